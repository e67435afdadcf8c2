//! The measurement: rays from viewpoints, wrong ones counted.
//!
//! Work is cut into pieces of [`CHUNK`] rays, which run in parallel; their counts are added, so
//! the order does not matter. Nearly every ray ends at a member of the set after one trace; only
//! the others are traced again with the members alone.

use std::ops::Range;

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::raycast::{Hit, Ray, RayCaster};
use sightline_geometry::{
    CellId, InstancedGeometry, Moment, PrimitiveId, PrimitiveSet, StateSets, Timeline, ViewCell,
};

use crate::depth_tie::ties;
use crate::directions::Lattice;
use crate::membership::StateMembers;
use crate::scattered::Suspect;
use crate::seed::{SplitMix64, batch_seed, moment_seed, placement_seed, viewpoint_seed};

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
    /// When they are cast.
    pub moment: Moment,
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
    /// Primitives that rays met and the sets lack, in a fixed order; some of them often. What ties with a
    /// member is among them, though its ray is not wrong.
    pub missing: Vec<PrimitiveId>,
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

/// Measures `set` at one viewpoint of a scene at rest with `rays` directions given by `seed`.
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
    let at = Suspect { viewpoint, moment: Moment::START };
    measure_viewpoint_at(geometry, &StateSets::constant(0..1, set.clone()), at, rays, seed)
}

/// Measures `sets` at one viewpoint and moment with `rays` directions given by `seed`.
///
/// # Panics
/// When a set has a member that the geometry lacks, or the moment's state is not covered.
#[must_use]
pub fn measure_viewpoint_at(
    geometry: &InstancedGeometry,
    sets: &StateSets,
    at: Suspect,
    rays: u32,
    seed: u64,
) -> ViewpointError {
    measure(geometry, sets, &[(at, seed)], rays).0[0]
}

/// Measures `set` at `viewpoints` random viewpoints, uniform in the cell, of a scene at rest.
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
    let sets = StateSets::constant(0..1, set.clone());
    measure_cell_over(geometry, &sets, &Timeline::at_rest(), cell, viewpoints, rays, seed)
}

/// Measures `sets` at `viewpoints` random viewpoints, uniform in the cell, each at a random moment,
/// uniform over the time of the states.
///
/// # Panics
/// When a set has a member that the geometry lacks, or the timeline lacks a state.
#[must_use]
pub fn measure_cell_over(
    geometry: &InstancedGeometry,
    sets: &StateSets,
    timeline: &Timeline,
    cell: &ViewCell,
    viewpoints: u32,
    rays: u32,
    seed: u64,
) -> CellError {
    let states = sets.states();
    let mut clock = SplitMix64::new(moment_seed(seed, cell.id));
    let at: Vec<Suspect> = random_viewpoints(cell, viewpoints, seed)
        .into_iter()
        .map(|viewpoint| {
            let moment = timeline.moment(&states, clock.next_unit());
            Suspect { viewpoint, moment }
        })
        .collect();
    measure_viewpoints_at(geometry, sets, cell.id, &at, rays, seed)
}

/// Measures `sets` at given viewpoints and moments of a cell; the directions at number i are given by
/// [`viewpoint_seed`]`(seed, cell, i)`.
///
/// # Panics
/// When a set has a member that the geometry lacks, or a moment's state is not covered.
#[must_use]
pub fn measure_viewpoints_at(
    geometry: &InstancedGeometry,
    sets: &StateSets,
    cell: CellId,
    at: &[Suspect],
    rays: u32,
    seed: u64,
) -> CellError {
    let seeded: Vec<(Suspect, u64)> =
        (0..).zip(at).map(|(i, &at)| (at, viewpoint_seed(seed, cell, i))).collect();
    let (viewpoints, missing) = measure(geometry, sets, &seeded, rays);
    CellError { cell, viewpoints, missing }
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
    sets: &StateSets,
    viewpoints: &[(Suspect, u64)],
    rays: u32,
) -> (Vec<ViewpointError>, Vec<PrimitiveId>) {
    let members = StateMembers::new(sets, geometry.primitive_count());
    let batches = Batches::new(rays);
    let pieces: Vec<(usize, u32, &Lattice, usize)> = (0..viewpoints.len())
        .flat_map(|v| batches.iter().map(move |(batch, lattice)| (v, batch, lattice)))
        .flat_map(|(v, batch, lattice)| {
            (0..lattice.len()).step_by(CHUNK).map(move |start| (v, batch, lattice, start))
        })
        .collect();
    let counts: Vec<(usize, u32, Vec<PrimitiveId>)> = pieces
        .into_par_iter()
        .map_init(Tracer::default, |tracer, (v, batch, lattice, start)| {
            let (at, seed) = viewpoints[v];
            let range = start..lattice.len().min(start + CHUNK);
            let rays = viewpoint_rays(lattice, at, batch_seed(seed, batch), range);
            let wrong = rays.filter(|&ray| tracer.is_wrong(geometry, &members, ray)).count();
            (v, wrong as u32, tracer.take_missing())
        })
        .collect();
    let mut wrong = vec![0u32; viewpoints.len()];
    let mut missing = Vec::new();
    for (v, count, of_piece) in counts {
        wrong[v] += count;
        missing.extend(of_piece);
    }
    let errors = viewpoints.iter().zip(wrong).map(|(&(at, seed), wrong)| {
        let error = f64::from(wrong) / f64::from(rays.max(1));
        let Suspect { viewpoint, moment } = at;
        ViewpointError { viewpoint, moment, rays, wrong, error, seed }
    });
    (errors.collect(), missing)
}

