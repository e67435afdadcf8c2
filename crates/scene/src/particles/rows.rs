//! Rows of a table, one after the other, from Parquet or CSV.
//!
//! Promise: memory is a few batches of [`BATCH_ROWS`] rows, whatever the file claims; a row is either
//! handed on with sound values or refused with its place. The order of rows is the caller's business.
//! Rows come in the order of the file, though Parquet is decoded on a thread of its own.

use std::{
    fs::File,
    io::{self, BufReader, Read, Seek},
    panic::{AssertUnwindSafe, catch_unwind},
    path::Path,
    sync::mpsc,
};

use arrow_array::{
    Array, RecordBatch,
    cast::AsArray,
    types::{
        ArrowPrimitiveType, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type,
        UInt8Type, UInt16Type, UInt32Type, UInt64Type,
    },
};
use arrow_schema::DataType;
use glam::DVec3;
use parquet::{
    arrow::{
        ProjectionMask,
        arrow_reader::{ArrowReaderOptions, ParquetRecordBatchReaderBuilder},
    },
    file::reader::ChunkReader,
};

use super::reach::Reach;
use super::{RowPlace, TableProblem};
use crate::{
    Cause, SceneError,
    gltf_reader::{MAX_COORDINATE, document::shorten},
};

/// Rows that are decoded at once.
const BATCH_ROWS: usize = 8192;
/// Batches that are decoded ahead of who takes them.
const BATCHES_AHEAD: usize = 2;
/// Largest time of a key frame, seconds: differences of times stay finite and exact to a
/// millisecond.
const TIME_MAX: f64 = 1e12;
/// Largest bound on a motion, metres a second, or a second squared: faster than light.
const REACH_MAX: f64 = 1e9;

const COLUMNS: [&str; 9] =
    ["particle", "x", "y", "z", "radius", "state", "time", "max_speed", "max_acceleration"];
/// The first so many columns have to be there.
const REQUIRED: usize = 5;
const PARTICLE: usize = 0;
const X: usize = 1;
const Y: usize = 2;
const Z: usize = 3;
const RADIUS: usize = 4;
const STATE: usize = 5;
const TIME: usize = 6;
const MAX_SPEED: usize = 7;
const MAX_ACCELERATION: usize = 8;

/// Where each of [`COLUMNS`] is in a file.
type Places = [Option<usize>; COLUMNS.len()];

const INTEGER_RULE: &str = "it has to be a whole number from 0 to 4294967295";
const NUMBER_RULE: &str = "it has to be a number";
const MISSING_RULE: &str = "every row has a value";

/// A row with sound values: finite, within the limits of a scene, radius above 0.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    pub(super) place: RowPlace,
    pub(super) particle: u32,
    /// Number of the key frame; 0 without such a column.
    pub(super) state: u32,
    /// Time of the key frame, seconds.
    pub(super) time: Option<f64>,
    /// World space, metres.
    pub(super) center: DVec3,
    /// Metres.
    pub(super) radius: f64,
    /// The most that is known of how it moves, in tables that say so.
    pub(super) reach: Option<Reach>,
}

/// Formats of tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TableFormat {
    /// Apache Parquet.
    Parquet,
    /// Comma-separated values with a header.
    Csv,
}

impl TableFormat {
    /// The format that the extension of a file names, in any case; `None` for others.
    #[must_use]
    pub fn of(path: &Path) -> Option<Self> {
        let extension = path.extension()?.to_str()?;
        [("parquet", Self::Parquet), ("csv", Self::Csv)]
            .into_iter()
            .find_map(|(name, format)| extension.eq_ignore_ascii_case(name).then_some(format))
    }
}

/// The bytes of a table: an open file, or memory.
pub(super) enum Source {
    File(File),
    Memory(bytes::Bytes),
}

impl Source {
    pub(super) fn open(path: &Path) -> Result<Self, SceneError> {
        let read = |source| SceneError::from(Cause::Read { source });
        // Opening a named pipe would wait for a writer.
        if !std::fs::metadata(path).map_err(read)?.is_file() {
            return Err(Cause::NotAFile.into());
        }
        Ok(Self::File(File::open(path).map_err(read)?))
    }

