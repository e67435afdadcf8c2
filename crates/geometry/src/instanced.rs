//! Triangles as the solver and the ray caster see them: meshes, instances of meshes, and
//! hierarchies over both. Memory follows unique triangles.
//!
//! Numbering: the primitives of an instance are `first_primitive ..
//! first_primitive + triangles of its mesh`, instances are numbered in ascending order of
//! `first_primitive` and leave no gaps, and the triangles of a mesh are in the order of the
//! mesh's hierarchy, so visible sets are runs of numbers.
//!
//! Particles are numbered behind the instances, system by system.
//!
//! Occluders and see-through instances (alpha-masked, blended, or marked by the author) are in
//! two top-level hierarchies: the first hide what is behind them, the second never do. Those that move
//! are in two more, whose nodes have a box at each key frame: what rests never pays for motion.

use std::{collections::BTreeMap, ops::Range, sync::Arc};

use glam::{DAffine3, DVec3};

use crate::{
    Array, Bounds, Bounds32, Hierarchy, InstanceId, MeshId, Moment, MovingHierarchy, ObjectId,
    ParticleSystem, PrimitiveId, Residency,
    hierarchy::{INSTANCES_A_LEAF, TRIANGLES_A_LEAF},
    motion::{around, lerp, lerp_transform},
};

/// Corners of a triangle in world space, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triangle {
    /// The three corners, in the winding order of the file.
    pub corners: [DVec3; 3],
}

/// Where a primitive is and what it is made of, world space, at one moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A triangle.
    Triangle(Triangle),
    /// A particle.
    Sphere {
        /// Centre, metres.
        center: DVec3,
        /// Radius, metres.
        radius: f64,
    },
    /// A particle that is not there.
    Absent,
}

/// Which part of the geometry a primitive is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// A triangle of an instance: the instance, and the triangle's number in its mesh.
    Triangle(InstanceId, usize),
    /// A particle: the number of its system, and its own in that.
    Particle(usize, usize),
}

/// One body of triangles in its own space, with its hierarchy.
#[derive(Clone, Debug)]
pub struct Mesh {
    /// Vertex positions, mesh space, metres; those of the first key frame.
    pub positions: Array<[f32; 3]>,
    /// Vertex indices a triangle, in hierarchy order.
    pub triangles: Array<[u32; 3]>,
    /// Hierarchy over the triangles; without nodes where they move.
    pub hierarchy: Hierarchy,
    /// Box of the triangles at all key frames, mesh space.
    pub bounds: Bounds,
    /// How the vertices move, where they do.
    pub motion: Option<MeshMotion>,
}

/// How the vertices of a mesh move.
#[derive(Clone, Debug)]
pub struct MeshMotion {
    /// Vertex positions at every key frame, the first included.
    pub keys: Vec<Vec<[f32; 3]>>,
    /// Hierarchy over the triangles.
    pub hierarchy: MovingHierarchy,
    /// For each state, whether a vertex moves in it.
    pub moves: Vec<bool>,
}

impl Mesh {
    /// Puts `triangles` in hierarchy order. Returns the mesh and the order: triangle `i` of the
    /// mesh is `triangles[order[i]]`. Every index must be below `positions.len()`, every
    /// position finite.
    #[must_use]
    pub fn new(positions: Vec<[f32; 3]>, triangles: &[[u32; 3]]) -> (Self, Vec<u32>) {
        let boxes: Vec<Bounds32> = triangles
            .iter()
            .map(|t| Bounds32::of_points(t.map(|v| positions[v as usize])))
            .collect();
        let (hierarchy, order) = Hierarchy::build(&boxes, TRIANGLES_A_LEAF);
        let bounds = boxes.iter().fold(Bounds::EMPTY, |b, x| b.union(x.widen()));
        let triangles = order.iter().map(|&t| triangles[t as usize]).collect();
        let positions = positions.into();
        (Self { positions, triangles, hierarchy, bounds, motion: None }, order)
    }

