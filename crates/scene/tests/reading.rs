//! What is read: transforms, modes, encodings, instancing, compression, numbering.

mod fixtures;

use std::f64::consts::FRAC_1_SQRT_2;

use fixtures::{Fixture, assert_same_triangles, open, rounded_triangles, scenes, world_triangles};
use serde_json::json;
use sightline_geometry::{ObjectId, Ray, raycast::RayCaster};
use sightline_scene::{OpenOptions, Scene};

fn open_with(f: &Fixture, see_through: &[&str]) -> Scene {
    let mut options = OpenOptions::default();
    options.see_through = see_through.iter().map(|s| (*s).to_owned()).collect();
    let scene = Scene::open_bytes("scene.glb".as_ref(), &f.glb(), &options).unwrap();
    scene.assert_well_formed();
    scene
}

#[test]
fn transforms_compose_in_f64_far_from_the_origin() {
    let mut f = Fixture::square();
    f.json["nodes"][0] = json!({"translation": [1e7, 0.0, 0.1], "children": [1]});
    f.node(json!({"rotation": [0.0, FRAC_1_SQRT_2, 0.0, FRAC_1_SQRT_2],
        "scale": [2.0, 3.0, -1.0], "children": [2]}));
    f.node(json!({"matrix": [1.0,0.0,0.0,0.0, 0.0,1.0,0.0,0.0, 0.0,0.0,1.0,0.0, 0.0,0.0,0.25,1.0],
        "mesh": 0}));
    let scene = f.open();
    // (x, y, 0.25) -> (2x, 3y, -0.25) -> a quarter turn about y: (-0.25, 3y, -2x).
    let at = |x: f64, y: f64| [1e7 - 0.25, 3.0 * y, 0.1 - 2.0 * x];
    let expected = [[at(0., 0.), at(1., 0.), at(1., 1.)], [at(0., 0.), at(1., 1.), at(0., 1.)]];
    assert_same_triangles(&world_triangles(&scene), &expected, 1e-8);
}

#[test]
fn a_negative_scale_keeps_world_positions() {
    let mut f = Fixture::square();
    f.json["nodes"][0]["scale"] = json!([-1.0, 1.0, 1.0]);
    let scene = f.open();
    let at = |x: f64, y: f64| [-x, y, 0.0];
    let expected = [[at(0., 0.), at(1., 0.), at(1., 1.)], [at(0., 0.), at(1., 1.), at(0., 1.)]];
    assert_same_triangles(&world_triangles(&scene), &expected, 0.0_f64.max(1e-12));
    let ray = Ray::new([-0.25, 0.5, 1.0].into(), [0.0, 0.0, -1.0].into());
    let hit = RayCaster::new().closest_occluder(&scene.geometry, ray, 10.0, |_| true).unwrap();
    assert_eq!(hit.distance, 1.0);
}

