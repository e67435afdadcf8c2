//! The protocol between a coordinator and workers, over real loopback gRPC, with workers that
//! write parts without solving anything.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use glam::DVec3;
use prost::Message;
use sightline_coordinator::clock::Clock;
use sightline_coordinator::journal::Journal;
use sightline_coordinator::{
    Coordinator, CoordinatorError, CoordinatorHandle, CoordinatorOptions, Publish,
};
use sightline_geometry::{CellId, ViewCell};
use sightline_jobs::{
    BakeConfig, FORMAT_VERSION, Phase, Plan, SceneRef, SkippedCells, TaskId, TiledCell, plan,
};
use sightline_proto::v1::{self, coordinator_client::CoordinatorClient, lease_response::Answer};
use sightline_store::{BakeStore, Created, PartKind, Published, keys};
use tonic::Code;
use tonic::transport::Channel;

const LEASE_MS: u64 = 600;

/// Checks that all tasks are committed, and publishes nothing.
struct CountCommits;

#[tonic::async_trait]
impl Publish for CountCommits {
    async fn publish(&self, journal: &Journal, plan: &Plan) -> Result<Published, CoordinatorError> {
        for task in &plan.tasks {
            let commit = journal.commit(task.id).await?.expect("JB-2: every task is committed");
            for part in &commit.parts {
                journal.part(part).await?;
            }
        }
        Ok(Published { number: 7, changed: true })
    }
}

/// A row of flat cells: 3 n + 1 segments a ring.
fn sample_plan(cells: u32) -> Plan {
    moving_plan(cells, vec![0.0])
}

/// The same in a scene with key frames at these times; two states a task.
fn moving_plan(cells: u32, key_times: Vec<f64>) -> Plan {
    let mut config = BakeConfig::default();
    config.region.rectangles = vec![[0.0, 0.0, 10.0, 10.0]];
    config.solver.rings = 1;
    config.tasks.segments_per_task = 4;
    config.tasks.cells_per_task = 2;
    config.tasks.states_per_task = 2;
    let scene = SceneRef {
        uri: "city.glb".into(),
        name: "city.glb".into(),
        digest: "ab".into(),
        files: vec![],
    };
    let cell = |k: u32| {
        let at = |x: u32, z: f64| DVec3::new(f64::from(x) * 10.0, 1.5, z);
        TiledCell {
            cell: ViewCell {
                id: CellId(k),
                corners: [at(k, 0.0), at(k + 1, 0.0), at(k + 1, 10.0), at(k, 10.0)],
                height: 0.0,
            },
            tile: [i32::try_from(k).unwrap(), 0],
        }
    };
    plan(scene, config, key_times, (0..cells).map(cell).collect(), SkippedCells::default())
}

fn options(store: &BakeStore, plan: &Plan) -> CoordinatorOptions {
    let listen = "127.0.0.1:0".parse().unwrap();
    let mut options =
        CoordinatorOptions::new(listen, store.clone(), plan.clone(), Arc::new(CountCommits));
    options.policy.lease_ms = LEASE_MS;
    options.linger = Duration::from_millis(500);
    options
}

async fn start(store: &BakeStore, plan: &Plan) -> CoordinatorHandle {
    Coordinator::start(options(store, plan)).await.unwrap()
}

/// A worker of which the test says what it does.
struct FakeWorker {
    client: CoordinatorClient<Channel>,
    store: BakeStore,
    session: v1::RegisterResponse,
}

impl FakeWorker {
    async fn join(coordinator: &CoordinatorHandle, store: &BakeStore) -> Self {
        let mut client = CoordinatorClient::connect(coordinator.url()).await.unwrap();
        let session = client.register(registration(0)).await.unwrap().into_inner();
        Self { client, store: store.clone(), session }
    }

    async fn ask(&mut self) -> Answer {
        let (worker_id, epoch) = (self.session.worker_id, self.session.epoch);
        let answer = self.client.lease(v1::LeaseRequest { worker_id, epoch }).await.unwrap();
        answer.into_inner().answer.unwrap()
    }

    /// The next task; `None` at the end.
    async fn lease(&mut self) -> Option<v1::LeasedTask> {
        loop {
            match self.ask().await {
                Answer::Task(task) => return Some(task),
                Answer::Finished(_) => return None,
                Answer::Wait(_) => {}
            }
        }
    }

