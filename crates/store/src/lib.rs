//! The visibility dataset: Parquet layout, manifest, commits, reader.
//!
//! - [`BakeStore`]: the few object-store operations that everything rests on.
//! - [`FileCache`]: a folder of limited size with copies of objects, by content.
//! - [`parts`]: what tasks write while a bake runs.
//! - [`DatasetWriter`] and [`publish`]: from rows to a published dataset.
//! - [`Dataset`]: reading it, cell by cell or whole, and [`Dataset::check`].
//! - [`codec`]: a set of primitives as bytes; [`Weight`]: how important one is, in a byte.
//!
//! Formats are contracts: versioned prose in `schemas/`, golden files in `schemas/golden/`.
//!
//! Invariants that code and tests quote:
//! - ST-1: equal rows give equal bytes. No file holds a clock reading, a host or an absolute path.
//! - ST-2: an object is there with all its bytes or not at all.
//! - ST-3: files that a manifest names exist before the manifest, the manifest before the pointer.
//! - ST-4: a file under `data/` is named by its content and never changes.

mod access;
pub mod codec;
mod error;
mod file_cache;
pub mod keys;
mod manifest;
mod observe;
pub mod parts;
mod publish;
mod reader;
mod rows;
mod tables;
mod verify;
mod weight;
mod writer;

pub use access::{BakeStore, Created, ObjectVersion, is_url, key_beside, local_path, redacted};
pub use codec::{DecodeError, decode_set, encode_set};
pub use error::{ErrorClass, Result, StoreError};
pub use file_cache::{CACHE_BYTES_MAX, CachedFile, FileCache, FileView};
pub use keys::PartKind;
pub use manifest::{
    BoxRecord, DataFile, FORMAT, FileKind, Manifest, Pointer, SceneFile, SceneSource, Totals,
    VERSION,
};
pub use observe::{Observer, Operation};
pub use parts::{
    decode_cell_part, decode_object_part, decode_segment_part, decode_segment_part_where,
    encode_cell_part, encode_object_part, encode_segment_part,
};
pub use publish::{Published, current, publish};
pub use reader::Dataset;
pub use rows::{
    CellEffort, CellEntry, CellRow, GltfTriangle, NumberedInstance, NumberedMesh, Numbering,
    ObjectRow, ObjectsLocation, RowOrder, SceneObject, SegmentRow, SetLocation,
};
pub use verify::{CheckReport, Problem};
pub use weight::Weight;
pub use writer::{DatasetWriter, Description, Limits};
