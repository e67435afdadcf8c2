//! Why a bake has no dataset, by what the caller has to do.

use std::net::SocketAddr;

use sightline_jobs::{Missing, TaskId};
use sightline_proto::ConvertError;
use sightline_store::{ErrorClass, StoreError};

use crate::security::SecurityError;

/// Why a coordinator ended without a dataset.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CoordinatorError {
    /// The store failed; its error says whether to try again.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {source}; choose another with --listen")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// What the system says.
        source: std::io::Error,
    },
    /// The coordinator cannot be secured as asked, or would be open to all.
    #[error(transparent)]
    Security(#[from] SecurityError),
    /// The store holds another plan under this bake's id.
    #[error(
        "{location} holds another plan under the id of this bake, {bake_id}: it was made by \
         another version of the program. Remove {folder} to start this bake again"
    )]
    PlanDiffers {
        /// The store.
        location: String,
        /// The bake.
        bake_id: String,
        /// Folder of the bake's state.
        folder: String,
    },
    /// An object of the bake's state cannot be read.
    #[error("`{key}` cannot be used: {problem}. Remove {folder} to start this bake again")]
    DamagedState {
        /// Key of the object.
        key: String,
        /// What is wrong with it.
        problem: String,
        /// Folder of the bake's state.
        folder: String,
    },
    /// A newer coordinator works on this bake.
    #[error("a newer coordinator (epoch {newest}) took over from this one (epoch {own})")]
    Superseded {
        /// This coordinator's epoch.
        own: u64,
        /// The newest epoch.
        newest: u64,
    },
    /// Tasks failed for good, so there is no dataset (JB-2).
    #[error("{}", describe_missing(.0))]
    Missing(Missing),
    /// No worker came, or all left and none came back.
    #[error(
        "no worker has been at hand for {waited_ms} ms; start one with \
         `sightline-worker http://{address}`"
    )]
    NoWorkers {
        /// How long, ms.
        waited_ms: u64,
        /// Where workers reach the coordinator.
        address: SocketAddr,
    },
    /// The caller stopped the coordinator. Starting the same bake again goes on from here.
    #[error("stopped before the end; start the same bake again to go on")]
    Stopped,
    /// A task of the coordinator itself failed: a defect of the program.
    #[error("the coordinator failed: {0}. Please report this")]
    Defect(String),
}

impl CoordinatorError {
    /// True when the same may succeed a little later.
    #[must_use]
    pub const fn passes(&self) -> bool {
        matches!(self, Self::Store(error) if matches!(error.class(), ErrorClass::RetryLater))
    }
}

impl From<ConvertError> for CoordinatorError {
    fn from(error: ConvertError) -> Self {
        Self::Defect(error.to_string())
    }
}

/// Quarantined tasks named in a message; the status lists all.
const NAMED_TASKS_MAX: usize = 3;

fn describe_missing(missing: &Missing) -> String {
    let name = |(task, reason): &(TaskId, String)| format!("task {task}: {reason}");
    let named: Vec<String> = missing.quarantined.iter().take(NAMED_TASKS_MAX).map(name).collect();
    let more = missing.quarantined.len().saturating_sub(NAMED_TASKS_MAX);
    format!(
        "{} tasks failed for good and {} more wait for them, so no dataset was published: {}{}",
        missing.quarantined.len(),
        missing.blocked.len(),
        named.join("; "),
        if more > 0 { format!("; and {more} more") } else { String::new() },
    )
}
