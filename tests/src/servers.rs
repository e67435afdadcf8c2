//! Object store servers that tests start: each on a free port of loopback, with a bucket `box`, and
//! stopped by its process id when dropped.
//!
//! | server | speaks | from |
//! | --- | --- | --- |
//! | moto | S3 | PyPI, `tests/object-stores/requirements.txt` |
//! | Azurite | Azure Blob Storage | npm, `tests/azurite` |
//! | google_double.py | Google Cloud Storage | here: no emulator on PyPI or npm has its XML API |
//! | s3s-fs | S3, but looks first and writes later | crates.io, `target/s3s-fs` |

use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use tempfile::TempDir;

use crate::binaries::executable;
use crate::process::{self, Ended, Process, eventually};
use crate::{requirement, workspace};

/// How long a server may take to start.
const START_TIME: Duration = Duration::from_secs(120);

/// The bucket that every server has.
const BUCKET: &str = "box";

/// A running server.
pub struct Server {
    // First, so that it ends before its folder is removed.
    _process: Process,
    folder: TempDir,
    port: u16,
    scheme: &'static str,
    environment: Vec<(&'static str, String)>,
}

/// A port of this machine that nobody listens on.
///
/// # Panics
/// When there is none.
#[must_use]
pub fn free_port() -> u16 {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a port is free");
    listener.local_addr().expect("it has an address").port()
}

/// moto, if it is installed.
#[must_use]
pub fn moto(test: &str) -> Option<Server> {
    let python = requirement::python_with("moto.server");
    let install = "`.venv` with the packages of tests/object-stores/requirements.txt";
    let python = requirement::program(test, python, install)?;
    let script = workspace::root().join("tests/object-stores/serve_moto.py");
    let mut server = start("s3", |port, _| {
        let mut command = Command::new(&python);
        command.arg(&script).arg(port.to_string());
        command
    });
    server.environment = s3_environment(server.port);
    server.run(Command::new(python).args(["-c", CREATE_BUCKET, &server.port.to_string()]));
    Some(server)
}

/// Creates the bucket; moto asks nobody who they are.
const CREATE_BUCKET: &str = "import sys, urllib.request as r; \
    r.urlopen(r.Request(f'http://127.0.0.1:{sys.argv[1]}/box', method='PUT'))";

fn s3_environment(port: u16) -> Vec<(&'static str, String)> {
    vec![
        ("AWS_ENDPOINT_URL", format!("http://127.0.0.1:{port}")),
        ("AWS_ALLOW_HTTP", "true".into()),
        ("AWS_ACCESS_KEY_ID", "test".into()),
        ("AWS_SECRET_ACCESS_KEY", "secret-of-the-test".into()),
    ]
}

/// Azurite, if it is installed.
#[must_use]
pub fn azurite(test: &str) -> Option<Server> {
    let package = workspace::root().join("tests/azurite");
    let node = requirement::node_with(&package.join("node_modules/azurite"));
    let node = requirement::program(test, node, "Node.js and `npm ci` in tests/azurite")?;
    let mut server = start("az", |port, folder| {
        let mut command = Command::new(&node);
        command.arg(package.join("node_modules/azurite/dist/src/blob/main.js"));
        command.args(["--blobHost", "127.0.0.1", "--blobPort", &port.to_string(), "--silent"]);
        command.args(["--disableTelemetry", "--skipApiVersionCheck", "--location"]).arg(folder);
        command
    });
    let port = server.port.to_string();
    server.environment = vec![
        ("AZURITE_BLOB_STORAGE_URL", format!("http://127.0.0.1:{port}")),
        ("AZURE_STORAGE_USE_EMULATOR", "true".into()),
    ];
    let script = package.join("create_container.mjs");
    server.run(Command::new(node).arg(script).args([&port, BUCKET]));
    Some(server)
}

/// The stand-in for Google Cloud Storage, if there is a Python.
#[must_use]
pub fn google(test: &str) -> Option<Server> {
    let python = requirement::python_with("http.server");
    let python = requirement::program(test, python, "`.venv` with a Python")?;
    let script = workspace::root().join("tests/object-stores/google_double.py");
    let mut server = start("gs", |port, _| {
        let mut command = Command::new(&python);
        command.arg(&script).arg(port.to_string());
        command
    });
    server.environment = vec![
        ("GOOGLE_BASE_URL", format!("http://127.0.0.1:{}", server.port)),
        ("GOOGLE_ALLOW_HTTP", "true".into()),
        // An account that asks nobody for a token.
        ("GOOGLE_SERVICE_ACCOUNT_KEY", ACCOUNT.into()),
    ];
    Some(server)
}

/// A Google service account of no worth.
const ACCOUNT: &str = r#"{"private_key": "none", "private_key_id": "none", "client_email": "none", "disable_oauth": true}"#;

/// s3s-fs, if it is installed: a store that must be refused.
#[must_use]
pub fn s3s_fs(test: &str) -> Option<Server> {
    let program = workspace::root().join("target/s3s-fs/bin/s3s-fs");
    let program = Some(program).filter(|p| p.is_file());
    let install = "`bash tests/object-stores/install_s3s_fs`";
    let program = requirement::program(test, program, install)?;
    let mut server = start("s3", |port, folder| {
        std::fs::create_dir(folder.join(BUCKET)).expect("a folder can be made");
        let mut command = Command::new(&program);
        command.args(["--host", "127.0.0.1", "--port", &port.to_string()]);
        command.args(["--access-key", "test", "--secret-key", "secret-of-the-test"]).arg(folder);
        command
    });
    server.environment = s3_environment(server.port);
    Some(server)
}

fn start(scheme: &'static str, command: impl FnOnce(u16, &std::path::Path) -> Command) -> Server {
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let data = folder.path().join("data");
    std::fs::create_dir(&data).expect("a folder can be made");
    let port = free_port();
    let mut process = Process::start(&mut command(port, &data), folder.path(), "server");
    let answers = || TcpStream::connect((Ipv4Addr::LOCALHOST, port)).is_ok();
    let started = eventually(START_TIME, || answers() || !process.is_running());
    assert!(started && process.is_running(), "it does not start:\n{}", process.stderr());
    Server { _process: process, folder, port, scheme, environment: Vec::new() }
}

impl Server {
    /// The URL of a prefix of the bucket.
    #[must_use]
    pub fn url(&self, prefix: &str) -> String {
        format!("{}://{BUCKET}/{prefix}", self.scheme)
    }

