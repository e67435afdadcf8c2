//! A case of the suite: a scene that moves, a segment, a state and a time path; and the words to make it.

use std::ops::Range;

use glam::{DAffine3, DVec3};
use sightline_geometry::{
    FACE_COUNT, Instance, InstancedGeometry, Mesh, MeshId, ObjectId, ParticleSystem, PrimitiveId,
    Sampling, Sphere, ViewSegment,
};
use sightline_solver::TimePath;

use super::random::Random;

/// One input of the solver.
pub struct MovingCase {
    pub geometry: InstancedGeometry,
    pub segment: ViewSegment,
    pub sampling: Sampling,
    pub state: u32,
    pub path: TimePath,
    /// Primitives that something closed hides: none may be found.
    pub hidden: Range<u32>,
    /// True when something closed is around the segment: no pixel has a gap.
    pub surrounded: bool,
}

impl MovingCase {
    pub fn pixels(&self) -> u64 {
        u64::from(self.sampling.rows()) * u64::from(self.sampling.columns()) * FACE_COUNT as u64
    }
}

/// A triangle at the key frames.
pub type Moves = Vec<[DVec3; 3]>;

/// A sphere at the key frames; `None` where it is absent.
pub type Ball = Vec<Option<(DVec3, f64)>>;

/// Collects the bodies of a scene of one state, or of several.
pub struct MovingScene {
    states: u32,
    meshes: Vec<Mesh>,
    instances: Vec<Instance>,
    primitives: u32,
    systems: Vec<(Vec<Vec<Sphere>>, DVec3, bool)>,
}

impl MovingScene {
    pub fn new(states: u32) -> Self {
        let (meshes, instances, systems) = Default::default();
        Self { states, meshes, instances, primitives: 0, systems }
    }

    /// Adds a mesh with positions in its own space, for all key frames or for each; so for its
    /// transforms. Returns the numbers of its primitives.
    pub fn add(
        &mut self,
        keys: &[Vec<DVec3>],
        triangles: &[[u32; 3]],
        maps: &[DAffine3],
        occluder: bool,
    ) -> Range<u32> {
        let stored = |p: &Vec<DVec3>| p.iter().map(|p| p.as_vec3().to_array()).collect();
        let (mesh, _) = match keys {
            [one] => Mesh::new(stored(one), triangles),
            keys => Mesh::moving(keys.iter().map(stored).collect(), triangles),
        };
        let first = self.primitives;
        self.primitives += mesh.triangles.len() as u32;
        let number = self.meshes.len() as u32;
        self.instances.push(Instance {
            mesh: MeshId(number),
            object: ObjectId(number),
            world_from_mesh: maps[0],
            first_primitive: PrimitiveId(first),
            occluder,
            motion: (maps.len() > 1).then(|| maps.into()),
        });
        self.meshes.push(mesh);
        first..self.primitives
    }

    /// Adds triangles that share no vertices, each with its corners at the key frames.
    pub fn add_soup(&mut self, soup: &[Moves], maps: &[DAffine3], occluder: bool) -> Range<u32> {
        let triangles: Vec<[u32; 3]> =
            (0..soup.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let keys = soup.iter().map(Vec::len).max().unwrap_or(1);
        let keys: Vec<Vec<DVec3>> =
            (0..keys).map(|k| soup.iter().flat_map(|t| t[k.min(t.len() - 1)]).collect()).collect();
        self.add(&keys, &triangles, maps, occluder)
    }

    /// Adds spheres, which `map` puts into the world without changing their size; `origin` is what
    /// the world positions are stored relative to.
    pub fn add_balls(&mut self, balls: &[Ball], map: &DAffine3, origin: DVec3, occluder: bool) {
        let keys = balls.iter().map(Vec::len).max().unwrap_or(1);
        let stored = |ball: &Option<(DVec3, f64)>| match ball {
            None => Sphere::ABSENT,
            Some((center, radius)) => Sphere {
                center: (map.transform_point3(*center) - origin).as_vec3().to_array(),
                radius: *radius as f32,
            },
        };
        let keys = (0..keys)
            .map(|k| balls.iter().map(|b| stored(&b[k.min(b.len() - 1)])).collect())
            .collect();
        self.systems.push((keys, origin, occluder));
    }

    /// Number of the first sphere, once all triangles are there.
    pub fn first_ball(&self) -> u32 {
        self.primitives
    }

    pub fn finish(
        self,
        random: &mut Random,
        segment: ViewSegment,
        sampling: Sampling,
    ) -> MovingCase {
        let mut next = self.primitives;
        let mut systems = Vec::new();
        for (keys, origin, occluder) in self.systems {
            let object = ObjectId((self.meshes.len() + systems.len()) as u32);
            let system = ParticleSystem::new(object, PrimitiveId(next), occluder, origin, keys).0;
            next += system.len() as u32;
            systems.push(system);
        }
        let geometry =
            InstancedGeometry::with_motion(self.meshes, self.instances, systems, self.states);
        let state = random.below(self.states as usize) as u32;
        let path = any_path(random);
        MovingCase { geometry, segment, sampling, state, path, hidden: 0..0, surrounded: false }
    }
}

/// Forward half of the time; reversed, a part, or stopped else.
pub fn any_path(random: &mut Random) -> TimePath {
    match random.below(8) {
        0..=3 => TimePath::FORWARD,
        4 | 5 => TimePath::REVERSED,
        6 => TimePath { t0: random.unit(), t1: random.unit() },
        _ => TimePath::stopped(random.unit()),
    }
}
