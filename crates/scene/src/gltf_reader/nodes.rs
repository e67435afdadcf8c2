//! The default scene as placements of glTF meshes, in `f64`.
//!
//! Promise: every node is visited at most once, without recursion; a node that is its own
//! ancestor or has two parents is an error. The transform of a skinned node is ignored, as the
//! specification asks: its joints place its vertices.
//!
//! Composition: world = parent * T * R * S, or parent * matrix. Rotations are normalized. What an
//! animation moves is in the rig; what it only poses stands as it does at time 0.

use std::collections::BTreeMap;

use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::{
    accessors::Accessors,
    animation::{
        Animations, NodeTracks,
        rig::{Local, Rig},
        skin,
    },
    document::{Document, Node, shorten},
    gpu_instancing,
};
use crate::{Cause, OpenOptions, SceneError};

/// Nodes may be nested this deep.
const MAX_DEPTH: u32 = 1024;

/// Deviation of a rotation's length from 1, or of a matrix's last row from 0 0 0 1, that is taken
/// for rounding: a few units in the last place of a number printed with six digits.
const TOLERANCE: f64 = 1e-4;

/// One node with a mesh.
pub struct Placement {
    /// Index into `nodes`.
    pub node: u32,
    /// Index into `meshes`.
    pub mesh: u32,
    /// The node that carries the mesh through the world: itself, where it moves.
    pub carrier: Option<u32>,
    /// Carrier from mesh, or world from mesh where there is no carrier; one for each instance of
    /// EXT_mesh_gpu_instancing.
    pub transforms: Vec<DAffine3>,
    /// True when the transforms are those of EXT_mesh_gpu_instancing.
    pub gpu_instanced: bool,
    /// True for a node with a skin.
    pub skinned: bool,
    /// True when an animation places it, or may, rather than the nodes of the file.
    pub posed: bool,
}