#[test]
fn a_scale_of_zero_on_one_axis_leaves_a_flat_mesh_that_rays_hit() {
    let corners = [[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [1.0, 1.0, 7.0], [1.0, 0.0, 9.0]];
    let mut f = Fixture::with_triangles(&corners, Some(&[0, 1, 2, 1, 3, 1, 1, 3, 0]));
    f.json["nodes"][0]["scale"] = json!([1.0, 1.0, 0.0]);
    f.json["nodes"][0]["translation"] = json!([1e6, 0.0, 2.0]);
    let scene = f.open();
    assert_eq!(scene.report.flattened_instances, 1);
    // The second triangle repeats a corner, the third is flattened to a line.
    assert_eq!((scene.report.unique_triangles, scene.report.degenerate_triangles), (1, 2));
    assert_eq!(scene.report.degenerate[0].triangles, [1, 2]);
    let ray = Ray::new([1e6 + 0.75, 0.25, 3.0].into(), [0.0, 0.0, -1.0].into());
    let hit = RayCaster::new().closest_occluder(&scene.geometry, ray, 10.0, |_| true).unwrap();
    assert_eq!(hit.distance, 1.0);
    f.json["nodes"][0]["scale"] = json!([0.0, 0.0, 0.0]);
    let scene = f.open();
    assert_eq!((scene.objects.len(), scene.geometry.meshes.len()), (0, 0));
}

#[test]
fn strips_fans_and_lists_hold_the_triangles_of_the_specification() {
    let p: Vec<[f32; 3]> =
        (0..5u8).map(|i| [f32::from(i), f32::from(i % 2), f32::from(i * i)]).collect();
    let corner = |i: usize| p[i].map(f64::from);
    let cases: [(u32, Vec<[usize; 3]>); 3] = [
        (4, vec![[0, 1, 2]]),
        (5, vec![[0, 1, 2], [1, 3, 2], [2, 3, 4]]),
        (6, vec![[1, 2, 0], [2, 3, 0], [3, 4, 0]]),
    ];
    for (mode, expected) in cases {
        for indices in [None, Some(&[0u32, 1, 2, 3, 4][..])] {
            let mut f = Fixture::with_triangles(&p, indices);
            f.json["meshes"][0]["primitives"][0]["mode"] = json!(mode);
            let scene = f.open();
            let expected: Vec<_> = expected.iter().map(|t| t.map(corner)).collect();
            let found = world_triangles(&scene);
            assert_same_triangles(&found, &expected, 1e-12);
            // The source numbers count in the order of the primitive.
            for (t, &source) in scene.meshes[0].triangles.iter().enumerate() {
                assert_same_triangles(&found[t..=t], &expected[source as usize..][..1], 1e-12);
            }
            assert_eq!(scene.report.warnings.is_empty(), mode != 4, "left-over indices");
        }
    }
    for mode in 0..4 {
        let mut f = Fixture::with_triangles(&p, None);
        f.json["meshes"][0]["primitives"][0]["mode"] = json!(mode);
        let scene = f.open();
        assert_eq!(scene.objects.len(), 0);
        assert_eq!(scene.report.skipped.points + scene.report.skipped.lines, 1);
    }
}

#[test]
fn degenerate_triangles_are_dropped_and_counted_and_others_keep_their_numbers() {
    let p = [[0.0; 3], [1.0, 1.0, 1.0], [3.0, 3.0, 3.0], [1.0, 0.0, 0.0]];
    let scene = Fixture::with_triangles(&p, Some(&[0, 1, 2, 0, 0, 3, 0, 1, 3, 3, 2, 0])).open();
    let report = &scene.report;
    assert_eq!((report.degenerate_triangles, report.unique_triangles), (2, 2));
    assert_eq!(report.degenerate[0].triangles, [0, 1]);
    let mut sources = scene.meshes[0].triangles.to_vec();
    sources.sort_unstable();
    assert_eq!(sources, [2, 3]);
}

#[test]
fn equal_accessors_share_a_body_and_different_ones_do_not() {
    let mut f = Fixture::square();
    let same = f.json["meshes"][0]["primitives"][0].clone();
    let mesh = f.mesh(same.clone());
    f.root(json!({"mesh": mesh, "translation": [5, 0, 0]}));
    f.root(json!({"mesh": 0, "translation": [9, 0, 0]}));
    let mut fan = same;
    fan["mode"] = json!(6);
    let mesh = f.mesh(fan);
    f.root(json!({"mesh": mesh, "translation": [12, 0, 0]}));
    let scene = f.open();
    assert_eq!((scene.geometry.meshes.len(), scene.geometry.instances.len()), (2, 4));
    assert_eq!((scene.meshes[0].mesh, scene.meshes[1].mesh), (0, 2));
}

#[test]
fn see_through_follows_materials_and_patterns() {
    let mut f = Fixture::square();
    f.json["materials"] = json!([{}, {"alphaMode": "OPAQUE"}, {"alphaMode": "MASK"},
        {"alphaMode": "BLEND"},
        {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.5}}},
        {"extensions": {"KHR_materials_transmission": {}}}]);
    let base = f.json["meshes"][0]["primitives"][0].clone();
    for material in 0..6 {
        let mut primitive = base.clone();
        primitive["material"] = json!(material);
        let mesh = f.mesh(primitive);
        f.root(json!({"name": format!("m{material}"), "mesh": mesh}));
    }
    let hides = |scene: &Scene| -> Vec<(String, bool)> {
        let mut list: Vec<_> = scene.objects.iter().map(|o| (o.name.clone(), o.occluder)).collect();
        list.sort();
        list
    };
    let expected = [true, true, false, false, false, true];
    let scene = f.open();
    assert_eq!(scene.geometry.meshes.len(), 1, "materials do not split bodies");
    for (i, (name, occluder)) in hides(&scene).iter().take(6).enumerate() {
        assert_eq!((name.as_str(), *occluder), (format!("m{i}").as_str(), expected[i]));
    }
    assert_eq!(scene.report.see_through_triangles, 6);
    let scene = open_with(&f, &["m?", "no*thing"]);
    assert_eq!(scene.objects.iter().filter(|o| o.occluder).count(), 1, "only `thing` is left");

    let mut f = Fixture::square();
    f.json["nodes"][0] = json!({"name": "house", "children": [1]});
    f.node(json!({"children": [2]}));
    f.node(json!({"name": "pane", "mesh": 0}));
    let scene = open_with(&f, &["house/**"]);
    assert_eq!(scene.objects[0].path, "house/#1/pane");
    assert!(!scene.objects[0].occluder);
}

