//! The exact twin for what moves: polynomials with rational coefficients, and their real roots.
//!
//! The floats of the input (vertices and transforms at the key frames, spheres, the frame's vectors
//! and length, the time path, rows and columns) are the rationals that they are; nothing is rounded
//! after that. Everything is relative to the camera, so a corner is linear in the parameter t of the
//! segment, as is the centre of a sphere. With g = x - c z and h = y - w z:
//!
//! - a triangle's corners change sides of the row plane at roots of h, its edges pass the ray at roots
//!   of `E = gP hQ - gQ hP`, and it is at depth N / D with D the sum of the three E, and N the sum of
//!   each E times the z of the corner that is opposite: the barycentric mean of the depths;
//! - a sphere is met where `G = k r^2 - g^2 - h^2 - (g w - h c)^2` is positive, k = 1 + c^2 + w^2, at depth
//!   `(q . d -+ sqrt(G)) / k`; the camera is inside of it where `|q|^2 < r^2`;
//! - two depths are equal at roots of a polynomial of degree 5 (two triangles), 6 (a triangle and a
//!   sphere) or 4 (two spheres; the ray is the same, so k is).
//!
//! All of these roots in (0, 1) cut the segment into stretches on which nothing changes, and each is
//! judged at a rational point inside of it. Depths are compared without roots, by squaring.
//!
//! *Half-open rules*: h = 0 is above, g = 0 is positive. Where E is 0 all the time, an edge moves along the
//! ray; here g = 0 is positive for every edge, while the solver goes by the edge's direction. Such a ray
//! is on the border of what it meets, and the bounds allow either.
//!
//! *Roots* are found by Descartes' rule of signs in Bernstein form, with integers: no change of sign among
//! the coefficients is no root; everything else is halved, to a length of 2^-200. Roots closer than that
//! may count as one, and what is left at that length may be none; either is harmless, since a border too
//! many changes nothing, and a stretch that is missing is shorter than 2^-199.
//!
//! Sources: Collins and Akritas, "Polynomial Real Root Isolation Using Descartes' Rule of Signs" (SYMSAC
//! 1976); Lane and Riesenfeld, "Bounds on a Polynomial" (BIT 1981) for the Bernstein form.

use std::cmp::Ordering;

use dashu_int::IBig;
use dashu_ratio::RBig;
use glam::{DAffine3, DVec3};
use sightline_geometry::{
    FACE_COUNT, InstanceId, InstancedGeometry, RectifiedFrame, Sampling, ViewSegment,
};

use super::{ExactInterval, Seen, V3, dot, exact, exact3};
use crate::TimePath;

/// Halvings after which a root is known well enough.
const HALVINGS: u32 = 200;

/// Coefficients of 1, t, t^2, ...
type Poly = Vec<RBig>;

fn add(a: &Poly, b: &Poly) -> Poly {
    let of = |p: &Poly, i: usize| p.get(i).cloned().unwrap_or(RBig::ZERO);
    (0..a.len().max(b.len())).map(|i| of(a, i) + of(b, i)).collect()
}

fn times(a: &Poly, by: &RBig) -> Poly {
    a.iter().map(|v| v * by).collect()
}

fn subtract(a: &Poly, b: &Poly) -> Poly {
    add(a, &times(b, &-RBig::ONE))
}

fn multiply(a: &Poly, b: &Poly) -> Poly {
    let mut out = vec![RBig::ZERO; a.len() + b.len() - 1];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            out[i + j] += x * y;
        }
    }
    out
}

fn value(p: &Poly, t: &RBig) -> RBig {
    p.iter().rev().fold(RBig::ZERO, |v, a| v * t + a)
}

fn sign(v: &RBig) -> i32 {
    match v.cmp(&RBig::ZERO) {
        Ordering::Less => -1,
        Ordering::Equal => 0,
        Ordering::Greater => 1,
    }
}

