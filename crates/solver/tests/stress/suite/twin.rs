//! The float twin: every triangle against every pixel, with bounds on what the solver may make
//! of each.
//!
//! Nothing is shared with the solver but the definition (frame, sampling) and the bounds that it
//! promises ([`ErrorBounds`]): no hierarchy, no culling, no lists that grow by insertion.
//!
//! The model of the solver's rounding, with D = `ErrorBounds::depth`, c a column, w a row:
//!
//! - A face coordinate of a vertex is off by at most D. So h = y - w z is off by at most
//!   H = D (1 + |w|). Where |h| <= H the vertex may fall on either side: every choice of sides is
//!   a *variant* of the cut. Coordinates that are coarse binary fractions in an axis-aligned frame
//!   are not rounded at all ([`is_coarse`]): there H = 0, and the sides are exact.
//! - The cut of an edge PQ is at lambda = hP / (hP - hQ). With hP + a, hQ + b, |a|, |b| <= H:
//!
//!   ```text
//!   lambda' - lambda = (b hP - a hQ) / ((hP - hQ) (hP - hQ + a - b))
//!   |lambda' - lambda| <= H / (|hP - hQ| - 2 H),   as |hP| + |hQ| = |hP - hQ|
//!   ```
//!
//!   (where rounding may have moved a vertex to the other side, |hP| + |hQ| is up to 2 H more than
//!   |hP - hQ|, and the bound as much larger), so it *slides* along its edge by up to that share of
//!   it, and is off the edge's line by at most D. Clipping at z = 0 has the same form, with z for h and an error of D plus the slide.
//! - A time t = (x - c z) / L is off by `ErrorBounds::time(c)` and by what the slide changes.
//! - A depth at t is off by D, by the slope of the cut times the error of t without the slide
//!   (never more than the cut's range of depths), and by how far the slid ends leave the cut's own
//!   line. Let devA and devB be these distances (in depth, to first order): while slides are under
//!   an eighth of the cut, its slope changes by at most (devA + devB) / (3/4 of its length), so
//!   twice the larger bounds the depth. For longer slides: the whole range of depths.
//! - The solver calls two depths equal when they differ by less than the sum of two such errors,
//!   and its own depths may be wrong by as much again; with what the twin itself rounds, one cut
//!   is certainly in front of another when three times their errors lie between.
//!
//! Two triangles of one plane ([`Planes`]) are certainly equal where the slides keep to the plane,
//! or where they are the same triangle twice: then the lower number is in front.
//!
//! At each t the *front* is what the solver may hold there: whatever no certain cut is in front
//! of, and what is not certainly behind one of these (equality within an error is not
//! transitive). A primitive is visible for certain where its cut certainly is and is in front of
//! all others that may be there.

use glam::{DAffine3, DMat3, DVec3};
use sightline_geometry::{
    FACE_COUNT, InstanceId, InstancedGeometry, PrimitiveId, RectifiedFrame, Sampling, UNIT_ROUNDOFF,
};
use sightline_solver::bounds::ErrorBounds;

use super::{case::Case, exact};

/// What keeps the certain and the possible weight of a primitive apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// An end of an interval: the error of a time.
    End,
    /// An interval no longer than `ErrorBounds::shortest_interval` is not counted.
    Short,
    /// A vertex within H of a row plane: rounding decides on which side.
    RowPlane,
    /// An edge nearly in the row plane: its cut slides along it.
    Sliding,
    /// An end within D of the camera plane or the axis.
    CameraPlane,
    /// Two depths closer than the errors of both.
    DepthTie,
}

pub const CAUSES: [Cause; 6] = [
    Cause::End,
    Cause::Short,
    Cause::RowPlane,
    Cause::Sliding,
    Cause::CameraPlane,
    Cause::DepthTie,
];

impl Cause {
    pub const fn name(self) -> &'static str {
        match self {
            Self::End => "end",
            Self::Short => "short",
            Self::RowPlane => "row plane",
            Self::Sliding => "sliding",
            Self::CameraPlane => "camera plane",
            Self::DepthTie => "depth tie",
        }
    }
}

/// What the twin says of one primitive at one pixel, in units of t.
#[derive(Clone, Copy, Debug)]
pub struct Seen {
    pub primitive: u32,
    /// Visible for certain on this much; possibly on that much; most likely on so much.
    pub certain: f64,
    pub possible: f64,
    pub likely: f64,
    /// The same without stretches that the solver does not count as they are too short, and with
    /// those that it must count.
    pub certain_counted: f64,
    pub possible_counted: f64,
    /// Lengths that are possible and not certain, by cause.
    pub open: [f64; CAUSES.len()],
}

