//! Removing packets from an archive.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::draft::digest;
use super::folder::checkpoints;
use super::journal::{Journal, OtherRecord, Sent};
use super::recovery::forget;
use crate::downlink::receive::EventReader;
use crate::downlink::transport::packet_archive::PacketName;
use crate::downlink::{Event, PacketHeader, PacketKind};
use crate::ground::{Collector, Ground, GroundConfig, GroundError, HeldPacket};
use crate::units::MissionTime;

/// Most packets that are listed as refused.
const REFUSED_LISTED: usize = 20;

/// A packet that stays in the archive.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RefusedPacket {
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Packet count.
    pub count: u64,
    /// Why.
    pub reason: &'static str,
}

/// Counts of a retraction.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Retracted {
    /// Packets removed, held ones included.
    pub packets: u64,
    /// Packets removed that were held.
    pub waited: u64,
    /// Visibilities in the packets removed that had been applied.
    pub visibilities: u64,
    /// Of these, packets that were in the sums.
    pub accumulated: u64,
    /// Packets that are not in the archive.
    pub absent: u64,
    /// Packets of positions by which other visibilities were placed, and parts of payloads: they stay.
    pub kept: u64,
    /// Packets that stay because their removal would remove something else.
    pub refused: u64,
    /// The first of those.
    pub named: Vec<RefusedPacket>,
}

/// Place of a packet in the journal.
type RecordKey = (PacketKind, Sent);

/// A retraction under way. Records are removed and their visibilities subtracted; the views of the journal are folded
/// again when the checkpoint is next opened.
struct Retraction {
    ground: Ground,
    journal: Journal,
    report: Retracted,
    /// Only visibilities within this span of time, if it is given.
    span: Option<[MissionTime; 2]>,
    /// Packets that were considered.
    done: BTreeSet<RecordKey>,
    /// Packets of other kinds that were applied.
    others: BTreeSet<RecordKey>,
    /// Packets that are removed, or had been.
    removed: Vec<PacketName>,
}

impl Ground {
    /// Removes every packet of `files` from the archive in `folder`, or, with a span of mission time, only the packets
    /// of visibilities within it. Returns what became of them, and notes on checkpoints that could not be used. The
    /// archive holds the new contents as a whole, or the old ones.
    ///
    /// # Errors
    /// Those of [`Ground::open`]; a folder without an archive; a file that cannot be read; sums that do not hold what
    /// the journal says.
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
        // Also if all had gone: an earlier retraction may have been ended before the older checkpoint was replaced.
        if report.packets > 0 || report.absent > 0 {
            retraction.write(config)?;
        }
        Ok((report, notes))
    }
}

impl Retraction {
    fn retract_file(&mut self, path: &Path) -> Result<(), GroundError> {
        let mut events = EventReader::open(path)?.unfiltered();
        events.for_each(|event| match event {
            Event::Packet(packet) => self.retract_packet(&HeldPacket::of(packet)),
            _ => Ok(()),
        })?;
        if events.packets() == 0 {
            let (path, found) = (path.to_owned(), "not one packet".into());
            return Err(GroundError::Damaged {
                path,
                found,
                expected: "a downlink file, as `lunarray replay` takes",
            });
        }
        Ok(())
    }

    fn retract_packet(&mut self, packet: &HeldPacket) -> Result<(), GroundError> {
        let header = packet.header;
        let key = (header.kind, (header.time, header.count));
        if self.span.is_some_and(|span| !lies_in(packet, span)) || !self.done.insert(key) {
            return Ok(());
        }
        let held = self.ground.collector.held().get(&header).map(|held| held.check);
        let check = held.or_else(|| match header.kind {
            PacketKind::Visibilities => self.journal.visibilities.get(&key.1).map(|record| record.check),
            _ => self.journal.others.get(&key).map(|record| record.check),
        });
        match check {
            None => {
                // Of an earlier retraction that was ended, or of a packet that never came.
                self.removed.push((header.kind, header.count, header.time));
                self.report.absent += 1;
            }
            Some(check) if check != packet.check => self.refuse(&header, OTHER_CONTENT),
            Some(_) if held.is_some() => {
                self.ground.collector.remove_held(&header);
                self.removed.push((header.kind, header.count, header.time));
                self.report.packets += 1;
                self.report.waited += 1;
            }
            Some(_) if header.kind == PacketKind::Visibilities => return self.retract_visibilities(packet),
            Some(_) => drop(self.others.insert(key)),
        }
        Ok(())
    }

