//! The joint solution: how alike channels are, then all of them together.

use std::collections::BTreeMap;

use serde::Serialize;

use super::amplitude::{RelativeAmplitude, relative_amplitudes};
use super::prior::{FREE, Likeness, Prior, View};
use super::spectrum::{Spectra, SpectralMaps};
use super::sums::{JointSums, ScaledBlocks, joint_blocks, scaled_blocks};
use crate::imaging::circle::{HarmonicSums, NOISES_TOGETHER, coefficients, degrees, view_sigma_k};
use crate::imaging::power::{
    Block, Covariance, Drawn, Factors, FoundPower, PowerProblem, SAMPLE_SETTLED, SkyPower, value,
};
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::{Convergence, NamedWatch, SolveError, SolveWatch, StoppingRule, System, dot};
use crate::imaging::{NormalSums, SumCounts};
use crate::sky::harmonics::synthesis;
use crate::units::{StreamKind, random_stream};
use rand_distr::{Distribution, StandardNormal};

/// Lengths and own shares that are tried first, and the factor within which they are refined.
const LENGTHS: [f64; 5] = [0.5, 1.0, 2.0, 4.0, 8.0];
const OWN_SHARES: [f64; 4] = [1e-4, 1e-3, 1e-2, 1e-1];
const FINEST: f64 = 1.05;
/// Bounds of a search: beyond them nothing changes.
const LENGTH_MAX: f64 = 64.0;
const OWN_SHARE_RANGE: [f64; 2] = [1e-7, 0.999];
/// How many times the power of l = 2 the free priors are.
const FREE_FACTORS: [f64; FREE] = [1e6, 1e4];

/// A channel's sums.
pub struct JointChannel {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// nside of its map.
    pub nside: usize,
    /// Normal equations over harmonics.
    pub sums: Box<HarmonicSums>,
}

/// What is asked for.
#[derive(Clone, Debug, PartialEq)]
pub struct JointRequest {
    /// When to stop.
    pub rule: StoppingRule,
    /// Draws from the posterior: errors of spectra and of the mean are their scatter.
    pub samples: usize,
    /// Frequencies between the channels at which maps are made, too, Hz.
    pub at_hz: Vec<f64>,
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
    /// Standard deviation of the mean, K: the scatter of samples.
    pub mean_sigma_k: f64,
    /// How the channel's data agree; `None` between channels.
    pub agreement: Option<Agreement>,
}

/// How a channel's data agree with the joint sky.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// chi-square of its data a number with the map of the channel alone.
    pub chi_square_alone: f64,
    /// With the joint map.
    pub chi_square: f64,
    /// By how much chi-square rises from the first to the second, a coefficient that the channel's data decide: of the order of 1 where the
    /// joint map leaves no more than the noise of the channel's own map.
    pub strain: f64,
    /// Amplitude of the channel's structure over that of the law through the others; `None` for fewer than five channels.
    pub amplitude: Option<RelativeAmplitude>,
}

/// All of it.
#[derive(Clone, Debug, PartialEq)]
pub struct JointSolution {
    /// How alike the channels are.
    pub likeness: Likeness,
    /// Maps of the channels and between them, by rising frequency.
    pub maps: Vec<JointMap>,
    /// Spectral index and curvature of every pixel.
    pub spectra: SpectralMaps,
    /// How the iteration ended.
    pub convergence: Convergence,
}

/// What a channel gives alone.
struct Alone {
    solution: Vec<f64>,
    power: SkyPower,
    /// `A x + R x` of its blocks over s^2: the data that the evidence is of.
    right: Vec<f64>,
}

/// A degree is measured where the data decide this share of its coefficients.
const MEASURED: f64 = 0.95;

