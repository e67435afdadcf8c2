//! A scene in memory: numbered geometry, and where each number comes from in the file.
//!
//! Invariants:
//! - objects of triangles are in the order of [`crate::morton`] numbering, those of particles follow in
//!   the order of their tables, and their primitives are contiguous:
//!   `objects[i].primitives.end == objects[i + 1].primitives.start`;
//! - every object has at least one primitive;
//! - `meshes` is parallel to `geometry.meshes`, `instances` to `geometry.instances`, `particles` to
//!   `geometry.particles`;
//! - every mesh has at least one triangle and one instance, and only vertices that a triangle
//!   uses, in the order in which the hierarchy's triangles use them;
//! - key times ascend, and there is one more than there are states; a scene at rest has one, and one
//!   state;
//! - what has a value a key frame is not the same at all of them.

use std::{
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
};

use sightline_geometry::{Array, Bounds, Bounds32, InstancedGeometry, Moment, ObjectId, Residency};

use crate::{
    IngestReport, Keeper, MemoryLimit, ParticleSource, SceneDigest, SceneError, gltf_reader,
    memory, particles,
};

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
    /// Particle tables (`.parquet`, `.csv`) that belong to the scene; see `schemas/particles-v1.md`.
    /// Each becomes an object, named as its file without extension.
    pub particles: Vec<PathBuf>,
    /// Refuse scenes whose particle tables have more spheres than this: particles times key
    /// frames, all tables together. A sphere takes 16 bytes.
    pub max_spheres: u64,
    /// Which animation moves the scene.
    pub animation: AnimationChoice,
    /// Between two key frames every vertex moves linearly; no vertex is then farther than this from
    /// where the animation puts it, at any time but within the short states of jumps. Metres, above
    /// 0.
    pub motion_error: f64,
    /// Refuse animations that need more states than this.
    pub max_states: u32,
    /// Refuse scenes that would keep more positions of moving things than this: vertices that move
    /// on their own and corners of the boxes of moving instances, once a key frame. A position takes
    /// 12 bytes.
    pub max_moving_positions: u64,
    /// How much memory the process may take; everything is in memory when absent. See
    /// [`MemoryLimit`].
    pub memory: Option<MemoryLimit>,
}

impl Default for OpenOptions {
    /// No see-through patterns, 2^28 unique triangles, 2^24 instances; no tables, 2^28 spheres; the
    /// first animation within 0.01 m, 4096 states, 2^28 moving positions.
    fn default() -> Self {
        Self {
            see_through: Vec::new(),
            max_unique_triangles: 1 << 28,
            max_instances: 1 << 24,
            particles: Vec::new(),
            max_spheres: 1 << 28,
            animation: AnimationChoice::First,
            motion_error: 0.01,
            max_states: 4096,
            max_moving_positions: 1 << 28,
            memory: None,
        }
    }
}

/// Which of a file's animations moves the scene. After its last key a channel holds its value, and so
/// it does before its first.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum AnimationChoice {
    /// The first one; none where the file has none.
    #[default]
    First,
    /// None: the scene is at rest, in the pose of its nodes.
    None,
    /// All of them, started together. Two that move the same property of a node are refused.
    All,
    /// The one with this index into `animations`.
    Index(u32),
    /// The first one with this name.
    Name(String),
}

impl AnimationChoice {
    /// The choice that a configuration writes as text: `all`, `none`, an index or a name; the first
    /// animation where there is none.
    #[must_use]
    pub fn of_text(text: Option<&str>) -> Self {
        match text {
            None => Self::First,
            Some("all") => Self::All,
            Some("none") => Self::None,
            Some(text) => match text.parse() {
                Ok(index) => Self::Index(index),
                Err(_) => Self::Name(text.to_owned()),
            },
        }
    }
}

impl OpenOptions {
    /// How the scene at `path` is read for a bake that says this of it: coordinators, workers and who
    /// reads the dataset do the same. Particle tables lie relative to the scene.
    #[must_use]
    pub fn of_bake(
        path: &Path,
        see_through: &[String],
        particles: &[String],
        animation: Option<&str>,
        motion_error: f64,
    ) -> Self {
        let folder = path.parent().unwrap_or(Path::new(""));
        Self {
            see_through: see_through.to_vec(),
            particles: particles.iter().map(|table| folder.join(table)).collect(),
            animation: AnimationChoice::of_text(animation),
            motion_error,
            ..Self::default()
        }
    }
}

