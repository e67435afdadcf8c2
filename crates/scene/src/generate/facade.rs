//! Walls of a rectangular building as one closed surface: rows of windows and doors, profiles
//! such as cornices, a roof and a floor.
//!
//! The surface is a stack of *loops*. A loop goes round the footprint at one height and one
//! distance `out` from the wall plane, and has a vertex on every column line of every side, so
//! neighbouring bands, sides and corners share their vertices. A band between two loops on the
//! wall plane is cut into cells, one a column; an opening in a cell is a sequence of nested
//! rectangles at changing depth, which is closed by construction.
//!
//! Sides are numbered 0: +z, 1: +x, 2: -z, 3: -x; seen from outside, columns go from left to
//! right.

use glam::DVec3;

use super::material::Material;
use super::solid::Solid;

/// A rectangle on the ground, metres.
#[derive(Clone, Copy, Debug)]
pub(super) struct Footprint {
    pub(super) x: [f64; 2],
    pub(super) z: [f64; 2],
}

impl Footprint {
    /// The rectangle with every side moved inward.
    pub(super) fn shrunk(self, by: f64) -> Self {
        Self { x: [self.x[0] + by, self.x[1] - by], z: [self.z[0] + by, self.z[1] - by] }
    }

    /// Length of a side.
    pub(super) fn length(self, side: usize) -> f64 {
        let [lo, hi] = if side.is_multiple_of(2) { self.x } else { self.z };
        hi - lo
    }
}

/// One rectangle of an opening: distances from the cell's left, right, lower and upper border,
/// and the distance from the wall plane (negative inside), metres. `material` is that of the
/// surface between it and the rectangle before.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ring {
    pub(super) left: f64,
    pub(super) right: f64,
    pub(super) low: f64,
    pub(super) high: f64,
    pub(super) out: f64,
    pub(super) material: Material,
}

impl Ring {
    /// The same rectangle at another depth, joined to this one by `material`.
    pub(super) fn moved(self, out: f64, material: Material) -> Self {
        Self { out, material, ..self }
    }

    /// The rectangle grown by `by` on every side (shrunk when negative), at the same depth.
    pub(super) fn grown(self, by: f64, material: Material) -> Self {
        Self {
            left: self.left - by,
            right: self.right - by,
            low: self.low - by,
            high: self.high - by,
            material,
            ..self
        }
    }
}

/// The column lines of a building's four sides.
pub(super) struct Walls {
    footprint: Footprint,
    lines: [Vec<f64>; 4],
}

/// +1 where columns go along the positive axis, -1 where they go against it.
const DIRECTION: [f64; 4] = [1.0, -1.0, -1.0, 1.0];

impl Walls {
    /// Evenly spaced columns, `columns[side] >= 1` on each side.
    pub(super) fn new(footprint: Footprint, columns: [usize; 4]) -> Self {
        let lines = std::array::from_fn(|side| {
            let [lo, hi] = if side % 2 == 0 { footprint.x } else { footprint.z };
            let [from, to] = if DIRECTION[side] > 0.0 { [lo, hi] } else { [hi, lo] };
            let n = columns[side];
            let step = (to - from) / n as f64;
            // The ends are exact, so that sides meet in the same corners.
            (0..=n).map(|k| if k == n { to } else { from + step * k as f64 }).collect()
        });
        Self { footprint, lines }
    }

    fn columns(&self, side: usize) -> usize {
        self.lines[side].len() - 1
    }

    /// A point of a side: coordinate along its axis, height, distance from the wall plane.
    fn point(&self, side: usize, along: f64, y: f64, out: f64) -> DVec3 {
        let Footprint { x, z } = self.footprint;
        match side {
            0 => DVec3::new(along, y, z[1] + out),
            1 => DVec3::new(x[1] + out, y, along),
            2 => DVec3::new(along, y, z[0] - out),
            _ => DVec3::new(x[0] - out, y, along),
        }
    }

    /// Vertex `k` of a side of the loop at height `y` and distance `out`.
    fn on_loop(&self, side: usize, k: usize, (y, out): (f64, f64)) -> DVec3 {
        let mut along = self.lines[side][k];
        if k == 0 {
            along -= DIRECTION[side] * out;
        } else if k == self.columns(side) {
            along += DIRECTION[side] * out;
        }
        self.point(side, along, y, out)
    }

    /// The surface between two loops, given as (height, out), from the lower or outer one on.
    pub(super) fn band(
        &self,
        solid: &mut Solid,
        material: Material,
        from: (f64, f64),
        to: (f64, f64),
    ) {
        for side in 0..4 {
            for k in 0..self.columns(side) {
                let corner = |k, l| self.on_loop(side, k, l);
                solid.quad(
                    material,
                    [corner(k, from), corner(k + 1, from), corner(k + 1, to), corner(k, to)],
                );
            }
        }
    }

    /// Bands along a profile of loops.
    pub(super) fn profile(&self, solid: &mut Solid, material: Material, loops: &[(f64, f64)]) {
        for pair in loops.windows(2) {
            self.band(solid, material, pair[0], pair[1]);
        }
    }

