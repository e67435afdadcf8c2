//! The visibility lists of a tile's pixels: lower envelopes of cuts in (t, z).
//!
//! At column c a cut covers t between its ends' times, and its depth is linear in t between them:
//! a [`Line`]. A pixel's list holds, in order of t, the pieces on which a line is nearest. A piece
//! keeps a reference to its line: depths are evaluated from the cut's own ends, never from ends
//! that were split before, so nothing drifts.
//!
//! Lists are kept by *bins*, equal stretches of t. A cut is inserted into each bin that it meets,
//! so an insertion touches two or three pieces, however many a pixel has. A bin also has its
//! *far* depth: the farthest of its pieces where they cover it without a gap, infinite elsewhere.
//! What is behind the far depths of all the bins that it can meet is hidden.
//!
//! Two cuts are compared at both ends of the stretch they share in a bin. Depths that differ by
//! less than the derived bound are equal; equal at one end is decided at the other; equal at both
//! goes to the lower primitive number. A crossing is computed from the pair alone (over the whole
//! stretch on which both exist), so it does not depend on what was inserted between.
//!
//! What moves or is round has an [`Arc`]; its line is the arc's chord, with how far the arc may be on
//! either side of it. Where the chords do not decide, the arcs do: [`crate::arc::order`].
//!
//! Invariants ([`Envelopes::assert_well_formed`]):
//! - pieces are sorted, disjoint, not empty, inside their bin (VI-1);
//! - no piece is farther than its bin's far depth.

use sightline_geometry::UNIT_ROUNDOFF;

use crate::{
    arc::{Arc, Curve, Order, order},
    bounds::ErrorBounds,
    cut::Cut,
};

/// Bins over t of a pixel. Eight let a 10 m segment see past a street corner bin by bin, and keep
/// the lists of a city two or three pieces long.
pub const BINS: usize = 8;

/// Pieces that a bin holds before it moves to a larger place.
const FIRST_CAPACITY: u32 = 4;

