//! Who works on what: a pure state machine over the tasks of a plan.
//!
//! The life of a task:
//!
//! ```text
//!             dependencies            lease               commit
//!   Waiting ----committed----> Ready --------> Leased ------------> Committed
//!                                ^                |                     ^
//!                                |  lease lost,   |                     | a late attempt
//!                                +- given back, --+                     | still counts
//!                                |  failed        |                     |
//!                                                 +---- third failure, -+-- Quarantined
//!                                                       or never retry
//! ```
//!
//! Time is an argument, in milliseconds of a clock that does not run backwards. Nothing here
//! decides whether a task is done: only its commit object does (JB-1). A commit that appears is
//! believed in every state.
//!
//! Invariants:
//! - JB-1: one commit a task: [`Scheduler::committed`] counts a task once.
//! - SC-1: a task is leased to one attempt at most at a time.
//! - SC-2: a leased task's dependencies are committed.
//! - SC-3: no task is lost: each is in exactly one state, and what is not committed is leased,
//!   can be leased, waits for such a task, or is reported as missing.
//!
//! Failures: a task that failed on a worker is offered to others first, and to that worker again
//! only when every worker at hand has failed it. The third failure quarantines it, so on three
//! workers or more it takes three different ones.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::{Task, TaskId};

/// Number under which a worker is registered with one coordinator.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WorkerId(pub u32);

impl std::fmt::Display for WorkerId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

/// Number of a lease, given out once by one coordinator.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LeaseId(pub u64);

impl std::fmt::Display for LeaseId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

/// What a failure asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailureClass {
    /// Something about this worker or this attempt: another worker may succeed.
    RetryElsewhere,
    /// Something that passes, such as a store that does not answer: the same worker may succeed.
    RetryLater,
    /// The task cannot succeed anywhere.
    Never,
}

impl FailureClass {
    /// The name, for metrics.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::RetryElsewhere => "retry_elsewhere",
            Self::RetryLater => "retry_later",
            Self::Never => "never",
        }
    }
}

/// Limits of leases and retries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SchedulePolicy {
    /// How long a lease lives without a heartbeat, ms. A worker that is silent for as long is gone.
    pub lease_ms: u64,
    /// Failures that quarantine a task.
    pub failures_max: u32,
    /// Pause before a task that is to be retried later is offered again, ms.
    pub retry_later_ms: u64,
    /// Retries of the later kind before they count as failures: an outage is not waited out
    /// for ever.
    pub retries_later_max: u32,
    /// Lost leases that quarantine a task: it may be what kills its workers.
    pub losses_max: u32,
}

impl Default for SchedulePolicy {
    fn default() -> Self {
        Self {
            lease_ms: 30_000,
            failures_max: 3,
            retry_later_ms: 2_000,
            retries_later_max: 30,
            losses_max: 12,
        }
    }
}

/// Where a task is in its life.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TaskState {
    /// Some of its dependencies are not committed.
    Waiting {
        /// How many.
        unmet: u32,
    },
    /// It can be leased.
    Ready {
        /// Not before this time, ms.
        not_before_ms: u64,
    },
    /// An attempt runs.
    Leased(Lease),
    /// Its commit object exists.
    Committed,
    /// It is not tried any more.
    Quarantined {
        /// Why, for people.
        reason: String,
    },
}

/// The right to attempt a task for a while.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lease {
    /// Number of the lease.
    pub id: LeaseId,
    /// The task.
    pub task: TaskId,
    /// Who holds it.
    pub worker: WorkerId,
    /// Number of this attempt at the task, from 1.
    pub attempt: u32,
    /// When it ends unless a heartbeat extends it, ms.
    pub expires_ms: u64,
}

/// One failed attempt.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// Who failed.
    pub worker: WorkerId,
    /// What happened, for people.
    pub reason: String,
}

/// A task and what happened to it.
#[derive(Clone, Debug)]
struct Record {
    state: TaskState,
    units: u32,
    depends_on: Vec<TaskId>,
    dependents: Vec<TaskId>,
    attempts: u32,
    failures: Vec<Failure>,
    retries_later: u32,
    losses: u32,
}

