//! Guided visibility sampling: random rays find triangles, mutated rays find their neighbours.
//!
//! Reference: Wonka, Wimmer, Zhou, Maierhofer, Hesina, Reshetov, "Guided Visibility Sampling"
//! (SIGGRAPH 2006).
//!
//! - *Random sampling*: rays from random points of the view cell in random directions.
//! - *Adaptive border sampling*: a triangle that a ray finds for the first time is enlarged a
//!   little, and rays from the same point go to nine points of its border. Where two that follow
//!   each other along an edge hit different triangles, one goes between them, and so on.
//! - *Reverse sampling*: where such a ray ends far before the border, at an occluder, the point
//!   of the border is looked at from elsewhere in the view cell: along the line that just passes
//!   the occluder, in the plane of the old ray and the found triangle.
//!
//! What new rays hit for the first time is sampled in turn, until nothing is left and random
//! sampling goes on. An *iteration* is 10 M rays; the method ends after three in a row that find
//! fewer than 10 triangles each.
//!
//! What makes it strong:
//! - random rays are stratified, each with a viewpoint of its own (`from_point`), and traced in the
//!   order of a curve;
//! - triangles wait in a queue and are taken in rounds, which all threads share; new triangles
//!   are entered between rounds, in order, so the result is the same on every run;
//! - the border is moved at right angles to line of sight and edge, so that the enlarged triangle
//!   shows a rim even when it is seen edge on;
//! - edges are not divided more finely than the border stands out, which spares most rays;
//! - reverse sampling tries both sides of the occluder;
//! - each kind of ray has the tracer that was measured fastest for its kind.
//!
//! The view cell is the rectangle as a box of small height, as the paper's cells are boxes.
//!
//! Parameters ([`Parameters`]): the published defaults.

use std::collections::VecDeque;

use glam::DVec3;
use rayon::prelude::*;
use sightline_geometry::{Bounds, InstancedGeometry, PrimitiveId, PrimitiveSet};

use super::from_point::{Batches, Viewpoints};
use crate::curve::Progressive;
use crate::found::Found;
use crate::region::Region;
use crate::tracers::{LocalHit, LocalRay, MISS, Tracer};

/// The method's parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameters {
    /// Rays of an iteration.
    pub iteration_rays: u64,
    /// An iteration that finds fewer triangles is idle.
    pub idle_below: u64,
    /// Idle iterations in a row after which it ends.
    pub idle_iterations: u32,
    /// By how much a triangle is enlarged, metres.
    pub border: f64,
    /// Most rays to an edge.
    pub edge_samples: usize,
    /// Height of the view cell, metres.
    pub height: f64,
}

impl Default for Parameters {
    fn default() -> Self {
        Self {
            iteration_rays: 10_000_000,
            idle_below: 10,
            idle_iterations: 3,
            border: 0.001,
            edge_samples: 40,
            height: 0.02,
        }
    }
}

/// Least angle by which a border stands out: some units in the last place of an `f32` direction.
const ANGLE_MIN: f64 = 1e-6;

/// A ray that ends this share before the border has hit an occluder. The paper asks for "a large
/// depth discontinuity"; small ones cost rays and find as much.
const DISCONTINUITY: f64 = 0.01;

/// Triangles of a round, and of a piece of work of it.
const ROUND: usize = 4096;
const PIECE: usize = 64;

/// A triangle that was found, and from where.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Sample {
    /// World space.
    origin: DVec3,
    /// Where the ray met the triangle.
    point: DVec3,
    primitive: u32,
}

/// A ray towards a point of a border.
#[derive(Clone, Copy, Debug)]
struct Probe {
    target: DVec3,
    hit: LocalHit,
}

/// The method in progress.
pub struct Guided<'a> {
    geometry: &'a InstancedGeometry,
    random_tracer: &'a dyn Tracer,
    border_tracer: &'a dyn Tracer,
    parameters: Parameters,
    cell: Bounds,
    random: Batches,
    batches: u64,
    queue: VecDeque<Sample>,
    found: Found,
    /// Rays of each kind: random, border, reverse.
    rays: [u64; 3],
    /// Rays and finds of this iteration, and idle iterations before it.
    iteration: (u64, u64),
    idle: u32,
}

