//! Closed meshes that move, which must not leak (VI-2): around the camera, where nothing outside is
//! ever found and no pixel has a gap, and in front of it, where nothing inside is. And spheres, which
//! are closed by themselves.
//!
//! There is no bound here. What keeps a shell between its two sides at every time is linear motion
//! between key frames: an affine map of a shell, of what is in it and of what is around it keeps the three
//! apart while it is not singular; between two rotations by up to 60 degrees, a point's distance from the
//! axis shrinks to cos(30) at most. A vertex that moves along its own ray from the centre stays on it.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use sightline_geometry::Sampling;

use super::{
    case::Pose,
    closed::{Closed, any_pose, large_sampling, sphere},
    families::{Family, families},
    random::Random,
    scene::{Moves, MovingCase, MovingScene},
};

/// All closed families.
pub const SHELLS: &[Family] = families! {
    "around-carried", "shells that move with the camera inside", around_carried;
    "around-turning", "shells that turn by up to 60 degrees, and are sheared", around_turning;
    "around-scaled", "shells that shrink and grow", around_scaled;
    "around-deforming", "shells whose vertices move on their own", around_deforming;
    "around-ball", "the camera in a sphere that moves and grows", around_ball;
    "front-carried", "what is inside of shells that pass by", front_carried;
    "front-turning", "what is inside of shells that turn and are sheared", front_turning;
    "front-scaled", "what is inside of shells that shrink to 1e-3", front_scaled;
    "front-deforming", "what is inside of shells whose vertices move", front_deforming;
    "front-ball", "what is inside of a sphere that moves and grows", front_ball;
};

/// Adds the shell at both key frames, in one instance or with its triangles dealt out to two.
fn add(
    random: &mut Random,
    scene: &mut MovingScene,
    shell: &Closed,
    keys: &[Vec<DVec3>],
    maps: &[DAffine3],
) {
    shell.assert_closed();
    if random.one_in(2) {
        scene.add(keys, &shell.triangles, maps, true);
        return;
    }
    let (mut one, mut other) = (Vec::new(), Vec::new());
    for &t in &shell.triangles {
        if random.one_in(2) { &mut one } else { &mut other }.push(t);
    }
    scene.add(keys, &one, maps, true);
    scene.add(keys, &other, maps, true);
}

/// Triangles within `size` of places that `at` gives, each with its own motion.
fn small(
    random: &mut Random,
    count: usize,
    keys: usize,
    at: impl Fn(&mut Random) -> DVec3,
    size: f64,
) -> Vec<Moves> {
    (0..count)
        .map(|_| {
            (0..keys)
                .map(|_| {
                    let place = at(random);
                    std::array::from_fn(|_| place + random.in_cube(size))
                })
                .collect()
        })
        .collect()
}

struct Setting {
    pose: Pose,
    length: f64,
    scale: f64,
    sampling: Sampling,
}

/// A shell of inner radius 0.5 `scale` (0.43 when it turns) holds a camera that keeps within 0.3 of it.
fn around_setting(random: &mut Random) -> Setting {
    let length = random.magnitude(0.05..50.0);
    let pose = any_pose(random, length);
    let scale = length * random.magnitude(2.5..100.0);
    Setting { pose, length, scale, sampling: large_sampling(random) }
}

/// Where the shell's centre may be at a time at which the camera is at x = `along`.
fn near(random: &mut Random, s: &Setting, along: f64) -> DVec3 {
    let off = random.in_cube(0.3 * s.scale / 3f64.sqrt());
    DVec3::X * along + if random.one_in(3) { DVec3::ZERO } else { off }
}

fn surrounded(
    random: &mut Random,
    s: &Setting,
    shell: &Closed,
    keys: &[Vec<DVec3>],
    maps: &[DAffine3],
) -> MovingCase {
    let mut scene = MovingScene::new(1);
    add(random, &mut scene, shell, keys, maps);
    let reach = keys.iter().flatten().fold(0.0f64, |m, p| m.max(p.length()));
    // Outside in the space of the shell, so outside at every time.
    let away = random.magnitude(1.5..100.0) * reach;
    let first = scene.first_ball();
    let one = small(random, 40, 1, |r| r.direction() * away, 0.1 * away);
    let other = small(random, 40, 1, |r| r.direction() * away, 0.1 * away);
    scene.add_soup(&one, maps, true);
    let end = scene.add_soup(&other, maps, false).end;
    let mut case = scene.finish(random, s.pose.segment, s.sampling);
    case.hidden = first..end;
    case.surrounded = true;
    case
}

