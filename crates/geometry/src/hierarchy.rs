//! Binary bounding volume hierarchies as plain nodes that any walk can read.
//!
//! Built by `obvhs` (PLOC with reinsertion, single-threaded, so the result depends on the
//! input alone) and copied into a compact layout.
//!
//! Invariants ([`Hierarchy::assert_well_formed`]):
//! - node 0 is the root; the children of an inner node are `first` and `first + 1`, both
//!   behind their parent;
//! - leaves cover the items `0..n` once each, in order of [`Hierarchy::build`]'s permutation;
//! - a node's box contains the boxes of its children and items.

use glam::Vec3A;
use obvhs::{Boundable, BvhBuildParams, aabb::Aabb, bvh2::builder::build_bvh2};

use crate::{Bounds, Bounds32};

/// One node, 32 bytes. `count == 0`: inner, children `first` and `first + 1`.
/// `count > 0`: leaf over the items `first..first + count`.
#[derive(Clone, Copy, Debug, PartialEq)]
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
    pub nodes: Vec<Node>,
    /// Largest number of nodes on a path from the root to a leaf; a walk's stack needs no more.
    pub depth: usize,
}

struct Boxed(Bounds32);

impl Boundable for Boxed {
    fn aabb(&self) -> Aabb {
        Aabb::new(Vec3A::from_array(self.0.min), Vec3A::from_array(self.0.max))
    }
}

impl Hierarchy {
    /// Builds over `boxes`; returns the hierarchy and its order: item `i` of the hierarchy
    /// is `boxes[order[i]]`.
    #[must_use]
    pub fn build(boxes: &[Bounds32]) -> (Self, Vec<u32>) {
        if boxes.is_empty() {
            return (Self::default(), Vec::new());
        }
        let items: Vec<Boxed> = boxes.iter().map(|b| Boxed(*b)).collect();
        let params = BvhBuildParams { max_prims_per_leaf: 4, ..BvhBuildParams::medium_build() };
        let mut unused_timer = std::time::Duration::ZERO;
        let built = build_bvh2(&items, params, &mut unused_timer);

        let mut out = Self { nodes: Vec::with_capacity(built.nodes.len()), depth: 0 };
        let mut order = Vec::with_capacity(boxes.len());
        out.nodes.push(Node { bounds: boxes[0], first: 0, count: 0 });
        // Depth first, left before right: items come out in the order a walk meets them.
        let mut stack = vec![(0usize, 0usize, 1usize)];
        while let Some((from, to, depth)) = stack.pop() {
            let node = &built.nodes[from];
            out.depth = out.depth.max(depth);
            let bounds = Bounds32 { min: node.aabb.min.to_array(), max: node.aabb.max.to_array() };
            let first = node.first_index as usize;
            if node.prim_count > 0 {
                let start = order.len() as u32;
                let items = &built.primitive_indices[first..first + node.prim_count as usize];
                order.extend_from_slice(items);
                out.nodes[to] = Node { bounds, first: start, count: node.prim_count };
            } else {
                let left = out.nodes.len();
                out.nodes.push(Node { bounds, first: 0, count: 0 });
                out.nodes.push(Node { bounds, first: 0, count: 0 });
                out.nodes[to] = Node { bounds, first: left as u32, count: 0 };
                stack.push((first + 1, left + 1, depth + 1));
                stack.push((first, left, depth + 1));
            }
        }
        (out, order)
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
