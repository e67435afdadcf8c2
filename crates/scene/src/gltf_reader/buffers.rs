//! The bytes of buffers and buffer views.
//!
//! Every buffer is loaded once, at the start, and hashed on the way. A buffer that is marked as
//! the fallback of a compression extension may be absent. Views are decompressed at their first
//! use and kept.

use std::{
    path::Path,
    sync::{Arc, OnceLock},
};

use serde::Deserialize;

use super::{
    document::{Document, extension, shorten},
    meshopt_view::{self, MeshoptView},
    uri::{self, Target},
};
use crate::{
    Cause, Keeper, SceneError,
    memory::{self, Content},
};

/// The two names of the same compression.
const MESHOPT: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];

/// The buffers of a scene.
pub struct Buffers<'a> {
    document: &'a Document,
    data: Vec<Bytes<'a>>,
    files: Vec<(String, u64, blake3::Hash)>,
    /// Decompressed views; the error is the decoder's reason.
    decoded: Vec<OnceLock<Result<Vec<u8>, String>>>,
}

enum Bytes<'a> {
    /// The binary chunk.
    Chunk(&'a [u8]),
    /// An external file or a data URI.
    Owned(Vec<u8>),
    /// An external file, perhaps mapped.
    File(Content),
    /// The same file as an earlier buffer.
    Shared(usize),
    /// No data: a placeholder.
    Absent,
}

/// The bytes of a buffer view.
pub struct View<'a> {
    /// Index into `bufferViews`.
    pub index: u32,
    /// Its bytes.
    pub bytes: &'a [u8],
    /// `byteStride`, where it is set.
    pub stride: Option<u64>,
}

#[derive(Default, Deserialize)]
struct Fallback {
    #[serde(default)]
    fallback: bool,
}

fn target(buffer: u32, uri: &str) -> Result<Target, SceneError> {
    let refused = |problem| Cause::BufferUri { buffer, uri: shorten(uri), problem };
    uri::resolve(uri).map_err(|problem| refused(problem).into())
}

/// What `read` makes of an external file; nothing where it is not there and need not be.
fn external<T>(
    document: &Document,
    path: &Path,
    buffer: u32,
    name: &str,
    read: impl FnOnce(&Path) -> std::io::Result<T>,
) -> Result<Option<T>, SceneError> {
    let file = path.parent().unwrap_or(Path::new("")).join(name);
    let read = || {
        // Opening a named pipe would wait for a writer.
        if !std::fs::metadata(&file)?.is_file() {
            return Err(std::io::Error::other("not a regular file"));
        }
        read(&file)
    };
    match read() {
        Ok(content) => Ok(Some(content)),
        Err(_) if is_fallback(document, buffer)? => Ok(None),
        Err(source) => Err(Cause::MissingBuffer { buffer, file, source }.into()),
    }
}

