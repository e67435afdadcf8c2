//! The tables: columns, Parquet settings, and conversion between rows and Arrow batches.
//!
//! Every file is plain Parquet 1.0 pages, zstd, no Arrow schema blob, a fixed `created_by`, and
//! key-value metadata that names the format, its version and what each column means. Nothing in a
//! file depends on when or where it was written (ST-1), so changing any constant here changes
//! bytes and needs a new version of the format.

use std::ops::Range;
use std::sync::Arc;

use arrow_array::builder::{
    BinaryBuilder, BooleanBuilder, Float32Builder, ListBuilder, StringBuilder, UInt32Builder,
};
use arrow_array::types::{ArrowPrimitiveType, Float64Type, Int32Type, UInt32Type, UInt64Type};
use arrow_array::{
    Array, ArrayRef, ArrowNativeTypeOp, BinaryArray, BooleanArray, Float32Array, ListArray,
    PrimitiveArray, RecordBatch, StringArray, UInt32Array,
};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use bytes::Bytes;
use glam::DVec3;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
};
use parquet::arrow::arrow_writer::{ArrowWriter, ArrowWriterOptions};
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::metadata::{KeyValue, PageIndexPolicy};
use parquet::file::properties::{EnabledStatistics, WriterProperties, WriterVersion};
use parquet::schema::types::ColumnPath;
use sightline_geometry::{
    Bounds, CellId, MeshId, ObjectId, PrimitiveSet, Run, SegmentId, ViewCell,
};

use crate::rows::{
    CellEffort, CellEntry, CellRow, NumberedInstance, NumberedMesh, ObjectRow, ObjectsLocation,
    SceneObject, SegmentRow, SetLocation,
};
use crate::{Result, StoreError, Weight, decode_set, encode_set};

/// Metadata key of a file's format.
const FORMAT_KEY: &str = "sightline.format";
/// Metadata key of the version of a file's format.
const VERSION_KEY: &str = "sightline.version";
/// Prefix of the metadata keys that describe columns.
const COLUMN_KEY: &str = "sightline.column.";
/// Writer named in every file; a library version here would change bytes with every update.
const CREATED_BY: &str = "sightline";
/// zstd level of all columns: higher levels gain a few percent of the sets and cost tenfold time.
const ZSTD_LEVEL: i32 = 3;
/// Rows in a data page of ordinary columns.
const PAGE_ROWS: usize = 4096;
/// Sets in a data page: one, so that a client reads a cell with one request and no waste.
pub(crate) const SETS_PER_PAGE: usize = 1;
/// Triangles in a row of the mesh table; longer meshes take several rows.
pub(crate) const TRIANGLES_PER_ROW: usize = 1 << 16;
/// Rows in a batch that a reader decodes at once.
const READ_BATCH_ROWS: usize = 1024;

/// Type of a column. Columns are never null unless the type says so.
#[derive(Clone, Copy)]
pub(crate) enum Kind {
    Bool,
    I32,
    U32,
    U32OrNull,
    U64,
    F64,
    Text,
    /// Bytes that are compressed but not searched: no dictionary, no statistics.
    Blob,
    /// A list of 32-bit numbers that ascend in stretches.
    Numbers,
    /// A list of `f32` fractions.
    Fractions,
}

/// A column: name, type, meaning with unit.
pub(crate) type Column = (&'static str, Kind, &'static str);

