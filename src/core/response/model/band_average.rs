//! Visibilities averaged over the width of a channel.

use std::f64::consts::{E, PI};

use num_complex::Complex64;

use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel, predict_means};
use crate::numerics::quadrature::GaussLegendre;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, sub};

/// Maximum error of the average, relative to the power of the sky.
const TOLERANCE: f64 = 1e-6;

/// Averages a model over a channel in which the sky does not depend on frequency: this multiplies the integrand by
/// `sinc(pi n . r_ij dnu / c)`.
///
/// The average is a Gauss-Legendre sum over as many frequencies as the baseline needs: 2 at 1 km in 8 kHz, 12 at 100 km.
/// The baseline is scaled in place of the frequency ([`scaled_baseline`](crate::array::scaled_baseline)), which moves the
/// Moon's limb by half of the added length: 1e-5 rad for 100 km at 10 MHz.
pub struct BandAverage {
    model: Box<dyn VisibilityModel>,
    frequency_hz: f64,
    width_hz: f64,
}

impl BandAverage {
    /// Averages `model`, of frequency `frequency_hz`, over a channel of `width_hz`. The model must cover baselines longer by
    /// [`BandAverage::baseline_factor`].
    #[must_use]
    pub fn new(model: Box<dyn VisibilityModel>, frequency_hz: f64, width_hz: f64) -> Self {
        Self { model, frequency_hz, width_hz }
    }

    /// Ratio of baselines in wavelengths at the upper end and at the middle of a channel.
    #[must_use]
    pub fn baseline_factor(frequency_hz: f64, width_hz: f64) -> f64 {
        1.0 + 0.5 * width_hz / frequency_hz
    }

    /// Number of frequencies that a baseline needs. The error of K points is below `(e x / 4 K)^(2 K)` for a phase that
    /// goes from -x to x over the channel.
    #[must_use]
    pub fn frequency_count(baseline_m: f64, width_hz: f64) -> usize {
        let x = PI * baseline_m * width_hz / SPEED_OF_LIGHT_M_S;
        let is_enough = |&k: &usize| (E * x / (4 * k) as f64).powi(2 * k as i32) <= TOLERANCE;
        // The search ends for any baseline about the Moon, as the bound falls with K.
        (1..).find(is_enough).unwrap_or(1)
    }
}

impl VisibilityModel for BandAverage {
    fn batch(&self) -> usize {
        self.model.batch()
    }

    fn has_individual_antennas(&self) -> bool {
        self.model.has_individual_antennas()
    }

    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        // In batches, to bound memory.
        let batch = self.model.batch().max(1024);
        for (positions, out) in positions.chunks(batch).zip(out.chunks_mut(batch)) {
            self.predict_batch(positions, out)?;
        }
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        self.model.predict_powers(daughters, out)
    }
}

