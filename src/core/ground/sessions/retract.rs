//! Retracts packets from an archive.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::downlink::receive::{Decoder, EventReader};
use crate::downlink::transport::packet_archive::PacketName;
use crate::downlink::{Event, PacketHeader, PacketKind};
use crate::ground::archive::draft::digest;
use crate::ground::archive::folder::checkpoints;
use crate::ground::archive::journal::{Journal, OtherRecord, SendingKey};
use crate::ground::archive::raw_archive::record_retraction;
use crate::ground::{Collector, Ground, GroundConfig, GroundError, HeldPacket};
use crate::units::MissionTime;

const REFUSED_LISTED: usize = 20;

/// A packet that cannot be removed from the archive.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RefusedPacket {
    /// Kind of the packet.
    pub kind: PacketKind,
    /// Count of the packet.
    pub count: u64,
    /// Reason for keeping it.
    pub reason: &'static str,
}

/// Report on a retraction.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Retracted {
    /// Number of packets removed, held ones included.
    pub packets: u64,
    /// Number of removed packets that were held.
    #[serde(rename = "waited")]
    pub held: u64,
    /// Number of visibilities in removed packets that had been applied.
    pub visibilities: u64,
    /// Number of these visibilities that were in the sums.
    pub accumulated: u64,
    /// Number of packets that are not in the archive.
    pub absent: u64,
    /// Number of packets kept: ephemeris packets that remaining visibilities need, and segments of payloads not given completely.
    pub kept: u64,
    /// Number of packets that differ from the ones in the archive, or whose positions have changed. They are kept.
    pub refused: u64,
    /// The first of the refused packets.
    #[serde(rename = "named")]
    pub refused_packets: Vec<RefusedPacket>,
}

type RecordKey = (PacketKind, SendingKey);

/// A retraction in progress. It removes records and subtracts their visibilities; derived data follow from the journal when
/// the checkpoint is next opened.
struct Retraction {
    ground: Ground,
    journal: Journal,
    report: Retracted,
    /// If given, only visibilities within this time span are removed.
    span: Option<[MissionTime; 2]>,
    done: BTreeSet<RecordKey>,
    /// Packets of other kinds that had been applied.
    others: BTreeSet<RecordKey>,
    /// Packets removed by this or an earlier retraction.
    removed: Vec<PacketName>,
}

impl Ground {
    /// Removes every packet of `files` from the archive in `folder`, or, with a span of mission time, only packets
    /// of visibilities within it. Returns a report, and notes on checkpoints that could not be used. The change is atomic.
    ///
    /// # Errors
    /// Errors of [`Ground::open`]; a folder without an archive; a file that cannot be read, or that describes another instrument;
    /// sums that do not match the journal.
    pub fn retract(
        folder: &Path,
        files: &[PathBuf],
        span: Option<[MissionTime; 2]>,
        config: &GroundConfig,
    ) -> Result<(Retracted, Vec<String>), GroundError> {
        if !folder.is_dir() || checkpoints(folder)?.is_empty() {
            return Err(GroundError::without_checkpoint(folder));
        }
        let mut ground = Self::open(folder, config, u64::MAX)?;
        let notes = ground.notes().map(str::to_owned).collect();
        let journal = ground.archive.as_mut().map(|archive| std::mem::take(&mut archive.journal));
        let mut retraction = Retraction {
            ground,
            journal: journal.unwrap_or_default(),
            report: Retracted::default(),
            span,
            done: BTreeSet::new(),
            others: BTreeSet::new(),
            removed: Vec::new(),
        };
        for file in files {
            retraction.retract_file(file)?;
        }
        if span.is_none() {
            retraction.retract_others();
        }
        let report = retraction.report.clone();
        // Even if all packets were absent: an earlier retraction may have been interrupted before it replaced the older checkpoint.
        if report.packets > 0 || report.absent > 0 {
            retraction.write(config)?;
        }
        Ok((report, notes))
    }
}

