//! Workers as a KEDA `ScaledJob` over the coordinator's external-scaler service.
//!
//! The types are the part of `keda.sh/v1alpha1` that is used here
//! (<https://keda.sh/docs/latest/reference/scaledjob-spec/>); KEDA publishes none for Rust.
//!
//! The metric is the number of workers wanted, busy ones included, with a target of 1. KEDA's
//! `default` strategy starts `wanted - running` jobs. A ScaledJob never ends a job, so no lease in
//! flight is cut short when fewer workers are wanted; a worker ends by itself when the bake does.

use std::collections::BTreeMap;

use k8s_openapi::api::batch::v1::JobSpec;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta;
use serde::Serialize;

use super::options::{Auth, Render};
use super::{jobs, network, pods};

const API_VERSION: &str = "keda.sh/v1alpha1";

/// Jobs as many as a trigger asks for.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct ScaledJob {
    api_version: &'static str,
    kind: &'static str,
    metadata: ObjectMeta,
    spec: ScaledJobSpec,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct ScaledJobSpec {
    job_target_ref: JobSpec,
    /// How often the trigger is asked, s.
    polling_interval: u32,
    successful_jobs_history_limit: u32,
    failed_jobs_history_limit: u32,
    min_replica_count: u32,
    max_replica_count: u32,
    rollout: Rollout,
    scaling_strategy: ScalingStrategy,
    triggers: Vec<Trigger>,
}

/// What becomes of running jobs when the ScaledJob changes.
#[derive(Debug, Serialize)]
struct Rollout {
    strategy: &'static str,
}

#[derive(Debug, Serialize)]
struct ScalingStrategy {
    strategy: &'static str,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct Trigger {
    #[serde(rename = "type")]
    kind: &'static str,
    metadata: BTreeMap<&'static str, String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    authentication_ref: Option<AuthenticationRef>,
}

#[derive(Debug, Serialize)]
struct AuthenticationRef {
    name: String,
}

/// Where a trigger's credentials are.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct TriggerAuthentication {
    api_version: &'static str,
    kind: &'static str,
    metadata: ObjectMeta,
    spec: TriggerAuthenticationSpec,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct TriggerAuthenticationSpec {
    secret_target_ref: Vec<SecretTargetRef>,
}

#[derive(Debug, Serialize)]
struct SecretTargetRef {
    parameter: &'static str,
    name: String,
    key: &'static str,
}

/// The workers.
pub fn scaled_job(render: &Render) -> ScaledJob {
    // KEDA asks from its own namespace.
    let address = format!(
        "{}.{}.svc:{}",
        render.named("coordinator"),
        render.namespace,
        network::COORDINATOR_PORT
    );
    let mut metadata = BTreeMap::from([
        ("scalerAddress", address),
        ("tasksPerWorker", render.tasks_per_worker.to_string()),
    ]);
    if render.auth != Auth::None {
        metadata.insert("enableTLS", "true".into());
    }
    ScaledJob {
        api_version: API_VERSION,
        kind: "ScaledJob",
        metadata: pods::metadata(render, render.named("worker"), Some("worker")),
        spec: ScaledJobSpec {
            job_target_ref: jobs::scaled_worker(render),
            polling_interval: 10,
            successful_jobs_history_limit: 3,
            failed_jobs_history_limit: 10,
            min_replica_count: 0,
            max_replica_count: render.workers,
            rollout: Rollout { strategy: "gradual" },
            scaling_strategy: ScalingStrategy { strategy: "default" },
            triggers: vec![Trigger {
                kind: "external",
                metadata,
                authentication_ref: (render.auth != Auth::None)
                    .then(|| AuthenticationRef { name: render.named("scaler") }),
            }],
        },
    }
}

/// KEDA's certificate. With a token, KEDA shows the certificate authority alone: its external
/// scaler has no way to send a token.
pub fn trigger_authentication(render: &Render) -> Option<TriggerAuthentication> {
    let own: &[(&'static str, &'static str)] = match render.auth {
        Auth::Mtls => {
            &[("caCert", "ca.crt"), ("tlsClientCert", "tls.crt"), ("tlsClientKey", "tls.key")]
        }
        Auth::Token => &[("caCert", "ca.crt")],
        Auth::None => return None,
    };
    let reference = |(parameter, key): &(&'static str, &'static str)| SecretTargetRef {
        parameter,
        name: render.keda_tls(),
        key,
    };
    Some(TriggerAuthentication {
        api_version: API_VERSION,
        kind: "TriggerAuthentication",
        metadata: pods::metadata(render, render.named("scaler"), Some("worker")),
        spec: TriggerAuthenticationSpec { secret_target_ref: own.iter().map(reference).collect() },
    })
}
