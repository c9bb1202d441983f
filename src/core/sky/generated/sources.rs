//! Point sources drawn from the GLEAM counts.

use std::f64::consts::PI;

use rand::RngExt;
use rand_distr::{Distribution, Poisson};

use crate::units::constants::{BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S};
use crate::units::vector::Vec3;
use crate::units::{StreamKind, random_stream};

use super::GeneratedSky;

/// Coefficients of log10(S^2.5 dN/dS) in powers of log10 S, S in Jy, dN/dS in Jy^-1 sr^-1, at
/// [`COUNTS_HZ`] (Franzen et al. 2019).
const COUNTS: [f64; 6] = [3.52, 0.307, -0.388, -0.0404, 0.0351, 0.006_00];
/// Frequency of the counts, Hz.
pub(super) const COUNTS_HZ: f64 = 154e6;
/// One jansky, W m^-2 Hz^-1.
const JANSKY: f64 = 1e-26;
/// Number of intervals of the tabulated integral of the counts, uniform in log S.
const INTERVALS: usize = 4096;

/// Differential source counts dN/dS at 154 MHz, Jy^-1 sr^-1.
pub(super) fn differential_counts(flux_jy: f64) -> f64 {
    let x = flux_jy.log10();
    let log = COUNTS.iter().rev().fold(0.0, |sum, a| sum * x + a);
    10.0_f64.powf(log - 2.5 * x)
}

struct Counts {
    /// ln S at the first node.
    first: f64,
    step: f64,
    /// Number of sources per sr fainter than each node.
    below: Vec<f64>,
    /// Total flux of all sources, Jy/sr.
    flux_jy_sr: f64,
}

impl Counts {
    fn new(flux_jy_min: f64, flux_jy_max: f64) -> Self {
        let first = flux_jy_min.ln();
        let step = (flux_jy_max.ln() - first) / INTERVALS as f64;
        let mut below = vec![0.0; INTERVALS + 1];
        let mut flux_jy_sr = 0.0;
        for k in 0..INTERVALS {
            // Midpoint rule in ln S: dN = S dN/dS dlnS.
            let flux = (first + (k as f64 + 0.5) * step).exp();
            let number = flux * differential_counts(flux) * step;
            below[k + 1] = below[k] + number;
            flux_jy_sr += flux * number;
        }
        Self { first, step, below, flux_jy_sr }
    }

