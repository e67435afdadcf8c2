//! How important what a cell sees is: weights of its primitives and of its objects.
//!
//! The weight of a primitive in a cell is the mean over the cell's segments, by length, of its
//! share of (solid angle x segment). A segment that does not see it counts as 0, and segments
//! that lie on one line count each: they are samples of the same viewpoints. What only reaches
//! into the cell was not measured. The weight of an object is the sum of those of its primitives.
//!
//! Over several states it is the mean of the states, by duration. In each, the segments are those that
//! were solved in it.
//!
//! Sums run in the order of states, of segments and of primitives, so they are the same everywhere.

use std::ops::Range;

use sightline_geometry::{ObjectId, PrimitiveSet, Timeline};
use sightline_scene::Scene;
use sightline_store::{CellRow, ObjectRow, SegmentRow, Weight};

/// A solved segment and its length, metres.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen<'a> {
    /// What was seen, by runs of the states in which it was solved.
    pub rows: &'a [SegmentRow],
    /// Length of the segment, metres.
    pub length: f64,
}

impl<'a> Seen<'a> {
    /// What was seen in a state; `None` when the segment was not solved in it.
    fn at(&self, state: u32) -> Option<&'a SegmentRow> {
        self.rows.iter().find(|row| row.states().contains(&state))
    }
}

/// The weights of the members of a cell's set, ascending; `None` for those that were not measured.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CellWeights(Vec<Option<f64>>);

impl CellWeights {
    /// The weights of `set`, which holds what the segments saw in each of `states` and perhaps more.
    ///
    /// # Panics
    /// When no segment was solved in a state.
    pub fn new(
        set: &PrimitiveSet,
        seen: &[Seen<'_>],
        states: &Range<u32>,
        timeline: &Timeline,
    ) -> Self {
        let mut weights = Self::unmeasured(set);
        // Between two borders, each segment sees one thing or was not solved.
        let ends =
            seen.iter().flat_map(|s| s.rows).flat_map(|row| [row.states().start, row.states().end]);
        let mut borders: Vec<u32> = ends.filter(|end| states.contains(end)).collect();
        borders.extend([states.start, states.end]);
        borders.sort_unstable();
        borders.dedup();
        for piece in borders.windows(2).map(|pair| pair[0]..pair[1]) {
            let time = timeline.share_of(&piece, states);
            let solved: Vec<(&SegmentRow, f64)> =
                seen.iter().filter_map(|s| Some((s.at(piece.start)?, s.length))).collect();
            let length: f64 = solved.iter().map(|(_, length)| length).sum();
            for (row, own) in solved {
                let shares = row.weights.iter().map(|weight| Some(f64::from(*weight)));
                weights.add(set, &row.set, shares, (own / length) * time);
            }
        }
        weights
    }

    /// Weights of a set of which nothing was measured.
    pub fn unmeasured(set: &PrimitiveSet) -> Self {
        Self(vec![None; usize::try_from(set.len()).expect("a set fits into memory")])
    }

    /// Adds what was measured of a subset, `shares`, as such a part of the whole.
    pub fn add(
        &mut self,
        set: &PrimitiveSet,
        subset: &PrimitiveSet,
        shares: impl Iterator<Item = Option<f64>>,
        part: f64,
    ) {
        for (place, measured) in places_in(set, subset).zip(shares) {
            let Some(measured) = measured else { continue };
            let share: &mut Option<f64> = &mut self.0[place];
            *share = Some(share.unwrap_or(0.0) + measured * part);
        }
    }

    /// As the dataset stores them.
    pub fn codes(&self) -> Vec<Weight> {
        self.0.iter().map(|w| w.map_or(Weight::UNMEASURED, Weight::from_share)).collect()
    }
}

/// For each member of `subset`, ascending, its place among the members of `set`.
fn places_in(set: &PrimitiveSet, subset: &PrimitiveSet) -> impl Iterator<Item = usize> {
    let (mut runs, mut before) = (set.runs().iter().peekable(), 0);
    subset.runs().iter().flat_map(move |own| {
        // A run of the subset lies within one run of the set.
        while let Some(passed) = runs.next_if(|run| run.end <= own.first) {
            before += (passed.end - passed.first) as usize;
        }
        let run = runs.peek().expect("the set holds the subset");
        let first = before + (own.first - run.first) as usize;
        first..first + (own.end - own.first) as usize
    })
}

/// One row an object with a member in the set of a cell, ascending. `union` is the cell's row of all
/// states, `runs` those of its runs, by time.
pub(crate) fn object_rows(
    scene: &Scene,
    union: &CellRow,
    weights: &CellWeights,
    runs: &[CellRow],
) -> Vec<ObjectRow> {
    let mut weights = weights.0.iter();
    visible_objects(scene, &union.set)
        .map(|(object, visible_primitives)| {
            let primitives = &scene.objects[object.index()].primitives;
            let own = weights.by_ref().take(visible_primitives as usize);
            let weight: f64 = own.flatten().sum();
            let seen = |run: &&CellRow| run.set.count_in(primitives.clone()) > 0;
            let (first, last) = (runs.iter().find(seen), runs.iter().rev().find(seen));
            ObjectRow {
                cell: union.cell.id,
                object,
                visible_primitives,
                total_primitives: primitives.end - primitives.start,
                // Each weight is rounded to f32, so a sum may pass the whole by as much; and
                // see-through primitives of one object may lie behind each other.
                weight: weight.min(1.0),
                first_state: first.map_or(union.first_state, |run| run.first_state),
                last_state: last.map_or(union.last_state, |run| run.last_state),
            }
        })
        .collect()
}

/// Objects with a member in `set`, ascending, and how many members each has.
fn visible_objects<'a>(
    scene: &'a Scene,
    set: &'a PrimitiveSet,
) -> impl Iterator<Item = (ObjectId, u32)> + 'a {
    let mut next = 0;
    std::iter::from_fn(move || {
        // The object of the first member at or behind `next`.
        let runs = set.runs();
        let run = runs.get(runs.partition_point(|run| run.end <= next))?;
        let object = object_of(scene, run.first.max(next));
        let range = scene.objects[object.index()].primitives.clone();
        next = range.end;
        let count =
            u32::try_from(set.count_in(range)).expect("an object has under 2^32 primitives");
        Some((object, count))
    })
}

