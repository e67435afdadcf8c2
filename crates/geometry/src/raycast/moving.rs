//! Rays against what moves, where it is at the ray's moment.
//!
//! A vertex is between its world positions at the two key frames around the moment. An instance
//! whose mesh does not change has there the transform between those of its key frames, and the ray
//! is taken into the space of the mesh; so is a ray at an instance that stands still while its mesh
//! changes. Where both change, or where the transform between cannot be inverted, boxes and
//! corners are taken into the world instead.

use glam::{DAffine3, DVec3};

use super::{Cast, Hit, Ray, RayCaster, Sheared, next_leaf, root};
use crate::{
    Bounds, Hierarchy, Instance, Mesh, Moment, MovingHierarchy, ParticleSystem, PrimitiveId,
    UNIT_ROUNDOFF,
    motion::{around, lerp},
};

/// Scratch memory of walks, one a level.
#[derive(Default)]
pub(super) struct Stacks {
    top: Vec<(f64, u32)>,
    bottom: Vec<(f64, u32)>,
}

/// A transform this much less voluminous than the box of its edges is not inverted: the ray in the
/// space of the mesh would be off by as much more.
const FLAT: f64 = 1e-6;

impl Sheared {
    /// The distance at which a box is entered within `limit`, if it is.
    #[inline(always)]
    fn enters(&self, bounds: Bounds, limit: f64) -> Option<f64> {
        // As in `boxes`, and two more roundings of a box between two key frames.
        const SLACK: f64 = 16.0 * UNIT_ROUNDOFF;
        let (mut near, mut far) = (0.0, limit);
        for k in 0..3 {
            let own = SLACK * (bounds.min[k].abs().max(bounds.max[k].abs()) + self.origin[k].abs());
            let (low, high) = (bounds.min[k] - own, bounds.max[k] + own);
            let (enter, leave) = if self.inverse[k] < 0.0 { (high, low) } else { (low, high) };
            let enter = (enter - self.origin[k]) * self.inverse[k];
            let leave = (leave - self.origin[k]) * self.inverse[k] * (1.0 + SLACK);
            // NaN compares false and is dropped, as in `boxes`.
            near = if enter > near { enter } else { near };
            far = if leave < far { leave } else { far };
        }
        (near <= far).then_some(near)
    }

    /// Distance to a triangle and whether its front is met, if hit.
    fn corners(&self, corners: &[DVec3; 3]) -> Option<(f64, bool)> {
        self.meets(corners.map(|p| self.sheared_point(&p.to_array())))
    }
}

/// Walks the nodes that a ray meets within a limit, front to back: `leaf(items, limit)` gives the
/// limit from then on.
#[inline(always)]
fn walk(
    stack: &mut Vec<(f64, u32)>,
    ray: &Sheared,
    mut limit: f64,
    node: impl Fn(u32) -> (u32, u32),
    bounds: impl Fn(u32) -> Option<Bounds>,
    mut leaf: impl FnMut(std::ops::Range<usize>, f64) -> f64,
) -> f64 {
    stack.clear();
    stack.extend(bounds(0).and_then(|b| ray.enters(b, limit)).map(|near| (near, 0)));
    while let Some((near, n)) = stack.pop() {
        if near > limit {
            continue;
        }
        let (first, count) = node(n);
        if count > 0 {
            limit = leaf(first as usize..(first + count) as usize, limit);
            continue;
        }
        let enter = |child: u32| Some((ray.enters(bounds(child)?, limit)?, child));
        match (enter(first), enter(first + 1)) {
            (Some(l), Some(r)) if l.0 <= r.0 => stack.extend([r, l]),
            (Some(l), Some(r)) => stack.extend([l, r]),
            (one, other) => stack.extend(one.or(other)),
        }
    }
    limit
}

