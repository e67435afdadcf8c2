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
//! found by splitting until bands do not overlap: [`order`]. Arcs that run side by side would be split
//! without end; their difference decides, `side_by_side`. Where depths differ by less than the
//! rounding of both, the two are equal there; equal on all of what they share, the lower number is
//! nearer, else what is beside it decides, as for lines.
//!
//! What rounding does to a depth depends on where on the arc it is: N / D is uncertain where D is small, a
//! root where what it is of is. So a stretch on which that varies is split before it is called equal.
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
        /// Largest error of a value of g.
        noise: f64,
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
    /// False when parts of the stretch may have much less of that: where a triangle is seen edge-on at one
    /// end, D is small there and noise is large.
    pub even: bool,
}

impl Arc {
    /// Depth at `t`, metres.
    #[must_use]
    pub fn depth(&self, t: f64) -> f64 {
        let z = match &self.shape {
            Shape::Rational { n, d, .. } => cubic(*n, t) / quadratic(*d, t),
            Shape::Ball { foot, g, inverse, from_inside, .. } => {
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
        let mut even = true;
        let (below, above, error) = match &self.shape {
            Shape::Rational { n, d, n_error, d_error } => {
                let (n, d) = (cubic_on(*n, s, e), quadratic_on(*d, s, e));
                let least_d = least(least(d[0].abs(), d[1].abs()), d[2].abs());
                let largest_d = largest(largest(d[0].abs(), d[1].abs()), d[2].abs());
                let one_sign = (d[0] > 0.0) == (d[1] > 0.0) && (d[1] > 0.0) == (d[2] > 0.0);
                if largest_d <= 4.0 * d_error {
                    // D is rounding all over: no part of the stretch tells more than the corners do.
                    (0.0, 0.0, self.error + whole)
                } else if !one_sign || least_d <= 2.0 * d_error {
                    even = false;
                    (whole, whole, self.error)
                } else {
                    let inner = [
                        n[1] - (2.0 * z0 * d[1] + z1 * d[0]) / 3.0,
                        n[2] - (z0 * d[2] + 2.0 * z1 * d[1]) / 3.0,
                    ];
                    let inverse = 1.0 / (least_d - d_error);
                    let bulge = 0.75 * largest(inner[0].abs(), inner[1].abs()) * inverse;
                    let bulge = least(bulge, whole);
                    // What moves fast may be far away at another time: here no depth is beyond this.
                    let top = least(largest(z0, z1) + bulge, self.far);
                    let noise = 2.0 * (n_error + top * d_error) * inverse;
                    let like = top * d_error <= *n_error || top <= 2.0 * least(z0, z1);
                    even = noise <= self.error || (largest_d <= 2.0 * least_d && like);
                    (bulge, bulge, self.error + least(noise, whole))
                }
            }
            Shape::Ball { g, noise, inverse, from_inside, .. } => {
                let g = quadratic_on(*g, s, e);
                let root = |v: f64| largest(v, 0.0).sqrt();
                let (h0, h1) = (root(g[0]), root(g[2]));
                let k = largest((h1 - h0) * (h1 - h0) - (g[0] - 2.0 * g[1] + g[2]), 0.0);
                // A cone: k and h are 0 where the camera is at its tip.
                let bulge =
                    if k > 0.0 { least(0.5 * k.sqrt(), k / (8.0 * least(h0, h1))) } else { 0.0 };
                let bulge = bulge * inverse;
                // A root of g is off by noise / (2 sqrt(g)), or the root of noise where g is no more.
                let (low, high) =
                    (least(least(g[0], g[1]), g[2]), largest(largest(g[0], g[1]), g[2]));
                let off = if low > *noise { noise / low.sqrt() } else { noise.sqrt() };
                let error = self.error + off * inverse;
                even = off * inverse <= self.error || high <= 16.0 * largest(low, *noise);
                if *from_inside { (0.0, bulge, error) } else { (bulge, 0.0, error) }
            }
        };
        Band { z0, z1, below, above, error, even }
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
                Band { z0, z1, below: 0.0, above: 0.0, error: self.line.above, even: true }
            }
        }
    }
}

/// N, D and their errors on a stretch, Bernstein coefficients.
type OnStretch = ([f64; 4], [f64; 3], f64, f64);

impl Curve<'_> {
    /// A line, or the depth of a triangle, as a quotient on `s..e`.
    fn quotient(&self, s: f64, e: f64) -> Option<OnStretch> {
        match self.arc.map(|arc| &arc.shape) {
            None => {
                let (a, b) = (self.line.depth(s), self.line.depth(e));
                let n = [a, (2.0 * a + b) / 3.0, (a + 2.0 * b) / 3.0, b];
                Some((n, [1.0; 3], 4.0 * UNIT_ROUNDOFF * largest(a, b), 0.0))
            }
            Some(Shape::Rational { n, d, n_error, d_error }) => {
                Some((cubic_on(*n, s, e), quadratic_on(*d, s, e), *n_error, *d_error))
            }
            Some(Shape::Ball { .. }) => None,
        }
    }
}

