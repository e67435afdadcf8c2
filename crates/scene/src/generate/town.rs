//! A walled town of gabled houses along crooked streets, with a church and trees.
//!
//! Layout: the high street runs along z at x = 0 and is free for |x| <= 5. Lanes leave it to either side
//! and wind; houses stand along both sides of every street, turned to it, and none overlaps
//! another, a street or the square before the church. A wall with towers goes round, trees stand in the
//! gardens and outside.
//!
//! The size follows the triangle count: about a third goes into houses, the rest into trees, and shrubs
//! fill up the remainder.

use glam::{DVec2, DVec3};

use super::Made;
use super::facade::{Footprint, Ring, Walls};
use super::glb_writer::{Document, MeshKey, NodeKey, Placement};
use super::material::Material;
use super::random::{Random, sin_cos};
use super::solid::{Solid, circle};
use super::vegetation;

/// Half of the free width of the high street.
const FREE_HALF_WIDTH: f64 = 5.0;
/// Half of the free length of the high street at the size of the source.
const FREE_HALF_LENGTH: f64 = 82.5;

// Streams of random numbers.
const LAYOUT: u64 = 1;
const TREES: u64 = 2;
const MODELS: u64 = 3;
const HOUSES: u64 = 1 << 32;

/// A rectangle on the ground in any direction: centre, half extents, and unit axes (x, z).
#[derive(Clone, Copy)]
struct Plot {
    center: DVec2,
    half: DVec2,
    along: DVec2,
}

impl Plot {
    fn across(self) -> DVec2 {
        DVec2::new(-self.along.y, self.along.x)
    }

    fn reach(self, axis: DVec2) -> f64 {
        self.half.x * self.along.dot(axis).abs() + self.half.y * self.across().dot(axis).abs()
    }

    /// Separating axes.
    fn overlaps(self, other: Self) -> bool {
        let d = other.center - self.center;
        [self.along, self.across(), other.along, other.across()]
            .into_iter()
            .all(|axis| d.dot(axis).abs() < self.reach(axis) + other.reach(axis))
    }

    fn distance_to(self, p: DVec2) -> f64 {
        let d = p - self.center;
        let off = DVec2::new(d.dot(self.along).abs(), d.dot(self.across()).abs()) - self.half;
        off.max(DVec2::ZERO).length()
    }
}

struct House {
    plot: Plot,
    stream: u64,
}

struct Town {
    radius: f64,
    streets: Vec<Plot>,
    houses: Vec<House>,
    church: Option<Plot>,
}

/// Makes a town of about `triangles` triangles.
pub(super) fn make(triangles: u64, seed: u64) -> Made {
    let t = triangles as f64;
    // 130 m at the size of the source.
    let radius = (130.0 * (t / 2.3e6).sqrt()).clamp(34.0, 170.0);
    let mut town = Town::new(radius, seed);
    let mut document = Document::new();
    let root = document.node(None, "town", None, Placement::IDENTITY);
    let ground = document.mesh("ground", &town.ground(triangles));
    document.node(Some(root), "ground", Some(ground), Placement::IDENTITY);
    if let Some(plot) = town.church {
        let mesh = document.mesh("church", &church());
        document.node(Some(root), "church", Some(mesh), placement(plot));
    }
    town.wall(&mut document, root);

    // Houses nearest to the origin first, until a third of the triangles is spent.
    let houses = document.node(Some(root), "houses", None, Placement::IDENTITY);
    town.houses
        .sort_by(|a, b| a.plot.center.length_squared().total_cmp(&b.plot.center.length_squared()));
    let mut built = 0;
    for house in &town.houses {
        let solid = house.solid(seed);
        if document.triangles() + solid.triangle_count() > (0.42 * t) as u64 {
            break;
        }
        let name = format!("houses/house_{built}");
        let mesh = document.mesh(name.clone(), &solid);
        document.node(Some(houses), name, Some(mesh), placement(house.plot));
        built += 1;
    }
    town.houses.truncate(built);
    town.plant(&mut document, root, triangles, seed);

    let half = FREE_HALF_LENGTH.min((radius - 12.0).floor());
    Made {
        document,
        suggested_region: [-FREE_HALF_WIDTH, -half, FREE_HALF_WIDTH, half],
        suggested_eye_height: [1.5, 1.8],
    }
}