fn is_fallback(document: &Document, buffer: u32) -> Result<bool, SceneError> {
    let extensions = document.buffers[buffer as usize].extensions.as_ref();
    for name in MESHOPT {
        let mark: Option<Fallback> = extension(extensions.map(|e| &e.others), name)?;
        if mark.is_some_and(|m| m.fallback) {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Name, size and hash of a file.
pub type Hashed = (String, u64, blake3::Hash);

/// What [`Buffers::files`] would give, with no file in memory as a whole. `main` is the size and the hash
/// of the main file at `path`.
pub fn hash_all(
    path: &Path,
    main: (u64, blake3::Hash),
    document: &Document,
) -> Result<Vec<Hashed>, SceneError> {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned());
    let mut files = vec![(name.unwrap_or_default(), main.0, main.1)];
    let mut seen = std::collections::HashSet::new();
    for (index, buffer) in (0..).zip(&document.buffers) {
        let Some(uri) = buffer.uri.as_deref().filter(|uri| seen.insert(*uri)) else { continue };
        if let Target::File(name) = target(index, uri)?
            && let Some((bytes, hash)) = external(document, path, index, &name, memory::hash_file)?
        {
            files.push((name, bytes, hash));
        }
    }
    Ok(files)
}

impl<'a> Buffers<'a> {
    /// Loads all buffers. `main` is the content of the main file at `path`.
    pub fn load(
        path: &Path,
        main: &[u8],
        binary: Option<&'a [u8]>,
        document: &'a Document,
        keeper: Option<&Arc<Keeper>>,
    ) -> Result<Self, SceneError> {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned());
        let main = (name.unwrap_or_default(), main.len() as u64, memory::hash(main, keeper));
        let decoded = document.buffer_views.iter().map(|_| OnceLock::new()).collect();
        let mut buffers = Self { document, data: Vec::new(), files: vec![main], decoded };
        let mut seen = std::collections::HashMap::new();
        for (index, buffer) in document.buffers.iter().enumerate() {
            let bytes = match (&buffer.uri, binary) {
                (Some(uri), _) => match seen.get(uri.as_str()) {
                    Some(&first) => Bytes::Shared(first),
                    None => {
                        seen.insert(uri.as_str(), index);
                        buffers.open(path, index as u32, uri, keeper)?
                    }
                },
                (None, Some(chunk)) if index == 0 => Bytes::Chunk(chunk),
                (None, _) => Bytes::Absent,
            };
            buffers.data.push(bytes);
            let available = buffers.whole(index).map(|b| b.len() as u64);
            if let Some(available) = available.filter(|&a| a < buffer.byte_length.0) {
                let (buffer, stated) = (index as u32, buffer.byte_length.0);
                return Err(Cause::TruncatedBuffer { buffer, stated, available }.into());
            }
        }
        Ok(buffers)
    }

    /// Names, sizes and hashes of the main file and of the external buffers.
    pub fn files(&self) -> &[(String, u64, blake3::Hash)] {
        &self.files
    }

    fn open(
        &mut self,
        path: &Path,
        buffer: u32,
        uri: &str,
        keeper: Option<&Arc<Keeper>>,
    ) -> Result<Bytes<'a>, SceneError> {
        let name = match target(buffer, uri)? {
            Target::Data(bytes) => return Ok(Bytes::Owned(bytes)),
            Target::File(name) => name,
        };
        let content = external(self.document, path, buffer, &name, |f| Content::of(f, keeper))?;
        let Some(content) = content else { return Ok(Bytes::Absent) };
        let bytes = content.bytes();
        self.files.push((name, bytes.len() as u64, memory::hash(bytes, keeper)));
        Ok(Bytes::File(content))
    }

    /// All bytes behind a buffer, also those behind its `byteLength`.
    fn whole(&self, buffer: usize) -> Option<&[u8]> {
        match self.data.get(buffer)? {
            Bytes::Chunk(bytes) => Some(bytes),
            Bytes::Owned(bytes) => Some(bytes),
            Bytes::File(content) => Some(content.bytes()),
            Bytes::Shared(first) => self.whole(*first),
            Bytes::Absent => None,
        }
    }

    /// Bytes `start .. start + length` of a buffer, on behalf of a view.
    fn slice(&self, view: u32, buffer: u32, start: u64, length: u64) -> Result<&[u8], SceneError> {
        let referrer = || format!("buffer view {view}");
        let stated = Document::get(&self.document.buffers, "buffer", buffer, referrer)?.byte_length;
        let bytes = self.whole(buffer as usize).ok_or(Cause::BufferWithoutData { buffer })?;
        // Loading has checked that the stated length is there.
        let available = stated.0.min(bytes.len() as u64);
        let end = start.saturating_add(length);
        if end > available {
            return Err(Cause::ViewOutOfBuffer { view, buffer, start, end, available }.into());
        }
        Ok(&bytes[start as usize..end as usize])
    }

    /// The bytes of a view, decompressed.
    pub fn view(
        &self,
        index: u32,
        referrer: impl FnOnce() -> String,
    ) -> Result<View<'_>, SceneError> {
        let view = Document::get(&self.document.buffer_views, "buffer view", index, referrer)?;
        let stride = view.byte_stride.map(|s| s.0 as u64).filter(|&s| s > 0);
        let others = view.extensions.as_ref().map(|e| &e.others);
        let plain = || {
            let start = view.byte_offset.map_or(0, |o| o.0);
            self.slice(index, view.buffer.value() as u32, start, view.byte_length.0)
        };
        for name in MESHOPT {
            let Some(compressed) = extension::<MeshoptView>(others, name)? else { continue };
            let decoded = self.decoded[index as usize].get_or_init(|| {
                let source = self.slice(
                    index,
                    compressed.buffer,
                    compressed.byte_offset,
                    compressed.byte_length,
                );
                let source = source.map_err(|e| e.cause.to_string())?;
                meshopt_view::decode(&compressed, source)
            });
            return match decoded {
                Ok(bytes) => Ok(View { index, bytes, stride }),
                // The data of the fallback buffer, where it has any.
                Err(reason) => match plain() {
                    Ok(bytes) => Ok(View { index, bytes, stride }),
                    Err(_) => {
                        let (extension, reason) = (name, reason.clone());
                        Err(Cause::Compressed { view: index, extension, reason }.into())
                    }
                },
            };
        }
        Ok(View { index, bytes: plain()?, stride })
    }
}
