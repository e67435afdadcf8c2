//! What the coordinator of a cluster costs: planning, leasing, committing, starting again, and waiting for
//! a slow worker. The coordinator is the real one, over gRPC on loopback with a file store that is synced;
//! workers write parts and commits as real ones do, and compute nothing.
//!
//! ```sh
//! cargo run --release -p sightline-benches --bin cluster -- plan --tasks 1000000
//! cargo run --release -p sightline-benches --bin cluster -- load --tasks 20000 --workers 1000
//! cargo run --release -p sightline-benches --bin cluster -- restart --tasks 100000
//! cargo run --release -p sightline-benches --bin cluster -- straggler
//! ```
#![allow(clippy::print_stdout)]

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::{Parser, Subcommand};
use glam::DVec3;
use prost::Message;
use sightline_coordinator::journal::Journal;
use sightline_coordinator::{
    Coordinator, CoordinatorError, CoordinatorHandle, CoordinatorOptions, Publish,
};
use sightline_geometry::{CellId, ViewCell};
use sightline_jobs::{BakeConfig, FORMAT_VERSION, Plan, SceneRef, SkippedCells, TiledCell, plan};
use sightline_proto::v1::coordinator_client::CoordinatorClient;
use sightline_proto::v1::{self, lease_response::Answer, report_request};
use sightline_proto::{decode_plan, encode_plan};
use sightline_store::{BakeStore, PartKind, Published, keys};
use tokio::task::JoinSet;
use tonic::transport::Channel;

type Error = Box<dyn std::error::Error + Send + Sync>;

/// Measures the coordinator.
#[derive(Parser)]
struct Arguments {
    /// What to measure.
    #[command(subcommand)]
    what: What,
    /// Folder for the store; a temporary one when absent.
    #[arg(long, global = true)]
    folder: Option<PathBuf>,
}

#[derive(Subcommand)]
enum What {
    /// Plans, stores and reads a bake of so many tasks.
    Plan {
        /// Tasks, about.
        #[arg(long, default_value_t = 1_000_000)]
        tasks: u32,
    },
    /// Workers commit tasks as fast as they can.
    Load {
        /// Tasks of the plan, about.
        #[arg(long, default_value_t = 20_000)]
        tasks: u32,
        /// Workers.
        #[arg(long, default_value_t = 1000)]
        workers: u32,
        /// Stop behind so many commits.
        #[arg(long)]
        commits: Option<u32>,
    },
    /// Starts a coordinator of a bake in which all tasks but a few are committed.
    Restart {
        /// Committed tasks.
        #[arg(long, default_value_t = 100_000)]
        tasks: u32,
    },
    /// Eight workers, of which one is slow, against eight equal ones.
    Straggler {
        /// Time of a task, ms.
        #[arg(long, default_value_t = 50)]
        task_ms: u64,
        /// Tasks a worker.
        #[arg(long, default_value_t = 30)]
        tasks: u32,
        /// Tasks take the slow worker so many times as long.
        #[arg(long, default_value_t = 10)]
        factor: u64,
    },
}

/// Nothing is published: the tasks are what is measured.
struct Nothing;

#[tonic::async_trait]
impl Publish for Nothing {
    async fn publish(&self, _: &Journal, _: &Plan) -> Result<Published, CoordinatorError> {
        Ok(Published { number: 1, changed: true })
    }
}

/// A plan of about so many tasks: a row of flat cells, one segment and one cell a task. A cell has four
/// segments, of which it shares one with the cell before.
fn plan_of(tasks: u32) -> Plan {
    let mut config = BakeConfig::default();
    config.region.rectangles = vec![[0.0, 0.0, 10.0, 10.0]];
    config.solver.rings = 1;
    (config.tasks.segments_per_task, config.tasks.cells_per_task) = (1, 1);
    let digest = "ab".to_owned();
    let scene = SceneRef { uri: "none".into(), name: "none".into(), digest, files: vec![] };
    let cell = |k: u32| {
        let at = |x: u32, z: f64| DVec3::new(f64::from(x) * 10.0, 1.5, z);
        let corners = [at(k, 0.0), at(k + 1, 0.0), at(k + 1, 10.0), at(k, 10.0)];
        let tile = [i32::try_from(k).unwrap_or(i32::MAX), 0];
        TiledCell { cell: ViewCell { id: CellId(k), corners, height: 0.0 }, tile }
    };
    let cells = (0..tasks.div_ceil(4).max(1)).map(cell).collect();
    plan(scene, config, vec![0.0], cells, SkippedCells::default())
}

