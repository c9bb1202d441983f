//! The regularised solution over pixels.

use super::cholesky::{Cholesky, NotPositive};
use crate::imaging::SolveError;
use crate::imaging::solver::{Diagnostics, FitInputs, NamedWatch, PointBeam, SolveWatch};
use crate::imaging::solver::{LargestEigenvalue, W_MAX_EXACT, largest_eigenvalue};
use crate::imaging::solver::{add, check_request, right_hand_side, subtract, traces};
use crate::imaging::{NormalSums, PixelSums};

/// A map and its noise-only companion.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelSolution {
    /// Map, K, HEALPix RING.
    pub map_k: Vec<f64>,
    /// Noise-only map, K.
    pub noise_k: Vec<f64>,
    /// Requested effective beams.
    pub beams: Vec<PointBeam>,
    /// Diagnostics of the solution.
    pub diagnostics: Diagnostics,
}

/// Optional results of a solution.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PixelExtras<'a> {
    /// Number of probes for traces if the matrix is too large to be decomposed; 0 for neither traces nor fit.
    pub probes: usize,
    /// Pixels whose effective beams are computed.
    pub beams: &'a [usize],
}

/// Solves by Cholesky factorisation, in the memory of the sums.
///
/// `T = (BtN^-1B + R)^-1 (BtN^-1V - BtN^-1B T_p) + T_p`; the noise-only map is the same inverse times
/// `BtN^-1n`, without a prior.
///
/// # Errors
/// There is no data, the prior has another size, or the matrix is not positive definite.
///
/// ```
/// use lunarray::prelude::*;
/// use lunarray::response::pixel::{Directions, PairGeometry, PixelMethod, sky_sums};
/// use lunarray::units::constants::MOON_RADIUS_M;
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// // External visibilities: here of a sky of 1e6 K, from two satellites in orbit about the Moon.
/// let (sky, frequency_hz) = (SkyMap::constant(16, Frame::Ecliptic, 1e6)?, 3e6);
/// let pair = |k: u32| {
///     let (sin, cos) = (0.1 * f64::from(k)).sin_cos();
///     let r_i_m = [2.04e6 * cos, 2.04e6 * sin, 0.0];
///     let r_j_m = [r_i_m[0], r_i_m[1] + f64::from(1 + k % 7), 0.3 * f64::from(k % 5)];
///     PairGeometry { r_i_m, r_j_m, frequency_hz, moon_radius_m: MOON_RADIUS_M, response: AntennaResponse::Isotropic }
/// };
/// let pairs: Vec<PairGeometry> = (0..500).map(pair).collect();
/// let values: Vec<f32> = sky.values().iter().map(|&kelvin| kelvin as f32).collect();
/// let directions = Directions::from(sky.directions_ecliptic().as_slice());
/// let sums = sky_sums(&pairs, &directions, &values, lunarray::sky::healpix::pixel_area_sr(16))?;
///
/// // The weight is the inverse variance, (K sr)^-2.
/// let block = PlacedVisibilities {
///     frequency_hz,
///     time_s: (0..500).map(f64::from).collect(),
///     r_i_m: pairs.iter().map(|pair| pair.r_i_m).collect(),
///     r_j_m: pairs.iter().map(|pair| pair.r_j_m).collect(),
///     value_k_sr: sums.iter().map(|sum| sum.visibility_k_sr).collect(),
///     weight: vec![1e-8; 500],
///     ..PlacedVisibilities::default()
/// };
/// let mut engine = PixelEngine::new(PixelSetup {
///     nside: 1,
///     frequency_hz,
///     method: PixelMethod::Average,
///     moon_radius_m: MOON_RADIUS_M,
///     response: AntennaResponse::Isotropic,
///     companion_seed: 1,
///     weight_max: 2e-8,
/// })?;
/// assert_eq!(engine.add(&block)?.visibilities, 500);
/// let solution = solve_pixels(engine.into_sums(), 1e-6, None)?;
/// let mean_k = solution.map_k.iter().sum::<f64>() / 12.0;
/// assert!((mean_k / 1e6 - 1.0).abs() < 0.01, "{mean_k} K");
/// # Ok(())
/// # }
/// ```
pub fn solve_pixels(
    sums: PixelSums,
    epsilon: f64,
    prior_k: Option<&[f64]>,
) -> Result<PixelSolution, SolveError> {
    solve_pixels_with(sums, epsilon, prior_k, PixelExtras::default(), SolveWatch::default().named("map"))
}

