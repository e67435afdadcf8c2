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
//! Tasks: the segments are cut into runs, then the cells are. A cells task depends on the
//! segments tasks that hold the segments of its cells.
//!
//! Invariants (checked by [`Plan::assert_well_formed`]):
//! - cells, segments and tasks are numbered from 0 in the order they are listed;
//! - segments are numbered in the order of their first use by a cell, and each is used;
//! - tasks cover every segment and every cell exactly once, segments first;
//! - a task depends on tasks with lower numbers only.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use glam::DVec3;
use serde::{Deserialize, Serialize};
use sightline_geometry::{CellId, SegmentId, ViewCell, ViewSegment};

use crate::BakeConfig;

/// Version of the plan and of everything workers write. A bake of another version is another
/// bake: the version is part of the bake id.
pub const FORMAT_VERSION: u32 = 2;

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

/// What a task does: a half-open run of segments or of cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TaskKind {
    /// Solve the segments `first..end`.
    Segments {
        /// First segment.
        first: SegmentId,
        /// First segment behind the task.
        end: SegmentId,
    },
    /// Finish the cells `first..end` from the sets of their segments.
    Cells {
        /// First cell.
        first: CellId,
        /// First cell behind the task.
        end: CellId,
    },
}

impl TaskKind {
    /// Number of segments or cells.
    #[must_use]
    pub const fn units(&self) -> u32 {
        match self {
            Self::Segments { first, end } => end.0 - first.0,
            Self::Cells { first, end } => end.0 - first.0,
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
    /// Tasks: segments tasks, then cells tasks.
    pub tasks: Vec<Task>,
    /// Tiles that got no cell.
    pub skipped: SkippedCells,
}

/// Identity of a bake: the scene's digest, the configuration and the version of the formats.
///
/// The cutting into tasks is part of it although the dataset does not depend on it, because
/// commits are numbered by task: two cuttings are two bakes with equal datasets.
#[must_use]
pub fn bake_id(scene_digest: &str, config: &BakeConfig) -> String {
    let mut hasher = blake3::Hasher::new();
    let tasks = &config.tasks;
    for part in [
        format!("sightline bake {FORMAT_VERSION}"),
        scene_digest.to_owned(),
        config.hash(),
        format!("{} {}", tasks.segments_per_task, tasks.cells_per_task),
    ] {
        hasher.update(part.as_bytes());
        hasher.update(&[0]);
    }
    // 128 bits are enough for a name and keep the paths short.
    hasher.finalize().to_hex()[..32].to_owned()
}

/// Plans a bake.
///
/// # Panics
/// When the cells are not numbered from 0 in order: that is a defect of the tiling.
#[must_use]
pub fn plan(
    scene: SceneRef,
    config: BakeConfig,
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
    let tasks = cut_tasks(&config, &cells, segments.len());
    let plan = Plan {
        bake_id: bake_id(&scene.digest, &config),
        scene,
        config,
        cells,
        segments,
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

fn cut_tasks(config: &BakeConfig, cells: &[PlannedCell], segment_count: usize) -> Vec<Task> {
    let (per_segments, per_cells) = (config.tasks.segments_per_task, config.tasks.cells_per_task);
    let mut tasks = Vec::new();
    for (first, end) in runs(segment_count, per_segments) {
        let kind = TaskKind::Segments { first: SegmentId(first), end: SegmentId(end) };
        tasks.push(Task { id: task_id(tasks.len()), kind, depends_on: Vec::new() });
    }
    for (first, end) in runs(cells.len(), per_cells) {
        let kind = TaskKind::Cells { first: CellId(first), end: CellId(end) };
        let depends_on: BTreeSet<TaskId> = cells[first as usize..end as usize]
            .iter()
            .flat_map(|cell| &cell.segments)
            .map(|segment| TaskId(segment.0 / per_segments))
            .collect();
        let depends_on = depends_on.into_iter().collect();
        tasks.push(Task { id: task_id(tasks.len()), kind, depends_on });
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

    /// The segments of a segments task; empty for a cells task.
    #[must_use]
    pub fn segments_of(&self, task: TaskId) -> &[ViewSegment] {
        match self.task(task).kind {
            TaskKind::Segments { first, end } => &self.segments[first.index()..end.index()],
            TaskKind::Cells { .. } => &[],
        }
    }

    /// The cells of a cells task; empty for a segments task.
    #[must_use]
    pub fn cells_of(&self, task: TaskId) -> &[PlannedCell] {
        match self.task(task).kind {
            TaskKind::Segments { .. } => &[],
            TaskKind::Cells { first, end } => &self.cells[first.index()..end.index()],
        }
    }

    /// The task that solves a segment.
    #[must_use]
    pub fn task_of_segment(&self, segment: SegmentId) -> TaskId {
        TaskId(segment.0 / self.config.tasks.segments_per_task)
    }

    /// The cells tasks, in cell order.
    pub fn cell_tasks(&self) -> impl Iterator<Item = &Task> {
        self.tasks.iter().filter(|t| matches!(t.kind, TaskKind::Cells { .. }))
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
        let expected = cut_tasks(&self.config, &self.cells, self.segments.len());
        ensure(self.tasks == expected, || {
            "the tasks do not cover segments, then cells, each once".into()
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
            let plan =
                plan(scene(), config(rings, false), grid(n, m, 0.3), SkippedCells::default());
            let wanted = rings as usize * usize::try_from(n * (m + 1) + m * (n + 1)).unwrap();
            assert_eq!(plan.segments.len(), wanted);
            assert!(plan.cells.iter().all(|c| c.segments.len() == 4 * rings as usize));
        }
    }

    #[test]
    fn verticals_are_shared_at_corners() {
        let with = plan(scene(), config(2, true), grid(3, 2, 0.3), SkippedCells::default());
        let without = plan(scene(), config(2, false), grid(3, 2, 0.3), SkippedCells::default());
        assert_eq!(with.segments.len() - without.segments.len(), 4 * 3);
    }

    #[test]
    fn rings_of_a_flat_cell_fall_together_and_its_verticals_vanish() {
        let flat = plan(scene(), config(3, true), grid(1, 1, 0.0), SkippedCells::default());
        assert_eq!(flat.segments.len(), 4);
        assert_eq!(flat.cells[0].segments.len(), 4);
    }

    #[test]
    fn one_ring_runs_through_the_middle() {
        let plan = plan(scene(), config(1, false), grid(1, 1, 1.0), SkippedCells::default());
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
        let plan = plan(scene(), config(1, false), cells, SkippedCells::default());
        assert_eq!(plan.segments.len(), 4);
    }

    #[test]
    fn the_bake_is_named_after_scene_and_configuration() {
        let id = |digest: &str, config: &BakeConfig| bake_id(digest, config);
        let base = config(2, false);
        let mut cut = base.clone();
        cut.tasks.cells_per_task = 99;
        let ids = [id("a", &base), id("b", &base), id("a", &config(1, false)), id("a", &cut)];
        assert_eq!(ids.iter().collect::<BTreeSet<_>>().len(), 4);
        assert_eq!(id("a", &base), id("a", &base.clone()));
    }

    proptest! {
        #[test]
        fn plans_are_well_formed_and_repeatable(
            n in 1..6i32, m in 1..6i32, rings in 1..4u32, verticals: bool,
            per_segments in 1..40u32, per_cells in 1..40u32,
        ) {
            let mut config = config(rings, verticals);
            config.tasks.segments_per_task = per_segments;
            config.tasks.cells_per_task = per_cells;
            let once = plan(scene(), config.clone(), grid(n, m, 0.3), SkippedCells::default());
            let twice = plan(scene(), config, grid(n, m, 0.3), SkippedCells::default());
            once.assert_well_formed();
            prop_assert_eq!(&once, &twice);
            for task in once.cell_tasks() {
                for cell in once.cells_of(task.id) {
                    for segment in &cell.segments {
                        prop_assert!(task.depends_on.contains(&once.task_of_segment(*segment)));
                    }
                }
            }
        }
    }
}
