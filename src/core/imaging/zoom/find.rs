//! Finds the sources of a patch: a positive, sparse solution without pixels.
//!
//! Sources are added where the dirty image of the residual is highest, then fluxes and places of all are fitted to the visibilities, and the
//! residual is made anew by direct sums (the sliding Frank-Wolfe algorithm: Denoyelle, Duval, Peyre & Soubies 2019). Nothing is rounded
//! to pixels, and no beam is approximated.

use std::f64::consts::{LN_2, PI};

use num_complex::Complex64;
use rayon::prelude::*;
use serde::Serialize;

use super::averaging::Row;
use super::points::{PointFit, PointSource, RowSums, subtract};
use super::transform::{PatchTransform, PixelGrid};
use crate::numerics::{SIGMA_OF_MEDIAN, median};

/// Sources must exceed the noise at least by this factor.
const THRESHOLD_MIN: f64 = 5.0;
/// Expected number of peaks of the noise in a patch that are taken for sources.
const FALSE_SOURCES_MAX: f64 = 0.05;
/// In one cycle only peaks are taken that are at least this part of the highest, as others may be its side lobes.
const PART_OF_HIGHEST: f64 = 0.25;
/// Maximum cycles, sources added in one, and sources.
const CYCLES_MAX: usize = 30;
const ADDED_MAX: usize = 50;
const SOURCES_MAX: usize = 1000;
/// Steps of the fit in a cycle.
const STEPS: usize = 2;
/// Sources nearer to each other than this, in beams, are one.
const APART_BEAMS: f64 = 0.6;

/// The sources of a patch, and what is left.
#[derive(Clone, Debug)]
pub struct FoundSources {
    /// Sources, the brightest first.
    pub sources: Vec<PointSource>,
    /// Image of the residuals, Jy per beam.
    pub image_jy: Vec<f64>,
    /// Noise of the residual image, Jy per beam.
    pub noise: ImageNoise,
    /// Factor by which sources exceed the noise at least.
    pub threshold: f64,
    /// Expected number of sources that are noise.
    pub false_sources: f64,
    /// Cycles.
    pub cycles: usize,
}

/// Noise of an image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ImageNoise {
    /// By the weights of the visibilities, Jy per beam.
    pub thermal_jy: f64,
    /// Of the image's pixels, by the median of their moduli, Jy per beam.
    pub measured_jy: f64,
}

impl ImageNoise {
    /// The greater of the two.
    #[must_use]
    pub fn sigma_jy(&self) -> f64 {
        self.thermal_jy.max(self.measured_jy)
    }
}

/// The rows of a patch, with all that images of them need.
pub struct PatchData<'a> {
    /// Rows.
    pub rows: &'a [Row],
    /// Their sums.
    pub sums: RowSums,
    /// Transforms.
    pub transform: &'a PatchTransform,
    /// Full width of the beam at half maximum, in direction cosines.
    pub beam: f64,
}

