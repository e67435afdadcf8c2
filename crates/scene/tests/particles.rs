//! What particle tables promise: the same scene from either format and any order of rows, positions
//! that hold far from the origin, numbers that lead back to the author's, and refusals that name the row
//! and the column.

mod fixtures;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow_array::{ArrayRef, Float32Array, Float64Array, Int64Array, RecordBatch, UInt64Array};
use fixtures::{Fixture, assert_valid, golden, mutate::Rng};
use glam::DVec3;
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, GzipLevel};
use parquet::file::properties::WriterProperties;
use proptest::prelude::*;
use sightline_geometry::{Moment, PrimitiveId, PrimitiveSet, Shape, Sphere};
use sightline_scene::export::export_visible;
use sightline_scene::particles::{NO_NODE, TableFormat, TableWriter, read_table};
use sightline_scene::{Cause, OpenOptions, Scene, SceneError, TableProblem, digest, digest_with};

fn open(name: &str, bytes: impl AsRef<[u8]>) -> Result<Scene, SceneError> {
    let path = Path::new("memory").join(name);
    let scene = Scene::open_bytes(&path, bytes.as_ref(), &OpenOptions::default())?;
    scene.assert_well_formed();
    Ok(scene)
}

fn problem(name: &str, bytes: impl AsRef<[u8]>) -> TableProblem {
    let error = open(name, bytes).unwrap_err();
    assert_eq!(error.file, Path::new("memory").join(name));
    assert!(error.help().is_some());
    match *error.cause {
        Cause::Table(problem) => problem,
        other => panic!("{other}"),
    }
}

/// Three key frames of three particles; particle 40 is not there at the second.
const CSV: &str = "\
state,time,particle,x,y,z,radius
0,0,7,1,2,3,0.5
0,0,40,-4,0,0,0.25
0,0,9,0,8,0,1
1,0.5,9,0,4,0,1
1,0.5,7,2,2,3,0.5
2,2,40,-4,0,8,0.25
2,2,7,3,2,3,1.5
2,2,9,0,1,0,1
";

fn table(format: TableFormat, keys: &[(f64, Vec<(u32, Sphere)>)]) -> Vec<u8> {
    let mut writer = TableWriter::new(format, Vec::new()).unwrap();
    for (time, spheres) in keys {
        writer.key_frame(*time, spheres).unwrap();
    }
    writer.finish().unwrap()
}

/// A Parquet file with columns of any type.
fn parquet(columns: Vec<(&str, ArrayRef)>, compression: Compression) -> Vec<u8> {
    let batch = RecordBatch::try_from_iter(columns).unwrap();
    let properties = WriterProperties::builder().set_compression(compression).build();
    let mut writer = ArrowWriter::try_new(Vec::new(), batch.schema(), Some(properties)).unwrap();
    writer.write(&batch).unwrap();
    writer.into_inner().unwrap()
}

/// The spheres of a scene by the author's numbers, at a moment.
fn spheres(scene: &Scene, moment: Moment) -> Vec<(u32, Shape)> {
    let mut found: Vec<(u32, Shape)> = scene
        .geometry
        .particles
        .iter()
        .zip(&scene.particles)
        .flat_map(|(system, source)| {
            let first = system.first_primitive.0;
            source
                .ids
                .iter()
                .zip(first..)
                .map(|(id, p)| (*id, scene.geometry.shape(PrimitiveId(p), moment)))
        })
        .collect();
    found.sort_by_key(|(id, _)| *id);
    found
}

fn sphere(x: f64, y: f64, z: f64, radius: f64) -> Shape {
    Shape::Sphere { center: DVec3::new(x, y, z), radius }
}

