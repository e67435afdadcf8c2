//! The methods that ours is compared with, each as strong as its definition allows.

pub mod algorithm_one;
pub mod from_point;
pub mod guided;

#[cfg(test)]
pub mod tests {
    //! Scenes that the tests of several modules share.

    use glam::{DAffine3, DQuat, DVec3};
    use sightline_geometry::{Instance, InstancedGeometry, Mesh, MeshId, ObjectId, PrimitiveId};

    use crate::directions::{sphere, stream};

    /// A mesh of corners, one after the other, placed as it is.
    pub fn scene_of(corners: &[[f32; 3]]) -> InstancedGeometry {
        let triangles: Vec<[u32; 3]> =
            (0..corners.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let (mesh, _) = Mesh::new(corners.to_vec(), &triangles);
        InstancedGeometry::new(vec![mesh], vec![instance(0, 0, DAffine3::IDENTITY)])
    }

    fn instance(mesh: u32, first: u32, world_from_mesh: DAffine3) -> Instance {
        Instance {
            mesh: MeshId(mesh),
            object: ObjectId(0),
            world_from_mesh,
            first_primitive: PrimitiveId(first),
            occluder: true,
            motion: None,
        }
    }

    fn corners(count: u32, seed: u64, size: f64, shell: f64) -> Vec<[f32; 3]> {
        let mut random = stream(seed, 77);
        let mut unit = || random.next_unit();
        (0..count)
            .flat_map(|_| {
                let middle = sphere(unit(), unit()) * (shell * (1.0 + 2.0 * unit()));
                [0, 1, 2].map(|_| (middle + size * sphere(unit(), unit())).as_vec3().to_array())
            })
            .collect()
    }

    /// `count` random triangles at 2 to 6 m around the origin.
    pub fn random_triangles(count: u32, seed: u64) -> InstancedGeometry {
        scene_of(&corners(count, seed, 0.6, 2.0))
    }

    /// `count` turned copies of a heap of `triangles` triangles, around the origin.
    pub fn instanced_triangles(count: u32, triangles: u32) -> InstancedGeometry {
        let corners = corners(triangles, 9, 0.3, 0.3);
        let indices: Vec<[u32; 3]> =
            (0..triangles).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let (mesh, _) = Mesh::new(corners, &indices);
        let mut random = stream(4, 4);
        let instances = (0..count)
            .map(|k| {
                let at = sphere(random.next_unit(), random.next_unit()) * 4.0;
                let turn = DQuat::from_axis_angle(DVec3::Y, f64::from(k));
                let scale = DVec3::new(1.0, 1.5, 0.5);
                let place = DAffine3::from_scale_rotation_translation(scale, turn, at);
                instance(0, k * triangles, place)
            })
            .collect();
        InstancedGeometry::new(vec![mesh], instances)
    }
}
