//! Estimates the correlation between channels, then solves for all channels together.

use std::collections::BTreeMap;

use serde::Serialize;

use super::powers::{PowerAgreement, PowerPriors, PowerRows, PowerSample};
use super::prior::{Correlation, FREE, Prior, View};
use super::rounds::Equations;
use super::spectrum::{SpectralMaps, SpectrumFit};
use super::sums::{JointSums, ScaledBlocks, joint_blocks, scaled_blocks};
use crate::imaging::circle::{HarmonicSums, NOISES_TOGETHER, coefficients, degrees, view_sigma_k};
use crate::imaging::power::{
    Block, Factors, FoundPower, PosteriorPrecision, PosteriorSample, PowerProblem, SAMPLE_TOLERANCE,
    SkyPower, value,
};
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::{Convergence, NamedWatch, SolveError, SolveWatch, StoppingRule, System, dot};
use crate::imaging::{NormalSums, SumCounts};
use crate::sky::harmonics::synthesis;
use crate::units::{StreamKind, random_stream};
use rand_distr::{Distribution, StandardNormal};

/// Correlation lengths of the initial grid.
const LENGTHS: [f64; 5] = [0.5, 1.0, 2.0, 4.0, 8.0];
/// Independent fractions of the initial grid.
const OWN_SHARES: [f64; 4] = [1e-4, 1e-3, 1e-2, 1e-1];
/// Factor to which the parameters are determined.
const FACTOR_MIN: f64 = 1.05;
/// Bounds of the search, beyond which the evidence does not change.
const LENGTH_MAX: f64 = 64.0;
const OWN_SHARE_RANGE: [f64; 2] = [1e-7, 0.999];
/// Prior power of the free degrees in units of that of l = 2.
const FREE_FACTORS: [f64; FREE] = [1e6, 1e4];

/// The sums of a channel.
pub struct JointChannel {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// nside of its map.
    pub nside: usize,
    /// Normal equations over harmonics.
    pub sums: Box<HarmonicSums>,
    /// Total powers of its daughters, by daughter and time.
    pub powers: Vec<PowerSample>,
}

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

/// A joint solution.
#[derive(Clone, Debug, PartialEq)]
pub struct JointSolution {
    /// Correlation between channels; `None` for one alone.
    pub likeness: Option<Correlation>,
    /// Maps at all frequencies, in increasing order.
    pub maps: Vec<JointMap>,
    /// Spectral index and curvature of every pixel; `None` for a channel alone.
    pub spectra: Option<SpectralMaps>,
    /// Convergence of the iteration.
    pub convergence: Convergence,
}

/// The solution of a single channel.
struct SingleChannel {
    solution: Vec<f64>,
    power: SkyPower,
    /// The data `(A x + R x) / s^2` with A from the blocks, for the evidence.
    right: Vec<f64>,
}

