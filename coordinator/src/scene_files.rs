//! Scene files from and to object stores.
//!
//! - [`fetch_scene`]: a scene that is named by a URL, with all files that a bake reads, on this machine.
//! - [`share_scene`]: copies of a scene's files in the bake's store, for workers that do not see the
//!   coordinator's disk. A copy is named by its content (`bake/scene/<hash>`), so all bakes of a scene
//!   share one, and a second coordinator finds what the first has written. Images are left out.

use std::path::{Path, PathBuf};

use sightline_jobs::{BakeConfig, SceneRef};
use sightline_scene::{SceneError, external_buffers};
use sightline_store::{BakeStore, CachedFile, FileCache, FileView, StoreError, key_beside, keys};

use crate::prepare::open_options;

/// Whether workers get copies of the scene's files from the store.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ShareScene {
    /// When the store is an object store and the scene lies on this machine.
    #[default]
    Auto,
    /// In any case.
    Always,
    /// Workers find the scene where the coordinator does, or where they are told.
    Never,
}

impl std::str::FromStr for ShareScene {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self::Auto),
            "always" => Ok(Self::Always),
            "never" => Ok(Self::Never),
            _ => Err("give auto, always or never".into()),
        }
    }
}

/// Why the files of a scene cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum SceneFilesError {
    /// The store or the cache failed.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The main file is refused.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// There is nothing at the URL.
    #[error("there is no scene at {url}; check bucket and key")]
    NoScene {
        /// The URL, without secrets.
        url: String,
    },
    /// A table of the configuration cannot be named beside the scene.
    #[error(
        "the particle table `{table}` has to lie in the bucket of {url}; give its path from there"
    )]
    TableOutside {
        /// The table as configured.
        table: String,
        /// The scene, without secrets.
        url: String,
    },
}

/// A scene's files on this machine.
#[derive(Debug)]
pub struct FetchedScene {
    /// The main file; other files lie around it as they do in the bucket.
    pub path: PathBuf,
    /// Keeps the files where they are.
    pub view: FileView,
}

/// Fetches the scene at a URL: its main file, the external buffers that it names, and the particle
/// tables of the configuration, which are relative to it. Missing buffers and tables are left to the
/// reader of the scene to name.
///
/// # Errors
/// [`SceneFilesError::NoScene`] when nothing is there; or what the store or the cache reports.
pub async fn fetch_scene(
    url: &str,
    tables: &[String],
    cache: &FileCache,
) -> Result<FetchedScene, SceneFilesError> {
    let shown = || sightline_store::redacted(url);
    let (bucket, key) = BakeStore::open_object(url)?;
    let Some(main) = cache.by_name(&bucket, &key).await? else {
        return Err(SceneFilesError::NoScene { url: shown() });
    };
    let mut names = Vec::new();
    for buffer in buffers_of(&main, &key)? {
        names.extend(key_beside(&key, &buffer));
    }
    for table in tables {
        let outside = || SceneFilesError::TableOutside { table: table.clone(), url: shown() };
        names.push(key_beside(&key, table).ok_or_else(outside)?);
    }
    let mut files = vec![(key.clone(), main)];
    for name in names {
        if let Some(file) = cache.by_name(&bucket, &name).await? {
            files.push((name, file));
        }
    }
    let view = cache.view(files).await?;
    Ok(FetchedScene { path: view.folder().join(&key), view })
}

/// The external buffers that a main file names; none for a table.
fn buffers_of(main: &CachedFile, key: &str) -> Result<Vec<String>, SceneError> {
    let is_gltf = [".gltf", ".glb"].iter().any(|end| key.to_ascii_lowercase().ends_with(end));
    if is_gltf { external_buffers(main.path()) } else { Ok(Vec::new()) }
}

/// Puts copies of a scene's files into the store, as far as `share` asks for it. The store is probed
/// first: a copy is large, and a store that cannot hold the bake needs none.
///
/// # Errors
/// What [`BakeStore::probe`] and [`BakeStore::upload_content`] report.
pub async fn share_scene(
    store: &BakeStore,
    scene: &SceneRef,
    path: &Path,
    config: &BakeConfig,
    share: ShareScene,
) -> Result<(), StoreError> {
    let is_wanted = match share {
        ShareScene::Auto => store.is_remote() && !sightline_store::is_url(&scene.uri),
        ShareScene::Always => true,
        ShareScene::Never => false,
    };
    if !is_wanted {
        return Ok(());
    }
    store.probe().await?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let tables = open_options(path, config).particles;
    let tables_start = scene.files.len().saturating_sub(tables.len());
    for (i, file) in scene.files.iter().enumerate() {
        let place = match i.checked_sub(tables_start) {
            _ if i == 0 => path.to_owned(),
            Some(table) => tables[table].clone(),
            None => folder.join(&file.path),
        };
        let key = keys::scene_file(&file.digest);
        tracing::info!(file = file.path, bytes = file.bytes, "sharing a file of the scene");
        store.upload_content(&key, &place, &file.digest).await?;
    }
    Ok(())
}
