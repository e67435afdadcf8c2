//! One tile of pixels: a hierarchy walk front to back against what has been found.
//!
//! A tile is R rows by C columns of one face. All its rays, for all t, lie in a beam bounded by
//! linear functions of a point's face coordinates (x, y, z):
//!
//! ```text
//! y - w_lo z >= 0    w_hi z - y >= 0    z > 0
//! t_hi = max (x - c_lo z) / L           t_lo = min (x - c_hi z) / L
//! ```
//!
//! so one pass over a node's box gives whether the beam meets it, the stretch of t on which it
//! can be seen, and its nearest depth *inside the beam*: what lies aside of the axis enters the beam
//! only where the beam is wide enough,
//!
//! ```text
//! z >= y / w_hi    z >= y / w_lo    z >= (x - L) / c_hi    z >= x / c_lo
//! ```
//!
//! where the divisor has the sign of what is divided. The pixels' lists are kept by bins of t,
//! each with the farthest depth of what covers it wholly (infinite where something shows through):
//! see [`envelope`](crate::envelope). Above them are the farthest over the pixels of a row, and
//! over the rows of the tile. A node is skipped when it is behind all bins that it can touch.
//!
//! Invariant: skipping never changes the result. Boxes and bins are compared with slack for the
//! rounding of either side, so what is skipped is behind by more than the error bound.

mod moving;
mod settled;

use std::cmp::Ordering;

use glam::{DMat3, DVec3};
use sightline_geometry::{
    Face, InstanceId, InstancedGeometry, Mesh, Node, PrimitiveId, PrimitiveSet, RectifiedFrame,
    STEPS, TopLevel,
};

use crate::{
    bounds::ErrorBounds,
    cut::Cut,
    envelope::{BINS, Column, Envelopes, Interval, Line, bin_of, largest, least},
    states::TimePath,
};

pub use settled::Settled;

/// Most rows of a tile. Small tiles have tight beams, large ones share a walk; these are the
/// fastest measured, with little between them and their neighbours.
pub const TILE_ROWS: usize = 8;

/// Columns of a tile.
pub const TILE_COLUMNS: usize = 4;

/// Triangles whose corners are transformed together.
const LANES: usize = 4;

/// What a hierarchy walk does with the cuts that it finds.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Pass {
    /// Occluders are inserted into the pixels' lists.
    Occluders,
    /// See-through cuts are compared with the finished lists.
    SeeThrough,
}

/// Face coordinates of a hierarchy's space, and the tile's beam in that space.
struct Space {
    face_from_local: DMat3,
    offset: DVec3,
    instance: InstanceId,
    normal: [DVec3; 7],
    extent: [DVec3; 7],
    constant: [f64; 7],
}

/// How far something has to be to be inside a tile's beam.
///
/// The divisors of the bounds are kept as their inverses, 0 for a side on which there is no bound: the
/// result is then 0, which all depths are at least. Where a divisor is small, the rounding of what is
/// divided counts for as much more, so that is taken off before.
#[derive(Clone, Copy, Debug, Default)]
struct Wedge {
    /// For x - L and -x: what is taken off, and the inverse of the largest and of -(the least c).
    columns: [(f64, f64); 2],
    /// For y and -y: what is taken off, and the inverse of the largest and of -(the least w).
    rows: [(f64, f64); 2],
}

impl Wedge {
    /// The beam between the first and the last of a tile's rows and of its columns. `depth` is the
    /// largest error of a face coordinate, metres.
    fn new(length: f64, rows: (f64, f64), columns: (f64, f64), depth: f64) -> Self {
        let side = |offset: f64, wide: f64| {
            let margin = 4.0 * depth * (1.0 + wide.abs());
            let bounds = wide > 0.0 && wide.is_finite();
            if bounds { (offset + margin, 1.0 / wide) } else { (0.0, 0.0) }
        };
        Self {
            columns: [side(length, columns.1), side(0.0, -columns.0)],
            rows: [side(0.0, rows.1), side(0.0, -rows.0)],
        }
    }

