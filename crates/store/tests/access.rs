//! What `BakeStore` promises, on files and in memory, and how it takes a store's failures.

mod support;

use std::sync::Arc;

use object_store::memory::InMemory;
use sightline_store::{BakeStore, Created, ErrorClass, StoreError, keys};
use support::faulty::{Fault, Faulty};

/// Runs the same promises on every kind of store.
async fn keeps_its_promises(store: &BakeStore) {
    store.probe().await.unwrap();
    assert!(store.list(keys::BAKE_FOLDER).await.unwrap().is_empty(), "the probe cleans up");

    assert_eq!(store.create("a/one", "1").await.unwrap(), Created::ByUs);
    assert_eq!(store.create("a/one", "2").await.unwrap(), Created::AlreadyThere);
    assert_eq!(store.get("a/one").await.unwrap(), "1");

    store.put_pointer("a/pointer", "old").await.unwrap();
    store.put_pointer("a/pointer", "newer").await.unwrap();
    assert_eq!(store.get("a/pointer").await.unwrap(), "newer");
    assert_eq!(store.get_range("a/pointer", 1..3).await.unwrap(), "ew");
    assert_eq!(store.size("a/pointer").await.unwrap(), 5);

    store.create("ab/two", "").await.unwrap();
    assert_eq!(store.list("a").await.unwrap(), ["a/one", "a/pointer"]);
    assert_eq!(store.list("").await.unwrap().len(), 3);
    assert!(store.list("nothing/here").await.unwrap().is_empty());

    let missing = store.get("a/three").await.unwrap_err();
    assert_eq!(missing.class(), ErrorClass::NotFound);
    assert!(store.get_if_exists("a/three").await.unwrap().is_none());
    for range in [3..9, 7..9] {
        let short = store.get_range("a/pointer", range).await.unwrap_err();
        assert!(matches!(short, StoreError::Corrupt { ref file, .. } if file == "a/pointer"));
    }

    store.create_content("data/x", "right").await.unwrap();
    store.put_pointer("data/x", "wrong").await.unwrap();
    assert_eq!(store.create_content("data/x", "right").await.unwrap(), Created::AlreadyThere);
    assert_eq!(store.get("data/x").await.unwrap(), "right", "damage is repaired");
}

#[tokio::test(flavor = "multi_thread")]
async fn files_keep_the_promises() {
    let folder = tempfile::tempdir().unwrap();
    let location = folder.path().join("new/folder with space");
    let location = location.to_str().unwrap();
    assert_eq!(BakeStore::open(location).unwrap_err().class(), ErrorClass::FixInput);
    keeps_its_promises(&BakeStore::open_or_create(location).unwrap()).await;
    BakeStore::open(location).unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn file_urls_keep_the_promises() {
    let folder = tempfile::tempdir().unwrap();
    let url = url::Url::from_directory_path(folder.path()).unwrap();
    keeps_its_promises(&BakeStore::open(url.as_str()).unwrap()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn memory_keeps_the_promises() {
    keeps_its_promises(&BakeStore::in_memory()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_in_a_store_keeps_the_promises() {
    let objects = Arc::new(InMemory::new());
    let store = BakeStore::new(objects, "some/folder".into(), "memory");
    keeps_its_promises(&store).await;
}

#[test]
fn unknown_schemes_are_the_users_to_fix() {
    for location in ["https://example.com/x", "nonsense://x", "://"] {
        let error = BakeStore::open(location).unwrap_err();
        assert_eq!(error.class(), ErrorClass::FixInput, "{error}");
    }
}

#[tokio::test]
async fn a_lost_answer_is_settled_by_reading_back() {
    let inner = Arc::new(InMemory::new());
    let store = Faulty::over(&inner, Fault::AnswersLost).bake_store();
    assert_eq!(store.create("k", "ours").await.unwrap(), Created::ByUs);
    assert_eq!(store.create("k", "theirs").await.unwrap(), Created::AlreadyThere);

    let store = Faulty::over(&inner, Fault::RequestsLost).bake_store();
    assert_eq!(store.create("k", "theirs").await.unwrap(), Created::AlreadyThere);
    assert_eq!(store.create("other", "x").await.unwrap_err().class(), ErrorClass::RetryLater);
}

#[tokio::test]
async fn a_put_that_was_tried_again_after_it_succeeded_is_ours() {
    let inner = Arc::new(InMemory::new());
    let store = Faulty::over(&inner, Fault::TriedAgain).bake_store();
    assert_eq!(store.create("k", "ours").await.unwrap(), Created::ByUs);
    assert_eq!(store.create("k", "theirs").await.unwrap(), Created::AlreadyThere);
    assert_eq!(store.get("k").await.unwrap(), "ours");
}

#[tokio::test]
async fn a_put_that_met_another_under_way_is_made_again() {
    let inner = Arc::new(InMemory::new());
    let store = Faulty::over(&inner, Fault::Conflicts(3)).bake_store();
    assert_eq!(store.create("k", "ours").await.unwrap(), Created::ByUs);
    let store = Faulty::over(&inner, Fault::Conflicts(100)).bake_store();
    let error = store.create("other", "ours").await.unwrap_err();
    assert_eq!(error.class(), ErrorClass::RetryLater, "{error}");
    assert_eq!(store.create("k", "theirs").await.unwrap(), Created::AlreadyThere);
}

#[tokio::test]
async fn a_hundred_thousand_commits_are_listed_in_order() {
    let store = BakeStore::in_memory();
    for task in 0..100_000 {
        store.put_pointer(&keys::commit("b", task), "x").await.unwrap();
    }
    let listed = store.list(&keys::commits("b")).await.unwrap();
    let tasks: Vec<u32> = listed.iter().filter_map(|key| keys::commit_task(key)).collect();
    assert!(tasks.iter().copied().eq(0..100_000));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_where_everyone_wins_is_refused() {
    let inner = Arc::new(InMemory::new());
    let store = Faulty::over(&inner, Fault::EveryoneWins).bake_store();
    let error = store.probe().await.unwrap_err();
    assert!(matches!(error, StoreError::UnsafeStore { .. }), "{error}");
    assert!(store.list("").await.unwrap().is_empty(), "nothing is left behind");
}
