//! Starting values: gains of each channel by alternating least squares (StEFCal, Salvini & Wijnholds 2014, A&A 571,
//! A97), with phases divided between clocks and phase parameters.

use num_complex::Complex64;

use super::layout::{ParameterLayout, ParameterValues};
use super::sums::{MODEL_TERMS, PairSums};

/// Maximum number of StEFCal iterations.
const STEFCAL_ITERATIONS_MAX: usize = 200;

impl ParameterLayout {
    /// Starting values with daughters at offsets of `position_m`.
    pub(super) fn starting_values(&self, sums: &[PairSums], position_m: &[[f64; 3]]) -> ParameterValues {
        let mut values = ParameterValues { position_m: position_m.to_vec(), ..self.ideal() };
        let fits: Vec<(&PairSums, Complex64, f64)> =
            sums.iter().map(|sums| self.model_sums(&values, sums)).collect();
        for c in 0..self.channels() {
            let gains = self.stefcal(&fits, c);
            let reference = gains[self.reference];
            let rotation =
                if reference.norm() > 0.0 { reference.conj() / reference.norm() } else { Complex64::ONE };
            for (n, gain) in gains.into_iter().enumerate() {
                let k = c * self.satellites + n;
                if self.amplitude_sigma > 0.0 {
                    // Within the range of the prior; Gauss-Newton goes on from there.
                    let amplitude_max = 4.0 * self.amplitude_sigma;
                    values.amplitude[k] = gain.norm().max(1e-9).ln().clamp(-amplitude_max, amplitude_max);
                }
                values.phase[k] = (gain * rotation).arg();
            }
        }
        self.divide_phases(&mut values);
        values
    }

    /// Sums of pairs, of w conj(M) V and of w |M|^2.
    fn model_sums<'a>(&self, values: &ParameterValues, sums: &'a PairSums) -> (&'a PairSums, Complex64, f64) {
        if self.model_terms() == 1 {
            return (sums, sums.cross[0], sums.gram[0][0].re);
        }
        let (_, u) = self.pair(values, sums.channel, sums.pair);
        let gram = sums.gram_times(&u);
        let cross = (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum();
        (sums, cross, (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum())
    }

    fn stefcal(&self, fits: &[(&PairSums, Complex64, f64)], channel: usize) -> Vec<Complex64> {
        let n = self.satellites;
        let mut gains = vec![Complex64::ONE; n];
        for iteration in 0..STEFCAL_ITERATIONS_MAX {
            let (mut numerator, mut denominator) = (vec![Complex64::ZERO; n], vec![0.0; n]);
            for &(sums, cross, model) in fits.iter().filter(|(sums, ..)| sums.channel == channel) {
                let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
                // V = g_i conj(g_j) M.
                numerator[i] += cross * gains[j];
                denominator[i] += model * gains[j].norm_sqr();
                numerator[j] += cross.conj() * gains[i];
                denominator[j] += model * gains[i].norm_sqr();
            }
            let mut change = 0.0_f64;
            for k in 0..n {
                let solved =
                    if denominator[k] > 0.0 { numerator[k] / denominator[k] } else { Complex64::ONE };
                let next = if iteration % 2 == 1 { 0.5 * (solved + gains[k]) } else { solved };
                change = change.max((next - gains[k]).norm());
                gains[k] = next;
            }
            if change < 1e-8 {
                break;
            }
        }
        gains
    }

    /// Moves the part of a daughter's phases that a clock explains best to its clock.
    fn divide_phases(&self, values: &mut ParameterValues) {
        if self.clock_sigma_ns <= 0.0 {
            return;
        }
        let rad_per_ns_max = (0..self.channels()).map(|c| self.rad_per_ns(c).abs()).fold(0.0, f64::max);
        // Candidates are a tenth of a radian of the highest channel apart, up to four standard deviations.
        let steps = (40.0 * self.clock_sigma_ns * rad_per_ns_max).ceil().min(1e5) as i64;
        let sigma = if self.phase_sigma > 0.0 { self.phase_sigma.min(1.0) } else { 0.1 };
        for n in 0..self.satellites {
            if self.clock(n).is_none() {
                continue;
            }
            let residual = |clock_ns: f64, c: usize| {
                let phase = values.phase[c * self.satellites + n] - self.rad_per_ns(c) * clock_ns;
                Complex64::cis(phase).arg()
            };
            let cost = |clock_ns: f64| {
                let phases: f64 = (0..self.channels()).map(|c| (residual(clock_ns, c) / sigma).powi(2)).sum();
                phases + (clock_ns / self.clock_sigma_ns).powi(2)
            };
            let candidates = (-steps..=steps).map(|k| 0.1 * k as f64 / rad_per_ns_max);
            let best = candidates.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(0.0);
            let phases: Vec<f64> = (0..self.channels()).map(|c| residual(best, c)).collect();
            values.clock_ns[n] = best;
            for (c, phase) in phases.into_iter().enumerate() {
                values.phase[c * self.satellites + n] = phase;
            }
        }
    }
}
