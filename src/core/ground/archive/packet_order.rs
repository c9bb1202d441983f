//! The order in which packets of visibilities are sent, from which the content of missing ones is estimated.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use super::gap_report::{GapReport, LostStream, Stream, VisibilityPacket};
use super::journal::SendingKey;
use crate::downlink::PacketKind;

/// Time between windows, s, longer than any gap between packets within a window.
const WINDOW_GAP_S: f64 = 600.0;

/// Number of packets of the same channel and pair on either side, from which the fraction of a packet in the map is estimated.
const NEAR_PACKETS: usize = 4;

/// Number of complete windows on either side of a gap that are tried as models of its content.
const NEAR_WINDOWS: usize = 2;

/// Fraction of the weight of packets that is in the map, from the packets for which it is known.
fn mapped_fraction(packets: &[VisibilityPacket]) -> Option<f64> {
    let known = packets.iter().filter_map(|packet| Some((packet.entry.weight, packet.share?)));
    let (all, taken) =
        known.fold((0.0, 0.0), |(all, taken), (weight, share)| (all + weight, taken + share * weight));
    (all > 0.0).then(|| taken / all)
}

/// Packets by channel and pair, in the order of sending.
pub(super) struct PacketStreams(BTreeMap<Stream, Vec<VisibilityPacket>>);

impl PacketStreams {
    pub(super) fn new(packets: impl Iterator<Item = VisibilityPacket>) -> Self {
        let mut streams: BTreeMap<Stream, Vec<VisibilityPacket>> = BTreeMap::new();
        for packet in packets {
            streams.entry(packet.stream()).or_default().push(packet);
        }
        streams.values_mut().for_each(|packets| packets.sort_by_key(|packet| packet.entry.sent()));
        Self(streams)
    }

    /// Estimates the fraction of a packet that is in the map; 1 if it is unknown.
    ///
    /// It uses packets of the same channel and pair sent shortly before and after, as the formation breathes.
    pub(super) fn share(&self, stream: Stream, place: SendingKey) -> f64 {
        if stream.1.i == stream.1.j {
            // Auto-correlations are not mapped.
            return 0.0;
        }
        let all = self.0.get(&stream).map_or(&[][..], Vec::as_slice);
        let at = all.partition_point(|packet| packet.entry.sent() < place);
        let near = &all[at.saturating_sub(NEAR_PACKETS)..all.len().min(at + NEAR_PACKETS)];
        mapped_fraction(near).or_else(|| mapped_fraction(all)).unwrap_or(1.0)
    }
}

/// The packets of a window: channel by channel and pair by pair, each in as many packets as needed.
struct SentWindow {
    /// Range of the packets in `SendingOrder::packets`.
    range: Range<usize>,
    is_complete: bool,
}

/// The order of packets in an era, as received.
pub(super) struct SendingOrder {
    packets: Vec<VisibilityPacket>,
    windows: Vec<SentWindow>,
    streams: PacketStreams,
}

/// A model of the content of a gap by the packets of a window.
struct GapModel {
    /// Number of times that each packet of the window is repeated.
    repeats: Vec<u64>,
    /// Difference between the number of packets in the gap and in the model.
    misfit: u64,
}

impl SendingOrder {
    pub(super) fn new(mut packets: Vec<VisibilityPacket>) -> Self {
        packets.sort_by_key(|packet| packet.entry.count);
        let streams = PacketStreams::new(packets.iter().copied());
        let count = |at: usize| packets[at].entry.count;
        let is_complete = |range: &Range<usize>| {
            let (first, last) = (range.start, range.end - 1);
            let has_begin = if first == 0 { count(0) == 0 } else { count(first - 1) + 1 == count(first) };
            // More packets of the last window may come.
            let has_end = range.end < packets.len() && count(last) + 1 == count(range.end);
            has_begin && has_end && count(last) - count(first) == (last - first) as u64
        };
        let windows: Vec<SentWindow> = sent_windows(&packets)
            .into_iter()
            .map(|range| SentWindow { is_complete: is_complete(&range), range })
            .collect();
        Self { packets, windows, streams }
    }

    pub(super) fn report(&self, kind: PacketKind, gap: &Range<u64>) -> GapReport {
        let next = self.packets.partition_point(|packet| packet.entry.count < gap.start);
        let before = next.checked_sub(1).map(|at| &self.packets[at].entry);
        let after = self.packets.get(next).map(|packet| &packet.entry);
        let between_s = [before.map(|entry| entry.end.seconds()), after.map(|entry| entry.start.seconds())];
        GapReport::new(kind, gap, between_s, self.lost(gap, next))
    }

