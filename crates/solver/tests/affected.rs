//! What was added and is seen nowhere leaves a result as it was, to the last bit.

use glam::{DAffine3, DVec3};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use sightline_geometry::{
    Instance, InstanceId, InstancedGeometry, Mesh, MeshId, ObjectId, PrimitiveId, PrimitiveSet,
    Run, Sampling, SegmentId, ViewSegment,
};
use sightline_solver::{
    Added, SegmentVisibility, SolveOptions, Statistics, is_affected, solve_segment_with,
};

/// A box, open or closed, somewhere in a room.
#[derive(Clone, Debug)]
struct Thing {
    center: [f32; 3],
    size: [f32; 3],
    faces: u8,
    occluder: bool,
}

const CORNERS: [[f32; 3]; 8] = [
    [-1.0, -1.0, -1.0],
    [1.0, -1.0, -1.0],
    [1.0, 1.0, -1.0],
    [-1.0, 1.0, -1.0],
    [-1.0, -1.0, 1.0],
    [1.0, -1.0, 1.0],
    [1.0, 1.0, 1.0],
    [-1.0, 1.0, 1.0],
];
const FACES: [[u32; 4]; 6] =
    [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [3, 2, 6, 7], [0, 3, 7, 4], [1, 2, 6, 5]];

impl Thing {
    fn mesh(&self) -> Mesh {
        let place = |c: [f32; 3]| std::array::from_fn(|k| self.center[k] + c[k] * self.size[k]);
        let chosen = (0..6).filter(|k| self.faces >> k & 1 == 1).map(|k| FACES[k]);
        let triangles: Vec<[u32; 3]> =
            chosen.flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Mesh::new(CORNERS.map(place).to_vec(), &triangles).0
    }
}

/// The walls around everything: all scenes have the same box.
fn room() -> Thing {
    Thing { center: [0.0; 3], size: [100.0; 3], faces: 63, occluder: true }
}

fn scene(things: &[Thing]) -> InstancedGeometry {
    let meshes: Vec<Mesh> = things.iter().map(Thing::mesh).collect();
    let mut next = 0;
    let instances = things.iter().zip(&meshes).zip(0..).map(|((thing, mesh), number)| {
        let first_primitive = PrimitiveId(next);
        next += mesh.triangles.len() as u32;
        Instance {
            mesh: MeshId(number),
            object: ObjectId(number),
            world_from_mesh: DAffine3::IDENTITY,
            first_primitive,
            occluder: thing.occluder,
            motion: None,
        }
    });
    let instances = instances.collect();
    InstancedGeometry::new(meshes, instances)
}

fn things() -> impl Strategy<Value = Vec<Thing>> {
    // On a coarse lattice, so that walls touch, coincide and hide each other exactly.
    let place = || (-9i8..=9).prop_map(|k| f32::from(k) * 4.0);
    let size = || prop_oneof![Just(1.0f32), Just(4.0), Just(8.0), Just(30.0)];
    let thing =
        ([place(), place(), place()], [size(), size(), size()], 1u8..64, prop::bool::weighted(0.8))
            .prop_map(|(center, size, faces, occluder)| Thing { center, size, faces, occluder });
    // The last one, which comes and goes, is small: now and then it is hidden.
    (prop::collection::vec(thing.clone(), 6..24), thing).prop_map(|(mut things, last)| {
        things.push(Thing { size: last.size.map(|size| size.min(2.0)), ..last });
        things
    })
}

fn runner() -> TestRunner {
    TestRunner::new(Config { cases: 1500, failure_persistence: None, ..Config::default() })
}

fn solve(scene: &InstancedGeometry, segment: &ViewSegment) -> SegmentVisibility {
    let options = SolveOptions { passes: 3, threshold: 1e-4, ..SolveOptions::default() };
    let found = solve_segment_with(scene, segment, Sampling::new(16), &options);
    // How much was looked at does change.
    let statistics = Statistics { rays: found.statistics.rays, ..Statistics::default() };
    SegmentVisibility { statistics, ..found }
}

#[test]
fn what_is_seen_nowhere_changes_nothing() {
    let mut runner = runner();
    let point = || [-8.0..8.0, -8.0..8.0, -8.0..8.0f64];
    let outcomes = std::cell::Cell::new([0, 0]);
    let cases = (things(), point(), point());
    let ran = runner.run(&cases, |(things, v0, v1)| {
        let segment = ViewSegment { id: SegmentId(0), v0: v0.into(), v1: DVec3::from(v1) };
        let all = [vec![room()], things].concat();
        let (before, after) = (scene(&all[..all.len() - 1]), scene(&all));
        prop_assert_eq!(before.bounds, after.bounds);
        let added = PrimitiveSet::from_sorted(before.primitive_count()..after.primitive_count());
        let alone = after.of_instances([InstanceId(all.len() as u32 - 1)]);
        let found = solve(&before, &segment);
        let question = Added { scene: &after, alone: &alone, primitives: &added };
        let affected = is_affected(&question, &segment, Sampling::new(16), &found.trace);
        let mut counts = outcomes.get();
        counts[usize::from(affected)] += 1;
        outcomes.set(counts);
        if !affected {
            prop_assert_eq!(solve(&after, &segment), found);
        }
        Ok(())
    });
    ran.unwrap_or_else(|error| panic!("{error}"));
    let [unseen, seen] = outcomes.get();
    assert!(unseen > 100 && seen > 100, "both happen: {unseen}, {seen}");
}

#[test]
fn what_was_nearest_nowhere_can_be_taken_away() {
    let mut runner = runner();
    let point = || [-8.0..8.0, -8.0..8.0, -8.0..8.0f64];
    let unseen = std::cell::Cell::new(0);
    let ran = runner.run(&(things(), point(), point()), |(things, v0, v1)| {
        let segment = ViewSegment { id: SegmentId(0), v0: v0.into(), v1: DVec3::from(v1) };
        let all = [vec![room()], things].concat();
        let (before, after) = (scene(&all), scene(&all[..all.len() - 1]));
        let gone = Run { first: after.primitive_count(), end: before.primitive_count() };
        let found = solve(&before, &segment);
        let seen = [&found.set, &found.trace.grazed].map(|s| s.count_in(gone.first..gone.end));
        if seen == [0, 0] {
            unseen.set(unseen.get() + 1);
            prop_assert_eq!(solve(&after, &segment), found);
        }
        Ok(())
    });
    ran.unwrap_or_else(|error| panic!("{error}"));
    assert!(unseen.get() > 100, "it happens: {}", unseen.get());
}
