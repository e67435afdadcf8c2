//! From rows to the files of a dataset.
//!
//! Cells come in ascending order, each with the rows of its states and its (cell, object) rows, and stream into files that
//! are stored as soon as they are full: memory holds one open file a kind and the index. Where
//! files and row groups end depends on the rows alone (ST-1). Nothing is visible to readers before
//! [`crate::publish`].

use std::collections::BTreeMap;
use std::ops::Range;

use arrow_array::RecordBatch;
use arrow_array::cast::AsArray;
use bytes::Bytes;
use parquet::arrow::arrow_writer::ArrowWriter;
use parquet::file::metadata::{PageIndexPolicy, ParquetMetaDataReader};
use serde_json::Value;
use sightline_geometry::{Bounds, CellId, PrimitiveSet, Timeline};

use crate::manifest::{
    DataFile, FORMAT, FileKind, Manifest, SceneSource, Totals, VERSION, hash, sorted,
};
use crate::rows::{
    CellEntry, CellRow, Numbering, ObjectRow, ObjectsLocation, SceneObject, SetLocation,
};
use crate::tables::{
    CELLS, INDEX, INSTANCES, MESHES, OBJECTS, SCENE, TRIANGLES_PER_ROW, Table, beyond, cell_batch,
    count, index_batch, instance_batch, mesh_batch, object_batch, scene_batch,
};
use crate::{BakeStore, Result, StoreError, Weight};

/// Hexadecimal digits of a file's hash in its name: 128 bits.
const HASH_DIGITS: usize = 32;
/// Upper bound of what a cell's row takes besides its set and weights: 30 plain values of 8 bytes,
/// and its share of page headers, offset index and footer.
const CELL_BYTES_MAX: usize = 640;
/// Upper bound of what a (cell, object) row takes: 7 plain values of 8 bytes or fewer, a
/// dictionary index, its share of pages and footer. Names are in dictionaries, bounded apart.
const PAIR_BYTES_MAX: usize = 80;
/// Upper bound of a footer without its share per row: schema, metadata, a few row groups.
const FOOTER_BYTES_MAX: usize = 1 << 18;
/// Rows of small tables handed to the Parquet writer at once.
const BATCH_ROWS: usize = 4096;
/// Rows of an index file; at some 250 bytes a row before compression it stays under the limit.
const INDEX_FILE_ROWS: usize = 1 << 17;
/// Rows of a scene or numbering file.
const SCENE_FILE_ROWS: usize = 1 << 17;

/// Limits of the files. The defaults are part of the format: others give other files.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Size of a file at most, bytes.
    pub file_bytes_max: usize,
}

impl Default for Limits {
    /// 64 MB: large enough for engines, small enough to cache and to send again.
    fn default() -> Self {
        Self { file_bytes_max: 64_000_000 }
    }
}

/// What a manifest says besides what the rows show.
#[derive(Clone, Debug, Default)]
pub struct Description {
    /// The scene, with its numbers of particles and of particle systems. The numbers of triangles and
    /// objects are filled in from the objects.
    pub scene: SceneSource,
    /// The configuration.
    pub config: Value,
    /// Its hash, as the bake computes it.
    pub config_hash: String,
    /// Cells without a set, by reason.
    pub skipped: BTreeMap<String, u64>,
}

/// Writes the files of one dataset.
pub struct DatasetWriter {
    store: BakeStore,
    limits: Limits,
    objects: Vec<SceneObject>,
    primitives: u64,
    timeline: Timeline,
    cell_count: u64,
    cells: Option<OpenFile>,
    pairs: Option<OpenFile>,
    /// Index rows; those at and behind `cells_from` and `pairs_from` wait for their files' names.
    index: Vec<CellEntry>,
    cells_from: usize,
    pairs_from: usize,
    files: Vec<DataFile>,
    totals: Totals,
    bounds: Bounds,
}

/// A file that is being filled.
struct OpenFile {
    writer: ArrowWriter<Vec<u8>>,
    rows: u32,
    first_cell: CellId,
    last_cell: CellId,
}

