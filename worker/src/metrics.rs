//! What a worker counts, for Prometheus. Labels take values from fixed lists alone.

use std::sync::atomic::AtomicU32;
use std::time::Duration;

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use sightline_jobs::{FailureClass, TaskKind};
use sightline_store::Operation;
use sightline_telemetry::metrics::{Label, Registry, StoreMetrics, begin, duration_buckets};

const COMMITTED: &str = "committed";
const GIVEN_UP: &str = "given_up";
const FAILED: &str = "failed";
/// How attempts end.
const RESULTS: [&str; 3] = [COMMITTED, GIVEN_UP, FAILED];

/// The metrics of a worker. Clones count together.
#[derive(Clone, Debug)]
pub struct Metrics {
    attempts: Family<Label, Counter>,
    failures: Family<Label, Counter>,
    durations: Family<Label, Histogram, fn() -> Histogram>,
    leases: Gauge<u32, AtomicU32>,
    registrations: Counter,
    /// What is asked of the store.
    pub store: StoreMetrics,
}

impl Default for Metrics {
    fn default() -> Self {
        let metrics = Self {
            attempts: Family::default(),
            failures: Family::default(),
            durations: Family::new_with_constructor(duration_buckets),
            leases: Gauge::default(),
            registrations: Counter::default(),
            store: StoreMetrics::new(&Operation::KINDS, &Operation::RESULTS),
        };
        begin(&metrics.attempts, "result", RESULTS);
        begin(&metrics.failures, "class", FailureClass::ALL.map(FailureClass::name));
        begin(&metrics.durations, "kind", TaskKind::NAMES);
        metrics
    }
}

impl Metrics {
    /// Makes them known to a registry.
    pub fn register(&self, registry: &mut Registry) {
        let r = registry;
        r.register(
            "sightline_worker_attempts",
            "Attempts by how they ended",
            self.attempts.clone(),
        );
        r.register(
            "sightline_worker_attempt_failures",
            "Attempts that failed, by class of failure",
            self.failures.clone(),
        );
        r.register(
            "sightline_worker_solve_duration_seconds",
            "Computing time of attempts that ended well, by kind of task",
            self.durations.clone(),
        );
        r.register("sightline_worker_leases", "Leases held", self.leases.clone());
        r.register(
            "sightline_worker_registrations",
            "Registrations with a coordinator",
            self.registrations.clone(),
        );
        self.store.register(r);
    }

    pub(crate) fn registered(&self) {
        self.registrations.inc();
    }

    pub(crate) fn holds(&self, leases: u32) {
        self.leases.set(leases);
    }

    pub(crate) fn committed(&self, kind: &'static str, solve_time: Duration) {
        self.attempts.get_or_create(&[("result", COMMITTED)]).inc();
        self.durations.get_or_create(&[("kind", kind)]).observe(solve_time.as_secs_f64());
    }

    pub(crate) fn given_up(&self) {
        self.attempts.get_or_create(&[("result", GIVEN_UP)]).inc();
    }

    pub(crate) fn failed(&self, class: FailureClass) {
        self.attempts.get_or_create(&[("result", FAILED)]).inc();
        self.failures.get_or_create(&[("class", class.name())]).inc();
    }
}
