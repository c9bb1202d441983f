//! Antennas by tables over angle and frequency, as codes of electromagnetic fields write them.
//!
//! A short dipole on a body has the field `E(n) = g d_perp (n . F n)`: its effective axis d, of which what is across the direction n
//! counts, and a symmetric form F of trace 3, which is 1 for a dipole that is short and alone. A table is fitted so at each of its
//! frequencies, and refused where it is something else. Overall factors are left to gains.

mod dipole_fit;
mod table_file;
#[cfg(test)]
mod tests;

use std::path::PathBuf;

pub use dipole_fit::FittedDipole;
use dipole_fit::{FittedSet, fit_table, scaled};
use table_file::read_table;
use thiserror::Error;

use crate::frames::AntennaResponse;
use crate::response::pixel::{DirectionForm, SatelliteAntenna};
use crate::units::vector::{Vec3, add, scale};

/// Why a table cannot be used.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{}: {what}", path.display())]
pub struct TableError {
    path: PathBuf,
    what: String,
}

/// Tables of the satellites: one for all, or one each.
#[derive(Clone, Debug, PartialEq)]
pub struct AntennaTables {
    tables: Vec<Vec<FittedSet>>,
}

impl AntennaTables {
    /// Reads tables and fits them; of each at most the part `left_max` (root mean square, of field or gain) may be left.
    ///
    /// # Errors
    /// A file that is no such table, or that no such dipoles fit.
    pub fn read(paths: &[PathBuf], left_max: f64) -> Result<Self, TableError> {
        let fitted = |path: &PathBuf| {
            let sets = read_table(path).and_then(|table| fit_table(&table, left_max));
            sets.map_err(|what| TableError { path: path.clone(), what })
        };
        Ok(Self { tables: paths.iter().map(fitted).collect::<Result<_, _>>()? })
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
        let above = sets.partition_point(|set| set.frequency_hz <= frequency_hz);
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