impl OpenFile {
    fn new(table: &Table, first_cell: CellId) -> Result<Self> {
        let writer = table.writer()?;
        Ok(Self { writer, rows: 0, first_cell, last_cell: first_cell })
    }

    /// Upper bound of the file's size when `more` bytes are added.
    fn size_with(&self, more: usize, footer_bytes_a_row: usize) -> usize {
        self.writer.bytes_written()
            + self.writer.in_progress_size()
            + self.rows as usize * footer_bytes_a_row
            + FOOTER_BYTES_MAX
            + more
    }
}

impl DatasetWriter {
    /// A writer into `store` for the scene with these objects and states.
    ///
    /// # Errors
    /// [`StoreError::InvalidRows`] when objects are not numbered from 0 in the order of their
    /// primitives, without gaps.
    pub fn new(store: &BakeStore, objects: Vec<SceneObject>, timeline: Timeline) -> Result<Self> {
        Self::with_limits(store, objects, timeline, Limits::default())
    }

    /// A writer with other limits, for tests.
    ///
    /// # Errors
    /// As [`DatasetWriter::new`].
    pub fn with_limits(
        store: &BakeStore,
        objects: Vec<SceneObject>,
        timeline: Timeline,
        limits: Limits,
    ) -> Result<Self> {
        let primitives = check_objects(&objects).map_err(|problem| SCENE.invalid(problem))?;
        Ok(Self {
            store: store.clone(),
            limits,
            objects,
            primitives,
            timeline,
            cell_count: 0,
            cells: None,
            pairs: None,
            index: Vec::new(),
            cells_from: 0,
            pairs_from: 0,
            files: Vec::new(),
            totals: Totals::default(),
            bounds: Bounds::EMPTY,
        })
    }

    /// Adds a cell: the row of all states, then those of its runs of states where it has several; and
    /// its (cell, object) rows, one for each object of which it sees a primitive in any state.
    ///
    /// # Errors
    /// [`StoreError::InvalidRows`] when cells are not in strictly ascending order, the rows of the
    /// cell contradict each other, or the objects' rows do not fit the sets; or what the store
    /// reports.
    pub async fn push_cell(&mut self, rows: &[CellRow], pairs: &[ObjectRow]) -> Result<()> {
        check_runs(rows, self.timeline.states()).map_err(|problem| CELLS.invalid(problem))?;
        let union = &rows[0];
        if self.index.last().is_some_and(|last| last.cell.id >= union.cell.id) {
            return Err(CELLS.invalid(format!("cell {} is out of order", union.cell.id)));
        }
        for row in rows {
            check_cell(row, self.primitives).map_err(|problem| CELLS.invalid(problem))?;
        }
        check_pairs(union, pairs, &self.objects).map_err(|problem| OBJECTS.invalid(problem))?;
        check_pair_states(rows, pairs, &self.objects)
            .map_err(|problem| OBJECTS.invalid(problem))?;
        check_weights(union, pairs, &self.objects).map_err(|problem| CELLS.invalid(problem))?;
        let first_row = self.write_pairs(union.cell.id, pairs).await?;
        self.cell_count += 1;
        self.totals.object_rows += pairs.len() as u64;
        self.bounds = self.bounds.union(union.cell.bounds());
        for row in rows {
            self.write_cell(row).await?;
            self.totals.cell_rows += 1;
            self.totals.primitives += row.set.len();
            self.index.push(CellEntry {
                cell: row.cell.clone(),
                tile: row.tile,
                first_state: row.first_state,
                last_state: row.last_state,
                primitives: count(&row.set),
                set: SetLocation {
                    file: String::new(),
                    row_group: 0,
                    row: 0,
                    page_offset: 0,
                    page_bytes: 0,
                    page_row: 0,
                    weights_offset: 0,
                    weights_bytes: 0,
                },
                objects: ObjectsLocation {
                    file: String::new(),
                    first_row,
                    rows: pairs.len() as u32,
                },
            });
        }
        Ok(())
    }

