//! Positions that are off by radians, even in the lowest channel: a search over all offsets.
//!
//! Daughter after daughter is set against those whose offsets are known, the best measured one first. A pair's gain takes what it
//! can: at each offset e it is the best complex number, and what counts is how much of the data M(b + e) then leaves. The model at
//! any offset follows from moments of its fringe with spherical harmonics (`expansion`), in axes that turn with the orbit, in which
//! offsets are constant.

use std::f64::consts::TAU;

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;
use rayon::prelude::*;

use super::expansion::{degree_for, harmonics, offset_factors, place, real_harmonics};
use super::model::KnownSignal;
use super::robust::spread_cost;
use crate::array::{track_axes, track_offset_m};
use crate::frames::PlacedVisibilities;
use crate::response::model::{ModelError, PairPosition};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, cross, dot, norm, sub, unit};

/// Phase of one standard deviation of an offset in the lowest channel, rad, from which on all offsets are searched.
const SEARCH_RADIANS: f64 = 0.8;

/// Standard deviations within which offsets are searched.
const REACH: f64 = 3.0;

/// Longest offset that is searched, rad: 400 harmonics, and 20,000 offsets on the grid.
const RADIANS_MAX: f64 = 15.0;

/// Step of the grid, rad: a sixth of a wavelength.
const STEP_RADIANS: f64 = TAU / 6.0;

/// Offsets of the grid from which the search goes on, and the least distance between two, rad.
const CANDIDATES: (usize, f64) = (8, 1.5);

/// Times that the grid's step is halved about each of them.
const HALVINGS: usize = 4;

/// Times that each daughter is set against all others.
const SWEEPS: usize = 2;

/// Offsets whose models are computed at once.
const BATCH: usize = 256;

/// Data of one channel.
pub(super) struct GlobalSearch<'a> {
    pub(super) channel: usize,
    pub(super) normal_hat: &'a [Vec3],
    pub(super) reference: usize,
    pub(super) position_sigma_m: f64,
    /// Visibilities, and whether the artificial signal is on in them.
    pub(super) data: &'a [(PlacedVisibilities, bool)],
}

/// A pair about offsets of the known daughter, with moments in axes that turn with the orbit.
struct PairMoments {
    value: Vec<Complex64>,
    weight: Vec<f64>,
    power: f64,
    /// A row a visibility: real parts of all moments, then imaginary ones.
    moments: Vec<f32>,
}

