//! The same scene in other words: triangles, instances and particles in another order (VI-3).

use sightline_geometry::{
    Instance, InstanceId, InstancedGeometry, Mesh, ParticleSystem, PrimitiveId,
};

use super::{random::Random, scene::MovingCase};

/// A case in another order, and the number that each of its primitives had before.
pub fn shuffled(case: &MovingCase, random: &mut Random) -> (MovingCase, Vec<u32>) {
    let geometry = &case.geometry;
    let (mut meshes, mut orders): (Vec<Mesh>, Vec<Vec<u32>>) = (Vec::new(), Vec::new());
    for mesh in &geometry.meshes {
        let mut mixed: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
        random.shuffle(&mut mixed);
        let triangles: Vec<[u32; 3]> = mixed.iter().map(|&t| mesh.triangles[t as usize]).collect();
        let (mesh, order) = match &mesh.motion {
            None => Mesh::new(mesh.positions.to_vec(), &triangles),
            Some(motion) => Mesh::moving(motion.keys.clone(), &triangles),
        };
        meshes.push(mesh);
        orders.push(order.iter().map(|&t| mixed[t as usize]).collect());
    }
    let mut numbers: Vec<usize> = (0..geometry.instances.len()).collect();
    random.shuffle(&mut numbers);
    let (mut instances, mut before): (Vec<Instance>, Vec<u32>) = (Vec::new(), Vec::new());
    for number in numbers {
        let instance = &geometry.instances[number];
        let first_primitive = PrimitiveId(before.len() as u32);
        instances.push(Instance { first_primitive, ..instance.clone() });
        let first = geometry.primitives_of(InstanceId(number as u32)).start;
        before.extend(orders[instance.mesh.index()].iter().map(|t| first + t));
    }
    let mut systems = Vec::new();
    for system in &geometry.particles {
        let mut mixed: Vec<usize> = (0..system.len()).collect();
        random.shuffle(&mut mixed);
        let keys = system.keys.iter().map(|key| mixed.iter().map(|&i| key[i]).collect()).collect();
        let first = PrimitiveId(before.len() as u32);
        let (new, order) =
            ParticleSystem::new(system.object, first, system.occluder, system.origin, keys);
        let number = |&i: &u32| system.first_primitive.0 + mixed[i as usize] as u32;
        before.extend(order.iter().map(number));
        systems.push(new);
    }
    let geometry = InstancedGeometry::with_motion(meshes, instances, systems, geometry.states);
    let other = MovingCase { geometry, hidden: 0..0, ..*case };
    (other, before)
}
