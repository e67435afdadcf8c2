//! Object stores, with real servers and the real commands: one conformance suite on every backend, the
//! same bytes wherever a bake writes, and stores and secrets that are refused.

use std::path::Path;
use std::process::Command;
use std::sync::LazyLock;

use sightline_store::BakeStore;
use sightline_tests::binaries::{executable, sightline};
use sightline_tests::city::{self, City, LIMIT, TASK_UNITS};
use sightline_tests::flaky_proxy::{Fault, Faults, FlakyProxy};
use sightline_tests::process::{self, Ended, Process, eventually};
use sightline_tests::servers::{self, Server};
use sightline_tests::{conformance, dataset, requirement};

/// A password that no output may show.
const SECRET: &str = "S3CRET-of-this-test";

/// The city that all tests share, baked once into a folder.
static CITY: LazyLock<City> =
    LazyLock::new(|| City::bake(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("object_stores")));

fn run(command: &mut Command) -> Ended {
    process::run(command, LIMIT)
}

/// `bake` of the shared city to a location.
fn bake(scene: &Path, out: &str) -> Command {
    let arguments = city::bake_arguments("bake", scene, Path::new(out), TASK_UNITS);
    let mut command = sightline(arguments);
    command.arg("--json");
    command
}

#[tokio::test(flavor = "multi_thread")]
async fn memory_and_folders_keep_every_promise() {
    conformance::run(&BakeStore::in_memory()).await;
    let folder = tempfile::tempdir().expect("a folder can be made");
    let location = folder.path().display().to_string();
    conformance::run(&BakeStore::open(&location).expect("it opens")).await;
}

/// Runs the suite in a process that has the server's address and credentials in its environment.
fn keeps_every_promise(server: &Server) {
    let ended = server.objects(&["conform", &server.url("some/folder")]);
    for (name, _) in conformance::PROMISES {
        assert!(ended.stdout.contains(&format!("kept: {name}\n")), "{name}: {ended:#?}");
    }
}

#[test]
fn s3_keeps_every_promise() {
    let Some(moto) = servers::moto("s3_keeps_every_promise") else { return };
    keeps_every_promise(&moto);
}

#[test]
fn azure_keeps_every_promise() {
    let Some(azurite) = servers::azurite("azure_keeps_every_promise") else { return };
    keeps_every_promise(&azurite);
}

#[test]
fn google_keeps_every_promise() {
    let Some(double) = servers::google("google_keeps_every_promise") else { return };
    keeps_every_promise(&double);
}

#[test]
fn a_store_that_looks_first_and_writes_later_is_refused() {
    let test = "a_store_that_looks_first_and_writes_later_is_refused";
    let Some(server) = servers::s3s_fs(test) else { return };
    let refused = run(server.admit(&mut bake(&CITY.scene, &server.url("out")))).failure(4);
    assert!(refused.stderr.contains("writers created one object"), "{}", refused.stderr);
    assert!(refused.stderr.contains("conditional writes"), "{}", refused.stderr);
}

/// Bakes to a server, compares the dataset with that in a folder, and asks about it.
fn same_dataset_and_answers(server: &Server) {
    let url = server.url("a bake/visible").replace(' ', "%20");
    let _ = run(server.admit(&mut bake(&CITY.scene, &url))).success();
    let copy = server.fetch("a%20bake/visible");
    dataset::assert_same(&CITY.dataset, &copy);

    let here = CITY.dataset.display().to_string();
    let ask = |arguments: &[&str], location: &str| {
        let mut command = sightline(arguments);
        run(server.admit(command.args(["--json", location]))).success().json()
    };
    for question in [&["info"][..], &["info", "--cell=3"], &["cell", "--at=0,1.6,0"]] {
        let (there, here) = (ask(question, &url), ask(question, &here));
        for key in ["summary", "visible_primitives", "cell", "totals"] {
            assert_eq!(there[key], here[key], "{key} of {question:?}");
        }
    }
    let out = CITY.folder.join(format!("cell-of-{}.glb", server.port()));
    let out = out.display().to_string();
    let exported = ask(&["export", "--cell=3", "-o", &out], &url);
    assert!(exported["triangles"].as_u64() > Some(0), "{exported:#}");
    let verified = ask(&["verify", "--cells=2", "--viewpoints=1", "--rays=1000"], &url);
    assert_eq!(verified["viewpoints"], 2, "{verified:#}");
}

#[test]
fn a_bake_to_s3_gives_the_bytes_of_a_bake_to_a_folder() {
    let test = "a_bake_to_s3_gives_the_bytes_of_a_bake_to_a_folder";
    let Some(moto) = servers::moto(test) else { return };
    same_dataset_and_answers(&moto);
}

