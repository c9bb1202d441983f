//! Integrated visibilities, before and after the ground has assigned positions to them.

use num_complex::{Complex32, Complex64};

use super::Flags;
use crate::units::vector::Vec3;
use crate::units::{ChannelId, MissionTime, Pair};

/// Consecutive integrations of one pair in one channel, as the mother produces them.
///
/// Structure of arrays; all arrays have the same length.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VisibilityBlock {
    /// Channel.
    pub channel: ChannelId,
    /// Pair.
    pub pair: Pair,
    /// Time that `offset_ticks` counts from.
    pub start: MissionTime,
    /// Start of each integration after `start`, us.
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

    /// Splits the integrations from `at` on off into a block of their own.
    ///
    /// # Panics
    /// If the block is shorter than that.
    #[must_use]
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
    /// Its width, Hz.
    pub width_hz: f64,
    /// Middle of the integration, s since the mission epoch.
    pub time_s: f64,
    /// Mean of |x|^2, K sr: sky and receiver.
    pub power_k_sr: f64,
    /// Standard deviation of its noise, K sr.
    pub sigma_k_sr: f64,
}

/// Calibrated visibilities with the positions of their two satellites, ready for accumulation.
///
/// Structure of arrays; all arrays have the same length. Times increase.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlacedVisibilities {
    /// Channel.
    pub channel: ChannelId,
    /// Sub-band of the channel, from 0, where several make one channel; else 0.
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
    /// Length of each integration, s; empty if they are instants.
    pub duration_s: Vec<f32>,
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

    /// The same channel and pair, with no visibilities.
    #[must_use]
    pub fn without_visibilities(&self) -> Self {
        let Self { channel, band, frequency_hz, pair, .. } = *self;
        Self { channel, band, frequency_hz, pair, ..Self::default() }
    }

    /// Adds visibility `k` of `other`, which has one.
    pub fn push_of(&mut self, other: &Self, k: usize) {
        self.time_s.push(other.time_s[k]);
        self.r_i_m.push(other.r_i_m[k]);
        self.r_j_m.push(other.r_j_m[k]);
        self.value_k_sr.push(other.value_k_sr[k]);
        self.weight.push(other.weight[k]);
        self.duration_s.extend(other.duration_s.get(k));
    }

    /// Keeps the first `len` visibilities.
    pub fn truncate(&mut self, len: usize) {
        let Self { time_s, r_i_m, r_j_m, value_k_sr, weight, duration_s, .. } = self;
        time_s.truncate(len);
        r_i_m.truncate(len);
        r_j_m.truncate(len);
        value_k_sr.truncate(len);
        weight.truncate(len);
        duration_s.truncate(len);
    }
}
