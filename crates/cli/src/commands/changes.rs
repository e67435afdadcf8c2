//! What changed since the last bake into a folder: scene files and configuration keys.

use serde_json::Value;
use sightline_jobs::{BakeConfig, KEYS, Plan};
use sightline_scene::SceneDigest;
use sightline_store::{BakeStore, Manifest, current};

use super::dataset::{changed_files, plans};
use crate::failure::Result;

/// What a folder holds with regard to a bake that is about to start.
#[derive(Debug, PartialEq, Eq)]
pub enum Before {
    /// Nothing.
    Nothing,
    /// A bake of the same input, unfinished or finished.
    Same,
    /// A bake or dataset of other input; the sentences say what changed since.
    Other(Vec<String>),
}

/// The input of an earlier bake.
struct Earlier {
    digest: String,
    files: Vec<(String, String)>,
    config: Value,
}

impl Earlier {
    fn of_plan(plan: &Plan) -> Self {
        let files = plan.scene.files.iter().map(|f| (f.path.clone(), f.digest.clone())).collect();
        Self { digest: plan.scene.digest.clone(), files, config: config_json(&plan.config) }
    }

    fn of_manifest(manifest: &Manifest) -> Self {
        let source = &manifest.scene;
        let files = source.files.iter().map(|f| (f.name.clone(), f.blake3.clone())).collect();
        Self { digest: source.hash.clone(), files, config: manifest.config.clone() }
    }

    fn changes(&self, digest: &SceneDigest, config: &Value) -> Vec<String> {
        let mut changes = Vec::new();
        if self.digest != digest.combined {
            let files: Vec<(&str, &str)> =
                self.files.iter().map(|(n, h)| (n.as_str(), h.as_str())).collect();
            changes.append(&mut changed_files(&files, digest));
        }
        changes.append(&mut changed_keys(&self.config, config));
        changes
    }
}

/// Compares what is in `store` with the input of a bake.
pub async fn since_last_bake(
    store: &BakeStore,
    digest: &SceneDigest,
    config: &BakeConfig,
) -> Result<Before> {
    let bakes = plans(store).await?;
    let same = |plan: &Plan| plan.scene.digest == digest.combined && plan.config == *config;
    if bakes.iter().any(same) {
        return Ok(Before::Same);
    }
    let config = config_json(config);
    // The published dataset is what people know; without one, the bake that differs least.
    if let Some((_, manifest)) = current(store).await? {
        let changes = Earlier::of_manifest(&manifest).changes(digest, &config);
        return Ok(if changes.is_empty() { Before::Same } else { Before::Other(changes) });
    }
    let changes = bakes.iter().map(|plan| Earlier::of_plan(plan).changes(digest, &config));
    Ok(changes.min_by_key(Vec::len).map_or(Before::Nothing, Before::Other))
}

/// True when the manifest is that of the bake with this plan.
pub fn is_of(manifest: &Manifest, plan: &Plan) -> bool {
    manifest.scene.hash == plan.scene.digest
        && changed_keys(&manifest.config, &config_json(&plan.config)).is_empty()
}

fn config_json(config: &BakeConfig) -> Value {
    serde_json::to_value(config).unwrap_or_default()
}

/// The keys whose values differ. A section that one side lacks is not compared: the manifest
/// leaves `[tasks]` out.
fn changed_keys(old: &Value, new: &Value) -> Vec<String> {
    let mut changes = Vec::new();
    for key in KEYS {
        let Some((section, name)) = key.key.split_once('.') else { continue };
        let (Some(old), Some(new)) = (old.get(section), new.get(section)) else { continue };
        let (old, new) = (&old[name], &new[name]);
        if old != new {
            changes.push(format!("{} changed from {} to {}", key.key, shown(old), shown(new)));
        }
    }
    changes
}

fn shown(value: &Value) -> String {
    if value.is_null() { "absent".into() } else { value.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(text: &str) -> BakeConfig {
        BakeConfig::from_toml(&format!("[region]\nrectangles = [[0, 0, 1, 1]]\n{text}")).unwrap()
    }

    #[test]
    fn changed_keys_are_named_with_both_values() {
        let old = config_json(&config("cell_size = 10.0"));
        let new = config_json(&config("cell_size = 5.0\nground_from = 2.0\n[solver]\nrows = 104"));
        assert_eq!(
            changed_keys(&old, &new),
            [
                "region.cell_size changed from 10.0 to 5.0",
                "region.ground_from changed from absent to 2.0",
                "solver.rows changed from 24 to 104",
            ]
        );
        assert!(changed_keys(&old, &old).is_empty());
    }

    #[test]
    fn the_canonical_form_of_a_manifest_compares() {
        let config = config("");
        let canonical: Value = serde_json::from_str(&config.canonical_json()).unwrap();
        assert!(changed_keys(&canonical, &config_json(&config)).is_empty());
    }
}
