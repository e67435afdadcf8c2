//! Chunk files: the resting triangles of a scene as walks read them. Format: `schemas/chunks-v1.md`.
//!
//! Arrays lie one behind the other, each at a multiple of 64 bytes; a directory behind them says, for
//! each primitive of the glTF file that was read, what came of it and where its arrays are; a hash over
//! everything ends the file.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
    sync::Arc,
};

use bytemuck::{AnyBitPattern, NoUninit};
use glam::DVec3;
use sightline_geometry::{Array, Bounds, Hierarchy, Holder, Mesh};

use super::{Keeper, Map, MemoryLimit, folder};
use crate::{Cause, SceneError};

/// First bytes of a chunk file.
const MAGIC: [u8; 8] = *b"SIGHTCHK";

/// Version of the format and of what the arrays hold: to be raised when the order of triangles, the
/// hierarchies, or what counts as degenerate changes.
const VERSION: u64 = 1;

const HEADER: usize = 64;
const FOOTER: usize = 16 + blake3::OUT_LEN;

/// Arrays begin at its multiples: the alignment of the most demanding element.
const ALIGNMENT: u64 = 64;

/// Flags of an entry.
const ODD_INDICES: u64 = 1;
const HAS_BODY: u64 = 2;
const HAS_DEGENERATE: u64 = 4;

/// What was made of one primitive of the glTF file.
pub(crate) struct StoredBody {
    /// Indices into `meshes` and into the `primitives` of that mesh.
    pub name: (u32, u32),
    /// Indices at the end made no triangle.
    pub odd_indices: bool,
    /// Number of degenerate triangles, and the first of them.
    pub degenerate: Option<(u64, Vec<u32>)>,
    /// The triangles, and their numbers in the primitive; none where all are degenerate.
    pub body: Option<(Mesh, Array<u32>)>,
}

/// The key of the chunk file of a scene: what it is made from.
pub(crate) fn key(files: &str, animation: &str) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&MAGIC);
    hasher.update(&VERSION.to_le_bytes());
    for text in [files, animation] {
        hasher.update(&(text.len() as u64).to_le_bytes());
        hasher.update(text.as_bytes());
    }
    hasher.finalize()
}