    /// Writes the part and the commit of a task, as a real worker does.
    async fn commit(&self, task: &v1::LeasedTask) -> Created {
        let bake = &self.session.bake_id;
        let bytes = format!("task {}", task.task).into_bytes();
        let key = keys::part(bake, task.task, &task.attempt, PartKind::Segments);
        assert_eq!(self.store.create(&key, bytes.clone()).await.unwrap(), Created::ByUs);
        let part = v1::CommittedPart {
            key,
            bytes: bytes.len() as u64,
            digest: blake3::hash(&bytes).to_hex().to_string(),
        };
        let commit = v1::Commit {
            task: task.task,
            attempt: task.attempt.clone(),
            parts: vec![part],
            reused: 0,
        };
        let key = keys::commit(bake, task.task);
        self.store.create(&key, commit.encode_to_vec()).await.unwrap()
    }

    async fn report(
        &mut self,
        task: &v1::LeasedTask,
        result: v1::report_request::Result,
    ) -> Result<(), tonic::Status> {
        let request = v1::ReportRequest {
            worker_id: self.session.worker_id,
            epoch: self.session.epoch,
            lease_id: task.lease_id,
            task: task.task,
            result: Some(result),
        };
        self.client.report(request).await.map(drop)
    }

    async fn work_on(&mut self, task: &v1::LeasedTask) {
        self.commit(task).await;
        self.report(task, committed()).await.unwrap();
    }

    /// Works until the end; gives the tasks it did.
    async fn work(&mut self) -> Vec<u32> {
        let mut done = Vec::new();
        while let Some(task) = self.lease().await {
            self.work_on(&task).await;
            done.push(task.task);
        }
        done
    }
}

fn registration(newest_epoch: u64) -> v1::RegisterRequest {
    v1::RegisterRequest {
        worker_name: "fake".into(),
        threads: 1,
        format_version: FORMAT_VERSION,
        newest_epoch,
        bake_id: String::new(),
    }
}

fn committed() -> v1::report_request::Result {
    v1::report_request::Result::Committed(v1::Committed { solve_ms: 5 })
}

fn failed(class: v1::FailureClass) -> v1::report_request::Result {
    let reason = "it broke".to_owned();
    v1::report_request::Result::Failed(v1::Failed { class: class.into(), reason })
}

#[tokio::test]
async fn ranges_of_states_are_solved_and_then_joined() {
    let store = BakeStore::in_memory();
    let plan = moving_plan(9, vec![0.0, 1.0, 2.0, 4.0, 5.0, 7.0]);
    let coordinator = start(&store, &plan).await;
    let mut worker = FakeWorker::join(&coordinator, &store).await;
    let done = worker.work().await;
    let wanted: Vec<u32> = (0..u32::try_from(plan.tasks.len()).unwrap()).collect();
    assert_eq!(done, wanted, "one worker takes them in their order");
    let status = coordinator.join().await.unwrap().status;
    assert_eq!((status.cells.done, status.segments.done), (3 * 9, 3 * 28));
    assert_eq!((status.joins.done, status.joins.total, status.dataset_cells()), (9, 9, 9));
}

/// A clock that a test sets.
#[derive(Default)]
struct SetClock(AtomicU64);

impl Clock for SetClock {
    fn now_ms(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

#[tokio::test]
async fn commits_behind_its_back_end_a_bake_to_which_nobody_comes() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(9));
    let clock = Arc::new(SetClock::default());
    let mut options = options(&store, &plan);
    options.clock = Arc::<SetClock>::clone(&clock);
    let coordinator = Coordinator::start(options).await.unwrap();
    // As the workers of a coordinator do that has not heard yet of this one.
    for task in &plan.tasks {
        let commit =
            v1::Commit { task: task.id.0, attempt: "e1-w1-l1".into(), ..Default::default() };
        let key = keys::commit(&plan.bake_id, task.id.0);
        store.create(&key, commit.encode_to_vec()).await.unwrap();
    }
    clock.0.store(60_000, Ordering::Relaxed);
    let end = tokio::time::timeout(Duration::from_secs(60), coordinator.join()).await;
    let status = end.expect("it looks for commits").unwrap().status;
    assert_eq!(status.tasks.committed, status.tasks.tasks);
}

#[tokio::test]
async fn a_bake_runs_to_its_end_on_two_workers() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(9));
    let coordinator = start(&store, &plan).await;
    let (mut a, mut b) = (
        FakeWorker::join(&coordinator, &store).await,
        FakeWorker::join(&coordinator, &store).await,
    );
    let (by_a, by_b) = tokio::join!(a.work(), b.work());
    let mut all: Vec<u32> = by_a.into_iter().chain(by_b).collect();
    all.sort_unstable();
    let wanted: Vec<u32> = (0..u32::try_from(plan.tasks.len()).unwrap()).collect();
    assert_eq!(all, wanted, "every task once");

    let summary = coordinator.join().await.unwrap();
    assert_eq!((summary.manifest, summary.changed), (7, true));
    let status = summary.status;
    assert_eq!(status.phase, Phase::Published);
    assert_eq!((status.cells.done, status.segments.done), (9, 28));
    assert_eq!(status.worker_solve_ms, 5 * u64::from(status.tasks.tasks));
}

