//! Triangles whose corners move, and spheres, against the rays of a row.
//!
//! Everything is relative to the camera: while the parameter t runs from 0 to 1, the camera moves by L
//! along x, and a corner with face coordinates P0 at the start and P1 at the end of the motion is at
//! the mean of `P0` and `P1 - (L, 0, 0)`, weighted by t. A ray is (c, w, 1) times its depth, the same for
//! every t. With
//!
//! ```text
//! g = x - c z        h = y - w z
//! ```
//!
//! both linear in t, the ray meets a triangle where the origin of the plane (g, h) is inside of the
//! triangle's image there.
//!
//! *Edges.* Row w is cut by an edge PQ while hP and hQ differ in sign (0 counts as above, as in
//! [`crate::cut`]): a corner changes sides at most once, at the root of a linear function, so for up to
//! two stretches of t. On such a stretch the edge's cut is at g = E / (hQ - hP) with
//!
//! ```text
//! E = gP hQ - gQ hP = X - c Z        X = xP hQ - xQ hP        Z = zP hQ - zQ hP
//! ```
//!
//! quadratics in t. This is the source's Eq. 4: E = d . ((a - v) x (b - v)). X and Z are the same for
//! all columns of a row. They are expanded on the stretch itself, where |hP| and |hQ| are at most
//! |hP - hQ|: over all of [0, 1] they would lose as many digits as h is larger elsewhere.
//!
//! *Coverage.* While a triangle is cut by a row, two of its edges are, and the ray is inside where
//! their g differ in sign. Signs change at roots of E, at most two an edge and stretch, so a
//! triangle covers a ray for up to four intervals of t.
//!
//! *Shared edges agree to the bit*: corners in canonical order, on a stretch that depends on the two
//! corners alone. Closed meshes do not leak.
//!
//! *Equal triangles agree to the bit*, whichever corner they begin with and whichever way they turn: all
//! is computed from the corners in canonical order. So what is in front of one is in front of all of them,
//! and the tie rule alone decides between them. Were their depths rounded apart, a third triangle that is
//! side by side with them would pass each at a time of its own, and between those times one that the tie
//! rule hides would be seen.
//!
//! *Depth* is N / D: see [`crate::arc`]. N = 0 is the camera in the triangle's plane, for all rays at
//! the same t; an interval that crosses it ends there, as only what is in front is seen.
//!
//! *Spheres.* |q x d|^2 = g^2 + h^2 + (g w - h c)^2, and the ray meets the ball where that is at most
//! k r^2: a quadratic with one stretch of t, since the ball is convex and moves linearly, whether or
//! not its radius changes. Nothing cancels when the sphere is small and far.
//!
//! Source: Popescu et al., from-segment visibility, sections 3.2 and 3.3; for spheres that cross each
//! other, which the source excludes, [`crate::arc::order`].

use glam::DVec3;
use sightline_geometry::{gamma, motion::lerp};

use crate::{
    arc::{Arc, Shape},
    bernstein::{Polynomial, cubic_on, linear, quadratic, quadratic_on},
    bounds::ErrorBounds,
    envelope::{largest, least},
    quadratic::sign_changes,
};

/// An interval of t, and the largest error of its ends.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Covered {
    /// Start.
    pub start: f64,
    /// End.
    pub end: f64,
    /// Largest error of either, in units of t.
    pub error: f64,
}

/// A list without memory of its own beyond `N` members.
#[derive(Clone, Copy, Debug)]
struct Few<T, const N: usize> {
    items: [T; N],
    len: usize,
}

impl<T: Copy + Default, const N: usize> Few<T, N> {
    fn new() -> Self {
        Self { items: [T::default(); N], len: 0 }
    }

    #[inline(always)]
    fn push(&mut self, item: T) {
        self.items[self.len] = item;
        self.len += 1;
    }

    #[inline(always)]
    fn of(&self) -> &[T] {
        &self.items[..self.len]
    }
}