    /// Estimates the content of a gap before the packet `next` from the nearby windows that fit its number of packets best.
    ///
    /// The nearest of them on either side are averaged if they have the same number of packets of each channel and pair.
    fn lost(&self, gap: &Range<u64>, next: usize) -> Vec<LostStream> {
        let mut near: Vec<(&SentWindow, GapModel)> = self
            .windows_near(next)
            .into_iter()
            .map(|window| (window, self.gap_model(window, gap, next)))
            .collect();
        let Some(best) = near.iter().map(|(_, model)| model.misfit).min() else { return Vec::new() };
        near.retain(|(_, model)| model.misfit == best);
        let distance = |window: &SentWindow| match window.range.end <= next {
            true => next - window.range.end,
            false => window.range.start.saturating_sub(next),
        };
        near.sort_by_key(|(window, _)| distance(window));
        let mut sums = near.iter().map(|(window, model)| self.modelled_streams(window, &model.repeats));
        let Some(mut lost) = sums.next() else { return Vec::new() };
        let is_before = |window: &SentWindow| window.range.end <= next;
        let other = (near.iter().position(|(window, _)| is_before(window) != is_before(near[0].0)))
            .and_then(|at| sums.nth(at - 1))
            .filter(|other| {
                lost.len() == other.len()
                    && lost.iter().all(|(stream, lost)| {
                        other.get(stream).is_some_and(|other| other.packets == lost.packets)
                    })
            });
        for (stream, other) in other.into_iter().flatten() {
            if let Some(lost) = lost.get_mut(&stream) {
                lost.integration_s = 0.5 * (lost.integration_s + other.integration_s);
                lost.weight = 0.5 * (lost.weight + other.weight);
            }
        }
        lost.into_values().collect()
    }

    /// Complete windows near a packet; incomplete ones if there are none.
    fn windows_near(&self, next: usize) -> Vec<&SentWindow> {
        let at = self.windows.partition_point(|window| window.range.start < next);
        let (before, after) = self.windows.split_at(at);
        let near = |is_usable: fn(&&SentWindow) -> bool| -> Vec<&SentWindow> {
            let before = before.iter().rev().filter(is_usable).take(NEAR_WINDOWS);
            before.chain(after.iter().filter(is_usable).take(NEAR_WINDOWS)).collect()
        };
        let complete = near(|window| window.is_complete);
        if complete.is_empty() { near(|_| true) } else { complete }
    }

    /// Models a gap by the packets of a window: the rest of the window of the packet before the gap, complete windows, and the
    /// beginning of the window of the packet after it.
    fn gap_model(&self, window: &SentWindow, gap: &Range<u64>, next: usize) -> GapModel {
        let model = &self.packets[window.range.clone()];
        let missing = gap.end - gap.start;
        let (before, after) = (next.checked_sub(1), (next < self.packets.len()).then_some(next));
        let start = before.map_or(model.len(), |at| self.index_after(model, at));
        let end = after.map_or(0, |at| self.index_of(model, at));
        let is_within = before.zip(after).is_some_and(|(before, after)| {
            let window_index = |at: usize| self.windows.partition_point(|window| window.range.end <= at);
            window_index(before) == window_index(after)
        });
        let mut repeats = vec![0; model.len()];
        if is_within {
            // If the two packets are adjacent in the model, the missing packets are of the stream of the first.
            let start = start.min(model.len() - 1);
            let part: Vec<usize> = (start..end.max(start + 1)).collect();
            distribute(missing, &part, &mut repeats);
            return GapModel { repeats, misfit: missing.abs_diff(part.len() as u64) };
        }
        let parts: Vec<usize> = (start..model.len()).chain(0..end).collect();
        let (all, known) = (model.len() as u64, parts.len() as u64);
        if missing < known {
            distribute(missing, &parts, &mut repeats);
            return GapModel { repeats, misfit: known - missing };
        }
        distribute(known, &parts, &mut repeats);
        // Complete windows in one step, as a packet may claim any count.
        let (windows, rest) = ((missing - known) / all, (missing - known) % all);
        repeats.iter_mut().zip(0..).for_each(|(repeats, at)| *repeats += windows + u64::from(at < rest));
        GapModel { repeats, misfit: rest.min(all - rest) }
    }

