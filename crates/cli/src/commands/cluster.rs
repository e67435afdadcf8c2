//! `sightline coordinator` and `sightline worker`: the same bake on any number of machines that
//! share a store.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use sightline_coordinator::{Coordinator, CoordinatorOptions, Prepared};
use sightline_store::BakeStore;
use sightline_worker::{Worker, WorkerOptions};

use super::bake::{open_store, prepare_on, read_config, stop_signal, watch};
use crate::arguments::{Coordinator as CoordinatorCommand, Worker as WorkerCommand};
use crate::failure::{Failure, Kind, Result};
use crate::memory::add_held;
use crate::progress::note;
use crate::report::{Table, count, duration, print, thousands};

pub fn run_coordinator(command: &CoordinatorCommand) -> Result<()> {
    let config = read_config(&command.input)?;
    let Prepared { scene, plan, publisher } = prepare_on(&command.input, config, None)?;
    let ended = super::runtime()?.block_on(async {
        let store = open_store(&command.input, &scene.digest, &plan).await?;
        // The scene is the workers' matter from here on.
        drop(scene);
        let options = CoordinatorOptions::new(command.listen, store, plan, Arc::new(publisher));
        let mut coordinator = Coordinator::start(options).await?;
        note(&format!("waiting for workers: sightline worker --coordinator {}", coordinator.url()));
        watch(&mut coordinator, None).await;
        Ok::<_, Failure>(coordinator.join().await?)
    })?;
    let status = &ended.status;
    let changed = if ended.changed { "" } else { ", as it was" };
    let mut table = Table::default();
    table
        .row("dataset", format!("{}, manifest {}{changed}", command.input.out, ended.manifest))
        .row("cells", thousands(status.dataset_cells()))
        .row("segments", thousands(status.segments.total))
        .row("resumed", count(u64::from(status.tasks_resumed), "task"))
        .row("workers", thousands(status.workers.len() as u64))
        .row("solve", duration(status.solve_ms as f64 / 1e3))
        .row("merge and publish", duration(status.merge_ms as f64 / 1e3));
    print(&table.to_string());
    Ok(())
}

pub fn run_worker(command: &WorkerCommand) -> Result<()> {
    let mut options = WorkerOptions::new(&command.coordinator);
    options.scene_path.clone_from(&command.scene);
    options.store = command.out.as_deref().map(BakeStore::open).transpose()?;
    options.memory = command.memory.limit();
    options.threads = command.threads.unwrap_or(0) as usize;
    options.name = format!("process {}", std::process::id());
    let stopped = Arc::new(AtomicBool::new(false));
    let stop = {
        let stopped = Arc::clone(&stopped);
        async move {
            stop_signal().await;
            stopped.store(true, Ordering::Relaxed);
        }
    };
    let summary = super::runtime()?.block_on(Worker::run(options, stop))?;
    let mut table = Table::default();
    table
        .row("tasks", thousands(summary.tasks))
        .row("failed attempts", thousands(summary.failures))
        .row("solving", duration(summary.solve_time.as_secs_f64()));
    if let Some(held) = &summary.held {
        add_held(&mut table, held);
    }
    print(&table.to_string());
    if stopped.load(Ordering::Relaxed) {
        note("stopped; the task at hand goes to another worker");
        return Ok(());
    }
    if summary.published {
        return Ok(());
    }
    Err(Failure::new(Kind::Incomplete, format!("the bake failed: {}", summary.message))
        .with_help("the coordinator's output lists what is missing"))
}
