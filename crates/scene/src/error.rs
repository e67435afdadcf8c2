//! Why a scene is refused, where in the file, and what to do about it.
//!
//! Promise: a file is either read or refused with one [`SceneError`]; the reader never panics
//! and never allocates by a count that the file's bytes do not back. [`Cause`] has one variant a
//! cause; [`SceneError::help`] says what the author of the file can do. Nobody needs to match on
//! strings.

use std::{
    fmt, io,
    path::{Path, PathBuf},
};

use bytesize::ByteSize;

use crate::particles::TableProblem;

/// A scene that was refused.
#[derive(Debug)]
pub struct SceneError {
    /// The main file of the scene, or the particle table.
    pub file: PathBuf,
    /// The part of the scene that was being read.
    pub place: Place,
    /// What is wrong.
    pub cause: Box<Cause>,
}

/// The part of a scene that an error is about; glTF indices, as far as they are known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Place {
    /// Index into `nodes`.
    pub node: Option<u32>,
    /// Index into `meshes`.
    pub mesh: Option<u32>,
    /// Index into the mesh's `primitives`.
    pub primitive: Option<u32>,
    /// Index into `skins`.
    pub skin: Option<u32>,
    /// Index into `animations`.
    pub animation: Option<u32>,
    /// Index into the animation's `channels`.
    pub channel: Option<u32>,
    /// Index into the animation's `samplers`.
    pub sampler: Option<u32>,
}

