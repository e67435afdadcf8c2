//! The threads that solve.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::WorkerError;
use crate::error::AttemptError;

/// Says when an attempt has to be given up. Cheap to clone and to ask.
#[derive(Clone, Debug, Default)]
pub struct Cancel(Arc<AtomicBool>);

impl Cancel {
    /// Asks for the end.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// True when the end was asked for.
    #[must_use]
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// A thread pool of its own, so that solving never runs on the RPC runtime.
#[derive(Clone)]
pub(crate) struct SolvePool(Arc<rayon::ThreadPool>);

impl SolvePool {
    /// A pool of `threads` threads, one a core when 0.
    pub fn new(threads: usize) -> Result<Self, WorkerError> {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|k| format!("solve-{k}"))
            .build()
            .map(|pool| Self(Arc::new(pool)))
            .map_err(|error| WorkerError::Threads { threads, problem: error.to_string() })
    }

    pub fn threads(&self) -> usize {
        self.0.current_num_threads()
    }

    /// Runs `work` in the pool. A panic is an error of the attempt, not the end of the worker.
    pub async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, AttemptError> {
        let (done, result) = tokio::sync::oneshot::channel();
        self.0.spawn(move || {
            // The work owns what it touches; nothing of it is seen after a panic.
            let outcome = catch_unwind(AssertUnwindSafe(work));
            // Nobody waits when the worker is ending.
            let _ = done.send(outcome);
        });
        match result.await {
            Ok(Ok(value)) => Ok(value),
            Ok(Err(panic)) => Err(AttemptError::Panic(describe(panic.as_ref()))),
            Err(_) => Err(AttemptError::Panic("a solving thread ended".into())),
        }
    }
}

fn describe(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("a panic without a message").to_owned()
}
