//! Real processes that are killed, stopped and cut off: a few seeds here, hundreds with
//! `cargo run --release -p sightline-tests --bin chaos -- --runs 100`.

use std::path::{Path, PathBuf};
use std::time::Duration;

use sightline_tests::chaos::{Campaign, Report, Store};

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join("chaos").join(name)
}

/// Runs `seeds`, one after the other: the tests of the other stores run meanwhile.
fn lose_nothing(store: Store, seeds: std::ops::Range<u64>, test: &str) {
    let Some(campaign) = Campaign::prepare(store, &folder(store.name()), test) else { return };
    let report = campaign.run_all(seeds, 1);
    let Report { broken, faults, gave_up, .. } = &report;
    let again = format!("`chaos --store {} --runs 1 --from SEED`", store.name());
    assert!(broken.is_empty(), "seeds {broken:?} broke a promise; run {again}");
    assert!(faults.len() > 3, "too little went wrong to mean anything: {faults:?}, {gave_up:?}");
}

#[test]
fn killed_and_stopped_processes_lose_nothing_on_files() {
    let test = "killed_and_stopped_processes_lose_nothing_on_files";
    lose_nothing(Store::Files, 1..5, test);
}

#[test]
fn killed_and_stopped_processes_lose_nothing_on_s3() {
    let test = "killed_and_stopped_processes_lose_nothing_on_s3";
    lose_nothing(Store::Moto, 3..5, test);
}

#[test]
fn killed_and_stopped_processes_lose_nothing_on_azure() {
    let test = "killed_and_stopped_processes_lose_nothing_on_azure";
    lose_nothing(Store::Azurite, 3..5, test);
}

#[test]
fn a_worker_that_wakes_after_its_task_was_given_away_changes_nothing() {
    let test = "a_worker_that_wakes_after_its_task_was_given_away_changes_nothing";
    let campaign = Campaign::prepare(Store::Files, &folder("sleeper"), test);
    campaign.expect("files need no server").sleeper(Duration::from_secs(2));
}