    /// A mesh whose vertices move: `keys` has their positions at every key frame. As [`Mesh::new`]
    /// where all are equal.
    ///
    /// # Panics
    /// Without a key frame, or with different numbers of vertices.
    #[must_use]
    pub fn moving(mut keys: Vec<Vec<[f32; 3]>>, triangles: &[[u32; 3]]) -> (Self, Vec<u32>) {
        assert!(keys.iter().all(|k| k.len() == keys[0].len()), "every vertex has a place a key");
        let moves: Vec<bool> = keys.windows(2).map(|pair| pair[0] != pair[1]).collect();
        if !moves.contains(&true) {
            return Self::new(keys.swap_remove(0), triangles);
        }
        let box_of =
            |t: usize, key: usize| Bounds32::of_points(triangles[t].map(|v| keys[key][v as usize]));
        let (hierarchy, order) =
            MovingHierarchy::build(triangles.len(), keys.len(), TRIANGLES_A_LEAF, box_of);
        let bounds = if triangles.is_empty() {
            Bounds::EMPTY
        } else {
            hierarchy.swept(0, 0..keys.len() as u32 - 1).widen()
        };
        let triangles = order.iter().map(|&t| triangles[t as usize]).collect();
        let positions = keys[0].clone().into();
        let motion = Some(MeshMotion { keys, hierarchy, moves });
        (Self { positions, triangles, hierarchy: Hierarchy::default(), bounds, motion }, order)
    }

    /// Vertex positions at the two key frames around a state; the same ones twice where no vertex
    /// moves in it.
    #[inline(always)]
    #[must_use]
    pub fn around(&self, state: u32) -> (&[[f32; 3]], &[[f32; 3]]) {
        match &self.motion {
            None => (&self.positions, &self.positions),
            Some(motion) => {
                let (from, to) = around(&motion.keys, state);
                (from, to)
            }
        }
    }

    /// True when a vertex moves in a state.
    #[inline(always)]
    #[must_use]
    pub fn moves_in(&self, state: u32) -> bool {
        self.motion.as_ref().is_some_and(|m| m.moves.get(state as usize).is_some_and(|&m| m))
    }

    /// Box at a key frame, mesh space.
    #[must_use]
    pub fn bounds_at(&self, key: u32) -> Bounds {
        match &self.motion {
            Some(motion) if !self.triangles.is_empty() => motion.hierarchy.at(0, key).widen(),
            _ => self.bounds,
        }
    }

    /// Mesh-space corners of triangle `t`.
    #[inline]
    #[must_use]
    pub fn corners(&self, t: usize) -> [DVec3; 3] {
        self.stored_corners(t).map(|p| DVec3::from_array(p.map(f64::from)))
    }

    /// Mesh-space corners of triangle `t` as stored.
    #[inline(always)]
    #[must_use]
    pub fn stored_corners(&self, t: usize) -> [[f32; 3]; 3] {
        let [a, b, c] = self.triangles[t];
        [self.positions[a as usize], self.positions[b as usize], self.positions[c as usize]]
    }
}

/// One placement of a mesh.
#[derive(Clone, Debug)]
pub struct Instance {
    /// The mesh that is placed.
    pub mesh: MeshId,
    /// The author's object that it belongs to.
    pub object: ObjectId,
    /// World space from mesh space.
    pub world_from_mesh: DAffine3,
    /// Global number of the mesh's triangle 0.
    pub first_primitive: PrimitiveId,
    /// False for see-through instances: they can be visible but hide nothing.
    pub occluder: bool,
    /// `world_from_mesh` at every key frame, where it changes.
    pub motion: Option<Box<[DAffine3]>>,
}

