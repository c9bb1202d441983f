//! Packets that wait for those that were sent before them.

use std::collections::BTreeMap;

use bincode::{Decode, Encode};

use super::cuc::CucTime;
use super::header::PacketHeader;
use super::receiver::{Event, Packet};

/// Order of sending, but that packets of one instant stand by kind.
type Key = (CucTime, u8, u64);

/// A packet that waits.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct WaitingPacket {
    /// Its headers.
    pub header: PacketHeader,
    /// What it carries.
    pub payload: Vec<u8>,
}

impl WaitingPacket {
    fn key(&self) -> Key {
        (self.header.time, self.header.kind as u8, self.header.count)
    }

    /// The packet as an event of a stream.
    #[must_use]
    pub fn event(&self) -> Event<'_> {
        Event::Packet(Packet { offset: 0, header: self.header, payload: &self.payload, late: false })
    }
}

/// Puts packets in the order in which they were sent, as long as none comes later than so many bytes of others.
///
/// What waits at any time is a function of the set of packets that have come, not of their order: those of which all
/// that were sent later make up less than the limit.
#[derive(Clone, Debug, Default, PartialEq, Encode, Decode)]
pub struct Waiting {
    packets: BTreeMap<Key, WaitingPacket>,
    bytes: u64,
    bytes_max: u64,
    /// The latest that was let go.
    gone: Option<Key>,
}

impl Waiting {
    /// Nothing waits yet; later so many bytes.
    #[must_use]
    pub fn new(bytes_max: u64) -> Self {
        Self { bytes_max, ..Self::default() }
    }

    /// Bytes that may wait.
    #[must_use]
    pub fn bytes_max(&self) -> u64 {
        self.bytes_max
    }

    /// Takes a packet that has not come before; gives it back if later ones have gone.
    pub fn put(&mut self, packet: WaitingPacket) -> Option<WaitingPacket> {
        let key = packet.key();
        if self.gone.is_some_and(|gone| key < gone) {
            return Some(packet);
        }
        self.bytes += packet.header.bytes as u64;
        self.packets.insert(key, packet);
        None
    }

    /// Headers of all packets, in order.
    pub fn headers(&self) -> impl Iterator<Item = PacketHeader> {
        self.packets.values().map(|packet| packet.header)
    }

    /// Lets go of a packet as if it had never come.
    pub fn drop_packet(&mut self, header: &PacketHeader) {
        let key = (header.time, header.kind as u8, header.count);
        if let Some(packet) = self.packets.remove(&key) {
            self.bytes -= packet.header.bytes as u64;
        }
    }

    /// The first of the packets, if so many times more wait than may; call it until it gives none.
    pub fn next_due(&mut self, times: u64) -> Option<WaitingPacket> {
        if self.bytes > self.bytes_max.saturating_mul(times) { self.next_waiting() } else { None }
    }

    /// The first of the packets.
    pub fn next_waiting(&mut self) -> Option<WaitingPacket> {
        let (key, packet) = self.packets.pop_first()?;
        self.bytes -= packet.header.bytes as u64;
        self.gone = self.gone.max(Some(key));
        Some(packet)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::downlink::{FORMAT_VERSION, Kind, Segment};

    fn packet(count: u64) -> WaitingPacket {
        let header = PacketHeader {
            kind: Kind::Visibilities,
            segment: Segment::Whole,
            count,
            time: CucTime(count / 3),
            version: FORMAT_VERSION,
            bytes: 30 + (count * 7 % 11) as usize,
        };
        WaitingPacket { header, payload: Vec::new() }
    }

    fn through(counts: &[u64], bytes_max: u64) -> (Vec<u64>, Waiting) {
        let mut waiting = Waiting::new(bytes_max);
        let mut order = Vec::new();
        for &count in counts {
            order.extend(waiting.put(packet(count)).map(|packet| packet.header.count));
            order.extend(std::iter::from_fn(|| waiting.next_due(1)).map(|packet| packet.header.count));
        }
        (order, waiting)
    }

    proptest! {
        #[test]
        fn disorder_within_the_limit_leaves_no_trace(shifts in proptest::collection::vec(0..8_u64, 200)) {
            let sorted: Vec<u64> = (0..200).collect();
            let mut shuffled = sorted.clone();
            shuffled.sort_by_key(|&count| count + shifts[count as usize]);
            // Eight packets of at most 40 bytes may come before one that was sent before them.
            let (clean, disordered) = (through(&sorted, 320), through(&shuffled, 320));
            prop_assert!(clean == disordered);
            prop_assert!(clean.0.is_sorted());
            // Without room, all goes out as it comes, and nothing is kept.
            let (order, waiting) = through(&shuffled, 0);
            prop_assert_eq!(order, shuffled);
            prop_assert!(waiting.packets.is_empty());
        }
    }
}