/// The lesser of two numbers, neither of them NaN: one instruction, unlike [`f64::min`].
#[inline(always)]
pub(crate) fn least(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

/// The larger of two numbers, neither of them NaN.
#[inline(always)]
pub(crate) fn largest(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

/// What a column fixes for the evaluation of cuts.
#[derive(Clone, Copy, Debug)]
pub struct Column {
    /// Column coordinate c.
    pub c: f64,
    /// 1 / L, 1/metres.
    pub inverse_length: f64,
    /// Largest error of a time at this column.
    pub time_error: f64,
    /// Largest error of a depth at exact t, metres.
    pub depth_error: f64,
}

impl Column {
    /// The column with coordinate `c` of a segment of length `length`, metres.
    #[must_use]
    pub fn new(c: f64, length: f64, bounds: &ErrorBounds) -> Self {
        Self {
            c,
            inverse_length: 1.0 / length,
            time_error: bounds.time(c),
            depth_error: bounds.depth,
        }
    }
}

/// A cut at one column: depth as a function of t.
#[derive(Clone, Copy, Debug)]
pub struct Line {
    /// Earlier end of the cut at this column (not clipped to [0, 1]).
    pub start: f64,
    /// Later end.
    pub end: f64,
    t: f64,
    z: f64,
    slope: f64,
    /// Least depth, metres.
    pub near: f64,
    far: f64,
    /// No depth is less than that of the line by more, metres.
    pub below: f64,
    /// No depth is larger than that of the line by more, metres.
    pub above: f64,
    /// Global number of the primitive.
    pub primitive: u32,
    /// Number of its arc, [`STRAIGHT`] for a line.
    arc: u32,
}

/// The arc of a line that is straight.
const STRAIGHT: u32 = u32::MAX;

/// The arc of a chord whose arc is in no list.
const UNLISTED: u32 = u32::MAX - 1;

impl Line {
    /// The cut seen at a column, where its ends (a, b) are seen at `times`, which differ.
    #[inline(always)]
    #[must_use]
    pub fn new(cut: &Cut, column: &Column, (ta, tb): (f64, f64)) -> Self {
        let slope = (cut.zb - cut.za) / (tb - ta);
        let (near, far) = (least(cut.za, cut.zb), largest(cut.za, cut.zb));
        // A time off by `time_error` moves the depth along the slope, but not beyond the ends.
        let error = column.depth_error + least(slope.abs() * column.time_error, far - near);
        Self {
            start: least(ta, tb),
            end: largest(ta, tb),
            t: ta,
            z: cut.za,
            slope,
            near,
            far,
            below: error,
            above: error,
            primitive: cut.primitive,
            arc: STRAIGHT,
        }
    }

    /// The chord of an arc that covers `start..end`, which is not empty.
    #[must_use]
    pub fn of_arc(arc: &Arc, start: f64, end: f64, primitive: u32) -> Self {
        let band = arc.band(start, end);
        Self {
            start,
            end,
            t: start,
            z: band.z0,
            slope: (band.z1 - band.z0) / (end - start),
            near: least(band.z0, band.z1),
            far: largest(band.z0, band.z1),
            below: band.below + band.error,
            above: band.above + band.error,
            primitive,
            arc: UNLISTED,
        }
    }

    /// Depth at `t`, metres.
    #[inline(always)]
    #[must_use]
    pub fn depth(&self, t: f64) -> f64 {
        let z = self.z + (t - self.t) * self.slope;
        least(largest(z, self.near), self.far)
    }

    /// No depth on `s..e` is larger than this, errors included.
    #[inline(always)]
    fn farthest(&self, s: f64, e: f64) -> f64 {
        let far = largest(self.depth(s), self.depth(e));
        far + self.above + 4.0 * UNIT_ROUNDOFF * far
    }
}

/// Sign of the depth difference `a - b` at `t`: -1 when a is nearer, 0 within the bound.
#[inline(always)]
fn compare(a: &Line, b: &Line, t: f64) -> i32 {
    let difference = a.depth(t) - b.depth(t);
    i32::from(difference > a.below + b.above) - i32::from(difference < -(a.above + b.below))
}

/// Who is nearer on a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Nearer {
    New,
    Old,
    NewThenOld(f64),
    OldThenNew(f64),
    /// The chords do not tell: see [`order`].
    Unknown,
}

/// Decides between two lines on `s..e`. `tie` is true when the new one wins a tie.
#[inline(always)]
fn decide(new: &Line, old: &Line, s: f64, e: f64, tie: bool) -> Nearer {
    let (at_s, at_e) = (compare(new, old, s), compare(new, old, e));
    if (new.arc & old.arc) != STRAIGHT {
        return match (at_s, at_e) {
            (-1, -1) => Nearer::New,
            (1, 1) => Nearer::Old,
            _ => Nearer::Unknown,
        };
    }
    if at_s == 0 && at_e == 0 {
        return if tie { Nearer::New } else { Nearer::Old };
    }
    if at_s >= 0 && at_e >= 0 {
        return Nearer::Old;
    }
    if at_s <= 0 && at_e <= 0 {
        return Nearer::New;
    }
    let (a, b) = if new.primitive < old.primitive { (new, old) } else { (old, new) };
    let (from, to) = (largest(a.start, b.start), least(a.end, b.end));
    let (d0, d1) = (a.depth(from) - b.depth(from), a.depth(to) - b.depth(to));
    let t = least(largest(from + (to - from) * (d0 / (d0 - d1)), s), e);
    if at_s < 0 { Nearer::NewThenOld(t) } else { Nearer::OldThenNew(t) }
}

/// A half-open stretch `t0 <= t < t1` of a bin on which a line is nearest.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Piece {
    t0: f64,
    t1: f64,
    /// No depth of the piece is larger.
    far: f64,
    line: u32,
}

/// A visibility interval: a stretch of t on which a primitive is nearest at a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// The primitive.
    pub primitive: u32,
    /// Start, in [0, 1).
    pub start: f64,
    /// End, in (0, 1].
    pub end: f64,
    /// Largest error of the start: that of the primitive's own end, or of what it meets there.
    pub start_error: f64,
    /// Largest error of the end.
    pub end_error: f64,
}

impl Interval {
    /// True when it is longer than what its ends may be off by: rounding alone makes nothing visible.
    #[inline(always)]
    #[must_use]
    pub fn counts(&self) -> bool {
        self.end - self.start > self.start_error + self.end_error
    }
}

/// Where the pieces of a bin are.
#[derive(Clone, Copy, Debug, Default)]
struct Bin {
    first: u32,
    len: u32,
    capacity: u32,
}

