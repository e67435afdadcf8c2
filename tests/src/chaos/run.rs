//! One bake under faults.

use std::collections::BTreeMap;
use std::path::Path;

use rand::rngs::SmallRng;
use rand::{Rng, SeedableRng};

use super::cluster::Cluster;
use super::place::Place;
use super::{Campaign, faults};
use crate::city::LIMIT;
use crate::{dataset, process};

/// What a run met that kept its promises.
#[derive(Debug)]
pub struct Ended {
    /// How often each fault happened.
    pub faults: BTreeMap<String, u64>,
    /// What processes said that ended with a failure of their own.
    pub gave_up: Vec<String>,
}

pub(super) fn run(campaign: &Campaign, seed: u64) -> Ended {
    let mut rng = SmallRng::seed_from_u64(seed);
    let folder = campaign.folder.join(format!("seed-{seed}"));
    std::fs::create_dir(&folder).expect("a seed is run once");
    let place = Place::of(campaign, &folder, seed);
    let lease_ms = rng.random_range(400..1200);
    let workers = rng.random_range(2..=3);
    let spells = faults::draw(&mut rng, campaign.store, seed, lease_ms);

    let mut cluster = Cluster::start(campaign, &place, &folder, workers, lease_ms);
    let mut met: BTreeMap<String, u64> = BTreeMap::new();
    let mut is_over = false;
    for spell in spells {
        is_over = cluster.goes_on(spell.after);
        if is_over {
            break;
        }
        if cluster.suffer(spell, &mut rng) {
            *met.entry(spell.fault.name().into()).or_default() += 1;
        }
    }
    let gave_up;
    if !is_over && seed.is_multiple_of(faults::KILLED_EVERY) {
        gave_up = std::mem::take(&mut cluster.gave_up);
        cluster.kill_all();
        *met.entry(faults::KILLED_FOR_GOOD.into()).or_default() += 1;
        place.calm();
        let left = place.fetch();
        if left.join("current.json").exists() {
            dataset::assert_same(&campaign.baked, &left);
        }
        let mut bake = campaign.bake(&place.out());
        let _ = process::run(place.admit(&mut bake), LIMIT).success();
    } else {
        is_over = is_over || cluster.outlasts_its_faults();
        cluster.finish(is_over);
        gave_up = std::mem::take(&mut cluster.gave_up);
        drop(cluster);
    }
    dataset::assert_same(&campaign.baked, &place.fetch());
    assert_nobody_panicked(&folder);
    met.extend(place.met());
    drop(place);
    // Kept where a promise was broken.
    let _ = std::fs::remove_dir_all(&folder);
    Ended { faults: met, gave_up }
}

fn assert_nobody_panicked(folder: &Path) {
    for entry in std::fs::read_dir(folder).expect("the outputs are there").flatten() {
        if entry.path().extension().is_some_and(|end| end == "stderr") {
            let bytes = std::fs::read(entry.path()).expect("an output can be read");
            let text = String::from_utf8_lossy(&bytes);
            assert!(!text.contains("panicked"), "{}:\n{text}", entry.path().display());
        }
    }
}
