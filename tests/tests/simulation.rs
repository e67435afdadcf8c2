//! The protocol under simulated faults: tens of seeds here, thousands with
//! `cargo run --release -p sightline-tests --bin simulate -- --seeds 10000`.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::OnceLock;

use sightline_tests::simulation::{Bake, Ended, run};

/// Seeds of the short campaign.
const SEEDS: u64 = 40;

fn bake() -> &'static Bake {
    static BAKE: OnceLock<Bake> = OnceLock::new();
    BAKE.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder can be made");
        Bake::prepare(folder.path())
    })
}

#[test]
fn a_bake_loses_nothing_whatever_goes_wrong() {
    let ended: Vec<Ended> = (1..=SEEDS)
        .map(|seed| match catch_unwind(AssertUnwindSafe(|| run(bake(), seed))) {
            Ok(ended) => ended,
            Err(panic) => {
                // The panic has been printed; this says how to see it again.
                let again = format!("simulate --seed {seed}");
                panic!("seed {seed} broke an invariant; run `{again}`: {panic:?}")
            }
        })
        .collect();
    let faults: usize = ended.iter().map(|e| e.faults).sum();
    let replaced = ended.iter().filter(|e| e.epochs > 1).count();
    assert!(faults > 200, "{faults} faults in {SEEDS} runs are too few to mean anything");
    assert!(replaced > 10, "{replaced} runs of {SEEDS} saw a second coordinator");
}

#[test]
fn a_seed_has_one_history() {
    for seed in [3, 11] {
        assert_eq!(run(bake(), seed), run(bake(), seed), "seed {seed}");
    }
}
