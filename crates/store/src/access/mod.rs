//! Object access: the few operations that bakes and datasets rest on, on any object store.
//!
//! A [`BakeStore`] is an object store and a folder in it. Keys are relative to that folder, use
//! `/`, and never start with it.
//!
//! What it promises:
//! - [`BakeStore::create`] makes an object appear at once with all of its bytes, or not at all,
//!   and at most one of several callers is told [`Created::ByUs`] as long as their bytes differ.
//!   (A file appears by a hard link to a synced temporary file; other stores by a conditional put.)
//!   A put whose answer was lost, or that the client below tried again after it had succeeded, is
//!   settled by reading the object back.
//! - [`BakeStore::put_pointer`] replaces an object at once; a reader gets the old or the new bytes.
//! - When either returns, the bytes survive a power cut (files and their folders are synced).
//!
//! Stores that cannot keep the first promise exist; [`BakeStore::probe`] finds them.
//!
//! Nothing secret leaves this module: locations are shown without passwords and signatures, and what a
//! backend reports is cleaned of both (`failure`).

mod failure;
mod large;
mod location;
mod open;
mod probe;

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::TryStreamExt;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions};

use crate::observe::{Observed, Observer};
use crate::{Result, StoreError};
pub use large::ObjectVersion;
pub use location::{is_url, key_beside, local_path, redacted};

/// How often a put is made whose refusal names an object that is not there: S3 answers so while
/// another conditional put of the key is under way.
const CONFLICT_TRIES: u32 = 8;
/// How often a deletion is asked for.
const DELETE_TRIES: u32 = 3;
/// The first pause between those of [`CONFLICT_TRIES`]; each is twice as long as the one before, 6 s
/// together.
const CONFLICT_PAUSE: Duration = Duration::from_millis(50);

/// Who made an object exist.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Created {
    /// This call did.
    ByUs,
    /// It existed before; its bytes may or may not be the same.
    AlreadyThere,
}

/// An object store and the folder in it that holds a bake or a dataset. Cheap to clone.
#[derive(Clone)]
pub struct BakeStore {
    objects: Arc<dyn ObjectStore>,
    prefix: Path,
    /// Without secrets.
    location: String,
    /// Texts that must not appear in any message.
    secrets: Arc<[String]>,
    /// What to do when the store does not let us in; empty where there is nothing to say.
    access_help: &'static str,
    is_remote: bool,
}

impl std::fmt::Debug for BakeStore {
    /// The backends' own form may show credentials.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "BakeStore({})", self.location)
    }
}

impl BakeStore {
    /// Opens an existing folder by its path or `file://` URL, or a prefix of a bucket by its URL:
    /// `s3://bucket/prefix`, `gs://bucket/prefix`, `az://container/prefix`,
    /// `abfss://container@account.dfs.core.windows.net/prefix`, or the `https` form of these.
    /// Credentials and the server's address come from the environment.
    ///
    /// # Errors
    /// [`StoreError::BadLocation`] when there is no such folder, the URL's scheme is unknown, or
    /// credentials are missing. Whether a bucket exists shows at the first request.
    pub fn open(location: &str) -> Result<Self> {
        open::open(location, false)
    }

    /// As [`BakeStore::open`]; makes a folder that does not exist. Buckets are not made.
    ///
    /// # Errors
    /// As [`BakeStore::open`]; when the folder cannot be made.
    pub fn open_or_create(location: &str) -> Result<Self> {
        open::open(location, true)
    }

    /// Opens the store that holds the object a URL names. The key comes with it, relative to the whole
    /// bucket.
    ///
    /// # Errors
    /// As [`BakeStore::open`]; [`StoreError::BadLocation`] when the URL names no object.
    pub fn open_object(url: &str) -> Result<(Self, String)> {
        let mut store = open::open(url, false)?;
        let key = std::mem::take(&mut store.prefix).to_string();
        if key.is_empty() {
            let problem = "it names a bucket, not an object in it".into();
            return Err(StoreError::BadLocation { location: store.location, problem });
        }
        store.location = location::root_of(&store.location, &key);
        Ok((store, key))
    }

    /// An empty store in memory, for tests.
    #[must_use]
    pub fn in_memory() -> Self {
        Self::new(Arc::new(InMemory::new()), Path::default(), "memory:///")
    }

    /// Wraps an object store that was opened elsewhere. `location` is for messages only.
    #[must_use]
    pub fn new(objects: Arc<dyn ObjectStore>, prefix: Path, location: &str) -> Self {
        let location = redacted(location);
        let secrets = Arc::default();
        Self { objects, prefix, location, secrets, access_help: "", is_remote: false }
    }

    /// The same store; `observer` is told of every operation.
    #[must_use]
    pub fn observed(self, observer: Observer) -> Self {
        Self { objects: Arc::new(Observed::new(self.objects, observer)), ..self }
    }

    /// The location as it was given, without what is secret in it.
    #[must_use]
    pub fn location(&self) -> &str {
        &self.location
    }

    /// True for a store that is reached over a network.
    #[must_use]
    pub const fn is_remote(&self) -> bool {
        self.is_remote
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
    /// Where the store's answer is lost (a timeout, say), and where it says that the object exists, the
    /// object is read back: our bytes there count as created by us, since a request that is tried again
    /// meets what its first try created. So where two callers must not both win, their bytes must
    /// differ, by an attempt's or a process's id, for example.
    ///
    /// # Errors
    /// What the store reports. After an error the object may exist; calling again settles it.
    pub async fn create(&self, key: &str, bytes: impl Into<Bytes>) -> Result<Created> {
        let bytes: Bytes = bytes.into();
        let path = self.path(key)?;
        let mut pause = CONFLICT_PAUSE;
        for _ in 1..CONFLICT_TRIES {
            match self.put_if_absent(&path, key, &bytes).await? {
                Some(created) => return Ok(created),
                None => tokio::time::sleep(pause).await,
            }
            pause *= 2;
        }
        match self.put_if_absent(&path, key, &bytes).await? {
            Some(created) => Ok(created),
            None => Err(StoreError::Unavailable {
                key: key.to_owned(),
                source: "it answers that the object is being written by another".into(),
            }),
        }
    }

    /// One try of [`BakeStore::create`]; `None` when the store refused for an object that is not there.
    async fn put_if_absent(
        &self,
        path: &Path,
        key: &str,
        bytes: &Bytes,
    ) -> Result<Option<Created>> {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        let put = self.objects.put_opts(path, bytes.clone().into(), options).await;
        let Err(error) = put else { return Ok(Some(Created::ByUs)) };
        let exists = matches!(
            error,
            object_store::Error::AlreadyExists { .. } | object_store::Error::Precondition { .. }
        );
        match self.get_if_exists(key).await {
            Ok(Some(found)) if found == *bytes => Ok(Some(Created::ByUs)),
            Ok(Some(_)) => Ok(Some(Created::AlreadyThere)),
            Ok(None) if exists => Ok(None),
            Err(unread) if exists => Err(unread),
            Ok(None) | Err(_) => Err(self.error(key, error)),
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

    async fn delete(&self, key: &str) -> Result<()> {
        let path = self.path(key)?;
        let mut outcome = Ok(());
        // The client does not send a deletion again whose answer was lost; doing so is safe.
        for _ in 0..DELETE_TRIES {
            outcome = match self.objects.delete(&path).await {
                Ok(()) | Err(object_store::Error::NotFound { .. }) => return Ok(()),
                Err(error) => Err(self.error(key, error)),
            };
        }
        outcome
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
        failure::explain(self, key, error)
    }
}
