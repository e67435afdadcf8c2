//! A worker against a coordinator that only hands out tasks in order, over real loopback gRPC.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use glam::{DAffine3, DVec3};
use prost::Message;
use sightline_geometry::{
    Bounds, CellId, Instance, InstancedGeometry, Mesh, MeshId, ObjectId, ParticleSystem,
    PrimitiveId, PrimitiveSet, SegmentId, Sphere, Units, ViewCell,
};
use sightline_jobs::{BakeConfig, Plan, SceneRef, SkippedCells, TaskId, TiledCell, plan};
use sightline_proto::encode_plan;
use sightline_proto::v1::coordinator_server::{Coordinator, CoordinatorServer};
use sightline_proto::v1::{self, lease_response::Answer, report_request};
use sightline_scene::generate::{Kind, generate};
use sightline_scene::region::{Heights, RegionSpec, tile};
use sightline_scene::{OpenOptions, Scene};
use sightline_store::{
    BakeStore, CellRow, ObjectRow, SegmentRow, Weight, decode_cell_part, decode_object_part, keys,
};
use sightline_worker::solve::{Cancel, CellOutput, Work, join_cells, solve_cells, solve_segments};
use sightline_worker::{Worker, WorkerError, WorkerOptions, WorkerSummary};
use tonic::{Request, Response, Status};

/// Leases every task of a plan once, in order.
struct OneByOne {
    plan: Plan,
    digest: String,
    scene: PathBuf,
    next: AtomicU32,
    committed: Arc<Mutex<BTreeSet<u32>>>,
    goodbyes: Arc<AtomicU32>,
}

#[tonic::async_trait]
impl Coordinator for OneByOne {
    async fn register(
        &self,
        _: Request<v1::RegisterRequest>,
    ) -> Result<Response<v1::RegisterResponse>, Status> {
        Ok(Response::new(v1::RegisterResponse {
            worker_id: 1,
            epoch: 1,
            bake_id: self.plan.bake_id.clone(),
            store_location: "nowhere".into(),
            scene_uri: self.scene.display().to_string(),
            scene_digest: self.digest.clone(),
            lease_ms: 1000,
            heartbeat_ms: 50,
        }))
    }

    async fn lease(
        &self,
        _: Request<v1::LeaseRequest>,
    ) -> Result<Response<v1::LeaseResponse>, Status> {
        let task = self.next.fetch_add(1, Ordering::SeqCst);
        let answer = if (task as usize) < self.plan.tasks.len() {
            let (lease_id, attempt) = (u64::from(task), format!("e1-w1-l{task}"));
            Answer::Task(v1::LeasedTask { task, lease_id, attempt })
        } else {
            Answer::Finished(v1::Finished { published: true, message: "done".into() })
        };
        Ok(Response::new(v1::LeaseResponse { answer: Some(answer) }))
    }

    async fn heartbeat(
        &self,
        _: Request<v1::HeartbeatRequest>,
    ) -> Result<Response<v1::HeartbeatResponse>, Status> {
        Ok(Response::new(v1::HeartbeatResponse::default()))
    }

    async fn report(
        &self,
        request: Request<v1::ReportRequest>,
    ) -> Result<Response<v1::ReportResponse>, Status> {
        let request = request.into_inner();
        match request.result {
            Some(report_request::Result::Committed(_)) => {
                self.committed.lock().unwrap().insert(request.task);
            }
            other => panic!("task {}: {other:?}", request.task),
        }
        Ok(Response::new(v1::ReportResponse {}))
    }

    async fn goodbye(
        &self,
        _: Request<v1::GoodbyeRequest>,
    ) -> Result<Response<v1::GoodbyeResponse>, Status> {
        self.goodbyes.fetch_add(1, Ordering::SeqCst);
        Ok(Response::new(v1::GoodbyeResponse {}))
    }

    async fn get_status(
        &self,
        _: Request<v1::GetStatusRequest>,
    ) -> Result<Response<v1::Status>, Status> {
        Err(Status::unimplemented("not here"))
    }

