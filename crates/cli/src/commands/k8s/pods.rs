//! The pods: what runs in them, as whom, with what. Nothing of it needs root, a writable image, a
//! token of the cluster's API, or a privilege.
//!
//! What a kustomization may want to change is in environment variables, which patches merge by
//! name; arguments quote them as `$(NAME)`.

use std::collections::BTreeMap;

use k8s_openapi::api::core::v1::{
    Capabilities, ConfigMap, ConfigMapKeySelector, ConfigMapVolumeSource, Container,
    EmptyDirVolumeSource, EnvFromSource, EnvVar, EnvVarSource, GRPCAction, ObjectFieldSelector,
    PersistentVolumeClaimVolumeSource, PodSecurityContext, PodSpec, PodTemplateSpec, Probe,
    ResourceRequirements, SeccompProfile, SecretEnvSource, SecretVolumeSource, SecurityContext,
    ServiceAccount, Volume, VolumeMount,
};
use k8s_openapi::apimachinery::pkg::api::resource::Quantity;
use k8s_openapi::apimachinery::pkg::apis::meta::v1::ObjectMeta;

use super::network::{COORDINATOR_PORT, HEALTH_PORT, METRICS_PORT, ports};
use super::options::{Auth, Render};
use super::placement;

/// Path of the command in the image.
const COMMAND: &str = "/usr/local/bin/sightline";
/// The user `nonroot` of distroless images.
const USER: i64 = 65_532;
/// How long a stopped worker may go on with its task, s.
const DRAIN_SECONDS: u32 = 25;
/// What a stopped worker has beyond that to write and to say goodbye, s.
const GOODBYE_SECONDS: u32 = 15;
/// Both, on nodes that are taken back within 15 s (GKE; others give longer).
const DRAIN_SECONDS_SPOT: u32 = 8;
const GRACE_SECONDS_SPOT: u32 = 14;

/// Labels of every object; `component` sets pods of one kind apart.
pub fn labels(render: &Render, component: Option<&str>) -> BTreeMap<String, String> {
    let mut labels = vec![
        ("app.kubernetes.io/name", "sightline"),
        ("app.kubernetes.io/instance", render.name.as_str()),
    ];
    labels.extend(component.map(|component| ("app.kubernetes.io/component", component)));
    labels.into_iter().map(|(key, value)| (key.to_owned(), value.to_owned())).collect()
}

/// Name, namespace and labels of an object.
pub fn metadata(render: &Render, name: String, component: Option<&str>) -> ObjectMeta {
    ObjectMeta {
        name: Some(name),
        namespace: Some(render.namespace.clone()),
        labels: Some(labels(render, component)),
        ..ObjectMeta::default()
    }
}

/// An account that has no rights in the cluster. Clouds tie rights on object stores to it.
pub fn service_account(render: &Render) -> ServiceAccount {
    ServiceAccount {
        metadata: metadata(render, render.account(), None),
        automount_service_account_token: Some(false),
        ..ServiceAccount::default()
    }
}

/// What to bake.
pub fn config_map(render: &Render, config: &str) -> ConfigMap {
    let data = [("bake.toml", config), ("out", &render.out), ("scene", &render.scene)];
    let data = data.map(|(key, value)| (key.to_owned(), value.to_owned()));
    ConfigMap {
        metadata: metadata(render, render.named("bake"), None),
        data: Some(BTreeMap::from(data)),
        ..ConfigMap::default()
    }
}

