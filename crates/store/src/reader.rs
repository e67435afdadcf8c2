//! Reading a dataset: pointer, manifest and index first, then a cell at a time.
//!
//! Opening reads three kinds of small objects and verifies their hashes. A cell then takes one
//! request for its pages, and the first cell of a file one more for the file's footer. Files that
//! are read whole and footers are verified by hash; pages read alone as far as zstd, Parquet and
//! the set encoding can. [`Dataset::check`] verifies everything.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use arrow_array::RecordBatch;
use bytes::Bytes;
use futures::stream::{self, Stream, StreamExt, TryStreamExt};
use glam::DVec3;
use parquet::DecodeResult;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, RowGroupSelection, RowSelection, RowSelector,
};
use parquet::arrow::push_decoder::ParquetPushDecoderBuilder;
use parquet::errors::ParquetError;
use parquet::file::metadata::{PageIndexPolicy, ParquetMetaDataPushDecoder};
use sightline_geometry::{CellId, StateSets, Timeline};

use crate::manifest::{DataFile, FileKind, Manifest, Pointer, hash};
use crate::publish::current;
use crate::rows::{CellEntry, CellRow, Numbering, ObjectRow, SceneObject};
use crate::tables::{
    CELLS, INDEX, INSTANCES, MESHES, OBJECTS, SCENE, Table, cell_rows, guarded, index_rows,
    instance_rows, mesh_rows, object_rows, scene_rows,
};
use crate::{BakeStore, Result, StoreError, keys};

/// A published dataset. Cells, index and manifest are those that were current when it was opened.
///
/// Invariants: `cells` has one entry a cell, ascending, of all states; `runs` has those of the runs of
/// cells that have several, ascending by cell and time, and those of a cell take each state once.
#[derive(Debug)]
pub struct Dataset {
    store: BakeStore,
    pointer: Pointer,
    manifest: Manifest,
    timeline: Timeline,
    cells: Vec<CellEntry>,
    runs: Vec<CellEntry>,
    footers: Mutex<HashMap<String, Arc<ArrowReaderMetadata>>>,
}

impl Dataset {
    /// Opens the current dataset in `store`: pointer, manifest and index.
    ///
    /// # Errors
    /// [`StoreError::NotADataset`] when nothing is published there,
    /// [`StoreError::UnsupportedVersion`], [`StoreError::Corrupt`] with the damaged file, or what
    /// the store reports.
    pub async fn open(store: &BakeStore) -> Result<Self> {
        let Some((pointer, manifest)) = current(store).await? else {
            return Err(not_a_dataset(store).await);
        };
        let manifest_name = keys::manifest(pointer.manifest);
        let timeline = Timeline::new(manifest.key_times.clone())
            .map_err(|problem| StoreError::corrupt(&manifest_name, problem))?;
        if timeline.states() != manifest.states {
            let problem = format!("its key frames do not have {} states between", manifest.states);
            return Err(StoreError::corrupt(&manifest_name, problem));
        }
        let mut index: Vec<CellEntry> = Vec::new();
        for file in manifest.files_of(FileKind::Index) {
            let bytes = verified(store, file).await?;
            for batch in INDEX.decode(&file.name, bytes)? {
                index.append(&mut index_rows(&file.name, &batch?)?);
            }
            if !index.is_sorted_by(|a, b| a.order() < b.order()) {
                return Err(StoreError::corrupt(&file.name, "cells are not in ascending order"));
            }
        }
        let (cells, runs) = split_index(index, timeline.states())
            .map_err(|problem| StoreError::corrupt(&manifest_name, problem))?;
        if cells.len() as u64 != manifest.cells {
            let (counted, found) = (manifest.cells, cells.len());
            let problem = format!("it counts {counted} cells, and the index has {found}");
            return Err(StoreError::corrupt(&manifest_name, problem));
        }
        let (store, footers) = (store.clone(), Mutex::default());
        Ok(Self { store, pointer, manifest, timeline, cells, runs, footers })
    }

