//! What an earlier bake found and an edit of the scene left as it is: it is taken over, not solved again.
//!
//! The coordinator compares the scene with that of an earlier bake and writes down what is the same
//! (`sightline_coordinator::edit`). A worker that is given a task reads what the earlier bake has for its
//! segments and cells, and takes over each that
//!
//! - was planned alike: the same number, in the same place;
//! - depends on nothing that was taken away: it is neither in the visible set nor among what the trace
//!   names beside it; and
//! - depends on nothing that was added: the questions of its trace are asked again, of what was added
//!   ([`sightline_solver::is_affected`], [`sightline_quality::Newcomers`]);
//! - for a cell: whose planned segments see what they saw.
//!
//! Everything else is solved. So the rows are those of a bake from scratch, bit by bit, in the numbers of
//! the new scene. What cannot be read of the earlier bake, because somebody removed it or it is damaged, is
//! solved as well: it is never needed.
//!
//! An edit costs what depends on it, and for the rest the questions: a thousandth to a tenth of solving,
//! by how much was added and how widely it would be seen if nothing stood before it.

use std::collections::BTreeMap;

use prost::Message;
use rayon::prelude::*;
use sightline_geometry::{
    CellId, InstanceId, InstancedGeometry, Moment, PrimitiveSet, SegmentId, ViewSegment,
    overlap::primitives_in_cell_over,
};
use sightline_jobs::{Plan, PlannedCell, TaskId, TaskKind};
use sightline_proto::{decode_plan, v1};
use sightline_quality::{Newcomers, Suspect};
use sightline_scene::{Edit, Same, Scene};
use sightline_solver::{Added, SegmentTrace, is_affected};
use sightline_store::{
    BakeStore, CellRow, ErrorClass, ObjectRow, PartKind, SegmentRow, StoreError, decode_cell_part,
    decode_object_part, decode_segment_part_where, keys,
};

use crate::solve::{CellOutput, SegmentOutput, planned_rows, rays_of};
use crate::trace::{CellTrace, Traces};

/// An earlier bake, and what its scene has in common with that of this one.
pub(crate) struct Reuse {
    store: BakeStore,
    earlier: Plan,
    /// Its cells tasks: the first cell behind each, and the task.
    cells_tasks: Vec<(CellId, TaskId)>,
    edit: Edit,
    /// What was added: its numbers, and it alone.
    added: PrimitiveSet,
    alone: InstancedGeometry,
}

/// What an earlier bake has for the segments and cells of a task, in the numbers of its scene.
#[derive(Debug, Default)]
pub(crate) struct Earlier {
    segments: BTreeMap<SegmentId, (Vec<SegmentRow>, Option<SegmentTrace>)>,
    cells: BTreeMap<CellId, (CellRow, Vec<ObjectRow>, CellTrace)>,
}

impl Reuse {
    /// The earlier bake that the coordinator chose for `bake`; `None` where there is none, or it cannot be
    /// read.
    pub async fn open(
        store: &BakeStore,
        bake: &str,
        scene: &Scene,
    ) -> Result<Option<Self>, StoreError> {
        let Some(bytes) = store.get_if_exists(&keys::edit(bake)).await? else { return Ok(None) };
        let unusable = |problem: &str| {
            tracing::warn!(bake, problem, "nothing is taken over of the earlier bake");
            Ok(None)
        };
        let read = match v1::Edit::decode(bytes) {
            Ok(read) if read.bake.is_empty() => return Ok(None),
            Ok(read) => read,
            Err(error) => return unusable(&error.to_string()),
        };
        let Some(bytes) = store.get_if_exists(&keys::plan(&read.bake)).await? else {
            return unusable("its plan is gone");
        };
        let earlier = match decode_plan(&bytes) {
            Ok(plan) => plan,
            Err(error) => return unusable(&error.to_string()),
        };
        let edit = edit_of(&read);
        let geometry = &scene.geometry;
        if let Some(problem) = edit.problem(geometry.primitive_count()) {
            return unusable(problem);
        }
        let added = edit.added(geometry.primitive_count());
        let ids = (0..geometry.instances.len() as u32).map(InstanceId);
        let is_added = |id: &InstanceId| {
            let range = geometry.primitives_of(*id);
            !range.is_empty() && added.count_in(range) > 0
        };
        let alone = geometry.of_instances(ids.filter(is_added));
        let cells_tasks = earlier.tasks.iter().filter_map(|task| match task.kind {
            TaskKind::Cells { end, .. } => Some((end, task.id)),
            _ => None,
        });
        let mut cells_tasks: Vec<(CellId, TaskId)> = cells_tasks.collect();
        cells_tasks.sort_unstable();
        Ok(Some(Self { store: store.clone(), earlier, cells_tasks, edit, added, alone }))
    }

