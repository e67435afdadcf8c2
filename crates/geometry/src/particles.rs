//! Particles: spheres that move, as primitives of their own.
//!
//! A sphere is a surface that is seen from both sides, like a triangle; from inside a particle one
//! sees its back wall. Spheres may overlap each other and triangles.

use glam::DVec3;

use crate::{Bounds, Bounds32, MovingHierarchy, ObjectId, PrimitiveId, motion::around};

/// A leaf holds at most so many spheres.
const SPHERES_A_LEAF: usize = 4;

/// A sphere at one time, relative to the origin of its system.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// Centre, metres.
    pub center: [f32; 3],
    /// Radius, metres; negative for a particle that is not there.
    pub radius: f32,
}

impl Sphere {
    /// A particle that is not there.
    pub const ABSENT: Self = Self { center: [0.0; 3], radius: -1.0 };

    /// True for a particle that is there.
    #[inline(always)]
    #[must_use]
    pub fn is_present(&self) -> bool {
        self.radius >= 0.0
    }

    /// Its box; empty when it is not there.
    #[must_use]
    pub fn bounds(&self) -> Bounds32 {
        if !self.is_present() {
            return crate::hierarchy::EMPTY;
        }
        let (center, radius) = (self.center(), f64::from(self.radius));
        Bounds32::containing(Bounds { min: center - radius, max: center + radius })
    }

    /// Its centre in `f64`.
    #[inline(always)]
    #[must_use]
    pub fn center(&self) -> DVec3 {
        DVec3::from_array(self.center.map(f64::from))
    }
}

/// Particles of one object, with their hierarchy.
///
/// A particle is there in a state when it is at both of its key frames.
#[derive(Clone, Debug)]
pub struct ParticleSystem {
    /// The author's object.
    pub object: ObjectId,
    /// Global number of particle 0.
    pub first_primitive: PrimitiveId,
    /// False for particles that hide nothing.
    pub occluder: bool,
    /// World position that centres are relative to.
    pub origin: DVec3,
    /// The spheres at each key frame, in hierarchy order; a single key frame for what rests.
    pub keys: Vec<Vec<Sphere>>,
    /// Hierarchy over the spheres, relative to `origin`.
    pub hierarchy: MovingHierarchy,
    /// World box over all key frames.
    pub bounds: Bounds,
}

impl ParticleSystem {
    /// Puts particles in hierarchy order. `keys` has one list a key frame, all of one length.
    /// Returns the system and the order: particle `i` of the system is particle `order[i]`.
    ///
    /// # Panics
    /// Without a key frame, or with lists of different lengths.
    #[must_use]
    pub fn new(
        object: ObjectId,
        first_primitive: PrimitiveId,
        occluder: bool,
        origin: DVec3,
        mut keys: Vec<Vec<Sphere>>,
    ) -> (Self, Vec<u32>) {
        let count = keys[0].len();
        assert!(keys.iter().all(|spheres| spheres.len() == count), "one sphere a key frame");
        let (hierarchy, order) =
            MovingHierarchy::build(count, keys.len(), SPHERES_A_LEAF, |i, key| {
                keys[key][i].bounds()
            });
        for spheres in &mut keys {
            // One key frame at a time, so that no second copy of all is held.
            *spheres = order.iter().map(|&i| spheres[i as usize]).collect();
        }
        let mut bounds = Bounds::EMPTY;
        if count > 0 {
            for key in 0..keys.len() {
                let own = hierarchy.at(0, key as u32);
                if !own.is_empty() {
                    let own = own.widen();
                    bounds = bounds.union(Bounds { min: own.min + origin, max: own.max + origin });
                }
            }
        }
        (Self { object, first_primitive, occluder, origin, keys, hierarchy, bounds }, order)
    }

    /// Number of particles.
    #[must_use]
    pub fn len(&self) -> usize {
        self.keys[0].len()
    }

    /// True without particles.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// A particle at the key frames around a state; `None` when it is not there.
    #[inline(always)]
    #[must_use]
    pub fn around(&self, particle: usize, state: u32) -> Option<(Sphere, Sphere)> {
        let (from, to) = around(&self.keys, state);
        let (from, to) = (from[particle], to[particle]);
        (from.is_present() && to.is_present()).then_some((from, to))
    }
}