    /// Number of the manifest that was current.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.pointer.manifest
    }

    /// The manifest.
    #[must_use]
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The store that the dataset lies in.
    #[must_use]
    pub fn store(&self) -> &BakeStore {
        &self.store
    }

    /// When the states of the scene are.
    #[must_use]
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// Number of states of the scene; 1 for one at rest.
    #[must_use]
    pub fn states(&self) -> u32 {
        self.timeline.states()
    }

    /// The index: all cells without their sets, in ascending order; of each, the entry of all states.
    #[must_use]
    pub fn cells(&self) -> &[CellEntry] {
        &self.cells
    }

    /// The index row of a cell, of all states.
    #[must_use]
    pub fn entry(&self, cell: CellId) -> Option<&CellEntry> {
        let found = self.cells.binary_search_by_key(&cell, |entry| entry.cell.id);
        found.ok().map(|k| &self.cells[k])
    }

    /// The index rows of a cell's runs of states, by time: its only row where nothing changes. Empty
    /// for a cell that does not exist.
    #[must_use]
    pub fn runs(&self, cell: CellId) -> &[CellEntry] {
        let from = self.runs.partition_point(|entry| entry.cell.id < cell);
        let end = from + self.runs[from..].partition_point(|entry| entry.cell.id == cell);
        if from < end {
            return &self.runs[from..end];
        }
        self.entry(cell).map_or(&[], std::slice::from_ref)
    }

    /// The cell that a point is in; the one with the lowest number where cells touch. Looks at the
    /// boxes of all cells.
    #[must_use]
    pub fn cell_at(&self, point: DVec3) -> Option<CellId> {
        self.cells.iter().find(|entry| entry.cell.contains(point)).map(|entry| entry.cell.id)
    }

    /// A cell with the set of all states: what is visible in any of them. Reads its pages only.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] when the dataset has no such cell, [`StoreError::Corrupt`] with the
    /// damaged or missing file, or what the store reports.
    pub async fn cell(&self, cell: CellId) -> Result<CellRow> {
        self.row(self.known(cell)?).await
    }

    /// A cell with the set of the run of states that holds `state`. Reads its pages only.
    ///
    /// # Errors
    /// As [`Dataset::cell`]; [`StoreError::NotFound`] also when the scene has no such state.
    pub async fn cell_in_state(&self, cell: CellId, state: u32) -> Result<CellRow> {
        self.known(cell)?;
        let run = self.runs(cell).iter().find(|run| run.states().contains(&state));
        let run = run.ok_or_else(|| StoreError::NotFound {
            key: format!("state {state} of cell {cell}"),
            location: self.store.location().to_owned(),
        })?;
        self.row(run).await
    }

    /// The sets of a cell, by runs of states. Reads their pages only.
    ///
    /// # Errors
    /// As [`Dataset::cell`].
    pub async fn state_sets(&self, cell: CellId) -> Result<StateSets> {
        self.known(cell)?;
        let mut runs = Vec::new();
        for entry in self.runs(cell) {
            runs.push((entry.states(), self.row(entry).await?.set));
        }
        Ok(StateSets::from_runs(runs))
    }

    /// The row of an index entry.
    async fn row(&self, entry: &CellEntry) -> Result<CellRow> {
        let place = &entry.set;
        let selection =
            RowSelection::from(vec![RowSelector::skip(place.row as usize), RowSelector::select(1)]);
        let rows = self
            .select(FileKind::Cells, &CELLS, &place.file, |builder| {
                let group = place.row_group as usize;
                builder
                    .with_row_group_selections(vec![RowGroupSelection::new(group, Some(selection))])
            })
            .await?;
        let rows: Result<Vec<_>> = rows.iter().map(|b| cell_rows(&place.file, b)).collect();
        match rows?.into_iter().flatten().next() {
            Some(row) if row.order() == entry.order() => Ok(row),
            _ => {
                let problem = format!("cell {} is not where the index says", entry.cell.id);
                Err(StoreError::corrupt(&place.file, problem))
            }
        }
    }

    /// The (cell, object) rows of a cell, by object. Reads the pages with these rows only.
    ///
    /// # Errors
    /// As [`Dataset::cell`].
    pub async fn object_rows(&self, cell: CellId) -> Result<Vec<ObjectRow>> {
        let place = &self.known(cell)?.objects;
        if place.rows == 0 {
            return Ok(Vec::new());
        }
        let selection = RowSelection::from(vec![
            RowSelector::skip(place.first_row as usize),
            RowSelector::select(place.rows as usize),
        ]);
        let batches = self
            .select(FileKind::Objects, &OBJECTS, &place.file, |builder| {
                let names = OBJECTS.columns.iter().map(|c| c.0).filter(|c| *c != "object_name");
                let mask = ProjectionMask::columns(builder.parquet_schema(), names);
                builder.with_row_selection(selection).with_projection(mask)
            })
            .await?;
        let rows: Result<Vec<_>> = batches.iter().map(|b| object_rows(&place.file, b)).collect();
        let rows: Vec<ObjectRow> = rows?.into_iter().flatten().collect();
        if rows.len() != place.rows as usize || rows.iter().any(|row| row.cell != cell) {
            let problem = format!("the rows of cell {cell} are not where the index says");
            return Err(StoreError::corrupt(&place.file, problem));
        }
        Ok(rows)
    }

    /// All rows of cells with their sets, in ascending order: of each cell that of all states first,
    /// then those of its runs, the longest first. Reads whole files, one after the other.
    pub fn cell_rows(&self) -> impl Stream<Item = Result<CellRow>> + '_ {
        self.rows_of(FileKind::Cells, &CELLS, cell_rows)
    }

    /// All (cell, object) rows, in ascending order. Reads whole files, one after the other.
    pub fn all_object_rows(&self) -> impl Stream<Item = Result<ObjectRow>> + '_ {
        self.rows_of(FileKind::Objects, &OBJECTS, object_rows)
    }

    /// The objects of the scene, by number.
    ///
    /// # Errors
    /// [`StoreError::Corrupt`] with the damaged or missing file, or what the store reports.
    pub async fn objects(&self) -> Result<Vec<SceneObject>> {
        self.rows_of(FileKind::Scene, &SCENE, scene_rows).try_collect().await
    }

    /// From primitive numbers to the triangles of the glTF file.
    ///
    /// # Errors
    /// As [`Dataset::objects`].
    pub async fn numbering(&self) -> Result<Numbering> {
        let instances =
            self.rows_of(FileKind::Numbering, &INSTANCES, instance_rows).try_collect().await?;
        let mut meshes = Vec::new();
        for file in self.manifest.files_of(FileKind::Meshes) {
            let bytes = verified(&self.store, file).await?;
            for batch in MESHES.decode(&file.name, bytes)? {
                mesh_rows(&file.name, &batch?, &mut meshes)?;
            }
        }
        Ok(Numbering { instances, meshes })
    }

    /// The rows of all files of a kind; one file is in memory at a time, decoded bit by bit.
    fn rows_of<'a, R: 'a>(
        &'a self,
        kind: FileKind,
        table: &'static Table,
        decode: fn(&str, &RecordBatch) -> Result<Vec<R>>,
    ) -> impl Stream<Item = Result<R>> + 'a {
        stream::iter(self.manifest.files_of(kind))
            .then(move |file| async move {
                let bytes = verified(&self.store, file).await?;
                let batches = table.decode(&file.name, bytes)?;
                let rows = batches.map(move |batch| decode(&file.name, &batch?));
                Ok::<_, StoreError>(stream::iter(rows))
            })
            .try_flatten()
            .map_ok(|rows| stream::iter(rows.into_iter().map(Ok)))
            .try_flatten()
    }

    fn known(&self, cell: CellId) -> Result<&CellEntry> {
        self.entry(cell).ok_or_else(|| StoreError::NotFound {
            key: format!("cell {cell}"),
            location: self.store.location().to_owned(),
        })
    }

    /// The batches that a selection of a file gives, reading no more than its pages.
    async fn select(
        &self,
        kind: FileKind,
        table: &Table,
        file: &str,
        select: impl FnOnce(ParquetPushDecoderBuilder) -> ParquetPushDecoderBuilder,
    ) -> Result<Vec<RecordBatch>> {
        let listed = self.manifest.files_of(kind).find(|f| f.name == file);
        let Some(listed) = listed else {
            let problem = format!("it does not list `{file}`, which the index names");
            return Err(StoreError::corrupt(&keys::manifest(self.number()), problem));
        };
        let footer = self.footer(table, listed).await?;
        let builder = ParquetPushDecoderBuilder::new_with_metadata((*footer).clone());
        let mut decoder = guarded(file, || select(builder).build())?;
        let mut batches = Vec::new();
        loop {
            match guarded(file, || decoder.try_decode())? {
                DecodeResult::NeedsData(ranges) => {
                    let parts = missing(file, self.store.get_ranges(file, &ranges).await)?;
                    guarded(file, || decoder.push_ranges(ranges, parts))?;
                }
                DecodeResult::Data(batch) => batches.push(batch),
                DecodeResult::Finished => return Ok(batches),
            }
        }
    }

    /// The footer of a file with its offset index; read once.
    async fn footer(&self, table: &Table, file: &DataFile) -> Result<Arc<ArrowReaderMetadata>> {
        let lock = || self.footers.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(footer) = lock().get(&file.name) {
            return Ok(Arc::clone(footer));
        }
        let range = file.bytes.saturating_sub(file.footer_bytes)..file.bytes;
        let bytes = missing(&file.name, self.store.get_range(&file.name, range.clone()).await)?;
        if hash(&bytes) != file.footer_blake3 {
            let problem = "the hash of its footer is not the one in the manifest";
            return Err(StoreError::corrupt(&file.name, problem));
        }
        let footer = guarded(&file.name, || {
            let mut decoder = ParquetMetaDataPushDecoder::try_new(file.bytes)?
                .with_offset_index_policy(PageIndexPolicy::Optional)
                .with_column_index_policy(PageIndexPolicy::Skip);
            decoder.push_range(range, bytes)?;
            match decoder.try_decode()? {
                DecodeResult::Data(metadata) => {
                    ArrowReaderMetadata::try_new(Arc::new(metadata), Table::reader_options())
                }
                _ => Err(ParquetError::EOF("the footer is longer than listed".into())),
            }
        })?;
        let footer = Arc::new(footer);
        table.expect(&file.name, &footer)?;
        lock().insert(file.name.clone(), Arc::clone(&footer));
        Ok(footer)
    }
}