/// Appends the roots of `p` in (0, 1), or numbers closer than 2^-200 to them.
fn roots(p: &Poly, out: &mut Vec<RBig>) {
    let degree = p.len() - 1;
    // b_i = sum of C(i, k) / C(n, k) a_k; 60 is a multiple of all C(n, k) for n up to 6.
    let choose = |n: usize, k: usize| (0..k).fold(1, |c, i| c * (n - i) / (i + 1));
    let scaled: Vec<RBig> = (0..=degree)
        .map(|i| {
            (0..=i).fold(RBig::ZERO, |sum, k| {
                sum + &p[k] * RBig::from((60 * choose(i, k) / choose(degree, k)) as u64)
            })
        })
        .collect();
    // Denominators are powers of two, so the largest is a multiple of all.
    let unit = scaled.iter().map(RBig::denominator).max().cloned().unwrap_or_default();
    let unit = RBig::from(unit);
    let whole: Vec<IBig> = scaled.iter().map(|b| (b * &unit).into_parts().0).collect();
    if whole.iter().all(|b| *b == IBig::ZERO) {
        return;
    }
    // A stretch: its coefficients, its place in units of its length, and how often it was halved.
    let mut stack = vec![(whole, IBig::ZERO, 0u32)];
    let place = |place: &IBig, level: u32| {
        RBig::from_parts(place.clone(), dashu_int::UBig::ONE << level as usize)
    };
    while let Some((b, at, level)) = stack.pop() {
        if b[0] == IBig::ZERO && at > IBig::ZERO {
            out.push(place(&at, level));
        }
        let signs = b.iter().filter(|v| **v != IBig::ZERO).map(|v| *v > IBig::ZERO);
        let signs: Vec<bool> = signs.collect();
        if signs.windows(2).all(|pair| pair[0] == pair[1]) {
            continue;
        }
        if level == HALVINGS {
            out.push(place(&(at * IBig::from(2) + IBig::ONE), level + 1));
            continue;
        }
        // Both halves at once, times 2^n: a triangle of sums.
        let (mut left, mut right) = (Vec::new(), Vec::new());
        let mut row = b;
        for k in 0..=degree {
            left.push(row[0].clone() << (degree - k));
            right.push(row[row.len() - 1].clone() << (degree - k));
            row = row.windows(2).map(|pair| &pair[0] + &pair[1]).collect();
        }
        right.reverse();
        let first = at * IBig::from(2);
        stack.push((right, &first + IBig::ONE, level + 1));
        stack.push((left, first, level + 1));
    }
}

/// A primitive at both ends of the path.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "its numbers are on the heap anyway")]
pub enum Form {
    /// Corners.
    Triangle([[V3; 3]; 2]),
    /// Centre and radius.
    Sphere([V3; 2], [RBig; 2]),
}

/// A primitive in exact face coordinates, at the start and at the end of the camera's path, relative to
/// the start of the segment.
#[derive(Clone, Debug)]
pub struct Body {
    /// Its number.
    pub primitive: u32,
    /// False for what hides nothing.
    pub occluder: bool,
    /// Where it is.
    pub form: Form,
}

impl Body {
    /// The body in coordinates of another face, from those of face 0.
    #[must_use]
    pub fn on_face(&self, face: usize) -> Self {
        // Forward and up are (a, b), (b, -a), (-a, -b), (-b, a).
        let turn = |p: &V3| -> V3 {
            let [x, y, z] = p.clone();
            match face {
                0 => [x, y, z],
                1 => [x, -z, y],
                2 => [x, -y, -z],
                _ => [x, z, -y],
            }
        };
        let form = match &self.form {
            Form::Triangle(ends) => Form::Triangle(ends.each_ref().map(|p| p.each_ref().map(turn))),
            Form::Sphere(centers, radii) => {
                Form::Sphere(centers.each_ref().map(turn), radii.clone())
            }
        };
        Self { form, ..*self }
    }
}