/// A triangle whose corners move, relative to the camera.
#[derive(Clone, Debug)]
pub struct MovingTriangle {
    /// Corners at t = 0 and at t = 1, in canonical order.
    corners: [[DVec3; 3]; 2],
    /// Bernstein coefficients of the normal.
    normal: [DVec3; 3],
    /// ... of N.
    n: [f64; 4],
    n_error: f64,
    /// Largest length of the normal, for the error of D.
    normal_size: f64,
    /// Least and largest z of the corners.
    z: (f64, f64),
}

impl MovingTriangle {
    /// The triangle with these face coordinates, relative to the start of the segment, at t = 0 and at
    /// t = 1; `length` is that of the segment.
    #[inline]
    #[must_use]
    pub fn new(start: [DVec3; 3], end: [DVec3; 3], length: f64) -> Self {
        let [start, end] = canonical(start, end);
        // Largest length of the side opposite to each corner.
        let opposite = [0, 1, 2].map(|k| {
            let (i, j) = ((k + 1) % 3, (k + 2) % 3);
            (start[j] - start[i]).abs().max((end[j] - end[i]).abs()).length()
        });
        // The corner of the two shortest sides: a sliver's normal cancels least there.
        let most = largest(largest(opposite[0], opposite[1]), opposite[2]);
        let base = if opposite[0] == most { 0 } else { 1 + usize::from(opposite[1] != most) };
        let (i, j) = ((base + 1) % 3, (base + 2) % 3);
        // Edges first: the camera's motion is the same for all corners and would round them.
        let edges = |p: &[DVec3; 3]| (p[i] - p[base], p[j] - p[base]);
        let ((e0, f0), (e1, f1)) = (edges(&start), edges(&end));
        let normal = [e0.cross(f0), 0.5 * (e0.cross(f1) + e1.cross(f0)), e1.cross(f1)];
        let relative = |p: DVec3| DVec3::new(p.x - length, p.y, p.z);
        let end = end.map(relative);
        let (q0, q1) = (start[base], end[base]);
        let n = [
            normal[0].dot(q0),
            (normal[0].dot(q1) + 2.0 * normal[1].dot(q0)) / 3.0,
            (2.0 * normal[1].dot(q1) + normal[2].dot(q0)) / 3.0,
            normal[2].dot(q1),
        ];
        // Products of the largest components bound every term of the normal and of N.
        let normal_size = 2.0 * opposite[i] * opposite[j];
        let reach = q0.abs().max(q1.abs()).length();
        let mut z = (f64::INFINITY, f64::NEG_INFINITY);
        for p in start.iter().chain(&end) {
            z = (least(z.0, p.z), largest(z.1, p.z));
        }
        Self {
            corners: [start, end],
            normal,
            n,
            n_error: gamma(16) * normal_size * reach,
            normal_size,
            z,
        }
    }

    /// Least and largest depth of its corners, metres.
    #[must_use]
    pub const fn depths(&self) -> (f64, f64) {
        self.z
    }
}

/// The corners of a triangle at t = 0 and at t = 1, in lexicographic order: that of the first place, then
/// of the last.
#[inline(always)]
fn canonical(start: [DVec3; 3], end: [DVec3; 3]) -> [[DVec3; 3]; 2] {
    let mut corners = [(start[0], end[0]), (start[1], end[1]), (start[2], end[2])];
    for (i, j) in [(0, 1), (1, 2), (0, 1)] {
        let of = |k: usize| (corners[k].0.to_array(), corners[k].1.to_array());
        if of(i) > of(j) {
            corners.swap(i, j);
        }
    }
    [corners.map(|c| c.0), corners.map(|c| c.1)]
}

/// An edge's cut with a row, while it is cut.
#[derive(Clone, Copy, Debug, Default)]
struct MovingEnd {
    from: f64,
    to: f64,
    /// Bernstein coefficients on `from..to`.
    x: [f64; 3],
    z: [f64; 3],
    /// True when hQ > hP: g has the sign of E.
    upward: bool,
    /// Largest |hP - hQ| on the stretch: times the error of g, that of E.
    height: f64,
}

