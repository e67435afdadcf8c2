//! The end of a cell: joins what its segments see, and works on until the error is small enough.
//!
//! The set is the union of the sets of the cell's planned segments, which are solved at a low
//! resolution and shared with its neighbours, and of the triangles that reach into the cell: those
//! are visible from viewpoints close to them, whatever the perimeter sees. Then, in rounds:
//!
//! 1. *Measure.* Single rays from *held-out* viewpoints, random in the cell, that no segment was
//!    chosen for, until [`ErrorTest`] says that the mean error is below the target with 95 %
//!    confidence or that it is not. Every round takes fresh ones. The rays share no code with the
//!    solver.
//! 2. *Look closer.* The viewpoints of wrong rays are suspects; some are measured in full. The
//!    cell is done when the mean is below its target and no suspect is over the worst error.
//! 3. *Add work*, chosen by what is wrong. A suspect whose error is far above the mean stands in a
//!    pocket that no segment enters, such as the inside of a hut: a line through it is solved, and
//!    one across it if that was not enough. Suspects are found in proportion to their error, so
//!    when most of them are in no pocket, the error is spread thin: then another *run* along the
//!    perimeter is solved, with its rays elsewhere and at more rows, at the height of the cell
//!    where most goes wrong. Where a run did not help, lines through all suspects follow: what
//!    they see is hidden from the whole perimeter.
//!
//! Easy cells stop after the first measurement. docs/adr/0008 has the reasons.
//!
//! Everything is seeded by the cell's number and the round, so the row is a function of scene and
//! configuration alone.

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::{
    PrimitiveSet, Sampling, SegmentId, ViewCell, ViewSegment, overlap::primitives_in_cell,
};
use sightline_jobs::{BakeConfig, PlannedCell};
use sightline_quality::{
    ErrorTest, Members, SCATTERED_BATCH, Verdict, measure_scattered, measure_viewpoints,
};
use sightline_scene::Scene;
use sightline_store::{CellEffort, CellRow, SegmentRow};

use crate::solve::{CellOutput, solve_segment};
use crate::weights::{CellWeights, Seen, object_rows};

/// Base of the seeds of held-out viewpoints ("sightline" on a keypad); the round is added. Far
/// from the small seeds that people give to `verify`, which has to be independent.
const HELDOUT_SEED: u64 = 744_485_463_000_000;

/// Base of the seeds of suspects' rays.
const SUSPECT_SEED: u64 = HELDOUT_SEED + 1_000_000;

/// Suspects that are measured in a round: enough to tell pockets from an error that is spread thin.
const SUSPECTS_MAX: usize = 8;

/// Rays that measure a suspect: at the usual worst error of 0.2 %, four are wrong.
const SUSPECT_RAYS: u32 = 2048;

/// A suspect is in a pocket when its error is so many times the mean. An error that is spread
/// evenly has suspects of about the mean, a pocket in a fifth of the cell has five times as much.
const POCKET: f64 = 4.0;

/// Where the mean error is so many times the target, the next run has twice the rows of the finest
/// before it.
const FAR_OFF: f64 = 16.0;

/// Where it is so many times the target, half as many rows again; elsewhere a quarter. Most of what
/// a run gains comes from its rays being elsewhere, and its cost grows with the square of its rows.
const OFF: f64 = 4.0;

/// A run helped when it left at most this part of the mean error. One that meets what is spread
/// thin leaves a tenth.
const HELPED: f64 = 0.5;

/// Numbers of lines and runs of one cell, for their jitter.
const EXTRA_MAX: u32 = 1 << 10;

/// A segment that was solved for the cell alone.
struct Extra {
    segment: ViewSegment,
    row: SegmentRow,
}

/// What one measurement found.
struct Finding {
    test: ErrorTest,
    /// Viewpoints of wrong rays that were measured in full, and their errors.
    suspects: Vec<(DVec3, f64)>,
    /// Relative heights of the viewpoints of all wrong rays.
    heights: Vec<f64>,
}

impl Finding {
    fn worst(&self) -> f64 {
        self.suspects.iter().fold(0.0, |worst, (_, error)| error.max(worst))
    }
}

/// A cell's visible set while it grows.
struct Sight<'a> {
    scene: &'a Scene,
    config: &'a BakeConfig,
    cell: &'a ViewCell,
    set: PrimitiveSet,
    extra: Vec<Extra>,
    runs: u32,
    lines: u32,
    /// Rows of the finest run.
    rows: u32,
    /// Runs at the bottom, the middle and the top of the cell.
    runs_at: [u32; 3],
    /// The mean error before the last round's run, when it made one.
    before_run: Option<f64>,
    solver_rays: u64,
    heldout_rays: u64,
}

