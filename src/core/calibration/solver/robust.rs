//! Residuals beyond noise: outliers, and pairs whose residuals exceed their noise.

use num_complex::Complex64;

use super::sums::{MODEL_TERMS, ModelledBlock};
use crate::numerics::median;

/// Median of the squared residual of a complex number, in units of the variance of its real part: 2 ln 2.
const MEDIAN_SQUARE: f64 = 2.0 * std::f64::consts::LN_2;

/// Minimum number of visibilities from which the variance factor of a pair is estimated.
const COUNT_MIN: f64 = 8.0;

/// Marks outliers of a block, and sets the variance factor of the others; returns the sum of their squared residuals
/// in units of the noise, and their number.
pub(super) fn mark_outliers(
    block: &mut ModelledBlock,
    [from_s, until_s]: [f64; 2],
    cut: f64,
    gain: Complex64,
    u: &[f64; MODEL_TERMS],
    variance_factor: &mut f64,
) -> (f64, f64) {
    let (inside, squares) = squared_residuals(block, [from_s, until_s], gain, u);
    let Some(limit) = outlier_limit(&squares, cut) else { return (0.0, 0.0) };
    let (mut sum, mut count) = (0.0, 0.0);
    for (k, square) in inside.into_iter().zip(squares) {
        // Values that are not finite are outliers, too.
        let is_kept = square <= limit;
        block.is_out[k] = !is_kept;
        if is_kept {
            sum += square;
            count += 1.0;
        }
    }
    *variance_factor = if count >= COUNT_MIN { (sum / (2.0 * count)).max(1.0) } else { 1.0 };
    (sum, count)
}

/// Contribution of a block to the cost that solutions with a variance factor per pair minimise. Squared residuals
/// count up to the limit for outliers. A pair whose mean square s is above one counts as one whose noise has that
/// square: 1 + ln s per residual.
pub(super) fn robust_cost(
    block: &ModelledBlock,
    span_s: [f64; 2],
    cut: f64,
    gain: Complex64,
    u: &[f64; MODEL_TERMS],
) -> f64 {
    let (_, squares) = squared_residuals(block, span_s, gain, u);
    let Some(limit) = outlier_limit(&squares, cut) else { return 0.0 };
    // `min` replaces values that are not finite by the limit.
    scaled_cost(squares.iter().map(|square| square.min(limit)).sum::<f64>(), squares.len() as f64)
}

/// Cost of squared residuals with this sum, in units of the noise, if an excess is attributed to stronger noise.
pub(super) fn scaled_cost(sum: f64, count: f64) -> f64 {
    let mean = sum / (2.0 * count).max(1.0);
    let per_part = if count >= COUNT_MIN && mean > 1.0 { 1.0 + mean.ln() } else { mean };
    2.0 * count * per_part
}

/// Indices of the visibilities between two times, and their squared residuals in units of the noise.
fn squared_residuals(
    block: &ModelledBlock,
    [from_s, until_s]: [f64; 2],
    gain: Complex64,
    u: &[f64; MODEL_TERMS],
) -> (Vec<usize>, Vec<f64>) {
    let inside: Vec<usize> =
        (0..block.time_s.len()).filter(|&k| (from_s..until_s).contains(&block.time_s[k])).collect();
    let square = |&k: &usize| {
        let model: Complex64 = block.model[k].iter().zip(u).map(|(term, factor)| term * factor).sum();
        block.weight[k] * (block.value_k_sr[k] - gain * model).norm_sqr()
    };
    let squares = inside.iter().map(square).collect();
    (inside, squares)
}

/// Squared residual above which a visibility is an outlier; `None` without visibilities.
fn outlier_limit(squares: &[f64], cut: f64) -> Option<f64> {
    Some(cut * cut * (median(squares.to_vec())? / MEDIAN_SQUARE).max(1.0))
}
