//! What an export promises: the visible triangles and no others, with attributes, materials, names
//! and hierarchy, in files that the Khronos validator accepts.

mod fixtures;

use std::path::{Path, PathBuf};

use fixtures::{
    Corners, Fixture, assert_same_triangles, assert_valid, files_below, open, scenes,
    world_triangles,
};
use serde_json::{Value, json};
use sightline_geometry::{Moment, PrimitiveId, PrimitiveSet, Run};
use sightline_scene::Scene;
use sightline_scene::export::{
    ExportError, ExportOptions, ExportReport, export_visible, export_visible_with,
};
use sightline_scene::generate::{Kind, generate};

fn all(scene: &Scene) -> PrimitiveSet {
    PrimitiveSet::from_sorted(0..scene.geometry.primitive_count())
}

/// About half of the primitives: runs of changing length.
fn some(scene: &Scene) -> PrimitiveSet {
    let mut set = PrimitiveSet::default();
    let (mut at, mut step) = (0, 1);
    while at < scene.geometry.primitive_count() {
        let end = (at + step).min(scene.geometry.primitive_count());
        set.push(Run { first: at, end });
        at = end + step % 5 + 1;
        step = step * 7 % 23 + 1;
    }
    set
}

/// The exported scene has the triangles of the set, up to the rounding of transforms: JSON
/// numbers are read to within one unit in the last place.
fn assert_exports_exactly(scene: &Scene, set: &PrimitiveSet, exported: &Scene) {
    assert_exports_at(Moment::START, scene, set, exported);
}

/// As [`assert_exports_exactly`], at a moment. What an animation or a skin places has positions of
/// its own, rounded to `f32`.
fn assert_exports_at(moment: Moment, scene: &Scene, set: &PrimitiveSet, exported: &Scene) {
    assert!(!exported.geometry.has_motion());
    assert_eq!(u64::from(exported.geometry.primitive_count()), set.len());
    let wanted: Vec<Corners> = set
        .iter()
        .map(|p: PrimitiveId| scene.geometry.triangle_at(p, moment).corners.map(|c| c.to_array()))
        .collect();
    let largest = wanted.as_flattened().as_flattened().iter().fold(1.0, |m: f64, v| m.max(v.abs()));
    let rounding = if scene.instances.iter().any(|i| i.posed) { 1e-6 } else { 1e-12 };
    assert_same_triangles(&wanted, &world_triangles(exported), rounding * largest);
}

/// A source on disk, opened, and a folder for the export.
struct Workplace {
    folder: tempfile::TempDir,
    source: PathBuf,
    scene: Scene,
}

impl Workplace {
    fn new(name: &str, bytes: &[u8]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let source = folder.path().join(name);
        std::fs::write(&source, bytes).unwrap();
        let scene = open(&source).unwrap();
        Self { folder, source, scene }
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("visible.glb")
    }

    fn export(&self, set: &PrimitiveSet) -> (ExportReport, Scene, Value) {
        let out = self.out();
        let report = export_visible(&self.source, &self.scene, set, &out).unwrap();
        assert_eq!(report.bytes, std::fs::metadata(&out).unwrap().len());
        assert_valid(&[&out]);
        let json = json_of(&out);
        (report, open(&out).unwrap(), json)
    }
}

fn json_of(glb: &Path) -> Value {
    let bytes = std::fs::read(glb).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&bytes[20..20 + length]).unwrap()
}

#[test]
fn generated_scenes_come_back_in_whole_and_in_part() {
    for (kind, n) in [(Kind::City, 60_000), (Kind::Town, 60_000), (Kind::Grass, 60_000)] {
        let mut bytes = vec![];
        generate(kind, n, 1, &mut bytes).unwrap();
        let place = Workplace::new("scene.glb", &bytes);
        for set in [all(&place.scene), some(&place.scene)] {
            let (report, exported, _) = place.export(&set);
            assert_exports_exactly(&place.scene, &set, &exported);
            assert_eq!(report.triangles, set.len());
            assert_eq!(report.unique_triangles, exported.geometry.unique_triangle_count() as u64);
            assert_eq!(report.warnings, [""; 0]);
        }
    }
}