fn walk_moving(
    stack: &mut Vec<(f64, u32)>,
    hierarchy: &MovingHierarchy,
    moment: Moment,
    ray: &Sheared,
    limit: f64,
    leaf: impl FnMut(std::ops::Range<usize>, f64) -> f64,
) -> f64 {
    if hierarchy.nodes.is_empty() {
        return limit;
    }
    let node = |n: u32| {
        let node = hierarchy.nodes[n as usize];
        (node.first, node.count)
    };
    walk(stack, ray, limit, node, |n| hierarchy.at_moment(n, moment), leaf)
}

/// The transform whose inverse takes a ray into the space of an instance's mesh; none where boxes and
/// corners are taken into the world instead.
#[must_use]
pub fn mesh_space(instance: &Instance, mesh: &Mesh, moment: Moment) -> Option<DAffine3> {
    if instance.motion.is_some() && mesh.motion.is_some() {
        return None;
    }
    let world_from_mesh = instance.world_from_mesh_at(moment);
    if instance.motion.is_some() {
        let m = world_from_mesh.matrix3;
        let volume = m.x_axis.length() * m.y_axis.length() * m.z_axis.length();
        let invertible = m.determinant().abs() > FLAT * volume;
        if !invertible || !world_from_mesh.inverse().is_finite() {
            return None;
        }
    }
    Some(world_from_mesh)
}

/// Distance at which a ray meets a sphere from outside or, when it starts within, from inside.
///
/// With b = q.d for the centre q from the ray's origin, the roots are (b -+ s) / d.d with
/// s^2 = r^2 d.d - |q x d|^2: no cancellation when the sphere is small and far. The smaller root by
/// the product of both, so that neither cancels.
fn meets_sphere(
    origin: DVec3,
    direction: DVec3,
    center: DVec3,
    radius: f64,
) -> Option<(f64, bool)> {
    let q = center - origin;
    let dd = direction.length_squared();
    let beyond = radius * radius * dd - q.cross(direction).length_squared();
    if beyond < 0.0 {
        return None;
    }
    let (b, s) = (q.dot(direction), beyond.sqrt());
    let c = (q.length() - radius) * (q.length() + radius);
    let (near, far) = if b >= 0.0 {
        let sum = b + s;
        (if sum > 0.0 { c / sum } else { 0.0 }, sum / dd)
    } else {
        ((b - s) / dd, c / (b - s))
    };
    match (near > 0.0, far > 0.0) {
        (true, _) => Some((near, true)),
        (false, true) => Some((far, false)),
        _ => None,
    }
}

impl RayCaster {
    /// As `visit`, for instances that move and for particles; gives the limit that is left.
    pub(super) fn visit_moving(
        &mut self,
        cast: &Cast,
        accept: &mut impl FnMut(PrimitiveId) -> bool,
        visit: &mut impl FnMut(Hit, f64) -> f64,
    ) -> f64 {
        let Cast { geometry, ray, moving, mut limit, .. } = *cast;
        if moving.instances.is_empty() && geometry.particles.is_empty() {
            return limit;
        }
        let mut stacks = std::mem::take(&mut self.moving);
        let Stacks { top, bottom } = &mut stacks;
        let relative = Sheared::new(Ray { origin: ray.origin - geometry.origin, ..ray });
        let wide = &mut self.bottom;
        limit = walk_moving(
            top,
            &moving.hierarchy,
            ray.moment,
            &relative,
            limit,
            |items, mut limit| {
                for &id in &moving.instances[items] {
                    let instance = &geometry.instances[id.index()];
                    let mesh = &geometry.meshes[instance.mesh.index()];
                    let mut hit = |t: usize, found: Option<(f64, bool)>, limit: f64| {
                        let Some((distance, front)) = found else { return limit };
                        let primitive = PrimitiveId(instance.first_primitive.0 + t as u32);
                        if distance > limit || !accept(primitive) {
                            return limit;
                        }
                        visit(Hit { distance, primitive, instance: Some(id), front }, limit)
                    };
                    limit = instance_hits(instance, mesh, ray, limit, bottom, wide, &mut hit);
                }
                limit
            },
        );
        for system in geometry.particles.iter().filter(|p| p.occluder == cast.occluders) {
            limit = particle_hits(system, ray, limit, bottom, accept, visit);
        }
        self.moving = stacks;
        limit
    }
}

