//! `sightline bake`: a bake on this machine.
//!
//! An embedded coordinator and an embedded worker speak the same gRPC services as the distributed
//! form, over loopback. Ctrl-C stops both; what is committed stays, and the same command goes on.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value, json};
use sightline_coordinator::edit;
use sightline_coordinator::{
    Coordinator, CoordinatorHandle, CoordinatorOptions, Prepared, Summary as Ended, prepare_from,
};
use sightline_jobs::{BakeConfig, BakeStatus, Done, Phase, Plan};
use sightline_scene::{Keeper, SceneContent, SceneDigest};
use sightline_store::{BakeStore, Dataset, StoreError, keys};
use sightline_worker::{Worker, WorkerOptions};
use tokio::sync::oneshot;

use super::changes::{Before, since_last_bake};
use super::dataset::Summary;
use super::{Joining, signalled};
use crate::arguments::{Bake, BakeInput};
use crate::failure::{Failure, Kind, Result};
use crate::memory::{Phases, add_held, held_json};
use crate::progress::{Progress, note};
use crate::report::{Table, count, print, print_json, thousands};

/// How long the embedded coordinator waits for its worker to hear of the end.
const LINGER: Duration = Duration::from_secs(1);

pub fn run(command: &Bake) -> Result<()> {
    if command.dry_run {
        return dry_run(command);
    }
    let baked = bake(&command.input, command.threads, &command.joining)?;
    if command.json {
        print_json(&baked.to_json());
    } else {
        print(&baked.to_text());
    }
    Ok(())
}

/// A finished bake.
pub struct Baked {
    out: String,
    plan: Plan,
    ended: Ended,
    summary: Summary,
    phases: Phases,
    memory: Option<Arc<Keeper>>,
}

/// Bakes on this machine, from reading the scene to the published dataset.
pub fn bake(input: &BakeInput, threads: Option<u32>, joining: &Joining) -> Result<Baked> {
    let config = read_config(input)?;
    let mut phases = Phases::start("read and plan");
    let prepared = prepare_on(input, config, threads)?;
    let plan = prepared.plan.clone();
    let memory = prepared.scene.memory.clone();
    let runtime = super::runtime()?;
    let (ended, summary) = runtime.block_on(async {
        let store = open_store(input, &prepared.scene.digest, &plan).await?;
        phases.next("solve");
        let ended = solve(prepared, store.clone(), threads, joining, &mut phases).await?;
        phases.next("summarize");
        let summary = Summary::of(&Dataset::open(&store).await?).await?;
        Ok::<_, Failure>((ended, summary))
    })?;
    phases.finish();
    let out = sightline_store::redacted(&input.out);
    Ok(Baked { out, plan, ended, summary, phases, memory })
}

/// The configuration: the file, overruled by flags.
pub fn read_config(input: &BakeInput) -> Result<BakeConfig> {
    let text = match &input.config {
        None => String::new(),
        Some(path) => read_config_file(path)?,
    };
    let overrides: Vec<(&str, &str)> =
        input.keys.overrides.iter().map(|(k, v)| (*k, v.as_str())).collect();
    Ok(BakeConfig::from_toml_with(&text, &overrides)?)
}

/// The text of a configuration file.
pub fn read_config_file(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).map_err(|e| {
        Failure::io(Kind::Usage, "read the configuration", path, &e)
            .with_help("give a TOML file with --config, or flags alone")
    })
}

/// Reads the scene and plans the bake, on so many threads.
pub fn prepare_on(input: &BakeInput, config: BakeConfig, threads: Option<u32>) -> Result<Prepared> {
    let found = super::scene::locate(&input.scene, &config.scene.particles, &input.cache);
    let found = super::runtime()?.block_on(found)?;
    // Commands that look for the scene later run in other folders.
    let uri = match super::scene::is_elsewhere(&input.scene) {
        true => input.scene.to_string_lossy().into_owned(),
        false => absolute(&found.path).display().to_string(),
    };
    let (path, memory) = (absolute(&found.path), input.memory.limit());
    Ok(super::on_threads(threads, || prepare_from(&path, &uri, config, memory))??)
}

fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf())
}

/// A place that was given for output is no missing input.
fn unusable(error: StoreError) -> Failure {
    match error {
        StoreError::BadLocation { .. } => {
            Failure::new(Kind::Store, error.to_string()).with_help("give another place with --out")
        }
        other => other.into(),
    }
}

