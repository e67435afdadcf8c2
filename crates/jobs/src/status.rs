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
    /// Every phase.
    pub const ALL: [Self; 5] =
        [Self::Planning, Self::Solving, Self::Merging, Self::Published, Self::Failed];

    /// The name, as in JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Planning => "planning",
            Self::Solving => "solving",
            Self::Merging => "merging",
            Self::Published => "published",
            Self::Failed => "failed",
        }
    }

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

/// A lease in force.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeaseStatus {
    /// The task.
    pub task: TaskId,
    /// Number of the lease.
    pub lease: u64,
    /// Registration number of who holds it.
    pub worker: u32,
    /// Name of who holds it.
    pub worker_name: String,
    /// Number of this attempt at the task, from 1.
    pub attempt: u32,
    /// Time since it was given out, ms.
    pub age_ms: u64,
    /// How long the task should take from its lease to its commit, ms, as the committed ones tell; 0 when
    /// they tell nothing yet.
    pub predicted_ms: u64,
    /// True when it takes so much longer that an idle worker gets a second attempt: a straggler.
    pub is_overdue: bool,
}

/// A task that was attempted more than once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskAttempts {
    /// The task.
    pub task: TaskId,
    /// Leases given out for it.
    pub attempts: u32,
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
    /// Of the segments and cells that this coordinator saw committed, those that were taken over from an
    /// earlier bake.
    pub segments_reused: u64,
    /// See [`Self::segments_reused`].
    pub cells_reused: u64,
    /// Workers at hand; at most [`Self::LISTED_MAX`] of them.
    pub workers: Vec<WorkerStatus>,
    /// Number of workers at hand.
    pub workers_at_hand: u32,
    /// Leases in force, the oldest first; at most [`Self::LISTED_MAX`] of them.
    pub leases: Vec<LeaseStatus>,
    /// Number of leases in force.
    pub leases_in_force: u32,
    /// Tasks with more than one attempt, the most attempted first; at most [`Self::LISTED_MAX`].
    pub attempts: Vec<TaskAttempts>,
    /// Number of tasks with more than one attempt.
    pub tasks_attempted_again: u32,
    /// Tasks that are not tried any more; at most [`Self::LISTED_MAX`] of them, all are counted in
    /// `tasks`.
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
    /// Longest list in a status: it is sent at every change.
    pub const LISTED_MAX: usize = 256;

    /// Cells of the dataset, each once.
    #[must_use]
    pub const fn dataset_cells(&self) -> u64 {
        if self.joins.total > 0 { self.joins.total } else { self.cells.total }
    }
}