impl Sight<'_> {
    fn measure(&mut self, round: u32) -> Finding {
        let Self { scene, cell, config, .. } = *self;
        let geometry = &scene.geometry;
        let members = Members::new(&self.set, geometry.primitive_count());
        let seed = HELDOUT_SEED + u64::from(round);
        let mut test = ErrorTest::new(config.accuracy.target_error, round);
        let mut wrong = Vec::new();
        for batch in 0.. {
            let found = measure_scattered(geometry, &members, cell, batch, seed);
            test.add(u64::from(SCATTERED_BATCH), found.len() as u64);
            wrong.extend(found);
            if test.verdict() != Verdict::Open {
                break;
            }
        }
        let heights = wrong.iter().map(|&v| relative_height(cell, v)).collect();
        // They come in the order of directions: some of each batch and of each side.
        let some = wrong.len().min(SUSPECTS_MAX);
        let wrong: Vec<DVec3> = (0..some).map(|k| wrong[k * wrong.len() / some]).collect();
        let suspects = self.errors_at(&wrong, SUSPECT_SEED + u64::from(round));
        self.heldout_rays += test.rays();
        Finding { test, suspects: wrong.into_iter().zip(suspects).collect(), heights }
    }

    /// Errors at viewpoints, each measured in full.
    fn errors_at(&mut self, viewpoints: &[DVec3], seed: u64) -> Vec<f64> {
        self.heldout_rays += u64::from(SUSPECT_RAYS) * viewpoints.len() as u64;
        let (geometry, id) = (&self.scene.geometry, self.cell.id);
        let found =
            measure_viewpoints(geometry, &self.set, id, viewpoints, SUSPECT_RAYS, seed).viewpoints;
        found.iter().map(|v| v.error).collect()
    }

    fn is_good(&self, found: &Finding) -> bool {
        found.test.verdict() == Verdict::Met && found.worst() <= self.config.accuracy.worst_error
    }

    /// Adds the work that what was found asks for.
    fn refine(&mut self, found: &Finding, round: u32) {
        let accuracy = &self.config.accuracy;
        let mean = found.test.mean();
        let met = found.test.verdict() == Verdict::Met;
        let in_vain = self.before_run.take().is_some_and(|before| mean > HELPED * before);
        let bound = if met {
            accuracy.worst_error
        } else if in_vain {
            accuracy.target_error
        } else {
            accuracy.worst_error.max(POCKET * mean)
        };
        let mut pockets = found.suspects.clone();
        pockets.retain(|(_, error)| *error > bound);
        let thin = 2 * pockets.len() < found.suspects.len().max(1);
        pockets.sort_by(|a, b| b.1.total_cmp(&a.1));
        for (viewpoint, _) in pockets {
            self.look_from(viewpoint, bound, round);
        }
        if thin && !met {
            self.before_run = Some(mean);
            self.run(&found.heights, mean);
        }
    }

    /// Solves lines through a suspect while its error is over `bound`: along u, then along v. The
    /// lines of suspects before it may have been enough.
    fn look_from(&mut self, viewpoint: DVec3, bound: f64, round: u32) {
        for along_u in [true, false] {
            let seed = SUSPECT_SEED + u64::from(round);
            if self.errors_at(&[viewpoint], seed)[0] <= bound {
                return;
            }
            let line = line_through(self.cell, viewpoint, along_u);
            self.lines += 1;
            self.solve(&[line]);
        }
    }

    /// Solves another run along the perimeter, at the height where most of `wrong` are.
    fn run(&mut self, wrong: &[f64], mean: f64) {
        let limit = Sampling::new(self.config.solver.rows_max).rows();
        let more = more_rows(self.rows, mean / self.config.accuracy.target_error);
        self.rows = Sampling::new(more).rows().min(limit);
        let level = next_level(wrong, self.runs_at);
        self.runs_at[level] += 1;
        self.runs += 1;
        let segments = run_segments(self.cell, level);
        self.solve(&segments);
    }

    /// Solves segments of the cell alone, at the rows of the finest run, and finer where they see what
    /// is not known yet.
    fn solve(&mut self, segments: &[ViewSegment]) {
        let sampling = Sampling::new(self.rows);
        let first = self.extra.len() as u32;
        let numbered: Vec<ViewSegment> = (first..)
            .zip(segments)
            .map(|(number, segment)| ViewSegment { id: extra_id(self.cell, number), ..*segment })
            .filter(|segment| segment.v0 != segment.v1)
            .collect();
        let seen: Vec<Extra> = numbered
            .into_par_iter()
            .map(|segment| {
                let known = Some(&self.set);
                let row = solve_segment(self.scene, &segment, sampling, self.config, known);
                Extra { row, segment }
            })
            .collect();
        self.solver_rays += seen.iter().map(|e| e.row.rays).sum::<u64>();
        self.set = PrimitiveSet::union(seen.iter().map(|e| &e.row.set).chain([&self.set]));
        self.extra.extend(seen);
    }
}