impl Instance {
    /// World space from mesh space at the two key frames around a state.
    #[inline(always)]
    #[must_use]
    pub fn around(&self, state: u32) -> (&DAffine3, &DAffine3) {
        match &self.motion {
            None => (&self.world_from_mesh, &self.world_from_mesh),
            Some(keys) => around(keys, state),
        }
    }

    /// World-space corners of a triangle of its mesh at the two key frames around a state.
    #[inline]
    #[must_use]
    pub fn corners_around(&self, mesh: &Mesh, triangle: usize, state: u32) -> [[DVec3; 3]; 2] {
        let (maps, keys) = (self.around(state), mesh.around(state));
        let place = |map: &DAffine3, positions: &[[f32; 3]]| {
            mesh.triangles[triangle].map(|v| {
                let p = positions[v as usize].map(f64::from);
                map.transform_point3(DVec3::from_array(p))
            })
        };
        [place(maps.0, keys.0), place(maps.1, keys.1)]
    }

    /// World space from mesh space at a moment.
    #[inline]
    #[must_use]
    pub fn world_from_mesh_at(&self, moment: Moment) -> DAffine3 {
        match &self.motion {
            None => self.world_from_mesh,
            Some(keys) => {
                let (from, to) = around(keys, moment.state);
                lerp_transform(from, to, moment.t)
            }
        }
    }
}

/// What rays need of an instance: the way back into mesh space.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Placement {
    /// Mesh space from world space: the inverse of the instance's transform.
    pub(crate) mesh_from_world: DAffine3,
}

impl Placement {
    fn of(instance: &Instance) -> Self {
        Self { mesh_from_world: instance.world_from_mesh.inverse() }
    }
}

/// `|M| |p|` of the mesh's vertex that is farthest from its origin on every axis, at any key frame.
fn placement_reach(mesh: &Mesh, instance: &Instance) -> f64 {
    if mesh.bounds.is_empty() {
        return 0.0;
    }
    let far = mesh.bounds.min.abs().max(mesh.bounds.max.abs());
    let reach = |map: &DAffine3| {
        let m = map.matrix3;
        (m.x_axis.abs() * far.x + m.y_axis.abs() * far.y + m.z_axis.abs() * far.z).length()
    };
    let keys =
        instance.motion.as_deref().unwrap_or(std::slice::from_ref(&instance.world_from_mesh));
    keys.iter().map(reach).fold(0.0, f64::max)
}

/// World box of an instance at a key frame.
fn box_at(mesh: &Mesh, instance: &Instance, key: u32) -> Bounds {
    mesh.bounds_at(key).transformed(instance.around(key).0)
}

/// Most instances whose placements are kept, which bounds the table to 96 MiB; a meadow of
/// millions of instances inverts a transform where a ray meets its box.
const PLACEMENTS_MAX: usize = 1 << 20;

/// A hierarchy over instances, its boxes relative to the origin of the geometry.
#[derive(Clone, Debug, Default)]
pub struct TopLevel {
    /// Hierarchy over `instances`.
    pub hierarchy: Hierarchy,
    /// Instances in hierarchy order.
    pub instances: Vec<InstanceId>,
}

/// A hierarchy over instances that move, its boxes relative to the origin of the geometry.
#[derive(Clone, Debug, Default)]
pub struct MovingLevel {
    /// Hierarchy over `instances`.
    pub hierarchy: MovingHierarchy,
    /// Instances in hierarchy order.
    pub instances: Vec<InstanceId>,
}

