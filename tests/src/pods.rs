//! Jobs of Kubernetes as processes of this machine, under the policies of their own manifests.
//!
//! [`crate::job`] decides which pods to start and when a Job is over; this runs them. A pod has one
//! container, and its container is a process. What stands for what:
//!
//! | manifest | here |
//! | --- | --- |
//! | image | left out; `/usr/local/bin/NAME` is the built executable NAME |
//! | `command`, `args` | as they are, `$(NAME)` expanded |
//! | `env` | as it is: values, ConfigMap keys, `metadata.name`; and JOB_COMPLETION_INDEX |
//! | `envFrom` a Secret | nothing: the Secret is optional |
//! | volume: ConfigMap | a folder a pod, with a file a key |
//! | volume: emptyDir | an empty folder a pod |
//! | volume: claim | one folder of the whole cluster |
//! | a path below a volume's mount | the same path below its folder |
//! | `0.0.0.0:PORT`, PORT in `ports` | `127.0.0.1` and one free port for all pods of the Job |
//! | `0.0.0.0:PORT` otherwise | `127.0.0.1` and a free port |
//! | `http(s)://SERVICE:PORT` | `http://127.0.0.1` and the port of the Job that it selects |
//! | flags of [`SECURITY`] | left out: on loopback, none is needed |
//! | eviction | condition DisruptionTarget, SIGTERM, SIGKILL after the pod's grace period |
//! | security context, resources, probes, network policies | left out |

use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use k8s_openapi::api::batch::v1::{Job, JobSpec};
use k8s_openapi::api::core::v1::{
    ConfigMap, Container, EnvVar, EnvVarSource, PodSpec, Service, Volume,
};

use crate::binaries::{executable, sightline};
use crate::job::{JobState, PodEnd, PodId, Verdict};
use crate::manifests::Manifests;
use crate::process::{self, Ended, Process, eventually};
use crate::servers::free_port;

/// Flags that secure connections, each with one value but the last.
pub const SECURITY: [&str; 6] =
    ["--tls-cert", "--tls-key", "--tls-ca", "--tls-client-ca", "--token-file", "--insecure"];
/// A cluster of one machine.
pub struct Cluster {
    folder: PathBuf,
    config_maps: BTreeMap<String, BTreeMap<String, String>>,
    /// Ports on this machine by service and port.
    services: BTreeMap<(String, i32), u16>,
    jobs: BTreeMap<String, RunningJob>,
}

struct RunningJob {
    spec: JobSpec,
    state: JobState,
    /// Ports on this machine by port of the container.
    ports: BTreeMap<i32, u16>,
    pods: Vec<Pod>,
    ended: Vec<EndedPod>,
}

struct Pod {
    id: PodId,
    index: Option<u32>,
    process: Process,
    conditions: BTreeSet<String>,
    /// When SIGKILL follows SIGTERM.
    killed_at: Option<Instant>,
}

/// A pod that ended.
#[derive(Debug)]
pub struct EndedPod {
    /// Its index.
    pub index: Option<u32>,
    /// How its container ended: the exit code, or 128 and the number of the signal.
    pub exit_code: i32,
    /// True when it was evicted.
    pub is_disrupted: bool,
    /// The output of its container.
    pub output: Ended,
}

impl Cluster {
    /// A cluster with the ConfigMaps, Services and Jobs of the manifests. Nothing runs yet.
    ///
    /// # Panics
    /// When a Job is of a form that this module does not know.
    #[must_use]
    pub fn new(manifests: &Manifests, folder: &Path) -> Self {
        let config_maps = manifests.all::<ConfigMap>().into_iter();
        let config_maps = config_maps
            .map(|map| (map.metadata.name.unwrap_or_default(), map.data.unwrap_or_default()));
        let jobs: BTreeMap<String, RunningJob> =
            manifests.all::<Job>().into_iter().map(RunningJob::of).collect();
        let mut services = BTreeMap::new();
        for service in manifests.all::<Service>() {
            let name = service.metadata.name.clone().unwrap_or_default();
            let spec = service.spec.unwrap_or_default();
            let selector = spec.selector.unwrap_or_default();
            let job = jobs.values().find(|job| job.has_labels(&selector));
            let job = job.unwrap_or_else(|| panic!("service {name} selects no Job's pods"));
            for port in spec.ports.unwrap_or_default() {
                let number = job.container_port(port.name.as_deref().unwrap_or_default());
                services.insert((name.clone(), port.port), job.ports[&number]);
            }
        }
        std::fs::create_dir_all(folder.join("claim")).expect("a folder can be made");
        Self { folder: folder.to_owned(), config_maps: config_maps.collect(), services, jobs }
    }

