//! Runs a plan to its end.
//!
//! [`Coordinator::start`] takes the steps of [`crate::journal`], serves workers, and returns a
//! handle. Two tasks run on the caller's tokio runtime: the gRPC server, and a loop that wakes at
//! every change and every tick, ends leases that ran out, and moves the phase on.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use futures::Stream;
use sightline_jobs::{BakeStatus, Outcome, Phase, Plan, SchedulePolicy, pause_ms};
use sightline_proto::v1::coordinator_server::CoordinatorServer;
use sightline_proto::{MESSAGE_BYTES_MAX, v1};
use sightline_store::{BakeStore, Operation};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Notify, oneshot, watch};
use tokio::task::JoinHandle;

use crate::CoordinatorError;
use crate::accept::connections;
use crate::clock::{Clock, MonotonicClock};
use crate::dataset::Publish;
use crate::journal::Journal;
use crate::metrics::{CountLayer, Metrics};
use crate::security::{Gate, GateLayer, SecurityOptions};
use crate::service::{Service, Shared};
use crate::state::State;

/// Shortest time between two looks at the state, ms: how fine progress is shown.
const TICK_MS: u64 = 100;
/// How long calls in flight may take at the end.
const DRAIN_TIME: Duration = Duration::from_secs(2);
/// First and longest pause while the store does not answer, ms.
const OUTAGE_PAUSE_MS: u64 = 200;
const OUTAGE_PAUSE_MS_MAX: u64 = 10_000;
/// Time between two looks for a newer epoch in the store, ms.
const EPOCH_CHECK_MS: u64 = 5_000;
/// Time between two looks for commits in the store while no worker is at hand, ms.
const COMMITS_CHECK_MS: u64 = 30_000;
/// The same when somebody spoke of a newer epoch: who says so again and again costs little.
const EPOCH_DOUBT_MS: u64 = 500;
/// Calls that a connection may have in flight.
const STREAMS_MAX: u32 = 256;
/// Longest time until a call is answered, or its answer begins.
const REQUEST_TIME: Duration = Duration::from_secs(30);
/// Largest headers of a call, bytes.
const HEADER_BYTES_MAX: u32 = 16 << 10;
/// A connection on which nothing is heard for as long is asked whether it is alive, and has so long
/// to answer.
const KEEPALIVE_EVERY: Duration = Duration::from_secs(10);
const KEEPALIVE_TIME: Duration = Duration::from_secs(10);

/// How to run a bake.
pub struct CoordinatorOptions {
    /// Where to listen; port 0 takes a free one.
    pub listen: SocketAddr,
    /// Where the bake's state and the dataset go.
    pub store: BakeStore,
    /// The plan.
    pub plan: Plan,
    /// The last step.
    pub publisher: Arc<dyn Publish>,
    /// Leases and retries.
    pub policy: SchedulePolicy,
    /// How long to go on with no worker at hand; `None` waits for ever.
    pub worker_wait: Option<Duration>,
    /// How long to stay at the end, so that workers learn of it.
    pub linger: Duration,
    /// The clock that leases are measured with.
    pub clock: Arc<dyn Clock>,
    /// How long to go on while the store does not answer.
    pub patience: Duration,
    /// Tells coordinators that race for an epoch apart: no two may have the same.
    pub name: String,
    /// Who may talk to the coordinator.
    pub security: SecurityOptions,
    /// What is counted.
    pub metrics: Arc<Metrics>,
}

impl CoordinatorOptions {
    /// Options with the defaults of the command.
    #[must_use]
    pub fn new(
        listen: SocketAddr,
        store: BakeStore,
        plan: Plan,
        publisher: Arc<dyn Publish>,
    ) -> Self {
        Self {
            listen,
            store,
            plan,
            publisher,
            policy: SchedulePolicy::default(),
            worker_wait: None,
            linger: Duration::from_secs(5),
            clock: Arc::new(MonotonicClock::default()),
            patience: Duration::from_secs(300),
            name: unique_name(),
            security: SecurityOptions::default(),
            metrics: Arc::default(),
        }
    }
}

/// How a bake ended with a dataset.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    /// Number of the current manifest.
    pub manifest: u64,
    /// False when this very dataset was current already.
    pub changed: bool,
    /// The last status, with counts and times.
    pub status: BakeStatus,
}

/// The coordinator of a bake.
pub struct Coordinator;