impl Retraction {
    fn retract_file(&mut self, path: &Path) -> Result<(), GroundError> {
        let mut events = EventReader::open(path)?.unfiltered();
        let mut decoder = Decoder::new();
        events.for_each(|event| {
            let Event::Packet(packet) = event else { return Ok(()) };
            if packet.header.kind == PacketKind::Instrument {
                decoder.accept(event);
                self.require_instrument(path, &decoder)?;
            }
            self.retract_packet(&HeldPacket::new(packet))
        })?;
        if events.packets() == 0 {
            return Err(damaged(path, "no packet", "a downlink file, as for `lunarray replay`"));
        }
        Ok(())
    }

    /// Requires that descriptions in a file are of the archive's instrument. Another mission of the same seed has some equal packets.
    fn require_instrument(&self, path: &Path, decoder: &Decoder) -> Result<(), GroundError> {
        let is_other =
            self.ground.instrument().zip(decoder.instrument()).is_some_and(|(own, found)| own != found);
        if !is_other && decoder.counters().instruments_contradictory == 0 {
            return Ok(());
        }
        let expected = "packets of the instrument of the state: nothing was changed";
        Err(damaged(path, "the description of another instrument", expected))
    }

    fn retract_packet(&mut self, packet: &HeldPacket) -> Result<(), GroundError> {
        let header = packet.header;
        let key = (header.kind, (header.time, header.count));
        if self.span.is_some_and(|span| !lies_in(packet, span)) || !self.done.insert(key) {
            return Ok(());
        }
        let held = self.ground.collector.held().get(&header).map(|held| held.checksum);
        let checksum = held.or_else(|| match header.kind {
            PacketKind::Visibilities => self.journal.visibilities.get(&key.1).map(|record| record.checksum),
            _ => self.journal.others.get(&key).map(|record| record.checksum),
        });
        match checksum {
            None => {
                // An earlier retraction was interrupted, or the packet was never received.
                self.removed.push((header.kind, header.count, header.time));
                self.report.absent += 1;
            }
            Some(checksum) if checksum != packet.checksum => self.refuse(&header, DIFFERENT_CONTENT),
            Some(_) if held.is_some() => {
                self.ground.collector.remove_held(&header);
                self.removed.push((header.kind, header.count, header.time));
                self.report.packets += 1;
                self.report.held += 1;
            }
            Some(_) if header.kind == PacketKind::Visibilities => return self.retract_visibilities(packet),
            Some(_) => {
                self.others.insert(key);
            }
        }
        Ok(())
    }

    fn refuse(&mut self, header: &PacketHeader, reason: &'static str) {
        self.report.refused += 1;
        if self.report.refused_packets.len() < REFUSED_LISTED {
            self.report.refused_packets.push(RefusedPacket {
                kind: header.kind,
                count: header.count,
                reason,
            });
        }
    }

    /// Removes an applied packet of visibilities with equal content.
    fn retract_visibilities(&mut self, packet: &HeldPacket) -> Result<(), GroundError> {
        let header = packet.header;
        let sent = (header.time, header.count);
        let Some(record) = self.journal.visibilities.get(&sent) else { return Ok(()) };
        let (visibilities, accumulated) = (record.entry.visibilities, record.accumulated);
        if accumulated > 0 {
            let Ground { collector, calibrator, accumulator, .. } = &mut self.ground;
            let block = collector.decoded(packet).unwrap_or_default();
            let removed = if block.pair.i == block.pair.j {
                calibrator.remove_autos(block)?
            } else {
                let placed = calibrator.calibrated(block)?;
                if digest(&placed) != record.digest {
                    self.refuse(&header, EPHEMERIS_CHANGED);
                    return Ok(());
                }
                accumulator.remove(&placed)?.visibilities
            };
            if removed != u64::from(accumulated) {
                let (count, found, expected) = (header.count, removed, accumulated);
                return Err(GroundError::NotInSums { count, found, expected });
            }
        }
        self.journal.visibilities.remove(&sent);
        self.removed.push((header.kind, header.count, header.time));
        self.report.packets += 1;
        self.report.visibilities += u64::from(visibilities);
        self.report.accumulated += u64::from(accumulated);
        Ok(())
    }

