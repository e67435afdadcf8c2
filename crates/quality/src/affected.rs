//! Whether what was added to a scene changes what was measured in a cell.
//!
//! A measurement depends on what its rays meet first. The same rays are cast into what was added, alone:
//! only one that meets it is cast into the whole scene as well. Whether what was taken away was met, is
//! known from the set and from what rays met that it lacks ([`crate::Scattered::missing`]).

use rayon::prelude::*;
use sightline_geometry::raycast::{Ray, RayCaster};
use sightline_geometry::{InstancedGeometry, Timeline, ViewCell};

use crate::measure::rays_at;
use crate::scattered::{Suspect, scattered_pieces, scattered_rays};

/// Part of a distance within which two hits are taken for the same: far above rounding. To take too many
/// costs a measurement that would not have been needed.
const SLACK: f64 = 1e-6;

/// A scene at rest, and what was added to it.
#[derive(Clone, Copy, Debug)]
pub struct Newcomers<'a> {
    /// The scene with what was added.
    pub scene: &'a InstancedGeometry,
    /// What was added alone.
    pub alone: &'a InstancedGeometry,
}

impl Newcomers<'_> {
    /// True when a ray of a batch of [`crate::measure_scattered`] meets what was added.
    #[must_use]
    pub fn are_met_by_batch(&self, cell: &ViewCell, batch: u32, seed: u64) -> bool {
        let (lattice, pieces) = scattered_pieces();
        let (timeline, states) = (Timeline::at_rest(), 0..1);
        let meets = |caster: &mut RayCaster, range| {
            scattered_rays(lattice, &timeline, &states, cell, (batch, seed), range)
                .any(|ray| self.are_met_by(caster, ray))
        };
        pieces.into_par_iter().map_init(RayCaster::new, meets).any(|meets| meets)
    }

    /// True when a ray of a measurement of a viewpoint, with the seed that it has in
    /// [`crate::measure_viewpoint_at`], meets what was added.
    #[must_use]
    pub fn are_met_from(&self, at: Suspect, rays: u32, seed: u64) -> bool {
        let mut caster = RayCaster::new();
        rays_at(at, rays, seed, |ray| self.are_met_by(&mut caster, ray))
    }

    fn are_met_by(&self, caster: &mut RayCaster, ray: Ray) -> bool {
        let any = |_| true;
        let mut first = caster
            .closest_occluder(self.alone, ray, f64::INFINITY, any)
            .map_or(f64::INFINITY, |hit| hit.distance);
        caster.see_through(self.alone, ray, first, |hit| first = first.min(hit.distance));
        if first == f64::INFINITY {
            return false;
        }
        // Something that hides it is nearer by more than rounding.
        let limit = first * (1.0 - SLACK);
        caster.closest_occluder(self.scene, ray, limit, any).is_none()
    }
}
