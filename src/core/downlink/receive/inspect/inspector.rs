//! Reads a downlink file and summarises its contents.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

use super::any_order::{AnyOrderDecoder, DecodeResult};
use super::contents::{
    ChannelContents, Contents, DamagedEntry, EphemerisSummary, FaultEntry, GapEntry, GarbageEntry,
    HousekeepingSummary, InstrumentSummary, KindSummary, PairSummary, TimeSpan, VisibilityCounts,
};
use super::packet_gaps::{PacketGap, SeenPackets};
use crate::array::{earth_is_hidden_by_date, interpolation_error_m};
use crate::downlink::error::DownlinkError;
use crate::downlink::receive::{DownlinkFile, Event, EventReader, LISTED_MAX, Listing, ReceptionCounters};
use crate::downlink::wire::{CucTime, Format, PacketHeader, PacketKind};
use crate::frames::{
    AntennaResponse, EphemerisSegment, GroundFrame, Housekeeping, Instrument, Spectrometer, VisibilityBlock,
};
use crate::units::calendar::tai_text;
use crate::units::time_scales::utc_text;
use crate::units::{ChannelId, IntervalSet, MissionTime, Pair, TICKS_PER_SECOND};

/// Maximum number of rows of the table by pair and channel: 28 pairs in every channel of the band. Visibilities of further
/// rows count in the sums only.
const ROWS_MAX: usize = 1 << 17;

/// Maximum number of intervals of ephemeris coverage: the observing windows of three precession periods. Beyond it, gaps
/// are bridged.
const COVERED_MAX: usize = 1 << 14;

impl Contents {
    /// Inspects a file.
    ///
    /// # Errors
    /// The file cannot be read, is empty, or holds no packet at all. Damage is reported in the result.
    pub fn read(path: &Path) -> Result<Self, DownlinkError> {
        Self::read_with(path, &mut |_| {})
    }

    /// Inspects a file and calls `visit` with every frame.
    ///
    /// # Errors
    /// The errors of [`Contents::read`].
    #[doc(hidden)]
    pub fn read_with(path: &Path, visit: &mut dyn FnMut(&GroundFrame)) -> Result<Self, DownlinkError> {
        Self::read_from(DownlinkFile::open(path)?, path, visit)
    }

