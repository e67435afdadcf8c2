//! Roots of quadratics, to the last bits: where an edge that moves passes a ray.
//!
//! `a t^2 + 2 b t + c = 0` has the roots q / a and c / q with q = -(b + sign(b) sqrt(b^2 - a c)). The
//! sum in q never cancels; the discriminant may, so it is summed without error first.
//!
//! *Sign of the discriminant.* With fused multiply-add, b^2 = p + e and a c = q + f exactly, and
//! p - q, e - f are sums of two numbers each. All are multiples of the last bit of a product, some
//! 2^-106 of the largest; the sums of the small parts are exact there, so the sum is 0 only if it is,
//! and never has the wrong sign: a double root is found to be one, as an exact oracle has it.
//!
//! *Error of a root.* With u the unit roundoff: the discriminant is right to u, its root to 1.5 u, q
//! to 2.5 u, the quotient to 3.5 u: at most 4 units in the last place, unless the root lies among the
//! subnormal numbers, where the scaling back rounds once more.
//!
//! *Range.* The variable is scaled by a power of two that makes a and c equally large, then all three
//! coefficients by one that makes the largest 1: nothing over- or underflows that matters, for any
//! finite coefficients. Where b is so large that a c does not show in the discriminant, the roots are
//! -2 b / a and -c / (2 b).
//!
//! Sources: Kahan, "On the Cost of Floating-Point Computation Without Extra-Precise Arithmetic"
//! (2004); Jeannerod, Louvet, Muller, "Further analysis of Kahan's algorithm for the accurate
//! computation of 2 x 2 determinants" (Math. Comp. 2013); Shewchuk, "Adaptive Precision
//! Floating-Point Arithmetic" (1997) for the sums.

/// Real roots of a quadratic, ascending. A double root is one root.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Roots {
    /// No real root, or no equation: all coefficients are 0.
    None,
    /// The root of a linear equation.
    Simple(f64),
    /// A root at which the quadratic touches 0.
    Double(f64),
    /// Two roots, ascending.
    Two(f64, f64),
}

/// Sum and error of two numbers. Source: Knuth, TAOCP 2, 4.2.2.
#[inline(always)]
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let s = a + b;
    let bb = s - a;
    (s, (a - (s - bb)) + (b - bb))
}

/// Product and error of two numbers.
#[inline(always)]
fn two_product(a: f64, b: f64) -> (f64, f64) {
    let p = a * b;
    (p, a.mul_add(b, -p))
}

/// `b^2 - a c`: rounded once, of the right sign, 0 only if it is. No product may under- or overflow.
#[inline(always)]
fn discriminant(a: f64, b: f64, c: f64) -> f64 {
    let ((p, e), (q, f)) = (two_product(b, b), two_product(a, c));
    let (s, s_low) = two_sum(p, -q);
    let (d, d_low) = two_sum(e, -f);
    let (m, m_low) = two_sum(s_low, d);
    let (high, low) = two_sum(s, m);
    high + (low + (m_low + d_low))
}

/// Exponent e of a finite number other than 0: 2^e <= |v| < 2^(e + 1).
fn exponent(v: f64) -> i32 {
    let biased = |v: f64| ((v.to_bits() >> 52) & 0x7ff) as i32;
    match biased(v) {
        // Subnormal: brought into the normal range by 2^64.
        0 => biased(v * 18_446_744_073_709_551_616.0) - 1023 - 64,
        e => e - 1023,
    }
}

/// `v * 2^e` for any e, rounded once where the result is normal.
fn scaled(v: f64, e: i32) -> f64 {
    let power = |e: i32| f64::from_bits(((e + 1023) as u64) << 52);
    let (mut v, mut e) = (v, e);
    while e > 1000 {
        (v, e) = (v * power(1000), e - 1000);
    }
    while e < -1000 {
        // The last step rounds; the ones before it are exact where the result is normal.
        (v, e) = (v * power(-1000), e + 1000);
    }
    v * power(e)
}

/// Above this difference of exponents `a c` does not show in `b^2 - a c`: it is under 2^-120 of it.
const NEGLIGIBLE: i32 = 62;