/// Opens the output folder, and says what a new bake into it has to do with the last one.
pub async fn open_store(input: &BakeInput, digest: &SceneDigest, plan: &Plan) -> Result<BakeStore> {
    let store = BakeStore::open_or_create(&input.out).map_err(unusable)?;
    // The first request shows whether there is such a bucket, and whether it lets us in.
    store.get_if_exists(keys::POINTER).await.map_err(unusable)?;
    match since_last_bake(&store, digest, &plan.config).await? {
        Before::Nothing => {}
        Before::Same => {
            note(&format!("{} holds a bake of this input: going on with it", store.location()))
        }
        Before::Other(changes) => {
            note(&format!("{} holds a bake of other input:", store.location()));
            for change in &changes {
                note(&format!("  {change}"));
            }
            note("a new bake starts; the old dataset stays until it is done");
        }
    }
    Ok(store)
}

/// Says what a bake has in common with an earlier one.
pub async fn compare(store: &BakeStore, plan: &Plan, content: Option<&SceneContent>) -> Result<()> {
    if let Some(common) = edit::compare(store, plan, content).await? {
        let changed = count(common.objects - common.same, "object");
        let all = thousands(common.objects);
        note(&format!(
            "{changed} of {all} changed since the bake {}: cells that see nothing of it are taken over",
            common.bake
        ));
    }
    Ok(())
}

/// Runs coordinator and worker to the end.
async fn solve(
    prepared: Prepared,
    store: BakeStore,
    threads: Option<u32>,
    joining: &Joining,
    phases: &mut Phases,
) -> Result<Ended> {
    let Prepared { scene, plan, publisher, content } = prepared;
    compare(&store, &plan, content.as_ref()).await?;
    let publisher = Arc::new(publisher);
    let mut options = CoordinatorOptions::new(joining.address(), store.clone(), plan, publisher);
    if joining.listen.is_none() {
        options.linger = LINGER;
    }
    let mut coordinator = Coordinator::start(options).await?;
    joining.announce(coordinator.addr)?;

    let mut options = WorkerOptions::new(&coordinator.url());
    options.store = Some(store);
    options.scene = Some(scene);
    options.threads = threads.unwrap_or(0) as usize;
    options.name = "embedded".into();
    let (stop, stopped) = oneshot::channel::<()>();
    let worker = Worker::run(options, async {
        // Dropping the sender stops the worker as well.
        let _ = stopped.await;
    });
    let mut worker = std::pin::pin!(worker);

    let early = tokio::select! {
        () = watch(&mut coordinator, Some(phases)) => None,
        ended = &mut worker => Some(ended),
    };
    match early {
        Some(Err(error)) => Err(error.into()),
        // A worker that ended well has heard of the end.
        Some(Ok(_)) => {
            let ended = coordinator.join().await?;
            joining.over()?;
            Ok(ended)
        }
        None => {
            if coordinator.status().borrow().phase == Phase::Published {
                joining.over()?;
            }
            let end = async {
                let end = coordinator.join().await;
                drop(stop);
                end
            };
            // How the bake ended is known; a worker that fails on the way out changes nothing.
            let (end, _) = tokio::join!(end, worker);
            Ok(end?)
        }
    }
}

/// Shows progress until the bake is over; a signal stops the coordinator.
pub async fn watch(coordinator: &mut CoordinatorHandle, mut phases: Option<&mut Phases>) {
    let mut status = coordinator.status();
    let first = status.borrow().clone();
    if first.tasks_resumed > 0 {
        let (done, all) = (first.tasks_resumed, first.tasks.tasks);
        note(&format!("{done} of {} were done before", count(u64::from(all), "task")));
    }
    let parts = |status: &BakeStatus| [status.cells, status.segments, status.joins];
    let all = parts(&first).iter().map(|part| part.total).sum();
    let mut progress = Progress::new("bake", "units", all);
    let mut merging = false;
    let mut signal = std::pin::pin!(signalled());
    loop {
        let now = status.borrow_and_update().clone();
        progress.set(parts(&now).iter().map(|part| part.done).sum(), &standing(&now));
        if now.phase == Phase::Merging && !merging {
            merging = true;
            if let Some(phases) = &mut phases {
                phases.next("merge and publish");
            }
        }
        if now.phase.is_final() {
            break;
        }
        tokio::select! {
            changed = status.changed() => {
                if changed.is_err() {
                    break;
                }
            }
            () = &mut signal => {
                note("stopping; what is done is kept");
                coordinator.shutdown();
                break;
            }
        }
    }
    drop(progress);
}