/// A pixel and all that may be visible there.
pub struct Pixel<'a> {
    pub face: usize,
    pub row: u32,
    pub column: u32,
    pub seen: &'a [Seen],
    /// True when what is open could be seen in a comparison of sets or weights.
    pub undecided: bool,
}

struct Triangle {
    /// Coordinates along (s, a, b) of the frame, from v0.
    corners: [DVec3; 3],
    primitive: u32,
    occluder: bool,
    /// Number of its plane; `NO_PLANE` for what has no area.
    plane: u32,
    /// Number of the set of three corners.
    shape: u32,
}

/// Weights are compared as `f32`: a smaller part of the segment does not show in them.
const VISIBLE_DIFFERENCE: f64 = f32::EPSILON as f64;

const NO_PLANE: u32 = u32::MAX;

/// One end of a cut, and the step by which it may slide along its edge, either way.
#[derive(Clone, Copy, Debug)]
struct End {
    x: f64,
    z: f64,
    slide_x: f64,
    slide_z: f64,
}

/// One way in which a triangle may be cut by a row; z >= 0.
#[derive(Clone, Copy, Debug)]
struct Variant {
    a: End,
    b: End,
    likely: bool,
}

struct RowCut {
    triangle: u32,
    variants: std::ops::Range<usize>,
    /// False when the triangle may have no cut.
    certain: bool,
    /// Why there is more than one variant, or none for certain.
    cause: Cause,
}

/// Depth over t of a variant at a column, and three times its error.
#[derive(Clone, Copy, Debug)]
struct Line {
    t: f64,
    z: f64,
    slope: f64,
    near: f64,
    far: f64,
    margin: f64,
    /// True when the slides keep so close to the triangle's plane that equal depths stay equal
    /// within the solver's bound.
    keeps_to_plane: bool,
}

impl Line {
    fn depth(&self, t: f64) -> f64 {
        (self.z + (t - self.t) * self.slope).clamp(self.near, self.far)
    }
}

/// A triangle at one pixel: where it may be, where it is for certain, and how deep.
struct Stretch {
    triangle: u32,
    occluder: bool,
    /// True when another stretch of the pixel lies in its plane.
    has_ties: bool,
    possible: [f64; 2],
    certain: [f64; 2],
    /// Empty when the triangle most likely is not there.
    likely: [f64; 2],
    lines: std::ops::Range<usize>,
    likely_line: Line,
    keeps_to_plane: bool,
    /// What keeps `possible` and `certain` apart.
    cause: Cause,
    run_certain: f64,
    run_possible: f64,
    seen: Seen,
}

/// The twin of one case.
pub struct Twin<'a> {
    case: &'a Case,
    pub frame: RectifiedFrame,
    pub bounds: ErrorBounds,
    coarse: bool,
    triangles: Vec<Triangle>,
}

/// Sum and error of two numbers. Source: Knuth, TAOCP 2, 4.2.2.
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let s = a + b;
    let bb = s - a;
    (s, (a - (s - bb)) + (b - bb))
}

/// A number of some 100 bits, high and low part. Source: Dekker, "A floating-point technique for
/// extending the available precision".
#[derive(Clone, Copy)]
struct Double(f64, f64);

impl Double {
    fn plus(self, b: Self) -> Self {
        let (s, e) = two_sum(self.0, b.0);
        let (hi, lo) = two_sum(s, e + self.1 + b.1);
        Self(hi, lo)
    }

    fn times(self, b: f64) -> Self {
        let p = self.0 * b;
        let e = self.0.mul_add(b, -p);
        let (hi, lo) = two_sum(p, e + self.1 * b);
        Self(hi, lo)
    }
}

/// Coordinates of a mesh-space point along `axes`, from v0, each off by one rounding: the sums
/// before it are of some 100 bits.
fn coordinates(p: DVec3, map: &DAffine3, v0: DVec3, axes: &[DVec3; 3]) -> DVec3 {
    let m = map.matrix3;
    let relative: [Double; 3] = std::array::from_fn(|k| {
        Double(m.x_axis[k], 0.0)
            .times(p.x)
            .plus(Double(m.y_axis[k], 0.0).times(p.y))
            .plus(Double(m.z_axis[k], 0.0).times(p.z))
            .plus(Double(map.translation[k], 0.0))
            .plus(Double(-v0[k], 0.0))
    });
    let along = |axis: DVec3| {
        let [x, y, z] = relative;
        x.times(axis.x).plus(y.times(axis.y)).plus(z.times(axis.z)).0
    };
    DVec3::from_array(axes.map(along))
}

