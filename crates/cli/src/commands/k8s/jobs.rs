//! The Jobs, and how they answer to pods that end. KU-1 to KU-6 are in [`super`].
//!
//! Exit codes are those of [`crate::failure`]. In the order of the rules:
//!
//! | how a pod ended | rule | then |
//! | --- | --- | --- |
//! | 2, 3, 5: usage, input, tasks missing | FailJob | the Job fails at once (KU-5) |
//! | disrupted, whatever its code | Ignore | the slot is filled again, nothing is counted (KU-2) |
//! | 130: stopped by a signal | Ignore | the same: someone deleted the pod (KU-3) |
//! | all else: 4 store, 6 network, 70 defect, 137 killed | none | counted, tried again (KU-6) |
//!
//! FailJob comes first: a pod that was disrupted while it failed for good still failed for good.
//! Retries wait longer each time, 10 s to 6 min, as the Job controller has it.

use k8s_openapi::api::batch::v1::{
    Job, JobSpec, PodFailurePolicy, PodFailurePolicyOnExitCodesRequirement,
    PodFailurePolicyOnPodConditionsPattern, PodFailurePolicyRule, SuccessPolicy, SuccessPolicyRule,
};
use k8s_openapi::api::policy::v1::{PodDisruptionBudget, PodDisruptionBudgetSpec};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::LabelSelector;
use k8s_openapi::apimachinery::pkg::util::intstr::IntOrString;

use super::options::Render;
use super::pods;
use crate::failure::Kind;

/// Failures of a slot, or of the coordinator, that are tried again.
pub const RETRIES_OF_A_SLOT: i32 = 6;
/// How long a Job that ended can be looked at, s: a week.
const KEPT_SECONDS: i32 = 7 * 24 * 3600;

/// The coordinator: one pod, until the dataset is published.
pub fn coordinator(render: &Render) -> Job {
    Job {
        metadata: pods::metadata(render, render.named("coordinator"), Some("coordinator")),
        spec: Some(JobSpec {
            completions: Some(1),
            parallelism: Some(1),
            backoff_limit: Some(RETRIES_OF_A_SLOT),
            pod_failure_policy: Some(failure_policy("coordinator")),
            pod_replacement_policy: Some("Failed".into()),
            ttl_seconds_after_finished: Some(KEPT_SECONDS),
            template: pods::coordinator(render),
            ..JobSpec::default()
        }),
        status: None,
    }
}

/// The workers: an index a slot.
pub fn workers(render: &Render) -> Job {
    let slots = i32::try_from(render.workers).unwrap_or(i32::MAX);
    Job {
        metadata: pods::metadata(render, render.named("worker"), Some("worker")),
        spec: Some(JobSpec {
            completion_mode: Some("Indexed".into()),
            completions: Some(slots),
            parallelism: Some(slots),
            backoff_limit_per_index: Some(RETRIES_OF_A_SLOT),
            max_failed_indexes: Some(slots / 2),
            pod_failure_policy: Some(failure_policy("worker")),
            // KU-4. Without a list of indexes: whichever is the first.
            success_policy: Some(SuccessPolicy {
                rules: vec![SuccessPolicyRule {
                    succeeded_count: Some(1),
                    succeeded_indexes: None,
                }],
            }),
            pod_replacement_policy: Some("Failed".into()),
            ttl_seconds_after_finished: Some(KEPT_SECONDS),
            template: pods::worker(render),
            ..JobSpec::default()
        }),
        status: None,
    }
}

/// One worker that KEDA starts; KEDA starts another where one failed.
pub fn scaled_worker(render: &Render) -> JobSpec {
    JobSpec {
        completions: Some(1),
        parallelism: Some(1),
        backoff_limit: Some(RETRIES_OF_A_SLOT),
        pod_failure_policy: Some(failure_policy("worker")),
        pod_replacement_policy: Some("Failed".into()),
        // KEDA keeps as many as it is asked to; a namespace fills up with ended ones otherwise.
        ttl_seconds_after_finished: Some(KEPT_SECONDS),
        template: pods::worker(render),
        ..JobSpec::default()
    }
}

/// At least half of the slots stay, however many nodes are drained at once. A bake with one worker
/// has no budget: it would hold up the drain of its node until the bake ends. Nor has the
/// coordinator, which is back within seconds and has lost nothing.
pub fn disruption_budget(render: &Render) -> Option<PodDisruptionBudget> {
    let stay = i32::try_from(render.workers / 2).ok().filter(|stay| *stay > 0)?;
    Some(PodDisruptionBudget {
        metadata: pods::metadata(render, render.named("worker"), Some("worker")),
        spec: Some(PodDisruptionBudgetSpec {
            // A number: percentages need a controller that says how many there should be.
            min_available: Some(IntOrString::Int(stay)),
            selector: Some(LabelSelector {
                match_labels: Some(pods::labels(render, Some("worker"))),
                match_expressions: None,
            }),
            ..PodDisruptionBudgetSpec::default()
        }),
        status: None,
    })
}

fn failure_policy(container: &str) -> PodFailurePolicy {
    let codes = |kinds: &[Kind]| {
        // The API wants them in order.
        let mut values: Vec<i32> = kinds.iter().map(|kind| i32::from(kind.exit_code())).collect();
        values.sort_unstable();
        Some(PodFailurePolicyOnExitCodesRequirement {
            container_name: Some(container.into()),
            operator: "In".into(),
            values,
        })
    };
    let rule = |action: &str| PodFailurePolicyRule {
        action: action.into(),
        on_exit_codes: None,
        on_pod_conditions: None,
    };
    let disrupted = PodFailurePolicyOnPodConditionsPattern {
        type_: "DisruptionTarget".into(),
        status: "True".into(),
    };
    PodFailurePolicy {
        rules: vec![
            PodFailurePolicyRule {
                on_exit_codes: codes(&[Kind::Usage, Kind::Input, Kind::Incomplete]),
                ..rule("FailJob")
            },
            PodFailurePolicyRule { on_pod_conditions: Some(vec![disrupted]), ..rule("Ignore") },
            PodFailurePolicyRule { on_exit_codes: codes(&[Kind::Interrupted]), ..rule("Ignore") },
        ],
    }
}
