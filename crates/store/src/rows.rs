//! The rows that writers take and readers give. Plain data; the tables are in [`crate::tables`].
//!
//! What a cell or a segment sees changes with the state where something moves. A row says what is seen
//! in a *run* of consecutive states with equal sets, `first_state..=last_state`. A cell that has several
//! runs has a row of their union beside them.

use std::cmp::Reverse;
use std::ops::Range;

use sightline_geometry::{
    Array, Bounds, CellId, MeshId, ObjectId, PrimitiveId, PrimitiveSet, SegmentId, ViewCell,
};

use crate::Weight;

/// What one view segment sees in a run of states.
#[derive(Clone, Debug, PartialEq)]
pub struct SegmentRow {
    /// The segment's number in the plan.
    pub segment: SegmentId,
    /// First state of the run; 0 in scenes at rest.
    pub first_state: u32,
    /// Last state of the run; 0 in scenes at rest.
    pub last_state: u32,
    /// The visible primitives.
    pub set: PrimitiveSet,
    /// One weight a member, in ascending order of the members: the share of (solid angle x
    /// segment) on which the member is nearest, in [0, 1].
    pub weights: Vec<f32>,
    /// Rays along which it was solved.
    pub rays: u64,
    /// Moving objects and particles in states in which they were not looked at, as a volume that holds
    /// them was hidden: a sum over the tiles of the solve.
    pub skipped_movers: u64,
}

impl SegmentRow {
    /// The states of the run.
    #[must_use]
    pub const fn states(&self) -> Range<u32> {
        self.first_state..self.last_state + 1
    }
}

/// What one view cell sees in a run of states or in any state, and how well that was established.
#[derive(Clone, Debug, PartialEq)]
pub struct CellRow {
    /// The cell.
    pub cell: ViewCell,
    /// Tile of the view region, (x, z).
    pub tile: [i32; 2],
    /// First state of the row; 0 in scenes at rest.
    pub first_state: u32,
    /// Last state of the row; 0 in scenes at rest.
    pub last_state: u32,
    /// The visible primitives.
    pub set: PrimitiveSet,
    /// One weight a member, in ascending order of the members: the mean over the states of the row, by
    /// duration, and over the cell's segments, by length, of the share of (solid angle x segment) on
    /// which the member is nearest.
    pub weights: Vec<Weight>,
    /// What was solved, and what was measured.
    pub effort: CellEffort,
}

/// What a cell took, in counts that are the same on every machine, and the error that was left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CellEffort {
    /// Segments that were solved for the cell, those of the plan included.
    pub segments: u32,
    /// Of these, runs along the whole perimeter; the plan's are one.
    pub runs: u32,
    /// Of these, lines through viewpoints where a pocket was found.
    pub lines: u32,
    /// Rows of a face of the finest run's first pass.
    pub rows: u32,
    /// Rays along which the segments were solved, finer ones included. A shared segment counts for
    /// each of its cells.
    pub solver_rays: u64,
    /// Moving objects and particles in states in which they were not looked at, as a volume that holds
    /// them was hidden: a sum over the tiles of all segments.
    pub skipped_movers: u64,
    /// Refinement rounds that were run.
    pub refinements: u32,
    /// Viewpoints of the last measurement, which the errors are from.
    pub heldout_viewpoints: u32,
    /// All rays that were cast from held-out viewpoints, in all rounds.
    pub heldout_rays: u64,
    /// Mean pixel error over the viewpoints of the cell, as measured, share of pixels.
    pub heldout_error_mean: f64,
    /// Upper end of the one-sided 95 % confidence interval of that mean.
    pub heldout_error_upper: f64,
    /// Pixel error of the worst viewpoint that was measured in full, share of pixels.
    pub heldout_error_max: f64,
    /// True when the error aimed at was met.
    pub target_met: bool,
}

impl Default for CellEffort {
    /// Nothing solved, nothing known.
    fn default() -> Self {
        Self {
            segments: 0,
            runs: 0,
            lines: 0,
            rows: 0,
            solver_rays: 0,
            skipped_movers: 0,
            refinements: 0,
            heldout_viewpoints: 0,
            heldout_rays: 0,
            heldout_error_mean: 0.0,
            heldout_error_upper: 1.0,
            heldout_error_max: 0.0,
            target_met: false,
        }
    }
}

