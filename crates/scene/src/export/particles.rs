//! The particles of a set as instances of one tessellated sphere, so that any viewer shows them.
//!
//! An icosphere of 80 triangles with its vertices on the unit sphere, placed by EXT_mesh_gpu_instancing
//! with centre and radius: one node a particle table, at the table's origin and under its name. A
//! particle that is not there at the moment is left out.

use serde_json::{Value, json};
use sightline_geometry::{Moment, PrimitiveId, PrimitiveSet, Shape as Primitive};

use super::Warnings;
use super::output::Output;
use super::source::{Elements, Shape};
use crate::{Scene, generate::unit_sphere};

/// What is to be added to the meshes and to the root nodes of the output.
pub(super) struct Balls {
    /// The sphere that all nodes show; none without nodes.
    pub(super) mesh: Option<Value>,
    pub(super) nodes: Vec<Value>,
    /// Particles that the nodes show.
    pub(super) count: u64,
}

/// The particles of `set` at a moment; `mesh` is the number that their mesh will have.
pub(super) fn balls(
    scene: &Scene,
    set: &PrimitiveSet,
    moment: Moment,
    mesh: usize,
    output: &mut Output,
    warnings: &mut Warnings,
) -> Option<Balls> {
    let mut balls = Balls { mesh: None, nodes: vec![], count: 0 };
    for system in &scene.geometry.particles {
        let object = &scene.objects[system.object.index()];
        let numbers = set.runs().iter().flat_map(|run| {
            run.first.max(object.primitives.start)..run.end.min(object.primitives.end)
        });
        let (mut centers, mut radii) = (vec![], vec![]);
        for number in numbers {
            match scene.geometry.shape(PrimitiveId(number), moment) {
                Primitive::Sphere { center, radius } => {
                    centers.extend((center - system.origin).as_vec3().to_array());
                    radii.extend([radius as f32; 3]);
                }
                _ => warnings.add("particles that are not there yet are left out", &object.name),
            }
        }
        if centers.is_empty() {
            continue;
        }
        let count = centers.len() / 3;
        let all: Vec<u32> = (0..count as u32).collect();
        let mut instances = |values: &[f32]| {
            Some(output.instances(&Elements::of_floats(Shape::floats(3), values)?, &all))
        };
        let (translation, scale) = (instances(&centers)?, instances(&radii)?);
        balls.count += count as u64;
        balls.nodes.push(json!({
            "name": object.name,
            "mesh": mesh,
            "translation": system.origin.to_array(),
            "extensions": { "EXT_mesh_gpu_instancing": {
                "attributes": { "TRANSLATION": translation, "SCALE": scale },
            } },
        }));
    }
    if !balls.nodes.is_empty() {
        balls.mesh = Some(sphere(output)?);
    }
    Some(balls)
}

/// The mesh of a sphere of radius 1.
fn sphere(output: &mut Output) -> Option<Value> {
    let (positions, triangles) = unit_sphere();
    let all: Vec<u32> = (0..positions.len() as u32).collect();
    let points = Elements::of_floats(Shape::floats(3), positions.as_flattened())?;
    // A point of the unit sphere is its own normal.
    let [position, normal] =
        ["POSITION", "NORMAL"].map(|name| output.vertices(name, &points, &all));
    let indices = output.indices(triangles.as_flattened(), positions.len());
    let attributes = json!({ "POSITION": position, "NORMAL": normal });
    Some(json!({
        "name": "particle",
        "primitives": [{ "attributes": attributes, "indices": indices }],
    }))
}
