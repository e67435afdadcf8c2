//! The short form of the numerical stress suite: every family, a few hundred cases of each. The
//! campaign is `cargo run --release -p sightline-solver --example stress -- --help`.

#[allow(dead_code, reason = "the campaign uses the rest")]
mod suite;

use sightline_solver::{SegmentVisibility, solve_segment};
use suite::{
    case::Case,
    closed::{CLOSED_FAMILIES, closed_family, leaks},
    determinism::{shuffled, taken_apart},
    families::{FAMILIES, family},
    random::Random,
    verdict::{Tally, judge_result, run, run_closed},
};

/// Each test runs cases until it has had this many pixels.
const PIXELS: u64 = 60_000;

fn solve(case: &Case) -> SegmentVisibility {
    solve_segment(&case.geometry, &case.segment, case.sampling)
}

fn assert_explained(name: &str) {
    let family = family(name).expect("the family exists");
    let mut tally = Tally::default();
    let mut seed = 0;
    while tally.pixels < PIXELS {
        tally.add(run(family, seed));
        seed += 1;
    }
    assert!(tally.unexplained.is_empty(), "{}", tally.unexplained.join("\n"));
}

macro_rules! agree_with_the_twins {
    ($($promise:ident: $family:literal,)*) => {
        /// The families that have a test.
        const PROMISED: &[&str] = &[$($family),*];
        $(
            #[test]
            fn $promise() {
                assert_explained($family);
            }
        )*
    };
}

agree_with_the_twins! {
    random_triangles_are_what_the_twins_say: "soup",
    every_row_whose_plane_cuts_a_triangle_finds_it: "one",
    ties_on_a_coarse_grid_go_the_way_of_the_definition: "grid",
    slivers_to_an_aspect_of_1e12_are_found_and_hide: "sliver",
    zero_area_and_repeated_triangles_do_no_harm: "degenerate",
    coplanar_overlaps_in_any_pose_are_what_the_twins_say: "coplanar",
    exact_depth_ties_go_to_the_lower_number: "tied",
    triangles_through_the_segment_end_intervals: "piercing",
    triangles_that_contain_the_segment_do_no_harm: "containing",
    corners_on_row_planes_axis_and_camera_plane_do_no_harm: "on-planes",
    corners_exactly_on_planes_count_as_above: "on-planes-exact",
    interpenetrating_triangles_change_places_where_they_cross: "crossing",
    segments_of_1e_minus_6_to_1e3_m_are_solved: "lengths",
    triangles_of_1e_minus_6_to_1e6_m_live_together: "sizes",
    scenes_1e7_m_from_the_origin_lose_nothing: "offset",
    meshes_1e7_m_from_their_own_origin_stay_within_the_bounds: "mesh-offset",
    directions_along_the_axis_are_solved: "along-axis",
    fans_of_thousands_of_triangles_are_what_the_twins_say: "fan",
    t_junctions_are_what_the_twins_say: "t-junction",
    layers_closer_than_the_bounds_do_no_harm: "layers",
    scaled_sheared_and_mirrored_instances_are_what_the_twins_say: "instances",
}

/// Formerly failing: the bounds knew how far a vertex is from the viewer, not how large the products
/// are that put it there.
#[test]
fn what_rounds_away_in_placing_a_mesh_is_in_the_bounds() {
    let tally = run(family("mesh-offset").expect("the family exists"), 192);
    assert!(tally.unexplained.is_empty(), "{}", tally.unexplained.join("\n"));
}

#[test]
fn every_family_has_a_promise() {
    let names: Vec<&str> = FAMILIES.iter().map(|f| f.name).collect();
    assert_eq!(names, PROMISED);
    assert!(FAMILIES.iter().all(|f| !f.about.is_empty()));
}

fn assert_no_leak(place: &str) {
    for family in CLOSED_FAMILIES.iter().filter(|f| f.name.starts_with(place)) {
        let mut tally = Tally::default();
        let mut seed = 0;
        while tally.pixels < 20 * PIXELS {
            tally.add(run_closed(family, seed));
            seed += 1;
        }
        assert!(tally.unexplained.is_empty(), "{}", tally.unexplained.join("\n"));
    }
}

#[test]
fn a_closed_mesh_around_the_segment_does_not_leak() {
    assert_no_leak("around");
}

#[test]
fn what_a_closed_mesh_in_front_holds_is_not_found() {
    assert_no_leak("front");
}

