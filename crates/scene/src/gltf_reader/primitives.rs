//! Triangles of glTF primitives: one body in memory for each distinct primitive.
//!
//! Two primitives share a body when their triangles are the same by construction: same position
//! accessor, index accessor and mode (or the same compressed data), same morph targets and
//! weights, and, for instances whose transform is singular, the same linear part.
//!
//! An instance's transform must be invertible. A scale of zero on one axis flattens a mesh that
//! may still be seen, so such an instance gets a body of its own with the transform's linear
//! part applied; what collapses to a line or a point is degenerate and dropped.
//!
//! What moves: an instance whose node moves has a transform a key frame. A body whose vertices move on
//! their own, by a skin or by weights of morph targets, is one of its node alone and has positions
//! a key frame; skins are in the world, so they are their own even at rest. Key frames are chosen when
//! the boxes of all that moves are known. A moving transform may be singular at a key frame, or at all
//! of them: then the instance stays as it is, but for one whose triangles are lines or points at every key frame,
//! which is dropped.

use std::{
    collections::{BTreeMap, HashMap},
    sync::Arc,
};

use glam::{DAffine3, DMat3, DVec3};
use gltf::{
    json::{self, mesh::Mode, validation::Checked},
    mesh::Semantic,
};
use rayon::prelude::*;
use sightline_geometry::{Bounds, Mesh};

use super::{
    MAX_COORDINATE,
    accessors::{Accessors, INDICES, POSITIONS},
    animation::{
        Animations,
        bend::{Mover, Part},
        deform::{Soft, corners as corners_of},
        key_frames::{self, KeyFrames},
        rig::Rig,
        skin::{Influences, Sets, Skin},
    },
    document::{Document, extension},
    draco::{self, Decoded, DracoPrimitive},
    nodes::{Placed, Warnings},
};
use crate::{
    Cause, DegenerateTriangles, Keeper, MemoryLimit, MeshSource, OpenOptions, SceneError,
    SkippedPrimitives,
    degenerate::is_degenerate,
    memory::{self, StoredBody},
    particles::merge_key_times,
    report::LISTED_DEGENERATE_TRIANGLES,
};

/// What makes the triangles of a body.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct Key {
    source: Source,
    /// Position accessors of morph targets and the bits of their weights, zeros left out.
    morph: Vec<(u32, u32)>,
    /// Bits of the linear part of a singular transform, by columns.
    flatten: Option<[u64; 9]>,
    /// What moves the vertices.
    deform: Option<Deform>,
}

/// What moves the vertices of a body on their own.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct Deform {
    /// The node that shows it, alone.
    node: u32,
    /// Index into `skins`, and where joints and weights are.
    skin: Option<(u32, Sets)>,
    /// Numbers of the morph targets with positions, and their accessors, where weights change.
    targets: Vec<(u32, u32)>,
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
    /// World from body at the first key frame; invertible where `motion` is `None`.
    pub world_from_mesh: DAffine3,
    /// World from body at every key frame, where it changes.
    pub motion: Option<Box<[DAffine3]>>,
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
    /// Times of the key frames, seconds.
    pub key_times: Vec<f64>,
    /// Number of times at which something jumps.
    pub jumps: u64,
    pub warnings: Vec<String>,
}

