//! Effective beams of harmonic maps.
//!
//! The beam at a pixel is a column of `B_eff = (A + R)^-1 A`, A the normal matrix: the solution for a sky that is 1 K in that pixel only.

use super::solve::HarmonicRequest;
use super::whole::PowerEquations;
use super::{HarmonicSums, coefficients, unknowns};
use crate::imaging::NormalSums;
use crate::imaging::SolveError;
use crate::imaging::power::Factors;
use crate::imaging::regulariser::{Diagonal, Regulariser};
use crate::imaging::solver::{NamedWatch, PointBeam, System};
use crate::sky::harmonics::Transform;
use crate::sky::healpix::pixel_count;

/// Solves for the beams of a harmonic map at pixels of its nside; `w_max` is the largest eigenvalue over harmonics. After an interruption the
/// beams so far are returned.
///
/// # Errors
/// The map does not have a pixel; there is no transform for its nside or degree; or a table of power ends too early.
pub fn harmonic_beams(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    (regulariser, w_max): (&Regulariser, f64),
    pixels: &[usize],
    watch: NamedWatch<'_>,
) -> Result<Vec<PointBeam>, SolveError> {
    let regularisation = regulariser.diagonal(request.epsilon, w_max, sums.setup().l_max)?;
    let factors = sums.order_blocks().factors_with(&|l| regularisation.at(l));
    let system = System { sums, regularisation, precondition: &|v| factors.solve(v) };
    beams(&system, sums.setup().l_max, request, pixels, watch)
}

/// The same of the R by degree that was found from the data, with the equations of that map.
///
/// # Errors
/// As [`harmonic_beams`].
pub(in crate::imaging) fn beams_with_power(
    sums: &HarmonicSums,
    request: HarmonicRequest,
    r: Vec<f64>,
    pixels: &[usize],
    watch: NamedWatch<'_>,
) -> Result<Vec<PointBeam>, SolveError> {
    let equations = PowerEquations::new(sums, sums.right_hand_side(), None, watch);
    let blocks = equations.blocks();
    let factors = Factors::new(&blocks, &r);
    let regularisation = Diagonal::ByDegree(r);
    let system = System { sums: equations.sums(), regularisation, precondition: &|v| factors.solve(v) };
    beams(&system, sums.setup().l_max, request, pixels, watch)
}

fn beams(
    system: &System<'_>,
    l_max: usize,
    request: HarmonicRequest,
    pixels: &[usize],
    watch: NamedWatch<'_>,
) -> Result<Vec<PointBeam>, SolveError> {
    let transform = Transform::new(request.nside, l_max)?;
    let count = pixel_count(request.nside);
    let mut beams = Vec::new();
    for &pixel in pixels {
        let mut point = vec![0.0; count];
        *point.get_mut(pixel).ok_or(SolveError::NoPixel { pixel, pixels: count })? = 1.0;
        let mut right = vec![0.0; system.sums.unknowns()];
        system.sums.apply(&unknowns(&transform.adjoint(&point)?), &mut right);
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