/// Numbers of tasks by state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Progress {
    /// Tasks of the plan.
    pub tasks: u32,
    /// With a commit object.
    pub committed: u32,
    /// With a running attempt.
    pub leased: u32,
    /// Free to lease, now or after a pause.
    pub ready: u32,
    /// With open dependencies.
    pub waiting: u32,
    /// Not tried any more.
    pub quarantined: u32,
}

/// How far a bake is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// There are tasks to do or running.
    Running,
    /// Every task is committed.
    Complete,
    /// Nothing can be done any more, and tasks are missing.
    Missing(Missing),
}

/// Tasks that will not be done.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Missing {
    /// Quarantined tasks, with their reasons.
    pub quarantined: Vec<(TaskId, String)>,
    /// Tasks that depend on those, directly or through others.
    pub blocked: Vec<TaskId>,
}

/// The states of all tasks of a plan, and who works on them.
#[derive(Clone, Debug)]
pub struct Scheduler {
    policy: SchedulePolicy,
    records: Vec<Record>,
    /// Tasks in state `Ready`.
    ready: BTreeSet<TaskId>,
    /// Leases in force.
    leases: BTreeMap<LeaseId, TaskId>,
    /// Workers at hand, and when they were last heard of, ms.
    workers: BTreeMap<WorkerId, u64>,
    committed: u32,
    next_lease: u64,
    next_worker: u32,
}

impl Scheduler {
    /// A scheduler of the tasks of a plan, none of them committed.
    ///
    /// # Panics
    /// When tasks are not numbered from 0 or depend on later ones.
    #[must_use]
    pub fn new(tasks: &[Task], policy: SchedulePolicy) -> Self {
        let mut records: Vec<Record> = tasks.iter().map(new_record).collect();
        for task in tasks {
            for dependency in &task.depends_on {
                assert!(*dependency < task.id, "tasks depend on earlier ones");
                records[dependency.index()].dependents.push(task.id);
            }
        }
        let ready = tasks.iter().filter(|t| t.depends_on.is_empty()).map(|t| t.id).collect();
        Self {
            policy,
            records,
            ready,
            leases: BTreeMap::new(),
            workers: BTreeMap::new(),
            committed: 0,
            next_lease: 1,
            next_worker: 1,
        }
    }

    /// Registers a worker.
    pub fn join(&mut self, now_ms: u64) -> WorkerId {
        let worker = WorkerId(self.next_worker);
        self.next_worker += 1;
        self.workers.insert(worker, now_ms);
        worker
    }

    /// A worker says goodbye: its leases end. They do not count as lost.
    pub fn leave(&mut self, worker: WorkerId) -> Vec<Lease> {
        self.workers.remove(&worker);
        let ended = self.leases_where(|lease| lease.worker == worker);
        for lease in &ended {
            self.end_lease(lease, 0);
        }
        ended
    }

    /// Gives a worker the first task that it may attempt.
    pub fn lease(&mut self, worker: WorkerId, now_ms: u64) -> Option<Lease> {
        self.workers.insert(worker, now_ms);
        let task = self.ready.iter().copied().find(|task| self.may_try(worker, *task, now_ms))?;
        self.ready.remove(&task);
        let record = &mut self.records[task.index()];
        record.attempts += 1;
        let lease = Lease {
            id: LeaseId(self.next_lease),
            task,
            worker,
            attempt: record.attempts,
            expires_ms: now_ms.saturating_add(self.policy.lease_ms),
        };
        self.next_lease += 1;
        record.state = TaskState::Leased(lease);
        self.leases.insert(lease.id, task);
        Some(lease)
    }

    /// Extends a worker's leases and returns those that it holds no more.
    pub fn heartbeat(&mut self, worker: WorkerId, held: &[LeaseId], now_ms: u64) -> Vec<LeaseId> {
        self.workers.insert(worker, now_ms);
        let expires_ms = now_ms.saturating_add(self.policy.lease_ms);
        let mut lost = Vec::new();
        for id in held {
            match self.lease_mut(*id) {
                Some(lease) if lease.worker == worker => lease.expires_ms = expires_ms,
                _ => lost.push(*id),
            }
        }
        lost
    }

