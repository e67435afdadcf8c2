//! One attempt at a task: read what it depends on, solve, write parts, commit.
//!
//! The order of writes is that of `sightline_coordinator::journal`: parts under the attempt's own
//! name, then the commit, created only if absent. When another attempt's commit is there first,
//! nothing is changed or deleted: the task is done (JB-1).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use prost::Message;
use sightline_geometry::SegmentId;
use sightline_jobs::{Plan, TaskId, TaskKind};
use sightline_proto::v1;
use sightline_scene::Scene;
use sightline_store::{
    BakeStore, Created, PartKind, SegmentRow, decode_segment_part_where, encode_cell_part,
    encode_object_part, encode_segment_part, keys,
};

use crate::cache::PartCache;
use crate::error::AttemptError;
use crate::pool::{Cancel, SolvePool};
use crate::solve::{self, CellOutput};

/// What all attempts at the tasks of one bake share.
pub(crate) struct Bake {
    pub store: BakeStore,
    pub plan: Plan,
    pub scene: Arc<Scene>,
    pub pool: SolvePool,
    cache: Mutex<PartCache>,
}

/// A part that is ready to be written.
type Part = (PartKind, Bytes);

impl Bake {
    pub fn new(store: BakeStore, plan: Plan, scene: Arc<Scene>, pool: SolvePool) -> Self {
        Self { store, plan, scene, pool, cache: Mutex::default() }
    }

    /// Attempts a task; on success its commit exists. Gives the time spent in computing.
    pub async fn attempt(
        self: &Arc<Self>,
        task: TaskId,
        attempt: &str,
        cancel: &Cancel,
    ) -> Result<Duration, AttemptError> {
        let rows = match self.plan.task(task).kind {
            TaskKind::Segments { .. } => BTreeMap::new(),
            TaskKind::Cells { .. } => self.read_dependencies(task).await?,
        };
        let (bake, cancelled) = (Arc::clone(self), cancel.clone());
        let compute = move || {
            let start = Instant::now();
            let parts = bake.compute(task, &rows, &cancelled)?;
            Ok::<_, AttemptError>((parts, start.elapsed()))
        };
        let (parts, solve_time) = self.pool.run(compute).await??;
        if cancel.is_cancelled() {
            return Err(AttemptError::GivenUp);
        }
        self.write(task, attempt, parts).await?;
        Ok(solve_time)
    }

    /// Solves and encodes. Runs on the solving threads.
    fn compute(
        &self,
        task: TaskId,
        rows: &BTreeMap<SegmentId, SegmentRow>,
        cancel: &Cancel,
    ) -> Result<Vec<Part>, AttemptError> {
        let Self { plan, scene, .. } = self;
        match plan.task(task).kind {
            TaskKind::Segments { .. } => {
                let segments = plan.segments_of(task);
                let solved = solve::solve_segments(scene, segments, &plan.config, cancel)
                    .ok_or(AttemptError::GivenUp)?;
                Ok(vec![(PartKind::Segments, encode_segment_part(&solved)?)])
            }
            TaskKind::Cells { .. } => {
                let cells = plan.cells_of(task);
                let solved =
                    solve::solve_cells(scene, cells, &plan.segments, rows, &plan.config, cancel)
                        .ok_or(AttemptError::GivenUp)?;
                let (cells, objects): (Vec<_>, Vec<_>) =
                    solved.into_iter().map(|CellOutput { cell, objects }| (cell, objects)).unzip();
                Ok(vec![
                    (PartKind::Cells, encode_cell_part(&cells)?),
                    (PartKind::Objects, encode_object_part(&objects.concat())?),
                ])
            }
        }
    }

    /// Steps 1 and 2 of an attempt: the parts, then the commit.
    async fn write(
        &self,
        task: TaskId,
        attempt: &str,
        parts: Vec<Part>,
    ) -> Result<(), AttemptError> {
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
        let commit = v1::Commit { task: task.0, attempt: attempt.to_owned(), parts: committed };
        let key = keys::commit(bake_id, task.0);
        if self.store.create(&key, commit.encode_to_vec()).await? == Created::AlreadyThere {
            tracing::info!(task = task.0, attempt, "another attempt committed first");
        }
        Ok(())
    }

    /// The rows of all segments of a cells task's cells.
    async fn read_dependencies(
        &self,
        task: TaskId,
    ) -> Result<BTreeMap<SegmentId, SegmentRow>, AttemptError> {
        let wanted: BTreeSet<SegmentId> =
            self.plan.cells_of(task).iter().flat_map(|cell| cell.segments.clone()).collect();
        let mut rows = BTreeMap::new();
        for dependency in &self.plan.task(task).depends_on {
            let (key, part) = self.segment_part(*dependency).await?;
            let decoded = decode_segment_part_where(&key, part, |id| wanted.contains(&id))?;
            rows.extend(decoded.into_iter().map(|row| (row.segment, row)));
        }
        match wanted.iter().find(|id| !rows.contains_key(id)) {
            None => Ok(rows),
            Some(id) => Err(AttemptError::Input {
                key: keys::commit(&self.plan.bake_id, self.plan.task_of_segment(*id).0),
                problem: format!("its part does not hold segment {id}"),
            }),
        }
    }

    /// The committed part of a segments task, checked against its commit.
    async fn segment_part(&self, task: TaskId) -> Result<(String, Bytes), AttemptError> {
        let commit_key = keys::commit(&self.plan.bake_id, task.0);
        let damaged = |problem: String| AttemptError::Input { key: commit_key.clone(), problem };
        let commit = v1::Commit::decode(self.store.get(&commit_key).await?)
            .map_err(|error| damaged(error.to_string()))?;
        let [part] = &commit.parts[..] else {
            return Err(damaged(format!("it names {} parts instead of 1", commit.parts.len())));
        };
        if let Some(bytes) = self.cache().get(&part.digest) {
            return Ok((part.key.clone(), bytes));
        }
        let bytes = self.store.get(&part.key).await?;
        if blake3::hash(&bytes).to_hex().as_str() != part.digest {
            let problem = "it does not hold the bytes that were committed".into();
            return Err(AttemptError::Input { key: part.key.clone(), problem });
        }
        self.cache().put(&part.digest, bytes.clone());
        Ok((part.key.clone(), bytes))
    }

    fn cache(&self) -> std::sync::MutexGuard<'_, PartCache> {
        // A panic while the cache is held leaves at worst a part too few in it.
        self.cache.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
