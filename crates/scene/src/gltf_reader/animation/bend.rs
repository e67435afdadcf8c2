//! How far things are from moving straight, and where they must be looked at to know.
//!
//! A *mover* is a set of points that move alike: a point is at M(t) (x + sum_k w_k(t) d_k), where M is
//! the transform of a node, x lies in a polytope that is known by its corners, and so does each
//! displacement d_k. Between two key frames a and b at s of the way, the point is drawn at the mean of
//! its places there instead, which is off by
//!
//!   [(1 - s) M(a) + s M(b) - M(t)] x + sum_k [(1 - s) w_k(a) M(a) + s w_k(b) M(b) - w_k(t) M(t)] d_k.
//!
//! Each bracket is an affine map, so its length is a convex function of the point and largest at a
//! corner: corners bound all points between them.
//!
//! Samples: between two consecutive keys of what moves a mover its path has a second derivative of
//! at most r (see [`Jet`]), so the path is within r h^2 / 8 of straight over a time h. Samples that are
//! close enough make that at most a share [`SAMPLED`] of the allowed error. If the mover is off by at
//! most the remaining share at all samples between two key frames, it is off by no more than the
//! allowed error at all times: the path through the samples and the straight one are both straight
//! between samples, and their distance, a convex function, is largest at one.

use glam::{DAffine3, DVec3};
use sightline_geometry::motion::lerp_transform;

use super::{
    rig::Rig,
    sampler::{Jet, Sampler},
};
use crate::{Cause, SceneError};

/// Share of the error that is left to what happens between samples. A quarter takes twice the samples
/// that half would, and spares a fifth of the states.
const SAMPLED: f64 = 0.25;

/// Most samples of all movers together: 8 bytes each, and some microseconds of time.
const SAMPLES_MAX: u64 = 1 << 23;

/// What carries the points of a mover.
#[derive(Clone, Copy, Debug)]
pub enum Part {
    /// A node.
    Node(u32),
    /// A transform into the world.
    Rests(DAffine3),
}

/// A displacement that is weighted.
#[derive(Clone, Debug)]
pub struct Term {
    /// Number of the morph target.
    pub target: usize,
    /// Corners of the box of displacements, in the space of the part.
    pub corners: Vec<DVec3>,
}

/// Points that move alike; see the module.
#[derive(Clone, Debug)]
pub struct Mover {
    pub part: Part,
    /// Corners of the points, in the space of the part.
    pub base: Vec<DVec3>,
    pub terms: Vec<Term>,
    /// Weights of the terms; none where there are no terms.
    pub weights: Option<Sampler>,
    /// How much a map behind this one stretches an error.
    pub stretch: f64,
}

/// A mover at one time.
struct Pose {
    world: DAffine3,
    seconds: f64,
}

/// A mover and the times at which it has to be looked at.
#[derive(Debug)]
pub struct Sampled {
    mover: Mover,
    /// Ascending, from 0 to the end of the animation.
    pub times: Vec<f64>,
}

fn longest(vectors: impl Iterator<Item = DVec3>) -> f64 {
    vectors.map(DVec3::length_squared).fold(0.0, f64::max).sqrt()
}

impl Mover {
    fn pose(&self, rig: &Rig, seconds: f64) -> Pose {
        let world = match self.part {
            Part::Node(node) => rig.world_from_node(node, seconds),
            Part::Rests(world) => world,
        };
        Pose { world, seconds }
    }

    fn weight(&self, term: &Term, seconds: f64) -> f64 {
        self.weights.as_ref().map_or(0.0, |w| w.number(term.target, seconds))
    }