    /// Stores what is left, the index, the scene and the numbering; gives the manifest, which
    /// [`crate::publish`] makes current.
    ///
    /// # Errors
    /// [`StoreError::InvalidRows`] when the numbering does not fit the objects; or what the store
    /// reports.
    pub async fn finish(mut self, numbering: &Numbering, about: Description) -> Result<Manifest> {
        let particles = about.scene.particles;
        let triangles = self.primitives.checked_sub(particles).ok_or_else(|| {
            SCENE.invalid(format!("{particles} particles are more than there are primitives"))
        })?;
        numbering.check(triangles).map_err(|problem| INSTANCES.invalid(problem))?;
        self.close_cells().await?;
        self.close_pairs().await?;
        self.store_index().await?;
        self.store_scene().await?;
        self.store_numbering(numbering).await?;
        self.files.sort_by_key(|file| (file.kind, file.first_cell));
        self.totals.file_bytes = self.files.iter().map(|file| file.bytes).sum();
        Ok(Manifest {
            format: FORMAT.into(),
            version: VERSION,
            scene: SceneSource { triangles, objects: self.objects.len() as u64, ..about.scene },
            config: sorted(&about.config),
            config_hash: about.config_hash,
            states: self.timeline.states(),
            key_times: self.timeline.key_times().to_vec(),
            cells: self.cell_count,
            skipped: about.skipped,
            totals: self.totals,
            bounds: (!self.bounds.is_empty()).then(|| self.bounds.into()),
            files: self.files,
        })
    }

    async fn write_cell(&mut self, row: &CellRow) -> Result<()> {
        let batch = cell_batch(&CELLS, std::slice::from_ref(row))?;
        let set_bytes = encoded_bytes(&batch, "set");
        self.totals.set_bytes += set_bytes as u64;
        let more = set_bytes + encoded_bytes(&batch, "weights") + CELL_BYTES_MAX;
        if let Some(open) = &self.cells
            && open.size_with(more, CELL_BYTES_MAX / 8) > self.limits.file_bytes_max
        {
            self.close_cells().await?;
        }
        let open = match &mut self.cells {
            Some(open) => open,
            none => none.insert(OpenFile::new(&CELLS, row.cell.id)?),
        };
        open.writer.write(&batch).map_err(|e| CELLS.invalid(e))?;
        open.rows += 1;
        open.last_cell = row.cell.id;
        Ok(())
    }

    /// Writes a cell's pairs into one file; gives the first row's number in it.
    async fn write_pairs(&mut self, cell: CellId, pairs: &[ObjectRow]) -> Result<u32> {
        let names: usize =
            pairs.iter().map(|pair| self.objects[pair.object.index()].name.len() + 8).sum();
        let more = pairs.len() * PAIR_BYTES_MAX + names;
        if let Some(open) = &self.pairs
            && open.size_with(more, 1) > self.limits.file_bytes_max
        {
            self.close_pairs().await?;
        }
        let open = match &mut self.pairs {
            Some(open) => open,
            none => none.insert(OpenFile::new(&OBJECTS, cell)?),
        };
        let first_row = open.rows;
        for rows in pairs.chunks(BATCH_ROWS) {
            let batch = object_batch(rows, Some(&self.objects))?;
            open.writer.write(&batch).map_err(|e| OBJECTS.invalid(e))?;
        }
        open.rows += pairs.len() as u32;
        open.last_cell = cell;
        Ok(first_row)
    }

    async fn close_cells(&mut self) -> Result<()> {
        let Some(open) = self.cells.take() else { return Ok(()) };
        let cells = Some((open.first_cell, open.last_cell));
        let bytes = self.finished(&CELLS, open.writer)?;
        let file =
            self.store_file(FileKind::Cells, &CELLS, bytes.clone(), open.rows, cells).await?;
        let waiting = self.cells_from..self.index.len();
        self.cells_from = self.index.len();
        locate_sets(&file, bytes, &mut self.index[waiting])
    }

