//! A store in memory behind a bad network, which checks everything that is written to it.
//!
//! A request takes a while to arrive and its answer a while to come back. A put lives on its own once it
//! is sent: it can arrive long after the sender has crashed or was told that it failed, arrive twice, or
//! never.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt;
use futures::stream::{self, BoxStream};
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, ObjectStoreExt, PutMode, PutMultipartOptions, PutOptions, PutPayload, PutResult,
    Result,
};
use prost::Message;
use rand::rngs::SmallRng;
use rand::{Rng, SeedableRng};
use sightline_proto::v1;
use tokio::sync::oneshot;

/// Longest time that a client of the store waits for an answer, ms.
const TIMEOUT_MS: u64 = 2_000;

/// Scratch of the start-up probe: all that may be deleted.
const PROBE: &str = "bake/probe/";

/// How the way between one host and the store is.
#[derive(Clone, Copy, Debug, Default)]
pub struct Way {
    /// No request of the host arrives.
    pub is_down: bool,
    /// Share of requests that are lost on the way there, and of answers on the way back, percent.
    pub loss_percent: u32,
    /// Puts arrive up to so much later, ms.
    pub stall_ms: u64,
}

/// The objects, and what is on its way to them.
struct Objects {
    rng: SmallRng,
    now_ms: u64,
    ways: Vec<Way>,
    /// What is stored; everything else that the object store trait asks for is InMemory's.
    bytes: BTreeMap<String, Bytes>,
    memory: Arc<InMemory>,
    /// Puts on their way, by arrival and number.
    sent: BTreeMap<(u64, u64), Sent>,
    /// Answers on their way back.
    answers: BTreeMap<(u64, u64), Answer>,
    next: u64,
    expected: Arc<BTreeMap<String, Bytes>>,
    history: blake3::Hasher,
    puts: u64,
}

struct Sent {
    host: usize,
    key: String,
    bytes: Bytes,
    create: bool,
    answer: Option<oneshot::Sender<Result<()>>>,
}

type Answer = (oneshot::Sender<Result<()>>, Result<()>);

/// The store of one simulation.
#[derive(Clone)]
pub struct SimStore(Arc<Mutex<Objects>>);

impl SimStore {
    /// An empty store that `hosts` hosts can reach. `expected` holds the objects of the dataset of the
    /// undisturbed bake, by key.
    pub fn new(seed: u64, hosts: usize, expected: Arc<BTreeMap<String, Bytes>>) -> Self {
        Self(Arc::new(Mutex::new(Objects {
            rng: SmallRng::seed_from_u64(seed ^ 0x5707_E000),
            now_ms: 0,
            ways: vec![Way::default(); hosts],
            bytes: BTreeMap::new(),
            memory: Arc::new(InMemory::new()),
            sent: BTreeMap::new(),
            answers: BTreeMap::new(),
            next: 0,
            expected,
            history: blake3::Hasher::new(),
            puts: 0,
        })))
    }

    fn lock(&self) -> MutexGuard<'_, Objects> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The store as a host sees it.
    pub fn of_host(&self, host: usize) -> HostStore {
        HostStore { store: self.clone(), host }
    }

    /// Changes the way between a host and the store.
    pub fn set_way(&self, host: usize, change: impl FnOnce(&mut Way)) {
        change(&mut self.lock().ways[host]);
    }

    /// Lets arrive what has to.
    pub fn advance(&self, now_ms: u64) {
        let mut due = Vec::new();
        let mut objects = self.lock();
        objects.now_ms = now_ms;
        while objects.sent.first_key_value().is_some_and(|((at, _), _)| *at <= now_ms) {
            let (_, sent) = objects.sent.pop_first().expect("there is one");
            objects.arrive(sent);
        }
        while objects.answers.first_key_value().is_some_and(|((at, _), _)| *at <= now_ms) {
            due.push(objects.answers.pop_first().expect("there is one").1);
        }
        drop(objects);
        for (answer, result) in due {
            // Who has crashed does not hear it.
            let _ = answer.send(result);
        }
    }

    /// A hash of everything that happened.
    pub fn history(&self) -> String {
        self.lock().history.finalize().to_hex().to_string()
    }

    /// Adds something else that happened.
    pub fn note(&self, what: &str) {
        self.lock().history.update(what.as_bytes());
    }

