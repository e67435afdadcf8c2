//! Bodies whose vertices move on their own: skins, and morph targets with weights that change.
//!
//! A vertex at rest is p, morph target k displaces it by d_k. In the space of the mesh it is at
//! q(t) = p + sum_k w_k(t) d_k. A skin takes q(t) into the world. Positions are kept relative to a
//! centre, so that `f32` is exact enough far from the world's origin.

use std::{collections::BTreeMap, sync::Arc};

use glam::{DAffine3, DMat3, DVec3};
use rayon::prelude::*;

use super::{
    bend::{Mover, Part, Term},
    rig::{Rig, operator_norm},
    sampler::Sampler,
    skin::{Influences, Skin},
};
use sightline_geometry::Bounds;

/// What moves the vertices of a body.
#[derive(Debug)]
pub struct Soft {
    /// Vertices at rest, without the displacements of `targets`; each is used by a triangle.
    pub positions: Vec<[f32; 3]>,
    /// Displacements by morph targets whose weights change, by number of the target.
    pub targets: Vec<(usize, Displacements)>,
    /// Weights of the morph targets, where they change.
    pub weights: Option<Sampler>,
    /// The skin, and which of its joints each vertex follows.
    pub skin: Option<(Arc<Skin>, Influences)>,
}

/// Vertices that a morph target moves, and how far.
pub type Displacements = Vec<(u32, [f32; 3])>;

fn wide(p: [f32; 3]) -> DVec3 {
    DVec3::from_array(p.map(f64::from))
}

/// The corners of a box.
pub fn corners(bounds: Bounds) -> impl Iterator<Item = DVec3> {
    let (a, b) = (bounds.min, bounds.max);
    (0..8).map(move |i| {
        DVec3::new(
            if i & 1 == 0 { a.x } else { b.x },
            if i & 2 == 0 { a.y } else { b.y },
            if i & 4 == 0 { a.z } else { b.z },
        )
    })
}

/// A box around some vertices, and boxes around their displacements by some of the targets, which
/// are by place in [`Soft::targets`] and hold zero.
struct Boxes {
    positions: Bounds,
    targets: BTreeMap<usize, Bounds>,
}

impl Boxes {
    const EMPTY: Self = Self { positions: Bounds::EMPTY, targets: BTreeMap::new() };

    fn add_position(&mut self, p: [f32; 3]) {
        self.positions = self.positions.union(Bounds::of_points([wide(p)]));
    }

    fn add_displacement(&mut self, target: usize, by: [f32; 3]) {
        let zero = Bounds { min: DVec3::ZERO, max: DVec3::ZERO };
        let bounds = self.targets.entry(target).or_insert(zero);
        *bounds = bounds.union(Bounds::of_points([wide(by)]));
    }

    /// Under several maps at once.
    fn under(&self, maps: &[DAffine3]) -> Self {
        let all = |bounds: &Bounds, map: &dyn Fn(&DAffine3) -> DAffine3| {
            let image = |m: &DAffine3| bounds.transformed(&map(m));
            maps.iter().map(image).fold(Bounds::EMPTY, Bounds::union)
        };
        let linear = |m: &DAffine3| DAffine3 { translation: DVec3::ZERO, ..*m };
        let targets = self.targets.iter().map(|(&t, bounds)| (t, all(bounds, &linear)));
        Self { positions: all(&self.positions, &|m| *m), targets: targets.collect() }
    }

    /// What moves them, after `map` into the space of a part.
    fn mover(&self, soft: &Soft, part: Part, map: &DAffine3, stretch: f64) -> Mover {
        let base = corners(self.positions).map(|c| map.transform_point3(c)).collect();
        let term = |(&target, bounds): (&usize, &Bounds)| Term {
            target: soft.targets[target].0,
            corners: corners(*bounds).map(|c| map.transform_vector3(c)).collect(),
        };
        let terms = self.targets.iter().map(term).collect();
        Mover { part, base, terms, weights: soft.weights.clone(), stretch }
    }
}

