//! Time line of the packets received and missing, by creation time.

use std::collections::VecDeque;
use std::ops::Range;

use serde::Serialize;

use crate::downlink::{CucTime, PacketKind, ReceivedSet};

const BINS_MAX: usize = 480;

/// Minimum width of a bin, s. Wider bins are this times a power of two; a window spans three of the narrowest.
const BIN_S_MIN: f64 = 900.0;

const RANGES_MAX: usize = 1000;

/// Packets of one kind by bin.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KindLine {
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Application process identifier.
    pub apid: u16,
    /// Packets received, held ones included.
    pub received: Vec<u64>,
    /// Packets missing between received ones. A gap that spans several bins is spread evenly, as its times are unknown.
    pub missing: Vec<u64>,
}

/// A range of missing packets with consecutive counts, to be requested again.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MissingRange {
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Application process identifier.
    pub apid: u16,
    /// Count of the first packet.
    pub from: u64,
    /// Count of the last packet.
    pub to: u64,
    /// Creation times, mission time in s, of the packets received before and after the range.
    pub between_s: [f64; 2],
}

/// Received and missing packets over mission time, in a bounded number of bins.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PassLine {
    /// Mission epoch: TAI seconds since 1958-01-01.
    pub epoch_tai_s: f64,
    /// Mission time at which the first bin begins, s.
    pub start_s: f64,
    /// Width of a bin, s.
    pub bin_s: f64,
    /// Received and missing packets of each kind received.
    pub kinds: Vec<KindLine>,
    /// Ranges of missing packets, latest first, at most a thousand.
    pub ranges: Vec<MissingRange>,
    /// Number of ranges that are not listed.
    pub ranges_left_out: u64,
}

impl PassLine {
    /// The time line of the received sets of each kind.
    #[must_use]
    pub fn new<'a>(epoch_tai_s: f64, received: impl Iterator<Item = (PacketKind, &'a ReceivedSet)>) -> Self {
        let time_s = |made: CucTime| made.tai_s() - epoch_tai_s;
        let sets: Vec<(PacketKind, &ReceivedSet)> = received.filter(|(_, set)| !set.is_empty()).collect();
        let ends = sets.iter().filter_map(|(_, set)| set.span());
        let Some(span) = ends.reduce(|[a, b], [c, d]| [a.min(c), b.max(d)]) else { return Self::default() };
        let [first_s, last_s] = span.map(time_s);
        let mut bin_s = BIN_S_MIN;
        let start_of = |bin_s: f64| (first_s / bin_s).floor() * bin_s;
        while last_s >= start_of(bin_s) + BINS_MAX as f64 * bin_s {
            bin_s *= 2.0;
        }
        let start_s = start_of(bin_s);
        let bin = |time_s: f64| (((time_s - start_s) / bin_s) as usize).min(BINS_MAX - 1);
        let bins = bin(last_s) + 1;
        let mut line = Self { epoch_tai_s, start_s, bin_s, ..Self::default() };
        for (kind, set) in sets {
            let apid = kind.apid();
            let mut kind_line = KindLine { kind, apid, received: vec![0; bins], missing: vec![0; bins] };
            let mut latest = VecDeque::new();
            let mut before: Option<(f64, u64)> = None;
            for (made, Range { start, end }) in set.intervals() {
                let time_s = time_s(made);
                kind_line.received[bin(time_s)] += end - start;
                // A lower count with a later creation time begins a new era, at 0.
                let (since_s, due) = before.filter(|(_, due)| *due <= start).unwrap_or((time_s, 0));
                if due < start {
                    distribute(&mut kind_line.missing[bin(since_s)..=bin(time_s)], start - due);
                    let between_s = [since_s, time_s];
                    latest.push_back(MissingRange { kind, apid, from: due, to: start - 1, between_s });
                    // Ranges come in the order of time.
                    if latest.len() > RANGES_MAX {
                        latest.pop_front();
                        line.ranges_left_out += 1;
                    }
                }
                before = Some((time_s, end));
            }
            line.kinds.push(kind_line);
            line.ranges.extend(latest);
        }
        line.keep_latest();
        line
    }

    fn keep_latest(&mut self) {
        self.ranges.sort_by(|a, b| b.between_s[1].total_cmp(&a.between_s[1]));
        self.ranges_left_out += self.ranges.len().saturating_sub(RANGES_MAX) as u64;
        self.ranges.truncate(RANGES_MAX);
    }
}

