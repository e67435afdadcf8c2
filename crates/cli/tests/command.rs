//! The command as its users meet it: arguments, errors, exit codes, JSON.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

fn sightline(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sightline"))
        .args(arguments)
        .env_remove("RUST_LOG")
        .output()
        .expect("the command runs")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn json(output: &Output) -> Value {
    let text = stdout(output);
    assert_eq!(text.lines().count(), 1, "one object: {text}");
    serde_json::from_str(&text).expect("JSON on stdout")
}

fn path(path: &Path) -> &str {
    path.to_str().expect("test folders have plain names")
}

fn city(folder: &Path) -> std::path::PathBuf {
    let scene = folder.join("city.glb");
    let made =
        sightline(&["generate", "city", "--triangles", "20k", "--seed", "3", "-o", path(&scene)]);
    assert!(made.status.success(), "{}", stderr(&made));
    scene
}

#[test]
fn help_lists_the_commands_and_the_exit_codes() {
    let help = stdout(&sightline(&["--help"]));
    let commands =
        ["generate", "bake", "coordinator", "worker", "verify", "export", "info", "cell", "demo"];
    for command in commands {
        assert!(help.contains(&format!("\n  {command}")), "{command}: {help}");
    }
    assert!(help.contains("Exit codes:") && help.contains("130"));
}

#[test]
fn an_unknown_flag_is_suggested() {
    let output = sightline(&["bake", "x.glb", "--out", "d", "--cel-size", "5"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("--cell-size"), "{}", stderr(&output));
}

#[test]
fn an_unknown_configuration_key_is_suggested() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("bake.toml");
    std::fs::write(&config, "[region]\ncell_sise = 5\n").unwrap();
    let output = sightline(&["bake", "x.glb", "--out", "d", "--config", path(&config), "--json"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("did you mean `region.cell_size`"), "{}", stderr(&output));
    let error = &json(&output)["error"];
    assert_eq!((error["kind"].as_str(), error["exit_code"].as_u64()), (Some("usage"), Some(2)));
}

#[test]
fn missing_files_are_named() {
    for arguments in [
        &["info", "no-such.glb"][..],
        &["bake", "no-such.glb", "--out", "no-such-dir", "--region=0,0,1,1"],
        &["verify", "no-such-dataset"],
        &["cell", "no-such-dataset", "--at=0,0,0"],
    ] {
        let output = sightline(arguments);
        assert_eq!(output.status.code(), Some(3), "{arguments:?}: {}", stderr(&output));
        assert!(stderr(&output).contains("no-such"), "{}", stderr(&output));
        assert!(stdout(&output).is_empty());
    }
    assert!(!Path::new("no-such-dir").exists(), "a refused bake makes no folder");
    let output =
        sightline(&["bake", "x.glb", "--out", "d", "--config", "no-such.toml", "--region=0,0,1,1"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("no-such.toml"));
}

#[test]
fn generated_scenes_are_the_same_twice_and_described() {
    let folder = tempfile::tempdir().unwrap();
    let first = std::fs::read(city(folder.path())).unwrap();
    let scene = city(folder.path());
    assert!(first == std::fs::read(&scene).unwrap(), "the same bytes");

    let info = json(&sightline(&["info", path(&scene), "--json"]));
    assert_eq!(info["kind"], "scene");
    let triangles = info["report"]["instanced_triangles"].as_u64().unwrap();
    assert!((19_600..=20_400).contains(&triangles), "{triangles}");
    assert_eq!(info["objects"].as_array().unwrap().len() as u64, info["report"]["objects"]);

    let text = stdout(&sightline(&["info", path(&scene), "--limit", "2"]));
    assert!(text.contains("triangles") && text.contains("more objects"), "{text}");
}

#[test]
fn a_size_out_of_range_is_refused() {
    let output = sightline(&["generate", "city", "--triangles", "7", "-o", "never.glb"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(!Path::new("never.glb").exists());
}

#[test]
fn a_small_city_is_baked_verified_queried_and_exported() {
    let folder = tempfile::tempdir().unwrap();
    let scene = city(folder.path());
    let out = folder.path().join("visible");
    let bake = |extra: &[&str]| {
        let base = ["bake", path(&scene), "--out", path(&out), "--region=-4,-4,4,4"];
        let more = ["--cell-size", "4", "--rows", "64", "--rounds", "1"];
        let all: Vec<&str> = base.iter().chain(&more).chain(extra).copied().collect();
        sightline(&all)
    };

    let plan = json(&bake(&["--dry-run", "--json"]));
    assert_eq!(plan["cells"], 4);
    assert!(!out.exists(), "a dry run writes nothing");

    let first = bake(&["--json"]);
    assert!(first.status.success(), "{}", stderr(&first));
    let first = json(&first);
    assert_eq!((&first["cells"], &first["changed"]), (&4.into(), &true.into()));
    assert_eq!(first["bake_id"], plan["bake_id"]);

    let again = bake(&["--json"]);
    assert!(stderr(&again).contains("going on with it"), "{}", stderr(&again));
    let again = json(&again);
    assert_eq!((&again["manifest"], &again["changed"]), (&first["manifest"], &false.into()));

    // Found where it was baked, measured, and the worst viewpoint measured again.
    let verified = sightline(&["verify", path(&out), "--rays", "20k", "--json"]);
    assert!(verified.status.success(), "{}", stderr(&verified));
    let verified = json(&verified);
    assert_eq!(verified["viewpoints"], 40);
    assert!(verified["error_mean"].as_f64().unwrap() < 0.01, "{verified}");
    let command = verified["worst"]["command"].as_str().unwrap().to_owned();
    let arguments: Vec<&str> = command.split(' ').skip(1).chain(["--json"]).collect();
    let repeated = json(&sightline(&arguments));
    assert_eq!(repeated["worst"]["wrong"], verified["worst"]["wrong"], "{command}");
    let limited = sightline(&["verify", path(&out), "--rays", "1k", "--max-mean=-1", "--json"]);
    assert_eq!(limited.status.code(), Some(1));
    assert_eq!(json(&limited)["exceeded"].as_array().unwrap().len(), 1);

    let info = json(&sightline(&["info", path(&out), "--json"]));
    assert_eq!((&info["kind"], &info["summary"]["cells"]), (&"dataset".into(), &4.into()));
    let cell = json(&sightline(&["info", path(&out), "--cell", "2", "--json"]));
    assert!(cell["visible_primitives"].as_u64().unwrap() > 0);
    let corner = &cell["corners"][0];
    let at = format!(
        "--at={},{},{}",
        0.1 + corner[0].as_f64().unwrap(),
        corner[1],
        0.1 + corner[2].as_f64().unwrap()
    );
    assert_eq!(stdout(&sightline(&["cell", path(&out), &at])), "2\n");
    let nowhere = sightline(&["cell", path(&out), "--at=500,0,0", "--json"]);
    assert_eq!(nowhere.status.code(), Some(1));
    assert!(json(&nowhere)["nearest"]["distance"].as_f64().unwrap() > 400.0);

    let exported = folder.path().join("cell.glb");
    let export = sightline(&["export", path(&out), "--cell", "2", "-o", path(&exported), "--json"]);
    assert!(export.status.success(), "{}", stderr(&export));
    let described = json(&sightline(&["info", path(&exported), "--json"]));
    assert_eq!(described["report"]["instanced_triangles"], cell["visible_primitives"]);

    // Another configuration is another bake, and the command says why.
    let other = bake(&["--rows", "32", "--json"]);
    assert_eq!(other.status.code(), Some(2), "a flag given twice");
    let other = sightline(&[
        "bake",
        path(&scene),
        "--out",
        path(&out),
        "--region=-4,-4,4,4",
        "--cell-size",
        "4",
        "--rows",
        "32",
        "--rounds",
        "1",
        "--json",
    ]);
    assert!(stderr(&other).contains("solver.rows changed from 64 to 32"), "{}", stderr(&other));
    assert_eq!(json(&other)["changed"], true);
}
