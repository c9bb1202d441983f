//! Going through a file, event by event.

use std::collections::BTreeMap;
use std::path::Path;

use super::{
    ChannelSummary, Contents, DamagedEntry, EphemerisSummary, FaultEntry, GapEntry, GarbageEntry,
    HousekeepingSummary, InstrumentSummary, LISTED_MAX, Listing, PairSummary, Span, VisibilityCounts,
    tai_text,
};
use crate::downlink::receive::{Event, ReceptionCounters};
use crate::downlink::wire::{CucTime, Format, Kind, PacketHeader};
use crate::frames::{
    AntennaResponse, EphemerisSegment, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use crate::units::{ChannelId, MissionTime, Pair, TICKS_PER_SECOND};

/// TAI - UTC since 2017-01-01 (IERS Bulletin C).
const LEAP_S: f64 = 37.0;

/// Rows of the table by pair and channel: all 28 pairs in every channel of the band. A file that says more
/// has its further rows in the sums alone.
const ROWS_MAX: usize = 1 << 17;

/// Visibilities of one pair in one channel.
#[derive(Clone, Copy, Debug, Default)]
struct Row {
    count: u64,
    ticks: u64,
    flagged: u64,
}

impl Row {
    fn add(&mut self, other: Self) {
        self.count += other.count;
        self.ticks += other.ticks;
        self.flagged += other.flagged;
    }

    fn counts(self) -> VisibilityCounts {
        let integration_s = self.ticks as f64 / TICKS_PER_SECOND as f64;
        VisibilityCounts { count: self.count, integration_s, flagged: self.flagged }
    }
}

/// Packets of one kind.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    first: Option<u64>,
    last: Option<u64>,
    time: Option<CucTime>,
}

/// What has been seen of a file so far.
#[derive(Debug, Default)]
pub(crate) struct Survey {
    instrument: Option<Instrument>,
    span: Option<[MissionTime; 2]>,
    rows: BTreeMap<(Pair, ChannelId), Row>,
    by_channel: BTreeMap<ChannelId, Row>,
    total: Row,
    segments: u64,
    nodes: u64,
    covered: Coverage,
    housekeeping: Option<Housekeeping>,
    seen: [Seen; Kind::ALL.len()],
    gaps: Listing<(GapEntry, Option<CucTime>, CucTime)>,
    damaged: Listing<(DamagedEntry, CucTime)>,
    garbage: Listing<GarbageEntry>,
    pub(crate) faults: Listing<FaultEntry>,
}

impl Survey {
    pub(crate) fn see_event(&mut self, event: &Event<'_>) {
        match *event {
            Event::Packet(packet) => self.see_packet(packet.header),
            Event::Gap { offset, header, expected } => {
                let PacketHeader { kind, count: found, time, .. } = header;
                let after = self.seen[kind.index()].time;
                let entry = GapEntry {
                    kind,
                    apid: kind.apid(),
                    from: expected,
                    to: found.saturating_sub(1),
                    count: found.saturating_sub(expected),
                    offset,
                    after_s: None,
                    before_s: None,
                };
                self.gaps.push((entry, after, time));
            }
            Event::Damaged { offset, header, .. } => {
                let PacketHeader { kind, count, time, bytes, .. } = header;
                let apid = kind.apid();
                let entry = DamagedEntry { offset, kind, apid, count, bytes: bytes as u64, time_s: None };
                self.damaged.push((entry, time));
            }
            Event::Garbage { offset, bytes } => self.garbage.push(GarbageEntry { offset, bytes }),
            Event::Duplicate { .. } | Event::Restart { .. } | Event::Truncated { .. } => {}
        }
    }

    fn see_packet(&mut self, header: PacketHeader) {
        let seen = &mut self.seen[header.kind.index()];
        seen.first.get_or_insert(header.count);
        seen.last = seen.last.max(Some(header.count));
        seen.time = seen.time.max(Some(header.time));
    }

