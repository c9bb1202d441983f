//! Division by complex gains of the antennas.

use std::ops::Range;
use std::path::Path;

use num_complex::Complex64;

use super::gain_errors::ErrorTable;
use super::{Calibration, CalibrationError, CalibrationReport, GainsFile, Interpolation, PositionSolution};
use crate::array::track_offset_m;
use crate::frames::{Instrument, PlacedVisibilities};
use crate::units::Pair;
use crate::units::vector::sub;

/// Division by complex voltage gains of every antenna, by channel and time.
///
/// With E'_i = g_i E_i and V_ij = <E_i conj(E_j)>, the scalar case of the measurement equation
/// (Hamaker, Bregman & Sault 1996, A&AS 117, 137; Smirnov 2011, A&A 527, A106, Sect. 1.6):
///
/// - V'_ij = g_i conj(g_j) V_ij, so V_ij = V'_ij / c with c = g_i conj(g_j);
/// - noise of variance s^2 in each of the real and imaginary part becomes s^2 / |c|^2, as division by c rotates and scales
///   a circular distribution; so the weight, its inverse, is multiplied by |c|^2.
///
/// Between solutions at t_0 and t_1, with u = (t - t_0) / (t_1 - t_0), a gain is
/// g_0 exp(u ln(g_1 / g_0)), ln the principal value: log amplitude and phase are linear. This is right
/// while the phase turns by less than pi from one solution to the next.
///
/// Where the errors of gains are stated, each visibility carries draws of its relative error d_i + conj(d_j), d a draw of the error of ln g. That
/// of ln g is interpolated as ln g is.
#[derive(Clone, Debug)]
pub struct AntennaGains {
    interpolation: Interpolation,
    frequency_tolerance_hz: f64,
    satellites: usize,
    channels: Vec<ChannelTable>,
    positions: Vec<PositionSolution>,
    /// Number of draws of the errors.
    draws: usize,
    /// Seed of the draws.
    seed: u64,
}

/// Gains of one channel, prepared for interpolation.
#[derive(Clone, Debug)]
struct ChannelTable {
    frequency_hz: f64,
    /// Times of the solutions, s; increasing and not empty.
    time_s: Vec<f64>,
    /// Gains, solution after solution, one for each satellite.
    gain: Vec<Complex64>,
    /// ln(g_1 / g_0) to the next solution; one solution fewer than `gain`.
    log_step: Vec<Complex64>,
    errors: ErrorTable,
}

impl AntennaGains {
    /// Reads a file of gains; visibilities get this many draws of their errors, if any are stated.
    ///
    /// # Errors
    /// [`CalibrationError`] if the file cannot be read or parsed, or with all its invalid values.
    pub fn read(path: &Path, error_draws: usize) -> Result<Self, CalibrationError> {
        let file = GainsFile::read(path)?;
        let gains = Self::new(&file).map_err(|error| match error {
            CalibrationError::Gains { problems } => {
                CalibrationError::Values { path: path.to_owned(), problems }
            }
            other => other,
        })?;
        Ok(gains.with_error_draws(&file, error_draws, 0))
    }

    /// Uses gains that are already in memory, without their errors.
    ///
    /// # Errors
    /// [`CalibrationError::Gains`] with all invalid values.
    pub fn new(file: &GainsFile) -> Result<Self, CalibrationError> {
        let problems = file.problems();
        if !problems.is_empty() {
            return Err(CalibrationError::Gains { problems });
        }
        let channels = file
            .channels
            .iter()
            .map(|channel| {
                let time_s = channel.solutions.iter().map(|solution| solution.time_s).collect();
                let gains = channel.solutions.iter().flat_map(|solution| &solution.gains);
                let gain = gains.map(|&[re, im]| Complex64::new(re, im)).collect();
                ChannelTable::new(channel.frequency_hz, time_s, gain)
            })
            .collect();
        Ok(Self {
            interpolation: file.interpolation,
            frequency_tolerance_hz: file.frequency_tolerance_hz,
            satellites: file.satellites(),
            channels,
            positions: file.positions.clone(),
            draws: 0,
            seed: 0,
        })
    }

