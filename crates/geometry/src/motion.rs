//! Motion: key frames, and what lies between them.
//!
//! A scene of K states has K + 1 key frames, 0..=K. State k lasts from key frame k to key frame
//! k + 1, and in it every vertex, every centre and every radius moves linearly. A scene at rest has
//! one state and a single key frame.
//!
//! Whatever moves has a value a key frame; what rests throughout has one value for all. Between two
//! key frames a value is [`lerp`] of the two, evaluated the same way everywhere, so that two parts of
//! the project that look at one moment see the same bits.
//!
//! A [`MovingHierarchy`] is a hierarchy over such things: one tree for all key frames, whose nodes
//! have a box at each. Boxes move linearly too: a box that contains a point at both key frames
//! contains it between them. The union of a node's boxes over several key frames is a *temporal
//! bounding volume*: it holds all that is below the node for as long.
//!
//! Source: Popescu et al., from-segment visibility, section 3.2 (linear motion between states);
//! Sudarsky and Gotsman, "Output-Sensitive Rendering and Communication in Dynamic Virtual
//! Environments" (VRST 1997), section 2.2 (temporal bounding volumes).

use std::ops::Range;

use glam::{DAffine3, DVec3};
use serde::{Deserialize, Serialize};

use crate::{Bounds, Bounds32, Hierarchy, hierarchy::EMPTY};

/// A time of a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Moment {
    /// The state, below the scene's number of states.
    pub state: u32,
    /// How far the motion of the state has gone, in [0, 1].
    pub t: f64,
}

impl Moment {
    /// The first key frame: the only one of a scene at rest.
    pub const START: Self = Self { state: 0, t: 0.0 };
}

/// The value between two key frames at `t` in [0, 1]. Exact at both ends.
#[inline(always)]
#[must_use]
pub fn lerp(from: DVec3, to: DVec3, t: f64) -> DVec3 {
    (1.0 - t) * from + t * to
}

/// The transform between two key frames, entry by entry: every vertex that it places moves linearly.
#[inline]
#[must_use]
pub fn lerp_transform(from: &DAffine3, to: &DAffine3, t: f64) -> DAffine3 {
    let (a, b) = (from.matrix3, to.matrix3);
    DAffine3 {
        matrix3: glam::DMat3::from_cols(
            lerp(a.x_axis, b.x_axis, t),
            lerp(a.y_axis, b.y_axis, t),
            lerp(a.z_axis, b.z_axis, t),
        ),
        translation: lerp(from.translation, to.translation, t),
    }
}

/// The values of the two key frames around a state; those of what rests have one value.
#[inline(always)]
#[must_use]
pub fn around<T>(keys: &[T], state: u32) -> (&T, &T) {
    let last = keys.len() - 1;
    (&keys[last.min(state as usize)], &keys[last.min(state as usize + 1)])
}

/// A node of a [`MovingHierarchy`]: as [`crate::Node`], without its box.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MovingNode {
    /// First child or first item.
    pub first: u32,
    /// Number of items of a leaf, 0 for an inner node.
    pub count: u32,
    /// Number of items below.
    pub items: u32,
}

impl MovingNode {
    /// True for a node that holds items.
    #[must_use]
    pub const fn is_leaf(&self) -> bool {
        self.count > 0
    }
}

/// A hierarchy over things that move.
///
/// Invariants: nodes are numbered and leaves ordered as in [`Hierarchy`]; at each key frame a node's
/// box contains those of its children and items; the box of what is not there is empty.
#[derive(Clone, Debug, Default)]
pub struct MovingHierarchy {
    /// Nodes; empty for no items.
    pub nodes: Vec<MovingNode>,
    /// `node * keys + key`.
    boxes: Vec<Bounds32>,
    keys: usize,
}

