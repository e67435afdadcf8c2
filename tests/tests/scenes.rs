//! Real scenes, baked and verified: few cells and few rows, so that it takes seconds each.
//!
//! The scenes are not in the repository; see [`sightline_tests::scenes`].

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, OnceLock};
use std::time::Duration;

use glam::DVec3;
use serde_json::Value;
use sightline_geometry::{CellId, PrimitiveId};
use sightline_scene::{OpenOptions, Scene};
use sightline_store::{BakeStore, CellRow, Dataset};
use sightline_tests::binaries::sightline;
use sightline_tests::{dataset, glb, process, scenes};

/// Longest time for one command.
const LIMIT: Duration = Duration::from_secs(600);
/// Mean pixel error that a dataset may have, share of pixels: 0.02 %.
const MEAN_MAX: f64 = 0.0002;
/// Error of the worst viewpoint that a dataset may have, share of pixels: 0.5 %.
const WORST_MAX: f64 = 0.005;

const LINZ: &str = "city/linz_center_r700m_with_ground.glb";
const ROTTERDAM: &str = "city/rotterdam_center_r900m.glb";
const HOSPITAL: &str = "indoor/hospital_three_floors.glb";
const HOSPITAL_INSTANCED: &str = "indoor/hospital_three_floors_gpuinst.glb";
const QUAKE: &str = "indoor/lq_e1m1.glb";

/// Scenes with animations, morph targets, skins, mirrored instances and sparse accessors.
const ANIMATED: [&str; 12] = [
    "animated/AnimatedMorphCube/glTF-Binary/AnimatedMorphCube.glb",
    "animated/AnimatedMorphCube/glTF-Quantized/AnimatedMorphCube.gltf",
    "animated/BoxAnimated/glTF-Binary/BoxAnimated.glb",
    "animated/Fox/glTF-Binary/Fox.glb",
    "animated/InterpolationTest/glTF-Binary/InterpolationTest.glb",
    "animated/MeshPrimitiveModes/glTF/MeshPrimitiveModes.gltf",
    "animated/NegativeScaleTest/glTF-Binary/NegativeScaleTest.glb",
    "animated/RecursiveSkeletons/glTF-Binary/RecursiveSkeletons.glb",
    "animated/SimpleInstancing/glTF-Binary/SimpleInstancing.glb",
    "animated/SimpleMorph/glTF/SimpleMorph.gltf",
    "animated/SimpleSkin/glTF/SimpleSkin.gltf",
    "animated/SimpleSparseAccessor/glTF/SimpleSparseAccessor.gltf",
];

/// A building of Linz of 14 m, 20 m beyond the western edge of the region that is baked before and after
/// it moves.
const MOVED: &str = "ID_50816";

/// A room on the lowest floor, below its ceiling.
const WARD: [&str; 4] =
    ["--region=-6,-2,0,2", "--cell-size=2", "--heights=absolute", "--eye-height=1.5,1.8"];

/// Bakes are large; one at a time keeps memory and time predictable.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

fn alone<R>(work: impl FnOnce() -> R) -> R {
    // A test that failed has released whatever it held.
    let _turn = ONE_AT_A_TIME.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    work()
}

/// Bakes a scene into an empty folder. Returns the folder and what the bake said.
fn bake(name: &str, scene: &Path, flags: &[&str]) -> (PathBuf, Value) {
    let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join("scenes").join(name);
    // Left over from the last run of the tests, or not there.
    let _ = std::fs::remove_dir_all(&out);
    let mut command = sightline(["bake", "--json", "--out"]);
    let ended = process::run(command.arg(&out).args(flags).arg(scene), LIMIT).success();
    (out, ended.json())
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is a number"))
}

/// The ward of the hospital, baked once. Call it alone.
fn ward(scene: &Path) -> &'static (PathBuf, Value) {
    static WARD_BAKED: OnceLock<(PathBuf, Value)> = OnceLock::new();
    WARD_BAKED.get_or_init(|| bake("hospital", scene, &WARD))
}

/// Verifies a dataset; there have to be `cells` cells at least.
fn assert_promise((out, summary): &(PathBuf, Value), cells: f64) {
    assert!(number(&summary["cells"]) >= cells, "too few cells: {summary:#}");
    let mut verify: Command = sightline(["verify", "--viewpoints=2", "--rays=20000", "--json"]);
    let found = process::run(verify.arg(out), LIMIT).success().json();
    let (mean, worst) = (number(&found["error_mean"]), number(&found["error_max"]));
    assert!(mean <= MEAN_MAX && worst <= WORST_MAX, "{found:#}");
}

#[test]
fn a_street_of_linz_keeps_its_promise() {
    let test = "a_street_of_linz_keeps_its_promise";
    let Some(scene) = scenes::shared(test, LINZ) else { return };
    let flags = ["--region=-40,-40,-10,-10", "--ground=ground_derived*"];
    alone(|| assert_promise(&bake("linz", &scene, &flags), 9.0));
}

