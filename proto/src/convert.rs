//! Conversions between messages and the types of [`sightline_jobs`].

use glam::DVec3;
use prost::Message;
use sightline_geometry::{CellId, SegmentId, ViewCell, ViewSegment};
use sightline_jobs::{
    BakeConfig, BakeStatus, ConfigError, Done, FORMAT_VERSION, FailureClass, LeaseStatus, Phase,
    Plan, PlannedCell, Progress, QuarantinedTask, SceneFile, SceneRef, SkippedCells, StateRange,
    Task, TaskAttempts, TaskId, TaskKind, WorkerStatus,
};

use crate::v1;

/// Why a message is refused.
#[derive(Debug, thiserror::Error)]
pub enum ConvertError {
    /// The bytes are not the message they should be.
    #[error("these bytes are not a {message}: {source}")]
    Malformed {
        /// Name of the message.
        message: &'static str,
        /// What the decoder says.
        source: prost::DecodeError,
    },
    /// A field is not there.
    #[error("a {message} has no `{field}`")]
    Missing {
        /// Name of the message.
        message: &'static str,
        /// Name of the field.
        field: &'static str,
    },
    /// A field has a value that makes no sense.
    #[error("`{field}` of a {message} makes no sense: {problem}")]
    Invalid {
        /// Name of the message.
        message: &'static str,
        /// Name of the field.
        field: &'static str,
        /// What is wrong.
        problem: String,
    },
    /// Written by another version of the program.
    #[error("the plan has format version {found}, this program reads {FORMAT_VERSION}")]
    Version {
        /// The version of the plan.
        found: u32,
    },
    /// The configuration in a plan is refused.
    #[error("the configuration of the plan is refused: {0}")]
    Config(#[from] ConfigError),
}

const fn missing(message: &'static str, field: &'static str) -> ConvertError {
    ConvertError::Missing { message, field }
}

fn invalid(
    message: &'static str,
    field: &'static str,
    problem: impl std::fmt::Display,
) -> ConvertError {
    ConvertError::Invalid { message, field, problem: problem.to_string() }
}

/// The stored form of a plan. Equal plans have equal bytes.
#[must_use]
pub fn encode_plan(plan: &Plan) -> Vec<u8> {
    v1::Plan::from(plan).encode_to_vec()
}

/// Reads the stored form of a plan.
///
/// # Errors
/// When the bytes are not a plan of this version, or the plan contradicts itself.
pub fn decode_plan(bytes: &[u8]) -> Result<Plan, ConvertError> {
    let message = v1::Plan::decode(bytes)
        .map_err(|source| ConvertError::Malformed { message: "Plan", source })?;
    Plan::try_from(message)
}

fn index(len: usize) -> u32 {
    u32::try_from(len).expect("numbers of a plan have 32 bits")
}

impl From<DVec3> for v1::Point {
    fn from(p: DVec3) -> Self {
        Self { x: p.x, y: p.y, z: p.z }
    }
}

impl From<v1::Point> for DVec3 {
    fn from(p: v1::Point) -> Self {
        Self::new(p.x, p.y, p.z)
    }
}

impl From<&SceneRef> for v1::Scene {
    fn from(scene: &SceneRef) -> Self {
        let file = |f: &SceneFile| v1::SceneFile {
            path: f.path.clone(),
            bytes: f.bytes,
            digest: f.digest.clone(),
        };
        Self {
            uri: scene.uri.clone(),
            name: scene.name.clone(),
            digest: scene.digest.clone(),
            files: scene.files.iter().map(file).collect(),
        }
    }
}

impl From<v1::Scene> for SceneRef {
    fn from(scene: v1::Scene) -> Self {
        let file = |f: v1::SceneFile| SceneFile { path: f.path, bytes: f.bytes, digest: f.digest };
        Self {
            uri: scene.uri,
            name: scene.name,
            digest: scene.digest,
            files: scene.files.into_iter().map(file).collect(),
        }
    }
}

impl From<&PlannedCell> for v1::Cell {
    fn from(planned: &PlannedCell) -> Self {
        let [tile_x, tile_z] = planned.tile;
        Self {
            corners: planned.cell.corners.map(Into::into).into(),
            height: planned.cell.height,
            tile_x,
            tile_z,
            segments: planned.segments.iter().map(|s| s.0).collect(),
        }
    }
}

fn cell(id: u32, message: v1::Cell) -> Result<PlannedCell, ConvertError> {
    let corners: Vec<DVec3> = message.corners.into_iter().map(Into::into).collect();
    let corners = <[DVec3; 4]>::try_from(corners)
        .map_err(|found| invalid("Cell", "corners", format!("{} instead of 4", found.len())))?;
    Ok(PlannedCell {
        cell: ViewCell { id: CellId(id), corners, height: message.height },
        tile: [message.tile_x, message.tile_z],
        segments: message.segments.into_iter().map(SegmentId).collect(),
    })
}

fn segment(id: u32, message: v1::Segment) -> Result<ViewSegment, ConvertError> {
    Ok(ViewSegment {
        id: SegmentId(id),
        v0: message.v0.ok_or(missing("Segment", "v0"))?.into(),
        v1: message.v1.ok_or(missing("Segment", "v1"))?.into(),
    })
}

impl From<&Task> for v1::Task {
    fn from(task: &Task) -> Self {
        use v1::task::Kind;
        let range = |first: u32, end: u32| v1::Range { first, end };
        let in_states = |states: StateRange| Some(range(states.first, states.end));
        let (kind, states) = match task.kind {
            TaskKind::Segments { first, end, states } => {
                (Kind::Segments(range(first.0, end.0)), in_states(states))
            }
            TaskKind::Cells { first, end, states } => {
                (Kind::Cells(range(first.0, end.0)), in_states(states))
            }
            TaskKind::Join { first, end } => (Kind::Join(range(first.0, end.0)), None),
        };
        Self { kind: Some(kind), depends_on: task.depends_on.iter().map(|d| d.0).collect(), states }
    }
}

fn task(id: u32, message: v1::Task) -> Result<Task, ConvertError> {
    use v1::task::Kind;
    let states = || {
        let states = message.states.ok_or(missing("Task", "states"))?;
        Ok::<_, ConvertError>(StateRange { first: states.first, end: states.end })
    };
    let kind = match message.kind.ok_or(missing("Task", "kind"))? {
        Kind::Segments(r) => TaskKind::Segments {
            first: SegmentId(r.first),
            end: SegmentId(r.end),
            states: states()?,
        },
        Kind::Cells(r) => {
            TaskKind::Cells { first: CellId(r.first), end: CellId(r.end), states: states()? }
        }
        Kind::Join(r) => TaskKind::Join { first: CellId(r.first), end: CellId(r.end) },
    };
    let depends_on = message.depends_on.into_iter().map(TaskId).collect();
    Ok(Task { id: TaskId(id), kind, depends_on })
}

impl From<&Plan> for v1::Plan {
    fn from(plan: &Plan) -> Self {
        let segment =
            |s: &ViewSegment| v1::Segment { v0: Some(s.v0.into()), v1: Some(s.v1.into()) };
        Self {
            format_version: FORMAT_VERSION,
            bake_id: plan.bake_id.clone(),
            scene: Some((&plan.scene).into()),
            config_toml: plan.config.to_toml(),
            cells: plan.cells.iter().map(Into::into).collect(),
            segments: plan.segments.iter().map(segment).collect(),
            tasks: plan.tasks.iter().map(Into::into).collect(),
            skipped: plan.skipped.0.clone(),
            key_times: plan.key_times.clone(),
        }
    }
}

impl TryFrom<v1::Plan> for Plan {
    type Error = ConvertError;

