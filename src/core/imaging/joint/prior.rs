//! The prior of the sky's coefficients at several frequencies: `x = T u` with standard normal u, so that `T T'` is their covariance (`correlation`).

use faer::linalg::triangular_solve::solve_upper_triangular_in_place;
use faer::{Mat, Par};

use super::correlation::{Correlation, Covariance, Moments};
use crate::imaging::SolveError;
use crate::imaging::power::{Derivatives, FREE_DEGREES};
use crate::imaging::unknowns::{degrees_orders_parts, index_of};

/// Independent fraction of the free degrees: the smallest for which correlations of close channels have a Cholesky factor.
const FREE_INDEPENDENT_FRACTION: f64 = 1e-6;
/// Least correlation length of the free degrees: with a shorter one nothing of the neighbours would reach frequencies between them.
const FREE_LENGTH_MIN: f64 = 0.3;

/// The prior of several channels, `x = T u` with standard normal u. Channels are in order of decreasing l_max, so that the channels with a
/// given degree come first.
#[derive(Clone, Debug)]
pub(super) struct Prior {
    pub(super) frequencies_hz: Vec<f64>,
    /// Maximum degree of each channel, in decreasing order.
    pub(super) l_max: Vec<usize>,
    /// s_l of each channel, K sr^(1/2).
    pub(super) scale: Vec<Vec<f64>>,
    pub(super) covariance: Covariance,
    /// By degree, lower Cholesky factor of the channels' covariance in units of their scales.
    factors: Vec<Mat<f64>>,
}

/// A map at some frequency as a function of the unknowns: `x_lm = s_l sum_k q_k u_k,lm` plus an undetermined remainder.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub(super) frequency_hz: f64,
    pub(super) l_max: usize,
    pub(super) scale: Vec<f64>,
    /// Coefficients q of the channels by degree; only channels with this degree contribute.
    pub(super) shares: Vec<Vec<f64>>,
    /// Variance of `x_lm / s_l` that no channel determines, by degree; 0 at the frequency of a channel.
    pub(super) undetermined: Vec<f64>,
}

impl Prior {
    pub(super) fn new(scale: Vec<Vec<f64>>, covariance: Covariance) -> Result<Self, SolveError> {
        let l_max: Vec<usize> = scale.iter().map(|scale| scale.len() - 1).collect();
        let of_degree = |l: usize| {
            if l < FREE_DEGREES {
                return Ok(Mat::identity(
                    covariance.frequencies_hz().len(),
                    covariance.frequencies_hz().len(),
                ));
            }
            let factor = covariance.correlation(l).cholesky_factor(covariance.frequencies_hz())?;
            let amplitudes = covariance.amplitudes(l);
            Ok(Mat::from_fn(factor.nrows(), factor.ncols(), |i, j| amplitudes[i] * factor[(i, j)]))
        };
        let factors =
            (0..=l_max.first().copied().unwrap_or(0)).map(of_degree).collect::<Result<_, SolveError>>()?;
        Ok(Self { frequencies_hz: covariance.frequencies_hz().to_vec(), l_max, scale, covariance, factors })
    }

    /// The same prior with other parameters of the covariance.
    pub(super) fn with_theta(&self, theta: &[f64]) -> Result<Self, SolveError> {
        Self::new(self.scale.clone(), self.covariance.with_theta(theta))
    }

    /// Gradient and information of the parameters' log evidence.
    pub(super) fn derivatives(&self, moments: &[Moments]) -> Derivatives {
        self.covariance.derivatives(&self.factors, moments)
    }

    pub(super) fn channels(&self) -> usize {
        self.l_max.len()
    }

    /// The number of channels with a degree, which are the first ones.
    pub(super) fn channels_with_degree(&self, l: usize) -> usize {
        self.l_max.iter().take_while(|l_max| **l_max >= l).count()
    }

    /// The element of T, without scale, that multiplies the unknowns of channel `source` in the map of `channel`.
    pub(super) fn share(&self, l: usize, channel: usize, source: usize) -> f64 {
        if source <= channel { self.factors[l][(channel, source)] } else { 0.0 }
    }

    /// The offset of each channel's unknowns, and the total number of unknowns.
    pub(super) fn offsets(&self) -> (Vec<usize>, usize) {
        let mut next = 0;
        let offsets = self.l_max.iter().map(|l_max| {
            let offset = next;
            next += (l_max + 1).pow(2);
            offset
        });
        (offsets.collect(), next)
    }

