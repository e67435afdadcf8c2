//! The gRPC service: requests to the state, and the state to answers.
//!
//! Nothing here computes or waits for the store while it holds the state.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures::stream;
use sightline_jobs::{BakeStatus, FORMAT_VERSION, FailureClass, Lease, LeaseId, TaskId, WorkerId};
use sightline_proto::v1::{self, coordinator_server, lease_response::Answer, report_request};
use sightline_telemetry::trace;
use tokio::sync::{Notify, watch};
use tonic::{Request, Response, Status};
use tracing::{Instrument, Span};

use crate::accept::Peer;
use crate::clock::Clock;
use crate::journal::Journal;
use crate::metrics::Metrics;
use crate::state::{Reported, State};

/// How long a lease request waits for a task before it is answered with "wait", ms. Well under
/// the clients' timeouts; long enough that waiting workers cost nothing.
const LEASE_WAIT_MS: u64 = 1_000;
/// Longest worker name and failure reason that are kept, bytes: they end up in statuses.
const TEXT_BYTES_MAX: usize = 2_000;
/// Longest worker name that is kept, bytes.
const NAME_BYTES_MAX: usize = 200;
/// Leases that a heartbeat may name: a worker holds a few.
const HEARTBEAT_LEASES_MAX: usize = 1_024;

/// What the service and the coordinator's loop share.
pub(crate) struct Shared {
    pub state: Mutex<State>,
    pub journal: Journal,
    pub clock: Arc<dyn Clock>,
    /// The status, sent by the coordinator's loop.
    pub status: watch::Sender<BakeStatus>,
    /// Wakes the loop, and lease requests that wait for a task, in the order in which they came: a
    /// `watch` channel would wake them in random order.
    pub changes: Notify,
    pub store_location: String,
    pub scene_uri: String,
    pub lease_ms: u64,
    pub metrics: Arc<Metrics>,
}

impl Shared {
    pub fn state(&self) -> MutexGuard<'_, State> {
        // A panic while the state is held is a defect; the state itself stays whole.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the state, then lets everyone know.
    pub fn change<T>(&self, change: impl FnOnce(&mut State, u64) -> T) -> T {
        let now_ms = self.clock.now_ms();
        let mut state = self.state();
        let out = change(&mut state, now_ms);
        drop(state);
        self.changes.notify_waiters();
        out
    }

    /// Sends the status to whoever watches.
    pub fn send_status(&self) {
        let status = self.state().status(self.clock.now_ms());
        self.metrics.show(&status);
        self.status.send_replace(status);
    }
}

/// The gRPC service.
pub(crate) struct Service(pub Arc<Shared>);

impl Service {
    /// Refuses messages of another epoch, of workers that are not registered, and of those who
    /// are not who registered the worker.
    fn admit(&self, epoch: u64, worker: u32, caller: Caller) -> Result<WorkerId, Status> {
        let mut state = self.0.state();
        state.hear_of_epoch(epoch);
        if state.is_closed() {
            return Err(closing());
        }
        if epoch != state.epoch {
            return Err(other_epoch(epoch, state.epoch));
        }
        let worker = WorkerId(worker);
        if !state.knows(worker) || !state.is_owned_by(worker, caller) {
            return Err(Status::not_found("this worker is not registered; register again"));
        }
        Ok(worker)
    }

    /// A task, or the end. Not a change when there is neither: waiting workers would keep waking
    /// each other.
    fn try_lease(&self, worker: WorkerId) -> Option<Answer> {
        let now_ms = self.0.clock.now_ms();
        let mut state = self.0.state();
        let answer = if let Some(ending) = state.ending() {
            // Who has been told needs nothing more from us.
            state.leave(worker);
            Answer::Finished(v1::Finished { published: ending.published, message: ending.message })
        } else {
            let lease = state.lease(worker, now_ms)?;
            let attempt = attempt_name(&state, &lease);
            tracing::debug!(
                bake = state.plan.bake_id,
                epoch = state.epoch,
                task = lease.task.0,
                lease = lease.id.0,
                attempt,
                worker = worker.0,
                "leased"
            );
            self.0.metrics.leased();
            Answer::Task(v1::LeasedTask { task: lease.task.0, lease_id: lease.id.0, attempt })
        };
        drop(state);
        self.0.changes.notify_waiters();
        Some(answer)
    }

    /// Believes a commit object, not a message.
    async fn commit_reported(
        &self,
        worker: WorkerId,
        task: TaskId,
        lease: LeaseId,
        solve_ms: u64,
    ) -> Result<(), Status> {
        let found = self.0.journal.commit(task).await;
        match found {
            Ok(Some(commit)) => {
                let reported = Reported { worker, lease, solve_ms, reused: commit.reused };
                let mut is_news = false;
                self.0.change(|state, now_ms| {
                    is_news = state.committed(task, Some(&reported), now_ms);
                });
                // A report that is sent again counts once.
                if is_news {
                    let kind = self.0.state().plan.task(task).kind;
                    self.0.metrics.committed(&kind, solve_ms);
                }
                Ok(())
            }
            Ok(None) => {
                let reason = "reported as committed, and there is no commit";
                if self.0.state().holds(worker, lease) {
                    self.failed(lease, FailureClass::RetryElsewhere, reason);
                }
                Err(Status::data_loss(reason))
            }
            Err(error) => Err(Status::unavailable(error.to_string())),
        }
    }

