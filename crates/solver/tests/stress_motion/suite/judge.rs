//! Who is nearest at a time: in `f64` with a bound on every number, else in rational arithmetic; and
//! whether a bound explains another answer.
//!
//! The formulas are those of the exact twin, not of the solver: the ray meets a triangle where the three
//! edge functions have one sign, at the barycentric mean of its corners' depths; nothing is expanded in t.
//! Exact face coordinates are rounded once to `f64`; every number after that carries the largest error
//! that it may have, to first order and with room for the second.
//!
//! *Explanation.* The solver's answer is right for a scene that is off by its bounds if it can be the
//! nearest when each primitive is where the bounds may put it:
//!
//! - *Coverage.* Corners and centres are moved by up to 2 D in each coordinate, D = `ErrorBounds::depth`: one
//!   D for where the solver has them, one for what it rounds after that. In the plane (g, h) that is
//!   2 D (1 + |c|) and 2 D (1 + |w|). A primitive that a ray may then meet or miss is open.
//! - *Depth of a triangle.* Corners that move by 2 D in each coordinate move its plane by 2 sqrt(3) D along
//!   the normal n, so the depth by 2 sqrt(3) D |n| / |n . d|. N and D of the solver are rounded, by e_N =
//!   gamma(16) |n|' q' and e_D = gamma(12) |n|' (1 + |c|), with |n|' twice the product of the two shortest
//!   sides, each as long as it can be at any time, and q' the reach of a corner; a depth is off by (e_N + z e_D) / |n . d|. What is closer than twice
//!   that where D is least on a stretch, which is at most half of its largest, counts as equal, and so does a
//!   band that is half as thick: 8 (e_N + z e_D) / |n . d| in all. No depth is beyond those of the corners,
//!   but what counts as equal may be: where a triangle is fast, the solver's bound is that much too large.
//! - *Camera.* A triangle is in front where its depth is positive, which is open within the same.
//! - *Depth of a sphere.* The same with the solver's noise of the root: 3 times D (1 + |c|) +
//!   sqrt(noise) / k.

use sightline_geometry::{FACE_COUNT, RectifiedFrame, gamma};
use sightline_solver::{
    bounds::ErrorBounds,
    reference::motion::{Body, ExactRay, Form, bodies, nearest},
};

use super::scene::MovingCase;

const U: f64 = f64::EPSILON / 2.0;

/// A number and its largest error.
#[derive(Clone, Copy, Debug)]
struct Near {
    v: f64,
    e: f64,
}

impl Near {
    fn plus(self, o: Self) -> Self {
        let v = self.v + o.v;
        Self { v, e: (self.e + o.e + U * v.abs()) * (1.0 + 4.0 * U) }
    }

    fn minus(self, o: Self) -> Self {
        self.plus(Self { v: -o.v, e: o.e })
    }

    fn times(self, o: Self) -> Self {
        let v = self.v * o.v;
        let e = self.v.abs() * o.e + o.v.abs() * self.e + self.e * o.e + U * v.abs();
        Self { v, e: e * (1.0 + 8.0 * U) + f64::MIN_POSITIVE }
    }

    /// Times a number without error.
    fn by(self, o: f64) -> Self {
        let v = self.v * o;
        Self { v, e: (o.abs() * self.e + U * v.abs()) * (1.0 + 4.0 * U) + f64::MIN_POSITIVE }
    }

    /// 1 or -1, or 0 where it is open.
    fn sign(self) -> i32 {
        i32::from(self.v > self.e) - i32::from(self.v < -self.e)
    }

    fn low(self) -> f64 {
        self.v - self.e
    }

    fn high(self) -> f64 {
        self.v + self.e
    }
}

/// Whether a ray meets a primitive, and between which depths.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Cover {
    Out,
    In(f64, f64),
    Maybe(f64, f64),
}

/// Whether a ray meets the inside of a triangle, in front of the camera or behind.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Edges {
    Outside,
    Inside,
    Open,
}

