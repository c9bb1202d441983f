//! Pixel maps with R from the data, solved for harmonics up to 2.5 nside with a stored matrix.

use std::borrow::Cow;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, Par};

use super::solve::{
    Diagnostics, PixelSolution, PointBeam, check_request, point_response, subtract_prediction,
};
use crate::imaging::circle::{coefficients, degrees, unknowns};
use crate::imaging::power::{Block, Factors, FoundPower, PowerProblem, Uncertainty};
use crate::imaging::solver::{NamedWatch, SolveError, add, dot};
use crate::imaging::{NormalSums, PixelSums, SumCounts};
use crate::sky::harmonics::Transform;
use crate::sky::healpix::pixel_area_sr;
use crate::units::{StreamKind, random_stream};
use rand_distr::{Distribution, StandardNormal};

/// Maximum nside: 6561 harmonics, and matrices of 1.6 GB in addition to the sums.
pub const POWER_NSIDE_MAX: usize = 32;
/// Degrees per nside, as for harmonic maps.
const DEGREES_PER_NSIDE: f64 = 2.5;
/// Rows of the matrix that are multiplied at once.
const ROWS_AT_ONCE: usize = 512;

/// Solves for the harmonics up to 2.5 nside with `R_l = 1 / C_l`, C_l estimated from the data, and draws `samples` posterior samples. Pixels
/// represent no higher degrees of a sky whose power falls with the degree.
///
/// # Errors
/// There is no data, the prior has another size, or numbers are not finite; [`SolveError::Interrupted`].
pub fn solve_pixels_with_power(
    sums: &PixelSums,
    prior_k: Option<&[f64]>,
    samples: usize,
    beams: &[usize],
    watch: NamedWatch<'_>,
) -> Result<(PixelSolution, Uncertainty), SolveError> {
    check_request(sums, 1.0)?;
    let (nside, pixels) = (sums.nside, sums.unknowns());
    let mut right = sums.right.clone();
    let mut predicted = 0.0;
    if let Some(prior_k) = prior_k {
        if prior_k.len() != pixels {
            return Err(SolveError::PriorLength { found: prior_k.len(), expected: pixels });
        }
        subtract_prediction(sums, prior_k, &mut right);
        // p.(2 b - A p), with b - A p in `right`.
        predicted = dot(prior_k, &sums.right) + dot(prior_k, &right);
    }
    let l_max = (DEGREES_PER_NSIDE * nside as f64) as usize;
    let transform = Transform::new(nside, l_max)?;
    let to_pixels = |x: &[f64]| transform.synthesis(&coefficients(x, l_max)).map_err(SolveError::from);
    // The transpose of `to_pixels`; the adjoint transform includes the area of a pixel.
    let area_sr = pixel_area_sr(nside);
    let from_pixels = |map: &[f64]| -> Result<Vec<f64>, SolveError> {
        Ok(unknowns(&transform.adjoint(map)?).into_iter().map(|x| x / area_sr).collect())
    };
    let degrees: Vec<usize> = degrees(l_max).collect();
    let harmonics = harmonics(&to_pixels, pixels, degrees.len())?;
    if !watch.may_continue() {
        return Err(SolveError::Interrupted);
    }
    let matrix = projected(sums, &harmonics);
    if !watch.may_continue() {
        return Err(SolveError::Interrupted);
    }
    let places = vec![(0..degrees.len()).collect()];
    let blocks = [Block { matrix: Cow::Owned(matrix), degrees: degrees.clone(), places }];
    let right = from_pixels(&right)?;
    let SumCounts { visibilities, power, .. } = sums.counts();
    let numbers = 2.0 * visibilities as f64;
    let problem = PowerProblem {
        sums,
        blocks: &blocks,
        degrees: &degrees,
        right: &right,
        power: power - predicted,
        numbers,
    };
    let found = problem.solve_blocks()?;
    let factor = found.noise_factor();
    let FoundPower { regularisation, solution, power, .. } = found;
    let factors = Factors::new(&blocks, &regularisation);
    let solved = |map: &[f64]| -> Result<Vec<f64>, SolveError> {
        let mut x = from_pixels(map)?;
        factors.solve(&mut x);
        to_pixels(&x)
    };
    let mut map_k = to_pixels(&solution)?;
    if let Some(prior_k) = prior_k {
        add(&mut map_k, prior_k);
    }
    let point = |&pixel: &usize| {
        let response = point_response(sums, pixel)?;
        Ok(PointBeam { pixel, map_k: solved(&response.map_k)? })
    };
    let beams = beams.iter().map(point).collect::<Result<Vec<_>, SolveError>>()?;
    let mut monopole = vec![0.0; degrees.len()];
    monopole[0] = 1.0;
    factors.solve(&mut monopole);
    let sample = |which: usize| {
        let mut sample = to_pixels(&draw(&factors, degrees.len(), factor, which))?;
        add(&mut sample, &map_k);
        Ok(sample)
    };
    // A pixel holds the mean of a sky that has more than the degrees solved for.
    let beyond_k2 = power.variance_beyond_k2(nside);
    let uncertainty = Uncertainty {
        sigma_k: factors
            .quadratic_forms(0, harmonics.transpose().to_owned())
            .into_iter()
            .map(|variance| (factor * factor * variance + beyond_k2).sqrt())
            .collect(),
        mean_sigma_k: factor * (monopole[0].max(0.0) / (4.0 * std::f64::consts::PI)).sqrt(),
        power,
        samples_k: (0..samples).map(sample).collect::<Result<_, SolveError>>()?,
    };
    let diagnostics = Diagnostics::of_power(l_max, &[]);
    let noise_k = solved(&sums.noise)?;
    Ok((PixelSolution { map_k, noise_k, beams, diagnostics }, uncertainty))
}

