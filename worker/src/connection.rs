//! Talking to the coordinator: registering, and doing so again when it changed.
//!
//! A call that fails because the coordinator is gone or busy is tried again for a while, with
//! growing pauses. A coordinator that does not know this worker, or is of another epoch, is
//! registered with again; one of an epoch older than the newest this worker has seen is refused,
//! and asked again until it is replaced or the time is up.

use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};
use std::time::Duration;

use sightline_jobs::{FORMAT_VERSION, pause_ms};
use sightline_proto::access::Role;
use sightline_proto::v1;
use tokio::time::Instant;
use tonic::{Code, Status};

use crate::WorkerError;
use crate::security::{Client, ClientSecurity, Dial, told};

/// First and longest pause between two tries.
const PAUSE_MS: u64 = 100;
const PAUSE_MS_MAX: u64 = 5_000;

/// A registration with one coordinator.
#[derive(Clone, Debug)]
pub(crate) struct Session {
    pub worker: u32,
    pub epoch: u64,
    pub bake_id: String,
    pub store_location: String,
    pub scene_uri: String,
    pub scene_digest: String,
    pub heartbeat: Duration,
}

/// What a failed call asks for.
#[derive(Debug)]
pub(crate) enum CallError {
    /// The coordinator does not know us, or is another one.
    RegisterAgain,
    /// It does not answer; it may later.
    TryAgain(String),
    /// It does not want this.
    Refused(String),
}

impl From<Status> for CallError {
    fn from(status: Status) -> Self {
        match status.code() {
            Code::FailedPrecondition | Code::NotFound => Self::RegisterAgain,
            Code::InvalidArgument
            | Code::Unimplemented
            | Code::PermissionDenied
            | Code::Unauthenticated
            | Code::DataLoss
            | Code::OutOfRange => Self::Refused(status.message().to_owned()),
            _ => Self::TryAgain(told(&status)),
        }
    }
}

/// A way to the coordinator.
pub(crate) struct Connection {
    url: String,
    name: String,
    threads: u32,
    patience: Duration,
    pub client: Client,
    /// The bake, and its newest epoch that this worker has seen.
    newest: Option<(String, u64)>,
}

/// Growing pauses until the patience is over. Those of different workers differ, so that a thousand do not
/// come back to a new coordinator at once.
pub(crate) struct Pauses {
    start: Instant,
    tries: u32,
    of: u64,
}

impl Pauses {
    pub fn new(name: &str) -> Self {
        // Not the process: a simulation has to be repeatable.
        let of = BuildHasherDefault::<DefaultHasher>::new().hash_one(name);
        Self { start: Instant::now(), tries: 0, of }
    }

    /// Waits; false when the time is up.
    pub async fn wait(&mut self, patience: Duration) -> bool {
        if self.start.elapsed() >= patience {
            return false;
        }
        let pause = pause_ms(PAUSE_MS, PAUSE_MS_MAX, self.tries, self.of);
        self.tries += 1;
        tokio::time::sleep(Duration::from_millis(pause)).await;
        true
    }
}

impl Connection {
    /// Does not connect yet.
    pub fn new(
        url: &str,
        name: &str,
        threads: usize,
        patience: Duration,
        security: &ClientSecurity,
        dial: Option<&Dial>,
    ) -> Result<Self, WorkerError> {
        let client = security.client_over(url, Role::Worker, dial)?;
        Ok(Self {
            url: url.to_owned(),
            name: name.to_owned(),
            threads: u32::try_from(threads).unwrap_or(u32::MAX),
            patience,
            client,
            newest: None,
        })
    }

    /// Registers, trying for as long as the patience lasts.
    pub async fn register(&mut self) -> Result<Session, WorkerError> {
        let mut pauses = Pauses::new(&self.name);
        loop {
            let problem = match self.try_register().await {
                Ok(session) => return Ok(session),
                Err(CallError::Refused(reason)) => return Err(WorkerError::Refused(reason)),
                Err(CallError::RegisterAgain) => "it is of an older epoch".to_owned(),
                Err(CallError::TryAgain(problem)) => problem,
            };
            tracing::info!(url = self.url, problem, "the coordinator does not answer");
            if !pauses.wait(self.patience).await {
                return Err(self.unreachable(problem));
            }
        }
    }

    async fn try_register(&mut self) -> Result<Session, CallError> {
        let request = v1::RegisterRequest {
            worker_name: self.name.clone(),
            threads: self.threads,
            format_version: FORMAT_VERSION,
            newest_epoch: self.newest.as_ref().map_or(0, |(_, epoch)| *epoch),
            bake_id: self.newest.as_ref().map_or_else(String::new, |(bake, _)| bake.clone()),
        };
        let answer = self.client.register(request).await?.into_inner();
        match &self.newest {
            Some((bake, epoch)) if *bake == answer.bake_id && *epoch > answer.epoch => {
                return Err(CallError::RegisterAgain);
            }
            _ => self.newest = Some((answer.bake_id.clone(), answer.epoch)),
        }
        Ok(Session {
            worker: answer.worker_id,
            epoch: answer.epoch,
            bake_id: answer.bake_id,
            store_location: answer.store_location,
            scene_uri: answer.scene_uri,
            scene_digest: answer.scene_digest,
            heartbeat: Duration::from_millis(answer.heartbeat_ms.max(1)),
        })
    }

    /// Calls until there is an answer, registering is needed, or the time is up.
    pub async fn call<T>(
        &self,
        mut call: impl AsyncFnMut(Client) -> Result<T, Status>,
    ) -> Result<Result<T, CallError>, WorkerError> {
        let mut pauses = Pauses::new(&self.name);
        loop {
            match call(self.client.clone()).await.map_err(CallError::from) {
                Err(CallError::TryAgain(problem)) => {
                    tracing::debug!(problem, "a call failed");
                    if !pauses.wait(self.patience).await {
                        return Err(self.unreachable(problem));
                    }
                }
                other => return Ok(other),
            }
        }
    }

    fn unreachable(&self, problem: String) -> WorkerError {
        WorkerError::Unreachable { url: self.url.clone(), waited: self.patience, problem }
    }
}
