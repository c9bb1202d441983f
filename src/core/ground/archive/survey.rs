//! Surveys the packets in an archive or a downlink file.

use std::io::{Cursor, ErrorKind};
use std::path::{Path, PathBuf};

use super::checkpoint;
use super::checkpoint::ArchiveHead;
use super::entry::JournalEntry;
use super::folder::{checkpoints, note};
use super::gap_report::VisibilityPacket;
use super::gaps::{EphemerisPacket, Gaps, ReceivedPackets, find_gaps};
use super::names::number_of;
use super::raw_archive::unsaved_note;
use crate::array::Ephemeris;
use crate::downlink::ReceptionCounters;
use crate::frames::GroundFrame;
use crate::ground::{Collector, DeliveredPacket, Delivery, GroundError};
use crate::imaging::{Accumulator, MapConfig};
use crate::runtime::Ledger;

/// Capacity of the hold buffer while reading a file, bytes.
const WAIT_BYTES: u64 = 1 << 24;
const SEGMENTS_MAX: usize = 1 << 14;

/// The packets in an archive or a downlink file.
#[derive(Clone, Debug, Default)]
pub struct CoverageSurvey {
    received: ReceivedPackets,
    ephemeris: Ephemeris,
    notes: Vec<String>,
}

impl CoverageSurvey {
    /// Surveys the folder of an archive, one of its checkpoints, or a downlink file.
    ///
    /// # Errors
    /// A folder without a usable checkpoint; a file that cannot be read, or is of neither format.
    pub fn read(path: &Path) -> Result<Self, GroundError> {
        if path.is_dir() {
            return Self::read_folder(path);
        }
        if checkpoint::is_checkpoint(path)? {
            return Self::read_checkpoint(path);
        }
        let mut survey = Self { ephemeris: Ephemeris::new(SEGMENTS_MAX), ..Self::default() };
        let mut collector = Collector::new(WAIT_BYTES);
        collector.read_file(path, &mut |found| survey.add(found))?;
        let Self { received, ephemeris, .. } = &mut survey;
        for packet in &mut received.packets {
            packet.is_waiting = !ephemeris.covers([packet.entry.start, packet.entry.end]);
        }
        survey.finish(&collector);
        Ok(survey)
    }

    fn read_folder(path: &Path) -> Result<Self, GroundError> {
        let mut retries = 0;
        loop {
            match Self::read_newest(path) {
                // A running ground stage has replaced the checkpoint since the folder was read.
                Err(GroundError::Io { source, .. })
                    if source.kind() == ErrorKind::NotFound && retries < 10 =>
                {
                    retries += 1;
                }
                found => return found,
            }
        }
    }

    fn read_newest(path: &Path) -> Result<Self, GroundError> {
        let files: Vec<PathBuf> = checkpoints(path)?;
        let mut bad = Vec::new();
        for file in files.iter().rev() {
            match Self::read_checkpoint(file) {
                Ok(found) => {
                    let notes = bad.iter().map(|error| note(error, file));
                    let notes = notes.chain(unsaved_note(path, number_of(file))).collect();
                    return Ok(Self { notes, ..found });
                }
                Err(error @ GroundError::Damaged { .. }) => bad.push(error),
                Err(error) => return Err(error),
            }
        }
        match bad.into_iter().next() {
            Some(newest) => Err(GroundError::NoUsableCheckpoint {
                path: path.to_owned(),
                checkpoints: files.len(),
                newest: Box::new(newest),
            }),
            None => Err(GroundError::without_checkpoint(path)),
        }
    }

    fn read_checkpoint(path: &Path) -> Result<Self, GroundError> {
        let head: ArchiveHead = checkpoint::read(path, |head, engines| {
            std::io::copy(engines, &mut std::io::sink()).map_err(GroundError::io(path, "read"))?;
            Ok(head)
        })?;
        Ok(Self::from_head(head))
    }

    /// Surveys a checkpoint in memory, and reads its sums as a session with settings `map` does.
    ///
    /// # Errors
    /// A damaged checkpoint.
    pub fn from_bytes(bytes: &[u8], map: &MapConfig) -> Result<Self, GroundError> {
        let head: ArchiveHead =
            checkpoint::read_from(&mut Cursor::new(bytes), Path::new("memory"), |head, engines| {
                let accumulator = Accumulator::new(map.clone(), Ledger::default());
                accumulator.resume(head.accumulator.clone(), engines, None)?;
                Ok(head)
            })?;
        Ok(Self::from_head(head))
    }