/// The sign of the difference of two depths all over `s..e`, where that is certain; 0 where both are equal
/// within their bounds. `error` is that of both depths at exact N and D, `noise` that of their bands.
///
/// Two arcs that run side by side have bands that overlap until both are as thin as they are apart, which
/// is never for two triangles of one plane. Their difference does not bend: of quotients it has the sign
/// of `N D' - N' D`, of degree 5, times that of `D D'`; that of two spheres is that of their feet, and that
/// of their g by the sum of the roots.
fn side_by_side(a: Curve, b: Curve, (s, e): (f64, f64), error: f64, noise: f64) -> Option<i32> {
    if let (Some(a), Some(b)) = (a.arc, b.arc)
        && let (
            Shape::Ball { foot: f, g, inverse, from_inside, .. },
            Shape::Ball { foot: k, g: h, from_inside: other, .. },
        ) = (&a.shape, &b.shape)
    {
        let (g, h) = (quadratic_on(*g, s, e), quadratic_on(*h, s, e));
        let ends = |v: &[f64]| {
            v.iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |m, v| (least(m.0, *v), largest(m.1, *v)))
        };
        let feet = ends(&[linear(*f, s) - linear(*k, s), linear(*f, e) - linear(*k, e)]);
        let (in_g, in_h) = (ends(&g), ends(&h));
        if from_inside != other || least(in_g.0, in_h.0) <= 0.0 {
            let same = feet == (0.0, 0.0) && g == h && from_inside == other;
            return same.then_some(0);
        }
        // sqrt(g) - sqrt(h) = (g - h) / (sqrt(g) + sqrt(h)).
        let apart = ends(&[g[0] - h[0], g[1] - h[1], g[2] - h[2]]);
        let sums = (in_g.0.sqrt() + in_h.0.sqrt(), in_g.1.sqrt() + in_h.1.sqrt());
        let high = apart.1 * inverse / if apart.1 > 0.0 { sums.0 } else { sums.1 };
        let low = apart.0 * inverse / if apart.0 < 0.0 { sums.0 } else { sums.1 };
        let (low, high) = if *from_inside { (low, high) } else { (-high, -low) };
        let (low, high) = (feet.0 + low, feet.1 + high);
        return if low > noise {
            Some(1)
        } else if high < -noise {
            Some(-1)
        } else {
            (low >= -noise && high <= noise).then_some(0)
        };
    }
    let (n, d, n_error, d_error) = a.quotient(s, e)?;
    let (m, f, m_error, f_error) = b.quotient(s, e)?;
    let size = |of: &[f64]| of.iter().fold(0.0, |most, v| largest(most, v.abs()));
    let (d_size, f_size) = (size(&d), size(&f));
    let one_sign = |v: &[f64; 3]| (v[0] > 0.0) == (v[1] > 0.0) && (v[1] > 0.0) == (v[2] > 0.0);
    if !one_sign(&d) || !one_sign(&f) {
        return None;
    }
    // C(3, i) C(2, j) / C(5, i + j).
    let p = |i: usize, j: usize| n[i] * f[j] - m[i] * d[j];
    let difference = [
        p(0, 0),
        (2.0 * p(0, 1) + 3.0 * p(1, 0)) / 5.0,
        (p(0, 2) + 6.0 * p(1, 1) + 3.0 * p(2, 0)) / 10.0,
        (3.0 * p(1, 2) + 6.0 * p(2, 1) + p(3, 0)) / 10.0,
        (3.0 * p(2, 2) + 2.0 * p(3, 1)) / 5.0,
        p(3, 2),
    ];
    let most = error * d_size * f_size
        + n_error * f_size
        + size(&n) * f_error
        + m_error * d_size
        + size(&m) * d_error;
    let sign = if (d[0] > 0.0) == (f[0] > 0.0) { 1 } else { -1 };
    if difference.iter().all(|v| v.abs() <= most) {
        Some(0)
    } else if difference.iter().all(|v| *v > most) {
        Some(sign)
    } else if difference.iter().all(|v| *v < -most) {
        Some(-sign)
    } else {
        None
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
    // Nor are more stretches looked at: a hundred or two are many.
    let mut left = 1 << 14;
    // What both are off by, whatever D is.
    let base = [a, b].map(|c| c.arc.map_or(c.line.above, |arc| arc.error));
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
        if p.even
            && q.even
            && let Some(sign) = side_by_side(a, b, (s, e), base[0] + base[1], noise)
        {
            runs.push(s, e, sign);
            continue;
        }
        let certain = |d: f64| i32::from(d > noise) - i32::from(d < -noise);
        let (at_s, at_e) = (certain(d0), certain(d1));
        let bulge = below + above;
        let thin = bulge <= 0.5 * noise && p.even && q.even;
        left -= 1;
        // Bands as thin as rounding: lines.
        if thin || e - s <= shortest || open + 3 > stack.len() || left <= 0 {
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
