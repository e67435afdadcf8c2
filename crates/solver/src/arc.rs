//! Depth over t of what moves or is round, along one ray direction: an arc where a static cut has a
//! line.
//!
//! - *A triangle whose corners move* is at depth N(t) / D(t): with its normal n(t) (a quadratic, as the
//!   edges are linear) and a corner q(t) relative to the camera, N = n . q is a cubic and D = n . d a
//!   quadratic. D is the sum of the three edge functions, so it has no root where the triangle
//!   covers the ray. (The source speaks of parabola arcs; the depth is rational.)
//! - *A sphere* with centre q(t) and radius r(t) is at (q . d -+ sqrt(k r^2 - |q x d|^2)) / k with
//!   k = d . d: seen from outside it is the smaller, a convex function of t, since the points of
//!   (t, depth) that are inside of the ball are a convex set; from inside the larger, a concave one.
//!
//! An arc is held between two lines parallel to its chord, a [`Band`]. Over a stretch that is split,
//! bands get thinner with the square of its length, so who is nearer, and where that changes, is
//! found by splitting until bands do not overlap: [`order`]. Where depths differ by less than the
//! rounding of both, the two are equal there; equal on all of what they share, the lower number is
//! nearer, else what is beside it decides, as for lines.
//!
//! Derivation of the bands. *Rational*: with the chord c(t) between the exact ends, N - c D is a cubic
//! that is 0 at both ends, so at most 3/4 of the larger of its two inner coefficients, and |D| is at
//! least its least coefficient. *Sphere*: let g = k r^2 - |q x d|^2, h = sqrt(g) and l the chord of h;
//! h^2 - l^2 = v (1 - v) K on the stretch with K = (h1 - h0)^2 - (g0 - 2 g1 + g2), v in [0, 1] the place
//! on it, so h - l = v (1 - v) K / (h + l) <= min(sqrt(K) / 2, K / (8 min(h0, h1))).

use sightline_geometry::UNIT_ROUNDOFF;

use crate::{
    bernstein::{cubic, cubic_on, linear, quadratic, quadratic_on},
    envelope::{Line, largest, least},
};

/// Depth over t, t in [0, 1] the whole segment.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    /// N / D, Bernstein coefficients; |D| > 0 where the triangle covers the ray.
    Rational {
        /// Coefficients of N.
        n: [f64; 4],
        /// Coefficients of D.
        d: [f64; 3],
        /// Largest error of a value of N.
        n_error: f64,
        /// Largest error of a value of D.
        d_error: f64,
    },
    /// A sphere.
    Ball {
        /// Depth of the foot of its centre on the ray.
        foot: [f64; 2],
        /// g: positive where the ray meets it.
        g: [f64; 3],
        /// 1 / k.
        inverse: f64,
        /// True when it is seen from inside.
        from_inside: bool,
    },
}

/// An arc, where it covers its ray.
#[derive(Clone, Copy, Debug)]
pub struct Arc {
    /// Depth over t.
    pub shape: Shape,
    /// No depth is less, metres.
    pub near: f64,
    /// No depth is larger, metres.
    pub far: f64,
    /// Largest rounding error of a depth at exact t, metres.
    pub error: f64,
    /// Largest error of the ends of the stretch that it covers, in units of t.
    pub time_error: f64,
}

/// An arc on a stretch of t: between two lines parallel to its chord.
#[derive(Clone, Copy, Debug)]
pub struct Band {
    /// Depth at the start.
    pub z0: f64,
    /// Depth at the end.
    pub z1: f64,
    /// The arc is at most so much nearer than its chord, metres.
    pub below: f64,
    /// The arc is at most so much farther than its chord, metres.
    pub above: f64,
    /// Rounding error of all depths, metres.
    pub error: f64,
}

impl Arc {
    /// Depth at `t`, metres.
    #[must_use]
    pub fn depth(&self, t: f64) -> f64 {
        let z = match &self.shape {
            Shape::Rational { n, d, .. } => cubic(*n, t) / quadratic(*d, t),
            Shape::Ball { foot, g, inverse, from_inside } => {
                let half = largest(quadratic(*g, t), 0.0).sqrt() * inverse;
                linear(*foot, t) + if *from_inside { half } else { -half }
            }
        };
        // NaN, where N and D are 0, becomes the far end.
        if z > self.near {
            least(z, self.far)
        } else if z <= self.near {
            self.near
        } else {
            self.far
        }
    }

    /// The band on `s..e`.
    #[must_use]
    pub fn band(&self, s: f64, e: f64) -> Band {
        let (z0, z1) = (self.depth(s), self.depth(e));
        let whole = self.far - self.near;
        let (below, above, error) = match &self.shape {
            Shape::Rational { n, d, n_error, d_error } => {
                let (n, d) = (cubic_on(*n, s, e), quadratic_on(*d, s, e));
                let least_d = least(least(d[0].abs(), d[1].abs()), d[2].abs());
                let one_sign = (d[0] > 0.0) == (d[1] > 0.0) && (d[1] > 0.0) == (d[2] > 0.0);
                if !one_sign || least_d <= 2.0 * d_error {
                    (whole, whole, self.error)
                } else {
                    let inner = [
                        n[1] - (2.0 * z0 * d[1] + z1 * d[0]) / 3.0,
                        n[2] - (z0 * d[2] + 2.0 * z1 * d[1]) / 3.0,
                    ];
                    let inverse = 1.0 / (least_d - d_error);
                    let bulge = 0.75 * largest(inner[0].abs(), inner[1].abs()) * inverse;
                    let noise = 2.0 * (n_error + self.far * d_error) * inverse;
                    let bulge = least(bulge + noise, whole);
                    (bulge, bulge, self.error + least(noise, whole))
                }
            }
            Shape::Ball { g, inverse, from_inside, .. } => {
                let g = quadratic_on(*g, s, e);
                let root = |v: f64| largest(v, 0.0).sqrt();
                let (h0, h1) = (root(g[0]), root(g[2]));
                let k = largest((h1 - h0) * (h1 - h0) - (g[0] - 2.0 * g[1] + g[2]), 0.0);
                let bulge = least(0.5 * k.sqrt(), k / (8.0 * least(h0, h1))) * inverse;
                if *from_inside { (0.0, bulge, self.error) } else { (bulge, 0.0, self.error) }
            }
        };
        Band { z0, z1, below, above, error }
    }
}

