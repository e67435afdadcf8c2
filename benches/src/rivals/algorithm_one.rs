//! Algorithm 1 of the source, as published: a list of visibility intervals a pixel of a cube map.
//!
//! Reference: Popescu, Lee, Choi, Fahmy, "Complex VEs on All-In-One VR Headsets Through Continuous
//! From-Segment Visibility Computation", sections 3.1 and 4.1.
//!
//! For every face of the cube map and every triangle: the pixels in the convex hull of the
//! projections from both ends of the segment; for each of them the interval of t on which the
//! triangle covers its centre (their Eq. 2); depth composition with the pixel's list. No triangle is
//! culled for being hidden. Several runs turn the cube map.
//!
//! With a' = a - v0, b' = b - v0 and D = v1 - v0, the pixel of direction d is on edge ab when
//!
//! ```text
//! f(t) = d . ((a' - t D) x (b' - t D)) = d . (a' x b') - t d . (D x (b' - a')) = 0
//! ```
//!
//! The two cross products belong to the edge, so an event costs two dot products and a quotient.
//! The three f add up to d.n, n the triangle's normal; the ray is inside where all have its
//! sign, and the triangle is in front where n.(a' - t D) has it too. All four are linear in t.
//!
//! What makes it strong:
//! - triangles come nearest first, so that lists stay short and most compositions end at once;
//! - a triangle whose hull's box holds no pixel centre ends before its hull is made;
//! - a list is a sorted array: for the lengths that occur, faster than a balanced tree;
//! - a face is cut into bands of rows, which are independent: phase one puts each triangle into
//!   the bands that it touches, phase two runs bands in parallel (the source's GPU version does
//!   the same with pixels);
//! - each segment turns the cube map its own way, which finds more for the union.
//!
//! Near plane: the source projects vertices, which fails behind the camera. Here the hull is that of
//! the points (vertices from either end) in front of a plane at [`NEAR`], and of where the lines
//! between them meet that plane: the body that the triangle sweeps, clipped. Coverage needs no
//! near plane.
//!
//! Equal depth goes to the lower primitive number, so the result does not depend on order.
//!
//! Parameters: N (pixels a side of a face), the run's number.

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;
use sightline_geometry::{InstancedGeometry, PrimitiveId, PrimitiveSet, ViewSegment};

use crate::clock::{Deadline, Stopwatch};
use crate::curve::{Curve, Judge};
use crate::directions::rotation;
use crate::tracers::FLAT_MAX;

/// Distance of the plane that hulls are clipped at, metres.
pub const NEAR: f64 = 1e-4;

/// Intervals of t up to this length are rounding: events of `f64` are exact to some 1e-13 of a
/// segment. Without it, what lies behind a seam of two triangles would count as seen through it.
const SLIVER: f64 = 1e-12;

/// Rows of a band.
const BAND: usize = 8;

/// A stretch of t on which one triangle is the nearest at a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Interval {
    t0: f64,
    t1: f64,
    /// Distance along the pixel's direction at t = 0, and its slope.
    depth: f64,
    slope: f64,
    primitive: u32,
}

impl Interval {
    fn at(&self, t: f64) -> f64 {
        self.depth + t * self.slope
    }

    fn part(&self, t0: f64, t1: f64) -> Self {
        Self { t0, t1, ..*self }
    }
}

/// A pixel's list: sorted, disjoint, never empty intervals.
#[derive(Clone, Debug, Default)]
struct List(Vec<Interval>);

fn push(list: &mut Vec<Interval>, interval: Interval) {
    if interval.t1 - interval.t0 > SLIVER {
        match list.last_mut() {
            Some(last) if last.primitive == interval.primitive && last.t1 == interval.t0 => {
                last.t1 = interval.t1;
            }
            _ => list.push(interval),
        }
    }
}

