//! The families of scenes with triangles that move: each is a function of a seed.
//!
//! All work in face space, as those of the suite for what rests: the camera's path is (0, 0, 0) -
//! (L, 0, 0), a row plane is y = w z, the camera plane z = 0.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use sightline_solver::TimePath;

use super::{
    case::{Pose, coarse_sampling, small_sampling},
    random::Random,
    scene::{Moves, MovingCase, MovingScene},
};

/// A named generator of cases.
pub struct Family {
    pub name: &'static str,
    /// What is difficult about it.
    pub about: &'static str,
    pub generate: fn(&mut Random) -> MovingCase,
}

macro_rules! families {
    ($($name:literal, $about:literal, $generate:ident;)*) => {
        &[$(Family { name: $name, about: $about, generate: $generate }),*]
    };
}
pub(crate) use families;

/// All families of triangles.
pub const FAMILIES: &[Family] = families! {
    "soup", "random triangles, some see-through, some at rest", soup;
    "sliver", "moving slivers to an aspect of 1e12", sliver;
    "instant", "edges through one point, planes through each other, at one time", instant;
    "graze", "double roots: edges and corners that touch rays, exactly", graze;
    "lattice", "corners on a coarse grid at both ends: every tie there is", lattice;
    "sweep", "triangles that sweep over the camera's path and plane", sweep;
    "turn", "half turns in a state: collapsed, mirrored, without area at times", turn;
    "speed", "motion of 1e-9 to 1e6 m in a state", speed;
    "size", "triangles of 1e-6 to 1e6 m together", size;
    "offset", "1e5 to 1e7 m from the origin", offset;
    "carried", "rigid, scaled, sheared and vanishing transforms, with meshes that deform", carried;
    "mixed", "what moves among what rests and see-through", mixed;
    "twice", "equal triangles, and nearly equal motions", twice;
    "decals", "overlaps in one plane that is carried", decals;
    "sheet", "a sheet of shared vertices that waves", sheet;
    "lengths", "camera paths of 1e-6 to 1e3 m", lengths;
};

fn triangle(random: &mut Random, spread: f64, size: f64) -> [DVec3; 3] {
    let at = random.in_cube(spread);
    std::array::from_fn(|_| at + random.in_cube(size))
}

/// A triangle that goes from one place to another, as itself or as another.
fn mover(random: &mut Random, keys: usize, spread: f64, size: f64) -> Moves {
    let first = triangle(random, spread, size);
    let rigid = random.one_in(2);
    let mut out = vec![first];
    for _ in 1..keys {
        let way = random.in_cube(spread);
        out.push(if rigid { first.map(|p| p + way) } else { triangle(random, spread, size) });
    }
    out
}

fn movers(random: &mut Random, count: usize, keys: usize, spread: f64, size: f64) -> Vec<Moves> {
    (0..count).map(|_| mover(random, keys, spread, size)).collect()
}

/// Triangles at rest.
fn backdrop(random: &mut Random, scene: &mut MovingScene, pose: &Pose) {
    let soup: Vec<Moves> =
        (0..2 + random.below(4)).map(|_| vec![triangle(random, 6.0, 6.0)]).collect();
    scene.add_soup(&soup, &[pose.world_from_face], true);
}