impl GlobalSearch<'_> {
    /// Whether the offsets of a channel have to be searched.
    pub(super) fn is_needed(position_sigma_m: f64, frequency_hz: f64) -> bool {
        TAU * frequency_hz / SPEED_OF_LIGHT_M_S * position_sigma_m > SEARCH_RADIANS
    }

    /// Offsets of all daughters, m.
    pub(super) fn find(&self, signal: &KnownSignal) -> Result<Vec<[f64; 3]>, ModelError> {
        let daughters = self.normal_hat.len();
        let mut offset_m = vec![[0.0; 3]; daughters];
        let (_, frequency_hz) = signal.beacon(self.channel);
        let per_m = TAU * frequency_hz / SPEED_OF_LIGHT_M_S;
        let grid = Grid::new((REACH * self.position_sigma_m * per_m).min(RADIANS_MAX));
        let functions = self.functions(signal, grid.l_max);
        let order = self.order();
        for sweep in 0..SWEEPS {
            for (k, &daughter) in order.iter().enumerate().skip(1) {
                let known = if sweep == 0 { &order[..k] } else { &order[..] };
                let mut pairs = Vec::new();
                for (placed, is_on) in self.data {
                    let [i, j] = [placed.pair.i, placed.pair.j].map(usize::from);
                    let other = if i == daughter { j } else { i };
                    if (i == daughter || j == daughter) && other != daughter && known.contains(&other) {
                        let about = (daughter, &offset_m[..], &functions[..], grid.l_max);
                        pairs.push(self.moments(placed, *is_on, about, signal)?);
                    }
                }
                if !pairs.is_empty() {
                    let sigma_radians = self.position_sigma_m * per_m;
                    let [up, along, across] = grid.best(&pairs, sigma_radians);
                    offset_m[daughter] = [along, across, up].map(|radians| radians / per_m);
                }
            }
        }
        Ok(offset_m)
    }

    /// Daughters in the order of their search, from the reference on: each the best measured against those before.
    fn order(&self) -> Vec<usize> {
        let daughters = self.normal_hat.len();
        let mut told = vec![0.0; daughters * daughters];
        for (placed, _) in self.data {
            let [i, j] = [placed.pair.i, placed.pair.j].map(usize::from);
            let power: f64 =
                placed.value_k_sr.iter().zip(&placed.weight).map(|(value, weight)| 0.5 * weight * value.norm_sqr()).sum();
            // Visibilities, less where they are noise.
            let signal = (power - placed.len() as f64).max(0.0) / power.max(f64::MIN_POSITIVE) * placed.len() as f64;
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

    /// Harmonics at the pixels of the sky, with the normal of the reference's orbit as pole.
    fn functions(&self, signal: &KnownSignal, l_max: usize) -> Vec<f32> {
        let axes = fixed_axes(self.normal_hat[self.reference]);
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

    /// Moments of a pair with the daughter in second place.
    fn moments(
        &self,
        placed: &PlacedVisibilities,
        is_on: bool,
        (daughter, offset_m, functions, l_max): (usize, &[[f64; 3]], &[f32], usize),
        signal: &KnownSignal,
    ) -> Result<PairMoments, ModelError> {
        let turns_round = usize::from(placed.pair.i) == daughter;
        let (first, r_first_m, r_own_m) = match turns_round {
            true => (usize::from(placed.pair.j), &placed.r_j_m, &placed.r_i_m),
            false => (usize::from(placed.pair.i), &placed.r_i_m, &placed.r_j_m),
        };
        let normal_hat = self.normal_hat[first];
        let flown = |r_m: Vec3| sub(r_m, track_offset_m(r_m, normal_hat, offset_m[first]));
        let place_of = |(r_i_m, r_j_m): (&Vec3, &Vec3)| PairPosition {
            r_i_m: flown(*r_i_m),
            r_j_m: *r_j_m,
            ..PairPosition::default()
        };
        let positions: Vec<PairPosition> = r_first_m.iter().zip(r_own_m).map(place_of).collect();
        let count = harmonics(l_max);
        let mut moments = signal.sums_with(self.channel, &positions, functions)?;
        moments.resize(2 * count * positions.len(), 0.0);
        let (beacon, frequency_hz) = signal.beacon(self.channel);
        let axes = fixed_axes(self.normal_hat[self.reference]);
        let mut of_beacon = vec![0.0; count];
        real_harmonics(axes.map(|axis| dot(axis, beacon.from_hat())), l_max, &mut of_beacon);
        for (position, moments) in positions.iter().zip(moments.chunks_exact_mut(2 * count)) {
            let (re, im) = moments.split_at_mut(count);
            if is_on {
                let wave = beacon.visibility_k_sr(position.r_i_m, position.r_j_m, frequency_hz);
                re.iter_mut().zip(&of_beacon).for_each(|(moment, function)| *moment += (wave.re * function) as f32);
                im.iter_mut().zip(&of_beacon).for_each(|(moment, function)| *moment += (wave.im * function) as f32);
            }
            let [_, _, up] = track_axes(position.r_j_m, self.normal_hat[daughter]);
            turn(re, im, l_max, dot(axes[1], up).atan2(dot(axes[0], up)));
        }
        let conjugate = |value: &Complex64| if turns_round { value.conj() } else { *value };
        let value: Vec<Complex64> = placed.value_k_sr.iter().map(conjugate).collect();
        let power = value.iter().zip(&placed.weight).map(|(value, weight)| weight * value.norm_sqr()).sum();
        Ok(PairMoments { value, weight: placed.weight.clone(), power, moments })
    }
}

/// Axes across a pole, and the pole.
fn fixed_axes(pole_hat: Vec3) -> [Vec3; 3] {
    // Any direction that is not near the pole.
    let away = if pole_hat[0].abs() < 0.7 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let x = unit(cross(away, pole_hat));
    [x, cross(pole_hat, x), pole_hat]
}

/// Turns moments to axes at an azimuth, and multiplies them by (-i)^l.
fn turn(re: &mut [f32], im: &mut [f32], l_max: usize, azimuth: f64) {
    for m in 1..=l_max as isize {
        let (sin, cos) = (m as f64 * azimuth).sin_cos();
        let (sin, cos) = (sin as f32, cos as f32);
        for l in m as usize..=l_max {
            let (plus, minus) = (place(l, m), place(l, -m));
            for part in [&mut *re, &mut *im] {
                let (c, s) = (part[plus], part[minus]);
                (part[plus], part[minus]) = (cos * c + sin * s, cos * s - sin * c);
            }
        }
    }
    for l in 0..=l_max {
        for k in l * l..(l + 1) * (l + 1) {
            (re[k], im[k]) = match l % 4 {
                0 => (re[k], im[k]),
                1 => (im[k], -re[k]),
                2 => (-re[k], -im[k]),
                _ => (-im[k], re[k]),
            };
        }
    }
}

/// Offsets in a ball, as phases in rad: away from the Moon, along the track, across it.
struct Grid {
    l_max: usize,
    reach: f64,
    offsets: Vec<Vec3>,
}

impl Grid {
    fn new(reach: f64) -> Self {
        let steps = (reach / STEP_RADIANS).floor() as i32;
        let axis = || (-steps..=steps).map(|k| f64::from(k) * STEP_RADIANS);
        let all = axis().flat_map(|x| axis().flat_map(move |y| axis().map(move |z| [x, y, z])));
        Self { l_max: degree_for(reach), reach, offsets: all.filter(|offset| norm(*offset) <= reach).collect() }
    }

    /// The offset that leaves the least of some pairs.
    fn best(&self, pairs: &[PairMoments], sigma: f64) -> Vec3 {
        let costs = self.costs(pairs, &self.offsets, sigma);
        let mut order: Vec<usize> = (0..costs.len()).collect();
        order.sort_by(|a, b| costs[*a].total_cmp(&costs[*b]));
        let mut starts: Vec<(Vec3, f64)> = Vec::new();
        for k in order {
            let is_apart = |(start, _): &(Vec3, f64)| norm(sub(*start, self.offsets[k])) > CANDIDATES.1;
            if starts.len() < CANDIDATES.0 && starts.iter().all(is_apart) {
                starts.push((self.offsets[k], costs[k]));
            }
        }
        let refined = starts.into_iter().map(|start| self.refined(pairs, start, sigma));
        refined.reduce(|best, one| if one.1 < best.1 { one } else { best }).map_or([0.0; 3], |best| best.0)
    }

    fn refined(&self, pairs: &[PairMoments], (mut at, mut cost): (Vec3, f64), sigma: f64) -> (Vec3, f64) {
        let mut step = 0.5 * STEP_RADIANS;
        for _ in 0..HALVINGS {
            // At most as far as the next offset of the grid.
            for _ in 0..4 {
                let about = (0..27).map(|k| [k % 3, k / 3 % 3, k / 9].map(|k| step * (f64::from(k) - 1.0)));
                let offsets: Vec<Vec3> = about
                    .map(|shift| std::array::from_fn(|axis| at[axis] + shift[axis]))
                    .filter(|offset| norm(*offset) <= self.reach)
                    .collect();
                let costs = self.costs(pairs, &offsets, sigma);
                let found = offsets.into_iter().zip(costs).reduce(|best, one| if one.1 < best.1 { one } else { best });
                match found.filter(|found| found.1 < cost) {
                    Some(found) => (at, cost) = found,
                    None => break,
                }
            }
            step *= 0.5;
        }
        (at, cost)
    }

    /// What each offset leaves of the data, see [`spread_cost`], with its prior.
    fn costs(&self, pairs: &[PairMoments], offsets: &[Vec3], sigma: f64) -> Vec<f64> {
        let of_batch = |offsets: &[Vec3]| {
            let factors: Vec<f32> = offsets
                .iter()
                .flat_map(|offset| offset_factors(*offset, self.l_max))
                .map(|factor| factor as f32)
                .collect();
            let mut costs: Vec<f64> = offsets.iter().map(|offset| dot(*offset, *offset) / (sigma * sigma)).collect();
            for pair in pairs {
                pair.add_costs(&factors, harmonics(self.l_max), &mut costs);
            }
            costs
        };
        offsets.par_chunks(BATCH).map(of_batch).collect::<Vec<_>>().concat()
    }
}

impl PairMoments {
    /// Adds what each offset leaves, with the best gain.
    fn add_costs(&self, factors: &[f32], count: usize, costs: &mut [f64]) {
        let (rows, offsets) = (2 * self.value.len(), costs.len());
        let mut model = vec![0.0_f32; rows * offsets];
        faer::linalg::matmul::matmul(
            MatMut::from_column_major_slice_mut(&mut model, rows, offsets),
            Accum::Replace,
            MatRef::from_row_major_slice(&self.moments, rows, count),
            MatRef::from_column_major_slice(factors, count, offsets),
            1.0,
            Par::Seq,
        );
        for (model, cost) in model.chunks_exact(rows.max(1)).zip(costs) {
            let (mut along, mut square) = (Complex64::ZERO, 0.0);
            for (k, (value, weight)) in self.value.iter().zip(&self.weight).enumerate() {
                let model = Complex64::new(model[2 * k].into(), model[2 * k + 1].into());
                along += weight * model.conj() * value;
                square += weight * model.norm_sqr();
            }
            let taken = if square > 0.0 { along.norm_sqr() / square } else { 0.0 };
            *cost += spread_cost((self.power - taken).max(0.0), self.value.len() as f64);
        }
    }
}
