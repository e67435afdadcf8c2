//! Accessors: typed elements in buffer views, with sparse replacements.
//!
//! Promise: every range is checked against its view before it is read, and memory is reserved
//! only for elements that have bytes behind them, or fewer than the limit of their use.

use gltf::json::{
    self,
    accessor::{ComponentType, Type},
    validation::Checked,
};

use super::{
    buffers::{Buffers, View},
    document::Document,
};
use crate::{Cause, SceneError};

/// What an accessor is used for, and what it may hold.
pub struct Use {
    /// For messages.
    pub name: &'static str,
    kind: Type,
    components: &'static [ComponentType],
    /// Elements that an accessor without a buffer view (all zeros) may have.
    dataless_limit: u64,
}

use ComponentType::{F32, I8, I16, U8, U16, U32};

const NUMBERS: &[ComponentType] = &[F32, I8, U8, I16, U16];

/// Vertices that may be zero without data: enough for a sparse morph target of a large mesh.
const DATALESS_VERTICES: u64 = 1 << 22;
/// Instances that may be placed by zeros without data.
pub const DATALESS_INSTANCES: u64 = 1 << 16;

/// Vertex positions, also of morph targets; integers by KHR_mesh_quantization.
pub const POSITIONS: Use = Use {
    name: "POSITION",
    kind: Type::Vec3,
    components: NUMBERS,
    dataless_limit: DATALESS_VERTICES,
};
/// Vertex indices.
pub const INDICES: Use = Use {
    name: "indices",
    kind: Type::Scalar,
    components: &[U8, U16, U32],
    dataless_limit: DATALESS_VERTICES,
};
/// Translations of EXT_mesh_gpu_instancing.
pub const TRANSLATIONS: Use = Use {
    name: "TRANSLATION",
    kind: Type::Vec3,
    components: NUMBERS,
    dataless_limit: DATALESS_INSTANCES,
};
/// Rotations of EXT_mesh_gpu_instancing, quaternions (x, y, z, w).
pub const ROTATIONS: Use = Use {
    name: "ROTATION",
    kind: Type::Vec4,
    components: NUMBERS,
    dataless_limit: DATALESS_INSTANCES,
};
/// Scales of EXT_mesh_gpu_instancing.
pub const SCALES: Use = Use {
    name: "SCALE",
    kind: Type::Vec3,
    components: NUMBERS,
    dataless_limit: DATALESS_INSTANCES,
};

/// Elements of samplers and skins that may be zero without data.
const DATALESS_KEYS: u64 = 1 << 16;

/// Times of a sampler's keys.
pub const KEY_TIMES: Use = Use {
    name: "input of a sampler",
    kind: Type::Scalar,
    components: &[F32],
    dataless_limit: DATALESS_KEYS,
};
/// Values of a sampler: vectors.
pub const KEY_VECTORS: Use = Use {
    name: "output of a sampler",
    kind: Type::Vec3,
    components: NUMBERS,
    dataless_limit: DATALESS_KEYS,
};
/// Values of a sampler: quaternions (x, y, z, w).
pub const KEY_ROTATIONS: Use = Use { kind: Type::Vec4, ..KEY_VECTORS };
/// Values of a sampler: weights of morph targets.
pub const KEY_WEIGHTS: Use = Use { kind: Type::Scalar, ..KEY_VECTORS };
/// Joints that a vertex follows, four in each set.
pub const JOINTS: Use = Use {
    name: "JOINTS",
    kind: Type::Vec4,
    components: &[U8, U16],
    dataless_limit: DATALESS_VERTICES,
};
/// How much it follows them.
pub const WEIGHTS: Use = Use {
    name: "WEIGHTS",
    kind: Type::Vec4,
    components: &[F32, U8, U16],
    dataless_limit: DATALESS_VERTICES,
};
/// From the space of a skinned mesh into that of each joint.
pub const INVERSE_BIND_MATRICES: Use = Use {
    name: "inverseBindMatrices",
    kind: Type::Mat4,
    components: &[F32],
    dataless_limit: DATALESS_KEYS,
};

/// Access to the accessors of a scene.
pub struct Accessors<'a> {
    document: &'a Document,
    buffers: &'a Buffers<'a>,
}

/// The elements of one accessor, with checked ranges.
pub struct Elements<'a> {
    /// Index into `accessors`.
    pub accessor: u32,
    /// Number of elements.
    pub count: usize,
    /// Type of a component.
    pub component: ComponentType,
    normalized: bool,
    base: Option<Strided<'a>>,
    sparse: Option<Sparse<'a>>,
}

