//! The families of scenes with spheres: each is a function of a seed. See [`super::families`].

use glam::DVec3;

use super::{
    case::{Pose, coarse_sampling, small_sampling},
    families::{Family, families},
    random::Random,
    scene::{Ball, Moves, MovingCase, MovingScene},
};

/// All families of spheres.
pub const BALLS: &[Family] = families! {
    "ball-soup", "random spheres, some see-through", soup;
    "ball-nested", "spheres in spheres", nested;
    "ball-tangent", "spheres that touch each other at one time, or all the time", tangent;
    "ball-crossing", "spheres through spheres", crossing;
    "ball-triangles", "spheres through triangles", triangles;
    "ball-inside", "the camera inside, entering and leaving", inside;
    "ball-size", "radii of 1e-6 to 1e6 m", size;
    "ball-growing", "from nothing, to nothing, in place", growing;
    "ball-absent", "not there at a key frame", absent;
    "ball-offset", "1e5 to 1e7 m from the origin", offset;
    "ball-twice", "equal spheres, and nearly equal ones", twice;
    "ball-graze", "spheres that just touch rays, exactly", graze;
    "ball-sweep", "spheres that sweep over the camera's path and plane", sweep;
    "ball-lattice", "centres and radii on a coarse grid", lattice;
};

fn ball(random: &mut Random, keys: usize, spread: f64, size: f64) -> Ball {
    (0..keys).map(|_| Some((random.in_cube(spread), random.magnitude(0.05 * size..size)))).collect()
}

/// Adds spheres, puts the camera's start as their origin.
fn add(scene: &mut MovingScene, pose: &Pose, balls: &[Ball], occluder: bool) {
    scene.add_balls(balls, &pose.world_from_face, pose.segment.v0, occluder);
}

fn start(random: &mut Random) -> (Pose, f64) {
    let length = random.within(0.5..5.0);
    (Pose::any(random, length), length)
}

fn finish(random: &mut Random, scene: MovingScene, pose: &Pose) -> MovingCase {
    let sampling = small_sampling(random);
    scene.finish(random, pose.segment, sampling)
}

fn some(random: &mut Random, count: usize, keys: usize, spread: f64, size: f64) -> Vec<Ball> {
    (0..count).map(|_| ball(random, keys, spread, size)).collect()
}

fn soup(random: &mut Random) -> MovingCase {
    let (pose, _) = start(random);
    let states = 1 + random.below(3) as u32;
    let mut scene = MovingScene::new(states);
    for occluder in [true, true, false] {
        let (count, size) = (1 + random.below(10), random.within(0.2..3.0));
        let keys = random.pick(&[1, states as usize + 1]);
        let balls = some(random, count, keys, 6.0, size);
        add(&mut scene, &pose, &balls, occluder);
    }
    finish(random, scene, &pose)
}

fn nested(random: &mut Random) -> MovingCase {
    let (pose, _) = start(random);
    let mut scene = MovingScene::new(1);
    for _ in 0..3 {
        let outer = ball(random, 2, 6.0, 4.0);
        let mut balls = vec![outer.clone()];
        for _ in 0..1 + random.below(3) {
            let share = random.pick(&[0.5, 0.9, 0.999, 1.0 - 1e-6]);
            // Touching from inside, or about the same centre.
            let touch = random.pick(&[0.0, 0.5, 1.0]);
            let way = random.direction();
            let inner = |b: &Option<(DVec3, f64)>| {
                b.map(|(c, r)| (c + way * (touch * r * (1.0 - share)), r * share))
            };
            balls.push(outer.iter().map(inner).collect());
        }
        add(&mut scene, &pose, &balls, true);
    }
    finish(random, scene, &pose)
}

fn tangent(random: &mut Random) -> MovingCase {
    let (pose, _) = start(random);
    let mut scene = MovingScene::new(1);
    let mut balls = Vec::new();
    for _ in 0..3 {
        let one = ball(random, 2, 5.0, 2.0);
        let other = one
            .iter()
            .map(|b| {
                let r = random.within(0.1..2.0);
                b.map(|(c, own)| (c + random.direction() * (own + r), r))
            })
            .collect();
        balls.extend([one, other]);
    }
    add(&mut scene, &pose, &balls, true);
    finish(random, scene, &pose)
}

