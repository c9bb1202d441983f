//! Whether a solution explains the data.
//!
//! A search over positions can end in a wrong minimum, whose formal errors are as small as those of the right one. What tells them
//! apart is how much of the signal they leave unexplained. Chi-square alone is no measure of that: with much signal, a sky that is
//! right within a few percent has a large one, and with little signal a wrong minimum has a small one. So the test has two parts:
//! what is left beyond the noise has to be significant, and a good part of the signal.

use super::layout::ParameterLayout;
use super::newton::NewtonFit;
use super::robust_fit::Fitted;
use super::sums::ModelledBlock;

/// Standard deviations of noise beyond which something is left.
const SIGNIFICANT: f64 = 3.0;

/// The same of all pairs of a channel together: what stays below turns amplitudes by no more than two deviations.
const SIGNIFICANT_OF_ALL: f64 = 2.0;

/// Parts of the signal that a solution leaves.
pub(super) struct Unexplained {
    /// By channel, then daughter.
    pub(super) of_gains: Vec<f64>,
    /// Of all pairs of a channel, without those of daughters that answer for more than is allowed.
    pub(super) of_channels: Vec<f64>,
}

/// What is left of the signal of a pair in a channel, and the signal, in units of the variance of signal and noise together:
/// beams, beacons and pairs of any strength count by the number of their visibilities.
#[derive(Clone, Copy, Default)]
struct Residual {
    left: f64,
    signal: f64,
    /// Variance of `left` by noise.
    variance: f64,
}

impl Residual {
    fn of(
        layout: &ParameterLayout,
        found: &NewtonFit,
        block: &ModelledBlock,
        [from_s, until_s]: [f64; 2],
    ) -> Self {
        let (gain, u) = layout.pair(&found.values, block.channel, block.pair);
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

    fn with(self, other: Self) -> Self {
        Self {
            left: self.left + other.left,
            signal: self.signal + other.signal,
            variance: self.variance + other.variance,
        }
    }

    /// Part of the signal that is left; none if it may be noise of so many standard deviations.
    fn part(&self, significant: f64) -> f64 {
        if self.left > significant * self.variance.sqrt() { self.left / self.signal } else { 0.0 }
    }
}

/// Part of the signal of each daughter in each channel, and of each channel, that its solution leaves. The worst daughter of a
/// channel answers for its pairs, if it is above `most`; the next one for what remains.
pub(super) fn unexplained(
    fitted: &Fitted,
    blocks: &[ModelledBlock],
    span_s: [f64; 2],
    most: f64,
) -> Unexplained {
    let Fitted { layout, found, takes_part, .. } = fitted;
    let n = layout.satellites;
    let mut parts = vec![0.0; n * layout.channels()];
    let mut of_channels = vec![0.0; layout.channels()];
    for (channel, parts) in parts.chunks_mut(n.max(1)).enumerate() {
        let mut pairs: Vec<([usize; 2], Residual)> = blocks
            .iter()
            .zip(takes_part)
            .filter(|(block, takes_part)| block.channel == channel && **takes_part)
            .map(|(block, _)| {
                let pair = [block.pair.i, block.pair.j].map(usize::from);
                (pair, Residual::of(layout, found, block, span_s))
            })
            .collect();
        loop {
            let of = |daughter: usize| {
                let own = pairs.iter().filter(|(pair, _)| pair.contains(&daughter));
                own.fold(Residual::default(), |sum, (_, left)| sum.with(*left)).part(SIGNIFICANT)
            };
            let open: Vec<(usize, f64)> = (0..n).filter(|k| parts[*k] == 0.0).map(|k| (k, of(k))).collect();
            // Of two that are equally bad the reference stays.
            let worst = open
                .iter()
                .copied()
                .filter(|(k, _)| *k != layout.reference)
                .chain(open.iter().copied().filter(|(k, _)| *k == layout.reference));
            let worst = worst.fold((0, 0.0), |worst, one| if one.1 > worst.1 { one } else { worst });
            if worst.1 <= most {
                open.into_iter().for_each(|(k, part)| parts[k] = part);
                let all = pairs.iter().fold(Residual::default(), |sum, (_, left)| sum.with(*left));
                of_channels[channel] = all.part(SIGNIFICANT_OF_ALL);
                break;
            }
            parts[worst.0] = worst.1;
            pairs.retain(|(pair, _)| !pair.contains(&worst.0));
        }
    }
    Unexplained { of_gains: parts, of_channels }
}
