//! Closest hits of rays: the independent opinion on what can be seen.
//!
//! A walk over the wide hierarchies in `f64`, four boxes at a time, front to back. It is compiled
//! for AVX2 and for any processor, and gives the same bits on both. It shares no code with the
//! interval solver, so that one can be checked by the other. Triangles are hit from both sides; a ray through a
//! shared edge hits at least one of its triangles (half-open edge signs are not needed for that:
//! zero counts as inside).
//!
//! A ray is cast at a moment. What moves is met where it is then: see `moving`.
//!
//! Source of the triangle test: Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection"
//! (JCGT 2013): shear the triangle so that the ray is the z axis, then take the signs of the
//! three edge functions.

mod moving;

pub use moving::mesh_space;

use glam::{DMat3, DVec3};

use crate::{
    InstanceId, InstancedGeometry, Mesh, Moment, MovingLevel, PrimitiveId, STEPS, TopLevel,
    UNIT_ROUNDOFF,
    instanced::Placement,
    wide::{Child, WIDTH, WideHierarchy, WideNode},
};

/// A half-line `origin + distance * direction`, world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Start, metres.
    pub origin: DVec3,
    /// Direction; distances are in units of its length.
    pub direction: DVec3,
    /// When it is cast.
    pub moment: Moment,
}

impl Ray {
    /// A ray at the first key frame.
    #[must_use]
    pub const fn new(origin: DVec3, direction: DVec3) -> Self {
        Self { origin, direction, moment: Moment::START }
    }
}

/// Where a ray meets a primitive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the ray, in units of the direction's length, > 0.
    pub distance: f64,
    /// The primitive.
    pub primitive: PrimitiveId,
    /// Its instance; none for a particle.
    pub instance: Option<InstanceId>,
    /// True when the glTF front is met: the side from which the corners go counter-clockwise in
    /// mesh space. Mirrored instances keep their front, as glTF has it. Of a particle, the outside.
    pub front: bool,
}

/// A ray prepared for triangle tests: the dominant axis and the shear of the Woop test.
struct Sheared {
    origin: [f64; 3],
    axes: [usize; 3],
    shear: DVec3,
    inverse: [f64; 3],
    /// For each axis, which of a wide node's `bounds` are met first and last: where the direction
    /// points down, boxes are entered by their upper side.
    sides: [(usize, usize); 3],
}

impl Sheared {
    #[inline(always)]
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
        let inverse = [1.0 / d.x, 1.0 / d.y, 1.0 / d.z];
        let side = |k: usize| if inverse[k] < 0.0 { (k + 3, k) } else { (k, k + 3) };
        let sides = [side(0), side(1), side(2)];
        Self { origin: ray.origin.to_array(), axes: [kx, ky, kz], shear, inverse, sides }
    }

    /// The ray of the same direction from another origin.
    #[inline(always)]
    fn from(&self, origin: DVec3) -> Self {
        Self { origin: origin.to_array(), ..*self }
    }

    /// A corner in the ray's sheared space, relative to its origin.
    #[inline(always)]
    fn sheared(&self, corner: &[f32; 3]) -> (f64, f64, f64) {
        self.sheared_point(&[0, 1, 2].map(|k| f64::from(corner[k])))
    }

    /// A point in the ray's sheared space, relative to its origin.
    #[inline(always)]
    fn sheared_point(&self, corner: &[f64; 3]) -> (f64, f64, f64) {
        let [kx, ky, kz] = self.axes;
        let z = corner[kz] - self.origin[kz];
        let x = (corner[kx] - self.origin[kx]) - self.shear.x * z;
        let y = (corner[ky] - self.origin[ky]) - self.shear.y * z;
        (x, y, z)
    }

    /// Distance to triangle `t` and the sign of its determinant (> 0: front), if hit.
    #[inline(always)]
    fn triangle(&self, mesh: &Mesh, t: usize) -> Option<(f64, bool)> {
        let [a, b, c] = mesh.triangles[t];
        let corner = |v: u32| self.sheared(&mesh.positions[v as usize]);
        self.meets([corner(a), corner(b), corner(c)])
    }

    /// Distance to a triangle with these sheared corners and the sign of its determinant, if hit.
    #[inline(always)]
    fn meets(&self, p: [(f64, f64, f64); 3]) -> Option<(f64, bool)> {
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

    /// Distances at which the boxes of a node's children are entered and left within `limit`. A
    /// box is met where the first is not larger than the second.
    #[inline(always)]
    fn boxes(&self, node: &WideNode, limit: f64) -> ([f64; WIDTH], [f64; WIDTH]) {
        // Two roundings of (b - o) * inverse, doubled: the far side is moved out by it, after
        // Ize, "Robust BVH Ray Traversal" (JCGT 2013).
        const SLACK: f64 = 1.0 + 8.0 * UNIT_ROUNDOFF;
        let (mut near, mut far) = ([0.0_f64; WIDTH], [limit; WIDTH]);
        for k in 0..3 {
            let (enter, leave) = self.sides[k];
            let (enter, leave) = (&node.bounds[enter], &node.bounds[leave]);
            for c in 0..WIDTH {
                let enter = (f64::from(enter[c]) - self.origin[k]) * self.inverse[k];
                let leave = (f64::from(leave[c]) - self.origin[k]) * self.inverse[k] * SLACK;
                // The NaN of 0 * inf compares false and is dropped: the ray lies in the slab's
                // border.
                near[c] = if enter > near[c] { enter } else { near[c] };
                far[c] = if leave < far[c] { leave } else { far[c] };
            }
        }
        (near, far)
    }
}