/// Where a row stands in a table of cells: by cell, the longest first, then by time. So the union of all
/// states comes before the runs.
pub type RowOrder = (CellId, Reverse<u32>, u32);

/// See [`RowOrder`].
pub(crate) const fn row_order(cell: CellId, states: &Range<u32>) -> RowOrder {
    (cell, Reverse(states.end - states.start), states.start)
}

impl CellRow {
    /// The states of the row.
    #[must_use]
    pub const fn states(&self) -> Range<u32> {
        self.first_state..self.last_state + 1
    }

    /// Where the row stands in a table: rows are written in this order.
    #[must_use]
    pub const fn order(&self) -> RowOrder {
        row_order(self.cell.id, &self.states())
    }

    /// The members with their weights, the most important first; among equal weights the lower
    /// primitive number. Members without a measured weight come last.
    #[must_use]
    pub fn by_importance(&self) -> Vec<(PrimitiveId, Weight)> {
        let mut members: Vec<_> = self.set.iter().zip(self.weights.iter().copied()).collect();
        // A stable sort keeps ascending numbers.
        members.sort_by_key(|(_, weight)| std::cmp::Reverse(*weight));
        members
    }

    /// The `budget` most important members as a set; all of them when there are no more.
    #[must_use]
    pub fn most_important(&self, budget: usize) -> PrimitiveSet {
        let mut kept: Vec<u32> =
            self.by_importance().into_iter().take(budget).map(|(p, _)| p.0).collect();
        kept.sort_unstable();
        PrimitiveSet::from_sorted(kept)
    }
}

/// How much of one object a cell sees, in any state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ObjectRow {
    /// The cell.
    pub cell: CellId,
    /// The object, of which at least one primitive is visible.
    pub object: ObjectId,
    /// Visible primitives of the object.
    pub visible_primitives: u32,
    /// All primitives of the object.
    pub total_primitives: u32,
    /// Share of (solid angle x segments) on which a primitive of the object is nearest, in [0, 1].
    pub weight: f64,
    /// First state in which the object is visible; 0 in static scenes.
    pub first_state: u32,
    /// Last state in which the object is visible; 0 in static scenes.
    pub last_state: u32,
}

/// An object of the scene. Objects are numbered from 0 in the order of their primitives.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneObject {
    /// The object's number.
    pub id: ObjectId,
    /// The name its author gave it; may be empty, need not be unique.
    pub name: String,
    /// Names from the root of the scene to the object, joined by `/`.
    pub path: String,
    /// Number of its glTF node.
    pub node: u32,
    /// First primitive.
    pub first_primitive: u32,
    /// First primitive behind the object.
    pub end_primitive: u32,
    /// True when the object hides what is behind it; false for see-through objects.
    pub occluder: bool,
    /// World box, metres.
    pub bounds: Bounds,
}

/// An instance of a mesh: a run of primitive numbers. Together with [`NumberedMesh`] it leads from
/// a primitive number to a triangle of the glTF file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NumberedInstance {
    /// Global number of its first triangle.
    pub first_primitive: u32,
    /// The object it belongs to.
    pub object: ObjectId,
    /// Number of its glTF node.
    pub node: u32,
    /// Number within the node's `EXT_mesh_gpu_instancing`, where the node has it.
    pub gpu_instance: Option<u32>,
    /// The mesh whose triangles it repeats.
    pub mesh: MeshId,
}

/// A body of triangles: one glTF primitive, its triangles in Sightline's order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NumberedMesh {
    /// The mesh's number.
    pub id: MeshId,
    /// Number of the glTF mesh.
    pub gltf_mesh: u32,
    /// Number of the primitive within the glTF mesh.
    pub gltf_primitive: u32,
    /// For each triangle in Sightline's order, its number in the glTF primitive.
    pub triangles: Array<u32>,
}

/// From primitive numbers to the triangles of the glTF file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Numbering {
    /// Instances, ascending by first primitive, without gaps.
    pub instances: Vec<NumberedInstance>,
    /// Meshes, by number from 0.
    pub meshes: Vec<NumberedMesh>,
}

