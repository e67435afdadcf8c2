//! What the scheduler promises, on small plans.

use proptest::prelude::*;
use sightline_geometry::{CellId, SegmentId};

use super::*;
use crate::{StateRange, TaskKind};

const STATES: StateRange = StateRange { first: 0, end: 1 };

const POLICY: SchedulePolicy = SchedulePolicy {
    lease_ms: 100,
    failures_max: 3,
    pause_ms: 50,
    pause_ms_max: 200,
    retries_later_max: 2,
    losses_max: 4,
    worker_failures_max: 100,
    straggler_percent: 150,
    straggler_ms_min: 10,
    straggler_ms_unknown: 1000,
    workers_max: 8,
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

fn join(s: &mut Scheduler) -> WorkerId {
    s.join(0).expect("there is room for a worker")
}

/// A commit object was found; who made it is not known.
fn commit(s: &mut Scheduler, task: TaskId) -> bool {
    s.committed(task, None, 0)
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
    let worker = join(&mut s);
    let (a, b) = (s.lease(worker, 0).unwrap(), s.lease(worker, 0).unwrap());
    assert!(s.lease(worker, 0).is_none());
    assert!(commit(&mut s, a.task) && !commit(&mut s, a.task));
    assert!(s.lease(worker, 0).is_none());
    commit(&mut s, b.task);
    assert_eq!(s.lease(worker, 0).unwrap().task, TaskId(2));
    assert_eq!(s.outcome(), Outcome::Running);
    commit(&mut s, TaskId(2));
    assert_eq!(s.outcome(), Outcome::Complete);
    let done = |kind| (s.units(kind).done, s.units(kind).total);
    assert_eq!((done(0), done(1)), ((2, 2), (1, 1)));
}

#[test]
fn a_lost_lease_goes_to_another_worker() {
    let mut s = Scheduler::new(&tasks(1, 0), POLICY);
    let (a, b) = (join(&mut s), join(&mut s));
    let first = s.lease(a, 0).unwrap();
    assert!(s.lease(b, 50).is_none());
    assert!(s.heartbeat(a, &[first.id], 90).is_empty());
    assert!(s.heartbeat(b, &[], 140).is_empty());
    assert!(s.expire(150).is_empty());
    assert_eq!(s.expire(190).len(), 1);
    let second = s.lease(b, 191).unwrap();
    assert_eq!((second.task, second.attempt), (first.task, 2));
    assert_eq!(s.heartbeat(a, &[first.id], 192), [first.id]);
    s.failed(first.id, FailureClass::Never, "too late to count", 192);
    assert!(s.lease_in_force(second.id).is_some());
    assert!(commit(&mut s, first.task), "a late attempt may still win the commit");
    s.assert_well_formed();
}

#[test]
fn silent_workers_are_forgotten() {
    let mut s = Scheduler::new(&tasks(1, 0), POLICY);
    let worker = join(&mut s);
    s.expire(99);
    assert!(s.knows(worker));
    s.expire(100);
    assert!(!s.knows(worker));
}

#[test]
fn three_different_workers_quarantine_a_task_and_block_what_depends_on_it() {
    let mut s = Scheduler::new(&tasks(1, 1), POLICY);
    let workers = [join(&mut s), join(&mut s), join(&mut s), join(&mut s)];
    failed(&mut s, workers[0], FailureClass::RetryElsewhere, 1);
    assert!(s.lease(workers[0], 2).is_none(), "others have not tried");
    failed(&mut s, workers[1], FailureClass::RetryElsewhere, 3);
    assert_eq!(s.outcome(), Outcome::Running);
    failed(&mut s, workers[2], FailureClass::RetryElsewhere, 4);
    let Outcome::Missing(missing) = s.outcome() else { panic!("nothing is left to do") };
    assert_eq!(missing.blocked, [TaskId(1)]);
    assert_eq!(missing.quarantined[0].0, TaskId(0));
    assert!(missing.quarantined[0].1.contains("worker 3: it broke"));
    assert!(commit(&mut s, TaskId(0)), "a commit is believed in every state");
    assert_eq!(s.lease(workers[0], 5).unwrap().task, TaskId(1));
}

#[test]
fn a_lonely_worker_may_try_again() {
    let mut s = Scheduler::new(&tasks(1, 0), POLICY);
    let worker = join(&mut s);
    for _ in 0..3 {
        failed(&mut s, worker, FailureClass::RetryElsewhere, 1);
    }
    assert!(matches!(s.outcome(), Outcome::Missing(_)));
}

#[test]
fn never_quarantines_at_once_and_later_waits() {
    let mut s = Scheduler::new(&tasks(2, 0), POLICY);
    let worker = join(&mut s);
    assert_eq!(failed(&mut s, worker, FailureClass::Never, 0), TaskId(0));
    assert!(matches!(s.state(TaskId(0)), TaskState::Quarantined));
    failed(&mut s, worker, FailureClass::RetryLater, 0);
    assert!(s.lease(worker, 24).is_none(), "at least half of the pause");
    failed(&mut s, worker, FailureClass::RetryLater, 50);
    assert!(s.lease(worker, 50 + 49).is_none(), "the second pause is twice as long");
    failed(&mut s, worker, FailureClass::RetryLater, 150);
    assert_eq!(s.missing().quarantined.len(), 1, "the third later is a first failure");
    assert!(s.lease(worker, 100).is_some());
}

#[test]
fn a_task_that_silences_its_workers_is_quarantined() {
    let mut s = Scheduler::new(&tasks(1, 0), POLICY);
    for round in 0..4u64 {
        let worker = s.join(round * 1000).unwrap();
        s.lease(worker, round * 1000).unwrap();
        s.expire(round * 1000 + 500);
        s.assert_well_formed();
    }
    assert!(matches!(s.outcome(), Outcome::Missing(_)));
}

#[test]
fn goodbye_gives_leases_back_at_once() {
    let mut s = Scheduler::new(&tasks(1, 0), POLICY);
    let (a, b) = (join(&mut s), join(&mut s));
    s.lease(a, 0).unwrap();
    assert_eq!(s.leave(a).len(), 1);
    assert!(s.lease(b, 0).is_some());
}

/// A scheduler that knows that a unit takes 100 ms, a worker at work on a task since time 0, and another.
fn with_a_straggler() -> (Scheduler, Lease, WorkerId) {
    let mut s = Scheduler::new(&tasks(5, 0), POLICY);
    let (slow, quick) = (join(&mut s), join(&mut s));
    let first = s.lease(slow, 0).unwrap();
    for _ in 0..4 {
        let lease = s.lease(quick, 0).unwrap();
        s.committed(lease.task, Some(lease.id), 100);
    }
    (s, first, quick)
}

#[test]
fn an_overdue_task_gets_a_second_attempt_on_another_worker() {
    let (mut s, first, quick) = with_a_straggler();
    let limit_ms = s.predicted_ms(first.task).unwrap() * 3 / 2;
    assert!((150..=188).contains(&limit_ms), "{limit_ms}");
    s.heartbeat(first.worker, &[first.id], 99);
    s.heartbeat(quick, &[], 99);
    s.expire(limit_ms - 1);
    assert!(s.lease(quick, limit_ms - 1).is_none(), "not yet overdue");
    s.expire(limit_ms);
    assert!(s.has_work() && s.lease(first.worker, limit_ms).is_none(), "not on the same worker");
    let second = s.lease(quick, limit_ms).unwrap();
    assert_eq!((second.task, second.attempt), (first.task, 2));
    s.assert_well_formed();
    let third = s.join(limit_ms).unwrap();
    s.heartbeat(first.worker, &[first.id], limit_ms);
    s.expire(limit_ms + 90);
    assert!(s.lease(third, limit_ms + 90).is_none(), "two attempts at most");
    assert!(s.committed(second.task, Some(second.id), limit_ms + 90));
    assert_eq!(s.heartbeat(first.worker, &[first.id], limit_ms + 91), [first.id], "told to stop");
    assert_eq!(s.outcome(), Outcome::Complete);
    s.assert_well_formed();
}

#[test]
fn the_other_attempt_goes_on_when_one_fails() {
    let (mut s, first, quick) = with_a_straggler();
    s.heartbeat(first.worker, &[first.id], 99);
    s.heartbeat(quick, &[], 150);
    s.expire(190);
    let second = s.lease(quick, 190).unwrap();
    s.failed(second.id, FailureClass::Never, "no such file", 191);
    s.assert_well_formed();
    assert_eq!(*s.state(first.task), TaskState::Leased, "the first attempt still runs");
    s.release(first.id);
    assert_eq!(*s.state(first.task), TaskState::Quarantined);
    s.assert_well_formed();
}

#[test]
fn a_task_is_not_overdue_while_nobody_knows_how_long_it_takes() {
    let mut s = Scheduler::new(&tasks(1, 0), POLICY);
    let (slow, idle) = (join(&mut s), join(&mut s));
    let first = s.lease(slow, 0).unwrap();
    for now_ms in (50..1000).step_by(50) {
        s.heartbeat(slow, &[first.id], now_ms);
        s.expire(now_ms);
        assert!(s.lease(idle, now_ms).is_none());
    }
    s.expire(1000);
    assert!(s.lease(idle, 1000).is_some(), "one that hangs is not waited for for ever");
}

#[test]
fn a_worker_on_which_everything_fails_pauses() {
    let policy = SchedulePolicy { worker_failures_max: 2, ..POLICY };
    let mut s = Scheduler::new(&tasks(6, 0), policy);
    let (bad, good) = (join(&mut s), join(&mut s));
    failed(&mut s, bad, FailureClass::RetryElsewhere, 0);
    failed(&mut s, bad, FailureClass::RetryElsewhere, 0);
    assert!(s.lease(bad, 24).is_none() && s.lease(good, 24).is_some());
    let again = s.lease(bad, 50).unwrap();
    s.committed(again.task, Some(again.id), 60);
    assert!(s.lease(bad, 60).is_some(), "one success ends it");
}

#[test]
fn no_more_workers_are_registered_than_there_may_be() {
    let mut s = Scheduler::new(&tasks(1, 0), POLICY);
    let all: Vec<_> = (0..9).map(|_| s.join(0)).collect();
    assert_eq!(all.iter().flatten().count(), 8);
    s.expire(100);
    assert!(s.join(100).is_some(), "silent ones make room");
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
        2 => prop_oneof![0..80u64, 150..250u64].prop_map(Event::Wait),
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
                let running: Vec<_> = leases.iter().filter(|l| l.task == lease.task).collect();
                assert!(running.len() < 2, "SC-1: two attempts at most");
                assert!(running.iter().all(|l| l.since_ms < *now_ms), "a second when overdue");
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
            pick(&leases, k).map(|l| s.committed(l.task, Some(l.id), *now_ms));
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
        now_ms += POLICY.lease_ms;
        s.expire(now_ms);
        let worker = s.join(now_ms).expect("the silent ones have made room");
        while s.outcome() == Outcome::Running {
            now_ms += POLICY.pause_ms;
            s.expire(now_ms);
            if let Some(lease) = s.lease(worker, now_ms) {
                s.committed(lease.task, Some(lease.id), now_ms);
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
