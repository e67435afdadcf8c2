//! Our method, through its public interface: the perimeter's segments, solved and added up.

use sightline_geometry::{InstancedGeometry, PrimitiveSet, Sampling, SegmentId, ViewSegment};
use sightline_solver::solve_segment;

use crate::clock::Stopwatch;
use crate::curve::{Curve, Judge};

/// Solves every segment once at `rows` rows; run `run` has its rays elsewhere than other runs.
#[must_use]
pub fn perimeter(
    geometry: &InstancedGeometry,
    segments: &[ViewSegment],
    rows: u32,
    run: u32,
) -> PrimitiveSet {
    let sets: Vec<PrimitiveSet> = segments
        .iter()
        .map(|segment| {
            let k = run * segments.len() as u32 + segment.id.0;
            solve_segment(geometry, segment, Sampling::new(rows).jittered(k)).set
        })
        .collect();
    PrimitiveSet::union(&sets)
}

/// A point for each number of rows, then for 2, 4, ... runs of the last, while there is time.
#[must_use]
pub fn curve(
    judge: &Judge,
    geometry: &InstancedGeometry,
    segments: &[ViewSegment],
    rows: &[u32],
    runs: u32,
) -> Curve {
    let mut curve = Curve { method: "from-segment (ours)".into(), ..Curve::default() };
    // Code and scene come into the caches: what the other methods had from their tracers' tests.
    let _ = perimeter(geometry, &segments[..1], 16, 0);
    let mut last = None;
    for &rows in rows {
        let mut watch = Stopwatch::new(judge.clock);
        let set = watch.time(|| perimeter(geometry, segments, rows, 0));
        curve.points.push(judge.point(format!("{rows} rows"), watch.seconds(), &set));
        // Twice the rows take two to four times as long.
        let is_last = 3.0 * watch.seconds() > judge.limit;
        last = Some((rows, watch, set));
        if is_last {
            break;
        }
    }
    let Some((rows, mut watch, mut set)) = last else { return curve };
    for run in 1..runs {
        let found = watch.time(|| perimeter(geometry, segments, rows, run));
        set = watch.time(|| PrimitiveSet::union([&set, &found]));
        let done = run + 1;
        let is_over = watch.seconds() > judge.limit;
        if done.is_power_of_two() || done == runs || is_over {
            let label = format!("{rows} rows, {done} runs");
            curve.points.push(judge.point(label, watch.seconds(), &set));
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
