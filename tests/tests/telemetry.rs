//! What a bake can be watched with: status, metrics, logs, traces, the dashboard.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{
    TraceService, TraceServiceServer,
};
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::any_value::Value as Any;
use opentelemetry_proto::tonic::trace::v1::Span;
use serde_json::Value;
use sightline_coordinator::Metrics as CoordinatorMetrics;
use sightline_telemetry::metrics::{Registry, text_of};
use sightline_tests::binaries::sightline;
use sightline_tests::city::{self, LIMIT};
use sightline_tests::process::{self, Process, eventually};
use sightline_tests::servers::free_port;
use sightline_tests::{dataset, workspace};
use sightline_worker::Metrics as WorkerMetrics;
use tokio_stream::wrappers::TcpListenerStream;

/// Spans, by the service that sent them.
#[derive(Clone, Default)]
struct Receiver(Arc<Mutex<Vec<(String, Span)>>>);

#[tonic::async_trait]
impl TraceService for Receiver {
    async fn export(
        &self,
        request: tonic::Request<ExportTraceServiceRequest>,
    ) -> Result<tonic::Response<ExportTraceServiceResponse>, tonic::Status> {
        let mut received = self.0.lock().expect("nobody panics with it");
        for of_process in request.into_inner().resource_spans {
            let attributes = of_process.resource.unwrap_or_default().attributes;
            let name = attributes.into_iter().find(|a| a.key == "service.name");
            let service = match name.and_then(|n| n.value?.value) {
                Some(Any::StringValue(name)) => name,
                other => panic!("a service has a name: {other:?}"),
            };
            let spans = of_process.scope_spans.into_iter().flat_map(|scope| scope.spans);
            received.extend(spans.map(|span| (service.clone(), span)));
        }
        Ok(tonic::Response::new(ExportTraceServiceResponse::default()))
    }
}

fn get(port: u16, path: &str) -> Option<String> {
    let address = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
    let mut stream = TcpStream::connect(address).ok()?;
    let request = format!("GET {path} HTTP/1.1\r\nHost: test\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).ok()?;
    let mut text = String::new();
    stream.read_to_string(&mut text).ok()?;
    Some(text)
}

/// The value of a metric without labels, or with these.
fn value(metrics: &str, name: &str) -> Option<f64> {
    metrics.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.parse().ok())
}

struct Watched {
    received: Vec<(String, Span)>,
    coordinator_log: String,
    worker_log: String,
    dataset: PathBuf,
}

/// Bakes with everything that there is to watch, and looks at the metrics meanwhile.
fn bake_watched(folder: &Path) -> Watched {
    let scene = folder.join("city.glb");
    city::generate(&scene, 7);
    let runtime = tokio::runtime::Runtime::new().expect("a runtime starts");
    let receiver = Receiver::default();
    let listener = runtime
        .block_on(tokio::net::TcpListener::bind((Ipv4Addr::LOCALHOST, 0)))
        .expect("a port is free");
    let collector = format!("http://{}", listener.local_addr().expect("it has an address"));
    let service = TraceServiceServer::new(receiver.clone());
    let serving = tonic::transport::Server::builder()
        .add_service(service)
        .serve_with_incoming(TcpListenerStream::new(listener));
    let serving = runtime.spawn(serving);

    let (dataset, port) = (folder.join("dataset"), free_port());
    let (metrics, of_worker) = (free_port(), free_port());
    let watched = |command: &mut std::process::Command, metrics: u16| {
        command.args(["--quiet", "--log-format=json", "--metrics"]).arg(metrics.to_string());
        command.env("RUST_LOG", "sightline=debug");
        command.env("OTEL_EXPORTER_OTLP_ENDPOINT", &collector);
    };
    let mut command = sightline(city::bake_arguments("coordinator", &scene, &dataset, [3, 1]));
    command.arg("--listen").arg(format!("127.0.0.1:{port}"));
    watched(&mut command, metrics);
    let coordinator = Process::start(&mut command, folder, "coordinator");
    let url = format!("http://127.0.0.1:{port}");
    let mut command = sightline(["worker", "--threads=1", "--coordinator", &url]);
    watched(&mut command, of_worker);
    let worker = Process::start(&mut command, folder, "worker");

    let has_commits = || {
        let text = get(metrics, "/metrics").unwrap_or_default();
        value(&text, "sightline_commits_total").is_some_and(|commits| commits >= 2.0)
    };
    assert!(eventually(LIMIT, has_commits), "{}", coordinator.stderr());
    let text = get(metrics, "/metrics").expect("metrics are served");
    assert_eq!(value(&text, "sightline_epoch"), Some(1.0), "{text}");
    assert!(value(&text, "sightline_attempts_total") >= Some(2.0), "{text}");
    assert!(text.contains("sightline_rpcs_total{method=\"Lease\",code=\"ok\"}"), "{text}");
    assert!(text.contains("sightline_store_operations_total{operation=\"put\""), "{text}");
    let text = get(of_worker, "/metrics").expect("metrics are served");
    let committed = value(&text, "sightline_worker_attempts_total{result=\"committed\"}");
    assert!(committed >= Some(1.0), "{text}");

    let coordinator_log = coordinator.wait(LIMIT).success().stderr;
    let worker_log = worker.wait(LIMIT).success().stderr;
    serving.abort();
    let received = std::mem::take(&mut *receiver.0.lock().expect("nobody panics with it"));
    Watched { received, coordinator_log, worker_log, dataset }
}

