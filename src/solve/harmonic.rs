//! The regularised solution over harmonic coefficients.

use super::conjugate_gradients::{StoppingRule, System};
use super::error::SolveError;
use super::lanczos::{LargestEigenvalue, largest_eigenvalue};
use super::probing::{Traces, traces};
use super::tikhonov::Diagnostics;
use super::watch::SolveWatch;
use crate::accumulation::NormalSums;
use crate::accumulation::harmonic::{HarmonicSums, coefficients, unknowns};
use crate::sky::harmonics::{AnalysisOptions, analysis, synthesis};
use crate::sky::healpix::{nside_of, pixel_area_sr};

/// Relative accuracy of W_max: it only scales R.
const W_MAX_TOLERANCE: f64 = 1e-4;

/// What a harmonic solution is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HarmonicRequest {
    /// epsilon of R = epsilon W_max I.
    pub epsilon: f64,
    /// nside of the maps.
    pub nside: usize,
    /// When to stop.
    pub rule: StoppingRule,
    /// Random vectors for the traces of the covariances; 0 for none.
    pub probes: usize,
}

/// A map and its noise-only companion, and their coefficients.
#[derive(Clone, Debug, PartialEq)]
pub struct HarmonicSolution {
    /// Map, K, HEALPix RING.
    pub map_k: Vec<f64>,
    /// Map of noise alone, K.
    pub noise_k: Vec<f64>,
    /// The unknowns, without the prior, and those of the noise; a warm start for more data.
    pub unknowns: [Vec<f64>; 2],
    /// How they were found.
    pub diagnostics: Diagnostics,
}

/// Solves by conjugate gradients, preconditioned by the blocks of BtN^-1B that keep m.
///
/// As [`crate::solve::solve_pixels`] with `T` among the functions of degree up to `l_max`; R is epsilon times the largest
/// eigenvalue times the identity of orthonormal harmonics, which is that of equal pixels up to their area.
/// `start` is an earlier solution's [`HarmonicSolution::unknowns`].
///
/// # Errors
/// No data, or a prior of a size that is no map's.
pub fn solve_harmonics(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    prior_k: Option<&[f64]>,
    start: Option<&[Vec<f64>; 2]>,
    (watch, name): (&SolveWatch, &str),
) -> Result<HarmonicSolution, SolveError> {
    if sums.counts().visibilities == 0 {
        return Err(SolveError::NoData);
    }
    if request.epsilon.is_nan() || request.epsilon <= 0.0 {
        return Err(SolveError::Epsilon(request.epsilon));
    }
    let l_max = sums.setup().l_max;
    let prior = prior_k.map(|map| prior_unknowns(map, l_max)).transpose()?;
    let LargestEigenvalue { value: w_max, iterations, .. } = {
        let work = watch.start(format!("{name}: largest eigenvalue"), W_MAX_TOLERANCE);
        largest_eigenvalue(sums, W_MAX_TOLERANCE, &mut |step, change| work.goes_on(step, change))
    };
    let regularisation = request.epsilon * w_max;
    let factors = sums.order_blocks().factors(regularisation);
    let system = System { sums, regularisation, precondition: &|v| factors.solve(v) };
    let mut right = sums.right_hand_side().to_vec();
    if let Some(prior) = &prior {
        let mut predicted = vec![0.0; prior.len()];
        sums.apply(prior, &mut predicted);
        right.iter_mut().zip(predicted).for_each(|(right, predicted)| *right -= predicted);
    }
    let sides = [("map", right.as_slice()), ("noise map", sums.noise_right_hand_side())];
    let mut solved = [0, 1].map(|side| match start {
        Some(start) if start[side].len() == right.len() => start[side].clone(),
        _ => vec![0.0; right.len()],
    });
    let mut convergence = Vec::new();
    for ((what, right), x) in sides.into_iter().zip(&mut solved) {
        let work = watch.start(format!("{name}: {what}"), request.rule.residual_max);
        convergence.push(system.solve(right, x, request.rule, &work));
    }
    let traces = (request.probes > 0).then(|| traces(sums, regularisation, request.probes, (watch, name)));
    let area_sr = pixel_area_sr(request.nside);
    let map = |x: &[f64]| synthesis(&coefficients(x, l_max), request.nside).map_err(SolveError::from);
    let mut whole = solved[0].clone();
    if let Some(prior) = prior {
        whole.iter_mut().zip(prior).for_each(|(map, prior)| *map += prior);
    }
    Ok(HarmonicSolution {
        map_k: map(&whole)?,
        noise_k: map(&solved[1])?,
        unknowns: solved,
        diagnostics: Diagnostics {
            epsilon: request.epsilon,
            w_max: w_max * area_sr,
            w_max_iterations: iterations,
            l_max: Some(l_max),
            convergence: convergence.first().copied(),
            noise_convergence: convergence.get(1).copied(),
            traces: traces.map(|traces| Traces { sigma_n_k2: traces.sigma_n_k2 / area_sr, ..traces }),
        },
    })
}

fn prior_unknowns(map: &[f64], l_max: usize) -> Result<Vec<f64>, SolveError> {
    if nside_of(map.len()).is_none() {
        return Err(SolveError::PriorLength { found: map.len(), expected: 12 });
    }
    let found = analysis(map, l_max, &AnalysisOptions::default()).map_err(SolveError::from)?;
    Ok(unknowns(&found.alm))
}
