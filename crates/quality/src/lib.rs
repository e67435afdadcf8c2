//! Pixel error of visible sets against the full scene, by casting rays.
//!
//! The *pixel error* of a set at a viewpoint is the share of all directions (uniform over the
//! sphere) in which the picture of the set differs from the picture of the full scene. A ray is
//! *wrong* when
//! - its nearest occluder of the full scene, at distance d, is not in the set, and the nearest
//!   occluder of the set is farther than d or there is none; or
//! - a see-through primitive nearer than d is not in the set, and no see-through primitive of
//!   the set is at the same depth.
//!
//! Where something moves, a ray is cast at a moment, and *the set* is that of the moment's state. The
//! error of a cell is then the mean over its viewpoints and the time of the states that are measured.
//!
//! *Same depth* and *farther* are meant up to a bound that is derived in `depth_tie`: a tie of
//! coplanar primitives is no error.
//!
//! The measurement shares no code with the solver: it walks the hierarchies of the geometry with
//! [`sightline_geometry::raycast::RayCaster`] in `f64`. It is a function of geometry, set,
//! viewpoint, number of rays and seed alone: thread count and machine do not matter (VI-3). So
//! no function of the platform's maths library is used, only operations that IEEE 754 rounds
//! correctly.

mod affected;
mod depth_tie;
mod directions;
mod measure;
mod membership;
mod scattered;
mod seed;
mod sequential;

pub use affected::Newcomers;
pub use depth_tie::ties;
pub use measure::{
    CellError, ViewpointError, measure_cell, measure_cell_over, measure_viewpoint,
    measure_viewpoint_at, measure_viewpoints_at, random_viewpoints,
};
pub use membership::{Members, StateMembers};
pub use scattered::{
    SCATTERED_BATCH, Scattered, Suspect, measure_scattered, measure_scattered_over,
};
pub use seed::{SplitMix64, viewpoint_seed};
pub use sequential::{ErrorTest, Verdict};
