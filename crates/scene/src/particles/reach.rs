//! Where a mover can be whose path is not known: temporal bounding volumes that are spheres.
//!
//! A table may say of a particle how fast it is at most, or how much it accelerates at most. Its rows
//! are then where it was seen; between two of them, and with a speed behind the last one, it is
//! somewhere in a ball that is guaranteed to hold it. The balls are what the scene has: a cell sees the
//! particle in all states in which it sees the ball. They hide nothing, since the particle is not all of
//! them.
//!
//! *Between two rows* at x and y, T apart, a share s of the time behind the first: a particle of speed v
//! is within s T v of x and (1 - s) T v of y, so it is within
//! `(1 - s) s T v + s (1 - s) T v = 2 v T s (1 - s)` of the point (1 - s) x + s y. One of acceleration a
//! is within `a T^2 / 2 s (1 - s)` of it (the error of linear interpolation). Either is b s (1 - s), a
//! concave function, and radii change linearly between key frames: a chord of length h (in s) runs
//! below it by at most b h^2 / 4, which is added at all key frames of the gap.
//!
//! *Behind the last row* a particle of speed v is within r + v t: linear, as radii are. What has an
//! acceleration alone ends with its last row.
//!
//! Source: Sudarsky and Gotsman, "Output-Sensitive Rendering and Communication in Dynamic Virtual
//! Environments" (VRST 1997), section 2.2.
//!
//! Invariant: the ball of every moment holds the balls of radius r around all points where the particle
//! can be then, up to the rounding of spheres to `f32`.

use std::ops::Range;

use sightline_geometry::{Sphere, motion::lerp};

/// The most that is known of how a particle moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Reach {
    /// Largest speed, metres a second; infinite when unknown.
    pub speed: f64,
    /// Largest acceleration, metres a second squared; infinite when unknown.
    pub acceleration: f64,
}

impl Reach {
    /// Of what one row says and what another does, the looser.
    pub fn or_looser(self, other: Self) -> Self {
        Self {
            speed: self.speed.max(other.speed),
            acceleration: self.acceleration.max(other.acceleration),
        }
    }

    /// b of the module's text, for rows that are so many seconds apart, metres.
    fn bulge(self, seconds: f64) -> f64 {
        (2.0 * self.speed * seconds).min(0.5 * self.acceleration * seconds * seconds)
    }
}

/// Two rows that are farther apart than the particle can move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TooFast {
    /// Number of the particle in the table.
    pub particle: usize,
    /// Time of the earlier row, seconds.
    pub from: f64,
    /// Distance of the rows, metres.
    pub distance: f64,
    /// Farthest that it can move between them, metres.
    pub most: f64,
}

/// Replaces the rows in `keys`, one list of spheres a key frame, by the balls of their particles.
pub(super) fn grow(
    keys: &mut [Vec<Sphere>],
    times: &[f64],
    reaches: &[Reach],
) -> Result<(), TooFast> {
    for (particle, reach) in reaches.iter().enumerate() {
        let rows: Vec<usize> =
            (0..keys.len()).filter(|&key| keys[key][particle].is_present()).collect();
        let before = rows.iter().map(|&key| keys[key][particle]).collect::<Vec<_>>();
        for (k, gap) in rows.windows(2).enumerate() {
            fill_gap(keys, times, particle, *reach, (before[k], before[k + 1]), gap[0]..gap[1])?;
        }
        let (Some(&last), Some(&ball)) = (rows.last(), before.last()) else { continue };
        if reach.speed.is_finite() {
            for key in last + 1..keys.len() {
                let radius = f64::from(ball.radius) + reach.speed * (times[key] - times[last]);
                keys[key][particle] = Sphere { radius: rounded_up(radius), ..ball };
            }
        }
    }
    Ok(())
}

/// The balls between two rows, `gap` from the key frame of the one to that of the other.
fn fill_gap(
    keys: &mut [Vec<Sphere>],
    times: &[f64],
    particle: usize,
    reach: Reach,
    (from, to): (Sphere, Sphere),
    gap: Range<usize>,
) -> Result<(), TooFast> {
    let seconds = times[gap.end] - times[gap.start];
    let distance = (to.center() - from.center()).length();
    let most = reach.speed * seconds;
    // Each coordinate is rounded to `f32`: half a unit in its last place, in both rows.
    let rounding =
        f64::from(f32::EPSILON) * (to.center().abs() + from.center().abs()).element_sum();
    if distance > most + rounding {
        return Err(TooFast { particle, from: times[gap.start], distance, most });
    }
    let bulge = reach.bulge(seconds);
    let share = |key: usize| (times[key] - times[gap.start]) / seconds;
    let chord = gap.clone().map(|key| share(key + 1) - share(key)).fold(0.0, f64::max);
    for (key, spheres) in keys.iter_mut().enumerate().take(gap.end + 1).skip(gap.start) {
        let s = share(key);
        let own = (1.0 - s) * f64::from(from.radius) + s * f64::from(to.radius);
        let radius = rounded_up(own + bulge * (s * (1.0 - s) + 0.25 * chord * chord));
        let center = match key {
            key if key == gap.start => from.center,
            key if key == gap.end => to.center,
            _ => lerp(from.center(), to.center(), s).as_vec3().to_array(),
        };
        let here = &mut spheres[particle];
        // A row lies between two gaps: the larger of both.
        *here = Sphere { center, radius: radius.max(here.radius) };
    }
    Ok(())
}

