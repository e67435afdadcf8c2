//! What hidden geometry costs: the solves and held-out rays of one cell, with more and more copies
//! of the scene around it that the cell cannot see.
//!
//! A box around the scene keeps what is visible the same; the sets are compared. Copies are bodies of
//! their own, not instances, side by side in a square. The held-out rays of a viewpoint run on one
//! thread and solves on all, so give it one thread to weigh both alike:
//!
//! ```sh
//! RAYON_NUM_THREADS=1 cargo run --release -p sightline-benches --bin hidden -- CITY --region=-30,50,-20,60 --y 13.7
//! ```
#![allow(clippy::print_stdout)]

use std::time::Instant;

use clap::Parser;
use glam::{DAffine3, DVec3};
use sightline_benches::region::Place;
use sightline_benches::walls::walls;
use sightline_geometry::{
    Bounds, Instance, InstancedGeometry, MeshId, ObjectId, PrimitiveId, PrimitiveSet, Sampling,
};
use sightline_quality::measure_viewpoint;
use sightline_scene::{OpenOptions, Scene};
use sightline_solver::{SegmentVisibility, SolveOptions, solve_segment_with};

#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    place: Place,
    /// Bodies of the scene in all, one of which is the one around the rectangle.
    #[arg(long, value_delimiter = ',', default_value = "1,4,16,64")]
    bodies: Vec<usize>,
    /// Rows a face.
    #[arg(long, default_value_t = 24)]
    rows: u32,
    /// Passes of refinement.
    #[arg(long, default_value_t = 4)]
    passes: u32,
    /// Held-out rays: as many as a clean cell takes.
    #[arg(long, default_value_t = 18_000)]
    rays: u32,
    /// Rounds over all numbers of bodies; the least time of each counts.
    #[arg(long, default_value_t = 9)]
    rounds: u32,
}

/// A scene in a box, and around the box as many copies of the scene as make `count` bodies. Nothing
/// touches.
fn copies(scene: &InstancedGeometry, count: usize) -> InstancedGeometry {
    let size = scene.bounds.size();
    // Whole numbers that spiral out from 0.
    let mut places: Vec<(i32, i32)> =
        (-9..=9).flat_map(|x| (-9..=9).map(move |z| (x, z))).collect();
    places.sort_by_key(|(x, z)| (x * x + z * z, *x, *z));
    assert!(count <= places.len(), "at most {} bodies", places.len());
    let (mut meshes, mut instances) = (Vec::new(), Vec::new());
    let mut next = 0;
    for (x, z) in &places[..count] {
        let step = DVec3::new(f64::from(*x), 0.0, f64::from(*z)) * 1.1;
        instances.extend(scene.instances.iter().map(|one| Instance {
            mesh: MeshId(one.mesh.0 + meshes.len() as u32),
            world_from_mesh: DAffine3::from_translation(step * size) * one.world_from_mesh,
            first_primitive: PrimitiveId(one.first_primitive.0 + next),
            ..one.clone()
        }));
        meshes.extend(scene.meshes.iter().cloned());
        next += scene.primitive_count();
        if (*x, *z) == (0, 0) {
            let bounds = scene.bounds;
            let margin = 0.02 * size;
            instances.push(Instance {
                mesh: MeshId(meshes.len() as u32),
                object: ObjectId(0),
                world_from_mesh: DAffine3::IDENTITY,
                first_primitive: PrimitiveId(next),
                occluder: true,
                motion: None,
            });
            meshes.push(walls(Bounds { min: bounds.min - margin, max: bounds.max + margin }));
            next += 12;
        }
    }
    InstancedGeometry::new(meshes, instances)
}

struct Timed {
    bodies: usize,
    geometry: InstancedGeometry,
    solve: f64,
    rays: f64,
    set: PrimitiveSet,
    nodes: u64,
    tests: u64,
}

fn main() {
    let arguments = Arguments::parse();
    let scene =
        Scene::open(&arguments.place.scene, &OpenOptions::default()).expect("a readable scene");
    let region = arguments.place.rectangle().expect("a rectangle");
    let segments = region.perimeter(f64::INFINITY);
    let options =
        SolveOptions { passes: arguments.passes, threshold: 1e-6, ..SolveOptions::default() };
    let mut all: Vec<Timed> = arguments
        .bodies
        .iter()
        .map(|&bodies| Timed {
            bodies,
            geometry: copies(&scene.geometry, bodies),
            solve: f64::INFINITY,
            rays: f64::INFINITY,
            set: PrimitiveSet::default(),
            nodes: 0,
            tests: 0,
        })
        .collect();
    for _ in 0..arguments.rounds {
        for one in &mut all {
            let began = Instant::now();
            let found: Vec<SegmentVisibility> = segments
                .iter()
                .map(|segment| {
                    let sampling = Sampling::new(arguments.rows).jittered(segment.id.0);
                    solve_segment_with(&one.geometry, segment, sampling, &options)
                })
                .collect();
            one.solve = one.solve.min(began.elapsed().as_secs_f64());
            one.set = PrimitiveSet::union(found.iter().map(|f| &f.set));
            one.nodes = found.iter().map(|f| f.statistics.nodes).sum();
            one.tests = found.iter().map(|f| f.statistics.triangles).sum();
            let began = Instant::now();
            for (k, at) in (0..).zip(region.viewpoints(8)) {
                let error = measure_viewpoint(&one.geometry, &one.set, at, arguments.rays / 8, k);
                assert!(error.error < 0.01, "the cell is solved: {error:?}");
            }
            one.rays = one.rays.min(began.elapsed().as_secs_f64());
        }
    }
    println!(
        "| bodies | triangles | visible | nodes | triangles tested | solve | held-out rays | both, against the first |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- |");
    let first = all[0].solve + all[0].rays;
    for one in &all {
        assert!(one.set == all[0].set, "what is visible has changed with {} bodies", one.bodies);
        println!(
            "| {} | {} | {} | {} | {} | {:.1} ms | {:.1} ms | {:.3} |",
            one.bodies,
            one.geometry.primitive_count(),
            one.set.len(),
            one.nodes,
            one.tests,
            1e3 * one.solve,
            1e3 * one.rays,
            (one.solve + one.rays) / first
        );
    }
}