fn distribute(bins: &mut [u64], count: u64) {
    // The common case.
    if let [bin] = bins {
        *bin = bin.saturating_add(count);
        return;
    }
    let parts = bins.len() as u128;
    let until = |k: usize| (u128::from(count) * k as u128 / parts) as u64;
    for (k, bin) in bins.iter_mut().enumerate() {
        *bin = bin.saturating_add(until(k + 1) - until(k));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EPOCH_S: f64 = 2e9;

    fn made(time_s: f64) -> CucTime {
        CucTime(((EPOCH_S + time_s) * f64::from(1 << 24)) as u64)
    }

    fn line_of(sets: &[(PacketKind, ReceivedSet)]) -> PassLine {
        PassLine::new(EPOCH_S, sets.iter().map(|(kind, set)| (*kind, set)))
    }

    /// Ten packets per pass with the same creation time, without lost ones.
    fn passes(count: u64, apart_s: f64, is_lost: impl Fn(u64) -> bool) -> ReceivedSet {
        let mut set = ReceivedSet::default();
        for packet in (0..10 * count).filter(|packet| !is_lost(*packet)) {
            set.insert(packet, made(apart_s * (packet / 10) as f64));
        }
        set
    }

    #[test]
    fn packets_lie_where_they_were_made_and_their_sums_are_those_of_the_set() {
        // Within pass 1; all of pass 3; the end of pass 5 and the beginning of pass 6.
        let is_lost = |packet| matches!(packet, 12..15 | 30..40 | 58..61);
        let set = passes(8, 9000.0, is_lost);
        let line = line_of(&[
            (PacketKind::Visibilities, set.clone()),
            (PacketKind::Calibration, ReceivedSet::default()),
        ]);
        assert_eq!((line.start_s, line.bin_s, line.kinds.len()), (0.0, 900.0, 1));
        let KindLine { received, missing, .. } = &line.kinds[0];
        assert_eq!((received.len(), missing.len()), (71, 71));
        let expected: Vec<u64> =
            (0..8).map(|pass| (10 * pass..10 * pass + 10).filter(|p| !is_lost(*p)).count() as u64).collect();
        let found: Vec<u64> = (0..8).map(|pass| received[10 * pass]).collect();
        assert_eq!(found, expected);
        assert_eq!(received.iter().sum::<u64>(), set.len());
        let lost: u64 = set.eras().iter().flat_map(|era| &era.missing).map(|gap| gap.end - gap.start).sum();
        assert_eq!((missing.iter().sum::<u64>(), lost), (16, 16));
        assert_eq!(missing[10], 3);
        // Between passes 2 and 4, and between 5 and 6.
        assert_eq!(missing[20..=40].iter().sum::<u64>(), 10);
        assert_eq!(missing[50..=60].iter().sum::<u64>(), 3);
        let ranges: Vec<_> =
            line.ranges.iter().map(|range| (range.from, range.to, range.between_s)).collect();
        let expected =
            [(58, 60, [45_000.0, 54_000.0]), (30, 39, [18_000.0, 36_000.0]), (12, 14, [9000.0, 9000.0])];
        assert_eq!((ranges.as_slice(), line.ranges_left_out), (expected.as_slice(), 0));
    }

    #[test]
    fn a_restart_of_the_counts_begins_at_nothing() {
        let mut set = passes(2, 9000.0, |packet| packet == 0);
        set.insert(2, made(30_000.0));
        let line = line_of(&[(PacketKind::Visibilities, set)]);
        let ranges: Vec<_> =
            line.ranges.iter().map(|range| (range.from, range.to, range.between_s)).collect();
        assert_eq!(ranges, [(0, 1, [30_000.0, 30_000.0]), (0, 0, [0.0, 0.0])]);
    }

    #[test]
    fn years_and_forged_packets_need_no_more_than_the_bins() {
        // Every second packet of 1.3 years of orbits is lost.
        let set = passes(5000, 8249.0, |packet| packet % 2 == 1);
        let line = line_of(&[(PacketKind::Visibilities, set.clone())]);
        let KindLine { received, missing, .. } = &line.kinds[0];
        assert!(received.len() <= BINS_MAX && received.len() > BINS_MAX / 3, "{}", received.len());
        assert_eq!(received.iter().sum::<u64>(), set.len());
        // Whether the last packet was lost is unknown.
        assert_eq!(missing.iter().sum::<u64>(), set.len() - 1);
        assert_eq!(line.ranges.len() as u64 + line.ranges_left_out, set.len() - 1);
        let mut forged = ReceivedSet::default();
        for (count, time) in [(0, 0), ((1 << 46) - 1, (1 << 56) - 1), (5, (1 << 56) - 1)] {
            forged.insert(count, CucTime(time));
        }
        let line = line_of(&[(PacketKind::Housekeeping, forged)]);
        assert!(line.kinds[0].received.len() <= BINS_MAX);
        assert_eq!(line.kinds[0].missing.iter().sum::<u64>(), (1 << 46) - 3);
        assert_eq!(line_of(&[]), PassLine::default());
    }

    #[test]
    fn equal_parts_add_up() {
        for (count, parts) in [(0, 3), (5, 1), (1, 5), (7, 3), (u64::MAX, 7)] {
            let mut bins = vec![0; parts];
            distribute(&mut bins, count);
            assert_eq!(bins.iter().sum::<u64>(), count);
            let [least, most] = [bins.iter().min().unwrap(), bins.iter().max().unwrap()];
            assert!(most - least <= 1, "{bins:?}");
        }
    }
}
