//! Numbering, objects and the report: from bodies and placements to a [`Scene`].

use globset::{GlobBuilder, GlobSet, GlobSetBuilder};
use sightline_geometry::{Bounds, Instance, InstancedGeometry, MeshId, ObjectId, PrimitiveId};

use super::{
    MAX_COORDINATE,
    animation::Animations,
    buffers::Buffers,
    document::{Document, Material},
    nodes::{Placed, node_name},
    primitives::{PlacedBody, Unique},
};
use crate::{
    Cause, IngestReport, InstanceSource, MeshSource, Object, OpenOptions, Scene, SceneDigest,
    SceneError, morton,
    particles::{self, Tables, merge_key_times},
};

/// The see-through patterns of the options.
pub fn see_through_patterns(options: &OpenOptions) -> Result<GlobSet, SceneError> {
    let mut set = GlobSetBuilder::new();
    let mut current = "";
    let mut build = || -> Result<GlobSet, globset::Error> {
        for pattern in &options.see_through {
            current = pattern;
            set.add(GlobBuilder::new(pattern).backslash_escape(true).build()?);
        }
        set.build()
    };
    build().map_err(|e| {
        Cause::Pattern { pattern: current.to_owned(), reason: e.kind().to_string() }.into()
    })
}

/// One object before it has a number.
struct Draft {
    node: u32,
    name: String,
    path: String,
    matches_pattern: bool,
    bounds: Bounds,
    /// Its instances in `Unique::instances`.
    first: usize,
    end: usize,
}

/// Numbers everything.
pub fn scene(
    document: &Document,
    buffers: &Buffers,
    placed: Placed,
    mut unique: Unique,
    tables: Tables,
    animations: Animations,
    see_through: &GlobSet,
) -> Result<Scene, SceneError> {
    check_count(&unique)?;
    let boxes = boxes(&placed, &unique)?;
    let mut drafts = drafts(document, &placed, &unique, &boxes, see_through);
    let bounds = drafts.iter().fold(Bounds::EMPTY, |b, d| b.union(d.bounds));
    drafts.sort_by_cached_key(|d| (morton(d.bounds.center(), bounds), d.node));

    let mut report = report(document, &placed, &unique, animations);
    let mut instances = Vec::with_capacity(unique.instances.len());
    let mut sources = Vec::with_capacity(unique.instances.len());
    let mut objects = Vec::with_capacity(drafts.len());
    let mut next = 0u32;
    for draft in drafts {
        let id = ObjectId(objects.len() as u32);
        let first_primitive = next;
        let mut order: Vec<usize> = (draft.first..draft.end).collect();
        order.sort_by_cached_key(|&i| {
            let instance = &unique.instances[i];
            let code = morton(boxes[i].center(), draft.bounds);
            (code, instance.gpu_instance, instance.primitive)
        });
        let mut hides = false;
        for i in order {
            let motion = unique.instances[i].motion.take();
            let placed_body = &unique.instances[i];
            let triangles = unique.bodies[placed_body.body as usize].mesh.triangles.len() as u32;
            let occluder = !draft.matches_pattern
                && !material(document, &placed, placed_body).is_some_and(Material::is_see_through);
            hides |= occluder;
            if !occluder {
                report.see_through_triangles += u64::from(triangles);
            }
            instances.push(Instance {
                mesh: MeshId(placed_body.body),
                object: id,
                world_from_mesh: placed_body.world_from_mesh,
                first_primitive: PrimitiveId(next),
                occluder,
                motion,
            });
            sources.push(InstanceSource {
                node: draft.node,
                gpu_instance: placed_body.gpu_instance,
                primitive: placed_body.primitive,
                posed: placed.placements[placed_body.placement as usize].posed,
                double_sided: material(document, &placed, placed_body)
                    .is_some_and(|m| m.double_sided),
            });
            next += triangles;
        }
        objects.push(Object {
            id,
            name: draft.name,
            path: draft.path,
            node: draft.node,
            primitives: first_primitive..next,
            occluder: hides,
            bounds: draft.bounds,
        });
    }
    let (bodies, meshes): (Vec<_>, Vec<MeshSource>) =
        unique.bodies.into_iter().map(|b| (b.mesh, b.source)).unzip();
    let digest = SceneDigest::of_files([buffers.files(), &tables.files()].concat());
    let mut parts = tables.key_times();
    // Where bodies move, these are among theirs already.
    parts.push(&unique.key_times);
    let key_times = merge_key_times(&parts);
    let placed = tables.place(&key_times, objects.len() as u32, next, see_through)?;
    objects.extend(placed.objects);
    let states = particles::states(&key_times);
    let geometry = InstancedGeometry::with_motion(bodies, instances, placed.systems, states);
    count(&mut report, &geometry, objects.len());
    Ok(Scene {
        geometry,
        objects,
        meshes,
        instances: sources,
        particles: placed.sources,
        key_times,
        report,
        digest,
        memory: None,
    })
}

