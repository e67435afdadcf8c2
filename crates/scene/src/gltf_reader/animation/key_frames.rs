//! Which times become key frames.
//!
//! One list for all that moves: from each key frame the next one is as late as all movers allow (see
//! `bend` for what they allow, and why it holds at all times). Whether a stretch is straight enough
//! is not quite monotone in its end, so the search may stop early, never too late: every stretch that is taken
//! has been looked at.
//!
//! Jumps: where a STEP sampler changes its value at time t there is a key frame at t, with the new value,
//! and one just before it with the old one. The state between them lasts [`JUMP_SECONDS`] or the
//! spacing of `f32` numbers at t, whichever is more, but at most half of the time since the jump
//! before. Within it nothing is promised.

use super::{
    bend::{Mover, Sampled, TIMES_AT_ONCE, sort},
    rig::Rig,
};
use crate::{Cause, OpenOptions, SceneError};

/// How long a jump takes, seconds: far below the time of a frame of any display.
pub const JUMP_SECONDS: f64 = 1e-3;

/// The key frames.
#[derive(Debug)]
pub struct KeyFrames {
    /// Seconds, ascending from 0; one where nothing moves.
    pub times: Vec<f64>,
    /// Number of jumps.
    pub jumps: u64,
}

/// Chooses the key frames of `0..=duration`.
pub fn choose(
    rig: &Rig,
    movers: Vec<Mover>,
    duration: f64,
    options: &OpenOptions,
) -> Result<KeyFrames, SceneError> {
    let mut times = vec![0.0];
    if movers.is_empty() || duration <= 0.0 {
        return Ok(KeyFrames { times, jumps: 0 });
    }
    let error = options.motion_error;
    let mut jumps = vec![];
    for mover in &movers {
        mover.jumps(rig, &mut jumps);
        if jumps.len() > TIMES_AT_ONCE {
            sort(&mut jumps);
        }
    }
    sort(&mut jumps);
    jumps.retain(|&t| t > 0.0 && t <= duration);
    let movers = Sampled::new(rig, movers, duration, error)?;
    let candidates = movers.times();

    let too_many = |reached: f64| -> SceneError {
        Cause::TooManyStates { error, limit: options.max_states, reached, duration }.into()
    };
    let add = |times: &mut Vec<f64>, time: f64| {
        if times.len() > options.max_states as usize {
            return Err(too_many(times[times.len() - 1]));
        }
        times.push(time);
        Ok(())
    };
    let walk = |times: &mut Vec<f64>, end: f64| -> Result<(), SceneError> {
        let mut stride = 1;
        loop {
            let from = times[times.len() - 1];
            if from >= end {
                return Ok(());
            }
            let first = candidates.partition_point(|&t| t <= from);
            let last = candidates.partition_point(|&t| t < end);
            let at = |i: usize| if i < last { candidates[i] } else { end };
            let next = farthest(first, last, stride, |i| movers.are_straight(from, at(i), error));
            stride = next + 1 - first;
            add(times, at(next))?;
        }
    };
    for &jump in &jumps {
        let before = times[times.len() - 1];
        let spacing = f64::from((jump as f32).next_up()) - f64::from(jump as f32);
        let takes = JUMP_SECONDS.max(spacing).min(0.5 * (jump - before_jump(&jumps, jump)));
        let from = jump - takes;
        if from > before {
            walk(&mut times, from)?;
        }
        if jump > times[times.len() - 1] {
            add(&mut times, jump)?;
        }
    }
    walk(&mut times, duration)?;
    Ok(KeyFrames { times, jumps: jumps.len() as u64 })
}

/// The jump before another one; 0 before the first.
fn before_jump(jumps: &[f64], jump: f64) -> f64 {
    match jumps.partition_point(|&t| t < jump) {
        0 => 0.0,
        at => jumps[at - 1],
    }
}

/// The farthest of `first..=last` that `reaches`, as far as a search finds it; `first` always does.
fn farthest(first: usize, last: usize, stride: usize, reaches: impl Fn(usize) -> bool) -> usize {
    let (mut near, mut far) = (first, last + 1);
    // The next state is about as long as the one before.
    let mut step = stride.max(1);
    while near < last {
        let probe = (near + step).min(last);
        if !reaches(probe) {
            far = probe;
            break;
        }
        near = probe;
        step *= 2;
    }
    while near + 1 < far {
        let middle = near + (far - near) / 2;
        if reaches(middle) {
            near = middle;
        } else {
            far = middle;
        }
    }
    near
}
