//! Which blocks of visibilities have been received, and how many visibilities of each window.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::fmt;

use serde::Serialize;

use crate::frames::{Housekeeping, VisibilityBlock, VisibilityReason};
use crate::runtime::Ledger;
use crate::units::{ChannelId, MissionTime, Pair};

/// Most reports that are kept: a dozen times those of a mission of 1.3 years, with one an orbit. Bounds what a forger's
/// reports cost.
const REPORTS_MAX: usize = 1 << 16;

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

/// The blocks that have been received, and the spacecraft's reports of its own counts.
///
/// A function of what was inserted, not of the order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReceivedBlocks {
    used: HashSet<BlockKey>,
    /// Visibilities by the start of their window.
    by_window: BTreeMap<MissionTime, u64>,
    /// Visibilities that were received with values that cannot be used, by the start of their window.
    bad_by_window: BTreeMap<MissionTime, u64>,
    /// Reports that differ, by time, visibilities sampled and dropped.
    reports: BTreeSet<(MissionTime, u64, u64)>,
}

/// Packets of visibilities that are known to be missing: each held at least one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MissingPackets {
    /// All of them.
    pub all: u64,
    /// Those made after the time of the latest report.
    pub unreported: u64,
}

/// Whether the counts of a ledger are known to be complete.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Completeness {
    /// Whether all that the spacecraft sampled is in the ledger.
    pub complete: bool,
    /// Mission time, s, up to which all that it sampled is in the ledger; `None` without a report, or for all time.
    pub until_s: Option<f64>,
    /// Reports that contradict the others, or the visibilities received, and were not used.
    pub reports_contradictory: u64,
    /// Why the ledger is not known to be complete.
    pub reasons: Vec<&'static str>,
}

impl fmt::Display for Completeness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.complete {
            true => f.write_str("complete: the spacecraft's last report was received")?,
            false => write!(f, "not known to be complete: {}", self.reasons.join("; "))?,
        }
        if let Some(until_s) = self.until_s {
            write!(f, "; complete up to {until_s:.0} s of mission time")?;
        }
        match self.reports_contradictory {
            0 => Ok(()),
            reports => write!(f, "; {reports} reports contradict the others and were not used"),
        }
    }
}

impl ReceivedBlocks {
    /// Inserts a block; returns whether it is new.
    pub fn insert(&mut self, key: BlockKey) -> bool {
        self.used.insert(key)
    }

    /// Counts visibilities of the window that starts at `window`.
    pub fn count(&mut self, window: MissionTime, visibilities: u64) {
        add(&mut self.by_window, window, visibilities);
    }

    /// Counts visibilities that were received with values that cannot be used.
    pub fn count_bad(&mut self, window: MissionTime, visibilities: u64) {
        add(&mut self.bad_by_window, window, visibilities);
    }

    /// Takes a report of the spacecraft. Reports of one mission do not contradict each other; which ones hold is decided
    /// when the counts are closed.
    pub fn report(&mut self, report: Housekeeping) {
        if self.reports.len() < REPORTS_MAX {
            self.reports.insert((report.time, report.sampled, report.dropped));
        }
    }

    /// Visibilities received that can be used.
    #[must_use]
    pub fn visibilities(&self) -> u64 {
        sum(self.by_window.values())
    }

    /// The latest of the reports that hold, and the number of those that do not.
    ///
    /// The counts only grow, at one time they have one value, and what was received was sampled. Of reports that
    /// contradict each other the greatest number that agree hold; where that leaves a choice, those that claim least.
    #[must_use]
    pub fn latest_report(&self) -> (Option<Housekeeping>, u64) {
        let covers_received = |&(time, sampled, dropped): &(MissionTime, u64, u64)| {
            sampled.saturating_sub(dropped) >= sum(self.by_window.range(..time).map(|(_, count)| count))
        };
        let known: Vec<_> = self.reports.iter().copied().filter(covers_received).collect();
        let sampled = longest_rise(&known, |&(time, sampled, _)| (time, sampled));
        let kept = longest_rise(&sampled, |&(time, _, dropped)| (time, dropped));
        let latest = kept.last().map(|&(time, sampled, dropped)| Housekeeping { time, sampled, dropped });
        (latest, (self.reports.len() - kept.len()) as u64)
    }

