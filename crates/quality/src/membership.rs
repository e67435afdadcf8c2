//! A set of primitives as one bit a primitive: membership in constant time.

use sightline_geometry::{PrimitiveId, PrimitiveSet};

/// The members of a [`PrimitiveSet`], one bit a primitive of the scene.
#[derive(Clone, Debug)]
pub struct Members {
    words: Vec<u64>,
}

impl Members {
    /// The members of `set` in a scene of `primitives` primitives.
    ///
    /// # Panics
    /// When the set has a member that the scene lacks.
    #[must_use]
    pub fn new(set: &PrimitiveSet, primitives: u32) -> Self {
        let mut words = vec![0u64; primitives.div_ceil(64) as usize];
        for run in set.runs() {
            assert!(run.end <= primitives, "primitive {} is not in the scene", run.end - 1);
            let (first, last) = (run.first as usize, run.end as usize - 1);
            let from = u64::MAX << (first % 64);
            let to = u64::MAX >> (63 - last % 64);
            if first / 64 == last / 64 {
                words[first / 64] |= from & to;
            } else {
                words[first / 64] |= from;
                words[first / 64 + 1..last / 64].fill(u64::MAX);
                words[last / 64] |= to;
            }
        }
        Self { words }
    }

    /// True when the primitive is in the set.
    ///
    /// # Panics
    /// May panic when the scene has no such primitive.
    #[inline]
    #[must_use]
    pub fn contains(&self, primitive: PrimitiveId) -> bool {
        self.words[primitive.index() / 64] >> (primitive.0 % 64) & 1 == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_agree_with_runs() {
        for members in [vec![], vec![0], vec![63, 64], (5..64).collect(), (1..300).collect()] {
            let set = PrimitiveSet::from_sorted(members);
            let bits = Members::new(&set, 300);
            assert!((0..300).map(PrimitiveId).all(|p| bits.contains(p) == set.contains(p)));
        }
    }
}
