//! The beam of a patch's image: its width, and a Gaussian of that width.

use std::f64::consts::{LN_2, PI};

use rayon::prelude::*;
use serde::Serialize;

use super::averaging::Row;
use super::points::{PointSource, RowSums};
use super::transform::PixelGrid;
use crate::numerics::trigonometry::sin_cos;

/// Directions in which the beam is followed to its half.
const RAYS: usize = 16;
/// Samples along a ray, to twice the width by the mean square of the baselines.
const SAMPLES: usize = 48;

/// An ellipse at half the beam's maximum.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ZoomBeam {
    /// Full width at half maximum along the longer axis, arcmin.
    pub fwhm_major_arcmin: f64,
    /// Full width at half maximum along the shorter axis, arcmin.
    pub fwhm_minor_arcmin: f64,
    /// Position angle of the longer axis, from north towards east, degrees.
    pub angle_deg: f64,
}

impl ZoomBeam {
    /// The beam at the patch's centre, by direct sums over rows; `None` if it has no width.
    #[must_use]
    pub fn measure(rows: &[Row], sums: &RowSums) -> Option<Self> {
        // A Gaussian beam of these baselines would have this width.
        let mean_square = 0.5 * (sums.squares[0][0] + sums.squares[1][1]) / sums.weight;
        let scale = (2.0 * LN_2).sqrt() / (PI * mean_square.sqrt());
        if !scale.is_finite() {
            return None;
        }
        let points: Vec<[f64; 2]> = (0..RAYS)
            .into_par_iter()
            .filter_map(|ray| {
                let (sin, cos) = (PI * ray as f64 / RAYS as f64).sin_cos();
                let at = |k: usize| 2.0 * scale * k as f64 / SAMPLES as f64;
                let values: Vec<f64> =
                    (0..=SAMPLES).map(|k| beam_at(rows, [at(k) * cos, at(k) * sin]) / sums.weight).collect();
                let k = values.iter().position(|value| *value < 0.5)?;
                let part = (values[k - 1] - 0.5) / (values[k - 1] - values[k]);
                let length = at(k - 1) + part * (at(k) - at(k - 1));
                Some([length * cos, length * sin])
            })
            .collect();
        Self::through(&points)
    }

    /// The ellipse through points, by least squares of its quadratic form.
    fn through(points: &[[f64; 2]]) -> Option<Self> {
        let terms = |[x, y]: [f64; 2]| [x * x, 2.0 * x * y, y * y];
        let mut normal = faer::Mat::<f64>::zeros(3, 3);
        let mut right = faer::Mat::<f64>::zeros(3, 1);
        // In units of the mean distance, so that all terms are about 1.
        let unit = points.iter().map(|p| p[0].hypot(p[1])).sum::<f64>() / points.len() as f64;
        for point in points {
            let row = terms(point.map(|x| x / unit));
            for a in 0..3 {
                (0..3).for_each(|b| normal[(a, b)] += row[a] * row[b]);
                right[(a, 0)] += row[a];
            }
        }
        use faer::linalg::solvers::Solve;
        let form = normal.partial_piv_lu().solve(&right);
        let (a, b, c) = (form[(0, 0)], form[(1, 0)], form[(2, 0)]);
        let (middle, half) = (0.5 * (a + c), (0.5 * (a - c)).hypot(b));
        let width = |value: f64| 2.0 * unit / value.sqrt();
        let (major, minor) = (width(middle - half), width(middle + half));
        // The longer axis is where the form is least; x is east, y north.
        let along_x = 0.5 * (-2.0 * b).atan2(c - a);
        let mut angle = 90.0 - along_x.to_degrees();
        if angle > 90.0 {
            angle -= 180.0;
        }
        let arcmin = |rad: f64| 60.0 * rad.to_degrees();
        (major.is_finite() && minor > 0.0).then(|| Self {
            fwhm_major_arcmin: arcmin(major),
            fwhm_minor_arcmin: arcmin(minor),
            angle_deg: angle,
        })
    }

