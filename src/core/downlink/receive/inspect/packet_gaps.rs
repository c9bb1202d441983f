//! The gaps in the packet counts of one kind, whatever the order of its packets in a file.

use std::collections::BTreeMap;

use crate::downlink::receive::{ReceivedSet, SendingKey};
use crate::downlink::wire::{CucTime, PacketHeader};

/// Maximum number of runs of consecutive counts with the same creation time that are kept, some 200 MB, as on the ground; beyond it
/// the earliest are forgotten.
const RUNS_MAX: usize = 1 << 20;

/// Missing packets between two of a file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PacketGap {
    /// Count of the first missing packet.
    pub(super) from: u64,
    /// Count of the last missing packet.
    pub(super) to: u64,
    /// Creation time of the packet before them.
    pub(super) after: CucTime,
    /// Creation time of the packet after them.
    pub(super) before: CucTime,
    /// Offset of the packet after them, bytes.
    pub(super) offset: u64,
}

/// The packets of one kind that a file has, valid or damaged.
#[derive(Clone, Debug, Default)]
pub(super) struct SeenPackets {
    packets: ReceivedSet,
    /// Offsets of the first packets of the runs of `packets`.
    offsets: BTreeMap<SendingKey, u64>,
}

impl SeenPackets {
    pub(super) fn add(&mut self, header: &PacketHeader, offset: u64) {
        let PacketHeader { count, time, .. } = *header;
        if !self.packets.insert(count, time) {
            return;
        }
        self.offsets.remove(&(time, count + 1));
        if count.checked_sub(1).is_none_or(|before| !self.packets.contains(before, time)) {
            self.offsets.insert((time, count), offset);
        }
        self.packets.remove_oldest(RUNS_MAX);
        while self.offsets.len() > RUNS_MAX {
            self.offsets.pop_first();
        }
    }

    /// The gaps in the order of sending. Packets before the first of the file are none; after a restart counts begin at 0.
    pub(super) fn gaps(&self) -> impl Iterator<Item = PacketGap> + '_ {
        let mut last: Option<SendingKey> = None;
        self.packets.intervals().filter_map(move |(before, counts)| {
            let (after, end) = last.replace((before, counts.end))?;
            let from = if counts.start < end { 0 } else { end };
            let to = counts.start.checked_sub(1).filter(|to| *to >= from)?;
            let offset = self.offsets.get(&(before, counts.start)).copied().unwrap_or_default();
            Some(PacketGap { from, to, after, before, offset })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::wire::{FORMAT_VERSION, PacketKind, PacketSegment};

    fn seen(packets: &[(u64, u64)]) -> Vec<PacketGap> {
        let mut seen = SeenPackets::default();
        for &(count, s) in packets {
            let header = PacketHeader {
                kind: PacketKind::Visibilities,
                segment: PacketSegment::Whole,
                count,
                time: CucTime(s),
                version: FORMAT_VERSION,
                bytes: 30,
            };
            // The offset tells the packet.
            seen.add(&header, 1000 * s + count);
        }
        assert_eq!(seen.offsets.len(), seen.packets.intervals().count());
        seen.gaps().collect()
    }

    fn gap(from: u64, to: u64, after: u64, before: u64, offset: u64) -> PacketGap {
        PacketGap { from, to, after: CucTime(after), before: CucTime(before), offset }
    }

    #[test]
    fn late_packets_close_their_gaps() {
        // Counts 10 to 15, two of each second.
        let sent: Vec<(u64, u64)> = (10..16).map(|count| (count, count / 2)).collect();
        for turn in 0..sent.len() {
            let mut packets = sent.clone();
            packets.rotate_left(turn);
            assert_eq!(seen(&packets), []);
            packets.reverse();
            assert_eq!(seen(&packets), []);
        }
        assert_eq!(
            seen(&[(15, 7), (10, 5), (14, 7), (12, 6)]),
            [gap(11, 11, 5, 6, 6012), gap(13, 13, 6, 7, 7014)]
        );
        assert_eq!(seen(&[(15, 7), (10, 5)]), [gap(11, 14, 5, 7, 7015)]);
    }

    #[test]
    fn counts_begin_at_0_after_a_restart() {
        assert_eq!(seen(&[(10, 5), (11, 5), (0, 6), (1, 6)]), []);
        assert_eq!(seen(&[(2, 6), (11, 5), (10, 5)]), [gap(0, 1, 5, 6, 6002)]);
    }
}