/// A draw from the posterior, its mean taken off.
fn draw(factors: &Factors<'_>, count: usize, factor: f64, which: usize) -> Vec<f64> {
    let mut stream = random_stream(3, StreamKind::Probe, [count as u64, which as u64]);
    let mut draw: Vec<f64> =
        (0..count).map(|_| StandardNormal.sample(&mut stream)).map(|w: f64| factor * w).collect();
    factors.solve_upper(&mut draw);
    draw
}

/// Computes the values at pixels of coefficients.
type ToPixels<'a> = &'a dyn Fn(&[f64]) -> Result<Vec<f64>, SolveError>;

/// The values of the harmonics at the pixels, one column each.
fn harmonics(to_pixels: ToPixels<'_>, pixels: usize, count: usize) -> Result<Mat<f64>, SolveError> {
    let mut columns = Mat::zeros(pixels, count);
    let mut unit = vec![0.0; count];
    for column in 0..count {
        unit[column] = 1.0;
        for (row, value) in to_pixels(&unit)?.into_iter().enumerate() {
            columns[(row, column)] = value;
        }
        unit[column] = 0.0;
    }
    Ok(columns)
}

/// Transforms the normal matrix from pixels to harmonics.
fn projected(sums: &PixelSums, harmonics: &Mat<f64>) -> Mat<f64> {
    let (pixels, count) = (harmonics.nrows(), harmonics.ncols());
    let mut matrix = Mat::zeros(count, count);
    for first in (0..pixels).step_by(ROWS_AT_ONCE) {
        let rows = ROWS_AT_ONCE.min(pixels - first);
        let of_rows = Mat::from_fn(rows, pixels, |row, column| sums.normal.get(first + row, column));
        let mut product = Mat::zeros(rows, count);
        matmul(product.as_mut(), Accum::Replace, of_rows.as_ref(), harmonics.as_ref(), 1.0, Par::rayon(0));
        let part = harmonics.subrows(first, rows);
        matmul(matrix.as_mut(), Accum::Add, part.transpose(), product.as_ref(), 1.0, Par::rayon(0));
    }
    matrix
}
