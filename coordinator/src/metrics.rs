//! What the coordinator counts, for Prometheus.
//!
//! How a bake is doing comes from its status, at every look of the coordinator's loop; what
//! happens is counted where it happens. Labels take values from fixed lists alone: what a caller
//! sends makes no new series.

use std::pin::Pin;
use std::sync::atomic::{AtomicU32, AtomicU64};
use std::task::{Context, Poll};
use std::time::Duration;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use sightline_jobs::{BakeStatus, FailureClass, Phase, TaskKind};
use sightline_store::Operation;
use sightline_telemetry::metrics::{
    Label, Labels, Registry, StoreMetrics, begin, duration_buckets,
};
use tonic::Code;
use tonic::body::Body;
use tower::{Layer, Service};

type Real = Gauge<f64, AtomicU64>;
type Count = Gauge<u32, AtomicU32>;

/// The metrics of a coordinator. Clones count together.
#[derive(Clone, Debug)]
pub struct Metrics {
    tasks: Family<Label, Count>,
    tasks_planned: Count,
    units_planned: Family<Label, Real>,
    units_committed: Family<Label, Real>,
    units_reused: Family<Label, Real>,
    units_per_second: Real,
    tasks_blocked: Count,
    leases: Count,
    oldest_lease_seconds: Real,
    workers: Count,
    epoch: Real,
    phase: Family<Label, Count>,
    attempts: Counter,
    commits: Counter,
    leases_lost: Counter,
    failures: Family<Label, Counter>,
    durations: Family<Label, Histogram, fn() -> Histogram>,
    rpcs: Family<Labels, Counter>,
    refusals: Counter,
    /// What is asked of the store.
    pub store: StoreMetrics,
}

impl Default for Metrics {
    fn default() -> Self {
        let metrics = Self {
            tasks: Family::default(),
            tasks_planned: Count::default(),
            units_planned: Family::default(),
            units_committed: Family::default(),
            units_reused: Family::default(),
            units_per_second: Real::default(),
            tasks_blocked: Count::default(),
            leases: Count::default(),
            oldest_lease_seconds: Real::default(),
            workers: Count::default(),
            epoch: Real::default(),
            phase: Family::default(),
            attempts: Counter::default(),
            commits: Counter::default(),
            leases_lost: Counter::default(),
            failures: Family::default(),
            durations: Family::new_with_constructor(duration_buckets),
            rpcs: Family::default(),
            refusals: Counter::default(),
            store: StoreMetrics::new(&Operation::KINDS, &Operation::RESULTS),
        };
        metrics.show(&BakeStatus::default());
        begin(&metrics.failures, "class", FailureClass::ALL.map(FailureClass::name));
        begin(&metrics.durations, "kind", TaskKind::NAMES);
        for method in METHODS {
            drop(metrics.rpcs.get_or_create(&[("method", method), ("code", name_of(Code::Ok))]));
        }
        metrics
    }
}