/// Reads every body that the placements need, and places all at the key frames. `table_times` are the
/// key times of the particle tables of the scene.
pub fn collect(
    document: &Document,
    accessors: &Accessors,
    placed: &Placed,
    animations: &Animations,
    table_times: &[&[f64]],
    options: &OpenOptions,
    chunks: Option<&Chunks>,
) -> Result<Unique, SceneError> {
    let mut survey = Survey::default();
    for index in 0..placed.placements.len() {
        let place = Place { document, accessors, placed, animations };
        survey
            .placement(&place, index as u32)
            .map_err(|e| e.at_node(placed.placements[index].node as usize))?;
    }
    let Survey { jobs, mut instances, skipped, flattened, mut warnings, skins, .. } = survey;
    check_size(&jobs, accessors, options)?;

    // Bodies are numbered by the first glTF primitive that needs them, whatever node came first.
    let mut order: Vec<usize> = (0..jobs.len()).collect();
    order.sort_unstable_by_key(|&j| (jobs[j].mesh, jobs[j].primitive, &jobs[j].key));
    let deforming = Deforming { skins, animations };
    let reading = Reading { jobs: &jobs, accessors, deforming: &deforming };
    let mut notes = Vec::new();
    let read: Vec<Read> = match chunks {
        None => reading.all(&order)?,
        Some(chunks) => reading.into_chunks(&order, chunks, &mut notes)?,
    };
    let mut read_of_job = vec![0; jobs.len()];
    for (r, &j) in order.iter().enumerate() {
        read_of_job[j] = r;
    }

    let movers = movers(&jobs, &read, &read_of_job, &instances, placed);
    let KeyFrames { times, jumps } =
        key_frames::choose(&placed.rig, movers, animations.duration, options)?;
    // What moves has the key frames of all that moves.
    let times = if times.len() > 1 {
        merge_key_times(&[&[times.as_slice()], table_times].concat())
    } else {
        times
    };
    check_moving(&read, &instances, placed, times.len(), options)?;

    let mut out = Unique {
        bodies: Vec::new(),
        instances: Vec::new(),
        degenerate: Vec::new(),
        skipped,
        flattened_instances: flattened,
        key_times: times,
        jumps,
        warnings: Vec::new(),
    };
    let built: Vec<Result<Built, SceneError>> = order
        .par_iter()
        .zip(read)
        .map(|(&j, read)| {
            let job = &jobs[j];
            build(job, read, &placed.rig, &out.key_times)
                .map_err(|e| e.at_primitive(job.mesh as usize, job.primitive as usize))
        })
        .collect();
    const EMPTY: u32 = u32::MAX;
    let mut body_of_job = vec![EMPTY; jobs.len()];
    let mut centers = Vec::new();
    for (&j, built) in order.iter().zip(built) {
        let built = built?;
        if built.odd_indices {
            let sentence = "indices at the end of a primitive make no triangle";
            warnings.add(sentence, || {
                format!("mesh {}, primitive {}", jobs[j].mesh, jobs[j].primitive)
            });
        }
        out.degenerate.extend(built.degenerate);
        if let Some(body) = built.body {
            body_of_job[j] = out.bodies.len() as u32;
            out.bodies.push(body);
            centers.push(built.center);
        }
    }
    instances.retain_mut(|i| {
        i.body = body_of_job[i.body as usize];
        i.body != EMPTY
    });
    for instance in &mut instances {
        let center = centers[instance.body as usize];
        if center != DVec3::ZERO {
            instance.world_from_mesh *= DAffine3::from_translation(center);
        }
    }
    move_instances(&mut instances, placed, &out.key_times, &mut warnings)?;
    out.instances = instances;
    out.drop_unplaced_bodies();
    out.rest_without_motion();
    out.warnings = warnings.sentences();
    out.warnings.extend(notes);
    Ok(out)
}

impl Unique {
    /// Bodies whose instances were all dropped.
    fn drop_unplaced_bodies(&mut self) {
        let mut is_placed = vec![false; self.bodies.len()];
        for instance in &self.instances {
            is_placed[instance.body as usize] = true;
        }
        if is_placed.iter().all(|&p| p) {
            return;
        }
        let mut number = vec![0; is_placed.len()];
        let mut next = 0;
        for (number, &is_placed) in number.iter_mut().zip(&is_placed) {
            *number = next;
            next += u32::from(is_placed);
        }
        let mut keep = is_placed.into_iter();
        self.bodies.retain(|_| keep.next().unwrap_or(true));
        for instance in &mut self.instances {
            instance.body = number[instance.body as usize];
        }
    }

    /// One key frame where the key frames turned out to be equal.
    fn rest_without_motion(&mut self) {
        let moves = self.bodies.iter().any(|b| b.mesh.motion.is_some())
            || self.instances.iter().any(|i| i.motion.is_some());
        if !moves {
            self.key_times.truncate(1);
        }
    }
}

