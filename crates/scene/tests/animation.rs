//! Animations become key frames: no vertex is farther from where the file puts it than the options
//! allow, at any time.

mod fixtures;

use std::path::{Path, PathBuf};

use fixtures::{
    Fixture, files_below,
    mutate::Rng,
    oracle::{Oracle, jumps_at, worst},
    scenes,
};
use proptest::prelude::*;
use serde_json::{Value, json};
use sightline_geometry::{Moment, PrimitiveId};
use sightline_scene::{AnimationChoice, Cause, OpenOptions, Scene, SceneError};

fn options(change: impl FnOnce(&mut OpenOptions)) -> OpenOptions {
    let mut options = OpenOptions::default();
    change(&mut options);
    options
}

fn open_with(main: &[u8], options: &OpenOptions) -> Result<Scene, SceneError> {
    let scene = Scene::open_bytes(Path::new("memory/scene.glb"), main, options)?;
    scene.assert_well_formed();
    Ok(scene)
}

/// An animation with one sampler a channel: target, interpolation, times and values.
fn animate(f: &mut Fixture, channels: &[(Value, &str, &[f32], Value)]) {
    let (mut list, mut samplers) = (vec![], vec![]);
    for (target, interpolation, times, output) in channels {
        let times: Vec<[f32; 1]> = times.iter().map(|&t| [t]).collect();
        let input = f.floats(&times);
        list.push(json!({"sampler": samplers.len(), "target": target}));
        samplers.push(json!({"input": input, "output": output, "interpolation": interpolation}));
    }
    let animation = json!({"channels": list, "samplers": samplers});
    if f.json["animations"].is_null() {
        f.json["animations"] = json!([]);
    }
    f.json["animations"].as_array_mut().unwrap().push(animation);
}

fn on(node: u32, path: &str) -> Value {
    json!({"node": node, "path": path})
}

/// Corner 0 of triangle 0 at a time.
fn corner(scene: &Scene, seconds: f64) -> [f64; 3] {
    let shown = scene.geometry.triangle_at(PrimitiveId(0), scene.moment_at(seconds));
    let corners = shown.corners.map(|c| c.to_array());
    corners.into_iter().min_by(|a, b| a.iter().sum::<f64>().total_cmp(&b.iter().sum())).unwrap()
}

fn moving_square(interpolation: &str, times: &[f32], values: &[[f32; 3]]) -> Fixture {
    let mut f = Fixture::square();
    let output = f.floats(values).into();
    animate(&mut f, &[(on(0, "translation"), interpolation, times, output)]);
    f
}

#[test]
fn a_straight_motion_takes_one_state_a_stretch_and_is_held_at_both_ends() {
    let f =
        moving_square("LINEAR", &[1.0, 2.0, 4.0], &[[0.0; 3], [3.0, 0.0, 0.0], [3.0, 8.0, 0.0]]);
    let scene = f.open();
    assert_eq!(scene.key_times, [0.0, 1.0, 2.0, 4.0]);
    for (seconds, expected) in [
        (-1.0, [0.0, 0.0, 0.0]),
        (0.5, [0.0, 0.0, 0.0]),
        (1.5, [1.5, 0.0, 0.0]),
        (3.0, [3.0, 4.0, 0.0]),
        (9.0, [3.0, 8.0, 0.0]),
    ] {
        assert_eq!(corner(&scene, seconds), expected, "at {seconds} s");
    }
    let r = &scene.report;
    assert_eq!((r.states, r.duration_s, r.jumps), (3, 4.0, 0));
    assert_eq!((r.moving_objects, r.moving_triangles), (1, 2));
    assert_eq!(
        (&r.animation_names[..], &r.animations_taken[..]),
        (&["#0".into()][..], &["#0".into()][..])
    );
    assert!(scene.objects[0].bounds.max.cmpge(glam::DVec3::new(4.0, 9.0, 0.0)).all());
}

