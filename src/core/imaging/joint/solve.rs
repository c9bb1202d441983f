//! Estimates the covariance between channels, then solves for all channels together.

use std::path::Path;

use super::correlation::{Correlation, Covariance};
use super::evidence::most_likely;
use super::posterior::{Equations, JointMap, JointRequest, Posterior};
use super::powers::{PowerRows, PowerSample};
use super::prior::{Prior, View};
use super::spectrum::SpectralMaps;
use super::sums::scaled_blocks;
use crate::imaging::SolveError;
use crate::imaging::circle::{HarmonicSums, OrderBlocks, degrees};
use crate::imaging::power::{Block, Coupling, FREE_DEGREES, FoundPower, PowerProblem, SkyPower};
use crate::imaging::solver::{Convergence, NamedWatch, SolveWatch, StoppingRule};
use crate::imaging::{AccumulationError, NormalSums, SumCounts};

/// Prior power of the free degrees in units of that of l = 2.
const FREE_FACTORS: [f64; FREE_DEGREES] = [1e6, 1e4];

/// A channel with its own solution.
pub struct JointChannel {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// nside of its map.
    pub nside: usize,
    /// Total powers of its daughters, by daughter and time.
    pub powers: Vec<PowerSample>,
    sums: HarmonicSums,
    blocks: OrderBlocks,
    coupling: Option<Coupling>,
    alone: SingleChannel,
}

impl JointChannel {
    /// Solves for the map of a channel alone, from its normal equations over harmonics.
    ///
    /// # Errors
    /// There is no data, or no angular power fits them.
    pub fn new(
        (frequency_hz, nside): (f64, usize),
        sums: HarmonicSums,
        powers: Vec<PowerSample>,
        rule: StoppingRule,
        watch: &SolveWatch,
    ) -> Result<Self, SolveError> {
        if sums.counts().visibilities == 0 {
            return Err(SolveError::NoData);
        }
        let blocks = sums.order_blocks();
        let coupling = sums.coupling();
        let name = format!("{:.3} MHz", frequency_hz / 1e6);
        let alone = SingleChannel::solve(
            &sums,
            &blocks.blocks(),
            coupling.as_ref(),
            rule,
            watch.named(&name).of_final_map(true),
        )?;
        Ok(Self { frequency_hz, nside, powers, sums, blocks, coupling, alone })
    }

    /// Bytes of its sums, which are in memory unless they were moved to disk.
    #[must_use]
    pub fn sums_bytes(&self) -> u64 {
        self.sums.weight_bytes()
    }

    /// Moves its sums into an unnamed file in a folder, which disappears with the process. Every product then reads them.
    ///
    /// # Errors
    /// The system's, in particular a full disk.
    pub fn with_sums_on_disk(self, folder: &Path) -> Result<Self, AccumulationError> {
        Ok(Self { sums: self.sums.on_disk(folder)?, ..self })
    }

    fn l_max(&self) -> usize {
        self.sums.setup().l_max
    }
}

