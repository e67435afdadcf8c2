//! Measures what visible sets take: bits an id, raw and in a cells file, and decoding time.
//!
//! The sets are made up to look like a street walk: objects of 40 to 2,000 primitives in spatial
//! order, each seen by neighbouring cells alike, each visible in a few runs. They stand for no real
//! scene; `benches/` measures those.

#![allow(clippy::print_stdout)]

use std::time::Instant;

use glam::DVec3;
use sightline_geometry::{CellId, PrimitiveSet, Run, ViewCell};
use sightline_store::{CellEffort, CellRow, Result, decode_set, encode_cell_part, encode_set};

const CELLS: u32 = 512;
const OBJECTS: u32 = 20_000;

/// Numbers that look random (Knuth's MMIX constants), as a function of their arguments.
fn hashed(parts: &[u32]) -> u32 {
    let mix = |state: u64, part: &u32| {
        let state = (state ^ u64::from(*part)).wrapping_mul(6364136223846793005);
        (state ^ (state >> 29)).wrapping_add(1442695040888963407)
    };
    (parts.iter().fold(0x9e37_79b9_7f4a_7c15, mix) >> 32) as u32
}

/// The set of a cell on a street: objects near it are seen in more runs than far ones.
fn street_cell(cell: u32) -> PrimitiveSet {
    let mut set = PrimitiveSet::default();
    let mut first = 0;
    for object in 0..OBJECTS {
        let size = 40 + hashed(&[object]) % 1960;
        // An object is seen from a stretch of the street.
        let stretch = hashed(&[object, 1]) % CELLS;
        if cell.abs_diff(stretch) < 4 + hashed(&[object, 2]) % 40 {
            let mut at = first;
            while at < first + size {
                // Runs mostly agree between neighbouring cells; one in eight moves with the cell.
                let moves = hashed(&[at, 3]).is_multiple_of(8);
                let salt = if moves { cell } else { cell / 16 };
                let end = (at + 1 + hashed(&[at, salt, 4]) % 60).min(first + size);
                set.push(Run { first: at, end });
                at = end + 1 + hashed(&[at, salt, 5]) % 40;
            }
        }
        first += size;
    }
    set
}

fn main() -> Result<()> {
    let row = |id: u32| CellRow {
        cell: ViewCell { id: CellId(id), corners: [DVec3::ZERO; 4], height: 0.0 },
        tile: [id as i32, 0],
        first_state: 0,
        last_state: 0,
        set: street_cell(id),
        weights: Vec::new(),
        effort: CellEffort::default(),
    };
    let rows: Vec<CellRow> = (0..CELLS).map(row).collect();
    let ids: u64 = rows.iter().map(|r| r.set.len()).sum();
    let runs: usize = rows.iter().map(|r| r.set.runs().len()).sum();
    let encoded: Vec<Vec<u8>> = rows.iter().map(|r| encode_set(&r.set)).collect();
    let raw: usize = encoded.iter().map(Vec::len).sum();
    let file = encode_cell_part(&rows)?.len();
    let start = Instant::now();
    let decoded: u64 = encoded.iter().map(|bytes| decode_set(bytes).map_or(0, |s| s.len())).sum();
    let seconds = start.elapsed().as_secs_f64();
    assert_eq!(decoded, ids);
    let bits = |bytes: usize| bytes as f64 * 8.0 / ids as f64;
    println!("{CELLS} cells, {ids} ids, {runs} runs");
    println!("encoded {raw} bytes, {:.3} bit an id", bits(raw));
    println!("cells file {file} bytes, {:.3} bit an id", bits(file));
    println!("decoding takes {:.1} ms in all", seconds * 1e3);
    Ok(())
}
