//! Pixel maps with R from the data, solved for harmonics up to 2.5 nside with a stored matrix.

use std::borrow::Cow;

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, get_global_parallelism};

use super::projected::Harmonics;
use super::solve::{PixelSolution, point_response};
use crate::imaging::SolveError;
use crate::imaging::circle::{degrees, moments, moments_k, resolution_deg, sample, unknowns};
use crate::imaging::power::{Block, Factors, FoundPower, PowerProblem, Sample, Samples, Uncertainty};
use crate::imaging::solver::{Diagnostics, NamedWatch, PointBeam};
use crate::imaging::solver::{add, check_request, dot, right_hand_side, subtract};
use crate::imaging::{NormalSums, PixelSums, SumCounts};
use crate::sky::harmonics::{AnalysisOptions, analysis};
use crate::units::{StreamKind, random_stream};
use rand_distr::{Distribution, StandardNormal};

/// Maximum nside: 6561 harmonics, and matrices of 1.6 GB in addition to the sums.
pub(in crate::imaging) const POWER_NSIDE_MAX: usize = 32;
/// First number of the draws of Gibbs sampling: those of plain samples are below.
const GIBBS: u64 = 1 << 40;
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
    samples: Samples,
    beams: &[usize],
    watch: NamedWatch<'_>,
) -> Result<(PixelSolution, Uncertainty), SolveError> {
    check_request(sums, 1.0)?;
    let (nside, pixels) = (sums.nside, sums.unknowns());
    let right = right_hand_side(sums, prior_k)?;
    // p.(2 b - A p), with b - A p in `right`.
    let predicted = prior_k.map_or(0.0, |prior_k| dot(prior_k, &sums.right) + dot(prior_k, &right));
    let transform = Harmonics::new(nside)?;
    let l_max = transform.l_max();
    let to_pixels = |x: &[f64]| transform.to_pixels(x);
    let harmonics_of = |map: &[f64]| transform.harmonics_of(map);
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
    let right = harmonics_of(&right)?;
    let SumCounts { visibilities, power, .. } = sums.counts();
    let numbers = 2.0 * visibilities as f64;
    let problem = PowerProblem {
        sums,
        blocks: &blocks,
        coupling: None,
        degrees: &degrees,
        right: &right,
        data_chi2: power - predicted,
        data_count: numbers,
    };
    let hidden = HiddenSky::new(sums);
    let found = problem.solve_blocks(&|x| {
        if !watch.may_continue() {
            return Err(SolveError::Interrupted);
        }
        // Mean and dipole are free.
        let structure = x.iter().zip(&degrees).map(|(x, l)| if *l < 2 { 0.0 } else { *x });
        Ok(hidden.is_plausible(&to_pixels(&structure.collect::<Vec<f64>>())?))
    })?;
    let factors = Factors::new(&blocks, &found.regularisation);
    let solved = |map: &[f64]| -> Result<Vec<f64>, SolveError> {
        let mut x = harmonics_of(map)?;
        factors.solve(&mut x);
        to_pixels(&x)
    };
    let mut map_k = to_pixels(&found.solution)?;
    if let Some(prior_k) = prior_k {
        add(&mut map_k, prior_k);
    }
    let point = |&pixel: &usize| {
        let response = point_response(sums, pixel)?;
        Ok(PointBeam { pixel, map_k: solved(&response.map_k)? })
    };
    let beams = beams.iter().map(point).collect::<Result<Vec<_>, SolveError>>()?;
    let posterior = PixelPosterior {
        blocks: &blocks,
        found: &found,
        factors: &factors,
        right: &right,
        map_k: &map_k,
        harmonics,
        to_pixels: &to_pixels,
    };
    let uncertainty = posterior.uncertainty(nside, samples)?;
    let diagnostics = Diagnostics::of_power(l_max, &[]);
    let noise_k = solved(&sums.noise)?;
    Ok((PixelSolution { map_k, noise_k, beams, diagnostics }, uncertainty))
}

/// Pixels that no visibility saw, or hardly any.
struct HiddenSky {
    is_hidden: Vec<bool>,
}

/// Pixels with less than this share of the greatest weight are hidden.
const HIDDEN_WEIGHT: f64 = 0.01;
/// Least share of hidden pixels for which the map is judged.
const HIDDEN_SHARE: f64 = 0.02;
/// A hidden sky whose structure (l >= 2) is rougher than that of the rest by this factor (rms) is no sky: R expects the same of both, and that where
/// nothing is measured the map is smooth.
const ROUGHER: f64 = 2.0;

impl HiddenSky {
    fn new(sums: &PixelSums) -> Self {
        let weights: Vec<f64> = (0..sums.unknowns()).map(|pixel| sums.normal.get(pixel, pixel)).collect();
        let greatest = weights.iter().copied().fold(0.0, f64::max);
        Self { is_hidden: weights.into_iter().map(|weight| weight < HIDDEN_WEIGHT * greatest).collect() }
    }

    /// Whether the map's hidden part is not much rougher than the rest.
    fn is_plausible(&self, map: &[f64]) -> bool {
        let part = |hidden: bool| {
            let of_part = map.iter().zip(&self.is_hidden).filter(|(_, is_hidden)| **is_hidden == hidden);
            of_part.map(|(value, _)| *value).collect::<Vec<f64>>()
        };
        let (hidden, seen) = (part(true), part(false));
        if (hidden.len() as f64) < HIDDEN_SHARE * map.len() as f64 || seen.is_empty() {
            return true;
        }
        let square = |values: &[f64]| dot(values, values) / values.len() as f64;
        square(&hidden) <= ROUGHER.powi(2) * square(&seen)
    }
}

