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
//! Over several states, each state is solved as if it were alone: what is refined for it depends on what
//! is seen in it. What is seen of what rests is shared. A tile's result is that of the resting scene for
//! all states in which nothing that moves is seen there, and finds are kept with the set of states they
//! are of, as bits.
//!
//! Where only units larger than a primitive are asked for ([`Units`]), finds are of units: a unit that a
//! ray sees is seen whole, so far fewer are seen by one ray alone, and far less is refined. A unit is
//! *settled* in a state once two rays have seen it, or when it was known before: nothing can make it more
//! seen, nor missing. The passes behind the first do not look where all that reaches into a tile is
//! settled. The weight of a unit is what the first pass that sees it finds: it looks everywhere.
//!
//! Source of the estimate: Good, "The population frequencies of species and the estimation of
//! population parameters" (Biometrika 1953).
//!
//! Invariants:
//! - a pass depends on the ones before it alone, through sums of integers: the result is the same
//!   on any number of threads (VI-3);
//! - all weights of occluders add up to at most the whole: a ray's share of the directions is
//!   divided between it and the finer rays around it (of primitives; units have weights of one pass);
//! - to look no further changes neither what may be missing nor which units are visible, but for units
//!   that are known anyway: those may be left out.

use rayon::prelude::*;
use std::ops::Range;

use sightline_geometry::{
    FACE_COUNT, Granularity, InstancedGeometry, PrimitiveId, PrimitiveSet, RectifiedFrame, Run,
    Sampling, StateSets, Units, ViewSegment,
};

use crate::{
    bounds::ErrorBounds,
    envelope::Column,
    states::{StateVisibility, TimePath},
    tile::{Motion, Settled, TILE_COLUMNS, TILE_ROWS, TileContext, TileCounters, TileSolver, When},
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
    /// visible, in (0, 1]. Members of a larger unit have equal parts of its share.
    pub weights: Vec<f32>,
    /// The share of (directions x segment) on which something is seen that is missing in the set,
    /// as far as the last passes can tell.
    pub missing: f64,
    /// What it took; of several runs of states that were solved together, the first has all.
    pub statistics: Statistics,
    /// Where it looked, of a scene at rest.
    pub trace: SegmentTrace,
}

/// Where a solve of a scene at rest looked, and what it saw too little of: with the visible set, all that
/// its result depends on. See [`crate::is_affected`].
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SegmentTrace {
    /// For each pass behind the first, which looks everywhere, the numbers of its tiles, ascending.
    pub tiles: Vec<Vec<u32>>,
    /// Primitives that were nearest somewhere, but nowhere on enough to be visible.
    pub grazed: PrimitiveSet,
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
    /// Do without temporal bounding volumes: what moves is looked at in every state. The result is the
    /// same.
    pub without_volumes: bool,
    /// What is visible as a whole; absent: every primitive for itself.
    pub units: Option<&'a Units>,
    /// Look on where all that can be seen has been. The result is the same.
    pub exhaustive: bool,
}

/// States that are solved together: the bits of a [`States`].
const STATES_AT_ONCE: u32 = u64::BITS;

/// A set of states, counted from the first of those that are solved together.
type States = u64;

/// A tile of a pass's grid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tile {
    face: usize,
    /// Place in the grid, in tiles.
    row: u32,
    column: u32,
    /// Share of its directions that the tile and what refines it weigh.
    share: f64,
    /// States that it is solved for.
    states: States,
}

/// A primitive, or a unit by its first, in a tile, or in several.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Find {
    primitive: u32,
    /// Rays that see it.
    rays: u32,
    /// States in which they do.
    states: States,
    /// Share of (directions x segment) on which they do, units of [`WEIGHT_UNIT`].
    weight: u64,
}

/// What the rays of a tile see, by primitive; a primitive once for each set of states.
type Finds = Vec<Find>;

/// The grid of one pass.
pub(crate) struct Grid {
    pub(crate) sampling: Sampling,
    columns: Vec<Column>,
}

