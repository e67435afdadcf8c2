//! A tile over several states: what rests is solved once, what moves state by state on top of it.
//!
//! The lists of what rests are kept. For each state they are taken as they are, what moves is
//! inserted front to back, and if anything of it is seen, the state's lists are reported; otherwise the
//! state sees what rests, and nothing more is done for it.
//!
//! *Boxes that move.* A node's box at the two key frames of a state gives each linear function of a
//! point a least and a largest value at either, and between them these move linearly too. So the tests
//! of a node at rest carry over: outside for good when outside at both ends; covered for the t at
//! which two linear functions have the right sign; no nearer than at the nearer end.
//!
//! *Temporal bounding volumes.* A node that is not seen in a state is tried with the union of its boxes
//! over a window of states from there on, against what rests: when that is outside of the beam or
//! hidden, the node is skipped for the whole window without another look. The window adapts as in the
//! source: a volume that expired unseen gets one twice as long, one that was seen, or could not be
//! proven hidden, one half as long. What is proven for a node holds for all that is below it: groups of
//! objects, objects, and clusters of large ones.
//!
//! Source: Sudarsky and Gotsman, "Output-Sensitive Rendering and Communication in Dynamic Virtual
//! Environments" (VRST 1997), sections 2.2 and 3.
//!
//! Invariant: volumes change what is looked at, never what is found.

use std::collections::HashMap;
use std::ops::Range;

use glam::{DAffine3, DMat3, DVec3};
use sightline_geometry::{
    Bounds32, InstanceId, Mesh, MovingHierarchy, MovingLevel, ParticleSystem, motion::lerp,
};

use super::{
    Entry, FaceTriangles, Far, LANES, Motion, Pass, TILE_COLUMNS, TileContext, TileSolver, When,
    rows_met,
};
use crate::{
    arc::Arc,
    envelope::{Envelopes, Line, bin_of, largest, least},
    moving::{Covered, MovingRow, MovingSphere, MovingTriangle},
};

/// Groups of particles and triangles have volumes of their own from so many members on; objects have
/// theirs.
const CLUSTER: u32 = 32;

/// After so many states at most, a node that no volume could be made for is tried again.
const LONGEST_GAP: u32 = 8;

/// What a hierarchy of moving things is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Of {
    /// Instances; the level is that of the pass.
    Level,
    /// The triangles of an instance.
    Instance(InstanceId),
    /// A particle system, by number.
    Particles(u32),
}

/// What is known of a node's future.
#[derive(Clone, Copy, Debug)]
struct Volume {
    /// First state in which it is not known to be hidden.
    expires: u32,
    /// States that the next volume is made for.
    window: u32,
    /// First state in which the next volume is tried, and the states to wait if that fails.
    retry: u32,
    gap: u32,
}

/// Face coordinates of a space that moves: at the two key frames around the state.
struct MovingSpace {
    of: Of,
    map: [(DMat3, DVec3); 2],
    normal: [[DVec3; 7]; 2],
    extent: [[DVec3; 7]; 2],
    constant: [[f64; 7]; 2],
}

/// What is kept from state to state, and memory from tile to tile.
#[derive(Default)]
pub(super) struct MovingSolver {
    spaces: Vec<MovingSpace>,
    volumes: HashMap<(u32, u32), Volume>,
    /// The lists, far depths and finds of what rests.
    base: Envelopes,
    base_rows: Vec<Far>,
    base_tile: Far,
    base_seen_through: Vec<(u32, u32, f64)>,
    /// True when something came into the lists since this was last set to false.
    pub(super) changed: bool,
}

/// A walk of what moves, in one state.
#[derive(Clone, Copy)]
struct Walk<'a> {
    context: &'a TileContext<'a>,
    motion: &'a Motion<'a>,
    state: u32,
    /// First state behind those that are solved.
    end: u32,
    pass: Pass,
}

impl<'a> Walk<'a> {
    fn level(&self) -> &'a MovingLevel {
        match self.pass {
            Pass::Occluders => &self.context.geometry.moving_occluders,
            Pass::SeeThrough => &self.context.geometry.moving_see_through,
        }
    }
}