/// Floats of a primitive at both ends of the path.
#[derive(Debug)]
enum Flat {
    Triangle([[[f64; 3]; 3]; 2]),
    Sphere([[f64; 3]; 2], [f64; 2]),
}

struct Solid {
    primitive: u32,
    flat: Flat,
    body: Body,
}

/// What explains an answer that is not the exact one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// The ray passes an edge, or the silhouette of a sphere, within the bound.
    Edge,
    /// So it does, where a corner is on the row plane within the bound.
    Row,
    /// Depths differ by less than the bound.
    Depth,
    /// The camera is in a triangle's plane, or on a sphere, within the bound.
    Camera,
}

/// All causes, in the order of [`Cause`].
pub const CAUSES: [&str; 4] = ["edge", "row", "depth", "camera"];

/// The outcome of one look.
#[derive(Clone, Debug, PartialEq)]
pub enum Verdict {
    /// Equal; whether rational arithmetic was needed.
    Same(bool),
    Explained(Cause),
    Unexplained(String),
}

/// The occluders of a case, on each face.
pub struct Judge {
    faces: Vec<Vec<Solid>>,
    length: f64,
    pub bounds: ErrorBounds,
}

/// What may be met along one ray at some time.
pub struct Along<'a> {
    judge: &'a Judge,
    solids: Vec<&'a Solid>,
    c: f64,
    w: f64,
}

fn floats(p: &[dashu_ratio::RBig; 3]) -> [f64; 3] {
    p.each_ref().map(|v| v.to_f64().value())
}

fn flat(form: &Form) -> Flat {
    match form {
        Form::Triangle(ends) => Flat::Triangle(ends.each_ref().map(|p| p.each_ref().map(floats))),
        Form::Sphere(centers, radii) => Flat::Sphere(
            centers.each_ref().map(floats),
            radii.each_ref().map(|r| r.to_f64().value()),
        ),
    }
}

/// A triangle with its corners in an order of their own: two are equal whichever corner they begin with
/// and whichever way they turn.
fn in_order(form: Form) -> Form {
    match form {
        Form::Triangle([start, end]) => {
            let mut corners: Vec<_> = start.into_iter().zip(end).collect();
            corners.sort();
            let corners: [_; 3] = corners.try_into().expect("a triangle has three corners");
            Form::Triangle([corners.clone().map(|c| c.0), corners.map(|c| c.1)])
        }
        sphere @ Form::Sphere(..) => sphere,
    }
}

impl Judge {
    pub fn new(case: &MovingCase) -> Option<Self> {
        let frame = RectifiedFrame::new(&case.segment)?;
        let mut solids: Vec<Body> = Vec::new();
        for mut body in bodies(&case.geometry, &frame, case.state, case.path) {
            // Of equal primitives the lowest number is seen, always.
            body.form = in_order(body.form);
            if body.occluder && !solids.iter().any(|s| s.form == body.form) {
                solids.push(body);
            }
        }
        let faces = (0..FACE_COUNT)
            .map(|face| {
                let solid = |body: &Body| {
                    let body = body.on_face(face);
                    Solid { primitive: body.primitive, flat: flat(&body.form), body }
                };
                solids.iter().map(solid).collect()
            })
            .collect();
        let bounds = ErrorBounds::new(&case.geometry, &frame);
        Some(Self { faces, length: frame.length, bounds })
    }

    /// What a ray may meet at any time.
    pub fn along(&self, face: usize, c: f64, w: f64) -> Along<'_> {
        let mut along = Along { judge: self, solids: Vec::new(), c, w };
        let solids = self.faces[face].iter().filter(|s| along.may_meet(&s.flat));
        let solids = solids.collect();
        along.solids = solids;
        along
    }

    /// The bodies of a face, for the algebraic twin.
    pub fn bodies(&self, face: usize) -> Vec<Body> {
        self.faces[face].iter().map(|s| s.body.clone()).collect()
    }

    pub fn ray(&self, c: f64, w: f64) -> ExactRay {
        ExactRay::new(c, w, self.length)
    }
}

