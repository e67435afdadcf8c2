//! Object access: the few operations that bakes and datasets rest on, on any object store.
//!
//! A [`BakeStore`] is an object store and a folder in it. Keys are relative to that folder, use
//! `/`, and never start with it.
//!
//! What it promises:
//! - [`BakeStore::create`] makes an object appear at once with all of its bytes, or not at all,
//!   and at most one of several callers is told [`Created::ByUs`] as long as their bytes differ.
//!   (A file appears by a hard link to a synced temporary file; other stores by a conditional put.)
//! - [`BakeStore::put_pointer`] replaces an object at once; a reader gets the old or the new bytes.
//! - When either returns, the bytes survive a power cut (files and their folders are synced).
//!
//! Stores that cannot keep the first promise exist; [`BakeStore::probe`] finds them.

use std::hash::{BuildHasher, RandomState};
use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::local::LocalFileSystem;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, ObjectStoreScheme, PutMode, PutOptions};
use url::Url;

use crate::observe::{Observed, Observer};
use crate::{Result, StoreError, keys};

/// Tasks that race in [`BakeStore::probe`].
const PROBE_RACERS: usize = 8;

/// Who made an object exist.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Created {
    /// This call did.
    ByUs,
    /// It existed before; its bytes may or may not be the same.
    AlreadyThere,
}

/// An object store and the folder in it that holds a bake or a dataset. Cheap to clone.
#[derive(Clone, Debug)]
pub struct BakeStore {
    objects: Arc<dyn ObjectStore>,
    prefix: Path,
    location: String,
}

impl BakeStore {
    /// Opens an existing folder by its path or `file://` URL.
    ///
    /// # Errors
    /// [`StoreError::BadLocation`] when there is no such folder, or the URL's scheme is unknown.
    pub fn open(location: &str) -> Result<Self> {
        Self::open_location(location, false)
    }

    /// Opens a folder by its path or `file://` URL, making it when it does not exist.
    ///
    /// # Errors
    /// [`StoreError::BadLocation`] when it cannot be made, or the URL's scheme is unknown.
    pub fn open_or_create(location: &str) -> Result<Self> {
        Self::open_location(location, true)
    }

    /// An empty store in memory, for tests.
    #[must_use]
    pub fn in_memory() -> Self {
        Self::new(Arc::new(InMemory::new()), Path::default(), "memory:///")
    }

    /// Wraps an object store that was opened elsewhere. `location` is for messages only.
    #[must_use]
    pub fn new(objects: Arc<dyn ObjectStore>, prefix: Path, location: &str) -> Self {
        Self { objects, prefix, location: location.to_owned() }
    }

    fn open_location(location: &str, make: bool) -> Result<Self> {
        let bad = |problem: String| StoreError::BadLocation { location: location.into(), problem };
        if !location.contains("://") {
            return Self::open_folder(location, std::path::Path::new(location), make);
        }
        let url = Url::parse(location).map_err(|e| bad(e.to_string()))?;
        let (scheme, _) = ObjectStoreScheme::parse(&url).map_err(|e| bad(e.to_string()))?;
        match scheme {
            ObjectStoreScheme::Local => {
                let folder = url.to_file_path().map_err(|()| bad("it names no file".into()))?;
                Self::open_folder(location, &folder, make)
            }
            // Network stores arrive behind cargo features, through `object_store::parse_url_opts`.
            _ => Err(bad(format!("this build has no support for `{}` URLs", url.scheme()))),
        }
    }

    fn open_folder(location: &str, folder: &std::path::Path, make: bool) -> Result<Self> {
        let bad = |problem: String| StoreError::BadLocation { location: location.into(), problem };
        if make {
            std::fs::create_dir_all(folder).map_err(|e| bad(e.to_string()))?;
        }
        if !folder.is_dir() {
            return Err(bad("there is no such folder".into()));
        }
        let files = LocalFileSystem::new_with_prefix(folder).map_err(|e| bad(e.to_string()))?;
        Ok(Self::new(Arc::new(files.with_fsync(true)), Path::default(), location))
    }

    /// The same store; `observer` is told of every operation.
    #[must_use]
    pub fn observed(self, observer: Observer) -> Self {
        Self { objects: Arc::new(Observed::new(self.objects, observer)), ..self }
    }