    type WatchStatusStream = futures::stream::Empty<Result<v1::Status, Status>>;

    async fn watch_status(
        &self,
        _: Request<v1::WatchStatusRequest>,
    ) -> Result<Response<Self::WatchStatusStream>, Status> {
        Err(Status::unimplemented("not here"))
    }
}

/// A small city and a plan of some cells in it.
fn sample(folder: &Path, tasks: (u32, u32)) -> (PathBuf, Plan) {
    let path = folder.join("city.glb");
    let mut file = File::create(&path).unwrap();
    let made = generate(Kind::City, 20_000, 7, &mut file).unwrap();
    drop(file);
    let mut config = BakeConfig::default();
    let [x0, z0, ..] = made.suggested_region;
    config.region.rectangles = vec![[x0, z0, x0 + 20.0, z0 + 20.0]];
    config.solver.rows = 32;
    config.accuracy.rounds = 0;
    (config.tasks.segments_per_task, config.tasks.cells_per_task) = tasks;

    let mut options = OpenOptions::default();
    options.see_through.clone_from(&config.scene.see_through);
    let scene = Scene::open(&path, &options).unwrap();
    let spec = RegionSpec {
        rectangles: config.region.rectangles.clone(),
        polygons: vec![],
        cell_size: config.region.cell_size,
        eye_height: config.region.eye_height,
        heights: Heights::AboveGround { from: None, ground: vec!["*".into()] },
    };
    let tiled = tile(&scene, &spec).unwrap();
    assert!(!tiled.cells.is_empty(), "{:?}", tiled.skipped);
    let cells = tiled.cells.into_iter().map(|(cell, tile)| TiledCell { cell, tile }).collect();
    let reference = SceneRef {
        uri: path.display().to_string(),
        name: "city.glb".into(),
        digest: scene.digest.combined.clone(),
        files: vec![],
    };
    let key_times = scene.key_times.clone();
    let plan = plan(reference, config, key_times, cells, SkippedCells(tiled.skipped));
    (path, plan)
}

struct Fake {
    url: String,
    committed: Arc<Mutex<BTreeSet<u32>>>,
    goodbyes: Arc<AtomicU32>,
}

async fn serve(plan: &Plan, scene: &Path, digest: &str) -> Fake {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let committed = Arc::default();
    let goodbyes = Arc::default();
    let service = OneByOne {
        plan: plan.clone(),
        digest: digest.to_owned(),
        scene: scene.to_owned(),
        next: AtomicU32::new(0),
        committed: Arc::clone(&committed),
        goodbyes: Arc::clone(&goodbyes),
    };
    let incoming = tokio_stream::wrappers::TcpListenerStream::new(listener);
    tokio::spawn(
        tonic::transport::Server::builder()
            .add_service(CoordinatorServer::new(service))
            .serve_with_incoming(incoming),
    );
    Fake { url, committed, goodbyes }
}

async fn work(plan: &Plan, scene: &Path, threads: usize) -> (BakeStore, WorkerSummary) {
    work_with(plan, scene, None, threads).await
}

async fn work_with(
    plan: &Plan,
    scene: &Path,
    in_memory: Option<Arc<Scene>>,
    threads: usize,
) -> (BakeStore, WorkerSummary) {
    let store = BakeStore::in_memory();
    store.create(&keys::plan(&plan.bake_id), encode_plan(plan)).await.unwrap();
    let fake = serve(plan, scene, &plan.scene.digest).await;
    let mut options = WorkerOptions::new(&fake.url);
    options.store = Some(store.clone());
    options.scene = in_memory;
    options.threads = threads;
    let summary = Worker::run(options, std::future::pending()).await.unwrap();
    assert_eq!(fake.committed.lock().unwrap().len(), plan.tasks.len());
    (store, summary)
}

