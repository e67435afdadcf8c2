//! The end of a cell: joins what its segments see, and works on until the error is small enough.
//!
//! The set is the union of the sets of the cell's planned segments, which are solved at a low
//! resolution and shared with its neighbours, and of the triangles that reach into the cell: those
//! are visible from viewpoints close to them, whatever the perimeter sees. All sets are of whole units
//! of the configured granularity. Then, in rounds:
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
//! Where something moves, all of this is done at once for the states of the task, with a set a state.
//! Rays are cast at random moments. What is added is solved in the states from the first to the last in
//! which a ray was wrong: what is missing beside them has not been seen, but it is most likely the same.
//! Camera and time are coupled otherwise than before: the first run reverses what the plan has on each
//! edge; those that follow stop the clock at 1/2, then at 1/4 and 3/4, and so on, of the stops of one
//! spacing first at the one that most wrong rays are near to. Lines stop it when their suspect was wrong,
//! so that they see what it should have seen.
//!
//! Everything is seeded by the cell's number, the first state and the round, so the rows are a function
//! of scene, configuration and the states that are taken together.

use std::ops::Range;

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::{
    PrimitiveId, PrimitiveSet, Sampling, SegmentId, StateSets, ViewCell, ViewSegment,
    overlap::primitives_in_cell_over,
};
use sightline_jobs::PlannedCell;
use sightline_quality::{
    ErrorTest, SCATTERED_BATCH, StateMembers, Suspect, Verdict, measure_scattered_over,
    measure_viewpoints_at,
};
use sightline_solver::TimePath;
use sightline_store::{CellEffort, CellRow, SegmentRow};

use crate::join::join_cell;
use crate::solve::{CellOutput, Work, planned_path, sets_of, solve_segment};
use crate::trace::{CellTrace, ExtraTrace};
use crate::weights::{CellWeights, Seen, object_rows};

/// Base of the seeds of held-out viewpoints ("sightline" on a keypad); the round is added. Far
/// from the small seeds that people give to `verify`, which has to be independent.
const HELDOUT_SEED: u64 = 744_485_463_000_000;

/// Base of the seeds of suspects' rays.
const SUSPECT_SEED: u64 = HELDOUT_SEED + 1_000_000;

/// Seeds of a range of states start so far apart, times its first state.
const STATE_SEEDS: u64 = 10_000_000;

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
    /// By runs of the states in which it was solved.
    rows: Vec<SegmentRow>,
    trace: Option<ExtraTrace>,
}

/// What one measurement found.
struct Finding {
    test: ErrorTest,
    /// Viewpoints and moments of wrong rays that were measured in full, and their errors.
    suspects: Vec<(Suspect, f64)>,
    /// Relative heights of the viewpoints of all wrong rays.
    heights: Vec<f64>,
    /// When they were wrong: t of their states.
    times: Vec<f64>,
    /// From the first to the last state in which a ray was wrong; all where none was.
    states: Range<u32>,
}

impl Finding {
    fn worst(&self) -> f64 {
        self.suspects.iter().fold(0.0, |worst, (_, error)| error.max(worst))
    }
}

/// A cell's visible sets while they grow.
struct Sight<'a> {
    work: &'a Work<'a>,
    planned: &'a PlannedCell,
    cell: &'a ViewCell,
    sets: StateSets,
    extra: Vec<Extra>,
    runs: u32,
    lines: u32,
    /// Rows of the finest run.
    rows: u32,
    /// Runs at the bottom, the middle and the top of the cell.
    runs_at: [u32; 3],
    /// Where the clock was stopped for runs.
    stops: Vec<f64>,
    /// The mean error before the last round's run, when it made one.
    before_run: Option<f64>,
    /// Rays of the solver, and movers that it skipped.
    solver_rays: u64,
    skipped_movers: u64,
    heldout_rays: u64,
    /// What was measured so far.
    asked: CellTrace,
    /// What the set lacked of what rays met.
    missed: Vec<PrimitiveId>,
}

