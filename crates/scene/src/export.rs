//! The visible part of a scene as a GLB file of its own.
//!
//! [`export_visible`] promises: the file holds the triangles of the set and no others, with their vertex
//! attributes (in the component types of the source), materials, textures, names, hierarchy, extras,
//! cameras and lights, in standard glTF 2.0 that passes the Khronos validator when the source does.
//! External and data-URI images are embedded. The bytes depend on source, set and moment alone.
//!
//! Particles of the set are instances of a tessellated sphere. A scene of particles alone is exported as
//! these.
//!
//! The file is at rest: what an animation or a skin places is frozen at one moment, by default the first
//! key frame. Such a mesh becomes a root with positions of its own, since between two key frames
//! its transform need not be one that glTF can state. Cameras and lights stand where the nodes of
//! the source put them.
//!
//! Left out: animations, skins and morph targets, once they are applied to positions; normals of
//! what bends; other scenes than the default one, and what nothing visible refers to. Compressed data is written decompressed; strips and fans become lists.
//! What is lost that way is a warning of the report.
//!
//! How a visible subset maps to meshes: the visible triangles of every instance of the geometry are a
//! *subset*; nodes (and instances of EXT_mesh_gpu_instancing) that show the same subsets of the
//! same glTF mesh share one mesh of the output. An instanced node whose instances differ gets
//! one child a distinct mesh, instanced where several instances share it.
//!
//! Parts: `source` reads raw elements; `output` collects sections, accessors and the GLB
//! container; `subset` finds subsets and rebuilds primitives, `frozen` those that move; `appearance` follows materials to images.

mod appearance;
mod frozen;
mod hierarchy;
mod output;
mod particles;
mod source;
mod subset;

use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use serde_json::{Map, Value, json};
use sightline_geometry::{Moment, PrimitiveSet, Run};

use crate::gltf_reader::{buffers, container, document, uri};
use crate::{Scene, SceneError};
use output::Output;
use source::Source;

/// What was exported.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ExportReport {
    /// Triangles of the exported scene, counted once for every instance: those of the set. Without
    /// those of particles.
    pub triangles: u64,
    /// Particles of the exported scene: those of the set that are there.
    pub particles: u64,
    /// Triangles in the file, without those of particles.
    pub unique_triangles: u64,
    /// Size of the file.
    pub bytes: u64,
    /// Nodes, meshes, materials and images in the file.
    pub nodes: usize,
    /// See `nodes`.
    pub meshes: usize,
    /// See `nodes`.
    pub materials: usize,
    /// See `nodes`.
    pub images: usize,
    /// What was left out although it may matter, one sentence each.
    pub warnings: Vec<String>,
}

/// How a set is to be exported.
#[derive(Clone, Copy, Debug, Default)]
#[non_exhaustive]
pub struct ExportOptions {
    /// The moment at which what moves is frozen; the first key frame without one.
    pub moment: Option<Moment>,
}

impl ExportOptions {
    /// Freezes what moves at a moment of the scene, see [`Scene::moment_at`].
    #[must_use]
    pub fn at(moment: Moment) -> Self {
        Self { moment: Some(moment) }
    }
}

