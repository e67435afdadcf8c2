//! The from-segment solve: tiles of four faces, in parallel, refined where something may be
//! missing, joined into one visible set.
//!
//! The first pass solves all tiles of a coarse grid. Each further pass solves with twice the rows
//! and columns, but only inside tiles of the pass before in which much may be missing. How much is
//! estimated by leaving out: if one ray were not there, the primitives that no other ray of the
//! segment meets would be missing. So the share of (directions x segment) on which a tile's rays
//! see such primitives estimates what rays between them would see that none sees yet. Where all
//! that is near is large, that is nothing, and one pass is enough; a far facade, finer than the
//! rays are spaced, is refined until it is not.
//!
//! Source of the estimate: Good, "The population frequencies of species and the estimation of
//! population parameters" (Biometrika 1953).
//!
//! Invariants:
//! - a pass depends on the ones before it alone, through sums of integers: the result is the same
//!   on any number of threads (VI-3);
//! - all weights of occluders add up to at most the whole: a ray's share of the directions is
//!   divided between it and the finer rays around it.

use rayon::prelude::*;
use sightline_geometry::{
    FACE_COUNT, InstancedGeometry, PrimitiveId, PrimitiveSet, RectifiedFrame, Sampling, ViewSegment,
};

use crate::{
    bounds::ErrorBounds,
    envelope::Column,
    tile::{TILE_COLUMNS, TILE_ROWS, TileContext, TileCounters, TileSolver},
};

/// Weights are summed in units of 2^-60 of the whole (directions x segment), as integers: the
/// sum does not depend on order, and cannot overflow, since all weights of a segment add up to
/// at most the whole, see-through ones to at most the whole each.
const WEIGHT_UNIT: f64 = (1u64 << 60) as f64;

/// Tiles that a thread takes at once: some milliseconds.
const TILES_AT_ONCE: usize = 8;

/// What is visible from a segment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SegmentVisibility {
    /// The visible primitives.
    pub set: PrimitiveSet,
    /// For each member of the set, ascending: the share of (directions x segment) on which it is
    /// visible, in (0, 1].
    pub weights: Vec<f32>,
    /// The share of (directions x segment) on which something is seen that is missing in the set,
    /// as far as the last passes can tell.
    pub missing: f64,
    /// What it took.
    pub statistics: Statistics,
}

/// Counters of one solve.
pub type Statistics = TileCounters;

/// How a segment is solved: when it goes on with finer rays.
#[derive(Clone, Copy, Debug, Default)]
pub struct SolveOptions<'a> {
    /// Passes beyond the first, each with twice the rows and columns.
    pub passes: u32,
    /// A tile is refined when more than this share of (directions x segment) may be missing in it.
    pub threshold: f64,
    /// What is known to be visible whatever this segment sees: it is never missing.
    pub known: Option<&'a PrimitiveSet>,
    /// Do without the instructions that only some processors have. The result is the same.
    pub portable: bool,
}

/// A tile of a pass's grid.
#[derive(Clone, Copy, Debug)]
struct Tile {
    face: usize,
    /// Place in the grid, in tiles.
    row: u32,
    column: u32,
    /// Share of its directions that the tile and what refines it weigh.
    share: f64,
}

/// A primitive in a tile.
#[derive(Clone, Copy, Debug)]
struct Find {
    primitive: u32,
    /// Rays that see it.
    rays: u32,
    /// Share of (directions x segment) on which they do, units of [`WEIGHT_UNIT`].
    weight: u64,
}

/// The grid of one pass.
struct Grid {
    sampling: Sampling,
    columns: Vec<Column>,
}

impl Grid {
    fn new(sampling: Sampling, frame: &RectifiedFrame, bounds: &ErrorBounds) -> Self {
        let columns = (0..sampling.columns())
            .map(|j| Column::new(sampling.column(j), frame.length, bounds))
            .collect();
        Self { sampling, columns }
    }

