//! Nodes in motion: where each is in the world at a time.
//!
//! Only nodes whose own transform or that of an ancestor changes over time are kept, and joints of
//! skins that rest. World from node = world from parent * T * R * S, as at rest.

use std::collections::HashMap;

use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::{NodeTracks, Property, sampler::Jet};
use crate::gltf_reader::document::Node;

/// A node's own transform: what the file says at rest, and what the animation moves.
#[derive(Clone, Debug)]
pub struct Local {
    /// Parent from node at rest, for nodes that nothing moves.
    fixed: DAffine3,
    rest: (DVec3, DQuat, DVec3),
    tracks: Option<NodeTracks>,
}

impl Local {
    /// A node with a transform that is not moved.
    pub fn fixed(fixed: DAffine3) -> Self {
        Self { fixed, rest: (DVec3::ZERO, DQuat::IDENTITY, DVec3::ONE), tracks: None }
    }

    /// A node whose transform is an animation's; `rotation` is its normalized rotation at rest.
    pub fn posed(node: &Node, rotation: DQuat, tracks: &NodeTracks) -> Self {
        let rest = (
            node.translation.map_or(DVec3::ZERO, DVec3::from_array),
            rotation,
            node.scale.map_or(DVec3::ONE, DVec3::from_array),
        );
        Self { fixed: DAffine3::IDENTITY, rest, tracks: Some(tracks.clone()) }
    }

    /// Parent from node at a time.
    pub fn at(&self, seconds: f64) -> DAffine3 {
        let Some(tracks) = &self.tracks else { return self.fixed };
        let vector = |property, rest: DVec3| {
            let moved = tracks.get(property).map(|s| DVec3::from_array(s.vector(seconds)));
            moved.unwrap_or(rest)
        };
        let turn = tracks.get(Property::Rotation).map(|s| s.rotation(seconds));
        DAffine3::from_scale_rotation_translation(
            vector(Property::Scale, self.rest.2),
            turn.unwrap_or(self.rest.1),
            vector(Property::Translation, self.rest.0),
        )
    }

    /// Bounds of its linear part as an operator, and of its translation, between two times that
    /// have no key between them.
    fn jets(&self, from: f64, to: f64) -> (Jet, Jet) {
        let Some(tracks) = &self.tracks else {
            let linear = Jet::constant(operator_norm(&self.fixed.matrix3));
            return (linear, Jet::constant(self.fixed.translation.length()));
        };
        let translation = tracks
            .get(Property::Translation)
            .map_or(Jet::constant(self.rest.0.length()), |s| s.jet(0..3, from, to));
        // A diagonal map stretches by no more than its largest entry, and so do its derivatives.
        let scale = tracks
            .get(Property::Scale)
            .map_or(Jet::constant(self.rest.2.abs().max_element()), |s| {
                (0..3).map(|c| s.jet(c..c + 1, from, to)).fold(Jet::constant(0.0), Jet::max)
            });
        let turn =
            tracks.get(Property::Rotation).map_or(Jet::constant(1.0), |s| s.rotation_jet(from, to));
        (turn.times(scale), translation)
    }

    fn key_times(&self, times: &mut Vec<f64>) {
        for sampler in self.tracks.iter().flat_map(NodeTracks::transform) {
            times.extend_from_slice(sampler.times());
        }
    }

    fn jumps(&self, times: &mut Vec<f64>) {
        for sampler in self.tracks.iter().flat_map(NodeTracks::transform) {
            times.extend(sampler.jumps());
        }
    }
}

/// An upper bound of how much a linear map M stretches: the root of the largest sum of a row of
/// |M^T M|, which bounds the largest eigenvalue; exact for a rotation after a scale.
pub fn operator_norm(m: &DMat3) -> f64 {
    let square = m.transpose() * *m;
    // The matrix is symmetric: its columns are its rows.
    let sum = |v: DVec3| v.abs().element_sum();
    sum(square.x_axis).max(sum(square.y_axis)).max(sum(square.z_axis)).sqrt()
}

#[derive(Clone, Copy, Debug)]
enum Parent {
    /// World from parent, for a parent that rests.
    Rests(DAffine3),
    /// A parent that moves.
    Moves(u32),
}

/// The nodes that move, and joints.
#[derive(Debug, Default)]
pub struct Rig {
    moving: HashMap<u32, (Parent, Local)>,
    resting: HashMap<u32, DAffine3>,
}

