//! Bakes by real processes while these are killed, stopped and cut off.
//!
//! A run is one bake of a small street by a `sightline-coordinator` and two or three
//! `sightline-worker`s, with leases of about a second. What goes wrong is drawn from a seed (`faults`);
//! when, is up to the clock and the machine, so a seed repeats the plan of a run and not its history.
//! The simulation (`crate::simulation`) is the other way round: it repeats everything, and its sockets,
//! clocks and store are not real.
//!
//! Faults:
//! - SIGKILL of a worker or the coordinator, and its restart a while later;
//! - SIGSTOP of either, for less than a lease or for several, and SIGCONT;
//! - a second coordinator while the first is stopped, which then wakes up;
//! - SIGTERM, and a restart;
//! - between workers and coordinator: connections that are cut, slow or stalled (`crate::tcp_proxy`);
//! - a full disk, for bakes to a folder: a small file system of its own, filled to the last block;
//! - in front of an object store: requests that are lost, and answers that are lost behind the store's
//!   work (`crate::flaky_proxy`).
//!
//! Who ends with a failure is started again, as a supervisor would.
//!
//! A run keeps these promises, or panics:
//! - when the faults are over the bake ends, with the bytes of `sightline bake` undisturbed (VI-3);
//! - when every process is killed for good half-way, the same `sightline bake` goes on to those bytes;
//! - a pointer that is there when everybody was killed names that whole dataset already (JB-2);
//! - no process panicked, and a coordinator that was replaced ends by itself.

mod cluster;
mod disk;
mod faults;
mod place;
mod run;
mod sleeper;

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use rayon::prelude::*;

use crate::binaries::{executable, sightline};
use crate::city::{self, LIMIT};
use crate::process;
use crate::servers::{self, Server};

pub use run::Ended;

/// A street short enough to be baked again and again: some two seconds of one core, in tasks of one
/// segment and one cell.
const CONFIG: &str = "\
[region]
rectangles = [[-5.0, -10.0, 5.0, 0.0]]
cell_size = 5.0
[solver]
rows = 24
[accuracy]
target_error = 0.0001
worst_error = 0.001
rounds = 1
[tasks]
segments_per_task = 1
cells_per_task = 1
";

/// Where bakes go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Store {
    /// A folder.
    Files,
    /// S3, from PyPI.
    Moto,
    /// Azure Blob Storage, from npm.
    Azurite,
}

impl Store {
    /// Every store.
    pub const ALL: [Self; 3] = [Self::Files, Self::Moto, Self::Azurite];

    /// The name on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Files => "files",
            Self::Moto => "moto",
            Self::Azurite => "azurite",
        }
    }
}

/// Runs on one store.
pub struct Campaign {
    store: Store,
    server: Option<Server>,
    folder: PathBuf,
    scene: PathBuf,
    config: PathBuf,
    /// What `sightline bake` made undisturbed.
    baked: PathBuf,
}

/// How the runs of a campaign ended.
#[derive(Debug, Default)]
pub struct Report {
    /// Runs that kept every promise.
    pub kept: u64,
    /// Seeds of the others.
    pub broken: Vec<u64>,
    /// How often each fault happened.
    pub faults: BTreeMap<String, u64>,
    /// What processes said that ended with a failure of their own, and how many.
    pub gave_up: BTreeMap<String, u64>,
    /// Wall time.
    pub took: Duration,
}

impl Campaign {
    /// Bakes undisturbed, once, into an empty `folder`. `None` when the store's server is not installed;
    /// `test` says who needs it.
    ///
    /// # Panics
    /// When a command fails.
    #[must_use]
    pub fn prepare(store: Store, folder: &Path, test: &str) -> Option<Self> {
        let server = match store {
            Store::Files => None,
            Store::Moto => Some(servers::moto(test)?),
            Store::Azurite => Some(servers::azurite(test)?),
        };
        // Left over from the last campaign, or not there.
        let _ = std::fs::remove_dir_all(folder);
        std::fs::create_dir_all(folder).expect("a folder can be made");
        let (scene, config) = (folder.join("city.glb"), folder.join("bake.toml"));
        city::generate(&scene, 7);
        std::fs::write(&config, CONFIG).expect("a file can be written");
        let baked = folder.join("baked");
        let campaign = Self { store, server, folder: folder.to_owned(), scene, config, baked };
        let out = campaign.baked.display().to_string();
        let _ = process::run(&mut campaign.bake(&out), LIMIT).success();
        Some(campaign)
    }

    /// Runs seed by seed, `at_a_time` next to each other.
    ///
    /// # Panics
    /// When the threads for it cannot be started.
    #[must_use]
    pub fn run_all(&self, seeds: std::ops::Range<u64>, at_a_time: usize) -> Report {
        let start = Instant::now();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(at_a_time).build();
        let run = |seed| (seed, catch_unwind(AssertUnwindSafe(|| run::run(self, seed))));
        let pool = pool.expect("threads can be started");
        let ended: BTreeMap<_, _> = pool.install(|| seeds.par_bridge().map(run).collect());
        let mut report = Report { took: start.elapsed(), ..Report::default() };
        for (seed, ended) in ended {
            // The panic has been printed.
            let Ok(Ended { faults, gave_up }) = ended else {
                report.broken.push(seed);
                continue;
            };
            report.kept += 1;
            for (fault, times) in faults {
                *report.faults.entry(fault).or_default() += times;
            }
            for reason in gave_up {
                *report.gave_up.entry(reason).or_default() += 1;
            }
        }
        report
    }

    /// Faults that the store can meet and that did not happen in any run.
    #[must_use]
    pub fn never_met(&self, report: &Report) -> Vec<String> {
        let expected = faults::names(self.store);
        expected.into_iter().filter(|name| !report.faults.contains_key(name)).collect()
    }

    /// A worker that stops for a while and wakes when its task was given away and done by another; at
    /// least until then, and for `asleep`.
    ///
    /// # Panics
    /// When it changes anything.
    pub fn sleeper(&self, asleep: Duration) {
        sleeper::run(self, asleep);
    }

    /// The bake in one process.
    fn bake(&self, out: &str) -> Command {
        let mut command = sightline(["bake"]);
        command.arg(&self.scene).args(["--json", "--out", out, "--config"]).arg(&self.config);
        command
    }

    fn coordinator(&self, out: &str, port: u16, lease_ms: u64) -> Command {
        let mut command = Command::new(executable("sightline-coordinator"));
        command.arg(&self.scene).args(["--out", out, "--config"]).arg(&self.config);
        command.args(["--listen", &format!("127.0.0.1:{port}")]);
        command.args(["--lease-ms", &lease_ms.to_string()]);
        command
    }

    fn worker(port: u16, name: &str) -> Command {
        let mut command = Command::new(executable("sightline-worker"));
        command.arg(format!("http://127.0.0.1:{port}"));
        command.args(["--threads=1", "--drain-seconds=1", "--name", name]);
        command
    }
}
