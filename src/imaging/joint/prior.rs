//! What is expected of the sky's coefficients at several frequencies together.
//!
//! The coefficients of one degree and order at frequencies nu and nu' are Gaussian with
//!
//! ```text
//! <x(nu) x(nu')> = s_l(nu) s_l(nu') rho(nu, nu'),     s_l^2 = C_l of the channel alone,
//! rho = (1 - p) exp(-(ln nu / nu')^2 / (2 L^2)) + p [nu = nu']
//! ```
//!
//! L says over how many e-foldings of frequency the sky keeps its structure, p which share of its power is each channel's own. A power law
//! with curvature at every point is of this kind, and so is one that turns over.

use faer::linalg::triangular_solve::solve_upper_triangular_in_place;
use faer::{Mat, Par, Side};
use serde::Serialize;

use crate::imaging::solver::SolveError;

/// Degrees whose prior is free: mean and dipole.
pub(super) const FREE: usize = 2;
/// What stands for no own share: the least that has a Cholesky factor for channels close to each other.
const OWN_SHARE_OF_FREE: f64 = 1e-6;

/// How alike the sky's structure is at different frequencies.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Likeness {
    /// L: e-foldings of frequency over which structure stays alike.
    pub length: f64,
    /// p: share of the power that a channel has in common with no other.
    pub own_share: f64,
}

impl Likeness {
    /// The correlation of two channels.
    pub(super) fn between(self, a_hz: f64, b_hz: f64) -> f64 {
        let own = if a_hz == b_hz { self.own_share } else { 0.0 };
        (1.0 - self.own_share) * (-0.5 * ((a_hz / b_hz).ln() / self.length).powi(2)).exp() + own
    }

    /// The lower Cholesky factor of the channels' correlations. That of the first few channels is its upper left corner.
    pub(super) fn root(self, frequencies_hz: &[f64]) -> Result<Mat<f64>, SolveError> {
        let count = frequencies_hz.len();
        let matrix = Mat::from_fn(count, count, |i, j| self.between(frequencies_hz[i], frequencies_hz[j]));
        let factor = matrix.llt(Side::Lower).map_err(|_| SolveError::NoPower)?;
        Ok(factor.L().to_owned())
    }
}

/// The prior of several channels: `x = T u`, with unit normal numbers u. Channels are in the order of falling l_max, so that those that have
/// a degree are the first few.
#[derive(Clone, Debug)]
pub(super) struct Prior {
    pub(super) frequencies_hz: Vec<f64>,
    /// Greatest degree of each channel, falling.
    pub(super) l_max: Vec<usize>,
    /// s_l of each channel, K sr^(1/2).
    pub(super) scale: Vec<Vec<f64>>,
    pub(super) likeness: Likeness,
    root: Mat<f64>,
}

/// A map at some frequency as the unknowns say it: `x_lm = s_l sum_k q_k u_k,lm`, and what they leave open.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub(super) frequency_hz: f64,
    pub(super) l_max: usize,
    pub(super) scale: Vec<f64>,
    /// q of each channel; at a degree those of the channels that have it count.
    pub(super) shares: Vec<f64>,
    /// The same for mean and dipole, no share of which is a channel's own.
    pub(super) shares_of_free: Vec<f64>,
    /// Variance of `x_lm / s_l` that no channel decides, by degree: 0 at a channel's own frequency.
    pub(super) open: Vec<f64>,
}

impl Prior {
    pub(super) fn new(
        frequencies_hz: Vec<f64>,
        scale: Vec<Vec<f64>>,
        likeness: Likeness,
    ) -> Result<Self, SolveError> {
        let l_max = scale.iter().map(|scale| scale.len() - 1).collect();
        let root = likeness.root(&frequencies_hz)?;
        Ok(Self { frequencies_hz, l_max, scale, likeness, root })
    }

    pub(super) fn with(&self, likeness: Likeness) -> Result<Self, SolveError> {
        Self::new(self.frequencies_hz.clone(), self.scale.clone(), likeness)
    }

    pub(super) fn channels(&self) -> usize {
        self.l_max.len()
    }

    /// Channels that have a degree: the first few.
    pub(super) fn of_degree(&self, l: usize) -> usize {
        self.l_max.iter().take_while(|l_max| **l_max >= l).count()
    }

    /// `T[channel][unknown of channel]` without the scale.
    pub(super) fn share(&self, channel: usize, of: usize) -> f64 {
        if of <= channel { self.root[(channel, of)] } else { 0.0 }
    }

    /// Where the unknowns of each channel begin, and how many there are.
    pub(super) fn offsets(&self) -> (Vec<usize>, usize) {
        let mut next = 0;
        let offsets = self.l_max.iter().map(|l_max| {
            let offset = next;
            next += (l_max + 1).pow(2);
            offset
        });
        (offsets.collect(), next)
    }