    /// Inspects any source and calls `visit` with every frame; `path` names the source in errors.
    ///
    /// # Errors
    /// The errors of [`Contents::read`].
    #[doc(hidden)]
    pub fn read_from(
        source: impl Read,
        path: &Path,
        visit: &mut dyn FnMut(&GroundFrame),
    ) -> Result<Self, DownlinkError> {
        let mut events = EventReader::new(source, path);
        let mut decoder = AnyOrderDecoder::default();
        let mut inspector = Inspector::default();
        events.for_each(|event| {
            inspector.add_event(event);
            decoder.accept(event, &mut |result| inspector.add_result(result, visit));
            Ok::<(), DownlinkError>(())
        })?;
        decoder.finish(&mut |result| inspector.add_result(result, visit));
        events.require_packets()?;
        let receiver = events.receiver();
        let mut reception = ReceptionCounters { frames: receiver.frames(), ..decoder.counters().clone() };
        for kind in PacketKind::ALL {
            let counts = reception.kind_mut(kind);
            counts.restarts = receiver.restarts(kind);
            let missing = inspector.seen[kind.index()].gaps().map(|gap| gap.to - gap.from + 1);
            (counts.gaps, counts.missing) =
                missing.fold((0, 0_u64), |(n, sum), count| (n + 1, sum.saturating_add(count)));
        }
        Ok(inspector.into_contents(path, receiver.bytes(), &reception))
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    count: u64,
    ticks: u64,
    flagged: u64,
}

impl Tally {
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

/// Lowest and highest count of the packets of one kind.
#[derive(Clone, Copy, Debug, Default)]
struct KindExtent {
    first: Option<u64>,
    last: Option<u64>,
}

#[derive(Debug, Default)]
struct Inspector {
    instrument: Option<Instrument>,
    span: Option<[MissionTime; 2]>,
    rows: BTreeMap<(Pair, ChannelId), Tally>,
    by_channel: BTreeMap<ChannelId, Tally>,
    total: Tally,
    segments: u64,
    nodes: u64,
    /// Number of segments during which the Moon occults the Earth of their dates.
    earth_hidden_by_date: u64,
    interpolation_error_m: Option<f64>,
    /// Checksums of segments by their start, at most [`COVERED_MAX`].
    checksums: BTreeMap<MissionTime, u64>,
    contradictory: u64,
    covered: EphemerisCoverage,
    housekeeping: Option<Housekeeping>,
    extents: [KindExtent; PacketKind::ALL.len()],
    seen: [SeenPackets; PacketKind::ALL.len()],
    damaged: Listing<(DamagedEntry, CucTime)>,
    garbage: Listing<GarbageEntry>,
    faults: Listing<FaultEntry>,
    idle_bytes: u64,
}

impl Inspector {
    fn add_event(&mut self, event: &Event<'_>) {
        match *event {
            Event::Packet(packet) => self.add_packet(packet.header, packet.offset),
            Event::Damaged { offset, header, .. } => {
                let PacketHeader { kind, count, time, bytes, .. } = header;
                let apid = kind.apid();
                let entry = DamagedEntry { offset, kind, apid, count, bytes: bytes as u64, time_s: None };
                self.damaged.push((entry, time));
                self.seen[kind.index()].add(&header, offset);
            }
            Event::Idle { bytes, .. } => self.idle_bytes += bytes,
            Event::Garbage { offset, bytes } => self.garbage.push(GarbageEntry { offset, bytes }),
            // Later packets may close a gap: gaps are found at the end, among all packets.
            Event::Gap { .. } | Event::Duplicate { .. } | Event::Restart { .. } | Event::Truncated { .. } => {
            }
        }
    }

    fn add_result(&mut self, result: DecodeResult, visit: &mut dyn FnMut(&GroundFrame)) {
        match result {
            Ok(frame) => {
                self.add_frame(&frame);
                visit(&frame);
            }
            Err((offset, fault)) => self.faults.push(FaultEntry { offset, reason: fault.to_string() }),
        }
    }

    fn add_packet(&mut self, header: PacketHeader, offset: u64) {
        self.seen[header.kind.index()].add(&header, offset);
        let extent = &mut self.extents[header.kind.index()];
        extent.first = Some(extent.first.map_or(header.count, |first| first.min(header.count)));
        extent.last = extent.last.max(Some(header.count));
    }

    fn add_frame(&mut self, frame: &GroundFrame) {
        match frame {
            GroundFrame::Instrument(instrument) => self.instrument = Some(instrument.clone()),
            GroundFrame::Ephemeris(segment) => self.add_segment(segment),
            GroundFrame::Visibilities(block) => self.add_block(block),
            GroundFrame::Housekeeping(counts) => {
                let later = self.housekeeping.filter(|known| known.time > counts.time);
                self.housekeeping = later.or(Some(*counts));
            }
        }
    }

    fn add_segment(&mut self, segment: &EphemerisSegment) {
        self.segments += 1;
        self.nodes += segment.nodes() as u64;
        let bytes: Vec<u8> =
            segment.positions_m.as_flattened().iter().flat_map(|x| x.to_le_bytes()).collect();
        let checksum =
            crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes) ^ u64::from(segment.step_ticks);
        match self.checksums.get(&segment.start) {
            Some(known) => self.contradictory += u64::from(*known != checksum),
            None if self.checksums.len() < COVERED_MAX => {
                self.checksums.insert(segment.start, checksum);
            }
            None => {}
        }
        self.interpolation_error_m = [self.interpolation_error_m, interpolation_error_m(segment)]
            .into_iter()
            .flatten()
            .reduce(f64::max);
        self.covered.add(segment.start, segment.end());
        if let Some(Instrument { epoch_tai_s, moon_radius_m, .. }) = &self.instrument {
            self.earth_hidden_by_date +=
                u64::from(earth_is_hidden_by_date(segment, *epoch_tai_s, *moon_radius_m));
        }
    }