/// Every primitive that is there in a state, in coordinates of face 0, in order of number.
#[must_use]
pub fn bodies(
    geometry: &InstancedGeometry,
    frame: &RectifiedFrame,
    state: u32,
    path: TimePath,
) -> Vec<Body> {
    let face = frame.face(0);
    let axes = [face.axis, face.up, face.forward].map(exact3);
    let v0 = exact3(frame.v0);
    let ends = [path.t0, path.t1].map(exact);
    let mix = |a: &RBig, b: &RBig, t: &RBig| (RBig::ONE - t) * a + t * b;
    // The same point at the key frames, in the world, to face coordinates at the ends of the path.
    let place = |key: [V3; 2]| -> [V3; 2] {
        let key = key.map(|p| -> V3 {
            let relative = std::array::from_fn(|k| &p[k] - &v0[k]);
            std::array::from_fn(|k| dot(&axes[k], &relative))
        });
        ends.each_ref().map(|t| std::array::from_fn(|k| mix(&key[0][k], &key[1][k], t)))
    };
    let mapped = |map: &DAffine3, p: DVec3| -> V3 {
        let m = map.matrix3;
        let columns = [m.x_axis, m.y_axis, m.z_axis].map(exact3);
        let (p, o) = (exact3(p), exact3(map.translation));
        std::array::from_fn(|k| {
            &columns[0][k] * &p[0] + &columns[1][k] * &p[1] + &columns[2][k] * &p[2] + &o[k]
        })
    };
    let mut out = Vec::new();
    for (number, instance) in geometry.instances.iter().enumerate() {
        let mesh = &geometry.meshes[instance.mesh.index()];
        let (maps, keys) = (instance.around(state), mesh.around(state));
        let wide = |p: [f32; 3]| DVec3::from_array(p.map(f64::from));
        for (t, primitive) in geometry.primitives_of(InstanceId(number as u32)).enumerate() {
            let corners = mesh.triangles[t].map(|v| {
                let v = v as usize;
                place([mapped(maps.0, wide(keys.0[v])), mapped(maps.1, wide(keys.1[v]))])
            });
            let at = |end: usize| corners.each_ref().map(|c| c[end].clone());
            let form = Form::Triangle([at(0), at(1)]);
            out.push(Body { primitive, occluder: instance.occluder, form });
        }
    }
    for system in &geometry.particles {
        let origin = exact3(system.origin);
        for particle in 0..system.len() {
            let Some((from, to)) = system.around(particle, state) else { continue };
            let center = [from, to].map(|s| -> V3 {
                let own = exact3(s.center());
                std::array::from_fn(|k| &own[k] + &origin[k])
            });
            let radii = [from, to].map(|s| exact(f64::from(s.radius)));
            let radii = ends.each_ref().map(|t| mix(&radii[0], &radii[1], t));
            let form = Form::Sphere(place(center), radii);
            let primitive = system.first_primitive.0 + particle as u32;
            out.push(Body { primitive, occluder: system.occluder, form });
        }
    }
    out
}

/// A ray (c, w, 1) from the camera that runs over a segment.
#[derive(Clone, Debug)]
pub struct ExactRay {
    /// Column coordinate.
    pub c: RBig,
    /// Row coordinate.
    pub w: RBig,
    /// Length of the segment, metres.
    pub length: RBig,
}

impl ExactRay {
    /// The ray of a row and a column.
    #[must_use]
    pub fn new(c: f64, w: f64, length: f64) -> Self {
        Self { c: exact(c), w: exact(w), length: exact(length) }
    }
}

/// A depth: `p + s sqrt(a)`.
#[derive(Clone, Debug)]
pub struct Depth {
    p: RBig,
    s: i32,
    a: RBig,
}

/// Sign of `x + s sqrt(a)`, a not negative.
fn sign_with_root(x: &RBig, s: i32, a: &RBig) -> i32 {
    let root = if *a == RBig::ZERO { 0 } else { s };
    match (sign(x), root) {
        (x, 0) => x,
        (0, s) => s,
        (x, s) if x == s => x,
        (sx, s) => match (x * x).cmp(a) {
            Ordering::Greater => sx,
            Ordering::Equal => 0,
            Ordering::Less => s,
        },
    }
}

impl Depth {
    /// Which is nearer, exactly.
    #[must_use]
    pub fn order(&self, other: &Self) -> Ordering {
        let x = &self.p - &other.p;
        // Sign of y = s sqrt(a) - u sqrt(b), and then of x + y.
        let (s, u) = (self.s, -other.s);
        let (a, b) = (&self.a, &other.a);
        let s = if *a == RBig::ZERO { 0 } else { s };
        let u = if *b == RBig::ZERO { 0 } else { u };
        let total = match (s, u) {
            (s, 0) => sign_with_root(&x, s, a),
            (0, u) => sign_with_root(&x, u, b),
            (s, u) => {
                let y = if s == u { s } else { s * sign(&(a - b)) };
                match (sign(&x), y) {
                    (x, 0) => x,
                    (0, y) => y,
                    (x, y) if x == y => x,
                    // |x| against |y|: x^2 - a - b - 2 s u sqrt(a b).
                    (sx, _) => {
                        let product = RBig::from(4) * a * b;
                        sx * sign_with_root(&(&x * &x - a - b), -s * u, &product)
                    }
                }
            }
        };
        total.cmp(&0)
    }

    /// The depth as a float.
    #[must_use]
    pub fn to_f64(&self) -> f64 {
        let root = self.a.to_f64().value().sqrt();
        self.p.to_f64().value() + f64::from(self.s) * root
    }
}

/// A body's polynomials for one ray.
enum Along {
    Triangle { h: [Poly; 3], e: [Poly; 3], n: Poly, d: Poly, behind: bool },
    Sphere { foot: Poly, g: Poly, inside: Poly, k: RBig },
}

