//! The worker: leases tasks, solves them, writes the results.
//!
//! - [`Worker`]: registers with a coordinator, works until the bake is over.
//! - [`compute`]: where the computation of a task runs.
//! - [`scene_files`]: the scene on a machine that may not have it.
//! - [`solve`]: what a task computes; a pure function of scene, plan and the rows it reads.
//! - [`trace`]: what its results depend on, for a later bake of an edited scene.
//! - [`security`]: how it shows who it is; [`metrics`]: what it counts.
//!
//! Solving runs on a thread pool of its own, never on the runtime that talks to the coordinator,
//! so heartbeats are on time however long a task takes. What a worker may write, and what a crash
//! leaves behind, is described in `sightline_coordinator::journal`.

mod attempt;
mod cache;
mod cell;
pub mod compute;
mod connection;
mod error;
mod join;
pub mod metrics;
mod pool;
mod reuse;
pub mod scene_files;
pub mod security;
pub mod solve;
pub mod trace;
mod weights;
mod worker;

pub use error::{AttemptError, WorkerError};
pub use metrics::Metrics;
pub use scene_files::{SceneAccess, SceneOnDisk};
pub use security::{ClientSecurity, Dial};
pub use worker::{Worker, WorkerOptions, WorkerSummary};
