//! Clusters and objects: a unit is seen when one of its primitives is, and to stop looking changes
//! nothing.

use glam::{DAffine3, DVec3};
use proptest::prelude::*;
use sightline_geometry::{
    Granularity, Instance, InstancedGeometry, Mesh, MeshId, ObjectId, ParticleSystem, PrimitiveId,
    Sampling, SegmentId, Sphere, Units, ViewSegment,
};
use sightline_solver::{
    SegmentVisibility, SolveOptions, StateVisibility, TimePath, solve_segment_with, solve_states,
};

const GRANULARITIES: [Granularity; 2] = [Granularity::Cluster, Granularity::Object];

/// A sheet of 2 n^2 triangles, 1 m wide, in the plane z = 0.
fn sheet(n: u32) -> Mesh {
    let at = |k: u32| k as f32 / n as f32 - 0.5;
    let positions = (0..=n).flat_map(|i| (0..=n).map(move |j| [at(i), at(j), 0.0])).collect();
    let corner = |i: u32, j: u32| i * (n + 1) + j;
    let triangles: Vec<[u32; 3]> = (0..n * n)
        .map(|k| (k / n, k % n))
        .flat_map(|(i, j)| {
            let [a, b] = [corner(i, j), corner(i + 1, j)];
            [[a, b, a + 1], [b, b + 1, a + 1]]
        })
        .collect();
    Mesh::new(positions, &triangles).0
}

/// Sheets around the origin, each an object, and how far each moves in two states.
fn sheets(places: &[(DVec3, f64, DVec3)], particles: bool) -> InstancedGeometry {
    let meshes = vec![sheet(24), sheet(3)];
    let mut first = 0;
    let instances = places
        .iter()
        .enumerate()
        .map(|(k, (place, size, moves))| {
            let mesh = k % 2;
            let first_primitive = PrimitiveId(first);
            first += meshes[mesh].triangles.len() as u32;
            let turned = glam::DQuat::from_rotation_arc(DVec3::Z, place.normalize());
            let key = |t: f64| {
                DAffine3::from_scale_rotation_translation(
                    DVec3::splat(*size),
                    turned,
                    *place + t * *moves,
                )
            };
            let motion = (*moves != DVec3::ZERO).then(|| [0.0, 1.0, -1.0].map(key).into());
            Instance {
                mesh: MeshId(mesh as u32),
                object: ObjectId(k as u32),
                world_from_mesh: key(0.0),
                first_primitive,
                occluder: k % 7 != 3,
                motion,
            }
        })
        .collect::<Vec<_>>();
    let key = |shift: f32| {
        (0..200)
            .map(|k| {
                let angle = k as f32 * 0.7;
                let center = [3.0 * angle.cos() + shift, 0.01 * k as f32, 3.0 * angle.sin()];
                Sphere { center, radius: 0.05 }
            })
            .collect()
    };
    let (system, _) = ParticleSystem::new(
        ObjectId(places.len() as u32),
        PrimitiveId(first),
        true,
        DVec3::ZERO,
        vec![key(0.0), key(0.4), key(-0.3)],
    );
    let moves = instances.iter().any(|i| i.motion.is_some());
    let particles = if particles { vec![system] } else { vec![] };
    let states = if moves || !particles.is_empty() { 2 } else { 1 };
    InstancedGeometry::with_motion(meshes, instances, particles, states)
}

fn segment() -> ViewSegment {
    ViewSegment {
        id: SegmentId(0),
        v0: DVec3::new(-0.4, 0.1, -0.2),
        v1: DVec3::new(0.5, -0.1, 0.3),
    }
}

/// Directions in all of space, sizes, and motion of one in three.
fn places() -> impl Strategy<Value = Vec<(DVec3, f64, DVec3)>> {
    let place = (prop::array::uniform3(-1.0..1.0), 1.5..9.0, 0.3..4.0, 0..3, -1.0..1.0).prop_map(
        |(to, far, size, moves, step): ([f64; 3], f64, f64, i32, f64)| {
            let to = (DVec3::from_array(to) + DVec3::new(1e-3, 0.0, 0.0)).normalize();
            let along = if moves == 0 { DVec3::new(step, 0.0, 0.5 * step) } else { DVec3::ZERO };
            (far * to, size, along)
        },
    );
    prop::collection::vec(place, 1..24)
}

fn solve(scene: &InstancedGeometry, options: &SolveOptions) -> Vec<StateVisibility> {
    let (sampling, states) = (Sampling::new(16), 0..scene.states);
    solve_states(scene, &segment(), sampling, states, TimePath::FORWARD, None, options)
}

/// What each state sees.
fn by_state(found: &[StateVisibility]) -> Vec<&SegmentVisibility> {
    found.iter().flat_map(|run| run.states.clone().map(|_| &run.visibility)).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn a_unit_is_seen_when_one_of_its_primitives_is(places in places(), particles: bool) {
        let scene = sheets(&places, particles);
        let single = solve(&scene, &SolveOptions::default());
        for granularity in GRANULARITIES {
            let units = Units::new(&scene, granularity);
            let whole =
                solve(&scene, &SolveOptions { units: Some(&units), ..SolveOptions::default() });
            for (single, whole) in by_state(&single).into_iter().zip(by_state(&whole)) {
                prop_assert_eq!(&units.around(&scene, &single.set), &whole.set);
                prop_assert_eq!(whole.weights.len() as u64, whole.set.len());
                let sum = |found: &SegmentVisibility| -> f64 {
                    found.weights.iter().map(|w| f64::from(*w)).sum()
                };
                prop_assert!((sum(single) - sum(whole)).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn to_stop_looking_changes_nothing(places in places(), particles: bool) {
        let scene = sheets(&places, particles);
        for granularity in GRANULARITIES {
            let units = Units::new(&scene, granularity);
            let options = SolveOptions {
                passes: 3,
                threshold: 1e-7,
                units: Some(&units),
                ..SolveOptions::default()
            };
            let stops = solve(&scene, &options);
            let looks_on = solve(&scene, &SolveOptions { exhaustive: true, ..options });
            for (a, b) in by_state(&stops).into_iter().zip(by_state(&looks_on)) {
                prop_assert_eq!(&a.set, &b.set);
                prop_assert_eq!(&a.weights, &b.weights);
                prop_assert_eq!(a.missing, b.missing);
                prop_assert!(a.statistics.rays <= b.statistics.rays);
            }
        }
    }
}

#[test]
fn the_solver_stops_where_all_that_can_be_seen_has_been() {
    // A distant one that few rays meet, beside near ones that all do.
    let near = |x: f64, z: f64| (DVec3::new(x, 0.0, z), 6.0, DVec3::ZERO);
    let far = (DVec3::new(24.0, 0.0, 18.0), 4.0, DVec3::ZERO);
    let scene = sheets(&[near(4.0, 0.0), far, near(0.0, -4.0), near(-4.0, 0.0)], false);
    let units = Units::new(&scene, Granularity::Object);
    let solve = |units: Option<&Units>, exhaustive| {
        let options = SolveOptions {
            passes: 4,
            threshold: 1e-8,
            units,
            exhaustive,
            ..SolveOptions::default()
        };
        solve_segment_with(&scene, &segment(), Sampling::new(12), &options)
    };
    let (single, on, stops) =
        (solve(None, false), solve(Some(&units), true), solve(Some(&units), false));
    assert_eq!(on.set, stops.set);
    assert!(single.set.iter().all(|p| stops.set.contains(p)));
    assert!(stops.statistics.rays < single.statistics.rays, "{:?}", stops.statistics);
    assert!(stops.statistics.rays <= on.statistics.rays);
}