impl Along {
    fn new(form: &Form, ray: &ExactRay) -> Self {
        let relative = |p: &V3, q: &V3| -> [Poly; 3] {
            let shift = [&ray.length, &RBig::ZERO, &RBig::ZERO];
            std::array::from_fn(|k| vec![p[k].clone(), &q[k] - &p[k] - shift[k]])
        };
        let images = |[x, y, z]: &[Poly; 3]| {
            (subtract(x, &times(z, &ray.c)), subtract(y, &times(z, &ray.w)))
        };
        match form {
            Form::Triangle([p, q]) => {
                let corners: [[Poly; 3]; 3] = std::array::from_fn(|k| relative(&p[k], &q[k]));
                let gh = corners.each_ref().map(images);
                let e: [Poly; 3] = std::array::from_fn(|k| {
                    let (p, q) = (&gh[k], &gh[(k + 1) % 3]);
                    subtract(&multiply(&p.0, &q.1), &multiply(&q.0, &p.1))
                });
                let d = add(&add(&e[0], &e[1]), &e[2]);
                let n = (0..3).fold(vec![RBig::ZERO], |n, k| {
                    add(&n, &multiply(&e[k], &corners[(k + 2) % 3][2]))
                });
                let behind = corners
                    .iter()
                    .any(|c| [0, 1].iter().any(|t| sign(&value(&c[2], &RBig::from(*t))) <= 0));
                Self::Triangle { h: gh.map(|p| p.1), e, n, d, behind }
            }
            Form::Sphere([p, q], [r0, r1]) => {
                let center = relative(p, q);
                let (g, h) = images(&center);
                let cross = subtract(&times(&g, &ray.w), &times(&h, &ray.c));
                let k = RBig::ONE + &ray.c * &ray.c + &ray.w * &ray.w;
                let square = |p: &Poly| multiply(p, p);
                let r = square(&vec![r0.clone(), r1 - r0]);
                let off = add(&add(&square(&g), &square(&h)), &square(&cross));
                let [x, y, z] = &center;
                let foot = add(&add(&times(x, &ray.c), &times(y, &ray.w)), z);
                let inside = subtract(&add(&add(&square(x), &square(y)), &square(z)), &r);
                Self::Sphere { foot, g: subtract(&times(&r, &k), &off), inside, k }
            }
        }
    }

    /// Where it may come or go.
    fn own_borders(&self) -> Vec<RBig> {
        let mut out = Vec::new();
        match self {
            Self::Triangle { h, e, n, behind, .. } => {
                h.iter().chain(e).for_each(|p| roots(p, &mut out));
                if *behind {
                    roots(n, &mut out);
                }
            }
            Self::Sphere { foot, g, inside, .. } => {
                [foot, g, inside].into_iter().for_each(|p| roots(p, &mut out));
            }
        }
        out
    }

    /// Where it is on the ray in front of the camera at `t`, if it is.
    fn depth(&self, t: &RBig) -> Option<Depth> {
        match self {
            Self::Triangle { h, e, n, d, .. } => {
                let h = h.each_ref().map(|p| value(p, t));
                let mut positive = Vec::new();
                for k in 0..3 {
                    let (a, b) = (&h[k], &h[(k + 1) % 3]);
                    if (sign(a) >= 0) != (sign(b) >= 0) {
                        // g of the cut, E / (hQ - hP).
                        let side = sign(&value(&e[k], t)) * sign(&(b - a));
                        positive.push(side >= 0);
                    }
                }
                let covers = positive.len() == 2 && positive[0] != positive[1];
                let d = value(d, t);
                if !covers || d == RBig::ZERO {
                    return None;
                }
                let p = value(n, t) / d;
                (sign(&p) > 0).then(|| Depth { p, s: 0, a: RBig::ZERO })
            }
            Self::Sphere { foot, g, inside, k } => {
                let g = value(g, t);
                if sign(&g) <= 0 {
                    return None;
                }
                let foot = value(foot, t);
                let from_inside = sign(&value(inside, t)) < 0;
                (from_inside || sign(&foot) > 0).then(|| Depth {
                    p: foot / k,
                    s: if from_inside { 1 } else { -1 },
                    a: g / (k * k),
                })
            }
        }
    }

