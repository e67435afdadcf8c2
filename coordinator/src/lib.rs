//! The coordinator: plans a bake, leases its tasks to workers, publishes the dataset.
//!
//! - [`prepare()`]: from a scene file and a configuration to a plan.
//! - [`Coordinator`]: runs a plan to its end, over gRPC.
//! - [`journal`]: what is in the store, who may write it, and what a crash leaves behind.
//! - [`dataset`]: from committed parts to a published dataset.
//!
//! The same library runs embedded in `sightline bake`, with a worker in the same process, and
//! alone in `sightline-coordinator`. It holds no state that the store does not: a coordinator can
//! be stopped at any moment and another started anywhere.

pub mod clock;
mod coordinator;
pub mod dataset;
mod error;
pub mod journal;
pub mod prepare;
mod service;
mod state;

pub use coordinator::{Coordinator, CoordinatorHandle, CoordinatorOptions, Summary};
pub use dataset::{DatasetPublisher, Publish};
pub use error::CoordinatorError;
pub use prepare::{PrepareError, Prepared, prepare, prepare_within};
