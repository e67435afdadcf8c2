//! Solving with a memory limit: the same sets and weights as with all in memory (VI-3).

use std::path::Path;

use glam::DVec3;
use proptest::prelude::*;
use serde_json::{Value, json};
use sightline_geometry::{Sampling, SegmentId, ViewSegment};
use sightline_scene::{MemoryLimit, OpenOptions, Scene};
use sightline_solver::{SolveOptions, TimePath, solve_segment_with, solve_states};

type Triangle = [[f32; 3]; 3];

/// A mesh, where it stands, whether it is glass, and whether it moves.
type Body = (Vec<Triangle>, Vec<[f32; 3]>, bool, bool);

fn bodies() -> impl Strategy<Value = Vec<Body>> {
    let corner = prop::array::uniform3(-0.6f32..0.6);
    let triangle = (prop::array::uniform3(-2.0f32..2.0), prop::array::uniform3(corner))
        .prop_map(|(at, by)| by.map(|b| [0, 1, 2].map(|k| at[k] + b[k])));
    let mesh = prop::collection::vec(triangle, 1..40);
    let places = prop::collection::vec(prop::array::uniform3(-6.0f32..6.0), 1..4);
    prop::collection::vec((mesh, places, any::<bool>(), any::<bool>()), 1..5)
}

/// A glTF scene of these bodies beside its buffer.
fn write(folder: &Path, bodies: &[Body]) -> std::path::PathBuf {
    let mut buffer: Vec<u8> = [0.0f32, 1.0].iter().flat_map(|t| t.to_le_bytes()).collect();
    let mut views = vec![json!({"buffer": 0, "byteOffset": 0, "byteLength": 8})];
    let times = json!({"bufferView": 0, "componentType": 5126, "type": "SCALAR", "count": 2});
    let mut accessors = vec![times];
    let mut floats = |values: &[[f32; 3]]| {
        views.push(json!({
            "buffer": 0, "byteOffset": buffer.len(), "byteLength": 12 * values.len(),
        }));
        buffer.extend(values.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
        accessors.push(json!({
            "bufferView": views.len() - 1, "componentType": 5126, "type": "VEC3",
            "count": values.len(),
        }));
        accessors.len() - 1
    };
    let (mut meshes, mut nodes): (Vec<Value>, Vec<Value>) = (vec![], vec![]);
    let (mut channels, mut samplers): (Vec<Value>, Vec<Value>) = (vec![], vec![]);
    for (triangles, places, glass, moves) in bodies {
        let positions = floats(triangles.as_flattened());
        meshes.push(json!({"primitives": [{"attributes": {"POSITION": positions}}]}));
        let name = if *glass { "glass" } else { "wall" };
        for place in places {
            if *moves {
                let way = floats(&[*place, place.map(|v| v + 0.7)]);
                samplers.push(json!({"input": 0, "output": way}));
                channels.push(json!({
                    "sampler": samplers.len() - 1,
                    "target": {"node": nodes.len(), "path": "translation"},
                }));
            }
            nodes.push(json!({"name": name, "mesh": meshes.len() - 1, "translation": place}));
        }
    }
    let mut gltf = json!({
        "asset": {"version": "2.0"}, "scene": 0,
        "scenes": [{"nodes": (0..nodes.len()).collect::<Vec<_>>()}],
        "nodes": nodes, "meshes": meshes, "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": buffer.len(), "uri": "soup.bin"}],
    });
    if !channels.is_empty() {
        gltf["animations"] = json!([{"channels": channels, "samplers": samplers}]);
    }
    std::fs::write(folder.join("soup.bin"), buffer).unwrap();
    let path = folder.join("soup.gltf");
    std::fs::write(&path, gltf.to_string()).unwrap();
    path
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_solve_within_no_memory_at_all_finds_the_same(bodies in bodies()) {
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), &bodies);
        let open = |memory: Option<MemoryLimit>| {
            let mut options = OpenOptions::default();
            options.see_through = vec!["glass".into()];
            options.motion_error = 0.1;
            options.memory = memory;
            Scene::open(&path, &options).unwrap()
        };
        // Far below what this process has: all that is loaded is given back at every look.
        let nothing = MemoryLimit::new(1 << 20, folder.path().join("chunks"));
        let limited = open(Some(MemoryLimit { strict: false, ..nothing }));
        let whole = open(None);
        let segment = ViewSegment {
            id: SegmentId(0),
            v0: DVec3::new(-0.5, 0.1, 0.2),
            v1: DVec3::new(0.5, 0.0, 0.3),
        };
        let sampling = Sampling::new(16);
        let options = SolveOptions { passes: 2, threshold: 1e-5, ..SolveOptions::default() };
        let solve = |scene: &Scene| {
            solve_segment_with(&scene.geometry, &segment, sampling, &options)
        };
        prop_assert_eq!(solve(&limited), solve(&whole));
        let states = 0..whole.geometry.states;
        let over = |scene: &Scene| {
            let (states, path) = (states.clone(), TimePath::FORWARD);
            solve_states(&scene.geometry, &segment, sampling, states, path, None, &options)
        };
        prop_assert_eq!(over(&limited), over(&whole));
        let held = limited.memory.as_ref().unwrap().held();
        prop_assert!(held.given_back > 1, "{:?}", held);
    }
}
