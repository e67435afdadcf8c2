//! Whether there is anything left to find in a tile, where only units are asked for.

use sightline_geometry::{
    InstanceId, InstancedGeometry, PrimitiveId, PrimitiveSet, Run, TopLevel, Units,
};

use super::{Column, Entry, TileContext, TileSolver};
use crate::states::Known;

/// Nodes that are looked at in a tile, at most: far fewer than a solve takes. Where that is not enough,
/// the tile is solved.
const MOST_NODES: u32 = 1 << 12;

/// Units of which no more can be found: in every state, they were seen by two rays or known before.
pub struct Settled {
    primitives: PrimitiveSet,
    /// Whether all that moves is settled.
    movers: bool,
}

impl Settled {
    /// `seen` has the first primitives of units, ascending; `known` what is known in `states`.
    pub fn new(
        geometry: &InstancedGeometry,
        units: &Units,
        seen: &[u32],
        known: Known,
        states: &std::ops::Range<u32>,
    ) -> Self {
        let mut set = PrimitiveSet::default();
        for &first in seen {
            let unit = units.of(geometry, PrimitiveId(first));
            set.push(Run { first: unit.start, end: unit.end });
        }
        // Over several runs, only what is in all of them is known; what is not costs time alone.
        if let Some(known) = known.map(|known| known.within(states.clone()))
            && let [(_, known)] = known.runs()
        {
            set = PrimitiveSet::union([&set, known]);
        }
        let has = |all: std::ops::Range<u32>| holds(&set, all);
        let movers = [&geometry.moving_occluders, &geometry.moving_see_through]
            .into_iter()
            .flat_map(|level| &level.instances)
            .all(|id| has(geometry.primitives_of(*id)))
            && geometry.particles.iter().all(|system| {
                let first = system.first_primitive.0;
                has(first..first + system.len() as u32)
            });
        Self { primitives: set, movers }
    }
}

/// Whether a set has all of a run.
fn holds(set: &PrimitiveSet, run: std::ops::Range<u32>) -> bool {
    set.count_in(run.clone()) == u64::from(run.end - run.start)
}

impl TileSolver {
    /// Whether all that reaches into the beam of rows `w` and columns `c` is settled. When in doubt it
    /// is not.
    pub fn meets_only(
        &mut self,
        settled: &Settled,
        context: &TileContext,
        w: &[f64],
        c: &[Column],
    ) -> bool {
        if !settled.movers {
            return false;
        }
        context.geometry.look();
        self.aim(context, w, c);
        let mut left = MOST_NODES;
        [&context.geometry.occluders, &context.geometry.see_through]
            .into_iter()
            .all(|top| self.walk_settled(settled, context, top, &mut left))
    }

    /// Walks both levels of a hierarchy; true when nothing in the beam is open, and that was found with
    /// `left` nodes.
    fn walk_settled(
        &mut self,
        settled: &Settled,
        context: &TileContext,
        top: &TopLevel,
        left: &mut u32,
    ) -> bool {
        let geometry = context.geometry;
        let Some(face_from_world) = self.enter_world(context, top) else { return true };
        while let Some(Entry { space, node, .. }) = self.stack.pop() {
            let Some(fewer) = left.checked_sub(1) else { return false };
            *left = fewer;
            let instance = self.spaces[space as usize].instance;
            let nodes = self.nodes_of(geometry, top, space);
            let node = nodes[node as usize];
            let items = node.first as usize..(node.first + node.count) as usize;
            if !node.is_leaf() {
                for child in [node.first, node.first + 1] {
                    let entry = self.test(context, space, child, &nodes[child as usize]);
                    self.stack.extend(entry);
                }
            } else if space == 0 {
                let open =
                    |id: &&InstanceId| !holds(&settled.primitives, geometry.primitives_of(**id));
                let ids: Vec<InstanceId> =
                    top.instances[items].iter().filter(open).copied().collect();
                self.enter(context, face_from_world, &ids);
            } else {
                let first = geometry.instances[instance.index()].first_primitive.0;
                let run = first + items.start as u32..first + items.end as u32;
                if !holds(&settled.primitives, run) {
                    return false;
                }
            }
        }
        true
    }
}
