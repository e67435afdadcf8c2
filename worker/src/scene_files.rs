//! The scene of a bake on a machine that may not have it.
//!
//! The plan names the files that a bake reads (the main file, its buffers, particle tables; never
//! images) with their hashes. Where they do not lie at the path that the coordinator used, they are
//! fetched by hash into a cache: from beside the scene's URL, where it has one, or from the copies that
//! the coordinator put into the store. Whatever the place, only bytes with the right hash are used.

use std::path::PathBuf;

use sightline_jobs::SceneFile;
use sightline_scene::OpenOptions;
use sightline_store::{
    BakeStore, CACHE_BYTES_MAX, FileCache, FileView, StoreError, is_url, key_beside, keys,
    local_path,
};

use crate::WorkerError;

/// How a worker gets a scene.
#[derive(Clone, Debug)]
pub struct SceneAccess {
    /// Fetch the scene even where there is a file at its path.
    pub fetch: bool,
    /// Folder of the cache; [`FileCache::default_folder`] when `None`.
    pub cache_folder: Option<PathBuf>,
    /// Limit of the cache, bytes.
    pub cache_bytes_max: u64,
}

impl Default for SceneAccess {
    fn default() -> Self {
        Self { fetch: false, cache_folder: None, cache_bytes_max: CACHE_BYTES_MAX }
    }
}

impl SceneAccess {
    /// Opens the cache.
    ///
    /// # Errors
    /// [`StoreError::Cache`] when its folder cannot be used.
    pub fn cache(&self) -> Result<FileCache, StoreError> {
        let folder = self.cache_folder.clone().unwrap_or_else(FileCache::default_folder);
        FileCache::open(&folder, self.cache_bytes_max)
    }
}

/// A scene that can be opened here.
#[derive(Debug)]
pub struct SceneOnDisk {
    /// The main file.
    pub path: PathBuf,
    /// The particle tables, where they do not lie as the configuration says.
    tables: Option<Vec<PathBuf>>,
    /// Keeps fetched files where they are.
    _view: Option<FileView>,
}

impl SceneOnDisk {
    /// A scene that lies at `path`, its particle tables as the configuration says.
    #[must_use]
    pub const fn at(path: PathBuf) -> Self {
        Self { path, tables: None, _view: None }
    }

    /// A scene that lies at `path` in a view, its particle tables as the configuration says.
    #[must_use]
    pub const fn in_view(path: PathBuf, view: FileView) -> Self {
        Self { path, tables: None, _view: Some(view) }
    }

    /// `options` for [`SceneOnDisk::path`], with the tables where they are.
    #[must_use]
    pub fn with_tables(&self, mut options: OpenOptions) -> OpenOptions {
        if let Some(tables) = &self.tables {
            options.particles.clone_from(tables);
        }
        options
    }
}

/// Finds the scene at `place`, a path or a URL, or fetches its `files`. `tables` are the particle
/// tables of the configuration: the last of the files.
///
/// # Errors
/// [`WorkerError::NoScene`] when it is nowhere; or what a store or the cache reports.
pub async fn locate(
    place: &str,
    files: &[SceneFile],
    tables: &[String],
    store: &BakeStore,
    access: &SceneAccess,
) -> Result<SceneOnDisk, WorkerError> {
    let path = local_path(place);
    if let Some(path) = path.filter(|path| !access.fetch && path.is_file()) {
        return Ok(SceneOnDisk::at(path));
    }
    match fetch(place, files, tables, store, &access.cache()?).await {
        Err(error @ StoreError::NotFound { .. }) => Err(WorkerError::NoScene {
            place: sightline_store::redacted(place),
            problem: error.to_string(),
        }),
        fetched => Ok(fetched?),
    }
}

/// Fetches the `files` of a scene by their hashes: from beside `place` when that is a URL, or from the
/// copies in the store.
///
/// # Errors
/// [`StoreError::NotFound`] when a file is in neither; or what a store or the cache reports.
pub async fn fetch(
    place: &str,
    files: &[SceneFile],
    tables: &[String],
    store: &BakeStore,
    cache: &FileCache,
) -> Result<SceneOnDisk, StoreError> {
    let origin = match is_url(place) && local_path(place).is_none() {
        true => Some(BakeStore::open_object(place)?),
        false => None,
    };
    let tables_start = files.len().saturating_sub(tables.len());
    let mut cached = Vec::with_capacity(files.len());
    let mut table_places = Vec::with_capacity(tables.len());
    for (i, file) in files.iter().enumerate() {
        let relative = match i.checked_sub(tables_start) {
            Some(table) if i > 0 => &tables[table],
            _ => &file.path,
        };
        let name = match i.checked_sub(tables_start) {
            Some(table) if i > 0 => format!("tables/{table}/{}", file.path),
            _ => format!("main/{}", file.path),
        };
        let mut sources = Vec::new();
        if let Some((bucket, main)) = &origin {
            let key = if i == 0 { Some(main.clone()) } else { key_beside(main, relative) };
            sources.extend(key.map(|key| (bucket.clone(), key)));
        }
        sources.push((store.clone(), keys::scene_file(&file.digest)));
        if i >= tables_start && i > 0 {
            table_places.push(name.clone());
        }
        cached.push((name, cache.by_content(&file.digest, file.bytes, &sources).await?));
    }
    let main = cached.first().map(|(name, _)| name.clone()).unwrap_or_default();
    let view = cache.view(cached).await?;
    let place_of = |name: &String| view.folder().join(name);
    let tables = table_places.iter().map(place_of).collect();
    Ok(SceneOnDisk { path: place_of(&main), tables: Some(tables), _view: Some(view) })
}