/// What the author named: a node with at least one triangle, or a particle table.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Its number: the index into [`Scene::objects`].
    pub id: ObjectId,
    /// Name of the node, else of its mesh, else `#` and the node index; of a table, its file name
    /// without extension.
    pub name: String,
    /// Node names from the root down, joined by `/`; nodes without a name as `#` and their
    /// index. Paths of more than 4096 bytes lose their beginning. The name again for a table.
    pub path: String,
    /// Index into the `nodes` of the file; [`particles::NO_NODE`] for a table.
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
    pub triangles: Array<u32>,
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
    /// True when an animation or a skin may place it, so that the nodes of the file and their weights
    /// alone do not say where it is.
    pub posed: bool,
    /// True when the material shows the back of its triangles: seeing a back does not mean
    /// being inside.
    pub double_sided: bool,
}

/// A scene, read and numbered.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Triangles, instances, particles and hierarchies.
    pub geometry: InstancedGeometry,
    /// Objects in the order of their numbers.
    pub objects: Vec<Object>,
    /// Parallel to the meshes of `geometry`.
    pub meshes: Vec<MeshSource>,
    /// Parallel to the instances of `geometry`.
    pub instances: Vec<InstanceSource>,
    /// Parallel to the particle systems of `geometry`.
    pub particles: Vec<ParticleSource>,
    /// Times of the key frames, seconds, ascending; those of an animation start at 0. One more than
    /// the geometry has states; a single one for a scene at rest, which has one state.
    pub key_times: Vec<f64>,
    /// What reading found.
    pub report: IngestReport,
    /// Hashes of the files.
    pub digest: SceneDigest,
    /// Who keeps the process within its memory, where there is a limit.
    pub memory: Option<Arc<Keeper>>,
}

impl Scene {
    /// Reads a `.gltf` or `.glb` file: the default scene, moved by the animation that the options
    /// choose; or a `.parquet` or `.csv` table of particles. The tables of the options are added.
    ///
    /// # Errors
    /// When a file cannot be read, breaks a rule of its format that the geometry depends on, or is
    /// too large; see [`crate::Cause`].
    pub fn open(path: &Path, options: &OpenOptions) -> Result<Self, SceneError> {
        Self::kept(options, |keeper| {
            if particles::is_table(path) {
                particles::read_scene(path, options)
            } else {
                gltf_reader::read(path, options, keeper)
            }
        })
        .map_err(|e| e.in_file(path))
    }

    /// Reads a scene within the memory that the options allow.
    fn kept(
        options: &OpenOptions,
        read: impl FnOnce(Option<&Arc<Keeper>>) -> Result<Self, SceneError>,
    ) -> Result<Self, SceneError> {
        let keeper = memory::keeper(options.memory.as_ref())?;
        let mut scene = read(keeper.as_ref())?;
        if let Some(keeper) = keeper {
            keeper.expect_room(0)?;
            scene.geometry.residency = Some(Arc::clone(&keeper) as Arc<dyn Residency>);
            scene.memory = Some(keeper);
        }
        Ok(scene)
    }

    /// As [`Scene::open`], with the content of the main file in `main`; external buffers are
    /// looked for beside `path`.
    ///
    /// # Errors
    /// As [`Scene::open`].
    pub fn open_bytes(path: &Path, main: &[u8], options: &OpenOptions) -> Result<Self, SceneError> {
        Self::kept(options, |keeper| {
            if particles::is_table(path) {
                particles::read_scene_bytes(path, main, options)
            } else {
                gltf_reader::read_bytes(path, main, options, keeper)
            }
        })
        .map_err(|e| e.in_file(path))
    }

    /// The moment at a time in seconds; times before the first key frame are taken for it, times
    /// after the last one for that. A key frame is the beginning of the state that it starts.
    #[must_use]
    pub fn moment_at(&self, seconds: f64) -> Moment {
        let times = &self.key_times;
        if times.len() < 2 || seconds.is_nan() || seconds <= times[0] {
            return Moment::START;
        }
        let state = times.partition_point(|&t| t <= seconds).min(times.len() - 1) - 1;
        let (from, to) = (times[state], times[state + 1]);
        Moment { state: state as u32, t: ((seconds - from) / (to - from)).min(1.0) }
    }