    fn try_from(message: v1::Plan) -> Result<Self, ConvertError> {
        if message.format_version != FORMAT_VERSION {
            return Err(ConvertError::Version { found: message.format_version });
        }
        let numbered = |len: usize| 0..index(len);
        let plan = Self {
            bake_id: message.bake_id,
            scene: message.scene.ok_or(missing("Plan", "scene"))?.into(),
            config: BakeConfig::from_toml(&message.config_toml)?,
            cells: numbered(message.cells.len())
                .zip(message.cells)
                .map(|(id, m)| cell(id, m))
                .collect::<Result<_, _>>()?,
            segments: numbered(message.segments.len())
                .zip(message.segments)
                .map(|(id, m)| segment(id, m))
                .collect::<Result<_, _>>()?,
            tasks: numbered(message.tasks.len())
                .zip(message.tasks)
                .map(|(id, m)| task(id, m))
                .collect::<Result<_, _>>()?,
            key_times: message.key_times,
            skipped: SkippedCells(message.skipped),
        };
        plan.check().map_err(|problem| invalid("Plan", "tasks", problem))?;
        Ok(plan)
    }
}

impl From<FailureClass> for v1::FailureClass {
    fn from(class: FailureClass) -> Self {
        match class {
            FailureClass::RetryElsewhere => Self::RetryElsewhere,
            FailureClass::RetryLater => Self::RetryLater,
            FailureClass::Never => Self::Never,
        }
    }
}

impl TryFrom<v1::FailureClass> for FailureClass {
    type Error = ConvertError;

