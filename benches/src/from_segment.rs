//! Our method, through its public interface: the perimeter's segments, solved and added up.

use sightline_geometry::{InstancedGeometry, PrimitiveSet, Sampling, SegmentId, ViewSegment};
use sightline_solver::{SolveOptions, solve_segment_with};

use crate::clock::Stopwatch;
use crate::curve::{Curve, Judge};

/// Passes of finer rays within a solve: the last has 32 times the rows of the first.
const PASSES: u32 = 5;

/// Share of (directions x segment) that may be missing in a tile in the first round.
const FIRST_THRESHOLD: f64 = 1e-4;

/// Solves every segment once more, and adds what it sees to what is `known`. Round `round` has its
/// rays elsewhere than other rounds, and looks four times as closely as the one before.
#[must_use]
pub fn perimeter(
    geometry: &InstancedGeometry,
    segments: &[ViewSegment],
    rows: u32,
    round: u32,
    known: &PrimitiveSet,
) -> PrimitiveSet {
    let threshold = FIRST_THRESHOLD / f64::from(4u32.saturating_pow(round));
    segments.iter().fold(known.clone(), |known, segment| {
        let run = round * segments.len() as u32 + segment.id.0;
        let options = SolveOptions {
            passes: PASSES,
            threshold,
            known: Some(&known),
            ..SolveOptions::default()
        };
        let sampling = Sampling::new(rows).jittered(run);
        let seen = solve_segment_with(geometry, segment, sampling, &options).set;
        PrimitiveSet::union([&known, &seen])
    })
}

/// Points after rounds, while there is time.
#[must_use]
pub fn curve(
    judge: &Judge,
    geometry: &InstancedGeometry,
    segments: &[ViewSegment],
    rows: u32,
    rounds: u32,
) -> Curve {
    let mut curve = Curve { method: "from-segment (ours)".into(), ..Curve::default() };
    let mut set = PrimitiveSet::default();
    // Code and scene come into the caches: what the other methods had from their tracers' tests.
    let _ = perimeter(geometry, &segments[..1], 16, 0, &set);
    let mut watch = Stopwatch::new(judge.clock);
    for round in 0..rounds {
        set = watch.time(|| perimeter(geometry, segments, rows, round, &set));
        let seconds = watch.seconds();
        let is_over = seconds > judge.limit || round + 1 == rounds;
        // A third more time makes a point worth reading.
        if is_over || curve.points.last().is_none_or(|p| seconds > 4.0 / 3.0 * p.seconds) {
            let label = format!("{rows} rows, round {}", round + 1);
            curve.points.push(judge.point(label, seconds, &set));
        }
        if is_over {
            break;
        }
    }
    curve
}

/// A segment renumbered, so that it stands alone.
#[must_use]
pub fn alone(segment: &ViewSegment) -> ViewSegment {
    ViewSegment { id: SegmentId(0), ..*segment }
}