    /// No point of the beam with these x and y (least, largest) has a lesser z.
    #[inline(always)]
    fn nearest(&self, x: (f64, f64), y: (f64, f64)) -> f64 {
        let bound = |value: f64, (off, inverse): (f64, f64)| (value - off) * inverse;
        let by_columns = largest(bound(x.0, self.columns[0]), bound(-x.1, self.columns[1]));
        let by_rows = largest(bound(y.0, self.rows[0]), bound(-y.1, self.rows[1]));
        largest(by_columns, by_rows)
    }
}

#[derive(Clone, Copy)]
struct Entry {
    /// No depth inside the beam is less.
    near: f64,
    /// Depth of the nearest corner, inside the beam or not.
    corner: f64,
    first_bin: u8,
    last_bin: u8,
    /// Rows that it can be seen in, of what moves.
    first_row: u8,
    end_row: u8,
    space: u32,
    node: u32,
}

impl Entry {
    /// What is entered first comes first. Of equals, such as parts of one wall or all that the
    /// camera stands in, what reaches farthest back: the largest hides most.
    #[inline(always)]
    fn order(&self, other: &Self) -> Ordering {
        self.near.total_cmp(&other.near).then(self.corner.total_cmp(&other.corner))
    }

    /// True when it is hidden by what has these far depths.
    #[inline(always)]
    fn is_behind(&self, far: &Far) -> bool {
        far.hides(self.near, self.first_bin, self.last_bin)
    }
}

/// Counters of a solve; sums over tiles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TileCounters {
    /// Directions along which the segment was swept.
    pub rays: u64,
    /// Hierarchy nodes tested against a beam.
    pub nodes: u64,
    /// Triangles whose face coordinates were computed.
    pub triangles: u64,
    /// Row cuts.
    pub cuts: u64,
    /// Pixel tests of a cut.
    pub pixel_tests: u64,
    /// Intervals in the finished lists.
    pub intervals: u64,
    /// Temporal bounding volumes compared with what rests.
    pub volumes: u64,
    /// Moving objects and particles in states in which they were not looked at, as a volume that holds
    /// them was hidden: sums over tiles.
    pub skipped: u64,
}

/// What of a scene's motion a tile is solved for.
#[derive(Clone, Copy)]
pub struct Motion<'a> {
    /// States, ascending.
    pub states: &'a [u32],
    /// How camera and time are coupled.
    pub path: TimePath,
    /// Whether what is hidden over a window of states is skipped for as long.
    pub volumes: bool,
}

/// For which states something was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    /// In all states that have nothing of their own.
    Always,
    /// In one state, which has what it sees of its own.
    In(u32),
}

/// What a tile is a part of.
pub struct TileContext<'a> {
    pub geometry: &'a InstancedGeometry,
    pub frame: &'a RectifiedFrame,
    pub face: Face,
    pub bounds: &'a ErrorBounds,
}

/// Far depths of a group of pixels, a bin each.
#[derive(Clone, Copy, Debug)]
struct Far {
    depths: [f64; BINS],
    /// True when a pixel has changed since.
    stale: bool,
}

impl Default for Far {
    fn default() -> Self {
        Self { depths: [f64::INFINITY; BINS], stale: false }
    }
}

impl Far {
    #[inline(always)]
    fn of<'a>(all: impl Iterator<Item = &'a [f64; BINS]>) -> Self {
        let mut depths = [f64::NEG_INFINITY; BINS];
        for one in all {
            for (far, one) in depths.iter_mut().zip(one) {
                *far = if *one > *far { *one } else { *far };
            }
        }
        Self { depths, stale: false }
    }

    /// Whether something no nearer than `near` is hidden in all of these bins.
    #[inline(always)]
    fn hides(&self, near: f64, first_bin: u8, last_bin: u8) -> bool {
        self.depths[first_bin as usize..=last_bin as usize].iter().all(|&far| near > far)
    }
}

/// Solves tiles; keeps its memory from tile to tile. One a thread.
#[derive(Default)]
pub struct TileSolver {
    rows: Vec<f64>,
    columns: Vec<Column>,
    wedge: Wedge,
    envelopes: Envelopes,
    row_far: Vec<Far>,
    tile_far: Far,
    stack: Vec<Entry>,
    spaces: Vec<Space>,
    moving: moving::MovingSolver,
    /// See-through finds: (primitive, pixel in tile, length in t).
    seen_through: Vec<(u32, u32, f64)>,
    /// Primitives that were nearest on so little of a ray that it does not count, in no order; whoever
    /// solves tiles clears it.
    pub grazed: Vec<u32>,
    pub counters: TileCounters,
    /// Do without the instructions that only some processors have.
    pub portable: bool,
}

