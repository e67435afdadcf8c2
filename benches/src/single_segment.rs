//! One segment, as the source compares it (its section 4.5.1 and Figure 7).
//!
//! A from-segment run at N rows is compared
//! - with tracing as many rays from one point of the segment: a *from-point run*;
//! - with from-point runs from points that divide the segment evenly. With *the same* directions,
//!   their sets are subsets of ours, as in the source: the share of ours that they have after our
//!   time, and how long they take for all of it. With *fresh* directions at every point, a rival that
//!   the source does not have, they also see what lies between our pixels: how many triangles they
//!   have after our time, as a share of the number we have, and how long they take for as many.

use std::fmt::Write;

use glam::Vec3;
use rayon::prelude::*;
use sightline_geometry::{
    FACE_COUNT, InstancedGeometry, PrimitiveSet, RectifiedFrame, Sampling, ViewSegment,
};
use sightline_solver::solve_segment;

use crate::clock::{Clock, Stopwatch, fastest};
use crate::curve::Progressive;
use crate::directions::van_der_corput;
use crate::found::Found;
use crate::report::digits;
use crate::rivals::from_point::{FromPoint, Viewpoints};
use crate::tracers::{LocalRay, MISS, Tracer};

/// Rays a piece of work.
const CHUNK: usize = 4096;

/// How far a rival got.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Race {
    /// Share of our triangles after our time.
    pub share_at_equal_time: f64,
    /// Time it took for 90 %, 95 %, 99 % and 100 % of our triangles, in units of our time.
    pub time_to_share: [Option<f64>; 4],
    /// Time after which it was stopped, in units of our time.
    pub stopped: f64,
    /// Share when it was stopped.
    pub share_at_stop: f64,
}

/// Shares that [`Race::time_to_share`] is about.
pub const SHARES: [f64; 4] = [0.9, 0.95, 0.99, 1.0];

/// What was measured on a segment.
#[derive(Clone, Debug, PartialEq)]
pub struct SingleSegment {
    /// Rows a face.
    pub rows: u32,
    /// Rays a from-point run has, and pixels the from-segment run.
    pub rays: u64,
    /// Seconds of the from-segment run.
    pub from_segment: f64,
    /// Seconds of a from-point run with the fastest tracer.
    pub from_point: f64,
    /// The fastest tracer.
    pub tracer: &'static str,
    /// Triangles that the from-segment run found.
    pub found: u64,
    /// Against from-point runs with the same directions.
    pub same: Race,
    /// Against from-point runs with fresh directions.
    pub fresh: Race,
}

/// The directions of our pixels, in an order that tracers like: four by four pixels at a time.
fn pixel_directions(segment: &ViewSegment, sampling: Sampling) -> Vec<Vec3> {
    let Some(frame) = RectifiedFrame::new(segment) else { return Vec::new() };
    let (rows, columns) = (sampling.rows(), sampling.columns());
    let mut out = Vec::new();
    for face in (0..FACE_COUNT).map(|k| frame.face(k)) {
        for (row, column) in
            (0..rows).step_by(4).flat_map(|r| (0..columns).step_by(4).map(move |c| (r, c)))
        {
            for k in 0..16 {
                let (w, c) = (sampling.row(row + k / 4), sampling.column(column + k % 4));
                let d = face.forward + c * face.axis + w * face.up;
                out.push(d.normalize().as_vec3());
            }
        }
    }
    out
}

/// A from-point run: the directions from one point.
fn trace_from(tracer: &dyn Tracer, origin: Vec3, directions: &[Vec3], found: &Found) {
    directions.par_chunks(CHUNK).for_each_init(
        || (Vec::with_capacity(CHUNK), Vec::with_capacity(CHUNK)),
        |(rays, hits), directions| {
            rays.clear();
            rays.extend(directions.iter().map(|&direction| LocalRay { origin, direction }));
            tracer.closest(rays, hits);
            for hit in hits.iter().filter(|h| h.primitive != MISS) {
                found.insert(hit.primitive);
            }
        },
    );
}

/// From-point runs with the same directions everywhere.
struct SameDirections<'a> {
    tracer: &'a dyn Tracer,
    segment: ViewSegment,
    directions: &'a [Vec3],
    found: Found,
    runs: u32,
}

impl Progressive for SameDirections<'_> {
    fn step(&mut self) -> bool {
        let at = self.segment.v0.lerp(self.segment.v1, van_der_corput(self.runs));
        let origin = (at - self.tracer.origin()).as_vec3();
        trace_from(self.tracer, origin, self.directions, &self.found);
        self.runs += 1;
        true
    }

    fn found(&self) -> PrimitiveSet {
        self.found.set()
    }

    fn label(&self) -> String {
        format!("{} runs", self.runs)
    }
}

