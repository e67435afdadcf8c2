//! Simulates bakes under faults, seed by seed, and stops at the first that breaks an invariant.
//!
//! ```text
//! cargo run --release -p sightline-tests --bin simulate -- --seeds 10000
//! RUST_LOG=info cargo run --release -p sightline-tests --bin simulate -- --seed 4711
//! ```

use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::time::Instant;

use clap::Parser;
use rayon::prelude::*;
use sightline_tests::simulation::{Bake, run};

/// Simulates bakes under faults.
#[derive(Debug, Parser)]
struct Arguments {
    /// One seed, twice: its history has to be the same.
    #[arg(long, conflicts_with_all = ["seeds", "from"])]
    seed: Option<u64>,
    /// Number of seeds.
    #[arg(long, default_value_t = 1000)]
    seeds: u64,
    /// First seed.
    #[arg(long, default_value_t = 1)]
    from: u64,
}

fn say(line: &str) {
    // Nobody reads it when this fails.
    let _ = writeln!(std::io::stdout(), "{line}");
}

fn main() -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::from_default_env();
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    let arguments = Arguments::parse();
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let bake = Bake::prepare(folder.path());
    if let Some(seed) = arguments.seed {
        let (first, second) = (run(&bake, seed), run(&bake, seed));
        say(&format!("seed {seed}: {first:?}"));
        if first != second {
            say(&format!("the second time: {second:?}"));
            return ExitCode::FAILURE;
        }
        return ExitCode::SUCCESS;
    }
    let start = Instant::now();
    let seeds = arguments.from..arguments.from + arguments.seeds;
    let ended: Vec<_> = seeds
        .into_par_iter()
        .map(|seed| catch_unwind(AssertUnwindSafe(|| run(&bake, seed))).map_err(|_| seed))
        .collect();
    let broken: Vec<u64> = ended.iter().filter_map(|e| e.as_ref().err()).copied().collect();
    let (mut faults, mut epochs, mut puts, mut simulated_ms) = (0, 0, 0, 0);
    for ended in ended.iter().flatten() {
        faults += ended.faults;
        epochs += ended.epochs;
        puts += ended.puts;
        simulated_ms += ended.took_ms;
    }
    say(&format!(
        "{} seeds, {faults} faults, {epochs} coordinators, {puts} puts, {} h simulated in {:.0} s",
        ended.len(),
        simulated_ms / 3_600_000,
        start.elapsed().as_secs_f64()
    ));
    if broken.is_empty() {
        say("no invariant was broken");
        return ExitCode::SUCCESS;
    }
    say(&format!("an invariant was broken by the seeds {broken:?}"));
    ExitCode::FAILURE
}