impl TileSolver {
    /// Solves the tile of rows `w` and columns `c` (coordinates, ascending) and calls
    /// `found(when, primitive, pixel, length)` for everything visible on more than the derived bound:
    /// `pixel` = row * [`TILE_COLUMNS`] + column, `length` in units of t. First what rests is looked at,
    /// alone; then, for each state in which something else is seen, everything.
    pub fn solve(
        &mut self,
        context: &TileContext,
        w: &[f64],
        c: &[Column],
        motion: Option<Motion>,
        found: impl FnMut(When, u32, usize, f64),
    ) {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("lzcnt")
            && !self.portable
        {
            // Sound: the processor has what the function was compiled for.
            #[allow(unsafe_code)]
            return unsafe { self.solve_with_avx2(context, w, c, motion, found) };
        }
        self.solve_anywhere(context, w, c, motion, found);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,bmi1,lzcnt")]
    fn solve_with_avx2(
        &mut self,
        context: &TileContext,
        w: &[f64],
        c: &[Column],
        motion: Option<Motion>,
        found: impl FnMut(When, u32, usize, f64),
    ) {
        self.solve_anywhere(context, w, c, motion, found);
    }

    #[inline(always)]
    fn solve_anywhere(
        &mut self,
        context: &TileContext,
        w: &[f64],
        c: &[Column],
        motion: Option<Motion>,
        mut found: impl FnMut(When, u32, usize, f64),
    ) {
        let pixels = w.len() * TILE_COLUMNS;
        self.counters.rays += pixels as u64;
        self.aim(context, w, c);
        self.envelopes.clear(pixels);
        self.seen_through.clear();
        context.geometry.look();

        self.walk(context, &context.geometry.occluders, Pass::Occluders);
        if !context.geometry.see_through.instances.is_empty() {
            self.walk(context, &context.geometry.see_through, Pass::SeeThrough);
        }
        self.report(pixels, When::Always, &mut found);
        if let Some(motion) = motion {
            self.solve_motion(context, &motion, pixels, &mut found);
        }
    }

    /// True when one of `wanted`, or anything, is nearest on some part of a ray of the tile, however
    /// small, or seen through nothing. The scene is at rest.
    pub fn sees_any(
        &mut self,
        context: &TileContext,
        w: &[f64],
        c: &[Column],
        wanted: Option<&PrimitiveSet>,
    ) -> bool {
        let mut sees = false;
        let is_wanted = |p: u32| wanted.is_none_or(|set| set.contains(PrimitiveId(p)));
        self.grazed.clear();
        self.solve(context, w, c, None, |_, primitive, _, _| sees |= is_wanted(primitive));
        sees || self.grazed.drain(..).any(is_wanted)
    }

    /// Takes the beam of these rows and columns, with nothing found in it.
    #[inline(always)]
    fn aim(&mut self, context: &TileContext, w: &[f64], c: &[Column]) {
        assert!(w.len() <= TILE_ROWS && c.len() == TILE_COLUMNS);
        self.rows.clear();
        self.rows.extend_from_slice(w);
        self.columns.clear();
        self.columns.extend_from_slice(c);
        let (rows, columns) = ((w[0], w[w.len() - 1]), (c[0].c, c[TILE_COLUMNS - 1].c));
        self.wedge = Wedge::new(context.frame.length, rows, columns, context.bounds.depth);
        self.row_far.clear();
        self.row_far.resize(w.len(), Far::default());
        self.tile_far = Far::default();
    }

    /// Calls `found` with the intervals of a pixel of the last state that was solved.
    pub fn intervals(&self, pixel: usize, found: impl FnMut(Interval)) {
        let time_error = self.columns[pixel % TILE_COLUMNS].time_error;
        self.envelopes.intervals(pixel, time_error, found);
    }

    /// Calls `found` with what the lists hold.
    #[inline(always)]
    fn report(&mut self, pixels: usize, when: When, found: &mut impl FnMut(When, u32, usize, f64)) {
        #[cfg(debug_assertions)]
        self.envelopes.assert_well_formed();
        for pixel in 0..pixels {
            let time_error = self.columns[pixel % TILE_COLUMNS].time_error;
            let mut intervals = 0;
            self.envelopes.intervals(pixel, time_error, |interval| {
                intervals += 1;
                if interval.counts() {
                    found(when, interval.primitive, pixel, interval.end - interval.start);
                } else {
                    self.grazed.push(interval.primitive);
                }
            });
            self.counters.intervals += intervals;
        }
        for &(primitive, pixel, length) in &self.seen_through {
            found(when, primitive, pixel as usize, length);
        }
    }

    #[inline(always)]
    fn space(
        &self,
        context: &TileContext,
        face_from_local: DMat3,
        offset: DVec3,
        instance: InstanceId,
    ) -> Space {
        let rows = face_from_local.transpose();
        let (x, y, z) = (rows.x_axis, rows.y_axis, rows.z_axis);
        let (w_lo, w_hi) = (self.rows[0], self.rows[self.rows.len() - 1]);
        let (c_lo, c_hi) = (self.columns[0].c, self.columns[self.columns.len() - 1].c);
        let normal = [y - w_lo * z, w_hi * z - y, x - c_lo * z, x - c_hi * z, z, y, x];
        let constant = [
            offset.y - w_lo * offset.z,
            w_hi * offset.z - offset.y,
            offset.x - c_lo * offset.z,
            offset.x - c_hi * offset.z,
            offset.z,
            offset.y,
            offset.x,
        ];
        // Rounding of a box test and of the vertices in the box: `depth` each, scaled by |c|.
        let slack = |c: f64| 2.0 * context.bounds.depth * (1.0 + c.abs());
        let constant = [
            constant[0] + slack(1.0),
            constant[1] + slack(1.0),
            constant[2] + slack(c_lo),
            constant[3] - slack(c_hi),
            constant[4],
            constant[5],
            constant[6],
        ];
        let extent = normal.map(DVec3::abs);
        Space { face_from_local, offset, instance, normal, extent, constant }
    }

    /// Tests a node against the beam; `None` when it is outside or hidden.
    #[inline(always)]
    fn test(&mut self, context: &TileContext, space: u32, node: u32, of: &Node) -> Option<Entry> {
        self.counters.nodes += 1;
        let s = &self.spaces[space as usize];
        let min = DVec3::from_array(of.bounds.min.map(f64::from));
        let max = DVec3::from_array(of.bounds.max.map(f64::from));
        let (center, half) = (0.5 * (min + max), 0.5 * (max - min));
        let middle = |k: usize| s.normal[k].dot(center) + s.constant[k];
        let reach = |k: usize| s.extent[k].dot(half);
        if middle(0) + reach(0) < 0.0 || middle(1) + reach(1) < 0.0 {
            return None;
        }
        let slack = 2.0 * context.bounds.depth;
        let (z, dz) = (middle(4), reach(4));
        if z + dz < -slack {
            return None;
        }
        let (first, last) = (middle(3) - reach(3), middle(2) + reach(2));
        // `first > last` only behind the camera: no ray of the beam gets there.
        if last < 0.0 || first > context.frame.length || first > last {
            return None;
        }
        let (x, dx) = (middle(6), reach(6));
        let (y, dy) = (middle(5), reach(5));
        let near = largest(z - dz, self.wedge.nearest((x - dx, x + dx), (y - dy, y + dy))) - slack;
        if near > z + dz + slack {
            return None;
        }
        if near > 0.0 {
            let (lo, hi) = (y - dy - slack, y + dy + slack);
            let (a, b) = (1.0 / near, 1.0 / (z + dz + slack));
            let lo = if lo < 0.0 { lo * a } else { lo * b };
            let hi = if hi < 0.0 { hi * b } else { hi * a };
            if rows_met(&self.rows, (lo, hi)).is_empty() {
                return None;
            }
        }
        let entry = self.entry_if_not_hidden(context, near, first, last, space, node)?;
        Some(Entry { corner: z - dz, ..entry })
    }

    /// An entry for something no nearer than `near` that covers at most `first..last` along the
    /// segment (metres), unless it is hidden there in all pixels.
    #[inline(always)]
    fn entry_if_not_hidden(
        &mut self,
        context: &TileContext,
        near: f64,
        first: f64,
        last: f64,
        space: u32,
        node: u32,
    ) -> Option<Entry> {
        let scale = BINS as f64 / context.frame.length;
        let bin = |x: f64| ((x * scale) as usize).min(BINS - 1) as u8;
        let entry = Entry {
            near,
            corner: near,
            first_bin: bin(first),
            last_bin: bin(last),
            first_row: 0,
            end_row: 0,
            space,
            node,
        };
        (!self.is_hidden(&entry)).then_some(entry)
    }

    #[inline(always)]
    fn is_hidden(&mut self, entry: &Entry) -> bool {
        if self.tile_far.stale {
            for row in 0..self.row_far.len() {
                self.refresh_row(row);
            }
            self.tile_far = Far::of(self.row_far.iter().map(|far| &far.depths));
        }
        entry.is_behind(&self.tile_far)
    }

    #[inline(always)]
    fn refresh_row(&mut self, row: usize) {
        if self.row_far[row].stale {
            let pixels = row * TILE_COLUMNS..(row + 1) * TILE_COLUMNS;
            self.row_far[row] = Far::of(pixels.map(|pixel| self.envelopes.far(pixel)));
        }
    }

    /// Starts a walk at the root of a top level, in space 0; `None` when there is nothing.
    #[inline(always)]
    fn enter_world(&mut self, context: &TileContext, top: &TopLevel) -> Option<DMat3> {
        let root = top.hierarchy.nodes.first()?;
        let face_from_world = context.face.face_from_world();
        let offset = face_from_world * (context.geometry.origin - context.frame.v0);
        self.spaces.clear();
        self.stack.clear();
        let space = self.space(context, face_from_world, offset, InstanceId(u32::MAX));
        self.spaces.push(space);
        let entry = self.test(context, 0, 0, root);
        self.stack.extend(entry);
        Some(face_from_world)
    }

    /// The nodes that a walk numbers in one of its spaces.
    #[inline(always)]
    fn nodes_of<'a>(
        &self,
        geometry: &'a InstancedGeometry,
        top: &'a TopLevel,
        space: u32,
    ) -> &'a [Node] {
        if space == 0 {
            return &top.hierarchy.nodes;
        }
        let instance = self.spaces[space as usize].instance;
        let mesh = geometry.instances[instance.index()].mesh;
        &geometry.meshes[mesh.index()].hierarchy.nodes
    }

    /// Walks both levels of a hierarchy front to back.
    #[inline(always)]
    fn walk(&mut self, context: &TileContext, top: &TopLevel, pass: Pass) {
        let geometry = context.geometry;
        let Some(face_from_world) = self.enter_world(context, top) else { return };
        let mut look_at = self.counters.nodes + STEPS;
        while let Some(entry) = self.stack.pop() {
            if self.is_hidden(&entry) {
                continue;
            }
            if self.counters.nodes >= look_at {
                look_at = self.counters.nodes + STEPS;
                geometry.look();
            }
            let nodes = self.nodes_of(geometry, top, entry.space);
            let node = nodes[entry.node as usize];
            let items = node.first as usize..(node.first + node.count) as usize;
            if !node.is_leaf() {
                let left = self.test(context, entry.space, node.first, &nodes[items.start]);
                let right =
                    self.test(context, entry.space, node.first + 1, &nodes[items.start + 1]);
                match (left, right) {
                    (Some(l), Some(r)) if l.order(&r).is_le() => self.stack.extend([r, l]),
                    (Some(l), Some(r)) => self.stack.extend([l, r]),
                    (one, other) => self.stack.extend(one.or(other)),
                }
            } else if entry.space == 0 {
                self.enter(context, face_from_world, &top.instances[items]);
            } else {
                self.leaf(context, entry.space, items, pass);
            }
        }
    }

    /// Pushes the roots of instances, the nearest on top.
    #[inline(always)]
    fn enter(&mut self, context: &TileContext, face_from_world: DMat3, ids: &[InstanceId]) {
        let bottom = self.stack.len();
        for &id in ids {
            let instance = &context.geometry.instances[id.index()];
            let map = &instance.world_from_mesh;
            let offset = face_from_world * (map.translation - context.frame.v0);
            let space = self.space(context, face_from_world * map.matrix3, offset, id);
            let number = self.spaces.len() as u32;
            self.spaces.push(space);
            let root = &context.geometry.meshes[instance.mesh.index()].hierarchy.nodes[0];
            match self.test(context, number, 0, root) {
                Some(entry) => self.stack.push(entry),
                None => {
                    self.spaces.pop();
                }
            }
        }
        self.stack[bottom..].sort_by(|a, b| b.order(a));
    }

    #[inline(always)]
    fn leaf(
        &mut self,
        context: &TileContext,
        space: u32,
        items: std::ops::Range<usize>,
        pass: Pass,
    ) {
        let s = &self.spaces[space as usize];
        let (matrix, offset) = (s.face_from_local, s.offset);
        let instance = &context.geometry.instances[s.instance.index()];
        let mesh = &context.geometry.meshes[instance.mesh.index()];
        for start in items.clone().step_by(LANES) {
            let lanes = LANES.min(items.end - start);
            let first = instance.first_primitive.0 + start as u32;
            let corners = FaceTriangles::new(mesh, &mesh.positions, start, lanes, &matrix, offset);
            self.still_triangles(context, &corners, lanes, first, pass);
        }
    }

    /// Triangles that rest, the first of them with this global number.
    #[inline(always)]
    fn still_triangles(
        &mut self,
        context: &TileContext,
        corners: &FaceTriangles,
        lanes: usize,
        first_primitive: u32,
        pass: Pass,
    ) {
        let (c_lo, c_hi) = (self.columns[0].c, self.columns[TILE_COLUMNS - 1].c);
        let slack = |c: f64| 2.0 * context.bounds.depth * (1.0 + c.abs());
        let (slack_lo, slack_hi) = (slack(c_lo), slack(c_hi));
        self.counters.triangles += lanes as u64;
        let extents = corners.extents(c_lo, c_hi);
        for lane in 0..lanes {
            let rows = rows_met(&self.rows, extents.rows(lane));
            if rows.is_empty() {
                continue;
            }
            let (first, last) = (extents.first[lane] - slack_hi, extents.last[lane] + slack_lo);
            if last < 0.0 || first > context.frame.length || first > last {
                continue;
            }
            let inside = self.wedge.nearest(extents.x(lane), extents.y(lane));
            let near = largest(extents.near[lane], inside) - 2.0 * context.bounds.depth;
            if self.entry_if_not_hidden(context, near, first, last, 0, 0).is_none() {
                continue;
            }
            let triangle = corners.triangle(lane);
            let stretches = self.stretches(&triangle);
            let primitive = first_primitive + lane as u32;
            for row in rows {
                let hidden = stretches.iter().enumerate().all(|(k, bins)| {
                    let far = self.envelopes.far(row * TILE_COLUMNS + k);
                    far[bins.clone()].iter().all(|&far| near > far)
                });
                if hidden {
                    continue;
                }
                let on_axis = context.bounds.depth;
                let cut = Cut::of_triangle(&triangle, self.rows[row], on_axis, primitive);
                if let Some(cut) = cut {
                    self.counters.cuts += 1;
                    self.row_cut(context, row, &cut, pass);
                }
            }
        }
    }

    /// For each column, the bins that a triangle can meet; empty where it meets none.
    #[inline(always)]
    fn stretches(&self, triangle: &[DVec3; 3]) -> [std::ops::Range<usize>; TILE_COLUMNS] {
        let (mut first, mut last) =
            ([f64::INFINITY; TILE_COLUMNS], [f64::NEG_INFINITY; TILE_COLUMNS]);
        let mut slack = [0.0; TILE_COLUMNS];
        for (k, column) in self.columns.iter().enumerate() {
            slack[k] = column.time_error * 4.0;
            for p in triangle {
                let t = (p.x - column.c * p.z) * column.inverse_length;
                first[k] = least(first[k], t);
                last[k] = largest(last[k], t);
            }
        }
        std::array::from_fn(|k| {
            let (first, last) = (first[k] - slack[k], last[k] + slack[k]);
            if last < 0.0 || first > 1.0 { 0..0 } else { bin_of(first)..bin_of(last) + 1 }
        })
    }

    #[inline(always)]
    fn row_cut(&mut self, context: &TileContext, row: usize, cut: &Cut, pass: Pass) {
        let columns: &[Column; TILE_COLUMNS] =
            self.columns[..].try_into().expect("a tile has TILE_COLUMNS columns");
        let times = columns.map(|column| cut.times(column.c, column.inverse_length));
        for (k, column) in columns.iter().enumerate() {
            let (ta, tb) = times[k];
            let (a, b) = (largest(least(ta, tb), 0.0), least(largest(ta, tb), 1.0));
            if a >= b {
                continue;
            }
            self.counters.pixel_tests += 1;
            let pixel = row * TILE_COLUMNS + k;
            let nearest = least(cut.za, cut.zb) - 2.0 * context.bounds.depth;
            let bins = bin_of(a)..=bin_of(b);
            if self.envelopes.far(pixel)[bins].iter().all(|&far| nearest > far) {
                continue;
            }
            let line = Line::new(cut, column, times[k]);
            match pass {
                Pass::Occluders => {
                    if self.envelopes.insert(pixel, line, a, b) {
                        self.row_far[row].stale = true;
                        self.tile_far.stale = true;
                        self.moving.changed = true;
                    }
                }
                Pass::SeeThrough => {
                    let seen = self.envelopes.unhidden_length(pixel, &line, None, (a, b));
                    if seen > context.bounds.shortest_interval(column.c) {
                        self.seen_through.push((cut.primitive, pixel as u32, seen));
                    }
                }
            }
        }
    }
}

