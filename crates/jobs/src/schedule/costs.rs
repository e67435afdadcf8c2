//! How long a task should take, from how long others of its kind took.
//!
//! Costs are counted in microseconds a unit (a segment, a cell), in buckets that are a quarter of an
//! octave wide, so that memory is bounded and the answer does not depend on the order of commits. The
//! prediction is the upper end of the median's bucket: a few slow workers or a few hard cells do not move
//! it.
//!
//! Times are from the lease to the commit, measured by the coordinator's clock: workers' clocks and what
//! they report take no part.

use crate::TaskKind;

/// Buckets an octave.
const BUCKETS_AN_OCTAVE: u64 = 4;
/// Octaves of a `u64`, and a bucket for zero.
const BUCKETS: usize = 64 * BUCKETS_AN_OCTAVE as usize + 1;
/// Durations that have to be known before anything is predicted.
const SAMPLES_MIN: u64 = 3;

/// Costs of the tasks of each kind.
#[derive(Clone, Debug)]
pub(super) struct Costs {
    kinds: [Histogram; TaskKind::KINDS],
}

#[derive(Clone, Debug)]
struct Histogram {
    counts: Box<[u64; BUCKETS]>,
    samples: u64,
}

impl Costs {
    pub fn new() -> Self {
        let empty = Histogram { counts: Box::new([0; BUCKETS]), samples: 0 };
        Self { kinds: std::array::from_fn(|_| empty.clone()) }
    }

    /// A task of `units` units of a kind took so long.
    pub fn add(&mut self, kind: usize, units: u32, took_ms: u64) {
        let histogram = &mut self.kinds[kind];
        let unit_us = took_ms.saturating_mul(1000) / u64::from(units.max(1));
        histogram.counts[bucket(unit_us)] += 1;
        histogram.samples += 1;
    }

    /// How long a task of `units` units of a kind should take, ms; `None` when too few are known.
    pub fn predicted_ms(&self, kind: usize, units: u32) -> Option<u64> {
        let histogram = &self.kinds[kind];
        if histogram.samples < SAMPLES_MIN {
            return None;
        }
        let mut below = 0;
        let median = histogram.counts.iter().position(|count| {
            below += count;
            below * 2 >= histogram.samples
        })?;
        Some(upper_end_us(median).saturating_mul(u64::from(units)) / 1000)
    }
}

fn bucket(unit_us: u64) -> usize {
    let Some(octave) = unit_us.checked_ilog2() else { return 0 };
    // The two bits behind the leading one tell the quarter.
    let quarter = ((unit_us << (63 - octave)) >> 61) & (BUCKETS_AN_OCTAVE - 1);
    (u64::from(octave) * BUCKETS_AN_OCTAVE + quarter) as usize + 1
}

/// First value behind a bucket.
fn upper_end_us(bucket: usize) -> u64 {
    let Some(place) = bucket.checked_sub(1) else { return 1 };
    let (octave, quarter) = (place as u64 / BUCKETS_AN_OCTAVE, place as u64 % BUCKETS_AN_OCTAVE);
    // 2^octave (1 + (quarter + 1) / 4), rounded up.
    let end = (u128::from(BUCKETS_AN_OCTAVE + quarter + 1) << octave).div_ceil(4);
    u64::try_from(end).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn nothing_is_predicted_from_two_tasks() {
        let mut costs = Costs::new();
        costs.add(0, 10, 100);
        costs.add(0, 10, 100);
        assert_eq!(costs.predicted_ms(0, 10), None);
        costs.add(0, 10, 100);
        let predicted = costs.predicted_ms(0, 20).unwrap();
        assert!((200..=250).contains(&predicted), "{predicted}");
        assert_eq!(costs.predicted_ms(1, 20), None, "kinds do not mix");
    }

    #[test]
    fn one_slow_worker_in_eight_does_not_move_the_prediction() {
        let mut costs = Costs::new();
        for k in 0..80 {
            costs.add(0, 1, if k % 8 == 0 { 1000 } else { 100 });
        }
        assert!(costs.predicted_ms(0, 1).unwrap() <= 125);
    }

    proptest! {
        #[test]
        fn a_value_lies_in_its_bucket(octave in 0..64u32, low in any::<u64>()) {
            let value = (1 << octave) | (low & ((1 << octave) - 1));
            let own = bucket(value);
            prop_assert!(own < BUCKETS);
            prop_assert!(value <= upper_end_us(own));
            prop_assert!(own == 1 || value >= upper_end_us(own - 1) - 1, "{value} {own}");
            prop_assert!(upper_end_us(own) <= value.saturating_add(value / 4).saturating_add(2));
        }
    }
}
