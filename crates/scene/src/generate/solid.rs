//! Bodies of triangles with shared vertices, and the solids that scenes are put together from.
//!
//! Invariants:
//! - vertices with equal positions are one vertex;
//! - every shape that is called closed adds each edge once in either direction, so a body of
//!   closed shapes that do not share an edge is watertight;
//! - no triangle has two equal corners.

use std::collections::HashMap;

use glam::DVec3;

use super::material::Material;

/// The triangles of one material.
#[derive(Clone, Debug)]
pub(super) struct Part {
    pub(super) material: Material,
    pub(super) triangles: Vec<[u32; 3]>,
}

/// A body of triangles, its own space, metres, fronts counter-clockwise.
#[derive(Clone, Debug, Default)]
pub(super) struct Solid {
    pub(super) positions: Vec<[f32; 3]>,
    pub(super) parts: Vec<Part>,
    welded: HashMap<[u32; 3], u32>,
}

impl Solid {
    pub(super) fn new() -> Self {
        Self::default()
    }

    /// Number of triangles.
    pub(super) fn triangle_count(&self) -> u64 {
        self.parts.iter().map(|p| p.triangles.len() as u64).sum()
    }

    fn vertex(&mut self, p: DVec3) -> u32 {
        // Adding +0 turns -0 into +0, so that equal positions have equal bits.
        let p = p.to_array().map(|c| c as f32 + 0.0);
        let positions = &mut self.positions;
        *self.welded.entry(p.map(f32::to_bits)).or_insert_with(|| {
            positions.push(p);
            positions.len() as u32 - 1
        })
    }

    pub(super) fn triangle(&mut self, material: Material, corners: [DVec3; 3]) {
        let t = corners.map(|p| self.vertex(p));
        debug_assert!(t[0] != t[1] && t[1] != t[2] && t[2] != t[0], "degenerate {corners:?}");
        match self.parts.iter_mut().find(|p| p.material == material) {
            Some(part) => part.triangles.push(t),
            None => self.parts.push(Part { material, triangles: vec![t] }),
        }
    }

    /// Adds the triangles of another body, moved.
    pub(super) fn append(&mut self, other: &Self, by: DVec3) {
        for part in &other.parts {
            for t in &part.triangles {
                let corner =
                    |v: u32| DVec3::from_array(other.positions[v as usize].map(f64::from)) + by;
                self.triangle(part.material, t.map(corner));
            }
        }
    }

    /// Two triangles; the corners go counter-clockwise seen from the front.
    pub(super) fn quad(&mut self, material: Material, [a, b, c, d]: [DVec3; 4]) {
        self.triangle(material, [a, b, c]);
        self.triangle(material, [a, c, d]);
    }

    /// A closed axis-aligned box, 12 triangles.
    pub(super) fn cuboid(&mut self, material: Material, p: DVec3, q: DVec3) {
        let (lo, hi) = (p.min(q), p.max(q));
        self.hexahedron(material, |x, y, z| {
            let pick = |k: usize, upper: bool| if upper { hi[k] } else { lo[k] };
            DVec3::new(pick(0, x), pick(1, y), pick(2, z))
        });
    }