    fn from_head(head: ArchiveHead) -> Self {
        let ArchiveHead { journal, ephemeris, collector, .. } = head;
        let mut survey = Self { ephemeris: Ephemeris::new(SEGMENTS_MAX), ..Self::default() };
        for segment in ephemeris {
            survey.ephemeris.insert(segment);
        }
        let packets = journal.accumulated_fractions().map(|(entry, share)| VisibilityPacket {
            entry: *entry,
            is_waiting: false,
            share,
        });
        survey.received.packets = packets.collect();
        for ((_, (made, count)), record) in &journal.others {
            let segment = record.ephemeris_start.and_then(|start| survey.ephemeris.segment(start));
            let span = segment.map(|segment| [segment.start, segment.end()]);
            survey.received.ephemerides.extend(span.map(|span| EphemerisPacket {
                count: *count,
                made: *made,
                span,
            }));
        }
        // Held packets are not in the journal.
        let counters = ReceptionCounters::default();
        let mut collector = Collector::resume(collector, journal.delivered(), counters);
        let applied = survey.received.packets.len();
        while let Some(delivery) = collector.flush_next() {
            survey.add(delivery);
        }
        survey.received.packets[applied..].iter_mut().for_each(|packet| packet.is_waiting = true);
        survey.finish(&collector);
        survey
    }

    fn add(&mut self, delivery: Delivery) {
        let Delivery { packets, frame } = delivery;
        match frame {
            Some(GroundFrame::Visibilities(block)) if !block.is_empty() => {
                let entry = packets
                    .first()
                    .map(|packet| JournalEntry::new(packet.header.time, packet.header.count, &block));
                let packet = entry.map(|entry| VisibilityPacket { entry, is_waiting: false, share: None });
                self.received.packets.extend(packet);
            }
            Some(GroundFrame::Ephemeris(segment)) => {
                let span = [segment.start, segment.end()];
                let ephemeris = |packet: &DeliveredPacket| EphemerisPacket {
                    count: packet.header.count,
                    made: packet.header.time,
                    span,
                };
                self.received.ephemerides.extend(packets.iter().map(ephemeris));
                self.ephemeris.insert(segment);
            }
            _ => {}
        }
    }

    fn finish(&mut self, collector: &Collector) {
        let channels = collector.instrument().into_iter().flat_map(|instrument| &instrument.channels);
        self.received.frequencies_hz = channels.map(|channel| channel.frequency_hz).collect();
        self.received.sets = collector.received().map(|(kind, set)| (kind, set.clone())).collect();
    }

    /// Notes on checkpoints that could not be used.
    #[doc(hidden)]
    pub fn notes(&self) -> impl Iterator<Item = &str> {
        self.notes.iter().map(String::as_str)
    }

    /// The received packets.
    #[must_use]
    pub fn received(&self) -> &ReceivedPackets {
        &self.received
    }

    /// The missing packets.
    #[must_use]
    pub fn gaps(&self) -> Gaps {
        find_gaps(&self.received)
    }

    /// The parts of a time span, s, during which the array observed: those with an ephemeris. Without any, the
    /// whole span, of at least a second.
    #[must_use]
    pub fn observed_s(&self, [a, b]: [f64; 2]) -> Vec<[f64; 2]> {
        let (from, to) = (a.min(b), a.max(b));
        let segments = self.ephemeris.segments();
        let segments = segments.map(|segment| [segment.start.seconds(), segment.end().seconds()]);
        let within = segments.filter(|[start, end]| (from..=to).contains(&(0.5 * (start + end))));
        let parts: Vec<[f64; 2]> = within.map(|[start, end]| [start.max(from), end.min(to)]).collect();
        if parts.is_empty() { vec![[from, to.max(from + 1.0)]] } else { parts }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::EphemerisSegment;
    use crate::units::MissionTime;

    #[test]
    fn what_is_missing_was_observed_where_positions_tell() {
        let mut survey = CoverageSurvey::default();
        // Windows of 2400 s in every 9000 s; the ephemeris of the fourth is missing.
        for window in [0, 1, 2, 4] {
            survey.ephemeris.insert(EphemerisSegment {
                start: MissionTime::from_seconds(9e3 * f64::from(window)),
                step_ticks: 300_000_000,
                satellites: 1,
                positions_m: vec![[0.0; 3]; 9],
            });
        }
        // The second window, from the edges of its neighbours; the third, from its end and beginning in reverse order; a
        // part of the third; and the fourth, whose time is unknown.
        assert_eq!(survey.observed_s([2399.0, 18_001.0]), [[9000.0, 11_400.0]]);
        assert_eq!(survey.observed_s([20_400.0, 18_000.0]), [[18_000.0, 20_400.0]]);
        assert_eq!(survey.observed_s([18_100.0, 18_900.0]), [[18_100.0, 18_900.0]]);
        assert_eq!(survey.observed_s([20_399.0, 36_001.0]), [[20_399.0, 36_001.0]]);
        assert_eq!(survey.observed_s([5000.0, 5000.0]), [[5000.0, 5001.0]]);
    }
}