/// Elements at equal distances. `bytes` reaches from the first to the end of the last.
struct Strided<'a> {
    bytes: &'a [u8],
    stride: usize,
    size: usize,
}

impl<'a> Strided<'a> {
    fn get(&self, index: usize) -> &'a [u8] {
        &self.bytes[index * self.stride..][..self.size]
    }
}

struct Sparse<'a> {
    count: usize,
    index_type: ComponentType,
    indices: Strided<'a>,
    values: Strided<'a>,
}

impl<'a> Accessors<'a> {
    pub fn new(document: &'a Document, buffers: &'a Buffers<'a>) -> Self {
        Self { document, buffers }
    }

    /// The bytes of a buffer view.
    pub fn view(
        &self,
        index: u32,
        referrer: impl FnOnce() -> String,
    ) -> Result<View<'a>, SceneError> {
        self.buffers.view(index, referrer)
    }

    /// The JSON of an accessor.
    pub fn get(
        &self,
        accessor: u32,
        referrer: impl FnOnce() -> String,
    ) -> Result<&'a json::Accessor, SceneError> {
        Document::get(&self.document.accessors, "accessor", accessor, referrer)
    }

    /// The elements of an accessor; checks its type and ranges.
    pub fn elements(&self, accessor: u32, use_as: &Use) -> Result<Elements<'a>, SceneError> {
        let json = self.get(accessor, || use_as.name.into())?;
        let invalid = |property: &str| -> SceneError {
            Cause::InvalidValue { property: format!("accessor {accessor}: {property}") }.into()
        };
        let Checked::Valid(kind) = json.type_ else { return Err(invalid("`type`")) };
        let Checked::Valid(component) = json.component_type else {
            return Err(invalid("`componentType`"));
        };
        let component = component.0;
        if kind != use_as.kind || !use_as.components.contains(&component) {
            let found = format!("{kind:?} of {component:?}");
            return Err(Cause::AccessorType { accessor, found, use_as: use_as.name }.into());
        }
        let components = match kind {
            Type::Scalar => 1,
            Type::Vec3 => 3,
            Type::Mat4 => 16,
            _ => 4,
        };
        let size = (components * component.size()) as u64;
        let count = json.count.0;
        let base = match &json.buffer_view {
            Some(view) => {
                let offset = json.byte_offset.map_or(0, |o| o.0);
                let view = self.view(view.value() as u32, || format!("accessor {accessor}"))?;
                Some(strided(accessor, "elements", &view, offset, count, size, view.stride)?)
            }
            None if count > use_as.dataless_limit => {
                let limit = use_as.dataless_limit;
                return Err(Cause::AccessorTooLarge { accessor, count, limit }.into());
            }
            None => None,
        };
        let sparse = match &json.sparse {
            Some(sparse) => self.sparse(accessor, sparse, count, size)?,
            None => None,
        };
        let normalized = json.normalized;
        Ok(Elements { accessor, count: count as usize, component, normalized, base, sparse })
    }

    fn sparse(
        &self,
        accessor: u32,
        sparse: &json::accessor::sparse::Sparse,
        count: u64,
        size: u64,
    ) -> Result<Option<Sparse<'a>>, SceneError> {
        let entries = sparse.count.0;
        if entries == 0 {
            return Ok(None);
        }
        if entries > count {
            let (entry, index) = (count, count);
            return Err(Cause::SparseIndex { accessor, entry, index, count }.into());
        }
        let Checked::Valid(index_type) = sparse.indices.component_type else {
            let property = format!("accessor {accessor}: `sparse.indices.componentType`");
            return Err(Cause::InvalidValue { property }.into());
        };
        let index_type = index_type.0;
        let referrer = || format!("accessor {accessor}");
        let at = |part, view: &json::Index<json::buffer::View>, offset: u64, size: u64| {
            let view = self.view(view.value() as u32, referrer)?;
            strided(accessor, part, &view, offset, entries, size, None)
        };
        let (i, v) = (&sparse.indices, &sparse.values);
        let index_size = index_type.size() as u64;
        let indices = at("sparse indices", &i.buffer_view, i.byte_offset.0, index_size)?;
        let values = at("sparse values", &v.buffer_view, v.byte_offset.0, size)?;
        Ok(Some(Sparse { count: entries as usize, index_type, indices, values }))
    }
}

