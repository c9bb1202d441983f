//! Position errors of a large fraction of a wavelength.
//!
//! The model of a visibility is linear in a position within a tenth of a wavelength at most. So positions are found
//! from the lowest frequency upwards: first from the lowest channel alone, where errors are the smallest fraction of
//! a wavelength, then with the next channel of at most twice its frequency, and so on. Each step recomputes the model
//! about the positions found so far, and moves by a fraction of a wavelength of the highest channel, only where the
//! data then fit better (a trust region). A subset of the visibilities suffices for that; the final solution uses
//! all.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::config::SolverConfig;
use super::global::{GlobalSearch, KEPT_COST};
use super::layout::{ParameterLayout, ParameterValues};
use super::model::{KnownSignal, Offsets};
use super::newton::{NewtonFit, TrustRegion};
use super::reach::is_searched;
use super::robust::{mark_outliers, robust_cost};
use super::robust_fit::sums_of;
use super::sums::{ModelTerms, ModelledBlock, PairSums};
use crate::frames::PlacedVisibilities;
use crate::response::model::ModelError;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, norm, sub};

/// Maximum number of visibilities of a pair in a channel used to find positions.
const THINNED_MAX: usize = 320;

/// Maximum number used to search all offsets.
const SEARCHED_MAX: usize = 160;

/// Initial and maximum trust radius, in wavelengths of the highest channel.
const TRUST_WAVELENGTHS: [f64; 2] = [0.1, 0.25];

/// Maximum number of models in one step.
const MODELS_MAX: usize = 30;

/// Movement, in wavelengths, below which positions have converged.
const CONVERGED_WAVELENGTHS: f64 = 1e-3;

/// Distance, in wavelengths of the highest channel, within which positions count as the same.
const SAME_WAVELENGTHS: f64 = 0.1;

/// Cost above the minimum within which other positions explain the data as well: three and a half standard
/// deviations.
const AMBIGUOUS_COST: f64 = 12.0;

/// Maximum number of Gauss-Newton iterations for one model.
const ITERATIONS_MAX: usize = 20;

/// Largest ratio of the highest frequencies of consecutive steps, if channels allow.
const FREQUENCY_RATIO_MAX: f64 = 2.0;

/// Search for the position errors of a pass.
pub(super) struct Search<'a> {
    pub(super) config: &'a SolverConfig,
    pub(super) frequencies_hz: &'a [f64],
    pub(super) span_s: [f64; 2],
    pub(super) normal_hat: &'a [Vec3],
    /// Visibilities, and whether the artificial signal is on.
    pub(super) placed: &'a [(PlacedVisibilities, bool)],
}

/// Result of a position search.
pub(super) struct FoundPositions {
    /// Offsets of the daughters, m.
    pub(super) position_m: Vec<[f64; 3]>,
    /// Other offsets that explain the data as well.
    others_m: Vec<Vec<[f64; 3]>>,
}

impl FoundPositions {
    /// Whether another position of a daughter explains the data as well and differs at a frequency.
    pub(super) fn is_ambiguous(&self, daughter: usize, frequency_hz: f64) -> bool {
        let same_m = SAME_WAVELENGTHS * SPEED_OF_LIGHT_M_S / frequency_hz;
        self.others_m.iter().any(|other_m| norm(sub(other_m[daughter], self.position_m[daughter])) > same_m)
    }
}

/// Offsets of the daughters, m, and their cost.
struct Candidate {
    position_m: Vec<[f64; 3]>,
    cost: f64,
}

