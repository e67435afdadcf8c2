//! Random quadratics against rational arithmetic: the roots to 4 units in the last place, over the whole
//! range of exponents, double roots where they are exact.

use dashu_ratio::RBig;
use sightline_solver::quadratic::{Roots, roots};

use super::random::Random;

fn exact(v: f64) -> RBig {
    RBig::try_from(v).expect("coefficients are finite")
}

fn sign(v: &RBig) -> i32 {
    v.cmp(&RBig::ZERO) as i32
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

fn any_size(random: &mut Random) -> f64 {
    let unit = random.within(-1.0..1.0);
    match random.below(16) {
        0..=5 => unit * 2f64.powi(random.integer(-40..=40) as i32),
        6..=8 => unit,
        9..=13 => loop {
            let v = f64::from_bits(random.bits());
            if v.is_finite() {
                break v;
            }
        },
        14 => random.integer(-4..=4),
        _ => unit * 2f64.powi(random.integer(-1074..=-1000) as i32),
    }
}

/// Coefficients of `a t^2 + 2 b t + c`.
fn quadratic(random: &mut Random) -> (f64, f64, f64) {
    if random.one_in(2) {
        return (any_size(random), any_size(random), any_size(random));
    }
    // b^2 = a c to the last bit, or one aside: (m r)^2 = m^2 r^2.
    let small = random.below(27) as u32;
    let (m, r) = (random.bits() >> 38, random.bits() >> (38 + small));
    let e = 2f64.powi(random.integer(-400..=400) as i32);
    let b = moved((m * r) as f64, random.integer(-1..=1) as i64);
    let b = if random.one_in(2) { -b } else { b };
    let (a, c) = ((m * m) as f64, (r * r) as f64);
    if random.one_in(2) { (a * e, b * e, c * e) } else { (a * e, b, c / e) }
}

/// What is wrong with the roots of `a t^2 + 2 b t + c`.
fn wrong(a: f64, b: f64, c: f64) -> Option<String> {
    let (ea, eb, ec) = (exact(a), exact(b), exact(c));
    let expected = match (a == 0.0, b == 0.0) {
        (true, true) => 0,
        (true, false) => 1,
        (false, _) => sign(&(&eb * &eb - &ea * &ec)) + 1,
    };
    let at = |t: f64| {
        let t = exact(t);
        sign(&((&ea * &t + RBig::from(2) * &eb) * &t + &ec))
    };
    let found = roots(a, b, c);
    // Subnormal roots are rounded once more; where both are, signs around one tell nothing of it.
    let both_tiny = matches!(found, Roots::Two(s, t) if s.abs().max(t.abs()) < 1e-300);
    let near = |t: f64| {
        let ulps = 4 + i64::from(t.abs() < 1e-290);
        let (low, high) = (moved(t, -ulps), moved(t, ulps));
        if both_tiny || !low.is_finite() || !high.is_finite() {
            return true;
        }
        let signs = [at(low), at(t), at(high)];
        signs.contains(&0) || signs[0] != signs[2] || signs[0] != signs[1]
    };
    let fine = match found {
        Roots::None => expected == 0,
        Roots::Simple(t) => expected == 1 && near(t),
        Roots::Double(t) => {
            let (low, high) = (moved(t, -4), moved(t, 4));
            let value = |t: f64| sign(&(&ea * exact(t) + &eb));
            let open = !low.is_finite() || !high.is_finite();
            expected == 1 && (open || value(low) * value(high) <= 0)
        }
        Roots::Two(s, t) => expected == 2 && s <= t && near(s) && near(t),
    };
    (!fine).then(|| format!("{a:e} t^2 + 2 {b:e} t + {c:e}: {found:?}, {expected} expected"))
}

/// Looks at `count` quadratics of a number; what is wrong, in words.
pub fn run(seed: u64, count: u64) -> Vec<String> {
    let mut random = Random::of_case("quadratics", seed);
    (0..count)
        .filter_map(|_| {
            let (a, b, c) = quadratic(&mut random);
            wrong(a, b, c)
        })
        .collect()
}
