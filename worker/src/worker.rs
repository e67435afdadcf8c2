//! The life of a worker.
//!
//! ```text
//!   register --> open store, plan, scene --> lease --> attempt --> report --+
//!      ^                                       ^                            |
//!      |  the coordinator changed              +----------------------------+
//!      +---------------------------------------|
//!                                              | finished, or asked to stop
//!                                              v
//!                                           goodbye
//! ```

use std::future::Future;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use sightline_jobs::{FailureClass, Plan, TaskId};
use sightline_proto::{decode_plan, v1};
use sightline_scene::{Held, MemoryLimit, OpenOptions, Scene};
use sightline_store::{BakeStore, ErrorClass, keys};
use sightline_telemetry::trace;
use tokio::sync::watch;
use tonic::Request;
use tracing::Instrument;

use crate::WorkerError;
use crate::attempt::Bake;
use crate::compute::Compute;
use crate::connection::{CallError, Connection, Pauses, Session};
use crate::error::AttemptError;
use crate::metrics::Metrics;
use crate::pool::{Cancel, SolvePool};
use crate::scene_files::{self, SceneAccess};
use crate::security::{Client, ClientSecurity, Dial};

/// How long a goodbye may take.
const GOODBYE_TIME: Duration = Duration::from_secs(1);

/// How to work.
#[derive(Clone)]
pub struct WorkerOptions {
    /// URL of the coordinator, `http://host:port`.
    pub coordinator: String,
    /// The store; where the coordinator says when `None`.
    pub store: Option<BakeStore>,
    /// Path of the scene; where the coordinator says when `None`.
    pub scene_path: Option<PathBuf>,
    /// How to get a scene that is not on this machine.
    pub scene_access: SceneAccess,
    /// The scene, when it is in memory already.
    pub scene: Option<Arc<Scene>>,
    /// How much memory the process may take; without it, a scene that is read is in memory.
    pub memory: Option<MemoryLimit>,
    /// Threads to solve with; 0 stands for one a core.
    pub threads: usize,
    /// A name for people; need not be unique.
    pub name: String,
    /// How long to look for a coordinator that does not answer.
    pub patience: Duration,
    /// How long the task at hand may still take when the worker is asked to stop.
    pub drain: Duration,
    /// Where tasks are computed; on threads of this process when `None`.
    pub compute: Option<Arc<dyn Compute>>,
    /// How to connect to the coordinator; by TCP when `None`.
    pub dial: Option<Dial>,
    /// Credentials, and whom to trust.
    pub security: ClientSecurity,
    /// What is counted.
    pub metrics: Arc<Metrics>,
}

impl WorkerOptions {
    /// Options with the defaults of the command.
    #[must_use]
    pub fn new(coordinator: &str) -> Self {
        Self {
            coordinator: coordinator.to_owned(),
            store: None,
            scene_path: None,
            scene_access: SceneAccess::default(),
            scene: None,
            memory: None,
            threads: 0,
            name: "worker".into(),
            patience: Duration::from_secs(60),
            drain: Duration::ZERO,
            compute: None,
            dial: None,
            security: ClientSecurity::default(),
            metrics: Arc::default(),
        }
    }
}

/// What a worker did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WorkerSummary {
    /// Tasks it committed, or found committed.
    pub tasks: u64,
    /// Attempts of its that failed.
    pub failures: u64,
    /// Time spent in computing.
    pub solve_time: Duration,
    /// True when the bake ended with a dataset; false when it failed or the worker was stopped.
    pub published: bool,
    /// How the bake ended, for people.
    pub message: String,
    /// What was held of the scene when the bake ended, where memory is limited.
    pub held: Option<Held>,
}

/// A worker.
pub struct Worker;

impl Worker {
    /// Works until the bake is over or `stop` resolves. Then no task is leased any more, and the one at
    /// hand has [`WorkerOptions::drain`] to end; behind that it is given up and its lease goes back at
    /// once.
    ///
    /// # Errors
    /// When the coordinator cannot be reached for too long or refuses this worker, or the store,
    /// the plan or the scene cannot be used.
    pub async fn run(
        options: WorkerOptions,
        stop: impl Future<Output = ()> + Send,
    ) -> Result<WorkerSummary, WorkerError> {
        let pool = SolvePool::new(options.threads)?;
        let WorkerOptions { patience, drain, dial, security, .. } = &options;
        let (url, name, drain) = (&options.coordinator, &options.name, *drain);
        let connection =
            Connection::new(url, name, pool.threads(), *patience, security, dial.as_ref())?;
        let (stopping, stopped) = watch::channel(false);
        let mut life = Life {
            options,
            pool,
            connection,
            stopped,
            session: None,
            summary: WorkerSummary::default(),
            is_over: false,
        };
        let mut stop = std::pin::pin!(stop);
        let ended = {
            let mut work = std::pin::pin!(life.work());
            tokio::select! {
                biased;
                ended = &mut work => Some(ended),
                () = &mut stop => {
                    stopping.send_replace(true);
                    tokio::time::timeout(drain, work).await.ok()
                }
            }
        };
        // Who was told that the bake is over has been let go already.
        if !life.is_over {
            life.goodbye().await;
        }
        ended.unwrap_or(Ok(())).map(|()| life.summary)
    }
}

