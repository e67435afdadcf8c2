//! Watching what is asked of a store: every operation, its time and its result.
//!
//! An [`Observed`] store passes everything on and changes nothing. What was observed is for metrics;
//! nothing is decided by it.

use std::fmt;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures::StreamExt;
use futures::stream::BoxStream;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult, RenameOptions, Result,
};

/// An operation on a store that has ended.
#[derive(Clone, Copy, Debug)]
pub struct Operation {
    /// `get`, `put`, `list`, `copy` or `delete`.
    pub kind: &'static str,
    /// `ok`, `not_found`, `already_exists` or `error`.
    pub result: &'static str,
    /// How long it took until its answer began.
    pub time: Duration,
}

impl Operation {
    /// Every kind.
    pub const KINDS: [&str; 5] = ["get", "put", "list", "copy", "delete"];
    /// Every result.
    pub const RESULTS: [&str; 4] = ["ok", "not_found", "already_exists", "error"];
}

/// Who is told of operations.
pub type Observer = Arc<dyn Fn(Operation) + Send + Sync>;

/// A store whose operations somebody is told of.
pub(crate) struct Observed {
    inner: Arc<dyn ObjectStore>,
    observer: Observer,
}

impl Observed {
    pub fn new(inner: Arc<dyn ObjectStore>, observer: Observer) -> Self {
        Self { inner, observer }
    }

    async fn tell<T>(
        &self,
        kind: &'static str,
        operation: impl Future<Output = Result<T>> + Send,
    ) -> Result<T> {
        let start = Instant::now();
        let done = operation.await;
        let result = match &done {
            Ok(_) => "ok",
            Err(Error::NotFound { .. }) => "not_found",
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => "already_exists",
            Err(_) => "error",
        };
        (self.observer)(Operation { kind, result, time: start.elapsed() });
        done
    }
}

impl fmt::Debug for Observed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.fmt(f)
    }
}

impl fmt::Display for Observed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.inner.fmt(f)
    }
}

#[async_trait::async_trait]
impl ObjectStore for Observed {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        opts: PutOptions,
    ) -> Result<PutResult> {
        self.tell("put", self.inner.put_opts(location, payload, opts)).await
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.tell("put", self.inner.put_multipart_opts(location, opts)).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.tell("get", self.inner.get_opts(location, options)).await
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.tell("get", self.inner.get_ranges(location, ranges)).await
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        let (observer, start) = (Arc::clone(&self.observer), Instant::now());
        let deleted = self.inner.delete_stream(locations).inspect(move |done| {
            let result = if done.is_ok() { "ok" } else { "error" };
            observer(Operation { kind: "delete", result, time: start.elapsed() });
        });
        deleted.boxed()
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        let (observer, start) = (Arc::clone(&self.observer), Instant::now());
        let mut has_failed = false;
        let listed = self.inner.list(prefix).map(Some).chain(futures::stream::once(async { None }));
        // The end of the listing is when it is known how it went.
        let listed = listed.filter_map(move |item| {
            if let Some(item) = &item {
                has_failed |= item.is_err();
            } else {
                let result = if has_failed { "error" } else { "ok" };
                observer(Operation { kind: "list", result, time: start.elapsed() });
            }
            std::future::ready(item)
        });
        listed.boxed()
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.tell("list", self.inner.list_with_delimiter(prefix)).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.tell("copy", self.inner.copy_opts(from, to, options)).await
    }

    async fn rename_opts(&self, from: &Path, to: &Path, options: RenameOptions) -> Result<()> {
        self.tell("copy", self.inner.rename_opts(from, to, options)).await
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::BakeStore;

    #[tokio::test]
    async fn every_operation_is_told_with_its_result() {
        let told = Arc::new(Mutex::new(Vec::new()));
        let observer = {
            let told = Arc::clone(&told);
            Arc::new(move |o: Operation| told.lock().unwrap().push((o.kind, o.result)))
        };
        let store = BakeStore::in_memory().observed(observer);
        store.create("a", "1").await.unwrap();
        store.create("a", "1").await.unwrap();
        assert!(store.get_if_exists("b").await.unwrap().is_none());
        assert_eq!(store.list("").await.unwrap().len(), 1);
        let told = told.lock().unwrap();
        let is_listed = |&(kind, result)| {
            Operation::KINDS.contains(&kind) && Operation::RESULTS.contains(&result)
        };
        assert!(told.iter().all(is_listed), "{told:?}");
        // Who finds an object there looks whether it is its own.
        let found = [("put", "already_exists"), ("get", "ok")];
        let others = [("get", "not_found"), ("list", "ok")];
        assert_eq!(told[..], [&[("put", "ok")][..], &found, &others].concat());
    }
}
