//! Passes of finer rays go where something is missing, and nowhere else.

use glam::{DAffine3, DVec3};
use sightline_geometry::{
    Instance, InstancedGeometry, Mesh, MeshId, ObjectId, PrimitiveId, Sampling, SegmentId,
    ViewSegment,
};
use sightline_solver::{SegmentVisibility, SolveOptions, solve_segment, solve_segment_with};

fn quad(out: &mut Vec<[f32; 3]>, a: [f32; 3], b: [f32; 3], c: [f32; 3], d: [f32; 3]) {
    out.extend([a, b, c, a, c, d]);
}

/// A room of 200 m around the origin; one wall is a pattern of `n` x `n` squares.
fn room(n: usize) -> InstancedGeometry {
    let mut corners = Vec::new();
    let r = 100.0f32;
    let at = |x: f32, y: f32, z: f32| [r * x, r * y, r * z];
    let (l, h) = (-1.0, 1.0);
    quad(&mut corners, at(l, l, l), at(h, l, l), at(h, l, h), at(l, l, h));
    quad(&mut corners, at(l, h, l), at(h, h, l), at(h, h, h), at(l, h, h));
    quad(&mut corners, at(l, l, l), at(l, h, l), at(l, h, h), at(l, l, h));
    quad(&mut corners, at(l, l, l), at(h, l, l), at(h, h, l), at(l, h, l));
    quad(&mut corners, at(l, l, h), at(h, l, h), at(h, h, h), at(l, h, h));
    let on_wall = |i: usize, j: usize| {
        let place = |k: usize| -1.0 + 2.0 * k as f32 / n as f32;
        at(h, place(i), place(j))
    };
    for i in 0..n {
        for j in 0..n {
            let [a, b] = [on_wall(i, j), on_wall(i + 1, j)];
            quad(&mut corners, a, b, on_wall(i + 1, j + 1), on_wall(i, j + 1));
        }
    }
    let triangles: Vec<[u32; 3]> =
        (0..corners.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    let (mesh, _) = Mesh::new(corners, &triangles);
    let instance = Instance {
        mesh: MeshId(0),
        object: ObjectId(0),
        world_from_mesh: DAffine3::IDENTITY,
        first_primitive: PrimitiveId(0),
        occluder: true,
        motion: None,
    };
    InstancedGeometry::new(vec![mesh], vec![instance])
}

fn segment() -> ViewSegment {
    let v0 = DVec3::new(-20.0, 3.0, 1.0);
    ViewSegment { id: SegmentId(0), v0, v1: v0 + DVec3::new(1.0, 0.5, 4.0) }
}

fn refined(scene: &InstancedGeometry, passes: u32, threshold: f64) -> SegmentVisibility {
    let options = SolveOptions { passes, threshold, ..SolveOptions::default() };
    solve_segment_with(scene, &segment(), Sampling::new(16), &options)
}

#[test]
fn rays_are_added_where_small_things_are_and_nowhere_else() {
    let scene = room(64);
    let all = u64::from(scene.primitive_count());
    let coarse = refined(&scene, 0, 1e-7);
    let fine = refined(&scene, 4, 1e-7);
    assert!(coarse.set.len() < all / 4, "{} of {all}", coarse.set.len());
    assert!(fine.set.len() > all * 99 / 100, "{} of {all}", fine.set.len());
    let everywhere = solve_segment(&scene, &segment(), Sampling::new(256)).statistics.rays;
    assert!(fine.statistics.rays < everywhere / 2, "{} of {everywhere}", fine.statistics.rays);
    let plain = refined(&room(1), 4, 1e-7);
    assert_eq!(plain.statistics.rays, coarse.statistics.rays, "walls of two triangles need none");
}

#[test]
fn the_estimate_of_what_is_missing_falls_with_the_threshold() {
    let scene = room(128);
    let missing = [1.0, 3e-4, 1e-5].map(|threshold| refined(&scene, 4, threshold).missing);
    assert!(missing[0] > 2.0 * missing[1] && missing[1] > 4.0 * missing[2], "{missing:?}");
}

#[test]
fn the_weights_of_a_closed_room_add_up_to_the_whole() {
    for passes in [0, 3] {
        let seen = refined(&room(16), passes, 1e-7);
        let sum: f64 = seen.weights.iter().map(|&w| f64::from(w)).sum();
        assert!((sum - 1.0).abs() < 1e-4, "{passes} passes: {sum}");
    }
}

#[test]
fn what_is_known_needs_no_finer_rays() {
    let scene = room(64);
    let fine = refined(&scene, 4, 1e-7);
    let options = SolveOptions {
        passes: 4,
        threshold: 1e-7,
        known: Some(&fine.set),
        ..SolveOptions::default()
    };
    let again = solve_segment_with(&scene, &segment(), Sampling::new(16).jittered(1), &options);
    assert!(again.statistics.rays < fine.statistics.rays / 4);
    assert!(again.missing < 1e-3);
}

#[test]
fn threads_and_instructions_do_not_change_a_refined_result() {
    let scene = room(40);
    let on = |threads, portable| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let options =
            SolveOptions { passes: 3, threshold: 1e-6, portable, ..SolveOptions::default() };
        let sampling = Sampling::new(16);
        pool.install(|| solve_segment_with(&scene, &segment(), sampling, &options))
    };
    let one = on(1, true);
    assert!(one.set.len() > 1000);
    for (threads, portable) in [(1, false), (2, true), (8, false)] {
        assert_eq!(one, on(threads, portable), "{threads} threads, portable: {portable}");
    }
}
