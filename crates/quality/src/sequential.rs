//! When enough rays were cast to know that a cell's mean error is below a target.
//!
//! Source: Wald, "Sequential Tests of Statistical Hypotheses" (1945). Rays are independent and wrong
//! with probability p, the mean pixel error. The hypothesis to refute is p >= t, the target; the
//! alternative that the test is tuned for is t / 10. After n rays of which k are wrong, the
//! likelihood ratio of the two is
//!
//! ```text
//! R = ((1 - t/10) / (1 - t))^(n - k) / 10^k
//! ```
//!
//! If p >= t, R is a supermartingale that starts at 1, so it *ever* reaches 1 / alpha with
//! probability alpha at most (Ville, 1939): one may look after every ray and stop when one likes.
//! A target of 0.0002 takes 18,000 rays when none is wrong, and 12,800 more for each that is. The
//! test gives up when R falls to 1/20: a cell with a tenth of the target's error is refined in vain
//! in one case of 20 at most.
//!
//! **Several looks.** A cell whose test fails is refined, and tested again with fresh rays. Look j
//! is made at level `alpha_j`: 4 % for the first, by far the most frequent, then 1/2 %, 1/4 % and so
//! on. The sum is below 5 %, so a bake says "met" of a cell that does not meet its target with
//! probability 5 % at most, whatever was done between the looks (union bound).
//!
//! **Upper bound.** Solving R(t) = 1 / alpha for t gives the largest mean error that is not refuted,
//! valid at every n for the same reason. It is below the target exactly when the test is passed.

/// The alternative that the test is tuned for is the target divided by this.
const EASE: f64 = 10.0;

/// The test gives up when the likelihood ratio falls to one in so many.
const GIVE_UP: f64 = 20.0;

/// A test that takes so many rays, divided by the target, gives up too: a cell that close to its
/// target is decided sooner by refining it.
const RAYS_MAX: f64 = 32.0;

/// What the rays so far say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The mean error is below the target.
    Met,
    /// It is not, or not by enough to tell soon.
    Missed,
    /// More rays are needed.
    Open,
}

/// A test of one cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorTest {
    target: f64,
    look: u32,
    rays: u64,
    wrong: u64,
}

impl ErrorTest {
    /// A test against `target`, a share of pixels in (0, 1], that is look number `look`, from 0, at
    /// its cell.
    #[must_use]
    pub const fn new(target: f64, look: u32) -> Self {
        Self { target, look, rays: 0, wrong: 0 }
    }

    /// Adds rays, of which `wrong` were wrong.
    pub const fn add(&mut self, rays: u64, wrong: u64) {
        self.rays += rays;
        self.wrong += wrong;
    }

    /// Rays so far.
    #[must_use]
    pub const fn rays(&self) -> u64 {
        self.rays
    }

    /// The mean error as measured; 0 without rays.
    #[must_use]
    pub fn mean(&self) -> f64 {
        self.wrong as f64 / self.rays.max(1) as f64
    }

    /// Logarithm of 1 / `alpha_j`.
    fn log_inverse_level(&self) -> f64 {
        match self.look {
            // 1 / 4 % = 25.
            0 => 3.218_875_824_868_200_7,
            // 1 / (1 % / 2^j) = 100 x 2^j.
            j => 4.605_170_185_988_091 + f64::from(j) * std::f64::consts::LN_2,
        }
    }

    /// The largest mean error that the rays do not refute, in [0, 1]; 1 without rays.
    #[must_use]
    pub fn upper_bound(&self) -> f64 {
        let right = (self.rays - self.wrong) as f64;
        if right == 0.0 {
            return 1.0;
        }
        let needed = self.log_inverse_level() + self.wrong as f64 * std::f64::consts::LN_10;
        // ((1 - t/10) / (1 - t))^right = e^needed, solved for t.
        let growth = libm::expm1(needed / right);
        if growth.is_finite() { growth / (growth + 1.0 - 1.0 / EASE) } else { 1.0 }
    }

