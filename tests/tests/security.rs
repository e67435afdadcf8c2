//! Who is refused, and that nothing else suffers from it: real coordinators, sockets and TLS.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use sightline_proto::access::Role;
use sightline_proto::v1;
use sightline_tests::binaries::sightline;
use sightline_tests::campaign::Campaign;
use sightline_tests::certificates::{Authority, Files};
use sightline_tests::city::{self, City, LIMIT};
use sightline_tests::dataset;
use sightline_tests::process::{Process, eventually};
use sightline_tests::servers::free_port;
use sightline_worker::ClientSecurity;
use sightline_worker::security::Client;
use tokio::runtime::Runtime;
use tonic::{Code, Status};

const WORKER_TOKEN: &str = "0123456789abcdef-worker";
const VIEWER_TOKEN: &str = "0123456789abcdef-viewer";

/// The city that all tests share, baked once.
static CITY: LazyLock<City> =
    LazyLock::new(|| City::bake(&Path::new(env!("CARGO_TARGET_TMPDIR")).join("security")));

/// A coordinator that is secured somehow.
struct Secured {
    folder: PathBuf,
    dataset: PathBuf,
    address: SocketAddr,
    process: Process,
}

impl Secured {
    fn start(name: &str, secure: impl FnOnce(&Path, &mut Command)) -> Self {
        let folder = CITY.empty(name);
        let dataset = folder.join("dataset");
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, free_port()));
        let arguments = city::bake_arguments("coordinator", &CITY.scene, &dataset, [3, 1]);
        let mut command = sightline(arguments);
        command.arg("--listen").arg(address.to_string());
        secure(&folder, &mut command);
        let mut process = Process::start(&mut command, &folder, "coordinator");
        let listens =
            eventually(LIMIT, || TcpStream::connect(address).is_ok() || !process.is_running());
        assert!(listens && process.is_running(), "{}", process.stderr());
        Self { folder, dataset, address, process }
    }

    /// Repeats an attack, which has to be refused each time, until the coordinator's log has a
    /// refusal with `why`: after some refusals it counts for a while instead of logging.
    fn logs(&self, why: &str, mut attack: impl FnMut()) {
        let told = || {
            let log = self.process.stderr();
            log.lines().any(|line| line.contains("refused") && line.contains(why))
        };
        let is_logged = eventually(LIMIT, || {
            attack();
            eventually(Duration::from_millis(300), told)
        });
        assert!(is_logged, "`{why}` is not in the log:\n{}", self.process.stderr());
    }
}

fn client(security: &ClientSecurity, url: &str, role: Role) -> Client {
    security.client(url, role).expect("the credentials can be used")
}

/// What GetStatus is answered with.
fn look(runtime: &Runtime, security: &ClientSecurity, url: &str) -> Result<v1::Status, Status> {
    runtime.block_on(async {
        let mut client = client(security, url, Role::Viewer);
        client.get_status(v1::GetStatusRequest {}).await.map(tonic::Response::into_inner)
    })
}

fn register(runtime: &Runtime, security: &ClientSecurity, url: &str) -> Result<u32, Status> {
    runtime.block_on(async {
        let mut client = client(security, url, Role::Worker);
        let answer = client.register(registration("tester".into())).await?;
        Ok(answer.into_inner().worker_id)
    })
}

fn registration(worker_name: String) -> v1::RegisterRequest {
    let format_version = sightline_jobs::FORMAT_VERSION;
    v1::RegisterRequest { worker_name, threads: 1, format_version, ..Default::default() }
}

fn refused(answer: Result<impl std::fmt::Debug, Status>, codes: &[Code]) {
    let status = answer.expect_err("this is refused");
    assert!(codes.contains(&status.code()), "{status:?}");
}

/// Sends bytes and reads until the connection is closed.
fn is_closed_on(address: SocketAddr, bytes: &[u8]) {
    let mut stream = TcpStream::connect(address).expect("the port is open");
    stream.set_read_timeout(Some(LIMIT)).expect("a timeout can be set");
    // It may be closed before everything is sent.
    let _ = stream.write_all(bytes);
    let mut answer = Vec::new();
    let ended = stream.read_to_end(&mut answer).map_err(|error| error.kind());
    let is_timeout =
        matches!(ended, Err(std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut));
    assert!(!is_timeout, "the connection stays open");
}

