//! The posterior of all channels: its mean, samples, and the maps of both; with total powers in rounds, in which their weights are found.

use std::ops::RangeInclusive;

use serde::Serialize;

use super::powers::{PowerAgreement, PowerPriors, PowerRows, WeightedRows};
use super::prior::{Prior, View};
use super::spectrum::{SpectralMaps, SpectrumFit};
use super::sums::{COUPLED_MAX, JointSums, ScaledBlocks, joint_blocks, joint_coupling, scaled_blocks};
use crate::imaging::SolveError;
use crate::imaging::circle::{NOISES_TOGETHER, coefficients, degrees, view_sigma_k};
use crate::imaging::power::{
    Block, Coupling, FREE_DEGREES, Factors, PosteriorPrecision, PosteriorSample, SAMPLE_TOLERANCE, SkyPower,
};
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::{Convergence, NamedWatch, StoppingRule, System, dot};
use crate::imaging::{NormalSums, SumCounts};
use crate::sky::harmonics::synthesis;
use crate::units::{StreamKind, frequency_folder, random_stream};
use rand_distr::{Distribution, StandardNormal};

/// Rounds before the last solution: with weights from the measured powers, then from a map.
const ROUNDS: usize = 2;

/// Parameters of a joint solution.
#[derive(Clone, Debug, PartialEq)]
pub struct JointRequest {
    /// Stopping rule.
    pub rule: StoppingRule,
    /// Number of posterior samples, whose scatter gives the errors of spectra and means.
    pub samples: usize,
    /// Further frequencies between the channels at which maps are made, Hz.
    pub at_hz: Vec<f64>,
    /// Priors of the total powers; `None` to leave them out.
    pub powers: Option<PowerPriors>,
}

impl JointRequest {
    /// Checks the request against the frequencies of the channels, before minutes of work.
    ///
    /// # Errors
    /// There is one channel without total powers, or two of one frequency; a frequency is outside the range of the channels, or nearly that of
    /// another map.
    pub fn check(&self, channels_hz: &[f64], with_powers: bool) -> Result<(), SolveError> {
        let mut frequencies_hz = channels_hz.to_vec();
        frequencies_hz.sort_by(f64::total_cmp);
        frequencies_hz.dedup();
        let fewest = if self.powers.is_some() && with_powers { 1 } else { 2 };
        let (channels, frequencies) = (channels_hz.len(), frequencies_hz.len());
        if frequencies < fewest || frequencies < channels {
            return Err(SolveError::FewChannels { channels, frequencies });
        }
        let ends_hz = [frequencies_hz[0], frequencies_hz[frequencies - 1]];
        if let Some(&frequency_hz) = self.at_hz.iter().find(|hz| !(ends_hz[0]..=ends_hz[1]).contains(*hz)) {
            return Err(SolveError::BeyondChannels { frequency_hz, ends_hz });
        }
        frequencies_hz.extend(&self.at_hz);
        frequencies_hz.sort_by(f64::total_cmp);
        frequencies_hz.dedup();
        let is_near = |pair: &&[f64]| frequency_folder(pair[0]) == frequency_folder(pair[1]);
        match frequencies_hz.windows(2).find(is_near) {
            Some(pair) => Err(SolveError::NearFrequencies { pair_hz: [pair[0], pair[1]] }),
            None => Ok(()),
        }
    }

    /// Requires one constant of the total powers, or one for each of a number of channels in a range.
    ///
    /// # Errors
    /// [`SolveError::PowerConstants`].
    pub fn check_constants(&self, channels: RangeInclusive<usize>) -> Result<(), SolveError> {
        let found = self.powers.as_ref().map_or(1, |priors| priors.constant_k_sr.len());
        match found == 1 || channels.contains(&found) {
            true => Ok(()),
            false => Err(SolveError::PowerConstants { found, channels: *channels.end() }),
        }
    }
}

/// A map at one frequency.
#[derive(Clone, Debug, PartialEq)]
pub struct JointMap {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Map, K, HEALPix RING, ecliptic.
    pub map_k: Vec<f64>,
    /// Standard deviation of every pixel, K.
    pub sigma_k: Vec<f64>,
    /// Standard deviation of the map's mean, from samples, K.
    pub mean_sigma_k: f64,
    /// Agreement of the channel's data with the joint map; `None` between channels.
    pub agreement: Option<Agreement>,
    /// The total powers in the fit of the channel; `None` if there are none.
    pub powers: Option<PowerAgreement>,
}

