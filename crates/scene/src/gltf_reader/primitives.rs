//! Triangles of glTF primitives: one body in memory for each distinct primitive.
//!
//! Two primitives share a body when their triangles are the same by construction: same position
//! accessor, index accessor and mode (or the same compressed data), same morph targets and
//! weights, and, for instances whose transform is singular, the same linear part.
//!
//! An instance's transform must be invertible. A scale of zero on one axis flattens a mesh that
//! may still be seen, so such an instance gets a body of its own with the transform's linear
//! part applied; what collapses to a line or a point is degenerate and dropped.

use std::collections::HashMap;

use glam::{DAffine3, DMat3, DVec3};
use gltf::{
    json::{self, mesh::Mode, validation::Checked},
    mesh::Semantic,
};
use rayon::prelude::*;
use sightline_geometry::Mesh;

use super::{
    MAX_COORDINATE,
    accessors::{Accessors, INDICES, POSITIONS},
    document::{Document, extension},
    draco::{self, Decoded, DracoPrimitive},
    nodes::{Placed, Warnings},
};
use crate::{
    Cause, DegenerateTriangles, MeshSource, OpenOptions, SceneError, SkippedPrimitives,
    degenerate::is_degenerate, report::LISTED_DEGENERATE_TRIANGLES,
};

/// What makes the triangles of a body.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct Key {
    source: Source,
    /// Position accessors of morph targets and the bits of their weights, zeros left out.
    morph: Vec<(u32, u32)>,
    /// Bits of the linear part of a singular transform, by columns.
    flatten: Option<[u64; 9]>,
}

#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
enum Source {
    Plain { positions: u32, indices: Option<u32>, topology: Topology },
    Draco { view: u32, position: u32 },
}

#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
enum Topology {
    Triangles,
    Strip,
    Fan,
}

/// A body that is to be read, named after the first primitive that needs it.
struct Job {
    mesh: u32,
    primitive: u32,
    key: Key,
}

/// A body of triangles in memory.
pub struct Body {
    /// The triangles.
    pub mesh: Mesh,
    /// Where they come from.
    pub source: MeshSource,
}

/// One placement of a body.
pub struct PlacedBody {
    /// Index into [`Unique::bodies`].
    pub body: u32,
    /// Index into [`Placed::placements`].
    pub placement: u32,
    /// Number within EXT_mesh_gpu_instancing.
    pub gpu_instance: Option<u32>,
    /// Index into the `primitives` of the glTF mesh.
    pub primitive: u32,
    /// World from body, invertible.
    pub world_from_mesh: DAffine3,
}

/// All bodies and where they stand.
pub struct Unique {
    /// Bodies with at least one triangle.
    pub bodies: Vec<Body>,
    /// Their placements, by ascending placement, instance and primitive.
    pub instances: Vec<PlacedBody>,
    pub degenerate: Vec<DegenerateTriangles>,
    pub skipped: SkippedPrimitives,
    pub flattened_instances: u64,
    pub warnings: Vec<String>,
}

/// Reads every body that the placements need.
pub fn collect(
    document: &Document,
    accessors: &Accessors,
    placed: &Placed,
    options: &OpenOptions,
) -> Result<Unique, SceneError> {
    let mut survey = Survey::default();
    for (index, placement) in placed.placements.iter().enumerate() {
        survey
            .placement(document, accessors, placed, index as u32)
            .map_err(|e| e.at_node(placement.node as usize))?;
    }
    let Survey { jobs, mut instances, skipped, flattened, warnings, .. } = survey;
    check_size(&jobs, accessors, options)?;

    // Bodies are numbered by the first glTF primitive that needs them, whatever node came first.
    let mut order: Vec<usize> = (0..jobs.len()).collect();
    order.sort_unstable_by_key(|&j| (jobs[j].mesh, jobs[j].primitive, &jobs[j].key));
    let read: Vec<Result<Read, SceneError>> = order
        .par_iter()
        .map(|&j| {
            let job = &jobs[j];
            read(job, accessors)
                .map_err(|e| e.at_primitive(job.mesh as usize, job.primitive as usize))
        })
        .collect();

    let mut out = Unique {
        bodies: Vec::new(),
        instances: Vec::new(),
        degenerate: Vec::new(),
        skipped,
        flattened_instances: flattened,
        warnings: Vec::new(),
    };
    let mut warnings: Warnings = warnings;
    const EMPTY: u32 = u32::MAX;
    let mut body_of_job = vec![EMPTY; jobs.len()];
    for (&j, read) in order.iter().zip(read) {
        // The first error in the order of the file, whichever thread met one first.
        let read = read?;
        if read.odd_indices {
            let sentence = "indices at the end of a primitive make no triangle";
            warnings.add(sentence, || {
                format!("mesh {}, primitive {}", jobs[j].mesh, jobs[j].primitive)
            });
        }
        out.degenerate.extend(read.degenerate);
        if let Some(body) = read.body {
            body_of_job[j] = out.bodies.len() as u32;
            out.bodies.push(body);
        }
    }
    instances.retain_mut(|i| {
        i.body = body_of_job[i.body as usize];
        i.body != EMPTY
    });
    out.instances = instances;
    out.warnings = warnings.sentences();
    Ok(out)
}