    fn add_block(&mut self, block: &VisibilityBlock) {
        let (Some(first), Some(last)) = (block.offset_ticks.first(), block.offset_ticks.last()) else {
            return;
        };
        let duration = block.duration_ticks.last().copied().unwrap_or_default();
        let start = block.start.plus_ticks(i64::from(*first));
        let end = block.start.plus_ticks(i64::from(*last) + i64::from(duration));
        let [from, to] = self.span.unwrap_or([start, end]);
        self.span = Some([from.min(start), to.max(end)]);
        let tally = Tally {
            count: block.len() as u64,
            ticks: block.duration_ticks.iter().map(|ticks| u64::from(*ticks)).sum(),
            flagged: block.flags.iter().map(|flags| u64::from(!flags.is_good())).sum(),
        };
        self.total.add(tally);
        self.by_channel.entry(block.channel).or_default().add(tally);
        let key = (block.pair, block.channel);
        if self.rows.len() < ROWS_MAX || self.rows.contains_key(&key) {
            self.rows.entry(key).or_default().add(tally);
        }
    }

    /// The contents of the file, which has been read to its end.
    fn into_contents(self, path: &Path, bytes: u64, reception: &ReceptionCounters) -> Contents {
        let epoch_tai_s = self.instrument.as_ref().map(|instrument| instrument.epoch_tai_s);
        let mission_s = |time: CucTime| epoch_tai_s.map(|epoch_tai_s| time.tai_s() - epoch_tai_s);
        let mut gaps = Listing::default();
        for kind in PacketKind::ALL {
            for PacketGap { from, to, after, before, offset } in self.seen[kind.index()].gaps() {
                gaps.push(GapEntry {
                    kind,
                    apid: kind.apid(),
                    from,
                    to,
                    count: to - from + 1,
                    offset,
                    after_s: mission_s(after),
                    before_s: mission_s(before),
                });
            }
        }
        let place_damaged =
            |(entry, time): (DamagedEntry, CucTime)| DamagedEntry { time_s: mission_s(time), ..entry };
        let packets = PacketKind::ALL.map(|kind| {
            let (counts, extent) = (reception.kind(kind), self.extents[kind.index()]);
            KindSummary {
                kind,
                apid: kind.apid(),
                packets: counts.packets,
                bytes: counts.bytes,
                first_count: extent.first,
                last_count: extent.last,
            }
        });
        let pair = |((pair, channel), row): (&(Pair, ChannelId), &Tally)| PairSummary {
            pair: pair.to_string(),
            channel: channel.0,
            visibilities: row.counts(),
        };
        Contents {
            file: path.display().to_string(),
            bytes,
            format: if reception.frames.is_some() { Format::Cadu } else { Format::Packets },
            span: self.span.zip(epoch_tai_s).map(|(span, epoch_tai_s)| time_span(span, epoch_tai_s)),
            channels: self.channels(),
            instrument: self.instrument.as_ref().map(instrument_summary),
            packets: packets.into(),
            visibilities: self.total.counts(),
            baselines: self.rows.iter().map(pair).collect(),
            ephemeris: EphemerisSummary {
                contradictory: self.contradictory,
                earth_hidden_by_date: self.earth_hidden_by_date,
                interpolation_error_m_max: self.interpolation_error_m,
                ..self.covered.summary(self.segments, self.nodes)
            },
            housekeeping: self.housekeeping.map(|counts| HousekeepingSummary {
                time_s: (!counts.is_last()).then(|| counts.time.seconds()),
                sampled: counts.sampled,
                dropped: counts.dropped,
            }),
            gaps,
            bad_checksums: map_listing(self.damaged, place_damaged),
            garbage: self.garbage,
            faults: self.faults,
            truncated_bytes: reception.bytes_truncated,
            idle_bytes: self.idle_bytes
                + reception.frames.as_ref().map_or(0, |frames| frames.bytes_idle_packets),
            without_positions: 0,
            reception: reception.clone(),
        }
    }