/// Local x along the plot, local +z to its front.
fn placement(plot: Plot) -> Placement {
    // A turn by a about +Y takes +x to (cos a, -sin a) in (x, z).
    let angle = libm::atan2(-plot.along.y, plot.along.x);
    Placement::turned(DVec3::new(plot.center.x, 0.0, plot.center.y), angle)
}

impl Town {
    fn new(radius: f64, seed: u64) -> Self {
        let mut random = Random::new(seed, LAYOUT);
        let mut town = Self { radius, streets: vec![], houses: vec![], church: None };
        let high_street = Plot {
            center: DVec2::ZERO,
            half: DVec2::new(radius + 30.0, FREE_HALF_WIDTH + 0.4),
            along: DVec2::Y,
        };
        town.streets.push(high_street);
        // Lanes: chains of short pieces that turn a little at every step.
        let mut lanes: Vec<Vec<Plot>> = vec![vec![high_street]];
        for side in [-1.0, 1.0] {
            let mut z = -radius + random.between(20.0, 30.0);
            while z < radius - 16.0 {
                let slant = random.between(-0.35, 0.35);
                lanes.push(town.lane(DVec2::new(side * 5.5, z), side, slant, &mut random));
                z += random.between(30.0, 44.0);
            }
        }
        if radius > 60.0 {
            let plot = Plot {
                center: DVec2::new(-34.0, 6.0),
                half: DVec2::new(22.0, 12.0),
                along: DVec2::X,
            };
            town.church = Some(plot);
        }
        for lane in lanes {
            for piece in lane {
                town.line_with_houses(piece, &mut random);
            }
        }
        town
    }

    /// A winding lane from `start` towards +x or -x; its pieces join the streets.
    fn lane(&mut self, start: DVec2, side: f64, slant: f64, random: &mut Random) -> Vec<Plot> {
        let mut pieces = vec![];
        let (mut at, mut angle) = (start, slant);
        for _ in 0..40 {
            let (s, c) = sin_cos(angle);
            let along = DVec2::new(side * c, s);
            let length = random.between(12.0, 19.0);
            let end = at + along * length;
            if end.length() > self.radius - 9.0 {
                break;
            }
            let width = random.between(1.9, 2.6);
            let plot =
                Plot { center: 0.5 * (at + end), half: DVec2::new(0.5 * length, width), along };
            pieces.push(plot);
            at = end;
            angle = (angle + random.between(-0.3, 0.3)).clamp(-0.7, 0.7);
        }
        self.streets.extend(&pieces);
        pieces
    }

    fn line_with_houses(&mut self, street: Plot, random: &mut Random) {
        for side in [-1.0, 1.0] {
            let mut s = -street.half.x;
            while s < street.half.x {
                let half = DVec2::new(random.between(3.0, 5.2), random.between(3.4, 5.0));
                let gap = street.half.y + random.between(0.5, 1.6);
                let center = street.center
                    + street.along * (s + half.x)
                    + street.across() * (side * (gap + half.y));
                // The front (local +z, which is `across` of the plot) faces the street.
                let (sin, cos) = sin_cos(random.between(-0.05, 0.05));
                let along = DVec2::new(cos, sin).rotate(street.along * -side);
                let plot = Plot { center, half, along };
                if self.is_free(plot) {
                    let stream = HOUSES + self.houses.len() as u64;
                    self.houses.push(House { plot, stream });
                    s += 2.0 * half.x + random.between(0.15, 1.2);
                } else {
                    s += 1.0;
                }
            }
        }
    }

    fn is_free(&self, plot: Plot) -> bool {
        // Eaves stand out by half a metre.
        let grown = Plot { half: plot.half + 0.25, ..plot };
        plot.center.length() + plot.half.length() < self.radius - 4.0
            && !self.streets.iter().any(|s| s.overlaps(grown))
            && !self.houses.iter().any(|h| h.plot.overlaps(grown))
            && !self.church.is_some_and(|c| Plot { half: c.half + 4.0, ..c }.overlaps(grown))
    }