/// Solves for the maps of all channels together.
///
/// `T(nu)` and the noise of each channel are Gaussian; the angular power of each channel is estimated from its own data as for a map alone,
/// and how alike channels are from all blocks together, by the greatest evidence.
///
/// # Errors
/// Fewer than two channels, two of one frequency, no data, or a frequency beyond all channels.
pub fn solve_jointly(
    mut channels: Vec<JointChannel>,
    request: &JointRequest,
    watch: &SolveWatch,
) -> Result<JointSolution, SolveError> {
    // Those of most degrees first: see `Prior`.
    channels.sort_by(|a, b| {
        let l_max = |channel: &JointChannel| channel.sums.setup().l_max;
        l_max(b).cmp(&l_max(a)).then(a.frequency_hz.total_cmp(&b.frequency_hz))
    });
    let mut frequencies_hz: Vec<f64> = channels.iter().map(|channel| channel.frequency_hz).collect();
    let all_hz = frequencies_hz.clone();
    frequencies_hz.sort_by(f64::total_cmp);
    frequencies_hz.dedup();
    if frequencies_hz.len() < 2 || frequencies_hz.len() < channels.len() {
        return Err(SolveError::FewChannels { channels: channels.len(), frequencies: frequencies_hz.len() });
    }
    // Before the work of minutes.
    let ends_hz = [frequencies_hz[0], frequencies_hz[frequencies_hz.len() - 1]];
    if let Some(&frequency_hz) = request.at_hz.iter().find(|hz| !(ends_hz[0]..=ends_hz[1]).contains(*hz)) {
        return Err(SolveError::BeyondChannels { frequency_hz, ends_hz });
    }
    let sums: Vec<&HarmonicSums> = channels.iter().map(|channel| &*channel.sums).collect();
    let order_blocks: Vec<_> = sums.iter().map(|sums| sums.order_blocks()).collect();
    let blocks: Vec<Vec<Block<'_>>> = order_blocks.iter().map(|blocks| blocks.blocks()).collect();
    let mut alone = Vec::new();
    for ((sums, blocks), frequency_hz) in sums.iter().zip(&blocks).zip(&all_hz) {
        let name = format!("{:.3} MHz", frequency_hz / 1e6);
        alone.push(Alone::of(sums, blocks, request.rule, watch.named(&name).wanted(true))?);
    }
    let noise_factors: Vec<f64> = alone.iter().map(|alone| alone.power.noise_factor).collect();
    let scale = alone.iter().map(Alone::scale).collect();
    let plain = Prior::new(all_hz.clone(), scale, Likeness { length: LENGTHS[2], own_share: OWN_SHARES[1] })?;
    let scaled = scaled_blocks(&plain, &blocks, &noise_factors);
    let watch = watch.named("all channels").wanted(true);
    let rights: Vec<Vec<f64>> = alone.iter().map(|alone| alone.right.clone()).collect();
    let likeness = most_likely(&plain, &scaled, &rights, watch)?;
    let prior = plain.with(likeness)?;
    let channels_sums = sums.iter().map(|sums| *sums as &(dyn NormalSums + Sync)).collect();
    let joint = JointSums::new(&prior, channels_sums, noise_factors);
    let posterior = Posterior::of(&joint, &scaled, request, watch)?;
    let mut views = (0..prior.channels()).map(|channel| prior.view_of(channel)).collect::<Vec<View>>();
    for &at_hz in &request.at_hz {
        views.push(prior.view_at(at_hz)?);
    }
    let nside_of = |view: &View| {
        let own = channels.iter().find(|channel| channel.frequency_hz == view.frequency_hz);
        // Between channels the resolution of the coarser neighbours is that of l_max.
        let like = own.or_else(|| channels.iter().find(|channel| channel.sums.setup().l_max == view.l_max));
        like.map_or(1, |channel| channel.nside)
    };
    let amplitudes = relative_amplitudes(&amplitudes(&all_hz, &alone));
    let mut maps = Vec::new();
    for (index, view) in views.iter().enumerate() {
        let mut map = posterior.map(view, nside_of(view))?;
        if index < prior.channels() {
            let agreement = posterior.agreement(index, &alone[index], view);
            map.agreement = Some(Agreement { amplitude: amplitudes[index], ..agreement });
        }
        maps.push(map);
    }
    let nside = channels.iter().map(|channel| channel.nside).min().unwrap_or(1);
    let spectra = posterior.spectra(&views[..prior.channels()], nside)?;
    maps.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
    maps.dedup_by(|a, b| a.frequency_hz == b.frequency_hz);
    Ok(JointSolution { likeness, maps, spectra, convergence: posterior.convergence })
}

