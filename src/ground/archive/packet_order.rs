//! The order in which packets of visibilities are sent, and what they usually hold.

use std::collections::BTreeMap;
use std::ops::Range;

use super::entry::JournalEntry;
use super::gap_report::{GapReport, LostStream, Stream, VisibilityPacket};
use super::journal::Sent;
use crate::downlink::{CucTime, Kind};

/// Passes on either side of a gap from which the number of packets a pass is estimated.
const PASSES: usize = 2;

/// Means over packets of a channel and pair.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PacketMeans {
    integration_s: f64,
    weight: f64,
    /// Share of the weight that is in the map, if it is known.
    share: Option<f64>,
}

impl PacketMeans {
    fn of(readings: &[VisibilityPacket]) -> Self {
        let packets = readings.len().max(1) as f64;
        let mean = |of: &dyn Fn(&VisibilityPacket) -> f64| readings.iter().map(of).sum::<f64>() / packets;
        let weight = mean(&|reading| reading.entry.weight);
        let known = mean(&|reading| reading.share.map_or(0.0, |_| reading.entry.weight));
        let taken = mean(&|reading| reading.share.unwrap_or(0.0) * reading.entry.weight);
        let share = (known > 0.0).then(|| taken / known);
        Self { integration_s: mean(&|reading| reading.entry.integration_s), weight, share }
    }

    /// Share of the weight that is in the map; 1 if it is not known.
    pub(super) fn share(&self) -> f64 {
        self.share.unwrap_or(1.0)
    }
}

/// Packets by channel and pair, in the order of sending.
pub(super) struct PacketStreams(BTreeMap<Stream, Vec<VisibilityPacket>>);

impl PacketStreams {
    pub(super) fn of(readings: impl Iterator<Item = VisibilityPacket>) -> Self {
        let mut streams: BTreeMap<Stream, Vec<VisibilityPacket>> = BTreeMap::new();
        for reading in readings {
            streams.entry(reading.stream()).or_default().push(reading);
        }
        streams.values_mut().for_each(|readings| readings.sort_by_key(|reading| reading.entry.sent()));
        Self(streams)
    }

    /// Means over `packets` packets on either side of a place in the order of sending: the formation breathes, so farther
    /// ones are less alike.
    pub(super) fn usual(&self, stream: Stream, place: Sent, packets: u64) -> PacketMeans {
        let all = self.0.get(&stream).map_or(&[][..], Vec::as_slice);
        let at = all.partition_point(|reading| reading.entry.sent() < place);
        let packets = usize::try_from(packets).unwrap_or(usize::MAX);
        let near =
            PacketMeans::of(&all[at.saturating_sub(packets)..all.len().min(at.saturating_add(packets))]);
        let share = match stream.1.i == stream.1.j {
            // Auto-correlations are in no map.
            true => Some(0.0),
            false => near.share.or_else(|| PacketMeans::of(all).share),
        };
        PacketMeans { share, ..near }
    }
}

/// The order of packets in an era, inferred from those received.
pub(super) struct SendingOrder {
    /// By count.
    entries: Vec<JournalEntry>,
    /// In the order of sending within a pass.
    order: Vec<Stream>,
    /// Pass by pass, the count of the first packet of each and the number of packets.
    passes: BTreeMap<Stream, Vec<(u64, u64)>>,
    streams: PacketStreams,
}

impl SendingOrder {
    pub(super) fn learn(readings: Vec<VisibilityPacket>) -> Self {
        let streams = PacketStreams::of(readings.iter().copied());
        let mut entries: Vec<JournalEntry> = readings.into_iter().map(|reading| reading.entry).collect();
        entries.sort_by_key(|entry| entry.count);
        let mut order: Vec<Stream> = Vec::new();
        let mut at = 0;
        let mut passes: BTreeMap<Stream, Vec<(u64, u64)>> = BTreeMap::new();
        let mut before: Option<JournalEntry> = None;
        for entry in &entries {
            let stream = (entry.channel, entry.pair);
            at = match order.iter().position(|known| *known == stream) {
                Some(at) => at,
                None => {
                    let after = (at + 1).min(order.len());
                    order.insert(after, stream);
                    after
                }
            };
            let passes = passes.entry(stream).or_default();
            match passes.last_mut() {
                Some((_, packets)) if before.is_some_and(|before| same_pass(&before, entry)) => *packets += 1,
                _ => passes.push((entry.count, 1)),
            }
            before = Some(*entry);
        }
        Self { order, passes, streams, entries }
    }

