//! The visibility list of a pixel: the lower envelope of cuts in (t, z).
//!
//! At column c a cut covers t between its ends' times, and its depth is linear in t between them.
//! The list holds, in order of t, the pieces on which a cut is nearest. An interval keeps a
//! reference to its cut: depths are evaluated from the cut's own ends, never from ends that were
//! split before, so nothing drifts.
//!
//! Two cuts are compared at both ends of the stretch they share. Depths that differ by less than
//! the derived bound are equal; equal at one end is decided at the other; equal at both goes to
//! the lower primitive number. A crossing is computed from the pair alone (over the whole
//! stretch on which both exist), so it does not depend on what was inserted between.
//!
//! Invariants ([`assert_well_formed`]): pieces are sorted, disjoint, not empty, inside [0, 1)
//! (VI-1).

use crate::{bounds::ErrorBounds, cut::Cut};

/// A half-open stretch `t0 <= t < t1` on which a cut is nearest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// Start, in [0, 1).
    pub t0: f64,
    /// End, in (0, 1].
    pub t1: f64,
    /// Index of the cut in the tile's list.
    pub cut: u32,
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
    near: f64,
    far: f64,
    error: f64,
}

impl Line {
    /// The cut seen at a column.
    #[inline]
    #[must_use]
    pub fn new(cut: &Cut, column: &Column) -> Self {
        let (ta, tb) = cut.times(column.c, column.inverse_length);
        let slope = (cut.zb - cut.za) / (tb - ta);
        let (near, far) = (cut.za.min(cut.zb), cut.za.max(cut.zb));
        // A time off by `time_error` moves the depth along the slope, but not beyond the ends.
        let error = column.depth_error + (slope.abs() * column.time_error).min(far - near);
        Self { start: ta.min(tb), end: ta.max(tb), t: ta, z: cut.za, slope, near, far, error }
    }

    /// Depth at `t`, metres.
    #[inline]
    #[must_use]
    pub fn depth(&self, t: f64) -> f64 {
        (self.z + (t - self.t) * self.slope).clamp(self.near, self.far)
    }
}

/// Sign of the depth difference `a - b` at `t`: -1 when a is nearer, 0 within the bound.
#[inline]
fn compare(a: &Line, b: &Line, t: f64) -> i32 {
    let difference = a.depth(t) - b.depth(t);
    if difference.abs() <= a.error + b.error {
        0
    } else if difference < 0.0 {
        -1
    } else {
        1
    }
}

/// Who is nearer on a stretch.
enum Nearer {
    New,
    Old,
    NewThenOld(f64),
    OldThenNew(f64),
}

/// Decides between two cuts on `s..e`; `new_first` tells whether the new one has the lower number.
#[inline]
fn decide(new: &Line, old: &Line, s: f64, e: f64, new_first: bool) -> Nearer {
    match (compare(new, old, s), compare(new, old, e)) {
        (0, 0) => {
            if new_first {
                Nearer::New
            } else {
                Nearer::Old
            }
        }
        (at_s, at_e) if at_s <= 0 && at_e <= 0 => Nearer::New,
        (at_s, at_e) if at_s >= 0 && at_e >= 0 => Nearer::Old,
        (at_s, _) => {
            let (a, b) = if new_first { (new, old) } else { (old, new) };
            let (from, to) = (a.start.max(b.start), a.end.min(b.end));
            let (d0, d1) = (a.depth(from) - b.depth(from), a.depth(to) - b.depth(to));
            let t = (from + (to - from) * (d0 / (d0 - d1))).clamp(s, e);
            if at_s < 0 { Nearer::NewThenOld(t) } else { Nearer::OldThenNew(t) }
        }
    }
}

/// Appends a piece; joins it to the last one if that is the same cut.
#[inline]
fn push(out: &mut Vec<Interval>, t0: f64, t1: f64, cut: u32) {
    if t0 >= t1 {
        return;
    }
    match out.last_mut() {
        Some(last) if last.cut == cut && last.t1 == t0 => last.t1 = t1,
        _ => out.push(Interval { t0, t1, cut }),
    }
}

/// Inserts cut `new`, which covers `a..b` (inside [0, 1]) at this column, into a pixel's list.
/// Returns whether it is nearest anywhere. `scratch` is memory to work in.
pub fn insert(
    list: &mut Vec<Interval>,
    scratch: &mut Vec<Interval>,
    cuts: &[Cut],
    column: &Column,
    new: u32,
    a: f64,
    b: f64,
) -> bool {
    let first = list.partition_point(|p| p.t1 <= a);
    let behind = first + list[first..].partition_point(|p| p.t0 < b);
    if first == behind {
        list.insert(first, Interval { t0: a, t1: b, cut: new });
        return true;
    }
    let new_cut = &cuts[new as usize];
    let new_line = Line::new(new_cut, column);
    scratch.clear();
    let mut won = false;
    let mut cursor = a;
    for piece in &list[first..behind] {
        if cursor < piece.t0 {
            push(scratch, cursor, piece.t0, new);
            won = true;
        }
        let (s, e) = (piece.t0.max(a), piece.t1.min(b));
        let old_cut = &cuts[piece.cut as usize];
        push(scratch, piece.t0, s, piece.cut);
        let new_first = new_cut.primitive < old_cut.primitive;
        let nearer = decide(&new_line, &Line::new(old_cut, column), s, e, new_first);
        match nearer {
            Nearer::New => push(scratch, s, e, new),
            Nearer::Old => push(scratch, s, e, piece.cut),
            Nearer::NewThenOld(t) => {
                push(scratch, s, t, new);
                push(scratch, t, e, piece.cut);
            }
            Nearer::OldThenNew(t) => {
                push(scratch, s, t, piece.cut);
                push(scratch, t, e, new);
            }
        }
        won |= !matches!(nearer, Nearer::Old);
        push(scratch, e, piece.t1, piece.cut);
        cursor = e;
    }
    if cursor < b {
        push(scratch, cursor, b, new);
        won = true;
    }
    if won {
        list.splice(first..behind, scratch.drain(..));
    }
    won
}

/// Length of the part of `a..b` on which `cut` is not behind the list: what is seen of a
/// see-through cut. The list does not change.
pub fn unhidden_length(
    list: &[Interval],
    cuts: &[Cut],
    column: &Column,
    cut: &Cut,
    a: f64,
    b: f64,
) -> f64 {
    let line = Line::new(cut, column);
    let mut hidden = 0.0;
    let first = list.partition_point(|p| p.t1 <= a);
    for piece in list[first..].iter().take_while(|p| p.t0 < b) {
        let (s, e) = (piece.t0.max(a), piece.t1.min(b));
        let old = Line::new(&cuts[piece.cut as usize], column);
        hidden += match decide(&line, &old, s, e, true) {
            Nearer::New => 0.0,
            Nearer::Old => e - s,
            Nearer::NewThenOld(t) => e - t,
            Nearer::OldThenNew(t) => t - s,
        };
    }
    (b - a) - hidden
}

/// Panics when the list breaks VI-1.
pub fn assert_well_formed(list: &[Interval]) {
    for p in list {
        assert!(0.0 <= p.t0 && p.t0 < p.t1 && p.t1 <= 1.0, "piece {p:?} lies in [0, 1]");
    }
    assert!(list.windows(2).all(|w| w[0].t1 <= w[1].t0), "sorted and disjoint: {list:?}");
}
