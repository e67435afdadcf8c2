//! Animation samplers: a property's value at a time, and how much it bends.
//!
//! Source: Khronos, "glTF 2.0 Specification", section 3.11 and appendix C.
//! Between the keys k and k + 1 at times t_k and t_k+1, h = t_k+1 - t_k, u = (t - t_k) / h:
//!
//! - STEP: v_k.
//! - LINEAR: (1 - u) v_k + u v_k+1. Rotations turn at constant speed: with a = acos |v_k . v_k+1|
//!   and s the sign of v_k . v_k+1, sin(a (1 - u)) / sin a v_k + s sin(a u) / sin a v_k+1.
//! - CUBICSPLINE: (2u^3 - 3u^2 + 1) v_k + h (u^3 - 2u^2 + u) b_k + (3u^2 - 2u^3) v_k+1
//!   + h (u^3 - u^2) a_k+1, with in-tangents a and out-tangents b. Rotations are normalized.
//!
//! Before the first key and behind the last one their values are held.
//!
//! Invariants: times are finite, not negative and ascend; there is at least one; values are finite
//! and as many as the keys ask for; rotations at keys are not zero.

use std::sync::Arc;

use glam::{DQuat, DVec4};

/// How values between keys are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Interpolation {
    Step,
    Linear,
    CubicSpline,
}

/// Bounds of the size of a quantity and of its first two derivatives by time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Jet {
    pub value: f64,
    pub first: f64,
    pub second: f64,
}

impl Jet {
    pub const fn constant(value: f64) -> Self {
        Self { value, first: 0.0, second: 0.0 }
    }

    /// Of a sum.
    pub fn plus(self, b: Self) -> Self {
        Self {
            value: self.value + b.value,
            first: self.first + b.first,
            second: self.second + b.second,
        }
    }

    /// Of the larger of two, at every time.
    pub fn max(self, b: Self) -> Self {
        Self {
            value: self.value.max(b.value),
            first: self.first.max(b.first),
            second: self.second.max(b.second),
        }
    }

    /// Of a bilinear product whose size is at most the product of the sizes.
    pub fn times(self, b: Self) -> Self {
        Self {
            value: self.value * b.value,
            first: self.first * b.value + self.value * b.first,
            second: self.second * b.value + 2.0 * self.first * b.first + self.value * b.second,
        }
    }
}

/// The values of one property over time.
#[derive(Clone, Debug)]
pub struct Sampler {
    interpolation: Interpolation,
    /// Numbers of a value.
    width: usize,
    /// Seconds.
    times: Arc<[f64]>,
    /// A value a key; in-tangent, value and out-tangent a key for splines.
    values: Arc<[f32]>,
}

/// Where a time lies.
enum At {
    /// The value of a key holds.
    Key(usize),
    /// Behind a key: u in (0, 1), and the distance h of the two keys.
    Behind(usize, f64, f64),
}

/// Below this angle rotations are mixed linearly: the difference, of the relative size a^2 / 6, is
/// less than the rounding of `f64`, and the sine in the denominator may be zero.
const SMALL_ANGLE: f64 = 1e-8;

/// Parts of a spline between two keys that are looked at for how short a quaternion gets.
const SPLINE_PARTS: usize = 64;

impl Sampler {
    /// The invariants of the module must hold.
    pub fn new(
        interpolation: Interpolation,
        width: usize,
        times: Arc<[f64]>,
        values: Arc<[f32]>,
    ) -> Self {
        let per_key = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        debug_assert_eq!(values.len(), times.len() * width * per_key);
        Self { interpolation, width, times, values }
    }

    /// Times of the keys, seconds.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Numbers of a value.
    pub fn width(&self) -> usize {
        self.width
    }

    /// The time of the last key, seconds.
    pub fn end(&self) -> f64 {
        self.times[self.times.len() - 1]
    }

    /// True when the value is the same at all times.
    pub fn is_constant(&self) -> bool {
        let keys = self.times.len();
        let straight = |k: usize| [0, 2].iter().all(|&p| self.part(k, p).iter().all(|&v| v == 0.0));
        (0..keys).all(|k| self.value(k) == self.value(0))
            && (keys == 1
                || self.interpolation != Interpolation::CubicSpline
                || (0..keys).all(straight))
    }

