//! How much of a cell's view a primitive takes, in one byte.
//!
//! The weight of a primitive is its share of (solid angle x segments), in [0, 1]. Weights span many
//! orders of magnitude and serve to put primitives in order of importance, so the byte holds a
//! logarithm: code c in 1..=255 stands for `2^((c - 255) / 4)`, from 2^-63.5 to 1. Code 0 stands for
//! a member without a measured weight: a triangle that reaches into the cell and that no segment
//! sees.
//!
//! Error: a share in [2^-63.5, 1] is rounded to the nearest code on the logarithmic scale, so what
//! comes back is within a factor of 2^(1/8) either way: [`Weight::RELATIVE_ERROR`]. No weight is
//! lost: the solver sums in units of 2^-60, and what is smaller takes code 1.
//!
//! Both directions use the exponent and a table, no logarithm of the platform: the same input gives
//! the same byte on every machine (ST-1).

/// Codes a factor of two. With 4, the codes of a byte reach just below the solver's unit, and the
/// error is far below the difference that a change of viewpoint in the cell makes.
const STEPS: i32 = 4;

/// 2^(j / 4).
const POWERS: [f64; STEPS as usize] =
    [1.0, 1.189_207_115_002_721, std::f64::consts::SQRT_2, 1.681_792_830_507_429];

/// 2^((2 j + 1) / 8): from here on, the next code is nearer.
const BORDERS: [f64; STEPS as usize] = [
    1.090_507_732_665_257_7,
    1.296_839_554_651_009_6,
    1.542_210_825_407_940_7,
    1.834_008_086_409_342_4,
];

/// The code of a share of 1.
const WHOLE: i32 = 255;

/// A primitive's share of a cell's view, as the dataset stores it. Orders by importance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Weight(u8);

impl Weight {
    /// In the set, without a measured weight.
    pub const UNMEASURED: Self = Self(0);

    /// What a share comes back as is within this part of it, either way: 2^(1/8) - 1.
    pub const RELATIVE_ERROR: f64 = BORDERS[0] - 1.0;

    /// The weight with this code.
    #[must_use]
    pub const fn from_code(code: u8) -> Self {
        Self(code)
    }

    /// The code, 0 to 255.
    #[must_use]
    pub const fn code(self) -> u8 {
        self.0
    }

    /// The nearest weight to a share, which is taken into [2^-63.5, 1].
    #[must_use]
    pub fn from_share(share: f64) -> Self {
        if share >= 1.0 {
            return Self(WHOLE as u8);
        }
        // Subnormals are far below every code; NaN and negative numbers are no shares.
        if share.is_nan() || share < f64::MIN_POSITIVE {
            return Self(1);
        }
        let bits = share.to_bits();
        let exponent = (bits >> 52) as i32 - 1023;
        let mantissa = f64::from_bits((bits & ((1 << 52) - 1)) | (1023 << 52));
        let steps = BORDERS.iter().filter(|border| mantissa >= **border).count() as i32;
        Self((WHOLE + STEPS * exponent + steps).max(1) as u8)
    }

    /// The share, in (0, 1]; `None` when it was not measured.
    #[must_use]
    pub fn share(self) -> Option<f64> {
        if self == Self::UNMEASURED {
            return None;
        }
        let steps = i32::from(self.0) - WHOLE;
        let exponent = 1023 + steps.div_euclid(STEPS);
        Some(POWERS[steps.rem_euclid(STEPS) as usize] * f64::from_bits((exponent as u64) << 52))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_table_of_the_schema_page_holds() {
        for (share, code) in [(1.0, 255), (0.5, 251), (0.25, 247), (0.001, 215), (1e-6, 175)] {
            assert_eq!(Weight::from_share(share).code(), code, "{share}");
        }
        assert_eq!(Weight::from_code(255).share(), Some(1.0));
        assert_eq!(Weight::from_code(251).share(), Some(0.5));
        assert_eq!(Weight::from_code(0).share(), None);
    }

    #[test]
    fn every_code_comes_back() {
        for code in 1..=255 {
            let share = Weight::from_code(code).share().unwrap();
            assert_eq!(Weight::from_share(share).code(), code);
        }
    }

    #[test]
    fn tables_are_powers_of_two() {
        for j in 0..STEPS {
            let [power, border] = [POWERS, BORDERS].map(|table| table[j as usize]);
            assert!((power.powi(STEPS) / f64::from(1 << j) - 1.0).abs() < 1e-15);
            assert!((border.powi(2 * STEPS) / f64::from(1 << (2 * j + 1)) - 1.0).abs() < 1e-15);
        }
    }

    #[test]
    fn what_is_no_share_becomes_the_nearest() {
        for share in [0.0, -1.0, f64::NAN, 1e-320, 1e-30] {
            assert_eq!(Weight::from_share(share).code(), 1);
        }
        assert_eq!(Weight::from_share(1.0 + 1e-6).code(), 255);
        assert_eq!(Weight::from_share(f64::INFINITY).code(), 255);
    }

    proptest! {
        #[test]
        fn a_share_comes_back_within_the_bound(exponent in -63.4..0.0_f64) {
            let share = exponent.exp2();
            let back = Weight::from_share(share).share().unwrap();
            let bound = (1.0 + Weight::RELATIVE_ERROR) * (1.0 + 4.0 * f64::EPSILON);
            prop_assert!(back <= share * bound && share <= back * bound, "{share} {back}");
        }

        #[test]
        fn a_larger_share_never_weighs_less(a in 0.0..1.0_f64, b in 0.0..1.0_f64) {
            let (low, high) = (a.min(b), a.max(b));
            prop_assert!(Weight::from_share(low) <= Weight::from_share(high));
        }
    }
}