impl Grid {
    pub(crate) fn new(sampling: Sampling, frame: &RectifiedFrame, bounds: &ErrorBounds) -> Self {
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

    /// Number of a tile in the order of [`Grid::all_tiles`].
    fn number(&self, tile: &Tile) -> u32 {
        let (rows, columns) = self.tiles();
        (tile.face as u32 * rows + tile.row) * columns + tile.column
    }

    /// Face, rows and columns of the tile with a number.
    ///
    /// # Panics
    /// When there is none.
    pub(crate) fn rays(&self, number: u32) -> (usize, Vec<f64>, &[Column]) {
        let (rows, columns) = self.tiles();
        let (column, row) = (number % columns, number / columns % rows);
        let (rows, columns) = self.rays_of(row, column);
        (self.face_of(number), rows, columns)
    }

    fn face_of(&self, number: u32) -> usize {
        let (rows, columns) = self.tiles();
        let face = (number / columns / rows) as usize;
        assert!(face < FACE_COUNT, "tile {number} is not in the grid");
        face
    }

    /// Number of tiles.
    pub(crate) fn tile_count(&self) -> u32 {
        let (rows, columns) = self.tiles();
        FACE_COUNT as u32 * rows * columns
    }

    fn rays_of(&self, row: u32, column: u32) -> (Vec<f64>, &[Column]) {
        let first_row = row * TILE_ROWS as u32;
        let end_row = self.sampling.rows().min(first_row + TILE_ROWS as u32);
        let rows = (first_row..end_row).map(|i| self.sampling.row(i)).collect();
        (rows, &self.columns[column as usize * TILE_COLUMNS..][..TILE_COLUMNS])
    }

    /// The tiles of all faces.
    fn all_tiles(&self, states: States) -> Vec<Tile> {
        let (rows, columns) = self.tiles();
        (0..FACE_COUNT)
            .flat_map(|face| (0..rows).map(move |row| (face, row)))
            .flat_map(|(face, row)| {
                (0..columns).map(move |column| Tile { face, row, column, share: 1.0, states })
            })
            .collect()
    }

    /// The tiles of this grid inside a tile of the grid with half the rows and columns.
    fn inside(&self, tile: &Tile, share: f64, states: States) -> impl Iterator<Item = Tile> {
        let (rows, columns) = self.tiles();
        let Tile { face, row, column, .. } = *tile;
        (2 * row..rows.min(2 * row + 2))
            .flat_map(move |row| (2 * column..columns.min(2 * column + 2)).map(move |c| (row, c)))
            .map(move |(row, column)| Tile { face, row, column, share, states })
    }

    /// What a tile's rays see, ascending. `time` is the first of the states that are solved together,
    /// and how camera and time are coupled. Units come with what of them is settled, if anything is.
    fn solve(
        &self,
        context: &TileContext,
        solver: &mut TileSolver,
        tile: &Tile,
        time: Option<(u32, TimePath, bool)>,
        units: Option<(&Units, Option<&Settled>)>,
    ) -> Finds {
        let sampling = self.sampling;
        let first_row = tile.row * TILE_ROWS as u32;
        let first_column = tile.column * TILE_COLUMNS as u32;
        let (rows, columns) = self.rays_of(tile.row, tile.column);
        let end_row = first_row + rows.len() as u32;
        let settled = units.and_then(|(_, settled)| settled);
        if settled.is_some_and(|settled| solver.meets_only(settled, context, &rows, columns)) {
            return Finds::new();
        }
        let angles = solid_angles(sampling, first_row..end_row, first_column);
        let first_state = time.map_or(0, |t| t.0);
        let numbers: Vec<u32> = members(tile.states).map(|bit| first_state + bit).collect();
        let motion = time.map(|(_, path, volumes)| Motion { states: &numbers, path, volumes });
        // (primitive, pixel) in one number, to sort by both at once.
        let mut seen: Vec<(u64, u64)> = Vec::new();
        let mut current = When::Always;
        let mut finds = Finds::new();
        // Neighbours in space are often of one unit.
        let mut unit = 0..0;
        // Where the finds of the state before begin.
        let (mut begin, mut own_states) = (0, 0);
        solver.solve(context, &rows, columns, motion, |when, mut primitive, pixel, length| {
            if let Some((units, _)) = units {
                if !unit.contains(&primitive) {
                    unit = units.of(context.geometry, PrimitiveId(primitive));
                }
                primitive = unit.start;
            }
            if when != current {
                flush(&mut seen, current, first_state, &mut finds, &mut begin, &mut own_states);
                current = when;
            }
            let weight = (length * angles[pixel] * WEIGHT_UNIT) as u64;
            seen.push((u64::from(primitive) << 32 | pixel as u64, weight));
        });
        flush(&mut seen, current, first_state, &mut finds, &mut begin, &mut own_states);
        // What rests is seen in the states that have nothing of their own.
        let others = tile.states & !own_states;
        for find in &mut finds {
            if find.states == 0 {
                find.states = others;
            }
        }
        finds.retain(|find| find.states != 0);
        finds.sort_by_key(|find| find.primitive);
        finds
    }
}

/// The members of a set of states, ascending.
fn members(states: States) -> impl Iterator<Item = u32> {
    (0..STATES_AT_ONCE).filter(move |bit| states >> bit & 1 == 1)
}

/// Adds what was seen in a state, or always (without states yet), to the finds. Equal results of
/// states that follow each other become one.
fn flush(
    seen: &mut Vec<(u64, u64)>,
    when: When,
    first_state: u32,
    finds: &mut Finds,
    begin: &mut usize,
    own: &mut States,
) {
    let states = match when {
        When::Always => 0,
        When::In(state) => 1 << (state - first_state),
    };
    *own |= states;
    seen.sort_unstable_by_key(|s| s.0);
    let start = finds.len();
    let mut last = u64::MAX;
    for (key, weight) in seen.drain(..) {
        let primitive = (key >> 32) as u32;
        let rays = u32::from(key != last);
        last = key;
        match finds[start..].last_mut() {
            Some(find) if find.primitive == primitive => {
                find.rays += rays;
                find.weight = find.weight.saturating_add(weight);
            }
            _ => finds.push(Find { primitive, rays, states, weight }),
        }
    }
    let equal = |(a, b): (&Find, &Find)| {
        (a.primitive, a.rays, a.weight) == (b.primitive, b.rays, b.weight) && a.states != 0
    };
    let (before, new) = finds[*begin..].split_at(start - *begin);
    if states != 0 && before.len() == new.len() && before.iter().zip(new).all(equal) {
        finds.truncate(start);
        finds[*begin..].iter_mut().for_each(|find| find.states |= states);
    } else {
        *begin = start;
    }
}

/// Sorts by primitive and states, and adds up what is of equal ones.
fn join(finds: &mut Finds) {
    finds.sort_unstable_by_key(|f| (f.primitive, f.states));
    finds.dedup_by(|b, a| {
        let same = (a.primitive, a.states) == (b.primitive, b.states);
        if same {
            a.rays = a.rays.saturating_add(b.rays);
            a.weight = a.weight.saturating_add(b.weight);
        }
        same
    });
}

/// The finds of one primitive at a time.
fn by_primitive(finds: &[Find]) -> impl Iterator<Item = &[Find]> {
    finds.chunk_by(|a, b| a.primitive == b.primitive)
}

/// The states in which exactly one ray sees a primitive, and those in which more do, from its finds.
fn seen_once_or_more(finds: &[Find]) -> (States, States) {
    let (mut once, mut more) = (0, 0);
    for find in finds.iter().filter(|find| find.rays > 0) {
        more |= if find.rays > 1 { find.states } else { once & find.states };
        once |= find.states;
    }
    (once & !more, more)
}

/// Adds the weights that a tile's finds have, to its own share of the directions: what finer rays look at
/// again weighs a fifth, as one ray of five.
fn weigh(found: &mut Finds, finds: &Finds, tile: &Tile, refined: States) {
    for find in finds {
        let shares = [(!refined, tile.share), (refined, 0.2 * tile.share)];
        for (states, share) in shares.map(|(s, share)| (s & find.states, share)) {
            if states != 0 {
                let weight = (find.weight as f64 * share) as u64;
                found.push(Find { rays: 0, states, weight, ..*find });
            }
        }
    }
}

/// Adds the weights of units that no pass before has seen. `before` has what those saw, ascending.
fn weigh_units(found: &mut Finds, finds: &Finds, tile: &Tile, before: &[(u32, States)]) {
    for find in finds {
        let at = before.binary_search_by_key(&find.primitive, |b| b.0);
        let states = find.states & !at.map_or(0, |k| before[k].1);
        if states != 0 {
            let weight = (find.weight as f64 * tile.share) as u64;
            found.push(Find { rays: 0, states, weight, ..*find });
        }
    }
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
/// `options` ask for them. What moves is as it is at the first key frame.
#[must_use]
pub fn solve_segment_with(
    geometry: &InstancedGeometry,
    segment: &ViewSegment,
    sampling: Sampling,
    options: &SolveOptions,
) -> SegmentVisibility {
    let path = TimePath::stopped(0.0);
    let known = options.known.map(|set| StateSets::constant(0..1, set.clone()));
    let solve = Solve { geometry, segment, sampling, states: 0..1, path, known: known.as_ref() };
    let mut found = solve.run(options);
    found.pop().map(|run| run.visibility).unwrap_or_default()
}

/// What is solved: at most [`STATES_AT_ONCE`] states of a segment.
pub(crate) struct Solve<'a> {
    pub geometry: &'a InstancedGeometry,
    pub segment: &'a ViewSegment,
    pub sampling: Sampling,
    pub states: Range<u32>,
    pub path: TimePath,
    pub known: Option<&'a StateSets>,
}

impl Solve<'_> {
    /// Most states of one solve.
    pub(crate) const MOST: u32 = STATES_AT_ONCE;

