//! Sets of primitives as sorted runs of global numbers.

use crate::PrimitiveId;

/// A half-open run of global primitive numbers, `first .. end`, never empty.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    /// First number in the run.
    pub first: u32,
    /// First number behind the run.
    pub end: u32,
}

/// A set of primitives: runs in ascending order, neither empty nor touching.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PrimitiveSet {
    runs: Vec<Run>,
}

impl PrimitiveSet {
    /// The set of `ids`, which must be sorted (duplicates are allowed).
    pub fn from_sorted(ids: impl IntoIterator<Item = u32>) -> Self {
        let mut set = Self::default();
        for id in ids {
            set.push(Run { first: id, end: id + 1 });
        }
        set
    }

    /// Appends a run that starts no earlier than the last run; joins what touches.
    ///
    /// # Panics
    /// When the run is empty or out of order.
    pub fn push(&mut self, run: Run) {
        assert!(run.first < run.end, "a run is never empty");
        match self.runs.last_mut() {
            Some(last) if run.first <= last.end => {
                assert!(run.first >= last.first, "runs are pushed in order");
                last.end = last.end.max(run.end);
            }
            _ => self.runs.push(run),
        }
    }

    /// The runs, ascending.
    #[must_use]
    pub fn runs(&self) -> &[Run] {
        &self.runs
    }

    /// Number of primitives.
    #[must_use]
    pub fn len(&self) -> u64 {
        self.runs.iter().map(|r| u64::from(r.end - r.first)).sum()
    }

    /// True for the empty set.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.runs.is_empty()
    }

    /// The members, ascending.
    pub fn iter(&self) -> impl Iterator<Item = PrimitiveId> + '_ {
        self.runs.iter().flat_map(|r| (r.first..r.end).map(PrimitiveId))
    }

    /// True when the primitive is in the set. Logarithmic in the number of runs.
    #[must_use]
    pub fn contains(&self, primitive: PrimitiveId) -> bool {
        let after = self.runs.partition_point(|r| r.first <= primitive.0);
        after > 0 && primitive.0 < self.runs[after - 1].end
    }

    /// Number of members in `first..end`.
    #[must_use]
    pub fn count_in(&self, range: std::ops::Range<u32>) -> u64 {
        let from = self.runs.partition_point(|r| r.end <= range.start);
        self.runs[from..]
            .iter()
            .take_while(|r| r.first < range.end)
            .map(|r| u64::from(r.end.min(range.end) - r.first.max(range.start)))
            .sum()
    }

    /// The union of sets.
    #[must_use]
    pub fn union<'a>(sets: impl IntoIterator<Item = &'a Self>) -> Self {
        let mut runs: Vec<Run> = sets.into_iter().flat_map(|s| s.runs.iter().copied()).collect();
        runs.sort_unstable_by_key(|r| (r.first, r.end));
        let mut out = Self::default();
        for run in runs {
            out.push(run);
        }
        out
    }

    /// Panics when the runs are not sorted, empty or touch each other.
    pub fn assert_well_formed(&self) {
        assert!(self.runs.iter().all(|r| r.first < r.end), "no empty run");
        assert!(self.runs.windows(2).all(|w| w[0].end < w[1].first), "ascending, not touching");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_keep_members_and_forget_order() {
        let a = PrimitiveSet::from_sorted([1, 2, 3, 7, 7, 9]);
        a.assert_well_formed();
        assert_eq!(a.runs().len(), 3);
        assert_eq!(a.len(), 5);
        let b = PrimitiveSet::from_sorted([4, 8]);
        let both = PrimitiveSet::union([&a, &b]);
        both.assert_well_formed();
        assert_eq!(both.iter().map(|p| p.0).collect::<Vec<_>>(), [1, 2, 3, 4, 7, 8, 9]);
        assert!(both.contains(PrimitiveId(8)) && !both.contains(PrimitiveId(5)));
        assert_eq!(both.count_in(3..8), 3);
    }
}
