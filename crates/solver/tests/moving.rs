//! The solver on what moves, against a picture: many times along each ray, each primitive where it is.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DAffine3, DQuat, DVec3};
use proptest::prelude::*;
use rayon::prelude::*;
use sightline_geometry::{
    FACE_COUNT, Instance, InstancedGeometry, Mesh, MeshId, Moment, ObjectId, ParticleSystem,
    PrimitiveId, Ray, RectifiedFrame, Sampling, SegmentId, Sphere, ViewSegment, raycast::RayCaster,
};
use sightline_solver::{
    Pixel, SolveOptions, StateVisibility, TimePath, envelope::Interval, solve_states,
    visit_intervals,
};

/// Times along a ray.
const TIMES: u32 = 1500;

fn segment(v0: DVec3, v1: DVec3) -> ViewSegment {
    ViewSegment { id: SegmentId(0), v0, v1 }
}

/// The place of a pixel in the order of faces, rows and columns.
fn number(sampling: Sampling, pixel: Pixel) -> usize {
    (pixel.face * sampling.rows() as usize + pixel.row as usize) * sampling.columns() as usize
        + pixel.column as usize
}

/// Of each pixel, at how many of the times in the middle of equal steps each primitive is the nearest
/// occluder.
fn picture(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
    state: u32,
    path: TimePath,
) -> Vec<BTreeMap<u32, u32>> {
    let frame = RectifiedFrame::new(segment).unwrap();
    let (rows, columns) = (sampling.rows() as usize, sampling.columns() as usize);
    let look = |caster: &mut RayCaster, pixel: usize| {
        let face = frame.face(pixel / (rows * columns));
        let (row, column) = (pixel / columns % rows, pixel % columns);
        let (w, c) = (sampling.row(row as u32), sampling.column(column as u32));
        let direction = face.axis * c + face.up * w + face.forward;
        let mut seen = BTreeMap::new();
        for k in 0..TIMES {
            let s = (f64::from(k) + 0.5) / f64::from(TIMES);
            let t = path.t0 + s * (path.t1 - path.t0);
            let origin = segment.v0.lerp(segment.v1, s);
            let ray = Ray { origin, direction, moment: Moment { state, t } };
            if let Some(hit) = caster.closest_occluder(geometry, ray, f64::INFINITY, |_| true) {
                *seen.entry(hit.primitive.0).or_insert(0) += 1;
            }
        }
        seen
    };
    (0..FACE_COUNT * rows * columns).into_par_iter().map_init(RayCaster::new, look).collect()
}

/// The intervals of each pixel.
fn lists(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
    state: u32,
    path: TimePath,
) -> Vec<(Pixel, Vec<Interval>)> {
    let mut out = Vec::new();
    visit_intervals(geometry, segment, sampling, state, path, |pixel, intervals| {
        out.push((pixel, intervals.to_vec()));
    });
    out
}

/// Panics where a pixel's intervals are not what its picture shows. An interval of length l holds more
/// than l TIMES - 1 and less than l TIMES + 1 of the times, and its ends may be off by their errors.
fn assert_seen(seen: &BTreeMap<u32, u32>, intervals: &[Interval], pixel: Pixel) {
    let step = 1.0 / f64::from(TIMES);
    let found: BTreeSet<u32> = intervals.iter().map(|i| i.primitive).collect();
    for &primitive in found.iter().chain(seen.keys()) {
        let shown = f64::from(seen.get(&primitive).copied().unwrap_or(0)) * step;
        let own = intervals.iter().filter(|i| i.primitive == primitive);
        let (length, off) = own.fold((0.0, 0.0), |(length, off), i| {
            (length + (i.end - i.start), off + step + i.start_error + i.end_error)
        });
        assert!(
            (length - shown).abs() <= off,
            "{pixel:?}, {primitive}: {length} of {intervals:?}, {shown} of the picture"
        );
    }
}

/// The share of (directions x segment) of each primitive, from the intervals that count.
fn shares(sampling: Sampling, lists: &[(Pixel, Vec<Interval>)]) -> BTreeMap<u32, f64> {
    let mut out = BTreeMap::new();
    for (pixel, intervals) in lists {
        let (i, j) = (f64::from(pixel.row), f64::from(pixel.column));
        let (c, w) = (|j: f64| sampling.c(j), |i: f64| sampling.w(i));
        let angle = Sampling::solid_angle(c(j), c(j + 1.0), w(i), w(i + 1.0));
        for interval in intervals.iter().filter(|i| i.counts()) {
            let share = angle / (4.0 * std::f64::consts::PI) * (interval.end - interval.start);
            *out.entry(interval.primitive).or_insert(0.0) += share;
        }
    }
    out
}

