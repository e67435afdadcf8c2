//! A worker that stops, loses its task to another, and wakes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use sightline_jobs::BakeStatus;
use sightline_store::keys;

use super::{Campaign, Store};
use crate::binaries::sightline;
use crate::city::LIMIT;
use crate::dataset;
use crate::process::{self, Process, eventually};
use crate::servers::free_port;

/// Time behind which a silent worker loses its task, ms.
const LEASE_MS: u64 = 600;
const SLEEPER: &str = "sleeper";

pub(super) fn run(campaign: &Campaign, asleep: Duration) {
    assert_eq!(campaign.store, Store::Files, "the sleeper's store is looked into as files");
    let folder = campaign.folder.join("sleeper");
    std::fs::create_dir(&folder).expect("one sleeps at a time");
    let (out, port) = (folder.join("dataset"), free_port());
    let start = |name: &str| Process::start(&mut Campaign::worker(port, name), &folder, name);
    let mut command = campaign.coordinator(&out.display().to_string(), port, LEASE_MS);
    let coordinator = Process::start(&mut command, &folder, "coordinator");

    let mut sleeper = start(SLEEPER);
    let commit = stop_at_work(&mut sleeper, port, &out);
    // Others do what they can, and the task that the sleeper holds as well: cells wait for it.
    let other = start("other");
    assert!(eventually(LIMIT, || commit.exists()), "nobody took its task:\n{}", other.stderr());
    // Before it has done all the rest, so that there is a bake to come back to.
    other.kill();
    let before = written(&out);
    eventually(asleep, || false);
    assert_eq!(written(&out), before, "nobody is at work");
    assert!(!out.join(keys::POINTER).exists(), "the bake is not over when it wakes");

    sleeper.signal("CONT");
    let _ = coordinator.wait(LIMIT).success();
    let ended = sleeper.wait(LIMIT).success();
    assert!(!ended.stderr.contains("panicked"), "{}", ended.stderr);
    let after = written(&out);
    for (path, bytes) in &before {
        assert!(after.get(path) == Some(bytes), "{} was changed", path.display());
    }
    dataset::assert_same(&campaign.baked, &out);
    let _ = std::fs::remove_dir_all(&folder);
}

/// Stops the only worker while it holds a task that is not committed; gives where the commit will be.
fn stop_at_work(sleeper: &mut Process, port: u16, out: &Path) -> PathBuf {
    let mut commit = PathBuf::new();
    let stopped = eventually(LIMIT, || {
        let Some(task) = held(port) else { return false };
        sleeper.signal("STOP");
        commit = out.join(task);
        // It may have committed between the answer and the signal.
        let is_at_work = !commit.exists();
        if !is_at_work {
            sleeper.signal("CONT");
        }
        is_at_work
    });
    assert!(stopped, "it was never seen at work:\n{}", sleeper.stderr());
    commit
}

/// The key of the commit of the task that the sleeper holds.
fn held(port: u16) -> Option<String> {
    let mut command = sightline(["status", "--once", "--json"]);
    let ended = process::run(command.arg(format!("http://127.0.0.1:{port}")), LIMIT);
    // The coordinator may not listen yet.
    let status: BakeStatus = serde_json::from_str(&ended.stdout).ok()?;
    let lease = status.leases.iter().find(|lease| lease.worker_name == SLEEPER)?;
    Some(keys::commit(&status.bake_id, lease.task.0))
}

/// Everything in the store that is written once, by path.
fn written(out: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = dataset::files(&out.join(keys::BAKE_FOLDER));
    found.retain(|path, _| !path.starts_with("probe"));
    found
}