/// A stretch of t on which two edges are cut.
#[derive(Clone, Copy, Debug, Default)]
struct Piece {
    from: f64,
    to: f64,
    ends: [u8; 2],
    /// Largest error of `from` and `to`.
    error: f64,
}

/// A triangle in one row.
#[derive(Debug)]
pub struct MovingRow<'a> {
    triangle: &'a MovingTriangle,
    w: f64,
    ends: Few<MovingEnd, 6>,
    pieces: Few<Piece, 4>,
}

/// Sign changes of an edge's g at a column.
#[derive(Clone, Copy, Debug, Default)]
struct Changes {
    /// True when g >= 0 at the start of its stretch.
    positive: bool,
    count: usize,
    at: [f64; 2],
    error: [f64; 2],
}

impl Changes {
    #[inline(always)]
    fn new(end: &MovingEnd, c: f64, g_error: f64) -> Self {
        let e = [0, 1, 2].map(|i| end.x[i] - c * end.z[i]);
        let positive = (e[0] >= 0.0) == end.upward;
        let (count, places) = sign_changes(e[0], e[1], e[2]);
        let length = end.to - end.from;
        let mut out = Self { positive, count, ..Self::default() };
        let noise = g_error * end.height;
        for (k, &s) in places[..count].iter().enumerate() {
            out.at[k] = end.from + s * length;
            let slope = 2.0 * ((1.0 - s) * (e[1] - e[0]) + s * (e[2] - e[1]));
            out.error[k] = length * root_error(slope, e[0] - 2.0 * e[1] + e[2], noise);
        }
        out
    }

    /// Whether g >= 0 on the stretch behind `t`.
    #[inline(always)]
    fn is_positive_behind(&self, t: f64) -> bool {
        let passed = self.at[..self.count].iter().filter(|&&at| at <= t).count();
        self.positive == (passed % 2 == 0)
    }
}

/// How far a root of `slope x + bend x^2` may be moved by `noise`: to the root of the whole at +-noise.
/// Where the linear term is beyond doubt, 2 noise / slope; elsewhere the roots of |bend| x^2 = noise
/// and what the linear term adds.
#[inline(always)]
fn root_error(slope: f64, bend: f64, noise: f64) -> f64 {
    let (slope, bend) = (slope.abs(), bend.abs());
    if slope * slope >= 4.0 * bend * noise {
        if slope > 0.0 { 2.0 * noise / slope } else { 1.0 }
    } else {
        3.0 * (noise / bend).sqrt()
    }
}

/// The t at which a linear function changes its sign, and its error.
#[inline(always)]
fn crossing(h0: f64, h1: f64, noise: f64) -> (f64, f64) {
    let height = (h0 - h1).abs();
    let t = h0.abs() / height;
    (least(t, 1.0), least(2.0 * noise / height, 1.0))
}