#[test]
fn sparse_accessors_replace_elements_with_and_without_a_base() {
    let mut f = Fixture::square();
    let indices = f.view(&[2]);
    let bytes: Vec<u8> = [4.0f32, 4.0, 4.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let values = f.view(&bytes);
    let sparse = json!({"count": 1, "indices": {"bufferView": indices, "componentType": 5121},
        "values": {"bufferView": values}});
    f.json["accessors"][0]["sparse"] = sparse;
    let scene = f.open();
    let corners: Vec<[f64; 3]> = world_triangles(&scene).into_iter().flatten().collect();
    assert!(corners.contains(&[4.0; 3]) && !corners.contains(&[1.0, 1.0, 0.0]));
    f.json["accessors"][0].as_object_mut().unwrap().remove("bufferView");
    assert_eq!(f.open().report.degenerate_triangles, 2, "all zero but one vertex");
}

#[test]
fn quantized_positions_are_read_as_the_specification_says() {
    // Component type, normalized, stored corner (1, 1, -1 where signed), expected value of 1.
    for (component, normalized, largest) in [
        (5120, true, 127i32),
        (5121, true, 255),
        (5122, true, 32767),
        (5123, true, 65535),
        (5120, false, 100),
        (5121, false, 200),
        (5122, false, -20000),
        (5123, false, 60000),
    ] {
        let size = if component < 5122 { 1 } else { 2 };
        let corners: [[i32; 3]; 3] = [[0, 0, 0], [largest, 0, 0], [0, largest, largest]];
        let mut bytes = Vec::new();
        for corner in corners {
            for v in corner {
                bytes.extend_from_slice(&v.to_le_bytes()[..size]);
            }
            bytes.resize(bytes.len().next_multiple_of(4), 0);
        }
        let mut f = Fixture::new();
        let position = f.accessor(&bytes, component, "VEC3", 3);
        f.json["bufferViews"][0]["byteStride"] = json!(bytes.len() / 3);
        f.json["accessors"][position as usize]["normalized"] = json!(normalized);
        let mesh = f.mesh(json!({"attributes": {"POSITION": position}}));
        f.root(json!({"mesh": mesh}));
        let one = if normalized { 1.0 } else { f64::from(largest) };
        let expected = [[[0.0; 3], [one, 0.0, 0.0], [0.0, one, one]]];
        assert_same_triangles(&world_triangles(&f.open()), &expected, 1e-12);
    }
}

#[test]
fn gpu_instances_are_numbered_instances_of_one_object() {
    let mut f = Fixture::square();
    let translation = f.floats(&[[8.0, 0.0, 0.0], [0.0, 0.0, 0.0], [4.0, 0.0, 0.0f32]]);
    let scale = f.floats(&[[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [1.0, 1.0, 1.0f32]]);
    let turn = f.accessor(&[0, 0, 0, 127, 0, 0, 0, 127, 0, 0, 127, 0], 5120, "VEC4", 3);
    f.json["accessors"][turn as usize]["normalized"] = json!(true);
    f.json["nodes"][0]["translation"] = json!([0, 10, 0]);
    f.json["nodes"][0]["extensions"] = json!({"EXT_mesh_gpu_instancing":
        {"attributes": {"TRANSLATION": translation, "SCALE": scale, "ROTATION": turn}}});
    let scene = f.open();
    assert_eq!((scene.objects.len(), scene.geometry.meshes.len()), (1, 1));
    assert_eq!(scene.objects[0].primitives, 0..6);
    let at = |number: u32, point: [f64; 3]| {
        let i = scene.instances.iter().position(|i| i.gpu_instance == Some(number)).unwrap();
        scene.geometry.instances[i].world_from_mesh.transform_point3(point.into())
    };
    assert_eq!(at(0, [1.0, 1.0, 0.0]).to_array(), [9.0, 11.0, 0.0]);
    assert_eq!(at(1, [1.0, 1.0, 0.0]).to_array(), [2.0, 12.0, 0.0]);
    let turned = at(2, [1.0, 1.0, 0.0]);
    assert!(turned.abs_diff_eq([3.0, 9.0, 0.0].into(), 1e-12), "half a turn about z");
}

#[test]
fn morph_weights_at_rest_are_applied() {
    let mut f = Fixture::square();
    let delta = f.floats(&[[0.0, 0.0, 2.0f32]; 4]);
    f.json["meshes"][0]["primitives"][0]["targets"] = json!([{"POSITION": delta}, {}]);
    f.json["meshes"][0]["weights"] = json!([0.5, 1.0]);
    let z = |scene: &Scene| world_triangles(scene)[0][0][2];
    assert_eq!(z(&f.open()), 1.0);
    f.json["nodes"][0]["weights"] = json!([0.25, 0.0]);
    assert_eq!(z(&f.open()), 0.5);
    f.json["nodes"][0]["weights"] = json!([0.0, 0.0]);
    assert_eq!(z(&f.open()), 0.0);
}

#[test]
fn hidden_and_unreached_nodes_are_left_out() {
    let mut f = Fixture::square();
    f.root(json!({"children": [2], "extensions": {"KHR_node_visibility": {"visible": false}}}));
    f.node(json!({"mesh": 0}));
    f.node(json!({"mesh": 0}));
    let scene = f.open();
    assert_eq!((scene.objects.len(), scene.report.hidden_nodes), (1, 1));
    // Without any scene, all root nodes are taken.
    f.json.as_object_mut().unwrap().remove("scene");
    f.json["scenes"] = json!([]);
    assert_eq!(f.open().objects.len(), 2);
}

#[test]
fn numbering_is_a_function_of_the_content_alone() {
    let mut f = Fixture::square();
    let mut nodes: Vec<_> = (0..40)
        .map(|i| {
            json!({"name": format!("n{i}"), "mesh": 0,
            "translation": [(i * 7) % 13 * 3, (i * 5) % 11 * 3, i]})
        })
        .collect();
    let set = |f: &mut Fixture, nodes: &[serde_json::Value]| {
        f.json["nodes"] = json!(nodes);
        f.json["scenes"][0]["nodes"] = json!((0..nodes.len()).collect::<Vec<_>>());
    };
    set(&mut f, &nodes);
    let a = f.open();
    nodes.reverse();
    set(&mut f, &nodes);
    let b = f.open();
    let names = |s: &Scene| s.objects.iter().map(|o| o.name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&a), names(&b));
    assert_eq!(world_triangles(&a), world_triangles(&b));
    assert_eq!(a.geometry.instances[3].object, ObjectId(3));
    let single = || rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let c = single().install(|| f.open());
    assert_eq!(world_triangles(&b), world_triangles(&c));
    assert_eq!(b.report, c.report);
}

#[test]
fn a_gltf_with_a_data_uri_equals_its_glb() {
    let f = Fixture::square();
    let (a, b) = (f.open(), fixtures::open_bytes(&f.gltf()).unwrap());
    assert_eq!(world_triangles(&a), world_triangles(&b));
    assert_ne!(a.digest, b.digest);
}

#[test]
fn fifty_million_instanced_triangles_take_the_memory_of_one_mesh() {
    // A grid of 32 x 16 quads: 1,024 triangles; 53,600 instances: 54.9 M triangles.
    let (w, h) = (32u32, 16u32);
    let p: Vec<[f32; 3]> = (0..=h)
        .flat_map(|y| (0..=w).map(move |x| [x as f32, y as f32, ((x * y) % 5) as f32]))
        .collect();
    let t: Vec<u32> = (0..h)
        .flat_map(|y| (0..w).map(move |x| y * (w + 1) + x))
        .flat_map(|v| [v, v + 1, v + w + 2, v, v + w + 2, v + w + 1])
        .collect();
    let mut f = Fixture::with_triangles(&p, Some(&t));
    let at: Vec<[f32; 3]> =
        (0..53_600u32).map(|i| [(i % 200 * 40) as f32, 0.0, (i / 200 * 40) as f32]).collect();
    let translation = f.floats(&at);
    f.json["nodes"][0]["extensions"] =
        json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": translation}}});
    let scene = f.open();
    assert_eq!(scene.report.instanced_triangles, 54_886_400);
    assert_eq!(scene.report.unique_triangles, 1024);
}

#[test]
fn real_meshopt_files_equal_their_fallback() {
    let Some(scenes) = scenes() else { return };
    let folder = scenes.join("import/compressed");
    for extension in ["EXT_meshopt_compression", "KHR_meshopt_compression"] {
        let open_one = |name: &str| {
            open(&folder.join(extension).join(name).join(format!("{name}.gltf"))).unwrap()
        };
        let (decoded, with_fallback) =
            (open_one("meshopt-no-fallback"), open_one("meshopt-fallback"));
        assert!(decoded.report.unique_triangles > 0);
        assert_same_triangles(&world_triangles(&decoded), &world_triangles(&with_fallback), 1e-9);
        // The same file without its extension: the fallback buffer alone.
        let path = folder.join(extension).join("meshopt-fallback/meshopt-fallback.gltf");
        let mut json: serde_json::Value =
            serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        for view in json["bufferViews"].as_array_mut().unwrap() {
            view.as_object_mut().unwrap().remove("extensions");
        }
        let plain = serde_json::to_vec(&json).unwrap();
        let plain = Scene::open_bytes(&path, &plain, &OpenOptions::default()).unwrap();
        let plain = world_triangles(&plain);
        assert_same_triangles(&world_triangles(&with_fallback), &plain, 1e-9);
    }
}

#[test]
fn a_real_draco_file_decodes_to_the_bounds_and_counts_it_states() {
    let Some(scenes) = scenes() else { return };
    let scene = open(&scenes.join("import/draco/DracoSparseMesh.gltf")).unwrap();
    let report = &scene.report;
    // The file states 306 indices and 62 vertices.
    assert_eq!(report.unique_triangles + report.degenerate_triangles, 102);
    assert!(report.unique_vertices <= 62);
    let bounds = scene.geometry.meshes[0].bounds;
    let stated = [
        [-0.039651595056056976, 0.04958648979663849, 0.028698956593871117],
        [-0.013482682406902313, 0.0891258493065834, 0.031650591641664505],
    ];
    // Quantization moves vertices by at most one step of 2^-11 of the box.
    let step = 0.04 / 2048.0;
    assert!(bounds.min.abs_diff_eq(stated[0].into(), step), "{bounds:?}");
    assert!(bounds.max.abs_diff_eq(stated[1].into(), step), "{bounds:?}");
}

#[test]
fn real_primitive_modes_agree_on_the_triangles() {
    let Some(scenes) = scenes() else { return };
    let folder = scenes.join("import/asset-generator/Positive/Mesh_PrimitiveMode");
    let mut first: Option<Vec<_>> = None;
    for (i, file) in fixtures::files_below(&folder).iter().enumerate() {
        let scene = open(file).unwrap();
        let triangles = rounded_triangles(&scene);
        // Files 0 to 3 and 7 to 10 hold points and lines.
        if triangles.is_empty() {
            assert!(scene.report.skipped.points + scene.report.skipped.lines > 0, "file {i}");
            continue;
        }
        // Strips, fans and lists cut the same square along either diagonal.
        let mut corners: Vec<_> = triangles.iter().flatten().copied().collect();
        corners.sort_unstable();
        corners.dedup();
        let first = first.get_or_insert_with(|| corners.clone());
        assert_eq!(*first, corners, "{}", file.display());
        assert_eq!(triangles.len(), 2, "{}", file.display());
    }
    assert!(first.is_some());
    let modes = open(&scenes.join("animated/MeshPrimitiveModes/glTF/MeshPrimitiveModes.gltf"));
    let modes = modes.unwrap();
    // List, strip and fan, without and with indices, stand apart but are congruent.
    let area = |o: &sightline_scene::Object| {
        let t = o.primitives.clone().map(|p| {
            let [a, b, c] = modes.geometry.triangle(sightline_geometry::PrimitiveId(p)).corners;
            (b - a).cross(c - a).length() / 2.0
        });
        (t.sum::<f64>() * 1e6).round() as i64
    };
    let areas: Vec<_> = modes.objects.iter().map(area).collect();
    assert!(!areas.is_empty());
    assert!(areas.iter().all(|a| *a == areas[0]), "{areas:?}");
}

#[test]
fn the_hospital_and_its_gpu_instanced_twin_hold_the_same_triangles() {
    let Some(scenes) = scenes() else { return };
    let a = open(&scenes.join("indoor/hospital_three_floors.glb")).unwrap();
    let b = open(&scenes.join("indoor/hospital_three_floors_gpuinst.glb")).unwrap();
    assert_same_triangles(&world_triangles(&a), &world_triangles(&b), 1e-4);
}

/// Boxes that are equal, have no extent in `f32` areas, or differ wildly in size: nothing that a
/// hierarchy builder can order by.
#[test]
fn geometry_that_cannot_be_sorted_is_read_in_time() {
    let many = 20_000u32;
    let mut times = Vec::new();
    let mut timed = |what: &str, f: &Fixture| {
        let began = std::time::Instant::now();
        let scene = f.open();
        times.push(format!("{what}: {:?}", began.elapsed()));
        assert!(began.elapsed().as_secs() < 5, "{times:?}");
        scene.report
    };
    let equal: Vec<u32> = (0..many).flat_map(|_| [0, 1, 2]).collect();
    for size in [1e-40_f32, 1e-20, 1.0, 1e14] {
        let p = [[size, 0.0, 0.0], [size, size, 0.0], [size, 0.0, size]];
        let f = Fixture::with_triangles(&p, Some(&equal));
        let report = timed(&format!("equal triangles of {size} m"), &f);
        assert_eq!(report.unique_triangles, u64::from(many));
    }
    let tiny: Vec<[f32; 3]> = (0..many)
        .flat_map(|i| {
            let x = 1e-30 * i as f32;
            [[x, 0.0, 0.0], [x, 1e-30, 0.0], [x, 0.0, 1e-30]]
        })
        .collect();
    timed("tiny triangles", &Fixture::with_triangles(&tiny, None));
    // A geometric row: each triangle twice as large as the one before.
    let row: Vec<[f32; 3]> = (-120..40)
        .flat_map(|i| [[0.0; 3], [2f32.powi(i), 0.0, 0.0], [0.0, 2f32.powi(i), 0.0]])
        .collect();
    assert_eq!(timed("row", &Fixture::with_triangles(&row, None)).unique_triangles, 160);
    let mut f = Fixture::square();
    let translation = f.floats(&vec![[7.0f32; 3]; many as usize]);
    f.json["nodes"][0]["extensions"] =
        json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": translation}}});
    assert_eq!(timed("equal instances", &f).instances, u64::from(many));
}

/// Thousands of primitives that share one array of all vertices must not read it each.
#[test]
fn primitives_that_share_all_vertices_are_read_in_time() {
    let vertices: Vec<[f32; 3]> =
        (0..300_000u32).map(|i| [i as f32, (i % 2) as f32, 0.0]).collect();
    let mut f = Fixture::with_triangles(&vertices, Some(&[0, 1, 2]));
    let base = f.json["meshes"][0]["primitives"][0].clone();
    let primitives: Vec<_> = (0..5000u32)
        .map(|i| {
            let mut primitive = base.clone();
            primitive["indices"] = f.indices(&[i * 50, i * 50 + 1, i * 50 + 3]).into();
            primitive
        })
        .collect();
    f.json["meshes"][0]["primitives"] = json!(primitives);
    let began = std::time::Instant::now();
    let scene = f.open();
    assert!(began.elapsed().as_secs() < 20, "{:?}", began.elapsed());
    assert_eq!((scene.report.unique_triangles, scene.report.unique_vertices), (5000, 15_000));
    let first = world_triangles(&scene).into_iter().find(|t| t[0][0] == 50.0).unwrap();
    assert_eq!(first.map(|c| c[0]), [50.0, 51.0, 53.0]);
}
