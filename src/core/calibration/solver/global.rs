//! Search over all position offsets, where errors are radians of phase even in the lowest channel.
//!
//! Daughters are located one after another against those already located, the best measured first. At each offset e a
//! pair's gain is the best complex number; the cost is what M(b + e) then leaves of the data. The model at any offset
//! follows from moments of its fringe with spherical harmonics (`moments`), in axes that rotate with the orbit, in
//! which offsets are constant.
//!
//! There are many minima. Where most of the signal comes from the directions of the baseline's ends, as from a
//! diffuse sky on long baselines, minima half a wavelength apart along it are nearly alike. So several are kept, of
//! each daughter and of all together; later steps decide between them, or mark the position as ambiguous.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use rayon::prelude::*;

use super::expansion::{degree_of_offset, harmonic_count, offset_factors, real_harmonics};
use super::model::KnownSignal;
use super::moments::{MomentSetup, PairMoments, fixed_axes};
use super::reach::reach_radians;
use crate::frames::PlacedVisibilities;
use crate::response::model::ModelError;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, dot, norm, sub};

/// Steps of the grid away from the Moon, along the track and across it, rad.
const STEP_RADIANS: Vec3 = [TAU / 6.0, TAU / 12.0, TAU / 6.0];

/// Number of minima of the grid that are refined along the track, for each daughter.
const ALONG_TRACK_STARTS_MAX: usize = 160;

/// Number of these that are refined in all directions.
const MINIMA_MAX: usize = 32;

/// Number of halvings of the grid's steps.
const HALVINGS: i32 = 4;

/// Number of moves with each step.
const MOVES: usize = 2;

/// Maximum number of candidates for the offsets of all daughters.
const CANDIDATES_MAX: usize = 8;

/// Distance, rad, within which two minima count as the same.
const SAME_RADIANS: f64 = 0.7;

/// Number of offsets whose models are computed together.
const BATCH: usize = 256;

/// Cost (-2 ln of the likelihood) above the minimum up to which positions are kept for the next daughter or channel.
pub(super) const KEPT_COST: f64 = 60.0;

/// Search in the data of one channel.
pub(super) struct GlobalSearch<'a> {
    pub(super) channel: usize,
    pub(super) normal_hat: &'a [Vec3],
    pub(super) reference: usize,
    pub(super) position_sigma_m: f64,
    pub(super) amplitude_sigma: f64,
    /// Visibilities, and whether the artificial signal is on.
    pub(super) data: &'a [(PlacedVisibilities, bool)],
}

