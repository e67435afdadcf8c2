//! An edited scene costs what sees the edit, and ends in the bytes of a bake from scratch: the real
//! command on the small city, in which things are moved.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use serde_json::Value;
use sightline_tests::binaries::sightline;
use sightline_tests::city::{self, CELLS, City, LIMIT, TASK_UNITS};
use sightline_tests::{dataset, glb, process};

/// The city that all tests share, baked once.
static CITY: LazyLock<City> =
    LazyLock::new(|| City::bake(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("edits")));

fn bake(scene: &Path, out: &Path, units: [u32; 2]) -> Value {
    let mut command = sightline(city::bake_arguments("bake", scene, out, units));
    process::run(command.arg("--json"), LIMIT).success().json()
}

fn reused(summary: &Value, what: &str) -> u64 {
    summary[format!("{what}_reused")].as_u64().unwrap_or_else(|| panic!("a count: {summary:#}"))
}

/// A copy of the shared bake with its parts.
fn copy_of_bake(folder: &Path) -> PathBuf {
    let copy = folder.join("dataset");
    dataset::copy(&CITY.dataset, &copy);
    copy
}

/// Bakes the city with a node moved, over the shared bake and from scratch. Returns what the first said.
fn after_moving(name: &str, node: &str, by: [f64; 3]) -> Value {
    let folder = CITY.empty(name);
    let edited = folder.join("city.glb");
    glb::move_node(&CITY.scene, &edited, glb::node_named(&CITY.scene, node), by);
    let over = copy_of_bake(&folder);
    let summary = bake(&edited, &over, TASK_UNITS);
    let scratch = folder.join("scratch");
    let from_scratch = bake(&edited, &scratch, TASK_UNITS);
    assert_eq!(reused(&from_scratch, "cells") + reused(&from_scratch, "segments"), 0);
    assert_eq!(summary["bake_id"], from_scratch["bake_id"]);
    dataset::assert_same_published(&scratch, &over);
    // The next edit starts from parts that are those of a bake from scratch as well.
    let parts = |out: &Path| {
        let bake = from_scratch["bake_id"].as_str().expect("an id");
        let mut parts: Vec<Vec<u8>> =
            dataset::files_below(&out.join("bake").join(bake).join("parts"))
                .into_values()
                .collect();
        parts.sort();
        parts
    };
    assert!(parts(&scratch) == parts(&over), "the same parts");
    summary
}

#[test]
fn what_nobody_sees_moves_for_free() {
    let hidden = after_moving("hidden", "block_0_0/bin_0", [0.1, 0.0, 0.0]);
    let all = hidden["segments"].as_u64().expect("a count");
    assert!(reused(&hidden, "segments") > all / 2, "{hidden:#}");
}

#[test]
fn what_somebody_sees_is_solved_again_where_it_is_seen() {
    for (k, node) in
        ["block_1_1/car_0", "block_0_1/tree_0", "block_1_0/lamp_0", "block_0_0/building_0"]
            .into_iter()
            .enumerate()
    {
        let seen = after_moving(&format!("seen_{k}"), node, [0.5, 0.0, 1.0]);
        assert!(reused(&seen, "cells") <= u64::from(CELLS), "{seen:#}");
    }
}

#[test]
fn a_thing_that_comes_into_view_is_found() {
    // From behind a building onto the street.
    let street = after_moving("into_view", "block_0_0/car_0", [-33.0, 0.0, 20.0]);
    assert!(reused(&street, "cells") < u64::from(CELLS), "{street:#}");
}

#[test]
fn other_tasks_take_over_all_cells() {
    let folder = CITY.empty("other_tasks");
    let over = copy_of_bake(&folder);
    let summary = bake(&CITY.scene, &over, [3, 1]);
    assert_eq!(reused(&summary, "cells"), u64::from(CELLS), "{summary:#}");
    assert_eq!(Some(reused(&summary, "segments")), summary["segments"].as_u64());
    dataset::assert_same_published(&CITY.dataset, &over);
}

#[test]
fn an_earlier_bake_that_is_damaged_is_not_needed() {
    let folder = CITY.empty("damaged");
    let over = copy_of_bake(&folder);
    let files = dataset::files_below(&over).into_keys();
    let parts = files.filter(|file| file.iter().any(|folder| folder == "parts"));
    for (k, part) in parts.enumerate() {
        let path = over.join(part);
        match k % 3 {
            0 => std::fs::remove_file(&path).expect("it can be removed"),
            1 => std::fs::write(&path, "not what was committed").expect("it can be written"),
            _ => {}
        }
    }
    let summary = bake(&CITY.scene, &over, [3, 1]);
    assert!(reused(&summary, "cells") < u64::from(CELLS), "{summary:#}");
    dataset::assert_same_published(&CITY.dataset, &over);
}
