//! The manifests of `sightline k8s render` and the overlays of k8s/: what schemas know, what
//! schemas do not know, and what becomes of a bake when its pods are killed.
//!
//! Invariants KU-1 to KU-7 are those of crates/cli/src/commands/k8s.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use k8s_openapi::api::batch::v1::{Job, JobSpec};
use k8s_openapi::api::core::v1::{ConfigMap, Container, PodSpec, Service};
use k8s_openapi::api::networking::v1::NetworkPolicy;
use k8s_openapi::api::policy::v1::PodDisruptionBudget;
use serde::Deserialize;
use serde_json::Value;
use sightline_proto::keda::external_scaler_client::ExternalScalerClient;
use sightline_proto::keda::{GetMetricsRequest, ScaledObjectRef};
use sightline_tests::binaries::sightline;
use sightline_tests::city::{self, City, LIMIT};
use sightline_tests::job::Verdict;
use sightline_tests::manifests::Manifests;
use sightline_tests::pods::{Cluster, SECURITY, help_of};
use sightline_tests::process::{self, Process, eventually};
use sightline_tests::{dataset, requirement, workspace};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// The version of Kubernetes whose API the manifests are written in; later ones take them too.
const KUBERNETES: &str = "1.33";
/// The API types of the last version that the validator knows.
const KUBERNETES_NEWEST: &str = "1.37";

/// Every way to render that differs in its objects.
const VARIANTS: [&[&str]; 9] = [
    &[],
    &["--gpu"],
    &["--spot"],
    &["--scaling=keda"],
    &["--scaling=keda", "--gpu", "--spot"],
    &["--auth=token"],
    &["--auth=token", "--scaling=keda"],
    &["--auth=none", "--claim=shared", "--scene=/shared/city.glb", "--out=/shared/visible"],
    &["--workers=1", "--name=a-bake", "--namespace=studio", "--store-port=9000"],
];

/// The city that the Jobs bake, baked once by `sightline bake`.
static CITY: LazyLock<City> =
    LazyLock::new(|| City::bake(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("kubernetes")));

/// The street of the shared bake as a configuration file, with tasks cut smaller.
const STREET: &str = "\
    [region]\nrectangles = [[-5.0, -10.0, 5.0, 10.0]]\ncell_size = 5.0\neye_height = [1.5, 1.8]\n\
    [solver]\nrows = 92\nverticals = false\n\
    [accuracy]\ntarget_error = 0.0001\nworst_error = 0.001\nrounds = 3\n\
    [tasks]\nsegments_per_task = 2\ncells_per_task = 1\n";

/// The manifests of a bake of the city, and a cluster to run them in.
fn cluster(name: &str, config: &str) -> Cluster {
    let folder = CITY.empty(name);
    let config_file = folder.join("bake.toml");
    std::fs::write(&config_file, STREET).expect("a file can be written");
    let mut manifests = Manifests::render(&[
        "--config",
        &config_file.display().to_string(),
        "--claim=shared",
        "--scene=/shared/city.glb",
        "--out=/shared/visible",
        "--workers=3",
        "--cpu=1",
        "--name=bake",
    ]);
    // The command refuses to render a wrong configuration; a user's edit is not stopped by it.
    for object in &mut manifests.objects {
        if object["kind"] == "ConfigMap" {
            object["data"]["bake.toml"] = config.into();
        }
    }
    let cluster = Cluster::new(&manifests, &folder);
    std::fs::copy(&CITY.scene, cluster.claim().join("city.glb")).expect("the scene is copied");
    cluster
}

