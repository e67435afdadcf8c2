//! The rectified frame of a view segment: image rows are epipolar planes.
//!
//! Source: DESIGN "From-segment solver", section 2.1. The axis `s` is the unit direction of the
//! segment, L its length, (s, a, b) orthonormal. Four faces look along +a, +b, -a, -b. For a
//! face with forward f and up g, a point P has
//!
//! ```text
//! x = (P - v0).s      y = (P - v0).g      z = (P - v0).f
//! ```
//!
//! and a pixel is (c, w): its ray from v(t) is x = t L + c z, y = w z, z > 0. Row w is the plane
//! y = w z for every t. Columns run over the whole line: |c| <= 1 with uniform spacing, beyond
//! it c = 1/k with k uniform in (0, 1), which takes the place of the end faces of a cube map.

use glam::{DMat3, DVec3};

use crate::ViewSegment;

/// Faces of a rectified frame.
pub const FACE_COUNT: usize = 4;

/// One of the four faces of a rectified frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Face {
    /// Unit direction of the segment, s.
    pub axis: DVec3,
    /// Up, g.
    pub up: DVec3,
    /// Forward, f.
    pub forward: DVec3,
}

impl Face {
    /// Face coordinates (x, y, z) of a vector relative to v0: the rows are s, g, f.
    #[must_use]
    pub fn face_from_world(&self) -> DMat3 {
        DMat3::from_cols(self.axis, self.up, self.forward).transpose()
    }
}

/// The frame of one segment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RectifiedFrame {
    /// Start of the segment, world space.
    pub v0: DVec3,
    /// Length of the segment, metres.
    pub length: f64,
    axis: DVec3,
    a: DVec3,
    b: DVec3,
}

impl RectifiedFrame {
    /// The frame of a segment; `None` when the segment has no length.
    #[must_use]
    pub fn new(segment: &ViewSegment) -> Option<Self> {
        let d = segment.v1 - segment.v0;
        let length = d.length();
        if !(length > 0.0 && length.is_finite()) {
            return None;
        }
        let axis = d / length;
        // The world axis least aligned with s gives the best conditioned cross product.
        let helper = if axis.y.abs() <= axis.x.abs().max(axis.z.abs()) {
            DVec3::Y
        } else if axis.x.abs() <= axis.z.abs() {
            DVec3::X
        } else {
            DVec3::Z
        };
        let a = axis.cross(helper).normalize();
        let b = axis.cross(a).normalize();
        Some(Self { v0: segment.v0, length, axis, a, b })
    }

    /// The face with number `face` in `0..FACE_COUNT`: forward +a, +b, -a, -b.
    #[must_use]
    pub fn face(&self, face: usize) -> Face {
        let (forward, up) = match face {
            0 => (self.a, self.b),
            1 => (self.b, -self.a),
            2 => (-self.a, -self.b),
            _ => (-self.b, self.a),
        };
        Face { axis: self.axis, up, forward }
    }
}

/// The border of the first column is the axis itself, which is no direction of a face: rays keep
/// away from borders by this part of a pixel.
const LEAST_PHASE: f64 = 1.0 / 1024.0;

/// The pixel grid of a face, with one ray a pixel: at its centre, or [jittered](Self::jittered).
///
/// Rows and columns are not alike. What lies between two rows is not seen from anywhere on the
/// segment. What lies between two columns may be: while the viewpoint moves by L, a column sweeps
/// over L metres of its row's plane. docs/adr/0007 has the measurements.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sampling {
    rows: u32,
    columns: u32,
    row_phase: f64,
    column_phase: f64,
}

impl Sampling {
    /// `rows` rows and as many columns a face. Columns cover twice the angle of rows.
    #[must_use]
    pub fn new(rows: u32) -> Self {
        Self::with_columns(rows, rows)
    }

    /// `rows` rows and `columns` columns a face; both are rounded up to a multiple of 4, at least
    /// 4.
    #[must_use]
    pub fn with_columns(rows: u32, columns: u32) -> Self {
        let round = |n: u32| n.max(4).next_multiple_of(4);
        Self { rows: round(rows), columns: round(columns), row_phase: 0.5, column_phase: 0.5 }
    }

    /// The same grid with its rays elsewhere in their pixels: number `run` of a sequence of grids
    /// whose rows, and columns, are spread evenly together. Run 0 has its rays in the centres.
    ///
    /// Segments that are solved on different runs find more together: on one line they would
    /// share their rows, and what lies between two rows is seen by none of them.
    ///
    /// Source: the additive recurrence R2 (Roberts, "The Unreasonable Effectiveness of
    /// Quasirandom Sequences").
    #[must_use]
    pub fn jittered(self, run: u32) -> Self {
        const PLASTIC: f64 = 1.324_717_957_244_746;
        let phase = |step: f64| (0.5 + f64::from(run) * step).fract().max(LEAST_PHASE);
        let (row_phase, column_phase) = (phase(1.0 / PLASTIC), phase(1.0 / (PLASTIC * PLASTIC)));
        Self { row_phase, column_phase, ..self }
    }

