//! The exact twin of single pixels, and exact answers about triangles, in rational arithmetic.
//!
//! The floats of the input are taken as the rationals that they are, as in
//! `sightline_solver::reference`; unlike there, one pixel is solved, for given primitives.

use dashu_ratio::RBig;
use glam::DVec3;
use sightline_geometry::{InstancedGeometry, PrimitiveId, RectifiedFrame, Sampling, UNIT_ROUNDOFF};

type V3 = [RBig; 3];

fn exact(v: f64) -> RBig {
    RBig::try_from(v).expect("scenes are finite")
}

fn exact3(v: DVec3) -> V3 {
    v.to_array().map(exact)
}

fn minus(a: &V3, b: &V3) -> V3 {
    std::array::from_fn(|k| &a[k] - &b[k])
}

fn dot(a: &V3, b: &V3) -> RBig {
    &a[0] * &b[0] + &a[1] * &b[1] + &a[2] * &b[2]
}

fn cross(a: &V3, b: &V3) -> V3 {
    let term = |i: usize, j: usize| &a[i] * &b[j] - &a[j] * &b[i];
    [term(1, 2), term(2, 0), term(0, 1)]
}

fn corners(geometry: &InstancedGeometry, primitive: u32) -> [V3; 3] {
    let (instance, local) = geometry.locate(PrimitiveId(primitive));
    let instance = &geometry.instances[instance.index()];
    let m = instance.world_from_mesh;
    let columns = [m.matrix3.x_axis, m.matrix3.y_axis, m.matrix3.z_axis].map(exact3);
    let translation = exact3(m.translation);
    geometry.meshes[instance.mesh.index()].corners(local).map(|p| {
        let p = exact3(p);
        std::array::from_fn(|k| {
            &columns[0][k] * &p[0]
                + &columns[1][k] * &p[1]
                + &columns[2][k] * &p[2]
                + &translation[k]
        })
    })
}

/// True for triangles without area, in their mesh.
pub fn is_degenerate(geometry: &InstancedGeometry, primitive: u32) -> bool {
    let (instance, local) = geometry.locate(PrimitiveId(primitive));
    let mesh = &geometry.meshes[geometry.instances[instance.index()].mesh.index()];
    let [a, b, c] = mesh.corners(local);
    let (e, f) = (b - a, c - a);
    // One rounding a difference, three a component: under 8 u of the products of the lengths.
    if e.cross(f).abs().max_element() > 8.0 * UNIT_ROUNDOFF * e.length() * f.length() {
        return false;
    }
    let [a, b, c] = [a, b, c].map(exact3);
    cross(&minus(&b, &a), &minus(&c, &a)).iter().all(|v| *v == RBig::ZERO)
}

/// True when `other` lies in the plane of `one`, which has an area.
pub fn are_coplanar(geometry: &InstancedGeometry, one: u32, other: u32) -> bool {
    let [a, b, c] = corners(geometry, one);
    let normal = cross(&minus(&b, &a), &minus(&c, &a));
    corners(geometry, other).iter().all(|p| dot(&normal, &minus(p, &a)) == RBig::ZERO)
}

/// One cut at one column: t of its ends, ascending, and the depths there.
struct Stretch {
    t: [RBig; 2],
    z: [RBig; 2],
    slope: RBig,
    primitive: u32,
    occluder: bool,
}

impl Stretch {
    fn depth(&self, t: &RBig) -> RBig {
        &self.z[0] + &self.slope * (t - &self.t[0])
    }

    fn covers(&self, t: &RBig) -> bool {
        &self.t[0] <= t && t < &self.t[1]
    }

    fn crossing(&self, other: &Self) -> Option<RBig> {
        if self.slope == other.slope {
            return None;
        }
        let at_zero = |s: &Self| &s.z[0] - &s.slope * &s.t[0];
        Some((at_zero(other) - at_zero(self)) / (&self.slope - &other.slope))
    }
}

