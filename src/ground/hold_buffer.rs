//! Packets that wait: visibilities for their positions, parts of payloads for each other.

use std::collections::BTreeMap;

use bincode::{Decode, Encode};

use crate::downlink::receive::{Event, Packet};
use crate::downlink::wire::payload::visibilities_span;
use crate::downlink::wire::{COUNT_MAX, CucTime, Kind, PACKET_BYTES_MAX, PacketHeader, PacketSegment};
use crate::units::MissionTime;

/// Memory that a packet takes while it waits, beyond its bytes.
const KEEPING_BYTES: u64 = 128;

/// Bytes of packets other than visibilities that may wait: for the rest of their payload.
const OTHERS_BYTES_MAX: u64 = 1 << 25;

/// Bytes that may wait for an instrument description, if those that wait otherwise are fewer.
const PATIENCE_BYTES: u64 = 1 << 26;

/// Segments of a payload that are looked for on either side of one.
const SEGMENTS_MAX: usize = 4096;

/// Order of sending.
type Sent = (CucTime, u64);

/// A packet that waits.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct WaitingPacket {
    /// Its headers.
    pub header: PacketHeader,
    /// What it carries.
    pub payload: Vec<u8>,
    /// Its check, over headers and payload.
    pub check: u32,
}

impl WaitingPacket {
    /// Keeps a packet.
    #[must_use]
    pub fn of(packet: &Packet<'_>) -> Self {
        Self { header: packet.header, payload: packet.payload.to_vec(), check: packet.check }
    }

    /// The packet as an event of a stream.
    #[must_use]
    pub fn event(&self) -> Event<'_> {
        let Self { header, payload, check } = self;
        Event::Packet(Packet { offset: 0, header: *header, payload, check: *check, late: false })
    }

    /// First and last instant of the visibilities in it; `None` if it does not say.
    #[must_use]
    pub fn span(&self) -> Option<[MissionTime; 2]> {
        visibilities_span(&self.payload).filter(|_| self.header.kind == Kind::Visibilities)
    }

    fn cost(&self) -> u64 {
        (self.header.bytes as u64).saturating_add(KEEPING_BYTES)
    }
}

/// Keeps visibilities until their positions are known, and parts of payloads until the others have come, within bounds.
///
/// When more bytes wait than may, the visibilities that were sent first go on as they are. As long as they need not,
/// what waits and what has gone is a function of the set of packets that have come, not of their order.
#[derive(Clone, Debug, Default, PartialEq, Encode, Decode)]
pub struct Waiting {
    visibilities: BTreeMap<Sent, WaitingPacket>,
    /// A state that was read may lie about it, so it never wraps.
    bytes: u64,
    others: BTreeMap<(Kind, Sent), WaitingPacket>,
    others_bytes: u64,
    bytes_max: u64,
}

impl Waiting {
    /// Nothing waits yet; later so many bytes, counting 128 for each packet besides its own.
    #[must_use]
    pub fn new(bytes_max: u64) -> Self {
        Self { bytes_max, ..Self::default() }
    }

    /// Takes a packet that has not come before.
    pub fn put(&mut self, packet: WaitingPacket) {
        let PacketHeader { kind, time, count, .. } = packet.header;
        let cost = packet.cost();
        let (replaced, bytes) = match kind {
            Kind::Visibilities => (self.visibilities.insert((time, count), packet), &mut self.bytes),
            _ => (self.others.insert((kind, (time, count)), packet), &mut self.others_bytes),
        };
        *bytes = bytes.saturating_add(cost).saturating_sub(replaced.map_or(0, |packet| packet.cost()));
    }

    /// Whether it is as taking packets makes it, which one that was read need not be.
    pub(super) fn is_sound(&self) -> bool {
        let is_packet = |packet: &WaitingPacket| {
            packet.header.count <= COUNT_MAX && packet.header.bytes <= PACKET_BYTES_MAX
        };
        let sent = |packet: &WaitingPacket| (packet.header.time, packet.header.count);
        let cost = |packets: &mut dyn Iterator<Item = &WaitingPacket>| -> u64 {
            packets.map(WaitingPacket::cost).sum()
        };
        self.packets().all(is_packet)
            && self
                .visibilities
                .iter()
                .all(|(key, packet)| (*key, Kind::Visibilities) == (sent(packet), packet.header.kind))
            && self.others.iter().all(|(key, packet)| *key == (packet.header.kind, sent(packet)))
            && self.bytes == cost(&mut self.visibilities.values())
            && self.others_bytes == cost(&mut self.others.values())
    }

