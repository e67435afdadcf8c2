//! The end of a cell: joins what its segments see, and refines until the error is small.
//!
//! 1. The set is the union of the sets of the cell's segments, and of the triangles that reach
//!    into the cell: those are visible from viewpoints close to them, whatever the perimeter sees.
//! 2. The error of the set is measured with rays from *held-out* viewpoints, random in the cell,
//!    that no segment was chosen for. Rays are cast over the hierarchy: the measurement shares no
//!    code with the solver.
//! 3. While the mean or the worst error is over its target and rounds are left, lines of the cell
//!    through the worst of these viewpoints are solved too, and the set is measured again at fresh
//!    viewpoints. A line runs across the whole footprint at the viewpoint's relative height;
//!    on the bilinear surface of a cell it is straight. So pockets that the perimeter does not
//!    see into, behind furniture or under a roof inside the cell, are found where they are.
//!
//! Everything is seeded by the cell's number and the round, so the row is a function of scene and
//! configuration alone.

use std::collections::BTreeMap;

use glam::DVec3;
use sightline_geometry::{
    CellId, InstancedGeometry, ObjectId, PrimitiveSet, Sampling, SegmentId, ViewCell, ViewSegment,
    overlap::primitives_in_cell,
};
use sightline_jobs::{AccuracyConfig, BakeConfig, PlannedCell};
use sightline_quality::{CellError, measure_viewpoints, random_viewpoints};
use sightline_scene::Scene;
use sightline_store::{CellRow, ObjectRow, SegmentRow};

use crate::solve::{CellOutput, solve_segment};

/// Lines that one refinement round solves at most. More find more a round, but a line through
/// one viewpoint of a pocket usually ends the error at the others too.
const LINES_PER_ROUND: usize = 4;

/// Base of the seeds of held-out viewpoints ("sightline" on a keypad); the round is added. Far
/// from the small seeds that people give to `verify`, which has to be independent.
const HELDOUT_SEED: u64 = 744_485_463_000_000;

/// The rows of a finished cell. `rows` are the sets of `planned.segments`, in that order.
///
/// Runs on the current rayon pool.
#[must_use]
pub fn finish_cell(
    scene: &Scene,
    config: &BakeConfig,
    planned: &PlannedCell,
    rows: &[&SegmentRow],
) -> CellOutput {
    let (geometry, cell, accuracy) = (&scene.geometry, &planned.cell, &config.accuracy);
    let sampling = Sampling::new(config.solver.rows);
    let inside = primitives_in_cell(geometry, cell);
    let mut set = PrimitiveSet::union(rows.iter().map(|r| &r.set).chain([&inside]));
    let mut lines: Vec<SegmentRow> = Vec::new();
    let (mut rounds, mut rays) = (0, 0);
    let error = loop {
        let error = heldout_error(geometry, &set, cell, accuracy, rounds);
        rays += error.viewpoints.iter().map(|v| u64::from(v.rays)).sum::<u64>();
        let good = error.mean() <= accuracy.target_error && error.max() <= accuracy.worst_error;
        if good || rounds >= accuracy.rounds {
            break error;
        }
        rounds += 1;
        for line in lines_through_worst(cell, &error, accuracy.target_error, rounds) {
            let seen = solve_segment(scene, &line, sampling);
            set = PrimitiveSet::union([&set, &seen.set]);
            lines.push(seen);
        }
    };
    let solved: Vec<&SegmentRow> = rows.iter().copied().chain(&lines).collect();
    CellOutput {
        objects: object_rows(scene, cell.id, &solved, &set),
        cell: CellRow {
            cell: cell.clone(),
            tile: planned.tile,
            set,
            segments: solved.len() as u32,
            refinements: rounds,
            heldout_rays: rays,
            heldout_error_mean: error.mean(),
            heldout_error_max: error.max(),
        },
    }
}

fn heldout_error(
    geometry: &InstancedGeometry,
    set: &PrimitiveSet,
    cell: &ViewCell,
    accuracy: &AccuracyConfig,
    round: u32,
) -> CellError {
    let seed = HELDOUT_SEED + u64::from(round);
    let viewpoints = random_viewpoints(cell, accuracy.heldout_viewpoints, seed);
    measure_viewpoints(geometry, set, cell.id, &viewpoints, accuracy.heldout_rays, seed)
}