impl Search<'_> {
    /// Finds the offsets of the daughters.
    pub(super) fn find(&self, signal: &mut KnownSignal) -> Result<FoundPositions, ModelError> {
        let highest_channels = highest_channels(self.frequencies_hz);
        let mut kept = self.initial_offsets(&highest_channels, signal)?;
        for top in 1..=highest_channels.len() {
            let step = Step::new(self, &highest_channels[..top], THINNED_MAX);
            kept = step.minima(kept, KEPT_COST, signal)?.into_iter().map(|found| found.position_m).collect();
        }
        if kept.len() > 1 {
            let step = Step::new(self, &highest_channels, usize::MAX);
            kept = step
                .minima(kept, AMBIGUOUS_COST, signal)?
                .into_iter()
                .map(|found| found.position_m)
                .collect();
        }
        let mut kept = kept.into_iter();
        let position_m = kept.next().unwrap_or_else(|| vec![[0.0; 3]; self.normal_hat.len()]);
        Ok(FoundPositions { position_m, others_m: kept.collect() })
    }

    /// Initial offsets: zero, or the best of a search over all offsets where errors may be radians in the lowest
    /// channel.
    fn initial_offsets(
        &self,
        highest_channels: &[usize],
        signal: &KnownSignal,
    ) -> Result<Vec<Vec<[f64; 3]>>, ModelError> {
        let Self { config, normal_hat, .. } = *self;
        let SolverConfig { position_sigma_m, amplitude_sigma, .. } = *config;
        let lowest = highest_channels.first().copied();
        let lowest = lowest.filter(|c| is_searched(position_sigma_m, self.frequencies_hz[*c]));
        let Some(channel) = lowest else { return Ok(vec![vec![[0.0; 3]; normal_hat.len()]]) };
        let thinned = self.thinned(&[channel], SEARCHED_MAX);
        let data: Vec<_> =
            thinned.into_iter().map(|(placed, beacon_is_on, _)| (placed, beacon_is_on)).collect();
        let reference = (config.reference_daughter as usize).saturating_sub(1);
        let search =
            GlobalSearch { channel, normal_hat, reference, position_sigma_m, amplitude_sigma, data: &data };
        search.find(signal)
    }

    /// Up to `count_max` visibilities of each pair in some channels, spread over the pass, each with the index of its
    /// channel in `channels`.
    fn thinned(&self, channels: &[usize], count_max: usize) -> Vec<(PlacedVisibilities, bool, usize)> {
        let mut all: BTreeMap<(usize, [u8; 2], bool), Vec<&PlacedVisibilities>> = BTreeMap::new();
        for (placed, beacon_is_on) in self.placed {
            if let Some(index) = channels.iter().position(|c| *c == usize::from(placed.channel.0)) {
                all.entry((index, [placed.pair.i, placed.pair.j], *beacon_is_on)).or_default().push(placed);
            }
        }
        let thin = |((index, _, beacon_is_on), parts): ((usize, [u8; 2], bool), Vec<&PlacedVisibilities>)| {
            let stride = parts.iter().map(|part| part.len()).sum::<usize>().div_ceil(count_max);
            let mut thinned = parts.first()?.without_visibilities();
            let visibilities = parts.iter().flat_map(|part| (0..part.len()).map(move |k| (part, k)));
            visibilities.step_by(stride.max(1)).for_each(|(part, k)| thinned.push_from(part, k));
            Some((thinned, beacon_is_on, index))
        };
        all.into_iter().filter_map(thin).collect()
    }
}

/// Highest channel of each step, from the lowest to the highest frequency.
fn highest_channels(frequencies_hz: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..frequencies_hz.len()).collect();
    order.sort_by(|a, b| frequencies_hz[*a].total_cmp(&frequencies_hz[*b]));
    let mut highest_channels: Vec<usize> = order.first().copied().into_iter().collect();
    for (k, &channel) in order.iter().enumerate().skip(1) {
        let limit_hz =
            highest_channels.last().map_or(0.0, |last| FREQUENCY_RATIO_MAX * frequencies_hz[*last]);
        let next_is_too_far = order.get(k + 1).is_none_or(|next| frequencies_hz[*next] > limit_hz);
        if next_is_too_far {
            highest_channels.push(channel);
        }
    }
    highest_channels
}

/// A step of the search: the data of some channels, and their parameters.
struct Step<'a> {
    search: &'a Search<'a>,
    layout: ParameterLayout,
    data: Vec<(PlacedVisibilities, bool, usize)>,
    wavelength_m: f64,
}

impl<'a> Step<'a> {
    fn new(search: &'a Search<'a>, channels: &[usize], count_max: usize) -> Self {
        let frequencies_hz: Vec<f64> = channels.iter().map(|c| search.frequencies_hz[*c]).collect();
        let highest_hz = frequencies_hz.iter().copied().fold(0.0, f64::max);
        Self {
            search,
            layout: ParameterLayout::new(search.config, search.normal_hat.len(), &frequencies_hz),
            data: search.thinned(channels, count_max),
            wavelength_m: SPEED_OF_LIGHT_M_S / highest_hz,
        }
    }

    /// Minimises from each starting position. Returns distinct minima, best first, with costs up to `cost_range`
    /// above the lowest.
    fn minima(
        &self,
        starts_m: Vec<Vec<[f64; 3]>>,
        cost_range: f64,
        signal: &mut KnownSignal,
    ) -> Result<Vec<Candidate>, ModelError> {
        let mut candidates = Vec::new();
        for position_m in starts_m {
            candidates.push(self.minimise(position_m, signal)?);
        }
        candidates.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        let cost_max = candidates.first().map_or(0.0, |best| best.cost + cost_range);
        let same_m = SAME_WAVELENGTHS * self.wavelength_m;
        let mut distinct: Vec<Candidate> = Vec::new();
        for candidate in candidates {
            let is_other = |other: &Candidate| moved_m(&other.position_m, &candidate.position_m) > same_m;
            if distinct.is_empty() || (candidate.cost <= cost_max && distinct.iter().all(is_other)) {
                distinct.push(candidate);
            }
        }
        Ok(distinct)
    }