    /// A polynomial that is 0 where both are at the same depth.
    fn difference(&self, other: &Self) -> Poly {
        match (self, other) {
            (Self::Triangle { n, d, .. }, Self::Triangle { n: m, d: f, .. }) => {
                subtract(&multiply(n, f), &multiply(m, d))
            }
            (Self::Triangle { n, d, .. }, Self::Sphere { foot, g, k, .. })
            | (Self::Sphere { foot, g, k, .. }, Self::Triangle { n, d, .. }) => {
                let off = subtract(&times(n, k), &multiply(foot, d));
                subtract(&multiply(&off, &off), &multiply(g, &multiply(d, d)))
            }
            (Self::Sphere { foot: p, g: a, .. }, Self::Sphere { foot: q, g: b, .. }) => {
                // p - q = +-sqrt(a) +- sqrt(b), squared twice.
                let f = subtract(p, q);
                let rest = subtract(&multiply(&f, &f), &add(a, b));
                let four = times(&multiply(a, b), &RBig::from(4));
                subtract(&multiply(&rest, &rest), &four)
            }
        }
    }
}

/// The depth of a body on a ray at `t`, if it is met in front of the camera.
#[must_use]
pub fn depth(body: &Body, ray: &ExactRay, t: &RBig) -> Option<Depth> {
    Along::new(&body.form, ray).depth(t)
}

/// The nearest occluder on a ray at `t`; of equals that with the lowest number.
pub fn nearest<'a>(
    bodies: impl Iterator<Item = &'a Body>,
    ray: &ExactRay,
    t: &RBig,
) -> Option<(u32, Depth)> {
    bodies
        .filter(|b| b.occluder)
        .filter_map(|b| Some((b.primitive, depth(b, ray, t)?)))
        .min_by(|a, b| a.1.order(&b.1).then(a.0.cmp(&b.0)))
}

/// What is seen along one ray.
#[derive(Clone, Debug, Default)]
pub struct ExactPixel {
    /// The nearest occluders, in order of t.
    pub occluders: Vec<ExactInterval>,
    /// Stretches on which a see-through primitive is not behind an occluder, in order of t.
    pub see_through: Vec<ExactInterval>,
}

fn join(out: &mut Vec<ExactInterval>, primitive: u32, t0: &RBig, t1: &RBig) {
    match out.iter_mut().rev().find(|i| i.primitive == primitive && i.t1 == *t0) {
        Some(last) => last.t1 = t1.clone(),
        None => out.push(ExactInterval { t0: t0.clone(), t1: t1.clone(), primitive }),
    }
}

fn sorted(mut borders: Vec<RBig>) -> Vec<RBig> {
    borders.extend([RBig::ZERO, RBig::ONE]);
    borders.sort();
    borders.dedup();
    borders
}

fn middle(a: &RBig, b: &RBig) -> RBig {
    (a + b) / RBig::from(2)
}

/// What is seen along a ray, stretch by stretch.
#[must_use]
pub fn pixel(bodies: &[Body], ray: &ExactRay) -> ExactPixel {
    // Those that are met at all, and where.
    let mut met = Vec::new();
    for body in bodies {
        let along = Along::new(&body.form, ray);
        let borders = sorted(along.own_borders());
        let mut covered = Vec::new();
        for pair in borders.windows(2) {
            if along.depth(&middle(&pair[0], &pair[1])).is_some() {
                join(&mut covered, body.primitive, &pair[0], &pair[1]);
            }
        }
        if !covered.is_empty() {
            met.push((body, along, borders, covered));
        }
    }
    let mut borders = Vec::new();
    for (i, a) in met.iter().enumerate() {
        borders.extend(a.2.iter().cloned());
        for b in &met[..i] {
            let meets = |i: &ExactInterval, k: &ExactInterval| i.t0 < k.t1 && k.t0 < i.t1;
            if a.3.iter().any(|i| b.3.iter().any(|k| meets(i, k))) {
                roots(&a.1.difference(&b.1), &mut borders);
            }
        }
    }
    let mut out = ExactPixel::default();
    for pair in sorted(borders).windows(2) {
        let t = middle(&pair[0], &pair[1]);
        let here: Vec<(&Body, Depth)> = met
            .iter()
            .filter(|m| m.3.iter().any(|i| i.t0 < t && t < i.t1))
            .filter_map(|m| Some((m.0, m.1.depth(&t)?)))
            .collect();
        let nearest = here
            .iter()
            .filter(|b| b.0.occluder)
            .min_by(|a, b| a.1.order(&b.1).then(a.0.primitive.cmp(&b.0.primitive)));
        if let Some((body, _)) = nearest {
            join(&mut out.occluders, body.primitive, &pair[0], &pair[1]);
        }
        for (body, depth) in here.iter().filter(|b| !b.0.occluder) {
            if nearest.is_none_or(|n| depth.order(&n.1).is_le()) {
                join(&mut out.see_through, body.primitive, &pair[0], &pair[1]);
            }
        }
    }
    out
}

