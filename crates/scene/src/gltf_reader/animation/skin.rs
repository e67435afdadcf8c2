//! Skins: which joints a vertex follows, and how.
//!
//! Source: Khronos, "glTF 2.0 Specification", section 3.7.3. A vertex p is at
//! sum_i w_i (world from joint_i) (inverse bind matrix_i) p, whatever the transform of the node that
//! shows it. Weights are scaled to a sum of 1; the specification asks for it up to rounding. A vertex
//! without weights follows the first of its joints.

use glam::{DAffine3, DMat3, DVec3};
use gltf::{
    json::{mesh::Primitive, validation::Checked},
    mesh::Semantic,
};
use serde::Deserialize;

use crate::gltf_reader::{
    accessors::{Accessors, INVERSE_BIND_MATRICES, JOINTS, WEIGHTS},
    document::{Document, part},
};
use crate::{Cause, SceneError};

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct SkinJson {
    joints: Vec<u32>,
    inverse_bind_matrices: Option<u32>,
}

/// The joints of a skin.
#[derive(Debug)]
pub struct Skin {
    /// Indices into `nodes`.
    pub joints: Vec<u32>,
    /// Joint from mesh, when the skin was bound.
    pub joint_from_mesh: Vec<DAffine3>,
}

impl Skin {
    /// Reads a skin.
    pub fn read(document: &Document, accessors: &Accessors, skin: u32) -> Result<Self, SceneError> {
        let json = Document::get(&document.skins, "skin", skin, || "`skin`".into())?;
        Self::of(document, accessors, json).map_err(|e| e.at_skin(skin))
    }

    fn of(
        document: &Document,
        accessors: &Accessors,
        json: &serde_json::Value,
    ) -> Result<Self, SceneError> {
        let json: SkinJson = part(json)?;
        let joints = json.joints;
        for &joint in &joints {
            Document::get(&document.nodes, "node", joint, || "`joints`".into())?;
        }
        let Some(accessor) = json.inverse_bind_matrices else {
            let joint_from_mesh = vec![DAffine3::IDENTITY; joints.len()];
            return Ok(Self { joints, joint_from_mesh });
        };
        let matrices = accessors.elements(accessor, &INVERSE_BIND_MATRICES)?;
        if matrices.count < joints.len() {
            let (count, expected) = (matrices.count as u64, joints.len() as u64);
            let use_as = INVERSE_BIND_MATRICES.name;
            return Err(Cause::CountMismatch { accessor, use_as, count, expected }.into());
        }
        let affine = |m: &[f32; 16]| {
            // The last row is 0 0 0 1.
            let column = |k: usize| DVec3::from_array([0, 1, 2].map(|r| f64::from(m[4 * k + r])));
            let matrix3 = DMat3::from_cols(column(0), column(1), column(2));
            DAffine3 { matrix3, translation: column(3) }
        };
        let joint_from_mesh: Vec<DAffine3> =
            matrices.vectors::<16>()?[..joints.len()].iter().map(affine).collect();
        if let Some(at) = joint_from_mesh.iter().position(|m| !m.is_finite()) {
            return Err(Cause::KeyValue { accessor, at: at as u64 }.into());
        }
        Ok(Self { joints, joint_from_mesh })
    }
}

/// Nodes that a skin of the file names as joints; what is malformed is found when it is used.
pub fn joints(document: &Document) -> std::collections::HashSet<u32> {
    let joints = document.skins.iter().filter_map(|skin| skin["joints"].as_array());
    let index = |joint: &serde_json::Value| joint.as_f64().map(|j| j as u32);
    joints.flatten().filter_map(index).collect()
}

/// Most sets of four joints that a vertex may follow. Exporters write up to four; sets may share
/// their data, so that memory must not follow their number.
const SETS_MAX: usize = 16;

/// Where the joints and weights of a primitive are.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Sets {
    /// Accessors of joints and of weights, by set. For compressed primitives the unique ids of the
    /// attributes.
    pub sets: Vec<(u32, u32)>,
}

impl Sets {
    /// The sets of a primitive; empty where it cannot be skinned.
    pub fn of(primitive: &Primitive) -> Self {
        let get = |semantic| primitive.attributes.get(&Checked::Valid(semantic));
        let set = |n: u32| {
            let (joints, weights) = (get(Semantic::Joints(n))?, get(Semantic::Weights(n))?);
            Some((joints.value() as u32, weights.value() as u32))
        };
        Self { sets: (0..=SETS_MAX as u32).map_while(set).collect() }
    }

    /// The sets of a compressed primitive, by the names of its attributes.
    pub fn of_names(ids: &std::collections::BTreeMap<String, u32>) -> Self {
        let set = |n: u32| {
            let get = |name: &str| ids.get(&format!("{name}_{n}")).copied();
            Some((get("JOINTS")?, get("WEIGHTS")?))
        };
        Self { sets: (0..=SETS_MAX as u32).map_while(set).collect() }
    }
}

