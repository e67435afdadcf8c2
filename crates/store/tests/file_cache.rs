//! The cache of files: whole or not there, below its limit, and shared.

use std::path::Path;

use sightline_store::{BakeStore, FileCache, StoreError};

/// A store with objects of `size` bytes, and their keys and hashes.
async fn store_with(count: u8, size: usize) -> (BakeStore, Vec<(String, String)>) {
    let store = BakeStore::in_memory();
    let mut objects = Vec::new();
    for n in 0..count {
        let bytes = vec![n; size];
        let (key, digest) = (format!("files/{n}"), blake3::hash(&bytes).to_hex().to_string());
        store.put_pointer(&key, bytes).await.unwrap();
        objects.push((key, digest));
    }
    (store, objects)
}

fn count(folder: &Path, part: &str) -> usize {
    std::fs::read_dir(folder.join(part)).unwrap().count()
}

#[tokio::test]
async fn a_file_is_fetched_once_and_has_the_bytes_of_its_hash() {
    let folder = tempfile::tempdir().unwrap();
    let cache = FileCache::open(folder.path(), 1 << 20).unwrap();
    let (store, objects) = store_with(1, 1000).await;
    let (key, digest) = &objects[0];
    let sources = [(store, key.clone())];
    let file = cache.by_content(digest, 1000, &sources).await.unwrap();
    assert_eq!(std::fs::read(file.path()).unwrap(), [0; 1000]);
    // It is there: no source is asked.
    let again = cache.by_content(digest, 1000, &[]).await.unwrap();
    assert_eq!(again.path(), file.path());
}

#[tokio::test]
async fn a_damaged_file_is_fetched_again() {
    let folder = tempfile::tempdir().unwrap();
    let cache = FileCache::open(folder.path(), 1 << 20).unwrap();
    let (store, objects) = store_with(1, 1000).await;
    let (key, digest) = &objects[0];
    let sources = [(store, key.clone())];
    let path = cache.by_content(digest, 1000, &sources).await.unwrap().path().to_owned();
    for damage in [vec![1; 1000], vec![0; 999], Vec::new()] {
        std::fs::write(&path, damage).unwrap();
        let file = cache.by_content(digest, 1000, &sources).await.unwrap();
        assert_eq!(std::fs::read(file.path()).unwrap(), [0; 1000]);
    }
}

#[tokio::test]
async fn the_next_source_is_asked_when_one_has_something_else() {
    let folder = tempfile::tempdir().unwrap();
    let cache = FileCache::open(folder.path(), 1 << 20).unwrap();
    let (store, objects) = store_with(3, 1000).await;
    let digest = &objects[2].1;
    let source = |n: usize| (store.clone(), objects[n].0.clone());
    let missing = (store.clone(), "files/nothing".to_owned());
    let wrong = cache.by_content(digest, 1000, &[missing.clone(), source(0)]).await.unwrap_err();
    assert!(matches!(wrong, StoreError::Corrupt { .. }), "{wrong}");
    let none = cache.by_content(digest, 1000, std::slice::from_ref(&missing)).await.unwrap_err();
    assert!(matches!(none, StoreError::NotFound { .. }), "{none}");
    assert_eq!((count(folder.path(), "files"), count(folder.path(), "partial")), (0, 0));
    let file = cache.by_content(digest, 1000, &[missing, source(0), source(2)]).await.unwrap();
    assert_eq!(std::fs::read(file.path()).unwrap(), [2; 1000]);
}

