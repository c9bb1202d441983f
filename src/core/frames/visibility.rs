//! Integrated visibilities, with and without the positions of their satellites.

use num_complex::{Complex32, Complex64};
use thiserror::Error;

use super::Flags;
use crate::units::vector::Vec3;
use crate::units::{ChannelId, MissionTime, Pair};

/// The error of a block of visibilities whose arrays differ in length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error("a block of visibilities of satellites {} and {} has {found} values of {name}: expected {expected}, one per visibility", pair.i + 1, pair.j + 1)]
pub struct UnequalLengths {
    /// Pair of the block.
    pub pair: Pair,
    /// Name of the array with another length.
    pub name: &'static str,
    /// Length of this array.
    pub found: usize,
    /// The number of visibilities.
    pub expected: usize,
}

/// Requires that all named arrays have the expected length.
fn require_lengths<const N: usize>(
    pair: Pair,
    expected: usize,
    arrays: [(&'static str, usize); N],
) -> Result<(), UnequalLengths> {
    match arrays.into_iter().find(|(_, found)| *found != expected) {
        None => Ok(()),
        Some((name, found)) => Err(UnequalLengths { pair, name, found, expected }),
    }
}

/// Consecutive integrations of one pair in one channel, as the mother produces them.
///
/// A structure of arrays of equal length ([`VisibilityBlock::check_lengths`]).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VisibilityBlock {
    /// Channel.
    pub channel: ChannelId,
    /// Pair.
    pub pair: Pair,
    /// Origin of `offset_ticks`.
    pub start: MissionTime,
    /// Start of each integration, us after `start`.
    pub offset_ticks: Vec<u32>,
    /// Length of each integration, us.
    pub duration_ticks: Vec<u32>,
    /// Visibility, K sr.
    pub value_k_sr: Vec<Complex32>,
    /// Inverse variance of the real part (equal to that of the imaginary part), (K sr)^-2.
    pub weight: Vec<f32>,
    /// Flags.
    pub flags: Vec<Flags>,
}

impl VisibilityBlock {
    /// Number of visibilities.
    #[must_use]
    pub fn len(&self) -> usize {
        self.value_k_sr.len()
    }

    /// Whether the block is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.value_k_sr.is_empty()
    }

    /// Requires that all arrays have the same length, as all code that uses blocks assumes.
    ///
    /// # Errors
    /// The first array with another length.
    pub fn check_lengths(&self) -> Result<(), UnequalLengths> {
        let Self { pair, offset_ticks, duration_ticks, weight, flags, .. } = self;
        let arrays = [
            ("offset_ticks", offset_ticks.len()),
            ("duration_ticks", duration_ticks.len()),
            ("weight", weight.len()),
            ("flags", flags.len()),
        ];
        require_lengths(*pair, self.len(), arrays)
    }

    /// Moves the integrations from index `at` on into a new block.
    ///
    /// # Panics
    /// If `at` exceeds the length of the block.
    #[must_use]
    #[doc(hidden)]
    pub fn split_off(&mut self, at: usize) -> Self {
        Self {
            channel: self.channel,
            pair: self.pair,
            start: self.start,
            offset_ticks: self.offset_ticks.split_off(at),
            duration_ticks: self.duration_ticks.split_off(at),
            value_k_sr: self.value_k_sr.split_off(at),
            weight: self.weight.split_off(at),
            flags: self.flags.split_off(at),
        }
    }

    /// Middle of integration `k`, s since the mission epoch.
    #[must_use]
    pub fn middle_s(&self, k: usize) -> f64 {
        let half_ticks = 0.5 * f64::from(self.duration_ticks[k]);
        let from_start_s = (f64::from(self.offset_ticks[k]) + half_ticks) * 1e-6;
        self.start.seconds() + from_start_s
    }
}

/// A calibrated auto-correlation: the power of one daughter in one channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AutoPower {
    /// Daughter, from 0.
    pub daughter: u8,
    /// Centre frequency of the channel or sub-band, Hz.
    pub frequency_hz: f64,
    /// Width of the channel or sub-band, Hz.
    pub width_hz: f64,
    /// Middle of the integration, s since the mission epoch.
    pub time_s: f64,
    /// Mean of |x|^2 of sky and receiver, K sr.
    pub power_k_sr: f64,
    /// Standard deviation of the power, K sr.
    pub sigma_k_sr: f64,
}

/// Maximum number of draws of the errors of gains.
pub(crate) const ERROR_DRAWS_MAX: usize = 64;

