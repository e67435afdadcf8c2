//! `sightline-coordinator`: plans a bake, leases its tasks to workers, publishes the dataset.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use bytesize::ByteSize;
use clap::Parser;
use sightline_coordinator::edit;
use sightline_coordinator::health::Health;
use sightline_coordinator::{
    Coordinator, CoordinatorHandle, CoordinatorOptions, Prepared, SecurityFlags, ShareScene,
    fetch_scene, prepare_from, share_scene,
};
use sightline_jobs::BakeConfig;
use sightline_store::{BakeStore, FileCache, local_path};
use sightline_telemetry::metrics::{Listener, Registry};
use sightline_telemetry::{LogOptions, WatchFlags, stop};

/// Plans a bake, leases its tasks to workers, publishes the dataset.
#[derive(Debug, Parser)]
#[command(version, after_help = "Stop it at any time; the same command goes on with the bake.")]
struct Arguments {
    /// The scene: a .gltf or .glb file or a particle table, or its URL in an object store.
    scene: String,
    /// Where the dataset goes: a folder or an object store URL.
    #[arg(long, value_name = "LOCATION")]
    out: String,
    /// The configuration of the bake.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// A configuration key to set, over what the file says.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Address to listen on.
    #[arg(long, default_value = "127.0.0.1:7070", env = "SIGHTLINE_LISTEN")]
    listen: SocketAddr,
    /// How long a task stays with a worker that is silent, ms.
    #[arg(long, default_value_t = 30_000, value_parser = clap::value_parser!(u64).range(100..))]
    lease_ms: u64,
    /// Give up after this time without any worker, s. Without it, wait for ever.
    #[arg(long, value_name = "SECONDS")]
    worker_wait: Option<u64>,
    /// Put copies of the scene's files into the store, for workers that do not see this machine's disk:
    /// always, never, or when the store is an object store (auto).
    #[arg(long, value_name = "WHEN", default_value = "auto", env = "SIGHTLINE_SHARE_SCENE")]
    share_scene: ShareScene,
    /// Folder for copies of a scene from an object store.
    #[arg(long, value_name = "DIR", env = "SIGHTLINE_CACHE")]
    cache: Option<PathBuf>,
    /// Limit of that folder, such as 20GiB or 500MB.
    #[arg(long, value_name = "SIZE", default_value = "20GiB", env = "SIGHTLINE_CACHE_SIZE")]
    cache_size: ByteSize,
    #[command(flatten)]
    security: SecurityFlags,
    /// Answer health checks there in plain text, and nothing else: for probes, which have no
    /// certificates.
    #[arg(long, value_name = "HOST:PORT", env = "SIGHTLINE_HEALTH")]
    health: Option<SocketAddr>,
    #[command(flatten)]
    watch: WatchFlags,
}

type Error = Box<dyn std::error::Error + Send + Sync>;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let format = arguments.watch.log_format;
    let logs = LogOptions { format, filter: "info", service: "sightline-coordinator" };
    stop::run(logs, run(arguments))
}

async fn run(arguments: Arguments) -> Result<(), Error> {
    let mut stop = std::pin::pin!(stop::signalled(|| std::process::exit(stop::INTERRUPTED)));
    let (health, mut coordinator, _listener) = tokio::select! {
        started = start(arguments) => started?,
        () = &mut stop => return Err("stopped before the bake began; the same command starts it".into()),
    };
    if let Some(health) = &health {
        health.ready().await;
    }
    let mut status = coordinator.status();
    let ended = async { status.wait_for(|s| s.phase.is_final()).await.map(drop) };
    tokio::select! {
        _ = ended => {}
        () = stop => coordinator.shutdown(),
    }
    let summary = coordinator.join().await?;
    tracing::info!(
        manifest = summary.manifest,
        changed = summary.changed,
        cells = summary.status.dataset_cells(),
        solve_ms = summary.status.solve_ms,
        merge_ms = summary.status.merge_ms,
        "done"
    );
    Ok(())
}

type Started = (Option<Health>, CoordinatorHandle, Option<Listener>);

/// Plans the bake and starts its coordinator.
async fn start(arguments: Arguments) -> Result<Started, Error> {
    let text = std::fs::read_to_string(&arguments.config)
        .map_err(|error| format!("{}: {error}", arguments.config.display()))?;
    let overrides = arguments
        .overrides
        .iter()
        .map(|text| text.split_once('=').ok_or(format!("--set {text}: write KEY=VALUE")))
        .collect::<Result<Vec<_>, _>>()?;
    let config = BakeConfig::from_toml_with(&text, &overrides)?;
    let health = match arguments.health {
        Some(address) => Some(Health::serve(address).await?),
        None => None,
    };
    let store = BakeStore::open_or_create(&arguments.out)?;
    let (scene, fetched) = match local_path(&arguments.scene) {
        Some(path) => (path, None),
        None => {
            let folder = arguments.cache.unwrap_or_else(FileCache::default_folder);
            let cache = FileCache::open(&folder, arguments.cache_size.0)?;
            let fetched = fetch_scene(&arguments.scene, &config.scene.particles, &cache).await?;
            (fetched.path, Some(fetched.view))
        }
    };
    let uri = match &fetched {
        Some(_) => arguments.scene.clone(),
        None => scene.display().to_string(),
    };
    let path = scene.clone();
    let Prepared { plan, publisher, content, scene: _ } =
        tokio::task::spawn_blocking(move || prepare_from(&path, &uri, config, None)).await??;
    share_scene(&store, &plan.scene, &scene, &plan.config, arguments.share_scene).await?;
    drop(fetched);
    if let Some(common) = edit::compare(&store, &plan, content.as_ref()).await? {
        let edit::Common { bake, objects, same } = common;
        tracing::info!(
            bake,
            objects,
            same,
            "what did not change is taken over from an earlier bake"
        );
    }

    let mut options = CoordinatorOptions::new(arguments.listen, store, plan, Arc::new(publisher));
    options.policy.lease_ms = arguments.lease_ms;
    options.security = arguments.security.into();
    let mut registry = Registry::default();
    options.metrics.register(&mut registry);
    let listener = match arguments.watch.metrics {
        Some(address) => Some(Listener::start(address, registry).await?),
        None => None,
    };
    options.worker_wait = arguments.worker_wait.map(Duration::from_secs);
    let coordinator = Coordinator::start(options).await?;
    Ok((health, coordinator, listener))
}