    pub(crate) fn see_frame(&mut self, frame: &GroundFrame) {
        match frame {
            GroundFrame::Instrument(instrument) => self.instrument = Some(instrument.clone()),
            GroundFrame::Ephemeris(segment) => self.see_segment(segment),
            GroundFrame::Visibilities(block) => self.see_block(block),
            GroundFrame::Housekeeping(counts) => {
                let newest = self.housekeeping.filter(|known| known.time > counts.time);
                self.housekeeping = newest.or(Some(*counts));
            }
        }
    }

    fn see_segment(&mut self, segment: &EphemerisSegment) {
        self.segments += 1;
        self.nodes += segment.nodes() as u64;
        self.covered.add(segment.start, segment.end());
    }

    fn see_block(&mut self, block: &VisibilityBlock) {
        let (Some(first), Some(last)) = (block.offset_ticks.first(), block.offset_ticks.last()) else {
            return;
        };
        let duration = block.duration_ticks.last().copied().unwrap_or_default();
        let start = block.start.plus_ticks(i64::from(*first));
        let end = block.start.plus_ticks(i64::from(*last) + i64::from(duration));
        let [from, to] = self.span.unwrap_or([start, end]);
        self.span = Some([from.min(start), to.max(end)]);
        let row = Row {
            count: block.len() as u64,
            ticks: block.duration_ticks.iter().map(|ticks| u64::from(*ticks)).sum(),
            flagged: block.flags.iter().map(|flags| u64::from(!flags.is_good())).sum(),
        };
        self.total.add(row);
        self.by_channel.entry(block.channel).or_default().add(row);
        let key = (block.pair, block.channel);
        if self.rows.len() < ROWS_MAX || self.rows.contains_key(&key) {
            self.rows.entry(key).or_default().add(row);
        }
    }

    /// What is in the file, now that all of it has been seen.
    pub(crate) fn conclude(self, path: &Path, bytes: u64, reception: &ReceptionCounters) -> Contents {
        let epoch_tai_s = self.instrument.as_ref().map(|instrument| instrument.epoch_tai_s);
        let mission_s = |time: CucTime| epoch_tai_s.map(|epoch_tai_s| time.tai_s() - epoch_tai_s);
        let place_gap = |(gap, after, before): (GapEntry, Option<CucTime>, CucTime)| GapEntry {
            after_s: after.and_then(mission_s),
            before_s: mission_s(before),
            ..gap
        };
        let place_damaged =
            |(entry, time): (DamagedEntry, CucTime)| DamagedEntry { time_s: mission_s(time), ..entry };
        let packets = Kind::ALL.map(|kind| {
            let (counts, seen) = (reception.kind(kind), self.seen[kind.index()]);
            crate::downlink::receive::contents::KindSummary {
                kind,
                apid: kind.apid(),
                packets: counts.packets,
                bytes: counts.bytes,
                first_count: seen.first,
                last_count: seen.last,
            }
        });
        let pair = |((pair, channel), row): (&(Pair, ChannelId), &Row)| PairSummary {
            pair: pair.to_string(),
            channel: channel.0,
            visibilities: row.counts(),
        };
        Contents {
            file: path.display().to_string(),
            bytes,
            format: if reception.frames.is_some() { Format::Cadu } else { Format::Packets },
            span: self.span.zip(epoch_tai_s).map(|(span, epoch_tai_s)| span_of(span, epoch_tai_s)),
            channels: self.channels(),
            instrument: self.instrument.as_ref().map(instrument_summary),
            packets: packets.into(),
            visibilities: self.total.counts(),
            baselines: self.rows.iter().map(pair).collect(),
            ephemeris: self.covered.summary(self.segments, self.nodes),
            housekeeping: self.housekeeping.map(|counts| HousekeepingSummary {
                time_s: counts.time.seconds(),
                sampled: counts.sampled,
                dropped: counts.dropped,
            }),
            gaps: map_listing(self.gaps, place_gap),
            bad_checksums: map_listing(self.damaged, place_damaged),
            garbage: self.garbage,
            faults: self.faults,
            truncated_bytes: reception.bytes_truncated,
            reception: reception.clone(),
        }
    }