/// The least and the largest value of a function of a [`super::Space`] over a box, at the start and at
/// the end of the camera's path.
type Ends = [(f64, f64); 2];

impl TileSolver {
    /// Solves the states of `motion` on top of the lists of what rests.
    pub(super) fn solve_motion(
        &mut self,
        context: &TileContext,
        motion: &Motion,
        pixels: usize,
        found: &mut impl FnMut(When, u32, usize, f64),
    ) {
        let geometry = context.geometry;
        if geometry.moving_occluders.instances.is_empty()
            && geometry.moving_see_through.instances.is_empty()
            && geometry.particles.is_empty()
        {
            return;
        }
        let end = motion.states.last().map_or(0, |last| last + 1);
        self.refresh_far();
        if motion.volumes && self.sees_no_motion(context, motion, end) {
            return;
        }
        self.keep_base();
        for (number, &state) in motion.states.iter().enumerate() {
            if number > 0 {
                self.envelopes.copy_from(&self.moving.base);
                self.row_far.clone_from(&self.moving.base_rows);
                self.tile_far = self.moving.base_tile;
            }
            self.moving.changed = false;
            self.seen_through.clear();
            geometry.look();
            let walk = Walk { context, motion, state, end, pass: Pass::Occluders };
            self.walk_moving(&walk);
            if self.moving.changed && !geometry.see_through.instances.is_empty() {
                self.walk(context, &geometry.see_through, Pass::SeeThrough);
            } else {
                self.seen_through.extend_from_slice(&self.moving.base_seen_through);
            }
            let before = self.seen_through.len();
            self.walk_moving(&Walk { pass: Pass::SeeThrough, ..walk });
            if self.moving.changed || self.seen_through.len() > before {
                self.report(pixels, When::In(state), found);
            }
        }
    }

    fn refresh_far(&mut self) {
        for row in 0..self.row_far.len() {
            self.refresh_row(row);
        }
        self.tile_far = Far::of(self.row_far.iter().map(|far| &far.depths));
    }

    /// Whether one volume a hierarchy, over all states, shows that nothing that moves is seen. Most tiles
    /// of a scene in which little moves need no more.
    fn sees_no_motion(&mut self, context: &TileContext, motion: &Motion, end: u32) -> bool {
        let Some(&state) = motion.states.first() else { return true };
        let geometry = context.geometry;
        self.moving.spaces.clear();
        let (mut volumes, mut items) = (0, 0);
        let mut hidden = |this: &mut Self, walk: &Walk, of, origin, hierarchy: &MovingHierarchy| {
            volumes += 1;
            items += u64::from(hierarchy.nodes[0].items);
            let swept = hierarchy.swept(0, state..end);
            let space = this.add_space(context, of, resting(context, origin));
            swept.is_empty()
                || this
                    .entry_in_beam(walk, space, 0, (&swept, &swept))
                    .is_none_or(|entry| this.is_hidden_in_rows(&entry))
        };
        for pass in [Pass::Occluders, Pass::SeeThrough] {
            let walk = Walk { context, motion, state, end, pass };
            let level = walk.level();
            if !level.instances.is_empty()
                && !hidden(self, &walk, Of::Level, geometry.origin, &level.hierarchy)
            {
                return false;
            }
        }
        for (number, system) in (0..).zip(&geometry.particles) {
            let walk = Walk { context, motion, state, end, pass: Pass::Occluders };
            if !system.is_empty()
                && !hidden(self, &walk, Of::Particles(number), system.origin, &system.hierarchy)
            {
                return false;
            }
        }
        self.counters.volumes += volumes;
        self.counters.skipped += items * motion.states.len() as u64;
        true
    }

    /// Keeps what rests as it is in the lists now.
    fn keep_base(&mut self) {
        let m = &mut self.moving;
        m.volumes.clear();
        m.base.copy_from(&self.envelopes);
        m.base_rows.clone_from(&self.row_far);
        m.base_tile = self.tile_far;
        m.base_seen_through.clone_from(&self.seen_through);
    }

