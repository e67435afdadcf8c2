//! Polynomials of low degree in Bernstein form: values, stretches and changes of sign.
//!
//! A polynomial of degree n on [0, 1] is the sum of `b_i C(n, i) t^i (1 - t)^(n - i)`. Its values lie
//! between the least and the largest coefficient; evaluation and restriction to a stretch are
//! repeated means of coefficients, which is as stable as the coefficients themselves.
//!
//! Source: Farin, "Curves and Surfaces for CAGD", chapters 4 and 5; Farouki and Rajan, "On the
//! numerical condition of polynomials in Bernstein form" (CAGD 1987).

#[inline(always)]
fn mix(a: f64, b: f64, t: f64) -> f64 {
    (1.0 - t) * a + t * b
}

/// Value of a line at `t`.
#[inline(always)]
#[must_use]
pub fn linear(b: [f64; 2], t: f64) -> f64 {
    mix(b[0], b[1], t)
}

/// Value of a quadratic at `t`.
#[inline(always)]
#[must_use]
pub fn quadratic(b: [f64; 3], t: f64) -> f64 {
    mix(mix(b[0], b[1], t), mix(b[1], b[2], t), t)
}

/// Value of a cubic at `t`.
#[inline(always)]
#[must_use]
pub fn cubic(b: [f64; 4], t: f64) -> f64 {
    mix(quadratic([b[0], b[1], b[2]], t), quadratic([b[1], b[2], b[3]], t), t)
}

/// The coefficients of a quadratic on the stretch `s..e`: its blossom there.
#[inline(always)]
#[must_use]
pub fn quadratic_on(b: [f64; 3], s: f64, e: f64) -> [f64; 3] {
    let (s0, s1) = (mix(b[0], b[1], s), mix(b[1], b[2], s));
    let (e0, e1) = (mix(b[0], b[1], e), mix(b[1], b[2], e));
    [mix(s0, s1, s), mix(s0, s1, e), mix(e0, e1, e)]
}

/// The coefficients of a cubic on the stretch `s..e`.
#[inline(always)]
#[must_use]
pub fn cubic_on(b: [f64; 4], s: f64, e: f64) -> [f64; 4] {
    let lower = |t: f64| [mix(b[0], b[1], t), mix(b[1], b[2], t), mix(b[2], b[3], t)];
    let (at_s, at_e) = (quadratic_on(lower(s), s, e), lower(e));
    [at_s[0], at_s[1], at_s[2], quadratic(at_e, e)]
}

/// A polynomial of degree at most [`Polynomial::MOST`], on a stretch of its own that is [0, 1] here.
#[derive(Clone, Copy, Debug)]
pub struct Polynomial {
    degree: usize,
    b: [f64; Self::MOST + 1],
}