/// The lists of a tile's pixels.
#[derive(Clone, Debug, Default)]
pub struct Envelopes {
    lines: Vec<Line>,
    arcs: Vec<Arc>,
    pieces: Vec<Piece>,
    /// `pixel * BINS + bin`.
    bins: Vec<Bin>,
    /// Far depths a pixel.
    far: Vec<[f64; BINS]>,
    scratch: Vec<Piece>,
}

/// The bin that holds `t`, which is in [0, 1].
#[inline(always)]
#[must_use]
pub fn bin_of(t: f64) -> usize {
    ((t * BINS as f64) as usize).min(BINS - 1)
}

/// The stretch of t of a bin; exact, as `BINS` is a power of two.
#[inline(always)]
fn stretch(bin: usize) -> (f64, f64) {
    (bin as f64 / BINS as f64, (bin + 1) as f64 / BINS as f64)
}

/// Appends a piece; joins it to the last one if that is the same line.
#[inline(always)]
fn push(out: &mut Vec<Piece>, lines: &[Line], t0: f64, t1: f64, line: u32) {
    if t0 >= t1 {
        return;
    }
    let far = lines[line as usize].farthest(t0, t1);
    match out.last_mut() {
        Some(last) if last.line == line && last.t1 == t0 => {
            last.t1 = t1;
            last.far = largest(last.far, far);
        }
        _ => out.push(Piece { t0, t1, far, line }),
    }
}

/// The curve of a line.
fn curve<'a>(line: &'a Line, arcs: &'a [Arc]) -> Curve<'a> {
    Curve { line, arc: arcs.get(line.arc as usize) }
}

/// Who of a new line and an old one is nearer, for pairs with an arc: for each stretch of `s..e`
/// `each(from, to, whether the new one is)`. `tie` is true when the new one wins a tie.
fn by_order(
    new: Curve,
    old: Curve,
    (s, e): (f64, f64),
    tie: bool,
    mut each: impl FnMut(f64, f64, bool),
) {
    // From the lower to the higher number, so that the result does not depend on who was first.
    let new_first = new.line.primitive < old.line.primitive;
    let (a, b) = if new_first { (new, old) } else { (old, new) };
    let Order { first, count, changes } = order(a, b, tie == new_first);
    let (mut is_new, mut from) = (first == new_first, s);
    for &change in &changes[..count] {
        if change > from && change < e {
            each(from, change, is_new);
            from = change;
        }
        if change < e {
            is_new = !is_new;
        }
    }
    each(from, e, is_new);
}

/// Puts what is left of `piece` and what a new line takes of its stretch `s..e` behind the scratch
/// pieces, where the arcs decide; whether it takes anything.
#[cold]
#[inline(never)]
fn by_arcs(
    lines: &[Line],
    arcs: &[Arc],
    scratch: &mut Vec<Piece>,
    new: u32,
    piece: Piece,
    (s, e): (f64, f64),
) -> bool {
    let of = |line: u32| curve(&lines[line as usize], arcs);
    let tie = lines[new as usize].primitive < lines[piece.line as usize].primitive;
    let mut won = false;
    by_order(of(new), of(piece.line), (s, e), tie, |_, _, is_new| won |= is_new);
    if !won {
        scratch.push(piece);
        return false;
    }
    push(scratch, lines, piece.t0, s, piece.line);
    by_order(of(new), of(piece.line), (s, e), tie, |from, to, is_new| {
        push(scratch, lines, from, to, if is_new { new } else { piece.line });
    });
    push(scratch, lines, e, piece.t1, piece.line);
    true
}

impl Envelopes {
    /// Empties the lists and makes room for `pixels`.
    pub fn clear(&mut self, pixels: usize) {
        let bins = pixels * BINS;
        self.lines.clear();
        self.arcs.clear();
        self.bins.clear();
        self.bins.extend((0..bins as u32).map(|i| Bin {
            first: i * FIRST_CAPACITY,
            len: 0,
            capacity: FIRST_CAPACITY,
        }));
        self.pieces.truncate(bins * FIRST_CAPACITY as usize);
        self.pieces.resize(bins * FIRST_CAPACITY as usize, Piece::default());
        self.far.clear();
        self.far.resize(pixels, [f64::INFINITY; BINS]);
    }

    /// Takes over the lists of `other`; keeps its memory.
    pub fn copy_from(&mut self, other: &Self) {
        self.lines.clone_from(&other.lines);
        self.arcs.clone_from(&other.arcs);
        self.pieces.clone_from(&other.pieces);
        self.bins.clone_from(&other.bins);
        self.far.clone_from(&other.far);
    }