/// The rows of a finished cell. `solved` are its planned segments and what they see.
///
/// Runs on the current rayon pool.
#[must_use]
pub fn finish_cell(
    scene: &Scene,
    config: &BakeConfig,
    planned: &PlannedCell,
    solved: &[(&ViewSegment, &SegmentRow)],
) -> CellOutput {
    let (cell, accuracy) = (&planned.cell, &config.accuracy);
    let inside = primitives_in_cell(&scene.geometry, cell);
    let sampling = Sampling::new(config.solver.rows);
    let mut sight = Sight {
        scene,
        config,
        cell,
        set: PrimitiveSet::union(solved.iter().map(|(_, row)| &row.set).chain([&inside])),
        extra: Vec::new(),
        runs: 1,
        lines: 0,
        rows: sampling.rows(),
        runs_at: planned_levels(config.solver.rings),
        before_run: None,
        solver_rays: solved.iter().map(|(_, row)| row.rays).sum(),
        heldout_rays: 0,
    };
    let mut round = 0;
    let (found, target_met) = loop {
        let found = sight.measure(round);
        let good = sight.is_good(&found);
        if good || round >= accuracy.rounds {
            break (found, good);
        }
        sight.refine(&found, round);
        round += 1;
    };
    let seen: Vec<Seen<'_>> = solved
        .iter()
        .copied()
        .chain(sight.extra.iter().map(|e| (&e.segment, &e.row)))
        .map(|(segment, row)| Seen { row, length: (segment.v1 - segment.v0).length() })
        .collect();
    let weights = CellWeights::new(&sight.set, &seen);
    let effort = CellEffort {
        segments: seen.len() as u32,
        runs: sight.runs,
        lines: sight.lines,
        rows: sight.rows,
        solver_rays: sight.solver_rays,
        refinements: round,
        heldout_viewpoints: u32::try_from(found.test.rays()).unwrap_or(u32::MAX),
        heldout_rays: sight.heldout_rays,
        heldout_error_mean: found.test.mean(),
        heldout_error_upper: found.test.upper_bound(),
        heldout_error_max: found.worst(),
        target_met,
    };
    let objects = object_rows(scene, cell.id, &sight.set, &weights);
    let (set, weights) = (sight.set, weights.codes());
    let cell = CellRow { cell: cell.clone(), tile: planned.tile, set, weights, effort };
    CellOutput { objects, cell }
}

/// Rows of the next run, behind one of `rows` rows that left so many times the target.
fn more_rows(rows: u32, times_target: f64) -> u32 {
    if times_target > FAR_OFF {
        2 * rows
    } else if times_target > OFF {
        rows + rows / 2
    } else {
        rows + rows / 4
    }
}

/// Segments of one cell alone have no number in the plan. Theirs count down from the last, a stretch
/// a cell, so that each has a jitter of its own.
fn extra_id(cell: &ViewCell, number: u32) -> SegmentId {
    SegmentId(u32::MAX.wrapping_sub(cell.id.0.wrapping_mul(EXTRA_MAX)).wrapping_sub(number))
}

/// Levels of a cell at which runs are solved: bottom, middle, top.
const LEVELS: [f64; 3] = [0.0, 0.5, 1.0];

/// The levels that the plan's rings take: one ring runs through the middle.
fn planned_levels(rings: u32) -> [u32; 3] {
    match rings {
        1 => [0, 1, 0],
        rings => [1, rings - 2, 1],
    }
}

/// The level at which to solve next: where most wrong viewpoints are for each run that was solved
/// there; the middle when all are equal. A quarter of a cell's height belongs to its bottom and
/// another to its top.
fn next_level(wrong: &[f64], runs_at: [u32; 3]) -> usize {
    let near = |level: f64| wrong.iter().filter(|h| (*h - level).abs() <= 0.25).count() as u32;
    // Bottom and top are near to half as much of the cell as the middle is.
    let votes = [2 * near(LEVELS[0]), near(LEVELS[1]), 2 * near(LEVELS[2])];
    // a / (1 + r) > b / (1 + s) without division.
    let better = |a: usize, b: usize| votes[a] * (1 + runs_at[b]) > votes[b] * (1 + runs_at[a]);
    [0, 2].into_iter().fold(1, |best, level| if better(level, best) { level } else { best })
}

