//! Files of tables of antennas.

use std::collections::BTreeMap;
use std::path::Path;

use num_complex::Complex64;

use crate::files::{read_file, text_of};
use crate::units::{echo, shortened};

/// Largest table that is read, bytes: three dipoles at 8 frequencies each degree, at 30 each 2 degrees. A line takes 64 bytes in memory, eight
/// times the shortest.
const FILE_BYTES_MAX: u64 = 1 << 27;

/// Longest header that a message repeats, characters.
const HEADER_CHARS_MAX: usize = 200;

/// How much values of one direction may differ, relative to the table's greatest field or gain: as 0 and 360 deg may by rounding.
const REPEATED_ERROR_MAX: f64 = 1e-3;

/// What a table has in one direction.
#[derive(Clone, Copy)]
pub(super) enum Value {
    /// Fields along theta and phi.
    Field([Complex64; 2]),
    /// Gain in power.
    Gain(f64),
}

/// One line of a table.
pub(super) struct Sample {
    pub(super) theta_deg: f64,
    /// From 0 to below 360.
    pub(super) phi_deg: f64,
    line: u32,
    pub(super) value: Value,
}

/// Samples by frequency (its bits, which are in order) and dipole.
pub(super) type Table = BTreeMap<(u64, usize), Vec<Sample>>;

impl Value {
    fn size(self) -> f64 {
        match self {
            Self::Field([a, b]) => a.norm().hypot(b.norm()),
            Self::Gain(gain) => gain,
        }
    }

    fn apart(self, other: Self) -> f64 {
        match (self, other) {
            (Self::Field([a, b]), Self::Field([c, d])) => Self::Field([a - c, b - d]).size(),
            _ => (self.size() - other.size()).abs(),
        }
    }
}

/// Columns of a table, by name.
struct Columns {
    places: BTreeMap<String, usize>,
    count: usize,
    has_fields: bool,
    gain: Option<&'static str>,
}

const FIELDS: [&str; 4] = ["e_theta_re", "e_theta_im", "e_phi_re", "e_phi_im"];

impl Columns {
    fn of(header: &str) -> Result<Self, String> {
        let mut places: BTreeMap<String, usize> = BTreeMap::new();
        for (k, name) in header.split(',').map(str::trim).enumerate() {
            if places.insert(name.to_owned(), k).is_some() && !name.is_empty() {
                return Err(format!("several columns {:?}; expected one of each name", echo(name)));
            }
        }
        let has = |name: &str| places.contains_key(name);
        let has_fields = FIELDS.iter().all(|name| has(name));
        let gain = ["gain", "gain_db"].into_iter().find(|name| has(name));
        let angles = ["frequency_hz", "theta_deg", "phi_deg"].iter().all(|name| has(name));
        if !angles || has_fields == gain.is_some() {
            return Err(format!(
                "columns {:?}; expected frequency_hz, theta_deg, phi_deg, and either gain, gain_db or {}; dipole (1 to 3) if \
                 there are several",
                shortened(header, HEADER_CHARS_MAX),
                FIELDS.join(", ")
            ));
        }
        Ok(Self { places, count: header.split(',').count(), has_fields, gain })
    }

    /// A line's frequency and dipole, and its sample.
    fn sample(&self, line: &str, number: u32) -> Option<((u64, usize), Sample)> {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        if fields.iter().skip(self.count).any(|field| !field.is_empty()) {
            return None;
        }
        let value = |name: &str| -> Option<f64> {
            let value: f64 = fields.get(*self.places.get(name)?)?.parse().ok()?;
            value.is_finite().then_some(value)
        };
        let dipole = if self.places.contains_key("dipole") { value("dipole")? } else { 1.0 };
        let [hz, theta_deg, phi_deg] = [value("frequency_hz")?, value("theta_deg")?, value("phi_deg")?];
        if !(hz > 0.0 && (0.0..=180.0).contains(&theta_deg) && [1.0, 2.0, 3.0].contains(&dipole)) {
            return None;
        }
        let value = match self.gain {
            Some("gain_db") => Value::Gain(10f64.powf(value("gain_db")? / 10.0)),
            Some(gain) => Value::Gain(value(gain).filter(|gain| *gain >= 0.0)?),
            None => {
                let [a, b, c, d] = FIELDS.map(value);
                Value::Field([Complex64::new(a?, b?), Complex64::new(c?, d?)])
            }
        };
        // A zero with a sign is the same direction.
        let [theta_deg, phi_deg] = [theta_deg, phi_deg.rem_euclid(360.0)].map(|angle| angle + 0.0);
        Some(((hz.to_bits(), dipole as usize - 1), Sample { theta_deg, phi_deg, line: number, value }))
    }
}

/// Reads a table, with each direction once.
pub(super) fn read_table(path: &Path) -> Result<Table, String> {
    let bytes = read_file(path, FILE_BYTES_MAX).map_err(|source| source.to_string())?;
    let text = text_of(&bytes).map_err(|form| format!("{form}; expected CSV as plain text"))?;
    let mut lines =
        text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'));
    let (_, header) = lines.next().ok_or("no lines; expected a line of columns")?;
    let columns = Columns::of(header)?;
    let mut table = Table::new();
    for (k, line) in lines {
        let Some((key, sample)) = columns.sample(line, k as u32 + 1) else {
            return Err(format!(
                "line {}: found {:?}; expected {} finite numbers: a frequency above 0, theta from 0 to 180 deg, a dipole from 1 to 3, a \
                 gain of 0 or more",
                k + 1,
                echo(line),
                columns.count
            ));
        };
        table.entry(key).or_default().push(sample);
    }
    table.values_mut().try_for_each(leave_repeated_out)?;
    if columns.has_fields || !table.keys().any(|(_, dipole)| *dipole > 0) {
        return Ok(table);
    }
    // Gains of several dipoles do not say how their phases differ.
    Err(format!("gains of several dipoles; expected their fields, {}", FIELDS.join(", ")))
}

/// Leaves out directions that are there again: azimuths often go from 0 to 360 deg, of which the last is the first.
fn leave_repeated_out(samples: &mut Vec<Sample>) -> Result<(), String> {
    let greatest = samples.iter().map(|sample| sample.value.size()).fold(0.0, f64::max);
    let direction = |sample: &Sample| [sample.theta_deg, sample.phi_deg].map(f64::to_bits);
    samples.sort_by_key(|sample| (direction(sample), sample.line));
    let differ = |pair: &&[Sample]| {
        let is_repeated = direction(&pair[0]) == direction(&pair[1]);
        is_repeated && pair[0].value.apart(pair[1].value) > REPEATED_ERROR_MAX * greatest
    };
    if let Some([first, second]) = samples.windows(2).find(differ) {
        return Err(format!(
            "lines {} and {}: found different values at theta = {} deg, phi = {} deg; expected one of a frequency, dipole and direction",
            first.line, second.line, first.theta_deg, first.phi_deg
        ));
    }
    samples.dedup_by_key(|sample| direction(sample));
    samples.sort_by_key(|sample| sample.line);
    Ok(())
}