/// Some of the rays of a lattice at a viewpoint.
fn viewpoint_rays(
    lattice: &Lattice,
    at: Suspect,
    seed: u64,
    range: Range<usize>,
) -> impl Iterator<Item = Ray> {
    lattice.directions(seed, range).map(move |direction| Ray {
        origin: at.viewpoint,
        direction,
        moment: at.moment,
    })
}

/// All rays of a viewpoint's measurement with a seed.
pub(crate) fn rays_at(
    at: Suspect,
    rays: u32,
    seed: u64,
    mut look: impl FnMut(Ray) -> bool,
) -> bool {
    Batches::new(rays).iter().any(|(batch, lattice)| {
        viewpoint_rays(lattice, at, batch_seed(seed, batch), 0..lattice.len()).any(&mut look)
    })
}

/// True when something can be seen and hides nothing.
fn has_see_through(geometry: &InstancedGeometry) -> bool {
    !geometry.see_through.instances.is_empty()
        || !geometry.moving_see_through.instances.is_empty()
        || geometry.particles.iter().any(|system| !system.occluder)
}

/// A ray caster and the see-through hits of the current ray.
#[derive(Default)]
pub(crate) struct Tracer {
    caster: RayCaster,
    missing: Vec<Hit>,
    present: Vec<Hit>,
    /// What the set lacks of what rays met.
    lacking: Vec<PrimitiveId>,
}

impl Tracer {
    /// What the set lacks of what rays met since the last call.
    pub(crate) fn take_missing(&mut self) -> Vec<PrimitiveId> {
        std::mem::take(&mut self.lacking)
    }

    /// The definition of the crate's documentation.
    pub(crate) fn is_wrong(
        &mut self,
        geometry: &InstancedGeometry,
        members: &StateMembers<'_>,
        ray: Ray,
    ) -> bool {
        let present = |p| members.contains(p, ray.moment.state);
        let nearest = self.caster.closest_occluder(geometry, ray, f64::INFINITY, |_| true);
        if let Some(hit) = nearest
            && !present(hit.primitive)
        {
            // Whether it ties or not: what is met when it is gone may not tie.
            self.lacking.push(hit.primitive);
            let of_set = self.caster.closest_occluder(geometry, ray, f64::INFINITY, present);
            if !of_set.is_some_and(|other| ties(geometry, ray, hit, other)) {
                return true;
            }
        }
        has_see_through(geometry) && self.misses_see_through(geometry, members, ray, nearest)
    }

    fn misses_see_through(
        &mut self,
        geometry: &InstancedGeometry,
        members: &StateMembers<'_>,
        ray: Ray,
        nearest: Option<Hit>,
    ) -> bool {
        let Self { caster, missing, present, lacking } = self;
        missing.clear();
        present.clear();
        let limit = nearest.map_or(f64::INFINITY, |hit| hit.distance);
        caster.see_through(geometry, ray, limit, |hit| {
            if members.contains(hit.primitive, ray.moment.state) {
                present.push(hit)
            } else {
                missing.push(hit)
            }
        });
        // Nearest first, so that `ties` sees its arguments in order.
        let is_wrong = missing.iter().any(|&gone| {
            let behind = nearest.is_some_and(|wall| ties(geometry, ray, gone, wall));
            let replaced = present.iter().any(|&other| {
                let (near, far) =
                    if gone.distance <= other.distance { (gone, other) } else { (other, gone) };
                ties(geometry, ray, near, far)
            });
            !behind && !replaced
        });
        if is_wrong {
            lacking.extend(missing.iter().map(|hit| hit.primitive));
        }
        is_wrong
    }
}