impl Soft {
    /// What its vertices move like. `carrier` is the node that carries the body where it has no
    /// skin, and `maps` are the transforms of its instances: into the space of the carrier, or into
    /// the world where nothing carries it.
    ///
    /// A skinned vertex is a mean of where its joints take it, so it is no farther from straight than
    /// the worst of them: one mover a joint, with the box of the vertices that follow it.
    pub fn movers(&self, rig: &Rig, carrier: Option<u32>, maps: &[DAffine3]) -> Vec<Mover> {
        if self.positions.is_empty() {
            return vec![];
        }
        let Some((skin, influences)) = &self.skin else {
            let mut boxes = Boxes::EMPTY;
            self.positions.iter().for_each(|&p| boxes.add_position(p));
            for (t, (_, moved)) in self.targets.iter().enumerate() {
                moved.iter().for_each(|(_, by)| boxes.add_displacement(t, *by));
            }
            let part = carrier.map_or(Part::Rests(DAffine3::IDENTITY), Part::Node);
            return vec![boxes.under(maps).mover(self, part, &DAffine3::IDENTITY, 1.0)];
        };
        let stretch = maps.iter().map(|m| operator_norm(&m.matrix3)).fold(0.0, f64::max);
        let mut boxes: Vec<Option<Boxes>> = Vec::new();
        boxes.resize_with(skin.joints.len(), || None);
        for (vertex, &position) in self.positions.iter().enumerate() {
            for (joint, _) in influences.of(vertex) {
                boxes[joint].get_or_insert(Boxes::EMPTY).add_position(position);
            }
        }
        for (t, (_, moved)) in self.targets.iter().enumerate() {
            for &(vertex, by) in moved {
                for (joint, _) in influences.of(vertex as usize) {
                    boxes[joint].get_or_insert(Boxes::EMPTY).add_displacement(t, by);
                }
            }
        }
        let moves = |node: u32, boxes: &Boxes| rig.moves(node) || !boxes.targets.is_empty();
        (boxes.iter().zip(&skin.joints).zip(&skin.joint_from_mesh))
            .filter_map(|((boxes, &node), map)| Some((boxes.as_ref()?, node, map)))
            .filter(|(boxes, node, _)| moves(*node, boxes))
            .map(|(boxes, node, map)| boxes.mover(self, Part::Node(node), map, stretch))
            .collect()
    }

    /// The centre that positions are kept relative to: near all of them for skins, which are in the
    /// world, and the origin of the mesh otherwise. In whole metres.
    pub fn center(&self, rig: &Rig, times: &[f64]) -> DVec3 {
        let Some((skin, influences)) = &self.skin else { return DVec3::ZERO };
        let mut bounds = Bounds::EMPTY;
        let some = self.positions.len().min(64);
        for &seconds in times {
            let maps = joint_maps(rig, skin, DVec3::ZERO, seconds);
            for vertex in (0..some).map(|i| i * self.positions.len() / some) {
                let position = wide(self.positions[vertex]);
                let at = influences.place(vertex, &maps, position);
                bounds = bounds.union(Bounds::of_points([at]));
            }
        }
        if bounds.is_empty() { DVec3::ZERO } else { bounds.center().round() }
    }

    /// Positions at each of some times relative to `center`, under the linear map `after`.
    pub fn keys(
        &self,
        rig: &Rig,
        times: &[f64],
        center: DVec3,
        after: Option<DMat3>,
    ) -> Vec<Vec<[f32; 3]>> {
        times.par_iter().map(|&seconds| self.at(rig, seconds, center, after)).collect()
    }

    fn at(&self, rig: &Rig, seconds: f64, center: DVec3, after: Option<DMat3>) -> Vec<[f32; 3]> {
        let weight = |k: usize| self.weights.as_ref().map_or(0.0, |w| w.number(k, seconds));
        let weights: Vec<f64> = self.targets.iter().map(|(k, _)| weight(*k)).collect();
        let maps = self.skin.as_ref().map(|(skin, _)| joint_maps(rig, skin, center, seconds));
        let mut positions: Vec<DVec3> = self.positions.iter().map(|&p| wide(p)).collect();
        for ((_, moved), weight) in self.targets.iter().zip(&weights) {
            for &(vertex, by) in moved {
                positions[vertex as usize] += *weight * wide(by);
            }
        }
        let place = |(vertex, p): (usize, DVec3)| {
            let p = match (&self.skin, &maps) {
                (Some((_, influences)), Some(maps)) => influences.place(vertex, maps, p),
                _ => p - center,
            };
            after.map_or(p, |after| after * p).to_array().map(|v| v as f32)
        };
        positions.into_iter().enumerate().map(place).collect()
    }
}

/// World, relative to `center`, from mesh for each joint.
fn joint_maps(rig: &Rig, skin: &Skin, center: DVec3, seconds: f64) -> Vec<DAffine3> {
    let world_from_joints = rig.world_from_nodes(&skin.joints, seconds);
    let map = |(mut world, joint_from_mesh): (DAffine3, &DAffine3)| {
        world.translation -= center;
        world * *joint_from_mesh
    };
    world_from_joints.into_iter().zip(&skin.joint_from_mesh).map(map).collect()
}