    /// What the earlier bake has for segments, and for cells with their segments.
    pub async fn read(
        &self,
        segments: &[ViewSegment],
        cells: &[PlannedCell],
        all: &[ViewSegment],
    ) -> Result<Earlier, StoreError> {
        let mut found = Earlier::default();
        let mut wanted: BTreeMap<TaskId, Vec<SegmentId>> = BTreeMap::new();
        let is_same =
            |segment: &ViewSegment| self.earlier.segments.get(segment.id.index()) == Some(segment);
        let is_planned_alike = |cell: &&PlannedCell| {
            self.earlier.cells.get(cell.cell.id.index()) == Some(*cell)
                && cell.segments.iter().all(|id| is_same(&all[id.index()]))
        };
        let cells: Vec<&PlannedCell> = cells.iter().filter(is_planned_alike).collect();
        let of_cells = cells.iter().flat_map(|cell| &cell.segments).map(|id| &all[id.index()]);
        for segment in segments.iter().filter(|s| is_same(s)).chain(of_cells) {
            let task = self.earlier.task_of_segment(segment.id, 0);
            wanted.entry(task).or_default().push(segment.id);
        }
        for (task, ids) in wanted {
            let Some(commit) = self.commit(task).await? else { continue };
            let Some((key, part)) = self.part(&commit, PartKind::Segments).await? else { continue };
            let Some(rows) = usable(decode_segment_part_where(&key, part, |id| ids.contains(&id)))
            else {
                continue;
            };
            // Cells ask for no traces of their segments: they compare what is seen.
            let traces = if segments.is_empty() { None } else { self.traces(&commit).await? };
            let mut traces = traces.unwrap_or_default();
            for row in rows {
                let trace = traces.segments.remove(&row.segment);
                let (rows, kept) = found.segments.entry(row.segment).or_default();
                *kept = trace.or(kept.take());
                rows.push(row);
            }
        }
        let mut tasks: BTreeMap<TaskId, Vec<CellId>> = BTreeMap::new();
        for cell in cells {
            let id = cell.cell.id;
            let at = self.cells_tasks.partition_point(|(end, _)| *end <= id);
            if let Some((_, task)) = self.cells_tasks.get(at) {
                tasks.entry(*task).or_default().push(id);
            }
        }
        for (task, ids) in tasks {
            self.read_cells(task, &ids, &mut found).await?;
        }
        Ok(found)
    }

    async fn read_cells(
        &self,
        task: TaskId,
        wanted: &[CellId],
        found: &mut Earlier,
    ) -> Result<(), StoreError> {
        let Some(commit) = self.commit(task).await? else { return Ok(()) };
        let Some((key, part)) = self.part(&commit, PartKind::Cells).await? else { return Ok(()) };
        let Some(rows) = usable(decode_cell_part(&key, part)) else { return Ok(()) };
        let Some((key, part)) = self.part(&commit, PartKind::Objects).await? else { return Ok(()) };
        let Some(objects) = usable(decode_object_part(&key, part)) else { return Ok(()) };
        let Some(mut traces) = self.traces(&commit).await? else { return Ok(()) };
        for row in rows {
            let id = row.cell.id;
            let Some(trace) = traces.cells.remove(&id).filter(|_| wanted.contains(&id)) else {
                continue;
            };
            let own = objects.iter().filter(|object| object.cell == id).copied().collect();
            found.cells.insert(id, (row, own, trace));
        }
        Ok(())
    }

    async fn commit(&self, task: TaskId) -> Result<Option<v1::Commit>, StoreError> {
        let key = keys::commit(&self.earlier.bake_id, task.0);
        let Some(bytes) = self.store.get_if_exists(&key).await? else { return Ok(None) };
        Ok(v1::Commit::decode(bytes).ok())
    }

    /// A part of an earlier task, when it is what was committed.
    async fn part(
        &self,
        commit: &v1::Commit,
        kind: PartKind,
    ) -> Result<Option<(String, bytes::Bytes)>, StoreError> {
        let wanted = keys::part(&self.earlier.bake_id, commit.task, &commit.attempt, kind);
        let Some(part) = commit.parts.iter().find(|part| part.key == wanted) else {
            return Ok(None);
        };
        let bytes = match self.store.get_if_exists(&part.key).await {
            Err(error) if error.class() == ErrorClass::RetryLater => return Err(error),
            read => read.ok().flatten(),
        };
        let is_whole = |bytes: &bytes::Bytes| blake3::hash(bytes).to_hex().as_str() == part.digest;
        Ok(bytes.filter(is_whole).map(|bytes| (part.key.clone(), bytes)))
    }

    async fn traces(&self, commit: &v1::Commit) -> Result<Option<Traces>, StoreError> {
        let part = self.part(commit, PartKind::Traces).await?;
        Ok(part.and_then(|(_, bytes)| Traces::decode(bytes).ok()))
    }