    /// What the rays so far say.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        if self.upper_bound() <= self.target {
            return Verdict::Met;
        }
        let (t, right) = (self.target, (self.rays - self.wrong) as f64);
        let gained = right * libm::log1p((1.0 - 1.0 / EASE) * t / (1.0 - t));
        let lost = self.wrong as f64 * std::f64::consts::LN_10;
        let hopeless = lost - gained >= libm::log(GIVE_UP);
        if hopeless || self.rays as f64 >= RAYS_MAX / t { Verdict::Missed } else { Verdict::Open }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SplitMix64;

    fn after(target: f64, look: u32, rays: u64, wrong: u64) -> ErrorTest {
        let mut test = ErrorTest::new(target, look);
        test.add(rays, wrong);
        test
    }

    #[test]
    fn a_clean_cell_is_met_after_as_many_rays_as_the_page_says() {
        assert_eq!(after(0.0002, 0, 17_000, 0).verdict(), Verdict::Open);
        assert_eq!(after(0.0002, 0, 18_000, 0).verdict(), Verdict::Met);
        assert_eq!(after(0.0002, 0, 30_000, 1).verdict(), Verdict::Open);
        assert_eq!(after(0.0002, 0, 31_000, 1).verdict(), Verdict::Met);
        assert_eq!(after(0.0002, 3, 18_000, 0).verdict(), Verdict::Open, "later looks take more");
    }

    #[test]
    fn a_bad_cell_is_missed_early() {
        assert_eq!(after(0.0002, 0, 4096, 1).verdict(), Verdict::Open);
        assert_eq!(after(0.0002, 0, 4096, 2).verdict(), Verdict::Missed);
        assert_eq!(after(0.0002, 0, 4096, 4096).verdict(), Verdict::Missed);
        assert_eq!(after(0.0002, 0, 4096, 4096).upper_bound(), 1.0);
    }

    #[test]
    fn the_bound_and_the_verdict_agree() {
        for (rays, wrong) in [(4096, 0), (8192, 3), (100_000, 12), (1_000_000, 0)] {
            let bound = after(0.5, 0, rays, wrong).upper_bound();
            assert!(bound > wrong as f64 / rays as f64);
            assert_eq!(after(bound * 1.000_001, 0, rays, wrong).verdict(), Verdict::Met);
            assert_ne!(after(bound * 0.999_999, 0, rays, wrong).verdict(), Verdict::Met);
        }
    }

    #[test]
    fn levels_of_all_looks_add_up_to_less_than_five_percent() {
        let level = |look| (-ErrorTest::new(0.1, look).log_inverse_level()).exp();
        let sum: f64 = (0..60).map(level).sum();
        assert!((0.049..0.05 + 1e-12).contains(&sum), "{sum}");
    }

    #[test]
    fn a_cell_at_its_target_passes_seldom_however_often_one_looks() {
        // Rays one at a time, and a look after each: the harshest optional stopping.
        let (target, tests) = (0.05, 2000);
        let mut random = SplitMix64::new(5);
        let passed = (0..tests)
            .filter(|_| {
                let mut test = ErrorTest::new(target, 0);
                while test.verdict() == Verdict::Open {
                    test.add(1, u64::from(random.next_unit() < target));
                }
                test.verdict() == Verdict::Met
            })
            .count();
        // 4 % and three standard deviations of 2,000 tests.
        assert!(
            (passed as f64) < 0.04 * 2000.0 + 3.0 * (0.04 * 0.96 * 2000.0_f64).sqrt(),
            "{passed}"
        );
    }

    #[test]
    fn a_cell_far_below_its_target_seldom_misses() {
        let (target, tests) = (0.05, 2000);
        let mut random = SplitMix64::new(9);
        let missed = (0..tests)
            .filter(|_| {
                let mut test = ErrorTest::new(target, 0);
                while test.verdict() == Verdict::Open {
                    test.add(1, u64::from(random.next_unit() < target / EASE));
                }
                test.verdict() == Verdict::Missed
            })
            .count();
        assert!(
            (missed as f64) < 0.05 * 2000.0 + 3.0 * (0.05 * 0.95 * 2000.0_f64).sqrt(),
            "{missed}"
        );
    }
}
