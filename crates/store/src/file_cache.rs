//! A folder with copies of objects, by the hash of their content, that keeps below a size.
//!
//! ```text
//! <cache>/files/<hash>                      a whole file with that BLAKE3 hash
//! <cache>/partial/<name>-<bytes>-<id>       a file on its way; `<bytes>` is how large it will be
//! <cache>/names/<hash of place and version> the hash and size of what a key named
//! <cache>/locks/<hash>                      who uses or fetches that file; empty
//! <cache>/views/<id>/                       links to files under the names that a reader wants
//! ```
//!
//! Any number of processes may share the folder. What keeps them apart are locks of the system on files
//! of `locks/`, which end with their process, however it ends:
//!
//! - who uses a file holds its lock, shared; who fetches or removes it holds the lock alone. So a file is
//!   never removed while it is used, and fetched by one while the others wait.
//! - room is made under one lock of the whole cache, and a file on its way counts as large as it will be.
//!   So all processes together keep below the limit.
//!
//! A file appears in `files/` by a rename, once its bytes have the hash, and its bytes are hashed again
//! whenever a process begins to use it: a partial or damaged file is never used. What a killed process
//! leaves behind (files on their way, views) is removed when room is made. The least recently used files
//! go first.

use std::fs::{self, File, TryLockError};
use std::hash::{BuildHasher, RandomState};
use std::io;
use std::path::{Component, Path, PathBuf};
use std::time::{Duration, SystemTime};

use crate::{BakeStore, ObjectVersion, Result, StoreError};

/// Size of the cache where none is given, bytes: 20 GiB.
pub const CACHE_BYTES_MAX: u64 = 20 << 30;

/// Time between two looks at a lock that another holds. Locks are not waited for in the system, so that
/// a process can be stopped meanwhile.
const LOCK_PAUSE: Duration = Duration::from_millis(50);
/// How often a file is fetched again that others remove before it can be used.
const TRIES: u32 = 10;
/// The lock under which room is made.
const ROOM: &str = "room";

/// A folder with copies of objects. Cheap to clone.
#[derive(Clone, Debug)]
pub struct FileCache {
    folder: PathBuf,
    bytes_max: u64,
}

/// A whole file of the cache. It stays there as long as this lives.
#[derive(Debug)]
pub struct CachedFile {
    path: PathBuf,
    digest: String,
    size: u64,
    _in_use: File,
}

impl CachedFile {
    /// Where its bytes are. They must not be changed.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// BLAKE3 hash, hexadecimal.
    #[must_use]
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Size, bytes.
    #[must_use]
    pub const fn size(&self) -> u64 {
        self.size
    }
}

/// Files of the cache under names of their own. The folder is removed when this is dropped.
#[derive(Debug)]
pub struct FileView {
    root: PathBuf,
    folder: PathBuf,
    _files: Vec<CachedFile>,
    _in_use: File,
}

impl FileView {
    /// The folder that the names are relative to.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}

impl Drop for FileView {
    fn drop(&mut self) {
        // What stays is removed when room is made.
        let _ = fs::remove_dir_all(&self.root);
    }
}

impl FileCache {
    /// The cache in `folder`, which is made when it does not exist. All processes that share it should
    /// give the same size.
    ///
    /// # Errors
    /// [`StoreError::Cache`] when the folder cannot be made.
    pub fn open(folder: &Path, bytes_max: u64) -> Result<Self> {
        let cache = Self { folder: folder.to_owned(), bytes_max };
        for part in ["files", "partial", "names", "locks", "views"] {
            fs::create_dir_all(folder.join(part)).map_err(|e| cache.failed(&e))?;
        }
        Ok(cache)
    }

    /// Where a cache lies when nothing else is said: `sightline` in `$XDG_CACHE_HOME`, in
    /// `$HOME/.cache`, or in the folder for temporary files.
    #[must_use]
    pub fn default_folder() -> PathBuf {
        let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
        let caches = set("XDG_CACHE_HOME").or_else(|| Some(set("HOME")?.join(".cache")));
        caches.unwrap_or_else(std::env::temp_dir).join("sightline")
    }