/// Everything visible from a segment in a state at the pixel centres of `sampling`, in order of
/// primitive. Exact up to stretches of 2^-199 of the segment.
#[must_use]
pub fn solve_state(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
    state: u32,
    path: TimePath,
) -> Vec<Seen> {
    let Some(frame) = RectifiedFrame::new(segment) else { return Vec::new() };
    let on_first = bodies(geometry, &frame, state, path);
    let mut seen: std::collections::BTreeMap<u32, Seen> = std::collections::BTreeMap::new();
    for face in 0..FACE_COUNT {
        let bodies: Vec<Body> = on_first.iter().map(|b| b.on_face(face)).collect();
        for row in 0..sampling.rows() {
            for column in 0..sampling.columns() {
                let c = sampling.column(column);
                let found = pixel(&bodies, &ExactRay::new(c, sampling.row(row), frame.length));
                let solid_angle = Sampling::solid_angle(
                    sampling.c(f64::from(column)),
                    sampling.c(f64::from(column) + 1.0),
                    sampling.w(f64::from(row)),
                    sampling.w(f64::from(row) + 1.0),
                );
                for interval in found.occluders.iter().chain(&found.see_through) {
                    let length = (&interval.t1 - &interval.t0).to_f64().value();
                    let primitive = interval.primitive;
                    let new = Seen { primitive, longest: 0.0, column: c, weight: 0.0 };
                    let s = seen.entry(primitive).or_insert(new);
                    s.weight += length * solid_angle / (4.0 * std::f64::consts::PI);
                    if length > s.longest {
                        (s.longest, s.column) = (length, c);
                    }
                }
            }
        }
    }
    seen.into_values().collect()
}

#[cfg(test)]
mod tests {
    use glam::DAffine3;
    use proptest::prelude::*;
    use sightline_geometry::{
        Instance, Mesh, MeshId, ObjectId, ParticleSystem, PrimitiveId, SegmentId, Sphere,
    };

    use super::*;
    use crate::{SolveOptions, bounds::ErrorBounds, solve_states};

    fn rational(numerator: i64, denominator: u64) -> RBig {
        RBig::from_parts(numerator.into(), denominator.into())
    }

    #[test]
    fn roots_are_found_once_each_with_their_multiplicity_or_more() {
        let mut found = Vec::new();
        // (4 t - 1)^2 (8 t - 7) (t - 2): a double root, a simple one, and one outside.
        let linear = |a: i64, b: i64| vec![rational(b, 1), rational(a, 1)];
        let double = multiply(&linear(4, -1), &linear(4, -1));
        let p = multiply(&double, &multiply(&linear(8, -7), &linear(1, -2)));
        roots(&p, &mut found);
        found.sort();
        found.dedup();
        assert_eq!(found, [rational(1, 4), rational(7, 8)]);
        // 1/3 is no dyadic number: it is held to 2^-200, also where it is double.
        for p in [linear(3, -1), multiply(&linear(3, -1), &linear(3, -1))] {
            found.clear();
            roots(&p, &mut found);
            assert!(!found.is_empty());
            for t in &found {
                let off = (t - rational(1, 3)).to_f64().value().abs();
                assert!(off <= 2f64.powi(-199), "{off:e}");
            }
        }
        found.clear();
        // 16 t^2 - 8 t + 2 has none; nor has 0.
        roots(&vec![rational(2, 1), rational(-8, 1), rational(16, 1)], &mut found);
        roots(&vec![RBig::ZERO; 4], &mut found);
        assert!(found.is_empty());
    }

    proptest! {
        #[test]
        fn depths_compare_as_their_values_do(
            (p, q) in (-50i64..50, -50i64..50),
            (s, u) in (-1i32..2, -1i32..2),
            (a, b) in (0i64..40, 0i64..40),
        ) {
            let of = |p: i64, s: i32, a: i64| Depth { p: rational(p, 8), s, a: rational(a, 16) };
            let (one, other) = (of(p, s, a), of(q, u, b));
            let off = one.to_f64() - other.to_f64();
            let order = one.order(&other);
            // Differences of such numbers are 0, or at least about 1e-6.
            let expected = if off.abs() < 1e-9 { Ordering::Equal } else { off.total_cmp(&0.0) };
            prop_assert_eq!(order, expected, "{:?} {:?}", one, other);
            prop_assert_eq!(other.order(&one), order.reverse());
        }
    }

    fn point(p: [i64; 3]) -> V3 {
        p.map(|v| rational(v, 1))
    }

