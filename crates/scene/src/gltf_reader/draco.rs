//! KHR_draco_mesh_compression: positions and triangles of one compressed primitive.
//!
//! Source: the extension's specification; the Draco bitstream through `draco-core`, which is
//! pure Rust without unsafe code and checks its reservations against the input. A panic in it
//! would be a bug of its own; it is caught and reported as data that does not decode.

use std::{
    collections::BTreeMap,
    panic::{AssertUnwindSafe, catch_unwind},
};

use draco_core::{DecodeLimits, DecoderBuffer, Mesh, MeshDecoder};
use serde::Deserialize;

use crate::{Cause, SceneError};

/// Name of the extension.
pub const NAME: &str = "KHR_draco_mesh_compression";

/// Bytes that one primitive may decode to for each compressed byte, and in any case: coarse
/// bounds for what a real mesh needs, so that a few bytes cannot claim all memory.
const MAX_EXPANSION: u64 = 4096;
const ALWAYS_ALLOWED: u64 = 1 << 20;
const NEVER_ALLOWED: u64 = 8 << 30;

/// The object of the extension on a primitive.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct DracoPrimitive {
    pub buffer_view: u32,
    #[serde(default)]
    pub attributes: BTreeMap<String, u32>,
}

/// Vertex positions, and vertex indices a triangle, not yet checked against them.
pub struct Decoded {
    pub positions: Vec<[f32; 3]>,
    pub triangles: Vec<[u32; 3]>,
    /// Other attributes, of four numbers a vertex.
    pub others: Vec<Vec<[f32; 4]>>,
}

/// Decodes vertex positions, triangles, and other attributes of four numbers. `position` and `others`
/// are the unique ids of the attributes.
pub fn decode(source: &[u8], position: u32, others: &[u32]) -> Result<Decoded, SceneError> {
    catch_unwind(AssertUnwindSafe(|| decode_unguarded(source, position, others)))
        .unwrap_or_else(|_| Err("the decoder failed".into()))
        .map_err(|reason| Cause::Draco { reason }.into())
}

fn decode_unguarded(source: &[u8], position: u32, others: &[u32]) -> Result<Decoded, String> {
    let bytes = (source.len() as u64 * MAX_EXPANSION).clamp(ALWAYS_ALLOWED, NEVER_ALLOWED);
    let limits = DecodeLimits::default()
        .with_max_points(bytes / 12)
        .with_max_faces(bytes / 12)
        .with_max_decoded_bytes(bytes);
    let mut mesh = Mesh::new();
    MeshDecoder::new()
        .decode(&mut DecoderBuffer::new(source).with_limits(limits), &mut mesh)
        .map_err(|e| e.to_string())?;
    let attribute = mesh
        .attribute_by_unique_id(position)
        .ok_or_else(|| format!("there is no attribute {position} for POSITION"))?;
    if attribute.num_components() != 3 {
        return Err(format!("POSITION has {} components", attribute.num_components()));
    }
    let positions = attribute.read_f32s(mesh.num_points(), 3);
    let positions = positions.as_chunks::<3>().0.to_vec();
    let triangles = mesh.faces().iter().map(|f| f.map(|p| p.0)).collect();
    let four = |&id: &u32| {
        let attribute = mesh
            .attribute_by_unique_id(id)
            .filter(|a| a.num_components() == 4)
            .ok_or_else(|| format!("there is no attribute {id} of four numbers"))?;
        Ok(attribute.read_f32s(mesh.num_points(), 4).as_chunks::<4>().0.to_vec())
    };
    let others = others.iter().map(four).collect::<Result<_, String>>()?;
    Ok(Decoded { positions, triangles, others })
}