/// A table: one kind of Parquet file.
pub(crate) struct Table {
    /// Name of the format, in the files' metadata.
    pub format: &'static str,
    /// Version of the format that is written.
    pub version: u32,
    /// Columns that a version added to the one before it, in a table whose earlier versions are still
    /// read.
    pub added: &'static [(u32, &'static [&'static str])],
    /// Rows in a row group.
    pub row_group_rows: usize,
    /// The columns, in the order of the file.
    pub columns: &'static [Column],
}

const CELL_COLUMNS: &[Column] = &[
    ("cell", Kind::U32, "number of the view cell, in Hilbert order"),
    ("tile_x", Kind::I32, "tile of the view region, x"),
    ("tile_z", Kind::I32, "tile of the view region, z"),
    ("corner0_x", Kind::F64, "footprint corner 0 at the lower eye height, metres"),
    ("corner0_y", Kind::F64, "metres"),
    ("corner0_z", Kind::F64, "metres"),
    ("corner1_x", Kind::F64, "footprint corner 1, metres"),
    ("corner1_y", Kind::F64, "metres"),
    ("corner1_z", Kind::F64, "metres"),
    ("corner2_x", Kind::F64, "footprint corner 2, metres"),
    ("corner2_y", Kind::F64, "metres"),
    ("corner2_z", Kind::F64, "metres"),
    ("corner3_x", Kind::F64, "footprint corner 3, metres"),
    ("corner3_y", Kind::F64, "metres"),
    ("corner3_z", Kind::F64, "metres"),
    ("height", Kind::F64, "from the lower to the upper eye height, metres"),
    (
        "first_state",
        Kind::U32,
        "first state of the row; a row of all states holds what any state sees",
    ),
    ("last_state", Kind::U32, "last state of the row"),
    ("primitives", Kind::U32, "number of visible primitives"),
    ("segments", Kind::U32, "view segments solved for the cell"),
    ("runs", Kind::U32, "of these, runs along the perimeter"),
    ("lines", Kind::U32, "of these, lines through viewpoints"),
    ("rows", Kind::U32, "rows of a face of the finest run"),
    ("solver_rays", Kind::U64, "rays along which the segments were solved"),
    (
        "skipped_movers",
        Kind::U64,
        "movers in states in which a hidden volume holds them, a tile each",
    ),
    ("refinements", Kind::U32, "refinement rounds"),
    ("heldout_viewpoints", Kind::U32, "viewpoints of the last measurement"),
    ("heldout_rays", Kind::U64, "rays cast from held-out viewpoints, in all rounds"),
    ("heldout_error_mean", Kind::F64, "mean pixel error of held-out viewpoints, share of pixels"),
    ("heldout_error_upper", Kind::F64, "95 % upper bound of the mean error, share of pixels"),
    ("heldout_error_max", Kind::F64, "worst pixel error of a held-out viewpoint, share of pixels"),
    ("target_met", Kind::Bool, "true when the error aimed at was met"),
    ("set", Kind::Blob, "visible primitives: varint (gap, length) runs, set encoding version 1"),
    ("weights", Kind::Blob, "one byte a visible primitive, ascending: weight encoding version 1"),
];

/// Columns of [`CELL_COLUMNS`] that version 1 did not have.
const CELL_COLUMNS_OF_2: &[&str] = &[
    "runs",
    "lines",
    "rows",
    "solver_rays",
    "heldout_viewpoints",
    "heldout_error_upper",
    "target_met",
    "weights",
];

/// Columns of [`CELL_COLUMNS`] and of the index that version 2 did not have.
const STATE_COLUMNS: &[&str] = &["first_state", "last_state", "skipped_movers"];

/// What segments tasks write.
pub(crate) const SEGMENT_PART: Table = Table {
    format: "sightline-part-segments",
    version: 3,
    added: &[],
    row_group_rows: 64,
    columns: &[
        ("segment", Kind::U32, "number of the view segment in the plan"),
        ("first_state", Kind::U32, "first state of the row"),
        ("last_state", Kind::U32, "last state of the row"),
        ("primitives", Kind::U32, "number of visible primitives"),
        (
            "set",
            Kind::Blob,
            "visible primitives: varint (gap, length) runs, set encoding version 1",
        ),
        (
            "weights",
            Kind::Fractions,
            "one a visible primitive, ascending: share of (solid angle x segment) on which it is \
             nearest",
        ),
        ("rays", Kind::U64, "rays along which the segment was solved"),
        (
            "skipped_movers",
            Kind::U64,
            "movers in states in which a hidden volume holds them, a tile each",
        ),
    ],
};

/// What cells tasks write: cells.
pub(crate) const CELL_PART: Table = Table {
    format: "sightline-part-cells",
    version: 3,
    added: &[],
    row_group_rows: 1024,
    columns: CELL_COLUMNS,
};

/// What cells tasks write: (cell, object) pairs.
pub(crate) const OBJECT_PART: Table = Table {
    format: "sightline-part-objects",
    version: 1,
    added: &[],
    row_group_rows: 1 << 17,
    columns: &[
        ("cell", Kind::U32, "number of the view cell"),
        ("object", Kind::U32, "number of the object"),
        ("visible_primitives", Kind::U32, "visible primitives of the object"),
        ("total_primitives", Kind::U32, "all primitives of the object"),
        ("weight", Kind::F64, "share of (solid angle x segments) on which the object is nearest"),
        ("first_state", Kind::U32, "first state in which the object is visible"),
        ("last_state", Kind::U32, "last state in which the object is visible"),
    ],
};

/// `data/cells-*`: one row a cell and run of states, and one of all. 1,024 rows a row group keep a footer entry per 1,024 cells and
/// let an engine read groups in parallel; the sets are in pages of their own whatever the group.
pub(crate) const CELLS: Table = Table {
    format: "sightline-cells",
    version: 3,
    added: &[(2, CELL_COLUMNS_OF_2), (3, STATE_COLUMNS)],
    row_group_rows: 1024,
    columns: CELL_COLUMNS,
};

/// `data/objects-*`: one row a (cell, object). Row groups of the usual size for engines.
pub(crate) const OBJECTS: Table = Table {
    format: "sightline-objects",
    version: 1,
    added: &[],
    row_group_rows: 1 << 17,
    columns: &[
        ("cell", Kind::U32, "number of the view cell"),
        ("object", Kind::U32, "number of the object"),
        ("object_name", Kind::Text, "name of the object"),
        ("visible_primitives", Kind::U32, "visible primitives of the object"),
        ("total_primitives", Kind::U32, "all primitives of the object"),
        ("weight", Kind::F64, "share of (solid angle x segments) on which the object is nearest"),
        ("first_state", Kind::U32, "first state in which the object is visible"),
        ("last_state", Kind::U32, "last state in which the object is visible"),
    ],
};

/// `data/index-*`: one row a row of the cells, small, fetched first.
pub(crate) const INDEX: Table = Table {
    format: "sightline-index",
    version: 3,
    added: &[(2, &["weights_offset", "weights_bytes"]), (3, STATE_COLUMNS)],
    row_group_rows: 1 << 16,
    columns: &[
        ("cell", Kind::U32, "number of the view cell, in Hilbert order"),
        ("tile_x", Kind::I32, "tile of the view region, x"),
        ("tile_z", Kind::I32, "tile of the view region, z"),
        ("min_x", Kind::F64, "box of the cell, metres"),
        ("min_y", Kind::F64, "metres"),
        ("min_z", Kind::F64, "metres"),
        ("max_x", Kind::F64, "metres"),
        ("max_y", Kind::F64, "metres"),
        ("max_z", Kind::F64, "metres"),
        ("corner0_x", Kind::F64, "footprint corner 0 at the lower eye height, metres"),
        ("corner0_y", Kind::F64, "metres"),
        ("corner0_z", Kind::F64, "metres"),
        ("corner1_x", Kind::F64, "footprint corner 1, metres"),
        ("corner1_y", Kind::F64, "metres"),
        ("corner1_z", Kind::F64, "metres"),
        ("corner2_x", Kind::F64, "footprint corner 2, metres"),
        ("corner2_y", Kind::F64, "metres"),
        ("corner2_z", Kind::F64, "metres"),
        ("corner3_x", Kind::F64, "footprint corner 3, metres"),
        ("corner3_y", Kind::F64, "metres"),
        ("corner3_z", Kind::F64, "metres"),
        ("height", Kind::F64, "from the lower to the upper eye height, metres"),
        ("first_state", Kind::U32, "first state of the row"),
        ("last_state", Kind::U32, "last state of the row"),
        ("primitives", Kind::U32, "number of visible primitives"),
        ("cells_file", Kind::Text, "key of the file with the cell's row"),
        ("row_group", Kind::U32, "row group in the cells file"),
        ("row", Kind::U32, "row in the row group"),
        ("page_offset", Kind::U32, "offset of the data page with the cell's set, bytes"),
        ("page_bytes", Kind::U32, "size of that page with its header, bytes"),
        ("page_row", Kind::U32, "place of the set among the values of that page"),
        ("weights_offset", Kind::U32, "offset of the data page with the cell's weights, bytes"),
        ("weights_bytes", Kind::U32, "size of that page with its header, bytes"),
        ("objects_file", Kind::Text, "key of the file with the cell's (cell, object) rows"),
        ("objects_first_row", Kind::U32, "first of those rows in the file"),
        ("objects_rows", Kind::U32, "number of those rows"),
    ],
};

/// `data/scene-*`: one row an object.
pub(crate) const SCENE: Table = Table {
    format: "sightline-scene",
    version: 1,
    added: &[],
    row_group_rows: 1 << 16,
    columns: &[
        ("object", Kind::U32, "number of the object"),
        ("name", Kind::Text, "name of the object; need not be unique"),
        ("path", Kind::Text, "names from the root of the scene, joined by /"),
        ("node", Kind::U32, "number of the glTF node"),
        ("first_primitive", Kind::U32, "first primitive"),
        ("end_primitive", Kind::U32, "first primitive behind the object"),
        ("occluder", Kind::Bool, "true when the object hides what is behind it"),
        ("min_x", Kind::F64, "world box, metres"),
        ("min_y", Kind::F64, "metres"),
        ("min_z", Kind::F64, "metres"),
        ("max_x", Kind::F64, "metres"),
        ("max_y", Kind::F64, "metres"),
        ("max_z", Kind::F64, "metres"),
    ],
};

/// `data/numbering-*`: one row an instance.
pub(crate) const INSTANCES: Table = Table {
    format: "sightline-numbering",
    version: 1,
    added: &[],
    row_group_rows: 1 << 16,
    columns: &[
        ("first_primitive", Kind::U32, "global number of the instance's first triangle"),
        ("object", Kind::U32, "number of the object"),
        ("node", Kind::U32, "number of the glTF node"),
        ("gpu_instance", Kind::U32OrNull, "number in the node's EXT_mesh_gpu_instancing"),
        ("mesh", Kind::U32, "number of the mesh"),
    ],
};

/// `data/meshes-*`: one row a mesh, or a stretch of its triangles. 64 rows hold up to 16 MiB.
pub(crate) const MESHES: Table = Table {
    format: "sightline-meshes",
    version: 1,
    added: &[],
    row_group_rows: 64,
    columns: &[
        ("mesh", Kind::U32, "number of the mesh"),
        ("gltf_mesh", Kind::U32, "number of the glTF mesh"),
        ("gltf_primitive", Kind::U32, "number of the primitive in the glTF mesh"),
        ("first_triangle", Kind::U32, "number in the mesh of the row's first triangle"),
        ("triangles", Kind::Numbers, "for each triangle, its number in the glTF primitive"),
    ],
};

impl Table {
    /// The Arrow schema of the table.
    pub fn schema(&self) -> SchemaRef {
        let fields: Vec<Field> = self
            .columns
            .iter()
            .map(|&(name, kind, _)| {
                Field::new(name, data_type(kind), matches!(kind, Kind::U32OrNull))
            })
            .collect();
        Arc::new(Schema::new(fields))
    }

