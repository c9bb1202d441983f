//! The set of packets of one kind that were received, over all files and sessions.

use std::ops::Range;

use crate::downlink::wire::CucTime;
use crate::units::IntervalSet;

/// The received packets of one kind by count and creation time, in any order of arrival. Memory grows with the number of
/// distinct times and of gaps.
///
/// Counts of 46 bits never wrap. They restart with the spacecraft, so two packets with the same count and different times
/// are different packets.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReceivedSet {
    /// Intervals of consecutive counts with the same time: `(time, first)..(time, last + 1)`.
    packets: IntervalSet<(CucTime, u64)>,
}

/// The result of adding a packet to a [`ReceivedSet`] of bounded size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PacketInsertion {
    /// The packet was added.
    New,
    /// The packet was in the set already.
    Known,
    /// The packet was not added, as the set is full.
    Full,
}

/// The packets received between two restarts of the spacecraft's count.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Era {
    /// Creation time of the first received packet.
    pub from: CucTime,
    /// Missing counts between the received packets, and from 0 to the first.
    pub missing: Vec<Range<u64>>,
    /// Last received count plus 1. Packets after it that were lost before the restart are unknown.
    pub end: u64,
}

impl ReceivedSet {
    /// Adds a packet; returns whether it is new.
    pub fn insert(&mut self, count: u64, time: CucTime) -> bool {
        if self.contains(count, time) {
            return false;
        }
        self.packets.insert((time, count)..(time, count + 1));
        true
    }

    /// Adds a packet, unless the set would then have more than `intervals_max` intervals.
    pub fn insert_bounded(&mut self, count: u64, time: CucTime, intervals_max: usize) -> PacketInsertion {
        if self.contains(count, time) {
            return PacketInsertion::Known;
        }
        let extends = |count: Option<u64>| count.is_some_and(|count| self.contains(count, time));
        let is_full = self.packets.intervals() >= intervals_max;
        if is_full && !extends(count.checked_sub(1)) && !extends(count.checked_add(1)) {
            return PacketInsertion::Full;
        }
        self.packets.insert((time, count)..(time, count + 1));
        PacketInsertion::New
    }

    /// Removes a packet.
    pub fn remove(&mut self, count: u64, time: CucTime) {
        self.packets.remove((time, count)..(time, count + 1));
    }

    /// Whether a packet is in the set.
    #[must_use]
    pub fn contains(&self, count: u64, time: CucTime) -> bool {
        self.packets.contains((time, count))
    }

    /// Number of packets.
    #[must_use]
    pub fn len(&self) -> u64 {
        self.packets.iter().map(|Range { start, end }| end.1 - start.1).sum()
    }