    /// Tiles in a column and in a row of a face.
    fn tiles(&self) -> (u32, u32) {
        let tiles = |rays: u32, size: usize| rays.div_ceil(size as u32);
        (tiles(self.sampling.rows(), TILE_ROWS), tiles(self.sampling.columns(), TILE_COLUMNS))
    }

    /// The tiles of all faces.
    fn all_tiles(&self) -> Vec<Tile> {
        let (rows, columns) = self.tiles();
        (0..FACE_COUNT)
            .flat_map(|face| (0..rows).map(move |row| (face, row)))
            .flat_map(|(face, row)| {
                (0..columns).map(move |column| Tile { face, row, column, share: 1.0 })
            })
            .collect()
    }

    /// The tiles of this grid inside a tile of the grid with half the rows and columns.
    fn inside(&self, tile: &Tile, share: f64) -> impl Iterator<Item = Tile> {
        let (rows, columns) = self.tiles();
        let Tile { face, row, column, .. } = *tile;
        (2 * row..rows.min(2 * row + 2))
            .flat_map(move |row| (2 * column..columns.min(2 * column + 2)).map(move |c| (row, c)))
            .map(move |(row, column)| Tile { face, row, column, share })
    }

    /// What a tile's rays see, ascending.
    fn solve(&self, context: &TileContext, solver: &mut TileSolver, tile: &Tile) -> Vec<Find> {
        let sampling = self.sampling;
        let first_row = tile.row * TILE_ROWS as u32;
        let first_column = tile.column * TILE_COLUMNS as u32;
        let end_row = sampling.rows().min(first_row + TILE_ROWS as u32);
        let rows: Vec<f64> = (first_row..end_row).map(|i| sampling.row(i)).collect();
        let columns = &self.columns[first_column as usize..][..TILE_COLUMNS];
        let angles = solid_angles(sampling, first_row..end_row, first_column);
        // (primitive, pixel) in one number, to sort by both at once.
        let mut seen: Vec<(u64, u64)> = Vec::new();
        solver.solve(context, &rows, columns, |primitive, pixel, length| {
            let weight = (length * angles[pixel] * WEIGHT_UNIT) as u64;
            seen.push((u64::from(primitive) << 32 | pixel as u64, weight));
        });
        seen.sort_unstable_by_key(|s| s.0);
        let mut finds: Vec<Find> = Vec::new();
        let mut last = u64::MAX;
        for (key, weight) in seen {
            let primitive = (key >> 32) as u32;
            let rays = u32::from(key != last);
            last = key;
            match finds.last_mut() {
                Some(find) if find.primitive == primitive => {
                    find.rays += rays;
                    find.weight = find.weight.saturating_add(weight);
                }
                _ => finds.push(Find { primitive, rays, weight }),
            }
        }
        finds
    }
}

/// Sorts by primitive, and adds up what is of equal ones.
fn join<T: Copy>(finds: &mut Vec<(u32, T)>, add: impl Fn(T, T) -> T) {
    finds.sort_unstable_by_key(|f| f.0);
    finds.dedup_by(|b, a| {
        let same = a.0 == b.0;
        if same {
            a.1 = add(a.1, b.1);
        }
        same
    });
}

/// Finds the primitives visible from a segment, along the rays of `sampling`.
///
/// A segment without length sees nothing. Runs on the current rayon pool; the result is the same
/// on any.
#[must_use]
pub fn solve_segment(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
) -> SegmentVisibility {
    solve_segment_with(geometry, segment, sampling, &SolveOptions::default())
}

