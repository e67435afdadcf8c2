//! Checking a dataset: every checksum, every rule of the format.
//!
//! Problems are collected, each with the file it lies in, so that one run shows all damage. Only a
//! store that does not answer ends a check early.

use futures::TryStreamExt;
use sightline_geometry::CellId;

use crate::manifest::{DataFile, FileKind, hash};
use crate::publish::current;
use crate::reader::verified;
use crate::rows::{CellEntry, CellRow, ObjectRow, SceneObject};
use crate::tables::{CELLS, INDEX, INSTANCES, MESHES, OBJECTS, SCENE, Table, count};
use crate::tables::{cell_rows, object_rows};
use crate::writer::{
    check_cell, check_objects, check_pair_states, check_pairs, check_runs, check_weights,
};
use crate::{BakeStore, Dataset, Result, StoreError, keys};

/// What is wrong with a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// Key of the file.
    pub file: String,
    /// What is wrong with it.
    pub problem: String,
}

/// What a check found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CheckReport {
    /// Files that were read, pointer and manifest included.
    pub files: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Cells whose sets and rows were compared.
    pub cells: u64,
    /// What is wrong, in the order it was found.
    pub problems: Vec<Problem>,
}

impl CheckReport {
    /// True when nothing is wrong.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.problems.is_empty()
    }

    /// Notes damage; hands on errors of other classes.
    fn note<T>(&mut self, result: Result<T>) -> Result<Option<T>> {
        match result {
            Ok(value) => Ok(Some(value)),
            Err(StoreError::Corrupt { file, problem }) => {
                self.problems.push(Problem { file, problem });
                Ok(None)
            }
            Err(error @ StoreError::UnsupportedVersion { .. }) => {
                let StoreError::UnsupportedVersion { file, .. } = &error else { unreachable!() };
                self.problems.push(Problem { file: file.clone(), problem: error.to_string() });
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    fn broken(&mut self, file: &str, problem: impl Into<String>) {
        self.problems.push(Problem { file: file.into(), problem: problem.into() });
    }
}

impl Dataset {
    /// Checks the current dataset in `store` from the pointer on: every file's size and hash, then
    /// every rule of the format. Reads everything.
    ///
    /// # Errors
    /// [`StoreError::NotADataset`], or what the store reports. Damage is no error, but in the
    /// report.
    pub async fn check(store: &BakeStore) -> Result<CheckReport> {
        let mut report = CheckReport::default();
        let found = current(store).await;
        let Some(found) = report.note(found)? else { return Ok(report) };
        if let Some((pointer, manifest)) = &found {
            report.files = 2;
            let manifest_size = store.size(&keys::manifest(pointer.manifest)).await?;
            report.bytes = store.size(keys::POINTER).await? + manifest_size;
            let sum = manifest.files.iter().map(|f| f.bytes).sum::<u64>();
            if sum != manifest.totals.file_bytes {
                let name = keys::manifest(pointer.manifest);
                report.broken(&name, "its files' sizes do not add up to its total");
            }
            for file in &manifest.files {
                check_file(store, file, &mut report).await?;
            }
        }
        if report.is_sound() {
            let opened = Self::open(store).await;
            if let Some(dataset) = report.note(opened)? {
                let checked = dataset.check_rules(&mut report).await;
                report.note(checked)?;
            }
        }
        Ok(report)
    }

    async fn check_rules(&self, report: &mut CheckReport) -> Result<()> {
        let manifest_name = keys::manifest(self.number());
        let objects = self.objects().await?;
        let primitives = match check_objects(&objects) {
            Ok(primitives) => primitives,
            Err(problem) => {
                report.broken(first_file(self, FileKind::Scene), problem);
                return Ok(());
            }
        };
        let scene = &self.manifest().scene;
        let counted = scene.triangles.checked_add(scene.particles);
        if (counted, scene.objects) != (Some(primitives), objects.len() as u64) {
            report.broken(&manifest_name, "it counts other primitives or objects than the scene");
        }
        if let Err(problem) = self.numbering().await?.check(scene.triangles) {
            report.broken(first_file(self, FileKind::Numbering), problem);
        }
        self.check_cells(&objects, primitives, report).await?;
        let totals = self.manifest().totals;
        let (mut rows, mut listed) = (0, 0);
        for cell in self.cells() {
            // A cell with one run has one row.
            let runs = self.runs(cell.cell.id);
            let more = if runs.len() > 1 { runs } else { &[] };
            rows += 1 + more.len() as u64;
            listed +=
                std::iter::once(cell).chain(more).map(|e| u64::from(e.primitives)).sum::<u64>();
        }
        // Versions before 3 had one row a cell, and did not count them.
        if self.manifest().version > 2 && totals.cell_rows != rows {
            report.broken(&manifest_name, "its number of rows is not that of the index");
        }
        let pairs: u64 = self.cells().iter().map(|e| u64::from(e.objects.rows)).sum();
        if (totals.primitives, totals.object_rows) != (listed, pairs) {
            report.broken(&manifest_name, "its totals differ from the sums over the cells");
        }
        Ok(())
    }

    /// Walks cells, index rows and (cell, object) rows side by side.
    async fn check_cells(
        &self,
        objects: &[SceneObject],
        primitives: u64,
        report: &mut CheckReport,
    ) -> Result<()> {
        let mut next_cell = 0;
        let mut pairs = std::pin::pin!(self.all_object_rows());
        let mut next_pair = pairs.try_next().await?;
        let mut stream = std::pin::pin!(self.cell_rows());
        let mut next_row = stream.try_next().await?;
        while let Some(first) = next_row.take() {
            let id = first.cell.id;
            let mut rows = vec![first];
            next_row = stream.try_next().await?;
            while let Some(row) = next_row.take_if(|row| row.cell.id == id) {
                rows.push(row);
                next_row = stream.try_next().await?;
            }
            let Some(entry) = self.cells().get(next_cell) else {
                report.broken(first_file(self, FileKind::Index), "cells are missing in it");
                return Ok(());
            };
            next_cell += 1;
            let mut own = Vec::new();
            while let Some(pair) = next_pair.filter(|pair| pair.cell <= id) {
                own.push(pair);
                next_pair = pairs.try_next().await?;
            }
            let runs = self.runs(entry.cell.id);
            let found = Found { rows: &rows, pairs: &own, entry, runs };
            // Version 1 had no weights.
            let weighed = self.manifest().version > 1;
            found.check(objects, primitives, self.states(), weighed, report);
            report.cells += 1;
        }
        if next_cell < self.cells().len() || next_pair.is_some() {
            report
                .broken(first_file(self, FileKind::Cells), "cells of the index are missing in it");
        }
        Ok(())
    }
}

/// What the files of a dataset have of one cell.
struct Found<'a> {
    /// Its rows, at least one.
    rows: &'a [CellRow],
    pairs: &'a [ObjectRow],
    /// The index entry of all states.
    entry: &'a CellEntry,
    /// Those of its runs by time; the same where there is one.
    runs: &'a [CellEntry],
}

impl Found<'_> {
    fn check(
        &self,
        objects: &[SceneObject],
        primitives: u64,
        states: u32,
        weighed: bool,
        report: &mut CheckReport,
    ) {
        let Self { rows, pairs, entry, runs } = *self;
        let union = &rows[0];
        let of_cells = rows.iter().try_for_each(|row| check_cell(row, primitives));
        if let Err(problem) = of_cells.and_then(|()| check_runs(rows, states)) {
            report.broken(&entry.set.file, problem);
            return;
        }
        let of_pairs = check_pairs(union, pairs, objects);
        match of_pairs.and_then(|()| check_pair_states(rows, pairs, objects)) {
            Err(problem) => report.broken(&entry.objects.file, problem),
            Ok(()) if !weighed => {}
            Ok(()) => {
                if let Err(problem) = check_weights(union, pairs, objects) {
                    report.broken(&entry.set.file, problem);
                }
            }
        }
        let listed = if runs.len() > 1 { runs.len() + 1 } else { 1 };
        let agrees = |entry: &CellEntry, row: &CellRow| {
            entry.cell == row.cell
                && entry.tile == row.tile
                && entry.states() == row.states()
                && entry.primitives == count(&row.set)
                && entry.objects.rows as usize == pairs.len()
        };
        let mut behind = rows.iter().skip(1);
        let all_agree = listed == rows.len()
            && agrees(entry, union)
            && behind.all(|row| runs.iter().any(|entry| agrees(entry, row)));
        if !all_agree {
            let problem = format!("the index and the rows of cell {} differ", union.cell.id);
            report.broken(&entry.set.file, problem);
        }
    }
}

