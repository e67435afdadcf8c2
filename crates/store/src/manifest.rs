//! The manifest and the pointer: what a dataset consists of, as JSON.
//!
//! A manifest is a function of scene and configuration (ST-1): it holds no clock reading, host or
//! absolute path, and not even its own number, so a second bake of the same input publishes
//! nothing new. Format: `schemas/dataset-v3.md`.

use std::collections::BTreeMap;

use bytes::Bytes;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sightline_geometry::Bounds;

use crate::{Result, StoreError, keys};

/// Name of the dataset format.
pub const FORMAT: &str = "sightline-dataset";
/// Version of the dataset format that this crate writes. Those before it are read, too.
pub const VERSION: u32 = 3;
/// Name of the pointer's format; it shares the dataset's version.
const POINTER_FORMAT: &str = "sightline-pointer";

/// What a dataset consists of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Always [`FORMAT`].
    pub format: String,
    /// [`VERSION`], or an earlier one in a dataset that was written then.
    pub version: u32,
    /// The scene that was baked.
    pub scene: SceneSource,
    /// The configuration, keys sorted.
    pub config: Value,
    /// Hash of the configuration, as the bake computed it.
    pub config_hash: String,
    /// Number of states; 1 before version 3.
    #[serde(default = "one")]
    pub states: u32,
    /// Times of the key frames, seconds: one more than there are states, or a single one for a scene at
    /// rest.
    #[serde(default = "at_rest")]
    pub key_times: Vec<f64>,
    /// Number of cells with a set.
    pub cells: u64,
    /// Cells without a set, by reason.
    pub skipped: BTreeMap<String, u64>,
    /// Sums over all rows.
    pub totals: Totals,
    /// Box around all cells, world space; absent when there are none.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub bounds: Option<BoxRecord>,
    /// The files, by kind, in cell order.
    pub files: Vec<DataFile>,
}

const fn one() -> u32 {
    1
}

fn at_rest() -> Vec<f64> {
    vec![0.0]
}

/// The scene that a dataset belongs to.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneSource {
    /// Name of the scene's main file, without its folder.
    pub uri: String,
    /// Hash over all files of the scene, as the reader computed it.
    pub hash: String,
    /// Number of triangles; primitives from this number on are particles.
    pub triangles: u64,
    /// Number of particles; 0 before version 3.
    #[serde(default)]
    pub particles: u64,
    /// Number of particle systems, which are the last objects; 0 before version 3.
    #[serde(default)]
    pub particle_systems: u64,
    /// Number of objects.
    pub objects: u64,
    /// The files of the scene.
    pub files: Vec<SceneFile>,
}

impl SceneSource {
    /// Number of primitives: triangles and particles.
    #[must_use]
    pub const fn primitives(&self) -> u64 {
        self.triangles.saturating_add(self.particles)
    }
}

/// A file of the scene.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneFile {
    /// Name, relative to the main file.
    pub name: String,
    /// Size, bytes.
    pub bytes: u64,
    /// BLAKE3 hash, hexadecimal.
    pub blake3: String,
}

/// Sums over all rows of a dataset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Totals {
    /// Rows of cells: one a cell, and one a run of states where there are several; 0 before version 3.
    #[serde(default)]
    pub cell_rows: u64,
    /// Members of the sets of all rows.
    pub primitives: u64,
    /// Encoded bytes of all sets, before compression.
    pub set_bytes: u64,
    /// (cell, object) rows.
    pub object_rows: u64,
    /// Bytes of all files.
    pub file_bytes: u64,
}

/// An axis-aligned box, metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BoxRecord {
    /// Lower corner.
    pub min: [f64; 3],
    /// Upper corner.
    pub max: [f64; 3],
}

impl From<Bounds> for BoxRecord {
    fn from(bounds: Bounds) -> Self {
        Self { min: bounds.min.to_array(), max: bounds.max.to_array() }
    }
}

/// What a data file holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FileKind {
    /// One row a cell and run of states, with its set.
    Cells,
    /// One row a (cell, object).
    Objects,
    /// One row a row of cells: where it lies.
    Index,
    /// One row an object.
    Scene,
    /// One row an instance.
    Numbering,
    /// One row a mesh, or a stretch of one.
    Meshes,
}