/// The pod of the coordinator.
pub fn coordinator(render: &Render) -> PodTemplateSpec {
    let arguments = [
        "coordinator",
        "$(BAKE_SCENE)",
        "--out",
        "$(BAKE_OUT)",
        "--config",
        "/etc/sightline/bake.toml",
    ];
    let mut arguments: Vec<String> = arguments.map(str::to_owned).into();
    arguments.extend(listen("--listen", COORDINATOR_PORT));
    arguments.extend(listen("--health", HEALTH_PORT));
    arguments.extend(listen("--metrics", METRICS_PORT));
    arguments.extend(coordinator_security(render));
    let bake_key = |name: &str, key: &str| EnvVar {
        name: name.into(),
        value_from: Some(EnvVarSource {
            config_map_key_ref: Some(ConfigMapKeySelector {
                key: key.into(),
                name: render.named("bake"),
                optional: None,
            }),
            ..EnvVarSource::default()
        }),
        ..EnvVar::default()
    };
    let memory = format!("{}Gi", render.coordinator_memory);
    let container = Container {
        name: "coordinator".into(),
        args: Some(arguments),
        env: Some(vec![bake_key("BAKE_SCENE", "scene"), bake_key("BAKE_OUT", "out")]),
        ports: Some(ports()),
        resources: Some(resources(&[
            ("cpu", "1", Some("2")),
            ("memory", &memory, Some(&memory)),
            ("ephemeral-storage", "2Gi", Some("4Gi")),
        ])),
        // Reading a large scene takes minutes; the process lives meanwhile, and is not ready.
        startup_probe: Some(probe("", 2, 30)),
        liveness_probe: Some(probe("", 10, 6)),
        readiness_probe: Some(probe("sightline.v1.Coordinator", 2, 1)),
        volume_mounts: Some(mounts(render, &[("bake", "/etc/sightline", true)])),
        ..container(render)
    };
    let bake = Volume {
        name: "bake".into(),
        config_map: Some(ConfigMapVolumeSource {
            name: render.named("bake"),
            ..ConfigMapVolumeSource::default()
        }),
        ..Volume::default()
    };
    let mut template = template(render, "coordinator", container);
    if let Some(spec) = &mut template.spec {
        spec.volumes = Some(volumes(render, &render.coordinator_tls(), vec![bake]));
        // Calls in flight get two seconds, the store the rest.
        spec.termination_grace_period_seconds = Some(30);
        placement::coordinator(render, spec);
    }
    // Moving it costs the bake some seconds: an autoscaler that saves a node looks elsewhere.
    let annotation = ("cluster-autoscaler.kubernetes.io/safe-to-evict".into(), "false".into());
    if let Some(metadata) = &mut template.metadata {
        metadata.annotations = Some(BTreeMap::from([annotation]));
    }
    template
}

/// The pod of a worker.
pub fn worker(render: &Render) -> PodTemplateSpec {
    let url = render.coordinator_url();
    let arguments = [
        "worker",
        "--coordinator",
        &url,
        "--name",
        "$(POD_NAME)",
        "--threads",
        "$(WORKER_THREADS)",
        "--memory",
        "$(WORKER_MEMORY)",
        "--cache",
        "/cache",
        "--cache-size",
        "$(WORKER_CACHE_SIZE)",
        "--drain-seconds",
        "$(WORKER_DRAIN_SECONDS)",
    ];
    let mut arguments: Vec<String> = arguments.map(str::to_owned).into();
    arguments.extend(listen("--health", HEALTH_PORT));
    arguments.extend(worker_security(render));
    let drain = if render.spot { DRAIN_SECONDS_SPOT } else { DRAIN_SECONDS };
    let grace = if render.spot { GRACE_SECONDS_SPOT } else { DRAIN_SECONDS + GOODBYE_SECONDS };
    let pod_name = EnvVar {
        name: "POD_NAME".into(),
        value_from: Some(EnvVarSource {
            field_ref: Some(ObjectFieldSelector {
                field_path: "metadata.name".into(),
                api_version: None,
            }),
            ..EnvVarSource::default()
        }),
        ..EnvVar::default()
    };
    let value = |name: &str, value: String| EnvVar {
        name: name.into(),
        value: Some(value),
        ..EnvVar::default()
    };
    let environment = vec![
        pod_name,
        value("WORKER_CACHE_SIZE", format!("{}GiB", render.cache_size)),
        value("WORKER_DRAIN_SECONDS", drain.to_string()),
        // The rest is for what is not geometry: threads, buffers, results.
        value("WORKER_MEMORY", format!("{}MiB", u64::from(render.memory) * 768)),
        value("WORKER_THREADS", render.cpu.to_string()),
    ];
    let (cpu, memory) = (render.cpu.to_string(), format!("{}Gi", render.memory));
    // What a cache may grow to, and a tenth for files on their way in.
    let cache = format!("{}Gi", render.cache_size + render.cache_size.div_ceil(10));
    let disk = format!("{}Gi", render.cache_size + render.cache_size.div_ceil(10) + 2);
    let mut container = Container {
        name: "worker".into(),
        args: Some(arguments),
        env: Some(environment),
        resources: Some(resources(&[
            ("cpu", &cpu, Some(&cpu)),
            ("memory", &memory, Some(&memory)),
            ("ephemeral-storage", &disk, Some(&disk)),
        ])),
        // Whether it works is for its leases to say; this finds a process that hangs as a whole.
        liveness_probe: Some(probe("", 20, 6)),
        volume_mounts: Some(mounts(render, &[("cache", "/cache", false)])),
        ..container(render)
    };
    placement::worker_container(render, &mut container);
    let mut template = template(render, "worker", container);
    if let Some(spec) = &mut template.spec {
        let secret = render.worker_tls();
        spec.volumes = Some(volumes(render, &secret, vec![empty_folder("cache", &cache)]));
        spec.termination_grace_period_seconds = Some(i64::from(grace));
        placement::worker(render, spec);
    }
    template
}