#[test]
fn a_table_is_a_scene_of_its_own() {
    let scene = open("drops.csv", CSV).unwrap();
    assert_eq!(scene.key_times, [0.0, 0.5, 2.0]);
    assert_eq!((scene.geometry.states, scene.geometry.primitive_count()), (2, 3));
    assert_eq!(scene.geometry.triangle_count(), 0);
    let object = &scene.objects[0];
    assert_eq!((object.name.as_str(), object.node), ("drops", NO_NODE));
    assert_eq!((object.primitives.clone(), object.occluder), (0..3, true));
    assert_eq!(object.bounds.min, DVec3::new(-4.25, -0.25, -1.0));
    assert_eq!(object.bounds.max, DVec3::new(4.5, 9.0, 8.25));
    assert_eq!((scene.report.particles, scene.report.instanced_triangles), (3, 0));
    let at = |state, t| spheres(&scene, Moment { state, t });
    assert_eq!(
        at(0, 0.5),
        [(7, sphere(1.5, 2.0, 3.0, 0.5)), (9, sphere(0.0, 6.0, 0.0, 1.0)), (40, Shape::Absent)]
    );
    assert_eq!(at(1, 1.0)[0], (7, sphere(3.0, 2.0, 3.0, 1.5)));
}

#[test]
fn format_and_order_of_the_rows_do_not_matter() {
    let csv = open("drops.csv", CSV).unwrap();
    let mut lines: Vec<&str> = CSV.lines().collect();
    lines.swap(1, 3);
    lines.swap(6, 8);
    let shuffled = open("drops.csv", lines.join("\r\n")).unwrap();
    let sphere = |x, y, z, radius| Sphere { center: [x, y, z], radius };
    let keys = [
        (
            0.0,
            vec![
                (40, sphere(-4.0, 0.0, 0.0, 0.25)),
                (7, sphere(1.0, 2.0, 3.0, 0.5)),
                (9, sphere(0.0, 8.0, 0.0, 1.0)),
            ],
        ),
        (
            0.5,
            vec![
                (7, sphere(2.0, 2.0, 3.0, 0.5)),
                (40, Sphere::ABSENT),
                (9, sphere(0.0, 4.0, 0.0, 1.0)),
            ],
        ),
        (
            2.0,
            vec![
                (7, sphere(3.0, 2.0, 3.0, 1.5)),
                (9, sphere(0.0, 1.0, 0.0, 1.0)),
                (40, sphere(-4.0, 0.0, 8.0, 0.25)),
            ],
        ),
    ];
    let parquet = open("drops.parquet", table(TableFormat::Parquet, &keys)).unwrap();
    let written = open("drops.CSV", table(TableFormat::Csv, &keys)).unwrap();
    for other in [shuffled, parquet, written] {
        assert_eq!(other.geometry.particles[0].keys, csv.geometry.particles[0].keys);
        assert_eq!(other.particles[0].ids, csv.particles[0].ids);
        assert_eq!(other.key_times, csv.key_times);
    }
}

#[test]
fn a_table_without_key_frames_rests() {
    let csv = "note, particle, radius, x, y, z\nhello, 3, 1, 0, 0, 0\n\"a, b\", 2, 1, 5, 0, 0\n";
    let scene = open("stones.csv", csv).unwrap();
    assert_eq!((scene.key_times.as_slice(), scene.geometry.states), (&[0.0][..], 1));
    assert!(!scene.geometry.has_motion());
    assert_eq!(spheres(&scene, Moment::START)[0].0, 2);
}

#[test]
fn without_times_a_state_takes_a_second() {
    let csv = "particle,x,y,z,radius,state\n1,0,0,0,1,0\n1,1,0,0,1,1\n1,2,0,0,1,2\n";
    assert_eq!(open("a.csv", csv).unwrap().key_times, [0.0, 1.0, 2.0]);
}

#[test]
fn positions_hold_far_from_the_origin() {
    let row =
        |k: u32| format!("{k},{:.6},{:.6},{:.6},0.01\n", 1e7 + 0.001 * f64::from(k), 50.0, -3e6);
    let csv = "particle,x,y,z,radius\n".to_owned() + &(0..100).map(row).collect::<String>();
    let scene = open("far.csv", csv).unwrap();
    for (k, shape) in spheres(&scene, Moment::START) {
        let Shape::Sphere { center, .. } = shape else { panic!("{k} is there") };
        let wanted = DVec3::new(1e7 + 0.001 * f64::from(k), 50.0, -3e6);
        assert!((center - wanted).length() < 1e-6, "{k}: {center}");
    }
}