/// Frequency and amplitude of each channel, over degrees that all channels measure: the root mean square of their maps, whose sky is one
/// and the same.
fn amplitudes(frequencies_hz: &[f64], alone: &[Alone]) -> Vec<(f64, f64)> {
    let l_max = alone.iter().map(|alone| alone.power.power_k2.len() - 1).min().unwrap_or(0);
    let is_measured = |l: usize| {
        let enough = |alone: &Alone| alone.power.decided[l] > MEASURED * (2 * l + 1) as f64;
        l >= FREE && alone.iter().all(enough)
    };
    let measured: Vec<bool> = (0..=l_max).map(is_measured).collect();
    let power = |alone: &Alone| -> f64 {
        let own_l_max = alone.power.power_k2.len() - 1;
        let squares = degrees(own_l_max).zip(&alone.solution);
        squares.filter(|(l, _)| measured.get(*l) == Some(&true)).map(|(_, x)| x * x).sum()
    };
    frequencies_hz.iter().zip(alone).map(|(hz, alone)| (*hz, power(alone).sqrt())).collect()
}

impl Alone {
    fn of(
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
        let FoundPower { solution, power, regularisation, .. } = equations.found(None, rule, watch)?;
        let mut right = crate::imaging::power::multiply(blocks, &solution);
        for ((b, x), l) in right.iter_mut().zip(&solution).zip(&degrees) {
            *b = (*b + regularisation[*l] * x) / power.noise_factor.powi(2);
        }
        Ok(Self { solution, power, right })
    }

    /// Square roots of the power by degree; those of l = 0 and 1 so large that they are free.
    fn scale(&self) -> Vec<f64> {
        let power = &self.power.power_k2;
        let structure = power.get(FREE_FACTORS.len()).or(power.last()).copied().unwrap_or(1.0);
        let of_degree =
            |(l, own): (usize, &f64)| FREE_FACTORS.get(l).map_or(*own, |factor| factor * structure);
        power.iter().enumerate().map(of_degree).map(f64::sqrt).collect()
    }
}

/// The likeness of the greatest evidence: on a coarse grid, then step by step from the best.
pub(super) fn most_likely(
    plain: &Prior,
    scaled: &[ScaledBlocks],
    rights: &[Vec<f64>],
    watch: NamedWatch<'_>,
) -> Result<Likeness, SolveError> {
    let mut known: BTreeMap<[u64; 2], f64> = BTreeMap::new();
    let task = watch.start("how alike channels are", FINEST);
    let mut evidence = |likeness: Likeness| -> Option<f64> {
        let key = [likeness.length.to_bits(), likeness.own_share.to_bits()];
        if let Some(found) = known.get(&key) {
            return Some(*found);
        }
        let prior = plain.with(likeness).ok()?;
        let blocks = joint_blocks(&prior, scaled);
        let unit = vec![1.0; plain.l_max.first().map_or(1, |l_max| l_max + 1)];
        let found = value(&blocks, &unit, &prior.transposed(rights))?;
        known.insert(key, found);
        Some(found)
    };
    let grid = LENGTHS
        .iter()
        .flat_map(|length| OWN_SHARES.iter().map(|own| Likeness { length: *length, own_share: *own }));
    let found = grid.filter_map(|likeness| Some((evidence(likeness)?, likeness)));
    let (mut best, mut at) = found.max_by(|a, b| a.0.total_cmp(&b.0)).ok_or(SolveError::NoPower)?;
    let mut factor: f64 = 2.0;
    let mut step = 0;
    while factor > FINEST && task.report_wanting(true, step, factor) {
        step += 1;
        // The corners, too: evidence has a ridge along which both change.
        let moves = [factor.recip(), 1.0, factor];
        let near: Vec<(f64, f64)> = moves.iter().flat_map(|a| moves.map(|b| (*a, b))).collect();
        let tried = near.iter().filter_map(|(length, own)| {
            let likeness = Likeness {
                length: (at.length * length).min(LENGTH_MAX),
                own_share: (at.own_share * own * own).clamp(OWN_SHARE_RANGE[0], OWN_SHARE_RANGE[1]),
            };
            Some((evidence(likeness)?, likeness))
        });
        match tried.max_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((found, likeness)) if found > best => (best, at) = (found, likeness),
            _ => factor = factor.sqrt(),
        }
    }
    Ok(at)
}

