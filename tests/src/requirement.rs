//! Requirements beyond a Rust toolchain: other programs and the shared scenes.
//!
//! A test whose requirement is missing says so on stderr, past the capture of the test runner,
//! and passes. With `SIGHTLINE_REQUIRE_ALL=1`, as `tests/run` sets it, a missing program fails
//! the test instead.

use std::io::Write;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use crate::workspace;

/// The environment variable that turns missing programs into failures.
pub const REQUIRE_ALL: &str = "SIGHTLINE_REQUIRE_ALL";

/// Says loudly that a test did not run.
pub fn skip(test: &str, missing: &str) {
    // Written to the stream itself: the test runner captures only the print macros.
    let line = format!("\nSKIPPED: {test}: {missing}\n");
    let _ = std::io::stderr().write_all(line.as_bytes());
}

/// The program if it can be used for `test`; else skips or fails.
///
/// # Panics
/// When it is missing and all programs are required.
#[must_use]
pub fn program(test: &str, found: Option<PathBuf>, install: &str) -> Option<PathBuf> {
    if found.is_none() {
        let required = std::env::var_os(REQUIRE_ALL).is_some_and(|v| v == "1");
        assert!(!required, "{test} needs a program that is missing: {install}");
        skip(test, install);
    }
    found
}

/// The Python that `tests/run` prepares, if it has DuckDB.
#[must_use]
pub fn python_with_duckdb() -> Option<PathBuf> {
    python_with("duckdb")
}

/// The Python that `tests/run` prepares, if it has a module.
#[must_use]
pub fn python_with(module: &str) -> Option<PathBuf> {
    let python = workspace::root().join(".venv/bin/python");
    succeeds(Command::new(&python).args(["-c", &format!("import {module}")])).then_some(python)
}

/// Node, if a package has been installed in a folder.
#[must_use]
pub fn node_with(package: &std::path::Path) -> Option<PathBuf> {
    let node = PathBuf::from("node");
    (package.is_dir() && succeeds(Command::new(&node).arg("--version"))).then_some(node)
}

/// The validator of Kubernetes objects, if `tests/run` has installed it.
#[must_use]
pub fn kubernetes_validate() -> Option<PathBuf> {
    in_venv("kubernetes-validate")
}

/// The runner of Open Job Description, if `tests/run` has installed it.
#[must_use]
pub fn openjd() -> Option<PathBuf> {
    in_venv("openjd")
}

fn in_venv(command: &str) -> Option<PathBuf> {
    let path = workspace::root().join(".venv/bin").join(command);
    succeeds(Command::new(&path).arg("--version")).then_some(path)
}

/// kubectl, if it is installed. It needs no cluster.
#[must_use]
pub fn kubectl() -> Option<PathBuf> {
    let kubectl = PathBuf::from("kubectl");
    succeeds(Command::new(&kubectl).args(["version", "--client"])).then_some(kubectl)
}

/// Node, if the Khronos validator has been installed beside its script.
#[must_use]
pub fn node_with_validator() -> Option<PathBuf> {
    let package = workspace::root().join("tests/gltf-validator/node_modules/gltf-validator");
    node_with(&package)
}

fn succeeds(command: &mut Command) -> bool {
    command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success())
}