/// Agreement of a channel's data with the joint map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// Reduced chi-square of the data with the map of the single channel.
    pub chi_square_alone: f64,
    /// Reduced chi-square of the data with the joint map.
    pub chi_square: f64,
    /// Increase of chi-square from the first to the second, per coefficient that the channel's data determine: of order 1 if the joint map
    /// differs from the channel's own by no more than noise.
    pub strain: f64,
}

/// Sums of all channels with the weights of their powers, what preconditions them, and a solution from which to begin.
type WeightedEquations<'a> = (JointSums<'a>, Approximation, Option<Vec<f64>>);

/// The scaled blocks, and what couples them in the unknowns of the prior.
pub(super) struct Approximation {
    pub(super) scaled: Vec<ScaledBlocks>,
    pub(super) coupling: Coupling,
}

/// The sums of all channels with their blocks.
pub(super) struct Equations<'a> {
    pub(super) prior: &'a Prior,
    pub(super) sums: &'a [&'a (dyn NormalSums + Sync)],
    pub(super) blocks: &'a [Vec<Block<'a>>],
    /// What couples the blocks of each channel.
    pub(super) couplings: Vec<Option<&'a Coupling>>,
    pub(super) noise_factors: &'a [f64],
}

impl<'a> Equations<'a> {
    pub(super) fn joint(&self, powers: Vec<Option<WeightedRows<'a>>>) -> (JointSums<'a>, Approximation) {
        let power_blocks: Vec<_> =
            powers.iter().map(|powers| powers.as_ref().map(WeightedRows::blocks)).collect();
        let scaled = scaled_blocks(self.prior, self.blocks, self.noise_factors, &power_blocks);
        let of_powers = powers.iter().zip(&power_blocks);
        let of_powers: Vec<Option<Coupling>> =
            of_powers.map(|(powers, blocks)| Some(powers.as_ref()?.coupling(blocks.as_ref()?))).collect();
        let coupling =
            joint_coupling(self.prior, &self.couplings, self.noise_factors, &of_powers, COUPLED_MAX);
        (
            JointSums::new(self.prior, self.sums.to_vec(), self.noise_factors.to_vec()).with_powers(powers),
            Approximation { scaled, coupling },
        )
    }

    /// Finds the weights of the powers in rounds. Returns the equations, with a solution from which to begin.
    pub(super) fn with_powers(
        &self,
        rows: &'a [Option<PowerRows>],
        request: &JointRequest,
        watch: NamedWatch<'_>,
    ) -> Result<WeightedEquations<'a>, SolveError> {
        let weighted =
            |rows: &'a Option<PowerRows>| rows.as_ref().map(|rows| rows.weighted(&rows.measured(), 1.0));
        let (mut joint, mut approximation) = self.joint(rows.iter().map(weighted).collect());
        let mut start = None;
        let rounds = if rows.iter().any(Option::is_some) { ROUNDS } else { 0 };
        let request = JointRequest { samples: 0, ..request.clone() };
        for _ in 0..rounds {
            let posterior = Posterior::new(&joint, &approximation, &request, start.as_deref(), watch)?;
            let weighted = |(channel, rows): (usize, &'a Option<PowerRows>)| {
                let (rows, before) = (rows.as_ref()?, joint.powers(channel)?);
                let x = posterior.coefficients(&self.prior.view_of(channel), &posterior.solution);
                // Residuals in excess of the noise count as noise.
                let noise = before.agreement(&x).chi_square.max(1.0);
                Some(rows.weighted(&rows.model(&x), noise))
            };
            let weighted = rows.iter().enumerate().map(weighted).collect();
            start = Some(posterior.solution);
            (joint, approximation) = self.joint(weighted);
        }
        Ok((joint, approximation, start))
    }
}

/// The posterior mean and samples in the unknowns of the prior.
pub(super) struct Posterior<'a> {
    sums: &'a JointSums<'a>,
    blocks: Vec<Block<'static>>,
    offsets: Vec<usize>,
    pub(super) solution: Vec<f64>,
    /// Posterior samples without the mean, with those of the blocks from the same random numbers.
    samples: Vec<PosteriorSample>,
    pub(super) convergence: Convergence,
}

