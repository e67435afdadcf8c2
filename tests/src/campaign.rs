//! A campaign against a coordinator: attackers of [`crate::fuzzing`], and beside them a viewer and a
//! worker that behave, who check after each other that it answers and that its state is sound.

use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use sightline_jobs::{BakeStatus, FORMAT_VERSION, Phase};
use sightline_proto::access::Role;
use sightline_proto::v1::{self, lease_response::Answer, report_request::Result as Report};
use sightline_worker::ClientSecurity;
use tokio::runtime::Runtime;

use crate::binaries::sightline;
use crate::city::{self, LIMIT};
use crate::dataset;
use crate::fuzzing::{Chance, Sent, Target, attack};
use crate::process::{Ended, Process, eventually};

/// Most memory that the coordinator may take, bytes. It takes some 60 MiB undisturbed.
const MEMORY_BYTES_MAX: u64 = 768 << 20;
/// Time between two checks.
const CHECK_EVERY: Duration = Duration::from_millis(100);
const TOKENS: [&str; 2] = ["0123456789abcdef-worker", "0123456789abcdef-viewer"];
/// The exit code of a bake of which tasks are missing: attackers who lease tasks can fail them.
const INCOMPLETE: i32 = 5;
const INTERRUPTED: i32 = 130;

/// What a campaign does.
#[derive(Clone, Debug)]
pub struct Campaign {
    /// An empty folder.
    pub folder: PathBuf,
    /// A scene that [`city::generate`] made.
    pub scene: PathBuf,
    /// What `sightline bake` makes of it.
    pub baked: PathBuf,
    /// Seed of what is sent.
    pub seed: u64,
    /// How long.
    pub time: Duration,
    /// Attackers at a time.
    pub attackers: u64,
}

/// What came of it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Figures {
    /// What was sent.
    pub sent: Sent,
    /// Checks that the coordinator passed.
    pub checks: u64,
    /// Coordinators that were started: one more for each bake that attackers ended.
    pub coordinators: u64,
    /// Most memory of a coordinator, bytes; 0 where the system does not tell.
    pub memory_bytes: u64,
}

/// A coordinator under attack.
struct Victim {
    process: Process,
    address: SocketAddr,
    committed: u32,
    epoch: Option<u64>,
}

impl Campaign {
    /// Runs it. At the end the bake goes on without attackers, to the bytes of `sightline bake`.
    ///
    /// # Panics
    /// When the coordinator does not answer, answers something unsound, panics, takes too much
    /// memory, ends otherwise than with tasks that attackers failed, or when the dataset differs.
    #[must_use]
    pub fn run(&self) -> Figures {
        let tokens = self.folder.join("tokens");
        let text = format!("worker: {}\nviewer: {}\n", TOKENS[0], TOKENS[1]);
        std::fs::write(&tokens, text).expect("a file can be written");
        let security = ClientSecurity { token_file: Some(tokens), ..ClientSecurity::default() };
        let runtime = Runtime::new().expect("a runtime starts");
        let (start, mut figures, mut round) = (Instant::now(), Figures::default(), 0);
        while start.elapsed() < self.time {
            let mut victim = self.start(&security, round);
            figures.coordinators += 1;
            self.besiege(&mut victim, &runtime, &security, start, &mut figures);
            sound(&self.end(victim, start.elapsed() < self.time));
            round += 1;
        }
        self.finish(&security);
        figures
    }

    fn dataset(&self) -> PathBuf {
        self.folder.join("dataset")
    }

    fn start(&self, security: &ClientSecurity, round: u64) -> Victim {
        let port = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a port is free");
        let address = port.local_addr().expect("it has an address");
        drop(port);
        let mut command =
            sightline(city::bake_arguments("coordinator", &self.scene, &self.dataset(), [1, 1]));
        command.arg("--listen").arg(address.to_string());
        command.arg("--token-file").arg(security.token_file.as_ref().expect("it was written"));
        let name = format!("coordinator-{round}");
        let mut process = Process::start(&mut command, &self.folder, &name);
        let listens =
            eventually(LIMIT, || TcpStream::connect(address).is_ok() || !process.is_running());
        assert!(listens && process.is_running(), "{}", process.stderr());
        Victim { process, address, committed: 0, epoch: None }
    }

