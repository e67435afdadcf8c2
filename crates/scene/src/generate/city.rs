//! A city of `n x n` blocks, n even, about the origin.
//!
//! Layout: streets along z at the x of [`Axis::streets`], streets along x likewise; the street with number
//! n / 2 of either axis is centred on 0 and 20 m wide between the buildings. A block is a slab of pavement,
//! 0.15 m high, with two rows of buildings that face the streets along z, wall to wall, and a
//! yard between the rows.
//!
//! Detail is bought: the layout is made first, with blank facades, then window rows are raised
//! from level to level in an order of priority until the triangle count is reached. Levels of an
//! opening: 0 wall, 1 recess, 2 stone surround, 3 sash, 4 glazing bars, 5 balcony.

use glam::DVec3;

use super::Made;
use super::facade::{Footprint, Ring, Walls};
use super::glb_writer::{Document, MeshKey, NodeKey, Placement};
use super::material::Material;
use super::random::Random;
use super::solid::Solid;
use super::vegetation;

/// Height of the pavement above the roadway.
const KERB: f64 = 0.15;
/// Half of the free width of the street at x = 0: parked cars begin behind it.
const FREE_HALF_WIDTH: f64 = 5.0;
/// Triangles of an opening at each level; level 5 is level 4 and a balcony on every other one.
const CELL_TRIANGLES: [u64; 6] = [2, 18, 34, 50, 74, 74];
const BALCONY_TRIANGLES: u64 = 48;
/// Share of the triangles that goes into cars, lamps, benches and trees.
const FURNITURE_SHARE: f64 = 0.2;

// Streams of random numbers.
const LAYOUT: u64 = 1;
const FURNITURE: u64 = 2;
const MODELS: u64 = 3;
const BUILDINGS: u64 = 1 << 32;

/// The streets and blocks along one axis.
struct Axis {
    /// Centre and width of every street, ascending; one more than blocks.
    streets: Vec<(f64, f64)>,
}

fn pavement(street_width: f64) -> f64 {
    if street_width >= 14.0 { 3.0 } else { 2.0 }
}

impl Axis {
    fn new(n: usize, block: (f64, f64), random: &mut Random) -> Self {
        let widths: Vec<f64> = (0..=n)
            .map(|k| {
                if k == n / 2 {
                    20.0
                } else {
                    random.pick(&[10.0, 12.0, 14.0, 16.0, 16.0, 18.0, 22.0, 30.0])
                }
            })
            .collect();
        let mut streets = vec![(0.0, 20.0); n + 1];
        for k in n / 2 + 1..=n {
            let pitch =
                random.between(block.0, block.1).round() + 0.5 * (widths[k - 1] + widths[k]);
            streets[k] = (streets[k - 1].0 + pitch, widths[k]);
        }
        for k in (0..n / 2).rev() {
            let pitch =
                random.between(block.0, block.1).round() + 0.5 * (widths[k + 1] + widths[k]);
            streets[k] = (streets[k + 1].0 - pitch, widths[k]);
        }
        Self { streets }
    }

    /// Building lines of block `k`.
    fn buildable(&self, k: usize) -> [f64; 2] {
        let ((a, wa), (b, wb)) = (self.streets[k], self.streets[k + 1]);
        [a + 0.5 * wa, b - 0.5 * wb]
    }

    /// Kerbs of block `k`.
    fn kerbs(&self, k: usize) -> [f64; 2] {
        let [lo, hi] = self.buildable(k);
        [lo - pavement(self.streets[k].1), hi + pavement(self.streets[k + 1].1)]
    }