impl<'a> MovingRow<'a> {
    /// The triangle in row `w`, if its plane cuts it at some t.
    #[must_use]
    pub fn new(triangle: &'a MovingTriangle, w: f64, bounds: &ErrorBounds) -> Option<Self> {
        let [start, end] = &triangle.corners;
        let h0 = start.map(|p| p.y - w * p.z);
        let h1 = end.map(|p| p.y - w * p.z);
        let above = |h: f64| h >= 0.0;
        let (a0, a1) = (h0.map(above), h1.map(above));
        let one_side = |a: &[bool; 3]| a[0] == a[1] && a[1] == a[2];
        if one_side(&a0) && a0 == a1 {
            return None;
        }
        let h_error = bounds.depth * (1.0 + w.abs());
        // When each corner changes sides; 2 for those that do not.
        let mut turns = [(2.0, 0.0); 3];
        for k in 0..3 {
            if a0[k] != a1[k] {
                turns[k] = crossing(h0[k], h1[k], h_error);
            }
        }
        let mut out = Self { triangle, w, ends: Few::new(), pieces: Few::new() };
        // Stretches of each edge on which its corners are on different sides.
        let mut stretches = [[(0.0, 0.0, 0u8); 2]; 3];
        let mut counts = [0; 3];
        for k in 0..3 {
            // From the first to the second in canonical order.
            let (p, q) = [(0, 1), (1, 2), (0, 2)][k];
            let (first, second) = (least(turns[p].0, turns[q].0), largest(turns[p].0, turns[q].0));
            let mut apart = a0[p] != a0[q];
            let mut from = 0.0;
            for to in [first, second, 1.0] {
                let to = least(to, 1.0);
                if apart && to > from {
                    stretches[k][counts[k]] = (from, to, out.ends.len as u8);
                    counts[k] += 1;
                    let turned = |corner: usize, t: f64| turns[corner].0 == t;
                    out.ends.push(moving_end(
                        (start[p], end[p], h0[p], h1[p]),
                        (start[q], end[q], h0[q], h1[q]),
                        (from, to),
                        [(turned(p, from), turned(q, from)), (turned(p, to), turned(q, to))],
                    ));
                }
                if to >= 1.0 {
                    break;
                }
                apart = !apart;
                from = to;
            }
        }
        // Elementary stretches between the turns of all corners.
        let mut borders = turns;
        borders.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut from, mut from_error) = (0.0, 0.0);
        for border in borders.into_iter().chain([(1.0, 0.0)]) {
            let (to, to_error) = if border.0 < 1.0 { border } else { (1.0, 0.0) };
            if to > from {
                let mut ends = [0u8; 2];
                let mut count = 0;
                for k in 0..3 {
                    for &(s, e, end) in &stretches[k][..counts[k]] {
                        // All are turns: even where no number lies between them, one holds the other.
                        if s <= from && to <= e && count < 2 {
                            ends[count] = end;
                            count += 1;
                        }
                    }
                }
                if count == 2 {
                    let error = largest(from_error, to_error);
                    out.pieces.push(Piece { from, to, ends, error });
                }
                (from, from_error) = (to, to_error);
            }
        }
        (out.pieces.len > 0).then_some(out)
    }

    /// The intervals of t on which the ray of column `c` meets the triangle in front of the camera;
    /// `covered(interval)`.
    #[inline(always)]
    pub fn coverage(&self, c: f64, bounds: &ErrorBounds, mut covered: impl FnMut(Covered)) {
        let mut covered = |whole: Covered| self.in_front(c, whole, bounds, &mut covered);
        let g_error = bounds.depth * (1.0 + c.abs());
        let mut changes = [Changes::default(); 6];
        for (change, end) in changes.iter_mut().zip(self.ends.of()) {
            *change = Changes::new(end, c, g_error);
        }
        let mut open = Covered::default();
        for piece in self.pieces.of() {
            let [a, b] = piece.ends.map(|k| &changes[k as usize]);
            let (mut at, mut error) = (piece.from, piece.error);
            loop {
                let inside = a.is_positive_behind(at) != b.is_positive_behind(at);
                // The next sign change of either edge.
                let (mut next, mut next_error) = (piece.to, piece.error);
                for change in [a, b] {
                    for k in 0..change.count {
                        if change.at[k] > at && change.at[k] < next {
                            (next, next_error) = (change.at[k], change.error[k]);
                        }
                    }
                }
                if inside && next > at {
                    let joins = open.end == at && open.start < open.end;
                    if joins {
                        open.end = next;
                        open.error = largest(open.error, next_error);
                    } else {
                        if open.start < open.end {
                            covered(open);
                        }
                        open = Covered { start: at, end: next, error: largest(error, next_error) };
                    }
                }
                (at, error) = (next, next_error);
                if at >= piece.to {
                    break;
                }
            }
        }
        if open.start < open.end {
            covered(open);
        }
    }

    /// The part of an interval on which the triangle is in front of the camera.
    #[inline(always)]
    fn in_front(
        &self,
        c: f64,
        whole: Covered,
        bounds: &ErrorBounds,
        covered: &mut impl FnMut(Covered),
    ) {
        if self.triangle.z.0 > bounds.depth {
            covered(whole);
        } else if self.triangle.z.1 > bounds.depth {
            self.cut_at_camera(c, whole, bounds, covered);
        }
    }

    /// Bernstein coefficients of D for column `c`.
    #[inline(always)]
    fn d(&self, c: f64) -> [f64; 3] {
        self.triangle.normal.map(|n| n.x * c + (n.y * self.w + n.z))
    }

    #[cold]
    #[inline(never)]
    fn cut_at_camera(
        &self,
        c: f64,
        whole: Covered,
        bounds: &ErrorBounds,
        covered: &mut impl FnMut(Covered),
    ) {
        let Covered { mut start, mut end, mut error } = whole;
        let [p, q] = &self.triangle.corners;
        let at = |t: f64| [0, 1, 2].map(|k| lerp(p[k], q[k], t));
        // Nothing is in front while all corners are behind: at one end at most, as the largest of three
        // linear functions is convex.
        let (first, last) = (at(start), at(end));
        let behind = |p: &[DVec3; 3]| p.iter().all(|p| p.z <= 0.0);
        if behind(&first) && behind(&last) {
            return;
        }
        if behind(&first) || behind(&last) {
            let from_start = behind(&first);
            let mut border = (if from_start { 1.0 } else { 0.0 }, 0.0);
            for k in 0..3 {
                if (first[k].z > 0.0) != (last[k].z > 0.0) {
                    let passes = crossing(first[k].z, last[k].z, bounds.depth);
                    let sooner = (passes.0 < border.0) == from_start;
                    border = if sooner { passes } else { border };
                }
            }
            error = largest(error, border.1 * (end - start));
            let place = start + border.0 * (end - start);
            *(if from_start { &mut start } else { &mut end }) = place;
            if start >= end {
                return;
            }
        }
        let whole = Covered { start, end, error };
        let length = end - start;
        // On the stretch itself: what moves fast is far away at other times, and its N as uncertain as
        // there. The corners are right to D, which moves the plane along its normal.
        let (first, last) = (at(start), at(end));
        let here = MovingTriangle::new(first, last, 0.0);
        if here.z.1 <= bounds.depth {
            return;
        }
        if here.z.0 > bounds.depth {
            covered(whole);
            return;
        }
        let (n, d) = (here.n, here.normal.map(|n| n.x * c + (n.y * self.w + n.z)));
        let noise = here.n_error + bounds.depth * here.normal_size;
        // Shares of the stretch, at most two for D and three for N. D changes its sign where a triangle is
        // turned over by being flat for an instant, which may be in the camera's place: then N does not.
        let mut borders = Few::<f64, 8>::new();
        borders.push(0.0);
        let (count, flat) = sign_changes(d[0], d[1], d[2]);
        flat[..count].iter().for_each(|&at| borders.push(at));
        Polynomial::new(&n).sign_changes(noise, |at| {
            if borders.len < 7 {
                borders.push(at);
            }
        });
        borders.push(1.0);
        let len = borders.len;
        borders.items[..len].sort_by(f64::total_cmp);
        // The mean of N over a part, over that of D: at one place the camera may just touch the plane.
        let on = |from: f64, to: f64| {
            let (n, d) = (cubic_on(n, from, to), quadratic_on(d, from, to));
            let z = (n.iter().sum::<f64>() / 4.0) / (d.iter().sum::<f64>() / 3.0);
            // D is 0 only where nothing is covered.
            if z.is_nan() { 0.0 } else { z }
        };
        // An end at the camera plane is off by what moves N by its noise, and D by that of the sides.
        let side = [first, last].iter().fold(0.0, |most, p| {
            largest(most, largest((p[1] - p[0]).length(), (p[2] - p[0]).length()))
        });
        let wide = 1.0 + c.abs() + self.w.abs();
        let d_noise = (gamma(12) * here.normal_size + 8.0 * bounds.depth * side) * wide;
        let own = |at: f64| {
            if at == 0.0 || at == 1.0 {
                return 0.0;
            }
            let off = if flat[..count].contains(&at) {
                let slope = 2.0 * linear([d[1] - d[0], d[2] - d[1]], at);
                root_error(slope, d[0] - 2.0 * d[1] + d[2], d_noise)
            } else {
                let slope = 3.0 * quadratic([n[1] - n[0], n[2] - n[1], n[3] - n[2]], at);
                let bend = 3.0 * linear([n[2] - 2.0 * n[1] + n[0], n[3] - 2.0 * n[2] + n[1]], at);
                root_error(slope, bend, 2.0 * noise)
            };
            length * least(off, 1.0)
        };
        for pair in borders.of().windows(2) {
            let (from, to) = (pair[0], pair[1]);
            if from >= to || on(from, to) <= bounds.depth {
                continue;
            }
            let error = largest(error, largest(own(from), own(to)));
            let place = |at: f64| if at == 1.0 { end } else { start + at * length };
            covered(Covered { start: place(from), end: place(to), error });
        }
    }

    /// The depth of the triangle along the ray of column `c`, where it covers the ray for `covered`.
    #[inline(always)]
    #[must_use]
    pub fn arc(&self, c: f64, covered: &Covered, bounds: &ErrorBounds) -> Arc {
        let t = self.triangle;
        let d = self.d(c);
        let d_error = gamma(12) * t.normal_size * (1.0 + c.abs());
        let shape = Shape::Rational { n: t.n, d, n_error: t.n_error, d_error };
        let near = largest(t.z.0, 0.0);
        Arc { shape, near, far: t.z.1, error: bounds.depth, time_error: covered.error }
    }
}