/// Map and samples in the unknowns of the prior.
pub(super) struct Posterior<'a> {
    sums: &'a JointSums<'a>,
    blocks: Vec<Block<'static>>,
    offsets: Vec<usize>,
    pub(super) solution: Vec<f64>,
    /// Draws less the solution, of the true matrix and of its blocks with the same numbers.
    draws: Vec<Drawn>,
    pub(super) convergence: Convergence,
}

impl<'a> Posterior<'a> {
    pub(super) fn of(
        sums: &'a JointSums<'a>,
        scaled: &[ScaledBlocks],
        request: &JointRequest,
        watch: NamedWatch<'_>,
    ) -> Result<Self, SolveError> {
        let blocks = joint_blocks(sums.prior, scaled);
        let (offsets, count) = sums.prior.offsets();
        let unit = unit_regularisation(sums.prior);
        let factors = Factors::new(&blocks, &unit);
        let regularisation = Diagonal::Uniform(1.0);
        let precondition = |v: &mut [f64]| factors.solve(v);
        let system = System { sums, regularisation: regularisation.clone(), precondition: &precondition };
        let mut columns = [vec![0.0; count]];
        let convergence = {
            let task = watch.start("maps", request.rule.residual_max);
            system.solve(&[sums.right_hand_side()], &mut columns, &[request.rule], &task)
        };
        let [solution] = columns;
        let covariance = Covariance { sums, regularisation: &regularisation, factors: &factors };
        let mut draws = Vec::new();
        let numbers: Vec<u64> = (0..request.samples as u64).collect();
        for which in numbers.chunks(NOISES_TOGETHER) {
            let task = watch.start(&format!("samples from {}", which[0] + 1), SAMPLE_SETTLED);
            draws.extend(covariance.draw(which, SAMPLE_SETTLED, &task));
        }
        if let Some(reason) = sums.failure() {
            return Err(SolveError::Sums(reason.to_owned()));
        }
        let convergence = convergence.first().copied().ok_or(SolveError::NoData)?;
        Ok(Self { sums, blocks, offsets, solution, draws, convergence })
    }

    fn prior(&self) -> &Prior {
        self.sums.prior
    }

    pub(super) fn seen(&self, view: &View, unknowns: &[f64]) -> Vec<f64> {
        view.coefficients(self.prior(), &self.offsets, unknowns)
    }

