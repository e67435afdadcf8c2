//! One attempt at a task: read what it depends on, solve, write parts, commit.
//!
//! The order of writes is that of `sightline_coordinator::journal`: parts under the attempt's own
//! name, then the commit, created only if absent. When another attempt's commit is there first,
//! nothing is changed or deleted: the task is done (JB-1).

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use prost::Message;
use sightline_geometry::{SegmentId, Timeline, Units, ViewSegment};
use sightline_jobs::{Plan, PlannedCell, TaskId, TaskKind};
use sightline_proto::v1;
use sightline_scene::Scene;
use sightline_store::{
    BakeStore, CellRow, Created, PartKind, SegmentRow, StoreError, decode_cell_part,
    decode_segment_part_where, encode_cell_part, encode_object_part, encode_segment_part, keys,
};
use tracing::Instrument;

use crate::cache::PartCache;
use crate::compute::{Compute, Computed, Output, Part};
use crate::error::AttemptError;
use crate::pool::Cancel;
use crate::reuse::{Earlier, Reuse};
use crate::solve::{self, CellOutput, SegmentOutput, Work};
use crate::trace::Traces;

/// What all attempts at the tasks of one bake share.
pub(crate) struct Bake {
    pub store: BakeStore,
    pub plan: Plan,
    timeline: Timeline,
    units: Units,
    pub scene: Arc<Scene>,
    /// What may be taken over from an earlier bake.
    reuse: Option<Reuse>,
    compute: Arc<dyn Compute>,
    cache: Mutex<PartCache>,
}

/// What a task reads of those that it depends on.
enum Inputs {
    /// A segments task reads nothing.
    Nothing,
    /// The rows of the cells' segments in the states of a cells task.
    Segments(BTreeMap<SegmentId, Vec<SegmentRow>>),
    /// Range by range of states, the rows of the cells of a join task.
    Ranges(Vec<Vec<CellRow>>),
}

impl Bake {
    /// Reads what it needs of an earlier bake.
    pub async fn open(
        store: BakeStore,
        plan: Plan,
        scene: Arc<Scene>,
        compute: Arc<dyn Compute>,
    ) -> Result<Self, StoreError> {
        let timeline = plan.timeline();
        let units = Units::new(&scene.geometry, plan.config.solver.granularity);
        let reuse = Reuse::open(&store, &plan.bake_id, &scene).await?;
        Ok(Self { store, plan, timeline, units, scene, reuse, compute, cache: Mutex::default() })
    }

    /// Attempts a task; on success its commit exists. Gives the time spent in computing.
    pub async fn attempt(
        self: &Arc<Self>,
        task: TaskId,
        attempt: &str,
        cancel: &Cancel,
    ) -> Result<Duration, AttemptError> {
        let read = async {
            Ok::<_, AttemptError>((self.read(task).await?, self.read_earlier(task).await?))
        };
        let (inputs, earlier) = read.instrument(tracing::info_span!("read")).await?;
        let (bake, cancelled) = (Arc::clone(self), cancel.clone());
        let span = tracing::info_span!("solve");
        let job = Box::new(move || {
            let _solving = span.enter();
            bake.compute(task, &inputs, &earlier, &cancelled)
        });
        let Computed { output, took } = self.compute.compute(task, job).await?;
        if cancel.is_cancelled() {
            return Err(AttemptError::GivenUp);
        }
        let write = tracing::info_span!("write");
        let parts = self.write_parts(task, attempt, output.parts).instrument(write).await?;
        let commit =
            v1::Commit { task: task.0, attempt: attempt.to_owned(), parts, reused: output.reused };
        self.commit(&commit).instrument(tracing::info_span!("commit")).await?;
        Ok(took)
    }

    async fn read(&self, task: TaskId) -> Result<Inputs, AttemptError> {
        Ok(match self.plan.task(task).kind {
            TaskKind::Segments { .. } => Inputs::Nothing,
            TaskKind::Cells { .. } => Inputs::Segments(self.read_segments(task).await?),
            TaskKind::Join { .. } => Inputs::Ranges(self.read_ranges(task).await?),
        })
    }

    /// What an earlier bake has for a task.
    async fn read_earlier(&self, task: TaskId) -> Result<Earlier, AttemptError> {
        let (Some(reuse), plan) = (&self.reuse, &self.plan) else { return Ok(Earlier::default()) };
        Ok(match plan.task(task).kind {
            TaskKind::Segments { .. } => {
                reuse.read(plan.segments_of(task), &[], &plan.segments).await?
            }
            TaskKind::Cells { .. } => reuse.read(&[], plan.cells_of(task), &plan.segments).await?,
            TaskKind::Join { .. } => Earlier::default(),
        })
    }