fn main() -> Result<(), Error> {
    let Arguments { what, folder } = Arguments::parse();
    let temporary = tempfile::tempdir()?;
    let folder = folder.unwrap_or_else(|| temporary.path().to_owned());
    let store = BakeStore::open_or_create(&folder.display().to_string())?;
    let runtime = tokio::runtime::Runtime::new()?;
    runtime.block_on(async {
        match what {
            What::Plan { tasks } => planning(&store, tasks).await,
            What::Load { tasks, workers, commits } => load(&store, tasks, workers, commits).await,
            What::Restart { tasks } => restart(&store, tasks).await,
            What::Straggler { task_ms, tasks, factor } => {
                straggler(&folder, task_ms, tasks, factor).await
            }
        }
    })
}

async fn planning(store: &BakeStore, tasks: u32) -> Result<(), Error> {
    let start = Instant::now();
    let plan = plan_of(tasks);
    let planned = start.elapsed();
    let bytes = encode_plan(&plan);
    let size = bytes.len();
    store.create(&keys::plan(&plan.bake_id), bytes).await?;
    let stored = start.elapsed();
    let read = decode_plan(&store.get(&keys::plan(&plan.bake_id)).await?)?;
    let same = read == plan;
    println!(
        "{} tasks: planned in {planned:.2?}, stored {:.2?} later ({} MiB), read back in {:.2?} \
         (the same: {same}); peak {} MiB",
        plan.tasks.len(),
        stored - planned,
        size >> 20,
        start.elapsed() - stored,
        peak_mib(),
    );
    Ok(())
}

/// Peak resident memory of this process.
fn peak_mib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kib = line.and_then(|l| l.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    kib.unwrap_or(0) >> 10
}

async fn coordinator(store: &BakeStore, plan: &Plan) -> Result<CoordinatorHandle, Error> {
    let listen = "127.0.0.1:0".parse()?;
    let mut options =
        CoordinatorOptions::new(listen, store.clone(), plan.clone(), Arc::new(Nothing));
    options.linger = Duration::from_millis(200);
    Ok(Coordinator::start(options).await?)
}

/// A worker that computes nothing.
struct Idle {
    client: CoordinatorClient<Channel>,
    store: BakeStore,
    session: v1::RegisterResponse,
    task: Duration,
}

impl Idle {
    async fn join(channel: Channel, store: &BakeStore, task: Duration) -> Result<Self, Error> {
        let mut client = CoordinatorClient::new(channel);
        let request = v1::RegisterRequest {
            worker_name: "idle".into(),
            threads: 1,
            format_version: FORMAT_VERSION,
            ..v1::RegisterRequest::default()
        };
        let session = client.register(request).await?.into_inner();
        Ok(Self { client, store: store.clone(), session, task })
    }

    /// Commits tasks until there are no more, or `limit` of them.
    async fn work(mut self, limit: u32) -> Result<u32, Error> {
        let (worker_id, epoch) = (self.session.worker_id, self.session.epoch);
        let mut done = 0;
        while done < limit {
            let answer = self.client.lease(v1::LeaseRequest { worker_id, epoch }).await?;
            let leased = match answer.into_inner().answer {
                Some(Answer::Task(leased)) => leased,
                Some(Answer::Wait(_)) => continue,
                _ => break,
            };
            tokio::time::sleep(self.task).await;
            self.commit(&leased).await?;
            let result = report_request::Result::Committed(v1::Committed { solve_ms: 1 });
            let report = v1::ReportRequest {
                worker_id,
                epoch,
                lease_id: leased.lease_id,
                task: leased.task,
                result: Some(result),
            };
            self.client.report(report).await?;
            done += 1;
        }
        Ok(done)
    }

    /// The part and the commit, as a real worker writes them.
    async fn commit(&self, leased: &v1::LeasedTask) -> Result<(), Error> {
        let bake = &self.session.bake_id;
        let bytes = format!("task {}", leased.task).into_bytes();
        let key = keys::part(bake, leased.task, &leased.attempt, PartKind::Segments);
        let digest = blake3::hash(&bytes).to_hex().to_string();
        let part = v1::CommittedPart { key: key.clone(), bytes: bytes.len() as u64, digest };
        self.store.create(&key, bytes).await?;
        let (task, attempt) = (leased.task, leased.attempt.clone());
        let commit = v1::Commit { task, attempt, parts: vec![part], reused: 0 };
        self.store.create(&keys::commit(bake, task), commit.encode_to_vec()).await?;
        Ok(())
    }
}

