//! Who works on what: a pure state machine over the tasks of a plan.
//!
//! The life of a task:
//!
//! ```text
//!             dependencies            lease               commit
//!   Waiting ----committed----> Ready --------> Leased ------------> Committed
//!                               ^ ^               |                     ^
//!                    pause over | |  lease lost,  |                     | a late attempt
//!                               | +- given back --+                     | still counts
//!                            Paused <-- failed ---+                     |
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
//! - SC-1: at most two attempts at a task run at a time, on different workers; the second is leased
//!   only when the first is overdue.
//! - SC-2: a leased task's dependencies are committed.
//! - SC-3: no task is lost: each is in exactly one state, and what is not committed is leased,
//!   can be leased, waits for such a task, or is reported as missing.
//! - SC-4: memory is bounded by the plan and [`SchedulePolicy::workers_max`], whatever happens: a
//!   task has two leases at most, and no more failures are kept than quarantine it.
//!
//! Failures: a task that failed on a worker is offered to others first, and to that worker again
//! only when every worker at hand has failed it. The third failure quarantines it, so on three
//! workers or more it takes three different ones. A worker on which tasks fail one after the other
//! pauses longer and longer, so that a broken machine does not take every task first.
//!
//! Stragglers: a task is overdue when its attempt runs longer than [`SchedulePolicy::straggler_percent`]
//! of what it should take (see `costs`). Who asks for a task when none is ready gets a second attempt at
//! the one that is overdue most. Both write the same bytes, one commit wins, and the other attempt is
//! told at its next heartbeat.

mod backoff;
mod costs;

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

pub use backoff::pause_ms;
use costs::Costs;

use crate::{Done, Task, TaskId, TaskKind};

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
    /// Every class.
    pub const ALL: [Self; 3] = [Self::RetryElsewhere, Self::RetryLater, Self::Never];

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
    /// First pause before a task that is to be retried later is offered again, and before a worker
    /// that keeps failing is given another task, ms; see [`pause_ms`].
    pub pause_ms: u64,
    /// Longest pause, ms.
    pub pause_ms_max: u64,
    /// Retries of the later kind before they count as failures: an outage is not waited out
    /// for ever.
    pub retries_later_max: u32,
    /// Lost leases that quarantine a task: it may be what kills its workers.
    pub losses_max: u32,
    /// Failures of different tasks, one after the other, behind which a worker pauses.
    pub worker_failures_max: u32,
    /// Share of its predicted time behind which a running task is overdue, percent.
    pub straggler_percent: u64,
    /// Time before which no task is overdue, ms: a second attempt costs about as much.
    pub straggler_ms_min: u64,
    /// Time behind which a task of unknown cost is overdue, ms.
    pub straggler_ms_unknown: u64,
    /// Workers that may be registered at a time.
    pub workers_max: u32,
}