/// Why a set was not exported.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// The source can no longer be read.
    #[error(transparent)]
    Source(#[from] SceneError),
    /// The source is not the file that the scene was read from: open the scene again.
    #[error("{} has changed since the scene was read", file.display())]
    SourceChanged {
        /// The source.
        file: PathBuf,
    },
    /// A part of the source that its geometry does not depend on is malformed: fix the file.
    #[error("{} is malformed: {reason}", file.display())]
    Malformed {
        /// The source.
        file: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The set is not one of this scene.
    #[error("the set has primitive {primitive}, the scene only {count} primitives")]
    NotThisScene {
        /// Largest number in the set.
        primitive: u32,
        /// Primitives of the scene.
        count: u32,
    },
    /// The scene has no such moment.
    #[error("the scene has {states} states, there is no moment {t} of state {state}")]
    NoSuchMoment {
        /// State of the moment.
        state: u32,
        /// Its share of the state.
        t: f64,
        /// States of the scene.
        states: u32,
    },
    /// The output would replace the source: choose another path.
    #[error("{} is the source of the export", file.display())]
    ReplacesSource {
        /// The path.
        file: PathBuf,
    },
    /// A GLB file has at most 2^32 - 1 bytes: export a smaller set.
    #[error("the export takes {bytes} bytes, more than a GLB file can hold")]
    TooLarge {
        /// Bytes that it takes.
        bytes: u64,
    },
    /// The output cannot be written.
    #[error("cannot write {}", file.display())]
    Write {
        /// The path.
        file: PathBuf,
        /// The operating system's reason.
        source: io::Error,
    },
}

/// Warnings by sentence, with how often and where first.
#[derive(Default)]
struct Warnings(BTreeMap<&'static str, (u64, String)>);

impl Warnings {
    fn add(&mut self, sentence: &'static str, place: impl Into<String>) {
        self.0.entry(sentence).or_insert_with(|| (0, place.into())).0 += 1;
    }

    fn sentences(&self) -> Vec<String> {
        let sentence = |(s, (n, first)): (&&str, &(u64, String))| match n {
            1 => format!("{s} ({first})"),
            _ => format!("{s} ({n} times, first: {first})"),
        };
        self.0.iter().map(sentence).collect()
    }
}

/// The source of a scene that has no glTF file.
const NO_TRIANGLES: &[u8] = br#"{ "asset": { "version": "2.0" }, "scene": 0, "scenes": [{}] }"#;

/// Root extensions that refer to nothing which is renumbered.
const ROOT_EXTENSIONS: [&str; 3] = ["KHR_lights_punctual", "KHR_xmp_json_ld", "KHR_xmp"];

/// Writes the part of `scene` that is in `set` to `out`, a GLB file. `source` is the file that
/// the scene was read from. `out` is replaced only when everything is written. What moves stands as
/// at the first key frame.
///
/// # Errors
/// See [`ExportError`].
pub fn export_visible(
    source: &Path,
    scene: &Scene,
    set: &PrimitiveSet,
    out: &Path,
) -> Result<ExportReport, ExportError> {
    export_visible_with(source, scene, set, ExportOptions::default(), out)
}

/// As [`export_visible`], with options.
///
/// # Errors
/// See [`ExportError`].
pub fn export_visible_with(
    source: &Path,
    scene: &Scene,
    set: &PrimitiveSet,
    options: ExportOptions,
    out: &Path,
) -> Result<ExportReport, ExportError> {
    let moment = options.moment.unwrap_or(Moment::START);
    let states = scene.geometry.states;
    if moment.state >= states || !(0.0..=1.0).contains(&moment.t) {
        return Err(ExportError::NoSuchMoment { state: moment.state, t: moment.t, states });
    }
    let count = scene.geometry.primitive_count();
    if let Some(last) = set.runs().last().filter(|r| r.end > count) {
        return Err(ExportError::NotThisScene { primitive: last.end - 1, count });
    }
    if let (Ok(a), Ok(b)) = (source.canonicalize(), out.canonicalize())
        && a == b
    {
        return Err(ExportError::ReplacesSource { file: out.into() });
    }
    let in_source = |e: SceneError| ExportError::from(e.in_file(source));
    let malformed = |reason: String| ExportError::Malformed { file: source.into(), reason };
    // What is exported of a table is in the scene.
    let is_table = crate::particles::is_table(source);
    let main = if is_table {
        NO_TRIANGLES.to_vec()
    } else {
        std::fs::read(source).map_err(|source| in_source(crate::Cause::Read { source }.into()))?
    };
    let parts = container::split(&main).map_err(in_source)?;
    let document = document::Document::parse(parts.json).map_err(in_source)?;
    let buffers =
        buffers::Buffers::load(source, &main, parts.binary, &document, None).map_err(in_source)?;
    // Behind the files of the source, the digest lists the particle tables.
    let files = scene.digest.files.len() - scene.particles.len();
    let own = crate::SceneDigest::of_files(buffers.files().to_vec());
    if own.files[usize::from(is_table)..] != scene.digest.files[..files] {
        return Err(ExportError::SourceChanged { file: source.into() });
    }
    let read = Source::new(parts.json, &buffers).map_err(|e| malformed(e.to_string()))?;

    let mut output = Output::default();
    let mut warnings = Warnings::default();
    let placed = subset::placed(scene, set);
    let mut meshes = subset::Meshes::new(&read, scene, moment);
    let mut nodes = hierarchy::build(&read, &placed, &mut meshes, &mut output, &mut warnings)
        .ok_or_else(|| malformed("its nodes or meshes are not as they were read".into()))?;
    let balls = particles::balls(scene, set, moment, meshes.json.len(), &mut output, &mut warnings)
        .ok_or_else(|| malformed("its particles are not as they were read".into()))?;
    nodes.roots.extend(nodes.json.len()..nodes.json.len() + balls.nodes.len());
    nodes.json.extend(balls.nodes);
    meshes.json.extend(balls.mesh);
    let mut root = Map::new();
    root.insert("asset".into(), asset(&read.json["asset"]));
    let mut shown = scene_of(&read.json);
    if !nodes.roots.is_empty() {
        shown.insert("nodes".into(), json!(nodes.roots));
    }
    root.insert("scene".into(), json!(0));
    root.insert("scenes".into(), json!([shown]));
    insert_list(&mut root, "nodes", nodes.json);
    let mut mesh_json = meshes.json;
    let looks = appearance::collect(&read, source, &mut mesh_json, &mut output, &mut warnings);
    let report = ExportReport {
        triangles: triangles_of(scene, set),
        particles: balls.count,
        unique_triangles: meshes.triangles,
        bytes: 0,
        nodes: root.get("nodes").and_then(Value::as_array).map_or(0, Vec::len),
        meshes: mesh_json.len(),
        materials: looks.materials.len(),
        images: looks.images.len(),
        warnings: vec![],
    };
    insert_list(&mut root, "meshes", mesh_json);
    insert_list(&mut root, "materials", looks.materials);
    insert_list(&mut root, "textures", looks.textures);
    insert_list(&mut root, "samplers", looks.samplers);
    insert_list(&mut root, "images", looks.images);
    keep_untouched(&read.json, &mut root, &mut warnings);
    output.finish(&mut root);
    declare_extensions(&read.json, &mut root, output.quantized);

    let bytes = write(&root, &output, out)?;
    Ok(ExportReport { bytes, warnings: warnings.sentences(), ..report })
}

/// Number of triangles in a set of a scene.
fn triangles_of(scene: &Scene, set: &PrimitiveSet) -> u64 {
    let end = scene.geometry.triangle_count();
    let below = |run: &Run| u64::from(run.end.min(end).saturating_sub(run.first));
    set.runs().iter().map(below).sum()
}

fn insert_list(root: &mut Map<String, Value>, name: &str, list: Vec<Value>) {
    if !list.is_empty() {
        root.insert(name.into(), list.into());
    }
}

fn asset(source: &Value) -> Value {
    let mut asset = json!({ "version": "2.0", "generator": "sightline export" });
    for key in ["copyright", "extras"] {
        if let Some(value) = source.get(key) {
            asset[key] = value.clone();
        }
    }
    asset
}

/// The default scene without its nodes.
fn scene_of(source: &Value) -> Map<String, Value> {
    let number = source["scene"].as_u64().unwrap_or(0) as usize;
    let mut scene = source["scenes"][number].as_object().cloned().unwrap_or_default();
    scene.retain(|key, _| key == "name" || key == "extras");
    scene
}

/// Cameras, extras and root extensions stay; what else the root has is left out with a warning.
fn keep_untouched(source: &Value, root: &mut Map<String, Value>, warnings: &mut Warnings) {
    for key in ["cameras", "extras"] {
        if let Some(value) = source.get(key) {
            root.insert(key.into(), value.clone());
        }
    }
    let count = |key: &str| source[key].as_array().map_or(0, Vec::len);
    for (key, at_most, sentence) in [
        ("animations", 0, "animations are left out"),
        ("skins", 0, "skins are left out"),
        ("scenes", 1, "scenes other than the default one are left out"),
    ] {
        if count(key) > at_most {
            warnings.add(sentence, format!("{} in `{key}`", count(key)));
        }
    }
    let mut kept = Map::new();
    for (name, value) in source["extensions"].as_object().into_iter().flatten() {
        if ROOT_EXTENSIONS.contains(&name.as_str()) {
            kept.insert(name.clone(), value.clone());
        } else {
            warnings.add("an extension of the whole file is left out", name);
        }
    }
    if !kept.is_empty() {
        root.insert("extensions".into(), kept.into());
    }
}

/// `extensionsUsed` from what is in the output, `extensionsRequired` as far as the source asks.
fn declare_extensions(source: &Value, root: &mut Map<String, Value>, quantized: bool) {
    const QUANTIZATION: &str = "KHR_mesh_quantization";
    let mut used = std::collections::BTreeSet::new();
    for value in root.values() {
        extensions_in(value, &mut used);
    }
    for name in root.get("extensions").and_then(Value::as_object).into_iter().flatten() {
        used.insert(name.0.clone());
    }
    let mut required: Vec<String> = source["extensionsRequired"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|name| name.as_str())
        .filter(|name| used.contains(*name) && *name != QUANTIZATION)
        .map(str::to_owned)
        .collect();
    // Instances are lost on viewers without the extension.
    const INSTANCING: &str = "EXT_mesh_gpu_instancing";
    if used.contains(INSTANCING) && !required.iter().any(|r| r == INSTANCING) {
        required.push(INSTANCING.into());
    }
    if quantized {
        used.insert(QUANTIZATION.into());
        required.push(QUANTIZATION.into());
    }
    let used: Vec<Value> = used.into_iter().map(Value::from).collect();
    insert_list(root, "extensionsUsed", used);
    insert_list(root, "extensionsRequired", required.into_iter().map(Value::from).collect());
}

fn extensions_in(value: &Value, used: &mut std::collections::BTreeSet<String>) {
    match value {
        Value::Array(list) => list.iter().for_each(|v| extensions_in(v, used)),
        Value::Object(object) => {
            for (key, value) in object.iter().filter(|(key, _)| *key != "extras") {
                if key == "extensions" {
                    used.extend(value.as_object().into_iter().flatten().map(|(k, _)| k.clone()));
                }
                extensions_in(value, used);
            }
        }
        _ => {}
    }
}

/// Writes beside `out` first, so that a broken write leaves no half file.
fn write(root: &Map<String, Value>, output: &Output, out: &Path) -> Result<u64, ExportError> {
    let failed = |source: io::Error| ExportError::Write { file: out.into(), source };
    let mut text = serde_json::to_vec(root).map_err(|e| failed(e.into()))?;
    text.resize(text.len().next_multiple_of(4), b' ');
    let bytes = output.container_size(text.len());
    if bytes > u64::from(u32::MAX) {
        return Err(ExportError::TooLarge { bytes });
    }
    let mut part = out.as_os_str().to_owned();
    part.push(".part");
    let part = PathBuf::from(part);
    let written = std::fs::File::create(&part).and_then(|file| {
        let mut file = BufWriter::new(file);
        output.write(&text, &mut file)?;
        file.flush()?;
        std::fs::rename(&part, out)
    });
    if let Err(source) = written {
        // The write has failed already; a remainder that cannot be removed changes nothing.
        let _ = std::fs::remove_file(&part);
        return Err(failed(source));
    }
    Ok(bytes)
}
