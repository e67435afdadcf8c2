//! Writes a document of nodes and meshes as a GLB file.
//!
//! Source: glTF 2.0 specification, sections 3 and 4 (binary layout); EXT_mesh_gpu_instancing.
//!
//! The file has one buffer in five views: positions and their displacements by morph targets
//! (`f32 x 3`), 16-bit indices, 32-bit indices, instance attributes, and times and weights of the
//! animation. What has no bytes has no view. The parts of a mesh share its positions. JSON comes from structs
//! with fields in a fixed order, so the bytes depend on the document alone.
//!
//! Invariants: parents are added before their children; a mesh is written once however many
//! nodes show it.

use std::io::{self, Write};

use glam::{DAffine3, DQuat, DVec3};
use serde::Serialize;
use sightline_geometry::Bounds;

use super::material::Material;
use super::solid::Solid;

/// Number of a mesh in a document.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct MeshKey(usize);

/// Number of a node in a document.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct NodeKey(usize);

/// Number of an animation sampler in a document.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct SamplerKey(usize);

/// Where a node stands in its parent's space.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placement {
    pub(super) translation: DVec3,
    pub(super) rotation: DQuat,
    pub(super) scale: f64,
}

impl Placement {
    pub(super) const IDENTITY: Self =
        Self { translation: DVec3::ZERO, rotation: DQuat::IDENTITY, scale: 1.0 };

    pub(super) fn at(translation: DVec3) -> Self {
        Self { translation, ..Self::IDENTITY }
    }

    /// Moved, and turned about +Y by an angle in radians.
    pub(super) fn turned(translation: DVec3, angle: f64) -> Self {
        let (s, c) = super::random::sin_cos(0.5 * angle);
        Self { translation, rotation: DQuat::from_xyzw(0.0, s, 0.0, c), scale: 1.0 }
    }

    pub(super) fn affine(&self) -> DAffine3 {
        DAffine3::from_scale_rotation_translation(
            DVec3::splat(self.scale),
            self.rotation,
            self.translation,
        )
    }
}

/// What [`Document::write`] wrote.
#[derive(Clone, Copy, Debug)]
pub(super) struct Written {
    pub(super) bytes: u64,
    pub(super) triangles: u64,
    pub(super) unique_triangles: u64,
    pub(super) bounds: Bounds,
}

struct MeshEntry {
    json: json::Mesh,
    triangles: u64,
    bounds: Bounds,
}

struct NodeEntry {
    json: json::Node,
    world: DAffine3,
}

/// A scene in the making.
#[derive(Default)]
pub(super) struct Document {
    nodes: Vec<NodeEntry>,
    roots: Vec<usize>,
    meshes: Vec<MeshEntry>,
    materials: Vec<Material>,
    accessors: Vec<json::Accessor>,
    positions: Vec<u8>,
    short_indices: Vec<u8>,
    long_indices: Vec<u8>,
    attributes: Vec<u8>,
    animation: Vec<u8>,
    samplers: Vec<json::Sampler>,
    channels: Vec<json::Channel>,
    triangles: u64,
    bounds: Option<Bounds>,
}

const FLOAT: u32 = 5126;
const UNSIGNED_INT: u32 = 5125;
const UNSIGNED_SHORT: u32 = 5123;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
const POSITIONS: usize = 0;
const SHORT_INDICES: usize = 1;
const LONG_INDICES: usize = 2;
const ATTRIBUTES: usize = 3;
const ANIMATION: usize = 4;

impl Document {
    pub(super) fn new() -> Self {
        Self::default()
    }

    /// Number of triangles of the scene so far, counted once for every instance.
    pub(super) fn triangles(&self) -> u64 {
        self.triangles
    }

    /// Triangles of a mesh.
    pub(super) fn triangles_of(&self, mesh: MeshKey) -> u64 {
        self.meshes[mesh.0].triangles
    }

    fn material(&mut self, material: Material) -> usize {
        self.materials.iter().position(|&m| m == material).unwrap_or_else(|| {
            self.materials.push(material);
            self.materials.len() - 1
        })
    }

