//! A set of primitives as one bit a primitive: membership in constant time; and sets of several states.
//!
//! What is visible in every state has a bit a primitive, once for all states. Nearly every ray ends
//! there. What is visible in some states is looked up in the set of the state.

use sightline_geometry::{PrimitiveId, PrimitiveSet, StateSets};

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

/// The members of [`StateSets`], state by state.
#[derive(Clone, Debug)]
pub struct StateMembers<'a> {
    /// What is in the sets of all states.
    always: Members,
    sets: &'a StateSets,
}

impl<'a> StateMembers<'a> {
    /// The members of `sets` in a scene of `primitives` primitives.
    ///
    /// # Panics
    /// When a set has a member that the scene lacks.
    #[must_use]
    pub fn new(sets: &'a StateSets, primitives: u32) -> Self {
        let mut members = sets.runs().iter().map(|(_, set)| Members::new(set, primitives));
        let mut always = members.next().expect("there is a run");
        for other in members {
            for (word, other) in always.words.iter_mut().zip(other.words) {
                *word &= other;
            }
        }
        Self { always, sets }
    }

    /// The sets.
    #[must_use]
    pub const fn sets(&self) -> &StateSets {
        self.sets
    }

    /// True when the primitive is in the set of a state.
    ///
    /// # Panics
    /// When the state is not covered; may panic when the scene has no such primitive.
    #[inline]
    #[must_use]
    pub fn contains(&self, primitive: PrimitiveId, state: u32) -> bool {
        self.always.contains(primitive)
            || self.sets.runs().len() > 1 && self.sets.at(state).contains(primitive)
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

    #[test]
    fn states_agree_with_their_sets() {
        let set = |members: &[u32]| PrimitiveSet::from_sorted(members.iter().copied());
        let sets = StateSets::from_runs([
            (3..5, set(&[1, 64, 200])),
            (5..6, set(&[1, 65])),
            (6..9, set(&[1, 64])),
        ]);
        let members = StateMembers::new(&sets, 300);
        for (p, state) in (0..300).flat_map(|p| (3..9).map(move |state| (PrimitiveId(p), state))) {
            assert_eq!(members.contains(p, state), sets.at(state).contains(p), "{p} {state}");
        }
    }
}
