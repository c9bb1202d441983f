//! Files of tables of antennas.

use std::collections::BTreeMap;
use std::path::Path;

use num_complex::Complex64;

use crate::files::{Columns, Row, Separator, TableFault, numbered_lines, read_file, text_of};

/// Largest table that is read, bytes: three dipoles at 8 frequencies each degree, at 30 each 2 degrees. A line takes 64 bytes in memory, eight
/// times the shortest.
const FILE_BYTES_MAX: u64 = 1 << 27;

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

    fn distance(self, other: Self) -> f64 {
        match (self, other) {
            (Self::Field([a, b]), Self::Field([c, d])) => Self::Field([a - c, b - d]).size(),
            _ => (self.size() - other.size()).abs(),
        }
    }
}

/// Places of the columns of a table.
struct Places {
    angles: [usize; 3],
    dipole: Option<usize>,
    values: ValuePlaces,
}

#[derive(Clone, Copy)]
enum ValuePlaces {
    Fields([usize; 4]),
    Gain(usize),
    GainDb(usize),
}

const FIELDS: [&str; 4] = ["e_theta_re", "e_theta_im", "e_phi_re", "e_phi_im"];

impl Places {
    fn of(columns: &Columns) -> Result<Self, TableFault> {
        let expected = format!(
            "frequency_hz, theta_deg, phi_deg, and either gain, gain_db or {}; dipole (1 to 3) if there are several",
            FIELDS.join(", ")
        );
        let angles = columns.places(["frequency_hz", "theta_deg", "phi_deg"], &expected)?;
        let fields: Vec<usize> = FIELDS
            .iter()
            .filter_map(|name| columns.place_of_name(name).transpose())
            .collect::<Result<_, _>>()?;
        let gains = [columns.place_of_name("gain")?, columns.place_of_name("gain_db")?];
        let values = match (&fields[..], gains) {
            (&[a, b, c, d], [None, None]) => ValuePlaces::Fields([a, b, c, d]),
            ([], [Some(gain), None]) => ValuePlaces::Gain(gain),
            ([], [None, Some(gain_db)]) => ValuePlaces::GainDb(gain_db),
            _ => return Err(columns.unlike(&expected)),
        };
        Ok(Self { angles, dipole: columns.place("dipole")?, values })
    }

    /// A line's frequency and dipole, and its sample.
    fn sample(&self, row: &Row<'_>) -> Result<((u64, usize), Sample), TableFault> {
        let any = |place| row.number(place, |_| true, "a finite number");
        let [hz, theta, phi] = self.angles;
        let hz = row.number(hz, |hz| hz > 0.0, "a frequency above 0")?;
        let theta_deg = row.number(theta, |theta| (0.0..=180.0).contains(&theta), "0 to 180 deg")?;
        let phi_deg = any(phi)?;
        let dipole = self.dipole.map_or(Ok(1.0), |place| {
            row.number(place, |dipole| [1.0, 2.0, 3.0].contains(&dipole), "a dipole from 1 to 3")
        })?;
        let value = match self.values {
            ValuePlaces::GainDb(gain) => Value::Gain(10f64.powf(any(gain)? / 10.0)),
            ValuePlaces::Gain(gain) => {
                Value::Gain(row.number(gain, |gain| gain >= 0.0, "a gain of 0 or more")?)
            }
            ValuePlaces::Fields([a, b, c, d]) => {
                Value::Field([Complex64::new(any(a)?, any(b)?), Complex64::new(any(c)?, any(d)?)])
            }
        };
        // A zero with a sign is the same direction.
        let [theta_deg, phi_deg] = [theta_deg, phi_deg.rem_euclid(360.0)].map(|angle| angle + 0.0);
        let sample = Sample { theta_deg, phi_deg, line: row.line as u32, value };
        Ok(((hz.to_bits(), dipole as usize - 1), sample))
    }
}

/// Reads a table, with each direction once.
pub(super) fn read_table(path: &Path) -> Result<Table, String> {
    let bytes = read_file(path, FILE_BYTES_MAX).map_err(|source| source.to_string())?;
    let text = text_of(&bytes).map_err(|form| format!("{form}; expected CSV as plain text"))?;
    let mut lines = numbered_lines(&text);
    let (line, names) = lines.next().ok_or("no lines; expected a line of columns")?;
    let told = |fault: TableFault| fault.to_string();
    let columns = Columns::new(line, names, Separator::Sign(',')).map_err(told)?;
    let places = Places::of(&columns).map_err(told)?;
    let mut table = Table::new();
    for (line, text) in lines {
        let (key, sample) = columns.row(line, text).and_then(|row| places.sample(&row)).map_err(told)?;
        table.entry(key).or_default().push(sample);
    }
    table.values_mut().try_for_each(leave_repeated_out)?;
    if matches!(places.values, ValuePlaces::Fields(_)) || !table.keys().any(|(_, dipole)| *dipole > 0) {
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
        is_repeated && pair[0].value.distance(pair[1].value) > REPEATED_ERROR_MAX * greatest
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