    /// Whether the set is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.packets.is_empty()
    }

    /// Intervals of consecutive counts with the same creation time, in the order of time.
    pub fn intervals(&self) -> impl Iterator<Item = (CucTime, Range<u64>)> + '_ {
        self.packets.iter().map(|Range { start: (time, first), end: (_, end) }| (time, first..end))
    }

    /// First and last creation time of a packet; `None` for an empty set.
    #[must_use]
    pub fn span(&self) -> Option<[CucTime; 2]> {
        Some([self.packets.lowest()?.start.0, self.packets.highest()?.start.0])
    }

    /// The eras in the order of time. A new one begins where the count decreases.
    #[must_use]
    pub fn eras(&self) -> Vec<Era> {
        let mut eras: Vec<Era> = Vec::new();
        for Range { start: (time, start), end: (_, end) } in self.packets.iter() {
            if eras.last().is_none_or(|era| start < era.end) {
                eras.push(Era { from: time, ..Era::default() });
            }
            let Some(era) = eras.last_mut() else { continue };
            if era.end < start {
                era.missing.push(era.end..start);
            }
            era.end = end;
        }
        eras
    }

    /// Numbers of missing counts, between received packets and from 0 to the first: in total, and after packets made later
    /// than `time`.
    #[must_use]
    pub fn missing_since(&self, time: CucTime) -> [u64; 2] {
        let (mut all, mut since) = (0_u64, 0_u64);
        let mut before: Option<(CucTime, u64)> = None;
        for Range { start: (made, first), end: (_, end) } in self.packets.iter() {
            // A lower count begins an era, at 0.
            let expected = before.map_or(0, |(_, end)| if end <= first { end } else { 0 });
            let is_since = before.is_some_and(|(made_before, _)| made_before > time);
            all = all.saturating_add(first - expected);
            since = since.saturating_add(if is_since { first - expected } else { 0 });
            before = Some((made, end));
        }
        [all, since]
    }

    /// Number of restarts among the packets received.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        let (mut restarts, mut end_before) = (0, 0);
        for Range { start: (_, start), end: (_, end) } in self.packets.iter() {
            restarts += u64::from(start < end_before);
            end_before = end;
        }
        restarts
    }

    /// Drops the intervals with the earliest times until at most `intervals_max` are left.
    pub(crate) fn remove_oldest(&mut self, intervals_max: usize) {
        self.packets.drop_lowest(intervals_max);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    fn at(s: u64) -> CucTime {
        CucTime(s << 24)
    }

    fn missing(received: &ReceivedSet) -> Vec<Vec<u64>> {
        received.eras().into_iter().map(|era| era.missing.into_iter().flatten().collect()).collect()
    }

    proptest! {
        #[test]
        fn the_set_does_not_depend_on_the_order_of_arrival(
            packets in proptest::collection::vec((0..60_u64, 0..2_u64), 1..150),
            out in 0..60_u64,
        ) {
            // Two packets for each creation time; and all once more after a restart.
            let made = |(count, era): (u64, u64)| at(count / 2 + 40 * era);
            let (mut received, mut expected) = (ReceivedSet::default(), BTreeSet::new());
            for &(count, era) in &packets {
                prop_assert_eq!(received.insert(count, made((count, era))), expected.insert((era, count)));
            }
            prop_assert_eq!(received.len(), expected.len() as u64);
            let mut sorted = ReceivedSet::default();
            for &(era, count) in &expected {
                sorted.insert(count, made((count, era)));
            }
            prop_assert_eq!(&sorted, &received);
            let of_era = |era: u64| expected.iter().filter(|(of, _)| *of == era).map(|(_, count)| *count).collect();
            let eras: [Vec<u64>; 2] = [of_era(0), of_era(1)];
            let is_restart = matches!((eras[0].last(), eras[1].first()), (Some(last), Some(first)) if first <= last);
            prop_assert_eq!(received.restarts(), u64::from(is_restart));
            prop_assert_eq!(received.eras().len(), 1 + usize::from(is_restart));
            let absent: Vec<Vec<u64>> = match is_restart {
                true => eras.iter().map(|era| (0..era[era.len() - 1]).filter(|c| !era.contains(c)).collect()).collect(),
                // Nothing shows the restart.
                false => {
                    let all = eras.concat();
                    vec![(0..all[all.len() - 1]).filter(|count| !all.contains(count)).collect()]
                }
            };
            prop_assert_eq!(missing(&received), absent);
            received.remove(out, made((out, 0)));
            expected.remove(&(0, out));
            prop_assert_eq!(received.len(), expected.len() as u64);
            prop_assert!(received.insert(out, made((out, 0))));
        }
    }

    #[test]
    fn a_full_set_accepts_only_packets_that_extend_its_intervals() {
        let mut received = ReceivedSet::default();
        for count in [10, 20, 30] {
            assert_eq!(received.insert_bounded(count, at(count), 3), PacketInsertion::New);
        }
        let full = received.clone();
        for (count, s) in [(40, 40), (11, 20), (10, 11)] {
            assert_eq!(received.insert_bounded(count, at(s), 3), PacketInsertion::Full, "{count}");
        }
        assert_eq!(received, full);
        assert_eq!(received.insert_bounded(20, at(20), 3), PacketInsertion::Known);
        for (count, s) in [(11, 10), (9, 10), (21, 20), (31, 30)] {
            assert_eq!(received.insert_bounded(count, at(s), 3), PacketInsertion::New, "{count}");
        }
        assert_eq!(received.len(), 7);
    }

    #[test]
    fn missing_counts_are_dated_by_the_packet_before_them() {
        let mut received = ReceivedSet::default();
        for (count, s) in [(2, 1), (5, 2), (6, 3), (9, 4), (1, 5), (3, 5)] {
            received.insert(count, at(s));
        }
        // Missing are 0, 1, 3, 4, 7, 8, and after the restart 0 and 2.
        assert_eq!(received.missing_since(at(0)), [8, 6]);
        assert_eq!(received.missing_since(at(2)), [8, 4]);
        assert_eq!(received.missing_since(at(4)), [8, 1]);
        assert_eq!(received.missing_since(at(5)), [8, 0]);
        assert_eq!(ReceivedSet::default().missing_since(at(0)), [0, 0]);
    }

    #[test]
    fn a_count_with_another_time_is_another_packet() {
        let mut received = ReceivedSet::default();
        // Packets sent after a restart arrive before those sent before it.
        assert!(received.insert(0, at(8)) && received.insert(2, at(9)));
        assert!(received.insert(0, at(1)) && received.insert(2, at(2)) && received.insert(7, at(3)));
        assert!(!received.insert(2, at(2)) && !received.insert(2, at(9)));
        assert_eq!(missing(&received), [vec![1, 3, 4, 5, 6], vec![1]]);
        let [before, after] = received.eras().try_into().unwrap();
        assert_eq!([(before.from, before.end), (after.from, after.end)], [(at(1), 8), (at(8), 3)]);
        assert_eq!(received.restarts(), 1);
    }
}
