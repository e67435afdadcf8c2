//! What hidden objects that move cost: the cell of a scene in a box, with visible ones that move inside
//! the box, and more and more that move around it and cannot be seen.
//!
//! Three ways to bake the same cell, whose sets have to be the same:
//! - with temporal bounding volumes, as every bake does;
//! - without: all that moves is looked at in every state, through its hierarchy of moving boxes;
//! - each state as a scene of its own: what moves is put where it is half-way through the state, and the
//!   hierarchy over instances is built again. This one sees the same only where the clock is stopped, so
//!   its sets are not compared; it stands for renderers that update their hierarchy with every object.
//!
//! A bake of a cell is the solves around it, what reaches into it, and the held-out rays of a clean cell
//! at random moments. One thread weighs them alike:
//!
//! ```sh
//! RAYON_NUM_THREADS=1 cargo run --release -p sightline-benches --bin hidden_movers -- \
//!   CITY --region=-30,50,-20,60 --y 13.7 --plot hidden-movers.svg
//! ```
//!
//! Source of the experiment: Sudarsky and Gotsman, "Output-Sensitive Rendering and Communication in
//! Dynamic Virtual Environments" (VRST 1997), figure 5.
#![allow(clippy::print_stdout)]

use std::path::PathBuf;
use std::time::Instant;

use clap::Parser;
use glam::{DAffine3, DQuat, DVec3};
use sightline_benches::plot::draw_lines;
use sightline_benches::region::{Place, Region};
use sightline_benches::walls::walls;
use sightline_geometry::overlap::primitives_in_cell_over;
use sightline_geometry::{
    Bounds, CellId, Instance, InstancedGeometry, Mesh, MeshId, Moment, ObjectId, PrimitiveId,
    Sampling, StateSets, ViewCell,
};
use sightline_quality::{Suspect, measure_viewpoints_at};
use sightline_scene::{OpenOptions, Scene};
use sightline_solver::{SolveOptions, Statistics, TimePath, solve_segment_with, solve_states};

#[derive(Parser)]
struct Arguments {
    #[command(flatten)]
    place: Place,
    /// Hidden objects that move.
    #[arg(long, value_delimiter = ',', default_value = "0,1000,10000,25000,50000,100000")]
    hidden: Vec<u32>,
    /// Objects that move inside the box, above the rectangle.
    #[arg(long, default_value_t = 16)]
    visible: u32,
    /// States.
    #[arg(long, default_value_t = 32)]
    states: u32,
    /// Rows a face.
    #[arg(long, default_value_t = 24)]
    rows: u32,
    /// Passes of refinement.
    #[arg(long, default_value_t = 4)]
    passes: u32,
    /// Held-out rays: as many as a clean cell takes.
    #[arg(long, default_value_t = 18_000)]
    rays: u32,
    /// Rounds over all numbers of objects; the least time of each counts.
    #[arg(long, default_value_t = 3)]
    rounds: u32,
    /// Leave out the third way: each state as a scene of its own.
    #[arg(long)]
    skip_rebuilding: bool,
    /// Draw the curves into this file, SVG.
    #[arg(long)]
    plot: Option<PathBuf>,
}

/// A number in [0, 1) from two.
///
/// Source: the additive recurrence R2 (Roberts, "The Unreasonable Effectiveness of Quasirandom
/// Sequences").
fn share(k: u32, of: u32) -> f64 {
    const PLASTIC: f64 = 1.324_717_957_244_746;
    (0.5 + f64::from(k) * PLASTIC.powi(-(of as i32) - 1)).fract()
}