    /// Runs of states with equal results, ascending; none for a segment without length.
    pub(crate) fn run(&self, options: &SolveOptions) -> Vec<StateVisibility> {
        let Self { geometry, segment, sampling, ref states, path, known } = *self;
        let Some(frame) = RectifiedFrame::new(segment) else { return Vec::new() };
        let bounds = ErrorBounds::new(geometry, &frame);
        let threshold = (options.threshold.clamp(0.0, 1.0) * WEIGHT_UNIT) as u64;
        let units = options.units.filter(|u| u.granularity() != Granularity::Triangle);
        let count = states.end - states.start;
        let all: States = States::MAX >> (STATES_AT_ONCE - count);
        let moves = geometry.has_motion() || !geometry.particles.is_empty();
        let time = moves.then_some((states.start, path, !options.without_volumes));
        let known_in = |primitive: u32| -> States {
            let Some(known) = known else { return 0 };
            let mut bits = 0;
            for (run, set) in known.runs() {
                if set.contains(PrimitiveId(primitive)) {
                    for state in run.start.max(states.start)..run.end.min(states.end) {
                        bits |= 1 << (state - states.start);
                    }
                }
            }
            bits
        };

        let mut grid = Grid::new(sampling, &frame, &bounds);
        let mut tiles = grid.all_tiles(all);
        let mut statistics = TileCounters::default();
        // Rays that see a primitive, and its weight; ascending.
        let mut found = Finds::new();
        let mut missing = vec![0.0; count as usize];
        // What the passes before saw, and in which states.
        let mut before: Vec<(u32, States)> = Vec::new();
        let mut settled: Option<Settled> = None;
        let mut looked: Vec<Vec<u32>> = Vec::new();
        let mut grazed: Vec<u32> = Vec::new();
        for pass in 0..=options.passes {
            let mut solved: Vec<(Finds, TileCounters, Vec<u32>)> = tiles
                .par_iter()
                .with_min_len(TILES_AT_ONCE)
                .map_init(TileSolver::default, |solver, tile| {
                    solver.counters = TileCounters::default();
                    solver.portable = options.portable;
                    let face = frame.face(tile.face);
                    let context = TileContext { geometry, frame: &frame, face, bounds: &bounds };
                    let units = units.map(|units| (units, settled.as_ref()));
                    let finds = grid.solve(&context, solver, tile, time, units);
                    (finds, solver.counters, std::mem::take(&mut solver.grazed))
                })
                .collect();
            // Weights are added when it is known what share of its directions a tile weighs.
            for (finds, counters, own) in &mut solved {
                grazed.append(own);
                statistics = statistics.plus(*counters);
                found.extend(finds.iter().map(|f| Find { weight: 0, ..*f }));
            }
            join(&mut found);
            let mut alone_in: Vec<(u32, States)> = Vec::new();
            let mut done = Vec::new();
            for of_one in by_primitive(&found) {
                let (once, more) = seen_once_or_more(of_one);
                let primitive = of_one[0].primitive;
                if once != 0 {
                    alone_in.push((primitive, once & !known_in(primitive)));
                }
                if units.is_some() && more == all {
                    done.push(primitive);
                }
            }
            if let Some(units) = units.filter(|_| !options.exhaustive) {
                settled = Some(Settled::new(geometry, units, &done, known, states));
            }
            let finer = Grid::new(grid.sampling.finer(), &frame, &bounds);
            let mut next = Vec::new();
            let mut alone = vec![0u64; count as usize];
            for (tile, (finds, ..)) in tiles.iter().zip(&solved) {
                alone.fill(0);
                for find in finds.iter().filter(|f| f.rays == 1) {
                    let at = alone_in.binary_search_by_key(&find.primitive, |a| a.0);
                    let states = at.map_or(0, |k| alone_in[k].1 & find.states);
                    members(states).for_each(|bit| alone[bit as usize] += find.weight);
                }
                let mut refined: States = 0;
                for bit in members(tile.states) {
                    let alone = alone[bit as usize];
                    if pass < options.passes && alone > threshold {
                        refined |= 1 << bit;
                    } else {
                        missing[bit as usize] += alone as f64 / WEIGHT_UNIT;
                    }
                }
                // One ray of five; the other four are in the four tiles inside.
                if refined != 0 {
                    next.extend(finer.inside(tile, 0.8 * tile.share, refined));
                }
                match units {
                    None => weigh(&mut found, finds, tile, refined),
                    Some(_) => weigh_units(&mut found, finds, tile, &before),
                }
            }
            join(&mut found);
            if units.is_some() {
                before = by_primitive(&found)
                    .map(|of_one| (of_one[0].primitive, of_one.iter().fold(0, |s, f| s | f.states)))
                    .collect();
            }
            if next.is_empty() {
                break;
            }
            (grid, tiles) = (finer, next);
            let mut numbers: Vec<u32> = tiles.iter().map(|tile| grid.number(tile)).collect();
            numbers.sort_unstable();
            looked.push(numbers);
        }
        let mut runs = runs(&found, states, &missing, statistics, |first| {
            units.map_or(first..first + 1, |units| units.of(geometry, PrimitiveId(first)))
        });
        if let (None, [only]) = (time, &mut runs[..]) {
            let set = &only.visibility.set;
            grazed.retain(|primitive| !set.contains(PrimitiveId(*primitive)));
            grazed.sort_unstable();
            let grazed = PrimitiveSet::from_sorted(grazed);
            only.visibility.trace = SegmentTrace { tiles: looked, grazed };
        }
        runs
    }
}