#[test]
fn moments_and_times_are_converted_both_ways() {
    let scene = moving_square("LINEAR", &[0.0, 1.0, 3.0], &[[0.0; 3], [9.0; 3], [0.0; 3]]).open();
    assert_eq!(scene.moment_at(0.25), Moment { state: 0, t: 0.25 });
    assert_eq!(scene.moment_at(1.0), Moment { state: 1, t: 0.0 });
    assert_eq!(scene.moment_at(2.0), Moment { state: 1, t: 0.5 });
    assert_eq!(scene.moment_at(7.0), Moment { state: 1, t: 1.0 });
    assert_eq!(scene.moment_at(f64::NAN), Moment::START);
    for seconds in [0.0, 0.25, 1.0, 2.5, 3.0] {
        assert!((scene.time_of(scene.moment_at(seconds)) - seconds).abs() < 1e-12);
    }
    let rest = Fixture::square().open();
    assert_eq!((&rest.key_times[..], rest.moment_at(5.0)), (&[0.0][..], Moment::START));
    assert_eq!(rest.time_of(Moment { state: 0, t: 1.0 }), 0.0);
}

#[test]
fn steps_jump_within_a_millisecond() {
    let f = moving_square("STEP", &[0.5, 1.0, 2.0], &[[0.0; 3], [5.0, 0.0, 0.0], [7.0, 0.0, 0.0]]);
    let scene = f.open();
    assert_eq!(scene.report.jumps, 2);
    assert_eq!(scene.key_times, [0.0, 1.0 - 1e-3, 1.0, 2.0 - 1e-3, 2.0]);
    for (seconds, x) in [(0.0, 0.0), (0.9, 0.0), (0.999, 0.0), (1.0, 5.0), (1.9, 5.0), (2.0, 7.0)] {
        assert_eq!(corner(&scene, seconds)[0], x, "at {seconds} s");
    }
}

#[test]
fn a_cubic_spline_follows_its_tangents() {
    // x(u) with v0 = 0, b0 = 6, a1 = 0, v1 = 4 and h = 2.
    let values = [[0.0; 3], [0.0; 3], [6.0, 0.0, 0.0], [0.0; 3], [4.0, 0.0, 0.0], [0.0; 3]];
    let f = moving_square("CUBICSPLINE", &[0.0, 2.0], &values);
    let scene = open_with(&f.glb(), &options(|o| o.motion_error = 1e-5)).unwrap();
    // At u = 1/2: 2 (1/8 - 1/2 + 1/2) 6 + 1/2 4 = 3.5.
    assert!((corner(&scene, 1.0)[0] - 3.5).abs() < 1e-5);
    // At u = 1/4: 2 (1/64 - 1/8 + 1/4) 6 + (3/16 - 1/32) 4.
    let expected = 12.0 * (1.0 / 64.0 - 0.125 + 0.25) + 4.0 * (3.0 / 16.0 - 1.0 / 32.0);
    assert!((corner(&scene, 0.5)[0] - expected).abs() < 1e-5);
}

#[test]
fn rotations_turn_the_short_way_at_constant_speed() {
    let mut f = Fixture::with_triangles(&[[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 0.0, 1.0]], None);
    // A quarter around y and its opposite quaternion: the same rotation, read as normalized shorts.
    let (s, c) = (0.25 * std::f64::consts::PI).sin_cos();
    let short = |v: f64| ((v * 32767.0).round() as i16).to_le_bytes();
    let rows = [[0.0, 0.0, 0.0, 1.0], [0.0, -s, 0.0, -c]];
    let bytes: Vec<u8> = rows.as_flattened().iter().flat_map(|&v| short(v)).collect();
    let output = f.accessor(&bytes, 5122, "VEC4", 2);
    f.json["accessors"][output as usize]["normalized"] = json!(true);
    animate(&mut f, &[(on(0, "rotation"), "LINEAR", &[0.0, 1.0], output.into())]);
    let scene = open_with(&f.glb(), &options(|o| o.motion_error = 1e-4)).unwrap();
    for share in [0.25f64, 0.5, 0.75] {
        let corners = scene.geometry.triangle_at(PrimitiveId(0), scene.moment_at(share)).corners;
        let angle = share * 0.5 * std::f64::consts::PI;
        let expected = glam::DVec3::new(angle.cos(), 0.0, -angle.sin());
        let nearest = corners.iter().map(|p| p.distance(expected)).fold(9.0, f64::min);
        assert!(nearest < 2e-4, "{share}: {corners:?}");
    }
}