/// Binomial coefficients up to 6 over k.
const BINOMIAL: [[f64; 7]; 7] = [
    [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    [1.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0],
    [1.0, 3.0, 3.0, 1.0, 0.0, 0.0, 0.0],
    [1.0, 4.0, 6.0, 4.0, 1.0, 0.0, 0.0],
    [1.0, 5.0, 10.0, 10.0, 5.0, 1.0, 0.0],
    [1.0, 6.0, 15.0, 20.0, 15.0, 6.0, 1.0],
];

impl Polynomial {
    /// Largest degree.
    pub const MOST: usize = 6;

    /// The polynomial with these coefficients, of degree one less than their number.
    #[must_use]
    pub fn new(coefficients: &[f64]) -> Self {
        let mut b = [0.0; Self::MOST + 1];
        b[..coefficients.len()].copy_from_slice(coefficients);
        Self { degree: coefficients.len() - 1, b }
    }

    /// The coefficients.
    #[must_use]
    pub fn coefficients(&self) -> &[f64] {
        &self.b[..=self.degree]
    }

    /// Largest absolute coefficient: no value is larger.
    #[must_use]
    pub fn size(&self) -> f64 {
        self.coefficients().iter().fold(0.0, |size, b| b.abs().max(size))
    }

    /// The product; its degree is the sum of both.
    #[must_use]
    pub fn times(&self, other: &Self) -> Self {
        let degree = self.degree + other.degree;
        let mut b = [0.0; Self::MOST + 1];
        for (i, x) in self.coefficients().iter().enumerate() {
            for (j, y) in other.coefficients().iter().enumerate() {
                b[i + j] += BINOMIAL[self.degree][i] * BINOMIAL[other.degree][j] * x * y;
            }
        }
        for (k, b) in b[..=degree].iter_mut().enumerate() {
            *b /= BINOMIAL[degree][k];
        }
        Self { degree, b }
    }

    /// The same polynomial, written with one degree more.
    fn raised(&self) -> Self {
        let degree = self.degree + 1;
        let mut b = [0.0; Self::MOST + 1];
        for (k, b) in b[..=degree].iter_mut().enumerate() {
            let share = k as f64 / degree as f64;
            let before = if k > 0 { share * self.b[k - 1] } else { 0.0 };
            let own = if k < degree { (1.0 - share) * self.b[k] } else { 0.0 };
            *b = before + own;
        }
        Self { degree, b }
    }

    /// The difference.
    #[must_use]
    pub fn minus(&self, other: &Self) -> Self {
        let (mut a, mut b) = (*self, *other);
        while a.degree < b.degree {
            a = a.raised();
        }
        while b.degree < a.degree {
            b = b.raised();
        }
        a.b.iter_mut().zip(b.b).for_each(|(a, b)| *a -= b);
        a
    }

    /// Value at `t`.
    #[must_use]
    pub fn at(&self, t: f64) -> f64 {
        let mut b = self.b;
        for end in (1..=self.degree).rev() {
            for k in 0..end {
                b[k] = mix(b[k], b[k + 1], t);
            }
        }
        b[0]
    }

    /// Both halves, cut at the middle.
    fn halves(&self) -> (Self, Self) {
        let (mut left, mut right) = (*self, *self);
        for step in 1..=self.degree {
            for k in (step..=self.degree).rev() {
                left.b[k] = 0.5 * (left.b[k - 1] + left.b[k]);
            }
            for k in 0..=self.degree - step {
                right.b[k] = 0.5 * (right.b[k] + right.b[k + 1]);
            }
        }
        (left, right)
    }

    /// Calls `found` with the places in (0, 1) at which the polynomial changes its sign, ascending.
    /// Values up to `noise` have no sign: a change through a stretch of them is in its middle. False
    /// when there are any but around a single root: what changes its sign twice may hide there.
    pub fn sign_changes(&self, noise: f64, mut found: impl FnMut(f64)) -> bool {
        /// Halvings until a stretch is a rounding long.
        const LEVELS: u32 = 50;
        let sign = |v: f64| i32::from(v > noise) - i32::from(v < -noise);
        let mut last = 0;
        // Since when there has been no sign.
        let mut lost = None;
        let mut note = |from: f64, now: i32| {
            if now == 0 {
                lost.get_or_insert(from);
            } else {
                if last != 0 && last != now {
                    found(lost.map_or(from, |since: f64| 0.5 * (since + from)));
                }
                (last, lost) = (now, None);
            }
        };
        // One entry a level, and one more.
        let mut stack = [(*self, 0.0, 1.0, 0u32); LEVELS as usize + 2];
        let mut open = 1;
        let mut certain = true;
        while open > 0 {
            open -= 1;
            let (p, from, to, level) = stack[open];
            let b = p.coefficients();
            let (mut low, mut high, mut changes, mut before) = (0, 0, 0, 0);
            for &b in b {
                let s = sign(b);
                (low, high) = (low.min(s), high.max(s));
                if s != 0 {
                    changes += u32::from(before == -s);
                    before = s;
                }
            }
            let (first, end) = (sign(b[0]), sign(b[p.degree]));
            if low >= 0 || high <= 0 {
                certain &= b.iter().all(|b| b.abs() > noise);
                note(from, low + high);
            } else if level == LEVELS {
                certain = false;
                note(from, first);
                note(to, end);
            } else if changes == 1 && first * end < 0 {
                // Descartes: one root.
                note(from, first);
                note(from + p.root() * (to - from), end);
            } else {
                let (left, right) = p.halves();
                let middle = 0.5 * (from + to);
                stack[open] = (right, middle, to, level + 1);
                stack[open + 1] = (left, from, middle, level + 1);
                open += 2;
            }
        }
        certain
    }

    /// The only root of a polynomial whose ends differ in sign.
    ///
    /// Source: the Illinois variant of regula falsi (Dowell and Jarratt, BIT 1971), with a halving
    /// where that is slow.
    fn root(&self) -> f64 {
        let (mut a, mut b) = ((0.0, self.b[0]), (1.0, self.b[self.degree]));
        for round in 0..100 {
            let width = b.0 - a.0;
            if width <= 4.0 * f64::EPSILON {
                break;
            }
            let t = if round % 4 == 3 {
                0.5 * (a.0 + b.0)
            } else {
                let t = a.0 + width * (a.1 / (a.1 - b.1));
                if t > a.0 && t < b.0 { t } else { 0.5 * (a.0 + b.0) }
            };
            let v = self.at(t);
            if v == 0.0 {
                return t;
            }
            if (v > 0.0) == (b.1 > 0.0) {
                b = (t, v);
                a.1 *= 0.5;
            } else {
                a = (t, v);
                b.1 *= 0.5;
            }
        }
        0.5 * (a.0 + b.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_stretch_has_the_values_of_the_whole(
            b in prop::array::uniform4(-9.0f64..9.0), (s, e, t) in (0.0..=1.0, 0.0..=1.0, 0.0..=1.0),
        ) {
            let at = mix(s, e, t);
            prop_assert!((cubic(cubic_on(b, s, e), t) - cubic(b, at)).abs() < 1e-12);
            let q = [b[0], b[1], b[2]];
            prop_assert!((quadratic(quadratic_on(q, s, e), t) - quadratic(q, at)).abs() < 1e-12);
        }

        #[test]
        fn products_and_differences_have_the_values_they_should(
            a in prop::array::uniform4(-9.0f64..9.0), b in prop::array::uniform3(-9.0f64..9.0),
            t in 0.0..=1.0,
        ) {
            let (p, q) = (Polynomial::new(&a), Polynomial::new(&b));
            prop_assert!((p.times(&q).at(t) - cubic(a, t) * quadratic(b, t)).abs() < 1e-11);
            prop_assert!((p.minus(&q).at(t) - (cubic(a, t) - quadratic(b, t))).abs() < 1e-12);
            prop_assert!((q.minus(&p).at(t) - (quadratic(b, t) - cubic(a, t))).abs() < 1e-12);
            let (left, right) = p.halves();
            prop_assert!((left.at(t) - cubic(a, 0.5 * t)).abs() < 1e-12);
            prop_assert!((right.at(t) - cubic(a, 0.5 + 0.5 * t)).abs() < 1e-12);
        }

        #[test]
        fn what_stays_within_the_noise_has_no_sign(b in prop::array::uniform4(-1.0f64..1.0)) {
            let mut found = vec![];
            Polynomial::new(&b).sign_changes(1.0, |t| found.push(t));
            prop_assert!(found.is_empty());
        }

        #[test]
        fn signs_change_where_roots_are(roots in prop::array::uniform3(-0.5f64..1.5), up in any::<bool>()) {
            let f = |t: f64| roots.iter().map(|r| t - r).product::<f64>() * if up { 1.0 } else { -1.0 };
            // The coefficients by the blossom: symmetric means of the factors.
            let factor = |k: usize, t: f64| t - roots[k];
            let blossom = |t: [f64; 3]| {
                let mut sum = 0.0;
                for p in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
                    sum += factor(0, t[p[0]]) * factor(1, t[p[1]]) * factor(2, t[p[2]]);
                }
                sum / 6.0 * if up { 1.0 } else { -1.0 }
            };
            let b = [[0.0; 3], [0.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0; 3]].map(blossom);
            prop_assert!((cubic(b, 0.3) - f(0.3)).abs() < 1e-12);
            let mut found = vec![];
            Polynomial::new(&b).sign_changes(0.0, |t| found.push(t));
            let mut sorted: Vec<f64> = roots.into_iter().filter(|r| (0.0..=1.0).contains(r)).collect();
            sorted.sort_by(f64::total_cmp);
            let apart = sorted.windows(2).all(|w| w[1] - w[0] > 1e-4);
            prop_assume!(apart);
            prop_assert_eq!(found.len(), sorted.len());
            for (t, r) in found.iter().zip(sorted) {
                prop_assert!((t - r).abs() < 1e-9, "{t} {r}");
            }
        }
    }
}
