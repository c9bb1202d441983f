//! Maps of noise of many realisations, which share everything but their right-hand sides.

use super::posterior::NOISES_TOGETHER;
use super::solve::{HarmonicRequest, W_MAX_TOLERANCE, lifted, power_of_data};
use super::{HarmonicSums, coefficients};
use crate::imaging::NormalSums;
use crate::imaging::pixel::check_request;
use crate::imaging::regulariser::Regulariser;
use crate::imaging::solver::NamedWatch;
use crate::imaging::solver::SolveError;
use crate::imaging::solver::System;
use crate::imaging::solver::largest_eigenvalue_from;
use crate::sky::harmonics::synthesis;

/// The noise-only maps, K, of the further realisations that the sums hold ([`HarmonicSums::further_noises`]): each as
/// [`crate::imaging::solve_regularised`] makes it of sums with that realisation as their companion.
///
/// # Errors
/// No data; a table of power that ends before the map's degrees; [`SolveError::Interrupted`].
pub fn solve_noises(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    regulariser: &Regulariser,
    watch: NamedWatch<'_>,
) -> Result<Vec<Vec<f64>>, SolveError> {
    let known = *regulariser != Regulariser::Data;
    let regulariser = match regulariser {
        Regulariser::Data => &power_of_data(sums, request.rule, watch)?,
        given => given,
    };
    // One over a power is what it is.
    let epsilon = if known { request.epsilon } else { 1.0 };
    check_request(sums, epsilon)?;
    let blocks = sums.order_blocks();
    let w_max = {
        let task = watch.start("largest eigenvalue", W_MAX_TOLERANCE);
        let start = lifted(&blocks, sums.unknowns());
        largest_eigenvalue_from(start, sums, W_MAX_TOLERANCE, &mut |wants, step, change| {
            task.report_wanting(wants, step, change)
        })
        .value
    };
    let l_max = sums.setup().l_max;
    let regularisation = regulariser.diagonal(epsilon, w_max, l_max)?;
    let factors = blocks.factors_with(&|l| regularisation.at(l));
    drop(blocks);
    let system = System { sums, regularisation, precondition: &|v| factors.solve(v) };
    let mut maps = Vec::new();
    for rights in sums.further_noises().chunks(NOISES_TOGETHER) {
        let rights: Vec<&[f64]> = rights.iter().map(Vec::as_slice).collect();
        let mut solved = vec![vec![0.0; sums.unknowns()]; rights.len()];
        let task = watch.start("noise maps", request.rule.residual_max);
        system.solve(&rights, &mut solved, &vec![request.rule; rights.len()], &task);
        if !watch.goes_on() {
            return Err(SolveError::Interrupted);
        }
        for unknowns in &solved {
            maps.push(synthesis(&coefficients(unknowns, l_max), request.nside)?);
        }
    }
    Ok(maps)
}