/// What moves, for the choice of the key frames.
fn movers(
    jobs: &[Job],
    read: &[Read],
    read_of_job: &[usize],
    instances: &[PlacedBody],
    placed: &Placed,
) -> Vec<Mover> {
    // The boxes of what a node carries, and the instances of bodies that deform.
    let mut boxes: BTreeMap<u32, Bounds> = BTreeMap::new();
    let mut soft: BTreeMap<u32, (Option<u32>, Vec<DAffine3>)> = BTreeMap::new();
    for instance in instances {
        let carrier = placed.placements[instance.placement as usize].carrier;
        match &read[read_of_job[instance.body as usize]].content {
            Content::Body(Some(body)) => {
                if let Some(carrier) = carrier {
                    let bounds = body.mesh.bounds.transformed(&instance.world_from_mesh);
                    let all = boxes.entry(carrier).or_insert(Bounds::EMPTY);
                    *all = all.union(bounds);
                }
            }
            Content::Body(None) => {}
            Content::Soft { .. } => {
                let flatten = jobs[instance.body as usize].key.flatten.map(linear_part);
                let linear = flatten.unwrap_or(DMat3::IDENTITY);
                let map = instance.world_from_mesh * DAffine3::from_mat3(linear);
                let entry = soft.entry(instance.body).or_insert_with(|| (carrier, vec![]));
                entry.1.push(map);
            }
        }
    }
    let rigid = boxes.into_iter().map(|(node, bounds)| Mover {
        part: Part::Node(node),
        base: corners_of(bounds).collect(),
        terms: vec![],
        weights: None,
        stretch: 1.0,
    });
    let mut movers: Vec<Mover> = rigid.collect();
    for (job, (carrier, maps)) in soft {
        if let Content::Soft { soft, .. } = &read[read_of_job[job as usize]].content {
            movers.extend(soft.movers(&placed.rig, carrier, &maps));
        }
    }
    movers
}

/// Refuses scenes whose moving parts would take more memory than is allowed.
fn check_moving(
    read: &[Read],
    instances: &[PlacedBody],
    placed: &Placed,
    keys: usize,
    options: &OpenOptions,
) -> Result<(), SceneError> {
    /// A transform takes the bytes of eight positions.
    const TRANSFORM: u64 = 8;
    let moves = |i: &&PlacedBody| placed.placements[i.placement as usize].carrier.is_some();
    let transforms = TRANSFORM * instances.iter().filter(moves).count() as u64;
    let vertices = |read: &Read| match &read.content {
        Content::Soft { soft, .. } => soft.positions.len() as u64,
        Content::Body(_) => 0,
    };
    let positions: u64 = read.iter().map(vertices).sum();
    let count = (transforms + positions).saturating_mul(keys as u64);
    let limit = options.max_moving_positions;
    if count > limit { Err(Cause::TooManyMovingPositions { count, limit }.into()) } else { Ok(()) }
}

/// Gives instances that are carried their transforms at the key frames; drops those whose triangles
/// are lines or points at all of them.
fn move_instances(
    instances: &mut Vec<PlacedBody>,
    placed: &Placed,
    times: &[f64],
    warnings: &mut Warnings,
) -> Result<(), SceneError> {
    // Instances of a placement follow each other.
    let mut current = (u32::MAX, vec![]);
    let mut failed = None;
    instances.retain_mut(|instance| {
        let Some(node) = placed.placements[instance.placement as usize].carrier else {
            return true;
        };
        if current.0 != node {
            let at = |&t: &f64| placed.rig.world_from_node(node, t);
            current = (node, times.iter().map(at).collect::<Vec<_>>());
        }
        let maps: Box<[DAffine3]> =
            current.1.iter().map(|world| *world * instance.world_from_mesh).collect();
        if !maps.iter().all(|m: &DAffine3| m.is_finite()) {
            failed.get_or_insert(node);
            return true;
        }
        if maps.iter().all(|m| is_collapsed(&m.matrix3)) {
            let sentence = "an instance that a scale of zero collapses throughout is left out";
            warnings.add(sentence, || format!("node {node}"));
            return false;
        }
        instance.world_from_mesh = maps[0];
        let changes = maps.iter().any(|m| *m != maps[0]);
        instance.motion = (changes || flattening(&maps[0]).is_some()).then_some(maps);
        true
    });
    let not_finite = |n: u32| SceneError::from(Cause::TransformNotFinite).at_node(n as usize);
    failed.map_or(Ok(()), |node| Err(not_finite(node)))
}