#[tokio::test]
async fn the_least_recently_used_file_makes_room_and_one_in_use_does_not() {
    let folder = tempfile::tempdir().unwrap();
    let cache = FileCache::open(folder.path(), 3000).unwrap();
    let (store, objects) = store_with(5, 1000).await;
    let fetch = async |n: usize| {
        let (key, digest) = &objects[n];
        cache.by_content(digest, 1000, &[(store.clone(), key.clone())]).await
    };
    let is_there = |n: usize| folder.path().join("files").join(&objects[n].1).exists();
    let in_use = fetch(0).await.unwrap();
    for n in [1, 2, 1] {
        fetch(n).await.unwrap();
    }
    fetch(3).await.unwrap();
    assert_eq!([0, 1, 2, 3].map(is_there), [true, true, false, true]);
    fetch(4).await.unwrap();
    assert_eq!([0, 1, 3, 4].map(is_there), [true, false, true, true]);
    assert_eq!(std::fs::read(in_use.path()).unwrap(), [0; 1000]);

    let others = [fetch(3).await.unwrap(), fetch(4).await.unwrap()];
    let full = fetch(1).await.unwrap_err();
    assert!(matches!(full, StoreError::Cache { .. }), "{full}");
    assert!(full.to_string().contains("--cache-size"), "{full}");
    drop(others);
    fetch(1).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn many_that_share_a_folder_keep_below_the_limit_and_out_of_each_others_way() {
    let folder = tempfile::tempdir().unwrap();
    let (store, objects) = store_with(8, 100_000).await;
    let limit = 400_000;
    let workers = (0..8u64).map(|worker| {
        let (store, objects) = (store.clone(), objects.clone());
        // A cache of its own over the folder, as another process has it.
        let cache = FileCache::open(folder.path(), limit).unwrap();
        let files = folder.path().join("files");
        tokio::spawn(async move {
            for step in 0..12u64 {
                let (key, digest) = &objects[((worker * 5 + step * 3) % 8) as usize];
                let sources = [(store.clone(), key.clone())];
                match cache.by_content(digest, 100_000, &sources).await {
                    Ok(file) => {
                        let bytes = std::fs::read(file.path()).unwrap();
                        assert_eq!(blake3::hash(&bytes).to_hex().as_str(), digest);
                    }
                    // All room is in use by others at this moment.
                    Err(StoreError::Cache { .. }) => {}
                    Err(error) => panic!("{error}"),
                }
                assert!(std::fs::read_dir(&files).unwrap().count() <= 4);
            }
        })
    });
    for worker in workers.collect::<Vec<_>>() {
        worker.await.unwrap();
    }
    assert_eq!(count(folder.path(), "partial"), 0);
}

#[tokio::test]
async fn what_a_killed_process_left_behind_is_removed() {
    let folder = tempfile::tempdir().unwrap();
    let cache = FileCache::open(folder.path(), 3000).unwrap();
    let (store, objects) = store_with(2, 1000).await;
    let partial = format!("{}-2500-0123456789abcdef", objects[0].1);
    std::fs::write(folder.path().join("partial").join(partial), "half a f").unwrap();
    let view = folder.path().join("views/0123456789abcdef/scene");
    std::fs::create_dir_all(&view).unwrap();
    for (key, digest) in &objects {
        cache.by_content(digest, 1000, &[(store.clone(), key.clone())]).await.unwrap();
    }
    assert_eq!((count(folder.path(), "partial"), count(folder.path(), "views")), (0, 0));
}

#[tokio::test]
async fn a_key_is_fetched_again_when_it_names_other_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let cache = FileCache::open(folder.path(), 1 << 20).unwrap();
    let store = BakeStore::in_memory();
    assert!(cache.by_name(&store, "a/scene.glb").await.unwrap().is_none());
    for text in ["first", "other", "other"] {
        store.put_pointer("a/scene.glb", text).await.unwrap();
        let file = cache.by_name(&store, "a/scene.glb").await.unwrap().unwrap();
        assert_eq!(std::fs::read_to_string(file.path()).unwrap(), text);
        assert_eq!(file.digest(), blake3::hash(text.as_bytes()).to_hex().as_str());
    }
    assert_eq!(count(folder.path(), "files"), 2);
}

#[tokio::test]
async fn a_view_has_files_under_their_names_and_goes_when_it_is_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let cache = FileCache::open(folder.path(), 1 << 20).unwrap();
    let (store, objects) = store_with(2, 1000).await;
    let fetch = async |n: usize| {
        let (key, digest) = &objects[n];
        cache.by_content(digest, 1000, &[(store.clone(), key.clone())]).await.unwrap()
    };
    let named = vec![
        ("main/city.gltf".to_owned(), fetch(0).await),
        ("main/./buffers/a b.bin".to_owned(), fetch(1).await),
    ];
    let view = cache.view(named).await.unwrap();
    let read = |name: &str| std::fs::read(view.folder().join(name)).unwrap();
    assert_eq!(
        (read("main/city.gltf"), read("main/buffers/a b.bin")),
        (vec![0; 1000], vec![1; 1000])
    );
    let place = view.folder().to_owned();
    drop(view);
    assert!(!place.exists());
    for name in ["../out", "/etc/out", "a/../../out", ""] {
        let wrong = cache.view(vec![(name.to_owned(), fetch(0).await)]).await;
        assert!(matches!(wrong, Err(StoreError::Cache { .. })), "{name}");
    }
    assert_eq!(count(folder.path(), "views"), 0);
}
