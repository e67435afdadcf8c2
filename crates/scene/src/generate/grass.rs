//! A meadow: a rolling terrain, and tufts and flowers scattered over it by
//! EXT_mesh_gpu_instancing. The file holds the unique models and 40 bytes an instance.
//!
//! The instances are grouped in tiles, one node a tile and model, so that objects are places.
//!
//! In the wind, every model has two morph targets, and an animation of their weights moves all
//! instances of a node together. A reader keeps one body in memory for each mesh and motion, so tiles sway
//! in one of only [`PHASES`] phases: the models are some 7,000 of the 58,000 unique triangles of the
//! source's meadow, and four times as many still fit beside its terrain. The terrain rests, and the
//! scene at rest is that of the meadow without wind.

use glam::{DQuat, DVec3};

use super::Made;
use super::glb_writer::{Document, MeshKey, Placement, SamplerKey};
use super::material::Material;
use super::random::{Random, sin_cos};
use super::solid::Solid;
use super::vegetation::direction;

/// Instances a square metre of meadow.
const DENSITY: f64 = 6.0;
/// Tiles along each side of the meadow.
const TILES: usize = 8;

/// Phases of the wind.
const PHASES: usize = 4;
/// Length of a state in the wind, and of a gust, seconds.
const WIND: (f64, f64) = (0.25, 2.5);
/// How far the tip of a blade of 0.5 m is displaced by a morph target, metres.
const SWAY: f64 = 0.04;
/// Depth of the roots below the ground, metres.
const ROOT: f64 = 0.06;

// Streams of random numbers.
const TERRAIN: u64 = 1;
const MODELS: u64 = 2;
const SCATTER: u64 = 3;

/// Height of the ground: four waves, flat to some decimetres near the origin.
struct Terrain {
    waves: [(f64, f64, f64, f64); 4],
}

impl Terrain {
    fn new(random: &mut Random) -> Self {
        let waves = [60.0, 37.0, 23.0, 11.0].map(|length| {
            let (s, c) = sin_cos(random.angle());
            let k = std::f64::consts::TAU / length;
            (k * s, k * c, random.angle(), 0.011 * length)
        });
        Self { waves }
    }

    fn height(&self, x: f64, z: f64) -> f64 {
        let raw = |x: f64, z: f64| -> f64 {
            self.waves.iter().map(|(kx, kz, p, a)| a * sin_cos(kx * x + kz * z + p).0).sum()
        };
        raw(x, z) - raw(0.0, 0.0)
    }
}

/// Sizes of a scene of a given count.
struct Plan {
    /// Triangles of the smallest model; the others are up to four times as large.
    model: u64,
    /// Cells along each side of the terrain.
    cells: usize,
}

impl Plan {
    fn new(triangles: u64) -> Self {
        // 50,000 instances at the size of the source; never more than 100,000.
        let model = (triangles / 100_000).clamp(60, 500);
        let model = model.max(triangles / 200_000);
        let cells = libm::sqrt(triangles as f64 / 8.0 / 2.0).clamp(12.0, 160.0) as usize;
        Self { model, cells }
    }
}

/// Makes a meadow of about `triangles` triangles, at rest or with wind over some states.
pub(super) fn make(triangles: u64, seed: u64, wind: Option<u32>) -> Made {
    let plan = Plan::new(triangles);
    let mut document = Document::new();
    let root = document.node(None, "meadow", None, Placement::IDENTITY);
    let models = models(&mut document, plan.model, seed, wind.is_some());
    let phases = wind.map(|states| phases(&mut document, states));
    let terrain_triangles = 2 * (plan.cells * plan.cells) as u64;

    // Draw models until the triangles are spent.
    let mut random = Random::new(seed, SCATTER);
    let mut left = triangles - terrain_triangles;
    let mut drawn = vec![];
    let smallest = models.iter().map(|m| document.triangles_of(m.1)).min().unwrap_or(1);
    while left >= smallest {
        // Two of three are grass.
        let grass = random.chance(0.68);
        let fitting: Vec<usize> =
            (0..models.len()).filter(|&k| document.triangles_of(models[k].1) <= left).collect();
        let liked: Vec<usize> = fitting.iter().copied().filter(|&k| (k < 4) == grass).collect();
        let model = random.pick(if liked.is_empty() { &fitting } else { &liked });
        left -= document.triangles_of(models[model].1);
        drawn.push(model);
    }

    let half = (0.5 * (drawn.len() as f64 / DENSITY).sqrt()).max(1.5);
    let mut terrain_random = Random::new(seed, TERRAIN);
    let terrain = Terrain::new(&mut terrain_random);
    let ground = document.mesh("ground", &ground(&terrain, half + 1.0, plan.cells));
    document.node(Some(root), "ground", Some(ground), Placement::IDENTITY);

    let mut tiles = vec![vec![]; TILES * TILES * models.len()];
    for model in drawn {
        let (u, v) = (random.unit(), random.unit());
        let (x, z) = (half * (2.0 * u - 1.0), half * (2.0 * v - 1.0));
        let (s, c) = sin_cos(0.5 * random.angle());
        let lean = direction(&mut random) * random.between(0.0, 0.1);
        let rotation = DQuat::from_xyzw(lean.x, s, lean.z, c).normalize();
        let translation = DVec3::new(x, terrain.height(x, z), z);
        let scale = random.between(0.75, 1.2);
        let tile = (u * TILES as f64) as usize * TILES + (v * TILES as f64) as usize;
        tiles[tile * models.len() + model].push(Placement { translation, rotation, scale });
    }
    for i in 0..TILES {
        for j in 0..TILES {
            let tile =
                document.node(Some(root), format!("tile_{i}_{j}"), None, Placement::IDENTITY);
            for (k, (name, mesh)) in models.iter().enumerate() {
                let placements = &tiles[(i * TILES + j) * models.len() + k];
                if !placements.is_empty() {
                    let name = format!("tile_{i}_{j}/{name}");
                    let node = document.instanced_node(Some(tile), name, *mesh, placements);
                    if let Some(phases) = &phases {
                        // Neighbours along either side differ.
                        document.animate_weights(node, phases[(i + 2 * j) % PHASES]);
                    }
                }
            }
        }
    }
    Made { document, suggested_region: [-1.0, -1.0, 1.0, 1.0], suggested_eye_height: [1.7, 1.7] }
}

