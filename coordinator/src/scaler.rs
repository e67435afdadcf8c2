//! How many workers a bake can use, told to KEDA (<https://keda.sh>) over its external-scaler
//! service.
//!
//! The one metric is [`METRIC`], the number of workers wanted, with a target of 1 a worker: KEDA
//! divides the one by the other and so runs as many workers as are wanted. With `open` the tasks
//! that are ready or leased, `per` the tasks that a worker is to find (`tasksPerWorker` of the
//! trigger's metadata; 1 when absent) and `busy` the workers that hold a lease,
//!
//! ```text
//! wanted = max(ceil(open / per), busy)   while the bake solves and merges
//!        = 0                             when it is over
//! ```
//!
//! - A task that waits for others makes no worker wanted: it would only wait too.
//! - `busy` keeps the number from falling below the leases in flight, whatever `per` is: a worker
//!   that solves is never too many. (A `ScaledJob` ends no job, and its default strategy counts
//!   the running ones as part of what is wanted, as this metric does.)
//! - A quarantined task is tried no more, so nobody is wanted for it.

use std::collections::BTreeMap;
use std::pin::Pin;

use futures::{Stream, StreamExt, stream};
use sightline_jobs::BakeStatus;
use sightline_proto::keda::external_scaler_server::{ExternalScaler, ExternalScalerServer};
use sightline_proto::keda::{
    GetMetricSpecResponse, GetMetricsRequest, GetMetricsResponse, IsActiveResponse, MetricSpec,
    MetricValue, ScaledObjectRef,
};
use tokio::sync::watch;
use tonic::{Request, Response, Status};

/// Name of the metric.
const METRIC: &str = "sightline_workers_wanted";
/// Key of the trigger's metadata for the tasks that a worker is to find.
const TASKS_PER_WORKER: &str = "tasksPerWorker";

/// The service over the status that the coordinator's loop sends.
pub(crate) fn service(status: watch::Receiver<BakeStatus>) -> ExternalScalerServer<Scaler> {
    ExternalScalerServer::new(Scaler { status })
}

/// The scaler of one bake.
pub(crate) struct Scaler {
    status: watch::Receiver<BakeStatus>,
}

/// Workers that the bake can use; see the module.
fn workers_wanted(status: &BakeStatus, tasks_per_worker: u32) -> u32 {
    if status.phase.is_final() {
        return 0;
    }
    let open = status.tasks.ready.saturating_add(status.tasks.leased);
    let busy = status.workers.iter().filter(|worker| worker.leases > 0).count();
    open.div_ceil(tasks_per_worker.max(1)).max(u32::try_from(busy).unwrap_or(u32::MAX))
}

/// The tasks that a worker is to find.
fn tasks_per_worker(metadata: &BTreeMap<String, String>) -> Result<u32, Status> {
    let Some(text) = metadata.get(TASKS_PER_WORKER) else { return Ok(1) };
    match text.trim().parse() {
        Ok(tasks) if tasks > 0 => Ok(tasks),
        _ => Err(Status::invalid_argument(format!(
            "{TASKS_PER_WORKER} of the trigger's metadata is `{text}`; give a number from 1"
        ))),
    }
}

#[tonic::async_trait]
impl ExternalScaler for Scaler {
    async fn is_active(
        &self,
        request: Request<ScaledObjectRef>,
    ) -> Result<Response<IsActiveResponse>, Status> {
        let per = tasks_per_worker(&request.get_ref().scaler_metadata)?;
        let result = workers_wanted(&self.status.borrow(), per) > 0;
        Ok(Response::new(IsActiveResponse { result }))
    }

    type StreamIsActiveStream =
        Pin<Box<dyn Stream<Item = Result<IsActiveResponse, Status>> + Send + 'static>>;

    async fn stream_is_active(
        &self,
        request: Request<ScaledObjectRef>,
    ) -> Result<Response<Self::StreamIsActiveStream>, Status> {
        let per = tasks_per_worker(&request.get_ref().scaler_metadata)?;
        let watched = self.status.clone();
        // `told` is the answer that was sent last; the stream ends with the bake.
        let answers = stream::unfold((watched, None), move |(mut watched, told)| async move {
            loop {
                let (is_active, is_over) = {
                    let status = watched.borrow_and_update();
                    (workers_wanted(&status, per) > 0, status.phase.is_final())
                };
                if told != Some(is_active) {
                    let answer = Ok(IsActiveResponse { result: is_active });
                    return Some((answer, (watched, Some(is_active))));
                }
                if is_over || watched.changed().await.is_err() {
                    return None;
                }
            }
        });
        Ok(Response::new(answers.boxed()))
    }