impl Sight<'_> {
    fn seed(&self, base: u64, round: u32) -> u64 {
        base + u64::from(round) + STATE_SEEDS * u64::from(self.work.states.start)
    }

    fn measure(&mut self, round: u32) -> Finding {
        let Self { work, cell, .. } = *self;
        let Work { scene, timeline, config, .. } = work;
        let geometry = &scene.geometry;
        let members = StateMembers::new(&self.sets, geometry.primitive_count());
        let seed = self.seed(HELDOUT_SEED, round);
        let mut test = ErrorTest::new(config.accuracy.target_error, round);
        let mut wrong: Vec<Suspect> = Vec::new();
        let (mut missing, mut batches) = (Vec::new(), 0);
        for batch in 0.. {
            let found = measure_scattered_over(geometry, &members, timeline, cell, batch, seed);
            test.add(u64::from(SCATTERED_BATCH), found.wrong.len() as u64);
            wrong.extend(found.wrong);
            missing.extend(found.missing);
            batches += 1;
            if test.verdict() != Verdict::Open {
                break;
            }
        }
        self.asked.batches.push((seed, batches));
        self.missed.append(&mut missing);
        let heights = wrong.iter().map(|w| relative_height(cell, w.viewpoint)).collect();
        let times = wrong.iter().map(|w| w.moment.t).collect();
        let states = || wrong.iter().map(|w| w.moment.state);
        let states = match (states().min(), states().max()) {
            (Some(first), Some(last)) => first..last + 1,
            _ => work.states.clone(),
        };
        // They come in the order of directions: some of each batch and of each side.
        let some = wrong.len().min(SUSPECTS_MAX);
        let wrong: Vec<Suspect> = (0..some).map(|k| wrong[k * wrong.len() / some]).collect();
        let suspects = self.errors_at(&wrong, self.seed(SUSPECT_SEED, round));
        self.heldout_rays += test.rays();
        Finding {
            test,
            suspects: wrong.into_iter().zip(suspects).collect(),
            heights,
            times,
            states,
        }
    }

    /// Errors at viewpoints and moments, each measured in full.
    fn errors_at(&mut self, at: &[Suspect], seed: u64) -> Vec<f64> {
        self.heldout_rays += u64::from(SUSPECT_RAYS) * at.len() as u64;
        let (geometry, id) = (&self.work.scene.geometry, self.cell.id);
        let found = measure_viewpoints_at(geometry, &self.sets, id, at, SUSPECT_RAYS, seed);
        let asked = found.viewpoints.iter().map(|v| (v.viewpoint, v.seed, v.rays));
        self.asked.viewpoints.extend(asked);
        self.missed.extend(found.missing);
        found.viewpoints.iter().map(|v| v.error).collect()
    }

    fn is_good(&self, found: &Finding) -> bool {
        found.test.verdict() == Verdict::Met
            && found.worst() <= self.work.config.accuracy.worst_error
    }

    /// Adds the work that what was found asks for.
    fn refine(&mut self, found: &Finding, round: u32) {
        let accuracy = &self.work.config.accuracy;
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
        for (suspect, _) in pockets {
            self.look_from(suspect, bound, round, &found.states);
        }
        if thin && !met {
            self.before_run = Some(mean);
            self.run(found, mean);
        }
    }

    /// Solves lines through a suspect while its error is over `bound`: along u, then along v. The
    /// lines of suspects before it may have been enough.
    fn look_from(&mut self, suspect: Suspect, bound: f64, round: u32, states: &Range<u32>) {
        for along_u in [true, false] {
            let seed = self.seed(SUSPECT_SEED, round);
            if self.errors_at(&[suspect], seed)[0] <= bound {
                return;
            }
            let line = line_through(self.cell, suspect.viewpoint, along_u);
            self.lines += 1;
            self.solve(&[(line, TimePath::stopped(suspect.moment.t))], states);
        }
    }

    /// Solves another run along the perimeter, at the height where most wrong rays are.
    fn run(&mut self, found: &Finding, mean: f64) {
        let config = self.work.config;
        let limit = Sampling::new(config.solver.rows_max).rows();
        let more = more_rows(self.rows, mean / config.accuracy.target_error);
        self.rows = Sampling::new(more).rows().min(limit);
        let level = next_level(&found.heights, self.runs_at);
        self.runs_at[level] += 1;
        let segments = run_segments(self.cell, level);
        let paths = if self.runs == 1 {
            reversed_paths(&segments, &self.planned.segments)
        } else {
            let stop = next_stop(&mut self.stops, &found.times);
            vec![TimePath::stopped(stop); segments.len()]
        };
        self.runs += 1;
        let coupled: Vec<(ViewSegment, TimePath)> = segments.into_iter().zip(paths).collect();
        self.solve(&coupled, &found.states);
    }

    /// Solves segments of the cell alone in some states, at the rows of the finest run, and finer where
    /// they see what is not known yet.
    fn solve(&mut self, segments: &[(ViewSegment, TimePath)], states: &Range<u32>) {
        let first = self.extra.len() as u32;
        let numbered: Vec<(ViewSegment, TimePath)> = (first..)
            .zip(segments)
            .map(|(number, (segment, path))| {
                (ViewSegment { id: extra_id(self.cell, number), ..*segment }, *path)
            })
            .filter(|(segment, _)| segment.v0 != segment.v1)
            .collect();
        let known = self.sets.within(states.clone());
        let seen: Vec<Extra> = numbered
            .into_par_iter()
            .map(|(segment, path)| {
                let (states, known) = (states.clone(), Some(&known));
                let found = solve_segment(self.work, &segment, self.rows, states, path, known);
                let trace = found.trace.map(|trace| ExtraTrace { segment, rows: self.rows, trace });
                Extra { rows: found.rows, segment, trace }
            })
            .collect();
        for row in seen.iter().flat_map(|e| &e.rows) {
            self.solver_rays += row.rays;
            self.skipped_movers += row.skipped_movers;
        }
        let whole = self.sets.states();
        let mut all: Vec<StateSets> =
            seen.iter().map(|e| sets_of(&e.rows).padded(whole.clone())).collect();
        all.push(std::mem::replace(&mut self.sets, known));
        self.sets = StateSets::join(&all);
        self.extra.extend(seen);
    }
}

