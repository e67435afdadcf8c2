//! What Sightline promises to who runs it, kept by the real commands on a small city.

use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;
use std::time::Duration;

use serde_json::Value;
use sightline_geometry::CellId;
use sightline_proto::v1::GetStatusRequest;
use sightline_proto::v1::coordinator_client::CoordinatorClient;
use sightline_store::{BakeStore, CellEntry, Dataset};
use sightline_tests::binaries::{executable, sightline};
use sightline_tests::city::{self, CELLS, City, LIMIT, TASK_UNITS};
use sightline_tests::process::{self, Process, eventually};
use sightline_tests::servers::free_port;
use sightline_tests::{dataset, requirement};
use tonic::transport::Endpoint;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_reflection::pb::v1::ServerReflectionRequest;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;

/// Mean pixel error that a dataset may have, share of pixels: 0.02 %.
const MEAN_MAX: f64 = 0.0002;
/// Error of the worst viewpoint that a dataset may have, share of pixels: 0.5 %.
const WORST_MAX: f64 = 0.005;

/// A memory limit below what the command itself takes, and above what of the city stays in memory.
const LITTLE: &str = "--memory=32MiB";

/// The city that all tests share, baked once.
static CITY: LazyLock<City> =
    LazyLock::new(|| City::bake(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("end_to_end")));

fn run(command: &mut Command) -> process::Ended {
    process::run(command, LIMIT)
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is a number"))
}

fn is_listening(port: u16) -> bool {
    std::net::TcpStream::connect((Ipv4Addr::LOCALHOST, port)).is_ok()
}

/// `sightline coordinator`. Its tasks are cut otherwise than those of the shared bake: the dataset
/// must not depend on it.
fn coordinator(dataset: &Path, listen: &str) -> Command {
    let arguments = city::bake_arguments("coordinator", &CITY.scene, dataset, [3, 1]);
    let mut command = sightline(arguments);
    command.args(["--listen", listen]);
    command
}

/// The commands of one cluster.
struct Cluster {
    folder: PathBuf,
    dataset: PathBuf,
    url: String,
    coordinator: Process,
}

impl Cluster {
    /// Starts a coordinator; `command` listens on the port that it is given.
    fn start(name: &str, command: impl FnOnce(&Path, &str) -> Command) -> Self {
        let folder = CITY.empty(name);
        let dataset = folder.join("dataset");
        let port = free_port();
        let mut command = command(&dataset, &format!("127.0.0.1:{port}"));
        let mut coordinator = Process::start(&mut command, &folder, "coordinator");
        let listening = eventually(LIMIT, || is_listening(port) || !coordinator.is_running());
        assert!(listening && coordinator.is_running(), "{}", coordinator.stderr());
        Self { folder, dataset, url: format!("http://127.0.0.1:{port}"), coordinator }
    }

    fn of_sightline(name: &str) -> Self {
        Self::start(name, coordinator)
    }

    fn worker(&self, name: &str) -> Process {
        self.worker_with(name, &[])
    }

    fn worker_with(&self, name: &str, flags: &[&str]) -> Process {
        let mut command = sightline(["worker", "--threads=1", "--coordinator", &self.url]);
        Process::start(command.args(flags), &self.folder, name)
    }
}

#[test]
fn bake_says_what_it_did() {
    let city = &*CITY;
    let cells = number(&city.summary["cells"]);
    assert_eq!(cells, entries(city).len() as f64, "{:#}", city.summary);
    assert_eq!(cells, f64::from(CELLS), "the street is free, so no cell is skipped");
}

#[test]
fn the_same_command_gives_the_same_bytes_with_one_thread() {
    let out = CITY.empty("again");
    let mut command = sightline(city::bake_arguments("bake", &CITY.scene, &out, TASK_UNITS));
    let _ = run(command.args(["--threads=1", "--json"])).success();
    dataset::assert_same(&CITY.dataset, &out);
}

#[test]
fn cluster_with_a_killed_worker_writes_the_bytes_of_bake() {
    let cluster = Cluster::of_sightline("cluster");
    let victim = cluster.worker("victim");
    let others = [cluster.worker("worker-1"), cluster.worker("worker-2")];
    let some_done = || dataset::commits(&cluster.dataset) >= 3;
    assert!(eventually(LIMIT, some_done), "no task was finished:\n{}", victim.stderr());
    victim.kill();
    assert!(!cluster.dataset.join("current.json").exists(), "the worker died half-way");
    let _ = cluster.coordinator.wait(LIMIT).success();
    for worker in others {
        let _ = worker.wait(LIMIT).success();
    }
    dataset::assert_same(&CITY.dataset, &cluster.dataset);
}