/// Height of a viewpoint in its cell: 0 at the bottom, 1 at the top, the middle in a flat cell.
fn relative_height(cell: &ViewCell, viewpoint: DVec3) -> f64 {
    if cell.height > 0.0 {
        ((viewpoint.y - cell.floor_below(viewpoint)) / cell.height).clamp(0.0, 1.0)
    } else {
        0.5
    }
}

/// A run along the perimeter of a cell; with its vertical edges where the cell is tall.
fn run_segments(cell: &ViewCell, level: usize) -> Vec<ViewSegment> {
    let corner = |k: usize, h: f64| cell.corners[k % 4] + DVec3::Y * (h * cell.height);
    let segment = |v0, v1| ViewSegment { id: SegmentId(0), v0, v1 };
    let mut segments: Vec<ViewSegment> =
        (0..4).map(|k| segment(corner(k, LEVELS[level]), corner(k + 1, LEVELS[level]))).collect();
    // A cell that is half as tall as it is wide sees much along its edges that no ring sees.
    let size = cell.bounds().size();
    if 2.0 * cell.height >= size.x.min(size.z) {
        segments.extend((0..4).map(|k| segment(corner(k, 0.0), corner(k, 1.0))));
    }
    segments
}

/// The line of constant v (`along_u`) or of constant u through a point of the cell, across the whole
/// footprint at the point's relative height; on the bilinear surface of a cell it is straight.
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
    ViewSegment { id: SegmentId(0), v0, v1 }
}

#[cfg(test)]
mod tests {
    use sightline_geometry::CellId;

    use super::*;

    fn cell() -> ViewCell {
        let corners = [[0.0, 1.0, 0.0], [4.0, 2.0, 0.0], [4.0, 2.5, 4.0], [0.0, 0.5, 4.0]];
        ViewCell { id: CellId(3), corners: corners.map(DVec3::from), height: 0.4 }
    }

    #[test]
    fn lines_pass_through_their_viewpoint_and_end_on_the_perimeter() {
        let cell = cell();
        let point = cell.viewpoint(0.25, 0.5, 0.75);
        assert!((relative_height(&cell, point) - 0.75).abs() < 1e-12);
        for along_u in [true, false] {
            let line = line_through(&cell, point, along_u);
            let t = if along_u { 0.25 } else { 0.5 };
            assert!((line.v0.lerp(line.v1, t) - point).length() < 1e-12);
        }
    }

    #[test]
    fn the_next_run_is_where_most_goes_wrong() {
        assert_eq!(next_level(&[0.5, 0.4, 0.6, 0.1], [0, 0, 0]), 1);
        assert_eq!(next_level(&[0.95, 0.9, 0.5, 0.1], [0, 1, 0]), 2);
        assert_eq!(next_level(&[0.1, 0.05, 0.0, 0.9], [0, 1, 0]), 0);
        assert_eq!(next_level(&[0.1, 0.05, 0.0, 0.9], [9, 1, 0]), 2, "the bottom was solved often");
        assert_eq!(next_level(&[0.5; 9], [0, 3, 0]), 1, "a flat cell has its middle only");
        assert_eq!(next_level(&[], [1, 1, 1]), 1);
    }

    #[test]
    fn rows_grow_faster_the_farther_the_target_is() {
        let rows = [1.0, 5.0, 20.0].map(|times_target| more_rows(80, times_target));
        assert_eq!(rows, [100, 120, 160]);
    }

    #[test]
    fn a_run_goes_round_and_takes_the_vertical_edges_of_a_tall_cell() {
        let mut cell = cell();
        let ring = run_segments(&cell, 2);
        assert_eq!(ring.len(), 4);
        for k in 0..4 {
            assert_eq!(ring[k].v1, ring[(k + 1) % 4].v0);
            assert_eq!(ring[k].v0, cell.corners[k] + DVec3::Y * 0.4);
        }
        cell.height = 2.0;
        assert_eq!(run_segments(&cell, 0).len(), 8);
    }

    #[test]
    fn segments_of_a_cell_alone_have_numbers_of_their_own() {
        let mut other = cell();
        other.id = CellId(4);
        let ids = [extra_id(&cell(), 0), extra_id(&cell(), 1), extra_id(&other, 0)];
        assert!(ids[0] != ids[1] && ids[1] != ids[2] && ids[0] != ids[2]);
    }
}
