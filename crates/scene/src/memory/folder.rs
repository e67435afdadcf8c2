//! The folder of the chunk files: `KEY.chunks`, the key being 64 hexadecimal digits.
//!
//! Files are found by what they were made from, so any number of processes share the folder: two that
//! need the same file at the same time make it twice, and the second one replaces the first by an equal
//! one. The time of a file's last change is that of its last use; when the folder holds more than it
//! may, the files that were not used for longest go.

use std::{
    fs, io,
    path::{Path, PathBuf},
    time::SystemTime,
};

/// Ending of a chunk file's name.
pub const ENDING: &str = "chunks";

/// Where chunk files are when nobody says: `sightline` in the user's folder for caches, or in that for
/// temporary files.
#[must_use]
pub fn default_folder() -> PathBuf {
    let named = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    named("XDG_CACHE_HOME")
        .filter(|folder| folder.is_absolute())
        .or_else(|| Some(named("HOME")?.join(".cache")))
        .unwrap_or_else(std::env::temp_dir)
        .join("sightline")
}

/// The chunk file of a key.
pub fn file_of(folder: &Path, key: &blake3::Hash) -> PathBuf {
    folder.join(format!("{}.{ENDING}", key.to_hex()))
}

/// Says that a file was used now. That it cannot be said matters to nobody but who cleans up.
pub fn touch(file: &fs::File) {
    let _ = file.set_modified(SystemTime::now());
}

/// Removes the files that were not used for longest, but not `keep`, until the others fit into
/// `most` bytes with it.
pub fn prune(folder: &Path, keep: &Path, most: u64) -> io::Result<()> {
    let mut files = Vec::new();
    let mut total = 0u64;
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.extension().is_none_or(|e| e != ENDING) {
            continue;
        }
        // Another process may remove files too.
        let Ok(metadata) = fs::metadata(&path) else { continue };
        total += metadata.len();
        if path != keep {
            files.push((
                metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH),
                path,
                metadata.len(),
            ));
        }
    }
    files.sort();
    for (_, path, bytes) in files {
        if total <= most {
            break;
        }
        match fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => total -= bytes,
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn what_was_not_used_for_longest_goes_first() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str, age: u64| {
            let path = folder.path().join(name);
            fs::write(&path, [0; 100]).unwrap();
            let file = fs::OpenOptions::new().write(true).open(&path).unwrap();
            file.set_modified(SystemTime::now() - Duration::from_secs(age)).unwrap();
            path
        };
        let (old, older) = (file("a.chunks", 100), file("b.chunks", 200));
        let (kept, other) = (file("c.chunks", 900), file("notes.txt", 999));
        touch(&fs::OpenOptions::new().write(true).open(&old).unwrap());
        prune(folder.path(), &kept, 300).unwrap();
        assert!([&old, &older, &kept, &other].iter().all(|p| p.exists()), "all fit");
        prune(folder.path(), &kept, 200).unwrap();
        assert_eq!([&old, &older, &kept, &other].map(|p| p.exists()), [true, false, true, true]);
        prune(folder.path(), &kept, 0).unwrap();
        assert_eq!([&old, &kept, &other].map(|p| p.exists()), [false, true, true]);
    }
}