impl PatchData<'_> {
    /// Factor by which sources must exceed the noise.
    #[must_use]
    pub fn threshold(&self) -> f64 {
        let beyond = (0..).map(|k| THRESHOLD_MIN + 0.05 * f64::from(k));
        beyond.into_iter().find(|&t| self.false_sources(t) <= FALSE_SOURCES_MAX).unwrap_or(THRESHOLD_MIN)
    }

    /// Expected number of peaks of Gaussian noise above a threshold: by the Euler characteristic of a field as smooth as the beam
    /// (Worsley et al. 1992).
    #[must_use]
    pub fn false_sources(&self, threshold: f64) -> f64 {
        let beams = PI * (self.transform.grid().reach / self.beam).powi(2);
        beams * 4.0 * LN_2 * (2.0 * PI).powf(-1.5) * threshold * (-0.5 * threshold * threshold).exp()
    }

    /// The dirty image of values of the rows: Jy per beam.
    #[must_use]
    pub fn image_jy(&self, values: &[Complex64]) -> Vec<f64> {
        let weighted: Vec<Complex64> =
            values.iter().zip(self.rows).map(|(value, row)| row.weight * value).collect();
        let mut image = self.transform.adjoint(&weighted);
        image.par_iter_mut().for_each(|value| *value /= self.sums.weight);
        image
    }

    /// Finds the sources.
    #[must_use]
    pub fn find(&self) -> FoundSources {
        let data: Vec<Complex64> = self.rows.iter().map(|row| row.value).collect();
        let fit = PointFit { rows: self.rows, sums: &self.sums, beam: self.beam };
        let residuals_of = |sources: &[PointSource]| {
            let mut residuals = data.clone();
            subtract(self.rows, sources, &mut residuals);
            residuals
        };
        let mut sources: Vec<PointSource> = Vec::new();
        let (mut cycles, mut is_final) = (0, false);
        loop {
            let residuals = residuals_of(&sources);
            let image_jy = self.image_jy(&residuals);
            let noise = self.noise(&image_jy);
            let is_last = is_final || cycles == CYCLES_MAX || sources.len() >= SOURCES_MAX;
            let added = if is_last { Vec::new() } else { self.peaks(&image_jy, &noise, &sources) };
            if added.is_empty() {
                let before = sources.len();
                sources.retain(|source| source.flux_jy >= self.threshold() * noise.sigma_jy());
                if is_final && sources.len() == before {
                    sources.sort_by(|a, b| b.flux_jy.total_cmp(&a.flux_jy));
                    let threshold = self.threshold();
                    let false_sources = self.false_sources(threshold);
                    return FoundSources { sources, image_jy, noise, threshold, false_sources, cycles };
                }
                // What the weak ones had goes to the others.
                is_final = true;
            } else {
                cycles += 1;
                sources.extend(added);
            }
            for _ in 0..STEPS {
                let residuals = residuals_of(&sources);
                fit.step(&mut sources, &residuals);
            }
            self.prune(&mut sources);
        }
    }

    /// Noise by the weights, and by the pixels.
    fn noise(&self, image_jy: &[f64]) -> ImageNoise {
        let grid = self.transform.grid();
        let inside = (0..grid.len()).filter(|&k| grid.is_inside(k)).map(|k| image_jy[k].abs());
        let measured_jy = median(inside.collect()).map_or(0.0, |median| SIGMA_OF_MEDIAN * median);
        ImageNoise { thermal_jy: self.sums.sigma_jy(), measured_jy }
    }

    /// The highest peaks of an image, none close to a source or to a higher one.
    fn peaks(&self, image_jy: &[f64], noise: &ImageNoise, known: &[PointSource]) -> Vec<PointSource> {
        let grid = self.transform.grid();
        let highest = image_jy.iter().copied().fold(0.0, f64::max);
        let least = (self.threshold() * noise.sigma_jy()).max(PART_OF_HIGHEST * highest);
        let mut peaks: Vec<PointSource> = (0..grid.len())
            .filter(|&k| image_jy[k] >= least)
            .filter_map(|k| peak_at(grid, image_jy, k))
            .collect();
        peaks.sort_by(|a, b| b.flux_jy.total_cmp(&a.flux_jy));
        let mut added: Vec<PointSource> = Vec::new();
        for peak in peaks {
            let is_near = |other: &PointSource| distance(&peak, other) < APART_BEAMS * self.beam;
            if added.len() < ADDED_MAX && !added.iter().chain(known).any(is_near) {
                added.push(peak);
            }
        }
        added
    }

    /// Removes sources that became negative, or left the patch; the fainter of two that met adds its flux to the other.
    fn prune(&self, sources: &mut Vec<PointSource>) {
        let reach = self.transform.grid().reach;
        sources.retain(|source| source.flux_jy > 0.0 && source.place[0].hypot(source.place[1]) <= reach);
        sources.sort_by(|a, b| b.flux_jy.total_cmp(&a.flux_jy));
        let mut kept: Vec<PointSource> = Vec::new();
        for source in sources.drain(..) {
            let met = kept.iter_mut().find(|one| distance(one, &source) < 0.5 * APART_BEAMS * self.beam);
            match met {
                Some(one) => one.flux_jy += source.flux_jy,
                None => kept.push(source),
            }
        }
        *sources = kept;
    }
}

fn distance(a: &PointSource, b: &PointSource) -> f64 {
    (a.place[0] - b.place[0]).hypot(a.place[1] - b.place[1])
}

/// A peak at a pixel that is higher than its neighbours, between pixels by a parabola along each axis.
fn peak_at(grid: &PixelGrid, image_jy: &[f64], index: usize) -> Option<PointSource> {
    let (column, row) = (index / grid.side, index % grid.side);
    if column == 0 || row == 0 || column + 1 == grid.side || row + 1 == grid.side || !grid.is_inside(index) {
        return None;
    }
    let value = image_jy[index];
    let neighbours = [index - grid.side, index + grid.side, index - 1, index + 1];
    if neighbours.iter().any(|&k| image_jy[k] > value) {
        return None;
    }
    let vertex = |below: f64, above: f64| {
        let bend = below + above - 2.0 * value;
        if bend < 0.0 { (0.5 * (below - above) / bend).clamp(-0.5, 0.5) } else { 0.0 }
    };
    let [l, m] = grid.place(index);
    // l falls with the column.
    let [x, y] = [
        vertex(image_jy[index - grid.side], image_jy[index + grid.side]),
        vertex(image_jy[index - 1], image_jy[index + 1]),
    ];
    Some(PointSource { place: [l - x * grid.step, m + y * grid.step], flux_jy: value })
}
