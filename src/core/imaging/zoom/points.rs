//! Point sources at any place of a patch: their visibilities by direct sums, and fits of their fluxes and positions.

use std::f64::consts::TAU;

use multiversion::multiversion;
use num_complex::Complex64;
use rayon::prelude::*;

use super::averaging::Row;
use crate::imaging::solver::{StoppingRule, solve_one};
use crate::numerics::trigonometry::sin_cos;

/// Rows whose sums are made together; sums of such blocks are added in order, so that results do not depend on threads.
const BLOCK: usize = 2048;

/// When a step is good enough.
const STEP: StoppingRule = StoppingRule { residual_max: 1e-3, iterations_max: 12 };
/// Greatest motion of a position in one step, in beams.
const STEP_BEAMS: f64 = 0.5;

/// A point source in a patch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointSource {
    /// Direction cosines l and m.
    pub place: [f64; 2],
    /// Flux density, Jy.
    pub flux_jy: f64,
}

impl PointSource {
    /// `n - 1`.
    fn depth(&self) -> f64 {
        let [l, m] = self.place;
        (1.0 - l * l - m * m).max(0.0).sqrt() - 1.0
    }

    /// Derivatives of `n` with l and m.
    fn slopes(&self) -> [f64; 2] {
        let n = 1.0 + self.depth();
        self.place.map(|cosine| -cosine / n)
    }
}

/// Weighted sums of the rows from which errors and the beam's width follow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowSums {
    /// Sum of the weights, Jy^-2.
    pub weight: f64,
    /// Sums of the weights times products of two components of the baseline.
    pub squares: [[f64; 3]; 3],
}

impl RowSums {
    /// The sums of `rows`.
    #[must_use]
    pub fn new(rows: &[Row]) -> Self {
        let mut sums = Self { weight: 0.0, squares: [[0.0; 3]; 3] };
        for row in rows {
            sums.weight += row.weight;
            for (a, squares) in sums.squares.iter_mut().enumerate() {
                for (b, square) in squares.iter_mut().enumerate() {
                    *square += row.weight * row.u[a] * row.u[b];
                }
            }
        }
        sums
    }

    /// Standard deviation of the flux of a source alone, Jy.
    #[must_use]
    pub fn sigma_jy(&self) -> f64 {
        self.weight.sqrt().recip()
    }

    /// Information about l and m of a source of 1 Jy alone: the inverse of their covariance.
    fn of_place(&self, source: &PointSource) -> [[f64; 2]; 2] {
        let slopes = source.slopes();
        let axes: [[f64; 3]; 2] = [[1.0, 0.0, slopes[0]], [0.0, 1.0, slopes[1]]];
        let form = |a: [f64; 3], b: [f64; 3]| -> f64 {
            (0..9).map(|k| a[k / 3] * self.squares[k / 3][k % 3] * b[k % 3]).sum()
        };
        std::array::from_fn(|a| std::array::from_fn(|b| TAU * TAU * form(axes[a], axes[b])))
    }

    /// Covariance of l and m of a source alone.
    #[must_use]
    pub fn covariance(&self, source: &PointSource) -> [[f64; 2]; 2] {
        let square = source.flux_jy * source.flux_jy;
        inverse(self.of_place(source)).map(|row| row.map(|value| value / square))
    }
}

fn inverse([[a, b], [c, d]]: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
    let determinant = a * d - b * c;
    [[d / determinant, -b / determinant], [-c / determinant, a / determinant]]
}

/// Sources as arrays, for vectorised loops.
struct SourceArrays {
    l: Vec<f64>,
    m: Vec<f64>,
    depth: Vec<f64>,
}

impl SourceArrays {
    fn new(sources: &[PointSource]) -> Self {
        Self {
            l: sources.iter().map(|source| source.place[0]).collect(),
            m: sources.iter().map(|source| source.place[1]).collect(),
            depth: sources.iter().map(PointSource::depth).collect(),
        }
    }
}

