//! What goes wrong, and when: drawn from the seed, one by one as time goes by.

use rand::Rng;
use rand::rngs::SmallRng;

/// One thing that goes wrong. Hosts are numbers: coordinators first, then workers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// A host dies, and is started again later.
    Crash { host: usize },
    /// A worker is asked to stop, and is started again later.
    Stop { worker: usize },
    /// Nothing passes between two hosts.
    Partition { a: usize, b: usize },
    /// Nothing passes from one host to another.
    PartitionOneWay { from: usize, to: usize },
    /// What is sent between two hosts arrives when the fault is over.
    Hold { a: usize, b: usize },
    /// Another host becomes the coordinator, whatever the first one does.
    Switch,
    /// The store is out of reach.
    StoreDown { host: usize },
    /// Requests to the store and its answers get lost, and some requests arrive twice.
    StoreLossy { host: usize, percent: u32 },
    /// Puts arrive late: behind the end of a lease.
    StoreStalls { host: usize, up_to_ms: u64 },
    /// A coordinator's clock jumps ahead.
    ClockJump { host: usize, by_ms: u64 },
    /// A coordinator's clock runs at another rate.
    ClockRate { host: usize, percent: u64 },
    /// A worker takes longer.
    Slow { worker: usize, factor: u32 },
    /// Tasks fail on a worker.
    Failing { worker: usize, percent: u32 },
}

/// A fault and the time for which it lasts.
#[derive(Clone, Copy, Debug)]
pub struct Spell {
    pub fault: Fault,
    pub lasts_ms: u64,
}

/// Draws a fault for hosts of which the first `coordinators` can coordinate and the others work.
pub fn draw(rng: &mut SmallRng, coordinators: usize, hosts: usize) -> Spell {
    let any = rng.random_range(0..hosts);
    let coordinator = rng.random_range(0..coordinators);
    let worker = rng.random_range(coordinators..hosts);
    let fault = match rng.random_range(0..26) {
        0..=2 => Fault::Crash { host: worker },
        3..=4 => Fault::Crash { host: coordinator },
        5 => Fault::Stop { worker },
        6..=7 => Fault::Partition { a: coordinator, b: worker },
        8..=9 if rng.random_bool(0.5) => Fault::PartitionOneWay { from: coordinator, to: worker },
        8..=9 => Fault::PartitionOneWay { from: worker, to: coordinator },
        10..=11 => Fault::Hold { a: coordinator, b: worker },
        12..=13 => Fault::Switch,
        14..=15 => Fault::StoreDown { host: any },
        16..=17 => Fault::StoreLossy { host: any, percent: rng.random_range(5..50) },
        18..=20 => Fault::StoreStalls { host: any, up_to_ms: rng.random_range(500..15_000) },
        21 => Fault::ClockJump { host: coordinator, by_ms: rng.random_range(10..10_000) },
        22 => Fault::ClockRate { host: coordinator, percent: rng.random_range(30..300) },
        23..=24 => Fault::Slow { worker, factor: rng.random_range(2..20) },
        _ => Fault::Failing { worker, percent: rng.random_range(10..100) },
    };
    Spell { fault, lasts_ms: rng.random_range(200..8_000) }
}
