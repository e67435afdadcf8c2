//! `sightline-worker`: leases tasks from a coordinator, solves them, writes the results.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use bytesize::ByteSize;
use clap::Parser;
use sightline_scene::{MemoryLimit, default_folder};
use sightline_store::BakeStore;
use sightline_telemetry::metrics::{Listener, Registry};
use sightline_telemetry::{LogOptions, WatchFlags, stop};
use sightline_worker::{ClientSecurity, SceneAccess, Worker, WorkerOptions};

/// Leases tasks from a coordinator, solves them, writes the results.
#[derive(Debug, Parser)]
#[command(version, after_help = "Stop it at any time; its task goes to another worker.")]
struct Arguments {
    /// URL of the coordinator.
    #[arg(default_value = "http://127.0.0.1:7070", env = "SIGHTLINE_COORDINATOR")]
    coordinator: String,
    /// The scene or its URL, where it lies elsewhere than for the coordinator. Where it is not found, it
    /// is fetched from the store.
    #[arg(long, value_name = "FILE", env = "SIGHTLINE_SCENE")]
    scene: Option<PathBuf>,
    /// Fetch the scene from the store even when it is found.
    #[arg(long, env = "SIGHTLINE_FETCH_SCENE")]
    fetch_scene: bool,
    /// Folder for copies of a scene that is fetched; any number of workers may share it.
    #[arg(long, value_name = "DIR", env = "SIGHTLINE_CACHE")]
    cache: Option<PathBuf>,
    /// Limit of that folder, such as 20GiB or 500MB.
    #[arg(long, value_name = "SIZE", default_value = "20GiB", env = "SIGHTLINE_CACHE_SIZE")]
    cache_size: ByteSize,
    /// The store, where it is elsewhere than for the coordinator.
    #[arg(long, value_name = "LOCATION", env = "SIGHTLINE_STORE")]
    store: Option<String>,
    /// Most memory that the process takes, such as 4GiB: the scene is then read from a file of chunks,
    /// of which only what is not hidden is loaded.
    #[arg(long, value_name = "SIZE", env = "SIGHTLINE_MEMORY")]
    memory: Option<ByteSize>,
    /// Folder of the chunk files; `sightline` in the user's cache folder when absent.
    #[arg(long, value_name = "DIR", env = "SIGHTLINE_CHUNKS", requires = "memory")]
    chunks: Option<PathBuf>,
    /// Threads to solve with; 0 stands for one a core.
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// A name for people.
    #[arg(long, default_value = "worker", env = "SIGHTLINE_NAME")]
    name: String,
    /// How long to look for a coordinator that does not answer, s.
    #[arg(long, default_value_t = 60, value_name = "SECONDS")]
    patience: u64,
    /// How long the task at hand may still take when the worker is asked to stop, s.
    #[arg(long, value_name = "SECONDS", default_value_t = 20, env = "SIGHTLINE_DRAIN_SECONDS")]
    drain_seconds: u64,
    #[command(flatten)]
    security: ClientSecurity,
    #[command(flatten)]
    watch: WatchFlags,
}

type Error = Box<dyn std::error::Error + Send + Sync>;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let format = arguments.watch.log_format;
    let logs = LogOptions { format, filter: "info", service: "sightline-worker" };
    stop::run(logs, run(arguments))
}

async fn run(arguments: Arguments) -> Result<(), Error> {
    let mut options = WorkerOptions::new(&arguments.coordinator);
    options.scene_path = arguments.scene;
    options.scene_access = SceneAccess {
        fetch: arguments.fetch_scene,
        cache_folder: arguments.cache,
        cache_bytes_max: arguments.cache_size.0,
    };
    options.store = arguments.store.as_deref().map(BakeStore::open).transpose()?;
    let folder = arguments.chunks.unwrap_or_else(default_folder);
    options.memory = arguments.memory.map(|size| MemoryLimit::new(size.0, folder));
    options.threads = arguments.threads;
    options.name = arguments.name;
    options.patience = Duration::from_secs(arguments.patience);
    options.drain = Duration::from_secs(arguments.drain_seconds);
    options.security = arguments.security;
    let mut registry = Registry::default();
    options.metrics.register(&mut registry);
    let _listener = match arguments.watch.metrics {
        Some(address) => Some(Listener::start(address, registry).await?),
        None => None,
    };
    let summary =
        Worker::run(options, stop::signalled(|| std::process::exit(stop::INTERRUPTED))).await?;
    let solve_ms = u64::try_from(summary.solve_time.as_millis()).unwrap_or(u64::MAX);
    tracing::info!(
        tasks = summary.tasks,
        failures = summary.failures,
        solve_ms,
        published = summary.published,
        end = summary.message,
        chunks_loaded = summary.held.map(|held| held.loaded),
        chunks_given_back = summary.held.map(|held| held.given_back),
        "done"
    );
    Ok(())
}