    /// The folder that stands for the claim.
    #[must_use]
    pub fn claim(&self) -> PathBuf {
        self.folder.join("claim")
    }

    /// Port on this machine of a container port of a Job.
    ///
    /// # Panics
    /// When there is no such Job or port.
    #[must_use]
    pub fn port(&self, job: &str, port: i32) -> u16 {
        self.jobs[job].ports[&port]
    }

    /// Where a Job stands.
    ///
    /// # Panics
    /// When there is no such Job.
    #[must_use]
    pub fn state(&self, job: &str) -> &JobState {
        &self.jobs[job].state
    }

    /// The pods of a Job that have ended, in that order.
    ///
    /// # Panics
    /// When there is no such Job.
    #[must_use]
    pub fn ended(&self, job: &str) -> &[EndedPod] {
        &self.jobs[job].ended
    }

    /// True when the index of a Job has a pod that runs and was not asked to end.
    #[must_use]
    pub fn is_running(&mut self, job: &str, index: u32) -> bool {
        self.pod(job, index).is_some_and(|pod| pod.process.is_running() && !pod.is_terminating())
    }

    /// SIGKILL to the container of an index, as the kernel sends it when memory runs out.
    ///
    /// # Panics
    /// When the index has no running pod.
    pub fn kill(&mut self, job: &str, index: u32) {
        let pod = self.pod(job, index).expect("the index has a pod");
        pod.process.signal("KILL");
    }

    /// Evicts the pod of an index: its node is drained or taken back.
    ///
    /// # Panics
    /// When the index has no pod.
    pub fn evict(&mut self, job: &str, index: u32) {
        let pod = self.pod(job, index).expect("the index has a pod");
        pod.conditions.insert("DisruptionTarget".into());
        self.stop(job, index);
    }

    /// Deletes the pod of an index, as a user does: no condition says why.
    ///
    /// # Panics
    /// When the index has no pod.
    pub fn stop(&mut self, job: &str, index: u32) {
        let running = self.jobs.get_mut(job).expect("the Job is there");
        let grace = running.grace();
        let found = running.pods.iter_mut().find(|pod| pod.index.unwrap_or(0) == index);
        let pod = found.expect("the index has a pod");
        pod.terminate(grace);
        running.state.terminating(pod.id);
    }

    fn pod(&mut self, job: &str, index: u32) -> Option<&mut Pod> {
        let pods = &mut self.jobs.get_mut(job)?.pods;
        pods.iter_mut().find(|pod| pod.index.unwrap_or(0) == index)
    }

    /// Looks after all Jobs until `condition` holds; false when `limit` has passed.
    pub fn run_until(
        &mut self,
        limit: Duration,
        mut condition: impl FnMut(&mut Self) -> bool,
    ) -> bool {
        eventually(limit, || {
            self.look_after();
            condition(self)
        })
    }

    /// Runs until every Job is over and no pod is left.
    ///
    /// # Panics
    /// When that takes longer than `limit`.
    pub fn run_to_end(&mut self, limit: Duration) {
        let ended = self.run_until(limit, |cluster| cluster.jobs.values().all(RunningJob::is_over));
        let states: Vec<_> =
            self.jobs.iter().map(|(name, job)| (name, job.state.verdict())).collect();
        assert!(ended, "Jobs are not over: {states:?}");
    }

    /// One round of the controller: pods that ended, pods to end, pods to start.
    fn look_after(&mut self) {
        let names: Vec<String> = self.jobs.keys().cloned().collect();
        for name in names {
            let job = self.jobs.get_mut(&name).expect("the Job is there");
            job.collect();
            job.kill_overdue();
            if job.state.verdict() != Verdict::Running {
                job.terminate_all();
                continue;
            }
            while let Some(index) = self.jobs[&name].state.next_pod() {
                self.start(&name, index);
            }
        }
    }

    fn start(&mut self, name: &str, index: Option<u32>) {
        let job = self.jobs.get_mut(name).expect("the Job is there");
        let id = job.state.started(index);
        let pod_name = match index {
            Some(index) => format!("{name}-{index}-{}", id.0),
            None => format!("{name}-{}", id.0),
        };
        let job = &self.jobs[name];
        let folder = self.folder.join(&pod_name);
        std::fs::create_dir_all(&folder).expect("a folder can be made");
        let pod = PodContext { cluster: self, job, name: &pod_name, folder: &folder };
        let mut command = pod.command(index);
        let process = Process::start(&mut command, &folder, "container");
        let pod = Pod { id, index, process, conditions: BTreeSet::new(), killed_at: None };
        self.jobs.get_mut(name).expect("the Job is there").pods.push(pod);
    }
}