fn garbage() -> Vec<u8> {
    (0..4096_u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 13) as u8).collect()
}

fn with(ca: &Path, own: Option<&Files>) -> ClientSecurity {
    ClientSecurity {
        ca: Some(ca.to_owned()),
        cert: own.map(|own| own.cert.clone()),
        key: own.map(|own| own.key.clone()),
        ..ClientSecurity::default()
    }
}

/// Noise on a port until it is dropped: garbage, and connections that say nothing.
struct Noise {
    goes_on: std::sync::Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<u32>>,
}

impl Noise {
    fn on(address: SocketAddr) -> Self {
        let goes_on = std::sync::Arc::new(AtomicBool::new(true));
        let flag = std::sync::Arc::clone(&goes_on);
        let thread = std::thread::spawn(move || {
            let (mut silent, mut sent) = (Vec::new(), 0);
            while flag.load(Ordering::Relaxed) {
                // Closed at once, at its limits, or gone at the end of the bake.
                if let Ok(mut stream) = TcpStream::connect(address) {
                    let _ = stream.write_all(&garbage());
                    sent += 1;
                }
                silent.extend(TcpStream::connect(address));
                if silent.len() > 50 {
                    silent.clear();
                }
                eventually(Duration::from_millis(5), || false);
            }
            sent
        });
        Self { goes_on, thread: Some(thread) }
    }

    fn end(mut self) -> u32 {
        self.goes_on.store(false, Ordering::Relaxed);
        self.thread.take().expect("it is ended once").join().expect("noise does not panic")
    }
}

