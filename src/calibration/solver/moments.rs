//! A pair at any offset of one of its daughters: moments of its fringe, and what offsets leave of its data.

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;

use super::expansion::{harmonics, place, real_harmonics};
use super::model::KnownSignal;
use super::robust::spread_cost;
use crate::array::{track_axes, track_offset_m};
use crate::frames::PlacedVisibilities;
use crate::response::model::{ModelError, PairPosition};
use crate::units::vector::{Vec3, cross, dot, sub, unit};

/// Most that the amplitude of a gain costs: few data do not know it.
const MOST_AMPLITUDE_COST: f64 = 25.0;

/// What moments are made with.
pub(super) struct MomentSetup<'a> {
    pub(super) signal: &'a KnownSignal,
    pub(super) channel: usize,
    pub(super) normal_hat: &'a [Vec3],
    /// Axes across the pole of the harmonics, and the pole.
    pub(super) axes: [Vec3; 3],
    pub(super) l_max: usize,
    /// Harmonics at the pixels of the sky.
    pub(super) functions: Vec<f32>,
}

/// A pair about offsets of the known daughter, with moments in axes that turn with the orbit.
pub(super) struct PairMoments {
    value: Vec<Complex64>,
    weight: Vec<f64>,
    power: f64,
    /// A row a visibility: real parts of all moments, then imaginary ones.
    moments: Vec<f32>,
}

impl MomentSetup<'_> {
    /// Moments of a pair with the daughter in second place.
    pub(super) fn moments(
        &self,
        (placed, is_on): &(PlacedVisibilities, bool),
        daughter: usize,
        offset_m: &[[f64; 3]],
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
        let count = harmonics(self.l_max);
        let mut moments = self.signal.sums_with(self.channel, &positions, &self.functions)?;
        moments.resize(2 * count * positions.len(), 0.0);
        let (beacon, frequency_hz) = self.signal.beacon(self.channel);
        let mut of_beacon = vec![0.0; count];
        real_harmonics(self.axes.map(|axis| dot(axis, beacon.source_hat())), self.l_max, &mut of_beacon);
        for (position, moments) in positions.iter().zip(moments.chunks_exact_mut(2 * count)) {
            let (re, im) = moments.split_at_mut(count);
            if *is_on {
                let wave = beacon.visibility_k_sr(position.r_i_m, position.r_j_m, frequency_hz);
                re.iter_mut()
                    .zip(&of_beacon)
                    .for_each(|(moment, function)| *moment += (wave.re * function) as f32);
                im.iter_mut()
                    .zip(&of_beacon)
                    .for_each(|(moment, function)| *moment += (wave.im * function) as f32);
            }
            let [_, _, up] = track_axes(position.r_j_m, self.normal_hat[daughter]);
            turn(re, im, self.l_max, dot(self.axes[1], up).atan2(dot(self.axes[0], up)));
        }
        let conjugate = |value: &Complex64| if turns_round { value.conj() } else { *value };
        let value: Vec<Complex64> = placed.value_k_sr.iter().map(conjugate).collect();
        let power = value.iter().zip(&placed.weight).map(|(value, weight)| weight * value.norm_sqr()).sum();
        Ok(PairMoments { value, weight: placed.weight.clone(), power, moments })
    }
}

/// Axes across a pole, and the pole.
pub(super) fn fixed_axes(pole_hat: Vec3) -> [Vec3; 3] {
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

impl PairMoments {
    /// Adds what each offset leaves with the best gain, and the cost of its amplitude, whose logarithm has a deviation.
    pub(super) fn add_costs(&self, factors: &[f32], count: usize, amplitude_sigma: f64, costs: &mut [f64]) {
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
            if square == 0.0 || along.norm() == 0.0 {
                *cost += spread_cost(self.power, self.value.len() as f64);
                continue;
            }
            *cost += spread_cost((self.power - along.norm_sqr() / square).max(0.0), self.value.len() as f64);
            if amplitude_sigma > 0.0 {
                *cost += ((along.norm() / square).ln() / amplitude_sigma).powi(2).min(MOST_AMPLITUDE_COST);
            }
        }
    }
}