    async fn close_pairs(&mut self) -> Result<()> {
        let Some(open) = self.pairs.take() else { return Ok(()) };
        let cells = Some((open.first_cell, open.last_cell));
        let bytes = self.finished(&OBJECTS, open.writer)?;
        let file = self.store_file(FileKind::Objects, &OBJECTS, bytes, open.rows, cells).await?;
        let waiting = self.pairs_from..self.index.len();
        self.pairs_from = self.index.len();
        for entry in &mut self.index[waiting] {
            entry.objects.file.clone_from(&file);
        }
        Ok(())
    }

    async fn store_index(&mut self) -> Result<()> {
        for range in stretches(self.index.len(), INDEX_FILE_ROWS) {
            let entries = &self.index[range];
            let bytes = INDEX.encode(entries.chunks(BATCH_ROWS).map(index_batch))?;
            let rows = entries.len() as u32;
            let ends = entries.first().zip(entries.last());
            let cells = ends.map(|(first, last)| (first.cell.id, last.cell.id));
            self.store_file(FileKind::Index, &INDEX, bytes, rows, cells).await?;
        }
        Ok(())
    }

    async fn store_scene(&mut self) -> Result<()> {
        for range in stretches(self.objects.len(), SCENE_FILE_ROWS) {
            let objects = &self.objects[range];
            let bytes = SCENE.encode(objects.chunks(BATCH_ROWS).map(scene_batch))?;
            self.store_file(FileKind::Scene, &SCENE, bytes, objects.len() as u32, None).await?;
        }
        Ok(())
    }

    async fn store_numbering(&mut self, numbering: &Numbering) -> Result<()> {
        for range in stretches(numbering.instances.len(), SCENE_FILE_ROWS) {
            let rows = &numbering.instances[range];
            let bytes = INSTANCES.encode(rows.chunks(BATCH_ROWS).map(instance_batch))?;
            let count = rows.len() as u32;
            self.store_file(FileKind::Numbering, &INSTANCES, bytes, count, None).await?;
        }
        let mut open: Option<OpenFile> = None;
        for mesh in &numbering.meshes {
            for triangles in stretches(mesh.triangles.len(), TRIANGLES_PER_ROW) {
                // Delta encoding never takes more than plain numbers and a block header.
                let more = 5 * triangles.len() + CELL_BYTES_MAX;
                if let Some(full) =
                    open.take_if(|open| open.size_with(more, 16) > self.limits.file_bytes_max)
                {
                    self.store_meshes(full).await?;
                }
                let batch = mesh_batch(mesh, triangles)?;
                let file = match &mut open {
                    Some(file) => file,
                    none => none.insert(OpenFile::new(&MESHES, CellId(0))?),
                };
                file.writer.write(&batch).map_err(|e| MESHES.invalid(e))?;
                file.rows += 1;
            }
        }
        match open {
            Some(open) => self.store_meshes(open).await,
            None => self.store_meshes(OpenFile::new(&MESHES, CellId(0))?).await,
        }
    }

    async fn store_meshes(&mut self, open: OpenFile) -> Result<()> {
        let bytes = self.finished(&MESHES, open.writer)?;
        self.store_file(FileKind::Meshes, &MESHES, bytes, open.rows, None).await.map(drop)
    }

    fn finished(&self, table: &Table, writer: ArrowWriter<Vec<u8>>) -> Result<Bytes> {
        writer.into_inner().map(Bytes::from).map_err(|e| table.invalid(e))
    }

    /// Stores a finished file under its content's name and lists it; gives its key.
    async fn store_file(
        &mut self,
        kind: FileKind,
        table: &Table,
        bytes: Bytes,
        rows: u32,
        cells: Option<(CellId, CellId)>,
    ) -> Result<String> {
        if bytes.len() > self.limits.file_bytes_max {
            let (size, limit) = (bytes.len(), self.limits.file_bytes_max);
            return Err(
                table.invalid(format!("a file takes {size} bytes, and {limit} are allowed"))
            );
        }
        let blake3 = hash(&bytes);
        let name = format!("data/{}-{}.parquet", kind.name(), &blake3[..HASH_DIGITS]);
        let size = bytes.len() as u64;
        let footer = bytes.slice(footer_start(&name, &bytes)?..);
        self.store.create_content(&name, bytes).await?;
        self.files.push(DataFile {
            name: name.clone(),
            kind,
            bytes: size,
            blake3,
            footer_bytes: footer.len() as u64,
            footer_blake3: hash(&footer),
            rows: rows.into(),
            first_cell: cells.map(|(first, _)| first.0),
            last_cell: cells.map(|(_, last)| last.0),
        });
        Ok(name)
    }
}

