//! The plan of a bake: which segments are solved for which cells, cut into numbered tasks.
//!
//! [`plan`] is a pure function of the scene, the configuration and the tiled cells, so every
//! coordinator that is given them writes the same plan.
//!
//! Segments: a cell stands between its lower and its upper eye height. At each of `rings`
//! relative heights h its four corners, raised by h times its height, give four edges; with
//! `verticals`, the vertical edges at the corners follow. Neighbours share edges: two edges with
//! the same end points to the bit, in either direction, are one segment, solved once.
//!
//! Tasks: the segments are cut into runs, the cells into blocks, and the states of the scene into
//! ranges. A segments task is a run times a range, a cells task a block times a range; it depends on
//! the segments tasks of its range that hold the segments of its cells. Where there are several ranges,
//! a join task a block follows, which depends on the cells tasks of the block. What the tasks at the
//! end ([`Plan::final_tasks`]) write is the dataset's data.
//!
//! Invariants (checked by [`Plan::assert_well_formed`]):
//! - cells, segments and tasks are numbered from 0 in the order they are listed;
//! - segments are numbered in the order of their first use by a cell, and each is used;
//! - key times are finite and ascending; a scene at rest has one;
//! - tasks cover every segment and every cell exactly once in each state: segments first, range by
//!   range, then cells, range by range, then, with several ranges, every cell exactly once;
//! - a task depends on tasks with lower numbers only.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::ops::Range;

use glam::DVec3;
use serde::{Deserialize, Serialize};
use sightline_geometry::{CellId, SegmentId, Timeline, ViewCell, ViewSegment};

use crate::BakeConfig;

/// Version of the plan and of everything workers write. A bake of another version is another
/// bake: the version is part of the bake id.
pub const FORMAT_VERSION: u32 = 3;

/// Number of a task in a plan.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(transparent)]
pub struct TaskId(pub u32);

impl TaskId {
    /// The id as an array index.
    #[must_use]
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

impl std::fmt::Display for TaskId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

/// One file that a scene was read from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneFile {
    /// Path relative to the scene's main file.
    pub path: String,
    /// Size, bytes.
    pub bytes: u64,
    /// BLAKE3 of the content, hexadecimal.
    pub digest: String,
}

/// Which scene a bake is of.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneRef {
    /// Where it was read from, as given. Not part of the bake's identity.
    pub uri: String,
    /// Its file name. Not part of the bake's identity.
    pub name: String,
    /// Digest of all of its files, hexadecimal.
    pub digest: String,
    /// The files, in the order in which the digest takes them.
    pub files: Vec<SceneFile>,
}

/// A cell as tiling made it.
#[derive(Clone, Debug, PartialEq)]
pub struct TiledCell {
    /// The cell; its number is its place in the dataset.
    pub cell: ViewCell,
    /// Its place in the grid of tiles, for people: nothing may depend on cells being a grid.
    pub tile: [i32; 2],
}

/// Tiles that got no cell, counted by reason.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct SkippedCells(pub BTreeMap<String, u64>);

impl SkippedCells {
    /// Number of tiles without a cell.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.0.values().sum()
    }
}

/// A cell and the segments that are solved for it.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannedCell {
    /// The cell.
    pub cell: ViewCell,
    /// Its place in the grid of tiles.
    pub tile: [i32; 2],
    /// Its segments, in the order of rings and corners, each once.
    pub segments: Vec<SegmentId>,
}

/// A half-open range of states, never empty.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StateRange {
    /// First state.
    pub first: u32,
    /// First state behind the range.
    pub end: u32,
}

impl StateRange {
    /// The states.
    #[must_use]
    pub const fn range(self) -> Range<u32> {
        self.first..self.end
    }
}

