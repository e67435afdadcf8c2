//! What a memory limit promises: the same scene, whatever is loaded, and a refusal where it cannot be kept.

mod fixtures;

use std::path::{Path, PathBuf};

use fixtures::{Fixture, odds_and_ends, world_triangles};
use proptest::prelude::*;
use serde_json::json;
use sightline_geometry::{
    CellId, Moment, Ray, Residency, ViewCell, overlap::primitives_in_cell_over, raycast::RayCaster,
};
use sightline_scene::{Cause, MemoryLimit, OpenOptions, Scene, generate};

/// A folder for chunk files.
fn folder() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

/// A limit far below what this process has anyway: whatever is loaded is given back at every look.
fn tiny(folder: &Path) -> OpenOptions {
    let mut options = OpenOptions::default();
    options.memory =
        Some(MemoryLimit { strict: false, ..MemoryLimit::new(1 << 20, folder.into()) });
    options
}

fn chunk_files(folder: &Path) -> Vec<PathBuf> {
    std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect()
}

/// Panics unless both scenes are the same in all that can be read of them.
fn assert_same(limited: &Scene, whole: &Scene) {
    limited.assert_well_formed();
    assert_eq!(limited.digest, whole.digest);
    assert_eq!(limited.report, whole.report);
    assert_eq!(limited.objects, whole.objects);
    assert_eq!(limited.meshes, whole.meshes);
    assert_eq!(limited.instances, whole.instances);
    assert_eq!(limited.key_times, whole.key_times);
    assert_eq!(world_triangles(limited), world_triangles(whole));
    for (a, b) in limited.geometry.meshes.iter().zip(&whole.geometry.meshes) {
        assert_eq!((&a.positions, &a.triangles), (&b.positions, &b.triangles));
        assert_eq!(
            (&a.hierarchy.nodes, a.hierarchy.depth),
            (&b.hierarchy.nodes, b.hierarchy.depth)
        );
        assert_eq!((a.bounds, a.motion.is_some()), (b.bounds, b.motion.is_some()));
    }
}

/// Opens a scene without and with a limit, the latter twice: making the chunk file and finding it.
fn assert_limit_changes_nothing(path: &Path) -> Scene {
    let folder = folder();
    let whole = Scene::open(path, &OpenOptions::default()).unwrap();
    assert!(whole.memory.is_none() && whole.geometry.residency.is_none());
    for _ in 0..2 {
        let limited = Scene::open(path, &tiny(folder.path())).unwrap();
        assert_same(&limited, &whole);
        assert_eq!(chunk_files(folder.path()).len(), 1);
    }
    Scene::open(path, &tiny(folder.path())).unwrap()
}

#[test]
fn a_limit_changes_nothing_that_can_be_read() {
    let folder = folder();
    let glb = folder.path().join("odd.glb");
    std::fs::write(&glb, odds_and_ends().glb()).unwrap();
    let scene = assert_limit_changes_nothing(&glb);
    assert!(scene.report.degenerate_triangles > 2 && scene.report.flattened_instances == 2);
    let moves = |scene: &Scene| scene.geometry.meshes.iter().filter(|m| m.motion.is_some()).count();
    assert_eq!(moves(&scene), 1, "one body moves and is no part of the chunks");
    let gltf = folder.path().join("odd.gltf");
    std::fs::write(&gltf, odds_and_ends().gltf()).unwrap();
    assert_limit_changes_nothing(&gltf);
    // An external buffer.
    let mut fixture = odds_and_ends();
    fixture.json["buffers"] = json!([{"byteLength": fixture.buffer.len(), "uri": "odd.bin"}]);
    std::fs::write(folder.path().join("odd.bin"), &fixture.buffer).unwrap();
    let external = folder.path().join("external.gltf");
    std::fs::write(&external, serde_json::to_vec(&fixture.json).unwrap()).unwrap();
    assert_limit_changes_nothing(&external);
    assert_eq!(
        sightline_scene::digest(&external).unwrap(),
        Scene::open(&external, &OpenOptions::default()).unwrap().digest
    );
}