    /// Variance of the draws over that of the blocks' draws, by degree: means over neighbouring degrees, as a draw has few numbers of each.
    fn ratio(&self, view: &View) -> Vec<f64> {
        let mut sums = vec![[0.0; 2]; view.l_max + 1];
        for Drawn { whole, of_blocks } in &self.draws {
            let both = self.seen(view, whole).into_iter().zip(self.seen(view, of_blocks));
            for (l, (whole, of_blocks)) in degrees(view.l_max).zip(both) {
                sums[l] = [sums[l][0] + whole * whole, sums[l][1] + of_blocks * of_blocks];
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

    /// Standard deviation of the coefficients of each degree that no channel decides, K sr^(1/2). Mean and dipole have a prior far above any
    /// sky, so that it is their own size that counts.
    fn open_sigma(&self, view: &View) -> Vec<f64> {
        let mut sigma: Vec<f64> =
            view.open.iter().zip(&view.scale).map(|(open, s)| s * open.sqrt()).collect();
        let mut square = vec![0.0; view.l_max + 1];
        for (l, x) in degrees(view.l_max).zip(self.seen(view, &self.solution)) {
            square[l] += x * x / (2 * l + 1) as f64;
        }
        for (l, sigma) in sigma.iter_mut().enumerate().take(FREE) {
            *sigma = (view.open[l] * square[l]).sqrt();
        }
        sigma
    }

    /// A sample of a view: what no channel decides is drawn, too.
    pub(super) fn sample(&self, view: &View, number: usize) -> Vec<f64> {
        let mut sky = self.seen(view, &self.draws[number].whole);
        crate::imaging::solver::add(&mut sky, &self.seen(view, &self.solution));
        let open = self.open_sigma(view);
        if open.iter().any(|open| *open > 0.0) {
            let mut stream =
                random_stream(4, StreamKind::Probe, [view.frequency_hz.to_bits(), number as u64]);
            for (x, l) in sky.iter_mut().zip(degrees(view.l_max)) {
                let normal: f64 = StandardNormal.sample(&mut stream);
                *x += open[l] * normal;
            }
        }
        sky
    }

    pub(super) fn map(&self, view: &View, nside: usize) -> Result<JointMap, SolveError> {
        let sky = self.seen(view, &self.solution);
        let ratio = self.ratio(view);
        let map_k = synthesis(&coefficients(&sky, view.l_max), nside)?;
        let factors = Factors::new(&self.blocks, &unit_regularisation(self.prior()));
        let row = |channel: usize, l: usize| {
            let shares = if l < FREE { &view.shares_of_free } else { &view.shares };
            let is_of = l <= view.l_max && channel < shares.len();
            if is_of { ratio[l].sqrt() * view.scale[l] * shares[channel] } else { 0.0 }
        };
        let open: Vec<f64> = self.open_sigma(view).iter().map(|sigma| sigma * sigma).collect();
        let sigma_k = view_sigma_k(&self.blocks, &factors, &row, &open, nside);
        let of_mean = |sky: &[f64]| sky[0] / (4.0 * std::f64::consts::PI).sqrt();
        let variance: f64 = (0..self.draws.len())
            .map(|number| (of_mean(&self.sample(view, number)) - of_mean(&sky)).powi(2))
            .sum();
        let mean_sigma_k = (variance / self.draws.len().max(1) as f64).sqrt();
        Ok(JointMap { frequency_hz: view.frequency_hz, map_k, sigma_k, mean_sigma_k, agreement: None })
    }

    fn agreement(&self, channel: usize, alone: &Alone, view: &View) -> Agreement {
        let sums = self.sums.channels[channel];
        let SumCounts { visibilities, power, .. } = sums.counts();
        let joint = self.seen(view, &self.solution);
        let products = sums.apply_all(&[&alone.solution, &joint]);
        let left =
            |x: &[f64], product: &[f64]| power - 2.0 * dot(x, sums.right_hand_side()) + dot(x, product);
        let [before, after] = [left(&alone.solution, &products[0]), left(&joint, &products[1])];
        let numbers = 2.0 * visibilities as f64;
        let decided: f64 = alone.power.decided.iter().sum();
        let factor = alone.power.noise_factor.powi(2);
        Agreement {
            chi_square_alone: before / numbers,
            chi_square: after / numbers,
            strain: (after - before) / (factor * decided.max(1.0)),
            amplitude: None,
        }
    }

    /// Spectra at the resolution of the coarsest channel.
    fn spectra(&self, views: &[View], nside: usize) -> Result<SpectralMaps, SolveError> {
        let l_max = views.iter().map(|view| view.l_max).min().unwrap_or(0);
        let views: Vec<View> = views.iter().map(|view| view.clone().cut(l_max)).collect();
        let frequencies_hz: Vec<f64> = views.iter().map(|view| view.frequency_hz).collect();
        let maps = |sky: &dyn Fn(&View) -> Vec<f64>| -> Result<Vec<Vec<f64>>, SolveError> {
            let map =
                |view: &View| synthesis(&coefficients(&sky(view), l_max), nside).map_err(SolveError::from);
            views.iter().map(map).collect()
        };
        let mut spectra = Spectra::new(&frequencies_hz, &maps(&|view| self.seen(view, &self.solution))?);
        for number in 0..self.draws.len() {
            spectra.add_sample(&maps(&|view| self.sample(view, number))?);
        }
        Ok(spectra.end())
    }
}

fn unit_regularisation(prior: &Prior) -> Vec<f64> {
    vec![1.0; prior.l_max.first().map_or(1, |l_max| l_max + 1)]
}