/// Lines of the cell through the worst viewpoints whose error is over `target`. Along u and along
/// v in turn, so that a pocket open to one side only is looked into from both.
fn lines_through_worst(
    cell: &ViewCell,
    error: &CellError,
    target: f64,
    round: u32,
) -> Vec<ViewSegment> {
    let mut worst: Vec<_> = error.viewpoints.iter().filter(|v| v.error > target).collect();
    worst.sort_by(|a, b| b.error.total_cmp(&a.error));
    worst
        .iter()
        .take(LINES_PER_ROUND)
        .enumerate()
        .map(|(k, v)| line_through(cell, v.viewpoint, (k as u32 + round) % 2 == 0))
        .collect()
}

/// The line of constant v (`along_u`) or of constant u through a point of the cell.
fn line_through(cell: &ViewCell, point: DVec3, along_u: bool) -> ViewSegment {
    let b = cell.bounds();
    let size = b.size();
    let (u, v) = ((point.x - b.min.x) / size.x, (point.z - b.min.z) / size.z);
    let up = point.y - cell.viewpoint(u, v, 0.0).y;
    let h = if cell.height > 0.0 { up / cell.height } else { 0.0 };
    let (v0, v1) = if along_u {
        (cell.viewpoint(0.0, v, h), cell.viewpoint(1.0, v, h))
    } else {
        (cell.viewpoint(u, 0.0, h), cell.viewpoint(u, 1.0, h))
    };
    // Lines of a cell are solved where they are found; they have no number in the plan.
    ViewSegment { id: SegmentId(u32::MAX), v0, v1 }
}

/// One row an object with a member in `set`.
///
/// The weight of an object is the mean over the cell's segments of the summed weights of its
/// primitives; what only reaches into the cell has none.
fn object_rows(
    scene: &Scene,
    cell: CellId,
    rows: &[&SegmentRow],
    set: &PrimitiveSet,
) -> Vec<ObjectRow> {
    let weights = object_weights(scene, rows);
    let segments = rows.len().max(1) as f64;
    visible_objects(scene, set)
        .map(|(object, visible_primitives)| {
            let primitives = &scene.objects[object.index()].primitives;
            let weight = weights.get(&object).copied().unwrap_or(0.0) / segments;
            ObjectRow {
                cell,
                object,
                visible_primitives,
                total_primitives: primitives.end - primitives.start,
                // Each weight is rounded to f32, so a sum may pass the whole by as much.
                weight: weight.min(1.0),
                first_state: 0,
                last_state: 0,
            }
        })
        .collect()
}

/// Objects with a member in `set`, ascending, and how many members each has.
fn visible_objects<'a>(
    scene: &'a Scene,
    set: &'a PrimitiveSet,
) -> impl Iterator<Item = (ObjectId, u32)> + 'a {
    let mut next = 0;
    std::iter::from_fn(move || {
        // The object of the first member at or behind `next`.
        let runs = set.runs();
        let run = runs.get(runs.partition_point(|run| run.end <= next))?;
        let object = object_of(scene, run.first.max(next));
        let range = scene.objects[object.index()].primitives.clone();
        next = range.end;
        let count =
            u32::try_from(set.count_in(range)).expect("an object has under 2^32 primitives");
        Some((object, count))
    })
}

fn object_of(scene: &Scene, primitive: u32) -> ObjectId {
    let behind = scene.objects.partition_point(|object| object.primitives.end <= primitive);
    scene.objects[behind].id
}

/// For each object, the sum of its primitives' weights over the cell's segments. Summed in the
/// order of segments and primitives, so the sum is always the same.
fn object_weights(scene: &Scene, rows: &[&SegmentRow]) -> BTreeMap<ObjectId, f64> {
    let mut sums = BTreeMap::new();
    for row in rows {
        let mut current: Option<(std::ops::Range<u32>, ObjectId)> = None;
        for (primitive, weight) in row.set.iter().zip(&row.weights) {
            let object = match &current {
                Some((range, object)) if range.contains(&primitive.0) => *object,
                _ => {
                    let object = object_of(scene, primitive.0);
                    let range = scene.objects[object.index()].primitives.clone();
                    current = Some((range, object));
                    object
                }
            };
            *sums.entry(object).or_insert(0.0) += f64::from(*weight);
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_pass_through_their_viewpoint_and_end_on_the_perimeter() {
        let corner = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
        let cell = ViewCell {
            id: CellId(3),
            corners: [
                corner(0.0, 1.0, 0.0),
                corner(4.0, 2.0, 0.0),
                corner(4.0, 2.5, 4.0),
                corner(0.0, 0.5, 4.0),
            ],
            height: 0.4,
        };
        let point = cell.viewpoint(0.25, 0.5, 0.75);
        for along_u in [true, false] {
            let line = line_through(&cell, point, along_u);
            let t = if along_u { 0.25 } else { 0.5 };
            assert!((line.v0.lerp(line.v1, t) - point).length() < 1e-12);
        }
    }
}
