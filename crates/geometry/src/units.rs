//! What is decided on as a whole: single primitives, clusters or objects.
//!
//! A partition of the primitives into *units*: a unit is visible when one of its primitives is. Every
//! unit is a run of primitive numbers, so a set of units is a set of primitives with few runs.
//!
//! - An *object* is what the author named: the instances of one node, or a particle system.
//! - A *cluster* is a subtree of a mesh's or a particle system's hierarchy with at most
//!   [`CLUSTER_PRIMITIVES`] primitives whose parent has more: what is close together, and a run of
//!   numbers because primitives are numbered in hierarchy order. docs/adr/0013 has the reasons against a
//!   second partition beside the hierarchy.
//!
//! Clusters are kept once a mesh, so memory follows unique triangles.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::{InstancedGeometry, PrimitiveId, PrimitiveSet, Run};

/// Most primitives of a cluster: what a draw call or a mesh shader takes at once.
pub const CLUSTER_PRIMITIVES: u32 = 128;

/// What a unit is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Granularity {
    /// Every primitive for itself.
    #[default]
    Triangle,
    /// Runs of close primitives of one object.
    Cluster,
    /// What the author named.
    Object,
}

/// The units of a scene.
#[derive(Clone, Debug)]
pub struct Units {
    granularity: Granularity,
    /// First primitives of the objects, ascending; only for objects.
    objects: Vec<u32>,
    /// First triangles of each mesh's clusters, ascending; only for clusters.
    meshes: Vec<Vec<u32>>,
    /// First particles of each system's clusters, ascending; only for clusters.
    systems: Vec<Vec<u32>>,
}

impl Units {
    /// The units of a geometry.
    #[must_use]
    pub fn new(geometry: &InstancedGeometry, granularity: Granularity) -> Self {
        let mut units = Self { granularity, objects: vec![], meshes: vec![], systems: vec![] };
        match granularity {
            Granularity::Triangle => {}
            Granularity::Object => {
                let instances = geometry.instances.iter().map(|i| (i.object, i.first_primitive.0));
                let systems = geometry.particles.iter().map(|p| (p.object, p.first_primitive.0));
                let mut last = None;
                for (object, first) in instances.chain(systems) {
                    if last != Some(object) {
                        units.objects.push(first);
                    }
                    last = Some(object);
                }
                // What has no primitives starts where its successor does.
                units.objects.dedup();
            }
            Granularity::Cluster => {
                units.meshes = geometry
                    .meshes
                    .iter()
                    .map(|mesh| {
                        geometry.look();
                        match &mesh.motion {
                            None => {
                                clusters(mesh.hierarchy.nodes.iter().map(|n| (n.first, n.count)))
                            }
                            Some(m) => {
                                clusters(m.hierarchy.nodes.iter().map(|n| (n.first, n.count)))
                            }
                        }
                    })
                    .collect();
                units.systems = geometry
                    .particles
                    .iter()
                    .map(|p| clusters(p.hierarchy.nodes.iter().map(|n| (n.first, n.count))))
                    .collect();
            }
        }
        units
    }

    /// What a unit is.
    #[must_use]
    pub const fn granularity(&self) -> Granularity {
        self.granularity
    }

    /// The unit of a primitive.
    ///
    /// # Panics
    /// When there is no such primitive.
    #[must_use]
    pub fn of(&self, geometry: &InstancedGeometry, primitive: PrimitiveId) -> Range<u32> {
        let within = |starts: &[u32], number: u32, end: u32| {
            let behind = starts.partition_point(|&first| first <= number);
            starts[behind - 1]..starts.get(behind).copied().unwrap_or(end)
        };
        let p = primitive.0;
        match self.granularity {
            Granularity::Triangle => p..p + 1,
            Granularity::Object => within(&self.objects, p, geometry.primitive_count()),
            Granularity::Cluster => {
                let (all, starts) = match geometry.place(primitive) {
                    crate::Place::Triangle(instance, _) => {
                        let mesh = geometry.instances[instance.index()].mesh;
                        (geometry.primitives_of(instance), &self.meshes[mesh.index()])
                    }
                    crate::Place::Particle(system, _) => {
                        let of = &geometry.particles[system];
                        let first = of.first_primitive.0;
                        (first..first + of.len() as u32, &self.systems[system])
                    }
                };
                let own = within(starts, p - all.start, all.end - all.start);
                all.start + own.start..all.start + own.end
            }
        }
    }

    /// The primitives of all units that have one in `set`.
    #[must_use]
    pub fn around(&self, geometry: &InstancedGeometry, set: &PrimitiveSet) -> PrimitiveSet {
        if self.granularity == Granularity::Triangle {
            return set.clone();
        }
        let mut out = PrimitiveSet::default();
        let mut end = 0;
        for run in set.runs() {
            let mut next = run.first.max(end);
            while next < run.end {
                let unit = self.of(geometry, PrimitiveId(next));
                end = unit.end;
                next = unit.end;
                out.push(Run { first: unit.start, end: unit.end });
            }
        }
        out
    }
}