/// What is wrong with a scene. Byte ranges are half open.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Cause {
    /// The main file cannot be read.
    #[error("cannot read the file: {source}")]
    Read {
        /// The operating system's reason.
        source: io::Error,
    },
    /// The path names a folder or a device.
    #[error("not a regular file")]
    NotAFile,
    /// The pattern of a see-through rule does not parse.
    #[error("the see-through pattern `{pattern}` is malformed: {reason}")]
    Pattern {
        /// The pattern as given.
        pattern: String,
        /// What the pattern parser says.
        reason: String,
    },

    /// A particle table is refused.
    #[error(transparent)]
    Table(#[from] TableProblem),

    /// The system does not say how much memory the process takes.
    #[error("a memory limit needs the sizes in /proc/self/statm: {source}")]
    MemoryUnknown {
        /// The operating system's reason.
        source: io::Error,
    },
    /// What of a scene stays in memory leaves no room for the rest.
    #[error("the scene needs at least {}, and the memory limit is {}", ByteSize(*.needed),
        ByteSize(*.limit))]
    OutOfMemory {
        /// Bytes that would do.
        needed: u64,
        /// The limit.
        limit: u64,
    },
    /// A chunk file cannot be written or read.
    #[error("the chunk file {}: {source}", file.display())]
    ChunkFile {
        /// Its path.
        file: PathBuf,
        /// The operating system's reason.
        source: io::Error,
    },

    /// A GLB file ends before the length that it states.
    #[error("the GLB container is cut short: {what} needs {needed} bytes, {available} are there")]
    GlbTruncated {
        /// Header, chunk header or chunk.
        what: &'static str,
        /// Bytes that it needs.
        needed: u64,
        /// Bytes that are left in the file.
        available: u64,
    },
    /// A GLB file of another version.
    #[error("GLB container version {version} instead of 2")]
    GlbVersion {
        /// The version in the header.
        version: u32,
    },
    /// The first chunk of a GLB file is not JSON.
    #[error("the first GLB chunk has type {found:#010x} instead of JSON")]
    GlbWithoutJson {
        /// Type of the first chunk.
        found: u32,
    },
    /// The JSON does not parse, or a property has the wrong type.
    #[error("the JSON is invalid at line {line}, column {column}: {reason}")]
    Json {
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// What the JSON parser says.
        reason: String,
    },
    /// Not a version of glTF that this reader knows.
    #[error("glTF version `{version}` instead of 2.x")]
    Version {
        /// `asset.version` or `asset.minVersion`.
        version: String,
    },
    /// The file requires an extension that changes geometry and is not known here.
    #[error("the required extension `{extension}` is not supported")]
    RequiredExtension {
        /// Its name.
        extension: String,
    },
    /// An extension's object does not have the form that its specification gives.
    #[error("`{extension}` is malformed: {reason}")]
    ExtensionMalformed {
        /// Its name.
        extension: &'static str,
        /// What is wrong.
        reason: String,
    },
    /// An index of the JSON names an element that does not exist.
    #[error("{referrer} names {element} {index}, but there are {count}")]
    NoSuch {
        /// The property that holds the index.
        referrer: String,
        /// Kind of the missing element.
        element: &'static str,
        /// The index.
        index: u64,
        /// Number of elements of the kind.
        count: u64,
    },
    /// A property has a value that glTF does not allow.
    #[error("{property} has a value that glTF does not allow")]
    InvalidValue {
        /// The property.
        property: String,
    },

    /// The URI of a buffer is refused.
    #[error("buffer {buffer}: the URI `{uri}` {problem}")]
    BufferUri {
        /// Index into `buffers`.
        buffer: u32,
        /// The URI, shortened when long.
        uri: String,
        /// Why it is refused.
        problem: UriProblem,
    },
    /// An external buffer cannot be read.
    #[error("buffer {buffer}: cannot read `{}`: {source}", file.display())]
    MissingBuffer {
        /// Index into `buffers`.
        buffer: u32,
        /// The file that its URI names.
        file: PathBuf,
        /// The operating system's reason.
        source: io::Error,
    },
    /// A buffer holds fewer bytes than it states.
    #[error("buffer {buffer} states {stated} bytes, {available} are there")]
    TruncatedBuffer {
        /// Index into `buffers`.
        buffer: u32,
        /// `byteLength`.
        stated: u64,
        /// Bytes in the file, the data URI or the binary chunk.
        available: u64,
    },
    /// A buffer with neither a URI nor a binary chunk is needed.
    #[error("buffer {buffer} has no URI and the file has no binary chunk for it")]
    BufferWithoutData {
        /// Index into `buffers`.
        buffer: u32,
    },
    /// A buffer view reaches behind its buffer.
    #[error(
        "buffer view {view} is bytes {start}..{end} of buffer {buffer}, which has {available} bytes"
    )]
    ViewOutOfBuffer {
        /// Index into `bufferViews`.
        view: u32,
        /// Index into `buffers`.
        buffer: u32,
        /// First byte.
        start: u64,
        /// Byte behind the last.
        end: u64,
        /// Bytes in the buffer.
        available: u64,
    },
    /// Compressed data does not decode.
    #[error("buffer view {view}: `{extension}` data does not decode: {reason}")]
    Compressed {
        /// Index into `bufferViews`.
        view: u32,
        /// The compression extension.
        extension: &'static str,
        /// What is wrong.
        reason: String,
    },

    /// An accessor reaches behind its buffer view.
    #[error(
        "accessor {accessor} ({part}) needs {needed} bytes of buffer view {view}, which has {available}"
    )]
    AccessorOutOfView {
        /// Index into `accessors`.
        accessor: u32,
        /// Elements, sparse indices or sparse values.
        part: &'static str,
        /// Index into `bufferViews`.
        view: u32,
        /// Bytes from the start of the view to the end of the last element.
        needed: u64,
        /// Bytes in the view.
        available: u64,
    },
    /// An accessor has the wrong type for its use.
    #[error("accessor {accessor} holds {found} and cannot be used as {use_as}")]
    AccessorType {
        /// Index into `accessors`.
        accessor: u32,
        /// Type and component type.
        found: String,
        /// What it is used for.
        use_as: &'static str,
    },
    /// The elements of an accessor overlap.
    #[error(
        "accessor {accessor}: the stride of {stride} bytes is less than an element's {element}"
    )]
    AccessorStride {
        /// Index into `accessors`.
        accessor: u32,
        /// `byteStride`.
        stride: u64,
        /// Bytes in an element.
        element: u64,
    },
    /// An accessor without data claims more elements than is allowed without data.
    #[error("accessor {accessor} claims {count} elements without data; the limit is {limit}")]
    AccessorTooLarge {
        /// Index into `accessors`.
        accessor: u32,
        /// `count`.
        count: u64,
        /// The limit.
        limit: u64,
    },
    /// A sparse accessor replaces an element that does not exist.
    #[error("accessor {accessor}: sparse entry {entry} replaces element {index} of {count}")]
    SparseIndex {
        /// Index into `accessors`.
        accessor: u32,
        /// Number of the sparse entry.
        entry: u64,
        /// The index it holds.
        index: u64,
        /// Elements of the accessor.
        count: u64,
    },
    /// Attributes that must have the same number of elements do not.
    #[error("accessor {accessor} ({use_as}) has {count} elements instead of {expected}")]
    CountMismatch {
        /// Index into `accessors`.
        accessor: u32,
        /// What it is used for.
        use_as: &'static str,
        /// Its elements.
        count: u64,
        /// Elements of its companions.
        expected: u64,
    },

    /// A vertex that a triangle uses is NaN or infinite.
    #[error("vertex {vertex} is at {position:?}, which is not finite")]
    PositionNotFinite {
        /// Index of the vertex in the primitive.
        vertex: u32,
        /// Its position.
        position: [f32; 3],
    },
    /// A vertex that a triangle uses is too far away.
    #[error("vertex {vertex} is at {position:?}, farther than {limit:e} m")]
    PositionTooFar {
        /// Index of the vertex in the primitive.
        vertex: u32,
        /// Its position.
        position: [f32; 3],
        /// The limit, metres.
        limit: f64,
    },
    /// A vertex index is out of range.
    #[error("index {at} of the primitive is {index}, but there are {vertices} vertices")]
    IndexOutOfRange {
        /// Position in the index list.
        at: u64,
        /// The index.
        index: u32,
        /// Vertices of the primitive.
        vertices: u64,
    },
    /// A vertex index is the primitive restart value, which glTF forbids.
    #[error("index {at} of the primitive is {index}, the primitive restart value")]
    PrimitiveRestart {
        /// Position in the index list.
        at: u64,
        /// The index.
        index: u32,
    },
    /// Draco data does not decode.
    #[error("`KHR_draco_mesh_compression` data does not decode: {reason}")]
    Draco {
        /// What is wrong.
        reason: String,
    },

    /// A node is its own ancestor.
    #[error("node {node} is its own ancestor")]
    NodeCycle {
        /// Index into `nodes`.
        node: u32,
    },
    /// A node is reached twice.
    #[error("node {node} has two parents, or is listed twice")]
    NodeWithTwoParents {
        /// Index into `nodes`.
        node: u32,
    },
    /// Nodes are nested too deeply.
    #[error("nodes are nested more than {limit} deep")]
    NodesTooDeep {
        /// The limit.
        limit: u32,
    },
    /// A transform is not finite.
    #[error("the transform is not finite")]
    TransformNotFinite,
    /// A matrix whose last row is not 0 0 0 1.
    #[error("the matrix is not affine: its last row is {row:?}")]
    MatrixNotAffine {
        /// The row.
        row: [f64; 4],
    },
    /// A rotation of length zero.
    #[error("the rotation has length zero")]
    RotationZero,
    /// Something lies too far from the world's origin.
    #[error(
        "the object reaches {coordinate:e} m from the world's origin; the limit is {limit:e} m"
    )]
    TooFar {
        /// Largest coordinate.
        coordinate: f64,
        /// The limit.
        limit: f64,
    },

    /// The options ask for an animation that the file does not have.
    #[error("there is no animation {wanted}; the file has {}", list(names))]
    NoSuchAnimation {
        /// Index, or name in quotation marks.
        wanted: String,
        /// Names of those in the file; `#` and the index for those without.
        names: Vec<String>,
    },
    /// The JSON of an animation or a skin is not what glTF defines.
    #[error("its JSON is malformed: {reason}")]
    PartMalformed {
        /// What is wrong.
        reason: String,
    },
    /// Two channels that play at the same time move the same property.
    #[error("`{path}` of node {node} is moved by {first} and by {second}")]
    AnimationConflict {
        /// Index into `nodes`.
        node: u32,
        /// The property.
        path: &'static str,
        /// Animation and channel.
        first: String,
        /// Animation and channel.
        second: String,
    },
    /// A channel moves the translation, rotation or scale of a node that has a matrix.
    #[error("node {node} has a matrix, of which `{path}` cannot be moved")]
    AnimatedMatrix {
        /// Index into `nodes`.
        node: u32,
        /// The property.
        path: &'static str,
    },
    /// Times of keys do not ascend, are negative or are not finite.
    #[error(
        "key {at} is at {time} s (accessor {accessor}); times must be finite, at least 0, and ascend"
    )]
    KeyTime {
        /// Index into `accessors`.
        accessor: u32,
        /// Number of the key.
        at: u64,
        /// Its time, seconds.
        time: f32,
    },
    /// A sampler has no keys.
    #[error("it has no keys (accessor {accessor})")]
    NoKeys {
        /// Index into `accessors`.
        accessor: u32,
    },
    /// A value of a sampler is not finite, or a rotation of length zero.
    #[error("value {at} of accessor {accessor} is not finite, or a rotation of length zero")]
    KeyValue {
        /// Index into `accessors`.
        accessor: u32,
        /// Number of the element.
        at: u64,
    },
    /// A joint of a skin is not in the scene.
    #[error("joint {joint} is node {node}, which is not in the scene")]
    JointNotInScene {
        /// Number of the joint in the skin.
        joint: u64,
        /// Index into `nodes`.
        node: u32,
    },
    /// A vertex follows a joint that the skin does not have, or with a weight that is none.
    #[error(
        "vertex {vertex} follows joint {joint} with weight {weight}; there are {joints} joints"
    )]
    VertexJoint {
        /// Index of the vertex in the primitive.
        vertex: u32,
        /// Number of the joint.
        joint: u32,
        /// Its weight.
        weight: f32,
        /// Joints of the skin.
        joints: u64,
    },
    /// The motion error of the options is not above 0.
    #[error("a motion error of {error} m cannot be kept")]
    MotionError {
        /// The option, metres.
        error: f64,
    },
    /// The motion needs more states than the options allow.
    #[error(
        "following the motion within {error} m takes more than {limit} states; they reach to \
         {reached:.3} s of {duration:.3} s"
    )]
    TooManyStates {
        /// Motion error of the options, metres.
        error: f64,
        /// The limit.
        limit: u32,
        /// Time that the states within the limit reach to, seconds.
        reached: f64,
        /// Duration of the animation, seconds.
        duration: f64,
    },
    /// The motion bends so much that looking at it takes too long.
    #[error("following the motion within {error} m takes more than {limit} samples of it")]
    TooManySamples {
        /// Motion error of the options, metres.
        error: f64,
        /// The limit.
        limit: u64,
    },
    /// More positions of moving things than the options allow.
    #[error(
        "the scene has {count} positions of moving things at its key frames; the limit is {limit}"
    )]
    TooManyMovingPositions {
        /// Positions, once a key frame.
        count: u64,
        /// The limit.
        limit: u64,
    },

    /// More triangles than primitive numbers.
    #[error("the scene has {count} triangles with its instances; the limit is {limit}")]
    TooManyTriangles {
        /// Triangles, instances counted.
        count: u64,
        /// The limit.
        limit: u64,
    },
    /// More triangles and particles than primitive numbers.
    #[error("the scene has {count} triangles and particles; the limit is {limit}")]
    TooManyPrimitives {
        /// Triangles, instances counted, and particles.
        count: u64,
        /// The limit.
        limit: u64,
    },
    /// More triangles in memory than the options allow.
    #[error("the scene has {count} unique triangles; the limit is {limit}")]
    TooManyUniqueTriangles {
        /// Triangles, each mesh counted once.
        count: u64,
        /// The limit.
        limit: u64,
    },
    /// More triangles of instances that a scale of zero flattens than are allowed.
    #[error("a scale of zero flattens {count} triangles of instances; the limit is {limit}")]
    TooManyFlattened {
        /// Triangles, each flattened instance counted.
        count: u64,
        /// The limit.
        limit: u64,
    },
    /// More instances than the options allow.
    #[error("the scene has {count} instances; the limit is {limit}")]
    TooManyInstances {
        /// Instances.
        count: u64,
        /// The limit.
        limit: u64,
    },
}