/// True for multiples of 2^-12 below 2^12: sums of products of two or three such numbers are
/// exact in any order, since they are multiples of 2^-36 below 2^17 with few terms at the extremes
/// (a row coordinate, one frame component of 0 or 1 and one coordinate in each).
fn is_coarse(v: f64) -> bool {
    let scaled = v * 4096.0;
    scaled == scaled.round() && v.abs() < 4096.0
}

fn is_coarse_case(case: &Case, frame: &RectifiedFrame) -> bool {
    let signs = |v: DVec3| v.to_array().iter().all(|x| [0.0, 1.0].contains(&x.abs()));
    let coarse3 = |v: DVec3| v.to_array().into_iter().all(is_coarse);
    let face = frame.face(0);
    let frame_is = [face.axis, face.up, face.forward].into_iter().all(signs);
    let maps_are = case.geometry.instances.iter().all(|i| {
        let m: DMat3 = i.world_from_mesh.matrix3;
        [m.x_axis, m.y_axis, m.z_axis].into_iter().all(signs)
            && coarse3(i.world_from_mesh.translation)
    });
    let points = case.geometry.meshes.iter().flat_map(|m| &m.positions);
    let rows_are = (0..case.sampling.rows()).all(|r| is_coarse(case.sampling.row(r)));
    frame_is
        && maps_are
        && rows_are
        && coarse3(frame.v0)
        && points.copied().flatten().all(|v| is_coarse(f64::from(v)))
}

/// Sorts triangles into planes and shapes. Planes are exact: in doubt, rational arithmetic
/// decides. Larger scenes than this keep a plane a triangle; their ties stay open.
const PLANES_MAX: usize = 96;

fn assign_planes(case: &Case, triangles: &mut [Triangle], reach: f64) {
    let mut shapes: Vec<[DVec3; 3]> = Vec::new();
    let mut planes: Vec<usize> = Vec::new();
    let count = triangles.len();
    for i in 0..count {
        triangles[i].plane = i as u32;
        triangles[i].shape = i as u32;
        if count > PLANES_MAX {
            continue;
        }
        let mut sorted = triangles[i].corners;
        sorted.sort_by(|p, q| p.to_array().partial_cmp(&q.to_array()).expect("finite"));
        let shape = shapes.iter().position(|s| *s == sorted);
        shapes.push(sorted);
        triangles[i].shape = shape.unwrap_or(i) as u32;
        if exact::is_degenerate(&case.geometry, triangles[i].primitive) {
            triangles[i].plane = NO_PLANE;
            continue;
        }
        let same = planes.iter().copied().find(|&k| {
            may_be_coplanar(&triangles[k].corners, &triangles[i].corners, reach)
                && exact::are_coplanar(
                    &case.geometry,
                    triangles[k].primitive,
                    triangles[i].primitive,
                )
        });
        match same {
            Some(k) => triangles[i].plane = k as u32,
            None => planes.push(i),
        }
    }
}

/// False only when a corner of `other` is certainly off the plane of `one`: coordinates up to
/// `reach` are off by one rounding each, a difference by 3 u `reach`, and a product of three
/// differences by three such terms and 9 roundings of its own, under 32 u in all.
fn may_be_coplanar(one: &[DVec3; 3], other: &[DVec3; 3], reach: f64) -> bool {
    let (e, f) = (one[1] - one[0], one[2] - one[0]);
    let normal = e.cross(f);
    other.iter().all(|p| {
        let d = *p - one[0];
        let [le, lf, ld] = [e, f, d].map(DVec3::length);
        let error = 32.0 * UNIT_ROUNDOFF * (reach * (le * lf + lf * ld + ld * le) + le * lf * ld);
        normal.dot(d).abs() <= error
    })
}

/// Which of two sides a number may be on, when it is off by at most `error`: (not below, below).
fn sides(v: f64, error: f64) -> [bool; 2] {
    [v >= -error, v < error]
}

impl<'a> Twin<'a> {
    pub fn new(case: &'a Case) -> Option<Self> {
        let frame = RectifiedFrame::new(&case.segment)?;
        let bounds = ErrorBounds::new(&case.geometry, &frame);
        let face = frame.face(0);
        let axes = [face.axis, face.forward, face.up];
        let mut triangles = Vec::new();
        for (number, instance) in case.geometry.instances.iter().enumerate() {
            let mesh = &case.geometry.meshes[instance.mesh.index()];
            let primitives = case.geometry.primitives_of(InstanceId(number as u32));
            for (t, primitive) in primitives.enumerate() {
                let place = |p| coordinates(p, &instance.world_from_mesh, frame.v0, &axes);
                triangles.push(Triangle {
                    corners: mesh.corners(t).map(place),
                    primitive,
                    occluder: instance.occluder,
                    plane: 0,
                    shape: 0,
                });
            }
        }
        let corners = triangles.iter().flat_map(|t| t.corners);
        let reach = corners.fold(frame.length, |m, p| m.max(p.abs().max_element()));
        assign_planes(case, &mut triangles, reach);
        let coarse = is_coarse_case(case, &frame);
        Some(Self { case, frame, bounds, coarse, triangles })
    }