/// Opens the chunk file of a key, or makes it: `make` writes the bodies of `names`, in this order.
/// A sentence comes with it when a file had to be made again.
pub(crate) fn read_or_make(
    limit: &MemoryLimit,
    keeper: &Arc<Keeper>,
    key: &blake3::Hash,
    names: &[(u32, u32)],
    make: impl FnOnce(&mut Writer) -> Result<(), SceneError>,
) -> Result<(Vec<StoredBody>, Option<String>), SceneError> {
    let path = folder::file_of(&limit.folder, key);
    let failed =
        |source: io::Error| SceneError::from(Cause::ChunkFile { file: path.clone(), source });
    if cfg!(target_endian = "big") {
        return Err(failed(io::Error::other("the arrays of chunk files are little endian")));
    }
    let mut warning = None;
    match File::open(&path).and_then(|file| read(&file, key, names, keeper, true)) {
        Ok(bodies) => {
            if let Ok(file) = File::options().write(true).open(&path) {
                folder::touch(&file);
            }
            return Ok((bodies, None));
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => {
            let file = path.display();
            warning = Some(format!("the chunk file {file} was damaged ({error}): made again"));
        }
    }
    fs::create_dir_all(&limit.folder).map_err(failed)?;
    let mut writer = Writer::new(&limit.folder, key, path.clone()).map_err(failed)?;
    make(&mut writer)?;
    let file = writer.finish().map_err(failed)?;
    folder::prune(&limit.folder, &path, limit.folder_bytes).map_err(failed)?;
    // What was just written is not hashed again.
    let bodies = read(&file, key, names, keeper, false).map_err(failed)?;
    Ok((bodies, warning))
}

/// Writes a chunk file.
pub(crate) struct Writer {
    out: BufWriter<tempfile::NamedTempFile>,
    hasher: blake3::Hasher,
    written: u64,
    directory: Vec<u64>,
    path: PathBuf,
}

impl Writer {
    fn new(folder: &Path, key: &blake3::Hash, path: PathBuf) -> io::Result<Self> {
        let file = tempfile::Builder::new().prefix("making-").tempfile_in(folder)?;
        let out = BufWriter::with_capacity(1 << 20, file);
        let hasher = blake3::Hasher::new();
        let mut writer = Self { out, hasher, written: 0, directory: vec![], path };
        writer.write(&MAGIC)?;
        writer.write(&VERSION.to_le_bytes())?;
        writer.write(key.as_bytes())?;
        writer.align()?;
        Ok(writer)
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.hasher.update(bytes);
        self.written += bytes.len() as u64;
        self.out.write_all(bytes)
    }

    fn align(&mut self) -> io::Result<()> {
        let missing = self.written.next_multiple_of(ALIGNMENT) - self.written;
        self.write(&[0; ALIGNMENT as usize][..missing as usize])
    }

    fn array<T: NoUninit>(&mut self, elements: &[T]) -> io::Result<()> {
        self.align()?;
        self.directory.extend([self.written, elements.len() as u64]);
        self.write(bytemuck::cast_slice(elements))
    }

    /// Adds what was made of a primitive.
    pub(crate) fn put(&mut self, stored: &StoredBody) -> Result<(), SceneError> {
        self.try_put(stored)
            .map_err(|source| Cause::ChunkFile { file: self.path.clone(), source }.into())
    }

    fn try_put(&mut self, stored: &StoredBody) -> io::Result<()> {
        let StoredBody { name, odd_indices, degenerate, body } = stored;
        let flag = |given: bool, flag: u64| if given { flag } else { 0 };
        let flags = flag(*odd_indices, ODD_INDICES)
            | flag(body.is_some(), HAS_BODY)
            | flag(degenerate.is_some(), HAS_DEGENERATE);
        self.directory.extend([u64::from(name.0), u64::from(name.1), flags]);
        if let Some((count, listed)) = degenerate {
            self.directory.extend([*count, listed.len() as u64]);
            self.directory.extend(listed.iter().map(|&t| u64::from(t)));
        }
        if let Some((mesh, numbers)) = body {
            let Bounds { min, max } = mesh.bounds;
            self.directory.push(mesh.hierarchy.depth as u64);
            let corners = [min.to_array(), max.to_array()];
            self.directory.extend(corners.as_flattened().iter().map(|v| v.to_bits()));
            self.array(&mesh.positions)?;
            self.array(&mesh.triangles)?;
            self.array(&mesh.hierarchy.nodes)?;
            self.array(mesh.hierarchy.wide_nodes())?;
            self.array(numbers)?;
        }
        Ok(())
    }

    /// Writes directory and hash, and gives the file its name (ME-1).
    fn finish(mut self) -> io::Result<File> {
        self.align()?;
        let (offset, directory) = (self.written, std::mem::take(&mut self.directory));
        for word in directory.iter().chain(&[offset, directory.len() as u64]) {
            self.write(&word.to_le_bytes())?;
        }
        let hash = self.hasher.finalize();
        self.out.write_all(hash.as_bytes())?;
        let file = self.out.into_inner().map_err(io::IntoInnerError::into_error)?;
        Ok(file.persist(&self.path)?)
    }
}

fn damaged(what: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

/// Maps a chunk file, once its hash is what it says where `check` asks for it.
fn read(
    mut file: &File,
    key: &blake3::Hash,
    names: &[(u32, u32)],
    keeper: &Arc<Keeper>,
    check: bool,
) -> io::Result<Vec<StoredBody>> {
    let length = file.metadata()?.len();
    let hashed = length.saturating_sub(blake3::OUT_LEN as u64);
    if length < (HEADER + FOOTER) as u64 {
        return Err(damaged("it is cut short"));
    }
    if check {
        file.seek(SeekFrom::Start(0))?;
        let mut hasher = blake3::Hasher::new();
        hasher.update_reader(file.take(hashed))?;
        let mut stated = [0; blake3::OUT_LEN];
        file.read_exact(&mut stated)?;
        if hasher.finalize() != stated {
            return Err(damaged("its hash is not that of its content"));
        }
    }
    let map = Arc::new(Map::of(file)?);
    if map.len() as u64 != length || !map.starts_with(&MAGIC) {
        return Err(damaged("it is no chunk file"));
    }
    if map[8..16] != VERSION.to_le_bytes() || map[16..48] != *key.as_bytes() {
        return Err(damaged("it is of another version or scene"));
    }
    let footer = words(&map, hashed as usize - 16, 2).ok_or_else(|| damaged("it has no footer"))?;
    let directory = words(&map, footer[0] as usize, footer[1] as usize);
    let mut directory = directory.ok_or_else(|| damaged("its directory is not within it"))?;
    let mut rest = Directory { words: &mut directory, next: 0, map: &map };
    let mut bodies = Vec::with_capacity(names.len());
    for name in names {
        let body = rest.entry().ok_or_else(|| damaged("an entry is not within it"))?;
        if body.name != *name {
            return Err(damaged("it has the triangles of other meshes"));
        }
        bodies.push(body);
    }
    if rest.next != rest.words.len() {
        return Err(damaged("it has triangles of more meshes"));
    }
    keeper.keep(&map, true);
    Ok(bodies)
}

/// Words at an offset.
fn words(bytes: &[u8], offset: usize, count: usize) -> Option<Vec<u64>> {
    let end = count.checked_mul(8)?.checked_add(offset)?;
    let words = bytes.get(offset..end)?.as_chunks::<8>().0;
    Some(words.iter().map(|word| u64::from_le_bytes(*word)).collect())
}

/// The directory while it is read.
struct Directory<'a> {
    words: &'a mut [u64],
    next: usize,
    map: &'a Arc<Map>,
}

impl Directory<'_> {
    fn word(&mut self) -> Option<u64> {
        self.next += 1;
        self.words.get(self.next - 1).copied()
    }

    fn small(&mut self) -> Option<u32> {
        self.word()?.try_into().ok()
    }

    fn array<T: AnyBitPattern>(&mut self) -> Option<Array<T>> {
        let (offset, len) = (self.word()?, self.word()?);
        let holder = Arc::clone(self.map) as Arc<dyn Holder>;
        Array::within(holder, offset.try_into().ok()?, len.try_into().ok()?)
    }

    fn entry(&mut self) -> Option<StoredBody> {
        let name = (self.small()?, self.small()?);
        let flags = self.word()?;
        let mut degenerate = None;
        if flags & HAS_DEGENERATE != 0 {
            let (count, listed) = (self.word()?, self.word()?);
            let listed: Option<Vec<u32>> = (0..listed).map(|_| self.small()).collect();
            degenerate = Some((count, listed?));
        }
        let mut body = None;
        if flags & HAS_BODY != 0 {
            let depth = self.word()?.try_into().ok()?;
            let mut corner = || -> Option<DVec3> {
                let mut value = || Some(f64::from_bits(self.word()?));
                Some(DVec3::new(value()?, value()?, value()?))
            };
            let bounds = Bounds { min: corner()?, max: corner()? };
            let (positions, triangles) = (self.array()?, self.array()?);
            let (nodes, wide) = (self.array()?, self.array()?);
            let hierarchy = Hierarchy::of_parts(nodes, depth, wide);
            let mesh = Mesh { positions, triangles, hierarchy, bounds, motion: None };
            body = Some((mesh, self.array()?));
        }
        Some(StoredBody { name, odd_indices: flags & ODD_INDICES != 0, degenerate, body })
    }
}

#[cfg(test)]
mod tests;