fn weights(of: &StateVisibility) -> BTreeMap<u32, f64> {
    let members = of.visibility.set.iter().map(|p| p.0);
    members.zip(of.visibility.weights.iter().map(|w| f64::from(*w))).collect()
}

fn compare(geometry: &InstancedGeometry, segment: &ViewSegment, path: TimePath) {
    let sampling = Sampling::with_columns(8, 8);
    let options = SolveOptions::default();
    let states = 0..geometry.states;
    let runs = solve_states(geometry, segment, sampling, states.clone(), path, None, &options);
    let without = SolveOptions { without_volumes: true, ..options };
    let plain = solve_states(geometry, segment, sampling, states.clone(), path, None, &without);
    assert_eq!(runs.len(), plain.len(), "volumes change nothing");
    for (a, b) in runs.iter().zip(&plain) {
        assert_eq!((&a.states, &a.visibility.set), (&b.states, &b.visibility.set));
        assert_eq!(a.visibility.weights, b.visibility.weights);
    }
    for state in states {
        let alone =
            solve_states(geometry, segment, sampling, state..state + 1, path, None, &options);
        let run = runs.iter().find(|run| run.states.contains(&state)).unwrap();
        assert_eq!(
            alone[0].visibility.set, run.visibility.set,
            "each state is as if it were alone"
        );
        assert_eq!(alone[0].visibility.weights, run.visibility.weights);
        let lists = lists(geometry, segment, sampling, state, path);
        let picture = picture(geometry, segment, sampling, state, path);
        for (pixel, intervals) in &lists {
            assert_seen(&picture[number(sampling, *pixel)], intervals, *pixel);
        }
        let (found, sums) = (weights(run), shares(sampling, &lists));
        assert!(found.keys().eq(sums.keys()), "state {state}: {found:?} {sums:?}");
        for ((primitive, a), b) in found.iter().zip(sums.values()) {
            // Stored as `f32`. A solid angle is a sum of four arcs, each right to 4 roundings of pi / 2:
            // in the solver's order and in this one, 4 roundings of the whole for a pixel.
            let off = f64::from(f32::EPSILON) * b + 4.0 * f64::EPSILON * lists.len() as f64;
            assert!((a - b).abs() <= off, "state {state}, {primitive}: {a} {b}");
        }
    }
}

fn point(size: f64) -> impl Strategy<Value = DVec3> {
    prop::array::uniform3(-size..size).prop_map(DVec3::from_array)
}

fn stored(points: &[DVec3]) -> Vec<[f32; 3]> {
    points.iter().map(|p| p.as_vec3().to_array()).collect()
}

