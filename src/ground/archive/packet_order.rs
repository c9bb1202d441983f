//! The order in which packets of visibilities are sent, and what they usually hold.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use super::gap_report::{GapReport, LostStream, Stream, VisibilityPacket};
use super::journal::Sent;
use crate::downlink::PacketKind;

/// Windows are further apart than this, s, and packets of a window are not.
const APART_S: f64 = 600.0;

/// Packets of the same channel and pair on either side of one from which its share in the map is estimated.
const NEAR: usize = 4;

/// Whole windows on either side of a gap that are tried as what it held.
const NEAR_WINDOWS: usize = 2;

/// Share of the weight of some packets that is in the map, of those of which it is known.
fn share_of(readings: &[VisibilityPacket]) -> Option<f64> {
    let known = readings.iter().filter_map(|reading| Some((reading.entry.weight, reading.share?)));
    let (all, taken) =
        known.fold((0.0, 0.0), |(all, taken), (weight, share)| (all + weight, taken + share * weight));
    (all > 0.0).then(|| taken / all)
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

    /// The share of a packet that is in the map: of packets of the same channel and pair near it in the order of sending, as
    /// the formation breathes; 1 if it is not known.
    pub(super) fn share(&self, stream: Stream, place: Sent) -> f64 {
        if stream.1.i == stream.1.j {
            // Auto-correlations are in no map.
            return 0.0;
        }
        let all = self.0.get(&stream).map_or(&[][..], Vec::as_slice);
        let at = all.partition_point(|reading| reading.entry.sent() < place);
        let near = &all[at.saturating_sub(NEAR)..all.len().min(at + NEAR)];
        share_of(near).or_else(|| share_of(all)).unwrap_or(1.0)
    }
}

/// What is sent of a window: channel after channel and pair after pair, each in as many packets as it takes.
struct SentWindow {
    /// Its packets, in `SendingOrder::readings`.
    range: Range<usize>,
    /// Whether none of it is missing.
    is_whole: bool,
}

/// The order of packets in an era, as received.
pub(super) struct SendingOrder {
    /// By count.
    readings: Vec<VisibilityPacket>,
    /// In the order of sending.
    windows: Vec<SentWindow>,
    streams: PacketStreams,
}

/// How often a gap holds each packet of a window that is like it, and by how many packets the two differ.
struct Likeness {
    times: Vec<u64>,
    misfit: u64,
}

impl SendingOrder {
    pub(super) fn learn(mut readings: Vec<VisibilityPacket>) -> Self {
        readings.sort_by_key(|reading| reading.entry.count);
        let streams = PacketStreams::of(readings.iter().copied());
        let count = |at: usize| readings[at].entry.count;
        let whole = |range: &Range<usize>| {
            let (first, last) = (range.start, range.end - 1);
            let has_begin = if first == 0 { count(0) == 0 } else { count(first - 1) + 1 == count(first) };
            // More of the last one may come.
            let has_end = range.end < readings.len() && count(last) + 1 == count(range.end);
            has_begin && has_end && count(last) - count(first) == (last - first) as u64
        };
        let windows: Vec<SentWindow> = sent_windows(&readings)
            .into_iter()
            .map(|range| SentWindow { is_whole: whole(&range), range })
            .collect();
        Self { readings, windows, streams }
    }

    pub(super) fn report(&self, kind: PacketKind, gap: &Range<u64>) -> GapReport {
        let next = self.readings.partition_point(|reading| reading.entry.count < gap.start);
        let before = next.checked_sub(1).map(|at| &self.readings[at].entry);
        let after = self.readings.get(next).map(|reading| &reading.entry);
        let between_s = [before.map(|entry| entry.end.seconds()), after.map(|entry| entry.start.seconds())];
        GapReport::new(kind, gap, between_s, self.lost(gap, next))
    }

