//! What callers cannot do to a coordinator or to each other, over real loopback sockets.

use std::sync::Arc;
use std::time::Duration;

use glam::DVec3;
use sightline_coordinator::journal::Journal;
use sightline_coordinator::{
    ConnectionLimits, Coordinator, CoordinatorError, CoordinatorHandle, CoordinatorOptions,
    Metrics, Publish,
};
use sightline_geometry::{CellId, ViewCell};
use sightline_jobs::{BakeConfig, FORMAT_VERSION, Plan, SceneRef, SkippedCells, TiledCell, plan};
use sightline_proto::v1::coordinator_client::CoordinatorClient;
use sightline_proto::v1::{self, lease_response::Answer, report_request::Result as Report};
use sightline_store::{BakeStore, Published};
use sightline_telemetry::metrics::{Registry, text_of};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tonic::Code;
use tonic::transport::Channel;

const TRIAL: Duration = Duration::from_millis(1500);

/// Never comes to it.
struct Nothing;

#[tonic::async_trait]
impl Publish for Nothing {
    async fn publish(&self, _: &Journal, _: &Plan) -> Result<Published, CoordinatorError> {
        Err(CoordinatorError::Stopped)
    }
}

fn sample_plan() -> Plan {
    let mut config = BakeConfig::default();
    config.region.rectangles = vec![[0.0, 0.0, 10.0, 10.0]];
    config.tasks.segments_per_task = 1;
    let scene = SceneRef {
        uri: "city.glb".into(),
        name: "city.glb".into(),
        digest: "ab".into(),
        files: vec![],
    };
    let at = |x: f64, z: f64| DVec3::new(x, 1.5, z);
    let corners = [at(0.0, 0.0), at(10.0, 0.0), at(10.0, 10.0), at(0.0, 10.0)];
    let cell = ViewCell { id: CellId(0), corners, height: 0.0 };
    let cells = vec![TiledCell { cell, tile: [0, 0] }];
    plan(scene, config, vec![0.0], cells, SkippedCells::default())
}

async fn start(limits: ConnectionLimits, metrics: &Arc<Metrics>) -> CoordinatorHandle {
    let listen = "127.0.0.1:0".parse().unwrap();
    let store = BakeStore::in_memory();
    let mut options = CoordinatorOptions::new(listen, store, sample_plan(), Arc::new(Nothing));
    options.security.limits = limits;
    options.metrics = Arc::clone(metrics);
    Coordinator::start(options).await.unwrap()
}

type Client = CoordinatorClient<Channel>;

async fn join(coordinator: &CoordinatorHandle, name: &str) -> (Client, v1::RegisterResponse) {
    let mut client = CoordinatorClient::connect(coordinator.url()).await.unwrap();
    let request = v1::RegisterRequest {
        worker_name: name.into(),
        threads: 1,
        format_version: FORMAT_VERSION,
        ..Default::default()
    };
    let session = client.register(request).await.unwrap().into_inner();
    (client, session)
}

