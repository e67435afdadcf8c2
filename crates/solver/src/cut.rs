//! The cut of a triangle with a row plane: the kernel of the rectified frame.
//!
//! Row w is the plane y = w z. The side of a vertex is the sign of h = y - w z, where zero counts
//! as above: that is the plane moved by an infinitesimal, so closed meshes stay closed and a
//! triangle in the plane has no cut. Two edges of a triangle that is cut have their ends on
//! different sides; each is cut at
//!
//! ```text
//! lambda = hP / (hP - hQ),   x = xP + lambda (xQ - xP),   z = zP + lambda (zQ - zP)
//! ```
//!
//! with (P, Q) in canonical (lexicographic) order, so that both triangles of an edge get the same
//! float whatever their winding or vertex numbering. A cut that reaches z <= 0 is clipped at
//! z = 0, where its t is x0 / L for every column: a camera that passes through a surface is an
//! ordinary end of an interval.

use glam::DVec3;

/// A row's cut through one triangle: a line segment (xa, za) - (xb, zb) of the row plane, z >= 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cut {
    /// Face x of one end, metres.
    pub xa: f64,
    /// Face z of the same end, metres, >= 0.
    pub za: f64,
    /// Face x of the other end.
    pub xb: f64,
    /// Face z of the other end, >= 0.
    pub zb: f64,
    /// Global number of the primitive.
    pub primitive: u32,
}

#[inline(always)]
fn edge(p: DVec3, q: DVec3, hp: f64, hq: f64) -> (f64, f64) {
    let swap = (q.x, q.y, q.z) < (p.x, p.y, p.z);
    let (p, q, hp, hq) = if swap { (q, p, hq, hp) } else { (p, q, hp, hq) };
    let lambda = hp / (hp - hq);
    (p.x + lambda * (q.x - p.x), p.z + lambda * (q.z - p.z))
}

impl Cut {
    /// The cut of row `w` through the triangle with these face coordinates, if there is one in
    /// front of the camera. `on_axis` is the largest rounding error of a face coordinate, metres:
    /// a cut no deeper than that lies on the axis. A triangle whose plane holds the segment has
    /// such cuts; seen edge-on from everywhere, it hides nothing.
    #[inline(always)]
    #[must_use]
    pub fn of_triangle(corners: &[DVec3; 3], w: f64, on_axis: f64, primitive: u32) -> Option<Self> {
        let h = corners.map(|p| p.y - w * p.z);
        let above = h.map(|h| h >= 0.0);
        // The corner that is alone on its side.
        let k = match above {
            [a, b, c] if a == b && b == c => return None,
            [a, b, _] if a == b => 2,
            [a, _, c] if a == c => 1,
            _ => 0,
        };
        let (i, j) = ((k + 1) % 3, (k + 2) % 3);
        let (xa, za) = edge(corners[k], corners[i], h[k], h[i]);
        let (xb, zb) = edge(corners[k], corners[j], h[k], h[j]);
        if za <= on_axis && zb <= on_axis {
            return None;
        }
        Self { xa, za, xb, zb, primitive }.clipped()
    }

    /// The part with z >= 0; `None` when nothing lies in front.
    #[inline(always)]
    fn clipped(self) -> Option<Self> {
        match (self.za > 0.0, self.zb > 0.0) {
            (true, true) => Some(self),
            (false, false) => None,
            (a_in_front, _) => {
                let lambda = self.za / (self.za - self.zb);
                let x0 = self.xa + lambda * (self.xb - self.xa);
                Some(if a_in_front {
                    Self { xb: x0, zb: 0.0, ..self }
                } else {
                    Self { xa: x0, za: 0.0, ..self }
                })
            }
        }
    }

    /// The times at which the two ends are on the ray of column `c`: (x - c z) / L.
    #[inline(always)]
    #[must_use]
    pub fn times(&self, c: f64, inverse_length: f64) -> (f64, f64) {
        ((self.xa - c * self.za) * inverse_length, (self.xb - c * self.zb) * inverse_length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn corner() -> impl Strategy<Value = DVec3> {
        (-10.0..10.0, -10.0..10.0, -3.0..10.0).prop_map(|(x, y, z)| DVec3::new(x, y, z))
    }

    proptest! {
        #[test]
        fn triangles_that_share_an_edge_share_its_cut_to_the_bit(
            p in corner(), q in corner(), r in corner(), s in corner(), w in -1.0..1.0,
        ) {
            let side = |v: DVec3| v.y - w * v.z >= 0.0;
            prop_assume!(side(p) != side(q));
            let ends = |t: [DVec3; 3]| Cut::of_triangle(&t, w, 0.0, 0)
                .map(|c| [(c.xa.to_bits(), c.za.to_bits()), (c.xb.to_bits(), c.zb.to_bits())]);
            let shared = edge(p, q, p.y - w * p.z, q.y - w * q.z);
            let bits = (shared.0.to_bits(), shared.1.to_bits());
            for t in [[p, q, r], [q, p, r], [s, q, p], [p, s, q]] {
                match ends(t) {
                    None => prop_assert!(shared.1 <= 0.0),
                    Some(found) => prop_assert!(shared.1 <= 0.0 || found.contains(&bits)),
                }
            }
        }
    }

    #[test]
    fn a_vertex_on_the_row_plane_counts_as_above() {
        let on = DVec3::new(0.0, 0.0, 1.0);
        let (up, down) = (DVec3::new(1.0, 1.0, 1.0), DVec3::new(1.0, -1.0, 1.0));
        let aside = DVec3::new(2.0, 1.0, 1.0);
        assert!(Cut::of_triangle(&[on, up, aside], 0.0, 0.0, 0).is_none());
        assert!(Cut::of_triangle(&[on, up, down], 0.0, 0.0, 0).is_some());
        let flat = [on, DVec3::new(1.0, 0.0, 1.0), DVec3::new(0.0, 0.0, 2.0)];
        assert!(
            Cut::of_triangle(&flat, 0.0, 0.0, 0).is_none(),
            "a triangle in the plane has no cut"
        );
    }
}
