//! When two hits are at the same depth: a bound on the error of the ray caster's distances.
//!
//! The caster maps the ray into mesh space by the inverse of A = `world_from_mesh`, shears the
//! corners, and interpolates the distance t with the edge functions (Woop, Benthin, Wald 2013).
//! With the ray's unit direction d, the triangle's normal n = (p1 - p0) x (p2 - p0) (length:
//! twice its area) and its longest edge E, all in world space:
//!
//! 1. *Positions.* Everything up to the sheared corners is as if each corner had been moved by
//!    at most delta. The inverse is cofactors over determinant; with the Frobenius norm |A| and
//!    K = |A|^3 / |det A|, a cofactor is wrong by `gamma(3)` 2 |A|^2 and the determinant by
//!    `gamma(6)` |A|^3, so the inverse times A by at most `gamma(12)` K (1 + K). It acts on the
//!    ray's origin o less the translation and on t d. Transforming, subtracting and shearing
//!    add `gamma(20)` of the coordinates' magnitude (shears are at most 1). So
//!    delta = `gamma(32)` K (1 + K) (|o| + |translation| + reach), where the farthest corner is
//!    at distance *reach* from the origin. A point of the triangle moves by a convex combination
//!    of its corners' moves, so t moves by delta |n| / |n.d|.
//! 2. *Edge functions.* Sheared corners of a triangle that is hit are at most 2 E from the ray,
//!    so an edge function is wrong by `gamma(3)` 2 (2 E)^2, three of them by `gamma(72)` E^2.
//!    Divided by their sum, >= |n.d|, and times the spread of t over the corners, <= sqrt(3) E:
//!    `gamma(128)` E^3 / |n.d|.
//! 3. *Interpolation.* The products and sums of equal sign, the scale and the quotient:
//!    `gamma(8)` t.
//!
//! The sum is doubled to cover terms of second order. A triangle seen edge on has no bound:
//! any other hit of the ray ties with it.
//!
//! What moves is put between two key frames first, which adds three roundings, well inside the
//! `gamma(32)`. Where the caster takes corners into the world, A is the identity and K = 1.
//!
//! A sphere of radius r is hit where the ray has gone in by s = r cos(a), a the angle of the hit
//! against its normal. Its centre and radius are off by at most delta, so t by delta, and s^2 by
//! 2 r delta (twice, for both): s by at most the root of that, and by 2 r delta / s.

use sightline_geometry::raycast::{Hit, Ray, mesh_space};
use sightline_geometry::{InstancedGeometry, Shape, gamma};

/// Bound on the error of the distance of `hit`, in units of the length of the ray's direction,
/// which must be 1.
pub fn distance_bound(geometry: &InstancedGeometry, ray: Ray, hit: Hit) -> f64 {
    let Some(instance) = hit.instance else { return sphere_bound(geometry, ray, hit) };
    let instance = &geometry.instances[instance.index()];
    let mesh = &geometry.meshes[instance.mesh.index()];
    let world_from_mesh = mesh_space(instance, mesh, ray.moment).unwrap_or_default();
    let a = world_from_mesh.matrix3;
    let square = a.x_axis.length_squared() + a.y_axis.length_squared() + a.z_axis.length_squared();
    let k = square * square.sqrt() / a.determinant().abs();
    let corners = geometry.triangle_at(hit.primitive, ray.moment).corners.map(|p| p - ray.origin);
    let reach = corners.iter().fold(hit.distance, |r, p| r.max(p.length()));
    let magnitude = ray.origin.length() + world_from_mesh.translation.length() + reach;
    let delta = gamma(32) * k * (1.0 + k) * magnitude;

    let [p0, p1, p2] = corners;
    let edge = (p1 - p0).length().max((p2 - p1).length()).max((p0 - p2).length());
    let normal = (p1 - p0).cross(p2 - p0);
    let towards = normal.dot(ray.direction).abs();
    let bound = 2.0
        * ((delta * normal.length() + gamma(128) * edge * edge * edge) / towards
            + gamma(8) * hit.distance);
    if bound.is_nan() { f64::INFINITY } else { bound }
}

/// As [`distance_bound`], of a particle.
fn sphere_bound(geometry: &InstancedGeometry, ray: Ray, hit: Hit) -> f64 {
    let Shape::Sphere { center, radius } = geometry.shape(hit.primitive, ray.moment) else {
        return f64::INFINITY;
    };
    let reach = ray.origin.length() + center.length() + hit.distance + radius;
    let delta = gamma(32) * reach;
    let inside = ((center - ray.origin).dot(ray.direction) - hit.distance).abs();
    let grazing = (4.0 * radius * delta).sqrt();
    2.0 * (delta + (4.0 * radius * delta / inside.max(grazing)).min(grazing))
}

/// True when `other` is not farther than `nearest`, up to the errors of both distances.
pub fn ties(geometry: &InstancedGeometry, ray: Ray, nearest: Hit, other: Hit) -> bool {
    let apart = other.distance - nearest.distance;
    apart <= 0.0
        || apart <= distance_bound(geometry, ray, nearest) + distance_bound(geometry, ray, other)
}
