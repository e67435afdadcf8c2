//! The stress campaign: the solver against its twins on scenes made to break floating point, and
//! closed meshes that must not leak.
//!
//! ```sh
//! cargo run --release -p sightline-solver --example stress                    # 10^8 and 10^9 pixels
//! cargo run --release -p sightline-solver --example stress -- --cases 1e6 --leaks 1e7
//! cargo run --release -p sightline-solver --example stress -- --family sliver --seed 7 --cases 1
//! ```
//!
//! A line a family says how many pixels were looked at, at how many something was undecided by the
//! float twin, how many primitives were compared, and why solver and twin differ where they do.
//! The status is 1 when a difference has no explanation, or a mesh leaks.

// A command: its report goes to standard output, its progress to standard error.
#![allow(clippy::print_stdout, clippy::print_stderr)]

#[path = "../tests/stress/suite/mod.rs"]
#[allow(dead_code, reason = "the short form of the suite uses the rest")]
mod suite;

use std::{io::IsTerminal, process::ExitCode, time::Instant};

use clap::Parser;
use rayon::prelude::*;
use suite::{
    closed::CLOSED_FAMILIES,
    families::FAMILIES,
    twin::CAUSES,
    verdict::{Tally, run, run_closed},
};

/// Compares the solver with its twins on scenes made to break floating point, and looks for leaks
/// in closed meshes.
///
/// The same options give the same report, up to the times. The status is 1 when a difference is
/// not explained by a derived bound, or a closed mesh leaks.
#[derive(Parser)]
struct Arguments {
    /// Pixels to compare with the twins, over all families.
    #[arg(long, default_value = "1e8", value_parser = count, value_name = "PIXELS")]
    cases: u64,
    /// Pixels of closed meshes to look for leaks in, over all closed families.
    #[arg(long, default_value = "1e9", value_parser = count, value_name = "PIXELS")]
    leaks: u64,
    /// Number of the first case of each family.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Runs this family only; may be given several times. All pixels go to the families named.
    #[arg(long, value_name = "NAME")]
    family: Vec<String>,
    /// Threads to work on; as many as there are processors unless given.
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    threads: usize,
    /// Says which families there are, and ends.
    #[arg(long)]
    list: bool,
}

/// Reads `1000` and `1e3`.
fn count(text: &str) -> Result<u64, String> {
    let value: f64 = text.parse().map_err(|_| format!("`{text}` is not a number"))?;
    // 2^53: above it, numbers are not counts any more.
    let is_count = value.fract() == 0.0 && (0.0..9_007_199_254_740_992.0).contains(&value);
    if is_count { Ok(value as u64) } else { Err(format!("`{text}` is not a count")) }
}

/// Cases that are run between two looks at the count of pixels.
const BATCH: u64 = 256;

/// Unexplained differences that are printed for each family.
const PRINTED: usize = 5;

/// Runs cases of a family, in parallel, until there are `pixels`; the order of results is that of
/// the seeds.
fn campaign(name: &str, first: u64, pixels: u64, run: impl Fn(u64) -> Tally + Sync) -> Tally {
    let mut tally = Tally::default();
    let mut seed = first;
    while tally.pixels < pixels {
        // No more than what is likely to be needed, so that a count of 1 runs one case.
        let a_case = (tally.pixels / tally.cases.max(1)).max(1);
        let batch = if tally.cases == 0 { 1 } else { (pixels - tally.pixels).div_ceil(a_case) };
        let batch = batch.min(BATCH);
        let results: Vec<Tally> = (seed..seed + batch).into_par_iter().map(&run).collect();
        results.into_iter().for_each(|t| tally.add(t));
        seed += batch;
        if std::io::stderr().is_terminal() {
            eprint!("\r{name}: {:.0} %   ", 100.0 * tally.pixels as f64 / pixels as f64);
        }
    }
    if std::io::stderr().is_terminal() {
        eprint!("\r{:60}\r", "");
    }
    tally
}

fn print_unexplained(tally: &Tally) {
    for line in tally.unexplained.iter().take(PRINTED) {
        println!("    {line}");
    }
    if tally.unexplained.len() > PRINTED {
        println!("    and {} more", tally.unexplained.len() - PRINTED);
    }
}