type Corner = (DVec3, DVec3, f64, f64);

/// The cut of the edge PQ on a stretch of t. `turned` tells of each end of the stretch whether P or Q is
/// on the row plane there.
#[inline(always)]
fn moving_end(
    p: Corner,
    q: Corner,
    (from, to): (f64, f64),
    turned: [(bool, bool); 2],
) -> MovingEnd {
    let at = |corner: &Corner, t: f64, on_plane: bool| {
        let (start, end, h0, h1) = *corner;
        let x = linear([start.x, end.x], t);
        let z = linear([start.z, end.z], t);
        (x, z, if on_plane { 0.0 } else { linear([h0, h1], t) })
    };
    let (p0, q0) = (at(&p, from, turned[0].0), at(&q, from, turned[0].1));
    let (p1, q1) = (at(&p, to, turned[1].0), at(&q, to, turned[1].1));
    let expand = |p0: f64, p1: f64, q0: f64, q1: f64, hp: (f64, f64), hq: (f64, f64)| {
        let middle = 0.5 * ((p0 * hq.1 + p1 * hq.0) - (q0 * hp.1 + q1 * hp.0));
        [p0 * hq.0 - q0 * hp.0, middle, p1 * hq.1 - q1 * hp.1]
    };
    let (hp, hq) = ((p0.2, p1.2), (q0.2, q1.2));
    let (d0, d1) = (hq.0 - hp.0, hq.1 - hp.1);
    MovingEnd {
        from,
        to,
        x: expand(p0.0, p1.0, q0.0, q1.0, hp, hq),
        z: expand(p0.1, p1.1, q0.1, q1.1, hp, hq),
        upward: d0 + d1 > 0.0,
        height: largest(d0.abs(), d1.abs()),
    }
}