/// Checks that `count` elements of `size` bytes from `offset` on lie in the view.
fn strided<'a>(
    accessor: u32,
    part: &'static str,
    view: &View<'a>,
    offset: u64,
    count: u64,
    size: u64,
    stride: Option<u64>,
) -> Result<Strided<'a>, SceneError> {
    let stride = stride.unwrap_or(size);
    if stride < size {
        return Err(Cause::AccessorStride { accessor, stride, element: size }.into());
    }
    let available = view.bytes.len() as u64;
    let length = match count {
        0 => 0,
        _ => (count - 1).saturating_mul(stride).saturating_add(size),
    };
    let needed = offset.saturating_add(length);
    if needed > available {
        let view = view.index;
        return Err(Cause::AccessorOutOfView { accessor, part, view, needed, available }.into());
    }
    let bytes = &view.bytes[offset as usize..needed as usize];
    Ok(Strided { bytes, stride: stride as usize, size: size as usize })
}

impl Elements<'_> {
    /// The elements as `f32` vectors. Normalized integers become [0, 1] or [-1, 1].
    pub fn vectors<const N: usize>(&self) -> Result<Vec<[f32; N]>, SceneError> {
        self.vectors_of(None)
    }

    /// The elements with the given numbers (ascending, in range), or all, as `f32` vectors.
    pub fn vectors_of<const N: usize>(
        &self,
        chosen: Option<&[u32]>,
    ) -> Result<Vec<[f32; N]>, SceneError> {
        // The conversions of "Animations" and "Accessors" in the specification.
        let n = self.normalized;
        let scale = move |value: f32, largest: f32| if n { value / largest } else { value };
        let signed = move |value: f32, largest: f32| {
            if n { (value / largest).max(-1.0) } else { value }
        };
        match self.component {
            F32 => self.decode(chosen, |b| words(b, f32::from_le_bytes)),
            U32 => self.decode(chosen, |b| words(b, u32::from_le_bytes).map(|v| v as f32)),
            I8 => self
                .decode(chosen, |b| words(b, i8::from_le_bytes).map(|v| signed(v.into(), 127.0))),
            U8 => {
                self.decode(chosen, |b| words(b, u8::from_le_bytes).map(|v| scale(v.into(), 255.0)))
            }
            I16 => self.decode(chosen, |b| {
                words(b, i16::from_le_bytes).map(|v| signed(v.into(), 32767.0))
            }),
            U16 => self
                .decode(chosen, |b| words(b, u16::from_le_bytes).map(|v| scale(v.into(), 65535.0))),
        }
    }

    /// The elements as unsigned integers.
    pub fn integers(&self) -> Result<Vec<u32>, SceneError> {
        let component = self.component;
        self.decode(None, |b| integer(component, b))
    }

    fn decode<T: Clone + Zero>(
        &self,
        chosen: Option<&[u32]>,
        read: impl Fn(&[u8]) -> T,
    ) -> Result<Vec<T>, SceneError> {
        let mut out: Vec<T> = match (&self.base, chosen) {
            (Some(base), None) => (0..self.count).map(|i| read(base.get(i))).collect(),
            (Some(base), Some(chosen)) => {
                chosen.iter().map(|&i| read(base.get(i as usize))).collect()
            }
            (None, chosen) => vec![T::ZERO; chosen.map_or(self.count, <[u32]>::len)],
        };
        if let Some(sparse) = &self.sparse {
            for entry in 0..sparse.count {
                let index = integer(sparse.index_type, sparse.indices.get(entry));
                if index as usize >= self.count {
                    let (accessor, entry) = (self.accessor, entry as u64);
                    let (index, count) = (index.into(), self.count as u64);
                    return Err(Cause::SparseIndex { accessor, entry, index, count }.into());
                }
                let slot = match chosen {
                    None => Some(index as usize),
                    Some(chosen) => chosen.binary_search(&index).ok(),
                };
                if let Some(slot) = slot {
                    out[slot] = read(sparse.values.get(entry));
                }
            }
        }
        Ok(out)
    }
}

trait Zero {
    const ZERO: Self;
}

impl Zero for u32 {
    const ZERO: Self = 0;
}

impl<const N: usize> Zero for [f32; N] {
    const ZERO: Self = [0.0; N];
}

/// N little-endian numbers of SIZE bytes.
fn words<T, const SIZE: usize, const N: usize>(
    bytes: &[u8],
    read: impl Fn([u8; SIZE]) -> T,
) -> [T; N] {
    std::array::from_fn(|k| read(std::array::from_fn(|i| bytes[k * SIZE + i])))
}

fn integer(component: ComponentType, bytes: &[u8]) -> u32 {
    match component.size() {
        1 => bytes[0].into(),
        2 => u16::from_le_bytes([bytes[0], bytes[1]]).into(),
        _ => u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]),
    }
}