    /// Ends leases that were not extended in time and forgets workers that are silent.
    pub fn expire(&mut self, now_ms: u64) -> Vec<Lease> {
        let lost = self.leases_where(|lease| lease.expires_ms <= now_ms);
        for lease in &lost {
            self.end_lease(lease, 0);
            let losses_max = self.policy.losses_max;
            let record = &mut self.records[lease.task.index()];
            record.losses += 1;
            if record.losses >= losses_max {
                let reason = format!("{losses_max} workers went silent while they worked on it");
                self.quarantine(lease.task, reason);
            }
        }
        let lease_ms = self.policy.lease_ms;
        let busy: BTreeSet<WorkerId> =
            self.leases_where(|_| true).iter().map(|l| l.worker).collect();
        self.workers.retain(|worker, seen_ms| {
            busy.contains(worker) || seen_ms.saturating_add(lease_ms) > now_ms
        });
        lost
    }

    /// A task's commit object exists. True when that is news.
    pub fn committed(&mut self, task: TaskId) -> bool {
        let record = &mut self.records[task.index()];
        let before = std::mem::replace(&mut record.state, TaskState::Committed);
        if before == TaskState::Committed {
            return false;
        }
        if let TaskState::Leased(lease) = before {
            self.leases.remove(&lease.id);
        }
        self.ready.remove(&task);
        self.committed += 1;
        for dependent in self.records[task.index()].dependents.clone() {
            self.dependency_met(dependent);
        }
        true
    }

    /// An attempt failed. Ignored when its lease is not in force any more.
    pub fn failed(&mut self, lease: LeaseId, class: FailureClass, reason: &str, now_ms: u64) {
        let Some(lease) = self.lease_mut(lease).copied() else { return };
        let record = &mut self.records[lease.task.index()];
        let later = class == FailureClass::RetryLater
            && record.retries_later < self.policy.retries_later_max;
        if later {
            record.retries_later += 1;
            self.end_lease(&lease, now_ms.saturating_add(self.policy.retry_later_ms));
            return;
        }
        record.failures.push(Failure { worker: lease.worker, reason: reason.to_owned() });
        let failures = u32::try_from(record.failures.len()).unwrap_or(u32::MAX);
        self.end_lease(&lease, 0);
        if class == FailureClass::Never || failures >= self.policy.failures_max {
            let reason = self.reason_of(lease.task);
            self.quarantine(lease.task, reason);
        }
    }

    /// A worker gives a lease back without an attempt worth counting.
    pub fn release(&mut self, lease: LeaseId) {
        if let Some(lease) = self.lease_mut(lease).copied() {
            self.end_lease(&lease, 0);
        }
    }

    /// The state of a task.
    #[must_use]
    pub fn state(&self, task: TaskId) -> &TaskState {
        &self.records[task.index()].state
    }

    /// The lease with this number, when it is in force.
    #[must_use]
    pub fn lease_in_force(&self, lease: LeaseId) -> Option<&Lease> {
        let task = self.leases.get(&lease)?;
        match &self.records[task.index()].state {
            TaskState::Leased(lease) => Some(lease),
            _ => None,
        }
    }

    /// True when the worker is at hand.
    #[must_use]
    pub fn knows(&self, worker: WorkerId) -> bool {
        self.workers.contains_key(&worker)
    }

    /// Number of workers at hand.
    #[must_use]
    pub fn worker_count(&self) -> usize {
        self.workers.len()
    }

    /// Workers at hand, and how many leases each holds.
    #[must_use]
    pub fn workers(&self) -> BTreeMap<WorkerId, u32> {
        let mut out: BTreeMap<WorkerId, u32> = self.workers.keys().map(|w| (*w, 0)).collect();
        for lease in self.leases_where(|_| true) {
            *out.entry(lease.worker).or_default() += 1;
        }
        out
    }

    /// Numbers of tasks by state.
    #[must_use]
    pub fn progress(&self) -> Progress {
        let mut progress = Progress {
            tasks: u32::try_from(self.records.len()).unwrap_or(u32::MAX),
            ..Progress::default()
        };
        for record in &self.records {
            *match record.state {
                TaskState::Waiting { .. } => &mut progress.waiting,
                TaskState::Ready { .. } => &mut progress.ready,
                TaskState::Leased(_) => &mut progress.leased,
                TaskState::Committed => &mut progress.committed,
                TaskState::Quarantined { .. } => &mut progress.quarantined,
            } += 1;
        }
        progress
    }