#[tokio::test]
async fn a_stopped_bake_goes_on_where_it_was() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(6));
    let mut first = start(&store, &plan).await;
    let mut worker = FakeWorker::join(&first, &store).await;
    for _ in 0..2 {
        let task = worker.lease().await.unwrap();
        worker.work_on(&task).await;
    }
    // This one is committed and never reported.
    let task = worker.lease().await.unwrap();
    worker.commit(&task).await;
    first.shutdown();
    assert!(matches!(first.join().await, Err(CoordinatorError::Stopped)));
    let request = v1::LeaseRequest { worker_id: worker.session.worker_id, epoch: 1 };
    let refused = worker.client.lease(request).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable, "the bake is not over");

    let second = start(&store, &plan).await;
    assert_eq!(second.status().borrow().tasks_resumed, 3);
    let mut worker = FakeWorker::join(&second, &store).await;
    assert_eq!(worker.session.epoch, 2);
    assert_eq!(worker.work().await.len(), plan.tasks.len() - 3);
    second.join().await.unwrap();
}

#[tokio::test]
async fn a_silent_worker_loses_its_task_to_another() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    let coordinator = start(&store, &plan).await;
    let mut silent = FakeWorker::join(&coordinator, &store).await;
    let lost = silent.lease().await.unwrap();
    let mut other = FakeWorker::join(&coordinator, &store).await;
    let taken = other.lease().await.unwrap();
    assert_eq!(taken.task, lost.task);
    assert_ne!(taken.attempt, lost.attempt, "attempts write under names of their own");

    // The silent one comes back and commits first; the other finds that and reports the task.
    assert_eq!(silent.commit(&lost).await, Created::ByUs);
    assert_eq!(other.commit(&taken).await, Created::AlreadyThere);
    other.report(&taken, committed()).await.unwrap();
    assert_eq!(silent.report(&lost, committed()).await.unwrap_err().code(), Code::NotFound);
    other.work().await;
    coordinator.join().await.unwrap();
}

#[tokio::test]
async fn a_commit_without_a_report_counts_when_the_lease_ends() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    let coordinator = start(&store, &plan).await;
    let mut silent = FakeWorker::join(&coordinator, &store).await;
    let task = silent.lease().await.unwrap();
    silent.commit(&task).await;
    let mut other = FakeWorker::join(&coordinator, &store).await;
    assert!(!other.work().await.contains(&task.task));
    coordinator.join().await.unwrap();
}

#[tokio::test]
async fn heartbeats_keep_a_lease() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    let coordinator = start(&store, &plan).await;
    let mut slow = FakeWorker::join(&coordinator, &store).await;
    let task = slow.lease().await.unwrap();
    for _ in 0..8 {
        tokio::time::sleep(Duration::from_millis(LEASE_MS / 4)).await;
        let beat = v1::HeartbeatRequest {
            worker_id: slow.session.worker_id,
            epoch: slow.session.epoch,
            lease_ids: vec![task.lease_id, 999],
        };
        let answer = slow.client.heartbeat(beat).await.unwrap().into_inner();
        assert_eq!(answer.lost_lease_ids, [999]);
    }
    slow.work_on(&task).await;
    slow.work().await;
    assert_eq!(coordinator.join().await.unwrap().status.tasks.committed, 2);
}

#[tokio::test]
async fn three_workers_failing_a_task_end_the_bake_without_a_dataset() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    let coordinator = start(&store, &plan).await;
    let mut workers = Vec::new();
    for _ in 0..3 {
        workers.push(FakeWorker::join(&coordinator, &store).await);
    }
    for worker in &mut workers {
        let task = worker.lease().await.unwrap();
        assert_eq!(task.task, 0);
        worker.report(&task, failed(v1::FailureClass::RetryElsewhere)).await.unwrap();
    }
    for worker in &mut workers {
        loop {
            match worker.ask().await {
                Answer::Finished(end) => break assert!(!end.published && !end.message.is_empty()),
                Answer::Wait(_) => {}
                Answer::Task(task) => panic!("task {} is quarantined", task.task),
            }
        }
    }
    let status = coordinator.status();
    let Err(CoordinatorError::Missing(missing)) = coordinator.join().await else {
        panic!("JB-2: a published dataset is never partial")
    };
    assert_eq!(missing.quarantined[0].0, TaskId(0));
    assert_eq!(missing.quarantined[0].1.matches("it broke").count(), 3);
    assert_eq!(missing.blocked, [TaskId(1)]);
    assert_eq!(status.borrow().phase, Phase::Failed);
    assert!(status.borrow().error.contains("it broke"));
}