    /// Attacks until the time is up or the bake has ended.
    fn besiege(
        &self,
        victim: &mut Victim,
        runtime: &Runtime,
        security: &ClientSecurity,
        start: Instant,
        figures: &mut Figures,
    ) {
        let first = victim.look(runtime, security).expect("an undisturbed coordinator answers");
        let target = Target {
            address: victim.address,
            tokens: TOKENS.map(str::to_owned),
            epoch: first.epoch,
            bake_id: first.bake_id,
        };
        let goes_on = Arc::new(AtomicBool::new(true));
        let attackers: Vec<_> = (0..self.attackers)
            .map(|k| {
                let (target, goes_on) = (target.clone(), Arc::clone(&goes_on));
                let seed = self.seed ^ (figures.coordinators << 32) ^ (k << 16);
                std::thread::spawn(move || siege(&target, &mut Chance(seed), &goes_on))
            })
            .collect();
        while start.elapsed() < self.time && victim.process.is_running() {
            // A bake that ends in the middle of a check is no failure of the check.
            match victim.check(runtime, security) {
                Ok(()) => figures.checks += 1,
                Err(problem) => {
                    let ends = eventually(Duration::from_secs(10), || !victim.process.is_running());
                    assert!(ends, "{problem}\n{}", victim.process.stderr());
                }
            }
            let memory_bytes = memory_of(victim.process.id());
            assert!(memory_bytes <= MEMORY_BYTES_MAX, "it takes {memory_bytes} bytes");
            figures.memory_bytes = figures.memory_bytes.max(memory_bytes);
            eventually(CHECK_EVERY, || false);
        }
        goes_on.store(false, Ordering::Relaxed);
        for attacker in attackers {
            let sent = attacker.join().expect("an attacker does not panic");
            figures.sent.connections += sent.connections;
            figures.sent.requests += sent.requests;
            figures.sent.answered += sent.answered;
            figures.sent.refused += sent.refused;
        }
    }

    fn end(&self, mut victim: Victim, is_early: bool) -> Ended {
        if is_early {
            return victim.process.wait(LIMIT).failure(INCOMPLETE);
        }
        if victim.process.is_running() {
            victim.process.interrupt();
            return victim.process.wait(LIMIT).failure(INTERRUPTED);
        }
        victim.process.wait(LIMIT).failure(INCOMPLETE)
    }

    /// The bake goes on where it was.
    fn finish(&self, security: &ClientSecurity) {
        let victim = self.start(security, u64::MAX);
        let url = format!("http://{}", victim.address);
        let mut command = sightline(["worker", "--threads=2", "--coordinator", &url]);
        command.arg("--token-file").arg(security.token_file.as_ref().expect("it was written"));
        let worker = Process::start(&mut command, &self.folder, "worker");
        let _ = victim.process.wait(LIMIT).success();
        let _ = worker.wait(LIMIT).success();
        dataset::assert_same(&self.baked, &self.dataset());
    }
}

fn siege(target: &Target, chance: &mut Chance, goes_on: &AtomicBool) -> Sent {
    let mut all = Sent::default();
    while goes_on.load(Ordering::Relaxed) {
        let sent = attack(target, chance, Duration::from_millis(500));
        all.connections += sent.connections;
        all.requests += sent.requests;
        all.answered += sent.answered;
        all.refused += sent.refused;
        if sent.connections == 0 {
            // Over its limits, or gone.
            eventually(CHECK_EVERY, || false);
        }
    }
    all
}

fn sound(ended: &Ended) {
    assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
    assert!(!ended.stderr.contains("defect"), "{}", ended.stderr);
    for token in TOKENS {
        assert!(!ended.stderr.contains(token), "no secret is logged");
    }
}

