//! The stress campaign for what moves: the solver against exact arithmetic on scenes made to break
//! floating point, and closed meshes that must not leak.
//!
//! ```sh
//! cargo run --release -p sightline-solver --example stress_motion             # 2 x 10^7, 10^8, 10^7
//! cargo run --release -p sightline-solver --example stress_motion -- --cases 1e5 --leaks 0
//! cargo run --release -p sightline-solver --example stress_motion -- --family graze --seed 7 --cases 1
//! ```
//!
//! A line a family says how many pixels were looked at, at how many times, how often rational arithmetic
//! had to decide, and why solver and judge differ where they do. The status is 1 when a difference has
//! no explanation, a mesh leaks, or a root is wrong.

// A command: its report goes to standard output, its progress to standard error.
#![allow(clippy::print_stdout, clippy::print_stderr)]

#[path = "../tests/stress_motion/suite/mod.rs"]
#[allow(dead_code, reason = "the short form of the suite uses the rest")]
mod suite;

use std::{
    io::{IsTerminal, Write},
    process::ExitCode,
    time::Instant,
};

use clap::Parser;
use rayon::prelude::*;
use suite::{
    balls::BALLS,
    families::{FAMILIES, Family},
    judge::CAUSES,
    quadratics,
    shells::SHELLS,
    verdict::{Tally, run, run_closed},
};

