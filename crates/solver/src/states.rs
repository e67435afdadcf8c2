//! Solves over several states: how camera and time are coupled, and what is seen in each state.

use std::ops::Range;

use sightline_geometry::{InstancedGeometry, Sampling, StateSets, ViewSegment};

use crate::{SegmentVisibility, SolveOptions, segment::Solve};

/// The time of a state as the camera moves: t runs from `t0` at the start of the segment to `t1` at its
/// end, linearly. Both in [0, 1]; where they are equal the clock stands still.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimePath {
    /// t of the state at the start of the segment.
    pub t0: f64,
    /// t of the state at the end of the segment.
    pub t1: f64,
}

impl TimePath {
    /// Camera and time start together: the source's run.
    pub const FORWARD: Self = Self { t0: 0.0, t1: 1.0 };
    /// The camera starts where time ends.
    pub const REVERSED: Self = Self { t0: 1.0, t1: 0.0 };

    /// The clock stands still at `t`.
    #[must_use]
    pub const fn stopped(t: f64) -> Self {
        Self { t0: t, t1: t }
    }
}

/// What is visible from a segment in a run of states.
#[derive(Clone, Debug, PartialEq)]
pub struct StateVisibility {
    /// The states.
    pub states: Range<u32>,
    /// What is visible in each of them.
    pub visibility: SegmentVisibility,
}

/// What is known to be visible in each state, whatever a segment sees.
pub type Known<'a> = Option<&'a StateSets>;

/// Finds the primitives visible from a segment in each of `states`: runs of states with equal results,
/// ascending, without gaps.
///
/// Runs on the current rayon pool; the result is the same on any, and for every way to cut the
/// states into ranges.
#[must_use]
pub fn solve_states(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
    states: Range<u32>,
    path: TimePath,
    known: Known,
    options: &SolveOptions,
) -> Vec<StateVisibility> {
    let mut out: Vec<StateVisibility> = Vec::new();
    let mut first = states.start;
    while first < states.end {
        let end = states.end.min(first + Solve::MOST);
        let solve = Solve { geometry, segment, sampling, states: first..end, path, known };
        let runs = solve.run(options);
        if runs.is_empty() {
            let visibility = SegmentVisibility::default();
            return vec![StateVisibility { states, visibility }];
        }
        out.extend(runs);
        first = end;
    }
    out.dedup_by(|b, a| {
        let same = a.visibility.same_result(&b.visibility);
        if same {
            a.states.end = b.states.end;
            a.visibility.statistics = a.visibility.statistics.plus(b.visibility.statistics);
        }
        same
    });
    out
}
