//! Positions that are off by radians, even in the lowest channel: a search over all offsets.
//!
//! Daughter after daughter is set against those whose offsets are known, the best measured one first. A pair's gain takes what it
//! can: at each offset e it is the best complex number, and what counts is how much of the data M(b + e) then leaves. The model at
//! any offset follows from moments of its fringe with spherical harmonics (`moments`), in axes that turn with the orbit, in which
//! offsets are constant.
//!
//! There are many minima. Where the ends of the baseline's direction hold most of the signal, as a diffuse sky does on long
//! baselines, those half a wavelength apart along it are nearly alike. So several are kept, for each daughter and of all, and
//! what follows tells which one is right, or that it cannot be told.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use rayon::prelude::*;

use super::expansion::{degree_for, harmonics, offset_factors, real_harmonics};
use super::model::KnownSignal;
use super::moments::{MomentSetup, PairMoments, fixed_axes};
use super::reach::reach_radians;
use crate::frames::PlacedVisibilities;
use crate::response::model::ModelError;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, dot, norm, sub};

/// Steps of the grid away from the Moon, along the track and across it, rad.
const STEP_RADIANS: Vec3 = [TAU / 6.0, TAU / 12.0, TAU / 6.0];

/// Minima of the grid from which the search goes on along the track, of a daughter.
const STARTS: usize = 160;

/// Of those, from which it goes on in all directions.
const MINIMA: usize = 32;

/// Times that the grid's steps are halved, and moves with each step.
const HALVINGS: i32 = 4;
const MOVES: usize = 2;

/// Offsets of all daughters that are kept.
const KEPT: usize = 8;

/// Distance, rad, within which two minima are one.
const SAME_RADIANS: f64 = 0.7;

/// Offsets whose models are computed at once.
const BATCH: usize = 256;

/// Cost (-2 ln of the likelihood) above the least up to which positions are kept for the next daughter or channel.
pub(super) const KEPT_COST: f64 = 60.0;

/// Data of one channel.
pub(super) struct GlobalSearch<'a> {
    pub(super) channel: usize,
    pub(super) normal_hat: &'a [Vec3],
    pub(super) reference: usize,
    pub(super) position_sigma_m: f64,
    pub(super) amplitude_sigma: f64,
    /// Visibilities, and whether the artificial signal is on in them.
    pub(super) data: &'a [(PlacedVisibilities, bool)],
}

impl GlobalSearch<'_> {
    /// Offsets of all daughters, m: the best ones, best first.
    pub(super) fn find(&self, signal: &KnownSignal) -> Result<Vec<Vec<[f64; 3]>>, ModelError> {
        let (_, frequency_hz) = signal.beacon(self.channel);
        let per_m = TAU * frequency_hz / SPEED_OF_LIGHT_M_S;
        let reach = reach_radians(self.position_sigma_m, frequency_hz);
        // Of the difference of two amplitudes.
        let amplitude_sigma = std::f64::consts::SQRT_2 * self.amplitude_sigma;
        let grid = Grid::new(reach, self.position_sigma_m * per_m, amplitude_sigma);
        let axes = fixed_axes(self.normal_hat[self.reference]);
        let functions = self.functions(signal, axes, grid.l_max);
        let Self { channel, normal_hat, .. } = *self;
        let setup = MomentSetup { signal, channel, normal_hat, axes, l_max: grid.l_max, functions };
        let mut kept = vec![(vec![[0.0; 3]; self.normal_hat.len()], 0.0)];
        let order = self.order();
        for (k, &daughter) in order.iter().enumerate().skip(1) {
            let is_of = |placed: &PlacedVisibilities| {
                let [i, j] = [placed.pair.i, placed.pair.j].map(usize::from);
                (i == daughter && order[..k].contains(&j)) || (j == daughter && order[..k].contains(&i))
            };
            if !self.data.iter().any(|(placed, _)| is_of(placed)) {
                continue;
            }
            let mut next = Vec::new();
            for (offset_m, cost) in &kept {
                let of_daughter = self.data.iter().filter(|(placed, _)| is_of(placed));
                let pairs: Vec<PairMoments> = of_daughter
                    .map(|data| setup.moments(data, daughter, offset_m))
                    .collect::<Result<_, ModelError>>()?;
                for ([up, along, across], more) in grid.minima(&pairs) {
                    let mut offset_m = offset_m.clone();
                    offset_m[daughter] = [along, across, up].map(|radians| radians / per_m);
                    next.push((offset_m, cost + more));
                }
            }
            next.sort_by(|a, b| a.1.total_cmp(&b.1));
            let most = next.first().map_or(0.0, |best| best.1 + KEPT_COST);
            next.retain(|one| one.1 <= most);
            next.truncate(KEPT);
            // Without any number there is nothing to tell offsets by.
            if !next.is_empty() {
                kept = next;
            }
        }
        Ok(kept.into_iter().map(|(offset_m, _)| offset_m).collect())
    }

    /// Daughters in the order of their search, from the reference on: each the best measured against those before.
    fn order(&self) -> Vec<usize> {
        let daughters = self.normal_hat.len();
        let mut told = vec![0.0; daughters * daughters];
        for (placed, _) in self.data {
            let [i, j] = [placed.pair.i, placed.pair.j].map(usize::from);
            let power: f64 = placed
                .value_k_sr
                .iter()
                .zip(&placed.weight)
                .map(|(value, weight)| 0.5 * weight * value.norm_sqr())
                .sum();
            // Visibilities, less where they are noise.
            let signal =
                (power - placed.len() as f64).max(0.0) / power.max(f64::MIN_POSITIVE) * placed.len() as f64;
            told[i * daughters + j] += signal;
            told[j * daughters + i] += signal;
        }
        let mut order = vec![self.reference];
        while order.len() < daughters {
            let of = |n: usize| order.iter().map(|k| told[n * daughters + k]).sum::<f64>();
            let open = (0..daughters).filter(|n| !order.contains(n)).map(|n| (n, of(n)));
            let Some(next) = open.reduce(|best, one| if one.1 > best.1 { one } else { best }) else { break };
            order.push(next.0);
        }
        order
    }

    /// Harmonics at the pixels of the sky.
    fn functions(&self, signal: &KnownSignal, axes: [Vec3; 3], l_max: usize) -> Vec<f32> {
        let directions = signal.directions(self.channel);
        let count = harmonics(l_max);
        let mut functions = vec![0.0; directions.len() * count];
        functions.par_chunks_mut(count).zip(&directions).for_each(|(functions, n_hat)| {
            let mut values = vec![0.0; count];
            real_harmonics(axes.map(|axis| dot(axis, *n_hat)), l_max, &mut values);
            functions.iter_mut().zip(values).for_each(|(function, value)| *function = value as f32);
        });
        functions
    }
}