    /// Walks what moves, front to back.
    fn walk_moving(&mut self, walk: &Walk) {
        let Walk { context, .. } = *walk;
        let geometry = context.geometry;
        self.moving.spaces.clear();
        self.stack.clear();
        let level = walk.level();
        if !level.instances.is_empty() {
            let space = self.add_space(context, Of::Level, resting(context, geometry.origin));
            let root = self.seen_node(walk, space, 0, &level.hierarchy);
            self.stack.extend(root);
        }
        for (number, system) in (0..).zip(&geometry.particles) {
            if system.occluder == (walk.pass == Pass::Occluders) && !system.is_empty() {
                let map = resting(context, system.origin);
                let space = self.add_space(context, Of::Particles(number), map);
                let root = self.seen_node(walk, space, 0, &system.hierarchy);
                self.stack.extend(root);
            }
        }
        self.stack.sort_by(|a, b| b.order(a));
        while let Some(entry) = self.stack.pop() {
            let of = self.moving.spaces[entry.space as usize].of;
            let hierarchy = match of {
                Of::Level => Some(&level.hierarchy),
                Of::Particles(number) => Some(&geometry.particles[number as usize].hierarchy),
                Of::Instance(id) => self.mesh(context, id).motion.as_ref().map(|m| &m.hierarchy),
            };
            if self.is_hidden_in_rows(&entry) {
                if let Some(hierarchy) = hierarchy {
                    self.try_volume(walk, entry.space, entry.node, hierarchy);
                }
                continue;
            }
            let Some(hierarchy) = hierarchy else {
                self.open_rigid(walk, &entry);
                continue;
            };
            let node = hierarchy.nodes[entry.node as usize];
            let items = node.first as usize..(node.first + node.count) as usize;
            if !node.is_leaf() {
                let [l, r] = [node.first, node.first + 1]
                    .map(|child| self.seen_node(walk, entry.space, child, hierarchy));
                self.push_two(l, r);
                continue;
            }
            match of {
                Of::Level => self.enter_moving(walk, &level.instances[items]),
                Of::Particles(number) => {
                    let system = &geometry.particles[number as usize];
                    self.spheres(walk, entry.space, system, items);
                }
                Of::Instance(_) => self.moving_leaf(walk, entry.space, items),
            }
        }
    }

