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
//! can be seen, and its nearest depth. The tile keeps, for each pixel, a coarse z-buffer over t:
//! `BINS` bins, each with the farthest depth of what covers it wholly (infinite where something
//! shows through), and the farthest over the pixels above it. A node is skipped when it is
//! behind all bins that it can touch.
//!
//! Invariant: skipping never changes the result. Boxes and bins are compared with slack for the
//! rounding of either side, so what is skipped is behind by more than the error bound.

use glam::{DMat3, DVec3};
use sightline_geometry::{
    Face, InstanceId, InstancedGeometry, Node, RectifiedFrame, TopLevel, UNIT_ROUNDOFF,
};

use crate::{
    bounds::ErrorBounds,
    cut::Cut,
    envelope::{self, Column, Interval, Line},
};

/// Bins of the coarse z-buffer over t. Eight let a 10 m segment see past a street corner
/// bin by bin; more cost more to keep than they skip.
const BINS: usize = 8;

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
    normal: [DVec3; 5],
    extent: [DVec3; 5],
    constant: [f64; 5],
}

#[derive(Clone, Copy)]
struct Entry {
    near: f64,
    first_bin: u8,
    last_bin: u8,
    space: u32,
    node: u32,
}

/// Counters of a solve; sums over tiles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TileCounters {
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
}

/// What a tile is a part of.
pub struct TileContext<'a> {
    pub geometry: &'a InstancedGeometry,
    pub frame: &'a RectifiedFrame,
    pub face: Face,
    pub bounds: &'a ErrorBounds,
}

/// Solves tiles; keeps its memory from tile to tile. One a thread.
#[derive(Default)]
pub struct TileSolver {
    rows: Vec<f64>,
    columns: Vec<Column>,
    lists: Vec<Vec<Interval>>,
    scratch: Vec<Interval>,
    cuts: Vec<Cut>,
    /// Farthest depth a pixel and bin; infinite where not wholly covered.
    far: Vec<[f64; BINS]>,
    tile_far: [f64; BINS],
    tile_far_is_stale: bool,
    stack: Vec<Entry>,
    spaces: Vec<Space>,
    /// See-through finds: (primitive, pixel in tile, length in t).
    seen_through: Vec<(u32, u32, f64)>,
    pub counters: TileCounters,
}

