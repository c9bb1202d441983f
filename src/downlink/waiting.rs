//! Packets that wait for those that were sent before them.

use std::collections::BTreeMap;

use bincode::{Decode, Encode};

use super::cuc::CucTime;
use super::header::{COUNT_MAX, PACKET_BYTES_MAX, PacketHeader, Segment};
use super::kind::Kind;
use super::payload::visibilities_span;
use super::receiver::{Event, Packet};
use super::taken::Taken;
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

/// Puts visibilities in the order in which they were sent, and payloads together, within bounds.
///
/// A packet of visibilities goes on at once if all of its kind that were sent before it have come and its positions
/// are known; if not, it waits, and those behind it. When more bytes wait than may, the first goes on as it is, with
/// those that follow it without a gap; one that comes later still goes on as it comes. Other packets wait for
/// the rest of their payload alone.
///
/// As long as none comes later than that, what waits and what has gone is a function of the set of packets that have
/// come, not of their order.
#[derive(Clone, Debug, Default, PartialEq, Encode, Decode)]
pub struct Waiting {
    visibilities: BTreeMap<Sent, WaitingPacket>,
    /// A state that was read may lie about it, so it never wraps.
    bytes: u64,
    others: BTreeMap<(Kind, Sent), WaitingPacket>,
    others_bytes: u64,
    bytes_max: u64,
    /// The latest visibilities that have gone.
    gone: Option<Sent>,
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
            && self.gone.is_none_or(|(_, count)| count <= COUNT_MAX)
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

    /// Order of the latest visibilities that have gone; those before it do not wait for others any more.
    pub(super) fn set_gone(&mut self, gone: Option<Sent>) {
        self.gone = gone;
    }

    /// As if all had gone that went in another.
    pub(super) fn absorb_gone(&mut self, other: &Self) {
        self.gone = self.gone.max(other.gone);
    }

    /// The next visibilities that need not wait, given all that have come and whether the positions are known over a
    /// stretch of time.
    pub fn next_visibilities(
        &mut self,
        taken: &Taken,
        placed: &dyn Fn([MissionTime; 2]) -> bool,
    ) -> Option<WaitingPacket> {
        let (&sent, packet) = self.visibilities.first_key_value()?;
        let (time, count) = sent;
        let is_late = self.gone.is_some_and(|gone| sent < gone);
        let from =
            self.gone.filter(|(gone, _)| taken.are_of_one_era(*gone, time)).map_or(0, |(_, gone)| gone + 1);
        let is_due = is_late
            || self.bytes > self.bytes_max
            || taken.is_whole(from, count, time) && packet.span().is_none_or(placed);
        if is_due { self.first_visibilities() } else { None }
    }

