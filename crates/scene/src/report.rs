//! What reading a scene found: counts, what was left out, and what deserves a look.

use serde::Serialize;
use sightline_geometry::ParticleSystem;

/// Degenerate triangles that are listed for one glTF primitive; the count is complete.
pub(crate) const LISTED_DEGENERATE_TRIANGLES: usize = 64;

/// Degenerate triangles of one glTF primitive.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct DegenerateTriangles {
    /// Index into the `meshes` of the file.
    pub mesh: u32,
    /// Index into the mesh's `primitives`.
    pub primitive: u32,
    /// How many there are.
    pub count: u64,
    /// Their triangle numbers in the glTF primitive, ascending; at most the first 64.
    pub triangles: Vec<u32>,
}

/// glTF primitives that hold no triangles. Each is counted once however often it is placed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct SkippedPrimitives {
    /// Primitives of mode POINTS.
    pub points: u64,
    /// Primitives of mode LINES, LINE_LOOP or LINE_STRIP.
    pub lines: u64,
    /// Triangle primitives without positions.
    pub without_positions: u64,
}

/// Channels of the animation that were not followed, for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct IgnoredChannels {
    /// Why.
    pub reason: String,
    /// How many there are.
    pub count: u64,
    /// Which is the first: animation, channel and what it moves.
    pub first: String,
}

/// What reading a scene found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct IngestReport {
    /// The tool that wrote the file, as it states.
    pub generator: Option<String>,
    /// The copyright notice in the file.
    pub copyright: Option<String>,
    /// Triangles in memory, without degenerate ones.
    pub unique_triangles: u64,
    /// Triangles with every instance counted: the number of primitives but particles.
    pub instanced_triangles: u64,
    /// Vertices in memory: those that a triangle uses.
    pub unique_vertices: u64,
    /// Objects: nodes with at least one triangle, and particle tables.
    pub objects: u64,
    /// Bodies of triangles in memory.
    pub meshes: u64,
    /// Placements of them.
    pub instances: u64,
    /// Particles of all tables.
    pub particles: u64,
    /// Particles that hide nothing.
    pub see_through_particles: u64,
    /// Instanced triangles that hide nothing.
    pub see_through_triangles: u64,
    /// Triangles of zero area that were dropped, in all meshes in memory.
    pub degenerate_triangles: u64,
    /// Where they are, by glTF mesh and primitive.
    pub degenerate: Vec<DegenerateTriangles>,
    /// Primitives that hold no triangles.
    pub skipped: SkippedPrimitives,
    /// Nodes with a mesh that are switched off by KHR_node_visibility, or lie below such a node.
    pub hidden_nodes: u64,
    /// True when the file animates anything, whether or not the scene is read in motion.
    pub animated: bool,
    /// Number of animations in the file.
    pub animations: u64,
    /// Their names; `#` and the index for those without.
    pub animation_names: Vec<String>,
    /// Names of those that move the scene.
    pub animations_taken: Vec<String>,
    /// The time of their last key, seconds.
    pub duration_s: f64,
    /// Number of states: 1 at rest.
    pub states: u64,
    /// Objects with something that moves.
    pub moving_objects: u64,
    /// Instanced triangles that move.
    pub moving_triangles: u64,
    /// Channels that were not followed.
    pub ignored_channels: Vec<IgnoredChannels>,
    /// Times at which something jumps. A jump is a state of its own, of a millisecond.
    pub jumps: u64,
    /// Objects with a skin.
    pub skinned_objects: u64,
    /// Instances that a scale of zero flattens; their triangles were flattened one by one.
    pub flattened_instances: u64,
    /// Extensions that the file uses, as it states.
    pub used_extensions: Vec<String>,
    /// Those of them that were ignored: they do not change triangles.
    pub ignored_extensions: Vec<String>,
    /// What deserves a look, one sentence each.
    pub warnings: Vec<String>,
}

impl IngestReport {
    /// Fills in the counts of particles.
    pub(crate) fn count_particles(&mut self, systems: &[ParticleSystem]) {
        let count = |occluder: bool| {
            systems.iter().filter(|s| s.occluder == occluder).map(|s| s.len() as u64).sum::<u64>()
        };
        self.see_through_particles = count(false);
        self.particles = self.see_through_particles + count(true);
    }
}