    /// An empty file of the table.
    pub fn writer(&self) -> Result<ArrowWriter<Vec<u8>>> {
        let options = ArrowWriterOptions::new()
            .with_properties(self.properties())
            .with_skip_arrow_metadata(true);
        ArrowWriter::try_new_with_options(Vec::new(), self.schema(), options)
            .map_err(|e| self.invalid(e))
    }

    fn properties(&self) -> WriterProperties {
        let level = ZstdLevel::try_new(ZSTD_LEVEL).expect("zstd has levels 1 to 22");
        let pair = |key: String, value: &str| KeyValue::new(key, value.to_owned());
        let mut metadata = vec![
            pair(FORMAT_KEY.into(), self.format),
            pair(VERSION_KEY.into(), &self.version.to_string()),
        ];
        for (name, _, about) in self.columns {
            metadata.push(pair(format!("{COLUMN_KEY}{name}"), about));
        }
        let mut properties = WriterProperties::builder()
            .set_created_by(CREATED_BY.into())
            .set_writer_version(WriterVersion::PARQUET_1_0)
            .set_compression(Compression::ZSTD(level))
            .set_max_row_group_row_count(Some(self.row_group_rows))
            .set_data_page_row_count_limit(PAGE_ROWS)
            .set_key_value_metadata(Some(metadata));
        for &(name, kind, _) in self.columns {
            let plain =
                |path: ColumnPath, p: parquet::file::properties::WriterPropertiesBuilder| {
                    p.set_column_dictionary_enabled(path.clone(), false)
                        .set_column_statistics_enabled(path, EnabledStatistics::None)
                };
            properties = match kind {
                Kind::Blob => {
                    let path = ColumnPath::from(name);
                    plain(path.clone(), properties)
                        .set_column_data_page_row_count_limit(path, SETS_PER_PAGE)
                }
                Kind::Numbers => plain(element(name), properties)
                    .set_column_encoding(element(name), Encoding::DELTA_BINARY_PACKED),
                Kind::Fractions => plain(element(name), properties)
                    .set_column_encoding(element(name), Encoding::BYTE_STREAM_SPLIT),
                _ => properties,
            };
        }
        properties.build()
    }

