//! Noise-only maps of many realisations, which share everything but their right-hand sides.

use super::posterior::NOISES_TOGETHER;
use super::solve::{HarmonicRequest, largest_of_circle, power_of_data};
use super::{HarmonicSums, coefficients};
use crate::imaging::NormalSums;
use crate::imaging::SolveError;
use crate::imaging::regulariser::Regulariser;
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
    let is_from_data = *regulariser == Regulariser::Data;
    let regulariser = match regulariser {
        Regulariser::Data => &power_of_data(sums, request.rule, watch)?,
        other => other,
    };
    // epsilon does not apply to an R from the data.
    let epsilon = if is_from_data { 1.0 } else { request.epsilon };
    check_request(sums, epsilon)?;
    let blocks = sums.order_blocks();
    let w_max = largest_of_circle(sums, &blocks, watch).value;
    let l_max = sums.setup().l_max;
    let regularisation = regulariser.diagonal(epsilon, w_max, l_max)?;
    let factors = blocks.factors_with(&|l| regularisation.at(l));
    drop(blocks);
    let system = System { sums, regularisation, precondition: &|v| factors.solve(v) };
    let mut maps = Vec::new();
    for right_hand_sides in sums.noise_realisations().chunks(NOISES_TOGETHER) {
        let right_hand_sides: Vec<&[f64]> = right_hand_sides.iter().map(Vec::as_slice).collect();
        let mut solved = vec![vec![0.0; sums.unknowns()]; right_hand_sides.len()];
        let task = watch.start("noise maps", request.rule.residual_max);
        system.solve(&right_hand_sides, &mut solved, &vec![request.rule; right_hand_sides.len()], &task);
        if !watch.may_continue() {
            return Err(SolveError::Interrupted);
        }
        for unknowns in &solved {
            maps.push(synthesis(&coefficients(unknowns, l_max), request.nside)?);
        }
    }
    Ok(maps)
}
