//! From-segment visibility: which triangles can be seen while the viewpoint moves along a segment.
//!
//! Source: Popescu, Lee, Choi, Fahmy, "Complex VEs on All-In-One VR Headsets Through Continuous
//! From-Segment Visibility Computation". For each pixel of an all-round image the algorithm keeps
//! the list of visibility intervals along the segment; the result is all and only the primitives
//! visible at the pixel centres as the camera translates. We keep that result and reach it in a
//! rectified frame whose image rows are epipolar planes ([`sightline_geometry::RectifiedFrame`]):
//! a row is a problem in a plane, a triangle cuts it in one line segment (a [`cut::Cut`]), a pixel
//! is the lower envelope of line segments in (t, z) ([`envelope`]), and a hierarchy is walked
//! front to back against what has been found (`tile`).
//!
//! Guarantees:
//! - VI-1: a pixel's intervals are sorted and disjoint.
//! - VI-2: closed meshes do not leak: both triangles of an edge get the same bits for its cut.
//! - VI-3: the result depends on geometry, segment and sampling alone, not on threads. Weights
//!   are summed as integers, so their order does not matter.
//! - An interval counts only when it is longer than the derived bound on the error of its ends
//!   ([`bounds`]), so rounding never makes a primitive visible.
//!
//! [`mod@reference`] solves the same definition in exact rational arithmetic, with no culling and no
//! floats; the tests compare the two.

mod affected;
pub mod arc;
pub mod bernstein;
pub mod bounds;
pub mod cut;
pub mod envelope;
mod lists;
pub mod moving;
pub mod quadratic;
pub mod reference;
mod segment;
mod states;
mod tile;

pub use affected::{Added, is_affected};
pub use lists::{Pixel, visit_intervals};
pub use segment::{
    SegmentTrace, SegmentVisibility, SolveOptions, Statistics, solve_segment, solve_segment_with,
};
pub use states::{Known, StateVisibility, TimePath, solve_states};
