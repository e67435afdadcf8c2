//! A small made-up dataset, the same everywhere: tests compare its bytes, and the golden files in
//! `schemas/golden/` are written from it.

#![allow(dead_code)]

pub mod faulty;

use std::collections::BTreeMap;

use glam::DVec3;
use serde_json::json;
use sightline_geometry::{
    Bounds, CellId, MeshId, ObjectId, PrimitiveSet, Run, SegmentId, Timeline, ViewCell,
};
use sightline_store::{
    BakeStore, CellEffort, CellRow, DatasetWriter, Description, Limits, Manifest, NumberedInstance,
    NumberedMesh, Numbering, ObjectRow, SceneFile, SceneObject, SceneSource, SegmentRow, Weight,
};

/// Numbers that look random and are the same on every machine (Knuth's MMIX constants).
pub struct Sequence(u64);

impl Sequence {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The next number below `bound`.
    pub fn below(&mut self, bound: u32) -> u32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((self.0 >> 33) as u32) % bound
    }
}

/// Rows of a made-up bake.
pub struct Sample {
    pub objects: Vec<SceneObject>,
    pub numbering: Numbering,
    pub timeline: Timeline,
    /// Of each cell the row of all states, and what it sees of each object.
    pub cells: Vec<(CellRow, Vec<ObjectRow>)>,
    /// Of each cell the rows of its runs, by time; none where there is one run.
    pub runs: Vec<Vec<CellRow>>,
    pub description: Description,
}

/// The states of the runs of a cell that has several.
const RUNS: [std::ops::Range<u32>; 3] = [0..2, 2..3, 3..5];

const MESH_SIZES: [u32; 3] = [12, 40, 250];
const NAMES: [&str; 4] = ["house", "tree", "fence", "lamp \u{2014} small"];

impl Sample {
    /// `cells` cells that see a scene of `object_count` objects at rest.
    pub fn new(cells: u32, object_count: u32) -> Self {
        let mut random = Sequence::new(7);
        let (objects, numbering) = scene(object_count, &mut random);
        let cells: Vec<_> = (0..cells).map(|id| cell(id, &objects, &mut random)).collect();
        let runs = vec![Vec::new(); cells.len()];
        let timeline = Timeline::at_rest();
        Self { objects, numbering, timeline, cells, runs, description: description() }
    }

    /// The same in a scene of five states, where every third cell sees something else in the first two,
    /// the third and the last two. The last object is a particle system.
    pub fn moving(cells: u32, object_count: u32) -> Self {
        let mut sample = Self::new(cells, object_count);
        sample.timeline = Timeline::new(vec![0.0, 0.5, 1.0, 2.0, 4.0, 4.25]).unwrap();
        let last = sample.objects[sample.objects.len() - 1].clone();
        sample.numbering.instances.retain(|instance| instance.object != last.id);
        let scene = &mut sample.description.scene;
        scene.particle_systems = 1;
        scene.particles = u64::from(last.end_primitive - last.first_primitive);
        for ((union, pairs), runs) in sample.cells.iter_mut().zip(&mut sample.runs) {
            union.last_state = 4;
            if union.cell.id.0.is_multiple_of(3) {
                *runs = RUNS.iter().zip(0..).map(|(states, k)| part(union, states, k)).collect();
            }
            for pair in pairs {
                let object = &sample.objects[pair.object.index()];
                let own = object.first_primitive..object.end_primitive;
                let seen = |run: &&CellRow| run.set.count_in(own.clone()) > 0;
                let runs = if runs.is_empty() { std::slice::from_ref(union) } else { &runs[..] };
                pair.first_state = runs.iter().find(seen).unwrap().first_state;
                pair.last_state = runs.iter().rev().find(seen).unwrap().last_state;
            }
        }
        sample
    }

    /// The sample of the golden files.
    pub fn golden() -> Self {
        Self::moving(24, 60)
    }

    /// The sample of the golden files of versions 1 and 2.
    pub fn golden_at_rest() -> Self {
        Self::new(24, 60)
    }