    /// The bytes from the start.
    fn reader(&self) -> io::Result<Box<dyn Read + '_>> {
        match self {
            Self::File(file) => {
                let mut file: &File = file;
                file.rewind()?;
                Ok(Box::new(BufReader::with_capacity(1 << 20, file)))
            }
            Self::Memory(bytes) => Ok(Box::new(&**bytes)),
        }
    }

    /// Size and BLAKE3 hash.
    pub(super) fn hash(&self) -> Result<(u64, blake3::Hash), SceneError> {
        let mut hasher = blake3::Hasher::new();
        self.reader()
            .and_then(|reader| hasher.update_reader(reader).map(|_| ()))
            .map_err(|source| Cause::Read { source })?;
        Ok((hasher.count(), hasher.finalize()))
    }

    /// Hands every row on, in the order of the file.
    pub(super) fn for_each_row(
        &self,
        format: TableFormat,
        mut each: impl FnMut(Row) -> Result<(), TableProblem>,
    ) -> Result<(), SceneError> {
        match (format, self) {
            (TableFormat::Csv, _) => {
                let reader = self.reader().map_err(|source| Cause::Read { source })?;
                csv_rows(reader, &mut each)
            }
            (TableFormat::Parquet, Self::File(file)) => {
                let file = file.try_clone().map_err(|source| Cause::Read { source })?;
                parquet_rows(file, &mut each)
            }
            (TableFormat::Parquet, Self::Memory(bytes)) => parquet_rows(bytes.clone(), &mut each),
        }
    }
}

/// What takes rows.
type Each<'a> = &'a mut dyn FnMut(Row) -> Result<(), TableProblem>;

/// Where each of [`COLUMNS`] is among the columns of a file.
fn find_columns<'a>(names: impl Iterator<Item = &'a str> + Clone) -> Result<Places, TableProblem> {
    let mut found: Places = Default::default();
    for (k, column) in COLUMNS.into_iter().enumerate() {
        let mut places = names.clone().enumerate().filter(|(_, name)| *name == column);
        found[k] = places.next().map(|(at, _)| at);
        if places.next().is_some() {
            return Err(TableProblem::ColumnTwice { column });
        }
        if k < REQUIRED && found[k].is_none() {
            let listed: Vec<String> =
                names.clone().take(32).map(|name| format!("`{}`", shorten(name))).collect();
            let found = if listed.is_empty() { "none".into() } else { listed.join(", ") };
            return Err(TableProblem::ColumnMissing { column, found: shorten(&found) });
        }
    }
    Ok(found)
}

/// A row of its numbers, in the order of [`COLUMNS`]; `None` for a column that is not there.
fn row(
    place: RowPlace,
    particle: u32,
    state: Option<u32>,
    [x, y, z, radius]: [f64; 4],
    time: Option<f64>,
    reach: [Option<f64>; 2],
) -> Result<Row, TableProblem> {
    let refuse = |column: usize, value: f64, rule| {
        let column = COLUMNS[column];
        Err(TableProblem::Value { place, column, value: format!("{value}"), rule })
    };
    // As an `f32`, since that is how it is kept. Also refuses NaN.
    if !(radius as f32 > 0.0 && radius.is_finite()) {
        return refuse(RADIUS, radius, "a sphere has a radius above 0 metres");
    }
    for (column, value) in [(X, x), (Y, y), (Z, z)] {
        if !value.is_finite() {
            return refuse(column, value, "coordinates are finite, in metres");
        }
        if value.abs() + radius > MAX_COORDINATE {
            return refuse(column, value, "spheres lie within 1e15 metres of the world's origin");
        }
    }
    if let Some(time) = time.filter(|time| time.is_nan() || time.abs() > TIME_MAX) {
        return refuse(TIME, time, "times lie within 1e12 seconds of 0");
    }
    for (column, value) in [MAX_SPEED, MAX_ACCELERATION].into_iter().zip(reach) {
        if let Some(value) = value.filter(|value| !(0.0..=REACH_MAX).contains(value)) {
            return refuse(column, value, "the most that is known of a motion is from 0 to 1e9");
        }
    }
    let reach = reach.iter().any(Option::is_some).then(|| {
        let [speed, acceleration] = reach.map(|most| most.unwrap_or(f64::INFINITY));
        Reach { speed, acceleration }
    });
    let center = DVec3::new(x, y, z);
    Ok(Row { place, particle, state: state.unwrap_or(0), time, center, radius, reach })
}

