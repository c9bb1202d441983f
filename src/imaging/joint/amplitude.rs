//! Test of each channel's amplitude against the spectrum of the other channels.
//!
//! A joint map estimates a C_l for each channel, so it does not detect a channel with a wrong scale. Amplitudes do: over a decade of frequency
//! the logarithm of the sky's amplitude is close to a parabola in the logarithm of frequency (a power law with curvature, or a spectrum
//! that turns over by absorption).

use serde::Serialize;

/// Coefficients of the parabola.
const COEFFICIENTS: usize = 3;
/// Minimum number of channels: the others must outnumber the coefficients, or every channel disagrees alike.
const CHANNELS_MIN: usize = COEFFICIENTS + 2;
/// Limits beyond which a channel disagrees: standard errors, and a relative difference. Channels with the right scale deviate by up to 3 %
/// (measured at nside 8 and 32), from what each map lacks and from terms of higher order.
const DISAGREES_SIGMAS: f64 = 3.0;
const DISAGREES: f64 = 0.06;

/// Amplitude of a channel relative to the parabola through the other channels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RelativeAmplitude {
    /// Ratio of the amplitudes: 1 if the channel agrees.
    pub ratio: f64,
    /// Standard error of the ratio, from the scatter of the other channels about the parabola.
    pub sigma: f64,
}

impl RelativeAmplitude {
    /// Whether the scale of the channel disagrees with the other channels.
    pub fn disagrees(self) -> bool {
        (self.ratio - 1.0).abs() > DISAGREES.max(DISAGREES_SIGMAS * self.sigma)
    }
}

/// Relative amplitude of each channel; `None` for all if there are too few channels or one of them has no structure.
///
/// Arguments: frequency (Hz) and amplitude (K sr^(1/2)) of each channel.
pub(super) fn relative_amplitudes(channels: &[(f64, f64)]) -> Vec<Option<RelativeAmplitude>> {
    let is_known = |(hz, amplitude): &(f64, f64)| *hz > 0.0 && *amplitude > 0.0;
    if channels.len() < CHANNELS_MIN || !channels.iter().all(is_known) {
        return vec![None; channels.len()];
    }
    let points: Vec<[f64; 2]> = channels.iter().map(|(hz, amplitude)| [hz.ln(), amplitude.ln()]).collect();
    let relative = |channel: usize| {
        let others: Vec<[f64; 2]> =
            points.iter().enumerate().filter(|(k, _)| *k != channel).map(|(_, point)| *point).collect();
        let [at, own] = points[channel];
        let (expected, variance) = parabola_at(&others, at)?;
        let ratio = (own - expected).exp();
        Some(RelativeAmplitude { ratio, sigma: ratio * variance.sqrt() })
    };
    (0..points.len()).map(relative).collect()
}