    /// The skies of unknowns: `T u`, a vector of coefficients a channel.
    pub(super) fn skies(&self, u: &[f64]) -> Vec<Vec<f64>> {
        let (offsets, _) = self.offsets();
        (0..self.channels())
            .map(|channel| {
                let view = self.view_of(channel);
                view.coefficients(self, &offsets, u)
            })
            .collect()
    }

    /// `T' y` of a vector of coefficients a channel.
    pub(super) fn transposed(&self, skies: &[Vec<f64>]) -> Vec<f64> {
        let (offsets, count) = self.offsets();
        let mut u = vec![0.0; count];
        for (channel, sky) in skies.iter().enumerate() {
            let mut place = 0;
            for_each_unknown(self.l_max[channel], &mut |l, m, part| {
                let scaled = self.scale[channel][l] * sky[place];
                place += 1;
                for of in 0..=channel {
                    u[offsets[of] + place_of(self.l_max[of], l, m, part)] += self.share(channel, of) * scaled;
                }
            });
        }
        u
    }

    /// The map of a channel.
    pub(super) fn view_of(&self, channel: usize) -> View {
        let shares: Vec<f64> = (0..=channel).map(|of| self.share(channel, of)).collect();
        View {
            frequency_hz: self.frequencies_hz[channel],
            l_max: self.l_max[channel],
            scale: self.scale[channel].clone(),
            shares_of_free: shares.clone(),
            shares,
            open: vec![0.0; self.l_max[channel] + 1],
        }
    }

    /// The map at a frequency among those of the channels: the most likely one given theirs.
    ///
    /// # Errors
    /// A frequency beyond all channels.
    pub(super) fn view_at(&self, frequency_hz: f64) -> Result<View, SolveError> {
        if let Some(channel) = self.frequencies_hz.iter().position(|own| *own == frequency_hz) {
            return Ok(self.view_of(channel));
        }
        let nearest = |is_side: &dyn Fn(f64) -> bool| {
            (0..self.channels()).filter(|channel| is_side(self.frequencies_hz[*channel])).min_by(|a, b| {
                let far = |channel: usize| (self.frequencies_hz[channel] / frequency_hz).ln().abs();
                far(*a).total_cmp(&far(*b))
            })
        };
        let (below, above) = (nearest(&|own| own < frequency_hz), nearest(&|own| own > frequency_hz));
        let (Some(below), Some(above)) = (below, above) else {
            let ends = self
                .frequencies_hz
                .iter()
                .fold([f64::INFINITY, 0.0], |[low, high]: [f64; 2], own| [low.min(*own), high.max(*own)]);
            return Err(SolveError::BeyondChannels { frequency_hz, ends_hz: ends });
        };
        let l_max = self.l_max[below].min(self.l_max[above]);
        let [low, high] = [below, above].map(|channel| self.frequencies_hz[channel]);
        let share = (frequency_hz / low).ln() / (high / low).ln();
        let ln = |channel: usize, l: usize| self.scale[channel][l].ln();
        let scale =
            (0..=l_max).map(|l| ((1.0 - share) * ln(below, l) + share * ln(above, l)).exp()).collect();
        let shares = conditional(&self.root, self.likeness, &self.frequencies_hz, frequency_hz);
        let left = |shares: &[f64]| (1.0 - shares.iter().map(|q| q * q).sum::<f64>()).max(0.0);
        let smooth = Likeness { own_share: OWN_SHARE_OF_FREE, ..self.likeness };
        let root = smooth.root(&self.frequencies_hz)?;
        let of_smooth = conditional(&root, smooth, &self.frequencies_hz, frequency_hz);
        let of_degree =
            |l: usize| if l < FREE { left(&of_smooth) } else { left(&shares[..self.of_degree(l)]) };
        let open = (0..=l_max).map(of_degree).collect();
        // In terms of these unknowns: q' root^-1 is what each channel's map counts for.
        let mut counts = Mat::from_fn(of_smooth.len(), 1, |k, _| of_smooth[k]);
        solve_upper_triangular_in_place(root.as_ref().transpose(), counts.as_mut(), Par::Seq);
        let of_unknown = |of: usize| {
            (0..self.channels()).map(|channel| counts[(channel, 0)] * self.share(channel, of)).sum()
        };
        let shares_of_free = (0..self.channels()).map(of_unknown).collect();
        Ok(View { frequency_hz, l_max, scale, shares, shares_of_free, open })
    }
}

impl View {
    /// Its coefficients.
    pub(super) fn coefficients(&self, prior: &Prior, offsets: &[usize], u: &[f64]) -> Vec<f64> {
        let mut sky = Vec::with_capacity((self.l_max + 1).pow(2));
        for_each_unknown(self.l_max, &mut |l, m, part| {
            let of_channel =
                |(of, q): (usize, &f64)| q * u[offsets[of] + place_of(prior.l_max[of], l, m, part)];
            let shares = if l < FREE { &self.shares_of_free } else { &self.shares };
            let sum: f64 = shares.iter().enumerate().take(prior.of_degree(l)).map(of_channel).sum();
            sky.push(self.scale[l] * sum);
        });
        sky
    }