fn crossing(random: &mut Random) -> MovingCase {
    let (pose, _) = start(random);
    let mut scene = MovingScene::new(1);
    let mut balls = Vec::new();
    for _ in 0..2 {
        let at = random.in_cube(5.0);
        for _ in 0..3 + random.below(3) {
            let mut own = || Some((at + random.in_cube(1.5), random.within(0.3..2.5)));
            balls.push(vec![own(), own()]);
        }
    }
    add(&mut scene, &pose, &balls, true);
    finish(random, scene, &pose)
}

fn triangles(random: &mut Random) -> MovingCase {
    let (pose, _) = start(random);
    let mut scene = MovingScene::new(1);
    let mut balls = Vec::new();
    for _ in 0..3 {
        let at = random.in_cube(4.0);
        let mut corner = || at + random.in_cube(4.0);
        let mut one = || -> [DVec3; 3] { [corner(), corner(), corner()] };
        let soup: Vec<Moves> = vec![vec![one()], vec![one(), one()]];
        scene.add_soup(&soup, &[pose.world_from_face], !random.one_in(4));
        for _ in 0..2 {
            let mut own = || Some((at + random.in_cube(2.0), random.within(0.3..2.0)));
            balls.push(vec![own(), own()]);
        }
    }
    add(&mut scene, &pose, &balls, true);
    finish(random, scene, &pose)
}

fn inside(random: &mut Random) -> MovingCase {
    let (pose, length) = start(random);
    let mut scene = MovingScene::new(1);
    let mut balls = some(random, 4, 2, 5.0, 1.0);
    for _ in 0..1 + random.below(3) {
        let t = random.pick(&[0.0, 0.25, 0.5, 1.0]);
        let r = random.within(0.2..3.0);
        let at = DVec3::X * (t * length);
        balls.push(match random.below(4) {
            // Around the camera all the time, or at one time; on its surface; the centre on it.
            0 => vec![Some((random.in_cube(0.3), length + r)), Some((at, length + r + 1.0))],
            1 => vec![Some((at + random.in_cube(r), r))],
            2 => vec![Some((at + r * DVec3::Y, r)), Some((at + r * random.direction(), r))],
            _ => vec![Some((DVec3::ZERO, r)), Some((DVec3::X * length, r * 0.5))],
        });
    }
    add(&mut scene, &pose, &balls, true);
    finish(random, scene, &pose)
}

fn size(random: &mut Random) -> MovingCase {
    let length = random.magnitude(1e-3..1e2);
    let pose = Pose::free(random, length, 1e3);
    let mut scene = MovingScene::new(1);
    let balls: Vec<Ball> = (0..4 + random.below(10))
        .map(|_| {
            let r = random.magnitude(1e-6..1e6);
            let mut own = || {
                let away = r * random.magnitude(0.1..1e3);
                let at = random.direction() * away + DVec3::X * (random.unit() * length);
                Some((at, r * random.within(0.5..1.0)))
            };
            vec![own(), own()]
        })
        .collect();
    add(&mut scene, &pose, &balls, true);
    finish(random, scene, &pose)
}

fn growing(random: &mut Random) -> MovingCase {
    let (pose, _) = start(random);
    let mut scene = MovingScene::new(1);
    let balls: Vec<Ball> = (0..4 + random.below(8))
        .map(|_| {
            let at = random.in_cube(5.0);
            let way = random.pick(&[DVec3::ZERO, DVec3::X, random.clone().in_cube(3.0)]);
            let mut radius = || random.magnitude(1e-6..4.0);
            let (a, b) = (radius(), radius());
            let (a, b) = random.pick(&[(a, b), (0.0, b), (a, 0.0), (0.0, 0.0)]);
            vec![Some((at, a)), Some((at + way, b))]
        })
        .collect();
    add(&mut scene, &pose, &balls, true);
    finish(random, scene, &pose)
}

fn absent(random: &mut Random) -> MovingCase {
    let (pose, _) = start(random);
    let states = 1 + random.below(4);
    let mut scene = MovingScene::new(states as u32);
    let count = 4 + random.below(10);
    let mut balls = some(random, count, states + 1, 5.0, 2.0);
    for key in balls.iter_mut().flatten() {
        if random.one_in(3) {
            *key = None;
        }
    }
    add(&mut scene, &pose, &balls, !random.one_in(4));
    let others = some(random, 3, 1, 5.0, 2.0);
    add(&mut scene, &pose, &others, true);
    finish(random, scene, &pose)
}