#[test]
fn a_bake_with_one_pod_killed_and_one_evicted_ends_complete_and_whole() {
    let mut cluster = cluster("two-killed", STREET);
    let visible = cluster.claim().join("visible");
    let some_done = |count| {
        let visible = visible.clone();
        move |_: &mut Cluster| dataset::commits(&visible) >= count
    };
    assert!(cluster.run_until(LIMIT, some_done(2)), "no task was finished");
    assert!(cluster.run_until(LIMIT, |c| c.is_running("bake-worker", 0)));
    cluster.kill("bake-worker", 0);
    assert!(cluster.run_until(LIMIT, some_done(4)), "the bake goes on");
    assert!(cluster.run_until(LIMIT, |c| c.is_running("bake-worker", 1)));
    cluster.evict("bake-worker", 1);
    assert!(!visible.join("current.json").exists(), "both died half-way");
    cluster.run_to_end(4 * LIMIT);

    let (worker, coordinator) = (cluster.state("bake-worker"), cluster.state("bake-coordinator"));
    assert_eq!(coordinator.verdict(), Verdict::Complete("CompletionsReached"));
    assert_eq!(worker.verdict(), Verdict::Complete("SuccessPolicy"));
    assert_eq!(worker.failures(), 1, "the kill counts: {:#?}", cluster.ended("bake-worker"));
    assert_eq!(worker.ignored(), 1, "the eviction does not");
    let ends: Vec<_> = cluster.ended("bake-worker").iter().collect();
    let killed = ends.iter().find(|end| end.exit_code == 137).expect("SIGKILL is 128 + 9");
    assert_eq!((killed.index, killed.is_disrupted), (Some(0), false));
    let evicted = ends.iter().find(|end| end.is_disrupted).expect("one was evicted");
    // KU-3: it stopped by itself within its grace period, and did not call that a success.
    assert_eq!((evicted.index, evicted.exit_code), (Some(1), 130), "{evicted:#?}");
    assert!(evicted.output.stderr.contains("another worker"), "{}", evicted.output.stderr);
    for index in [0, 1] {
        let pods = ends.iter().filter(|end| end.index == Some(index)).count();
        assert!(pods >= 2, "index {index} was started again");
    }
    dataset::assert_same(&CITY.dataset, &visible);
}

#[test]
fn an_evicted_coordinator_is_started_again_and_resumes() {
    let mut cluster = cluster("coordinator-evicted", STREET);
    let visible = cluster.claim().join("visible");
    let done = visible.clone();
    assert!(cluster.run_until(LIMIT, move |_| dataset::commits(&done) >= 2));
    cluster.evict("bake-coordinator", 0);
    cluster.run_to_end(4 * LIMIT);
    let coordinator = cluster.state("bake-coordinator");
    assert_eq!(coordinator.verdict(), Verdict::Complete("CompletionsReached"));
    assert_eq!((coordinator.failures(), coordinator.ignored()), (0, 1));
    assert_eq!(cluster.state("bake-worker").verdict(), Verdict::Complete("SuccessPolicy"));
    dataset::assert_same(&CITY.dataset, &visible);
}

#[test]
fn a_deleted_worker_pod_is_no_success_and_no_failure() {
    let mut cluster = cluster("deleted", STREET);
    let visible = cluster.claim().join("visible");
    let done = visible.clone();
    assert!(cluster.run_until(LIMIT, move |_| dataset::commits(&done) >= 2));
    assert!(cluster.run_until(LIMIT, |c| c.is_running("bake-worker", 2)));
    cluster.stop("bake-worker", 2);
    assert!(cluster.run_until(LIMIT, |c| !c.ended("bake-worker").is_empty()));
    let worker = cluster.state("bake-worker");
    assert_eq!((worker.verdict(), worker.failures()), (Verdict::Running, 0));
    assert_eq!(worker.ignored(), 1, "{:#?}", cluster.ended("bake-worker"));
}

#[test]
fn a_wrong_configuration_fails_the_job_at_once() {
    let wrong = STREET.replace("rows = 92", "row = 92");
    let mut cluster = cluster("wrong-configuration", &wrong);
    let failed = |c: &mut Cluster| c.state("bake-coordinator").verdict() != Verdict::Running;
    assert!(cluster.run_until(LIMIT, failed));
    let verdict = cluster.state("bake-coordinator").verdict();
    assert_eq!(verdict, Verdict::Failed("PodFailurePolicy"));
    let [pod] = cluster.ended("bake-coordinator") else { panic!("one attempt, no retry") };
    assert_eq!(pod.exit_code, 2);
    assert!(pod.output.stderr.contains("did you mean `solver.rows`"), "{}", pod.output.stderr);
}

#[test]
fn probes_are_answered_where_the_manifest_asks() {
    let manifests = Manifests::render(&["--name=bake"]);
    let spec = pod(&job(&manifests, "bake-coordinator"));
    let probe = spec.containers[0].readiness_probe.clone().and_then(|probe| probe.grpc);
    let probe = probe.expect("the coordinator has a gRPC probe");
    let mut cluster = cluster("probes", STREET);
    let port = cluster.port("bake-coordinator", probe.port);
    let runtime = tokio::runtime::Runtime::new().expect("a runtime starts");
    let service = probe.service.expect("it asks for a service");
    let is_ready = || runtime.block_on(ask_health(port, &service)) == Some(ServingStatus::Serving);
    assert!(cluster.run_until(LIMIT, |_| is_ready()), "the coordinator gets ready");
    let alive = runtime.block_on(ask_health(port, ""));
    assert_eq!(alive, Some(ServingStatus::Serving));
}