/// All primitives of a scene.
#[derive(Clone, Debug)]
pub struct InstancedGeometry {
    /// World position that the boxes of the top-level hierarchies are relative to, so that
    /// `f32` is exact enough 10^7 m from the world's origin.
    pub origin: DVec3,
    /// Unique meshes.
    pub meshes: Vec<Mesh>,
    /// Instances in ascending order of `first_primitive`.
    pub instances: Vec<Instance>,
    /// Instances that rest, and hide what is behind them.
    pub occluders: TopLevel,
    /// Instances that rest, and hide nothing.
    pub see_through: TopLevel,
    /// Instances that move, and hide what is behind them.
    pub moving_occluders: MovingLevel,
    /// Instances that move, and hide nothing.
    pub moving_see_through: MovingLevel,
    /// Particles.
    pub particles: Vec<ParticleSystem>,
    /// Number of states, at least 1.
    pub states: u32,
    /// World box of everything at all key frames.
    pub bounds: Bounds,
    /// Largest `|M| |p|` over all instances and the vertices p of their meshes, M the linear part of
    /// the transform, absolute values entry by entry, and over the particles; metres. A vertex is placed by products of
    /// that size, so it can be off by that many roundings even if the sum is close to the viewer:
    /// that is so for meshes that stand far from their own origin.
    pub placement_reach: f64,
    /// Who keeps it within its memory, where parts of it are mapped.
    pub residency: Option<Arc<dyn Residency>>,
    /// One placement an instance, or none at all above [`PLACEMENTS_MAX`] instances.
    placements: Vec<Placement>,
}

impl InstancedGeometry {
    /// Geometry at rest. The instances must follow the numbering of the module.
    ///
    /// # Panics
    /// When the numbering has a gap, or exceeds 2^32 - 1 primitives.
    #[must_use]
    pub fn new(meshes: Vec<Mesh>, instances: Vec<Instance>) -> Self {
        Self::with_motion(meshes, instances, Vec::new(), 1)
    }

    /// Builds the top-level hierarchies of a scene of `states` states. The instances and then the
    /// particle systems must follow the numbering of the module.
    ///
    /// # Panics
    /// When the numbering has a gap, or exceeds 2^32 - 1 primitives; when something has neither one
    /// key frame nor one more than there are states.
    #[must_use]
    pub fn with_motion(
        meshes: Vec<Mesh>,
        instances: Vec<Instance>,
        particles: Vec<ParticleSystem>,
        states: u32,
    ) -> Self {
        let mut next = 0u64;
        let keys = states as usize + 1;
        assert!(states > 0, "a scene at rest has one state");
        for instance in &instances {
            let mesh = &meshes[instance.mesh.index()];
            assert_eq!(u64::from(instance.first_primitive.0), next, "numbering without gaps");
            assert!(instance.motion.as_ref().is_none_or(|m| m.len() == keys), "key frames");
            assert!(mesh.motion.as_ref().is_none_or(|m| m.keys.len() == keys), "key frames");
            next += mesh.triangles.len() as u64;
        }
        for system in &particles {
            assert_eq!(u64::from(system.first_primitive.0), next, "numbering without gaps");
            assert!([1, keys].contains(&system.keys.len()), "key frames");
            next += system.len() as u64;
        }
        assert!(u32::try_from(next).is_ok(), "at most 2^32 - 1 primitives");
        let moves = |i: &Instance| i.motion.is_some() || meshes[i.mesh.index()].motion.is_some();
        let boxes: Vec<Bounds> = instances
            .iter()
            .map(|i| {
                let last = if moves(i) { states } else { 0 };
                (0..=last)
                    .map(|key| box_at(&meshes[i.mesh.index()], i, key))
                    .fold(Bounds::EMPTY, Bounds::union)
            })
            .collect();
        let bounds = boxes
            .iter()
            .chain(particles.iter().map(|p| &p.bounds))
            .fold(Bounds::EMPTY, |b, x| b.union(*x));
        let placement_reach = instances
            .iter()
            .map(|i| placement_reach(&meshes[i.mesh.index()], i))
            .chain(particles.iter().filter(|p| !p.bounds.is_empty()).map(|p| {
                let (min, max) = (p.bounds.min - p.origin, p.bounds.max - p.origin);
                min.abs().max(max.abs()).length()
            }))
            .fold(0.0, f64::max);
        let origin = if bounds.is_empty() { DVec3::ZERO } else { bounds.center().round() };
        let relative =
            |b: Bounds| Bounds32::containing(Bounds { min: b.min - origin, max: b.max - origin });
        let chosen = |occluder: bool, moving: bool| -> Vec<usize> {
            (0..instances.len())
                .filter(|&i| instances[i].occluder == occluder && !boxes[i].is_empty())
                .filter(|&i| moves(&instances[i]) == moving)
                .collect()
        };
        let ids = |chosen: &[usize], order: &[u32]| {
            order.iter().map(|&o| InstanceId(chosen[o as usize] as u32)).collect()
        };
        let top_level = |occluder: bool| {
            let chosen = chosen(occluder, false);
            let boxes: Vec<Bounds32> = chosen.iter().map(|&i| relative(boxes[i])).collect();
            let (hierarchy, order) = Hierarchy::build(&boxes, INSTANCES_A_LEAF);
            TopLevel { hierarchy, instances: ids(&chosen, &order) }
        };
        let moving_level = |occluder: bool| {
            let chosen = chosen(occluder, true);
            let box_of = |i: usize, key: usize| {
                let instance = &instances[chosen[i]];
                relative(box_at(&meshes[instance.mesh.index()], instance, key as u32))
            };
            let (hierarchy, order) =
                MovingHierarchy::build(chosen.len(), keys, INSTANCES_A_LEAF, box_of);
            MovingLevel { hierarchy, instances: ids(&chosen, &order) }
        };
        let (occluders, see_through) = (top_level(true), top_level(false));
        let (moving_occluders, moving_see_through) = (moving_level(true), moving_level(false));
        let kept = if instances.len() <= PLACEMENTS_MAX { instances.as_slice() } else { &[] };
        let placements = kept.iter().map(Placement::of).collect();
        Self {
            origin,
            meshes,
            instances,
            occluders,
            see_through,
            moving_occluders,
            moving_see_through,
            particles,
            states,
            bounds,
            placement_reach,
            residency: None,
            placements,
        }
    }