fn map(pose: &Pose, linear: DMat3, at: DVec3) -> DAffine3 {
    pose.world_from_face * DAffine3::from_mat3_translation(linear, at)
}

fn uniform(by: f64) -> DMat3 {
    DMat3::from_diagonal(DVec3::splat(by))
}

/// The camera stays within 0.3 of the centre at both key frames of every path: of a reversed one, at
/// which it is at the other end of the segment, and of a part.
fn ends(random: &mut Random, s: &Setting) -> [DVec3; 2] {
    // Any time may meet any place of the camera, which are within 0.4 / 2 scales of the middle.
    let middle = 0.5 * s.length;
    let tight = Setting { scale: 0.4 * s.scale, ..*s };
    [near(random, &tight, middle), near(random, &tight, middle)]
}

fn around_carried(random: &mut Random) -> MovingCase {
    let s = around_setting(random);
    let shell = sphere(random);
    let maps = ends(random, &s).map(|at| map(&s.pose, uniform(s.scale), at));
    let keys = [shell.positions.clone()];
    surrounded(random, &s, &shell, &keys, &maps)
}

fn around_turning(random: &mut Random) -> MovingCase {
    let s = around_setting(random);
    let shell = sphere(random);
    let turn = DMat3::from_quat(DQuat::from_axis_angle(
        random.direction(),
        random.within(-60.0..60.0).to_radians(),
    ));
    let first = DMat3::from_quat(random.rotation());
    let [a, b] = ends(random, &s);
    let keys = [shell.positions.clone()];
    let linear = [first * s.scale, turn * first * (s.scale * random.within(1.0..2.0))];
    let maps = [map(&s.pose, linear[0], a), map(&s.pose, linear[1], b)];
    surrounded(random, &s, &shell, &keys, &maps)
}

fn around_scaled(random: &mut Random) -> MovingCase {
    let s = around_setting(random);
    let shell = sphere(random);
    let [a, b] = ends(random, &s);
    let mut sides = || {
        let mut side = || random.magnitude(1.0..10.0);
        DMat3::from_diagonal(DVec3::new(side(), side(), side())) * s.scale
    };
    let maps = [map(&s.pose, sides(), a), map(&s.pose, sides(), b)];
    let keys = [shell.positions.clone()];
    surrounded(random, &s, &shell, &keys, &maps)
}

fn star_keys(random: &mut Random, shell: &Closed) -> [Vec<DVec3>; 2] {
    let rough = random.magnitude(1e-6..2.0);
    let mut key = || -> Vec<DVec3> {
        shell.positions.iter().map(|p| *p * (1.0 + rough * random.unit())).collect()
    };
    [key(), key()]
}

fn around_deforming(random: &mut Random) -> MovingCase {
    let s = around_setting(random);
    let shell = sphere(random);
    let keys = star_keys(random, &shell);
    let maps = ends(random, &s).map(|at| map(&s.pose, uniform(s.scale), at));
    let moves = random.one_in(2);
    surrounded(random, &s, &shell, &keys, if moves { &maps } else { &maps[..1] })
}

fn around_ball(random: &mut Random) -> MovingCase {
    let s = around_setting(random);
    let [a, b] = ends(random, &s);
    let mut scene = MovingScene::new(1);
    let away = 4.0 * s.scale;
    let end = {
        let soup = small(random, 60, 2, |r| r.direction() * away, 0.1 * away);
        // Between two places that are far out, what moves may pass: so all of it is on one side.
        let soup: Vec<Moves> =
            soup.into_iter().map(|m| vec![m[0], m[0].map(|p| p * 1.5)]).collect();
        scene.add_soup(&soup, &[s.pose.world_from_face], true).end
    };
    let mut radius = || s.scale * random.within(1.0..1.5);
    let ball = vec![Some((a, radius())), Some((b, radius()))];
    scene.add_balls(&[ball], &s.pose.world_from_face, s.pose.segment.v0, true);
    let mut case = scene.finish(random, s.pose.segment, s.sampling);
    case.hidden = 0..end;
    case.surrounded = true;
    case
}

fn front_setting(random: &mut Random) -> Setting {
    let length = random.magnitude(0.05..50.0);
    let pose = any_pose(random, length);
    let scale = length * random.magnitude(0.01..100.0);
    Setting { pose, length, scale, sampling: large_sampling(random) }
}

