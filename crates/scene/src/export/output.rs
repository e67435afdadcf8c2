//! The output's one buffer: vertices by stride, indices, instance attributes, images; and the
//! GLB container around it.
//!
//! Every section but the images is one buffer view, and its elements start at multiples of four
//! bytes.

use std::collections::BTreeMap;
use std::io::{self, Write};

use serde_json::{Map, Value, json};

use super::source::{Elements, FLOAT, Shape};

/// A part of the buffer that is one buffer view, in the order of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Section {
    /// Vertex attributes at distances of so many bytes.
    Vertices(usize),
    ShortIndices,
    LongIndices,
    Instances,
    Image(usize),
}

/// What has been collected.
#[derive(Default)]
pub(super) struct Output {
    sections: BTreeMap<Section, Vec<u8>>,
    accessors: Vec<(Section, Value)>,
    images: usize,
    /// True when an attribute needs KHR_mesh_quantization.
    pub(super) quantized: bool,
}

const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

impl Output {
    fn accessor(&mut self, section: Section, shape: &Shape, count: usize, at: usize) -> usize {
        let mut json = json!({
            "byteOffset": at,
            "componentType": shape.component,
            "count": count,
            "type": shape.kind,
        });
        if shape.normalized {
            json["normalized"] = true.into();
        }
        self.accessors.push((section, json));
        self.accessors.len() - 1
    }

    /// Adds a vertex attribute with the chosen elements; returns its accessor.
    pub(super) fn vertices(&mut self, name: &str, elements: &Elements, chosen: &[u32]) -> usize {
        let shape = &elements.shape;
        let size = shape.size().unwrap_or(4);
        let stride = size.next_multiple_of(4);
        let section = Section::Vertices(stride);
        let bytes = self.sections.entry(section).or_default();
        let at = bytes.len();
        for &v in chosen {
            bytes.extend_from_slice(elements.get(v as usize));
            bytes.resize(bytes.len() + stride - size, 0);
        }
        let accessor = self.accessor(section, shape, chosen.len(), at);
        if name == "POSITION" {
            let n = shape.components().unwrap_or(3);
            let (mut min, mut max) = (vec![f64::INFINITY; n], vec![f64::NEG_INFINITY; n]);
            for &v in chosen {
                for (k, value) in shape.stored(elements.get(v as usize)).into_iter().enumerate() {
                    min[k] = min[k].min(value);
                    max[k] = max[k].max(value);
                }
            }
            let json = &mut self.accessors[accessor].1;
            (json["min"], json["max"]) = (bound(shape, &min), bound(shape, &max));
        }
        self.quantized |= is_quantized(name, shape);
        accessor
    }

    /// Adds vertex indices below `vertices`; returns their accessor.
    pub(super) fn indices(&mut self, indices: &[u32], vertices: usize) -> usize {
        // 65,535 restarts primitives, so it is no index.
        let short = vertices <= 65_535;
        let section = if short { Section::ShortIndices } else { Section::LongIndices };
        let bytes = self.sections.entry(section).or_default();
        let at = bytes.len();
        for &i in indices {
            if short {
                bytes.extend((i as u16).to_le_bytes());
            } else {
                bytes.extend(i.to_le_bytes());
            }
        }
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        let component = if short { 5123 } else { 5125 };
        let shape = Shape { component, kind: "SCALAR".into(), normalized: false };
        self.accessor(section, &shape, indices.len(), at)
    }

    /// Adds an instance attribute with the chosen elements; returns its accessor.
    pub(super) fn instances(&mut self, elements: &Elements, chosen: &[u32]) -> usize {
        let bytes = self.sections.entry(Section::Instances).or_default();
        let at = bytes.len();
        for &i in chosen {
            bytes.extend_from_slice(elements.get(i as usize));
        }
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        self.accessor(Section::Instances, &elements.shape, chosen.len(), at)
    }

    /// Adds an image; returns a number that [`Output::finish`] turns into its buffer view.
    pub(super) fn image(&mut self, bytes: Vec<u8>) -> usize {
        self.sections.insert(Section::Image(self.images), bytes);
        self.images += 1;
        self.images - 1
    }

    /// Writes accessors, buffer views and the buffer into the root, and the views of images.
    pub(super) fn finish(&mut self, root: &mut Map<String, Value>) {
        let mut views = vec![];
        let mut view_of = BTreeMap::new();
        let mut offset = 0;
        for (section, bytes) in &self.sections {
            view_of.insert(*section, views.len());
            let mut view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() });
            match section {
                Section::Vertices(stride) => {
                    view["byteStride"] = json!(stride);
                    view["target"] = json!(ARRAY_BUFFER);
                }
                Section::ShortIndices | Section::LongIndices => {
                    view["target"] = json!(ELEMENT_ARRAY_BUFFER);
                }
                Section::Instances | Section::Image(_) => {}
            }
            views.push(view);
            offset += bytes.len().next_multiple_of(4);
        }
        let accessors: Vec<Value> = std::mem::take(&mut self.accessors)
            .into_iter()
            .map(|(section, mut json)| {
                json["bufferView"] = json!(view_of[&section]);
                json
            })
            .collect();
        for image in root.get_mut("images").and_then(Value::as_array_mut).into_iter().flatten() {
            if let Some(number) = image["bufferView"].as_u64() {
                image["bufferView"] = json!(view_of[&Section::Image(number as usize)]);
            }
        }
        super::insert_list(root, "accessors", accessors);
        super::insert_list(root, "bufferViews", views);
        if offset > 0 {
            root.insert("buffers".into(), json!([{ "byteLength": offset }]));
        }
    }

    fn binary_size(&self) -> u64 {
        self.sections.values().map(|b| b.len().next_multiple_of(4) as u64).sum()
    }

    /// Size of the file for a JSON text of `text` bytes.
    pub(super) fn container_size(&self, text: usize) -> u64 {
        let binary = self.binary_size();
        let chunk = if binary > 0 { 8 + binary } else { 0 };
        12 + 8 + text as u64 + chunk
    }

    /// Writes the container. The size must fit into 32 bits.
    pub(super) fn write(&self, text: &[u8], out: &mut impl Write) -> io::Result<()> {
        let word = |v: u64| (v as u32).to_le_bytes();
        out.write_all(b"glTF")?;
        out.write_all(&2u32.to_le_bytes())?;
        out.write_all(&word(self.container_size(text.len())))?;
        out.write_all(&word(text.len() as u64))?;
        out.write_all(b"JSON")?;
        out.write_all(text)?;
        if self.binary_size() == 0 {
            return Ok(());
        }
        out.write_all(&word(self.binary_size()))?;
        out.write_all(b"BIN\0")?;
        for section in self.sections.values() {
            out.write_all(section)?;
            out.write_all(&[0; 3][..section.len().next_multiple_of(4) - section.len()])?;
        }
        Ok(())
    }
}

/// `min` or `max` of an accessor; integers without a fraction.
fn bound(shape: &Shape, values: &[f64]) -> Value {
    if shape.component == FLOAT {
        json!(values)
    } else {
        json!(values.iter().map(|v| *v as i64).collect::<Vec<_>>())
    }
}

/// True for component types that only KHR_mesh_quantization allows.
fn is_quantized(name: &str, shape: &Shape) -> bool {
    let core_integer = shape.normalized && matches!(shape.component, 5121 | 5123);
    match name {
        "POSITION" | "NORMAL" | "TANGENT" => shape.component != FLOAT,
        _ if name.starts_with("TEXCOORD_") => shape.component != FLOAT && !core_integer,
        _ => false,
    }
}
