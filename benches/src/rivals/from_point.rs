//! From-point sampling: the visible sets of many viewpoints, added up.
//!
//! Reference: the comparison of Popescu, Lee, Choi, Fahmy, "Complex VEs on All-In-One VR Headsets
//! Through Continuous From-Segment Visibility Computation", section 4.5, which samples the segment
//! uniformly; and the random sampling that Wonka et al., "Guided Visibility Sampling" (SIGGRAPH
//! 2006) compare with, which draws origins in the view cell.
//!
//! A *batch* is a set of directions spread evenly over the sphere, turned by a random rotation of
//! its own. Its rays start at one viewpoint (a frame), or each group of rays at its own.
//!
//! What makes it strong:
//! - viewpoints come from sequences that are even at every length (van der Corput along the
//!   perimeter, R2 in the rectangle), directions are stratified: nothing is left to luck;
//! - frames are small and turned, so that no two viewpoints look in the same directions; in the
//!   rectangle every ray has a viewpoint of its own, which finds most for a number of rays;
//! - rays come in the order of a Morton curve over the sphere, which the tracers like;
//! - the tracer is the fastest measured on the scene for this kind of rays;
//! - the result of a ray is one bit, set without locks; all threads trace.
//!
//! Parameters: rays a batch ([`SIDE`] squared), rays a viewpoint.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use sightline_geometry::{PrimitiveSet, ViewSegment};

use crate::curve::Progressive;
use crate::directions::{morton, rotation, sphere, stream, van_der_corput};
use crate::found::Found;
use crate::region::Region;
use crate::tracers::{LocalRay, MISS, Tracer};

/// Side of the square of directions of a batch.
pub const SIDE: u32 = 256;

/// Rays that a thread traces in one go.
const CHUNK: usize = 4096;

/// Where viewpoints are.
#[derive(Clone, Debug)]
pub enum Viewpoints {
    /// Uniform along segments of equal length that follow each other; a viewpoint has a whole
    /// batch.
    Along(Vec<ViewSegment>),
    /// In the rectangle; so many rays have a viewpoint to themselves.
    Inside(Region, usize),
}

impl Viewpoints {
    fn rays_each(&self) -> usize {
        match self {
            Self::Along(_) => (SIDE * SIDE) as usize,
            Self::Inside(_, rays) => *rays,
        }
    }

    fn at(&self, k: u64) -> DVec3 {
        match self {
            Self::Along(segments) => {
                let along = van_der_corput(k as u32) * segments.len() as f64;
                let segment = &segments[along as usize];
                segment.v0.lerp(segment.v1, along.fract())
            }
            Self::Inside(region, _) => {
                const PLASTIC: f64 = 1.324_717_957_244_746;
                let share = |step: f64| (0.5 + k as f64 * step).fract();
                region.at(share(1.0 / PLASTIC), share(1.0 / (PLASTIC * PLASTIC)))
            }
        }
    }
}

/// Batches of rays.
pub struct Batches {
    viewpoints: Viewpoints,
    /// Unit directions of a batch, along a Morton curve.
    directions: Vec<Vec3>,
}

impl Batches {
    /// Batches from viewpoints.
    #[must_use]
    pub fn new(viewpoints: Viewpoints) -> Self {
        let mut random = stream(0xF0, 0);
        let mut jitter = |k: u32| (f64::from(k) + random.next_unit()) / f64::from(SIDE);
        let directions = (0..SIDE * SIDE)
            .map(|i| {
                let (x, y) = morton(i);
                sphere(jitter(x), jitter(y)).as_vec3()
            })
            .collect();
        Self { viewpoints, directions }
    }

    /// Pieces of a batch.
    pub const PIECES: usize = (SIDE * SIDE) as usize / CHUNK;

    /// Replaces `rays` by a piece of a batch, relative to `tracer_origin`.
    pub fn piece(&self, batch: u64, piece: usize, tracer_origin: DVec3, rays: &mut Vec<LocalRay>) {
        let turn = rotation(batch).as_mat3();
        let first = piece * CHUNK;
        let each = self.viewpoints.rays_each();
        let viewpoints_a_batch = (self.directions.len() / each) as u64;
        rays.clear();
        let mut origin = Vec3::ZERO;
        for (i, &direction) in (first..).zip(&self.directions[first..first + CHUNK]) {
            if i % each == 0 || i == first {
                let k = batch * viewpoints_a_batch + (i / each) as u64;
                origin = (self.viewpoints.at(k) - tracer_origin).as_vec3();
            }
            rays.push(LocalRay { origin, direction: turn * direction });
        }
    }
}