    /// What a gap before the reading `next` held: what the windows near it hold that fit its number of packets best. The nearest of
    /// them on either side count alike if they have as many packets of each channel and pair.
    fn lost(&self, gap: &Range<u64>, next: usize) -> Vec<LostStream> {
        let mut near: Vec<(&SentWindow, Likeness)> =
            self.near(next).into_iter().map(|window| (window, self.likeness(window, gap, next))).collect();
        let Some(best) = near.iter().map(|(_, likeness)| likeness.misfit).min() else { return Vec::new() };
        near.retain(|(_, likeness)| likeness.misfit == best);
        let distance = |window: &SentWindow| match window.range.end <= next {
            true => next - window.range.end,
            false => window.range.start.saturating_sub(next),
        };
        near.sort_by_key(|(window, _)| distance(window));
        let mut sums = near.iter().map(|(window, likeness)| self.sum(window, &likeness.times));
        let Some(mut lost) = sums.next() else { return Vec::new() };
        let is_before = |window: &SentWindow| window.range.end <= next;
        let other = (near.iter().position(|(window, _)| is_before(window) != is_before(near[0].0)))
            .and_then(|at| sums.nth(at - 1))
            .filter(|other| {
                lost.len() == other.len()
                    && lost
                        .iter()
                        .all(|(stream, lost)| other.get(stream).is_some_and(|it| it.packets == lost.packets))
            });
        for (stream, other) in other.into_iter().flatten() {
            if let Some(lost) = lost.get_mut(&stream) {
                lost.integration_s = 0.5 * (lost.integration_s + other.integration_s);
                lost.weight = 0.5 * (lost.weight + other.weight);
            }
        }
        lost.into_values().collect()
    }

    /// Whole windows near a reading; if there are none, others.
    fn near(&self, next: usize) -> Vec<&SentWindow> {
        let at = self.windows.partition_point(|window| window.range.start < next);
        let (before, after) = self.windows.split_at(at);
        let near = |is_known: fn(&&SentWindow) -> bool| -> Vec<&SentWindow> {
            let before = before.iter().rev().filter(is_known).take(NEAR_WINDOWS);
            before.chain(after.iter().filter(is_known).take(NEAR_WINDOWS)).collect()
        };
        let whole = near(|window| window.is_whole);
        if whole.is_empty() { near(|_| true) } else { whole }
    }

    /// How often a gap holds the packets of a window like those about it: the rest of the window of the packet before it, whole
    /// windows, and the beginning of that of the packet after it.
    fn likeness(&self, window: &SentWindow, gap: &Range<u64>, next: usize) -> Likeness {
        let like = &self.readings[window.range.clone()];
        let missing = gap.end - gap.start;
        let (before, after) = (next.checked_sub(1), (next < self.readings.len()).then_some(next));
        let start = before.map_or(like.len(), |at| self.place_behind(like, at));
        let end = after.map_or(0, |at| self.place_of(like, at));
        let is_within = before.zip(after).is_some_and(|(before, after)| {
            let of = |at: usize| self.windows.partition_point(|window| window.range.end <= at);
            of(before) == of(after)
        });
        let mut times = vec![0; like.len()];
        if is_within {
            // Without room between them in the window that is like theirs, what is missing is of the first one's stream.
            let start = start.min(like.len() - 1);
            let part: Vec<usize> = (start..end.max(start + 1)).collect();
            spread(missing, &part, &mut times);
            return Likeness { times, misfit: missing.abs_diff(part.len() as u64) };
        }
        let parts: Vec<usize> = (start..like.len()).chain(0..end).collect();
        let (all, known) = (like.len() as u64, parts.len() as u64);
        if missing < known {
            spread(missing, &parts, &mut times);
            return Likeness { times, misfit: known - missing };
        }
        spread(known, &parts, &mut times);
        // Whole windows at once: a packet may claim any count.
        let (windows, rest) = ((missing - known) / all, (missing - known) % all);
        times.iter_mut().zip(0..).for_each(|(times, at)| *times += windows + u64::from(at < rest));
        Likeness { times, misfit: rest.min(all - rest) }
    }

    /// The place in a window that is like it behind a reading.
    fn place_behind(&self, like: &[VisibilityPacket], at: usize) -> usize {
        let (reading, window) = (&self.readings[at], self.window_of(at));
        let stream = reading.stream();
        let first = window[..].iter().find(|other| other.stream() == stream).unwrap_or(reading);
        let sent = (reading.entry.count - first.entry.count + 1) as usize;
        let mut of_stream = (0..like.len()).filter(|place| like[*place].stream() == stream);
        match of_stream.clone().next_back() {
            Some(last) => of_stream.nth(sent - 1).unwrap_or(last) + 1,
            None => like.iter().take_while(|other| other.stream() < stream).count(),
        }
    }