/// A running worker.
struct Life {
    options: WorkerOptions,
    pool: SolvePool,
    connection: Connection,
    /// True when the worker was asked to stop.
    stopped: watch::Receiver<bool>,
    session: Option<Session>,
    summary: WorkerSummary,
    /// True when the coordinator has said that the bake is over.
    is_over: bool,
}

/// A task that was leased.
struct Leased {
    task: TaskId,
    lease: u64,
    attempt: String,
}

impl Life {
    /// Until the bake is over, or the worker was asked to stop and has no task at hand.
    async fn work(&mut self) -> Result<(), WorkerError> {
        let mut bake: Option<Arc<Bake>> = None;
        loop {
            let mut stopped = self.stopped.clone();
            let opened = tokio::select! {
                biased;
                opened = self.begin(bake.take()) => opened?,
                () = asked_to_stop(&mut stopped) => return Ok(()),
            };
            if self.serve(&opened).await? {
                self.summary.held = opened.scene.memory.as_ref().map(|keeper| keeper.held());
                return Ok(());
            }
            bake = Some(opened);
        }
    }

    /// Registers, and opens the bake unless it is the one at hand.
    async fn begin(&mut self, at_hand: Option<Arc<Bake>>) -> Result<Arc<Bake>, WorkerError> {
        let session = self.connection.register().await?;
        tracing::info!(
            bake = session.bake_id,
            epoch = session.epoch,
            worker = session.worker,
            "registered"
        );
        self.options.metrics.registered();
        self.session = Some(session.clone());
        match at_hand {
            Some(bake) if bake.plan.bake_id == session.bake_id => Ok(bake),
            _ => self.open_alive(&session).await,
        }
    }

    /// Opens a bake; heartbeats meanwhile, since reading a scene can take longer than a lease.
    async fn open_alive(&self, session: &Session) -> Result<Arc<Bake>, WorkerError> {
        let alive = heartbeats(self.connection.client.clone(), session.clone(), None, None);
        tokio::select! {
            biased;
            opened = self.open(session) => opened,
            never = alive => match never {},
        }
    }

    /// Opens a bake; an outage of the store is waited out for as long as the patience lasts.
    async fn open(&self, session: &Session) -> Result<Arc<Bake>, WorkerError> {
        let mut pauses = Pauses::new(&self.options.name);
        loop {
            match self.try_open(session).await {
                Err(WorkerError::Store(error)) if error.class() == ErrorClass::RetryLater => {
                    tracing::warn!(%error, "the store does not answer; trying again");
                    if !pauses.wait(self.options.patience).await {
                        return Err(error.into());
                    }
                }
                opened => return opened,
            }
        }
    }

    async fn try_open(&self, session: &Session) -> Result<Arc<Bake>, WorkerError> {
        let store = match &self.options.store {
            Some(store) => store.clone(),
            None => BakeStore::open(&session.store_location)?,
        };
        let metrics = self.options.metrics.store.clone();
        let store = store.observed(Arc::new(move |o| metrics.operation(o.kind, o.result, o.time)));
        let bytes = store.get(&keys::plan(&session.bake_id)).await?;
        let plan = decode_plan(&bytes)
            .map_err(|source| WorkerError::Plan { bake_id: session.bake_id.clone(), source })?;
        let scene = self.open_scene(session, &plan, &store).await?;
        let pool: Arc<dyn Compute> = Arc::new(self.pool.clone());
        let compute = self.options.compute.clone().unwrap_or(pool);
        Ok(Arc::new(Bake::open(store, plan, scene, compute).await?))
    }