    fn try_from(class: v1::FailureClass) -> Result<Self, ConvertError> {
        match class {
            v1::FailureClass::Unspecified => Err(missing("Failed", "class")),
            v1::FailureClass::RetryElsewhere => Ok(Self::RetryElsewhere),
            v1::FailureClass::RetryLater => Ok(Self::RetryLater),
            v1::FailureClass::Never => Ok(Self::Never),
        }
    }
}

impl From<Phase> for v1::Phase {
    fn from(phase: Phase) -> Self {
        match phase {
            Phase::Planning => Self::Planning,
            Phase::Solving => Self::Solving,
            Phase::Merging => Self::Merging,
            Phase::Published => Self::Published,
            Phase::Failed => Self::Failed,
        }
    }
}

impl TryFrom<v1::Phase> for Phase {
    type Error = ConvertError;

    fn try_from(phase: v1::Phase) -> Result<Self, ConvertError> {
        match phase {
            v1::Phase::Unspecified => Err(missing("Status", "phase")),
            v1::Phase::Planning => Ok(Self::Planning),
            v1::Phase::Solving => Ok(Self::Solving),
            v1::Phase::Merging => Ok(Self::Merging),
            v1::Phase::Published => Ok(Self::Published),
            v1::Phase::Failed => Ok(Self::Failed),
        }
    }
}

impl From<Done> for v1::Done {
    fn from(Done { done, total }: Done) -> Self {
        Self { done, total }
    }
}

impl From<v1::Done> for Done {
    fn from(v1::Done { done, total }: v1::Done) -> Self {
        Self { done, total }
    }
}

impl From<Progress> for v1::TaskCounts {
    fn from(p: Progress) -> Self {
        Self {
            tasks: p.tasks,
            committed: p.committed,
            leased: p.leased,
            ready: p.ready,
            waiting: p.waiting,
            quarantined: p.quarantined,
        }
    }
}

impl From<v1::TaskCounts> for Progress {
    fn from(c: v1::TaskCounts) -> Self {
        Self {
            tasks: c.tasks,
            committed: c.committed,
            leased: c.leased,
            ready: c.ready,
            waiting: c.waiting,
            quarantined: c.quarantined,
        }
    }
}

impl From<&BakeStatus> for v1::Status {
    fn from(s: &BakeStatus) -> Self {
        let worker = |w: &WorkerStatus| v1::WorkerStatus {
            id: w.id,
            name: w.name.clone(),
            threads: w.threads,
            leases: w.leases,
            tasks_committed: w.tasks_committed,
        };
        let quarantined =
            |q: &QuarantinedTask| v1::QuarantinedTask { task: q.task.0, reason: q.reason.clone() };
        let lease = |l: &LeaseStatus| v1::LeaseStatus {
            task: l.task.0,
            lease: l.lease,
            worker: l.worker,
            worker_name: l.worker_name.clone(),
            attempt: l.attempt,
            age_ms: l.age_ms,
            predicted_ms: l.predicted_ms,
            is_overdue: l.is_overdue,
        };
        let attempts = |a: &TaskAttempts| v1::TaskAttempts { task: a.task.0, attempts: a.attempts };
        Self {
            bake_id: s.bake_id.clone(),
            epoch: s.epoch,
            phase: v1::Phase::from(s.phase).into(),
            tasks: Some(s.tasks.into()),
            cells: Some(s.cells.into()),
            segments: Some(s.segments.into()),
            joins: Some(s.joins.into()),
            tasks_resumed: s.tasks_resumed,
            segments_reused: s.segments_reused,
            cells_reused: s.cells_reused,
            workers: s.workers.iter().map(worker).collect(),
            workers_at_hand: s.workers_at_hand,
            leases: s.leases.iter().map(lease).collect(),
            leases_in_force: s.leases_in_force,
            attempts: s.attempts.iter().map(attempts).collect(),
            tasks_attempted_again: s.tasks_attempted_again,
            quarantined: s.quarantined.iter().map(quarantined).collect(),
            tasks_blocked: s.tasks_blocked,
            elapsed_ms: s.elapsed_ms,
            solve_ms: s.solve_ms,
            merge_ms: s.merge_ms,
            worker_solve_ms: s.worker_solve_ms,
            units_per_second: s.units_per_second,
            manifest: s.manifest,
            error: s.error.clone(),
        }
    }
}

impl TryFrom<v1::Status> for BakeStatus {
    type Error = ConvertError;