/// The nearer of two intervals on `t0..t1`, which both cover.
fn nearer(list: &mut Vec<Interval>, a: &Interval, b: &Interval, t0: f64, t1: f64) {
    let (d0, d1) = (a.at(t0) - b.at(t0), a.at(t1) - b.at(t1));
    if d0 == 0.0 && d1 == 0.0 {
        let first = if a.primitive < b.primitive { a } else { b };
        push(list, first.part(t0, t1));
    } else if d0 <= 0.0 && d1 <= 0.0 {
        push(list, a.part(t0, t1));
    } else if d0 >= 0.0 && d1 >= 0.0 {
        push(list, b.part(t0, t1));
    } else {
        let t = (t0 + (t1 - t0) * d0 / (d0 - d1)).clamp(t0, t1);
        let (first, second) = if d0 < 0.0 { (a, b) } else { (b, a) };
        push(list, first.part(t0, t));
        push(list, second.part(t, t1));
    }
}

impl List {
    /// Depth composition of a coverage interval (line 9).
    fn compose(&mut self, new: Interval, scratch: &mut Vec<Interval>) {
        let first = self.0.partition_point(|i| i.t1 <= new.t0);
        let mut end = first;
        // Nothing changes when whoever is there is nearer throughout: the common case.
        let mut t = new.t0;
        let mut hidden = true;
        while end < self.0.len() && self.0[end].t0 < new.t1 {
            let old = &self.0[end];
            let (t0, t1) = (old.t0.max(new.t0), old.t1.min(new.t1));
            hidden &= old.t0 <= t && old.at(t0) < new.at(t0) && old.at(t1) < new.at(t1);
            t = old.t1;
            end += 1;
        }
        if hidden && t >= new.t1 {
            return;
        }
        scratch.clear();
        let mut t = new.t0;
        for old in &self.0[first..end] {
            push(scratch, old.part(old.t0, old.t1.min(new.t0)));
            push(scratch, new.part(t, old.t0.min(new.t1)));
            let (t0, t1) = (old.t0.max(new.t0), old.t1.min(new.t1));
            nearer(scratch, old, &new, t0, t1);
            push(scratch, old.part(old.t0.max(new.t1), old.t1));
            t = old.t1;
        }
        push(scratch, new.part(t, new.t1));
        self.0.splice(first..end, scratch.iter().copied());
    }
}

/// A face of the cube map: forward, right and up.
fn faces(turn: DMat3) -> [DMat3; 6] {
    [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y, DVec3::Z, -DVec3::Z]
        .map(|forward| {
            let right = if forward.y == 0.0 { DVec3::Y.cross(forward) } else { DVec3::X };
            let up = forward.cross(right);
            // World to face: rows are right, up and forward.
            turn * DMat3::from_cols(right, up, forward)
        })
        .map(|m| m.transpose())
}

/// The convex hull of the projections, counter-clockwise (lines 4 to 6); empty for less than a
/// triangle of it.
///
/// Source: Andrew's monotone chain (1979).
fn convex_hull(points: &mut [DVec2], hull: &mut Vec<DVec2>) {
    points.sort_unstable_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    hull.clear();
    let turns_left = |a: DVec2, b: DVec2, c: DVec2| (b - a).perp_dot(c - a) > 0.0;
    let mut extend = |points: &mut dyn Iterator<Item = DVec2>| {
        let base = hull.len();
        for p in points {
            while hull.len() >= base + 2
                && !turns_left(hull[hull.len() - 2], hull[hull.len() - 1], p)
            {
                hull.pop();
            }
            hull.push(p);
        }
        hull.pop();
    };
    extend(&mut points.iter().copied());
    extend(&mut points.iter().rev().copied());
}

/// A face, its resolution and the segment.
struct View {
    face_from_world: DMat3,
    /// D, in face coordinates.
    step: DVec3,
    pixels: usize,
}

impl View {
    /// Vertices in face coordinates, from v0.
    fn corners(&self, triangles: &Triangles, k: u32) -> [DVec3; 3] {
        triangles.corners(k).map(|p| self.face_from_world * p)
    }

    /// The projections whose hull the triangle sweeps, in pixels: centres are at whole numbers.
    fn project(&self, corners: &[DVec3; 3], out: &mut Vec<DVec2>) {
        out.clear();
        let points: [DVec3; 6] =
            std::array::from_fn(|k| if k < 3 { corners[k] } else { corners[k - 3] - self.step });
        let half = 0.5 * self.pixels as f64;
        let mut add = |p: DVec3| {
            out.push(DVec2::new((p.x / p.z + 1.0) * half - 0.5, (p.y / p.z + 1.0) * half - 0.5));
        };
        let in_front = points.map(|p| p.z >= NEAR);
        if in_front == [false; 6] {
            return;
        }
        for (k, p) in points.iter().enumerate() {
            if in_front[k] {
                add(*p);
                for q in points.iter().filter(|q| q.z < NEAR) {
                    let share = (p.z - NEAR) / (p.z - q.z);
                    add(p.lerp(*q, share).with_z(NEAR));
                }
            }
        }
    }