    /// A scene of some of its instances alone, numbered anew, at rest; they must be at rest.
    #[must_use]
    pub fn of_instances(&self, chosen: impl IntoIterator<Item = InstanceId>) -> Self {
        let mut new_ids: BTreeMap<MeshId, MeshId> = BTreeMap::new();
        let (mut meshes, mut instances, mut next) = (Vec::new(), Vec::new(), 0);
        for id in chosen {
            let instance = &self.instances[id.index()];
            let mesh = *new_ids.entry(instance.mesh).or_insert_with(|| {
                meshes.push(self.meshes[instance.mesh.index()].clone());
                MeshId(meshes.len() as u32 - 1)
            });
            let first_primitive = PrimitiveId(next);
            next += meshes[mesh.index()].triangles.len() as u32;
            instances.push(Instance { mesh, first_primitive, motion: None, ..instance.clone() });
        }
        Self { residency: self.residency.clone(), ..Self::new(meshes, instances) }
    }

    /// To be called by who walks it, after at most [`STEPS`](crate::STEPS) steps.
    #[inline(always)]
    pub fn look(&self) {
        if let Some(residency) = &self.residency {
            residency.look();
        }
    }

    /// True when something moves, or may be there in one state and not in another.
    #[must_use]
    pub fn has_motion(&self) -> bool {
        !self.moving_occluders.instances.is_empty()
            || !self.moving_see_through.instances.is_empty()
            || self.particles.iter().any(|p| p.keys.len() > 1)
    }

    /// The way from world space into the space of an instance's mesh.
    #[inline]
    pub(crate) fn placement(&self, instance: InstanceId) -> Placement {
        let kept = self.placements.get(instance.index());
        kept.copied().unwrap_or_else(|| Placement::of(&self.instances[instance.index()]))
    }

