//! Packet counts of one kind: what is missing, late, twice.

use std::collections::BTreeMap;
use std::ops::Range;

use super::ReceivedSet;
use crate::downlink::wire::CucTime;

/// Stretches that are remembered: of packets that came, and of missing ones in case they arrive late. Fifteen times the
/// packets of the paper's mission. Bounds the memory to some 100 MB a kind, whatever a forger sends.
const STRETCHES_MAX: usize = 1 << 20;

/// What the count of a packet says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// The first of its kind, or the one after the last.
    InOrder,
    /// Packets are missing before it.
    AfterGap {
        /// The count that was due.
        expected: u64,
    },
    /// It fills a gap that has been reported.
    Late,
    /// It was sent before the first of its kind that came, or before a restart.
    Early,
    /// It has been here before.
    Duplicate,
    /// Its count is lower, yet it was made later: the spacecraft has begun to count anew.
    Restart {
        /// The count that was due.
        expected: u64,
    },
}

/// The counts that have arrived.
#[derive(Clone, Debug, Default)]
pub(crate) struct Sequence {
    begun: bool,
    /// Count of the packet that came first, since the last restart.
    first: u64,
    next: u64,
    /// Time of the latest good packet.
    newest: CucTime,
    /// Good packets that came.
    received: ReceivedSet,
    /// Missing counts below `next`: beginning and end (one beyond the last) of at most [`STRETCHES_MAX`] stretches.
    missing: BTreeMap<u64, u64>,
}

impl Sequence {
    /// Takes a packet into the account.
    pub(crate) fn receive(&mut self, count: u64, time: CucTime) -> Arrival {
        let arrival = self.judge(count, time);
        match arrival {
            Arrival::InOrder | Arrival::AfterGap { .. } | Arrival::Restart { .. } => self.next = count + 1,
            Arrival::Late | Arrival::Early => self.fill(count),
            Arrival::Duplicate => return arrival,
        }
        self.newest = self.newest.max(time);
        self.received.insert(count, time);
        self.received.remove_oldest(STRETCHES_MAX);
        arrival
    }

    /// Takes a damaged packet, of which the headers alone hold, into the account: its place is passed but
    /// may still be filled.
    pub(crate) fn pass_damaged(&mut self, count: u64, time: CucTime) -> Arrival {
        let arrival = self.judge(count, time);
        if !matches!(arrival, Arrival::Late | Arrival::Early | Arrival::Duplicate) {
            self.miss(count..count + 1);
            self.next = count + 1;
        }
        arrival
    }

    /// Times that the spacecraft has begun to count anew.
    pub(crate) fn restarts(&self) -> u64 {
        self.received.restarts()
    }

    fn judge(&mut self, count: u64, time: CucTime) -> Arrival {
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
        } else if count >= self.first && self.stretch_of(count).is_some() {
            Arrival::Late
        } else {
            Arrival::Early
        }
    }

    /// Begins with a packet: what was sent before it is no gap, but may still come.
    fn begin(&mut self, count: u64) {
        self.first = count;
        self.missing.clear();
        self.miss(0..count);
    }

    fn miss(&mut self, stretch: Range<u64>) {
        if stretch.is_empty() {
            return;
        }
        match self.missing.last_entry().filter(|last| *last.get() == stretch.start) {
            Some(mut last) => *last.get_mut() = stretch.end,
            None => drop(self.missing.insert(stretch.start, stretch.end)),
        }
        self.forget_oldest();
    }

    /// The missing stretch that a count lies in.
    fn stretch_of(&self, count: u64) -> Option<Range<u64>> {
        let (&start, &end) = self.missing.range(..=count).next_back()?;
        (count < end).then_some(start..end)
    }

    fn fill(&mut self, count: u64) {
        let Some(stretch) = self.stretch_of(count) else { return };
        self.missing.remove(&stretch.start);
        for part in [stretch.start..count, count + 1..stretch.end] {
            if !part.is_empty() {
                self.missing.insert(part.start, part.end);
            }
        }
        self.forget_oldest();
    }

    fn forget_oldest(&mut self) {
        if self.missing.len() > STRETCHES_MAX {
            self.missing.pop_first();
        }
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
        // Lower counts, the one that is due, and higher ones: none is a duplicate, none tells of a gap.
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
        let last = 2 * (STRETCHES_MAX as u64 + 500);
        for count in (0..=last).step_by(2) {
            sequence.receive(count, at(1));
        }
        assert_eq!(sequence.missing.len(), STRETCHES_MAX);
        // The oldest are forgotten, all others are not.
        assert_eq!(sequence.receive(1, at(1)), Arrival::Early);
        assert_eq!(sequence.receive(2 * 500 + 1, at(1)), Arrival::Late);
        assert_eq!(sequence.receive(last - 1, at(1)), Arrival::Late);
        assert_eq!(sequence.missing.len(), STRETCHES_MAX - 2);
    }
}