/// Responses of a row to sources of 1 Jy.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2"))]
fn responses(row: &Row, sources: &SourceArrays, re: &mut [f64], im: &mut [f64]) {
    let ([u, v, w], [du, dv, dw]) = (row.u, row.spread);
    let places = sources.l.iter().zip(&sources.m).zip(&sources.depth);
    for (((l, m), depth), (re, im)) in places.zip(re.iter_mut().zip(im)) {
        let (sin, cos) = sin_cos(TAU * (u * l + v * m + w * depth));
        // The cosine to the fourth power of an angle below 0.23: to 2e-7.
        let square = (TAU * (du * l + dv * m + dw * depth)).powi(2);
        let smeared = 1.0 - square * (0.5 - square / 24.0);
        (*re, *im) = (smeared * cos, -smeared * sin);
    }
}

/// Subtracts the visibilities of sources from values of the rows.
pub fn subtract(rows: &[Row], sources: &[PointSource], values: &mut [Complex64]) {
    if sources.is_empty() {
        return;
    }
    let arrays = SourceArrays::new(sources);
    values.par_chunks_mut(BLOCK).zip(rows.par_chunks(BLOCK)).for_each(|(values, rows)| {
        let (mut re, mut im) = (vec![0.0; sources.len()], vec![0.0; sources.len()]);
        for (value, row) in values.iter_mut().zip(rows) {
            responses(row, &arrays, &mut re, &mut im);
            for ((re, im), source) in re.iter().zip(&im).zip(sources) {
                *value -= source.flux_jy * Complex64::new(*re, *im);
            }
        }
    });
}

/// Steps of Gauss and Newton for the fluxes and places of sources, whose normal equations are solved by conjugate gradients.
pub struct PointFit<'a> {
    /// Rows.
    pub rows: &'a [Row],
    /// Their sums.
    pub sums: &'a RowSums,
    /// Width of the beam, in direction cosines.
    pub beam: f64,
}

impl PointFit<'_> {
    /// Moves sources towards the least squares, given the residuals of the rows. Unknowns are flux, l and m of each.
    pub fn step(&self, sources: &mut [PointSource], residuals: &[Complex64]) {
        let blocks: Vec<[[f64; 2]; 2]> =
            sources.iter().map(|source| self.sums.covariance(&bounded(source, self.sums))).collect();
        let precondition = |r: &mut [f64]| {
            for (r, block) in r.chunks_exact_mut(3).zip(&blocks) {
                let [l, m] = [r[1], r[2]];
                r[0] /= self.sums.weight;
                r[1] = block[0][0] * l + block[0][1] * m;
                r[2] = block[1][0] * l + block[1][1] * m;
            }
        };
        let product = |x: &[f64]| self.normal_product(sources, Some(x), &[]);
        let right = self.normal_product(sources, None, residuals);
        let (change, _) = solve_one(&right, STEP, &product, &precondition);
        for (source, change) in sources.iter_mut().zip(change.chunks_exact(3)) {
            if change.iter().any(|value| !value.is_finite()) {
                continue;
            }
            source.flux_jy += change[0];
            let length = change[1].hypot(change[2]);
            let bound = (STEP_BEAMS * self.beam / length.max(f64::MIN_POSITIVE)).min(1.0);
            source.place[0] += bound * change[1];
            source.place[1] += bound * change[2];
        }
    }

    /// `J' W y`, J the derivatives of the visibilities with the unknowns, y either `J p` or values of the rows.
    fn normal_product(&self, sources: &[PointSource], p: Option<&[f64]>, values: &[Complex64]) -> Vec<f64> {
        let arrays = SourceArrays::new(sources);
        let slopes: Vec<[f64; 2]> = sources.iter().map(PointSource::slopes).collect();
        let fluxes: Vec<f64> = sources.iter().map(|source| bounded(source, self.sums).flux_jy).collect();
        let of_block = |(number, rows): (usize, &[Row])| {
            let mut sums = vec![0.0; 3 * sources.len()];
            let (mut re, mut im) = (vec![0.0; sources.len()], vec![0.0; sources.len()]);
            for (k, row) in rows.iter().enumerate() {
                responses(row, &arrays, &mut re, &mut im);
                // Derivatives of the phase with l and m, over -i, times the flux.
                let turn =
                    |s: usize, axis: usize| TAU * fluxes[s] * (row.u[axis] + row.u[2] * slopes[s][axis]);
                let y = match p {
                    None => values[number * BLOCK + k],
                    Some(p) => (0..sources.len())
                        .map(|s| {
                            let phase = turn(s, 0) * p[3 * s + 1] + turn(s, 1) * p[3 * s + 2];
                            Complex64::new(re[s], im[s]) * Complex64::new(p[3 * s], -phase)
                        })
                        .sum(),
                };
                let y = row.weight * y;
                for (s, sums) in sums.chunks_exact_mut(3).enumerate() {
                    // conj(a) y; conj(-i t a) y = i t conj(a) y.
                    let seen = Complex64::new(re[s], -im[s]) * y;
                    sums[0] += seen.re;
                    sums[1] -= turn(s, 0) * seen.im;
                    sums[2] -= turn(s, 1) * seen.im;
                }
            }
            sums
        };
        let blocks: Vec<Vec<f64>> = self.rows.par_chunks(BLOCK).enumerate().map(of_block).collect();
        let mut total = vec![0.0; 3 * sources.len()];
        for block in blocks {
            total.iter_mut().zip(block).for_each(|(total, sum)| *total += sum);
        }
        total
    }
}

