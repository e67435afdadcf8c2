//! What is visible in each state: sets of primitives by runs of states.

use std::ops::Range;

use crate::PrimitiveSet;

/// Sets of primitives over consecutive states, as runs of states with equal sets.
///
/// Invariants: runs are ascending, meet without gaps, none is empty, and two that meet differ.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StateSets {
    runs: Vec<(Range<u32>, PrimitiveSet)>,
}

impl StateSets {
    /// One set for all of `states`.
    ///
    /// # Panics
    /// Without a state.
    #[must_use]
    pub fn constant(states: Range<u32>, set: PrimitiveSet) -> Self {
        assert!(!states.is_empty(), "there is a state");
        Self { runs: vec![(states, set)] }
    }

    /// Joins runs that follow each other; equal neighbours become one.
    ///
    /// # Panics
    /// Without a run, with an empty one, or with a gap.
    #[must_use]
    pub fn from_runs(runs: impl IntoIterator<Item = (Range<u32>, PrimitiveSet)>) -> Self {
        let mut out: Vec<(Range<u32>, PrimitiveSet)> = Vec::new();
        for (states, set) in runs {
            assert!(!states.is_empty(), "a run has a state");
            match out.last_mut() {
                Some(last) => {
                    assert_eq!(last.0.end, states.start, "runs meet");
                    if last.1 == set {
                        last.0.end = states.end;
                    } else {
                        out.push((states, set));
                    }
                }
                None => out.push((states, set)),
            }
        }
        assert!(!out.is_empty(), "there is a run");
        Self { runs: out }
    }

    /// The states that are covered.
    #[must_use]
    pub fn states(&self) -> Range<u32> {
        self.runs[0].0.start..self.runs[self.runs.len() - 1].0.end
    }

    /// The runs, ascending.
    #[must_use]
    pub fn runs(&self) -> &[(Range<u32>, PrimitiveSet)] {
        &self.runs
    }

    /// Number of the run that holds a state.
    ///
    /// # Panics
    /// When the state is not covered.
    #[must_use]
    pub fn run_of(&self, state: u32) -> usize {
        assert!(self.states().contains(&state), "state {state} is not in {:?}", self.states());
        self.runs.partition_point(|run| run.0.end <= state)
    }

    /// The set of a state.
    ///
    /// # Panics
    /// When the state is not covered.
    #[must_use]
    pub fn at(&self, state: u32) -> &PrimitiveSet {
        &self.runs[self.run_of(state)].1
    }

    /// The sets of some of the states.
    ///
    /// # Panics
    /// Without a state, or when one is not covered.
    #[must_use]
    pub fn within(&self, states: Range<u32>) -> Self {
        let own = self.states();
        assert!(own.start <= states.start && states.end <= own.end, "{states:?} of {own:?}");
        let cut = |run: &Range<u32>| run.start.max(states.start)..run.end.min(states.end);
        Self::from_runs(
            self.runs
                .iter()
                .map(|(run, set)| (cut(run), set))
                .filter(|(run, _)| !run.is_empty())
                .map(|(run, set)| (run, set.clone())),
        )
    }

    /// The same over more states: empty sets where there were none.
    ///
    /// # Panics
    /// When `states` does not hold those that are covered.
    #[must_use]
    pub fn padded(&self, states: Range<u32>) -> Self {
        let own = self.states();
        assert!(states.start <= own.start && own.end <= states.end, "{own:?} of {states:?}");
        let empty = |states: Range<u32>| {
            Some((states, PrimitiveSet::default())).filter(|(states, _)| !states.is_empty())
        };
        let before = empty(states.start..own.start);
        let behind = empty(own.end..states.end);
        Self::from_runs(before.into_iter().chain(self.runs.iter().cloned()).chain(behind))
    }

    /// What is visible in any state.
    #[must_use]
    pub fn union(&self) -> PrimitiveSet {
        PrimitiveSet::union(self.runs.iter().map(|run| &run.1))
    }

    /// State by state, the union of several over the same states.
    ///
    /// # Panics
    /// Without any, or over different states.
    #[must_use]
    pub fn join<'a>(all: impl IntoIterator<Item = &'a Self>) -> Self {
        let all: Vec<&Self> = all.into_iter().collect();
        let states = all[0].states();
        assert!(all.iter().all(|one| one.states() == states), "over the same states");
        let mut borders: Vec<u32> =
            all.iter().flat_map(|one| one.runs.iter().map(|run| run.0.start)).collect();
        borders.sort_unstable();
        borders.dedup();
        borders.push(states.end);
        Self::from_runs(borders.windows(2).map(|pair| {
            let set = PrimitiveSet::union(all.iter().map(|one| one.at(pair[0])));
            (pair[0]..pair[1], set)
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(members: &[u32]) -> PrimitiveSet {
        PrimitiveSet::from_sorted(members.iter().copied())
    }

    #[test]
    fn runs_meet_and_equal_neighbours_are_one() {
        let sets =
            StateSets::from_runs([(2..3, set(&[1])), (3..5, set(&[1])), (5..6, set(&[1, 2]))]);
        assert_eq!(sets.runs().len(), 2);
        assert_eq!((sets.states(), sets.run_of(4), sets.run_of(5)), (2..6, 0, 1));
        assert_eq!(sets.at(5), &set(&[1, 2]));
        assert_eq!(sets.union(), set(&[1, 2]));
        let other = StateSets::from_runs([(2..4, set(&[7])), (4..6, set(&[]))]);
        let both = StateSets::join([&sets, &other]);
        let expected = [(2..4, set(&[1, 7])), (4..5, set(&[1])), (5..6, set(&[1, 2]))];
        assert_eq!(both.runs(), expected);
        assert_eq!(both.within(3..5).runs(), [(3..4, set(&[1, 7])), (4..5, set(&[1]))]);
        let padded = both.within(4..5).padded(2..6);
        assert_eq!(padded.runs(), [(2..4, set(&[])), (4..5, set(&[1])), (5..6, set(&[]))]);
        assert_eq!(padded.within(4..5).padded(4..5), both.within(4..5));
        assert_eq!(StateSets::constant(0..9, set(&[3])).at(8), &set(&[3]));
    }
}