async fn rows(store: &BakeStore, plan: &Plan) -> (Vec<CellRow>, Vec<ObjectRow>) {
    let (mut cells, mut objects) = (Vec::new(), Vec::new());
    for task in plan.final_tasks() {
        let commit = store.get(&keys::commit(&plan.bake_id, task.id.0)).await.unwrap();
        let commit = v1::Commit::decode(commit).unwrap();
        let [first, second, ..] = &commit.parts[..] else { panic!("{commit:?}") };
        cells.extend(decode_cell_part(&first.key, store.get(&first.key).await.unwrap()).unwrap());
        objects.extend(
            decode_object_part(&second.key, store.get(&second.key).await.unwrap()).unwrap(),
        );
    }
    (cells, objects)
}

#[tokio::test]
async fn rows_do_not_depend_on_threads_or_on_the_cutting_into_tasks() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, coarse) = sample(folder.path(), (100, 100));
    let (_, fine) = sample(folder.path(), (3, 1));
    let (store, summary) = work(&coarse, &scene, 1).await;
    let (cells, objects) = rows(&store, &coarse).await;
    let (store, finer_summary) = work(&fine, &scene, 2).await;
    assert_eq!(rows(&store, &fine).await, (cells.clone(), objects.clone()));
    assert!(summary.published && summary.failures == 0);
    assert_eq!(finer_summary.tasks as usize, fine.tasks.len());

    assert_eq!(cells.len(), coarse.cells.len());
    for cell in &cells {
        let own: Vec<&ObjectRow> = objects.iter().filter(|o| o.cell == cell.cell.id).collect();
        let visible: u64 = own.iter().map(|o| u64::from(o.visible_primitives)).sum();
        assert_eq!(visible, cell.set.len(), "every visible primitive belongs to an object");
        assert!(own.iter().all(|o| o.visible_primitives <= o.total_primitives));
        assert!(own.iter().any(|o| o.weight > 0.0) && own.iter().all(|o| o.weight <= 1.0));
        // The city has nothing see-through: no two primitives are the nearest at one ray.
        let whole: f64 = cell.weights.iter().filter_map(|w| w.share()).sum();
        assert!(whole > 0.0 && whole <= 1.0 + Weight::RELATIVE_ERROR, "{whole}");
        assert_eq!(cell.weights.len() as u64, cell.set.len());
    }
}

/// A triangle of side 1, three times: 4 m away, 12 m away, and 12 m away at twice the size.
fn three_triangles(folder: &Path) -> Scene {
    let corners: [[f32; 3]; 3] = [[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.9, 0.0]];
    let bytes: Vec<u8> = corners.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
    std::fs::write(folder.join("triangle.bin"), bytes).unwrap();
    let gltf = r#"{ "asset": { "version": "2.0" }, "scene": 0,
        "scenes": [{ "nodes": [0, 1, 2] }],
        "nodes": [
            { "name": "near", "mesh": 0, "translation": [0, 0, -4] },
            { "name": "far", "mesh": 0, "translation": [-6, 0, -12] },
            { "name": "large", "mesh": 0, "translation": [6, 0, -12], "scale": [2, 2, 2] }
        ],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3",
            "min": [-0.5, 0, 0], "max": [0.5, 0.9, 0] }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }],
        "buffers": [{ "uri": "triangle.bin", "byteLength": 36 }] }"#;
    std::fs::write(folder.join("scene.gltf"), gltf).unwrap();
    Scene::open(&folder.join("scene.gltf"), &OpenOptions::default()).unwrap()
}

/// A plan of one cell of 1 m at the origin, at height 0.4.
fn plan_one(scene: &Scene, config: BakeConfig) -> Plan {
    let corner = |x: f64, z: f64| DVec3::new(x, 0.4, z);
    let corners = [corner(-0.5, -0.5), corner(0.5, -0.5), corner(0.5, 0.5), corner(-0.5, 0.5)];
    let cell = ViewCell { id: CellId(0), corners, height: 0.1 };
    let tiled = vec![TiledCell { cell, tile: [0, 0] }];
    let reference = SceneRef {
        uri: String::new(),
        name: String::new(),
        digest: scene.digest.combined.clone(),
        files: vec![],
    };
    plan(reference, config, scene.key_times.clone(), tiled, SkippedCells::default())
}