/// True for a map onto a line or a point.
fn is_collapsed(m: &DMat3) -> bool {
    let pairs = [(m.x_axis, m.y_axis), (m.y_axis, m.z_axis), (m.z_axis, m.x_axis)];
    pairs.iter().all(|(a, b)| a.cross(*b) == DVec3::ZERO)
}

/// The file, and what moves it.
struct Place<'a> {
    document: &'a Document,
    accessors: &'a Accessors<'a>,
    placed: &'a Placed,
    animations: &'a Animations,
}

/// What bodies that deform need.
struct Deforming<'a> {
    skins: HashMap<u32, Arc<Skin>>,
    animations: &'a Animations,
}

/// What the placements need, before anything is read.
#[derive(Default)]
struct Survey {
    jobs: Vec<Job>,
    job_of_key: HashMap<Key, u32>,
    instances: Vec<PlacedBody>,
    /// Keys of primitives by mesh, for meshes without a node's own weights.
    keys_of_mesh: HashMap<u32, Vec<Option<(Key, Sets)>>>,
    skins: HashMap<u32, Arc<Skin>>,
    skipped: SkippedPrimitives,
    flattened: u64,
    warnings: Warnings,
}

impl Survey {
    fn placement(&mut self, place: &Place, index: u32) -> Result<(), SceneError> {
        let Place { document, accessors, placed, animations } = *place;
        let placement = &placed.placements[index as usize];
        let (mesh, node) = (placement.mesh, placement.node);
        if !self.keys_of_mesh.contains_key(&mesh) {
            let keys = self.keys(document, accessors, mesh)?;
            self.keys_of_mesh.insert(mesh, keys);
        }
        let mut keys = self.keys_of_mesh[&mesh].clone();
        let tracks = animations.weights(node);
        let held = tracks.map(|s| (0..s.width()).map(|k| s.number(k, 0.0) as f32).collect());
        let changing = tracks.is_some_and(|s| !s.is_constant());
        let own = held.as_ref().or(document.nodes[node as usize].weights.as_ref());
        let primitives = &document.meshes[mesh as usize].primitives;
        for (key, primitive) in keys.iter_mut().zip(primitives) {
            let Some((key, sets)) = key else { continue };
            if let Some(weights) = own {
                key.morph = morph(primitive, weights);
            }
            let targets = if changing { targets(primitive) } else { vec![] };
            if !targets.is_empty() {
                key.morph = vec![];
            }
            let skin = document.nodes[node as usize].skin.filter(|_| !sets.sets.is_empty());
            if placement.skinned && skin.is_none() {
                let sentence =
                    "a primitive without joints is shown with a skin; it is read as it is";
                self.warnings.add(sentence, || format!("node {node}, mesh {mesh}"));
            }
            if let Some(skin) = skin {
                self.skin(place, skin)?;
            }
            let skin = skin.map(|skin| (skin, std::mem::take(sets)));
            key.deform =
                (skin.is_some() || !targets.is_empty()).then_some(Deform { node, skin, targets });
        }
        let keys: Vec<Option<Key>> = keys.into_iter().map(|key| Some(key?.0)).collect();
        // One look-up a primitive, not one an instance; none where every instance is flattened.
        let mut jobs: Vec<Option<u32>> = vec![None; keys.len()];
        for (i, transform) in placement.transforms.iter().enumerate() {
            let flatten = placement.carrier.is_none().then(|| flattening(transform)).flatten();
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
                    motion: None,
                });
            }
        }
        Ok(())
    }

    /// Reads a skin that is used, once.
    fn skin(&mut self, place: &Place, number: u32) -> Result<(), SceneError> {
        if self.skins.contains_key(&number) {
            return Ok(());
        }
        let skin = Skin::read(place.document, place.accessors, number)?;
        let outside = |&node: &u32| !place.placed.rig.has(node);
        if let Some(joint) = skin.joints.iter().position(outside) {
            let node = skin.joints[joint];
            let cause = Cause::JointNotInScene { joint: joint as u64, node };
            return Err(SceneError::from(cause).at_skin(number));
        }
        self.skins.insert(number, Arc::new(skin));
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
    ) -> Result<Vec<Option<(Key, Sets)>>, SceneError> {
        let json = &document.meshes[mesh as usize];
        let mut keys = Vec::with_capacity(json.primitives.len());
        for (p, primitive) in json.primitives.iter().enumerate() {
            let source = self
                .source(document, accessors, primitive)
                .map_err(|e| e.at_primitive(mesh as usize, p))?;
            let weights = json.weights.as_deref().unwrap_or(&[]);
            let morph = morph(primitive, weights);
            let key = |(source, sets)| (Key { source, morph, flatten: None, deform: None }, sets);
            keys.push(source.map(key));
        }
        Ok(keys)
    }

    fn source(
        &mut self,
        document: &Document,
        accessors: &Accessors,
        primitive: &json::mesh::Primitive,
    ) -> Result<Option<(Source, Sets)>, SceneError> {
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
                let source = Source::Draco { view: draco.buffer_view, position };
                return Ok(Some((source, Sets::of_names(&draco.attributes))));
            }
        }
        let indices = primitive.indices.as_ref().map(|i| i.value() as u32);
        Ok(Some((Source::Plain { positions, indices, topology }, Sets::of(primitive))))
    }
}