/// A sphere that moves, relative to the camera.
#[derive(Clone, Copy, Debug)]
pub struct MovingSphere {
    center: [DVec3; 2],
    radius: [f64; 2],
}

impl MovingSphere {
    /// The sphere with these face coordinates of its centre, relative to the start of the segment, and
    /// these radii, at t = 0 and at t = 1; `length` is that of the segment.
    #[inline]
    #[must_use]
    pub fn new(center: [DVec3; 2], radius: [f64; 2], length: f64) -> Self {
        let [start, end] = center;
        Self { center: [start, DVec3::new(end.x - length, end.y, end.z)], radius }
    }

    /// Least depth of its surface, metres; negative where it reaches behind the camera.
    #[must_use]
    pub fn nearest(&self) -> f64 {
        let [a, b] = [0, 1].map(|k| self.center[k].z - self.radius[k]);
        least(a, b)
    }

    /// True when the plane y = w z may cut the sphere at some t.
    #[inline(always)]
    #[must_use]
    pub fn meets_row(&self, w: f64, bounds: &ErrorBounds) -> bool {
        let size = (1.0 + w * w).sqrt();
        let slack = 4.0 * bounds.depth * size;
        let above = |k: usize| {
            let (q, r) = (self.center[k], self.radius[k] * size + slack);
            let h = q.y - w * q.z;
            (h > r, h < -r)
        };
        let (a, b) = (above(0), above(1));
        !(a.0 && b.0 || a.1 && b.1)
    }