    fn on_street(&self, p: DVec2, margin: f64) -> bool {
        self.streets.iter().any(|s| s.distance_to(p) <= margin)
    }

    /// The ground: squares of cobble on streets and meadow elsewhere, y = 0 up to the wall and
    /// gentle hills outside.
    fn ground(&self, triangles: u64) -> Solid {
        let half = self.radius + 70.0;
        // Squares of 3 m, larger where that would take more than a fifteenth of the triangles.
        let n = (2.0 * half / 3.0).min((triangles as f64 / 30.0).sqrt()).round() as usize;
        let at = |i: usize, j: usize| {
            let c = |k: usize| half * (2.0 * k as f64 / n as f64 - 1.0);
            let (x, z) = (c(i), c(j));
            let outside = ((x * x + z * z).sqrt() - self.radius - 8.0).max(0.0);
            let wave = 1.0 + sin_cos(0.05 * x).0 * sin_cos(0.043 * z).1;
            DVec3::new(x, 0.06 * outside * wave, z)
        };
        let mut solid = Solid::new();
        for i in 0..n {
            for j in 0..n {
                let corners = [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)];
                let middle = 0.5 * (corners[0] + corners[2]);
                let cobble = self.on_street(DVec2::new(middle.x, middle.z), 0.8);
                solid.quad(if cobble { Material::Cobble } else { Material::Meadow }, corners);
            }
        }
        solid
    }

    /// The town wall: crenellated pieces between round towers, open where the high street leaves.
    fn wall(&self, document: &mut Document, root: NodeKey) {
        let group = document.node(Some(root), "wall", None, Placement::IDENTITY);
        let corners = ((self.radius / 9.0) as usize).max(8).next_multiple_of(2);
        let tower = document.mesh("wall tower", &tower());
        let ring = circle(2 * corners);
        let corner = |k: usize| {
            // Odd places: the high street leaves in the middle between two towers.
            let (s, c) = ring[(2 * k + 1) % (2 * corners)];
            self.radius * DVec2::new(s, c)
        };
        for k in 0..corners {
            let (a, b) = (corner(k), corner((k + 1) % corners));
            let at = DVec3::new(a.x, 0.0, a.y);
            document.node(Some(group), format!("wall/tower_{k}"), Some(tower), Placement::at(at));
            let middle = 0.5 * (a + b);
            let along = (b - a).normalize();
            let plot =
                Plot { center: middle, half: DVec2::new(0.5 * (b - a).length(), 0.9), along };
            let gate = middle.x.abs() < 1.0;
            let name = if gate { format!("wall/gate_{k}") } else { format!("wall/piece_{k}") };
            let mesh = document.mesh(name.clone(), &wall_piece(plot.half.x, gate));
            document.node(Some(group), name, Some(mesh), placement(plot));
        }
    }

    /// Trees in gardens and outside the wall until the triangles are spent, then shrubs.
    fn plant(&self, document: &mut Document, root: NodeKey, triangles: u64, seed: u64) {
        let group = document.node(Some(root), "trees", None, Placement::IDENTITY);
        let mut models = Random::new(seed, MODELS);
        let leaves = ((triangles / 900) as usize).clamp(60, 2_600);
        let trees: Vec<(MeshKey, f64)> = (0..6)
            .map(|k| {
                let height = models.between(5.5, 10.0);
                let leaves = (leaves as f64 * models.between(0.7, 1.2)) as usize;
                let solid = vegetation::leafy_tree(&mut models, height, leaves);
                (document.mesh(format!("tree {k}"), &solid), 0.37 * height)
            })
            .collect();
        let shrub = document.mesh("shrub", &shrub(&mut models));
        let mut random = Random::new(seed, TREES);
        let mut number = 0;
        loop {
            let left = triangles.saturating_sub(document.triangles());
            let (mesh, crown) = random.pick(&trees);
            if document.triangles_of(mesh) > left {
                break;
            }
            let p = (self.radius + 40.0)
                * DVec2::new(random.between(-1.0, 1.0), random.between(-1.0, 1.0));
            let ring = (p.length() - self.radius).abs();
            let inside = p.length() < self.radius;
            if ring < 4.0 || (!inside && random.chance(0.6)) || !self.can_grow(p, crown) {
                continue;
            }
            let at = Placement {
                scale: random.between(0.85, 1.0),
                ..Placement::turned(self.on_ground(p), random.angle())
            };
            document.node(Some(group), format!("trees/tree_{number}"), Some(mesh), at);
            number += 1;
        }
        let mut number = 0;
        while document.triangles() + document.triangles_of(shrub) <= triangles {
            let p = (self.radius - 5.0)
                * DVec2::new(random.between(-1.0, 1.0), random.between(-1.0, 1.0));
            if p.length() > self.radius - 5.0 || !self.can_grow(p, 0.6) {
                continue;
            }
            let at = Placement::turned(self.on_ground(p), random.angle());
            document.node(Some(group), format!("trees/shrub_{number}"), Some(shrub), at);
            number += 1;
        }
    }

    fn can_grow(&self, p: DVec2, crown: f64) -> bool {
        let high_street = self.streets[0].distance_to(p) > crown + 0.2;
        high_street
            && !self.on_street(p, 0.8)
            && !self.houses.iter().any(|h| h.plot.distance_to(p) < 0.45 * crown + 0.3)
            && !self.church.is_some_and(|c| c.distance_to(p) < crown)
    }

    fn on_ground(&self, p: DVec2) -> DVec3 {
        let outside = (p.length() - self.radius - 8.0).max(0.0);
        let wave = 1.0 + sin_cos(0.05 * p.x).0 * sin_cos(0.043 * p.y).1;
        DVec3::new(p.x, 0.06 * outside * wave, p.y)
    }
}

