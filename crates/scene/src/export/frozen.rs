//! What an animation or a skin places, frozen at a moment: positions of its own.
//!
//! A root of the output shows it with a translation alone, so that `f32` positions are exact enough
//! far from the world's origin, and a scale of -1 where the transform mirrors: viewers turn the winding
//! order of such nodes around, and positions alone would not tell them.
//!
//! Directions under a linear map A: tangents become A t, normals the inverse transpose of A times n.
//! What bends has no one map; its normals are left out, and viewers take those of its triangles.

use std::collections::BTreeMap;

use glam::{DMat3, DVec3};
use sightline_geometry::{Instance, Mesh, Moment, motion::lerp};

use super::Warnings;
use super::source::{Elements, Shape};
use super::subset::Part;
use crate::Scene;

/// Where a root stands.
#[derive(Clone, Copy)]
pub(super) struct Place {
    pub(super) translation: DVec3,
    pub(super) mirrored: bool,
}

/// Visible triangles of one instance at a moment.
pub(super) struct Frozen<'a> {
    instance: &'a Instance,
    mesh: &'a Mesh,
    /// Numbers of the body's triangles in the glTF primitive.
    of_file: &'a [u32],
    triangles: &'a [u32],
    moment: Moment,
    place: Place,
    /// True for what is not moved by one transform alone.
    pub(super) bends: bool,
}

impl<'a> Frozen<'a> {
    /// A part at a moment. The first of a root decides about its place.
    pub(super) fn new(
        scene: &'a Scene,
        part: &'a Part,
        moment: Moment,
        place: &mut Option<Place>,
    ) -> Self {
        let instance = &scene.geometry.instances[part.instance];
        let mesh = &scene.geometry.meshes[instance.mesh.index()];
        let map = instance.world_from_mesh_at(moment);
        let mirrored = map.matrix3.determinant() < 0.0;
        let place = *place.get_or_insert(Place { translation: map.translation, mirrored });
        let of_file = &scene.meshes[instance.mesh.index()].triangles;
        let triangles = &part.triangles;
        let bends = mesh.motion.is_some();
        Self { instance, mesh, of_file, triangles, moment, place, bends }
    }

    /// Numbers of the visible triangles in the glTF primitive.
    pub(super) fn of_file(&self) -> Vec<u32> {
        self.triangles.iter().map(|&t| self.of_file[t as usize]).collect()
    }

    fn local(&self, world: DVec3) -> DVec3 {
        let p = world - self.place.translation;
        if self.place.mirrored { DVec3::new(-p.x, p.y, p.z) } else { p }
    }

    /// Positions of `vertices` vertices of the source, zero where no visible triangle uses them.
    /// `corners` are the source's, by triangle.
    pub(super) fn positions(
        &self,
        vertices: usize,
        corners: &[[u32; 3]],
    ) -> Option<Elements<'static>> {
        let mut values = vec![0.0f32; 3 * vertices];
        for &triangle in self.triangles {
            let numbers = corners.get(self.of_file[triangle as usize] as usize)?;
            let state = self.moment.state;
            let [from, to] = self.instance.corners_around(self.mesh, triangle as usize, state);
            for (k, &vertex) in numbers.iter().enumerate() {
                let p = self.local(lerp(from[k], to[k], self.moment.t));
                let slot = values.get_mut(3 * vertex as usize..)?.get_mut(..3)?;
                slot.copy_from_slice(&p.to_array().map(|v| v as f32));
            }
        }
        Elements::of_floats(Shape::floats(3), &values)
    }

    /// Turns normals and tangents along, or leaves them out.
    pub(super) fn directions(
        &self,
        attributes: &mut BTreeMap<String, Elements>,
        place: &str,
        warnings: &mut Warnings,
    ) -> Option<()> {
        let mirror = if self.place.mirrored { -1.0 } else { 1.0 };
        let linear = DMat3::from_diagonal(DVec3::new(mirror, 1.0, 1.0))
            * self.instance.world_from_mesh_at(self.moment).matrix3;
        let inverse = linear.inverse();
        if self.bends || !inverse.is_finite() {
            for name in ["NORMAL", "TANGENT"] {
                if attributes.remove(name).is_some() {
                    warnings.add("normals and tangents of what bends are left out", place);
                }
            }
            return Some(());
        }
        for (name, map, size) in [("NORMAL", inverse.transpose(), 3), ("TANGENT", linear, 4)] {
            let Some(elements) = attributes.get(name) else { continue };
            let mut values = Vec::with_capacity(size * elements.count);
            for i in 0..elements.count {
                let old = elements.shape.values(elements.get(i));
                let &[x, y, z, ref rest @ ..] = &old[..] else { return None };
                // A direction of length zero is the source's own fault; any other is as good.
                let new = (map * DVec3::new(x, y, z)).try_normalize().unwrap_or(DVec3::Z);
                values.extend(new.to_array().map(|v| v as f32));
                values.extend(rest.iter().map(|&v| v as f32));
            }
            attributes.insert(name.into(), Elements::of_floats(Shape::floats(size), &values)?);
        }
        Some(())
    }
}