    /// Times at which the value jumps.
    pub fn jumps(&self) -> impl Iterator<Item = f64> + '_ {
        let steps = self.interpolation == Interpolation::Step;
        (1..self.times.len())
            .filter(move |&k| steps && self.value(k) != self.value(k - 1))
            .map(|k| self.times[k])
    }

    /// In-tangent (0), value (1) or out-tangent (2) of a key of a spline.
    fn part(&self, key: usize, part: usize) -> &[f32] {
        &self.values[(3 * key + part) * self.width..][..self.width]
    }

    /// The value of a key.
    fn value(&self, key: usize) -> &[f32] {
        match self.interpolation {
            Interpolation::CubicSpline => self.part(key, 1),
            _ => &self.values[key * self.width..][..self.width],
        }
    }

    fn at(&self, seconds: f64) -> At {
        let after = self.times.partition_point(|&t| t <= seconds);
        if after == 0 {
            return At::Key(0);
        }
        let key = after - 1;
        if after == self.times.len() || self.interpolation == Interpolation::Step {
            return At::Key(key);
        }
        let h = self.times[after] - self.times[key];
        match (seconds - self.times[key]) / h {
            0.0 => At::Key(key),
            u => At::Behind(key, u, h),
        }
    }

    /// One number of the value at a time.
    pub fn number(&self, component: usize, seconds: f64) -> f64 {
        let of = |part: &[f32]| f64::from(part[component]);
        match self.at(seconds) {
            At::Key(k) => of(self.value(k)),
            At::Behind(k, u, h) if self.interpolation == Interpolation::CubicSpline => {
                let (v, b) = (of(self.value(k)), of(self.part(k, 2)));
                let (w, a) = (of(self.value(k + 1)), of(self.part(k + 1, 0)));
                let (u2, u3) = (u * u, u * u * u);
                (2.0 * u3 - 3.0 * u2 + 1.0) * v
                    + h * (u3 - 2.0 * u2 + u) * b
                    + (3.0 * u2 - 2.0 * u3) * w
                    + h * (u3 - u2) * a
            }
            At::Behind(k, u, _) => (1.0 - u) * of(self.value(k)) + u * of(self.value(k + 1)),
        }
    }

    /// The value at a time.
    pub fn vector<const N: usize>(&self, seconds: f64) -> [f64; N] {
        std::array::from_fn(|component| self.number(component, seconds))
    }

    /// The value at a time as a rotation, of length 1.
    pub fn rotation(&self, seconds: f64) -> DQuat {
        match self.at(seconds) {
            At::Behind(k, u, _) if self.interpolation == Interpolation::Linear => {
                slerp(self.key_rotation(k), self.key_rotation(k + 1), u)
            }
            At::Behind(k, ..) => {
                let q = DQuat::from_array(self.vector(seconds)).normalize();
                // A spline that passes through zero has no direction there.
                if q.is_finite() { q } else { self.key_rotation(k) }
            }
            At::Key(k) => self.key_rotation(k),
        }
    }

    /// The rotation of a key: not zero, and its squares neither over- nor underflow in `f64`.
    fn key_rotation(&self, key: usize) -> DQuat {
        let q = self.value(key);
        DQuat::from_array(std::array::from_fn(|k| f64::from(q[k]))).normalize()
    }

    /// Bounds of the numbers in `components` taken as a vector, between two times that have no key
    /// between them.
    pub fn jet(&self, components: std::ops::Range<usize>, from: f64, to: f64) -> Jet {
        let norm = |number: &dyn Fn(usize) -> f64| {
            components.clone().map(number).map(|v| v * v).sum::<f64>().sqrt()
        };
        let of = |part: &[f32], c: usize| f64::from(part[c]);
        let k = match self.at(0.5 * (from + to)) {
            At::Key(k) => return Jet::constant(norm(&|c| of(self.value(k), c))),
            At::Behind(k, ..) => k,
        };
        let h = self.times[k + 1] - self.times[k];
        if self.interpolation == Interpolation::Linear {
            let ends = [from, to].map(|t| norm(&|c| self.number(c, t)));
            let change = norm(&|c| of(self.value(k + 1), c) - of(self.value(k), c));
            return Jet { value: ends[0].max(ends[1]), first: change / h, second: 0.0 };
        }
        // The control points of its Bezier form hold the curve in their hull, their differences its
        // derivatives.
        let control = |i: usize, c: usize| match i {
            0 => of(self.value(k), c),
            1 => of(self.value(k), c) + h / 3.0 * of(self.part(k, 2), c),
            2 => of(self.value(k + 1), c) - h / 3.0 * of(self.part(k + 1, 0), c),
            _ => of(self.value(k + 1), c),
        };
        let largest = |count: usize, f: &dyn Fn(usize, usize) -> f64| {
            (0..count).map(|i| norm(&|c| f(i, c))).fold(0.0, f64::max)
        };
        let first = |i: usize, c: usize| control(i + 1, c) - control(i, c);
        Jet {
            value: largest(4, &control),
            first: 3.0 / h * largest(3, &first),
            second: 6.0 / (h * h) * largest(2, &|i, c| first(i + 1, c) - first(i, c)),
        }
    }

    /// Bounds of the rotation as a linear map, between two times that have no key between them.
    ///
    /// A turn at speed w has the derivatives w and w^2. A spline q has the direction n = q / |q| with
    /// |n'| <= |q'| / |q| and |n''| <= 2 |q''| / |q| + 6 |q'|^2 / |q|^2, by the product rule with
    /// (1 / |q|)' = -(q . q') / |q|^3. The map v -> n v n* then has |R'| <= 2 |n'| and
    /// |R''| <= 2 |n''| + 2 |n'|^2.
    pub fn rotation_jet(&self, from: f64, to: f64) -> Jet {
        let k = match self.at(0.5 * (from + to)) {
            At::Key(_) => return Jet::constant(1.0),
            At::Behind(k, ..) => k,
        };
        if self.interpolation == Interpolation::Linear {
            let (half, _) = angle(self.key_rotation(k), self.key_rotation(k + 1));
            let speed = 2.0 * half / (self.times[k + 1] - self.times[k]);
            return Jet { value: 1.0, first: speed, second: speed * speed };
        }
        let q = self.jet(0..4, from, to);
        let part = (to - from) / SPLINE_PARTS as f64;
        let length = |i: usize| {
            let seconds = from + (i as f64 + 0.5) * part;
            DVec4::from_array(self.vector(seconds)).length()
        };
        let shortest = (0..SPLINE_PARTS).map(length).fold(f64::INFINITY, f64::min);
        // Every time is within half a part of one that was looked at. What may pass through zero
        // has no bound.
        let shortest = (shortest - 0.5 * part * q.first).max(0.0);
        let (a, b) = (q.first / shortest, q.second / shortest);
        let (first, second) = (a, 2.0 * b + 6.0 * a * a);
        if q.first == 0.0 {
            return Jet::constant(1.0);
        }
        Jet { value: 1.0, first: 2.0 * first, second: 2.0 * second + 2.0 * first * first }
    }
}

