//! Mutated files never panic: they are read into a well-formed scene or refused.

mod fixtures;

use std::path::Path;

use fixtures::{
    Fixture,
    mutate::{Rng, mutate},
};
use proptest::prelude::*;
use serde_json::json;
use sightline_scene::{OpenOptions, Scene};

/// Small valid files that together use every feature of the reader.
fn seeds() -> Vec<Vec<u8>> {
    let mut out = Vec::new();
    let square = Fixture::square();
    out.extend([square.glb(), square.gltf()]);

    let mut strip = Fixture::square();
    strip.json["meshes"][0]["primitives"][0]["mode"] = json!(5);
    strip.json["materials"] = json!([{"alphaMode": "MASK"}]);
    strip.json["meshes"][0]["primitives"][0]["material"] = json!(0);
    strip.root(json!({"children": [2], "matrix":
        [1,0,0,0, 0,1,0,0, 0,0,1,0, 3,4,5,1]}));
    strip.node(json!({"mesh": 0, "scale": [1, 0, -2], "rotation": [0, 0, 0, 1]}));
    out.push(strip.glb());

    let mut instanced = Fixture::square();
    let translation = instanced.floats(&[[0.0; 3], [5.0, 0.0, 0.0], [0.0, 5.0, 1.0f32]]);
    let turn = instanced.floats(&[[0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.5; 4]]);
    instanced.json["nodes"][0]["extensions"] = json!({"EXT_mesh_gpu_instancing":
        {"attributes": {"TRANSLATION": translation, "ROTATION": turn}}});
    out.extend([instanced.glb(), instanced.gltf()]);

    let mut sparse = Fixture::square();
    let indices = sparse.view(&[1, 0, 3, 0]);
    let values = sparse.view(&[0x40; 24]);
    let delta = sparse.floats(&[[0.0, 0.0, 1.0f32]; 4]);
    sparse.json["accessors"][0]["sparse"] = json!({"count": 2,
        "indices": {"bufferView": indices, "componentType": 5123},
        "values": {"bufferView": values}});
    sparse.json["meshes"][0]["primitives"][0]["targets"] = json!([{"POSITION": delta}]);
    sparse.json["meshes"][0]["weights"] = json!([0.5]);
    out.push(sparse.glb());

    out.push(meshopt_square());
    out.extend(animated());
    out
}

/// Channels of every kind on nodes, a skin and morph targets.
fn animated() -> [Vec<u8>; 2] {
    let mut f = Fixture::square();
    let joints = f.accessor(&[0, 1, 0, 0].repeat(4), 5121, "VEC4", 4);
    let weights = f.floats(&[[0.5, 0.5, 0.0, 0.0f32]; 4]);
    let delta = f.floats(&[[0.0, 0.0, 1.0f32]; 4]);
    let primitive = &mut f.json["meshes"][0]["primitives"][0];
    primitive["attributes"]["JOINTS_0"] = joints.into();
    primitive["attributes"]["WEIGHTS_0"] = weights.into();
    primitive["targets"] = json!([{"POSITION": delta}]);
    let identity: [f32; 16] = std::array::from_fn(|i| if i % 5 == 0 { 1.0 } else { 0.0 });
    let bytes: Vec<u8> =
        [identity; 2].as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    let inverse = f.accessor(&bytes, 5126, "MAT4", 2);
    let child = f.node(json!({"mesh": 0, "translation": [0.0, 1.0, 0.0]}));
    let parent = f.root(json!({"children": [child], "scale": [1.0, 2.0, 1.0]}));
    f.json["nodes"][0]["skin"] = json!(0);
    f.json["skins"] = json!([{"joints": [parent, child], "inverseBindMatrices": inverse}]);
    let times = f.floats(&[[0.0], [0.5], [1.0f32]]);
    let turns = f.floats(&[[0.0, 0.0, 0.0, 1.0], [0.0, 0.6, 0.0, 0.8], [1.0, 0.0, 0.0, 0.0f32]]);
    let spline = f.floats(&[[0.5f32, 0.1, 0.2]; 9]);
    let faces = f.floats(&[[0.0], [1.0], [0.5f32]]);
    let channel = |sampler: u32, node: u32, path: &str| json!({"sampler": sampler, "target": {"node": node, "path": path}});
    f.json["animations"] = json!([{"samplers": [
        {"input": times, "output": turns, "interpolation": "LINEAR"},
        {"input": times, "output": spline, "interpolation": "CUBICSPLINE"},
        {"input": times, "output": faces, "interpolation": "STEP"},
    ], "channels": [
        channel(0, parent, "rotation"), channel(0, child, "rotation"),
        channel(1, child, "translation"), channel(1, parent, "scale"),
        channel(2, child, "weights"),
        {"sampler": 2, "target": {"path": "pointer", "extensions":
            {"KHR_animation_pointer": {"pointer": "/nodes/0/weights"}}}},
    ]}]);
    [f.glb(), f.gltf()]
}

/// A square whose positions and indices are compressed.
fn meshopt_square() -> Vec<u8> {
    let mut f = Fixture::new();
    let corners = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
    let positions = meshopt::encode_vertex_buffer(&corners).unwrap();
    let indices = meshopt::encode_index_buffer(&[0, 1, 2, 0, 2, 3], 4).unwrap();
    let (p, i) = (f.view(&positions), f.view(&indices));
    let compress = |f: &mut Fixture, view: u32, stride: u32, count: u32, mode: &str| {
        let json = f.json["bufferViews"][view as usize].clone();
        f.json["bufferViews"][view as usize] = json!({"buffer": 1, "byteOffset": 0,
            "byteLength": stride * count, "extensions": {"EXT_meshopt_compression": {
            "buffer": 0, "byteOffset": json["byteOffset"], "byteLength": json["byteLength"],
            "byteStride": stride, "count": count, "mode": mode}}});
    };
    compress(&mut f, p, 12, 4, "ATTRIBUTES");
    compress(&mut f, i, 4, 6, "TRIANGLES");
    let p = f.add_accessor(json!({"bufferView": p, "componentType": 5126, "type": "VEC3",
        "count": 4}));
    let i = f.add_accessor(json!({"bufferView": i, "componentType": 5125, "type": "SCALAR",
        "count": 6}));
    let mesh = f.mesh(json!({"attributes": {"POSITION": p}, "indices": i}));
    f.root(json!({"mesh": mesh}));
    f.json["buffers"] = json!([{"byteLength": f.buffer.len()}, {"byteLength": 96,
        "extensions": {"EXT_meshopt_compression": {"fallback": true}}}]);
    f.glb()
}

#[test]
fn the_seeds_are_valid() {
    for (i, seed) in seeds().iter().enumerate() {
        let scene = fixtures::open_bytes(seed).unwrap_or_else(|e| panic!("seed {i}: {e}"));
        assert!(scene.geometry.primitive_count() > 0, "seed {i}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 2000,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn mutated_files_are_read_or_refused(seed in any::<u64>()) {
        let mut rng = Rng(seed);
        let seeds = seeds();
        let main = mutate(&seeds[rng.below(seeds.len())], &mut rng);
        if let Ok(scene) =
            Scene::open_bytes(Path::new("memory/scene.glb"), &main, &OpenOptions::default())
        {
            scene.assert_well_formed();
        }
    }

    #[test]
    fn arbitrary_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        prop_assert!(fixtures::open_bytes(&bytes).is_err());
        let glb = [&b"glTF\x02\0\0\0"[..], &bytes].concat();
        prop_assert!(fixtures::open_bytes(&glb).is_err());
    }
}