    /// Twice as many rows and columns, whose rays are not where those of this grid are but as far
    /// from them as they can be.
    #[must_use]
    pub fn finer(self) -> Self {
        let phase = |coarse: f64| (2.0 * coarse + 0.5).fract().max(LEAST_PHASE);
        Self {
            rows: 2 * self.rows,
            columns: 2 * self.columns,
            row_phase: phase(self.row_phase),
            column_phase: phase(self.column_phase),
        }
    }

    /// The coordinate w of the rays of row `i`.
    #[must_use]
    pub fn row(&self, i: u32) -> f64 {
        self.w(f64::from(i) + self.row_phase)
    }

    /// The coordinate c of the rays of column `j`.
    #[must_use]
    pub fn column(&self, j: u32) -> f64 {
        self.c(f64::from(j) + self.column_phase)
    }

    /// Number of rows a face, N.
    #[must_use]
    pub const fn rows(&self) -> u32 {
        self.rows
    }

    /// Number of columns a face, M.
    #[must_use]
    pub const fn columns(&self) -> u32 {
        self.columns
    }

    /// The row coordinate w at pixel coordinate `i` in [0, N]: the borders of row k are at `k` and
    /// `k + 1`. In [-1, 1], ascending.
    #[must_use]
    pub fn w(&self, i: f64) -> f64 {
        2.0 * i / f64::from(self.rows) - 1.0
    }

    /// The column coordinate c at pixel coordinate `j` in [0, M], ascending from -inf to +inf:
    /// M/4 columns of c = 1/k on either side, M/2 columns of uniform c between.
    #[must_use]
    pub fn c(&self, j: f64) -> f64 {
        let m = f64::from(self.columns);
        let quarter = m / 4.0;
        if j < quarter {
            // k runs from 0 (c = -inf) to 1 (c = -1).
            -(quarter / j)
        } else if j <= m - quarter {
            (j - quarter) / quarter - 1.0
        } else {
            quarter / (m - j)
        }
    }

    /// Solid angle of a rectangle of directions (c0..c1) x (w0..w1) on the plane z = 1, in
    /// steradians. Source: closed form of the integral of (1 + c^2 + w^2)^(-3/2).
    #[must_use]
    pub fn solid_angle(c0: f64, c1: f64, w0: f64, w1: f64) -> f64 {
        let corner = |c: f64, w: f64| {
            // atan(c w / sqrt(1 + c^2 + w^2)), with its limit for c = +-inf.
            if c.is_infinite() {
                libm::atan(c.signum() * w)
            } else {
                libm::atan(c * w / (1.0 + c * c + w * w).sqrt())
            }
        };
        corner(c1, w1) - corner(c0, w1) - corner(c1, w0) + corner(c0, w0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SegmentId;

    fn frame(d: DVec3) -> RectifiedFrame {
        let v0 = DVec3::new(3.0, -2.0, 7.0);
        RectifiedFrame::new(&ViewSegment { id: SegmentId(0), v0, v1: v0 + d }).unwrap()
    }

    #[test]
    fn faces_are_orthonormal_and_right_handed_for_any_direction() {
        for d in [DVec3::X, DVec3::Y, DVec3::Z, DVec3::new(1.0, 2.0, -3.0), -DVec3::Y * 1e-3] {
            for k in 0..FACE_COUNT {
                let f = frame(d).face(k);
                let m = f.face_from_world();
                let identity = m * m.transpose();
                assert!((identity - DMat3::IDENTITY).abs_diff_eq(DMat3::ZERO, 1e-14));
                assert!((f.axis.cross(f.up).dot(f.forward).abs() - 1.0).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn four_faces_cover_the_sphere_of_directions_once() {
        let s = Sampling::new(16);
        let mut total = 0.0;
        for row in 0..s.rows() {
            for col in 0..s.columns() {
                let (i, j) = (f64::from(row), f64::from(col));
                total += Sampling::solid_angle(s.c(j), s.c(j + 1.0), s.w(i), s.w(i + 1.0));
            }
        }
        let sphere = 4.0 * std::f64::consts::PI;
        assert!((4.0 * total - sphere).abs() < 1e-12 * sphere);
    }

    #[test]
    fn columns_ascend_over_the_whole_line() {
        let s = Sampling::with_columns(10, 22);
        assert_eq!((s.rows(), s.columns()), (12, 24));
        let c: Vec<f64> = (0..=24).map(|j| s.c(f64::from(j))).collect();
        assert!(c.windows(2).all(|w| w[0] < w[1]));
        assert_eq!((c[0], c[24]), (f64::NEG_INFINITY, f64::INFINITY));
    }
}
