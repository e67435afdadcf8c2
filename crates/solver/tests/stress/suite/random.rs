//! Random numbers: the same everywhere, for ever.
//!
//! Source: Steele, Lea, Flood, "Fast Splittable Pseudorandom Number Generators" (OOPSLA 2014),
//! with the constants of Vigna's `splitmix64.c`.

use std::ops::Range;

use glam::{DQuat, DVec3};

const GAMMA: u64 = 0x9E37_79B9_7F4A_7C15;

const fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// SplitMix64.
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// The generator of a case: every pair of a family's name and a number has its own.
    pub fn of_case(family: &str, seed: u64) -> Self {
        let name = family.bytes().fold(0, |state, b| mix(state ^ (u64::from(b) + GAMMA)));
        Self(mix(name ^ mix(seed.wrapping_add(GAMMA))))
    }

    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(GAMMA);
        mix(self.0)
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    pub fn below(&mut self, n: usize) -> usize {
        (self.bits() % n as u64) as usize
    }

    pub fn within(&mut self, range: Range<f64>) -> f64 {
        range.start + (range.end - range.start) * self.unit()
    }

    /// Uniform in the exponent: as many numbers between 1 and 10 as between 10 and 100.
    pub fn magnitude(&mut self, range: Range<f64>) -> f64 {
        libm::exp(self.within(libm::log(range.start)..libm::log(range.end)))
    }

    pub fn integer(&mut self, range: std::ops::RangeInclusive<i32>) -> f64 {
        let (low, high) = (*range.start(), *range.end());
        f64::from(low + self.below((high - low + 1) as usize) as i32)
    }

    /// True once in `n` times.
    pub fn one_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }

    pub fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }

    pub fn in_cube(&mut self, half: f64) -> DVec3 {
        let mut next = || self.within(-half..half);
        DVec3::new(next(), next(), next())
    }

    /// Uniform on the unit sphere. Source: Archimedes' hat-box theorem.
    pub fn direction(&mut self) -> DVec3 {
        let (z, angle) = (self.within(-1.0..1.0), self.within(0.0..std::f64::consts::TAU));
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * libm::cos(angle), r * libm::sin(angle), z)
    }

    pub fn rotation(&mut self) -> DQuat {
        let (axis, angle) = (self.direction(), self.within(0.0..std::f64::consts::TAU));
        DQuat::from_axis_angle(axis, angle)
    }

    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.below(i + 1));
        }
    }
}
