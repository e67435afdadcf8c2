//! Spaces, view cells, primitive sets, and instanced geometry with its hierarchies.
//!
//! This is the vocabulary that the solver, the scene reader, the store and the quality
//! measurement share. It knows no file format, does no I/O and keeps no global state.
//!
//! Spaces:
//! - *world*: glTF world space of the scene, metres, right-handed, +Y up, `f64`.
//! - *mesh*: the space of one mesh's vertices, `f32` as stored in the file.
//! - *frame*: the rectified frame of a view segment ([`RectifiedFrame`]), `f64`.
//!
//! Global invariants that code, tests and documents quote:
//! - VI-1: the intervals of a pixel are sorted and disjoint.
//! - VI-2: closed meshes do not leak.
//! - VI-3: output does not depend on worker, thread count or order.

mod array;
mod bounds;
mod frame;
mod hierarchy;
mod ids;
mod instanced;
pub mod motion;
pub mod overlap;
mod particles;
pub mod raycast;
mod residency;
mod set;
mod state_sets;
mod timeline;
mod units;
mod view;
mod wide;

pub use array::{Array, Holder};
pub use bounds::{Bounds, Bounds32};
pub use frame::{FACE_COUNT, Face, RectifiedFrame, Sampling};
pub use hierarchy::{Hierarchy, Node};
pub use ids::{CellId, InstanceId, MeshId, ObjectId, PrimitiveId, SegmentId};
pub use instanced::{
    Instance, InstancedGeometry, Mesh, MeshMotion, MovingLevel, Place, Shape, TopLevel, Triangle,
};
pub use motion::{Moment, MovingHierarchy, MovingNode};
pub use particles::{ParticleSystem, Sphere};
pub use raycast::{Hit, Ray};
pub use residency::{Residency, STEPS};
pub use set::{PrimitiveSet, Run};
pub use state_sets::StateSets;
pub use timeline::Timeline;
pub use units::{CLUSTER_PRIMITIVES, Granularity, Units};
pub use view::{ViewCell, ViewSegment};
pub use wide::WideNode;

/// Unit roundoff of `f64`, 2^-53: the relative error of one correctly rounded operation.
pub const UNIT_ROUNDOFF: f64 = f64::EPSILON / 2.0;

/// `gamma(n) = n u / (1 - n u)`: bounds the relative error of a chain of `n` roundings.
///
/// Source: Higham, "Accuracy and Stability of Numerical Algorithms", lemma 3.1.
#[must_use]
pub const fn gamma(roundings: u32) -> f64 {
    let nu = roundings as f64 * UNIT_ROUNDOFF;
    nu / (1.0 - nu)
}