    /// Assembles columns, in the order of the table.
    pub fn batch(&self, columns: Vec<ArrayRef>) -> Result<RecordBatch> {
        RecordBatch::try_new(self.schema(), columns).map_err(|e| self.invalid(e))
    }

    /// The error for rows that break the table's contract.
    pub fn invalid(&self, problem: impl std::fmt::Display) -> StoreError {
        StoreError::InvalidRows { table: self.format, problem: problem.to_string() }
    }

    /// A whole file of the table from batches.
    pub fn encode(&self, batches: impl IntoIterator<Item = Result<RecordBatch>>) -> Result<Bytes> {
        let mut writer = self.writer()?;
        for batch in batches {
            writer.write(&batch?).map_err(|e| self.invalid(e))?;
        }
        writer.into_inner().map(Bytes::from).map_err(|e| self.invalid(e))
    }

    /// How footers are read: always with the offset index, which finds pages.
    pub fn reader_options() -> ArrowReaderOptions {
        ArrowReaderOptions::new()
            .with_skip_arrow_metadata(true)
            .with_offset_index_policy(PageIndexPolicy::Optional)
    }

    /// Checks that `metadata` is of this table, in a version and with columns that we can read.
    pub fn expect(&self, file: &str, metadata: &ArrowReaderMetadata) -> Result<()> {
        let pairs = metadata.metadata().file_metadata().key_value_metadata();
        let value = |key: &str| {
            let pair = pairs.into_iter().flatten().find(|pair| pair.key == key);
            pair.and_then(|pair| pair.value.as_deref()).unwrap_or("")
        };
        if value(FORMAT_KEY) != self.format {
            let problem = format!("it is not a {} file", self.format);
            return Err(StoreError::corrupt(file, problem));
        }
        let oldest = if self.added.is_empty() { self.version } else { 1 };
        match value(VERSION_KEY).parse::<u64>() {
            Ok(version) if (u64::from(oldest)..=u64::from(self.version)).contains(&version) => {
                self.expect_columns(file, metadata, version)
            }
            Ok(found) => {
                let supported = self.version;
                Err(StoreError::UnsupportedVersion { file: file.into(), found, supported })
            }
            Err(_) => Err(StoreError::corrupt(file, "it names no version")),
        }
    }

    fn expect_columns(
        &self,
        file: &str,
        metadata: &ArrowReaderMetadata,
        version: u64,
    ) -> Result<()> {
        let later = |name: &str| {
            let mut later = self.added.iter().filter(|(since, _)| u64::from(*since) > version);
            later.any(|(_, columns)| columns.contains(&name))
        };
        for field in self.schema().fields() {
            if later(field.name()) {
                continue;
            }
            let found = metadata.schema().field_with_name(field.name());
            let found = found.map_err(|_| {
                StoreError::corrupt(file, format!("column `{}` is missing", field.name()))
            })?;
            if !same_type(found.data_type(), field.data_type()) {
                let problem = format!("column `{}` is {}", field.name(), found.data_type());
                return Err(StoreError::corrupt(file, problem));
            }
        }
        Ok(())
    }

    /// The batches of a whole file of this table, decoded one after the other.
    pub fn decode(
        &self,
        file: &str,
        bytes: Bytes,
    ) -> Result<impl Iterator<Item = Result<RecordBatch>> + use<>> {
        let metadata = guarded(file, || ArrowReaderMetadata::load(&bytes, Self::reader_options()))?;
        self.expect(file, &metadata)?;
        let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(bytes, metadata);
        let mut reader = guarded(file, || builder.with_batch_size(READ_BATCH_ROWS).build())?;
        let file = file.to_owned();
        let mut over = false;
        Ok(std::iter::from_fn(move || {
            if over {
                return None;
            }
            let next = guarded(&file, || reader.next().transpose().map_err(ParquetError::from));
            over = !matches!(next, Ok(Some(_)));
            next.transpose()
        }))
    }
}

/// Runs a decoder on bytes whose hash may not have been verified.
///
/// The Parquet decoder returns errors for most damage, but panics on some (a negative offset, for
/// example). Such a panic means no more than that the file is damaged.
pub(crate) fn guarded<T>(
    file: &str,
    decode: impl FnOnce() -> Result<T, ParquetError>,
) -> Result<T> {
    match std::panic::catch_unwind(std::panic::AssertUnwindSafe(decode)) {
        Ok(result) => result.map_err(|e| StoreError::corrupt(file, e)),
        Err(_) => Err(StoreError::corrupt(file, "it is not well-formed Parquet")),
    }
}

/// Path of the values of a list column.
fn element(name: &str) -> ColumnPath {
    ColumnPath::new(vec![name.into(), "list".into(), "element".into()])
}

fn list_of(item: DataType) -> DataType {
    DataType::List(Arc::new(Field::new("element", item, false)))
}

fn data_type(kind: Kind) -> DataType {
    match kind {
        Kind::Bool => DataType::Boolean,
        Kind::I32 => DataType::Int32,
        Kind::U32 | Kind::U32OrNull => DataType::UInt32,
        Kind::U64 => DataType::UInt64,
        Kind::F64 => DataType::Float64,
        Kind::Text => DataType::Utf8,
        Kind::Blob => DataType::Binary,
        Kind::Numbers => list_of(DataType::UInt32),
        Kind::Fractions => list_of(DataType::Float32),
    }
}

/// Types are the same, whatever the elements of lists are called.
fn same_type(a: &DataType, b: &DataType) -> bool {
    match (a, b) {
        (DataType::List(a), DataType::List(b)) => a.data_type() == b.data_type(),
        _ => a == b,
    }
}

// Rows to columns.

fn numbers<T: ArrowPrimitiveType>(values: impl Iterator<Item = T::Native>) -> ArrayRef {
    Arc::new(PrimitiveArray::<T>::from_iter_values(values))
}

fn texts<'a>(values: impl Iterator<Item = &'a str>) -> ArrayRef {
    let mut builder = StringBuilder::new();
    values.for_each(|v| builder.append_value(v));
    Arc::new(builder.finish())
}