/// Solves for the maps of all channels together.
///
/// `T(nu)` and the noise of each channel are Gaussian. The angular power of each channel is estimated from its own data as for a single map,
/// and the correlation between channels from all blocks together, by maximum evidence.
///
/// # Errors
/// There is no data, or one channel without total powers, or two of one frequency; or a frequency is outside the range of the channels.
pub fn solve_jointly(
    mut channels: Vec<JointChannel>,
    request: &JointRequest,
    watch: &SolveWatch,
) -> Result<JointSolution, SolveError> {
    // `Prior` needs decreasing l_max.
    channels.sort_by(|a, b| {
        let l_max = |channel: &JointChannel| channel.sums.setup().l_max;
        l_max(b).cmp(&l_max(a)).then(a.frequency_hz.total_cmp(&b.frequency_hz))
    });
    let mut frequencies_hz: Vec<f64> = channels.iter().map(|channel| channel.frequency_hz).collect();
    let all_hz = frequencies_hz.clone();
    frequencies_hz.sort_by(f64::total_cmp);
    frequencies_hz.dedup();
    let has_powers = request.powers.is_some() && channels.iter().any(|channel| !channel.powers.is_empty());
    if frequencies_hz.len() < if has_powers { 1 } else { 2 } || frequencies_hz.len() < channels.len() {
        return Err(SolveError::FewChannels { channels: channels.len(), frequencies: frequencies_hz.len() });
    }
    // Checked before minutes of work.
    let ends_hz = [frequencies_hz[0], frequencies_hz[frequencies_hz.len() - 1]];
    if let Some(&frequency_hz) = request.at_hz.iter().find(|hz| !(ends_hz[0]..=ends_hz[1]).contains(*hz)) {
        return Err(SolveError::BeyondChannels { frequency_hz, ends_hz });
    }
    let sums: Vec<&HarmonicSums> = channels.iter().map(|channel| &*channel.sums).collect();
    let order_blocks: Vec<_> = sums.iter().map(|sums| sums.order_blocks()).collect();
    let blocks: Vec<Vec<Block<'_>>> = order_blocks.iter().map(|blocks| blocks.blocks()).collect();
    let mut singles = Vec::new();
    for ((sums, blocks), frequency_hz) in sums.iter().zip(&blocks).zip(&all_hz) {
        let name = format!("{:.3} MHz", frequency_hz / 1e6);
        singles.push(SingleChannel::solve(
            sums,
            blocks,
            request.rule,
            watch.named(&name).with_priority(true),
        )?);
    }
    let noise_factors: Vec<f64> = singles.iter().map(|single| single.power.noise_factor).collect();
    let scale = singles.iter().map(SingleChannel::scale).collect();
    let initial = Prior::new(all_hz, scale, Correlation { length: LENGTHS[2], own_share: OWN_SHARES[1] })?;
    let watch = watch.named("all channels").with_priority(true);
    let likeness = if channels.len() > 1 {
        let scaled = scaled_blocks(&initial, &blocks, &noise_factors, &[]);
        let rights: Vec<Vec<f64>> = singles.iter().map(|single| single.right.clone()).collect();
        Some(most_likely(&initial, &scaled, &rights, watch)?)
    } else {
        None
    };
    let prior = initial.with_correlation(likeness.unwrap_or(initial.likeness))?;
    let rows = power_rows(&channels, &singles, request)?;
    let sums: Vec<&(dyn NormalSums + Sync)> =
        sums.iter().map(|sums| *sums as &(dyn NormalSums + Sync)).collect();
    let equations = Equations { prior: &prior, sums: &sums, blocks: &blocks, noise_factors: &noise_factors };
    let (joint, scaled, start) = equations.with_powers(&rows, request, watch)?;
    let posterior = Posterior::new(&joint, &scaled, request, start.as_deref(), watch)?;
    let mut views = (0..prior.channels()).map(|channel| prior.view_of(channel)).collect::<Vec<View>>();
    for &at_hz in &request.at_hz {
        views.push(prior.view_at(at_hz)?);
    }
    let nside_of = |view: &View| {
        let own = channels.iter().find(|channel| channel.frequency_hz == view.frequency_hz);
        // Between channels the coarser neighbour has the same l_max.
        let similar =
            own.or_else(|| channels.iter().find(|channel| channel.sums.setup().l_max == view.l_max));
        similar.map_or(1, |channel| channel.nside)
    };
    let mut maps = Vec::new();
    for (index, view) in views.iter().enumerate() {
        let mut map = posterior.map(view, nside_of(view))?;
        if index < prior.channels() {
            map.agreement = Some(posterior.agreement(index, &singles[index], view));
            map.powers = posterior.agreement_of_powers(index, view);
        }
        maps.push(map);
    }
    let nside = channels.iter().map(|channel| channel.nside).min().unwrap_or(1);
    let spectra =
        if channels.len() > 1 { Some(posterior.spectra(&views[..prior.channels()], nside)?) } else { None };
    maps.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
    maps.dedup_by(|a, b| a.frequency_hz == b.frequency_hz);
    Ok(JointSolution { likeness, maps, spectra, convergence: posterior.convergence })
}

