//! The measurement: rays from viewpoints, wrong ones counted.
//!
//! Work is cut into pieces of [`CHUNK`] rays, which run in parallel; their counts are added, so
//! the order does not matter. Nearly every ray ends at a member of the set after one trace; only
//! the others are traced again with the members alone.

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::raycast::{Hit, Ray, RayCaster};
use sightline_geometry::{CellId, InstancedGeometry, PrimitiveSet, ViewCell};

use crate::depth_tie::ties;
use crate::directions::Lattice;
use crate::membership::Members;
use crate::seed::{SplitMix64, batch_seed, placement_seed, viewpoint_seed};

/// Rays of one piece of work: a few milliseconds.
const CHUNK: usize = 4096;

/// Most directions in one lattice, which bounds its memory to 24 MiB; more rays are taken in
/// several lattices, each with its own rotation.
const LATTICE_MAX: u32 = 1 << 20;

/// Pixel error at one viewpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewpointError {
    /// Where the rays start, world space, metres.
    pub viewpoint: DVec3,
    /// Rays traced.
    pub rays: u32,
    /// Rays whose picture of the set is wrong.
    pub wrong: u32,
    /// `wrong / rays`, in [0, 1]; 0 without rays.
    pub error: f64,
    /// Seed of the directions: [`measure_viewpoint`] with it repeats this measurement.
    pub seed: u64,
}

/// Pixel error at the viewpoints of one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct CellError {
    /// The cell.
    pub cell: CellId,
    /// One result a viewpoint, in the order of the viewpoints.
    pub viewpoints: Vec<ViewpointError>,
}

impl CellError {
    /// Mean error over the viewpoints, in [0, 1]; 0 without viewpoints.
    #[must_use]
    pub fn mean(&self) -> f64 {
        let sum: f64 = self.viewpoints.iter().map(|v| v.error).sum();
        sum / self.viewpoints.len().max(1) as f64
    }

    /// Largest error of a viewpoint, in [0, 1]; 0 without viewpoints.
    #[must_use]
    pub fn max(&self) -> f64 {
        self.worst().map_or(0.0, |v| v.error)
    }

    /// The first viewpoint with the largest error.
    #[must_use]
    pub fn worst(&self) -> Option<&ViewpointError> {
        self.viewpoints.iter().reduce(|worst, v| if v.error > worst.error { v } else { worst })
    }
}

/// Measures `set` at one viewpoint with `rays` directions given by `seed`.
///
/// # Panics
/// When the set has a member that the geometry lacks.
#[must_use]
pub fn measure_viewpoint(
    geometry: &InstancedGeometry,
    set: &PrimitiveSet,
    viewpoint: DVec3,
    rays: u32,
    seed: u64,
) -> ViewpointError {
    measure(geometry, set, &[(viewpoint, seed)], rays)[0]
}

/// Measures `set` at `viewpoints` random viewpoints, uniform in the cell.
///
/// # Panics
/// When the set has a member that the geometry lacks.
#[must_use]
pub fn measure_cell(
    geometry: &InstancedGeometry,
    set: &PrimitiveSet,
    cell: &ViewCell,
    viewpoints: u32,
    rays: u32,
    seed: u64,
) -> CellError {
    let viewpoints = random_viewpoints(cell, viewpoints, seed);
    measure_viewpoints(geometry, set, cell.id, &viewpoints, rays, seed)
}

/// Measures `set` at given viewpoints of a cell; the directions at viewpoint i are given by
/// [`viewpoint_seed`]`(seed, cell, i)`.
///
/// # Panics
/// When the set has a member that the geometry lacks.
#[must_use]
pub fn measure_viewpoints(
    geometry: &InstancedGeometry,
    set: &PrimitiveSet,
    cell: CellId,
    viewpoints: &[DVec3],
    rays: u32,
    seed: u64,
) -> CellError {
    let seeded: Vec<(DVec3, u64)> =
        (0..).zip(viewpoints).map(|(i, &v)| (v, viewpoint_seed(seed, cell, i))).collect();
    CellError { cell, viewpoints: measure(geometry, set, &seeded, rays) }
}

/// `count` viewpoints, uniform in the cell's footprint and height, given by seed and cell id.
#[must_use]
pub fn random_viewpoints(cell: &ViewCell, count: u32, seed: u64) -> Vec<DVec3> {
    let mut random = SplitMix64::new(placement_seed(seed, cell.id));
    (0..count)
        .map(|_| {
            let (u, v, h) = (random.next_unit(), random.next_unit(), random.next_unit());
            cell.viewpoint(u, v, h)
        })
        .collect()
}

