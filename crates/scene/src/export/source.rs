//! Raw elements of the source: bytes of accessors with their component types kept.
//!
//! Positions and indices have been checked by the reader; everything else is checked here, and
//! what is out of range is `None`.

use std::collections::BTreeMap;

use serde_json::Value;

use super::buffers::Buffers;

/// The source file: its JSON in full, and its buffers.
pub(super) struct Source<'a> {
    pub(super) json: Value,
    pub(super) buffers: &'a Buffers<'a>,
}

/// Component type and shape of an element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Shape {
    /// `componentType`.
    pub(super) component: u32,
    /// `type`.
    pub(super) kind: String,
    pub(super) normalized: bool,
}

pub(super) const FLOAT: u32 = 5126;

impl Shape {
    pub(super) fn floats(components: usize) -> Self {
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][components - 1].into();
        Self { component: FLOAT, kind, normalized: false }
    }

    /// Components of an element; `None` for matrices, whose columns are padded.
    pub(super) fn components(&self) -> Option<usize> {
        ["SCALAR", "VEC2", "VEC3", "VEC4"].iter().position(|k| *k == self.kind).map(|k| k + 1)
    }

    pub(super) fn component_size(&self) -> Option<usize> {
        match self.component {
            5120 | 5121 => Some(1),
            5122 | 5123 => Some(2),
            5125 | FLOAT => Some(4),
            _ => None,
        }
    }

    /// Bytes of an element.
    pub(super) fn size(&self) -> Option<usize> {
        Some(self.components()? * self.component_size()?)
    }

    /// Components of an element as numbers, integers as they are stored.
    pub(super) fn stored(&self, element: &[u8]) -> Vec<f64> {
        let size = self.component_size().unwrap_or(1);
        element
            .chunks_exact(size)
            .map(|c| match self.component {
                5120 => f64::from(c[0] as i8),
                5121 => f64::from(c[0]),
                5122 => f64::from(i16::from_le_bytes([c[0], c[1]])),
                5123 => f64::from(u16::from_le_bytes([c[0], c[1]])),
                5125 => f64::from(u32::from_le_bytes([c[0], c[1], c[2], c[3]])),
                _ => f64::from(f32::from_le_bytes([c[0], c[1], c[2], c[3]])),
            })
            .collect()
    }

    /// Components of an element; normalized integers in [0, 1] or [-1, 1].
    pub(super) fn values(&self, element: &[u8]) -> Vec<f64> {
        let mut values = self.stored(element);
        if self.normalized {
            let largest = match self.component {
                5120 => 127.0,
                5121 => 255.0,
                5122 => 32_767.0,
                5123 => 65_535.0,
                _ => 1.0,
            };
            values.iter_mut().for_each(|v| *v = (*v / largest).max(-1.0));
        }
        values
    }
}

/// The elements of an accessor.
pub(super) struct Elements<'a> {
    pub(super) shape: Shape,
    pub(super) count: usize,
    size: usize,
    data: Data<'a>,
}

enum Data<'a> {
    /// Elements at equal distances in a view.
    View { bytes: &'a [u8], stride: usize },
    /// Elements without gaps.
    Owned(Vec<u8>),
}

impl Elements<'_> {
    /// Elements that were made here: `values` holds `shape.components()` floats each.
    pub(super) fn of_floats(shape: Shape, values: &[f32]) -> Option<Self> {
        let size = shape.size()?;
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        Some(Self { shape, count: bytes.len() / size, size, data: Data::Owned(bytes) })
    }

    /// The bytes of element `index`, which must be below `count`.
    pub(super) fn get(&self, index: usize) -> &[u8] {
        match &self.data {
            Data::View { bytes, stride } => &bytes[index * stride..][..self.size],
            Data::Owned(bytes) => &bytes[index * self.size..][..self.size],
        }
    }
}

/// An index that JSON states.
pub(super) fn index(value: &Value) -> Option<usize> {
    value.as_u64().and_then(|v| usize::try_from(v).ok())
}

impl<'a> Source<'a> {
    /// Parses the JSON in full, of which the reader has parsed a part before.
    pub(super) fn new(text: &[u8], buffers: &'a Buffers<'a>) -> serde_json::Result<Self> {
        let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
        let end = text.iter().rposition(|&b| b != 0).map_or(0, |last| last + 1);
        Ok(Self { json: serde_json::from_slice(&text[..end])?, buffers })
    }

    /// The element `number` of a root array.
    pub(super) fn entry(&self, list: &str, number: usize) -> &Value {
        &self.json[list][number]
    }

    /// Bytes and stride of a buffer view, decompressed.
    pub(super) fn view(&self, view: usize) -> Option<(&'a [u8], Option<usize>)> {
        let buffers: &'a Buffers<'a> = self.buffers;
        let view = buffers.view(u32::try_from(view).ok()?, String::new).ok()?;
        Some((view.bytes, view.stride.map(|s| s as usize)))
    }

    /// True when an accessor has a buffer view.
    pub(super) fn has_view(&self, accessor: &Value) -> bool {
        index(accessor).is_some_and(|a| !self.entry("accessors", a)["bufferView"].is_null())
    }