#[test]
fn a_whole_scene_keeps_its_objects_and_its_size() {
    let mut bytes = vec![];
    generate(Kind::City, 60_000, 1, &mut bytes).unwrap();
    let place = Workplace::new("scene.glb", &bytes);
    let (report, exported, json) = place.export(&all(&place.scene));
    let paths = |s: &Scene| {
        let mut paths: Vec<String> = s.objects.iter().map(|o| o.path.clone()).collect();
        paths.sort();
        paths
    };
    assert_eq!(paths(&place.scene), paths(&exported));
    let source = json_of(&place.source);
    assert_eq!(json["materials"], source["materials"]);
    assert_eq!(
        json["meshes"].as_array().unwrap().len(),
        source["meshes"].as_array().unwrap().len()
    );
    // Shared positions are cut by part, so that some vertices are written twice.
    assert!(report.bytes < 2 * bytes.len() as u64, "{} of {}", report.bytes, bytes.len());
}

#[test]
fn instances_that_show_the_same_share_a_mesh() {
    let mut bytes = vec![];
    generate(Kind::Grass, 200_000, 1, &mut bytes).unwrap();
    let place = Workplace::new("scene.glb", &bytes);
    let (_, exported, _) = place.export(&all(&place.scene));
    assert_eq!(
        exported.geometry.unique_triangle_count(),
        place.scene.geometry.unique_triangle_count()
    );
    // One instance shows one triangle only: it gets a child and a mesh of its own.
    let instanced = place.scene.instances.iter().position(|i| i.gpu_instance.is_some()).unwrap();
    let range =
        place.scene.geometry.primitives_of(sightline_geometry::InstanceId(instanced as u32));
    let set = PrimitiveSet::from_sorted(
        (0..place.scene.geometry.primitive_count())
            .filter(|p| !range.contains(p) || *p == range.start),
    );
    let (_, exported, json) = place.export(&set);
    assert_exports_exactly(&place.scene, &set, &exported);
    assert_eq!(
        exported.geometry.unique_triangle_count(),
        place.scene.geometry.unique_triangle_count() + 1
    );
    assert_eq!(json["extensionsRequired"], json!(["EXT_mesh_gpu_instancing"]));
}

#[test]
fn the_same_set_gives_the_same_bytes() {
    let place = Workplace::new("scene.glb", &Fixture::square().glb());
    let set = all(&place.scene);
    place.export(&set);
    let first = std::fs::read(place.out()).unwrap();
    place.export(&set);
    assert!(first == std::fs::read(place.out()).unwrap());
}