/// Why a URI is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UriProblem {
    /// It has a scheme such as `https:`.
    Scheme,
    /// It is an absolute path.
    Absolute,
    /// It leaves the folder of the main file.
    Escape,
    /// Its percent encoding is malformed, or not UTF-8.
    Encoding,
    /// It is a `data:` URI that does not decode.
    Data,
    /// It is empty.
    Empty,
}

impl fmt::Display for UriProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Scheme => "has a scheme; only relative files and data: URIs are read",
            Self::Absolute => "is an absolute path; only relative files are read",
            Self::Escape => "leaves the folder of the scene",
            Self::Encoding => "is not valid percent-encoded UTF-8",
            Self::Data => "is not a valid data: URI",
            Self::Empty => "is empty",
        })
    }
}

/// Names for a message, cut where they are many.
fn list(names: &[String]) -> String {
    const LISTED: usize = 16;
    match names.len() {
        0 => "none".into(),
        n if n <= LISTED => names.join(", "),
        n => format!("{} and {} more", names[..LISTED].join(", "), n - LISTED),
    }
}

impl fmt::Display for Place {
    /// `node 3, mesh 2, primitive 0: `, or nothing.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parts = [
            ("node", self.node),
            ("mesh", self.mesh),
            ("primitive", self.primitive),
            ("skin", self.skin),
            ("animation", self.animation),
            ("channel", self.channel),
            ("sampler", self.sampler),
        ];
        let known: Vec<String> =
            parts.iter().filter_map(|(name, index)| index.map(|i| format!("{name} {i}"))).collect();
        if known.is_empty() { Ok(()) } else { write!(f, "{}: ", known.join(", ")) }
    }
}