    /// First and last whole number in a range that is a pixel.
    fn pixels_in(&self, low: f64, high: f64) -> Option<(usize, usize)> {
        let (low, high) = (low.ceil().max(0.0), high.floor().min(self.pixels as f64 - 1.0));
        (low <= high).then_some((low as usize, high as usize))
    }

    /// The rows and columns of the box of projections.
    fn extent(&self, points: &[DVec2]) -> Option<[(usize, usize); 2]> {
        let far = DVec2::splat(f64::INFINITY);
        let (low, high) = points.iter().fold((far, -far), |(l, h), p| (l.min(*p), h.max(*p)));
        // Rounding moves a projection by far less than this share of a pixel.
        let slack = 1e-9 * self.pixels as f64;
        let columns = self.pixels_in(low.x - slack, high.x + slack)?;
        let rows = self.pixels_in(low.y - slack, high.y + slack)?;
        Some([columns, rows])
    }

    /// The columns of row `y` inside the hull.
    fn columns(&self, hull: &[DVec2], y: f64) -> Option<(usize, usize)> {
        let slack = 1e-9 * self.pixels as f64;
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for (k, &a) in hull.iter().enumerate() {
            let b = hull[(k + 1) % hull.len()];
            let (lower, upper) = if a.y <= b.y { (a, b) } else { (b, a) };
            if y < lower.y - slack || y > upper.y + slack {
                continue;
            }
            let mut add = |x: f64| {
                low = low.min(x);
                high = high.max(x);
            };
            if upper.y - lower.y <= 2.0 * slack {
                add(a.x);
                add(b.x);
            } else {
                let share = ((y - lower.y) / (upper.y - lower.y)).clamp(0.0, 1.0);
                add(lower.x + share * (upper.x - lower.x));
            }
        }
        self.pixels_in(low - slack, high + slack)
    }
}

/// What Eq. 2 needs of a triangle.
struct Events {
    /// The two cross products of each edge.
    edges: [[DVec3; 2]; 3],
    normal: DVec3,
    /// n.a' and n.D.
    plane: [f64; 2],
}

impl Events {
    fn new([a, b, c]: [DVec3; 3], step: DVec3) -> Self {
        let edge = |a: DVec3, b: DVec3| [a.cross(b), step.cross(b - a)];
        let normal = (b - a).cross(c - a);
        Self {
            edges: [edge(a, b), edge(b, c), edge(c, a)],
            normal,
            plane: [normal.dot(a), normal.dot(step)],
        }
    }

    /// The interval on which the triangle covers direction `d` (line 8).
    fn coverage(&self, d: DVec3, primitive: u32) -> Option<Interval> {
        let towards = d.dot(self.normal);
        if towards == 0.0 {
            return None;
        }
        let sign = towards.signum();
        let (mut t0, mut t1) = (0.0, 1.0);
        // Keeps the t at which sign * (value - t * slope) > 0.
        let mut keep = |value: f64, slope: f64| {
            let (value, slope) = (sign * value, sign * slope);
            if slope == 0.0 {
                return value > 0.0;
            }
            let t = value / slope;
            if slope > 0.0 {
                t1 = f64::min(t1, t);
            } else {
                t0 = f64::max(t0, t);
            }
            t0 < t1
        };
        for [value, slope] in &self.edges {
            if !keep(d.dot(*value), d.dot(*slope)) {
                return None;
            }
        }
        if !keep(self.plane[0], self.plane[1]) {
            return None;
        }
        let (depth, slope) = (self.plane[0] / towards, -self.plane[1] / towards);
        (t1 - t0 > SLIVER).then_some(Interval { t0, t1, depth, slope, primitive })
    }
}