    /// Removes payloads of other kinds of which all packets were given, except ephemeris segments that remaining visibilities need.
    fn retract_others(&mut self) {
        let mut payloads: BTreeMap<(PacketKind, SendingKey), (OtherRecord, Vec<RecordKey>)> = BTreeMap::new();
        for key @ (kind, (time, _)) in &self.others {
            let Some(record) = self.journal.others.get(key) else { continue };
            let first = (*kind, (*time, record.payload[0]));
            payloads.entry(first).or_insert_with(|| (*record, Vec::new())).1.push(*key);
        }
        let needed = self.needed_segments();
        for (record, keys) in payloads.into_values() {
            let [first, last] = record.payload;
            let is_whole = last.checked_sub(first).is_some_and(|more| more == keys.len() as u64 - 1);
            if !is_whole || record.ephemeris_start.is_some_and(|start| needed.contains(&start)) {
                self.report.kept += keys.len() as u64;
                continue;
            }
            self.report.packets += keys.len() as u64;
            for key in &keys {
                self.journal.others.remove(key);
                let (kind, (time, count)) = *key;
                self.removed.push((kind, count, time));
            }
            if let Some(start) = record.ephemeris_start
                && !self.journal.others.values().any(|other| other.ephemeris_start == Some(start))
            {
                self.ground.calibrator.remove_segment(start);
            }
        }
    }

    /// Start times of ephemeris segments that only the given packets contain and that remaining visibilities need.
    fn needed_segments(&self) -> BTreeSet<MissionTime> {
        let starts = |is_found: bool| -> BTreeSet<MissionTime> {
            let records = self.journal.others.iter();
            let records = records.filter(|(key, _)| self.others.contains(key) == is_found);
            records.filter_map(|(_, record)| record.ephemeris_start).collect()
        };
        let (found, others) = (starts(true), starts(false));
        let is_needed = |start: &MissionTime| {
            let segment = self.ground.calibrator.ephemeris().segment(*start);
            !others.contains(start)
                && segment.is_some_and(|segment| self.journal.uses([segment.start, segment.end()]))
        };
        found.into_iter().filter(is_needed).collect()
    }

    /// Writes the archive twice, so that falling back to the older checkpoint does not bring the packets back.
    fn write(self, config: &GroundConfig) -> Result<(), GroundError> {
        let Self { mut ground, journal, removed, .. } = self;
        let is_empty = journal.is_empty() && ground.collector.held().packets().next().is_none();
        ground.accumulator.restore_spans(&journal.spans_s());
        if let Some(archive) = &mut ground.archive {
            archive.journal = journal;
            // Before the checkpoints: if the command is interrupted in between, running it again completes it.
            record_retraction(archive.packets.as_ref(), &removed, archive.folder.path())?;
        }
        if is_empty {
            // Reset to the state of a new archive.
            ground.collector = Collector::new(ground.collector.held().bytes_max());
            ground.gate = config.gate()?;
            ground.calibrator = config.calibrator(ground.gate.as_ref(), &ground.outcome.ledger)?;
            ground.accumulator = config.accumulator(&ground.outcome.ledger);
        }
        ground.checkpoint()?;
        if let Some(archive) = &mut ground.archive {
            // The old contents must be removed even if there is no space for a second copy of the new ones.
            archive.folder.drop_older()?;
        }
        ground.checkpoint()
    }
}

const DIFFERENT_CONTENT: &str = "its content differs from the packet in the state";
const EPHEMERIS_CHANGED: &str =
    "the ephemeris, or the table of bursts, has changed since the packet was added to the sums";

fn damaged(path: &Path, found: &str, expected: &'static str) -> GroundError {
    GroundError::Damaged { path: path.to_owned(), found: found.to_owned(), expected }
}

/// Whether a packet holds visibilities that all lie within a span of mission time.
fn lies_in(packet: &HeldPacket, [from, to]: [MissionTime; 2]) -> bool {
    packet.span().is_some_and(|[first, last]| from <= first && last <= to)
}