#[test]
fn a_worker_that_joins_late_helps_and_one_that_leaves_is_not_missed() {
    let cluster = Cluster::of_sightline("joining");
    let mut first = cluster.worker("first");
    assert!(eventually(LIMIT, || dataset::commits(&cluster.dataset) >= 2), "{}", first.stderr());
    // In so little memory that all of the scene is given back again and again.
    let chunks = format!("--chunks={}", cluster.folder.join("chunks").display());
    let late = cluster.worker_with("late", &[LITTLE, &chunks]);
    first.interrupt();
    let _ = first.wait(LIMIT);
    let _ = cluster.coordinator.wait(LIMIT).success();
    let late = late.wait(LIMIT).success();
    assert!(late.stdout.contains("given back"), "{}", late.stdout);
    dataset::assert_same(&CITY.dataset, &cluster.dataset);
}

#[test]
fn a_bake_in_little_memory_writes_the_same_bytes_and_is_measured_alike() {
    let out = CITY.empty("limited");
    let chunks = format!("--chunks={}", out.join("chunks").display());
    let dataset = out.join("dataset");
    let limited =
        |command: &mut Command| run(command.args([LITTLE, &chunks, "--json"])).success().json();
    let scene = &CITY.scene;
    let mut command = sightline(city::bake_arguments("bake", scene, &dataset, TASK_UNITS));
    let memory = &limited(&mut command)["memory"];
    let given_back = number(&memory["chunks_given_back"]);
    assert!(given_back > 2.0 * number(&memory["chunks"]), "{memory:#}");
    dataset::assert_same(&CITY.dataset, &dataset);
    let verify = || {
        let mut command = sightline(["verify", "--cells=2", "--viewpoints=3", "--rays=5000"]);
        command.arg(&dataset).arg("--scene").arg(scene);
        command
    };
    // Rays alone take so little that nothing has to be given back.
    let found = limited(&mut verify());
    assert!(number(&found["memory"]["chunks_touched"]) > 0.0, "{:#}", found["memory"]);
    let expected = run(verify().arg("--json")).success().json();
    for key in ["rays", "error_mean", "error_max", "histogram"] {
        assert_eq!(found[key], expected[key], "{key}");
    }
    assert!(expected["memory"].is_null(), "without a limit there is nothing to tell");
}

#[test]
fn a_limit_that_a_scene_does_not_fit_is_refused_with_a_reason() {
    let out = CITY.empty("too_little");
    let chunks = format!("--chunks={}", out.join("chunks").display());
    let mut command = sightline(city::bake_arguments("bake", &CITY.scene, &out, TASK_UNITS));
    let ended = run(command.args(["--memory=1MiB", &chunks]));
    assert!(!ended.status.success());
    assert!(ended.stderr.contains("the memory limit is 1.0 MiB"), "{}", ended.stderr);
    let mut command = sightline(city::bake_arguments("bake", &CITY.scene, &out, TASK_UNITS));
    let ended = run(command.args(["--memory=much", &chunks]));
    assert!(ended.stderr.contains("invalid value 'much' for"), "{}", ended.stderr);
}

#[test]
fn a_killed_coordinator_is_replaced_by_another() {
    let cluster = Cluster::of_sightline("replaced");
    let worker = cluster.worker("worker");
    assert!(eventually(LIMIT, || dataset::commits(&cluster.dataset) >= 3), "{}", worker.stderr());
    cluster.coordinator.kill();
    let dataset = cluster.dataset;
    let before = dataset::commits(&dataset);
    let mut command = coordinator(&dataset, cluster.url.trim_start_matches("http://"));
    let successor = Process::start(&mut command, &cluster.folder, "successor");
    let _ = successor.wait(LIMIT).success();
    let _ = worker.wait(LIMIT).success();
    assert!(dataset::commits(&dataset) > before);
    dataset::assert_same(&CITY.dataset, &dataset);
}

