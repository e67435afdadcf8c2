//! The coordinator: plans a bake, leases its tasks to workers, publishes the dataset.
//!
//! - [`prepare()`]: from a scene file and a configuration to a plan.
//! - [`Coordinator`]: runs a plan to its end, over gRPC.
//! - [`journal`]: what is in the store, who may write it, and what a crash leaves behind.
//! - [`scene_files`]: scenes from object stores, and copies for workers.
//! - [`security`]: who may talk to it; [`metrics`]: what it counts.
//! - [`edit`]: what a bake can take over from an earlier one.
//! - [`dataset`]: from committed parts to a published dataset.
//! - [`health`]: the health service on a port of its own, for probes.
//!
//! The same library runs embedded in `sightline bake`, with a worker in the same process, and
//! alone in `sightline-coordinator`. It holds no state that the store does not: a coordinator can
//! be stopped at any moment and another started anywhere.

mod accept;
pub mod clock;
mod coordinator;
pub mod dataset;
pub mod edit;
mod error;
pub mod health;
pub mod journal;
pub mod metrics;
pub mod prepare;
mod scaler;
pub mod scene_files;
pub mod security;
mod service;
mod state;

pub use accept::ConnectionLimits;
pub use coordinator::{Coordinator, CoordinatorHandle, CoordinatorOptions, Summary};
pub use dataset::{DatasetPublisher, Publish};
pub use error::CoordinatorError;
pub use metrics::Metrics;
pub use prepare::{PrepareError, Prepared, prepare, prepare_from};
pub use scene_files::{SceneFilesError, ShareScene, fetch_scene, share_scene};
pub use security::{SecurityError, SecurityFlags, SecurityOptions, TlsFiles};
