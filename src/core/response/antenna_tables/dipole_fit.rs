//! Fits of an axis and a form to the tables of dipoles.

use std::collections::BTreeSet;

use num_complex::Complex64;

use super::table_file::{Sample, Table, Value};
use crate::units::vector::{Vec3, add, dot, scale, unit};

/// Fewest directions of a dipole at a frequency: a form and an axis have eight numbers.
const DIRECTIONS_MIN: usize = 40;

/// How much the directions of a table, weighted, may prefer one axis: an even grid over the sphere has a third of each.
const UNEVEN_MAX: f64 = 0.05;

/// Iterations of a fit; ten suffice.
const ITERATIONS: usize = 40;

/// Axis and form of one dipole on the axes of its body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedDipole {
    /// Effective axis; lengths are relative to the root of the mean square of a satellite's dipoles.
    pub axis: Vec3,
    /// n . F n by its matrix on the same axes.
    pub form: [Vec3; 3],
}

/// The dipoles of a satellite at one frequency.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct FittedSet {
    pub(super) frequency_hz: f64,
    pub(super) dipoles: Vec<FittedDipole>,
}

/// A direction of a table on the axes of the body, with the unit vectors across it.
struct TableDirection {
    n_hat: Vec3,
    across: [Vec3; 2],
    /// Share of the sphere.
    weight: f64,
    value: Value,
}

impl TableDirection {
    fn new(sample: &Sample) -> Self {
        let angles = [sample.theta_deg, sample.phi_deg];
        let [(sin_t, cos_t), (sin_p, cos_p)] = angles.map(|angle| angle.to_radians().sin_cos());
        let n_hat = [sin_t * cos_p, sin_t * sin_p, cos_t];
        let across = [[cos_t * cos_p, cos_t * sin_p, -sin_t], [-sin_p, cos_p, 0.0]];
        Self { n_hat, across, weight: sin_t, value: sample.value }
    }
}

/// Dipoles whose mean square length is 1.
pub(super) fn scaled(mut dipoles: Vec<FittedDipole>) -> Vec<FittedDipole> {
    let square = dipoles.iter().map(|dipole| dot(dipole.axis, dipole.axis)).sum::<f64>();
    let factor = (dipoles.len() as f64 / square).sqrt();
    dipoles.iter_mut().for_each(|dipole| dipole.axis = scale(factor, dipole.axis));
    dipoles
}

/// Fits all frequencies and dipoles of a table.
pub(super) fn fit_table(table: &Table, left_max: f64) -> Result<Vec<FittedSet>, String> {
    let frequencies: BTreeSet<u64> = table.keys().map(|(hz, _)| *hz).collect();
    let dipoles = table.keys().map(|(_, dipole)| dipole + 1).max().unwrap_or(0);
    if dipoles == 0 {
        return Err("no directions; expected lines below the columns".into());
    }
    let mut sets = Vec::new();
    for bits in frequencies {
        let frequency_hz = f64::from_bits(bits);
        let at = |dipole: usize| format!("at {frequency_hz} Hz, dipole {}", dipole + 1);
        let mut samples = Vec::new();
        for dipole in 0..dipoles {
            let found = table.get(&(bits, dipole)).map_or(&[][..], Vec::as_slice);
            let found: Vec<TableDirection> = found.iter().map(TableDirection::new).collect();
            require_sphere(&found).map_err(|what| format!("{}: {what}", at(dipole)))?;
            samples.push(found);
        }
        let phase = common_phase(&samples);
        let mut set = Vec::new();
        for (dipole, samples) in samples.iter().enumerate() {
            let (fitted, left) = fit(samples, phase, dipole);
            if left.is_nan() {
                return Err(format!(
                    "{}: all zero, or too large; expected fields or gains of a dipole",
                    at(dipole)
                ));
            }
            if left > left_max {
                return Err(format!(
                    "{}: a dipole with an effective axis and a form of degree 2 leaves {:.2} % of the table; expected at most \
                     {:.2} % (table_error_max)",
                    at(dipole),
                    100.0 * left,
                    100.0 * left_max
                ));
            }
            set.push(fitted);
        }
        sets.push(FittedSet { frequency_hz, dipoles: scaled(set) });
    }
    Ok(sets)
}