    fn triangle(primitive: u32, ends: [[[i64; 3]; 3]; 2]) -> Body {
        Body { primitive, occluder: true, form: Form::Triangle(ends.map(|p| p.map(point))) }
    }

    fn ball(primitive: u32, centers: [[i64; 3]; 2], radii: [i64; 2]) -> Body {
        let form = Form::Sphere(centers.map(point), radii.map(|r| rational(r, 1)));
        Body { primitive, occluder: true, form }
    }

    /// The intervals of the ray straight ahead, from a camera that stands still.
    fn ahead(bodies: &[Body]) -> Vec<(f64, f64, u32)> {
        let ray = ExactRay::new(0.0, 0.0, 0.0);
        let of = |i: &ExactInterval| (i.t0.to_f64().value(), i.t1.to_f64().value(), i.primitive);
        pixel(bodies, &ray).occluders.iter().map(of).collect()
    }

    /// A triangle that is larger than what is looked at, at a depth.
    fn wall(primitive: u32, z: [i64; 2]) -> Body {
        triangle(primitive, z.map(|z| [[-90, -90, z], [90, -90, z], [0, 90, z]]))
    }

    #[test]
    fn an_edge_that_just_touches_the_ray_leaves_the_triangle_whole() {
        // E = (2 t - 1)^2 for the first edge: it touches at t = 1/2.
        let touching = triangle(
            0,
            [[[-1, -2, 4], [1, -1, 4], [0, 40, 4]], [[-1, -2, 4], [1, -1, 4], [0, 40, 4]]],
        );
        assert_eq!(ahead(&[touching]), [(0.0, 1.0, 0)]);
        // P = (1 - 2 t, 1), Q = (0, 1 - 2 t): E is a square, so the third corner decides alone.
        let square = triangle(
            0,
            [[[-1, 1, 4], [0, -1, 4], [-9, -9, 4]], [[1, 1, 4], [0, 1, 4], [-9, 9, 4]]],
        );
        let found = ahead(&[square]);
        assert!(found.iter().all(|i| i.2 == 0), "{found:?}");
        let whole: f64 = found.iter().map(|i| i.1 - i.0).sum();
        let samples = 1000;
        let ray = ExactRay::new(0.0, 0.0, 0.0);
        let square = triangle(
            0,
            [[[-1, 1, 4], [0, -1, 4], [-9, -9, 4]], [[1, 1, 4], [0, 1, 4], [-9, 9, 4]]],
        );
        let met = (0..samples)
            .filter(|&k| depth(&square, &ray, &rational(2 * k + 1, 2 * samples as u64)).is_some());
        let share = met.count() as f64 / samples as f64;
        assert!((whole - share).abs() <= 4.0 / samples as f64, "{whole} {share}");
    }

    #[test]
    fn planes_that_cross_at_one_time_change_places_then() {
        // Depths 2 + 2 t and 4 - 2 t are equal at t = 1/2; a tie all the time goes to the lower number.
        assert_eq!(ahead(&[wall(1, [4, 2]), wall(0, [2, 4])]), [(0.0, 0.5, 0), (0.5, 1.0, 1)]);
        assert_eq!(ahead(&[wall(7, [3, 5]), wall(4, [3, 5])]), [(0.0, 1.0, 4)]);
    }

    #[test]
    fn what_passes_through_the_camera_is_seen_while_it_is_in_front() {
        assert_eq!(ahead(&[wall(0, [1, -3])]), [(0.0, 0.25, 0)]);
        assert_eq!(ahead(&[wall(0, [-1, 1])]), [(0.5, 1.0, 0)]);
    }

    /// Two roots for each of three edges, and inside at both ends: there is no more.
    #[test]
    fn a_triangle_can_cover_a_ray_for_four_intervals() {
        let ends = [[[-7, 5, 4], [-5, -5, 4], [3, 2, 4]], [[4, -3, 4], [5, 4, 4], [-4, 2, 4]]];
        let body = triangle(0, ends);
        let found = ahead(std::slice::from_ref(&body));
        assert_eq!(found.len(), 4, "{found:?}");
        assert!(found[0].0 == 0.0 && found[3].1 == 1.0, "{found:?}");
        let ray = ExactRay::new(0.0, 0.0, 0.0);
        for k in 0..400 {
            let t = rational(2 * k + 1, 800);
            let at = t.to_f64().value();
            let inside = found.iter().any(|i| i.0 < at && at < i.1);
            assert_eq!(depth(&body, &ray, &t).is_some(), inside, "{at}");
        }
    }