/// The rows of all cells of a plan, finished without tasks: range by range of states, then joined.
fn finish_all(scene: &Scene, plan: &Plan) -> Vec<CellOutput> {
    let (never, timeline, mut ranges) = (Cancel::default(), plan.timeline(), Vec::new());
    let units = &Units::new(&scene.geometry, plan.config.solver.granularity);
    let (all, a_task) = (plan.states(), plan.config.tasks.states_per_task);
    for first in (0..all).step_by(a_task as usize) {
        let states = first..all.min(first + a_task);
        let work = Work { scene, timeline: &timeline, config: &plan.config, units, states };
        let solved = solve_segments(&work, &plan.segments, |_| None, &never).unwrap();
        let mut rows: BTreeMap<SegmentId, Vec<SegmentRow>> = BTreeMap::new();
        solved
            .into_iter()
            .flat_map(|found| found.rows)
            .for_each(|row| rows.entry(row.segment).or_default().push(row));
        let done =
            solve_cells(&work, &plan.cells, &plan.segments, &rows, |_| None, &never).unwrap();
        if work.takes_all_states() {
            return done;
        }
        assert!(done.iter().all(|cell| cell.objects.is_empty()));
        ranges.push(done.into_iter().flat_map(|cell| cell.rows).collect());
    }
    join_cells(scene, &timeline, &ranges)
}

/// One cell of a scene at rest.
fn finish_one(scene: &Scene, config: BakeConfig) -> (CellRow, Vec<ObjectRow>) {
    let CellOutput { mut rows, objects, .. } =
        finish_all(scene, &plan_one(scene, config)).remove(0);
    assert_eq!(rows.len(), 1, "a scene at rest has one row a cell");
    assert_eq!(rows[0].states(), 0..1);
    (rows.remove(0), objects)
}

#[test]
fn nearer_and_larger_triangles_weigh_more_and_near_their_solid_angles() {
    let folder = tempfile::tempdir().unwrap();
    let scene = three_triangles(folder.path());
    let mut config = BakeConfig::default();
    config.solver.rows = 200;
    config.accuracy.rounds = 0;
    let (cell, objects) = finish_one(&scene, config);
    assert_eq!(cell.set.len(), 3);
    let weight = |name: &str| {
        let object = scene.objects.iter().find(|o| o.name == name).unwrap();
        let place = cell.set.iter().position(|p| p.0 == object.primitives.start).unwrap();
        let share = cell.weights[place].share().unwrap();
        let own = objects.iter().find(|o| o.object == object.id).unwrap().weight;
        assert!((share / own - 1.0).abs() <= Weight::RELATIVE_ERROR, "{name}: {share} {own}");
        own
    };
    let (near, far, large) = (weight("near"), weight("far"), weight("large"));
    assert!(near > large && large > far, "{near} {large} {far}");
    // Area 0.45 m2 seen head-on from 4 m; four times the area weighs four times as much.
    let expected = 0.45 / 16.0 / (4.0 * std::f64::consts::PI);
    assert!((near / expected - 1.0).abs() < 0.1, "{near} {expected}");
    assert!((large / far - 4.0).abs() < 0.6, "{large} {far}");
}

#[test]
fn an_easy_cell_stops_after_its_first_measurement() {
    let folder = tempfile::tempdir().unwrap();
    let scene = three_triangles(folder.path());
    let (cell, _) = finish_one(&scene, BakeConfig::default());
    let effort = cell.effort;
    assert_eq!((effort.refinements, effort.runs, effort.lines, effort.segments), (0, 1, 0, 4));
    assert!(effort.target_met && effort.heldout_error_upper <= 0.0002, "{effort:?}");
    assert!((18_000..25_000).contains(&effort.heldout_viewpoints), "{effort:?}");
}

