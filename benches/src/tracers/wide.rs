//! Compressed wide hierarchies of the crate `obvhs`.
//!
//! Triangles are stored in the order of the hierarchy's leaves. With instances there is a hierarchy
//! over their boxes and one a mesh; a ray is taken into mesh space without normalising it, so
//! that distances stay comparable.

use glam::{Affine3A, DVec3, Vec3A};
use obvhs::cwbvh::{CwBvh, builder::build_cwbvh, builder::build_cwbvh_from_tris};
use obvhs::ray::{Ray, RayHit};
use obvhs::triangle::Triangle;
use obvhs::{BvhBuildParams, aabb::Aabb};
use rayon::prelude::*;
use sightline_geometry::{InstancedGeometry, PrimitiveId};

use super::{FLAT_MAX, LocalHit, LocalRay, MISS, Tracer};

/// Triangles with their hierarchy.
struct Body {
    hierarchy: CwBvh,
    /// In the order of the leaves.
    triangles: Vec<Triangle>,
    /// Numbers of the triangles before they were put in order.
    numbers: Vec<u32>,
}

impl Body {
    fn new(triangles: &[Triangle]) -> Self {
        // Reinsertion pays for itself: tracing is all that is timed. Splits make it slower to
        // build and hardly faster to trace where triangles are small.
        let parameters = BvhBuildParams::medium_build();
        let hierarchy = build_cwbvh_from_tris(triangles, parameters, &mut Default::default());
        let numbers = hierarchy.primitive_indices.clone();
        let triangles = numbers.iter().map(|&t| triangles[t as usize]).collect();
        Self { hierarchy, triangles, numbers }
    }

    /// The nearest triangle, and its distance; `(MISS, _)` when there is none.
    #[inline]
    fn closest(&self, ray: Ray) -> (u32, f32) {
        let mut hit = RayHit::none();
        self.hierarchy.ray_traverse(ray, &mut hit, |ray, t| self.triangles[t].intersect(ray));
        (self.numbers.get(hit.primitive_id as usize).copied().unwrap_or(MISS), hit.t)
    }
}

/// An instance in the order of its hierarchy.
struct Placed {
    mesh_from_local: Affine3A,
    mesh: u32,
    first_primitive: u32,
}

enum Parts {
    Flat(Body),
    Instanced { hierarchy: CwBvh, placed: Vec<Placed>, bodies: Vec<Body> },
}

/// A scene in wide hierarchies.
pub struct Wide {
    origin: DVec3,
    parts: Parts,
}

fn triangle([v0, v1, v2]: [DVec3; 3]) -> Triangle {
    let [v0, v1, v2] = [v0, v1, v2].map(|p| p.as_vec3a());
    Triangle { v0, v1, v2 }
}

impl Wide {
    /// Builds the hierarchies, for rays that start near `origin`.
    #[must_use]
    pub fn new(geometry: &InstancedGeometry, origin: DVec3) -> Self {
        let parts = if geometry.primitive_count() <= FLAT_MAX {
            let triangles: Vec<Triangle> = (0..geometry.primitive_count())
                .into_par_iter()
                .map(|p| triangle(geometry.triangle(PrimitiveId(p)).corners.map(|c| c - origin)))
                .collect();
            Parts::Flat(Body::new(&triangles))
        } else {
            Self::instanced(geometry, origin)
        };
        Self { origin, parts }
    }

    fn instanced(geometry: &InstancedGeometry, origin: DVec3) -> Parts {
        let bodies = geometry
            .meshes
            .par_iter()
            .map(|mesh| {
                let corners = (0..mesh.triangles.len()).map(|t| triangle(mesh.corners(t)));
                Body::new(&corners.collect::<Vec<_>>())
            })
            .collect();
        let boxes: Vec<Aabb> = geometry
            .instances
            .iter()
            .map(|i| {
                let b = geometry.meshes[i.mesh.index()].bounds.transformed(&i.world_from_mesh);
                // Rounding to f32 moves a corner by less than this.
                let slack =
                    f64::from(f32::EPSILON) * ((b.min - origin).abs() + (b.max - origin).abs());
                let corner = |p: DVec3| (p - origin).as_vec3a();
                Aabb::new(corner(b.min - slack), corner(b.max + slack))
            })
            .collect();
        let hierarchy =
            build_cwbvh(&boxes, BvhBuildParams::medium_build(), &mut Default::default());
        let placed = hierarchy
            .primitive_indices
            .iter()
            .map(|&i| {
                let instance = &geometry.instances[i as usize];
                let mut local_from_mesh = instance.world_from_mesh;
                local_from_mesh.translation -= origin;
                Placed {
                    mesh_from_local: local_from_mesh.inverse().as_affine3a(),
                    mesh: instance.mesh.0,
                    first_primitive: instance.first_primitive.0,
                }
            })
            .collect();
        Parts::Instanced { hierarchy, placed, bodies }
    }

    #[inline]
    fn closest_one(&self, ray: &LocalRay) -> LocalHit {
        let ray = Ray::new_inf(Vec3A::from(ray.origin), Vec3A::from(ray.direction));
        match &self.parts {
            Parts::Flat(body) => {
                let (primitive, distance) = body.closest(ray);
                LocalHit { primitive, distance }
            }
            Parts::Instanced { hierarchy, placed, bodies } => {
                let mut nearest = LocalHit::MISS;
                hierarchy.ray_traverse(ray, &mut RayHit::none(), |ray, i| {
                    let placed = &placed[i];
                    let local = Ray::new(
                        placed.mesh_from_local.transform_point3a(ray.origin),
                        placed.mesh_from_local.transform_vector3a(ray.direction),
                        0.0,
                        nearest.distance,
                    );
                    let (triangle, distance) = bodies[placed.mesh as usize].closest(local);
                    if triangle != MISS && distance < nearest.distance {
                        let primitive = placed.first_primitive + triangle;
                        nearest = LocalHit { primitive, distance };
                    }
                    nearest.distance
                });
                nearest
            }
        }
    }
}

impl Tracer for Wide {
    fn name(&self) -> &'static str {
        "obvhs, CWBVH"
    }

    fn origin(&self) -> DVec3 {
        self.origin
    }

    fn closest(&self, rays: &[LocalRay], hits: &mut Vec<LocalHit>) {
        hits.clear();
        hits.extend(rays.iter().map(|ray| self.closest_one(ray)));
    }
}