    /// What an earlier bake found from a segment, where the edit has no part in it.
    pub fn segment(
        &self,
        scene: &Scene,
        earlier: &Earlier,
        segment: &ViewSegment,
    ) -> Option<SegmentOutput> {
        let (rows, trace) = earlier.segments.get(&segment.id)?;
        let trace = trace.as_ref()?;
        let rows = self.segment_rows(rows)?;
        let trace = self.segment_trace(trace)?;
        let sampling = rays_of(segment, planned_rows(&self.earlier.config));
        let added = self.added_to(scene);
        (!is_affected(&added, segment, sampling, &trace))
            .then_some(SegmentOutput { rows, trace: Some(trace) })
    }

    /// What an earlier bake found for a cell, where the edit has no part in it. `seen` are the rows of its
    /// planned segments now.
    pub fn cell(
        &self,
        scene: &Scene,
        earlier: &Earlier,
        planned: &PlannedCell,
        seen: &BTreeMap<SegmentId, Vec<SegmentRow>>,
    ) -> Option<CellOutput> {
        let cell = &planned.cell;
        let (row, objects, trace) = earlier.cells.get(&cell.id)?;
        let sees_the_same = |id: &SegmentId| {
            let before = earlier.segments.get(id).and_then(|(rows, _)| self.segment_rows(rows));
            before.is_some_and(|before| before == seen[id])
        };
        if row.cell != *cell || !planned.segments.iter().all(sees_the_same) {
            return None;
        }
        let set = self.edit.renumbered(&row.set)?;
        let missing = self.edit.renumbered(&trace.missing)?;
        let renumbered = |object: &ObjectRow| {
            Some(ObjectRow { object: self.edit.object(object.object)?, ..*object })
        };
        let mut objects: Vec<ObjectRow> = objects.iter().map(renumbered).collect::<Option<_>>()?;
        objects.sort_by_key(|object| object.object);
        let extra = trace.extra.iter().map(|extra| {
            let trace = self.segment_trace(&extra.trace)?;
            Some(crate::trace::ExtraTrace { trace, ..extra.clone() })
        });
        let trace = CellTrace { extra: extra.collect::<Option<_>>()?, missing, ..trace.clone() };
        if self.is_asked_by(scene, planned, &trace) {
            return None;
        }
        let row = CellRow { set, tile: planned.tile, ..row.clone() };
        Some(CellOutput { rows: vec![row], objects, trace: Some(trace) })
    }

    /// True when something that was added answers a question of a cell.
    fn is_asked_by(&self, scene: &Scene, planned: &PlannedCell, trace: &CellTrace) -> bool {
        if self.added.is_empty() {
            return false;
        }
        let cell = &planned.cell;
        let inside = primitives_in_cell_over(&self.alone, cell, 0..1);
        if inside.runs().iter().any(|(_, set)| !set.is_empty()) {
            return true;
        }
        let newcomers = Newcomers { scene: &scene.geometry, alone: &self.alone };
        let by_batch = |&(seed, batches): &(u64, u32)| {
            (0..batches).any(|batch| newcomers.are_met_by_batch(cell, batch, seed))
        };
        let from_viewpoint = |&(viewpoint, seed, rays): &(glam::DVec3, u64, u32)| {
            let at = Suspect { viewpoint, moment: Moment::START };
            newcomers.are_met_from(at, rays, seed)
        };
        let added = self.added_to(scene);
        trace.batches.iter().any(by_batch)
            || trace.viewpoints.par_iter().any(from_viewpoint)
            || trace.extra.iter().any(|extra| {
                let sampling = rays_of(&extra.segment, extra.rows);
                is_affected(&added, &extra.segment, sampling, &extra.trace)
            })
    }

    fn added_to<'a>(&'a self, scene: &'a Scene) -> Added<'a> {
        Added { scene: &scene.geometry, alone: &self.alone, primitives: &self.added }
    }

    fn segment_rows(&self, rows: &[SegmentRow]) -> Option<Vec<SegmentRow>> {
        let renumbered = |row: &SegmentRow| {
            Some(SegmentRow { set: self.edit.renumbered(&row.set)?, ..row.clone() })
        };
        rows.iter().map(renumbered).collect()
    }

    fn segment_trace(&self, trace: &SegmentTrace) -> Option<SegmentTrace> {
        Some(SegmentTrace {
            grazed: self.edit.renumbered(&trace.grazed)?,
            tiles: trace.tiles.clone(),
        })
    }
}

/// The message, as what it says.
fn edit_of(read: &v1::Edit) -> Edit {
    let same = |same: &v1::SameObjects| Same {
        object: [same.old_object, same.new_object],
        primitive: [same.old_primitive, same.new_primitive],
        objects: same.objects,
        primitives: same.primitives,
    };
    Edit { same: read.same.iter().map(same).collect() }
}

/// What was read; what cannot be read is not needed.
fn usable<T>(read: Result<T, StoreError>) -> Option<T> {
    read.inspect_err(|error| tracing::warn!(%error, "it is solved again")).ok()
}