/// The lines of a log, which are JSON.
fn lines(log: &str) -> Vec<Value> {
    let parse = |line: &str| serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}"));
    log.lines().map(parse).collect()
}

#[test]
fn the_life_of_a_task_can_be_followed() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("telemetry");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder can be made");
    let watched = bake_watched(&folder);
    let tasks = dataset::commits(&watched.dataset);
    assert!(tasks > 4);
    check_spans(&watched.received, tasks);
    check_logs(&watched);
    check_status(&watched.dataset);
}

fn check_spans(received: &[(String, Span)], tasks: usize) {
    let by_id: BTreeMap<&[u8], &(String, Span)> =
        received.iter().map(|pair| (pair.1.span_id.as_slice(), pair)).collect();
    let named = |name: &'static str| received.iter().filter(move |(_, span)| span.name == name);
    let parent_of = |span: &Span| by_id.get(span.parent_span_id.as_slice()).copied();
    assert_eq!(named("attempt").count(), tasks, "each task was attempted once");
    let traces: BTreeSet<&[u8]> =
        named("attempt").map(|(_, span)| span.trace_id.as_slice()).collect();
    assert_eq!(traces.len(), tasks, "a trace a task");
    for (service, span) in named("attempt") {
        assert_eq!(service, "sightline-worker");
        let (of, lease) = parent_of(span).expect("an attempt has a lease");
        assert_eq!((of.as_str(), lease.name.as_str()), ("sightline-coordinator", "lease"));
        assert_eq!(lease.trace_id, span.trace_id);
        assert!(lease.parent_span_id.is_empty(), "a life begins with the lease");
        let keys: BTreeSet<&str> = span.attributes.iter().map(|a| a.key.as_str()).collect();
        let wanted = ["bake", "epoch", "task", "lease", "attempt", "worker"];
        assert!(wanted.iter().all(|key| keys.contains(key)), "{keys:?}");
    }
    for name in ["read", "solve", "write", "commit", "report"] {
        assert_eq!(named(name).count(), tasks, "{name}");
        for (_, span) in named(name) {
            let (_, attempt) = parent_of(span).expect("it is part of an attempt");
            assert_eq!((attempt.name.as_str(), &attempt.trace_id), ("attempt", &span.trace_id));
        }
    }
    assert_eq!(named("take_report").count(), tasks);
    for (service, span) in named("take_report") {
        let (of, report) = parent_of(span).expect("somebody reported");
        assert_eq!((service.as_str(), of.as_str()), ("sightline-coordinator", "sightline-worker"));
        assert_eq!((report.name.as_str(), &report.trace_id), ("report", &span.trace_id));
    }
}

