//! The families of scenes that the exact rules are compared on: each is a function of a seed.
//!
//! All work in face space ([`super::case`]): the segment is (0, 0, 0) - (L, 0, 0), a row plane is
//! y = w z, the camera plane is z = 0.

use glam::{DAffine3, DMat3, DVec3};
use sightline_geometry::Sampling;

use super::{
    case::{Case, Pose, Scene, coarse_sampling, small_sampling},
    random::Random,
};

/// A named generator of cases.
pub struct Family {
    pub name: &'static str,
    /// What is difficult about it.
    pub about: &'static str,
    pub generate: fn(&mut Random) -> Case,
}

/// All families that are compared with the twins.
pub const FAMILIES: &[Family] = &[
    Family { name: "soup", about: "random triangles, some see-through", generate: soup },
    Family { name: "one", about: "one triangle that spans all columns", generate: one },
    Family { name: "grid", about: "corners on a coarse grid: every tie there is", generate: grid },
    Family { name: "sliver", about: "slivers to an aspect of 1e12", generate: sliver },
    Family { name: "degenerate", about: "zero-area and repeated triangles", generate: degenerate },
    Family { name: "coplanar", about: "overlaps in one plane, in any pose", generate: coplanar },
    Family { name: "tied", about: "overlaps in one plane, exactly representable", generate: tied },
    Family {
        name: "piercing",
        about: "triangles through the segment or its ends",
        generate: piercing,
    },
    Family {
        name: "containing",
        about: "triangles that contain the segment",
        generate: containing,
    },
    Family {
        name: "on-planes",
        about: "corners on row planes, axis, camera plane",
        generate: on_planes,
    },
    Family {
        name: "on-planes-exact",
        about: "the same, exactly representable",
        generate: on_planes_exact,
    },
    Family { name: "crossing", about: "interpenetrating triangles", generate: crossing },
    Family { name: "lengths", about: "segments of 1e-6 to 1e3 m", generate: lengths },
    Family { name: "sizes", about: "triangles of 1e-6 to 1e6 m together", generate: sizes },
    Family { name: "offset", about: "scenes 1e5, 1e6, 1e7 m from the origin", generate: offset },
    Family {
        name: "mesh-offset",
        about: "meshes 1e3 to 1e7 m from their own origin",
        generate: mesh_offset,
    },
    Family { name: "along-axis", about: "directions close to the axis", generate: along_axis },
    Family {
        name: "fan",
        about: "hundreds to thousands of triangles about a vertex",
        generate: fan,
    },
    Family { name: "t-junction", about: "vertices in the middle of edges", generate: t_junction },
    Family {
        name: "layers",
        about: "stacks of nearly parallel layers, see-through between",
        generate: layers,
    },
    Family { name: "instances", about: "scaled, sheared, mirrored instances", generate: instances },
];

/// The family with a name.
pub fn family(name: &str) -> Option<&'static Family> {
    FAMILIES.iter().find(|f| f.name == name)
}

fn triangles(count: usize, mut next: impl FnMut() -> [DVec3; 3]) -> Vec<[DVec3; 3]> {
    (0..count).map(|_| next()).collect()
}

fn free_triangle(random: &mut Random, spread: f64, size: f64) -> [DVec3; 3] {
    let at = random.in_cube(spread);
    std::array::from_fn(|_| at + random.in_cube(size))
}

