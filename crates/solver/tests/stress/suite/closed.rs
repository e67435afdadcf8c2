//! Closed meshes, which must not leak (VI-2): around the segment, where nothing outside is ever
//! found, and in front of it, where nothing inside is.
//!
//! There is no bound here: one pixel in 10^9 is one too many. Vertices are shared, so the two
//! triangles of an edge have the same floats for it; that is all a mesh needs, whatever its shape.
//! Meshes may fold over themselves: what counts is that no part of the surface lies between the
//! two sides that it divides, which holds while it keeps away from the segment and from what is
//! hidden.

use std::collections::HashMap;

use glam::{DAffine3, DMat3, DVec3};
use sightline_geometry::{RectifiedFrame, Sampling};
use sightline_solver::{SegmentVisibility, bounds::ErrorBounds};

use super::{
    case::{Case, Pose, Scene},
    random::Random,
};

/// A named generator of closed scenes.
pub struct ClosedFamily {
    pub name: &'static str,
    pub about: &'static str,
    pub generate: fn(&mut Random) -> Case,
}

/// Every family of closed meshes.
pub const CLOSED_FAMILIES: &[ClosedFamily] = &[
    ClosedFamily {
        name: "around-sphere",
        about: "spheres around the segment",
        generate: around_sphere,
    },
    ClosedFamily {
        name: "around-star",
        about: "random radii around the segment",
        generate: around_star,
    },
    ClosedFamily {
        name: "around-box",
        about: "vertices snapped to row planes, axis, camera plane",
        generate: around_box,
    },
    ClosedFamily {
        name: "around-torus",
        about: "the segment in the tube of a torus",
        generate: around_torus,
    },
    ClosedFamily {
        name: "front-sphere",
        about: "something inside spheres in front",
        generate: front_sphere,
    },
    ClosedFamily {
        name: "front-star",
        about: "something inside random radii in front",
        generate: front_star,
    },
    ClosedFamily {
        name: "front-box",
        about: "something inside a snapped box in front",
        generate: front_box,
    },
];

/// The closed family with a name.
pub fn closed_family(name: &str) -> Option<&'static ClosedFamily> {
    CLOSED_FAMILIES.iter().find(|f| f.name == name)
}

/// What leaked, in words; nothing when nothing did.
pub fn leaks(case: &Case, found: &SegmentVisibility) -> Vec<String> {
    let mut out = Vec::new();
    let members = || found.set.iter().zip(&found.weights);
    for (p, weight) in members().filter(|(p, _)| case.hidden.contains(&p.0)) {
        out.push(format!("{p} is hidden, and was found with weight {weight:e}"));
    }
    if case.surrounded {
        let whole: f64 = members().map(|(_, w)| f64::from(*w)).sum();
        // Weights are rounded to `f32`, and a pixel may have dropped one interval a triangle.
        let frame = RectifiedFrame::new(&case.segment).expect("the segment has a length");
        let bounds = ErrorBounds::new(&case.geometry, &frame);
        let c = case.sampling.column(case.sampling.columns() - 1).abs();
        let c = c.max(case.sampling.column(0).abs());
        let dropped = f64::from(case.geometry.primitive_count()) * bounds.shortest_interval(c);
        if (whole - 1.0).abs() > f64::from(f32::EPSILON) + dropped {
            out.push(format!("directions that end nowhere, or twice: {whole}"));
        }
    }
    out
}

/// Vertices and triangles of a closed mesh.
#[derive(Clone)]
pub struct Closed {
    pub positions: Vec<DVec3>,
    pub triangles: Vec<[u32; 3]>,
}

impl Closed {
    pub fn map(mut self, mut to: impl FnMut(DVec3) -> DVec3) -> Self {
        for p in &mut self.positions {
            *p = to(*p);
        }
        self
    }

    /// In one instance, or with its triangles dealt out to two that share its vertices.
    fn add(&self, random: &mut Random, scene: &mut Scene, map: DAffine3) {
        if random.one_in(2) {
            scene.add(&self.positions, &self.triangles, map, true);
        } else {
            let (mut one, mut other) = (Vec::new(), Vec::new());
            for &t in &self.triangles {
                if random.one_in(2) { &mut one } else { &mut other }.push(t);
            }
            scene.add(&self.positions, &one, map, true);
            scene.add(&self.positions, &other, map, true);
        }
    }

    /// Panics when an edge does not belong to two triangles, once in each direction.
    pub fn assert_closed(&self) {
        let mut edges: HashMap<(u32, u32), i32> = HashMap::new();
        for &[a, b, c] in &self.triangles {
            for (p, q) in [(a, b), (b, c), (c, a)] {
                *edges.entry((p.min(q), p.max(q))).or_default() += if p < q { 1 } else { -1 };
            }
        }
        assert!(edges.values().all(|&n| n == 0), "every edge has two sides");
    }
}

