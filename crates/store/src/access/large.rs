//! Objects that do not fit in memory: files up, objects down, a few pieces at a time.

use std::io;
use std::path::Path as FilePath;

use bytes::{Bytes, BytesMut};
use futures::{StreamExt, TryStreamExt, stream};
use object_store::{GetOptions, GetRange, ObjectStoreExt, WriteMultipart};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::BakeStore;
use crate::{Result, StoreError};

/// Bytes of a piece. S3 wants at least 5 MiB; a request of this size takes a second at 8 MB/s, so a
/// lost one costs little.
const PIECE_BYTES: usize = 8 << 20;
/// Pieces on their way at a time: 32 MiB of memory.
const PIECES_AT_ONCE: usize = 4;
/// Most pieces of an object: S3 takes 10,000.
const PIECES_MAX: u64 = 9_000;

/// Which bytes a key names at a moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ObjectVersion {
    /// Size, bytes.
    pub size: u64,
    /// What tells these bytes from others that were or will be there: entity tag, version and time.
    pub tag: String,
    e_tag: Option<String>,
}

impl BakeStore {
    /// The bytes that a key names now.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], or what the store reports.
    pub async fn version(&self, key: &str) -> Result<ObjectVersion> {
        let meta = self.objects.head(&self.path(key)?).await.map_err(|e| self.error(key, e))?;
        let tag = format!(
            "{} {} {}",
            meta.e_tag.as_deref().unwrap_or_default(),
            meta.version.as_deref().unwrap_or_default(),
            meta.last_modified.timestamp_millis()
        );
        Ok(ObjectVersion { size: meta.size, tag, e_tag: meta.e_tag })
    }

    /// Writes a file under a key that is derived from its content: `digest` is the file's BLAKE3
    /// hash. The object appears at once, whole; one of the right size that is there is left alone.
    ///
    /// # Errors
    /// [`StoreError::SourceFile`] when the file cannot be read or is not the one that was hashed, and
    /// then nothing is written; or what the store reports.
    pub async fn upload_content(&self, key: &str, path: &FilePath, digest: &str) -> Result<()> {
        let unreadable = |e: io::Error| source_file(path, format!("it cannot be read: {e}"));
        let mut file = File::open(path).await.map_err(unreadable)?;
        let size = file.metadata().await.map_err(unreadable)?.len();
        match self.size(key).await {
            Ok(found) if found == size => return Ok(()),
            Ok(_) | Err(StoreError::NotFound { .. }) => {}
            Err(error) => return Err(error),
        }
        let changed = || source_file(path, "it changed after it was read".into());
        let mut hasher = blake3::Hasher::new();
        if size <= PIECE_BYTES as u64 {
            let bytes = read_piece(&mut file, PIECE_BYTES + 1).await.map_err(unreadable)?;
            hasher.update(&bytes);
            if hasher.finalize().to_hex().as_str() != digest {
                return Err(changed());
            }
            return self.put_pointer(key, bytes).await;
        }
        let piece = PIECE_BYTES.max((size / PIECES_MAX) as usize + 1);
        let upload = self.objects.put_multipart(&self.path(key)?).await;
        let mut upload =
            WriteMultipart::new_with_chunk_size(upload.map_err(|e| self.error(key, e))?, piece);
        loop {
            let bytes = match read_piece(&mut file, piece).await {
                Ok(bytes) => bytes,
                Err(error) => {
                    self.give_up(key, upload).await;
                    return Err(unreadable(error));
                }
            };
            if bytes.is_empty() {
                break;
            }
            hasher.update(&bytes);
            if let Err(error) = upload.wait_for_capacity(PIECES_AT_ONCE).await {
                self.give_up(key, upload).await;
                return Err(self.error(key, error));
            }
            upload.put(bytes);
        }
        if hasher.finalize().to_hex().as_str() != digest {
            self.give_up(key, upload).await;
            return Err(changed());
        }
        upload.finish().await.map(drop).map_err(|e| self.error(key, e))
    }

    /// What stays of an upload that was given up costs space until the store's owner clears it.
    async fn give_up(&self, key: &str, upload: WriteMultipart) {
        let _ = upload.abort().await.map_err(|e| self.error(key, e));
    }

    /// Writes the bytes of an object to a file, and returns their BLAKE3 hash.
    ///
    /// # Errors
    /// [`StoreError::Unavailable`] when the object changes meanwhile; [`StoreError::SourceFile`] when
    /// the file cannot be written; or what the store reports.
    pub async fn download(
        &self,
        key: &str,
        version: &ObjectVersion,
        file: &FilePath,
    ) -> Result<blake3::Hash> {
        let path = self.path(key)?;
        let unwritable = |e: io::Error| source_file(file, format!("it cannot be written: {e}"));
        let mut out = File::create(file).await.map_err(unwritable)?;
        let starts = (0..version.size).step_by(PIECE_BYTES);
        let pieces = stream::iter(starts).map(|start| {
            let end = version.size.min(start + PIECE_BYTES as u64);
            let options = GetOptions {
                range: Some(GetRange::Bounded(start..end)),
                if_match: version.e_tag.clone(),
                ..GetOptions::default()
            };
            let path = &path;
            async move {
                let got = self.objects.get_opts(path, options).await;
                let bytes: Bytes = match got {
                    Ok(got) => got.bytes().await.map_err(|e| self.error(key, e))?,
                    Err(error) => return Err(self.error(key, error)),
                };
                if bytes.len() as u64 == end - start {
                    return Ok(bytes);
                }
                Err(StoreError::corrupt(key, "it is shorter than the store said"))
            }
        });
        let mut pieces = pieces.buffered(PIECES_AT_ONCE);
        let mut hasher = blake3::Hasher::new();
        while let Some(bytes) = pieces.try_next().await? {
            hasher.update(&bytes);
            out.write_all(&bytes).await.map_err(unwritable)?;
        }
        out.flush().await.map_err(unwritable)?;
        Ok(hasher.finalize())
    }
}

fn source_file(path: &FilePath, problem: String) -> StoreError {
    StoreError::SourceFile { path: path.to_owned(), problem }
}

/// Up to `bytes_max` bytes; fewer at the end of the file only.
async fn read_piece(file: &mut File, bytes_max: usize) -> io::Result<Bytes> {
    let mut out = BytesMut::with_capacity(bytes_max);
    while out.len() < bytes_max {
        let room = (bytes_max - out.len()) as u64;
        if (&mut *file).take(room).read_buf(&mut out).await? == 0 {
            break;
        }
    }
    Ok(out.freeze())
}