/// The least `f32` that is not less.
fn rounded_up(radius: f64) -> f32 {
    let nearest = radius as f32;
    if f64::from(nearest) < radius { nearest.next_up() } else { nearest }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::*;

    fn row(center: DVec3) -> Sphere {
        Sphere { center: center.as_vec3().to_array(), radius: 0.25 }
    }

    fn point(k: usize) -> DVec3 {
        let s = k as f64;
        DVec3::new((0.7 * s).sin(), (0.3 * s).cos(), 0.1 * s)
    }

    proptest! {
        #[test]
        fn a_particle_never_leaves_its_ball(
            steps in prop::collection::vec((0.2..2.0, prop::array::uniform3(-1.0..1.0)), 1..60),
            seen in prop::collection::vec(any::<bool>(), 60),
            by_speed: bool,
        ) {
            // A path of many small pieces: speed at most 1, or acceleration at most 1.
            let (mut place, mut velocity, mut times) = (DVec3::ZERO, DVec3::ZERO, vec![0.0]);
            let mut places = vec![place];
            // Positions between key frames, with their times.
            let mut path = Vec::new();
            for (duration, push) in steps {
                let push = DVec3::from_array(push).clamp_length_max(1.0);
                for _ in 0..16 {
                    let dt: f64 = duration / 16.0;
                    if by_speed {
                        place += dt * push;
                    } else {
                        place += dt * velocity + 0.5 * dt * dt * push;
                        velocity += dt * push;
                    }
                    path.push((times.len() - 1, path.len() % 16 + 1, place));
                }
                times.push(times[times.len() - 1] + duration);
                places.push(place);
            }
            let last = times.len() - 1;
            let is_row = |key: usize| key == 0 || seen[key % seen.len()] || (!by_speed && key == last);
            let mut keys: Vec<Vec<Sphere>> = (0..times.len())
                .map(|key| vec![if is_row(key) { row(places[key]) } else { Sphere::ABSENT }])
                .collect();
            let reach = Reach {
                speed: if by_speed { 1.0 } else { f64::INFINITY },
                acceleration: if by_speed { f64::INFINITY } else { 1.0 },
            };
            grow(&mut keys, &times, &[reach]).unwrap();
            let farthest = places.iter().map(|p| p.abs().max_element()).fold(1.0, f64::max);
            for (state, sixteenth, place) in path {
                let t = sixteenth as f64 / 16.0;
                let (a, b) = (keys[state][0], keys[state + 1][0]);
                prop_assert!(a.is_present() && b.is_present());
                let center = lerp(a.center(), b.center(), t);
                let radius = (1.0 - t) * f64::from(a.radius) + t * f64::from(b.radius);
                // Half a unit in the last place of the rows, and of what lies between them.
                let slack = f64::from(f32::EPSILON) * 3.0 * farthest;
                let distance = (place - center).length();
                prop_assert!(distance + 0.25 <= radius + slack, "{distance} of {radius}");
            }
        }
    }

    #[test]
    fn a_ball_grows_behind_the_last_row_and_is_nowhere_before_the_first() {
        let mut keys = vec![vec![Sphere::ABSENT]; 5];
        keys[1][0] = row(point(1));
        let (times, speed) = ([0.0, 1.0, 2.0, 4.0, 4.5], 2.0);
        let reach = Reach { speed, acceleration: f64::INFINITY };
        grow(&mut keys, &times, &[reach]).unwrap();
        let radii: Vec<f32> = keys.iter().map(|k| k[0].radius).collect();
        assert_eq!(radii, [-1.0, 0.25, 2.25, 6.25, 7.25]);
    }

    #[test]
    fn what_accelerates_alone_ends_with_its_last_row() {
        let mut keys = vec![vec![Sphere::ABSENT]; 3];
        keys[0][0] = row(point(1));
        let reach = Reach { speed: f64::INFINITY, acceleration: 1.0 };
        grow(&mut keys, &[0.0, 1.0, 2.0], &[reach]).unwrap();
        assert!(!keys[1][0].is_present());
    }

    #[test]
    fn rows_that_are_too_far_apart_are_refused() {
        let mut keys = vec![vec![row(DVec3::ZERO)], vec![row(DVec3::new(3.0, 0.0, 0.0))]];
        let reach = Reach { speed: 1.0, acceleration: f64::INFINITY };
        let refused = grow(&mut keys, &[0.0, 2.0], &[reach]).unwrap_err();
        assert_eq!(refused, TooFast { particle: 0, from: 0.0, distance: 3.0, most: 2.0 });
    }
}