/// Finds the primitives visible from a segment, along the rays of `sampling` and finer ones where
/// `options` ask for them.
#[must_use]
pub fn solve_segment_with(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
    options: &SolveOptions,
) -> SegmentVisibility {
    let Some(frame) = RectifiedFrame::new(segment) else { return SegmentVisibility::default() };
    let bounds = ErrorBounds::new(geometry, &frame);
    let threshold = (options.threshold.clamp(0.0, 1.0) * WEIGHT_UNIT) as u64;

    let mut grid = Grid::new(sampling, &frame, &bounds);
    let mut tiles = grid.all_tiles();
    let mut statistics = TileCounters::default();
    // Rays that see a primitive, and its weight; ascending.
    let mut rays: Vec<(u32, u32)> = Vec::new();
    let mut weights: Vec<(u32, u64)> = Vec::new();
    let mut missing = 0.0;
    for pass in 0..=options.passes {
        let solved: Vec<(Vec<Find>, TileCounters)> = tiles
            .par_iter()
            .with_min_len(TILES_AT_ONCE)
            .map_init(TileSolver::default, |solver, tile| {
                solver.counters = TileCounters::default();
                solver.portable = options.portable;
                let face = frame.face(tile.face);
                let context = TileContext { geometry, frame: &frame, face, bounds: &bounds };
                let finds = grid.solve(&context, solver, tile);
                (finds, solver.counters)
            })
            .collect();
        for (finds, counters) in &solved {
            statistics = statistics.plus(*counters);
            rays.extend(finds.iter().map(|f| (f.primitive, f.rays)));
        }
        join(&mut rays, u32::saturating_add);
        let seen_once = |find: &&Find| {
            find.rays == 1
                && rays.binary_search_by_key(&find.primitive, |r| r.0).is_ok_and(|k| rays[k].1 == 1)
                && !options.known.is_some_and(|k| k.contains(PrimitiveId(find.primitive)))
        };
        let finer = Grid::new(grid.sampling.finer(), &frame, &bounds);
        let mut next = Vec::new();
        for (tile, (finds, _)) in tiles.iter().zip(&solved) {
            let alone: u64 = finds.iter().filter(seen_once).map(|f| f.weight).sum();
            let mut share = tile.share;
            if pass < options.passes && alone > threshold {
                // One ray of five; the other four are in the four tiles inside.
                next.extend(finer.inside(tile, 0.8 * share));
                share *= 0.2;
            } else {
                missing += alone as f64 / WEIGHT_UNIT;
            }
            weights.extend(finds.iter().map(|f| (f.primitive, (f.weight as f64 * share) as u64)));
        }
        join(&mut weights, u64::saturating_add);
        if next.is_empty() {
            break;
        }
        (grid, tiles) = (finer, next);
    }
    SegmentVisibility {
        set: PrimitiveSet::from_sorted(weights.iter().map(|f| f.0)),
        weights: weights.iter().map(|f| (f.1 as f64 / WEIGHT_UNIT) as f32).collect(),
        missing,
        statistics,
    }
}

impl TileCounters {
    /// Sums of two.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            rays: self.rays + other.rays,
            nodes: self.nodes + other.nodes,
            triangles: self.triangles + other.triangles,
            cuts: self.cuts + other.cuts,
            pixel_tests: self.pixel_tests + other.pixel_tests,
            intervals: self.intervals + other.intervals,
        }
    }
}

/// The share of the sphere of each pixel of a tile, row by row.
fn solid_angles(
    sampling: Sampling,
    rows: std::ops::Range<u32>,
    first_column: u32,
) -> [f64; TILE_ROWS * TILE_COLUMNS] {
    const WIDTH: usize = TILE_COLUMNS + 1;
    let whole = 4.0 * std::f64::consts::PI;
    // One corner evaluation a grid point: differences of the closed form from (0, 0).
    let mut corners = [0.0; (TILE_ROWS + 1) * WIDTH];
    for (i, row) in (rows.start..=rows.end).enumerate() {
        let w = sampling.w(f64::from(row));
        for j in 0..WIDTH {
            let c = sampling.c(f64::from(first_column + j as u32));
            corners[i * WIDTH + j] = Sampling::solid_angle(0.0, c, 0.0, w);
        }
    }
    std::array::from_fn(|pixel| {
        let at = pixel / TILE_COLUMNS * WIDTH + pixel % TILE_COLUMNS;
        let [a, b, c, d] = [at, at + 1, at + WIDTH, at + WIDTH + 1].map(|k| corners[k]);
        ((d - c) - (b - a)) / whole
    })
}