#[test]
fn a_bake_to_azure_gives_the_bytes_of_a_bake_to_a_folder() {
    let test = "a_bake_to_azure_gives_the_bytes_of_a_bake_to_a_folder";
    let Some(azurite) = servers::azurite(test) else { return };
    same_dataset_and_answers(&azurite);
}

#[test]
fn a_cluster_over_s3_survives_a_killed_worker_and_needs_no_shared_folder() {
    let test = "a_cluster_over_s3_survives_a_killed_worker_and_needs_no_shared_folder";
    let Some(moto) = servers::moto(test) else { return };
    let folder = CITY.empty("cluster");
    let url = moto.url("cluster");
    // The workers' way to the scene is the store: its path is gone once the coordinator listens.
    let scene = folder.join("city.glb");
    std::fs::copy(&CITY.scene, &scene).expect("a scene can be copied");
    let port = servers::free_port();
    let listen = format!("127.0.0.1:{port}");
    let mut command =
        sightline(city::bake_arguments("coordinator", &scene, Path::new(&url), [3, 1]));
    let command = moto.admit(command.args(["--listen", &listen]));
    let mut coordinator = Process::start(command, &folder, "coordinator");
    let is_up = || std::net::TcpStream::connect(&listen).is_ok();
    let listening = eventually(LIMIT, || is_up() || !coordinator.is_running());
    assert!(listening && coordinator.is_running(), "{}", coordinator.stderr());
    std::fs::remove_file(&scene).expect("it can be removed");

    let cache = folder.join("cache");
    let worker = |name: &str| {
        let mut command = sightline(["worker", "--threads=1", "--coordinator"]);
        command.arg(format!("http://{listen}")).arg("--cache").arg(&cache);
        Process::start(moto.admit(command.arg("--cache-size=100MB")), &folder, name)
    };
    let (victim, other) = (worker("victim"), worker("other"));
    let some_done = eventually(LIMIT, || moto.commits("cluster") >= 3);
    assert!(some_done, "no task was finished:\n{}", victim.stderr());
    victim.kill();
    let _ = coordinator.wait(LIMIT).success();
    let _ = other.wait(LIMIT).success();
    dataset::assert_same(&CITY.dataset, &moto.fetch("cluster"));
    let files = std::fs::read_dir(cache.join("files")).expect("it is there").count();
    assert_eq!(files, 1, "one copy for both");
}

#[test]
fn a_scene_in_a_bucket_is_baked_and_verified_from_there() {
    let test = "a_scene_in_a_bucket_is_baked_and_verified_from_there";
    let Some(moto) = servers::moto(test) else { return };
    let folder = CITY.empty("scene-in-a-bucket");
    let (scene, out) = (moto.url("scenes/city.glb"), folder.join("out").display().to_string());
    moto.objects(&["put", &moto.url("scenes"), "city.glb", &CITY.scene.display().to_string()]);
    let cache = format!("--cache={}", folder.join("cache").display());
    let _ = run(moto.admit(bake(Path::new(&scene), &out).arg(&cache))).success();
    dataset::assert_same(&CITY.dataset, Path::new(&out));
    // The scene is found again by the URL that the bake read it from.
    let mut verify = sightline(["verify", "--cells=1", "--viewpoints=1", "--rays=1000", &cache]);
    let _ = run(moto.admit(verify.arg(&out))).success();
    let described = run(moto.admit(sightline(["info", "--json", &cache]).arg(&scene))).success();
    assert_eq!(described.json()["kind"], "scene");
    let missing = moto.url("scenes/village.glb");
    let refused = run(moto.admit(bake(Path::new(&missing), &out).arg(&cache))).failure(3);
    assert!(refused.stderr.contains("no scene at s3://box/scenes/village.glb"), "{refused:#?}");
}

#[test]
fn a_bake_on_a_bad_day_gives_the_same_bytes() {
    let Some(moto) = servers::moto("a_bake_on_a_bad_day_gives_the_same_bytes") else { return };
    let proxy = FlakyProxy::before(moto.port(), Faults::bad_day(5));
    let mut command = bake(&CITY.scene, &moto.url("bad-day"));
    moto.admit(&mut command);
    command.env("AWS_ENDPOINT_URL", format!("http://127.0.0.1:{}", proxy.port()));
    command.env("AWS_TIMEOUT", "2 seconds");
    let _ = run(&mut command).success();
    dataset::assert_same(&CITY.dataset, &moto.fetch("bad-day"));
    let met: Vec<(Fault, u64)> = Fault::ALL.into_iter().map(|f| (f, proxy.met(f))).collect();
    for fault in [Fault::CutAfter, Fault::ErrorAfter] {
        assert!(proxy.met(fault) > 0, "{met:?} of {}", proxy.requests());
    }
}