async fn lease(client: &mut Client, session: &v1::RegisterResponse) -> v1::LeasedTask {
    let request = v1::LeaseRequest { worker_id: session.worker_id, epoch: session.epoch };
    match client.lease(request).await.unwrap().into_inner().answer {
        Some(Answer::Task(task)) => task,
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_worker_cannot_end_the_lease_of_another() {
    let coordinator = start(ConnectionLimits::default(), &Arc::default()).await;
    let (mut owner, mine) = join(&coordinator, "owner").await;
    let (mut thief, theirs) = join(&coordinator, "thief").await;
    let task = lease(&mut owner, &mine).await;
    let report = |result| v1::ReportRequest {
        worker_id: theirs.worker_id,
        epoch: theirs.epoch,
        lease_id: task.lease_id,
        task: task.task,
        result: Some(result),
    };
    let class = v1::FailureClass::Never.into();
    let failed = v1::Failed { class, reason: "for fun".into() };
    thief.report(report(Report::Failed(failed))).await.unwrap();
    thief.report(report(Report::Released(v1::Released {}))).await.unwrap();
    let lie = Report::Committed(v1::Committed { solve_ms: 1 });
    assert_eq!(thief.report(report(lie)).await.unwrap_err().code(), Code::DataLoss);
    let beat = |session: &v1::RegisterResponse| v1::HeartbeatRequest {
        worker_id: session.worker_id,
        epoch: session.epoch,
        lease_ids: vec![task.lease_id],
    };
    let lost = |answer: tonic::Response<v1::HeartbeatResponse>| answer.into_inner().lost_lease_ids;
    assert_eq!(lost(thief.heartbeat(beat(&theirs)).await.unwrap()), [task.lease_id]);
    assert!(lost(owner.heartbeat(beat(&mine)).await.unwrap()).is_empty(), "it is in force");

    let status = owner.get_status(v1::GetStatusRequest {}).await.unwrap().into_inner();
    assert_eq!(status.leases_in_force, 1);
    assert_eq!((status.leases[0].worker_name.as_str(), status.leases[0].attempt), ("owner", 1));
    assert_eq!(status.tasks.unwrap().quarantined, 0);
}

#[tokio::test]
async fn who_speaks_of_a_newer_epoch_is_not_believed() {
    let coordinator = start(ConnectionLimits::default(), &Arc::default()).await;
    let (mut client, session) = join(&coordinator, "prophet").await;
    for epoch in [2, u64::MAX] {
        let request = v1::LeaseRequest { worker_id: session.worker_id, epoch };
        assert_eq!(client.lease(request).await.unwrap_err().code(), Code::FailedPrecondition);
    }
    // Long enough for the coordinator to have looked into the store.
    tokio::time::sleep(Duration::from_millis(1500)).await;
    lease(&mut client, &session).await;
}

#[tokio::test]
async fn a_lease_given_back_is_counted_as_another_attempt() {
    let coordinator = start(ConnectionLimits::default(), &Arc::default()).await;
    let (mut client, session) = join(&coordinator, "undecided").await;
    for _ in 0..3 {
        let task = lease(&mut client, &session).await;
        assert_eq!(task.task, 0);
        let report = v1::ReportRequest {
            worker_id: session.worker_id,
            epoch: session.epoch,
            lease_id: task.lease_id,
            task: task.task,
            result: Some(Report::Released(v1::Released {})),
        };
        client.report(report).await.unwrap();
    }
    let status = client.get_status(v1::GetStatusRequest {}).await.unwrap().into_inner();
    assert_eq!(status.attempts, [v1::TaskAttempts { task: 0, attempts: 3 }]);
    assert_eq!((status.tasks_attempted_again, status.leases_in_force), (1, 0));
}

async fn is_closed(stream: &mut TcpStream) -> bool {
    let mut byte = [0];
    let read = tokio::time::timeout(Duration::from_secs(10), stream.read(&mut byte)).await;
    matches!(read.expect("it ends in time"), Ok(0) | Err(_))
}

fn count(metrics: &Metrics, line: &str) -> u64 {
    let mut registry = Registry::default();
    metrics.register(&mut registry);
    let text = text_of(&registry);
    let found = text.lines().find_map(|l| l.strip_prefix(line)?.trim().parse().ok());
    found.unwrap_or_else(|| panic!("{line}: {text}"))
}

#[tokio::test]
async fn half_open_connections_keep_nobody_out_for_long() {
    let metrics = Arc::new(Metrics::default());
    let limits = ConnectionLimits { trials_max: 4, trial_time: TRIAL, ..Default::default() };
    let coordinator = start(limits, &metrics).await;
    // Who is admitted takes none of the places.
    let (mut admitted, _) = join(&coordinator, "early").await;
    let mut silent = Vec::new();
    for _ in 0..limits.trials_max {
        silent.push(TcpStream::connect(coordinator.addr).await.unwrap());
    }
    let mut too_many = TcpStream::connect(coordinator.addr).await.unwrap();
    assert!(is_closed(&mut too_many).await, "CN-1");
    admitted.get_status(v1::GetStatusRequest {}).await.expect("others do not suffer");
    for stream in &mut silent {
        assert!(is_closed(stream).await, "CN-2");
    }
    // There is room again.
    let (mut late, _) = join(&coordinator, "late").await;
    late.get_status(v1::GetStatusRequest {}).await.unwrap();
    assert!(count(&metrics, "sightline_refusals_total") >= 5);
}

#[tokio::test]
async fn there_are_at_most_so_many_connections() {
    let limits = ConnectionLimits { connections_max: 2, ..Default::default() };
    let coordinator = start(limits, &Arc::default()).await;
    let (mut a, _) = join(&coordinator, "a").await;
    let (b, _) = join(&coordinator, "b").await;
    let mut third = TcpStream::connect(coordinator.addr).await.unwrap();
    assert!(is_closed(&mut third).await, "CN-1");
    a.get_status(v1::GetStatusRequest {}).await.unwrap();
    drop(b);
    // The place is free as soon as the coordinator has seen the end of it.
    let again = async {
        loop {
            if let Ok(mut client) = CoordinatorClient::connect(coordinator.url()).await
                && client.get_status(v1::GetStatusRequest {}).await.is_ok()
            {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(10), again).await.expect("a place is free again");
}

#[tokio::test]
async fn garbage_is_refused_at_its_first_wrong_byte_and_counted() {
    let metrics = Arc::new(Metrics::default());
    let coordinator = start(ConnectionLimits::default(), &metrics).await;
    for bytes in [&b"X"[..], b"PRI * HTTP/1.1\r\n", &[0x16, 3, 1], b"GET / HTTP/1.1\r\n\r\n"] {
        let mut stream = TcpStream::connect(coordinator.addr).await.unwrap();
        stream.write_all(bytes).await.unwrap();
        assert!(is_closed(&mut stream).await, "CN-3");
    }
    assert_eq!(count(&metrics, "sightline_refusals_total"), 4);
    let (mut client, _) = join(&coordinator, "well-behaved").await;
    client.get_status(v1::GetStatusRequest {}).await.unwrap();
    let answered = "sightline_rpcs_total{method=\"GetStatus\",code=\"ok\"}";
    assert_eq!(count(&metrics, answered), 1);
}
