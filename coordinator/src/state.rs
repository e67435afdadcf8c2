//! What a running coordinator knows: the scheduler, its workers, and the status made from them.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use sightline_jobs::{
    BakeStatus, FailureClass, Lease, LeaseId, LeaseStatus, Outcome, Phase, Plan, QuarantinedTask,
    SchedulePolicy, Scheduler, TaskAttempts, TaskId, TaskKind, WorkerId, WorkerStatus,
};

/// A registered worker.
#[derive(Clone, Debug)]
struct Registered {
    name: String,
    threads: u32,
    tasks_committed: u32,
}

/// A worker's word that a task is committed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reported {
    pub worker: WorkerId,
    pub lease: LeaseId,
    /// Time spent in computing, ms.
    pub solve_ms: u64,
    /// Segments or cells that were taken over from an earlier bake, as the commit says.
    pub reused: u32,
}

/// Why a bake ends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Ending {
    pub published: bool,
    pub message: String,
}

/// The state of a running coordinator. Times are in ms of the coordinator's clock.
#[derive(Debug)]
pub(crate) struct State {
    pub plan: Plan,
    pub epoch: u64,
    scheduler: Scheduler,
    registered: BTreeMap<WorkerId, Registered>,
    phase: Phase,
    phase_since_ms: u64,
    started_ms: u64,
    solve_ms: u64,
    merge_ms: u64,
    worker_solve_ms: u64,
    tasks_resumed: u32,
    /// By kind of task.
    units_reused: [u64; TaskKind::KINDS],
    units_resumed: u64,
    /// When a worker was last at hand.
    workers_seen_ms: u64,
    manifest: u64,
    ending: Option<Ending>,
    /// The coordinator ends and the bake does not: workers are to look for the next one.
    is_closed: bool,
    /// The newest epoch in the store, when it is newer than ours.
    newer_epoch: Option<u64>,
    /// Somebody showed us a newer epoch; only the store is believed.
    is_epoch_in_doubt: bool,
    /// Certificates of those who registered with one.
    owners: BTreeMap<WorkerId, blake3::Hash>,
    attempted_again: BTreeSet<(Reverse<u32>, TaskId)>,
}

impl State {
    pub fn new(plan: Plan, epoch: u64, policy: SchedulePolicy, now_ms: u64) -> Self {
        let scheduler = Scheduler::new(&plan.tasks, policy);
        Self {
            plan,
            epoch,
            scheduler,
            registered: BTreeMap::new(),
            phase: Phase::Planning,
            phase_since_ms: now_ms,
            started_ms: now_ms,
            solve_ms: 0,
            merge_ms: 0,
            worker_solve_ms: 0,
            tasks_resumed: 0,
            units_reused: [0; TaskKind::KINDS],
            units_resumed: 0,
            workers_seen_ms: now_ms,
            manifest: 0,
            ending: None,
            is_closed: false,
            newer_epoch: None,
            is_epoch_in_doubt: false,
            owners: BTreeMap::new(),
            attempted_again: BTreeSet::new(),
        }
    }

    /// Takes over the tasks that were committed before this coordinator.
    pub fn resume(&mut self, committed: impl IntoIterator<Item = TaskId>) {
        for task in committed {
            if task.index() < self.plan.tasks.len()
                && self.scheduler.committed(task, None, self.started_ms)
            {
                self.tasks_resumed += 1;
            }
        }
        self.units_resumed = (0..TaskKind::KINDS).map(|kind| self.scheduler.units(kind).done).sum();
    }

    /// Moves on to a phase; the time spent in the one before is added up.
    pub fn enter(&mut self, phase: Phase, now_ms: u64) {
        let spent = now_ms.saturating_sub(self.phase_since_ms);
        match self.phase {
            Phase::Solving => self.solve_ms += spent,
            Phase::Merging => self.merge_ms += spent,
            Phase::Planning | Phase::Published | Phase::Failed => {}
        }
        (self.phase, self.phase_since_ms) = (phase, now_ms);
    }

    pub fn published(&mut self, manifest: u64, now_ms: u64) {
        self.manifest = manifest;
        self.enter(Phase::Published, now_ms);
        self.end(true, "the dataset is published".into());
    }

    pub fn failed_for_good(&mut self, message: String, now_ms: u64) {
        self.enter(Phase::Failed, now_ms);
        self.end(false, message);
    }

    fn end(&mut self, published: bool, message: String) {
        self.ending.get_or_insert(Ending { published, message });
    }

    pub const fn close(&mut self) {
        self.is_closed = true;
    }

    pub const fn is_closed(&self) -> bool {
        self.is_closed
    }

    pub fn ending(&self) -> Option<Ending> {
        self.ending.clone()
    }