    fn failed(&self, lease: LeaseId, class: FailureClass, reason: &str) {
        self.0.metrics.failed(class);
        self.0.change(|state, now_ms| state.attempt_failed(lease, class, reason, now_ms));
    }

    /// A report of a worker. What it says of a lease that it does not hold is left out.
    async fn take_report(
        &self,
        request: v1::ReportRequest,
        caller: Caller,
    ) -> Result<Response<v1::ReportResponse>, Status> {
        let worker = self.admit(request.epoch, request.worker_id, caller)?;
        let (task, lease) = (TaskId(request.task), LeaseId(request.lease_id));
        if task.index() >= self.0.state().plan.tasks.len() {
            return Err(Status::invalid_argument(format!("the plan has no task {task}")));
        }
        match request.result {
            Some(report_request::Result::Committed(done)) => {
                self.commit_reported(worker, task, lease, done.solve_ms).await?;
            }
            Some(report_request::Result::Failed(failed)) => {
                let class = FailureClass::try_from(failed.class())
                    .map_err(|error| Status::invalid_argument(error.to_string()))?;
                let name = self.0.state().name_of(worker).to_owned();
                let reason = shortened(format!("{name}: {}", failed.reason), TEXT_BYTES_MAX);
                tracing::warn!(
                    task = task.0,
                    lease = lease.0,
                    worker = worker.0,
                    ?class,
                    reason,
                    "an attempt failed"
                );
                if self.0.state().holds(worker, lease) {
                    self.failed(lease, class, &reason);
                }
            }
            Some(report_request::Result::Released(_)) => {
                if self.0.state().holds(worker, lease) {
                    self.0.change(|state, _| state.release(lease));
                }
            }
            None => return Err(Status::invalid_argument("a ReportRequest has no `result`")),
        }
        Ok(Response::new(v1::ReportResponse {}))
    }
}

/// The first span of a task's life; the worker's attempt is its child.
fn lease_span(answer: &Answer, worker: WorkerId) -> Span {
    match answer {
        Answer::Task(leased) => tracing::info_span!(
            parent: None,
            "lease",
            task = leased.task,
            lease = leased.lease_id,
            attempt = leased.attempt,
            worker = worker.0,
        ),
        Answer::Wait(_) | Answer::Finished(_) => Span::none(),
    }
}

/// The certificate that a caller showed, if certificates are asked for.
type Caller = Option<blake3::Hash>;

fn caller_of<T>(request: &Request<T>) -> Caller {
    let peer = request.extensions().get::<Peer>()?;
    Some(peer.certificate.as_ref()?.fingerprint)
}

/// A name that no other attempt of this bake has, on whatever coordinator: epochs are taken once,
/// and lease numbers are given once an epoch.
fn attempt_name(state: &State, lease: &Lease) -> String {
    format!("e{}-w{}-l{}", state.epoch, lease.worker, lease.id)
}

fn other_epoch(theirs: u64, ours: u64) -> Status {
    Status::failed_precondition(format!(
        "the message is of epoch {theirs}, this coordinator of epoch {ours}; register again"
    ))
}

fn closing() -> Status {
    Status::unavailable("this coordinator is ending before the bake does; try again")
}

/// At most so many bytes, on one line: it ends up in logs and on terminals.
fn shortened(mut text: String, bytes_max: usize) -> String {
    if text.len() > bytes_max {
        let boundary = (0..=bytes_max).rev().find(|at| text.is_char_boundary(*at));
        text.truncate(boundary.unwrap_or(0));
    }
    text.replace(char::is_control, " ")
}

#[tonic::async_trait]
impl coordinator_server::Coordinator for Service {
    async fn register(
        &self,
        request: Request<v1::RegisterRequest>,
    ) -> Result<Response<v1::RegisterResponse>, Status> {
        let caller = caller_of(&request);
        let request = request.into_inner();
        if request.format_version != FORMAT_VERSION {
            return Err(Status::invalid_argument(format!(
                "the worker writes format version {}, this bake has {FORMAT_VERSION}; run the \
                 same version of both",
                request.format_version
            )));
        }
        let shared = &self.0;
        shared.change(|state, now_ms| {
            if state.is_closed() {
                return Err(closing());
            }
            let is_of_this_bake =
                request.bake_id.is_empty() || request.bake_id == state.plan.bake_id;
            if is_of_this_bake && request.newest_epoch > state.epoch {
                state.hear_of_epoch(request.newest_epoch);
                return Err(other_epoch(request.newest_epoch, state.epoch));
            }
            let name = shortened(request.worker_name, NAME_BYTES_MAX);
            let Some(worker) = state.join(name.clone(), request.threads, now_ms) else {
                let count = state.worker_count();
                tracing::warn!(count, "a worker is refused: as many are here as there may be");
                return Err(Status::resource_exhausted(format!(
                    "{count} workers are at hand, as many as there may be; try again"
                )));
            };
            tracing::info!(
                bake = state.plan.bake_id,
                epoch = state.epoch,
                worker = worker.0,
                name,
                threads = request.threads,
                "a worker joins"
            );
            state.own(worker, caller);
            Ok(Response::new(v1::RegisterResponse {
                worker_id: worker.0,
                epoch: state.epoch,
                bake_id: state.plan.bake_id.clone(),
                store_location: shared.store_location.clone(),
                scene_uri: shared.scene_uri.clone(),
                scene_digest: state.plan.scene.digest.clone(),
                lease_ms: shared.lease_ms,
                // Two heartbeats may get lost.
                heartbeat_ms: (shared.lease_ms / 3).max(1),
            }))
        })
    }

