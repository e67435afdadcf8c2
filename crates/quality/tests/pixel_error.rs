//! What the measurement promises, on scenes with closed-form answers.

use glam::{DAffine3, DVec3};
use sightline_geometry::{
    CellId, Instance, InstancedGeometry, Mesh, MeshId, Moment, ObjectId, ParticleSystem,
    PrimitiveId, PrimitiveSet, Sphere, StateSets, Timeline, ViewCell,
};
use sightline_quality::{
    SCATTERED_BATCH, StateMembers, Suspect, measure_cell, measure_cell_over, measure_scattered,
    measure_scattered_over, measure_viewpoint, measure_viewpoint_at, measure_viewpoints_at,
    random_viewpoints, viewpoint_seed,
};

const RAYS: u32 = 200_000;

type Part = (Vec<[f32; 3]>, Vec<[u32; 3]>, DAffine3, bool);

fn geometry(parts: Vec<Part>) -> InstancedGeometry {
    let (mut meshes, mut instances, mut first) = (vec![], vec![], 0);
    for (k, (positions, triangles, world_from_mesh, occluder)) in (0..).zip(parts) {
        instances.push(Instance {
            mesh: MeshId(k),
            object: ObjectId(k),
            world_from_mesh,
            first_primitive: PrimitiveId(first),
            occluder,
            motion: None,
        });
        first += triangles.len() as u32;
        meshes.push(Mesh::new(positions, &triangles).0);
    }
    InstancedGeometry::new(meshes, instances)
}

/// A closed box of 12 triangles around `center`.
fn room(half: f32, center: DVec3) -> Part {
    let positions =
        (0..8).map(|i| [0, 1, 2].map(|k| if i >> k & 1 == 1 { half } else { -half })).collect();
    let quads =
        [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
    let triangles = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
    (positions, triangles, DAffine3::from_translation(center), true)
}

const TRIANGLE: [[f32; 3]; 3] = [[-1.0, -0.5, -2.0], [1.25, -0.75, -1.5], [0.25, 1.0, -2.5]];

fn panel(at: DVec3, occluder: bool) -> Part {
    (TRIANGLE.to_vec(), vec![[0, 1, 2]], DAffine3::from_translation(at), occluder)
}

/// Share of the sphere that a triangle takes, seen from the origin.
///
/// Source: Van Oosterom, Strackee, "The Solid Angle of a Plane Triangle" (1983).
fn share(corners: [DVec3; 3]) -> f64 {
    let [a, b, c] = corners.map(DVec3::normalize);
    let top = a.dot(b.cross(c)).abs();
    let bottom = 1.0 + a.dot(b) + b.dot(c) + c.dot(a);
    2.0 * top.atan2(bottom) / (4.0 * std::f64::consts::PI)
}

fn all_but(geometry: &InstancedGeometry, missing: &[u32]) -> PrimitiveSet {
    let all = 0..geometry.primitive_count();
    PrimitiveSet::from_sorted(all.filter(|p| !missing.contains(p)))
}

/// Four standard deviations of as many independent rays; the lattice is far better.
fn spread(share: f64) -> f64 {
    4.0 * (share * (1.0 - share) / f64::from(RAYS)).sqrt()
}

#[test]
fn a_missing_triangle_costs_its_solid_angle() {
    for center in [DVec3::ZERO, DVec3::new(3e5, 12.0, -7e6)] {
        let scene = geometry(vec![room(5.0, center), panel(center, true)]);
        let of = |missing: &[u32], seed| {
            measure_viewpoint(&scene, &all_but(&scene, missing), center, RAYS, seed)
        };
        let expected = share(TRIANGLE.map(|p| DVec3::from_array(p.map(f64::from))));
        for seed in 0..4 {
            assert_eq!(of(&[], seed).wrong, 0);
            let error = of(&[12], seed).error;
            assert!((error - expected).abs() < spread(expected), "{error} {expected}");
        }
        // A hole in the room itself: there is nothing behind it.
        let hole = scene.triangle(PrimitiveId(3)).corners.map(|p| p - center);
        let error = of(&[3, 12], 1).error;
        assert!(error > share(hole) - spread(share(hole)), "{error}");
    }
}

#[test]
fn a_hidden_triangle_costs_nothing() {
    let scene = geometry(vec![room(5.0, DVec3::ZERO), panel(DVec3::new(0.0, 0.0, -4.0), true)]);
    let error = measure_viewpoint(&scene, &all_but(&scene, &[12]), DVec3::ZERO, RAYS, 1);
    assert_eq!(error.wrong, 0);
}

#[test]
fn coplanar_duplicates_are_no_error() {
    // The same panel twice in one place, reached by two different transforms, far from the
    // world's origin: depths differ by rounding only.
    let at = DVec3::new(1e6, 1e3, -3e5);
    let turned = DAffine3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.7);
    let positions: Vec<DVec3> =
        vec![DVec3::new(-1.0, -0.5, -2.0), DVec3::new(1.0, -0.5, -2.0), DVec3::new(0.0, 1.0, -2.0)];
    let exact = positions.iter().map(|p| p.as_vec3().to_array()).collect::<Vec<_>>();
    let scaled = exact.iter().map(|p| p.map(|x| x * 4.0)).collect();
    let quarter = DAffine3::from_scale(DVec3::splat(0.25));
    let world = DAffine3::from_translation(at) * turned;
    let scene = geometry(vec![
        room(5.0, at),
        (exact, vec![[0, 1, 2]], world, true),
        (scaled, vec![[0, 1, 2]], world * quarter, true),
    ]);
    for missing in [12, 13] {
        let set = all_but(&scene, &[missing]);
        let error = measure_viewpoint(&scene, &set, at, RAYS, 5);
        assert_eq!(error.wrong, 0, "without {missing}");
    }
    assert!(measure_viewpoint(&scene, &all_but(&scene, &[12, 13]), at, RAYS, 5).wrong > 1000);
    // The result depends on the one that is missing all the same: what is met in its place may not tie.
    let suspect = Suspect { viewpoint: at, moment: Moment::START };
    let met = [12, 13].map(|missing| {
        let sets = StateSets::constant(0..1, all_but(&scene, &[missing]));
        measure_viewpoints_at(&scene, &sets, CellId(0), &[suspect], RAYS, 5).missing
    });
    assert!(met.iter().any(|missing| !missing.is_empty()), "one of them is met first");
}

