//! From what was found in ranges of states to the rows of the dataset.
//!
//! A cell is finished range by range of states, and in each there is a row a run of states with equal
//! sets. Runs that meet with equal sets where two ranges do become one. A cell with several runs gets a
//! row of their union.
//!
//! Weights are means over time. They are made from the weights of the runs as those are stored, so that
//! they are the same whether runs come from one task or from parts; a member that a run does not see
//! counts as 0 there. The weight of an object is the sum of those of its primitives in the union.
//!
//! What it took is told by ranges: counts of the ranges that a row lies in are added up, a mean error is
//! the mean over their time, and bounds are those of the worst range.

use std::ops::Range;

use sightline_geometry::{PrimitiveSet, Timeline};
use sightline_scene::Scene;
use sightline_store::{CellEffort, CellRow, Weight};

use crate::solve::CellOutput;
use crate::weights::{CellWeights, object_rows};

/// The rows of the dataset for cells, in order. `ranges` has, for each range of states in their order,
/// the rows of all cells: the same cells in the same order, and of each cell one a run of states.
///
/// # Panics
/// When a range has other cells than another, or the runs of a cell do not take each state once: the
/// caller checks what it reads.
#[must_use]
pub fn join_cells(scene: &Scene, timeline: &Timeline, ranges: &[Vec<CellRow>]) -> Vec<CellOutput> {
    let by_cell: Vec<Vec<&[CellRow]>> =
        ranges.iter().map(|rows| rows.chunk_by(|a, b| a.cell.id == b.cell.id).collect()).collect();
    (0..by_cell.first().map_or(0, Vec::len))
        .map(|k| {
            let of_cell: Vec<&[CellRow]> = by_cell.iter().map(|cells| cells[k]).collect();
            join_cell(scene, timeline, &of_cell)
        })
        .collect()
}

/// The rows of the dataset for one cell, from those of its runs in each range of states.
pub(crate) fn join_cell(scene: &Scene, timeline: &Timeline, ranges: &[&[CellRow]]) -> CellOutput {
    let ranges: Vec<Stretch<'_>> = ranges.iter().map(|rows| Stretch::new(rows)).collect();
    let found: Vec<&CellRow> = ranges.iter().flat_map(|range| range.runs.iter().copied()).collect();
    let meet = found.windows(2).all(|pair| pair[0].states().end == pair[1].first_state);
    let whole = found[0].first_state..found[found.len() - 1].last_state + 1;
    assert!(meet && whole == (0..timeline.states()), "the runs take each state once");
    let id = found[0].cell.id;
    assert!(found.iter().all(|row| row.cell.id == id), "the ranges have the same cells");

    let mut joined: Vec<(CellRow, CellWeights)> = found
        .chunk_by(|a, b| a.set == b.set)
        .map(|same| mean_row(timeline, same, &ranges))
        .collect();
    let runs: Vec<CellRow> = joined.iter().map(|(row, _)| row.clone()).collect();
    let (union, weights) =
        if joined.len() > 1 { mean_row(timeline, &found, &ranges) } else { joined.remove(0) };
    let objects = object_rows(scene, &union, &weights, &runs);
    let mut rows = vec![union];
    if runs.len() > 1 {
        rows.extend(runs);
        rows.sort_by_key(CellRow::order);
    }
    CellOutput { rows, objects, trace: None }
}

/// What a cell's rows in one range of states say together.
struct Stretch<'a> {
    states: Range<u32>,
    effort: CellEffort,
    /// By time.
    runs: Vec<&'a CellRow>,
}

impl<'a> Stretch<'a> {
    fn new(rows: &'a [CellRow]) -> Self {
        let mut runs: Vec<&CellRow> = rows.iter().collect();
        runs.sort_by_key(|row| row.first_state);
        let states = runs[0].first_state..runs[runs.len() - 1].last_state + 1;
        // All rows of a range say what the range took.
        Self { states, effort: runs[0].effort, runs }
    }
}

/// One row for rows that follow each other in time, of all that they see.
fn mean_row(
    timeline: &Timeline,
    rows: &[&CellRow],
    ranges: &[Stretch<'_>],
) -> (CellRow, CellWeights) {
    let states = rows[0].first_state..rows[rows.len() - 1].last_state + 1;
    let share = |row: &CellRow| timeline.share_of(&row.states(), &states);
    let set = PrimitiveSet::union(rows.iter().map(|row| &row.set));
    let weights = CellWeights::mean(&set, rows.iter().map(|row| (*row, share(row))));
    let touched = ranges
        .iter()
        .filter(|range| range.states.start < states.end && states.start < range.states.end);
    let row = CellRow {
        first_state: states.start,
        last_state: states.end - 1,
        set,
        // A row that stands alone keeps its codes.
        weights: if let [row] = rows { row.weights.clone() } else { weights.codes() },
        effort: effort_of(timeline, touched),
        ..rows[0].clone()
    };
    (row, weights)
}

/// What ranges that follow each other took together.
fn effort_of<'a>(timeline: &Timeline, ranges: impl Iterator<Item = &'a Stretch<'a>>) -> CellEffort {
    let ranges: Vec<&Stretch<'_>> = ranges.collect();
    if let [range] = ranges[..] {
        return range.effort;
    }
    let whole = ranges[0].states.start..ranges[ranges.len() - 1].states.end;
    let nothing =
        CellEffort { heldout_error_upper: 0.0, target_met: true, ..CellEffort::default() };
    ranges.iter().fold(nothing, |sum, range| {
        let one = &range.effort;
        let share = timeline.share_of(&range.states, &whole);
        CellEffort {
            segments: sum.segments + one.segments,
            runs: sum.runs + one.runs,
            lines: sum.lines + one.lines,
            rows: sum.rows.max(one.rows),
            solver_rays: sum.solver_rays + one.solver_rays,
            skipped_movers: sum.skipped_movers + one.skipped_movers,
            refinements: sum.refinements + one.refinements,
            heldout_viewpoints: sum.heldout_viewpoints.saturating_add(one.heldout_viewpoints),
            heldout_rays: sum.heldout_rays + one.heldout_rays,
            heldout_error_mean: sum.heldout_error_mean + share * one.heldout_error_mean,
            heldout_error_upper: sum.heldout_error_upper.max(one.heldout_error_upper),
            heldout_error_max: sum.heldout_error_max.max(one.heldout_error_max),
            target_met: sum.target_met && one.target_met,
        }
    })
}

impl CellWeights {
    /// The weights of `set` as the mean of rows, each with its share of the time. The set holds those of
    /// the rows.
    fn mean<'a>(set: &PrimitiveSet, rows: impl Iterator<Item = (&'a CellRow, f64)>) -> Self {
        let mut weights = Self::unmeasured(set);
        for (row, share) in rows {
            weights.add(set, &row.set, row.weights.iter().copied().map(Weight::share), share);
        }
        weights
    }
}
