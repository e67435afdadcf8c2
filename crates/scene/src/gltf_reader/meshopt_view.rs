//! EXT_meshopt_compression and KHR_meshopt_compression: a compressed buffer view.
//!
//! Source: the extensions' specifications; meshoptimizer's codecs through the `meshopt` crate,
//! whose decoders are safe on any bytes as long as counts and strides keep their contract, which
//! is checked here first.
//!
//! Bounds on what compressed bytes can hold, so that nothing is reserved that they cannot back:
//! - vertex codec: a block of at most 256 vertices takes at least one control byte for each four
//!   bytes of a vertex, so at most 1024 bytes come from one;
//! - index codec: at least one byte a triangle;
//! - index sequence codec: at least one byte an index.

use serde::Deserialize;

/// Bytes that one compressed byte of the vertex codec can stand for.
const MAX_EXPANSION: u64 = 1024;

/// The object of the extension on a buffer view.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct MeshoptView {
    pub buffer: u32,
    #[serde(default)]
    pub byte_offset: u64,
    pub byte_length: u64,
    byte_stride: u64,
    count: u64,
    mode: Mode,
    #[serde(default)]
    filter: Filter,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
enum Mode {
    Attributes,
    Triangles,
    Indices,
}

#[derive(Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
enum Filter {
    #[default]
    None,
    Octahedral,
    Quaternion,
    Exponential,
    Color,
}

/// Decodes a view: `count * byte_stride` bytes, or the reason why not.
pub fn decode(view: &MeshoptView, source: &[u8]) -> Result<Vec<u8>, String> {
    let bytes = source.len() as u64;
    let fits = match view.mode {
        Mode::Attributes => {
            if view.byte_stride == 0
                || view.byte_stride > 256
                || !view.byte_stride.is_multiple_of(4)
            {
                return Err(format!("a stride of {} bytes is not allowed", view.byte_stride));
            }
            view.count.checked_mul(view.byte_stride).is_some_and(|n| n / MAX_EXPANSION <= bytes)
        }
        Mode::Triangles => view.count / 3 <= bytes,
        Mode::Indices => view.count <= bytes,
    };
    if !fits {
        return Err(format!("{bytes} bytes cannot hold {} elements", view.count));
    }
    let count = view.count as usize;
    match view.mode {
        Mode::Attributes => attributes(view, source, count),
        Mode::Triangles if !count.is_multiple_of(3) => {
            Err(format!("{count} indices are no triangles"))
        }
        Mode::Triangles => match view.byte_stride {
            2 => bytes_of(meshopt::decode_index_buffer::<u16>(source, count), u16::to_le_bytes),
            4 => bytes_of(meshopt::decode_index_buffer::<u32>(source, count), u32::to_le_bytes),
            stride => Err(format!("indices of {stride} bytes are not allowed")),
        },
        Mode::Indices => match view.byte_stride {
            2 => bytes_of(meshopt::decode_index_sequence::<u16>(source, count), u16::to_le_bytes),
            4 => bytes_of(meshopt::decode_index_sequence::<u32>(source, count), u32::to_le_bytes),
            stride => Err(format!("indices of {stride} bytes are not allowed")),
        },
    }
}

fn bytes_of<T: Copy, const N: usize>(
    decoded: meshopt::Result<Vec<T>>,
    to_bytes: impl Fn(T) -> [u8; N],
) -> Result<Vec<u8>, String> {
    Ok(decoded.map_err(|e| e.to_string())?.into_iter().flat_map(to_bytes).collect())
}

/// A vertex of N words, which the decoder's bounds ask to have a default.
#[derive(Clone)]
#[repr(transparent)]
struct Vertex<const N: usize>([u32; N]);

impl<const N: usize> Default for Vertex<N> {
    fn default() -> Self {
        Self([0; N])
    }
}

fn attributes(view: &MeshoptView, source: &[u8], count: usize) -> Result<Vec<u8>, String> {
    // The decoder takes the stride from a type: one copy of it for each number of words.
    macro_rules! by_words {
        ($($words:literal)*) => {
            match view.byte_stride / 4 {
                $($words => vertices::<$words>(view, source, count),)*
                _ => Err(format!("a stride of {} bytes is not allowed", view.byte_stride)),
            }
        };
    }
    let decoded = by_words!(
        1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30 31 32
        33 34 35 36 37 38 39 40 41 42 43 44 45 46 47 48 49 50 51 52 53 54 55 56 57 58 59 60 61 62
        63 64
    )?;
    match (view.filter, view.byte_stride) {
        (Filter::None | Filter::Exponential, _) => Ok(decoded),
        (Filter::Octahedral, 4) => Ok(filtered::<i8, 1>(&decoded, meshopt::decode_filter_oct)),
        (Filter::Octahedral, 8) => Ok(filtered::<i16, 2>(&decoded, meshopt::decode_filter_oct)),
        (Filter::Quaternion, 8) => Ok(filtered::<i16, 2>(&decoded, meshopt::decode_filter_quat)),
        (Filter::Color, 4) => Ok(filtered::<i8, 1>(&decoded, meshopt::decode_filter_color)),
        (Filter::Color, 8) => Ok(filtered::<i16, 2>(&decoded, meshopt::decode_filter_color)),
        (_, stride) => Err(format!("the filter does not apply to a stride of {stride} bytes")),
    }
}

fn vertices<const N: usize>(
    view: &MeshoptView,
    source: &[u8],
    count: usize,
) -> Result<Vec<u8>, String> {
    let decoded = meshopt::decode_vertex_buffer::<Vertex<N>>(source, count);
    let mut words: Vec<[u32; N]> =
        decoded.map_err(|e| e.to_string())?.into_iter().map(|v| v.0).collect();
    if matches!(view.filter, Filter::Exponential) {
        meshopt::decode_filter_exp(&mut words);
    }
    Ok(words.as_flattened().iter().flat_map(|w| w.to_ne_bytes()).collect())
}

/// Integers of SIZE bytes that filters work on, four a vertex.
trait Component<const SIZE: usize>: Copy {
    fn from_bytes(bytes: &[u8]) -> Self;
    fn to_bytes(self) -> [u8; SIZE];
}

impl Component<1> for i8 {
    fn from_bytes(bytes: &[u8]) -> Self {
        i8::from_le_bytes([bytes[0]])
    }
    fn to_bytes(self) -> [u8; 1] {
        self.to_le_bytes()
    }
}

impl Component<2> for i16 {
    fn from_bytes(bytes: &[u8]) -> Self {
        i16::from_le_bytes([bytes[0], bytes[1]])
    }
    fn to_bytes(self) -> [u8; 2] {
        self.to_le_bytes()
    }
}

fn filtered<C: Component<SIZE>, const SIZE: usize>(
    bytes: &[u8],
    filter: impl Fn(&mut [[C; 4]]),
) -> Vec<u8> {
    let mut data: Vec<[C; 4]> = bytes
        .chunks_exact(4 * SIZE)
        .map(|v| std::array::from_fn(|k| C::from_bytes(&v[k * SIZE..])))
        .collect();
    filter(&mut data);
    data.as_flattened().iter().flat_map(|c| c.to_bytes()).collect()
}