#[test]
fn thin_binaries_write_the_bytes_of_bake() {
    let config = CITY.folder.join("bake.toml");
    let text = "\
        [region]\nrectangles = [[-5.0, -10.0, 5.0, 10.0]]\ncell_size = 5.0\n\
        [solver]\nrows = 92\n\
        [accuracy]\ntarget_error = 0.0001\nworst_error = 0.001\nrounds = 3\n";
    std::fs::write(&config, text).expect("the configuration can be written");
    let cluster = Cluster::start("thin", |dataset, listen| {
        let mut command = Command::new(executable("sightline-coordinator"));
        command.arg(&CITY.scene).arg("--out").arg(dataset).arg("--config").arg(&config);
        command.args(["--set", "tasks.segments_per_task=5", "--listen", listen]);
        command
    });
    let mut command = Command::new(executable("sightline-worker"));
    command.arg(&cluster.url).args(["--threads", "2", "--name", "thin"]);
    let worker = Process::start(&mut command, &cluster.folder, "worker");
    let _ = cluster.coordinator.wait(LIMIT).success();
    let _ = worker.wait(LIMIT).success();
    dataset::assert_same(&CITY.dataset, &cluster.dataset);
}

#[test]
fn an_interrupted_bake_resumes_to_the_same_bytes() {
    let folder = CITY.empty("interrupted");
    let out = folder.join("dataset");
    let command = || {
        let mut command = sightline(city::bake_arguments("bake", &CITY.scene, &out, TASK_UNITS));
        command.args(["--threads=1", "--json"]);
        command
    };
    let mut bake = Process::start(&mut command(), &folder, "first");
    assert!(eventually(LIMIT, || dataset::commits(&out) >= 3), "{}", bake.stderr());
    bake.interrupt();
    let ended = bake.wait(LIMIT).failure(130);
    assert!(ended.stderr.contains("resume"), "{}", ended.stderr);
    assert!(!out.join("current.json").exists(), "nothing is published half-way");
    let before = dataset::commits(&out);
    assert!(before >= 3);
    let _ = run(&mut command()).success();
    assert!(dataset::commits(&out) > before, "the first half was kept");
    dataset::assert_same(&CITY.dataset, &out);
}

#[test]
fn a_changed_input_is_named() {
    let folder = CITY.empty("changed");
    let (scene, out) = (folder.join("scene.glb"), folder.join("dataset"));
    let one_cell = || {
        let mut command = sightline(["bake"]);
        command.arg(&scene).arg("--out").arg(&out);
        command.args(["--region=0,0,5,5", "--cell-size=5", "--rounds=0"]);
        command
    };
    city::generate(&scene, 1);
    let _ = run(one_cell().arg("--rows=16")).success();
    let other_key = run(one_cell().arg("--rows=20"));
    assert!(other_key.stderr.contains("solver.rows changed from 16 to 20"), "{other_key:#?}");
    city::generate(&scene, 2);
    let other_scene = run(one_cell().arg("--rows=20"));
    assert!(other_scene.stderr.contains("scene file `scene.glb` changed"), "{other_scene:#?}");
}

#[test]
fn an_unknown_key_is_refused_with_a_suggestion() {
    let folder = CITY.empty("unknown-key");
    let config = folder.join("bake.toml");
    std::fs::write(&config, "[solver]\nrow = 100\n").expect("a file can be written");
    let mut command =
        sightline(city::bake_arguments("bake", &CITY.scene, &folder.join("out"), TASK_UNITS));
    let ended = run(command.arg("--config").arg(&config)).failure(2);
    assert!(ended.stderr.contains("solver.row`"), "{}", ended.stderr);
    assert!(ended.stderr.contains("did you mean `solver.rows`"), "{}", ended.stderr);
}

#[test]
fn verify_finds_the_error_small() {
    let found = verify(&[]).success().json();
    let (mean, worst) = (number(&found["error_mean"]), number(&found["error_max"]));
    assert!(mean <= MEAN_MAX && worst <= WORST_MAX, "{found:#}");
    assert_eq!(number(&found["viewpoints"]), 4.0 * entries(&CITY).len() as f64);
}

#[test]
fn verify_fails_over_a_limit() {
    let ended = verify(&["--max-mean=-1"]).failure(1);
    assert!(ended.stderr.contains("mean pixel error"), "{}", ended.stderr);
}