/// Cuts `0..len` into stretches of `size`; one empty stretch when there is nothing to cut.
fn stretches(len: usize, size: usize) -> impl Iterator<Item = Range<usize>> {
    (0..len.div_ceil(size).max(1)).map(move |k| k * size..((k + 1) * size).min(len))
}

/// Where the page index and the footer of a finished file start: they follow each other, and all
/// that is behind the last page belongs to them.
fn footer_start(file: &str, bytes: &Bytes) -> Result<usize> {
    let metadata = ParquetMetaDataReader::new()
        .parse_and_finish(bytes)
        .map_err(|e| StoreError::corrupt(file, e))?;
    let columns = metadata.row_groups().iter().flat_map(|group| group.columns());
    let ends = columns.map(|column| {
        let (start, length) = column.byte_range();
        (start + length) as usize
    });
    // A file without rows has its footer right behind the four bytes of its signature.
    Ok(ends.max().unwrap_or(4))
}

/// Size of a binary value in a batch of one cell.
fn encoded_bytes(batch: &RecordBatch, column: &str) -> usize {
    let values = batch.column_by_name(column).map(|column| column.as_binary::<i32>());
    values.map_or(0, |values| values.value(0).len())
}

/// Fills in where the sets and weights of a finished cells file lie, from its own offset index.
fn locate_sets(file: &str, bytes: Bytes, entries: &mut [CellEntry]) -> Result<()> {
    let odd = |problem: &str| StoreError::corrupt(file, problem);
    let metadata = ParquetMetaDataReader::new()
        .with_page_index_policy(PageIndexPolicy::Optional)
        .parse_and_finish(&bytes)
        .map_err(|e| StoreError::corrupt(file, e))?;
    let column = |name| CELLS.columns.iter().position(|c| c.0 == name);
    let columns = column("set").zip(column("weights"));
    let (set_column, weights_column) = columns.ok_or_else(|| odd("it has no sets"))?;
    let mut entries = entries.iter_mut();
    for (group, group_metadata) in metadata.row_groups().iter().enumerate() {
        let index = metadata.page_index_for_row_group(group);
        let pages =
            index.page_locations(set_column).ok_or_else(|| odd("it has no offset index"))?;
        let weights =
            index.page_locations(weights_column).ok_or_else(|| odd("it has no offset index"))?;
        if pages.len() != weights.len() {
            return Err(odd("its sets and weights are paged otherwise"));
        }
        let rows = group_metadata.num_rows() as u32;
        for (k, page) in pages.iter().enumerate() {
            let first = page.first_row_index as u32;
            let end = pages.get(k + 1).map_or(rows, |next| next.first_row_index as u32);
            for row in first..end {
                let entry = entries.next().ok_or_else(|| odd("it has more rows than cells"))?;
                entry.set = SetLocation {
                    file: file.to_owned(),
                    row_group: group as u32,
                    row,
                    page_offset: page.offset as u32,
                    page_bytes: page.compressed_page_size as u32,
                    page_row: row - first,
                    weights_offset: weights[k].offset as u32,
                    weights_bytes: weights[k].compressed_page_size as u32,
                };
            }
        }
    }
    if entries.next().is_some() {
        return Err(odd("it has fewer rows than cells"));
    }
    Ok(())
}

