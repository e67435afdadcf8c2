//! A scene in memory: numbered geometry, and where each number comes from in the file.
//!
//! Invariants:
//! - objects are in the order of [`crate::morton`] numbering, and their primitives are
//!   contiguous: `objects[i].primitives.end == objects[i + 1].primitives.start`;
//! - every object has at least one triangle;
//! - `meshes` is parallel to `geometry.meshes`, `instances` to `geometry.instances`;
//! - every mesh has at least one triangle and one instance, and only vertices that a triangle
//!   uses, in the order in which the hierarchy's triangles use them.

use std::{ops::Range, path::Path};

use sightline_geometry::{Bounds, InstancedGeometry, ObjectId};

use crate::{IngestReport, SceneDigest, SceneError, gltf_reader};

/// How a scene is to be read.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct OpenOptions {
    /// Glob patterns. Objects whose name or path matches one hide nothing. `*` also matches `/`;
    /// case matters.
    pub see_through: Vec<String>,
    /// Refuse scenes with more triangles in memory than this. A triangle takes about 60 bytes.
    pub max_unique_triangles: u64,
    /// Refuse scenes with more instances than this. An instance takes about 300 bytes.
    pub max_instances: u64,
}

impl Default for OpenOptions {
    /// No see-through patterns, 2^28 unique triangles, 2^24 instances.
    fn default() -> Self {
        Self { see_through: Vec::new(), max_unique_triangles: 1 << 28, max_instances: 1 << 24 }
    }
}

/// What the author named: a node with at least one triangle.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Its number: the index into [`Scene::objects`].
    pub id: ObjectId,
    /// Name of the node, else of its mesh, else `#` and the node index.
    pub name: String,
    /// Node names from the root down, joined by `/`; nodes without a name as `#` and their
    /// index. Paths of more than 4096 bytes lose their beginning.
    pub path: String,
    /// Index into the `nodes` of the file.
    pub node: u32,
    /// Global numbers of its primitives.
    pub primitives: Range<u32>,
    /// True when at least one of its primitives can hide something.
    pub occluder: bool,
    /// World box, metres.
    pub bounds: Bounds,
}

/// Where a mesh of the geometry comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MeshSource {
    /// Index into the `meshes` of the file; the lowest when glTF meshes share their accessors.
    pub mesh: u32,
    /// Index into the `primitives` of that mesh.
    pub primitive: u32,
    /// Our number of a triangle in the mesh to its number in the glTF primitive, where the
    /// triangles of strips and fans are counted in order, and degenerate ones count.
    pub triangles: Vec<u32>,
}

/// Where an instance of the geometry comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InstanceSource {
    /// Index into the `nodes` of the file.
    pub node: u32,
    /// Number within the node's EXT_mesh_gpu_instancing.
    pub gpu_instance: Option<u32>,
    /// Index into the `primitives` of the node's mesh.
    pub primitive: u32,
    /// True when the material shows the back of its triangles: seeing a back does not mean
    /// being inside.
    pub double_sided: bool,
}

/// A scene, read and numbered.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Triangles, instances and hierarchies.
    pub geometry: InstancedGeometry,
    /// Objects in the order of their numbers.
    pub objects: Vec<Object>,
    /// Parallel to the meshes of `geometry`.
    pub meshes: Vec<MeshSource>,
    /// Parallel to the instances of `geometry`.
    pub instances: Vec<InstanceSource>,
    /// What reading found.
    pub report: IngestReport,
    /// Hashes of the files.
    pub digest: SceneDigest,
}

impl Scene {
    /// Reads a `.gltf` or `.glb` file: the default scene, at rest.
    ///
    /// # Errors
    /// When the file cannot be read, breaks a rule of glTF that its triangles depend on, or is
    /// too large; see [`crate::Cause`].
    pub fn open(path: &Path, options: &OpenOptions) -> Result<Self, SceneError> {
        gltf_reader::read(path, options).map_err(|e| e.in_file(path))
    }

    /// As [`Scene::open`], with the content of the main file in `main`; external buffers are
    /// looked for beside `path`.
    ///
    /// # Errors
    /// As [`Scene::open`].
    pub fn open_bytes(path: &Path, main: &[u8], options: &OpenOptions) -> Result<Self, SceneError> {
        gltf_reader::read_bytes(path, main, options).map_err(|e| e.in_file(path))
    }

    /// Panics when an invariant of the module does not hold.
    pub fn assert_well_formed(&self) {
        let g = &self.geometry;
        assert_eq!(self.meshes.len(), g.meshes.len());
        assert_eq!(self.instances.len(), g.instances.len());
        let mut next = 0;
        for (i, object) in self.objects.iter().enumerate() {
            assert_eq!(object.id.index(), i);
            assert_eq!(object.primitives.start, next, "objects are contiguous");
            assert!(!object.primitives.is_empty(), "objects have triangles");
            assert!(!object.bounds.is_empty());
            next = object.primitives.end;
        }
        assert_eq!(next, g.primitive_count());
        let mut placed = vec![false; g.meshes.len()];
        for instance in &g.instances {
            placed[instance.mesh.index()] = true;
            let object = &self.objects[instance.object.index()];
            assert!(object.primitives.contains(&instance.first_primitive.0));
            assert!(object.occluder || !instance.occluder);
        }
        assert!(placed.iter().all(|&p| p), "every mesh is placed");
        for (mesh, source) in g.meshes.iter().zip(&self.meshes) {
            assert_eq!(mesh.triangles.len(), source.triangles.len());
            assert!(!mesh.triangles.is_empty());
            let mut next = 0;
            for &v in mesh.triangles.as_flattened() {
                assert!(v <= next, "vertices are in order of first use");
                next = next.max(v + 1);
            }
            assert_eq!(next as usize, mesh.positions.len(), "every vertex is used");
            let boxes: Vec<_> = mesh
                .triangles
                .iter()
                .map(|t| {
                    sightline_geometry::Bounds32::of_points(t.map(|v| mesh.positions[v as usize]))
                })
                .collect();
            mesh.hierarchy.assert_well_formed(&boxes);
        }
    }
}