#[test]
fn with_certificates_strangers_are_refused_and_the_bake_goes_on() {
    let (mut ca, mut own) = (None, None);
    let secured = Secured::start("certificates", |folder, command| {
        let authority = Authority::new(folder, "ours");
        let server = authority.issue("server", &[], false);
        command.arg("--tls-cert").arg(&server.cert).arg("--tls-key").arg(&server.key);
        command.arg("--tls-client-ca").arg(authority.file());
        own = Some(server);
        ca = Some(authority);
    });
    let (ca, server) = (ca.expect("made above"), own.expect("made above"));
    let url = format!("https://{}", secured.address);
    let runtime = Runtime::new().expect("a runtime starts");
    let other = Authority::new(&secured.folder, "other");
    let issue = |name: &str, role: Role| ca.issue(name, &[role.uri()], false);
    let (worker, viewer) = (issue("worker", Role::Worker), issue("viewer", Role::Viewer));
    let no_role = ca.issue("nobody", &["urn:sightline:role:boss"], false);
    let expired = ca.issue("expired", &[Role::Worker.uri()], true);
    let foreign = other.issue("foreign", &[Role::Worker.uri()], false);

    // A handshake that fails is a connection that fails.
    let gone = [Code::Unavailable, Code::Unknown, Code::Cancelled, Code::Internal];
    let attack = |own: Option<&Files>| {
        refused(register(&runtime, &with(&ca.file(), own), &url), &gone);
    };
    secured.logs("peer sent no certificates", || attack(None));
    secured.logs("invalid peer certificate: UnknownIssuer", || attack(Some(&foreign)));
    secured.logs("invalid peer certificate: certificate expired", || attack(Some(&expired)));
    secured.logs("role `worker`", || {
        let answer = register(&runtime, &with(&ca.file(), Some(&viewer)), &url);
        refused(answer, &[Code::PermissionDenied]);
    });
    secured.logs("role `viewer`", || {
        refused(look(&runtime, &with(&ca.file(), Some(&no_role)), &url), &[Code::PermissionDenied]);
        let answer = look(&runtime, &with(&ca.file(), Some(&worker)), &url);
        refused(answer, &[Code::PermissionDenied]);
    });
    secured.logs("no TLS", || is_closed_on(secured.address, &garbage()));
    let plain = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
    is_closed_on(secured.address, plain);
    secured.logs("decoded message length too large", || {
        let request = registration("x".repeat(sightline_proto::MESSAGE_BYTES_MAX + 1));
        let answer = runtime.block_on(async {
            let speaker = client(&with(&ca.file(), Some(&worker)), &url, Role::Worker);
            speaker.max_encoding_message_size(64 << 20).register(request).await
        });
        refused(answer, &[Code::OutOfRange]);
    });
    // Who does not trust the coordinator does not talk to it.
    refused(look(&runtime, &with(&other.file(), Some(&viewer)), &url), &gone);

    // A worker speaks for itself alone.
    let mine = with(&ca.file(), Some(&worker));
    let id = register(&runtime, &mine, &url).expect("a worker may register");
    let twin = with(&ca.file(), Some(&issue("twin", Role::Worker)));
    let bye = |security: &ClientSecurity| {
        runtime.block_on(async {
            let request = v1::GoodbyeRequest { worker_id: id, epoch: 1 };
            client(security, &url, Role::Worker).goodbye(request).await.map(drop)
        })
    };
    refused(bye(&twin), &[Code::NotFound]);
    bye(&mine).expect("its own goodbye is heard");

    // Nothing of this disturbs a bake, and noise does not either.
    let noise = Noise::on(secured.address);
    let mut command = sightline(["worker", "--threads=1", "--coordinator", &url]);
    command.arg("--tls-ca").arg(ca.file());
    command.env("SIGHTLINE_TLS_CERT", &worker.cert).env("SIGHTLINE_TLS_KEY", &worker.key);
    let working = Process::start(&mut command, &secured.folder, "worker");
    let status = look(&runtime, &with(&ca.file(), Some(&viewer)), &url).expect("viewers may look");
    assert_eq!(status.epoch, 1);
    let ended = secured.process.wait(LIMIT).success();
    let _ = working.wait(LIMIT).success();
    assert!(noise.end() > 0);
    assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
    let lines = ended.stderr.lines().filter(|line| line.contains("refused")).count();
    assert!(lines < 2_000, "refusals are not logged for ever: {lines}");
    for secret in [&server.key, &worker.key] {
        let key = std::fs::read_to_string(secret).expect("a key can be read");
        let body = key.lines().nth(1).expect("PEM has lines");
        assert!(!ended.stderr.contains(body), "no secret is logged");
    }
    dataset::assert_same(&CITY.dataset, &secured.dataset);
}