/// Checks the scene's objects; gives the number of primitives.
pub(crate) fn check_objects(objects: &[SceneObject]) -> Result<u64, String> {
    let mut next = 0;
    for (k, object) in objects.iter().enumerate() {
        if object.id.index() != k {
            return Err(format!("object {} stands at place {k}", object.id));
        }
        if object.first_primitive != next || object.end_primitive < next {
            return Err(format!(
                "object {k} holds primitives {}..{}; objects follow each other, and primitive \
                 {next} is next",
                object.first_primitive, object.end_primitive
            ));
        }
        next = object.end_primitive;
    }
    Ok(next.into())
}

/// Checks the rows of one cell against each other: that of all states first, then, where there are
/// several runs, one a run of states with equal sets.
pub(crate) fn check_runs(rows: &[CellRow], states: u32) -> Result<(), String> {
    let Some((union, runs)) = rows.split_first() else {
        return Err("a cell has no row".into());
    };
    let id = union.cell.id;
    if rows.iter().any(|row| row.last_state < row.first_state || row.last_state >= states) {
        return Err(format!("a row of cell {id} is of states that the scene does not have"));
    }
    if union.states() != (0..states) {
        return Err(format!("the first row of cell {id} is not of all {states} states"));
    }
    if rows.iter().any(|row| row.cell != union.cell || row.tile != union.tile) {
        return Err(format!("the rows of cell {id} are of different cells"));
    }
    if !rows.is_sorted_by(|a, b| a.order() < b.order()) {
        return Err(format!("the rows of cell {id} are not in strictly ascending order"));
    }
    if runs.is_empty() {
        return Ok(());
    }
    let runs = by_time(runs);
    let meet = runs.windows(2).all(|pair| pair[0].states().end == pair[1].first_state);
    let whole = runs[0].first_state..runs[runs.len() - 1].last_state + 1;
    if !meet || whole != (0..states) {
        return Err(format!("the runs of cell {id} do not take each state once"));
    }
    if runs.windows(2).any(|pair| pair[0].set == pair[1].set) {
        return Err(format!("two runs of cell {id} that meet have equal sets"));
    }
    if PrimitiveSet::union(runs.iter().map(|run| &run.set)) != union.set {
        return Err(format!("the first row of cell {id} is not the union of its runs"));
    }
    Ok(())
}

/// Rows of runs in the order of their states.
fn by_time(runs: &[CellRow]) -> Vec<&CellRow> {
    let mut runs: Vec<&CellRow> = runs.iter().collect();
    runs.sort_unstable_by_key(|run| run.first_state);
    runs
}

/// Checks the states of a cell's (cell, object) rows: the first and the last in which the object is
/// visible.
///
/// The rows have passed [`check_runs`] and [`check_pairs`].
pub(crate) fn check_pair_states(
    rows: &[CellRow],
    pairs: &[ObjectRow],
    objects: &[SceneObject],
) -> Result<(), String> {
    let runs = by_time(if rows.len() > 1 { &rows[1..] } else { rows });
    for pair in pairs {
        let object = &objects[pair.object.index()];
        let own = object.first_primitive..object.end_primitive;
        let seen = |run: &&&CellRow| run.set.count_in(own.clone()) > 0;
        let first = runs.iter().find(seen).map(|run| run.first_state);
        let last = runs.iter().rev().find(seen).map(|run| run.last_state);
        if (Some(pair.first_state), Some(pair.last_state)) != (first, last) {
            return Err(format!(
                "cell {} does not see object {} in the states {} to {} that its row says",
                pair.cell, pair.object, pair.first_state, pair.last_state
            ));
        }
    }
    Ok(())
}

/// Checks a cell's row against the scene.
pub(crate) fn check_cell(row: &CellRow, primitives: u64) -> Result<(), String> {
    let id = row.cell.id;
    if let Some(run) = beyond(&row.set, primitives) {
        return Err(format!(
            "cell {id} sees primitive {}, and the scene has {primitives}",
            run.end - 1
        ));
    }
    if row.weights.len() as u64 != row.set.len() {
        return Err(format!(
            "cell {id} has {} weights for {} primitives; {REPAIR}",
            row.weights.len(),
            row.set.len()
        ));
    }
    let finite = row.cell.corners.iter().all(|c| c.is_finite()) && row.cell.height.is_finite();
    if !finite || row.cell.height < 0.0 {
        return Err(format!("cell {id} has no proper shape"));
    }
    Ok(())
}