#[test]
fn tables_of_other_writers_are_read() {
    let columns = || -> Vec<(&str, ArrayRef)> {
        let f64s = |v: [f64; 2]| Arc::new(Float64Array::from(v.to_vec())) as ArrayRef;
        vec![
            ("radius", Arc::new(Float32Array::from(vec![1.0, 2.0]))),
            ("particle", Arc::new(Int64Array::from(vec![4_294_967_295, 0]))),
            ("x", f64s([1.5, -1.0])),
            ("y", Arc::new(Int64Array::from(vec![0, 0]))),
            ("color", Arc::new(arrow_array::StringArray::from(vec!["red", "blue"]))),
            ("z", f64s([0.0, 1.0])),
            ("state", Arc::new(UInt64Array::from(vec![0, 0]))),
        ]
    };
    for compression in [
        Compression::UNCOMPRESSED,
        Compression::SNAPPY,
        Compression::LZ4,
        Compression::LZ4_RAW,
        Compression::GZIP(GzipLevel::default()),
        Compression::ZSTD(Default::default()),
    ] {
        let scene = open("a.parquet", parquet(columns(), compression)).unwrap();
        assert_eq!(
            spheres(&scene, Moment::START),
            [(0, sphere(-1.0, 0.0, 1.0, 2.0)), (u32::MAX, sphere(1.5, 0.0, 0.0, 1.0))]
        );
    }
}

