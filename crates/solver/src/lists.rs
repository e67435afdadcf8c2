//! The visibility intervals of single pixels: what a solve adds up.

use sightline_geometry::{FACE_COUNT, InstancedGeometry, RectifiedFrame, Sampling, ViewSegment};

use crate::{
    bounds::ErrorBounds,
    envelope::{Column, Interval},
    states::TimePath,
    tile::{Motion, TILE_COLUMNS, TILE_ROWS, TileContext, TileSolver},
};

/// A pixel of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pixel {
    /// Number of the face.
    pub face: usize,
    /// Row.
    pub row: u32,
    /// Column.
    pub column: u32,
}

/// Calls `found` with every pixel of a segment and the visibility intervals of its occluders in a
/// state, in order of t, those that are too short to count included. Without refinement, on one
/// thread: for tests, and to look at why something is seen.
pub fn visit_intervals(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
    state: u32,
    path: TimePath,
    mut found: impl FnMut(Pixel, &[Interval]),
) {
    let Some(frame) = RectifiedFrame::new(segment) else { return };
    let bounds = ErrorBounds::new(geometry, &frame);
    let columns: Vec<Column> = (0..sampling.columns())
        .map(|j| Column::new(sampling.column(j), frame.length, &bounds))
        .collect();
    let motion = Motion { states: &[state], path, volumes: true };
    let mut solver = TileSolver::default();
    let mut intervals = Vec::new();
    for face in 0..FACE_COUNT {
        let context =
            TileContext { geometry, frame: &frame, face: frame.face(face), bounds: &bounds };
        for first_row in (0..sampling.rows()).step_by(TILE_ROWS) {
            let rows: Vec<f64> =
                (first_row..sampling.rows()).take(TILE_ROWS).map(|row| sampling.row(row)).collect();
            for first_column in (0..sampling.columns()).step_by(TILE_COLUMNS) {
                let columns = &columns[first_column as usize..][..TILE_COLUMNS];
                solver.solve(&context, &rows, columns, Some(motion), |_, _, _, _| {});
                for pixel in 0..rows.len() * TILE_COLUMNS {
                    intervals.clear();
                    solver.intervals(pixel, |interval| intervals.push(interval));
                    let row = first_row + (pixel / TILE_COLUMNS) as u32;
                    let column = first_column + (pixel % TILE_COLUMNS) as u32;
                    found(Pixel { face, row, column }, &intervals);
                }
            }
        }
    }
}
