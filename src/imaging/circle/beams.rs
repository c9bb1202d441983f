//! The effective beam in some directions: what a map makes of a point there.
//!
//! `B_eff = (A + R)^-1 A`, A the normal matrix: its column for a pixel is the solution for data of a sky that is 1 K in that pixel alone.

use super::solve::HarmonicRequest;
use super::{HarmonicSums, coefficients, unknowns};
use crate::imaging::NormalSums;
use crate::imaging::pixel::PointBeam;
use crate::imaging::regulariser::Regulariser;
use crate::imaging::solver::NamedWatch;
use crate::imaging::solver::SolveError;
use crate::imaging::solver::System;
use crate::sky::harmonics::Transform;
use crate::sky::healpix::pixel_count;

/// Beams of a harmonic map at pixels of its nside, solved for as the map is; `w_max` is the largest eigenvalue over harmonics. Those
/// that are reached before an interruption.
///
/// # Errors
/// A pixel that the map does not have; an nside or degree without a transform; a table of power that ends too early.
pub fn harmonic_beams(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    (regulariser, w_max): (&Regulariser, f64),
    pixels: &[usize],
    watch: NamedWatch<'_>,
) -> Result<Vec<PointBeam>, SolveError> {
    let l_max = sums.setup().l_max;
    let transform = Transform::new(request.nside, l_max)?;
    let regularisation = regulariser.diagonal(request.epsilon, w_max, l_max)?;
    let factors = sums.order_blocks().factors_with(&|l| regularisation.at(l));
    let system = System { sums, regularisation, precondition: &|v| factors.solve(v) };
    let count = pixel_count(request.nside);
    let mut beams = Vec::new();
    for &pixel in pixels {
        let mut point = vec![0.0; count];
        *point.get_mut(pixel).ok_or(SolveError::NoPixel { pixel, pixels: count })? = 1.0;
        let mut right = vec![0.0; sums.unknowns()];
        sums.apply(&unknowns(&transform.adjoint(&point)?), &mut right);
        let mut beam = [vec![0.0; right.len()]];
        let task = watch.start(&format!("beam at pixel {pixel}"), request.rule.residual_max);
        system.solve(&[&right], &mut beam, &[request.rule], &task);
        if !watch.may_continue() {
            break;
        }
        beams.push(PointBeam { pixel, map_k: transform.synthesis(&coefficients(&beam[0], l_max))? });
    }
    Ok(beams)
}
