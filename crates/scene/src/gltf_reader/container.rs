//! The GLB container: a 12-byte header and chunks. Anything else is taken for JSON.
//!
//! Layout (little endian): magic `glTF`, version 2, total length; then for each chunk its
//! length, its type and its bytes. The first chunk is JSON; the next, if it is `BIN\0`, is the
//! first buffer; chunks of other types are ignored, as the specification asks.

use std::{fs::File, io::Read, path::Path};

use crate::{Cause, SceneError};

const MAGIC: &[u8] = b"glTF";
const JSON: u32 = u32::from_le_bytes(*b"JSON");
const BINARY: u32 = u32::from_le_bytes(*b"BIN\0");

/// The parts of a main file.
pub struct Parts<'a> {
    /// The JSON text.
    pub json: &'a [u8],
    /// The binary chunk of a GLB file.
    pub binary: Option<&'a [u8]>,
}

/// Splits a main file.
pub fn split(file: &[u8]) -> Result<Parts<'_>, SceneError> {
    if !file.starts_with(MAGIC) {
        return Ok(Parts { json: file, binary: None });
    }
    let (header, mut rest) = take(file, 12, "the header")?;
    let version = word(header, 4);
    if version != 2 {
        return Err(Cause::GlbVersion { version }.into());
    }
    let stated = u64::from(word(header, 8));
    if stated > file.len() as u64 {
        let what = "the file by its header";
        let available = file.len() as u64;
        return Err(Cause::GlbTruncated { what, needed: stated, available }.into());
    }
    // Bytes behind the stated length are no part of the container.
    rest = &rest[..(stated.saturating_sub(12) as usize).min(rest.len())];
    let (kind, json, mut rest) = chunk(rest)?;
    if kind != JSON {
        return Err(Cause::GlbWithoutJson { found: kind }.into());
    }
    let mut binary = None;
    while binary.is_none() && !rest.is_empty() {
        let (kind, data, behind) = chunk(rest)?;
        if kind == BINARY {
            binary = Some(data);
        }
        rest = behind;
    }
    Ok(Parts { json, binary })
}

/// The JSON of a main file, with no more of it in memory.
pub fn json_of(path: &Path) -> Result<Vec<u8>, SceneError> {
    let failed = |source| SceneError::from(Cause::Read { source });
    let mut file = File::open(path).map_err(failed)?;
    let mut head = Vec::new();
    file.by_ref().take(20).read_to_end(&mut head).map_err(failed)?;
    // As `split` reads it: the header, the header of the first chunk, and its bytes.
    let most = match head.starts_with(MAGIC) && head.len() == 20 {
        true => u64::from(word(&head, 12)),
        false => u64::MAX,
    };
    file.take(most).read_to_end(&mut head).map_err(failed)?;
    if head.starts_with(MAGIC) && head.len() >= 12 {
        // What is not there is behind the JSON.
        let length = head.len() as u32;
        head[8..12].copy_from_slice(&length.to_le_bytes());
    }
    Ok(split(&head)?.json.to_vec())
}

/// Type and bytes of the first chunk, and what is behind it.
fn chunk(rest: &[u8]) -> Result<(u32, &[u8], &[u8]), SceneError> {
    let (header, rest) = take(rest, 8, "a chunk header")?;
    let (data, rest) = take(rest, u64::from(word(header, 0)), "a chunk")?;
    Ok((word(header, 4), data, rest))
}

fn take<'a>(
    bytes: &'a [u8],
    needed: u64,
    what: &'static str,
) -> Result<(&'a [u8], &'a [u8]), SceneError> {
    let available = bytes.len() as u64;
    if needed > available {
        return Err(Cause::GlbTruncated { what, needed, available }.into());
    }
    Ok(bytes.split_at(needed as usize))
}

fn word(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}