    /// The elements of an accessor.
    pub(super) fn elements(&self, accessor: usize) -> Option<Elements<'a>> {
        let json = self.entry("accessors", accessor);
        let shape = Shape {
            component: u32::try_from(json["componentType"].as_u64()?).ok()?,
            kind: json["type"].as_str()?.into(),
            normalized: json["normalized"].as_bool().unwrap_or(false),
        };
        let size = shape.size()?;
        let count = index(&json["count"])?;
        let sparse = &json["sparse"];
        let base = match &json["bufferView"] {
            Value::Null => None,
            view => {
                let (bytes, stride) = self.view(index(view)?)?;
                let stride = stride.unwrap_or(size);
                let bytes = range(bytes, json, stride, count, size)?;
                Some(Data::View { bytes, stride })
            }
        };
        if sparse.is_null()
            && let Some(data) = base
        {
            return Some(Elements { shape, count, size, data });
        }
        // A zero in front of sparse values needs no bytes in the file; the reader limits them.
        const LARGEST: usize = 1 << 22;
        let mut dense = match base {
            Some(data) => {
                let base = Elements { shape: shape.clone(), count, size, data };
                (0..count).flat_map(|i| base.get(i)).copied().collect()
            }
            None if count <= LARGEST => vec![0; count * size],
            None => return None,
        };
        if !sparse.is_null() {
            self.replace(sparse, &mut dense, size)?;
        }
        Some(Elements { shape, count, size, data: Data::Owned(dense) })
    }

    fn replace(&self, sparse: &Value, dense: &mut [u8], size: usize) -> Option<()> {
        let count = index(&sparse["count"])?;
        let (indices, values) = (&sparse["indices"], &sparse["values"]);
        let shape = Shape {
            component: u32::try_from(indices["componentType"].as_u64()?).ok()?,
            kind: "SCALAR".into(),
            normalized: false,
        };
        let index_size = shape.size()?;
        let at = |json: &Value, size: usize| -> Option<&'a [u8]> {
            let (bytes, _) = self.view(index(&json["bufferView"])?)?;
            range(bytes, json, size, count, size)
        };
        let (index_bytes, value_bytes) = (at(indices, index_size)?, at(values, size)?);
        for k in 0..count {
            let target = shape.stored(&index_bytes[k * index_size..][..index_size])[0] as usize;
            dense
                .get_mut(target * size..(target + 1) * size)?
                .copy_from_slice(&value_bytes[k * size..][..size]);
        }
        Some(())
    }

    /// Vertex indices of a primitive, `0..vertices` where it has none.
    pub(super) fn indices(&self, accessor: &Value, vertices: usize) -> Option<Vec<u32>> {
        if accessor.is_null() {
            return Some((0..vertices as u32).collect());
        }
        let elements = self.elements(index(accessor)?)?;
        let get = |i| elements.shape.stored(elements.get(i))[0] as u32;
        Some((0..elements.count).map(get).collect())
    }

    /// Attributes and triangles of a Draco primitive: floats, normalized where they are.
    pub(super) fn draco(&self, extension: &Value, attributes: &Value) -> Option<Decoded> {
        use draco_core::{DecoderBuffer, Mesh, MeshDecoder};
        let (bytes, _) = self.view(index(&extension["bufferView"])?)?;
        let mut mesh = Mesh::new();
        MeshDecoder::new().decode(&mut DecoderBuffer::new(bytes), &mut mesh).ok()?;
        let mut out = Decoded {
            attributes: BTreeMap::new(),
            triangles: mesh.faces().iter().map(|f| f.map(|p| p.0)).collect(),
        };
        for (name, id) in extension["attributes"].as_object()? {
            let Some(attribute) = mesh.attribute_by_unique_id(u32::try_from(id.as_u64()?).ok()?)
            else {
                continue;
            };
            let components = usize::from(attribute.num_components()).clamp(1, 4);
            let mut values = attribute.read_f32s(mesh.num_points(), components);
            if let Some(accessor) = index(&attributes[name]) {
                let json = self.entry("accessors", accessor);
                let stored = Shape {
                    component: json["componentType"].as_u64().unwrap_or(0) as u32,
                    kind: "SCALAR".into(),
                    normalized: json["normalized"].as_bool().unwrap_or(false),
                };
                let largest = match stored.component {
                    5120 => 127.0,
                    5121 => 255.0,
                    5122 => 32_767.0,
                    5123 => 65_535.0,
                    _ => 1.0,
                };
                if stored.normalized {
                    values.iter_mut().for_each(|v| *v = (*v / largest).max(-1.0));
                }
            }
            let elements = Elements::of_floats(Shape::floats(components), &values)?;
            out.attributes.insert(name.clone(), elements);
        }
        Some(out)
    }
}

/// What Draco data decodes to.
pub(super) struct Decoded {
    pub(super) attributes: BTreeMap<String, Elements<'static>>,
    pub(super) triangles: Vec<[u32; 3]>,
}

/// `count` elements of `size` bytes at distances of `stride`, from the JSON's `byteOffset` on.
fn range<'a>(
    bytes: &'a [u8],
    json: &Value,
    stride: usize,
    count: usize,
    size: usize,
) -> Option<&'a [u8]> {
    let offset = json["byteOffset"].as_u64().unwrap_or(0) as usize;
    let length = match count {
        0 => 0,
        _ => (count - 1).checked_mul(stride)?.checked_add(size)?,
    };
    bytes.get(offset..offset.checked_add(length)?)
}