    /// Takes over or solves, and encodes. Runs on the solving threads.
    fn compute(
        &self,
        task: TaskId,
        inputs: &Inputs,
        earlier: &Earlier,
        cancel: &Cancel,
    ) -> Result<Output, AttemptError> {
        let Self { plan, scene, timeline, units, .. } = self;
        let states = plan.states_of(task);
        let work = Work { scene, timeline, config: &plan.config, units, states };
        let reused = AtomicU32::new(0);
        let count = || _ = reused.fetch_add(1, Ordering::Relaxed);
        let solved = match inputs {
            Inputs::Nothing => {
                let reuse = |segment: &ViewSegment| {
                    let reuse = self.reuse.as_ref()?;
                    reuse.segment(scene, earlier, segment).inspect(|_| count())
                };
                let segments = plan.segments_of(task);
                let solved = solve::solve_segments(&work, segments, reuse, cancel);
                let solved = solved.ok_or(AttemptError::GivenUp)?;
                return Ok(Output { parts: segment_parts(solved)?, reused: reused.into_inner() });
            }
            Inputs::Segments(rows) => {
                let reuse = |cell: &PlannedCell| {
                    let reuse = self.reuse.as_ref()?;
                    reuse.cell(scene, earlier, cell, rows).inspect(|_| count())
                };
                let cells = plan.cells_of(task);
                solve::solve_cells(&work, cells, &plan.segments, rows, reuse, cancel)
                    .ok_or(AttemptError::GivenUp)?
            }
            Inputs::Ranges(ranges) => solve::join_cells(scene, timeline, ranges),
        };
        let parts = cell_parts(solved, work.takes_all_states())?;
        Ok(Output { parts, reused: reused.into_inner() })
    }

    /// Step 1 of an attempt: the parts.
    async fn write_parts(
        &self,
        task: TaskId,
        attempt: &str,
        parts: Vec<Part>,
    ) -> Result<Vec<v1::CommittedPart>, AttemptError> {
        let bake_id = &self.plan.bake_id;
        let mut committed = Vec::with_capacity(parts.len());
        for (kind, part) in parts {
            let key = keys::part(bake_id, task.0, attempt, kind);
            let digest = blake3::hash(&part).to_hex().to_string();
            let bytes = part.len() as u64;
            if kind == PartKind::Segments {
                self.cache().put(&digest, part.clone());
            }
            if self.store.create(&key, part).await? == Created::AlreadyThere {
                return Err(AttemptError::Input {
                    key,
                    problem: format!("the attempt {attempt} was made before"),
                });
            }
            committed.push(v1::CommittedPart { key, bytes, digest });
        }
        Ok(committed)
    }

    /// Step 2: the commit.
    async fn commit(&self, commit: &v1::Commit) -> Result<(), AttemptError> {
        let key = keys::commit(&self.plan.bake_id, commit.task);
        if self.store.create(&key, commit.encode_to_vec()).await? == Created::AlreadyThere {
            let v1::Commit { task, attempt, .. } = commit;
            tracing::info!(task, attempt, "another attempt committed first");
        }
        Ok(())
    }

    /// The rows of all segments of a cells task's cells, in its states.
    async fn read_segments(
        &self,
        task: TaskId,
    ) -> Result<BTreeMap<SegmentId, Vec<SegmentRow>>, AttemptError> {
        let wanted: BTreeSet<SegmentId> =
            self.plan.cells_of(task).iter().flat_map(|cell| cell.segments.clone()).collect();
        let mut rows: BTreeMap<SegmentId, Vec<SegmentRow>> = BTreeMap::new();
        for dependency in &self.plan.task(task).depends_on {
            let (key, part) = self.committed_part(*dependency, PartKind::Segments).await?;
            for row in decode_segment_part_where(&key, part, |id| wanted.contains(&id))? {
                rows.entry(row.segment).or_default().push(row);
            }
        }
        let states = self.plan.states_of(task);
        let whole = |id: &SegmentId| {
            rows.get(id).is_some_and(|own| follow(own.iter().map(SegmentRow::states), &states))
        };
        match wanted.iter().find(|id| !whole(id)) {
            None => Ok(rows),
            Some(id) => {
                let holder = self.plan.task_of_segment(*id, states.start);
                Err(AttemptError::Input {
                    key: keys::commit(&self.plan.bake_id, holder.0),
                    problem: format!(
                        "its part does not hold segment {id} in its states, once each"
                    ),
                })
            }
        }
    }