/// Up to [`LANES`] triangles in face coordinates; lanes beyond are copies of the last one.
struct FaceTriangles {
    /// Corner, axis, lane.
    corners: [[[f64; LANES]; 3]; 3],
}

/// What decides whether the triangles of [`FaceTriangles`] can be seen, a lane each.
struct Extents {
    near: [f64; LANES],
    /// Least x - c_hi z.
    first: [f64; LANES],
    /// Largest x - c_lo z.
    last: [f64; LANES],
    /// Least and largest y / z; everything when a corner is not in front.
    w: [[f64; LANES]; 2],
    /// Least and largest x.
    x: [[f64; LANES]; 2],
    /// Least and largest y.
    y: [[f64; LANES]; 2],
}

impl Extents {
    #[inline(always)]
    fn rows(&self, lane: usize) -> (f64, f64) {
        (self.w[0][lane], self.w[1][lane])
    }

    #[inline(always)]
    fn x(&self, lane: usize) -> (f64, f64) {
        (self.x[0][lane], self.x[1][lane])
    }

    #[inline(always)]
    fn y(&self, lane: usize) -> (f64, f64) {
        (self.y[0][lane], self.y[1][lane])
    }
}

impl FaceTriangles {
    #[inline(always)]
    fn new(
        mesh: &Mesh,
        positions: &[[f32; 3]],
        start: usize,
        lanes: usize,
        matrix: &DMat3,
        offset: DVec3,
    ) -> Self {
        let mut local = [[[0.0f64; LANES]; 3]; 3];
        for lane in 0..LANES {
            let vertices = mesh.triangles[start + lane.min(lanes - 1)];
            for (corner, vertex) in local.iter_mut().zip(vertices) {
                let stored = positions[vertex as usize];
                for (axis, value) in corner.iter_mut().zip(stored) {
                    axis[lane] = f64::from(value);
                }
            }
        }
        let (mx, my, mz) = (matrix.x_axis, matrix.y_axis, matrix.z_axis);
        let mut corners = [[[0.0f64; LANES]; 3]; 3];
        for (corner, local) in corners.iter_mut().zip(&local) {
            for (axis, out) in corner.iter_mut().enumerate() {
                for lane in 0..LANES {
                    out[lane] = (mx[axis] * local[0][lane] + my[axis] * local[1][lane])
                        + mz[axis] * local[2][lane]
                        + offset[axis];
                }
            }
        }
        Self { corners }
    }

