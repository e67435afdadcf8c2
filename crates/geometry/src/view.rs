//! Where viewers stand: view cells, and the segments that are solved for them.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::{Bounds, CellId, SegmentId};

/// A straight camera path, v(t) = v0 + t (v1 - v0), t in [0, 1]. World space, metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewSegment {
    /// Number in the plan.
    pub id: SegmentId,
    /// Start point.
    pub v0: DVec3,
    /// End point, different from `v0`.
    pub v1: DVec3,
}

/// A place to stand: a prism over a quadrilateral footprint that follows the ground.
///
/// Nothing may assume that cells form a grid. The corners go round the footprint (seen from
/// above, in order of ascending x + then z: (x0,z0), (x1,z0), (x1,z1), (x0,z1) for a tile); their
/// heights are those of the lowest eye position. The surface between them is bilinear.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewCell {
    /// Number in the dataset, in Hilbert order.
    pub id: CellId,
    /// Corners at the lower eye height, going round the footprint. World space, metres.
    pub corners: [DVec3; 4],
    /// Distance from the lower to the upper eye height, metres, >= 0.
    pub height: f64,
}

impl ViewCell {
    /// The viewpoint at footprint coordinates `(u, v)` and relative height `h`, each in [0, 1].
    #[must_use]
    pub fn viewpoint(&self, u: f64, v: f64, h: f64) -> DVec3 {
        let [a, b, c, d] = self.corners;
        let low = (1.0 - v) * ((1.0 - u) * a + u * b) + v * ((1.0 - u) * d + u * c);
        low + DVec3::Y * (h * self.height)
    }

    /// Height of the lower surface at a point's x and z (bilinear over the footprint's box).
    #[must_use]
    pub fn floor_below(&self, point: DVec3) -> f64 {
        let b = Bounds::of_points(self.corners);
        let size = b.size();
        let share = |p: f64, low: f64, size: f64| if size > 0.0 { (p - low) / size } else { 0.0 };
        self.viewpoint(share(point.x, b.min.x, size.x), share(point.z, b.min.z, size.z), 0.0).y
    }

    /// Centre of the cell.
    #[must_use]
    pub fn center(&self) -> DVec3 {
        self.viewpoint(0.5, 0.5, 0.5)
    }

    /// World box of the cell.
    #[must_use]
    pub fn bounds(&self) -> Bounds {
        let low = Bounds::of_points(self.corners);
        Bounds { min: low.min, max: low.max + DVec3::Y * self.height }
    }

    /// True when `point` is in the cell; the footprint is taken as its box in x and z.
    #[must_use]
    pub fn contains(&self, point: DVec3) -> bool {
        let b = self.bounds();
        if point.x < b.min.x || point.x > b.max.x || point.z < b.min.z || point.z > b.max.z {
            return false;
        }
        let low = self.floor_below(point);
        (low..=low + self.height).contains(&point.y)
    }
}
