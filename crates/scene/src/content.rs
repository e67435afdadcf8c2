//! What a scene at rest is made of, object by object, and what an edit changed.
//!
//! A [`SceneContent`] has a hash for each object: of its triangles, where they are placed and whether they
//! hide what is behind them. An [`Edit`] says which objects of two scenes are the same, and how their
//! numbers changed. What is not the same was taken away or added; an object that was moved was both.
//!
//! Invariants:
//! - objects that are the same have equal primitives in equal order, and come in the same order in both
//!   scenes: who wins a tie of depths is the same in both;
//! - there is an edit only between scenes with equal boxes and reach, on which numbering and the solver's
//!   error bounds rest.

use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;

use bytemuck::Pod;
use rayon::prelude::*;
use sightline_geometry::{InstancedGeometry, Mesh, ObjectId, PrimitiveSet, Run};

use crate::Scene;

/// Hash of what one object is made of.
pub type ObjectHash = [u8; 16];

/// What a scene at rest is made of.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneContent {
    /// World box, least and largest corner, metres.
    pub bounds: [f64; 6],
    /// [`InstancedGeometry::placement_reach`], metres.
    pub placement_reach: f64,
    /// For each object, in order, its hash and the number of its primitives.
    pub objects: Vec<(ObjectHash, u32)>,
}

/// Bytes that are hashed between two looks at the memory.
const PIECE: usize = 1 << 20;

impl SceneContent {
    /// The content of a scene; `None` where something moves or there are particles.
    #[must_use]
    pub fn of(scene: &Scene) -> Option<Self> {
        let geometry = &scene.geometry;
        if geometry.states > 1 || geometry.has_motion() || !geometry.particles.is_empty() {
            return None;
        }
        let meshes: Vec<blake3::Hash> =
            geometry.meshes.par_iter().map(|mesh| hash_of(geometry, mesh)).collect();
        let mut hashers = vec![blake3::Hasher::new(); scene.objects.len()];
        for instance in &geometry.instances {
            let hasher = &mut hashers[instance.object.index()];
            hasher.update(meshes[instance.mesh.index()].as_bytes());
            for entry in instance.world_from_mesh.to_cols_array() {
                hasher.update(&entry.to_bits().to_le_bytes());
            }
            hasher.update(&[u8::from(instance.occluder)]);
        }
        let objects = hashers.iter().zip(&scene.objects).map(|(hasher, object)| {
            let mut hash = ObjectHash::default();
            hash.copy_from_slice(&hasher.finalize().as_bytes()[..16]);
            (hash, object.primitives.end - object.primitives.start)
        });
        let (min, max) = (geometry.bounds.min, geometry.bounds.max);
        Some(Self {
            bounds: [min.x, min.y, min.z, max.x, max.y, max.z],
            placement_reach: geometry.placement_reach,
            objects: objects.collect(),
        })
    }

    fn primitives(&self) -> u64 {
        self.objects.iter().map(|(_, primitives)| u64::from(*primitives)).sum()
    }
}

fn hash_of(geometry: &InstancedGeometry, mesh: &Mesh) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    add(geometry, &mut hasher, &mesh.positions);
    add(geometry, &mut hasher, &mesh.triangles);
    hasher.finalize()
}

fn add<T: Pod>(geometry: &InstancedGeometry, hasher: &mut blake3::Hasher, elements: &[T]) {
    hasher.update(&(elements.len() as u64).to_le_bytes());
    // What is mapped from a file does not have to fit into memory at once.
    for piece in bytemuck::cast_slice::<T, u8>(elements).chunks(PIECE) {
        hasher.update(piece);
        geometry.look();
    }
}

/// Objects that follow each other in both scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Same {
    /// The first object, before and after.
    pub object: [u32; 2],
    /// Its first primitive, before and after.
    pub primitive: [u32; 2],
    /// Number of objects.
    pub objects: u32,
    /// Number of their primitives, at least 1.
    pub primitives: u32,
}

/// What is the same in two scenes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Edit {
    /// Runs of objects, ascending in both scenes.
    pub same: Vec<Same>,
}