/// Visits the hits of one instance: `hit(triangle, what is found, limit)`.
fn instance_hits(
    instance: &Instance,
    mesh: &Mesh,
    ray: Ray,
    mut limit: f64,
    stack: &mut Vec<(f64, u32)>,
    wide: &mut Vec<super::Open>,
    hit: &mut impl FnMut(usize, Option<(f64, bool)>, f64) -> f64,
) -> f64 {
    let moment = ray.moment;
    let inside = mesh_space(instance, mesh, moment).map(|world_from_mesh| {
        let mesh_from_world = world_from_mesh.inverse();
        Sheared::new(Ray {
            origin: mesh_from_world.transform_point3(ray.origin),
            direction: mesh_from_world.transform_vector3(ray.direction),
            ..ray
        })
    });
    match (inside, &mesh.motion) {
        (Some(local), None) => {
            let hierarchy = &mesh.hierarchy.wide;
            wide.clear();
            wide.extend(root(hierarchy));
            while let Some(items) = next_leaf(hierarchy, &local, limit, wide) {
                for t in items {
                    limit = hit(t, local.triangle(mesh, t), limit);
                }
            }
            limit
        }
        (Some(local), Some(motion)) => {
            let (from, to) = around(&motion.keys, moment.state);
            let point = |v: u32| {
                let wide = |p: &[f32; 3]| DVec3::from_array(p.map(f64::from));
                lerp(wide(&from[v as usize]), wide(&to[v as usize]), moment.t)
            };
            let leaf = |items: std::ops::Range<usize>, mut limit: f64| {
                for t in items {
                    limit = hit(t, local.corners(&mesh.triangles[t].map(point)), limit);
                }
                limit
            };
            walk_moving(stack, &motion.hierarchy, moment, &local, limit, leaf)
        }
        (None, _) => {
            let world = Sheared::new(ray);
            let leaf = |items: std::ops::Range<usize>, mut limit: f64| {
                for t in items {
                    let [from, to] = instance.corners_around(mesh, t, moment.state);
                    let corners = [0, 1, 2].map(|k| lerp(from[k], to[k], moment.t));
                    limit = hit(t, world.corners(&corners), limit);
                }
                limit
            };
            let maps = instance.around(moment.state);
            let between = |from: Bounds, to: Bounds| {
                let (from, to) = (from.transformed(maps.0), to.transformed(maps.1));
                Bounds {
                    min: lerp(from.min, to.min, moment.t),
                    max: lerp(from.max, to.max, moment.t),
                }
            };
            match &mesh.motion {
                None => {
                    let Hierarchy { nodes, .. } = &mesh.hierarchy;
                    if nodes.is_empty() {
                        return limit;
                    }
                    let bounds = |n: u32| {
                        let own = nodes[n as usize].bounds.widen();
                        Some(between(own, own))
                    };
                    let node = |n: u32| (nodes[n as usize].first, nodes[n as usize].count);
                    walk(stack, &world, limit, node, bounds, leaf)
                }
                Some(motion) => {
                    let h = &motion.hierarchy;
                    if h.nodes.is_empty() {
                        return limit;
                    }
                    let bounds = |n: u32| {
                        let (from, to) = h.around(n, moment.state)?;
                        Some(between(from.widen(), to.widen()))
                    };
                    let node = |n: u32| (h.nodes[n as usize].first, h.nodes[n as usize].count);
                    walk(stack, &world, limit, node, bounds, leaf)
                }
            }
        }
    }
}