/// Morph targets that move vertices at rest.
fn morph(primitive: &json::mesh::Primitive, weights: &[f32]) -> Vec<(u32, u32)> {
    let targets = primitive.targets.as_deref().unwrap_or(&[]);
    let moving = targets.iter().zip(weights).filter(|(_, w)| **w != 0.0);
    moving.filter_map(|(t, w)| Some((t.positions.as_ref()?.value() as u32, w.to_bits()))).collect()
}

/// Morph targets that can move vertices: their numbers and accessors.
fn targets(primitive: &json::mesh::Primitive) -> Vec<(u32, u32)> {
    let targets = primitive.targets.as_deref().unwrap_or(&[]).iter().enumerate();
    targets.filter_map(|(k, t)| Some((k as u32, t.positions.as_ref()?.value() as u32))).collect()
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
        let triangles = triangles_of(job, accessors)?;
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

/// Triangles of a job, by what its accessors say.
fn triangles_of(job: &Job, accessors: &Accessors) -> Result<u64, SceneError> {
    Ok(match job.key.source {
        Source::Plain { positions, indices, topology } => {
            let corners = accessors.get(indices.unwrap_or(positions), || {
                format!("mesh {}, primitive {}", job.mesh, job.primitive)
            })?;
            let corners = corners.count.0;
            if topology == Topology::Triangles { corners / 3 } else { corners }
        }
        Source::Draco { .. } => DRACO_GUESS,
    })
}

/// What reading a job gives.
struct Read {
    content: Content,
    degenerate: Option<DegenerateTriangles>,
    odd_indices: bool,
}

/// Triangles, or what they are made of at the key frames.
enum Content {
    Body(Option<Body>),
    Soft {
        soft: Soft,
        triangles: Vec<[u32; 3]>,
        /// Numbers of the vertices in the primitive.
        chosen: Vec<u32>,
    },
}

/// Where the triangles of what rests go when memory is limited.
pub struct Chunks<'a> {
    pub keeper: &'a Arc<Keeper>,
    pub limit: &'a MemoryLimit,
    /// What the chunk file is made from.
    pub key: blake3::Hash,
}

/// Bytes that a triangle takes while its mesh is read and its hierarchy is built, at most.
const MAKING: u64 = 320;

/// What bodies are read from.
#[derive(Clone, Copy)]
struct Reading<'a> {
    jobs: &'a [Job],
    accessors: &'a Accessors<'a>,
    deforming: &'a Deforming<'a>,
}