    /// The intervals of t on which the ray (c, w, 1) meets the sphere in front of the camera, and its
    /// depth there: from outside, and from inside while the camera is in it.
    #[inline(always)]
    pub fn coverage(
        &self,
        c: f64,
        w: f64,
        bounds: &ErrorBounds,
        mut covered: impl FnMut(Covered, Arc),
    ) {
        let [q0, q1] = self.center;
        let [r0, r1] = self.radius;
        let dd = 1.0 + c * c + w * w;
        let image = |q: DVec3| {
            let (g, h) = (q.x - c * q.z, q.y - w * q.z);
            (g, h, g * w - h * c)
        };
        let (a, b) = (image(q0), image(q1));
        let product = |a: (f64, f64, f64), b: (f64, f64, f64)| a.0 * b.0 + a.1 * b.1 + a.2 * b.2;
        // Positive where the ray meets the sphere.
        let g = [
            dd * r0 * r0 - product(a, a),
            dd * r0 * r1 - product(a, b),
            dd * r1 * r1 - product(b, b),
        ];
        let (count, places) = sign_changes(-g[0], -g[1], -g[2]);
        // -0 counts as positive: the ray that touches does not meet.
        let (start, end) = match (count, g[0] > 0.0) {
            (0, true) => (0.0, 1.0),
            (0, false) => return,
            (1, true) => (0.0, places[0]),
            (1, false) => (places[0], 1.0),
            // Convex: it cannot leave and come back.
            (_, true) => (0.0, 1.0),
            (_, false) => (places[0], places[1]),
        };
        if start >= end {
            return;
        }
        // An error of a coordinate moves g, h by (1 + |c|), (1 + |w|) of it, the third by both times
        // |d|; near the border each is at most r |d|.
        let size = dd.sqrt();
        let radius = largest(r0, r1);
        let moved = bounds.depth * (2.0 + c.abs() + w.abs()) * size;
        // What passes fast is far off at the ends, where products of that size are rounded.
        let products = dd * radius * radius + largest(product(a, a), product(b, b));
        let noise = 2.0 * size * radius * moved + moved * moved + gamma(8) * products;
        let bend = g[0] - 2.0 * g[1] + g[2];
        let slope_at = |t: f64| 2.0 * ((1.0 - t) * (g[1] - g[0]) + t * (g[2] - g[1]));
        let end_error = |t: f64| {
            if t > 0.0 && t < 1.0 { root_error(slope_at(t), bend, noise) } else { 0.0 }
        };
        let error = least(largest(end_error(start), end_error(end)), 1.0);
        let inverse = 1.0 / dd;
        let foot = [q0, q1].map(|q| (q.x * c + q.y * w + q.z) * inverse);
        let depth_error = bounds.depth * (1.0 + c.abs()) + noise.sqrt() * inverse;
        let reach = radius / size;
        let (low, high) = (least(foot[0], foot[1]) - reach, largest(foot[0], foot[1]) + reach);
        let arc = |from_inside: bool| Arc {
            shape: Shape::Ball { foot, g, noise, inverse, from_inside },
            near: largest(low, 0.0),
            far: high,
            error: bounds.depth * (1.0 + c.abs()),
            time_error: error,
        };
        let whole = Covered { start, end, error };
        if low > depth_error {
            covered(whole, arc(false));
            return;
        }
        if high <= depth_error {
            return;
        }
        self.around_camera(whole, bounds, &arc, &mut covered);
    }