#[test]
fn a_panel_a_hair_in_front_is_no_tie() {
    let near = DVec3::new(0.0, 0.0, 1e-6);
    let scene = geometry(vec![room(5.0, DVec3::ZERO), panel(DVec3::ZERO, true), panel(near, true)]);
    let of =
        |missing| measure_viewpoint(&scene, &all_but(&scene, &[missing]), DVec3::ZERO, RAYS, 5);
    assert!(of(13).wrong > 1000, "the nearer one is needed");
    // The farther one shows only past the rim of the nearer one, a millionth of its size.
    assert!(of(12).wrong <= 1);
}

#[test]
fn a_missing_see_through_triangle_costs_its_solid_angle_when_nothing_opaque_is_nearer() {
    let expected = share(TRIANGLE.map(|p| DVec3::from_array(p.map(f64::from))));
    let glass = |parts: Vec<Part>, missing: &[u32]| {
        let scene = geometry(parts);
        measure_viewpoint(&scene, &all_but(&scene, missing), DVec3::ZERO, RAYS, 2).error
    };
    let walls = || room(5.0, DVec3::ZERO);
    let behind = DVec3::new(0.0, 0.0, -1.0);
    // Visible, and the wall behind it stays visible.
    let error = glass(vec![walls(), panel(DVec3::ZERO, false)], &[12]);
    assert!((error - expected).abs() < spread(expected), "{error} {expected}");
    // A second pane behind it is no replacement, one at the same depth is.
    let error = glass(vec![walls(), panel(DVec3::ZERO, false), panel(behind, false)], &[12]);
    assert!((error - expected).abs() < spread(expected), "{error} {expected}");
    assert_eq!(
        glass(vec![walls(), panel(DVec3::ZERO, false), panel(DVec3::ZERO, false)], &[13]),
        0.0
    );
    // Behind something opaque, or in its plane, it cannot be seen.
    let outside = DVec3::new(0.0, 0.0, -6.0);
    assert_eq!(glass(vec![walls(), panel(outside, false)], &[12]), 0.0);
    assert_eq!(
        glass(vec![walls(), panel(DVec3::ZERO, true), panel(DVec3::ZERO, false)], &[13]),
        0.0
    );
    // It hides nothing: the opaque panel behind it is still needed.
    let error = glass(vec![walls(), panel(behind, true), panel(DVec3::ZERO, false)], &[12]);
    let expected = share(TRIANGLE.map(|p| DVec3::from_array(p.map(f64::from)) + behind));
    assert!((error - expected).abs() < spread(expected), "{error} {expected}");
}

fn cell() -> ViewCell {
    let corner = |x: f64, z: f64| DVec3::new(x, 0.1 * x, z);
    let corners = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
    ViewCell { id: CellId(7), corners, height: 0.5 }
}

