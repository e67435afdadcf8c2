//! Compares from-segment visibility with its rivals: the harness behind docs/benchmarks.md.
//!
//! ```sh
//! cargo run --release -p sightline-benches --features embree --bin compare -- \
//!     --scene city=city.glb,-5,-30,5,0,1.7,10 --out out/compare
//! ```
#![allow(clippy::print_stdout, clippy::print_stderr)]

use std::path::PathBuf;
use std::process::ExitCode;
use std::str::FromStr;
use std::time::Instant;

use clap::Parser;
use glam::DVec3;
use rayon::prelude::*;
use sightline_benches::clock::{Clock, fastest};
use sightline_benches::curve::{Curve, Judge};
use sightline_benches::directions::{sphere, stream};
use sightline_benches::plot::{self, Axis};
use sightline_benches::region::Region;
use sightline_benches::report::{SceneReport, TracerSpeed, claims, section};
use sightline_benches::rivals::from_point::{Batches, FromPoint, Viewpoints};
use sightline_benches::rivals::{algorithm_one, guided};
use sightline_benches::tracers::{self, LocalRay, Tracer, Tracers};
use sightline_benches::truth::Truth;
use sightline_benches::{from_segment, single_segment};
use sightline_geometry::InstancedGeometry;
use sightline_scene::{OpenOptions, Scene};

/// A scene and the place in it.
#[derive(Clone, Debug)]
struct Place {
    name: String,
    path: PathBuf,
    region: Region,
    length: f64,
}

impl FromStr for Place {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let form = "it has the form NAME=PATH,X0,Z0,X1,Z1,Y,LENGTH";
        let (name, rest) = text.split_once('=').ok_or(form)?;
        let mut parts = rest.rsplitn(7, ',');
        let mut numbers = [0.0f64; 6];
        for number in numbers.iter_mut().rev() {
            let part = parts.next().ok_or(form)?;
            *number = part.trim().parse().map_err(|_| format!("`{part}` is no number; {form}"))?;
        }
        let [x0, z0, x1, z1, y, length] = numbers;
        let path = PathBuf::from(parts.next().ok_or(form)?);
        let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if name.is_empty() || !name.chars().all(is_plain) {
            return Err(format!("`{name}` becomes a file name: letters, digits, - and _ only"));
        }
        if length.is_nan() || length <= 0.0 {
            return Err(format!("a segment's length is more than 0 m, not {length}"));
        }
        Ok(Self { name: name.into(), path, region: Region::new([x0, z0, x1, z1], y)?, length })
    }
}

/// A method of the comparison.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Method {
    /// Algorithm 1 of the source as published.
    AlgorithmOne,
    /// From-point sampling, uniform along the perimeter.
    Perimeter,
    /// From-point sampling, random in the rectangle.
    Inside,
    /// Guided visibility sampling.
    Guided,
    /// The comparison on one segment.
    SingleSegment,
}

/// Compares from-segment visibility with Algorithm 1 as published, from-point sampling and guided
/// visibility sampling, on the same scenes in one run.
#[derive(Parser)]
struct Arguments {
    /// A scene and the rectangle in it: NAME=PATH,X0,Z0,X1,Z1,Y,LENGTH. Metres; the perimeter is
    /// cut into pieces of at most LENGTH. Give it once a scene.
    #[arg(long = "scene", required = true, value_name = "SCENE", allow_hyphen_values = true)]
    scenes: Vec<Place>,
    /// Folder for compare.md and the plots; it is made when absent.
    #[arg(long, default_value = "out/compare")]
    out: PathBuf,
    /// Rows a face of the first pass of our method.
    #[arg(long, default_value_t = 24)]
    rows: u32,
    /// Most rounds of our method, and runs of Algorithm 1 at its last resolution; time may end
    /// them earlier.
    #[arg(long, default_value_t = 64)]
    runs: u32,
    /// N of the cube maps that Algorithm 1 is run with, ascending.
    #[arg(long, value_delimiter = ',', default_value = "16,32,64,128,256")]
    pixels: Vec<u32>,
    /// Time that a method may take on a scene, seconds.
    #[arg(long, default_value_t = 60.0)]
    limit: f64,
    /// Time that Algorithm 1 may take on a scene instead, seconds.
    #[arg(long)]
    algorithm_limit: Option<f64>,
    /// Viewpoints, spread evenly over the rectangle, at which errors are measured.
    #[arg(long, default_value_t = 16)]
    viewpoints: u32,
    /// Rays a viewpoint, rounded up to a power of four.
    #[arg(long, default_value_t = 65_536)]
    rays: u32,
    /// Rows of the comparison on one segment.
    #[arg(long, value_delimiter = ',', default_value = "16,64,200")]
    single_rows: Vec<u32>,
    /// Time that a rival may take on one segment, seconds.
    #[arg(long, default_value_t = 30.0)]
    single_limit: f64,
    /// Rivals to run; all when absent.
    #[arg(long, value_delimiter = ',')]
    methods: Option<Vec<Method>>,
    /// Which time is compared.
    #[arg(long, value_enum, default_value = "wall")]
    clock: Clock,
}