#[test]
fn a_hard_target_gets_more_rows_and_runs_and_says_when_they_were_not_enough() {
    let folder = tempfile::tempdir().unwrap();
    let (path, plan) = sample(folder.path(), (100, 100));
    let scene = Scene::open(&path, &OpenOptions::default()).unwrap();
    let target = 0.000_02;
    let finish = |rounds: u32| {
        let mut config = plan.config.clone();
        (config.solver.rows, config.solver.rows_max) = (8, 40);
        (config.accuracy.rounds, config.accuracy.target_error) = (rounds, target);
        let mut one = plan.clone();
        (one.config, one.cells) = (config, vec![plan.cells[0].clone()]);
        finish_all(&scene, &one).remove(0).rows.remove(0)
    };
    let (coarse, refined, again) = (finish(0), finish(2), finish(2));
    assert_eq!(refined, again, "a function of its input alone");
    let [a, b] = [&coarse.effort, &refined.effort];
    assert!(!a.target_met && a.refinements == 0 && a.heldout_error_upper > 0.0002, "{a:?}");
    assert!(b.refinements >= 1 && b.segments == 4 * b.runs + b.lines, "{b:?}");
    assert!(b.rows > a.rows && b.rows <= 40 && b.solver_rays > a.solver_rays, "{b:?}");
    assert!(b.heldout_error_mean < a.heldout_error_mean, "{a:?} {b:?}");
    assert!(b.target_met || b.refinements == 2, "{b:?}");
    let members: Vec<_> = coarse.set.iter().collect();
    assert!(members.iter().all(|p| refined.set.contains(*p)), "nothing is lost");
}

#[tokio::test]
async fn another_scene_is_refused_with_both_digests() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, plan) = sample(folder.path(), (100, 100));
    let store = BakeStore::in_memory();
    store.create(&keys::plan(&plan.bake_id), encode_plan(&plan)).await.unwrap();
    let fake = serve(&plan, &scene, &"ab".repeat(32)).await;
    let mut options = WorkerOptions::new(&fake.url);
    options.store = Some(store);
    let error = Worker::run(options, std::future::pending()).await.unwrap_err();
    assert!(matches!(error, WorkerError::OtherScene { .. }));
    let message = error.to_string();
    assert!(message.contains(&plan.scene.digest) && message.contains(&"ab".repeat(32)));
    assert_eq!(fake.goodbyes.load(Ordering::SeqCst), 1);
}

#[tokio::test]
async fn a_worker_that_is_stopped_says_goodbye() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, plan) = sample(folder.path(), (1, 1));
    let store = BakeStore::in_memory();
    store.create(&keys::plan(&plan.bake_id), encode_plan(&plan)).await.unwrap();
    let fake = serve(&plan, &scene, &plan.scene.digest).await;
    let mut options = WorkerOptions::new(&fake.url);
    options.store = Some(store.clone());
    let first = keys::commit(&plan.bake_id, TaskId(0).0);
    let first_commit = async {
        while store.get_if_exists(&first).await.unwrap().is_none() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    let summary = Worker::run(options, first_commit).await.unwrap();
    assert!(!summary.published && (summary.tasks as usize) < plan.tasks.len());
    assert_eq!(fake.goodbyes.load(Ordering::SeqCst), 1);
}

#[tokio::test]
async fn nobody_there_is_an_error_that_says_what_to_do() {
    let mut options = WorkerOptions::new("http://127.0.0.1:9");
    options.patience = Duration::from_millis(100);
    let error = Worker::run(options, std::future::pending()).await.unwrap_err();
    assert!(error.to_string().contains("check that one is running"), "{error}");
    let options = WorkerOptions::new("somewhere");
    let error = Worker::run(options, std::future::pending()).await.unwrap_err();
    assert!(matches!(error, WorkerError::BadUrl { .. }));
}