/// Offsets in a ball, as phases in rad: away from the Moon, along the track, across it.
struct Grid {
    l_max: usize,
    reach: f64,
    /// Of an offset, rad.
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
                    let place = [x, y, z];
                    let offset: Vec3 =
                        std::array::from_fn(|axis| f64::from(place[axis]) * STEP_RADIANS[axis]);
                    if norm(offset) <= reach {
                        offsets.insert(place, offset);
                    }
                }
            }
        }
        Self { l_max: degree_for(reach), reach, sigma, amplitude_sigma, offsets }
    }

    /// Offsets that leave the least of some pairs, with what they leave, best first.
    fn minima(&self, pairs: &[PairMoments]) -> Vec<(Vec3, f64)> {
        let offsets: Vec<Vec3> = self.offsets.values().copied().collect();
        let costs = self.costs(pairs, &offsets);
        let by_place: BTreeMap<&[i32; 3], f64> = self.offsets.keys().zip(costs.iter().copied()).collect();
        let is_least = |place: &[i32; 3], cost: f64| {
            let shifts = (0..27).map(|k| [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1]);
            let beside =
                shifts.filter_map(|[x, y, z]| by_place.get(&[place[0] + x, place[1] + y, place[2] + z]));
            beside.copied().all(|other| other >= cost)
        };
        let mut starts: Vec<(Vec3, f64)> = self
            .offsets
            .iter()
            .zip(&costs)
            .filter(|((place, _), cost)| is_least(place, **cost))
            .map(|((_, offset), cost)| (*offset, *cost))
            .collect();
        best_of(&mut starts, STARTS);
        // Along the track a position is known ten times better than across: a minimum may lie far below the nearest offset of the grid.
        let along: Vec<Vec3> = [-1.0, 1.0].map(|sign| [0.0, sign, 0.0]).to_vec();
        self.refine(pairs, &mut starts, &along);
        best_of(&mut starts, MINIMA);
        let around = (0..27).map(|k| [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1].map(f64::from));
        self.refine(pairs, &mut starts, &around.collect::<Vec<Vec3>>());
        best_of(&mut starts, MINIMA);
        let mut apart: Vec<(Vec3, f64)> = Vec::new();
        for one in starts {
            if apart.iter().all(|other| norm(sub(one.0, other.0)) > SAME_RADIANS) {
                apart.push(one);
            }
        }
        apart
    }

    /// Moves each start to the best of the offsets about it, in steps that become smaller.
    fn refine(&self, pairs: &[PairMoments], starts: &mut [(Vec3, f64)], about: &[Vec3]) {
        for halving in 1..=HALVINGS {
            let step = STEP_RADIANS.map(|step| step * 0.5_f64.powi(halving));
            for _ in 0..MOVES {
                let shifted = |at: &Vec3, shift: &Vec3| -> Vec3 {
                    let to = std::array::from_fn(|axis| at[axis] + step[axis] * shift[axis]);
                    if norm(to) <= self.reach { to } else { *at }
                };
                let offsets: Vec<Vec3> =
                    starts.iter().flat_map(|(at, _)| about.iter().map(|shift| shifted(at, shift))).collect();
                let costs = self.costs(pairs, &offsets);
                let found = offsets.chunks(about.len()).zip(costs.chunks(about.len()));
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

    /// What each offset leaves of the data, with its prior.
    fn costs(&self, pairs: &[PairMoments], offsets: &[Vec3]) -> Vec<f64> {
        let of_batch = |offsets: &[Vec3]| {
            let factors: Vec<f32> = offsets
                .iter()
                .flat_map(|offset| offset_factors(*offset, self.l_max))
                .map(|factor| factor as f32)
                .collect();
            let prior = |offset: &Vec3| dot(*offset, *offset) / (self.sigma * self.sigma);
            let mut costs: Vec<f64> = offsets.iter().map(prior).collect();
            for pair in pairs {
                pair.add_costs(&factors, harmonics(self.l_max), self.amplitude_sigma, &mut costs);
            }
            costs
        };
        offsets.par_chunks(BATCH).map(of_batch).collect::<Vec<_>>().concat()
    }
}

/// Keeps the first so many, best first.
fn best_of(starts: &mut Vec<(Vec3, f64)>, most: usize) {
    starts.sort_by(|a, b| a.1.total_cmp(&b.1));
    starts.truncate(most);
}