#[test]
fn the_worst_viewpoint_command_reproduces_its_figure() {
    let worst = verify(&["--seed=3"]).success().json()["worst"].clone();
    let command = worst["command"].as_str().expect("the command is a text");
    let folder = executable("sightline").parent().expect("it is in a folder");
    let path = std::env::var("PATH").unwrap_or_default();
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("{command} --json")]);
    shell.env("PATH", format!("{}:{path}", folder.display()));
    let again = run(&mut shell).success().json()["worst"].clone();
    for figure in ["cell", "viewpoint", "rays", "wrong", "error"] {
        assert_eq!(worst[figure], again[figure], "{figure} of {command}");
    }
}

fn verify(more: &[&str]) -> process::Ended {
    let mut command = sightline(["verify", "--viewpoints=4", "--rays=20000", "--json"]);
    run(command.args(more).arg(&CITY.dataset))
}

#[test]
fn cell_at_a_position_contains_it() {
    for entry in entries(&CITY) {
        let at = entry.cell.center();
        let found = cell_at(at.x, at.y, at.z).success().json();
        assert_eq!(found["cell"], entry.cell.id.0, "{at}");
    }
    let nowhere = cell_at(1e6, 0.0, 0.0).failure(1);
    assert!(nowhere.stderr.contains("nearest"), "{}", nowhere.stderr);
}

fn cell_at(x: f64, y: f64, z: f64) -> process::Ended {
    let mut command = sightline(["cell", "--json"]);
    run(command.arg(format!("--at={x},{y},{z}")).arg(&CITY.dataset))
}

/// The cells of the dataset, by the reader of the library.
fn entries(city: &City) -> Vec<CellEntry> {
    let store = BakeStore::open(&city.dataset.display().to_string()).expect("the store opens");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime starts");
    let dataset = runtime.block_on(Dataset::open(&store)).expect("the dataset opens");
    dataset.cells().to_vec()
}

fn export(cell: CellId, name: &str) -> PathBuf {
    let out = CITY.empty(name).join("cell.glb");
    let mut command = sightline(["export", "--cell", &cell.to_string(), "-o"]);
    let _ = run(command.arg(&out).arg(&CITY.dataset)).success();
    out
}

fn info(path: &Path, more: &[&str]) -> Value {
    run(sightline(["info", "--json"]).args(more).arg(path)).success().json()
}

#[test]
fn exported_cell_has_the_triangles_of_its_set() {
    let cell = CellId(3);
    let out = export(cell, "exported");
    let visible = info(&CITY.dataset, &["--cell", &cell.to_string()]);
    let exported = info(&out, &[]);
    let visible = number(&visible["visible_primitives"]);
    assert_eq!(visible, number(&exported["report"]["instanced_triangles"]), "{exported:#}");
}

#[test]
fn a_budget_keeps_the_most_important_triangles() {
    let ask = |budget: &str| {
        let mut command = sightline(["cell", "--json", "--cell=3", "--budget", budget]);
        run(command.arg(&CITY.dataset)).success().json()["budget"].clone()
    };
    let all = ask("1000000");
    let numbers = |value: &Value| value.as_array().expect("a list").clone();
    let weights: Vec<f64> =
        numbers(&all["weights"]).iter().map(|w| w.as_f64().unwrap_or(0.0)).collect();
    assert!(weights.is_sorted_by(|a, b| a >= b), "the most important first");
    assert_eq!(number(&all["visible_primitives"]), weights.len() as f64);
    assert!((0.1..1.1).contains(&number(&all["share_of_all"])), "{}", all["share_of_all"]);
    let some = ask("50");
    assert_eq!(numbers(&some["primitives"])[..], numbers(&all["primitives"])[..50]);

    let out = CITY.empty("budget").join("cell.glb");
    let mut command = sightline(["export", "--cell=3", "--budget=50", "-o"]);
    let _ = run(command.arg(&out).arg(&CITY.dataset)).success();
    assert_eq!(number(&info(&out, &[])["report"]["instanced_triangles"]), 50.0);
}

#[test]
fn a_cell_says_what_it_took_and_whether_its_target_was_met() {
    for entry in entries(&CITY) {
        let cell = info(&CITY.dataset, &["--cell", &entry.cell.id.to_string()]);
        let of = |key: &str| number(&cell[key]);
        assert!(of("rows") >= 92.0 && of("runs") >= 1.0 && of("segments") >= 4.0, "{cell:#}");
        assert_eq!(of("segments"), 4.0 * of("runs") + of("lines"));
        assert!(of("heldout_error_mean") < of("heldout_error_upper"));
        let met = of("heldout_error_upper") <= 0.0001 && of("heldout_error_max") <= 0.001;
        assert_eq!(cell["target_met"], met, "{cell:#}");
        assert!(met || of("refinements") == 3.0, "it goes on while it may: {cell:#}");
    }
}