    async fn open_scene(
        &self,
        session: &Session,
        plan: &Plan,
        store: &BakeStore,
    ) -> Result<Arc<Scene>, WorkerError> {
        let path = self.options.scene_path.clone();
        let path = path.unwrap_or_else(|| PathBuf::from(&session.scene_uri));
        let scene = match &self.options.scene {
            Some(scene) => Arc::clone(scene),
            None => self.read_scene(&path, plan, store).await?,
        };
        if scene.digest.combined != session.scene_digest {
            return Err(WorkerError::OtherScene {
                path: path.display().to_string(),
                found: scene.digest.combined.clone(),
                expected: session.scene_digest.clone(),
            });
        }
        let (found, expected) = (scene.geometry.states, plan.states());
        if found != expected {
            let path = path.display().to_string();
            return Err(WorkerError::OtherStates { path, found, expected });
        }
        Ok(scene)
    }

    async fn read_scene(
        &self,
        path: &Path,
        plan: &Plan,
        store: &BakeStore,
    ) -> Result<Arc<Scene>, WorkerError> {
        // As the coordinator did.
        let asked = &plan.config.scene;
        let (place, files) = (path.to_string_lossy(), &plan.scene.files);
        let access = &self.options.scene_access;
        let found = scene_files::locate(&place, files, &asked.particles, store, access).await?;
        let path = &found.path;
        let mut options = OpenOptions::of_bake(
            path,
            &asked.see_through,
            &asked.particles,
            asked.animation.as_deref(),
            asked.motion_error,
        );
        options.memory = self.options.memory.clone();
        let (options, path) = (found.with_tables(options), path.to_owned());
        let read = self.pool.run(move || Scene::open(&path, &options)).await;
        let scene = read.map_err(|panic| WorkerError::Defect(panic.to_string()))??;
        Ok(Arc::new(scene))
    }

    /// Leases and attempts tasks. True when there is nothing more to do, false when registering is
    /// needed.
    async fn serve(&mut self, bake: &Arc<Bake>) -> Result<bool, WorkerError> {
        let session = self.session.clone().ok_or_else(not_registered)?;
        let mut stopped = self.stopped.clone();
        loop {
            let request = v1::LeaseRequest { worker_id: session.worker, epoch: session.epoch };
            // A lease whose answer is not waited for goes back with the goodbye.
            let answer = tokio::select! {
                biased;
                () = asked_to_stop(&mut stopped) => return Ok(true),
                answer = self.connection.call(async |mut client| client.lease(request).await) => {
                    answer?
                }
            };
            let answer = match answer {
                Ok(answer) => answer,
                Err(error) => return again_or_refused(error),
            };
            let metadata = answer.metadata().clone();
            match answer.into_inner().answer {
                Some(v1::lease_response::Answer::Task(task)) => {
                    let leased = Leased {
                        task: TaskId(task.task),
                        lease: task.lease_id,
                        attempt: task.attempt,
                    };
                    // The life of the task goes on where the coordinator began it.
                    let span = tracing::info_span!(
                        "attempt",
                        bake = session.bake_id,
                        epoch = session.epoch,
                        task = leased.task.0,
                        lease = leased.lease,
                        attempt = leased.attempt,
                        worker = session.worker,
                    );
                    trace::adopt(&span, &metadata);
                    self.options.metrics.holds(1);
                    let goes_on = self.attempt(&session, bake, &leased).instrument(span).await;
                    self.options.metrics.holds(0);
                    if !goes_on? {
                        return Ok(false);
                    }
                }
                Some(v1::lease_response::Answer::Wait(wait)) => {
                    tokio::time::sleep(Duration::from_millis(wait.retry_after_ms)).await;
                }
                Some(v1::lease_response::Answer::Finished(finished)) => {
                    tracing::info!(end = finished.message, "the bake is over");
                    self.summary.published = finished.published;
                    self.summary.message = finished.message;
                    self.is_over = true;
                    return Ok(true);
                }
                None => return Err(WorkerError::Refused("a LeaseResponse has no answer".into())),
            }
        }
    }