/// A wall; a panel that is behind it, comes forward in the second of five states, stands before it in the
/// third and goes back in the fourth; and a ball that is there in the last two.
fn crossing(folder: &Path) -> Scene {
    let mut scene = three_triangles(folder);
    let square = |half: f32| {
        let corners =
            vec![[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]];
        Mesh::new(corners, &[[0, 1, 2], [0, 2, 3]]).0
    };
    let at = |z: f64| DAffine3::from_translation(DVec3::new(0.0, 0.4, z));
    let instance = |mesh: u32, motion: Option<Box<[DAffine3]>>| Instance {
        mesh: MeshId(mesh),
        object: ObjectId(mesh),
        world_from_mesh: motion.as_ref().map_or(at(-6.0), |keys| keys[0]),
        first_primitive: PrimitiveId(2 * mesh),
        occluder: true,
        motion,
    };
    let instances = vec![
        instance(0, None),
        instance(1, Some([-9.0, -9.0, -3.0, -3.0, -9.0, -9.0].map(at).into())),
    ];
    let ball = vec![Sphere { center: [2.0, 0.4, -4.0], radius: 0.3 }];
    let gone = vec![Sphere::ABSENT];
    let keys = vec![gone.clone(), gone.clone(), gone, ball.clone(), ball.clone(), ball];
    let (system, _) = ParticleSystem::new(ObjectId(2), PrimitiveId(4), true, DVec3::ZERO, keys);
    scene.geometry =
        InstancedGeometry::with_motion(vec![square(9.0), square(0.5)], instances, vec![system], 5);
    for (object, (name, primitives)) in
        scene.objects.iter_mut().zip([("wall", 0..2), ("panel", 2..4), ("ball", 4..5)])
    {
        object.name = name.into();
        object.primitives = primitives;
        object.bounds = Bounds { min: DVec3::splat(-9.0), max: DVec3::splat(9.0) };
    }
    scene.key_times = vec![0.0, 1.0, 2.0, 3.0, 5.0, 6.0];
    scene
}

fn moving_config(states_per_task: u32) -> BakeConfig {
    let mut config = BakeConfig::default();
    config.region.rectangles = vec![[0.0, 0.0, 1.0, 1.0]];
    config.solver.rows = 64;
    config.tasks.states_per_task = states_per_task;
    config
}

fn set(members: &[u32]) -> PrimitiveSet {
    PrimitiveSet::from_sorted(members.iter().copied())
}

#[test]
fn what_moves_has_a_row_a_run_of_states_and_one_of_all() {
    let folder = tempfile::tempdir().unwrap();
    let scene = crossing(folder.path());
    let CellOutput { rows, objects, .. } =
        finish_all(&scene, &plan_one(&scene, moving_config(32))).remove(0);
    let found: Vec<_> = rows.iter().map(|row| (row.states(), row.set.clone())).collect();
    // All states first, the longest run next, then by time.
    assert_eq!(
        found,
        [
            (0..5, set(&[0, 1, 2, 3, 4])),
            (1..3, set(&[0, 1, 2, 3])),
            (0..1, set(&[0, 1])),
            (3..4, set(&[0, 1, 2, 3, 4])),
            (4..5, set(&[0, 1, 4])),
        ]
    );
    let states: Vec<_> = objects.iter().map(|o| (o.first_state, o.last_state)).collect();
    assert_eq!(states, [(0, 4), (1, 3), (3, 4)]);
    assert!(rows.iter().all(|row| row.effort.target_met && row.effort == rows[0].effort));
    // The ball is there for three seconds of six, and weighs half as much in the mean of all.
    let weight = |row: &CellRow| row.weights.last().unwrap().share().unwrap();
    let ratio = weight(&rows[4]) / weight(&rows[0]);
    assert!((1.6..2.5).contains(&ratio), "{ratio}");
    assert!((objects[2].weight / weight(&rows[0]) - 1.0).abs() <= Weight::RELATIVE_ERROR);
    for row in &rows {
        let whole: f64 = row.weights.iter().filter_map(|w| w.share()).sum();
        assert!(whole > 0.0 && whole <= 1.0 + Weight::RELATIVE_ERROR, "{whole}");
    }
}