    /// Gives visibilities this many draws of the errors of their gains, if the file of these states any.
    #[must_use]
    pub fn with_error_draws(mut self, file: &GainsFile, draws: usize, seed: u64) -> Self {
        if draws > 0 && file.states_errors() {
            (self.draws, self.seed) = (draws, seed);
            for (table, channel) in self.channels.iter_mut().zip(&file.channels) {
                table.errors = ErrorTable::new(channel);
            }
        }
        self
    }

    /// The factor g_i conj(g_j) by which visibilities of `pair` at `frequency_hz` were multiplied at
    /// `time_s` (s since the mission epoch); not finite or zero where a gain is unusable.
    ///
    /// # Errors
    /// [`CalibrationError`] if there are no gains for the pair or frequency.
    pub fn factor(&self, frequency_hz: f64, pair: Pair, time_s: f64) -> Result<Complex64, CalibrationError> {
        let table = self.table(frequency_hz, pair)?;
        Ok(table.factor(self.interpolation, self.satellites, pair, time_s))
    }

    /// Subtracts the solved position errors from the positions of a pair.
    fn correct_positions(&self, block: &mut PlacedVisibilities) {
        // An auto-correlation has no position.
        if self.positions.is_empty() || block.pair.i == block.pair.j {
            return;
        }
        let [i, j] = [block.pair.i, block.pair.j].map(usize::from);
        for (k, &time_s) in block.time_s.iter().enumerate() {
            let next = self.positions.partition_point(|position| position.from_s <= time_s);
            let latest = next.checked_sub(1).and_then(|index| self.positions.get(index));
            let Some(position) = latest.filter(|latest| time_s <= latest.until_s) else { continue };
            for (r_m, n) in [(&mut block.r_i_m[k], i), (&mut block.r_j_m[k], j)] {
                *r_m = sub(*r_m, track_offset_m(*r_m, position.normals_hat[n], position.offsets_m[n]));
            }
        }
    }

    /// Whether positions are corrected at any time.
    #[must_use]
    pub fn corrects_positions(&self) -> bool {
        !self.positions.is_empty()
    }

    /// Whether `self` and `other` change visibilities of a pair between two times (s) identically. May return `false`
    /// where nothing differs.
    #[must_use]
    pub fn is_equivalent(&self, other: &Self, frequency_hz: f64, pair: Pair, span_s: [f64; 2]) -> bool {
        let tables = (self.table(frequency_hz, pair), other.table(frequency_hz, pair));
        let (Ok(own), Ok(others)) = tables else { return false };
        self.interpolation == other.interpolation
            && own.rows(self.satellites, pair, span_s).eq(others.rows(other.satellites, pair, span_s))
            && own.has_errors_of(others, span_s)
            && self.positions_within(span_s).eq(other.positions_within(span_s))
    }

    fn positions_within(&self, [from_s, until_s]: [f64; 2]) -> impl Iterator<Item = &PositionSolution> {
        self.positions.iter().filter(move |position| position.from_s <= until_s && position.until_s >= from_s)
    }

    /// Returns the table of a channel, after checking that it has both satellites.
    fn table(&self, frequency_hz: f64, pair: Pair) -> Result<&ChannelTable, CalibrationError> {
        if usize::from(pair.i.max(pair.j)) >= self.satellites {
            return Err(CalibrationError::Satellite { pair, satellites: self.satellites });
        }
        let distance_hz = |table: &ChannelTable| (table.frequency_hz - frequency_hz).abs();
        let nearest = self.channels.iter().min_by(|a, b| distance_hz(a).total_cmp(&distance_hz(b)));
        match nearest {
            Some(table) if distance_hz(table) <= self.frequency_tolerance_hz => Ok(table),
            _ => Err(CalibrationError::Channel {
                frequency_hz,
                nearest_hz: nearest.map_or(f64::NAN, |table| table.frequency_hz),
                tolerance_hz: self.frequency_tolerance_hz,
            }),
        }
    }
}

impl ChannelTable {
    fn new(frequency_hz: f64, time_s: Vec<f64>, gain: Vec<Complex64>) -> Self {
        let satellites = gain.len() / time_s.len().max(1);
        let log_step = gain.iter().zip(gain.iter().skip(satellites)).map(|(g_0, g_1)| (g_1 / g_0).ln());
        Self { frequency_hz, time_s, log_step: log_step.collect(), gain, errors: ErrorTable::default() }
    }

