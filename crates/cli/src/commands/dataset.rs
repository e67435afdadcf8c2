//! Datasets and their scenes, as the commands open them.
//!
//! The scene of a dataset is, in this order: the one given by `--scene`; where a bake in the
//! dataset's folder read it; a file of its name beside or in the dataset's folder; fetched from the URL
//! that a bake read it from, or from the copies in the dataset's store. Whichever it is, its digest has to be the one in the manifest: primitive numbers mean nothing in another
//! scene.

use std::path::{Path, PathBuf};

use futures::TryStreamExt;
use serde_json::{Value, json};
use sightline_jobs::{Plan, SceneFile};
use sightline_scene::{OpenOptions, Scene, SceneDigest};
use sightline_store::{BakeStore, Dataset, Manifest, keys, local_path};
use sightline_worker::{SceneOnDisk, scene_files};

use crate::arguments::{CacheFlags, DatasetInput};
use crate::failure::{Failure, Kind, Result};
use crate::progress::note;

/// Opens the dataset in a folder.
pub async fn open(location: &str) -> Result<Dataset> {
    Ok(Dataset::open(&BakeStore::open(location)?).await?)
}

/// Opens a dataset and the scene that it was baked from; where the scene lies comes with it.
pub async fn open_with_scene(input: &DatasetInput) -> Result<(Dataset, Scene, SceneOnDisk)> {
    let dataset = open(&input.dataset).await?;
    let found = find_scene(&dataset, input).await?;
    let mut options = found.with_tables(open_options(dataset.manifest(), &found.path));
    options.memory = input.memory.limit();
    let scene = Scene::open(&found.path, &options)?;
    expect_digest(dataset.manifest(), &scene.digest, &found.path)?;
    Ok((dataset, scene, found))
}

/// How the bake read the scene: see-through patterns decide what hides what, and particles are in tables
/// relative to it.
fn open_options(manifest: &Manifest, path: &Path) -> OpenOptions {
    let scene = &manifest.config["scene"];
    let texts = |key: &str| -> Vec<String> {
        let texts = scene[key].as_array();
        texts.into_iter().flatten().filter_map(Value::as_str).map(str::to_owned).collect()
    };
    // Datasets from before there was motion were baked at rest.
    let motion_error = scene["motion_error"].as_f64();
    let animation = if motion_error.is_some() { scene["animation"].as_str() } else { Some("none") };
    OpenOptions::of_bake(
        path,
        &texts("see_through"),
        &tables(manifest),
        animation,
        motion_error.unwrap_or_else(|| OpenOptions::default().motion_error),
    )
}

/// The particle tables of the configuration.
fn tables(manifest: &Manifest) -> Vec<String> {
    let tables = manifest.config["scene"]["particles"].as_array();
    tables.into_iter().flatten().filter_map(Value::as_str).map(str::to_owned).collect()
}

async fn find_scene(dataset: &Dataset, input: &DatasetInput) -> Result<SceneOnDisk> {
    let manifest = dataset.manifest();
    let tables = tables(manifest);
    if let Some(path) = &input.scene {
        return super::scene::locate(path, &tables, &input.cache).await;
    }
    let source = &manifest.scene;
    let mut uris = Vec::new();
    for plan in plans(dataset.store()).await? {
        if plan.scene.digest == source.hash {
            uris.push(plan.scene.uri);
        }
    }
    let mut candidates: Vec<PathBuf> = uris.iter().filter_map(|uri| local_path(uri)).collect();
    if let Some(folder) = local_path(&input.dataset) {
        candidates.push(folder.join("..").join(&source.uri));
        candidates.push(folder.join(&source.uri));
    }
    for path in &candidates {
        let tables = open_options(manifest, path).particles;
        let digest = || sightline_scene::digest_with(path, &tables);
        if path.is_file() && digest().is_ok_and(|d| d.combined == source.hash) {
            return Ok(SceneOnDisk::at(path.clone()));
        }
    }
    let mut looked: Vec<String> = candidates.iter().map(|p| p.display().to_string()).collect();
    uris.retain(|uri| local_path(uri).is_none());
    // The store may hold copies, whether or not there is a URL.
    uris.push(source.uri.clone());
    for uri in uris {
        match fetch(dataset, &uri, &tables, &input.cache).await {
            Ok(found) => return Ok(found),
            Err(error) => looked.push(error.to_string()),
        }
    }
    Err(Failure::new(
        Kind::Input,
        format!("the scene `{}` of this dataset was not found: {}", source.uri, looked.join(", ")),
    )
    .with_help("give the scene that was baked with --scene"))
}