fn object_of(scene: &Scene, primitive: u32) -> ObjectId {
    let behind = scene.objects.partition_point(|object| object.primitives.end <= primitive);
    scene.objects[behind].id
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sightline_geometry::SegmentId;

    use super::*;

    fn row(members: &[u32], weights: &[f32]) -> SegmentRow {
        let set = PrimitiveSet::from_sorted(members.iter().copied());
        let (segment, weights) = (SegmentId(0), weights.to_vec());
        SegmentRow { segment, first_state: 0, last_state: 0, set, weights, rays: 64 }
    }

    #[test]
    fn a_weight_is_the_mean_over_the_segments_by_length() {
        let (a, b) = (row(&[1, 2, 9], &[0.5, 0.25, 0.125]), row(&[2, 3], &[0.75, 0.25]));
        let set = PrimitiveSet::from_sorted([1, 2, 3, 4, 9]);
        let (a, b) = ([a], [b]);
        let seen = [Seen { rows: &a, length: 3.0 }, Seen { rows: &b, length: 1.0 }];
        let weights = CellWeights::new(&set, &seen, &(0..1), &Timeline::at_rest());
        assert_eq!(
            weights.0,
            [Some(0.375), Some(0.375), Some(0.0625), None, Some(0.09375)],
            "4 only reaches into the cell"
        );
        assert_eq!(weights.codes()[3], Weight::UNMEASURED);
        let nothing = CellWeights::new(&set, &[], &(0..1), &Timeline::at_rest());
        assert!(nothing.0.iter().all(Option::is_none));
    }

    #[test]
    fn states_weigh_by_their_duration_and_segments_where_they_were_solved() {
        let in_states = |row: SegmentRow, states: Range<u32>| SegmentRow {
            first_state: states.start,
            last_state: states.end - 1,
            ..row
        };
        // 1 is seen from the first segment for a quarter of the time; the second was solved in the rest.
        let first = [in_states(row(&[1], &[0.5]), 0..1), in_states(row(&[], &[]), 1..2)];
        let second = [in_states(row(&[2], &[0.5]), 1..2)];
        let timeline = Timeline::new(vec![0.0, 1.0, 4.0]).unwrap();
        let set = PrimitiveSet::from_sorted([1, 2]);
        let seen = [Seen { rows: &first, length: 1.0 }, Seen { rows: &second, length: 3.0 }];
        let weights = CellWeights::new(&set, &seen, &(0..2), &timeline);
        assert_eq!(weights.0, [Some(0.125), Some(0.5 * 0.75 * 0.75)]);
        let late = CellWeights::new(&set, &seen, &(1..2), &timeline);
        assert_eq!(late.0, [None, Some(0.375)]);
    }

    proptest! {
        #[test]
        fn members_find_their_places(
            members in prop::collection::btree_set(0..300_u32, 0..100),
            kept in prop::collection::vec(any::<bool>(), 100),
        ) {
            let set = PrimitiveSet::from_sorted(members.iter().copied());
            let some: Vec<u32> =
                members.iter().zip(&kept).filter(|(_, k)| **k).map(|(m, _)| *m).collect();
            let subset = PrimitiveSet::from_sorted(some.iter().copied());
            let all: Vec<u32> = members.iter().copied().collect();
            let found: Vec<u32> = places_in(&set, &subset).map(|p| all[p]).collect();
            prop_assert_eq!(found, some);
        }
    }
}