    /// Sum of the units (segments or cells) of the committed tasks that `counts` accepts.
    #[must_use]
    pub fn units_committed(&self, counts: impl Fn(TaskId) -> bool) -> u64 {
        (0u32..)
            .zip(&self.records)
            .filter(|(id, r)| r.state == TaskState::Committed && counts(TaskId(*id)))
            .map(|(_, r)| u64::from(r.units))
            .sum()
    }

    /// How far the bake is.
    #[must_use]
    pub fn outcome(&self) -> Outcome {
        if self.committed as usize == self.records.len() {
            return Outcome::Complete;
        }
        if !self.ready.is_empty() || !self.leases.is_empty() {
            return Outcome::Running;
        }
        Outcome::Missing(self.missing())
    }

    /// Tasks that will not be done as things are.
    #[must_use]
    pub fn missing(&self) -> Missing {
        let mut missing = Missing::default();
        let mut gone = BTreeSet::new();
        for (id, record) in (0..).map(TaskId).zip(&self.records) {
            match &record.state {
                TaskState::Quarantined { reason } => {
                    missing.quarantined.push((id, reason.clone()));
                    gone.insert(id);
                }
                // Dependencies come first, so one pass finds them all.
                TaskState::Waiting { .. } if record.depends_on.iter().any(|d| gone.contains(d)) => {
                    missing.blocked.push(id);
                    gone.insert(id);
                }
                _ => {}
            }
        }
        missing
    }

    /// Panics with the first invariant that does not hold.
    pub fn assert_well_formed(&self) {
        let committed = self.records.iter().filter(|r| r.state == TaskState::Committed).count();
        assert_eq!(committed, self.committed as usize, "JB-1: each commit counts once");
        for (id, record) in (0..).map(TaskId).zip(&self.records) {
            let unmet = self.unmet(record);
            let leased_as = self.leases.iter().filter(|(_, task)| **task == id);
            let leases = leased_as.map(|(lease, _)| *lease).collect::<Vec<_>>();
            let is_ready = self.ready.contains(&id);
            match &record.state {
                TaskState::Waiting { unmet: counted } => {
                    assert!(unmet > 0 && unmet == *counted, "open dependencies are counted");
                    assert!(!is_ready && leases.is_empty(), "SC-3: one state a task");
                }
                TaskState::Ready { .. } => {
                    assert!(unmet == 0 && is_ready && leases.is_empty(), "SC-3: one state a task");
                }
                TaskState::Leased(lease) => {
                    assert_eq!(leases, [lease.id], "SC-1: one lease a task");
                    assert!(unmet == 0 && !is_ready, "SC-2: dependencies are committed");
                    assert_eq!(lease.task, id, "a lease knows its task");
                }
                TaskState::Committed | TaskState::Quarantined { .. } => {
                    assert!(!is_ready && leases.is_empty(), "SC-3: one state a task");
                }
            }
        }
        if let Outcome::Missing(missing) = self.outcome() {
            let lost = missing.quarantined.len() + missing.blocked.len() + committed;
            assert_eq!(lost, self.records.len(), "SC-3: what is not committed is reported");
        }
    }

    /// True when a worker may attempt a ready task now.
    fn may_try(&self, worker: WorkerId, task: TaskId, now_ms: u64) -> bool {
        let record = &self.records[task.index()];
        let is_due =
            matches!(record.state, TaskState::Ready { not_before_ms } if not_before_ms <= now_ms);
        let failed_on = |w: &WorkerId| record.failures.iter().any(|f| f.worker == *w);
        is_due && (!failed_on(&worker) || self.workers.keys().all(failed_on))
    }

    fn lease_mut(&mut self, lease: LeaseId) -> Option<&mut Lease> {
        let task = self.leases.get(&lease)?;
        match &mut self.records[task.index()].state {
            TaskState::Leased(lease) => Some(lease),
            _ => None,
        }
    }

