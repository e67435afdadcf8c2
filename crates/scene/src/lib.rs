//! Scenes: glTF files and particle tables to validated, numbered geometry.
//!
//! [`Scene::open`] reads a `.gltf` or `.glb` file, or a table of particles (`.parquet`, `.csv`), into
//! [`sightline_geometry::InstancedGeometry`] with a primitive numbering that is a function of the
//! file alone, or refuses it with a [`SceneError`] that names the cause. Memory follows unique
//! triangles, not instances, and particles times key frames.

mod content;
mod degenerate;
mod digest;
mod error;
pub mod export;
pub mod generate;
mod gltf_reader;
mod memory;
mod numbering;
pub mod particles;
pub mod region;
mod report;
mod scene;

pub use content::{Edit, ObjectHash, Same, SceneContent};
pub use digest::{FileDigest, SceneDigest, digest, digest_with, external_buffers};
pub use error::{Cause, Place, SceneError, UriProblem};
pub use memory::{Held, Keeper, MemoryLimit, default_folder};
pub use numbering::morton;
pub use particles::{ParticleSource, TableProblem};
pub use report::{DegenerateTriangles, IgnoredChannels, IngestReport, SkippedPrimitives};
pub use scene::{AnimationChoice, InstanceSource, MeshSource, Object, OpenOptions, Scene};
