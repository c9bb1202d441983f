//! The packet counts of one kind: which packets are missing, late or duplicate.

use std::ops::Range;

use super::ReceivedSet;
use crate::downlink::wire::CucTime;
use crate::units::IntervalSet;

/// Maximum number of intervals of counts that are kept, of received packets and of missing ones that may arrive late:
/// fifteen times the packets of the paper's mission. Limits memory to some 100 MB per kind, also with forged packets.
const INTERVALS_MAX: usize = 1 << 20;

/// How the count of a packet relates to the packets before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arrival {
    /// It is the first of its kind, or the successor of the last.
    InOrder,
    /// Packets are missing before it.
    AfterGap {
        /// The count of the first missing packet.
        expected: u64,
    },
    /// It fills a gap that was reported earlier.
    Late,
    /// It was sent before the first received packet of its kind, or before a restart.
    Early,
    /// It was received before.
    Duplicate,
    /// Its count is lower and its time later, so the spacecraft restarted its count.
    Restart {
        /// The count expected without a restart.
        expected: u64,
    },
}

/// The counts received so far.
#[derive(Clone, Debug, Default)]
pub(super) struct Sequence {
    has_begun: bool,
    /// Count of the first packet since the last restart.
    first: u64,
    /// Expected count of the next packet.
    next: u64,
    /// Latest time of a valid packet.
    latest: CucTime,
    /// Valid packets received.
    received: ReceivedSet,
    /// Missing counts below `next`, in at most [`INTERVALS_MAX`] intervals.
    missing: IntervalSet<u64>,
}

impl Sequence {
    /// Records a valid packet.
    pub(super) fn receive(&mut self, count: u64, time: CucTime) -> Arrival {
        let arrival = self.classify(count, time);
        match arrival {
            Arrival::InOrder | Arrival::AfterGap { .. } | Arrival::Restart { .. } => self.next = count + 1,
            Arrival::Late | Arrival::Early => self.mark_received(count),
            Arrival::Duplicate => return arrival,
        }
        self.latest = self.latest.max(time);
        self.received.insert(count, time);
        self.received.remove_oldest(INTERVALS_MAX);
        arrival
    }

    /// Records a damaged packet with valid headers as missing: a valid copy may still arrive.
    pub(super) fn receive_damaged(&mut self, count: u64, time: CucTime) -> Arrival {
        let arrival = self.classify(count, time);
        if !matches!(arrival, Arrival::Late | Arrival::Early | Arrival::Duplicate) {
            self.mark_missing(count..count + 1);
            self.next = count + 1;
        }
        arrival
    }

    /// Number of restarts of the count.
    pub(crate) fn restarts(&self) -> u64 {
        self.received.restarts()
    }

    fn classify(&mut self, count: u64, time: CucTime) -> Arrival {
        let expected = self.next;
        if self.received.contains(count, time) {
            return Arrival::Duplicate;
        }
        if !std::mem::replace(&mut self.has_begun, true) {
            self.begin(count);
            Arrival::InOrder
        } else if time >= self.latest && count == expected {
            Arrival::InOrder
        } else if time >= self.latest && count > expected {
            self.mark_missing(expected..count);
            Arrival::AfterGap { expected }
        } else if time > self.latest {
            self.begin(count);
            Arrival::Restart { expected }
        } else if count >= self.first && self.missing.contains(count) {
            Arrival::Late
        } else {
            Arrival::Early
        }
    }

    /// Starts with a packet. Packets sent before it are not a gap, but may still arrive.
    fn begin(&mut self, count: u64) {
        self.first = count;
        self.missing.clear();
        self.mark_missing(0..count);
    }

    /// Marks counts as missing.
    fn mark_missing(&mut self, counts: Range<u64>) {
        self.missing.insert(counts);
        self.missing.drop_lowest(INTERVALS_MAX);
    }

    /// Marks a count as received.
    fn mark_received(&mut self, count: u64) {
        self.missing.remove(count..count + 1);
        self.missing.drop_lowest(INTERVALS_MAX);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(s: u64) -> CucTime {
        CucTime(s << 24)
    }

    #[test]
    fn late_packets_fill_their_gap_once() {
        let mut sequence = Sequence::default();
        assert_eq!(sequence.receive(0, at(1)), Arrival::InOrder);
        assert_eq!(sequence.receive(4, at(2)), Arrival::AfterGap { expected: 1 });
        assert_eq!(sequence.receive(2, at(1)), Arrival::Late);
        assert_eq!(sequence.receive(2, at(1)), Arrival::Duplicate);
        assert_eq!(sequence.receive(1, at(1)), Arrival::Late);
        assert_eq!(sequence.receive(3, at(2)), Arrival::Late);
        assert_eq!(sequence.receive(4, at(2)), Arrival::Duplicate);
        assert_eq!(sequence.receive(5, at(2)), Arrival::InOrder);
        assert!(sequence.missing.is_empty());
    }

    #[test]
    fn a_recording_may_begin_anywhere() {
        let mut sequence = Sequence::default();
        assert_eq!(sequence.receive(100, at(5)), Arrival::InOrder);
        assert_eq!(sequence.receive(99, at(5)), Arrival::Early);
        assert_eq!(sequence.receive(99, at(5)), Arrival::Duplicate);
    }

    #[test]
    fn a_lower_count_with_a_later_time_is_a_restart() {
        let mut sequence = Sequence::default();
        sequence.receive(100, at(5));
        assert_eq!(sequence.receive(0, at(6)), Arrival::Restart { expected: 101 });
        assert_eq!(sequence.receive(1, at(6)), Arrival::InOrder);
        assert_eq!(sequence.restarts(), 1);
    }

    #[test]
    fn packets_sent_before_a_restart_may_arrive_after_it() {
        let mut sequence = Sequence::default();
        for count in 0..3 {
            assert_eq!(sequence.receive(count, at(9)), Arrival::InOrder);
        }
        // Counts below, at and above the expected one: none is a duplicate, and none reveals a gap.
        for count in 0..9 {
            assert_eq!(sequence.receive(count, at(1)), Arrival::Early, "{count}");
            assert_eq!(sequence.receive(count, at(1)), Arrival::Duplicate, "{count}");
        }
        assert_eq!(sequence.receive(3, at(9)), Arrival::InOrder);
        assert_eq!(sequence.restarts(), 1);
    }

    #[test]
    fn a_valid_copy_of_a_damaged_packet_is_late() {
        let mut sequence = Sequence::default();
        sequence.receive(0, at(1));
        assert_eq!(sequence.receive_damaged(1, at(1)), Arrival::InOrder);
        assert_eq!(sequence.receive(2, at(1)), Arrival::InOrder);
        assert_eq!(sequence.receive(1, at(1)), Arrival::Late);
    }

    #[test]
    fn memory_is_bounded() {
        let mut sequence = Sequence::default();
        let last = 2 * (INTERVALS_MAX as u64 + 500);
        for count in (0..=last).step_by(2) {
            sequence.receive(count, at(1));
        }
        assert_eq!(sequence.missing.intervals(), INTERVALS_MAX);
        // Only the lowest intervals are dropped.
        assert_eq!(sequence.receive(1, at(1)), Arrival::Early);
        assert_eq!(sequence.receive(2 * 500 + 1, at(1)), Arrival::Late);
        assert_eq!(sequence.receive(last - 1, at(1)), Arrival::Late);
        assert_eq!(sequence.missing.intervals(), INTERVALS_MAX - 2);
    }
}