/// An octahedron, each face divided into n x n, on the unit sphere.
fn octasphere(n: i32) -> Closed {
    let mut numbers: HashMap<[i32; 3], u32> = HashMap::new();
    let mut positions = Vec::new();
    let mut triangles = Vec::new();
    for signs in [
        [1, 1, 1],
        [-1, 1, 1],
        [1, -1, 1],
        [-1, -1, 1],
        [1, 1, -1],
        [-1, 1, -1],
        [1, -1, -1],
        [-1, -1, -1],
    ] {
        let mut vertex = |i: i32, j: i32| {
            let at = [signs[0] * i, signs[1] * j, signs[2] * (n - i - j)];
            *numbers.entry(at).or_insert_with(|| {
                let p = DVec3::from_array(at.map(f64::from));
                positions.push(p.normalize());
                positions.len() as u32 - 1
            })
        };
        let flipped = signs.iter().product::<i32>() < 0;
        for i in 0..n {
            for j in 0..n - i {
                let (a, b, c) = (vertex(i, j), vertex(i + 1, j), vertex(i, j + 1));
                triangles.push(if flipped { [a, c, b] } else { [a, b, c] });
                if i + j < n - 1 {
                    let d = vertex(i + 1, j + 1);
                    triangles.push(if flipped { [b, c, d] } else { [b, d, c] });
                }
            }
        }
    }
    Closed { positions, triangles }
}

/// Rings and sectors with one vertex at either pole.
fn uv_sphere(rings: u32, sectors: u32) -> Closed {
    let mut positions = vec![DVec3::Z];
    for r in 1..rings {
        let polar = std::f64::consts::PI * f64::from(r) / f64::from(rings);
        for s in 0..sectors {
            let around = std::f64::consts::TAU * f64::from(s) / f64::from(sectors);
            let ring = libm::sin(polar);
            positions.push(DVec3::new(
                ring * libm::cos(around),
                ring * libm::sin(around),
                libm::cos(polar),
            ));
        }
    }
    positions.push(-DVec3::Z);
    let south = positions.len() as u32 - 1;
    let at = |r: u32, s: u32| 1 + (r - 1) * sectors + s % sectors;
    let mut triangles = Vec::new();
    for s in 0..sectors {
        triangles.push([0, at(1, s), at(1, s + 1)]);
        triangles.push([south, at(rings - 1, s + 1), at(rings - 1, s)]);
        for r in 1..rings - 1 {
            triangles.push([at(r, s), at(r + 1, s), at(r + 1, s + 1)]);
            triangles.push([at(r, s), at(r + 1, s + 1), at(r, s + 1)]);
        }
    }
    Closed { positions, triangles }
}