impl fmt::Display for SceneError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}{}", self.file.display(), self.place, self.cause)
    }
}

impl std::error::Error for SceneError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        std::error::Error::source(&*self.cause)
    }
}

impl From<Cause> for SceneError {
    fn from(cause: Cause) -> Self {
        Self { file: PathBuf::new(), place: Place::default(), cause: Box::new(cause) }
    }
}

impl From<TableProblem> for SceneError {
    fn from(problem: TableProblem) -> Self {
        Cause::from(problem).into()
    }
}

impl SceneError {
    /// Names the file, where none is named yet.
    pub(crate) fn in_file(mut self, file: &Path) -> Self {
        if self.file.as_os_str().is_empty() {
            self.file = file.to_path_buf();
        }
        self
    }

    pub(crate) fn at_node(mut self, node: usize) -> Self {
        self.place.node.get_or_insert(node as u32);
        self
    }

    pub(crate) fn at_primitive(mut self, mesh: usize, primitive: usize) -> Self {
        self.place.mesh.get_or_insert(mesh as u32);
        self.place.primitive.get_or_insert(primitive as u32);
        self
    }

    pub(crate) fn at_skin(mut self, skin: u32) -> Self {
        self.place.skin.get_or_insert(skin);
        self
    }

    pub(crate) fn at_animation(mut self, animation: usize) -> Self {
        self.place.animation.get_or_insert(animation as u32);
        self
    }

