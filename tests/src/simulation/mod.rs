//! The real coordinator and the real workers on a simulated network, clock and store.
//!
//! A run is one bake of a small city under faults, all drawn from a seed: the same seed gives the same
//! history, to the last message. Two hosts can be the coordinator and three are workers; turmoil runs
//! them on one thread, each with a clock of its own. What is real: the gRPC services and clients, the
//! scheduler, the journal, attempts, commits, the writing and publishing of the dataset. What is
//! simulated: sockets, time, the store's front (`store`), and how long a computation takes; its result
//! is computed once a task and remembered, since it is a function of the plan.
//!
//! Faults (`faults`): crashes and restarts of every host, polite stops, partitions in both directions
//! and one, messages held back, a second coordinator while the first still runs, clocks that jump and run
//! fast or slow, workers that slow down or fail tasks, and a store that is out of reach for a host,
//! applies a write long after its writer has been told that it failed, loses answers and repeats
//! requests.
//!
//! After every step of the clock these invariants hold, or the run panics with the seed:
//! - JB-1: a task has one commit, which never changes, and names parts that exist with the bytes of the
//!   undisturbed bake;
//! - JB-2: whatever the pointer names is whole, and is the dataset of the undisturbed bake;
//! - CL-1: no object but the pointer is ever replaced or deleted;
//! - CL-2: epochs have no gaps and one owner each;
//! - SC-1 to SC-4, in the scheduler of every coordinator.
//!
//! When the faults end, the bake ends too, with a dataset: nothing was lost.

mod compute;
mod faults;
mod store;
mod world;

pub use world::{Bake, Ended, run};