/// Rings of a recessed window or door with a timber frame.
fn opening(wall: Material, frame: Ring) -> (Vec<Ring>, Material) {
    let outer = Ring { material: wall, ..frame.grown(0.1, wall) };
    let outer = Ring { low: outer.low.max(0.02), ..outer };
    let rings = vec![
        outer,
        outer.moved(0.04, Material::Timber),
        frame.moved(0.04, Material::Timber),
        frame.moved(-0.18, Material::Timber),
        frame.moved(-0.18, Material::Wood).grown(-0.06, Material::Wood),
        frame.grown(-0.06, Material::Wood).moved(-0.23, Material::Wood),
    ];
    (rings, Material::Glass)
}

impl House {
    /// Local x along the street, front at +z, y = 0 on the ground.
    fn solid(&self, seed: u64) -> Solid {
        let mut random = Random::new(seed, self.stream);
        let mut solid = Solid::new();
        let half = self.plot.half;
        let footprint = Footprint { x: [-half.x, half.x], z: [-half.y, half.y] };
        let wall = random.pick(&[
            Material::Plaster,
            Material::Plaster,
            Material::Ochre,
            Material::Sandstone,
        ]);
        let tile = if random.chance(0.75) { Material::Tile } else { Material::Slate };
        let storeys = 1 + random.below(3).min(1) + usize::from(random.chance(0.25));
        let column =
            |length: f64, r: &mut Random| (length / r.between(1.8, 2.5)).round().max(2.0) as usize;
        let (front, side) = (column(2.0 * half.x, &mut random), column(2.0 * half.y, &mut random));
        let walls = Walls::new(footprint, [front, side, front, side]);
        walls.floor(&mut solid, Material::Rubble, -0.5);
        // A plinth of rubble, then storeys.
        walls.profile(
            &mut solid,
            Material::Rubble,
            &[(-0.5, 0.0), (-0.45, 0.12), (0.3, 0.12), (0.38, 0.0)],
        );
        let mut y = 0.38;
        for s in 0..storeys {
            let height = random.between(2.4, 2.8);
            let door = random.below(front);
            let some = random.between(0.65, 0.95);
            walls.row(&mut solid, (y, y + height), |side, k, width| {
                let entrance = s == 0 && side == 0 && k == door;
                if !entrance && !random.chance(some) {
                    return (vec![], wall);
                }
                let beside = if entrance { (0.5 * width - 0.5).max(0.2) } else { 0.28 * width };
                let (low, high) = if entrance { (0.06, 0.35) } else { (0.85, 0.4) };
                let frame =
                    Ring { left: beside, right: beside, low, high, out: 0.0, material: wall };
                let (rings, pane) = opening(wall, frame);
                (rings, if entrance { Material::Door } else { pane })
            });
            self.timber(&mut solid, &walls, (front, side), (y, height), &mut random);
            y += height;
            // The next storey starts on a sill.
            if s + 1 < storeys {
                walls.profile(
                    &mut solid,
                    Material::Timber,
                    &[(y, 0.0), (y + 0.02, 0.1), (y + 0.2, 0.1), (y + 0.22, 0.0)],
                );
                y += 0.22;
            }
        }
        let along_x = half.x >= half.y || random.chance(0.3);
        let (run, span) = if along_x { (half.x, half.y) } else { (half.y, half.x) };
        let rise = span * random.between(0.95, 1.35);
        walls.gable(&mut solid, wall, Material::Timber, (y, y + rise), along_x);
        let courses = 9 + random.below(5);
        roof(&mut solid, tile, (run + 0.28, span, rise, y), courses, along_x);
        // Chimney through the roof.
        let (cx, cz) = (random.between(-0.6, 0.6) * run, random.between(0.2, 0.5) * span);
        let at = if along_x { DVec3::new(cx, 0.0, cz) } else { DVec3::new(cz, 0.0, cx) };
        let chimney = Footprint { x: [at.x - 0.35, at.x + 0.35], z: [at.z - 0.35, at.z + 0.35] };
        let top = y + rise + random.between(0.5, 1.0);
        let stack = Walls::new(chimney, [1; 4]);
        stack.floor(&mut solid, Material::RedBrick, y + 0.1);
        let loops = [
            (y + 0.1, 0.0),
            (top - 0.25, 0.0),
            (top - 0.2, 0.07),
            (top, 0.07),
            (top, -0.12),
            (top - 0.5, -0.12),
        ];
        stack.profile(&mut solid, Material::RedBrick, &loops);
        stack.roof(&mut solid, Material::Rubber, (top - 0.5, -0.12));
        solid
    }

