//! Antennas by tables over angle and frequency, as codes of electromagnetic fields write them.
//!
//! A short dipole on a body has the field `E(n) = g d_perp (n . F n)`: its effective axis d, of which what is across the direction n
//! counts, and a symmetric form F of trace 3, which is 1 for a dipole that is short and alone. A table is fitted so at each of its
//! frequencies, and refused where it is something else. Overall factors are left to gains.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use num_complex::Complex64;
use thiserror::Error;

use crate::frames::AntennaResponse;
use crate::response::pixel::{DirectionForm, SatelliteAntenna};
use crate::units::vector::{Vec3, add, dot, scale, unit};

/// Largest table that is read, bytes: three dipoles at 30 frequencies each degree.
const FILE_BYTES_MAX: u64 = 1 << 29;

/// Fewest directions of a dipole at a frequency: a form and an axis have eight numbers.
const DIRECTIONS_MIN: usize = 40;

/// How much the directions of a table, weighted, may prefer one axis: an even grid over the sphere has a third of each.
const UNEVEN_MAX: f64 = 0.05;

/// Iterations of a fit; ten suffice.
const ITERATIONS: usize = 40;

/// Why a table cannot be used.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{}: {what}", path.display())]
pub struct TableError {
    path: PathBuf,
    what: String,
}

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
struct FittedSet {
    frequency_hz: f64,
    dipoles: Vec<FittedDipole>,
}

/// Tables of the satellites: one for all, or one each.
#[derive(Clone, Debug, PartialEq)]
pub struct AntennaTables {
    tables: Vec<Vec<FittedSet>>,
    /// Greatest part of a table that its fit leaves, by file.
    left: Vec<f64>,
}

/// What a table has in one direction.
#[derive(Clone, Copy)]
enum Value {
    /// Fields along theta and phi.
    Field([Complex64; 2]),
    /// Gain in power.
    Gain(f64),
}

/// A direction of a table on the axes of the body, with the unit vectors across it.
struct Sample {
    n_hat: Vec3,
    across: [Vec3; 2],
    /// Share of the sphere.
    weight: f64,
    value: Value,
}

impl AntennaTables {
    /// Reads tables and fits them; of each at most the part `left_max` (root mean square, of field or gain) may be left.
    ///
    /// # Errors
    /// A file that is no such table, or that no such dipoles fit.
    pub fn read(paths: &[PathBuf], left_max: f64) -> Result<Self, TableError> {
        let (mut tables, mut left) = (Vec::new(), Vec::new());
        for path in paths {
            let error = |what: String| TableError { path: path.clone(), what };
            let (sets, most) = fit_table(&read_table(path)?, left_max).map_err(error)?;
            tables.push(sets);
            left.push(most);
        }
        Ok(Self { tables, left })
    }

    /// Greatest part of each table that its fit leaves: root mean square over directions, relative to the table's.
    #[must_use]
    pub fn left(&self) -> &[f64] {
        &self.left
    }

    /// How many tables there are.
    #[must_use]
    pub fn count(&self) -> usize {
        self.tables.len()
    }

    /// Frequencies that all tables have in between, Hz.
    #[must_use]
    pub fn span_hz(&self) -> [f64; 2] {
        let ends =
            |sets: &Vec<FittedSet>| [sets.first(), sets.last()].map(|set| set.map(|set| set.frequency_hz));
        let spans = self.tables.iter().map(ends);
        spans.fold([0.0, f64::INFINITY], |[low, high], [from, until]| {
            [from.map_or(low, |from| low.max(from)), until.map_or(high, |until| high.min(until))]
        })
    }

    /// How many dipoles every table has; `None` if they differ.
    #[must_use]
    pub fn dipoles(&self) -> Option<usize> {
        let mut counts = self.tables.iter().flatten().map(|set| set.dipoles.len());
        let first = counts.next()?;
        counts.all(|count| count == first).then_some(first)
    }