    /// Visits every pixel.
    pub fn visit(&self, mut visit: impl FnMut(&Pixel)) {
        let sampling = self.case.sampling;
        let mut work = Work::default();
        for face in 0..FACE_COUNT {
            for row in 0..sampling.rows() {
                self.cut(face, sampling.row(row), &mut work);
                for column in 0..sampling.columns() {
                    let undecided = self.pixel(sampling.column(column), &mut work);
                    visit(&Pixel { face, row, column, seen: &work.seen, undecided });
                }
            }
        }
    }

    /// Face coordinates: forward is +a, +b, -a, -b and up is +b, -a, -b, +a, as in
    /// [`RectifiedFrame::face`].
    fn in_face(face: usize, p: DVec3) -> DVec3 {
        match face {
            0 => p.with_y(p.z).with_z(p.y),
            1 => p.with_y(-p.y),
            2 => p.with_y(-p.z).with_z(-p.y),
            _ => p.with_z(-p.z),
        }
    }

    /// All variants of all cuts of a row.
    fn cut(&self, face: usize, w: f64, work: &mut Work) {
        work.cuts.clear();
        work.variants.clear();
        let side_error = if self.coarse { 0.0 } else { self.bounds.depth * (1.0 + w.abs()) };
        for (number, triangle) in self.triangles.iter().enumerate() {
            let p = triangle.corners.map(|p| Self::in_face(face, p));
            let h = p.map(|p| p.y - w * p.z);
            let may =
                h.map(|h| if self.coarse { [h >= 0.0, h < 0.0] } else { sides(h, side_error) });
            let first = work.variants.len();
            let (mut certain, mut sure_sides) = (true, true);
            for pattern in 0..8usize {
                let above: [bool; 3] = std::array::from_fn(|k| pattern >> k & 1 == 1);
                if !(0..3).all(|k| may[k][usize::from(!above[k])]) {
                    continue;
                }
                let likely = (0..3).all(|k| above[k] == (h[k] >= 0.0));
                let alone = match above {
                    [a, b, c] if a == b && b == c => {
                        certain = false;
                        continue;
                    }
                    [a, b, _] if a == b => 2,
                    [a, _, c] if a == c => 1,
                    _ => 0,
                };
                sure_sides &= may.iter().all(|m| m[0] != m[1]);
                let (i, j) = ((alone + 1) % 3, (alone + 2) % 3);
                let a = edge_end(p[alone], p[i], h[alone], h[i], side_error);
                let b = edge_end(p[alone], p[j], h[alone], h[j], side_error);
                certain &= clip(a, b, self.bounds.depth, likely, &mut work.variants);
            }
            if work.variants.len() > first {
                let cause = if sure_sides { Cause::CameraPlane } else { Cause::RowPlane };
                let variants = first..work.variants.len();
                work.cuts.push(RowCut { triangle: number as u32, variants, certain, cause });
            }
        }
    }

    /// Fills `work.seen` with what is seen at column `c` of the row that was cut. True when what is
    /// open could be seen in a comparison of sets or weights.
    fn pixel(&self, c: f64, work: &mut Work) -> bool {
        work.stretches.clear();
        work.lines.clear();
        work.seen.clear();
        for cut in &work.cuts {
            let variants = &work.variants[cut.variants.clone()];
            let stretch = self.stretch(cut, variants, c, &mut work.lines);
            work.stretches.extend(stretch);
        }
        if work.stretches.is_empty() {
            return false;
        }
        work.stretches.sort_by(|a, b| a.possible[0].total_cmp(&b.possible[0]));
        self.borders(work);
        let shortest = self.bounds.shortest_interval(c);
        self.mark_ties(&mut work.stretches);
        let mut entered = 0;
        work.active.clear();
        for k in 1..work.borders.len() {
            let (from, to) = (work.borders[k - 1], work.borders[k]);
            while entered < work.stretches.len() && work.stretches[entered].possible[0] <= from {
                work.active.push(entered as u32);
                entered += 1;
            }
            let stretches = &mut work.stretches;
            work.active.retain(|&i| stretches[i as usize].possible[1] > from);
            if work.active.is_empty() {
                continue;
            }
            let moment = Moment { t: 0.5 * (from + to), length: to - from, shortest };
            self.elementary(&moment, stretches, &work.lines, &mut work.here, &work.active);
        }
        let mut undecided = false;
        for stretch in &mut work.stretches {
            stretch.end_certain_run(shortest);
            stretch.end_possible_run(shortest);
            let seen = &mut stretch.seen;
            if !stretch.occluder {
                // Of a see-through primitive the sum counts.
                seen.certain_counted = if seen.certain > shortest { seen.certain } else { 0.0 };
                seen.possible_counted = if seen.possible > shortest { seen.possible } else { 0.0 };
            }
            let open = seen.possible_counted - seen.certain_counted;
            undecided |= open > VISIBLE_DIFFERENCE
                || seen.certain_counted == 0.0 && seen.possible_counted > 0.0;
            work.seen.push(stretch.seen);
        }
        undecided
    }