fn sets<'a>(values: impl Iterator<Item = &'a PrimitiveSet>) -> ArrayRef {
    let mut builder = BinaryBuilder::new();
    values.for_each(|v| builder.append_value(encode_set(v)));
    Arc::new(builder.finish())
}

fn weights<'a>(values: impl Iterator<Item = &'a [Weight]>) -> ArrayRef {
    let mut builder = BinaryBuilder::new();
    for weights in values {
        builder.append_value(weights.iter().map(|w| w.code()).collect::<Vec<u8>>());
    }
    Arc::new(builder.finish())
}

fn flags(values: impl Iterator<Item = bool>) -> ArrayRef {
    let mut builder = BooleanBuilder::new();
    values.for_each(|v| builder.append_value(v));
    Arc::new(builder.finish())
}

/// The number of members of a set, as tables store it: primitive numbers have 32 bits.
pub(crate) fn count(set: &PrimitiveSet) -> u32 {
    u32::try_from(set.len()).expect("a set of 32-bit numbers below the last has a 32-bit size")
}

fn cell_geometry<'a>(cells: impl Iterator<Item = &'a ViewCell> + Clone) -> Vec<ArrayRef> {
    let mut columns = Vec::new();
    for corner in 0..4 {
        for axis in 0..3 {
            columns.push(numbers::<Float64Type>(cells.clone().map(|c| c.corners[corner][axis])));
        }
    }
    columns.push(numbers::<Float64Type>(cells.map(|c| c.height)));
    columns
}

fn boxes(bounds: impl Iterator<Item = Bounds> + Clone) -> Vec<ArrayRef> {
    let corner = |b: Bounds, upper: bool| if upper { b.max } else { b.min };
    let column = |upper: bool, axis: usize| {
        numbers::<Float64Type>(bounds.clone().map(move |b| corner(b, upper)[axis]))
    };
    [false, true]
        .iter()
        .flat_map(|&upper| (0..3).map(move |axis| (upper, axis)))
        .map(|(upper, axis)| column(upper, axis))
        .collect()
}

pub(crate) fn segment_batch(row: &SegmentRow) -> Result<RecordBatch> {
    let mut weights = ListBuilder::new(Float32Builder::new()).with_field(Field::new(
        "element",
        DataType::Float32,
        false,
    ));
    weights.values().append_slice(&row.weights);
    weights.append(true);
    SEGMENT_PART.batch(vec![
        numbers::<UInt32Type>([row.segment.0].into_iter()),
        numbers::<UInt32Type>([row.first_state].into_iter()),
        numbers::<UInt32Type>([row.last_state].into_iter()),
        numbers::<UInt32Type>([count(&row.set)].into_iter()),
        sets([&row.set].into_iter()),
        Arc::new(weights.finish()),
        numbers::<UInt64Type>([row.rays].into_iter()),
        numbers::<UInt64Type>([row.skipped_movers].into_iter()),
    ])
}

/// Cells as a batch of [`CELLS`] or [`CELL_PART`].
pub(crate) fn cell_batch(table: &Table, rows: &[CellRow]) -> Result<RecordBatch> {
    let mut columns = vec![
        numbers::<UInt32Type>(rows.iter().map(|r| r.cell.id.0)),
        numbers::<Int32Type>(rows.iter().map(|r| r.tile[0])),
        numbers::<Int32Type>(rows.iter().map(|r| r.tile[1])),
    ];
    columns.extend(cell_geometry(rows.iter().map(|r| &r.cell)));
    columns.extend([
        numbers::<UInt32Type>(rows.iter().map(|r| r.first_state)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.last_state)),
        numbers::<UInt32Type>(rows.iter().map(|r| count(&r.set))),
        numbers::<UInt32Type>(rows.iter().map(|r| r.effort.segments)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.effort.runs)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.effort.lines)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.effort.rows)),
        numbers::<UInt64Type>(rows.iter().map(|r| r.effort.solver_rays)),
        numbers::<UInt64Type>(rows.iter().map(|r| r.effort.skipped_movers)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.effort.refinements)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.effort.heldout_viewpoints)),
        numbers::<UInt64Type>(rows.iter().map(|r| r.effort.heldout_rays)),
        numbers::<Float64Type>(rows.iter().map(|r| r.effort.heldout_error_mean)),
        numbers::<Float64Type>(rows.iter().map(|r| r.effort.heldout_error_upper)),
        numbers::<Float64Type>(rows.iter().map(|r| r.effort.heldout_error_max)),
        flags(rows.iter().map(|r| r.effort.target_met)),
        sets(rows.iter().map(|r| &r.set)),
        weights(rows.iter().map(|r| &r.weights[..])),
    ]);
    table.batch(columns)
}

/// Pairs as a batch of [`OBJECT_PART`], or of [`OBJECTS`] when the scene's objects are given.
pub(crate) fn object_batch(
    rows: &[ObjectRow],
    objects: Option<&[SceneObject]>,
) -> Result<RecordBatch> {
    let mut columns = vec![
        numbers::<UInt32Type>(rows.iter().map(|r| r.cell.0)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.object.0)),
    ];
    if let Some(objects) = objects {
        columns.push(texts(rows.iter().map(|r| objects[r.object.index()].name.as_str())));
    }
    columns.extend([
        numbers::<UInt32Type>(rows.iter().map(|r| r.visible_primitives)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.total_primitives)),
        numbers::<Float64Type>(rows.iter().map(|r| r.weight)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.first_state)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.last_state)),
    ]);
    if objects.is_some() { OBJECTS.batch(columns) } else { OBJECT_PART.batch(columns) }
}