async fn ask_health(port: u16, service: &str) -> Option<ServingStatus> {
    let url = format!("http://127.0.0.1:{port}");
    let channel = tonic::transport::Endpoint::from_shared(url).ok()?.connect().await.ok()?;
    let request = HealthCheckRequest { service: service.into() };
    Some(HealthClient::new(channel).check(request).await.ok()?.into_inner().status())
}

#[test]
fn keda_learns_from_a_real_coordinator_how_many_workers_to_run() {
    let out = CITY.empty("keda");
    let arguments = city::bake_arguments("coordinator", &CITY.scene, &out.join("d"), [2, 1]);
    let listener = std::net::TcpListener::bind(("127.0.0.1", 0)).expect("a port is free");
    let address = listener.local_addr().expect("it has an address").to_string();
    drop(listener);
    let mut command = sightline(arguments);
    command.args(["--listen", &address]);
    let coordinator = Process::start(&mut command, &out, "coordinator");
    let url = format!("http://{address}");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime starts");
    let connected = || runtime.block_on(ExternalScalerClient::connect(url.clone())).is_ok();
    assert!(eventually(LIMIT, connected), "{}", coordinator.stderr());

    let asked = |per: u32| runtime.block_on(ask_scaler(url.clone(), per)).expect("it answers");
    // Eight cells have 22 perimeter segments: 11 tasks of two, all ready, and cells that wait.
    let Scaling { active, wanted: all } = asked(1);
    assert!(active && all > 3, "{all} workers");
    assert_eq!(asked(4).wanted, (all + 3) / 4);
    assert_eq!(asked(1000).wanted, 1);

    let worker = || sightline(["worker", "--threads=1", "--coordinator", &url]);
    let workers: Vec<Process> =
        ["one", "two"].iter().map(|name| Process::start(&mut worker(), &out, name)).collect();
    // Both are busy: a scaler that asks for less would end one of them.
    assert!(eventually(LIMIT, || asked(1000).wanted == 2), "leases in flight count");
    let _ = coordinator.wait(LIMIT).success();
    for worker in workers {
        let _ = worker.wait(LIMIT).success();
    }
}

struct Scaling {
    active: bool,
    wanted: i64,
}

async fn ask_scaler(url: String, per: u32) -> Result<Scaling, Box<dyn std::error::Error>> {
    let scaled = ScaledObjectRef {
        name: "bake-worker".into(),
        namespace: "studio".into(),
        scaler_metadata: BTreeMap::from([("tasksPerWorker".into(), per.to_string())]),
    };
    let mut client = ExternalScalerClient::connect(url).await?;
    let active = client.is_active(scaled.clone()).await?.into_inner().result;
    let specs = client.get_metric_spec(scaled.clone()).await?.into_inner().metric_specs;
    assert_eq!((specs.len(), specs[0].target_size, specs[0].target_size_float), (1, 1, 1.0));
    let request = GetMetricsRequest {
        scaled_object_ref: Some(scaled),
        metric_name: specs[0].metric_name.clone(),
    };
    let values = client.get_metrics(request).await?.into_inner().metric_values;
    assert_eq!(values[0].metric_name, specs[0].metric_name);
    assert_eq!(values[0].metric_value as f64, values[0].metric_value_float);
    Ok(Scaling { active, wanted: values[0].metric_value })
}

// ---- what the schemas of Kubernetes know

#[test]
fn every_object_passes_strict_validation() {
    let test = "every_object_passes_strict_validation";
    let found = requirement::kubernetes_validate();
    let install = "`.venv` with the packages of tests/kubernetes/requirements.txt";
    let Some(validate) = requirement::program(test, found, install) else { return };
    let folder = CITY.empty("validated");
    for (at, flags) in VARIANTS.iter().enumerate() {
        let objects = Manifests::render(flags).objects;
        // KEDA's kinds are no part of Kubernetes; the Job inside a ScaledJob is.
        let known = objects.iter().filter(|o| o["kind"] != "TriggerAuthentication").map(|object| {
            match object["kind"].as_str() {
                Some("ScaledJob") => serde_json::json!({
                    "apiVersion": "batch/v1", "kind": "Job",
                    "metadata": object["metadata"], "spec": object["spec"]["jobTargetRef"]
                }),
                _ => object.clone(),
            }
        });
        let file = folder.join(format!("{at}.yaml"));
        Manifests { objects: known.collect() }.write(&file);
        for version in [KUBERNETES, KUBERNETES_NEWEST] {
            let mut command = Command::new(&validate);
            command.args(["--strict", "-k", version]).arg(&file);
            let ended = process::run(&mut command, LIMIT);
            assert!(ended.status.success(), "{flags:?}\n{ended:#?}");
        }
    }
    // The check can fail.
    let file = folder.join("wrong.yaml");
    let mut wrong = Manifests::render(&[]);
    wrong.objects[0]["metadata"]["nmae"] = "misspelt".into();
    wrong.write(&file);
    let ended = process::run(Command::new(&validate).arg("--strict").arg(&file), LIMIT);
    assert!(!ended.status.success(), "{ended:#?}");
}

