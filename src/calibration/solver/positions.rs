//! Positions that are off by a good part of a wavelength.
//!
//! The model of a visibility is linear in a position within a tenth of a wavelength at most. So positions are found from the lowest
//! frequency upwards: first from the lowest channel alone, where they are the smallest part of a wavelength, then with the next one of
//! twice its frequency or less, and so on. At each step the model is made again about the positions found so far, which may move by
//! part of a wavelength of the highest channel, and only where the data then fit better (a trust region). A part of the visibilities
//! is enough for that; the solution is of all.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::config::SolverConfig;
use super::global::{GlobalSearch, KEPT_COST};
use super::layout::{ParameterLayout, Values};
use super::model::{KnownSignal, Offsets};
use super::newton::{NewtonFit, PositionPrior};
use super::reach::is_searched;
use super::robust::{judge, misfit};
use super::robust_fit::sums_of;
use super::sums::{ModelTerms, ModelledBlock, PairSums};
use crate::frames::PlacedVisibilities;
use crate::response::model::ModelError;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, norm, sub};

/// Most visibilities of a pair in a channel that positions are sought with.
const THINNED: usize = 320;

/// Most of them that all offsets are searched with.
const SEARCHED: usize = 160;

/// Distance, in wavelengths of the highest channel, that a position may move at first without a new model, and the most.
const TRUST_WAVELENGTHS: [f64; 2] = [0.1, 0.25];

/// Most models of one step.
const ROUNDS: usize = 30;

/// Movement, in wavelengths, that is none.
const SETTLED_WAVELENGTHS: f64 = 1e-3;

/// Positions closer than this, in wavelengths of the highest channel, are the same.
const SAME_WAVELENGTHS: f64 = 0.1;

/// Cost above the least within which other positions explain the data as well: three and a half standard deviations.
const AMBIGUOUS_COST: f64 = 12.0;

/// Most iterations of Gauss-Newton for one model.
const ITERATIONS: usize = 20;

/// Ratio of frequencies of one step and the next, if channels allow.
const OCTAVE: f64 = 2.0;

/// Data of a pass with positions to be found.
pub(super) struct Search<'a> {
    pub(super) config: &'a SolverConfig,
    pub(super) frequencies_hz: &'a [f64],
    pub(super) span_s: [f64; 2],
    pub(super) normal_hat: &'a [Vec3],
    /// Visibilities, and whether the artificial signal is on in them.
    pub(super) placed: &'a [(PlacedVisibilities, bool)],
}

/// Positions that were found.
pub(super) struct FoundPositions {
    /// Offsets of the daughters, m.
    pub(super) position_m: Vec<[f64; 3]>,
    /// Others that explain the data as well.
    others_m: Vec<Vec<[f64; 3]>>,
}

impl FoundPositions {
    /// Whether the position of a daughter may be another one, as far as a frequency can tell.
    pub(super) fn is_ambiguous(&self, daughter: usize, frequency_hz: f64) -> bool {
        let most_m = SAME_WAVELENGTHS * SPEED_OF_LIGHT_M_S / frequency_hz;
        self.others_m.iter().any(|other_m| norm(sub(other_m[daughter], self.position_m[daughter])) > most_m)
    }
}

/// Offsets of the daughters, and their cost.
type Place = (Vec<[f64; 3]>, f64);

