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

/// Calls `found` with the places in (0, 1) at which a cubic changes its sign, ascending. Coefficients
/// no larger than `noise` count as 0: what stays within it has no sign of its own.
pub fn cubic_sign_changes(b: [f64; 4], noise: f64, mut found: impl FnMut(f64)) {
    /// Halvings until a stretch is a rounding long.
    const LEVELS: u32 = 52;
    let mut stack = vec![(b, 0.0, 1.0, 0)];
    let mut last = 0;
    while let Some((b, from, to, level)) = stack.pop() {
        let sign = |v: f64| i32::from(v > noise) - i32::from(v < -noise);
        let signs = b.map(sign);
        let (low, high) = (signs.into_iter().min(), signs.into_iter().max());
        if low >= Some(0) || high <= Some(0) || level == LEVELS {
            let here = if level == LEVELS { signs[3] } else { signs.into_iter().sum::<i32>() };
            if here != 0 {
                let here = here.signum();
                if last != 0 && last != here {
                    found(from);
                }
                last = here;
            }
            continue;
        }
        let middle = 0.5 * (from + to);
        stack.push((cubic_on(b, 0.5, 1.0), middle, to, level + 1));
        stack.push((cubic_on(b, 0.0, 0.5), from, middle, level + 1));
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
            cubic_sign_changes(b, 0.0, |t| found.push(t));
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
