//! Closest hits of rays: the independent opinion on what can be seen.
//!
//! A plain walk over the hierarchies in `f64`. It shares no code with the interval solver, so
//! that one can be checked by the other. Triangles are hit from both sides; a ray through a
//! shared edge hits at least one of its triangles (half-open edge signs are not needed for that:
//! zero counts as inside).
//!
//! Source of the triangle test: Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection"
//! (JCGT 2013): shear the triangle so that the ray is the z axis, then take the signs of the
//! three edge functions.

use glam::DVec3;

use crate::{
    Hierarchy, InstanceId, InstancedGeometry, Node, PrimitiveId, TopLevel, UNIT_ROUNDOFF,
    instanced::Placement,
};

/// A half-line `origin + distance * direction`, world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Start, metres.
    pub origin: DVec3,
    /// Direction; distances are in units of its length.
    pub direction: DVec3,
}

/// Where a ray meets a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the ray, in units of the direction's length, > 0.
    pub distance: f64,
    /// The triangle.
    pub primitive: PrimitiveId,
    /// Its instance.
    pub instance: InstanceId,
    /// True when the glTF front is met: the side from which the corners go counter-clockwise in
    /// mesh space. Mirrored instances keep their front, as glTF has it.
    pub front: bool,
}

/// A ray prepared for triangle tests: the dominant axis and the shear of the Woop test.
struct Sheared {
    origin: [f64; 3],
    axes: [usize; 3],
    shear: DVec3,
    inverse: [f64; 3],
    /// True on axes where the direction points down: boxes are entered by their upper side.
    downward: [bool; 3],
}

impl Sheared {
    fn new(ray: Ray) -> Self {
        let d = ray.direction;
        let kz = if d.x.abs() >= d.y.abs() && d.x.abs() >= d.z.abs() {
            0
        } else if d.y.abs() >= d.z.abs() {
            1
        } else {
            2
        };
        let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
        if d[kz] < 0.0 {
            std::mem::swap(&mut kx, &mut ky);
        }
        let shear = DVec3::new(d[kx] / d[kz], d[ky] / d[kz], 1.0 / d[kz]);
        let inverse = d.recip().to_array();
        let downward = inverse.map(|i| i < 0.0);
        Self { origin: ray.origin.to_array(), axes: [kx, ky, kz], shear, inverse, downward }
    }

    /// A corner in the ray's sheared space, relative to its origin.
    #[inline(always)]
    fn sheared(&self, corner: [f32; 3]) -> (f64, f64, f64) {
        let [kx, ky, kz] = self.axes;
        let z = f64::from(corner[kz]) - self.origin[kz];
        let x = (f64::from(corner[kx]) - self.origin[kx]) - self.shear.x * z;
        let y = (f64::from(corner[ky]) - self.origin[ky]) - self.shear.y * z;
        (x, y, z)
    }

    /// Distance to the triangle and the sign of its determinant (> 0: front), if hit.
    #[inline(always)]
    fn triangle(&self, corners: [[f32; 3]; 3]) -> Option<(f64, bool)> {
        let [a, b, c] = corners;
        let p = [self.sheared(a), self.sheared(b), self.sheared(c)];
        let u = p[2].0 * p[1].1 - p[2].1 * p[1].0;
        let v = p[0].0 * p[2].1 - p[0].1 * p[2].0;
        let w = p[1].0 * p[0].1 - p[1].1 * p[0].0;
        if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
            return None;
        }
        let det = u + v + w;
        if det == 0.0 {
            return None;
        }
        let t = (u * p[0].2 + v * p[1].2 + w * p[2].2) * self.shear.z / det;
        (t > 0.0).then_some((t, det > 0.0))
    }

    /// Entry distance into a node's box, if the box is met within `limit`.
    #[inline(always)]
    fn node(&self, node: &Node, limit: f64) -> Option<f64> {
        // Two roundings of (b - o) * inverse, doubled: the far side is moved out by it, after
        // Ize, "Robust BVH Ray Traversal" (JCGT 2013).
        const SLACK: f64 = 1.0 + 8.0 * UNIT_ROUNDOFF;
        let (mut near, mut far) = (0.0_f64, limit);
        let (min, max) = (&node.bounds.min, &node.bounds.max);
        for k in 0..3 {
            let (enter, leave) = if self.downward[k] { (max[k], min[k]) } else { (min[k], max[k]) };
            let enter = (f64::from(enter) - self.origin[k]) * self.inverse[k];
            let leave = (f64::from(leave) - self.origin[k]) * self.inverse[k] * SLACK;
            // The NaN of 0 * inf compares false and is dropped: the ray lies in the slab's border.
            near = if enter > near { enter } else { near };
            far = if leave < far { leave } else { far };
        }
        (near <= far).then_some(near)
    }
}

