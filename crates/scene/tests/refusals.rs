//! Broken scenes are refused with an error that names the cause and the place.

mod fixtures;

use fixtures::{Fixture, open, open_bytes};
use serde_json::json;
use sightline_scene::{Cause, OpenOptions, Scene, UriProblem};

const TRIANGLE: [[f32; 3]; 3] = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];

macro_rules! assert_refused {
    ($fixture:expr, $pattern:pat $(if $guard:expr)?) => {{
        let cause = $fixture.cause();
        assert!(matches!(&cause, $pattern $(if $guard)?), "{cause:?}");
    }};
}

#[test]
fn positions_that_are_not_finite_name_the_vertex() {
    for bad in [f32::NAN, f32::INFINITY] {
        let mut t = TRIANGLE;
        t[1][2] = bad;
        let error = Fixture::with_triangles(&t, None).try_open().unwrap_err();
        assert!(matches!(*error.cause, Cause::PositionNotFinite { vertex: 1, .. }));
        assert_eq!((error.place.mesh, error.place.primitive), (Some(0), Some(0)));
        assert!(error.to_string().contains("mesh 0, primitive 0: vertex 1 is at"), "{error}");
    }
    let mut t = TRIANGLE;
    t[1][2] = 1e16;
    assert_refused!(Fixture::with_triangles(&t, None), Cause::PositionTooFar { vertex: 1, .. });
}

#[test]
fn a_vertex_that_no_triangle_uses_may_be_anything() {
    let mut corners = TRIANGLE.to_vec();
    corners.push([f32::NAN; 3]);
    let scene = Fixture::with_triangles(&corners, Some(&[0, 1, 2])).open();
    assert_eq!(scene.report.unique_vertices, 3);
}

#[test]
fn indices_out_of_range_and_primitive_restart_name_the_position() {
    let f = Fixture::with_triangles(&TRIANGLE, Some(&[0, 1, 2, 0, 1, 3]));
    assert_refused!(f, Cause::IndexOutOfRange { at: 5, index: 3, vertices: 3 });
    let f = Fixture::with_triangles(&TRIANGLE, Some(&[0, 1, u32::MAX]));
    assert_refused!(f, Cause::PrimitiveRestart { at: 2, index: u32::MAX });
}

#[test]
fn a_missing_buffer_file_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut f = Fixture::square();
    f.json["buffers"] = json!([{"byteLength": f.buffer.len(), "uri": "some%20where.bin"}]);
    let path = folder.path().join("scene.gltf");
    std::fs::write(&path, serde_json::to_vec(&f.json).unwrap()).unwrap();
    let error = open(&path).unwrap_err();
    let Cause::MissingBuffer { buffer: 0, file, .. } = &*error.cause else { panic!("{error}") };
    assert_eq!(file, &folder.path().join("some where.bin"));
    assert!(error.to_string().starts_with(path.to_str().unwrap()));

    std::fs::write(folder.path().join("some where.bin"), &f.buffer).unwrap();
    let scene = open(&path).unwrap();
    assert_eq!(scene.report.unique_triangles, 2);
    assert_eq!(scene.digest.files.len(), 2);
    assert_eq!(scene.digest.files[1].name, "some where.bin");
    assert_eq!(scene.digest, sightline_scene::digest(&path).unwrap());

    std::fs::write(folder.path().join("some where.bin"), &f.buffer[1..]).unwrap();
    let error = open(&path).unwrap_err();
    assert!(matches!(*error.cause, Cause::TruncatedBuffer { buffer: 0, .. }), "{error}");
}

#[test]
fn uris_that_leave_the_folder_are_refused() {
    for (uri, expected) in [
        ("../scene.bin", UriProblem::Escape),
        ("%2e%2e/scene.bin", UriProblem::Escape),
        ("/etc/hostname", UriProblem::Absolute),
        ("https://example.com/a.bin", UriProblem::Scheme),
    ] {
        let mut f = Fixture::square();
        f.json["buffers"] = json!([{"byteLength": 4, "uri": uri}]);
        assert_refused!(f, Cause::BufferUri { problem, .. } if *problem == expected);
    }
}