    /// Where it listens.
    #[must_use]
    pub const fn port(&self) -> u16 {
        self.port
    }

    /// Gives a command what it needs to get in.
    pub fn admit<'c>(&self, command: &'c mut Command) -> &'c mut Command {
        shut_out(command).envs(self.environment.iter().map(|(k, v)| (k, v)))
    }

    /// As [`Server::admit`], by way of a proxy on another port.
    pub fn admit_by<'c>(&self, command: &'c mut Command, port: u16) -> &'c mut Command {
        let (own, other) = (format!(":{}", self.port), format!(":{port}"));
        let led = self.environment.iter().map(|(k, v)| (k, v.replace(&own, &other)));
        shut_out(command).envs(led)
    }

    /// Runs the command `objects` on this server.
    ///
    /// # Panics
    /// When it fails.
    pub fn objects(&self, arguments: &[&str]) -> Ended {
        let mut command = Command::new(executable("objects"));
        process::run(self.admit(command.args(arguments)), 2 * START_TIME).success()
    }

    /// Copies everything below a prefix into a new folder.
    #[must_use]
    pub fn fetch(&self, prefix: &str) -> PathBuf {
        let folder = self.folder.path().join("fetched").join(prefix);
        std::fs::create_dir_all(&folder).expect("a folder can be made");
        self.objects(&["fetch", &self.url(prefix), &folder.display().to_string()]);
        folder
    }

    /// Number of commits of the bakes below a prefix.
    #[must_use]
    pub fn commits(&self, prefix: &str) -> usize {
        let mut command = Command::new(executable("objects"));
        let url = self.url(prefix);
        let ended = process::run(self.admit(command.args(["list", &url])), START_TIME).success();
        ended.stdout.lines().filter(|key| key.contains("/commits/")).count()
    }

    fn run(&self, command: &mut Command) {
        let _ = process::run(command, START_TIME).success();
    }
}

/// Takes every credential of the environment from a command.
pub fn shut_out(command: &mut Command) -> &mut Command {
    let is_ours =
        |name: &str| ["AWS_", "AZURE_", "GOOGLE_", "AZURITE_"].iter().any(|p| name.starts_with(p));
    for (name, _) in std::env::vars_os() {
        if name.to_str().is_some_and(is_ours) {
            command.env_remove(name);
        }
    }
    command
}