    /// Somebody says that there is this epoch. Anybody can say so: the coordinator looks.
    pub const fn hear_of_epoch(&mut self, epoch: u64) {
        self.is_epoch_in_doubt |= epoch > self.epoch;
    }

    /// Whether somebody spoke of a newer epoch since the last time.
    pub const fn take_doubt(&mut self) -> bool {
        std::mem::replace(&mut self.is_epoch_in_doubt, false)
    }

    /// Notes an epoch that is in the store.
    pub fn see_epoch(&mut self, epoch: u64) {
        if epoch > self.epoch {
            self.newer_epoch = self.newer_epoch.max(Some(epoch));
        }
    }

    pub const fn newer_epoch(&self) -> Option<u64> {
        self.newer_epoch
    }

    /// Registers a worker; `None` when there are as many as there may be.
    pub fn join(&mut self, name: String, threads: u32, now_ms: u64) -> Option<WorkerId> {
        let id = self.scheduler.join(now_ms)?;
        self.registered.insert(id, Registered { name, threads, tasks_committed: 0 });
        Some(id)
    }

    pub fn knows(&self, worker: WorkerId) -> bool {
        self.scheduler.knows(worker)
    }

    /// Binds a worker to the certificate it registered with.
    pub fn own(&mut self, worker: WorkerId, owner: Option<blake3::Hash>) {
        self.owners.extend(owner.map(|owner| (worker, owner)));
    }

    /// True when a caller with this certificate may speak for the worker.
    pub fn is_owned_by(&self, worker: WorkerId, caller: Option<blake3::Hash>) -> bool {
        self.owners.get(&worker).is_none_or(|owner| caller == Some(*owner))
    }

    /// True when the worker holds the lease.
    pub fn holds(&self, worker: WorkerId, lease: LeaseId) -> bool {
        self.scheduler.lease_in_force(lease).is_some_and(|lease| lease.worker == worker)
    }

    pub fn name_of(&self, worker: WorkerId) -> &str {
        self.registered.get(&worker).map_or("?", |w| w.name.as_str())
    }

    pub fn leave(&mut self, worker: WorkerId) {
        self.scheduler.leave(worker);
        self.registered.remove(&worker);
        self.owners.remove(&worker);
    }

    pub fn worker_count(&self) -> usize {
        self.scheduler.worker_count()
    }

    pub fn lease(&mut self, worker: WorkerId, now_ms: u64) -> Option<Lease> {
        self.scheduler.heartbeat(worker, &[], now_ms);
        let solves = self.phase == Phase::Solving;
        let lease = solves.then(|| self.scheduler.lease(worker, now_ms)).flatten()?;
        if lease.attempt > 1 {
            self.attempted_again.remove(&(Reverse(lease.attempt - 1), lease.task));
            self.attempted_again.insert((Reverse(lease.attempt), lease.task));
        }
        Some(lease)
    }

    pub fn heartbeat(&mut self, worker: WorkerId, held: &[LeaseId], now_ms: u64) -> Vec<LeaseId> {
        self.scheduler.heartbeat(worker, held, now_ms)
    }

    /// A task's commit object exists; `by` tells who reported it. True when that is news.
    pub fn committed(&mut self, task: TaskId, by: Option<&Reported>, now_ms: u64) -> bool {
        let held = by.filter(|r| self.holds(r.worker, r.lease)).map(|r| r.lease);
        let is_news = self.scheduler.committed(task, held, now_ms);
        if let Some(reported) = by {
            self.worker_solve_ms += reported.solve_ms;
            if is_news {
                let kind = self.plan.task(task).kind.index();
                self.units_reused[kind] += u64::from(reported.reused);
            }
            if let Some(worker) = self.registered.get_mut(&reported.worker).filter(|_| is_news) {
                worker.tasks_committed += 1;
            }
        }
        is_news
    }

    /// Commit objects that are in the store.
    pub fn see_commits(&mut self, tasks: &[TaskId], now_ms: u64) {
        for task in tasks.iter().filter(|task| task.index() < self.plan.tasks.len()) {
            self.scheduler.committed(*task, None, now_ms);
        }
    }

    pub fn attempt_failed(
        &mut self,
        lease: LeaseId,
        class: FailureClass,
        reason: &str,
        now_ms: u64,
    ) {
        self.scheduler.failed(lease, class, reason, now_ms);
    }

    pub fn release(&mut self, lease: LeaseId) {
        self.scheduler.release(lease);
    }