impl Default for SchedulePolicy {
    fn default() -> Self {
        Self {
            lease_ms: 30_000,
            failures_max: 3,
            pause_ms: 1_000,
            pause_ms_max: 60_000,
            retries_later_max: 30,
            losses_max: 12,
            worker_failures_max: 3,
            straggler_percent: 150,
            straggler_ms_min: 200,
            straggler_ms_unknown: 120_000,
            workers_max: 10_000,
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
    Ready,
    /// It can be leased behind a pause.
    Paused {
        /// Not before this time, ms.
        not_before_ms: u64,
    },
    /// One attempt runs, or two.
    Leased,
    /// Its commit object exists.
    Committed,
    /// It is not tried any more.
    Quarantined,
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
    /// When it was given, ms.
    pub since_ms: u64,
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

/// A task of the plan: what nearly all tasks need and no more, since there can be millions.
#[derive(Clone, Debug)]
struct Record {
    state: TaskState,
    attempts: u32,
    units: u32,
    kind: u8,
}

/// What went wrong with a task, kept for those few with which something did.
#[derive(Clone, Debug, Default)]
struct Trouble {
    failures: Vec<Failure>,
    retries_later: u32,
    losses: u32,
    /// An attempt said that none can succeed.
    is_hopeless: bool,
}

/// A worker at hand.
#[derive(Clone, Copy, Debug)]
struct Hand {
    seen_ms: u64,
    /// Failed attempts since the last that ended well.
    failures: u32,
    /// No task before this time, ms.
    not_before_ms: u64,
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

/// For each task those that depend on it, in one piece of memory.
#[derive(Clone, Debug)]
struct Dependents {
    /// The dependents of task `t` are `tasks[from[t]..from[t + 1]]`.
    from: Vec<u32>,
    tasks: Vec<TaskId>,
}

impl Dependents {
    fn new(tasks: &[Task]) -> Self {
        let mut from = vec![0_u32; tasks.len() + 1];
        for task in tasks {
            for dependency in &task.depends_on {
                assert!(*dependency < task.id, "tasks depend on earlier ones");
                from[dependency.index() + 1] += 1;
            }
        }
        for k in 1..from.len() {
            from[k] += from[k - 1];
        }
        let mut next = from.clone();
        let mut out = vec![TaskId::default(); from[tasks.len()] as usize];
        for task in tasks {
            for dependency in &task.depends_on {
                let place = &mut next[dependency.index()];
                out[*place as usize] = task.id;
                *place += 1;
            }
        }
        Self { from, tasks: out }
    }

    fn of(&self, task: TaskId) -> &[TaskId] {
        &self.tasks[self.from[task.index()] as usize..self.from[task.index() + 1] as usize]
    }
}

/// The states of all tasks of a plan, and who works on them.
#[derive(Clone, Debug)]
pub struct Scheduler {
    policy: SchedulePolicy,
    records: Vec<Record>,
    dependents: Dependents,
    troubles: BTreeMap<TaskId, Trouble>,
    /// Tasks in state `Ready`.
    ready: BTreeSet<TaskId>,
    /// Tasks in state `Paused`, by the end of their pause.
    paused: BTreeSet<(u64, TaskId)>,
    /// Leases in force.
    leases: BTreeMap<LeaseId, Lease>,
    /// The leases in force of each task in state `Leased`: one or two.
    running: BTreeMap<TaskId, Vec<LeaseId>>,
    /// Tasks with one running attempt that is overdue, as of the last look.
    overdue: BTreeSet<TaskId>,
    workers: BTreeMap<WorkerId, Hand>,
    costs: Costs,
    progress: Progress,
    /// Units by kind.
    units: [Done; TaskKind::KINDS],
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
        let dependents = Dependents::new(tasks);
        let records: Vec<Record> = tasks.iter().map(new_record).collect();
        let ready: BTreeSet<TaskId> =
            tasks.iter().filter(|t| t.depends_on.is_empty()).map(|t| t.id).collect();
        let mut units = [Done::default(); TaskKind::KINDS];
        for record in &records {
            units[usize::from(record.kind)].total += u64::from(record.units);
        }
        let (count, free) = (number(records.len()), number(ready.len()));
        let progress =
            Progress { tasks: count, ready: free, waiting: count - free, ..Progress::default() };
        Self {
            policy,
            records,
            dependents,
            troubles: BTreeMap::new(),
            ready,
            paused: BTreeSet::new(),
            leases: BTreeMap::new(),
            running: BTreeMap::new(),
            overdue: BTreeSet::new(),
            workers: BTreeMap::new(),
            costs: Costs::new(),
            progress,
            units,
            next_lease: 1,
            next_worker: 1,
        }
    }

    /// Registers a worker; `None` when there are as many as there may be.
    pub fn join(&mut self, now_ms: u64) -> Option<WorkerId> {
        if self.workers.len() >= self.policy.workers_max as usize {
            return None;
        }
        let worker = WorkerId(self.next_worker);
        self.next_worker += 1;
        self.workers.insert(worker, Hand { seen_ms: now_ms, failures: 0, not_before_ms: 0 });
        Some(worker)
    }

    /// A worker says goodbye: its leases end. They do not count as lost.
    pub fn leave(&mut self, worker: WorkerId) -> Vec<Lease> {
        self.workers.remove(&worker);
        let ended = self.leases_where(|lease| lease.worker == worker);
        for lease in &ended {
            self.end_lease(lease, None);
        }
        ended
    }

    /// Gives a worker that is at hand the first ready task that it may attempt; when there is none, a
    /// second attempt at the task that is overdue most.
    pub fn lease(&mut self, worker: WorkerId, now_ms: u64) -> Option<Lease> {
        let hand = self.workers.get_mut(&worker)?;
        hand.seen_ms = now_ms;
        if hand.not_before_ms > now_ms {
            return None;
        }
        self.end_pauses(now_ms);
        let ready = self.ready.iter().copied().find(|task| self.may_try(worker, *task));
        let task = ready.or_else(|| self.second_attempt(worker, now_ms))?;
        self.set_state(task, TaskState::Leased);
        let record = &mut self.records[task.index()];
        record.attempts += 1;
        let lease = Lease {
            id: LeaseId(self.next_lease),
            task,
            worker,
            attempt: record.attempts,
            since_ms: now_ms,
            expires_ms: now_ms.saturating_add(self.policy.lease_ms),
        };
        self.next_lease += 1;
        self.leases.insert(lease.id, lease);
        self.running.entry(task).or_default().push(lease.id);
        self.overdue.remove(&task);
        Some(lease)
    }

    /// Extends a worker's leases and returns those that it holds no more. A worker that is not at hand
    /// holds none.
    pub fn heartbeat(&mut self, worker: WorkerId, held: &[LeaseId], now_ms: u64) -> Vec<LeaseId> {
        let Some(hand) = self.workers.get_mut(&worker) else { return held.to_vec() };
        hand.seen_ms = now_ms;
        let expires_ms = now_ms.saturating_add(self.policy.lease_ms);
        let mut lost = Vec::new();
        for id in held {
            match self.leases.get_mut(id) {
                Some(lease) if lease.worker == worker => lease.expires_ms = expires_ms,
                _ => lost.push(*id),
            }
        }
        lost
    }

    /// Ends leases that were not extended in time, forgets workers that are silent, and finds out which
    /// tasks are overdue. Returns the leases that were lost.
    pub fn expire(&mut self, now_ms: u64) -> Vec<Lease> {
        let lost = self.leases_where(|lease| lease.expires_ms <= now_ms);
        for lease in &lost {
            self.troubles.entry(lease.task).or_default().losses += 1;
            self.end_lease(lease, None);
        }
        let lease_ms = self.policy.lease_ms;
        let busy: BTreeSet<WorkerId> = self.leases.values().map(|l| l.worker).collect();
        self.workers.retain(|worker, hand| {
            busy.contains(worker) || hand.seen_ms.saturating_add(lease_ms) > now_ms
        });
        self.end_pauses(now_ms);
        let late = self.running.iter().filter(|(_, leases)| leases.len() == 1);
        self.overdue = late
            .filter(|(_, leases)| self.lateness_ms(&self.leases[&leases[0]], now_ms).is_some())
            .map(|(task, _)| *task)
            .collect();
        lost
    }

    /// A task's commit object exists; `by` is the lease of the attempt that says so. True when that is
    /// news.
    pub fn committed(&mut self, task: TaskId, by: Option<LeaseId>, now_ms: u64) -> bool {
        if self.records[task.index()].state == TaskState::Committed {
            return false;
        }
        for id in self.running.remove(&task).unwrap_or_default() {
            let lease = self.leases.remove(&id).expect("a running attempt has a lease");
            if by == Some(id) {
                self.ended_well(&lease, now_ms);
            }
        }
        self.leave_queues(task);
        self.troubles.remove(&task);
        self.set_state(task, TaskState::Committed);
        let record = &self.records[task.index()];
        self.units[usize::from(record.kind)].done += u64::from(record.units);
        for place in 0..self.dependents.of(task).len() {
            self.dependency_met(self.dependents.of(task)[place]);
        }
        true
    }

    /// An attempt failed. Ignored when its lease is not in force any more.
    pub fn failed(&mut self, lease: LeaseId, class: FailureClass, reason: &str, now_ms: u64) {
        let Some(lease) = self.leases.get(&lease).copied() else { return };
        let policy = self.policy;
        let trouble = self.troubles.entry(lease.task).or_default();
        if class == FailureClass::RetryLater && trouble.retries_later < policy.retries_later_max {
            let tries = trouble.retries_later;
            trouble.retries_later += 1;
            let pause = pause_ms(policy.pause_ms, policy.pause_ms_max, tries, lease.task.0.into());
            self.end_lease(&lease, Some(now_ms.saturating_add(pause)));
            return;
        }
        trouble.is_hopeless |= class == FailureClass::Never;
        trouble.failures.push(Failure { worker: lease.worker, reason: reason.to_owned() });
        self.end_lease(&lease, None);
        if class == FailureClass::RetryElsewhere
            && let Some(hand) = self.workers.get_mut(&lease.worker)
        {
            hand.failures += 1;
            if let Some(tries) = hand.failures.checked_sub(policy.worker_failures_max) {
                let of = lease.worker.0.into();
                let pause = pause_ms(policy.pause_ms, policy.pause_ms_max, tries, of);
                hand.not_before_ms = now_ms.saturating_add(pause);
            }
        }
    }

    /// A worker gives a lease back without an attempt worth counting.
    pub fn release(&mut self, lease: LeaseId) {
        if let Some(lease) = self.leases.get(&lease).copied() {
            self.end_lease(&lease, None);
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
        self.leases.get(&lease)
    }

    /// Leases in force, in the order in which they were given.
    pub fn leases(&self) -> impl Iterator<Item = &Lease> {
        self.leases.values()
    }

    /// How long a task should take, ms, when that can be told.
    #[must_use]
    pub fn predicted_ms(&self, task: TaskId) -> Option<u64> {
        let record = &self.records[task.index()];
        self.costs.predicted_ms(record.kind.into(), record.units)
    }

    /// True when the attempt runs so long that its task may get a second one.
    #[must_use]
    pub fn is_overdue(&self, lease: &Lease, now_ms: u64) -> bool {
        self.lateness_ms(lease, now_ms).is_some()
    }

    /// True when a worker that asks may get a task that it could not get before the last look: a pause
    /// is over, or a task is overdue.
    #[must_use]
    pub fn has_work(&self) -> bool {
        !self.ready.is_empty() || !self.overdue.is_empty()
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
        for lease in self.leases.values() {
            *out.entry(lease.worker).or_default() += 1;
        }
        out
    }

    /// Numbers of tasks by state.
    #[must_use]
    pub const fn progress(&self) -> Progress {
        self.progress
    }

    /// Units (segments or cells) of the tasks of a kind, and those of the committed ones.
    #[must_use]
    pub const fn units(&self, kind: usize) -> Done {
        self.units[kind]
    }

    /// How far the bake is.
    #[must_use]
    pub fn outcome(&self) -> Outcome {
        let Progress { tasks, committed, ready, leased, .. } = self.progress;
        if committed == tasks {
            Outcome::Complete
        } else if ready > 0 || leased > 0 {
            Outcome::Running
        } else {
            Outcome::Missing(self.missing())
        }
    }

    /// Tasks that will not be done as things are. Takes as long as there are tasks in trouble.
    #[must_use]
    pub fn missing(&self) -> Missing {
        Missing { quarantined: self.quarantined().collect(), blocked: self.blocked() }
    }

    /// Quarantined tasks, with their reasons.
    pub fn quarantined(&self) -> impl Iterator<Item = (TaskId, String)> {
        self.quarantined_tasks().map(|task| (task, self.reason_of(task)))
    }

    fn quarantined_tasks(&self) -> impl Iterator<Item = TaskId> {
        let is_out = |task: &TaskId| *self.state(*task) == TaskState::Quarantined;
        self.troubles.keys().copied().filter(is_out)
    }

    /// Tasks that depend on quarantined ones, directly or through others.
    #[must_use]
    pub fn blocked(&self) -> Vec<TaskId> {
        if self.progress.quarantined == 0 {
            return Vec::new();
        }
        let mut blocked = BTreeSet::new();
        let mut open: Vec<TaskId> = self.quarantined_tasks().collect();
        while let Some(task) = open.pop() {
            for dependent in self.dependents.of(task) {
                let waits = matches!(self.state(*dependent), TaskState::Waiting { .. });
                if waits && blocked.insert(*dependent) {
                    open.push(*dependent);
                }
            }
        }
        blocked.into_iter().collect()
    }

    /// Panics with the first invariant that does not hold.
    pub fn assert_well_formed(&self) {
        let unmet = self.count_unmet();
        let mut counted = Progress { tasks: number(self.records.len()), ..Progress::default() };
        for (id, record) in (0..).map(TaskId).zip(&self.records) {
            let leases = self.running.get(&id).map_or(&[][..], Vec::as_slice);
            let (unmet, is_ready) = (unmet[id.index()], self.ready.contains(&id));
            let is_paused = self.paused.iter().any(|(_, task)| *task == id);
            let is = (is_ready, is_paused, leases.len());
            match record.state {
                TaskState::Waiting { unmet: counted } => {
                    assert!(unmet > 0 && unmet == counted, "open dependencies are counted");
                    assert_eq!(is, (false, false, 0), "SC-3: one state a task");
                }
                TaskState::Ready => {
                    assert_eq!((unmet, is), (0, (true, false, 0)), "SC-3: one state a task");
                }
                TaskState::Paused { not_before_ms } => {
                    assert_eq!((unmet, is), (0, (false, true, 0)), "SC-3: one state a task");
                    assert!(self.paused.contains(&(not_before_ms, id)), "pauses are in order");
                }
                TaskState::Leased => {
                    assert!((1..=2).contains(&leases.len()), "SC-1: one or two attempts");
                    assert_eq!((unmet, is.0, is.1), (0, false, false), "SC-2, SC-3");
                    let workers: BTreeSet<_> =
                        leases.iter().map(|lease| self.leases[lease].worker).collect();
                    assert_eq!(workers.len(), leases.len(), "SC-1: on different workers");
                }
                TaskState::Committed | TaskState::Quarantined => {
                    assert_eq!(is, (false, false, 0), "SC-3: one state a task");
                }
            }
            *count_of(&mut counted, &record.state) += 1;
        }
        assert_eq!(counted, self.progress, "tasks are counted as they are");
        let running: usize = self.running.values().map(Vec::len).sum();
        assert_eq!(running, self.leases.len(), "SC-4: a lease belongs to a running attempt");
        assert!(self.leases.iter().all(|(id, l)| *id == l.id), "leases are found by number");
        assert!(self.leases.values().all(|l| self.running[&l.task].contains(&l.id)));
        let kept = |t: &Trouble| t.failures.len() <= self.policy.failures_max as usize + 1;
        assert!(self.troubles.values().all(kept), "SC-4: few failures a task are kept");
        if let Outcome::Missing(missing) = self.outcome() {
            let lost = missing.quarantined.len() + missing.blocked.len();
            let all = lost + self.progress.committed as usize;
            assert_eq!(all, self.records.len(), "SC-3: what is not committed is reported");
        }
    }

    /// Open dependencies by task, counted anew.
    fn count_unmet(&self) -> Vec<u32> {
        let mut unmet = vec![0; self.records.len()];
        for (id, record) in (0..).map(TaskId).zip(&self.records) {
            if record.state != TaskState::Committed {
                self.dependents.of(id).iter().for_each(|d| unmet[d.index()] += 1);
            }
        }
        unmet
    }

    /// True when a worker may attempt a task: it has not failed it, or everybody has.
    fn may_try(&self, worker: WorkerId, task: TaskId) -> bool {
        let Some(trouble) = self.troubles.get(&task) else { return true };
        let failed_on = |w: &WorkerId| trouble.failures.iter().any(|f| f.worker == *w);
        !failed_on(&worker) || self.workers.keys().all(failed_on)
    }

    /// The overdue task that a worker may attempt and that has waited longest behind its time.
    fn second_attempt(&self, worker: WorkerId, now_ms: u64) -> Option<TaskId> {
        let may = |task: &&TaskId| {
            let first = &self.leases[&self.running[*task][0]];
            first.worker != worker && self.may_try(worker, **task)
        };
        let late = |task: &TaskId| self.lateness_ms(&self.leases[&self.running[task][0]], now_ms);
        let late = self.overdue.iter().filter(may).filter_map(|task| Some((late(task)?, *task)));
        late.max_by_key(|(late_ms, task)| (*late_ms, std::cmp::Reverse(*task))).map(|(_, t)| t)
    }

    /// How far an attempt is behind the time at which it is overdue, ms; `None` before.
    fn lateness_ms(&self, lease: &Lease, now_ms: u64) -> Option<u64> {
        let policy = &self.policy;
        let limit_ms =
            self.predicted_ms(lease.task).map_or(policy.straggler_ms_unknown, |predicted_ms| {
                predicted_ms.saturating_mul(policy.straggler_percent) / 100
            });
        let ran_ms = now_ms.saturating_sub(lease.since_ms);
        ran_ms.checked_sub(limit_ms.max(policy.straggler_ms_min))
    }

    /// What the lease of an attempt that committed teaches.
    fn ended_well(&mut self, lease: &Lease, now_ms: u64) {
        let record = &self.records[lease.task.index()];
        let took_ms = now_ms.saturating_sub(lease.since_ms);
        self.costs.add(record.kind.into(), record.units, took_ms);
        if let Some(hand) = self.workers.get_mut(&lease.worker) {
            hand.failures = 0;
        }
    }

    fn leases_where(&self, holds: impl Fn(&Lease) -> bool) -> Vec<Lease> {
        self.leases.values().filter(|lease| holds(lease)).copied().collect()
    }

    /// Ends a lease. With the task's last one, Leased -> Ready, Paused or Quarantined.
    fn end_lease(&mut self, lease: &Lease, not_before_ms: Option<u64>) {
        self.leases.remove(&lease.id);
        let running = self.running.get_mut(&lease.task).expect("a leased task is running");
        running.retain(|id| *id != lease.id);
        if !running.is_empty() {
            // The other attempt decides.
            return;
        }
        self.running.remove(&lease.task);
        self.overdue.remove(&lease.task);
        let is_out = self.troubles.get(&lease.task).is_some_and(|trouble| {
            trouble.is_hopeless
                || trouble.failures.len() >= self.policy.failures_max as usize
                || trouble.losses >= self.policy.losses_max
        });
        match not_before_ms {
            _ if is_out => self.set_state(lease.task, TaskState::Quarantined),
            None => {
                self.ready.insert(lease.task);
                self.set_state(lease.task, TaskState::Ready);
            }
            Some(not_before_ms) => {
                self.paused.insert((not_before_ms, lease.task));
                self.set_state(lease.task, TaskState::Paused { not_before_ms });
            }
        }
    }

    /// Paused -> Ready, for those whose pause is over.
    fn end_pauses(&mut self, now_ms: u64) {
        while let Some(&(until_ms, task)) = self.paused.first()
            && until_ms <= now_ms
        {
            self.paused.pop_first();
            self.ready.insert(task);
            self.set_state(task, TaskState::Ready);
        }
    }

    /// Waiting -> Ready, with the last dependency.
    fn dependency_met(&mut self, task: TaskId) {
        let TaskState::Waiting { unmet } = *self.state(task) else { return };
        if unmet > 1 {
            self.records[task.index()].state = TaskState::Waiting { unmet: unmet - 1 };
            return;
        }
        self.ready.insert(task);
        self.set_state(task, TaskState::Ready);
    }

    fn leave_queues(&mut self, task: TaskId) {
        self.overdue.remove(&task);
        self.ready.remove(&task);
        if let TaskState::Paused { not_before_ms } = *self.state(task) {
            self.paused.remove(&(not_before_ms, task));
        }
    }

    fn set_state(&mut self, task: TaskId, state: TaskState) {
        if state == TaskState::Leased {
            self.ready.remove(&task);
        }
        let before = std::mem::replace(&mut self.records[task.index()].state, state.clone());
        *count_of(&mut self.progress, &before) -= 1;
        *count_of(&mut self.progress, &state) += 1;
    }

    fn reason_of(&self, task: TaskId) -> String {
        let Some(trouble) = self.troubles.get(&task) else { return String::new() };
        let told = trouble.failures.iter().map(|f| format!("worker {}: {}", f.worker, f.reason));
        let lost = (trouble.losses >= self.policy.losses_max)
            .then(|| format!("{} workers went silent while they worked on it", trouble.losses));
        told.chain(lost).collect::<Vec<_>>().join("; ")
    }
}

/// Where tasks in a state are counted.
const fn count_of<'a>(progress: &'a mut Progress, state: &TaskState) -> &'a mut u32 {
    match state {
        TaskState::Waiting { .. } => &mut progress.waiting,
        TaskState::Ready | TaskState::Paused { .. } => &mut progress.ready,
        TaskState::Leased => &mut progress.leased,
        TaskState::Committed => &mut progress.committed,
        TaskState::Quarantined => &mut progress.quarantined,
    }
}

fn new_record(task: &Task) -> Record {
    let state = match number(task.depends_on.len()) {
        0 => TaskState::Ready,
        unmet => TaskState::Waiting { unmet },
    };
    let kind = u8::try_from(task.kind.index()).expect("a handful of kinds");
    Record { state, attempts: 0, units: task.kind.units(), kind }
}

fn number(count: usize) -> u32 {
    u32::try_from(count).expect("under 2^32 tasks")
}

#[cfg(test)]
mod tests;