#[test]
fn rotterdam_without_ground_keeps_its_promise() {
    let test = "rotterdam_without_ground_keeps_its_promise";
    let Some(scene) = scenes::shared(test, ROTTERDAM) else { return };
    let flags = ["--region=-40,-40,-10,-10", "--heights=absolute"];
    alone(|| {
        let baked = bake("rotterdam", &scene, &flags);
        assert_promise(&baked, 8.0);
        assert_eq!(baked.1["skipped"]["inside a solid"], 1, "one tile is in a house");
    });
}

#[test]
fn a_hospital_ward_keeps_its_promise() {
    let test = "a_hospital_ward_keeps_its_promise";
    let Some(scene) = scenes::shared(test, HOSPITAL) else { return };
    alone(|| assert_promise(ward(&scene), 6.0));
}

#[test]
fn a_game_level_keeps_its_promise() {
    let test = "a_game_level_keeps_its_promise";
    let Some(scene) = scenes::shared(test, QUAKE) else { return };
    let flags = ["--region=0,-5,10,0", "--cell-size=2.5", "--ground-from=6"];
    alone(|| assert_promise(&bake("quake", &scene, &flags), 8.0));
}

/// The middle of a scene's box, and the largest of its sides, metres.
fn middle_and_size(scene: &Path) -> (DVec3, f64) {
    let told = process::run(sightline(["info", "--json"]).arg(scene), LIMIT).success().json();
    let corner = |name: &str| {
        let at = &told["bounds"][name];
        DVec3::new(number(&at[0]), number(&at[1]), number(&at[2]))
    };
    let (min, max) = (corner("min"), corner("max"));
    (0.5 * (min + max), (max - min).max_element())
}

#[test]
fn what_moves_keeps_its_promise_at_all_times() {
    let test = "what_moves_keeps_its_promise_at_all_times";
    for path in ANIMATED {
        let Some(scene) = scenes::shared(test, path) else { return };
        let (middle, size) = middle_and_size(&scene);
        // Two cells: one that the scene is in, one beside it.
        let region = [
            middle.x - 0.25 * size,
            middle.z - 0.25 * size,
            middle.x + 0.75 * size,
            middle.z + 0.25 * size,
        ];
        let [x0, z0, x1, z1] = region;
        let height = |part: f64| middle.y + part * size;
        let flags = [
            format!("--region={x0},{z0},{x1},{z1}"),
            format!("--cell-size={}", 0.5 * size),
            "--heights=absolute".to_owned(),
            format!("--eye-height={},{}", height(-0.05), height(0.05)),
        ];
        let flags = flags.each_ref().map(String::as_str);
        let name = Path::new(path).file_stem().expect("a scene has a name").to_string_lossy();
        alone(|| assert_promise(&bake(&name, &scene, &flags), 1.0));
    }
}

/// A scene and the rows of its dataset.
struct Baked {
    scene: Scene,
    rows: Vec<CellRow>,
}

impl Baked {
    fn open(scene: &Path, dataset: &Path) -> Self {
        let scene = Scene::open(scene, &OpenOptions::default()).expect("the scene opens");
        let runtime = tokio::runtime::Runtime::new().expect("a runtime starts");
        let rows = runtime.block_on(async {
            let store = BakeStore::open(&dataset.display().to_string()).expect("the store opens");
            let dataset = Dataset::open(&store).await.expect("the dataset opens");
            let mut rows = Vec::new();
            for entry in dataset.cells() {
                rows.push(dataset.cell(entry.cell.id).await.expect("a cell can be read"));
            }
            rows
        });
        Self { scene, rows }
    }

    /// True when the middle of a triangle lies on another one, up to the rounding of the files.
    /// Which of the two is seen hangs on the last bit of their heights, and the files differ there.
    fn ties(&self, triangle: &[DVec3; 3]) -> bool {
        let [p, q, r] = *triangle;
        let middle = (p + q + r) / 3.0;
        let geometry = &self.scene.geometry;
        let own = key(triangle);
        let lies_on = |t: u32| {
            let corners = geometry.triangle(PrimitiveId(t)).corners;
            let [a, b, c] = corners;
            let normal = (b - a).cross(c - a).normalize_or_zero();
            let inside = |p: DVec3, q: DVec3| (q - p).cross(middle - p).dot(normal) >= 0.0;
            normal != DVec3::ZERO
                && normal.dot(middle - a).abs() <= ROUNDING
                && inside(a, b)
                && inside(b, c)
                && inside(c, a)
                && key(&sorted(corners)) != own
        };
        (0..geometry.primitive_count()).any(lies_on)
    }