// ---- the files of k8s/

#[test]
fn the_base_is_what_render_prints() {
    let folder = CITY.empty("base");
    let mut command = sightline(["k8s", "render", "--quiet", "--output"]);
    let _ = process::run(command.arg(&folder), LIMIT).success();
    let base = workspace::root().join("k8s/base");
    let files = |folder: &Path| -> BTreeMap<String, String> {
        let entries = std::fs::read_dir(folder).expect("a folder can be read").flatten();
        let read = |path: PathBuf| std::fs::read_to_string(path).expect("a file can be read");
        entries.map(|e| (e.file_name().to_string_lossy().into_owned(), read(e.path()))).collect()
    };
    let (rendered, kept) = (files(&folder), files(&base));
    let names = |f: &BTreeMap<String, String>| f.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&rendered), names(&kept), "`bash k8s/render` writes them again");
    for (name, text) in &rendered {
        assert_eq!(text, &kept[name], "k8s/base/{name} differs: `bash k8s/render` writes it again");
    }
}

/// An overlay with the flags that print the same objects.
const OVERLAYS: [(&str, &[&str]); 4] = [
    ("base", &[]),
    ("overlays/gpu", &["--gpu"]),
    ("overlays/spot", &["--spot"]),
    ("overlays/keda", &["--scaling=keda"]),
];

#[test]
fn overlays_are_what_render_prints_with_their_flag() {
    let test = "overlays_are_what_render_prints_with_their_flag";
    let found = requirement::kubectl();
    let install = "kubectl (Debian: kubernetes-client)";
    let Some(kubectl) = requirement::program(test, found, install) else { return };
    for (overlay, flags) in OVERLAYS {
        let path = workspace::root().join("k8s").join(overlay);
        let ended = process::run(Command::new(&kubectl).arg("kustomize").arg(path), LIMIT);
        let built = Manifests::parse(&ended.success().stdout);
        let (built, rendered) = (by_name(&built), by_name(&Manifests::render(flags)));
        assert_eq!(
            built.keys().collect::<Vec<_>>(),
            rendered.keys().collect::<Vec<_>>(),
            "objects of {overlay}"
        );
        for (name, object) in &rendered {
            assert_eq!(&built[name], object, "{name:?} of {overlay}");
        }
    }
}

/// Objects by kind and name, with lists of named things in the order of their names: patches put
/// new ones first.
fn by_name(manifests: &Manifests) -> BTreeMap<(String, String), Value> {
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let key = |object: &Value| (text(&object["kind"]), text(&object["metadata"]["name"]));
    manifests.objects.iter().map(|object| (key(object), sorted(object.clone()))).collect()
}

fn sorted(value: Value) -> Value {
    match value {
        Value::Object(map) => map.into_iter().map(|(key, value)| (key, sorted(value))).collect(),
        Value::Array(list) => {
            let mut list: Vec<Value> = list.into_iter().map(sorted).collect();
            if list.iter().all(|item| item["name"].is_string()) {
                list.sort_by_key(|item| item["name"].to_string());
            }
            list.into()
        }
        other => other,
    }
}

// ---- what schemas do not know

fn job(manifests: &Manifests, name: &str) -> Job {
    let jobs = manifests.all::<Job>();
    let found = jobs.into_iter().find(|job| job.metadata.name.as_deref() == Some(name));
    found.unwrap_or_else(|| panic!("there is no Job {name}"))
}

fn pod(job: &Job) -> PodSpec {
    let spec = job.spec.clone().expect("a Job has a specification");
    spec.template.spec.expect("a Job has a pod template")
}

/// Specifications of all Jobs, those that KEDA makes included.
fn jobs(manifests: &Manifests) -> Vec<JobSpec> {
    let plain = manifests.all::<Job>().into_iter().filter_map(|job| job.spec);
    let scaled = manifests.of_kind("ScaledJob").map(|object| {
        let scaled: ScaledJob =
            serde_json::from_value(object.clone()).expect("KEDA knows every field");
        scaled.spec.job_target_ref
    });
    plain.chain(scaled).collect()
}

