//! The judgement of a case: solver against twins.
//!
//! The solver gives sets and weights of whole cases. A primitive's weight is a sum over pixels of
//! length times solid-angle share, so a pixel that is wrong by more than the rounding of an `f32`
//! shows: cases are kept small, 64 to 512 pixels, and weights are compared to the last bits.

use sightline_geometry::PrimitiveId;
use sightline_solver::{SegmentVisibility, solve_segment};

use super::{
    case::Case,
    closed::{ClosedFamily, leaks},
    exact,
    families::Family,
    random::Random,
    twin::{CAUSES, Pixel, Seen, Twin, describe, share},
};

/// The kinds of outcomes of comparing one primitive, and what was looked at: sums over cases.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    pub cases: u64,
    pub pixels: u64,
    /// Pixels at which something but the end of an interval is open.
    pub undecided: u64,
    /// Primitives that may be visible, over all cases.
    pub compared: u64,
    /// Compared primitives on which solver and float twin differ, but not solver and exact twin.
    pub settled: u64,
    /// Compared primitives on which solver and exact twin differ within a bound, by cause.
    pub explained: [u64; CAUSES.len()],
    /// Pixels that were solved in rational arithmetic.
    pub exact: u64,
    pub unexplained: Vec<String>,
}

impl Tally {
    pub fn add(&mut self, other: Self) {
        self.cases += other.cases;
        self.pixels += other.pixels;
        self.undecided += other.undecided;
        self.compared += other.compared;
        self.settled += other.settled;
        for (a, b) in self.explained.iter_mut().zip(other.explained) {
            *a += b;
        }
        self.exact += other.exact;
        self.unexplained.extend(other.unexplained);
    }
}

/// What the twin says of a primitive over all pixels of a case.
#[derive(Clone, Debug, Default)]
struct Weight {
    certain: f64,
    possible: f64,
    likely: f64,
    open: [f64; CAUSES.len()],
    /// What the sums may be off by: see [`Weight::add`].
    rounding: f64,
}

impl Weight {
    fn add(&mut self, seen: &Seen, share: f64) {
        self.certain += share * seen.certain_counted;
        self.possible += share * seen.possible_counted;
        self.likely += share * seen.likely;
        for (a, b) in self.open.iter_mut().zip(seen.open) {
            *a += share * b;
        }
        // A pixel's weight is cut off to units of 2^-60. Its share of the sphere is a difference
        // of four angles below pi / 2, over 4 pi, each right to some 4 roundings: 4 u in all, on
        // either side of the comparison.
        self.rounding += 2.0f64.powi(-60) + 8.0 * sightline_geometry::UNIT_ROUNDOFF;
    }

    /// The part that ends of intervals, and intervals too short to count, leave open.
    fn slack(&self) -> f64 {
        self.open[0] + self.open[1] + self.rounding
    }
}

/// Weights are rounded to `f32`; what the twin sums up is not.
fn rounded(weight: f64) -> f64 {
    weight * f64::from(f32::EPSILON)
}

/// At most this many undecided pixels of a case are solved exactly for one primitive.
const EXACT_PIXELS_MAX: usize = 16;

/// The exact twin is cubic in the primitives of a pixel; pixels with more are left as they are.
const EXACT_PRIMITIVES_MAX: usize = 64;

/// A random number decides which pixels are solved exactly although nothing is in doubt: one case
/// in this many, one pixel each.
const SPOT_CHECK_ONE_IN: usize = 64;

/// Compares the solver with the twins on one case.
pub fn judge(case: &Case, random: &mut Random) -> Tally {
    let found = solve_segment(&case.geometry, &case.segment, case.sampling);
    judge_result(case, &found, random)
}

/// Judges a given result of a case.
pub fn judge_result(case: &Case, found: &SegmentVisibility, random: &mut Random) -> Tally {
    let mut tally = Tally { cases: 1, pixels: case.pixels(), ..Tally::default() };
    let Some(twin) = Twin::new(case) else { return tally };
    let mut weights = vec![Weight::default(); case.geometry.primitive_count() as usize];
    let spot = random.one_in(SPOT_CHECK_ONE_IN).then(|| random.below(case.pixels() as usize));
    let mut number = 0;
    twin.visit(|pixel| {
        tally.undecided += u64::from(pixel.undecided);
        let share = share(case.sampling, pixel.row, pixel.column);
        for seen in pixel.seen {
            weights[seen.primitive as usize].add(seen, share);
        }
        if spot == Some(number) {
            spot_check(case, &twin, pixel, &mut tally);
        }
        number += 1;
    });
    let in_set = found_weights(case, found, &mut tally);
    let mut doubtful = Vec::new();
    for (primitive, weight) in weights.iter().enumerate() {
        let got = in_set[primitive];
        if weight.possible == 0.0 && got.is_none() {
            continue;
        }
        tally.compared += 1;
        let value = got.unwrap_or(0.0);
        let low = weight.certain - rounded(weight.certain) - weight.rounding;
        let high = weight.possible + rounded(weight.possible) + weight.rounding;
        let missed = got.is_none() && weight.certain > 0.0;
        let invented = got.is_some() && weight.possible == 0.0;
        if missed || invented || value < low || value > high {
            let what = if missed {
                "missed"
            } else if invented {
                "invented"
            } else {
                "weight"
            };
            let name = describe(&case.geometry, primitive as u32);
            tally.unexplained.push(format!("{what}: found {got:?}, twin {weight:?}, {name}"));
        } else if (value - weight.likely).abs() > weight.slack() + rounded(weight.likely) {
            doubtful.push(primitive as u32);
        }
    }
    if !doubtful.is_empty() {
        settle(case, &twin, &doubtful, &weights, &in_set, &mut tally);
    }
    tally
}

