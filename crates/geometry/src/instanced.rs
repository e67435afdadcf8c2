//! Triangles as the solver and the ray caster see them: meshes, instances of meshes, and
//! hierarchies over both. Memory follows unique triangles.
//!
//! Numbering: the primitives of an instance are `first_primitive ..
//! first_primitive + triangles of its mesh`, instances are numbered in ascending order of
//! `first_primitive` and leave no gaps, and the triangles of a mesh are in the order of the
//! mesh's hierarchy, so visible sets are runs of numbers.
//!
//! Occluders and see-through instances (alpha-masked, blended, or marked by the author) are in
//! two top-level hierarchies: the first hide what is behind them, the second never do.

use std::ops::Range;

use glam::{DAffine3, DVec3};

use crate::{
    Bounds, Bounds32, Hierarchy, InstanceId, MeshId, ObjectId, PrimitiveId,
    hierarchy::{INSTANCES_A_LEAF, TRIANGLES_A_LEAF},
};

/// Corners of a triangle in world space, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triangle {
    /// The three corners, in the winding order of the file.
    pub corners: [DVec3; 3],
}

/// One body of triangles in its own space, with its hierarchy.
#[derive(Clone, Debug)]
pub struct Mesh {
    /// Vertex positions, mesh space, metres.
    pub positions: Vec<[f32; 3]>,
    /// Vertex indices a triangle, in hierarchy order.
    pub triangles: Vec<[u32; 3]>,
    /// Hierarchy over the triangles.
    pub hierarchy: Hierarchy,
    /// Box of the triangles, mesh space.
    pub bounds: Bounds,
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
        (Self { positions, triangles, hierarchy, bounds }, order)
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

/// `|M| |p|` of the mesh's vertex that is farthest from its origin on every axis.
fn placement_reach(mesh: &Mesh, instance: &Instance) -> f64 {
    if mesh.bounds.is_empty() {
        return 0.0;
    }
    let far = mesh.bounds.min.abs().max(mesh.bounds.max.abs());
    let m = instance.world_from_mesh.matrix3;
    (m.x_axis.abs() * far.x + m.y_axis.abs() * far.y + m.z_axis.abs() * far.z).length()
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

/// All triangles of a scene.
#[derive(Clone, Debug)]
pub struct InstancedGeometry {
    /// World position that the boxes of the top-level hierarchies are relative to, so that
    /// `f32` is exact enough 10^7 m from the world's origin.
    pub origin: DVec3,
    /// Unique meshes.
    pub meshes: Vec<Mesh>,
    /// Instances in ascending order of `first_primitive`.
    pub instances: Vec<Instance>,
    /// Instances that hide what is behind them.
    pub occluders: TopLevel,
    /// Instances that hide nothing.
    pub see_through: TopLevel,
    /// World box of everything.
    pub bounds: Bounds,
    /// Largest `|M| |p|` over all instances and the vertices p of their meshes, M the linear part of
    /// the transform, absolute values entry by entry; metres. A vertex is placed by products of
    /// that size, so it can be off by that many roundings even if the sum is close to the viewer:
    /// that is so for meshes that stand far from their own origin.
    pub placement_reach: f64,
    /// One placement an instance, or none at all above [`PLACEMENTS_MAX`] instances.
    placements: Vec<Placement>,
}

impl InstancedGeometry {
    /// Builds the top-level hierarchies. The instances must follow the numbering of the module.
    ///
    /// # Panics
    /// When the numbering has a gap, or exceeds 2^32 - 1 primitives.
    #[must_use]
    pub fn new(meshes: Vec<Mesh>, instances: Vec<Instance>) -> Self {
        let mut next = 0u64;
        for instance in &instances {
            assert_eq!(u64::from(instance.first_primitive.0), next, "numbering without gaps");
            next += meshes[instance.mesh.index()].triangles.len() as u64;
        }
        assert!(u32::try_from(next).is_ok(), "at most 2^32 - 1 primitives");
        let boxes: Vec<Bounds> = instances
            .iter()
            .map(|i| meshes[i.mesh.index()].bounds.transformed(&i.world_from_mesh))
            .collect();
        let bounds = boxes.iter().fold(Bounds::EMPTY, |b, x| b.union(*x));
        let placement_reach = instances
            .iter()
            .map(|i| placement_reach(&meshes[i.mesh.index()], i))
            .fold(0.0, f64::max);
        let origin = if bounds.is_empty() { DVec3::ZERO } else { bounds.center().round() };
        let top_level = |occluder: bool| {
            let chosen: Vec<usize> = (0..instances.len())
                .filter(|&i| instances[i].occluder == occluder && !boxes[i].is_empty())
                .collect();
            let relative: Vec<Bounds32> = chosen
                .iter()
                .map(|&i| {
                    let b = boxes[i];
                    Bounds32::containing(Bounds { min: b.min - origin, max: b.max - origin })
                })
                .collect();
            let (hierarchy, order) = Hierarchy::build(&relative, INSTANCES_A_LEAF);
            let instances = order.iter().map(|&o| InstanceId(chosen[o as usize] as u32)).collect();
            TopLevel { hierarchy, instances }
        };
        let (occluders, see_through) = (top_level(true), top_level(false));
        let kept = if instances.len() <= PLACEMENTS_MAX { instances.as_slice() } else { &[] };
        let placements = kept.iter().map(Placement::of).collect();
        Self {
            origin,
            meshes,
            instances,
            occluders,
            see_through,
            bounds,
            placement_reach,
            placements,
        }
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

    /// The instance that holds a primitive, and the triangle's number in its mesh.
    ///
    /// # Panics
    /// When there is no such primitive.
    #[must_use]
    pub fn locate(&self, primitive: PrimitiveId) -> (InstanceId, usize) {
        assert!(primitive.0 < self.primitive_count(), "no primitive {primitive}");
        // Meshes without triangles share their number with their successor: take the last.
        let after = self.instances.partition_point(|i| i.first_primitive <= primitive);
        let first = self.instances[after - 1].first_primitive.0;
        (InstanceId(after as u32 - 1), (primitive.0 - first) as usize)
    }

    /// World-space corners of a primitive.
    #[must_use]
    pub fn triangle(&self, primitive: PrimitiveId) -> Triangle {
        let (instance, local) = self.locate(primitive);
        let instance = &self.instances[instance.index()];
        let corners = self.meshes[instance.mesh.index()].corners(local);
        Triangle { corners: corners.map(|p| instance.world_from_mesh.transform_point3(p)) }
    }
}