#[test]
fn pointers_to_nodes_are_followed_and_others_are_counted() {
    let mut f = Fixture::square();
    let output = f.floats(&[[0.0; 3], [2.0, 0.0, 0.0]]);
    let pointer = |p: &str| {
        json!({"path": "pointer", "extensions":
        {"KHR_animation_pointer": {"pointer": p}}})
    };
    animate(
        &mut f,
        &[
            (pointer("/nodes/0/translation"), "LINEAR", &[0.0, 1.0], output.into()),
            (
                pointer("/materials/0/pbrMetallicRoughness/baseColorFactor"),
                "LINEAR",
                &[0.0, 1.0],
                output.into(),
            ),
            (pointer("/nodes/0/mesh"), "LINEAR", &[0.0, 1.0], output.into()),
            (json!({"path": "translation"}), "LINEAR", &[0.0, 1.0], output.into()),
            (on(0, "weights"), "LINEAR", &[0.0, 1.0], output.into()),
        ],
    );
    let scene = f.open();
    assert_eq!(corner(&scene, 0.5), [1.0, 0.0, 0.0]);
    let counts: Vec<u64> = scene.report.ignored_channels.iter().map(|i| i.count).collect();
    assert_eq!(counts.iter().sum::<u64>(), 4, "{:?}", scene.report.ignored_channels);
    let first = &scene.report.ignored_channels.iter().find(|i| i.count == 2).unwrap().first;
    assert!(first.contains("animation 0, channel 1: /materials/0"), "{first}");
}

#[test]
fn an_animation_is_chosen_by_name_by_index_all_together_or_not_at_all() {
    let mut f = Fixture::square();
    let other = f.root(json!({"mesh": 0, "translation": [0.0, 5.0, 0.0]}));
    let output: Value = f.floats(&[[0.0; 3], [2.0, 0.0, 0.0]]).into();
    animate(&mut f, &[(on(0, "translation"), "LINEAR", &[0.0, 1.0], output.clone())]);
    animate(&mut f, &[(on(other, "translation"), "LINEAR", &[0.0, 3.0], output.clone())]);
    f.json["animations"][1]["name"] = json!("wave");
    let open = |f: &Fixture, choice| open_with(&f.glb(), &options(|o| o.animation = choice));
    let moving = |choice| {
        let report = open(&f, choice).unwrap().report;
        (report.moving_objects, report.duration_s)
    };
    assert_eq!(moving(AnimationChoice::First), (1, 1.0));
    assert_eq!(moving(AnimationChoice::Name("wave".into())), (1, 3.0));
    assert_eq!(moving(AnimationChoice::Index(0)), (1, 1.0));
    assert_eq!(moving(AnimationChoice::All), (2, 3.0));
    assert_eq!(moving(AnimationChoice::None), (0, 0.0));
    let error = open(&f, AnimationChoice::Name("walk".into())).unwrap_err();
    assert!(error.to_string().contains("no animation `walk`; the file has #0, wave"), "{error}");
    animate(&mut f, &[(on(other, "translation"), "STEP", &[0.0, 1.0], output)]);
    let error = open(&f, AnimationChoice::All).unwrap_err();
    assert!(
        matches!(&*error.cause, Cause::AnimationConflict { first, second, .. }
        if first == "animation 1, channel 0" && second == "animation 2, channel 0"),
        "{error}"
    );
    assert!(error.help().is_some());
}

#[test]
fn what_only_holds_still_is_posed_and_rests() {
    let f = moving_square("LINEAR", &[0.0, 1.0], &[[4.0, 0.0, 0.0]; 2]);
    let scene = f.open();
    assert_eq!((scene.geometry.states, &scene.key_times[..]), (1, &[0.0][..]));
    assert!(!scene.geometry.has_motion());
    assert!(scene.instances[0].posed);
    assert_eq!(corner(&scene, 0.0), [4.0, 0.0, 0.0]);
}