/// The scene by the hashes of its files: from a URL, or from the copies in the dataset's store.
async fn fetch(
    dataset: &Dataset,
    uri: &str,
    tables: &[String],
    cache: &CacheFlags,
) -> Result<SceneOnDisk> {
    let files = dataset.manifest().scene.files.iter();
    let files: Vec<SceneFile> = files
        .map(|f| SceneFile { path: f.name.clone(), bytes: f.bytes, digest: f.blake3.clone() })
        .collect();
    Ok(scene_files::fetch(uri, &files, tables, dataset.store(), &cache.open()?).await?)
}

fn expect_digest(manifest: &Manifest, found: &SceneDigest, path: &Path) -> Result<()> {
    if found.combined == manifest.scene.hash {
        return Ok(());
    }
    let old: Vec<(&str, &str)> =
        manifest.scene.files.iter().map(|f| (f.name.as_str(), f.blake3.as_str())).collect();
    let changes = changed_files(&old, found);
    Err(Failure::new(
        Kind::Input,
        format!("`{}` is not the scene that was baked: {}", path.display(), changes.join("; ")),
    )
    .with_help("give the scene that was baked with --scene, or bake this one"))
}

/// What differs between the files of two scenes, one sentence each; `old` is (name, BLAKE3).
pub fn changed_files(old: &[(&str, &str)], new: &SceneDigest) -> Vec<String> {
    let mut changes = Vec::new();
    for (name, hash) in old {
        match new.files.iter().find(|f| f.name == *name) {
            None => changes.push(format!("scene file `{name}` is not part of it any more")),
            Some(f) if f.blake3 != *hash => changes.push(format!("scene file `{name}` changed")),
            Some(_) => {}
        }
    }
    for file in &new.files {
        if !old.iter().any(|(name, _)| *name == file.name) {
            changes.push(format!("scene file `{}` is new", file.name));
        }
    }
    if changes.is_empty() {
        changes.push("its files come in another order".into());
    }
    changes
}

/// The plans of all bakes in a store. What cannot be read, of another version say, is left out.
pub async fn plans(store: &BakeStore) -> Result<Vec<Plan>> {
    let mut plans = Vec::new();
    for key in store.list(keys::BAKE_FOLDER).await? {
        if !key.ends_with("/plan.bin") {
            continue;
        }
        match sightline_proto::decode_plan(&store.get(&key).await?) {
            Ok(plan) => plans.push(plan),
            Err(error) => note(&format!("`{key}` is left out: {error}")),
        }
    }
    Ok(plans)
}

/// Figures over all cells of a dataset.
#[derive(Clone, Debug, Default)]
pub struct Summary {
    /// Cells with a set.
    pub cells: u64,
    /// Primitives of the scene.
    pub primitives: u64,
    /// Of these, particles.
    pub particles: u64,
    /// Mean number of visible primitives a cell.
    pub visible_mean: f64,
    /// Largest number of visible primitives of a cell.
    pub visible_max: u64,
    /// Rays that measured the error while baking.
    pub heldout_rays: u64,
    /// Mean held-out pixel error over the cells, share of pixels.
    pub error_mean: f64,
    /// Largest 95 % upper bound of a cell's mean pixel error, share of pixels.
    pub error_upper: f64,
    /// Cells whose target was met.
    pub targets_met: u64,
    /// Segments solved over all cells; a shared one counts for each of its cells.
    pub segments: u64,
    /// Rays of the solver's grids over all cells; those of shared segments for each cell.
    pub solver_rays: u64,
    /// Moving objects and particles in states in which they were skipped, over the tiles of all cells.
    pub skipped_movers: u64,
    /// Held-out pixel error of the worst viewpoint of all cells, share of pixels.
    pub error_max: f64,
    /// Refinement rounds of all cells.
    pub refinements: u64,
}