pub(crate) fn index_batch(rows: &[CellEntry]) -> Result<RecordBatch> {
    let mut columns = vec![
        numbers::<UInt32Type>(rows.iter().map(|r| r.cell.id.0)),
        numbers::<Int32Type>(rows.iter().map(|r| r.tile[0])),
        numbers::<Int32Type>(rows.iter().map(|r| r.tile[1])),
    ];
    columns.extend(boxes(rows.iter().map(|r| r.cell.bounds())));
    columns.extend(cell_geometry(rows.iter().map(|r| &r.cell)));
    columns.extend([
        numbers::<UInt32Type>(rows.iter().map(|r| r.first_state)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.last_state)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.primitives)),
        texts(rows.iter().map(|r| r.set.file.as_str())),
        numbers::<UInt32Type>(rows.iter().map(|r| r.set.row_group)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.set.row)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.set.page_offset)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.set.page_bytes)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.set.page_row)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.set.weights_offset)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.set.weights_bytes)),
        texts(rows.iter().map(|r| r.objects.file.as_str())),
        numbers::<UInt32Type>(rows.iter().map(|r| r.objects.first_row)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.objects.rows)),
    ]);
    INDEX.batch(columns)
}

pub(crate) fn scene_batch(rows: &[SceneObject]) -> Result<RecordBatch> {
    let mut columns = vec![
        numbers::<UInt32Type>(rows.iter().map(|r| r.id.0)),
        texts(rows.iter().map(|r| r.name.as_str())),
        texts(rows.iter().map(|r| r.path.as_str())),
        numbers::<UInt32Type>(rows.iter().map(|r| r.node)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.first_primitive)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.end_primitive)),
        flags(rows.iter().map(|r| r.occluder)),
    ];
    columns.extend(boxes(rows.iter().map(|r| r.bounds)));
    SCENE.batch(columns)
}

pub(crate) fn instance_batch(rows: &[NumberedInstance]) -> Result<RecordBatch> {
    INSTANCES.batch(vec![
        numbers::<UInt32Type>(rows.iter().map(|r| r.first_primitive)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.object.0)),
        numbers::<UInt32Type>(rows.iter().map(|r| r.node)),
        Arc::new(rows.iter().map(|r| r.gpu_instance).collect::<UInt32Array>()),
        numbers::<UInt32Type>(rows.iter().map(|r| r.mesh.0)),
    ])
}

/// A stretch of a mesh's triangles as one row.
pub(crate) fn mesh_batch(mesh: &NumberedMesh, triangles: Range<usize>) -> Result<RecordBatch> {
    let mut list = ListBuilder::new(UInt32Builder::new()).with_field(Field::new(
        "element",
        DataType::UInt32,
        false,
    ));
    list.values().append_slice(&mesh.triangles[triangles.clone()]);
    list.append(true);
    MESHES.batch(vec![
        numbers::<UInt32Type>([mesh.id.0].into_iter()),
        numbers::<UInt32Type>([mesh.gltf_mesh].into_iter()),
        numbers::<UInt32Type>([mesh.gltf_primitive].into_iter()),
        numbers::<UInt32Type>([triangles.start as u32].into_iter()),
        Arc::new(list.finish()),
    ])
}

// Columns to rows.

/// The columns of a batch, by name; mistakes are laid to the file.
struct Columns<'a> {
    batch: &'a RecordBatch,
    file: &'a str,
}

impl<'a> Columns<'a> {
    fn get<T: 'static>(&self, name: &str) -> Result<&'a T> {
        let column = self.batch.column_by_name(name);
        let typed = column.and_then(|c| c.as_any().downcast_ref::<T>());
        typed.ok_or_else(|| {
            StoreError::corrupt(self.file, format!("column `{name}` is missing or of another type"))
        })
    }

    fn has(&self, name: &str) -> bool {
        self.batch.column_by_name(name).is_some()
    }

    /// The first and the last state of each row; all 0 in versions that had no states.
    fn states(&self) -> Result<impl Fn(usize) -> Result<[u32; 2]>> {
        let columns = if self.has("first_state") {
            Some((self.u32s("first_state")?, self.u32s("last_state")?))
        } else {
            None
        };
        let file = self.file;
        Ok(move |row: usize| {
            let Some((first, last)) = columns else { return Ok([0, 0]) };
            let (first, last) = (first[row], last[row]);
            if first > last || last == u32::MAX {
                let problem = format!("a row is of the states {first} to {last}");
                return Err(StoreError::corrupt(file, problem));
            }
            Ok([first, last])
        })
    }

    /// A column that version 1 did not have; `expect` has seen to it that later versions do.
    fn added<T: 'static>(&self, name: &str) -> Result<Option<&'a T>> {
        self.has(name).then(|| self.get(name)).transpose()
    }

    fn numbers<T: ArrowPrimitiveType>(&self, name: &str) -> Result<&'a [T::Native]>
    where
        T::Native: ArrowNativeTypeOp,
    {
        let array = self.get::<PrimitiveArray<T>>(name)?;
        if array.null_count() > 0 {
            let problem = format!("column `{name}` has missing values");
            return Err(StoreError::corrupt(self.file, problem));
        }
        Ok(array.values())
    }

    fn u32s(&self, name: &str) -> Result<&'a [u32]> {
        self.numbers::<UInt32Type>(name)
    }

    fn f64s(&self, name: &str) -> Result<&'a [f64]> {
        self.numbers::<Float64Type>(name)
    }

    fn vector(&self, prefix: &str) -> Result<[&'a [f64]; 3]> {
        Ok([
            self.f64s(&format!("{prefix}_x"))?,
            self.f64s(&format!("{prefix}_y"))?,
            self.f64s(&format!("{prefix}_z"))?,
        ])
    }

    fn set(&self, sets: &BinaryArray, sizes: &[u32], row: usize) -> Result<PrimitiveSet> {
        let set = decode_set(sets.value(row)).map_err(|e| StoreError::corrupt(self.file, e))?;
        if set.len() != u64::from(sizes[row]) {
            let problem = format!("a set of {} primitives has {} members", sizes[row], set.len());
            return Err(StoreError::corrupt(self.file, problem));
        }
        Ok(set)
    }

    fn cells(&self) -> Result<Vec<ViewCell>> {
        let ids = self.u32s("cell")?;
        let mut corners = [[&[] as &[f64]; 3]; 4];
        for (k, corner) in corners.iter_mut().enumerate() {
            *corner = self.vector(&format!("corner{k}"))?;
        }
        let heights = self.f64s("height")?;
        let cell = |row: usize| ViewCell {
            id: CellId(ids[row]),
            corners: corners.map(|[x, y, z]| DVec3::new(x[row], y[row], z[row])),
            height: heights[row],
        };
        Ok((0..ids.len()).map(cell).collect())
    }
}