    /// The rows of cell `k`, as the table has them: all states, then the longest runs first.
    pub fn rows(&self, k: usize) -> Vec<CellRow> {
        let mut runs = self.runs[k].clone();
        runs.sort_by_key(|run| std::cmp::Reverse(run.last_state - run.first_state));
        runs.insert(0, self.cells[k].0.clone());
        runs
    }

    /// The rows of all cells.
    pub fn all_rows(&self) -> Vec<CellRow> {
        (0..self.cells.len()).flat_map(|k| self.rows(k)).collect()
    }

    /// Stores all files; gives the manifest.
    pub async fn write(&self, store: &BakeStore, limits: Limits) -> Manifest {
        self.try_write(store, limits).await.unwrap()
    }

    pub async fn try_write(
        &self,
        store: &BakeStore,
        limits: Limits,
    ) -> sightline_store::Result<Manifest> {
        let (objects, timeline) = (self.objects.clone(), self.timeline.clone());
        let mut writer = DatasetWriter::with_limits(store, objects, timeline, limits)?;
        for (k, (_, pairs)) in self.cells.iter().enumerate() {
            writer.push_cell(&self.rows(k), pairs).await?;
        }
        writer.finish(&self.numbering, self.description.clone()).await
    }
}

fn scene(count: u32, random: &mut Sequence) -> (Vec<SceneObject>, Numbering) {
    let mut objects = Vec::new();
    let mut instances = Vec::new();
    let mut next = 0;
    for id in 0..count {
        let mesh = random.below(MESH_SIZES.len() as u32);
        let name = NAMES[random.below(NAMES.len() as u32) as usize];
        let first = next;
        // Every fifth object repeats its mesh three times.
        for copy in 0..if id % 5 == 4 { 3 } else { 1 } {
            instances.push(NumberedInstance {
                first_primitive: next,
                object: ObjectId(id),
                node: id + 1,
                gpu_instance: (id % 5 == 4).then_some(copy),
                mesh: MeshId(mesh),
            });
            next += MESH_SIZES[mesh as usize];
        }
        let min = DVec3::new(f64::from(random.below(400)) * 0.25, 0.0, f64::from(id) * 1.5);
        objects.push(SceneObject {
            id: ObjectId(id),
            name: name.into(),
            path: format!("town/block {}/{name}", id / 8),
            node: id + 1,
            first_primitive: first,
            end_primitive: next,
            occluder: !name.starts_with("fence"),
            bounds: Bounds { min, max: min + DVec3::new(2.0, 3.5, 2.0) },
        });
    }
    let meshes = MESH_SIZES.iter().enumerate().map(|(id, &size)| NumberedMesh {
        id: MeshId(id as u32),
        gltf_mesh: id as u32 / 2,
        gltf_primitive: id as u32 % 2,
        triangles: (0..size).map(|k| (k * 7 + 3) % size).collect(),
    });
    let meshes = meshes.collect();
    (objects, Numbering { instances, meshes })
}