impl Pod {
    const fn is_terminating(&self) -> bool {
        self.killed_at.is_some()
    }

    fn terminate(&mut self, grace: Duration) {
        if self.killed_at.is_none() {
            self.killed_at = Some(Instant::now() + grace);
            self.process.signal("TERM");
        }
    }
}

impl RunningJob {
    fn of(job: Job) -> (String, Self) {
        let name = job.metadata.name.unwrap_or_default();
        let spec = job.spec.expect("a Job has a specification");
        let state = JobState::new(&spec);
        let mut job =
            Self { spec, state, ports: BTreeMap::new(), pods: Vec::new(), ended: Vec::new() };
        let declared = job.container().ports.clone().unwrap_or_default();
        job.ports = declared.iter().map(|port| (port.container_port, free_port())).collect();
        (name, job)
    }

    fn pod_spec(&self) -> &PodSpec {
        self.spec.template.spec.as_ref().expect("a Job has a pod template")
    }

    fn container(&self) -> &Container {
        let containers = &self.pod_spec().containers;
        assert_eq!(containers.len(), 1, "one container a pod is known here");
        &containers[0]
    }

    fn container_port(&self, name: &str) -> i32 {
        let ports = self.container().ports.as_deref().unwrap_or_default();
        let port = ports.iter().find(|port| port.name.as_deref() == Some(name));
        port.unwrap_or_else(|| panic!("no container port is called {name}")).container_port
    }

    fn has_labels(&self, selector: &BTreeMap<String, String>) -> bool {
        let labels = self.spec.template.metadata.as_ref().and_then(|m| m.labels.as_ref());
        let has = |(key, value): (&String, &String)| labels.and_then(|l| l.get(key)) == Some(value);
        !selector.is_empty() && selector.iter().all(has)
    }

    fn grace(&self) -> Duration {
        let seconds = self.pod_spec().termination_grace_period_seconds.unwrap_or(30);
        Duration::from_secs(u64::try_from(seconds).unwrap_or(0))
    }

    fn is_over(&self) -> bool {
        self.state.verdict() != Verdict::Running && self.pods.is_empty()
    }

    fn collect(&mut self) {
        let container = self.container().name.clone();
        let mut at = 0;
        while at < self.pods.len() {
            if self.pods[at].process.is_running() {
                at += 1;
                continue;
            }
            let pod = self.pods.remove(at);
            let output = pod.process.wait(Duration::ZERO);
            let signal = output.status.signal().map(|signal| 128 + signal);
            let exit_code = output.status.code().or(signal).unwrap_or(-1);
            let end = PodEnd {
                exit_codes: BTreeMap::from([(container.clone(), exit_code)]),
                conditions: pod.conditions,
            };
            self.state.ended(pod.id, &end);
            let is_disrupted = !end.conditions.is_empty();
            self.ended.push(EndedPod { index: pod.index, exit_code, is_disrupted, output });
        }
    }

    fn kill_overdue(&mut self) {
        let now = Instant::now();
        for pod in &mut self.pods {
            if pod.killed_at.is_some_and(|at| at <= now) {
                pod.process.signal("KILL");
            }
        }
    }

    fn terminate_all(&mut self) {
        let grace = self.grace();
        for pod in &mut self.pods {
            pod.terminate(grace);
            self.state.terminating(pod.id);
        }
    }
}

/// What the command of a pod is made from.
struct PodContext<'a> {
    cluster: &'a Cluster,
    job: &'a RunningJob,
    name: &'a str,
    folder: &'a Path,
}