    /// Notes which stretches are tied to another one of the pixel.
    fn mark_ties(&self, stretches: &mut [Stretch]) {
        if self.triangles.len() > PLANES_MAX {
            return;
        }
        for i in 1..stretches.len() {
            let (before, rest) = stretches.split_at_mut(i);
            for other in before {
                if self.share_a_plane(other, &rest[0]) {
                    other.has_ties = true;
                    rest[0].has_ties = true;
                }
            }
        }
    }

    fn stretch(
        &self,
        cut: &RowCut,
        variants: &[Variant],
        c: f64,
        lines: &mut Vec<Line>,
    ) -> Option<Stretch> {
        let first = lines.len();
        let mut possible = [f64::INFINITY, f64::NEG_INFINITY];
        let mut certain = if cut.certain {
            [f64::NEG_INFINITY, f64::INFINITY]
        } else {
            [f64::INFINITY, f64::NEG_INFINITY]
        };
        let mut likely = [0.0, 0.0];
        let mut likely_line = None;
        let mut slides = false;
        for variant in variants {
            let placed = Placed::new(variant, c, &self.frame, &self.bounds);
            possible = [possible[0].min(placed.possible[0]), possible[1].max(placed.possible[1])];
            certain = [certain[0].max(placed.certain[0]), certain[1].min(placed.certain[1])];
            slides |= placed.slides;
            if variant.likely {
                likely = placed.likely;
                likely_line = Some(placed.line);
            }
            lines.push(placed.line);
        }
        let possible = possible.map(|t| t.clamp(0.0, 1.0));
        if possible[0] >= possible[1] {
            lines.truncate(first);
            return None;
        }
        let cause = match (cut.certain && variants.len() == 1, slides) {
            (false, _) => cut.cause,
            (true, true) => Cause::Sliding,
            (true, false) => Cause::End,
        };
        let triangle = &self.triangles[cut.triangle as usize];
        Some(Stretch {
            triangle: cut.triangle,
            occluder: triangle.occluder,
            has_ties: false,
            possible,
            certain,
            likely,
            likely_line: likely_line.unwrap_or(lines[first]),
            keeps_to_plane: lines[first..].iter().all(|l| l.keeps_to_plane),
            lines: first..lines.len(),
            cause,
            run_certain: 0.0,
            run_possible: 0.0,
            seen: Seen {
                primitive: triangle.primitive,
                certain: 0.0,
                possible: 0.0,
                likely: 0.0,
                certain_counted: 0.0,
                possible_counted: 0.0,
                open: [0.0; CAUSES.len()],
            },
        })
    }

    /// Sorted borders in [0, 1] between which no answer changes: ends of stretches, and where the
    /// depths of two, give or take their margins, cross.
    fn borders(&self, work: &mut Work) {
        let borders = &mut work.borders;
        borders.clear();
        borders.extend([0.0, 1.0]);
        for (i, s) in work.stretches.iter().enumerate() {
            for t in [s.possible, s.certain, s.likely].into_iter().flatten() {
                if t > 0.0 && t < 1.0 {
                    borders.push(t);
                }
            }
            for other in &work.stretches[i + 1..] {
                if other.possible[0] >= s.possible[1] {
                    break;
                }
                let (from, to) = (other.possible[0], other.possible[1].min(s.possible[1]));
                for a in &work.lines[s.lines.clone()] {
                    for b in &work.lines[other.lines.clone()] {
                        crossings(a, b, from, to, borders);
                    }
                }
            }
        }
        borders.sort_by(f64::total_cmp);
        borders.dedup();
    }

    /// True when the two lie in one plane, or are one triangle twice.
    fn share_a_plane(&self, a: &Stretch, b: &Stretch) -> bool {
        let (one, other) =
            (&self.triangles[a.triangle as usize], &self.triangles[b.triangle as usize]);
        one.shape == other.shape || one.plane == other.plane && one.plane != NO_PLANE
    }