/// What a task does: a half-open run of segments or of cells, in a range of states.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TaskKind {
    /// Solve the segments `first..end`.
    Segments {
        /// First segment.
        first: SegmentId,
        /// First segment behind the task.
        end: SegmentId,
        /// In these states.
        states: StateRange,
    },
    /// Finish the cells `first..end` from the sets of their segments.
    Cells {
        /// First cell.
        first: CellId,
        /// First cell behind the task.
        end: CellId,
        /// In these states.
        states: StateRange,
    },
    /// Join what was found for the cells `first..end` in the ranges of states.
    Join {
        /// First cell.
        first: CellId,
        /// First cell behind the task.
        end: CellId,
    },
}

impl TaskKind {
    /// The names of the kinds, by number, for logs and metrics.
    pub const NAMES: [&str; 3] = ["segments", "cells", "join"];
    /// Number of kinds.
    pub const KINDS: usize = Self::NAMES.len();

    /// Number of the kind, below [`TaskKind::KINDS`].
    #[must_use]
    pub const fn index(&self) -> usize {
        match self {
            Self::Segments { .. } => 0,
            Self::Cells { .. } => 1,
            Self::Join { .. } => 2,
        }
    }

    /// The name, for logs and metrics.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        Self::NAMES[self.index()]
    }

    /// Number of segments or cells. Each counts once a task, whatever the number of states: most of
    /// what is solved in a state is what was solved in the one before.
    #[must_use]
    pub const fn units(&self) -> u32 {
        match self {
            Self::Segments { first, end, .. } => end.0 - first.0,
            Self::Cells { first, end, .. } | Self::Join { first, end } => end.0 - first.0,
        }
    }
}

/// A unit of work that a worker leases.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Task {
    /// Number in the plan.
    pub id: TaskId,
    /// What it does.
    pub kind: TaskKind,
    /// Tasks whose commits it reads, ascending.
    pub depends_on: Vec<TaskId>,
}

/// The plan of a bake.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// Identity of the bake: see [`bake_id`].
    pub bake_id: String,
    /// The scene.
    pub scene: SceneRef,
    /// The configuration.
    pub config: BakeConfig,
    /// Cells in dataset order.
    pub cells: Vec<PlannedCell>,
    /// Segments in order of first use.
    pub segments: Vec<ViewSegment>,
    /// Times of the scene's key frames, seconds; one for a scene at rest.
    pub key_times: Vec<f64>,
    /// Tasks: segments tasks, then cells tasks, then join tasks.
    pub tasks: Vec<Task>,
    /// Tiles that got no cell.
    pub skipped: SkippedCells,
}

/// Identity of a bake: the scene's digest, the configuration and the version of the formats.
///
/// The cutting into tasks is part of it although the dataset of a scene at rest does not depend on it,
/// because commits are numbered by task: two cuttings are two bakes with equal datasets. Key times are
/// not: they follow from the scene and how it is read.
#[must_use]
pub fn bake_id(scene_digest: &str, config: &BakeConfig) -> String {
    let mut hasher = blake3::Hasher::new();
    let tasks = &config.tasks;
    for part in [
        format!("sightline bake {FORMAT_VERSION}"),
        scene_digest.to_owned(),
        config.hash(),
        format!("{} {} {}", tasks.segments_per_task, tasks.cells_per_task, tasks.states_per_task),
    ] {
        hasher.update(part.as_bytes());
        hasher.update(&[0]);
    }
    // 128 bits are enough for a name and keep the paths short.
    hasher.finalize().to_hex()[..32].to_owned()
}

