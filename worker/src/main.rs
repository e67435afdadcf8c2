//! `sightline-worker`: leases tasks from a coordinator, solves them, writes the results.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use sightline_scene::{ByteSize, MemoryLimit, default_folder};
use sightline_store::BakeStore;
use sightline_worker::{Worker, WorkerOptions, WorkerSummary};

/// Leases tasks from a coordinator, solves them, writes the results.
#[derive(Debug, Parser)]
#[command(version, after_help = "Stop it at any time; its task goes to another worker.")]
struct Arguments {
    /// URL of the coordinator.
    #[arg(default_value = "http://127.0.0.1:7070", env = "SIGHTLINE_COORDINATOR")]
    coordinator: String,
    /// The scene, where it lies elsewhere than for the coordinator.
    #[arg(long, value_name = "FILE", env = "SIGHTLINE_SCENE")]
    scene: Option<PathBuf>,
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
    #[arg(long, default_value = "worker", env = "SIGHTLINE_WORKER_NAME")]
    name: String,
    /// How long to look for a coordinator that does not answer, s.
    #[arg(long, default_value_t = 60, value_name = "SECONDS")]
    patience: u64,
}

type Error = Box<dyn std::error::Error + Send + Sync>;

#[tokio::main]
async fn main() -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    match run(Arguments::parse()).await {
        Ok(summary) => {
            let solve_ms = u64::try_from(summary.solve_time.as_millis()).unwrap_or(u64::MAX);
            tracing::info!(
                tasks = summary.tasks,
                failures = summary.failures,
                solve_ms,
                published = summary.published,
                message = summary.message,
                chunks_loaded = summary.held.map(|held| held.loaded),
                chunks_given_back = summary.held.map(|held| held.given_back),
                "done"
            );
            ExitCode::SUCCESS
        }
        Err(error) => {
            tracing::error!("{error}");
            ExitCode::FAILURE
        }
    }
}

async fn run(arguments: Arguments) -> Result<WorkerSummary, Error> {
    let mut options = WorkerOptions::new(&arguments.coordinator);
    options.scene_path = arguments.scene;
    options.store = arguments.store.as_deref().map(BakeStore::open).transpose()?;
    let folder = arguments.chunks.unwrap_or_else(default_folder);
    options.memory = arguments.memory.map(|size| MemoryLimit::new(size.0, folder));
    options.threads = arguments.threads;
    options.name = arguments.name;
    options.patience = Duration::from_secs(arguments.patience);
    Ok(Worker::run(options, signalled()).await?)
}

/// Until someone asks the process to stop.
async fn signalled() {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        if let Ok(mut terminate) = signal(SignalKind::terminate()) {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = tokio::signal::ctrl_c() => {}
            }
            return;
        }
    }
    // Without a handler the default action applies: the process ends.
    if tokio::signal::ctrl_c().await.is_err() {
        std::future::pending::<()>().await;
    }
}