fn template(render: &Render, component: &str, container: Container) -> PodTemplateSpec {
    PodTemplateSpec {
        metadata: Some(ObjectMeta {
            labels: Some(labels(render, Some(component))),
            ..ObjectMeta::default()
        }),
        spec: Some(PodSpec {
            containers: vec![container],
            // The failure policies of Jobs look at pods that ended for good.
            restart_policy: Some("Never".into()),
            service_account_name: Some(render.account()),
            automount_service_account_token: Some(false),
            enable_service_links: Some(false),
            security_context: Some(PodSecurityContext {
                run_as_non_root: Some(true),
                run_as_user: Some(USER),
                run_as_group: Some(USER),
                fs_group: Some(USER),
                fs_group_change_policy: Some("OnRootMismatch".into()),
                seccomp_profile: Some(SeccompProfile {
                    type_: "RuntimeDefault".into(),
                    localhost_profile: None,
                }),
                ..PodSecurityContext::default()
            }),
            ..PodSpec::default()
        }),
    }
}

fn container(render: &Render) -> Container {
    Container {
        image: Some(render.image.clone()),
        command: Some(vec![COMMAND.into()]),
        env_from: Some(vec![EnvFromSource {
            secret_ref: Some(SecretEnvSource { name: render.store(), optional: Some(true) }),
            ..EnvFromSource::default()
        }]),
        security_context: Some(SecurityContext {
            allow_privilege_escalation: Some(false),
            read_only_root_filesystem: Some(true),
            capabilities: Some(Capabilities { drop: Some(vec!["ALL".into()]), add: None }),
            ..SecurityContext::default()
        }),
        // The last lines of the log, where a container that failed left no message of its own.
        termination_message_policy: Some("FallbackToLogsOnError".into()),
        ..Container::default()
    }
}

fn listen(flag: &str, port: u16) -> [String; 2] {
    [flag.into(), format!("0.0.0.0:{port}")]
}

fn coordinator_security(render: &Render) -> Vec<String> {
    let certificate = ["--tls-cert", "/etc/sightline-tls/tls.crt", "--tls-key"];
    let mut arguments = certificate.map(str::to_owned).to_vec();
    arguments.push("/etc/sightline-tls/tls.key".into());
    match render.auth {
        Auth::Mtls => {
            arguments.extend(["--tls-client-ca", "/etc/sightline-tls/ca.crt"].map(str::to_owned))
        }
        Auth::Token => arguments.extend(token()),
        Auth::None => return vec!["--insecure".into()],
    }
    arguments
}