/// Where a triangle is found in the glTF file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GltfTriangle {
    /// The instance, with its node.
    pub instance: NumberedInstance,
    /// Number of the glTF mesh.
    pub gltf_mesh: u32,
    /// Number of the primitive within the glTF mesh.
    pub gltf_primitive: u32,
    /// Number of the triangle within the glTF primitive.
    pub triangle: u32,
}

impl Numbering {
    /// The glTF triangle of a global primitive number; `None` behind the last primitive.
    #[must_use]
    pub fn locate(&self, primitive: PrimitiveId) -> Option<GltfTriangle> {
        let after = self.instances.partition_point(|i| i.first_primitive <= primitive.0);
        let instance = *self.instances.get(after.checked_sub(1)?)?;
        let mesh = self.meshes.get(instance.mesh.index())?;
        let in_mesh = (primitive.0 - instance.first_primitive) as usize;
        Some(GltfTriangle {
            instance,
            gltf_mesh: mesh.gltf_mesh,
            gltf_primitive: mesh.gltf_primitive,
            triangle: *mesh.triangles.get(in_mesh)?,
        })
    }

    /// Checks the numbering against the number of primitives of the scene.
    ///
    /// # Errors
    /// The broken rule.
    pub fn check(&self, primitives: u64) -> Result<(), String> {
        if let Some((k, mesh)) =
            self.meshes.iter().enumerate().find(|(k, mesh)| mesh.id.index() != *k)
        {
            return Err(format!("mesh {} stands at place {k}", mesh.id));
        }
        let mut next = 0_u64;
        for instance in &self.instances {
            let Some(mesh) = self.meshes.get(instance.mesh.index()) else {
                return Err(format!("there is no mesh {}", instance.mesh));
            };
            if u64::from(instance.first_primitive) != next {
                let first = instance.first_primitive;
                return Err(format!("an instance starts at primitive {first} instead of {next}"));
            }
            next += mesh.triangles.len() as u64;
        }
        if next != primitives {
            return Err(format!("instances hold {next} primitives and objects {primitives}"));
        }
        Ok(())
    }
}

/// What the index says of a cell's row: everything but its set, and where that is.
#[derive(Clone, Debug, PartialEq)]
pub struct CellEntry {
    /// The cell.
    pub cell: ViewCell,
    /// Tile of the view region, (x, z).
    pub tile: [i32; 2],
    /// First state of the row; 0 in scenes at rest.
    pub first_state: u32,
    /// Last state of the row; 0 in scenes at rest.
    pub last_state: u32,
    /// Number of visible primitives.
    pub primitives: u32,
    /// Where the cell's row lies.
    pub set: SetLocation,
    /// Where the cell's (cell, object) rows lie.
    pub objects: ObjectsLocation,
}

impl CellEntry {
    /// The states of the row.
    #[must_use]
    pub const fn states(&self) -> Range<u32> {
        self.first_state..self.last_state + 1
    }

    /// Where the row stands in a table.
    pub(crate) const fn order(&self) -> RowOrder {
        row_order(self.cell.id, &self.states())
    }
}

/// Where a cell's row, and the page with its set, lie.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SetLocation {
    /// Key of the cells file.
    pub file: String,
    /// Row group in the file.
    pub row_group: u32,
    /// Row in the row group.
    pub row: u32,
    /// Offset in the file of the data page that holds the set, bytes.
    pub page_offset: u32,
    /// Size of that page with its header, bytes.
    pub page_bytes: u32,
    /// Place of the set among the values of that page.
    pub page_row: u32,
    /// Offset in the file of the data page that holds the weights, bytes; 0 in datasets of
    /// version 1, which have none.
    pub weights_offset: u32,
    /// Size of that page with its header, bytes.
    pub weights_bytes: u32,
}

/// Where a cell's (cell, object) rows lie.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ObjectsLocation {
    /// Key of the objects file.
    pub file: String,
    /// First row in the file.
    pub first_row: u32,
    /// Number of rows.
    pub rows: u32,
}