#[test]
fn every_closed_family_stands_around_or_in_front() {
    let placed = |name: &str| name.starts_with("around") || name.starts_with("front");
    assert!(CLOSED_FAMILIES.iter().all(|f| placed(f.name) && !f.about.is_empty()));
    assert!(CLOSED_FAMILIES.iter().all(|f| closed_family(f.name).is_some()));
}

/// Cases of every family, closed ones last.
fn all_cases(each: u64, mut look: impl FnMut(&str, u64, Case, Random)) {
    for seed in 0..each {
        for f in FAMILIES {
            let mut random = Random::of_case(f.name, seed);
            let case = (f.generate)(&mut random);
            look(f.name, seed, case, random);
        }
        for f in CLOSED_FAMILIES {
            let mut random = Random::of_case(f.name, seed);
            let case = (f.generate)(&mut random);
            look(f.name, seed, case, random);
        }
    }
}

#[test]
fn one_two_and_eight_threads_give_the_same_bits() {
    let pools = [1, 2, 8].map(|threads| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads start")
    });
    all_cases(3, |name, _, case, _| {
        let [one, two, eight] = pools.each_ref().map(|pool| pool.install(|| solve(&case)));
        assert_eq!(one, two, "{name}");
        assert_eq!(one, eight, "{name}");
    });
}

#[test]
fn t_junctions_leak_identically_each_time() {
    let family = family("t-junction").expect("the family exists");
    for seed in 0..50 {
        let case = || (family.generate)(&mut Random::of_case(family.name, seed));
        let first = solve(&case());
        for _ in 0..3 {
            assert_eq!(first, solve(&case()), "seed {seed}");
        }
    }
}

/// Families in general position: no two depths are equal on more than a point.
const WITHOUT_TIES: &[&str] = &["soup", "one", "crossing", "offset", "instances", "fan"];

/// The order of triangles in a mesh, and of instances, gives primitives other numbers. Results are
/// compared by the old numbers: sets are equal, weights to the rounding of a crossing (which is
/// computed from the lower to the higher number, so its last bits follow the numbering).
///
/// Where depths are tied the tie rule follows the numbering, so another triangle of the tie is
/// found. There, either result is judged by the twins under its own numbering, and together the
/// occluders cover as much.
#[test]
fn the_order_of_triangles_and_instances_does_not_matter() {
    all_cases(20, |name, _, case, mut random| {
        let other = shuffled(&case, &mut random);
        let (one, two) = (solve(&case), solve(&other.case));
        let mut mapped: Vec<(u32, f32)> = two
            .set
            .iter()
            .zip(&two.weights)
            .map(|(p, w)| (other.before[p.0 as usize], *w))
            .collect();
        mapped.sort_by_key(|m| m.0);
        if WITHOUT_TIES.contains(&name) || closed_family(name).is_some() {
            let numbers: Vec<u32> = mapped.iter().map(|m| m.0).collect();
            let expected: Vec<u32> = one.set.iter().map(|p| p.0).collect();
            assert_eq!(numbers, expected, "{name}");
            for ((p, w), v) in mapped.iter().zip(&one.weights) {
                // Sums of lengths that are off by a few u, and one rounding to `f32` each.
                assert!((w - v).abs() <= f32::EPSILON * v.max(*w) + 1e-15, "{name} {p}: {w} {v}");
            }
        }
        if closed_family(name).is_some() {
            assert!(leaks(&other.case, &two).is_empty(), "{name}");
        } else {
            let tally = judge_result(&other.case, &two, &mut random);
            assert!(tally.unexplained.is_empty(), "{name}: {}", tally.unexplained.join("\n"));
        }
    });
}

/// Same numbers, other hierarchies, other orders of insertion: the same bits.
#[test]
fn how_triangles_are_grouped_into_instances_changes_nothing() {
    all_cases(20, |name, seed, case, _| {
        if case.geometry.primitive_count() > 2000 {
            return;
        }
        let (one, other) = (solve(&case), solve(&taken_apart(&case)));
        let found = |of: &SegmentVisibility| -> Vec<(u32, u32)> {
            of.set.iter().zip(&of.weights).map(|(p, w)| (p.0, w.to_bits())).collect()
        };
        let (one, other) = (found(&one), found(&other));
        let only_in = |a: &[(u32, u32)], b: &[(u32, u32)]| -> Vec<(u32, f32)> {
            let missing = a.iter().filter(|x| !b.contains(x));
            missing.map(|x| (x.0, f32::from_bits(x.1))).collect()
        };
        let (left, right) = (only_in(&one, &other), only_in(&other, &one));
        assert!(left.is_empty() && right.is_empty(), "{name} {seed}: {left:?} {right:?}");
    });
}