    /// The file with this content, from the cache or else from the first of `sources` (a store and a
    /// key) that has it.
    ///
    /// # Errors
    /// [`StoreError::NotFound`] when no source has it; [`StoreError::Corrupt`] when those that have
    /// something have something else; [`StoreError::Cache`] when there is no room; or what a store
    /// reports.
    pub async fn by_content(
        &self,
        digest: &str,
        size: u64,
        sources: &[(BakeStore, String)],
    ) -> Result<CachedFile> {
        self.expect_digest(digest)?;
        for _ in 0..TRIES {
            if let Some(found) = self.in_use(digest, size).await? {
                return Ok(found);
            }
            let _alone = self.lock(digest, Kind::Alone).await?;
            if !self.is_whole(digest, size).await {
                self.fetch(digest, size, sources).await?;
            }
        }
        Err(self.problem("files are removed as fast as they are fetched; give it more room"))
    }

    /// What a key names now, or `None` when it names nothing. An object that was fetched before and
    /// has not changed is not fetched again.
    ///
    /// # Errors
    /// [`StoreError::Cache`] when there is no room; or what the store reports.
    pub async fn by_name(&self, store: &BakeStore, key: &str) -> Result<Option<CachedFile>> {
        let version = match store.version(key).await {
            Ok(version) => version,
            Err(StoreError::NotFound { .. }) => return Ok(None),
            Err(error) => return Err(error),
        };
        let place = format!("{}\n{key}\n{}", store.location(), version.tag);
        let identity = blake3::hash(place.as_bytes()).to_hex().to_string();
        let name = self.folder.join("names").join(&identity);
        for _ in 0..TRIES {
            let known = fs::read_to_string(&name).ok();
            if let Some(digest) = known.filter(|text| is_digest(text))
                && let Some(found) = self.in_use(&digest, version.size).await?
            {
                return Ok(Some(found));
            }
            let _alone = self.lock(&identity, Kind::Alone).await?;
            let partial = self.reserve(&identity, version.size).await?;
            let fetched = self.fetch_new(store, key, &version, &partial, &name).await;
            if fetched.is_err() {
                let _ = fs::remove_file(&partial);
            }
            fetched?;
        }
        Err(self.problem("files are removed as fast as they are fetched; give it more room"))
    }

    /// Puts files under names of their own, relative to a new folder.
    ///
    /// # Errors
    /// [`StoreError::Cache`] when a name leads out of the folder, or the links cannot be made.
    pub async fn view(&self, files: Vec<(String, CachedFile)>) -> Result<FileView> {
        let room = self.lock(ROOM, Kind::Alone).await?;
        self.remove_old_views();
        let root = self.folder.join("views").join(unique());
        let folder = root.join("scene");
        fs::create_dir_all(&folder).map_err(|e| self.failed(&e))?;
        let in_use = self.lock_file(&root.join("lock"))?;
        in_use.try_lock().map_err(|e| self.problem(&e.to_string()))?;
        drop(room);
        let (names, files): (Vec<String>, Vec<CachedFile>) = files.into_iter().unzip();
        let view = FileView { root, folder, _files: files, _in_use: in_use };
        for (name, file) in names.iter().zip(&view._files) {
            let parts = Path::new(name).components().filter(|part| *part != Component::CurDir);
            let inside: Option<PathBuf> =
                parts.map(|part| matches!(part, Component::Normal(_)).then_some(part)).collect();
            let Some(inside) = inside.filter(|path| path.file_name().is_some()) else {
                return Err(self.problem(&format!("`{name}` is no name of a file in a folder")));
            };
            let place = view.folder.join(inside);
            if place.exists() {
                continue;
            }
            let parent = place.parent().unwrap_or(&view.folder);
            fs::create_dir_all(parent)
                .and_then(|()| fs::hard_link(&file.path, &place))
                .map_err(|e| self.failed(&e))?;
        }
        Ok(view)
    }