/// What the placements need, before anything is read.
#[derive(Default)]
struct Survey {
    jobs: Vec<Job>,
    job_of_key: HashMap<Key, u32>,
    instances: Vec<PlacedBody>,
    /// Keys of primitives by mesh, for meshes without a node's own weights.
    keys_of_mesh: HashMap<u32, Vec<Option<Key>>>,
    skipped: SkippedPrimitives,
    flattened: u64,
    warnings: Warnings,
}

impl Survey {
    fn placement(
        &mut self,
        document: &Document,
        accessors: &Accessors,
        placed: &Placed,
        index: u32,
    ) -> Result<(), SceneError> {
        let placement = &placed.placements[index as usize];
        let mesh = placement.mesh;
        if !self.keys_of_mesh.contains_key(&mesh) {
            let keys = self.keys(document, accessors, mesh)?;
            self.keys_of_mesh.insert(mesh, keys);
        }
        let mut keys = self.keys_of_mesh[&mesh].clone();
        if let Some(weights) = &document.nodes[placement.node as usize].weights {
            for (key, primitive) in keys.iter_mut().zip(&document.meshes[mesh as usize].primitives)
            {
                if let Some(key) = key {
                    key.morph = morph(primitive, weights);
                }
            }
        }
        // One look-up a primitive, not one an instance; none where every instance is flattened.
        let mut jobs: Vec<Option<u32>> = vec![None; keys.len()];
        for (i, transform) in placement.transforms.iter().enumerate() {
            let flatten = flattening(transform);
            for (p, key) in keys.iter().enumerate() {
                let Some(key) = key else { continue };
                let (job, world_from_mesh) = match flatten {
                    None => {
                        let job = match jobs[p] {
                            Some(job) => job,
                            None => *jobs[p].insert(self.job(mesh, p as u32, key.clone())),
                        };
                        (job, *transform)
                    }
                    Some(_) => {
                        self.flattened += 1;
                        let job = self.job(mesh, p as u32, Key { flatten, ..key.clone() });
                        (job, DAffine3::from_translation(transform.translation))
                    }
                };
                self.instances.push(PlacedBody {
                    body: job,
                    placement: index,
                    gpu_instance: placement.gpu_instanced.then_some(i as u32),
                    primitive: p as u32,
                    world_from_mesh,
                });
            }
        }
        Ok(())
    }

    /// The number of the job for a key; the job is named after its lowest primitive.
    fn job(&mut self, mesh: u32, primitive: u32, key: Key) -> u32 {
        let next = self.jobs.len() as u32;
        let job = *self.job_of_key.entry(key.clone()).or_insert(next);
        if job == next {
            self.jobs.push(Job { mesh, primitive, key });
        } else {
            let named = &mut self.jobs[job as usize];
            (named.mesh, named.primitive) = (named.mesh, named.primitive).min((mesh, primitive));
        }
        job
    }

    /// The keys of a mesh's primitives; `None` for those without triangles.
    fn keys(
        &mut self,
        document: &Document,
        accessors: &Accessors,
        mesh: u32,
    ) -> Result<Vec<Option<Key>>, SceneError> {
        let json = &document.meshes[mesh as usize];
        let mut keys = Vec::with_capacity(json.primitives.len());
        for (p, primitive) in json.primitives.iter().enumerate() {
            let source = self
                .source(document, accessors, primitive)
                .map_err(|e| e.at_primitive(mesh as usize, p))?;
            let weights = json.weights.as_deref().unwrap_or(&[]);
            let morph = morph(primitive, weights);
            keys.push(source.map(|source| Key { source, morph, flatten: None }));
        }
        Ok(keys)
    }