/// All pods that variants of the manifests make.
fn for_every_pod(look: impl Fn(&[&str], &PodSpec, &Container)) {
    for flags in VARIANTS {
        let jobs = jobs(&Manifests::render(flags));
        assert_eq!(jobs.len(), 2, "a coordinator and workers: {flags:?}");
        for job in jobs {
            let pod = job.template.spec.expect("a Job has a pod template");
            for container in pod.containers.iter().chain(pod.init_containers.iter().flatten()) {
                look(flags, &pod, container);
            }
        }
    }
}

/// What the level `restricted` of the Pod Security Standards asks for, and more.
#[test]
fn containers_run_without_root_privileges_and_a_writable_image() {
    for_every_pod(|flags, pod, container| {
        let of_pod = pod.security_context.clone().unwrap_or_default();
        assert_eq!(of_pod.run_as_non_root, Some(true), "{flags:?}");
        assert!(of_pod.run_as_user.is_some_and(|user| user > 0));
        assert_eq!(of_pod.seccomp_profile.map(|s| s.type_).as_deref(), Some("RuntimeDefault"));
        let own = container.security_context.clone().unwrap_or_default();
        assert_eq!(own.read_only_root_filesystem, Some(true));
        assert_eq!(own.allow_privilege_escalation, Some(false));
        let capabilities = own.capabilities.unwrap_or_default();
        assert_eq!(capabilities.drop, Some(vec!["ALL".to_owned()]));
        assert_eq!(capabilities.add, None);
        assert_eq!((own.privileged, own.run_as_user), (None, None));
        assert_eq!(pod.automount_service_account_token, Some(false));
        assert_eq!((pod.host_network, pod.host_pid, pod.host_ipc), (None, None, None));
        for volume in pod.volumes.iter().flatten() {
            assert!(volume.host_path.is_none(), "{flags:?}");
        }
    });
}

#[test]
fn what_a_container_writes_to_is_a_volume_with_a_limit() {
    for_every_pod(|flags, pod, container| {
        let mounts = container.volume_mounts.as_deref().unwrap_or_default();
        let volumes = pod.volumes.as_deref().unwrap_or_default();
        let names: BTreeSet<&str> = volumes.iter().map(|v| v.name.as_str()).collect();
        assert!(mounts.iter().all(|m| names.contains(m.name.as_str())), "{flags:?}");
        assert!(mounts.iter().any(|m| m.mount_path == "/tmp"));
        for volume in volumes {
            if let Some(folder) = &volume.empty_dir {
                assert!(folder.size_limit.is_some(), "{} has no limit", volume.name);
            }
        }
        let arguments = container.args.clone().unwrap_or_default();
        if arguments[0] == "worker" {
            let at = arguments.iter().position(|word| word == "--cache").expect("it has a cache");
            assert!(mounts.iter().any(|m| m.mount_path == arguments[at + 1]));
        }
    });
}

#[test]
fn containers_ask_for_what_they_may_use() {
    for_every_pod(|flags, _, container| {
        let resources = container.resources.clone().unwrap_or_default();
        let (requests, limits) =
            (resources.requests.unwrap_or_default(), resources.limits.unwrap_or_default());
        for name in ["cpu", "memory", "ephemeral-storage"] {
            assert!(requests.contains_key(name) && limits.contains_key(name), "{name} {flags:?}");
        }
        assert_eq!(requests["memory"], limits["memory"], "memory is no guess");
        let wants_gpu = flags.contains(&"--gpu") && container.name == "worker";
        assert_eq!(limits.contains_key("nvidia.com/gpu"), wants_gpu, "{flags:?}");
    });
}

#[test]
fn a_worker_is_done_draining_before_its_pod_is_killed() {
    for_every_pod(|flags, pod, container| {
        let grace = pod.termination_grace_period_seconds.expect("it is stated");
        // A hook would take its time from the same period.
        assert!(container.lifecycle.is_none());
        if container.name != "worker" {
            return;
        }
        let mut variables = container.env.iter().flatten();
        let drain = variables.find(|variable| variable.name == "WORKER_DRAIN_SECONDS");
        let drain = drain.and_then(|d| d.value.clone()).expect("it is a variable");
        let drain: i64 = drain.parse().expect("it is a number");
        assert!(drain + 5 <= grace, "{drain} s of {grace} s: {flags:?}");
        // Google gives pods of nodes that it takes back no more.
        assert!(!flags.contains(&"--spot") || grace <= 15, "{grace} s");
    });
}

