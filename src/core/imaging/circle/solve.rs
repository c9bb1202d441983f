//! Solves the regularised normal equations over harmonic coefficients.

use super::posterior::Posterior;
use super::whole::PowerEquations;
use super::{HarmonicSums, OrderBlocks, coefficients, unknowns};
use crate::imaging::NormalSums;
use crate::imaging::SolveError;
use crate::imaging::power::{MapsWithPower, Samples, Uncertainty};
use crate::imaging::regulariser::Regulariser;
use crate::imaging::solver::{Convergence, Diagnostics, FitInputs, NamedWatch, StoppingRule};
use crate::imaging::solver::{LargestEigenvalue, System, largest_eigenvalue_from, normalised, random_vector};
use crate::imaging::solver::{add, check_request, dot, right_hand_side, traces};
use crate::imaging::unknowns::degrees;
use crate::sky::harmonics::{AnalysisOptions, analysis, synthesis};
use crate::sky::healpix::{nside_of, pixel_area_sr};

/// Relative change of W_max at which it has converged. It only scales R, and epsilon is never needed to a percent.
const W_MAX_TOLERANCE: f64 = 1e-3;

/// Number of products with the blocks before the iteration for W_max.
const POWER_STEPS: usize = 6;

/// Parameters of a harmonic solution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HarmonicRequest {
    /// epsilon of R = epsilon W_max I.
    pub epsilon: f64,
    /// nside of the maps.
    pub nside: usize,
    /// Stopping rule.
    pub rule: StoppingRule,
    /// Number of posterior samples; with R from the data.
    pub samples: Samples,
    /// Number of random probes for traces of covariances if the matrix is too large to store; 0 for no traces. Traces require a multiple of the
    /// identity as R.
    pub probes: usize,
}

/// A map and its noise-only companion, with their coefficients.
#[derive(Clone, Debug, PartialEq)]
pub struct HarmonicSolution {
    /// Map, K, HEALPix RING.
    pub map_k: Vec<f64>,
    /// Noise-only map, K.
    pub noise_k: Vec<f64>,
    /// The unknowns of the map, without the prior, and of the noise-only map: a warm start for more data.
    pub unknowns: [Vec<f64>; 2],
    /// Diagnostics of the solution.
    pub diagnostics: Diagnostics,
    /// Errors of the map; only with R from the data.
    pub uncertainty: Option<Uncertainty>,
}

/// Solves by conjugate gradients, preconditioned by the blocks of BtN^-1B that are diagonal in m.
///
/// The equations are those of [`crate::imaging::solve_pixels`] for functions of degree up to `l_max`, with an R that may depend on the
/// degree. The identity is over orthonormal harmonics, which equals that over pixels up to their area. `start` holds the
/// [`HarmonicSolution::unknowns`] of an earlier solution.
///
/// # Errors
/// There is no data, the size of the prior is not that of a map, or a table of power ends before the map's degrees.
pub fn solve_regularised(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    regulariser: &Regulariser,
    prior_k: Option<&[f64]>,
    start: Option<&[Vec<f64>; 2]>,
    watch: NamedWatch<'_>,
) -> Result<HarmonicSolution, SolveError> {
    if *regulariser == Regulariser::Data {
        return solve_with_power(sums, request, prior_k, start, watch);
    }
    check_request(sums, request.epsilon)?;
    let l_max = sums.setup().l_max;
    let prior = prior_k.map(|map| prior_unknowns(map, l_max)).transpose()?;
    let blocks = sums.order_blocks();
    let LargestEigenvalue { value: w_max, iterations, .. } = largest_of_circle(sums, &blocks, watch);
    let regularisation = regulariser.diagonal(request.epsilon, w_max, l_max)?;
    let right = right_hand_side(sums, prior.as_deref())?;
    let right_hand_sides = [right.as_slice(), sums.noise_right_hand_side()];
    let factors = blocks.factors_with(&|l| regularisation.at(l));
    // Frees memory: at high degrees blocks are as large as the factors.
    drop(blocks);
    let system = System { sums, regularisation, precondition: &|v| factors.solve(v) };
    let (solved, convergence) = iterate(&system, right_hand_sides, start, request.rule, watch);
    let area_sr = pixel_area_sr(request.nside);
    let map = |x: &[f64]| synthesis(&coefficients(x, l_max), request.nside).map_err(SolveError::from);
    let mut whole = solved[0].clone();
    if let Some(prior) = prior {
        add(&mut whole, &prior);
    }
    let mut diagnostics = Diagnostics {
        epsilon: Some(request.epsilon),
        w_max: Some(w_max * area_sr),
        w_max_iterations: iterations,
        ..Diagnostics::of_power(l_max, &convergence)
    };
    if request.probes > 0 {
        let mut product = vec![0.0; whole.len()];
        sums.apply(&whole, &mut product);
        let fitted = FitInputs {
            counts: sums.counts(),
            accuracy: sums.accuracy(),
            w_max,
            right: sums.right_hand_side(),
            whole: &whole,
            product: &product,
            solved: &solved[0],
        };
        diagnostics.fit = Some(fitted.fit(area_sr));
        let found = traces(sums, request.epsilon, w_max, request.probes, watch.beside_map());
        diagnostics = diagnostics.with_traces(found, area_sr);
    }
    Ok(HarmonicSolution {
        map_k: map(&whole)?,
        noise_k: map(&solved[1])?,
        unknowns: solved,
        diagnostics,
        uncertainty: None,
    })
}

