//! Directions and numbers that sampling methods draw, the same on every run.

use glam::{DMat3, DQuat, DVec3};
use sightline_quality::SplitMix64;

/// A generator for piece `k` of stream `stream`.
#[must_use]
pub fn stream(stream: u64, k: u64) -> SplitMix64 {
    let mut seed = SplitMix64::new(stream ^ k.wrapping_mul(0xA076_1D64_78BD_642F));
    SplitMix64::new(seed.next_u64())
}

/// The rotation number `k` of a sequence of random rotations, uniform over all rotations.
///
/// Source: Shoemake, "Uniform Random Rotations" (Graphics Gems III).
#[must_use]
pub fn rotation(k: u64) -> DMat3 {
    let mut random = stream(0x0607, k);
    let (u, v, w) = (random.next_unit(), random.next_unit(), random.next_unit());
    let turn = std::f64::consts::TAU;
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    DMat3::from_quat(DQuat::from_xyzw(
        a * (turn * v).sin(),
        a * (turn * v).cos(),
        b * (turn * w).sin(),
        b * (turn * w).cos(),
    ))
}

/// The direction at a point of the unit square, uniform over the sphere: equal areas of the square
/// are equal areas of the sphere, and neighbours stay neighbours except at a seam.
///
/// Source: Archimedes' cylinder.
#[must_use]
pub fn sphere(u: f64, v: f64) -> DVec3 {
    let z = 1.0 - 2.0 * u;
    let r = (1.0 - z * z).max(0.0).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * v).sin_cos();
    DVec3::new(r * cos, r * sin, z)
}

/// The cell number `i` of a grid of 2^bits x 2^bits along a Morton curve.
#[must_use]
pub const fn morton(i: u32) -> (u32, u32) {
    (every_other(i), every_other(i >> 1))
}

const fn every_other(x: u32) -> u32 {
    let x = x & 0x5555_5555;
    let x = (x | x >> 1) & 0x3333_3333;
    let x = (x | x >> 2) & 0x0F0F_0F0F;
    let x = (x | x >> 4) & 0x00FF_00FF;
    (x | x >> 8) & 0x0000_FFFF
}

/// The number `k` of the van der Corput sequence: any first 2^n of it are spread evenly.
#[must_use]
pub fn van_der_corput(k: u32) -> f64 {
    f64::from(k.reverse_bits()) / 4_294_967_296.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_areas_of_the_square_are_equal_areas_of_the_sphere() {
        let n = 64;
        for (axis, cos) in [(DVec3::X, 0.5), (DVec3::new(0.0, 0.6, -0.8), 0.8)] {
            let inside = (0..n * n).filter(|i| {
                let at = |k: i32| (f64::from(k) + 0.5) / f64::from(n);
                sphere(at(i / n), at(i % n)).dot(axis) > cos
            });
            let share = inside.count() as f64 / f64::from(n * n);
            assert!((share - (1.0 - cos) / 2.0).abs() < 5e-3, "{axis} {share}");
        }
    }

    #[test]
    fn a_morton_curve_visits_every_cell_of_a_grid() {
        let mut cells: Vec<_> = (0..256).map(morton).collect();
        assert_eq!(cells[..4], [(0, 0), (1, 0), (0, 1), (1, 1)]);
        cells.sort_unstable();
        assert!(cells.iter().copied().eq((0..16).flat_map(|x| (0..16).map(move |y| (x, y)))));
    }

    #[test]
    fn rotations_are_rotations_and_differ() {
        for k in 0..10 {
            let m = rotation(k);
            assert!((m * m.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-12));
            assert!((m.determinant() - 1.0).abs() < 1e-12);
            assert!(!m.abs_diff_eq(rotation(k + 1), 1e-3));
        }
    }
}