    /// Number of puts that arrived.
    pub fn puts(&self) -> u64 {
        self.lock().puts
    }

    /// What is stored.
    pub fn objects(&self) -> BTreeMap<String, Bytes> {
        self.lock().bytes.clone()
    }
}

impl Objects {
    /// A put arrives.
    fn arrive(&mut self, sent: Sent) {
        let Sent { host, key, bytes, create, answer } = sent;
        let result = self.apply(&key, bytes, create);
        self.puts += 1;
        // The probe's scratch has a random name.
        let name = if key.starts_with(PROBE) { PROBE } else { &key };
        let line = format!("{} {host} {name} {}\n", self.now_ms, result.is_ok());
        tracing::debug!(line, "a put arrived");
        self.history.update(line.as_bytes());
        let Some(answer) = answer else { return };
        let way = self.ways[host];
        let is_lost = way.is_down || self.rng.random_range(0..100) < way.loss_percent;
        let result = if is_lost { Err(lost()) } else { result };
        let after = if is_lost { TIMEOUT_MS } else { self.rng.random_range(1..30) };
        self.next += 1;
        self.answers.insert((self.now_ms + after, self.next), (answer, result));
    }

    fn apply(&mut self, key: &str, bytes: Bytes, create: bool) -> Result<()> {
        if create && self.bytes.contains_key(key) {
            let source = "it is there".into();
            return Err(Error::AlreadyExists { path: key.to_owned(), source });
        }
        self.check(key, &bytes);
        self.bytes.insert(key.to_owned(), bytes.clone());
        let path = Path::parse(key).expect("keys are paths");
        let put = self.memory.put(&path, bytes.into());
        futures::executor::block_on(put).expect("memory takes everything");
        Ok(())
    }

    /// The invariants of what is written.
    fn check(&self, key: &str, bytes: &Bytes) {
        if key == "current.json" {
            for (name, expected) in &*self.expected {
                let is_data = name.starts_with("data/") || name.starts_with("manifests/");
                let stored = self.bytes.get(name);
                assert!(!is_data || stored == Some(expected), "JB-2: published without {name}");
            }
        } else if let Some(before) = self.bytes.get(key) {
            assert!(before == bytes, "CL-1: {key} is replaced");
        }
        if let Some(expected) = self.expected.get(key) {
            assert!(expected == bytes, "JB-2: {key} is not that of the undisturbed bake");
        }
        let folders: Vec<&str> = key.split('/').collect();
        match folders[..] {
            ["bake", _, "commits", task] => self.check_commit(task, bytes),
            ["bake", bake, "epochs", number] => {
                let number: u64 = number.parse().expect("epochs are numbers");
                let before = format!("bake/{bake}/epochs/{:08}", number - 1);
                let follows = number == 1 || self.bytes.contains_key(&before);
                assert!(follows, "CL-2: epoch {number} leaves a gap");
            }
            ["bake", ..] => {}
            // The undisturbed bake itself expects nothing.
            _ if self.expected.is_empty() => {}
            _ => assert!(self.expected.contains_key(key), "JB-2: nobody expects {key}"),
        }
    }

    fn check_commit(&self, task: &str, bytes: &Bytes) {
        let commit = v1::Commit::decode(bytes.clone()).expect("JB-1: a commit is a commit");
        assert_eq!(commit.task, task.parse::<u32>().expect("tasks are numbers"), "JB-1");
        for part in &commit.parts {
            let stored = self.bytes.get(&part.key);
            let stored = stored.unwrap_or_else(|| panic!("JB-1: {} is committed first", part.key));
            let digest = blake3::hash(stored).to_hex().to_string();
            assert_eq!(digest, part.digest, "JB-1: {} holds what is committed", part.key);
        }
    }
}

/// What a client that waits in vain is told.
fn lost() -> Error {
    Error::Generic { store: "simulated", source: "no answer in time".into() }
}

/// The store as one host sees it.
#[derive(Clone)]
pub struct HostStore {
    store: SimStore,
    host: usize,
}

impl HostStore {
    /// One way, there or back.
    async fn travel(&self) -> Result<()> {
        let (is_lost, takes_ms) = {
            let mut objects = self.store.lock();
            let way = objects.ways[self.host];
            let is_lost = way.is_down || objects.rng.random_range(0..100) < way.loss_percent;
            (is_lost, if is_lost { TIMEOUT_MS } else { objects.rng.random_range(1..30) })
        };
        tokio::time::sleep(Duration::from_millis(takes_ms)).await;
        if is_lost { Err(lost()) } else { Ok(()) }
    }