    /// Closes the surface with a flat roof at a loop.
    pub(super) fn roof(&self, solid: &mut Solid, material: Material, at: (f64, f64)) {
        self.fan(solid, material, at, true);
    }

    /// Closes the surface with a floor at height `y`.
    pub(super) fn floor(&self, solid: &mut Solid, material: Material, y: f64) {
        self.fan(solid, material, (y, 0.0), false);
    }

    fn fan(&self, solid: &mut Solid, material: Material, at: (f64, f64), up: bool) {
        let Footprint { x, z } = self.footprint;
        let center = DVec3::new(0.5 * (x[0] + x[1]), at.0, 0.5 * (z[0] + z[1]));
        for side in 0..4 {
            for k in 0..self.columns(side) {
                let (a, b) = (self.on_loop(side, k, at), self.on_loop(side, k + 1, at));
                solid.triangle(material, if up { [a, b, center] } else { [b, a, center] });
            }
        }
    }

    /// Closes the surface with a gable over the wall plane at height `y`: the ridge, at
    /// `ridge_y`, runs along x when `along_x`. The sides along the ridge must have equally many
    /// columns.
    pub(super) fn gable(
        &self,
        solid: &mut Solid,
        wall: Material,
        roof: Material,
        (y, ridge_y): (f64, f64),
        along_x: bool,
    ) {
        let Footprint { x, z } = self.footprint;
        let first = usize::from(!along_x);
        let n = self.columns(first);
        assert_eq!(n, self.columns(first + 2), "equally many columns beside the ridge");
        let ridge = |along: f64| {
            if along_x {
                DVec3::new(along, ridge_y, 0.5 * (z[0] + z[1]))
            } else {
                DVec3::new(0.5 * (x[0] + x[1]), ridge_y, along)
            }
        };
        for side in 0..4 {
            for k in 0..self.columns(side) {
                let (a, b) = (self.on_loop(side, k, (y, 0.0)), self.on_loop(side, k + 1, (y, 0.0)));
                if side % 2 == first {
                    // Column lines of the opposite side are taken in reverse: the ridge has one
                    // vertex for both.
                    let at = |k: usize| {
                        let k = if side == first { k } else { n - k };
                        ridge(self.lines[first][k])
                    };
                    solid.quad(roof, [a, b, at(k + 1), at(k)]);
                } else {
                    // A gable end stands at the right end of the side before it.
                    let before = (side + 3) % 4;
                    let end = if before == first { n } else { 0 };
                    solid.triangle(wall, [a, b, ridge(self.lines[first][end])]);
                }
            }
        }
    }

    /// The band between the heights `y.0` and `y.1` on the wall plane, cut into cells.
    /// `opening(side, column, width)` gives the rectangles of the cell's opening, outermost
    /// first, and the material of its pane; without rectangles the cell is a plain wall of the
    /// pane's material.
    pub(super) fn row(
        &self,
        solid: &mut Solid,
        y: (f64, f64),
        mut opening: impl FnMut(usize, usize, f64) -> (Vec<Ring>, Material),
    ) {
        for side in 0..4 {
            for k in 0..self.columns(side) {
                let (rings, pane) = opening(side, k, self.width(side));
                let mut before = self.cell_corners(side, k, y, None);
                for ring in &rings {
                    let next = self.cell_corners(side, k, y, Some(ring));
                    for i in 0..4 {
                        let j = (i + 1) % 4;
                        solid.quad(ring.material, [before[i], before[j], next[j], next[i]]);
                    }
                    before = next;
                }
                solid.quad(pane, before);
            }
        }
    }

    /// Width of the columns of a side.
    pub(super) fn width(&self, side: usize) -> f64 {
        self.footprint.length(side) / self.columns(side) as f64
    }

    fn cell_corners(
        &self,
        side: usize,
        k: usize,
        y: (f64, f64),
        ring: Option<&Ring>,
    ) -> [DVec3; 4] {
        let (left, right) = (self.lines[side][k], self.lines[side][k + 1]);
        let d = DIRECTION[side];
        let (left, right, low, high, out) = match ring {
            None => (left, right, y.0, y.1, 0.0),
            Some(r) => (left + d * r.left, right - d * r.right, y.0 + r.low, y.1 - r.high, r.out),
        };
        [(left, low), (right, low), (right, high), (left, high)]
            .map(|(along, y)| self.point(side, along, y, out))
    }

    /// A closed box on a cell: `across` from its left border, `y` absolute, `out` from the wall plane.
    pub(super) fn cell_box(
        &self,
        solid: &mut Solid,
        material: Material,
        (side, k): (usize, usize),
        across: (f64, f64),
        y: (f64, f64),
        out: (f64, f64),
    ) {
        let along = |a: f64| self.lines[side][k] + DIRECTION[side] * a;
        let p = self.point(side, along(across.0), y.0, out.0);
        let q = self.point(side, along(across.1), y.1, out.1);
        solid.cuboid(material, p, q);
    }
}