/// A running coordinator. Dropping it stops the coordinator; the bake can be resumed.
pub struct CoordinatorHandle {
    /// Where it listens.
    pub addr: SocketAddr,
    is_encrypted: bool,
    status: watch::Receiver<BakeStatus>,
    stop: Option<oneshot::Sender<()>>,
    end: JoinHandle<Result<Summary, CoordinatorError>>,
    shared: Arc<Shared>,
}

impl CoordinatorHandle {
    /// What checks the invariants of the scheduler's state, for simulations: it panics with the first
    /// that does not hold.
    pub fn auditor(&self) -> impl Fn() + Send + Sync + 'static {
        let shared = Arc::downgrade(&self.shared);
        move || {
            if let Some(shared) = shared.upgrade() {
                shared.state().assert_well_formed();
            }
        }
    }

    /// The address for workers on this machine, as a URL.
    #[must_use]
    pub fn url(&self) -> String {
        let scheme = if self.is_encrypted { "https" } else { "http" };
        format!("{scheme}://{}", self.addr)
    }

    /// The status, now and at every change.
    #[must_use]
    pub fn status(&self) -> watch::Receiver<BakeStatus> {
        self.status.clone()
    }

    /// Asks the coordinator to stop. The bake can be resumed.
    pub fn shutdown(&mut self) {
        if let Some(stop) = self.stop.take() {
            // It may have ended by itself.
            let _ = stop.send(());
        }
    }

    /// Waits for the end.
    ///
    /// # Errors
    /// Why there is no dataset.
    pub async fn join(self) -> Result<Summary, CoordinatorError> {
        // Held until the end: a dropped sender would look like a request to stop.
        let _stop = self.stop;
        match self.end.await {
            Ok(end) => end,
            Err(error) => Err(CoordinatorError::Defect(error.to_string())),
        }
    }
}

impl Coordinator {
    /// Starts a bake, or goes on with one, and serves workers.
    ///
    /// # Errors
    /// When the store breaks its promises, holds another plan, or cannot be listened for.
    pub async fn start(options: CoordinatorOptions) -> Result<CoordinatorHandle, CoordinatorError> {
        // Refused before anything is opened.
        Gate::new(&options.security, options.listen, Arc::clone(&options.metrics))?;
        let (listener, addr) = listen(options.listen).await?;
        Self::start_on(options, stream_of(listener), addr).await
    }

    /// As [`Coordinator::start`], with connections that were accepted elsewhere; `addr` is where workers
    /// reach it.
    ///
    /// # Errors
    /// As [`Coordinator::start`].
    pub async fn start_on<IO>(
        mut options: CoordinatorOptions,
        accepted: impl Stream<Item = std::io::Result<(IO, SocketAddr)>> + Send + 'static,
        addr: SocketAddr,
    ) -> Result<CoordinatorHandle, CoordinatorError>
    where
        IO: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let counted = options.metrics.store.clone();
        let observer = Arc::new(move |o: Operation| counted.operation(o.kind, o.result, o.time));
        options.store = options.store.observed(observer);
        let gate = Gate::new(&options.security, options.listen, Arc::clone(&options.metrics))?;
        let gate = Arc::new(gate);
        let mut outage = Outage::new(options.patience);
        let (shared, status) = loop {
            match open_bake(&options, addr).await {
                Ok(opened) => break opened,
                Err(error) => outage.wait_out(error).await?,
            }
        };
        let (stop, stopped) = oneshot::channel();
        let (stop_server, server_stopped) = oneshot::channel();
        let is_encrypted = gate.tls().is_some();
        let server = tokio::spawn(serve(accepted, Arc::clone(&shared), gate, server_stopped));
        let audited = Arc::clone(&shared);
        let now_ms = shared.clock.now_ms();
        let run = Run { shared, options, addr, epoch_checked_ms: 0, commits_checked_ms: now_ms };
        let end = tokio::spawn(async move {
            let end = run.drive(stopped).await;
            let _ = stop_server.send(());
            match server.await {
                Ok(Ok(())) => end,
                Ok(Err(error)) => end.and(Err(CoordinatorError::Defect(error.to_string()))),
                Err(error) => end.and(Err(CoordinatorError::Defect(error.to_string()))),
            }
        });
        let stop = Some(stop);
        Ok(CoordinatorHandle { addr, is_encrypted, status, stop, end, shared: audited })
    }
}