    /// Flux below which a fraction `u` of the sources lies, Jy.
    fn flux_jy(&self, u: f64) -> f64 {
        let target = u * self.below[INTERVALS];
        let node = self.below.partition_point(|&n| n <= target).clamp(1, INTERVALS);
        let (low, high) = (self.below[node - 1], self.below[node]);
        let inside = if high > low { (target - low) / (high - low) } else { 0.0 };
        (self.first + ((node - 1) as f64 + inside) * self.step).exp()
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PointSource {
    pub direction: Vec3,
    /// Flux at 154 MHz, Jy.
    pub flux_jy: f64,
}

/// Draws the sources of a sky: a Poisson number, uniform on the sphere.
pub(super) fn draw(config: &GeneratedSky, seed: u64) -> Vec<PointSource> {
    let counts = Counts::new(config.source_flux_jy_min, config.source_flux_jy_max);
    let mut stream = random_stream(seed, StreamKind::SkySources, [0, 0]);
    let mean = 4.0 * PI * counts.below[INTERVALS];
    let number = Poisson::new(mean).map_or(0.0, |poisson| poisson.sample(&mut stream)) as usize;
    (0..number)
        .map(|_| {
            let z = 2.0 * stream.random::<f64>() - 1.0;
            let (sin, cos) = (2.0 * PI * stream.random::<f64>()).sin_cos();
            let across = ((1.0 - z) * (1.0 + z)).sqrt();
            let flux_jy = counts.flux_jy(stream.random());
            PointSource { direction: [across * cos, across * sin, z], flux_jy }
        })
        .collect()
}

/// Catalogue entry of a point source of a generated sky.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CatalogueSource {
    /// Ecliptic longitude and latitude, degrees.
    pub place_deg: [f64; 2],
    /// Flux density at 154 MHz, Jy.
    pub flux_154mhz_jy: f64,
    /// Flux density at the requested frequency, Jy, before absorption by Galactic gas.
    pub flux_jy: f64,
}

/// Lists the point sources of a generated sky at `frequency_hz`, brightest first; none without `config.point_sources`.
#[must_use]
pub fn catalogue(config: &GeneratedSky, frequency_hz: f64, seed: u64) -> Vec<CatalogueSource> {
    if !config.point_sources {
        return Vec::new();
    }
    let factor = (frequency_hz / COUNTS_HZ).powf(config.source_spectral_index);
    let entry = |source: PointSource| {
        let [x, y, z] = source.direction;
        CatalogueSource {
            place_deg: [y.atan2(x).to_degrees().rem_euclid(360.0), z.clamp(-1.0, 1.0).asin().to_degrees()],
            flux_154mhz_jy: source.flux_jy,
            flux_jy: factor * source.flux_jy,
        }
    };
    let mut sources: Vec<CatalogueSource> = draw(config, seed).into_iter().map(entry).collect();
    sources.sort_by(|a, b| b.flux_jy.total_cmp(&a.flux_jy));
    sources
}

/// Mean temperature that the sources add to the sky at `frequency_hz`, K.
pub(super) fn mean_k(config: &GeneratedSky, frequency_hz: f64) -> f64 {
    let counts = Counts::new(config.source_flux_jy_min, config.source_flux_jy_max);
    counts.flux_jy_sr * kelvin_sr_per_jansky(config, frequency_hz)
}

/// Temperature times solid angle at `frequency_hz`, K sr, of a source with 1 Jy at 154 MHz:
/// S = 2 k T nu^2 / c^2 dOmega.
pub(super) fn kelvin_sr_per_jansky(config: &GeneratedSky, frequency_hz: f64) -> f64 {
    let wavelength = SPEED_OF_LIGHT_M_S / frequency_hz;
    let flux = JANSKY * (frequency_hz / COUNTS_HZ).powf(config.source_spectral_index);
    flux * wavelength * wavelength / (2.0 * BOLTZMANN_J_K)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_number_of_sources_is_the_integral_of_the_counts() {
        let config = GeneratedSky::default();
        // Simpson's rule for S dN/dS in ln S, on independent nodes.
        let integral = |low: f64, high: f64| {
            let (intervals, a) = (1000, low.ln());
            let h = (high.ln() - a) / f64::from(intervals);
            let f = |k: i32| {
                let s = (a + f64::from(k) * h).exp();
                s * differential_counts(s)
            };
            let inner: f64 = (1..intervals).map(|k| f(k) * if k % 2 == 1 { 4.0 } else { 2.0 }).sum();
            4.0 * PI * h / 3.0 * (f(0) + inner + f(intervals))
        };
        let runs = 20;
        for (low, high) in [(4.36, 75.0), (4.36, 6.0), (10.0, 75.0)] {
            let counted: usize = (0..runs)
                .map(|seed| {
                    draw(&config, seed).iter().filter(|s| s.flux_jy >= low && s.flux_jy < high).count()
                })
                .sum();
            let expected = runs as f64 * integral(low, high);
            // Five standard deviations of a Poisson number.
            assert!((counted as f64 - expected).abs() < 5.0 * expected.sqrt(), "{counted} {expected}");
        }
    }

    #[test]
    fn a_catalogue_is_what_is_drawn() {
        let config = GeneratedSky::default();
        let (found, drawn) = (catalogue(&config, 77e6, 5), draw(&config, 5));
        assert_eq!(found.len(), drawn.len());
        assert!(found.windows(2).all(|two| two[0].flux_jy >= two[1].flux_jy));
        for source in &found {
            // The ratio for half the frequency and a spectral index of -0.8.
            assert!((source.flux_jy / source.flux_154mhz_jy - 2f64.powf(0.8)).abs() < 1e-12);
            let [(sin_l, cos_l), (sin_b, cos_b)] = source.place_deg.map(|deg| deg.to_radians().sin_cos());
            let n = [cos_l * cos_b, sin_l * cos_b, sin_b];
            let same = |one: &&PointSource| one.flux_jy == source.flux_154mhz_jy;
            let one = drawn.iter().find(same).unwrap();
            assert!(one.direction.iter().zip(n).all(|(a, b)| (a - b).abs() < 1e-12));
        }
        assert!(catalogue(&GeneratedSky { point_sources: false, ..config }, 77e6, 5).is_empty());
    }

    #[test]
    fn counts_at_one_jansky_are_the_leading_coefficient() {
        assert!((differential_counts(1.0) - 10f64.powf(3.52)).abs() < 1e-9);
    }

    #[test]
    fn sources_lie_everywhere() {
        let sources = draw(&GeneratedSky::default(), 3);
        let n = sources.len() as f64;
        for axis in 0..3 {
            let mean = sources.iter().map(|s| s.direction[axis]).sum::<f64>() / n;
            // Each coordinate of a uniform direction has variance 1/3; five standard deviations.
            assert!(mean.abs() < 5.0 / (3.0 * n).sqrt(), "axis {axis}: {mean}");
        }
    }
}