    /// The place in a window that is like it of a reading.
    fn place_of(&self, like: &[VisibilityPacket], at: usize) -> usize {
        let (reading, window) = (&self.readings[at], self.window_of(at));
        let stream = reading.stream();
        let last = window.iter().rev().find(|other| other.stream() == stream).unwrap_or(reading);
        let left = (last.entry.count - reading.entry.count) as usize;
        let mut of_stream = (0..like.len()).filter(|place| like[*place].stream() == stream);
        match of_stream.next() {
            Some(first) => std::iter::once(first).chain(of_stream).rev().nth(left).unwrap_or(first),
            None => like.iter().take_while(|other| other.stream() < stream).count(),
        }
    }

    fn window_of(&self, at: usize) -> &[VisibilityPacket] {
        let window = self.windows.partition_point(|window| window.range.end <= at);
        self.windows.get(window).map_or(&[], |window| &self.readings[window.range.clone()])
    }

    /// What packets like those of a window hold, each so many times.
    fn sum(&self, window: &SentWindow, times: &[u64]) -> BTreeMap<Stream, LostStream> {
        let mut lost = BTreeMap::new();
        for (reading, &times) in
            self.readings[window.range.clone()].iter().zip(times).filter(|(_, times)| **times > 0)
        {
            let stream = reading.stream();
            let share = reading.share.filter(|_| !reading.is_auto());
            let share = share.unwrap_or_else(|| self.streams.share(stream, reading.entry.sent()));
            let sum = lost.entry(stream).or_insert_with(|| LostStream::nothing(stream));
            sum.packets += times;
            sum.integration_s += times as f64 * reading.entry.integration_s;
            sum.weight += times as f64 * reading.entry.weight * share;
        }
        lost
    }
}

/// Counts `packets` evenly over some places.
fn spread(packets: u64, places: &[usize], times: &mut [u64]) {
    let until = |part: usize| (u128::from(packets) * part as u128 / places.len() as u128) as u64;
    for (part, &place) in places.iter().enumerate() {
        times[place] += until(part + 1) - until(part);
    }
}

/// The packets of each window, of readings by count. One ends where the next is of another time, or of a channel and pair that have
/// had their turn.
fn sent_windows(readings: &[VisibilityPacket]) -> Vec<Range<usize>> {
    let mut in_time: Vec<(usize, &VisibilityPacket)> = readings.iter().enumerate().collect();
    in_time.sort_by_key(|(_, reading)| reading.entry.start);
    let of_time: Vec<&VisibilityPacket> = in_time.iter().map(|(_, reading)| *reading).collect();
    let mut window_of = vec![0; readings.len()];
    for (number, window) in windows_of(&of_time).into_iter().enumerate() {
        in_time[window].iter().for_each(|(at, _)| window_of[*at] = number);
    }
    let mut windows: Vec<Range<usize>> = Vec::new();
    let mut had_turn = BTreeSet::new();
    for (at, reading) in readings.iter().enumerate() {
        let before = at.checked_sub(1).filter(|before| window_of[*before] == window_of[at]);
        let continues = before.is_some_and(|before| readings[before].stream() == reading.stream());
        match windows.last_mut() {
            Some(window) if continues || (before.is_some() && !had_turn.contains(&reading.stream())) => {
                window.end = at + 1;
            }
            _ => {
                had_turn.clear();
                windows.push(at..at + 1);
            }
        }
        had_turn.insert(reading.stream());
    }
    windows
}

/// Readings in the order of time, by observing window.
pub(super) fn windows_of(waiting: &[&VisibilityPacket]) -> Vec<Range<usize>> {
    let mut windows: Vec<Range<usize>> = Vec::new();
    let mut until = f64::NEG_INFINITY;
    for (at, reading) in waiting.iter().enumerate() {
        match windows.last_mut() {
            Some(window) if reading.entry.start.seconds() <= until + APART_S => window.end = at + 1,
            _ => windows.push(at..at + 1),
        }
        until = until.max(reading.entry.end.seconds());
    }
    windows
}