#[test]
fn a_store_that_lets_nobody_in_says_what_to_do() {
    let test = "a_store_that_lets_nobody_in_says_what_to_do";
    let bake_to = |url: &str| bake(&CITY.scene, url);
    let metadata = std::net::SocketAddr::from(([169, 254, 169, 254], 80));
    let wait = std::time::Duration::from_secs(1);
    if std::net::TcpStream::connect_timeout(&metadata, wait).is_ok() {
        requirement::skip(test, "this is a cloud's machine, which has credentials of its own");
        return;
    }
    let mut command = bake_to("s3://box/out");
    let ended = run(servers::shut_out(&mut command)).failure(4);
    assert!(ended.stderr.contains("AWS_ACCESS_KEY_ID"), "{}", ended.stderr);
    let mut command = bake_to("gs://box/out");
    let ended = run(servers::shut_out(&mut command).env("HOME", CITY.empty("no-home"))).failure(4);
    assert!(ended.stderr.contains("GOOGLE_APPLICATION_CREDENTIALS"), "{}", ended.stderr);
    let mut command = bake_to("az://box/out");
    servers::shut_out(&mut command).env("AZURE_STORAGE_ACCOUNT_NAME", "someone");
    let ended = run(&mut command).failure(4);
    assert!(ended.stderr.contains("AZURE_STORAGE_ACCOUNT_KEY"), "{}", ended.stderr);

    let Some(moto) = servers::moto(test) else { return };
    let ended = run(moto.admit(&mut bake_to("s3://no-such-bucket/out"))).failure(4);
    assert!(ended.stderr.contains("no such bucket"), "{}", ended.stderr);
    let nobody = format!("http://127.0.0.1:{}", servers::free_port());
    let mut command = bake_to(&moto.url("out"));
    moto.admit(&mut command).env("AWS_ENDPOINT_URL", nobody);
    let ended = run(&mut command).failure(4);
    assert!(ended.stderr.contains("cannot be reached"), "{}", ended.stderr);

    let Some(azurite) = servers::azurite(test) else { return };
    let mut command = bake_to(&azurite.url("out"));
    azurite.admit(&mut command).env("AZURE_STORAGE_ACCOUNT_KEY", "d3JvbmcK");
    let ended = run(&mut command).failure(4);
    assert!(ended.stderr.contains("the server says Auth"), "{}", ended.stderr);
    assert!(ended.stderr.contains("AZURE_STORAGE_ACCOUNT_KEY"), "{}", ended.stderr);
}

#[test]
fn secrets_of_a_url_appear_nowhere() {
    let Some(azurite) = servers::azurite("secrets_of_a_url_appear_nowhere") else { return };
    let is_silent = |ended: &Ended| {
        let all = format!("{}{}", ended.stdout, ended.stderr);
        assert!(!all.contains(SECRET) && !all.contains("sig="), "{all}");
    };
    // A signature that the server refuses: it comes back in no message and no log.
    let signed = format!("{}?sv=2021-12-02&sp=rwl&sig={SECRET}", azurite.url("signed"));
    let mut command = bake(&CITY.scene, &signed);
    let ended = run(azurite.admit(&mut command).env("RUST_LOG", "debug")).failure(4);
    is_silent(&ended);
    assert!(ended.stderr.contains("the server says Auth"), "{}", ended.stderr);
    for url in [format!("s3://key:{SECRET}@box/out"), format!("gs://box/out?token={SECRET}")] {
        for command in [&mut bake(&CITY.scene, &url), sightline(["info"]).arg(&url)] {
            let ended = run(command);
            assert!(!ended.status.success());
            is_silent(&ended);
            assert!(ended.stderr.contains("environment"), "{}", ended.stderr);
        }
    }
}

#[test]
fn the_probe_says_which_servers_are_fit() {
    // What docs/adr/0014-object-stores.md says of each server, looked at again.
    let test = "the_probe_says_which_servers_are_fit";
    let fit = [servers::moto(test), servers::azurite(test), servers::google(test)];
    for server in fit.into_iter().flatten() {
        server.objects(&["probe", &server.url("probed")]);
    }
    let Some(unfit) = servers::s3s_fs(test) else { return };
    for _ in 0..5 {
        let mut command = Command::new(executable("objects"));
        let ended = run(unfit.admit(command.args(["probe", &unfit.url("probed")]))).failure(1);
        assert!(ended.stderr.contains("cannot hold a bake"), "{}", ended.stderr);
    }
}