/// A ball of 128 triangles, 1 m across: an octahedron, divided and pushed out.
fn ball() -> Mesh {
    let mut points: Vec<DVec3> =
        [DVec3::X, DVec3::Y, DVec3::Z].iter().flat_map(|a| [*a, -*a]).collect();
    let mut faces: Vec<[u32; 3]> =
        (0..8u32).map(|k| [k & 1, 2 + (k >> 1 & 1), 4 + (k >> 2 & 1)]).collect();
    for _ in 0..2 {
        faces = faces
            .iter()
            .flat_map(|&[a, b, c]| {
                let mut middle = |p: u32, q: u32| {
                    points.push((points[p as usize] + points[q as usize]).normalize());
                    points.len() as u32 - 1
                };
                let [ab, bc, ca] = [middle(a, b), middle(b, c), middle(c, a)];
                [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
            })
            .collect();
    }
    let positions = points.iter().map(|p| (0.5 * *p).as_vec3().to_array()).collect();
    Mesh::new(positions, &faces).0
}

/// Where an object that walks in circles is, at each key frame.
fn walk(k: u32, middle: DVec3, radius: f64, states: u32) -> Box<[DAffine3]> {
    (0..=states)
        .map(|key| {
            let turn = std::f64::consts::TAU * (share(k, 2) + f64::from(key) / 24.0);
            let way = DVec3::new(turn.cos(), 0.05 * (3.0 * turn).sin(), turn.sin());
            DAffine3::from_rotation_translation(
                DQuat::from_rotation_y(-turn),
                middle + radius * way,
            )
        })
        .collect()
}

/// The scene in a box, with objects that move in it above the region, and others around it.
fn with_movers(
    scene: &InstancedGeometry,
    region: &Region,
    visible: u32,
    hidden: u32,
    states: u32,
) -> InstancedGeometry {
    let (mut meshes, mut instances) = (scene.meshes.clone(), scene.instances.clone());
    let mut next = scene.primitive_count();
    let size = scene.bounds.size();
    let margin = 0.05 * size + 1.0;
    let inside = Bounds { min: scene.bounds.min - margin, max: scene.bounds.max + margin };
    let mut add = |mesh: &Mesh, number: u32, motion: Option<Box<[DAffine3]>>| {
        instances.push(Instance {
            mesh: MeshId(number),
            object: ObjectId(instances.len() as u32),
            world_from_mesh: motion.as_ref().map_or(DAffine3::IDENTITY, |keys| keys[0]),
            first_primitive: PrimitiveId(next),
            occluder: true,
            motion,
        });
        next += mesh.triangles.len() as u32;
    };
    let (box_number, ball_number) = (meshes.len() as u32, meshes.len() as u32 + 1);
    let (the_box, ball) = (walls(inside), ball());
    add(&the_box, box_number, None);
    for k in 0..visible {
        let at = region.at(share(k, 0), share(k, 1)) + DVec3::new(0.0, 4.0, 0.0);
        add(&ball, ball_number, Some(walk(k, at, 2.0, states)));
    }
    // Around the box on the ground, within 500 m: as dense as a crowd at the most.
    let reach = 500.0;
    let (center, half) = (inside.center(), 0.5 * inside.size());
    let mut placed = 0;
    for k in 0.. {
        if placed == hidden {
            break;
        }
        let [x, z] = [share(k, 0), share(k, 1)].map(|s| 2.0 * s - 1.0);
        let away = DVec3::new(x * (half.x + reach), 0.0, z * (half.z + reach));
        if away.x.abs() < half.x + 4.0 && away.z.abs() < half.z + 4.0 {
            continue;
        }
        let at = DVec3::new(center.x + away.x, region.y, center.z + away.z);
        add(&ball, ball_number, Some(walk(k, at, 3.0, states)));
        placed += 1;
    }
    meshes.extend([the_box, ball]);
    InstancedGeometry::with_motion(meshes, instances, vec![], states)
}

/// The cell that stands on the rectangle.
fn cell(region: &Region) -> ViewCell {
    let corners =
        [region.at(0.0, 0.0), region.at(1.0, 0.0), region.at(1.0, 1.0), region.at(0.0, 1.0)];
    ViewCell { id: CellId(0), corners, height: 0.01 }
}

struct Timed {
    hidden: u32,
    geometry: InstancedGeometry,
    /// Seconds with volumes, without, and with each state on its own.
    seconds: [f64; 3],
    sets: Option<StateSets>,
    statistics: Statistics,
}

impl Timed {
    fn solve(&mut self, arguments: &Arguments, region: &Region, without_volumes: bool) -> f64 {
        let options = SolveOptions {
            passes: arguments.passes,
            threshold: 1e-6,
            without_volumes,
            ..SolveOptions::default()
        };
        let (geometry, states) = (&self.geometry, 0..arguments.states);
        let began = Instant::now();
        let mut statistics = Statistics::default();
        let mut seen = vec![primitives_in_cell_over(geometry, &cell(region), states.clone())];
        for segment in region.perimeter(f64::INFINITY) {
            let sampling = Sampling::new(arguments.rows).jittered(segment.id.0);
            let (states, path) = (states.clone(), TimePath::FORWARD);
            let found = solve_states(geometry, &segment, sampling, states, path, None, &options);
            statistics = found.iter().fold(statistics, |s, f| s.plus(f.visibility.statistics));
            let sets = found.into_iter().map(|f| (f.states, f.visibility.set));
            seen.push(StateSets::from_runs(sets));
        }
        let sets = StateSets::join(&seen);
        let at: Vec<Suspect> = (0..)
            .zip(region.viewpoints(64))
            .map(|(k, viewpoint)| {
                let time = share(k, 3) * f64::from(arguments.states);
                Suspect { viewpoint, moment: Moment { state: time as u32, t: time.fract() } }
            })
            .collect();
        let error = measure_viewpoints_at(geometry, &sets, CellId(0), &at, arguments.rays / 64, 1);
        let seconds = began.elapsed().as_secs_f64();
        let worst = error.viewpoints.iter().map(|v| v.error).fold(0.0, f64::max);
        assert!(worst < 0.02, "the cell is solved: {worst}");
        if let Some(before) = &self.sets {
            assert!(*before == sets, "volumes change what is found");
        }
        self.sets = Some(sets);
        if !without_volumes {
            self.statistics = statistics;
        }
        seconds
    }

    /// Each state as a scene of its own.
    fn rebuild(&self, arguments: &Arguments, region: &Region) -> f64 {
        let options =
            SolveOptions { passes: arguments.passes, threshold: 1e-6, ..SolveOptions::default() };
        let began = Instant::now();
        // The meshes are moved from scene to scene.
        let mut meshes = self.geometry.meshes.clone();
        for state in 0..arguments.states {
            let moment = Moment { state, t: 0.5 };
            let frozen = |one: &Instance| Instance {
                world_from_mesh: one.world_from_mesh_at(moment),
                motion: None,
                ..one.clone()
            };
            let instances = self.geometry.instances.iter().map(frozen).collect();
            let geometry = InstancedGeometry::new(meshes, instances);
            for segment in region.perimeter(f64::INFINITY) {
                let sampling = Sampling::new(arguments.rows).jittered(segment.id.0);
                let found = solve_segment_with(&geometry, &segment, sampling, &options);
                assert!(!found.set.is_empty());
            }
            meshes = geometry.meshes;
        }
        began.elapsed().as_secs_f64()
    }
}

fn main() {
    let arguments = Arguments::parse();
    let scene =
        Scene::open(&arguments.place.scene, &OpenOptions::default()).expect("a readable scene");
    let region = arguments.place.rectangle().expect("a rectangle");
    let mut all: Vec<Timed> = arguments
        .hidden
        .iter()
        .map(|&hidden| Timed {
            hidden,
            geometry: with_movers(
                &scene.geometry,
                &region,
                arguments.visible,
                hidden,
                arguments.states,
            ),
            seconds: [f64::INFINITY; 3],
            sets: None,
            statistics: Statistics::default(),
        })
        .collect();
    for round in 0..arguments.rounds {
        for one in &mut all {
            let with = one.solve(&arguments, &region, false);
            let without = one.solve(&arguments, &region, true);
            let apart = if round == 0 && !arguments.skip_rebuilding {
                one.rebuild(&arguments, &region)
            } else {
                f64::INFINITY
            };
            for (least, now) in one.seconds.iter_mut().zip([with, without, apart]) {
                *least = least.min(now);
            }
        }
    }
    println!(
        "| hidden objects | visible | volumes | skipped | with volumes | against the first | without | against the first | each state on its own |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- | --- |");
    let first = all[0].seconds;
    for one in &all {
        let sets = one.sets.as_ref().expect("it was solved");
        assert!(Some(sets) == all[0].sets.as_ref(), "what is visible has changed");
        let s = one.seconds;
        println!(
            "| {} | {} | {} | {} | {:.3} s | {:.3} | {:.3} s | {:.3} | {:.3} s |",
            one.hidden,
            sets.union().len(),
            one.statistics.volumes,
            one.statistics.skipped,
            s[0],
            s[0] / first[0],
            s[1],
            s[1] / first[1],
            s[2],
        );
    }
    if let Some(path) = &arguments.plot {
        let names = ["temporal bounding volumes", "without them", "each state on its own"];
        let lines: Vec<(&str, Vec<(f64, f64)>)> = names
            .iter()
            .enumerate()
            .filter(|(k, _)| all.iter().all(|one| one.seconds[*k].is_finite()))
            .map(|(k, name)| {
                (*name, all.iter().map(|one| (f64::from(one.hidden), one.seconds[k])).collect())
            })
            .collect();
        let axes = ("hidden objects that move", "time to bake the cell, s");
        draw_lines(path, "A cell with hidden objects around it", axes, &lines).expect("a file");
    }
}
