//! The error bounds of the solver, derived once and used by every comparison.
//!
//! Let u be the unit roundoff and S a bound on |P - v0| over the scene, so that every face
//! coordinate x, y, z of a vertex is at most S. Let R be the geometry's `placement_reach`: a vertex
//! is `M p + T`, and `|M| |p|` is at most R. For meshes that stand far from their own origin R is
//! larger than S, and T cancels it.
//!
//! - *Vertex*: `x = m . p + b` with a composed matrix row m (3 products of 3 terms: 5 roundings
//!   an entry) and offset b (T - v0 and 3 products: 6), then 3 products and 3 sums. The terms of
//!   m . p add up to at most R, since m is a unit vector times M; those of b to at most
//!   |T - v0| <= S + R. The error is at most gamma(12) (S + 2 R).
//! - *Cut*: h = y - w z adds 2 roundings; lambda = hP / (hP - hQ) is a convex weight; its error
//!   moves the cut point along the edge, by at most the error of h over the edge's slope against
//!   the row plane. Along the edge that is a point of the true triangle displaced *within* the
//!   edge's own line, so the cut stays within gamma(12) (S + 2 R) of the true edge, plus gamma(4) S
//!   for the interpolation: gamma(16) S + gamma(24) R off the line in all.
//! - *Depth*: z of a cut at t is interpolated between its ends: 4 u S more, and the error of t
//!   times the slope of the cut.
//! - *Motion*: a vertex between two key frames is (1 - t) a + t b, 3 roundings of terms of at most S, so
//!   gamma(15) (S + 2 R) in all; centres of particles likewise. What follows for cuts and ends then is
//!   gamma(19) S + gamma(30) R.
//! - *Time*: t = (x - c z) / L: (gamma(19) S + gamma(24) R) (1 + |c|) / L.
//!
//! All are rounded up to gamma(32) (S + R), which leaves room for the second-order terms.

use sightline_geometry::{InstancedGeometry, RectifiedFrame, gamma};

/// Bounds on the rounding errors of one segment's solve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorBounds {
    /// Largest error of a face coordinate or of a depth at exact t, metres.
    pub depth: f64,
    /// `time * (1 + |c|)` is the largest error of an interval's end at column c, in units of t.
    time_per_column: f64,
}

impl ErrorBounds {
    /// The bounds for a scene and a segment's frame.
    #[must_use]
    pub fn new(scene: &InstancedGeometry, frame: &RectifiedFrame) -> Self {
        let reach = if scene.bounds.is_empty() {
            frame.length
        } else {
            let (min, max) = (scene.bounds.min - frame.v0, scene.bounds.max - frame.v0);
            min.abs().max(max.abs()).length() + frame.length + scene.placement_reach
        };
        let depth = gamma(32) * reach;
        Self { depth, time_per_column: depth / frame.length }
    }

    /// Largest error of an interval's end at column `c`, in units of t.
    #[must_use]
    pub fn time(&self, c: f64) -> f64 {
        self.time_per_column * (1.0 + c.abs())
    }

    /// Intervals up to this length (units of t) may be rounding alone: both ends may be off.
    #[must_use]
    pub fn shortest_interval(&self, c: f64) -> f64 {
        2.0 * self.time(c)
    }
}
