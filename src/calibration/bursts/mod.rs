//! Bursts of point sources, such as the Sun's, found in the visibilities of a pass.
//!
//! [`find_bursts`] sees all visibilities of a pass in one channel; [`FoundBursts`] is the table of what was found, which leaves visibilities
//! that arrive later out as well.

mod detect;
mod locate;

pub use detect::{BurstSearch, find_bursts};

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bincode::{Decode, Encode};
use serde::{Deserialize, Serialize};

use crate::frames::PlacedVisibilities;
use crate::units::{ChannelId, Dimension};

/// Maximum number of bursts in a table, 5 MB. Later ones are found, and stay in the maps.
const BURSTS_MAX: usize = 32_768;

/// What is done with bursts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BurstChoice {
    /// Visibilities in a burst stay out of the sums.
    #[default]
    Flag,
    /// Bursts are reported, and their visibilities are used like others.
    Keep,
}

impl BurstChoice {
    #[allow(clippy::trivially_copy_pass_by_ref)] // As serde calls it.
    pub(super) fn is_flag(&self) -> bool {
        *self == Self::Flag
    }
}

/// A burst in one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct FoundBurst {
    /// Channel, from 0.
    pub channel: u16,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Start, s since the epoch.
    pub from_s: f64,
    /// End, s.
    pub until_s: f64,
    /// Time of the brightest interval, s.
    pub peak_s: f64,
    /// Signal-to-noise ratio of a point source at the position. The noise is that of the visibilities and the steady sky.
    pub significance: f64,
    /// Flux density in the brightest interval, as an isotropic antenna sees it, Jy.
    pub flux_jy: f64,
    /// Standard deviation of the flux density, Jy.
    pub flux_sigma_jy: f64,
    /// Ecliptic longitude and latitude, deg, the likeliest first; others have a likelihood within 99 % of its distribution: daughters in
    /// one plane do not tell its two sides apart.
    pub positions_deg: Vec<[f64; 2]>,
    /// Standard deviation of the first position along its worst direction, deg.
    pub position_sigma_deg: f64,
    /// `sun` if the Sun's direction at that time is within two degrees and three standard deviations of a position.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
}

impl FoundBurst {
    /// Length, s.
    #[must_use]
    pub fn length_s(&self) -> f64 {
        self.until_s - self.from_s
    }

    /// Whether the values are those of a burst. Checkpoints are untrusted.
    #[must_use]
    pub fn is_sound(&self, channels: usize) -> bool {
        usize::from(self.channel) < channels && self.from_s.is_finite() && self.length_s() >= 0.0
    }

    /// Whether visibility `k` of a block lies in the burst.
    #[must_use]
    pub fn holds(&self, placed: &PlacedVisibilities, k: usize) -> bool {
        let half_s = 0.5 * placed.duration_s.get(k).copied().map_or(0.0, f64::from);
        ChannelId(self.channel) == placed.channel
            && placed.time_s[k] + half_s > self.from_s
            && placed.time_s[k] - half_s < self.until_s
    }
}

impl fmt::Display for FoundBurst {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hz = Dimension::Frequency.show(self.frequency_hz);
        write!(f, "a burst at {hz} from {:.1} s to {:.1} s: ", self.from_s, self.until_s)?;
        write!(f, "{:.2e} Jy, {:.0} sigma", self.flux_jy, self.significance)?;
        if let Some([longitude, latitude]) = self.positions_deg.first() {
            let sigma = self.position_sigma_deg;
            write!(f, ", from ecliptic longitude {longitude:.2}, latitude {latitude:.2} deg (+- {sigma:.2})")?;
            match self.positions_deg.len() - 1 {
                0 => {}
                others => write!(f, " or {others} other direction(s)")?,
            }
        }
        if let Some(name) = &self.name {
            write!(f, ": {name}")?;
        }
        Ok(())
    }
}

/// The bursts that a ground has found. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct FoundBursts {
    choice: BurstChoice,
    table: Arc<Mutex<BurstTable>>,
}

#[derive(Debug, Default)]
struct BurstTable {
    bursts: Vec<FoundBurst>,
    /// Number of bursts of earlier sessions.
    earlier: usize,
}

impl FoundBursts {
    /// An empty table.
    #[must_use]
    pub fn new(choice: BurstChoice) -> Self {
        Self { choice, ..Self::default() }
    }

    fn table(&self) -> MutexGuard<'_, BurstTable> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether visibilities in a burst are left out.
    #[must_use]
    pub fn flags(&self) -> bool {
        self.choice.is_flag()
    }

    /// Adds a burst; returns whether there was room.
    pub fn add(&self, burst: FoundBurst) -> bool {
        let mut table = self.table();
        let has_room = table.bursts.len() < BURSTS_MAX;
        if has_room {
            table.bursts.push(burst);
        }
        has_room
    }

    /// Resumes with the bursts of earlier sessions.
    pub fn resume(&self, bursts: Vec<FoundBurst>) {
        let mut table = self.table();
        table.earlier = bursts.len();
        table.bursts = bursts;
    }

    /// All bursts, in the order in which they were found.
    #[must_use]
    pub fn list(&self) -> Vec<FoundBurst> {
        self.table().bursts.clone()
    }

    /// Number of bursts.
    #[must_use]
    pub fn len(&self) -> usize {
        self.table().bursts.len()
    }

    /// Whether no burst was found.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bursts of this session, except the first `seen`.
    #[must_use]
    pub fn since(&self, seen: usize) -> Vec<FoundBurst> {
        let table = self.table();
        table.bursts.get(table.earlier + seen..).unwrap_or_default().to_vec()
    }

    /// Divides a block into the visibilities outside all bursts and those in one; `None` if all are outside, or bursts are kept.
    #[must_use]
    pub fn divided(&self, placed: &PlacedVisibilities) -> Option<[PlacedVisibilities; 2]> {
        if !self.flags() {
            return None;
        }
        let table = self.table();
        let in_burst = |k: usize| table.bursts.iter().any(|burst| burst.holds(placed, k));
        if table.bursts.is_empty() || !(0..placed.len()).any(in_burst) {
            return None;
        }
        let mut parts = [placed.without_visibilities(), placed.without_visibilities()];
        (0..placed.len()).for_each(|k| parts[usize::from(in_burst(k))].push_from(placed, k));
        Some(parts)
    }
}

#[cfg(test)]
mod tests;