#[test]
fn a_limit_changes_no_generated_scene() {
    let folder = folder();
    for (kind, name) in
        [(generate::Kind::City, "city"), (generate::Kind::SwayingGrass { states: 2 }, "grass")]
    {
        let path = folder.path().join(format!("{name}.glb"));
        let mut file = std::fs::File::create(&path).unwrap();
        generate::generate(kind, 20_000, 5, &mut file).unwrap();
        let scene = assert_limit_changes_nothing(&path);
        let held = scene.memory.as_ref().unwrap().held();
        assert_eq!(held.chunks, held.bytes.div_ceil(2 << 20));
    }
}

#[test]
fn to_open_a_scene_again_loads_nothing_of_its_chunks() {
    let folder = folder();
    let path = folder.path().join("city.glb");
    let mut file = std::fs::File::create(&path).unwrap();
    generate::generate(generate::Kind::City, 100_000, 5, &mut file).unwrap();
    let mut options = tiny(folder.path());
    drop(Scene::open(&path, &options).unwrap());
    options.memory = Some(MemoryLimit::new(1 << 40, folder.path().into()));
    let scene = Scene::open(&path, &options).unwrap();
    let keeper = scene.memory.as_ref().unwrap();
    // The header and the directory at the end are read.
    assert!(keeper.held().chunks >= 3 && keeper.held().touched <= 2, "{:?}", keeper.held());
    let before = keeper.held();
    assert_eq!(world_triangles(&scene).len(), scene.geometry.primitive_count() as usize);
    assert!(keeper.held().touched > before.touched);
    assert_eq!(keeper.held().given_back, 0);
}

#[test]
fn a_scene_that_cannot_fit_is_refused() {
    let folder = folder();
    let path = folder.path().join("odd.glb");
    std::fs::write(&path, odds_and_ends().glb()).unwrap();
    let mut options = OpenOptions::default();
    options.memory = Some(MemoryLimit::new(1 << 20, folder.path().into()));
    let error = Scene::open(&path, &options).unwrap_err();
    assert!(matches!(*error.cause, Cause::OutOfMemory { limit: 1_048_576, .. }), "{error}");
    assert!(error.to_string().contains("1.0 MiB"), "{error}");
    assert!(error.help().is_some());
}

#[test]
fn a_damaged_chunk_file_is_made_again_and_said_so() {
    let folder = folder();
    let path = folder.path().join("odd.glb");
    std::fs::write(&path, odds_and_ends().glb()).unwrap();
    let chunks = folder.path().join("chunks");
    let whole = Scene::open(&path, &tiny(&chunks)).unwrap();
    let file = chunk_files(&chunks).remove(0);
    let mut bytes = std::fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    drop(whole);
    std::fs::write(&file, &bytes).unwrap();
    let scene = Scene::open(&path, &tiny(&chunks)).unwrap();
    let says = |scene: &Scene| {
        scene.report.warnings.iter().any(|w| w.contains(&file.display().to_string()))
    };
    assert!(says(&scene), "{:?}", scene.report.warnings);
    assert!(!says(&Scene::open(&path, &tiny(&chunks)).unwrap()));
}

#[test]
fn the_choice_of_animation_has_a_chunk_file_of_its_own() {
    let folder = folder();
    let path = folder.path().join("odd.glb");
    std::fs::write(&path, odds_and_ends().glb()).unwrap();
    let chunks = folder.path().join("chunks");
    let moving = Scene::open(&path, &tiny(&chunks)).unwrap();
    let mut options = tiny(&chunks);
    options.animation = sightline_scene::AnimationChoice::None;
    let resting = Scene::open(&path, &options).unwrap();
    assert!(moving.geometry.has_motion() && !resting.geometry.has_motion());
    assert_eq!(chunk_files(&chunks).len(), 2);
}

