//! Residuals that are not those of noise alone: outliers, and pairs whose model is less good than their noise.

use num_complex::Complex64;

use super::sums::{MODEL_TERMS, ModelledBlock};
use crate::numerics::median;

/// Median of the squared residual of a complex number, in units of the variance of a part: 2 ln 2.
const MEDIAN: f64 = 2.0 * std::f64::consts::LN_2;

/// Visibilities below which those of a pair say little of their spread.
const SPREAD_COUNT: f64 = 8.0;

/// Marks outliers of a block, and measures the spread of the others; returns the sum of their squared residuals in units of
/// the noise, and their number.
pub(super) fn judge(
    block: &mut ModelledBlock,
    [from_s, until_s]: [f64; 2],
    cut: f64,
    gain: Complex64,
    u: &[f64; MODEL_TERMS],
    spread: &mut f64,
) -> (f64, f64) {
    let (inside, squares) = squares_of(block, [from_s, until_s], gain, u);
    let Some(limit) = limit_of(&squares, cut) else { return (0.0, 0.0) };
    let (mut sum, mut count) = (0.0, 0.0);
    for (k, square) in inside.into_iter().zip(squares) {
        // What is not finite is out, too.
        let keeps = square <= limit;
        block.is_out[k] = !keeps;
        if keeps {
            sum += square;
            count += 1.0;
        }
    }
    *spread = if count >= SPREAD_COUNT { (sum / (2.0 * count)).max(1.0) } else { 1.0 };
    (sum, count)
}

/// What a block adds to the cost of values: that which solutions with weights by pair make least. Squares of residuals count up
/// to the limit for outliers; a pair whose mean square s is above one counts as one whose noise has that square: 1 + ln s each.
pub(super) fn misfit(
    block: &ModelledBlock,
    span_s: [f64; 2],
    cut: f64,
    gain: Complex64,
    u: &[f64; MODEL_TERMS],
) -> f64 {
    let (_, squares) = squares_of(block, span_s, gain, u);
    let Some(limit) = limit_of(&squares, cut) else { return 0.0 };
    // What is not finite is out.
    spread_cost(squares.iter().map(|square| square.min(limit)).sum::<f64>(), squares.len() as f64)
}

/// What squared residuals in units of the noise with this sum cost, if noise that seems stronger is taken for stronger noise.
pub(super) fn spread_cost(sum: f64, count: f64) -> f64 {
    let mean = sum / (2.0 * count).max(1.0);
    let each = if count >= SPREAD_COUNT && mean > 1.0 { 1.0 + mean.ln() } else { mean };
    2.0 * count * each
}

/// Visibilities between two times, and their squared residuals in units of the noise.
fn squares_of(
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

/// Square above which a residual is an outlier; `None` without any.
fn limit_of(squares: &[f64], cut: f64) -> Option<f64> {
    Some(cut * cut * (median(squares.to_vec())? / MEDIAN).max(1.0))
}
