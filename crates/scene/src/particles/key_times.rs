//! Times of key frames: one list for the scene from the lists of its parts, and what the parts look
//! like at times that are not their own.
//!
//! Motion is linear between the key frames of a part, so more key frames change nothing but the
//! rounding of the positions at the new ones to `f32`. Before its first key frame a part stands as
//! at the first, behind its last as at the last.

use sightline_geometry::{Sphere, motion::lerp};

/// Most key frames of a scene: 36 minutes at 30 a second.
pub const KEY_FRAMES_MAX: usize = 1 << 16;

/// The key frames of a scene whose parts have the given ones: their union, ascending. Parts with
/// fewer than two key frames rest and add nothing; a scene of nothing else has the one key frame 0.
/// Times are finite.
#[must_use]
pub fn merge_key_times(parts: &[&[f64]]) -> Vec<f64> {
    let mut all: Vec<f64> =
        parts.iter().filter(|times| times.len() > 1).copied().flatten().copied().collect();
    if all.is_empty() {
        return vec![0.0];
    }
    all.sort_by(f64::total_cmp);
    all.dedup_by(|a, b| a == b);
    all
}

/// Spheres with key frames at ascending `times`, at other ascending times. What has one key frame
/// rests and keeps it.
///
/// A particle is there between two key frames when it is at both; so at a time between them, and
/// the states that meet there are those in which it was there before.
///
/// # Panics
/// Without a key frame, or when `times` and `keys` have different lengths.
#[must_use]
pub fn resample(times: &[f64], keys: Vec<Vec<Sphere>>, at: &[f64]) -> Vec<Vec<Sphere>> {
    assert_eq!(times.len(), keys.len(), "every key frame has a time");
    if keys.len() == 1 || times == at {
        return keys;
    }
    // Key frames are dropped when they are passed, so that no second copy of all is held.
    let mut rest = times.iter().copied().zip(keys);
    let Some((mut from_time, mut from)) = rest.next() else {
        panic!("there is a key frame");
    };
    let mut next = rest.next();
    let mut out = Vec::with_capacity(at.len());
    for &time in at {
        while let Some((passed, keys)) = next.take_if(|(next_time, _)| *next_time <= time) {
            (from_time, from) = (passed, keys);
            next = rest.next();
        }
        out.push(match &next {
            Some((to_time, to)) if time > from_time => {
                let t = (time - from_time) / (to_time - from_time);
                from.iter().zip(to).map(|(a, b)| between(*a, *b, t)).collect()
            }
            _ => from.clone(),
        });
    }
    out
}

/// A sphere between two key frames, at `t` in [0, 1].
fn between(from: Sphere, to: Sphere, t: f64) -> Sphere {
    if !from.is_present() || !to.is_present() {
        return Sphere::ABSENT;
    }
    let center = lerp(from.center(), to.center(), t).as_vec3().to_array();
    let radius = (1.0 - t) * f64::from(from.radius) + t * f64::from(to.radius);
    Sphere { center, radius: radius as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f32) -> Sphere {
        Sphere { center: [x, 0.0, 0.0], radius: 1.0 + x }
    }

    #[test]
    fn the_key_frames_of_a_scene_are_those_of_all_that_moves() {
        assert_eq!(merge_key_times(&[]), [0.0]);
        assert_eq!(merge_key_times(&[&[5.0], &[]]), [0.0]);
        assert_eq!(
            merge_key_times(&[&[0.0, 1.0, 2.0], &[7.0], &[0.5, 1.0, 3.0], &[-0.0, 2.0]]),
            [0.0, 0.5, 1.0, 2.0, 3.0]
        );
    }

    #[test]
    fn more_key_frames_do_not_change_the_motion() {
        let times = [1.0, 2.0, 4.0];
        let keys = vec![vec![at(0.0)], vec![at(8.0)], vec![at(4.0)]];
        let found = resample(&times, keys, &[0.0, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 9.0]);
        let xs: Vec<f32> = found.iter().map(|k| k[0].center[0]).collect();
        assert_eq!(xs, [0.0, 0.0, 2.0, 4.0, 8.0, 6.0, 4.0, 4.0]);
        assert!(found.iter().all(|k| k[0].radius == 1.0 + k[0].center[0]));
    }

    #[test]
    fn a_particle_is_there_in_the_same_states_as_before() {
        let keys = vec![vec![at(0.0)], vec![at(1.0)], vec![Sphere::ABSENT], vec![at(3.0)]];
        let found = resample(&[0.0, 1.0, 2.0, 3.0], keys, &[0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]);
        let there: Vec<bool> = found.iter().map(|k| k[0].is_present()).collect();
        assert_eq!(there, [true, true, true, false, false, false, true]);
    }

    #[test]
    fn what_rests_keeps_its_key_frame() {
        assert_eq!(resample(&[3.0], vec![vec![at(1.0)]], &[0.0, 1.0]), [[at(1.0)]]);
    }
}