async fn listen(address: SocketAddr) -> Result<(TcpListener, SocketAddr), CoordinatorError> {
    let failed = |source| CoordinatorError::Listen { address, source };
    let listener = TcpListener::bind(address).await.map_err(failed)?;
    let bound = listener.local_addr().map_err(failed)?;
    Ok((listener, bound))
}

/// The steps of [`crate::journal`].
async fn open_bake(
    options: &CoordinatorOptions,
    addr: SocketAddr,
) -> Result<(Arc<Shared>, watch::Receiver<BakeStatus>), CoordinatorError> {
    let CoordinatorOptions { store, plan, policy, clock, .. } = options;
    store.probe().await?;
    let journal = Journal::new(store.clone(), &plan.bake_id);
    journal.write_plan(plan).await?;
    let epoch = journal.claim_epoch(&format!("{addr} {}", options.name)).await?;
    let committed = journal.committed_tasks().await?;

    let mut state = State::new(plan.clone(), epoch, *policy, clock.now_ms());
    state.resume(committed);
    state.enter(Phase::Solving, clock.now_ms());
    let status = state.status(clock.now_ms());
    tracing::info!(
        bake = plan.bake_id,
        epoch,
        tasks = status.tasks.tasks,
        resumed = status.tasks_resumed,
        %addr,
        "the bake starts"
    );
    let (status, watched) = watch::channel(status);
    let shared = Shared {
        state: std::sync::Mutex::new(state),
        journal,
        clock: Arc::clone(clock),
        status,
        changes: Notify::new(),
        store_location: absolute(store.location()),
        scene_uri: absolute(&plan.scene.uri),
        lease_ms: policy.lease_ms,
        metrics: Arc::clone(&options.metrics),
    };
    Ok((Arc::new(shared), watched))
}

/// No two coordinators have the same process and start; those on different machines differ by a hash
/// that starts from random bytes. Names only; nothing is decided by the time in it.
fn unique_name() -> String {
    let started = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |since| since.as_nanos());
    let salt = std::hash::BuildHasher::hash_one(&std::hash::RandomState::new(), started);
    format!("process {} started {started} {salt:016x}", std::process::id())
}

/// A path as workers elsewhere on this machine can use it; URLs stay as they are.
fn absolute(location: &str) -> String {
    if location.contains("://") {
        return location.to_owned();
    }
    std::path::absolute(location)
        .map_or_else(|_| location.to_owned(), |path| path.display().to_string())
}

async fn serve<IO>(
    accepted: impl Stream<Item = std::io::Result<(IO, SocketAddr)>> + Send + 'static,
    shared: Arc<Shared>,
    gate: Arc<Gate>,
    stopped: oneshot::Receiver<()>,
) -> Result<(), Box<dyn std::error::Error + Send + Sync>>
where
    IO: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<CoordinatorServer<Service>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(v1::FILE_DESCRIPTOR_SET)
        .build_v1()?;
    let counts = CountLayer(shared.metrics.as_ref().clone());
    let scaler = crate::scaler::service(shared.status.subscribe());
    let service = CoordinatorServer::new(Service(shared))
        .max_decoding_message_size(MESSAGE_BYTES_MAX)
        .max_encoding_message_size(MESSAGE_BYTES_MAX);
    let (draining, drain) = oneshot::channel();
    let incoming = connections(accepted, Arc::clone(&gate));
    let server = limited()
        .layer(counts)
        .layer(GateLayer(gate))
        .add_service(health_service)
        .add_service(reflection)
        .add_service(service)
        .add_service(scaler)
        .serve_with_incoming_shutdown(incoming, async {
            // A dropped sender asks for the end too.
            let _ = stopped.await;
            let _ = draining.send(());
        });
    // Calls in flight get their answers, but nobody's open stream holds the end up.
    let drained = async {
        if drain.await.is_ok() {
            tokio::time::sleep(DRAIN_TIME).await;
        } else {
            std::future::pending::<()>().await;
        }
    };
    tokio::select! {
        biased;
        served = server => Ok(served?),
        () = drained => Ok(()),
    }
}

/// A store that does not answer, and for how long.
struct Outage {
    patience: Duration,
    since: Option<tokio::time::Instant>,
    tries: u32,
}

impl Outage {
    const fn new(patience: Duration) -> Self {
        Self { patience, since: None, tries: 0 }
    }