    pub(super) fn report(&self, kind: Kind, gap: &Range<u64>) -> GapReport {
        let next = self.entries.partition_point(|entry| entry.count < gap.start);
        let before = next.checked_sub(1).map(|at| &self.entries[at]);
        let after = self.entries.get(next);
        let place = after.map_or((CucTime(u64::MAX), u64::MAX), JournalEntry::sent);
        let mut lost: Vec<LostStream> = self
            .fill(gap, next)
            .into_iter()
            .map(|(stream, packets)| {
                let usual = self.streams.usual(stream, place, self.packets_of(&stream, gap.start));
                let (integration_s, weight) = (usual.integration_s, usual.weight * usual.share());
                LostStream {
                    packets,
                    integration_s: integration_s * packets as f64,
                    weight: weight * packets as f64,
                    ..LostStream::nothing(stream)
                }
            })
            .collect();
        lost.sort_by(|a, b| (a.channel, &a.pair).cmp(&(b.channel, &b.pair)));
        let between_s = [before.map(|entry| entry.end.seconds()), after.map(|entry| entry.start.seconds())];
        GapReport::new(kind, gap, between_s, lost)
    }

    /// Packets of a pass about a count: the median of some, as the gap itself may have cut the nearest.
    fn packets_of(&self, stream: &Stream, count: u64) -> u64 {
        let all = self.passes.get(stream).map_or(&[][..], Vec::as_slice);
        let at = all.partition_point(|(first, _)| *first < count);
        let near = &all[at.saturating_sub(PASSES)..all.len().min(at + PASSES)];
        let mut packets: Vec<u64> = near.iter().map(|(_, packets)| *packets).collect();
        packets.sort_unstable();
        packets.get(packets.len() / 2).copied().unwrap_or(1)
    }

    /// The streams of the packets of a gap before the entry `next`, along the schedule.
    fn fill(&self, gap: &Range<u64>, next: usize) -> BTreeMap<Stream, u64> {
        let (mut filled, missing) = (BTreeMap::new(), gap.end - gap.start);
        let before = next.checked_sub(1).map(|at| self.entries[at]);
        let after = self.entries.get(next);
        let (mut at, mut sent, mut step) = (0, 0, 1);
        let place = |stream: Stream| self.order.iter().position(|known| *known == stream).unwrap_or(0);
        if let Some(before) = before {
            let stream = (before.channel, before.pair);
            if after.is_some_and(|after| same_pass(&before, after)) {
                filled.insert(stream, missing);
                return filled;
            }
            at = place(stream);
            let of_pass = self.entries[..next].iter().rev();
            sent = of_pass.take_while(|entry| (entry.channel, entry.pair) == stream).count() as u64;
        } else if let Some(after) = after {
            // Nothing came before: backwards from what came first.
            let stream = (after.channel, after.pair);
            (at, step) = (place(stream), self.order.len() - 1);
            let of_pass = self.entries[next..].iter();
            sent = of_pass.take_while(|entry| (entry.channel, entry.pair) == stream).count() as u64;
        }
        let usual = |stream: &Stream| self.packets_of(stream, gap.start);
        let pass: u64 = self.order.iter().map(usual).sum();
        let mut left = missing;
        while left > 0 && !self.order.is_empty() {
            let stream = self.order[at];
            let packets = usual(&stream).saturating_sub(sent).min(left);
            if packets > 0 {
                *filled.entry(stream).or_default() += packets;
            }
            left -= packets;
            sent = 0;
            at = (at + step) % self.order.len();
            // Whole passes at once: a packet may claim any count.
            for stream in self.order.iter().filter(|_| left >= pass) {
                *filled.entry(*stream).or_default() += left / pass * usual(stream);
            }
            left %= pass;
        }
        filled
    }
}

/// Whether a packet continues the channel and pair of the one before it, in the same pass.
fn same_pass(before: &JournalEntry, entry: &JournalEntry) -> bool {
    // A pass is over when another channel or pair has been in between: then time has gone back, or far ahead.
    let length_s = (before.end.seconds() - before.start.seconds()).max(1.0);
    let ahead_s = entry.start.seconds() - before.end.seconds();
    let packets = entry.count.abs_diff(before.count) as f64;
    (before.channel, before.pair) == (entry.channel, entry.pair)
        && ahead_s >= -1e-6
        && ahead_s <= 4.0 * length_s * packets
}
