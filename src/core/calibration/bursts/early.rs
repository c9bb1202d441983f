//! Alerts of bursts while their pass is open.
//!
//! The statistics of detection, over the visibilities of a channel so far. Pairs of one daughter may come first, and what is wrong with it is no burst:
//! alerts wait until none is in more than half of the pairs, which decide a median. A power has to rise above what follows, too, as the Moon's
//! limb makes steps; so an alert by powers needs three bins after the burst, one by visibilities nothing but them.

use std::fmt;

use serde::Serialize;

use super::detect::{Bins, pairs_of};
use crate::frames::PlacedVisibilities;
use crate::units::Dimension;

/// Least number of visibilities of a pair so far, for its quartile.
const VISIBILITIES_MIN: usize = 24;

/// Largest share of the pairs that have the same daughter, of more than three: each of three is in two of three pairs.
const SHARE_MAX: f64 = 0.5;

/// What may be a burst in a pass that goes on. When the pass has ended it is found, with its direction and flux, or was none.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BurstAlert {
    /// Channel, from 0.
    pub channel: u16,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Start, s since the epoch.
    pub from_s: f64,
    /// End so far, s.
    pub until_s: f64,
    /// Time of the brightest interval so far, s.
    pub peak_s: f64,
    /// Always true.
    pub is_provisional: bool,
}

impl BurstAlert {
    /// Whether another alert of a channel overlaps.
    pub(super) fn is_same_as(&self, other: &Self) -> bool {
        self.channel == other.channel && self.from_s < other.until_s && other.from_s < self.until_s
    }
}

impl fmt::Display for BurstAlert {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hz = Dimension::Frequency.show(self.frequency_hz);
        let Self { from_s, until_s, .. } = self;
        write!(f, "perhaps a burst at {hz} from {from_s:.1} s to {until_s:.1} s: its pass is still open")
    }
}

/// Finds what may be bursts in the visibilities of an open pass in one channel.
#[must_use]
pub fn find_alerts(blocks: &[&PlacedVisibilities]) -> Vec<BurstAlert> {
    let Some(first) = blocks.first() else { return Vec::new() };
    let pairs = pairs_of(blocks, VISIBILITIES_MIN);
    let mut daughters = vec![0.0; 1 + usize::from(u8::MAX)];
    for pair in pairs.iter().filter_map(|pair| pair.first()).map(|entry| entry.pair()) {
        [pair.i, pair.j].into_iter().for_each(|n| daughters[usize::from(n)] += 1.0);
    }
    let present = daughters.iter().filter(|count| **count > 0.0).count();
    let share = daughters.into_iter().fold(0.0, f64::max) / pairs.len().max(1) as f64;
    if present > 3 && share > SHARE_MAX || pairs.len() < 3 {
        return Vec::new();
    }
    let Some(bins) = Bins::new(&pairs) else { return Vec::new() };
    let alert = |range: std::ops::Range<usize>| {
        let [from_s, until_s] = [range.start, range.end].map(|bin| bins.start_s(bin));
        let peak_s = bins.start_s(*bins.brightest(range).first()?) + 0.5 * bins.width_s;
        let (channel, frequency_hz) = (first.channel.0, first.frequency_hz);
        Some(BurstAlert { channel, frequency_hz, from_s, until_s, peak_s, is_provisional: true })
    };
    bins.detections().into_iter().filter_map(alert).collect()
}
