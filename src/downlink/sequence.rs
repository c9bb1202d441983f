//! Packet counts of one kind: what is missing, late, twice.

use std::ops::Range;

use super::cuc::CucTime;

/// Stretches of missing packets that are remembered in case they arrive late; bounds the memory.
const STRETCHES_MAX: usize = 4096;

/// What the count of a packet says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arrival {
    /// The first of its kind, or the one after the last.
    InOrder,
    /// Packets are missing before it.
    AfterGap {
        /// The count that was due.
        expected: u64,
    },
    /// It fills a gap that has been reported.
    Late,
    /// It was sent before the first of its kind that came.
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
pub(super) struct Sequence {
    begun: bool,
    /// Count of the packet that came first, since the last restart.
    first: u64,
    next: u64,
    newest: CucTime,
    /// Missing counts below `next`, in order, at most [`STRETCHES_MAX`] stretches.
    missing: Vec<Range<u64>>,
}

impl Sequence {
    /// Takes a packet into the account.
    pub(super) fn receive(&mut self, count: u64, time: CucTime) -> Arrival {
        let arrival = self.judge(count, time);
        match arrival {
            Arrival::InOrder | Arrival::AfterGap { .. } | Arrival::Restart { .. } => self.next = count + 1,
            Arrival::Late | Arrival::Early => self.fill(count),
            Arrival::Duplicate => {}
        }
        arrival
    }

    /// Takes a damaged packet, of which the headers alone hold, into the account: its place is passed but
    /// may still be filled.
    pub(super) fn pass_damaged(&mut self, count: u64, time: CucTime) -> Arrival {
        let arrival = self.judge(count, time);
        if !matches!(arrival, Arrival::Late | Arrival::Early | Arrival::Duplicate) {
            self.miss(count..count + 1);
            self.next = count + 1;
        }
        arrival
    }

    fn judge(&mut self, count: u64, time: CucTime) -> Arrival {
        let (expected, newest) = (self.next, self.newest);
        self.newest = newest.max(time);
        if !std::mem::replace(&mut self.begun, true) {
            self.begin(count);
            return Arrival::InOrder;
        }
        if count == expected {
            Arrival::InOrder
        } else if count > expected {
            self.miss(expected..count);
            Arrival::AfterGap { expected }
        } else if time > newest {
            self.begin(count);
            Arrival::Restart { expected }
        } else if self.stretch_of(count).is_some() {
            if count < self.first { Arrival::Early } else { Arrival::Late }
        } else {
            Arrival::Duplicate
        }
    }

    /// Begins with a packet: what was sent before it is no gap, but may still come.
    fn begin(&mut self, count: u64) {
        self.first = count;
        self.missing.clear();
        self.miss(0..count);
    }

    fn miss(&mut self, stretch: Range<u64>) {
        match self.missing.last_mut() {
            _ if stretch.is_empty() => {}
            Some(last) if last.end == stretch.start => last.end = stretch.end,
            _ => self.missing.push(stretch),
        }
        if self.missing.len() > STRETCHES_MAX {
            self.missing.remove(0);
        }
    }

    /// The missing stretch that a count lies in.
    fn stretch_of(&self, count: u64) -> Option<usize> {
        let at = self.missing.partition_point(|stretch| stretch.end <= count);
        self.missing.get(at).filter(|stretch| stretch.contains(&count)).map(|_| at)
    }

    fn fill(&mut self, count: u64) {
        let Some(at) = self.stretch_of(count) else { return };
        let stretch = self.missing[at].clone();
        let parts = [stretch.start..count, count + 1..stretch.end];
        self.missing.splice(at..=at, parts.into_iter().filter(|part| !part.is_empty()));
        if self.missing.len() > STRETCHES_MAX {
            self.missing.remove(0);
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
    }

    #[test]
    fn a_lower_count_made_later_is_a_restart() {
        let mut sequence = Sequence::default();
        sequence.receive(100, at(5));
        assert_eq!(sequence.receive(0, at(6)), Arrival::Restart { expected: 101 });
        assert_eq!(sequence.receive(1, at(6)), Arrival::InOrder);
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
        for k in 0..3 * STRETCHES_MAX as u64 {
            sequence.receive(2 * k, at(1));
        }
        assert_eq!(sequence.missing.len(), STRETCHES_MAX);
    }
}