impl GlobalSearch<'_> {
    /// Finds the best offsets of all daughters, m, best first.
    pub(super) fn find(&self, signal: &KnownSignal) -> Result<Vec<Vec<[f64; 3]>>, ModelError> {
        let (_, frequency_hz) = signal.beacon(self.channel);
        let per_m = TAU * frequency_hz / SPEED_OF_LIGHT_M_S;
        let reach = reach_radians(self.position_sigma_m, frequency_hz);
        // Standard deviation of the difference of two log amplitudes.
        let amplitude_sigma = std::f64::consts::SQRT_2 * self.amplitude_sigma;
        let grid = Grid::new(reach, self.position_sigma_m * per_m, amplitude_sigma);
        let axes = fixed_axes(self.normal_hat[self.reference]);
        let functions = self.functions(signal, axes, grid.l_max);
        let Self { channel, normal_hat, .. } = *self;
        let setup = MomentSetup { signal, channel, normal_hat, axes, l_max: grid.l_max, functions };
        let mut candidates = vec![(vec![[0.0; 3]; self.normal_hat.len()], 0.0)];
        let order = self.order();
        for (k, &daughter) in order.iter().enumerate().skip(1) {
            let is_with_located = |placed: &PlacedVisibilities| {
                let [i, j] = [placed.pair.i, placed.pair.j].map(usize::from);
                (i == daughter && order[..k].contains(&j)) || (j == daughter && order[..k].contains(&i))
            };
            if !self.data.iter().any(|(placed, _)| is_with_located(placed)) {
                continue;
            }
            let mut next = Vec::new();
            for (offset_m, cost) in &candidates {
                let of_daughter = self.data.iter().filter(|(placed, _)| is_with_located(placed));
                let pairs: Vec<PairMoments> = of_daughter
                    .map(|data| setup.moments(data, daughter, offset_m))
                    .collect::<Result<_, ModelError>>()?;
                for ([up, along, across], added_cost) in grid.minima(&pairs) {
                    let mut offset_m = offset_m.clone();
                    offset_m[daughter] = [along, across, up].map(|radians| radians / per_m);
                    next.push((offset_m, cost + added_cost));
                }
            }
            next.sort_by(|a, b| a.1.total_cmp(&b.1));
            let cost_max = next.first().map_or(0.0, |best| best.1 + KEPT_COST);
            next.retain(|(_, cost)| *cost <= cost_max);
            next.truncate(CANDIDATES_MAX);
            // If no cost is finite, the data do not constrain the offsets.
            if !next.is_empty() {
                candidates = next;
            }
        }
        Ok(candidates.into_iter().map(|(offset_m, _)| offset_m).collect())
    }

    /// Daughters in the order of the search, the reference first: each is the one best measured against those before
    /// it.
    fn order(&self) -> Vec<usize> {
        let daughters = self.normal_hat.len();
        let mut pair_signal = vec![0.0; daughters * daughters];
        for (placed, _) in self.data {
            let [i, j] = [placed.pair.i, placed.pair.j].map(usize::from);
            let power: f64 = placed
                .value_k_sr
                .iter()
                .zip(&placed.weight)
                .map(|(value, weight)| 0.5 * weight * value.norm_sqr())
                .sum();
            // The number of visibilities, times the fraction of their power that is signal.
            let signal =
                (power - placed.len() as f64).max(0.0) / power.max(f64::MIN_POSITIVE) * placed.len() as f64;
            pair_signal[i * daughters + j] += signal;
            pair_signal[j * daughters + i] += signal;
        }
        let mut order = vec![self.reference];
        while order.len() < daughters {
            let signal_with_located =
                |n: usize| order.iter().map(|k| pair_signal[n * daughters + k]).sum::<f64>();
            let open = (0..daughters).filter(|n| !order.contains(n)).map(|n| (n, signal_with_located(n)));
            let Some(next) = open.reduce(|best, one| if one.1 > best.1 { one } else { best }) else { break };
            order.push(next.0);
        }
        order
    }

    /// Real spherical harmonics at the pixels of the sky.
    fn functions(&self, signal: &KnownSignal, axes: [Vec3; 3], l_max: usize) -> Vec<f32> {
        let directions = signal.directions(self.channel);
        let count = harmonic_count(l_max);
        let mut functions = vec![0.0; directions.len() * count];
        functions.par_chunks_mut(count).zip(&directions).for_each(|(functions, n_hat)| {
            let mut values = vec![0.0; count];
            real_harmonics(axes.map(|axis| dot(axis, *n_hat)), l_max, &mut values);
            functions.iter_mut().zip(values).for_each(|(function, value)| *function = value as f32);
        });
        functions
    }
}

/// Grid of offsets in a ball, as phases in rad: away from the Moon, along the track, across it.
struct Grid {
    l_max: usize,
    reach: f64,
    /// Standard deviation of an offset, rad.
    sigma: f64,
    amplitude_sigma: f64,
    offsets: BTreeMap<[i32; 3], Vec3>,
}

impl Grid {
    fn new(reach: f64, sigma: f64, amplitude_sigma: f64) -> Self {
        let axis = |step: f64| {
            let steps = (reach / step).floor() as i32;
            -steps..=steps
        };
        let mut offsets = BTreeMap::new();
        for x in axis(STEP_RADIANS[0]) {
            for y in axis(STEP_RADIANS[1]) {
                for z in axis(STEP_RADIANS[2]) {
                    let cell = [x, y, z];
                    let offset: Vec3 = std::array::from_fn(|axis| f64::from(cell[axis]) * STEP_RADIANS[axis]);
                    if norm(offset) <= reach {
                        offsets.insert(cell, offset);
                    }
                }
            }
        }
        Self { l_max: degree_of_offset(reach), reach, sigma, amplitude_sigma, offsets }
    }