impl BandAverage {
    fn predict_batch(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        let count =
            |pair: &PairPosition| Self::frequency_count(norm(sub(pair.r_i_m, pair.r_j_m)), self.width_hz);
        let counts: Vec<usize> = positions.iter().map(count).collect();
        let count_max = counts.iter().copied().max().unwrap_or(0);
        let rules: Vec<GaussLegendre> = (0..=count_max).map(GaussLegendre::new).collect();
        // Frequency by frequency, so that consecutive integrations of a pair stay adjacent.
        let (mut scaled, mut terms) = (Vec::new(), Vec::new());
        for node in 0..count_max {
            for (index, (pair, &count)) in positions.iter().zip(&counts).enumerate() {
                if node < count {
                    let offset = (rules[count].abscissae[node] - 0.5) * self.width_hz / self.frequency_hz;
                    scaled.push(pair.scaled(1.0 + offset));
                    terms.push((index, rules[count].weights[node]));
                }
            }
        }
        predict_means(self.model.as_mut(), &scaled, &terms, out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::frames::AntennaResponse;
    use crate::response::model::DirectSum;
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::sky::{Frame, SkyMap};
    use crate::units::vector::dot;
    use std::f64::consts::TAU;

    #[test]
    fn rules_average_fringes_as_well_as_they_say() {
        for baseline_m in [0.0, 1.0, 100.0, 1e3, 7.5e3, 24e3, 1e5, 1e6] {
            let count = BandAverage::frequency_count(baseline_m, 8e3);
            let rule = GaussLegendre::new(count);
            for part in [0.1, 0.5, 0.9, 1.0] {
                let x = PI * part * baseline_m * 8e3 / SPEED_OF_LIGHT_M_S;
                let mean: f64 =
                    (0..count).map(|k| rule.weights[k] * (x * (2.0 * rule.abscissae[k] - 1.0)).cos()).sum();
                let sinc = if x == 0.0 { 1.0 } else { x.sin() / x };
                assert!(
                    (mean - sinc).abs() < TOLERANCE,
                    "{baseline_m} m: {count} frequencies, {mean} {sinc}"
                );
            }
        }
        assert_eq!(BandAverage::frequency_count(0.0, 8e3), 1);
    }

    /// Direct sum over the sky with the sinc in the integrand, written independently from the equations.
    fn with_sinc(
        sky: &[f64],
        pair: &PairPosition,
        frequency_hz: f64,
        width_hz: f64,
        moon_radius_m: f64,
    ) -> Complex64 {
        let nside = 32;
        let sees =
            |n: [f64; 3], r: [f64; 3]| -dot(n, r) <= (dot(r, r) - moon_radius_m * moon_radius_m).sqrt();
        let seen = |n: [f64; 3]| sees(n, pair.r_i_m) && sees(n, pair.r_j_m);
        let b = sub(pair.r_i_m, pair.r_j_m);
        let term = |(&n, &t): (&[f64; 3], &f64)| {
            let delay_s = dot(n, b) / SPEED_OF_LIGHT_M_S;
            let x = PI * delay_s * width_hz;
            let sinc = if x == 0.0 { 1.0 } else { x.sin() / x };
            Complex64::from_polar(t * sinc, -TAU * frequency_hz * delay_s)
        };
        let all: Vec<[f64; 3]> = pixel_directions(nside);
        let visible = all.iter().zip(sky).filter(|(n, _)| seen(**n));
        visible.map(term).sum::<Complex64>() * pixel_area_sr(nside)
    }

    #[test]
    fn averages_have_the_sinc_of_the_delay() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let values: Vec<f64> =
            (0..12 * 32 * 32).map(|p: i64| 1e5 * (1.0 + ((p * 7919) % 1013) as f64 / 300.0)).collect();
        let sky = SkyMap::new(Frame::Ecliptic, values.clone()).unwrap();
        let (frequency_hz, width_hz) = (3e6, 8e3);
        let direct = DirectSum::new(&sky, frequency_hz, array.moon_radius_m(), AntennaResponse::Isotropic);
        let mut averages = BandAverage::new(Box::new(direct.clone()), frequency_hz, width_hz);
        let position = |(i, j, t_s): (usize, usize, f64)| PairPosition {
            r_i_m: array.position_m(i, t_s),
            r_j_m: array.position_m(j, t_s),
            span_rad: 0.0,
            pair_time: None,
        };
        let pairs =
            [(0, 1, 100.0), (0, 4, 900.0), (0, 5, 4000.0), (2, 6, 7000.0), (0, 7, 2000.0)].map(position);
        let mut found = [Complex64::ZERO; 5];
        averages.predict(&pairs, &mut found).unwrap();
        let mut instants = [Complex64::ZERO; 5];
        direct.clone().predict(&pairs, &mut instants).unwrap();
        for (pair, found) in pairs.iter().zip(&found) {
            let expected = with_sinc(&values, pair, frequency_hz, width_hz, array.moon_radius_m());
            // Direct sums have f32 phases and values: 1e-4 of the noise of 1e4 pixels of about 2e5 K. One pixel may also cross
            // the Moon's limb, which moves by 3e-5 rad, at one of the frequencies.
            let tolerance = pixel_area_sr(32) * 2.7e5 * (1e-4 * 1e4_f64.sqrt() + 0.3);
            let error = (*found - expected).norm();
            assert!(error < tolerance, "{error} {tolerance}");
        }
        // The test is sensitive: without the average the longest baseline is far off.
        let expected = with_sinc(&values, &pairs[4], frequency_hz, width_hz, array.moon_radius_m());
        assert!((instants[4] - expected).norm() > 20.0 * pixel_area_sr(32) * 2.7e5 * 0.3);
    }
}