    /// The file, when it is there and whole; in use from then on.
    async fn in_use(&self, digest: &str, size: u64) -> Result<Option<CachedFile>> {
        let in_use = self.lock(digest, Kind::Shared).await?;
        if !self.is_whole(digest, size).await {
            return Ok(None);
        }
        let path = self.file(digest);
        // Says when it was used last; a file that cannot be marked goes a little early.
        if let Ok(file) = File::options().append(true).open(&path) {
            let _ = file.set_modified(SystemTime::now());
        }
        Ok(Some(CachedFile { path, digest: digest.to_owned(), size, _in_use: in_use }))
    }

    /// True when the file has this size and this hash.
    async fn is_whole(&self, digest: &str, size: u64) -> bool {
        let path = self.file(digest);
        if !fs::metadata(&path).is_ok_and(|m| m.is_file() && m.len() == size) {
            return false;
        }
        let hash = tokio::task::spawn_blocking(move || hash_of(&path)).await;
        matches!(hash, Ok(Ok(hash)) if hash.to_hex().as_str() == digest)
    }

    /// Fetches a file whose hash is known. Its lock is held.
    async fn fetch(&self, digest: &str, size: u64, sources: &[(BakeStore, String)]) -> Result<()> {
        // Damaged, or of a process that died in a rename of its system.
        let _ = fs::remove_file(self.file(digest));
        let mut last = None;
        for (store, key) in sources {
            let version = match store.version(key).await {
                Ok(version) if version.size == size => version,
                Ok(version) => {
                    let problem = format!("it has {} bytes instead of {size}", version.size);
                    last = Some(StoreError::corrupt(key, problem));
                    continue;
                }
                Err(error) => {
                    last = worse(last, error);
                    continue;
                }
            };
            let partial = self.reserve(digest, size).await?;
            tracing::info!(key, bytes = size, from = store.location(), "fetching a file");
            match store.download(key, &version, &partial).await {
                Ok(hash) if hash.to_hex().as_str() == digest => {
                    return fs::rename(&partial, self.file(digest)).map_err(|e| self.failed(&e));
                }
                Ok(_) => {
                    let problem = "its bytes are not those that were baked";
                    last = Some(StoreError::corrupt(key, problem));
                }
                Err(error) => last = worse(last, error),
            }
            let _ = fs::remove_file(&partial);
        }
        Err(last.unwrap_or_else(|| self.problem("there is no place to fetch it from")))
    }

    /// Fetches what a key names now, and notes what it was. The lock of the name is held.
    async fn fetch_new(
        &self,
        store: &BakeStore,
        key: &str,
        version: &ObjectVersion,
        partial: &Path,
        name: &Path,
    ) -> Result<()> {
        tracing::info!(key, bytes = version.size, from = store.location(), "fetching a file");
        let hash = store.download(key, version, partial).await?.to_hex().to_string();
        let note = partial.with_extension("name");
        let place = || {
            fs::rename(partial, self.file(&hash))?;
            fs::write(&note, &hash)?;
            fs::rename(&note, name)
        };
        place().map_err(|e| self.failed(&e))
    }

    /// An empty file on its way that counts as `size` bytes. The lock of `name` is held.
    async fn reserve(&self, name: &str, size: u64) -> Result<PathBuf> {
        let _room = self.lock(ROOM, Kind::Alone).await?;
        self.remove_old_views();
        let mut used = self.partial_bytes(name)?;
        let mut files = Vec::new();
        for entry in self.entries("files")? {
            let Ok(meta) = entry.metadata() else { continue };
            used += meta.len();
            let name = entry.file_name().to_string_lossy().into_owned();
            files.push((meta.modified().unwrap_or(SystemTime::UNIX_EPOCH), name, meta.len()));
        }
        files.sort();
        for (_, digest, bytes) in files {
            if used.saturating_add(size) <= self.bytes_max {
                break;
            }
            // Who holds its lock uses it.
            if self.is_free(&digest)? && fs::remove_file(self.file(&digest)).is_ok() {
                tracing::info!(digest, bytes, "removed from the cache");
                used -= bytes;
            }
        }
        if used.saturating_add(size) > self.bytes_max {
            return Err(self.problem(&format!(
                "{size} more bytes are needed, {used} are in use, and it is limited to {}; give it \
                 more with --cache-size",
                self.bytes_max
            )));
        }
        let partial = self.folder.join("partial").join(format!("{name}-{size}-{}", unique()));
        File::create(&partial).map_err(|e| self.failed(&e))?;
        Ok(partial)
    }

