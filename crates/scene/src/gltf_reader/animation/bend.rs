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

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DAffine3, DVec3};
use rayon::prelude::*;
use sightline_geometry::motion::lerp_transform;

use super::{
    rig::Rig,
    sampler::{Jet, Sampler},
};
use crate::{Cause, SceneError};

/// Share of the error that is left to what happens between samples. A quarter takes 1.4 times the
/// samples that a half would, and a fifth fewer states.
const SAMPLED: f64 = 0.25;

/// Most samples of all movers together: 8 bytes each, and some microseconds of time.
const SAMPLES_MAX: u64 = 1 << 23;

/// Most transforms that are kept rather than found again: 200 MB of them.
const KEPT_MAX: usize = 1 << 21;

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

/// Movers, and the times at which they have to be looked at.
#[derive(Debug)]
pub struct Sampled<'a> {
    rig: &'a Rig,
    movers: Vec<Mover>,
    /// A list a mover, ascending, from 0 to the end of the animation.
    samples: Vec<Vec<f64>>,
    /// All samples, ascending.
    times: Vec<f64>,
    /// Nodes that carry movers, without repetition, and a number in it for each mover that has one.
    nodes: Vec<u32>,
    slots: Vec<Option<usize>>,
    /// World from node at all times, `time * nodes + node`; empty where that takes too much.
    kept: Vec<DAffine3>,
    /// The mover that was last too far from straight: it is likely to be so again.
    worst: AtomicUsize,
}

fn longest(vectors: impl Iterator<Item = DVec3>) -> f64 {
    vectors.map(DVec3::length_squared).fold(0.0, f64::max).sqrt()
}

impl Mover {
    fn weight(&self, term: &Term, seconds: f64) -> f64 {
        self.weights.as_ref().map_or(0.0, |w| w.number(term.target, seconds))
    }