#[test]
fn the_golden_chunk_file_is_made_and_read() {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../schemas/golden/chunks-v1");
    let scene = golden.join("scene.glb");
    assert_eq!(std::fs::read(&scene).unwrap(), odds_and_ends().glb(), "the scene of this test");
    let stored = chunk_files(&golden).into_iter().find(|f| f.extension().unwrap() == "chunks");
    let stored = stored.expect("it is there");
    let made = folder();
    let _ = Scene::open(&scene, &tiny(made.path())).unwrap();
    let file = chunk_files(made.path()).remove(0);
    assert_eq!(file.file_name(), stored.file_name());
    assert_eq!(std::fs::read(&file).unwrap(), std::fs::read(&stored).unwrap());
    let found = folder();
    let copy = found.path().join(stored.file_name().unwrap());
    std::fs::copy(&stored, &copy).unwrap();
    let read = Scene::open(&scene, &tiny(found.path())).unwrap();
    let made_again = read.report.warnings.iter().any(|w| w.contains(&copy.display().to_string()));
    assert!(!made_again, "it was read, not made: {:?}", read.report.warnings);
    assert_same(&read, &Scene::open(&scene, &OpenOptions::default()).unwrap());
}

/// Triangles of all sizes, in meshes that are placed several times, some see-through.
fn soup() -> impl Strategy<Value = Fixture> {
    let corner = prop::array::uniform3(-1.0f32..1.0);
    let triangle = (prop::array::uniform3(-4.0f32..4.0), prop::array::uniform3(corner));
    let mesh = prop::collection::vec(triangle, 1..60);
    prop::collection::vec((mesh, 1..4u8, any::<bool>()), 1..5).prop_map(|meshes| {
        let mut f = Fixture::new();
        for (m, (triangles, places, glass)) in meshes.into_iter().enumerate() {
            let corners: Vec<[f32; 3]> = triangles
                .iter()
                .flat_map(|(at, by)| by.map(|b| [0, 1, 2].map(|k| at[k] + b[k])))
                .collect();
            let positions = f.floats(&corners);
            let mesh = f.mesh(json!({"attributes": {"POSITION": positions}}));
            let name = if glass { "glass" } else { "wall" };
            for place in 0..places {
                let at = [m as f32 - 2.0, 0.5 * f32::from(place), f32::from(place) - 6.0];
                f.root(json!({"name": name, "mesh": mesh, "translation": at}));
            }
        }
        f
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn rays_and_cells_find_the_same_whatever_is_given_back(
        soup in soup(),
        rays in prop::collection::vec(prop::array::uniform3(-1.0f64..1.0), 1..40),
    ) {
        let folder = folder();
        let open = |mut options: OpenOptions| {
            options.see_through = vec!["glass".into()];
            Scene::open_bytes("soup.glb".as_ref(), &soup.glb(), &options).unwrap()
        };
        let (whole, limited) = (open(OpenOptions::default()), open(tiny(folder.path())));
        let keeper = limited.memory.clone().unwrap();
        let mut caster = RayCaster::new();
        for d in rays {
            let ray = Ray::new(glam::DVec3::new(0.1, 0.2, 0.3), glam::DVec3::from_array(d));
            let mut seen = |scene: &Scene| {
                let nearest =
                    caster.closest_occluder(&scene.geometry, ray, f64::INFINITY, |_| true);
                let mut through = vec![];
                caster.see_through(&scene.geometry, ray, f64::INFINITY, |hit| through.push(hit));
                (nearest, through)
            };
            let found = seen(&limited);
            keeper.look();
            prop_assert_eq!(found, seen(&whole));
        }
        let corners = [[-2.0, -1.0], [2.0, -1.0], [2.0, 3.0], [-2.0, 3.0]]
            .map(|[x, z]| glam::DVec3::new(x, -1.0, z));
        let cell = ViewCell { id: CellId(0), corners, height: 2.0 };
        let inside = |scene: &Scene| primitives_in_cell_over(&scene.geometry, &cell, 0..1);
        prop_assert_eq!(inside(&limited), inside(&whole));
        for p in 0..whole.geometry.primitive_count() {
            let shape = |scene: &Scene| {
                scene.geometry.shape(sightline_geometry::PrimitiveId(p), Moment::START)
            };
            prop_assert_eq!(shape(&limited), shape(&whole));
        }
        prop_assert!(keeper.held().given_back > 0);
    }
}
