//! Record of received blocks of visibilities, and visibility counts by window.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::fmt;

use serde::Serialize;

use crate::frames::{Housekeeping, VisibilityBlock, VisibilityReason};
use crate::runtime::Ledger;
use crate::units::{ChannelId, MissionTime, Pair};

/// Maximum number of reports kept: twelve times what a mission of 1.3 years makes at one per orbit. Bounds the memory
/// that forged reports can take.
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

/// Received blocks, and the spacecraft's reports of its own counts.
///
/// Independent of the order of insertion.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReceivedBlocks {
    used: HashSet<BlockKey>,
    /// Number of visibilities, by the start of their window.
    by_window: BTreeMap<MissionTime, u64>,
    /// Number of visibilities received with unusable values, by the start of their window.
    bad_by_window: BTreeMap<MissionTime, u64>,
    /// Distinct reports: (time, visibilities sampled, visibilities dropped).
    reports: BTreeSet<(MissionTime, u64, u64)>,
}

/// Packets of visibilities known to be missing. Each held at least one visibility.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MissingPackets {
    /// All missing packets.
    pub all: u64,
    /// Missing packets made after the time of the latest report.
    pub unreported: u64,
}

/// Whether the counts of a ledger are known to be complete.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Completeness {
    /// Whether every visibility that the spacecraft sampled is in the ledger.
    pub complete: bool,
    /// Mission time, s, up to which the ledger is complete; `None` without a report, or if it is complete for all
    /// time.
    pub until_s: Option<f64>,
    /// Reports not used because they contradict the others, or the visibilities received.
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

    /// Counts visibilities received with unusable values.
    pub fn count_bad(&mut self, window: MissionTime, visibilities: u64) {
        add(&mut self.bad_by_window, window, visibilities);
    }

    /// Records a report of the spacecraft. [`Self::latest_report`] decides which reports are used.
    pub fn report(&mut self, report: Housekeeping) {
        if self.reports.len() < REPORTS_MAX {
            self.reports.insert((report.time, report.sampled, report.dropped));
        }
    }

    /// Number of usable visibilities received.
    #[must_use]
    pub fn visibilities(&self) -> u64 {
        sum(self.by_window.values())
    }

    /// The latest accepted report, and the number of rejected ones.
    ///
    /// Genuine counts only grow, have one value at one time, and cover what was received. The largest mutually
    /// consistent set of reports is accepted; among sets of equal size, the one with the lowest counts.
    #[must_use]
    pub fn latest_report(&self) -> (Option<Housekeeping>, u64) {
        let covers_received = |&(time, sampled, dropped): &(MissionTime, u64, u64)| {
            sampled.saturating_sub(dropped) >= sum(self.by_window.range(..time).map(|(_, count)| count))
        };
        let possible: Vec<_> = self.reports.iter().copied().filter(covers_received).collect();
        let consistent_in_sampled =
            longest_nondecreasing_subsequence(&possible, |&(time, sampled, _)| (time, sampled));
        let consistent =
            longest_nondecreasing_subsequence(&consistent_in_sampled, |&(time, _, dropped)| (time, dropped));
        let latest =
            consistent.last().map(|&(time, sampled, dropped)| Housekeeping { time, sampled, dropped });
        (latest, (self.reports.len() - consistent.len()) as u64)
    }

    /// Posts to the ledger the visibilities sampled, and those lost before reception; returns whether the counts are
    /// complete.
    pub(super) fn post_losses(
        &self,
        ledger: &Ledger<VisibilityReason>,
        packets: MissingPackets,
    ) -> Completeness {
        let (latest, reports_contradictory) = self.latest_report();
        let (time, sampled, dropped) = latest
            .map_or((MissionTime(i64::MIN), 0, 0), |latest| (latest.time, latest.sampled, latest.dropped));
        let sum_before =
            |counts: &BTreeMap<MissionTime, u64>| sum(counts.range(..time).map(|(_, count)| count));
        let counted = sum_before(&self.by_window).saturating_add(sum_before(&self.bad_by_window));
        let missing = sampled.saturating_sub(dropped).saturating_sub(counted);
        // The mission's last report is exact.
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

/// Longest subsequence of a sorted list whose counts never fall, with at most one item per time; among several, one
/// with the lowest last count.
fn longest_nondecreasing_subsequence<T: Copy>(
    sorted: &[T],
    key: impl Fn(&T) -> (MissionTime, u64),
) -> Vec<T> {
    // ends[n]: index of the item with the lowest count that can end a subsequence of length n + 1.
    let mut ends: Vec<usize> = Vec::new();
    let mut predecessor: Vec<Option<usize>> = vec![None; sorted.len()];
    let mut start = 0;
    while start < sorted.len() {
        let (time, _) = key(&sorted[start]);
        let same_time = sorted[start..].iter().take_while(|item| key(item).0 == time).count();
        // Items of equal time all extend subsequences of earlier items, so that no subsequence contains two of them.
        let lengths: Vec<usize> = (start..start + same_time)
            .map(|k| ends.partition_point(|&end| key(&sorted[end]).1 <= key(&sorted[k]).1))
            .collect();
        for (k, &length) in (start..).zip(&lengths) {
            predecessor[k] = length.checked_sub(1).map(|shorter| ends[shorter]);
        }
        for (k, length) in (start..).zip(lengths) {
            match ends.get_mut(length) {
                Some(end) if key(&sorted[*end]).1 > key(&sorted[k]).1 => *end = k,
                Some(_) => {}
                None => ends.push(k),
            }
        }
        start += same_time;
    }
    let mut subsequence: Vec<T> =
        std::iter::successors(ends.last().copied(), |&k| predecessor[k]).map(|k| sorted[k]).collect();
    subsequence.reverse();
    subsequence
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
        let completeness = blocks.post_losses(&ledger, MissingPackets { all, unreported });
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
        // Without a report only gaps are known.
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
    fn counts_of_forged_reports_do_not_overflow() {
        let blocks = received(&[report(5, u64::MAX, 0), report(9, u64::MAX, u64::MAX), report(-7, 0, 0)]);
        let ledger = Ledger::new();
        blocks.post_losses(&ledger, MissingPackets { all: 1 << 46, unreported: 1 << 46 });
    }

    #[test]
    fn memory_of_forged_reports_is_bounded() {
        let mut blocks = ReceivedBlocks::default();
        for k in 0..2 * REPORTS_MAX {
            blocks.report(report(k as i64, (k % 7) as u64, 0));
        }
        assert_eq!(blocks.reports.len(), REPORTS_MAX);
        assert!(blocks.latest_report().0.is_some());
    }

    /// Length of the longest valid subsequence, by trying all subsequences.
    fn longest(items: &[(MissionTime, u64)]) -> usize {
        let is_valid = |part: &[(MissionTime, u64)]| {
            part.windows(2).all(|two| two[0].0 < two[1].0 && two[0].1 <= two[1].1)
        };
        let parts = (0..1_u32 << items.len()).map(|bits| -> Vec<_> {
            items.iter().enumerate().filter(|(k, _)| bits >> k & 1 == 1).map(|(_, item)| *item).collect()
        });
        parts.filter(|part| is_valid(part)).map(|part| part.len()).max().unwrap_or(0)
    }

    proptest! {
        #[test]
        fn the_longest_nondecreasing_subsequence_is_valid_and_maximal(items in proptest::collection::btree_set((0..8_i64, 0..6_u64), 0..11)) {
            let sorted: Vec<_> = items.into_iter().map(|(time, count)| (MissionTime(time), count)).collect();
            let subsequence = longest_nondecreasing_subsequence(&sorted, |item| *item);
            prop_assert!(subsequence.windows(2).all(|two| two[0].0 < two[1].0 && two[0].1 <= two[1].1));
            prop_assert_eq!(subsequence.len(), longest(&sorted));
        }
    }
}