/// Checks one file by itself: size, hash, format, columns, number of rows, range of cells.
async fn check_file(store: &BakeStore, file: &DataFile, report: &mut CheckReport) -> Result<()> {
    report.files += 1;
    report.bytes += file.bytes;
    if !file.name.ends_with(&format!("-{}.parquet", &file.blake3.get(..32).unwrap_or_default())) {
        report.broken(&file.name, "its name is not that of its content");
    }
    let bytes = verified(store, file).await;
    let Some(bytes) = report.note(bytes)? else { return Ok(()) };
    let footer = bytes.len().saturating_sub(file.footer_bytes as usize);
    if hash(&bytes[footer..]) != file.footer_blake3 {
        report.broken(&file.name, "the hash of its footer is not the one in the manifest");
    }
    let counted = count_rows(file, bytes);
    let Some((rows, cells)) = report.note(counted)? else { return Ok(()) };
    if rows != file.rows {
        report.broken(&file.name, format!("it has {rows} rows instead of {}", file.rows));
    }
    let listed = file.first_cell.zip(file.last_cell);
    if let (Some((first, last)), Some((listed_first, listed_last))) = (cells, listed)
        && (first.0 < listed_first || last.0 > listed_last)
    {
        report.broken(&file.name, "it holds cells that the manifest lays elsewhere");
    }
    Ok(())
}