impl Arguments {
    fn runs_method(&self, method: Method) -> bool {
        self.methods.as_ref().is_none_or(|m| m.contains(&method))
    }
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("error: {message}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), String> {
    let folder = &arguments.out;
    std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    let mut reports = Vec::new();
    for place in &arguments.scenes {
        let report = compare(arguments, place)?;
        for (axis, name) in [(Axis::Error, "error"), (Axis::Found, "found")] {
            let path = folder.join(format!("{}-{name}.svg", place.name));
            let title = match axis {
                Axis::Error => format!("{}: error against time", place.name),
                Axis::Found => format!("{}: triangles against time", place.name),
            };
            plot::draw(&path, &title, &report.curves, axis, report.floor)?;
        }
        reports.push(report);
        // After every scene, so that a long run can be looked at.
        let path = folder.join("compare.md");
        let text = page(arguments, &reports);
        std::fs::write(&path, text).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    print!("{}", page(arguments, &reports));
    Ok(())
}

/// The whole page.
fn page(arguments: &Arguments, reports: &[SceneReport]) -> String {
    let clock = match arguments.clock {
        Clock::Wall => "on the wall",
        Clock::Processor => "of the processor, over the number of threads",
    };
    let mut page = format!(
        "# Comparison\n\n{} threads; times are {clock}. {} viewpoints inside each rectangle, {} rays each.\n\n",
        rayon::current_num_threads(),
        arguments.viewpoints,
        arguments.rays,
    );
    page += &claims(reports);
    reports.iter().for_each(|r| page += &section(r));
    page
}

/// The scene with every instance an occluder: no rival knows see-through ones.
fn opaque(scene: Scene) -> InstancedGeometry {
    let InstancedGeometry { meshes, mut instances, .. } = scene.geometry;
    instances.iter_mut().for_each(|i| i.occluder = true);
    InstancedGeometry::new(meshes, instances)
}

fn compare(arguments: &Arguments, place: &Place) -> Result<SceneReport, String> {
    let began = Instant::now();
    let say = |what: &str| {
        eprintln!("{:7.1} s  {}: {what}", began.elapsed().as_secs_f64(), place.name);
    };
    say("reading");
    let scene = Scene::open(&place.path, &OpenOptions::default())
        .map_err(|e| format!("{}: {e}", place.path.display()))?;
    let geometry = &opaque(scene);
    let region = place.region;
    let segments = region.perimeter(place.length);
    say("tracing what is really seen");
    let truth = Truth::trace(geometry, &region.viewpoints(arguments.viewpoints), arguments.rays);
    let floor = 0.5 / (f64::from(truth.rays()) * f64::from(arguments.viewpoints.max(1)));
    let primitives = geometry.primitive_count();
    let judge = Judge { truth: &truth, primitives, clock: arguments.clock, limit: arguments.limit };
    say("building and measuring ray tracers");
    let (tracers, speeds) = measured_tracers(geometry, region, arguments.clock)?;
    let fastest_by = |speed: fn(&TracerSpeed) -> f64| {
        let by_speed = |a: &usize, b: &usize| speed(&speeds[*a]).total_cmp(&speed(&speeds[*b]));
        &*tracers[(0..tracers.len()).max_by(by_speed).unwrap_or(0)]
    };
    let (for_frames, for_scattered) = (fastest_by(|s| s.frames), fastest_by(|s| s.scattered));

    say("from-segment");
    // Our curve reaches as far as any rival's, so that all of their points have one of ours beside.
    let algorithm_limit = arguments.algorithm_limit.unwrap_or(arguments.limit);
    let longest = Judge { limit: algorithm_limit.max(arguments.limit), ..judge };
    let mut curves =
        vec![from_segment::curve(&longest, geometry, &segments, arguments.rows, arguments.runs)];
    let mut add = |method: Method, make: &dyn Fn() -> Curve| {
        if arguments.runs_method(method) {
            let curve = make();
            if let Some(last) = curve.points.last() {
                let error = 100.0 * last.error.mean;
                say(&format!("{}: {error:.4} % after {:.1} s", curve.method, last.seconds));
            }
            curves.push(curve);
        }
    };
    let sampled = |name: &str, tracer: &dyn Tracer, viewpoints: Viewpoints| {
        let name = format!("from-point, {name} ({})", tracer.name());
        judge.follow(&name, &mut FromPoint::new(tracer, primitives, viewpoints))
    };
    add(Method::Perimeter, &|| {
        sampled("uniform along the perimeter", for_frames, Viewpoints::Along(segments.clone()))
    });
    add(Method::Inside, &|| {
        sampled("random in the rectangle", for_scattered, Viewpoints::Inside(region, 1))
    });
    add(Method::Guided, &|| {
        let (tracers, parameters) = ([for_scattered, for_frames], guided::Parameters::default());
        let mut method = guided::Guided::new(geometry, tracers, region, parameters);
        judge.follow("guided visibility sampling", &mut method)
    });
    add(Method::AlgorithmOne, &|| {
        let judge = Judge { limit: algorithm_limit, ..judge };
        algorithm_one::curve(&judge, geometry, &segments, &arguments.pixels, arguments.runs)
    });

    let mut single = Vec::new();
    if arguments.runs_method(Method::SingleSegment) {
        for &rows in &arguments.single_rows {
            say(&format!("one segment at {rows} rows"));
            let (segment, clock) = (from_segment::alone(&segments[0]), arguments.clock);
            let limit = arguments.single_limit;
            single
                .extend(single_segment::compare(geometry, &segment, rows, &tracers, clock, limit));
        }
    }
    let Region { low, high, y } = region;
    let about = format!(
        "{primitives} triangles, {} unique. Rectangle {},{} to {},{} at height {y}, {} segments of at most {} m.",
        geometry.unique_triangle_count(),
        low[0],
        low[1],
        high[0],
        high[1],
        segments.len(),
        place.length,
    );
    Ok(SceneReport { name: place.name.clone(), about, tracers: speeds, curves, single, floor })
}

/// The tracers of this build and their speeds, for rays from the region.
fn measured_tracers(
    geometry: &InstancedGeometry,
    region: Region,
    clock: Clock,
) -> Result<(Tracers<'_>, Vec<TracerSpeed>), String> {
    let built = tracers::all(geometry, region.center())?;
    let of = |viewpoints: Viewpoints| {
        let batches = Batches::new(viewpoints);
        let mut rays = Vec::new();
        (0..4 * Batches::PIECES).map(move |k| {
            let (batch, piece) = ((k / Batches::PIECES) as u64, k % Batches::PIECES);
            batches.piece(batch, piece, region.center(), &mut rays);
            rays.clone()
        })
    };
    let frames: Vec<Vec<LocalRay>> = of(Viewpoints::Along(region.perimeter(1e9))).collect();
    let scattered: Vec<Vec<LocalRay>> = of(Viewpoints::Inside(region, 1)).collect();
    let random = random_rays(region);
    let speeds = built
        .iter()
        .map(|(tracer, build)| {
            let rate = |pieces: &[Vec<LocalRay>]| {
                let trace = || {
                    pieces.par_iter().for_each_init(Vec::new, |hits, rays| {
                        tracer.closest(rays, hits);
                    });
                };
                pieces.iter().map(Vec::len).sum::<usize>() as f64 / fastest(clock, 1.0, trace)
            };
            TracerSpeed {
                tracer: tracer.name(),
                frames: rate(&frames),
                scattered: rate(&scattered),
                random: rate(&random),
                build: *build,
            }
        })
        .collect();
    Ok((built.into_iter().map(|b| b.0).collect(), speeds))
}

/// Random directions from random points, in no order.
fn random_rays(region: Region) -> Vec<Vec<LocalRay>> {
    (0..64)
        .map(|piece| {
            let mut random = stream(0x5EED, piece);
            let mut unit = || random.next_unit();
            let ray = |_| {
                let origin: DVec3 = region.at(unit(), unit()) - region.center();
                let direction = sphere(unit(), unit());
                LocalRay { origin: origin.as_vec3(), direction: direction.as_vec3() }
            };
            (0..4096).map(ray).collect()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_read_from_the_end() {
        let place: Place = "linz=a,b.glb,-30,50,-10,70,13.7,10".parse().unwrap();
        assert_eq!((place.name.as_str(), place.path), ("linz", PathBuf::from("a,b.glb")));
        assert_eq!((place.region.low, place.region.y, place.length), ([-30.0, 50.0], 13.7, 10.0));
        for wrong in
            ["linz", "a=b.glb", "a=b.glb,1,2,3,4,5,x", "a/b=c,0,0,1,1,0,1", "a=c,0,0,1,1,0,0"]
        {
            assert!(wrong.parse::<Place>().is_err(), "{wrong}");
        }
    }
}