#[test]
fn a_scale_of_zero_on_the_way_breaks_nothing_and_throughout_leaves_the_instance_out() {
    let mut f = Fixture::square();
    let output = f.floats(&[[1.0f32; 3], [0.0; 3], [1.0, 0.0, 1.0], [-1.0, 1.0, 1.0]]).into();
    animate(&mut f, &[(on(0, "scale"), "LINEAR", &[0.0, 1.0, 2.0, 3.0], output)]);
    let scene = f.open();
    assert_eq!(scene.report.moving_triangles, 2);
    assert_eq!(corner(&scene, 1.0), [0.0; 3]);
    let mut f = Fixture::square();
    f.root(json!({"mesh": 0}));
    let zero = f.floats(&[[0.0f32; 3]; 2]).into();
    let way = f.floats(&[[0.0f32; 3], [1.0; 3]]).into();
    animate(
        &mut f,
        &[
            (on(0, "scale"), "LINEAR", &[0.0, 1.0], zero),
            (on(0, "translation"), "LINEAR", &[0.0, 1.0], way),
        ],
    );
    let scene = f.open();
    assert_eq!(scene.geometry.primitive_count(), 2);
    assert_eq!(scene.report.warnings.len(), 1, "{:?}", scene.report.warnings);
}

#[test]
fn broken_animations_name_animation_channel_and_sampler() {
    type Case<'a> = (&'a [f32], [[f32; 3]; 2], fn(&Cause) -> bool);
    let cases: [Case; 5] = [
        (&[0.0, 0.0], [[0.0; 3]; 2], |c| matches!(c, Cause::KeyTime { at: 1, .. })),
        (&[-1.0, 0.0], [[0.0; 3]; 2], |c| matches!(c, Cause::KeyTime { at: 0, .. })),
        (&[0.0, f32::NAN], [[0.0; 3]; 2], |c| matches!(c, Cause::KeyTime { at: 1, .. })),
        (&[0.0, 1.0], [[0.0; 3], [f32::NAN; 3]], |c| matches!(c, Cause::KeyValue { at: 1, .. })),
        (&[0.0, 1.0, 2.0], [[0.0; 3]; 2], |c| matches!(c, Cause::CountMismatch { .. })),
    ];
    for (times, values, expected) in cases {
        let f = moving_square("LINEAR", times, &values);
        let error = f.try_open().unwrap_err();
        assert!(expected(&error.cause), "{error}");
        let place = error.place;
        assert_eq!((place.animation, place.channel, place.sampler), (Some(0), Some(0), Some(0)));
        let text = error.to_string();
        assert!(text.contains("animation 0, channel 0, sampler 0: "), "{text}");
        // Nothing is wrong with the scene at rest.
        open_with(&f.glb(), &options(|o| o.animation = AnimationChoice::None)).unwrap();
    }
    let mut f = moving_square("LINEAR", &[0.0, 1.0], &[[0.0; 3]; 2]);
    f.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
    assert!(matches!(f.cause(), Cause::AnimatedMatrix { .. }));
    f.json["animations"][0]["channels"][0]["sampler"] = json!("x");
    assert!(matches!(f.cause(), Cause::PartMalformed { .. }));
}

#[test]
fn limits_say_what_to_raise() {
    let mut f = Fixture::square();
    let output = f.floats(&[[0.0, 0.0, 0.0, 1.0f32], [0.0, 0.0, 1.0, 0.0]]).into();
    animate(&mut f, &[(on(0, "rotation"), "LINEAR", &[0.0, 1.0], output)]);
    let open =
        |change: fn(&mut OpenOptions)| *open_with(&f.glb(), &options(change)).unwrap_err().cause;
    assert!(matches!(open(|o| o.max_states = 3), Cause::TooManyStates { limit: 3, .. }));
    assert!(matches!(open(|o| o.motion_error = 1e-15), Cause::TooManySamples { .. }));
    assert!(matches!(open(|o| o.motion_error = 0.0), Cause::MotionError { .. }));
    assert!(matches!(open(|o| o.motion_error = f64::NAN), Cause::MotionError { .. }));
    assert!(matches!(open(|o| o.max_moving_positions = 9), Cause::TooManyMovingPositions { .. }));
    let few = open_with(&f.glb(), &options(|o| o.motion_error = 0.1)).unwrap();
    let many = open_with(&f.glb(), &options(|o| o.motion_error = 0.001)).unwrap();
    // The error of a chord falls with the square of its length.
    let ratio = f64::from(many.geometry.states) / f64::from(few.geometry.states);
    assert!((7.0..14.0).contains(&ratio), "{ratio}");
}

