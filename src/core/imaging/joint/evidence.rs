//! The covariance between channels of maximum evidence.

use rayon::prelude::*;

use super::correlation::{Covariance, Moments};
use super::prior::Prior;
use super::sums::{ScaledBlocks, joint_blocks};
use crate::imaging::SolveError;
use crate::imaging::power::{log_evidence, maximise};
use crate::imaging::solver::NamedWatch;

/// Correlation lengths and independent shares of the grid on which the search begins.
const LENGTHS: [f64; 3] = [0.7, 2.0, 6.0];
const OWN_SHARES: [f64; 3] = [1e-3, 1e-2, 1e-1];
/// Gain in evidence per step below which the search ends: parameters are then within a small part of their errors.
const GAIN_MIN: f64 = 0.1;

/// The prior of maximum evidence: from the best of a grid of parameters that are the same at all degrees, by Newton's iteration.
pub(super) fn most_likely(
    initial: &Prior,
    scaled: &[ScaledBlocks],
    rights: &[Vec<f64>],
    watch: NamedWatch<'_>,
) -> Result<Prior, SolveError> {
    let task = watch.start("correlation between channels", GAIN_MIN);
    let objective = |theta: &[f64]| -> Option<f64> {
        let prior = initial.with_theta(theta).ok()?;
        Some(evidence(&prior, scaled, rights)? + prior.covariance.hyperprior().value)
    };
    let grid = LENGTHS.iter().flat_map(|length| OWN_SHARES.iter().map(move |own| (*length, *own)));
    let of_grid = |(length, own_share)| {
        let hz = initial.frequencies_hz.clone();
        let theta = Covariance::constant(hz, initial.l_max[0], length, own_share).theta;
        Some((objective(&theta)?, theta))
    };
    let best = grid.filter_map(of_grid).max_by(|a, b| a.0.total_cmp(&b.0));
    let (_, start) = best.ok_or(SolveError::NoPower)?;
    let derivatives = |theta: &[f64]| {
        let prior = initial.with_theta(theta).ok()?;
        Some(prior.derivatives(&moments(&prior, scaled, rights)?))
    };
    let goes_on = |step: usize, gain: f64| task.report_step(true, step, gain);
    let theta = maximise((start, GAIN_MIN), &objective, &derivatives, &goes_on).ok_or(SolveError::NoPower)?;
    initial.with_theta(&theta)
}

/// The log evidence of the data of all blocks.
pub(super) fn evidence(prior: &Prior, scaled: &[ScaledBlocks], rights: &[Vec<f64>]) -> Option<f64> {
    let unit = vec![1.0; prior.l_max.first()? + 1];
    log_evidence(&joint_blocks(prior, scaled), &unit, &prior.transposed(rights))
}

/// What the data say of the unknowns by degree; `None` if a block is not positive definite.
pub(super) fn moments(prior: &Prior, scaled: &[ScaledBlocks], rights: &[Vec<f64>]) -> Option<Vec<Moments>> {
    let right = prior.transposed(rights);
    let l_max = *prior.l_max.first()?;
    let of_block = |scaled: &ScaledBlocks| -> Option<Vec<(usize, Moments)>> {
        let block = &joint_blocks(prior, std::slice::from_ref(scaled))[0];
        let posterior = block.posterior(&vec![1.0; l_max + 1], &right)?;
        // Rows are by channel, then by degree.
        let mut channel_rows: Vec<Vec<usize>> = vec![Vec::new(); l_max + 1];
        block.degrees.iter().enumerate().for_each(|(row, l)| channel_rows[*l].push(row));
        let of_degree = |(l, rows): (usize, Vec<usize>)| {
            let mut found = Moments::none(rows.len());
            found.copies = block.places.len() as f64;
            for (i, a) in rows.iter().enumerate() {
                for (j, b) in rows.iter().enumerate() {
                    found.spread[(i, j)] = found.copies * posterior.covariance[(*a, *b)];
                    let parts = 0..block.places.len();
                    found.square[(i, j)] =
                        parts.map(|part| posterior.mean[(*a, part)] * posterior.mean[(*b, part)]).sum();
                }
            }
            (l, found)
        };
        let with_rows = channel_rows.into_iter().enumerate().filter(|(_, rows)| !rows.is_empty());
        Some(with_rows.map(of_degree).collect())
    };
    let mut all: Vec<Moments> = (0..=l_max).map(|l| Moments::none(prior.channels_with_degree(l))).collect();
    let blocks: Vec<Option<Vec<(usize, Moments)>>> = scaled.par_iter().map(of_block).collect();
    for block in blocks {
        for (l, found) in block? {
            all[l].add(&found);
        }
    }
    Some(all)
}
