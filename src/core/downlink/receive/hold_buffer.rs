//! The hold buffer, in which visibilities wait for their positions, and segments for the rest of their payload.

use std::collections::BTreeMap;

use bincode::{Decode, Encode};

use super::Packet;
use crate::downlink::wire::payload::visibilities_outline;
use crate::downlink::wire::{
    COUNT_MAX, CucTime, PACKET_BYTES_MAX, PacketHeader, PacketKind, PacketSegment, VisibilitiesOutline,
};
use crate::units::MissionTime;

/// Memory of a held packet in addition to its bytes.
const OVERHEAD_BYTES: u64 = 128;

const OTHERS_BYTES_MAX: u64 = 1 << 25;

/// Minimum capacity before an instrument description arrives, bytes.
const BEFORE_INSTRUMENT_BYTES: u64 = 1 << 26;

/// Maximum number of segments of a payload on either side of a segment.
const SEGMENTS_MAX: usize = 4096;

/// Decides whether visibilities with this outline can be delivered, for example because their positions are known.
pub type IsDue<'a> = &'a dyn Fn(&VisibilitiesOutline) -> bool;

/// Key of a packet in the order of sending within its kind: creation time and count.
pub(crate) type SendingKey = (CucTime, u64);

/// A packet in the hold buffer.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct HeldPacket {
    /// The headers of the packet.
    pub header: PacketHeader,
    /// The content of the packet.
    pub payload: Vec<u8>,
    /// The checksum over headers and payload.
    pub checksum: u32,
}

impl HeldPacket {
    /// A copy of a packet.
    #[must_use]
    pub fn new(packet: &Packet<'_>) -> Self {
        Self { header: packet.header, payload: packet.payload.to_vec(), checksum: packet.checksum }
    }

    /// The packet as the receiver returned it.
    #[must_use]
    pub fn packet(&self) -> Packet<'_> {
        let Self { header, payload, checksum } = self;
        Packet { offset: 0, header: *header, payload, checksum: *checksum, late: false }
    }

    /// First and last instant of the visibilities in the packet; `None` if unknown.
    #[must_use]
    pub fn span(&self) -> Option<[MissionTime; 2]> {
        self.outline().map(|outline| outline.span)
    }

    /// Outline of the visibilities that the packet claims to hold; `None` if it has no outline.
    #[must_use]
    pub fn outline(&self) -> Option<VisibilitiesOutline> {
        visibilities_outline(&self.payload).filter(|_| self.header.kind == PacketKind::Visibilities)
    }

    fn cost(&self) -> u64 {
        cost(&self.header)
    }
}

fn cost(header: &PacketHeader) -> u64 {
    (header.bytes as u64).saturating_add(OVERHEAD_BYTES)
}

/// Holds visibilities until their positions are known, and segments until their payload is complete, in bounded memory.
///
/// Beyond its capacity it releases the oldest visibilities although their positions are unknown. Until then, the held and the
/// released packets depend on the set of packets received, not on their order.
#[derive(Clone, Debug, Default, PartialEq, Encode, Decode)]
pub struct HoldBuffer {
    visibilities: BTreeMap<SendingKey, HeldPacket>,
    /// Memory of `visibilities`. Saturates, as checkpoints are untrusted.
    bytes: u64,
    others: BTreeMap<(PacketKind, SendingKey), HeldPacket>,
    others_bytes: u64,
    bytes_max: u64,
}

impl HoldBuffer {
    /// An empty buffer for `bytes_max` bytes of visibilities, including 128 bytes of overhead per packet.
    #[must_use]
    pub fn new(bytes_max: u64) -> Self {
        Self { bytes_max, ..Self::default() }
    }

    /// Capacity for visibilities, bytes.
    #[must_use]
    pub fn bytes_max(&self) -> u64 {
        self.bytes_max
    }

    /// Bytes of held visibilities, including 128 bytes of overhead per packet.
    #[must_use]
    pub fn waiting_bytes(&self) -> u64 {
        self.bytes
    }

    /// Inserts a packet.
    pub fn insert(&mut self, packet: HeldPacket) {
        let PacketHeader { kind, time, count, .. } = packet.header;
        let cost = packet.cost();
        let (replaced, bytes) = match kind {
            PacketKind::Visibilities => (self.visibilities.insert((time, count), packet), &mut self.bytes),
            _ => (self.others.insert((kind, (time, count)), packet), &mut self.others_bytes),
        };
        *bytes = bytes.saturating_add(cost).saturating_sub(replaced.map_or(0, |packet| packet.cost()));
    }