    fn source(
        &mut self,
        document: &Document,
        accessors: &Accessors,
        primitive: &json::mesh::Primitive,
    ) -> Result<Option<Source>, SceneError> {
        let topology = match primitive.mode {
            Checked::Invalid => {
                return Err(Cause::InvalidValue { property: "`mode`".into() }.into());
            }
            Checked::Valid(Mode::Points) => {
                self.skipped.points += 1;
                return Ok(None);
            }
            Checked::Valid(Mode::Lines | Mode::LineLoop | Mode::LineStrip) => {
                self.skipped.lines += 1;
                return Ok(None);
            }
            Checked::Valid(Mode::Triangles) => Topology::Triangles,
            Checked::Valid(Mode::TriangleStrip) => Topology::Strip,
            Checked::Valid(Mode::TriangleFan) => Topology::Fan,
        };
        if let Some(material) = &primitive.material {
            let material = material.value() as u32;
            Document::get(&document.materials, "material", material, || "`material`".into())?;
        }
        let Some(positions) = primitive.attributes.get(&Checked::Valid(Semantic::Positions)) else {
            self.skipped.without_positions += 1;
            return Ok(None);
        };
        let positions = positions.value() as u32;
        let others = primitive.extensions.as_ref().map(|e| &e.others);
        if let Some(draco) = extension::<DracoPrimitive>(others, draco::NAME)? {
            // A primitive whose accessors have data of their own needs no decoder.
            let has_data = |index: u32, name: &str| -> Result<bool, SceneError> {
                Ok(accessors.get(index, || name.to_owned())?.buffer_view.is_some())
            };
            let mut fallback = has_data(positions, "POSITION")?;
            if let Some(indices) = &primitive.indices {
                fallback &= has_data(indices.value() as u32, "indices")?;
            }
            if !fallback {
                let Some(&position) = draco.attributes.get("POSITION") else {
                    let reason = "its attributes have no POSITION".into();
                    return Err(Cause::ExtensionMalformed { extension: draco::NAME, reason }.into());
                };
                return Ok(Some(Source::Draco { view: draco.buffer_view, position }));
            }
        }
        let indices = primitive.indices.as_ref().map(|i| i.value() as u32);
        Ok(Some(Source::Plain { positions, indices, topology }))
    }
}

/// Morph targets that move vertices at rest.
fn morph(primitive: &json::mesh::Primitive, weights: &[f32]) -> Vec<(u32, u32)> {
    let targets = primitive.targets.as_deref().unwrap_or(&[]);
    let moving = targets.iter().zip(weights).filter(|(_, w)| **w != 0.0);
    moving.filter_map(|(t, w)| Some((t.positions.as_ref()?.value() as u32, w.to_bits()))).collect()
}

/// The linear part of a transform that cannot be inverted, `None` for those that can.
fn flattening(transform: &DAffine3) -> Option<[u64; 9]> {
    /// A volume this much smaller than the box of its edges is rounding: composing a few
    /// rotations with a scale of zero leaves about 1e-16.
    const FLAT: f64 = 1e-12;
    let m = transform.matrix3;
    let volume = m.x_axis.length() * m.y_axis.length() * m.z_axis.length();
    let determinant = m.determinant().abs();
    let invertible = determinant > FLAT * volume && transform.inverse().is_finite();
    (!invertible).then(|| m.to_cols_array().map(f64::to_bits))
}

/// Triangles in bodies of flattened instances that a scene may have. Each such instance takes
/// memory and time of its own, so a scale of zero on a forest must not cost what a forest does.
const MAX_FLATTENED_TRIANGLES: u64 = 1 << 20;

/// Triangles that a Draco body counts for before it is decoded.
const DRACO_GUESS: u64 = 1 << 14;

/// Refuses scenes that would take more memory than is allowed.
fn check_size(
    jobs: &[Job],
    accessors: &Accessors,
    options: &OpenOptions,
) -> Result<(), SceneError> {
    let (mut count, mut flattened) = (0u64, 0u64);
    for job in jobs {
        let triangles = match job.key.source {
            Source::Plain { positions, indices, topology } => {
                let corners = accessors.get(indices.unwrap_or(positions), || {
                    format!("mesh {}, primitive {}", job.mesh, job.primitive)
                })?;
                let corners = corners.count.0;
                if topology == Topology::Triangles { corners / 3 } else { corners }
            }
            Source::Draco { .. } => DRACO_GUESS,
        };
        count = count.saturating_add(triangles);
        if job.key.flatten.is_some() {
            flattened = flattened.saturating_add(triangles);
        }
    }
    let limit = options.max_unique_triangles;
    if count > limit {
        return Err(Cause::TooManyUniqueTriangles { count, limit }.into());
    }
    let limit = MAX_FLATTENED_TRIANGLES;
    if flattened > limit {
        return Err(Cause::TooManyFlattened { count: flattened, limit }.into());
    }
    Ok(())
}

