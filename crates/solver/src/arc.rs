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
//! An arc is held between two lines parallel to its chord, a [`Band`]: mostly that is enough to tell who
//! of two is nearer. Where it is not, [`order`] looks where they may change places. Depths are
//! (A -+ sqrt(C)) / B with polynomials A, B, C (C = 0 for triangles and lines, B = 1 for spheres and lines),
//! so that is where a polynomial changes its sign:
//!
//! - two triangles: N1 D2 - N2 D1, of degree 5;
//! - a triangle and a sphere: (N - foot D)^2 - C D^2, of degree 6;
//! - two spheres, with the distance d of their feet: (C1 - C2 - d^2)^2 - 4 d^2 C2, of degree 4.
//!
//! Between two such places the depths in the middle decide. Where depths differ by less than the rounding
//! of both, the two are equal; equal on all of what they share, the lower number is nearer, else
//! what is beside it decides, as for lines. (The source excludes spheres that cross.)
//!
//! Derivation of the bands. *Rational*: with the chord c(t) between the exact ends, N - c D is a cubic
//! that is 0 at both ends, so at most 3/4 of the larger of its two inner coefficients, and |D| is at
//! least its least coefficient. *Sphere*: let g = k r^2 - |q x d|^2, h = sqrt(g) and l the chord of h;
//! h^2 - l^2 = v (1 - v) K on the stretch with K = (h1 - h0)^2 - (g0 - 2 g1 + g2), v in [0, 1] the place
//! on it, so h - l = v (1 - v) K / (h + l) <= min(sqrt(K) / 2, K / (8 min(h0, h1))).

use sightline_geometry::UNIT_ROUNDOFF;

use crate::{
    bernstein::{Polynomial, cubic, cubic_on, linear, quadratic, quadratic_on},
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
                    let bulge = least(bulge, whole);
                    // What moves fast may be far away at another time: here no depth is beyond this.
                    let top = least(largest(z0, z1) + bulge, self.far);
                    let noise = 2.0 * (n_error + top * d_error) * inverse;
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
                let low = least(least(g[0], g[1]), g[2]);
                let error = self.error + root_noise(low, *noise) * inverse;
                if *from_inside { (0.0, bulge, error) } else { (bulge, 0.0, error) }
            }
        };
        Band { z0, z1, below, above, error }
    }
}

/// What the root of a value v of a function is off by where that is off by `noise` either way: sqrt(v) -
/// sqrt(v - noise), without cancellation; the root of the noise where v is no more.
#[inline(always)]
fn root_noise(v: f64, noise: f64) -> f64 {
    if v > noise { noise / (v.sqrt() + (v - noise).sqrt()) } else { noise.sqrt() }
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
    /// room for what rounding breaks up.
    pub const MOST: usize = 10;
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
    /// Depth at `t` and its largest error, metres.
    fn depth(&self, t: f64) -> (f64, f64) {
        let Some(arc) = self.arc else { return (self.line.depth(t), self.line.above) };
        let z = arc.depth(t);
        let error = match &arc.shape {
            Shape::Rational { d, n_error, d_error, .. } => {
                let noise = 2.0 * (n_error + z * d_error) / quadratic(*d, t).abs();
                // NaN, where D is 0, becomes the whole.
                arc.error + if noise < arc.far - arc.near { noise } else { arc.far - arc.near }
            }
            Shape::Ball { g, noise, inverse, .. } => {
                arc.error + root_noise(quadratic(*g, t), *noise) * inverse
            }
        };
        (z, error)
    }

    /// Its depth as (A -+ sqrt(C)) / B on a stretch.
    fn on(&self, s: f64, e: f64) -> Terms {
        let none = (Polynomial::new(&[0.0]), 0.0);
        let one = (Polynomial::new(&[1.0]), 0.0);
        let Some(arc) = self.arc else {
            let a = Polynomial::new(&[self.line.depth(s), self.line.depth(e)]);
            return Terms { a: (a, self.line.above), b: one, c: none };
        };
        match &arc.shape {
            Shape::Rational { n, d, n_error, d_error } => Terms {
                a: (Polynomial::new(&cubic_on(*n, s, e)), *n_error),
                b: (Polynomial::new(&quadratic_on(*d, s, e)), *d_error),
                c: none,
            },
            Shape::Ball { foot, g, noise, inverse, .. } => {
                let a = Polynomial::new(&[linear(*foot, s), linear(*foot, e)]);
                let scale = inverse * inverse;
                let c = quadratic_on(*g, s, e).map(|g| g * scale);
                Terms { a: (a, arc.error), b: one, c: (Polynomial::new(&c), noise * scale) }
            }
        }
    }

    fn is_ball(&self) -> bool {
        matches!(self.arc, Some(Arc { shape: Shape::Ball { .. }, .. }))
    }
}

/// A polynomial and the largest error of a value.
type Noisy = (Polynomial, f64);

/// A depth as (A -+ sqrt(C)) / B.
struct Terms {
    a: Noisy,
    b: Noisy,
    c: Noisy,
}

fn times(p: &Noisy, q: &Noisy) -> Noisy {
    let (x, y) = (p.0.size(), q.0.size());
    let rounding = 16.0 * UNIT_ROUNDOFF * x * y;
    (p.0.times(&q.0), p.1 * y + q.1 * x + p.1 * q.1 + rounding)
}

