//! What the generated scenes promise, read from their bytes without the scene reader, and that
//! the scene reader opens them.

mod fixtures;

use std::collections::HashMap;
use std::path::Path;

use fixtures::assert_valid;
use glam::{DAffine3, DQuat, DVec3};
use serde_json::Value;
use sightline_geometry::Sphere;
use sightline_scene::generate::{
    GenerateError, GenerateReport, Kind, SPHERES_RANGE, STATES_RANGE, bouncing_spheres, generate,
};
use sightline_scene::particles::{TableFormat, read_table};
use sightline_scene::{OpenOptions, Scene};

const SWAYING: Kind = Kind::SwayingGrass { states: 10 };

fn bytes_of(kind: Kind, triangles: u64, seed: u64) -> (GenerateReport, Vec<u8>) {
    let mut bytes = vec![];
    let report = generate(kind, triangles, seed, &mut bytes).unwrap();
    assert_eq!(report.bytes, bytes.len() as u64);
    (report, bytes)
}

/// A GLB file as the generators write it: floats and indices without strides.
struct Glb {
    json: Value,
    bin: Vec<u8>,
}

fn number(v: &Value) -> usize {
    v.as_u64().unwrap() as usize
}

impl Glb {
    fn parse(bytes: &[u8]) -> Self {
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
        let json = word(12);
        Self {
            json: serde_json::from_slice(&bytes[20..20 + json]).unwrap(),
            bin: bytes[28 + json..].to_vec(),
        }
    }

    fn accessor(&self, index: &Value) -> (&Value, &[u8]) {
        let a = &self.json["accessors"][number(index)];
        let view = &self.json["bufferViews"][number(&a["bufferView"])];
        (a, &self.bin[number(&view["byteOffset"]) + number(&a["byteOffset"])..])
    }

