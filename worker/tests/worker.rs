//! A worker against a coordinator that only hands out tasks in order, over real loopback gRPC.

use std::collections::BTreeSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use glam::DVec3;
use prost::Message;
use sightline_geometry::{CellId, ViewCell};
use sightline_jobs::{BakeConfig, Plan, SceneRef, SkippedCells, TaskId, TiledCell, plan};
use sightline_proto::encode_plan;
use sightline_proto::v1::coordinator_server::{Coordinator, CoordinatorServer};
use sightline_proto::v1::{self, lease_response::Answer, report_request};
use sightline_scene::generate::{Kind, generate};
use sightline_scene::region::{Heights, RegionSpec, tile};
use sightline_scene::{OpenOptions, Scene};
use sightline_store::{
    BakeStore, CellRow, ObjectRow, Weight, decode_cell_part, decode_object_part, keys,
};
use sightline_worker::solve::{Cancel, CellOutput, solve_cells, solve_segments};
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
    let plan = plan(reference, config, cells, SkippedCells(tiled.skipped));
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
    let store = BakeStore::in_memory();
    store.create(&keys::plan(&plan.bake_id), encode_plan(plan)).await.unwrap();
    let fake = serve(plan, scene, &plan.scene.digest).await;
    let mut options = WorkerOptions::new(&fake.url);
    options.store = Some(store.clone());
    options.threads = threads;
    let summary = Worker::run(options, std::future::pending()).await.unwrap();
    assert_eq!(fake.committed.lock().unwrap().len(), plan.tasks.len());
    (store, summary)
}

async fn rows(store: &BakeStore, plan: &Plan) -> (Vec<CellRow>, Vec<ObjectRow>) {
    let (mut cells, mut objects) = (Vec::new(), Vec::new());
    for task in plan.cell_tasks() {
        let commit = store.get(&keys::commit(&plan.bake_id, task.id.0)).await.unwrap();
        let commit = v1::Commit::decode(commit).unwrap();
        let [first, second] = &commit.parts[..] else { panic!("{commit:?}") };
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

/// One cell of 1 m at the origin, at height 0.4, finished without tasks.
fn finish_one(scene: &Scene, config: BakeConfig) -> (CellRow, Vec<ObjectRow>) {
    let corner = |x: f64, z: f64| DVec3::new(x, 0.4, z);
    let corners = [corner(-0.5, -0.5), corner(0.5, -0.5), corner(0.5, 0.5), corner(-0.5, 0.5)];
    let cell = ViewCell { id: CellId(0), corners, height: 0.1 };
    let tiled = vec![TiledCell { cell, tile: [0, 0] }];
    let reference =
        SceneRef { uri: String::new(), name: String::new(), digest: String::new(), files: vec![] };
    let plan = plan(reference, config, tiled, SkippedCells::default());
    let never = Cancel::default();
    let rows = solve_segments(scene, &plan.segments, &plan.config, &never).unwrap();
    let rows = rows.into_iter().map(|row| (row.segment, row)).collect();
    let done = solve_cells(scene, &plan.cells, &plan.segments, &rows, &plan.config, &never);
    let CellOutput { cell, objects } = done.unwrap().remove(0);
    (cell, objects)
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
        let never = Cancel::default();
        let rows = solve_segments(&scene, &plan.segments, &config, &never).unwrap();
        let rows = rows.into_iter().map(|row| (row.segment, row)).collect();
        let (cells, segments) = (&plan.cells[..1], &plan.segments);
        solve_cells(&scene, cells, segments, &rows, &config, &never).unwrap().remove(0).cell
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
