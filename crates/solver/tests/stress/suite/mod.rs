//! The numerical stress suite: scenes made to break floating point, and what judges the solver.
//!
//! Three layers look at every pixel of a case:
//!
//! 1. The solver, through its public interface: a set and the weights of its members.
//! 2. [`twin`]: every triangle against every pixel in `f64`, without hierarchy or culling. For
//!    each primitive it gives a weight that it has for certain, one that it cannot exceed, and
//!    the name of the bound that keeps the two apart.
//! 3. [`exact`]: single pixels in rational arithmetic, for what the second layer leaves open, and
//!    for samples of what it is sure of.
//!
//! [`verdict`] compares them. A disagreement is *explained* when a derived bound covers it: the
//! solver's weight lies between what the twin is sure of and what it allows. Anything else is
//! *unexplained*, and a bug of the solver or of the twin.
//!
//! [`families`] and [`closed`] hold the scenes: functions of a seed, in one table. Closed meshes
//! have no bound to hide behind: what they enclose or keep out is never found, not once.

pub mod case;
pub mod closed;
pub mod determinism;
pub mod exact;
pub mod families;
pub mod random;
pub mod twin;
pub mod verdict;