/// A torus about z: the tube's axis is a circle of radius 3, the tube has radius 1.
pub fn torus(around: u32, across: u32) -> Closed {
    let mut positions = Vec::new();
    let mut triangles = Vec::new();
    for i in 0..around {
        let u = std::f64::consts::TAU * f64::from(i) / f64::from(around);
        for j in 0..across {
            let v = std::f64::consts::TAU * f64::from(j) / f64::from(across);
            let r = 3.0 + libm::cos(v);
            positions.push(DVec3::new(r * libm::cos(u), r * libm::sin(u), libm::sin(v)));
        }
    }
    let at = |i: u32, j: u32| i % around * across + j % across;
    for i in 0..around {
        for j in 0..across {
            let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
            triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    Closed { positions, triangles }
}

/// The surface of the cube of half side n, each side divided into 2n x 2n squares of two
/// triangles, diagonals at random. Coordinates are whole numbers.
pub fn grid_box(random: &mut Random, n: i32) -> Closed {
    let mut numbers: HashMap<[i32; 3], u32> = HashMap::new();
    let mut positions = Vec::new();
    let mut triangles = Vec::new();
    let mut vertex = |at: [i32; 3]| {
        *numbers.entry(at).or_insert_with(|| {
            positions.push(DVec3::from_array(at.map(f64::from)));
            positions.len() as u32 - 1
        })
    };
    for axis in 0..3 {
        for side in [-n, n] {
            for i in -n..n {
                for j in -n..n {
                    let mut corner = |di: i32, dj: i32| {
                        let mut at = [0; 3];
                        at[axis] = side;
                        at[(axis + 1) % 3] = i + di;
                        at[(axis + 2) % 3] = j + dj;
                        vertex(at)
                    };
                    let quad = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                    let [a, b, c, d] =
                        if side > 0 { quad } else { [quad[0], quad[3], quad[2], quad[1]] };
                    triangles.extend(if random.one_in(2) {
                        [[a, b, c], [a, c, d]]
                    } else {
                        [[b, c, d], [b, d, a]]
                    });
                }
            }
        }
    }
    Closed { positions, triangles }
}

pub fn large_sampling(random: &mut Random) -> Sampling {
    let (rows, columns) =
        random.pick(&[(16, 16), (32, 64), (64, 64), (128, 128), (64, 256), (8, 256)]);
    let sampling = Sampling::with_columns(rows, columns);
    if random.one_in(2) { sampling } else { sampling.jittered(random.below(1000) as u32) }
}

pub fn sphere(random: &mut Random) -> Closed {
    let closed = if random.one_in(2) {
        octasphere(2 + random.below(14) as i32)
    } else {
        uv_sphere(5 + random.below(20) as u32, 5 + random.below(40) as u32)
    };
    // Poles on the axis half of the time: the mesh's own z is the axis then.
    if random.one_in(2) {
        closed.map(|p| DVec3::new(p.z, p.x, p.y))
    } else {
        let turn = random.rotation();
        closed.map(|p| turn * p)
    }
}

/// Radii of 1 to 3: no point of a triangle is nearer to the centre than the cosine of half the
/// angle between its corners, which is over a half for all spheres made here.
pub fn star(random: &mut Random) -> Closed {
    let rough = random.magnitude(1e-3..2.0);
    sphere(random).map(|p| p * (1.0 + rough * random.unit()))
}

/// A box with its vertices moved by up to half a square, then onto the row planes of `sampling`,
/// the axis and the camera plane, where they are close to one. The centre of the box is at `at`
/// in face space, `scale` is the side of a square.
fn snapped_box(random: &mut Random, sampling: Sampling, at: DVec3, scale: f64) -> Closed {
    let n = 2 + random.below(6) as i32;
    let loose = random.pick(&[0.0, 0.5]);
    let scale = scale / f64::from(n);
    grid_box(random, n).map(|p| {
        let mut p = at + (p + random.in_cube(loose)) * scale;
        let near = |v: f64| v.abs() < 0.5 * scale;
        match random.below(4) {
            0 if near(p.z) => p.z = 0.0,
            1 if near(p.y) && near(p.z) => p = p.with_y(0.0).with_z(0.0),
            0..=2 => {
                let w = sampling.row(random.below(sampling.rows() as usize) as u32);
                let (y, z) = (w * p.z, p.y / w);
                if near(y - p.y) {
                    // Row w of a face, or of the face a quarter turn further.
                    p.y = y;
                } else if near(z - p.z) {
                    p.z = z;
                }
            }
            _ => {}
        }
        p
    })
}

/// Puts `shell` around the middle of the segment, and hides a larger copy of it and small
/// triangles outside. `reach` is the largest distance of its vertices from its centre.
fn around(
    random: &mut Random,
    pose: &Pose,
    sampling: Sampling,
    shell: &Closed,
    map: DAffine3,
) -> Case {
    shell.assert_closed();
    let reach = shell.positions.iter().fold(0.0f64, |m, p| m.max(p.length()));
    let mut scene = Scene::default();
    shell.add(random, &mut scene, pose.world_from_face * map);
    let size = random.magnitude(1.5..1e3) * reach;
    let outside: Vec<[DVec3; 3]> = (0..200)
        .map(|_| {
            let at = random.direction() * size;
            std::array::from_fn(|_| at + random.in_cube(0.1 * size))
        })
        .collect();
    let (one, other) = outside.split_at(100);
    let first = scene.add_soup(one, pose.world_from_face * map, true).start;
    let end = scene.add_soup(other, pose.world_from_face * map, false).end;
    let mut case = scene.finish(pose.segment, sampling);
    case.hidden = first..end;
    case.surrounded = true;
    case
}

fn scaled(by: f64, at: DVec3) -> DAffine3 {
    DAffine3::from_mat3_translation(DMat3::from_diagonal(DVec3::splat(by)), at)
}

pub fn any_pose(random: &mut Random, length: f64) -> Pose {
    match random.below(3) {
        0 => Pose::aligned(random, length),
        1 => Pose::free(random, length, 1e3),
        _ => {
            let far = random.pick(&[1e5, 1e6, 1e7]);
            Pose::free(random, length, far)
        }
    }
}

/// A shell of unit inner size is scaled to hold a segment of `length`: the segment keeps within
/// 0.4 of the centre, every triangle beyond 0.5.
fn around_unit(random: &mut Random, shell: &Closed) -> Case {
    let length = random.magnitude(0.05..50.0);
    let pose = any_pose(random, length);
    let scale = length * random.magnitude(1.25..100.0);
    let off = random.in_cube(1.0) * (0.4 * scale - 0.5 * length).max(0.0) / 3.0f64.sqrt();
    let middle = DVec3::X * (0.5 * length) + if random.one_in(2) { off } else { DVec3::ZERO };
    let sampling = large_sampling(random);
    around(random, &pose, sampling, shell, scaled(scale, middle))
}

fn around_sphere(random: &mut Random) -> Case {
    let shell = sphere(random);
    around_unit(random, &shell)
}

fn around_star(random: &mut Random) -> Case {
    let shell = star(random);
    around_unit(random, &shell)
}

fn around_box(random: &mut Random) -> Case {
    let length = random.integer(1..=8);
    let pose = any_pose(random, length);
    let sampling = large_sampling(random);
    let middle = DVec3::X * (0.5 * length);
    // The box is moved by one square at most, of at least four from side to side: half of its
    // half side is more than the segment.
    let half = 2.0 * length.max(1.0) * random.pick(&[1.0, 2.0, 8.0]);
    let shell = snapped_box(random, sampling, middle, half);
    around(random, &pose, sampling, &shell, DAffine3::IDENTITY)
}

/// The segment is a chord of the tube's axis: it leaves that by under 0.05 for an angle of 0.3,
/// and a tube of 8 sides or more has an inner radius of 0.92.
fn around_torus(random: &mut Random) -> Case {
    let ring = torus(12 + random.below(50) as u32, 8 + random.below(24) as u32);
    let scale = random.magnitude(0.1..100.0);
    let length = scale * random.within(0.1..0.9);
    let pose = any_pose(random, length);
    // Tube's axis at the middle of the segment: x of face space is tangent to the circle there.
    let turn = random.within(0.0..std::f64::consts::TAU);
    let about = DMat3::from_rotation_x(turn);
    let shell = ring.map(|p| about * (p - 3.0 * DVec3::Y));
    let sampling = large_sampling(random);
    around(random, &pose, sampling, &shell, scaled(scale, DVec3::X * (0.5 * length)))
}

/// Puts `shell` in front of the segment, hides a small copy of it and triangles in it, and has
/// something behind that may be seen beside it.
fn in_front(
    random: &mut Random,
    pose: &Pose,
    sampling: Sampling,
    shell: &Closed,
    map: DAffine3,
    centre: DVec3,
    inner: f64,
) -> Case {
    shell.assert_closed();
    let mut scene = Scene::default();
    let world = pose.world_from_face * map;
    shell.add(random, &mut scene, world);
    let mut small = || {
        let at = centre + random.in_cube(0.25) * inner;
        std::array::from_fn(|_| at + random.direction() * (0.25 * inner))
    };
    let inside: Vec<[DVec3; 3]> = (0..60).map(|_| small()).collect();
    let (one, other) = inside.split_at(30);
    let first = scene.add_soup(one, world, true).start;
    let end = scene.add_soup(other, world, false).end;
    let behind: Vec<[DVec3; 3]> = (0..20)
        .map(|_| std::array::from_fn(|_| centre + random.direction() * (20.0 * inner)))
        .collect();
    scene.add_soup(&behind, world, true);
    let mut case = scene.finish(pose.segment, sampling);
    case.hidden = first..end;
    case
}

/// A shell of unit inner size (see [`star`]: half of it is free) and outer size up to 3, at a
/// distance that keeps the segment outside.
fn in_front_unit(random: &mut Random, shell: &Closed) -> Case {
    let length = random.magnitude(0.05..50.0);
    let pose = any_pose(random, length);
    let scale = length * random.magnitude(0.01..100.0);
    let distance = 3.5 * scale + length * random.magnitude(1.0..10.0);
    let middle = DVec3::X * (0.5 * length) + random.direction() * distance;
    let sampling = large_sampling(random);
    in_front(random, &pose, sampling, shell, scaled(scale, middle), DVec3::ZERO, 0.7)
}

fn front_sphere(random: &mut Random) -> Case {
    let shell = sphere(random);
    in_front_unit(random, &shell)
}

fn front_star(random: &mut Random) -> Case {
    let shell = star(random);
    in_front_unit(random, &shell)
}

fn front_box(random: &mut Random) -> Case {
    let length = random.integer(1..=8);
    let pose = any_pose(random, length);
    let sampling = large_sampling(random);
    let half = random.pick(&[1.0, 4.0, 16.0]);
    // A snapped vertex moves by a square at most, half of the half side.
    let centre = DVec3::X * (0.5 * length) + (random.direction() * (3.0 * half + length)).round();
    let shell = snapped_box(random, sampling, centre, half);
    in_front(random, &pose, sampling, &shell, DAffine3::IDENTITY, centre, 0.45 * half)
}
