//! Model of a pair at any offset of one of its daughters, by moments of its fringe, and the cost of offsets.

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;

use super::expansion::{harmonic_count, harmonic_index, real_harmonics};
use super::model::KnownSignal;
use super::robust::scaled_cost;
use crate::array::{track_axes, track_offset_m};
use crate::frames::PlacedVisibilities;
use crate::response::model::{ModelError, PairPosition};
use crate::units::vector::{Vec3, cross, dot, sub, unit};

/// Maximum cost of a gain's amplitude, so that few data cannot outweigh the rest.
const AMPLITUDE_COST_MAX: f64 = 25.0;

/// Inputs of [`MomentSetup::moments`].
pub(super) struct MomentSetup<'a> {
    pub(super) signal: &'a KnownSignal,
    pub(super) channel: usize,
    pub(super) normal_hat: &'a [Vec3],
    /// Two axes perpendicular to the pole of the harmonics, and the pole.
    pub(super) axes: [Vec3; 3],
    pub(super) l_max: usize,
    /// Real spherical harmonics at the pixels of the sky.
    pub(super) functions: Vec<f32>,
}

/// Data of a pair, and the moments of its fringe about the offset of the known daughter, in axes that rotate with the
/// orbit.
pub(super) struct PairMoments {
    value: Vec<Complex64>,
    weight: Vec<f64>,
    power: f64,
    /// One row per visibility: real parts of all moments, then imaginary parts.
    moments: Vec<f32>,
}

impl MomentSetup<'_> {
    /// Computes the moments of a pair, conjugated if needed so that `daughter` is the second of the pair.
    pub(super) fn moments(
        &self,
        (placed, beacon_is_on): &(PlacedVisibilities, bool),
        daughter: usize,
        offset_m: &[[f64; 3]],
    ) -> Result<PairMoments, ModelError> {
        let is_conjugated = usize::from(placed.pair.i) == daughter;
        let (first, r_first_m, r_own_m) = match is_conjugated {
            true => (usize::from(placed.pair.j), &placed.r_j_m, &placed.r_i_m),
            false => (usize::from(placed.pair.i), &placed.r_i_m, &placed.r_j_m),
        };
        let normal_hat = self.normal_hat[first];
        let true_position = |r_m: Vec3| sub(r_m, track_offset_m(r_m, normal_hat, offset_m[first]));
        let pair_position = |(r_i_m, r_j_m): (&Vec3, &Vec3)| PairPosition {
            r_i_m: true_position(*r_i_m),
            r_j_m: *r_j_m,
            ..PairPosition::default()
        };
        let positions: Vec<PairPosition> = r_first_m.iter().zip(r_own_m).map(pair_position).collect();
        let count = harmonic_count(self.l_max);
        let mut moments = self.signal.sums_with(self.channel, &positions, &self.functions)?;
        moments.resize(2 * count * positions.len(), 0.0);
        let (beacon, frequency_hz) = self.signal.beacon(self.channel);
        let mut beacon_harmonics = vec![0.0; count];
        real_harmonics(
            self.axes.map(|axis| dot(axis, beacon.source_hat())),
            self.l_max,
            &mut beacon_harmonics,
        );
        for (position, moments) in positions.iter().zip(moments.chunks_exact_mut(2 * count)) {
            let (re, im) = moments.split_at_mut(count);
            if *beacon_is_on {
                let wave = beacon.visibility_k_sr(position.r_i_m, position.r_j_m, frequency_hz);
                re.iter_mut()
                    .zip(&beacon_harmonics)
                    .for_each(|(moment, function)| *moment += (wave.re * function) as f32);
                im.iter_mut()
                    .zip(&beacon_harmonics)
                    .for_each(|(moment, function)| *moment += (wave.im * function) as f32);
            }
            let [_, _, up] = track_axes(position.r_j_m, self.normal_hat[daughter]);
            rotate(re, im, self.l_max, dot(self.axes[1], up).atan2(dot(self.axes[0], up)));
        }
        let conjugate = |value: &Complex64| if is_conjugated { value.conj() } else { *value };
        let value: Vec<Complex64> = placed.value_k_sr.iter().map(conjugate).collect();
        let power = value.iter().zip(&placed.weight).map(|(value, weight)| weight * value.norm_sqr()).sum();
        Ok(PairMoments { value, weight: placed.weight.clone(), power, moments })
    }
}

/// Two axes perpendicular to a pole, and the pole.
pub(super) fn fixed_axes(pole_hat: Vec3) -> [Vec3; 3] {
    // Any direction away from the pole.
    let away = if pole_hat[0].abs() < 0.7 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let x = unit(cross(away, pole_hat));
    [x, cross(pole_hat, x), pole_hat]
}

/// Rotates moments to axes at an azimuth, and multiplies them by (-i)^l.
fn rotate(re: &mut [f32], im: &mut [f32], l_max: usize, azimuth: f64) {
    for m in 1..=l_max as isize {
        let (sin, cos) = (m as f64 * azimuth).sin_cos();
        let (sin, cos) = (sin as f32, cos as f32);
        for l in m as usize..=l_max {
            let (plus, minus) = (harmonic_index(l, m), harmonic_index(l, -m));
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
    /// Adds to `costs` what each offset leaves of the data with the best gain, and the cost of that gain's amplitude,
    /// whose logarithm has the standard deviation `amplitude_sigma`.
    pub(super) fn add_costs(
        &self,
        factors: &[f32],
        harmonic_count: usize,
        amplitude_sigma: f64,
        costs: &mut [f64],
    ) {
        let (rows, offsets) = (2 * self.value.len(), costs.len());
        let mut model = vec![0.0_f32; rows * offsets];
        faer::linalg::matmul::matmul(
            MatMut::from_column_major_slice_mut(&mut model, rows, offsets),
            Accum::Replace,
            MatRef::from_row_major_slice(&self.moments, rows, harmonic_count),
            MatRef::from_column_major_slice(factors, harmonic_count, offsets),
            1.0,
            Par::Seq,
        );
        for (model, cost) in model.chunks_exact(rows.max(1)).zip(costs) {
            let (mut projection, mut model_power) = (Complex64::ZERO, 0.0);
            for (k, (value, weight)) in self.value.iter().zip(&self.weight).enumerate() {
                let model = Complex64::new(model[2 * k].into(), model[2 * k + 1].into());
                projection += weight * model.conj() * value;
                model_power += weight * model.norm_sqr();
            }
            if model_power == 0.0 || projection.norm() == 0.0 {
                *cost += scaled_cost(self.power, self.value.len() as f64);
                continue;
            }
            *cost += scaled_cost(
                (self.power - projection.norm_sqr() / model_power).max(0.0),
                self.value.len() as f64,
            );
            if amplitude_sigma > 0.0 {
                *cost += ((projection.norm() / model_power).ln() / amplitude_sigma)
                    .powi(2)
                    .min(AMPLITUDE_COST_MAX);
            }
        }
    }
}
