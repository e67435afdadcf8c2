//! Axis-aligned boxes: exact ones in `f64` (world), rounded outward in `f32` (hierarchy nodes).

use bytemuck::{Pod, Zeroable};
use glam::{DAffine3, DVec3};

/// A closed axis-aligned box in `f64`, metres. Empty when any `min > max`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Lower corner.
    pub min: DVec3,
    /// Upper corner.
    pub max: DVec3,
}

impl Bounds {
    /// The empty box: the neutral element of [`Bounds::union`].
    pub const EMPTY: Self =
        Self { min: DVec3::splat(f64::INFINITY), max: DVec3::splat(f64::NEG_INFINITY) };

    /// The smallest box around `points`.
    pub fn of_points(points: impl IntoIterator<Item = DVec3>) -> Self {
        points.into_iter().fold(Self::EMPTY, |b, p| Self { min: b.min.min(p), max: b.max.max(p) })
    }

    /// The smallest box around both.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// True when the box holds no point.
    #[must_use]
    pub fn is_empty(self) -> bool {
        !self.min.cmple(self.max).all()
    }

    /// Centre of a non-empty box.
    #[must_use]
    pub fn center(self) -> DVec3 {
        0.5 * (self.min + self.max)
    }

    /// Edge lengths of a non-empty box.
    #[must_use]
    pub fn size(self) -> DVec3 {
        self.max - self.min
    }

    /// True when the closed boxes share a point.
    #[must_use]
    pub fn intersects(self, other: Self) -> bool {
        self.min.cmple(other.max).all() && other.min.cmple(self.max).all()
    }

    /// Bounds of the image of this box under an affine map.
    #[must_use]
    pub fn transformed(self, map: &DAffine3) -> Self {
        if self.is_empty() {
            return Self::EMPTY;
        }
        let center = map.transform_point3(self.center());
        let half = 0.5 * self.size();
        let m = map.matrix3;
        let extent = m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z;
        // Three products and sums an axis; gamma(8) covers them and the rounding of centre and half.
        let slack = crate::gamma(8) * (extent + center.abs() + map.translation.abs());
        Self { min: center - extent - slack, max: center + extent + slack }
    }
}

/// A closed axis-aligned box in `f32`, as hierarchy nodes store it.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Bounds32 {
    /// Lower corner.
    pub min: [f32; 3],
    /// Upper corner.
    pub max: [f32; 3],
}

impl Bounds32 {
    /// The smallest `f32` box that contains `bounds`: rounded outward.
    #[must_use]
    pub fn containing(bounds: Bounds) -> Self {
        let down = |v: f64| {
            let f = v as f32;
            if f64::from(f) > v { f.next_down() } else { f }
        };
        let up = |v: f64| {
            let f = v as f32;
            if f64::from(f) < v { f.next_up() } else { f }
        };
        Self { min: bounds.min.to_array().map(down), max: bounds.max.to_array().map(up) }
    }

    /// The smallest box around `f32` points (exact).
    pub fn of_points(points: impl IntoIterator<Item = [f32; 3]>) -> Self {
        let mut b = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };
        for p in points {
            b.min = std::array::from_fn(|k| b.min[k].min(p[k]));
            b.max = std::array::from_fn(|k| b.max[k].max(p[k]));
        }
        b
    }

    /// The smallest box around both.
    #[inline(always)]
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        let mut out = *self;
        for k in 0..3 {
            // Finite numbers or infinities: one instruction each, unlike `f32::min`.
            out.min[k] = if other.min[k] < out.min[k] { other.min[k] } else { out.min[k] };
            out.max[k] = if other.max[k] > out.max[k] { other.max[k] } else { out.max[k] };
        }
        out
    }

    /// True when the box holds no point.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        (0..3).any(|k| self.min[k] > self.max[k])
    }

    /// Half the surface area; in `f64`, where it neither over- nor underflows. 0 for the empty box.
    #[must_use]
    pub fn half_area(&self) -> f64 {
        let [x, y, z] = [0, 1, 2].map(|k| f64::from(self.max[k]) - f64::from(self.min[k]));
        if x < 0.0 { 0.0 } else { x * y + y * z + z * x }
    }

    /// The same box in `f64`.
    #[must_use]
    pub fn widen(self) -> Bounds {
        Bounds {
            min: DVec3::from_array(self.min.map(f64::from)),
            max: DVec3::from_array(self.max.map(f64::from)),
        }
    }
}