impl Along<'_> {
    /// A point at t, from those at both ends of the path, relative to the camera.
    fn at(&self, p: &[f64; 3], q: &[f64; 3], t: f64, extra: f64) -> [Near; 3] {
        let way = [self.judge.length, 0.0, 0.0];
        std::array::from_fn(|k| {
            let v = (1.0 - t) * p[k] + t * q[k] - t * way[k];
            let e = 8.0 * U * (p[k].abs() + q[k].abs() + way[k]) + extra;
            Near { v, e: e + f64::MIN_POSITIVE }
        })
    }

    /// False when all of it is beside the ray at both ends, on the same side: so it is between them.
    fn may_meet(&self, flat: &Flat) -> bool {
        let sides = |p: &[f64; 3], t: f64, r: f64| {
            let x = p[0] - t * self.judge.length;
            let size = 1e-9 * (p[0].abs() + self.judge.length + p[1].abs() + p[2].abs());
            let side = |v: f64, s: f64| {
                let slack = (size + r) * (1.0 + s.abs()) * 1.001;
                i32::from(v > slack) - i32::from(v < -slack)
            };
            [
                side(x - self.c * p[2], self.c),
                side(p[1] - self.w * p[2], self.w),
                side(p[2], 0.0).min(0),
            ]
        };
        let all: Vec<[i32; 3]> = match flat {
            Flat::Triangle(ends) => {
                let both = ends.iter().zip([0.0, 1.0]);
                both.flat_map(|(p, t)| p.iter().map(move |p| sides(p, t, 0.0))).collect()
            }
            Flat::Sphere(centers, radii) => {
                (0..2).map(|k| sides(&centers[k], k as f64, radii[k])).collect()
            }
        };
        (0..3).all(|k| !(all[0][k] != 0 && all.iter().all(|s| s[k] == all[0][k])))
    }

    fn cover(&self, flat: &Flat, t: f64, extra: f64) -> Cover {
        match flat {
            Flat::Triangle([p, q]) => {
                let corners: [[Near; 3]; 3] =
                    std::array::from_fn(|k| self.at(&p[k], &q[k], t, extra));
                let (edges, (low, high), plane) = self.cross_triangle(&corners);
                let (from, to) = plane.map_or((low, high), |(a, b)| (a.max(low), b.min(high)));
                match edges {
                    Edges::Outside => Cover::Out,
                    Edges::Open => Cover::Maybe(low, high),
                    Edges::Inside if to <= 0.0 => Cover::Out,
                    Edges::Inside if from > 0.0 => Cover::In(from, to),
                    Edges::Inside => Cover::Maybe(from, to),
                }
            }
            Flat::Sphere([p, q], radii) => {
                self.cover_sphere(&self.at(p, q, t, extra), self.radius(radii, t))
            }
        }
    }

    fn radius(&self, [a, b]: &[f64; 2], t: f64) -> Near {
        Near { v: (1.0 - t) * a + t * b, e: 8.0 * U * (a + b) + f64::MIN_POSITIVE }
    }

    /// Whether the ray is inside of all edges, between which depths the corners are, and between which
    /// the plane is on the ray.
    fn cross_triangle(&self, corners: &[[Near; 3]; 3]) -> (Edges, (f64, f64), Option<(f64, f64)>) {
        let z = corners.map(|p| p[2]);
        let low = z.iter().fold(f64::INFINITY, |m, z| m.min(z.low()));
        let high = z.iter().fold(f64::NEG_INFINITY, |m, z| m.max(z.high()));
        let g = corners.map(|p| p[0].minus(p[2].by(self.c)));
        let h = corners.map(|p| p[1].minus(p[2].by(self.w)));
        let beside = |v: [Near; 3]| v[0].sign() != 0 && v.iter().all(|x| x.sign() == v[0].sign());
        let e: [Near; 3] = std::array::from_fn(|k| {
            let next = (k + 1) % 3;
            g[k].times(h[next]).minus(g[next].times(h[k]))
        });
        let d = e[0].plus(e[1]).plus(e[2]);
        let plane = (d.sign() != 0).then(|| {
            let n = (0..3).fold(Near { v: 0.0, e: 0.0 }, |n, k| n.plus(e[k].times(z[(k + 2) % 3])));
            let v = n.v / d.v;
            let error = (n.e + v.abs() * d.e) / (d.v.abs() - d.e) + 4.0 * U * v.abs();
            (v - error, v + error)
        });
        let signs = e.map(Near::sign);
        let both = signs.contains(&1) && signs.contains(&-1);
        let edges = if high <= 0.0 || beside(g) || beside(h) || both {
            Edges::Outside
        } else if signs.contains(&0) {
            Edges::Open
        } else {
            Edges::Inside
        };
        (edges, (low, high), plane)
    }

    fn cover_sphere(&self, q: &[Near; 3], r: Near) -> Cover {
        let (c, w) = (self.c, self.w);
        let [x, y, z] = *q;
        let g = x.minus(z.by(c));
        let h = y.minus(z.by(w));
        let cross = g.by(w).minus(h.by(c));
        let k = 1.0 + c * c + w * w;
        let k = Near { v: k, e: 4.0 * U * k };
        let rr = r.times(r);
        let off = g.times(g).plus(h.times(h)).plus(cross.times(cross));
        let met = k.times(rr).minus(off);
        if met.high() <= 0.0 {
            return Cover::Out;
        }
        let foot = x.by(c).plus(y.by(w)).plus(z);
        let inside = x.times(x).plus(y.times(y)).plus(z.times(z)).minus(rr);
        let roots =
            (met.low().max(0.0).sqrt() * (1.0 - 4.0 * U), met.high().sqrt() * (1.0 + 4.0 * U));
        let depth = |v: f64, up: bool| {
            let v = v / k.v;
            v + if up { 8.0 * U * v.abs() } else { -8.0 * U * v.abs() }
        };
        let front = (depth(foot.low() - roots.1, false), depth(foot.high() - roots.0, true));
        let back = (depth(foot.low() + roots.0, false), depth(foot.high() + roots.1, true));
        match (inside.sign(), foot.sign(), met.sign()) {
            (1, -1, _) => Cover::Out,
            (1, 1, 1) => Cover::In(front.0.max(0.0), front.1),
            (-1, _, 1) => Cover::In(back.0.max(0.0), back.1),
            (1, ..) => Cover::Maybe(front.0, front.1),
            _ => Cover::Maybe(front.0, back.1),
        }
    }

    /// How far a depth at t may be off for the solver, and the plane's own depth for a triangle.
    fn widened(&self, flat: &Flat, t: f64) -> Cover {
        let depth = self.judge.bounds.depth;
        let (certain, low, high) = match flat {
            Flat::Triangle([p, q]) => {
                let at = |extra: f64| -> [[Near; 3]; 3] {
                    std::array::from_fn(|k| self.at(&p[k], &q[k], t, extra))
                };
                let (edges, (nearest, farthest), _) = self.cross_triangle(&at(2.0 * depth));
                if edges == Edges::Outside {
                    return Cover::Out;
                }
                let corners = at(0.0);
                let (low, high) = match self.cross_triangle(&corners).2 {
                    None => (nearest, farthest),
                    Some((a, b)) => {
                        let (own, equal) = self.triangle_error(p, q, &corners, b.abs());
                        (
                            (a - own).clamp(nearest, farthest) - equal,
                            (b + own).clamp(nearest, farthest) + equal,
                        )
                    }
                };
                (edges == Edges::Inside, low, high)
            }
            Flat::Sphere(centers, radii) => {
                let k = 1.0 + self.c * self.c + self.w * self.w;
                let r = radii[0].max(radii[1]);
                let moved = depth * (2.0 + self.c.abs() + self.w.abs()) * k.sqrt();
                // The largest distance from the ray, at an end of the path, squared, times k.
                let off = (0..2).fold(0.0f64, |most, end| {
                    let p = centers[end];
                    let (x, z) = (p[0] - end as f64 * self.judge.length, p[2]);
                    let (g, h) = (x - self.c * z, p[1] - self.w * z);
                    most.max(g * g + h * h + (g * self.w - h * self.c).powi(2))
                });
                let noise = 2.0 * k.sqrt() * r * moved
                    + moved * moved
                    + gamma(8) * (k * r * r + off) * 1.01;
                let error = 3.0 * (depth * (1.0 + self.c.abs()) + noise.sqrt() / k);
                match self.cover(flat, t, 2.0 * depth) {
                    Cover::Out => return Cover::Out,
                    Cover::In(low, high) => (true, low - error, high + error),
                    Cover::Maybe(low, high) => (false, low - error, high + error),
                }
            }
        };
        match (certain, low > 0.0, high > 0.0) {
            (.., false) => Cover::Out,
            (true, true, _) => Cover::In(low, high),
            _ => Cover::Maybe(low, high),
        }
    }

    /// How far a triangle's depth may be off, and how far apart two may be that count as equal.
    fn triangle_error(
        &self,
        p: &[[f64; 3]; 3],
        q: &[[f64; 3]; 3],
        corners: &[[Near; 3]; 3],
        z: f64,
    ) -> (f64, f64) {
        let length = |v: [f64; 3]| (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        let side = |p: &[[f64; 3]; 3], k: usize, j: usize| -> [f64; 3] {
            std::array::from_fn(|i| p[k][i] - p[j][i])
        };
        let largest = |k: usize, j: usize| {
            let (a, b) = (side(p, k, j), side(q, k, j));
            length(std::array::from_fn(|i| a[i].abs().max(b[i].abs())))
        };
        let sides = [largest(1, 0), largest(2, 1), largest(0, 2)];
        let pairs = (0..3).map(|k| sides[k] * sides[(k + 1) % 3]);
        let normal_size = 2.0 * pairs.fold(f64::INFINITY, f64::min);
        let reach = |k: usize| {
            length(std::array::from_fn(|i| {
                let way = if i == 0 { self.judge.length } else { 0.0 };
                p[k][i].abs().max((q[k][i] - way).abs())
            }))
        };
        let reach = (0..3).map(reach).fold(0.0, f64::max);
        let now = corners.map(|p| p.map(|x| x.v));
        let (a, b) = (side(&now, 1, 0), side(&now, 2, 0));
        let n = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        let along = (n[0] * self.c + n[1] * self.w + n[2]).abs();
        let moved = 2.0 * 3f64.sqrt() * self.judge.bounds.depth * length(n);
        let rounded =
            gamma(16) * normal_size * reach + z * gamma(12) * normal_size * (1.0 + self.c.abs());
        let depth = 2.0 * self.judge.bounds.depth;
        ((moved + rounded) / along + depth, 7.0 * rounded / along + depth)
    }

    /// Compares the solver's answer at `t` with the exact one.
    pub fn look(&self, t: f64, answer: Option<u32>) -> Verdict {
        let covers: Vec<(u32, Cover, &Solid)> = self
            .solids
            .iter()
            .map(|s| (s.primitive, self.cover(&s.flat, t, 0.0), *s))
            .filter(|c| c.1 != Cover::Out)
            .collect();
        let best = covers
            .iter()
            .filter_map(|c| match c.1 {
                Cover::In(_, high) => Some((high, c.0)),
                _ => None,
            })
            .min_by(|a, b| a.0.total_cmp(&b.0));
        let limit = best.map_or(f64::INFINITY, |b| b.0);
        let close = |cover: &Cover| match cover {
            Cover::In(low, _) | Cover::Maybe(low, _) => *low <= limit,
            Cover::Out => false,
        };
        let open: Vec<_> = covers.iter().filter(|c| close(&c.1)).collect();
        let certain = match (best, open.len()) {
            (None, 0) => Some(None),
            (Some((_, p)), 1) => Some(Some(p)),
            _ => None,
        };
        let (truth, exact) = match certain {
            Some(truth) => (truth, false),
            None => {
                let t = dashu_ratio::RBig::try_from(t).expect("times are finite");
                let bodies = open.iter().map(|c| &c.2.body);
                let ray = self.judge.ray(self.c, self.w);
                (nearest(bodies, &ray, &t).map(|n| n.0), true)
            }
        };
        if truth == answer {
            return Verdict::Same(exact);
        }
        self.explain(t, answer, truth)
    }

    fn explain(&self, t: f64, answer: Option<u32>, truth: Option<u32>) -> Verdict {
        let moved: Vec<(u32, Cover, &Solid)> =
            self.solids.iter().map(|s| (s.primitive, self.widened(&s.flat, t), *s)).collect();
        let of = |p: Option<u32>| moved.iter().find(|m| Some(m.0) == p);
        let low = match of(answer).map(|m| m.1) {
            None if answer.is_none() => f64::INFINITY,
            Some(Cover::In(low, _) | Cover::Maybe(low, _)) => low,
            _ => return self.unexplained("invented", t, answer, truth),
        };
        let behind = moved.iter().any(|m| matches!(m.1, Cover::In(_, high) if high < low));
        if behind {
            return self.unexplained("behind", t, answer, truth);
        }
        // Which of the two is open?
        let open =
            [answer, truth].into_iter().filter_map(of).find(|m| matches!(m.1, Cover::Maybe(..)));
        let cause = match open {
            None => Cause::Depth,
            Some((_, cover, solid)) => self.cause(*cover, solid, t),
        };
        Verdict::Explained(cause)
    }

    fn cause(&self, cover: Cover, solid: &Solid, t: f64) -> Cause {
        let extra = 2.0 * self.judge.bounds.depth;
        let in_front = !matches!(cover, Cover::Maybe(low, _) if low <= extra);
        match &solid.flat {
            Flat::Triangle([p, q]) => {
                let corners: [[Near; 3]; 3] =
                    std::array::from_fn(|k| self.at(&p[k], &q[k], t, extra));
                let on_row = corners.iter().any(|p| p[1].minus(p[2].by(self.w)).sign() == 0);
                match self.cross_triangle(&corners).0 {
                    Edges::Inside => Cause::Camera,
                    _ if on_row => Cause::Row,
                    _ => Cause::Edge,
                }
            }
            Flat::Sphere(..) if in_front => Cause::Edge,
            Flat::Sphere(..) => Cause::Camera,
        }
    }

    fn unexplained(&self, what: &str, t: f64, answer: Option<u32>, truth: Option<u32>) -> Verdict {
        let tell = |p: Option<u32>| {
            let solid = self.solids.iter().find(|s| Some(s.primitive) == p);
            solid.map(|s| {
                let exact = self.cover(&s.flat, t, 0.0);
                let widened = self.widened(&s.flat, t);
                format!("{} {exact:?}, widened {widened:?}, {:?}", s.primitive, s.flat)
            })
        };
        Verdict::Unexplained(format!(
            "{what} at t = {t:?}, c = {:?}, w = {:?}, L = {:?}, D = {:e}: found {answer:?} ({:?}), \
             exact {truth:?} ({:?})",
            self.c,
            self.w,
            self.judge.length,
            self.judge.bounds.depth,
            tell(answer),
            tell(truth)
        ))
    }
}