/// Which joints the vertices of a body follow: `width` of them a vertex.
#[derive(Debug)]
pub struct Influences {
    width: usize,
    joints: Vec<u32>,
    /// Not negative; those of a vertex have the sum 1.
    weights: Vec<f32>,
}

impl Influences {
    /// Joints and weights of some vertices from the accessors of a primitive.
    pub fn read(
        accessors: &Accessors,
        sets: &Sets,
        chosen: &[u32],
        vertices: usize,
        joints: usize,
    ) -> Result<Self, SceneError> {
        if sets.sets.len() > SETS_MAX {
            let property = format!("JOINTS_{SETS_MAX}: the set beyond the last that is read");
            return Err(Cause::InvalidValue { property }.into());
        }
        let mut read = Vec::with_capacity(sets.sets.len());
        for &(joints, weights) in &sets.sets {
            let mut columns = Vec::with_capacity(2);
            for (accessor, use_as) in [(joints, &JOINTS), (weights, &WEIGHTS)] {
                let elements = accessors.elements(accessor, use_as)?;
                if elements.count != vertices {
                    let (count, expected) = (elements.count as u64, vertices as u64);
                    let use_as = use_as.name;
                    return Err(Cause::CountMismatch { accessor, use_as, count, expected }.into());
                }
                columns.push(elements.vectors_of::<4>(Some(chosen))?);
            }
            read.push(columns);
        }
        let at = |vertex: usize, set: usize, column: usize| read[set][column][vertex];
        Self::gather(chosen, sets.sets.len(), joints, at)
    }

    /// Joints and weights of some vertices from decoded attributes, of four numbers a vertex: joints
    /// and weights of each set in turn.
    pub fn of_columns(
        columns: &[Vec<[f32; 4]>],
        chosen: &[u32],
        joints: usize,
    ) -> Result<Self, SceneError> {
        let at = |vertex: usize, set: usize, column: usize| {
            columns[2 * set + column][chosen[vertex] as usize]
        };
        Self::gather(chosen, columns.len() / 2, joints, at)
    }

    fn gather(
        chosen: &[u32],
        sets: usize,
        joints: usize,
        at: impl Fn(usize, usize, usize) -> [f32; 4],
    ) -> Result<Self, SceneError> {
        let width = 4 * sets;
        let mut out = Self { width, joints: vec![], weights: vec![] };
        out.joints.reserve(width * chosen.len());
        out.weights.reserve(width * chosen.len());
        for (vertex, &number) in chosen.iter().enumerate() {
            let first = out.weights.len();
            for set in 0..sets {
                let (follows, weights) = (at(vertex, set, 0), at(vertex, set, 1));
                for k in 0..4 {
                    let (joint, weight) = (follows[k] as u32, weights[k]);
                    // A joint of weight zero may be anything.
                    let exists = (joint as usize) < joints || weight == 0.0;
                    if !(exists && weight >= 0.0 && weight.is_finite()) {
                        let (vertex, joints) = (number, joints as u64);
                        return Err(Cause::VertexJoint { vertex, joint, weight, joints }.into());
                    }
                    out.joints.push(if weight == 0.0 { 0 } else { joint });
                    out.weights.push(weight);
                }
            }
            let sum: f64 = out.weights[first..].iter().map(|&w| f64::from(w)).sum();
            if sum == 0.0 {
                let joint = at(vertex, 0, 0)[0] as u32;
                if joint as usize >= joints {
                    let (vertex, joints) = (number, joints as u64);
                    return Err(Cause::VertexJoint { vertex, joint, weight: 0.0, joints }.into());
                }
                (out.joints[first], out.weights[first]) = (joint, 1.0);
            } else {
                for weight in &mut out.weights[first..] {
                    *weight = (f64::from(*weight) / sum) as f32;
                }
            }
        }
        Ok(out)
    }

    /// The joints that a vertex follows, and how much: above 0.
    pub fn of(&self, vertex: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        let range = vertex * self.width..(vertex + 1) * self.width;
        let joints = self.joints[range.clone()].iter().map(|&j| j as usize);
        joints.zip(self.weights[range].iter().map(|&w| f64::from(w))).filter(|(_, w)| *w > 0.0)
    }

    /// A vertex under the joints' maps: the mean of where they take it.
    pub fn place(&self, vertex: usize, maps: &[DAffine3], position: DVec3) -> DVec3 {
        // Rounded weights do not add up to 1 exactly: far from the origin that would show.
        let (mut sum, mut total) = (DVec3::ZERO, 0.0);
        for (joint, weight) in self.of(vertex) {
            sum += weight * maps[joint].transform_point3(position);
            total += weight;
        }
        sum / total
    }
}
