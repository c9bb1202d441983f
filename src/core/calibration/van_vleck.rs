//! The effect of coarse quantisers on correlations, and its correction.

use std::f64::consts::{FRAC_PI_2, TAU};

use thiserror::Error;

use crate::frames::VisibilityBlock;

/// Number of steps of the table over the angle whose sine is the correlation.
const STEPS: usize = 512;

/// The number of bits has no correction.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("calibration.quantiser_bits = {0}: expected 0 for none, 1, 2 or 4")]
pub struct QuantiserBitsError(pub u32);

/// Relation between correlations before and after quantisation with equal levels.
///
/// Two Gaussian variables of correlation rho, quantised to q with thresholds t_k a step h apart, have
/// `d<q q'>/d rho = h^2 sum over k, l of phi(t_k, t_l; rho)`, phi their joint density (Price's theorem;
/// Thompson, Moran & Swenson 2017, Sect. 8.3; van Vleck & Middleton 1966 for one bit, where it is
/// `2/pi asin rho`). With rho = sin(theta) the integrand has no pole.
#[derive(Clone, Debug)]
pub struct VanVleck {
    /// Correlation after quantising, as a fraction of the power, at equal steps of theta from 0 to pi/2.
    quantised: Vec<f64>,
    /// Power after quantising as a fraction of the power before.
    power_ratio: f64,
}

impl VanVleck {
    /// Computes the relation for 1, 2 or 4 bits at the levels of least loss: steps of 0.9957 and 0.3352 standard
    /// deviations (Thompson, Moran & Swenson, Table 8.2); for one bit, levels of one deviation.
    ///
    /// # Errors
    /// The number of bits is none of these.
    pub fn new(bits: u32) -> Result<Self, QuantiserBitsError> {
        let step = match bits {
            1 => 2.0,
            2 => 0.9957,
            4 => 0.3352,
            _ => return Err(QuantiserBitsError(bits)),
        };
        let half = 1_i32 << (bits - 1);
        let thresholds: Vec<f64> = (1 - half..half).map(|k| f64::from(k) * step).collect();
        let slope = |theta: f64| -> f64 {
            let (sin, cos) = theta.sin_cos();
            let mut sum = 0.0;
            for s in &thresholds {
                for t in &thresholds {
                    let square = s * s + t * t - 2.0 * s * t * sin;
                    sum += if square > 0.0 { (-square / (2.0 * cos * cos)).exp() } else { 1.0 };
                }
            }
            step * step * sum / TAU
        };
        let h = FRAC_PI_2 / STEPS as f64;
        let mut quantised = vec![0.0];
        let mut total = 0.0;
        for k in 0..STEPS {
            let from = h * k as f64;
            // Three-point Gauss rule: the integrand is never evaluated at the end, where cos is 0.
            let at = |x: f64| slope(from + h * (0.5 + 0.5 * x));
            let root = 0.6_f64.sqrt();
            total += h * (5.0 * at(-root) + 8.0 * at(0.0) + 5.0 * at(root)) / 18.0;
            quantised.push(total);
        }
        for value in &mut quantised {
            *value /= total;
        }
        Ok(Self { quantised, power_ratio: total })
    }

    /// Correlation after quantisation, for a correlation from -1 to 1.
    #[must_use]
    pub fn forward(&self, correlation: f64) -> f64 {
        let position = correlation.abs().min(1.0).asin() / FRAC_PI_2 * STEPS as f64;
        let k = (position as usize).min(STEPS - 1);
        let (low, high) = (self.quantised[k], self.quantised[k + 1]);
        (low + (position - k as f64) * (high - low)).copysign(correlation)
    }

    /// Correlation before quantisation, for one after it from -1 to 1; noise beyond counts as +-1.
    #[must_use]
    pub fn inverse(&self, quantised: f64) -> f64 {
        let target = quantised.abs().min(1.0);
        let k = self.quantised.partition_point(|value| *value <= target).clamp(1, STEPS) - 1;
        let (low, high) = (self.quantised[k], self.quantised[k + 1]);
        let position = k as f64 + (target - low) / (high - low);
        (FRAC_PI_2 * position / STEPS as f64).sin().copysign(quantised)
    }