/// The real roots of `a t^2 + 2 b t + c`, for finite coefficients of any size.
#[must_use]
pub fn roots(a: f64, b: f64, c: f64) -> Roots {
    let ordered = |s: f64, t: f64| if s <= t { Roots::Two(s, t) } else { Roots::Two(t, s) };
    // -c / (2 b); halved in the larger of both, which loses nothing.
    let small = || if b.abs() >= 1.0 { -((0.5 * c) / b) } else { -(c / (2.0 * b)) };
    if a == 0.0 {
        return if b == 0.0 { Roots::None } else { Roots::Simple(small()) };
    }
    if c == 0.0 {
        // One root is 0 exactly, as the equation is t (a t + 2 b).
        return if b == 0.0 { Roots::Double(0.0) } else { ordered(0.0, scaled_quotient(b, a, 1)) };
    }
    let (ea, ec) = (exponent(a), exponent(c));
    let k = (ec - ea).div_euclid(2);
    // With t = 2^k s, the coefficients of s have these exponents.
    let (ea, eb) = (ea + 2 * k, if b == 0.0 { i32::MIN / 2 } else { exponent(b) + k });
    if eb - ec.max(ea) > NEGLIGIBLE {
        return ordered(scaled_quotient(b, a, 1), scaled_quotient(c, b, -1));
    }
    let m = ec.max(ea).max(eb);
    let (sa, sb, sc) = (scaled(a, 2 * k - m), scaled(b, k - m), scaled(c, -m));
    let d = discriminant(sa, sb, sc);
    if d < 0.0 {
        return Roots::None;
    }
    if d == 0.0 {
        return Roots::Double(scaled(-sb / sa, k));
    }
    let q = -(sb + d.sqrt().copysign(sb));
    ordered(scaled(q / sa, k), scaled(sc / q, k))
}

/// `-2^e p / q`, without overflow on the way.
fn scaled_quotient(p: f64, q: f64, e: i32) -> f64 {
    if p == 0.0 {
        return 0.0;
    }
    let (ep, eq) = (exponent(p), exponent(q));
    -scaled(scaled(p, -ep) / scaled(q, -eq), ep - eq + e)
}

/// The places in [0, 1] at which `b0 (1-s)^2 + 2 b1 s (1-s) + b2 s^2` changes its sign, where 0 counts
/// as positive: none, one or two, ascending.
///
/// The ratio r = s / (1 - s) is a positive root of `b0 + 2 b1 r + b2 r^2`. Where the ends differ in
/// sign it is one, and nothing cancels in it: it needs neither exact sums nor scaling, unless the
/// numbers are very small.
#[inline(always)]
#[must_use]
pub fn sign_changes(b0: f64, b1: f64, b2: f64) -> (usize, [f64; 2]) {
    if (b0 >= 0.0) != (b2 >= 0.0) {
        let d = b1 * b1 - b0 * b2;
        if d > 1e-280 && d < 1e280 {
            let q = b1.abs() + d.sqrt();
            let same = (b1 >= 0.0) == (b0 >= 0.0);
            let root = if same { q / (q + b2.abs()) } else { b0.abs() / (b0.abs() + q) };
            return (1, [root, 0.0]);
        }
        return few(b0, b1, b2);
    }
    if (b1 >= 0.0) == (b0 >= 0.0) {
        return (0, [0.0; 2]);
    }
    // Far from a double root no exact sum is needed.
    let (p, q) = (b1 * b1, b0 * b2);
    if q > p * (1.0 + 1e-12) && q > 1e-280 && q < 1e280 {
        return (0, [0.0; 2]);
    }
    few(b0, b1, b2)
}