fn minus(p: &Noisy, q: &Noisy) -> Noisy {
    let rounding = 16.0 * UNIT_ROUNDOFF * (p.0.size() + q.0.size());
    (p.0.minus(&q.0), p.1 + q.1 + rounding)
}

/// A polynomial that changes its sign wherever the two change places.
fn meeting(a: &Curve, b: &Curve, s: f64, e: f64) -> Noisy {
    let (p, q) = (a.on(s, e), b.on(s, e));
    match (a.is_ball(), b.is_ball()) {
        (false, false) => minus(&times(&p.a, &q.b), &times(&q.a, &p.b)),
        (true, true) => {
            let apart = minus(&p.a, &q.a);
            let square = times(&apart, &apart);
            let rest = minus(&minus(&p.c, &q.c), &square);
            let four = (Polynomial::new(&[4.0]), 0.0);
            minus(&times(&rest, &rest), &times(&four, &times(&square, &q.c)))
        }
        (ball_first, _) => {
            let (ball, other) = if ball_first { (p, q) } else { (q, p) };
            let off = minus(&other.a, &times(&ball.a, &other.b));
            let square = times(&other.b, &other.b);
            minus(&times(&off, &off), &times(&ball.c, &square))
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
    let sign = |t: f64| {
        let ((p, p_error), (q, q_error)) = (a.depth(t), b.depth(t));
        let (difference, noise) = (p - q, p_error + q_error);
        i32::from(difference > noise) - i32::from(difference < -noise)
    };
    let with_ball = a.is_ball() || b.is_ball();
    if with_ball {
        // Where a sphere comes into sight it is steep, and what it passes there is passed at once.
        (0..NEAR_ENDS).rev().for_each(|k| runs.push(from + share_of(k) * (to - from), from, &sign));
    }
    // One entry a level, and one more.
    let mut stack = [(from, to, 0); LEVELS + 2];
    let mut open = usize::from(from < to && !are_one(&a, &b));
    while open > 0 {
        open -= 1;
        let (s, e, level) = stack[open];
        let (meeting, noise) = meeting(&a, &b, s, e);
        let mut borders = [e; Polynomial::MOST + 2];
        let mut count = 0;
        let certain = meeting.sign_changes(noise, |at| {
            if count <= Polynomial::MOST {
                borders[count] = s + at * (e - s);
                count += 1;
            }
        });
        // A sphere's polynomial has more than one factor: noise that is nothing beside one of them may
        // hide another. On shorter stretches all are smaller.
        if !certain && level < LEVELS && with_ball {
            let middle = 0.5 * (s + e);
            stack[open] = (middle, e, level + 1);
            stack[open + 1] = (s, middle, level + 1);
            open += 2;
            continue;
        }
        let mut from = s;
        for &to in &borders[..=count] {
            if from < to {
                // A change that hides in the noise shows at one of these.
                for share in [1.0 / 64.0, 0.5, 63.0 / 64.0] {
                    runs.push(from + share * (to - from), from, &sign);
                }
            }
            from = to;
        }
    }
    if with_ball {
        (0..NEAR_ENDS).for_each(|k| runs.push(to - share_of(k) * (to - from), from, &sign));
    }
    runs.order(lower_wins)
}

/// Places close to each end of a stretch at which two are compared.
const NEAR_ENDS: i32 = 40;

/// How far from the end they are, as a share of the stretch: under a 256th of it, each half as far as the
/// one before.
fn share_of(k: i32) -> f64 {
    2.0f64.powi(-9 - k)
}

/// Halvings of a stretch on which a sphere's polynomial is noise.
const LEVELS: usize = 8;

/// True for two spheres that are one: equal wherever both are.
fn are_one(a: &Curve, b: &Curve) -> bool {
    let (Some(a), Some(b)) = (a.arc, b.arc) else { return false };
    match (&a.shape, &b.shape) {
        (
            Shape::Ball { foot: p, g, from_inside, .. },
            Shape::Ball { foot: q, g: h, from_inside: other, .. },
        ) => (p, g, from_inside) == (q, h, other),
        _ => false,
    }
}

/// Stretches with the sign of the difference; what is equal, between.
#[derive(Default)]
struct Runs {
    first: i32,
    last: i32,
    /// Where the last sign was seen.
    seen: f64,
    count: usize,
    changes: [f64; Order::MOST],
}

impl Runs {
    /// Looks at `t`, later than before. `border` is where the sign should change if that is between: if one
    /// of the two is nearer there for certain, the polynomial's noise has hidden the place, and it is looked
    /// for by halving.
    fn push(&mut self, t: f64, border: f64, sign_at: &impl Fn(f64) -> i32) {
        let sign = sign_at(t);
        if sign == 0 || t <= self.seen {
            return;
        }
        if self.last == 0 {
            self.first = sign;
        } else if self.last != sign && self.count < Order::MOST {
            let (mut before, mut behind) = (self.seen, t);
            let mut change = if before < border { border } else { 0.5 * (before + behind) };
            // Stops where neither is certain, or at a rounding.
            for _ in 0..60 {
                match sign_at(change) {
                    0 => break,
                    s if s == sign => behind = change,
                    _ => before = change,
                }
                change = 0.5 * (before + behind);
            }
            self.changes[self.count] = change;
            self.count += 1;
        }
        (self.last, self.seen) = (sign, t);
    }

    fn order(self, lower_wins: bool) -> Order {
        let first = if self.first == 0 { lower_wins } else { self.first < 0 };
        Order { first, count: self.count, changes: self.changes }
    }
}