impl Edit {
    /// What is the same before and after; `None` where the scenes differ in box or reach.
    #[must_use]
    pub fn between(before: &SceneContent, after: &SceneContent) -> Option<Self> {
        let frame = |c: &SceneContent| (c.bounds.map(f64::to_bits), c.placement_reach.to_bits());
        if frame(before) != frame(after) {
            return None;
        }
        let mut places: BTreeMap<ObjectHash, VecDeque<usize>> = BTreeMap::new();
        for (index, (hash, _)) in before.objects.iter().enumerate() {
            places.entry(*hash).or_default().push_back(index);
        }
        let pairs: Vec<(usize, usize)> = (0..after.objects.len())
            .filter_map(|new| Some((places.get_mut(&after.objects[new].0)?.pop_front()?, new)))
            .collect();
        let starts = |content: &SceneContent| -> Vec<u32> {
            let numbers = content.objects.iter().scan(0, |next, (_, primitives)| {
                let start = *next;
                *next += primitives;
                Some(start)
            });
            numbers.collect()
        };
        let (old_starts, new_starts) = (starts(before), starts(after));
        let mut edit = Self::default();
        for (old, new) in longest_ascending(&pairs) {
            let primitives = after.objects[new].1;
            let same = Same {
                object: [old as u32, new as u32],
                primitive: [old_starts[old], new_starts[new]],
                objects: 1,
                primitives,
            };
            match edit.same.last_mut() {
                Some(last) if last.object.map(|o| o + last.objects) == same.object => {
                    last.objects += 1;
                    last.primitives += primitives;
                }
                _ => edit.same.push(same),
            }
        }
        Some(edit)
    }

    /// Number of primitives that are the same.
    #[must_use]
    pub fn primitives(&self) -> u64 {
        self.same.iter().map(|same| u64::from(same.primitives)).sum()
    }

    /// Number of objects that are the same.
    #[must_use]
    pub fn objects(&self) -> u64 {
        self.same.iter().map(|same| u64::from(same.objects)).sum()
    }

    /// True when so much is the same that it is worth looking at what an earlier bake found: half.
    #[must_use]
    pub fn is_small(&self, after: &SceneContent) -> bool {
        2 * self.primitives() >= after.primitives()
    }

    /// The set in the numbers after the edit; `None` when it has a member that was taken away.
    #[must_use]
    pub fn renumbered(&self, set: &PrimitiveSet) -> Option<PrimitiveSet> {
        let mut out = PrimitiveSet::default();
        let mut at = 0;
        for run in set.runs() {
            let mut first = run.first;
            while first < run.end {
                let same = self.same.get(at)?;
                let [old, new] = same.primitive;
                if first >= old + same.primitives {
                    at += 1;
                    continue;
                }
                let offset = first.checked_sub(old)?;
                let end = run.end.min(old + same.primitives);
                out.push(Run { first: new + offset, end: new + (end - old) });
                first = end;
            }
        }
        Some(out)
    }

    /// The number after the edit of an object; `None` when it was taken away.
    #[must_use]
    pub fn object(&self, before: ObjectId) -> Option<ObjectId> {
        let behind = self.same.partition_point(|same| same.object[0] <= before.0);
        let same = self.same.get(behind.checked_sub(1)?)?;
        let offset = before.0 - same.object[0];
        (offset < same.objects).then(|| ObjectId(same.object[1] + offset))
    }

    /// What was added, in the numbers after the edit, of a scene with so many primitives.
    #[must_use]
    pub fn added(&self, primitives: u32) -> PrimitiveSet {
        let ends = self.same.iter().map(|same| same.primitive[1] + same.primitives);
        let starts = self.same.iter().map(|same| same.primitive[1]);
        let gaps = std::iter::once(0).chain(ends).zip(starts.chain(std::iter::once(primitives)));
        let mut added = PrimitiveSet::default();
        for Range { start: first, end } in gaps.map(|(a, b)| a..b).filter(|gap| !gap.is_empty()) {
            added.push(Run { first, end });
        }
        added
    }

    /// What is wrong with an edit that was read, between scenes with so many primitives; nothing when it is
    /// one.
    #[must_use]
    pub fn problem(&self, primitives: u32) -> Option<&'static str> {
        let fits = |number: u32, count: u32| number.checked_add(count).is_some();
        let is_whole = self.same.iter().all(|s| {
            s.primitives > 0
                && s.objects > 0
                && s.object.iter().all(|o| fits(*o, s.objects))
                && s.primitive.iter().all(|p| fits(*p, s.primitives))
        });
        if !is_whole {
            return Some("a run of objects is empty or has no end");
        }
        let ascends = self.same.windows(2).all(|pair| {
            (0..2).all(|k| {
                pair[0].object[k] + pair[0].objects <= pair[1].object[k]
                    && pair[0].primitive[k] + pair[0].primitives <= pair[1].primitive[k]
            })
        });
        if !ascends {
            return Some("its runs of objects are out of order");
        }
        let last = self.same.last();
        let is_inside = last.is_none_or(|s| s.primitive[1] + s.primitives <= primitives);
        (!is_inside).then_some("it has primitives that the scene lacks")
    }
}

