//! The built commands.
//!
//! Cargo gives a test only the executables of its own package, so cargo is asked to build those of
//! the others, once a test run. It answers at once when they are up to date.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

use crate::workspace;

/// The executable `name`, up to date.
///
/// # Panics
/// When it cannot be built.
#[must_use]
pub fn executable(name: &str) -> &'static Path {
    static BUILT: OnceLock<BTreeMap<String, PathBuf>> = OnceLock::new();
    let built = BUILT.get_or_init(build);
    built.get(name).unwrap_or_else(|| panic!("no executable {name} among {built:?}"))
}

/// `sightline` with arguments.
pub fn sightline<A: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = A>) -> Command {
    let mut command = Command::new(executable("sightline"));
    command.args(arguments);
    command
}

/// Asks for all executables and tests of the workspace, so that features are unified as when the tests
/// were built and no dependency is built twice.
fn build() -> BTreeMap<String, PathBuf> {
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["build", "--workspace", "--bins", "--tests", "--message-format=json"]);
    if !cfg!(debug_assertions) {
        cargo.arg("--release");
    }
    // What cargo tells a test about its package is no business of the build: build scripts that look at
    // it (ring's does) would run again, and everything above them with it.
    for (name, _) in std::env::vars_os() {
        let is_of_this_test = ["CARGO_PKG_", "CARGO_MANIFEST_", "CARGO_BIN_", "CARGO_CRATE_"];
        if is_of_this_test.iter().any(|start| name.to_string_lossy().starts_with(start)) {
            cargo.env_remove(&name);
        }
    }
    let messages = workspace::run(cargo.current_dir(workspace::root()));
    let executable = |line: &str| {
        let message: Value = serde_json::from_str(line).ok()?;
        if message["profile"]["test"] == true {
            return None;
        }
        let path = PathBuf::from(message["executable"].as_str()?);
        Some((message["target"]["name"].as_str()?.to_owned(), path))
    };
    messages.lines().filter_map(executable).collect()
}
