//! Parts: what tasks write while a bake runs. One Parquet object each, see `schemas/parts-v3.md`.
//!
//! A segments task writes one file of [`SegmentRow`]s. A cells task writes one of [`CellRow`]s, and one
//! of [`ObjectRow`]s where it takes all states; where it takes some, a join task writes both. Equal rows give equal bytes (ST-1), so attempts of one task agree.
//! Encoders check the contract of the rows; decoders check what they read and name the file.

use bytes::Bytes;
use sightline_geometry::SegmentId;

use crate::Result;
use crate::rows::{CellRow, ObjectRow, SegmentRow};
use crate::tables::{
    CELL_PART, OBJECT_PART, SEGMENT_PART, Table, cell_batch, cell_rows, object_batch, object_rows,
    segment_batch, segment_rows,
};

/// Pairs in a batch handed to the Parquet writer.
const OBJECT_BATCH_ROWS: usize = 4096;

/// The file of a segments task.
///
/// # Errors
/// [`crate::StoreError::InvalidRows`] when rows are not in ascending order of (segment, first state),
/// or a row has no states, or not one finite weight a member of its set.
pub fn encode_segment_part(rows: &[SegmentRow]) -> Result<Bytes> {
    has_states(&SEGMENT_PART, rows.iter().map(|r| (r.first_state, r.last_state)))?;
    ascending(&SEGMENT_PART, rows.iter().map(|r| (r.segment.0, r.first_state)))?;
    for row in rows {
        if row.weights.len() as u64 != row.set.len() {
            let (weights, members) = (row.weights.len(), row.set.len());
            return Err(SEGMENT_PART.invalid(format!(
                "segment {} has {weights} weights and {members} primitives",
                row.segment
            )));
        }
        if !row.weights.iter().all(|w| w.is_finite()) {
            return Err(
                SEGMENT_PART.invalid(format!("segment {}: a weight is not a number", row.segment))
            );
        }
    }
    SEGMENT_PART.encode(rows.iter().map(segment_batch))
}

/// The rows of a segments task's file. `file` is for messages.
///
/// # Errors
/// [`crate::StoreError::Corrupt`] or [`crate::StoreError::UnsupportedVersion`].
pub fn decode_segment_part(file: &str, bytes: Bytes) -> Result<Vec<SegmentRow>> {
    decode_segment_part_where(file, bytes, |_| true)
}

/// The rows of a segments task's file whose segment is wanted; other sets are not decoded.
///
/// # Errors
/// As [`decode_segment_part`].
pub fn decode_segment_part_where(
    file: &str,
    bytes: Bytes,
    mut wanted: impl FnMut(SegmentId) -> bool,
) -> Result<Vec<SegmentRow>> {
    let mut rows = Vec::new();
    for batch in SEGMENT_PART.decode(file, bytes)? {
        segment_rows(file, &batch?, &mut wanted, &mut rows)?;
    }
    Ok(rows)
}

/// The cells file of a cells task.
///
/// # Errors
/// [`crate::StoreError::InvalidRows`] when rows are not in ascending order of cells, each cell's
/// longest first and equally long ones by time, or a row has no states.
pub fn encode_cell_part(rows: &[CellRow]) -> Result<Bytes> {
    has_states(&CELL_PART, rows.iter().map(|r| (r.first_state, r.last_state)))?;
    ascending(&CELL_PART, rows.iter().map(CellRow::order))?;
    CELL_PART.encode(rows.chunks(1).map(|row| cell_batch(&CELL_PART, row)))
}

/// The rows of a cells task's cells file. `file` is for messages.
///
/// # Errors
/// [`crate::StoreError::Corrupt`] or [`crate::StoreError::UnsupportedVersion`].
pub fn decode_cell_part(file: &str, bytes: Bytes) -> Result<Vec<CellRow>> {
    let mut rows = Vec::new();
    for batch in CELL_PART.decode(file, bytes)? {
        rows.append(&mut cell_rows(file, &batch?)?);
    }
    Ok(rows)
}

/// The objects file of a cells task.
///
/// # Errors
/// [`crate::StoreError::InvalidRows`] when rows are not in ascending order of (cell, object).
pub fn encode_object_part(rows: &[ObjectRow]) -> Result<Bytes> {
    ascending(&OBJECT_PART, rows.iter().map(|r| (r.cell, r.object)))?;
    OBJECT_PART.encode(rows.chunks(OBJECT_BATCH_ROWS).map(|rows| object_batch(rows, None)))
}

/// The rows of a cells task's objects file. `file` is for messages.
///
/// # Errors
/// [`crate::StoreError::Corrupt`] or [`crate::StoreError::UnsupportedVersion`].
pub fn decode_object_part(file: &str, bytes: Bytes) -> Result<Vec<ObjectRow>> {
    let mut rows = Vec::new();
    for batch in OBJECT_PART.decode(file, bytes)? {
        rows.append(&mut object_rows(file, &batch?)?);
    }
    Ok(rows)
}

/// Checks pairs of a first and a last state.
fn has_states(table: &Table, mut states: impl Iterator<Item = (u32, u32)>) -> Result<()> {
    match states.find(|(first, last)| first > last || *last == u32::MAX) {
        None => Ok(()),
        Some((first, last)) => Err(table.invalid(format!("a row is of states {first} to {last}"))),
    }
}

fn ascending<K: PartialOrd>(table: &Table, keys: impl Iterator<Item = K>) -> Result<()> {
    if keys.is_sorted_by(|a, b| a < b) {
        Ok(())
    } else {
        Err(table.invalid("rows are not in strictly ascending order"))
    }
}