/// Plans a bake of a scene with key frames at `key_times`, seconds.
///
/// # Panics
/// When the cells are not numbered from 0 in order, or the key times are not those of a
/// [`Timeline`]: that is a defect of the tiling, or of the reader.
#[must_use]
pub fn plan(
    scene: SceneRef,
    config: BakeConfig,
    key_times: Vec<f64>,
    cells: Vec<TiledCell>,
    skipped: SkippedCells,
) -> Plan {
    let mut pool = SegmentPool::default();
    let cells: Vec<PlannedCell> = cells
        .into_iter()
        .map(|TiledCell { cell, tile }| {
            let segments = pool.segments_of(&cell, &config);
            PlannedCell { cell, tile, segments }
        })
        .collect();
    let segments = pool.segments;
    let tasks = cut_tasks(&config, states_of(&key_times), &cells, segments.len());
    let plan = Plan {
        bake_id: bake_id(&scene.digest, &config),
        scene,
        config,
        cells,
        segments,
        key_times,
        tasks,
        skipped,
    };
    plan.assert_well_formed();
    plan
}

/// Relative heights of the rings: evenly from the lower to the upper eye height, or the middle.
fn ring_heights(rings: u32) -> impl Iterator<Item = f64> {
    (0..rings).map(move |k| if rings == 1 { 0.5 } else { f64::from(k) / f64::from(rings - 1) })
}

/// The edges that are solved for a cell.
fn edges(cell: &ViewCell, config: &BakeConfig) -> Vec<(DVec3, DVec3)> {
    let raised = |corner: usize, h: f64| cell.corners[corner] + DVec3::Y * (h * cell.height);
    let rings = ring_heights(config.solver.rings)
        .flat_map(|h| (0..4).map(move |k| (raised(k, h), raised((k + 1) % 4, h))));
    let verticals =
        (0..4).filter(|_| config.solver.verticals).map(|k| (raised(k, 0.0), raised(k, 1.0)));
    rings.chain(verticals).collect()
}

/// End points of a segment, to the bit.
type EndBits = [u64; 6];

/// Segments numbered in order of first use.
#[derive(Default)]
struct SegmentPool {
    segments: Vec<ViewSegment>,
    numbers: HashMap<EndBits, SegmentId>,
}

impl SegmentPool {
    fn segments_of(&mut self, cell: &ViewCell, config: &BakeConfig) -> Vec<SegmentId> {
        let mut out: Vec<SegmentId> = Vec::new();
        for (a, b) in edges(cell, config) {
            let Some(id) = self.number(a, b) else { continue };
            if !out.contains(&id) {
                out.push(id);
            }
        }
        out
    }

    /// The segment between two points; `None` when they are the same point.
    fn number(&mut self, a: DVec3, b: DVec3) -> Option<SegmentId> {
        // Adding +0 turns -0 into +0, so that equal points have equal bits.
        let (a, b) = (a + DVec3::ZERO, b + DVec3::ZERO);
        let (v0, v1) = match a.to_array().partial_cmp(&b.to_array())? {
            std::cmp::Ordering::Less => (a, b),
            std::cmp::Ordering::Equal => return None,
            std::cmp::Ordering::Greater => (b, a),
        };
        let bits = [v0.x, v0.y, v0.z, v1.x, v1.y, v1.z].map(f64::to_bits);
        let next = SegmentId(u32::try_from(self.segments.len()).expect("under 2^32 segments"));
        let id = *self.numbers.entry(bits).or_insert(next);
        if id == next {
            self.segments.push(ViewSegment { id, v0, v1 });
        }
        Some(id)
    }
}

/// Number of states between so many key frames, as [`Timeline::states`].
fn states_of(key_times: &[f64]) -> u32 {
    u32::try_from(key_times.len().saturating_sub(1)).expect("under 2^32 states").max(1)
}