/// Requires directions all over the sphere.
fn require_sphere(samples: &[TableDirection]) -> Result<(), String> {
    let weight: f64 = samples.iter().map(|sample| sample.weight).sum();
    let mean =
        |of: &dyn Fn(&TableDirection) -> f64| samples.iter().map(|s| s.weight * of(s)).sum::<f64>() / weight;
    let uneven = (0..3).map(|k| {
        let first = mean(&|s| s.n_hat[k]).abs();
        first.max((3.0 * mean(&|s| s.n_hat[k] * s.n_hat[k]) - 1.0).abs())
    });
    let uneven = uneven.fold(0.0, f64::max);
    let count = samples.len();
    if count < DIRECTIONS_MIN {
        return Err(format!("{count} directions; expected {DIRECTIONS_MIN} or more over the whole sphere"));
    }
    if weight > 0.0 && uneven <= UNEVEN_MAX {
        return Ok(());
    }
    Err(format!(
        "{count} directions that are uneven or of a part of the sphere; expected even steps, in degrees, of theta from 0 to 180 and phi \
         from 0 to 360"
    ))
}

/// The factor of length 1 that makes fields as real as they can be, with the first dipole along its nominal axis.
fn common_phase(dipoles: &[Vec<TableDirection>]) -> Complex64 {
    let mut square = Complex64::ZERO;
    for sample in dipoles.iter().flatten() {
        if let Value::Field([a, b]) = sample.value {
            square += sample.weight * (a * a + b * b);
        }
    }
    let phase = Complex64::cis(-0.5 * square.arg());
    let along: f64 = dipoles
        .first()
        .into_iter()
        .flatten()
        .map(|sample| match sample.value {
            Value::Field(field) => {
                let nominal = nominal_axis(0);
                let [a, b] = [0, 1].map(|k| (field[k] * phase).re * dot(sample.across[k], nominal));
                sample.weight * (a + b)
            }
            Value::Gain(_) => 0.0,
        })
        .sum();
    if along < 0.0 { -phase } else { phase }
}

/// Where dipoles point: the first along z, the second along x, the third along y.
fn nominal_axis(dipole: usize) -> Vec3 {
    let mut axis = [0.0; 3];
    axis[(dipole + 2) % 3] = 1.0;
    axis
}

/// Numbers of a fit: an axis, and F less the identity by its components xx, yy, xy, xz, yz.
type Numbers = [f64; 8];

fn form_of(x: &Numbers) -> [Vec3; 3] {
    let [_, _, _, xx, yy, xy, xz, yz] = *x;
    [[1.0 + xx, xy, xz], [xy, 1.0 + yy, yz], [xz, yz, 1.0 - xx - yy]]
}

/// The model in a direction: its field across, and the derivatives.
fn modelled(x: &Numbers, sample: &TableDirection) -> ([f64; 2], [[f64; 8]; 2]) {
    let n = sample.n_hat;
    let form = form_of(x);
    let factor = dot(n, [0, 1, 2].map(|k| dot(form[k], n)));
    let by_form = [
        n[0] * n[0] - n[2] * n[2],
        n[1] * n[1] - n[2] * n[2],
        2.0 * n[0] * n[1],
        2.0 * n[0] * n[2],
        2.0 * n[1] * n[2],
    ];
    let mut slopes = [[0.0; 8]; 2];
    let mut field = [0.0; 2];
    for (k, e) in sample.across.into_iter().enumerate() {
        let along = dot([x[0], x[1], x[2]], e);
        field[k] = along * factor;
        for axis in 0..3 {
            slopes[k][axis] = e[axis] * factor;
        }
        for (slope, by) in slopes[k][3..].iter_mut().zip(by_form) {
            *slope = along * by;
        }
    }
    (field, slopes)
}

/// Differences of a sample from the model, and the model's derivatives: of fields two, of a gain one.
fn differences(x: &Numbers, sample: &TableDirection, phase: Complex64) -> [(f64, [f64; 8]); 2] {
    let (field, slopes) = modelled(x, sample);
    match sample.value {
        Value::Field(given) => [0, 1].map(|k| ((given[k] * phase).re - field[k], slopes[k])),
        Value::Gain(gain) => {
            let power = field[0] * field[0] + field[1] * field[1];
            let slope = std::array::from_fn(|j| 2.0 * (field[0] * slopes[0][j] + field[1] * slopes[1][j]));
            [(gain - power, slope), (0.0, [0.0; 8])]
        }
    }
}

