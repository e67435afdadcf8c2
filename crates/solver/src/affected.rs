//! Whether what was added to a scene changes what was found from a segment.
//!
//! The result of a solve of a scene at rest is a function of what is nearest along its rays. Something that
//! is nearest nowhere has no part in it. So an edit leaves a result as it is when
//!
//! - nothing that was taken away was nearest: it is neither in the visible set nor in
//!   [`SegmentTrace::grazed`], which whoever has the old numbers can tell; and
//! - nothing that was added is: which is asked here, of the new scene, along the same rays. They are those
//!   of the tiles that the solve looked at; an unchanged result would have asked for the same ones.
//!
//! Most tiles are done with at the price of looking for what was added in a scene that has nothing else:
//! only where it would be seen is the whole scene looked at.
//!
//! The error bounds of a solve are those of the whole scene, so both scenes must have the same
//! [`ErrorBounds`], and what is in both the same order of numbers, which decides ties.
//!
//! Source: verifying traces (Mokhov, Mitchell, Peyton Jones, "Build Systems a la Carte", 2018).

use rayon::prelude::*;
use sightline_geometry::{InstancedGeometry, PrimitiveSet, RectifiedFrame, Sampling, ViewSegment};

use crate::bounds::ErrorBounds;
use crate::segment::{Grid, SegmentTrace};
use crate::tile::{TileContext, TileSolver};

/// What was added to a scene at rest.
#[derive(Clone, Copy, Debug)]
pub struct Added<'a> {
    /// The scene with what was added.
    pub scene: &'a InstancedGeometry,
    /// What was added alone; its numbers do not matter.
    pub alone: &'a InstancedGeometry,
    /// What was added, in the numbers of the scene.
    pub primitives: &'a PrimitiveSet,
}

/// True when something that was added is nearest on a ray of a solve of `segment` that left this trace.
///
/// # Panics
/// When the trace is not of this sampling.
#[must_use]
pub fn is_affected(
    added: &Added<'_>,
    segment: &ViewSegment,
    sampling: Sampling,
    trace: &SegmentTrace,
) -> bool {
    let Some(frame) = RectifiedFrame::new(segment) else { return false };
    let bounds = ErrorBounds::new(added.scene, &frame);
    let mut sampling = sampling;
    for pass in 0..=trace.tiles.len() {
        let grid = Grid::new(sampling, &frame, &bounds);
        let tiles = match pass.checked_sub(1) {
            None => (0..grid.tile_count()).collect(),
            Some(finer) => trace.tiles[finer].clone(),
        };
        let sees = |solver: &mut TileSolver, number: u32| {
            let (face, rows, columns) = grid.rays(number);
            let face = frame.face(face);
            let context = |geometry| TileContext { geometry, frame: &frame, face, bounds: &bounds };
            solver.sees_any(&context(added.alone), &rows, columns, None)
                && solver.sees_any(&context(added.scene), &rows, columns, Some(added.primitives))
        };
        if tiles.into_par_iter().map_init(TileSolver::default, |s, n| sees(s, n)).any(|sees| sees) {
            return true;
        }
        sampling = sampling.finer();
    }
    false
}