fn cut_tasks(
    config: &BakeConfig,
    states: u32,
    cells: &[PlannedCell],
    segment_count: usize,
) -> Vec<Task> {
    let cut = &config.tasks;
    let ranges =
        || runs(states as usize, cut.states_per_task).map(|(first, end)| StateRange { first, end });
    let (range_count, segment_runs, blocks) = (
        ranges().count(),
        runs(segment_count, cut.segments_per_task).count(),
        runs(cells.len(), cut.cells_per_task).count(),
    );
    let mut tasks: Vec<Task> = Vec::new();
    let mut push =
        |kind, depends_on| tasks.push(Task { id: task_id(tasks.len()), kind, depends_on });
    for states in ranges() {
        for (first, end) in runs(segment_count, cut.segments_per_task) {
            let (first, end) = (SegmentId(first), SegmentId(end));
            push(TaskKind::Segments { first, end, states }, Vec::new());
        }
    }
    for (range, states) in ranges().enumerate() {
        for (first, end) in runs(cells.len(), cut.cells_per_task) {
            let depends_on: BTreeSet<TaskId> = cells[first as usize..end as usize]
                .iter()
                .flat_map(|cell| &cell.segments)
                .map(|segment| (segment.0 / cut.segments_per_task) as usize)
                .map(|run| task_id(range * segment_runs + run))
                .collect();
            let (first, end) = (CellId(first), CellId(end));
            push(TaskKind::Cells { first, end, states }, depends_on.into_iter().collect());
        }
    }
    if range_count > 1 {
        for (block, (first, end)) in runs(cells.len(), cut.cells_per_task).enumerate() {
            let of_range = |range| task_id(range_count * segment_runs + range * blocks + block);
            let depends_on = (0..range_count).map(of_range).collect();
            push(TaskKind::Join { first: CellId(first), end: CellId(end) }, depends_on);
        }
    }
    tasks
}

fn task_id(index: usize) -> TaskId {
    TaskId(u32::try_from(index).expect("under 2^32 tasks"))
}

/// Cuts `0..count` into runs of `size`, the last one shorter.
fn runs(count: usize, size: u32) -> impl Iterator<Item = (u32, u32)> {
    let count = u32::try_from(count).expect("under 2^32 units");
    (0..count.div_ceil(size))
        .map(move |k| (k * size, k.saturating_mul(size).saturating_add(size).min(count)))
}

impl Plan {
    /// A task.
    ///
    /// # Panics
    /// When the plan has no such task.
    #[must_use]
    pub fn task(&self, id: TaskId) -> &Task {
        &self.tasks[id.index()]
    }

    /// Number of states of the scene, at least 1.
    #[must_use]
    pub fn states(&self) -> u32 {
        states_of(&self.key_times)
    }

    /// When the states are.
    ///
    /// # Panics
    /// When the key times break their invariant: a plan that was [checked](Self::check) has none such.
    #[must_use]
    pub fn timeline(&self) -> Timeline {
        Timeline::new(self.key_times.clone()).expect("key times are finite and ascending")
    }

    /// The segments of a segments task; empty for others.
    #[must_use]
    pub fn segments_of(&self, task: TaskId) -> &[ViewSegment] {
        match self.task(task).kind {
            TaskKind::Segments { first, end, .. } => &self.segments[first.index()..end.index()],
            TaskKind::Cells { .. } | TaskKind::Join { .. } => &[],
        }
    }

    /// The cells of a cells or join task; empty for a segments task.
    #[must_use]
    pub fn cells_of(&self, task: TaskId) -> &[PlannedCell] {
        match self.task(task).kind {
            TaskKind::Segments { .. } => &[],
            TaskKind::Cells { first, end, .. } | TaskKind::Join { first, end } => {
                &self.cells[first.index()..end.index()]
            }
        }
    }

    /// The states of a task; all of them for a join task.
    #[must_use]
    pub fn states_of(&self, task: TaskId) -> Range<u32> {
        match self.task(task).kind {
            TaskKind::Segments { states, .. } | TaskKind::Cells { states, .. } => states.range(),
            TaskKind::Join { .. } => 0..self.states(),
        }
    }

    /// The task that solves a segment in a state.
    #[must_use]
    pub fn task_of_segment(&self, segment: SegmentId, state: u32) -> TaskId {
        let cut = &self.config.tasks;
        let segments = u32::try_from(self.segments.len()).expect("under 2^32 segments");
        let range = state / cut.states_per_task;
        let runs = segments.div_ceil(cut.segments_per_task);
        TaskId(range * runs + segment.0 / cut.segments_per_task)
    }