    /// How far a point can be from the straight way between two key frames, metres; NaN where
    /// numbers overflow.
    fn error(&self, rig: &Rig, a: &Pose, b: &Pose, seconds: f64) -> f64 {
        let s = (seconds - a.seconds) / (b.seconds - a.seconds);
        let at = self.pose(rig, seconds);
        let drawn = lerp_transform(&a.world, &b.world, s);
        let off = |c: &DVec3| drawn.transform_point3(*c) - at.world.transform_point3(*c);
        let mut error = longest(self.base.iter().map(off));
        for term in &self.terms {
            let [wa, wb, w] = [a.seconds, b.seconds, seconds].map(|t| self.weight(term, t));
            let map =
                (1.0 - s) * wa * a.world.matrix3 + s * wb * b.world.matrix3 - w * at.world.matrix3;
            error += longest(term.corners.iter().map(|c| map * *c));
        }
        error * self.stretch
    }

    /// A bound of the second derivative of its points between two times without a key between
    /// them, metres a second squared.
    fn bend(&self, rig: &Rig, from: f64, to: f64) -> f64 {
        let world = |jet: Jet, point: bool| match (self.part, point) {
            (Part::Node(node), true) => rig.world_jet(node, jet, from, to),
            (Part::Node(node), false) => rig.world_jet_of_vector(node, jet, from, to),
            (Part::Rests(world), _) => {
                Jet::constant(super::rig::operator_norm(&world.matrix3)).times(jet)
            }
        };
        let base = longest(self.base.iter().copied());
        let mut second = world(Jet::constant(base), true).second;
        if let Some(weights) = &self.weights {
            for term in &self.terms {
                let size = Jet::constant(longest(term.corners.iter().copied()));
                let jet = weights.jet(term.target..term.target + 1, from, to).times(size);
                second += world(jet, false).second;
            }
        }
        second * self.stretch
    }

    /// The times at which it jumps, seconds.
    pub fn jumps(&self, rig: &Rig, times: &mut Vec<f64>) {
        if let Part::Node(node) = self.part {
            rig.jumps(node, times);
        }
        times.extend(self.weights.iter().flat_map(Sampler::jumps));
    }
}

/// Finds the samples of movers over `0..=duration` for an allowed error, metres.
pub fn sample(
    rig: &Rig,
    movers: Vec<Mover>,
    duration: f64,
    error: f64,
) -> Result<Vec<Sampled>, SceneError> {
    let mut left = SAMPLES_MAX;
    let mut out = Vec::with_capacity(movers.len());
    for mover in movers {
        let mut keys = vec![0.0, duration];
        if let Part::Node(node) = mover.part {
            rig.key_times(node, &mut keys);
        }
        keys.extend(mover.weights.iter().flat_map(|w| w.times()));
        keys.retain(|&t| t <= duration);
        keys.sort_unstable_by(f64::total_cmp);
        keys.dedup();
        let mut times = vec![0.0];
        for pair in keys.windows(2) {
            let (from, to) = (pair[0], pair[1]);
            let bend = mover.bend(rig, from, to);
            // r h^2 / 8 <= share * error for parts of the length h.
            let parts = ((to - from) * (bend / (8.0 * SAMPLED * error)).sqrt()).ceil().max(1.0);
            // Also refuses NaN.
            if !(parts <= left as f64) {
                return Err(Cause::TooManySamples { error, limit: SAMPLES_MAX }.into());
            }
            left -= parts as u64;
            times.extend((1..parts as u64).map(|i| from + (to - from) * (i as f64 / parts)));
            times.push(to);
        }
        // Parts shorter than the spacing of numbers fall together.
        times.dedup();
        out.push(Sampled { mover, times });
    }
    Ok(out)
}

impl Sampled {
    /// True when it may be drawn straight between two key frames.
    pub fn is_straight(&self, rig: &Rig, from: f64, to: f64, error: f64) -> bool {
        let first = self.times.partition_point(|&t| t <= from);
        let end = self.times.partition_point(|&t| t < to);
        if first >= end {
            return true;
        }
        let (a, b) = (self.mover.pose(rig, from), self.mover.pose(rig, to));
        let straight = |&t: &f64| self.mover.error(rig, &a, &b, t) <= (1.0 - SAMPLED) * error;
        // What fails does so in the middle, mostly.
        let inside = &self.times[first..end];
        straight(&inside[inside.len() / 2]) && inside.iter().all(straight)
    }
}
