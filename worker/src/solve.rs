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
    Granularity, InstancedGeometry, Sampling, SegmentId, StateSets, Timeline, Units, ViewSegment,
};
use sightline_jobs::{BakeConfig, PlannedCell};
use sightline_scene::Scene;
use sightline_solver::{
    SegmentTrace, SegmentVisibility, SolveOptions, TimePath, solve_segment_with, solve_states,
};
use sightline_store::{CellRow, ObjectRow, SegmentRow};

use crate::cell::finish_cell;
pub use crate::join::join_cells;
pub use crate::pool::Cancel;
use crate::trace::CellTrace;

/// What a task works on: some of the states of a scene.
#[derive(Clone, Debug)]
pub struct Work<'a> {
    /// The scene.
    pub scene: &'a Scene,
    /// When its states are.
    pub timeline: &'a Timeline,
    /// What is asked of the dataset.
    pub config: &'a BakeConfig,
    /// What is visible as a whole, as the configuration asks for it.
    pub units: &'a Units,
    /// The states of the task.
    pub states: Range<u32>,
}

impl Work<'_> {
    /// True when it is known what results depend on: in scenes at rest, of single primitives.
    #[must_use]
    pub fn is_traced(&self) -> bool {
        is_at_rest(&self.scene.geometry)
            && self.scene.geometry.particles.is_empty()
            && self.units.granularity() == Granularity::Triangle
    }

    /// True when the task takes all states of the scene.
    #[must_use]
    pub fn takes_all_states(&self) -> bool {
        self.states == (0..self.timeline.states())
    }
}

/// What was found from one segment.
#[derive(Clone, Debug, PartialEq)]
pub struct SegmentOutput {
    /// One row a run of states with equal results.
    pub rows: Vec<SegmentRow>,
    /// What that depends on; none where something moves, or where units larger than triangles are looked
    /// for: what is hidden has a part in when a unit is settled.
    pub trace: Option<SegmentTrace>,
}

/// Solves segments, in order, but for what is known already. `None` when it was cancelled.
#[must_use]
pub fn solve_segments(
    work: &Work<'_>,
    segments: &[ViewSegment],
    known: impl Fn(&ViewSegment) -> Option<SegmentOutput> + Sync,
    cancel: &Cancel,
) -> Option<Vec<SegmentOutput>> {
    let solve = |segment: &ViewSegment| {
        let found = || known(segment).unwrap_or_else(|| solve_planned(work, segment));
        (!cancel.is_cancelled()).then(found)
    };
    segments.par_iter().map(solve).collect()
}

/// The rays of the first pass of a segment of the plan.
pub(crate) const fn planned_rows(config: &BakeConfig) -> u32 {
    config.solver.rows
}

/// Solves a segment of the plan.
#[must_use]
pub fn solve_planned(work: &Work<'_>, segment: &ViewSegment) -> SegmentOutput {
    let rows = planned_rows(work.config);
    solve_segment(work, segment, rows, work.states.clone(), planned_path(segment.id), None)
}

/// The rays of a segment's first pass. Segments differ in where the rays of their pixels are: neighbours
/// on one line would otherwise share their rows.
pub(crate) fn rays_of(segment: &ViewSegment, rows: u32) -> Sampling {
    Sampling::new(rows).jittered(segment.id.0)
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

/// The one place that calls the solver. Without refinement by rounds, there is none by rays. What is
/// `known` is so in each of `states`.
#[must_use]
pub(crate) fn solve_segment(
    work: &Work<'_>,
    segment: &ViewSegment,
    rows: u32,
    states: Range<u32>,
    path: TimePath,
    known: Option<&StateSets>,
) -> SegmentOutput {
    let Work { scene, config, units, .. } = *work;
    let sampling = rays_of(segment, rows);
    let options = SolveOptions {
        passes: if config.accuracy.rounds > 0 { PASSES } else { 0 },
        threshold: TILE_SHARE * config.accuracy.target_error,
        units: Some(units),
        ..SolveOptions::default()
    };
    let row = |states: Range<u32>, found: SegmentVisibility| SegmentRow {
        segment: segment.id,
        first_state: states.start,
        last_state: states.end - 1,
        set: found.set,
        weights: found.weights,
        rays: found.statistics.rays,
        skipped_movers: found.statistics.skipped,
    };
    if is_at_rest(&scene.geometry) {
        let options = SolveOptions { known: known.map(|sets| sets.at(states.start)), ..options };
        let mut found = solve_segment_with(&scene.geometry, segment, sampling, &options);
        let trace = work.is_traced().then(|| std::mem::take(&mut found.trace));
        return SegmentOutput { rows: vec![row(states, found)], trace };
    }
    let found = solve_states(&scene.geometry, segment, sampling, states, path, known, &options);
    let rows = found.into_iter().map(|found| row(found.states, found.visibility)).collect();
    SegmentOutput { rows, trace: None }
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
    /// What that depends on; none where its segments have none.
    pub trace: Option<CellTrace>,
}

/// Finishes cells, in order, but for those that are known already. `None` when it was cancelled. `segments` are those of the plan, by
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
    known: impl Fn(&PlannedCell) -> Option<CellOutput> + Sync,
    cancel: &Cancel,
) -> Option<Vec<CellOutput>> {
    cells
        .par_iter()
        .map(|planned| {
            if cancel.is_cancelled() {
                return None;
            }
            let finish = || {
                let solved: Vec<(&ViewSegment, &[SegmentRow])> = planned
                    .segments
                    .iter()
                    .map(|id| (&segments[id.index()], &rows[id][..]))
                    .collect();
                finish_cell(work, planned, &solved)
            };
            Some(known(planned).unwrap_or_else(finish))
        })
        .collect()
}