/// The method in progress.
pub struct FromPoint<'a> {
    tracer: &'a dyn Tracer,
    batches: Batches,
    found: Found,
    done: u64,
}

impl<'a> FromPoint<'a> {
    /// Nothing found yet, in a scene of `primitives` primitives.
    #[must_use]
    pub fn new(tracer: &'a dyn Tracer, primitives: u32, viewpoints: Viewpoints) -> Self {
        let batches = Batches::new(viewpoints);
        Self { tracer, batches, found: Found::new(primitives), done: 0 }
    }

    /// Rays traced so far.
    #[must_use]
    pub fn rays(&self) -> u64 {
        self.done * u64::from(SIDE * SIDE)
    }

    /// What was found so far.
    #[must_use]
    pub fn found_so_far(&self) -> &Found {
        &self.found
    }
}

impl Progressive for FromPoint<'_> {
    fn step(&mut self) -> bool {
        let batches = rayon::current_num_threads().next_power_of_two();
        let this = &*self;
        (0..batches * Batches::PIECES).into_par_iter().for_each_init(
            || (Vec::with_capacity(CHUNK), Vec::with_capacity(CHUNK)),
            |(rays, hits), k| {
                let batch = this.done + (k / Batches::PIECES) as u64;
                this.batches.piece(batch, k % Batches::PIECES, this.tracer.origin(), rays);
                this.tracer.closest(rays, hits);
                for hit in hits.iter().filter(|h| h.primitive != MISS) {
                    this.found.insert(hit.primitive);
                }
            },
        );
        self.done += batches as u64;
        true
    }

    fn found(&self) -> PrimitiveSet {
        self.found.set()
    }

    fn label(&self) -> String {
        format!("{:.1} M rays", self.rays() as f64 / 1e6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rivals::tests::{random_triangles, scene_of};
    use crate::tracers::wide::Wide;

    fn region() -> Region {
        Region::new([-0.5, -0.5, 0.5, 0.5], 0.0).unwrap()
    }

    fn both() -> [Viewpoints; 2] {
        [Viewpoints::Along(region().perimeter(0.5)), Viewpoints::Inside(region(), 1)]
    }

    #[test]
    fn a_lone_triangle_is_found() {
        // 0.5 degrees wide: several rays of one batch meet it.
        let scene = scene_of(&[[10.0, 0.0, 0.0], [10.0, 0.1, 0.0], [10.0, 0.0, 0.1]]);
        let tracer = Wide::new(&scene, DVec3::ZERO);
        for viewpoints in both() {
            let mut method = FromPoint::new(&tracer, 1, viewpoints);
            for _ in 0..4 {
                method.step();
            }
            assert_eq!(method.found().len(), 1);
        }
    }

    #[test]
    fn a_triangle_that_only_the_inside_sees_is_found_from_the_inside_alone() {
        // Two plates hide a triangle from the perimeter, above and below the middle.
        let tiny = [[0.0, 0.1, 0.0], [0.01, 0.1, 0.0], [0.0, 0.1, 0.01]];
        let plate = |x: f32| [[x, -9.0, -9.0], [x, 9.0, -9.0], [x, 0.0, 19.0]];
        let wall = |z: f32| [[-9.0, -9.0, z], [9.0, -9.0, z], [0.0, 19.0, z]];
        let corners = [tiny, plate(-0.2), plate(0.2), wall(-0.2), wall(0.2)].concat();
        let scene = scene_of(&corners);
        let tiny = (0..5)
            .find(|&p| {
                let t = scene.triangle(sightline_geometry::PrimitiveId(p));
                t.corners.iter().all(|c| c.length() < 0.2)
            })
            .unwrap();
        let tracer = Wide::new(&scene, DVec3::ZERO);
        let [along, inside] = both().map(|viewpoints| {
            let mut method = FromPoint::new(&tracer, 5, viewpoints);
            for _ in 0..4 {
                method.step();
            }
            method.found_so_far().contains(tiny)
        });
        assert!(!along && inside);
    }

    #[test]
    fn the_result_does_not_depend_on_threads() {
        let scene = random_triangles(2000, 8);
        let tracer = Wide::new(&scene, DVec3::ZERO);
        for viewpoints in both() {
            let run = |threads: usize, steps: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| {
                    let mut method = FromPoint::new(&tracer, 2000, viewpoints.clone());
                    (0..steps).for_each(|_| _ = method.step());
                    (method.rays(), method.found())
                })
            };
            // A step has a batch a thread.
            assert_eq!(run(1, 4), run(2, 2));
        }
    }
}