impl PodContext<'_> {
    fn command(&self, index: Option<u32>) -> Command {
        let container = self.job.container();
        let words = container.command.iter().chain(&container.args).flatten();
        let mut environment: BTreeMap<String, String> = BTreeMap::new();
        for variable in container.env.iter().flatten() {
            let value = self.value(variable);
            environment.insert(variable.name.clone(), value);
        }
        if let Some(index) = index {
            environment.insert("JOB_COMPLETION_INDEX".into(), index.to_string());
        }
        let volumes = self.volumes();
        let words: Vec<String> = words.map(|word| expand(word, &environment)).collect();
        let (program, arguments) = words.split_first().expect("the container has a command");
        let program = Path::new(program);
        assert_eq!(program.parent(), Some(Path::new("/usr/local/bin")), "{program:?}");
        let name = program.file_name().and_then(|n| n.to_str()).expect("it is called something");
        let mut command = Command::new(executable(name));
        // The environment of a pod is that of its manifest.
        command.env_clear().envs(&environment).current_dir(self.folder);
        command.args(unsecured(arguments).iter().map(|word| self.mapped(word, &volumes)));
        command
    }

    fn value(&self, variable: &EnvVar) -> String {
        if let Some(value) = &variable.value {
            return value.clone();
        }
        match &variable.value_from {
            Some(EnvVarSource { config_map_key_ref: Some(key), .. }) => {
                self.cluster.config_maps[&key.name][&key.key].clone()
            }
            Some(EnvVarSource { field_ref: Some(field), .. })
                if field.field_path == "metadata.name" =>
            {
                self.name.to_owned()
            }
            other => panic!("{} comes from {other:?}, which is not known here", variable.name),
        }
    }

    /// Folders by the path that they are mounted at, nested ones last.
    fn volumes(&self) -> BTreeMap<String, PathBuf> {
        let volumes = self.job.pod_spec().volumes.as_deref().unwrap_or_default();
        let mounts = self.job.container().volume_mounts.as_deref().unwrap_or_default();
        let folder_of = |name: &str| {
            let volume = volumes.iter().find(|volume| volume.name == name);
            self.volume(volume.unwrap_or_else(|| panic!("there is no volume {name}")))
        };
        mounts.iter().map(|m| (m.mount_path.clone(), folder_of(&m.name))).collect()
    }

    fn volume(&self, volume: &Volume) -> PathBuf {
        if volume.persistent_volume_claim.is_some() {
            return self.cluster.claim();
        }
        let folder = self.folder.join(&volume.name);
        std::fs::create_dir_all(&folder).expect("a folder can be made");
        if let Some(map) = &volume.config_map {
            for (key, text) in &self.cluster.config_maps[&map.name] {
                std::fs::write(folder.join(key), text).expect("a file can be written");
            }
        } else {
            assert!(volume.empty_dir.is_some() || volume.secret.is_some(), "{volume:?}");
        }
        folder
    }

    /// A word of the command line as it reads on this machine.
    fn mapped(&self, word: &str, volumes: &BTreeMap<String, PathBuf>) -> String {
        for (mount, folder) in volumes.iter().rev() {
            if let Some(rest) = word.strip_prefix(mount.as_str())
                && (rest.is_empty() || rest.starts_with('/'))
            {
                return format!("{}{rest}", folder.display());
            }
        }
        if let Some(port) = word.strip_prefix("0.0.0.0:") {
            let port: i32 = port.parse().expect("a port is a number");
            return format!("127.0.0.1:{}", self.job.ports.get(&port).copied().unwrap_or(0));
        }
        let address = word.strip_prefix("https://").or_else(|| word.strip_prefix("http://"));
        if let Some((service, port)) = address.and_then(|a| a.rsplit_once(':')) {
            let port: i32 = port.parse().expect("a port is a number");
            let mapped = self.cluster.services.get(&(service.to_owned(), port));
            return format!("http://127.0.0.1:{}", mapped.expect("the service is there"));
        }
        word.to_owned()
    }
}

/// `$(NAME)` for the value of NAME.
fn expand(word: &str, environment: &BTreeMap<String, String>) -> String {
    let mut word = word.to_owned();
    for (name, value) in environment {
        word = word.replace(&format!("$({name})"), value);
    }
    assert!(!word.contains("$("), "`{word}` quotes a variable that is not there");
    word
}

/// The arguments without those of [`SECURITY`].
fn unsecured(arguments: &[String]) -> Vec<String> {
    let mut kept = Vec::new();
    let mut words = arguments.iter();
    while let Some(word) = words.next() {
        match word.as_str() {
            "--insecure" => {}
            flag if SECURITY.contains(&flag) => {
                words.next();
            }
            _ => kept.push(word.clone()),
        }
    }
    kept
}

/// The help of a command of `sightline`.
///
/// # Panics
/// When there is no such command.
#[must_use]
pub fn help_of(command: &str) -> String {
    process::run(&mut sightline([command, "--help"]), crate::city::LIMIT).success().stdout
}
