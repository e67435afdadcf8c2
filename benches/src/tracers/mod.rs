//! Ray tracers for the methods that sample: the best at hand, measured in every run.
//!
//! - [`caster::Caster`]: the project's own `f64` caster, the reference of the measurements.
//! - [`wide::Wide`]: eight-wide compressed hierarchies of the crate `obvhs` (Ylitie, Karras, Laine,
//!   "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", HPG 2017),
//!   traversed with SSE, in `f32`. Builds everywhere.
//! - `embree::Embree`, with the feature `embree`: Intel Embree 3 (Wald et al., "Embree: A Kernel
//!   Framework for Efficient CPU Ray Tracing", SIGGRAPH 2014) with AVX-512 where there is, single
//!   rays or packets of sixteen.
//!
//! All trace closest hits of batches of rays on the calling thread; methods spread batches over
//! threads. Every primitive is an occluder. Scenes of up to [`FLAT_MAX`] triangles are one body, which
//! spares the way into instances; larger ones keep their instances.

use std::time::Instant;

use glam::{DVec3, Vec3};
use sightline_geometry::InstancedGeometry;

pub mod caster;
#[cfg(feature = "embree")]
pub mod embree;
pub mod wide;

/// Most triangles that are put into one body.
pub const FLAT_MAX: u32 = 8_000_000;

/// No primitive.
pub const MISS: u32 = u32::MAX;

/// A half-line. The origin is relative to the tracer's, so that `f32` is exact enough.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalRay {
    /// Start, metres from the tracer's origin.
    pub origin: Vec3,
    /// Unit direction.
    pub direction: Vec3,
}

/// The nearest primitive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalHit {
    /// Global number, or [`MISS`].
    pub primitive: u32,
    /// Distance in units of the direction's length; infinite for a miss.
    pub distance: f32,
}

impl LocalHit {
    /// Nothing.
    pub const MISS: Self = Self { primitive: MISS, distance: f32::INFINITY };
}

/// Finds nearest primitives.
pub trait Tracer: Send + Sync {
    /// What the tables call it.
    fn name(&self) -> &'static str;
    /// World position that origins are relative to.
    fn origin(&self) -> DVec3;
    /// Replaces `hits` by the nearest hits of `rays`.
    fn closest(&self, rays: &[LocalRay], hits: &mut Vec<LocalHit>);

    /// A ray in the tracer's space.
    fn local(&self, origin: DVec3, direction: DVec3) -> LocalRay {
        let origin = (origin - self.origin()).as_vec3();
        LocalRay { origin, direction: direction.as_vec3() }
    }
}

/// Tracers of one scene.
pub type Tracers<'a> = Vec<Box<dyn Tracer + 'a>>;

/// A tracer, and the seconds that it took to build on the wall.
pub type Built<'a> = (Box<dyn Tracer + 'a>, f64);

/// Every tracer of this build, for rays that start near `origin`.
///
/// # Errors
/// When Embree cannot be started.
pub fn all(geometry: &InstancedGeometry, origin: DVec3) -> Result<Vec<Built<'_>>, String> {
    let mut out: Vec<Built> = Vec::new();
    let began = Instant::now();
    out.push((Box::new(wide::Wide::new(geometry, origin)), began.elapsed().as_secs_f64()));
    // The scene was read with the hierarchies that the caster walks.
    out.push((Box::new(caster::Caster::new(geometry, origin)), 0.0));
    #[cfg(feature = "embree")]
    {
        let began = Instant::now();
        let scene = std::sync::Arc::new(embree::EmbreeScene::new(geometry, origin)?);
        let seconds = began.elapsed().as_secs_f64();
        out.push((Box::new(embree::Embree::single(scene.clone())), seconds));
        out.push((Box::new(embree::Embree::packets(scene)), seconds));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::directions::{sphere, stream};
    use crate::rivals::tests::{instanced_triangles, random_triangles};

    #[test]
    fn tracers_agree() {
        let origin = DVec3::new(0.05, 0.0, -0.1);
        for geometry in [random_triangles(500, 1), instanced_triangles(40, 30)] {
            let mut tracers: Vec<_> =
                all(&geometry, origin).unwrap().into_iter().map(|t| t.0).collect();
            tracers.insert(0, Box::new(caster::Caster::new(&geometry, origin)));
            let mut random = stream(5, 0);
            let directions: Vec<DVec3> =
                (0..20_000).map(|_| sphere(random.next_unit(), random.next_unit())).collect();
            let trace = |tracer: &dyn Tracer| {
                let rays: Vec<_> = directions.iter().map(|&d| tracer.local(origin, d)).collect();
                let mut hits = Vec::new();
                tracer.closest(&rays, &mut hits);
                hits
            };
            let truth = trace(&*tracers[0]);
            assert!(truth.iter().filter(|h| h.primitive != MISS).count() > 1000);
            for tracer in &tracers[1..] {
                let hits = trace(&**tracer);
                let differ = hits.iter().zip(&truth).filter(|(a, b)| a.primitive != b.primitive);
                // Rays within rounding of an edge.
                assert!(differ.count() < 20, "{}", tracer.name());
            }
        }
    }
}