    fn accessor(&mut self, accessor: json::Accessor) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    /// Adds points or displacements of vertices.
    fn vertices(&mut self, points: &[[f32; 3]]) -> usize {
        let bounds = Bounds::of_points(points.iter().map(wide));
        let byte_offset = self.positions.len();
        self.positions.extend(points.as_flattened().iter().flat_map(|c| c.to_le_bytes()));
        self.accessor(json::Accessor {
            buffer_view: POSITIONS,
            byte_offset,
            component_type: FLOAT,
            count: points.len(),
            kind: "VEC3",
            min: Some(bounds.min.to_array().to_vec()),
            max: Some(bounds.max.to_array().to_vec()),
        })
    }

    /// Adds a mesh.
    pub(super) fn mesh(&mut self, name: impl Into<String>, solid: &Solid) -> MeshKey {
        self.morphing_mesh(name, solid, &[])
    }

    /// Adds a mesh with morph targets: displacements of every vertex, of weight 0 at rest and of weights
    /// in [-1, 1] otherwise.
    pub(super) fn morphing_mesh(
        &mut self,
        name: impl Into<String>,
        solid: &Solid,
        targets: &[Vec<[f32; 3]>],
    ) -> MeshKey {
        let position = self.vertices(&solid.positions);
        let mut bounds = Bounds::of_points(solid.positions.iter().map(wide));
        let mut displacements = Vec::with_capacity(targets.len());
        for target in targets {
            assert_eq!(target.len(), solid.positions.len(), "every vertex has a displacement");
            displacements.push(json::Target { position: self.vertices(target) });
        }
        for (v, p) in solid.positions.iter().enumerate().filter(|_| !targets.is_empty()) {
            let reach: DVec3 = targets.iter().map(|target| wide(&target[v]).abs()).sum();
            bounds = bounds.union(Bounds { min: wide(p) - reach, max: wide(p) + reach });
        }
        // 65,535 restarts primitives, so it is no index.
        let short = solid.positions.len() <= 65_535;
        let mut primitives = Vec::with_capacity(solid.parts.len());
        for part in &solid.parts {
            let (view, bytes) = if short {
                (SHORT_INDICES, &mut self.short_indices)
            } else {
                (LONG_INDICES, &mut self.long_indices)
            };
            let byte_offset = bytes.len();
            for &index in part.triangles.iter().flatten() {
                if short {
                    bytes.extend((index as u16).to_le_bytes());
                } else {
                    bytes.extend(index.to_le_bytes());
                }
            }
            let indices = self.accessor(json::Accessor {
                buffer_view: view,
                byte_offset,
                component_type: if short { UNSIGNED_SHORT } else { UNSIGNED_INT },
                count: 3 * part.triangles.len(),
                kind: "SCALAR",
                min: None,
                max: None,
            });
            let material = self.material(part.material);
            let attributes = json::PrimitiveAttributes { position };
            let targets = displacements.clone();
            primitives.push(json::Primitive { attributes, indices, material, targets });
        }
        let weights = vec![0.0; targets.len()];
        let json = json::Mesh { name: name.into(), primitives, weights };
        self.meshes.push(MeshEntry { json, triangles: solid.triangle_count(), bounds });
        MeshKey(self.meshes.len() - 1)
    }

    fn count(&mut self, mesh: MeshKey, world: &DAffine3) {
        let mesh = &self.meshes[mesh.0];
        self.triangles += mesh.triangles;
        let bounds = mesh.bounds.transformed(world);
        self.bounds = Some(self.bounds.map_or(bounds, |b| b.union(bounds)));
    }

    fn add_node(
        &mut self,
        parent: Option<NodeKey>,
        json: json::Node,
        placement: &Placement,
    ) -> NodeKey {
        let key = self.nodes.len();
        let world = match parent {
            Some(p) => {
                self.nodes[p.0].json.children.push(key);
                self.nodes[p.0].world * placement.affine()
            }
            None => {
                self.roots.push(key);
                placement.affine()
            }
        };
        self.nodes.push(NodeEntry { json, world });
        NodeKey(key)
    }

