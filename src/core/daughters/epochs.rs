//! Interpolation over time: from the instants of a prediction to the epochs at which samples are drawn.

use super::nodes::BandInterpolation;
use crate::units::arithmetic::fused;

/// Number of epochs that are interpolated together.
pub(super) const EPOCHS: usize = 4;

/// Number of values that are interpolated together.
pub(super) const COLUMNS: usize = 8;

/// Weights of the instants at each epoch: interpolation, corrected for the blending of epochs. Rows of zeros pad the
/// matrix to a multiple of `EPOCHS`.
pub(super) fn time_matrix(instants: usize, count: usize) -> Vec<f32> {
    // Variance of a density cos^2 of half width 1, halved.
    let flattening = 0.5 * (1.0 / 3.0 - 2.0 / std::f64::consts::PI.powi(2));
    let interpolation = BandInterpolation::new(instants);
    let step = 2.0 / (count + 1) as f64;
    let mut weights = vec![0.0; (count + 2) * instants];
    for (k, row) in weights.chunks_exact_mut(instants).enumerate() {
        interpolation.weights(-1.0 + step * k as f64, row);
    }
    let flattening_corrected = |k: usize| {
        let (before, current, after) = (weights[k - instants], weights[k], weights[k + instants]);
        (current - flattening * (after - 2.0 * current + before)) as f32
    };
    let mut matrix: Vec<f32> = (instants..(count + 1) * instants).map(flattening_corrected).collect();
    matrix.resize(count.next_multiple_of(EPOCHS) * instants, 0.0);
    matrix
}

/// `out = weights x rows`. `rows` are `width` values each, one for each column of `weights`; the rows of `out` start
/// `stride` values apart.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn combine(weights: &[f32], rows: &[f32], width: usize, out: &mut [f32], stride: usize) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let count = rows.len() / width;
    // The last row may lack its padding.
    for (out, weights) in out.chunks_mut(EPOCHS * stride).zip(weights.chunks_exact(EPOCHS * count)) {
        let (first, rest) = weights.split_at(count);
        let (second, rest) = rest.split_at(count);
        let (third, fourth) = rest.split_at(count);
        for column in (0..width).step_by(COLUMNS) {
            let mut sums = [[0.0_f32; COLUMNS]; EPOCHS];
            let own = first.iter().zip(second).zip(third.iter().zip(fourth));
            for (row, ((a, b), (c, d))) in rows.chunks_exact(width).zip(own) {
                let Some(row) = row[column..].first_chunk::<COLUMNS>() else { continue };
                for (k, value) in row.iter().enumerate() {
                    sums[0][k] = fused::<FMA>(*a, *value, sums[0][k]);
                    sums[1][k] = fused::<FMA>(*b, *value, sums[1][k]);
                    sums[2][k] = fused::<FMA>(*c, *value, sums[2][k]);
                    sums[3][k] = fused::<FMA>(*d, *value, sums[3][k]);
                }
            }
            for (epoch, sums) in sums.iter().enumerate() {
                out[epoch * stride + column..][..COLUMNS].copy_from_slice(sums);
            }
        }
    }
}