/// A strip of two triangles bound to two joints, the second below the first.
fn skinned() -> Fixture {
    let mut f = Fixture::new();
    let positions = f.floats(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [1.0, 2.0, 0.5]]);
    let joints = f.accessor(&[0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], 5121, "VEC4", 4);
    let weights = f.floats(&[
        [1.0, 0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, 0.0],
        [0.75, 0.25, 0.0, 0.0],
        [0.5, 0.5, 0.0, 0.0f32],
    ]);
    let indices = f.indices(&[0, 1, 2, 2, 1, 3]);
    let mesh = f.mesh(json!({"attributes": {"POSITION": positions, "JOINTS_0": joints,
        "WEIGHTS_0": weights}, "indices": indices}));
    f.root(json!({"mesh": mesh, "skin": 0, "translation": [100.0, 0.0, 0.0]}));
    let second = f.node(json!({"translation": [0.0, 1.0, 0.0]}));
    let first = f.root(json!({"children": [second], "translation": [1e6, 0.0, 0.0]}));
    f.json["skins"] = json!([{"joints": [first, second]}]);
    f
}

#[test]
fn a_skin_at_rest_poses_its_mesh_and_ignores_its_node() {
    let f = skinned();
    let scene = f.open();
    assert!(!scene.geometry.has_motion());
    let oracle = Oracle::new(Path::new(""), &f.glb(), vec![]);
    // Sixteenths of a metre at 1000 km: positions are relative to a centre near by.
    assert!(worst(&scene, &oracle, &[0.0]) < 1e-6);
    assert!(scene.geometry.bounds.min.x > 1e6 - 1.0);
}

#[test]
fn broken_skins_are_refused_by_name() {
    let mut f = skinned();
    f.json["skins"][0]["joints"] = json!([1]);
    assert!(matches!(f.cause(), Cause::VertexJoint { vertex: 2, joint: 1, joints: 1, .. }));
    f.json["skins"][0]["joints"] = json!([1, 9]);
    assert_eq!(f.try_open().unwrap_err().place.skin, Some(0));
    let outside = f.node(json!({}));
    f.json["skins"][0]["joints"] = json!([1, outside]);
    assert!(matches!(f.cause(), Cause::JointNotInScene { joint: 1, .. }));
    f.json["skins"] = json!([]);
    assert!(matches!(f.cause(), Cause::NoSuch { element: "skin", .. }));
}

