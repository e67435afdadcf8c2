//! The end of a cell: joins what its segments see, and refines until the error is small.
//!
//! 1. The set is the union of the sets of the cell's segments, and of the triangles that reach
//!    into the cell: those are visible from viewpoints close to them, whatever the perimeter sees.
//! 2. Where geometry reaches into the cell it may be cut into pockets that no segment of the
//!    perimeter enters: the inside of furniture, or of a hut. Many *scouts*, random viewpoints
//!    with few rays each, look for them; one wrong ray makes a scout a suspect.
//! 3. The error of the set is measured with rays from *held-out* viewpoints, random in the cell,
//!    that no segment was chosen for. Rays are cast over the hierarchy: the measurement shares no
//!    code with the solver. Where the worst error is over its target, or the mean is not below it
//!    with 95 % confidence, and rounds are left, these viewpoints are suspects, and the set is
//!    measured again at fresh ones.
//! 4. Suspects are dealt with one by one: where the error is confirmed, a line of the cell through
//!    the viewpoint is solved, then one across it if that was not enough. A line runs across the
//!    whole footprint at the viewpoint's relative height; on the bilinear surface of a cell it is
//!    straight.
//!
//! Everything is seeded by the cell's number and the round, so the row is a function of scene and
//! configuration alone.

use glam::DVec3;
use sightline_geometry::{
    PrimitiveSet, Sampling, SegmentId, ViewCell, ViewSegment, overlap::primitives_in_cell,
};
use sightline_jobs::{BakeConfig, PlannedCell};
use sightline_quality::{CellError, measure_viewpoints, random_viewpoints};
use sightline_scene::Scene;
use sightline_store::{CellEffort, CellRow, SegmentRow};

use crate::solve::{CellOutput, solve_segment};
use crate::weights::{CellWeights, Seen, object_rows};

/// Lines that are solved at most for one list of suspects: a cell of furniture has a handful of
/// pockets, and a cell of leaves would never end.
const LINES_MAX: usize = 12;

/// Base of the seeds of held-out viewpoints ("sightline" on a keypad); the round is added. Far
/// from the small seeds that people give to `verify`, which has to be independent.
const HELDOUT_SEED: u64 = 744_485_463_000_000;

/// Seed of the scouts, away from those of the rounds.
const SCOUT_SEED: u64 = HELDOUT_SEED + 1_000_000;

/// A suspect is measured with this part of the rays of a held-out viewpoint: enough to tell a
/// pocket, where whole surfaces are missing.
const SUSPECT_SHARE: u32 = 2;

/// Seed of the measurements of suspects.
const SUSPECT_SEED: u64 = HELDOUT_SEED + 2_000_000;

/// A cell's visible set while it grows.
struct Sight<'a> {
    scene: &'a Scene,
    config: &'a BakeConfig,
    cell: &'a ViewCell,
    set: PrimitiveSet,
    /// What was solved beyond the planned segments.
    lines: Vec<(ViewSegment, SegmentRow)>,
    /// Rays cast from held-out viewpoints and scouts.
    rays: u64,
}

impl Sight<'_> {
    fn measure(&mut self, viewpoints: &[DVec3], rays: u32, seed: u64) -> CellError {
        self.rays += u64::from(rays) * viewpoints.len() as u64;
        let geometry = &self.scene.geometry;
        measure_viewpoints(geometry, &self.set, self.cell.id, viewpoints, rays, seed)
    }

    /// Viewpoints of scouts that saw something wrong.
    fn scout(&mut self) -> Vec<DVec3> {
        let accuracy = &self.config.accuracy;
        let scouts = random_viewpoints(self.cell, accuracy.scouts, SCOUT_SEED);
        let found = self.measure(&scouts, accuracy.scout_rays, SCOUT_SEED);
        found.viewpoints.iter().filter(|v| v.wrong > 0).map(|v| v.viewpoint).collect()
    }

    /// Solves lines through suspects whose error is over `tolerated`: along u, and along v if
    /// that was not enough.
    fn look_from(&mut self, suspects: &[DVec3], tolerated: f64) {
        let rays = self.config.accuracy.heldout_rays.div_ceil(SUSPECT_SHARE);
        let sampling = Sampling::new(self.config.solver.rows);
        let mut lines_left = LINES_MAX;
        for &viewpoint in suspects {
            for along_u in [true, false] {
                if self.measure(&[viewpoint], rays, SUSPECT_SEED).max() <= tolerated {
                    break;
                }
                if lines_left == 0 {
                    return;
                }
                lines_left -= 1;
                let line = line_through(self.cell, viewpoint, along_u);
                let seen = solve_segment(self.scene, &line, sampling);
                self.set = PrimitiveSet::union([&self.set, &seen.set]);
                self.lines.push((line, seen));
            }
        }
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
    let set = PrimitiveSet::union(solved.iter().map(|(_, row)| &row.set).chain([&inside]));
    let mut sight = Sight { scene, config, cell, set, lines: Vec::new(), rays: 0 };
    if accuracy.rounds > 0 && !inside.is_empty() {
        let suspects = sight.scout();
        sight.look_from(&suspects, accuracy.worst_error);
    }
    let mut rounds = 0;
    let error = loop {
        let seed = HELDOUT_SEED + u64::from(rounds);
        let heldout = random_viewpoints(cell, accuracy.heldout_viewpoints, seed);
        let error = sight.measure(&heldout, accuracy.heldout_rays, seed);
        let mean_is_good = error.mean_upper_bound() <= accuracy.target_error;
        let good = mean_is_good && error.max() <= accuracy.worst_error;
        if good || rounds >= accuracy.rounds {
            break error;
        }
        rounds += 1;
        // Where the mean is too large, every viewpoint over the target adds to it.
        let tolerated = if mean_is_good { accuracy.worst_error } else { accuracy.target_error };
        sight.look_from(&worst_first(&error), tolerated);
    };
    let Sight { set, lines, rays, .. } = sight;
    let seen: Vec<Seen<'_>> = solved
        .iter()
        .copied()
        .chain(lines.iter().map(|(line, row)| (line, row)))
        .map(|(segment, row)| Seen { row, length: (segment.v1 - segment.v0).length() })
        .collect();
    let weights = CellWeights::new(&set, &seen);
    let sampling = Sampling::new(config.solver.rows);
    let rays_a_segment = 4 * u64::from(sampling.rows()) * u64::from(sampling.columns());
    let effort = CellEffort {
        segments: seen.len() as u32,
        runs: 1,
        lines: lines.len() as u32,
        rows: sampling.rows(),
        solver_rays: rays_a_segment * seen.len() as u64,
        refinements: rounds,
        heldout_viewpoints: error.viewpoints.len() as u32,
        heldout_rays: rays,
        heldout_error_mean: error.mean(),
        heldout_error_upper: error.mean_upper_bound(),
        heldout_error_max: error.max(),
        target_met: error.mean_upper_bound() <= accuracy.target_error
            && error.max() <= accuracy.worst_error,
    };
    let objects = object_rows(scene, cell.id, &set, &weights);
    let weights = weights.codes();
    let cell = CellRow { cell: cell.clone(), tile: planned.tile, set, weights, effort };
    CellOutput { objects, cell }
}

/// The viewpoints with an error, the worst first.
fn worst_first(error: &CellError) -> Vec<DVec3> {
    let mut wrong: Vec<_> = error.viewpoints.iter().filter(|v| v.wrong > 0).collect();
    wrong.sort_by(|a, b| b.error.total_cmp(&a.error));
    wrong.iter().map(|v| v.viewpoint).collect()
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

#[cfg(test)]
mod tests {
    use sightline_geometry::CellId;

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