/// What a cell sees in the states of a task. `solved` are its planned segments and what they see in
/// each of them.
///
/// Runs on the current rayon pool.
#[must_use]
pub fn finish_cell(
    work: &Work<'_>,
    planned: &PlannedCell,
    solved: &[(&ViewSegment, &[SegmentRow])],
) -> CellOutput {
    let Work { scene, timeline, config, units, states } = work;
    let (cell, accuracy) = (&planned.cell, &config.accuracy);
    let mut seen: Vec<StateSets> = solved.iter().map(|(_, rows)| sets_of(rows)).collect();
    let inside = primitives_in_cell_over(&scene.geometry, cell, states.clone());
    seen.push(inside.map(|set| units.around(&scene.geometry, set)));
    let sampling = Sampling::new(config.solver.rows);
    let mut sight = Sight {
        work,
        planned,
        cell,
        sets: StateSets::join(&seen),
        extra: Vec::new(),
        runs: 1,
        lines: 0,
        rows: sampling.rows(),
        runs_at: planned_levels(config.solver.rings),
        stops: Vec::new(),
        before_run: None,
        solver_rays: solved.iter().flat_map(|(_, rows)| *rows).map(|row| row.rays).sum(),
        skipped_movers: solved
            .iter()
            .flat_map(|(_, rows)| *rows)
            .map(|row| row.skipped_movers)
            .sum(),
        heldout_rays: 0,
        asked: CellTrace::default(),
        missed: Vec::new(),
    };
    drop(seen);
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
        .chain(sight.extra.iter().map(|e| (&e.segment, &e.rows[..])))
        .map(|(segment, rows)| Seen { rows, length: (segment.v1 - segment.v0).length() })
        .collect();
    let trace = work.is_traced().then(|| {
        let mut missed: Vec<u32> = sight.missed.iter().map(|primitive| primitive.0).collect();
        missed.sort_unstable();
        CellTrace {
            extra: sight.extra.iter().filter_map(|extra| extra.trace.clone()).collect(),
            missing: PrimitiveSet::from_sorted(missed),
            ..sight.asked
        }
    });
    let effort = CellEffort {
        segments: seen.len() as u32,
        runs: sight.runs,
        lines: sight.lines,
        rows: sight.rows,
        solver_rays: sight.solver_rays,
        skipped_movers: sight.skipped_movers,
        refinements: round,
        heldout_viewpoints: u32::try_from(found.test.rays()).unwrap_or(u32::MAX),
        heldout_rays: sight.heldout_rays,
        heldout_error_mean: found.test.mean(),
        heldout_error_upper: found.test.upper_bound(),
        heldout_error_max: found.worst(),
        target_met,
    };
    let mut rows: Vec<(CellRow, CellWeights)> = sight
        .sets
        .runs()
        .iter()
        .map(|(states, set)| {
            let weights = CellWeights::new(set, &seen, states, timeline);
            let row = CellRow {
                cell: cell.clone(),
                tile: planned.tile,
                first_state: states.start,
                last_state: states.end - 1,
                set: set.clone(),
                weights: weights.codes(),
                effort,
            };
            (row, weights)
        })
        .collect();
    if !work.takes_all_states() {
        let mut rows: Vec<CellRow> = rows.into_iter().map(|(row, _)| row).collect();
        rows.sort_by_key(CellRow::order);
        return CellOutput { rows, objects: Vec::new(), trace };
    }
    if rows.len() > 1 {
        let runs: Vec<CellRow> = rows.into_iter().map(|(row, _)| row).collect();
        return join_cell(scene, timeline, &[&runs]);
    }
    let (row, weights) = rows.remove(0);
    let objects = object_rows(scene, &row, &weights, std::slice::from_ref(&row));
    CellOutput { objects, rows: vec![row], trace }
}