    /// Whether inserting packets could have produced this state. Checkpoints are untrusted.
    pub(crate) fn is_sound(&self) -> bool {
        let is_packet =
            |packet: &HeldPacket| packet.header.count <= COUNT_MAX && packet.header.bytes <= PACKET_BYTES_MAX;
        let key_of = |packet: &HeldPacket| (packet.header.time, packet.header.count);
        let cost =
            |packets: &mut dyn Iterator<Item = &HeldPacket>| -> u64 { packets.map(HeldPacket::cost).sum() };
        self.packets().all(is_packet)
            && self
                .visibilities
                .iter()
                .all(|(key, packet)| (*key, PacketKind::Visibilities) == (key_of(packet), packet.header.kind))
            && self.others.iter().all(|(key, packet)| *key == (packet.header.kind, key_of(packet)))
            && self.bytes == cost(&mut self.visibilities.values())
            && self.others_bytes == cost(&mut self.others.values())
    }

    /// All packets, visibilities first.
    pub fn packets(&self) -> impl Iterator<Item = &HeldPacket> {
        self.visibilities.values().chain(self.others.values())
    }

    /// The packet with these headers.
    #[must_use]
    pub fn get(&self, header: &PacketHeader) -> Option<&HeldPacket> {
        let key_of = (header.time, header.count);
        match header.kind {
            PacketKind::Visibilities => self.visibilities.get(&key_of),
            kind => self.others.get(&(kind, key_of)),
        }
    }

    /// Removes a packet.
    pub fn remove(&mut self, header: &PacketHeader) -> Option<HeldPacket> {
        let key_of = (header.time, header.count);
        let (found, bytes) = match header.kind {
            PacketKind::Visibilities => (self.visibilities.remove(&key_of), &mut self.bytes),
            kind => (self.others.remove(&(kind, key_of)), &mut self.others_bytes),
        };
        *bytes = bytes.saturating_sub(found.as_ref().map_or(0, HeldPacket::cost));
        found
    }

    /// Removes a packet of visibilities if `is_due` is true for its outline, or if it has no outline.
    pub fn release(&mut self, header: &PacketHeader, is_due: IsDue<'_>) -> Option<HeldPacket> {
        if self.get(header)?.outline().as_ref().is_none_or(is_due) { self.remove(header) } else { None }
    }

    /// Whether one more packet of visibilities fits into the capacity.
    #[must_use]
    pub fn has_room(&self, header: &PacketHeader) -> bool {
        self.bytes.saturating_add(cost(header)) <= self.bytes_max
    }