#[test]
fn results_depend_on_the_seed_and_not_on_threads() {
    let scene = geometry(vec![room(5.0, DVec3::ZERO), panel(DVec3::ZERO, true)]);
    let set = all_but(&scene, &[3, 12]);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| measure_cell(&scene, &set, &cell(), 5, 10_000, 11))
    };
    let one = on(1);
    assert_eq!(one, on(3));
    assert_ne!(one, measure_cell(&scene, &set, &cell(), 5, 10_000, 12));
    // Pinned: these counts are the same on every machine.
    let wrong: Vec<u32> = one.viewpoints.iter().map(|v| v.wrong).collect();
    assert_eq!(wrong, PINNED);
    // Each viewpoint can be measured again on its own.
    let worst = one.worst().unwrap();
    assert_eq!(worst.error, one.max());
    let again = measure_viewpoint(&scene, &set, worst.viewpoint, 10_000, worst.seed);
    assert_eq!(*worst, again);
    assert_eq!(one.viewpoints[2].seed, viewpoint_seed(11, CellId(7), 2));
}

const PINNED: [u32; 5] = [1265, 1028, 1095, 950, 1029];

#[test]
fn viewpoints_fill_the_cell() {
    let points = random_viewpoints(&cell(), 2000, 3);
    assert!(points.iter().all(|&p| cell().contains(p)));
    let mean = points.iter().sum::<DVec3>() / 2000.0;
    assert!((mean - cell().center()).length() < 0.05, "{mean}");
    assert_eq!(points[..10], random_viewpoints(&cell(), 10, 3)[..]);
}

#[test]
fn many_rays_are_taken_in_batches() {
    let scene = geometry(vec![room(5.0, DVec3::ZERO), panel(DVec3::ZERO, true)]);
    let set = all_but(&scene, &[12]);
    let expected = share(TRIANGLE.map(|p| DVec3::from_array(p.map(f64::from))));
    let error = measure_viewpoint(&scene, &set, DVec3::ZERO, (1 << 20) + 50_000, 1);
    assert!((error.error - expected).abs() < 1e-3);
    assert_eq!(measure_viewpoint(&scene, &set, DVec3::ZERO, 0, 1).error, 0.0);
}

#[test]
fn single_rays_measure_the_mean_error_of_the_cell() {
    let scene = geometry(vec![room(5.0, DVec3::ZERO), panel(DVec3::ZERO, true)]);
    let set = all_but(&scene, &[12]);
    let expected = measure_cell(&scene, &set, &cell(), 200, 2000, 1).mean();
    let scattered = |seed| -> Vec<DVec3> {
        (0..20).flat_map(|b| measure_scattered(&scene, &set, &cell(), b, seed)).collect()
    };
    let wrong = scattered(1);
    let rays = f64::from(20 * SCATTERED_BATCH);
    let found = wrong.len() as f64 / rays;
    assert!((found - expected).abs() < 5.0 * (expected / rays).sqrt(), "{found} {expected}");
    assert!(wrong.iter().all(|&p| cell().contains(p)));
    assert!(wrong.windows(2).all(|w| w[0] != w[1]), "every ray has a viewpoint of its own");
    assert_ne!(wrong, scattered(2));
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert_eq!(pool.install(|| scattered(1)), wrong, "the same on {threads} threads");
    }
    let all = all_but(&scene, &[]);
    assert!(measure_scattered(&scene, &all, &cell(), 0, 1).is_empty());
}

/// A room with a panel that is there, see-through or not, and moves behind the far wall in the second
/// of three states.
fn leaving(occluder: bool) -> InstancedGeometry {
    let still = geometry(vec![room(5.0, DVec3::ZERO), panel(DVec3::ZERO, occluder)]);
    let mut instances = still.instances;
    let at = |z: f64| DAffine3::from_translation(DVec3::new(0.0, 0.0, z));
    instances[1].motion = Some(Box::new([at(0.0), at(0.0), at(-9.0), at(-9.0)]));
    InstancedGeometry::with_motion(still.meshes, instances, vec![], 3)
}

fn clock() -> Timeline {
    Timeline::new(vec![0.0, 1.0, 2.0, 4.0]).unwrap()
}

/// The room alone in `states`, the panel with it in the others.
fn without_panel(scene: &InstancedGeometry, states: std::ops::Range<u32>) -> StateSets {
    let (all, room) = (all_but(scene, &[]), all_but(scene, &[12]));
    StateSets::from_runs(
        (0..3).map(|k| (k..k + 1, if states.contains(&k) { room.clone() } else { all.clone() })),
    )
}

#[test]
fn the_set_of_the_moment_counts() {
    for occluder in [true, false] {
        let scene = leaving(occluder);
        let expected = share(TRIANGLE.map(|p| DVec3::from_array(p.map(f64::from))));
        let error = |sets: &StateSets, state, t| {
            let at = Suspect { viewpoint: DVec3::ZERO, moment: Moment { state, t } };
            measure_viewpoint_at(&scene, sets, at, RAYS, 3).error
        };
        let missing = without_panel(&scene, 0..3);
        assert!((error(&missing, 0, 0.5) - expected).abs() < spread(expected));
        assert!((error(&missing, 1, 0.0) - expected).abs() < spread(expected));
        assert!(error(&missing, 1, 0.1) < 0.9 * expected, "it moves away");
        assert_eq!(error(&missing, 1, 0.9), 0.0, "it is behind the wall");
        assert_eq!(error(&missing, 2, 0.5), 0.0);
        // It is enough to have it where it is seen.
        let right = without_panel(&scene, 2..3);
        assert!([(0, 0.5), (1, 0.1), (2, 0.5)].iter().all(|&(k, t)| error(&right, k, t) == 0.0));
    }
}

