//! What a bake asks of a store, as one suite that runs on every backend.
//!
//! Each promise is a function of its own that works below a folder of its own, so that they can be run
//! in any order and again on a store that has been used before.

use std::fmt::Write;
use std::future::Future;
use std::pin::Pin;

use sightline_store::{BakeStore, Created, ErrorClass, StoreError};

/// Writers that race for an object, and how often they do.
const RACERS: usize = 8;
const RACES: usize = 5;

/// Objects of the large listing: more than the thousand that S3, Google and Azure give at a time.
const LISTED: usize = 1_050;

type Kept<'a> = Pin<Box<dyn Future<Output = ()> + Send + 'a>>;

/// A promise: its name, and what looks whether it is kept in a folder.
type Promise = (&'static str, for<'a> fn(&'a BakeStore, &'a str) -> Kept<'a>);

/// All promises.
pub const PROMISES: [Promise; 11] = [
    ("the_probe_passes_and_cleans_up", |s, f| Box::pin(probe(s, f))),
    ("an_object_is_created_once", |s, f| Box::pin(created_once(s, f))),
    ("a_repeated_request_of_the_winner_wins", |s, f| Box::pin(repeated(s, f))),
    ("of_racing_writers_one_wins_and_its_bytes_are_read", |s, f| Box::pin(race(s, f))),
    ("bytes_come_back_as_they_were_written", |s, f| Box::pin(bytes(s, f))),
    ("ranges_are_parts_of_the_bytes", |s, f| Box::pin(ranges(s, f))),
    ("a_pointer_is_replaced", |s, f| Box::pin(pointer(s, f))),
    ("a_missing_object_is_missing", |s, f| Box::pin(missing(s, f))),
    ("keys_with_odd_characters_are_kept", |s, f| Box::pin(odd_keys(s, f))),
    ("more_than_a_thousand_keys_are_listed_in_order", |s, f| Box::pin(listing(s, f))),
    ("large_files_go_up_and_down_in_pieces", |s, f| Box::pin(large(s, f))),
];

/// Looks whether a store keeps every promise; returns their names.
///
/// # Panics
/// When one is broken.
pub async fn run(store: &BakeStore) -> String {
    let mut kept = String::new();
    for (name, promise) in PROMISES {
        promise(store, &format!("conformance/{name}")).await;
        let _ = writeln!(kept, "kept: {name}");
    }
    kept
}

async fn probe(store: &BakeStore, _: &str) {
    store.probe().await.expect("the store is fit for bakes");
    let left = store.list(sightline_store::keys::PROBE_FOLDER).await.expect("a folder is listed");
    assert!(left.is_empty(), "the probe leaves {left:?}");
}

async fn created_once(store: &BakeStore, folder: &str) {
    let key = format!("{folder}/one");
    let create = async |text: &'static str| store.create(&key, text).await.expect("it answers");
    assert_eq!(create("first").await, Created::ByUs);
    assert_eq!(create("second").await, Created::AlreadyThere);
    assert_eq!(store.get(&key).await.expect("it is there"), "first");
}

async fn repeated(store: &BakeStore, folder: &str) {
    let key = format!("{folder}/one");
    for _ in 0..2 {
        assert_eq!(store.create(&key, "ours").await.expect("it answers"), Created::ByUs);
    }
}

async fn race(store: &BakeStore, folder: &str) {
    for race in 0..RACES {
        let key = format!("{folder}/{race}");
        let racers = (0..RACERS).map(|racer| {
            let (store, key) = (store.clone(), key.clone());
            tokio::spawn(async move { store.create(&key, format!("racer {racer}")).await })
        });
        let racers: Vec<_> = racers.collect();
        let mut winners = Vec::new();
        for (number, racer) in racers.into_iter().enumerate() {
            let created = racer.await.expect("a racer ends").expect("it answers");
            winners.extend((created == Created::ByUs).then_some(number));
        }
        assert_eq!(winners.len(), 1, "winners of race {race}: {winners:?}");
        let expected = format!("racer {}", winners[0]);
        assert_eq!(store.get(&key).await.expect("it is there"), expected);
    }
}

async fn bytes(store: &BakeStore, folder: &str) {
    let all: Vec<u8> = (0..=255).cycle().take(100_000).collect();
    for (name, bytes) in [("empty", Vec::new()), ("all", all)] {
        let key = format!("{folder}/{name}");
        store.create(&key, bytes.clone()).await.expect("it can be written");
        assert_eq!(store.get(&key).await.expect("it is there"), bytes);
        assert_eq!(store.size(&key).await.expect("it is there"), bytes.len() as u64);
    }
}

async fn ranges(store: &BakeStore, folder: &str) {
    let key = format!("{folder}/digits");
    store.create(&key, "0123456789").await.expect("it can be written");
    assert_eq!(store.get_range(&key, 2..5).await.expect("a range"), "234");
    let several = store.get_ranges(&key, &[0..1, 9..10, 3..7]).await.expect("ranges");
    assert_eq!(several, ["0", "9", "3456"]);
    for behind_the_end in [8..12, 20..30] {
        let error = store.get_range(&key, behind_the_end).await.expect_err("it is too short");
        assert!(matches!(error, StoreError::Corrupt { .. }), "{error}");
    }
}

async fn pointer(store: &BakeStore, folder: &str) {
    let key = format!("{folder}/pointer");
    for text in ["first, and longer than what follows", "second", "third"] {
        store.put_pointer(&key, text).await.expect("it can be written");
        assert_eq!(store.get(&key).await.expect("it is there"), text);
    }
}

async fn missing(store: &BakeStore, folder: &str) {
    let key = format!("{folder}/nothing");
    let error = store.get(&key).await.expect_err("there is nothing");
    assert_eq!(error.class(), ErrorClass::NotFound, "{error}");
    assert_eq!(store.size(&key).await.expect_err("nothing").class(), ErrorClass::NotFound);
    assert_eq!(store.get_if_exists(&key).await.expect("it answers"), None);
    assert!(store.list(&key).await.expect("it answers").is_empty());
}

async fn odd_keys(store: &BakeStore, folder: &str) {
    let odd = ["a b", "a+b", "a&b=c", "ü", "100 (%)", "q,;@$!'", "dots..", "~tilde_-"];
    let mut keys: Vec<String> = odd.iter().map(|name| format!("{folder}/in {name}/x")).collect();
    for key in &keys {
        store.create(key, key.clone()).await.unwrap_or_else(|e| panic!("{key}: {e}"));
        assert_eq!(store.get(key).await.unwrap_or_else(|e| panic!("{key}: {e}")), *key);
    }
    keys.sort_unstable();
    assert_eq!(store.list(folder).await.expect("a listing"), keys);
}

async fn listing(store: &BakeStore, folder: &str) {
    let keys: Vec<String> = (0..LISTED).map(|n| format!("{folder}/commits/{n:08}")).collect();
    for some in keys.chunks(32) {
        let puts = some.iter().map(|key| {
            let (store, key) = (store.clone(), key.clone());
            tokio::spawn(async move { store.put_pointer(&key, "x").await })
        });
        for put in puts.collect::<Vec<_>>() {
            put.await.expect("a writer ends").expect("it can be written");
        }
    }
    // A folder whose name only begins alike is another.
    store.put_pointer(&format!("{folder}/commits-of-others"), "x").await.expect("it is written");
    assert_eq!(store.list(&format!("{folder}/commits")).await.expect("a listing"), keys);
}

async fn large(store: &BakeStore, folder: &str) {
    let scratch = tempfile::tempdir().expect("a temporary folder can be made");
    // Three pieces, the last one short; and less than one.
    for size in [20_000_003usize, 1_000, 0] {
        let bytes: Vec<u8> = (0..size).map(|i| (i * 31 % 251) as u8).collect();
        let (up, down) = (scratch.path().join("up"), scratch.path().join("down"));
        std::fs::write(&up, &bytes).expect("a file can be written");
        let digest = blake3::hash(&bytes).to_hex().to_string();
        let key = format!("{folder}/{digest}");
        let wrong = store.upload_content(&format!("{key}-wrong"), &up, "not its hash").await;
        assert!(matches!(wrong, Err(StoreError::SourceFile { .. })), "{wrong:?}");
        assert_eq!(store.get_if_exists(&format!("{key}-wrong")).await.expect("it answers"), None);
        for _ in 0..2 {
            store.upload_content(&key, &up, &digest).await.expect("it can be uploaded");
        }
        let version = store.version(&key).await.expect("it is there");
        assert_eq!(version.size, size as u64);
        let got = store.download(&key, &version, &down).await.expect("it can be downloaded");
        assert_eq!(got.to_hex().as_str(), digest);
        assert!(std::fs::read(&down).expect("it is there") == bytes, "{size} bytes differ");
    }
}