    /// The dipoles of a satellite at a frequency, linear between the table's.
    #[must_use]
    pub fn dipoles_at(&self, satellite: usize, frequency_hz: f64) -> Vec<FittedDipole> {
        let Some(sets) = self.tables.get(satellite).or(self.tables.first()) else { return Vec::new() };
        let above = sets.iter().position(|set| set.frequency_hz > frequency_hz).unwrap_or(sets.len());
        let (low, high) = (&sets[above.saturating_sub(1)], &sets[above.min(sets.len() - 1)]);
        let step_hz = high.frequency_hz - low.frequency_hz;
        let part = if step_hz > 0.0 { (frequency_hz - low.frequency_hz) / step_hz } else { 0.0 };
        let between = |a: Vec3, b: Vec3| add(scale(1.0 - part, a), scale(part, b));
        let dipoles = low.dipoles.iter().zip(&high.dipoles).map(|(a, b)| FittedDipole {
            axis: between(a.axis, b.axis),
            form: [0, 1, 2].map(|k| between(a.form[k], b.form[k])),
        });
        scaled(dipoles.collect())
    }

    /// The antenna of a satellite at a frequency, whose body has the axes x, y, z.
    #[must_use]
    pub fn antenna(
        &self,
        satellite: usize,
        frequency_hz: f64,
        elements: AntennaResponse,
        body: [Vec3; 3],
    ) -> SatelliteAntenna {
        let turned = |v: Vec3| add(add(scale(v[0], body[0]), scale(v[1], body[1])), scale(v[2], body[2]));
        let dipoles = self.dipoles_at(satellite, frequency_hz);
        // Of one dipole the others are not used.
        let place = |k: usize| dipoles.get(k).or(dipoles.first());
        let axis = |k: usize| place(k).map_or([0.0; 3], |dipole| turned(dipole.axis));
        let form =
            |k: usize| place(k).map_or(DirectionForm::ONE, |dipole| DirectionForm::of(dipole.form, body));
        SatelliteAntenna { elements, axes: [0, 1, 2].map(axis), forms: Some([0, 1, 2].map(form)) }
    }
}

/// Dipoles whose mean square length is 1.
fn scaled(mut dipoles: Vec<FittedDipole>) -> Vec<FittedDipole> {
    let square = dipoles.iter().map(|dipole| dot(dipole.axis, dipole.axis)).sum::<f64>();
    let factor = (dipoles.len() as f64 / square).sqrt();
    dipoles.iter_mut().for_each(|dipole| dipole.axis = scale(factor, dipole.axis));
    dipoles
}

/// Samples by frequency (its bits, which are in order) and dipole.
type Table = BTreeMap<(u64, usize), Vec<Sample>>;

/// Columns of a table, by name.
struct Columns {
    places: BTreeMap<String, usize>,
    has_fields: bool,
    gain: Option<&'static str>,
}

const FIELDS: [&str; 4] = ["e_theta_re", "e_theta_im", "e_phi_re", "e_phi_im"];

impl Columns {
    fn of(header: &str) -> Result<Self, String> {
        let places: BTreeMap<String, usize> =
            header.split(',').enumerate().map(|(k, name)| (name.trim().to_owned(), k)).collect();
        let has = |name: &str| places.contains_key(name);
        let has_fields = FIELDS.iter().all(|name| has(name));
        let gain = ["gain", "gain_db"].into_iter().find(|name| has(name));
        let angles = ["frequency_hz", "theta_deg", "phi_deg"].iter().all(|name| has(name));
        if !angles || has_fields == gain.is_some() {
            return Err(format!(
                "columns {header:?}; expected frequency_hz, theta_deg, phi_deg, and either gain, gain_db or {}; dipole (1 to 3) if \
                 there are several",
                FIELDS.join(", ")
            ));
        }
        Ok(Self { places, has_fields, gain })
    }