/// Who is nearer, stretch by stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Order {
    /// True when the first of two is nearer at the start.
    pub first: bool,
    /// Number of changes.
    pub count: usize,
    /// Where the other becomes the nearer one, ascending.
    pub changes: [f64; Order::MOST],
}

impl Order {
    /// Two rational depths cross at most five times, a sphere and such a depth six times; the rest is
    /// room for touches that rounding breaks up.
    pub const MOST: usize = 12;
}

/// A line or an arc.
#[derive(Clone, Copy)]
pub struct Curve<'a> {
    /// Where it covers the ray, and its chord.
    pub line: &'a Line,
    /// What bends, if it does.
    pub arc: Option<&'a Arc>,
}

impl Curve<'_> {
    fn band(&self, s: f64, e: f64) -> Band {
        match self.arc {
            Some(arc) => arc.band(s, e),
            None => {
                let (z0, z1) = (self.line.depth(s), self.line.depth(e));
                Band { z0, z1, below: 0.0, above: 0.0, error: self.line.above }
            }
        }
    }
}

/// Who of two is nearer over all of the stretch that both cover: a function of the two alone.
/// `lower_wins` is true when the first is nearer where both are equal.
#[must_use]
pub fn order(a: Curve, b: Curve, lower_wins: bool) -> Order {
    let (from, to) = (largest(a.line.start, b.line.start), least(a.line.end, b.line.end));
    let (from, to) = (largest(from, 0.0), least(to, 1.0));
    let mut runs = Runs::default();
    // No stretch is split to less than this: neither ends nor depths have a meaning there.
    let shortest = 16.0 * UNIT_ROUNDOFF;
    let mut stack = [(0.0, 0.0); 64];
    stack[0] = (from, to);
    let mut open = usize::from(from < to);
    while open > 0 {
        open -= 1;
        let (s, e) = stack[open];
        let (p, q) = (a.band(s, e), b.band(s, e));
        let (d0, d1) = (p.z0 - q.z0, p.z1 - q.z1);
        let (below, above) = (p.below + q.above, p.above + q.below);
        let noise = p.error + q.error;
        if largest(d0, d1) + above < -noise {
            runs.push(s, e, -1);
            continue;
        }
        if least(d0, d1) - below > noise {
            runs.push(s, e, 1);
            continue;
        }
        let certain = |d: f64| i32::from(d > noise) - i32::from(d < -noise);
        let (at_s, at_e) = (certain(d0), certain(d1));
        let bulge = below + above;
        // Bands as thin as rounding: lines.
        if bulge <= noise || e - s <= shortest || open + 3 > stack.len() {
            match (at_s, at_e) {
                (0, 0) => runs.push(s, e, 0),
                (x, y) if x * y < 0 => {
                    let t = least(largest(s + (e - s) * (d0 / (d0 - d1)), s), e);
                    runs.push(s, t, x);
                    runs.push(t, e, y);
                }
                (x, y) => runs.push(s, e, x + y),
            }
            continue;
        }
        let slope = (d1 - d0) / (e - s);
        let crossing = s - d0 / slope;
        let reach = 1.5 * (bulge + noise) / slope.abs();
        let (left, right) = (crossing - reach, crossing + reach);
        if at_s * at_e < 0 && s < left && right < e && right - left < 0.5 * (e - s) {
            stack[open..open + 3].copy_from_slice(&[(right, e), (left, right), (s, left)]);
            open += 3;
        } else {
            let middle = 0.5 * (s + e);
            stack[open..open + 2].copy_from_slice(&[(middle, e), (s, middle)]);
            open += 2;
        }
    }
    runs.order(lower_wins)
}

/// Stretches with the sign of the difference; what is equal, between.
#[derive(Default)]
struct Runs {
    first: i32,
    last: i32,
    /// Since when it is equal.
    equal_since: Option<f64>,
    count: usize,
    changes: [f64; Order::MOST],
}

impl Runs {
    fn push(&mut self, s: f64, _e: f64, sign: i32) {
        let sign = sign.signum();
        if sign == 0 {
            self.equal_since.get_or_insert(s);
            return;
        }
        if self.last == 0 {
            self.first = sign;
        } else if self.last != sign {
            // In the middle of where both are equal.
            let at = self.equal_since.map_or(s, |since| 0.5 * (since + s));
            if self.count < Order::MOST {
                self.changes[self.count] = at;
                self.count += 1;
            } else {
                // Two more that touch: they take the last change back.
                self.count -= 1;
            }
        }
        self.last = sign;
        self.equal_since = None;
    }

    fn order(self, lower_wins: bool) -> Order {
        let first = if self.first == 0 { lower_wins } else { self.first < 0 };
        Order { first, count: self.count, changes: self.changes }
    }
}