    /// Adds a node, with a mesh or as a group.
    pub(super) fn node(
        &mut self,
        parent: Option<NodeKey>,
        name: impl Into<String>,
        mesh: Option<MeshKey>,
        placement: Placement,
    ) -> NodeKey {
        let Placement { translation, rotation, scale } = placement;
        let json = json::Node {
            name: name.into(),
            mesh: mesh.map(|m| m.0),
            children: vec![],
            translation: (translation != DVec3::ZERO).then(|| translation.to_array()),
            rotation: (rotation != DQuat::IDENTITY).then(|| rotation.to_array()),
            scale: (scale != 1.0).then_some([scale; 3]),
            extensions: None,
        };
        let key = self.add_node(parent, json, &placement);
        if let Some(mesh) = mesh {
            let world = self.nodes[key.0].world;
            self.count(mesh, &world);
        }
        key
    }

    /// Adds a node that shows a mesh at every placement (EXT_mesh_gpu_instancing).
    pub(super) fn instanced_node(
        &mut self,
        parent: Option<NodeKey>,
        name: impl Into<String>,
        mesh: MeshKey,
        placements: &[Placement],
    ) -> NodeKey {
        let count = placements.len();
        let mut attribute = |kind: &'static str, values: &mut dyn Iterator<Item = f32>| {
            let byte_offset = self.attributes.len();
            self.attributes.extend(values.flat_map(f32::to_le_bytes));
            self.accessor(json::Accessor {
                buffer_view: ATTRIBUTES,
                byte_offset,
                component_type: FLOAT,
                count,
                kind,
                min: None,
                max: None,
            })
        };
        let translation = attribute(
            "VEC3",
            &mut placements.iter().flat_map(|p| p.translation.as_vec3().to_array()),
        );
        let rotation =
            attribute("VEC4", &mut placements.iter().flat_map(|p| p.rotation.as_quat().to_array()));
        let scale = attribute("VEC3", &mut placements.iter().flat_map(|p| [p.scale as f32; 3]));
        let json = json::Node {
            name: name.into(),
            mesh: Some(mesh.0),
            children: vec![],
            translation: None,
            rotation: None,
            scale: None,
            extensions: Some(json::NodeExtensions {
                instancing: json::Instancing {
                    attributes: json::InstanceAttributes { translation, rotation, scale },
                },
            }),
        };
        let key = self.add_node(parent, json, &Placement::IDENTITY);
        for p in placements {
            let world = self.nodes[key.0].world * p.affine();
            self.count(mesh, &world);
        }
        key
    }

    /// Adds linear motion of the weights of morph targets: ascending times in seconds, and all weights
    /// of a time after those of the time before it.
    pub(super) fn weights_sampler(&mut self, times: &[f32], weights: &[f32]) -> SamplerKey {
        let mut scalars = |values: &[f32], bounds: Option<(f32, f32)>| {
            let byte_offset = self.animation.len();
            self.animation.extend(values.iter().flat_map(|v| v.to_le_bytes()));
            self.accessors.push(json::Accessor {
                buffer_view: ANIMATION,
                byte_offset,
                component_type: FLOAT,
                count: values.len(),
                kind: "SCALAR",
                min: bounds.map(|(first, _)| vec![first.into()]),
                max: bounds.map(|(_, last)| vec![last.into()]),
            });
            self.accessors.len() - 1
        };
        let input = scalars(times, times.first().copied().zip(times.last().copied()));
        let output = scalars(weights, None);
        self.samplers.push(json::Sampler { input, interpolation: "LINEAR", output });
        SamplerKey(self.samplers.len() - 1)
    }

    /// Moves the mesh of a node by its morph targets.
    pub(super) fn animate_weights(&mut self, node: NodeKey, sampler: SamplerKey) {
        let target = json::ChannelTarget { node: node.0, path: "weights" };
        self.channels.push(json::Channel { sampler: sampler.0, target });
    }

    /// Writes the GLB file. A file of more than 4 GiB is [`io::ErrorKind::FileTooLarge`].
    pub(super) fn write(self, generator: String, out: &mut impl Write) -> io::Result<Written> {
        let sections = [
            &self.positions,
            &self.short_indices,
            &self.long_indices,
            &self.attributes,
            &self.animation,
        ];
        let targets = [
            Some((ARRAY_BUFFER, Some(12))),
            Some((ELEMENT_ARRAY_BUFFER, None)),
            Some((ELEMENT_ARRAY_BUFFER, None)),
            None,
            None,
        ];
        // Views of nothing are not allowed: number the others anew.
        let mut buffer_views = vec![];
        let mut renumbered = [0; 5];
        let mut byte_offset = 0;
        for (k, bytes) in sections.iter().enumerate().filter(|(_, b)| !b.is_empty()) {
            renumbered[k] = buffer_views.len();
            let (target, byte_stride) = targets[k].unzip();
            let byte_length = bytes.len();
            let byte_stride = byte_stride.flatten();
            let view =
                json::BufferView { buffer: 0, byte_offset, byte_length, byte_stride, target };
            buffer_views.push(view);
            byte_offset += byte_length.next_multiple_of(4);
        }
        let mut accessors = self.accessors;
        for a in &mut accessors {
            a.buffer_view = renumbered[a.buffer_view];
        }
        let instanced = self.nodes.iter().any(|n| n.json.extensions.is_some());
        let extensions = instanced.then(|| vec!["EXT_mesh_gpu_instancing"]);
        let unique_triangles = self.meshes.iter().map(|m| m.triangles).sum();
        let animation = json::Animation { channels: self.channels, samplers: self.samplers };
        let root = json::Root {
            asset: json::Asset { version: "2.0", generator },
            extensions_used: extensions.clone(),
            extensions_required: extensions,
            scene: 0,
            scenes: [json::Scene { nodes: self.roots }],
            nodes: self.nodes.into_iter().map(|n| n.json).collect(),
            meshes: self.meshes.into_iter().map(|m| m.json).collect(),
            materials: self.materials.iter().map(|m| json::Material::of(*m)).collect(),
            animations: (!animation.channels.is_empty()).then_some([animation]),
            accessors,
            buffer_views,
            buffers: [json::Buffer { byte_length: byte_offset }],
        };
        let mut text = serde_json::to_vec(&root)?;
        text.resize(text.len().next_multiple_of(4), b' ');
        let bytes = 12 + 8 + text.len() + 8 + byte_offset;
        let length =
            |n: usize| u32::try_from(n).map_err(|_| io::Error::from(io::ErrorKind::FileTooLarge));
        out.write_all(b"glTF")?;
        out.write_all(&2u32.to_le_bytes())?;
        out.write_all(&length(bytes)?.to_le_bytes())?;
        out.write_all(&length(text.len())?.to_le_bytes())?;
        out.write_all(b"JSON")?;
        out.write_all(&text)?;
        out.write_all(&length(byte_offset)?.to_le_bytes())?;
        out.write_all(b"BIN\0")?;
        for section in sections {
            out.write_all(section)?;
            out.write_all(&[0; 3][..section.len().next_multiple_of(4) - section.len()])?;
        }
        let bounds = self.bounds.unwrap_or(Bounds::EMPTY);
        Ok(Written { bytes: bytes as u64, triangles: self.triangles, unique_triangles, bounds })
    }
}