    /// Minimises the cost from given positions.
    fn minimise(
        &self,
        mut position_m: Vec<[f64; 3]>,
        signal: &mut KnownSignal,
    ) -> Result<Candidate, ModelError> {
        let [initial_m, radius_m_max] = TRUST_WAVELENGTHS.map(|wavelengths| wavelengths * self.wavelength_m);
        let mut radius_m = initial_m;
        let mut blocks = self.model(&position_m, signal)?;
        let variance_factors = vec![1.0; blocks.len()];
        let sums = sums_of(&blocks, self.search.span_s, &self.layout, &variance_factors);
        let mut values = self.layout.starting_values(&sums, &position_m);
        let mut cost = self.cost(&blocks, &values);
        for _ in 0..MODELS_MAX {
            let found = self.step(&mut blocks, &values, (&position_m, radius_m));
            let next_m = found.values.position_m.clone();
            let moved_m = moved_m(&position_m, &next_m);
            let next_blocks = self.model(&next_m, signal)?;
            let next_cost = self.cost(&next_blocks, &found.values);
            if next_cost >= cost || next_cost.is_nan() {
                if moved_m < CONVERGED_WAVELENGTHS * self.wavelength_m {
                    break;
                }
                radius_m = 0.3 * moved_m.min(radius_m);
                continue;
            }
            if moved_m > 0.7 * radius_m {
                radius_m = (2.0 * radius_m).min(radius_m_max);
            }
            (position_m, blocks, values, cost) = (next_m, next_blocks, found.values, next_cost);
            if moved_m < CONVERGED_WAVELENGTHS * self.wavelength_m {
                break;
            }
        }
        Ok(Candidate { position_m, cost })
    }

    /// Parameter values of least cost with positions in a trust region.
    fn step(
        &self,
        blocks: &mut [ModelledBlock],
        values: &ParameterValues,
        (centre_m, radius_m): (&[[f64; 3]], f64),
    ) -> NewtonFit {
        let mut variance_factors = vec![1.0; blocks.len()];
        let (span_s, cut) = (self.search.span_s, self.search.config.outlier_sigma);
        blocks.par_iter_mut().zip(&mut variance_factors).for_each(|(block, variance_factor)| {
            let (gain, u) = self.layout.pair(values, block.channel, block.pair);
            mark_outliers(block, span_s, cut, gain, &u, variance_factor);
        });
        let sums: Vec<PairSums> = sums_of(blocks, span_s, &self.layout, &variance_factors);
        let mut found = self.layout.minimise(values.clone(), &sums, None, ITERATIONS_MAX);
        let mut sigma_m = radius_m;
        // The data may constrain positions a thousand times better than the trust radius.
        for _ in 0..24 {
            let moved_m = moved_m(centre_m, &found.values.position_m);
            if moved_m <= 1.5 * radius_m {
                break;
            }
            let trust_region = TrustRegion { centre_m, sigma_m };
            found = self.layout.minimise(values.clone(), &sums, Some(&trust_region), ITERATIONS_MAX);
            sigma_m *= 0.5;
        }
        found
    }

    fn model(
        &self,
        position_m: &[[f64; 3]],
        signal: &mut KnownSignal,
    ) -> Result<Vec<ModelledBlock>, ModelError> {
        let offsets = Offsets { offset_m: position_m.to_vec(), normal_hat: self.search.normal_hat.to_vec() };
        let placed: Vec<(&PlacedVisibilities, bool)> =
            self.data.iter().map(|(placed, beacon_is_on, _)| (placed, *beacon_is_on)).collect();
        let blocks = modelled(&placed, signal, &offsets)?.into_iter().zip(&self.data);
        Ok(blocks.map(|(block, (_, _, channel))| ModelledBlock { channel: *channel, ..block }).collect())
    }

    fn cost(&self, blocks: &[ModelledBlock], values: &ParameterValues) -> f64 {
        let (span_s, cut) = (self.search.span_s, self.search.config.outlier_sigma);
        let block_cost = |block: &ModelledBlock| {
            let (gain, u) = self.layout.pair(values, block.channel, block.pair);
            robust_cost(block, span_s, cut, gain, &u)
        };
        let costs: Vec<f64> = blocks.par_iter().map(block_cost).collect();
        self.layout.with_priors(values, costs.iter().sum())
    }
}

/// Largest movement of a daughter.
fn moved_m(before_m: &[[f64; 3]], after_m: &[[f64; 3]]) -> f64 {
    before_m.iter().zip(after_m).map(|(before, after)| norm(sub(*after, *before))).fold(0.0, f64::max)
}

/// Visibilities with their model, linearised about offsets.
pub(super) fn modelled(
    placed: &[(&PlacedVisibilities, bool)],
    signal: &mut KnownSignal,
    offsets: &Offsets,
) -> Result<Vec<ModelledBlock>, ModelError> {
    let models = signal.models(placed, offsets)?;
    let block = |((placed, _), model): (&(&PlacedVisibilities, bool), Vec<ModelTerms>)| ModelledBlock {
        channel: placed.channel.0.into(),
        pair: placed.pair,
        time_s: placed.time_s.clone(),
        value_k_sr: placed.value_k_sr.clone(),
        weight: placed.weight.clone(),
        model,
        is_out: vec![false; placed.len()],
    };
    Ok(placed.iter().zip(models).map(block).collect())
}
