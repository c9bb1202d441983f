//! Starting values: gains of every channel alone by alternating least squares (StEFCal, Salvini & Wijnholds 2014, A&A 571,
//! A97), their phases shared between clocks and phases.

use num_complex::Complex64;

use super::layout::{ParameterLayout, Values};
use super::sums::{MODEL_TERMS, PairSums};

/// Iterations for starting values by channel.
const START_ITERATIONS: usize = 200;

impl ParameterLayout {
    /// Starting values with daughters that are off by `position_m`.
    pub(super) fn start(&self, sums: &[PairSums], position_m: &[[f64; 3]]) -> Values {
        let mut values = Values { position_m: position_m.to_vec(), ..self.ideal() };
        let fits: Vec<(&PairSums, Complex64, f64)> =
            sums.iter().map(|sums| self.fit(&values, sums)).collect();
        for c in 0..self.channels() {
            let gains = self.stefcal(&fits, c);
            let reference = gains[self.reference];
            let turn =
                if reference.norm() > 0.0 { reference.conj() / reference.norm() } else { Complex64::ONE };
            for (n, gain) in gains.into_iter().enumerate() {
                let k = c * self.satellites + n;
                if self.amplitude_sigma > 0.0 {
                    // Within what the prior can hold; Gauss-Newton goes on from there.
                    let most = 4.0 * self.amplitude_sigma;
                    values.amplitude[k] = gain.norm().max(1e-9).ln().clamp(-most, most);
                }
                values.phase[k] = (gain * turn).arg();
            }
        }
        self.share_clocks(&mut values);
        values
    }

    /// Sums of w conj(M) V and of w |M|^2.
    fn fit<'a>(&self, values: &Values, sums: &'a PairSums) -> (&'a PairSums, Complex64, f64) {
        if self.terms() == 1 {
            return (sums, sums.cross[0], sums.gram[0][0].re);
        }
        let (_, u) = self.pair(values, sums.channel, sums.pair);
        let gram = sums.gram_of(&u);
        let along = (0..MODEL_TERMS).map(|k| u[k] * sums.cross[k]).sum();
        (sums, along, (0..MODEL_TERMS).map(|k| u[k] * gram[k].re).sum())
    }

    fn stefcal(&self, fits: &[(&PairSums, Complex64, f64)], channel: usize) -> Vec<Complex64> {
        let n = self.satellites;
        let mut gains = vec![Complex64::ONE; n];
        for round in 0..START_ITERATIONS {
            let (mut above, mut below) = (vec![Complex64::ZERO; n], vec![0.0; n]);
            for &(sums, along, model) in fits.iter().filter(|(sums, ..)| sums.channel == channel) {
                let [i, j] = [sums.pair.i, sums.pair.j].map(usize::from);
                // V = g_i conj(g_j) M.
                above[i] += along * gains[j];
                below[i] += model * gains[j].norm_sqr();
                above[j] += along.conj() * gains[i];
                below[j] += model * gains[i].norm_sqr();
            }
            let mut change = 0.0_f64;
            for k in 0..n {
                let found = if below[k] > 0.0 { above[k] / below[k] } else { Complex64::ONE };
                let next = if round % 2 == 1 { 0.5 * (found + gains[k]) } else { found };
                change = change.max((next - gains[k]).norm());
                gains[k] = next;
            }
            if change < 1e-8 {
                break;
            }
        }
        gains
    }

    /// Moves what a clock explains best from the phases of a daughter to its clock.
    fn share_clocks(&self, values: &mut Values) {
        if self.clock_sigma_ns <= 0.0 {
            return;
        }
        let fastest = (0..self.channels()).map(|c| self.per_ns(c).abs()).fold(0.0, f64::max);
        // A tenth of a radian apart, to four standard deviations.
        let reach = (40.0 * self.clock_sigma_ns * fastest).ceil().min(1e5) as i64;
        let sigma = if self.phase_sigma > 0.0 { self.phase_sigma.min(1.0) } else { 0.1 };
        for n in 0..self.satellites {
            if self.clock(n).is_none() {
                continue;
            }
            let left = |clock_ns: f64, c: usize| {
                let phase = values.phase[c * self.satellites + n] - self.per_ns(c) * clock_ns;
                Complex64::cis(phase).arg()
            };
            let cost = |clock_ns: f64| {
                let phases: f64 = (0..self.channels()).map(|c| (left(clock_ns, c) / sigma).powi(2)).sum();
                phases + (clock_ns / self.clock_sigma_ns).powi(2)
            };
            let candidates = (-reach..=reach).map(|k| 0.1 * k as f64 / fastest);
            let best = candidates.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap_or(0.0);
            let phases: Vec<f64> = (0..self.channels()).map(|c| left(best, c)).collect();
            values.clock_ns[n] = best;
            for (c, phase) in phases.into_iter().enumerate() {
                values.phase[c * self.satellites + n] = phase;
            }
        }
    }
}