fn offset(random: &mut Random) -> MovingCase {
    let length = random.magnitude(1e-2..1e2);
    let far = random.pick(&[1e5, 1e6, 1e7]);
    let v0 = random.in_cube(1.0).signum() * far + random.in_cube(1e3);
    let direction = random.direction();
    let pose = Pose::of(random, v0, direction, length);
    let mut scene = MovingScene::new(1);
    let spread = 4.0 * length.max(1.0);
    let count = 4 + random.below(8);
    let balls = some(random, count, 2, spread, 0.3 * spread);
    // Relative to the camera, or to the origin of the world, where `f32` is coarse.
    let origin = random.pick(&[pose.segment.v0, pose.segment.v0.round(), DVec3::ZERO]);
    scene.add_balls(&balls, &pose.world_from_face, origin, true);
    finish(random, scene, &pose)
}

fn twice(random: &mut Random) -> MovingCase {
    let (pose, _) = start(random);
    let mut scene = MovingScene::new(1);
    let count = 1 + random.below(3);
    let mut balls = some(random, count, 2, 4.0, 3.0);
    for _ in 0..2 + random.below(4) {
        let one = balls[random.below(balls.len())].clone();
        let off = random.pick(&[0.0, 0.0, 1e-6, 1e-4]);
        let moved = one.iter().map(|b| b.map(|(c, r)| (c + random.in_cube(off), r * (1.0 + off))));
        balls.push(moved.collect());
    }
    random.shuffle(&mut balls);
    let (one, other) = balls.split_at(balls.len() / 2);
    for part in [one, other].into_iter().filter(|p| !p.is_empty()) {
        add(&mut scene, &pose, part, true);
    }
    finish(random, scene, &pose)
}

/// Rays with c = w = 0 would touch a sphere exactly where its centre is a radius aside; rays of a grid
/// touch at 3-4-5 triangles. At t = 1/2 here, or all the time.
fn graze(random: &mut Random) -> MovingCase {
    let length = random.integer(1..=4);
    let pose = Pose::aligned(random, length);
    let sampling = coarse_sampling(random);
    let mut scene = MovingScene::new(1);
    let balls: Vec<Ball> = (0..3 + random.below(6))
        .map(|_| {
            let columns = sampling.columns();
            let column = columns / 4 + random.below(columns as usize / 2) as u32;
            let row = random.below(sampling.rows() as usize) as u32;
            let (c, w) = (sampling.column(column), sampling.row(row));
            let d = DVec3::new(c, w, 1.0);
            let z = random.pick(&[1.0, 2.0, 4.0, 8.0]);
            // Perpendicular to the ray, of a length that is the radius up to one rounding.
            let aside = random.pick(&[
                DVec3::new(1.0, 0.0, -c),
                DVec3::new(0.0, 1.0, -w),
                d.cross(DVec3::new(1.0, 0.0, -c)),
            ]) * random.pick(&[0.25, 0.5, 1.0]);
            let r = aside.length() * random.pick(&[1.0, 1.0, 1.0 + 1e-7, 1.0 - 1e-7]);
            let at = |t: f64| d * z + aside + DVec3::X * (t * length);
            let through = d.cross(aside).normalize() * random.integer(-4..=4);
            vec![Some((at(0.0) - through, r)), Some((at(1.0) + through, r))]
        })
        .collect();
    add(&mut scene, &pose, &balls, true);
    scene.finish(random, pose.segment, sampling)
}

fn sweep(random: &mut Random) -> MovingCase {
    let (pose, length) = start(random);
    let mut scene = MovingScene::new(1);
    let balls: Vec<Ball> = (0..2 + random.below(6))
        .map(|_| {
            let t = random.unit();
            let at = DVec3::X * (random.pick(&[t, random.clone().unit()]) * length);
            let (v, r) = (random.in_cube(8.0), random.magnitude(1e-3..3.0));
            let aside = random.direction() * random.pick(&[0.0, r, 0.5 * r]);
            vec![Some((at + aside - t * v, r)), Some((at + aside + (1.0 - t) * v, r))]
        })
        .collect();
    add(&mut scene, &pose, &balls, true);
    finish(random, scene, &pose)
}

fn lattice(random: &mut Random) -> MovingCase {
    let length = random.integer(1..=4);
    let pose = Pose::aligned(random, length);
    let mut scene = MovingScene::new(1);
    let mut own = || {
        let center = DVec3::from_array(std::array::from_fn(|_| random.integer(-4..=4)));
        Some((center, random.integer(0..=3)))
    };
    let balls: Vec<Ball> = (0..8).map(|_| vec![own(), own()]).collect();
    add(&mut scene, &pose, &balls, true);
    let sampling = coarse_sampling(random);
    scene.finish(random, pose.segment, sampling)
}