impl Victim {
    fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    fn look(&self, runtime: &Runtime, security: &ClientSecurity) -> Result<BakeStatus, String> {
        runtime.block_on(async {
            let client = security.client(&self.url(), Role::Viewer);
            let mut client = client.map_err(|error| error.to_string())?;
            let answer = client.get_status(v1::GetStatusRequest {}).await;
            let message = answer.map_err(|status| format!("{status:?}"))?.into_inner();
            Ok(BakeStatus::try_from(message).expect("a status is well formed"))
        })
    }

    /// One look and one life of a worker, and what has to hold.
    fn check(&mut self, runtime: &Runtime, security: &ClientSecurity) -> Result<(), String> {
        let status = self.look(runtime, security)?;
        let t = status.tasks;
        let sum = t.committed + t.leased + t.ready + t.waiting + t.quarantined;
        assert_eq!(sum, t.tasks, "SC-3: each task is in one state");
        assert!(t.committed >= self.committed, "JB-1: what is committed stays so");
        assert_eq!(*self.epoch.get_or_insert(status.epoch), status.epoch, "an epoch stays");
        assert_ne!(status.phase, Phase::Published, "JB-2: nobody has solved anything");
        assert!(status.leases_in_force >= t.leased, "every leased task has a lease");
        assert!(status.leases_in_force <= 2 * t.leased, "SC-1: two attempts at a task at most");
        let lists = [status.workers.len(), status.leases.len(), status.quarantined.len()];
        assert!(lists.iter().all(|length| *length <= BakeStatus::LISTED_MAX), "{lists:?}");
        assert!(status.workers.iter().all(|w| w.name.len() <= 200), "names are short");
        self.committed = t.committed;
        runtime.block_on(self.behave(security)).map_err(|status| format!("{status:?}"))
    }

    /// Joins, leases, keeps the lease, gives it back and leaves.
    async fn behave(&self, security: &ClientSecurity) -> Result<(), tonic::Status> {
        let client = security.client(&self.url(), Role::Worker);
        let mut client = client.map_err(|error| tonic::Status::unknown(error.to_string()))?;
        let request = v1::RegisterRequest {
            worker_name: "well-behaved".into(),
            threads: 1,
            format_version: FORMAT_VERSION,
            ..v1::RegisterRequest::default()
        };
        let session = client.register(request).await?.into_inner();
        let (worker_id, epoch) = (session.worker_id, session.epoch);
        let answer = client.lease(v1::LeaseRequest { worker_id, epoch }).await;
        // An attacker may have said goodbye in its name: with tokens, workers are not told apart.
        let is_gone = |status: &tonic::Status| status.code() == tonic::Code::NotFound;
        let answer = match answer {
            Err(status) if is_gone(&status) => return Ok(()),
            answer => answer?.into_inner().answer,
        };
        if let Some(Answer::Task(task)) = answer {
            let lease_ids = vec![task.lease_id];
            let beat = v1::HeartbeatRequest { worker_id, epoch, lease_ids };
            let result = Some(Report::Released(v1::Released {}));
            let (lease_id, task) = (task.lease_id, task.task);
            let report = v1::ReportRequest { worker_id, epoch, lease_id, task, result };
            for answer in
                [client.heartbeat(beat).await.map(drop), client.report(report).await.map(drop)]
            {
                match answer {
                    Err(status) if is_gone(&status) => return Ok(()),
                    answer => answer?,
                }
            }
        }
        match client.goodbye(v1::GoodbyeRequest { worker_id, epoch }).await {
            Err(status) if !is_gone(&status) => Err(status),
            _ => Ok(()),
        }
    }
}

/// Resident memory of a process, bytes.
fn memory_of(process: u32) -> u64 {
    let text = std::fs::read_to_string(Path::new("/proc").join(process.to_string()).join("status"));
    let text = text.unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.trim().strip_suffix(" kB")?.parse::<u64>().ok());
    kib.unwrap_or(0) * 1024
}