    /// True when the solver must find the depths of both equal everywhere.
    fn are_tied(&self, a: &Stretch, b: &Stretch) -> bool {
        a.has_ties
            && b.has_ties
            && self.share_a_plane(a, b)
            && (a.keeps_to_plane && b.keeps_to_plane
                || self.triangles[a.triangle as usize].shape
                    == self.triangles[b.triangle as usize].shape)
    }

    /// True when `a` is in front of `b` for certain, where both are: an occluder before an
    /// occluder, or before something see-through, which is not hidden by its equal.
    fn is_before(&self, a: &Here, b: &Here, stretches: &[Stretch]) -> bool {
        let (one, other) = (&stretches[a.stretch as usize], &stretches[b.stretch as usize]);
        if self.are_tied(one, other) {
            return match (one.occluder, other.occluder) {
                (true, true) => one.seen.primitive < other.seen.primitive,
                (true, false) => false,
                (false, _) => true,
            };
        }
        a.far < b.near
    }

    /// Who is visible on a stretch of t on which nothing changes.
    fn elementary(
        &self,
        moment: &Moment,
        stretches: &mut [Stretch],
        lines: &[Line],
        here: &mut Vec<Here>,
        active: &[u32],
    ) {
        here.clear();
        let mut no_ties = true;
        for &i in active {
            let s = &stretches[i as usize];
            let t = moment.t;
            let covers = |range: [f64; 2]| range[0] <= t && t < range[1];
            if !covers(s.possible) {
                continue;
            }
            let (mut near, mut far) = (f64::INFINITY, f64::NEG_INFINITY);
            for line in &lines[s.lines.clone()] {
                let z = line.depth(t);
                near = near.min(z - line.margin);
                far = far.max(z + line.margin);
            }
            no_ties &= !s.has_ties;
            here.push(Here {
                stretch: i,
                near,
                far,
                z: s.likely_line.depth(t),
                must: covers(s.certain),
                likely: covers(s.likely),
                occluder: s.occluder,
                front: false,
            });
        }
        self.find_front(here, stretches, no_ties);
        let covered = here.iter().any(|h| h.occluder && h.must);
        for k in 0..here.len() {
            let h = &here[k];
            let possible = if h.occluder {
                h.front
            } else {
                !covered || here.iter().any(|f| f.front && !self.is_before(f, h, stretches))
            };
            let rival = here
                .iter()
                .enumerate()
                .find(|&(m, r)| m != k && r.occluder && !self.is_before(h, r, stretches))
                .map(|(_, r)| r);
            let certain = possible && h.must && rival.is_none();
            let likely = h.likely && !self.is_likely_hidden(k, here, stretches);
            let cause = match rival {
                _ if !h.must => stretches[h.stretch as usize].cause,
                None => Cause::End,
                Some(r) if r.must => Cause::DepthTie,
                Some(r) => stretches[r.stretch as usize].cause,
            };
            stretches[h.stretch as usize].note(moment, possible, certain, likely, cause);
        }
    }

    /// Marks what the solver may hold: see the top of the file.
    fn find_front(&self, here: &mut [Here], stretches: &[Stretch], no_ties: bool) {
        if no_ties {
            let certain = here.iter().filter(|h| h.occluder && h.must).map(|h| h.far);
            let mut reach = certain.fold(f64::INFINITY, f64::min);
            loop {
                let mut farther = reach;
                for h in here.iter_mut().filter(|h| h.occluder && !h.front && h.near <= reach) {
                    h.front = true;
                    farther = farther.max(h.far);
                }
                if farther == reach {
                    return;
                }
                reach = farther;
            }
        }
        for k in 0..here.len() {
            let hidden = here.iter().enumerate().any(|(m, other)| {
                m != k && other.occluder && other.must && self.is_before(other, &here[k], stretches)
            });
            here[k].front = here[k].occluder && !hidden;
        }
        let mut grows = true;
        while grows {
            grows = false;
            for k in 0..here.len() {
                if here[k].front || !here[k].occluder {
                    continue;
                }
                let joins = here.iter().any(|f| f.front && !self.is_before(f, &here[k], stretches));
                here[k].front |= joins;
                grows |= joins;
            }
        }
    }

    /// True when an occluder is most likely in front of number `k`.
    fn is_likely_hidden(&self, k: usize, here: &[Here], stretches: &[Stretch]) -> bool {
        let h = &here[k];
        let own = &stretches[h.stretch as usize];
        here.iter().enumerate().any(|(m, r)| {
            if m == k || !r.occluder || !r.likely {
                return false;
            }
            let rival = &stretches[r.stretch as usize];
            let tied =
                r.z == h.z || own.has_ties && rival.has_ties && self.share_a_plane(own, rival);
            if tied { h.occluder && rival.seen.primitive < own.seen.primitive } else { r.z < h.z }
        })
    }
}