/// A source with a flux of at least its error, so that its place stays determined.
fn bounded(source: &PointSource, sums: &RowSums) -> PointSource {
    PointSource { flux_jy: source.flux_jy.max(sums.sigma_jy()), ..*source }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::vector::dot;

    fn rows(count: usize) -> Vec<Row> {
        // Baselines of all lengths and directions, by irrational steps.
        let part = |k: usize, step: f64| (k as f64 * step).fract() * 2.0 - 1.0;
        let row = |k| Row {
            u: [600.0 * part(k, 0.618_034), 600.0 * part(k, 0.414_214), 600.0 * part(k, 0.732_051)],
            spread: [0.1, -0.2, 0.1],
            value: Complex64::ZERO,
            weight: 2.0,
        };
        (0..count).map(row).collect()
    }

    fn visibility(row: &Row, source: &PointSource) -> Complex64 {
        let [l, m] = source.place;
        let delta = [l, m, (1.0 - l * l - m * m).sqrt() - 1.0];
        let at = |sign: f64| Complex64::cis(-TAU * (dot(row.u, delta) + sign * dot(row.spread, delta)));
        0.5 * source.flux_jy * (at(1.0) + at(-1.0))
    }

    #[test]
    fn sources_are_subtracted_and_found_again_from_wrong_starts() {
        let truth = [
            PointSource { place: [0.03, -0.05], flux_jy: 7.0 },
            PointSource { place: [-0.081, 0.02], flux_jy: 2.0 },
            // A beam (1 / 1200) and a half beside the first.
            PointSource { place: [0.0312, -0.0495], flux_jy: 3.0 },
        ];
        let rows = rows(5000);
        let data: Vec<Complex64> =
            rows.iter().map(|row| truth.iter().map(|one| visibility(row, one)).sum()).collect();
        let mut rest = data.clone();
        subtract(&rows, &truth, &mut rest);
        // The series of the smearing is good to 2e-7 of 7 Jy.
        assert!(rest.iter().all(|value| value.norm() < 3e-6));
        let sums = RowSums::new(&rows);
        let fit = PointFit { rows: &rows, sums: &sums, beam: 8e-4 };
        let mut found = truth.map(|source| PointSource {
            place: [source.place[0] + 1e-4, source.place[1] - 1e-4],
            flux_jy: 0.8 * source.flux_jy,
        });
        for _ in 0..8 {
            let mut rest = data.clone();
            subtract(&rows, &found, &mut rest);
            fit.step(&mut found, &rest);
        }
        for (found, truth) in found.iter().zip(&truth) {
            // Without noise the series alone is left.
            assert!((found.flux_jy / truth.flux_jy - 1.0).abs() < 1e-5, "{found:?}");
            assert!((0..2).all(|k| (found.place[k] - truth.place[k]).abs() < 1e-8), "{found:?}");
        }
    }
}
