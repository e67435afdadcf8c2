//! What is really seen at held-out viewpoints, traced once and compared with every set.
//!
//! The error is that of `sightline_quality`: the share of rays, uniform over the sphere, whose
//! nearest primitive is not in the set and has no member of the set at the same depth. There, every
//! measurement traces anew; here, a ray keeps its nearest primitive and those at the same depth,
//! so that measuring a set is looking things up.

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::raycast::{Ray, RayCaster};
use sightline_geometry::{InstancedGeometry, PrimitiveId, PrimitiveSet};
use sightline_quality::{Members, ties};

use crate::directions::{morton, rotation, sphere, stream};

/// Rays of one piece of work.
const CHUNK: u32 = 1024;

/// Most primitives at the same depth that a ray keeps. A ray along a triangle ties with all that
/// is behind it, as far as the bounds tell.
const TIES_MAX: usize = 8;

/// Pixel error of a set.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Error {
    /// Mean over the viewpoints, in [0, 1].
    pub mean: f64,
    /// Largest of a viewpoint, in [0, 1].
    pub worst: f64,
}

/// What rays from viewpoints see.
pub struct Truth {
    /// For each viewpoint and each ray that hits something: its primitives, one after the other.
    viewpoints: Vec<Vec<u32>>,
    rays: u32,
}

/// Set on the last primitive of a ray; primitive numbers stay below it.
const LAST: u32 = 1 << 31;

impl Truth {
    /// Traces `rays` rays, rounded up to a power of four, from each viewpoint.
    ///
    /// # Panics
    /// When the scene has 2^31 primitives or more.
    #[must_use]
    pub fn trace(geometry: &InstancedGeometry, viewpoints: &[DVec3], rays: u32) -> Self {
        assert!(geometry.primitive_count() < LAST, "primitive numbers leave a bit free");
        let side = (f64::from(rays).sqrt().ceil() as u32).next_power_of_two().max(2);
        let rays = side * side;
        let at = |viewpoint: usize| {
            let rotation = rotation(0x7121 + viewpoint as u64);
            let pieces: Vec<Vec<u32>> = (0..rays.div_ceil(CHUNK))
                .into_par_iter()
                .map_init(RayCaster::new, |caster, piece| {
                    let mut random = stream(viewpoint as u64, u64::from(piece));
                    let mut seen = Vec::new();
                    for i in piece * CHUNK..rays.min((piece + 1) * CHUNK) {
                        let (x, y) = morton(i);
                        let mut jitter =
                            |k: u32| (f64::from(k) + random.next_unit()) / f64::from(side);
                        let direction = rotation * sphere(jitter(x), jitter(y));
                        let ray = Ray::new(viewpoints[viewpoint], direction);
                        nearest(geometry, caster, ray, &mut seen);
                    }
                    seen
                })
                .collect();
            pieces.concat()
        };
        Self { viewpoints: (0..viewpoints.len()).map(at).collect(), rays }
    }

    /// Rays a viewpoint.
    #[must_use]
    pub const fn rays(&self) -> u32 {
        self.rays
    }

    /// The error of `set` in a scene of `primitives` primitives.
    #[must_use]
    pub fn error(&self, set: &PrimitiveSet, primitives: u32) -> Error {
        let members = Members::new(set, primitives);
        let of = |seen: &Vec<u32>| {
            let rays = seen.split_inclusive(|p| p & LAST != 0);
            let is_wrong =
                |ray: &&[u32]| !ray.iter().any(|p| members.contains(PrimitiveId(p & !LAST)));
            rays.filter(is_wrong).count() as f64 / f64::from(self.rays)
        };
        let errors: Vec<f64> = self.viewpoints.par_iter().map(of).collect();
        Error {
            mean: errors.iter().sum::<f64>() / errors.len().max(1) as f64,
            worst: errors.iter().fold(0.0, |w, e| e.max(w)),
        }
    }
}

/// Appends the nearest primitive of a ray and those at the same depth.
fn nearest(geometry: &InstancedGeometry, caster: &mut RayCaster, ray: Ray, seen: &mut Vec<u32>) {
    let Some(hit) = caster.closest_occluder(geometry, ray, f64::INFINITY, |_| true) else { return };
    let first = seen.len();
    seen.push(hit.primitive.0);
    while seen.len() - first < TIES_MAX {
        let known = &seen[first..];
        // What ties is hardly farther; the limit spares the walk behind it.
        let limit = hit.distance * 1.001;
        let next = caster.closest_occluder(geometry, ray, limit, |p| !known.contains(&p.0));
        match next {
            Some(next) if ties(geometry, ray, hit, next) => seen.push(next.primitive.0),
            _ => break,
        }
    }
    if let Some(last) = seen.last_mut() {
        *last |= LAST;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rivals::tests::random_triangles;
    use sightline_quality::measure_viewpoint;

    #[test]
    fn the_error_is_that_of_the_quality_crate() {
        let geometry = random_triangles(300, 3);
        let viewpoint = DVec3::new(0.1, -0.2, 0.3);
        let truth = Truth::trace(&geometry, &[viewpoint], 1 << 16);
        for every in [2, 3, 10] {
            let set = PrimitiveSet::from_sorted((0..300).filter(|p| p % every != 0));
            let ours = truth.error(&set, 300).mean;
            let theirs = measure_viewpoint(&geometry, &set, viewpoint, 1 << 16, 1).error;
            assert!((ours - theirs).abs() < 0.01, "{ours} {theirs}");
            assert!(ours > 0.02);
        }
        let all = PrimitiveSet::from_sorted(0..300);
        assert_eq!(truth.error(&all, 300), Error::default());
    }
}