    /// Whether the held visibilities exceed the capacity.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.bytes > self.bytes_max
    }

    /// Removes the packet of visibilities that was sent first.
    pub fn pop_visibilities(&mut self) -> Option<HeldPacket> {
        let (_, packet) = self.visibilities.pop_first()?;
        self.bytes = self.bytes.saturating_sub(packet.cost());
        Some(packet)
    }

    /// Removes all packets of the payload that this one belongs to, if it is complete.
    pub fn take_payload(&mut self, header: &PacketHeader) -> Option<Vec<HeldPacket>> {
        let segments = self.segments(header)?;
        Some(segments.iter().filter_map(|header| self.remove(header)).collect())
    }

    /// Headers of all packets of the payload that this one belongs to, if it is complete.
    fn segments(&self, header: &PacketHeader) -> Option<Vec<PacketHeader>> {
        let PacketHeader { kind, time, count, segment, .. } = *header;
        let header_of = |count: u64| self.others.get(&(kind, (time, count))).map(|packet| packet.header);
        let mut last = (segment, count);
        while !matches!(last.0, PacketSegment::Last | PacketSegment::Whole) {
            let next = header_of(last.1 + 1)?;
            if !matches!(next.segment, PacketSegment::Continuation | PacketSegment::Last)
                || next.count - count > SEGMENTS_MAX as u64
            {
                return None;
            }
            last = (next.segment, next.count);
        }
        let mut first = (segment, count);
        while !matches!(first.0, PacketSegment::First | PacketSegment::Whole) {
            let before = header_of(first.1.checked_sub(1)?)?;
            if !matches!(before.segment, PacketSegment::Continuation | PacketSegment::First)
                || count - before.count > SEGMENTS_MAX as u64
            {
                return None;
            }
            first = (before.segment, before.count);
        }
        (first.1..=last.1).map(header_of).collect()
    }

    /// Removes the first packet other than visibilities if these exceed their capacity.
    pub fn pop_excess_segment(&mut self) -> Option<HeldPacket> {
        if self.others_bytes > OTHERS_BYTES_MAX { self.pop_other() } else { None }
    }

    /// Removes the first packet if the packets exceed the capacity that applies before an instrument description arrives.
    pub fn pop_before_instrument(&mut self) -> Option<HeldPacket> {
        if self.bytes.saturating_add(self.others_bytes) <= self.bytes_max.max(BEFORE_INSTRUMENT_BYTES) {
            return None;
        }
        self.pop_visibilities().or_else(|| self.pop_other())
    }

    /// Removes the first packet other than visibilities.
    pub fn pop_other(&mut self) -> Option<HeldPacket> {
        let (_, packet) = self.others.pop_first()?;
        self.others_bytes = self.others_bytes.saturating_sub(packet.cost());
        Some(packet)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::FORMAT_VERSION;

    const BYTES: u64 = 30;

    fn packet(count: u64) -> HeldPacket {
        let header = PacketHeader {
            kind: PacketKind::Visibilities,
            segment: PacketSegment::Whole,
            count,
            time: CucTime(count / 3),
            version: FORMAT_VERSION,
            bytes: BYTES as usize,
        };
        HeldPacket { header, payload: Vec::new(), checksum: 0 }
    }

    /// A state that claims fewer bytes than its packets have, found by fuzzing.
    #[test]
    fn what_waits_may_be_more_than_a_forged_state_says() {
        let mut forged = HoldBuffer::new(0);
        forged.insert(packet(5));
        forged.insert(packet(7));
        assert!(forged.is_sound());
        for (bytes, others_bytes) in [(1, 0), (2 * (BYTES + OVERHEAD_BYTES), 1)] {
            assert!(!HoldBuffer { bytes, others_bytes, ..forged.clone() }.is_sound());
        }
        (forged.bytes, forged.others_bytes) = (1, u64::MAX);
        forged.insert(HeldPacket {
            header: PacketHeader { bytes: usize::MAX, ..packet(9).header },
            ..packet(9)
        });
        assert!(forged.remove(&packet(5).header).is_some());
        while forged.pop_visibilities().is_some() {}
        assert!(forged.visibilities.is_empty() && forged.pop_before_instrument().is_none());
    }

    #[test]
    fn visibilities_wait_for_their_positions() {
        let mut buffer = HoldBuffer::new(2 * (BYTES + OVERHEAD_BYTES));
        for count in 0..3 {
            let mut packet = packet(count);
            // Record and arrays of one visibility: channel, pair, start, count; offset, duration, value, weight, flags.
            packet.payload = [0, 0, 0, 1].to_vec();
            packet.payload.extend((1000 * count as i64).to_le_bytes());
            packet.payload.extend(1_u32.to_le_bytes());
            packet.payload.extend([5_u32, 10].map(u32::to_le_bytes).concat());
            packet.payload.resize(16 + 21, 0);
            buffer.insert(packet);
        }
        let seen = std::cell::RefCell::new(Vec::new());
        let until = |end: i64| {
            let seen = &seen;
            move |outline: &VisibilitiesOutline| {
                let [from, to] = outline.span;
                seen.borrow_mut().push((from.0, to.0));
                to.0 <= end
            }
        };
        let mut placed = |count: u64, end: i64| buffer.release(&packet(count).header, &until(end)).is_some();
        // The second is released before the first: only the span of each matters.
        assert!(!placed(0, 0) && !placed(1, 500) && placed(1, 1015) && !placed(1, 1015) && !placed(7, 9999));
        assert_eq!(*seen.borrow(), [(5, 15), (1005, 1015), (1005, 1015)]);
        assert!(!buffer.is_full());
        buffer.insert(packet(9));
        assert!(buffer.is_full());
        assert_eq!(buffer.pop_visibilities().map(|packet| packet.header.count), Some(0));
        assert!(!buffer.is_full());
        // A packet without an outline does not wait.
        assert!(buffer.release(&packet(9).header, &until(0)).is_some());
    }

    #[test]
    fn payloads_are_put_together_whatever_the_order() {
        let segment = |count: u64, segment: PacketSegment| {
            let header = PacketHeader {
                kind: PacketKind::Ephemeris,
                segment,
                time: CucTime(7),
                ..packet(count).header
            };
            HeldPacket { header, payload: vec![count as u8], checksum: 0 }
        };
        let all = [
            segment(3, PacketSegment::First),
            segment(4, PacketSegment::Continuation),
            segment(5, PacketSegment::Last),
            segment(6, PacketSegment::Whole),
        ];
        for order in [[0, 1, 2], [2, 1, 0], [1, 0, 2], [2, 0, 1]] {
            let mut buffer = HoldBuffer::new(0);
            let mut found = Vec::new();
            for k in order {
                buffer.insert(all[k].clone());
                found.push(buffer.take_payload(&all[k].header));
            }
            assert_eq!(found, [None, None, Some(all[..3].to_vec())], "{order:?}");
            buffer.insert(all[3].clone());
            assert_eq!(buffer.take_payload(&all[3].header), Some(all[3..].to_vec()));
            assert_eq!((buffer.others.len(), buffer.others_bytes), (0, 0));
        }
    }
}