    fn is_over(&mut self) {
        (self.since, self.tries) = (None, 0);
    }

    /// Waits before another try, when the error is one that passes and there is patience left.
    async fn wait_out(&mut self, error: CoordinatorError) -> Result<(), CoordinatorError> {
        let since = *self.since.get_or_insert_with(tokio::time::Instant::now);
        if !error.passes() || since.elapsed() > self.patience {
            return Err(error);
        }
        let pause = pause_ms(OUTAGE_PAUSE_MS, OUTAGE_PAUSE_MS_MAX, self.tries, 0);
        tracing::warn!(%error, pause_ms = pause, "the store does not answer; trying again");
        self.tries += 1;
        tokio::time::sleep(Duration::from_millis(pause)).await;
        Ok(())
    }
}

/// A server that nobody can make hold more than a bounded amount, and that notices who is gone.
pub(crate) fn limited() -> tonic::transport::Server {
    tonic::transport::Server::builder()
        .max_concurrent_streams(STREAMS_MAX)
        .concurrency_limit_per_connection(STREAMS_MAX as usize)
        .timeout(REQUEST_TIME)
        .http2_max_header_list_size(HEADER_BYTES_MAX)
        .http2_keepalive_interval(Some(KEEPALIVE_EVERY))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIME))
        .tcp_keepalive(Some(KEEPALIVE_EVERY))
}

/// Accepted connections with their addresses.
fn stream_of(
    listener: TcpListener,
) -> impl futures::Stream<Item = std::io::Result<(TcpStream, SocketAddr)>> + Send {
    futures::stream::unfold(listener, |listener| async move {
        let accepted = listener.accept().await.and_then(|(stream, address)| {
            stream.set_nodelay(true)?;
            Ok((stream, address))
        });
        Some((accepted, listener))
    })
}

/// The loop of a running coordinator.
struct Run {
    shared: Arc<Shared>,
    options: CoordinatorOptions,
    addr: SocketAddr,
    epoch_checked_ms: u64,
    commits_checked_ms: u64,
}

impl Run {
    /// Runs to the end, and says goodbye to the workers.
    async fn drive(mut self, stopped: oneshot::Receiver<()>) -> Result<Summary, CoordinatorError> {
        let shared = Arc::clone(&self.shared);
        let end = tokio::select! {
            biased;
            end = self.solve_and_publish() => end,
            _ = stopped => Err(CoordinatorError::Stopped),
        };
        // A coordinator that was stopped or replaced does not tell workers that the bake is over:
        // they look for the next one.
        let is_over =
            !matches!(end, Err(CoordinatorError::Stopped | CoordinatorError::Superseded { .. }));
        if !is_over {
            shared.state().close();
        }
        match &end {
            Ok(published) => shared.change(|s, now_ms| s.published(published.number, now_ms)),
            Err(error) => shared.change(|s, now_ms| s.failed_for_good(error.to_string(), now_ms)),
        }
        shared.send_status();
        if is_over {
            self.linger().await;
        }
        let status = shared.status.borrow().clone();
        let published = end?;
        tracing::info!(manifest = published.number, "the dataset is published");
        Ok(Summary { manifest: published.number, changed: published.changed, status })
    }

    /// An outage of the store is waited out: nothing is lost by it but time.
    async fn solve_and_publish(&mut self) -> Result<sightline_store::Published, CoordinatorError> {
        let mut outage = Outage::new(self.options.patience);
        while let Err(error) = self.solve(&mut outage).await {
            outage.wait_out(error).await?;
        }
        let mut outage = Outage::new(self.options.patience);
        loop {
            match self.publish().await {
                Ok(published) => return Ok(published),
                Err(error) => outage.wait_out(error).await?,
            }
        }
    }

    async fn publish(&mut self) -> Result<sightline_store::Published, CoordinatorError> {
        self.shared.change(|state, now_ms| state.enter(Phase::Merging, now_ms));
        self.shared.send_status();
        tracing::info!("all tasks are committed; the dataset is put together");
        let publish = self.options.publisher.publish(&self.shared.journal, &self.options.plan);
        tokio::pin!(publish);
        loop {
            // The state is looked after meanwhile: workers are waiting.
            tokio::select! {
                biased;
                published = &mut publish => return published,
                () = tokio::time::sleep(Duration::from_millis(TICK_MS)) => {
                    self.shared.state().tick(self.shared.clock.now_ms());
                    self.shared.send_status();
                }
            }
        }
    }

