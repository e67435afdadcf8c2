//! Directions spread evenly over the sphere, in an order that keeps neighbours together.
//!
//! Source: the spherical Fibonacci lattice (Gonzalez, "Measurement of Areas on a Sphere Using
//! Fibonacci and Latitude-Longitude Lattices", 2010): point i of n has
//! `z = 1 - (2 i + 1) / n` and the azimuth `i` golden angles. The lattice is rotated by a random
//! rotation, so every single direction is uniform over the sphere and the measured share has no
//! bias, and each direction is moved by about the lattice's spacing, so that regular facades do
//! not beat with it.
//!
//! Everything is made of additions, products, quotients and square roots, which IEEE 754 rounds
//! correctly: the directions are the same on every machine. The azimuths come from repeated
//! complex multiplication; its error, some n u, moves points by far less than their spacing.
//!
//! The points are sorted along a space-filling curve over the octahedral map, so that
//! consecutive rays visit the same nodes.

use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::seed::SplitMix64;

/// Cosine and sine of the golden angle, pi (3 - sqrt 5).
const GOLDEN: DVec2 = DVec2::new(-0.737_368_878_078_319_9, 0.675_490_294_261_523_6);

/// The lattice before rotation and jitter.
pub struct Lattice {
    points: Vec<DVec3>,
    /// Edge of the cube of jitter: the spacing of the points, sqrt(4 pi / n).
    spacing: f64,
}

impl Lattice {
    /// The lattice of `count` points.
    pub fn new(count: u32) -> Self {
        let n = f64::from(count.max(1));
        let mut turn = DVec2::X;
        let mut keyed: Vec<(u32, DVec3)> = (0..count)
            .map(|i| {
                let z = 1.0 - (2.0 * f64::from(i) + 1.0) / n;
                let point = (turn * (1.0 - z * z).max(0.0).sqrt()).extend(z).normalize();
                turn = turn.rotate(GOLDEN);
                (curve_position(point), point)
            })
            .collect();
        keyed.sort_unstable_by_key(|(position, point)| (*position, point.z.to_bits()));
        let points = keyed.into_iter().map(|(_, point)| point).collect();
        Self { points, spacing: (4.0 * std::f64::consts::PI / n).sqrt() }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// The directions with numbers `range` of the lattice rotated and jittered by `seed`. Unit
    /// vectors.
    pub fn directions(
        &self,
        seed: u64,
        range: std::ops::Range<usize>,
    ) -> impl Iterator<Item = DVec3> + '_ {
        let mut random = SplitMix64::new(seed);
        let rotation = DMat3::from_quat(random_rotation(&mut random));
        // Three numbers a direction, from a stream of its own.
        let mut jitter = SplitMix64::at(random.next_u64(), 3 * range.start as u64);
        self.points[range].iter().map(move |&point| {
            let mut side = || jitter.next_unit() - 0.5;
            let offset = DVec3::new(side(), side(), side());
            (rotation * (point + self.spacing * offset)).normalize()
        })
    }
}

/// A rotation uniform over all rotations.
///
/// Source: Marsaglia, "Choosing a Point from the Surface of a Sphere" (1972), for four
/// dimensions: rejection from two discs, no trigonometry.
fn random_rotation(random: &mut SplitMix64) -> DQuat {
    let mut disc = || loop {
        let p = 2.0 * DVec2::new(random.next_unit(), random.next_unit()) - 1.0;
        let square = p.length_squared();
        if square > 0.0 && square < 1.0 {
            return (p, square);
        }
    };
    let ((a, a2), (b, b2)) = (disc(), disc());
    let b = b * ((1.0 - a2) / b2).sqrt();
    DQuat::from_xyzw(a.x, a.y, b.x, b.y).normalize()
}

/// Position along a Morton curve over the octahedral map of the sphere, 15 bits a side.
fn curve_position(d: DVec3) -> u32 {
    let p = d / (d.x.abs() + d.y.abs() + d.z.abs());
    let p = if p.z >= 0.0 {
        DVec2::new(p.x, p.y)
    } else {
        DVec2::new((1.0 - p.y.abs()).copysign(p.x), (1.0 - p.x.abs()).copysign(p.y))
    };
    let cell = |x: f64| (((x + 1.0) * 16384.0) as u32).min(32767);
    spread(cell(p.x)) | spread(cell(p.y)) << 1
}

/// Puts a zero bit above each of the low 16 bits.
const fn spread(x: u32) -> u32 {
    let x = (x | x << 8) & 0x00FF_00FF;
    let x = (x | x << 4) & 0x0F0F_0F0F;
    let x = (x | x << 2) & 0x3333_3333;
    (x | x << 1) & 0x5555_5555
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_cover_the_sphere_evenly() {
        let lattice = Lattice::new(20_000);
        let all: Vec<DVec3> = lattice.directions(5, 0..20_000).collect();
        assert!(all.iter().all(|d| (d.length() - 1.0).abs() < 1e-12));
        let mean = all.iter().sum::<DVec3>() / 20_000.0;
        assert!(mean.length() < 1e-3, "{mean}");
        // Caps around several axes hold their share of the area, (1 - cos) / 2.
        for axis in [DVec3::X, -DVec3::Y, DVec3::new(0.6, 0.0, -0.8)] {
            for cos in [0.9, 0.5, -0.3] {
                let inside = all.iter().filter(|d| d.dot(axis) > cos).count() as f64 / 20_000.0;
                assert!((inside - (1.0 - cos) / 2.0).abs() < 2e-3, "{axis} {cos} {inside}");
            }
        }
    }

    #[test]
    fn a_part_of_the_directions_is_the_same_as_in_the_whole() {
        let lattice = Lattice::new(1000);
        let all: Vec<DVec3> = lattice.directions(9, 0..1000).collect();
        let part: Vec<DVec3> = lattice.directions(9, 300..420).collect();
        assert_eq!(all[300..420], part);
    }

    #[test]
    fn seeds_turn_the_lattice() {
        let lattice = Lattice::new(10);
        let of = |seed| lattice.directions(seed, 0..10).collect::<Vec<_>>();
        assert_ne!(of(1), of(2));
        assert_eq!(of(1), of(1));
    }
}
