//! Fraction of the signal that a solution leaves unexplained.
//!
//! A search over positions can end in a wrong minimum, whose formal errors are as small as those of the right one. It
//! differs by the fraction of the signal that it leaves unexplained. Chi-square alone does not measure that: with
//! much signal, a sky that is right within a few percent has a large chi-square, and with little signal a wrong
//! minimum has a small one. So the test has two parts: the residual beyond noise must be significant, and a large
//! fraction of the signal.

use super::layout::ParameterLayout;
use super::newton::NewtonFit;
use super::robust_fit::RobustFit;
use super::sums::ModelledBlock;

/// Significance, in standard deviations of noise, of a residual.
const SIGMAS: f64 = 3.0;

/// Significance of the residual of all pairs of a channel together: what stays below turns amplitudes by no more than two deviations.
const SIGMAS_OF_ALL: f64 = 2.0;

/// Unexplained fractions of the signal.
pub(super) struct Unexplained {
    /// By channel, then daughter.
    pub(super) by_gain: Vec<f64>,
    /// Of all pairs of a channel, without those attributed to a daughter above the maximum.
    pub(super) by_channel: Vec<f64>,
}

/// Residual signal of a pair in a channel, and the signal, in units of the variance of signal and noise together: so
/// pairs of any strength count by the number of their visibilities.
#[derive(Clone, Copy, Default)]
struct Residual {
    left: f64,
    signal: f64,
    /// Variance of `left` due to noise.
    variance: f64,
}

impl Residual {
    fn of(
        layout: &ParameterLayout,
        newton: &NewtonFit,
        block: &ModelledBlock,
        [from_s, until_s]: [f64; 2],
    ) -> Self {
        let (gain, u) = layout.pair(&newton.values, block.channel, block.pair);
        let (mut count, mut residual, mut power) = (0.0, 0.0, 0.0);
        let is_used = |k: &usize| !block.is_out[*k] && (from_s..until_s).contains(&block.time_s[*k]);
        for k in (0..block.time_s.len()).filter(is_used) {
            let model: num_complex::Complex64 =
                block.model[k].iter().zip(&u).map(|(term, factor)| term * factor).sum();
            let (value, weight) = (block.value_k_sr[k], block.weight[k]);
            count += 1.0;
            residual += 0.5 * weight * (value - gain * model).norm_sqr();
            power += 0.5 * weight * value.norm_sqr();
        }
        if power <= count {
            return Self::default();
        }
        let noise = count / power;
        Self {
            left: (residual - count) * noise,
            signal: (power - count) * noise,
            variance: count * noise * noise,
        }
    }

    fn plus(self, other: Self) -> Self {
        Self {
            left: self.left + other.left,
            signal: self.signal + other.signal,
            variance: self.variance + other.variance,
        }
    }

    /// Unexplained fraction of the signal; 0 if the residual may be noise of so many standard deviations.
    fn fraction(&self, sigmas: f64) -> f64 {
        if self.left > sigmas * self.variance.sqrt() { self.left / self.signal } else { 0.0 }
    }
}

/// Unexplained fractions of the signal of each daughter in each channel, and of each channel. If the worst
/// daughter of a channel is above `fraction_max`, its pairs are attributed to it, and the others are judged by the
/// remaining pairs.
pub(super) fn unexplained(
    fitted: &RobustFit,
    blocks: &[ModelledBlock],
    span_s: [f64; 2],
    fraction_max: f64,
) -> Unexplained {
    let RobustFit { layout, newton, is_pair_used, .. } = fitted;
    let n = layout.satellites;
    let mut fractions = vec![0.0; n * layout.channels()];
    let mut by_channel = vec![0.0; layout.channels()];
    for (channel, fractions) in fractions.chunks_mut(n.max(1)).enumerate() {
        let mut pairs: Vec<([usize; 2], Residual)> = blocks
            .iter()
            .zip(is_pair_used)
            .filter(|(block, is_pair_used)| block.channel == channel && **is_pair_used)
            .map(|(block, _)| {
                let pair = [block.pair.i, block.pair.j].map(usize::from);
                (pair, Residual::of(layout, newton, block, span_s))
            })
            .collect();
        loop {
            let fraction_of = |daughter: usize| {
                let of_daughter = pairs.iter().filter(|(pair, _)| pair.contains(&daughter));
                of_daughter.fold(Residual::default(), |sum, (_, left)| sum.plus(*left)).fraction(SIGMAS)
            };
            let open: Vec<(usize, f64)> =
                (0..n).filter(|k| fractions[*k] == 0.0).map(|k| (k, fraction_of(k))).collect();
            // Of equally bad daughters the reference is the last to be chosen.
            let worst = open
                .iter()
                .copied()
                .filter(|(k, _)| *k != layout.reference)
                .chain(open.iter().copied().filter(|(k, _)| *k == layout.reference));
            let worst = worst.fold((0, 0.0), |worst, one| if one.1 > worst.1 { one } else { worst });
            if worst.1 <= fraction_max {
                open.into_iter().for_each(|(k, fraction)| fractions[k] = fraction);
                let all = pairs.iter().fold(Residual::default(), |sum, (_, left)| sum.plus(*left));
                by_channel[channel] = all.fraction(SIGMAS_OF_ALL);
                break;
            }
            fractions[worst.0] = worst.1;
            pairs.retain(|(pair, _)| !pair.contains(&worst.0));
        }
    }
    Unexplained { by_gain: fractions, by_channel }
}