    /// Those between these and `other`, at `t` in [0, 1].
    #[inline(always)]
    fn between(&self, other: &Self, t: f64) -> Self {
        let mut corners = self.corners;
        for (corner, to) in corners.as_flattened_mut().iter_mut().zip(other.corners.as_flattened())
        {
            for lane in 0..LANES {
                corner[lane] = (1.0 - t) * corner[lane] + t * to[lane];
            }
        }
        Self { corners }
    }

    #[inline(always)]
    fn triangle(&self, lane: usize) -> [DVec3; 3] {
        [0, 1, 2].map(|k| {
            let p = &self.corners[k];
            DVec3::new(p[0][lane], p[1][lane], p[2][lane])
        })
    }

    #[inline(always)]
    fn extents(&self, c_lo: f64, c_hi: f64) -> Extents {
        let mut out = Extents {
            near: [f64::INFINITY; LANES],
            first: [f64::INFINITY; LANES],
            last: [f64::NEG_INFINITY; LANES],
            w: [[f64::INFINITY; LANES], [f64::NEG_INFINITY; LANES]],
            x: [[f64::INFINITY; LANES], [f64::NEG_INFINITY; LANES]],
            y: [[f64::INFINITY; LANES], [f64::NEG_INFINITY; LANES]],
        };
        let [w_least, w_largest] = &mut out.w;
        for [x, y, z] in &self.corners {
            for lane in 0..LANES {
                out.near[lane] = least(out.near[lane], z[lane]);
                out.x[0][lane] = least(out.x[0][lane], x[lane]);
                out.x[1][lane] = largest(out.x[1][lane], x[lane]);
                out.y[0][lane] = least(out.y[0][lane], y[lane]);
                out.y[1][lane] = largest(out.y[1][lane], y[lane]);
                out.first[lane] = least(out.first[lane], x[lane] - c_hi * z[lane]);
                out.last[lane] = largest(out.last[lane], x[lane] - c_lo * z[lane]);
                // A quotient that is no number belongs to a corner that is not in front.
                let w = y[lane] / z[lane];
                w_least[lane] = least(w_least[lane], w);
                w_largest[lane] = largest(w_largest[lane], w);
            }
        }
        for lane in 0..LANES {
            if out.near[lane] <= 0.0 {
                w_least[lane] = f64::NEG_INFINITY;
                w_largest[lane] = f64::INFINITY;
            }
        }
        out
    }
}