/// All triangles, nearest first.
struct Triangles<'a> {
    geometry: &'a InstancedGeometry,
    v0: DVec3,
    /// Their numbers in the scene.
    primitives: Vec<u32>,
    /// Corners from v0, where memory allows it; else they are looked up each time.
    corners: Vec<[DVec3; 3]>,
}

impl<'a> Triangles<'a> {
    fn new(geometry: &'a InstancedGeometry, segment: &ViewSegment) -> Self {
        let middle = segment.v0.lerp(segment.v1, 0.5);
        let mut keyed: Vec<(f32, u32)> = (0..geometry.primitive_count())
            .into_par_iter()
            .map(|p| {
                let [a, b, c] = geometry.triangle(PrimitiveId(p)).corners;
                (((a + b + c) / 3.0).distance_squared(middle) as f32, p)
            })
            .collect();
        keyed.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let primitives: Vec<u32> = keyed.into_iter().map(|k| k.1).collect();
        let mut out = Self { geometry, v0: segment.v0, primitives, corners: Vec::new() };
        if geometry.primitive_count() <= FLAT_MAX {
            let count = out.primitives.len() as u32;
            out.corners = (0..count).into_par_iter().map(|k| out.looked_up(k)).collect();
        }
        out
    }

    fn looked_up(&self, k: u32) -> [DVec3; 3] {
        let primitive = PrimitiveId(self.primitives[k as usize]);
        self.geometry.triangle(primitive).corners.map(|p| p - self.v0)
    }

    fn corners(&self, k: u32) -> [DVec3; 3] {
        self.corners.get(k as usize).copied().unwrap_or_else(|| self.looked_up(k))
    }
}

/// The visible set of a segment with a cube map of `pixels` x `pixels` x 6, turned by rotation
/// number `run` (0: along the axes). `None` when `deadline` passes before the end.
#[must_use]
pub fn solve(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    pixels: u32,
    run: u32,
    deadline: Option<Deadline>,
) -> Option<PrimitiveSet> {
    let is_late = || deadline.is_some_and(|d| d.is_past());
    let turn = if run == 0 { DMat3::IDENTITY } else { rotation(u64::from(run)) };
    let triangles = &Triangles::new(geometry, segment);
    let mut sets = Vec::new();
    for face_from_world in faces(turn) {
        let view = View {
            face_from_world,
            step: face_from_world * (segment.v1 - segment.v0),
            pixels: pixels as usize,
        };
        let bands = bands(triangles, &view, &is_late);
        if is_late() {
            return None;
        }
        let seen = bands
            .par_iter()
            .enumerate()
            .map(|(band, members)| solve_band(triangles, &view, band * BAND, members, &is_late))
            .collect::<Option<Vec<_>>>()?;
        sets.extend(seen);
    }
    Some(PrimitiveSet::union(&sets))
}

/// Phase one: the triangles that touch each band, by their place in the order.
fn bands(
    triangles: &Triangles,
    view: &View,
    is_late: &(impl Fn() -> bool + Sync),
) -> Vec<Vec<u32>> {
    let count = view.pixels.div_ceil(BAND);
    let piece = 1 << 14;
    let all = triangles.primitives.len() as u32;
    let pieces: Vec<Vec<(u32, u32)>> = (0..all.div_ceil(piece))
        .into_par_iter()
        .map_init(Vec::new, |points, number| {
            let mut touched = Vec::new();
            if is_late() {
                return touched;
            }
            for k in number * piece..all.min((number + 1) * piece) {
                view.project(&view.corners(triangles, k), points);
                if let Some([_, (low, high)]) = view.extent(points) {
                    let bands = low / BAND..=high / BAND;
                    touched.extend(bands.map(|band| (band as u32, k)));
                }
            }
            touched
        })
        .collect();
    let mut out = vec![Vec::new(); count];
    for (band, k) in pieces.into_iter().flatten() {
        out[band as usize].push(k);
    }
    out
}