impl Search<'_> {
    /// Finds the offsets of the daughters.
    pub(super) fn find(&self, signal: &mut KnownSignal) -> Result<FoundPositions, ModelError> {
        let ladder = ladder(self.frequencies_hz);
        let mut kept = self.start(&ladder, signal)?;
        for top in 1..=ladder.len() {
            let step = Step::new(self, &ladder[..top], THINNED);
            kept =
                step.best(kept, KEPT_COST, signal)?.into_iter().map(|(position_m, _)| position_m).collect();
        }
        if kept.len() > 1 {
            let step = Step::new(self, &ladder, usize::MAX);
            kept = step
                .best(kept, AMBIGUOUS_COST, signal)?
                .into_iter()
                .map(|(position_m, _)| position_m)
                .collect();
        }
        let mut kept = kept.into_iter();
        let position_m = kept.next().unwrap_or_else(|| vec![[0.0; 3]; self.normal_hat.len()]);
        Ok(FoundPositions { position_m, others_m: kept.collect() })
    }

    /// Offsets to begin with: none, or the best of all where they are radians in the lowest channel.
    fn start(&self, ladder: &[usize], signal: &KnownSignal) -> Result<Vec<Vec<[f64; 3]>>, ModelError> {
        let Self { config, normal_hat, .. } = *self;
        let SolverConfig { position_sigma_m, amplitude_sigma, .. } = *config;
        let lowest = ladder.first().copied();
        let lowest = lowest.filter(|c| is_searched(position_sigma_m, self.frequencies_hz[*c]));
        let Some(channel) = lowest else { return Ok(vec![vec![[0.0; 3]; normal_hat.len()]]) };
        let thinned = self.thinned(&[channel], SEARCHED);
        let data: Vec<_> = thinned.into_iter().map(|(placed, is_on, _)| (placed, is_on)).collect();
        let reference = (config.reference_daughter as usize).saturating_sub(1);
        let search =
            GlobalSearch { channel, normal_hat, reference, position_sigma_m, amplitude_sigma, data: &data };
        search.find(signal)
    }

    /// At most so many visibilities of each pair in some channels, spread over the pass, each with its channel's place among them.
    fn thinned(&self, channels: &[usize], most: usize) -> Vec<(PlacedVisibilities, bool, usize)> {
        let mut all: BTreeMap<(usize, [u8; 2], bool), Vec<&PlacedVisibilities>> = BTreeMap::new();
        for (placed, is_on) in self.placed {
            if let Some(place) = channels.iter().position(|c| *c == usize::from(placed.channel.0)) {
                all.entry((place, [placed.pair.i, placed.pair.j], *is_on)).or_default().push(placed);
            }
        }
        let thin = |((place, _, is_on), parts): ((usize, [u8; 2], bool), Vec<&PlacedVisibilities>)| {
            let every = parts.iter().map(|part| part.len()).sum::<usize>().div_ceil(most);
            let mut thinned = parts.first()?.without_visibilities();
            let each = parts.iter().flat_map(|part| (0..part.len()).map(move |k| (part, k)));
            each.step_by(every.max(1)).for_each(|(part, k)| thinned.push_from(part, k));
            Some((thinned, is_on, place))
        };
        all.into_iter().filter_map(thin).collect()
    }
}

/// Channels by which to climb, from the lowest to the highest.
fn ladder(frequencies_hz: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..frequencies_hz.len()).collect();
    order.sort_by(|a, b| frequencies_hz[*a].total_cmp(&frequencies_hz[*b]));
    let mut ladder: Vec<usize> = order.first().copied().into_iter().collect();
    for (k, &channel) in order.iter().enumerate().skip(1) {
        let reach_hz = ladder.last().map_or(0.0, |last| OCTAVE * frequencies_hz[*last]);
        let next_is_too_far = order.get(k + 1).is_none_or(|next| frequencies_hz[*next] > reach_hz);
        if next_is_too_far {
            ladder.push(channel);
        }
    }
    ladder
}

/// A step of the ladder.
struct Step<'a> {
    search: &'a Search<'a>,
    layout: ParameterLayout,
    data: Vec<(PlacedVisibilities, bool, usize)>,
    wavelength_m: f64,
}

impl<'a> Step<'a> {
    fn new(search: &'a Search<'a>, channels: &[usize], most: usize) -> Self {
        let frequencies_hz: Vec<f64> = channels.iter().map(|c| search.frequencies_hz[*c]).collect();
        let highest_hz = frequencies_hz.iter().copied().fold(0.0, f64::max);
        Self {
            search,
            layout: ParameterLayout::new(search.config, search.normal_hat.len(), &frequencies_hz),
            data: search.thinned(channels, most),
            wavelength_m: SPEED_OF_LIGHT_M_S / highest_hz,
        }
    }

    /// Where one comes to from some positions, best first, up to a cost above the least.
    fn best(
        &self,
        from_m: Vec<Vec<[f64; 3]>>,
        cost: f64,
        signal: &mut KnownSignal,
    ) -> Result<Vec<Place>, ModelError> {
        let mut places = Vec::new();
        for position_m in from_m {
            places.push(self.climb(position_m, signal)?);
        }
        places.sort_by(|a: &Place, b: &Place| a.1.total_cmp(&b.1));
        let most = places.first().map_or(0.0, |best| best.1 + cost);
        let mut apart: Vec<Place> = Vec::new();
        for place in places {
            let is_other = |other: &Place| moved_m(&other.0, &place.0) > SAME_WAVELENGTHS * self.wavelength_m;
            if apart.is_empty() || (place.1 <= most && apart.iter().all(is_other)) {
                apart.push(place);
            }
        }
        Ok(apart)
    }

