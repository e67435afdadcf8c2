//! A hierarchy with four children a node, for rays: the four boxes are tested together.
//!
//! Made of a binary [`Hierarchy`](crate::Hierarchy) by pulling grandchildren up, the largest box first; items and
//! their order stay what they are.
//!
//! Source: Dammertz, Hanika, Keller, "Shallow Bounding Volume Hierarchies for Fast SIMD Ray
//! Tracing of Incoherent Rays" (EGSR 2008).
//!
//! Invariants (tested):
//! - the leaves are those of the binary hierarchy, each once;
//! - a child's box is that of the binary node it came from.

use bytemuck::{Pod, Zeroable};

use crate::{Array, Node};

/// Children of a node.
pub(crate) const WIDTH: usize = 4;

/// What a place of a [`WideNode`] refers to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Child {
    /// First item of a leaf, or number of an inner node.
    pub(crate) first: u32,
    /// Items of a leaf, 0 for an inner node.
    pub(crate) count: u32,
}

/// One node, two cache lines.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C, align(64))]
pub struct WideNode {
    /// Least x, y, z, then largest x, y, z, a child each. Places without a child hold a box that
    /// nothing meets.
    pub(crate) bounds: [[f32; WIDTH]; 6],
    /// What is there.
    pub(crate) children: [Child; WIDTH],
}

const _: () = assert!(size_of::<WideNode>() == 128);

impl WideNode {
    const EMPTY: Self = Self {
        bounds: [
            [f32::INFINITY; WIDTH],
            [f32::INFINITY; WIDTH],
            [f32::INFINITY; WIDTH],
            [f32::NEG_INFINITY; WIDTH],
            [f32::NEG_INFINITY; WIDTH],
            [f32::NEG_INFINITY; WIDTH],
        ],
        children: [Child { first: 0, count: 0 }; WIDTH],
    };

    fn set(&mut self, place: usize, node: &Node, child: Child) {
        for k in 0..3 {
            self.bounds[k][place] = node.bounds.min[k];
            self.bounds[3 + k][place] = node.bounds.max[k];
        }
        self.children[place] = child;
    }
}

/// Nodes of a wide hierarchy; node 0 is the root. Empty for no items.
#[derive(Clone, Debug, Default)]
pub(crate) struct WideHierarchy {
    pub(crate) nodes: Array<WideNode>,
}

impl WideHierarchy {
    /// The wide hierarchy over the same items.
    pub(crate) fn new(binary: &[Node]) -> Self {
        let Some(root) = binary.first() else { return Self::default() };
        let mut nodes = vec![WideNode::EMPTY];
        // (binary node, its wide node). The root alone may be a leaf.
        let mut open = Vec::new();
        if root.is_leaf() {
            nodes[0].set(0, root, Child { first: root.first, count: root.count });
        } else {
            open.push((0, 0));
        }
        while let Some((from, to)) = open.pop() {
            let (places, len) = children(binary, from);
            for (place, &number) in places[..len].iter().enumerate() {
                let node = &binary[number as usize];
                let child = if node.is_leaf() {
                    Child { first: node.first, count: node.count }
                } else {
                    let wide = nodes.len() as u32;
                    nodes.push(WideNode::EMPTY);
                    open.push((number, wide as usize));
                    Child { first: wide, count: 0 }
                };
                nodes[to].set(place, node, child);
            }
        }
        nodes.shrink_to_fit();
        Self { nodes: nodes.into() }
    }
}

/// The binary nodes below an inner one that become its children, and how many they are.
fn children(binary: &[Node], from: u32) -> ([u32; WIDTH], usize) {
    let node = |number: u32| &binary[number as usize];
    let first = node(from).first;
    let mut places = [first, first + 1, 0, 0];
    let mut len = 2;
    while len < WIDTH {
        let inner = (0..len).filter(|&k| !node(places[k]).is_leaf());
        let area = |k: usize| node(places[k]).bounds.half_area();
        let Some(largest) = inner.max_by(|&a, &b| area(a).total_cmp(&area(b))) else { break };
        let below = node(places[largest]).first;
        places[largest] = below;
        places[len] = below + 1;
        len += 1;
    }
    (places, len)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Bounds32, Hierarchy, hierarchy::TRIANGLES_A_LEAF};

    /// Item ranges of the leaves below a node, and the boxes of the leaves.
    fn leaves(wide: &WideHierarchy) -> Vec<(u32, u32, [[f32; 3]; 2])> {
        let mut found = vec![];
        for node in wide.nodes.iter() {
            for (place, child) in node.children.iter().enumerate() {
                if child.count > 0 {
                    let corner = |upper: usize| [0, 1, 2].map(|k| node.bounds[upper + k][place]);
                    found.push((child.first, child.count, [corner(0), corner(3)]));
                }
            }
        }
        found.sort_by_key(|leaf| leaf.0);
        found
    }

    #[test]
    fn every_leaf_of_the_binary_hierarchy_is_there_once_with_its_box() {
        for n in [0, 1, 4, 5, 9, 1000] {
            let boxes: Vec<Bounds32> = (0..n)
                .map(|i| {
                    let at = (f64::from(i) * 0.618).fract() as f32;
                    Bounds32 { min: [at, i as f32, -at], max: [at + 1.0, i as f32, at] }
                })
                .collect();
            let (binary, _) = Hierarchy::build(&boxes, TRIANGLES_A_LEAF);
            let of_binary: Vec<_> = binary
                .nodes
                .iter()
                .filter(|node| node.is_leaf())
                .map(|node| (node.first, node.count, [node.bounds.min, node.bounds.max]))
                .collect();
            let mut of_binary = of_binary;
            of_binary.sort_by_key(|leaf| leaf.0);
            let wide = WideHierarchy::new(&binary.nodes);
            assert_eq!(leaves(&wide), of_binary);
            let inner =
                wide.nodes.iter().flat_map(|n| n.children).filter(|c| c.first > 0 && c.count == 0);
            assert_eq!(inner.count(), wide.nodes.len().saturating_sub(1));
        }
    }
}