impl Reading<'_> {
    /// Reads some jobs. An error is the first in their order, whichever thread met one first.
    fn all(&self, order: &[usize]) -> Result<Vec<Read>, SceneError> {
        let read: Vec<Result<Read, SceneError>> = order
            .par_iter()
            .map(|&j| {
                let job = &self.jobs[j];
                read(job, self.accessors, self.deforming)
                    .map_err(|e| e.at_primitive(job.mesh as usize, job.primitive as usize))
            })
            .collect();
        read.into_iter().collect()
    }

    /// As [`Reading::all`], with the triangles of what rests in a chunk file: so many bodies at a time are
    /// in memory as an eighth of it takes.
    fn into_chunks(
        self,
        order: &[usize],
        chunks: &Chunks,
        notes: &mut Vec<String>,
    ) -> Result<Vec<Read>, SceneError> {
        let rests = |j: &usize| self.jobs[*j].key.deform.is_none();
        let resting: Vec<usize> = order.iter().copied().filter(rests).collect();
        let moving: Vec<usize> = order.iter().copied().filter(|j| !rests(j)).collect();
        let names: Vec<(u32, u32)> =
            resting.iter().map(|&j| (self.jobs[j].mesh, self.jobs[j].primitive)).collect();
        let Chunks { keeper, limit, key } = chunks;
        let (stored, note) = memory::read_or_make(limit, keeper, key, &names, |file| {
            let mut rest = &resting[..];
            while !rest.is_empty() {
                let (some, others) = rest.split_at(self.batch(rest, chunks)?);
                rest = others;
                for (read, &j) in self.all(some)?.into_iter().zip(some) {
                    file.put(&read.into_stored(&self.jobs[j]))?;
                }
                keeper.look_now();
            }
            Ok(())
        })?;
        notes.extend(note);
        let mut stored = stored.into_iter().map(Read::of_stored);
        let mut moving = self.all(&moving)?.into_iter();
        let next = |j: &usize| if rests(j) { stored.next() } else { moving.next() };
        Ok(order.iter().filter_map(next).collect())
    }

    /// How many of these jobs are read together, at least one.
    fn batch(&self, jobs: &[usize], chunks: &Chunks) -> Result<usize, SceneError> {
        let most = chunks.limit.bytes / 8;
        let mut bytes = 0;
        let mut count = 0;
        for &j in jobs {
            let own = MAKING * triangles_of(&self.jobs[j], self.accessors)?;
            if count == 0 {
                let (mesh, primitive) =
                    (self.jobs[j].mesh as usize, self.jobs[j].primitive as usize);
                let room = chunks.keeper.expect_room(own);
                room.map_err(|e| e.at_primitive(mesh, primitive))?;
            } else if bytes + own > most {
                break;
            }
            bytes += own;
            count += 1;
        }
        Ok(count)
    }
}

impl Read {
    fn into_stored(self, job: &Job) -> StoredBody {
        let body = match self.content {
            Content::Body(body) => body.map(|body| (body.mesh, body.source.triangles)),
            // Only what rests is stored.
            Content::Soft { .. } => None,
        };
        StoredBody {
            name: (job.mesh, job.primitive),
            odd_indices: self.odd_indices,
            degenerate: self.degenerate.map(|d| (d.count, d.triangles)),
            body,
        }
    }

    fn of_stored(stored: StoredBody) -> Self {
        let StoredBody { name: (mesh, primitive), odd_indices, degenerate, body } = stored;
        let degenerate = degenerate.map(|(count, triangles)| DegenerateTriangles {
            mesh,
            primitive,
            count,
            triangles,
        });
        let body = body.map(|(triangles, numbers)| Body {
            mesh: triangles,
            source: MeshSource { mesh, primitive, triangles: numbers },
        });
        Self { content: Content::Body(body), degenerate, odd_indices }
    }
}

fn linear_part(columns: [u64; 9]) -> DMat3 {
    DMat3::from_cols_array(&columns.map(f64::from_bits))
}

