//! The processes of a run: started, hurt, and started again.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rand::Rng;
use rand::rngs::SmallRng;

use super::Campaign;
use super::faults::{Fault, Spell};
use super::place::Place;
use crate::city::LIMIT;
use crate::process::{Ended, Process, eventually};
use crate::servers::free_port;
use crate::tcp_proxy::TcpProxy;

/// Longest delay of a chunk between workers and coordinator, ms.
const DELAY_MS_MAX: u64 = 150;
/// How long a supervisor takes to start a worker again.
const RESTART_TIME: Duration = Duration::from_millis(500);
/// Failures of coordinators behind the faults that are put up with: what went wrong last may only be
/// noticed then.
const FAILURES_WHEN_CALM_MAX: usize = 3;

/// What ends a fault.
#[derive(Clone, Copy, Debug)]
enum Relief {
    StartWorker(usize),
    StartCoordinator,
    WakeWorker(usize),
    WakeCoordinators,
    FreeConnections,
    FreeDisk,
}

/// The processes of one bake.
pub(super) struct Cluster<'c> {
    campaign: &'c Campaign,
    place: &'c Place<'c>,
    folder: PathBuf,
    lease_ms: u64,
    line: TcpProxy,
    /// Where the newest coordinator listens.
    port: u16,
    /// `None` between its end and its restart.
    coordinator: Option<Process>,
    /// Coordinators that were stopped and replaced, and whether they had an epoch by then.
    replaced: Vec<(Process, bool)>,
    workers: Vec<Option<Process>>,
    starts: u32,
    /// What will end the faults that last, and when.
    reliefs: Vec<(Instant, Relief)>,
    /// What processes said that ended with a failure of their own.
    pub gave_up: Vec<String>,
}

impl<'c> Cluster<'c> {
    pub fn start(
        campaign: &'c Campaign,
        place: &'c Place<'c>,
        folder: &Path,
        workers: usize,
        lease_ms: u64,
    ) -> Self {
        let port = free_port();
        let mut cluster = Self {
            campaign,
            place,
            folder: folder.to_owned(),
            lease_ms,
            line: TcpProxy::before(port),
            port,
            coordinator: None,
            replaced: Vec::new(),
            workers: (0..workers).map(|_| None).collect(),
            starts: 0,
            reliefs: Vec::new(),
            gave_up: Vec::new(),
        };
        cluster.start_coordinator();
        (0..workers).for_each(|k| cluster.start_worker(k));
        cluster
    }

    /// Until `limit` or the end of the bake. True at the end.
    pub fn goes_on(&mut self, limit: Duration) -> bool {
        let mut is_over = false;
        eventually(limit, || {
            let now = Instant::now();
            while let Some(due) = self.reliefs.iter().position(|(at, _)| *at <= now) {
                let (_, relief) = self.reliefs.swap_remove(due);
                self.relieve(relief);
            }
            is_over = self.look_after();
            is_over
        });
        is_over
    }

    /// Until all that went wrong is over, or the bake is. True when it is.
    pub fn outlasts_its_faults(&mut self) -> bool {
        let last = self.reliefs.iter().map(|(at, _)| *at).max();
        let left = last.map_or(Duration::ZERO, |at| at.saturating_duration_since(Instant::now()));
        self.goes_on(left)
    }

    /// Starts who has ended and should not have. True when the newest coordinator has published.
    fn look_after(&mut self) -> bool {
        if let Some(ended) = ended(&mut self.coordinator) {
            if ended.status.success() {
                return true;
            }
            self.gave_up.push(reason(&ended));
            self.port = free_port();
            self.line.lead_to(self.port);
            self.start_coordinator();
        }
        for k in 0..self.workers.len() {
            if let Some(ended) = ended(&mut self.workers[k]) {
                if !ended.status.success() {
                    self.gave_up.push(reason(&ended));
                }
                // It was asked to stop, or told of an end that the newest coordinator has yet to find.
                self.reliefs.push((Instant::now() + RESTART_TIME, Relief::StartWorker(k)));
            }
        }
        false
    }

    /// Does what a fault says; false when there is nobody to do it to.
    pub fn suffer(&mut self, spell: Spell, rng: &mut SmallRng) -> bool {
        let worker = rng.random_range(0..self.workers.len());
        let Some(relief) = self.begin(spell.fault, worker, rng) else { return false };
        if let Some(relief) = relief {
            self.reliefs.push((Instant::now() + spell.lasts, relief));
        }
        true
    }

