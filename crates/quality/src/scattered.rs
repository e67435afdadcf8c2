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
//! Directions of a batch are one spherical lattice, rotated and jittered at random, which spreads
//! them more evenly than independent ones. Counts then vary less than those of independent rays
//! with the same mean (Hoeffding, "On the Distribution of the Number of Successes in Independent
//! Trials", 1956), so a test for independent rays errs on the safe side.

use std::sync::OnceLock;

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::raycast::Ray;
use sightline_geometry::{InstancedGeometry, ViewCell};

use crate::directions::Lattice;
use crate::measure::Tracer;
use crate::membership::Members;
use crate::seed::{SplitMix64, placement_seed, viewpoint_seed};

/// Rays of a batch: enough for a bad cell to show, a fifth of what a good one takes at a target of
/// 0.02 %.
pub const SCATTERED_BATCH: u32 = 4096;

/// Rays of one piece of work.
const CHUNK: usize = 1024;

/// Casts batch number `batch` of a measurement: [`SCATTERED_BATCH`] rays. Gives the viewpoints of
/// those that are wrong, in a fixed order.
///
/// # Panics
/// When the set has a member that the geometry lacks.
#[must_use]
pub fn measure_scattered(
    geometry: &InstancedGeometry,
    members: &Members,
    cell: &ViewCell,
    batch: u32,
    seed: u64,
) -> Vec<DVec3> {
    static LATTICE: OnceLock<Lattice> = OnceLock::new();
    let lattice = LATTICE.get_or_init(|| Lattice::new(SCATTERED_BATCH));
    let directions = viewpoint_seed(seed, cell.id, batch);
    let places = placement_seed(directions, cell.id);
    let starts: Vec<usize> = (0..lattice.len()).step_by(CHUNK).collect();
    let wrong: Vec<Vec<DVec3>> = starts
        .into_par_iter()
        .map_init(Tracer::default, |tracer, start| {
            let range = start..lattice.len().min(start + CHUNK);
            // Three numbers a viewpoint.
            let mut random = SplitMix64::at(places, 3 * start as u64);
            let rays = lattice.directions(directions, range).map(|direction| {
                let (u, v, h) = (random.next_unit(), random.next_unit(), random.next_unit());
                Ray::new(cell.viewpoint(u, v, h), direction)
            });
            rays.filter(|&ray| tracer.is_wrong(geometry, members, ray)).map(|r| r.origin).collect()
        })
        .collect();
    wrong.concat()
}
