//! Rounding of products to whole numbers within fused multiply-adds.
//!
//! A running sum that starts at `BIAS = 1.5 2^52` and takes products by fused multiply-add stays between 2^52 and
//! 2^53, where neighbouring numbers differ by one: each addition rounds its product to a whole number, and nothing
//! else is ever rounded. The rounding of a product does not depend on the sum so far, because there are no ties: factors
//! are odd multiples of 2^-28 (or zero), so a product is an odd multiple of 2^-56 and never half a whole number.
//! The difference between the bits of the sum and those of the bias is the sum of the rounded products, an integer, which
//! is added to a 64-bit sum.

use multiversion::multiversion;

/// Start value of running sums; it is even, so that a term and its negative are rounded alike.
pub(in crate::imaging) const BIAS: f64 = 1.5 * 4_503_599_627_370_496.0;
/// Steps per unit of factors.
pub(in crate::imaging) const STEPS: f64 = 268_435_456.0; // 2^28
/// Rounds a factor to a step when it is added.
const FACTOR_BIAS: f64 = BIAS / STEPS;
/// Maximum factor: the square root of the 2^42 quanta of the maximum weight, and a little room for rounding.
const FACTOR_MAX: f64 = 2.1e6;

/// Rounds factors to odd multiples of 2^-28, or zero.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub(in crate::imaging) fn round_factors(factors: &mut [f64]) {
    for factor in factors {
        let odd = f64::from_bits((*factor + FACTOR_BIAS).to_bits() | 1) - FACTOR_BIAS;
        // Only rows of invalid geometry exceed the range.
        let is_valid = *factor != 0.0 && factor.abs() < FACTOR_MAX;
        *factor = if is_valid { odd } else { 0.0 };
    }
}

/// Adds each element of `row` times `factor`, rounded to a whole number, to `sums`; products may reach 2^50.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub(in crate::imaging) fn add_scaled(sums: &mut [i64], row: &[f64], factor: f64) {
    for (sum, row) in sums.iter_mut().zip(row) {
        *sum = sum.wrapping_add(above_bias(row * factor + BIAS));
    }
}

/// The integer that a running sum represents.
#[inline(always)]
pub(in crate::imaging) fn above_bias(sum: f64) -> i64 {
    (sum.to_bits() as i64).wrapping_sub(BIAS.to_bits() as i64)
}