    /// All packets, visibilities first.
    pub fn packets(&self) -> impl Iterator<Item = &WaitingPacket> {
        self.visibilities.values().chain(self.others.values())
    }

    /// The packet of these headers, if it waits.
    #[must_use]
    pub fn get(&self, header: &PacketHeader) -> Option<&WaitingPacket> {
        let sent = (header.time, header.count);
        match header.kind {
            Kind::Visibilities => self.visibilities.get(&sent),
            kind => self.others.get(&(kind, sent)),
        }
    }

    /// Lets go of a packet as if it had never come.
    pub fn take_out(&mut self, header: &PacketHeader) -> Option<WaitingPacket> {
        let sent = (header.time, header.count);
        let (found, bytes) = match header.kind {
            Kind::Visibilities => (self.visibilities.remove(&sent), &mut self.bytes),
            kind => (self.others.remove(&(kind, sent)), &mut self.others_bytes),
        };
        *bytes = bytes.saturating_sub(found.as_ref().map_or(0, WaitingPacket::cost));
        found
    }

    /// Visibilities that wait and need not: positions are known over all their time, or it cannot be told.
    pub fn placed_visibilities(
        &mut self,
        header: &PacketHeader,
        placed: &dyn Fn([MissionTime; 2]) -> bool,
    ) -> Option<WaitingPacket> {
        if self.get(header)?.span().is_none_or(placed) { self.take_out(header) } else { None }
    }

