//! Weighted sums of the data by channel and pair, from which a solution is computed. Their size does not grow with
//! the number of visibilities.

use num_complex::Complex64;

use crate::units::Pair;

/// Number of terms of the model of a visibility: its value, and its derivatives by the position errors of both
/// daughters (three axes each, K sr / m). Only the first is used where positions are not solved for.
pub const MODEL_TERMS: usize = 7;

/// Terms of the model of a visibility, see [`MODEL_TERMS`].
pub type ModelTerms = [Complex64; MODEL_TERMS];

/// Visibilities of one pair in one channel, with their model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ModelledBlock {
    /// Channel, from 0.
    pub channel: usize,
    /// Pair.
    pub pair: Pair,
    /// Middle of each integration, s since the epoch.
    pub time_s: Vec<f64>,
    /// Measured, K sr.
    pub value_k_sr: Vec<Complex64>,
    /// Inverse variance of the real part, (K sr)^-2.
    pub weight: Vec<f64>,
    /// Model terms of each visibility.
    pub model: Vec<ModelTerms>,
    /// Whether each visibility is left out of solutions as an outlier.
    pub is_out: Vec<bool>,
}

/// Weighted sums of one pair in one channel, with f the model's terms and V the measured values.
#[derive(Clone, Copy, Debug)]
pub(super) struct PairSums {
    pub(super) channel: usize,
    pub(super) pair: Pair,
    /// Number of visibilities.
    pub(super) count: f64,
    /// Variance factor that weights are divided by.
    pub(super) variance_factor: f64,
    /// Sum of w |V|^2.
    pub(super) power: f64,
    /// Sums of w conj(f_k) V.
    pub(super) cross: ModelTerms,
    /// Sums of w conj(f_k) f_l.
    pub(super) gram: [ModelTerms; MODEL_TERMS],
}

impl PairSums {
    /// Sums visibilities between two times that are not left out, with weights divided by `variance_factor` and the
    /// first `terms` terms of the model.
    pub(super) fn of(
        block: &ModelledBlock,
        [from_s, until_s]: [f64; 2],
        terms: usize,
        variance_factor: f64,
    ) -> Self {
        let mut sums = Self {
            channel: block.channel,
            pair: block.pair,
            count: 0.0,
            variance_factor,
            power: 0.0,
            cross: [Complex64::ZERO; MODEL_TERMS],
            gram: [[Complex64::ZERO; MODEL_TERMS]; MODEL_TERMS],
        };
        for k in 0..block.time_s.len() {
            if block.is_out[k] || !(from_s..until_s).contains(&block.time_s[k]) {
                continue;
            }
            let (value, weight, model) =
                (block.value_k_sr[k], block.weight[k] / variance_factor, &block.model[k]);
            sums.count += 1.0;
            sums.power += weight * value.norm_sqr();
            for a in 0..terms {
                let weighted = weight * model[a].conj();
                sums.cross[a] += weighted * value;
                for (gram, term) in sums.gram[a].iter_mut().zip(&model[..terms]) {
                    *gram += weighted * term;
                }
            }
        }
        sums
    }

    /// Products of the gram matrix with the factors `u` of the model's terms.
    pub(super) fn gram_times(&self, u: &[f64; MODEL_TERMS]) -> ModelTerms {
        let mut out = [Complex64::ZERO; MODEL_TERMS];
        for (k, out) in out.iter_mut().enumerate() {
            *out = (0..MODEL_TERMS).map(|l| u[l] * self.gram[l][k]).sum();
        }
        out
    }
}