/// Walks a hierarchy front to back; `leaf(items, limit)` returns the new limit.
fn walk(
    hierarchy: &Hierarchy,
    ray: &Sheared,
    limit: f64,
    stack: &mut Vec<(f64, u32)>,
    mut leaf: impl FnMut(std::ops::Range<usize>, f64) -> f64,
) -> f64 {
    let nodes = &hierarchy.nodes;
    let mut limit = limit;
    let base = stack.len();
    if let Some(near) = nodes.first().and_then(|n| ray.node(n, limit)) {
        stack.push((near, 0));
    }
    while stack.len() > base {
        let Some((near, index)) = stack.pop() else { break };
        if near > limit {
            continue;
        }
        let node = &nodes[index as usize];
        let first = node.first as usize;
        if node.is_leaf() {
            limit = leaf(first..first + node.count as usize, limit);
            continue;
        }
        let left = ray.node(&nodes[first], limit).map(|n| (n, first as u32));
        let right = ray.node(&nodes[first + 1], limit).map(|n| (n, first as u32 + 1));
        match (left, right) {
            (Some(l), Some(r)) if l.0 <= r.0 => stack.extend([r, l]),
            (Some(l), Some(r)) => stack.extend([l, r]),
            (Some(one), None) | (None, Some(one)) => stack.push(one),
            (None, None) => {}
        }
    }
    limit
}

/// Scratch memory of a caster; keep one a thread.
#[derive(Default)]
pub struct RayCaster {
    top: Vec<(f64, u32)>,
    bottom: Vec<(f64, u32)>,
}

impl RayCaster {
    /// A new caster.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Visits every hit of the top level nearer than the limit; `visit(hit)` returns the limit
    /// from then on. `accept` decides which primitives exist.
    fn visit(
        &mut self,
        geometry: &InstancedGeometry,
        top_level: &TopLevel,
        ray: Ray,
        limit: f64,
        accept: &mut impl FnMut(PrimitiveId) -> bool,
        visit: &mut impl FnMut(Hit, f64) -> f64,
    ) {
        let relative = Sheared::new(Ray { origin: ray.origin - geometry.origin, ..ray });
        let Self { top, bottom } = self;
        walk(&top_level.hierarchy, &relative, limit, top, |items, mut limit| {
            for &id in &top_level.instances[items] {
                let instance = &geometry.instances[id.index()];
                let mesh = &geometry.meshes[instance.mesh.index()];
                // The affine inverse keeps distances: they are in units of the direction.
                let Placement { mesh_from_world } = geometry.placement(id);
                let local = Sheared::new(Ray {
                    origin: mesh_from_world.transform_point3(ray.origin),
                    direction: mesh_from_world.transform_vector3(ray.direction),
                });
                limit = walk(&mesh.hierarchy, &local, limit, bottom, |items, mut limit| {
                    for t in items {
                        let Some((distance, front)) = local.triangle(mesh.stored_corners(t)) else {
                            continue;
                        };
                        let primitive = PrimitiveId(instance.first_primitive.0 + t as u32);
                        if distance <= limit && accept(primitive) {
                            let hit = Hit { distance, primitive, instance: id, front };
                            limit = visit(hit, limit);
                        }
                    }
                    limit
                });
            }
            limit
        });
    }