/// The lattices of a number of rays: full ones, and one for the rest.
struct Batches {
    full: Option<Lattice>,
    rest: Option<Lattice>,
    full_count: u32,
}

impl Batches {
    fn new(rays: u32) -> Self {
        let (full_count, rest) = (rays / LATTICE_MAX, rays % LATTICE_MAX);
        Self {
            full: (full_count > 0).then(|| Lattice::new(LATTICE_MAX)),
            rest: (rest > 0).then(|| Lattice::new(rest)),
            full_count,
        }
    }

    fn iter(&self) -> impl Iterator<Item = (u32, &Lattice)> {
        let full = self.full.iter().flat_map(|l| (0..self.full_count).map(move |b| (b, l)));
        full.chain(self.rest.iter().map(|l| (self.full_count, l)))
    }
}

fn measure(
    geometry: &InstancedGeometry,
    set: &PrimitiveSet,
    viewpoints: &[(DVec3, u64)],
    rays: u32,
) -> Vec<ViewpointError> {
    let members = Members::new(set, geometry.primitive_count());
    let batches = Batches::new(rays);
    let pieces: Vec<(usize, u32, &Lattice, usize)> = (0..viewpoints.len())
        .flat_map(|v| batches.iter().map(move |(batch, lattice)| (v, batch, lattice)))
        .flat_map(|(v, batch, lattice)| {
            (0..lattice.len()).step_by(CHUNK).map(move |start| (v, batch, lattice, start))
        })
        .collect();
    let counts: Vec<(usize, u32)> = pieces
        .into_par_iter()
        .map_init(Tracer::default, |tracer, (v, batch, lattice, start)| {
            let (origin, seed) = viewpoints[v];
            let range = start..lattice.len().min(start + CHUNK);
            let wrong = lattice
                .directions(batch_seed(seed, batch), range)
                .filter(|&direction| {
                    tracer.is_wrong(geometry, &members, Ray::new(origin, direction))
                })
                .count();
            (v, wrong as u32)
        })
        .collect();
    let mut wrong = vec![0u32; viewpoints.len()];
    for (v, count) in counts {
        wrong[v] += count;
    }
    let errors = viewpoints.iter().zip(wrong).map(|(&(viewpoint, seed), wrong)| {
        let error = f64::from(wrong) / f64::from(rays.max(1));
        ViewpointError { viewpoint, rays, wrong, error, seed }
    });
    errors.collect()
}

/// A ray caster and the see-through hits of the current ray.
#[derive(Default)]
pub(crate) struct Tracer {
    caster: RayCaster,
    missing: Vec<Hit>,
    present: Vec<Hit>,
}

impl Tracer {
    /// The definition of the crate's documentation.
    pub(crate) fn is_wrong(
        &mut self,
        geometry: &InstancedGeometry,
        members: &Members,
        ray: Ray,
    ) -> bool {
        let nearest = self.caster.closest_occluder(geometry, ray, f64::INFINITY, |_| true);
        if let Some(hit) = nearest
            && !members.contains(hit.primitive)
        {
            let of_set =
                self.caster.closest_occluder(geometry, ray, f64::INFINITY, |p| members.contains(p));
            if !of_set.is_some_and(|other| ties(geometry, ray, hit, other)) {
                return true;
            }
        }
        !geometry.see_through.instances.is_empty()
            && self.misses_see_through(geometry, members, ray, nearest)
    }

    fn misses_see_through(
        &mut self,
        geometry: &InstancedGeometry,
        members: &Members,
        ray: Ray,
        nearest: Option<Hit>,
    ) -> bool {
        let Self { caster, missing, present } = self;
        missing.clear();
        present.clear();
        let limit = nearest.map_or(f64::INFINITY, |hit| hit.distance);
        caster.see_through(geometry, ray, limit, |hit| {
            if members.contains(hit.primitive) { present.push(hit) } else { missing.push(hit) }
        });
        // Nearest first, so that `ties` sees its arguments in order.
        missing.iter().any(|&gone| {
            let behind = nearest.is_some_and(|wall| ties(geometry, ray, gone, wall));
            let replaced = present.iter().any(|&other| {
                let (near, far) =
                    if gone.distance <= other.distance { (gone, other) } else { (other, gone) };
                ties(geometry, ray, near, far)
            });
            !behind && !replaced
        })
    }
}