    /// The far depths of a pixel, a bin each.
    #[inline(always)]
    #[must_use]
    pub fn far(&self, pixel: usize) -> &[f64; BINS] {
        &self.far[pixel]
    }

    /// Inserts the part of an arc that covers `line.start..line.end` (inside [0, 1], not empty), with
    /// its chord `line`. Returns whether it is nearest anywhere.
    pub fn insert_arc(&mut self, pixel: usize, line: Line, arc: Arc) -> bool {
        let number = self.arcs.len() as u32;
        self.arcs.push(arc);
        let (a, b) = (line.start, line.end);
        let won = self.insert(pixel, Line { arc: number, ..line }, a, b);
        if !won {
            self.arcs.pop();
        }
        won
    }

    /// Inserts a line that covers `a..b` (inside [0, 1], not empty) into a pixel's list. Returns
    /// whether it is nearest anywhere.
    #[inline(always)]
    pub fn insert(&mut self, pixel: usize, line: Line, a: f64, b: f64) -> bool {
        let number = self.lines.len() as u32;
        self.lines.push(line);
        let mut won = false;
        let near = line.near - line.below;
        for bin in bin_of(a)..=bin_of(b) {
            let (start, end) = stretch(bin);
            let (s, e) = (largest(a, start), least(b, end));
            if s < e && near <= self.far[pixel][bin] {
                won |= self.insert_into_bin(pixel, bin, number, s, e);
            }
        }
        if !won {
            self.lines.pop();
        }
        won
    }

    #[inline(always)]
    fn insert_into_bin(&mut self, pixel: usize, bin: usize, new: u32, a: f64, b: f64) -> bool {
        let slot = pixel * BINS + bin;
        let Bin { first, len, .. } = self.bins[slot];
        let (first, len) = (first as usize, len as usize);
        let lines = &self.lines[..];
        let new_line = &lines[new as usize];
        let old = &self.pieces[first..first + len];

        let mut before = 0;
        while before < len && old[before].t1 <= a {
            before += 1;
        }
        let scratch = &mut self.scratch;
        scratch.clear();
        let mut won = false;
        let mut cursor = a;
        let mut behind = before;
        while behind < len && old[behind].t0 < b {
            let piece = old[behind];
            if cursor < piece.t0 {
                push(scratch, lines, cursor, piece.t0, new);
                won = true;
            }
            let (s, e) = (largest(piece.t0, a), least(piece.t1, b));
            let old_line = &lines[piece.line as usize];
            let tie = new_line.primitive < old_line.primitive;
            let nearer = decide(new_line, old_line, s, e, tie);
            if nearer == Nearer::Unknown {
                won |= by_arcs(lines, &self.arcs, scratch, new, piece, (s, e));
            } else if nearer == Nearer::Old {
                scratch.push(piece);
            } else {
                won = true;
                push(scratch, lines, piece.t0, s, piece.line);
                match nearer {
                    Nearer::NewThenOld(t) => {
                        push(scratch, lines, s, t, new);
                        push(scratch, lines, t, e, piece.line);
                    }
                    Nearer::OldThenNew(t) => {
                        push(scratch, lines, s, t, piece.line);
                        push(scratch, lines, t, e, new);
                    }
                    _ => push(scratch, lines, s, e, new),
                }
                push(scratch, lines, e, piece.t1, piece.line);
            }
            cursor = e;
            behind += 1;
        }
        if cursor < b {
            push(scratch, lines, cursor, b, new);
            won = true;
        }
        if won {
            self.replace(slot, before, behind);
            let (start, end) = stretch(bin);
            self.far[pixel][bin] = self.farthest(slot, start, end);
        }
        won
    }

    /// Puts the scratch pieces in the place of `before..behind` of a bin.
    #[inline(always)]
    fn replace(&mut self, slot: usize, before: usize, behind: usize) {
        let bin = &mut self.bins[slot];
        let first = bin.first as usize;
        let (len, added) = (bin.len as usize, self.scratch.len());
        let new_len = len - (behind - before) + added;
        if new_len <= bin.capacity as usize {
            self.pieces.copy_within(first + behind..first + len, first + before + added);
            self.pieces[first + before..first + before + added].copy_from_slice(&self.scratch);
        } else {
            let moved = self.pieces.len();
            self.pieces.extend_from_within(first..first + before);
            self.pieces.extend_from_slice(&self.scratch);
            self.pieces.extend_from_within(first + behind..first + len);
            bin.capacity = 2 * new_len as u32;
            bin.first = moved as u32;
            self.pieces.resize(moved + bin.capacity as usize, Piece::default());
        }
        self.bins[slot].len = new_len as u32;
    }