/// The ends (x, z) of a triangle's cut with row w, z >= 0.
fn cut(corners: &[V3; 3], w: &RBig) -> Option<[(RBig, RBig); 2]> {
    let h: [RBig; 3] = std::array::from_fn(|k| &corners[k][1] - w * &corners[k][2]);
    let mut ends = Vec::new();
    for (i, j) in [(0, 1), (1, 2), (2, 0)] {
        if (h[i] >= RBig::ZERO) != (h[j] >= RBig::ZERO) {
            let lambda = &h[i] / (&h[i] - &h[j]);
            let mix = |k: usize| &corners[i][k] + &lambda * (&corners[j][k] - &corners[i][k]);
            ends.push((mix(0), mix(2)));
        }
    }
    let [mut a, mut b] = <[(RBig, RBig); 2]>::try_from(ends).ok()?;
    match (a.1 > RBig::ZERO, b.1 > RBig::ZERO) {
        (false, false) => return None,
        (true, true) => {}
        (a_in_front, _) => {
            let lambda = &a.1 / (&a.1 - &b.1);
            let x0 = &a.0 + lambda * (&b.0 - &a.0);
            *(if a_in_front { &mut b } else { &mut a }) = (x0, RBig::ZERO);
        }
    }
    Some([a, b])
}

/// What each primitive of `candidates` has of the segment at a pixel, in units of t. Primitives
/// that are not candidates are not looked at: the caller knows that they are not at this pixel.
pub fn pixel(
    geometry: &InstancedGeometry,
    frame: &RectifiedFrame,
    sampling: Sampling,
    (face, row, column): (usize, u32, u32),
    candidates: &[u32],
) -> Vec<(u32, f64)> {
    let face = frame.face(face);
    let axes = [face.axis, face.up, face.forward].map(exact3);
    let (v0, length) = (exact3(frame.v0), exact(frame.length));
    let (w, c) = (exact(sampling.row(row)), exact(sampling.column(column)));
    let mut stretches = Vec::new();
    for &primitive in candidates {
        let in_face = corners(geometry, primitive).map(|p| {
            let relative = minus(&p, &v0);
            std::array::from_fn(|k| dot(&axes[k], &relative))
        });
        let Some(ends) = cut(&in_face, &w) else { continue };
        let time = |e: &(RBig, RBig)| (&e.0 - &c * &e.1) / &length;
        let (a, b) = (time(&ends[0]), time(&ends[1]));
        let [(_, za), (_, zb)] = ends;
        let (t, z) = if a <= b { ([a, b], [za, zb]) } else { ([b, a], [zb, za]) };
        if t[0] < t[1] && t[0] < RBig::ONE && t[1] > RBig::ZERO {
            let slope = (&z[1] - &z[0]) / (&t[1] - &t[0]);
            let (instance, _) = geometry.locate(PrimitiveId(primitive));
            let occluder = geometry.instances[instance.index()].occluder;
            stretches.push(Stretch { t, z, slope, primitive, occluder });
        }
    }
    let mut borders = vec![RBig::ZERO, RBig::ONE];
    for (i, a) in stretches.iter().enumerate() {
        borders.extend(a.t.iter().cloned());
        borders.extend(stretches[..i].iter().filter_map(|b| a.crossing(b)));
    }
    borders.retain(|t| (RBig::ZERO..=RBig::ONE).contains(t));
    borders.sort();
    borders.dedup();
    let mut seen: Vec<(u32, RBig)> = stretches.iter().map(|s| (s.primitive, RBig::ZERO)).collect();
    for pair in borders.windows(2) {
        let middle = (&pair[0] + &pair[1]) / RBig::from(2);
        let here = |s: &&Stretch| s.covers(&middle);
        let nearest = stretches
            .iter()
            .filter(|s| s.occluder)
            .filter(here)
            .map(|s| (s.depth(&middle), s.primitive))
            .min();
        for (s, seen) in stretches.iter().zip(&mut seen) {
            let is_seen = if s.occluder {
                nearest.as_ref().is_some_and(|n| n.1 == s.primitive)
            } else {
                s.covers(&middle) && nearest.as_ref().is_none_or(|n| s.depth(&middle) <= n.0)
            };
            if is_seen {
                seen.1 += &pair[1] - &pair[0];
            }
        }
    }
    seen.into_iter().map(|(p, length)| (p, length.to_f64().value())).collect()
}