    /// The first visibilities, due or not.
    pub fn first_visibilities(&mut self) -> Option<WaitingPacket> {
        let (sent, packet) = self.visibilities.pop_first()?;
        self.bytes = self.bytes.saturating_sub(packet.cost());
        self.gone = self.gone.max(Some(sent));
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
        while !matches!(last.0, Segment::Last | Segment::Whole) {
            let next = at(last.1 + 1)?;
            if !matches!(next.segment, Segment::Continuation | Segment::Last)
                || next.count - count > SEGMENTS_MAX as u64
            {
                return None;
            }
            last = (next.segment, next.count);
        }
        let mut first = (segment, count);
        while !matches!(first.0, Segment::First | Segment::Whole) {
            let before = at(first.1.checked_sub(1)?)?;
            if !matches!(before.segment, Segment::Continuation | Segment::First)
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
    use proptest::prelude::*;

    use super::*;
    use crate::downlink::FORMAT_VERSION;

    const BYTES: u64 = 30;

    fn packet(count: u64) -> WaitingPacket {
        let header = PacketHeader {
            kind: Kind::Visibilities,
            segment: Segment::Whole,
            count,
            time: CucTime(count / 3),
            version: FORMAT_VERSION,
            bytes: BYTES as usize,
        };
        WaitingPacket { header, payload: Vec::new(), check: 0 }
    }

    fn through(counts: &[u64], packets_max: u64) -> (Vec<u64>, Waiting) {
        let mut waiting = Waiting::new(packets_max * (BYTES + KEEPING_BYTES));
        let (mut order, mut taken) = (Vec::new(), Taken::default());
        for &count in counts {
            let packet = packet(count);
            assert!(taken.take(count, packet.header.time));
            waiting.put(packet);
            let due = std::iter::from_fn(|| waiting.next_visibilities(&taken, &|_| true));
            order.extend(due.map(|packet| packet.header.count));
        }
        (order, waiting)
    }

    /// Found by fuzzing: a state that says that less waits than does.
    #[test]
    fn what_waits_may_be_more_than_a_forged_state_says() {
        let mut forged = Waiting::new(0);
        forged.put(packet(5));
        forged.put(packet(7));
        assert!(forged.is_sound());
        for (bytes, others_bytes, gone) in
            [(1, 0, None), (2 * (BYTES + KEEPING_BYTES), 1, None), (316, 0, Some((CucTime(0), u64::MAX)))]
        {
            assert!(!Waiting { bytes, others_bytes, gone, ..forged.clone() }.is_sound());
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

    proptest! {
        #[test]
        fn disorder_within_the_limit_leaves_no_trace(
            shifts in proptest::collection::vec(0..8_u64, 200),
            lost in proptest::collection::btree_set(0..200_u64, 0..9),
        ) {
            let sorted: Vec<u64> = (0..200).filter(|count| !lost.contains(count)).collect();
            let mut shuffled = sorted.clone();
            shuffled.sort_by_key(|&count| count + shifts[count as usize]);
            // Eight packets may come before one that was sent before them.
            let (clean, disordered) = (through(&sorted, 8), through(&shuffled, 8));
            prop_assert!(clean == disordered);
            prop_assert!(clean.0.is_sorted());
            // Only gaps make packets wait: all but those that follow a gap by less than the limit have gone.
            let gone = clean.0.len();
            prop_assert!(gone + 8 >= sorted.len());
            let waits_for_nothing = lost.range(..*sorted.last().unwrap()).next().is_none();
            prop_assert!(!waits_for_nothing || gone == sorted.len());
            // Without room, all goes out as it comes, and nothing is kept.
            let (order, waiting) = through(&shuffled, 0);
            prop_assert_eq!(order, shuffled);
            prop_assert!(waiting.visibilities.is_empty() && waiting.bytes == 0);
        }
    }

    #[test]
    fn visibilities_wait_for_their_positions() {
        let mut waiting = Waiting::new(1 << 20);
        let mut taken = Taken::default();
        for count in 0..3 {
            let mut packet = packet(count);
            // Record and arrays of one visibility: channel, pair, start, count; offset, duration, value, weight, flags.
            packet.payload = [0, 0, 0, 1].to_vec();
            packet.payload.extend((1000 * count as i64).to_le_bytes());
            packet.payload.extend(1_u32.to_le_bytes());
            packet.payload.extend([5_u32, 10].map(u32::to_le_bytes).concat());
            packet.payload.resize(16 + 21, 0);
            taken.take(count, packet.header.time);
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
        assert!(waiting.next_visibilities(&taken, &until(0)).is_none());
        assert_eq!(
            waiting.next_visibilities(&taken, &until(1000)).map(|packet| packet.header.count),
            Some(0)
        );
        assert!(waiting.next_visibilities(&taken, &until(1000)).is_none());
        assert_eq!(*seen.borrow(), [(5, 15), (5, 15), (1005, 1015)]);
    }

    #[test]
    fn payloads_are_put_together_whatever_the_order() {
        let segment = |count: u64, segment: Segment| {
            let header =
                PacketHeader { kind: Kind::Ephemeris, segment, time: CucTime(7), ..packet(count).header };
            WaitingPacket { header, payload: vec![count as u8], check: 0 }
        };
        let all = [
            segment(3, Segment::First),
            segment(4, Segment::Continuation),
            segment(5, Segment::Last),
            segment(6, Segment::Whole),
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