    /// Posts on the column lines and braces of a half-timbered storey.
    fn timber(
        &self,
        solid: &mut Solid,
        walls: &Walls,
        (front, side): (usize, usize),
        (y, height): (f64, f64),
        random: &mut Random,
    ) {
        for s in 0..4 {
            let n = if s % 2 == 0 { front } else { side };
            for k in 0..n {
                // Each post a little different, so that no two boxes share an edge.
                let w = random.between(0.07, 0.1);
                let (low, high) =
                    (y - random.between(0.01, 0.03), y + height + random.between(0.01, 0.03));
                let out = (-0.1, random.between(0.02, 0.032));
                let shift = if k == 0 { random.between(0.1, 0.12) } else { 0.0 };
                walls.cell_box(
                    solid,
                    Material::Timber,
                    (s, k),
                    (shift - w, shift + w),
                    (low, high),
                    out,
                );
            }
        }
    }
}

/// A closed roof of two slopes in courses, `run` half long along the ridge; `span` half wide without
/// the eaves; the wall's top at `y`.
fn roof(
    solid: &mut Solid,
    tile: Material,
    (run, span, rise, y): (f64, f64, f64, f64),
    courses: usize,
    along_x: bool,
) {
    // Section: u across the ridge, v up. The lower chain is a plain inverted V above the gable.
    let slope = rise / span;
    let eave = span + 0.45;
    let surface = |u: f64| y + rise + 0.04 - slope * u.abs();
    let (mut lower, mut upper) = (vec![], vec![]);
    let lift = 0.2;
    let step = 0.035;
    for k in 0..=courses {
        let u = eave * (k as f64 / courses as f64 - 1.0);
        // Every course starts above the end of the one below it.
        if k > 0 {
            lower.push((u - 0.012, surface(u - 0.012)));
            upper.push((
                u - 0.012,
                surface(u - 0.012) + lift - if k == courses { 0.0 } else { step },
            ));
        }
        if k < courses {
            lower.push((u, surface(u)));
            upper.push((u, surface(u) + lift));
        }
    }
    // Without the point at the ridge the slopes mirror each other.
    lower.pop();
    upper.pop();
    let mirror = |chain: &mut Vec<(f64, f64)>, ridge: (f64, f64)| {
        let right: Vec<_> = chain.iter().rev().map(|&(u, v)| (-u, v)).collect();
        chain.push(ridge);
        chain.extend(right);
    };
    mirror(&mut lower, (0.0, surface(0.0)));
    mirror(&mut upper, (0.0, surface(0.0) + lift + 0.05));
    solid.extrude(
        &lower,
        &upper,
        tile,
        |_| tile,
        |(u, v), far| {
            let w = if far { -run } else { run };
            // Near is +z with u along +x, or near is +x with u along -z.
            if along_x { DVec3::new(w, v, -u) } else { DVec3::new(u, v, w) }
        },
    );
}

