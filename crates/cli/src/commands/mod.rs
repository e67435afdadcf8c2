//! The commands, one module each, and what they share.

mod bake;
mod cell;
mod changes;
mod cluster;
mod dataset;
mod demo;
mod export;
mod generate;
mod info;
mod joining;
mod k8s;
mod scene;
mod status;
mod stored;
mod verify;

/// Until someone asks the command to stop; asked again, it ends at once.
async fn signalled() {
    let code = i32::from(crate::failure::Kind::Interrupted.exit_code());
    sightline_telemetry::stop::signalled(move || std::process::exit(code)).await;
}

pub use joining::Joining;
pub use k8s::K8s;

use std::path::{Path, PathBuf};

use sightline_geometry::CellId;
use sightline_store::Dataset;
use tokio::runtime::Runtime;

use crate::arguments::Task;
use crate::failure::{Failure, Kind, Result};

/// Runs a command.
pub fn run(task: Task) -> Result<()> {
    match task {
        Task::Generate(command) => generate::run(&command),
        Task::Bake(command) => bake::run(&command),
        Task::Coordinator(command) => cluster::run_coordinator(&command),
        Task::Worker(command) => cluster::run_worker(&command),
        Task::Status(command) => status::run(&command),
        Task::Verify(command) => verify::run(&command),
        Task::Export(command) => export::run(&command),
        Task::Info(command) => info::run(&command),
        Task::Cell(command) => cell::run(&command),
        Task::Demo(command) => demo::run(&command),
        Task::K8s(command) => k8s::run(&command),
    }
}

/// A runtime for I/O and RPC. Solving and ray casting run on threads of their own.
fn runtime() -> Result<Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(|e| Failure::new(Kind::Defect, format!("cannot start the threads for I/O: {e}")))
}

/// Runs `work` on so many threads, or on all cores.
fn on_threads<R: Send>(threads: Option<u32>, work: impl FnOnce() -> R + Send) -> Result<R> {
    let count = threads.unwrap_or(0) as usize;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(count)
        .build()
        .map_err(|e| Failure::new(Kind::Defect, format!("cannot start {count} threads: {e}")))?;
    Ok(pool.install(work))
}

/// Fails when the dataset has no such cell.
fn expect_cell(dataset: &Dataset, cell: CellId) -> Result<()> {
    if dataset.entry(cell).is_some() {
        return Ok(());
    }
    let failure = Failure::new(Kind::Input, format!("the dataset has no cell {cell}"));
    Err(match (dataset.cells().first(), dataset.cells().last()) {
        (Some(first), Some(last)) => failure.with_help(format!(
            "its cells are {} to {}; `sightline cell` finds the cell of a position",
            first.cell.id, last.cell.id
        )),
        _ => failure.with_help("it has no cells at all"),
    })
}

/// Writes a file through a temporary one beside it, so that it appears when it is complete.
fn write_whole<R>(out: &Path, write: impl FnOnce(&Path) -> Result<R>) -> Result<R> {
    let mut partial = out.as_os_str().to_owned();
    partial.push(format!(".partial-{}", std::process::id()));
    let partial = PathBuf::from(partial);
    let renamed = write(&partial).and_then(|result| {
        std::fs::rename(&partial, out)
            .map_err(|e| Failure::io(Kind::Store, "write", out, &e))
            .map(|()| result)
    });
    if renamed.is_err() {
        // What is left of it is of no use; when it cannot be removed, the error says enough.
        let _ = std::fs::remove_file(&partial);
    }
    renamed
}

/// An argument as a POSIX shell takes it.
fn quoted(argument: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "/._-+=:,@%".contains(c);
    if !argument.is_empty() && argument.chars().all(plain) {
        return argument.to_owned();
    }
    format!("'{}'", argument.replace('\'', "'\\''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_survive_a_shell() {
        assert_eq!(quoted("a/b-c.glb"), "a/b-c.glb");
        assert_eq!(quoted("my scene's"), "'my scene'\\''s'");
        assert_eq!(quoted(""), "''");
    }

    #[test]
    fn a_failed_write_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("a");
        let failed: Result<()> = write_whole(&out, |partial| {
            std::fs::write(partial, "half").unwrap();
            Err(Failure::new(Kind::Store, "full"))
        });
        assert!(failed.is_err());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        write_whole(&out, |partial| {
            std::fs::write(partial, "whole").unwrap();
            Ok(())
        })
        .unwrap();
        assert_eq!(std::fs::read_to_string(out).unwrap(), "whole");
    }
}
