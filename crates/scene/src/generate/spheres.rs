//! Spheres that bounce on the ground plane, as a particle table.
//!
//! Source: Popescu et al., from-segment visibility, section 4.2: spheres fall from random heights
//! around the user, bounce, lose energy and rest after 25 states; 10,000 of them over 100 m x 100 m,
//! 1,000,000 over 1 km x 1 km.
//!
//! Each sphere has a square column of 1 m to itself and stays in it, so that no two ever overlap. It
//! bounces vertically: free fall from height h takes t0 = sqrt(2 h / g), and with restitution e the
//! bounces after it take 2 t0 e, 2 t0 e^2 and so on, t0 (1 + e) / (1 - e) in all. So a sphere that is
//! to rest at time T has e = (T - t0) / (T + t0).
//!
//! Sizes and heights are chosen so that as much is hidden as in the source, where 1,611 of 10,000
//! spheres are seen from 20 m x 20 m: rays from 200 random places and times at the suggested eye height
//! meet 1,600 (seed 1). Smaller spheres that fall from 8 m hide little of each other: 8,300.
//!
//! Motion is sampled at the key frames and linear between them. Coordinates are multiples of 2^-10 m,
//! which packs well and is exact in `f32`.

use std::io::Write;
use std::ops::RangeInclusive;

use glam::DVec3;
use sightline_geometry::{Bounds, Sphere};

use super::random::Random;
use super::{GenerateError, GenerateReport, check_states};
use crate::particles::{TableFormat, TableWriter};

/// Numbers of spheres that can be generated.
pub const SPHERES_RANGE: RangeInclusive<u64> = 1..=16_000_000;

/// From the first key frame until all spheres rest, seconds.
const DURATION: f64 = 5.0;
/// Gravity, metres a square second.
const GRAVITY: f64 = 9.81;
/// Units of length a metre.
const UNITS: f64 = 1024.0;
/// Half a column, units.
const HALF_COLUMN: usize = 512;
/// Smallest radius and what is added at most, units: 0.4 to 0.48 m.
const RADIUS: (usize, usize) = (410, 82);
/// Heights that spheres fall from, metres.
const HEIGHT: (f64, f64) = (0.3, 2.5);
/// Height of eyes that are among the spheres, metres.
const EYE_HEIGHT: f64 = 0.9;
/// When spheres come to rest, shares of the duration.
const REST: (f64, f64) = (0.7, 1.0);

/// A sphere that bounces.
struct Bouncer {
    x: f32,
    z: f32,
    radius: f32,
    /// Height of the lowest point at the start, metres.
    height: f64,
    /// Speed after a bounce by the speed before it.
    restitution: f64,
}

impl Bouncer {
    /// The sphere of the column `column` of `side` columns along each axis.
    fn new(column: u32, side: u32, random: &mut Random) -> Self {
        let radius = RADIUS.0 + random.below(RADIUS.1 + 1);
        let room = HALF_COLUMN - radius;
        let mut place = |cell: u32| {
            let middle = (2.0 * f64::from(cell) + 1.0 - f64::from(side)) * HALF_COLUMN as f64;
            let moved = random.below(2 * room + 1) as f64 - room as f64;
            ((middle + moved) / UNITS) as f32
        };
        let (x, z) = (place(column % side), place(column / side));
        let height = random.between(HEIGHT.0, HEIGHT.1);
        let fall = (2.0 * height / GRAVITY).sqrt();
        let rest = DURATION * random.between(REST.0, REST.1);
        let restitution = (rest - fall) / (rest + fall);
        Self { x, z, radius: (radius as f64 / UNITS) as f32, height, restitution }
    }

    /// Height of the lowest point at a time in seconds, metres.
    fn height_at(&self, time: f64) -> f64 {
        let fall = (2.0 * self.height / GRAVITY).sqrt();
        if time < fall {
            return self.height - 0.5 * GRAVITY * time * time;
        }
        let (mut left, mut speed) = (time - fall, GRAVITY * fall * self.restitution);
        // Bounces get shorter by a factor below 1: it rests when they are lower than a unit.
        while speed * speed > 2.0 * GRAVITY / UNITS {
            let bounce = 2.0 * speed / GRAVITY;
            if left < bounce {
                return left * (speed - 0.5 * GRAVITY * left);
            }
            left -= bounce;
            speed *= self.restitution;
        }
        0.0
    }

    fn at(&self, time: f64) -> Sphere {
        let height = (self.height_at(time) * UNITS).round() / UNITS;
        let y = (f64::from(self.radius) + height) as f32;
        Sphere { center: [self.x, y, self.z], radius: self.radius }
    }
}

/// Generates `count` bouncing spheres over `states` states and writes them as a table.
///
/// # Errors
/// [`GenerateError::Spheres`] and [`GenerateError::States`] for numbers out of range,
/// [`GenerateError::Table`] when `out` fails.
pub fn bouncing_spheres(
    count: u64,
    states: u32,
    seed: u64,
    format: TableFormat,
    out: &mut (impl Write + Send),
) -> Result<GenerateReport, GenerateError> {
    if !SPHERES_RANGE.contains(&count) {
        return Err(GenerateError::Spheres { requested: count });
    }
    check_states(states)?;
    let side = (1u32..).find(|&side| u64::from(side).pow(2) >= count).unwrap_or(1);
    let mut random = Random::new(seed, 0);
    let bouncers: Vec<Bouncer> =
        (0..count as u32).map(|column| Bouncer::new(column, side, &mut random)).collect();

    let mut bytes = 0;
    let mut writer = TableWriter::new(format, Counted { out, bytes: &mut bytes })?;
    let mut bounds = Bounds::EMPTY;
    let mut spheres: Vec<(u32, Sphere)> = Vec::with_capacity(bouncers.len());
    for key in 0..=states {
        let time = DURATION * f64::from(key) / f64::from(states);
        spheres.clear();
        spheres.extend((0..).zip(bouncers.iter().map(|b| b.at(time))));
        for (_, sphere) in &spheres {
            let (center, radius) = (sphere.center(), DVec3::splat(sphere.radius.into()));
            bounds = bounds.union(Bounds { min: center - radius, max: center + radius });
        }
        writer.key_frame(time, &spheres)?;
    }
    writer.finish()?;
    Ok(GenerateReport {
        triangles: 0,
        unique_triangles: 0,
        particles: count,
        states,
        bytes,
        bounds,
        suggested_region: [-10.0, -10.0, 10.0, 10.0],
        suggested_eye_height: [EYE_HEIGHT; 2],
    })
}

/// An output that counts its bytes.
struct Counted<'a, W> {
    out: &'a mut W,
    bytes: &'a mut u64,
}

impl<W: Write> Write for Counted<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.out.write(bytes)?;
        *self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.out.flush()
    }
}
