//! What a task computes.
//!
//! Everything here is a pure function of the scene, the plan's entries, the configuration and the
//! rows of the segments: no store, no network, no clock. VI-3: the result does not depend on the
//! worker, its threads or the order of its tasks.

use std::collections::BTreeMap;

use rayon::prelude::*;
use sightline_geometry::{PrimitiveSet, Sampling, SegmentId, ViewSegment};
use sightline_jobs::{BakeConfig, PlannedCell};
use sightline_scene::Scene;
use sightline_solver::{SolveOptions, solve_segment_with};
use sightline_store::{CellRow, ObjectRow, SegmentRow};

use crate::cell::finish_cell;
pub use crate::pool::Cancel;

/// Solves segments, in order. `None` when it was cancelled.
#[must_use]
pub fn solve_segments(
    scene: &Scene,
    segments: &[ViewSegment],
    config: &BakeConfig,
    cancel: &Cancel,
) -> Option<Vec<SegmentRow>> {
    let sampling = Sampling::new(config.solver.rows);
    segments
        .par_iter()
        .map(|segment| {
            (!cancel.is_cancelled()).then(|| solve_segment(scene, segment, sampling, config, None))
        })
        .collect()
}

/// Passes of finer rays within a solve: the last has 16 times the rows of the first.
const PASSES: u32 = 4;

/// A tile is refined when more than this part of the target error may be missing in it.
const TILE_SHARE: f64 = 1.0 / 128.0;

/// The one place that calls the solver. Segments differ in where the rays of their pixels are:
/// neighbours on one line would otherwise share their rows. Without refinement by rounds, there is
/// none by rays.
#[must_use]
pub fn solve_segment(
    scene: &Scene,
    segment: &ViewSegment,
    sampling: Sampling,
    config: &BakeConfig,
    known: Option<&PrimitiveSet>,
) -> SegmentRow {
    let sampling = sampling.jittered(segment.id.0);
    let options = SolveOptions {
        passes: if config.accuracy.rounds > 0 { PASSES } else { 0 },
        threshold: TILE_SHARE * config.accuracy.target_error,
        known,
        ..SolveOptions::default()
    };
    let found = solve_segment_with(&scene.geometry, segment, sampling, &options);
    SegmentRow {
        segment: segment.id,
        set: found.set,
        weights: found.weights,
        rays: found.statistics.rays,
    }
}

/// The rows of the dataset for one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct CellOutput {
    /// The cell's row.
    pub cell: CellRow,
    /// One row an object of which a primitive is visible, ascending.
    pub objects: Vec<ObjectRow>,
}

/// Finishes cells, in order. `None` when it was cancelled. `segments` are those of the plan, by
/// number; `rows` holds at least the rows of the cells' segments.
///
/// # Panics
/// When a row is missing: the caller reads them all.
#[must_use]
pub fn solve_cells(
    scene: &Scene,
    cells: &[PlannedCell],
    segments: &[ViewSegment],
    rows: &BTreeMap<SegmentId, SegmentRow>,
    config: &BakeConfig,
    cancel: &Cancel,
) -> Option<Vec<CellOutput>> {
    cells
        .par_iter()
        .map(|planned| {
            let solved: Vec<(&ViewSegment, &SegmentRow)> =
                planned.segments.iter().map(|id| (&segments[id.index()], &rows[id])).collect();
            (!cancel.is_cancelled()).then(|| finish_cell(scene, config, planned, &solved))
        })
        .collect()
}