fn particle_hits(
    system: &ParticleSystem,
    ray: Ray,
    limit: f64,
    stack: &mut Vec<(f64, u32)>,
    accept: &mut impl FnMut(PrimitiveId) -> bool,
    visit: &mut impl FnMut(Hit, f64) -> f64,
) -> f64 {
    let Ray { direction, moment, .. } = ray;
    let origin = ray.origin - system.origin;
    let relative = Sheared::new(Ray { origin, ..ray });
    walk_moving(stack, &system.hierarchy, moment, &relative, limit, |items, mut limit| {
        for i in items {
            let Some((from, to)) = system.around(i, moment.state) else { continue };
            let center = lerp(from.center(), to.center(), moment.t);
            let radius =
                (1.0 - moment.t) * f64::from(from.radius) + moment.t * f64::from(to.radius);
            let Some((distance, front)) = meets_sphere(origin, direction, center, radius) else {
                continue;
            };
            let primitive = PrimitiveId(system.first_primitive.0 + i as u32);
            if distance <= limit && accept(primitive) {
                limit = visit(Hit { distance, primitive, instance: None, front }, limit);
            }
        }
        limit
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{InstancedGeometry, MeshId, ObjectId, Sphere};
    use proptest::prelude::*;

    type Points = Vec<DVec3>;

    fn instance(mesh: u32, first: u32, keys: Option<Box<[DAffine3]>>, at: DAffine3) -> Instance {
        Instance {
            mesh: MeshId(mesh),
            object: ObjectId(mesh),
            world_from_mesh: keys.as_ref().map_or(at, |k| k[0]),
            first_primitive: PrimitiveId(first),
            occluder: true,
            motion: keys,
        }
    }

    fn transform(seed: f64) -> DAffine3 {
        let turn = glam::DQuat::from_axis_angle(
            DVec3::new(seed.sin(), seed.cos(), 0.3).normalize(),
            seed * 0.7,
        );
        let scale = DVec3::new(1.0 + 0.2 * seed.sin(), 1.0, 0.8);
        let to = DVec3::new(2.0 * seed.sin(), seed.cos(), -8.0);
        DAffine3::from_scale_rotation_translation(scale, turn, to)
    }

    fn scene(points: &[Points], seeds: [f64; 3], spheres: &[(DVec3, f64)]) -> InstancedGeometry {
        let stored = |p: &Points| p.iter().map(|v| v.as_vec3().to_array()).collect::<Vec<_>>();
        let triangles: Vec<[u32; 3]> =
            (0..points[0].len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let rigid = Mesh::new(stored(&points[0]), &triangles).0;
        let soft = Mesh::moving(points.iter().map(stored).collect(), &triangles).0;
        let count = triangles.len() as u32;
        let keys = || Some(seeds.map(transform).into());
        let instances = vec![
            instance(0, 0, None, transform(0.1)),
            instance(0, count, keys(), DAffine3::IDENTITY),
            instance(1, 2 * count, None, transform(0.9)),
            instance(1, 3 * count, keys(), DAffine3::IDENTITY),
        ];
        let sphere = |(c, r): &(DVec3, f64), key: f64| Sphere {
            center: (*c + DVec3::new(key, 0.3 * key, 0.0)).as_vec3().to_array(),
            radius: (*r * (1.0 + 0.2 * key)) as f32,
        };
        let lists =
            (0..3).map(|key| spheres.iter().map(|s| sphere(s, f64::from(key))).collect()).collect();
        let origin = DVec3::new(0.0, 0.0, -8.0);
        let first = PrimitiveId(4 * count);
        let (system, _) = ParticleSystem::new(ObjectId(2), first, true, origin, lists);
        InstancedGeometry::with_motion(vec![rigid, soft], instances, vec![system], 2)
    }

    /// The nearest primitive by looking at each where it is at the moment.
    fn nearest(scene: &InstancedGeometry, ray: Ray) -> Option<(f64, u32)> {
        let world = Sheared::new(ray);
        let hits = (0..scene.primitive_count()).filter_map(|p| {
            let distance = match scene.shape(PrimitiveId(p), ray.moment) {
                crate::Shape::Triangle(t) => world.corners(&t.corners)?.0,
                crate::Shape::Sphere { center, radius } => {
                    meets_sphere(ray.origin, ray.direction, center, radius)?.0
                }
                crate::Shape::Absent => return None,
            };
            Some((distance, p))
        });
        hits.min_by(|a, b| a.partial_cmp(b).expect("distances are numbers"))
    }

    proptest! {
        #[test]
        fn rays_meet_what_moves_where_it_is(
            points in prop::collection::vec(
                prop::collection::vec(prop::array::uniform3(-3.0f64..3.0), 60), 3),
            seeds in prop::array::uniform3(0.0..2.0),
            spheres in prop::collection::vec((prop::array::uniform3(-3.0f64..3.0), 0.1..0.8), 1..30),
            (state, t) in (0u32..2, 0.0..=1.0),
            rays in prop::collection::vec(
                (prop::array::uniform3(-2.0f64..2.0), prop::array::uniform3(-0.5f64..0.5)), 20),
        ) {
            let points: Vec<Points> = points
                .iter()
                .map(|p| p.iter().map(|v| DVec3::from_array(*v)).collect())
                .collect();
            let spheres: Vec<_> =
                spheres.into_iter().map(|(c, r)| (DVec3::from_array(c), r)).collect();
            let scene = scene(&points, seeds, &spheres);
            let mut caster = RayCaster::new();
            for (origin, aside) in rays {
                let direction = DVec3::new(aside[0], aside[1], -1.0);
                let ray = Ray {
                    origin: DVec3::from_array(origin),
                    direction,
                    moment: Moment { state, t },
                };
                let found = caster.closest_occluder(&scene, ray, f64::INFINITY, |_| true);
                match (found, nearest(&scene, ray)) {
                    (None, None) => {}
                    (Some(hit), Some((distance, _))) => {
                        prop_assert!((hit.distance - distance).abs() < 1e-9 * (1.0 + distance));
                    }
                    // A ray through an edge, to a rounding.
                    other => prop_assert!(false, "{other:?}"),
                }
            }
        }
    }

    #[test]
    fn from_inside_a_sphere_its_back_wall_is_seen() {
        let meet = |at: f64| meets_sphere(DVec3::X * at, DVec3::X * 2.0, DVec3::ZERO, 1.0);
        assert_eq!(meet(-3.0), Some((1.0, true)));
        assert_eq!(meet(0.0), Some((0.5, false)));
        assert_eq!(meet(3.0), None);
    }

    #[test]
    fn a_transform_that_cannot_be_inverted_between_key_frames_is_met_in_the_world() {
        let flip = DAffine3::from_scale(DVec3::new(-1.0, 1.0, 1.0));
        let square = vec![[-1.0, -1.0, -2.0], [1.0, -1.0, -2.0], [1.0, 1.0, -3.0]];
        let (mesh, _) = Mesh::new(square, &[[0, 1, 2]]);
        let keys: Box<[DAffine3]> = [DAffine3::IDENTITY, flip].into();
        let one = instance(0, 0, Some(keys), DAffine3::IDENTITY);
        let scene = InstancedGeometry::with_motion(vec![mesh], vec![one], vec![], 1);
        let cast = |t: f64, x: f64| {
            let moment = Moment { state: 0, t };
            let ray = Ray { origin: DVec3::new(x, 0.0, 0.0), direction: -DVec3::Z, moment };
            RayCaster::new().closest_occluder(&scene, ray, 9.0, |_| true).map(|h| h.distance)
        };
        assert_eq!(cast(0.0, 0.5), Some(2.5));
        assert_eq!(cast(0.5, 0.5), None, "flat at half time");
        assert_eq!(cast(1.0, -0.5), Some(2.5));
    }
}