#[test]
fn the_coordinator_has_all_probes_and_workers_live() {
    for_every_pod(|flags, _, container| {
        let grpc = |probe: &Option<k8s_openapi::api::core::v1::Probe>| {
            probe.as_ref().and_then(|probe| probe.grpc.as_ref()).map(|grpc| grpc.port)
        };
        let at = container.args.iter().flatten().position(|word| word == "--health");
        let listen = &container.args.as_ref().expect("it has arguments")[at.expect("--health") + 1];
        let port = listen.rsplit_once(':').and_then(|(_, port)| port.parse().ok());
        assert_eq!(grpc(&container.liveness_probe), port, "{flags:?}");
        if container.name == "coordinator" {
            assert_eq!(grpc(&container.startup_probe), port);
            assert_eq!(grpc(&container.readiness_probe), port);
        }
    });
}

/// What the API server checks beyond the schema, and what KU-1 to KU-6 say.
#[test]
fn jobs_say_what_becomes_of_pods_that_end() {
    for flags in VARIANTS {
        for job in jobs(&Manifests::render(flags)) {
            let pod = job.template.spec.as_ref().expect("a pod template");
            assert_eq!(pod.restart_policy.as_deref(), Some("Never"), "failure policies need it");
            assert_eq!(job.pod_replacement_policy.as_deref(), Some("Failed"));
            let rules = job.pod_failure_policy.as_ref().expect("a failure policy").rules.as_slice();
            let ignores = |rule: &k8s_openapi::api::batch::v1::PodFailurePolicyRule| {
                rule.action == "Ignore"
                    && rule.on_pod_conditions.iter().flatten().any(|pattern| {
                        pattern.type_ == "DisruptionTarget" && pattern.status == "True"
                    })
            };
            assert!(rules.iter().any(ignores), "KU-2: {flags:?}");
            for rule in rules {
                let codes = rule.on_exit_codes.as_ref();
                assert!(codes.is_some() != rule.on_pod_conditions.is_some(), "one of the two");
                let Some(codes) = codes else { continue };
                assert!(codes.values.is_sorted_by(|a, b| a < b) && !codes.values.contains(&0));
                let names: Vec<&str> = pod.containers.iter().map(|c| c.name.as_str()).collect();
                assert!(codes.container_name.as_deref().is_some_and(|n| names.contains(&n)));
                assert!(rule.action != "FailJob" || codes.values == [2, 3, 5], "KU-5");
            }
        }
    }
    let workers = job(&Manifests::render(&["--workers=5"]), "sightline-worker").spec;
    let workers = workers.expect("a Job has a specification");
    assert_eq!(workers.completion_mode.as_deref(), Some("Indexed"));
    assert_eq!((workers.completions, workers.parallelism), (Some(5), Some(5)), "KU-1");
    assert!(workers.backoff_limit_per_index.is_some_and(|limit| limit > 0), "KU-6");
    assert_eq!(workers.max_failed_indexes, Some(2), "KU-6");
    assert_eq!(workers.backoff_limit, None, "slots are counted one by one");
    let success = workers.success_policy.expect("KU-4").rules;
    assert_eq!(success[0].succeeded_count, Some(1), "KU-4");
    // Pods of an indexed Job have host names of at most 63 characters.
    let long = "a".repeat(64);
    let mut command = sightline(["k8s", "render", "--name", &long]);
    let _ = process::run(&mut command, LIMIT).failure(2);
}

#[test]
fn selectors_select_the_pods_that_are_meant() {
    for flags in VARIANTS {
        let manifests = Manifests::render(flags);
        let labels: Vec<BTreeMap<String, String>> = jobs(&manifests)
            .into_iter()
            .map(|job| job.template.metadata.and_then(|m| m.labels).expect("pods have labels"))
            .collect();
        let selected = |selector: &BTreeMap<String, String>| {
            let has = |pod: &BTreeMap<String, String>| {
                selector.iter().all(|(key, value)| pod.get(key) == Some(value))
            };
            let pods = labels.iter().filter(|pod| has(pod));
            pods.map(|pod| pod["app.kubernetes.io/component"].as_str()).collect::<Vec<_>>()
        };
        for service in manifests.all::<Service>() {
            let selector = service.spec.and_then(|spec| spec.selector).expect("a selector");
            assert_eq!(selected(&selector), ["coordinator"], "{flags:?}");
        }
        for budget in manifests.all::<PodDisruptionBudget>() {
            let spec = budget.spec.expect("a budget has a specification");
            let selector = spec.selector.and_then(|s| s.match_labels).expect("a selector");
            assert_eq!(selected(&selector), ["worker"], "{flags:?}");
        }
        let policies = manifests.all::<NetworkPolicy>();
        let covered: Vec<Vec<&str>> = policies
            .iter()
            .filter_map(|policy| {
                let selector = policy.spec.as_ref()?.pod_selector.as_ref()?;
                Some(selected(selector.match_labels.as_ref()?))
            })
            .collect();
        assert!(covered.contains(&vec!["coordinator", "worker"]), "a floor for all: {covered:?}");
        assert!(covered.contains(&vec!["coordinator"]) && covered.contains(&vec!["worker"]));
    }
}