/// The same coupling, seen from the other end of a segment; and the other coupling from the same end.
const fn reversed(path: TimePath) -> TimePath {
    TimePath { t0: path.t1, t1: path.t0 }
}

/// For segments of a run, camera and time coupled the other way round than the plan has it on the same
/// edge of the cell.
fn reversed_paths(run: &[ViewSegment], planned: &[SegmentId]) -> Vec<TimePath> {
    let path = |(k, segment): (usize, &ViewSegment)| {
        // The plan's segments start with a ring; its vertical edges, if any, are behind all rings.
        let own = planned.get(k).map_or(TimePath::FORWARD, |id| planned_path(*id));
        // A planned segment starts at its lower end; a run goes round.
        let same_way = segment.v0.to_array() < segment.v1.to_array();
        if same_way { reversed(own) } else { own }
    };
    run.iter().enumerate().map(path).collect()
}

/// Where to stop the clock next: the stops 1/2; 1/4, 3/4; 1/8, 3/8, ... are taken in this order, and of
/// those of one spacing first the one that most of `wrong` are near to.
fn next_stop(stops: &mut Vec<f64>, wrong: &[f64]) -> f64 {
    let level = (stops.len() as u32 + 1).ilog2();
    let spacing = 1.0 / f64::from(1u32 << level);
    let near = |stop: f64| wrong.iter().filter(|t| (*t - stop).abs() <= spacing / 2.0).count();
    let free = (0..1u32 << level)
        .map(|k| (f64::from(k) + 0.5) * spacing)
        .filter(|stop| !stops.contains(stop))
        // The first of equally good ones.
        .reduce(|best, stop| if near(stop) > near(best) { stop } else { best });
    let stop = free.expect("a level has more stops than were taken of it");
    stops.push(stop);
    stop
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
    fn the_clock_stops_where_most_goes_wrong() {
        let mut stops = Vec::new();
        let wrong = [0.9, 0.8, 0.1];
        let taken: Vec<f64> = (0..7).map(|_| next_stop(&mut stops, &wrong)).collect();
        assert_eq!(taken, [0.5, 0.75, 0.25, 0.875, 0.125, 0.375, 0.625]);
    }

    #[test]
    fn the_first_run_turns_the_plan_round() {
        let run = run_segments(&cell(), 1);
        let paths = reversed_paths(&run, &[0, 1, 2, 5].map(SegmentId));
        // The third edge runs against its planned segment.
        let (with, against) = (TimePath::FORWARD, TimePath::REVERSED);
        assert_eq!(paths, [against, with, with, with]);
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