fn csv_rows(reader: impl Read, each: Each<'_>) -> Result<(), SceneError> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(reader);
    let malformed = |row: Option<u64>, error: csv::Error| -> SceneError {
        let line = error.position().map(csv::Position::line);
        let place = row.map(|row| RowPlace { row, line });
        match error.into_kind() {
            csv::ErrorKind::Io(source) => Cause::Read { source }.into(),
            csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
                let reason = format!("it has {len} fields instead of {expected_len}");
                TableProblem::Malformed { place, reason }.into()
            }
            csv::ErrorKind::Utf8 { .. } => {
                TableProblem::Malformed { place, reason: "it is not UTF-8".into() }.into()
            }
            other => {
                let reason = shorten(&format!("{other:?}"));
                TableProblem::Malformed { place, reason }.into()
            }
        }
    };
    let header = reader.headers().map_err(|e| malformed(None, e))?.clone();
    let columns = find_columns(header.iter())?;
    let mut record = csv::ByteRecord::new();
    for number in 0.. {
        if !reader.read_byte_record(&mut record).map_err(|e| malformed(Some(number), e))? {
            break;
        }
        let line = record.position().map(csv::Position::line);
        let place = RowPlace { row: number, line };
        each(csv_row(&record, &columns, place)?)?;
    }
    Ok(())
}

fn csv_row(
    record: &csv::ByteRecord,
    columns: &Places,
    place: RowPlace,
) -> Result<Row, TableProblem> {
    fn parse<T: std::str::FromStr>(
        record: &csv::ByteRecord,
        (column, at): (usize, usize),
        place: RowPlace,
        rule: &'static str,
    ) -> Result<T, TableProblem> {
        let field = record.get(at).unwrap_or_default();
        let number = std::str::from_utf8(field).ok().and_then(|text| text.parse().ok());
        number.ok_or_else(|| TableProblem::Value {
            place,
            column: COLUMNS[column],
            value: format!("`{}`", shorten(&String::from_utf8_lossy(field))),
            rule: if field.is_empty() { MISSING_RULE } else { rule },
        })
    }
    let integer = |column: usize| -> Result<Option<u32>, TableProblem> {
        columns[column].map(|at| parse(record, (column, at), place, INTEGER_RULE)).transpose()
    };
    let number = |column: usize| -> Result<Option<f64>, TableProblem> {
        columns[column].map(|at| parse(record, (column, at), place, NUMBER_RULE)).transpose()
    };
    // Columns that have to be there are there.
    let required = |column: usize| Ok(number(column)?.unwrap_or(f64::NAN));
    let sphere = [required(X)?, required(Y)?, required(Z)?, required(RADIUS)?];
    let reach = [number(MAX_SPEED)?, number(MAX_ACCELERATION)?];
    row(place, integer(PARTICLE)?.unwrap_or(0), integer(STATE)?, sphere, number(TIME)?, reach)
}

/// Runs the Parquet parser, which is not free of panics on damaged files; what a panic leaves behind is
/// dropped.
fn guarded<T>(
    place: Option<RowPlace>,
    parse: impl FnOnce() -> Result<T, String>,
) -> Result<T, TableProblem> {
    catch_unwind(AssertUnwindSafe(parse))
        .unwrap_or_else(|_| Err("it is not well-formed Parquet".into()))
        .map_err(|reason| TableProblem::Malformed { place, reason: shorten(&reason) })
}

fn parquet_rows<T: ChunkReader + 'static>(input: T, each: Each<'_>) -> Result<(), SceneError> {
    // Plain Parquet types: an Arrow schema in the file could ask for any other.
    let options = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
    let builder = guarded(None, || {
        ParquetRecordBatchReaderBuilder::try_new_with_options(input, options)
            .map_err(|e| e.to_string())
    })?;
    let fields = builder.schema().fields();
    let columns = find_columns(fields.iter().map(|field| field.name().as_str()))?;
    for (k, at) in columns.iter().enumerate() {
        if let Some(at) = *at {
            check_type(COLUMNS[k], k == PARTICLE || k == STATE, fields[at].data_type())?;
        }
    }
    let mut reader = guarded(None, || {
        let mask = ProjectionMask::roots(builder.parquet_schema(), columns.into_iter().flatten());
        let builder = builder.with_projection(mask).with_batch_size(BATCH_ROWS);
        builder.build().map_err(|e| e.to_string())
    })?;
    // One thread decodes while the other takes the rows.
    std::thread::scope(|scope| {
        let (sender, batches) = mpsc::sync_channel(BATCHES_AHEAD);
        scope.spawn(move || {
            let mut first = 0;
            loop {
                let place = RowPlace { row: first, line: None };
                let next = || reader.next().transpose().map_err(|e| e.to_string());
                let Some(batch) = guarded(Some(place), next).transpose() else { return };
                let rows = batch.as_ref().ok().map(RecordBatch::num_rows);
                // Nobody takes what follows an error, be it ours or of who takes the rows.
                let (Ok(()), Some(rows)) = (sender.send((first, batch)), rows) else { return };
                first += rows as u64;
            }
        });
        for (first, batch) in batches {
            batch_rows(&batch?, first, each)?;
        }
        Ok(())
    })
}