/// The rows (ascending) whose plane may cut a triangle: those between the least and the largest
/// y / z of its corners. The margin is some 1,000 times the rounding of either side, where |y| is
/// of the size of z; where it is larger, the signs are beyond doubt.
#[inline(always)]
fn rows_met(rows: &[f64], (least, largest): (f64, f64)) -> std::ops::Range<usize> {
    let (least, largest) = (least - 1e-12, largest + 1e-12);
    let before = rows.iter().filter(|&&w| w < least).count();
    let behind = rows.iter().filter(|&&w| w > largest).count();
    before..(rows.len() - behind).max(before)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Numbers of all sizes, next to 0 included.
    fn slope() -> impl Strategy<Value = f64> {
        (-1.0..1.0, -12..1).prop_map(|(mantissa, exponent)| mantissa * 10f64.powi(exponent))
    }

    proptest! {
        #[test]
        fn nothing_in_the_beam_is_nearer_than_its_bound(
            (w0, w1, c0, c1) in (slope(), slope(), slope(), slope()),
            (at_row, at_column, t) in (0.0..=1.0, 0.0..=1.0, 0.0..=1.0),
            (z, length, widen) in (0.0..1000.0, 0.01..100.0, 1.0..100.0),
            errors in prop::array::uniform2(-1.0..1.0),
        ) {
            let between = |a: f64, b: f64, s: f64| (a.min(b) + s * (a - b).abs()).min(a.max(b));
            let rows = (w0.min(w1), w0.max(w1));
            let columns = (widen * c0.min(c1), widen * c0.max(c1));
            let (w, c) = (between(rows.0, rows.1, at_row), between(columns.0, columns.1, at_column));
            // A point of the beam, as far off as rounding puts the corners of a scene of this size.
            let depth = sightline_geometry::gamma(32) * 200_000.0;
            let x = c * z + t * length + errors[0] * depth;
            let y = w * z + errors[1] * depth;
            let wedge = Wedge::new(length, rows, columns, depth);
            let near = wedge.nearest((x, x), (y, y));
            // The walk takes 2 `depth` off what is returned, for the rounding of z.
            prop_assert!(near <= z + 2.0 * depth, "{near} {z}");
        }
    }
}