    fn mesh<'a>(&self, context: &TileContext<'a>, id: InstanceId) -> &'a Mesh {
        let mesh = context.geometry.instances[id.index()].mesh;
        &context.geometry.meshes[mesh.index()]
    }

    /// Pushes the roots of instances that move, the nearest on top.
    fn enter_moving(&mut self, walk: &Walk, ids: &[InstanceId]) {
        let context = walk.context;
        let bottom = self.stack.len();
        let face_from_world = context.face.face_from_world();
        for &id in ids {
            let maps = context.geometry.instances[id.index()].around(walk.state);
            let map = |m: &DAffine3| {
                (face_from_world * m.matrix3, face_from_world * (m.translation - context.frame.v0))
            };
            let space = self.add_space(context, Of::Instance(id), [map(maps.0), map(maps.1)]);
            let mesh = self.mesh(context, id);
            let root = match &mesh.motion {
                Some(motion) => self.seen_node(walk, space, 0, &motion.hierarchy),
                None => self.seen_rigid(walk, space, 0, mesh),
            };
            match root {
                Some(entry) => self.stack.push(entry),
                None => {
                    self.moving.spaces.pop();
                }
            }
        }
        self.stack[bottom..].sort_by(|a, b| b.order(a));
    }

    /// Opens a node of a mesh that does not change, in an instance that moves.
    fn open_rigid(&mut self, walk: &Walk, entry: &Entry) {
        let Of::Instance(id) = self.moving.spaces[entry.space as usize].of else { return };
        let mesh = self.mesh(walk.context, id);
        let node = mesh.hierarchy.nodes[entry.node as usize];
        if node.is_leaf() {
            let items = node.first as usize..(node.first + node.count) as usize;
            self.moving_leaf(walk, entry.space, items);
        } else {
            let [l, r] = [node.first, node.first + 1]
                .map(|child| self.seen_rigid(walk, entry.space, child, mesh));
            self.push_two(l, r);
        }
    }

    /// Pushes what is seen of two, the nearer on top.
    fn push_two(&mut self, left: Option<Entry>, right: Option<Entry>) {
        match (left, right) {
            (Some(l), Some(r)) if l.order(&r).is_le() => self.stack.extend([r, l]),
            (Some(l), Some(r)) => self.stack.extend([l, r]),
            (one, other) => self.stack.extend(one.or(other)),
        }
    }

    fn add_space(&mut self, context: &TileContext, of: Of, map: [(DMat3, DVec3); 2]) -> u32 {
        let [a, b] = map.map(|(matrix, offset)| self.space(context, matrix, offset, InstanceId(0)));
        self.moving.spaces.push(MovingSpace {
            of,
            map,
            normal: [a.normal, b.normal],
            extent: [a.extent, b.extent],
            constant: [a.constant, b.constant],
        });
        self.moving.spaces.len() as u32 - 1
    }

    /// The entry of a node with a box at each key frame; `None` when it is outside of the beam, hidden,
    /// or known to be.
    fn seen_node(
        &mut self,
        walk: &Walk,
        space: u32,
        node: u32,
        hierarchy: &MovingHierarchy,
    ) -> Option<Entry> {
        if self.sleeps(walk, space, node, hierarchy) {
            return None;
        }
        let boxes = hierarchy.around(node, walk.state)?;
        let seen = self
            .entry_in_beam(walk, space, node, boxes)
            .filter(|entry| !self.is_hidden_in_rows(entry));
        if seen.is_none() {
            self.try_volume(walk, space, node, hierarchy);
        }
        seen
    }

    /// The entry of a node of a mesh that does not change.
    fn seen_rigid(&mut self, walk: &Walk, space: u32, node: u32, mesh: &Mesh) -> Option<Entry> {
        let own = &mesh.hierarchy.nodes.get(node as usize)?.bounds;
        self.entry_in_beam(walk, space, node, (own, own))
            .filter(|entry| !self.is_hidden_in_rows(entry))
    }

    /// The entry of a node with these boxes at the two key frames; `None` outside of the beam.
    #[inline(always)]
    fn entry_in_beam(
        &mut self,
        walk: &Walk,
        space: u32,
        node: u32,
        boxes: (&Bounds32, &Bounds32),
    ) -> Option<Entry> {
        self.counters.nodes += 1;
        let s = &self.moving.spaces[space as usize];
        let mut at_key = [[(0.0, 0.0); 7]; 2];
        for (key, bounds) in [boxes.0, boxes.1].into_iter().enumerate() {
            let min = DVec3::from_array(bounds.min.map(f64::from));
            let max = DVec3::from_array(bounds.max.map(f64::from));
            let (center, half) = (0.5 * (min + max), 0.5 * (max - min));
            for (k, value) in at_key[key].iter_mut().enumerate() {
                let middle = s.normal[key][k].dot(center) + s.constant[key][k];
                let reach = s.extent[key][k].dot(half);
                *value = (middle - reach, middle + reach);
            }
        }
        let path = walk.motion.path;
        let mut ends = [[(0.0, 0.0); 2]; 7];
        for (k, ends) in ends.iter_mut().enumerate() {
            let (a, b) = (at_key[0][k], at_key[1][k]);
            for (end, t) in ends.iter_mut().zip([path.t0, path.t1]) {
                *end = ((1.0 - t) * a.0 + t * b.0, (1.0 - t) * a.1 + t * b.1);
            }
        }
        let (x, y, z) = (ends[6], ends[5], ends[4]);
        if largest(ends[0][0].1, ends[0][1].1) < 0.0 || largest(ends[1][0].1, ends[1][1].1) < 0.0 {
            return None;
        }
        let last = (ends[2][0].1, ends[2][1].1);
        let first = (ends[3][0].0, ends[3][1].0);
        let entry = self.entry_within(walk.context, (x, y, z), first, last)?;
        Some(Entry { space, node, ..entry })
    }

    /// The entry of what has these x, y and z, and these least x - c_hi z and largest x - c_lo z, slack
    /// included, at the start and the end of the camera's path, without the camera's own motion.
    #[inline(always)]
    fn entry_within(
        &self,
        context: &TileContext,
        (x, y, z): (Ends, Ends, Ends),
        first: (f64, f64),
        last: (f64, f64),
    ) -> Option<Entry> {
        let length = context.frame.length;
        let slack = 2.0 * context.bounds.depth;
        let far = largest(z[0].1, z[1].1);
        if far < -slack {
            return None;
        }
        let (start, end) = times((first.0, first.1 - length), (last.0, last.1 - length))?;
        // As if the camera stood at the start of its path: `Wedge` allows for all of it.
        let x = (least(x[0].0 + length, x[1].0), largest(x[0].1, x[1].1 - length));
        let y = (least(y[0].0, y[1].0), largest(y[0].1, y[1].1));
        let corner = least(z[0].0, z[1].0);
        let near = largest(corner, self.wedge.nearest(x, y)) - slack;
        if near > far + slack {
            return None;
        }
        let mut rows = 0..self.rows.len();
        if near > 0.0 {
            let (lo, hi) = (y.0 - slack, y.1 + slack);
            let (a, b) = (1.0 / near, 1.0 / (far + slack));
            let lo = if lo < 0.0 { lo * a } else { lo * b };
            let hi = if hi < 0.0 { hi * b } else { hi * a };
            rows = rows_met(&self.rows, (lo, hi));
            if rows.is_empty() {
                return None;
            }
        }
        let (first_bin, last_bin) = (bin_of(start) as u8, bin_of(end) as u8);
        let (first_row, end_row) = (rows.start as u8, rows.end as u8);
        Some(Entry { near, corner, first_bin, last_bin, first_row, end_row, space: 0, node: 0 })
    }

    /// True when an entry is hidden in all pixels of the rows that it can be seen in: what is far away
    /// is seen in few rows, and the sky above it hides nothing.
    #[inline(always)]
    fn is_hidden_in_rows(&mut self, entry: &Entry) -> bool {
        if self.is_hidden(entry) {
            return true;
        }
        let rows = entry.first_row as usize..entry.end_row as usize;
        rows.len() < self.rows.len() && self.row_far[rows].iter().all(|far| entry.is_behind(far))
    }

    /// The key of a node's volumes, and how many things they are of; `None` for what has none.
    fn volume_key(
        &self,
        walk: &Walk,
        space: u32,
        node: u32,
        hierarchy: &MovingHierarchy,
    ) -> Option<((u32, u32), u32)> {
        let items = hierarchy.nodes[node as usize].items;
        let geometry = walk.context.geometry;
        let (source, least_items) = match self.moving.spaces[space as usize].of {
            Of::Level => (walk.pass as u32, 1),
            Of::Particles(number) => (2 + number, CLUSTER),
            Of::Instance(id) => {
                // The boxes of a mesh whose instance moves have no place in the world.
                let rests = geometry.instances[id.index()].motion.is_none();
                let source = 2 + geometry.particles.len() as u32 + id.0;
                (source, if rests { CLUSTER } else { u32::MAX })
            }
        };
        (walk.motion.volumes && items >= least_items).then_some(((source, node), items))
    }

    /// True for a node that is known to be hidden in the state.
    #[inline(always)]
    fn sleeps(&mut self, walk: &Walk, space: u32, node: u32, hierarchy: &MovingHierarchy) -> bool {
        if self.moving.volumes.is_empty() {
            return false;
        }
        let Some((key, items)) = self.volume_key(walk, space, node, hierarchy) else {
            return false;
        };
        let hidden = self.moving.volumes.get(&key).is_some_and(|v| walk.state < v.expires);
        self.counters.skipped += if hidden { u64::from(items) } else { 0 };
        hidden
    }

    /// Tries to prove a node that is not seen in the state hidden for some states more.
    fn try_volume(&mut self, walk: &Walk, space: u32, node: u32, hierarchy: &MovingHierarchy) {
        let next = walk.state + 1;
        let left = walk.end.saturating_sub(next);
        if left == 0 {
            return;
        }
        let Some((key, _)) = self.volume_key(walk, space, node, hierarchy) else { return };
        let known = self.moving.volumes.get(&key).copied();
        let mut volume = match known {
            // Nothing is known of it: for as long as there is.
            None => Volume { expires: 0, window: left, retry: 0, gap: 1 },
            Some(v) if walk.state < v.retry => return,
            // Expired unseen.
            Some(v) if v.expires == walk.state => Volume { window: 2 * v.window, ..v },
            // Seen since.
            Some(v) => Volume { window: (v.window / 2).max(1), ..v },
        };
        let window = volume.window.min(left);
        self.counters.volumes += 1;
        let swept = hierarchy.swept(node, next..next + window);
        let hidden = swept.is_empty()
            || self.entry_in_beam(walk, space, node, (&swept, &swept)).is_none_or(|e| {
                let rows = e.first_row as usize..e.end_row as usize;
                let base = &self.moving;
                e.is_behind(&base.base_tile)
                    || base.base_rows[rows].iter().all(|far| e.is_behind(far))
            });
        if hidden {
            volume = Volume { expires: next + window, window, retry: next, gap: 1 };
        } else {
            volume.window = (window / 2).max(1);
            volume.retry = next + volume.gap - 1;
            volume.gap = (2 * volume.gap).min(LONGEST_GAP);
        }
        self.moving.volumes.insert(key, volume);
    }

    /// Triangles of a leaf of an instance that moves, or whose mesh changes.
    fn moving_leaf(&mut self, walk: &Walk, space: u32, items: Range<usize>) {
        let Walk { context, state, .. } = *walk;
        let Of::Instance(id) = self.moving.spaces[space as usize].of else { return };
        let instance = &context.geometry.instances[id.index()];
        let mesh = self.mesh(context, id);
        let maps = self.moving.spaces[space as usize].map;
        let positions = mesh.around(state);
        let rests = maps[0] == maps[1] && !mesh.moves_in(state);
        let path = walk.motion.path;
        for first in items.clone().step_by(LANES) {
            let lanes = LANES.min(items.end - first);
            let primitive = instance.first_primitive.0 + first as u32;
            let (m, o) = &maps[0];
            let start = FaceTriangles::new(mesh, positions.0, first, lanes, m, *o);
            if rests {
                self.still_triangles(context, &start, lanes, primitive, walk.pass);
                continue;
            }
            let (m, o) = &maps[1];
            let end = FaceTriangles::new(mesh, positions.1, first, lanes, m, *o);
            let from = start.between(&end, path.t0);
            if path.t0 == path.t1 {
                self.still_triangles(context, &from, lanes, primitive, walk.pass);
                continue;
            }
            let to = start.between(&end, path.t1);
            self.moving_triangles(walk, (&from, &to), lanes, primitive);
        }
    }

    /// Triangles that move, with their corners at the start and the end of the camera's path.
    fn moving_triangles(
        &mut self,
        walk: &Walk,
        (from, to): (&FaceTriangles, &FaceTriangles),
        lanes: usize,
        first_primitive: u32,
    ) {
        let context = walk.context;
        let (c_lo, c_hi) = (self.columns[0].c, self.columns[TILE_COLUMNS - 1].c);
        let slack = |c: f64| 2.0 * context.bounds.depth * (1.0 + c.abs());
        let (slack_lo, slack_hi) = (slack(c_lo), slack(c_hi));
        self.counters.triangles += lanes as u64;
        let (a, b) = (from.extents(c_lo, c_hi), to.extents(c_lo, c_hi));
        for lane in 0..lanes {
            // A corner's y / z lies between those of its ends, as long as it stays in front.
            let rows = (least(a.w[0][lane], b.w[0][lane]), largest(a.w[1][lane], b.w[1][lane]));
            let rows = rows_met(&self.rows, rows);
            if rows.is_empty() {
                continue;
            }
            let x = [a.x(lane), b.x(lane)];
            let y = [a.y(lane), b.y(lane)];
            let z = [(a.near[lane], f64::INFINITY), (b.near[lane], f64::INFINITY)];
            let first = (a.first[lane] - slack_hi, b.first[lane] - slack_hi);
            let last = (a.last[lane] + slack_lo, b.last[lane] + slack_lo);
            let Some(entry) = self.entry_within(context, (x, y, z), first, last) else { continue };
            if self.is_hidden_in_rows(&entry) {
                continue;
            }
            let length = context.frame.length;
            let (from, to) = (from.triangle(lane), to.triangle(lane));
            let stretches = self.moving_stretches(context, &from, &to);
            // What is small falls between the columns.
            if stretches.iter().all(Range::is_empty) {
                continue;
            }
            let triangle = MovingTriangle::new(from, to, length);
            let primitive = first_primitive + lane as u32;
            for row in rows {
                self.moving_row(walk, &triangle, (&entry, &stretches), row, primitive);
            }
        }
    }

    /// For each column, the bins in which a triangle that moves can be met; empty where it never is.
    #[inline(always)]
    fn moving_stretches(
        &self,
        context: &TileContext,
        from: &[DVec3; 3],
        to: &[DVec3; 3],
    ) -> [Range<usize>; TILE_COLUMNS] {
        let length = context.frame.length;
        std::array::from_fn(|k| {
            let c = self.columns[k].c;
            let slack = 2.0 * context.bounds.depth * (1.0 + c.abs());
            let reach = |corners: &[DVec3; 3]| {
                let [p, q, r] = corners.map(|p| p.x - c * p.z);
                (least(p, least(q, r)) - slack, largest(p, largest(q, r)) + slack)
            };
            let (a, b) = (reach(from), reach(to));
            match times((a.0, b.0 - length), (a.1, b.1 - length)) {
                Some((start, end)) => bin_of(start)..bin_of(end) + 1,
                None => 0..0,
            }
        })
    }

    fn moving_row(
        &mut self,
        walk: &Walk,
        triangle: &MovingTriangle,
        (entry, stretches): (&Entry, &[Range<usize>; TILE_COLUMNS]),
        row: usize,
        primitive: u32,
    ) {
        let hidden = stretches.iter().enumerate().all(|(k, bins)| {
            let far = self.envelopes.far(row * TILE_COLUMNS + k);
            far[bins.clone()].iter().all(|&far| entry.near > far)
        });
        if hidden {
            return;
        }
        let bounds = walk.context.bounds;
        let Some(in_row) = MovingRow::new(triangle, self.rows[row], bounds) else { return };
        self.counters.cuts += 1;
        for (k, bins) in stretches.iter().enumerate() {
            if bins.is_empty() {
                continue;
            }
            let c = self.columns[k].c;
            in_row.coverage(c, bounds, |covered| {
                let arc = || in_row.arc(c, &covered, bounds);
                self.cover(walk, row, k, &covered, entry.near, primitive, arc);
            });
        }
    }

    /// Spheres of a leaf.
    fn spheres(&mut self, walk: &Walk, space: u32, system: &ParticleSystem, items: Range<usize>) {
        let context = walk.context;
        let (bounds, path) = (context.bounds, walk.motion.path);
        let (matrix, offset) = self.moving.spaces[space as usize].map[0];
        let (c_lo, c_hi) = (self.columns[0].c, self.columns[TILE_COLUMNS - 1].c);
        let width = |c: f64| (1.0 + c * c).sqrt();
        let slack = |c: f64| 2.0 * bounds.depth * (1.0 + c.abs());
        for particle in items {
            let Some((from, to)) = system.around(particle, walk.state) else { continue };
            self.counters.triangles += 1;
            let place = |s: &sightline_geometry::Sphere| matrix * s.center() + offset;
            let (p, q) = (place(&from), place(&to));
            let radii = (f64::from(from.radius), f64::from(to.radius));
            let center = [lerp(p, q, path.t0), lerp(p, q, path.t1)];
            let radius = [path.t0, path.t1].map(|t| (1.0 - t) * radii.0 + t * radii.1);
            let around = |k: usize, v: f64| (v - radius[k], v + radius[k]);
            let x = [around(0, center[0].x), around(1, center[1].x)];
            let y = [around(0, center[0].y), around(1, center[1].y)];
            let z = [around(0, center[0].z), around(1, center[1].z)];
            let of = |k: usize, c: f64| center[k].x - c * center[k].z;
            let least_of = |k: usize| of(k, c_hi) - radius[k] * width(c_hi) - slack(c_hi);
            let largest_of = |k: usize| of(k, c_lo) + radius[k] * width(c_lo) + slack(c_lo);
            let first = (least_of(0), least_of(1));
            let last = (largest_of(0), largest_of(1));
            let Some(entry) = self.entry_within(context, (x, y, z), first, last) else { continue };
            if self.is_hidden_in_rows(&entry) {
                continue;
            }
            let sphere = MovingSphere::new(center, radius, context.frame.length);
            let primitive = system.first_primitive.0 + particle as u32;
            for row in entry.first_row as usize..entry.end_row as usize {
                let w = self.rows[row];
                self.refresh_row(row);
                if entry.is_behind(&self.row_far[row]) || !sphere.meets_row(w, bounds) {
                    continue;
                }
                self.counters.cuts += 1;
                for k in 0..TILE_COLUMNS {
                    let c = self.columns[k].c;
                    sphere.coverage(c, w, bounds, |covered, arc| {
                        self.cover(walk, row, k, &covered, entry.near, primitive, || arc);
                    });
                }
            }
        }
    }

    /// What an arc that covers a pixel's ray for an interval of t does to its list.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn cover(
        &mut self,
        walk: &Walk,
        row: usize,
        column: usize,
        covered: &Covered,
        near: f64,
        primitive: u32,
        arc: impl FnOnce() -> Arc,
    ) {
        let Covered { start, end, .. } = *covered;
        if start >= end {
            return;
        }
        self.counters.pixel_tests += 1;
        let pixel = row * TILE_COLUMNS + column;
        let bins = bin_of(start)..=bin_of(end);
        if self.envelopes.far(pixel)[bins].iter().all(|&far| near > far) {
            return;
        }
        let arc = arc();
        let line = Line::of_arc(&arc, start, end, primitive);
        match walk.pass {
            Pass::Occluders => {
                if self.envelopes.insert_arc(pixel, line, arc) {
                    self.row_far[row].stale = true;
                    self.tile_far.stale = true;
                    self.moving.changed = true;
                }
            }
            Pass::SeeThrough => {
                let seen = self.envelopes.unhidden_length(pixel, &line, Some(&arc), (start, end));
                let error = 2.0 * largest(arc.time_error, self.columns[column].time_error);
                if seen > error {
                    self.seen_through.push((primitive, pixel as u32, seen));
                }
            }
        }
    }
}

/// Face coordinates of a space that rests, from those relative to its origin.
fn resting(context: &TileContext, origin: DVec3) -> [(DMat3, DVec3); 2] {
    let face_from_world = context.face.face_from_world();
    let map = (face_from_world, face_from_world * (origin - context.frame.v0));
    [map, map]
}

/// The t in [0, 1] at which something may be met: where the least of x - c_hi z is not above, and the
/// largest of x - c_lo z not below 0. Both are linear in t, with these values at its ends.
#[inline(always)]
fn times(first: (f64, f64), last: (f64, f64)) -> Option<(f64, f64)> {
    /// Rounding of a quotient below 1, and then some.
    const SLACK: f64 = 1e-12;
    let (mut start, mut end) = (0.0, 1.0);
    // (value at 0, at 1) of what must not be negative.
    for (a, b) in [(-first.0, -first.1), last] {
        match (a < 0.0, b < 0.0) {
            (true, true) => return None,
            (true, false) => start = largest(start, a / (a - b)),
            (false, true) => end = least(end, a / (a - b)),
            (false, false) => {}
        }
    }
    (start <= end + SLACK).then(|| (largest(start - SLACK, 0.0), least(end + SLACK, 1.0)))
}
