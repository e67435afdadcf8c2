//! What a task computes.
//!
//! Everything here is a pure function of the scene, the plan's entries, the configuration and the
//! rows of the segments: no store, no network, no clock. VI-3: the result does not depend on the
//! worker, its threads or the order of its tasks.
//!
//! Where something moves, camera and time are coupled by a [`TimePath`]. The planned segments take turns
//! by their number: the camera runs with time along even ones, against it along odd ones, so a cell's
//! perimeter has both. What that leaves out, refinement finds (`cell`).

use std::collections::BTreeMap;
use std::ops::Range;

use rayon::prelude::*;
use sightline_geometry::{
    InstancedGeometry, Sampling, SegmentId, StateSets, Timeline, ViewSegment,
};
use sightline_jobs::{BakeConfig, PlannedCell};
use sightline_scene::Scene;
use sightline_solver::{
    SegmentVisibility, SolveOptions, TimePath, solve_segment_with, solve_states,
};
use sightline_store::{CellRow, ObjectRow, SegmentRow};

use crate::cell::finish_cell;
pub use crate::join::join_cells;
pub use crate::pool::Cancel;

/// What a task works on: some of the states of a scene.
#[derive(Clone, Debug)]
pub struct Work<'a> {
    /// The scene.
    pub scene: &'a Scene,
    /// When its states are.
    pub timeline: &'a Timeline,
    /// What is asked of the dataset.
    pub config: &'a BakeConfig,
    /// The states of the task.
    pub states: Range<u32>,
}

impl Work<'_> {
    /// True when the task takes all states of the scene.
    #[must_use]
    pub fn takes_all_states(&self) -> bool {
        self.states == (0..self.timeline.states())
    }
}

/// Solves segments, in order: for each, one row a run of states with equal results. `None` when it was
/// cancelled.
#[must_use]
pub fn solve_segments(
    work: &Work<'_>,
    segments: &[ViewSegment],
    cancel: &Cancel,
) -> Option<Vec<SegmentRow>> {
    let sampling = Sampling::new(work.config.solver.rows);
    let solved: Option<Vec<Vec<SegmentRow>>> = segments
        .par_iter()
        .map(|segment| {
            let (states, path) = (work.states.clone(), planned_path(segment.id));
            (!cancel.is_cancelled())
                .then(|| solve_segment(work, segment, sampling, states, path, None))
        })
        .collect();
    solved.map(|rows| rows.concat())
}

/// How camera and time are coupled along a segment of the plan.
pub(crate) const fn planned_path(segment: SegmentId) -> TimePath {
    if segment.0.is_multiple_of(2) { TimePath::FORWARD } else { TimePath::REVERSED }
}

/// Passes of finer rays within a solve: the last has 16 times the rows of the first.
const PASSES: u32 = 4;

/// A tile is refined when more than this part of the target error may be missing in it.
const TILE_SHARE: f64 = 1.0 / 128.0;

/// True when nothing moves and nothing comes or goes.
fn is_at_rest(geometry: &InstancedGeometry) -> bool {
    geometry.states == 1 && !geometry.has_motion()
}

/// The one place that calls the solver. Segments differ in where the rays of their pixels are:
/// neighbours on one line would otherwise share their rows. Without refinement by rounds, there is
/// none by rays. What is `known` is so in each of `states`.
#[must_use]
pub fn solve_segment(
    work: &Work<'_>,
    segment: &ViewSegment,
    sampling: Sampling,
    states: Range<u32>,
    path: TimePath,
    known: Option<&StateSets>,
) -> Vec<SegmentRow> {
    let Work { scene, config, .. } = work;
    let sampling = sampling.jittered(segment.id.0);
    let options = SolveOptions {
        passes: if config.accuracy.rounds > 0 { PASSES } else { 0 },
        threshold: TILE_SHARE * config.accuracy.target_error,
        ..SolveOptions::default()
    };
    let row = |states: Range<u32>, found: SegmentVisibility| SegmentRow {
        segment: segment.id,
        first_state: states.start,
        last_state: states.end - 1,
        set: found.set,
        weights: found.weights,
        rays: found.statistics.rays,
    };
    if is_at_rest(&scene.geometry) {
        let options = SolveOptions { known: known.map(|sets| sets.at(states.start)), ..options };
        let found = solve_segment_with(&scene.geometry, segment, sampling, &options);
        return vec![row(states, found)];
    }
    solve_states(&scene.geometry, segment, sampling, states, path, known, &options)
        .into_iter()
        .map(|found| row(found.states, found.visibility))
        .collect()
}

/// What rows of one segment see in each of their states.
///
/// # Panics
/// When the rows do not follow each other.
pub(crate) fn sets_of(rows: &[SegmentRow]) -> StateSets {
    StateSets::from_runs(rows.iter().map(|row| (row.states(), row.set.clone())))
}

/// What was found for one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct CellOutput {
    /// Its rows: those of the dataset when the task takes all states, else one a run of the task's
    /// states. In the order of their table.
    pub rows: Vec<CellRow>,
    /// One row an object of which a primitive is visible, ascending; none when the task does not take
    /// all states.
    pub objects: Vec<ObjectRow>,
}

/// Finishes cells, in order. `None` when it was cancelled. `segments` are those of the plan, by
/// number; `rows` holds at least the rows of the cells' segments in the states of the task.
///
/// # Panics
/// When a row is missing: the caller reads them all.
#[must_use]
pub fn solve_cells(
    work: &Work<'_>,
    cells: &[PlannedCell],
    segments: &[ViewSegment],
    rows: &BTreeMap<SegmentId, Vec<SegmentRow>>,
    cancel: &Cancel,
) -> Option<Vec<CellOutput>> {
    cells
        .par_iter()
        .map(|planned| {
            let solved: Vec<(&ViewSegment, &[SegmentRow])> =
                planned.segments.iter().map(|id| (&segments[id.index()], &rows[id][..])).collect();
            (!cancel.is_cancelled()).then(|| finish_cell(work, planned, &solved))
        })
        .collect()
}