fn wide(p: &[f32; 3]) -> DVec3 {
    DVec3::from_array(p.map(f64::from))
}

/// The parts of glTF's JSON that the generators use; names as in the specification.
mod json {
    use super::Serialize;

    #[derive(Serialize)]
    #[serde(rename_all = "camelCase")]
    pub(super) struct Root {
        pub(super) asset: Asset,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) extensions_used: Option<Vec<&'static str>>,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) extensions_required: Option<Vec<&'static str>>,
        pub(super) scene: usize,
        pub(super) scenes: [Scene; 1],
        pub(super) nodes: Vec<Node>,
        pub(super) meshes: Vec<Mesh>,
        pub(super) materials: Vec<Material>,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) animations: Option<[Animation; 1]>,
        pub(super) accessors: Vec<Accessor>,
        pub(super) buffer_views: Vec<BufferView>,
        pub(super) buffers: [Buffer; 1],
    }

    #[derive(Serialize)]
    pub(super) struct Asset {
        pub(super) version: &'static str,
        pub(super) generator: String,
    }

    #[derive(Serialize)]
    pub(super) struct Scene {
        pub(super) nodes: Vec<usize>,
    }

    #[derive(Serialize)]
    pub(super) struct Node {
        pub(super) name: String,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) mesh: Option<usize>,
        #[serde(skip_serializing_if = "Vec::is_empty")]
        pub(super) children: Vec<usize>,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) translation: Option<[f64; 3]>,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) rotation: Option<[f64; 4]>,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) scale: Option<[f64; 3]>,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) extensions: Option<NodeExtensions>,
    }

    #[derive(Serialize)]
    pub(super) struct NodeExtensions {
        #[serde(rename = "EXT_mesh_gpu_instancing")]
        pub(super) instancing: Instancing,
    }

    #[derive(Serialize)]
    pub(super) struct Instancing {
        pub(super) attributes: InstanceAttributes,
    }

    #[derive(Serialize)]
    #[serde(rename_all = "UPPERCASE")]
    pub(super) struct InstanceAttributes {
        pub(super) translation: usize,
        pub(super) rotation: usize,
        pub(super) scale: usize,
    }

    #[derive(Serialize)]
    pub(super) struct Mesh {
        pub(super) name: String,
        pub(super) primitives: Vec<Primitive>,
        #[serde(skip_serializing_if = "Vec::is_empty")]
        pub(super) weights: Vec<f64>,
    }

    #[derive(Serialize)]
    pub(super) struct Primitive {
        pub(super) attributes: PrimitiveAttributes,
        pub(super) indices: usize,
        pub(super) material: usize,
        #[serde(skip_serializing_if = "Vec::is_empty")]
        pub(super) targets: Vec<Target>,
    }

    #[derive(Clone, Copy, Serialize)]
    #[serde(rename_all = "UPPERCASE")]
    pub(super) struct Target {
        pub(super) position: usize,
    }

    #[derive(Serialize)]
    pub(super) struct Animation {
        pub(super) channels: Vec<Channel>,
        pub(super) samplers: Vec<Sampler>,
    }

    #[derive(Serialize)]
    pub(super) struct Channel {
        pub(super) sampler: usize,
        pub(super) target: ChannelTarget,
    }

    #[derive(Serialize)]
    pub(super) struct ChannelTarget {
        pub(super) node: usize,
        pub(super) path: &'static str,
    }

    #[derive(Serialize)]
    pub(super) struct Sampler {
        pub(super) input: usize,
        pub(super) interpolation: &'static str,
        pub(super) output: usize,
    }

    #[derive(Serialize)]
    #[serde(rename_all = "UPPERCASE")]
    pub(super) struct PrimitiveAttributes {
        pub(super) position: usize,
    }

    #[derive(Serialize)]
    #[serde(rename_all = "camelCase")]
    pub(super) struct Material {
        pub(super) name: &'static str,
        pub(super) pbr_metallic_roughness: Pbr,
        #[serde(skip_serializing_if = "std::ops::Not::not")]
        pub(super) double_sided: bool,
    }

    #[derive(Serialize)]
    #[serde(rename_all = "camelCase")]
    pub(super) struct Pbr {
        pub(super) base_color_factor: [f64; 4],
        pub(super) metallic_factor: f64,
        pub(super) roughness_factor: f64,
    }

    impl Material {
        pub(super) fn of(material: super::Material) -> Self {
            let look = material.look();
            let [r, g, b] = look.color;
            Self {
                name: look.name,
                pbr_metallic_roughness: Pbr {
                    base_color_factor: [r, g, b, 1.0],
                    metallic_factor: look.metallic,
                    roughness_factor: look.roughness,
                },
                double_sided: look.double_sided,
            }
        }
    }

    #[derive(Serialize)]
    #[serde(rename_all = "camelCase")]
    pub(super) struct Accessor {
        pub(super) buffer_view: usize,
        pub(super) byte_offset: usize,
        pub(super) component_type: u32,
        pub(super) count: usize,
        #[serde(rename = "type")]
        pub(super) kind: &'static str,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) min: Option<Vec<f64>>,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) max: Option<Vec<f64>>,
    }

    #[derive(Serialize)]
    #[serde(rename_all = "camelCase")]
    pub(super) struct BufferView {
        pub(super) buffer: usize,
        pub(super) byte_offset: usize,
        pub(super) byte_length: usize,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) byte_stride: Option<usize>,
        #[serde(skip_serializing_if = "Option::is_none")]
        pub(super) target: Option<u32>,
    }

    #[derive(Serialize)]
    #[serde(rename_all = "camelCase")]
    pub(super) struct Buffer {
        pub(super) byte_length: usize,
    }
}
