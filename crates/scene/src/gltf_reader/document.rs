//! The JSON of a scene, as far as triangles depend on it.
//!
//! Accessors, views, buffers, meshes and scenes have the types of the `gltf` crate. Nodes have a
//! type of their own, because transforms are composed in `f64` and the crate reads `f32`.
//! Animations and skins are kept as they are, and read where they are used: a broken one that nothing
//! uses refuses nothing. Textures, images and cameras are not read.

use std::collections::BTreeMap;

use gltf::json;
use serde::{Deserialize, de::DeserializeOwned};
use serde_json::{Map, Value};

use crate::{Cause, SceneError};

/// Extensions that this reader applies.
const APPLIED: [&str; 7] = [
    "KHR_mesh_quantization",
    "EXT_mesh_gpu_instancing",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "KHR_draco_mesh_compression",
    "KHR_node_visibility",
    "KHR_animation_pointer",
];

/// Applied in part: decides whether a material can be seen through.
const TRANSMISSION: &str = "KHR_materials_transmission";

/// Beginnings of the names of extensions that leave every triangle where it is, so that a file
/// which requires them can still be read.
const APPEARANCE: [&str; 16] = [
    "KHR_materials_",
    "KHR_texture_",
    "KHR_lights_",
    "KHR_techniques_webgl",
    "KHR_xmp",
    "KHR_audio",
    "KHR_interactivity",
    "KHR_node_selectability",
    "KHR_node_hoverability",
    "EXT_texture_",
    "EXT_lights_",
    "EXT_mesh_features",
    "EXT_instance_features",
    "EXT_structural_metadata",
    "MSFT_texture_dds",
    "MSFT_packing_",
];

/// The parts of a glTF file that its triangles depend on.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Document {
    /// Version and origin.
    pub asset: Asset,
    /// See the specification, as for every field below.
    #[serde(default)]
    pub accessors: Vec<json::Accessor>,
    #[serde(default)]
    pub buffers: Vec<json::Buffer>,
    #[serde(default)]
    pub buffer_views: Vec<json::buffer::View>,
    #[serde(default)]
    pub materials: Vec<Material>,
    #[serde(default)]
    pub meshes: Vec<json::Mesh>,
    #[serde(default)]
    pub nodes: Vec<Node>,
    pub scene: Option<u32>,
    #[serde(default)]
    pub scenes: Vec<Roots>,
    #[serde(default)]
    pub animations: Vec<Value>,
    #[serde(default)]
    pub skins: Vec<Value>,
    #[serde(default)]
    pub extensions_used: Vec<String>,
    #[serde(default)]
    pub extensions_required: Vec<String>,
}

/// Version and origin of the file.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Asset {
    pub version: String,
    pub min_version: Option<String>,
    pub generator: Option<String>,
    pub copyright: Option<String>,
}

/// A scene: its root nodes, which may be absent.
#[derive(Deserialize)]
pub struct Roots {
    #[serde(default)]
    pub nodes: Vec<u32>,
}

/// A node; its numbers in `f64`.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Node {
    pub name: Option<String>,
    #[serde(default)]
    pub children: Vec<u32>,
    pub matrix: Option<[f64; 16]>,
    pub translation: Option<[f64; 3]>,
    pub rotation: Option<[f64; 4]>,
    pub scale: Option<[f64; 3]>,
    pub mesh: Option<u32>,
    pub skin: Option<u32>,
    pub weights: Option<Vec<f32>>,
    #[serde(default)]
    pub extensions: NodeExtensions,
}

/// The extensions of a node that matter here.
#[derive(Default, Deserialize)]
pub struct NodeExtensions {
    #[serde(rename = "EXT_mesh_gpu_instancing")]
    pub gpu_instancing: Option<GpuInstancing>,
    #[serde(rename = "KHR_node_visibility")]
    pub visibility: Option<Visibility>,
}

/// EXT_mesh_gpu_instancing.
#[derive(Deserialize)]
pub struct GpuInstancing {
    #[serde(default)]
    pub attributes: BTreeMap<String, u32>,
}

/// KHR_node_visibility.
#[derive(Deserialize)]
pub struct Visibility {
    #[serde(default = "visible")]
    pub visible: bool,
}

fn visible() -> bool {
    true
}

/// What decides whether a material hides what is behind it.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Material {
    alpha_mode: Option<String>,
    /// Whether the back of its triangles is meant to be seen.
    #[serde(default)]
    pub double_sided: bool,
    #[serde(default)]
    extensions: MaterialExtensions,
}

#[derive(Default, Deserialize)]
struct MaterialExtensions {
    #[serde(rename = "KHR_materials_transmission")]
    transmission: Option<Transmission>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Transmission {
    #[serde(default)]
    transmission_factor: f64,
}

impl Material {
    /// True for materials that hide nothing for certain: alpha-masked, blended, or transmitting
    /// light (KHR_materials_transmission with a factor above 0, such as window glass).
    pub fn is_see_through(&self) -> bool {
        let masked = matches!(self.alpha_mode.as_deref(), Some("MASK" | "BLEND"));
        let glass = self.extensions.transmission.as_ref();
        masked || glass.is_some_and(|t| t.transmission_factor > 0.0)
    }
}

impl Document {
    /// Parses the JSON of a scene.
    pub fn parse(text: &[u8]) -> Result<Self, SceneError> {
        // Some exporters write a byte order mark, which the specification forbids.
        let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
        // GLB files pad the JSON chunk; zeros are not allowed but common.
        let end = text.iter().rposition(|&b| b != 0).map_or(0, |last| last + 1);
        let text = &text[..end];
        let document: Self =
            serde_json::from_slice(text).or_else(|e| with_integral_floats(text).ok_or(e)).map_err(
                |e| Cause::Json { line: e.line(), column: e.column(), reason: describe(&e) },
            )?;
        for version in [Some(&document.asset.version), document.asset.min_version.as_ref()] {
            let unknown = |v: &&String| v.split('.').next() != Some("2");
            if let Some(version) = version.filter(unknown) {
                return Err(Cause::Version { version: shorten(version) }.into());
            }
        }
        if let Some(version) = document.asset.min_version.as_ref().filter(|v| *v != "2.0") {
            return Err(Cause::Version { version: shorten(version) }.into());
        }
        Ok(document)
    }