/// Compares the solver with exact arithmetic on scenes that move, made to break floating point, and
/// looks for leaks in closed meshes.
///
/// The same options give the same report, up to the times. The status is 1 when a difference is not
/// explained by a derived bound, a closed mesh leaks, or a root of a quadratic is wrong.
#[derive(Parser)]
struct Arguments {
    /// Pixels to compare of triangles, and as many of spheres, over all families of either.
    #[arg(long, default_value = "1e7", value_parser = count, value_name = "PIXELS")]
    cases: u64,
    /// Pixels of closed meshes to look for leaks in, over all closed families.
    #[arg(long, default_value = "1e8", value_parser = count, value_name = "PIXELS")]
    leaks: u64,
    /// Random quadratics to solve.
    #[arg(long, default_value = "1e7", value_parser = count, value_name = "COUNT")]
    quadratics: u64,
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

/// Runs cases of a family, in parallel, until there are `pixels`; the order of results is that of the
/// seeds.
fn campaign(family: &Family, first: u64, pixels: u64, run: fn(&Family, u64) -> Tally) -> Tally {
    let mut tally = Tally::default();
    let mut seed = first;
    while tally.pixels < pixels {
        // No more than what is likely to be needed, so that a count of 1 runs one case.
        let a_case = (tally.pixels / tally.cases.max(1)).max(1);
        let batch = if tally.cases == 0 { 1 } else { (pixels - tally.pixels).div_ceil(a_case) };
        let batch = batch.min(BATCH);
        let results: Vec<Tally> =
            (seed..seed + batch).into_par_iter().map(|seed| run(family, seed)).collect();
        results.into_iter().for_each(|t| tally.add(t));
        seed += batch;
        if std::io::stderr().is_terminal() {
            let share = 100.0 * tally.pixels as f64 / pixels as f64;
            eprint!("\r{}: {share:.0} %   ", family.name);
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

fn print_line(name: &str, tally: &Tally, seconds: f64) {
    print!(
        "{name:16} {:>8} {:>10} {:>11} {:>10}",
        tally.cases, tally.pixels, tally.looks, tally.exact
    );
    tally.explained.iter().for_each(|n| print!(" {n:>8}"));
    println!(" {:>9} {:>11} {seconds:>7.1}", tally.algebraic, tally.unexplained.len());
    print_unexplained(tally);
    // The report is read while the campaign runs.
    let _ = std::io::stdout().flush();
}

fn compare(title: &str, families: &[&Family], arguments: &Arguments) -> usize {
    if families.is_empty() || arguments.cases == 0 {
        return 0;
    }
    println!("{title}: differences from exact arithmetic, by what explains them");
    print!("{:16} {:>8} {:>10} {:>11} {:>10}", "family", "cases", "pixels", "looks", "rational");
    CAUSES.iter().for_each(|c| print!(" {c:>8}"));
    println!(" {:>9} {:>11} {:>7}", "algebraic", "unexplained", "s");
    let mut whole = Tally::default();
    let start = Instant::now();
    for family in families {
        let pixels = arguments.cases.div_ceil(families.len() as u64);
        let from = Instant::now();
        let tally = campaign(family, arguments.seed, pixels, run);
        print_line(family.name, &tally, from.elapsed().as_secs_f64());
        whole.add(tally);
    }
    let unexplained = whole.unexplained.len();
    whole.unexplained.clear();
    print_line("all", &whole, start.elapsed().as_secs_f64());
    println!("unexplained: {unexplained}\n");
    unexplained
}

fn look_for_leaks(families: &[&Family], arguments: &Arguments) -> usize {
    if families.is_empty() || arguments.leaks == 0 {
        return 0;
    }
    println!("Closed meshes that move");
    println!("{:16} {:>9} {:>11} {:>7} {:>7}", "family", "cases", "pixels", "leaks", "s");
    let (mut leaks, mut pixels, mut cases) = (0, 0, 0);
    let start = Instant::now();
    for family in families {
        let share = arguments.leaks.div_ceil(families.len() as u64);
        let from = Instant::now();
        let tally = campaign(family, arguments.seed, share, run_closed);
        let (seconds, found) = (from.elapsed().as_secs_f64(), tally.unexplained.len());
        let name = family.name;
        println!("{name:16} {:>9} {:>11} {found:>7} {seconds:>7.1}", tally.cases, tally.pixels);
        print_unexplained(&tally);
        let _ = std::io::stdout().flush();
        leaks += found;
        pixels += tally.pixels;
        cases += tally.cases;
    }
    let seconds = start.elapsed().as_secs_f64();
    println!("{:16} {cases:>9} {pixels:>11} {leaks:>7} {seconds:>7.1}\n", "all");
    leaks
}

fn solve_quadratics(arguments: &Arguments) -> usize {
    /// Quadratics with one number.
    const EACH: u64 = 10_000;
    if arguments.quadratics == 0 {
        return 0;
    }
    let from = Instant::now();
    let batches = arguments.quadratics.div_ceil(EACH);
    let first = arguments.seed;
    let wrong: Vec<String> = (first..first + batches)
        .into_par_iter()
        .flat_map_iter(|seed| quadratics::run(seed, EACH))
        .collect();
    let seconds = from.elapsed().as_secs_f64();
    println!("Quadratics: {} solved, {} wrong, {seconds:.1} s", batches * EACH, wrong.len());
    wrong.iter().take(PRINTED).for_each(|line| println!("    {line}"));
    wrong.len()
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let all = || FAMILIES.iter().chain(BALLS).chain(SHELLS);
    if arguments.list {
        all().for_each(|f| println!("{:16} {}", f.name, f.about));
        return ExitCode::SUCCESS;
    }
    if let Some(name) = arguments.family.iter().find(|n| all().all(|f| f.name != n.as_str())) {
        eprintln!("there is no family `{name}`; --list shows all");
        return ExitCode::from(2);
    }
    let chosen = |of: &'static [Family]| -> Vec<&'static Family> {
        let named = |f: &&Family| arguments.family.iter().any(|n| n == f.name);
        of.iter().filter(|f| arguments.family.is_empty() || named(f)).collect()
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(arguments.threads).build();
    let wrong = pool.expect("threads can be started").install(|| {
        let equations = if arguments.family.is_empty() { solve_quadratics(&arguments) } else { 0 };
        equations
            + compare("Triangles", &chosen(FAMILIES), &arguments)
            + compare("Spheres", &chosen(BALLS), &arguments)
            + look_for_leaks(&chosen(SHELLS), &arguments)
    });
    if wrong == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