    /// Sizes of the files on their way; those that nobody works on, and those of `own`, are removed.
    fn partial_bytes(&self, own: &str) -> Result<u64> {
        let mut used = 0u64;
        for entry in self.entries("partial")? {
            let name = entry.file_name().to_string_lossy().into_owned();
            let mut parts = name.split('-');
            let whose = parts.next().unwrap_or_default();
            if whose == own || !is_digest(whose) || self.is_free(whose)? {
                let _ = fs::remove_file(entry.path());
            } else {
                used += parts.next().and_then(|bytes| bytes.parse::<u64>().ok()).unwrap_or(0);
            }
        }
        Ok(used)
    }

    /// Views whose process is gone. The lock of the room is held: nobody is making one.
    fn remove_old_views(&self) {
        for entry in self.entries("views").into_iter().flatten() {
            let lock = File::open(entry.path().join("lock"));
            if lock.map_or(true, |lock| lock.try_lock().is_ok()) {
                let _ = fs::remove_dir_all(entry.path());
            }
        }
    }

    /// True when nobody holds the lock.
    fn is_free(&self, name: &str) -> Result<bool> {
        let file = self.lock_file(&self.folder.join("locks").join(name))?;
        Ok(file.try_lock().is_ok())
    }

    async fn lock(&self, name: &str, kind: Kind) -> Result<File> {
        let file = self.lock_file(&self.folder.join("locks").join(name))?;
        loop {
            let locked = match kind {
                Kind::Shared => file.try_lock_shared(),
                Kind::Alone => file.try_lock(),
            };
            match locked {
                Ok(()) => return Ok(file),
                Err(TryLockError::WouldBlock) => tokio::time::sleep(LOCK_PAUSE).await,
                Err(TryLockError::Error(error)) => return Err(self.failed(&error)),
            }
        }
    }

    fn lock_file(&self, path: &Path) -> Result<File> {
        let mut options = File::options();
        options.create(true).truncate(false).read(true).write(true);
        options.open(path).map_err(|e| self.failed(&e))
    }

    fn entries(&self, part: &str) -> Result<Vec<fs::DirEntry>> {
        let entries = fs::read_dir(self.folder.join(part)).map_err(|e| self.failed(&e))?;
        Ok(entries.flatten().collect())
    }

    fn file(&self, digest: &str) -> PathBuf {
        self.folder.join("files").join(digest)
    }

    fn expect_digest(&self, digest: &str) -> Result<()> {
        if is_digest(digest) {
            return Ok(());
        }
        Err(self.problem(&format!("`{digest}` is no BLAKE3 hash")))
    }

    fn failed(&self, error: &io::Error) -> StoreError {
        self.problem(&format!("{error}; give another folder with --cache"))
    }

    fn problem(&self, problem: &str) -> StoreError {
        StoreError::Cache { path: self.folder.clone(), problem: problem.to_owned() }
    }
}

#[derive(Clone, Copy)]
enum Kind {
    Shared,
    Alone,
}

/// Of two errors of sources, the one that says more: anything more than a missing object.
fn worse(last: Option<StoreError>, error: StoreError) -> Option<StoreError> {
    match last {
        Some(last) if matches!(error, StoreError::NotFound { .. }) => Some(last),
        _ => Some(error),
    }
}

fn is_digest(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

/// A name that no other process takes; nothing else depends on it.
fn unique() -> String {
    format!("{:016x}", RandomState::new().hash_one(std::process::id()))
}

fn hash_of(path: &Path) -> io::Result<blake3::Hash> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(File::open(path)?)?;
    Ok(hasher.finalize())
}
