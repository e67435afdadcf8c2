//! The project's own ray caster behind the interface of the tracers.

use glam::DVec3;
use sightline_geometry::InstancedGeometry;
use sightline_geometry::raycast::{Ray, RayCaster};

use super::{LocalHit, LocalRay, Tracer};

/// `sightline_geometry::raycast`, in `f64`.
pub struct Caster<'a> {
    geometry: &'a InstancedGeometry,
    origin: DVec3,
}

impl<'a> Caster<'a> {
    /// A tracer for rays that start near `origin`.
    #[must_use]
    pub fn new(geometry: &'a InstancedGeometry, origin: DVec3) -> Self {
        Self { geometry, origin }
    }
}

impl Tracer for Caster<'_> {
    fn name(&self) -> &'static str {
        "own caster, f64"
    }

    fn origin(&self) -> DVec3 {
        self.origin
    }

    fn closest(&self, rays: &[LocalRay], hits: &mut Vec<LocalHit>) {
        let mut caster = RayCaster::new();
        hits.clear();
        hits.extend(rays.iter().map(|ray| {
            let origin = self.origin + ray.origin.as_dvec3();
            let ray = Ray::new(origin, ray.direction.as_dvec3());
            let hit = caster.closest_occluder(self.geometry, ray, f64::INFINITY, |_| true);
            hit.map_or(LocalHit::MISS, |hit| LocalHit {
                primitive: hit.primitive.0,
                distance: hit.distance as f32,
            })
        }));
    }
}