/// The part of `V'N^-1V` that a prior p explains, `p.(2 b - A p)`, with `right` = b - A p.
pub(super) fn predicted_power(sums: &HarmonicSums, prior: &[f64], right: &[f64]) -> f64 {
    dot(prior, sums.right_hand_side()) + dot(prior, right)
}

/// Solves as [`solve_regularised`], with R from the data.
fn solve_with_power(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    prior_k: Option<&[f64]>,
    start: Option<&[Vec<f64>; 2]>,
    watch: NamedWatch<'_>,
) -> Result<HarmonicSolution, SolveError> {
    check_request(sums, 1.0)?;
    let HarmonicRequest { nside, rule, samples, .. } = request;
    let l_max = sums.setup().l_max;
    let prior = prior_k.map(|map| prior_unknowns(map, l_max)).transpose()?;
    let right = right_hand_side(sums, prior.as_deref())?;
    let equations = PowerEquations::new(sums, &right, prior.as_deref(), watch);
    let (blocks, degrees) = (equations.blocks(), degrees(l_max).collect::<Vec<usize>>());
    let data_chi2 =
        sums.counts().power - prior.as_ref().map_or(0.0, |prior| predicted_power(sums, prior, &right));
    let (sums, right) = (equations.sums(), &equations.right(&right)[..]);
    let problem = equations.problem(&blocks, &degrees, right, data_chi2);
    let MapsWithPower { found, columns, convergence } = problem.solve_maps(start, rule, watch)?;
    let [solved, noise] = columns;
    let mut whole = solved.clone();
    if let Some(prior) = prior {
        add(&mut whole, &prior);
    }
    let map = |x: &[f64]| synthesis(&coefficients(x, l_max), nside).map_err(SolveError::from);
    let posterior = Posterior {
        sums,
        blocks: &blocks,
        found: &found,
        right,
        solved: &solved,
        whole: &whole,
        nside,
        rule,
        watch: watch.beside_map(),
    };
    let errors = || posterior.uncertainty(samples, &|x| sums.apply_all(x));
    let uncertainty = watch.is_of_final_map().then(errors).transpose()?;
    let errors_may_mislead = equations.may_mislead();
    let diagnostics = Diagnostics { errors_may_mislead, ..Diagnostics::of_power(l_max, &convergence) };
    Ok(HarmonicSolution {
        map_k: map(&whole)?,
        noise_k: map(&noise)?,
        unknowns: [solved, noise],
        diagnostics,
        uncertainty,
    })
}

/// The largest eigenvalue of the sums. The iteration starts near its eigenvector: from a random vector after several power iterations with
/// the blocks of BtN^-1B, which take less time than one product.
pub(in crate::imaging) fn largest_of_circle(
    sums: &HarmonicSums,
    blocks: &OrderBlocks,
    watch: NamedWatch<'_>,
) -> LargestEigenvalue {
    let task = watch.start("largest eigenvalue", W_MAX_TOLERANCE);
    let mut start = random_vector(sums.unknowns());
    for _ in 0..POWER_STEPS {
        blocks.multiply(&mut start);
        start = normalised(start);
    }
    largest_eigenvalue_from(start, sums, W_MAX_TOLERANCE, &mut |needs_step, step, change| {
        task.report_step(needs_step, step, change)
    })
}

/// Solves for the map and the noise-only map, from an earlier solution of the same size if there is one.
fn iterate(
    system: &System<'_>,
    right_hand_sides: [&[f64]; 2],
    start: Option<&[Vec<f64>; 2]>,
    rule: StoppingRule,
    watch: NamedWatch<'_>,
) -> ([Vec<f64>; 2], Vec<Convergence>) {
    let unknowns = system.sums.unknowns();
    let mut solved = [0, 1].map(|which| match start {
        Some(start) if start[which].len() == unknowns => start[which].clone(),
        _ => vec![0.0; unknowns],
    });
    let task = watch.start("map and noise map", rule.residual_max);
    let convergence = system.solve(&right_hand_sides, &mut solved, &[rule, rule], &task);
    (solved, convergence)
}

/// The unknowns of a prior map.
pub(in crate::imaging) fn prior_unknowns(map: &[f64], l_max: usize) -> Result<Vec<f64>, SolveError> {
    if nside_of(map.len()).is_none() {
        return Err(SolveError::PriorLength { found: map.len(), expected: 12 });
    }
    let found = analysis(map, l_max, &AnalysisOptions::default()).map_err(SolveError::from)?;
    Ok(unknowns(&found.alm))
}