#[test]
fn only_those_who_need_a_port_reach_it() {
    for flags in [&[][..], &["--scaling=keda"]] {
        let manifests = Manifests::render(flags);
        let mut reached: BTreeSet<(String, String)> = BTreeSet::new();
        for policy in manifests.all::<NetworkPolicy>() {
            let spec = policy.spec.expect("a policy has a specification");
            assert_eq!(spec.policy_types, Some(vec!["Ingress".into(), "Egress".into()]));
            for rule in spec.ingress.iter().flatten() {
                let ports = rule.ports.as_deref().unwrap_or_default();
                assert!(!ports.is_empty() && rule.from.is_some(), "nobody is let in everywhere");
                for (port, from) in
                    ports.iter().flat_map(|p| rule.from.iter().flatten().map(move |f| (p, f)))
                {
                    let port = serde_json::json!(port.port).to_string();
                    let selector = from.namespace_selector.as_ref().or(from.pod_selector.as_ref());
                    let labels = selector.and_then(|s| s.match_labels.clone()).expect("labels");
                    let who = labels
                        .get("kubernetes.io/metadata.name")
                        .or_else(|| labels.get("app.kubernetes.io/component"));
                    reached.insert((port, who.expect("a name").clone()));
                }
            }
        }
        let pair = |port: &str, who: &str| (port.to_owned(), who.to_owned());
        let mut expected = BTreeSet::from([pair("7070", "worker"), pair("9090", "monitoring")]);
        if !flags.is_empty() {
            expected.insert(pair("7070", "keda"));
        }
        assert_eq!(reached, expected, "{flags:?}");
    }
}

/// KU-7.
#[test]
fn manifests_hold_names_of_secrets_and_no_secret() {
    for flags in VARIANTS {
        let manifests = Manifests::render(flags);
        assert_eq!(manifests.of_kind("Secret").count(), 0, "{flags:?}");
        for map in manifests.all::<ConfigMap>() {
            let keys: Vec<String> = map.data.unwrap_or_default().into_keys().collect();
            assert_eq!(keys, ["bake.toml", "out", "scene"], "{flags:?}");
        }
        for job in jobs(&manifests) {
            for container in job.template.spec.expect("a pod template").containers {
                for variable in container.env.iter().flatten() {
                    let name = variable.name.to_lowercase();
                    let is_secret =
                        ["secret", "token", "password", "key"].iter().any(|w| name.contains(w));
                    assert!(!is_secret || variable.value.is_none(), "{}", variable.name);
                }
                // Where an argument is about a secret, it is the path of a mounted file.
                let arguments = container.args.unwrap_or_default();
                for pair in arguments.windows(2) {
                    if SECURITY.contains(&pair[0].as_str()) && pair[0] != "--insecure" {
                        assert!(pair[1].starts_with("/etc/sightline-"), "{pair:?}");
                    }
                }
            }
        }
    }
    let auth = |flags: &[&str]| {
        let worker = job(&Manifests::render(flags), "sightline-worker");
        pod(&worker).containers[0].args.clone().unwrap_or_default()
    };
    assert!(auth(&[]).contains(&"--tls-cert".to_owned()), "mTLS is the default");
    assert!(auth(&["--auth=token"]).contains(&"--token-file".to_owned()));
}

/// A flag that the command does not know would end every pod with exit code 2.
#[test]
fn containers_are_given_flags_that_the_command_knows() {
    let mut helps: BTreeMap<String, String> = BTreeMap::new();
    for command in ["coordinator", "worker"] {
        helps.insert(command.into(), help_of(command));
    }
    for_every_pod(|flags, _, container| {
        let arguments = container.args.clone().unwrap_or_default();
        let help: BTreeSet<&str> = helps[&arguments[0]].split_whitespace().collect();
        for flag in arguments.iter().map(String::as_str).filter(|word| word.starts_with("--")) {
            assert!(help.contains(flag), "{flag} of {} {flags:?}", arguments[0]);
        }
    });
}

#[test]
fn a_wrong_configuration_is_refused_before_it_reaches_the_cluster() {
    let config = CITY.empty("refused").join("bake.toml");
    std::fs::write(&config, "[solver]\nrow = 100\n").expect("a file can be written");
    let mut command = sightline(["k8s", "render", "--config"]);
    let ended = process::run(command.arg(&config), LIMIT).failure(2);
    assert!(ended.stderr.contains("did you mean `solver.rows`"), "{}", ended.stderr);
}