/// Solves as [`solve_pixels`], with optional results; `watch` can interrupt it.
///
/// # Errors
/// As [`solve_pixels`]; [`SolveError::Interrupted`]; or the map does not have the pixel of a beam.
pub fn solve_pixels_with(
    sums: PixelSums,
    epsilon: f64,
    prior_k: Option<&[f64]>,
    extras: PixelExtras<'_>,
    watch: NamedWatch<'_>,
) -> Result<PixelSolution, SolveError> {
    check_request(&sums, epsilon)?;
    let PixelExtras { probes, beams } = extras;
    let mut map_k = right_hand_side(&sums, prior_k)?;
    let LargestEigenvalue { value: w_max, iterations, .. } =
        largest_eigenvalue(&sums, W_MAX_EXACT, &mut |_, _| watch.may_continue());
    // Before the factorisation, which overwrites the sums.
    let traces = (probes > 0).then(|| traces(&sums, epsilon, w_max, probes, watch.beside_map()));
    let accuracy = sums.accuracy();
    let mut beams = beams.iter().map(|&pixel| point_response(&sums, pixel)).collect::<Result<Vec<_>, _>>()?;
    let PixelSums { mut normal, right, noise: mut noise_k, counts, .. } = sums;
    normal.add_to_diagonal(epsilon * w_max);
    for step in 0..normal.along() {
        if !watch.may_continue() {
            return Err(SolveError::Interrupted);
        }
        Cholesky::advance(&mut normal, step)
            .map_err(|NotPositive(pixel)| SolveError::NotPositive { pixel, epsilon })?;
    }
    let factor = Cholesky::from_factor(normal);
    rayon::join(|| factor.solve(&mut map_k), || factor.solve(&mut noise_k));
    beams.iter_mut().for_each(|beam| factor.solve(&mut beam.map_k));
    let solved = (probes > 0).then(|| map_k.clone());
    if let Some(prior_k) = prior_k {
        add(&mut map_k, prior_k);
    }
    let fit = solved.map(|solved| {
        // From (A + R) y = b - A T_p follows A (y + T_p) = b - R y.
        let mut product = right.clone();
        subtract(&mut product, epsilon * w_max, &solved);
        let (right, whole, product, solved) = (&right, &map_k, &product, &solved);
        FitInputs { counts, accuracy, w_max, right, whole, product, solved }.fit(1.0)
    });
    let diagnostics = Diagnostics {
        epsilon: Some(epsilon),
        w_max: Some(w_max),
        w_max_iterations: iterations,
        fit,
        ..Diagnostics::default()
    };
    let diagnostics = match traces {
        Some(found) => diagnostics.with_traces(found, 1.0),
        None => diagnostics,
    };
    Ok(PixelSolution { map_k, noise_k, beams, diagnostics })
}

/// The product of `BtN^-1B` and a sky that is 1 K in one pixel.
pub(super) fn point_response(sums: &dyn NormalSums, pixel: usize) -> Result<PointBeam, SolveError> {
    let pixels = sums.unknowns();
    let mut point = vec![0.0; pixels];
    *point.get_mut(pixel).ok_or(SolveError::NoPixel { pixel, pixels })? = 1.0;
    let mut response = vec![0.0; pixels];
    sums.apply(&point, &mut response);
    Ok(PointBeam { pixel, map_k: response })
}
