//! Whether a triangle has exactly zero area.
//!
//! A triangle (a, b, c) has no area when the cross product of u = b - a and v = c - a is the
//! zero vector in exact arithmetic of its `f32` positions: corners repeat or are collinear.
//!
//! Fast filter: in `f64`, `u_i` is the correctly rounded difference of two `f32` numbers, so
//! each product carries three roundings and the difference of the products one more. With
//! `d = fl(u_i v_j - u_j v_i)` and `s = fl(|u_i v_j| + |u_j v_i|)`, the error of `d` is at most
//! `gamma(4) (|u_i v_j| + |u_j v_i|)`, and the exact sum is at most `s / (1 - gamma(4))`:
//! `gamma(9) s` bounds it. Nothing over- or underflows: nonzero differences of `f32` numbers lie
//! in `[2^-149, 2^129]`, so products lie in `[2^-298, 2^258]`, and their rounding errors are
//! multiples of `2^-298`, well inside the range of `f64`.
//!
//! Exact fallback: u and v as unevaluated sums of two `f64` numbers (two-sum), their products by
//! two-product, the sum of the sixteen terms as a nonoverlapping expansion. An expansion is zero
//! exactly when all its components are. Source: Shewchuk, "Adaptive Precision Floating-Point
//! Arithmetic and Fast Robust Geometric Predicates" (1997), theorems 7, 10 and 18.

use sightline_geometry::gamma;

/// Relative error bound of the filter, see the module.
const FILTER: f64 = gamma(9);

/// True when the triangle has exactly zero area. The corners must be finite.
pub fn is_degenerate(corners: [[f32; 3]; 3]) -> bool {
    let [a, b, c] = corners.map(|p| p.map(f64::from));
    let pairs = [(1, 2), (2, 0), (0, 1)];
    let surely_not = pairs.iter().any(|&(i, j)| {
        let p = (b[i] - a[i]) * (c[j] - a[j]);
        let q = (b[j] - a[j]) * (c[i] - a[i]);
        (p - q).abs() > FILTER * (p.abs() + q.abs())
    });
    !surely_not && pairs.iter().all(|&(i, j)| cross_is_zero(a, b, c, i, j))
}

/// True when `u_i v_j - u_j v_i` is exactly zero.
fn cross_is_zero(a: [f64; 3], b: [f64; 3], c: [f64; 3], i: usize, j: usize) -> bool {
    let u = |k: usize| two_sum(b[k], -a[k]);
    let v = |k: usize| two_sum(c[k], -a[k]);
    let mut sum = Expansion::default();
    sum.add_product(u(i), v(j), 1.0);
    sum.add_product(u(j), v(i), -1.0);
    sum.is_zero()
}

/// `a + b` as the rounded sum and its error, exactly (Knuth).
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let from_b = sum - a;
    let from_a = sum - from_b;
    (sum, (a - from_a) + (b - from_b))
}

/// A nonoverlapping expansion: components in ascending order, zeros allowed.
#[derive(Default)]
struct Expansion {
    components: [f64; 16],
    len: usize,
}

impl Expansion {
    /// Adds one number (GROW-EXPANSION).
    fn add(&mut self, term: f64) {
        let mut q = term;
        for h in &mut self.components[..self.len] {
            (q, *h) = two_sum(q, *h);
        }
        self.components[self.len] = q;
        self.len += 1;
    }

    /// Adds `sign * x * y`, where x and y are sums of two numbers: eight terms.
    fn add_product(&mut self, x: (f64, f64), y: (f64, f64), sign: f64) {
        for p in [x.1, x.0] {
            for q in [y.1, y.0] {
                let q = sign * q;
                let product = p * q;
                // The error of a product is exact with a fused multiply-add.
                self.add(p.mul_add(q, -product));
                self.add(product);
            }
        }
    }

    fn is_zero(&self) -> bool {
        self.components[..self.len].iter().all(|&c| c == 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The same question in integers, for coordinates that are small integers.
    fn slow_twin(p: [[i32; 3]; 3]) -> bool {
        let [a, b, c] = p.map(|p| p.map(i128::from));
        [(1, 2), (2, 0), (0, 1)]
            .iter()
            .all(|&(i, j)| (b[i] - a[i]) * (c[j] - a[j]) == (b[j] - a[j]) * (c[i] - a[i]))
    }

    #[test]
    fn repeated_and_collinear_corners_have_no_area() {
        assert!(is_degenerate([[1.0, 2.0, 3.0]; 3]));
        assert!(is_degenerate([[0.1, 0.7, 3.0], [5.0, 1e-30, 2.0], [0.1, 0.7, 3.0]]));
        assert!(is_degenerate([[0.0; 3], [1e-45, 1e-45, 0.0], [2.8e-45, 2.8e-45, 0.0]]));
        assert!(is_degenerate([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [1e30, 1e30, 1e30]]));
    }

    #[test]
    fn the_thinnest_triangles_have_area() {
        let next = 1.0_f32.next_up();
        assert!(!is_degenerate([[0.0; 3], [1.0, 1.0, 0.0], [next, 1.0, 0.0]]));
        // Exponents so far apart that differences are not exact in f64.
        assert!(!is_degenerate([[1e-45, 0.0, 0.0], [1e30, 1e30, 0.0], [2e30, 2e30, 0.0]]));
        assert!(!is_degenerate([[0.0; 3], [1e-45, 0.0, 0.0], [0.0, 1e-45, 0.0]]));
        assert!(!is_degenerate([[0.0; 3], [3e38, -3e38, 0.0], [3e38, 3e38, 0.0]]));
    }

    proptest! {
        #[test]
        fn agrees_with_integers(p in prop::array::uniform3(prop::array::uniform3(-3i32..4)),
                                scale in -100i32..100) {
            let s = 2.0_f32.powi(scale);
            prop_assert_eq!(is_degenerate(p.map(|q| q.map(|v| v as f32 * s))), slow_twin(p));
        }

        #[test]
        fn agrees_with_integers_of_full_width(
            a in prop::array::uniform3(-(1i32 << 23)..(1 << 23)),
            d in prop::array::uniform3(-(1i32 << 11)..(1 << 11)),
            m in -2000i32..2000, off in 0i32..2) {
            let b = [a[0] + d[0], a[1] + d[1], a[2] + d[2]];
            let c = [a[0] + m * d[0] + off, a[1] + m * d[1], a[2] + m * d[2]];
            prop_assume!(c.iter().all(|v| v.abs() < 1 << 24));
            let p = [a, b, c];
            prop_assert_eq!(is_degenerate(p.map(|q| q.map(|v| v as f32))), slow_twin(p));
        }
    }
}
