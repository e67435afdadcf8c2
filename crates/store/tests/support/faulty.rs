//! An object store in memory that misbehaves as told.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use async_trait::async_trait;
use bytes::Bytes;
use futures::stream::BoxStream;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMode, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result,
};
use sightline_store::BakeStore;

/// What goes wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Nothing: only requests are counted.
    None,
    /// Puts happen, and their answers are lost.
    AnswersLost,
    /// Puts do not happen, and no answer comes.
    RequestsLost,
    /// The client tries a put again that has succeeded, and is told that the object exists.
    TriedAgain,
    /// The first so many puts meet another that is under way, which comes to nothing.
    Conflicts(u64),
    /// Creating if absent overwrites and always succeeds.
    EveryoneWins,
    /// After so many puts, the process is gone.
    CrashAfter(u64),
}

/// The store.
#[derive(Debug)]
pub struct Faulty {
    inner: Arc<InMemory>,
    fault: Fault,
    puts: AtomicU64,
    pub requests: AtomicU64,
    pub bytes_read: AtomicU64,
}

impl std::fmt::Display for Faulty {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Faulty({:?})", self.fault)
    }
}

impl Faulty {
    /// A store over `inner` with a fault.
    pub fn over(inner: &Arc<InMemory>, fault: Fault) -> Arc<Self> {
        let (puts, requests, bytes_read) = Default::default();
        Arc::new(Self { inner: Arc::clone(inner), fault, puts, requests, bytes_read })
    }

    /// The store as bakes use it.
    pub fn bake_store(self: &Arc<Self>) -> BakeStore {
        let objects: Arc<dyn ObjectStore> = Arc::<Self>::clone(self);
        BakeStore::new(objects, Path::default(), "a faulty store")
    }
}

fn exists(path: &Path) -> Error {
    Error::AlreadyExists { path: path.to_string(), source: "it is there".into() }
}

fn lost() -> Error {
    Error::Generic { store: "faulty", source: "the answer did not come".into() }
}

#[async_trait]
impl ObjectStore for Faulty {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        mut opts: PutOptions,
    ) -> Result<PutResult> {
        let before = self.puts.fetch_add(1, Ordering::Relaxed);
        match self.fault {
            Fault::RequestsLost => return Err(lost()),
            Fault::Conflicts(puts) if before < puts => return Err(exists(location)),
            Fault::CrashAfter(puts) if before >= puts => return Err(lost()),
            Fault::EveryoneWins => opts.mode = PutMode::Overwrite,
            _ => {}
        }
        let result = self.inner.put_opts(location, payload, opts).await?;
        match self.fault {
            Fault::AnswersLost => Err(lost()),
            Fault::TriedAgain => Err(exists(location)),
            _ => Ok(result),
        }
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.inner.put_multipart_opts(location, opts).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.requests.fetch_add(1, Ordering::Relaxed);
        let result = self.inner.get_opts(location, options).await?;
        self.bytes_read.fetch_add(result.range.end - result.range.start, Ordering::Relaxed);
        Ok(result)
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.requests.fetch_add(1, Ordering::Relaxed);
        let bytes: u64 = ranges.iter().map(|r| r.end - r.start).sum();
        self.bytes_read.fetch_add(bytes, Ordering::Relaxed);
        self.inner.get_ranges(location, ranges).await
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        self.inner.delete_stream(locations)
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.inner.copy_opts(from, to, options).await
    }
}