#[test]
fn main_files_that_are_no_gltf_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let cause = |bytes: &[u8]| *open_bytes(bytes).unwrap_err().cause;
    assert!(matches!(*open(folder.path()).unwrap_err().cause, Cause::NotAFile));
    let absent = folder.path().join("absent.glb");
    assert!(matches!(*open(&absent).unwrap_err().cause, Cause::Read { .. }));
    assert!(matches!(cause(b""), Cause::Json { .. }));
    assert!(matches!(cause(b"{\n  nodes"), Cause::Json { line: 2, .. }));
    assert!(matches!(cause(b"{}"), Cause::Json { .. }));
    assert!(matches!(cause(br#"{"asset":{"version":"1.0"}}"#), Cause::Version { .. }));
    let newer = br#"{"asset":{"version":"2.1","minVersion":"2.1"}}"#;
    assert!(matches!(cause(newer), Cause::Version { .. }));

    let glb = Fixture::square().glb();
    assert!(matches!(cause(&glb[..11]), Cause::GlbTruncated { .. }));
    assert!(matches!(cause(&glb[..glb.len() - 1]), Cause::GlbTruncated { .. }));
    let changed = |at: usize, byte: u8| {
        let mut glb = glb.clone();
        glb[at] = byte;
        cause(&glb)
    };
    assert!(matches!(changed(4, 3), Cause::GlbVersion { version: 3 }));
    assert!(matches!(changed(16, b'X'), Cause::GlbWithoutJson { .. }));
    assert!(matches!(changed(15, 0x7f), Cause::GlbTruncated { what: "a chunk", .. }));
}

#[test]
fn nodes_that_are_no_tree_are_refused() {
    let mut f = Fixture::square();
    f.json["nodes"] = json!([{"children": [1]}, {"children": [2]}, {"children": [1], "mesh": 0}]);
    assert_refused!(f, Cause::NodeCycle { node: 1 });
    f.json["nodes"] = json!([{"children": [0]}]);
    assert_refused!(f, Cause::NodeCycle { node: 0 });
    f.json["nodes"] = json!([{"children": [1, 2]}, {"children": [3]}, {"children": [3]}, {}]);
    assert_refused!(f, Cause::NodeWithTwoParents { node: 3 });
    f.json["nodes"] = json!([{"children": [9]}]);
    assert_refused!(f, Cause::NoSuch { element: "node", index: 9, count: 1, .. });
    f.json["nodes"] = (1..=2000).map(|i| json!({"children": [i]})).collect();
    assert_refused!(f, Cause::NodesTooDeep { .. });
}

#[test]
fn transforms_that_make_no_sense_name_the_node() {
    let node = |extra: serde_json::Value| {
        let mut f = Fixture::square();
        for (k, v) in extra.as_object().unwrap() {
            f.json["nodes"][0][k] = v.clone();
        }
        f
    };
    let mut matrix = vec![0.0; 16];
    matrix[15] = 0.5;
    assert_refused!(node(json!({"matrix": matrix})), Cause::MatrixNotAffine { .. });
    assert_refused!(node(json!({"rotation": [0, 0, 0, 0]})), Cause::RotationZero);
    assert_refused!(node(json!({"translation": [1e300, 0, 0]})), Cause::TooFar { .. });
    let mut f = node(json!({"scale": [1e300, 1, 1], "children": [1]}));
    f.node(json!({"scale": [1e300, 1, 1], "mesh": 0}));
    let error = f.try_open().unwrap_err();
    assert!(matches!(*error.cause, Cause::TransformNotFinite), "{error}");
    assert_eq!(error.place.node, Some(1));
}

#[test]
fn accessors_are_checked_against_their_bytes() {
    let square = Fixture::square;
    let with = |at: &str, value: serde_json::Value| {
        let mut f = square();
        *f.json.pointer_mut(at).unwrap() = value;
        f
    };
    assert_refused!(
        with("/accessors/0/count", json!(5)),
        Cause::AccessorOutOfView { accessor: 0, needed: 60, available: 48, .. }
    );
    assert_refused!(
        with("/accessors/0/count", json!(u64::MAX)),
        Cause::AccessorOutOfView { needed: u64::MAX, .. }
    );
    assert_refused!(with("/accessors/0/type", json!("VEC2")), Cause::AccessorType { .. });
    assert_refused!(with("/accessors/0/type", json!("VEC9")), Cause::InvalidValue { .. });
    assert_refused!(with("/accessors/0/componentType", json!(5125)), Cause::AccessorType { .. });
    assert_refused!(
        with("/accessors/1/bufferView", json!(7)),
        Cause::NoSuch { element: "buffer view", index: 7, count: 2, .. }
    );
    assert_refused!(
        with("/bufferViews/0/byteLength", json!(1u64 << 40)),
        Cause::ViewOutOfBuffer { view: 0, .. }
    );
    assert_refused!(
        with("/bufferViews/0/buffer", json!(1)),
        Cause::NoSuch { element: "buffer", .. }
    );
    assert_refused!(
        with("/meshes/0/primitives/0/indices", json!(4)),
        Cause::NoSuch { element: "accessor", .. }
    );
    assert_refused!(with("/nodes/0/mesh", json!(3)), Cause::NoSuch { element: "mesh", .. });
    let mut f = square();
    f.json["bufferViews"][0]["byteStride"] = json!(8);
    assert_refused!(f, Cause::AccessorStride { stride: 8, element: 12, .. });
    let mut f = square();
    f.json["meshes"][0]["primitives"][0]["material"] = json!(0);
    assert_refused!(f, Cause::NoSuch { element: "material", .. });
    let mut f = square();
    f.json["meshes"][0]["primitives"][0]["mode"] = json!(7);
    assert_refused!(f, Cause::InvalidValue { .. });
}

#[test]
fn counts_without_data_reserve_no_memory() {
    let mut f = Fixture::square();
    f.json["accessors"][0] = json!({"componentType": 5126, "type": "VEC3", "count": u32::MAX});
    assert_refused!(f, Cause::AccessorTooLarge { accessor: 0, .. });
    let mut f = Fixture::square();
    let count = f.add_accessor(json!({"componentType": 5126, "type": "VEC3", "count": 1 << 30}));
    f.json["nodes"][0]["extensions"] =
        json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": count}}});
    assert_refused!(f, Cause::AccessorTooLarge { .. });
    f.json["nodes"][0]["extensions"] =
        json!({"EXT_mesh_gpu_instancing": {"attributes": {"_ID": count}}});
    assert_refused!(f, Cause::AccessorTooLarge { .. });
    f.json["nodes"][0]["extensions"] = json!({"EXT_mesh_gpu_instancing": {}});
    assert_refused!(f, Cause::ExtensionMalformed { .. });
    for mode in ["ATTRIBUTES", "TRIANGLES", "INDICES"] {
        let mut f = Fixture::square();
        f.json["bufferViews"][0]["extensions"] = json!({"EXT_meshopt_compression": {
            "buffer": 0, "byteLength": 16, "byteStride": 4, "count": 3_000_000_000u64,
            "mode": mode}});
        f.json["bufferViews"][0]["buffer"] = json!(1);
        f.json["buffers"] = json!([{"byteLength": f.buffer.len()}, {"byteLength": 1 << 20,
            "extensions": {"EXT_meshopt_compression": {"fallback": true}}}]);
        assert_refused!(f, Cause::Compressed { view: 0, .. });
    }
}

#[test]
fn sparse_entries_stay_in_their_accessor() {
    let mut f = Fixture::square();
    let indices = f.view(&[4, 0]);
    let values = f.view(&[0; 12]);
    let sparse = json!({"count": 1, "indices": {"bufferView": indices, "componentType": 5123},
        "values": {"bufferView": values}});
    f.json["accessors"][0]["sparse"] = sparse;
    assert_refused!(f, Cause::SparseIndex { accessor: 0, entry: 0, index: 4, count: 4 });
    f.json["accessors"][0]["sparse"]["count"] = json!(5);
    assert_refused!(f, Cause::SparseIndex { .. });
    f.json["accessors"][0]["sparse"]["count"] = json!(2);
    assert_refused!(f, Cause::AccessorOutOfView { part: "sparse indices", .. });
}

#[test]
fn unknown_required_extensions_are_named() {
    let mut f = Fixture::square();
    f.json["extensionsRequired"] = json!(["KHR_materials_unlit", "VENDOR_bent_triangles"]);
    assert_refused!(f, Cause::RequiredExtension { extension } if extension == "VENDOR_bent_triangles");
    f.json["extensionsRequired"] = json!(["KHR_materials_unlit"]);
    f.json["extensionsUsed"] = json!(["KHR_materials_unlit", "KHR_mesh_quantization"]);
    let scene = f.open();
    assert_eq!(scene.report.ignored_extensions, ["KHR_materials_unlit"]);
}

#[test]
fn compressed_data_that_does_not_decode_is_refused() {
    let mut f = Fixture::square();
    let garbage = f.view(&[7; 64]);
    f.json["meshes"][0]["primitives"][0]["extensions"] = json!({"KHR_draco_mesh_compression":
        {"bufferView": garbage, "attributes": {"POSITION": 0}}});
    // The accessors have data of their own, so the decoder is not needed.
    assert_eq!(f.open().report.unique_triangles, 2);
    for accessor in 0..2 {
        f.json["accessors"][accessor].as_object_mut().unwrap().remove("bufferView");
    }
    assert_refused!(f, Cause::Draco { .. });
}

#[test]
fn a_scale_of_zero_on_many_turned_instances_is_refused_before_it_is_read() {
    let mut f = Fixture::with_triangles(&[[0.0; 3]; 3000], None);
    let turns: Vec<[f32; 4]> = (0..2000u32).map(|i| [i as f32, 1.0, 2.0, 3.0]).collect();
    let turns = f.floats(&turns);
    f.json["nodes"][0]["scale"] = json!([0, 1, 1]);
    f.json["nodes"][0]["extensions"] =
        json!({"EXT_mesh_gpu_instancing": {"attributes": {"ROTATION": turns}}});
    assert_refused!(f, Cause::TooManyFlattened { count: 2_000_000, .. });
}

#[test]
fn limits_of_the_options_hold() {
    let glb = Fixture::square().glb();
    let mut options = OpenOptions::default();
    options.max_unique_triangles = 1;
    let open = |options: &OpenOptions| Scene::open_bytes("a.glb".as_ref(), &glb, options);
    let cause = *open(&options).unwrap_err().cause;
    assert!(matches!(cause, Cause::TooManyUniqueTriangles { count: 2, limit: 1 }), "{cause:?}");
    let mut options = OpenOptions::default();
    options.max_instances = 0;
    let cause = *open(&options).unwrap_err().cause;
    assert!(matches!(cause, Cause::TooManyInstances { count: 1, limit: 0 }), "{cause:?}");
    let mut options = OpenOptions::default();
    options.see_through = vec!["a{".into()];
    let cause = *open(&options).unwrap_err().cause;
    assert!(matches!(cause, Cause::Pattern { .. }), "{cause:?}");
}
