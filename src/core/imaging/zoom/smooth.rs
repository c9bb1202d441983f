//! What sources leave of a patch, as a regularised map: `(B'WB + R) x = B'W V`, solved by conjugate gradients.
//!
//! R is `1 / variance` of a pixel, the same for all: nothing is assumed of the sky's smoothness. The variance is what the dirty image has
//! beyond its noise, over the sum of the squared beam. The preconditioner takes `B'WB` for a convolution with the beam, which it nearly is.

use num_complex::Complex64;
use rayon::prelude::*;
use rustfft::{Fft, FftPlanner};
use serde::Serialize;
use std::sync::Arc;

use super::find::PatchData;
use crate::imaging::solver::{Convergence, StoppingRule, solve_one};
use crate::numerics::fft_length;

const RULE: StoppingRule = StoppingRule { residual_max: 1e-4, iterations_max: 50 };
/// The least part of the noise's variance that counts as that of a sky, in standard deviations of the image's variance.
const SIGNIFICANT: f64 = 5.0;

/// A regularised map of a patch.
#[derive(Clone, Debug, PartialEq)]
pub struct SmoothMap {
    /// Flux density in each pixel, Jy; 0 outside the patch.
    pub pixel_jy: Vec<f64>,
    /// How it was solved.
    pub report: SmoothReport,
}

/// How a regularised map was solved.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SmoothReport {
    /// Standard deviation of a pixel of the sky, which is R, Jy.
    pub pixel_sigma_jy: f64,
    /// Iterations.
    pub iterations: usize,
    /// Residual.
    pub residual: f64,
}

/// Multiplies by functions of spatial frequency.
struct Filter {
    side: usize,
    length: usize,
    forward: Arc<dyn Fft<f64>>,
    back: Arc<dyn Fft<f64>>,
    response: Vec<f64>,
}

impl Filter {
    /// The transform of the beam, in columns of pixels with the centre at `side / 2`, times the weight.
    fn new(side: usize, beam: &[f64], weight: f64) -> Self {
        let length = fft_length(side);
        let mut planner = FftPlanner::new();
        let (forward, back) = (planner.plan_fft_forward(length), planner.plan_fft_inverse(length));
        let mut filter = Self { side, length, forward, back, response: Vec::new() };
        let mut square = vec![Complex64::ZERO; length * length];
        let centred = |k: usize| (k + length - side / 2) % length;
        for (index, value) in beam.iter().enumerate() {
            square[centred(index / side) * length + centred(index % side)].re = weight * value;
        }
        filter.transform(&mut square, true);
        // Sampled side lobes that the square cuts off make it slightly negative.
        filter.response = square.iter().map(|value| value.re.max(0.0)).collect();
        filter
    }

    fn transform(&self, square: &mut Vec<Complex64>, is_forward: bool) {
        let fft = if is_forward { &self.forward } else { &self.back };
        for _ in 0..2 {
            square.par_chunks_mut(self.length).for_each(|row| fft.process(row));
            let source = std::mem::take(square);
            *square = vec![Complex64::ZERO; source.len()];
            square.par_chunks_mut(self.length).enumerate().for_each(|(k, row)| {
                row.iter_mut().enumerate().for_each(|(j, value)| *value = source[j * self.length + k]);
            });
        }
    }

    /// `x / (response + r)` by spatial frequency.
    fn divide(&self, x: &[f64], r: f64) -> Vec<f64> {
        let mut square = vec![Complex64::ZERO; self.length * self.length];
        for (row, x) in square.chunks_exact_mut(self.length).zip(x.chunks_exact(self.side)) {
            row.iter_mut().zip(x).for_each(|(value, x)| value.re = *x);
        }
        self.transform(&mut square, true);
        square.par_iter_mut().zip(&self.response).for_each(|(value, response)| *value /= response + r);
        self.transform(&mut square, false);
        let scale = ((self.length * self.length) as f64).recip();
        square
            .chunks_exact(self.length)
            .take(self.side)
            .flat_map(|row| &row[..self.side])
            .map(|v| scale * v.re)
            .collect()
    }
}

