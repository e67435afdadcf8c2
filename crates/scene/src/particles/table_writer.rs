//! Writes particle tables, one key frame after the other: memory is one key frame.
//!
//! Promise: the bytes depend on the rows alone. Parquet is plain, version 1.0 pages, zstd, without
//! an Arrow schema; columns of floats are split by bytes (BYTE_STREAM_SPLIT), which zstd packs far
//! better than whole floats. CSV has the shortest decimals that read back as the same numbers.

use std::io::{self, Write};
use std::sync::Arc;

use arrow_array::{ArrayRef, Float32Array, Float64Array, RecordBatch, UInt32Array};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use parquet::{
    arrow::arrow_writer::{ArrowWriter, ArrowWriterOptions},
    basic::{Compression, Encoding, ZstdLevel},
    errors::ParquetError,
    file::{
        metadata::KeyValue,
        properties::{EnabledStatistics, WriterProperties, WriterVersion},
    },
    schema::types::ColumnPath,
};
use sightline_geometry::Sphere;

use super::TableFormat;

/// Rows in a batch, so that rows are not held twice as columns.
const BATCH_ROWS: usize = 1 << 16;
/// Rows in a row group: some 16 MiB.
const ROW_GROUP_ROWS: usize = 1 << 20;
const ZSTD_LEVEL: i32 = 3;

/// Why a table was not written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The output failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The Parquet writer failed, mostly since its output did.
    #[error(transparent)]
    Parquet(#[from] ParquetError),
}

/// A table in the making. Key frames are numbered in the order in which they are written.
pub struct TableWriter<W: Write + Send> {
    out: Output<W>,
    state: u32,
}

enum Output<W: Write + Send> {
    Parquet(Box<ArrowWriter<W>>),
    Csv(W),
}

impl<W: Write + Send> TableWriter<W> {
    /// Begins a table.
    ///
    /// # Errors
    /// When `out` fails.
    pub fn new(format: TableFormat, mut out: W) -> Result<Self, WriteError> {
        let out = match format {
            TableFormat::Csv => {
                out.write_all(b"state,time,particle,x,y,z,radius\n")?;
                Output::Csv(out)
            }
            TableFormat::Parquet => {
                let options = ArrowWriterOptions::new()
                    .with_properties(properties())
                    .with_skip_arrow_metadata(true);
                let writer = ArrowWriter::try_new_with_options(out, schema(), options)?;
                Output::Parquet(Box::new(writer))
            }
        };
        Ok(Self { out, state: 0 })
    }

    /// Writes the next key frame: its time in seconds, and particles with their spheres in world
    /// space, metres. Particles that are not there have no row.
    ///
    /// # Errors
    /// When the output fails.
    pub fn key_frame(&mut self, time: f64, spheres: &[(u32, Sphere)]) -> Result<(), WriteError> {
        let state = self.state;
        self.state += 1;
        for chunk in spheres.chunks(BATCH_ROWS) {
            let there = chunk.iter().filter(|(_, sphere)| sphere.is_present());
            match &mut self.out {
                Output::Csv(out) => {
                    for (particle, Sphere { center: [x, y, z], radius }) in there {
                        writeln!(out, "{state},{time},{particle},{x},{y},{z},{radius}")?;
                    }
                }
                Output::Parquet(writer) => {
                    let there: Vec<(u32, Sphere)> = there.copied().collect();
                    writer.write(&batch(state, time, &there)?)?;
                }
            }
        }
        Ok(())
    }

    /// Ends the table and returns the output.
    ///
    /// # Errors
    /// When the output fails.
    pub fn finish(self) -> Result<W, WriteError> {
        match self.out {
            Output::Csv(out) => Ok(out),
            Output::Parquet(writer) => Ok(writer.into_inner()?),
        }
    }
}

fn schema() -> SchemaRef {
    let column = |name: &str, kind: DataType| Field::new(name, kind, false);
    Arc::new(Schema::new(vec![
        column("state", DataType::UInt32),
        column("time", DataType::Float64),
        column("particle", DataType::UInt32),
        column("x", DataType::Float32),
        column("y", DataType::Float32),
        column("z", DataType::Float32),
        column("radius", DataType::Float32),
    ]))
}

fn properties() -> WriterProperties {
    let level = ZstdLevel::try_new(ZSTD_LEVEL).unwrap_or_default();
    let pair = |key: &str, value: &str| KeyValue::new(key.to_owned(), value.to_owned());
    let mut properties = WriterProperties::builder()
        .set_created_by("sightline".into())
        .set_writer_version(WriterVersion::PARQUET_1_0)
        .set_compression(Compression::ZSTD(level))
        .set_max_row_group_row_count(Some(ROW_GROUP_ROWS))
        .set_key_value_metadata(Some(vec![
            pair("sightline.format", "sightline-particles"),
            pair("sightline.version", "1"),
        ]));
    for (name, encoding) in [
        ("particle", Encoding::DELTA_BINARY_PACKED),
        ("x", Encoding::BYTE_STREAM_SPLIT),
        ("y", Encoding::BYTE_STREAM_SPLIT),
        ("z", Encoding::BYTE_STREAM_SPLIT),
        ("radius", Encoding::BYTE_STREAM_SPLIT),
    ] {
        let path = ColumnPath::from(name);
        properties = properties
            .set_column_dictionary_enabled(path.clone(), false)
            .set_column_statistics_enabled(path.clone(), EnabledStatistics::Chunk)
            .set_column_encoding(path, encoding);
    }
    properties.build()
}

fn batch(state: u32, time: f64, rows: &[(u32, Sphere)]) -> Result<RecordBatch, WriteError> {
    let floats = |of: fn(&Sphere) -> f32| -> ArrayRef {
        Arc::new(rows.iter().map(|(_, sphere)| of(sphere)).collect::<Float32Array>())
    };
    let columns: Vec<ArrayRef> = vec![
        Arc::new(UInt32Array::from_value(state, rows.len())),
        Arc::new(Float64Array::from_value(time, rows.len())),
        Arc::new(rows.iter().map(|(particle, _)| *particle).collect::<UInt32Array>()),
        floats(|s| s.center[0]),
        floats(|s| s.center[1]),
        floats(|s| s.center[2]),
        floats(|s| s.radius),
    ];
    RecordBatch::try_new(schema(), columns).map_err(|e| ParquetError::from(e).into())
}