/// A stretch of t on which nothing changes: its middle, its length, and the length up to which
/// intervals are not counted.
struct Moment {
    t: f64,
    length: f64,
    shortest: f64,
}

/// A stretch at one t.
struct Here {
    stretch: u32,
    near: f64,
    far: f64,
    z: f64,
    must: bool,
    likely: bool,
    occluder: bool,
    front: bool,
}

impl Stretch {
    fn note(&mut self, moment: &Moment, possible: bool, certain: bool, likely: bool, cause: Cause) {
        if likely {
            self.seen.likely += moment.length;
        }
        if possible {
            self.seen.possible += moment.length;
            self.run_possible += moment.length;
        } else {
            self.end_possible_run(moment.shortest);
        }
        if certain {
            self.seen.certain += moment.length;
            self.run_certain += moment.length;
        } else {
            self.end_certain_run(moment.shortest);
        }
        if possible && !certain {
            self.seen.open[cause as usize] += moment.length;
        }
    }

    fn end_certain_run(&mut self, shortest: f64) {
        let run = std::mem::take(&mut self.run_certain);
        if !self.occluder || run == 0.0 {
            return;
        }
        // The sum of a run is off by a rounding a border; `shortest` is at least 64 u, so a
        // relative 2^-20 is beyond doubt for a million borders.
        if run > shortest * (1.0 + 1.0 / f64::from(1 << 20)) {
            self.seen.certain_counted += run;
        } else {
            self.seen.open[Cause::Short as usize] += run;
        }
    }

    fn end_possible_run(&mut self, shortest: f64) {
        let run = std::mem::take(&mut self.run_possible);
        if self.occluder && run > shortest * (1.0 - 1.0 / f64::from(1 << 20)) {
            self.seen.possible_counted += run;
        }
    }
}

/// Where two edges' heights put a cut, and how far it may slide.
fn edge_end(p: DVec3, q: DVec3, hp: f64, hq: f64, side_error: f64) -> End {
    let height = (hp - hq).abs();
    // The true heights may be on one side both; lambda is then beyond an end, and clamped.
    let lambda = if height > 0.0 { (hp / (hp - hq)).clamp(0.0, 1.0) } else { 0.5 };
    // The rounding of lambda itself: three operations.
    let own = 4.0 * UNIT_ROUNDOFF;
    let slide = if height > 2.0 * side_error {
        let spread = 1.0 + 2.0 * side_error / height;
        (side_error * spread / (height - 2.0 * side_error) + own).min(1.0)
    } else {
        1.0
    };
    let (x, z) = (q.x - p.x, q.z - p.z);
    End { x: p.x + lambda * x, z: p.z + lambda * z, slide_x: slide * x, slide_z: slide * z }
}

/// Adds the variants of a cut after clipping at z = 0. True when it certainly has one.
fn clip(a: End, b: End, depth: f64, likely: bool, out: &mut Vec<Variant>) -> bool {
    let error = |e: &End| depth + e.slide_z.abs();
    let (may_a, may_b) = (sides(a.z, error(&a)), sides(b.z, error(&b)));
    // Cuts no deeper than the bound lie on the axis and are dropped; so may be those a bound
    // deeper.
    let mut certain = (a.z - error(&a)).max(b.z - error(&b)) > depth;
    for (a_in_front, b_in_front) in [(true, true), (true, false), (false, true), (false, false)] {
        if !may_a[usize::from(!a_in_front)] || !may_b[usize::from(!b_in_front)] {
            continue;
        }
        let likely = likely && a_in_front == (a.z > 0.0) && b_in_front == (b.z > 0.0);
        match (a_in_front, b_in_front) {
            (false, false) => certain = false,
            (true, true) => {
                let front = |e: End| End { z: e.z.max(0.0), ..e };
                out.push(Variant { a: front(a), b: front(b), likely });
            }
            (a_front, _) => {
                let (front, behind) = if a_front { (a, b) } else { (b, a) };
                let off = error(&front).max(error(&behind));
                let height = (front.z - behind.z).abs();
                let (lambda, slide) = if height > 2.0 * off {
                    let lambda = (front.z / (front.z - behind.z)).clamp(0.0, 1.0);
                    let spread = 1.0 + 2.0 * off / height;
                    (lambda, (off * spread / (height - 2.0 * off) + 4.0 * UNIT_ROUNDOFF).min(1.0))
                } else {
                    (0.5, 1.0)
                };
                let x = behind.x - front.x;
                let slide_x = (slide * x).abs() + front.slide_x.abs().max(behind.slide_x.abs());
                let on_axis = End { x: front.x + lambda * x, z: 0.0, slide_x, slide_z: 0.0 };
                let front = End { z: front.z.max(0.0), ..front };
                out.push(Variant { a: front, b: on_axis, likely });
            }
        }
    }
    certain
}