/// The smallest PNG file: one pixel.
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x01\0\0\0\x01\x08\0\0\0\0\x3a\x7e\x9b\x55\
\0\0\0\nIDATx\x9cc`\0\0\0\x02\0\x01\x48\xaf\xa4\x71\0\0\0\0IEND\xae\x42\x60\x82";

/// A square and a triangle with textures, extras, a camera, a light and unused things.
fn rich() -> Fixture {
    let mut f = Fixture::new();
    let positions = f.floats(&[
        [9.0, 9.0, 9.0],
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [1.0, 1.0, 0.0],
        [0.0, 1.0, 0.0],
    ]);
    f.json["accessors"][positions as usize]["min"] = json!([0.0, 0.0, 0.0]);
    f.json["accessors"][positions as usize]["max"] = json!([9.0, 9.0, 9.0]);
    let normals = f.floats(&[[0.0, 0.0, 1.0]; 5]);
    let uv = f.floats(&[[0.5, 0.5], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]);
    let colors = f.accessor(&(0..20).map(|k| k * 12).collect::<Vec<u8>>(), 5121, "VEC4", 5);
    f.json["accessors"][colors as usize]["normalized"] = json!(true);
    let indices = f.indices(&[1, 2, 3, 1, 3, 4]);
    let attributes = json!({
        "POSITION": positions, "NORMAL": normals, "TEXCOORD_0": uv, "COLOR_0": colors,
    });
    let strip = f.indices(&[1, 2, 4, 3]);
    f.json["meshes"] = json!([
        {"primitives": [{"attributes": attributes}], "name": "unused"},
        {"primitives": [
            {"attributes": attributes, "indices": indices, "material": 2, "extras": {"part": 1}},
            {"attributes": attributes, "indices": strip, "mode": 5, "material": 1},
        ], "name": "panel", "extras": {"maker": "x"}},
    ]);
    f.json["materials"] = json!([
        {"name": "unused", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}},
        {"name": "lost", "pbrMetallicRoughness": {"baseColorTexture": {"index": 1}},
         "emissiveTexture": {"index": 2}},
        {"name": "found", "pbrMetallicRoughness": {"baseColorTexture": {"index": 2}},
         "normalTexture": {"index": 3}},
    ]);
    f.json["textures"] =
        json!([{"source": 0}, {"source": 1}, {"source": 2, "sampler": 1}, {"source": 3}]);
    f.json["samplers"] = json!([{}, {"wrapS": 33071, "name": "clamp"}]);
    let view = f.view(PNG);
    use base64::Engine;
    let data = base64::engine::general_purpose::STANDARD.encode(PNG);
    f.json["images"] = json!([
        {"uri": "unused.png"},
        {"uri": "missing.png"},
        {"uri": format!("data:image/png;base64,{data}"), "name": "pixel"},
        {"bufferView": view, "mimeType": "image/png"},
    ]);
    f.json["cameras"] =
        json!([{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]);
    f.json["extensionsUsed"] = json!(["KHR_lights_punctual"]);
    f.json["extensions"] = json!({"KHR_lights_punctual": {"lights": [{"type": "point"}]}});
    f.json["nodes"] = json!([
        {"name": "empty"},
        {"name": "left", "mesh": 1, "translation": [1.0, 2.0, 3.0], "extras": {"tag": [1, 2]}},
        {"name": "house", "children": [0, 1, 3], "rotation": [0.0, 0.6, 0.0, 0.8]},
        {"name": "right", "mesh": 1, "scale": [2.0, 2.0, 2.0]},
        {"name": "eye", "camera": 0},
        {"name": "lamp", "extensions": {"KHR_lights_punctual": {"light": 0}}},
        {"name": "nowhere", "children": []},
    ]);
    f.json["nodes"][6].as_object_mut().unwrap().remove("children");
    f.json["scenes"] = json!([{"nodes": [2, 4, 5, 6], "name": "yard"}]);
    f.json["extras"] = json!({"project": "p"});
    f
}

#[test]
fn names_hierarchy_materials_and_images_are_kept_and_what_is_unused_is_not() {
    let place = Workplace::new("rich.gltf", &rich().gltf());
    let set = all(&place.scene);
    let (report, exported, json) = place.export(&set);
    assert_exports_exactly(&place.scene, &set, &exported);
    let names = |list: &str| -> Vec<&str> {
        json[list].as_array().unwrap().iter().map(|v| v["name"].as_str().unwrap_or("")).collect()
    };
    assert_eq!(names("nodes"), ["left", "house", "right", "eye", "lamp"]);
    assert_eq!(json["nodes"][1]["children"], json!([0, 2]));
    assert_eq!(json["nodes"][0]["extras"], json!({"tag": [1, 2]}));
    assert_eq!(json["nodes"][0]["translation"], json!([1.0, 2.0, 3.0]));
    assert_eq!(json["scenes"], json!([{"name": "yard", "nodes": [1, 3, 4]}]));
    assert_eq!(names("meshes"), ["panel"]);
    assert_eq!(json["meshes"][0]["primitives"][0]["extras"], json!({"part": 1}));
    assert_eq!(names("materials"), ["lost", "found"]);
    assert_eq!(json["materials"][0].get("pbrMetallicRoughness"), Some(&json!({})));
    assert_eq!(json["materials"][1]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 0);
    assert_eq!(json["textures"], json!([{"source": 0, "sampler": 0}, {"source": 1}]));
    assert_eq!(names("samplers"), ["clamp"]);
    assert_eq!(names("images"), ["pixel", ""]);
    assert!(json["images"].as_array().unwrap().iter().all(|i| i.get("uri").is_none()));
    assert_eq!(json["extensionsUsed"], json!(["KHR_lights_punctual"]));
    assert_eq!(json["extras"], json!({"project": "p"}));
    assert_eq!((report.nodes, report.meshes, report.materials, report.images), (5, 1, 2, 2));
    assert_eq!(report.warnings.len(), 2, "{:?}", report.warnings);
    assert!(report.warnings[1].contains("missing.png"), "{:?}", report.warnings);
}

#[test]
fn attributes_keep_their_values_and_component_types() {
    let place = Workplace::new("rich.glb", &rich().glb());
    // The second triangle of the first primitive, wherever it is in the numbering.
    let visible = (0..place.scene.geometry.primitive_count()).filter(|&p| {
        let (instance, local) = place.scene.geometry.locate(PrimitiveId(p));
        let source = place.scene.instances[instance.index()];
        let mesh = place.scene.geometry.instances[instance.index()].mesh;
        let triangle = place.scene.meshes[mesh.index()].triangles[local];
        (source.node, source.primitive, triangle) == (1, 0, 1)
    });
    let (_, exported, json) = place.export(&PrimitiveSet::from_sorted(visible));
    assert_eq!(exported.geometry.primitive_count(), 1);
    let bytes = std::fs::read(place.out()).unwrap();
    let binary = 28 + u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let attributes = &json["meshes"][0]["primitives"][0]["attributes"];
    let elements = |name: &str, size: usize| -> (Value, Vec<Vec<u8>>) {
        let accessor = &json["accessors"][attributes[name].as_u64().unwrap() as usize];
        let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let at = |v: &Value| v.as_u64().unwrap() as usize;
        let start = binary + at(&view["byteOffset"]) + at(&accessor["byteOffset"]);
        let stride = at(&view["byteStride"]);
        let rows = (0..at(&accessor["count"]))
            .map(|i| bytes[start + i * stride..][..size].to_vec())
            .collect();
        (accessor.clone(), rows)
    };
    // Vertices 1, 3 and 4 of the source.
    let (accessor, colors) = elements("COLOR_0", 4);
    assert_eq!((&accessor["componentType"], &accessor["normalized"]), (&json!(5121), &json!(true)));
    assert_eq!(colors, [[48, 60, 72, 84], [144, 156, 168, 180], [192, 204, 216, 228]]);
    let (_, uv) = elements("TEXCOORD_0", 8);
    let floats = |row: &Vec<u8>| -> Vec<f32> {
        row.chunks(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
    };
    assert_eq!(uv.iter().map(floats).collect::<Vec<_>>(), [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]);
    assert_eq!(elements("NORMAL", 12).1.len(), 3);
    assert_eq!(elements("POSITION", 12).0["max"], json!([1.0, 1.0, 0.0]));
}

#[test]
fn nodes_without_anything_visible_are_dropped() {
    let place = Workplace::new("rich.glb", &rich().glb());
    let object = place.scene.objects.iter().find(|o| o.name == "right").unwrap();
    let set = PrimitiveSet::from_sorted(object.primitives.clone());
    let (_, exported, json) = place.export(&set);
    assert_eq!(exported.objects.len(), 1);
    assert_eq!(exported.objects[0].path, "house/right");
    let names: Vec<&str> =
        json["nodes"].as_array().unwrap().iter().map(|n| n["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["house", "right", "eye", "lamp"]);
}

#[test]
fn the_empty_set_is_a_valid_file_without_meshes() {
    let place = Workplace::new("square.glb", &Fixture::square().glb());
    let out = place.out();
    let report =
        export_visible(&place.source, &place.scene, &PrimitiveSet::default(), &out).unwrap();
    assert_valid(&[&out]);
    assert_eq!((report.triangles, report.nodes, report.meshes), (0, 0, 0));
    assert!(json_of(&out).get("buffers").is_none());
}

#[test]
fn skins_and_morph_targets_leave_the_triangles_where_the_reader_saw_them() {
    let mut f = Fixture::square();
    let up = f.floats(&[[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0], [0.0, 0.0, 4.0]]);
    f.json["meshes"][0]["primitives"][0]["targets"] = json!([{"POSITION": up}]);
    f.json["meshes"][0]["weights"] = json!([0.5]);
    f.root(json!({"name": "other", "mesh": 0, "weights": [1.0], "translation": [5.0, 0.0, 0.0]}));
    f.json["nodes"][0]["skin"] = json!(0);
    f.json["nodes"][0]["translation"] = json!([50.0, 0.0, 0.0]);
    f.json["skins"] = json!([{"joints": [0]}]);
    let place = Workplace::new("moved.glb", &f.glb());
    let set = all(&place.scene);
    let (report, exported, json) = place.export(&set);
    assert_exports_exactly(&place.scene, &set, &exported);
    assert_eq!(json["meshes"].as_array().unwrap().len(), 2);
    assert!(json.get("skins").is_none());
    assert_eq!(report.warnings.len(), 2, "{:?}", report.warnings);
}

/// Two moving squares, one of them mirrored, under a turning parent; and a strip on two joints.
fn moving() -> Fixture {
    let mut f = Fixture::square();
    let normals = f.floats(&[[0.0, 0.0, 1.0f32]; 4]);
    let tangents = f.floats(&[[1.0, 0.0, 0.0, 1.0f32]; 4]);
    let attributes = &mut f.json["meshes"][0]["primitives"][0]["attributes"];
    (attributes["NORMAL"], attributes["TANGENT"]) = (normals.into(), tangents.into());
    f.json["scenes"][0]["nodes"] = json!([]);
    let other = f.node(json!({"name": "mirrored", "mesh": 0, "scale": [-1.0, 2.0, 1.0]}));
    let parent = f.root(json!({"children": [0, other], "translation": [1e5, 0.0, 0.0]}));
    let joints = f.accessor(&[0, 1, 0, 0].repeat(4), 5121, "VEC4", 4);
    let weights = f.floats(&[
        [1.0, 0.0, 0.0, 0.0],
        [0.5, 0.5, 0.0, 0.0],
        [0.25, 0.75, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0f32],
    ]);
    let mut bound = f.json["meshes"][0]["primitives"][0].clone();
    bound["attributes"]["JOINTS_0"] = joints.into();
    bound["attributes"]["WEIGHTS_0"] = weights.into();
    let mesh = f.mesh(bound);
    f.root(json!({"name": "strip", "mesh": mesh, "skin": 0}));
    let joint = f.root(json!({"translation": [0.0, 3.0, 0.0]}));
    f.json["skins"] = json!([{"joints": [parent, joint]}]);
    let times = f.floats(&[[0.0], [2.0f32]]);
    f.json["accessors"][times as usize]["min"] = json!([0.0]);
    f.json["accessors"][times as usize]["max"] = json!([2.0]);
    let turns = f.floats(&[[0.0, 0.0, 0.0, 1.0f32], [0.0, 0.6, 0.0, 0.8]]);
    f.json["animations"] = json!([{"samplers": [{"input": times, "output": turns}], "channels":
        [{"sampler": 0, "target": {"node": parent, "path": "rotation"}}]}]);
    f
}

#[test]
fn what_moves_is_frozen_at_the_moment_and_the_file_is_at_rest() {
    let place = Workplace::new("moving.glb", &moving().glb());
    let scene = &place.scene;
    assert!(scene.geometry.states > 2);
    for seconds in [0.0, 0.77, 2.0] {
        let moment = scene.moment_at(seconds);
        for set in [all(scene), some(scene)] {
            let out = place.out();
            let options = ExportOptions::at(moment);
            let report = export_visible_with(&place.source, scene, &set, options, &out).unwrap();
            assert_valid(&[&out]);
            assert_eq!(report.triangles, set.len());
            assert_exports_at(moment, scene, &set, &open(&out).unwrap());
            let json = json_of(&out);
            assert!(json.get("animations").is_none() && json.get("skins").is_none());
        }
    }
    let json = json_of(&place.out());
    let mirrored = json["nodes"].as_array().unwrap().iter().find(|n| n["name"] == "mirrored");
    assert_eq!(mirrored.unwrap()["scale"], json!([-1.0, 1.0, 1.0]));
}

#[test]
fn a_moment_that_the_scene_does_not_have_is_refused() {
    let place = Workplace::new("square.glb", &Fixture::square().glb());
    for (state, t) in [(1, 0.0), (0, 1.5), (0, f64::NAN)] {
        let options = ExportOptions::at(Moment { state, t });
        let (source, scene, set) = (&place.source, &place.scene, all(&place.scene));
        let error = export_visible_with(source, scene, &set, options, &place.out()).unwrap_err();
        assert!(matches!(error, ExportError::NoSuchMoment { states: 1, .. }), "{error}");
    }
}

#[test]
fn refusals_say_what_to_do() {
    let place = Workplace::new("square.glb", &Fixture::square().glb());
    let (source, scene, out) = (&place.source, &place.scene, place.out());
    let set = PrimitiveSet::from_sorted([0, 7]);
    let error = export_visible(source, scene, &set, &out).unwrap_err();
    assert!(matches!(error, ExportError::NotThisScene { primitive: 7, count: 2 }));
    let set = all(scene);
    let error = export_visible(source, scene, &set, source).unwrap_err();
    assert!(matches!(error, ExportError::ReplacesSource { .. }));
    let nowhere = place.folder.path().join("no/such/folder.glb");
    let error = export_visible(source, scene, &set, &nowhere).unwrap_err();
    assert!(matches!(error, ExportError::Write { .. }));
    assert!(!out.exists());
    std::fs::write(source, rich().glb()).unwrap();
    let error = export_visible(source, scene, &set, &out).unwrap_err();
    assert!(matches!(error, ExportError::SourceChanged { .. }));
    std::fs::remove_file(source).unwrap();
    let error = export_visible(source, scene, &set, &out).unwrap_err();
    assert!(matches!(error, ExportError::Source(_)));
}

#[test]
fn real_scenes_come_back_in_whole_and_in_part() {
    let Some(scenes) = scenes() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut outputs = vec![];
    for part in ["animated", "city", "indoor", "instanced", "import"] {
        for source in files_below(&scenes.join(part)) {
            let Ok(scene) = open(&source) else { continue };
            // Ten million triangles take too long here; memory is not the question.
            if scene.geometry.primitive_count() > 1_200_000 {
                continue;
            }
            let broken = source.starts_with(scenes.join("import/gltf-validator"));
            for set in [all(&scene), some(&scene)] {
                let out = folder.path().join(format!("{}.glb", outputs.len()));
                let report = match export_visible(&source, &scene, &set, &out) {
                    Ok(report) => report,
                    // The validator's own test files may be broken where triangles are not.
                    Err(ExportError::Malformed { .. }) if broken => continue,
                    Err(e) => panic!("{}: {e}", source.display()),
                };
                let exported = open(&out).unwrap_or_else(|e| panic!("{}: {e}", source.display()));
                assert_exports_exactly(&scene, &set, &exported);
                assert_eq!(report.triangles, set.len());
                if !broken {
                    outputs.push((source.clone(), out));
                }
            }
        }
    }
    for chunk in outputs.chunks(64) {
        let files: Vec<&Path> = chunk.iter().map(|(_, out)| out.as_path()).collect();
        assert_valid(&files);
    }
    assert!(outputs.len() > 100);
}