impl Metrics {
    /// Makes them known to a registry.
    pub fn register(&self, registry: &mut Registry) {
        let r = registry;
        r.register("sightline_tasks", "Tasks by state", self.tasks.clone());
        r.register("sightline_tasks_planned", "Tasks of the plan", self.tasks_planned.clone());
        r.register(
            "sightline_tasks_blocked",
            "Tasks that wait for quarantined ones",
            self.tasks_blocked.clone(),
        );
        r.register(
            "sightline_units_planned",
            "Segments, cells and joins of the plan",
            self.units_planned.clone(),
        );
        r.register(
            "sightline_units_committed",
            "Segments, cells and joins that are committed",
            self.units_committed.clone(),
        );
        r.register(
            "sightline_units_reused",
            "Segments and cells that were taken over from an earlier bake",
            self.units_reused.clone(),
        );
        r.register(
            "sightline_units_per_second",
            "Segments, cells and joins finished a second, averaged over the solving so far",
            self.units_per_second.clone(),
        );
        r.register("sightline_leases", "Leases in force", self.leases.clone());
        r.register(
            "sightline_oldest_lease_seconds",
            "Age of the oldest lease in force",
            self.oldest_lease_seconds.clone(),
        );
        r.register("sightline_workers", "Workers at hand", self.workers.clone());
        r.register("sightline_epoch", "Epoch of the coordinator", self.epoch.clone());
        r.register("sightline_phase", "1 for the phase of the bake", self.phase.clone());
        r.register("sightline_attempts", "Leases given out", self.attempts.clone());
        r.register("sightline_commits", "Tasks that were committed", self.commits.clone());
        r.register("sightline_leases_lost", "Leases that ran out", self.leases_lost.clone());
        r.register(
            "sightline_attempt_failures",
            "Attempts that failed, by class of failure",
            self.failures.clone(),
        );
        r.register(
            "sightline_task_duration_seconds",
            "Computing time of committed tasks by kind",
            self.durations.clone(),
        );
        r.register("sightline_rpcs", "Calls by method and code", self.rpcs.clone());
        r.register(
            "sightline_refusals",
            "Connections and calls that were refused for want of rights or over a limit",
            self.refusals.clone(),
        );
        self.store.register(r);
    }

    /// How the bake is doing now.
    pub(crate) fn show(&self, status: &BakeStatus) {
        let tasks = &status.tasks;
        let states = [
            ("committed", tasks.committed),
            ("leased", tasks.leased),
            ("ready", tasks.ready),
            ("waiting", tasks.waiting),
            ("quarantined", tasks.quarantined),
        ];
        for (state, count) in states {
            self.tasks.get_or_create(&[("state", state)]).set(count);
        }
        self.tasks_planned.set(tasks.tasks);
        self.tasks_blocked.set(status.tasks_blocked);
        let kinds =
            [("cells", status.cells), ("segments", status.segments), ("joins", status.joins)];
        for (kind, done) in kinds {
            self.units_planned.get_or_create(&[("kind", kind)]).set(done.total as f64);
            self.units_committed.get_or_create(&[("kind", kind)]).set(done.done as f64);
        }
        for (kind, reused) in [("cells", status.cells_reused), ("segments", status.segments_reused)]
        {
            self.units_reused.get_or_create(&[("kind", kind)]).set(reused as f64);
        }
        self.units_per_second.set(status.units_per_second);
        self.leases.set(status.leases_in_force);
        let oldest_ms = status.leases.iter().map(|lease| lease.age_ms).max().unwrap_or(0);
        self.oldest_lease_seconds.set(oldest_ms as f64 / 1e3);
        self.workers.set(status.workers_at_hand);
        self.epoch.set(status.epoch as f64);
        for phase in Phase::ALL {
            let is_now = u32::from(phase == status.phase);
            self.phase.get_or_create(&[("phase", phase.name())]).set(is_now);
        }
    }

    pub(crate) fn leased(&self) {
        self.attempts.inc();
    }

    pub(crate) fn lease_lost(&self) {
        self.leases_lost.inc();
    }

    pub(crate) fn committed(&self, kind: &TaskKind, solve_ms: u64) {
        self.commits.inc();
        let time = Duration::from_millis(solve_ms);
        self.durations.get_or_create(&[("kind", kind.name())]).observe(time.as_secs_f64());
    }

    pub(crate) fn failed(&self, class: FailureClass) {
        self.failures.get_or_create(&[("class", class.name())]).inc();
    }

    pub(crate) fn refused(&self) {
        self.refusals.inc();
    }

    fn answered(&self, method: &'static str, code: Code) {
        self.rpcs.get_or_create(&[("method", method), ("code", name_of(code))]).inc();
    }
}

/// The methods of the protocol.
const METHODS: [&str; 7] =
    ["Register", "Lease", "Heartbeat", "Report", "Goodbye", "GetStatus", "WatchStatus"];