fn standing(status: &BakeStatus) -> String {
    let done = |part: Done| format!("{} of {}", thousands(part.done), thousands(part.total));
    let cells = match status.joins.total {
        0 => format!("{} cells done", done(status.cells)),
        // Each cell counts once a range of states.
        _ => format!("{} cells solved, {} joined", done(status.cells), done(status.joins)),
    };
    match status.phase {
        Phase::Merging => format!("{cells}, merging"),
        _ => cells,
    }
}

impl Baked {
    fn to_json(&self) -> Value {
        let status = &self.ended.status;
        json!({
            "dataset": self.out,
            "bake_id": self.plan.bake_id,
            "manifest": self.ended.manifest,
            "changed": self.ended.changed,
            "cells": self.plan.cells.len(),
            "skipped": self.plan.skipped,
            "segments": self.plan.segments.len(),
            "states": self.plan.states(),
            "tasks": self.plan.tasks.len(),
            "tasks_resumed": status.tasks_resumed,
            "segments_reused": status.segments_reused,
            "cells_reused": status.cells_reused,
            "solve_ms": status.solve_ms,
            "merge_ms": status.merge_ms,
            "worker_solve_ms": status.worker_solve_ms,
            "summary": self.summary.to_json(),
            "time": self.phases.to_json(),
            "memory": held_json(self.memory.as_deref()),
        })
    }

    /// The summary for people.
    pub fn to_text(&self) -> String {
        let mut table = Table::default();
        let changed = if self.ended.changed { "" } else { ", as it was" };
        table.row("dataset", format!("{}, manifest {}{changed}", self.out, self.ended.manifest));
        self.summary.add_to(&mut table);
        add_skipped(&mut table, &self.plan);
        table.row("segments", thousands(self.plan.segments.len() as u64));
        let resumed = self.ended.status.tasks_resumed;
        if resumed > 0 {
            let all = count(self.plan.tasks.len() as u64, "task");
            table.row("resumed", format!("{resumed} of {all} were done before"));
        }
        let Done { total, .. } = self.ended.status.cells;
        let reused = self.ended.status.cells_reused;
        if reused > 0 {
            let (reused, all) = (thousands(reused), count(total, "cell"));
            table.row("taken over", format!("{reused} of {all}"));
        }
        table.gap();
        self.phases.add_to(&mut table);
        if let Some(keeper) = &self.memory {
            add_held(&mut table, &keeper.held());
        }
        table.to_string()
    }
}

fn add_skipped(table: &mut Table, plan: &Plan) {
    for (reason, n) in &plan.skipped.0 {
        table.row(format!("skipped: {reason}"), count(*n, "cell"));
    }
}

/// Prints the plan.
fn dry_run(command: &Bake) -> Result<()> {
    let config = read_config(&command.input)?;
    let mut phases = Phases::start("read and plan");
    let Prepared { scene, plan, .. } = prepare_on(&command.input, config, command.threads)?;
    phases.finish();
    let length: f64 = plan.segments.iter().map(|s| (s.v1 - s.v0).length()).sum();
    if command.json {
        print_json(&json!({
            "dry_run": true,
            "bake_id": plan.bake_id,
            "scene": plan.scene,
            "primitives": scene.geometry.primitive_count(),
            "config": plan.config,
            "cells": plan.cells.len(),
            "skipped": plan.skipped,
            "segments": plan.segments.len(),
            "segment_metres": length,
            "states": plan.states(),
            "tasks": plan.tasks.len(),
            "time": phases.to_json(),
        }));
        return Ok(());
    }
    let mut table = Table::default();
    table
        .row("bake", plan.bake_id.clone())
        .row("scene", plan.scene.uri.clone())
        .row("triangles", thousands(u64::from(scene.geometry.primitive_count())))
        .row("cells", thousands(plan.cells.len() as u64));
    add_skipped(&mut table, &plan);
    table
        .row(
            "segments",
            format!("{}, {length:.0} m together", thousands(plan.segments.len() as u64)),
        )
        .row("states", thousands(u64::from(plan.states())))
        .row("tasks", thousands(plan.tasks.len() as u64));
    phases.add_to(&mut table);
    print(&format!("{table}\nConfiguration:\n{}", plan.config.to_toml()));
    Ok(())
}