    pub(crate) fn at_channel(mut self, channel: usize) -> Self {
        self.place.channel.get_or_insert(channel as u32);
        self
    }

    pub(crate) fn at_sampler(mut self, sampler: u32) -> Self {
        self.place.sampler.get_or_insert(sampler);
        self
    }

    /// What to do about it, in one or two sentences; `None` when the message says it all.
    #[must_use]
    pub fn help(&self) -> Option<String> {
        let text = match &*self.cause {
            Cause::Read { .. } | Cause::NotAFile => {
                "give the path of a .gltf, .glb, .parquet or .csv file that this user can read"
                    .into()
            }
            Cause::Table(problem) => problem.help().into(),
            Cause::MemoryUnknown { .. } => {
                "a memory limit can be kept on Linux, with /proc; leave the limit away".into()
            }
            Cause::OutOfMemory { .. } => {
                "give a higher limit; instances, what moves and particles stay in memory, and a mesh \
                 is in memory while its hierarchy is made"
                    .into()
            }
            Cause::ChunkFile { .. } => {
                "give a folder on a disk with room for about 100 bytes a triangle with --chunks".into()
            }
            Cause::Pattern { .. } => {
                "patterns are globs: `*` and `**` match any text, `?` one character, `{a,b}` \
                 alternatives; write `[*]` for a literal star"
                    .into()
            }
            Cause::GlbTruncated { .. } | Cause::TruncatedBuffer { .. } => {
                "the file was probably cut short while it was copied or downloaded; fetch or \
                 export it again"
                    .into()
            }
            Cause::GlbVersion { .. } | Cause::Version { .. } => {
                "convert the file to glTF 2.0, for example by importing it in Blender and \
                 exporting it again"
                    .into()
            }
            Cause::GlbWithoutJson { .. } | Cause::Json { .. } => {
                "this is not a valid glTF file; check that the path names the scene and not one \
                 of its buffers, and export it again"
                    .into()
            }
            Cause::RequiredExtension { extension } => format!(
                "export the scene without `{extension}`; without it the triangles would be wrong"
            ),
            Cause::MissingBuffer { file, .. } => format!(
                "put `{}` beside the scene, or pack everything into one file with `npx \
                 @gltf-transform/cli copy scene.gltf scene.glb`",
                file.display()
            ),
            Cause::BufferUri { .. } => {
                "buffers have to lie in the folder of the scene or below; pack everything into \
                 one file with `npx @gltf-transform/cli copy scene.gltf scene.glb`"
                    .into()
            }
            Cause::Draco { .. } | Cause::Compressed { .. } => {
                "decompress the scene with `npx @gltf-transform/cli copy in.glb out.glb`, which \
                 removes KHR_draco_mesh_compression and EXT_meshopt_compression"
                    .into()
            }
            Cause::PrimitiveRestart { .. } => {
                "glTF has no primitive restart; export the strips as separate primitives or as \
                 triangles"
                    .into()
            }
            Cause::PositionNotFinite { .. } => {
                "remove the vertex, or the modifier that made it, and export the scene again".into()
            }
            Cause::PositionTooFar { .. } | Cause::TooFar { .. } => {
                "move the scene to the world's origin; its unit is the metre".into()
            }
            Cause::TooManyFlattened { .. } => {
                "give the node a small scale instead of zero, or remove its instances".into()
            }
            Cause::TransformNotFinite | Cause::MatrixNotAffine { .. } | Cause::RotationZero => {
                "give the node a valid transform: finite numbers, a rotation of length 1".into()
            }
            Cause::NodeCycle { .. } | Cause::NodeWithTwoParents { .. } => {
                "the nodes of a glTF scene form trees; use one node a placement, which may share \
                 a mesh"
                    .into()
            }
            Cause::NodesTooDeep { .. } => "flatten the node hierarchy".into(),
            Cause::TooManyTriangles { .. } | Cause::TooManyPrimitives { .. } => {
                "primitive numbers have 32 bits; split the world into several scenes".into()
            }
            Cause::TooManyUniqueTriangles { .. } | Cause::TooManyInstances { .. } => {
                "raise the limit if this machine has the memory, or split the world into \
                 several scenes"
                    .into()
            }
            Cause::NoSuchAnimation { .. } => {
                "choose one of the file's animations by name or index, all of them, or none".into()
            }
            Cause::AnimationConflict { .. } => {
                "choose one of the two animations instead of all, or export them as one".into()
            }
            Cause::AnimatedMatrix { .. } => {
                "export the node with translation, rotation and scale instead of a matrix, or \
                 choose another animation, or none"
                    .into()
            }
            Cause::KeyTime { .. } | Cause::NoKeys { .. } | Cause::KeyValue { .. } => {
                "repair the animation and export it again, or choose another one, or none".into()
            }
            Cause::JointNotInScene { .. } => {
                "put the skeleton into the scene that shows the skinned mesh".into()
            }
            Cause::VertexJoint { .. } => {
                "a vertex follows joints of its skin, with weights that are finite and not \
                 negative; bind the mesh again and export it"
                    .into()
            }
            Cause::MotionError { .. } => "give a finite number of metres above 0".into(),
            Cause::TooManyStates { .. } => {
                "raise the motion error or the limit of states, or choose a shorter animation"
                    .into()
            }
            Cause::TooManySamples { .. } => {
                "raise the motion error, or choose a shorter or a slower animation".into()
            }
            Cause::TooManyMovingPositions { .. } => {
                "raise the motion error, which takes fewer key frames, or the limit if this \
                 machine has the memory"
                    .into()
            }
            Cause::PartMalformed { .. }
            | Cause::ExtensionMalformed { .. }
            | Cause::NoSuch { .. }
            | Cause::InvalidValue { .. }
            | Cause::BufferWithoutData { .. }
            | Cause::ViewOutOfBuffer { .. }
            | Cause::AccessorOutOfView { .. }
            | Cause::AccessorType { .. }
            | Cause::AccessorStride { .. }
            | Cause::AccessorTooLarge { .. }
            | Cause::SparseIndex { .. }
            | Cause::CountMismatch { .. }
            | Cause::IndexOutOfRange { .. } => {
                "the file breaks the glTF specification; report it to the maker of the exporter, \
                 with the report of the Khronos glTF validator"
                    .into()
            }
        };
        Some(text)
    }
}