    fn floats(&self, index: &Value) -> Vec<f32> {
        let (a, bytes) = self.accessor(index);
        assert_eq!(a["componentType"], 5126);
        let width = match a["type"].as_str().unwrap() {
            "SCALAR" => 1,
            "VEC3" => 3,
            _ => 4,
        };
        let count = width * number(&a["count"]);
        bytes[..4 * count].chunks(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
    }

    fn indices(&self, index: &Value) -> Vec<u32> {
        let (a, bytes) = self.accessor(index);
        let count = number(&a["count"]);
        if a["componentType"] == 5123 {
            let two = |c: &[u8]| u32::from(u16::from_le_bytes(c.try_into().unwrap()));
            bytes[..2 * count].chunks(2).map(two).collect()
        } else {
            let four = |c: &[u8]| u32::from_le_bytes(c.try_into().unwrap());
            bytes[..4 * count].chunks(4).map(four).collect()
        }
    }

    /// Triangles of a mesh as corners, mesh space.
    fn mesh(&self, mesh: usize) -> Vec<[DVec3; 3]> {
        let mut out = vec![];
        for primitive in self.json["meshes"][mesh]["primitives"].as_array().unwrap() {
            let p = self.floats(&primitive["attributes"]["POSITION"]);
            let at = |i: u32| {
                let k = 3 * i as usize;
                DVec3::new(p[k].into(), p[k + 1].into(), p[k + 2].into())
            };
            out.extend(
                self.indices(&primitive["indices"])
                    .chunks(3)
                    .map(|t| [at(t[0]), at(t[1]), at(t[2])]),
            );
        }
        out
    }

    /// Every placement: world from mesh, mesh, node name.
    fn placements(&self) -> Vec<(DAffine3, usize, String)> {
        let mut out = vec![];
        let mut stack: Vec<(usize, DAffine3)> = self.json["scenes"][0]["nodes"]
            .as_array()
            .unwrap()
            .iter()
            .map(|n| (number(n), DAffine3::IDENTITY))
            .collect();
        while let Some((n, parent)) = stack.pop() {
            let node = &self.json["nodes"][n];
            let list = |key: &str, or: &[f64]| -> Vec<f64> {
                node[key]
                    .as_array()
                    .map_or(or.to_vec(), |a| a.iter().map(|v| v.as_f64().unwrap()).collect())
            };
            let world = parent
                * DAffine3::from_scale_rotation_translation(
                    DVec3::from_slice(&list("scale", &[1.0; 3])),
                    DQuat::from_slice(&list("rotation", &[0.0, 0.0, 0.0, 1.0])),
                    DVec3::from_slice(&list("translation", &[0.0; 3])),
                );
            if let Some(children) = node["children"].as_array() {
                stack.extend(children.iter().map(|c| (number(c), world)));
            }
            if node["mesh"].is_null() {
                continue;
            }
            let name = node["name"].as_str().unwrap().to_owned();
            let attributes = &node["extensions"]["EXT_mesh_gpu_instancing"]["attributes"];
            if attributes.is_null() {
                out.push((world, number(&node["mesh"]), name));
                continue;
            }
            let wide = |v: Vec<f32>| v.into_iter().map(f64::from).collect::<Vec<_>>();
            let t = wide(self.floats(&attributes["TRANSLATION"]));
            let r = wide(self.floats(&attributes["ROTATION"]));
            let s = wide(self.floats(&attributes["SCALE"]));
            for k in 0..t.len() / 3 {
                let q = DQuat::from_slice(&r[4 * k..]);
                assert!((q.length() - 1.0).abs() < 1e-6);
                let local = DAffine3::from_scale_rotation_translation(
                    DVec3::from_slice(&s[3 * k..]),
                    q,
                    DVec3::from_slice(&t[3 * k..]),
                );
                out.push((world * local, number(&node["mesh"]), name.clone()));
            }
        }
        out
    }

    fn mesh_count(&self) -> usize {
        self.json["meshes"].as_array().unwrap().len()
    }

    fn mesh_name(&self, mesh: usize) -> &str {
        self.json["meshes"][mesh]["name"].as_str().unwrap()
    }
}

fn within_two_percent(wanted: u64, got: u64) {
    assert!(wanted.abs_diff(got) * 50 <= wanted, "wanted {wanted} triangles, got {got}");
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_another_seed_others() {
    for (kind, n) in
        [(Kind::City, 60_000), (Kind::Town, 60_000), (Kind::Grass, 60_000), (SWAYING, 60_000)]
    {
        let a = bytes_of(kind, n, 7);
        assert_eq!(a, bytes_of(kind, n, 7));
        assert_ne!(a.1, bytes_of(kind, n, 8).1);
    }
}

/// Pins the bytes: a change here is a change of every benchmark that names a seed.
#[test]
fn the_bytes_are_pinned() {
    let hash = |kind| blake3::hash(&bytes_of(kind, 60_000, 1).1).to_hex()[..16].to_owned();
    let pinned = [Kind::City, Kind::Town, Kind::Grass, SWAYING].map(hash);
    assert_eq!(
        pinned,
        ["840d1577a877beef", "abd054e4e3fb3f7f", "4a0c0925ce098f0e", "e4045b18bb14d863"]
    );
    let hash = |format| blake3::hash(&spheres_of(2000, 5, 1, format).1).to_hex()[..16].to_owned();
    let pinned = [TableFormat::Parquet, TableFormat::Csv].map(hash);
    assert_eq!(pinned, ["845f84531d1340c7", "3dc1e8557f74f2a0"]);
}

#[test]
fn triangle_counts_are_hit_within_two_percent() {
    for seed in 0..3 {
        for n in [20_000, 50_000, 200_000, 700_000] {
            within_two_percent(n, bytes_of(Kind::City, n, seed).0.triangles);
        }
        for n in [50_000, 200_000, 700_000] {
            within_two_percent(n, bytes_of(Kind::Town, n, seed).0.triangles);
        }
        for n in [20_000, 200_000, 5_000_000, 54_900_000] {
            within_two_percent(n, bytes_of(Kind::Grass, n, seed).0.triangles);
        }
    }
    within_two_percent(5_000_000, bytes_of(Kind::City, 5_000_000, 1).0.triangles);
    within_two_percent(2_300_000, bytes_of(Kind::Town, 2_300_000, 1).0.triangles);
}

#[test]
fn counts_out_of_range_are_refused() {
    for kind in [Kind::City, Kind::Town, Kind::Grass, SWAYING] {
        for n in [0, kind.triangle_range().start() - 1, kind.triangle_range().end() + 1] {
            let result = generate(kind, n, 1, &mut vec![]);
            assert!(matches!(result, Err(GenerateError::Size { requested, .. }) if requested == n));
        }
    }
    for states in [0, STATES_RANGE.end() + 1] {
        let refused = |result| matches!(result, Err(GenerateError::States { requested }) if requested == states);
        assert!(refused(generate(Kind::SwayingGrass { states }, 60_000, 1, &mut vec![])));
        assert!(refused(bouncing_spheres(9, states, 1, TableFormat::Csv, &mut vec![])));
    }
    for n in [0, SPHERES_RANGE.end() + 1] {
        let result = bouncing_spheres(n, 5, 1, TableFormat::Csv, &mut vec![]);
        assert!(matches!(result, Err(GenerateError::Spheres { requested }) if requested == n));
    }
}

#[test]
fn reports_describe_the_file() {
    for (kind, n) in [(Kind::City, 60_000), (Kind::Town, 60_000), (Kind::Grass, 60_000)] {
        let (report, bytes) = bytes_of(kind, n, 3);
        let glb = Glb::parse(&bytes);
        let unique: usize = (0..glb.mesh_count()).map(|m| glb.mesh(m).len()).sum();
        assert_eq!(report.unique_triangles, unique as u64);
        let placements = glb.placements();
        let total: usize = placements.iter().map(|(_, m, _)| glb.mesh(*m).len()).sum();
        assert_eq!(report.triangles, total as u64);
        for (world, mesh, _) in placements {
            for p in glb.mesh(mesh).into_iter().flatten() {
                let p = world.transform_point3(p);
                assert!(p.cmpge(report.bounds.min - 1e-4).all());
                assert!(p.cmple(report.bounds.max + 1e-4).all());
            }
        }
    }
}

#[test]
fn no_triangle_is_degenerate() {
    for (kind, n) in [(Kind::City, 300_000), (Kind::Town, 300_000), (Kind::Grass, 300_000)] {
        let glb = Glb::parse(&bytes_of(kind, n, 5).1);
        for m in 0..glb.mesh_count() {
            for [a, b, c] in glb.mesh(m) {
                let area = 0.5 * (b - a).cross(c - a).length();
                assert!(area > 1e-8, "{}: {a} {b} {c}", glb.mesh_name(m));
            }
        }
    }
}

/// Sheets: the ground, and what carries leaves, blades or petals.
fn is_solid(name: &str) -> bool {
    let sheets = ["ground", "tree ", "shrub", "tuft", "poppy", "daisy", "cornflower"];
    !sheets.iter().any(|s| name.starts_with(s))
}

#[test]
fn buildings_and_furniture_are_watertight() {
    for (kind, n) in [(Kind::City, 300_000), (Kind::City, 1_500_000), (Kind::Town, 400_000)] {
        let glb = Glb::parse(&bytes_of(kind, n, 11).1);
        let mut solids = 0;
        for m in (0..glb.mesh_count()).filter(|&m| is_solid(glb.mesh_name(m))) {
            solids += 1;
            let mut edges: HashMap<[[u64; 3]; 2], i32> = HashMap::new();
            let bits = |p: DVec3| p.to_array().map(f64::to_bits);
            let mut volume = 0.0;
            for t in glb.mesh(m) {
                for k in 0..3 {
                    *edges.entry([bits(t[k]), bits(t[(k + 1) % 3])]).or_default() += 1;
                }
                volume += t[0].dot(t[1].cross(t[2])) / 6.0;
            }
            for (&[a, b], &n) in &edges {
                let back = edges.get(&[b, a]).copied().unwrap_or(0);
                assert_eq!((n, back), (1, 1), "{}", glb.mesh_name(m));
            }
            assert!(volume > 0.0, "{} faces outward", glb.mesh_name(m));
        }
        assert!(solids > 30);
    }
}

/// True when a triangle and a box overlap; conservative by the triangle's box, refined by
/// clipping to the slabs in x and z.
fn reaches_into(t: [DVec3; 3], low: DVec3, high: DVec3) -> bool {
    let mut polygon = t.to_vec();
    for axis in 0..3 {
        for (sign, limit) in [(1.0, low[axis]), (-1.0, -high[axis])] {
            let mut kept = vec![];
            for i in 0..polygon.len() {
                let (p, q): (DVec3, DVec3) = (polygon[i], polygon[(i + 1) % polygon.len()]);
                let (a, b) = (sign * p[axis] - limit, sign * q[axis] - limit);
                if a >= 0.0 {
                    kept.push(p);
                }
                if (a < 0.0) != (b < 0.0) {
                    kept.push(p.lerp(q, a / (a - b)));
                }
            }
            polygon = kept;
        }
    }
    !polygon.is_empty()
}

#[test]
fn the_suggested_region_is_free_from_knee_to_above_the_head() {
    for (kind, n, seed) in [
        (Kind::City, 20_000, 0..4),
        (Kind::City, 200_000, 0..4),
        (Kind::City, 3_700_000, 2..3),
        (Kind::Town, 50_000, 0..4),
        (Kind::Town, 200_000, 0..4),
        (Kind::Town, 2_300_000, 2..3),
    ]
    .into_iter()
    .flat_map(|(kind, n, seeds)| seeds.map(move |seed| (kind, n, seed)))
    {
        let (report, bytes) = bytes_of(kind, n, seed);
        let [x0, z0, x1, z1] = report.suggested_region;
        let (low, high) = (DVec3::new(x0, 0.2, z0), DVec3::new(x1, 3.0, z1));
        let glb = Glb::parse(&bytes);
        let meshes: Vec<_> = (0..glb.mesh_count()).map(|m| glb.mesh(m)).collect();
        for (world, mesh, name) in glb.placements() {
            for t in &meshes[mesh] {
                let t = t.map(|p| world.transform_point3(p));
                assert!(!reaches_into(t, low, high), "{name} stands in the region");
            }
        }
    }
}

#[test]
fn paper_sizes_have_their_view_regions() {
    let (city, _) = bytes_of(Kind::City, 3_700_000, 1);
    assert_eq!(city.suggested_region, [-5.0, -244.5, 5.0, 244.5]);
    let size = city.bounds.size();
    assert!((900.0..1_600.0).contains(&size.x) && (900.0..1_600.0).contains(&size.z), "{size}");
    assert!((120.0..260.0).contains(&size.y), "{size}");
    let (town, _) = bytes_of(Kind::Town, 2_300_000, 1);
    assert_eq!(town.suggested_region, [-5.0, -82.5, 5.0, 82.5]);
}

#[test]
fn a_meadow_of_fifty_million_triangles_is_a_few_megabytes() {
    let (report, bytes) = bytes_of(Kind::Grass, 54_900_000, 1);
    let glb = Glb::parse(&bytes);
    let placements = glb.placements();
    assert!((10_000..=100_000).contains(&placements.len()), "{} instances", placements.len());
    assert!(report.bytes < 6 << 20, "{} bytes", report.bytes);
    for key in ["extensionsUsed", "extensionsRequired"] {
        assert_eq!(glb.json[key], serde_json::json!(["EXT_mesh_gpu_instancing"]));
    }
    assert_eq!(report.suggested_region, [-1.0, -1.0, 1.0, 1.0]);
    // The terrain is the only mesh that is not instanced, and it rolls about y = 0.
    let ground: Vec<_> = (0..glb.mesh_count()).filter(|&m| glb.mesh_name(m) == "ground").collect();
    assert_eq!(ground.len(), 1);
    let heights: Vec<f64> = glb.mesh(ground[0]).into_iter().flatten().map(|p| p.y).collect();
    assert!(heights.iter().all(|y| y.abs() < 6.0));
}

#[test]
fn the_largest_meadow_has_at_most_a_hundred_thousand_instances() {
    let glb = Glb::parse(&bytes_of(Kind::Grass, 100_000_000, 1).1);
    assert!(glb.placements().len() <= 100_000);
}

#[test]
fn the_reader_opens_what_is_generated() {
    let folder = tempfile::tempdir().unwrap();
    for (kind, n) in [(Kind::City, 100_000), (Kind::Town, 100_000), (Kind::Grass, 1_000_000)] {
        let (report, bytes) = bytes_of(kind, n, 4);
        let path: &Path = &folder.path().join(format!("{}.glb", kind.name()));
        std::fs::write(path, bytes).unwrap();
        let scene = Scene::open(path, &OpenOptions::default()).unwrap();
        scene.assert_well_formed();
        assert_eq!(u64::from(scene.geometry.primitive_count()), report.triangles);
        assert_eq!(scene.geometry.unique_triangle_count() as u64, report.unique_triangles);
        let names: Vec<&str> = scene.objects.iter().map(|o| o.name.as_str()).collect();
        assert!(names.contains(&"ground"));
        if kind == Kind::City {
            assert!(names.contains(&"block_0_0/building_0"));
        }
    }
}

#[test]
fn the_swaying_meadow_at_rest_is_the_meadow() {
    let still = Glb::parse(&bytes_of(Kind::Grass, 300_000, 3).1);
    let (report, bytes) = bytes_of(SWAYING, 300_000, 3);
    let swaying = Glb::parse(&bytes);
    assert_eq!(report.states, 10);
    assert_eq!(still.mesh_count(), swaying.mesh_count());
    for m in 0..still.mesh_count() {
        assert_eq!(still.mesh(m), swaying.mesh(m));
    }
    let shape = |glb: &Glb| -> Vec<_> {
        glb.placements()
            .into_iter()
            .map(|(world, mesh, name)| (world.translation, mesh, name))
            .collect()
    };
    assert_eq!(shape(&still), shape(&swaying));
}

#[test]
fn in_the_wind_all_blades_and_flowers_move_and_the_ground_rests() {
    let glb = Glb::parse(&bytes_of(SWAYING, 300_000, 3).1);
    for m in 0..glb.mesh_count() {
        for primitive in glb.json["meshes"][m]["primitives"].as_array().unwrap() {
            let Some(targets) = primitive["targets"].as_array() else {
                assert_eq!(glb.mesh_name(m), "ground");
                continue;
            };
            let positions = glb.floats(&primitive["attributes"]["POSITION"]);
            let targets: Vec<Vec<f32>> =
                targets.iter().map(|t| glb.floats(&t["POSITION"])).collect();
            assert_eq!(targets.len(), 2);
            let displaced = |t: &[f32], v: usize| {
                DVec3::new(t[3 * v].into(), t[3 * v + 1].into(), t[3 * v + 2].into()).length()
            };
            for v in 0..positions.len() / 3 {
                let height = positions[3 * v + 1];
                for target in &targets {
                    let way = displaced(target, v);
                    assert_eq!(way > 0.0, height > -0.0599, "{height} m: {way} m");
                    if (0.49..0.51).contains(&height) {
                        assert!((0.02..0.05).contains(&way), "{way} m, to either side");
                    }
                }
            }
            for t in glb.indices(&primitive["indices"]).chunks(3) {
                assert!(t.iter().any(|&v| displaced(&targets[0], v as usize) > 0.0));
            }
        }
    }
    // Every node of a model sways, in one of few ways.
    let animation = &glb.json["animations"][0];
    let (channels, samplers) =
        (animation["channels"].as_array().unwrap(), animation["samplers"].as_array().unwrap());
    let nodes = glb.json["nodes"].as_array().unwrap().iter();
    assert_eq!(channels.len(), nodes.filter(|n| !n["extensions"].is_null()).count());
    assert_eq!(samplers.len(), 4);
    for sampler in samplers {
        let times = glb.floats(&sampler["input"]);
        assert_eq!((times.len(), times[0], times[10]), (11, 0.0, 2.5));
        assert_eq!(glb.floats(&sampler["output"]).len(), 22);
    }
}

#[test]
fn the_swaying_meadow_passes_the_validator() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("meadow.glb");
    std::fs::write(&path, bytes_of(SWAYING, 60_000, 1).1).unwrap();
    assert_valid(&[&path]);
}

fn spheres_of(
    count: u64,
    states: u32,
    seed: u64,
    format: TableFormat,
) -> (GenerateReport, Vec<u8>) {
    let mut bytes = vec![];
    let report = bouncing_spheres(count, states, seed, format, &mut bytes).unwrap();
    assert_eq!(report.bytes, bytes.len() as u64);
    assert_eq!((report.particles, report.states), (count, states));
    (report, bytes)
}

#[test]
fn spheres_bounce_apart_from_each_other_and_come_to_rest() {
    let folder = tempfile::tempdir().unwrap();
    for (name, format) in [("a.parquet", TableFormat::Parquet), ("a.csv", TableFormat::Csv)] {
        let path = folder.path().join(name);
        let (report, bytes) = spheres_of(10_000, 25, 1, format);
        assert_eq!(bytes, spheres_of(10_000, 25, 1, format).1);
        assert_ne!(bytes, spheres_of(10_000, 25, 2, format).1);
        std::fs::write(&path, bytes).unwrap();
        let table = read_table(&path, 1 << 20).unwrap();
        assert_eq!((table.keys.len(), table.ids.len(), table.key_times[25]), (26, 10_000, 5.0));
        let low = |s: &Sphere| s.center().y + table.origin.y - f64::from(s.radius);
        let last = &table.keys[25];
        assert!(last.iter().all(|s| low(s) == 0.0), "all rest on the ground");
        assert!(table.keys.iter().flatten().all(|s| low(s) >= 0.0), "none is in the ground");
        let high = |key: usize| table.keys[key].iter().map(low).sum::<f64>() / 10_000.0;
        assert!(high(0) > 1.2 && high(12) < high(0) && high(20) < 0.2, "they lose energy");
        // A column of 1 m each: none ever meets another.
        let mut columns: Vec<[i64; 2]> = vec![];
        for s in last {
            let (at, r) = (s.center() + table.origin, f64::from(s.radius));
            assert_eq!((at.x - r).floor(), (at.x + r).ceil() - 1.0);
            assert_eq!((at.z - r).floor(), (at.z + r).ceil() - 1.0);
            columns.push([at.x.floor() as i64, at.z.floor() as i64]);
        }
        columns.sort_unstable();
        columns.dedup();
        assert_eq!(columns.len(), 10_000);
        let size = report.bounds.size();
        assert!((99.0..=100.0).contains(&size.x) && (99.0..=100.0).contains(&size.z), "{size}");
        let scene = Scene::open(&path, &OpenOptions::default()).unwrap();
        scene.assert_well_formed();
        assert_eq!((scene.geometry.states, scene.geometry.primitive_count()), (25, 10_000));
    }
}
