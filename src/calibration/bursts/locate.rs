//! The position of a point source, by maximum likelihood over pairs.
//!
//! The model of a visibility is P_b exp(-2 pi i u . n), with a positive power for each bin of time, or 0 where the Moon hides n from a
//! daughter. The rest is noise: thermal, and of the steady sky. With the best powers, twice the logarithm of the likelihood over that of no
//! source is `sum over b of 2 C^2 / I`, C the real part of the sum of V exp(2 pi i u . n) over variances, I the sum of inverse variances.
//!
//! Baselines reach from some wavelengths to thousands, so the peak is a small part of the sky: the search begins on a HEALPix grid with
//! the short baselines, and refines the best directions with longer and longer ones.

use std::f64::consts::TAU;

use num_complex::Complex64;
use rayon::prelude::*;

use crate::array::hidden_by_moon;
use crate::response::pixel::PairGeometry;
use crate::sky::healpix::pixel_directions;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub, unit};

/// nside of the first grid: pixels of 1.8 deg, a quarter of a fringe of the longest baselines used.
const NSIDE: usize = 32;

/// Longest baseline of the first grid, wavelengths. If fewer samples than [`SAMPLES_MIN`] are that short, the shortest that suffice.
const FIRST_WAVELENGTHS: f64 = 8.0;

const SAMPLES_MIN: usize = 12;

/// Factor by which each refinement narrows the grid, and lengthens the baselines.
const NARROWING: f64 = 2.0;

/// Least distance of directions that are refined apart, in fringes of the longest baseline.
const QUARTER: f64 = 0.25;

/// Distance from the Sun within which its bursts at these frequencies arise and are scattered, rad: two degrees.
const SUN_RAD: f64 = 0.035;

/// Steps of a refinement to either side of a direction.
const STEPS: i32 = 3;

/// Directions that each refinement keeps.
const KEPT: usize = 24;

/// Directions of equal likelihood that are reported.
const REPORTED_MAX: usize = 4;

/// Twice the logarithm of a likelihood within which 99 % of positions, of two parameters, lie.
const WITHIN: f64 = 9.21;

/// A visibility for the search.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    pub(super) geometry: PairGeometry,
    pub(super) value_k_sr: Complex64,
    /// Inverse variance of the visibility, real and imaginary part together.
    pub(super) information: f64,
}

/// A located source.
#[derive(Clone, Debug)]
pub(super) struct Located {
    /// The likeliest direction first.
    pub(super) directions: Vec<Vec3>,
    /// Standard deviation of the first direction along its worst axis, rad.
    pub(super) sigma_rad: f64,
    pub(super) significance: f64,
    /// Power in the first bin, and its standard deviation, K sr.
    pub(super) power_k_sr: f64,
    pub(super) power_sigma_k_sr: f64,
    pub(super) is_sun: bool,
}

/// Samples of a bin with their baselines in wavelengths.
struct Search<'a> {
    bins: Vec<Vec<(&'a Sample, Vec3, f64)>>,
    moon_radius_m: f64,
}

/// Finds the direction of a source, whose power may differ from bin to bin; the first bin is the brightest. `None` without samples.
pub(super) fn locate(bins: &[Vec<Sample>], moon_radius_m: f64, sun_hat: Vec3) -> Option<Located> {
    let with_baseline = |sample| {
        let u = Sample::baseline(sample);
        (sample, u, norm(u))
    };
    let bins = bins.iter().map(|bin| bin.iter().map(with_baseline).collect()).collect();
    let search = Search { bins, moon_radius_m };
    let mut lengths: Vec<f64> = search.bins.iter().flatten().map(|(_, _, length)| *length).collect();
    lengths.sort_by(f64::total_cmp);
    let longest = *lengths.last()?;
    let mut reach = FIRST_WAVELENGTHS.max(lengths[(SAMPLES_MIN - 1).min(lengths.len() - 1)]);
    let grid: Vec<Vec3> = pixel_directions(NSIDE);
    // A grid of pixels of 0.03 rad serves baselines of 8 wavelengths.
    let mut step_rad = 0.25 / FIRST_WAVELENGTHS;
    let mut best = search.best(grid, reach, step_rad.max(QUARTER / longest));
    loop {
        step_rad /= NARROWING;
        reach *= NARROWING;
        let refined = best.iter().flat_map(|(_, hat)| around(*hat, step_rad)).collect();
        best = search.best(refined, reach, step_rad.max(QUARTER / longest));
        let (largest, _) = *best.first()?;
        if reach >= longest && step_rad < 0.1 / (TAU * longest.max(1.0) * largest.max(1.0).sqrt()) {
            break;
        }
    }
    let (largest, first) = *best.first()?;
    let sigma_rad = search.information(first, longest).sqrt().recip();
    let [power_k_sr, power_sigma_k_sr] = search.power(first);
    let mut directions: Vec<Vec3> = Vec::new();
    let apart = |a: Vec3, b: Vec3| norm(sub(a, b));
    for (_, hat) in best.into_iter().filter(|(twice, _)| largest - twice < WITHIN).take(KEPT) {
        let is_other = directions.iter().all(|other| apart(*other, hat) > 5.0 * sigma_rad + 1.0 / longest);
        if is_other && directions.len() < REPORTED_MAX {
            directions.push(hat);
        }
    }
    let sun_rad = SUN_RAD + WITHIN.sqrt() * sigma_rad;
    let is_sun = directions.iter().any(|hat| apart(*hat, sun_hat) < sun_rad);
    let significance = largest.max(0.0).sqrt();
    Some(Located { directions, sigma_rad, significance, power_k_sr, power_sigma_k_sr, is_sun })
}