fn vector_at([x, y, z]: [&[f64]; 3], row: usize) -> DVec3 {
    DVec3::new(x[row], y[row], z[row])
}

pub(crate) fn segment_rows(
    file: &str,
    batch: &RecordBatch,
    wanted: &mut impl FnMut(SegmentId) -> bool,
    rows: &mut Vec<SegmentRow>,
) -> Result<()> {
    let columns = Columns { batch, file };
    let ids = columns.u32s("segment")?;
    let sizes = columns.u32s("primitives")?;
    let sets = columns.get::<BinaryArray>("set")?;
    let weights = columns.get::<ListArray>("weights")?;
    let rays = columns.numbers::<UInt64Type>("rays")?;
    let skipped_movers = columns.numbers::<UInt64Type>("skipped_movers")?;
    let states = columns.states()?;
    for (row, &id) in ids.iter().enumerate() {
        let segment = SegmentId(id);
        if !wanted(segment) {
            continue;
        }
        let set = columns.set(sets, sizes, row)?;
        let list = weights.value(row);
        let list = list.as_any().downcast_ref::<Float32Array>();
        let weights = list.map(|w| w.values().to_vec()).unwrap_or_default();
        if weights.len() as u64 != set.len() {
            let problem = format!("segment {segment} has not one weight a primitive");
            return Err(StoreError::corrupt(file, problem));
        }
        let [first_state, last_state] = states(row)?;
        let (rays, skipped_movers) = (rays[row], skipped_movers[row]);
        rows.push(SegmentRow {
            segment,
            first_state,
            last_state,
            set,
            weights,
            rays,
            skipped_movers,
        });
    }
    Ok(())
}

pub(crate) fn cell_rows(file: &str, batch: &RecordBatch) -> Result<Vec<CellRow>> {
    let columns = Columns { batch, file };
    let tile_x = columns.numbers::<Int32Type>("tile_x")?;
    let tile_z = columns.numbers::<Int32Type>("tile_z")?;
    let sizes = columns.u32s("primitives")?;
    let sets = columns.get::<BinaryArray>("set")?;
    let weights = columns.added::<BinaryArray>("weights")?;
    let efforts = cell_efforts(&columns)?;
    let states = columns.states()?;
    let row = |((row, cell), effort): ((usize, ViewCell), CellEffort)| {
        let set = columns.set(sets, sizes, row)?;
        let weights = match weights {
            Some(weights) => weights.value(row).iter().copied().map(Weight::from_code).collect(),
            None => vec![Weight::UNMEASURED; sizes[row] as usize],
        };
        let ([first_state, last_state], tile) = (states(row)?, [tile_x[row], tile_z[row]]);
        Ok(CellRow { cell, tile, first_state, last_state, set, weights, effort })
    };
    columns.cells()?.into_iter().enumerate().zip(efforts).map(row).collect()
}

fn cell_efforts(columns: &Columns<'_>) -> Result<Vec<CellEffort>> {
    let segments = columns.u32s("segments")?;
    let refinements = columns.u32s("refinements")?;
    let heldout_rays = columns.numbers::<UInt64Type>("heldout_rays")?;
    let error_mean = columns.f64s("heldout_error_mean")?;
    let error_max = columns.f64s("heldout_error_max")?;
    let of_1 = |row: usize| CellEffort {
        segments: segments[row],
        refinements: refinements[row],
        heldout_rays: heldout_rays[row],
        heldout_error_mean: error_mean[row],
        heldout_error_max: error_max[row],
        ..CellEffort::default()
    };
    if !columns.has("runs") {
        return Ok((0..segments.len()).map(of_1).collect());
    }
    let runs = columns.u32s("runs")?;
    let lines = columns.u32s("lines")?;
    let rows = columns.u32s("rows")?;
    let solver_rays = columns.numbers::<UInt64Type>("solver_rays")?;
    let skipped_movers = match columns.has("skipped_movers") {
        true => Some(columns.numbers::<UInt64Type>("skipped_movers")?),
        false => None,
    };
    let heldout_viewpoints = columns.u32s("heldout_viewpoints")?;
    let error_upper = columns.f64s("heldout_error_upper")?;
    let target_met = columns.get::<BooleanArray>("target_met")?;
    let of_2 = |row: usize| CellEffort {
        runs: runs[row],
        lines: lines[row],
        rows: rows[row],
        solver_rays: solver_rays[row],
        skipped_movers: skipped_movers.map_or(0, |skipped_movers| skipped_movers[row]),
        heldout_viewpoints: heldout_viewpoints[row],
        heldout_error_upper: error_upper[row],
        target_met: target_met.value(row),
        ..of_1(row)
    };
    Ok((0..segments.len()).map(of_2).collect())
}

pub(crate) fn object_rows(file: &str, batch: &RecordBatch) -> Result<Vec<ObjectRow>> {
    let columns = Columns { batch, file };
    let cells = columns.u32s("cell")?;
    let objects = columns.u32s("object")?;
    let visible = columns.u32s("visible_primitives")?;
    let total = columns.u32s("total_primitives")?;
    let weights = columns.f64s("weight")?;
    let first_states = columns.u32s("first_state")?;
    let last_states = columns.u32s("last_state")?;
    let row = |row: usize| ObjectRow {
        cell: CellId(cells[row]),
        object: ObjectId(objects[row]),
        visible_primitives: visible[row],
        total_primitives: total[row],
        weight: weights[row],
        first_state: first_states[row],
        last_state: last_states[row],
    };
    Ok((0..batch.num_rows()).map(row).collect())
}