#[test]
fn sets_do_not_depend_on_how_states_are_cut_where_nothing_is_refined() {
    let folder = tempfile::tempdir().unwrap();
    let scene = crossing(folder.path());
    let finish = |states_per_task| {
        finish_all(&scene, &plan_one(&scene, moving_config(states_per_task))).remove(0)
    };
    let whole = finish(32);
    assert_eq!(whole.rows[0].effort.refinements, 0, "{:?}", whole.rows[0].effort);
    for states_per_task in [1, 2, 4] {
        let joined = finish(states_per_task);
        assert_eq!(joined.rows.len(), whole.rows.len());
        for (a, b) in whole.rows.iter().zip(&joined.rows) {
            assert_eq!((a.states(), &a.set), (b.states(), &b.set), "{states_per_task} a task");
            let near = |(a, b): (&Weight, &Weight)| a.code().abs_diff(b.code()) <= 1;
            assert!(a.weights.iter().zip(&b.weights).all(near), "weights differ by rounding");
        }
        for (a, b) in whole.objects.iter().zip(&joined.objects) {
            let seen =
                |o: &ObjectRow| (o.object, o.visible_primitives, o.first_state, o.last_state);
            assert_eq!(seen(a), seen(b));
        }
        let ranges = 5u32.div_ceil(states_per_task);
        let effort = joined.rows[0].effort;
        assert_eq!((effort.segments, effort.runs), (4 * ranges, ranges));
        assert!(effort.target_met);
    }
}

#[test]
fn refinement_finds_more_of_what_moves_and_is_repeatable() {
    let folder = tempfile::tempdir().unwrap();
    let scene = crossing(folder.path());
    let finish = |rounds| {
        let mut config = moving_config(32);
        (config.solver.rows, config.accuracy.rounds) = (2, rounds);
        config.accuracy.target_error = 0.000_05;
        finish_all(&scene, &plan_one(&scene, config)).remove(0).rows
    };
    let (coarse, refined) = (finish(0), finish(6));
    assert_eq!(refined, finish(6), "a function of its input alone");
    let [a, b] = [&coarse[0].effort, &refined[0].effort];
    assert!(!a.target_met && b.refinements >= 1, "{a:?} {b:?}");
    assert!(b.heldout_error_mean < a.heldout_error_mean, "{a:?} {b:?}");
    assert_eq!(b.segments, 4 * b.runs + b.lines);
    assert!(coarse[0].set.iter().all(|p| refined[0].set.contains(p)), "nothing is lost");
}

#[tokio::test]
async fn ranges_of_states_are_joined_from_parts_as_without_tasks() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Arc::new(crossing(folder.path()));
    let plan = plan_one(&scene, moving_config(2));
    assert_eq!(plan.tasks.len(), 3 + 3 + 1, "three ranges of states, and their join");
    let path = folder.path().join("scene.gltf");
    let (store, summary) = work_with(&plan, &path, Some(Arc::clone(&scene)), 2).await;
    assert_eq!(summary.failures, 0);
    let (cells, objects) = rows(&store, &plan).await;
    let expected = finish_all(&scene, &plan).remove(0);
    assert_eq!((cells, objects), (expected.rows, expected.objects));
}

#[tokio::test]
async fn a_scene_with_other_states_than_the_plan_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut scene = crossing(folder.path());
    let plan = plan_one(&scene, moving_config(2));
    scene.geometry.states = 1;
    let store = BakeStore::in_memory();
    store.create(&keys::plan(&plan.bake_id), encode_plan(&plan)).await.unwrap();
    let fake = serve(&plan, &folder.path().join("scene.gltf"), &plan.scene.digest).await;
    let mut options = WorkerOptions::new(&fake.url);
    (options.store, options.scene) = (Some(store), Some(Arc::new(scene)));
    let error = Worker::run(options, std::future::pending()).await.unwrap_err();
    assert!(matches!(error, WorkerError::OtherStates { found: 1, expected: 5, .. }), "{error}");
}
