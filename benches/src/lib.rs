//! What the benchmarks share: regions, ground truth, ray tracers, clocks, and the rivals.
//!
//! `src/bin/compare.rs` runs every method on the same scenes in one process and writes a table
//! and plots; `src/bin/segments.rs` times our own solves alone; `src/bin/hidden.rs` says what
//! hidden geometry costs them, `src/bin/hidden_movers.rs` what hidden objects that move cost,
//! `src/bin/motion.rs` what a scene that moves costs a state.

pub mod clock;
pub mod curve;
pub mod directions;
pub mod found;
pub mod from_segment;
pub mod plot;
pub mod region;
pub mod report;
pub mod rivals;
pub mod single_segment;
pub mod tracers;
pub mod truth;
pub mod walls;