    /// The tasks that write the dataset's data, in cell order: join tasks, or cells tasks where all
    /// states are in one range.
    pub fn final_tasks(&self) -> impl Iterator<Item = &Task> {
        let joins = self.tasks.last().is_some_and(|t| matches!(t.kind, TaskKind::Join { .. }));
        self.tasks.iter().filter(move |task| match task.kind {
            TaskKind::Segments { .. } => false,
            TaskKind::Cells { .. } => !joins,
            TaskKind::Join { .. } => true,
        })
    }

    /// Number of ranges that the states are cut into.
    #[must_use]
    pub fn state_ranges(&self) -> u32 {
        self.states().div_ceil(self.config.tasks.states_per_task)
    }

    /// Panics with the first invariant that does not hold.
    pub fn assert_well_formed(&self) {
        if let Err(problem) = self.check() {
            panic!("{problem}");
        }
    }

    /// Checks a plan that comes from elsewhere.
    ///
    /// # Errors
    /// The first invariant that does not hold.
    pub fn check(&self) -> Result<(), String> {
        ensure(self.bake_id == bake_id(&self.scene.digest, &self.config), || {
            "the bake id is not that of the scene and the configuration".into()
        })?;
        self.check_segments()?;
        for (index, cell) in self.cells.iter().enumerate() {
            ensure(cell.cell.id.index() == index, || format!("cell {index} is out of order"))?;
        }
        Timeline::new(self.key_times.clone())?;
        let expected = cut_tasks(&self.config, self.states(), &self.cells, self.segments.len());
        ensure(self.tasks == expected, || {
            "the tasks do not cover segments, then cells, each once a state".into()
        })?;
        ensure(self.tasks.iter().all(|t| t.depends_on.iter().all(|d| *d < t.id)), || {
            "a task depends on a later one".into()
        })
    }

    fn check_segments(&self) -> Result<(), String> {
        for (index, segment) in self.segments.iter().enumerate() {
            ensure(segment.id.index() == index, || format!("segment {index} is out of order"))?;
            ensure(segment.v0.to_array() < segment.v1.to_array(), || {
                format!("segment {index} does not run in its canonical direction")
            })?;
        }
        let mut seen = 0;
        for id in self.cells.iter().flat_map(|cell| &cell.segments) {
            ensure(id.index() <= seen, || {
                format!("segment {id} is not numbered in order of first use")
            })?;
            seen = seen.max(id.index() + 1);
        }
        ensure(seen == self.segments.len(), || {
            format!("cells use {seen} segments of {}", self.segments.len())
        })
    }
}