/// Value at `x` of the least-squares parabola, and the variance of a new point about it.
fn parabola_at(points: &[[f64; 2]], x: f64) -> Option<(f64, f64)> {
    // About `x` and over the widest distance, so that the value is the first coefficient and the equations are well conditioned.
    let width = points.iter().map(|point| (point[0] - x).abs()).fold(0.0, f64::max);
    let row = |point: &[f64; 2]| [0, 1, 2].map(|power| ((point[0] - x) / width).powi(power));
    let normal = faer::Mat::from_fn(COEFFICIENTS, COEFFICIENTS, |i, j| {
        points.iter().map(|point| row(point)[i] * row(point)[j]).sum::<f64>()
    });
    let right = faer::Mat::from_fn(COEFFICIENTS, 1, |i, _| {
        points.iter().map(|point| row(point)[i] * point[1]).sum::<f64>()
    });
    let factor = normal.llt(faer::Side::Lower).ok()?;
    let fitted = faer::linalg::solvers::Solve::solve(&factor, &right);
    let leverage = faer::linalg::solvers::DenseSolveCore::inverse(&factor)[(0, 0)];
    let residual = |point: &[f64; 2]| {
        point[1] - row(point).iter().enumerate().map(|(k, x)| x * fitted[(k, 0)]).sum::<f64>()
    };
    let scatter = points.iter().map(|point| residual(point).powi(2)).sum::<f64>();
    let freedom = points.len().checked_sub(COEFFICIENTS).filter(|freedom| *freedom > 0)?;
    Some((fitted[(0, 0)], scatter / freedom as f64 * (1.0 + leverage)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Amplitudes of a sky that is absorbed, `nu^-2.5 exp(-(2.5 MHz / nu)^2.1)`, a cubic law in part, with 0.2 % of scatter.
    fn sky(hz: &[f64]) -> Vec<(f64, f64)> {
        let scatter = [1.002, 0.998, 1.001, 0.999, 1.0, 1.002, 0.998, 1.001];
        let at = |(k, hz): (usize, &f64)| {
            let law = (hz / 1e7).powf(-2.5) * (-(2.5e6 / hz).powf(2.1)).exp();
            (*hz, law * scatter[k % scatter.len()])
        };
        hz.iter().enumerate().map(at).collect()
    }

    #[test]
    fn a_channel_of_a_wrong_scale_is_the_one_that_disagrees() {
        let hz = [4e6, 5e6, 6e6, 7e6, 8e6, 9e6, 10e6];
        let right = relative_amplitudes(&sky(&hz));
        assert!(
            right.iter().flatten().count() == 7 && !right.iter().flatten().any(|found| found.disagrees()),
            "{right:?}"
        );
        for wrong in 0..hz.len() {
            let mut channels = sky(&hz);
            channels[wrong].1 *= 1.1;
            let found = relative_amplitudes(&channels);
            let disagreeing: Vec<usize> =
                (0..hz.len()).filter(|k| found[*k].is_some_and(RelativeAmplitude::disagrees)).collect();
            // An end is extrapolated to, which the scatter and the law's higher orders make uncertain.
            let is_end = wrong == 0 || wrong == hz.len() - 1;
            assert!(disagreeing == [wrong] || is_end && disagreeing.is_empty(), "{wrong}: {found:?}");
            let ratio = found[wrong].unwrap().ratio;
            assert!((ratio - 1.1).abs() < if is_end { 0.05 } else { 0.02 }, "{wrong}: {ratio}");
        }
    }

    #[test]
    fn four_channels_cannot_tell_which_is_wrong() {
        assert_eq!(relative_amplitudes(&sky(&[4e6, 6e6, 8e6, 10e6])), [None; 4]);
    }

    /// Ordinary least squares by hand: five points on `1 + x^2` but one, which is 0.5 above.
    #[test]
    fn the_parabola_is_that_of_least_squares() {
        let points = [[-2.0, 5.0], [-1.0, 2.0], [1.0, 2.0], [2.0, 5.0]];
        let (value, variance) = parabola_at(&points, 0.0).unwrap();
        assert!((value - 1.0).abs() < 1e-12 && variance < 1e-20, "{value} {variance}");
        // At x = -2, -1, 1, 2 the constant's weights are (-1, 4, 4, -1) / 6 and their squares sum to 34 / 36; residuals of
        // (0.1, 0, 0, -0.1) after the fit of slope 0.04: 0.02, 0.04, -0.04, -0.02.
        let tilted = [[-2.0, 5.1], [-1.0, 2.0], [1.0, 2.0], [2.0, 4.9]];
        let (value, variance) = parabola_at(&tilted, 0.0).unwrap();
        let expected = (2.0 * 0.02_f64.powi(2) + 2.0 * 0.04_f64.powi(2)) * (1.0 + 34.0 / 36.0);
        assert!(
            (value - 1.0).abs() < 1e-12 && (variance - expected).abs() < 1e-12,
            "{value} {variance} {expected}"
        );
    }
}
