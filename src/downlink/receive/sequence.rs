//! Packet counts of one kind: what is missing, late or duplicate.

use std::ops::Range;

use super::ReceivedSet;
use crate::downlink::wire::CucTime;
use crate::units::IntervalSet;

/// Intervals of counts that are remembered, both of received packets and of missing ones that may arrive late. Fifteen
/// times the packets of the paper's mission. Bounds the memory to some 100 MB a kind, whatever a forger sends.
const INTERVALS_MAX: usize = 1 << 20;

/// How a packet's count relates to those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arrival {
    /// The first of its kind, or the successor of the last.
    InOrder,
    /// Packets are missing before it.
    AfterGap {
        /// The count that was due.
        expected: u64,
    },
    /// It fills a gap reported earlier.
    Late,
    /// It was sent before the first of its kind received, or before a restart.
    Early,
    /// It was received before.
    Duplicate,
    /// Its count is lower, yet its time is later: the spacecraft restarted its count.
    Restart {
        /// The count that was due.
        expected: u64,
    },
}

/// The counts received so far.
#[derive(Clone, Debug, Default)]
pub(super) struct Sequence {
    begun: bool,
    /// Count of the first packet since the last restart.
    first: u64,
    next: u64,
    /// Latest time of a sound packet.
    newest: CucTime,
    /// Sound packets received.
    received: ReceivedSet,
    /// Missing counts below `next`, in at most [`INTERVALS_MAX`] intervals.
    missing: IntervalSet<u64>,
}

impl Sequence {
    /// Records a sound packet.
    pub(super) fn receive(&mut self, count: u64, time: CucTime) -> Arrival {
        let arrival = self.classify(count, time);
        match arrival {
            Arrival::InOrder | Arrival::AfterGap { .. } | Arrival::Restart { .. } => self.next = count + 1,
            Arrival::Late | Arrival::Early => self.fill(count),
            Arrival::Duplicate => return arrival,
        }
        self.newest = self.newest.max(time);
        self.received.insert(count, time);
        self.received.remove_oldest(INTERVALS_MAX);
        arrival
    }

    /// Records a damaged packet with sound headers: its count is passed, but a sound copy may still arrive.
    pub(super) fn pass_damaged(&mut self, count: u64, time: CucTime) -> Arrival {
        let arrival = self.classify(count, time);
        if !matches!(arrival, Arrival::Late | Arrival::Early | Arrival::Duplicate) {
            self.miss(count..count + 1);
            self.next = count + 1;
        }
        arrival
    }

    /// Restarts of the count.
    pub(crate) fn restarts(&self) -> u64 {
        self.received.restarts()
    }

    fn classify(&mut self, count: u64, time: CucTime) -> Arrival {
        let expected = self.next;
        if self.received.contains(count, time) {
            return Arrival::Duplicate;
        }
        if !std::mem::replace(&mut self.begun, true) {
            self.begin(count);
            Arrival::InOrder
        } else if time >= self.newest && count == expected {
            Arrival::InOrder
        } else if time >= self.newest && count > expected {
            self.miss(expected..count);
            Arrival::AfterGap { expected }
        } else if time > self.newest {
            self.begin(count);
            Arrival::Restart { expected }
        } else if count >= self.first && self.missing.contains(count) {
            Arrival::Late
        } else {
            Arrival::Early
        }
    }

    /// Starts with a packet. Packets sent before it are no gap, but may still arrive.
    fn begin(&mut self, count: u64) {
        self.first = count;
        self.missing.clear();
        self.miss(0..count);
    }

    /// Marks counts as missing.
    fn miss(&mut self, counts: Range<u64>) {
        self.missing.insert(counts);
        self.missing.drop_lowest(INTERVALS_MAX);
    }

    /// Marks a count as received.
    fn fill(&mut self, count: u64) {
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
    fn a_lower_count_made_later_is_a_restart() {
        let mut sequence = Sequence::default();
        sequence.receive(100, at(5));
        assert_eq!(sequence.receive(0, at(6)), Arrival::Restart { expected: 101 });
        assert_eq!(sequence.receive(1, at(6)), Arrival::InOrder);
        assert_eq!(sequence.restarts(), 1);
    }

    #[test]
    fn what_was_sent_before_a_restart_may_come_after_it() {
        let mut sequence = Sequence::default();
        for count in 0..3 {
            assert_eq!(sequence.receive(count, at(9)), Arrival::InOrder);
        }
        // Lower counts, the one that is due, and higher ones: none is a duplicate, none reveals a gap.
        for count in 0..9 {
            assert_eq!(sequence.receive(count, at(1)), Arrival::Early, "{count}");
            assert_eq!(sequence.receive(count, at(1)), Arrival::Duplicate, "{count}");
        }
        assert_eq!(sequence.receive(3, at(9)), Arrival::InOrder);
        assert_eq!(sequence.restarts(), 1);
    }

    #[test]
    fn a_damaged_packet_may_come_again() {
        let mut sequence = Sequence::default();
        sequence.receive(0, at(1));
        assert_eq!(sequence.pass_damaged(1, at(1)), Arrival::InOrder);
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
