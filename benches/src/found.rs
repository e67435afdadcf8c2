//! The primitives that a sampling method has found so far, one bit each.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use sightline_geometry::PrimitiveSet;

/// A set of primitives that threads add to.
pub struct Found {
    words: Vec<AtomicU64>,
}

impl Found {
    /// The empty set in a scene of `primitives` primitives.
    #[must_use]
    pub fn new(primitives: u32) -> Self {
        Self { words: (0..primitives.div_ceil(64)).map(|_| AtomicU64::new(0)).collect() }
    }

    /// Adds a primitive; true when it is new.
    #[inline]
    pub fn insert(&self, primitive: u32) -> bool {
        let (word, bit) = (&self.words[primitive as usize / 64], 1 << (primitive % 64));
        // Nearly always there already: a plain load keeps the line shared between threads.
        word.load(Relaxed) & bit == 0 && word.fetch_or(bit, Relaxed) & bit == 0
    }

    /// True when the primitive was added.
    #[inline]
    #[must_use]
    pub fn contains(&self, primitive: u32) -> bool {
        self.words[primitive as usize / 64].load(Relaxed) >> (primitive % 64) & 1 == 1
    }

    /// Adds all of `set`.
    pub fn insert_all(&self, set: &PrimitiveSet) {
        for p in set.iter() {
            self.insert(p.0);
        }
    }

    /// The members so far.
    #[must_use]
    pub fn set(&self) -> PrimitiveSet {
        let members = self.words.iter().zip(0u32..).flat_map(|(word, k)| {
            let word = word.load(Relaxed);
            (0..64).filter(move |b| word >> b & 1 == 1).map(move |b| 64 * k + b)
        });
        PrimitiveSet::from_sorted(members)
    }

    /// Number of members so far.
    #[must_use]
    pub fn len(&self) -> u64 {
        self.words.iter().map(|w| u64::from(w.load(Relaxed).count_ones())).sum()
    }

    /// True for the empty set.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of members of `set` that were found.
    #[must_use]
    pub fn len_of(&self, set: &PrimitiveSet) -> u64 {
        set.iter().filter(|p| self.contains(p.0)).count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn found_sets_keep_members() {
        let found = Found::new(200);
        assert!(found.insert(63) && found.insert(64) && !found.insert(63));
        assert_eq!(found.set().iter().map(|p| p.0).collect::<Vec<_>>(), [63, 64]);
        assert_eq!((found.len(), found.len_of(&PrimitiveSet::from_sorted([64, 65]))), (2, 1));
    }
}
