//! When the states of a scene are: the times of its key frames.
//!
//! Invariants: there is a key frame; times are finite and strictly ascending. A single key frame is
//! that of a scene at rest, which has one state without a duration.
//!
//! Everything is made of sums, products and quotients, so moments are the same on every machine.

use std::ops::Range;

use crate::Moment;

/// The times of a scene's key frames, seconds.
#[derive(Clone, Debug, PartialEq)]
pub struct Timeline {
    key_times: Vec<f64>,
}

impl Default for Timeline {
    fn default() -> Self {
        Self::at_rest()
    }
}

impl Timeline {
    /// The timeline of a scene at rest.
    #[must_use]
    pub fn at_rest() -> Self {
        Self { key_times: vec![0.0] }
    }

    /// The timeline with these key frames, seconds.
    ///
    /// # Errors
    /// Without a key frame, with a time that is not finite, or with one that is not after the one
    /// before it.
    pub fn new(key_times: Vec<f64>) -> Result<Self, String> {
        if key_times.is_empty() {
            return Err("a scene has at least one key frame".into());
        }
        if u32::try_from(key_times.len()).is_err() {
            return Err(format!("{} key frames are too many", key_times.len()));
        }
        if let Some(time) = key_times.iter().find(|time| !time.is_finite()) {
            return Err(format!("a key frame is at {time} s"));
        }
        if let Some(pair) = key_times.windows(2).find(|pair| pair[0] >= pair[1]) {
            return Err(format!("a key frame at {} s follows one at {} s", pair[1], pair[0]));
        }
        Ok(Self { key_times })
    }

    /// Times of the key frames, seconds.
    #[must_use]
    pub fn key_times(&self) -> &[f64] {
        &self.key_times
    }

    /// Number of states, at least 1.
    #[must_use]
    pub fn states(&self) -> u32 {
        (self.key_times.len() as u32 - 1).max(1)
    }

    /// True for a scene with a single key frame.
    #[must_use]
    pub fn is_at_rest(&self) -> bool {
        self.key_times.len() == 1
    }

    /// The share of the time of the states `whole` that the states `part` of them take, in (0, 1]:
    /// 1 exactly where both are the same.
    ///
    /// # Panics
    /// When `part` is empty or no part of `whole`, or there are no such states.
    #[must_use]
    pub fn share_of(&self, part: &Range<u32>, whole: &Range<u32>) -> f64 {
        assert!(!part.is_empty() && part.start >= whole.start && part.end <= whole.end, "a part");
        assert!(whole.end <= self.states(), "state {} does not exist", whole.end - 1);
        if part == whole {
            return 1.0;
        }
        let key = |state: u32| self.key_times[state as usize];
        (key(part.end) - key(part.start)) / (key(whole.end) - key(whole.start))
    }

    /// The moment at a share in [0, 1] of the time of the states `states`. In a scene at rest there is
    /// but one.
    ///
    /// # Panics
    /// When `states` is empty, or there are no such states.
    #[must_use]
    pub fn moment(&self, states: &Range<u32>, share: f64) -> Moment {
        assert!(!states.is_empty() && states.end <= self.states(), "no states {states:?}");
        if self.is_at_rest() {
            return Moment::START;
        }
        let key = |state: u32| self.key_times[state as usize];
        let time = (1.0 - share) * key(states.start) + share * key(states.end);
        let after = self.key_times.partition_point(|key| *key <= time) as u32;
        let state = after.saturating_sub(1).clamp(states.start, states.end - 1);
        let t = (time - key(state)) / (key(state + 1) - key(state));
        Moment { state, t: t.clamp(0.0, 1.0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_spread_evenly_over_time() {
        let line = Timeline::new(vec![-1.0, 0.0, 3.0, 4.0]).unwrap();
        assert_eq!(line.states(), 3);
        let at = |share| line.moment(&(0..3), share);
        assert_eq!(at(0.0), Moment { state: 0, t: 0.0 });
        assert_eq!(at(0.5), Moment { state: 1, t: 0.5 });
        assert_eq!(at(0.9), Moment { state: 2, t: 0.5 });
        assert_eq!(at(1.0), Moment { state: 2, t: 1.0 }, "the end belongs to the last state");
        assert_eq!(line.moment(&(1..2), 1.0), Moment { state: 1, t: 1.0 });
        assert_eq!(line.share_of(&(1..2), &(0..3)), 0.6);
        assert_eq!(line.share_of(&(1..3), &(1..3)), 1.0);
    }

    #[test]
    fn a_scene_at_rest_has_one_moment() {
        let line = Timeline::at_rest();
        assert_eq!((line.states(), line.moment(&(0..1), 0.7)), (1, Moment::START));
        assert_eq!(line.share_of(&(0..1), &(0..1)), 1.0);
    }

    #[test]
    fn times_that_make_no_sense_are_refused() {
        for times in [vec![], vec![0.0, 0.0], vec![0.0, f64::NAN], vec![1.0, 0.0]] {
            assert!(Timeline::new(times).is_err());
        }
    }
}