/// Runs a rival for `limit` seconds, or as long as ours when that is longer. `count` tells how many triangles it has.
fn race<P: Progressive>(
    rival: &mut P,
    count: impl Fn(&P) -> u64,
    clock: Clock,
    (our_time, our_found): (f64, u64),
    limit: f64,
) -> Race {
    let limit = limit.max(our_time);
    let mut watch = Stopwatch::new(clock);
    let mut share_at_equal_time = 0.0;
    let mut time_to_share = [None; 4];
    let mut share = 0.0;
    // Counting takes time of its own, which is not the rival's.
    let mut next_count = 0.0;
    loop {
        watch.time(|| rival.step());
        let seconds = watch.seconds();
        let is_over = seconds > limit;
        if seconds < next_count && seconds < our_time && !is_over {
            continue;
        }
        if seconds >= next_count || is_over {
            share = count(rival) as f64 / our_found.max(1) as f64;
            next_count = 1.02 * seconds;
        }
        if seconds <= our_time || share_at_equal_time == 0.0 {
            share_at_equal_time = share;
        }
        for (time, wanted) in time_to_share.iter_mut().zip(SHARES) {
            if time.is_none() && share >= wanted {
                *time = Some(seconds / our_time);
            }
        }
        if is_over || share >= 1.0 {
            let stopped = seconds / our_time;
            return Race { share_at_equal_time, time_to_share, stopped, share_at_stop: share };
        }
    }
}

/// Compares on one segment at `rows` rows; each rival may take `limit` seconds.
#[must_use]
pub fn compare(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    rows: u32,
    tracers: &[Box<dyn Tracer + '_>],
    clock: Clock,
    limit: f64,
) -> Option<SingleSegment> {
    let sampling = Sampling::new(rows);
    let directions = pixel_directions(segment, sampling);
    let primitives = geometry.primitive_count();
    let ours = solve_segment(geometry, segment, sampling).set;
    let from_segment = fastest(clock, 1.0, || _ = solve_segment(geometry, segment, sampling));
    let found = Found::new(primitives);
    let middle = segment.v0.lerp(segment.v1, 0.5);
    let (from_point, tracer) = tracers
        .iter()
        .map(|tracer| {
            let origin = (middle - tracer.origin()).as_vec3();
            let run = || trace_from(&**tracer, origin, &directions, &found);
            (fastest(clock, 0.5, run), &**tracer)
        })
        .min_by(|a, b| a.0.total_cmp(&b.0))?;
    let goal = (from_segment, ours.len());
    let mut same = SameDirections {
        tracer,
        segment: *segment,
        directions: &directions,
        found: Found::new(primitives),
        runs: 0,
    };
    let same = race(&mut same, |r| r.found.len_of(&ours), clock, goal, limit);
    let mut fresh = FromPoint::new(tracer, primitives, Viewpoints::Along(vec![*segment]));
    let fresh = race(&mut fresh, |r| r.found_so_far().len(), clock, goal, limit);
    Some(SingleSegment {
        rows,
        rays: directions.len() as u64,
        from_segment,
        from_point,
        tracer: tracer.name(),
        found: ours.len(),
        same,
        fresh,
    })
}

/// The table of several.
#[must_use]
pub fn table(all: &[SingleSegment]) -> String {
    let mut out = String::new();
    let _ = writeln!(
        out,
        "| rows | rays | from-segment | from-point run | ratio | triangles | directions | at equal time | time for 90 % | 95 % | 99 % | 100 % | stopped at |"
    );
    let _ = writeln!(out, "|{}", " --- |".repeat(13));
    for s in all {
        for (kind, race) in [("the same", &s.same), ("fresh", &s.fresh)] {
            let times = race.time_to_share.map(|t| {
                t.map_or_else(
                    || format!("> {} x", digits(race.stopped)),
                    |t| format!("{} x", digits(t)),
                )
            });
            let _ = writeln!(
                out,
                "| {} | {} | {} ms | {} ms, {} | {} | {} | {kind} | {} % | {} | {} % after {} x |",
                s.rows,
                s.rays,
                digits(1e3 * s.from_segment),
                digits(1e3 * s.from_point),
                s.tracer,
                digits(s.from_segment / s.from_point),
                s.found,
                digits(100.0 * race.share_at_equal_time),
                times.join(" | "),
                digits(100.0 * race.share_at_stop),
                digits(race.stopped),
            );
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rivals::tests::random_triangles;
    use crate::tracers::caster::Caster;
    use glam::DVec3;
    use sightline_geometry::SegmentId;

    #[test]
    fn from_point_runs_with_our_directions_find_a_part_of_our_set() {
        let geometry = random_triangles(400, 13);
        let (v0, v1) = (DVec3::new(-0.5, 0.0, 0.0), DVec3::new(0.5, 0.1, 0.2));
        let segment = ViewSegment { id: SegmentId(0), v0, v1 };
        let sampling = Sampling::new(24);
        let ours = solve_segment(&geometry, &segment, sampling).set;
        let directions = pixel_directions(&segment, sampling);
        assert_eq!(directions.len(), 4 * 24 * 24);
        let tracer = Caster::new(&geometry, v0);
        let found = Found::new(400);
        let mut runs =
            SameDirections { tracer: &tracer, segment, directions: &directions, found, runs: 0 };
        let mut counts = Vec::new();
        for _ in 0..256 {
            runs.step();
            counts.push(runs.found.len());
        }
        // Directions are rounded to f32: a ray near an edge may see its neighbour.
        let outside = runs.found.len() - runs.found.len_of(&ours);
        assert!(outside <= 2, "{outside}");
        assert!(counts[0] < counts[255]);
        assert!(runs.found.len_of(&ours) * 100 > ours.len() * 95);
    }
}