/// A variant at one column.
struct Placed {
    possible: [f64; 2],
    certain: [f64; 2],
    likely: [f64; 2],
    line: Line,
    slides: bool,
}

impl Placed {
    fn new(variant: &Variant, c: f64, frame: &RectifiedFrame, bounds: &ErrorBounds) -> Self {
        let inverse = 1.0 / frame.length;
        let time = bounds.time(c);
        let at = |e: &End| (e.x - c * e.z) * inverse;
        let slide = |e: &End| (e.slide_x - c * e.slide_z) * inverse;
        // An end on the axis slides in both signs of x: its slide has no direction in z.
        let (ta, tb) = (at(&variant.a), at(&variant.b));
        let (a, b, ta, tb) =
            if ta <= tb { (variant.a, variant.b, ta, tb) } else { (variant.b, variant.a, tb, ta) };
        let (sa, sb) = (slide(&a), slide(&b));
        let (ea, eb) = (time + sa.abs(), time + sb.abs());
        let possible = [(ta - ea).min(tb - eb), (tb + eb).max(ta + ea)];
        let certain = [ta + ea, tb - eb];
        let (near, far) = (a.z.min(b.z), a.z.max(b.z));
        let (range, length) = (far - near, tb - ta);
        let slope = if length > 0.0 { (b.z - a.z) / length } else { 0.0 };
        let by_time = (slope.abs() * time).min(range);
        let slides = sa.abs().max(sb.abs()) > time;
        let straight = sa.abs() + sb.abs() <= 0.125 * length;
        let (margin, off_plane, near, far) = if straight {
            let off = |e: &End, s: f64| (e.slide_z - slope * s).abs();
            // Where the end is on the axis, z stays 0 and only t moves: to either side.
            let off_plane = 2.0 * off(&a, sa).max(off(&b, sb));
            let (low, high) = (a.slide_z.abs().max(b.slide_z.abs()), bounds.depth);
            (
                3.0 * (bounds.depth + off_plane + by_time),
                off_plane,
                near - low - high,
                far + low + high,
            )
        } else {
            let all = range + a.slide_z.abs().max(b.slide_z.abs());
            (3.0 * (bounds.depth + all), f64::INFINITY, near, far)
        };
        // Four roundings of the twin's own numbers are an eighth of the bound.
        let keeps_to_plane = off_plane <= 0.25 * bounds.depth;
        let line = Line { t: ta, z: a.z, slope, near, far, margin, keeps_to_plane };
        Self { possible, certain, likely: [ta, tb], line, slides }
    }
}

/// Where `a` with its margin comes in front of `b` with its own, or the other way round.
fn crossings(a: &Line, b: &Line, from: f64, to: f64, out: &mut Vec<f64>) {
    let slope = a.slope - b.slope;
    let at_zero = (a.z - a.slope * a.t) - (b.z - b.slope * b.t);
    let margin = a.margin + b.margin;
    for difference in [-margin, 0.0, margin] {
        let t = (difference - at_zero) / slope;
        if t > from && t < to && t > 0.0 && t < 1.0 {
            out.push(t);
        }
    }
}

/// Memory that is kept from pixel to pixel.
#[derive(Default)]
struct Work {
    cuts: Vec<RowCut>,
    variants: Vec<Variant>,
    stretches: Vec<Stretch>,
    lines: Vec<Line>,
    borders: Vec<f64>,
    active: Vec<u32>,
    here: Vec<Here>,
    seen: Vec<Seen>,
}

/// World-space name of a primitive, for reports.
pub fn describe(geometry: &InstancedGeometry, primitive: u32) -> String {
    let corners = geometry.triangle(PrimitiveId(primitive)).corners;
    format!("{primitive}: {corners:?}")
}

/// The solid-angle shares of a pixel.
pub fn share(sampling: Sampling, row: u32, column: u32) -> f64 {
    let (i, j) = (f64::from(row), f64::from(column));
    let (c0, c1) = (sampling.c(j), sampling.c(j + 1.0));
    let (w0, w1) = (sampling.w(i), sampling.w(i + 1.0));
    Sampling::solid_angle(c0, c1, w0, w1) / (4.0 * std::f64::consts::PI)
}