pub(crate) fn index_rows(file: &str, batch: &RecordBatch) -> Result<Vec<CellEntry>> {
    let columns = Columns { batch, file };
    let tile_x = columns.numbers::<Int32Type>("tile_x")?;
    let tile_z = columns.numbers::<Int32Type>("tile_z")?;
    let primitives = columns.u32s("primitives")?;
    let cells_files = columns.get::<StringArray>("cells_file")?;
    let row_groups = columns.u32s("row_group")?;
    let rows = columns.u32s("row")?;
    let page_offsets = columns.u32s("page_offset")?;
    let page_bytes = columns.u32s("page_bytes")?;
    let page_rows = columns.u32s("page_row")?;
    let of_weights =
        |name: &str| if columns.has(name) { columns.u32s(name).map(Some) } else { Ok(None) };
    let weights_offsets = of_weights("weights_offset")?;
    let weights_bytes = of_weights("weights_bytes")?;
    let objects_files = columns.get::<StringArray>("objects_file")?;
    let first_rows = columns.u32s("objects_first_row")?;
    let row_counts = columns.u32s("objects_rows")?;
    let states = columns.states()?;
    let entry = |(row, cell): (usize, ViewCell)| {
        let [first_state, last_state] = states(row)?;
        Ok(CellEntry {
            cell,
            tile: [tile_x[row], tile_z[row]],
            first_state,
            last_state,
            primitives: primitives[row],
            set: SetLocation {
                file: cells_files.value(row).to_owned(),
                row_group: row_groups[row],
                row: rows[row],
                page_offset: page_offsets[row],
                page_bytes: page_bytes[row],
                page_row: page_rows[row],
                weights_offset: weights_offsets.map_or(0, |offsets| offsets[row]),
                weights_bytes: weights_bytes.map_or(0, |bytes| bytes[row]),
            },
            objects: ObjectsLocation {
                file: objects_files.value(row).to_owned(),
                first_row: first_rows[row],
                rows: row_counts[row],
            },
        })
    };
    columns.cells()?.into_iter().enumerate().map(entry).collect()
}

pub(crate) fn scene_rows(file: &str, batch: &RecordBatch) -> Result<Vec<SceneObject>> {
    let columns = Columns { batch, file };
    let ids = columns.u32s("object")?;
    let names = columns.get::<StringArray>("name")?;
    let paths = columns.get::<StringArray>("path")?;
    let nodes = columns.u32s("node")?;
    let first = columns.u32s("first_primitive")?;
    let end = columns.u32s("end_primitive")?;
    let occluders = columns.get::<BooleanArray>("occluder")?;
    let (min, max) = (columns.vector("min")?, columns.vector("max")?);
    let object = |row: usize| SceneObject {
        id: ObjectId(ids[row]),
        name: names.value(row).to_owned(),
        path: paths.value(row).to_owned(),
        node: nodes[row],
        first_primitive: first[row],
        end_primitive: end[row],
        occluder: occluders.value(row),
        bounds: Bounds { min: vector_at(min, row), max: vector_at(max, row) },
    };
    Ok((0..batch.num_rows()).map(object).collect())
}

pub(crate) fn instance_rows(file: &str, batch: &RecordBatch) -> Result<Vec<NumberedInstance>> {
    let columns = Columns { batch, file };
    let first = columns.u32s("first_primitive")?;
    let objects = columns.u32s("object")?;
    let nodes = columns.u32s("node")?;
    let gpu_instances = columns.get::<UInt32Array>("gpu_instance")?;
    let meshes = columns.u32s("mesh")?;
    let instance = |row: usize| NumberedInstance {
        first_primitive: first[row],
        object: ObjectId(objects[row]),
        node: nodes[row],
        gpu_instance: gpu_instances.is_valid(row).then(|| gpu_instances.value(row)),
        mesh: MeshId(meshes[row]),
    };
    Ok((0..batch.num_rows()).map(instance).collect())
}

/// Appends the meshes of a batch; a row that goes on with the last mesh extends it.
pub(crate) fn mesh_rows(
    file: &str,
    batch: &RecordBatch,
    meshes: &mut Vec<NumberedMesh>,
) -> Result<()> {
    let columns = Columns { batch, file };
    let ids = columns.u32s("mesh")?;
    let gltf_meshes = columns.u32s("gltf_mesh")?;
    let gltf_primitives = columns.u32s("gltf_primitive")?;
    let first = columns.u32s("first_triangle")?;
    let lists = columns.get::<ListArray>("triangles")?;
    for row in 0..batch.num_rows() {
        let list = lists.value(row);
        let triangles = list.as_any().downcast_ref::<UInt32Array>();
        let triangles = triangles.map(|t| t.values().as_ref()).unwrap_or_default();
        let id = MeshId(ids[row]);
        match meshes.last_mut() {
            Some(last) if last.id == id && last.triangles.len() == first[row] as usize => {
                let mut all = std::mem::take(&mut last.triangles).into_vec();
                all.extend_from_slice(triangles);
                last.triangles = all.into();
            }
            _ if first[row] == 0 => meshes.push(NumberedMesh {
                id,
                gltf_mesh: gltf_meshes[row],
                gltf_primitive: gltf_primitives[row],
                triangles: triangles.to_vec().into(),
            }),
            _ => {
                let problem = format!("the triangles of mesh {id} are not in order");
                return Err(StoreError::corrupt(file, problem));
            }
        }
    }
    Ok(())
}

/// The set of all primitives below `count`, for comparisons.
pub(crate) fn beyond(set: &PrimitiveSet, count: u64) -> Option<&Run> {
    set.runs().last().filter(|run| u64::from(run.end) > count)
}
