//! How important what a cell sees is: weights of its primitives and of its objects.
//!
//! The weight of a primitive in a cell is the mean over the cell's segments, by length, of its
//! share of (solid angle x segment). A segment that does not see it counts as 0, and segments
//! that lie on one line count each: they are samples of the same viewpoints. What only reaches
//! into the cell was not measured. The weight of an object is the sum of those of its primitives.
//!
//! Sums run in the order of segments and of primitives, so they are the same everywhere.

use sightline_geometry::{CellId, ObjectId, PrimitiveSet};
use sightline_scene::Scene;
use sightline_store::{ObjectRow, SegmentRow, Weight};

/// A solved segment and its length, metres.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen<'a> {
    /// What was seen.
    pub row: &'a SegmentRow,
    /// Length of the segment, metres.
    pub length: f64,
}

/// The weights of the members of a cell's set, ascending; `None` for those that were not measured.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CellWeights(Vec<Option<f64>>);

impl CellWeights {
    /// The weights of `set`, which holds what the segments saw and perhaps more.
    pub fn new(set: &PrimitiveSet, seen: &[Seen<'_>]) -> Self {
        let mut shares = vec![None; usize::try_from(set.len()).expect("a set fits into memory")];
        let length: f64 = seen.iter().map(|s| s.length).sum();
        for Seen { row, length: own } in seen {
            for (place, weight) in places_in(set, &row.set).zip(&row.weights) {
                let share: &mut Option<f64> = &mut shares[place];
                *share = Some(share.unwrap_or(0.0) + f64::from(*weight) * (own / length));
            }
        }
        Self(shares)
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

/// One row an object with a member in `set`, ascending.
pub(crate) fn object_rows(
    scene: &Scene,
    cell: CellId,
    set: &PrimitiveSet,
    weights: &CellWeights,
) -> Vec<ObjectRow> {
    let mut weights = weights.0.iter();
    visible_objects(scene, set)
        .map(|(object, visible_primitives)| {
            let primitives = &scene.objects[object.index()].primitives;
            let own = weights.by_ref().take(visible_primitives as usize);
            let weight: f64 = own.flatten().sum();
            ObjectRow {
                cell,
                object,
                visible_primitives,
                total_primitives: primitives.end - primitives.start,
                // Each weight is rounded to f32, so a sum may pass the whole by as much; and
                // see-through primitives of one object may lie behind each other.
                weight: weight.min(1.0),
                first_state: 0,
                last_state: 0,
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
        SegmentRow { segment: SegmentId(0), set, weights: weights.to_vec(), rays: 64 }
    }

    #[test]
    fn a_weight_is_the_mean_over_the_segments_by_length() {
        let (a, b) = (row(&[1, 2, 9], &[0.5, 0.25, 0.125]), row(&[2, 3], &[0.75, 0.25]));
        let set = PrimitiveSet::from_sorted([1, 2, 3, 4, 9]);
        let seen = [Seen { row: &a, length: 3.0 }, Seen { row: &b, length: 1.0 }];
        let weights = CellWeights::new(&set, &seen);
        assert_eq!(
            weights.0,
            [Some(0.375), Some(0.375), Some(0.0625), None, Some(0.09375)],
            "4 only reaches into the cell"
        );
        assert_eq!(weights.codes()[3], Weight::UNMEASURED);
        assert!(CellWeights::new(&set, &[]).0.iter().all(Option::is_none));
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
