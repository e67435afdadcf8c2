//! Binary bounding volume hierarchies as plain nodes that any walk can read.
//!
//! Built top-down: items are binned by their centres, and split where the surface area heuristic
//! costs least. O(n log n) and of logarithmic depth for every input: bottom-up clustering (PLOC)
//! gives slightly worse trees and takes quadratic time where neighbours tie, as in a straight row
//! of equal boxes, a fan of triangles or coincident instances. Single-threaded and without
//! randomness, so the result depends on the input alone.
//!
//! Source: Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (RT 2007).
//!
//! Invariants ([`Hierarchy::assert_well_formed`]):
//! - node 0 is the root; the children of an inner node are `first` and `first + 1`, both
//!   behind their parent;
//! - leaves cover the items `0..n` once each, in order of [`Hierarchy::build`]'s permutation;
//! - a node's box contains the boxes of its children and items.

use bytemuck::{Pod, Zeroable};

use crate::{
    Array, Bounds, Bounds32,
    wide::{WideHierarchy, WideNode},
};

/// One node, 32 bytes. `count == 0`: inner, children `first` and `first + 1`.
/// `count > 0`: leaf over the items `first..first + count`.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Node {
    /// Box of everything below.
    pub bounds: Bounds32,
    /// First child or first item.
    pub first: u32,
    /// Number of items of a leaf, 0 for an inner node.
    pub count: u32,
}

impl Node {
    /// True for a node that holds items.
    #[must_use]
    pub const fn is_leaf(&self) -> bool {
        self.count > 0
    }
}

/// A bounding volume hierarchy over items that were put in its order.
#[derive(Clone, Debug, Default)]
pub struct Hierarchy {
    /// Nodes; empty for no items.
    pub nodes: Array<Node>,
    /// Largest number of nodes on a path from the root to a leaf; a walk's stack needs no more.
    pub depth: usize,
    /// The same with four children a node, for rays.
    pub(crate) wide: WideHierarchy,
}

/// Bins an axis; more make trees hardly better.
const BINS: usize = 16;

/// A leaf holds at most so many triangles: testing a few costs no more than another level.
pub const TRIANGLES_A_LEAF: usize = 4;

/// A leaf holds at most so many instances: to enter one costs more than to test its box.
pub const INSTANCES_A_LEAF: usize = 1;

/// An item on its way into a leaf.
#[derive(Clone, Copy)]
struct Item {
    bounds: Bounds32,
    /// Centre of the box.
    center: [f32; 3],
    number: u32,
}

/// The empty box.
pub(crate) const EMPTY: Bounds32 =
    Bounds32 { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };

fn grow(b: &mut Bounds32, x: &Bounds32) {
    *b = b.union(x);
}

impl Hierarchy {
    /// Builds over finite `boxes`, with at most `leaf_items` in a leaf; returns the hierarchy and its
    /// order: item `i` of the hierarchy is `boxes[order[i]]`.
    #[must_use]
    pub fn build(boxes: &[Bounds32], leaf_items: usize) -> (Self, Vec<u32>) {
        if boxes.is_empty() {
            return (Self::default(), Vec::new());
        }
        let mut items: Vec<Item> = boxes
            .iter()
            .zip(0..)
            .map(|(bounds, number)| {
                let center = [0, 1, 2].map(|k| 0.5 * bounds.min[k] + 0.5 * bounds.max[k]);
                Item { bounds: *bounds, center, number }
            })
            .collect();
        let mut scratch = Vec::with_capacity(items.len());
        // Below this depth items are halved, which adds at most log2(n) levels.
        let deepest_split = 2 * (usize::BITS - boxes.len().leading_zeros()) as usize;

        let unknown = Node { bounds: EMPTY, first: 0, count: 0 };
        let mut nodes = Vec::with_capacity(boxes.len());
        let mut deepest = 0;
        nodes.push(unknown);
        // Depth first, left before right: items come out in the order a walk meets them.
        let mut stack = vec![(0usize, 0..items.len(), 1usize)];
        while let Some((node, range, depth)) = stack.pop() {
            deepest = deepest.max(depth);
            let here = &mut items[range.clone()];
            let mut bounds = EMPTY;
            here.iter().for_each(|item| grow(&mut bounds, &item.bounds));
            if here.len() <= leaf_items {
                let (first, count) = (range.start as u32, range.len() as u32);
                nodes[node] = Node { bounds, first, count };
                continue;
            }
            let split = if depth <= deepest_split { split(here, &mut scratch) } else { None };
            let middle = range.start + split.unwrap_or(here.len() / 2);
            let left = nodes.len();
            nodes.extend([unknown, unknown]);
            nodes[node] = Node { bounds, first: left as u32, count: 0 };
            stack.push((left + 1, middle..range.end, depth + 1));
            stack.push((left, range.start..middle, depth + 1));
        }
        let wide = WideHierarchy::new(&nodes);
        let out = Self { nodes: nodes.into(), depth: deepest, wide };
        (out, items.iter().map(|item| item.number).collect())
    }