/// The equations over harmonics, solved.
struct PixelPosterior<'a> {
    blocks: &'a [Block<'a>],
    found: &'a FoundPower,
    factors: &'a Factors<'a>,
    /// Right-hand side, less what the prior map predicts.
    right: &'a [f64],
    /// The map, with its prior.
    map_k: &'a [f64],
    /// At pixels, a column each.
    harmonics: Mat<f64>,
    to_pixels: ToPixels<'a>,
}

impl PixelPosterior<'_> {
    fn uncertainty(self, nside: usize, samples: Samples) -> Result<Uncertainty, SolveError> {
        let FoundPower { regularisation, power, .. } = self.found;
        let (factor, l_max, count) = (power.noise_factor, regularisation.len() - 1, self.right.len());
        let of_moment = |(place, scale): (usize, f64)| {
            let mut column = vec![0.0; count];
            column[place] = 1.0;
            self.factors.solve(&mut column);
            factor * scale.abs() * column[place].max(0.0).sqrt()
        };
        let [mean_sigma_k, dipole_sigma_k @ ..] = moments(l_max).map(of_moment);
        // The map's own, whatever the prior has beyond its degrees.
        let whole = unknowns(&analysis(self.map_k, l_max, &AnalysisOptions::default())?.alm);
        let [_, dipole_k @ ..] = moments_k(&whole, l_max);
        let drawn = |which: usize| -> Result<Sample, SolveError> {
            let mut drawn =
                if samples.gibbs { self.gibbs(which) } else { self.draw(self.factors, which as u64) };
            let mut map = (self.to_pixels)(&drawn)?;
            add(&mut map, self.map_k);
            add(&mut drawn, &whole);
            Ok(sample(&drawn, l_max, map))
        };
        let samples = (0..samples.count).map(drawn).collect::<Result<_, SolveError>>()?;
        // A pixel holds the mean of a sky that has more than the degrees solved for.
        let beyond_k2 = power.variance_beyond_k2(nside);
        let roots: Vec<f64> = degrees(l_max).map(|l| regularisation[l].sqrt()).collect();
        let columns = self.harmonics.transpose();
        let open = Mat::from_fn(count, self.map_k.len(), |row, pixel| roots[row] * columns[(row, pixel)]);
        let open = self.factors.quadratic_forms(0, open);
        let variances = self.factors.quadratic_forms(0, columns.to_owned());
        Ok(Uncertainty {
            sigma_k: variances.iter().map(|v| (factor * factor * v + beyond_k2).sqrt()).collect(),
            resolution_deg: open.into_iter().map(|open| resolution_deg(count as f64, open)).collect(),
            mean_sigma_k,
            dipole_k,
            dipole_sigma_k,
            power: power.clone(),
            gains: None,
            samples,
        })
    }

    /// A draw from the posterior with the R of these factors, its mean taken off.
    fn draw(&self, factors: &Factors<'_>, which: u64) -> Vec<f64> {
        let count = self.right.len();
        let mut stream = random_stream(3, StreamKind::Probe, [count as u64, which]);
        let factor = self.found.noise_factor();
        let mut draw: Vec<f64> =
            (0..count).map(|_| StandardNormal.sample(&mut stream)).map(|w: f64| factor * w).collect();
        factors.solve_upper(&mut draw);
        draw
    }

    /// A draw whose R is drawn, too, the map taken off.
    fn gibbs(&self, which: usize) -> Vec<f64> {
        let mut turn = 0;
        let mut sky = self.found.gibbs(which as u64, &mut |r| {
            turn += 1;
            let factors = Factors::new(self.blocks, r);
            let mut sky = self.right.to_vec();
            factors.solve(&mut sky);
            add(&mut sky, &self.draw(&factors, GIBBS + 16 * which as u64 + turn));
            sky
        });
        subtract(&mut sky, 1.0, &self.found.solution);
        sky
    }
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
        matmul(
            product.as_mut(),
            Accum::Replace,
            of_rows.as_ref(),
            harmonics.as_ref(),
            1.0,
            get_global_parallelism(),
        );
        let part = harmonics.subrows(first, rows);
        matmul(
            matrix.as_mut(),
            Accum::Add,
            part.transpose(),
            product.as_ref(),
            1.0,
            get_global_parallelism(),
        );
    }
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A map of twelve pixels, of which four are hidden.
    #[test]
    fn structure_where_nothing_is_seen_is_no_sky() {
        let hidden = HiddenSky { is_hidden: (0..12).map(|pixel| pixel < 4).collect() };
        let map = |inside: f64| -> Vec<f64> {
            (0..12)
                .map(|pixel| if pixel < 4 { inside } else { 1.0 } * if pixel % 2 == 0 { 1.0 } else { -1.0 })
                .collect()
        };
        assert!(
            hidden.is_plausible(&map(0.0))
                && hidden.is_plausible(&map(1.9))
                && !hidden.is_plausible(&map(2.1))
        );
        // Of a sky that is seen everywhere nothing is judged, nor of one that is seen nowhere.
        for is_hidden in [false, true] {
            assert!(HiddenSky { is_hidden: vec![is_hidden; 12] }.is_plausible(&map(9.0)));
        }
    }
}