/// The number of rows of a file, and its first and last cell where it holds cells.
fn count_rows(file: &DataFile, bytes: bytes::Bytes) -> Result<(u64, Option<(CellId, CellId)>)> {
    let mut rows = 0;
    let mut ends: Option<(CellId, CellId)> = None;
    for batch in table(file.kind).decode(&file.name, bytes)? {
        let batch = batch?;
        rows += batch.num_rows() as u64;
        let ids: Vec<CellId> = match file.kind {
            FileKind::Cells => {
                cell_rows(&file.name, &batch)?.iter().map(|row| row.cell.id).collect()
            }
            FileKind::Objects => {
                object_rows(&file.name, &batch)?.iter().map(|row| row.cell).collect()
            }
            _ => Vec::new(),
        };
        if let (Some(&first), Some(&last)) = (ids.first(), ids.last()) {
            ends = Some((ends.map_or(first, |(first, _)| first), last));
        }
    }
    Ok((rows, ends))
}

fn table(kind: FileKind) -> &'static Table {
    match kind {
        FileKind::Cells => &CELLS,
        FileKind::Objects => &OBJECTS,
        FileKind::Index => &INDEX,
        FileKind::Scene => &SCENE,
        FileKind::Numbering => &INSTANCES,
        FileKind::Meshes => &MESHES,
    }
}

fn first_file(dataset: &Dataset, kind: FileKind) -> &str {
    dataset.manifest().files_of(kind).next().map_or(keys::POINTER, |file| file.name.as_str())
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use sightline_geometry::{Bounds, ObjectId, PrimitiveSet, ViewCell};

    use super::*;
    use crate::{CellEffort, ObjectsLocation, SetLocation, Weight};

    /// A cell that sees three primitives of one object, of which the rows say `weight`.
    fn problems_with(weights: &[f64], weight: f64) -> Vec<Problem> {
        let cell = ViewCell { id: CellId(7), corners: [DVec3::ZERO; 4], height: 0.0 };
        let row = CellRow {
            cell: cell.clone(),
            tile: [0, 0],
            first_state: 0,
            last_state: 0,
            set: PrimitiveSet::from_sorted([1, 2, 4]),
            weights: weights.iter().map(|w| Weight::from_share(*w)).collect(),
            effort: CellEffort::default(),
        };
        let set = SetLocation {
            file: "data/cells-x.parquet".into(),
            row_group: 0,
            row: 0,
            page_offset: 4,
            page_bytes: 20,
            page_row: 0,
            weights_offset: 24,
            weights_bytes: 20,
        };
        let objects_at =
            ObjectsLocation { file: "data/objects-x.parquet".into(), first_row: 0, rows: 1 };
        let entry = CellEntry {
            cell,
            tile: [0, 0],
            first_state: 0,
            last_state: 0,
            primitives: 3,
            set,
            objects: objects_at,
        };
        let pair = ObjectRow {
            cell: CellId(7),
            object: ObjectId(0),
            visible_primitives: 3,
            total_primitives: 5,
            weight,
            first_state: 0,
            last_state: 0,
        };
        let object = SceneObject {
            id: ObjectId(0),
            name: String::new(),
            path: String::new(),
            node: 0,
            first_primitive: 0,
            end_primitive: 5,
            occluder: true,
            bounds: Bounds::EMPTY,
        };
        let mut report = CheckReport::default();
        let runs = std::slice::from_ref(&entry);
        let found = Found { rows: &[row], pairs: &[pair], entry: &entry, runs };
        found.check(&[object], 5, 1, true, &mut report);
        report.problems
    }

    #[test]
    fn corrupted_weights_are_named_with_file_cell_and_remedy() {
        assert_eq!(problems_with(&[0.1, 0.2, 0.3], 0.6), []);
        for (weights, weight, says) in [
            (&[0.1, 0.2, 0.9][..], 0.6, "object 0 in cell 7 add up to"),
            (&[0.1, 0.2, 0.0001], 0.6, "object 0 in cell 7 add up to"),
            (&[0.1, 0.2], 0.6, "cell 7 has 2 weights for 3 primitives"),
            (&[0.9, 0.9, 0.9], 2.7, "the weights of cell 7 add up to"),
        ] {
            let found = problems_with(weights, weight);
            let problem = found.first().unwrap_or_else(|| panic!("{weights:?} are accepted"));
            assert_eq!(problem.file, "data/cells-x.parquet");
            assert!(problem.problem.contains(says), "{}", problem.problem);
            assert!(problem.problem.contains("bake again"), "{}", problem.problem);
        }
    }
}