impl Sample {
    fn baseline(&self) -> Vec3 {
        self.geometry.baseline_wavelengths()
    }
}

impl Search<'_> {
    /// Sums of a bin in a direction, over baselines of at most `reach` wavelengths: C and I.
    fn sums(&self, bin: usize, n_hat: Vec3, reach: f64) -> [f64; 2] {
        let mut sums = [0.0; 2];
        for (sample, u, length) in &self.bins[bin] {
            let Sample { geometry, value_k_sr, information } = sample;
            let is_hidden = |r_m| hidden_by_moon(r_m, n_hat, self.moon_radius_m);
            if *length > reach || is_hidden(geometry.r_i_m) || is_hidden(geometry.r_j_m) {
                continue;
            }
            let turns = dot(*u, n_hat);
            let (sin, cos) = (TAU * (turns - turns.round())).sin_cos();
            sums[0] += information * (value_k_sr.re * cos - value_k_sr.im * sin);
            sums[1] += information;
        }
        sums
    }

    /// Twice the logarithm of the likelihood ratio.
    fn twice_log(&self, n_hat: Vec3, reach: f64) -> f64 {
        let of_bin = |bin| match self.sums(bin, n_hat, reach) {
            [c, i] if c > 0.0 && i > 0.0 => 2.0 * c * c / i,
            _ => 0.0,
        };
        (0..self.bins.len()).map(of_bin).sum()
    }

    /// The best directions of a grid, each some steps from better ones, with their likelihoods.
    fn best(&self, grid: Vec<Vec3>, reach: f64, apart_rad: f64) -> Vec<(f64, Vec3)> {
        let mut all: Vec<(f64, Vec3)> =
            grid.into_par_iter().map(|hat| (self.twice_log(hat, reach), hat)).collect();
        all.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut kept: Vec<(f64, Vec3)> = Vec::new();
        let apart = (2.5 * apart_rad).cos();
        for (twice, hat) in all {
            if kept.len() == KEPT {
                break;
            }
            if kept.iter().all(|(_, other)| dot(hat, *other) < apart) {
                kept.push((twice, hat));
            }
        }
        kept
    }

    /// Power of the first bin in a direction and its standard deviation, K sr.
    fn power(&self, n_hat: Vec3) -> [f64; 2] {
        let [c, i] = self.sums(0, n_hat, f64::INFINITY);
        [c / i, (2.0 * i).sqrt().recip()]
    }

    /// Least information on the direction along any axis across it, rad^-2: from the curvature of the likelihood.
    fn information(&self, n_hat: Vec3, longest: f64) -> f64 {
        let [a, b] = axes(n_hat);
        // A tenth of a radian of phase on the longest baseline.
        let h = 0.1 / (TAU * longest.max(1.0));
        let at = |x: f64, y: f64| {
            let hat = unit(add(n_hat, add(scale(x * h, a), scale(y * h, b))));
            0.5 * self.twice_log(hat, f64::INFINITY) / (h * h)
        };
        let middle = at(0.0, 0.0);
        let xx = 2.0 * middle - at(1.0, 0.0) - at(-1.0, 0.0);
        let yy = 2.0 * middle - at(0.0, 1.0) - at(0.0, -1.0);
        let xy = -0.25 * (at(1.0, 1.0) + at(-1.0, -1.0) - at(1.0, -1.0) - at(-1.0, 1.0));
        // The smaller eigenvalue. Rounding may make it negative where daughters lie in a line; then a radian is not resolved.
        (0.5 * (xx + yy) - (0.25 * (xx - yy).powi(2) + xy * xy).sqrt()).max(1.0)
    }
}

/// Two unit vectors across a direction and each other.
fn axes(n_hat: Vec3) -> [Vec3; 2] {
    let across = if n_hat[2].abs() < 0.9 { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] };
    let a = unit(cross(n_hat, across));
    [a, cross(n_hat, a)]
}

/// A square grid of directions about one.
fn around(n_hat: Vec3, step_rad: f64) -> Vec<Vec3> {
    let [a, b] = axes(n_hat);
    let at = |x: i32, y: i32| {
        unit(add(n_hat, add(scale(step_rad * f64::from(x), a), scale(step_rad * f64::from(y), b))))
    };
    (-STEPS..=STEPS).flat_map(|x| (-STEPS..=STEPS).map(move |y| (x, y))).map(|(x, y)| at(x, y)).collect()
}
