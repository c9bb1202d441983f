//! Which passes were searched for bursts.

use std::collections::BTreeMap;
use std::fmt;

use bincode::{Decode, Encode};
use serde::Serialize;

use super::FoundBurst;
use crate::units::Dimension;

/// Least number of pairs in a bin. Half of the six pairs of four daughters, or less of more, have the same daughter.
pub(super) const PAIRS_MIN: usize = 6;

/// The same for powers: a direction takes three.
pub(super) const PAIRS_OF_POWERS_MIN: usize = 3;

/// Least number of visibilities of a pair, for its quartile.
pub(super) const VISIBILITIES_MIN: usize = 8;

/// Shortest and longest bin, s. Sparser visibilities are not judged.
pub(super) const BIN_S: [f64; 2] = [10.0, 300.0];

/// What the search of a pass found in a channel.
#[derive(Clone, Debug, Default)]
pub struct SearchedChannel {
    /// Channel, from 0.
    pub channel: u16,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Number of its visibilities.
    pub visibilities: usize,
    /// Number of those at times that were judged: of enough pairs.
    pub judged: usize,
    /// The bursts, in the order of their starts.
    pub bursts: Vec<FoundBurst>,
}

impl SearchedChannel {
    /// Whether at least half of the visibilities lie at times that were judged.
    fn is_searched(&self) -> bool {
        2 * self.judged >= self.visibilities
    }
}

/// Numbers of passes of a channel that were searched for bursts, and that were not.
#[derive(Clone, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct SearchedPasses {
    /// Channel, from 0.
    pub channel: u16,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Number of passes with visibilities.
    pub passes: u64,
    /// Number of those of which more than half of the visibilities lie at times of too few pairs.
    pub not_searched: u64,
    /// Number of those again in which another channel has a burst.
    pub not_searched_beside_burst: u64,
}

impl SearchedPasses {
    /// Whether the values can be those of a channel. Checkpoints are untrusted.
    #[must_use]
    pub fn is_sound(&self, channels: usize) -> bool {
        usize::from(self.channel) < channels && self.frequency_hz > 0.0 && self.frequency_hz.is_finite()
    }
}

/// Numbers of passes that were searched, by channel.
#[derive(Clone, Debug, Default)]
pub struct PassCounts(BTreeMap<u16, SearchedPasses>);

impl PassCounts {
    /// Counts a pass.
    pub fn add_pass(&mut self, channels: &[SearchedChannel]) {
        let has_burst = channels.iter().any(|channel| !channel.bursts.is_empty());
        for found in channels.iter().filter(|channel| channel.visibilities > 0) {
            let not_searched = u64::from(!found.is_searched());
            let is_beside = has_burst && found.bursts.is_empty();
            self.add(SearchedPasses {
                channel: found.channel,
                frequency_hz: found.frequency_hz,
                passes: 1,
                not_searched,
                not_searched_beside_burst: not_searched * u64::from(is_beside),
            });
        }
    }

    /// Adds those of another session, or of other channels.
    pub fn add(&mut self, other: SearchedPasses) {
        let Some(ours) = self.0.get_mut(&other.channel) else {
            self.0.insert(other.channel, other);
            return;
        };
        ours.passes = ours.passes.saturating_add(other.passes);
        ours.not_searched = ours.not_searched.saturating_add(other.not_searched);
        ours.not_searched_beside_burst =
            ours.not_searched_beside_burst.saturating_add(other.not_searched_beside_burst);
    }

    /// The numbers, in the order of channels.
    #[must_use]
    pub fn list(&self) -> Vec<SearchedPasses> {
        self.0.values().cloned().collect()
    }
}

impl fmt::Display for SearchedPasses {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hz = Dimension::Frequency.show(self.frequency_hz);
        let Self { passes, not_searched, not_searched_beside_burst: beside, .. } = self;
        if *not_searched == 0 {
            return write!(f, "{hz}: all {passes} passes were searched for bursts");
        }
        write!(f, "{hz}: {not_searched} of {passes} passes were not searched for bursts")?;
        if *beside > 0 {
            write!(f, " (in {beside} of them another channel has one)")?;
        }
        write!(
            f,
            ": most of the time fewer than {PAIRS_MIN} pairs, or {PAIRS_OF_POWERS_MIN} whose weights tell powers, have \
             {VISIBILITIES_MIN} visibilities in the pass, at most {} s apart; expected longer baselines in the downlink \
             (spacecraft.baseline_wavelengths_max)",
            0.5 * BIN_S[1]
        )
    }
}