#[test]
fn with_tokens_strangers_are_refused_and_the_bake_goes_on() {
    let tokens = |folder: &Path, text: &str| {
        let path = folder.join(format!("tokens-{}", text.len()));
        std::fs::write(&path, text).expect("a file can be written");
        path
    };
    let both = format!("worker: {WORKER_TOKEN}\nviewer: {VIEWER_TOKEN}\n");
    let secured = Secured::start("tokens", |folder, command| {
        command.arg("--token-file").arg(tokens(folder, &both));
    });
    let url = format!("http://{}", secured.address);
    let runtime = Runtime::new().expect("a runtime starts");
    let holding = |text: &str| ClientSecurity {
        token_file: Some(tokens(&secured.folder, text)),
        ..ClientSecurity::default()
    };
    secured.logs("asks for a bearer token", || {
        let none = ClientSecurity::default();
        refused(register(&runtime, &none, &url), &[Code::Unauthenticated]);
    });
    secured.logs("not known here", || {
        let wrong = holding("0123456789abcdef-wrong-one");
        refused(register(&runtime, &wrong, &url), &[Code::Unauthenticated]);
    });
    secured.logs("role `worker`", || {
        let viewer_as_worker = holding(VIEWER_TOKEN);
        refused(register(&runtime, &viewer_as_worker, &url), &[Code::PermissionDenied]);
    });
    secured.logs("role `viewer`", || {
        let worker_as_viewer = holding(WORKER_TOKEN);
        refused(look(&runtime, &worker_as_viewer, &url), &[Code::PermissionDenied]);
    });
    secured.logs("not HTTP/2", || is_closed_on(secured.address, &garbage()));
    secured.logs("not HTTP/2", || is_closed_on(secured.address, b"GET / HTTP/1.1\r\n\r\n"));
    // Nobody is let in on it: it is closed when its trial is over.
    secured.logs("nobody was let in", || {
        is_closed_on(secured.address, b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0");
    });

    let noise = Noise::on(secured.address);
    let mut command = sightline(["worker", "--threads=1", "--coordinator", &url]);
    command.env("SIGHTLINE_TOKEN_FILE", tokens(&secured.folder, &both));
    let working = Process::start(&mut command, &secured.folder, "worker");
    let mut command = sightline(["status", "--json", "--once", &url]);
    command.arg("--token-file").arg(tokens(&secured.folder, &both));
    let told = Process::start(&mut command, &secured.folder, "status").wait(LIMIT).success();
    assert_eq!(told.json()["epoch"], 1);
    let ended = secured.process.wait(LIMIT).success();
    let worked = working.wait(LIMIT).success();
    noise.end();
    for log in [&ended.stderr, &worked.stderr] {
        assert!(!log.contains(WORKER_TOKEN) && !log.contains(VIEWER_TOKEN), "no secret is logged");
    }
    assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
    dataset::assert_same(&CITY.dataset, &secured.dataset);
}

#[test]
fn an_open_coordinator_beyond_loopback_is_refused_with_what_to_do() {
    let folder = CITY.empty("open");
    let arguments =
        city::bake_arguments("coordinator", &CITY.scene, &folder.join("dataset"), [3, 1]);
    let mut command = sightline(arguments);
    command.args(["--listen", "0.0.0.0:0"]);
    let ended = Process::start(&mut command, &folder, "coordinator").wait(LIMIT).failure(2);
    assert!(ended.stderr.contains("--tls-client-ca"), "{}", ended.stderr);
    assert!(ended.stderr.contains("--insecure"), "{}", ended.stderr);
}

#[test]
fn health_is_answered_in_plain_text_beside_an_encrypted_service() {
    let probes = free_port();
    let secured = Secured::start("health", |folder, command| {
        let authority = Authority::new(folder, "ours");
        let server = authority.issue("server", &[], false);
        command.arg("--tls-cert").arg(&server.cert).arg("--tls-key").arg(&server.key);
        command.arg("--tls-client-ca").arg(authority.file());
        command.arg("--health").arg(format!("127.0.0.1:{probes}"));
    });
    let runtime = Runtime::new().expect("a runtime starts");
    runtime.block_on(async {
        use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
        let url = format!("http://127.0.0.1:{probes}");
        let channel = tonic::transport::Endpoint::from_shared(url).expect("a URL");
        let channel = channel.connect().await.expect("probes connect");
        // It listens before it says that it serves.
        let deadline = Instant::now() + LIMIT;
        loop {
            let request = HealthCheckRequest { service: "sightline.v1.Coordinator".into() };
            let answer = HealthClient::new(channel.clone()).check(request).await;
            let is_serving = answer.is_ok_and(|answer| answer.into_inner().status == 1);
            if is_serving {
                break;
            }
            assert!(Instant::now() < deadline, "it never says that it serves");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let mut service = v1::coordinator_client::CoordinatorClient::new(channel);
        let answer = service.get_status(v1::GetStatusRequest {}).await;
        assert_eq!(answer.expect_err("nothing else is there").code(), Code::Unimplemented);
    });
    secured.process.kill();
}

#[test]
fn a_coordinator_under_random_requests_answers_and_keeps_its_state() {
    let campaign = Campaign {
        folder: CITY.empty("fuzzed"),
        scene: CITY.scene.clone(),
        baked: CITY.dataset.clone(),
        seed: 1,
        time: Duration::from_secs(5),
        attackers: 2,
    };
    let figures = campaign.run();
    assert!(figures.checks > 0 && figures.sent.answered > 0, "{figures:?}");
}