/// Weights by primitive; complains when set and weights do not fit together.
fn found_weights(case: &Case, found: &SegmentVisibility, tally: &mut Tally) -> Vec<Option<f64>> {
    let mut out = vec![None; case.geometry.primitive_count() as usize];
    found.set.assert_well_formed();
    if found.set.len() != found.weights.len() as u64 {
        tally.unexplained.push("a set has one weight a member".into());
    }
    for (PrimitiveId(p), weight) in found.set.iter().zip(&found.weights) {
        out[p as usize] = Some(f64::from(*weight));
    }
    out
}

/// Solves the undecided pixels of the doubtful primitives exactly: does the solver agree with
/// that, or is the difference one that a bound explains?
fn settle(
    case: &Case,
    twin: &Twin,
    doubtful: &[u32],
    weights: &[Weight],
    found: &[Option<f64>],
    tally: &mut Tally,
) {
    let mut likely: Vec<f64> = doubtful.iter().map(|&p| weights[p as usize].likely).collect();
    let mut solved = 0;
    twin.visit(|pixel| {
        let concerned = pixel.undecided
            && pixel.seen.len() <= EXACT_PRIMITIVES_MAX
            && pixel.seen.iter().any(|s| s.possible > s.certain && doubtful.contains(&s.primitive));
        if !concerned || solved >= EXACT_PIXELS_MAX {
            return;
        }
        solved += 1;
        let exact = solve_exactly(case, twin, pixel, tally);
        let share = share(case.sampling, pixel.row, pixel.column);
        for (&p, likely) in doubtful.iter().zip(&mut likely) {
            let sum = |of: f64, s: &Seen| if s.primitive == p { of } else { 0.0 };
            let guess: f64 = pixel.seen.iter().map(|s| sum(s.likely, s)).sum();
            let truth: f64 = exact.iter().filter(|e| e.0 == p).map(|e| e.1).sum();
            *likely += share * (truth - guess);
        }
    });
    for (&p, likely) in doubtful.iter().zip(likely) {
        let weight = &weights[p as usize];
        let value = found[p as usize].unwrap_or(0.0);
        if (value - likely).abs() <= weight.slack() + rounded(likely) {
            tally.settled += 1;
        } else {
            let largest =
                (0..CAUSES.len()).max_by(|&a, &b| weight.open[a].total_cmp(&weight.open[b]));
            tally.explained[largest.expect("there are causes")] += 1;
        }
    }
}

/// Solves a pixel exactly, and complains when the float twin does not hold the answer.
fn solve_exactly(case: &Case, twin: &Twin, pixel: &Pixel, tally: &mut Tally) -> Vec<(u32, f64)> {
    tally.exact += 1;
    let candidates: Vec<u32> = pixel.seen.iter().map(|s| s.primitive).collect();
    let address = (pixel.face, pixel.row, pixel.column);
    let exact = exact::pixel(&case.geometry, &twin.frame, case.sampling, address, &candidates);
    compare_with_exact(case, twin, pixel, &exact, tally);
    exact
}

/// Looks at all primitives, also at those that the float twin says are not at the pixel.
fn spot_check(case: &Case, twin: &Twin, pixel: &Pixel, tally: &mut Tally) {
    if case.geometry.primitive_count() as usize > EXACT_PRIMITIVES_MAX {
        return;
    }
    tally.exact += 1;
    let all: Vec<u32> = (0..case.geometry.primitive_count()).collect();
    let address = (pixel.face, pixel.row, pixel.column);
    let exact = exact::pixel(&case.geometry, &twin.frame, case.sampling, address, &all);
    compare_with_exact(case, twin, pixel, &exact, tally);
}

fn compare_with_exact(
    case: &Case,
    twin: &Twin,
    pixel: &Pixel,
    exact: &[(u32, f64)],
    tally: &mut Tally,
) {
    // The twin rounds sums of stretches: a few u a border, far less than the error of a time.
    let time = twin.bounds.time(case.sampling.column(pixel.column));
    for &(primitive, length) in exact {
        let seen = pixel.seen.iter().find(|s| s.primitive == primitive);
        let (certain, possible) = seen.map_or((0.0, 0.0), |s| (s.certain, s.possible));
        if length < certain - time || length > possible + time {
            let at = (pixel.face, pixel.row, pixel.column);
            let name = describe(&case.geometry, primitive);
            tally.unexplained.push(format!(
                "the twin is wrong: exact {length:e}, certain {certain:e}, possible {possible:e}, \
                 pixel {at:?}, {name}"
            ));
        }
    }
}

/// Runs and judges the case of a family with a number.
pub fn run(family: &Family, seed: u64) -> Tally {
    let mut random = Random::of_case(family.name, seed);
    let case = (family.generate)(&mut random);
    let mut tally = judge(&case, &mut random);
    for line in &mut tally.unexplained {
        *line = format!("--family {} --seed {seed}: {line}", family.name);
    }
    tally
}

/// Runs the case of a closed family with a number, and looks for leaks.
pub fn run_closed(family: &ClosedFamily, seed: u64) -> Tally {
    let case = (family.generate)(&mut Random::of_case(family.name, seed));
    let found = solve_segment(&case.geometry, &case.segment, case.sampling);
    let name = |leak: String| format!("--family {} --seed {seed}: {leak}", family.name);
    let unexplained = leaks(&case, &found).into_iter().map(name).collect();
    Tally { cases: 1, pixels: case.pixels(), unexplained, ..Tally::default() }
}
