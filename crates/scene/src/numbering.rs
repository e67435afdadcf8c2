//! The order of objects and instances, which fixes the global primitive numbers.
//!
//! Promise: the order is a function of the scene's content alone. Objects follow a Morton
//! (Z-order) curve through the centres of their boxes, quantized to 21 bits an axis in the box
//! of the scene; equal codes are ordered by node index. Instances of an object follow the same
//! curve in the box of the object, then their number in EXT_mesh_gpu_instancing, then the glTF
//! primitive index. So what is near in space is near in number, and visible sets are few runs.
//!
//! Source: Morton, "A computer oriented geodetic data base and a new technique in file
//! sequencing" (IBM, 1966).

use glam::DVec3;
use sightline_geometry::Bounds;

/// Bits of a Morton code an axis.
const BITS: u32 = 21;

/// The Morton code of `point` in `bounds`: 21 bits an axis, x in the lowest bit. Points outside
/// are clamped; an axis without extent counts as 0.
#[must_use]
pub fn morton(point: DVec3, bounds: Bounds) -> u64 {
    let size = bounds.size();
    let last = f64::from((1u32 << BITS) - 1);
    let cell = |k: usize| -> u64 {
        let t = (point[k] - bounds.min[k]) / size[k];
        // A NaN (no extent, or an empty box) becomes 0 by the saturating cast.
        (t.clamp(0.0, 1.0) * last) as u64
    };
    spread(cell(0)) | spread(cell(1)) << 1 | spread(cell(2)) << 2
}

/// Moves bit i of a 21-bit number to bit 3 i.
fn spread(v: u64) -> u64 {
    let mut x = v & 0x1f_ffff;
    x = (x | x << 32) & 0x001f_0000_0000_ffff;
    x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_moves_every_bit_to_its_place() {
        for i in 0..BITS {
            assert_eq!(spread(1 << i), 1 << (3 * i));
        }
        assert_eq!(spread(0x1f_ffff), 0x1249_2492_4924_9249);
    }

    #[test]
    fn morton_orders_octants_and_survives_flat_boxes() {
        let unit = Bounds { min: DVec3::ZERO, max: DVec3::ONE };
        let code = |x, y, z| morton(DVec3::new(x, y, z), unit);
        assert!(code(0.2, 0.2, 0.2) < code(0.8, 0.2, 0.2));
        assert!(code(0.8, 0.8, 0.2) < code(0.2, 0.2, 0.8));
        assert_eq!(code(2.0, 2.0, 2.0), (1 << 63) - 1);
        let flat = Bounds { min: DVec3::ZERO, max: DVec3::new(1.0, 0.0, 1.0) };
        assert_eq!(morton(DVec3::new(1.0, 0.0, 0.0), flat), spread(0x1f_ffff));
    }
}