    /// Whether more visibilities wait than may.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.bytes > self.bytes_max
    }

    /// The first visibilities, due or not.
    pub fn first_visibilities(&mut self) -> Option<WaitingPacket> {
        let (_, packet) = self.visibilities.pop_first()?;
        self.bytes = self.bytes.saturating_sub(packet.cost());
        Some(packet)
    }

    /// All packets of the payload that one of these headers is of, if all have come.
    pub fn payload_of(&mut self, header: &PacketHeader) -> Option<Vec<WaitingPacket>> {
        let segments = self.segments(header)?;
        Some(segments.iter().filter_map(|header| self.take_out(header)).collect())
    }

    /// Headers of the payload that one of these headers is of, if all have come.
    fn segments(&self, header: &PacketHeader) -> Option<Vec<PacketHeader>> {
        let PacketHeader { kind, time, count, segment, .. } = *header;
        let at = |count: u64| self.others.get(&(kind, (time, count))).map(|packet| packet.header);
        let mut last = (segment, count);
        while !matches!(last.0, PacketSegment::Last | PacketSegment::Whole) {
            let next = at(last.1 + 1)?;
            if !matches!(next.segment, PacketSegment::Continuation | PacketSegment::Last)
                || next.count - count > SEGMENTS_MAX as u64
            {
                return None;
            }
            last = (next.segment, next.count);
        }
        let mut first = (segment, count);
        while !matches!(first.0, PacketSegment::First | PacketSegment::Whole) {
            let before = at(first.1.checked_sub(1)?)?;
            if !matches!(before.segment, PacketSegment::Continuation | PacketSegment::First)
                || count - before.count > SEGMENTS_MAX as u64
            {
                return None;
            }
            first = (before.segment, before.count);
        }
        (first.1..=last.1).map(at).collect()
    }

    /// A packet other than visibilities whose payload is given up, if more of them wait than may.
    pub fn next_given_up(&mut self) -> Option<WaitingPacket> {
        if self.others_bytes > OTHERS_BYTES_MAX { self.first_other() } else { None }
    }

    /// The first packet if nobody can read it for want of a description and more wait than may.
    pub fn next_unread(&mut self) -> Option<WaitingPacket> {
        if self.bytes.saturating_add(self.others_bytes) <= self.bytes_max.max(PATIENCE_BYTES) {
            return None;
        }
        self.first_visibilities().or_else(|| self.first_other())
    }

    /// The first packet other than visibilities.
    pub fn first_other(&mut self) -> Option<WaitingPacket> {
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

    fn packet(count: u64) -> WaitingPacket {
        let header = PacketHeader {
            kind: Kind::Visibilities,
            segment: PacketSegment::Whole,
            count,
            time: CucTime(count / 3),
            version: FORMAT_VERSION,
            bytes: BYTES as usize,
        };
        WaitingPacket { header, payload: Vec::new(), check: 0 }
    }

    /// Found by fuzzing: a state that says that less waits than does.
    #[test]
    fn what_waits_may_be_more_than_a_forged_state_says() {
        let mut forged = Waiting::new(0);
        forged.put(packet(5));
        forged.put(packet(7));
        assert!(forged.is_sound());
        for (bytes, others_bytes) in [(1, 0), (2 * (BYTES + KEEPING_BYTES), 1)] {
            assert!(!Waiting { bytes, others_bytes, ..forged.clone() }.is_sound());
        }
        (forged.bytes, forged.others_bytes) = (1, u64::MAX);
        forged.put(WaitingPacket {
            header: PacketHeader { bytes: usize::MAX, ..packet(9).header },
            ..packet(9)
        });
        assert!(forged.take_out(&packet(5).header).is_some());
        while forged.first_visibilities().is_some() {}
        assert!(forged.visibilities.is_empty() && forged.next_unread().is_none());
    }

    #[test]
    fn visibilities_wait_for_their_positions() {
        let mut waiting = Waiting::new(2 * (BYTES + KEEPING_BYTES));
        for count in 0..3 {
            let mut packet = packet(count);
            // Record and arrays of one visibility: channel, pair, start, count; offset, duration, value, weight, flags.
            packet.payload = [0, 0, 0, 1].to_vec();
            packet.payload.extend((1000 * count as i64).to_le_bytes());
            packet.payload.extend(1_u32.to_le_bytes());
            packet.payload.extend([5_u32, 10].map(u32::to_le_bytes).concat());
            packet.payload.resize(16 + 21, 0);
            waiting.put(packet);
        }
        let seen = std::cell::RefCell::new(Vec::new());
        let until = |end: i64| {
            let seen = &seen;
            move |[from, to]: [MissionTime; 2]| {
                seen.borrow_mut().push((from.0, to.0));
                to.0 <= end
            }
        };
        let mut placed =
            |count: u64, end: i64| waiting.placed_visibilities(&packet(count).header, &until(end)).is_some();
        // The second goes before the first: what lies in between does not matter.
        assert!(!placed(0, 0) && !placed(1, 500) && placed(1, 1015) && !placed(1, 1015) && !placed(7, 9999));
        assert_eq!(*seen.borrow(), [(5, 15), (1005, 1015), (1005, 1015)]);
        assert!(!waiting.is_full());
        waiting.put(packet(9));
        assert!(waiting.is_full());
        assert_eq!(waiting.first_visibilities().map(|packet| packet.header.count), Some(0));
        assert!(!waiting.is_full());
        // One that does not say which time it is of waits for nothing.
        assert!(waiting.placed_visibilities(&packet(9).header, &until(0)).is_some());
    }

    #[test]
    fn payloads_are_put_together_whatever_the_order() {
        let segment = |count: u64, segment: PacketSegment| {
            let header =
                PacketHeader { kind: Kind::Ephemeris, segment, time: CucTime(7), ..packet(count).header };
            WaitingPacket { header, payload: vec![count as u8], check: 0 }
        };
        let all = [
            segment(3, PacketSegment::First),
            segment(4, PacketSegment::Continuation),
            segment(5, PacketSegment::Last),
            segment(6, PacketSegment::Whole),
        ];
        for order in [[0, 1, 2], [2, 1, 0], [1, 0, 2], [2, 0, 1]] {
            let mut waiting = Waiting::new(0);
            let mut found = Vec::new();
            for k in order {
                waiting.put(all[k].clone());
                found.push(waiting.payload_of(&all[k].header));
            }
            assert_eq!(found, [None, None, Some(all[..3].to_vec())], "{order:?}");
            waiting.put(all[3].clone());
            assert_eq!(waiting.payload_of(&all[3].header), Some(all[3..].to_vec()));
            assert_eq!((waiting.others.len(), waiting.others_bytes), (0, 0));
        }
    }
}
