//! What a scene is made of, as hashes: two scenes with the same digest hold the same bytes.
//!
//! The digest covers the main file and every external buffer, in the order of `buffers`, each
//! once, and then every particle table, in the order of the options, under its file name without
//! folders. Images are left out: they do not change geometry. Buffers that are marked as the
//! fallback of a compression extension count when their file is there.
//!
//! `combined` is the BLAKE3 hash over, for each file, the length of its name (8 bytes, little
//! endian), its name, its size (8 bytes, little endian) and its BLAKE3 hash (32 bytes).

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::{SceneError, gltf_reader, particles};

/// Hash of one file of a scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileDigest {
    /// Path relative to the folder of the main file, `/` between its parts; the name alone for
    /// particle tables.
    pub name: String,
    /// Size in bytes.
    pub size: u64,
    /// BLAKE3 hash, 64 hexadecimal digits.
    pub blake3: String,
}

/// Hashes of the files of a scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneDigest {
    /// The files, the main file first.
    pub files: Vec<FileDigest>,
    /// BLAKE3 hash over the list, 64 hexadecimal digits.
    pub combined: String,
}

impl SceneDigest {
    pub(crate) fn of_files(files: Vec<(String, u64, blake3::Hash)>) -> Self {
        let mut combined = blake3::Hasher::new();
        for (name, size, hash) in &files {
            combined.update(&(name.len() as u64).to_le_bytes());
            combined.update(name.as_bytes());
            combined.update(&size.to_le_bytes());
            combined.update(hash.as_bytes());
        }
        let files = files
            .into_iter()
            .map(|(name, size, hash)| FileDigest { name, size, blake3: hash.to_hex().to_string() })
            .collect();
        Self { files, combined: combined.finalize().to_hex().to_string() }
    }
}

/// The files that the buffers of the glTF file at `path` name, relative to its folder: what a bake reads
/// of a scene besides the main file and particle tables.
///
/// # Errors
/// When the main file cannot be read or its JSON is invalid.
pub fn external_buffers(path: &Path) -> Result<Vec<String>, SceneError> {
    gltf_reader::external_buffers(path).map_err(|e| e.in_file(path))
}

/// Hashes a scene without reading its geometry; equal to the digest of [`crate::Scene::open`].
///
/// # Errors
/// When the main file or an external buffer cannot be read or the JSON is invalid.
pub fn digest(path: &Path) -> Result<SceneDigest, SceneError> {
    digest_with(path, &[])
}

/// As [`digest`], for a scene that is opened with the particle tables `tables` added.
///
/// # Errors
/// As [`digest`]; when a table cannot be read.
pub fn digest_with(path: &Path, tables: &[PathBuf]) -> Result<SceneDigest, SceneError> {
    let mut files = if particles::is_table(path) {
        particles::files(&[path.to_path_buf()])?
    } else {
        gltf_reader::files(path).map_err(|e| e.in_file(path))?
    };
    files.extend(particles::files(tables)?);
    Ok(SceneDigest::of_files(files))
}