/// What reading a job gives.
struct Read {
    body: Option<Body>,
    degenerate: Option<DegenerateTriangles>,
    odd_indices: bool,
}

fn read(job: &Job, accessors: &Accessors) -> Result<Read, SceneError> {
    let mut chosen = None;
    let (mut positions, corners) = match job.key.source {
        Source::Plain { positions, indices, topology } => {
            let elements = accessors.elements(positions, &POSITIONS)?;
            let mut corners = corners(accessors, indices, topology, elements.count)?;
            chosen = choose_vertices(&mut corners.triangles, elements.count);
            (elements.vectors_of::<3>(chosen.as_deref())?, corners)
        }
        Source::Draco { view, position } => {
            let view = accessors.view(view, || draco::NAME.into())?;
            let Decoded { positions, triangles } = draco::decode(view.bytes, position)?;
            let vertices = positions.len();
            let outside = |&v: &u32| v as usize >= vertices;
            if let Some(at) = triangles.as_flattened().iter().position(outside) {
                let index = triangles.as_flattened()[at];
                let (at, vertices) = (at as u64, vertices as u64);
                return Err(Cause::IndexOutOfRange { at, index, vertices }.into());
            }
            (positions, Corners { triangles, odd: false })
        }
    };
    for &(accessor, weight) in &job.key.morph {
        displace(accessors, &mut positions, chosen.as_deref(), accessor, f32::from_bits(weight))?;
    }
    if let Some(columns) = job.key.flatten {
        let linear = DMat3::from_cols_array(&columns.map(f64::from_bits));
        for p in &mut positions {
            let q = linear * DVec3::from_array(p.map(f64::from));
            *p = q.to_array().map(|v| v as f32);
        }
    }
    let odd_indices = corners.odd;
    check_positions(&positions, chosen.as_deref(), &corners.triangles)?;
    let (body, degenerate) = body(job, positions, corners.triangles);
    Ok(Read { body, degenerate, odd_indices })
}

/// For a primitive that uses few of its vertices: those that it uses, ascending; renumbers the
/// triangles. Files exist in which thousands of primitives share one array of all vertices of the
/// scene, which must not be read once a primitive.
fn choose_vertices(triangles: &mut [[u32; 3]], vertices: usize) -> Option<Vec<u32>> {
    let corners = triangles.as_flattened_mut();
    if corners.len() >= vertices / 4 {
        return None;
    }
    let mut chosen = corners.to_vec();
    chosen.sort_unstable();
    chosen.dedup();
    for corner in corners {
        // Every corner is among them: the position found is the number of smaller ones.
        *corner = chosen.partition_point(|v| v < corner) as u32;
    }
    Some(chosen)
}

/// Vertex indices a triangle, in the order of the primitive.
struct Corners {
    triangles: Vec<[u32; 3]>,
    /// True when indices were left over.
    odd: bool,
}

/// Triangles of a primitive. Source: section 3.7.2.1 of the specification: a strip's triangle i
/// is (i, i + 1 + i % 2, i + 2 - i % 2), a fan's is (i + 1, i + 2, 0).
fn corners(
    accessors: &Accessors,
    indices: Option<u32>,
    topology: Topology,
    vertices: usize,
) -> Result<Corners, SceneError> {
    let list = match indices {
        Some(accessor) => {
            let elements = accessors.elements(accessor, &INDICES)?;
            let list = elements.integers()?;
            let restart = (u64::MAX >> (64 - 8 * elements.component.size())) as u32;
            for (at, &index) in list.iter().enumerate() {
                let at = at as u64;
                if index == restart {
                    return Err(Cause::PrimitiveRestart { at, index }.into());
                }
                if index as usize >= vertices {
                    let vertices = vertices as u64;
                    return Err(Cause::IndexOutOfRange { at, index, vertices }.into());
                }
            }
            Some(list)
        }
        None => None,
    };
    let count = list.as_ref().map_or(vertices, Vec::len);
    let limit = u64::from(u32::MAX);
    if count as u64 >= limit {
        return Err(Cause::TooManyTriangles { count: count as u64, limit }.into());
    }
    let at = |i: usize| list.as_ref().map_or(i as u32, |l| l[i]);
    let strips = count.saturating_sub(2);
    let triangles: Vec<[u32; 3]> = match topology {
        Topology::Triangles => {
            (0..count / 3).map(|i| [at(3 * i), at(3 * i + 1), at(3 * i + 2)]).collect()
        }
        Topology::Strip => {
            (0..strips).map(|i| [at(i), at(i + 1 + i % 2), at(i + 2 - i % 2)]).collect()
        }
        Topology::Fan => (0..strips).map(|i| [at(i + 1), at(i + 2), at(0)]).collect(),
    };
    let odd = match topology {
        Topology::Triangles => !count.is_multiple_of(3),
        Topology::Strip | Topology::Fan => count > 0 && count < 3,
    };
    Ok(Corners { triangles, odd })
}