    fn extent(&self) -> [f64; 2] {
        let (first, last) = (self.streets[0], self.streets[self.streets.len() - 1]);
        [first.0 - 0.5 * first.1, last.0 + 0.5 * last.1]
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Style {
    Brick,
    Stone,
    Concrete,
    Curtain,
}

impl Style {
    fn max_level(self) -> u8 {
        match self {
            Self::Brick => 5,
            Self::Stone => 4,
            Self::Concrete => 3,
            Self::Curtain => 2,
        }
    }
}

/// A storey: its height and level of detail.
#[derive(Clone, Copy)]
struct Storey {
    height: f64,
    level: u8,
}

/// A box of storeys.
struct Tier {
    footprint: Footprint,
    base: f64,
    storeys: Vec<Storey>,
    columns: [usize; 4],
    /// Sides with windows; the others are party walls of one column.
    open: [bool; 4],
}

impl Tier {
    fn top(&self) -> f64 {
        self.base + self.storeys.iter().map(|s| s.height).sum::<f64>()
    }

    fn open_cells(&self) -> u64 {
        (0..4).filter(|&s| self.open[s]).map(|s| self.columns[s] as u64).sum()
    }

    /// Balconies of a storey at level 5: every other column of the open sides along z.
    fn balconies(&self) -> u64 {
        [1, 3].iter().filter(|&&s| self.open[s]).map(|&s| (self.columns[s] / 2) as u64).sum()
    }

    /// Triangles that raising storey `k` to `level` from the level below adds.
    fn step_cost(&self, level: u8) -> u64 {
        let l = usize::from(level);
        let cells = self.open_cells() * (CELL_TRIANGLES[l] - CELL_TRIANGLES[l - 1]);
        cells + if level == 5 { BALCONY_TRIANGLES * self.balconies() } else { 0 }
    }
}

struct Building {
    block: [usize; 2],
    number: usize,
    /// World position of the local origin, on the pavement.
    origin: DVec3,
    tiers: Vec<Tier>,
    style: Style,
    wall: Material,
    /// The side with the door: 1 or 3.
    front: usize,
    stream: u64,
}

struct Layout {
    x: Axis,
    z: Axis,
    blocks: usize,
    buildings: Vec<Building>,
    parks: Vec<[usize; 2]>,
}

/// How coarse a city is, from the triangles that it has for a block.
#[derive(Clone, Copy)]
struct Measure {
    /// Factors on heights, sizes of blocks, frontages and widths of window columns.
    height: f64,
    block: f64,
    frontage: f64,
    column: f64,
    /// Windows to the yards too.
    rear_windows: bool,
}

impl Measure {
    fn of(triangles_a_block: f64) -> Self {
        const RICH: f64 = 19_000.0;
        let poverty = RICH / triangles_a_block;
        Self {
            height: 1.0,
            block: libm::pow(poverty, -0.2),
            frontage: libm::pow(poverty, 0.45),
            column: libm::pow(poverty, 0.25),
            rear_windows: triangles_a_block > 12_000.0,
        }
    }
}

/// Makes a city of about `triangles` triangles.
pub(super) fn make(triangles: u64, seed: u64) -> Made {
    // Larger cities have richer blocks: 5,000 triangles a block for a handful, 19,000 for hundreds.
    let t = triangles as f64;
    let a_block = (5_500.0 * libm::pow(t / 200_000.0, 0.43)).clamp(5_000.0, 19_000.0);
    let blocks = 2 * ((t / a_block).sqrt() / 2.0).round().max(1.0) as usize;

    let wanted = |share: f64| (share * t) as u64;
    let mut measure = Measure::of(a_block);
    let mut layout = Layout::new(blocks, measure, seed);
    // Windows for every open side must leave room for detail, and full detail must reach the count.
    for _ in 0..12 {
        let (recessed, full) = layout.cost_range(seed);
        if recessed > wanted(0.74) {
            measure.height *= 0.86;
        } else if full < wanted(0.85) {
            measure.height *= 1.2;
        } else {
            break;
        }
        layout = Layout::new(blocks, measure, seed);
    }

    let mut document = Document::new();
    let root = document.node(None, "city", None, Placement::IDENTITY);
    let ground = document.mesh("ground", &layout.ground());
    document.node(Some(root), "ground", Some(ground), Placement::IDENTITY);
    let block_nodes: Vec<Vec<NodeKey>> = (0..blocks)
        .map(|i| {
            (0..blocks)
                .map(|j| {
                    let at = Placement::at(layout.block_origin([i, j]));
                    document.node(Some(root), format!("block_{i}_{j}"), None, at)
                })
                .collect()
        })
        .collect();
    place_furniture(&mut document, &layout, &block_nodes, wanted(FURNITURE_SHARE), seed);
    layout.buy_detail(triangles.saturating_sub(document.triangles()), seed);
    for b in &layout.buildings {
        let name = format!("block_{}_{}/building_{}", b.block[0], b.block[1], b.number);
        let mesh = document.mesh(name.clone(), &b.solid(seed));
        let at = Placement::at(b.origin - layout.block_origin(b.block));
        document.node(Some(block_nodes[b.block[0]][b.block[1]]), name, Some(mesh), at);
    }
    let [z0, z1] = layout.z.extent();
    let half = (0.4 * (z1 - z0)).min(244.5).floor();
    let half = if half >= 244.0 { 244.5 } else { half };
    Made {
        document,
        suggested_region: [-FREE_HALF_WIDTH, -half, FREE_HALF_WIDTH, half],
        suggested_eye_height: [1.5, 1.8],
    }
}

impl Layout {
    fn new(blocks: usize, measure: Measure, seed: u64) -> Self {
        let mut random = Random::new(seed, LAYOUT);
        let block = measure.block;
        let x = Axis::new(blocks, (56.0 * block, 72.0 * block), &mut random);
        let z = Axis::new(blocks, (60.0 * block, 86.0 * block), &mut random);
        let mut layout = Self { x, z, blocks, buildings: vec![], parks: vec![] };
        for i in 0..blocks {
            for j in 0..blocks {
                // No park beside the street of x = 0 in a small city: it would be the whole view.
                if blocks > 4 && random.chance(0.05) {
                    layout.parks.push([i, j]);
                } else {
                    layout.fill_block([i, j], measure, &mut random);
                }
            }
        }
        layout
    }

    fn block_origin(&self, [i, j]: [usize; 2]) -> DVec3 {
        let ([x0, x1], [z0, z1]) = (self.x.buildable(i), self.z.buildable(j));
        DVec3::new((0.5 * (x0 + x1)).round(), 0.0, (0.5 * (z0 + z1)).round())
    }

    fn fill_block(&mut self, [i, j]: [usize; 2], measure: Measure, random: &mut Random) {
        let ([x0, x1], [z0, z1]) = (self.x.buildable(i), self.z.buildable(j));
        // 0 in the middle of the city, 1 at its rim.
        let half = self.blocks as f64 / 2.0;
        let off = |k: usize| (k as f64 + 0.5 - half) / half;
        let rim = (off(i) * off(i) + off(j) * off(j)).min(1.0);
        let mut number = 0;
        for west in [true, false] {
            let depth = 0.5 * (x1 - x0) - random.between(1.5, 4.0);
            let mut z = z0;
            while z1 - z > 1.0 {
                let mut frontage = measure.frontage * random.between(14.0, 26.0);
                // A remainder that is too narrow for a house goes to this one.
                if z1 - (z + frontage) < 12.0 * measure.frontage {
                    frontage = z1 - z;
                }
                let depth = depth * random.between(0.72, 1.0);
                let front_gap = random.between(0.0, 0.5);
                let x =
                    if west { [x0 + front_gap, x0 + depth] } else { [x1 - depth, x1 - front_gap] };
                // Neighbours overlap by some centimetres: no slit between them.
                let overlap = random.between(0.02, 0.05);
                let corner = [z <= z0, z + frontage >= z1];
                let lot_z = [
                    z + if corner[0] { random.between(0.0, 0.4) } else { -overlap },
                    z + frontage - if corner[1] { random.between(0.0, 0.4) } else { 0.0 },
                ];
                let building = self.building(
                    [i, j],
                    number,
                    (x, lot_z),
                    (west, corner),
                    (rim, measure),
                    random,
                );
                self.buildings.push(building);
                number += 1;
                z += frontage;
            }
        }
    }

    fn building(
        &self,
        block: [usize; 2],
        number: usize,
        (x, z): ([f64; 2], [f64; 2]),
        (west, corner): (bool, [bool; 2]),
        (rim, measure): (f64, Measure),
        random: &mut Random,
    ) -> Building {
        let central = 1.0 - rim;
        let big = (self.blocks as f64 / 14.0).min(1.0);
        // A poorer city has fewer towers, not as much lower ones.
        let tower = random.chance((0.03 + 0.16 * central * central) * measure.height.max(0.5));
        let height = if tower {
            random.between(50.0, 95.0) + 130.0 * big * central * random.between(0.3, 1.0)
        } else {
            random.between(12.0, 24.0) + 22.0 * central * random.unit()
        };
        let scale = if tower { measure.height.sqrt() } else { measure.height };
        let height = (height * scale).clamp(10.5, 198.0);
        let style = match (tower, random.unit()) {
            (true, u) if u < 0.6 => Style::Curtain,
            (_, u) if u < 0.45 => Style::Brick,
            (_, u) if u < 0.75 => Style::Stone,
            _ => Style::Concrete,
        };
        let wall = match style {
            Style::Brick => {
                random.pick(&[Material::RedBrick, Material::BrownBrick, Material::Ochre])
            }
            Style::Stone => random.pick(&[Material::Sandstone, Material::Limestone]),
            Style::Concrete => random.pick(&[Material::Concrete, Material::Plaster]),
            Style::Curtain => random.pick(&[Material::DarkPanel, Material::Metal]),
        };
        let (storey, cell) = match style {
            Style::Brick => (3.1, random.between(2.6, 3.4)),
            Style::Stone => (3.5, random.between(2.9, 3.8)),
            Style::Concrete => (3.3, random.between(3.6, 4.8)),
            Style::Curtain => (3.8, random.between(4.0, 5.5)),
        };
        let cell = cell * measure.column;
        let center = DVec3::new(0.5 * (x[0] + x[1]), KERB, 0.5 * (z[0] + z[1]));
        let local = Footprint { x: x.map(|v| v - center.x), z: z.map(|v| v - center.z) };
        let columns = |footprint: Footprint, open: [bool; 4]| {
            std::array::from_fn(|s| {
                if open[s] { (footprint.length(s) / cell).round().max(2.0) as usize } else { 1 }
            })
        };
        let (high, rear) = (height > 45.0, measure.rear_windows);
        let open =
            [corner[1] || high, !west || high || rear, corner[0] || high, west || high || rear];
        let mut floors = ((height - 4.2) / storey).floor().max(2.0) as usize;
        let ground = Storey { height: random.between(3.9, 4.6), level: 0 };
        let mut tiers = vec![];
        let mut footprint = local;
        let mut base = 0.0;
        // Tall buildings step back, once or twice.
        for step in 0..3 {
            let here = if step < 2 && floors > 14 {
                (floors as f64 * random.between(0.35, 0.7)) as usize
            } else {
                floors
            };
            floors -= here;
            let mut storeys = vec![Storey { height: storey, level: 0 }; here];
            if step == 0 {
                storeys.insert(0, ground);
            }
            let open = if step == 0 { open } else { [true; 4] };
            let tier = Tier { footprint, base, storeys, columns: columns(footprint, open), open };
            base = tier.top();
            tiers.push(tier);
            footprint = footprint.shrunk(random.between(1.6, 3.4));
            if floors == 0 || footprint.length(0).min(footprint.length(1)) < 8.0 {
                break;
            }
        }
        let stream =
            BUILDINGS + ((block[0] as u64) << 20) + ((block[1] as u64) << 8) + number as u64;
        let front = if west { 3 } else { 1 };
        Building { block, number, origin: center, tiers, style, wall, front, stream }
    }

    /// Triangles with recessed windows, and with all the detail there is, furniture not counted.
    fn cost_range(&self, seed: u64) -> (u64, u64) {
        let blank: u64 = self.buildings.iter().map(|b| b.solid(seed).triangle_count()).sum();
        let blank = blank + self.ground().triangle_count();
        let raised = |highest: fn(&Building) -> u8| -> u64 {
            let tiers = self.buildings.iter().flat_map(|b| b.tiers.iter().map(move |t| (b, t)));
            tiers
                .map(|(b, t)| {
                    let steps = (1..=highest(b)).map(|l| t.step_cost(l)).sum::<u64>();
                    steps * t.storeys.len() as u64
                })
                .sum()
        };
        (blank + raised(|_| 1), blank + raised(|b| b.style.max_level()))
    }

    /// Raises levels of detail until the buildings have `budget` triangles.
    fn buy_detail(&mut self, budget: u64, seed: u64) {
        let blank: u64 = self.buildings.iter().map(|b| b.solid(seed).triangle_count()).sum();
        let mut left = budget.saturating_sub(blank);
        // Recesses for everyone come first; then some buildings are richer than others.
        let mut wishes = vec![];
        for (k, b) in self.buildings.iter().enumerate() {
            let mut random = Random::new(seed, b.stream ^ (1 << 60));
            for level in 1..=b.style.max_level() {
                let taste = random.unit();
                let rank = if level == 1 { taste } else { f64::from(level) + 2.5 * taste };
                wishes.push((rank, k, level));
            }
        }
        wishes.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        for (_, k, level) in wishes {
            for tier in &mut self.buildings[k].tiers {
                let cost = tier.step_cost(level);
                for s in 0..tier.storeys.len() {
                    // Street level has no balconies, so level 5 of it would cost nothing.
                    let balcony_at_street = level == 5 && s == 0 && tier.base == 0.0;
                    if cost <= left && tier.storeys[s].level + 1 == level && !balcony_at_street {
                        tier.storeys[s].level = level;
                        left -= cost;
                    }
                }
            }
        }
    }

    /// The ground: roadways at y = 0 with a painted centre line, kerbs, and the blocks' slabs.
    fn ground(&self) -> Solid {
        /// What lies between two neighbouring grid lines.
        #[derive(Clone, Copy, PartialEq)]
        enum Strip {
            Block(usize),
            Lane,
            Line,
        }
        const MARGIN: f64 = 40.0;
        let strips = |axis: &Axis| {
            let n = axis.streets.len() - 1;
            let [lo, hi] = axis.extent();
            let (mut lines, mut kinds) = (vec![lo - MARGIN], vec![]);
            for (k, &(center, _)) in axis.streets.iter().enumerate() {
                kinds.push(Strip::Lane);
                lines.push(center - 0.09);
                kinds.push(Strip::Line);
                lines.push(center + 0.09);
                kinds.push(Strip::Lane);
                if k < n {
                    lines.extend(axis.kerbs(k));
                    kinds.push(Strip::Block(k));
                }
            }
            lines.push(hi + MARGIN);
            (lines, kinds)
        };
        let ((xs, x_kinds), (zs, z_kinds)) = (strips(&self.x), strips(&self.z));
        let mut solid = Solid::new();
        for (i, &kind_x) in x_kinds.iter().enumerate() {
            for (j, &kind_z) in z_kinds.iter().enumerate() {
                let (y, material) = match (kind_x, kind_z) {
                    (Strip::Block(a), Strip::Block(b)) if self.parks.contains(&[a, b]) => {
                        (KERB, Material::Yard)
                    }
                    (Strip::Block(_), Strip::Block(_)) => (KERB, Material::Pavement),
                    (Strip::Line, Strip::Block(_)) | (Strip::Block(_), Strip::Line) => {
                        (0.0, Material::Paint)
                    }
                    _ => (0.0, Material::Asphalt),
                };
                let (x, z) = ([xs[i], xs[i + 1]], [zs[j], zs[j + 1]]);
                let at = |a: usize, y: f64, b: usize| DVec3::new(x[a], y, z[b]);
                solid.quad(material, [at(0, y, 1), at(1, y, 1), at(1, y, 0), at(0, y, 0)]);
                if y > 0.0 {
                    let around = [(0, 1), (1, 1), (1, 0), (0, 0)];
                    for k in 0..4 {
                        let ((a, b), (c, d)) = (around[k], around[(k + 1) % 4]);
                        let wall = [at(a, 0.0, b), at(c, 0.0, d), at(c, y, d), at(a, y, b)];
                        solid.quad(Material::Limestone, wall);
                    }
                }
            }
        }
        solid
    }
}

impl Building {
    /// The building's mesh, in its own space: y = 0 on the pavement.
    fn solid(&self, seed: u64) -> Solid {
        let mut random = Random::new(seed, self.stream);
        let mut solid = Solid::new();
        let trim = match self.style {
            Style::Brick => Material::Trim,
            Style::Stone => Material::Limestone,
            Style::Concrete | Style::Curtain => self.wall,
        };
        let last = self.tiers.len() - 1;
        for (t, tier) in self.tiers.iter().enumerate() {
            let walls = Walls::new(tier.footprint, tier.columns);
            let sunk = tier.base - 0.35;
            walls.floor(&mut solid, self.wall, sunk);
            let look = Look::new(self.style, &mut random);
            let mut y = tier.base;
            for (s, storey) in tier.storeys.iter().enumerate() {
                let (low, top) = (if s == 0 { sunk } else { y }, y + storey.height);
                let street = s == 0 && tier.base == 0.0;
                let door = tier.columns[self.front] / 2;
                walls.row(&mut solid, (low, top), |side, k, width| {
                    if !tier.open[side] || storey.level == 0 {
                        return (vec![], self.wall);
                    }
                    let entrance = street && side == self.front && k == door;
                    let shop = street && side == self.front;
                    look.opening(self.wall, trim, (width, y - low, storey), (entrance, shop))
                });
                if storey.level >= 4 {
                    self.details(&mut solid, &walls, tier, &look, (y, s, storey));
                }
                y = top;
                if street {
                    let out = if self.style == Style::Curtain { 0.05 } else { 0.14 };
                    walls.profile(
                        &mut solid,
                        trim,
                        &[(y, 0.0), (y, out), (y + 0.28, out), (y + 0.28, 0.0)],
                    );
                    y += 0.28;
                }
            }
            // Cornice, parapet, roof.
            let out =
                if self.style == Style::Stone || self.style == Style::Brick { 0.45 } else { 0.08 };
            let parapet = if t == last { 1.0 } else { 0.7 };
            walls.profile(
                &mut solid,
                trim,
                &[(y, 0.0), (y + 0.15, out), (y + 0.5, out), (y + 0.5, 0.02)],
            );
            walls.profile(
                &mut solid,
                self.wall,
                &[
                    (y + 0.5, 0.02),
                    (y + 0.5 + parapet, 0.02),
                    (y + 0.5 + parapet, -0.28),
                    (y + 0.1, -0.28),
                ],
            );
            walls.roof(&mut solid, Material::Roof, (y + 0.1, -0.28));
            if t == last {
                self.roof_structures(&mut solid, tier.footprint.shrunk(1.0), y + 0.1, &mut random);
            }
        }
        solid
    }

    /// Glazing bars and balconies of a storey.
    fn details(
        &self,
        solid: &mut Solid,
        walls: &Walls,
        tier: &Tier,
        look: &Look,
        (y, s, storey): (f64, usize, &Storey),
    ) {
        let street = s == 0 && tier.base == 0.0;
        let door = tier.columns[self.front] / 2;
        for side in (0..4).filter(|&s| tier.open[s]) {
            let width = walls.width(side);
            for k in 0..tier.columns[side] {
                let entrance = street && side == self.front && k == door;
                let pane =
                    look.frame((width, 0.0, storey), (entrance, street && side == self.front));
                let (a, b) = (pane.left + 0.05, width - pane.right - 0.05);
                let (low, high) = (y + pane.low + 0.05, y + storey.height - pane.high - 0.05);
                let depth = (-look.depth - 0.08, -look.depth + 0.012);
                let (middle, bar) = (0.5 * (a + b), low + 0.58 * (high - low));
                walls.cell_box(
                    solid,
                    Material::Frame,
                    (side, k),
                    (middle - 0.03, middle + 0.03),
                    (low, high),
                    depth,
                );
                let depth = (depth.0 - 0.003, depth.1 - 0.004);
                walls.cell_box(
                    solid,
                    Material::Frame,
                    (side, k),
                    (a + 0.004, b - 0.004),
                    (bar - 0.025, bar + 0.03),
                    depth,
                );
                if storey.level == 5 && !street && (side == 1 || side == 3) && k % 2 == 1 {
                    let (a, b) = (0.06 * width, 0.94 * width);
                    let cell = (side, k);
                    walls.cell_box(
                        solid,
                        Material::Concrete,
                        cell,
                        (a, b),
                        (y - 0.02, y + 0.16),
                        (-0.1, 1.05),
                    );
                    walls.cell_box(
                        solid,
                        Material::DarkMetal,
                        cell,
                        (a + 0.03, b - 0.03),
                        (y + 0.14, y + 1.1),
                        (0.96, 1.01),
                    );
                    walls.cell_box(
                        solid,
                        Material::DarkMetal,
                        cell,
                        (a + 0.02, a + 0.06),
                        (y + 0.13, y + 1.09),
                        (-0.08, 0.98),
                    );
                    walls.cell_box(
                        solid,
                        Material::DarkMetal,
                        cell,
                        (b - 0.06, b - 0.02),
                        (y + 0.13, y + 1.09),
                        (-0.08, 0.98),
                    );
                }
            }
        }
    }

    fn roof_structures(&self, solid: &mut Solid, area: Footprint, y: f64, random: &mut Random) {
        let spot = |random: &mut Random, half: DVec3| {
            let at = |[lo, hi]: [f64; 2], half: f64, r: &mut Random| {
                let (lo, hi) = (lo + half, hi - half);
                if lo < hi { r.between(lo, hi) } else { 0.5 * (lo + hi) }
            };
            DVec3::new(at(area.x, half.x, random), y, at(area.z, half.z, random))
        };
        // Stair head with a door leaf.
        let half = DVec3::new(random.between(1.3, 2.2), 0.0, random.between(1.3, 2.2));
        let p = spot(random, half);
        let h = random.between(2.4, 3.0);
        solid.cuboid(self.wall, p - half - DVec3::Y * 0.1, p + half + DVec3::Y * h);
        let slab = half + DVec3::new(0.15, 0.0, 0.15);
        solid.cuboid(
            Material::Roof,
            p - slab + DVec3::Y * (h - 0.07),
            p + slab + DVec3::Y * (h + 0.12),
        );
        let face = p + DVec3::new(half.x, 0.0, 0.0);
        solid.cuboid(
            Material::Door,
            face + DVec3::new(-0.06, -0.05, -0.5),
            face + DVec3::new(0.05, 2.05, 0.5),
        );
        // Cooling units: a box with a fan on legs.
        for _ in 0..1 + random.below(4) {
            let half = DVec3::new(random.between(0.5, 1.1), 0.0, random.between(0.5, 1.1));
            let p = spot(random, half);
            let h = random.between(0.8, 1.6);
            solid.cuboid(Material::Metal, p - half - DVec3::Y * 0.06, p + half + DVec3::Y * h);
            let r = 0.8 * half.x.min(half.z);
            solid.frustum(Material::DarkMetal, p, (h - 0.03, r), (h + 0.16, 0.92 * r), 8);
        }
        if self.style == Style::Brick && random.chance(0.55) {
            let r = random.between(1.2, 1.7);
            let p = spot(random, DVec3::new(r, 0.0, r));
            let tank = DVec3::Y * 2.3;
            for (sx, sz) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
                let leg = p + DVec3::new(0.55 * r * sx, 0.0, 0.55 * r * sz);
                let w = DVec3::new(0.07, 0.0, 0.07);
                solid.cuboid(
                    Material::DarkMetal,
                    leg - w - DVec3::Y * 0.06,
                    leg + w + DVec3::Y * 2.4,
                );
            }
            solid.frustum(Material::Wood, p + tank, (0.0, r), (3.0, 0.95 * r), 12);
            solid.frustum(Material::Roof, p + tank, (2.96, 1.08 * r), (4.0, 0.0), 12);
        }
        if self.tiers.len() > 1 {
            let p = spot(random, DVec3::new(0.5, 0.0, 0.5));
            solid.frustum(Material::Metal, p, (-0.1, 0.22), (random.between(6.0, 14.0), 0.05), 6);
        }
        if self.style == Style::Brick {
            let p = spot(random, DVec3::new(0.4, 0.0, 0.4));
            let w = DVec3::new(0.38, 0.0, 0.38);
            solid.cuboid(Material::BrownBrick, p - w - DVec3::Y * 0.07, p + w + DVec3::Y * 1.7);
        }
    }
}

/// Proportions of a tier's openings.
struct Look {
    /// Share of the cell's width beside a window.
    beside: f64,
    sill: f64,
    lintel: f64,
    depth: f64,
    pane: Material,
}

impl Look {
    fn new(style: Style, random: &mut Random) -> Self {
        let (beside, sill, lintel) = match style {
            Style::Brick => (random.between(0.27, 0.33), random.between(0.75, 0.95), 0.5),
            Style::Stone => (random.between(0.24, 0.31), random.between(0.6, 0.9), 0.55),
            Style::Concrete => (random.between(0.12, 0.2), random.between(0.8, 1.0), 0.45),
            Style::Curtain => (random.between(0.04, 0.07), random.between(0.3, 0.9), 0.25),
        };
        let depth = if style == Style::Curtain {
            random.between(0.08, 0.15)
        } else {
            random.between(0.18, 0.32)
        };
        let pane = if style == Style::Curtain { Material::BlueGlass } else { Material::Glass };
        Self { beside, sill, lintel, depth, pane }
    }