#[test]
fn random_moments_are_uniform_over_time() {
    let scene = leaving(true);
    let cell = cell();
    let sets = without_panel(&scene, 0..3);
    let members = StateMembers::new(&sets, scene.primitive_count());
    let over = |sets: &StateSets, seed| -> Vec<Suspect> {
        let members = StateMembers::new(sets, scene.primitive_count());
        (0..20)
            .flat_map(|b| measure_scattered_over(&scene, &members, &clock(), &cell, b, seed).wrong)
            .collect()
    };
    let wrong = over(&sets, 1);
    assert!(wrong.iter().all(|w| w.moment.state < 2 && cell.contains(w.viewpoint)));
    let first = wrong.iter().filter(|w| w.moment.state == 0).count() as f64;
    // The first state takes a quarter of the time.
    let alone = over(&sets.within(0..1), 1).len() as f64;
    assert!((first - alone / 4.0).abs() < 5.0 * first.sqrt(), "{first} {alone}");
    let late = sets.within(2..3);
    assert!(over(&late, 1).is_empty());
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let again =
            pool.install(|| measure_scattered_over(&scene, &members, &clock(), &cell, 0, 1).wrong);
        assert_eq!(again, wrong[..again.len()], "the same on {threads} threads");
    }
    let full = measure_cell_over(&scene, &sets, &clock(), &cell, 50, 1000, 1);
    let states: std::collections::BTreeSet<u32> =
        full.viewpoints.iter().map(|v| v.moment.state).collect();
    assert_eq!(states.len(), 3, "viewpoints are looked at at moments of all states");
    assert!(full.viewpoints.iter().all(|v| v.moment.state < 2 || v.wrong == 0));
    let worst = full.worst().unwrap();
    let at = Suspect { viewpoint: worst.viewpoint, moment: worst.moment };
    assert_eq!(measure_viewpoint_at(&scene, &sets, at, 1000, worst.seed), *worst);
}

#[test]
fn viewpoints_and_directions_do_not_depend_on_whether_something_moves() {
    let scene = geometry(vec![room(5.0, DVec3::ZERO), panel(DVec3::ZERO, true)]);
    let set = all_but(&scene, &[12]);
    let still = measure_scattered(&scene, &set, &cell(), 0, 4);
    let sets = StateSets::constant(0..3, set.clone());
    let members = StateMembers::new(&sets, scene.primitive_count());
    let moving = measure_scattered_over(&scene, &members, &clock(), &cell(), 0, 4).wrong;
    assert!(moving.iter().map(|s| s.viewpoint).eq(still));
    assert!(moving.windows(2).any(|w| w[0].moment.state != w[1].moment.state));
    let still = measure_cell(&scene, &set, &cell(), 5, 1000, 11);
    let moving = measure_cell_over(&scene, &sets, &clock(), &cell(), 5, 1000, 11);
    let wrong =
        |e: &sightline_quality::CellError| e.viewpoints.iter().map(|v| v.wrong).collect::<Vec<_>>();
    assert_eq!(wrong(&still), wrong(&moving));
}

#[test]
fn missing_particles_are_found() {
    for occluder in [true, false] {
        let still = geometry(vec![room(5.0, DVec3::ZERO)]);
        let sphere = vec![Sphere { center: [0.0, 0.0, -2.0], radius: 1.0 }];
        let keys = vec![sphere.clone(), sphere, vec![Sphere::ABSENT]];
        let (object, first) = (ObjectId(1), PrimitiveId(12));
        let (system, _) = ParticleSystem::new(object, first, occluder, DVec3::ZERO, keys);
        let scene = InstancedGeometry::with_motion(still.meshes, still.instances, vec![system], 2);
        let sets = StateSets::constant(0..2, all_but(&scene, &[12]));
        let error = |state| {
            let at = Suspect { viewpoint: DVec3::ZERO, moment: Moment { state, t: 0.5 } };
            measure_viewpoint_at(&scene, &sets, at, RAYS, 3).error
        };
        // A ball of radius 1 at distance 2: a cap of half-angle 30 degrees.
        let expected = (1.0 - 0.75f64.sqrt()) / 2.0;
        assert!((error(0) - expected).abs() < spread(expected), "{} {expected}", error(0));
        assert_eq!(error(1), 0.0, "it is gone");
    }
}