    /// The time of a moment, seconds.
    #[must_use]
    pub fn time_of(&self, moment: Moment) -> f64 {
        let (from, to) = sightline_geometry::motion::around(&self.key_times, moment.state);
        (1.0 - moment.t) * from + moment.t * to
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
            assert!(!object.primitives.is_empty(), "objects have primitives");
            assert!(!object.bounds.is_empty());
            next = object.primitives.end;
        }
        assert_eq!(next, g.primitive_count());
        self.assert_particles_well_formed();
        let mut placed = vec![false; g.meshes.len()];
        for instance in &g.instances {
            placed[instance.mesh.index()] = true;
            let object = &self.objects[instance.object.index()];
            assert!(object.primitives.contains(&instance.first_primitive.0));
            assert!(object.occluder || !instance.occluder);
        }
        assert!(placed.iter().all(|&p| p), "every mesh is placed");
        self.assert_motion_is_well_formed();
        for (mesh, source) in g.meshes.iter().zip(&self.meshes) {
            assert_eq!(mesh.triangles.len(), source.triangles.len());
            assert!(!mesh.triangles.is_empty());
            let mut next = 0;
            for &v in mesh.triangles.as_flattened() {
                assert!(v <= next, "vertices are in order of first use");
                next = next.max(v + 1);
            }
            assert_eq!(next as usize, mesh.positions.len(), "every vertex is used");
            let box_of = |positions: &[[f32; 3]], t: usize| {
                Bounds32::of_points(mesh.triangles[t].map(|v| positions[v as usize]))
            };
            let count = mesh.triangles.len();
            match &mesh.motion {
                None => {
                    let boxes: Vec<_> = (0..count).map(|t| box_of(&mesh.positions, t)).collect();
                    mesh.hierarchy.assert_well_formed(&boxes);
                }
                Some(motion) => {
                    assert!(mesh.hierarchy.nodes.is_empty(), "one hierarchy a mesh");
                    let box_of = |t: usize, key: usize| box_of(&motion.keys[key], t);
                    motion.hierarchy.assert_well_formed(count, box_of);
                }
            }
        }
    }

    fn assert_motion_is_well_formed(&self) {
        let (g, times) = (&self.geometry, &self.key_times);
        assert!(times.windows(2).all(|pair| pair[0] < pair[1]), "key times ascend");
        let keys = g.states as usize + 1;
        if times.len() == 1 {
            assert!(g.states == 1 && !g.has_motion(), "one key frame is of a scene at rest");
        } else {
            assert_eq!(times.len(), keys, "key frames and states");
            assert!(g.has_motion(), "a scene of several key frames moves");
        }
        for maps in g.instances.iter().filter_map(|i| Some((i, i.motion.as_deref()?))) {
            let (instance, maps) = maps;
            assert_eq!(maps.len(), keys);
            assert_eq!(maps[0], instance.world_from_mesh, "at the first key frame");
            assert!(maps.iter().all(|m| m.is_finite()));
        }
        for (mesh, motion) in g.meshes.iter().filter_map(|m| Some((m, m.motion.as_ref()?))) {
            assert_eq!(motion.keys.len(), keys);
            assert_eq!(motion.keys[0], *mesh.positions, "at the first key frame");
            let same = |key: &Vec<[f32; 3]>| key.len() == mesh.positions.len();
            assert!(motion.keys.iter().all(same), "every vertex has a place a key frame");
            assert!(motion.moves.contains(&true), "what does not move has one value");
        }
    }

    fn assert_particles_well_formed(&self) {
        let g = &self.geometry;
        assert_eq!(self.particles.len(), g.particles.len());
        let behind = self.objects.len() - self.particles.len();
        for ((system, source), object) in
            g.particles.iter().zip(&self.particles).zip(&self.objects[behind..])
        {
            assert_eq!(system.object, object.id);
            assert_eq!(system.first_primitive.0, object.primitives.start);
            assert_eq!(system.len(), object.primitives.len());
            assert_eq!(system.occluder, object.occluder);
            assert_eq!(object.node, particles::NO_NODE);
            let mut ids = source.ids.clone();
            ids.sort_unstable();
            assert!(ids.is_sorted_by(|a, b| a < b), "a particle has one number");
            assert_eq!(ids.len(), system.len());
            let box_of = |i: usize, key: usize| system.keys[key][i].bounds();
            system.hierarchy.assert_well_formed(system.len(), box_of);
            let spheres = || system.keys.iter().flatten().filter(|s| s.is_present());
            assert!(spheres().all(|s| s.radius > 0.0 && s.center().is_finite()));
            assert!(spheres().next().is_some(), "a table has a sphere");
        }
    }
}
