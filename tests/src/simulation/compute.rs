//! Computations that take simulated time. What they give is computed once a process and remembered: it
//! is a function of the plan and the scene (VI-3), and of no fault.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rand::rngs::SmallRng;
use rand::{Rng, SeedableRng};
use sightline_jobs::TaskId;
use sightline_worker::AttemptError;
use sightline_worker::compute::{Compute, Computed, Job, Output};

/// The results of all tasks that were computed so far.
pub type Results = Arc<Mutex<BTreeMap<TaskId, Output>>>;

/// How a worker computes.
#[derive(Clone, Copy, Debug)]
pub struct Speed {
    /// Tasks take so many times as long.
    pub factor: u32,
    /// Share of tasks that fail, percent.
    pub failing_percent: u32,
}

impl Default for Speed {
    fn default() -> Self {
        Self { factor: 1, failing_percent: 0 }
    }
}

/// The computing of one worker.
pub struct SimCompute {
    speed: Arc<Mutex<Speed>>,
    rng: Mutex<SmallRng>,
    results: Results,
}

impl SimCompute {
    pub fn new(seed: u64, speed: Arc<Mutex<Speed>>, results: Results) -> Self {
        Self { speed, rng: Mutex::new(SmallRng::seed_from_u64(seed)), results }
    }
}

#[tonic::async_trait]
impl Compute for SimCompute {
    async fn compute(&self, task: TaskId, job: Job) -> Result<Computed, AttemptError> {
        let (took, fails) = {
            let speed = *self.speed.lock().unwrap_or_else(PoisonError::into_inner);
            let mut rng = self.rng.lock().unwrap_or_else(PoisonError::into_inner);
            let takes_ms = rng.random_range(300..2_500) * u64::from(speed.factor);
            let fails = rng.random_range(0..100) < speed.failing_percent;
            (Duration::from_millis(takes_ms), fails)
        };
        tokio::time::sleep(took).await;
        if fails {
            return Err(AttemptError::Panic("a fault of the simulation".into()));
        }
        let mut results = self.results.lock().unwrap_or_else(PoisonError::into_inner);
        let output = match results.get(&task) {
            Some(output) => output.clone(),
            None => {
                let output = job()?;
                results.insert(task, output.clone());
                output
            }
        };
        Ok(Computed { output, took })
    }
}