    fn channels(&self) -> Vec<ChannelSummary> {
        let channels = self.instrument.iter().flat_map(|instrument| &instrument.channels);
        let summary = |(k, channel): (usize, &crate::frames::Channel)| {
            let row = self.by_channel.get(&ChannelId(k as u16)).copied().unwrap_or_default();
            ChannelSummary {
                channel: k as u16,
                frequency_hz: channel.frequency_hz,
                width_hz: channel.width_hz,
                visibilities: row.counts(),
            }
        };
        channels.enumerate().map(summary).collect()
    }
}

fn map_listing<A, B>(listing: Listing<A>, map: impl FnMut(A) -> B) -> Listing<B> {
    Listing { count: listing.count, listed: listing.listed.into_iter().map(map).collect() }
}

fn instrument_summary(instrument: &Instrument) -> InstrumentSummary {
    InstrumentSummary {
        name: instrument.name.clone(),
        epoch_tai_s: instrument.epoch_tai_s,
        epoch_tai: tai_text(instrument.epoch_tai_s),
        satellites: instrument.satellites,
        moon_radius_m: instrument.moon_radius_m,
        response: match instrument.response {
            AntennaResponse::Isotropic => "isotropic".to_owned(),
            AntennaResponse::DipoleNormal => "dipole along the orbit normal".to_owned(),
        },
        seed: instrument.seed,
        configuration_hash: format!("{:016x}", instrument.configuration_hash),
        spectrometer: instrument.spectrometer.map(|own| {
            let (low, high) = (own.low_hz, own.low_hz + own.width_hz * f64::from(own.channels));
            format!("{:.3} to {:.3} MHz in {} channels", low / 1e6, high / 1e6, own.channels)
        }),
    }
}

fn span_of([start, end]: [MissionTime; 2], epoch_tai_s: f64) -> Span {
    let (start_s, end_s) = (start.seconds(), end.seconds());
    let tai = |time_s| tai_text(epoch_tai_s + time_s);
    Span {
        start_s,
        end_s,
        start_tai: tai(start_s),
        end_tai: tai(end_s),
        start_utc: tai(start_s - LEAP_S),
        end_utc: tai(end_s - LEAP_S),
    }
}

/// Stretches of time, those that touch made one.
#[derive(Debug, Default)]
struct Coverage {
    /// End of each stretch by its start; apart, at most [`STRETCHES_MAX`].
    stretches: BTreeMap<MissionTime, MissionTime>,
}

/// Stretches that are kept apart: as many windows as three precessions have. Beyond them the nearest to
/// the new one is stretched over the hole.
const STRETCHES_MAX: usize = 1 << 14;

impl Coverage {
    fn add(&mut self, start: MissionTime, end: MissionTime) {
        let (mut from, mut to) = (start, end);
        // Those that begin within it or touch its end, and the one before it if that one reaches it.
        while let Some((&other_from, &other_to)) =
            self.stretches.range(..=to.plus_ticks(1)).next_back().filter(|(_, end)| end.plus_ticks(1) >= from)
        {
            self.stretches.remove(&other_from);
            (from, to) = (from.min(other_from), to.max(other_to));
        }
        if self.stretches.len() >= STRETCHES_MAX {
            if let Some((&other_from, _)) = self.stretches.range(..from).next_back() {
                self.stretches.insert(other_from, to);
            }
            return;
        }
        self.stretches.insert(from, to);
    }

    fn summary(&self, segments: u64, nodes: u64) -> EphemerisSummary {
        let each = || self.stretches.iter().map(|(start, end)| [start.seconds(), end.seconds()]);
        EphemerisSummary {
            segments,
            nodes,
            // An empty sum of f64 is -0.
            covered_s: each().fold(0.0, |sum, [start_s, end_s]| sum + (end_s - start_s)),
            covered: Listing {
                count: self.stretches.len() as u64,
                listed: each().take(LISTED_MAX).collect(),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stretches_that_touch_are_one() {
        let mut coverage = Coverage::default();
        for (start, end) in [(0, 10), (20, 30), (50, 60), (11, 15), (18, 20), (55, 57), (29, 52)] {
            coverage.add(MissionTime(start), MissionTime(end));
        }
        let stretches: Vec<_> = coverage.stretches.iter().map(|(a, b)| (a.0, b.0)).collect();
        assert_eq!(stretches, [(0, 15), (18, 60)]);
    }
}