    #[test]
    fn the_camera_sees_the_back_wall_of_a_sphere_that_it_is_in() {
        // Centre from z = 8 to -8, radius 2: in front until the camera enters at t = 3/8, which it
        // leaves at 5/8; a wall at 9 behind.
        let found = ahead(&[ball(0, [[0, 0, 8], [0, 0, -8]], [2, 2]), wall(1, [9, 9])]);
        assert_eq!(found, [(0.0, 0.625, 0), (0.625, 1.0, 1)]);
        let ray = ExactRay::new(0.0, 0.0, 0.0);
        let body = ball(0, [[0, 0, 8], [0, 0, -8]], [2, 2]);
        let at = |n: i64| depth(&body, &ray, &rational(n, 16)).map(|d| d.to_f64());
        assert_eq!([at(4), at(8), at(12)], [Some(2.0), Some(2.0), None]);
    }

    #[test]
    fn spheres_that_cross_change_places_where_their_surfaces_meet() {
        // Front surfaces at 3 + 4 t and 5: equal at t = 1/2. A sphere that touches the ray is not met.
        let moving = ball(0, [[0, 0, 4], [0, 0, 8]], [1, 1]);
        let still = ball(1, [[0, 0, 7], [0, 0, 7]], [2, 2]);
        assert_eq!(ahead(&[moving, still]), [(0.0, 0.5, 0), (0.5, 1.0, 1)]);
        assert!(ahead(&[ball(0, [[2, 0, 9], [2, 0, 9]], [2, 2])]).is_empty());
    }

    fn coordinates() -> impl Strategy<Value = DVec3> {
        prop::array::uniform3(-4.0..4.0).prop_map(DVec3::from_array)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]

        /// Weights are sums of lengths: each pixel may be off by the errors of a few ends.
        #[test]
        fn the_solver_sees_what_the_algebraic_twin_sees(
            corners in prop::collection::vec(coordinates(), 18),
            spheres in prop::collection::vec((coordinates(), 0.2f32..1.5), 4),
            (v0, v1) in (coordinates(), coordinates()),
            reversed in any::<bool>(), see_through in any::<bool>(),
        ) {
            prop_assume!((v1 - v0).length() > 0.1);
            let stored = |p: &[DVec3]| -> Vec<[f32; 3]> {
                p.iter().map(|p| p.as_vec3().to_array()).collect()
            };
            let keys = vec![stored(&corners[..9]), stored(&corners[9..])];
            let (mesh, _) = Mesh::moving(keys, &[[0, 1, 2], [3, 4, 5], [6, 7, 8]]);
            let instance = Instance {
                mesh: MeshId(0),
                object: ObjectId(0),
                world_from_mesh: DAffine3::IDENTITY,
                first_primitive: PrimitiveId(0),
                occluder: !see_through,
                motion: None,
            };
            let of = |s: &(DVec3, f32)| Sphere { center: s.0.as_vec3().to_array(), radius: s.1 };
            let balls = [&spheres[..2], &spheres[2..]].map(|s| s.iter().map(of).collect());
            let first = PrimitiveId(3);
            let system =
                ParticleSystem::new(ObjectId(1), first, true, DVec3::ZERO, balls.to_vec()).0;
            let geometry =
                InstancedGeometry::with_motion(vec![mesh], vec![instance], vec![system], 1);
            let segment = ViewSegment { id: SegmentId(0), v0, v1 };
            let sampling = Sampling::with_columns(4, 4);
            let path = if reversed { TimePath::REVERSED } else { TimePath::FORWARD };
            let exact = solve_state(&geometry, &segment, sampling, 0, path);
            let options = SolveOptions::default();
            let runs = solve_states(&geometry, &segment, sampling, 0..1, path, None, &options);
            let found = &runs[0].visibility;
            let frame = RectifiedFrame::new(&segment).unwrap();
            let time = ErrorBounds::new(&geometry, &frame).time(sampling.column(3));
            for primitive in 0..5 {
                let twin = exact.iter().find(|s| s.primitive == primitive);
                let twin = twin.map_or(0.0, |s| s.weight);
                let own = found.set.iter().zip(&found.weights);
                let own = own.filter(|(p, _)| p.0 == primitive).map(|(_, w)| f64::from(*w));
                let own: f64 = own.sum();
                // Ends near double roots are known to the root of a rounding.
                let most = 16.0 * time.sqrt() * (own + twin) + 1e-6;
                prop_assert!((own - twin).abs() <= most, "{primitive}: {own} {twin}");
            }
        }
    }
}