    /// Posts what was sampled and what was lost before the ground received it; returns whether that is known to be all.
    pub(super) fn close(&self, ledger: &Ledger<VisibilityReason>, packets: MissingPackets) -> Completeness {
        let (latest, reports_contradictory) = self.latest_report();
        let (time, sampled, dropped) = latest
            .map_or((MissionTime(i64::MIN), 0, 0), |latest| (latest.time, latest.sampled, latest.dropped));
        let before = |counts: &BTreeMap<MissionTime, u64>| sum(counts.range(..time).map(|(_, count)| count));
        let counted = before(&self.by_window).saturating_add(before(&self.bad_by_window));
        let missing = sampled.saturating_sub(dropped).saturating_sub(counted);
        // The last report is exact.
        let is_last = latest.is_some_and(|latest| latest.is_last());
        let at_least = if is_last { 0 } else { packets.unreported.max(packets.all.saturating_sub(missing)) };
        for (reason, count) in [
            (VisibilityReason::BadValue, sum(self.bad_by_window.values())),
            (VisibilityReason::StoreFull, dropped),
            (VisibilityReason::NotReceived, missing),
            (VisibilityReason::NotReceivedAtLeast, at_least),
        ] {
            ledger.add_sampled(count);
            ledger.add_left_out(reason, count);
        }
        ledger.add_sampled(self.visibilities());
        let last_reports = self.reports.range((Housekeeping::FOREVER, 0, 0)..).count();
        let reasons = match latest {
            None => vec!["no report of the spacecraft's counts was received"],
            Some(_) if !is_last => vec!["the spacecraft's last report was not received"],
            Some(_) if last_reports > 1 => vec!["the spacecraft's last reports contradict each other"],
            Some(_) => Vec::new(),
        };
        Completeness {
            complete: reasons.is_empty(),
            until_s: latest.filter(|_| !is_last).map(|latest| latest.time.seconds()),
            reports_contradictory,
            reasons,
        }
    }
}

fn add(counts: &mut BTreeMap<MissionTime, u64>, window: MissionTime, count: u64) {
    if count > 0 {
        let sum = counts.entry(window).or_default();
        *sum = sum.saturating_add(count);
    }
}

fn sum<'a>(counts: impl Iterator<Item = &'a u64>) -> u64 {
    counts.fold(0, |sum, &count| sum.saturating_add(count))
}