/// The longest sub-sequence of pairs whose first members ascend; the second ones do already.
///
/// Source: Fredman, "On computing the length of longest increasing subsequences" (Discrete Mathematics,
/// 1975).
fn longest_ascending(pairs: &[(usize, usize)]) -> Vec<(usize, usize)> {
    // tails[k]: the pair with the least first member that ends an ascending sequence of k + 1.
    let mut tails: Vec<usize> = Vec::new();
    let mut before: Vec<Option<usize>> = Vec::with_capacity(pairs.len());
    for (index, pair) in pairs.iter().enumerate() {
        let length = tails.partition_point(|tail| pairs[*tail].0 < pair.0);
        before.push(length.checked_sub(1).map(|k| tails[k]));
        if length == tails.len() {
            tails.push(index);
        } else {
            tails[length] = index;
        }
    }
    let mut chain = Vec::with_capacity(tails.len());
    let mut at = tails.last().copied();
    while let Some(index) = at {
        chain.push(pairs[index]);
        at = before[index];
    }
    chain.reverse();
    chain
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Objects by name; the name says how many primitives each has.
    fn content(objects: &[u8]) -> SceneContent {
        let objects = objects.iter().map(|name| ([*name; 16], u32::from(*name % 5) + 1)).collect();
        SceneContent { bounds: [0.0; 6], placement_reach: 1.0, objects }
    }

    fn primitives(content: &SceneContent) -> Vec<(ObjectHash, u32)> {
        let of = |(hash, count): &(ObjectHash, u32)| {
            let hash = *hash;
            (0..*count).map(move |k| (hash, k)).collect::<Vec<_>>()
        };
        content.objects.iter().flat_map(of).collect()
    }

    #[test]
    fn a_moved_object_is_taken_away_and_added() {
        let (before, after) = (content(&[1, 2, 3, 4]), content(&[1, 3, 2, 4]));
        let edit = Edit::between(&before, &after).unwrap();
        assert_eq!(edit.objects(), 3);
        assert_eq!(edit.problem(after.primitives() as u32), None);
        let moved = edit.object(ObjectId(1)).is_none() || edit.object(ObjectId(2)).is_none();
        assert!(moved, "one of the two: {edit:?}");
    }

    #[test]
    fn scenes_in_other_boxes_have_nothing_in_common() {
        let (before, mut after) = (content(&[1, 2]), content(&[1, 2]));
        assert!(Edit::between(&before, &after).is_some());
        after.bounds[3] = 1.0;
        assert_eq!(Edit::between(&before, &after), None);
        after = content(&[1, 2]);
        after.placement_reach = 2.0;
        assert_eq!(Edit::between(&before, &after), None);
    }

    proptest! {
        #[test]
        fn what_is_the_same_keeps_its_primitives(
            old in proptest::collection::vec(0u8..30, 0..20),
            new in proptest::collection::vec(0u8..30, 0..20),
        ) {
            let (before, after) = (content(&old), content(&new));
            let edit = Edit::between(&before, &after).unwrap();
            let (old, new) = (primitives(&before), primitives(&after));
            prop_assert_eq!(edit.problem(new.len() as u32), None);
            let mut kept = 0;
            for (number, primitive) in (0..).zip(&old) {
                let set = PrimitiveSet::from_sorted([number]);
                if let Some(now) = edit.renumbered(&set) {
                    prop_assert_eq!(&new[now.runs()[0].first as usize], primitive);
                    kept += 1;
                }
            }
            prop_assert_eq!(kept, edit.primitives());
            let added = edit.added(new.len() as u32);
            prop_assert_eq!(added.len() + kept, new.len() as u64);
            let whole: Vec<u32> = (0..old.len() as u32)
                .filter(|n| edit.renumbered(&PrimitiveSet::from_sorted([*n])).is_some())
                .collect();
            let renumbered = edit.renumbered(&PrimitiveSet::from_sorted(whole.iter().copied())).unwrap();
            prop_assert_eq!(renumbered.len(), kept);
            prop_assert!(renumbered.iter().all(|p| !added.contains(p)));
        }

        #[test]
        fn the_same_scene_is_one_run(names in proptest::collection::vec(0u8..250, 1..30)) {
            let scene = content(&names);
            let edit = Edit::between(&scene, &scene).unwrap();
            prop_assert_eq!(edit.same.len(), 1);
            prop_assert!(edit.added(scene.primitives() as u32).is_empty());
        }
    }
}
