//! Reading glTF 2.0: from bytes to a numbered [`Scene`].
//!
//! Source: Khronos, "glTF 2.0 Specification"; the extensions KHR_mesh_quantization,
//! EXT_mesh_gpu_instancing, EXT_ and KHR_meshopt_compression, KHR_draco_mesh_compression,
//! KHR_node_visibility, KHR_animation_pointer.
//!
//! The steps, one module each:
//! 1. `container`: a `.glb` file into its JSON and binary chunks;
//! 2. `document`: the JSON into the types of the `gltf` crate, without what triangles do not
//!    need, so that a broken texture, or an animation that is not asked for, refuses nothing;
//! 3. `uri`, `buffers`: external, embedded and data-URI buffers; views, decompressed by
//!    `meshopt_view` where they are compressed;
//! 4. `animation`: what moves, from the channels of the animation that the options choose;
//! 5. `nodes`, `gpu_instancing`: the default scene into placements in `f64`;
//! 6. `accessors`, `draco`, `primitives`: triangles of each unique primitive, in parallel, and where
//!    they are at the key frames;
//! 7. `assemble`: numbering, objects, report.
//!
//! The `gltf` crate's own accessor iterators and validation are not used: they panic on ranges
//! that are out of bounds. Every count is checked against the bytes behind it before memory is
//! reserved; what has no bytes behind it has a limit of its own.

mod accessors;
mod animation;
mod assemble;
pub(crate) mod buffers;
pub(crate) mod container;
pub(crate) mod document;
mod draco;
mod gpu_instancing;
mod meshopt_view;
mod nodes;
mod primitives;
pub(crate) mod uri;

use std::{path::Path, sync::Arc};

use crate::{
    Cause, Keeper, OpenOptions, Scene, SceneDigest, SceneError,
    memory::{self, Content},
    particles::Tables,
};
pub use assemble::see_through_patterns;

/// Largest coordinate of a used vertex and of anything in the world, metres (a tenth of a light
/// year). Keeps areas and volumes of boxes finite in `f32` hierarchies.
pub const MAX_COORDINATE: f64 = 1e15;

/// Reads and numbers a scene.
pub fn read(
    path: &Path,
    options: &OpenOptions,
    keeper: Option<&Arc<Keeper>>,
) -> Result<Scene, SceneError> {
    read_bytes(path, main_file(path, keeper)?.bytes(), options, keeper)
}

/// Reads and numbers a scene whose main file is in memory.
pub fn read_bytes(
    path: &Path,
    main: &[u8],
    options: &OpenOptions,
    keeper: Option<&Arc<Keeper>>,
) -> Result<Scene, SceneError> {
    let see_through = see_through_patterns(options)?;
    let error = options.motion_error;
    if !(error > 0.0 && error.is_finite()) {
        return Err(Cause::MotionError { error }.into());
    }
    let parts = container::split(main)?;
    let document = document::Document::parse(parts.json)?;
    document.check_extensions()?;
    let buffers = buffers::Buffers::load(path, main, parts.binary, &document, keeper)?;
    let accessors = accessors::Accessors::new(&document, &buffers);
    let mut animations = animation::read(&document, &accessors, &options.animation)?;
    let placed = nodes::placements(&document, &accessors, &animations, options)?;
    animations.ignore_nodes_outside(|node| placed.has(node));
    let tables = Tables::read(options)?;
    let times = tables.key_times();
    let chunks = keeper.zip(options.memory.as_ref()).map(|(keeper, limit)| primitives::Chunks {
        keeper,
        limit,
        key: memory::key(
            &SceneDigest::of_files(buffers.files().to_vec()).combined,
            &format!("{:?}", options.animation),
        ),
    });
    let unique = primitives::collect(
        &document,
        &accessors,
        &placed,
        &animations,
        &times,
        options,
        chunks.as_ref(),
    )?;
    assemble::scene(&document, &buffers, placed, unique, tables, animations, &see_through)
}

/// Names, sizes and hashes of the files of a scene.
pub fn files(path: &Path) -> Result<Vec<(String, u64, blake3::Hash)>, SceneError> {
    expect_file(path)?;
    let read = |source| SceneError::from(Cause::Read { source });
    let json = container::json_of(path)?;
    let document = document::Document::parse(&json)?;
    let (bytes, hash) = memory::hash_file(path).map_err(read)?;
    buffers::hash_all(path, (bytes, hash), &document)
}

/// The files that the buffers of a glTF file name, relative to its folder, in their order, each once. Of
/// buffers whose URIs are refused there is nothing here: opening the scene says why.
pub fn external_buffers(path: &Path) -> Result<Vec<String>, SceneError> {
    expect_file(path)?;
    let json = container::json_of(path)?;
    let document = document::Document::parse(&json)?;
    let mut names = Vec::new();
    for uri in document.buffers.iter().filter_map(|buffer| buffer.uri.as_deref()) {
        if let Ok(uri::Target::File(name)) = uri::resolve(uri)
            && !names.contains(&name)
        {
            names.push(name);
        }
    }
    Ok(names)
}

fn main_file(path: &Path, keeper: Option<&Arc<Keeper>>) -> Result<Content, SceneError> {
    expect_file(path)?;
    Content::of(path, keeper).map_err(|source| Cause::Read { source }.into())
}

fn expect_file(path: &Path) -> Result<(), SceneError> {
    let read = |source| SceneError::from(Cause::Read { source });
    // Opening a named pipe would wait for a writer.
    if !std::fs::metadata(path).map_err(read)?.is_file() {
        return Err(Cause::NotAFile.into());
    }
    Ok(())
}