fn write(folder: &Path, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn tables_are_added_behind_the_triangles_of_a_scene() {
    let folder = tempfile::tempdir().unwrap();
    let glb = write(folder.path(), "square.glb", Fixture::square().glb());
    let drops = write(folder.path(), "drops.csv", CSV);
    let mist = write(folder.path(), "mist.csv", "particle,x,y,z,radius\n5,0,0,0,1\n6,9,0,0,1\n");
    let mut options = OpenOptions::default();
    options.particles = vec![drops.clone(), mist.clone()];
    options.see_through = vec!["mi*".into()];
    let scene = Scene::open(&glb, &options).unwrap();
    scene.assert_well_formed();
    let names: Vec<&str> = scene.objects.iter().map(|o| o.name.as_str()).collect();
    assert_eq!(names[1..], ["drops", "mist"]);
    assert_eq!(scene.geometry.triangle_count(), 2);
    assert_eq!(scene.objects[1].primitives, 2..5);
    assert_eq!(scene.objects[2].primitives, 5..7);
    assert!(scene.objects[1].occluder && !scene.objects[2].occluder);
    assert!(!scene.geometry.particles[1].occluder);
    assert_eq!((scene.report.particles, scene.report.see_through_particles), (5, 2));
    assert_eq!(scene.geometry.states, 2);

    let files: Vec<&str> = scene.digest.files.iter().map(|f| f.name.as_str()).collect();
    assert_eq!(files, ["square.glb", "drops.csv", "mist.csv"]);
    assert_eq!(digest_with(&glb, &options.particles).unwrap(), scene.digest);
    assert_ne!(digest(&glb).unwrap().combined, scene.digest.combined);
    assert_eq!(
        digest(&drops).unwrap(),
        Scene::open(&drops, &OpenOptions::default()).unwrap().digest
    );
}

#[test]
fn key_frames_of_all_tables_are_those_of_the_scene() {
    let folder = tempfile::tempdir().unwrap();
    let slow = "state,particle,x,y,z,radius\n0,1,0,0,0,1\n1,1,8,0,0,1\n2,1,8,4,0,1\n";
    let slow = write(folder.path(), "slow.csv", slow);
    let mut options = OpenOptions::default();
    options.particles = vec![write(folder.path(), "drops.csv", CSV)];
    let scene = Scene::open(&slow, &options).unwrap();
    scene.assert_well_formed();
    assert_eq!(scene.key_times, [0.0, 0.5, 1.0, 2.0]);
    assert_eq!(spheres(&scene, Moment { state: 1, t: 0.5 })[0], (1, sphere(6.0, 0.0, 0.0, 1.0)));
    // Particle 40 is away from before 0.5 s until after it.
    for state in 0..3 {
        let seen = spheres(&scene, Moment { state, t: 0.5 });
        assert_eq!(seen.last(), Some(&(40, Shape::Absent)), "state {state}");
    }
    let at_1_s = spheres(&scene, Moment { state: 2, t: 0.0 });
    let seven = at_1_s.iter().find(|(id, _)| *id == 7).unwrap().1;
    let Shape::Sphere { center, radius } = seven else { panic!("it is there") };
    assert!((center.x - (2.0 + 1.0 / 3.0)).abs() < 1e-6 && (radius - 5.0 / 6.0).abs() < 1e-6);
}

#[test]
fn refusals_name_the_row_the_column_and_what_to_do() {
    let header = "particle,state,time,x,y,z,radius\n";
    for (rows, message) in [
        (
            "1,0,0,0,0,0,0\n",
            "row 0 (line 2), column `radius`: 0 is refused; a sphere has a radius above 0 metres",
        ),
        ("1,0,0,0,0,0,-1\n", "row 0 (line 2), column `radius`: -1 is refused"),
        ("1,0,0,0,0,0,1e-60\n", "column `radius`"),
        ("1,0,0,0,0,0,NaN\n", "column `radius`: NaN is refused"),
        (
            "1,0,0,0,0,0,1\n2,0,0,0,inf,0,1\n",
            "row 1 (line 3), column `y`: inf is refused; coordinates are finite",
        ),
        (
            "1,0,0,0,0,-1e16,1\n",
            "column `z`: -10000000000000000 is refused; spheres lie within 1e15",
        ),
        ("1,0,0,2;5,0,0,1\n", "column `x`: `2;5` is refused; it has to be a number"),
        ("1,0,0,,0,0,1\n", "column `x`: `` is refused; every row has a value"),
        ("-1,0,0,0,0,0,1\n", "column `particle`: `-1` is refused; it has to be a whole number"),
        ("1.5,0,0,0,0,0,1\n", "column `particle`: `1.5`"),
        ("4294967296,0,0,0,0,0,1\n", "column `particle`: `4294967296`"),
        ("1,1,0,0,0,0,1\n", "column `state`: key frame 1 follows nothing"),
        (
            "1,0,0,0,0,0,1\n1,2,2,0,0,0,1\n",
            "row 1 (line 3), column `state`: key frame 2 follows key frame 0",
        ),
        (
            "1,0,0,0,0,0,1\n1,1,1,0,0,0,1\n2,0,0,0,0,0,1\n",
            "column `state`: key frame 0 follows key frame 1",
        ),
        (
            "1,0,0,0,0,0,1\n2,0,0.5,0,0,0,1\n",
            "column `time`: 0.5 s does not fit the 0 s before it; all rows",
        ),
        ("1,0,0,0,0,0,1\n1,1,0,0,0,0,1\n", "later key frames have later times"),
        ("1,0,inf,0,0,0,1\n", "column `time`: inf is refused"),
        (
            "1,0,0,0,0,0,1\n2,0,0,0,0,0,1\n1,0,0,5,0,0,1\n",
            "row 2 (line 4): particle 1 is there a second time at key frame 0",
        ),
        ("1,0,0,0,0,0,1\n1,0,0\n", "at row 1 (line 3): it has 3 fields instead of 7"),
        ("", "the table has no rows"),
    ] {
        let found = problem("a.csv", header.to_owned() + rows).to_string();
        assert!(found.contains(message), "{rows}: {found}");
    }
    for (csv, message) in [
        (
            "particle,x,y,radius\n",
            "there is no column `z`; the columns are `particle`, `x`, `y`, `radius`",
        ),
        ("particle,x,y,z,x,radius\n", "there are two columns `x`"),
        ("", "there is no column `particle`; the columns are none"),
    ] {
        let found = problem("a.csv", csv).to_string();
        assert!(found.contains(message), "{csv}: {found}");
    }
}

#[test]
fn refusals_of_parquet_name_the_row_the_column_and_what_to_do() {
    let f64s = |v: Vec<Option<f64>>| Arc::new(Float64Array::from(v)) as ArrayRef;
    let whole = |v: Vec<i64>| Arc::new(Int64Array::from(v)) as ArrayRef;
    let one = || f64s(vec![Some(1.0); 2]);
    let file = |particle: ArrayRef, x: ArrayRef| {
        let columns =
            vec![("particle", particle), ("x", x), ("y", one()), ("z", one()), ("radius", one())];
        parquet(columns, Compression::UNCOMPRESSED)
    };
    for (bytes, message) in [
        (file(whole(vec![1, -2]), one()), "row 1, column `particle`: -2 is refused"),
        (
            file(whole(vec![1, 2]), f64s(vec![Some(0.0), None])),
            "row 1, column `x`: null is refused",
        ),
        (file(one(), one()), "column `particle` holds Float64 and has to hold integers"),
        (file(whole(vec![1, 1]), one()), "row 1: particle 1 is there a second time"),
        (b"PAR1 and nothing else".to_vec(), "the table does not parse"),
        (vec![], "the table does not parse"),
    ] {
        let found = problem("a.parquet", bytes).to_string();
        assert!(found.contains(message), "{found}");
    }
    let text = Arc::new(arrow_array::StringArray::from(vec!["0", "1"])) as ArrayRef;
    let found = problem("a.parquet", file(whole(vec![1, 2]), text)).to_string();
    assert!(found.contains("column `x` holds Utf8"), "{found}");
}

#[test]
fn errors_name_the_table_and_not_the_scene_that_it_belongs_to() {
    let folder = tempfile::tempdir().unwrap();
    let glb = write(folder.path(), "square.glb", Fixture::square().glb());
    for (name, bytes) in [("bad.csv", "particle\n"), ("bad.txt", CSV)] {
        let mut options = OpenOptions::default();
        options.particles = vec![write(folder.path(), name, bytes)];
        let error = Scene::open(&glb, &options).unwrap_err();
        assert_eq!(error.file, options.particles[0]);
    }
    let mut options = OpenOptions::default();
    options.particles = vec![folder.path().join("missing.csv")];
    let error = Scene::open(&glb, &options).unwrap_err();
    assert!(matches!(*error.cause, Cause::Read { .. }) && error.file == options.particles[0]);
}

#[test]
fn small_tables_do_not_take_much_memory() {
    // Every row a particle and a key frame of its own: as many spheres as rows squared.
    let folder = tempfile::tempdir().unwrap();
    let rows: String = (0..60_000).map(|k| format!("{k},{k},0,0,0,1\n")).collect();
    let path = write(folder.path(), "a.csv", "particle,state,x,y,z,radius\n".to_owned() + &rows);
    let error = Scene::open(&path, &OpenOptions::default()).unwrap_err();
    assert!(
        matches!(
            *error.cause,
            Cause::Table(TableProblem::TooManySpheres { limit: 0x1000_0000, .. })
        ),
        "{error}"
    );
    let error = read_table(&path, 1).unwrap_err();
    assert!(error.to_string().contains("4 spheres or more"), "{error}");

    // A second table is counted at the key frames of both.
    let drops = write(folder.path(), "drops.csv", CSV);
    let other = CSV.replace("\n2,2,", "\n2,3,");
    let mut options = OpenOptions::default();
    options.particles = vec![write(folder.path(), "other.csv", other)];
    options.max_spheres = 18;
    let error = Scene::open(&drops, &options).unwrap_err();
    assert!(error.to_string().contains("24 spheres"), "{error}");
    options.max_spheres = 24;
    Scene::open(&drops, &options).unwrap();
}

#[test]
fn golden_tables_are_written_and_read_as_ever() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../schemas/golden/particles-v1");
    for (name, format) in golden::TABLES {
        let path = folder.join(name);
        assert!(std::fs::read(&path).unwrap() == golden::bytes(format).unwrap(), "{name}");
        let table = read_table(&path, 100).unwrap();
        assert_eq!(table.ids, [1, 2, 3, 1000]);
        let wanted = golden::key_frames();
        assert_eq!(table.key_times, wanted.iter().map(|(time, _)| *time).collect::<Vec<_>>());
        for ((_, there), keys) in wanted.into_iter().zip(&table.keys) {
            for (id, sphere) in table.ids.iter().zip(keys) {
                match there.iter().find(|(wanted, _)| wanted == id) {
                    None => assert_eq!(*sphere, Sphere::ABSENT, "particle {id}"),
                    Some((_, wanted)) => {
                        assert_eq!(sphere.radius, wanted.radius);
                        let center = sphere.center() + table.origin;
                        assert!((center - wanted.center()).length() < 1e-6, "particle {id}");
                    }
                }
            }
        }
    }
}

