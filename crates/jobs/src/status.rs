//! How a bake is doing, for people and dashboards.

use serde::{Deserialize, Serialize};

use crate::{Progress, TaskId};

/// The phases of a bake.
///
/// ```text
/// Planning --> Solving --> Merging --> Published
///     |           |           |
///     +-----------+-----------+------> Failed
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// The plan is written and what earlier coordinators left is read.
    #[default]
    Planning,
    /// Workers attempt tasks.
    Solving,
    /// Every task is committed; the dataset is put together.
    Merging,
    /// The dataset is there.
    Published,
    /// The bake ended without a dataset (JB-2).
    Failed,
}

impl Phase {
    /// True when nothing follows.
    #[must_use]
    pub const fn is_final(self) -> bool {
        matches!(self, Self::Published | Self::Failed)
    }
}

/// A part of the work: how much there is, and how much is committed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Done {
    /// Committed, or found committed.
    pub done: u64,
    /// In the plan.
    pub total: u64,
}

/// A worker as its coordinator sees it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerStatus {
    /// Its registration number.
    pub id: u32,
    /// Its name.
    pub name: String,
    /// Threads it solves with.
    pub threads: u32,
    /// Leases it holds.
    pub leases: u32,
    /// Tasks it committed.
    pub tasks_committed: u32,
}

/// A task that is not tried any more.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct QuarantinedTask {
    /// The task.
    pub task: TaskId,
    /// Why.
    pub reason: String,
}

/// How a bake is doing. Times are those of this coordinator; earlier ones do not count.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BakeStatus {
    /// The bake.
    pub bake_id: String,
    /// The coordinator's epoch.
    pub epoch: u64,
    /// Where the bake is.
    pub phase: Phase,
    /// Tasks by state.
    pub tasks: Progress,
    /// Cells, once a range of states.
    pub cells: Done,
    /// Segments, once a range of states.
    pub segments: Done,
    /// Cells whose ranges of states are joined; none in all where there is one range.
    pub joins: Done,
    /// Tasks that were committed before this coordinator started.
    pub tasks_resumed: u32,
    /// Workers at hand.
    pub workers: Vec<WorkerStatus>,
    /// Tasks that are not tried any more.
    pub quarantined: Vec<QuarantinedTask>,
    /// Number of tasks that wait for quarantined ones.
    pub tasks_blocked: u32,
    /// Time since the start, ms.
    pub elapsed_ms: u64,
    /// Time spent in phase `Solving`, ms.
    pub solve_ms: u64,
    /// Time spent in phase `Merging`, ms.
    pub merge_ms: u64,
    /// Sum over reported tasks of the time workers spent in computing, ms.
    pub worker_solve_ms: u64,
    /// Segments, cells and joins finished a second, averaged over phase `Solving`.
    pub units_per_second: f64,
    /// Number of the published manifest; 0 before it is.
    pub manifest: u64,
    /// Why the bake failed; empty otherwise.
    pub error: String,
}

impl BakeStatus {
    /// Cells of the dataset, each once.
    #[must_use]
    pub const fn dataset_cells(&self) -> u64 {
        if self.joins.total > 0 { self.joins.total } else { self.cells.total }
    }
}