impl Rig {
    /// Adds a node that moves. Parents come first.
    pub fn add_moving(
        &mut self,
        node: u32,
        parent: u32,
        world_from_parent: DAffine3,
        local: Local,
    ) {
        let parent = if self.moving.contains_key(&parent) {
            Parent::Moves(parent)
        } else {
            Parent::Rests(world_from_parent)
        };
        self.moving.insert(node, (parent, local));
    }

    /// Adds a joint that rests.
    pub fn add_resting(&mut self, node: u32, world_from_node: DAffine3) {
        self.resting.insert(node, world_from_node);
    }

    /// True for a node that moves.
    pub fn moves(&self, node: u32) -> bool {
        self.moving.contains_key(&node)
    }

    /// True for nodes that have been added.
    pub fn has(&self, node: u32) -> bool {
        self.moves(node) || self.resting.contains_key(&node)
    }

    /// World from node at a time; the identity for nodes that have not been added.
    pub fn world_from_node(&self, node: u32, seconds: f64) -> DAffine3 {
        // Multiplied from the root down, as for nodes at rest.
        let mut path = vec![];
        let mut at = node;
        let mut world = loop {
            let Some((parent, local)) = self.moving.get(&at) else {
                break self.resting.get(&at).copied().unwrap_or(DAffine3::IDENTITY);
            };
            path.push(local);
            match parent {
                Parent::Moves(parent) => at = *parent,
                Parent::Rests(world_from_parent) => break *world_from_parent,
            }
        };
        while let Some(local) = path.pop() {
            world *= local.at(seconds);
        }
        world
    }

    /// World from node at a time for several nodes, whose ancestors are looked at once.
    pub fn world_from_nodes(&self, nodes: &[u32], seconds: f64) -> Vec<DAffine3> {
        let mut known: HashMap<u32, DAffine3> = HashMap::new();
        let mut path = vec![];
        let mut world_from_node = |node: u32| {
            let mut at = node;
            let mut world = loop {
                if let Some(world) = known.get(&at) {
                    break *world;
                }
                let Some((parent, local)) = self.moving.get(&at) else {
                    break self.world_from_node(at, seconds);
                };
                path.push((at, local));
                match parent {
                    Parent::Moves(parent) => at = *parent,
                    Parent::Rests(world_from_parent) => break *world_from_parent,
                }
            };
            while let Some((node, local)) = path.pop() {
                world *= local.at(seconds);
                known.insert(node, world);
            }
            world
        };
        nodes.iter().map(|&node| world_from_node(node)).collect()
    }

    /// Bounds of a point of a node as it moves in the world, from those of the point in the node,
    /// between two times without a key between them. The first number is a bound of nothing: where
    /// the node is does not matter to how it moves.
    pub fn world_jet(&self, node: u32, point: Jet, from: f64, to: f64) -> Jet {
        self.jet(node, point, from, to, true)
    }

    /// As [`Rig::world_jet`], of a vector.
    pub fn world_jet_of_vector(&self, node: u32, vector: Jet, from: f64, to: f64) -> Jet {
        self.jet(node, vector, from, to, false)
    }

    fn jet(&self, node: u32, mut jet: Jet, from: f64, to: f64, point: bool) -> Jet {
        let mut at = node;
        while let Some((parent, local)) = self.moving.get(&at) {
            let (linear, translation) = local.jets(from, to);
            jet = linear.times(jet);
            if point {
                jet = jet.plus(translation);
            }
            match parent {
                Parent::Moves(parent) => at = *parent,
                Parent::Rests(world) => {
                    return Jet::constant(operator_norm(&world.matrix3)).times(jet);
                }
            }
        }
        let rests = self.resting.get(&node).map_or(1.0, |w| operator_norm(&w.matrix3));
        Jet::constant(rests).times(jet)
    }

    /// Appends the times of all keys that move a node.
    pub fn key_times(&self, node: u32, times: &mut Vec<f64>) {
        self.up(node, |local| local.key_times(times));
    }

    /// Appends the times at which a node jumps.
    pub fn jumps(&self, node: u32, times: &mut Vec<f64>) {
        self.up(node, |local| local.jumps(times));
    }

    fn up(&self, node: u32, mut visit: impl FnMut(&Local)) {
        let mut at = node;
        while let Some((parent, local)) = self.moving.get(&at) {
            visit(local);
            let Parent::Moves(parent) = parent else { return };
            at = *parent;
        }
    }
}
