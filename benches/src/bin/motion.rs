//! Times the solves of the segments around a rectangle of a scene that moves, state by state, and
//! measures the pixel error of the sets at random viewpoints inside and random times.
//!
//! ```sh
//! sightline generate bouncing-spheres --count 10000 --states 25 -o spheres.parquet
//! cargo run --release -p sightline-benches --bin motion -- spheres.parquet --region=-10,-10,10,10 --y 1.7
//! ```
#![allow(clippy::print_stdout)]

use std::time::Instant;

use clap::Parser;
use glam::{DQuat, DVec3};
use rayon::prelude::*;
use sightline_benches::region::{Place, Region};
use sightline_geometry::raycast::{Ray, RayCaster};
use sightline_geometry::{InstancedGeometry, Moment, PrimitiveSet, Sampling, StateSets};
use sightline_scene::{OpenOptions, Scene};
use sightline_solver::{SolveOptions, Statistics, TimePath, solve_states};

#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    place: Place,
    /// Length of the pieces that the sides are cut into, metres.
    #[arg(long, default_value_t = 10.0)]
    length: f64,
    /// Rows and columns a face.
    #[arg(long, default_value_t = 24)]
    rows: u32,
    /// Passes of refinement.
    #[arg(long, default_value_t = 2)]
    passes: u32,
    /// A tile is refined when this share of (directions x segment) may be missing in it.
    #[arg(long, default_value_t = 2e-6)]
    threshold: f64,
    /// Runs along the perimeter: forward, reversed, and with the clock stopped here and there.
    #[arg(long, default_value_t = 1)]
    runs: u32,
    /// States to solve; all when absent.
    #[arg(long)]
    states: Option<u32>,
    /// Do without temporal bounding volumes.
    #[arg(long)]
    without_volumes: bool,
    /// Stop the clock: what moves stands still where it is at this t of its state.
    #[arg(long)]
    stopped: Option<f64>,
    /// Random viewpoints, each at a random time, at which the error is measured.
    #[arg(long, default_value_t = 64)]
    viewpoints: u32,
    /// Rays a viewpoint.
    #[arg(long, default_value_t = 16_384)]
    rays: u32,
}

/// How camera and time are coupled in a run.
fn path(run: u32) -> TimePath {
    match run {
        0 => TimePath::FORWARD,
        1 => TimePath::REVERSED,
        // Spread evenly.
        k => TimePath::stopped((0.5 + f64::from(k - 2) * 0.618_033_988_749_895).fract()),
    }
}

fn main() {
    let arguments = Arguments::parse();
    let began = Instant::now();
    let scene =
        Scene::open(&arguments.place.scene, &OpenOptions::default()).expect("a readable scene");
    let geometry = &scene.geometry;
    let region = arguments.place.rectangle().expect("a rectangle");
    let states = arguments.states.unwrap_or(geometry.states).min(geometry.states);
    println!(
        "{} primitives, {} states, opened in {:.2} s",
        geometry.primitive_count(),
        geometry.states,
        began.elapsed().as_secs_f64()
    );
    let segments = region.perimeter(arguments.length);
    let sampling = Sampling::new(arguments.rows);
    let options = SolveOptions {
        passes: arguments.passes,
        threshold: arguments.threshold,
        without_volumes: arguments.without_volumes,
        ..SolveOptions::default()
    };
    let began = Instant::now();
    let mut total = Statistics::default();
    let mut all: Option<StateSets> = None;
    for run in 0..arguments.runs.max(1) {
        for segment in &segments {
            let sampling = sampling.jittered(segment.id.0 + run * segments.len() as u32);
            let path = arguments.stopped.map_or_else(|| path(run), TimePath::stopped);
            let found =
                solve_states(geometry, segment, sampling, 0..states, path, all.as_ref(), &options);
            total = total.plus(found[0].visibility.statistics);
            let found =
                StateSets::from_runs(found.into_iter().map(|f| (f.states, f.visibility.set)));
            all = Some(match all {
                None => found,
                Some(before) => StateSets::join([&before, &found]),
            });
        }
    }
    let seconds = began.elapsed().as_secs_f64();
    let all = all.expect("a rectangle has sides");
    println!(
        "{} segments x {states} states, {} runs: {seconds:.2} s, {:.3} s a state; {total:?}",
        segments.len(),
        arguments.runs,
        seconds / f64::from(states)
    );
    let mean: u64 = (0..states).map(|s| all.at(s).len()).sum::<u64>() / u64::from(states);
    println!("visible: {mean} a state, {} in all", all.union().len());
    let (mean, worst) = error(geometry, &all, &region, &arguments);
    println!("error: mean {:.5} %, worst {:.5} %", 100.0 * mean, 100.0 * worst);
}

/// Mean and largest pixel error over viewpoints in the rectangle, each at a time of its own.
fn error(
    geometry: &InstancedGeometry,
    all: &StateSets,
    region: &Region,
    arguments: &Arguments,
) -> (f64, f64) {
    let states = all.states().end;
    let errors: Vec<f64> = region
        .viewpoints(arguments.viewpoints)
        .into_par_iter()
        .enumerate()
        .map(|(k, viewpoint)| {
            let time = (0.5 + k as f64 * 0.754_877_666_246_693).fract() * f64::from(states);
            let moment = Moment { state: time as u32, t: time.fract() };
            let set: &PrimitiveSet = all.at(moment.state);
            let mut caster = RayCaster::new();
            let turn = DQuat::from_axis_angle(DVec3::new(0.48, 0.6, 0.64), k as f64);
            let wrong = (0..arguments.rays)
                .filter(|&i| {
                    // Source: Fibonacci lattice.
                    let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(arguments.rays);
                    let angle = f64::from(i) * 2.399_963_229_728_653;
                    let r = (1.0 - z * z).sqrt();
                    let direction = turn * DVec3::new(r * angle.cos(), z, r * angle.sin());
                    let ray = Ray { origin: viewpoint, direction, moment };
                    let hit = caster.closest_occluder(geometry, ray, f64::INFINITY, |_| true);
                    hit.is_some_and(|hit| !set.contains(hit.primitive))
                })
                .count();
            wrong as f64 / f64::from(arguments.rays)
        })
        .collect();
    let mean = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    (mean, errors.into_iter().fold(0.0, f64::max))
}