async fn load(
    store: &BakeStore,
    tasks: u32,
    workers: u32,
    commits: Option<u32>,
) -> Result<(), Error> {
    let plan = plan_of(tasks);
    let coordinator = coordinator(store, &plan).await?;
    let limit = commits.map_or(u32::MAX, |commits| commits.div_ceil(workers));
    let mut channel = Channel::from_shared(coordinator.url())?.connect_lazy();
    let mut joined = Vec::new();
    for worker in 0..workers {
        // A connection for every fifty: files are limited, and connections are not what is measured.
        if worker % 50 == 0 {
            channel = Channel::from_shared(coordinator.url())?.connect_lazy();
        }
        joined.push(Idle::join(channel.clone(), store, Duration::ZERO).await?);
    }
    let start = Instant::now();
    let mut all = JoinSet::new();
    for idle in joined {
        all.spawn(idle.work(limit));
    }
    let mut done = 0;
    while let Some(ended) = all.join_next().await {
        done += ended??;
    }
    let took = start.elapsed();
    println!(
        "{} tasks planned, {workers} workers: {done} tasks committed in {took:.2?}, {:.0} a second; \
         peak {} MiB",
        plan.tasks.len(),
        f64::from(done) / took.as_secs_f64(),
        peak_mib(),
    );
    Ok(())
}

async fn restart(store: &BakeStore, tasks: u32) -> Result<(), Error> {
    // A quarter more, so that there is something left to lease.
    let plan = plan_of(tasks + tasks / 4 + 4);
    let journal = Journal::new(store.clone(), &plan.bake_id);
    journal.write_plan(&plan).await?;
    let start = Instant::now();
    let folder = std::path::Path::new(store.location()).join(keys::commits(&plan.bake_id));
    std::fs::create_dir_all(&folder)?;
    for task in 0..tasks {
        // Not synced: how the commits got there is not what is measured.
        let commit = v1::Commit { task, attempt: "e1-w1-l1".into(), parts: vec![], reused: 0 };
        let key = keys::commit(&plan.bake_id, task);
        std::fs::write(std::path::Path::new(store.location()).join(key), commit.encode_to_vec())?;
    }
    println!("{tasks} commits were written in {:.2?}", start.elapsed());
    let start = Instant::now();
    let coordinator = coordinator(store, &plan).await?;
    let listening = start.elapsed();
    let channel = Channel::from_shared(coordinator.url())?.connect().await?;
    let done = Idle::join(channel, store, Duration::ZERO).await?.work(1).await?;
    let resumed = coordinator.status().borrow().tasks_resumed;
    println!(
        "{} tasks, {resumed} of them found committed: listening in {listening:.2?}, {done} task \
         leased and committed {:.2?} later; peak {} MiB",
        plan.tasks.len(),
        start.elapsed() - listening,
        peak_mib(),
    );
    Ok(())
}

async fn straggler(
    folder: &std::path::Path,
    task_ms: u64,
    tasks: u32,
    factor: u64,
) -> Result<(), Error> {
    const WORKERS: u32 = 8;
    let plan = plan_of(WORKERS * tasks);
    let mut walls = Vec::new();
    for (run, slow) in [("equal", 1), ("slow", factor)] {
        let store = BakeStore::open_or_create(&folder.join(run).display().to_string())?;
        let coordinator = coordinator(&store, &plan).await?;
        let start = Instant::now();
        let mut all = JoinSet::new();
        for worker in 0..WORKERS {
            let times = if worker == 0 { slow } else { 1 };
            let channel = Channel::from_shared(coordinator.url())?.connect().await?;
            let task = Duration::from_millis(task_ms * times);
            all.spawn(Idle::join(channel, &store, task).await?.work(u32::MAX));
        }
        let mut status = coordinator.status();
        status.wait_for(|status| status.phase.is_final()).await?;
        walls.push(start.elapsed().as_secs_f64());
        drop(all);
    }
    println!(
        "{} tasks of {task_ms} ms on 8 workers: {:.2} s; with one {factor} times slower: {:.2} s, \
         {:+.1} %",
        plan.tasks.len(),
        walls[0],
        walls[1],
        (walls[1] / walls[0] - 1.0) * 100.0,
    );
    Ok(())
}