    /// Refuses files that require an extension which changes triangles in an unknown way.
    pub fn check_extensions(&self) -> Result<(), SceneError> {
        match self.extensions_required.iter().find(|e| !is_applied(e) && !is_appearance(e)) {
            Some(extension) => {
                Err(Cause::RequiredExtension { extension: shorten(extension) }.into())
            }
            None => Ok(()),
        }
    }

    /// Extensions in use, sorted, and those of them that are ignored.
    pub fn extensions(&self) -> (Vec<String>, Vec<String>) {
        let mut used: Vec<String> = self.extensions_used.iter().map(|e| shorten(e)).collect();
        used.sort();
        used.dedup();
        let ignored = used.iter().filter(|e| !is_applied(e) && *e != TRANSMISSION).cloned();
        let ignored = ignored.collect();
        (used, ignored)
    }

    /// Looks up an element by index.
    pub fn get<'a, T>(
        elements: &'a [T],
        element: &'static str,
        index: u32,
        referrer: impl FnOnce() -> String,
    ) -> Result<&'a T, SceneError> {
        elements.get(index as usize).ok_or_else(|| {
            let (index, count) = (u64::from(index), elements.len() as u64);
            Cause::NoSuch { referrer: referrer(), element, index, count }.into()
        })
    }

    /// Root nodes of the default scene: `scene`, else the first scene, else every node that is
    /// nobody's child.
    pub fn roots(&self) -> Result<Vec<u32>, SceneError> {
        let scene = match self.scene {
            Some(scene) => Self::get(&self.scenes, "scene", scene, || "`scene`".into())?,
            None => match self.scenes.first() {
                Some(scene) => scene,
                None => return Ok(self.orphans()),
            },
        };
        Ok(scene.nodes.clone())
    }

    fn orphans(&self) -> Vec<u32> {
        let mut orphan = vec![true; self.nodes.len()];
        for &child in self.nodes.iter().flat_map(|n| &n.children) {
            if let Some(orphan) = orphan.get_mut(child as usize) {
                *orphan = false;
            }
        }
        (0..self.nodes.len() as u32).filter(|&n| orphan[n as usize]).collect()
    }
}

/// The object of an extension, or `None` where it is absent.
pub fn extension<T: DeserializeOwned>(
    extensions: Option<&Map<String, Value>>,
    name: &'static str,
) -> Result<Option<T>, SceneError> {
    let Some(value) = extensions.and_then(|map| map.get(name)) else { return Ok(None) };
    serde_json::from_value(value.clone())
        .map(Some)
        .map_err(|e| Cause::ExtensionMalformed { extension: name, reason: describe(&e) }.into())
}

/// An animation or a skin in its type.
pub fn part<T: DeserializeOwned>(value: &Value) -> Result<T, SceneError> {
    T::deserialize(value).or_else(|e| {
        let mut integral = value.clone();
        make_integral(&mut integral);
        T::deserialize(&integral).map_err(|_| Cause::PartMalformed { reason: describe(&e) }.into())
    })
}

/// Parses JSON in which integers are written as `1.0` or `1e0`, which the specification allows
/// readers to expect.
fn with_integral_floats(text: &[u8]) -> Option<Document> {
    let mut value: Value = serde_json::from_slice(text).ok()?;
    make_integral(&mut value);
    serde_json::from_slice(&serde_json::to_vec(&value).ok()?).ok()
}

/// Turns floats that are whole numbers into integers. The parser limits the depth.
fn make_integral(value: &mut Value) {
    /// Above it, not every integer is an `f64`.
    const LARGEST: f64 = 9_007_199_254_740_992.0;
    match value {
        Value::Number(n) if n.is_f64() => {
            if let Some(v) = n.as_f64().filter(|v| v.fract() == 0.0 && v.abs() <= LARGEST) {
                *n = (v as i64).into();
            }
        }
        Value::Array(values) => values.iter_mut().for_each(make_integral),
        Value::Object(values) => values.values_mut().for_each(make_integral),
        _ => {}
    }
}

fn is_applied(extension: &str) -> bool {
    APPLIED.contains(&extension)
}

fn is_appearance(extension: &str) -> bool {
    APPEARANCE.iter().any(|prefix| extension.starts_with(prefix))
}

/// The text of a JSON error without its position, which `Cause::Json` gives.
fn describe(error: &serde_json::Error) -> String {
    let text = error.to_string();
    let end = text.rfind(" at line ").unwrap_or(text.len());
    shorten(&text[..end])
}

/// Text from the file, cut for messages.
pub fn shorten(text: &str) -> String {
    const LONGEST: usize = 200;
    match text.char_indices().nth(LONGEST) {
        Some((cut, _)) => format!("{}…", &text[..cut]),
        None => text.to_owned(),
    }
}