    /// Ends what ran out. Forgets silent workers. Returns the leases that were lost.
    pub fn tick(&mut self, now_ms: u64) -> Vec<Lease> {
        let lost = self.scheduler.expire(now_ms);
        let scheduler = &self.scheduler;
        self.registered.retain(|worker, _| scheduler.knows(*worker));
        self.owners.retain(|worker, _| scheduler.knows(*worker));
        if self.worker_count() > 0 {
            self.workers_seen_ms = now_ms;
        }
        lost
    }

    /// For how long there has been no worker, ms.
    pub const fn lonely_ms(&self, now_ms: u64) -> u64 {
        now_ms.saturating_sub(self.workers_seen_ms)
    }

    /// True when a waiting worker may get a task that it could not get before the last tick.
    pub fn has_work(&self) -> bool {
        self.phase == Phase::Solving && self.scheduler.has_work()
    }

    /// Panics with the first invariant that does not hold.
    pub fn assert_well_formed(&self) {
        self.scheduler.assert_well_formed();
        let at_hand = self.scheduler.workers();
        assert!(at_hand.keys().all(|w| self.registered.contains_key(w)), "workers have names");
    }

    pub fn outcome(&self) -> Outcome {
        self.scheduler.outcome()
    }

    pub fn status(&self, now_ms: u64) -> BakeStatus {
        let in_phase = |phase| {
            if self.phase == phase { now_ms.saturating_sub(self.phase_since_ms) } else { 0 }
        };
        let solve_ms = self.solve_ms + in_phase(Phase::Solving);
        let [segments, cells, joins] = std::array::from_fn(|kind| self.scheduler.units(kind));
        let units = (cells.done + segments.done + joins.done).saturating_sub(self.units_resumed);
        BakeStatus {
            bake_id: self.plan.bake_id.clone(),
            epoch: self.epoch,
            phase: self.phase,
            tasks: self.scheduler.progress(),
            cells,
            segments,
            joins,
            tasks_resumed: self.tasks_resumed,
            segments_reused: self.units_reused[0],
            cells_reused: self.units_reused[1],
            workers: self.worker_statuses(),
            workers_at_hand: u32::try_from(self.registered.len()).unwrap_or(u32::MAX),
            leases: self.lease_statuses(now_ms),
            leases_in_force: u32::try_from(self.scheduler.leases().count()).unwrap_or(u32::MAX),
            attempts: self.task_attempts(),
            tasks_attempted_again: u32::try_from(self.attempted_again.len()).unwrap_or(u32::MAX),
            quarantined: self
                .scheduler
                .quarantined()
                .take(BakeStatus::LISTED_MAX)
                .map(|(task, reason)| QuarantinedTask { task, reason })
                .collect(),
            tasks_blocked: u32::try_from(self.scheduler.blocked().len()).unwrap_or(u32::MAX),
            elapsed_ms: now_ms.saturating_sub(self.started_ms),
            solve_ms,
            merge_ms: self.merge_ms + in_phase(Phase::Merging),
            worker_solve_ms: self.worker_solve_ms,
            units_per_second: if solve_ms == 0 {
                0.0
            } else {
                units as f64 * 1000.0 / solve_ms as f64
            },
            manifest: self.manifest,
            error: match &self.ending {
                Some(ending) if !ending.published => ending.message.clone(),
                _ => String::new(),
            },
        }
    }

    fn worker_statuses(&self) -> Vec<WorkerStatus> {
        let leases = self.scheduler.workers();
        self.registered
            .iter()
            .take(BakeStatus::LISTED_MAX)
            .map(|(id, worker)| WorkerStatus {
                id: id.0,
                name: worker.name.clone(),
                threads: worker.threads,
                leases: leases.get(id).copied().unwrap_or(0),
                tasks_committed: worker.tasks_committed,
            })
            .collect()
    }

    /// Leases in force, in the order they were given out.
    fn lease_statuses(&self, now_ms: u64) -> Vec<LeaseStatus> {
        self.scheduler
            .leases()
            .take(BakeStatus::LISTED_MAX)
            .map(|lease| LeaseStatus {
                task: lease.task,
                lease: lease.id.0,
                worker: lease.worker.0,
                worker_name: self.name_of(lease.worker).to_owned(),
                attempt: lease.attempt,
                age_ms: now_ms.saturating_sub(lease.since_ms),
                predicted_ms: self.scheduler.predicted_ms(lease.task).unwrap_or(0),
                is_overdue: self.scheduler.is_overdue(lease, now_ms),
            })
            .collect()
    }

    /// Tasks with more than one attempt, the most attempted first.
    fn task_attempts(&self) -> Vec<TaskAttempts> {
        let most = self.attempted_again.iter().take(BakeStatus::LISTED_MAX);
        most.map(|&(Reverse(attempts), task)| TaskAttempts { task, attempts }).collect()
    }
}
