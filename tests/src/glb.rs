//! Edits of binary glTF files, as an author would make them in a modelling program.

use std::path::Path;

use serde_json::{Value, json};

/// Bytes before the JSON text: the header of the file and of its first chunk.
const HEADERS: usize = 20;

/// The JSON of a binary glTF file.
///
/// # Panics
/// When the file is none.
#[must_use]
pub fn document(scene: &Path) -> Value {
    let bytes = std::fs::read(scene).expect("the scene can be read");
    let (json, _) = split(&bytes);
    serde_json::from_slice(json).expect("a glTF file has JSON")
}

/// Number of the node with a name.
///
/// # Panics
/// When there is none.
#[must_use]
pub fn node_named(scene: &Path, name: &str) -> usize {
    let document = document(scene);
    let mut nodes = document["nodes"].as_array().expect("it has nodes").iter();
    nodes.position(|node| node["name"] == name).unwrap_or_else(|| panic!("no node is {name}"))
}

/// Writes a copy of a scene in which a node stands elsewhere, by so many metres along x, y and z.
///
/// # Panics
/// When the scene cannot be read, the copy cannot be written, or the node has a matrix.
pub fn move_node(scene: &Path, copy: &Path, node: usize, by: [f64; 3]) {
    let bytes = std::fs::read(scene).expect("the scene can be read");
    let (json, rest) = split(&bytes);
    let mut document: Value = serde_json::from_slice(json).expect("a glTF file has JSON");
    let node = &mut document["nodes"][node];
    assert!(node.is_object() && node["matrix"].is_null(), "a node with a translation: {node}");
    let moved: Vec<f64> =
        (0..3).map(|k| node["translation"][k].as_f64().unwrap_or(0.0) + by[k]).collect();
    node["translation"] = json!(moved);
    let mut text = serde_json::to_vec(&document).expect("a value is JSON");
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = |bytes: usize| u32::try_from(bytes).expect("a small file").to_le_bytes();
    let mut out = bytes[..8].to_vec();
    out.extend(length(HEADERS + text.len() + rest.len()));
    out.extend(length(text.len()));
    out.extend(b"JSON");
    out.extend(text);
    out.extend(rest);
    std::fs::write(copy, out).expect("the copy can be written");
}

/// The JSON, and the chunks behind it.
fn split(bytes: &[u8]) -> (&[u8], &[u8]) {
    assert!(bytes.starts_with(b"glTF"), "a binary glTF file");
    let length = u32::from_le_bytes(bytes[12..16].try_into().expect("four bytes")) as usize;
    bytes[HEADERS..].split_at(length)
}