/// The angle between two quaternions of length 1 or their opposites, and 1 or -1 for which of them;
/// in [0, pi / 2]. Source: Kahan, "How Futile are Mindless Assessments of Roundoff" (2006), section
/// 12: exact for small angles too.
fn angle(from: DQuat, to: DQuat) -> (f64, f64) {
    let sign = if from.dot(to) < 0.0 { -1.0 } else { 1.0 };
    let near = to * sign;
    (2.0 * libm::atan2((from - near).length(), (from + near).length()), sign)
}

/// Between two rotations, the short way around, at constant speed.
fn slerp(from: DQuat, to: DQuat, u: f64) -> DQuat {
    let (a, sign) = angle(from, to);
    let (x, y) = if a < SMALL_ANGLE {
        (1.0 - u, u)
    } else {
        (libm::sin(a * (1.0 - u)) / libm::sin(a), libm::sin(a * u) / libm::sin(a))
    };
    (from * x + to * (sign * y)).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sampler(
        interpolation: Interpolation,
        width: usize,
        times: &[f64],
        values: &[f32],
    ) -> Sampler {
        Sampler::new(interpolation, width, times.into(), values.into())
    }

    #[test]
    fn steps_hold_the_value_of_the_key_before() {
        let s = sampler(Interpolation::Step, 1, &[1.0, 2.0, 4.0], &[5.0, 6.0, 6.0]);
        for (seconds, value) in [(0.0, 5.0), (1.0, 5.0), (1.999, 5.0), (2.0, 6.0), (9.0, 6.0)] {
            assert_eq!(s.number(0, seconds), value, "{seconds}");
        }
        assert_eq!(s.jumps().collect::<Vec<_>>(), [2.0]);
        assert!(!s.is_constant());
    }

    #[test]
    fn lines_join_the_keys_and_hold_behind_them() {
        let s = sampler(Interpolation::Linear, 2, &[1.0, 3.0], &[0.0, 10.0, 4.0, -10.0]);
        assert_eq!(s.vector::<2>(0.5), [0.0, 10.0]);
        assert_eq!(s.vector::<2>(1.5), [1.0, 5.0]);
        assert_eq!(s.vector::<2>(3.5), [4.0, -10.0]);
        assert_eq!(s.jet(0..1, 1.0, 3.0), Jet { value: 4.0, first: 2.0, second: 0.0 });
        assert_eq!(s.jet(0..1, 3.0, 4.0), Jet::constant(4.0));
    }

    #[test]
    fn splines_are_hermite_curves() {
        // In-tangent, value, out-tangent: from 1 with slope 3 to 2 with slope -1, over 2 s.
        let s =
            sampler(Interpolation::CubicSpline, 1, &[0.0, 2.0], &[9.0, 1.0, 3.0, -1.0, 2.0, 9.0]);
        // u = 1/2: 1/2 1 + 2/8 3 + 1/2 2 - 2/8 (-1).
        assert_eq!(s.number(0, 1.0), 2.5);
        assert_eq!((s.number(0, 0.0), s.number(0, 2.0)), (1.0, 2.0));
        let slope = (s.number(0, 1e-6) - 1.0) / 1e-6;
        assert!((slope - 3.0).abs() < 1e-4, "{slope}");
    }

    #[test]
    fn opposite_quaternions_are_the_same_rotation() {
        let s = sampler(
            Interpolation::Linear,
            4,
            &[0.0, 1.0],
            &[0.0, 0.0, 0.0, 2.0, 0.0, 0.0, -0.6, -0.8],
        );
        let half = s.rotation(0.5);
        // A third of the way by angle is the cosine of half of it.
        let expected = DQuat::from_xyzw(0.0, 0.0, 0.6, 0.8);
        assert!(half.dot(expected) > 0.9 && (half * half).dot(expected).abs() > 1.0 - 1e-7);
        assert!((s.rotation(0.0).w - 1.0).abs() < 1e-15);
    }

    #[test]
    fn a_spline_through_zero_still_gives_a_rotation() {
        let values = [
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, //
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0,
        ];
        let s = sampler(Interpolation::CubicSpline, 4, &[0.0, 1.0], &values);
        assert!((0..=100).all(|i| s.rotation(f64::from(i) / 100.0).is_finite()));
        assert!(!s.rotation_jet(0.0, 1.0).second.is_finite());
    }

    proptest! {
        /// Against differences of values: the bounds hold.
        #[test]
        fn jets_bound_value_and_derivatives(
            values in prop::collection::vec(-2.0f32..2.0, 24),
            spline in any::<bool>(),
            at in 0.01..0.98f64,
        ) {
            let mode = if spline { Interpolation::CubicSpline } else { Interpolation::Linear };
            let mut values = values[..if spline { 24 } else { 8 }].to_vec();
            for k in 0..2 {
                values[if spline { 12 * k + 7 } else { 4 * k + 3 }] = 3.0;
            }
            let s = sampler(mode, 4, &[0.0, 1.0], &values);
            let h = 1e-3;
            let derivatives = |f: &dyn Fn(f64) -> DVec4| {
                let (a, b, c) = (f(at), f(at + h), f(at + 2.0 * h));
                (b.length(), (c - a).length() / (2.0 * h), (a - 2.0 * b + c).length() / (h * h))
            };
            let jet = s.jet(0..4, 0.0, 1.0);
            let (value, first, second) = derivatives(&|t| DVec4::from_array(s.vector(t)));
            prop_assert!(value <= jet.value + 1e-9 && first <= jet.first + 1e-6);
            prop_assert!(second <= jet.second + 1e-4, "{second} > {}", jet.second);
            let turn = s.rotation_jet(0.0, 1.0);
            let (_, first, second) =
                derivatives(&|t| (s.rotation(t) * glam::DVec3::new(0.6, 0.0, 0.8)).extend(0.0));
            prop_assert!(first <= turn.first + 1e-6, "{first} > {}", turn.first);
            prop_assert!(second <= turn.second + 1e-4, "{second} > {}", turn.second);
        }
    }
}