/// Weights of the two morph targets over the key frames, for each phase: the tips go round an ellipse.
fn phases(document: &mut Document, states: u32) -> [SamplerKey; PHASES] {
    let (state, gust) = WIND;
    let times: Vec<f64> = (0..=states).map(|key| state * f64::from(key)).collect();
    let seconds: Vec<f32> = times.iter().map(|t| *t as f32).collect();
    std::array::from_fn(|phase| {
        let weights: Vec<f32> = times
            .iter()
            .flat_map(|t| {
                let turns = t / gust + phase as f64 / PHASES as f64;
                let (s, c) = sin_cos(std::f64::consts::TAU * turns);
                [c as f32, s as f32]
            })
            .collect();
        document.weights_sampler(&seconds, &weights)
    })
}

/// Displacements of the vertices by the two morph targets: none at the roots, and more with the square
/// of the height above them, as a bent rod's; blades beside each other differ a little.
fn sway(solid: &Solid) -> [Vec<[f32; 3]>; 2] {
    let displaced = |direction: DVec3, wave: f64| {
        let of = |p: &[f32; 3]| {
            let [x, _, z] = p.map(f64::from);
            // In `f32`, as roots are stored: they do not move at all.
            let height = f64::from((p[1] + ROOT as f32).max(0.0)) / (0.5 + ROOT);
            let gust = 0.8 + 0.2 * sin_cos(wave * x + 5.0 * z).0;
            (SWAY * height * height * gust * direction).as_vec3().to_array()
        };
        solid.positions.iter().map(of).collect()
    };
    [displaced(DVec3::new(1.0, 0.0, 0.25), 7.0), displaced(DVec3::new(-0.25, 0.0, 0.8), -6.0)]
}

/// The terrain over |x|, |z| <= `half`.
fn ground(terrain: &Terrain, half: f64, cells: usize) -> Solid {
    let mut solid = Solid::new();
    let at = |i: usize, j: usize| {
        let c = |k: usize| half * (2.0 * k as f64 / cells as f64 - 1.0);
        DVec3::new(c(i), terrain.height(c(i), c(j)), c(j))
    };
    for i in 0..cells {
        for j in 0..cells {
            let corners = [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)];
            solid.quad(Material::Meadow, corners);
        }
    }
    solid
}

/// Four tufts of grass, then three kinds of flowers.
fn models(document: &mut Document, size: u64, seed: u64, wind: bool) -> Vec<(String, MeshKey)> {
    let mut add = |name: String, solid: &Solid| {
        let mesh = if wind {
            document.morphing_mesh(name.as_str(), solid, &sway(solid))
        } else {
            document.mesh(name.as_str(), solid)
        };
        (name, mesh)
    };
    let mut random = Random::new(seed, MODELS);
    let mut models = vec![];
    for (k, share) in [1.0, 1.6, 2.4, 3.6].into_iter().enumerate() {
        let budget = (share * size as f64) as u64;
        let tuft = tuft(&mut random, budget, 0.12 + 0.1 * k as f64);
        models.push(add(format!("tuft_{k}"), &tuft));
    }
    for (petal, name, share) in [
        (Material::RedPetal, "poppy", 1.2),
        (Material::WhitePetal, "daisy", 2.0),
        (Material::BluePetal, "cornflower", 2.8),
    ] {
        let flowers = flowers(&mut random, (share * size as f64) as u64, petal);
        models.push(add(name.into(), &flowers));
    }
    models
}