    /// Index in the model after the packet that corresponds to `packets[at]`.
    fn index_after(&self, model: &[VisibilityPacket], at: usize) -> usize {
        let (packet, window) = (&self.packets[at], self.window_of(at));
        let stream = packet.stream();
        let first = window[..].iter().find(|other| other.stream() == stream).unwrap_or(packet);
        let sent = (packet.entry.count - first.entry.count + 1) as usize;
        let mut of_stream = (0..model.len()).filter(|place| model[*place].stream() == stream);
        match of_stream.clone().next_back() {
            Some(last) => of_stream.nth(sent - 1).unwrap_or(last) + 1,
            None => model.iter().take_while(|other| other.stream() < stream).count(),
        }
    }

    /// Index in the model of the packet that corresponds to `packets[at]`.
    fn index_of(&self, model: &[VisibilityPacket], at: usize) -> usize {
        let (packet, window) = (&self.packets[at], self.window_of(at));
        let stream = packet.stream();
        let last = window.iter().rev().find(|other| other.stream() == stream).unwrap_or(packet);
        let remaining = (last.entry.count - packet.entry.count) as usize;
        let mut of_stream = (0..model.len()).filter(|place| model[*place].stream() == stream);
        match of_stream.next() {
            Some(first) => std::iter::once(first).chain(of_stream).rev().nth(remaining).unwrap_or(first),
            None => model.iter().take_while(|other| other.stream() < stream).count(),
        }
    }

    fn window_of(&self, at: usize) -> &[VisibilityPacket] {
        let window = self.windows.partition_point(|window| window.range.end <= at);
        self.windows.get(window).map_or(&[], |window| &self.packets[window.range.clone()])
    }

    /// Sums the contents of the packets of a window, each repeated a number of times.
    fn modelled_streams(&self, window: &SentWindow, repeats: &[u64]) -> BTreeMap<Stream, LostStream> {
        let mut lost = BTreeMap::new();
        for (packet, &repeats) in
            self.packets[window.range.clone()].iter().zip(repeats).filter(|(_, repeats)| **repeats > 0)
        {
            let stream = packet.stream();
            let share = packet.share.filter(|_| !packet.is_auto());
            let share = share.unwrap_or_else(|| self.streams.share(stream, packet.entry.sent()));
            let sum = lost.entry(stream).or_insert_with(|| LostStream::empty(stream));
            sum.packets += repeats;
            sum.integration_s += repeats as f64 * packet.entry.integration_s;
            sum.weight += repeats as f64 * packet.entry.weight * share;
        }
        lost
    }
}

/// Distributes a number of packets evenly over places of a window.
fn distribute(packets: u64, places: &[usize], repeats: &mut [u64]) {
    let until = |part: usize| (u128::from(packets) * part as u128 / places.len() as u128) as u64;
    for (part, &place) in places.iter().enumerate() {
        repeats[place] += until(part + 1) - until(part);
    }
}

/// Divides packets, sorted by count, into windows. A window ends where the next packet is of another time, or of a channel and
/// pair that were already sent.
fn sent_windows(packets: &[VisibilityPacket]) -> Vec<Range<usize>> {
    let mut in_time: Vec<(usize, &VisibilityPacket)> = packets.iter().enumerate().collect();
    in_time.sort_by_key(|(_, packet)| packet.entry.start);
    let of_time: Vec<&VisibilityPacket> = in_time.iter().map(|(_, packet)| *packet).collect();
    let mut window_of = vec![0; packets.len()];
    for (number, window) in windows_of(&of_time).into_iter().enumerate() {
        in_time[window].iter().for_each(|(at, _)| window_of[*at] = number);
    }
    let mut windows: Vec<Range<usize>> = Vec::new();
    let mut already_sent = BTreeSet::new();
    for (at, packet) in packets.iter().enumerate() {
        let before = at.checked_sub(1).filter(|before| window_of[*before] == window_of[at]);
        let continues = before.is_some_and(|before| packets[before].stream() == packet.stream());
        match windows.last_mut() {
            Some(window) if continues || (before.is_some() && !already_sent.contains(&packet.stream())) => {
                window.end = at + 1;
            }
            _ => {
                already_sent.clear();
                windows.push(at..at + 1);
            }
        }
        already_sent.insert(packet.stream());
    }
    windows
}

/// Divides packets, sorted by time, into observing windows.
pub(super) fn windows_of(packets: &[&VisibilityPacket]) -> Vec<Range<usize>> {
    let mut windows: Vec<Range<usize>> = Vec::new();
    let mut until = f64::NEG_INFINITY;
    for (at, packet) in packets.iter().enumerate() {
        match windows.last_mut() {
            Some(window) if packet.entry.start.seconds() <= until + WINDOW_GAP_S => window.end = at + 1,
            _ => windows.push(at..at + 1),
        }
        until = until.max(packet.entry.end.seconds());
    }
    windows
}