/// Phase two: the lists of the pixels of a band, and what is on them (lines 1 to 14).
fn solve_band(
    triangles: &Triangles,
    view: &View,
    first_row: usize,
    members: &[u32],
    is_late: &impl Fn() -> bool,
) -> Option<PrimitiveSet> {
    let end_row = view.pixels.min(first_row + BAND);
    let mut lists = vec![List::default(); (end_row - first_row) * view.pixels];
    let (mut points, mut hull, mut scratch) = (Vec::new(), Vec::new(), Vec::new());
    let center = |k: usize| 2.0 * (k as f64 + 0.5) / view.pixels as f64 - 1.0;
    for (done, &k) in members.iter().enumerate() {
        if done % 1024 == 0 && is_late() {
            return None;
        }
        let primitive = triangles.primitives[k as usize];
        let corners = view.corners(triangles, k);
        view.project(&corners, &mut points);
        let Some([_, (low, high)]) = view.extent(&points) else { continue };
        convex_hull(&mut points, &mut hull);
        let events = Events::new(corners, view.step);
        for row in low.max(first_row)..=high.min(end_row - 1) {
            let Some((from, to)) = view.columns(&hull, row as f64) else { continue };
            let lists = &mut lists[(row - first_row) * view.pixels..][from..=to];
            for (column, list) in (from..).zip(lists) {
                let d = DVec3::new(center(column), center(row), 1.0);
                if let Some(interval) = events.coverage(d, primitive) {
                    list.compose(interval, &mut scratch);
                }
            }
        }
    }
    let mut seen: Vec<u32> = lists.iter().flat_map(|l| &l.0).map(|i| i.primitive).collect();
    seen.sort_unstable();
    Some(PrimitiveSet::from_sorted(seen))
}