    fn sample(&self, line: &str) -> Option<((u64, usize), [u64; 2], Sample)> {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let number = |name: &str| -> Option<f64> {
            let number: f64 = fields.get(*self.places.get(name)?)?.parse().ok()?;
            number.is_finite().then_some(number)
        };
        let dipole = if self.places.contains_key("dipole") { number("dipole")? } else { 1.0 };
        let [hz, theta_deg, phi_deg] = [number("frequency_hz")?, number("theta_deg")?, number("phi_deg")?];
        let phi_deg = phi_deg.rem_euclid(360.0);
        if !(hz > 0.0 && (0.0..=180.0).contains(&theta_deg) && [1.0, 2.0, 3.0].contains(&dipole)) {
            return None;
        }
        let value = match self.gain {
            Some("gain_db") => Value::Gain(10f64.powf(number("gain_db")? / 10.0)),
            Some(gain) => Value::Gain(number(gain).filter(|gain| *gain >= 0.0)?),
            None => {
                let [a, b, c, d] = FIELDS.map(number);
                Value::Field([Complex64::new(a?, b?), Complex64::new(c?, d?)])
            }
        };
        let ((sin_t, cos_t), (sin_p, cos_p)) =
            (theta_deg.to_radians().sin_cos(), phi_deg.to_radians().sin_cos());
        let n_hat = [sin_t * cos_p, sin_t * sin_p, cos_t];
        let across = [[cos_t * cos_p, cos_t * sin_p, -sin_t], [-sin_p, cos_p, 0.0]];
        let sample = Sample { n_hat, across, weight: sin_t, value };
        Some(((hz.to_bits(), dipole as usize - 1), [theta_deg.to_bits(), phi_deg.to_bits()], sample))
    }
}

fn read_table(path: &Path) -> Result<Table, TableError> {
    let error = |what: String| TableError { path: path.to_owned(), what };
    let size = std::fs::metadata(path).map_err(|source| error(source.to_string()))?.len();
    if size > FILE_BYTES_MAX {
        return Err(error(format!("{size} bytes; expected at most {FILE_BYTES_MAX}")));
    }
    let text = std::fs::read_to_string(path).map_err(|source| error(source.to_string()))?;
    let mut lines =
        text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'));
    let (_, header) = lines.next().ok_or_else(|| error("no lines; expected a line of columns".into()))?;
    let columns = Columns::of(header).map_err(error)?;
    let (mut table, mut seen) = (Table::new(), BTreeSet::new());
    for (k, line) in lines {
        let Some((key, angles, sample)) = columns.sample(line) else {
            let what = "a frequency above 0, theta from 0 to 180 deg, a dipole from 1 to 3, a gain of 0 or more, finite numbers";
            return Err(error(format!("line {}: found {line:?}; expected {what}", k + 1)));
        };
        // Azimuths often go from 0 to 360 deg: the last is the first again.
        if seen.insert((key, angles)) {
            table.entry(key).or_default().push(sample);
        }
    }
    if columns.has_fields || !table.keys().any(|(_, dipole)| *dipole > 0) {
        return Ok(table);
    }
    // Gains of several dipoles do not say how their phases differ.
    Err(error(format!("gains of several dipoles; expected their fields, {}", FIELDS.join(", "))))
}

/// Fits all frequencies and dipoles of a table; gives the greatest part that is left, too.
fn fit_table(table: &Table, left_max: f64) -> Result<(Vec<FittedSet>, f64), String> {
    let frequencies: BTreeSet<u64> = table.keys().map(|(hz, _)| *hz).collect();
    let dipoles = table.keys().map(|(_, dipole)| dipole + 1).max().unwrap_or(0);
    if dipoles == 0 {
        return Err("no directions; expected lines below the columns".into());
    }
    let (mut sets, mut most) = (Vec::new(), 0.0_f64);
    for bits in frequencies {
        let frequency_hz = f64::from_bits(bits);
        let at = |dipole: usize| format!("at {frequency_hz} Hz, dipole {}", dipole + 1);
        let mut samples = Vec::new();
        for dipole in 0..dipoles {
            let found = table.get(&(bits, dipole)).map_or(&[][..], Vec::as_slice);
            require_sphere(found).map_err(|what| format!("{}: {what}", at(dipole)))?;
            samples.push(found);
        }
        let phase = common_phase(&samples);
        let mut set = Vec::new();
        for (dipole, samples) in samples.into_iter().enumerate() {
            let (fitted, left) = fit(samples, phase, dipole);
            if left.is_nan() || left > left_max {
                return Err(format!(
                    "{}: a dipole with an effective axis and a form of degree 2 leaves {:.2} % of the table; expected at most \
                     {:.2} % (table_error_max)",
                    at(dipole),
                    100.0 * left,
                    100.0 * left_max
                ));
            }
            most = most.max(left);
            set.push(fitted);
        }
        sets.push(FittedSet { frequency_hz, dipoles: scaled(set) });
    }
    Ok((sets, most))
}

