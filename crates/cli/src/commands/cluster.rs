//! `sightline coordinator` and `sightline worker`: the same bake on any number of machines that
//! share a store.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use sightline_coordinator::health::Health;
use sightline_coordinator::{Coordinator, CoordinatorOptions, Prepared, share_scene};
use sightline_store::{BakeStore, redacted};
use sightline_telemetry::WatchFlags;
use sightline_telemetry::metrics::{Listener, Registry};
use sightline_worker::{Worker, WorkerOptions};

use super::bake::{compare, open_store, prepare_on, read_config, watch};
use super::signalled;
use crate::arguments::{Coordinator as CoordinatorCommand, Worker as WorkerCommand};
use crate::failure::{Failure, Kind, Result};
use crate::memory::add_held;
use crate::progress::note;
use crate::report::{Table, count, duration, print, thousands};

pub fn run_coordinator(command: &CoordinatorCommand) -> Result<()> {
    let config = read_config(&command.input)?;
    let runtime = super::runtime()?;
    let health = runtime.block_on(serve_health(command.health))?;
    let Prepared { scene, plan, publisher, content } = prepare_on(&command.input, config, None)?;
    let ended = runtime.block_on(async {
        let store = open_store(&command.input, &scene.digest, &plan).await?;
        // The scene is the workers' matter from here on.
        drop(scene);
        let (scene, tables) = (&command.input.scene, &plan.config.scene.particles);
        let found = super::scene::locate(scene, tables, &command.input.cache).await?;
        let share = command.share_scene;
        share_scene(&store, &plan.scene, &found.path, &plan.config, share).await?;
        compare(&store, &plan, content.as_ref()).await?;
        let mut options = CoordinatorOptions::new(command.listen, store, plan, Arc::new(publisher));
        options.security = command.security.clone().into();
        let mut registry = Registry::default();
        options.metrics.register(&mut registry);
        let _listener = listen_for_metrics(&command.watch, registry).await?;
        let mut coordinator = Coordinator::start(options).await?;
        if let Some(health) = &health {
            health.ready().await;
        }
        note(&format!("waiting for workers: sightline worker --coordinator {}", coordinator.url()));
        watch(&mut coordinator, None).await;
        Ok::<_, Failure>(coordinator.join().await?)
    })?;
    let status = &ended.status;
    let changed = if ended.changed { "" } else { ", as it was" };
    let mut table = Table::default();
    table
        .row(
            "dataset",
            format!("{}, manifest {}{changed}", redacted(&command.input.out), ended.manifest),
        )
        .row("cells", thousands(status.dataset_cells()))
        .row("segments", thousands(status.segments.total))
        .row("resumed", count(u64::from(status.tasks_resumed), "task"))
        .row("workers", thousands(status.workers.len() as u64))
        .row("solve", duration(status.solve_ms as f64 / 1e3))
        .row("merge and publish", duration(status.merge_ms as f64 / 1e3));
    print(&table.to_string());
    Ok(())
}

/// Answers Prometheus, if it was asked for.
async fn listen_for_metrics(watch: &WatchFlags, registry: Registry) -> Result<Option<Listener>> {
    let Some(address) = watch.metrics else { return Ok(None) };
    let started = Listener::start(address, registry).await;
    started.map(Some).map_err(|error| {
        Failure::new(Kind::Usage, format!("cannot listen on {address} for metrics: {error}"))
            .with_help("choose another address with --metrics")
    })
}

/// Answers probes from now on, if that was asked for.
async fn serve_health(listen: Option<std::net::SocketAddr>) -> Result<Option<Health>> {
    match listen {
        Some(listen) => Ok(Some(Health::serve(listen).await?)),
        None => Ok(None),
    }
}

pub fn run_worker(command: &WorkerCommand) -> Result<()> {
    let runtime = super::runtime()?;
    let Some(coordinator) = runtime.block_on(super::joining::find(&command.coordinator))? else {
        return Ok(());
    };
    let mut options = WorkerOptions::new(&coordinator);
    options.scene_path.clone_from(&command.scene);
    options.scene_access = command.cache.access(command.fetch_scene);
    options.store = command.out.as_deref().map(BakeStore::open).transpose()?;
    options.memory = command.memory.limit();
    options.threads = command.threads.unwrap_or(0) as usize;
    options.name =
        command.name.clone().unwrap_or_else(|| format!("process {}", std::process::id()));
    options.drain = Duration::from_secs(command.drain_seconds);
    options.security = command.security.clone();
    let mut registry = Registry::default();
    options.metrics.register(&mut registry);
    let stopped = Arc::new(AtomicBool::new(false));
    let stop = {
        let stopped = Arc::clone(&stopped);
        async move {
            signalled().await;
            note("stopping behind the task at hand; once more stops at once");
            stopped.store(true, Ordering::Relaxed);
        }
    };
    let _health = runtime.block_on(serve_health(command.health))?;
    let ended = runtime.block_on(async {
        let _listener = listen_for_metrics(&command.watch, registry).await?;
        Ok::<_, Failure>(Worker::run(options, stop).await)
    })?;
    let summary = match ended {
        // The bake ended between the look into the file and the first call.
        Err(_) if super::joining::is_over(&command.coordinator) => return Ok(()),
        ended => ended?,
    };
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
        // Not a success: a platform that starts workers must not take it for the end of the bake.
        return Err(Failure::new(Kind::Interrupted, "stopped before the end of the bake")
            .with_help("what it did is kept; a task that was not done goes to another worker"));
    }
    if summary.published {
        return Ok(());
    }
    Err(Failure::new(Kind::Incomplete, format!("the bake failed: {}", summary.message))
        .with_help("the coordinator's output lists what is missing"))
}