fn worker_security(render: &Render) -> Vec<String> {
    let mut arguments = ["--tls-ca", "/etc/sightline-tls/ca.crt"].map(str::to_owned).to_vec();
    match render.auth {
        Auth::Mtls => arguments.extend(
            ["--tls-cert", "/etc/sightline-tls/tls.crt", "--tls-key", "/etc/sightline-tls/tls.key"]
                .map(str::to_owned),
        ),
        Auth::Token => arguments.extend(token()),
        Auth::None => return Vec::new(),
    }
    arguments
}

fn token() -> [String; 2] {
    ["--token-file".into(), "/etc/sightline-token/token".into()]
}

/// Requests and limits: name, what is asked for, what it may grow to.
fn resources(list: &[(&str, &str, Option<&str>)]) -> ResourceRequirements {
    let quantity = |(name, text): (&str, &str)| (name.to_owned(), Quantity(text.to_owned()));
    let requests = list.iter().map(|(name, request, _)| quantity((name, request)));
    let limits = list.iter().filter_map(|(name, _, limit)| Some(quantity((name, (*limit)?))));
    ResourceRequirements {
        requests: Some(requests.collect()),
        limits: Some(limits.collect()),
        claims: None,
    }
}

fn probe(service: &str, period_seconds: i32, failure_threshold: i32) -> Probe {
    let service = (!service.is_empty()).then(|| service.to_owned());
    Probe {
        grpc: Some(GRPCAction { port: i32::from(HEALTH_PORT), service }),
        period_seconds: Some(period_seconds),
        timeout_seconds: Some(if period_seconds > 5 { 5 } else { period_seconds }),
        failure_threshold: Some(failure_threshold),
        ..Probe::default()
    }
}

fn empty_folder(name: &str, size: &str) -> Volume {
    Volume {
        name: name.into(),
        empty_dir: Some(EmptyDirVolumeSource {
            size_limit: Some(Quantity(size.into())),
            medium: None,
        }),
        ..Volume::default()
    }
}

fn secret(name: &str, secret: String) -> Volume {
    Volume {
        name: name.into(),
        secret: Some(SecretVolumeSource {
            secret_name: Some(secret),
            // For the group of the pod, and nobody else.
            default_mode: Some(0o440),
            ..SecretVolumeSource::default()
        }),
        ..Volume::default()
    }
}

fn volumes(render: &Render, tls: &str, own: Vec<Volume>) -> Vec<Volume> {
    let mut volumes = own;
    volumes.push(empty_folder("tmp", "1Gi"));
    if render.auth != Auth::None {
        volumes.push(secret("tls", tls.to_owned()));
    }
    if render.auth == Auth::Token {
        volumes.push(secret("token", render.token()));
    }
    if let Some(claim) = &render.claim {
        volumes.push(Volume {
            name: "shared".into(),
            persistent_volume_claim: Some(PersistentVolumeClaimVolumeSource {
                claim_name: claim.clone(),
                read_only: None,
            }),
            ..Volume::default()
        });
    }
    volumes
}

fn mounts(render: &Render, own: &[(&str, &str, bool)]) -> Vec<VolumeMount> {
    let mut mounts = own.to_vec();
    mounts.push(("tmp", "/tmp", false));
    if render.auth != Auth::None {
        mounts.push(("tls", "/etc/sightline-tls", true));
    }
    if render.auth == Auth::Token {
        mounts.push(("token", "/etc/sightline-token", true));
    }
    if render.claim.is_some() {
        mounts.push(("shared", "/shared", false));
    }
    let mount = |(name, path, read_only): (&str, &str, bool)| VolumeMount {
        name: name.into(),
        mount_path: path.into(),
        read_only: read_only.then_some(true),
        ..VolumeMount::default()
    };
    mounts.into_iter().map(mount).collect()
}
