//! Datasets as bytes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::Value;

/// The files below a folder by relative path.
///
/// # Panics
/// When a file cannot be read.
#[must_use]
pub fn files_below(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(at) = open.pop() {
        for entry in std::fs::read_dir(&at).unwrap_or_else(|e| panic!("{}: {e}", at.display())) {
            let path = entry.expect("a folder's entries can be read").path();
            if path.is_dir() {
                open.push(path);
            } else {
                let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{path:?}: {e}"));
                let relative = path.strip_prefix(folder).expect("it is inside").to_owned();
                found.insert(relative, bytes);
            }
        }
    }
    found
}

/// The files of a dataset by relative path. `bake/`, the state of the bake, is no part of it, nor is what
/// a process that was killed had begun to write: until it is whole it has a temporary name, with a `#`.
///
/// # Panics
/// When a file cannot be read.
#[must_use]
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = files_below(folder);
    let is_begun =
        |path: &Path| path.file_name().is_some_and(|name| name.to_string_lossy().contains('#'));
    found.retain(|path, _| !path.starts_with("bake") && !is_begun(path));
    found
}

/// Copies a folder.
///
/// # Panics
/// When something cannot be read or written.
pub fn copy(from: &Path, to: &Path) {
    for (path, bytes) in files_below(from) {
        let path = to.join(path);
        let folder = path.parent().expect("a file is in a folder");
        std::fs::create_dir_all(folder).expect("a folder can be made");
        std::fs::write(path, bytes).expect("a file can be written");
    }
}

/// The manifest that a folder's pointer names, and the files that it names: the dataset that readers see,
/// whatever was published before it.
///
/// # Panics
/// When there is none.
#[must_use]
pub fn published(folder: &Path) -> (Value, BTreeMap<PathBuf, Vec<u8>>) {
    let files = files(folder);
    let json = |path: &str| -> Value {
        serde_json::from_slice(&files[Path::new(path)]).expect("it is JSON")
    };
    let number = json("current.json")["manifest"].as_u64().expect("a number");
    let manifest = json(&format!("manifests/{number:08}.json"));
    let named = |path: &PathBuf| manifest.to_string().contains(&path.display().to_string());
    let files = files.into_iter().filter(|(path, _)| named(path)).collect();
    (manifest, files)
}

/// Panics unless two folders publish the same dataset.
pub fn assert_same_published(one: &Path, other: &Path) {
    let ((a, a_files), (b, b_files)) = (published(one), published(other));
    assert_eq!(a, b, "the same manifest");
    assert!(a_files.len() > 2, "it names files: {a:#}");
    let different: Vec<_> =
        a_files.iter().filter(|(k, v)| b_files.get(*k) != Some(v)).map(|(k, _)| k).collect();
    assert!(different.is_empty(), "files differ: {different:?}");
}

/// Panics with the names of the files that differ between two datasets.
pub fn assert_same(one: &Path, other: &Path) {
    let (a, b) = (files(one), files(other));
    let names = |f: &BTreeMap<PathBuf, Vec<u8>>| f.keys().cloned().collect::<Vec<_>>();
    assert!(a.contains_key(Path::new("current.json")), "{} is published", one.display());
    assert_eq!(names(&a), names(&b), "the same files");
    let different: Vec<_> = a.iter().filter(|(k, v)| b[*k] != **v).map(|(k, _)| k).collect();
    assert!(different.is_empty(), "files differ: {different:?}");
}

/// Number of finished tasks of the bakes in a folder: one commit object each.
#[must_use]
pub fn commits(folder: &Path) -> usize {
    let entries = |p: PathBuf| std::fs::read_dir(p).into_iter().flatten().flatten();
    entries(folder.join("bake"))
        .flat_map(|bake| entries(bake.path().join("commits")))
        // A commit being written has a temporary name.
        .filter(|c| !c.file_name().to_string_lossy().contains('#'))
        .count()
}