    async fn get_metric_spec(
        &self,
        request: Request<ScaledObjectRef>,
    ) -> Result<Response<GetMetricSpecResponse>, Status> {
        // A wrong trigger is refused here too: KEDA asks this first.
        tasks_per_worker(&request.get_ref().scaler_metadata)?;
        let spec =
            MetricSpec { metric_name: METRIC.into(), target_size: 1, target_size_float: 1.0 };
        Ok(Response::new(GetMetricSpecResponse { metric_specs: vec![spec] }))
    }

    async fn get_metrics(
        &self,
        request: Request<GetMetricsRequest>,
    ) -> Result<Response<GetMetricsResponse>, Status> {
        let scaled = request.into_inner().scaled_object_ref.unwrap_or_default();
        let wanted =
            workers_wanted(&self.status.borrow(), tasks_per_worker(&scaled.scaler_metadata)?);
        let value = MetricValue {
            metric_name: METRIC.into(),
            metric_value: i64::from(wanted),
            metric_value_float: f64::from(wanted),
        };
        Ok(Response::new(GetMetricsResponse { metric_values: vec![value] }))
    }
}

#[cfg(test)]
mod tests {
    use sightline_jobs::{Phase, Progress, WorkerStatus};

    use super::*;

    fn status(phase: Phase, ready: u32, leased: u32, busy: u32) -> BakeStatus {
        let worker = |leases| WorkerStatus { leases, ..WorkerStatus::default() };
        BakeStatus {
            phase,
            tasks: Progress { tasks: 100, ready, leased, waiting: 50, ..Progress::default() },
            workers: (0..busy).map(|_| worker(1)).chain([worker(0)]).collect(),
            ..BakeStatus::default()
        }
    }

    fn scaled(metadata: &[(&str, &str)]) -> ScaledObjectRef {
        let scaler_metadata =
            metadata.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect();
        ScaledObjectRef { scaler_metadata, ..ScaledObjectRef::default() }
    }

    #[test]
    fn workers_are_wanted_for_tasks_that_are_ready_or_leased() {
        let wanted = |ready, leased, per| {
            workers_wanted(&status(Phase::Solving, ready, leased, leased.min(3)), per)
        };
        assert_eq!(wanted(0, 0, 1), 0, "50 tasks wait for others, and nobody can do them");
        assert_eq!(wanted(10, 0, 1), 10);
        assert_eq!(wanted(10, 3, 4), 4, "ceil(13 / 4)");
        assert_eq!(wanted(12, 0, 4), 3);
        assert_eq!(wanted(12, 0, 0), 12, "0 is taken for 1");
    }

    #[test]
    fn leases_in_flight_are_never_too_many_workers() {
        for per in [1, 2, 8, 1000] {
            let wanted = workers_wanted(&status(Phase::Solving, 0, 6, 6), per);
            assert_eq!(wanted, 6, "6 workers are busy, {per} tasks a worker");
        }
    }

    #[test]
    fn nobody_is_wanted_when_the_bake_is_over() {
        for phase in [Phase::Published, Phase::Failed] {
            assert_eq!(workers_wanted(&status(phase, 5, 5, 5), 1), 0);
        }
    }

    #[tokio::test]
    async fn a_stream_of_activity_tells_changes_and_ends_with_the_bake() {
        let (sender, receiver) = watch::channel(status(Phase::Solving, 3, 0, 0));
        let scaler = Scaler { status: receiver };
        let stream = scaler.stream_is_active(Request::new(scaled(&[]))).await.unwrap();
        let mut answers = stream.into_inner().map(|answer| answer.unwrap().result);
        assert_eq!(answers.next().await, Some(true));
        // The same answer is not told twice.
        sender.send_replace(status(Phase::Solving, 2, 1, 1));
        sender.send_replace(status(Phase::Published, 0, 0, 0));
        assert_eq!(answers.next().await, Some(false));
        assert_eq!(answers.next().await, None);
    }

    #[tokio::test]
    async fn a_wrong_number_of_tasks_is_refused_by_name() {
        let (_sender, receiver) = watch::channel(status(Phase::Solving, 3, 0, 0));
        let scaler = Scaler { status: receiver };
        for wrong in ["0", "-1", "many"] {
            let asked = Request::new(scaled(&[(TASKS_PER_WORKER, wrong)]));
            let refused = scaler.get_metric_spec(asked).await.unwrap_err();
            assert_eq!(refused.code(), tonic::Code::InvalidArgument);
            assert!(refused.message().contains(TASKS_PER_WORKER), "{refused}");
        }
    }
}