/// Scratch memory of a thread.
#[derive(Default)]
struct Scratch {
    rays: Vec<LocalRay>,
    hits: Vec<LocalHit>,
    probes: Vec<Probe>,
    reverse: Vec<(DVec3, DVec3)>,
}

/// What a piece of work brings: triangles that are not known yet, and rays of the three kinds.
type Finds = (Vec<Sample>, [u64; 3]);

impl<'a> Guided<'a> {
    /// Nothing found yet. `random_tracer` is for rays from anywhere, `border_tracer` for bundles
    /// from one point.
    #[must_use]
    pub fn new(
        geometry: &'a InstancedGeometry,
        [random_tracer, border_tracer]: [&'a dyn Tracer; 2],
        region: Region,
        parameters: Parameters,
    ) -> Self {
        let half = DVec3::Y * (0.5 * parameters.height);
        Self {
            geometry,
            random_tracer,
            border_tracer,
            parameters,
            cell: Bounds { min: region.at(0.0, 0.0) - half, max: region.at(1.0, 1.0) + half },
            random: Batches::new(Viewpoints::Inside(region, 1)),
            batches: 0,
            queue: VecDeque::new(),
            found: Found::new(geometry.primitive_count()),
            rays: [0; 3],
            iteration: (0, 0),
            idle: 0,
        }
    }

    /// Enters what rays have found, in order.
    fn enter(&mut self, finds: Vec<Finds>) {
        for (samples, rays) in finds {
            for sample in samples {
                if self.found.insert(sample.primitive) {
                    self.queue.push_back(sample);
                    self.iteration.1 += 1;
                }
            }
            for (sum, rays) in self.rays.iter_mut().zip(rays) {
                *sum += rays;
                self.iteration.0 += rays;
            }
        }
        if self.iteration.0 >= self.parameters.iteration_rays {
            let is_idle = self.iteration.1 < self.parameters.idle_below;
            self.idle = if is_idle { self.idle + 1 } else { 0 };
            self.iteration = (0, 0);
        }
    }

    /// A batch of random rays.
    fn random_finds(&self) -> Vec<Finds> {
        let origin = self.random_tracer.origin();
        (0..Batches::PIECES)
            .into_par_iter()
            .map_init(Scratch::default, |scratch, piece| {
                let Scratch { rays, hits, .. } = scratch;
                self.random.piece(self.batches, piece, origin, rays);
                self.random_tracer.closest(rays, hits);
                let new = rays.iter().zip(hits.iter()).filter_map(|(ray, hit)| {
                    self.sample(origin + ray.origin.as_dvec3(), ray.direction.as_dvec3(), *hit)
                });
                (new.collect(), [rays.len() as u64, 0, 0])
            })
            .collect()
    }

    /// What a hit adds, if it is new.
    fn sample(&self, origin: DVec3, direction: DVec3, hit: LocalHit) -> Option<Sample> {
        let is_new = hit.primitive != MISS && !self.found.contains(hit.primitive);
        is_new.then(|| Sample {
            origin,
            point: origin + f64::from(hit.distance) * direction,
            primitive: hit.primitive,
        })
    }

    /// Samples the borders of a round of triangles.
    fn border_finds(&mut self) -> Vec<Finds> {
        let round: Vec<Sample> = self.queue.drain(..self.queue.len().min(ROUND)).collect();
        let this = &*self;
        round
            .par_chunks(PIECE)
            .map_init(Scratch::default, |scratch, samples| {
                let mut finds = (Vec::new(), [0; 3]);
                for sample in samples {
                    this.sample_border(sample, scratch, &mut finds);
                }
                finds
            })
            .collect()
    }

    /// Traces rays from `origin` to `targets`; new triangles go to `finds`, `probed` sees all.
    fn probe(
        &self,
        origin: DVec3,
        targets: &[DVec3],
        scratch: (&mut Vec<LocalRay>, &mut Vec<LocalHit>),
        finds: &mut Finds,
        mut probed: impl FnMut(usize, Probe),
    ) {
        let (rays, hits) = scratch;
        rays.clear();
        let local = (origin - self.border_tracer.origin()).as_vec3();
        rays.extend(targets.iter().map(|target| LocalRay {
            origin: local,
            direction: (*target - origin).normalize().as_vec3(),
        }));
        self.border_tracer.closest(rays, hits);
        for (k, (ray, hit)) in rays.iter().zip(hits.iter()).enumerate() {
            finds.0.extend(self.sample(origin, ray.direction.as_dvec3(), *hit));
            probed(k, Probe { target: targets[k], hit: *hit });
        }
    }

    /// By how much a border stands out at a point seen from `origin`.
    fn amount(&self, origin: DVec3, point: DVec3) -> f64 {
        self.parameters.border.max(ANGLE_MIN * (point - origin).length())
    }

    /// Adaptive border sampling of one triangle, and reverse sampling behind what is in the way.
    fn sample_border(&self, sample: &Sample, scratch: &mut Scratch, finds: &mut Finds) {
        let corners = self.geometry.triangle(PrimitiveId(sample.primitive)).corners;
        let Some(border) = border(sample.origin, corners, self.parameters.border) else { return };
        let Scratch { rays, hits, probes, reverse } = scratch;
        reverse.clear();
        let origin = sample.origin;
        let mut first = [Probe { target: DVec3::ZERO, hit: LocalHit::MISS }; 9];
        self.probe(origin, &border, (rays, hits), finds, |k, probe| first[k] = probe);
        finds.1[1] += 9;
        first.iter().for_each(|p| self.look_behind(sample, p, reverse));
        // Points 3 e and 3 e + 1 are the ends of edge e; 3 e + 2 is the corner behind it.
        for edge in 0..3 {
            probes.clear();
            probes.extend([first[3 * edge], first[3 * edge + 1]]);
            let mut left = self.parameters.edge_samples.saturating_sub(2);
            loop {
                let differ = |p: &[Probe]| {
                    p[0].hit.primitive != p[1].hit.primitive
                        && (p[0].target - p[1].target).length() > self.amount(origin, p[0].target)
                };
                let targets: Vec<DVec3> = probes
                    .windows(2)
                    .filter(|p| differ(p))
                    .map(|p| 0.5 * (p[0].target + p[1].target))
                    .take(left)
                    .collect();
                if targets.is_empty() {
                    break;
                }
                left -= targets.len();
                finds.1[1] += targets.len() as u64;
                let mut between = Vec::with_capacity(targets.len());
                self.probe(origin, &targets, (rays, hits), finds, |_, probe| between.push(probe));
                between.iter().for_each(|p| self.look_behind(sample, p, reverse));
                let mut between = between.into_iter();
                let old = std::mem::take(probes);
                for (k, probe) in old.iter().enumerate() {
                    probes.push(*probe);
                    if old.get(k + 1).is_some_and(|next| differ(&[*probe, *next])) {
                        probes.extend(between.next());
                    }
                }
            }
        }
        finds.1[2] += reverse.len() as u64;
        for &(from, target) in reverse.iter() {
            self.probe(from, &[target], (rays, hits), finds, |_, _| {});
        }
    }

    /// Reverse sampling: rays to the probe's target that pass by the occluder in the way.
    fn look_behind(&self, sample: &Sample, probe: &Probe, reverse: &mut Vec<(DVec3, DVec3)>) {
        let Sample { origin, point, .. } = *sample;
        let far = (probe.target - origin).length();
        if probe.hit.primitive == MISS
            || f64::from(probe.hit.distance) > (1.0 - DISCONTINUITY) * far
        {
            return;
        }
        let normal = (probe.target - origin).cross(point - origin);
        let corners = self.geometry.triangle(PrimitiveId(probe.hit.primitive)).corners;
        let at = origin + f64::from(probe.hit.distance) * (probe.target - origin) / far;
        for k in 0..3 {
            let (a, b) = (corners[k], corners[(k + 1) % 3]);
            let (da, db) = (normal.dot(a - origin), normal.dot(b - origin));
            if (da < 0.0) == (db < 0.0) {
                continue;
            }
            // Where the plane of the rays cuts the occluder's edge, moved off it.
            let cut = a.lerp(b, da / (da - db));
            let past = cut + self.parameters.border * (cut - at).normalize_or_zero();
            if let Some(from) = entry(&self.cell, probe.target, past) {
                reverse.push((from, probe.target));
            }
        }
    }
}

/// The nine points of the border of a triangle enlarged by `by`, seen from `origin`: for each edge
/// its ends, moved away from the triangle at right angles to edge and line of sight, and the corner
/// behind it. `None` for triangles too thin or too near to tell.
fn border(origin: DVec3, corners: [DVec3; 3], by: f64) -> Option<[DVec3; 9]> {
    let middle = (corners[0] + corners[1] + corners[2]) / 3.0;
    let mut out = [DVec3::ZERO; 9];
    let mut away = [DVec3::ZERO; 3];
    for edge in 0..3 {
        let (a, b) = (corners[edge], corners[(edge + 1) % 3]);
        let half = 0.5 * (a + b);
        let side = (b - a).cross(half - origin).try_normalize()?;
        away[edge] = if side.dot(half - middle) < 0.0 { -side } else { side };
    }
    let amount = |p: DVec3| by.max(ANGLE_MIN * (p - origin).length());
    for edge in 0..3 {
        let (a, b) = (corners[edge], corners[(edge + 1) % 3]);
        out[3 * edge] = a + amount(a) * away[edge];
        out[3 * edge + 1] = b + amount(b) * away[edge];
        let both = away[edge] + away[(edge + 1) % 3];
        // Seen edge on, the two sides lie opposite: the corner goes out along the edge.
        let tip = both.try_normalize().or_else(|| (b - middle).try_normalize())?;
        out[3 * edge + 2] = b + amount(b) * tip;
    }
    let is_usable = |p: &DVec3| p.is_finite() && (*p - origin).length_squared() > 0.0;
    out.iter().all(is_usable).then_some(out)
}

/// Where the half-line from `target` through `past` is in the middle of the cell, if it meets it.
fn entry(cell: &Bounds, target: DVec3, past: DVec3) -> Option<DVec3> {
    let direction = past - target;
    let inverse = direction.recip();
    let (a, b) = ((cell.min - target) * inverse, (cell.max - target) * inverse);
    let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
    // The occluder, at 1, stands between target and cell.
    let near = near.max(1.0);
    let from = target + 0.5 * (near + far) * direction;
    (near <= far && from.is_finite()).then_some(from)
}

impl Progressive for Guided<'_> {
    fn step(&mut self) -> bool {
        let finds = if self.queue.is_empty() {
            let finds = self.random_finds();
            self.batches += 1;
            finds
        } else {
            self.border_finds()
        };
        self.enter(finds);
        self.idle < self.parameters.idle_iterations
    }