/// Finds as runs of states with equal results. `unit` gives the primitives of a unit, by its first.
fn runs(
    found: &[Find],
    states: &Range<u32>,
    missing: &[f64],
    statistics: TileCounters,
    unit: impl Fn(u32) -> Range<u32>,
) -> Vec<StateVisibility> {
    // Bit k: something differs between states k and k + 1.
    let mut differs = 0;
    for find in found {
        differs |= find.states ^ (find.states >> 1);
    }
    let count = states.end - states.start;
    let mut out: Vec<StateVisibility> = Vec::new();
    let mut first = 0;
    for last in 0..count {
        let equal = last + 1 < count
            && differs >> last & 1 == 0
            && missing[last as usize] == missing[last as usize + 1];
        if equal {
            continue;
        }
        let mut set = PrimitiveSet::default();
        let mut weights: Vec<f32> = Vec::new();
        for of_one in by_primitive(found) {
            let here = of_one.iter().filter(|f| f.states >> first & 1 == 1);
            let (mut any, mut weight) = (false, 0u64);
            for find in here {
                any = true;
                weight = weight.saturating_add(find.weight);
            }
            if any {
                let Range { start: first, end } = unit(of_one[0].primitive);
                set.push(Run { first, end });
                let parts = f64::from(end - first);
                let part = (weight as f64 / WEIGHT_UNIT / parts) as f32;
                weights.extend((first..end).map(|_| part));
            }
        }
        let missing = missing[first as usize];
        // What it took is counted once.
        let statistics = if first == 0 { statistics } else { TileCounters::default() };
        let visibility =
            SegmentVisibility { set, weights, missing, statistics, ..Default::default() };
        let run = states.start + first..states.start + last + 1;
        match out.last_mut() {
            Some(before) if before.visibility.same_result(&visibility) => {
                before.states.end = run.end
            }
            _ => out.push(StateVisibility { states: run, visibility }),
        }
        first = last + 1;
    }
    out
}

impl SegmentVisibility {
    /// True when both have the same result, whatever it took.
    pub(crate) fn same_result(&self, other: &Self) -> bool {
        (&self.set, &self.weights) == (&other.set, &other.weights) && self.missing == other.missing
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
            volumes: self.volumes + other.volumes,
            skipped: self.skipped + other.skipped,
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