/// The church: nave along x, a tower with a spire at its -x end, buttresses. On a plot of 44 m by 24 m.
fn church() -> Solid {
    let mut solid = Solid::new();
    let stone = Material::Limestone;
    let nave = Footprint { x: [-12.0, 20.0], z: [-7.0, 7.0] };
    let walls = Walls::new(nave, [8, 3, 8, 3]);
    walls.floor(&mut solid, stone, -0.6);
    walls.profile(&mut solid, stone, &[(-0.6, 0.0), (-0.5, 0.3), (0.6, 0.3), (0.8, 0.0)]);
    walls.row(&mut solid, (0.8, 10.5), |side, _, width| {
        if side == 3 {
            return (vec![], stone);
        }
        let frame = Ring {
            left: 0.33 * width,
            right: 0.33 * width,
            low: 2.0,
            high: 1.8,
            out: 0.0,
            material: stone,
        };
        let inner = frame.grown(-0.3, stone);
        let rings = vec![
            frame.grown(0.3, stone),
            frame.moved(0.12, Material::Trim).grown(0.2, Material::Trim),
            frame.moved(-0.2, stone),
            inner.moved(-0.5, stone),
        ];
        (rings, Material::BlueGlass)
    });
    walls.profile(&mut solid, stone, &[(10.5, 0.0), (10.7, 0.35), (11.1, 0.35), (11.1, 0.0)]);
    walls.gable(&mut solid, stone, Material::Timber, (11.1, 20.0), true);
    let mut cover = Solid::new();
    roof(&mut cover, Material::Slate, (16.3, 7.0, 8.9, 11.1), 26, true);
    solid.append(&cover, DVec3::new(4.0, 0.0, 0.0));
    for k in 0..9 {
        let x = -12.0 + 4.0 * f64::from(k) + if k == 0 { 0.4 } else { 0.0 }
            - if k == 8 { 0.4 } else { 0.0 };
        for side in [-1.0, 1.0] {
            solid.hexahedron(stone, |right, top, front| {
                let near = 6.8 * side;
                let far = if top { 7.5 } else { 8.6 } * side;
                let (low, high) = if side > 0.0 { (near, far) } else { (far, near) };
                let x = x + if right { 0.35 } else { -0.35 };
                DVec3::new(x, if top { 8.6 } else { -0.4 }, if front { high } else { low })
            });
        }
    }
    let tower = Footprint { x: [-20.0, -11.4], z: [-4.3, 4.3] };
    let walls = Walls::new(tower, [2; 4]);
    walls.floor(&mut solid, stone, -0.7);
    let mut y = -0.7;
    for storey in 0..4 {
        let top = 7.5 * f64::from(storey + 1);
        walls.row(&mut solid, (y, top), |side, _, width| {
            if side == 1 && storey < 2 {
                return (vec![], stone);
            }
            let frame = Ring {
                left: 0.34 * width,
                right: 0.34 * width,
                low: 2.2,
                high: 1.5,
                out: 0.0,
                material: stone,
            };
            let rings = vec![
                frame.grown(0.2, stone),
                frame.moved(0.1, Material::Trim).grown(0.15, Material::Trim),
                frame.moved(-0.5, stone),
            ];
            (rings, if storey == 3 { Material::Timber } else { Material::Glass })
        });
        walls.profile(
            &mut solid,
            stone,
            &[(top, 0.0), (top + 0.1, 0.25), (top + 0.4, 0.25), (top + 0.45, 0.0)],
        );
        y = top + 0.45;
    }
    let edge = [(y, 0.0), (y + 0.2, 0.5), (y + 0.7, 0.5), (y + 0.8, -0.2)];
    walls.profile(&mut solid, stone, &edge);
    walls.profile(
        &mut solid,
        Material::Slate,
        &[(y + 0.8, -0.2), (y + 9.0, -2.4), (y + 19.0, -4.1)],
    );
    walls.roof(&mut solid, Material::Slate, (y + 19.0, -4.1));
    let top = DVec3::new(-15.7, y + 19.0, 0.0);
    solid.cuboid(
        Material::DarkMetal,
        top - DVec3::new(0.06, 0.3, 0.06),
        top + DVec3::new(0.06, 2.2, 0.06),
    );
    solid.cuboid(
        Material::DarkMetal,
        top + DVec3::new(-0.05, 1.3, -0.6),
        top + DVec3::new(0.05, 1.45, 0.6),
    );
    solid
}