/// The longest part of a sorted list in which the count never falls and has one value at each time; of several, one with
/// the lowest end.
fn longest_rise<T: Copy>(sorted: &[T], of: impl Fn(&T) -> (MissionTime, u64)) -> Vec<T> {
    // By length less one: the place of the item with the lowest count in which a rise of that length can end.
    let mut ends: Vec<usize> = Vec::new();
    let mut before: Vec<Option<usize>> = vec![None; sorted.len()];
    let mut at = 0;
    while at < sorted.len() {
        let (time, _) = of(&sorted[at]);
        let same = sorted[at..].iter().take_while(|item| of(item).0 == time).count();
        // All of one time extend rises that end earlier, so that no two of them are in one rise unless they are equal.
        let lengths: Vec<usize> = (at..at + same)
            .map(|k| ends.partition_point(|&end| of(&sorted[end]).1 <= of(&sorted[k]).1))
            .collect();
        for (k, &length) in (at..).zip(&lengths) {
            before[k] = length.checked_sub(1).map(|shorter| ends[shorter]);
        }
        for (k, length) in (at..).zip(lengths) {
            match ends.get_mut(length) {
                Some(end) if of(&sorted[*end]).1 > of(&sorted[k]).1 => *end = k,
                Some(_) => {}
                None => ends.push(k),
            }
        }
        at += same;
    }
    let mut rise: Vec<T> =
        std::iter::successors(ends.last().copied(), |&k| before[k]).map(|k| sorted[k]).collect();
    rise.reverse();
    rise
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn report(time: i64, sampled: u64, dropped: u64) -> Housekeeping {
        Housekeeping { time: MissionTime(time), sampled, dropped }
    }

    /// Two windows of 100 visibilities, of which the ground has 70 and 90.
    fn received(reports: &[Housekeeping]) -> ReceivedBlocks {
        let mut blocks = ReceivedBlocks::default();
        blocks.count(MissionTime(0), 70);
        blocks.count(MissionTime(1000), 90);
        reports.iter().for_each(|&report| blocks.report(report));
        blocks
    }

    fn closed(
        blocks: &ReceivedBlocks,
        all: u64,
        unreported: u64,
    ) -> (crate::runtime::LedgerReport<VisibilityReason>, Completeness) {
        let ledger = Ledger::new();
        let completeness = blocks.close(&ledger, MissingPackets { all, unreported });
        ledger.add_accumulated(blocks.visibilities());
        (ledger.balanced_report().unwrap(), completeness)
    }

    #[test]
    fn only_the_last_report_makes_a_ledger_complete() {
        let forever = Housekeeping::FOREVER.0;
        let lost =
            |(ledger, completeness): (crate::runtime::LedgerReport<VisibilityReason>, Completeness)| {
                let counts = [VisibilityReason::NotReceived, VisibilityReason::NotReceivedAtLeast];
                (counts.map(|reason| ledger.count(reason)), completeness.complete, completeness.until_s)
            };
        // Nothing but gaps is known.
        assert_eq!(lost(closed(&received(&[]), 3, 3)), ([0, 3], false, None));
        // Of the first window the loss is exact; two packets are missing after it.
        let first = report(900, 100, 0);
        assert_eq!(lost(closed(&received(&[first]), 5, 2)), ([30, 2], false, Some(900e-6)));
        // More packets are missing than the report explains, wherever they are.
        assert_eq!(lost(closed(&received(&[first]), 50, 2)), ([30, 20], false, Some(900e-6)));
        let last = report(forever, 200, 5);
        assert_eq!(lost(closed(&received(&[last, first]), 50, 2)), ([35, 0], true, None));
        assert!(closed(&received(&[last]), 0, 0).1.to_string().starts_with("complete:"));
        let text = closed(&received(&[first]), 0, 0).1.to_string();
        assert!(text.starts_with("not known to be complete: ") && text.contains("up to 0 s"), "{text}");
    }

    #[test]
    fn reports_that_contradict_the_others_are_not_used() {
        let forever = Housekeeping::FOREVER.0;
        let sound = [report(900, 100, 0), report(1900, 200, 5), report(forever, 200, 5)];
        for forged in [
            // More than was sampled later; dropped more than later; less than was received; two values at one time.
            report(500, 1 << 48, 0),
            report(500, 100, 100),
            report(950, 1 << 48, 1 << 48),
            report(1950, 150, 0),
            report(1900, 1 << 48, 5),
        ] {
            let blocks = received(&[&[forged], &sound[..]].concat());
            assert_eq!(blocks.latest_report(), (Some(sound[2]), 1), "{forged:?}");
            assert!(closed(&blocks, 0, 0).1.complete);
        }
        // Two last reports: which one is right cannot be known.
        let blocks = received(&[&[report(forever, 300, 5)], &sound[..]].concat());
        let (_, completeness) = closed(&blocks, 0, 0);
        assert_eq!((completeness.complete, completeness.reports_contradictory), (false, 1));
    }

    #[test]
    fn forged_counts_close() {
        let blocks = received(&[report(5, u64::MAX, 0), report(9, u64::MAX, u64::MAX), report(-7, 0, 0)]);
        let ledger = Ledger::new();
        blocks.close(&ledger, MissingPackets { all: 1 << 46, unreported: 1 << 46 });
    }

    #[test]
    fn what_is_kept_of_forged_reports_is_bounded() {
        let mut blocks = ReceivedBlocks::default();
        for k in 0..2 * REPORTS_MAX {
            blocks.report(report(k as i64, (k % 7) as u64, 0));
        }
        assert_eq!(blocks.reports.len(), REPORTS_MAX);
        assert!(blocks.latest_report().0.is_some());
    }

    /// The length of the longest rise, by trying all parts.
    fn longest(items: &[(MissionTime, u64)]) -> usize {
        let is_rise = |part: &[(MissionTime, u64)]| {
            part.windows(2).all(|two| two[0].0 < two[1].0 && two[0].1 <= two[1].1)
        };
        let parts = (0..1_u32 << items.len()).map(|bits| -> Vec<_> {
            items.iter().enumerate().filter(|(k, _)| bits >> k & 1 == 1).map(|(_, item)| *item).collect()
        });
        parts.filter(|part| is_rise(part)).map(|part| part.len()).max().unwrap_or(0)
    }

    proptest! {
        #[test]
        fn a_rise_is_a_rise_and_the_longest(items in proptest::collection::btree_set((0..8_i64, 0..6_u64), 0..11)) {
            let sorted: Vec<_> = items.into_iter().map(|(time, count)| (MissionTime(time), count)).collect();
            let rise = longest_rise(&sorted, |item| *item);
            prop_assert!(rise.windows(2).all(|two| two[0].0 < two[1].0 && two[0].1 <= two[1].1));
            prop_assert_eq!(rise.len(), longest(&sorted));
        }
    }
}