impl MovingHierarchy {
    /// Builds over `items` things with a box at each of `keys` key frames; `box_of(item, key)` is
    /// empty where the item is not there. Returns the hierarchy and its order: item `i` of the
    /// hierarchy is item `order[i]`.
    ///
    /// The tree is built over the means of the boxes, as what is close most of the time belongs
    /// together.
    #[must_use]
    pub fn build(
        items: usize,
        keys: usize,
        leaf_items: usize,
        box_of: impl Fn(usize, usize) -> Bounds32,
    ) -> (Self, Vec<u32>) {
        assert!(keys > 0, "there is a key frame");
        let means: Vec<Bounds32> = (0..items).map(|i| mean(keys, |key| box_of(i, key))).collect();
        let (tree, order) = Hierarchy::build(&means, leaf_items);
        drop(means);
        let node = |n: &crate::Node| MovingNode { first: n.first, count: n.count, items: n.count };
        let mut nodes: Vec<MovingNode> = tree.nodes.iter().map(node).collect();
        drop(tree);
        // Children lie behind their parent.
        for n in (0..nodes.len()).rev() {
            if nodes[n].is_leaf() {
                continue;
            }
            let first = nodes[n].first as usize;
            nodes[n].items = nodes[first].items + nodes[first + 1].items;
        }
        let mut boxes = vec![EMPTY; nodes.len() * keys];
        for (n, node) in nodes.iter().enumerate().rev() {
            for key in 0..keys {
                let mut bounds = EMPTY;
                if node.is_leaf() {
                    for item in node.first..node.first + node.count {
                        bounds = bounds.union(&box_of(order[item as usize] as usize, key));
                    }
                } else {
                    for child in [node.first as usize, node.first as usize + 1] {
                        bounds = bounds.union(&boxes[child * keys + key]);
                    }
                }
                boxes[n * keys + key] = bounds;
            }
        }
        (Self { nodes, boxes, keys }, order)
    }

    /// The box of a node at a key frame; empty when nothing is there.
    #[inline(always)]
    #[must_use]
    pub fn at(&self, node: u32, key: u32) -> &Bounds32 {
        &self.boxes[node as usize * self.keys + (self.keys - 1).min(key as usize)]
    }

    /// The boxes of a node around a state; `None` when nothing is there.
    #[inline(always)]
    #[must_use]
    pub fn around(&self, node: u32, state: u32) -> Option<(&Bounds32, &Bounds32)> {
        let (from, to) = (self.at(node, state), self.at(node, state + 1));
        // What is there in a state is there at both of its key frames.
        (from.min[0] <= from.max[0] && to.min[0] <= to.max[0]).then_some((from, to))
    }

    /// The box of a node at a moment; `None` when nothing is there.
    #[inline]
    #[must_use]
    pub fn at_moment(&self, node: u32, moment: Moment) -> Option<Bounds> {
        let (from, to) = self.around(node, moment.state)?;
        let (from, to) = (from.widen(), to.widen());
        Some(Bounds {
            min: lerp(from.min, to.min, moment.t),
            max: lerp(from.max, to.max, moment.t),
        })
    }

    /// The temporal bounding volume of a node for a window of states: it contains all that is below
    /// the node at every moment of them. Empty when nothing is there.
    #[inline]
    #[must_use]
    pub fn swept(&self, node: u32, states: Range<u32>) -> Bounds32 {
        let first = node as usize * self.keys;
        let key = |key: u32| first + (self.keys - 1).min(key as usize);
        let mut bounds = EMPTY;
        for one in &self.boxes[key(states.start)..=key(states.end)] {
            bounds = bounds.union(one);
        }
        bounds
    }

    /// The items whose leaves' volumes for a window of states meet `query`, in order.
    pub fn items_in(&self, states: &Range<u32>, query: Bounds, mut found: impl FnMut(usize)) {
        let mut stack: Vec<u32> = if self.nodes.is_empty() { vec![] } else { vec![0] };
        while let Some(n) = stack.pop() {
            let swept = self.swept(n, states.clone());
            if swept.is_empty() || !swept.widen().intersects(query) {
                continue;
            }
            let node = self.nodes[n as usize];
            if node.is_leaf() {
                (node.first..node.first + node.count).for_each(|item| found(item as usize));
            } else {
                stack.extend([node.first + 1, node.first]);
            }
        }
    }