fn count(report: &mut IngestReport, geometry: &InstancedGeometry, objects: usize) {
    report.unique_triangles = geometry.unique_triangle_count() as u64;
    report.instanced_triangles = u64::from(geometry.triangle_count());
    report.unique_vertices = geometry.meshes.iter().map(|m| m.positions.len() as u64).sum();
    report.objects = objects as u64;
    report.meshes = geometry.meshes.len() as u64;
    report.instances = geometry.instances.len() as u64;
    report.count_particles(&geometry.particles);
    report.states = u64::from(geometry.states);
    let moves =
        |i: &&Instance| i.motion.is_some() || geometry.meshes[i.mesh.index()].motion.is_some();
    let mut last = None;
    for instance in geometry.instances.iter().filter(moves) {
        report.moving_triangles += geometry.meshes[instance.mesh.index()].triangles.len() as u64;
        // The instances of an object follow each other.
        report.moving_objects += u64::from(last.replace(instance.object) != Some(instance.object));
    }
}

/// Refuses scenes with more triangles than primitive numbers.
fn check_count(unique: &Unique) -> Result<(), SceneError> {
    let sizes = unique.instances.iter().map(|i| &unique.bodies[i.body as usize].mesh.triangles);
    let count: u64 = sizes.map(|t| t.len() as u64).sum();
    let limit = u64::from(u32::MAX);
    if count > limit { Err(Cause::TooManyTriangles { count, limit }.into()) } else { Ok(()) }
}

/// World boxes of the instances, over all key frames.
fn boxes(placed: &Placed, unique: &Unique) -> Result<Vec<Bounds>, SceneError> {
    unique
        .instances
        .iter()
        .map(|instance| {
            let mesh = &unique.bodies[instance.body as usize].mesh;
            let bounds = match instance.motion.as_deref() {
                None => mesh.bounds.transformed(&instance.world_from_mesh),
                Some(maps) => (0..)
                    .zip(maps)
                    .map(|(key, map)| mesh.bounds_at(key).transformed(map))
                    .fold(Bounds::EMPTY, Bounds::union),
            };
            let farthest = bounds.min.abs().max(bounds.max.abs()).max_element();
            // Also refuses NaN.
            if farthest <= MAX_COORDINATE {
                return Ok(bounds);
            }
            let node = placed.placements[instance.placement as usize].node;
            let cause = Cause::TooFar { coordinate: farthest, limit: MAX_COORDINATE };
            Err(SceneError::from(cause).at_node(node as usize))
        })
        .collect()
}

/// The objects: runs of instances of the same placement.
fn drafts(
    document: &Document,
    placed: &Placed,
    unique: &Unique,
    boxes: &[Bounds],
    see_through: &GlobSet,
) -> Vec<Draft> {
    let mut first = 0;
    unique
        .instances
        .chunk_by(|a, b| a.placement == b.placement)
        .map(|run| {
            let end = first + run.len();
            let placement = &placed.placements[run[0].placement as usize];
            let node = placement.node;
            let mesh = &document.meshes[placement.mesh as usize];
            let name = node_name(document, node)
                .or_else(|| mesh.name.clone().filter(|n| !n.is_empty()))
                .unwrap_or_else(|| format!("#{node}"));
            let path = placed.path(document, node);
            let matches_pattern = see_through.is_match(&name) || see_through.is_match(&path);
            let bounds = boxes[first..end].iter().fold(Bounds::EMPTY, |b, x| b.union(*x));
            let draft = Draft { node, name, path, matches_pattern, bounds, first, end };
            first = end;
            draft
        })
        .collect()
}

fn material<'a>(
    document: &'a Document,
    placed: &Placed,
    instance: &PlacedBody,
) -> Option<&'a Material> {
    let mesh = placed.placements[instance.placement as usize].mesh;
    let primitive = &document.meshes[mesh as usize].primitives[instance.primitive as usize];
    primitive.material.as_ref().map(|m| &document.materials[m.value()])
}

/// The report without its counts of what is in the geometry.
fn report(
    document: &Document,
    placed: &Placed,
    unique: &Unique,
    animations: Animations,
) -> IngestReport {
    let (used_extensions, ignored_extensions) = document.extensions();
    let mut warnings = placed.warnings.sentences();
    warnings.extend(unique.warnings.iter().cloned());
    IngestReport {
        generator: document.asset.generator.clone(),
        copyright: document.asset.copyright.clone(),
        degenerate_triangles: unique.degenerate.iter().map(|d| d.count).sum(),
        degenerate: unique.degenerate.clone(),
        skipped: unique.skipped,
        hidden_nodes: placed.hidden_nodes,
        animated: !document.animations.is_empty(),
        animations: document.animations.len() as u64,
        animation_names: animations.names,
        animations_taken: animations.taken,
        duration_s: animations.duration,
        ignored_channels: animations.ignored.into_values().collect(),
        jumps: unique.jumps,
        skinned_objects: placed.placements.iter().filter(|p| p.skinned).count() as u64,
        flattened_instances: unique.flattened_instances,
        used_extensions,
        ignored_extensions,
        warnings,
        ..IngestReport::default()
    }
}