/// Warnings by sentence, with how often and where first.
#[derive(Default)]
pub struct Warnings(BTreeMap<&'static str, (u64, String)>);

impl Warnings {
    /// Adds a warning; `place` names the part of the scene.
    pub fn add(&mut self, sentence: &'static str, place: impl FnOnce() -> String) {
        self.0.entry(sentence).or_insert_with(|| (0, place())).0 += 1;
    }

    /// One sentence each.
    pub fn sentences(&self) -> Vec<String> {
        self.0
            .iter()
            .map(|(sentence, (count, first))| match count {
                1 => format!("{sentence} ({first})"),
                _ => format!("{sentence} ({count} times, first: {first})"),
            })
            .collect()
    }
}

/// The placements of the default scene, by ascending node index.
pub struct Placed {
    /// Nodes with a mesh.
    pub placements: Vec<Placement>,
    /// What moves, and joints.
    pub rig: Rig,
    /// Parent of each node that was reached, `NO_PARENT` for roots.
    parents: Vec<u32>,
    /// Nodes with a mesh that are switched off.
    pub hidden_nodes: u64,
    /// What deserves a look.
    pub warnings: Warnings,
}

const UNREACHED: u32 = u32::MAX;
const NO_PARENT: u32 = u32::MAX - 1;

impl Placed {
    /// Names from the root down, joined by `/`.
    pub fn path(&self, document: &Document, node: u32) -> String {
        const LONGEST: usize = 4096;
        let mut names = Vec::new();
        let (mut at, mut length) = (node, 0);
        while at < NO_PARENT && length <= LONGEST {
            let name = node_name(document, at).unwrap_or_else(|| format!("#{at}"));
            length += name.len() + 1;
            names.push(name);
            at = self.parents[at as usize];
        }
        names.reverse();
        let path = names.join("/");
        if path.len() <= LONGEST {
            return path;
        }
        let cut = (path.len() - LONGEST..).find(|&i| path.is_char_boundary(i));
        format!("…{}", &path[cut.unwrap_or(path.len())..])
    }
}

/// The name of a node, if it has one.
pub fn node_name(document: &Document, node: u32) -> Option<String> {
    document.nodes[node as usize].name.clone().filter(|n| !n.is_empty())
}

/// Walks the default scene.
pub fn placements(
    document: &Document,
    accessors: &Accessors,
    animations: &Animations,
    options: &OpenOptions,
) -> Result<Placed, SceneError> {
    let joints = skin::joints(document);
    let mut placed = Placed {
        placements: Vec::new(),
        rig: Rig::default(),
        parents: vec![UNREACHED; document.nodes.len()],
        hidden_nodes: 0,
        warnings: Warnings::default(),
    };
    let mut instances = 0;
    let mut stack: Vec<Visit> = document
        .roots()?
        .into_iter()
        .rev()
        .map(|node| Visit {
            node,
            parent: NO_PARENT,
            depth: 1,
            world_from_parent: DAffine3::IDENTITY,
            hidden: false,
            moves: false,
            posed: false,
        })
        .collect();
    while let Some(visit) = stack.pop() {
        let index = visit.node;
        let node = Document::get(&document.nodes, "node", index, || match visit.parent {
            NO_PARENT => "the scene".into(),
            parent => format!("node {parent}"),
        })?;
        placed.reach(&visit)?;
        let tracks = animations.nodes.get(&index);
        let local = local(index, node, tracks, &mut placed.warnings)
            .map_err(|e| e.at_node(index as usize))?;
        let world_from_node = visit.world_from_parent * local.at(0.0);
        if !world_from_node.is_finite() {
            return Err(SceneError::from(Cause::TransformNotFinite).at_node(index as usize));
        }
        let moves = visit.moves || tracks.is_some_and(NodeTracks::moves);
        let posed = visit.posed || tracks.is_some_and(NodeTracks::poses);
        if moves {
            placed.rig.add_moving(index, visit.parent, visit.world_from_parent, local);
        } else if joints.contains(&index) {
            placed.rig.add_resting(index, world_from_node);
        }
        let hidden =
            visit.hidden || node.extensions.visibility.as_ref().is_some_and(|v| !v.visible);
        match node.mesh {
            Some(_) if hidden => placed.hidden_nodes += 1,
            Some(mesh) => {
                let (frame, carrier) = match moves {
                    true => (DAffine3::IDENTITY, Some(index)),
                    false => (world_from_node, None),
                };
                let placement = place(document, accessors, index, mesh, frame)
                    .map_err(|e| e.at_node(index as usize))?;
                let weights = animations.weights(index).is_some();
                let placement = Placement {
                    carrier: carrier.filter(|_| !placement.skinned),
                    posed: posed || weights || placement.skinned,
                    ..placement
                };
                let primitives = document.meshes[mesh as usize].primitives.len() as u64;
                instances += primitives * placement.transforms.len() as u64;
                let limit = options.max_instances;
                if instances > limit {
                    return Err(Cause::TooManyInstances { count: instances, limit }.into());
                }
                placed.placements.push(placement);
            }
            None => {}
        }
        stack.extend(node.children.iter().rev().map(|&child| Visit {
            node: child,
            parent: index,
            depth: visit.depth + 1,
            world_from_parent: world_from_node,
            hidden,
            moves,
            posed,
        }));
    }
    placed.placements.sort_unstable_by_key(|p| p.node);
    Ok(placed)
}

/// A node that is to be visited.
struct Visit {
    node: u32,
    parent: u32,
    depth: u32,
    world_from_parent: DAffine3,
    hidden: bool,
    /// True below a node that an animation moves.
    moves: bool,
    /// True below a node that an animation poses.
    posed: bool,
}

impl Placed {
    /// True for nodes of the default scene.
    pub fn has(&self, node: u32) -> bool {
        self.parents.get(node as usize).is_some_and(|&p| p != UNREACHED)
    }

    /// Notes a node's parent; refuses cycles, second parents and deep nesting.
    fn reach(&mut self, visit: &Visit) -> Result<(), SceneError> {
        let node = visit.node;
        if visit.depth > MAX_DEPTH {
            return Err(Cause::NodesTooDeep { limit: MAX_DEPTH }.into());
        }
        if self.parents[node as usize] == UNREACHED {
            self.parents[node as usize] = visit.parent;
            return Ok(());
        }
        let mut ancestor = visit.parent;
        while ancestor < NO_PARENT {
            if ancestor == node {
                return Err(Cause::NodeCycle { node }.into());
            }
            ancestor = self.parents[ancestor as usize];
        }
        Err(Cause::NodeWithTwoParents { node }.into())
    }
}

fn place(
    document: &Document,
    accessors: &Accessors,
    index: u32,
    mesh: u32,
    frame_from_node: DAffine3,
) -> Result<Placement, SceneError> {
    let node = &document.nodes[index as usize];
    Document::get(&document.meshes, "mesh", mesh, || format!("node {index}"))?;
    let skinned = node.skin.is_some();
    let frame_from_mesh = if skinned { DAffine3::IDENTITY } else { frame_from_node };
    let (transforms, gpu_instanced) = match &node.extensions.gpu_instancing {
        Some(extension) => {
            let locals = gpu_instancing::transforms(accessors, &extension.attributes)?;
            (locals.into_iter().map(|local| frame_from_mesh * local).collect(), true)
        }
        None => (vec![frame_from_mesh], false),
    };
    if transforms.iter().any(|t: &DAffine3| !t.is_finite()) {
        return Err(Cause::TransformNotFinite.into());
    }
    let (carrier, posed) = (None, false);
    Ok(Placement { node: index, mesh, carrier, transforms, gpu_instanced, skinned, posed })
}

/// Parent from node.
fn local(
    index: u32,
    node: &Node,
    tracks: Option<&NodeTracks>,
    warnings: &mut Warnings,
) -> Result<Local, SceneError> {
    let trs = node.translation.is_some() || node.rotation.is_some() || node.scale.is_some();
    let place = || match &node.name {
        Some(name) => format!("node {index}, `{}`", shorten(name)),
        None => format!("node {index}"),
    };
    if let Some(m) = node.matrix {
        if trs {
            warnings.add("a node has both a matrix and TRS; the matrix was taken", place);
        }
        let row = [m[3], m[7], m[11], m[15]];
        let off = [row[0], row[1], row[2], row[3] - 1.0];
        if off.iter().any(|v| v.abs() > TOLERANCE) {
            return Err(Cause::MatrixNotAffine { row }.into());
        }
        let column = |k: usize| DVec3::new(m[4 * k], m[4 * k + 1], m[4 * k + 2]);
        let matrix3 = DMat3::from_cols(column(0), column(1), column(2));
        return Ok(Local::fixed(DAffine3 { matrix3, translation: column(3) }));
    }
    let tracks = tracks.filter(|t| t.poses());
    if !trs && tracks.is_none() {
        return Ok(Local::fixed(DAffine3::IDENTITY));
    }
    let rotation = match node.rotation {
        Some(q) => {
            let length = DQuat::from_array(q).length();
            if (length - 1.0).abs() > TOLERANCE {
                warnings.add("a rotation is not of length 1; it was normalized", place);
            }
            rotation(q)?
        }
        None => DQuat::IDENTITY,
    };
    if let Some(tracks) = tracks {
        return Ok(Local::posed(node, rotation, tracks));
    }
    Ok(Local::fixed(DAffine3::from_scale_rotation_translation(
        node.scale.map_or(DVec3::ONE, DVec3::from_array),
        rotation,
        node.translation.map_or(DVec3::ZERO, DVec3::from_array),
    )))
}

/// A quaternion (x, y, z, w), normalized.
pub fn rotation(q: [f64; 4]) -> Result<DQuat, SceneError> {
    let q = DQuat::from_array(q);
    if q == DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0) {
        return Err(Cause::RotationZero.into());
    }
    // Scaled first, so that the squares neither over- nor underflow.
    let largest = q.to_array().into_iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let q = (q * largest.recip()).normalize();
    if q.is_finite() { Ok(q) } else { Err(Cause::TransformNotFinite.into()) }
}
