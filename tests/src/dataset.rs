//! Datasets as bytes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The files of a dataset by relative path. `bake/`, the state of the bake, is no part of it, nor is what
/// a process that was killed had begun to write: until it is whole it has a temporary name, with a `#`.
///
/// # Panics
/// When a file cannot be read.
#[must_use]
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(at) = open.pop() {
        for entry in std::fs::read_dir(&at).unwrap_or_else(|e| panic!("{}: {e}", at.display())) {
            let entry = entry.expect("a folder's entries can be read");
            let path = entry.path();
            let relative = path.strip_prefix(folder).expect("it is inside").to_owned();
            let is_begun = entry.file_name().to_string_lossy().contains('#');
            if is_begun || relative == Path::new("bake") {
                continue;
            }
            if path.is_dir() {
                open.push(path);
            } else {
                let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{path:?}: {e}"));
                found.insert(relative, bytes);
            }
        }
    }
    found
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
