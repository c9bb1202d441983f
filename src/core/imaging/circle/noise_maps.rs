//! Noise-only maps of many realisations, which share everything but their right-hand sides.

use super::posterior::NOISES_TOGETHER;
use super::solve::{HarmonicRequest, largest_of_circle};
use super::whole::PowerEquations;
use super::{HarmonicSums, coefficients, degrees};
use crate::imaging::NormalSums;
use crate::imaging::SolveError;
use crate::imaging::power::Factors;
use crate::imaging::regulariser::{Diagonal, Regulariser};
use crate::imaging::solver::{NamedWatch, System, check_request};
use crate::sky::harmonics::synthesis;

/// Solves for the noise-only maps, K, of the additional realisations of the sums ([`HarmonicSums::noise_realisations`]). Each equals the
/// noise-only map of [`crate::imaging::solve_regularised`] for that realisation.
///
/// # Errors
/// There is no data, or a table of power ends before the map's degrees; [`SolveError::Interrupted`].
pub fn solve_noises(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    regulariser: &Regulariser,
    watch: NamedWatch<'_>,
) -> Result<Vec<Vec<f64>>, SolveError> {
    if *regulariser == Regulariser::Data {
        return noises_with_power(sums, request, watch);
    }
    check_request(sums, request.epsilon)?;
    let blocks = sums.order_blocks();
    let w_max = largest_of_circle(sums, &blocks, watch).value;
    let regularisation = regulariser.diagonal(request.epsilon, w_max, sums.setup().l_max)?;
    let factors = blocks.factors_with(&|l| regularisation.at(l));
    drop(blocks);
    let system = System { sums, regularisation, precondition: &|v| factors.solve(v) };
    solve_all(&system, sums, &|right| right.to_vec(), request, watch)
}

/// The same with R from the data.
fn noises_with_power(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    watch: NamedWatch<'_>,
) -> Result<Vec<Vec<f64>>, SolveError> {
    check_request(sums, 1.0)?;
    let equations = PowerEquations::new(sums, sums.right_hand_side(), None, watch);
    let (blocks, degrees) = (equations.blocks(), degrees(sums.setup().l_max).collect::<Vec<usize>>());
    let right = equations.right(sums.right_hand_side());
    let problem = equations.problem(&blocks, &degrees, &right, sums.counts().power);
    let r = problem.solve(None, request.rule, watch)?.regularisation;
    let factors = Factors::new(&blocks, &r);
    let regularisation = Diagonal::ByDegree(r);
    let system = System { sums: equations.sums(), regularisation, precondition: &|v| factors.solve(v) };
    solve_all(&system, sums, &|right| equations.right(right), request, watch)
}

/// Solves for each realisation, whose right-hand side the equations have as `right_of` makes it.
fn solve_all(
    system: &System<'_>,
    sums: &HarmonicSums,
    right_of: &dyn Fn(&[f64]) -> Vec<f64>,
    request: HarmonicRequest,
    watch: NamedWatch<'_>,
) -> Result<Vec<Vec<f64>>, SolveError> {
    let mut maps = Vec::new();
    for right_hand_sides in sums.noise_realisations().chunks(NOISES_TOGETHER) {
        let right_hand_sides: Vec<Vec<f64>> = right_hand_sides.iter().map(|right| right_of(right)).collect();
        let right_hand_sides: Vec<&[f64]> = right_hand_sides.iter().map(Vec::as_slice).collect();
        let mut solved = vec![vec![0.0; sums.unknowns()]; right_hand_sides.len()];
        let task = watch.start("noise maps", request.rule.residual_max);
        system.solve(&right_hand_sides, &mut solved, &vec![request.rule; right_hand_sides.len()], &task);
        if !watch.may_continue() {
            return Err(SolveError::Interrupted);
        }
        for unknowns in &solved {
            maps.push(synthesis(&coefficients(unknowns, sums.setup().l_max), request.nside)?);
        }
    }
    Ok(maps)
}