fn print_heading() {
    print!(
        "{:16} {:>9} {:>11} {:>10} {:>10} {:>8}",
        "family", "cases", "pixels", "undecided", "compared", "settled"
    );
    CAUSES.iter().for_each(|c| print!(" {:>12}", c.name()));
    println!(" {:>8} {:>11} {:>7}", "exact", "unexplained", "s");
}

fn print_line(name: &str, tally: &Tally, seconds: f64) {
    print!(
        "{name:16} {:>9} {:>11} {:>10} {:>10} {:>8}",
        tally.cases, tally.pixels, tally.undecided, tally.compared, tally.settled
    );
    tally.explained.iter().for_each(|n| print!(" {n:>12}"));
    println!(" {:>8} {:>11} {seconds:>7.1}", tally.exact, tally.unexplained.len());
    print_unexplained(tally);
}

fn compare(arguments: &Arguments, wanted: impl Fn(&str) -> bool) -> usize {
    let chosen: Vec<_> = FAMILIES.iter().filter(|f| wanted(f.name)).collect();
    if chosen.is_empty() || arguments.cases == 0 {
        return 0;
    }
    println!("Differences from the twins, by what explains them");
    print_heading();
    let mut whole = Tally::default();
    let start = Instant::now();
    for family in &chosen {
        let pixels = arguments.cases.div_ceil(chosen.len() as u64);
        let from = Instant::now();
        let tally = campaign(family.name, arguments.seed, pixels, |seed| run(family, seed));
        print_line(family.name, &tally, from.elapsed().as_secs_f64());
        whole.add(tally);
    }
    let unexplained = whole.unexplained.len();
    whole.unexplained.truncate(0);
    print_line("all", &Tally { ..whole }, start.elapsed().as_secs_f64());
    println!("unexplained: {unexplained}\n");
    unexplained
}

fn look_for_leaks(arguments: &Arguments, wanted: impl Fn(&str) -> bool) -> usize {
    let chosen: Vec<_> = CLOSED_FAMILIES.iter().filter(|f| wanted(f.name)).collect();
    if chosen.is_empty() || arguments.leaks == 0 {
        return 0;
    }
    println!("Closed meshes");
    println!("{:16} {:>9} {:>11} {:>7} {:>7}", "family", "cases", "pixels", "leaks", "s");
    let (mut leaks, mut pixels, mut cases) = (0, 0, 0);
    let start = Instant::now();
    for family in &chosen {
        let share = arguments.leaks.div_ceil(chosen.len() as u64);
        let from = Instant::now();
        let tally = campaign(family.name, arguments.seed, share, |seed| run_closed(family, seed));
        let seconds = from.elapsed().as_secs_f64();
        let found = tally.unexplained.len();
        println!(
            "{:16} {:>9} {:>11} {found:>7} {seconds:>7.1}",
            family.name, tally.cases, tally.pixels
        );
        print_unexplained(&tally);
        leaks += found;
        pixels += tally.pixels;
        cases += tally.cases;
    }
    let seconds = start.elapsed().as_secs_f64();
    println!("{:16} {cases:>9} {pixels:>11} {leaks:>7} {seconds:>7.1}", "all");
    leaks
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let families = FAMILIES.iter().map(|f| (f.name, f.about));
    let all: Vec<_> = families.chain(CLOSED_FAMILIES.iter().map(|f| (f.name, f.about))).collect();
    if arguments.list {
        all.iter().for_each(|(name, about)| println!("{name:16} {about}"));
        return ExitCode::SUCCESS;
    }
    if let Some(name) = arguments.family.iter().find(|n| !all.iter().any(|f| f.0 == n.as_str())) {
        eprintln!("there is no family `{name}`; --list shows all");
        return ExitCode::from(2);
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(arguments.threads).build();
    let wanted =
        |name: &str| arguments.family.is_empty() || arguments.family.iter().any(|f| f == name);
    let unexplained = pool
        .expect("threads can be started")
        .install(|| compare(&arguments, wanted) + look_for_leaks(&arguments, wanted));
    if unexplained == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
