//! Rounding of products to whole numbers within fused multiply-adds.
//!
//! A running sum that starts at `BIAS = 1.5 2^52` and takes products by fused multiply-add stays between 2^52 and
//! 2^53, where neighbouring numbers differ by one: each addition rounds its product to a whole number, and nothing
//! else is ever rounded. Nor does the rounding of a product depend on the sum so far, for there are no ties: factors
//! are odd multiples of 2^-28, so that a product is an odd multiple of 2^-56 and never half a whole number (or zero).
//! What the sum's bits are above those of the bias is the sum of the rounded products, an integer, and is added to
//! a 64-bit one.

use multiversion::multiversion;

/// Where running sums start; it is even, so that a term and its negative are rounded alike.
pub(in crate::imaging) const BIAS: f64 = 1.5 * 4_503_599_627_370_496.0;
/// Steps of factors in one.
pub(in crate::imaging) const STEPS: f64 = 268_435_456.0; // 2^28
/// Adding it rounds a factor to a step.
const FACTOR_BIAS: f64 = BIAS / STEPS;
/// Greatest factor: roots of the greatest weight's 2^42 quanta, and a little room for rounding.
const FACTOR_MAX: f64 = 2.1e6;

/// Rounds factors to odd multiples of 2^-28, or zero.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub(in crate::imaging) fn round_factors(factors: &mut [f64]) {
    for factor in factors {
        let odd = f64::from_bits((*factor + FACTOR_BIAS).to_bits() | 1) - FACTOR_BIAS;
        // Only rows of invalid geometry exceed the range.
        let is_term = *factor != 0.0 && factor.abs() < FACTOR_MAX;
        *factor = if is_term { odd } else { 0.0 };
    }
}

/// Adds each of `row` times `factor`, rounded to a whole number, to `sums`; products may reach 2^50.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub(in crate::imaging) fn add_scaled(sums: &mut [i64], row: &[f64], factor: f64) {
    for (sum, row) in sums.iter_mut().zip(row) {
        *sum = sum.wrapping_add(above_bias(row * factor + BIAS));
    }
}

/// The integer that a running sum holds.
#[inline(always)]
pub(in crate::imaging) fn above_bias(sum: f64) -> i64 {
    (sum.to_bits() as i64).wrapping_sub(BIAS.to_bits() as i64)
}