    /// The nearest occluder within `limit` among the accepted primitives; of equally near
    /// ones the lowest number.
    pub fn closest_occluder(
        &mut self,
        geometry: &InstancedGeometry,
        ray: Ray,
        limit: f64,
        mut accept: impl FnMut(PrimitiveId) -> bool,
    ) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        self.visit(geometry, &geometry.occluders, ray, limit, &mut accept, &mut |hit, limit| {
            let better =
                best.is_none_or(|b| (hit.distance, hit.primitive) < (b.distance, b.primitive));
            if better {
                best = Some(hit);
            }
            limit.min(hit.distance)
        });
        best
    }

    /// Calls `found` with every see-through primitive nearer than `limit`, in no fixed order.
    pub fn see_through(
        &mut self,
        geometry: &InstancedGeometry,
        ray: Ray,
        limit: f64,
        mut found: impl FnMut(Hit),
    ) {
        self.visit(
            geometry,
            &geometry.see_through,
            ray,
            limit,
            &mut |_| true,
            &mut |hit, limit| {
                if hit.distance < limit {
                    found(hit);
                }
                limit
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Instance, Mesh, MeshId, ObjectId};
    use glam::DAffine3;

    fn square(at: f32, first: u32, occluder: bool) -> (Mesh, Instance) {
        let p = vec![[-1.0, -1.0, at], [1.0, -1.0, at], [1.0, 1.0, at], [-1.0, 1.0, at]];
        let (mesh, _) = Mesh::new(p, &[[0, 1, 2], [0, 2, 3]]);
        let instance = Instance {
            mesh: MeshId(first / 2),
            object: ObjectId(0),
            world_from_mesh: DAffine3::from_translation(DVec3::new(1e7, 0.0, 0.0)),
            first_primitive: PrimitiveId(first),
            occluder,
        };
        (mesh, instance)
    }

    fn scene() -> InstancedGeometry {
        let parts = [square(-1.0, 0, false), square(-2.0, 2, true), square(-3.0, 4, true)];
        let (meshes, instances) = parts.into_iter().unzip();
        InstancedGeometry::new(meshes, instances)
    }

    #[test]
    fn nearest_occluder_wins_far_from_the_origin() {
        let scene = scene();
        let ray = Ray { origin: DVec3::new(1e7 + 0.25, 0.5, 0.0), direction: -DVec3::Z };
        let mut caster = RayCaster::new();
        let hit = caster.closest_occluder(&scene, ray, f64::INFINITY, |_| true).unwrap();
        assert_eq!((hit.distance, hit.primitive.0 / 2, hit.front), (2.0, 1, true));
        let behind =
            caster.closest_occluder(&scene, ray, f64::INFINITY, |p| p != hit.primitive).unwrap();
        assert_eq!((behind.distance, behind.primitive.0 / 2), (3.0, 2));
        let mut seen = vec![];
        caster.see_through(&scene, ray, hit.distance, |h| seen.push(h.primitive.0 / 2));
        assert_eq!(seen, [0]);
    }

    #[test]
    fn rays_through_a_shared_edge_do_not_slip_through() {
        let scene = scene();
        let mut caster = RayCaster::new();
        for i in -999..1000 {
            let s = f64::from(i) / 1000.0;
            let ray = Ray { origin: DVec3::new(1e7 + s, s, 0.0), direction: -DVec3::Z };
            assert!(caster.closest_occluder(&scene, ray, f64::INFINITY, |_| true).is_some());
        }
    }

    #[test]
    fn rays_in_the_border_of_a_box_meet_it() {
        let scene = scene();
        let mut caster = RayCaster::new();
        for (x, y) in [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (-1.0, -1.0), (1.0, 1.0)] {
            for direction in [DVec3::NEG_Z, DVec3::new(0.0, -0.0, -1.0)] {
                let ray = Ray { origin: DVec3::new(1e7 + x, y, 0.0), direction };
                let hit = caster.closest_occluder(&scene, ray, f64::INFINITY, |_| true);
                assert_eq!(hit.map(|h| h.distance), Some(2.0), "{x} {y}");
            }
        }
    }
}