impl<'a> Posterior<'a> {
    pub(super) fn new(
        sums: &'a JointSums<'a>,
        approximation: &Approximation,
        request: &JointRequest,
        start: Option<&[f64]>,
        watch: NamedWatch<'_>,
    ) -> Result<Self, SolveError> {
        let blocks = joint_blocks(sums.prior, &approximation.scaled);
        let (offsets, count) = sums.prior.offsets();
        let unit = unit_regularisation(sums.prior);
        let factors = Factors::coupled(&blocks, &approximation.coupling, &unit);
        let regularisation = Diagonal::Uniform(1.0);
        let precondition = |v: &mut [f64]| factors.solve(v);
        let system = System { sums, regularisation: regularisation.clone(), precondition: &precondition };
        let mut columns = [start.map_or_else(|| vec![0.0; count], <[f64]>::to_vec)];
        let convergence = {
            let task = watch.start("maps", request.rule.residual_max);
            system.solve(&[sums.right_hand_side()], &mut columns, &[request.rule], &task)
        };
        let [solution] = columns;
        let products = |x: &[&[f64]]| sums.apply_all(x);
        let precision = PosteriorPrecision {
            products: &products,
            unknowns: count,
            regularisation: &regularisation,
            factors: &factors,
        };
        let mut samples = Vec::new();
        let numbers: Vec<u64> = (0..request.samples as u64).collect();
        for sample_ids in numbers.chunks(NOISES_TOGETHER) {
            let task = watch.start(&format!("samples from {}", sample_ids[0] + 1), SAMPLE_TOLERANCE);
            samples.extend(precision.draw(sample_ids, SAMPLE_TOLERANCE, &task));
        }
        if let Some(reason) = sums.failure() {
            return Err(SolveError::Sums(reason.to_owned()));
        }
        let convergence = convergence.first().copied().ok_or(SolveError::NoData)?;
        Ok(Self { sums, blocks, offsets, solution, samples, convergence })
    }

    fn prior(&self) -> &Prior {
        self.sums.prior
    }

    /// The coefficients of a view for some unknowns.
    pub(super) fn coefficients(&self, view: &View, unknowns: &[f64]) -> Vec<f64> {
        view.coefficients(self.prior(), &self.offsets, unknowns)
    }

    /// Amplitudes of the mean and of the dipole (rms of its three coefficients) in each channel, K sr^(1/2).
    pub(super) fn amplitudes_of_free(&self) -> Vec<[f64; FREE_DEGREES]> {
        let of_channel = |channel: usize| {
            let view = self.prior().view_of(channel);
            let mut squares = [0.0; FREE_DEGREES];
            for (l, x) in degrees(view.l_max).zip(self.coefficients(&view, &self.solution)) {
                if let Some(square) = squares.get_mut(l) {
                    *square += x * x / (2 * l + 1) as f64;
                }
            }
            // Of a sky without mean or dipole any amplitude serves.
            squares.map(|square| if square > 0.0 { square.sqrt() } else { 1.0 })
        };
        (0..self.prior().channels()).map(of_channel).collect()
    }

    /// Ratio of the variances of posterior samples and those of the blocks by degree, averaged over neighbouring degrees for accuracy.
    fn variance_ratio(&self, view: &View) -> Vec<f64> {
        let mut sums = vec![[0.0; 2]; view.l_max + 1];
        for PosteriorSample { exact, of_blocks } in &self.samples {
            let both = self.coefficients(view, exact).into_iter().zip(self.coefficients(view, of_blocks));
            for (l, (x, y)) in degrees(view.l_max).zip(both) {
                sums[l] = [sums[l][0] + x * x, sums[l][1] + y * y];
            }
        }
        let of_degree = |l: usize| {
            let width = l / 4;
            let near = &sums[l.saturating_sub(width)..(l + width + 1).min(sums.len())];
            let [a, b] = near.iter().fold([0.0, 0.0], |[a, b], [c, d]| [a + c / d, b + 1.0]);
            if a > 0.0 { a / b } else { 1.0 }
        };
        (0..=view.l_max).map(of_degree).collect()
    }

    /// Standard deviation of the part of the coefficients that no channel determines, by degree, K sr^(1/2). For mean and dipole, whose prior
    /// is far above any sky, it is relative to their solution.
    fn undetermined_sigma(&self, view: &View) -> Vec<f64> {
        let mut sigma: Vec<f64> =
            view.undetermined.iter().zip(&view.scale).map(|(variance, s)| s * variance.sqrt()).collect();
        let mut square = vec![0.0; view.l_max + 1];
        for (l, x) in degrees(view.l_max).zip(self.coefficients(view, &self.solution)) {
            square[l] += x * x / (2 * l + 1) as f64;
        }
        for (l, sigma) in sigma.iter_mut().enumerate().take(FREE_DEGREES) {
            *sigma = (view.undetermined[l] * square[l]).sqrt();
        }
        sigma
    }

