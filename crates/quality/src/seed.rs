//! Seeds and random numbers: the same everywhere, for ever.
//!
//! Source: Steele, Lea, Flood, "Fast Splittable Pseudorandom Number Generators" (OOPSLA 2014),
//! with the constants of Vigna's `splitmix64.c`. State n of a generator is `seed + n * GAMMA`,
//! its output `mix(state)`.
//!
//! Seeds are derived by absorbing numbers one at a time: `absorb(s, x) = mix((s ^ mix(x + GAMMA))
//! + GAMMA)`, which is a bijection in s for a fixed x and in x for a fixed s.

use sightline_geometry::CellId;

const GAMMA: u64 = 0x9E37_79B9_7F4A_7C15;

const fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

const fn absorb(state: u64, x: u64) -> u64 {
    mix((state ^ mix(x.wrapping_add(GAMMA))).wrapping_add(GAMMA))
}

/// The seed of the directions at viewpoint number `viewpoint` of a cell:
/// `absorb(absorb(seed, cell), viewpoint)`.
#[must_use]
pub const fn viewpoint_seed(seed: u64, cell: CellId, viewpoint: u32) -> u64 {
    absorb(absorb(seed, cell.0 as u64), viewpoint as u64)
}

/// The seed that places a cell's random viewpoints: apart from every [`viewpoint_seed`], whose
/// last number is below 2^32.
pub(crate) const fn placement_seed(seed: u64, cell: CellId) -> u64 {
    absorb(absorb(seed, cell.0 as u64), 1 << 32)
}

/// The seed of batch number `batch` of a viewpoint's directions.
pub(crate) const fn batch_seed(seed: u64, batch: u32) -> u64 {
    absorb(seed, (2 << 32) | batch as u64)
}

/// The seed of the moments at which rays or viewpoints are looked at. Apart from the other two, so
/// that a scene that moves has the viewpoints and directions of one at rest.
pub(crate) const fn moment_seed(seed: u64, cell: CellId) -> u64 {
    absorb(absorb(seed, cell.0 as u64), 3 << 32)
}

/// A small generator of 64 random bits a step, period 2^64.
#[derive(Clone, Debug)]
pub struct SplitMix64(u64);

impl SplitMix64 {
    /// The generator that starts at `seed`.
    #[must_use]
    pub const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The generator after `steps` steps from `seed`.
    #[must_use]
    pub(crate) const fn at(seed: u64, steps: u64) -> Self {
        Self(seed.wrapping_add(steps.wrapping_mul(GAMMA)))
    }

    /// The next 64 bits.
    pub const fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(GAMMA);
        mix(self.0)
    }

    /// The next number, uniform in [0, 1) with 53 bits.
    pub const fn next_unit(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn generator_gives_the_published_sequence() {
        // First outputs of splitmix64.c for the seed 1234567.
        let mut random = SplitMix64::new(1_234_567);
        assert_eq!(random.next_u64(), 6_457_827_717_110_365_317);
        assert_eq!(random.next_u64(), 3_203_168_211_198_807_973);
        assert_eq!(SplitMix64::at(1_234_567, 1).next_u64(), 3_203_168_211_198_807_973);
    }

    #[test]
    fn seeds_of_cells_and_viewpoints_differ() {
        let mut seen = std::collections::HashSet::new();
        for cell in 0..50 {
            assert!(seen.insert(placement_seed(7, CellId(cell))));
            assert!(seen.insert(moment_seed(7, CellId(cell))));
            for viewpoint in 0..50 {
                assert!(seen.insert(viewpoint_seed(7, CellId(cell), viewpoint)));
            }
        }
    }
}