    /// The same, up to a lesser degree.
    pub(super) fn cut(mut self, l_max: usize) -> Self {
        self.l_max = self.l_max.min(l_max);
        self.scale.truncate(self.l_max + 1);
        self.open.truncate(self.l_max + 1);
        self
    }
}

/// `q = root^-1 rho`, step by step: what a frequency has of each unknown.
fn conditional(root: &Mat<f64>, likeness: Likeness, channels_hz: &[f64], frequency_hz: f64) -> Vec<f64> {
    let mut shares: Vec<f64> = Vec::new();
    for (channel, channel_hz) in channels_hz.iter().enumerate() {
        let known: f64 = shares.iter().enumerate().map(|(of, q)| q * root[(channel, of)]).sum();
        shares.push((likeness.between(*channel_hz, frequency_hz) - known) / root[(channel, channel)]);
    }
    shares
}

/// Degree, order and part of each unknown of a map, in their order.
fn for_each_unknown(l_max: usize, take: &mut dyn FnMut(usize, usize, usize)) {
    for m in 0..=l_max {
        for l in m..=l_max {
            for part in 0..if m == 0 { 1 } else { 2 } {
                take(l, m, part);
            }
        }
    }
}

/// Where an unknown is among those of a map.
pub(super) fn place_of(l_max: usize, l: usize, m: usize, part: usize) -> usize {
    // Before order m: l_max + 1 of order 0, and 2 (l_max + 1 - k) of each order k below m.
    if m == 0 { l } else { (l_max + 1) * (2 * m - 1) - m * (m - 1) + 2 * (l - m) + part }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prior() -> Prior {
        let scale = vec![vec![3.0, 2.0, 1.0, 0.5], vec![6.0, 4.0, 2.5], vec![1.0, 1.0, 1.0]];
        Prior::new(vec![10e6, 5e6, 20e6], scale, Likeness { length: 1.5, own_share: 0.01 }).unwrap()
    }

    #[test]
    fn places_follow_the_order_of_unknowns() {
        for l_max in [0, 1, 5] {
            let mut next = 0;
            for_each_unknown(l_max, &mut |l, m, part| {
                assert_eq!(place_of(l_max, l, m, part), next);
                next += 1;
            });
            assert_eq!(next, (l_max + 1).pow(2));
        }
    }

    /// The covariance of skies is that of the law, element by element: T T' against the law written out.
    #[test]
    fn skies_of_unit_numbers_have_the_covariance_of_the_law() {
        let prior = prior();
        let (_, count) = prior.offsets();
        let unit = |k: usize| (0..count).map(|j| f64::from(u8::from(j == k))).collect::<Vec<f64>>();
        let columns: Vec<Vec<Vec<f64>>> = (0..count).map(|k| prior.skies(&unit(k))).collect();
        for (a, a_hz) in prior.frequencies_hz.iter().enumerate() {
            for (b, b_hz) in prior.frequencies_hz.iter().enumerate() {
                for (l, m, part) in [(0, 0, 0), (1, 1, 1), (2, 1, 0)] {
                    let at = |channel: usize| place_of(prior.l_max[channel], l, m, part);
                    let found: f64 = columns.iter().map(|sky| sky[a][at(a)] * sky[b][at(b)]).sum();
                    let apart = f64::ln(a_hz / b_hz);
                    let alike = 0.99 * (-apart * apart / 4.5).exp() + if a == b { 0.01 } else { 0.0 };
                    let expected = prior.scale[a][l] * prior.scale[b][l] * alike;
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

    /// By the formulas of conditional Gaussians for two channels, written out.
    #[test]
    fn a_frequency_between_is_the_most_likely_given_its_neighbours() {
        let likeness = Likeness { length: 1.0, own_share: 0.0 };
        let prior = Prior::new(vec![4e6, 9e6], vec![vec![2.0; 3], vec![1.0; 3]], likeness).unwrap();
        let view = prior.view_at(6e6).unwrap();
        let (r, q) = ((-0.5 * (9.0_f64 / 4.0).ln().powi(2)).exp(), (-0.5 * 1.5_f64.ln().powi(2)).exp());
        // rho' C^-1 rho for rho = (q, q), C = (1 r; r 1).
        let explained = 2.0 * q * q / (1.0 + r);
        assert!((view.open[2] - (1.0 - explained)).abs() < 1e-12, "{:?}", view.open);
        // The geometric mean of 4 and 9 MHz: the scale is that of both channels.
        assert!((view.scale[1] - 2.0_f64.sqrt()).abs() < 1e-12);
        assert!(prior.view_at(3e6).is_err() && prior.view_at(10e6).is_err());
    }
}
