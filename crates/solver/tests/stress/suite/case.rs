//! A case: a scene, a segment, a grid of pixels; and the spaces that cases are made in.
//!
//! Scenes are built in *face space*: the segment runs from the origin along +x, a row plane is
//! y = w z, the camera plane is z = 0. A [`Pose`] puts face space into the world by the frame that
//! the solver itself will use, so that what is made to lie on a row plane lies there up to one
//! rounding; in an axis-aligned pose, with coarse coordinates, it lies there exactly.

use std::ops::Range;

use glam::{DAffine3, DMat3, DVec3};
use sightline_geometry::{
    FACE_COUNT, Instance, InstancedGeometry, Mesh, MeshId, ObjectId, PrimitiveId, RectifiedFrame,
    Sampling, SegmentId, ViewSegment,
};

use super::random::Random;

/// One input of the solver.
pub struct Case {
    pub geometry: InstancedGeometry,
    pub segment: ViewSegment,
    pub sampling: Sampling,
    /// Primitives that a closed mesh hides: none may be found.
    pub hidden: Range<u32>,
    /// True when a closed mesh is around the segment: every direction ends on it.
    pub surrounded: bool,
}

impl Case {
    pub fn pixels(&self) -> u64 {
        u64::from(self.sampling.rows()) * u64::from(self.sampling.columns()) * FACE_COUNT as u64
    }
}

/// The segment from `v0` to `v1`.
pub fn segment(v0: DVec3, v1: DVec3) -> ViewSegment {
    ViewSegment { id: SegmentId(0), v0, v1 }
}

/// Where face space lies in the world.
#[derive(Clone, Copy, Debug)]
pub struct Pose {
    pub world_from_face: DAffine3,
    pub segment: ViewSegment,
}

impl Pose {
    /// A segment of length `length` from `v0`, and the space of one of its faces.
    pub fn of(random: &mut Random, v0: DVec3, direction: DVec3, length: f64) -> Self {
        let segment = segment(v0, v0 + direction * length);
        let frame = RectifiedFrame::new(&segment).expect("the segment has a length");
        let face = frame.face(random.below(FACE_COUNT));
        let turn = DMat3::from_cols(face.axis, face.up, face.forward);
        Self { world_from_face: DAffine3::from_mat3_translation(turn, v0), segment }
    }

    /// Along a world axis, from a point with whole coordinates: nothing is rounded on the way
    /// into the world.
    pub fn aligned(random: &mut Random, length: f64) -> Self {
        let axes = [DVec3::X, DVec3::Y, DVec3::Z, -DVec3::X, -DVec3::Y, -DVec3::Z];
        let direction = random.pick(&axes);
        let mut next = || if random.one_in(2) { 0.0 } else { random.integer(-1000..=1000) };
        let v0 = DVec3::new(next(), next(), next());
        Self::of(random, v0, direction, length)
    }

    /// In any direction, from a point up to `reach` metres from the origin.
    pub fn free(random: &mut Random, length: f64, reach: f64) -> Self {
        let (v0, direction) = (random.in_cube(reach), random.direction());
        Self::of(random, v0, direction, length)
    }

    /// One of both.
    pub fn any(random: &mut Random, length: f64) -> Self {
        if random.one_in(2) {
            Self::aligned(random, length)
        } else {
            Self::free(random, length, 1e3)
        }
    }
}

/// Collects the bodies of a scene.
#[derive(Default)]
pub struct Scene {
    meshes: Vec<Mesh>,
    instances: Vec<Instance>,
    primitives: u32,
}

impl Scene {
    /// Adds a mesh in its own space, and returns the numbers of its primitives.
    pub fn add(
        &mut self,
        positions: &[DVec3],
        triangles: &[[u32; 3]],
        world_from_mesh: DAffine3,
        occluder: bool,
    ) -> Range<u32> {
        let stored = positions.iter().map(|p| p.as_vec3().to_array()).collect();
        let (mesh, _) = Mesh::new(stored, triangles);
        let first = self.primitives;
        self.primitives += mesh.triangles.len() as u32;
        let number = self.meshes.len() as u32;
        self.instances.push(Instance {
            mesh: MeshId(number),
            object: ObjectId(number),
            world_from_mesh,
            first_primitive: PrimitiveId(first),
            occluder,
            motion: None,
        });
        self.meshes.push(mesh);
        first..self.primitives
    }

    /// Adds triangles that share no vertices.
    pub fn add_soup(
        &mut self,
        corners: &[[DVec3; 3]],
        world_from_mesh: DAffine3,
        occluder: bool,
    ) -> Range<u32> {
        let triangles: Vec<[u32; 3]> =
            (0..corners.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        self.add(corners.as_flattened(), &triangles, world_from_mesh, occluder)
    }

    pub fn finish(self, segment: ViewSegment, sampling: Sampling) -> Case {
        let geometry = InstancedGeometry::new(self.meshes, self.instances);
        Case { geometry, segment, sampling, hidden: 0..0, surrounded: false }
    }
}

/// A small grid of pixels, often with its rays off the centres.
pub fn small_sampling(random: &mut Random) -> Sampling {
    let (rows, columns) =
        random.pick(&[(4, 4), (4, 8), (8, 8), (8, 16), (16, 16), (16, 4), (4, 32)]);
    let sampling = Sampling::with_columns(rows, columns);
    if random.one_in(2) { sampling } else { sampling.jittered(random.below(1000) as u32) }
}

/// A small grid whose rows and columns are short binary fractions.
pub fn coarse_sampling(random: &mut Random) -> Sampling {
    let (rows, columns) = random.pick(&[(4, 4), (4, 8), (8, 8), (8, 16), (16, 16), (16, 4)]);
    Sampling::with_columns(rows, columns)
}