    /// Number of primitives: one more than the largest global number.
    #[must_use]
    pub fn primitive_count(&self) -> u32 {
        self.particles
            .last()
            .map_or_else(|| self.triangle_count(), |p| p.first_primitive.0 + p.len() as u32)
    }

    /// Number of triangles; global numbers from here on are of particles.
    #[must_use]
    pub fn triangle_count(&self) -> u32 {
        self.instances
            .last()
            .map_or(0, |i| i.first_primitive.0 + self.meshes[i.mesh.index()].triangles.len() as u32)
    }

    /// Number of triangles in memory.
    #[must_use]
    pub fn unique_triangle_count(&self) -> usize {
        self.meshes.iter().map(|m| m.triangles.len()).sum()
    }

    /// Global numbers of the primitives of an instance.
    #[must_use]
    pub fn primitives_of(&self, instance: InstanceId) -> Range<u32> {
        let i = &self.instances[instance.index()];
        let first = i.first_primitive.0;
        first..first + self.meshes[i.mesh.index()].triangles.len() as u32
    }

    /// Which part of the geometry a primitive is.
    ///
    /// # Panics
    /// When there is no such primitive.
    #[must_use]
    pub fn place(&self, primitive: PrimitiveId) -> Place {
        assert!(primitive.0 < self.primitive_count(), "no primitive {primitive}");
        if primitive.0 < self.triangle_count() {
            let (instance, triangle) = self.locate(primitive);
            return Place::Triangle(instance, triangle);
        }
        // Systems without particles share their number with their successor: take the last.
        let system = self.particles.partition_point(|p| p.first_primitive <= primitive) - 1;
        let first = self.particles[system].first_primitive.0;
        Place::Particle(system, (primitive.0 - first) as usize)
    }

    /// The instance that holds a triangle, and the triangle's number in its mesh.
    ///
    /// # Panics
    /// When there is no such triangle.
    #[must_use]
    pub fn locate(&self, primitive: PrimitiveId) -> (InstanceId, usize) {
        assert!(primitive.0 < self.triangle_count(), "no triangle {primitive}");
        // Meshes without triangles share their number with their successor: take the last.
        let after = self.instances.partition_point(|i| i.first_primitive <= primitive);
        let first = self.instances[after - 1].first_primitive.0;
        (InstanceId(after as u32 - 1), (primitive.0 - first) as usize)
    }

    /// World-space corners of a triangle at the first key frame.
    ///
    /// # Panics
    /// When there is no such triangle.
    #[must_use]
    pub fn triangle(&self, primitive: PrimitiveId) -> Triangle {
        self.triangle_at(primitive, Moment::START)
    }

    /// World-space corners of a triangle at a moment.
    ///
    /// # Panics
    /// When there is no such triangle.
    #[must_use]
    pub fn triangle_at(&self, primitive: PrimitiveId, moment: Moment) -> Triangle {
        let (id, local) = self.locate(primitive);
        let instance = &self.instances[id.index()];
        let mesh = &self.meshes[instance.mesh.index()];
        let [from, to] = instance.corners_around(mesh, local, moment.state);
        Triangle { corners: [0, 1, 2].map(|k| lerp(from[k], to[k], moment.t)) }
    }

    /// What a primitive is and where, at a moment.
    ///
    /// # Panics
    /// When there is no such primitive.
    #[must_use]
    pub fn shape(&self, primitive: PrimitiveId, moment: Moment) -> Shape {
        match self.place(primitive) {
            Place::Triangle(..) => Shape::Triangle(self.triangle_at(primitive, moment)),
            Place::Particle(system, particle) => {
                let system = &self.particles[system];
                match system.around(particle, moment.state) {
                    None => Shape::Absent,
                    Some((from, to)) => Shape::Sphere {
                        center: system.origin + lerp(from.center(), to.center(), moment.t),
                        radius: (1.0 - moment.t) * f64::from(from.radius)
                            + moment.t * f64::from(to.radius),
                    },
                }
            }
        }
    }
}