/// A chain of nodes with a mesh, a skin and morph targets, moved by random samplers.
fn random(seed: u64) -> Fixture {
    let mut rng = Rng(seed);
    let mut f = skinned();
    let number = |rng: &mut Rng, size: f32| (rng.below(2001) as f32 / 1000.0 - 1.0) * size;
    let deltas: Vec<[f32; 3]> = (0..4).map(|_| [0; 3].map(|_| number(&mut rng, 1.0))).collect();
    let target = f.floats(&deltas);
    let indices = f.indices(&[0, 1, 2, 2, 1, 3]);
    let positions = f.floats(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [1.0, 2.0, 0.5]]);
    f.json["meshes"][0]["primitives"][0]["targets"] = json!([{"POSITION": target}]);
    let mesh = f.mesh(json!({"attributes": {"POSITION": positions}, "indices": indices,
        "targets": [{"POSITION": target}, {"POSITION": target}]}));
    let leaf = f.node(json!({"mesh": mesh, "translation": [1.0, 0.0, 0.0]}));
    let middle = f.node(json!({"children": [leaf], "translation": [2.0, 0.0, 1.0],
        "matrix": null}));
    f.json["nodes"][middle as usize].as_object_mut().unwrap().remove("matrix");
    let top = f.root(json!({"children": [middle], "scale": [1.0, 2.0, 1.0]}));
    let mut targets = vec![(leaf, "weights", 2), (0, "weights", 1)];
    for node in [1, 2, leaf, middle, top] {
        targets.extend([(node, "translation", 3), (node, "rotation", 4), (node, "scale", 3)]);
    }
    let mut channels = vec![];
    for (node, path, width) in targets {
        if rng.below(3) == 0 {
            continue;
        }
        let mode = ["STEP", "LINEAR", "LINEAR", "CUBICSPLINE", "CUBICSPLINE"][rng.below(5)];
        let keys = 2 + rng.below(3);
        let mut times: Vec<f32> = vec![rng.below(10) as f32 / 10.0];
        for _ in 1..keys {
            times.push(times[times.len() - 1] + 0.05 + rng.below(100) as f32 / 70.0);
        }
        let rows = keys * if mode == "CUBICSPLINE" { 3 } else { 1 };
        let size = if path == "scale" { 0.5 } else { 1.0 };
        let mut values: Vec<f32> = (0..rows * width).map(|_| number(&mut rng, size)).collect();
        if path == "rotation" && mode == "CUBICSPLINE" {
            // Near each other, so that the spline does not pass through zero.
            for k in 0..keys {
                values[(3 * k + 1) * 4 + 3] = 3.0;
            }
        } else if path == "rotation" {
            values.chunks_mut(4).for_each(|q| q[0] += 1.5);
        }
        let kind = match (path, width) {
            ("weights", _) => "SCALAR",
            (_, 3) => "VEC3",
            _ => "VEC4",
        };
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let count = if kind == "SCALAR" { rows * width } else { rows };
        let output = f.accessor(&bytes, 5126, kind, count);
        channels.push((on(node, path), mode, times, Value::from(output)));
    }
    let channels: Vec<_> =
        channels.iter().map(|(t, m, times, v)| (t.clone(), *m, &times[..], v.clone())).collect();
    animate(&mut f, &channels);
    f
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 48,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn no_vertex_is_farther_from_its_true_place_than_allowed(
        seed in any::<u64>(),
        fine in any::<bool>(),
    ) {
        let main = random(seed).glb();
        let error = if fine { 0.003 } else { 0.05 };
        let scene = open_with(&main, &options(|o| o.motion_error = error)).unwrap();
        let oracle = Oracle::new(Path::new(""), &main, vec![0]);
        let mut rng = Rng(seed);
        let end = scene.report.duration_s + 0.1;
        let mut times: Vec<f64> = (0..40).map(|_| rng.below(1 << 20) as f64 / 1048576.0 * end).collect();
        times.extend(scene.key_times.windows(2).step_by(7).map(|pair| 0.5 * (pair[0] + pair[1])));
        times.retain(|&t| !jumps_at(&scene, t));
        let worst = worst(&scene, &oracle, &times);
        // Rounding to f32, a few units at 1000 km less the centre.
        prop_assert!(worst <= error + 1e-5, "{worst} > {error}, {} states", scene.geometry.states);
    }
}

#[test]
fn instances_of_a_node_move_with_it_and_share_a_body_that_changes() {
    let mut f = Fixture::square();
    let delta = f.floats(&[[0.0, 0.0, 1.0f32]; 4]);
    f.json["meshes"][0]["primitives"][0]["targets"] = json!([{"POSITION": delta}]);
    let places = f.floats(&[[0.0; 3], [5.0, 0.0, 0.0], [0.0, 5.0, 0.0f32]]);
    let extension = json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}});
    f.json["nodes"][0]["extensions"] = extension.clone();
    let rests = f.root(json!({"mesh": 0, "extensions": extension}));
    let way = f.floats(&[[0.0f32; 3], [0.0, 0.0, 8.0]]).into();
    let weights: Value = f.floats(&[[0.0], [4.0f32]]).into();
    animate(
        &mut f,
        &[
            (on(0, "translation"), "LINEAR", &[0.0, 1.0], way),
            (on(rests, "weights"), "LINEAR", &[0.0, 1.0], weights),
        ],
    );
    let scene = f.open();
    let g = &scene.geometry;
    assert_eq!((g.instances.len(), g.meshes.len(), scene.key_times.len()), (6, 2, 2));
    for (instance, source) in g.instances.iter().zip(&scene.instances) {
        let mesh = &g.meshes[instance.mesh.index()];
        assert_eq!(instance.motion.is_some(), source.node == 0);
        assert_eq!(mesh.motion.is_some(), source.node == rests);
        let height = if source.node == 0 { 4.0 } else { 2.0 };
        let first = instance.first_primitive;
        for corner in g.triangle_at(first, scene.moment_at(0.5)).corners {
            assert_eq!(corner.z, height);
            let at = [0.0, 5.0, 0.0][source.gpu_instance.unwrap() as usize];
            assert!((at..=at + 1.0).contains(&corner.x));
        }
    }
}