    /// The skies `T u`, one vector of coefficients per channel.
    pub(super) fn skies(&self, u: &[f64]) -> Vec<Vec<f64>> {
        let (offsets, _) = self.offsets();
        (0..self.channels())
            .map(|channel| {
                let view = self.view_of(channel);
                view.coefficients(self, &offsets, u)
            })
            .collect()
    }

    /// The unknowns `T' y`, from one vector of coefficients per channel.
    pub(super) fn transposed(&self, skies: &[Vec<f64>]) -> Vec<f64> {
        let (offsets, count) = self.offsets();
        let mut u = vec![0.0; count];
        for (channel, sky) in skies.iter().enumerate() {
            for ((l, m, part), value) in degrees_orders_parts(self.l_max[channel]).zip(sky) {
                let scaled = self.scale[channel][l] * value;
                for source in 0..=channel {
                    u[offsets[source] + index_of(self.l_max[source], l, m, part)] +=
                        self.share(l, channel, source) * scaled;
                }
            }
        }
        u
    }

    /// The view at the frequency of a channel.
    pub(super) fn view_of(&self, channel: usize) -> View {
        let shares = |l: usize| (0..=channel).map(|source| self.share(l, channel, source)).collect();
        View {
            frequency_hz: self.frequencies_hz[channel],
            l_max: self.l_max[channel],
            scale: self.scale[channel].clone(),
            shares: (0..=self.l_max[channel]).map(shares).collect(),
            undetermined: vec![0.0; self.l_max[channel] + 1],
        }
    }

    /// The view at any frequency in the range of the channels: the conditional mean given the channels.
    ///
    /// Mean and dipole have no prior power to scale them, and that of other degrees scatters from channel to channel. So they are given
    /// relative to `free`, amplitudes of mean and dipole in each channel: between channels these follow power laws.
    pub(super) fn view_at(
        &self,
        frequency_hz: f64,
        free: &[[f64; FREE_DEGREES]],
    ) -> Result<View, SolveError> {
        if let Some(channel) = self.frequencies_hz.iter().position(|channel_hz| *channel_hz == frequency_hz) {
            return Ok(self.view_of(channel));
        }
        let nearest = |is_on_side: &dyn Fn(f64) -> bool| {
            (0..self.channels()).filter(|channel| is_on_side(self.frequencies_hz[*channel])).min_by(|a, b| {
                let distance = |channel: usize| (self.frequencies_hz[channel] / frequency_hz).ln().abs();
                distance(*a).total_cmp(&distance(*b))
            })
        };
        let (below, above) = (nearest(&|hz| hz < frequency_hz), nearest(&|hz| hz > frequency_hz));
        let (Some(below), Some(above)) = (below, above) else {
            let ends = self
                .frequencies_hz
                .iter()
                .fold([f64::INFINITY, 0.0], |[low, high]: [f64; 2], hz| [low.min(*hz), high.max(*hz)]);
            return Err(SolveError::BeyondChannels { frequency_hz, ends_hz: ends });
        };
        let l_max = self.l_max[below].min(self.l_max[above]);
        let [low, high] = [below, above].map(|channel| self.frequencies_hz[channel]);
        let share = (frequency_hz / low).ln() / (high / low).ln();
        let ln = |channel: usize, l: usize| {
            let own = || self.scale[channel][l] * self.covariance.amplitudes(l)[channel];
            free[channel].get(l).copied().unwrap_or_else(own).ln()
        };
        let scale =
            (0..=l_max).map(|l| ((1.0 - share) * ln(below, l) + share * ln(above, l)).exp()).collect();
        let of_degree = |l: usize| {
            let given = &self.frequencies_hz[..self.channels_with_degree(l)];
            self.between(l, given, frequency_hz, free)
        };
        let (shares, undetermined) =
            (0..=l_max).map(of_degree).collect::<Result<Vec<_>, SolveError>>()?.into_iter().unzip();
        Ok(View { frequency_hz, l_max, scale, shares, undetermined })
    }