    /// Panics when an invariant does not hold; `box_of` takes items in the order of the hierarchy.
    pub fn assert_well_formed(&self, items: usize, box_of: impl Fn(usize, usize) -> Bounds32) {
        let contains = |a: &Bounds32, b: &Bounds32| b.is_empty() || a.union(b) == *a;
        let mut next = 0;
        let mut stack = if self.nodes.is_empty() { vec![] } else { vec![0u32] };
        while let Some(n) = stack.pop() {
            let node = self.nodes[n as usize];
            for key in 0..self.keys {
                let own = self.at(n, key as u32);
                if node.is_leaf() {
                    for item in node.first..node.first + node.count {
                        assert!(contains(own, &box_of(item as usize, key)), "leaf {n}, key {key}");
                    }
                } else {
                    assert!(node.first > n, "children lie behind their parent");
                    for child in [node.first, node.first + 1] {
                        assert!(contains(own, self.at(child, key as u32)), "node {n}, key {key}");
                    }
                }
            }
            if node.is_leaf() {
                assert_eq!(node.first as usize, next, "leaves cover the items in order");
                next += node.count as usize;
            } else {
                stack.extend([node.first + 1, node.first]);
            }
        }
        assert_eq!(next, items, "every item is in one leaf");
    }
}

/// The mean of the boxes at the key frames where there are any; a point at the origin elsewhere.
fn mean(keys: usize, box_of: impl Fn(usize) -> Bounds32) -> Bounds32 {
    let (mut min, mut max, mut count) = (DVec3::ZERO, DVec3::ZERO, 0u32);
    for bounds in (0..keys).map(box_of).filter(|b| !b.is_empty()) {
        let wide = bounds.widen();
        (min, max, count) = (min + wide.min, max + wide.max, count + 1);
    }
    let scale = 1.0 / f64::from(count.max(1));
    Bounds32::containing(Bounds { min: min * scale, max: max * scale })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_volume_holds_what_is_below_it_at_every_moment(
            things in prop::collection::vec(
                prop::collection::vec(prop::option::of(prop::array::uniform3(-100.0f32..100.0)), 4),
                1..40,
            ),
            (state, t, size) in (0u32..3, 0.0..=1.0, 0.0f32..5.0),
            (first, states) in (0u32..3, 1u32..4),
        ) {
            let box_of = |i: usize, key: usize| things[i][key].map_or(EMPTY, |p| Bounds32 {
                min: p,
                max: p.map(|v| v + size),
            });
            let (h, order) = MovingHierarchy::build(things.len(), 4, 2, box_of);
            h.assert_well_formed(things.len(), |i, key| box_of(order[i] as usize, key));
            let window = first..(first + states).min(3);
            let inside = |b: &Bounds, p: DVec3| {
                let slack = DVec3::splat(1e-4);
                (b.min - slack).cmple(p).all() && p.cmple(b.max + slack).all()
            };
            for (n, node) in h.nodes.iter().enumerate().filter(|(_, n)| n.is_leaf()) {
                for item in node.first..node.first + node.count {
                    let thing = &things[order[item as usize] as usize];
                    let (Some(a), Some(b)) =
                        (thing[state as usize], thing[state as usize + 1]) else { continue };
                    let wide = |p: [f32; 3]| DVec3::from_array(p.map(f64::from));
                    let p = lerp(wide(a), wide(b), t);
                    let moment = Moment { state, t };
                    prop_assert!(inside(&h.at_moment(n as u32, moment).unwrap(), p));
                    if window.contains(&state) {
                        prop_assert!(inside(&h.swept(n as u32, window.clone()).widen(), p));
                    }
                }
            }
        }
    }

    #[test]
    fn what_rests_has_one_key_frame_for_all_states() {
        let own = Bounds32 { min: [1.0; 3], max: [2.0; 3] };
        let (h, _) = MovingHierarchy::build(1, 1, 4, |_, _| own);
        assert_eq!(h.around(0, 17), Some((&own, &own)));
        assert_eq!(h.swept(0, 3..9), own);
        assert_eq!(around(&[7], 3), (&7, &7));
        assert_eq!(around(&[7, 8, 9], 1), (&8, &9));
    }
}
