//! The judgement of a case: every pixel's intervals, at the borders of their errors and between.

use sightline_geometry::Sampling;
use sightline_solver::{
    Pixel, SolveOptions, envelope::Interval, reference::motion, solve_states, visit_intervals,
};

use super::{
    families::Family,
    judge::{Along, CAUSES, Judge, Verdict},
    random::Random,
    scene::MovingCase,
};

/// Sums over cases.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    pub cases: u64,
    pub pixels: u64,
    /// Times at which solver and judge were compared.
    pub looks: u64,
    /// Looks that rational arithmetic decided.
    pub exact: u64,
    /// Looks at which both differ within a bound, by cause.
    pub explained: [u64; CAUSES.len()],
    /// Pixels that were solved algebraically.
    pub algebraic: u64,
    pub unexplained: Vec<String>,
}

impl Tally {
    pub fn add(&mut self, other: Self) {
        self.cases += other.cases;
        self.pixels += other.pixels;
        self.looks += other.looks;
        self.exact += other.exact;
        for (a, b) in self.explained.iter_mut().zip(other.explained) {
            *a += b;
        }
        self.algebraic += other.algebraic;
        self.unexplained.extend(other.unexplained);
    }

    fn look(&mut self, along: &Along, t: f64, answer: Option<u32>, pixel: Pixel) {
        self.looks += 1;
        match along.look(t, answer) {
            Verdict::Same(exact) => self.exact += u64::from(exact),
            Verdict::Explained(cause) => self.explained[cause as usize] += 1,
            Verdict::Unexplained(what) => self.unexplained.push(format!("{pixel:?}: {what}")),
        }
    }
}

/// A look at a random time, so many times a pixel.
const RANDOM_TIMES: usize = 2;

/// One pixel in so many is solved algebraically.
const ALGEBRAIC_ONE_IN: usize = 20_000;

/// More bodies than this, and a pixel is not solved algebraically: pairs are what that costs.
const ALGEBRAIC_BODIES_MAX: usize = 60;

/// Stretches of t that are uncertain: around each border of a list.
fn windows(intervals: &[Interval]) -> Vec<(f64, f64, f64)> {
    let mut out: Vec<(f64, f64, f64)> = Vec::new();
    let ends = intervals.iter().flat_map(|i| [(i.start, i.start_error), (i.end, i.end_error)]);
    for (at, error) in ends {
        // Slightly more than the bound, and than the rounding of the sums.
        let reach = error * (1.0 + 1e-9) + 4.0 * f64::EPSILON;
        if at > 0.0 && at < 1.0 {
            out.push((at - reach, at, at + reach));
        }
    }
    out
}

fn answer(intervals: &[Interval], t: f64) -> Option<u32> {
    intervals.iter().find(|i| i.start <= t && t < i.end).map(|i| i.primitive)
}

fn is_free(windows: &[(f64, f64, f64)], t: f64) -> bool {
    t > 0.0 && t < 1.0 && windows.iter().all(|w| t <= w.0 || t >= w.2)
}

/// Whether a list keeps VI-1.
fn well_formed(intervals: &[Interval]) -> bool {
    intervals.iter().all(|i| 0.0 <= i.start && i.start < i.end && i.end <= 1.0)
        && intervals.windows(2).all(|pair| pair[0].end <= pair[1].start)
}

/// Compares every pixel of a case with the judge, and some with the algebraic twin.
pub fn judge(case: &MovingCase, random: &mut Random) -> Tally {
    let mut tally = Tally { cases: 1, pixels: case.pixels(), ..Tally::default() };
    let Some(judge) = Judge::new(case) else { return tally };
    let MovingCase { geometry, segment, sampling, state, path, .. } = case;
    visit_intervals(geometry, segment, *sampling, *state, *path, |pixel, intervals| {
        if !well_formed(intervals) {
            tally.unexplained.push(format!("{pixel:?}: VI-1 is broken: {intervals:?}"));
            return;
        }
        let (c, w) = ray(*sampling, pixel);
        let along = judge.along(pixel.face, c, w);
        let windows = windows(intervals);
        let at_borders = windows.iter().flat_map(|w| [w.0, w.2]);
        let times: Vec<f64> = at_borders.chain((0..RANDOM_TIMES).map(|_| random.unit())).collect();
        for t in times.into_iter().filter(|&t| is_free(&windows, t)) {
            tally.look(&along, t, answer(intervals, t), pixel);
        }
        if random.one_in(ALGEBRAIC_ONE_IN) {
            algebraic(&judge, &along, pixel, (c, w), intervals, &mut tally);
        }
    });
    tally
}