    /// How far a point can be from the straight way between two key frames, metres; NaN where
    /// numbers overflow.
    fn error(&self, a: &Pose, b: &Pose, at: &Pose) -> f64 {
        let s = (at.seconds - a.seconds) / (b.seconds - a.seconds);
        let drawn = lerp_transform(&a.world, &b.world, s);
        let off = |c: &DVec3| drawn.transform_point3(*c) - at.world.transform_point3(*c);
        let mut error = longest(self.base.iter().map(off));
        for term in &self.terms {
            let [wa, wb, w] = [a.seconds, b.seconds, at.seconds].map(|t| self.weight(term, t));
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

    /// The times at which it must be looked at, ascending; as many are taken from `left`.
    fn samples(
        &self,
        rig: &Rig,
        duration: f64,
        error: f64,
        left: &mut u64,
    ) -> Result<Vec<f64>, SceneError> {
        let mut keys = vec![0.0, duration];
        if let Part::Node(node) = self.part {
            rig.key_times(node, &mut keys);
        }
        keys.extend(self.weights.iter().flat_map(|w| w.times()));
        keys.retain(|&t| t <= duration);
        sort(&mut keys);
        let mut samples = vec![0.0];
        for pair in keys.windows(2) {
            let (from, to) = (pair[0], pair[1]);
            let bend = self.bend(rig, from, to);
            // r h^2 / 8 <= share * error for parts of the length h. Halves of halves, so that
            // movers share their samples.
            let parts = (to - from) * (bend / (8.0 * SAMPLED * error)).sqrt();
            if parts.is_nan() || parts > *left as f64 {
                return Err(Cause::TooManySamples { error, limit: SAMPLES_MAX }.into());
            }
            let parts = (parts.ceil() as u64).max(1).next_power_of_two();
            *left = left.saturating_sub(parts);
            let share = |i: u64| i as f64 / parts as f64;
            samples.extend((1..parts).map(|i| from + (to - from) * share(i)));
            samples.push(to);
        }
        // Parts shorter than the spacing of numbers fall together.
        samples.dedup();
        Ok(samples)
    }

    /// The times at which it jumps, seconds.
    pub fn jumps(&self, rig: &Rig, times: &mut Vec<f64>) {
        if let Part::Node(node) = self.part {
            rig.jumps(node, times);
        }
        times.extend(self.weights.iter().flat_map(Sampler::jumps));
    }
}

impl<'a> Sampled<'a> {
    /// Finds the samples of movers over `0..=duration` for an allowed error, metres.
    pub fn new(
        rig: &'a Rig,
        movers: Vec<Mover>,
        duration: f64,
        error: f64,
    ) -> Result<Self, SceneError> {
        let mut left = SAMPLES_MAX;
        let mut samples = Vec::with_capacity(movers.len());
        for mover in &movers {
            samples.push(mover.samples(rig, duration, error, &mut left)?);
        }
        let mut times = vec![];
        for samples in &samples {
            times.extend_from_slice(samples);
            // Most movers share most of theirs.
            if times.len() > 4 * TIMES_AT_ONCE {
                sort(&mut times);
            }
        }
        sort(&mut times);
        let carrier = |m: &Mover| if let Part::Node(node) = m.part { Some(node) } else { None };
        let mut nodes: Vec<u32> = movers.iter().filter_map(carrier).collect();
        nodes.sort_unstable();
        nodes.dedup();
        let slots =
            movers.iter().map(|m| nodes.binary_search(&carrier(m)?).ok()).collect::<Vec<_>>();
        let kept = match nodes.len().saturating_mul(times.len()) <= KEPT_MAX {
            true => times.par_iter().flat_map_iter(|&t| rig.world_from_nodes(&nodes, t)).collect(),
            false => vec![],
        };
        let worst = AtomicUsize::new(0);
        Ok(Self { rig, movers, samples, times, nodes, slots, kept, worst })
    }

    /// All samples, ascending.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// True when all movers may be drawn straight between two key frames.
    pub fn are_straight(&self, from: f64, to: f64, error: f64) -> bool {
        let worst = self.worst.load(Ordering::Relaxed);
        // Which one is remembered changes how long this takes, not what it finds.
        self.is_straight(worst, from, to, error)
            && (0..self.movers.len()).into_par_iter().all(|m| {
                let straight = self.is_straight(m, from, to, error);
                if !straight {
                    self.worst.store(m, Ordering::Relaxed);
                }
                straight
            })
    }

    fn is_straight(&self, mover: usize, from: f64, to: f64, error: f64) -> bool {
        let samples = &self.samples[mover];
        let first = samples.partition_point(|&t| t <= from);
        let end = samples.partition_point(|&t| t < to);
        if first >= end {
            return true;
        }
        let (a, b) = (self.pose(mover, from), self.pose(mover, to));
        let straight = |&t: &f64| {
            let off = self.movers[mover].error(&a, &b, &self.pose(mover, t));
            off <= (1.0 - SAMPLED) * error
        };
        // What fails does so in the middle, mostly.
        let inside = &samples[first..end];
        straight(&inside[inside.len() / 2]) && inside.iter().all(straight)
    }

    fn pose(&self, mover: usize, seconds: f64) -> Pose {
        let world = match (self.movers[mover].part, self.slots[mover]) {
            (Part::Rests(world), _) => world,
            (Part::Node(node), slot) => {
                let kept = slot.filter(|_| !self.kept.is_empty()).and_then(|slot| {
                    let time = self.times.binary_search_by(|t| t.total_cmp(&seconds)).ok()?;
                    Some(self.kept[time * self.nodes.len() + slot])
                });
                kept.unwrap_or_else(|| self.rig.world_from_node(node, seconds))
            }
        };
        Pose { world, seconds }
    }
}

/// Times that are gathered before those that are equal are dropped.
pub const TIMES_AT_ONCE: usize = 1 << 20;

/// Puts times in order and drops equal ones.
pub fn sort(times: &mut Vec<f64>) {
    times.sort_unstable_by(f64::total_cmp);
    times.dedup();
}
