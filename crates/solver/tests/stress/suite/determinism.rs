//! The same scene in other words: other threads, other orders, other groupings (VI-3).

use std::ops::Range;

use sightline_geometry::{
    Instance, InstanceId, InstancedGeometry, Mesh, MeshId, ObjectId, PrimitiveId,
};

use super::{case::Case, random::Random};

/// A case with the triangles of its meshes, and its instances, in another order.
pub struct Shuffled {
    pub case: Case,
    /// The number that each primitive had before.
    pub before: Vec<u32>,
}

pub fn shuffled(case: &Case, random: &mut Random) -> Shuffled {
    let geometry = &case.geometry;
    let mut meshes = Vec::new();
    let mut orders: Vec<Vec<u32>> = Vec::new();
    for mesh in &geometry.meshes {
        let mut mixed: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
        random.shuffle(&mut mixed);
        let triangles: Vec<[u32; 3]> = mixed.iter().map(|&t| mesh.triangles[t as usize]).collect();
        let (mesh, order) = Mesh::new(mesh.positions.to_vec(), &triangles);
        meshes.push(mesh);
        orders.push(order.iter().map(|&t| mixed[t as usize]).collect());
    }
    let mut numbers: Vec<usize> = (0..geometry.instances.len()).collect();
    random.shuffle(&mut numbers);
    let (mut instances, mut before) = (Vec::new(), Vec::new());
    for number in numbers {
        let instance = &geometry.instances[number];
        instances.push(Instance {
            first_primitive: PrimitiveId(before.len() as u32),
            ..instance.clone()
        });
        let order = &orders[instance.mesh.index()];
        before.extend(order.iter().map(|t| instance.first_primitive.0 + t));
    }
    let case = Case {
        geometry: InstancedGeometry::new(meshes, instances),
        segment: case.segment,
        sampling: case.sampling,
        hidden: 0..0,
        surrounded: case.surrounded,
    };
    Shuffled { case, before }
}

/// The case with every triangle in an instance of its own: same numbers, another hierarchy. Error
/// bounds are those of the boxes of instances, so behind them come triangles without area, from
/// corner to corner of the boxes that were there: nothing is seen of them, and the bounds stay.
pub fn taken_apart(case: &Case) -> Case {
    let geometry = &case.geometry;
    let (mut meshes, mut instances) = (Vec::new(), Vec::new());
    for (number, instance) in geometry.instances.iter().enumerate() {
        let mesh = &geometry.meshes[instance.mesh.index()];
        let primitives: Range<u32> = geometry.primitives_of(InstanceId(number as u32));
        for (t, primitive) in primitives.enumerate() {
            let positions = mesh.triangles[t].map(|v| mesh.positions[v as usize]).to_vec();
            meshes.push(Mesh::new(positions, &[[0, 1, 2]]).0);
            instances.push(Instance {
                mesh: MeshId(primitive),
                object: ObjectId(primitive),
                world_from_mesh: instance.world_from_mesh,
                first_primitive: PrimitiveId(primitive),
                occluder: instance.occluder,
                motion: None,
            });
        }
    }
    let count = geometry.primitive_count();
    let with_triangles =
        geometry.instances.iter().filter(|i| !geometry.meshes[i.mesh.index()].bounds.is_empty());
    for (primitive, instance) in (count..).zip(with_triangles) {
        let bounds = geometry.meshes[instance.mesh.index()].bounds;
        let corners = [bounds.min, bounds.max].map(|p| p.as_vec3().to_array()).to_vec();
        meshes.push(Mesh::new(corners, &[[0, 1, 1]]).0);
        instances.push(Instance {
            mesh: MeshId(primitive),
            object: ObjectId(primitive),
            world_from_mesh: instance.world_from_mesh,
            first_primitive: PrimitiveId(primitive),
            occluder: instance.occluder,
            motion: None,
        });
    }
    Case {
        geometry: InstancedGeometry::new(meshes, instances),
        segment: case.segment,
        sampling: case.sampling,
        hidden: case.hidden.clone(),
        surrounded: case.surrounded,
    }
}