/// Requires directions all over the sphere.
fn require_sphere(samples: &[Sample]) -> Result<(), String> {
    let weight: f64 = samples.iter().map(|sample| sample.weight).sum();
    let mean = |of: &dyn Fn(&Sample) -> f64| samples.iter().map(|s| s.weight * of(s)).sum::<f64>() / weight;
    let uneven = (0..3).map(|k| {
        let first = mean(&|s| s.n_hat[k]).abs();
        first.max((3.0 * mean(&|s| s.n_hat[k] * s.n_hat[k]) - 1.0).abs())
    });
    let uneven = uneven.fold(0.0, f64::max);
    if samples.len() >= DIRECTIONS_MIN && uneven <= UNEVEN_MAX {
        return Ok(());
    }
    Err(format!(
        "{} directions; expected {DIRECTIONS_MIN} or more, at even steps of theta and phi over the whole sphere",
        samples.len()
    ))
}

/// The factor of length 1 that makes fields as real as they can be, with the first dipole along its nominal axis.
fn common_phase(dipoles: &[&[Sample]]) -> Complex64 {
    let mut square = Complex64::ZERO;
    for sample in dipoles.iter().copied().flatten() {
        if let Value::Field([a, b]) = sample.value {
            square += sample.weight * (a * a + b * b);
        }
    }
    let phase = Complex64::cis(-0.5 * square.arg());
    let along: f64 = dipoles
        .first()
        .copied()
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
fn modelled(x: &Numbers, sample: &Sample) -> ([f64; 2], [[f64; 8]; 2]) {
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
fn differences(x: &Numbers, sample: &Sample, phase: Complex64) -> [(f64, [f64; 8]); 2] {
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
fn fit(samples: &[Sample], phase: Complex64, dipole: usize) -> (FittedDipole, f64) {
    let whole = |of: &dyn Fn(&Sample) -> f64| samples.iter().map(|s| s.weight * of(s)).sum::<f64>();
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
fn start(samples: &[Sample], phase: Complex64, dipole: usize) -> Numbers {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::response::general::PairResponse;
    use crate::units::vector::{cross, norm, sub};

    /// Lines of a table each 5 deg, fields by direction.
    fn lines(dipole: usize, field: impl Fn(f64, f64) -> [Complex64; 2]) -> String {
        let mut text = String::new();
        for theta_deg in (0..=180).step_by(5) {
            for phi_deg in (0..=360).step_by(10) {
                let [a, b] = field(f64::from(theta_deg).to_radians(), f64::from(phi_deg).to_radians());
                text += &format!("2e6,{dipole},{theta_deg},{phi_deg},{},{},{},{}\n", a.re, a.im, b.re, b.im);
            }
        }
        text
    }

    const HEADER: &str =
        "# made by hand\nfrequency_hz,dipole,theta_deg,phi_deg,e_theta_re,e_theta_im,e_phi_re,e_phi_im\n";

    fn read(texts: &[String], left_max: f64) -> Result<AntennaTables, String> {
        let folder = tempfile::tempdir().unwrap();
        let write = |(k, text): (usize, &String)| {
            let path = folder.path().join(format!("{k}.csv"));
            std::fs::write(&path, text).unwrap();
            path
        };
        let paths: Vec<PathBuf> = texts.iter().enumerate().map(write).collect();
        AntennaTables::read(&paths, left_max).map_err(|error| error.to_string())
    }

    /// Field of a current along z with this form of its distribution, in a medium without a body: a half-wave dipole.
    fn half_wave(theta: f64) -> f64 {
        let (sin, cos) = theta.sin_cos();
        if sin < 1e-12 { 0.0 } else { (std::f64::consts::FRAC_PI_2 * cos).cos() / sin }
    }

    #[test]
    fn a_half_wave_dipole_has_the_numbers_of_other_code() {
        // numpy 2.3 (lstsq of fields) and SciPy 1.17 (least_squares of gains), weights sin(theta), the same steps.
        let [q, left] = [-0.159_040_876, 0.001_018_897];
        let phase = Complex64::from_polar(3.0, 2.0);
        let fields = HEADER.to_owned() + &lines(1, |theta, _| [half_wave(theta) * phase, Complex64::ZERO]);
        let gains: String = (0..=180)
            .step_by(5)
            .flat_map(|theta| (0..360).step_by(10).map(move |phi| (theta, phi)))
            .map(|(theta, phi)| {
                // 0 is -inf dB, which no code writes.
                let db = (10.0 * half_wave(f64::from(theta).to_radians()).powi(2).log10()).max(-200.0);
                format!("2e6,{theta},{phi},{db}\n")
            })
            .collect();
        let gains = format!("frequency_hz,theta_deg,phi_deg,gain_db\n{gains}");
        for (text, q, left) in [(fields, q, left), (gains, -0.161_104_852, 0.001_310_502)] {
            let tables = read(std::slice::from_ref(&text), 0.02).unwrap();
            let [FittedDipole { axis, form }] = tables.dipoles_at(0, 2e6)[..] else { panic!() };
            assert!(norm(sub(axis, [0.0, 0.0, 1.0])) < 1e-6, "{axis:?}");
            // 1 + q P_2 is 1 - q / 2 across the axis, 1 + q along it.
            let expected = [1.0 - 0.5 * q, 1.0 - 0.5 * q, 1.0 + q];
            for k in 0..3 {
                assert!((form[k][k] - expected[k]).abs() < 1e-6, "{form:?}: {expected:?}");
            }
            assert!((tables.left()[0] - left).abs() < 1e-6, "{:?}", tables.left());
            let said = read(&[text], 0.9 * left).unwrap_err();
            assert!(
                said.contains("at 2000000 Hz, dipole 1") && said.contains("of the table; expected at most"),
                "{said}"
            );
        }
    }

    /// A satellite whose three dipoles have other axes, lengths and forms than they should; the third axis and form are given by the body.
    fn skew(k: usize) -> ([f64; 3], [Vec3; 3]) {
        let axis = [[0.1, -0.05, 0.9], [1.1, 0.1, 0.0], [-0.1, 1.0, 0.2]][k];
        let a = 0.1 * (k as f64 + 1.0);
        (axis, [[1.0 + a, 0.05, 0.02], [0.05, 1.0 - 0.5 * a, -0.03], [0.02, -0.03, 1.0 - 0.5 * a]])
    }

    fn field_of(k: usize, n: Vec3) -> Vec3 {
        let (axis, form) = skew(k);
        let factor = dot(n, [0, 1, 2].map(|row| dot(form[row], n)));
        scale(factor, sub(axis, scale(dot(axis, n), n)))
    }

    #[test]
    fn pairs_of_skew_dipoles_respond_by_the_products_of_their_fields() {
        let phase = Complex64::cis(0.7);
        let across = |theta: f64, phi: f64| {
            let ((st, ct), (sp, cp)) = (theta.sin_cos(), phi.sin_cos());
            ([st * cp, st * sp, ct], [[ct * cp, ct * sp, -st], [-sp, cp, 0.0]])
        };
        let of_dipole = |k: usize| {
            lines(k + 1, |theta, phi| {
                let (n, basis) = across(theta, phi);
                basis.map(|e| phase * dot(field_of(k, n), e))
            })
        };
        let text = HEADER.to_owned() + &[0, 1, 2].map(of_dipole).concat();
        let tables = read(&[text], 1e-6).unwrap();
        assert_eq!((tables.dipoles(), tables.span_hz()), (Some(3), [2e6, 2e6]));
        // Lengths are relative to the root of the mean square.
        let square: f64 = (0..3).map(|k| dot(skew(k).0, skew(k).0)).sum::<f64>() / 3.0;
        let x = unit([0.3, -0.7, 0.2]);
        let y = unit(cross([0.1, 0.2, 0.9], x));
        let body = [x, y, cross(x, y)];
        let on_body = |v: Vec3| body.map(|axis| dot(axis, v));
        let antenna = |body| tables.antenna(5, 2e6, AntennaResponse::ThreeDipoles, body);
        let straight = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let response = PairResponse::of_antennas([&antenna(straight), &antenna(body)]);
        assert_eq!(response.degree(), 6);
        for n in [[0.2, 0.3, -0.7], [1.0, 0.0, 0.0], [-0.4, 0.9, 0.1]].map(unit) {
            let turned = |v: Vec3| add(add(scale(v[0], x), scale(v[1], y)), scale(v[2], body[2]));
            let product = |k: usize| dot(field_of(k, n), turned(field_of(k, on_body(n))));
            let expected = 0.5 * (product(0) + product(1) + product(2)) / square;
            assert!((response.value(n) - expected).abs() < 1e-9, "{} {expected}", response.value(n));
        }
    }

    #[test]
    fn frequencies_between_are_linear_and_files_are_of_daughters() {
        let of = |hz: &str, x: f64| {
            let text = lines(1, |theta, phi| {
                // d = (x, 0, 1).
                let ((sin, cos), (sp, cp)) = (theta.sin_cos(), phi.sin_cos());
                [Complex64::from(x * cos * cp - sin), Complex64::from(-x * sp)]
            });
            text.replace("2e6", hz)
        };
        let first = HEADER.to_owned() + &of("1e6", 0.0) + &of("3e6", 0.4);
        let second = HEADER.to_owned() + &of("0.5e6", 0.0) + &of("2e6", 0.0);
        let tables = read(&[first, second], 1e-6).unwrap();
        assert_eq!((tables.count(), tables.span_hz()), (2, [1e6, 2e6]));
        let axis = |satellite, hz| tables.dipoles_at(satellite, hz)[0].axis;
        // Half way between unit vectors along (0, 0, 1) and (0.4, 0, 1).
        let end = unit([0.4, 0.0, 1.0]);
        assert!(norm(sub(axis(0, 2e6), unit(add(end, [0.0, 0.0, 1.0])))) < 1e-9);
        assert!(norm(sub(axis(1, 1.5e6), [0.0, 0.0, 1.0])) < 1e-9);
    }

    #[test]
    fn what_is_no_dipole_is_refused() {
        let field = |theta: f64, phi: f64| [Complex64::from(-theta.sin()), Complex64::from(0.0 * phi)];
        let good = lines(1, field);
        let half: String = good
            .lines()
            .filter(|line| line.split(',').nth(2).unwrap().parse::<f64>().unwrap() <= 90.0)
            .map(|line| format!("{line}\n"))
            .collect();
        let lopsided = lines(1, |theta, phi| {
            [Complex64::from(theta.sin() * (1.0 + 0.3 * theta.sin() * phi.cos())), Complex64::ZERO]
        });
        let phased = lines(1, |theta, phi| {
            [theta.sin() * Complex64::cis(0.3 * theta.sin() * phi.cos()), Complex64::ZERO]
        });
        for (text, expected) in [
            (format!("{HEADER}{half}"), "even steps of theta and phi over the whole sphere"),
            (format!("{HEADER}{lopsided}"), "of the table; expected at most 2.00 %"),
            (format!("{HEADER}{phased}"), "of the table; expected at most 2.00 %"),
            (format!("{HEADER}{good}2e6,1,190,0,0,0,0,0\n"), "line 1372: found \"2e6,1,190,0,0,0,0,0\""),
            (
                format!("{HEADER}{good}").replace("e_phi_im", "e_phi"),
                "expected frequency_hz, theta_deg, phi_deg",
            ),
            (HEADER.to_owned(), "no directions"),
            (String::new(), "no lines"),
            (
                "frequency_hz,dipole,theta_deg,phi_deg,gain\n1e6,1,0,0,1\n1e6,2,0,0,1\n".to_owned(),
                "gains of several dipoles",
            ),
        ] {
            let said = read(&[text], 0.02).unwrap_err();
            assert!(said.contains(expected), "{said}: expected {expected}");
        }
    }
}