    /// Corrects the values of a block in place, real and imaginary parts separately, and sets its weights to those of
    /// the corrected values. `width_hz` is the channel's width.
    ///
    /// The daughters' powers follow from the mother's weights, `2 n / (P_i P_j)`, with n all samples of the
    /// integration.
    pub fn apply(&self, block: &mut VisibilityBlock, width_hz: f64) {
        if block.pair.i == block.pair.j {
            // Powers are only scaled by the power ratio.
            for (value, weight) in block.value_k_sr.iter_mut().zip(&mut block.weight) {
                *value /= self.power_ratio as f32;
                *weight *= self.power_ratio.powi(2) as f32;
            }
            return;
        }
        let weak_slope = self.quantised[1] / (FRAC_PI_2 / STEPS as f64).sin();
        for k in 0..block.value_k_sr.len() {
            let samples = width_hz * f64::from(block.duration_ticks[k]) * 1e-6;
            let power = (2.0 * samples / f64::from(block.weight[k])).sqrt();
            let value = &mut block.value_k_sr[k];
            let corrected =
                |part: f32| (self.inverse(f64::from(part) / power) * power / self.power_ratio) as f32;
            value.re = corrected(value.re);
            value.im = corrected(value.im);
            // The correction scales the noise of weak correlations as it scales them.
            block.weight[k] *= ((weak_slope * self.power_ratio).powi(2)) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Flags;
    use num_complex::Complex32;

    #[test]
    fn one_bit_is_the_arcsine() {
        let relation = VanVleck::new(1).unwrap();
        for k in -100..=100 {
            let rho = f64::from(k) / 100.0;
            // 2/pi asin(rho); the table is linear in just this.
            assert!((relation.forward(rho) - rho.asin() / FRAC_PI_2).abs() < 1e-9, "{rho}");
            assert!((relation.inverse(relation.forward(rho)) - rho).abs() < 1e-9, "{rho}");
        }
    }

    /// Efficiency of weak correlations: `a^2 / <q^2>` with `a = <x q(x)>`.
    #[test]
    fn weak_correlations_shrink_by_the_known_efficiencies() {
        // Table 8.2 for 4 and 16 levels, even spacing; 2/pi.
        for (bits, efficiency) in [(1, 2.0 / std::f64::consts::PI), (2, 0.88115), (4, 0.98846)] {
            let relation = VanVleck::new(bits).unwrap();
            let slope = relation.forward(1e-4) / 1e-4;
            assert!((slope - efficiency).abs() < 1e-4, "{bits} bits: {slope}");
        }
        assert_eq!(VanVleck::new(8).unwrap_err(), QuantiserBitsError(8));
    }

    #[test]
    fn the_power_ratio_is_that_of_the_levels() {
        // 2 bits: levels +-1/2 and +-3/2 of 0.9957; the outer two with the probability of |x| > 0.9957, 0.31940.
        let expected = 0.9957_f64.powi(2) * (0.25 + 2.0 * 0.319_396);
        let found = VanVleck::new(2).unwrap().power_ratio;
        assert!((found - expected).abs() < 1e-5, "{found} {expected}");
        assert!((VanVleck::new(1).unwrap().power_ratio - 1.0).abs() < 1e-12);
    }

    #[test]
    fn a_block_is_restored_with_its_noise() {
        let relation = VanVleck::new(2).unwrap();
        // Powers of 3 before the quantiser, 1 s of 8 kHz.
        let power = 3.0 * relation.power_ratio;
        let rho: [f64; 2] = [0.3, -0.7];
        let quantised = rho.map(|rho| (relation.forward(rho) * power) as f32);
        let mut block = VisibilityBlock {
            pair: crate::units::Pair { i: 0, j: 1 },
            offset_ticks: vec![0],
            duration_ticks: vec![1_000_000],
            value_k_sr: vec![Complex32::new(quantised[0], quantised[1])],
            weight: vec![(2.0 * 8000.0 / (power * power)) as f32],
            flags: vec![Flags::GOOD],
            ..VisibilityBlock::default()
        };
        relation.apply(&mut block, 8e3);
        // f32.
        assert!((block.value_k_sr[0].re - 0.9).abs() < 1e-5 && (block.value_k_sr[0].im + 2.1).abs() < 1e-5);
        // 2 n eta^2 / P^2 (the definition of the efficiency eta).
        let expected = 16_000.0 * 0.88115_f32.powi(2) / 9.0;
        assert!((block.weight[0] / expected - 1.0).abs() < 1e-3, "{} {expected}", block.weight[0]);
    }
}