impl Summary {
    /// Reads all cells; of each, the row of all states.
    pub async fn of(dataset: &Dataset) -> Result<Self> {
        let scene = &dataset.manifest().scene;
        let (primitives, particles) = (scene.primitives(), scene.particles);
        let mut out = Self { primitives, particles, ..Self::default() };
        let (mut visible, mut error) = (0u64, 0.0f64);
        let mut rows = std::pin::pin!(dataset.cell_rows());
        while let Some(row) = rows.try_next().await? {
            if row.states() != (0..dataset.states()) {
                continue;
            }
            let members = row.set.len();
            out.cells += 1;
            visible += members;
            out.visible_max = out.visible_max.max(members);
            let effort = &row.effort;
            out.heldout_rays += effort.heldout_rays;
            out.refinements += u64::from(effort.refinements);
            out.segments += u64::from(effort.segments);
            out.solver_rays += effort.solver_rays;
            out.skipped_movers += effort.skipped_movers;
            out.targets_met += u64::from(effort.target_met);
            error += effort.heldout_error_mean;
            out.error_upper = out.error_upper.max(effort.heldout_error_upper);
            out.error_max = out.error_max.max(effort.heldout_error_max);
        }
        let cells = out.cells.max(1) as f64;
        (out.visible_mean, out.error_mean) = (visible as f64 / cells, error / cells);
        Ok(out)
    }

    /// The figures as JSON.
    pub fn to_json(&self) -> Value {
        json!({
            "cells": self.cells,
            "primitives": self.primitives,
            "visible_mean": self.visible_mean,
            "visible_max": self.visible_max,
            "reduction": self.reduction(),
            "heldout_rays": self.heldout_rays,
            "heldout_error_mean": self.error_mean,
            "heldout_error_upper_max": self.error_upper,
            "heldout_error_max": self.error_max,
            "refinements": self.refinements,
            "targets_met": self.targets_met,
            "segments": self.segments,
            "solver_rays": self.solver_rays,
            "skipped_movers": self.skipped_movers,
        })
    }

    /// Primitives of the scene for each visible one, on average; absent when nothing is visible.
    pub fn reduction(&self) -> Option<f64> {
        (self.visible_mean > 0.0).then(|| self.primitives as f64 / self.visible_mean)
    }

    /// Adds the figures to a table.
    pub fn add_to(&self, table: &mut crate::report::Table) {
        use crate::report::{count, percent, thousands};
        let triangles = self.primitives - self.particles;
        table.row("cells", thousands(self.cells)).row("triangles", thousands(triangles));
        if self.particles > 0 {
            table.row("particles", thousands(self.particles));
        }
        if self.cells == 0 {
            return;
        }
        table.row(
            "visible a cell",
            format!(
                "mean {}, max {}",
                thousands(self.visible_mean.round() as u64),
                thousands(self.visible_max)
            ),
        );
        if let Some(factor) = self.reduction() {
            let kind = if self.particles > 0 { "primitives" } else { "triangles" };
            table.row("reduction", format!("{factor:.1} times fewer {kind}"));
        }
        if self.heldout_rays > 0 {
            table.row(
                "pixel error",
                format!(
                    "mean {}, worst viewpoint {} ({} held-out rays)",
                    percent(self.error_mean),
                    percent(self.error_max),
                    thousands(self.heldout_rays)
                ),
            );
            let (met, all) = (thousands(self.targets_met), count(self.cells, "cell"));
            table.row("target met", format!("in {met} of {all}"));
        }
        if self.skipped_movers > 0 {
            let times = thousands(self.skipped_movers);
            table.row("hidden movers", format!("skipped {times} times, once a tile and state"));
        }
        table.row(
            "solved",
            format!(
                "{} of the cells, {} rays",
                count(self.segments, "segment"),
                thousands(self.solver_rays)
            ),
        );
    }
}