/// [`sign_changes`] by the exact way.
#[cold]
#[inline(never)]
fn few(b0: f64, b1: f64, b2: f64) -> (usize, [f64; 2]) {
    let unit = |r: f64| if r.is_finite() { r / (1.0 + r) } else { 1.0 };
    let opposite = (b0 >= 0.0) != (b2 >= 0.0);
    match roots(b2, b1, b0) {
        Roots::Two(r0, r1) if opposite => {
            // One is positive, or the one that is not negative.
            (1, [unit(if r1 > 0.0 { r1 } else { r0.max(0.0) }), 0.0])
        }
        Roots::Two(r0, r1) => (2, [unit(r0.max(0.0)), unit(r1.max(0.0))]),
        Roots::Simple(r) if opposite => (1, [unit(r.max(0.0)), 0.0]),
        Roots::Double(r) if opposite => (1, [unit(r.max(0.0)), 0.0]),
        // Nothing but an end is different from 0.
        Roots::None if opposite => (1, [1.0, 0.0]),
        // b2 = 0: the second root is at the end.
        Roots::Simple(r) => (2, [unit(r.max(0.0)), 1.0]),
        Roots::Double(_) | Roots::None => (0, [0.0; 2]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dashu_ratio::RBig;
    use proptest::prelude::*;

    fn exact(v: f64) -> RBig {
        RBig::try_from(v).unwrap()
    }

    fn sign(v: &RBig) -> i32 {
        match v.cmp(&RBig::ZERO) {
            std::cmp::Ordering::Less => -1,
            std::cmp::Ordering::Equal => 0,
            std::cmp::Ordering::Greater => 1,
        }
    }

    fn value(a: f64, b: f64, c: f64, t: f64) -> RBig {
        let t = exact(t);
        (exact(a) * &t + RBig::from(2) * exact(b)) * &t + exact(c)
    }

    /// `t` moved by some units in the last place.
    fn moved(t: f64, ulps: i64) -> f64 {
        let ordinal = |t: f64| {
            let bits = t.to_bits() as i64;
            if bits < 0 { i64::MIN - bits } else { bits }
        };
        let to = ordinal(t).saturating_add(ulps);
        f64::from_bits((if to < 0 { i64::MIN - to } else { to }) as u64)
    }

    /// True when the quadratic has a sign change within `ulps` of a root.
    fn is_root(a: f64, b: f64, c: f64, t: f64, ulps: i64) -> bool {
        let (low, high) = (moved(t, -ulps), moved(t, ulps));
        if !low.is_finite() || !high.is_finite() {
            // Beyond the largest number: so is the root.
            return true;
        }
        let signs = [low, t, high].map(|t| sign(&value(a, b, c, t)));
        signs.contains(&0) || signs[0] != signs[2] || signs[0] != signs[1]
    }

    fn check(a: f64, b: f64, c: f64) {
        let discriminant = exact(b) * exact(b) - exact(a) * exact(c);
        let expected = match (a == 0.0, b == 0.0) {
            (true, true) => 0,
            (true, false) => 1,
            (false, _) => sign(&discriminant) + 1,
        };
        let found = roots(a, b, c);
        // Subnormal roots are rounded once more.
        // Where both are, the signs around one of them tell nothing of it.
        let both_tiny = matches!(found, Roots::Two(s, t) if s.abs().max(t.abs()) < 1e-300);
        let near = |t: f64| both_tiny || is_root(a, b, c, t, 4 + i64::from(t.abs() < 1e-290));
        match found {
            Roots::None => assert_eq!(expected, 0, "{a:e} {b:e} {c:e}"),
            Roots::Simple(t) => assert!(expected == 1 && near(t), "{a:e} {b:e} {c:e} {t:e}"),
            Roots::Double(t) => {
                assert_eq!(expected, 1, "{a:e} {b:e} {c:e}");
                // t = -b / a to 4 ulp.
                let (low, high) = (moved(t, -4), moved(t, 4));
                if low.is_finite() && high.is_finite() {
                    let at = |t: f64| sign(&(exact(a) * exact(t) + exact(b)));
                    assert!(at(low) * at(high) <= 0, "{a:e} {b:e} {c:e} {t:e}");
                }
            }
            Roots::Two(s, t) => {
                assert_eq!(expected, 2, "{a:e} {b:e} {c:e}");
                assert!(s <= t && near(s) && near(t), "{a:e} {b:e} {c:e} {s:e} {t:e}");
            }
        }
    }

    fn any_size() -> impl Strategy<Value = f64> {
        prop_oneof![
            8 => any::<u64>().prop_map(f64::from_bits).prop_filter("finite", |v| v.is_finite()),
            4 => (-1.0..1.0, -40..40).prop_map(|(m, e): (f64, i32)| m * 2f64.powi(e)),
            1 => Just(0.0),
            1 => (-4i32..5).prop_map(f64::from),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20_000))]

        #[test]
        fn roots_are_right_to_4_ulp_over_the_whole_exponent_range(
            a in any_size(), b in any_size(), c in any_size(),
        ) {
            check(a, b, c);
        }

        /// b^2 = a c to the last bit, or nearly: (m r)^2 = (m^2) (r^2), and one ulp aside.
        #[test]
        fn double_roots_are_found_where_they_are_exact(
            m in 1i64..(1 << 26), r in 1i64..(1 << 26), e in -400i32..400, off in -1i64..2,
            negative in any::<bool>(),
        ) {
            let scale = 2f64.powi(e);
            let (a, b, c) = ((m * m) as f64, (m * r) as f64, (r * r) as f64);
            let b = if negative { -b } else { b };
            check(a * scale, moved(b, off) * scale, c * scale);
            check(a * scale, b, c / scale);
        }

        #[test]
        fn sign_changes_lie_between_the_ends_for_any_size(
            b0 in any_size(), b1 in any_size(), b2 in any_size(),
        ) {
            let (count, places) = sign_changes(b0, b1, b2);
            prop_assert!(places[..count].iter().all(|s| (0.0..=1.0).contains(s)));
            prop_assert!(count < 2 || places[0] <= places[1]);
            prop_assert_eq!(count % 2 == 1, (b0 >= 0.0) != (b2 >= 0.0));
        }

        /// Ends and middle of about one size, as the motion within a state has them.
        #[test]
        fn sign_changes_are_where_the_exact_ones_are(
            (m0, m1, m2) in (-1.0..1.0, -1.0..1.0, -1.0..1.0),
            (e0, e1, e2) in (-12i32..12, -12i32..12, -12i32..12),
            scale in -300i32..300, near in 0u32..4,
        ) {
            let sized = |m: f64, e: i32| m * 2f64.powi(e + scale);
            let (b0, b1, b2) = (sized(m0, e0), sized(m1, e1), sized(m2, e2));
            let b1 = match near {
                // Close to a double root.
                0 if b0 * b2 > 0.0 => -(b0 * b2).sqrt().copysign(b0),
                _ => b1,
            };
            let (count, places) = sign_changes(b0, b1, b2);
            let at = |s: f64| {
                let (s, r) = (exact(s), RBig::ONE - exact(s));
                sign(&(exact(b0) * &r * &r
                    + RBig::from(2) * exact(b1) * &s * &r
                    + exact(b2) * &s * &s))
            };
            let positive = |s: i32| s >= 0;
            prop_assert_eq!(count % 2 == 1, positive(at(0.0)) != positive(at(1.0)));
            let middle = exact(b1) * exact(b1) > exact(b0) * exact(b2);
            let inner = (b1 >= 0.0) != (b0 >= 0.0) && b1 != 0.0;
            if count == 0 && positive(at(0.0)) == positive(at(1.0)) && inner && middle {
                // Two changes that were not found lie at one end: a value of 0 there.
                prop_assert!(b0 == 0.0 || b2 == 0.0, "{b0:e} {b1:e} {b2:e}");
            }
            for &s in &places[..count] {
                prop_assert!((0.0..=1.0).contains(&s));
                // s = r / (1 + r): two roundings more than the root.
                let (low, high) = ((s * (1.0 - 8.0 * f64::EPSILON)).max(0.0),
                    (s * (1.0 + 8.0 * f64::EPSILON) + f64::MIN_POSITIVE).min(1.0));
                let signs = [low, s, high].map(at);
                let double = 4.0 * (b1 * b1 - b0 * b2).abs() <= 1e-10 * (b1 * b1);
                prop_assert!(
                    signs.contains(&0) || signs[0] != signs[2] || signs[0] != signs[1] || double,
                    "{b0:e} {b1:e} {b2:e}: {s:e} {signs:?}"
                );
            }
        }
    }
}
