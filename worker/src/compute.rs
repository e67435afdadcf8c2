//! Where the computation of a task runs: a seam, so that a simulation can run the real worker on a
//! simulated clock.

use std::time::{Duration, Instant};

use bytes::Bytes;
use sightline_jobs::TaskId;
use sightline_store::PartKind;

use crate::error::AttemptError;
use crate::pool::SolvePool;

/// A part that is ready to be written.
pub type Part = (PartKind, Bytes);

/// What a task gives.
#[derive(Clone, Debug, Default)]
pub struct Output {
    /// The parts.
    pub parts: Vec<Part>,
    /// Segments or cells that were taken over from an earlier bake.
    pub reused: u32,
}

/// The computation of a task: from what was read to the parts, a function of the plan and the scene.
pub type Job = Box<dyn FnOnce() -> Result<Output, AttemptError> + Send>;

/// What a computation gave.
#[derive(Clone, Debug)]
pub struct Computed {
    /// What the task gives.
    pub output: Output,
    /// Time spent.
    pub took: Duration,
}

/// Runs computations.
#[tonic::async_trait]
pub trait Compute: Send + Sync {
    /// Runs the computation of a task. Dropping the future gives it up.
    ///
    /// # Errors
    /// Those of the job; [`AttemptError::Panic`] when it panics.
    async fn compute(&self, task: TaskId, job: Job) -> Result<Computed, AttemptError>;
}

#[tonic::async_trait]
impl Compute for SolvePool {
    async fn compute(&self, _: TaskId, job: Job) -> Result<Computed, AttemptError> {
        let timed = || {
            let start = Instant::now();
            job().map(|output| Computed { output, took: start.elapsed() })
        };
        self.run(timed).await?
    }
}