#[tokio::test]
async fn a_report_is_not_believed_without_a_commit() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    let coordinator = start(&store, &plan).await;
    let mut liar = FakeWorker::join(&coordinator, &store).await;
    let task = liar.lease().await.unwrap();
    assert_eq!(liar.report(&task, committed()).await.unwrap_err().code(), Code::DataLoss);
    assert_eq!(coordinator.status().borrow().tasks.committed, 0);
}

#[tokio::test]
async fn other_epochs_are_refused_and_a_newer_one_ends_a_coordinator() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(2));
    let old = start(&store, &plan).await;
    let new = start(&store, &plan).await;
    let mut worker = FakeWorker::join(&new, &store).await;
    assert_eq!(worker.session.epoch, 2);

    let request = v1::LeaseRequest { worker_id: worker.session.worker_id, epoch: 1 };
    let error = worker.client.lease(request).await.unwrap_err();
    assert_eq!(error.code(), Code::FailedPrecondition);
    let request = v1::LeaseRequest { worker_id: 99, epoch: 2 };
    assert_eq!(worker.client.lease(request).await.unwrap_err().code(), Code::NotFound);

    let mut to_old = CoordinatorClient::connect(old.url()).await.unwrap();
    let error = to_old.register(registration(2)).await.unwrap_err();
    assert_eq!(error.code(), Code::FailedPrecondition);
    let end = tokio::time::timeout(Duration::from_secs(3), old.join()).await.unwrap();
    assert!(matches!(end, Err(CoordinatorError::Superseded { own: 1, newest: 2 })));

    worker.work().await;
    new.join().await.unwrap();
}

#[tokio::test]
async fn another_version_is_refused() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    let coordinator = start(&store, &plan).await;
    let mut client = CoordinatorClient::connect(coordinator.url()).await.unwrap();
    let request = v1::RegisterRequest { format_version: 99, ..registration(0) };
    assert_eq!(client.register(request).await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test]
async fn another_plan_under_the_same_id_is_refused_and_another_path_is_not() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    drop(start(&store, &plan).await);
    let mut moved = plan.clone();
    moved.scene.uri = "elsewhere/city.glb".into();
    drop(start(&store, &moved).await);
    let mut other = plan.clone();
    other.skipped = SkippedCells(BTreeMap::from([("inside a solid".into(), 1)]));
    let error = Coordinator::start(options(&store, &other)).await.err().unwrap();
    assert!(matches!(error, CoordinatorError::PlanDiffers { .. }));
}

#[tokio::test]
async fn status_streams_until_the_end_and_goodbye_gives_leases_back() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(3));
    let coordinator = start(&store, &plan).await;
    let mut leaver = FakeWorker::join(&coordinator, &store).await;
    let task = leaver.lease().await.unwrap();
    let mut watch =
        leaver.client.watch_status(v1::WatchStatusRequest {}).await.unwrap().into_inner();
    let (worker_id, epoch) = (leaver.session.worker_id, leaver.session.epoch);
    leaver.client.goodbye(v1::GoodbyeRequest { worker_id, epoch }).await.unwrap();

    let mut worker = FakeWorker::join(&coordinator, &store).await;
    let first = worker.lease().await.unwrap();
    assert_eq!(first.task, task.task, "at once, without waiting for the lease to run out");
    worker.work_on(&first).await;
    worker.work().await;
    let mut last = None;
    while let Ok(Some(status)) = watch.message().await {
        last = Some(status);
    }
    assert_eq!(last.unwrap().phase(), v1::Phase::Published);
    coordinator.join().await.unwrap();
}

#[tokio::test]
async fn without_workers_a_bake_gives_up_when_asked_to() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    let mut options = options(&store, &plan);
    options.worker_wait = Some(Duration::from_millis(200));
    let coordinator = Coordinator::start(options).await.unwrap();
    assert!(matches!(coordinator.join().await, Err(CoordinatorError::NoWorkers { .. })));
}

#[tokio::test]
async fn health_and_reflection_answer() {
    let (store, plan) = (BakeStore::in_memory(), sample_plan(1));
    let coordinator = start(&store, &plan).await;
    let channel = Channel::from_shared(coordinator.url()).unwrap().connect().await.unwrap();
    let mut health = tonic_health::pb::health_client::HealthClient::new(channel);
    let request =
        tonic_health::pb::HealthCheckRequest { service: "sightline.v1.Coordinator".into() };
    let answer = health.check(request).await.unwrap().into_inner();
    assert_eq!(answer.status(), tonic_health::pb::health_check_response::ServingStatus::Serving);
}
