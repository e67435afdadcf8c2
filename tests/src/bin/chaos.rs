//! Bakes with real processes that are killed, stopped and cut off, seed by seed; see
//! `sightline_tests::chaos`.
//!
//! ```text
//! cargo run --release -p sightline-tests --bin chaos -- --store all --runs 100
//! cargo run --release -p sightline-tests --bin chaos -- --sleeper-minutes 10
//! ```

use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Parser, ValueEnum};
use sightline_tests::chaos::{Campaign, Report, Store};

/// Bakes with real processes under faults.
#[derive(Debug, Parser)]
struct Arguments {
    /// Where the bakes go.
    #[arg(long, value_enum, default_value = "all")]
    store: Choice,
    /// Number of runs on each store.
    #[arg(long, default_value_t = 20)]
    runs: u64,
    /// First seed.
    #[arg(long, default_value_t = 1)]
    from: u64,
    /// Runs next to each other: they wait more than they work.
    #[arg(long, default_value_t = 2, value_name = "N")]
    at_a_time: usize,
    /// Instead, one bake to a folder with a worker that is stopped for so long, and wakes.
    #[arg(long, value_name = "MINUTES", conflicts_with_all = ["store", "runs", "from"])]
    sleeper_minutes: Option<u64>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Choice {
    Files,
    Moto,
    Azurite,
    All,
}

impl Choice {
    fn stores(self) -> Vec<Store> {
        match self {
            Self::Files => vec![Store::Files],
            Self::Moto => vec![Store::Moto],
            Self::Azurite => vec![Store::Azurite],
            Self::All => Store::ALL.to_vec(),
        }
    }
}

fn say(line: &str) {
    // Nobody reads it when this fails.
    let _ = writeln!(std::io::stdout(), "{line}");
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    // Folders of broken runs are left for whoever looks into them.
    let folder = tempfile::Builder::new().prefix("sightline-chaos-").tempdir();
    let folder = folder.expect("a temporary folder can be made").keep();
    let mut is_kept = true;
    if let Some(minutes) = arguments.sleeper_minutes {
        is_kept = sleeps(&folder, Duration::from_secs(60 * minutes));
    } else {
        for store in arguments.store.stores() {
            is_kept &= keeps(store, &arguments, &folder);
        }
    }
    // What is left is of broken runs.
    if std::fs::remove_dir(&folder).is_err() {
        say(&format!("what is left of broken runs is in {}", folder.display()));
    }
    if is_kept { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn sleeps(folder: &std::path::Path, asleep: Duration) -> bool {
    let folder = folder.join("files");
    let campaign = Campaign::prepare(Store::Files, &folder, "chaos");
    let campaign = campaign.expect("files need no server");
    let is_kept = catch_unwind(AssertUnwindSafe(|| campaign.sleeper(asleep))).is_ok();
    tidy(&folder, is_kept);
    let ended = if is_kept { "changed nothing" } else { "BROKE A PROMISE" };
    say(&format!("a worker that slept for {} s and woke {ended}", asleep.as_secs()));
    is_kept
}

fn tidy(folder: &std::path::Path, is_kept: bool) {
    if is_kept {
        let _ = std::fs::remove_dir_all(folder);
    }
}

/// True when every run kept its promises and every fault happened.
fn keeps(store: Store, arguments: &Arguments, folder: &std::path::Path) -> bool {
    let name = store.name();
    let folder = folder.join(name);
    let Some(campaign) = Campaign::prepare(store, &folder, "chaos") else {
        say(&format!("{name}: its server is not installed; `bash tests/run` does that"));
        return false;
    };
    let seeds = arguments.from..arguments.from + arguments.runs;
    let report = campaign.run_all(seeds, arguments.at_a_time);
    let Report { kept, broken, faults, gave_up, took } = &report;
    say(&format!("{name}: {kept} of {} runs kept, {:.0} s", arguments.runs, took.as_secs_f64()));
    for (what, times) in faults {
        say(&format!("  {times:5}  {what}"));
    }
    if !gave_up.is_empty() {
        say("  ended with a failure, and started again:");
    }
    for (reason, times) in gave_up {
        say(&format!("  {times:5}  {reason}"));
    }
    let never = campaign.never_met(&report);
    if !never.is_empty() {
        say(&format!("  never happened: {}; give more --runs", never.join(", ")));
    }
    if !broken.is_empty() {
        say(&format!("  BROKEN by the seeds {broken:?}"));
    }
    tidy(&folder, broken.is_empty());
    broken.is_empty() && never.is_empty()
}
