//! Every real file is read, or refused with a named cause; nothing panics or hangs.

mod fixtures;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::mpsc,
    time::Duration,
};

use fixtures::{files_below, open, scenes};
use sightline_scene::SceneError;

/// What became of each file: the name of the cause, or `read`.
fn outcomes(folder: &Path) -> BTreeMap<PathBuf, String> {
    files_below(folder)
        .into_iter()
        .map(|file| {
            let (sender, receiver) = mpsc::channel();
            let path = file.clone();
            std::thread::spawn(move || sender.send(open(&path).map(|_| ())));
            // A panic drops the sender; a hang runs into the limit.
            let outcome = receiver
                .recv_timeout(Duration::from_secs(60))
                .unwrap_or_else(|e| panic!("{}: {e}", file.display()));
            let outcome = match outcome {
                Ok(()) => "read".to_owned(),
                Err(error) => name_of(&error),
            };
            (file.strip_prefix(folder).unwrap().to_path_buf(), outcome)
        })
        .collect()
}

fn name_of(error: &SceneError) -> String {
    assert!(error.help().is_some() && !error.to_string().is_empty());
    let debug = format!("{:?}", error.cause);
    debug.split([' ', '{', '(']).next().unwrap_or_default().to_owned()
}

fn counts(outcomes: &BTreeMap<PathBuf, String>) -> Vec<(String, usize)> {
    let mut counts = BTreeMap::new();
    for outcome in outcomes.values() {
        *counts.entry(outcome.clone()).or_insert(0) += 1;
    }
    counts.into_iter().collect()
}

fn assert_counts(folder: &str, expected: &[(&str, usize)]) {
    let Some(scenes) = scenes() else { return };
    let found = counts(&outcomes(&scenes.join(folder)));
    let found: Vec<(&str, usize)> = found.iter().map(|(n, c)| (n.as_str(), *c)).collect();
    assert_eq!(found, expected, "{folder}");
}

#[test]
fn every_file_for_the_validator_is_read_or_refused_by_name() {
    let expected = [
        ("AccessorType", 2),
        ("AnimatedMatrix", 1),
        ("AnimationConflict", 1),
        ("BufferUri", 2),
        ("BufferWithoutData", 3),
        ("CountMismatch", 1),
        ("GlbTruncated", 6),
        ("GlbVersion", 1),
        ("GlbWithoutJson", 5),
        ("JointNotInScene", 1),
        ("Json", 18),
        ("KeyTime", 6),
        ("KeyValue", 1),
        ("MatrixNotAffine", 1),
        ("MissingBuffer", 2),
        ("NoSuch", 9),
        ("NodeCycle", 1),
        ("NodeWithTwoParents", 1),
        ("RequiredExtension", 1),
        ("TruncatedBuffer", 2),
        ("Version", 4),
        ("read", 303),
    ];
    assert_counts("import/gltf-validator", &expected);
}

#[test]
fn every_file_of_the_asset_generator_is_read_but_unknown_versions_and_extensions() {
    let expected = [("RequiredExtension", 1), ("Version", 1), ("read", 188)];
    assert_counts("import/asset-generator", &expected);
}

#[test]
fn every_other_real_scene_is_read() {
    for folder in [
        "import/compressed",
        "import/draco",
        "import/regressions",
        "animated",
        "instanced",
        "city",
        "indoor",
    ] {
        let Some(scenes) = scenes() else { return };
        for (file, outcome) in outcomes(&scenes.join(folder)) {
            assert_eq!(outcome, "read", "{folder}/{}", file.display());
        }
    }
}

/// What the validator finds no error in is read, but for six files.
#[test]
fn what_the_validator_accepts_is_read() {
    let Some(scenes) = scenes() else { return };
    let folder = scenes.join("import/gltf-validator");
    let mut accepted = 0;
    let mut refused = Vec::new();
    for (file, outcome) in outcomes(&folder) {
        let mut report = folder.join(&file).into_os_string();
        report.push(".report.json");
        let Ok(report) = std::fs::read(report) else { continue };
        let report: serde_json::Value = serde_json::from_slice(&report).unwrap();
        if report["issues"]["numErrors"] == 0 {
            accepted += 1;
            if outcome != "read" {
                refused.push((file.display().to_string(), outcome));
            }
        }
    }
    // Remote buffers are not fetched, and four files only show the structure, without any data: the
    // keys of their animations are all at time zero.
    let expected = [
        ("animation/valid.gltf", "KeyTime"),
        ("asset/min_version_valid.gltf", "Version"),
        ("buffer/non_relative_uri.gltf", "BufferUri"),
        ("root/named_objects.gltf", "BufferWithoutData"),
        ("root/unused_objects.gltf", "BufferWithoutData"),
        ("skin/ignored_animated_transform.gltf", "KeyTime"),
    ];
    let expected = expected.map(|(f, o)| (format!("test/base/data/{f}"), o.to_owned()));
    assert_eq!(refused, expected);
    assert!(accepted > 100, "{accepted}");
}

#[test]
fn counts_of_the_named_scenes_are_as_their_makers_state() {
    let Some(scenes) = scenes() else { return };
    for (file, triangles) in [
        ("city/linz_center_r700m_with_ground.glb", 191_599),
        ("city/rotterdam_center_r900m.glb", 66_400),
        ("indoor/hospital_three_floors.glb", 435_855),
        ("indoor/hospital_three_floors_gpuinst.glb", 435_855),
        ("indoor/lq_e1m1.glb", 38_909),
        ("instanced/24_gpu_instancing/24_gpu_instancing.gltf", 7_656_770),
    ] {
        let scene = open(&scenes.join(file)).unwrap();
        let g = &scene.geometry;
        let dropped: u64 = scene
            .report
            .degenerate
            .iter()
            .map(|d| {
                let mesh = g.instances.iter().zip(&scene.instances).filter(|(i, s)| {
                    scene.meshes[i.mesh.index()].mesh == d.mesh && s.primitive == d.primitive
                });
                d.count * mesh.count() as u64
            })
            .sum();
        assert_eq!(scene.report.instanced_triangles + dropped, triangles, "{file}");
    }
}
