//! What a store holds of bakes, without a coordinator: plans, commits, epochs, and what is
//! published.

use prost::Message;
use serde_json::{Value, json};
use sightline_jobs::{Done, Plan, Task};
use sightline_proto::v1;
use sightline_store::{BakeStore, current, keys};

use super::changes::is_of;
use super::dataset::plans;
use crate::failure::{Failure, Kind, Result};
use crate::report::{Table, count, thousands};

/// Missing tasks that are named for people; JSON has them all.
const NAMED_MAX: usize = 12;

/// What a location holds.
pub struct Stored {
    location: String,
    /// Number and cells of the current manifest.
    published: Option<(u64, u64)>,
    bakes: Vec<StoredBake>,
}

/// What is stored of one bake.
struct StoredBake {
    id: String,
    scene: String,
    /// The newest, and who took it.
    epoch: Option<(u64, String)>,
    is_published: bool,
    tasks: Done,
    /// By kind, in the order of the plan.
    kinds: Vec<(&'static str, Done)>,
    missing: Vec<u32>,
}

impl Stored {
    pub async fn read(location: &str) -> Result<Self> {
        let store = BakeStore::open(location)?;
        let current = current(&store).await?;
        let mut bakes = Vec::new();
        for plan in plans(&store).await? {
            let is_published = current.as_ref().is_some_and(|(_, found)| is_of(found, &plan));
            bakes.push(StoredBake::read(&store, &plan, is_published).await?);
        }
        if bakes.is_empty() && current.is_none() {
            return Err(Failure::new(
                Kind::Input,
                format!("{location} holds no bake and no dataset"),
            )
            .with_help("give the folder or URL that a bake writes to, or that of a coordinator"));
        }
        let published = current.map(|(pointer, found)| (pointer.manifest, found.cells));
        Ok(Self { location: location.to_owned(), published, bakes })
    }

    pub fn to_json(&self) -> Value {
        let bakes: Vec<Value> = self.bakes.iter().map(StoredBake::to_json).collect();
        let (manifest, cells) = self.published.unzip();
        json!({
            "location": self.location,
            "published": self.published.is_some(),
            "manifest": manifest,
            "cells": cells,
            "bakes": bakes,
        })
    }

    pub fn to_text(&self) -> String {
        let mut table = Table::default();
        table.row("location", &self.location);
        let published = self.published.map_or_else(
            || "nothing".to_owned(),
            |(manifest, cells)| format!("manifest {manifest}, {}", count(cells, "cell")),
        );
        table.row("published", published);
        for bake in &self.bakes {
            table.gap();
            bake.describe(&mut table);
        }
        table.to_string()
    }
}

impl StoredBake {
    async fn read(store: &BakeStore, plan: &Plan, is_published: bool) -> Result<Self> {
        let listed = store.list(&keys::commits(&plan.bake_id)).await?;
        let mut is_committed = vec![false; plan.tasks.len()];
        for task in listed.iter().filter_map(|key| keys::commit_task(key)) {
            if let Some(task) = is_committed.get_mut(task as usize) {
                *task = true;
            }
        }
        let done = |task: &Task| is_committed[task.id.index()];
        let mut kinds: Vec<(&'static str, Done)> = Vec::new();
        for task in &plan.tasks {
            let name = task.kind.name();
            if kinds.iter().all(|(kind, _)| *kind != name) {
                kinds.push((name, Done::default()));
            }
            for (_, counted) in kinds.iter_mut().filter(|(kind, _)| *kind == name) {
                counted.total += 1;
                counted.done += u64::from(done(task));
            }
        }
        let missing: Vec<u32> = plan.tasks.iter().filter(|t| !done(t)).map(|t| t.id.0).collect();
        let total = plan.tasks.len() as u64;
        Ok(Self {
            id: plan.bake_id.clone(),
            scene: plan.scene.name.clone(),
            epoch: newest_epoch(store, &plan.bake_id).await?,
            is_published,
            tasks: Done { done: total - missing.len() as u64, total },
            kinds,
            missing,
        })
    }

    fn to_json(&self) -> Value {
        let kinds: serde_json::Map<String, Value> =
            self.kinds.iter().map(|(kind, done)| ((*kind).to_owned(), json!(done))).collect();
        let (epoch, coordinator) = self.epoch.as_ref().map(|(n, who)| (n, who)).unzip();
        json!({
            "bake": self.id,
            "scene": self.scene,
            "epoch": epoch,
            "coordinator": coordinator,
            "published": self.is_published,
            "tasks": self.tasks,
            "kinds": kinds,
            "missing": self.missing,
        })
    }

    fn describe(&self, table: &mut Table) {
        let of =
            |part: Done| format!("{} of {} tasks", thousands(part.done), thousands(part.total));
        table.row("bake", format!("{}, of {}", self.id, self.scene));
        let epoch = self.epoch.as_ref().map_or_else(
            || "no coordinator yet".to_owned(),
            |(number, who)| format!("{number}, {who}"),
        );
        table.row("epoch", epoch);
        table.row("committed", of(self.tasks));
        for (kind, done) in &self.kinds {
            table.row(*kind, of(*done));
        }
        let state = match (self.is_published, self.missing.is_empty()) {
            (true, _) => "published".to_owned(),
            (false, true) => "complete, not published: the same command publishes it".to_owned(),
            (false, false) => {
                let named = self.missing.iter().take(NAMED_MAX).map(u32::to_string);
                let mut named = named.collect::<Vec<_>>().join(", ");
                if self.missing.len() > NAMED_MAX {
                    named.push_str(", …");
                }
                format!("{} missing: {named}", count(self.missing.len() as u64, "task"))
            }
        };
        table.row("state", state);
    }
}

async fn newest_epoch(store: &BakeStore, bake: &str) -> Result<Option<(u64, String)>> {
    let listed = store.list(&keys::epochs(bake)).await?;
    let Some(key) = listed.last() else { return Ok(None) };
    let epoch = v1::Epoch::decode(store.get(key).await?).unwrap_or_default();
    Ok(Some((epoch.number, epoch.coordinator)))
}