impl TileSolver {
    /// Solves the tile of rows `w` and columns `c` (coordinates, ascending) and calls
    /// `found(primitive, pixel, length)` for everything visible on more than the derived bound:
    /// `pixel` = row * columns + column, `length` in units of t.
    pub fn solve(
        &mut self,
        context: &TileContext,
        w: &[f64],
        c: &[Column],
        mut found: impl FnMut(u32, usize, f64),
    ) {
        let pixels = w.len() * c.len();
        self.rows.clear();
        self.rows.extend_from_slice(w);
        self.columns.clear();
        self.columns.extend_from_slice(c);
        self.lists.resize_with(pixels.max(self.lists.len()), Vec::new);
        self.lists.iter_mut().for_each(Vec::clear);
        self.far.clear();
        self.far.resize(pixels, [f64::INFINITY; BINS]);
        self.tile_far = [f64::INFINITY; BINS];
        self.tile_far_is_stale = false;
        self.cuts.clear();
        self.seen_through.clear();

        self.walk(context, &context.geometry.occluders, Pass::Occluders);
        self.walk(context, &context.geometry.see_through, Pass::SeeThrough);

        for pixel in 0..pixels {
            let shortest = context.bounds.shortest_interval(self.columns[pixel % c.len()].c);
            let list = &self.lists[pixel];
            self.counters.intervals += list.len() as u64;
            for piece in list {
                let length = piece.t1 - piece.t0;
                if length > shortest {
                    found(self.cuts[piece.cut as usize].primitive, pixel, length);
                }
            }
        }
        for &(primitive, pixel, length) in &self.seen_through {
            found(primitive, pixel as usize, length);
        }
    }

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
        let normal = [y - w_lo * z, w_hi * z - y, x - c_lo * z, x - c_hi * z, z];
        let constant = [
            offset.y - w_lo * offset.z,
            w_hi * offset.z - offset.y,
            offset.x - c_lo * offset.z,
            offset.x - c_hi * offset.z,
            offset.z,
        ];
        // Rounding of a box test and of the vertices in the box: `depth` each, scaled by |c|.
        let slack = |c: f64| 2.0 * context.bounds.depth * (1.0 + c.abs());
        let constant = [
            constant[0] + slack(1.0),
            constant[1] + slack(1.0),
            constant[2] + slack(c_lo),
            constant[3] - slack(c_hi),
            constant[4],
        ];
        let extent = normal.map(DVec3::abs);
        Space { face_from_local, offset, instance, normal, extent, constant }
    }

    /// Tests a node against the beam; `None` when it is outside or hidden.
    #[inline]
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
        let near = z - dz - slack;
        self.entry_if_not_hidden(context, near, first, last, space, node)
    }

    /// An entry for something no nearer than `near` that covers at most `first..last` along the
    /// segment (metres), unless it is hidden there in all pixels.
    #[inline]
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
        let entry = Entry { near, first_bin: bin(first), last_bin: bin(last), space, node };
        (!self.is_hidden(&entry)).then_some(entry)
    }

    #[inline]
    fn is_hidden(&mut self, entry: &Entry) -> bool {
        if self.tile_far_is_stale {
            self.tile_far_is_stale = false;
            let mut far = [f64::NEG_INFINITY; BINS];
            for pixel in &self.far {
                for (far, pixel) in far.iter_mut().zip(pixel) {
                    *far = if *pixel > *far { *pixel } else { *far };
                }
            }
            self.tile_far = far;
        }
        let bins = entry.first_bin as usize..=entry.last_bin as usize;
        self.tile_far[bins].iter().all(|&far| entry.near > far)
    }

    /// Walks both levels of a hierarchy front to back.
    fn walk(&mut self, context: &TileContext, top: &TopLevel, pass: Pass) {
        let Some(root) = top.hierarchy.nodes.first() else { return };
        let geometry = context.geometry;
        let face_from_world = context.face.face_from_world();
        let offset = face_from_world * (geometry.origin - context.frame.v0);
        self.spaces.clear();
        self.stack.clear();
        let space = self.space(context, face_from_world, offset, InstanceId(u32::MAX));
        self.spaces.push(space);
        if let Some(entry) = self.test(context, 0, 0, root) {
            self.stack.push(entry);
        }
        while let Some(entry) = self.stack.pop() {
            if self.is_hidden(&entry) {
                continue;
            }
            let nodes = if entry.space == 0 {
                &top.hierarchy.nodes
            } else {
                let instance = self.spaces[entry.space as usize].instance;
                let mesh = geometry.instances[instance.index()].mesh;
                &geometry.meshes[mesh.index()].hierarchy.nodes
            };
            let node = nodes[entry.node as usize];
            let items = node.first as usize..(node.first + node.count) as usize;
            if !node.is_leaf() {
                let left = self.test(context, entry.space, node.first, &nodes[items.start]);
                let right =
                    self.test(context, entry.space, node.first + 1, &nodes[items.start + 1]);
                match (left, right) {
                    (Some(l), Some(r)) if l.near <= r.near => self.stack.extend([r, l]),
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
        self.stack[bottom..].sort_by(|a, b| b.near.total_cmp(&a.near));
    }

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
        let (c_lo, c_hi) = (self.columns[0].c, self.columns[self.columns.len() - 1].c);
        for item in items {
            self.counters.triangles += 1;
            let corners = mesh.corners(item).map(|p| matrix * p + offset);
            let near = corners.iter().fold(f64::INFINITY, |m, p| m.min(p.z));
            let last = corners.iter().fold(f64::NEG_INFINITY, |m, p| m.max(p.x - c_lo * p.z));
            let first = corners.iter().fold(f64::INFINITY, |m, p| m.min(p.x - c_hi * p.z));
            let slack = |c: f64| 2.0 * context.bounds.depth * (1.0 + c.abs());
            let (first, last) = (first - slack(c_hi), last + slack(c_lo));
            if last < 0.0 || first > context.frame.length || first > last {
                continue;
            }
            let near = near - 2.0 * context.bounds.depth;
            if self.entry_if_not_hidden(context, near, first, last, 0, 0).is_none() {
                continue;
            }
            let primitive = instance.first_primitive.0 + item as u32;
            for row in rows_met(&self.rows, &corners) {
                let on_axis = context.bounds.depth;
                if let Some(cut) = Cut::of_triangle(&corners, self.rows[row], on_axis, primitive) {
                    self.counters.cuts += 1;
                    self.row_cut(context, row, cut, pass);
                }
            }
        }
    }

    fn row_cut(&mut self, context: &TileContext, row: usize, cut: Cut, pass: Pass) {
        let number = self.cuts.len() as u32;
        let mut kept = false;
        let nearest = cut.za.min(cut.zb) - 2.0 * context.bounds.depth;
        let width = self.columns.len();
        for (k, column) in self.columns.iter().enumerate() {
            let (ta, tb) = cut.times(column.c, column.inverse_length);
            let (a, b) = (ta.min(tb).max(0.0), ta.max(tb).min(1.0));
            if a >= b {
                continue;
            }
            self.counters.pixel_tests += 1;
            let pixel = row * width + k;
            let bin = |t: f64| ((t * BINS as f64) as usize).min(BINS - 1);
            let bins = bin(a)..=bin(b);
            if self.far[pixel][bins.clone()].iter().all(|&far| nearest > far) {
                continue;
            }
            let list = &mut self.lists[pixel];
            match pass {
                Pass::Occluders => {
                    if !kept {
                        self.cuts.push(cut);
                        kept = true;
                    }
                    if envelope::insert(list, &mut self.scratch, &self.cuts, column, number, a, b) {
                        refresh(&mut self.far[pixel], list, &self.cuts, column, bins);
                        self.tile_far_is_stale = true;
                    }
                }
                Pass::SeeThrough => {
                    let seen = envelope::unhidden_length(list, &self.cuts, column, &cut, a, b);
                    if seen > context.bounds.shortest_interval(column.c) {
                        self.seen_through.push((cut.primitive, pixel as u32, seen));
                    }
                }
            }
        }
    }
}

/// The rows (ascending) whose plane may cut a triangle: those between the least and the largest
/// y / z of its corners. The margin is some 1,000 times the rounding of either side, where |y| is
/// of the size of z; where it is larger, the signs are beyond doubt.
#[inline]
fn rows_met(rows: &[f64], corners: &[DVec3; 3]) -> std::ops::Range<usize> {
    if corners.iter().any(|p| p.z <= 0.0) {
        return 0..rows.len();
    }
    let w = corners.map(|p| p.y / p.z);
    let first = w[0].min(w[1]).min(w[2]) - 1e-12;
    let last = w[0].max(w[1]).max(w[2]) + 1e-12;
    let before = rows.iter().take_while(|&&w| w < first).count();
    let behind = rows.iter().rev().take_while(|&&w| w > last).count();
    before..(rows.len() - behind).max(before)
}

/// Recomputes a pixel's bins: the farthest depth where the list covers a bin without a gap.
fn refresh(
    far: &mut [f64; BINS],
    list: &[Interval],
    cuts: &[Cut],
    column: &Column,
    bins: std::ops::RangeInclusive<usize>,
) {
    let first = list.partition_point(|p| p.t1 * BINS as f64 <= *bins.start() as f64);
    let mut pieces = list[first..].iter().peekable();
    for bin in bins {
        let (start, end) = (bin as f64 / BINS as f64, (bin + 1) as f64 / BINS as f64);
        let mut covered = start;
        let mut farthest = f64::NEG_INFINITY;
        while let Some(piece) = pieces.peek() {
            if piece.t1 > start {
                if piece.t0 > covered {
                    break;
                }
                let line = Line::new(&cuts[piece.cut as usize], column);
                let (s, e) = (piece.t0.max(start), piece.t1.min(end));
                farthest = farthest.max(line.depth(s)).max(line.depth(e));
                covered = piece.t1;
                if covered >= end {
                    break;
                }
            }
            pieces.next();
        }
        far[bin] = if covered >= end {
            farthest + column.depth_error + 4.0 * UNIT_ROUNDOFF * farthest
        } else {
            f64::INFINITY
        };
    }
}