fn check_logs(watched: &Watched) {
    let ids = ["bake", "epoch", "task", "lease", "attempt", "worker"];
    let of_coordinator = lines(&watched.coordinator_log);
    let leased = of_coordinator.iter().find(|line| line["message"] == "leased");
    let leased = leased.expect("leases are logged");
    assert!(ids.iter().all(|id| !leased[id].is_null()), "{leased:#}");
    let of_worker = lines(&watched.worker_log);
    let committed = of_worker.iter().find(|line| line["message"] == "committed");
    let span = &committed.expect("commits are logged")["span"];
    assert!(ids.iter().all(|id| !span[id].is_null()), "{span:#}");
}

fn check_status(dataset: &Path) {
    let ask = |more: &[&str]| {
        let mut command = sightline(["status"]);
        process::run(command.arg(dataset).args(more), Duration::from_secs(60))
    };
    let stored = ask(&["--json"]).success().json();
    assert_eq!(stored["published"], true, "{stored:#}");
    let bake = &stored["bakes"][0];
    assert_eq!((&bake["published"], &bake["epoch"]), (&Value::from(true), &Value::from(1)));
    assert_eq!(bake["missing"], serde_json::json!([]), "{stored:#}");
    let text = ask(&[]).success().stdout;
    assert!(text.contains("manifest 1, 8 cells") && text.contains("published"), "{text}");

    // Without the pointer and one commit: what is missing is named.
    std::fs::remove_file(dataset.join("current.json")).expect("it was published");
    let id = bake["bake"].as_str().expect("a bake has an id");
    let commit = dataset.join(format!("bake/{id}/commits/00000003"));
    std::fs::remove_file(commit).expect("task 3 was committed");
    let stored = ask(&["--json"]).success().json();
    assert_eq!(stored["published"], false);
    assert_eq!(stored["bakes"][0]["missing"], serde_json::json!([3]), "{stored:#}");
    assert!(ask(&[]).success().stdout.contains("1 task missing: 3"));
    let nothing = process::run(sightline(["status"]).arg(env!("CARGO_TARGET_TMPDIR")), LIMIT);
    assert!(nothing.failure(3).stderr.contains("no bake"));
    let nobody = process::run(sightline(["status", "http://127.0.0.1:9"]).arg("--once"), LIMIT);
    let _ = nobody.failure(6);
}

/// Names as Prometheus knows them: those of counters and histograms with what is added to them.
fn exported() -> BTreeSet<String> {
    let mut registry = Registry::default();
    CoordinatorMetrics::default().register(&mut registry);
    let mut of_worker = Registry::default();
    WorkerMetrics::default().register(&mut of_worker);
    let text = text_of(&registry) + &text_of(&of_worker);
    let mut names = BTreeSet::new();
    for line in text.lines().filter_map(|line| line.strip_prefix("# TYPE ")) {
        let (name, kind) = line.split_once(' ').expect("a name and a type");
        let endings: &[&str] = match kind {
            "counter" => &["_total"],
            "histogram" => &["_bucket", "_sum", "_count"],
            _ => &[""],
        };
        names.extend(endings.iter().map(|ending| format!("{name}{ending}")));
    }
    names
}

/// Words of an expression that are names of our metrics.
fn used(expression: &str) -> impl Iterator<Item = &str> {
    let words = expression.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    words.filter(|word| word.starts_with("sightline_"))
}

#[test]
fn the_dashboard_asks_for_metrics_that_there_are() {
    let text = workspace::read("docs/grafana/sightline.json");
    let dashboard: Value = serde_json::from_str(&text).expect("a dashboard is JSON");
    let exported = exported();
    let mut asked = BTreeSet::new();
    for panel in dashboard["panels"].as_array().expect("it has panels") {
        for target in panel["targets"].as_array().expect("a panel asks for something") {
            let expression = target["expr"].as_str().expect("an expression");
            let names: Vec<&str> = used(expression).collect();
            assert!(!names.is_empty(), "{expression}");
            for name in names {
                assert!(exported.contains(name), "{name} of {} is not exported", panel["title"]);
                asked.insert(name.to_owned());
            }
        }
    }
    assert!(asked.len() > 15, "{asked:?}");
}

#[test]
fn metrics_are_named_as_prometheus_asks() {
    for name in exported() {
        let fits = |c: char| c.is_ascii_lowercase() || c == '_';
        assert!(name.starts_with("sightline_") && name.chars().all(fits), "{name}");
        assert!(!name.ends_with("_ms") && !name.contains("_total_"), "{name}: base units");
    }
}