/// Adds a weighted morph target.
fn displace(
    accessors: &Accessors,
    positions: &mut [[f32; 3]],
    chosen: Option<&[u32]>,
    accessor: u32,
    weight: f32,
) -> Result<(), SceneError> {
    let elements = accessors.elements(accessor, &POSITIONS)?;
    let expected = chosen.map_or(positions.len(), |c| c.last().map_or(0, |&v| v as usize + 1));
    let enough = match chosen {
        None => elements.count == expected,
        Some(_) => elements.count >= expected,
    };
    if !enough {
        let (count, expected) = (elements.count as u64, expected as u64);
        let use_as = "POSITION of a morph target";
        return Err(Cause::CountMismatch { accessor, use_as, count, expected }.into());
    }
    for (p, d) in positions.iter_mut().zip(elements.vectors_of::<3>(chosen)?) {
        for k in 0..3 {
            p[k] = (f64::from(p[k]) + f64::from(weight) * f64::from(d[k])) as f32;
        }
    }
    Ok(())
}

/// Refuses triangles whose corners are not finite or absurdly far away.
fn check_positions(
    positions: &[[f32; 3]],
    chosen: Option<&[u32]>,
    triangles: &[[u32; 3]],
) -> Result<(), SceneError> {
    let near = |p: &[f32; 3]| p.iter().all(|v| f64::from(v.abs()) <= MAX_COORDINATE);
    let found = triangles.as_flattened().iter().find(|&&v| !near(&positions[v as usize]));
    let Some(&vertex) = found else { return Ok(()) };
    let position = positions[vertex as usize];
    let vertex = chosen.map_or(vertex, |c| c[vertex as usize]);
    Err(if position.iter().all(|v| v.is_finite()) {
        Cause::PositionTooFar { vertex, position, limit: MAX_COORDINATE }.into()
    } else {
        Cause::PositionNotFinite { vertex, position }.into()
    })
}

/// Drops degenerate triangles, builds the hierarchy, and renumbers vertices by first use.
fn body(
    job: &Job,
    positions: Vec<[f32; 3]>,
    mut triangles: Vec<[u32; 3]>,
) -> (Option<Body>, Option<DegenerateTriangles>) {
    let (mesh, primitive) = (job.mesh, job.primitive);
    let mut dropped = DegenerateTriangles { mesh, primitive, count: 0, triangles: Vec::new() };
    let mut kept: Vec<u32> = Vec::with_capacity(triangles.len());
    let mut number = 0;
    triangles.retain(|t| {
        let degenerate = is_degenerate(t.map(|v| positions[v as usize]));
        if !degenerate {
            kept.push(number);
        } else {
            dropped.count += 1;
            if dropped.triangles.len() < LISTED_DEGENERATE_TRIANGLES {
                dropped.triangles.push(number);
            }
        }
        number += 1;
        !degenerate
    });
    let body = (!triangles.is_empty()).then(|| {
        let (mut out, order) = Mesh::new(positions, &triangles);
        renumber_vertices(&mut out);
        let triangles = order.iter().map(|&t| kept[t as usize]).collect();
        Body { mesh: out, source: MeshSource { mesh, primitive, triangles } }
    });
    (body, (dropped.count > 0).then_some(dropped))
}

/// Puts vertices in the order in which the triangles use them; drops the others.
fn renumber_vertices(mesh: &mut Mesh) {
    const UNUSED: u32 = u32::MAX;
    let mut new_number = vec![UNUSED; mesh.positions.len()];
    let mut positions = Vec::new();
    for v in mesh.triangles.as_flattened_mut() {
        let number = &mut new_number[*v as usize];
        if *number == UNUSED {
            *number = positions.len() as u32;
            positions.push(mesh.positions[*v as usize]);
        }
        *v = *number;
    }
    positions.shrink_to_fit();
    mesh.positions = positions;
}