/// The method that a path names, if it is one of the protocol.
fn method_of(path: &str) -> &'static str {
    let of_ours = path.strip_prefix("/sightline.v1.Coordinator/");
    match of_ours.and_then(|name| METHODS.into_iter().find(|method| *method == name)) {
        Some(method) => method,
        None if path.starts_with("/grpc.health.v1.Health/") => "Health",
        None => "other",
    }
}

/// The names of gRPC's codes.
const fn name_of(code: Code) -> &'static str {
    match code {
        Code::Ok => "ok",
        Code::Cancelled => "cancelled",
        Code::Unknown => "unknown",
        Code::InvalidArgument => "invalid_argument",
        Code::DeadlineExceeded => "deadline_exceeded",
        Code::NotFound => "not_found",
        Code::AlreadyExists => "already_exists",
        Code::PermissionDenied => "permission_denied",
        Code::ResourceExhausted => "resource_exhausted",
        Code::FailedPrecondition => "failed_precondition",
        Code::Aborted => "aborted",
        Code::OutOfRange => "out_of_range",
        Code::Unimplemented => "unimplemented",
        Code::Internal => "internal",
        Code::Unavailable => "unavailable",
        Code::DataLoss => "data_loss",
        Code::Unauthenticated => "unauthenticated",
    }
}

/// Counts the calls to a service. A stream counts when it begins.
#[derive(Clone)]
pub(crate) struct CountLayer(pub Metrics);

impl<S> Layer<S> for CountLayer {
    type Service = Counted<S>;

    fn layer(&self, inner: S) -> Self::Service {
        Counted { inner, metrics: self.0.clone() }
    }
}

/// A service whose calls are counted.
#[derive(Clone)]
pub(crate) struct Counted<S> {
    inner: S,
    metrics: Metrics,
}

impl<S, B> Service<http::Request<B>> for Counted<S>
where
    S: Service<http::Request<B>, Response = http::Response<Body>>,
    S::Future: Send + 'static,
{
    type Response = S::Response;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<S::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<B>) -> Self::Future {
        let (method, metrics) = (method_of(request.uri().path()), self.metrics.clone());
        let answered = self.inner.call(request);
        Box::pin(async move {
            let response = answered.await?;
            // A call that succeeds has its code behind its message, one that fails in the headers.
            let code = response.headers().get("grpc-status");
            metrics
                .answered(method, code.map_or(Code::Ok, |code| Code::from_bytes(code.as_bytes())));
            Ok(response)
        })
    }
}

#[cfg(test)]
mod tests {
    use sightline_telemetry::metrics::text_of;

    use super::*;

    #[test]
    fn strangers_make_no_series() {
        let (mut registry, metrics) = (Registry::default(), Metrics::default());
        metrics.register(&mut registry);
        for path in ["/sightline.v1.Coordinator/Evil", "/x", "", "/sightline.v1.Coordinator/Lease"]
        {
            metrics.answered(method_of(path), Code::Unimplemented);
        }
        let text = text_of(&registry);
        let other = "sightline_rpcs_total{method=\"other\",code=\"unimplemented\"} 3";
        assert!(text.contains(other) && !text.contains("Evil"), "{text}");
    }

    #[test]
    fn a_status_is_shown() {
        let (mut registry, metrics) = (Registry::default(), Metrics::default());
        metrics.register(&mut registry);
        let mut status = BakeStatus { phase: Phase::Merging, epoch: 3, ..BakeStatus::default() };
        status.tasks.quarantined = 2;
        metrics.show(&status);
        let text = text_of(&registry);
        for line in [
            "sightline_tasks{state=\"quarantined\"} 2",
            "sightline_phase{phase=\"merging\"} 1",
            "sightline_phase{phase=\"solving\"} 0",
            "sightline_epoch 3.0",
        ] {
            assert!(text.contains(line), "{line}: {text}");
        }
    }
}