fn cell(id: u32, objects: &[SceneObject], random: &mut Sequence) -> (CellRow, Vec<ObjectRow>) {
    let mut set = PrimitiveSet::default();
    let mut pairs = Vec::new();
    for object in objects {
        // Cell 5 sees nothing; the others see about two objects of three.
        if id == 5 || random.below(3) == 0 {
            continue;
        }
        let total = object.end_primitive - object.first_primitive;
        let first = object.first_primitive + random.below(total);
        let end = first + 1 + random.below(object.end_primitive - first);
        set.push(Run { first, end });
        pairs.push(ObjectRow {
            cell: CellId(id),
            object: object.id,
            visible_primitives: end - first,
            total_primitives: total,
            // So small that the objects of a large sample stay below the whole view together.
            weight: f64::from(random.below(1 << 20)) / f64::from(1 << 30),
            first_state: 0,
            last_state: 0,
        });
    }
    let tile = [(id % 6) as i32 - 2, (id / 6) as i32];
    let corner = |dx: i32, dz: i32| {
        let (x, z) = (f64::from(tile[0] + dx) * 10.0, f64::from(tile[1] + dz) * 10.0);
        DVec3::new(x, 1.5 + 0.125 * x, z)
    };
    let weights = pairs.iter().flat_map(weights_of).collect();
    let heldout_error_mean = f64::from(random.below(1000)) / f64::from(1 << 22);
    let effort = CellEffort {
        segments: 8 + id % 3,
        runs: 1 + id % 3,
        lines: id % 5,
        rows: 64 << (id % 3),
        solver_rays: 1_000_000 + u64::from(id),
        refinements: id % 3,
        heldout_viewpoints: 8192,
        heldout_rays: 64_000,
        heldout_error_mean,
        heldout_error_upper: 2.0 * heldout_error_mean + 0.0001,
        heldout_error_max: f64::from(random.below(1000)) / f64::from(1 << 20),
        target_met: !id.is_multiple_of(4),
    };
    let row = CellRow {
        cell: ViewCell {
            id: CellId(id),
            corners: [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)],
            height: 0.25,
        },
        tile,
        first_state: 0,
        last_state: 0,
        set,
        weights,
        effort,
    };
    (row, pairs)
}

/// What a run of states sees of a cell's set: two members of three, others in each run.
fn part(union: &CellRow, states: &std::ops::Range<u32>, run: u32) -> CellRow {
    let seen =
        union.set.iter().zip(&union.weights).filter(|(p, _)| !(p.0 / 7 + run).is_multiple_of(3));
    let (members, weights): (Vec<u32>, Vec<Weight>) = seen.map(|(p, w)| (p.0, *w)).unzip();
    CellRow {
        first_state: states.start,
        last_state: states.end - 1,
        set: PrimitiveSet::from_sorted(members),
        weights,
        ..union.clone()
    }
}

/// The weight of an object, shared out unevenly among its visible primitives.
fn weights_of(pair: &ObjectRow) -> Vec<Weight> {
    let part = |k: u32| f64::from(k % 7 + 1);
    let whole: f64 = (0..pair.visible_primitives).map(part).sum();
    (0..pair.visible_primitives)
        .map(|k| Weight::from_share(pair.weight * part(k) / whole))
        .collect()
}

fn description() -> Description {
    Description {
        scene: SceneSource {
            uri: "town.gltf".into(),
            hash: "00c0ffee".into(),
            files: vec![SceneFile {
                name: "town.bin".into(),
                bytes: 12_345,
                blake3: "00".repeat(32),
            }],
            ..SceneSource::default()
        },
        config: json!({ "solver": { "rows": 200, "rings": 2 }, "region": { "cell_size": 10.0 } }),
        config_hash: "0badcafe".into(),
        skipped: BTreeMap::from([("inside a solid".into(), 3), ("no ground".into(), 1)]),
    }
}

/// Rows of a made-up segments task; every fourth segment has two runs of states.
pub fn segments(count: u32) -> Vec<SegmentRow> {
    let mut random = Sequence::new(11);
    let row = |id: u32| {
        let mut set = PrimitiveSet::default();
        let mut first = random.below(50);
        for _ in 0..random.below(40) {
            let end = first + 1 + random.below(30);
            set.push(Run { first, end });
            first = end + 1 + random.below(100);
        }
        let weights = (0..set.len()).map(|_| random.below(1 << 20) as f32 / 1e9).collect();
        let (segment, rays) = (SegmentId(3 * id), u64::from(1000 + id));
        let whole = SegmentRow { segment, first_state: 0, last_state: 4, set, weights, rays };
        if !id.is_multiple_of(4) {
            return vec![whole];
        }
        let nothing = SegmentRow {
            first_state: 2,
            set: PrimitiveSet::default(),
            weights: vec![],
            ..whole.clone()
        };
        vec![SegmentRow { last_state: 1, ..whole }, nothing]
    };
    (0..count).flat_map(row).collect()
}