    fn leases_where(&self, holds: impl Fn(&Lease) -> bool) -> Vec<Lease> {
        self.leases
            .keys()
            .filter_map(|id| self.lease_in_force(*id))
            .filter(|lease| holds(lease))
            .copied()
            .collect()
    }

    /// Leased -> Ready.
    fn end_lease(&mut self, lease: &Lease, not_before_ms: u64) {
        self.leases.remove(&lease.id);
        self.records[lease.task.index()].state = TaskState::Ready { not_before_ms };
        self.ready.insert(lease.task);
    }

    /// Ready -> Quarantined.
    fn quarantine(&mut self, task: TaskId, reason: String) {
        self.ready.remove(&task);
        self.records[task.index()].state = TaskState::Quarantined { reason };
    }

    /// Waiting -> Ready, with the last dependency.
    fn dependency_met(&mut self, task: TaskId) {
        let record = &mut self.records[task.index()];
        let TaskState::Waiting { unmet } = &mut record.state else { return };
        *unmet -= 1;
        if *unmet == 0 {
            record.state = TaskState::Ready { not_before_ms: 0 };
            self.ready.insert(task);
        }
    }

    fn unmet(&self, record: &Record) -> u32 {
        let open = |d: &&TaskId| self.records[d.index()].state != TaskState::Committed;
        u32::try_from(record.depends_on.iter().filter(open).count()).unwrap_or(u32::MAX)
    }

    fn reason_of(&self, task: TaskId) -> String {
        let failures = &self.records[task.index()].failures;
        let told: Vec<String> =
            failures.iter().map(|f| format!("worker {}: {}", f.worker, f.reason)).collect();
        told.join("; ")
    }
}

