//! Which blocks of visibilities have been received, and how many visibilities of each window.

use std::collections::{BTreeMap, HashSet};

use crate::frames::{Housekeeping, VisibilityBlock, VisibilityReason};
use crate::runtime::Ledger;
use crate::units::{ChannelId, MissionTime, Pair};

/// Identity of a block of visibilities. A block is used once, however often it is received.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct BlockKey {
    /// Channel.
    pub channel: ChannelId,
    /// Pair.
    pub pair: Pair,
    /// Beginning of the first integration.
    pub first: MissionTime,
}

impl BlockKey {
    /// Key of a block; `None` if it is empty.
    #[must_use]
    pub fn of(block: &VisibilityBlock) -> Option<Self> {
        let &offset = block.offset_ticks.first()?;
        let first = block.start.plus_ticks(i64::from(offset));
        Some(Self { channel: block.channel, pair: block.pair, first })
    }
}

/// The blocks that have been received, and the spacecraft's latest report of its own counts.
///
/// A function of what was inserted, not of the order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReceivedBlocks {
    used: HashSet<BlockKey>,
    /// Visibilities by the start of their window.
    by_window: BTreeMap<MissionTime, u64>,
    latest: Option<Housekeeping>,
}

impl ReceivedBlocks {
    /// Inserts a block; returns whether it is new.
    pub fn insert(&mut self, key: BlockKey) -> bool {
        self.used.insert(key)
    }

    /// Counts visibilities of the window that starts at `window`.
    pub fn count(&mut self, window: MissionTime, visibilities: u64) {
        *self.by_window.entry(window).or_default() += visibilities;
    }

    /// Takes a report of the spacecraft; the one that covers most time holds.
    pub fn report(&mut self, report: Housekeeping) {
        let order = |report: &Housekeeping| (report.time, report.sampled, report.dropped);
        if self.latest.is_none_or(|latest| order(&latest) < order(&report)) {
            self.latest = Some(report);
        }
    }

    /// Visibilities received.
    #[must_use]
    pub fn visibilities(&self) -> u64 {
        self.by_window.values().sum()
    }

    /// Posts what was sampled and what was lost before the ground received it.
    pub(super) fn close(&self, ledger: &Ledger<VisibilityReason>) {
        let all = self.visibilities();
        let Some(report) = self.latest else {
            ledger.sampled(all);
            return;
        };
        let counted: u64 = self.by_window.range(..report.time).map(|(_, count)| count).sum();
        let missing = report.sampled.saturating_sub(report.dropped).saturating_sub(counted);
        // A forged report may claim anything.
        ledger.sampled(all.saturating_add(missing).saturating_add(report.dropped));
        ledger.left_out(VisibilityReason::StoreFull, report.dropped);
        ledger.left_out(VisibilityReason::NotReceived, missing);
    }
}