    /// The rectangle of the opening on the wall plane. `below` is the part of the cell under
    /// the floor of the storey.
    fn frame(
        &self,
        (width, below, storey): (f64, f64, &Storey),
        (entrance, shop): (bool, bool),
    ) -> Ring {
        let (beside, low, high) = match (entrance, shop) {
            (true, _) => ((0.5 * width - 0.75).max(0.22), 0.08, storey.height - 2.7),
            (false, true) => ((0.1 * width).max(0.22), 0.6, 0.8),
            _ => ((self.beside * width).max(0.22), self.sill, self.lintel),
        };
        Ring {
            left: beside,
            right: beside,
            low: below + low,
            high,
            out: 0.0,
            material: Material::Trim,
        }
    }

    /// The rings of an opening at the storey's level, and its pane.
    fn opening(
        &self,
        wall: Material,
        trim: Material,
        cell: (f64, f64, &Storey),
        kind: (bool, bool),
    ) -> (Vec<Ring>, Material) {
        let pane = if kind.0 { Material::Door } else { self.pane };
        let frame = self.frame(cell, kind);
        let mut rings = Vec::with_capacity(6);
        if cell.2.level >= 2 {
            let mut surround = frame.grown(0.13, wall);
            if kind.0 {
                surround.low = frame.low - 0.03;
            }
            rings.extend([surround, surround.moved(0.07, trim), frame.moved(0.07, trim)]);
        } else {
            rings.push(Ring { material: wall, ..frame });
        }
        let reveal = frame.moved(-self.depth, trim);
        rings.push(reveal);
        if cell.2.level >= 3 {
            let sash = reveal.grown(-0.07, Material::Frame);
            rings.extend([sash, sash.moved(-self.depth - 0.05, Material::Frame)]);
        }
        (rings, pane)
    }
}

/// Meshes that many nodes share.
struct Models {
    cars: Vec<MeshKey>,
    trees: Vec<MeshKey>,
    lamp: MeshKey,
    bench: MeshKey,
    bin: MeshKey,
}

impl Models {
    fn new(document: &mut Document, seed: u64) -> Self {
        let mut random = Random::new(seed, MODELS);
        let paints = [
            Material::RedCar,
            Material::WhiteCar,
            Material::BlackCar,
            Material::SilverCar,
            Material::BlueCar,
            Material::YellowCar,
        ];
        let cars = paints.iter().map(|&p| document.mesh(p.look().name, &car(p))).collect();
        let trees = (0..4)
            .map(|k| {
                let tree = vegetation::blob_tree(&mut random, 3 + k % 2);
                document.mesh(format!("street tree {k}"), &tree)
            })
            .collect();
        Self {
            cars,
            trees,
            lamp: document.mesh("lamp", &lamp()),
            bench: document.mesh("bench", &bench()),
            bin: document.mesh("bin", &bin()),
        }
    }
}

/// A parked car along z, its nose at -z, 4.4 m long and 1.7 m wide, wheels on y = 0.
fn car(paint: Material) -> Solid {
    /// The upper half of an octagonal wheel, in units of its radius; the lower half mirrors it.
    const WHEEL: [(f64, f64); 4] =
        [(-0.924, 0.383), (-0.383, 0.924), (0.383, 0.924), (0.924, 0.383)];
    let mut solid = Solid::new();
    // Side view, tail to nose: u is -z, v the height. Near is +x.
    let lower = [
        (-2.2, 0.45),
        (-1.5, 0.32),
        (-0.9, 0.3),
        (-0.2, 0.29),
        (0.5, 0.3),
        (1.4, 0.32),
        (2.2, 0.45),
    ];
    let upper = [
        (-2.18, 0.85),
        (-1.65, 0.98),
        (-1.1, 1.42),
        (-0.1, 1.46),
        (0.85, 0.98),
        (1.75, 0.86),
        (2.17, 0.7),
    ];
    let material = |edge: usize| if edge == 1 || edge == 3 { Material::Glass } else { paint };
    solid.extrude(&lower, &upper, paint, material, |(u, v), far| {
        let x = if v > 1.2 { 0.68 } else { 0.82 };
        DVec3::new(if far { -x } else { x }, v, -u)
    });
    for side in [-1.0, 1.0] {
        for (z0, z1) in [(-0.45, 0.12), (0.18, 0.85)] {
            solid.hexahedron(Material::Glass, |right, top, front| {
                let lean = if top { 0.05 * side } else { 0.0 };
                let x = 0.70 * side - lean + if right { 0.07 } else { -0.07 };
                let z = if front { z1 } else { z0 };
                DVec3::new(x, if top { 1.33 } else { 1.0 }, if top { 0.85 * z } else { z })
            });
        }
        for z in [-1.35, 1.3] {
            let radius = 0.33;
            let lower = WHEEL.map(|(u, v)| (radius * u, -radius * v));
            let upper = WHEEL.map(|(u, v)| (radius * u, radius * v));
            let rubber = Material::Rubber;
            solid.extrude(
                &lower,
                &upper,
                rubber,
                |_| rubber,
                |(u, v), far| {
                    DVec3::new(0.74 * side + if far { -0.11 } else { 0.11 }, v + radius, z - u)
                },
            );
        }
    }
    for (z, material) in [(-2.17, Material::Lamp), (2.2, Material::RedCar)] {
        for x in [-0.6, 0.6] {
            let (p, q) =
                (DVec3::new(x - 0.15, 0.6, z - 0.05), DVec3::new(x + 0.15, 0.72, z + 0.05));
            solid.cuboid(material, p, q);
        }
    }
    solid
}

/// A street lamp, 6.5 m high, its arm along +x.
fn lamp() -> Solid {
    let mut solid = Solid::new();
    solid.frustum(Material::DarkMetal, DVec3::ZERO, (-0.1, 0.14), (0.7, 0.12), 8);
    solid.frustum(Material::DarkMetal, DVec3::ZERO, (0.68, 0.07), (6.4, 0.05), 8);
    solid.cuboid(
        Material::DarkMetal,
        DVec3::new(-0.04, 6.32, -0.035),
        DVec3::new(1.5, 6.42, 0.035),
    );
    solid.cuboid(Material::DarkMetal, DVec3::new(0.9, 6.27, -0.13), DVec3::new(1.52, 6.36, 0.13));
    solid.cuboid(Material::Lamp, DVec3::new(0.95, 6.22, -0.1), DVec3::new(1.47, 6.29, 0.1));
    solid
}

/// A bench, its seat facing +x.
fn bench() -> Solid {
    let mut solid = Solid::new();
    for (k, x) in [0.0, 0.16, 0.32].into_iter().enumerate() {
        let dz = 0.9 + 0.001 * k as f64;
        solid.cuboid(Material::Wood, DVec3::new(x, 0.42, -dz), DVec3::new(x + 0.13, 0.46, dz));
    }
    for (k, y) in [0.58, 0.74].into_iter().enumerate() {
        let dz = 0.903 + 0.001 * k as f64;
        solid.cuboid(Material::Wood, DVec3::new(-0.1, y, -dz), DVec3::new(-0.06, y + 0.12, dz));
    }
    for z in [-0.7, 0.7] {
        solid.cuboid(
            Material::DarkMetal,
            DVec3::new(0.02, -0.05, z - 0.03),
            DVec3::new(0.42, 0.43, z + 0.03),
        );
        solid.cuboid(
            Material::DarkMetal,
            DVec3::new(-0.07, -0.05, z - 0.031),
            DVec3::new(-0.02, 0.84, z + 0.031),
        );
    }
    solid
}

/// A litter bin.
fn bin() -> Solid {
    let mut solid = Solid::new();
    solid.frustum(Material::DarkMetal, DVec3::ZERO, (-0.05, 0.24), (0.85, 0.28), 8);
    solid.frustum(Material::Metal, DVec3::ZERO, (0.84, 0.3), (0.93, 0.2), 8);
    solid
}

/// Puts furniture on the pavements and cars along the kerbs until `budget` triangles are spent.
fn place_furniture(
    document: &mut Document,
    layout: &Layout,
    blocks: &[Vec<NodeKey>],
    budget: u64,
    seed: u64,
) {
    let models = Models::new(document, seed);
    let mut random = Random::new(seed, FURNITURE);
    let mut wishes: Vec<([usize; 2], &str, MeshKey, Placement)> = vec![];
    const QUARTER: f64 = std::f64::consts::FRAC_PI_2;
    for i in 0..layout.blocks {
        for j in 0..layout.blocks {
            let block = [i, j];
            let ([z0, z1], kerbs) = (layout.z.buildable(j), layout.x.kerbs(i));
            for (side, kerb) in kerbs.into_iter().enumerate() {
                // Towards the roadway along x.
                let out = if side == 0 { -1.0 } else { 1.0 };
                let facing = if side == 0 { 2.0 * QUARTER } else { 0.0 };
                let street = layout.x.streets[i + side].1;
                // Pavement: lamps, with trees, benches and bins between them.
                let mut z = z0 + 3.0;
                let mut k = 0;
                while z < z1 - 2.0 {
                    let at = |inward: f64| DVec3::new(kerb - out * inward, KERB, z);
                    match k % 3 {
                        0 => wishes.push((
                            block,
                            "lamp",
                            models.lamp,
                            Placement::turned(at(0.5), facing),
                        )),
                        _ if random.chance(0.55) && street >= 14.0 => {
                            let tree = random.pick(&models.trees);
                            let at = Placement::turned(at(0.8), random.angle());
                            wishes.push((block, "tree", tree, at));
                        }
                        1 => wishes.push((
                            block,
                            "bench",
                            models.bench,
                            Placement::turned(at(0.7), facing),
                        )),
                        _ => wishes.push((
                            block,
                            "bin",
                            models.bin,
                            Placement::turned(at(0.4), random.angle()),
                        )),
                    }
                    z += random.between(7.0, 9.5);
                    k += 1;
                }
                // Cars park where the roadway is wide enough.
                if street >= 16.0 {
                    let mut z = z0 + random.between(3.0, 7.0);
                    while z < z1 - 3.0 {
                        if random.chance(0.8) {
                            let at = DVec3::new(kerb + out * 1.02, 0.0, z);
                            let turn = facing + random.between(-0.008, 0.008);
                            let car = random.pick(&models.cars);
                            wishes.push((block, "car", car, Placement::turned(at, turn)));
                        }
                        z += random.between(5.2, 7.5);
                    }
                }
            }
        }
    }
    for &[i, j] in &layout.parks {
        let ([x0, x1], [z0, z1]) = (layout.x.buildable(i), layout.z.buildable(j));
        for _ in 0..40 {
            let at = DVec3::new(random.between(x0, x1), KERB, random.between(z0, z1));
            let at = Placement::turned(at, random.angle());
            let (name, model) = if random.chance(0.8) {
                ("tree", random.pick(&models.trees))
            } else {
                ("bench", models.bench)
            };
            wishes.push(([i, j], name, model, at));
        }
    }
    random.shuffle(&mut wishes);
    // The street of x = 0 is where viewers stand: it is furnished first.
    let middle = layout.blocks / 2;
    wishes.sort_by_key(|(block, ..)| block[0] != middle && block[0] + 1 != middle);
    let mut left = budget;
    let mut numbers = vec![[0usize; 5]; layout.blocks * layout.blocks];
    for (block, name, model, mut at) in wishes {
        let cost = document.triangles_of(model);
        if cost > left {
            continue;
        }
        left -= cost;
        at.translation -= layout.block_origin(block);
        let kind =
            ["lamp", "tree", "bench", "bin", "car"].iter().position(|n| *n == name).unwrap_or(0);
        let number = &mut numbers[block[0] * layout.blocks + block[1]][kind];
        let [i, j] = block;
        document.node(
            Some(blocks[i][j]),
            format!("block_{i}_{j}/{name}_{number}"),
            Some(model),
            at,
        );
        *number += 1;
    }
}