    /// The far depth of a bin.
    #[inline(always)]
    fn farthest(&self, slot: usize, start: f64, end: f64) -> f64 {
        let mut covered = start;
        let mut far = f64::NEG_INFINITY;
        for piece in self.of(slot) {
            if piece.t0 > covered {
                return f64::INFINITY;
            }
            far = largest(far, piece.far);
            covered = piece.t1;
        }
        if covered >= end { far } else { f64::INFINITY }
    }

    #[inline(always)]
    fn of(&self, slot: usize) -> &[Piece] {
        let bin = self.bins[slot];
        &self.pieces[bin.first as usize..(bin.first + bin.len) as usize]
    }

    /// Calls `found` with every interval of a pixel, in order of t; pieces of a line that meet at the
    /// border of two bins are one interval. `time_error` is that of the ends of lines at this column.
    #[inline(always)]
    pub fn intervals(&self, pixel: usize, time_error: f64, mut found: impl FnMut(Interval)) {
        let error_of = |line: u32| match self.arcs.get(self.lines[line as usize].arc as usize) {
            Some(arc) => largest(arc.time_error, time_error),
            None => time_error,
        };
        let mut open = Piece::default();
        // The error of what is before the open piece, where both meet.
        let mut before = time_error;
        let mut close = |open: &Piece, before: f64, behind: f64| {
            let own = error_of(open.line);
            found(Interval {
                primitive: self.lines[open.line as usize].primitive,
                start: open.t0,
                end: open.t1,
                start_error: largest(own, before),
                end_error: largest(own, behind),
            });
            own
        };
        for bin in 0..BINS {
            for piece in self.of(pixel * BINS + bin) {
                if piece.line == open.line && piece.t0 == open.t1 {
                    open.t1 = piece.t1;
                } else {
                    let meets = piece.t0 == open.t1;
                    let mut passed = time_error;
                    if open.t0 < open.t1 {
                        let behind = if meets { error_of(piece.line) } else { time_error };
                        passed = close(&open, before, behind);
                    }
                    before = if meets { passed } else { time_error };
                    open = *piece;
                }
            }
        }
        if open.t0 < open.t1 {
            close(&open, before, time_error);
        }
    }

    /// Length of the part of `a..b` on which a line is not behind a pixel's list: what is seen of
    /// a see-through cut, with its arc if it has one. The list does not change.
    #[must_use]
    pub fn unhidden_length(
        &self,
        pixel: usize,
        line: &Line,
        arc: Option<&Arc>,
        (a, b): (f64, f64),
    ) -> f64 {
        let mut hidden = 0.0;
        for bin in bin_of(a)..=bin_of(b) {
            for piece in self.of(pixel * BINS + bin) {
                let (s, e) = (largest(piece.t0, a), least(piece.t1, b));
                if s < e {
                    let old = &self.lines[piece.line as usize];
                    hidden += match decide(line, old, s, e, true) {
                        Nearer::Unknown => {
                            let mut hidden = 0.0;
                            let curves = (Curve { line, arc }, curve(old, &self.arcs));
                            by_order(curves.0, curves.1, (s, e), true, |from, to, is_new| {
                                hidden += if is_new { 0.0 } else { to - from };
                            });
                            hidden
                        }
                        Nearer::New => 0.0,
                        Nearer::Old => e - s,
                        Nearer::NewThenOld(t) => e - t,
                        Nearer::OldThenNew(t) => t - s,
                    };
                }
            }
        }
        (b - a) - hidden
    }

    /// Panics when a list breaks an invariant of the module.
    pub fn assert_well_formed(&self) {
        for (slot, bin) in self.bins.iter().enumerate() {
            let (start, end) = stretch(slot % BINS);
            let list = self.of(slot);
            assert!(bin.len <= bin.capacity);
            for p in list {
                assert!(start <= p.t0 && p.t0 < p.t1 && p.t1 <= end, "{p:?} lies in its bin");
                assert!(p.far <= self.far[slot / BINS][slot % BINS], "{p:?} is not beyond far");
            }
            assert!(list.windows(2).all(|w| w[0].t1 <= w[1].t0), "sorted, disjoint: {list:?}");
        }
    }
}
