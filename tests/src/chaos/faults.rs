//! What goes wrong in a run: drawn from its seed.

use std::time::Duration;

use rand::Rng;
use rand::rngs::SmallRng;

use super::Store;
use crate::flaky_proxy;

/// Faults that every run has from the list of all, in turn: so that consecutive seeds meet each.
const IN_TURN: usize = 4;
/// Most faults by chance, besides.
const BY_CHANCE_MAX: usize = 4;
/// Of so many seeds one is killed for good.
pub(super) const KILLED_EVERY: u64 = 4;
/// The name of that.
pub(super) const KILLED_FOR_GOOD: &str = "killed for good";

/// A kind of fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    WorkerKilled,
    CoordinatorKilled,
    WorkerStopped,
    WorkerStoppedBeyondItsLease,
    CoordinatorStopped,
    CoordinatorStoppedAndReplaced,
    WorkerAskedToStop,
    CoordinatorAskedToStop,
    ConnectionsCut,
    ConnectionsSlow,
    ConnectionsStalled,
    DiskFull,
}

impl Fault {
    const ALL: [Self; 12] = [
        Self::WorkerKilled,
        Self::CoordinatorKilled,
        Self::WorkerStopped,
        Self::WorkerStoppedBeyondItsLease,
        Self::CoordinatorStopped,
        Self::CoordinatorStoppedAndReplaced,
        Self::WorkerAskedToStop,
        Self::CoordinatorAskedToStop,
        Self::ConnectionsCut,
        Self::ConnectionsSlow,
        Self::ConnectionsStalled,
        Self::DiskFull,
    ];

    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::WorkerKilled => "worker killed",
            Self::CoordinatorKilled => "coordinator killed",
            Self::WorkerStopped => "worker stopped",
            Self::WorkerStoppedBeyondItsLease => "worker stopped beyond its lease",
            Self::CoordinatorStopped => "coordinator stopped",
            Self::CoordinatorStoppedAndReplaced => "coordinator stopped and replaced",
            Self::WorkerAskedToStop => "worker asked to stop",
            Self::CoordinatorAskedToStop => "coordinator asked to stop",
            Self::ConnectionsCut => "connections cut",
            Self::ConnectionsSlow => "connections slow",
            Self::ConnectionsStalled => "connections stalled",
            Self::DiskFull => "disk full",
        }
    }

    /// All that can happen to a bake on this store.
    fn of(store: Store) -> Vec<Self> {
        let can = |fault: &Self| store == Store::Files || *fault != Self::DiskFull;
        Self::ALL.into_iter().filter(can).collect()
    }
}

/// The name of a fault in front of the store.
pub(super) fn name_at_store(fault: flaky_proxy::Fault) -> String {
    format!("store: {fault:?}")
}

/// The names of everything that a campaign on this store should meet.
pub(super) fn names(store: Store) -> Vec<String> {
    let mut names: Vec<String> = Fault::of(store).iter().map(|f| f.name().to_owned()).collect();
    names.push(KILLED_FOR_GOOD.into());
    if store != Store::Files {
        names.extend(flaky_proxy::Fault::ALL.map(name_at_store));
    }
    names
}

/// A fault: how long behind the one before, and for how long.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spell {
    pub fault: Fault,
    pub after: Duration,
    pub lasts: Duration,
}

/// The faults of a run, one after the other.
pub(super) fn draw(rng: &mut SmallRng, store: Store, seed: u64, lease_ms: u64) -> Vec<Spell> {
    let all = Fault::of(store);
    let first = seed as usize * IN_TURN;
    let mut faults: Vec<Fault> = (first..first + IN_TURN).map(|k| all[k % all.len()]).collect();
    for _ in 0..rng.random_range(0..=BY_CHANCE_MAX) {
        let at = rng.random_range(0..=faults.len());
        faults.insert(at, all[rng.random_range(0..all.len())]);
    }
    let mut spell = |fault| {
        let lasts_ms = match fault {
            Fault::WorkerStoppedBeyondItsLease => rng.random_range(lease_ms * 3 / 2..lease_ms * 4),
            Fault::CoordinatorStoppedAndReplaced => rng.random_range(lease_ms / 4..lease_ms * 4),
            Fault::WorkerStopped => rng.random_range(10..lease_ms * 3 / 4),
            _ => rng.random_range(10..lease_ms * 3 / 2),
        };
        let after = Duration::from_millis(rng.random_range(0..250));
        Spell { fault, after, lasts: Duration::from_millis(lasts_ms) }
    };
    faults.into_iter().map(&mut spell).collect()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn a_few_seeds_in_a_row_plan_every_fault() {
        for store in Store::ALL {
            let all = Fault::of(store);
            let runs = all.len().div_ceil(IN_TURN) as u64;
            let planned: Vec<Fault> = (7..7 + runs)
                .flat_map(|seed| draw(&mut SmallRng::seed_from_u64(seed), store, seed, 600))
                .map(|spell| spell.fault)
                .collect();
            assert!(all.iter().all(|fault| planned.contains(fault)), "{store:?}: {planned:?}");
        }
    }
}
