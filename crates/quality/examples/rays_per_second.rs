//! Rays a second of the measurement in a synthetic city of about 200,000 triangles.
//!
//! `cargo run --release -p sightline-quality --example rays_per_second`
#![allow(clippy::print_stdout)]

use std::time::Instant;

use glam::{DAffine3, DVec3};
use sightline_geometry::{
    CellId, Instance, InstancedGeometry, Mesh, MeshId, ObjectId, PrimitiveId, PrimitiveSet, Run,
    ViewCell,
};
use sightline_quality::{SplitMix64, measure_cell};

/// A box of `floors` x `bays` window panels a side: a building.
fn building(floors: usize, bays: usize, height: f32) -> Mesh {
    let (mut positions, mut triangles) = (Vec::new(), Vec::new());
    let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0f32]];
    for side in 0..4 {
        let (a, b) = (corners[side], corners[(side + 1) % 4]);
        let base = positions.len() as u32;
        for f in 0..=floors {
            for k in 0..=bays {
                let (s, y) = (k as f32 / bays as f32, height * f as f32 / floors as f32);
                positions.push([a[0] + s * (b[0] - a[0]), y, a[1] + s * (b[1] - a[1])]);
            }
        }
        for f in 0..floors as u32 {
            for k in 0..bays as u32 {
                let i = base + f * (bays as u32 + 1) + k;
                let up = i + bays as u32 + 1;
                triangles.extend([[i, up, i + 1], [i + 1, up, up + 1]]);
            }
        }
    }
    Mesh::new(positions, &triangles).0
}

fn main() {
    let mut random = SplitMix64::new(1);
    let (mut meshes, mut instances, mut first) = (Vec::new(), Vec::new(), 0u32);
    let mut place = |mesh: Mesh, at: DAffine3| {
        let count = mesh.triangles.len() as u32;
        instances.push(Instance {
            mesh: MeshId(meshes.len() as u32),
            object: ObjectId(meshes.len() as u32),
            world_from_mesh: at,
            first_primitive: PrimitiveId(first),
            occluder: true,
            motion: None,
        });
        meshes.push(mesh);
        first += count;
    };
    let ground = vec![[-2e3, 0.0, -2e3], [2e3, 0.0, -2e3], [2e3, 0.0, 2e3], [-2e3, 0.0, 2e3f32]];
    place(Mesh::new(ground, &[[0, 2, 1], [0, 3, 2]]).0, DAffine3::IDENTITY);
    for x in -10..10 {
        for z in -10..10 {
            let at = DVec3::new(f64::from(x) * 40.0 + 20.0, 0.0, f64::from(z) * 40.0 + 20.0);
            let height = 10.0 + 70.0 * random.next_unit();
            let mesh = building((height / 4.0) as usize, 6, height as f32);
            let scale = DVec3::new(12.0 + 3.0 * random.next_unit(), 1.0, 12.0);
            place(mesh, DAffine3::from_scale_rotation_translation(scale, Default::default(), at));
        }
    }
    let geometry = InstancedGeometry::new(meshes, instances);
    let all = geometry.primitive_count();
    let mut set = PrimitiveSet::default();
    set.push(Run { first: 0, end: all });
    let corner = |x: f64, z: f64| DVec3::new(x, 1.6, z);
    let corners = [corner(-5.0, -5.0), corner(5.0, -5.0), corner(5.0, 5.0), corner(-5.0, 5.0)];
    let cell = ViewCell { id: CellId(0), corners, height: 0.4 };
    for rays in [10_000, 100_000] {
        let start = Instant::now();
        let error = measure_cell(&geometry, &set, &cell, 10, rays, 3);
        let seconds = start.elapsed().as_secs_f64();
        let rate = 1e-6 * f64::from(10 * rays) / seconds / rayon::current_num_threads() as f64;
        println!("{all} triangles, {rays} rays: {rate:.3} M rays/s/core, error {}", error.mean());
    }
}