/// The rows of total powers of each channel; `None` if it has none.
fn power_rows(
    channels: &[JointChannel],
    singles: &[SingleChannel],
    request: &JointRequest,
) -> Result<Vec<Option<PowerRows>>, SolveError> {
    let Some(priors) = &request.powers else { return Ok(channels.iter().map(|_| None).collect()) };
    let constants = &priors.constant_k_sr;
    if constants.len() != 1 && constants.len() != channels.len() {
        return Err(SolveError::PowerConstants { found: constants.len(), channels: channels.len() });
    }
    let of_channel = |(channel, single): (&JointChannel, &SingleChannel)| {
        let below = channels.iter().filter(|other| other.frequency_hz < channel.frequency_hz).count();
        let constant_k_sr = constants[below.min(constants.len() - 1)];
        let moon_radius_m = channel.sums.setup().moon_radius_m;
        PowerRows::new(&channel.powers, moon_radius_m, &single.power, priors, constant_k_sr)
    };
    Ok(channels.iter().zip(singles).map(of_channel).collect())
}

impl SingleChannel {
    fn solve(
        sums: &HarmonicSums,
        blocks: &[Block<'_>],
        rule: StoppingRule,
        watch: NamedWatch<'_>,
    ) -> Result<Self, SolveError> {
        let degrees: Vec<usize> = degrees(sums.setup().l_max).collect();
        let SumCounts { visibilities, power, .. } = sums.counts();
        if visibilities == 0 {
            return Err(SolveError::NoData);
        }
        let (right, numbers) = (sums.right_hand_side(), 2.0 * visibilities as f64);
        let equations = PowerProblem { sums, blocks, degrees: &degrees, right, power, numbers };
        let FoundPower { solution, power, regularisation, .. } = equations.solve(None, rule, watch)?;
        let mut right = crate::imaging::power::multiply(blocks, &solution);
        for ((b, x), l) in right.iter_mut().zip(&solution).zip(&degrees) {
            *b = (*b + regularisation[*l] * x) / power.noise_factor.powi(2);
        }
        Ok(Self { solution, power, right })
    }

    /// Square roots of the prior power by degree; l = 0 and 1 have so much that they are free.
    fn scale(&self) -> Vec<f64> {
        let power = &self.power.power_k2;
        let structure = power.get(FREE_FACTORS.len()).or(power.last()).copied().unwrap_or(1.0);
        let of_degree =
            |(l, own): (usize, &f64)| FREE_FACTORS.get(l).map_or(*own, |factor| factor * structure);
        power.iter().enumerate().map(of_degree).map(f64::sqrt).collect()
    }
}

/// The correlation of maximum evidence, by a search on a coarse grid and then in smaller and smaller steps.
pub(super) fn most_likely(
    initial: &Prior,
    scaled: &[ScaledBlocks],
    rights: &[Vec<f64>],
    watch: NamedWatch<'_>,
) -> Result<Correlation, SolveError> {
    let mut known: BTreeMap<[u64; 2], f64> = BTreeMap::new();
    let task = watch.start("correlation between channels", FACTOR_MIN);
    let mut evidence = |likeness: Correlation| -> Option<f64> {
        let key = [likeness.length.to_bits(), likeness.own_share.to_bits()];
        if let Some(found) = known.get(&key) {
            return Some(*found);
        }
        let prior = initial.with_correlation(likeness).ok()?;
        let blocks = joint_blocks(&prior, scaled);
        let unit = vec![1.0; initial.l_max.first().map_or(1, |l_max| l_max + 1)];
        let found = value(&blocks, &unit, &prior.transposed(rights))?;
        known.insert(key, found);
        Some(found)
    };
    let grid = LENGTHS
        .iter()
        .flat_map(|length| OWN_SHARES.iter().map(|own| Correlation { length: *length, own_share: *own }));
    let found = grid.filter_map(|likeness| Some((evidence(likeness)?, likeness)));
    let (mut best, mut position) = found.max_by(|a, b| a.0.total_cmp(&b.0)).ok_or(SolveError::NoPower)?;
    let mut factor: f64 = 2.0;
    let mut step = 0;
    while factor > FACTOR_MIN && task.report_step(true, step, factor) {
        step += 1;
        // Both parameters change together, because the evidence has a diagonal ridge.
        let moves = [factor.recip(), 1.0, factor];
        let steps: Vec<(f64, f64)> = moves.iter().flat_map(|a| moves.map(|b| (*a, b))).collect();
        let tried = steps.iter().filter_map(|(length, own)| {
            let likeness = Correlation {
                length: (position.length * length).min(LENGTH_MAX),
                own_share: (position.own_share * own * own).clamp(OWN_SHARE_RANGE[0], OWN_SHARE_RANGE[1]),
            };
            Some((evidence(likeness)?, likeness))
        });
        match tried.max_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((found, likeness)) if found > best => (best, position) = (found, likeness),
            _ => factor = factor.sqrt(),
        }
    }
    Ok(position)
}

