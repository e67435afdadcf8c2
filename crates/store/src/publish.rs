//! Publishing: how a dataset becomes visible, at once.
//!
//! The writer of a dataset stores, in this order:
//! 1. the files under `data/`, each named by its content (ST-4);
//! 2. `manifests/<number>.json`, created only if absent, with the next free number;
//! 3. `current.json`, which names the manifest by number and hash.
//!
//! A crash leaves behind:
//! - during 1: files that nothing names. The next bake of the same input finds and uses them.
//! - between 2 and 3: a manifest that nothing names. The next [`publish`] of the same dataset finds
//!   it under the highest number and points to it instead of adding another.
//!
//! At every moment a reader finds the old dataset or the new one. Old manifests and files stay, so
//! a reader that holds an old pointer goes on reading. Publishing what is current already changes
//! nothing. One publisher at a time moves the pointer (the coordinator's epoch sees to that); two
//! that race still leave a complete dataset behind, of one or the other.

use bytes::Bytes;

use crate::manifest::{Manifest, Pointer, hash};
use crate::{BakeStore, Created, Result, StoreError, keys};

/// What [`publish`] did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Published {
    /// Number of the current manifest.
    pub number: u64,
    /// False when this very dataset was current already.
    pub changed: bool,
}

/// The pointer and the manifest it names, or `None` when nothing has been published.
///
/// # Errors
/// [`StoreError::Corrupt`] when one of them is damaged or the manifest is missing.
pub async fn current(store: &BakeStore) -> Result<Option<(Pointer, Manifest)>> {
    let Some(bytes) = store.get_if_exists(keys::POINTER).await? else { return Ok(None) };
    let pointer = Pointer::from_bytes(&bytes)?;
    if pointer.to_bytes() != bytes {
        return Err(StoreError::corrupt(keys::POINTER, "it is not written as pointers are"));
    }
    let key = keys::manifest(pointer.manifest);
    let Some(bytes) = store.get_if_exists(&key).await? else {
        return Err(StoreError::corrupt(&key, "the pointer names it, and it does not exist"));
    };
    if hash(&bytes) != pointer.blake3 {
        let problem = "its hash is not the one in the pointer";
        return Err(StoreError::corrupt(&key, problem));
    }
    let manifest = Manifest::from_bytes(&key, &bytes)?;
    Ok(Some((pointer, manifest)))
}

/// Makes `manifest` the current dataset. All files that it names must exist.
///
/// # Errors
/// [`StoreError::NotFound`] or [`StoreError::Corrupt`] when a file is missing or of another size,
/// and then nothing has changed; or what the store reports.
pub async fn publish(store: &BakeStore, manifest: &Manifest) -> Result<Published> {
    for file in &manifest.files {
        let size = store.size(&file.name).await?;
        if size != file.bytes {
            let problem = format!("it has {size} bytes instead of {}", file.bytes);
            return Err(StoreError::corrupt(&file.name, problem));
        }
    }
    let bytes = manifest.to_bytes();
    let number = place_manifest(store, &bytes).await?;
    let pointer = Pointer::to(number, &bytes).to_bytes();
    if store.get_if_exists(keys::POINTER).await?.as_ref() == Some(&pointer) {
        return Ok(Published { number, changed: false });
    }
    store.put_pointer(keys::POINTER, pointer).await?;
    Ok(Published { number, changed: true })
}

/// Stores the manifest under the next free number, unless the highest number or the current one
/// holds it already.
async fn place_manifest(store: &BakeStore, bytes: &Bytes) -> Result<u64> {
    if let Some(number) = current_number(store).await?
        && store.get_if_exists(&keys::manifest(number)).await?.as_ref() == Some(bytes)
    {
        return Ok(number);
    }
    let listed = store.list(keys::MANIFEST_FOLDER).await?;
    let highest = listed.iter().filter_map(|key| keys::manifest_number(key)).max().unwrap_or(0);
    let mut number = highest.max(1);
    loop {
        let key = keys::manifest(number);
        match store.get_if_exists(&key).await? {
            Some(found) if found == bytes => return Ok(number),
            Some(_) => number += 1,
            None => match store.create(&key, bytes.clone()).await? {
                Created::ByUs => return Ok(number),
                Created::AlreadyThere => {}
            },
        }
    }
}

/// The number in the pointer; a damaged pointer counts as none, since publishing replaces it.
async fn current_number(store: &BakeStore) -> Result<Option<u64>> {
    let bytes = store.get_if_exists(keys::POINTER).await?;
    Ok(bytes.and_then(|bytes| Pointer::from_bytes(&bytes).ok()).map(|pointer| pointer.manifest))
}