impl FileKind {
    /// The name in keys and manifests.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Cells => "cells",
            Self::Objects => "objects",
            Self::Index => "index",
            Self::Scene => "scene",
            Self::Numbering => "numbering",
            Self::Meshes => "meshes",
        }
    }
}

/// A file of the dataset.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DataFile {
    /// Key, relative to the dataset.
    pub name: String,
    /// What it holds.
    pub kind: FileKind,
    /// Size, bytes.
    pub bytes: u64,
    /// BLAKE3 hash, hexadecimal.
    pub blake3: String,
    /// Bytes at the end of the file that hold its page index and footer: what a reader of single
    /// rows fetches first.
    pub footer_bytes: u64,
    /// BLAKE3 hash of these bytes, hexadecimal.
    pub footer_blake3: String,
    /// Number of rows.
    pub rows: u64,
    /// First cell in the file, for the kinds that hold cells.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub first_cell: Option<u32>,
    /// Last cell in the file.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub last_cell: Option<u32>,
}

/// The pointer to the current manifest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pointer {
    /// Always `sightline-pointer`.
    pub format: String,
    /// [`VERSION`], or an earlier one in a dataset that was written then.
    pub version: u32,
    /// Number of the manifest.
    pub manifest: u64,
    /// BLAKE3 hash of the manifest's bytes, hexadecimal.
    pub blake3: String,
}

impl Manifest {
    /// The manifest's bytes: indented JSON with fields in a fixed order.
    #[must_use]
    pub fn to_bytes(&self) -> Bytes {
        let mut json = serde_json::to_vec_pretty(self).expect("a manifest is plain data");
        json.push(b'\n');
        json.into()
    }

    pub(crate) fn from_bytes(file: &str, bytes: &[u8]) -> Result<Self> {
        parse(file, bytes, FORMAT)
    }

    /// The files of one kind, in cell order.
    pub fn files_of(&self, kind: FileKind) -> impl Iterator<Item = &DataFile> {
        self.files.iter().filter(move |f| f.kind == kind)
    }
}

impl Pointer {
    pub(crate) fn to(number: u64, manifest: &[u8]) -> Self {
        Self {
            format: POINTER_FORMAT.into(),
            version: VERSION,
            manifest: number,
            blake3: hash(manifest),
        }
    }

    pub(crate) fn to_bytes(&self) -> Bytes {
        let mut json = serde_json::to_vec(self).expect("a pointer is plain data");
        json.push(b'\n');
        json.into()
    }

    pub(crate) fn from_bytes(bytes: &[u8]) -> Result<Self> {
        parse(keys::POINTER, bytes, POINTER_FORMAT)
    }
}

/// BLAKE3 of `bytes`, 64 hexadecimal digits.
pub(crate) fn hash(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex().to_string()
}

/// Parses JSON of one of our formats: first the format and its version, then the rest.
fn parse<T: DeserializeOwned>(file: &str, bytes: &[u8], format: &str) -> Result<T> {
    let value: Value = serde_json::from_slice(bytes).map_err(|e| StoreError::corrupt(file, e))?;
    if value["format"] != format {
        return Err(StoreError::corrupt(file, format!("its format is not `{format}`")));
    }
    match value["version"].as_u64() {
        Some(found) if (1..=u64::from(VERSION)).contains(&found) => {}
        Some(found) => {
            let (file, supported) = (file.into(), VERSION);
            return Err(StoreError::UnsupportedVersion { file, found, supported });
        }
        None => return Err(StoreError::corrupt(file, "it names no version")),
    }
    serde_json::from_value(value).map_err(|e| StoreError::corrupt(file, e))
}

/// The same value with all object keys sorted, whatever map the JSON library was built with.
pub(crate) fn sorted(value: &Value) -> Value {
    match value {
        Value::Object(map) => {
            let sorted: BTreeMap<&String, Value> =
                map.iter().map(|(key, value)| (key, self::sorted(value))).collect();
            Value::Object(sorted.into_iter().map(|(key, value)| (key.clone(), value)).collect())
        }
        Value::Array(items) => Value::Array(items.iter().map(sorted).collect()),
        other => other.clone(),
    }
}
