//! Why a worker ends, and why an attempt fails, by what has to be done.

use std::time::Duration;

use sightline_jobs::FailureClass;
use sightline_proto::ConvertError;
use sightline_scene::SceneError;
use sightline_store::{ErrorClass, StoreError};

/// Why a worker ended before the bake did.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WorkerError {
    /// The coordinator's address is not a URL.
    #[error(
        "`{url}` is not the URL of a coordinator: {problem}; write http://HOST:PORT or https://HOST:PORT"
    )]
    BadUrl {
        /// The URL as given.
        url: String,
        /// What is wrong with it.
        problem: String,
    },
    /// Certificates or tokens cannot be used, or would be given away.
    #[error("{0}")]
    Credentials(String),
    /// The coordinator does not answer.
    #[error(
        "no coordinator answered at {url} for {} s: {problem}; check that one is running and \
         start this worker again", .waited.as_secs()
    )]
    Unreachable {
        /// The coordinator.
        url: String,
        /// How long it was tried.
        waited: Duration,
        /// The last answer.
        problem: String,
    },
    /// The coordinator refuses this worker.
    #[error("the coordinator refuses this worker: {0}")]
    Refused(String),
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The scene is refused.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The scene is neither on this machine nor in the store.
    #[error(
        "the scene is not at {place} on this machine, and cannot be fetched: {problem}. Start the \
         coordinator with --share-scene always, or give this worker the scene with --scene"
    )]
    NoScene {
        /// Where it was looked for.
        place: String,
        /// What the store says.
        problem: String,
    },
    /// The scene is not the one that is being baked.
    #[error(
        "{path} is not the scene of this bake: its digest is {found}, the bake's is {expected}. \
         Give this worker the same files as the coordinator, with --scene"
    )]
    OtherScene {
        /// The scene that was opened.
        path: String,
        /// Its digest.
        found: String,
        /// The digest in the plan.
        expected: String,
    },
    /// The scene has other states than the plan.
    #[error(
        "{path} has {found} states, and the plan of this bake {expected}: it was read otherwise than \
         by the coordinator. Run the same version of both"
    )]
    OtherStates {
        /// The scene that was opened.
        path: String,
        /// Its number of states.
        found: u32,
        /// That in the plan.
        expected: u32,
    },
    /// The plan cannot be read.
    #[error("the plan of bake {bake_id} cannot be used: {source}")]
    Plan {
        /// The bake.
        bake_id: String,
        /// What is wrong.
        source: ConvertError,
    },
    /// The threads for solving cannot be started.
    #[error("cannot start {threads} threads: {problem}; use fewer with --threads")]
    Threads {
        /// How many were asked for.
        threads: usize,
        /// What the system says.
        problem: String,
    },
    /// A defect of the program.
    #[error("the worker failed: {0}. Please report this")]
    Defect(String),
}

/// Why an attempt at a task failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AttemptError {
    /// The store failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A commit or part of another task cannot be used.
    #[error("`{key}` cannot be used: {problem}")]
    Input {
        /// Key of the object.
        key: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The computation panicked.
    #[error("the computation failed: {0}")]
    Panic(String),
    /// The attempt was given up: the lease is gone, or the worker is stopping.
    #[error("given up")]
    GivenUp,
}

impl AttemptError {
    /// What the coordinator is to do. One table, so that nobody matches on strings.
    #[must_use]
    pub const fn class(&self) -> FailureClass {
        match self {
            Self::Store(error) => match error.class() {
                ErrorClass::RetryLater => FailureClass::RetryLater,
                ErrorClass::NotFound | ErrorClass::FixInput => FailureClass::RetryElsewhere,
                // Stored bytes are what they are, for every worker.
                ErrorClass::Corrupt => FailureClass::Never,
            },
            Self::Input { .. } => FailureClass::Never,
            Self::Panic(_) => FailureClass::RetryElsewhere,
            Self::GivenUp => FailureClass::RetryLater,
        }
    }
}