fn check_type(column: &'static str, integer: bool, found: &DataType) -> Result<(), TableProblem> {
    let float = matches!(found, DataType::Float32 | DataType::Float64);
    if found.is_integer() || (float && !integer) {
        return Ok(());
    }
    let wanted = if integer { "integers" } else { "32-bit or 64-bit floats, or integers" };
    Err(TableProblem::ColumnType { column, found: shorten(&found.to_string()), wanted })
}

/// The rows of a batch whose types are checked.
fn batch_rows(batch: &RecordBatch, first: u64, each: Each<'_>) -> Result<(), TableProblem> {
    let column = |k: usize| batch.column_by_name(COLUMNS[k]).map(|array| (k, &**array));
    let place = |row: usize| RowPlace { row: first + row as u64, line: None };
    for (k, array) in (0..COLUMNS.len()).filter_map(column) {
        let nulls = array.null_count();
        if let Some(row) = (0..array.len()).find(|&row| nulls > 0 && array.is_null(row)) {
            return Err(TableProblem::Value {
                place: place(row),
                column: COLUMNS[k],
                value: "null".into(),
                rule: MISSING_RULE,
            });
        }
    }
    let integers = |k: usize| column(k).map(|(_, array)| integers(array));
    let numbers = |k: usize| column(k).map(|(_, array)| numbers(array));
    let (particle, state) = (integers(PARTICLE).unwrap_or_default(), integers(STATE));
    let [x, y, z, radius] = [X, Y, Z, RADIUS].map(|k| numbers(k).unwrap_or_default());
    let [time, speed, acceleration] = [TIME, MAX_SPEED, MAX_ACCELERATION].map(numbers);
    let at = |column: &Option<Vec<f64>>, row: usize| column.as_ref().map(|values| values[row]);
    for i in 0..batch.num_rows() {
        let place = place(i);
        let whole = |k: usize, value: i128| {
            u32::try_from(value).map_err(|_| TableProblem::Value {
                place,
                column: COLUMNS[k],
                value: value.to_string(),
                rule: INTEGER_RULE,
            })
        };
        each(row(
            place,
            whole(PARTICLE, particle[i])?,
            state.as_ref().map(|state| whole(STATE, state[i])).transpose()?,
            [x[i], y[i], z[i], radius[i]],
            at(&time, i),
            [at(&speed, i), at(&acceleration, i)],
        )?)?;
    }
    Ok(())
}

/// Values of a column of integers.
fn integers(array: &dyn Array) -> Vec<i128> {
    fn of<T: ArrowPrimitiveType>(array: &dyn Array) -> Vec<i128>
    where
        T::Native: Into<i128>,
    {
        array.as_primitive::<T>().values().iter().map(|&v| v.into()).collect()
    }
    match array.data_type() {
        DataType::Int8 => of::<Int8Type>(array),
        DataType::Int16 => of::<Int16Type>(array),
        DataType::Int32 => of::<Int32Type>(array),
        DataType::Int64 => of::<Int64Type>(array),
        DataType::UInt8 => of::<UInt8Type>(array),
        DataType::UInt16 => of::<UInt16Type>(array),
        DataType::UInt32 => of::<UInt32Type>(array),
        DataType::UInt64 => of::<UInt64Type>(array),
        other => unreachable!("types are checked before: {other}"),
    }
}

/// Values of a column of floats or integers.
fn numbers(array: &dyn Array) -> Vec<f64> {
    match array.data_type() {
        DataType::Float64 => array.as_primitive::<Float64Type>().values().to_vec(),
        DataType::Float32 => {
            array.as_primitive::<Float32Type>().values().iter().map(|&v| v.into()).collect()
        }
        _ => integers(array).into_iter().map(|v| v as f64).collect(),
    }
}
