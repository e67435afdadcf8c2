//! What Sightline promises of scenes that move and of larger units than triangles, kept by the real
//! commands on small generated scenes.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use serde_json::Value;
use sightline_geometry::PrimitiveSet;
use sightline_store::{BakeStore, Dataset};
use sightline_tests::binaries::sightline;
use sightline_tests::{city, process};

/// Longest time for one command.
const LIMIT: Duration = Duration::from_secs(300);

/// An empty folder of one test.
fn empty(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("moving").join(name);
    // Left over from the last run of the tests, or not there.
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).expect("a folder can be made");
    folder
}

fn run(command: &mut Command) -> process::Ended {
    process::run(command, LIMIT)
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is a number"))
}

fn bake(scene: &Path, out: &Path, flags: &[&str]) -> Value {
    run(sightline(["bake", "--json"]).args(flags).arg("--out").arg(out).arg(scene)).success().json()
}

/// Fails unless random viewpoints, at random times where something moves, have at most 0.02 % of their
/// pixels wrong.
fn assert_promise(dataset: &Path) {
    let mut verify = sightline(["verify", "--json", "--viewpoints=8", "--rays=20000"]);
    let found = run(verify.arg("--max-mean=0.0002").arg(dataset)).success().json();
    assert!(number(&found["error_mean"]) <= 0.0002, "{found:#}");
}

fn dataset<R>(folder: &Path, read: impl AsyncFnOnce(Dataset) -> R) -> R {
    let runtime = tokio::runtime::Runtime::new().expect("a runtime starts");
    runtime.block_on(async {
        let store = BakeStore::open(&folder.display().to_string()).expect("the store opens");
        read(Dataset::open(&store).await.expect("the dataset opens")).await
    })
}

#[test]
fn particles_are_baked_verified_and_exported_by_state() {
    let folder = empty("spheres");
    let (scene, out) = (folder.join("spheres.parquet"), folder.join("baked"));
    let mut generate =
        sightline(["generate", "bouncing-spheres", "--count=600", "--states=6", "-o"]);
    let _ = run(generate.arg(&scene)).success();
    // Two states a task: the ranges of a cell are joined.
    let flags = [
        "--region=-2,-2,2,2",
        "--cell-size=4",
        "--heights=absolute",
        "--eye-height=0.9,0.9",
        "--states-per-task=2",
    ];
    let summary = bake(&scene, &out, &flags);
    assert_eq!(number(&summary["cells"]), 1.0, "{summary:#}");
    assert_promise(&out);

    let info = run(sightline(["info", "--json", "--cell=0"]).arg(&out)).success().json();
    let runs = info["states"].as_array().expect("a list");
    assert!(runs.len() > 1, "what moves is seen in some states only: {info:#}");
    let particles = |how: &[&str]| {
        let glb = folder.join("cell.glb");
        let mut export = sightline(["export", "--json", "--cell=0", "-o"]);
        let said = run(export.arg(&glb).args(how).arg(&out)).success().json();
        number(&said["particles"])
    };
    let in_any = number(&info["visible_primitives"]);
    for run in runs {
        let state = format!("--state={}", run["first_state"]);
        let exported = particles(&[&state]);
        assert_eq!(exported, number(&run["visible_primitives"]), "{run}");
        assert!(exported < in_any, "{run}");
    }
    assert!(particles(&["--time=1e9"]) > 0.0, "after the end it stays as it is");
    let mut export = sightline(["export", "--cell=0", "--state=6", "-o"]);
    let refused = run(export.arg(folder.join("none.glb")).arg(&out)).failure(2);
    assert!(refused.stderr.contains("states 0 to 5"), "{}", refused.stderr);
}

#[test]
fn swaying_grass_is_baked_and_verified() {
    let folder = empty("grass");
    let (scene, out) = (folder.join("grass.glb"), folder.join("baked"));
    let mut generate =
        sightline(["generate", "swaying-grass", "--triangles=60k", "--states=3", "-o"]);
    let _ = run(generate.arg(&scene)).success();
    let flags = ["--region=-0.5,-0.5,0.5,0.5", "--cell-size=1", "--heights=absolute"];
    let summary = bake(&scene, &out, &flags);
    assert_eq!(number(&summary["cells"]), 1.0, "{summary:#}");
    assert_promise(&out);
}

/// The sets of all cells.
fn sets(folder: &Path) -> Vec<PrimitiveSet> {
    dataset(folder, async |dataset| {
        let mut sets = Vec::new();
        for entry in dataset.cells() {
            sets.push(dataset.cell(entry.cell.id).await.expect("a cell can be read").set);
        }
        sets
    })
}

#[test]
fn larger_units_are_seen_whole_and_take_less() {
    let folder = empty("units");
    let scene = folder.join("city.glb");
    city::generate(&scene, 7);
    let flags = ["--region=-5,-10,5,10", "--cell-size=5"];
    let baked = ["triangle", "cluster", "object"].map(|granularity| {
        let out = folder.join(granularity);
        let units = format!("--granularity={granularity}");
        let summary = bake(&scene, &out, &[&flags[..], &[&units]].concat());
        assert_promise(&out);
        (sets(&out), number(&summary["summary"]["solver_rays"]))
    });
    let [(triangles, many), (clusters, fewer), (objects, fewest)] = &baked;
    assert!(fewest < fewer && fewer < many, "rays: {many}, {fewer}, {fewest}");
    let sum = |sets: &[PrimitiveSet]| sets.iter().map(PrimitiveSet::len).sum::<u64>();
    assert!(sum(triangles) < sum(clusters) && sum(clusters) < sum(objects));
    // Objects are seen with all of their triangles.
    let ranges = dataset(&folder.join("object"), async |dataset| {
        let objects = dataset.objects().await.expect("the objects can be read");
        objects.iter().map(|o| o.first_primitive..o.end_primitive).collect::<Vec<_>>()
    });
    for set in objects {
        for range in &ranges {
            let seen = set.count_in(range.clone());
            assert!([0, u64::from(range.end - range.start)].contains(&seen), "{range:?}: {seen}");
        }
    }
}

#[test]
fn a_granularity_that_does_not_exist_is_refused_with_those_that_do() {
    let folder = empty("refused");
    let scene = folder.join("city.glb");
    city::generate(&scene, 7);
    let mut bake = sightline(["bake", "--region=0,0,5,5", "--granularity=mesh", "--out"]);
    let refused = run(bake.arg(folder.join("baked")).arg(&scene)).failure(2);
    for name in ["granularity", "triangle", "cluster", "object"] {
        assert!(refused.stderr.contains(name), "{}", refused.stderr);
    }
}
