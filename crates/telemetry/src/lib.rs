//! What every Sightline process tells of itself: logs, metrics, traces; and when it is to stop.
//!
//! - [`logs`]: lines for people or for machines, with the same fields everywhere: `bake`, `epoch`,
//!   `task`, `lease`, `attempt`, `worker`.
//! - [`metrics`]: a small HTTP listener for Prometheus, and the metrics that all processes share.
//! - [`trace`]: the life of a task as spans, exported by OTLP when a collector is named, with one
//!   trace across processes.
//! - [`stop`] waits for signals.
//!
//! It knows nothing of bakes: coordinator and worker register their own metrics and make their own
//! spans.

pub mod logs;
pub mod metrics;
pub mod stop;
pub mod trace;

pub use logs::{LogFormat, LogOptions, Telemetry, WatchFlags};
