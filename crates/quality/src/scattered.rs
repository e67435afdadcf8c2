//! Pixel error of a cell by single rays, each from a viewpoint of its own.
//!
//! A ray from a random viewpoint of the cell in a random direction is wrong with a probability that
//! is the mean pixel error of the cell. Rays that share a viewpoint are not independent of each
//! other: what matters for the mean is the number of viewpoints, and a ray more from an old one
//! costs as much as one from a new one. So here every ray has a viewpoint of its own, and the number
//! of wrong ones is what [`crate::ErrorTest`] takes.
//!
//! The viewpoint of a wrong ray is a *suspect*: viewpoints are found in proportion to their error,
//! so what stands in a pocket is found before what stands in the open.
//!
//! Where something moves, a ray is cast at a random moment, uniform over the time of the states that
//! are measured: it is then wrong with a probability that is the mean error over cell and time.
//!
//! Directions of a batch are one spherical lattice, rotated and jittered at random, which spreads
//! them more evenly than independent ones. Counts then vary less than those of independent rays
//! with the same mean (Hoeffding, "On the Distribution of the Number of Successes in Independent
//! Trials", 1956), so a test for independent rays errs on the safe side.

use std::ops::Range;
use std::sync::OnceLock;

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::raycast::Ray;
use sightline_geometry::{
    InstancedGeometry, Moment, PrimitiveId, PrimitiveSet, StateSets, Timeline, ViewCell,
};

use crate::directions::Lattice;
use crate::measure::Tracer;
use crate::membership::StateMembers;
use crate::seed::{SplitMix64, moment_seed, placement_seed, viewpoint_seed};

/// Rays of a batch: enough for a bad cell to show, a fifth of what a good one takes at a target of
/// 0.02 %.
pub const SCATTERED_BATCH: u32 = 4096;

/// Rays of one piece of work.
const CHUNK: usize = 1024;

/// Where and when a ray was wrong.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Suspect {
    /// Where it started, world space, metres.
    pub viewpoint: DVec3,
    /// When it was cast.
    pub moment: Moment,
}

/// Casts batch number `batch` of a measurement in a scene at rest: [`SCATTERED_BATCH`] rays. Gives the
/// viewpoints of those that are wrong, in a fixed order.
///
/// # Panics
/// When the set has a member that the geometry lacks.
#[must_use]
pub fn measure_scattered(
    geometry: &InstancedGeometry,
    set: &PrimitiveSet,
    cell: &ViewCell,
    batch: u32,
    seed: u64,
) -> Vec<DVec3> {
    let sets = StateSets::constant(0..1, set.clone());
    let members = StateMembers::new(&sets, geometry.primitive_count());
    let timeline = Timeline::at_rest();
    let found = measure_scattered_over(geometry, &members, &timeline, cell, batch, seed);
    found.wrong.into_iter().map(|suspect| suspect.viewpoint).collect()
}

/// What a batch of rays found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scattered {
    /// Rays that are wrong, in a fixed order.
    pub wrong: Vec<Suspect>,
    /// Primitives that rays met and the set lacks, in a fixed order; some of them often. What ties with a
    /// member is among them, though its ray is not wrong.
    pub missing: Vec<PrimitiveId>,
}

/// The rays `range` of a batch in a cell.
pub(crate) fn scattered_rays<'a>(
    lattice: &'a Lattice,
    timeline: &'a Timeline,
    states: &'a Range<u32>,
    cell: &'a ViewCell,
    (batch, seed): (u32, u64),
    range: Range<usize>,
) -> impl Iterator<Item = Ray> + 'a {
    let directions = viewpoint_seed(seed, cell.id, batch);
    // Three numbers a viewpoint, and one a moment.
    let mut random = SplitMix64::at(placement_seed(directions, cell.id), 3 * range.start as u64);
    let mut clock = SplitMix64::at(moment_seed(directions, cell.id), range.start as u64);
    lattice.directions(directions, range).map(move |direction| {
        let (u, v, h) = (random.next_unit(), random.next_unit(), random.next_unit());
        let moment = timeline.moment(states, clock.next_unit());
        Ray { origin: cell.viewpoint(u, v, h), direction, moment }
    })
}

/// The directions of a batch, and where its pieces of work start.
pub(crate) fn scattered_pieces() -> (&'static Lattice, Vec<Range<usize>>) {
    static LATTICE: OnceLock<Lattice> = OnceLock::new();
    let lattice = LATTICE.get_or_init(|| Lattice::new(SCATTERED_BATCH));
    let len = lattice.len();
    (lattice, (0..len).step_by(CHUNK).map(|start| start..len.min(start + CHUNK)).collect())
}

/// Casts batch number `batch` of a measurement over the states of `members`: [`SCATTERED_BATCH`] rays,
/// at random moments.
///
/// # Panics
/// When a set has a member that the geometry lacks, or the timeline lacks a state.
#[must_use]
pub fn measure_scattered_over(
    geometry: &InstancedGeometry,
    members: &StateMembers<'_>,
    timeline: &Timeline,
    cell: &ViewCell,
    batch: u32,
    seed: u64,
) -> Scattered {
    let (lattice, pieces) = scattered_pieces();
    let states: Range<u32> = members.sets().states();
    let found: Vec<Scattered> = pieces
        .into_par_iter()
        .map_init(Tracer::default, |tracer, range| {
            let rays = scattered_rays(lattice, timeline, &states, cell, (batch, seed), range);
            let wrong = rays
                .filter(|&ray| tracer.is_wrong(geometry, members, ray))
                .map(|ray| Suspect { viewpoint: ray.origin, moment: ray.moment })
                .collect();
            Scattered { wrong, missing: tracer.take_missing() }
        })
        .collect();
    let mut all = Scattered::default();
    for piece in found {
        all.wrong.extend(piece.wrong);
        all.missing.extend(piece.missing);
    }
    all
}