/// The posterior mean and samples in the unknowns of the prior.
pub(super) struct Posterior<'a> {
    sums: &'a JointSums<'a>,
    blocks: Vec<Block<'static>>,
    offsets: Vec<usize>,
    pub(super) solution: Vec<f64>,
    /// Posterior samples without the mean, with the samples of the preconditioner from the same random numbers.
    samples: Vec<PosteriorSample>,
    pub(super) convergence: Convergence,
}

impl<'a> Posterior<'a> {
    pub(super) fn new(
        sums: &'a JointSums<'a>,
        scaled: &[ScaledBlocks],
        request: &JointRequest,
        start: Option<&[f64]>,
        watch: NamedWatch<'_>,
    ) -> Result<Self, SolveError> {
        let blocks = joint_blocks(sums.prior, scaled);
        let (offsets, count) = sums.prior.offsets();
        let unit = unit_regularisation(sums.prior);
        let factors = Factors::new(&blocks, &unit);
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

    /// Ratio of the variances of posterior samples and preconditioner samples by degree, averaged over neighbouring degrees for accuracy.
    fn variance_ratio(&self, view: &View) -> Vec<f64> {
        let mut sums = vec![[0.0; 2]; view.l_max + 1];
        for PosteriorSample { exact, preconditioner } in &self.samples {
            let both =
                self.coefficients(view, exact).into_iter().zip(self.coefficients(view, preconditioner));
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
        for (l, sigma) in sigma.iter_mut().enumerate().take(FREE) {
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
            let shares = if l < FREE { &view.shares_of_free } else { &view.shares };
            let has_unknown = l <= view.l_max && channel < shares.len();
            if has_unknown { ratio[l].sqrt() * view.scale[l] * shares[channel] } else { 0.0 }
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

    fn agreement_of_powers(&self, channel: usize, view: &View) -> Option<PowerAgreement> {
        Some(self.sums.powers(channel)?.agreement(&self.coefficients(view, &self.solution)))
    }

    fn agreement(&self, channel: usize, single: &SingleChannel, view: &View) -> Agreement {
        let sums = self.sums.channels[channel];
        let SumCounts { visibilities, power, .. } = sums.counts();
        let joint = self.coefficients(view, &self.solution);
        let products = sums.apply_all(&[&single.solution, &joint]);
        let chi_square =
            |x: &[f64], product: &[f64]| power - 2.0 * dot(x, sums.right_hand_side()) + dot(x, product);
        let [before, after] = [chi_square(&single.solution, &products[0]), chi_square(&joint, &products[1])];
        let numbers = 2.0 * visibilities as f64;
        let decided: f64 = single.power.decided.iter().sum();
        let factor = single.power.noise_factor.powi(2);
        Agreement {
            chi_square_alone: before / numbers,
            chi_square: after / numbers,
            strain: (after - before) / (factor * decided.max(1.0)),
        }
    }

    /// Spectra at the resolution of the coarsest channel.
    fn spectra(&self, views: &[View], nside: usize) -> Result<SpectralMaps, SolveError> {
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