    async fn put(&self, key: String, bytes: Bytes, create: bool) -> Result<()> {
        let (answer, answered) = oneshot::channel();
        {
            let mut objects = self.store.lock();
            let way = objects.ways[self.host];
            let arrives = objects.now_ms + objects.rng.random_range(1..30);
            if !way.is_down && objects.rng.random_range(0..100) >= way.loss_percent {
                let arrives = arrives + objects.rng.random_range(0..=way.stall_ms);
                let repeats = way.loss_percent > 0 && objects.rng.random_range(0..100) < 5;
                let sent = |answer| Sent {
                    host: self.host,
                    key: key.clone(),
                    bytes: bytes.clone(),
                    create,
                    answer,
                };
                objects.next += 2;
                let number = objects.next;
                if repeats {
                    // The network sends it again; nobody hears of that.
                    let later = arrives + objects.rng.random_range(1..20_000);
                    objects.sent.insert((later, number - 1), sent(None));
                }
                objects.sent.insert((arrives, number), sent(Some(answer)));
            }
        }
        match tokio::time::timeout(Duration::from_millis(TIMEOUT_MS), answered).await {
            Ok(Ok(result)) => result,
            // The request is lost: its sender was dropped at once.
            Ok(Err(_)) => {
                tokio::time::sleep(Duration::from_millis(TIMEOUT_MS)).await;
                Err(lost())
            }
            Err(_) => Err(lost()),
        }
    }

    fn memory(&self) -> Arc<InMemory> {
        Arc::clone(&self.store.lock().memory)
    }
}

impl fmt::Debug for HostStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the store as host {} sees it", self.host)
    }
}

impl fmt::Display for HostStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self, f)
    }
}

#[async_trait::async_trait]
impl ObjectStore for HostStore {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        options: PutOptions,
    ) -> Result<PutResult> {
        let create = matches!(options.mode, PutMode::Create);
        self.put(location.to_string(), payload.into(), create).await?;
        Ok(PutResult { e_tag: None, version: None, extensions: Default::default() })
    }

    async fn put_multipart_opts(
        &self,
        _: &Path,
        _: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        Err(Error::NotImplemented {
            operation: "put_multipart".into(),
            implementer: "the simulation".into(),
        })
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        self.travel().await?;
        let found = self.memory().get_opts(location, options).await;
        self.travel().await?;
        found
    }

    async fn get_ranges(&self, location: &Path, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        self.travel().await?;
        let found = self.memory().get_ranges(location, ranges).await;
        self.travel().await?;
        found
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        let own = self.clone();
        let delete = move |location: Result<Path>| {
            let own = own.clone();
            async move {
                let location = location?;
                own.travel().await?;
                let scratch = location.as_ref().starts_with(PROBE);
                assert!(scratch, "CL-1: {location} is deleted");
                own.store.lock().bytes.remove(location.as_ref());
                own.memory().delete(&location).await?;
                Ok(location)
            }
        };
        locations.then(delete).boxed()
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        let (own, prefix) = (self.clone(), prefix.cloned());
        let listed = async move {
            own.travel().await?;
            let found: Vec<_> = own.memory().list(prefix.as_ref()).collect().await;
            own.travel().await?;
            Ok::<_, Error>(stream::iter(found))
        };
        stream::once(listed)
            .flat_map(|listed| match listed {
                Ok(found) => found.boxed(),
                Err(error) => stream::iter([Err(error)]).boxed(),
            })
            .boxed()
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.travel().await?;
        self.memory().list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, _: &Path, _: &Path, _: CopyOptions) -> Result<()> {
        Err(Error::NotImplemented {
            operation: "copy".into(),
            implementer: "the simulation".into(),
        })
    }
}

/// The numbers of the epochs that were taken.
pub fn epochs(objects: &BTreeMap<String, Bytes>) -> BTreeSet<u64> {
    let number = |key: &String| {
        let (folder, number) = key.rsplit_once('/')?;
        folder.ends_with("/epochs").then(|| number.parse().ok())?
    };
    objects.keys().filter_map(number).collect()
}