    /// The location as it was given, for messages.
    #[must_use]
    pub fn location(&self) -> &str {
        &self.location
    }

    /// All bytes of an object.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], or what the store reports.
    pub async fn get(&self, key: &str) -> Result<Bytes> {
        let result = self.objects.get(&self.path(key)?).await.map_err(|e| self.error(key, e))?;
        result.bytes().await.map_err(|e| self.error(key, e))
    }

    /// All bytes of an object, or `None` when it does not exist.
    ///
    /// # Errors
    /// What the store reports, but for a missing object.
    pub async fn get_if_exists(&self, key: &str) -> Result<Option<Bytes>> {
        match self.get(key).await {
            Ok(bytes) => Ok(Some(bytes)),
            Err(StoreError::NotFound { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The bytes `range.start..range.end` of an object.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::Corrupt`] when the object is shorter, or what the
    /// store reports.
    pub async fn get_range(&self, key: &str, range: Range<u64>) -> Result<Bytes> {
        let mut parts = self.get_ranges(key, std::slice::from_ref(&range)).await?;
        Ok(parts.pop().unwrap_or_default())
    }

    /// Several byte ranges of an object; neighbouring ranges share requests.
    ///
    /// # Errors
    /// As [`BakeStore::get_range`].
    pub async fn get_ranges(&self, key: &str, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        let path = self.path(key)?;
        let parts = match self.objects.get_ranges(&path, ranges).await {
            Ok(parts) => parts,
            Err(error) => {
                // Backends report a range behind the end each in their own way.
                let end = ranges.iter().map(|r| r.end).max().unwrap_or(0);
                let size = self.size(key).await?;
                if size < end {
                    let problem = format!("it has {size} bytes, and byte {end} was asked for");
                    return Err(StoreError::corrupt(key, problem));
                }
                return Err(self.error(key, error));
            }
        };
        for (part, range) in parts.iter().zip(ranges) {
            if part.len() as u64 != range.end - range.start {
                return Err(StoreError::corrupt(key, "it is shorter than expected"));
            }
        }
        Ok(parts)
    }

    /// Size of an object, bytes.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], or what the store reports.
    pub async fn size(&self, key: &str) -> Result<u64> {
        let meta = self.objects.head(&self.path(key)?).await.map_err(|e| self.error(key, e))?;
        Ok(meta.size)
    }

    /// Creates an object unless it exists.
    ///
    /// When the store's answer is lost (a timeout, say), the object is read back: our bytes there
    /// count as created by us. So where two callers must not both win, their bytes must differ,
    /// by an attempt's or a process's id, for example.
    ///
    /// # Errors
    /// What the store reports. After an error the object may exist; calling again settles it.
    pub async fn create(&self, key: &str, bytes: impl Into<Bytes>) -> Result<Created> {
        let bytes: Bytes = bytes.into();
        let path = self.path(key)?;
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        match self.objects.put_opts(&path, bytes.clone().into(), options).await {
            Ok(_) => Ok(Created::ByUs),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(Created::AlreadyThere),
            Err(error) => match self.get_if_exists(key).await {
                Ok(Some(found)) if found == bytes => Ok(Created::ByUs),
                Ok(Some(_)) => Ok(Created::AlreadyThere),
                Ok(None) | Err(_) => Err(self.error(key, error)),
            },
        }
    }

    /// Creates an object whose key is derived from its bytes. An object with other bytes under
    /// that key is damaged, and is replaced.
    ///
    /// # Errors
    /// What the store reports.
    pub async fn create_content(&self, key: &str, bytes: impl Into<Bytes>) -> Result<Created> {
        let bytes: Bytes = bytes.into();
        let created = self.create(key, bytes.clone()).await?;
        if created == Created::AlreadyThere && self.get(key).await? != bytes {
            self.put_pointer(key, bytes).await?;
        }
        Ok(created)
    }

    /// Writes an object in place of what was there, at once.
    ///
    /// # Errors
    /// What the store reports. After an error the old or the new bytes may be there.
    pub async fn put_pointer(&self, key: &str, bytes: impl Into<Bytes>) -> Result<()> {
        let bytes: Bytes = bytes.into();
        let path = self.path(key)?;
        let put = self.objects.put(&path, bytes.into()).await;
        put.map(drop).map_err(|e| self.error(key, e))
    }

    /// The keys below a folder, sorted. A folder that does not exist is empty.
    ///
    /// # Errors
    /// What the store reports.
    pub async fn list(&self, folder: &str) -> Result<Vec<String>> {
        let path = self.path(folder)?;
        let found: Result<Vec<String>, _> = self
            .objects
            .list(Some(&path))
            .map_ok(|meta| self.key(&meta.location))
            .try_collect()
            .await;
        let mut found = found.map_err(|e| self.error(folder, e))?;
        found.sort_unstable();
        Ok(found)
    }

    /// Verifies that creating if absent has exactly one winner, and that the winner's bytes can be
    /// read and listed. Leaves nothing behind.
    ///
    /// # Errors
    /// [`StoreError::UnsafeStore`] when the store breaks a promise, or what the store reports.
    pub async fn probe(&self) -> Result<()> {
        // Ids come through seams; this one names scratch that is deleted below and decides nothing.
        let scratch = RandomState::new().hash_one(std::process::id());
        let key = format!("{}/{scratch:016x}", keys::PROBE_FOLDER);
        let outcome = self.race(&key).await;
        let cleaned = self.delete(&key).await;
        outcome.and(cleaned)
    }

    async fn race(&self, key: &str) -> Result<()> {
        let broken =
            |problem: String| StoreError::UnsafeStore { location: self.location.clone(), problem };
        let racers = (0..PROBE_RACERS).map(|racer| {
            let (store, key) = (self.clone(), key.to_owned());
            tokio::spawn(async move { store.create(&key, format!("racer {racer}")).await })
        });
        let mut winners = Vec::new();
        for (racer, result) in futures::future::join_all(racers).await.into_iter().enumerate() {
            let created = result.map_err(|source| StoreError::Unavailable {
                key: key.to_owned(),
                source: Box::new(source),
            })??;
            if created == Created::ByUs {
                winners.push(racer);
            }
        }
        let [winner] = winners[..] else {
            let count = winners.len();
            return Err(broken(format!(
                "{PROBE_RACERS} writers created one object at the same time, and {count} were \
                 told that they were first; exactly one must be"
            )));
        };
        if self.get(key).await? != format!("racer {winner}").as_bytes() {
            return Err(broken("an object does not hold the bytes of the writer that won".into()));
        }
        if !self.list(keys::PROBE_FOLDER).await?.iter().any(|k| k == key) {
            return Err(broken("an object that was created is not listed".into()));
        }
        Ok(())
    }

    async fn delete(&self, key: &str) -> Result<()> {
        match self.objects.delete(&self.path(key)?).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(self.error(key, error)),
        }
    }

    fn path(&self, key: &str) -> Result<Path> {
        let relative = Path::parse(key).map_err(|e| self.error(key, e.into()))?;
        Ok(self.prefix.parts().chain(relative.parts()).collect())
    }

    fn key(&self, path: &Path) -> String {
        let parts = path.prefix_match(&self.prefix);
        parts.map_or_else(|| path.to_string(), |parts| parts.collect::<Path>().to_string())
    }

    fn error(&self, key: &str, error: object_store::Error) -> StoreError {
        use object_store::Error as E;
        let key = key.to_owned();
        match error {
            E::NotFound { .. } => StoreError::NotFound { key, location: self.location.clone() },
            E::InvalidPath { .. }
            | E::NotSupported { .. }
            | E::NotImplemented { .. }
            | E::PermissionDenied { .. }
            | E::Unauthenticated { .. }
            | E::UnknownConfigurationKey { .. } => {
                StoreError::Refused { key, source: Box::new(error) }
            }
            _ if refused_by_the_system(&error) => {
                StoreError::Refused { key, source: Box::new(error) }
            }
            _ => StoreError::Unavailable { key, source: Box::new(error) },
        }
    }
}

/// True when an I/O error below `error` will not pass by itself.
fn refused_by_the_system(error: &(dyn std::error::Error + 'static)) -> bool {
    use std::io::ErrorKind as K;
    let chain = std::iter::successors(Some(error), |e| e.source());
    chain.filter_map(|e| e.downcast_ref::<std::io::Error>()).any(|e| {
        matches!(
            e.kind(),
            K::PermissionDenied | K::ReadOnlyFilesystem | K::NotADirectory | K::IsADirectory
        )
    })
}