/// Calibrated visibilities with the positions of their two satellites, ready for accumulation.
///
/// A structure of arrays of equal length ([`PlacedVisibilities::check_lengths`]), with increasing times.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlacedVisibilities {
    /// Channel.
    pub channel: ChannelId,
    /// Index of the sub-band, from 0; 0 for a channel without sub-bands.
    pub band: u16,
    /// Centre frequency of the channel, Hz.
    pub frequency_hz: f64,
    /// Pair.
    pub pair: Pair,
    /// Middle of each integration, s since the mission epoch.
    pub time_s: Vec<f64>,
    /// Position of satellite i, m.
    pub r_i_m: Vec<Vec3>,
    /// Position of satellite j, m.
    pub r_j_m: Vec<Vec3>,
    /// Visibility, K sr.
    pub value_k_sr: Vec<Complex64>,
    /// Inverse variance of the real part, (K sr)^-2; positive.
    pub weight: Vec<f64>,
    /// Length of each integration, s; empty if integration times are neglected.
    pub duration_s: Vec<f32>,
    /// Relative errors by the gains that were applied: of each visibility as many draws, one after another; empty if none are known.
    pub gain_errors: Vec<Complex64>,
}

impl PlacedVisibilities {
    /// Number of visibilities.
    #[must_use]
    pub fn len(&self) -> usize {
        self.time_s.len()
    }

    /// Whether the block is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.time_s.is_empty()
    }

    /// Requires that all arrays have the same length, as all code that uses blocks assumes; `duration_s` may be empty.
    ///
    /// # Errors
    /// The first array with another length.
    pub fn check_lengths(&self) -> Result<(), UnequalLengths> {
        let Self { pair, r_i_m, r_j_m, value_k_sr, weight, duration_s, gain_errors, .. } = self;
        let durations = if duration_s.is_empty() { self.len() } else { duration_s.len() };
        let has_draws = !self.is_empty() && gain_errors.len().is_multiple_of(self.len());
        let arrays = [
            ("r_i_m", r_i_m.len()),
            ("r_j_m", r_j_m.len()),
            ("value_k_sr", value_k_sr.len()),
            ("weight", weight.len()),
            ("duration_s", durations),
            ("gain_errors", if has_draws { self.len() } else { gain_errors.len() }),
        ];
        require_lengths(*pair, self.len(), arrays)
    }

    /// The draws of the relative error of visibility `k` by the gains; empty if none are known.
    #[must_use]
    #[doc(hidden)]
    pub fn gain_errors_of(&self, k: usize) -> &[Complex64] {
        let draws = self.gain_errors.len().checked_div(self.len()).unwrap_or(0);
        self.gain_errors.get(k * draws..(k + 1) * draws).unwrap_or_default()
    }

    /// A block of the same channel and pair without visibilities.
    #[must_use]
    #[doc(hidden)]
    pub fn without_visibilities(&self) -> Self {
        let Self { channel, band, frequency_hz, pair, .. } = *self;
        Self { channel, band, frequency_hz, pair, ..Self::default() }
    }

    /// Appends visibility `k` of `other`.
    #[doc(hidden)]
    pub fn push_from(&mut self, other: &Self, k: usize) {
        self.gain_errors.extend_from_slice(other.gain_errors_of(k));
        self.time_s.push(other.time_s[k]);
        self.r_i_m.push(other.r_i_m[k]);
        self.r_j_m.push(other.r_j_m[k]);
        self.value_k_sr.push(other.value_k_sr[k]);
        self.weight.push(other.weight[k]);
        self.duration_s.extend(other.duration_s.get(k));
    }

    /// Keeps the first `len` visibilities.
    #[doc(hidden)]
    pub fn truncate(&mut self, len: usize) {
        let draws = self.gain_errors.len().checked_div(self.len()).unwrap_or(0);
        let Self { time_s, r_i_m, r_j_m, value_k_sr, weight, duration_s, gain_errors, .. } = self;
        gain_errors.truncate(draws * len);
        time_s.truncate(len);
        r_i_m.truncate(len);
        r_j_m.truncate(len);
        value_k_sr.truncate(len);
        weight.truncate(len);
        duration_s.truncate(len);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unequal_lengths_are_reported_with_the_arrays_name() {
        let block = VisibilityBlock {
            pair: Pair { i: 0, j: 4 },
            offset_ticks: vec![0, 5],
            duration_ticks: vec![5, 5],
            value_k_sr: vec![Complex32::ZERO; 2],
            weight: vec![1.0; 2],
            flags: vec![Flags::default(); 2],
            ..VisibilityBlock::default()
        };
        assert_eq!(block.check_lengths(), Ok(()));
        let wrong = VisibilityBlock { flags: vec![Flags::default()], ..block };
        let error = wrong.check_lengths().unwrap_err().to_string();
        assert_eq!(
            error,
            "a block of visibilities of satellites 1 and 5 has 1 values of flags: expected 2, one per visibility"
        );
    }
}