/// A place of a hierarchy that is still to be visited, and the distance at which it is entered.
type Open = (f64, Child);

/// The bits of a child's place.
const PLACE: u64 = WIDTH as u64 - 1;

/// Walks a hierarchy front to back: the items of the next leaf that a ray meets within `limit`.
/// `stack` holds the [`root`] at first, and nothing at the end.
#[inline(always)]
fn next_leaf(
    hierarchy: &WideHierarchy,
    ray: &Sheared,
    limit: f64,
    stack: &mut Vec<Open>,
) -> Option<std::ops::Range<usize>> {
    while let Some((near, child)) = stack.pop() {
        if near > limit {
            continue;
        }
        let first = child.first as usize;
        if child.count > 0 {
            return Some(first..first + child.count as usize);
        }
        let node = &hierarchy.nodes[first];
        let (near, far) = ray.boxes(node, limit);
        // Entry distance and place in one number. Distances are not negative, so their bits are
        // in their order; two bits less make them smaller, which is on the safe side.
        let mut keys: [u64; WIDTH] = std::array::from_fn(|place| {
            let key = near[place].to_bits() & !PLACE | place as u64;
            if near[place] <= far[place] { key } else { u64::MAX }
        });
        for (a, b) in [(0, 1), (2, 3), (0, 2), (1, 3), (1, 2)] {
            (keys[a], keys[b]) = (keys[a].min(keys[b]), keys[a].max(keys[b]));
        }
        // Nearest on top.
        for key in keys.into_iter().rev() {
            if key != u64::MAX {
                stack.push((f64::from_bits(key & !PLACE), node.children[(key & PLACE) as usize]));
            }
        }
    }
    None
}

/// Where the walk of a hierarchy begins, if it has nodes.
#[inline(always)]
fn root(hierarchy: &WideHierarchy) -> Option<Open> {
    (!hierarchy.nodes.is_empty()).then_some((0.0, Child { first: 0, count: 0 }))
}

/// What a ray is cast at.
struct Cast<'a> {
    geometry: &'a InstancedGeometry,
    top_level: &'a TopLevel,
    /// What of the same kind moves.
    moving: &'a MovingLevel,
    /// Whether particles that hide something are meant, or those that do not.
    occluders: bool,
    ray: Ray,
    /// Largest distance of a hit, in units of the direction's length.
    limit: f64,
}