#[test]
fn exported_cell_passes_the_khronos_validator() {
    let test = "exported_cell_passes_the_khronos_validator";
    let found = requirement::node_with_validator();
    let install = "Node.js and `npm ci` in tests/gltf-validator";
    let Some(node) = requirement::program(test, found, install) else { return };
    let out = export(CellId(5), "validated");
    let script = sightline_tests::workspace::root().join("tests/gltf-validator/validate.mjs");
    let ended = run(Command::new(node).arg(script).arg(&out));
    assert!(ended.status.success(), "{ended:#?}");
}

#[test]
fn duckdb_answers_the_two_questions() {
    let test = "duckdb_answers_the_two_questions";
    let install = "`.venv` with the packages of tests/analytics/requirements.txt";
    let found = requirement::python_with_duckdb();
    let Some(python) = requirement::program(test, found, install) else { return };
    let script = sightline_tests::workspace::root().join("tests/analytics/query_dataset.py");
    let answers = run(Command::new(python).arg(script).arg(&CITY.dataset)).success().json();
    assert_eq!(answers["cells"], CELLS);
    let objects = answers["top_objects"].as_array().expect("a list of objects");
    assert_eq!(objects.len(), 10, "the ten objects seen from most cells");
    let histogram = answers["set_size_histogram"].as_array().expect("a histogram");
    let counted: u64 = histogram.iter().filter_map(|row| row["cells"].as_u64()).sum();
    assert_eq!(counted, u64::from(CELLS), "every cell is in one class: {answers:#}");
}

#[test]
fn info_describes_scene_dataset_and_cell() {
    let scene = info(&CITY.scene, &[]);
    let triangles = number(&scene["report"]["instanced_triangles"]);
    assert!((29_000.0..31_000.0).contains(&triangles), "{triangles}");
    let dataset = info(&CITY.dataset, &[]);
    assert_eq!(number(&dataset["summary"]["cells"]), f64::from(CELLS), "{dataset:#}");
    let missing = run(sightline(["info", "--cell=99"]).arg(&CITY.dataset)).failure(3);
    assert!(missing.stderr.contains("cell 99"), "{}", missing.stderr);
}

#[test]
fn health_and_reflection_answer() {
    let cluster = Cluster::of_sightline("health");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime starts");
    let asked = runtime.block_on(async {
        tokio::time::timeout(Duration::from_secs(30), ask(cluster.url.clone())).await
    });
    asked.expect("the coordinator answers in time").expect("the coordinator answers");
}

async fn ask(url: String) -> Result<(), Box<dyn std::error::Error>> {
    let coordinator = "sightline.v1.Coordinator";
    let channel = Endpoint::from_shared(url)?.connect().await?;
    let mut health = HealthClient::new(channel.clone());
    for service in ["", coordinator] {
        let answer = health.check(HealthCheckRequest { service: service.into() }).await?;
        assert_eq!(answer.into_inner().status(), ServingStatus::Serving, "`{service}`");
    }
    let request = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut reflection = ServerReflectionClient::new(channel.clone());
    let mut answers =
        reflection.server_reflection_info(tokio_stream::once(request)).await?.into_inner();
    let answer = answers.message().await?.and_then(|m| m.message_response);
    let Some(MessageResponse::ListServicesResponse(list)) = answer else {
        panic!("no list of services: {answer:?}")
    };
    let names: Vec<&str> = list.service.iter().map(|s| s.name.as_str()).collect();
    assert!(names.contains(&coordinator), "{names:?}");
    let status = CoordinatorClient::new(channel).get_status(GetStatusRequest {}).await?;
    let status = status.into_inner();
    assert_eq!(status.cells.map(|c| c.total), Some(u64::from(CELLS)), "{status:?}");
    Ok(())
}

#[test]
fn demo_ends_with_where_to_look_next() {
    let out = CITY.empty("demo").join("demo");
    let mut command = sightline(["demo", "--triangles=30k", "--out"]);
    let ended = process::run(command.arg(&out), 4 * LIMIT).success();
    assert!(ended.stdout.contains("sightline export"), "{}", ended.stdout);
}