    /// World-space corners of the visible triangles of a cell, in an order that does not depend
    /// on the numbering.
    fn visible(&self, cell: CellId) -> Vec<[DVec3; 3]> {
        let row = self.rows.iter().find(|r| r.cell.id == cell).expect("the cell is there");
        row.set.iter().map(|p| sorted(self.scene.geometry.triangle(p).corners)).collect()
    }
}

/// Positions of the two files differ by at most this, metres.
const ROUNDING: f64 = 1e-4;

fn sorted(mut corners: [DVec3; 3]) -> [DVec3; 3] {
    corners.sort_by(|a, b| {
        a.to_array().map(tenth_millimetres).cmp(&b.to_array().map(tenth_millimetres))
    });
    corners
}

fn tenth_millimetres(metres: f64) -> i64 {
    (metres * 1e4).round() as i64
}

type Key = [[i64; 3]; 3];

fn key(triangle: &[DVec3; 3]) -> Key {
    triangle.map(|p| p.to_array().map(tenth_millimetres))
}

/// Triangles of `a` without a partner in `b`: the same triangle up to rounding at 10^-4 m.
fn without_partner(a: &[[DVec3; 3]], b: &[[DVec3; 3]]) -> Vec<[DVec3; 3]> {
    let mut partners: BTreeMap<Key, u32> = BTreeMap::new();
    for triangle in b {
        *partners.entry(key(triangle)).or_default() += 1;
    }
    let mut left = Vec::new();
    for triangle in a {
        match partners.get_mut(&key(triangle)) {
            Some(count) if *count > 0 => *count -= 1,
            _ => left.push(*triangle),
        }
    }
    // What sits on a rounding border: look at the corners themselves.
    let is_close = |p: &[DVec3; 3], q: &[DVec3; 3]| {
        p.iter().all(|x| q.iter().any(|y| (*x - *y).abs().max_element() <= ROUNDING))
    };
    left.retain(|p| !b.iter().any(|q| is_close(p, q)));
    left
}

#[test]
fn hospital_and_its_gpu_instanced_twin_see_the_same_triangles() {
    let test = "hospital_and_its_gpu_instanced_twin_see_the_same_triangles";
    let (Some(plain), Some(twin)) =
        (scenes::shared(test, HOSPITAL), scenes::shared(test, HOSPITAL_INSTANCED))
    else {
        return;
    };
    let (a, b) = alone(|| {
        let (a, _) = ward(&plain);
        let (b, _) = bake("hospital-gpuinst", &twin, &WARD);
        (Baked::open(&plain, a), Baked::open(&twin, &b))
    });
    let boxes = |x: &Baked| x.rows.iter().map(|r| r.cell.clone()).collect::<Vec<_>>();
    assert_eq!(boxes(&a), boxes(&b), "the same cells");
    let mut differences = Vec::new();
    for row in &a.rows {
        let (x, y) = (a.visible(row.cell.id), b.visible(row.cell.id));
        let (mut only_plain, mut only_twin) = (without_partner(&x, &y), without_partner(&y, &x));
        only_plain.retain(|t| !a.ties(t));
        only_twin.retain(|t| !b.ties(t));
        if !only_plain.is_empty() || !only_twin.is_empty() {
            differences.push(format!(
                "cell {}: {} and {} visible; {} only in the plain scene, {} only in its twin: {:?} {:?}",
                row.cell.id,
                x.len(),
                y.len(),
                only_plain.len(),
                only_twin.len(),
                only_plain.first(),
                only_twin.first(),
            ));
        }
    }
    let cells = a.rows.len();
    assert!(
        differences.is_empty(),
        "{} of {cells} cells differ: {differences:#?}",
        differences.len()
    );
}

#[test]
fn a_moved_building_of_linz_costs_the_cells_that_see_it() {
    let test = "a_moved_building_of_linz_costs_the_cells_that_see_it";
    let Some(scene) = scenes::shared(test, LINZ) else { return };
    let flags = ["--region=-100,-100,0,0", "--ground=ground_derived*"];
    alone(|| {
        let (over, before) = bake("linz_edited", &scene, &flags);
        let moved = over.with_file_name("linz_moved.glb");
        glb::move_node(&scene, &moved, glb::node_named(&scene, MOVED), [3.0, 0.0, 0.0]);
        let mut again = sightline(["bake", "--json", "--out"]);
        let again = process::run(again.arg(&over).args(flags).arg(&moved), LIMIT).success().json();
        let (cells, reused) = (number(&before["cells"]), number(&again["cells_reused"]));
        assert!(cells >= 100.0 && reused < cells, "some cell sees it: {again:#}");
        assert!(cells - reused < 0.2 * cells, "{again:#}");
        let (scratch, _) = bake("linz_scratch", &moved, &flags);
        dataset::assert_same_published(&scratch, &over);
    });
}