    /// Full width at half maximum of a circular beam of the same area, rad.
    #[must_use]
    pub fn fwhm_rad(&self) -> f64 {
        (self.fwhm_major_arcmin * self.fwhm_minor_arcmin).sqrt().to_radians() / 60.0
    }

    /// Adds Gaussian sources of this beam, with their fluxes at their maxima, to an image.
    pub fn add_to(&self, grid: &PixelGrid, sources: &[PointSource], image_jy: &mut [f64]) {
        let rad = |arcmin: f64| arcmin.to_radians() / 60.0;
        let (major, minor) = (rad(self.fwhm_major_arcmin), rad(self.fwhm_minor_arcmin));
        let (sin, cos) = self.angle_deg.to_radians().sin_cos();
        let reach = (3.0 * major / grid.step).ceil() as i64;
        let middle = (grid.side / 2) as i64;
        for PointSource { place: [l, m], flux_jy } in sources {
            let [column, row] = [-l, *m].map(|x| (x / grid.step).round() as i64 + middle);
            for column in (column - reach).max(0)..=(column + reach).min(grid.side as i64 - 1) {
                for row in (row - reach).max(0)..=(row + reach).min(grid.side as i64 - 1) {
                    let index = column as usize * grid.side + row as usize;
                    let [x, y] = grid.place(index);
                    let (east, north) = (x - l, y - m);
                    let (along, across) = (north * cos + east * sin, east * cos - north * sin);
                    let square = (along / major).powi(2) + (across / minor).powi(2);
                    image_jy[index] += flux_jy * (-4.0 * LN_2 * square).exp();
                }
            }
        }
    }
}

/// The sum of weights times the beam's cosine at direction cosines l and m.
fn beam_at(rows: &[Row], [l, m]: [f64; 2]) -> f64 {
    let depth = (1.0 - l * l - m * m).sqrt() - 1.0;
    let term = |row: &Row| {
        let (_, cos) = sin_cos(std::f64::consts::TAU * (row.u[0] * l + row.u[1] * m + row.u[2] * depth));
        row.weight * cos
    };
    rows.iter().map(term).sum()
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;

    #[test]
    fn widths_are_those_of_gaussian_baselines() {
        // Weights exp(-u.C u / 2) on a grid of baselines: a Gaussian beam with standard deviations 1 / (2 pi sigma).
        let (wide, narrow, angle) = (400.0_f64, 150.0_f64, 35.0_f64.to_radians());
        let rows: Vec<Row> = (0..101 * 101)
            .map(|k| {
                let at = |k: usize| (k as f64 - 50.0) / 12.0;
                let (a, b) = (at(k % 101), at(k / 101));
                // `narrow` along the axis at the angle from north to east: there the beam is wide.
                let (north, east) = (
                    narrow * a * angle.cos() - wide * b * angle.sin(),
                    narrow * a * angle.sin() + wide * b * angle.cos(),
                );
                let weight = (-0.5 * (a * a + b * b)).exp();
                Row { u: [east, north, 0.0], spread: [0.0; 3], value: Complex64::ZERO, weight }
            })
            .collect();
        let found = ZoomBeam::measure(&rows, &RowSums::new(&rows)).unwrap();
        let width = |sigma: f64| (8.0 * LN_2).sqrt() / (2.0 * PI * sigma) * 180.0 * 60.0 / PI;
        // Linear interpolation over a 24th of the width: 2e-3.
        assert!((found.fwhm_major_arcmin / width(narrow) - 1.0).abs() < 5e-3, "{found:?}");
        assert!((found.fwhm_minor_arcmin / width(wide) - 1.0).abs() < 5e-3, "{found:?}");
        assert!((found.angle_deg - 35.0).abs() < 0.5, "{found:?}");
    }
}