fn soup(random: &mut Random) -> Case {
    let length = random.within(0.5..6.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    for occluder in [true, true, false] {
        let count = 1 + random.below(10);
        let size = random.within(0.5..5.0);
        let soup = triangles(count, || free_triangle(random, 6.0, size));
        scene.add_soup(&soup, pose.world_from_face, occluder);
    }
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

/// What is found tells which rows were cut: the weight is that of all rows between the least and
/// the largest y / z of the corners.
fn one(random: &mut Random) -> Case {
    let pose = Pose::any(random, 1.0);
    let side = |random: &mut Random, x: f64| {
        let z = random.magnitude(1e-3..1e3);
        let w = random.within(-1.2..1.2);
        DVec3::new(x, w * z, z)
    };
    let reach = 1e6;
    let corners = [side(random, -reach), side(random, reach), {
        let x = random.within(-reach..reach);
        side(random, x)
    }];
    let mut scene = Scene::default();
    scene.add_soup(&[corners], pose.world_from_face, true);
    let rows = 4 * (1 + random.below(16)) as u32;
    let sampling = Sampling::with_columns(rows, 4).jittered(random.below(1000) as u32);
    scene.finish(pose.segment, sampling)
}

fn grid_point(random: &mut Random) -> DVec3 {
    let mut next = || random.integer(-4..=4);
    DVec3::new(next(), next(), next())
}

fn grid(random: &mut Random) -> Case {
    let length = random.integer(1..=4);
    let pose = Pose::aligned(random, length);
    let mut scene = Scene::default();
    for occluder in [true, false] {
        let count = 1 + random.below(8);
        let soup = triangles(count, || std::array::from_fn(|_| grid_point(random)));
        scene.add_soup(&soup, pose.world_from_face, occluder);
    }
    let sampling = coarse_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn sliver(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    let count = 4 + random.below(12);
    let soup = triangles(count, || {
        let [a, b, _] = free_triangle(random, 4.0, 6.0);
        let width = (b - a).length() * random.magnitude(1e-12..1e-1);
        let middle = a + random.unit() * (b - a);
        [a, b, middle + random.direction() * width]
    });
    // Half of them in a mesh of their own scale, where `f32` can hold the narrow side.
    let squeeze = random.magnitude(1e-12..1.0);
    let narrow = DMat3::from_diagonal(DVec3::new(1.0, squeeze, 1.0));
    let turn = DMat3::from_quat(random.rotation()) * narrow;
    let local = DAffine3::from_mat3_translation(turn, random.in_cube(2.0));
    let (one, other) = soup.split_at(count / 2);
    scene.add_soup(one, pose.world_from_face, true);
    scene.add_soup(other, pose.world_from_face * local, true);
    let behind = triangles(2, || free_triangle(random, 8.0, 8.0));
    scene.add_soup(&behind, pose.world_from_face, true);
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn degenerate(random: &mut Random) -> Case {
    let length = random.integer(1..=4);
    let pose = Pose::any(random, length);
    let mut soup = triangles(2 + random.below(5), || free_triangle(random, 4.0, 4.0));
    for _ in 0..1 + random.below(5) {
        let [a, b, c] = soup[random.below(soup.len())];
        soup.push(match random.below(5) {
            0 => [a, a, a],
            1 => [a, b, b],
            2 => [a, b, 0.5 * (a + b)],
            3 => [b, c, a],
            _ => [c, b, a],
        });
    }
    random.shuffle(&mut soup);
    let mut scene = Scene::default();
    let (one, other) = soup.split_at(soup.len() / 2);
    scene.add_soup(one, pose.world_from_face, true);
    scene.add_soup(other, pose.world_from_face, random.one_in(2));
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

/// Triangles of one plane, `z = 0` of their own mesh, turned into any pose.
fn coplanar(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    for _ in 0..1 + random.below(2) {
        let turn = DMat3::from_quat(random.rotation());
        let local = DAffine3::from_mat3_translation(turn, random.in_cube(4.0));
        for _ in 0..1 + random.below(2) {
            let soup = triangles(1 + random.below(4), || {
                std::array::from_fn(|_| random.in_cube(5.0).with_z(0.0))
            });
            scene.add_soup(&soup, pose.world_from_face * local, true);
        }
    }
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

/// Triangles of a few planes through grid points, coordinates on the grid.
fn tied(random: &mut Random) -> Case {
    let length = random.integer(1..=4);
    let pose = Pose::aligned(random, length);
    let mut scene = Scene::default();
    for _ in 0..1 + random.below(3) {
        let (at, u, v) = (grid_point(random), grid_point(random), grid_point(random));
        let soup = triangles(1 + random.below(5), || {
            std::array::from_fn(|_| at + random.integer(-2..=2) * u + random.integer(-2..=2) * v)
        });
        scene.add_soup(&soup, pose.world_from_face, !random.one_in(4));
    }
    let sampling = coarse_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn backdrop(random: &mut Random, scene: &mut Scene, pose: &Pose) {
    let soup = triangles(2 + random.below(4), || free_triangle(random, 6.0, 6.0));
    scene.add_soup(&soup, pose.world_from_face, true);
}

fn piercing(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    let soup = triangles(1 + random.below(4), || {
        let anywhere = random.unit();
        let x = random.pick(&[0.0, 1.0, 0.5, anywhere]) * length;
        let at = DVec3::new(x, 0.0, 0.0);
        let (p, q) = (random.in_cube(4.0), random.in_cube(4.0));
        match random.below(3) {
            // Through the point, with a corner at it, with an edge over it.
            0 => [at + p, at + q, at - (p + q)],
            1 => [at, at + p, at + q],
            _ => [at + p, at - p, at + q],
        }
    });
    scene.add_soup(&soup, pose.world_from_face, true);
    backdrop(random, &mut scene, &pose);
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn containing(random: &mut Random) -> Case {
    let length = random.integer(1..=4);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    let soup = triangles(1 + random.below(3), || {
        let v = random.in_cube(3.0).with_x(0.0);
        let x = |random: &mut Random| random.integer(-8..=8);
        let on = |x: f64| DVec3::new(x, 0.0, 0.0);
        match random.below(4) {
            // An edge along the segment; the segment inside; a corner on its line; coplanar only.
            0 => [on(-1.0), on(length + 1.0), v + on(x(random))],
            1 => [v + on(x(random)), on(-3.0) - v, on(length + 3.0) - v],
            2 => [on(x(random)), v + on(x(random)), 2.0 * v + on(x(random))],
            _ => [v + on(x(random)), v + on(x(random)), 3.0 * v + on(x(random))],
        }
    });
    scene.add_soup(&soup, pose.world_from_face, true);
    backdrop(random, &mut scene, &pose);
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn special_point(random: &mut Random, sampling: Sampling, length: f64) -> DVec3 {
    let mut whole = || random.integer(-4..=4);
    let (x, y, z) = (whole(), whole(), whole());
    match random.below(6) {
        // On a row plane, also behind the camera; on the plane and the ray of a pixel; on the
        // axis; at an end of the segment; on the camera plane; anywhere.
        0 | 1 => {
            let w = sampling.row(random.below(sampling.rows() as usize) as u32);
            DVec3::new(x, w * z, z)
        }
        2 => {
            let w = sampling.row(random.below(sampling.rows() as usize) as u32);
            let c = sampling.column(random.below(sampling.columns() as usize) as u32);
            DVec3::new(0.5 * length + c * z, w * z, z)
        }
        3 => DVec3::new(x, 0.0, 0.0),
        4 => DVec3::new(x, y, 0.0),
        _ => DVec3::new(x, y, z),
    }
}

fn with_special_points(random: &mut Random, pose: &Pose, sampling: Sampling, length: f64) -> Case {
    let mut scene = Scene::default();
    let points: Vec<DVec3> =
        (0..6 + random.below(12)).map(|_| special_point(random, sampling, length)).collect();
    let soup = triangles(3 + random.below(10), || {
        std::array::from_fn(|_| points[random.below(points.len())])
    });
    scene.add_soup(&soup, pose.world_from_face, true);
    scene.finish(pose.segment, sampling)
}

fn on_planes(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::free(random, length, 1e3);
    let sampling = small_sampling(random);
    with_special_points(random, &pose, sampling, length)
}

fn on_planes_exact(random: &mut Random) -> Case {
    let length = random.integer(1..=4);
    let pose = Pose::aligned(random, length);
    let sampling = coarse_sampling(random);
    with_special_points(random, &pose, sampling, length)
}

fn crossing(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    for _ in 0..1 + random.below(3) {
        // All through one point, so that many cross at one place.
        let at = random.in_cube(4.0);
        let soup = triangles(2 + random.below(4), || {
            let (p, q) = (random.in_cube(4.0), random.in_cube(4.0));
            [at + p, at + q, at - (p + q) * random.unit()]
        });
        scene.add_soup(&soup, pose.world_from_face, !random.one_in(4));
    }
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn lengths(random: &mut Random) -> Case {
    let length = random.magnitude(1e-6..1e3);
    let pose = Pose::free(random, length, 1e3);
    let spread = length * random.magnitude(0.1..1e4);
    let mut scene = Scene::default();
    let unit = triangles(4 + random.below(12), || free_triangle(random, 1.0, 1.0));
    let scale = DAffine3::from_scale(DVec3::splat(spread));
    scene.add_soup(&unit, pose.world_from_face * scale, true);
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn sizes(random: &mut Random) -> Case {
    let length = random.magnitude(1e-3..1e2);
    let pose = Pose::free(random, length, 1e3);
    let mut scene = Scene::default();
    for _ in 0..4 + random.below(12) {
        let size = random.magnitude(1e-6..1e6);
        // As large as the view from where it stands, or much smaller, or around it.
        let distance = size * random.magnitude(0.1..100.0);
        let local = DAffine3::from_mat3_translation(
            DMat3::from_diagonal(DVec3::splat(size)),
            random.direction() * distance + DVec3::X * (random.unit() * length),
        );
        let triangle = free_triangle(random, 0.1, 1.0);
        scene.add_soup(&[triangle], pose.world_from_face * local, !random.one_in(5));
    }
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn offset(random: &mut Random) -> Case {
    let length = random.magnitude(1e-2..1e2);
    let far = random.pick(&[1e5, 1e6, 1e7]);
    let v0 = random.in_cube(1.0).signum() * far + random.in_cube(1e3);
    let direction = random.direction();
    let pose = Pose::of(random, v0, direction, length);
    let mut scene = Scene::default();
    for occluder in [true, true, false] {
        let spread = length * random.within(0.5..20.0);
        let soup = triangles(1 + random.below(8), || free_triangle(random, spread, spread));
        scene.add_soup(&soup, pose.world_from_face, occluder);
    }
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

/// Meshes modelled far from their own origin, brought back by their instance or not.
fn mesh_offset(random: &mut Random) -> Case {
    let length = random.within(0.5..8.0);
    let far = random.pick(&[1e3, 1e4, 1e5, 1e6, 1e7]);
    let at = (random.in_cube(1.0).signum() * far).round();
    let back = random.one_in(2);
    let direction = random.direction();
    let v0 = if back { random.in_cube(10.0) } else { at + random.in_cube(2.0) };
    let pose = Pose::of(random, v0, direction, length);
    // What `f32` can still tell apart there.
    let step = f64::from((far as f32).next_up() - far as f32);
    let size = random.within(2.0..40.0) * step.max(0.25);
    let mut scene = Scene::default();
    for _ in 0..2 {
        let soup = triangles(1 + random.below(8), || {
            free_triangle(random, size, size)
                .map(|p| at + p + if back { DVec3::ZERO } else { v0 - at })
        });
        let map = if back {
            pose.world_from_face * DAffine3::from_translation(-at)
        } else {
            DAffine3::IDENTITY
        };
        scene.add_soup(&soup, map, true);
    }
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn along_axis(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    // Close to the line of the segment, before and behind it and beside it.
    let soup = triangles(2 + random.below(6), || {
        let (away, spread) = (random.magnitude(1e-6..1.0), random.magnitude(1e-3..1e2));
        std::array::from_fn(|_| {
            let side = random.in_cube(1.0) * away;
            side.with_x(random.within(-1.0..1.0) * spread + 0.5 * length)
        })
    });
    scene.add_soup(&soup, pose.world_from_face, true);
    backdrop(random, &mut scene, &pose);
    let columns = random.pick(&[16, 64, 256]);
    let sampling = Sampling::with_columns(4, columns).jittered(random.below(100) as u32);
    scene.finish(pose.segment, sampling)
}

fn fan(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    // A crumpled fan is deep at its tip, and the twin quadratic in that: large ones are cones.
    let crumpled = random.one_in(2);
    let most = if crumpled { 120.0 } else { 3000.0 };
    let count = random.magnitude(20.0..most) as u32;
    let tip = random.in_cube(5.0);
    let turn = random.rotation();
    let lift = random.within(-1.0..1.0);
    let mut positions = vec![tip];
    for i in 0..count {
        let angle = std::f64::consts::TAU * f64::from(i) / f64::from(count);
        let height = lift * if crumpled { random.unit() } else { 1.0 };
        positions.push(tip + turn * DVec3::new(libm::cos(angle), libm::sin(angle), height) * 6.0);
    }
    let wheel: Vec<[u32; 3]> = (0..count).map(|i| [0, 1 + i, 1 + (i + 1) % count]).collect();
    scene.add(&positions, &wheel, pose.world_from_face, true);
    backdrop(random, &mut scene, &pose);
    let glass = triangles(2, || free_triangle(random, 6.0, 6.0));
    scene.add_soup(&glass, pose.world_from_face, false);
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

/// A strip of triangles along one edge of a large triangle, and something behind the seam.
fn t_junction(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    let (a, b) = (random.in_cube(4.0), random.in_cube(4.0));
    let (c, d) = (random.in_cube(6.0), random.in_cube(6.0));
    let count = 2 + random.below(6);
    let on = |k: usize| a + (b - a) * (k as f64 / count as f64);
    let mut soup = vec![[a, b, c]];
    soup.extend((0..count).map(|k| [on(k), on(k + 1), d]));
    scene.add_soup(&soup, pose.world_from_face, true);
    backdrop(random, &mut scene, &pose);
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn layers(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    let turn = DMat3::from_quat(random.rotation());
    let middle = random.direction() * random.within(1.0..4.0);
    let gap = random.magnitude(1e-15..1e-3);
    for k in 0..3 + random.below(8) {
        let local = DAffine3::from_mat3_translation(turn, middle + turn.z_axis * (gap * k as f64));
        let tilt = random.pick(&[0.0, gap]);
        let soup = triangles(1 + random.below(2), || {
            std::array::from_fn(|_| random.in_cube(5.0).with_z(tilt * random.within(-1.0..1.0)))
        });
        scene.add_soup(&soup, pose.world_from_face * local, !random.one_in(4));
    }
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}

fn instances(random: &mut Random) -> Case {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = Scene::default();
    for _ in 0..2 + random.below(4) {
        let scale = DVec3::new(
            random.magnitude(1e-2..1e2),
            random.magnitude(1e-2..1e2),
            -random.magnitude(1e-2..1e2),
        );
        let turn = DMat3::from_quat(random.rotation())
            * DMat3::from_diagonal(scale)
            * DMat3::from_quat(random.rotation());
        let local = DAffine3::from_mat3_translation(turn, random.in_cube(5.0));
        let soup = triangles(1 + random.below(5), || free_triangle(random, 1.0, 1.0));
        scene.add_soup(&soup, pose.world_from_face * local, !random.one_in(4));
    }
    let sampling = small_sampling(random);
    scene.finish(pose.segment, sampling)
}