#[test]
fn exported_particles_are_instances_of_a_sphere() {
    let folder = tempfile::tempdir().unwrap();
    let glb = write(folder.path(), "square.glb", Fixture::square().glb());
    let drops = write(folder.path(), "drops.csv", CSV);
    let mut options = OpenOptions::default();
    options.particles = vec![drops.clone()];
    // With a scene of triangles and alone; particle 40 is not there in the first state.
    for (main, options, triangles) in [(&glb, &options, 2), (&drops, &OpenOptions::default(), 0)] {
        let scene = Scene::open(main, options).unwrap();
        let out = folder.path().join("visible.glb");
        let count = scene.geometry.primitive_count();
        let report =
            export_visible(main, &scene, &PrimitiveSet::from_sorted(0..count), &out).unwrap();
        assert_eq!((report.triangles, report.particles), (triangles, 2));
        assert_eq!(report.warnings, ["particles that are not there yet are left out (drops)"]);
        assert_valid(&[&out]);
        let exported = Scene::open(&out, &OpenOptions::default()).unwrap();
        let object = exported.objects.iter().find(|o| o.name == "drops").unwrap();
        assert_eq!(object.primitives.len(), 2 * 80);
        // Particle 7 at (1, 2, 3) with radius 0.5, and particle 9 at (0, 8, 0) with radius 1.
        for p in object.primitives.clone() {
            for corner in exported.geometry.triangle(PrimitiveId(p)).corners {
                let off = |center: DVec3, radius: f64| ((corner - center).length() - radius).abs();
                let near = off(DVec3::new(1.0, 2.0, 3.0), 0.5).min(off(DVec3::Y * 8.0, 1.0));
                assert!(near < 1e-5, "{corner}");
            }
        }
        // Without particles in the set the file has none.
        let none = PrimitiveSet::from_sorted(0..triangles as u32);
        let report = export_visible(main, &scene, &none, &out).unwrap();
        assert_eq!((report.particles, report.warnings.len()), (0, 0));
        assert_valid(&[&out]);
    }
}