// ---- KEDA

/// The fields of a ScaledJob that KEDA documents and that are used; others are mistakes.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct ScaledJob {
    api_version: String,
    #[serde(rename = "kind")]
    _kind: String,
    metadata: Value,
    spec: ScaledJobSpec,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct ScaledJobSpec {
    job_target_ref: JobSpec,
    polling_interval: u32,
    #[serde(rename = "successfulJobsHistoryLimit")]
    _successful: u32,
    #[serde(rename = "failedJobsHistoryLimit")]
    _failed: u32,
    min_replica_count: u32,
    max_replica_count: u32,
    rollout: BTreeMap<String, String>,
    scaling_strategy: BTreeMap<String, String>,
    triggers: Vec<Trigger>,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
struct Trigger {
    #[serde(rename = "type")]
    kind: String,
    metadata: BTreeMap<String, String>,
    authentication_ref: Option<BTreeMap<String, String>>,
}

#[test]
fn the_scaled_job_asks_the_coordinator_of_its_own_bake() {
    let flags = ["--scaling=keda", "--workers=40", "--tasks-per-worker=7", "--namespace=studio"];
    let manifests = Manifests::render(&flags);
    let object = manifests.of_kind("ScaledJob").next().expect("a ScaledJob").clone();
    let scaled: ScaledJob = serde_json::from_value(object).expect("KEDA knows every field");
    assert_eq!(scaled.api_version, "keda.sh/v1alpha1");
    assert_eq!(scaled.metadata["namespace"], "studio");
    let spec = scaled.spec;
    assert_eq!((spec.min_replica_count, spec.max_replica_count), (0, 40));
    assert!(spec.polling_interval <= 30);
    // Running workers are never ended, and are part of what is wanted.
    assert_eq!(spec.rollout["strategy"], "gradual");
    assert_eq!(spec.scaling_strategy["strategy"], "default");
    let [trigger] = &spec.triggers[..] else { panic!("one trigger") };
    assert_eq!(trigger.kind, "external");
    let service = &manifests.all::<Service>()[0].metadata;
    let name = service.name.as_deref().expect("a service has a name");
    assert_eq!(trigger.metadata["scalerAddress"], format!("{name}.studio.svc:7070"));
    assert_eq!(trigger.metadata["tasksPerWorker"], "7");
    let authentication = trigger.authentication_ref.as_ref().expect("mTLS is the default");
    let given = manifests.of_kind("TriggerAuthentication").next().expect("it is there");
    assert_eq!(authentication["name"], given["metadata"]["name"]);
    for reference in given["spec"]["secretTargetRef"].as_array().expect("a list") {
        assert_eq!(reference["name"], "sightline-keda-tls", "a name, no value");
    }
    assert_eq!(
        (spec.job_target_ref.completions, spec.job_target_ref.parallelism),
        (Some(1), Some(1))
    );
    assert_eq!(manifests.all::<Job>().len(), 1, "the coordinator alone");
}

// ---- the image

#[test]
fn the_image_is_small_unprivileged_and_built_from_the_lock_file() {
    let dockerfile = workspace::read("k8s/Dockerfile");
    let lines: Vec<&str> = dockerfile.lines().filter(|l| !l.starts_with('#')).collect();
    let stages: Vec<&&str> = lines.iter().filter(|line| line.starts_with("FROM ")).collect();
    assert_eq!(stages.len(), 2, "one that builds, one that runs");
    assert!(stages[1].contains("distroless"), "{}", stages[1]);
    let last = lines.iter().rposition(|line| line.starts_with("FROM ")).expect("a stage");
    let runs = &lines[last..];
    assert!(runs.contains(&"USER 65532:65532"), "runAsNonRoot wants a number");
    assert!(!runs.iter().any(|line| line.starts_with("RUN ")), "there is no shell");
    assert!(
        runs.iter()
            .any(|l| l.starts_with("COPY --from=build") && l.ends_with("/usr/local/bin/sightline"))
    );
    assert!(dockerfile.contains("--locked"));
    let manifest: toml::Table = workspace::read("Cargo.toml").parse().expect("it is TOML");
    let rust = manifest["workspace"]["package"]["rust-version"].as_str().expect("a version");
    assert!(stages[0].contains(&format!("rust:{rust}")), "{} and rust-version {rust}", stages[0]);
    // Containers name the command by its path in the image.
    for_every_pod(|_, _, container| {
        assert_eq!(container.command, Some(vec!["/usr/local/bin/sightline".to_owned()]));
    });
}