    /// The outer `None` when nothing happened, the inner where nothing has to end it.
    fn begin(&mut self, fault: Fault, worker: usize, rng: &mut SmallRng) -> Option<Option<Relief>> {
        let relief = match fault {
            Fault::WorkerKilled => {
                kill(self.workers[worker].take()?);
                Relief::StartWorker(worker)
            }
            Fault::CoordinatorKilled => {
                kill(self.coordinator.take()?);
                Relief::StartCoordinator
            }
            Fault::WorkerStopped | Fault::WorkerStoppedBeyondItsLease => {
                self.workers[worker].as_mut()?.signal("STOP");
                Relief::WakeWorker(worker)
            }
            Fault::CoordinatorStopped => {
                self.coordinator.as_mut()?.signal("STOP");
                Relief::WakeCoordinators
            }
            Fault::CoordinatorStoppedAndReplaced => {
                let mut old = self.coordinator.take()?;
                old.signal("STOP");
                let had_begun = old.stderr().contains("the bake starts");
                self.replaced.push((old, had_begun));
                self.port = free_port();
                self.line.lead_to(self.port);
                self.start_coordinator();
                // Otherwise workers hang on the old one until they lose patience or it wakes.
                if rng.random_bool(0.7) {
                    self.line.cut();
                }
                Relief::WakeCoordinators
            }
            Fault::WorkerAskedToStop => {
                self.workers[worker].as_mut()?.signal("TERM");
                return Some(None);
            }
            Fault::CoordinatorAskedToStop => {
                self.coordinator.as_mut()?.signal("TERM");
                return Some(None);
            }
            Fault::ConnectionsCut => {
                self.line.cut();
                return Some(None);
            }
            Fault::ConnectionsSlow => {
                self.line.delay(Duration::from_millis(rng.random_range(1..DELAY_MS_MAX)));
                Relief::FreeConnections
            }
            Fault::ConnectionsStalled => {
                self.line.stall(true);
                Relief::FreeConnections
            }
            Fault::DiskFull => {
                self.place.disk()?.fill();
                Relief::FreeDisk
            }
        };
        Some(Some(relief))
    }

    fn relieve(&mut self, relief: Relief) {
        match relief {
            Relief::StartWorker(k) if self.workers[k].is_none() => self.start_worker(k),
            Relief::StartCoordinator if self.coordinator.is_none() => self.start_coordinator(),
            // Somebody has been started meanwhile.
            Relief::StartWorker(_) | Relief::StartCoordinator => {}
            Relief::WakeWorker(k) => self.workers[k].iter_mut().for_each(|w| w.signal("CONT")),
            Relief::WakeCoordinators => {
                let all = self.replaced.iter_mut().map(|(old, _)| old).chain(&mut self.coordinator);
                all.for_each(|coordinator| coordinator.signal("CONT"));
            }
            Relief::FreeConnections => {
                self.line.delay(Duration::ZERO);
                self.line.stall(false);
            }
            Relief::FreeDisk => self.place.disk().into_iter().for_each(super::disk::Disk::free),
        }
    }

    fn start_coordinator(&mut self) {
        let mut command = self.campaign.coordinator(&self.place.out(), self.port, self.lease_ms);
        let name = self.next_name("coordinator");
        self.coordinator =
            Some(Process::start(self.place.admit(&mut command), &self.folder, &name));
    }

    fn start_worker(&mut self, k: usize) {
        let name = self.next_name("worker");
        let mut command = Campaign::worker(self.line.port(), &name);
        let cache = self.folder.join("cache");
        let command = self.place.admit(command.arg("--cache").arg(cache));
        self.workers[k] = Some(Process::start(command, &self.folder, &name));
    }

    /// No output is written over that of another start.
    fn next_name(&mut self, of: &str) -> String {
        self.starts += 1;
        format!("{:02}-{of}", self.starts)
    }

    /// SIGKILL for all, and nobody is started again.
    pub fn kill_all(self) {
        let all = self.replaced.into_iter().map(|(old, _)| old).chain(self.coordinator);
        all.chain(self.workers.into_iter().flatten()).for_each(kill);
    }

    /// Ends the faults and waits for the end of the bake and of everybody.
    pub fn finish(&mut self, mut is_over: bool) {
        self.place.calm();
        for (_, relief) in std::mem::take(&mut self.reliefs) {
            self.relieve(relief);
        }
        let failures = self.gave_up.len();
        if !is_over {
            is_over = self.goes_on(LIMIT);
        }
        let late = &self.gave_up[failures..];
        assert!(is_over, "the bake does not end; meanwhile: {late:?}");
        assert!(late.len() <= FAILURES_WHEN_CALM_MAX, "nothing disturbs them: {late:?}");
        for (mut old, had_begun) in self.replaced.drain(..) {
            // It finds out from the store. Stopped before it had an epoch, it took a newer one when it
            // woke, and waits for workers.
            if !had_begun {
                old.signal("TERM");
            }
            let _ = old.wait(LIMIT);
        }
        for mut worker in self.workers.drain(..).flatten() {
            worker.signal("TERM");
            let _ = worker.wait(LIMIT);
        }
    }
}

/// Takes a process that has ended by itself.
fn ended(process: &mut Option<Process>) -> Option<Ended> {
    process.take_if(|p| !p.is_running()).map(|p| p.wait(LIMIT))
}

/// SIGKILL, also for who has just ended.
fn kill(mut process: Process) {
    process.signal("KILL");
    let _ = process.wait(LIMIT);
}

/// Who it was and the last that it said, without what differs from run to run.
fn reason(ended: &Ended) -> String {
    let last = ended.stderr.lines().rev().find(|line| line.contains("ERROR")).unwrap_or_default();
    let text = last.split_once("ERROR").map_or("nothing", |(_, text)| text.trim());
    let plain: String = text.chars().map(|c| if c.is_ascii_digit() { '0' } else { c }).collect();
    let who = if ended.name.contains("sightline-coordinator") { "coordinator" } else { "worker" };
    format!("{who}, {}: {plain}", ended.status)
}