fn soup(count: usize) -> Vec<[u32; 3]> {
    (0..count as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect()
}

fn instance(mesh: u32, first: usize, motion: Option<Vec<DAffine3>>) -> Instance {
    Instance {
        mesh: MeshId(mesh),
        object: ObjectId(mesh),
        world_from_mesh: motion.as_ref().map_or(DAffine3::IDENTITY, |m| m[0]),
        first_primitive: PrimitiveId(first as u32),
        occluder: true,
        motion: motion.map(Into::into),
    }
}

fn path() -> impl Strategy<Value = TimePath> {
    prop_oneof![
        Just(TimePath::FORWARD),
        Just(TimePath::REVERSED),
        (0.0..=1.0).prop_map(TimePath::stopped),
        (0.0..=1.0, 0.0..=1.0).prop_map(|(t0, t1)| TimePath { t0, t1 }),
    ]
}

/// Triangles that rest, that change and that are carried, and spheres, all around the segment.
fn scene() -> impl Strategy<Value = InstancedGeometry> {
    let points = |n: usize| prop::collection::vec(point(4.0), 3 * n);
    let turns = prop::collection::vec((point(1.0), 0.0..3.0, point(3.0)), 3);
    let spheres = prop::collection::vec((point(4.0), 0.1..1.2), 0..8);
    (
        points(4),
        prop::collection::vec(points(5), 3),
        points(4),
        turns,
        spheres.prop_flat_map(|s| {
            let n = s.len();
            (Just(s), prop::collection::vec((point(2.0), 0.5..1.5), 3 * n))
        }),
    )
        .prop_map(|(still, changing, carried, turns, (spheres, moves))| {
            let meshes = vec![
                Mesh::new(stored(&still), &soup(4)).0,
                Mesh::moving(changing.iter().map(|p| stored(p)).collect(), &soup(5)).0,
                Mesh::new(stored(&carried), &soup(4)).0,
            ];
            let maps = turns
                .iter()
                .map(|(axis, angle, to)| {
                    let axis = (*axis + DVec3::X * 1e-3).normalize();
                    DAffine3::from_rotation_translation(DQuat::from_axis_angle(axis, *angle), *to)
                })
                .collect();
            let instances =
                vec![instance(0, 0, None), instance(1, 4, None), instance(2, 9, Some(maps))];
            let keys = (0..3)
                .map(|key| {
                    let own = |(i, (center, radius)): (usize, &(DVec3, f64))| {
                        let (off, grow) = moves[3 * i + key];
                        Sphere {
                            center: (*center + off).as_vec3().to_array(),
                            radius: (radius * grow) as f32,
                        }
                    };
                    spheres.iter().enumerate().map(own).collect()
                })
                .collect();
            let first = PrimitiveId(13);
            let system = ParticleSystem::new(ObjectId(3), first, true, DVec3::ZERO, keys).0;
            InstancedGeometry::with_motion(meshes, instances, vec![system], 2)
        })
}

/// The same cases each time: a change is judged by what it changes.
fn short_form() -> ProptestConfig {
    let rng_seed = proptest::test_runner::RngSeed::Fixed(20_261_122);
    ProptestConfig { cases: 16, rng_seed, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(short_form())]

    #[test]
    fn what_moves_is_seen_where_it_is(
        scene in scene(), v0 in point(1.0), v1 in point(1.0), path in path(),
    ) {
        prop_assume!((v1 - v0).length() > 0.05);
        compare(&scene, &segment(v0, v1), path);
    }
}

/// A square at z = -2 that slides along x behind a wall with a window, over some states.
fn window(states: u32) -> InstancedGeometry {
    let quad = |x0: f32, x1: f32, y0: f32, y1: f32, z: f32| {
        vec![[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]
    };
    let two = [[0, 1, 2], [0, 2, 3]];
    let wall = |x0: f32, x1: f32| Mesh::new(quad(x0, x1, -9.0, 9.0, -1.0), &two).0;
    let meshes = vec![
        wall(-20.0, -0.25),
        wall(0.25, 20.0),
        Mesh::new(quad(-0.2, 0.2, -0.2, 0.2, -2.0), &two).0,
    ];
    let keys = (0..=states)
        .map(|k| DAffine3::from_translation(DVec3::X * (f64::from(k) - 0.5 * f64::from(states))))
        .collect();
    let instances = vec![instance(0, 0, None), instance(1, 2, None), instance(2, 4, Some(keys))];
    InstancedGeometry::with_motion(meshes, instances, vec![], states)
}

#[test]
fn a_mover_is_seen_in_the_states_in_which_it_passes_the_window() {
    let scene = window(20);
    let view = segment(DVec3::new(-0.1, 0.0, 0.0), DVec3::new(0.1, 0.0, 0.0));
    let sampling = Sampling::new(64);
    let solve = |options: &SolveOptions| {
        solve_states(&scene, &view, sampling, 0..20, TimePath::FORWARD, None, options)
    };
    let runs = solve(&SolveOptions::default());
    let seen: Vec<u32> = runs
        .iter()
        .filter(|run| run.visibility.set.contains(PrimitiveId(4)))
        .flat_map(|run| run.states.clone())
        .collect();
    assert_eq!(seen, [9, 10], "{:?}", runs.iter().map(|r| &r.states).collect::<Vec<_>>());
    assert!(runs[0].states == (0..9) && runs.last().unwrap().states == (11..20));
    let counters = runs[0].visibility.statistics;
    assert!(counters.skipped > 0 && counters.volumes > 0, "{counters:?}");
    let without = solve(&SolveOptions { without_volumes: true, ..SolveOptions::default() });
    assert_eq!(without[0].visibility.statistics.skipped, 0);
    assert!(without[0].visibility.statistics.nodes > counters.nodes);
}