/// Least squares by damped Newton steps from the nominal axis; gives the part that is left, too.
fn fit(samples: &[TableDirection], phase: Complex64, dipole: usize) -> (FittedDipole, f64) {
    let whole = |of: &dyn Fn(&TableDirection) -> f64| samples.iter().map(|s| s.weight * of(s)).sum::<f64>();
    let size = whole(&|s| match s.value {
        Value::Field([a, b]) => a.norm_sqr() + b.norm_sqr(),
        Value::Gain(gain) => gain * gain,
    });
    let imaginary = whole(&|s| match s.value {
        Value::Field(field) => field.map(|e| (e * phase).im.powi(2)).iter().sum(),
        Value::Gain(_) => 0.0,
    });
    let cost = |x: &Numbers| whole(&|s| differences(x, s, phase).map(|(d, _)| d * d).iter().sum::<f64>());
    let mut x = start(samples, phase, dipole);
    let (mut best, mut damping) = (cost(&x), 1e-3);
    for _ in 0..ITERATIONS {
        let mut matrix = [[0.0; 9]; 8];
        for sample in samples {
            for (difference, slopes) in differences(&x, sample, phase) {
                for i in 0..8 {
                    for j in 0..8 {
                        matrix[i][j] += sample.weight * slopes[i] * slopes[j];
                    }
                    matrix[i][8] += sample.weight * slopes[i] * difference;
                }
            }
        }
        (0..8).for_each(|k| matrix[k][k] *= 1.0 + damping);
        let Some(step) = solved(matrix) else { break };
        let next = std::array::from_fn(|k| x[k] + step[k]);
        let found = cost(&next);
        if found < best {
            let gained = best - found;
            (x, best, damping) = (next, found, damping * 0.1);
            if gained <= 1e-14 * size {
                break;
            }
        } else {
            damping *= 10.0;
        }
    }
    let left = ((best + imaginary) / size).sqrt();
    let axis = [x[0], x[1], x[2]];
    // An axis and its opposite have the same gain.
    let is_gain = samples.iter().any(|sample| matches!(sample.value, Value::Gain(_)));
    let turned = is_gain && dot(axis, nominal_axis(dipole)) < 0.0;
    (FittedDipole { axis: if turned { scale(-1.0, axis) } else { axis }, form: form_of(&x) }, left)
}

/// The nominal axis with the size of the table, and no form; of fields the axis that fits best.
fn start(samples: &[TableDirection], phase: Complex64, dipole: usize) -> Numbers {
    let weight: f64 = samples.iter().map(|s| s.weight).sum();
    let mut axis = [0.0; 3];
    let mut power = 0.0;
    for sample in samples {
        match sample.value {
            // The mean of a field is two thirds of its axis.
            Value::Field(field) => {
                for (part, across) in field.into_iter().zip(sample.across) {
                    let part = 1.5 * sample.weight / weight * (part * phase).re;
                    axis = add(axis, scale(part, across));
                }
            }
            Value::Gain(gain) => power += 1.5 * sample.weight / weight * gain,
        }
    }
    if power > 0.0 {
        axis = scale(power.sqrt(), unit(add(nominal_axis(dipole), [0.01, 0.02, 0.015])));
    }
    [axis[0], axis[1], axis[2], 0.0, 0.0, 0.0, 0.0, 0.0]
}

/// Solves eight equations, whose right-hand sides are in the last column; `None` if they are dependent.
fn solved(mut matrix: [[f64; 9]; 8]) -> Option<[f64; 8]> {
    for k in 0..8 {
        let pivot = (k..8).max_by(|a, b| matrix[*a][k].abs().total_cmp(&matrix[*b][k].abs()))?;
        matrix.swap(k, pivot);
        if matrix[k][k] == 0.0 || matrix[k][k].is_nan() {
            return None;
        }
        let from = matrix[k];
        for row in &mut matrix[k + 1..] {
            let factor = row[k] / from[k];
            row.iter_mut().zip(from).skip(k).for_each(|(x, of_pivot)| *x -= factor * of_pivot);
        }
    }
    let mut x = [0.0; 8];
    for k in (0..8).rev() {
        let known: f64 = (k + 1..8).map(|j| matrix[k][j] * x[j]).sum();
        x[k] = (matrix[k][8] - known) / matrix[k][k];
    }
    Some(x)
}