    fn try_from(m: v1::Status) -> Result<Self, ConvertError> {
        let worker = |w: v1::WorkerStatus| WorkerStatus {
            id: w.id,
            name: w.name,
            threads: w.threads,
            leases: w.leases,
            tasks_committed: w.tasks_committed,
        };
        let quarantined =
            |q: v1::QuarantinedTask| QuarantinedTask { task: TaskId(q.task), reason: q.reason };
        let lease = |l: v1::LeaseStatus| LeaseStatus {
            task: TaskId(l.task),
            lease: l.lease,
            worker: l.worker,
            worker_name: l.worker_name,
            attempt: l.attempt,
            age_ms: l.age_ms,
            predicted_ms: l.predicted_ms,
            is_overdue: l.is_overdue,
        };
        let attempts =
            |a: v1::TaskAttempts| TaskAttempts { task: TaskId(a.task), attempts: a.attempts };
        let phase = m.phase().try_into()?;
        Ok(Self {
            bake_id: m.bake_id,
            epoch: m.epoch,
            phase,
            tasks: m.tasks.ok_or(missing("Status", "tasks"))?.into(),
            cells: m.cells.ok_or(missing("Status", "cells"))?.into(),
            segments: m.segments.ok_or(missing("Status", "segments"))?.into(),
            joins: m.joins.ok_or(missing("Status", "joins"))?.into(),
            tasks_resumed: m.tasks_resumed,
            segments_reused: m.segments_reused,
            cells_reused: m.cells_reused,
            workers: m.workers.into_iter().map(worker).collect(),
            workers_at_hand: m.workers_at_hand,
            leases: m.leases.into_iter().map(lease).collect(),
            leases_in_force: m.leases_in_force,
            attempts: m.attempts.into_iter().map(attempts).collect(),
            tasks_attempted_again: m.tasks_attempted_again,
            quarantined: m.quarantined.into_iter().map(quarantined).collect(),
            tasks_blocked: m.tasks_blocked,
            elapsed_ms: m.elapsed_ms,
            solve_ms: m.solve_ms,
            merge_ms: m.merge_ms,
            worker_solve_ms: m.worker_solve_ms,
            units_per_second: m.units_per_second,
            manifest: m.manifest,
            error: m.error,
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sightline_jobs::{TiledCell, plan};

    use super::*;

    fn sample(count: u32, size: f64) -> Plan {
        moving(count, size, vec![0.0])
    }

    fn moving(count: u32, size: f64, key_times: Vec<f64>) -> Plan {
        let mut config = BakeConfig::default();
        config.region.rectangles = vec![[0.0, 0.0, size, 10.0]];
        config.region.ground_from = Some(size);
        config.tasks.segments_per_task = 3;
        config.tasks.states_per_task = 2;
        let scene = SceneRef {
            uri: "data/city.gltf".into(),
            name: "city.gltf".into(),
            digest: "ab".into(),
            files: vec![SceneFile { path: "city.bin".into(), bytes: 9, digest: "cd".into() }],
        };
        let cells = (0..count)
            .map(|k| {
                let x = f64::from(k) * size;
                let corner = |x: f64, z: f64| DVec3::new(x, 0.1 * x, z);
                TiledCell {
                    cell: ViewCell {
                        id: CellId(k),
                        corners: [
                            corner(x, 0.0),
                            corner(x + size, 0.0),
                            corner(x + size, size),
                            corner(x, size),
                        ],
                        height: 0.3,
                    },
                    tile: [i32::try_from(k).unwrap(), -1],
                }
            })
            .collect();
        plan(scene, config, key_times, cells, SkippedCells([("no ground".into(), 4)].into()))
    }

    proptest! {
        #[test]
        fn plans_survive_the_round_trip_to_the_bit(
            count in 0..9u32, size in 0.001..1e6f64, frames in 1..8u32, last in 0.0..1e9f64,
        ) {
            let times = (0..frames).map(|k| last + 0.1 * f64::from(k)).collect();
            let plan = moving(count, size, times);
            let bytes = encode_plan(&plan);
            let back = decode_plan(&bytes).unwrap();
            prop_assert_eq!(&back, &plan);
            prop_assert_eq!(encode_plan(&back), bytes);
        }

        #[test]
        fn damaged_plans_are_refused_without_a_panic(
            at in any::<prop::sample::Index>(), to: u8,
        ) {
            let mut bytes = encode_plan(&sample(4, 10.0));
            let at = at.index(bytes.len());
            bytes[at] = to;
            let _ = decode_plan(&bytes);
            let _ = decode_plan(&bytes[..at]);
        }
    }

    #[test]
    fn missing_fields_are_named() {
        let good = v1::Plan::from(&sample(2, 10.0));
        let error = |change: fn(&mut v1::Plan)| {
            let mut message = good.clone();
            change(&mut message);
            Plan::try_from(message).unwrap_err().to_string()
        };
        assert_eq!(error(|m| m.scene = None), "a Plan has no `scene`");
        assert_eq!(error(|m| m.tasks[0].kind = None), "a Task has no `kind`");
        assert_eq!(error(|m| m.tasks[0].states = None), "a Task has no `states`");
        assert!(error(|m| m.key_times.clear()).contains("key frame"));
        assert_eq!(error(|m| m.segments[0].v1 = None), "a Segment has no `v1`");
        assert!(error(|m| m.format_version = 99).contains("99"));
        assert!(error(|m| m.cells[0].corners.truncate(3)).contains("3 instead of 4"));
        assert!(error(|m| m.config_toml.push_str("\n[solver2]\n")).contains("solver2"));
        assert!(error(|m| m.cells[1].segments.push(1000)).contains("tasks"));
    }

    #[test]
    fn statuses_survive_the_round_trip() {
        let status = BakeStatus {
            bake_id: "b".into(),
            epoch: 3,
            phase: Phase::Solving,
            tasks: Progress {
                tasks: 9,
                committed: 1,
                leased: 2,
                ready: 3,
                waiting: 2,
                quarantined: 1,
            },
            cells: Done { done: 1, total: 4 },
            segments: Done { done: 2, total: 8 },
            joins: Done { done: 0, total: 3 },
            tasks_resumed: 1,
            segments_reused: 5,
            cells_reused: 6,
            workers: vec![WorkerStatus {
                id: 1,
                name: "w".into(),
                threads: 2,
                leases: 1,
                tasks_committed: 4,
            }],
            workers_at_hand: 300,
            leases: vec![LeaseStatus {
                task: TaskId(2),
                lease: 7,
                worker: 1,
                worker_name: "w".into(),
                attempt: 3,
                age_ms: 5,
                predicted_ms: 6,
                is_overdue: true,
            }],
            leases_in_force: 301,
            attempts: vec![TaskAttempts { task: TaskId(2), attempts: 3 }],
            tasks_attempted_again: 302,
            quarantined: vec![QuarantinedTask { task: TaskId(4), reason: "it broke".into() }],
            tasks_blocked: 2,
            elapsed_ms: 1,
            solve_ms: 2,
            merge_ms: 3,
            worker_solve_ms: 4,
            units_per_second: 0.5,
            manifest: 0,
            error: String::new(),
        };
        assert_eq!(BakeStatus::try_from(v1::Status::from(&status)).unwrap(), status);
        let nothing = BakeStatus::try_from(v1::Status::default()).unwrap_err();
        assert_eq!(nothing.to_string(), "a Status has no `phase`");
    }

    #[test]
    fn failure_classes_survive_the_round_trip() {
        for class in [FailureClass::RetryElsewhere, FailureClass::RetryLater, FailureClass::Never] {
            assert_eq!(FailureClass::try_from(v1::FailureClass::from(class)).unwrap(), class);
        }
        assert!(FailureClass::try_from(v1::FailureClass::Unspecified).is_err());
    }
}
