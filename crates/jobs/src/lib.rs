//! Bake configuration, plans, task states and pure scheduling.
//!
//! This crate has no clock, no I/O and no randomness: the same arguments give the same plan and
//! the same decisions on every machine. Time is an argument, in milliseconds of any clock that
//! does not run backwards.
//!
//! Invariants that code, tests and documents quote:
//! - JB-1: one commit a task. A task may run many times; its output counts once.
//! - JB-2: a published dataset is never partial.

pub mod config;
pub mod plan;
pub mod schedule;
pub mod status;

pub use config::{AccuracyConfig, BakeConfig, ConfigError, Heights, KEYS, KeyDoc};
pub use plan::{
    FORMAT_VERSION, Plan, PlannedCell, SceneFile, SceneRef, SkippedCells, StateRange, Task, TaskId,
    TaskKind, TiledCell, plan,
};
pub use schedule::{
    FailureClass, Lease, LeaseId, Missing, Outcome, Progress, SchedulePolicy, Scheduler, TaskState,
    WorkerId, pause_ms,
};
pub use status::{
    BakeStatus, Done, LeaseStatus, Phase, QuarantinedTask, TaskAttempts, WorkerStatus,
};