/// Bound on the relative error of a sum of weights besides that of their codes: each has 24 bits
/// when it leaves the solver, and sums of up to 2^32 of them in 53 bits lose no more than 21.
const SUM_ROUNDING: f64 = 1.0 / (1 << 20) as f64;

/// What helps against weights that contradict themselves.
const REPAIR: &str = "fetch the dataset again from where it was published, or bake again";

/// Checks the weights of a cell's first row against the weights of its objects: each object's is the sum of those
/// of its primitives, up to the rounding of the codes.
///
/// The rows have passed [`check_cell`] and [`check_pairs`].
pub(crate) fn check_weights(
    row: &CellRow,
    pairs: &[ObjectRow],
    objects: &[SceneObject],
) -> Result<(), String> {
    let cell = row.cell.id;
    let mut members = row.set.iter().zip(&row.weights);
    let mut whole = 0.0;
    for pair in pairs {
        let object = &objects[pair.object.index()];
        let members = members.by_ref().take(pair.visible_primitives as usize);
        let sum: f64 = members.filter_map(|(_, weight)| weight.share()).sum();
        // Each share is within a factor of the code's rounding; those that took the lowest code
        // may be anything below it.
        let factor = 1.0 + Weight::RELATIVE_ERROR + SUM_ROUNDING;
        let lowest = Weight::from_code(1).share().unwrap_or(0.0);
        let slack = lowest * f64::from(pair.visible_primitives);
        // See-through primitives of one object may cover each other: their sum is cut at 1.
        let not_less = pair.weight >= 1.0 || sum <= pair.weight * factor + slack;
        let not_more = pair.weight <= sum * factor + slack;
        if !(not_less && not_more) {
            return Err(format!(
                "the weights of the primitives of object {} in cell {cell} add up to {sum:.3e}, \
                 and its row says {:.3e}; {REPAIR}",
                pair.object, pair.weight
            ));
        }
        whole += if object.occluder { sum } else { 0.0 };
    }
    if whole > 1.0 + Weight::RELATIVE_ERROR + SUM_ROUNDING {
        return Err(format!(
            "the weights of cell {cell} add up to {whole:.3} of the view; {REPAIR}"
        ));
    }
    Ok(())
}

/// Checks a cell's (cell, object) rows against its set.
pub(crate) fn check_pairs(
    row: &CellRow,
    pairs: &[ObjectRow],
    objects: &[SceneObject],
) -> Result<(), String> {
    let cell = row.cell.id;
    if !pairs.is_sorted_by(|a, b| a.object < b.object) {
        return Err(format!("the objects of cell {cell} are not in strictly ascending order"));
    }
    let mut seen = 0;
    for pair in pairs {
        if pair.cell != cell {
            return Err(format!("a row of cell {} stands among those of cell {cell}", pair.cell));
        }
        let Some(object) = objects.get(pair.object.index()) else {
            return Err(format!("cell {cell} sees object {}, which does not exist", pair.object));
        };
        let visible = row.set.count_in(object.first_primitive..object.end_primitive);
        let total = object.end_primitive - object.first_primitive;
        if visible != u64::from(pair.visible_primitives) || total != pair.total_primitives {
            return Err(format!(
                "cell {cell} sees {visible} of {total} primitives of object {}, and its row says \
                 {} of {}",
                pair.object, pair.visible_primitives, pair.total_primitives
            ));
        }
        if visible == 0 || !pair.weight.is_finite() {
            return Err(format!("cell {cell} has an empty row for object {}", pair.object));
        }
        seen += visible;
    }
    if seen != row.set.len() {
        return Err(format!(
            "cell {cell} sees {} primitives, and the rows of its objects have {seen}",
            row.set.len()
        ));
    }
    Ok(())
}