/// First items of the largest subtrees with at most [`CLUSTER_PRIMITIVES`] items, from the nodes of a
/// hierarchy: (first child or item, number of items or 0).
fn clusters(nodes: impl Iterator<Item = (u32, u32)>) -> Vec<u32> {
    let nodes: Vec<(u32, u32)> = nodes.collect();
    // Children lie behind their parent.
    let mut items: Vec<u32> = nodes.iter().map(|node| node.1).collect();
    for (n, (first, count)) in nodes.iter().enumerate().rev() {
        if *count == 0 {
            items[n] = items[*first as usize] + items[*first as usize + 1];
        }
    }
    let (mut starts, mut next) = (Vec::new(), 0);
    let mut stack: Vec<u32> = if nodes.is_empty() { vec![] } else { vec![0] };
    while let Some(n) = stack.pop() {
        let (first, count) = nodes[n as usize];
        if count > 0 || items[n as usize] <= CLUSTER_PRIMITIVES {
            starts.push(next);
            next += items[n as usize];
        } else {
            stack.extend([first + 1, first]);
        }
    }
    starts
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DVec3};

    use super::*;
    use crate::{
        Instance, Mesh, MeshId, ObjectId, ParticleSystem, Sphere, hierarchy::TRIANGLES_A_LEAF,
    };

    /// A wavy sheet of 2 n^2 triangles.
    fn sheet(n: u32) -> Mesh {
        let at = |i: u32, j: u32| [i as f32, ((i * 7 + j * 3) % 5) as f32, j as f32];
        let positions = (0..=n).flat_map(|i| (0..=n).map(move |j| at(i, j))).collect();
        let corner = |i: u32, j: u32| i * (n + 1) + j;
        let triangles: Vec<[u32; 3]> = (0..n)
            .flat_map(|i| (0..n).map(move |j| (i, j)))
            .flat_map(|(i, j)| {
                let [a, b, c, d] =
                    [corner(i, j), corner(i + 1, j), corner(i, j + 1), corner(i + 1, j + 1)];
                [[a, b, c], [b, d, c]]
            })
            .collect();
        Mesh::new(positions, &triangles).0
    }

    fn scene() -> InstancedGeometry {
        let meshes = vec![sheet(40), sheet(3)];
        let mut first = 0;
        let mut place = |mesh: u32, object: u32| {
            let first_primitive = PrimitiveId(first);
            first += meshes[mesh as usize].triangles.len() as u32;
            Instance {
                mesh: MeshId(mesh),
                object: ObjectId(object),
                world_from_mesh: DAffine3::from_translation(DVec3::splat(f64::from(object))),
                first_primitive,
                occluder: true,
                motion: None,
            }
        };
        let instances = vec![place(0, 0), place(1, 1), place(0, 1), place(1, 2)];
        let spheres = (0..300).map(|k| Sphere { center: [k as f32, 0.0, 0.0], radius: 0.1 });
        let (system, _) = ParticleSystem::new(
            ObjectId(3),
            PrimitiveId(first),
            true,
            DVec3::ZERO,
            vec![spheres.collect()],
        );
        InstancedGeometry::with_motion(meshes, instances, vec![system], 1)
    }

    fn all_units(geometry: &InstancedGeometry, units: &Units) -> Vec<Range<u32>> {
        let mut out: Vec<Range<u32>> = Vec::new();
        for p in 0..geometry.primitive_count() {
            let unit = units.of(geometry, PrimitiveId(p));
            assert!(unit.contains(&p));
            if out.last() != Some(&unit) {
                assert_eq!(out.last().map_or(0, |last| last.end), unit.start, "units meet");
                out.push(unit);
            }
        }
        out
    }

    #[test]
    fn every_primitive_is_in_one_unit_and_units_are_runs() {
        let scene = scene();
        let count = scene.primitive_count();
        let triangles = Units::new(&scene, Granularity::Triangle);
        assert_eq!(all_units(&scene, &triangles).len(), count as usize);
        let objects = all_units(&scene, &Units::new(&scene, Granularity::Object));
        assert_eq!(objects, [0..3200, 3200..6418, 6418..6436, 6436..6736]);
        let clusters = all_units(&scene, &Units::new(&scene, Granularity::Cluster));
        assert!(clusters.iter().all(|c| c.end - c.start <= CLUSTER_PRIMITIVES));
        for object in objects {
            assert!(clusters.iter().any(|c| c.start == object.start), "no cluster has two objects");
        }
        // A split in halves of what is just too large gives half of the most.
        let mean = f64::from(count) / clusters.len() as f64;
        assert!(mean > 0.4 * f64::from(CLUSTER_PRIMITIVES), "{mean} primitives a cluster");
        assert!(TRIANGLES_A_LEAF < CLUSTER_PRIMITIVES as usize);
    }

    #[test]
    fn what_is_around_a_set_is_whole_units() {
        let scene = scene();
        let set = PrimitiveSet::from_sorted([3, 4, 3300, 6430, 6431]);
        let around = |granularity| Units::new(&scene, granularity).around(&scene, &set);
        assert_eq!(around(Granularity::Triangle), set);
        let objects = around(Granularity::Object);
        assert_eq!(objects.runs(), [Run { first: 0, end: 6436 }]);
        let clusters = around(Granularity::Cluster);
        assert!(clusters.len() >= 5 && clusters.len() <= 5 * u64::from(CLUSTER_PRIMITIVES));
        assert!(set.iter().all(|p| clusters.contains(p)));
        let units = Units::new(&scene, Granularity::Cluster);
        assert_eq!(units.around(&scene, &clusters), clusters);
    }
}