    /// Attempts a task and reports. False when registering is needed.
    async fn attempt(
        &mut self,
        session: &Session,
        bake: &Arc<Bake>,
        leased: &Leased,
    ) -> Result<bool, WorkerError> {
        if leased.task.index() >= bake.plan.tasks.len() {
            return Err(WorkerError::Refused(format!("the plan has no task {}", leased.task)));
        }
        let lost = Cancel::default();
        // Dropped when the worker is stopped: the computation then ends by itself.
        let guard = CancelOnDrop(lost.clone());
        let alive = heartbeats(
            self.connection.client.clone(),
            session.clone(),
            Some(leased.lease),
            Some(lost.clone()),
        );
        let outcome = tokio::select! {
            biased;
            outcome = bake.attempt(leased.task, &leased.attempt, &lost) => outcome,
            never = alive => match never {},
        };
        drop(guard);
        self.count(leased, bake.plan.task(leased.task).kind.name(), &outcome);
        let result = report_of(&outcome);
        let report = v1::ReportRequest {
            worker_id: session.worker,
            epoch: session.epoch,
            lease_id: leased.lease,
            task: leased.task.0,
            result: Some(result),
        };
        let sent = self
            .connection
            .call(async |mut client| client.report(report.clone()).await)
            .instrument(tracing::info_span!("report"))
            .await?;
        match sent {
            Ok(_) => Ok(true),
            // The coordinator has answered with a failure of the task.
            Err(CallError::Refused(reason)) => {
                tracing::warn!(task = leased.task.0, reason, "a report was refused");
                Ok(true)
            }
            // The next coordinator lists the commit.
            Err(_) => Ok(false),
        }
    }

    fn count(
        &mut self,
        leased: &Leased,
        kind: &'static str,
        outcome: &Result<Duration, AttemptError>,
    ) {
        match outcome {
            Ok(solve_time) => self.options.metrics.committed(kind, *solve_time),
            Err(AttemptError::GivenUp) => self.options.metrics.given_up(),
            Err(error) => self.options.metrics.failed(error.class()),
        }
        match outcome {
            Ok(solve_time) => {
                tracing::debug!(task = leased.task.0, ?solve_time, "committed");
                self.summary.tasks += 1;
                self.summary.solve_time += *solve_time;
            }
            Err(error) => {
                tracing::warn!(task = leased.task.0, %error, "an attempt failed");
                self.summary.failures += 1;
            }
        }
    }

    /// Gives leases back at once; does not insist.
    async fn goodbye(&mut self) {
        let Some(session) = &self.session else { return };
        let mut request =
            Request::new(v1::GoodbyeRequest { worker_id: session.worker, epoch: session.epoch });
        request.set_timeout(GOODBYE_TIME);
        if let Err(status) = self.connection.client.goodbye(request).await {
            tracing::debug!(%status, "the goodbye was not heard");
        }
    }
}

/// Until the worker is asked to stop.
async fn asked_to_stop(stopped: &mut watch::Receiver<bool>) {
    if stopped.wait_for(|stopped| *stopped).await.is_err() {
        // The sender lives as long as the worker.
        std::future::pending::<()>().await;
    }
}

fn not_registered() -> WorkerError {
    WorkerError::Defect("it asks for tasks before it is registered".into())
}

struct CancelOnDrop(Cancel);

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

fn again_or_refused(error: CallError) -> Result<bool, WorkerError> {
    match error {
        CallError::Refused(reason) => Err(WorkerError::Refused(reason)),
        CallError::RegisterAgain | CallError::TryAgain(_) => Ok(false),
    }
}

fn report_of(outcome: &Result<Duration, AttemptError>) -> v1::report_request::Result {
    use v1::report_request::Result as Report;
    match outcome {
        Ok(solve_time) => Report::Committed(v1::Committed {
            solve_ms: u64::try_from(solve_time.as_millis()).unwrap_or(u64::MAX),
        }),
        Err(AttemptError::GivenUp) => Report::Released(v1::Released {}),
        Err(error) => {
            let class: FailureClass = error.class();
            Report::Failed(v1::Failed {
                class: v1::FailureClass::from(class).into(),
                reason: error.to_string(),
            })
        }
    }
}

/// Extends the lease for ever. When the coordinator says that it is lost, `lost` is cancelled. A
/// coordinator that does not answer is no reason to give up: the commit decides.
async fn heartbeats(
    mut client: Client,
    session: Session,
    lease: Option<u64>,
    lost: Option<Cancel>,
) -> std::convert::Infallible {
    let mut beat = tokio::time::interval(session.heartbeat);
    beat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    beat.tick().await;
    loop {
        beat.tick().await;
        let mut request = Request::new(v1::HeartbeatRequest {
            worker_id: session.worker,
            epoch: session.epoch,
            lease_ids: lease.into_iter().collect(),
        });
        request.set_timeout(session.heartbeat);
        match client.heartbeat(request).await {
            Ok(answer) if !answer.get_ref().lost_lease_ids.is_empty() => {
                tracing::info!("the lease is lost; the task is given up");
                if let Some(lost) = &lost {
                    lost.cancel();
                }
            }
            Ok(_) => {}
            Err(status) => tracing::debug!(%status, "a heartbeat was not heard"),
        }
    }
}