/// Where a shell of up to `reach` scales is at the key frames: beyond a plane that the camera does not
/// reach, so that it never comes to the camera in between.
fn in_front(random: &mut Random, s: &Setting, reach: f64) -> [DVec3; 2] {
    let way = random.direction();
    let middle = DVec3::X * (0.5 * s.length);
    let mut one = || {
        let away = 1.1 * reach * s.scale + s.length * random.magnitude(1.0..10.0);
        let aside = random.in_cube(away);
        middle + way * away + (aside - aside.dot(way) * way)
    };
    [one(), one()]
}

fn held(
    random: &mut Random,
    s: &Setting,
    shell: &Closed,
    keys: &[Vec<DVec3>],
    maps: &[DAffine3],
) -> MovingCase {
    let mut scene = MovingScene::new(1);
    add(random, &mut scene, shell, keys, maps);
    let first = scene.first_ball();
    // Inside of the inner radius of one half.
    let one = small(random, 20, 2, |r| r.in_cube(0.1), 0.1);
    let other = small(random, 20, 1, |r| r.in_cube(0.1), 0.1);
    scene.add_soup(&one, maps, true);
    let end = scene.add_soup(&other, maps, false).end;
    let behind = small(random, 10, 2, |r| r.direction() * 10.0, 4.0);
    scene.add_soup(&behind, &[s.pose.world_from_face], true);
    let mut case = scene.finish(random, s.pose.segment, s.sampling);
    case.hidden = first..end;
    case
}

fn front_carried(random: &mut Random) -> MovingCase {
    let s = front_setting(random);
    let shell = sphere(random);
    let maps = in_front(random, &s, 1.0).map(|at| map(&s.pose, uniform(s.scale), at));
    held(random, &s, &shell, std::slice::from_ref(&shell.positions), &maps)
}

fn front_turning(random: &mut Random) -> MovingCase {
    let s = front_setting(random);
    let shell = sphere(random);
    let [a, b] = in_front(random, &s, 4.0);
    let shear = DMat3::from_cols(
        DVec3::X + random.in_cube(0.2),
        DVec3::Y + random.in_cube(0.2),
        DVec3::Z + random.in_cube(0.2),
    );
    let turn = DQuat::from_axis_angle(random.direction(), random.within(-1.0..1.0));
    let first = DMat3::from_quat(random.rotation()) * s.scale;
    let maps = [map(&s.pose, first, a), map(&s.pose, DMat3::from_quat(turn) * shear * first, b)];
    held(random, &s, &shell, std::slice::from_ref(&shell.positions), &maps)
}

fn front_scaled(random: &mut Random) -> MovingCase {
    let s = front_setting(random);
    let shell = sphere(random);
    let [a, b] = in_front(random, &s, 2.0);
    let mut sides = || {
        let mut side = || random.magnitude(1e-3..2.0);
        DMat3::from_diagonal(DVec3::new(side(), side(), side())) * s.scale
    };
    let maps = [map(&s.pose, sides(), a), map(&s.pose, sides(), b)];
    held(random, &s, &shell, std::slice::from_ref(&shell.positions), &maps)
}

fn front_deforming(random: &mut Random) -> MovingCase {
    let s = front_setting(random);
    let shell = sphere(random);
    let keys = star_keys(random, &shell);
    let maps = in_front(random, &s, 3.0).map(|at| map(&s.pose, uniform(s.scale), at));
    held(random, &s, &shell, &keys, &maps)
}

fn front_ball(random: &mut Random) -> MovingCase {
    let s = front_setting(random);
    let ends = in_front(random, &s, 2.0);
    let radii = [s.scale, s.scale * random.within(1.0..2.0)];
    let mut scene = MovingScene::new(1);
    let maps = [0, 1].map(|k| map(&s.pose, uniform(radii[k]), ends[k]));
    let one = small(random, 20, 2, |r| r.in_cube(0.3), 0.2);
    let other = small(random, 20, 1, |r| r.in_cube(0.3), 0.2);
    scene.add_soup(&one, &maps, true);
    let end = scene.add_soup(&other, &maps, false).end;
    let ball = vec![Some((ends[0], radii[0])), Some((ends[1], radii[1]))];
    scene.add_balls(&[ball], &s.pose.world_from_face, s.pose.segment.v0, true);
    let mut case = scene.finish(random, s.pose.segment, s.sampling);
    case.hidden = 0..end;
    case
}