    /// The coefficients q at a frequency between the `given` channels, and the variance that they leave.
    fn between(
        &self,
        l: usize,
        given: &[f64],
        frequency_hz: f64,
        free: &[[f64; FREE_DEGREES]],
    ) -> Result<(Vec<f64>, f64), SolveError> {
        let own = self.covariance.correlation(l);
        let smooth = || Correlation {
            own_share: FREE_INDEPENDENT_FRACTION,
            length: own.length.max(FREE_LENGTH_MIN),
            ..own
        };
        let correlation = if l < FREE_DEGREES { smooth() } else { own };
        let factor = correlation.cholesky_factor(given)?;
        let shares = conditional(&factor, correlation, given, frequency_hz);
        let left = (1.0 - shares.iter().map(|q| q * q).sum::<f64>()).max(0.0);
        if l >= FREE_DEGREES {
            return Ok((shares, left));
        }
        // q' factor^-1 are the coefficients of the channels' maps; they are converted to coefficients of the unknowns.
        let mut map_weights = Mat::from_fn(shares.len(), 1, |k, _| shares[k]);
        solve_upper_triangular_in_place(factor.as_ref().transpose(), map_weights.as_mut(), Par::Seq);
        // An amplitude that all channels have is that of frequencies between them, too, as it is free: shares of it add up to one.
        let total: f64 = map_weights.col(0).iter().sum();
        let of_unknown = |source: usize| {
            let of_channel = |channel: usize| {
                let relative = self.scale[channel][l] / free[channel][l];
                map_weights[(channel, 0)] / total * relative * self.share(l, channel, source)
            };
            (0..self.channels()).map(of_channel).sum()
        };
        Ok(((0..self.channels()).map(of_unknown).collect(), left))
    }
}

impl View {
    /// The coefficients of the map for these unknowns.
    pub(super) fn coefficients(&self, prior: &Prior, offsets: &[usize], u: &[f64]) -> Vec<f64> {
        let of_unknown = |(l, m, part): (usize, usize, usize)| {
            let of_channel = |(channel, q): (usize, &f64)| {
                q * u[offsets[channel] + index_of(prior.l_max[channel], l, m, part)]
            };
            let sum: f64 =
                self.shares[l].iter().enumerate().take(prior.channels_with_degree(l)).map(of_channel).sum();
            self.scale[l] * sum
        };
        degrees_orders_parts(self.l_max).map(of_unknown).collect()
    }

    /// The view truncated to a lower maximum degree.
    pub(super) fn truncated(mut self, l_max: usize) -> Self {
        self.l_max = self.l_max.min(l_max);
        self.scale.truncate(self.l_max + 1);
        self.shares.truncate(self.l_max + 1);
        self.undetermined.truncate(self.l_max + 1);
        self
    }
}