fn soup(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..6.0);
    let pose = Pose::any(random, length);
    let states = 1 + random.below(3) as u32;
    let mut scene = MovingScene::new(states);
    for (occluder, moves) in [(true, true), (true, true), (true, false), (false, true)] {
        let (count, size) = (1 + random.below(8), random.within(0.5..5.0));
        let keys = if moves { states as usize + 1 } else { 1 };
        let soup = movers(random, count, keys, 6.0, size);
        scene.add_soup(&soup, &[pose.world_from_face], occluder);
    }
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn sliver(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = MovingScene::new(1);
    let thin = |random: &mut Random| -> [DVec3; 3] {
        let [a, b, _] = triangle(random, 4.0, 6.0);
        let width = (b - a).length() * random.magnitude(1e-12..1e-1);
        [a, b, a + random.unit() * (b - a) + random.direction() * width]
    };
    let count = 3 + random.below(8);
    let soup: Vec<Moves> = (0..count).map(|_| vec![thin(random), thin(random)]).collect();
    scene.add_soup(&soup, &[pose.world_from_face], true);
    // In a mesh of their own scale `f32` can hold the narrow side, and carry it.
    let narrow = |random: &mut Random| {
        let squeeze = DVec3::new(1.0, random.magnitude(1e-12..1.0), 1.0);
        let turn = DMat3::from_quat(random.rotation()) * DMat3::from_diagonal(squeeze);
        pose.world_from_face * DAffine3::from_mat3_translation(turn, random.in_cube(2.0))
    };
    let soup: Vec<Moves> = (0..count).map(|_| vec![triangle(random, 2.0, 3.0)]).collect();
    let maps = [narrow(random), narrow(random)];
    scene.add_soup(&soup, &maps, true);
    backdrop(random, &mut scene, &pose);
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

/// Where a linear motion is at t = 0 and at t = 1, when it is at `p` at t with speed `v`.
fn through(p: DVec3, v: DVec3, t: f64) -> [DVec3; 2] {
    [p - t * v, p + (1.0 - t) * v]
}

fn instant(random: &mut Random) -> MovingCase {
    let length = random.integer(1..=4);
    let pose = if random.one_in(2) {
        Pose::aligned(random, length)
    } else {
        Pose::free(random, length, 1e3)
    };
    let mut scene = MovingScene::new(1);
    for _ in 0..1 + random.below(3) {
        let t = random.pick(&[0.25, 0.5, 0.75]);
        let whole = |random: &mut Random, n: i32| {
            DVec3::new(random.integer(-n..=n), random.integer(-n..=n), random.integer(-n..=n))
        };
        let at = whole(random, 4);
        let turned = |corners: [[DVec3; 2]; 3]| -> Moves {
            vec![corners.map(|c| c[0]), corners.map(|c| c[1])]
        };
        let kind = random.below(3);
        let (u, v) = (whole(random, 4), whole(random, 4));
        let soup: Vec<Moves> = (0..2 + random.below(4))
            .map(|_| {
                let mut corner = |place: DVec3| through(place, 4.0 * whole(random, 2), t);
                turned(match kind {
                    // A corner of each at one point; an edge of each over it; all in one plane.
                    0 => [corner(at), corner(at + u), corner(at + v)],
                    1 => [corner(at + u), corner(at - u), corner(at + v)],
                    _ => {
                        let mut own = || {
                            let place = at + u * f64::from(random.below(5) as u32)
                                - v * f64::from(random.below(5) as u32);
                            through(place, 4.0 * whole(random, 2), t)
                        };
                        [own(), own(), own()]
                    }
                })
            })
            .collect();
        scene.add_soup(&soup, &[pose.world_from_face], !random.one_in(4));
    }
    let sampling = coarse_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

/// A corner that is at (g, h, z) relative to the camera and a ray, at one end of its path.
fn beside(ray: (f64, f64), along: f64, (g, h, z): (f64, f64, f64)) -> DVec3 {
    DVec3::new(along + g + ray.0 * z, h + ray.1 * z, z)
}

fn graze(random: &mut Random) -> MovingCase {
    let length = random.integer(1..=4);
    let pose = Pose::aligned(random, length);
    let sampling = coarse_sampling(random);
    let mut scene = MovingScene::new(1);
    let soup: Vec<Moves> = (0..3 + random.below(6))
        .map(|_| {
            // Inner columns: c and w are short binary fractions.
            let columns = sampling.columns();
            let column = columns / 4 + random.below(columns as usize / 2) as u32;
            let row = random.below(sampling.rows() as usize) as u32;
            let ray = (sampling.column(column), sampling.row(row));
            let z = random.pick(&[1.0, 2.0, 4.0, 8.0]);
            let (a, b) = (random.integer(-3..=3), random.integer(-3..=3));
            let off = random.pick(&[0.0, 0.0, 9.5e-7, -9.5e-7, 1.0]);
            // E = a b (2 t - 1)^2 - off, for the edge of the first two corners.
            let mut third = || (random.integer(-4..=4), random.integer(-4..=4), z);
            let (r, s) = (third(), third());
            [(-1.0, 0.0), (1.0, length)]
                .map(|(k, along)| {
                    let end = if k < 0.0 { r } else { s };
                    [
                        beside(ray, along, (k * a, 1.0, z)),
                        beside(ray, along, (off, k * b, z)),
                        beside(ray, along, end),
                    ]
                })
                .to_vec()
        })
        .collect();
    scene.add_soup(&soup, &[pose.world_from_face], true);
    if random.one_in(2) {
        backdrop(random, &mut scene, &pose);
    }
    let mut case = scene.finish(random, pose.segment, sampling);
    if random.one_in(2) {
        case.path = TimePath::FORWARD;
    }
    case
}

fn lattice(random: &mut Random) -> MovingCase {
    let length = random.integer(1..=4);
    let pose = Pose::aligned(random, length);
    let mut scene = MovingScene::new(1);
    for occluder in [true, true, false] {
        let mut corner = || DVec3::from_array(std::array::from_fn(|_| random.integer(-4..=4)));
        let mut one = || -> [DVec3; 3] { std::array::from_fn(|_| corner()) };
        let soup: Vec<Moves> = (0..5).map(|_| vec![one(), one()]).collect();
        scene.add_soup(&soup, &[pose.world_from_face], occluder);
    }
    let sampling = coarse_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn sweep(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = MovingScene::new(1);
    let soup: Vec<Moves> = (0..1 + random.below(5))
        .map(|_| {
            let anywhere = random.unit();
            let t = random.pick(&[0.0, 1.0, 0.5, anywhere]);
            let at = DVec3::X * (random.pick(&[t, t, anywhere]) * length);
            let (p, q) = (random.in_cube(4.0), random.in_cube(4.0));
            let v = random.in_cube(6.0);
            let corners = match random.below(4) {
                // Through the camera's place at t, with a corner at it, with an edge over it, in the
                // camera plane.
                0 => [at + p, at + q, at - (p + q)],
                1 => [at, at + p, at + q],
                2 => [at + p, at - p, at + q],
                _ => [at + p.with_z(0.0), at + q.with_z(0.0), at - (p + q).with_z(0.0)],
            };
            let twist = random.pick(&[0.0, 0.0, 2.0]);
            let keys = corners.map(|c| through(c, v + random.in_cube(1.0) * twist, t));
            vec![keys.map(|k| k[0]), keys.map(|k| k[1])]
        })
        .collect();
    scene.add_soup(&soup, &[pose.world_from_face], true);
    backdrop(random, &mut scene, &pose);
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn turn(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = MovingScene::new(1);
    for _ in 0..2 {
        let count = 1 + random.below(6);
        let soup: Vec<Moves> = (0..count).map(|_| vec![triangle(random, 2.0, 3.0)]).collect();
        let center = random.in_cube(5.0);
        let angle = random.pick(&[90.0, 120.0, 170.0, 180.0, 181.0, 270.0, 360.0]);
        let axis = random.pick(&[DVec3::X, DVec3::Y, DVec3::Z, random.clone().direction()]);
        let turn = |by: f64| {
            let turn = DQuat::from_axis_angle(axis, by.to_radians());
            pose.world_from_face * DAffine3::from_rotation_translation(turn, center)
        };
        let mirror = DMat3::from_diagonal(random.pick(&[
            DVec3::new(1.0, 1.0, -1.0),
            DVec3::new(-1.0, -1.0, 1.0),
            DVec3::splat(-1.0),
        ]));
        let end = if random.one_in(3) {
            pose.world_from_face * DAffine3::from_mat3_translation(mirror, center)
        } else {
            turn(angle)
        };
        scene.add_soup(&soup, &[turn(0.0), end], true);
    }
    if random.one_in(2) {
        backdrop(random, &mut scene, &pose);
    }
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn speed(random: &mut Random) -> MovingCase {
    let length = random.magnitude(1e-2..1e2);
    let pose = Pose::any(random, length);
    let mut scene = MovingScene::new(1);
    // In turn all slow, all fast, and each as it likes.
    let common = random.magnitude(1e-9..1e6);
    let own = random.one_in(2);
    let soup: Vec<Moves> = (0..3 + random.below(8))
        .map(|_| {
            let first = triangle(random, 6.0, 4.0);
            let fast = if own { random.magnitude(1e-9..1e6) } else { common };
            let way = random.direction() * fast;
            let jitter = random.pick(&[0.0, 0.5]) * fast;
            vec![first, first.map(|p| p + way + random.in_cube(jitter))]
        })
        .collect();
    scene.add_soup(&soup, &[pose.world_from_face], true);
    // What is slow is lost in `f32` positions, but not in transforms.
    let soup: Vec<Moves> = (0..4).map(|_| vec![triangle(random, 6.0, 4.0)]).collect();
    let way = DAffine3::from_translation(random.direction() * common);
    scene.add_soup(&soup, &[pose.world_from_face, pose.world_from_face * way], true);
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn size(random: &mut Random) -> MovingCase {
    let length = random.magnitude(1e-3..1e2);
    let pose = Pose::free(random, length, 1e3);
    let mut scene = MovingScene::new(1);
    for _ in 0..3 + random.below(8) {
        let size = random.magnitude(1e-6..1e6);
        let mut map = || {
            let distance = size * random.magnitude(0.1..100.0);
            let at = random.direction() * distance + DVec3::X * (random.unit() * length);
            let scale = DMat3::from_diagonal(DVec3::splat(size));
            pose.world_from_face * DAffine3::from_mat3_translation(scale, at)
        };
        let maps = [map(), map()];
        let one = mover(random, 2, 0.1, 1.0);
        scene.add_soup(&[one], &maps, !random.one_in(5));
    }
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn offset(random: &mut Random) -> MovingCase {
    let length = random.magnitude(1e-2..1e2);
    let far = random.pick(&[1e5, 1e6, 1e7]);
    let v0 = random.in_cube(1.0).signum() * far + random.in_cube(1e3);
    let direction = random.direction();
    let pose = Pose::of(random, v0, direction, length);
    let mut scene = MovingScene::new(1);
    for _ in 0..3 {
        let own = random.one_in(2);
        let spread = length.max(1.0) * 4.0;
        let (count, keys) = (1 + random.below(5), if own { 2 } else { 1 });
        let soup = movers(random, count, keys, spread, spread);
        let way = DAffine3::from_rotation_translation(random.rotation(), random.in_cube(spread));
        let maps = [pose.world_from_face, pose.world_from_face * way];
        scene.add_soup(&soup, if own { &maps[..1] } else { &maps }, true);
    }
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn carried(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let states = 1 + random.below(2) as u32;
    let mut scene = MovingScene::new(states);
    for _ in 0..4 {
        let map = |random: &mut Random| {
            let shear = DMat3::from_cols(
                DVec3::X + random.in_cube(0.5),
                DVec3::Y + random.in_cube(0.5),
                DVec3::Z + random.in_cube(0.5),
            );
            let scale = DMat3::from_diagonal(random.pick(&[
                DVec3::ONE,
                DVec3::splat(0.1),
                DVec3::new(3.0, 1.0, 0.2),
                DVec3::new(-1.0, 1.0, 1.0),
                DVec3::ZERO,
                DVec3::new(1.0, 0.0, 1.0),
            ]));
            let turn = DMat3::from_quat(random.rotation());
            let linear = random.pick(&[turn, turn * scale, turn * shear * scale]);
            pose.world_from_face * DAffine3::from_mat3_translation(linear, random.in_cube(5.0))
        };
        let all = states as usize + 1;
        let (count, keys) = (1 + random.below(5), random.pick(&[1, all]));
        let soup = movers(random, count, keys, 2.0, 3.0);
        let maps: Vec<_> = (0..all).map(|_| map(random)).collect();
        let rests = random.one_in(4);
        scene.add_soup(&soup, if rests { &maps[..1] } else { &maps }, !random.one_in(5));
    }
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn mixed(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..6.0);
    let pose = Pose::any(random, length);
    let mut scene = MovingScene::new(2);
    for _ in 0..2 {
        backdrop(random, &mut scene, &pose);
        let (count, spread) = (1 + random.below(4), random.within(1.0..8.0));
        // At rest in one of the states.
        let mut soup = movers(random, count, 3, spread, 4.0);
        let rests = random.below(2);
        for moves in &mut soup {
            moves[rests + 1] = moves[rests];
        }
        let occluder = !random.one_in(3);
        scene.add_soup(&soup, &[pose.world_from_face], occluder);
        let glass: Vec<Moves> = (0..3).map(|_| vec![triangle(random, 5.0, 4.0)]).collect();
        scene.add_soup(&glass, &[pose.world_from_face], false);
    }
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn twice(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = MovingScene::new(1);
    let count = 1 + random.below(3);
    let mut soup = movers(random, count, 2, 4.0, 5.0);
    for _ in 0..1 + random.below(5) {
        let one = soup[random.below(soup.len())].clone();
        let (p, q) = (one[0], one[1]);
        soup.push(match random.below(4) {
            0 => one,
            1 => vec![[p[1], p[2], p[0]], [q[1], q[2], q[0]]],
            2 => vec![[p[2], p[1], p[0]], [q[2], q[1], q[0]]],
            // Off by about the last bits of `f32`.
            _ => vec![p, q.map(|c| c + random.in_cube(1e-6))],
        });
    }
    random.shuffle(&mut soup);
    let (one, other) = soup.split_at(soup.len() / 2);
    scene.add_soup(one, &[pose.world_from_face], true);
    scene.add_soup(other, &[pose.world_from_face], true);
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn decals(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let mut scene = MovingScene::new(1);
    for _ in 0..1 + random.below(2) {
        let mut map = || {
            let turn = DMat3::from_quat(random.rotation());
            pose.world_from_face * DAffine3::from_mat3_translation(turn, random.in_cube(4.0))
        };
        let maps = [map(), map()];
        let apart = random.pick(&[0.0, 1e-15, 1e-12, 1e-9]);
        for k in 0..1 + random.below(3) {
            let z = apart * k as f64;
            let soup: Vec<Moves> = (0..1 + random.below(3))
                .map(|_| vec![std::array::from_fn(|_| random.in_cube(5.0).with_z(z))])
                .collect();
            scene.add_soup(&soup, &maps, true);
        }
    }
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn sheet(random: &mut Random) -> MovingCase {
    let length = random.within(0.5..4.0);
    let pose = Pose::any(random, length);
    let n = 2 + random.below(6) as u32;
    let mut triangles = Vec::new();
    for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
        let at = |i: u32, j: u32| i * (n + 1) + j;
        triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
        triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
    }
    let place = |random: &mut Random, wave: f64| -> Vec<DVec3> {
        let turn = random.rotation();
        let center = random.in_cube(4.0);
        (0..=n)
            .flat_map(|i| (0..=n).map(move |j| (i, j)))
            .map(|(i, j)| {
                let of = |k: u32| 8.0 * f64::from(k) / f64::from(n) - 4.0;
                center + turn * (DVec3::new(of(i), of(j), 0.0) + random.in_cube(wave))
            })
            .collect()
    };
    let wave = random.magnitude(1e-9..2.0);
    let mut scene = MovingScene::new(1);
    let keys = [place(random, wave), place(random, wave)];
    scene.add(&keys, &triangles, &[pose.world_from_face], true);
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn lengths(random: &mut Random) -> MovingCase {
    let length = random.magnitude(1e-6..1e3);
    let pose = Pose::free(random, length, 1e3);
    let spread = length * random.magnitude(0.1..1e4);
    let mut scene = MovingScene::new(1);
    let scale = pose.world_from_face * DAffine3::from_scale(DVec3::splat(spread));
    let count = 4 + random.below(12);
    let soup = movers(random, count, 2, 1.0, 1.0);
    scene.add_soup(&soup, &[scale], true);
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}