    /// Goes from positions to better ones.
    fn climb(&self, mut position_m: Vec<[f64; 3]>, signal: &mut KnownSignal) -> Result<Place, ModelError> {
        let [first, most] = TRUST_WAVELENGTHS.map(|part| part * self.wavelength_m);
        let mut radius_m = first;
        let mut blocks = self.model(&position_m, signal)?;
        let even = vec![1.0; blocks.len()];
        let sums = sums_of(&blocks, self.search.span_s, &self.layout, &even);
        let mut values = self.layout.start(&sums, &position_m);
        let mut cost = self.cost(&blocks, &values);
        for _ in 0..ROUNDS {
            let found = self.step(&mut blocks, &values, (&position_m, radius_m));
            let next_m = found.values.position_m.clone();
            let moved_m = moved_m(&position_m, &next_m);
            let next_blocks = self.model(&next_m, signal)?;
            let next_cost = self.cost(&next_blocks, &found.values);
            if next_cost >= cost || next_cost.is_nan() {
                if moved_m < SETTLED_WAVELENGTHS * self.wavelength_m {
                    break;
                }
                radius_m = 0.3 * moved_m.min(radius_m);
                continue;
            }
            if moved_m > 0.7 * radius_m {
                radius_m = (2.0 * radius_m).min(most);
            }
            (position_m, blocks, values, cost) = (next_m, next_blocks, found.values, next_cost);
            if moved_m < SETTLED_WAVELENGTHS * self.wavelength_m {
                break;
            }
        }
        Ok((position_m, cost))
    }

    /// Values of least cost with positions that stay within a distance.
    fn step(&self, blocks: &mut [ModelledBlock], values: &Values, near: (&[[f64; 3]], f64)) -> NewtonFit {
        let (position_m, radius_m) = near;
        let mut spreads = vec![1.0; blocks.len()];
        let (span_s, cut) = (self.search.span_s, self.search.config.outlier_sigma);
        blocks.par_iter_mut().zip(&mut spreads).for_each(|(block, spread)| {
            let (gain, u) = self.layout.pair(values, block.channel, block.pair);
            judge(block, span_s, cut, gain, &u, spread);
        });
        let sums: Vec<PairSums> = sums_of(blocks, span_s, &self.layout, &spreads);
        let mut found = self.layout.minimise(values.clone(), &sums, None, ITERATIONS);
        let mut sigma_m = radius_m;
        // The data may hold positions a thousand times better than they are known.
        for _ in 0..24 {
            let moved_m = moved_m(position_m, &found.values.position_m);
            if moved_m <= 1.5 * radius_m {
                break;
            }
            let near = PositionPrior { position_m, sigma_m };
            found = self.layout.minimise(values.clone(), &sums, Some(&near), ITERATIONS);
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
            self.data.iter().map(|(placed, is_on, _)| (placed, *is_on)).collect();
        let blocks = modelled(&placed, signal, &offsets)?.into_iter().zip(&self.data);
        Ok(blocks.map(|(block, (_, _, place))| ModelledBlock { channel: *place, ..block }).collect())
    }

    fn cost(&self, blocks: &[ModelledBlock], values: &Values) -> f64 {
        let (span_s, cut) = (self.search.span_s, self.search.config.outlier_sigma);
        let of = |block: &ModelledBlock| {
            let (gain, u) = self.layout.pair(values, block.channel, block.pair);
            misfit(block, span_s, cut, gain, &u)
        };
        let costs: Vec<f64> = blocks.par_iter().map(of).collect();
        self.layout.with_priors(values, costs.iter().sum())
    }
}

/// The farthest that a daughter moves.
fn moved_m(before_m: &[[f64; 3]], after_m: &[[f64; 3]]) -> f64 {
    before_m.iter().zip(after_m).map(|(before, after)| norm(sub(*after, *before))).fold(0.0, f64::max)
}

/// Visibilities with their model about offsets.
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