fn read(job: &Job, accessors: &Accessors, deforming: &Deforming) -> Result<Read, SceneError> {
    let deforms = job.key.deform.is_some();
    let mut chosen = None;
    let mut followed = vec![];
    let (mut positions, mut corners) = match job.key.source {
        Source::Plain { positions, indices, topology } => {
            let elements = accessors.elements(positions, &POSITIONS)?;
            let mut corners = corners(accessors, indices, topology, elements.count)?;
            chosen = choose_vertices(&mut corners.triangles, elements.count, deforms);
            (elements.vectors_of::<3>(chosen.as_deref())?, corners)
        }
        Source::Draco { view, position } => {
            let view = accessors.view(view, || draco::NAME.into())?;
            let sets = job.key.deform.as_ref().and_then(|d| d.skin.as_ref()).map(|(_, s)| s);
            let others: Vec<u32> =
                sets.iter().flat_map(|s| &s.sets).flat_map(|&(j, w)| [j, w]).collect();
            let Decoded { positions, triangles, others } =
                draco::decode(view.bytes, position, &others)?;
            followed = others;
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
    let vertices = positions.len();
    for &(accessor, weight) in &job.key.morph {
        displace(accessors, &mut positions, chosen.as_deref(), accessor, f32::from_bits(weight))?;
    }
    let odd_indices = corners.odd;
    if let Some(deform) = &job.key.deform {
        let used = match chosen {
            Some(chosen) => chosen,
            // Decoded data has no choice of vertices.
            None => {
                let used = choose_vertices(&mut corners.triangles, vertices, true);
                let used = used.unwrap_or_default();
                positions = used.iter().map(|&v| positions[v as usize]).collect();
                used
            }
        };
        let soft =
            soften(deform, job.key.source, accessors, deforming, positions, &used, &followed)?;
        let content = Content::Soft { soft, triangles: corners.triangles, chosen: used };
        return Ok(Read { content, degenerate: None, odd_indices });
    }
    if let Some(linear) = job.key.flatten.map(linear_part) {
        for p in &mut positions {
            let q = linear * DVec3::from_array(p.map(f64::from));
            *p = q.to_array().map(|v| v as f32);
        }
    }
    check_positions(&positions, chosen.as_deref(), &corners.triangles)?;
    let (body, degenerate) = body(job, vec![positions], corners.triangles);
    Ok(Read { content: Content::Body(body), degenerate, odd_indices })
}

/// Reads what moves the vertices of a body. `used` are the numbers of its vertices.
fn soften(
    deform: &Deform,
    source: Source,
    accessors: &Accessors,
    deforming: &Deforming,
    positions: Vec<[f32; 3]>,
    used: &[u32],
    followed: &[Vec<[f32; 4]>],
) -> Result<Soft, SceneError> {
    let mut targets = Vec::with_capacity(deform.targets.len());
    for &(number, accessor) in &deform.targets {
        let by = displacements(accessors, Some(used), used.len(), accessor)?;
        let moved = (0u32..).zip(by).filter(|(_, by)| *by != [0.0; 3]);
        targets.push((number as usize, moved.collect()));
    }
    let skin = match &deform.skin {
        None => None,
        Some((number, sets)) => {
            let skin = deforming.skins[number].clone();
            let joints = skin.joints.len();
            let influences = match source {
                Source::Plain { positions, .. } => {
                    let vertices = accessors.elements(positions, &POSITIONS)?.count;
                    Influences::read(accessors, sets, used, vertices, joints)?
                }
                Source::Draco { .. } => Influences::of_columns(followed, used, joints)?,
            };
            Some((skin, influences))
        }
    };
    let weights =
        if targets.is_empty() { None } else { deforming.animations.weights(deform.node).cloned() };
    Ok(Soft { positions, targets, weights, skin })
}

/// What building a job gives.
struct Built {
    body: Option<Body>,
    /// Mesh space from the space of the stored positions is a translation by it.
    center: DVec3,
    degenerate: Option<DegenerateTriangles>,
    odd_indices: bool,
}

/// Puts the vertices of bodies that deform where they are at the key frames.
fn build(job: &Job, read: Read, rig: &Rig, times: &[f64]) -> Result<Built, SceneError> {
    let Read { content, degenerate, odd_indices } = read;
    let (soft, triangles, chosen) = match content {
        Content::Body(body) => {
            return Ok(Built { body, center: DVec3::ZERO, degenerate, odd_indices });
        }
        Content::Soft { soft, triangles, chosen } => (soft, triangles, chosen),
    };
    let after = job.key.flatten.map(linear_part);
    // A flattened body has another space.
    let center = if after.is_some() { DVec3::ZERO } else { soft.center(rig, times) };
    let keys = soft.keys(rig, times, center, after);
    drop(soft);
    for positions in &keys {
        check_positions(positions, Some(&chosen), &triangles)?;
    }
    let (body, degenerate) = body(job, keys, triangles);
    Ok(Built { body, center, degenerate, odd_indices })
}

/// For a primitive that uses few of its vertices: those that it uses, ascending; renumbers the
/// triangles. Files exist in which thousands of primitives share one array of all vertices of the
/// scene, which must not be read once a primitive. With `always`, for any primitive.
fn choose_vertices(triangles: &mut [[u32; 3]], vertices: usize, always: bool) -> Option<Vec<u32>> {
    let corners = triangles.as_flattened_mut();
    if !always && corners.len() >= vertices / 4 {
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
    let by = displacements(accessors, chosen, positions.len(), accessor)?;
    for (p, d) in positions.iter_mut().zip(by) {
        for k in 0..3 {
            p[k] = (f64::from(p[k]) + f64::from(weight) * f64::from(d[k])) as f32;
        }
    }
    Ok(())
}

/// How far a morph target moves some vertices, or all of `vertices`.
fn displacements(
    accessors: &Accessors,
    chosen: Option<&[u32]>,
    vertices: usize,
    accessor: u32,
) -> Result<Vec<[f32; 3]>, SceneError> {
    let elements = accessors.elements(accessor, &POSITIONS)?;
    let expected = chosen.map_or(vertices, |c| c.last().map_or(0, |&v| v as usize + 1));
    let enough = match chosen {
        None => elements.count == expected,
        Some(_) => elements.count >= expected,
    };
    if !enough {
        let (count, expected) = (elements.count as u64, expected as u64);
        let use_as = "POSITION of a morph target";
        return Err(Cause::CountMismatch { accessor, use_as, count, expected }.into());
    }
    elements.vectors_of::<3>(chosen)
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

/// Drops triangles that are degenerate at all key frames, builds the hierarchy, and renumbers vertices
/// by first use. `keys` are the positions at each key frame, or one for all.
fn body(
    job: &Job,
    keys: Vec<Vec<[f32; 3]>>,
    mut triangles: Vec<[u32; 3]>,
) -> (Option<Body>, Option<DegenerateTriangles>) {
    let (mesh, primitive) = (job.mesh, job.primitive);
    let mut dropped = DegenerateTriangles { mesh, primitive, count: 0, triangles: Vec::new() };
    let mut kept: Vec<u32> = Vec::with_capacity(triangles.len());
    let mut number = 0;
    triangles.retain(|t| {
        let degenerate = keys.iter().all(|key| is_degenerate(t.map(|v| key[v as usize])));
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
        let (mut out, order) = Mesh::moving(keys, &triangles);
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
    let mut used = Vec::new();
    let mut triangles = std::mem::take(&mut mesh.triangles).into_vec();
    for v in triangles.as_flattened_mut() {
        let number = &mut new_number[*v as usize];
        if *number == UNUSED {
            *number = used.len() as u32;
            used.push(*v);
        }
        *v = *number;
    }
    mesh.triangles = triangles.into();
    drop(new_number);
    let chosen = |positions: &[[f32; 3]]| -> Vec<[f32; 3]> {
        used.iter().map(|&v| positions[v as usize]).collect()
    };
    mesh.positions = chosen(&mesh.positions).into();
    for positions in mesh.motion.iter_mut().flat_map(|m| &mut m.keys) {
        *positions = chosen(positions);
    }
}