fn ensure(holds: bool, problem: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(problem()) }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn scene() -> SceneRef {
        SceneRef {
            uri: "city.glb".into(),
            name: "city.glb".into(),
            digest: "ab".repeat(32),
            files: vec![SceneFile { path: "city.glb".into(), bytes: 3, digest: "cd".into() }],
        }
    }

    fn config(rings: u32, verticals: bool) -> BakeConfig {
        let mut config = BakeConfig::default();
        config.region.rectangles = vec![[0.0, 0.0, 1.0, 1.0]];
        config.solver.rings = rings;
        config.solver.verticals = verticals;
        config.tasks.segments_per_task = 7;
        config.tasks.cells_per_task = 3;
        config
    }

    fn at_rest() -> Vec<f64> {
        vec![0.0]
    }

    /// An n x m grid of cells whose corners follow a bumpy ground.
    fn grid(n: i32, m: i32, height: f64) -> Vec<TiledCell> {
        let corner = |i: i32, j: i32| {
            DVec3::new(
                f64::from(i) * 10.0 - 5.0,
                f64::from((i * 7 + j * 3) % 4),
                f64::from(j) * 10.0,
            )
        };
        (0..m)
            .flat_map(|j| (0..n).map(move |i| (i, j)))
            .enumerate()
            .map(|(id, (i, j))| TiledCell {
                cell: ViewCell {
                    id: CellId(u32::try_from(id).unwrap()),
                    corners: [
                        corner(i, j),
                        corner(i + 1, j),
                        corner(i + 1, j + 1),
                        corner(i, j + 1),
                    ],
                    height,
                },
                tile: [i, j],
            })
            .collect()
    }

    #[test]
    fn neighbours_share_their_edges() {
        for (n, m, rings) in [(1, 1, 1), (3, 2, 2), (5, 4, 3)] {
            let plan = plan(
                scene(),
                config(rings, false),
                at_rest(),
                grid(n, m, 0.3),
                SkippedCells::default(),
            );
            let wanted = rings as usize * usize::try_from(n * (m + 1) + m * (n + 1)).unwrap();
            assert_eq!(plan.segments.len(), wanted);
            assert!(plan.cells.iter().all(|c| c.segments.len() == 4 * rings as usize));
        }
    }

    #[test]
    fn verticals_are_shared_at_corners() {
        let with =
            plan(scene(), config(2, true), at_rest(), grid(3, 2, 0.3), SkippedCells::default());
        let without =
            plan(scene(), config(2, false), at_rest(), grid(3, 2, 0.3), SkippedCells::default());
        assert_eq!(with.segments.len() - without.segments.len(), 4 * 3);
    }

    #[test]
    fn rings_of_a_flat_cell_fall_together_and_its_verticals_vanish() {
        let flat =
            plan(scene(), config(3, true), at_rest(), grid(1, 1, 0.0), SkippedCells::default());
        assert_eq!(flat.segments.len(), 4);
        assert_eq!(flat.cells[0].segments.len(), 4);
    }

    #[test]
    fn one_ring_runs_through_the_middle() {
        let plan =
            plan(scene(), config(1, false), at_rest(), grid(1, 1, 1.0), SkippedCells::default());
        assert_eq!(plan.segments[0].v0.y, 0.5);
    }

    #[test]
    fn negative_zero_is_zero() {
        let mut cells = grid(1, 1, 0.0);
        for corner in &mut cells[0].cell.corners {
            corner.y = 0.0;
        }
        let mut second = cells[0].clone();
        second.cell.id = CellId(1);
        for corner in &mut second.cell.corners {
            corner.y = -0.0;
        }
        cells.push(second);
        let plan = plan(scene(), config(1, false), at_rest(), cells, SkippedCells::default());
        assert_eq!(plan.segments.len(), 4);
    }

    #[test]
    fn the_bake_is_named_after_scene_and_configuration() {
        let id = |digest: &str, config: &BakeConfig| bake_id(digest, config);
        let base = config(2, false);
        let mut cut = base.clone();
        cut.tasks.cells_per_task = 99;
        let mut cut_states = base.clone();
        cut_states.tasks.states_per_task = 5;
        let ids = [
            id("a", &base),
            id("b", &base),
            id("a", &config(1, false)),
            id("a", &cut),
            id("a", &cut_states),
        ];
        assert_eq!(ids.iter().collect::<BTreeSet<_>>().len(), 5);
        assert_eq!(id("a", &base), id("a", &base.clone()));
    }

    #[test]
    fn a_scene_at_rest_has_no_joins_and_ranges_of_states_have() {
        let planned = |key_times| {
            let mut config = config(1, false);
            config.tasks.states_per_task = 2;
            plan(scene(), config, key_times, grid(2, 2, 0.3), SkippedCells::default())
        };
        let kinds = |plan: &Plan| {
            let count = |kind: fn(&TaskKind) -> bool| {
                plan.tasks.iter().filter(|task| kind(&task.kind)).count()
            };
            [
                count(|kind| matches!(kind, TaskKind::Segments { .. })),
                count(|kind| matches!(kind, TaskKind::Cells { .. })),
                count(|kind| matches!(kind, TaskKind::Join { .. })),
            ]
        };
        // 12 segments by 7, 4 cells by 3.
        assert_eq!(kinds(&planned(vec![0.0])), [2, 2, 0]);
        assert_eq!(kinds(&planned(vec![0.0, 0.5, 2.0])), [2, 2, 0], "one range of two states");
        assert_eq!(kinds(&planned(vec![0.0, 0.5, 2.0, 3.0])), [4, 4, 2]);
    }

    #[test]
    fn key_times_that_make_no_sense_are_found() {
        let good = plan(
            scene(),
            config(1, false),
            vec![0.0, 1.0],
            grid(1, 1, 0.3),
            SkippedCells::default(),
        );
        for times in [vec![], vec![0.0, f64::NAN], vec![1.0, 1.0]] {
            assert!(Plan { key_times: times, ..good.clone() }.check().is_err());
        }
        let more = Plan { key_times: (0..99).map(f64::from).collect(), ..good };
        assert!(more.check().unwrap_err().contains("each once a state"));
    }

    proptest! {
        #[test]
        fn plans_are_well_formed_and_repeatable(
            n in 1..6i32, m in 1..6i32, rings in 1..4u32, verticals: bool,
            per_segments in 1..40u32, per_cells in 1..40u32,
            key_frames in 1..9u32, per_states in 1..10u32,
        ) {
            let mut config = config(rings, verticals);
            config.tasks.segments_per_task = per_segments;
            config.tasks.cells_per_task = per_cells;
            config.tasks.states_per_task = per_states;
            let times: Vec<f64> = (0..key_frames).map(f64::from).collect();
            let planned =
                || plan(scene(), config.clone(), times.clone(), grid(n, m, 0.3), SkippedCells::default());
            let (once, twice) = (planned(), planned());
            once.assert_well_formed();
            prop_assert_eq!(&once, &twice);
            // How often each segment and each cell is taken in each state.
            let states = once.states();
            prop_assert_eq!(states, (key_frames - 1).max(1));
            let mut solved = vec![0; once.segments.len() * states as usize];
            let mut finished = vec![0; once.cells.len() * states as usize];
            for task in &once.tasks {
                for state in once.states_of(task.id) {
                    let at = |number: usize| number * states as usize + state as usize;
                    for segment in once.segments_of(task.id) {
                        solved[at(segment.id.index())] += 1;
                        prop_assert_eq!(once.task_of_segment(segment.id, state), task.id);
                    }
                    let is_cells = matches!(task.kind, TaskKind::Cells { .. });
                    for cell in once.cells_of(task.id).iter().filter(|_| is_cells) {
                        finished[at(cell.cell.id.index())] += 1;
                        for segment in &cell.segments {
                            let needed = once.task_of_segment(*segment, state);
                            prop_assert!(task.depends_on.contains(&needed));
                        }
                    }
                }
            }
            prop_assert!(solved.iter().chain(&finished).all(|times| *times == 1));
            // The tasks at the end cover the cells in order, and know of all that was found.
            let last: Vec<CellId> = once
                .final_tasks()
                .flat_map(|task| once.cells_of(task.id))
                .map(|cell| cell.cell.id)
                .collect();
            prop_assert!(last.iter().copied().eq((0..once.cells.len() as u32).map(CellId)));
            let ranges = states.div_ceil(per_states);
            prop_assert_eq!(once.state_ranges(), ranges);
            for task in once.final_tasks().filter(|_| ranges > 1) {
                prop_assert_eq!(task.depends_on.len(), ranges as usize);
                for (range, before) in task.depends_on.iter().enumerate() {
                    prop_assert_eq!(once.cells_of(*before), once.cells_of(task.id));
                    prop_assert_eq!(once.states_of(*before).start, range as u32 * per_states);
                }
            }
        }
    }
}
