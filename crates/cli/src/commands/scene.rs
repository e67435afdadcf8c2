//! Scenes as the commands take them: files of this machine, or URLs, whose files are fetched first.

use std::path::Path;

use sightline_coordinator::fetch_scene;
use sightline_store::{FileCache, is_url, local_path};
use sightline_worker::{SceneAccess, SceneOnDisk};

use crate::arguments::CacheFlags;
use crate::failure::Result;

impl CacheFlags {
    /// The flags as workers take them.
    pub fn access(&self, fetch: bool) -> SceneAccess {
        let (cache_folder, cache_bytes_max) = (self.cache.clone(), self.cache_size.0);
        SceneAccess { fetch, cache_folder, cache_bytes_max }
    }

    /// Opens the cache.
    pub fn open(&self) -> Result<FileCache> {
        Ok(self.access(false).cache()?)
    }
}

/// True for a scene that has to be fetched.
pub fn is_elsewhere(scene: &Path) -> bool {
    scene.to_str().is_some_and(|text| is_url(text) && local_path(text).is_none())
}

/// A scene that was given on the command line, with particle tables relative to it.
pub async fn locate(scene: &Path, tables: &[String], cache: &CacheFlags) -> Result<SceneOnDisk> {
    let text = scene.to_string_lossy();
    if is_elsewhere(scene) {
        let fetched = fetch_scene(&text, tables, &cache.open()?).await?;
        return Ok(SceneOnDisk::in_view(fetched.path, fetched.view));
    }
    // A path that is no text is no URL.
    Ok(SceneOnDisk::at(local_path(&text).filter(|_| is_url(&text)).unwrap_or_else(|| scene.into())))
}