    /// A hierarchy of its parts, as [`Hierarchy::wide_nodes`] and its fields gave them.
    #[must_use]
    pub fn of_parts(nodes: Array<Node>, depth: usize, wide: Array<WideNode>) -> Self {
        Self { nodes, depth, wide: WideHierarchy { nodes: wide } }
    }

    /// The nodes that rays walk.
    #[must_use]
    pub fn wide_nodes(&self) -> &Array<WideNode> {
        &self.wide.nodes
    }

    /// Calls `found` with every item whose leaf's box meets `query` (same space), in order.
    pub fn items_in(&self, query: Bounds, mut found: impl FnMut(usize)) {
        let mut stack: Vec<u32> = if self.nodes.is_empty() { vec![] } else { vec![0] };
        while let Some(n) = stack.pop() {
            let node = &self.nodes[n as usize];
            if !node.bounds.widen().intersects(query) {
                continue;
            }
            if node.is_leaf() {
                (node.first..node.first + node.count).for_each(|item| found(item as usize));
            } else {
                stack.extend([node.first + 1, node.first]);
            }
        }
    }

    /// Panics when an invariant of the module does not hold over `boxes`, given in hierarchy order.
    pub fn assert_well_formed(&self, boxes: &[Bounds32]) {
        let contains = |a: &Bounds32, b: &Bounds32| {
            (0..3).all(|k| a.min[k] <= b.min[k] && a.max[k] >= b.max[k])
        };
        let mut next_item = 0;
        let mut stack = if self.nodes.is_empty() { vec![] } else { vec![0usize] };
        while let Some(n) = stack.pop() {
            let node = &self.nodes[n];
            let first = node.first as usize;
            if node.is_leaf() {
                assert_eq!(first, next_item, "leaves cover the items in order");
                next_item += node.count as usize;
                for item in &boxes[first..next_item] {
                    assert!(contains(&node.bounds, item), "leaf {n} contains its items");
                }
            } else {
                assert!(first > n, "children lie behind their parent");
                for child in [first + 1, first] {
                    assert!(contains(&node.bounds, &self.nodes[child].bounds));
                    stack.push(child);
                }
            }
        }
        assert_eq!(next_item, boxes.len(), "every item is in one leaf");
    }
}