    /// Local minima of the cost of some pairs, with their costs, best first.
    fn minima(&self, pairs: &[PairMoments]) -> Vec<(Vec3, f64)> {
        let offsets: Vec<Vec3> = self.offsets.values().copied().collect();
        let costs = self.costs(pairs, &offsets);
        let cost_of_cell: BTreeMap<&[i32; 3], f64> = self.offsets.keys().zip(costs.iter().copied()).collect();
        let is_minimum = |cell: &[i32; 3], cost: f64| {
            let shifts = (0..27).map(|k| [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1]);
            let neighbours =
                shifts.filter_map(|[x, y, z]| cost_of_cell.get(&[cell[0] + x, cell[1] + y, cell[2] + z]));
            neighbours.copied().all(|other| other >= cost)
        };
        let mut starts: Vec<(Vec3, f64)> = self
            .offsets
            .iter()
            .zip(&costs)
            .filter(|((cell, _), cost)| is_minimum(cell, **cost))
            .map(|((_, offset), cost)| (*offset, *cost))
            .collect();
        best_of(&mut starts, ALONG_TRACK_STARTS_MAX);
        // Along the track a position is known ten times better than across it: a minimum may lie far below the
        // nearest offset of the grid.
        let along: Vec<Vec3> = [-1.0, 1.0].map(|sign| [0.0, sign, 0.0]).to_vec();
        self.refine(pairs, &mut starts, &along);
        best_of(&mut starts, MINIMA_MAX);
        let around = (0..27).map(|k| [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1].map(f64::from));
        self.refine(pairs, &mut starts, &around.collect::<Vec<Vec3>>());
        best_of(&mut starts, MINIMA_MAX);
        let mut distinct: Vec<(Vec3, f64)> = Vec::new();
        for start in starts {
            if distinct.iter().all(|other| norm(sub(start.0, other.0)) > SAME_RADIANS) {
                distinct.push(start);
            }
        }
        distinct
    }

    /// Moves each start to the best of the offsets around it, with decreasing steps.
    fn refine(&self, pairs: &[PairMoments], starts: &mut [(Vec3, f64)], directions: &[Vec3]) {
        for halving in 1..=HALVINGS {
            let step = STEP_RADIANS.map(|step| step * 0.5_f64.powi(halving));
            for _ in 0..MOVES {
                let shifted = |at: &Vec3, shift: &Vec3| -> Vec3 {
                    let to = std::array::from_fn(|axis| at[axis] + step[axis] * shift[axis]);
                    if norm(to) <= self.reach { to } else { *at }
                };
                let offsets: Vec<Vec3> = starts
                    .iter()
                    .flat_map(|(at, _)| directions.iter().map(|shift| shifted(at, shift)))
                    .collect();
                let costs = self.costs(pairs, &offsets);
                let found = offsets.chunks(directions.len()).zip(costs.chunks(directions.len()));
                for (start, (offsets, costs)) in starts.iter_mut().zip(found) {
                    for (offset, cost) in offsets.iter().zip(costs) {
                        if *cost < start.1 {
                            *start = (*offset, *cost);
                        }
                    }
                }
            }
        }
    }

    /// Cost of each offset, with its prior.
    fn costs(&self, pairs: &[PairMoments], offsets: &[Vec3]) -> Vec<f64> {
        let batch_costs = |offsets: &[Vec3]| {
            let factors: Vec<f32> = offsets
                .iter()
                .flat_map(|offset| offset_factors(*offset, self.l_max))
                .map(|factor| factor as f32)
                .collect();
            let prior = |offset: &Vec3| dot(*offset, *offset) / (self.sigma * self.sigma);
            let mut costs: Vec<f64> = offsets.iter().map(prior).collect();
            for pair in pairs {
                pair.add_costs(&factors, harmonic_count(self.l_max), self.amplitude_sigma, &mut costs);
            }
            costs
        };
        offsets.par_chunks(BATCH).map(batch_costs).collect::<Vec<_>>().concat()
    }
}

/// Keeps the best starts, up to `count_max`, best first.
fn best_of(starts: &mut Vec<(Vec3, f64)>, count_max: usize) {
    starts.sort_by(|a, b| a.1.total_cmp(&b.1));
    starts.truncate(count_max);
}