#[test]
fn joints_and_weights_of_several_sets_and_types_are_one_list() {
    let mut f = skinned();
    let shorts: Vec<u8> = [1u16, 0, 0, 0].repeat(4).iter().flat_map(|v| v.to_le_bytes()).collect();
    let joints = f.accessor(&shorts, 5123, "VEC4", 4);
    let weights = f.accessor(&[255, 0, 0, 0].repeat(4), 5121, "VEC4", 4);
    f.json["accessors"][weights as usize]["normalized"] = json!(true);
    let attributes = &mut f.json["meshes"][0]["primitives"][0]["attributes"];
    (attributes["JOINTS_1"], attributes["WEIGHTS_1"]) = (joints.into(), weights.into());
    let oracle = Oracle::new(Path::new(""), &f.glb(), vec![]);
    assert!(worst(&f.open(), &oracle, &[0.0]) < 1e-6);
}

fn animated(name: &str) -> Option<PathBuf> {
    Some(scenes()?.join("animated").join(name)).filter(|p| p.exists())
}

#[test]
fn real_animations_are_where_the_files_put_them() {
    let Some(scenes) = scenes() else { return };
    // Name, moving objects.
    let expected = [
        ("AnimatedMorphCube.glb", 1),
        ("AnimatedMorphCube.gltf", 1),
        ("BoxAnimated.glb", 1),
        ("Fox.glb", 1),
        ("InterpolationTest.glb", 1),
        ("MeshPrimitiveModes.gltf", 0),
        ("NegativeScaleTest.glb", 0),
        ("RecursiveSkeletons.glb", 84),
        ("SimpleInstancing.glb", 0),
        ("SimpleMorph.gltf", 1),
        ("SimpleSkin.gltf", 1),
        ("SimpleSparseAccessor.gltf", 0),
    ];
    let mut found = vec![];
    for path in files_below(&scenes.join("animated")) {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        // The largest has 90 m long bones: a coarser error keeps it quick.
        let error = if name == "RecursiveSkeletons.glb" { 0.2 } else { 0.01 };
        let scene = Scene::open(&path, &options(|o| o.motion_error = error)).unwrap();
        scene.assert_well_formed();
        found.push((name.clone(), scene.report.moving_objects));
        if scene.report.moving_objects == 0 {
            continue;
        }
        let oracle = Oracle::new(&path, &std::fs::read(&path).unwrap(), vec![0]);
        let mut rng = Rng(7);
        let times = if name == "RecursiveSkeletons.glb" { 2 } else { 12 };
        let mut times: Vec<f64> = (0..times)
            .map(|_| rng.below(1 << 20) as f64 / 1048576.0 * scene.report.duration_s)
            .collect();
        times.retain(|&t| !jumps_at(&scene, t));
        let off = worst(&scene, &oracle, &times);
        assert!(off <= error + 1e-4, "{name}: {off}");
    }
    let expected: Vec<(String, u64)> =
        expected.iter().map(|(name, moving)| ((*name).to_owned(), *moving)).collect();
    found.sort();
    assert_eq!(found, expected);
}

#[test]
fn all_nine_ways_to_move_play_together() {
    let Some(path) = animated("InterpolationTest/glTF-Binary/InterpolationTest.glb") else {
        return;
    };
    let options = options(|o| o.animation = AnimationChoice::All);
    let scene = Scene::open(&path, &options).unwrap();
    scene.assert_well_formed();
    assert_eq!(scene.report.moving_objects, 9);
    let oracle = Oracle::new(&path, &std::fs::read(&path).unwrap(), (0..9).collect());
    let times: Vec<f64> =
        (0..40).map(|i| f64::from(i) * 0.0437).filter(|&t| !jumps_at(&scene, t)).collect();
    assert!(worst(&scene, &oracle, &times) <= 0.01 + 1e-5);
}
