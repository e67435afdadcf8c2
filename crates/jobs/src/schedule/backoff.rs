//! Pauses before something is tried again: they double, and spread out.
//!
//! Many tasks fail at once when a store goes down; pauses of equal length would bring them all back at
//! once. So a pause is drawn from its upper half. The draw is a hash of what is tried and of how often it
//! was, since this crate has no randomness: the same history gives the same pauses.

/// How long to wait before try number `tries` (0 for the first that follows a failure), ms: between half
/// of `base_ms` times 2^tries and all of it, `longest_ms` at most. `of` tells apart what is tried.
#[must_use]
pub fn pause_ms(base_ms: u64, longest_ms: u64, tries: u32, of: u64) -> u64 {
    let doubled = base_ms.saturating_mul(1_u64.checked_shl(tries).unwrap_or(u64::MAX));
    let whole = doubled.min(longest_ms);
    let half = whole / 2;
    half + mixed(of.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(u64::from(tries)))
        % (whole - half + 1)
}

/// The finaliser of SplitMix64 (Steele, Lea and Flood, 2014): every input bit moves every output bit.
const fn mixed(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::pause_ms;

    #[test]
    fn pauses_double_up_to_the_longest() {
        for of in 0..100 {
            assert!((1_000..=2_000).contains(&pause_ms(2_000, 60_000, 0, of)));
            assert!((4_000..=8_000).contains(&pause_ms(2_000, 60_000, 2, of)));
            assert!((30_000..=60_000).contains(&pause_ms(2_000, 60_000, 200, of)));
        }
        assert_eq!(pause_ms(0, 0, 3, 7), 0);
    }

    #[test]
    fn tasks_that_fail_together_come_back_one_by_one() {
        let pauses: BTreeSet<u64> = (0..1000).map(|of| pause_ms(10_000, 60_000, 0, of)).collect();
        assert!(pauses.len() > 850, "{}", pauses.len());
    }
}