    /// A posterior sample of a view, including the part that no channel determines.
    pub(super) fn sample(&self, view: &View, number: usize) -> Vec<f64> {
        let mut sky = self.coefficients(view, &self.samples[number].exact);
        crate::imaging::solver::add(&mut sky, &self.coefficients(view, &self.solution));
        let sigma = self.undetermined_sigma(view);
        if sigma.iter().any(|sigma| *sigma > 0.0) {
            let mut stream =
                random_stream(4, StreamKind::Probe, [view.frequency_hz.to_bits(), number as u64]);
            for (x, l) in sky.iter_mut().zip(degrees(view.l_max)) {
                let normal: f64 = StandardNormal.sample(&mut stream);
                *x += sigma[l] * normal;
            }
        }
        sky
    }

    pub(super) fn map(&self, view: &View, nside: usize) -> Result<JointMap, SolveError> {
        let sky = self.coefficients(view, &self.solution);
        let ratio = self.variance_ratio(view);
        let map_k = synthesis(&coefficients(&sky, view.l_max), nside)?;
        let factors = Factors::new(&self.blocks, &unit_regularisation(self.prior()));
        let row = |channel: usize, l: usize| {
            let share = view.shares.get(l).and_then(|shares| shares.get(channel));
            share.map_or(0.0, |share| ratio[l].sqrt() * view.scale[l] * share)
        };
        let undetermined: Vec<f64> =
            self.undetermined_sigma(view).iter().map(|sigma| sigma * sigma).collect();
        let sigma_k = view_sigma_k(&self.blocks, &factors, &row, &undetermined, nside);
        let mean_of = |sky: &[f64]| sky[0] / (4.0 * std::f64::consts::PI).sqrt();
        let variance: f64 = (0..self.samples.len())
            .map(|number| (mean_of(&self.sample(view, number)) - mean_of(&sky)).powi(2))
            .sum();
        let mean_sigma_k = (variance / self.samples.len().max(1) as f64).sqrt();
        Ok(JointMap {
            frequency_hz: view.frequency_hz,
            map_k,
            sigma_k,
            mean_sigma_k,
            agreement: None,
            powers: None,
        })
    }

    pub(super) fn agreement_of_powers(&self, channel: usize, view: &View) -> Option<PowerAgreement> {
        Some(self.sums.powers(channel)?.agreement(&self.coefficients(view, &self.solution)))
    }

    pub(super) fn agreement(
        &self,
        channel: usize,
        (alone, power_alone): (&[f64], &SkyPower),
        view: &View,
    ) -> Agreement {
        let sums = self.sums.channels[channel];
        let SumCounts { visibilities, power, .. } = sums.counts();
        let joint = self.coefficients(view, &self.solution);
        let products = sums.apply_all(&[alone, &joint]);
        let chi_square =
            |x: &[f64], product: &[f64]| power - 2.0 * dot(x, sums.right_hand_side()) + dot(x, product);
        let [before, after] = [chi_square(alone, &products[0]), chi_square(&joint, &products[1])];
        let numbers = 2.0 * visibilities as f64;
        let constrained: f64 = power_alone.constrained.iter().sum();
        let factor = power_alone.noise_factor.powi(2);
        Agreement {
            chi_square_alone: before / numbers,
            chi_square: after / numbers,
            strain: (after - before) / (factor * constrained.max(1.0)),
        }
    }

    /// Spectra at the resolution of the coarsest channel.
    pub(super) fn spectra(&self, views: &[View], nside: usize) -> Result<SpectralMaps, SolveError> {
        let l_max = views.iter().map(|view| view.l_max).min().unwrap_or(0);
        let views: Vec<View> = views.iter().map(|view| view.clone().truncated(l_max)).collect();
        let frequencies_hz: Vec<f64> = views.iter().map(|view| view.frequency_hz).collect();
        let maps = |sky: &dyn Fn(&View) -> Vec<f64>| -> Result<Vec<Vec<f64>>, SolveError> {
            let map =
                |view: &View| synthesis(&coefficients(&sky(view), l_max), nside).map_err(SolveError::from);
            views.iter().map(map).collect()
        };
        let mut spectra =
            SpectrumFit::new(&frequencies_hz, &maps(&|view| self.coefficients(view, &self.solution))?);
        for number in 0..self.samples.len() {
            spectra.add_sample(&maps(&|view| self.sample(view, number))?);
        }
        Ok(spectra.finish())
    }
}

fn unit_regularisation(prior: &Prior) -> Vec<f64> {
    vec![1.0; prior.l_max.first().map_or(1, |l_max| l_max + 1)]
}