/// Scratch memory of a caster; keep one a thread.
#[derive(Default)]
pub struct RayCaster {
    /// Rays since the last look at the memory.
    rays: u64,
    top: Vec<Open>,
    bottom: Vec<Open>,
    moving: moving::Stacks,
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
        cast: &Cast,
        accept: &mut impl FnMut(PrimitiveId) -> bool,
        visit: &mut impl FnMut(Hit, f64) -> f64,
    ) {
        // A ray takes some tens of steps.
        self.rays += 1;
        if self.rays.is_multiple_of(STEPS / 32) {
            cast.geometry.look();
        }
        let limit = self.visit_moving(cast, accept, visit);
        let cast = &Cast { limit, ..*cast };
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("lzcnt")
        {
            // Sound: the processor has what the function was compiled for.
            #[allow(unsafe_code)]
            return unsafe { self.visit_with_avx2(cast, accept, visit) };
        }
        self.visit_anywhere(cast, accept, visit);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,bmi1,lzcnt")]
    fn visit_with_avx2(
        &mut self,
        cast: &Cast,
        accept: &mut impl FnMut(PrimitiveId) -> bool,
        visit: &mut impl FnMut(Hit, f64) -> f64,
    ) {
        self.visit_anywhere(cast, accept, visit);
    }

    #[inline(always)]
    fn visit_anywhere(
        &mut self,
        cast: &Cast,
        accept: &mut impl FnMut(PrimitiveId) -> bool,
        visit: &mut impl FnMut(Hit, f64) -> f64,
    ) {
        let Cast { geometry, top_level, ray, mut limit, .. } = *cast;
        let relative = Sheared::new(Ray { origin: ray.origin - geometry.origin, ..ray });
        let Self { top, bottom, .. } = self;
        top.clear();
        top.extend(root(&top_level.hierarchy.wide));
        while let Some(items) = next_leaf(&top_level.hierarchy.wide, &relative, limit, top) {
            for &id in &top_level.instances[items] {
                let instance = &geometry.instances[id.index()];
                let mesh = &geometry.meshes[instance.mesh.index()];
                let wide = &mesh.hierarchy.wide;
                // The affine inverse keeps distances: they are in units of the direction.
                let Placement { mesh_from_world } = geometry.placement(id);
                let local = if mesh_from_world.matrix3 == DMat3::IDENTITY {
                    relative.from(ray.origin + mesh_from_world.translation)
                } else {
                    Sheared::new(Ray {
                        origin: mesh_from_world.transform_point3(ray.origin),
                        direction: mesh_from_world.transform_vector3(ray.direction),
                        ..ray
                    })
                };
                bottom.clear();
                bottom.extend(root(wide));
                while let Some(items) = next_leaf(wide, &local, limit, bottom) {
                    for t in items {
                        let Some((distance, front)) = local.triangle(mesh, t) else { continue };
                        let primitive = PrimitiveId(instance.first_primitive.0 + t as u32);
                        if distance <= limit && accept(primitive) {
                            let hit = Hit { distance, primitive, instance: Some(id), front };
                            limit = visit(hit, limit);
                        }
                    }
                }
            }
        }
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
        let cast = Cast {
            geometry,
            top_level: &geometry.occluders,
            moving: &geometry.moving_occluders,
            occluders: true,
            ray,
            limit,
        };
        self.visit(&cast, &mut accept, &mut |hit, limit| {
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
        let cast = Cast {
            geometry,
            top_level: &geometry.see_through,
            moving: &geometry.moving_see_through,
            occluders: false,
            ray,
            limit,
        };
        self.visit(&cast, &mut |_| true, &mut |hit, limit| {
            if hit.distance < limit {
                found(hit);
            }
            limit
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Instance, MeshId, ObjectId};
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
            motion: None,
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
        let ray = Ray::new(DVec3::new(1e7 + 0.25, 0.5, 0.0), -DVec3::Z);
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
            let ray = Ray::new(DVec3::new(1e7 + s, s, 0.0), -DVec3::Z);
            assert!(caster.closest_occluder(&scene, ray, f64::INFINITY, |_| true).is_some());
        }
    }

    #[test]
    fn rays_in_the_border_of_a_box_meet_it() {
        let scene = scene();
        let mut caster = RayCaster::new();
        for (x, y) in [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (-1.0, -1.0), (1.0, 1.0)] {
            for direction in [DVec3::NEG_Z, DVec3::new(0.0, -0.0, -1.0)] {
                let ray = Ray::new(DVec3::new(1e7 + x, y, 0.0), direction);
                let hit = caster.closest_occluder(&scene, ray, f64::INFINITY, |_| true);
                assert_eq!(hit.map(|h| h.distance), Some(2.0), "{x} {y}");
            }
        }
    }

    /// A number in [-1, 1) that looks random.
    fn scatter(i: u64) -> f64 {
        let mixed = (i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (mixed >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// Meshes of small triangles all over the place, under translations, rotations and mirrors.
    fn clutter() -> InstancedGeometry {
        let mut meshes = vec![];
        let mut instances = vec![];
        let mut first = 0;
        for m in 0..12u64 {
            let corner = |v: u64, axis: u64| scatter(1000 * m + 3 * (v / 3) + axis) as f32;
            let nudge = |v: u64, axis: u64| 0.2 * scatter(50_000 + 700 * m + 3 * v + axis) as f32;
            let count = 7 * m + 1;
            let positions: Vec<[f32; 3]> = (0..3 * count)
                .map(|v| [0, 1, 2].map(|axis| corner(v, axis) + nudge(v, axis)))
                .collect();
            let triangles: Vec<[u32; 3]> =
                (0..count as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
            meshes.push(Mesh::new(positions, &triangles).0);
            let to = DVec3::new(scatter(m), scatter(m + 90), scatter(m + 180));
            let turned = DAffine3::from_axis_angle(to.normalize(), m as f64);
            let mirrored = DAffine3::from_scale(DVec3::new(-1.0, 1.0, 2.0));
            let moved = DAffine3::from_translation(to);
            for world_from_mesh in [moved, moved * turned, moved * turned * mirrored] {
                instances.push(Instance {
                    mesh: MeshId(m as u32),
                    object: ObjectId(0),
                    world_from_mesh,
                    first_primitive: PrimitiveId(first),
                    occluder: true,
                    motion: None,
                });
                first += count as u32;
            }
        }
        InstancedGeometry::new(meshes, instances)
    }

    /// The nearest hit as `closest_occluder` defines it, found without a hierarchy.
    fn nearest_of_all(geometry: &InstancedGeometry, ray: Ray) -> Option<(f64, PrimitiveId)> {
        let mut hits = vec![];
        for (id, instance) in (0..).map(InstanceId).zip(&geometry.instances) {
            let Placement { mesh_from_world } = geometry.placement(id);
            let local = Sheared::new(Ray {
                origin: mesh_from_world.transform_point3(ray.origin),
                direction: mesh_from_world.transform_vector3(ray.direction),
                ..ray
            });
            let mesh = &geometry.meshes[instance.mesh.index()];
            for t in 0..mesh.triangles.len() {
                let primitive = PrimitiveId(instance.first_primitive.0 + t as u32);
                hits.extend(local.triangle(mesh, t).map(|(distance, _)| (distance, primitive)));
            }
        }
        hits.into_iter().min_by(|a, b| a.partial_cmp(b).expect("distances are numbers"))
    }

    #[test]
    fn walks_find_what_is_nearest_of_all_on_any_processor() {
        let geometry = clutter();
        let mut caster = RayCaster::new();
        let mut hits = 0;
        for i in 0..3000 {
            let [x, y, z, u, v, w] = [0, 1, 2, 3, 4, 5].map(|k| scatter(7 * i + k + 1_000_000));
            let ray = Ray::new(DVec3::new(x, y, z), DVec3::new(u, v, w));
            let expected = nearest_of_all(&geometry, ray);
            let found = caster.closest_occluder(&geometry, ray, f64::INFINITY, |_| true);
            assert_eq!(found.map(|hit| (hit.distance, hit.primitive)), expected, "{ray:?}");
            let mut nearest: Option<(f64, PrimitiveId)> = None;
            let limit = f64::INFINITY;
            let cast = Cast {
                geometry: &geometry,
                top_level: &geometry.occluders,
                moving: &geometry.moving_occluders,
                occluders: true,
                ray,
                limit,
            };
            caster.visit_anywhere(&cast, &mut |_| true, &mut |hit, limit| {
                let this = (hit.distance, hit.primitive);
                nearest = Some(nearest.map_or(this, |n| if this < n { this } else { n }));
                limit.min(hit.distance)
            });
            assert_eq!(nearest, expected, "{ray:?}");
            hits += usize::from(expected.is_some());
        }
        assert!(hits > 1000 && hits < 3000, "{hits}: some rays hit, some do not");
    }
}
