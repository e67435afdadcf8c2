//! From a scene file and a configuration to a plan, and to what publishing needs of the scene.

use std::path::Path;
use std::sync::Arc;

use sightline_jobs::{
    BakeConfig, ConfigError, Heights, Plan, SceneFile, SceneRef, SkippedCells, TiledCell, plan,
};
use sightline_scene::region::{self, RegionError, RegionSpec, TiledRegion, tile};
use sightline_scene::{MemoryLimit, OpenOptions, Scene, SceneContent, SceneError};
use sightline_store::{
    NumberedInstance, NumberedMesh, Numbering, SceneFile as StoredFile, SceneObject, SceneSource,
};

use crate::dataset::DatasetPublisher;

/// A scene that is ready to be baked.
pub struct Prepared {
    /// The scene; a worker in the same process can use it.
    pub scene: Arc<Scene>,
    /// The plan.
    pub plan: Plan,
    /// The last step of the bake.
    pub publisher: DatasetPublisher,
    /// What the scene is made of, for [`crate::edit::compare`].
    pub content: Option<SceneContent>,
}

/// Why there is nothing to bake. All kinds are for the user to fix.
#[derive(Debug, thiserror::Error)]
pub enum PrepareError {
    /// The configuration is refused.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The scene is refused.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The view region is refused.
    #[error(transparent)]
    Region(#[from] RegionError),
    /// The view region has no place to stand.
    #[error(
        "the view region has no cell to stand in{}; check region.rectangles against the box of the \
         scene, and region.ground_from", describe(.skipped)
    )]
    NoCells {
        /// Tiles without a cell, by reason.
        skipped: SkippedCells,
    },
}

fn describe(skipped: &SkippedCells) -> String {
    let counts: Vec<String> = skipped.0.iter().map(|(why, n)| format!("{n} {why}")).collect();
    if counts.is_empty() { String::new() } else { format!(" ({})", counts.join(", ")) }
}

/// Opens a scene, cuts the view region into cells and plans the bake. Takes as long as reading
/// the scene; runs on the current rayon pool.
///
/// # Errors
/// When the configuration, the scene or the region is refused.
pub fn prepare(path: &Path, config: BakeConfig) -> Result<Prepared, PrepareError> {
    prepare_from(path, &path.display().to_string(), config, None)
}

/// As [`prepare`], of a scene that workers find at `uri`, in a process that may take so much memory; `path`
/// is where the scene lies here.
///
/// # Errors
/// As [`prepare`]; when the scene does not fit.
pub fn prepare_from(
    path: &Path,
    uri: &str,
    config: BakeConfig,
    memory: Option<MemoryLimit>,
) -> Result<Prepared, PrepareError> {
    config.validate()?;
    let mut options = open_options(path, &config);
    options.memory = memory;
    let scene = Scene::open(path, &options)?;
    let mut prepared = prepare_scene(Arc::new(scene), path, config)?;
    // Where the scene lies is no part of the bake's identity.
    prepared.plan.scene.uri = sightline_store::redacted(uri);
    Ok(prepared)
}

/// How the scene at `path` has to be opened for a bake with this configuration: workers do the same.
/// Tables of particles lie relative to it.
#[must_use]
pub fn open_options(path: &Path, config: &BakeConfig) -> OpenOptions {
    let scene = &config.scene;
    OpenOptions::of_bake(
        path,
        &scene.see_through,
        &scene.particles,
        scene.animation.as_deref(),
        scene.motion_error,
    )
}

/// As [`prepare`], with a scene that was opened with [`open_options`].
///
/// # Errors
/// When the configuration or the region is refused.
pub fn prepare_scene(
    scene: Arc<Scene>,
    path: &Path,
    config: BakeConfig,
) -> Result<Prepared, PrepareError> {
    config.validate()?;
    let TiledRegion { cells, skipped } = tile(&scene, &region_spec(&config))?;
    let skipped = SkippedCells(skipped);
    if cells.is_empty() {
        return Err(PrepareError::NoCells { skipped });
    }
    let cells = cells.into_iter().map(|(cell, tile)| TiledCell { cell, tile }).collect();
    let reference = scene_ref(&scene, path);
    let publisher = DatasetPublisher {
        objects: objects(&scene),
        numbering: numbering(&scene),
        source: source(&reference, &scene),
    };
    let plan = plan(reference, config, scene.key_times.clone(), cells, skipped);
    tracing::info!(
        cells = plan.cells.len(),
        segments = plan.segments.len(),
        skipped = plan.skipped.total(),
        "the bake is planned"
    );
    let content = SceneContent::of(&scene);
    Ok(Prepared { scene, plan, publisher, content })
}

fn region_spec(config: &BakeConfig) -> RegionSpec {
    let region = &config.region;
    RegionSpec {
        rectangles: region.rectangles.clone(),
        polygons: region.polygons.clone(),
        cell_size: region.cell_size,
        eye_height: region.eye_height,
        heights: match region.heights {
            Heights::Absolute => region::Heights::Absolute,
            Heights::Ground => region::Heights::AboveGround {
                from: region.ground_from,
                ground: config.scene.ground.clone(),
            },
        },
    }
}

fn scene_ref(scene: &Scene, path: &Path) -> SceneRef {
    let file = |f: &sightline_scene::FileDigest| SceneFile {
        path: f.name.clone(),
        bytes: f.size,
        digest: f.blake3.clone(),
    };
    SceneRef {
        uri: path.display().to_string(),
        name: path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
        digest: scene.digest.combined.clone(),
        files: scene.digest.files.iter().map(file).collect(),
    }
}

fn source(scene: &SceneRef, read: &Scene) -> SceneSource {
    let geometry = &read.geometry;
    let file = |f: &SceneFile| StoredFile {
        name: f.path.clone(),
        bytes: f.bytes,
        blake3: f.digest.clone(),
    };
    SceneSource {
        uri: scene.name.clone(),
        hash: scene.digest.clone(),
        files: scene.files.iter().map(file).collect(),
        particles: u64::from(geometry.primitive_count() - geometry.triangle_count()),
        particle_systems: geometry.particles.len() as u64,
        // The other numbers are filled in from the objects.
        ..SceneSource::default()
    }
}

fn objects(scene: &Scene) -> Vec<SceneObject> {
    scene
        .objects
        .iter()
        .map(|object| SceneObject {
            id: object.id,
            name: object.name.clone(),
            path: object.path.clone(),
            node: object.node,
            first_primitive: object.primitives.start,
            end_primitive: object.primitives.end,
            occluder: object.occluder,
            bounds: object.bounds,
        })
        .collect()
}

fn numbering(scene: &Scene) -> Numbering {
    let instances = scene.geometry.instances.iter().zip(&scene.instances);
    let instances = instances
        .map(|(instance, source)| NumberedInstance {
            first_primitive: instance.first_primitive.0,
            object: instance.object,
            node: source.node,
            gpu_instance: source.gpu_instance,
            mesh: instance.mesh,
        })
        .collect();
    let meshes = (0..).zip(&scene.meshes);
    let meshes = meshes
        .map(|(id, source)| NumberedMesh {
            id: sightline_geometry::MeshId(id),
            gltf_mesh: source.mesh,
            gltf_primitive: source.primitive,
            triangles: source.triangles.clone(),
        })
        .collect();
    Numbering { instances, meshes }
}
