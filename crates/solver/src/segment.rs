//! The from-segment solve: tiles of four faces, in parallel, joined into one visible set.

use rayon::prelude::*;
use sightline_geometry::{
    FACE_COUNT, InstancedGeometry, PrimitiveSet, RectifiedFrame, Sampling, ViewSegment,
};

use crate::{
    bounds::ErrorBounds,
    envelope::Column,
    tile::{TileContext, TileCounters, TileSolver},
};

/// Rows and columns of a tile. Small tiles have tight beams, large ones share a walk; these are
/// the fastest measured, with little between them and their neighbours.
const TILE_ROWS: usize = 8;
const TILE_COLUMNS: usize = 4;

/// Weights are summed in units of 2^-60 of the whole (directions x segment), as integers: the
/// sum does not depend on order, and cannot overflow, since all weights of a segment add up to
/// at most the whole, see-through ones to at most the whole each.
const WEIGHT_UNIT: f64 = (1u64 << 60) as f64;

/// What is visible from a segment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SegmentVisibility {
    /// The visible primitives.
    pub set: PrimitiveSet,
    /// For each member of the set, ascending: the share of (directions x segment) on which it is
    /// visible, in (0, 1].
    pub weights: Vec<f32>,
    /// What it took.
    pub statistics: Statistics,
}

/// Counters of one solve.
pub type Statistics = TileCounters;

/// Primitive and weight in units of `WEIGHT_UNIT`.
type Find = (u32, u64);

/// Sorts finds by primitive and adds up the weights of equal ones.
fn join(finds: &mut Vec<Find>) {
    finds.sort_unstable_by_key(|f| f.0);
    finds.dedup_by(|b, a| {
        let same = a.0 == b.0;
        if same {
            a.1 = a.1.saturating_add(b.1);
        }
        same
    });
}

/// Finds the primitives visible from a segment, at the pixel centres of `sampling`.
///
/// A segment without length sees nothing. Runs on the current rayon pool; the result is the same
/// on any.
#[must_use]
pub fn solve_segment(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
) -> SegmentVisibility {
    let Some(frame) = RectifiedFrame::new(segment) else { return SegmentVisibility::default() };
    let bounds = ErrorBounds::new(geometry.bounds, &frame);
    let columns: Vec<Column> = (0..sampling.columns())
        .map(|j| Column::new(sampling.column(j), frame.length, &bounds))
        .collect();
    let solid_angles = solid_angles(sampling);
    let rows = sampling.rows() as usize;
    let bands = rows.div_ceil(TILE_ROWS);

    let (mut finds, statistics) = (0..FACE_COUNT * bands)
        .into_par_iter()
        .map_init(TileSolver::default, |solver, item| {
            solver.counters = TileCounters::default();
            let context = TileContext {
                geometry,
                frame: &frame,
                face: frame.face(item / bands),
                bounds: &bounds,
            };
            let first_row = item % bands * TILE_ROWS;
            let end_row = rows.min(first_row + TILE_ROWS);
            let rows: Vec<f64> = (first_row..end_row).map(|i| sampling.row(i as u32)).collect();
            let mut finds: Vec<Find> = Vec::new();
            for (block, c) in columns.chunks(TILE_COLUMNS).enumerate() {
                solver.solve(&context, &rows, c, |primitive, pixel, length| {
                    let (row, column) =
                        (first_row + pixel / c.len(), block * TILE_COLUMNS + pixel % c.len());
                    let share = length * solid_angles[row * columns.len() + column];
                    finds.push((primitive, (share * WEIGHT_UNIT) as u64));
                });
            }
            join(&mut finds);
            (finds, solver.counters)
        })
        .reduce(
            || (Vec::new(), TileCounters::default()),
            |(mut a, ca), (b, cb)| {
                a.extend_from_slice(&b);
                join(&mut a);
                (a, ca.plus(cb))
            },
        );
    join(&mut finds);
    SegmentVisibility {
        set: PrimitiveSet::from_sorted(finds.iter().map(|f| f.0)),
        weights: finds.iter().map(|f| (f.1 as f64 / WEIGHT_UNIT) as f32).collect(),
        statistics,
    }
}

impl TileCounters {
    /// Sums of two.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            nodes: self.nodes + other.nodes,
            triangles: self.triangles + other.triangles,
            cuts: self.cuts + other.cuts,
            pixel_tests: self.pixel_tests + other.pixel_tests,
            intervals: self.intervals + other.intervals,
        }
    }
}

/// The share of the sphere of each pixel of a face, row by row.
fn solid_angles(sampling: Sampling) -> Vec<f64> {
    let (rows, columns) = (sampling.rows(), sampling.columns());
    let whole = 4.0 * std::f64::consts::PI;
    // One corner evaluation a grid point: differences of the closed form from (0, 0).
    let corners: Vec<f64> = (0..=rows)
        .flat_map(|i| {
            let w = sampling.w(f64::from(i));
            (0..=columns).map(move |j| {
                let c = sampling.c(f64::from(j));
                Sampling::solid_angle(0.0, c, 0.0, w)
            })
        })
        .collect();
    let at = |i: u32, j: u32| corners[(i * (columns + 1) + j) as usize];
    (0..rows)
        .flat_map(|i| (0..columns).map(move |j| (i, j)))
        .map(|(i, j)| (at(i + 1, j + 1) - at(i + 1, j) - at(i, j + 1) + at(i, j)) / whole)
        .collect()
}