/// The coefficients `q = factor^-1 rho` of the unknowns at a frequency, by forward substitution.
fn conditional(
    factor: &Mat<f64>,
    correlation: Correlation,
    channels_hz: &[f64],
    frequency_hz: f64,
) -> Vec<f64> {
    let mut shares: Vec<f64> = Vec::new();
    for (channel, channel_hz) in channels_hz.iter().enumerate() {
        let known: f64 = shares.iter().enumerate().map(|(source, q)| q * factor[(channel, source)]).sum();
        shares.push((correlation.between(*channel_hz, frequency_hz) - known) / factor[(channel, channel)]);
    }
    shares
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prior() -> Prior {
        let scale = vec![vec![3.0, 2.0, 1.0, 0.5], vec![6.0, 4.0, 2.5], vec![1.0, 1.0, 1.0]];
        Prior::new(scale, Covariance::constant(vec![10e6, 5e6, 20e6], 3, 1.5, 0.01)).unwrap()
    }

    /// Compares T T' with the covariance of the prior, element by element.
    #[test]
    fn skies_have_the_covariance_of_the_prior() {
        let prior = prior();
        let (_, count) = prior.offsets();
        let unit = |k: usize| (0..count).map(|j| f64::from(u8::from(j == k))).collect::<Vec<f64>>();
        let columns: Vec<Vec<Vec<f64>>> = (0..count).map(|k| prior.skies(&unit(k))).collect();
        for (a, a_hz) in prior.frequencies_hz.iter().enumerate() {
            for (b, b_hz) in prior.frequencies_hz.iter().enumerate() {
                for (l, m, part) in [(0, 0, 0), (1, 1, 1), (2, 1, 0)] {
                    let at = |channel: usize| index_of(prior.l_max[channel], l, m, part);
                    let found: f64 = columns.iter().map(|sky| sky[a][at(a)] * sky[b][at(b)]).sum();
                    let ln_ratio = f64::ln(a_hz / b_hz);
                    let alike = if l < 2 { 0.0 } else { 0.99 * (-ln_ratio * ln_ratio / 4.5).exp() };
                    let correlation = if a == b { 1.0 } else { alike };
                    let expected = prior.scale[a][l] * prior.scale[b][l] * correlation;
                    assert!((found - expected).abs() < 1e-12, "{a} {b} {l}: {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn transposed_is_the_transpose() {
        let prior = prior();
        let (_, count) = prior.offsets();
        let wave = |count: usize, f: f64| (0..count).map(|k| (f * k as f64).sin()).collect::<Vec<f64>>();
        let (u, skies) = (wave(count, 0.7), [wave(16, 0.3), wave(9, 1.1), wave(9, 2.3)]);
        let left: f64 =
            prior.skies(&u).iter().flatten().zip(skies.iter().flatten()).map(|(a, b)| a * b).sum();
        let right: f64 = prior.transposed(&skies).iter().zip(&u).map(|(a, b)| a * b).sum();
        assert!((left - right).abs() < 1e-12 * left.abs(), "{left} {right}");
    }

    /// Compares with the explicit formulas of conditional Gaussians for two channels.
    #[test]
    fn a_frequency_between_is_the_most_likely_given_its_neighbours() {
        let covariance = Covariance::constant(vec![4e6, 9e6], 2, 1.0, 1e-15);
        let prior = Prior::new(vec![vec![2.0; 3], vec![1.0; 3]], covariance).unwrap();
        let free = [[2.0; FREE_DEGREES], [1.0; FREE_DEGREES]];
        let view = prior.view_at(6e6, &free).unwrap();
        let (r, q) = ((-0.5 * (9.0_f64 / 4.0).ln().powi(2)).exp(), (-0.5 * 1.5_f64.ln().powi(2)).exp());
        // rho' C^-1 rho for rho = (q, q), C = (1 r; r 1).
        let explained = 2.0 * q * q / (1.0 + r);
        assert!((view.undetermined[2] - (1.0 - explained)).abs() < 1e-12, "{:?}", view.undetermined);
        // At the geometric mean of 4 and 9 MHz the scale is the geometric mean of both channels' scales.
        assert!((view.scale[1] - 2.0_f64.sqrt()).abs() < 1e-12);
        assert!(prior.view_at(3e6, &free).is_err() && prior.view_at(10e6, &free).is_err());
    }

    /// A mean that falls as frequency to the -2.5 stays so between channels, however the estimated powers of the channels scatter.
    #[test]
    fn a_mean_between_channels_follows_a_power_law() {
        let (frequencies_hz, scatter) = (vec![10e6, 5e6, 3e6], [1.2, 0.8, 1.15]);
        let law = |hz: f64| (hz / 1e7).powf(-2.5);
        let scale = |(hz, scatter): (&f64, f64)| vec![1e3 * scatter * law(*hz); 3];
        let scale = frequencies_hz.iter().zip(scatter).map(scale).collect();
        let covariance = Covariance::constant(frequencies_hz.clone(), 2, 1.5, 0.01);
        let prior = Prior::new(scale, covariance).unwrap();
        let (offsets, count) = prior.offsets();
        // Unknowns of which the channels' means are the law, by forward substitution.
        let mut u = vec![0.0; count];
        for channel in 0..prior.channels() {
            let share = |source: usize| prior.share(0, channel, source) * prior.scale[channel][0];
            let known: f64 = (0..channel).map(|source| share(source) * u[offsets[source]]).sum();
            u[offsets[channel]] = (law(frequencies_hz[channel]) - known) / share(channel);
        }
        let free: Vec<[f64; FREE_DEGREES]> = frequencies_hz.iter().map(|hz| [law(*hz), 1.0]).collect();
        for hz in [4e6, 7e6, 9e6] {
            let view = prior.view_at(hz, &free).unwrap();
            let found = view.coefficients(&prior, &offsets, &u)[0];
            // Cholesky factors of nearly equal channels (1e-6) keep half of the digits.
            assert!((found / law(hz) - 1.0).abs() < 1e-6, "{hz} {found} {}", law(hz));
        }
    }
}