    async fn lease(
        &self,
        request: Request<v1::LeaseRequest>,
    ) -> Result<Response<v1::LeaseResponse>, Status> {
        let caller = caller_of(&request);
        let request = request.into_inner();
        let give_up =
            tokio::time::sleep(Duration::from_millis(LEASE_WAIT_MS.min(self.0.lease_ms / 3)));
        tokio::pin!(give_up);
        loop {
            let worker = self.admit(request.epoch, request.worker_id, caller)?;
            // A change between the look and the wait is not missed.
            let mut changed = std::pin::pin!(self.0.changes.notified());
            changed.as_mut().enable();
            if let Some(answer) = self.try_lease(worker) {
                let span = lease_span(&answer, worker);
                let mut response = Response::new(v1::LeaseResponse { answer: Some(answer) });
                trace::inject(&span, response.metadata_mut());
                return Ok(response);
            }
            let gave_up = tokio::select! {
                biased;
                () = &mut give_up => true,
                () = changed => false,
            };
            if gave_up {
                let answer = Some(Answer::Wait(v1::Wait { retry_after_ms: 10 }));
                return Ok(Response::new(v1::LeaseResponse { answer }));
            }
        }
    }

    async fn heartbeat(
        &self,
        request: Request<v1::HeartbeatRequest>,
    ) -> Result<Response<v1::HeartbeatResponse>, Status> {
        let caller = caller_of(&request);
        let request = request.into_inner();
        let worker = self.admit(request.epoch, request.worker_id, caller)?;
        if request.lease_ids.len() > HEARTBEAT_LEASES_MAX {
            return Err(Status::invalid_argument("a heartbeat names too many leases"));
        }
        let held: Vec<LeaseId> = request.lease_ids.into_iter().map(LeaseId).collect();
        let now_ms = self.0.clock.now_ms();
        let lost = self.0.state().heartbeat(worker, &held, now_ms);
        let lost_lease_ids = lost.into_iter().map(|lease| lease.0).collect();
        Ok(Response::new(v1::HeartbeatResponse { lost_lease_ids }))
    }

    async fn report(
        &self,
        request: Request<v1::ReportRequest>,
    ) -> Result<Response<v1::ReportResponse>, Status> {
        let caller = caller_of(&request);
        let span = tracing::info_span!("take_report", task = request.get_ref().task);
        trace::adopt(&span, request.metadata());
        self.take_report(request.into_inner(), caller).instrument(span).await
    }

    async fn goodbye(
        &self,
        request: Request<v1::GoodbyeRequest>,
    ) -> Result<Response<v1::GoodbyeResponse>, Status> {
        let caller = caller_of(&request);
        let request = request.into_inner();
        let worker = self.admit(request.epoch, request.worker_id, caller)?;
        self.0.change(|state, _| {
            tracing::info!(worker = worker.0, name = state.name_of(worker), "a worker leaves");
            state.leave(worker);
        });
        Ok(Response::new(v1::GoodbyeResponse {}))
    }

    async fn get_status(
        &self,
        _: Request<v1::GetStatusRequest>,
    ) -> Result<Response<v1::Status>, Status> {
        let now_ms = self.0.clock.now_ms();
        let status = self.0.state().status(now_ms);
        Ok(Response::new((&status).into()))
    }

    type WatchStatusStream =
        std::pin::Pin<Box<dyn futures::Stream<Item = Result<v1::Status, Status>> + Send>>;

    async fn watch_status(
        &self,
        _: Request<v1::WatchStatusRequest>,
    ) -> Result<Response<Self::WatchStatusStream>, Status> {
        let watched = self.0.status.subscribe();
        let statuses = stream::unfold((watched, false), |(mut watched, is_waiting)| async move {
            if is_waiting {
                let has_ended = watched.borrow().phase.is_final();
                if has_ended || watched.changed().await.is_err() {
                    return None;
                }
            }
            let status = v1::Status::from(&*watched.borrow_and_update());
            Some((Ok(status), (watched, true)))
        });
        Ok(Response::new(Box::pin(statuses)))
    }
}