impl PatchData<'_> {
    /// The regularised map of residual visibilities, whose dirty image is given; `None` if that is noise.
    #[must_use]
    pub fn smooth_map(&self, image_jy: &[f64], beam: &[f64]) -> Option<SmoothMap> {
        let grid = self.transform.grid();
        let inside: Vec<bool> = (0..grid.len()).map(|k| grid.is_inside(k)).collect();
        let square = |values: &[f64]| values.iter().map(|value| value * value).sum::<f64>();
        let (pixels, squared_beam) = (inside.iter().filter(|inside| **inside).count() as f64, square(beam));
        let thermal = self.sums.sigma_jy().powi(2);
        // The noise of pixels is correlated as the beam: there are this many independent ones.
        let independent = pixels / squared_beam.max(1.0);
        let excess = square(image_jy) / pixels - thermal;
        if excess <= SIGNIFICANT * thermal * (2.0 / independent).sqrt() {
            return None;
        }
        let pixel_sigma_jy = (excess / squared_beam).sqrt();
        let r = pixel_sigma_jy.powi(-2);
        let filter = Filter::new(grid.side, beam, self.sums.weight);
        let precondition = |x: &mut [f64]| {
            let z = filter.divide(x, r);
            x.iter_mut()
                .zip(&z)
                .zip(&inside)
                .for_each(|((x, z), inside)| *x = if *inside { *z } else { 0.0 });
        };
        let product = |x: &[f64]| {
            let mut values = self.transform.forward(x);
            values.iter_mut().zip(self.rows).for_each(|(value, row)| *value *= row.weight);
            let mut y = self.transform.adjoint(&values);
            y.iter_mut().zip(x).for_each(|(y, x)| *y += r * x);
            y
        };
        let right: Vec<f64> = image_jy.iter().map(|value| self.sums.weight * value).collect();
        let (pixel_jy, Convergence { iterations, residual, .. }) =
            solve_one(&right, RULE, &product, &precondition);
        Some(SmoothMap { pixel_jy, report: SmoothReport { pixel_sigma_jy, iterations, residual } })
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use faer::linalg::solvers::Solve;

    use super::*;
    use crate::imaging::zoom::{PatchTransform, PixelGrid, Row, RowSums};
    use crate::units::vector::dot;

    #[test]
    fn a_map_solves_the_equations_of_dense_matrices() {
        let grid = PixelGrid::new(1.0_f64.to_radians(), 2.0_f64.to_radians() / 12.0);
        // Baselines by irrational steps.
        let part = |k: usize, step: f64| (k as f64 * step).fract() - 0.5;
        let row = |k| Row {
            u: [part(k, 0.618_034), part(k, 0.414_214), part(k, 0.732_051)].map(|x| 0.9 / grid.step * x),
            spread: [0.0; 3],
            value: Complex64::ZERO,
            weight: 2.0,
        };
        let rows: Vec<Row> = (0..500).map(row).collect();
        let inside: Vec<usize> = (0..grid.len()).filter(|&k| grid.is_inside(k)).collect();
        let b = |row: &Row, k: usize| {
            let [l, m] = grid.place(k);
            Complex64::cis(-TAU * dot(row.u, [l, m, (1.0 - l * l - m * m).sqrt() - 1.0]))
        };
        let sky = |k: usize| part(k, 0.539_345);
        let data: Vec<Complex64> =
            rows.iter().map(|row| inside.iter().map(|&k| sky(k) * b(row, k)).sum()).collect();
        let transform = PatchTransform::new(grid, &rows);
        let patch =
            PatchData { rows: &rows, sums: RowSums::new(&rows), transform: &transform, beam: grid.step };
        let (image, beam) = (patch.image_jy(&data), patch.image_jy(&vec![Complex64::ONE; rows.len()]));
        let SmoothMap { pixel_jy, report } = patch.smooth_map(&image, &beam).unwrap();
        let count = inside.len();
        let r = report.pixel_sigma_jy.powi(-2);
        let matrix = faer::Mat::<f64>::from_fn(count, count, |i, j| {
            let term = |row: &Row| row.weight * (b(row, inside[i]).conj() * b(row, inside[j])).re;
            rows.iter().map(term).sum::<f64>() + if i == j { r } else { 0.0 }
        });
        let right = faer::Mat::<f64>::from_fn(count, 1, |i, _| {
            let term = |(row, v): (&Row, &Complex64)| row.weight * (b(row, inside[i]).conj() * v).re;
            rows.iter().zip(&data).map(term).sum::<f64>()
        });
        let exact = matrix.partial_piv_lu().solve(&right);
        let found = faer::Mat::<f64>::from_fn(count, 1, |i, _| pixel_jy[inside[i]]);
        let energy = |x: &faer::Mat<f64>| (x.transpose() * &matrix * x)[(0, 0)];
        let error = (energy(&(&found - &exact)) / energy(&exact)).sqrt();
        // In the norm of the matrix the error is the residual, 1e-4, as far as the preconditioner is the inverse: within a factor of twenty in so
        // small a patch.
        assert!(error < 2e-3 && report.residual <= 1e-4, "{error} {report:?}");
        // The variance of the pixels is 1 / 12. In a patch of a few beams the edge cuts much of the beam off, which makes it too small.
        assert!((report.pixel_sigma_jy * 12.0_f64.sqrt() - 1.0).abs() < 0.4, "{report:?}");
        // Without a sky there is nothing to map.
        assert_eq!(patch.smooth_map(&vec![0.0; grid.len()], &beam), None);
    }
}
