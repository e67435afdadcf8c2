//! Times the solves of the segments around a rectangle, and measures the pixel error of each
//! segment's set at viewpoints on that segment.
//!
//! ```sh
//! cargo run --release -p sightline-benches --bin segments -- SCENE --region=-30,50,-10,70 --y 13.7
//! ```
#![allow(clippy::print_stdout)]

use std::time::Instant;

use clap::Parser;
use sightline_benches::region::Place;
use sightline_geometry::{PrimitiveSet, Sampling};
use sightline_quality::measure_viewpoint;
use sightline_scene::{OpenOptions, Scene};
use sightline_solver::{SolveOptions, Statistics, solve_segment_with};

#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    place: Place,
    /// Length of the pieces that the sides are cut into, metres.
    #[arg(long, default_value_t = 10.0)]
    length: f64,
    /// Viewpoints, spread evenly over a segment, at which the error of its set is measured.
    #[arg(long, default_value_t = 0)]
    viewpoints: u32,
    /// Passes of refinement.
    #[arg(long, default_value_t = 0)]
    passes: u32,
    /// A tile is refined when this share of (directions x segment) may be missing in it.
    #[arg(long, default_value_t = 1e-6)]
    threshold: f64,
    /// Take what segments before saw for known.
    #[arg(long)]
    known: bool,
    /// Solve every segment this many times, and take the least time of each.
    #[arg(long, default_value_t = 1)]
    repeat: u32,
    /// Solve every segment with the rays of its pixels in the same place.
    #[arg(long)]
    no_jitter: bool,
    /// Viewpoints, spread evenly over the rectangle, at which the error of the union is measured.
    #[arg(long, default_value_t = 0)]
    inside: u32,
    /// Rays a viewpoint.
    #[arg(long, default_value_t = 100_000)]
    rays: u32,
    /// Rows a face.
    #[arg(long, default_value_t = 104)]
    rows: u32,
    /// Columns a face; as many as rows when absent.
    #[arg(long)]
    columns: Option<u32>,
}

fn main() {
    let arguments = Arguments::parse();
    let scene =
        Scene::open(&arguments.place.scene, &OpenOptions::default()).expect("a readable scene");
    let region = arguments.place.rectangle().expect("a rectangle");
    let segments = region.perimeter(arguments.length);
    let rows = arguments.rows;
    let sampling = Sampling::with_columns(rows, arguments.columns.unwrap_or(rows));
    let (mut seconds, mut missing) = (0.0, 0.0);
    let mut total = Statistics::default();
    let mut sets = Vec::new();
    let mut known = PrimitiveSet::default();
    for segment in &segments {
        let sampling = if arguments.no_jitter { sampling } else { sampling.jittered(segment.id.0) };
        let mut least = f64::INFINITY;
        let mut found = None;
        for _ in 0..arguments.repeat.max(1) {
            let began = Instant::now();
            let options = SolveOptions {
                passes: arguments.passes,
                threshold: arguments.threshold,
                known: arguments.known.then_some(&known),
                ..SolveOptions::default()
            };
            found = Some(solve_segment_with(&scene.geometry, segment, sampling, &options));
            least = least.min(began.elapsed().as_secs_f64());
        }
        seconds += least;
        let found = found.expect("solved at least once");
        total = total.plus(found.statistics);
        missing += found.missing;
        if arguments.known {
            known = PrimitiveSet::union([&known, &found.set]);
        }
        sets.push(found.set);
    }
    println!("estimated missing: {:.5} % a segment", 100.0 * missing / segments.len() as f64);
    let n = segments.len() as f64;
    let all = PrimitiveSet::union(&sets);
    println!(
        "segments {n}, {:.2} ms each, {} of {} visible",
        1e3 * seconds / n,
        all.len(),
        scene.geometry.primitive_count()
    );
    println!("in all: {total:?}");
    if arguments.inside > 0 {
        let (mut sum, mut worst) = (0.0, 0.0f64);
        for (k, at) in (0..).zip(region.viewpoints(arguments.inside)) {
            let e = measure_viewpoint(&scene.geometry, &all, at, arguments.rays, k);
            sum += e.error;
            worst = worst.max(e.error);
        }
        let mean = sum / f64::from(arguments.inside);
        println!("inside: mean {:.5} %, worst {:.5} %", 100.0 * mean, 100.0 * worst);
    }
    if arguments.viewpoints > 0 {
        let (mut sum, mut worst) = (0.0, 0.0f64);
        for (segment, set) in segments.iter().zip(&sets) {
            for k in 0..arguments.viewpoints {
                // Fractions of the golden ratio spread evenly.
                let t = (f64::from(k + 1) * 0.618_033_988_749_895).fract();
                let at = segment.v0.lerp(segment.v1, t);
                let error =
                    measure_viewpoint(&scene.geometry, set, at, arguments.rays, u64::from(k));
                sum += error.error;
                worst = worst.max(error.error);
            }
        }
        let mean = sum / (n * f64::from(arguments.viewpoints));
        println!("pixel error: mean {:.5} %, worst {:.5} %", 100.0 * mean, 100.0 * worst);
    }
}