fn new_record(task: &Task) -> Record {
    let unmet = u32::try_from(task.depends_on.len()).expect("under 2^32 dependencies");
    let state = match unmet {
        0 => TaskState::Ready { not_before_ms: 0 },
        unmet => TaskState::Waiting { unmet },
    };
    Record {
        state,
        units: task.kind.units(),
        depends_on: task.depends_on.clone(),
        dependents: Vec::new(),
        attempts: 0,
        failures: Vec::new(),
        retries_later: 0,
        losses: 0,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sightline_geometry::{CellId, SegmentId};

    use super::*;
    use crate::{StateRange, TaskKind};

    const STATES: StateRange = StateRange { first: 0, end: 1 };

    const POLICY: SchedulePolicy = SchedulePolicy {
        lease_ms: 100,
        failures_max: 3,
        retry_later_ms: 50,
        retries_later_max: 2,
        losses_max: 4,
    };

    /// `leaves` segments tasks, then cells tasks that depend on two of them each.
    fn tasks(leaves: u32, cells: u32) -> Vec<Task> {
        let segments = (0..leaves).map(|k| Task {
            id: TaskId(k),
            kind: TaskKind::Segments { first: SegmentId(k), end: SegmentId(k + 1), states: STATES },
            depends_on: vec![],
        });
        let cells = (0..cells).map(|k| {
            let on: BTreeSet<TaskId> = [TaskId(k % leaves), TaskId((k + 1) % leaves)].into();
            Task {
                id: TaskId(leaves + k),
                kind: TaskKind::Cells { first: CellId(k), end: CellId(k + 1), states: STATES },
                depends_on: on.into_iter().collect(),
            }
        });
        segments.chain(cells).collect()
    }

    fn failed(s: &mut Scheduler, worker: WorkerId, class: FailureClass, now_ms: u64) -> TaskId {
        let lease = s.lease(worker, now_ms).expect("there is a task to lease");
        s.failed(lease.id, class, "it broke", now_ms);
        s.assert_well_formed();
        lease.task
    }

    #[test]
    fn a_task_waits_for_its_dependencies() {
        let mut s = Scheduler::new(&tasks(2, 1), POLICY);
        let worker = s.join(0);
        let (a, b) = (s.lease(worker, 0).unwrap(), s.lease(worker, 0).unwrap());
        assert!(s.lease(worker, 0).is_none());
        assert!(s.committed(a.task) && !s.committed(a.task));
        assert!(s.lease(worker, 0).is_none());
        s.committed(b.task);
        assert_eq!(s.lease(worker, 0).unwrap().task, TaskId(2));
        assert_eq!(s.outcome(), Outcome::Running);
        s.committed(TaskId(2));
        assert_eq!(s.outcome(), Outcome::Complete);
        assert_eq!(s.units_committed(|_| true), 3);
    }

    #[test]
    fn a_lost_lease_goes_to_another_worker() {
        let mut s = Scheduler::new(&tasks(1, 0), POLICY);
        let (a, b) = (s.join(0), s.join(0));
        let first = s.lease(a, 0).unwrap();
        assert!(s.lease(b, 50).is_none());
        assert!(s.heartbeat(a, &[first.id], 90).is_empty());
        assert!(s.expire(150).is_empty());
        assert_eq!(s.expire(190).len(), 1);
        let second = s.lease(b, 191).unwrap();
        assert_eq!((second.task, second.attempt), (first.task, 2));
        assert_eq!(s.heartbeat(a, &[first.id], 192), [first.id]);
        s.failed(first.id, FailureClass::Never, "too late to count", 192);
        assert!(s.lease_in_force(second.id).is_some());
        assert!(s.committed(first.task), "a late attempt may still win the commit");
        s.assert_well_formed();
    }

    #[test]
    fn silent_workers_are_forgotten() {
        let mut s = Scheduler::new(&tasks(1, 0), POLICY);
        let worker = s.join(0);
        s.expire(99);
        assert!(s.knows(worker));
        s.expire(100);
        assert!(!s.knows(worker));
    }

    #[test]
    fn three_different_workers_quarantine_a_task_and_block_what_depends_on_it() {
        let mut s = Scheduler::new(&tasks(1, 1), POLICY);
        let workers = [s.join(0), s.join(0), s.join(0), s.join(0)];
        failed(&mut s, workers[0], FailureClass::RetryElsewhere, 1);
        assert!(s.lease(workers[0], 2).is_none(), "others have not tried");
        failed(&mut s, workers[1], FailureClass::RetryElsewhere, 3);
        assert_eq!(s.outcome(), Outcome::Running);
        failed(&mut s, workers[2], FailureClass::RetryElsewhere, 4);
        let Outcome::Missing(missing) = s.outcome() else { panic!("nothing is left to do") };
        assert_eq!(missing.blocked, [TaskId(1)]);
        assert_eq!(missing.quarantined[0].0, TaskId(0));
        assert!(missing.quarantined[0].1.contains("worker 3: it broke"));
        assert!(s.committed(TaskId(0)), "a commit is believed in every state");
        assert_eq!(s.lease(workers[0], 5).unwrap().task, TaskId(1));
    }

    #[test]
    fn a_lonely_worker_may_try_again() {
        let mut s = Scheduler::new(&tasks(1, 0), POLICY);
        let worker = s.join(0);
        for _ in 0..3 {
            failed(&mut s, worker, FailureClass::RetryElsewhere, 1);
        }
        assert!(matches!(s.outcome(), Outcome::Missing(_)));
    }

    #[test]
    fn never_quarantines_at_once_and_later_waits() {
        let mut s = Scheduler::new(&tasks(2, 0), POLICY);
        let worker = s.join(0);
        assert_eq!(failed(&mut s, worker, FailureClass::Never, 0), TaskId(0));
        assert!(matches!(s.state(TaskId(0)), TaskState::Quarantined { .. }));
        failed(&mut s, worker, FailureClass::RetryLater, 0);
        assert!(s.lease(worker, 49).is_none());
        failed(&mut s, worker, FailureClass::RetryLater, 50);
        failed(&mut s, worker, FailureClass::RetryLater, 100);
        assert_eq!(s.missing().quarantined.len(), 1, "the third later is a first failure");
        assert!(s.lease(worker, 100).is_some());
    }

    #[test]
    fn a_task_that_silences_its_workers_is_quarantined() {
        let mut s = Scheduler::new(&tasks(1, 0), POLICY);
        for round in 0..4u64 {
            let worker = s.join(round * 1000);
            s.lease(worker, round * 1000).unwrap();
            s.expire(round * 1000 + 500);
            s.assert_well_formed();
        }
        assert!(matches!(s.outcome(), Outcome::Missing(_)));
    }

    #[test]
    fn goodbye_gives_leases_back_at_once() {
        let mut s = Scheduler::new(&tasks(1, 0), POLICY);
        let (a, b) = (s.join(0), s.join(0));
        s.lease(a, 0).unwrap();
        assert_eq!(s.leave(a).len(), 1);
        assert!(s.lease(b, 0).is_some());
    }

    #[derive(Clone, Debug)]
    enum Event {
        Join,
        Leave(usize),
        Lease(usize),
        Heartbeat(usize),
        Wait(u64),
        Commit(usize),
        Fail(usize, FailureClass),
        Release(usize),
    }

    fn event() -> impl Strategy<Value = Event> {
        let class = prop_oneof![
            4 => Just(FailureClass::RetryElsewhere),
            4 => Just(FailureClass::RetryLater),
            1 => Just(FailureClass::Never),
        ];
        prop_oneof![
            1 => Just(Event::Join),
            1 => any::<usize>().prop_map(Event::Leave),
            8 => any::<usize>().prop_map(Event::Lease),
            3 => any::<usize>().prop_map(Event::Heartbeat),
            2 => (0..80u64).prop_map(Event::Wait),
            5 => any::<usize>().prop_map(Event::Commit),
            2 => (any::<usize>(), class).prop_map(|(k, c)| Event::Fail(k, c)),
            1 => any::<usize>().prop_map(Event::Release),
        ]
    }

    fn pick<T: Copy>(from: &[T], index: usize) -> Option<T> {
        (!from.is_empty()).then(|| from[index % from.len()])
    }

    fn apply(s: &mut Scheduler, event: Event, now_ms: &mut u64) {
        let workers: Vec<WorkerId> = s.workers().into_keys().collect();
        let leases = s.leases_where(|_| true);
        match event {
            Event::Join => {
                s.join(*now_ms);
            }
            Event::Leave(k) => {
                pick(&workers, k).map(|w| s.leave(w));
            }
            Event::Lease(k) => {
                let Some(worker) = pick(&workers, k) else { return };
                if let Some(lease) = s.lease(worker, *now_ms) {
                    assert!(leases.iter().all(|l| l.task != lease.task), "leased twice");
                    assert!(leases.iter().all(|l| l.id != lease.id), "a number given twice");
                }
            }
            Event::Heartbeat(k) => {
                let Some(worker) = pick(&workers, k) else { return };
                let held: Vec<LeaseId> =
                    leases.iter().filter(|l| l.worker == worker).map(|l| l.id).collect();
                assert!(s.heartbeat(worker, &held, *now_ms).is_empty());
            }
            Event::Wait(ms) => {
                *now_ms += ms;
                s.expire(*now_ms);
            }
            Event::Commit(k) => {
                pick(&leases, k).map(|l| s.committed(l.task));
            }
            Event::Fail(k, class) => {
                if let Some(lease) = pick(&leases, k) {
                    s.failed(lease.id, class, "it broke", *now_ms);
                }
            }
            Event::Release(k) => {
                if let Some(lease) = pick(&leases, k) {
                    s.release(lease.id);
                }
            }
        }
    }

    proptest! {
        #[test]
        fn nothing_is_lost_or_leased_twice_and_a_bake_ends(
            leaves in 1..6u32, cells in 0..6u32,
            events in prop::collection::vec(event(), 0..120),
        ) {
            let mut s = Scheduler::new(&tasks(leaves, cells), POLICY);
            let mut now_ms = 0;
            for event in events {
                apply(&mut s, event, &mut now_ms);
                s.assert_well_formed();
            }
            // From any state, one willing worker ends the bake.
            let worker = s.join(now_ms);
            while s.outcome() == Outcome::Running {
                now_ms += POLICY.retry_later_ms;
                s.expire(now_ms);
                if let Some(lease) = s.lease(worker, now_ms) {
                    s.committed(lease.task);
                }
                s.assert_well_formed();
                prop_assert!(now_ms < 1_000_000);
            }
            let blocked = s.missing();
            let done = s.progress().committed as usize;
            prop_assert_eq!(
                done + blocked.quarantined.len() + blocked.blocked.len(),
                (leaves + cells) as usize
            );
        }
    }
}