/// Partitions items at the cheapest border of bins, keeping their order on both sides; returns
/// the size of the first part, or `None` when all centres coincide.
///
/// The cost of a border is area * items of its two sides: the terms of the surface area heuristic
/// that the choice of a border can change.
fn split(items: &mut [Item], scratch: &mut Vec<Item>) -> Option<usize> {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for item in items.iter() {
        for k in 0..3 {
            low[k] = if item.center[k] < low[k] { item.center[k] } else { low[k] };
            high[k] = if item.center[k] > high[k] { item.center[k] } else { high[k] };
        }
    }
    // Halved before they are subtracted, so that nothing overflows. A scale that does is that of
    // an axis whose centres all but coincide; the cast saturates.
    let scale = [0, 1, 2].map(|k| 0.5 * BINS as f32 / (0.5 * high[k] - 0.5 * low[k]));
    let bin =
        |item: &Item, k: usize| (((item.center[k] - low[k]) * scale[k]) as usize).min(BINS - 1);
    let mut bins = [[(EMPTY, 0u32); BINS]; 3];
    for item in items.iter() {
        for k in 0..3 {
            let (bounds, count) = &mut bins[k][bin(item, k)];
            grow(bounds, &item.bounds);
            *count += 1;
        }
    }
    let mut best: Option<(f64, usize, usize)> = None;
    for (k, bins) in bins.iter().enumerate() {
        let mut right_cost = [0.0; BINS];
        let (mut bounds, mut count) = (EMPTY, 0);
        for border in (1..BINS).rev() {
            grow(&mut bounds, &bins[border].0);
            count += bins[border].1;
            right_cost[border] = bounds.half_area() * f64::from(count);
        }
        let (mut bounds, mut count) = (EMPTY, 0);
        for border in 1..BINS {
            grow(&mut bounds, &bins[border - 1].0);
            count += bins[border - 1].1;
            let cost = bounds.half_area() * f64::from(count) + right_cost[border];
            let splits = count > 0 && (count as usize) < items.len();
            if splits && best.is_none_or(|b| cost < b.0) {
                best = Some((cost, k, border));
            }
        }
    }
    let (_, k, border) = best?;
    scratch.clear();
    let mut left = 0;
    for i in 0..items.len() {
        if bin(&items[i], k) < border {
            items[left] = items[i];
            left += 1;
        } else {
            scratch.push(items[i]);
        }
    }
    items[left..].copy_from_slice(scratch);
    Some(left)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(what: &str, boxes: &[Bounds32]) {
        for leaf_items in [TRIANGLES_A_LEAF, INSTANCES_A_LEAF] {
            let (hierarchy, order) = Hierarchy::build(boxes, leaf_items);
            let ordered: Vec<_> = order.iter().map(|&i| boxes[i as usize]).collect();
            hierarchy.assert_well_formed(&ordered);
            let mut all = order.clone();
            all.sort_unstable();
            assert!(all.into_iter().eq(0..boxes.len() as u32));
            assert!(hierarchy.nodes.iter().all(|node| node.count as usize <= leaf_items));
            assert!(hierarchy.depth <= 64, "{what}: depth {}", hierarchy.depth);
        }
    }

    /// Time is not asserted: were it quadratic, this would run for minutes.
    #[test]
    fn time_and_depth_stay_small_where_boxes_tie_or_nest() {
        let n = 50_000;
        let boxes = |f: &dyn Fn(f32) -> ([f32; 3], [f32; 3])| -> Vec<Bounds32> {
            let make = |i: i32| {
                let (min, max) = f(i as f32);
                Bounds32 { min, max }
            };
            (0..n).map(make).collect()
        };
        check("equal", &boxes(&|_| ([0.0; 3], [1.0; 3])));
        check("points", &boxes(&|_| ([3.0; 3], [3.0; 3])));
        check("row", &boxes(&|i| ([i, 0.0, 0.0], [i + 1.0, 0.0, 1.0])));
        check("line", &boxes(&|i| ([i, 0.0, 0.0], [i + 1.0, 0.0, 0.0])));
        check("nested", &boxes(&|i| ([-i; 3], [i; 3])));
        check("tiny", &boxes(&|i| ([1e-40 * i; 3], [1e-40 * i; 3])));
        check("huge", &boxes(&|i| ([-3e38, i, 0.0], [3e38, i * 1e33, 0.0])));
        check("powers", &boxes(&|i| ([0.0; 3], [2f32.powf(i / 200.0 - 125.0); 3])));
        let fan = |i: f32| {
            let p = |i: f32| [(i / 8000.0).cos(), (i / 8000.0).sin(), 0.0];
            let b = Bounds32::of_points([[0.0; 3], p(i), p(i + 1.0)]);
            (b.min, b.max)
        };
        check("fan", &boxes(&fan));
    }
}