/// Tells entries of all states, one a cell, from those of runs; the latter by time.
fn split_index(
    index: Vec<CellEntry>,
    states: u32,
) -> Result<(Vec<CellEntry>, Vec<CellEntry>), String> {
    let (cells, mut runs): (Vec<_>, Vec<_>) =
        index.into_iter().partition(|entry| entry.states() == (0..states));
    runs.sort_by_key(|entry| (entry.cell.id, entry.first_state));
    let mut known = cells.iter();
    for own in runs.chunk_by(|a, b| a.cell.id == b.cell.id) {
        let id = own[0].cell.id;
        if !known.any(|entry| entry.cell.id == id) {
            return Err(format!("the index has no row of all states of cell {id}"));
        }
        let meet = own.windows(2).all(|pair| pair[0].states().end == pair[1].first_state);
        let (first, last) = (own[0].first_state, own[own.len() - 1].last_state);
        if !meet || (first, last) != (0, states - 1) {
            return Err(format!("the index does not take each state of cell {id} once"));
        }
    }
    Ok((cells, runs))
}

/// The bytes of a file of the dataset, verified.
pub(crate) async fn verified(store: &BakeStore, file: &DataFile) -> Result<Bytes> {
    let bytes = missing(&file.name, store.get(&file.name).await)?;
    if bytes.len() as u64 != file.bytes {
        let problem = format!("it has {} bytes instead of {}", bytes.len(), file.bytes);
        return Err(StoreError::corrupt(&file.name, problem));
    }
    if hash(&bytes) != file.blake3 {
        return Err(StoreError::corrupt(&file.name, "its hash is not the one in the manifest"));
    }
    Ok(bytes)
}

/// A missing file that the manifest names is damage, not a wrong question.
fn missing<T>(file: &str, result: Result<T>) -> Result<T> {
    result.map_err(|error| match error {
        StoreError::NotFound { .. } => StoreError::corrupt(file, "it is missing"),
        other => other,
    })
}

async fn not_a_dataset(store: &BakeStore) -> StoreError {
    let location = store.location().to_owned();
    let bakes = match store.list(keys::BAKE_FOLDER).await {
        Ok(bakes) => bakes,
        Err(error) => return error,
    };
    let problem = if bakes.is_empty() {
        format!("it has no `{}`", keys::POINTER)
    } else {
        "a bake was started here and has published nothing yet".into()
    };
    StoreError::NotADataset { location, problem }
}