    fn refuse(&mut self, header: &PacketHeader, reason: &'static str) {
        self.report.refused += 1;
        if self.report.named.len() < REFUSED_LISTED {
            self.report.named.push(RefusedPacket { kind: header.kind, count: header.count, reason });
        }
    }

    /// Removes a packet of visibilities that was applied with this content.
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
                    self.refuse(&header, OTHER_POSITIONS);
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

    /// Removes payloads of other kinds whose packets were all found, unless something depends on them.
    fn retract_others(&mut self) {
        let mut payloads: BTreeMap<(PacketKind, Sent), (OtherRecord, Vec<RecordKey>)> = BTreeMap::new();
        for key @ (kind, (time, _)) in &self.others {
            let Some(record) = self.journal.others.get(key) else { continue };
            let first = (*kind, (*time, record.payload[0]));
            payloads.entry(first).or_insert_with(|| (*record, Vec::new())).1.push(*key);
        }
        let needed = self.segments_needed();
        for (record, keys) in payloads.into_values() {
            let [first, last] = record.payload;
            let is_whole = last.checked_sub(first).is_some_and(|more| more == keys.len() as u64 - 1);
            if !is_whole || record.segment.is_some_and(|start| needed.contains(&start)) {
                self.report.kept += keys.len() as u64;
                continue;
            }
            self.report.packets += keys.len() as u64;
            for key in &keys {
                self.journal.others.remove(key);
                let (kind, (time, count)) = *key;
                self.removed.push((kind, count, time));
            }
            if let Some(start) = record.segment
                && !self.journal.others.values().any(|other| other.segment == Some(start))
            {
                self.ground.calibrator.remove_segment(start);
            }
        }
    }

    /// Starts of the positions that came only from the packets found, and by which visibilities that stay were placed.
    fn segments_needed(&self) -> BTreeSet<MissionTime> {
        let starts = |is_found: bool| -> BTreeSet<MissionTime> {
            let records = self.journal.others.iter();
            let records = records.filter(|(key, _)| self.others.contains(key) == is_found);
            records.filter_map(|(_, record)| record.segment).collect()
        };
        let (found, others) = (starts(true), starts(false));
        let is_needed = |start: &MissionTime| {
            let segment = self.ground.calibrator.ephemeris().segment(*start);
            !others.contains(start)
                && segment.is_some_and(|segment| self.journal.uses([segment.start, segment.end()]))
        };
        found.into_iter().filter(is_needed).collect()
    }

    /// Writes the archive without the packets: twice, so that the checkpoint before the newest does not bring them back.
    fn write(self, config: &GroundConfig) -> Result<(), GroundError> {
        let Self { mut ground, journal, removed, .. } = self;
        let is_empty = journal.is_empty() && ground.collector.held().packets().next().is_none();
        ground.accumulator.set_spans(&journal.spans_s());
        if let Some(archive) = &mut ground.archive {
            archive.journal = journal;
            // First: a retraction that is ended before the checkpoints are written is repeated.
            forget(archive.packets.as_ref(), &removed, archive.folder.path())?;
        }
        if is_empty {
            // As if nothing had ever been received.
            ground.collector = Collector::new(ground.collector.held().bytes_max());
            ground.gate = config.gate()?;
            ground.calibrator = config.calibrator(ground.gate.as_ref(), &ground.outcome.ledger)?;
            ground.accumulator = config.accumulator(&ground.outcome.ledger);
        }
        ground.checkpoint()?;
        if let Some(archive) = &mut ground.archive {
            // The old contents have to go, whether or not there is room for another copy of the new ones.
            archive.folder.drop_older()?;
        }
        ground.checkpoint()
    }
}

const OTHER_CONTENT: &str = "its content differs from that of the packet in the state";
const OTHER_POSITIONS: &str = "the positions that are known now are others than those that it was placed by";

/// Whether a packet holds visibilities that all lie in a span of mission time.
fn lies_in(packet: &HeldPacket, [from, to]: [MissionTime; 2]) -> bool {
    packet.span().is_some_and(|[first, last]| from <= first && last <= to)
}