    /// The solutions that determine gains between two times.
    fn rows_within(&self, [from_s, until_s]: [f64; 2]) -> Range<usize> {
        let count_until = |time_s: f64| self.time_s.partition_point(|&t| t <= time_s);
        count_until(from_s).saturating_sub(1)..(count_until(until_s) + 1).min(self.time_s.len())
    }

    /// Whether the errors that hold between two times are those of another table.
    fn has_errors_of(&self, other: &Self, span_s: [f64; 2]) -> bool {
        let entries = |table: &Self| {
            table.rows_within(span_s).map(|row| table.errors.entry(row).cloned()).collect::<Vec<_>>()
        };
        entries(self) == entries(other)
    }

    /// The solutions between which a time lies, and how far it is towards the second; one alone before the first and after the last.
    fn place(&self, interpolation: Interpolation, time_s: f64) -> (usize, Option<(usize, f64)>) {
        let next = self.time_s.partition_point(|&t| t <= time_s);
        let row = next.saturating_sub(1);
        if next == 0 || next == self.time_s.len() || time_s == self.time_s[row] {
            return (row, None);
        }
        let u = (time_s - self.time_s[row]) / (self.time_s[next] - self.time_s[row]);
        match interpolation {
            Interpolation::LogLinear => (row, Some((next, u))),
            Interpolation::Nearest => (if u > 0.5 { next } else { row }, None),
        }
    }

    /// Solutions of a pair (time and both gains) that determine its gains between two times.
    fn rows(
        &self,
        satellites: usize,
        pair: Pair,
        span_s: [f64; 2],
    ) -> impl Iterator<Item = (f64, Complex64, Complex64)> {
        let gain = move |row: usize, n: u8| self.gain[row * satellites + usize::from(n)];
        self.rows_within(span_s).map(move |row| (self.time_s[row], gain(row, pair.i), gain(row, pair.j)))
    }

    fn factor(&self, interpolation: Interpolation, satellites: usize, pair: Pair, time_s: f64) -> Complex64 {
        let (i, j) = (usize::from(pair.i), usize::from(pair.j));
        let row_of_pair = |table: &[Complex64], row: usize| {
            // The gains of both satellites, or the logarithmic steps, the second conjugated.
            (table[row * satellites + i], table[row * satellites + j].conj())
        };
        let (row, towards) = self.place(interpolation, time_s);
        let (g_i, g_j) = row_of_pair(&self.gain, row);
        let Some((_, u)) = towards else { return g_i * g_j };
        let (log_i, log_j) = row_of_pair(&self.log_step, row);
        g_i * g_j * (u * (log_i + log_j)).exp()
    }
}

impl Calibration for AntennaGains {
    fn name(&self) -> &'static str {
        "antenna-gains"
    }

    fn describe(&mut self, instrument: &Instrument) -> Result<Instrument, CalibrationError> {
        self.seed = instrument.seed;
        Ok(instrument.clone())
    }

    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError> {
        let pair = block.pair;
        let table = self.table(block.frequency_hz, pair)?;
        let count = block.len();
        // An auto-correlation is in no map, and draws of a channel without stated errors are zero.
        let draws = if pair.i == pair.j || !table.errors.states_any() { 0 } else { self.draws };
        let mut drawn = table.errors.drawn((table.frequency_hz, pair), self.seed, draws);
        let mut errors = Vec::with_capacity(draws * count);
        let mut kept = 0;
        for k in 0..count {
            let factor = table.factor(self.interpolation, self.satellites, pair, block.time_s[k]);
            let power = factor.norm_sqr();
            let weight = block.weight[k] * power;
            // A normal number is neither zero nor infinite, nor so small that digits are lost.
            if !(power.is_normal() && weight.is_normal()) {
                continue;
            }
            drawn.push_at(table.place(self.interpolation, block.time_s[k]), &mut errors);
            block.value_k_sr[kept] = block.value_k_sr[k] / factor;
            block.weight[kept] = weight;
            block.time_s[kept] = block.time_s[k];
            block.r_i_m[kept] = block.r_i_m[k];
            block.r_j_m[kept] = block.r_j_m[k];
            if !block.duration_s.is_empty() {
                block.duration_s[kept] = block.duration_s[k];
            }
            kept += 1;
        }
        block.truncate(kept);
        block.gain_errors = errors;
        self.correct_positions(block);
        Ok(CalibrationReport { kept, unusable_gain: count - kept })
    }
}

#[cfg(test)]
mod tests;
