//! The short form of the numerical stress suite; `cargo run --release -p sightline-solver
//! --example stress` runs the campaign.

mod suite;

use suite::{families::{FAMILIES, Family}, random::Random, verdict::{Tally, judge}};

fn run(family: &Family, seeds: std::ops::Range<u64>) -> Tally {
    let mut tally = Tally::default();
    for seed in seeds {
        let mut random = Random::of_case(family.name, seed);
        let case = (family.generate)(&mut random);
        let mut of_case = judge(&case, &mut random);
        for line in &mut of_case.unexplained {
            *line = format!("{} seed {seed}: {line}", family.name);
        }
        tally.add(of_case);
    }
    tally
}

#[test]
fn try_all() {
    for family in FAMILIES {
        let start = std::time::Instant::now();
        let t = run(family, 0..200);
        eprintln!("{:16} {:?} px {} undecided {} compared {} settled {} explained {:?} exact {} unexplained {}", family.name, start.elapsed(), t.pixels, t.undecided, t.compared, t.settled, t.explained, t.exact, t.unexplained.len());
        for l in t.unexplained.iter().take(3) { eprintln!("   {l}"); }
    }
}