/// Small valid tables.
fn seeds() -> Vec<(&'static str, Vec<u8>)> {
    let ball = |k: u32| (k, Sphere { center: [k as f32, 1.0, 0.0], radius: 0.5 });
    let keys: Vec<_> =
        (0..3).map(|key| (f64::from(key), (key..9 + key).map(ball).collect())).collect();
    let f64s = |v: Vec<f64>| Arc::new(Float64Array::from(v)) as ArrayRef;
    let plain = vec![
        ("particle", Arc::new(Int64Array::from(vec![1, 2])) as ArrayRef),
        ("x", f64s(vec![1.0, 2.0])),
        ("y", f64s(vec![1.0, 2.0])),
        ("z", f64s(vec![1.0, 2.0])),
        ("radius", f64s(vec![1.0, 2.0])),
    ];
    vec![
        ("a.csv", CSV.into()),
        ("a.csv", table(TableFormat::Csv, &keys)),
        ("a.parquet", table(TableFormat::Parquet, &keys)),
        ("a.parquet", parquet(plain.clone(), Compression::UNCOMPRESSED)),
        ("a.parquet", parquet(plain, Compression::SNAPPY)),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 2000,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn mutated_tables_are_read_or_refused(seed in any::<u64>()) {
        let mut rng = Rng(seed);
        let mut seeds = seeds();
        let (name, mut bytes) = seeds.swap_remove(rng.below(seeds.len()));
        for _ in 0..1 + rng.below(8) {
            let at = rng.below(bytes.len());
            match rng.below(6) {
                0 => drop(bytes.splice(at..at, [b"0,-9e.\nN"[rng.below(8)]])),
                1 => drop(bytes.remove(at)),
                2 => bytes[at] ^= 1 << rng.below(8),
                3 => bytes[at] = 0xff,
                _ => bytes[at] = rng.next() as u8,
            }
        }
        if rng.below(8) == 0 {
            bytes.truncate(rng.below(bytes.len()));
        }
        if let Ok(scene) = open(name, &bytes) {
            prop_assert!(scene.geometry.primitive_count() > 0);
        }
    }

    #[test]
    fn arbitrary_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        prop_assert!(open("a.csv", &bytes).is_err());
        prop_assert!(open("a.parquet", &bytes).is_err());
        let parquet = [b"PAR1", &bytes[..], b"\x10\0\0\0PAR1"].concat();
        prop_assert!(open("a.parquet", parquet).is_err());
    }
}
