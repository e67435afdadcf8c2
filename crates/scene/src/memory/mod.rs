//! Scenes that are larger than memory.
//!
//! With a [`MemoryLimit`], the triangles of a scene do not lie in vectors but in a *chunk file*
//! ([`file`]): for each mesh its vertices, its triangles in the order of its hierarchy, the nodes of
//! that hierarchy, and the numbers of the triangles in the glTF file, one array behind the other, just as
//! walks read them. The file is mapped into the process ([`map`]), and the arrays of the geometry point into
//! the mapping. What a walk touches is loaded by the operating system, some tens of KiB at a time; what it
//! does not touch, because something nearer hides it, is never loaded. All arrays are in the order of the
//! hierarchy, so a subtree is a stretch of each: what is near in space is near in the file.
//!
//! A mapping alone would grow until all of it is loaded. The [`Keeper`] looks, from within the walks, at what
//! the system counts for the process, and when that comes close to the limit it gives *chunks* of the
//! mapping back, 2 MiB each, in a circle over the file, until an eighth of the limit is free. To give back
//! changes nothing that anyone can read: a chunk that is touched again is loaded again, most often from
//! the page cache of the system, which keeps what is used most as long as it has room. So the result of
//! a bake depends neither on the limit nor on what was given back when (VI-3), walks cost what they cost in
//! memory, and there is no moment at which a thread may not read what it reads.
//!
//! What stays in memory always: nodes and objects of the scene, instances and the hierarchies over them,
//! boxes of meshes, all that moves on its own (skins, morph targets), particles. It counts: a scene whose
//! resting part leaves no room for chunks is refused.
//!
//! The chunk file is made once a scene, a mesh at a time, while the glTF file is mapped and kept within the
//! limit in the same way; later commands, and other workers on the machine, find it ([`folder`]). A damaged
//! one is made again.
//!
//! Invariants:
//! - ME-1: a chunk file is complete under its name, or not there: it is written under another name, and
//!   its hash is checked when it is opened;
//! - ME-2: a chunk file is never written to once it has its name, so mapped bytes do not change;
//! - ME-3: the bytes of a chunk file are a function of the glTF files and the options that choose what
//!   is read of them: not of the limit, the number of threads, or the machine.

mod file;
mod folder;
mod keeper;
mod map;

use std::{io, path::PathBuf, sync::Arc};

pub(crate) use file::{StoredBody, key, read_or_make};
pub use folder::default_folder;
pub use keeper::{Held, Keeper};
pub(crate) use map::Map;

use crate::{Cause, SceneError};

/// How much memory the process may take, and where what does not fit is put.
#[derive(Clone, Debug)]
pub struct MemoryLimit {
    /// Bytes that the system may count for the process (its resident set).
    pub bytes: u64,
    /// Folder of the chunk files; made when it does not exist.
    pub folder: PathBuf,
    /// Chunk files that were not used for longest are removed when the folder has more bytes than this.
    pub folder_bytes: u64,
    /// Refuse scenes whose resting part does not fit. Otherwise as little as possible is held.
    pub strict: bool,
}

impl MemoryLimit {
    /// A limit with the chunk files in `folder`, of which there may be 64 GiB.
    #[must_use]
    pub fn new(bytes: u64, folder: PathBuf) -> Self {
        Self { bytes, folder, folder_bytes: 64 << 30, strict: true }
    }
}

/// The content of a file: in memory, or mapped and kept within a limit.
pub(crate) enum Content {
    /// Read.
    Read(Vec<u8>),
    /// Mapped.
    Mapped(Arc<Map>),
}

impl Content {
    /// Opens a file, with a keeper mapped.
    pub(crate) fn of(path: &std::path::Path, keeper: Option<&Arc<Keeper>>) -> io::Result<Self> {
        match keeper {
            None => Ok(Self::Read(std::fs::read(path)?)),
            Some(keeper) => {
                let map = Arc::new(Map::of(&std::fs::File::open(path)?)?);
                keeper.keep(&map, false);
                Ok(Self::Mapped(map))
            }
        }
    }

    /// The bytes.
    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            Self::Read(bytes) => bytes,
            Self::Mapped(map) => map,
        }
    }
}

/// The hash of bytes that may be mapped.
pub(crate) fn hash(bytes: &[u8], keeper: Option<&Arc<Keeper>>) -> blake3::Hash {
    const BLOCK: usize = 4 << 20;
    let mut hasher = blake3::Hasher::new();
    for block in bytes.chunks(BLOCK) {
        hasher.update(block);
        if let Some(keeper) = keeper {
            keeper.look_now();
        }
    }
    hasher.finalize()
}

/// The hash of a file, read in pieces.
pub(crate) fn hash_file(path: &std::path::Path) -> io::Result<(u64, blake3::Hash)> {
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(std::fs::File::open(path)?)?;
    Ok((hasher.count(), hasher.finalize()))
}

/// The keeper for the limit of some options.
pub(crate) fn keeper(limit: Option<&MemoryLimit>) -> Result<Option<Arc<Keeper>>, SceneError> {
    let Some(limit) = limit else { return Ok(None) };
    let keeper = Keeper::new(limit).map_err(|source| Cause::MemoryUnknown { source })?;
    let keeper = Arc::new(keeper);
    keeper.watch().map_err(|source| Cause::MemoryUnknown { source })?;
    Ok(Some(keeper))
}