    /// The rows of a join task's cells, range by range of states.
    async fn read_ranges(&self, task: TaskId) -> Result<Vec<Vec<CellRow>>, AttemptError> {
        let planned = self.plan.cells_of(task);
        let mut ranges = Vec::new();
        for dependency in &self.plan.task(task).depends_on {
            let (key, part) = self.committed_part(*dependency, PartKind::Cells).await?;
            let mut rows = decode_cell_part(&key, part)?;
            rows.sort_by_key(|row| (row.cell.id, row.first_state));
            let states = self.plan.states_of(*dependency);
            let by_cell: Vec<&[CellRow]> = rows.chunk_by(|a, b| a.cell.id == b.cell.id).collect();
            let is_whole = by_cell.len() == planned.len()
                && by_cell.iter().zip(planned).all(|(own, planned)| {
                    own.iter().all(|row| row.cell == planned.cell)
                        && follow(own.iter().map(CellRow::states), &states)
                });
            if !is_whole {
                let problem = "it does not hold the cells of its task in its states, once each";
                return Err(AttemptError::Input { key, problem: problem.into() });
            }
            ranges.push(rows);
        }
        Ok(ranges)
    }

    /// A committed part of a task, checked against its commit.
    async fn committed_part(
        &self,
        task: TaskId,
        kind: PartKind,
    ) -> Result<(String, Bytes), AttemptError> {
        let bake_id = &self.plan.bake_id;
        let commit_key = keys::commit(bake_id, task.0);
        let damaged = |problem: String| AttemptError::Input { key: commit_key.clone(), problem };
        let commit = v1::Commit::decode(self.store.get(&commit_key).await?)
            .map_err(|error| damaged(error.to_string()))?;
        let wanted = keys::part(bake_id, task.0, &commit.attempt, kind);
        let Some(part) = commit.parts.iter().find(|part| part.key == wanted) else {
            return Err(damaged(format!("it does not name `{wanted}`")));
        };
        if let Some(bytes) = self.cache().get(&part.digest) {
            return Ok((part.key.clone(), bytes));
        }
        let bytes = self.store.get(&part.key).await?;
        if blake3::hash(&bytes).to_hex().as_str() != part.digest {
            let problem = "it does not hold the bytes that were committed".into();
            return Err(AttemptError::Input { key: part.key.clone(), problem });
        }
        // Neighbouring cells tasks read the same segments; what a join reads is read once.
        if kind == PartKind::Segments {
            self.cache().put(&part.digest, bytes.clone());
        }
        Ok((part.key.clone(), bytes))
    }

    fn cache(&self) -> std::sync::MutexGuard<'_, PartCache> {
        // A panic while the cache is held leaves at worst a part too few in it.
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The parts of a segments task.
fn segment_parts(solved: Vec<SegmentOutput>) -> Result<Vec<Part>, AttemptError> {
    let mut traces = Traces::default();
    let mut rows = Vec::with_capacity(solved.len());
    for found in solved {
        if let (Some(trace), Some(row)) = (found.trace, found.rows.first()) {
            traces.segments.insert(row.segment, trace);
        }
        rows.extend(found.rows);
    }
    let mut parts = vec![(PartKind::Segments, encode_segment_part(&rows)?)];
    add_traces(&mut parts, &traces);
    Ok(parts)
}

/// The parts of a cells or a join task.
fn cell_parts(solved: Vec<CellOutput>, has_all_states: bool) -> Result<Vec<Part>, AttemptError> {
    let mut traces = Traces::default();
    let (mut rows, mut objects) = (Vec::new(), Vec::new());
    for found in solved {
        if let (Some(trace), Some(row)) = (found.trace, found.rows.first()) {
            traces.cells.insert(row.cell.id, trace);
        }
        rows.extend(found.rows);
        objects.extend(found.objects);
    }
    let mut parts = vec![(PartKind::Cells, encode_cell_part(&rows)?)];
    if has_all_states {
        parts.push((PartKind::Objects, encode_object_part(&objects)?));
    }
    add_traces(&mut parts, &traces);
    Ok(parts)
}

fn add_traces(parts: &mut Vec<Part>, traces: &Traces) {
    if !traces.segments.is_empty() || !traces.cells.is_empty() {
        parts.push((PartKind::Traces, traces.encode()));
    }
}

/// True when ranges follow each other and take each of `states` once.
fn follow(ranges: impl Iterator<Item = Range<u32>>, states: &Range<u32>) -> bool {
    let mut next = Some(states.start);
    for range in ranges {
        next = next.filter(|next| *next == range.start).map(|_| range.end);
    }
    next == Some(states.end)
}