    fn found(&self) -> PrimitiveSet {
        self.found.set()
    }

    fn label(&self) -> String {
        let [random, border, reverse] = self.rays.map(|r| r as f64 / 1e6);
        format!("{random:.1} + {border:.1} + {reverse:.1} M rays")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rivals::tests::{random_triangles, scene_of};
    use crate::tracers::wide::Wide;

    fn region() -> Region {
        Region::new([-0.5, -0.5, 0.5, 0.5], 0.0).unwrap()
    }

    fn quick() -> Parameters {
        Parameters { iteration_rays: 150_000, ..Parameters::default() }
    }

    fn run(geometry: &InstancedGeometry, parameters: Parameters) -> (PrimitiveSet, [u64; 3]) {
        let tracer = Wide::new(geometry, DVec3::ZERO);
        let mut method = Guided::new(geometry, [&tracer, &tracer], region(), parameters);
        while method.step() {}
        (method.found(), method.rays)
    }

    /// A box around the origin whose six faces are grids of 2 x n x n triangles.
    fn room(n: u32) -> InstancedGeometry {
        let mut corners = Vec::new();
        for axis in 0..3 {
            for side in [-1.0f32, 1.0] {
                let at = |i: u32, j: u32| {
                    let f = |k: u32| 2.0 * k as f32 / n as f32 - 1.0;
                    let mut p = [0.0; 3];
                    p[axis] = side * 3.0;
                    p[(axis + 1) % 3] = 3.0 * f(i);
                    p[(axis + 2) % 3] = 3.0 * f(j);
                    p
                };
                for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
                    corners.extend([at(i, j), at(i + 1, j), at(i, j + 1)]);
                    corners.extend([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
        scene_of(&corners)
    }

    #[test]
    fn all_faces_of_a_room_are_found() {
        let room = room(20);
        let (found, _) = run(&room, quick());
        assert_eq!(found.len(), 4800);
    }

    #[test]
    fn borders_lead_from_one_triangle_to_all_of_a_fine_wall() {
        // More triangles than one batch has random rays: guided ones find the rest.
        let room = room(80);
        let tracer = Wide::new(&room, DVec3::ZERO);
        let mut method = Guided::new(&room, [&tracer, &tracer], region(), quick());
        method.step();
        let by_chance = method.found.len();
        while !method.queue.is_empty() {
            method.step();
        }
        let all = u64::from(room.primitive_count());
        assert!(by_chance * 10 < 7 * all, "{by_chance}");
        let missing = all - method.found.len();
        assert!(missing * 1000 < all, "{missing}");
    }

    #[test]
    fn reverse_sampling_looks_behind_an_occluder() {
        let tri = |x: f32, s: f32| [[x, -s, -s], [x, s, -s], [x, 0.0, s]];
        let scene = scene_of(&[tri(2.0, 0.2), tri(6.0, 3.0)].concat());
        let tracer = Wide::new(&scene, DVec3::ZERO);
        let method = Guided::new(&scene, [&tracer, &tracer], region(), quick());
        let is_near = |p: u32| scene.triangle(PrimitiveId(p)).corners[0].x < 3.0;
        let (near, far) = if is_near(0) { (0, 1) } else { (1, 0) };
        let point = DVec3::new(6.0, 0.01, -2.0);
        let sample = Sample { origin: DVec3::ZERO, point, primitive: far };
        let target = DVec3::new(6.0, 0.01, 0.02);
        let hit = LocalHit { primitive: near, distance: 2.0 };
        let mut reverse = Vec::new();
        method.look_behind(&sample, &Probe { target, hit }, &mut reverse);
        for (from, target) in &reverse {
            assert!(from.x.abs() <= 0.5 && from.z.abs() <= 0.5 && from.y.abs() <= 0.011);
            let mut hits = Vec::new();
            tracer.closest(&[tracer.local(*from, (*target - *from).normalize())], &mut hits);
            assert_eq!(hits[0].primitive, far, "from {from}");
        }
        assert!(!reverse.is_empty());
        // A ray that reaches the border's depth has nothing to look behind.
        reverse.clear();
        let reached = Probe { target, hit: LocalHit { primitive: near, distance: 5.99 } };
        method.look_behind(&sample, &reached, &mut reverse);
        assert!(reverse.is_empty());
    }

    #[test]
    fn it_ends_and_does_not_depend_on_threads() {
        let scene = random_triangles(600, 2);
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| run(&scene, quick()))
        };
        let (set, rays) = run(1);
        assert!(rays.iter().all(|&r| r > 0), "{rays:?}");
        assert_eq!((set, rays), run(2));
    }
}