/// A blade of `2 n - 1` triangles from `root`: a strip that narrows and bends over.
fn blade(
    solid: &mut Solid,
    random: &mut Random,
    root: DVec3,
    height: f64,
    n: usize,
    material: Material,
) {
    let (s, c) = sin_cos(random.angle());
    let (bend, side) = (DVec3::new(s, 0.0, c), DVec3::new(c, 0.0, -s));
    let width = random.between(0.0025, 0.005) * (1.0 + 2.0 * height);
    let curve = random.between(0.15, 0.75);
    let at = |k: usize| {
        let t = k as f64 / n as f64;
        root + height * (DVec3::Y * (t - 0.35 * curve * t * t) + bend * (curve * t * t))
    };
    let half = |k: usize| side * (width * (1.0 - k as f64 / n as f64));
    for k in 0..n - 1 {
        let (a, b) = (at(k), at(k + 1));
        solid.quad(material, [a - half(k), a + half(k), b + half(k + 1), b - half(k + 1)]);
    }
    solid.triangle(material, [at(n - 1) - half(n - 1), at(n - 1) + half(n - 1), at(n)]);
}

/// A tuft of blades, about `budget` triangles and up to `height` + 0.1 metres high.
fn tuft(random: &mut Random, budget: u64, height: f64) -> Solid {
    let mut solid = Solid::new();
    while solid.triangle_count() + 7 <= budget {
        let (s, c) = sin_cos(random.angle());
        let r = 0.3 * random.unit().sqrt();
        // Roots are below the ground, also where it slopes.
        let root = DVec3::new(r * s, -ROOT, r * c);
        let material = if random.chance(0.85) { Material::Blade } else { Material::DryBlade };
        let height = 0.06 + height * random.between(0.45, 1.1);
        blade(&mut solid, random, root, height, 4, material);
    }
    solid
}

/// A group of flowers with some leaves, about `budget` triangles, up to 0.7 m high.
fn flowers(random: &mut Random, budget: u64, petal: Material) -> Solid {
    let mut solid = Solid::new();
    // A flower: a stem of 3 sides and 3 parts, 6 petals of 4 triangles, a heart of 8 and leaves.
    while solid.triangle_count() + 60 <= budget {
        let (s, c) = sin_cos(random.angle());
        let r = 0.28 * random.unit().sqrt();
        let root = DVec3::new(r * s, -ROOT, r * c);
        let height = random.between(0.35, 0.7);
        let head =
            root + DVec3::new(random.between(-0.07, 0.07), height, random.between(-0.07, 0.07));
        let stem =
            |t: f64| root.lerp(head, t) + DVec3::new(0.04 * s, 0.0, 0.04 * c) * (t * (1.0 - t));
        for k in 0..3 {
            let (a, b) = (stem(f64::from(k) / 3.0), stem(f64::from(k + 1) / 3.0));
            for side in 0..3 {
                let at = |p: DVec3, k: i32| {
                    let (s, c) = sin_cos(std::f64::consts::TAU * f64::from(k % 3) / 3.0);
                    p + 0.0035 * DVec3::new(s, 0.0, c)
                };
                solid.quad(
                    Material::Stem,
                    [at(a, side), at(a, side + 1), at(b, side + 1), at(b, side)],
                );
            }
        }
        for k in 0..6 {
            let (s, c) =
                sin_cos(std::f64::consts::TAU * (f64::from(k) + 0.2 * random.unit()) / 6.0);
            let (out, side) = (DVec3::new(s, 0.0, c), DVec3::new(c, 0.0, -s));
            let size = random.between(0.028, 0.04);
            let up = DVec3::Y * size;
            let inner = head + 0.2 * size * out;
            let middle = head + 0.8 * size * out + 0.35 * up;
            let (left, right) = (middle - 0.45 * size * side, middle + 0.45 * size * side);
            let tip = head + 1.4 * size * out + 0.3 * up;
            for t in [
                [inner, right, middle],
                [inner, middle, left],
                [middle, right, tip],
                [middle, tip, left],
            ] {
                solid.triangle(petal, t);
            }
        }
        let heart = |k: usize| head + 0.011 * [DVec3::X, DVec3::Z, -DVec3::X, -DVec3::Z][k % 4];
        for k in 0..4 {
            solid
                .triangle(Material::YellowPetal, [heart(k + 1), heart(k), head + DVec3::Y * 0.012]);
            solid
                .triangle(Material::YellowPetal, [heart(k), heart(k + 1), head - DVec3::Y * 0.012]);
        }
        blade(&mut solid, random, root, 0.55 * height, 4, Material::Stem);
    }
    // Grass between the stems.
    while solid.triangle_count() + 7 <= budget {
        let root = DVec3::new(random.between(-0.25, 0.25), -ROOT, random.between(-0.25, 0.25));
        let height = random.between(0.12, 0.26);
        blade(&mut solid, random, root, height, 4, Material::Blade);
    }
    solid
}