/// A joint solution.
#[derive(Clone, Debug, PartialEq)]
pub struct JointSolution {
    /// Correlation between channels at degrees an octave apart; empty for one channel alone.
    pub likeness: Vec<Correlation>,
    /// Maps at all frequencies, in increasing order.
    pub maps: Vec<JointMap>,
    /// Spectral index and curvature of every pixel; `None` for a channel alone.
    pub spectra: Option<SpectralMaps>,
    /// Convergence of the iteration.
    pub convergence: Convergence,
    /// Number of posterior samples, from which errors of means and spectra are.
    pub samples: usize,
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
/// and the covariance between channels by degree from all blocks together, by maximum evidence.
///
/// # Errors
/// There is no data, or one channel without total powers, or two of one frequency; or a frequency is outside the range of the channels.
pub fn solve_jointly(
    mut channels: Vec<JointChannel>,
    request: &JointRequest,
    watch: &SolveWatch,
) -> Result<JointSolution, SolveError> {
    // `Prior` needs decreasing l_max. The unknowns of a channel are coupled up to the degree of those that follow, which is the smaller the
    // lower the frequency.
    channels.sort_by(|a, b| b.l_max().cmp(&a.l_max()).then(b.frequency_hz.total_cmp(&a.frequency_hz)));
    let all_hz: Vec<f64> = channels.iter().map(|channel| channel.frequency_hz).collect();
    let has_powers = channels.iter().any(|channel| !channel.powers.is_empty());
    request.check(&all_hz, has_powers)?;
    let blocks: Vec<Vec<Block<'_>>> = channels.iter().map(|channel| channel.blocks.blocks()).collect();
    let singles = || channels.iter().map(|channel| &channel.alone);
    let noise_factors: Vec<f64> = singles().map(|single| single.power.noise_factor).collect();
    let scale: Vec<Vec<f64>> = singles().map(SingleChannel::scale).collect();
    let l_max = channels.first().map_or(0, JointChannel::l_max);
    let mut prior = Prior::new(scale, Covariance::initial(all_hz, l_max))?;
    let watch = watch.named("all channels").of_final_map(true);
    let mut likeness = Vec::new();
    if channels.len() > 1 {
        let scaled = scaled_blocks(&prior, &blocks, &noise_factors, &[]);
        let rights: Vec<Vec<f64>> = singles().map(|single| single.right.clone()).collect();
        prior = most_likely(&prior, &scaled, &rights, watch)?;
        likeness = prior.covariance.at_knots();
    }
    let rows = power_rows(&channels, request)?;
    let sums: Vec<&(dyn NormalSums + Sync)> =
        channels.iter().map(|channel| &channel.sums as &(dyn NormalSums + Sync)).collect();
    let couplings = channels.iter().map(|channel| channel.coupling.as_ref()).collect();
    let equations =
        Equations { prior: &prior, sums: &sums, blocks: &blocks, couplings, noise_factors: &noise_factors };
    let (joint, approximation, start) = equations.with_powers(&rows, request, watch)?;
    let posterior = Posterior::new(&joint, &approximation, request, start.as_deref(), watch)?;
    let mut views = (0..prior.channels()).map(|channel| prior.view_of(channel)).collect::<Vec<View>>();
    let free = posterior.amplitudes_of_free();
    for &at_hz in &request.at_hz {
        views.push(prior.view_at(at_hz, &free)?);
    }
    let nside_of = |view: &View| {
        let own = channels.iter().find(|channel| channel.frequency_hz == view.frequency_hz);
        // Between channels the coarser neighbour has the same l_max.
        let of_l_max = channels.iter().filter(|channel| channel.l_max() == view.l_max);
        own.or_else(|| of_l_max.min_by_key(|channel| channel.nside)).map_or(1, |channel| channel.nside)
    };
    let mut maps = Vec::new();
    for (index, view) in views.iter().enumerate() {
        let mut map = posterior.map(view, nside_of(view))?;
        if index < prior.channels() {
            let SingleChannel { solution, power, .. } = &channels[index].alone;
            map.agreement = Some(posterior.agreement(index, (solution, power), view));
            map.powers = posterior.agreement_of_powers(index, view);
        }
        maps.push(map);
    }
    let nside = channels.iter().map(|channel| channel.nside).min().unwrap_or(1);
    let spectra =
        if channels.len() > 1 { Some(posterior.spectra(&views[..prior.channels()], nside)?) } else { None };
    maps.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
    maps.dedup_by(|a, b| a.frequency_hz == b.frequency_hz);
    let (samples, convergence) = (request.samples, posterior.convergence);
    Ok(JointSolution { likeness, maps, spectra, convergence, samples })
}

/// The rows of total powers of each channel; `None` if it has none.
fn power_rows(
    channels: &[JointChannel],
    request: &JointRequest,
) -> Result<Vec<Option<PowerRows>>, SolveError> {
    let Some(priors) = &request.powers else { return Ok(channels.iter().map(|_| None).collect()) };
    request.check_constants(channels.len()..=channels.len())?;
    let constants = &priors.constant_k_sr;
    let of_channel = |channel: &JointChannel| {
        let below = channels.iter().filter(|other| other.frequency_hz < channel.frequency_hz).count();
        let constant_k_sr = constants[below.min(constants.len() - 1)];
        let moon_radius_m = channel.sums.setup().moon_radius_m;
        PowerRows::new(&channel.powers, moon_radius_m, &channel.alone.power, priors, constant_k_sr)
    };
    Ok(channels.iter().map(of_channel).collect())
}

impl SingleChannel {
    fn solve(
        sums: &HarmonicSums,
        blocks: &[Block<'_>],
        coupling: Option<&Coupling>,
        rule: StoppingRule,
        watch: NamedWatch<'_>,
    ) -> Result<Self, SolveError> {
        let degrees: Vec<usize> = degrees(sums.setup().l_max).collect();
        let SumCounts { visibilities, power, .. } = sums.counts();
        let (right, numbers) = (sums.right_hand_side(), 2.0 * visibilities as f64);
        let equations = PowerProblem {
            sums,
            blocks,
            coupling,
            degrees: &degrees,
            right,
            data_chi2: power,
            data_count: numbers,
        };
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