    /// Until every task is committed.
    async fn solve(&mut self, outage: &mut Outage) -> Result<(), CoordinatorError> {
        let shared = Arc::clone(&self.shared);
        loop {
            let mut changed = std::pin::pin!(shared.changes.notified());
            changed.as_mut().enable();
            self.end_lost_leases().await?;
            self.check_epoch().await?;
            self.check_commits().await?;
            outage.is_over();
            self.shared.send_status();
            match self.shared.state().outcome() {
                Outcome::Complete => return Ok(()),
                Outcome::Missing(missing) => return Err(CoordinatorError::Missing(missing)),
                Outcome::Running => {}
            }
            self.check_workers()?;
            // At most one look a tick, and at once when the last was longer ago.
            tokio::time::sleep(Duration::from_millis(TICK_MS / 5)).await;
            let _ = tokio::time::timeout(Duration::from_millis(TICK_MS), changed).await;
        }
    }

    /// A worker that went silent may have committed first.
    async fn end_lost_leases(&self) -> Result<(), CoordinatorError> {
        let now_ms = self.shared.clock.now_ms();
        let lost = self.shared.state().tick(now_ms);
        for lease in &lost {
            self.shared.metrics.lease_lost();
            tracing::warn!(
                task = lease.task.0,
                lease = lease.id.0,
                worker = %lease.worker,
                "a lease ran out"
            );
            if self.shared.journal.commit(lease.task).await?.is_some() {
                self.shared.change(|state, now_ms| {
                    state.committed(lease.task, None, now_ms);
                });
            }
        }
        let has_work = self.shared.state().has_work();
        if has_work {
            // Whoever waits for a task looks again.
            self.shared.change(|_, _| ());
        }
        Ok(())
    }

    async fn check_epoch(&mut self) -> Result<(), CoordinatorError> {
        let now_ms = self.shared.clock.now_ms();
        let since_ms = now_ms.saturating_sub(self.epoch_checked_ms);
        let is_in_doubt = since_ms >= EPOCH_DOUBT_MS && self.shared.state().take_doubt();
        if is_in_doubt || since_ms >= EPOCH_CHECK_MS {
            self.epoch_checked_ms = now_ms;
            let newest = self.shared.journal.newest_epoch().await?;
            self.shared.state().see_epoch(newest);
        }
        let state = self.shared.state();
        match state.newer_epoch() {
            Some(newest) => Err(CoordinatorError::Superseded { own: state.epoch, newest }),
            None => Ok(()),
        }
    }

    /// A coordinator that this one has replaced, and its workers, may do all that is left before they hear of
    /// it: then nobody comes any more, and nothing is left to be done.
    async fn check_commits(&mut self) -> Result<(), CoordinatorError> {
        let now_ms = self.shared.clock.now_ms();
        let is_alone = self.shared.state().worker_count() == 0;
        if !is_alone || now_ms.saturating_sub(self.commits_checked_ms) < COMMITS_CHECK_MS {
            return Ok(());
        }
        self.commits_checked_ms = now_ms;
        let committed = self.shared.journal.committed_tasks().await?;
        self.shared.change(|state, now_ms| state.see_commits(&committed, now_ms));
        Ok(())
    }

    fn check_workers(&self) -> Result<(), CoordinatorError> {
        let waited_ms = self.shared.state().lonely_ms(self.shared.clock.now_ms());
        match self.options.worker_wait {
            Some(wait) if u128::from(waited_ms) > wait.as_millis() => {
                Err(CoordinatorError::NoWorkers { waited_ms, address: self.addr })
            }
            _ => Ok(()),
        }
    }

    /// Until all workers know that the bake is over, or the time for that is up.
    async fn linger(&self) {
        let all_told = async {
            while self.shared.state().worker_count() > 0 {
                tokio::time::sleep(Duration::from_millis(TICK_MS / 5)).await;
                self.shared.state().tick(self.shared.clock.now_ms());
            }
        };
        if tokio::time::timeout(self.options.linger, all_told).await.is_err() {
            tracing::info!("some workers did not hear of the end");
        } else {
            // The last answer is still on its way out.
            tokio::time::sleep(Duration::from_millis(TICK_MS)).await;
        }
    }
}