    /// A closed body with the topology of a box, 12 triangles. `corner(x, y, z)` gives the
    /// corner at the upper (true) or lower end of each axis of a right-handed frame.
    pub(super) fn hexahedron(
        &mut self,
        material: Material,
        corner: impl Fn(bool, bool, bool) -> DVec3,
    ) {
        let c = |bits: u8| corner(bits & 1 != 0, bits & 2 != 0, bits & 4 != 0);
        for face in
            [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]]
        {
            self.quad(material, face.map(c));
        }
    }

    /// A closed box along the line from `from` to `to` with half widths in two directions;
    /// `side`, `up` and the direction of the line must be a right-handed frame.
    pub(super) fn beam(
        &mut self,
        material: Material,
        from: DVec3,
        to: DVec3,
        side: DVec3,
        up: DVec3,
    ) {
        self.hexahedron(material, |x, y, z| {
            let base = if z { to } else { from };
            base + if x { side } else { -side } + if y { up } else { -up }
        });
    }

    /// A closed upright frustum with `n` sides, `4 n - 4` triangles, or a cone, `2 n - 2`, when
    /// `top.1` is 0. `bottom` and `top` are (height, radius), the outline is that of [`circle`].
    pub(super) fn frustum(
        &mut self,
        material: Material,
        axis: DVec3,
        bottom: (f64, f64),
        top: (f64, f64),
        n: usize,
    ) {
        let outline = circle(n);
        let at = |k: usize, (y, r): (f64, f64)| {
            let (s, c) = outline[k % n];
            axis + DVec3::new(r * s, y, r * c)
        };
        for k in 0..n {
            if top.1 > 0.0 {
                self.quad(material, [at(k, bottom), at(k + 1, bottom), at(k + 1, top), at(k, top)]);
            } else {
                self.triangle(
                    material,
                    [at(k, bottom), at(k + 1, bottom), axis + DVec3::Y * top.0],
                );
            }
        }
        for k in 1..n - 1 {
            self.triangle(material, [at(0, bottom), at(k + 1, bottom), at(k, bottom)]);
            if top.1 > 0.0 {
                self.triangle(material, [at(0, top), at(k, top), at(k + 1, top)]);
            }
        }
    }

    /// A closed extrusion of a section between two chains of equally many points, `lower` and
    /// `upper`, that run side by side and may meet only at neither end. `place(p, end)` puts a
    /// section point (u, v) at the near (false) or far (true) end; seen from the near end, u
    /// points right and v up. `material(i)` is that of the upper chain's i-th edge, `rest` that of
    /// everything else.
    pub(super) fn extrude(
        &mut self,
        lower: &[(f64, f64)],
        upper: &[(f64, f64)],
        rest: Material,
        material: impl Fn(usize) -> Material,
        place: impl Fn((f64, f64), bool) -> DVec3,
    ) {
        assert_eq!(lower.len(), upper.len(), "chains have equally many points");
        let last = lower.len() - 1;
        let (near, far) = (|p| place(p, false), |p| place(p, true));
        for i in 0..last {
            let (l0, l1, u0, u1) = (lower[i], lower[i + 1], upper[i], upper[i + 1]);
            self.quad(rest, [near(l0), near(l1), near(u1), near(u0)]);
            self.quad(rest, [far(l1), far(l0), far(u0), far(u1)]);
            self.quad(rest, [near(l1), near(l0), far(l0), far(l1)]);
            self.quad(material(i), [near(u0), near(u1), far(u1), far(u0)]);
        }
        self.quad(rest, [near(lower[0]), near(upper[0]), far(upper[0]), far(lower[0])]);
        let (l, u) = (lower[last], upper[last]);
        self.quad(rest, [near(l), far(l), far(u), near(u)]);
    }

    /// A closed blob of 80 triangles: an icosahedron, divided once, with vertices pushed in or
    /// out by `radius(direction)`, metres.
    pub(super) fn blob(
        &mut self,
        material: Material,
        center: DVec3,
        mut radius: impl FnMut(DVec3) -> f64,
    ) {
        let g = f64::midpoint(1.0, 5f64.sqrt());
        let v = |x, y, z| DVec3::new(x, y, z).normalize();
        let base = [
            v(-1.0, g, 0.0),
            v(1.0, g, 0.0),
            v(-1.0, -g, 0.0),
            v(1.0, -g, 0.0),
            v(0.0, -1.0, g),
            v(0.0, 1.0, g),
            v(0.0, -1.0, -g),
            v(0.0, 1.0, -g),
            v(g, 0.0, -1.0),
            v(g, 0.0, 1.0),
            v(-g, 0.0, -1.0),
            v(-g, 0.0, 1.0),
        ];
        const FACES: [[usize; 3]; 20] = [
            [0, 11, 5],
            [0, 5, 1],
            [0, 1, 7],
            [0, 7, 10],
            [0, 10, 11],
            [1, 5, 9],
            [5, 11, 4],
            [11, 10, 2],
            [10, 7, 6],
            [7, 1, 8],
            [3, 9, 4],
            [3, 4, 2],
            [3, 2, 6],
            [3, 6, 8],
            [3, 8, 9],
            [4, 9, 5],
            [2, 4, 11],
            [6, 2, 10],
            [8, 6, 7],
            [9, 8, 1],
        ];
        // One radius a vertex: numbered by the pair of corners whose middle it is.
        let mut placed: HashMap<(usize, usize), DVec3> = HashMap::new();
        let mut at = |a: usize, b: usize| {
            *placed.entry((a.min(b), a.max(b))).or_insert_with(|| {
                let direction = (base[a.min(b)] + base[a.max(b)]).normalize();
                center + radius(direction) * direction
            })
        };
        for [a, b, c] in FACES {
            let [ab, bc, ca] = [at(a, b), at(b, c), at(c, a)];
            let [a, b, c] = [at(a, a), at(b, b), at(c, c)];
            for t in [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]] {
                self.triangle(material, t);
            }
        }
    }
}

/// (sin, cos) of `n` evenly spread angles: an outline that goes counter-clockwise seen from above
/// when used as (x, z).
pub(super) fn circle(n: usize) -> Vec<(f64, f64)> {
    (0..n).map(|k| super::random::sin_cos(std::f64::consts::TAU * k as f64 / n as f64)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every directed edge has its opposite exactly once, and the volume is positive.
    fn assert_closed(solid: &Solid) {
        let mut edges = HashMap::new();
        let mut volume = 0.0;
        for t in solid.parts.iter().flat_map(|p| &p.triangles) {
            for k in 0..3 {
                *edges.entry((t[k], t[(k + 1) % 3])).or_insert(0) += 1;
            }
            let [a, b, c] =
                t.map(|v| DVec3::from_array(solid.positions[v as usize].map(f64::from)));
            volume += a.dot(b.cross(c));
        }
        assert!(edges.iter().all(|(&(a, b), &n)| n == 1 && edges.get(&(b, a)) == Some(&1)));
        assert!(volume > 0.0, "fronts point outward");
    }

    #[test]
    fn closed_shapes_are_closed_and_face_outward() {
        let m = Material::Concrete;
        let mut s = Solid::new();
        s.cuboid(m, DVec3::ZERO, DVec3::ONE);
        assert_closed(&s);
        for top in [0.0, 0.5] {
            let mut s = Solid::new();
            s.frustum(m, DVec3::ZERO, (0.0, 1.0), (2.0, top), 7);
            assert_closed(&s);
        }
        let mut s = Solid::new();
        s.beam(m, DVec3::ZERO, DVec3::Z, DVec3::X, DVec3::Y);
        assert_closed(&s);
        let mut s = Solid::new();
        s.blob(m, DVec3::ONE, |d| 1.0 + 0.2 * d.y);
        assert_closed(&s);
        assert_eq!(s.triangle_count(), 80);
        let mut s = Solid::new();
        let (lower, upper) =
            ([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)], [(0.0, 1.0), (1.0, 2.0), (2.0, 1.0)]);
        s.extrude(
            &lower,
            &upper,
            m,
            |_| m,
            |(u, v), far| DVec3::new(u, v, if far { -3.0 } else { 0.0 }),
        );
        assert_closed(&s);
    }
}