fn ray(sampling: Sampling, pixel: Pixel) -> (f64, f64) {
    (sampling.column(pixel.column), sampling.row(pixel.row))
}

/// Solves a pixel with the algebraic twin. Where lists differ outside of the windows of the borders, the
/// judge is asked: it must know why.
fn algebraic(
    judge: &Judge,
    along: &Along,
    pixel: Pixel,
    (c, w): (f64, f64),
    intervals: &[Interval],
    tally: &mut Tally,
) {
    let bodies = judge.bodies(pixel.face);
    if bodies.len() > ALGEBRAIC_BODIES_MAX {
        return;
    }
    tally.algebraic += 1;
    let exact = motion::pixel(&bodies, &judge.ray(c, w)).occluders;
    let exact: Vec<(f64, f64, u32)> =
        exact.iter().map(|i| (i.t0.to_f64().value(), i.t1.to_f64().value(), i.primitive)).collect();
    let windows = windows(intervals);
    let mut borders: Vec<f64> = windows.iter().flat_map(|w| [w.0, w.2]).collect();
    borders.extend(exact.iter().flat_map(|i| [i.0, i.1]));
    borders.extend([0.0, 1.0]);
    borders.retain(|t| (0.0..=1.0).contains(t));
    borders.sort_by(f64::total_cmp);
    for pair in borders.windows(2) {
        let t = 0.5 * (pair[0] + pair[1]);
        // Shorter than what the rounding of the borders leaves: no time is in it for certain.
        if pair[1] - pair[0] < 4.0 * f64::EPSILON || !is_free(&windows, t) {
            continue;
        }
        let found = answer(intervals, t);
        let truth = exact.iter().find(|i| i.0 <= t && t < i.1).map(|i| i.2);
        if truth != found {
            match along.look(t, found) {
                Verdict::Same(_) => tally.unexplained.push(format!(
                    "{pixel:?}: the twins differ at t = {t}: {found:?}, algebraic {truth:?}"
                )),
                Verdict::Explained(cause) => tally.explained[cause as usize] += 1,
                Verdict::Unexplained(what) => tally.unexplained.push(format!("{pixel:?}: {what}")),
            }
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

/// What leaked, in words.
pub fn leaks(case: &MovingCase, with_set: bool) -> Vec<String> {
    let MovingCase { geometry, segment, sampling, state, path, .. } = case;
    let mut out = Vec::new();
    visit_intervals(geometry, segment, *sampling, *state, *path, |pixel, intervals| {
        if let Some(i) = intervals.iter().find(|i| case.hidden.contains(&i.primitive)) {
            out.push(format!("{pixel:?}: hidden, and found: {i:?}"));
        }
        let whole = intervals.first().is_some_and(|i| i.start == 0.0)
            && intervals.last().is_some_and(|i| i.end == 1.0)
            && intervals.windows(2).all(|pair| pair[0].end == pair[1].start);
        if case.surrounded && !whole {
            out.push(format!("{pixel:?}: a gap in {intervals:?}"));
        }
    });
    if with_set {
        let states = *state..*state + 1;
        let options = SolveOptions::default();
        let runs = solve_states(geometry, segment, *sampling, states, *path, None, &options);
        for p in runs.iter().flat_map(|run| run.visibility.set.iter()) {
            if case.hidden.contains(&p.0) {
                out.push(format!("{p} is hidden, and in the set"));
            }
        }
    }
    out
}

/// Runs the case of a closed family with a number, and looks for leaks.
pub fn run_closed(family: &Family, seed: u64) -> Tally {
    let case = (family.generate)(&mut Random::of_case(family.name, seed));
    let name = |leak: String| format!("--family {} --seed {seed}: {leak}", family.name);
    let unexplained = leaks(&case, seed.is_multiple_of(4)).into_iter().map(name).collect();
    Tally { cases: 1, pixels: case.pixels(), unexplained, ..Tally::default() }
}