    /// A sphere that reaches the camera plane: parts of an interval on which it is in front, seen from
    /// outside, or all around the camera.
    #[cold]
    #[inline(never)]
    fn around_camera(
        &self,
        whole: Covered,
        bounds: &ErrorBounds,
        arc: &dyn Fn(bool) -> Arc,
        covered: &mut dyn FnMut(Covered, Arc),
    ) {
        let [q0, q1] = self.center;
        let [r0, r1] = self.radius;
        // Negative while the camera is inside.
        let m =
            [q0.length_squared() - r0 * r0, q0.dot(q1) - r0 * r1, q1.length_squared() - r1 * r1];
        let mut borders = Few::<f64, 5>::new();
        borders.push(whole.start);
        let (count, places) = sign_changes(m[0], m[1], m[2]);
        let mut inner = Few::<f64, 3>::new();
        places[..count].iter().for_each(|&t| inner.push(t));
        // At the surface |q| is r, and each coordinate is off by D; and m is rounded.
        let (r, d) = (largest(r0, r1), bounds.depth);
        let products = r * r + largest(q0.length_squared(), q1.length_squared());
        let noise = 4.0 * r * d + 3.0 * d * d + gamma(8) * products;
        let bend = m[0] - 2.0 * m[1] + m[2];
        let slope_at = |t: f64| 2.0 * ((1.0 - t) * (m[1] - m[0]) + t * (m[2] - m[1]));
        let passing = places[..count]
            .iter()
            .fold(0.0, |most, &t| largest(most, least(root_error(slope_at(t), bend, noise), 1.0)));
        let whole = Covered { error: largest(whole.error, passing), ..whole };
        // Where the foot passes the camera plane, outside of the sphere: nothing is met there, but
        // rounding may say so.
        let Shape::Ball { foot, .. } = arc(false).shape else { return };
        if (foot[0] > 0.0) != (foot[1] > 0.0) {
            inner.push(foot[0] / (foot[0] - foot[1]));
        }
        let len = inner.len;
        inner.items[..len].sort_by(f64::total_cmp);
        for &t in inner.of() {
            if t > whole.start && t < whole.end {
                borders.push(t);
            }
        }
        borders.push(whole.end);
        for pair in borders.of().windows(2) {
            let (from, to) = (pair[0], pair[1]);
            let middle = 0.5 * (from + to);
            let inside = quadratic(m, middle) < 0.0;
            let in_front = inside || linear(foot, middle) > 0.0;
            if from < to && in_front {
                let arc = Arc { time_error: whole.error, ..arc(inside) };
                covered(Covered { start: from, end: to, ..whole }, arc);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn corner() -> impl Strategy<Value = (DVec3, DVec3)> {
        let place = || (-9.0..9.0, -9.0..9.0, -1.0..9.0).prop_map(DVec3::from);
        (place(), place())
    }

    /// Bits of all that is known of a triangle.
    fn bits(corners: &[(DVec3, DVec3)], order: [usize; 3]) -> Vec<u64> {
        let of = |end: fn(&(DVec3, DVec3)) -> DVec3| order.map(|k| end(&corners[k]));
        let t = MovingTriangle::new(of(|c| c.0), of(|c| c.1), 1.5);
        let vectors = t.corners.iter().flatten().chain(&t.normal).flat_map(|v| v.to_array());
        let rest = t.n.into_iter().chain([t.n_error, t.normal_size, t.z.0, t.z.1]);
        vectors.chain(rest).map(f64::to_bits).collect()
    }

    proptest! {
        #[test]
        fn equal_triangles_are_equal_to_the_bit(corners in prop::collection::vec(corner(), 3)) {
            let first = bits(&corners, [0, 1, 2]);
            for order in [[1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]] {
                prop_assert_eq!(&first, &bits(&corners, order));
            }
        }
    }
}