/// A round tower of the wall: crenels all round, a cone of slate.
fn tower() -> Solid {
    let mut solid = Solid::new();
    let stone = Material::Rubble;
    solid.frustum(stone, DVec3::ZERO, (-0.8, 3.3), (8.6, 3.0), 16);
    solid.frustum(stone, DVec3::ZERO, (8.4, 3.45), (9.6, 3.5), 16);
    for (s, c) in circle(12) {
        let (out, side) = (DVec3::new(s, 0.0, c), DVec3::new(c, 0.0, -s));
        let p = 3.2 * out;
        solid.beam(stone, p + DVec3::Y * 9.5, p + DVec3::Y * 10.5, 0.22 * out, 0.4 * side);
    }
    solid.frustum(Material::Slate, DVec3::ZERO, (9.55, 2.7), (13.5, 0.0), 16);
    solid
}

/// A piece of the wall along x, with a gateway for the high street or without.
fn wall_piece(half: f64, gate: bool) -> Solid {
    let mut solid = Solid::new();
    let stone = Material::Rubble;
    let opening = FREE_HALF_WIDTH + 0.6;
    if gate && half > opening + 0.5 {
        for side in [-1.0, 1.0] {
            let (p, q) =
                (DVec3::new(side * opening, -0.8, -0.9), DVec3::new(side * half, 6.0, 0.9));
            solid.cuboid(stone, p, q);
        }
        let wide = opening + 1.5;
        solid.cuboid(stone, DVec3::new(-wide, 5.4, -1.3), DVec3::new(wide, 8.2, 1.3));
    } else if !gate {
        solid.cuboid(stone, DVec3::new(-half, -0.8, -0.9), DVec3::new(half, 6.0, 0.9));
    }
    if !gate || half > opening + 0.5 {
        let n = (half / 0.9) as usize;
        for k in 0..n {
            let x = half * ((2.0 * k as f64 + 1.0) / n as f64 - 1.0);
            if gate && x.abs() < opening + 0.8 {
                continue;
            }
            solid.cuboid(stone, DVec3::new(x - 0.5, 5.9, 0.45), DVec3::new(x + 0.5, 7.0, 0.88));
        }
    }
    solid
}

/// A low shrub of 30 leaves.
fn shrub(random: &mut Random) -> Solid {
    let mut solid = Solid::new();
    for _ in 0..30 {
        let d = vegetation::direction(random);
        let center = DVec3::new(0.45 * d.x, 0.42 + 0.36 * d.y, 0.45 * d.z);
        let side = vegetation::direction(random).cross(d).normalize();
        let up = d.cross(side);
        let size = 0.12;
        let corner = |a: f64, b: f64| center + size * (a * side + b * up);
        solid.quad(
            Material::DarkLeaf,
            [corner(0.0, -1.3), corner(0.7, 0.0), corner(0.0, 1.3), corner(-0.7, 0.0)],
        );
    }
    solid
}
