//! Views of the journal: counters, the ledger, received packets and blocks, spans. Each is a fold over its records.

use std::collections::BTreeMap;

use super::journal::{Journal, JournalEntry, Sent, VisibilityRecord};
use crate::calibration::{BlockKey, ReceivedBlocks};
use crate::downlink::{Kind, ReceptionCounters};
use crate::runtime::LedgerReport;
use crate::units::{ChannelId, MissionTime};

impl Journal {
    /// Records of packets with visibilities.
    fn with_visibilities(&self) -> impl Iterator<Item = &VisibilityRecord> {
        self.visibilities.values().filter(|record| record.entry.visibilities > 0)
    }

    /// Number of packets with visibilities.
    pub(super) fn packets(&self) -> usize {
        self.with_visibilities().count()
    }

    /// Packets with visibilities, each with the share of what was offered to the sums that they have taken.
    pub(super) fn shares(&self) -> impl Iterator<Item = (&JournalEntry, Option<f64>)> {
        self.with_visibilities().map(|record| {
            let offered = (record.offered > 0).then_some(record.offered);
            let share = offered.map(|offered| f64::from(record.accumulated) / f64::from(offered));
            (&record.entry, share)
        })
    }

    /// Packets that were delivered.
    pub(super) fn delivered(&self) -> impl Iterator<Item = (Kind, Sent)> {
        let visibilities = self.visibilities.keys().map(|sent| (Kind::Visibilities, *sent));
        visibilities.chain(self.others.keys().copied())
    }

    /// Counters of the packets that were delivered.
    pub(super) fn reception(&self) -> ReceptionCounters {
        let mut counters = ReceptionCounters::default();
        for record in self.visibilities.values() {
            counters.add_packet(Kind::Visibilities, record.bytes, &record.reading);
        }
        for ((kind, _), record) in &self.others {
            counters.add_packet(*kind, record.bytes, &record.reading);
        }
        counters
    }

    /// Blocks that were received, and the spacecraft's reports.
    pub(super) fn blocks(&self) -> ReceivedBlocks {
        let mut blocks = ReceivedBlocks::default();
        for record in self.with_visibilities() {
            let JournalEntry { channel, pair, start, visibilities, .. } = record.entry;
            blocks.insert(BlockKey { channel, pair, first: start });
            if !record.is_duplicate {
                blocks.count(record.window, u64::from(visibilities));
            }
        }
        self.others.values().filter_map(|record| record.report).for_each(|report| blocks.report(report));
        blocks
    }

    /// What applying all packets has posted to the ledger.
    pub(super) fn ledger(&self) -> LedgerReport {
        let mut ledger = LedgerReport::default();
        for record in self.visibilities.values() {
            ledger.accumulated = ledger.accumulated.saturating_add(u64::from(record.accumulated));
            if record.is_duplicate {
                ledger.sampled = ledger.sampled.saturating_add(u64::from(record.entry.visibilities));
            }
            for (reason, count) in self.flagged(record) {
                match ledger.flagged.get_mut(reason) {
                    Some(sum) => *sum = sum.saturating_add(count),
                    None => drop(ledger.flagged.insert(reason.to_owned(), count)),
                }
            }
        }
        ledger
    }

    /// First and last mission time, s, of what was offered to the engine of each channel.
    pub(super) fn spans_s(&self) -> BTreeMap<ChannelId, [f64; 2]> {
        let mut spans: BTreeMap<ChannelId, [f64; 2]> = BTreeMap::new();
        for record in self.visibilities.values() {
            let Some([first, last]) = record.used_s else { continue };
            let span = spans.entry(record.entry.channel).or_insert([first, last]);
            *span = [span[0].min(first), span[1].max(last)];
        }
        spans
    }

    /// Whether the sums hold visibilities of pairs whose positions lie in a span of time.
    pub(super) fn uses(&self, [from, to]: [MissionTime; 2]) -> bool {
        self.visibilities.values().any(|VisibilityRecord { entry, accumulated, .. }| {
            *accumulated > 0 && entry.pair.i != entry.pair.j && entry.start <= to && entry.end >= from
        })
    }
}