/// A point for each N, while there is time, then for 2, 4, ... runs of the last.
#[must_use]
pub fn curve(
    judge: &Judge,
    geometry: &InstancedGeometry,
    segments: &[ViewSegment],
    pixels: &[u32],
    runs: u32,
) -> Curve {
    let mut curve = Curve { method: "Algorithm 1 as published".into(), ..Curve::default() };
    let count = segments.len() as u32;
    let all = |pixels: u32, run: u32, watch: &mut Stopwatch| {
        let mut sets = Vec::new();
        for segment in segments {
            let deadline = Deadline::after(judge.clock, judge.limit - watch.seconds());
            let k = run * count + segment.id.0;
            sets.push(watch.time(|| solve(geometry, segment, pixels, k, Some(deadline)))?);
        }
        Some(PrimitiveSet::union(&sets))
    };
    let mut last = None;
    for &pixels in pixels {
        let mut watch = Stopwatch::new(judge.clock);
        let Some(set) = all(pixels, 0, &mut watch) else {
            curve.ended = Some(format!("N = {pixels} did not end within {} s", judge.limit));
            return curve;
        };
        curve.points.push(judge.point(format!("N = {pixels}"), watch.seconds(), &set));
        last = Some((pixels, watch, set));
    }
    let Some((pixels, mut watch, mut set)) = last else { return curve };
    for run in 1..runs {
        let Some(found) = all(pixels, run, &mut watch) else {
            curve.ended = Some(format!("run {} did not end within {} s", run + 1, judge.limit));
            return curve;
        };
        set = watch.time(|| PrimitiveSet::union([&set, &found]));
        if (run + 1).is_power_of_two() || run + 1 == runs {
            let label = format!("N = {pixels}, {} runs", run + 1);
            curve.points.push(judge.point(label, watch.seconds(), &set));
        }
    }
    curve
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Clock;
    use crate::directions::stream;
    use crate::rivals::tests::{random_triangles, scene_of};
    use sightline_geometry::raycast::{Ray, RayCaster};
    use sightline_geometry::{Sampling, SegmentId};

    fn segment(v0: DVec3, v1: DVec3) -> ViewSegment {
        ViewSegment { id: SegmentId(0), v0, v1 }
    }

    /// Rays through pixel centres from points of the segment see nothing else, and the set holds
    /// nothing that no such ray comes close to seeing.
    #[test]
    fn the_set_is_what_rays_through_the_pixels_see() {
        for seed in 0..4 {
            let geometry = random_triangles(200, seed);
            let s = segment(DVec3::new(-0.4, 0.1, 0.2), DVec3::new(0.5, -0.1, 0.0));
            let (pixels, run) = (12, seed as u32);
            let set = solve(&geometry, &s, pixels, run, None).unwrap();
            let turn = if run == 0 { DMat3::IDENTITY } else { rotation(seed) };
            let mut caster = RayCaster::new();
            let mut seen = std::collections::BTreeSet::new();
            for face in faces(turn) {
                for i in 0..pixels * pixels {
                    let at = |k: u32| 2.0 * (f64::from(k) + 0.5) / f64::from(pixels) - 1.0;
                    let d = DVec3::new(at(i % pixels), at(i / pixels), 1.0);
                    let direction = face.transpose() * d;
                    for step in 0..=2000 {
                        let origin = s.v0.lerp(s.v1, f64::from(step) / 2000.0);
                        let ray = Ray::new(origin, direction);
                        let hit = caster.closest_occluder(&geometry, ray, f64::INFINITY, |_| true);
                        if let Some(hit) = hit {
                            seen.insert(hit.primitive.0);
                        }
                    }
                }
            }
            let missed: Vec<_> = seen.iter().filter(|p| !set.contains(PrimitiveId(**p))).collect();
            assert!(missed.is_empty(), "seed {seed}: {missed:?}");
            let unseen = set.iter().filter(|p| !seen.contains(&p.0)).count();
            // Intervals shorter than the step of the rays.
            assert!(unseen <= 3, "seed {seed}: {unseen} of {}", set.len());
        }
    }

    /// Two samplings of the same directions, dense compared with the triangles, agree.
    #[test]
    fn it_agrees_with_our_solver() {
        let geometry = random_triangles(150, 21);
        let s = segment(DVec3::new(-0.3, 0.0, 0.1), DVec3::new(0.4, 0.1, -0.1));
        let theirs = solve(&geometry, &s, 160, 0, None).unwrap();
        let ours = sightline_solver::solve_segment(&geometry, &s, Sampling::new(200)).set;
        let common = ours.iter().filter(|p| theirs.contains(*p)).count() as u64;
        assert!(ours.len() > 50);
        let differ = ours.len() + theirs.len() - 2 * common;
        assert!(differ <= 4, "{} {} {common}", ours.len(), theirs.len());
    }

    #[test]
    fn a_camera_that_passes_through_a_triangle_sees_it_and_what_is_behind() {
        let wall = |x: f32, s: f32| [[x, -s, -s], [x, s, -s], [x, 0.0, 2.0 * s]];
        let scene = scene_of(&[wall(1.0, 9.0), wall(3.0, 9.0)].concat());
        let through = segment(DVec3::ZERO, DVec3::new(2.0, 0.0, 0.0));
        let short = segment(DVec3::ZERO, DVec3::new(0.9, 0.0, 0.0));
        assert_eq!(solve(&scene, &through, 16, 0, None).unwrap().len(), 2);
        let set = solve(&scene, &short, 2, 0, None).unwrap();
        assert_eq!(set.len(), 1, "nothing shows through the nearer wall");
    }

    #[test]
    fn lists_stay_sorted_and_keep_the_nearest() {
        let mut random = stream(3, 3);
        for _ in 0..200 {
            let mut list = List::default();
            let mut all = Vec::new();
            for primitive in 0..12 {
                let (a, b) = (random.next_unit(), random.next_unit());
                let (t0, t1) = (a.min(b), a.max(b));
                let (depth, slope) = (1.0 + random.next_unit(), random.next_unit() - 0.5);
                let new = Interval { t0, t1, depth, slope, primitive };
                all.push(new);
                list.compose(new, &mut Vec::new());
                assert!(list.0.windows(2).all(|w| w[0].t1 <= w[1].t0));
                assert!(list.0.iter().all(|i| i.t0 < i.t1));
            }
            for k in 0..100 {
                let t = (f64::from(k) + random.next_unit()) / 100.0;
                let covers = |i: &&Interval| i.t0 <= t && t < i.t1;
                let nearest = all.iter().filter(covers).min_by(|a, b| a.at(t).total_cmp(&b.at(t)));
                let found = list.0.iter().find(covers);
                assert_eq!(nearest.map(|i| i.primitive), found.map(|i| i.primitive));
            }
        }
    }

    #[test]
    fn it_gives_up_at_the_deadline() {
        let geometry = random_triangles(100, 1);
        let s = segment(DVec3::ZERO, DVec3::X);
        assert_eq!(solve(&geometry, &s, 16, 0, Some(Deadline::after(Clock::Wall, 0.0))), None);
    }
}