    fn channels(&self) -> Vec<ChannelContents> {
        let channels = self.instrument.iter().flat_map(|instrument| &instrument.channels);
        let summary = |(k, channel): (usize, &crate::frames::Channel)| {
            let row = self.by_channel.get(&ChannelId(k as u16)).copied().unwrap_or_default();
            ChannelContents {
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
        epoch_utc: utc_text(instrument.epoch_tai_s),
        satellites: instrument.satellites,
        moon_radius_m: instrument.moon_radius_m,
        response: match instrument.response {
            AntennaResponse::Isotropic => "isotropic".to_owned(),
            AntennaResponse::DipoleNormal => "dipole along the orbit normal".to_owned(),
            AntennaResponse::ThreeDipoles => "three dipoles across each other".to_owned(),
        },
        seed: instrument.seed,
        configuration_hash: format!("{:016x}", instrument.configuration_hash),
        spectrometer: instrument.spectrometer.map(|Spectrometer { low_hz, width_hz, channels }| {
            let high_hz = low_hz + width_hz * f64::from(channels);
            format!("{:.3} to {:.3} MHz in {channels} channels", low_hz / 1e6, high_hz / 1e6)
        }),
    }
}

fn time_span([start, end]: [MissionTime; 2], epoch_tai_s: f64) -> TimeSpan {
    let (start_s, end_s) = (start.seconds(), end.seconds());
    let tai = |time_s| tai_text(epoch_tai_s + time_s);
    TimeSpan {
        start_s,
        end_s,
        start_tai: tai(start_s),
        end_tai: tai(end_s),
        start_utc: utc_text(epoch_tai_s + start_s),
        end_utc: utc_text(epoch_tai_s + end_s),
    }
}

/// The intervals of time that ephemeris segments cover, with both ends included. Segments one tick apart are joined.
#[derive(Debug, Default)]
struct EphemerisCoverage(IntervalSet<MissionTime>);

impl EphemerisCoverage {
    fn add(&mut self, start: MissionTime, end: MissionTime) {
        self.0.insert_bridging(start..end.plus_ticks(1), COVERED_MAX);
    }

    fn summary(&self, segments: u64, nodes: u64) -> EphemerisSummary {
        let intervals =
            || self.0.iter().map(|covered| [covered.start.seconds(), covered.end.plus_ticks(-1).seconds()]);
        EphemerisSummary {
            segments,
            nodes,
            // A fold, since an empty sum of f64 is -0.
            covered_s: intervals().fold(0.0, |sum, [start_s, end_s]| sum + (end_s - start_s)),
            covered: Listing {
                count: self.0.intervals() as u64,
                listed: intervals().take(LISTED_MAX).collect(),
            },
            ..EphemerisSummary::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_a_tick_apart_are_joined() {
        let mut coverage = EphemerisCoverage::default();
        for (start, end) in [(0, 10), (20, 30), (50, 60), (11, 15), (18, 20), (55, 57), (29, 52)] {
            coverage.add(MissionTime(start), MissionTime(end));
        }
        let summary = coverage.summary(7, 70);
        let ticks = |s: f64| (s * TICKS_PER_SECOND as f64).round() as i64;
        let covered: Vec<_> = summary.covered.listed.iter().map(|span| span.map(ticks)).collect();
        assert_eq!(covered, [[0, 15], [18, 60]]);
    }
}
