//! What hides everything behind it.

use sightline_geometry::{Bounds, Mesh};

/// A closed box, seen from both sides.
#[must_use]
pub fn walls(bounds: Bounds) -> Mesh {
    let corner = |k: usize| {
        let side = |axis: usize| if k >> axis & 1 == 0 { bounds.min } else { bounds.max };
        [0, 1, 2].map(|axis| side(axis)[axis] as f32)
    };
    let quads =
        [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
    let triangles: Vec<[u32; 3]> =
        quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    Mesh::new((0..8).map(corner).collect(), &triangles).0
}
