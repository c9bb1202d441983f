//! What an archive or a downlink file holds.

use std::io::{Cursor, ErrorKind};
use std::path::{Path, PathBuf};

use super::checkpoint;
use super::checkpoint::ArchiveHead;
use super::entry::JournalEntry;
use super::folder::{checkpoints, note};
use super::gap_report::VisibilityPacket;
use super::gaps::{Gaps, PositionsPacket, ReceivedPackets, find_gaps};
use super::names::number_of;
use super::recovery::unsaved_note;
use crate::array::Ephemeris;
use crate::downlink::ReceptionCounters;
use crate::frames::GroundFrame;
use crate::ground::{Collector, DeliveredPacket, Delivery, GroundError};
use crate::imaging::{Accumulator, MapConfig};
use crate::runtime::Ledger;

/// Capacity of the hold buffer while a file is read.
const WAIT_BYTES: u64 = 1 << 24;
/// Most segments of positions.
const SEGMENTS_MAX: usize = 1 << 14;

/// What has been received.
#[derive(Clone, Debug, Default)]
pub struct CoverageSurvey {
    received: ReceivedPackets,
    /// Known positions.
    ephemeris: Ephemeris,
    notes: Vec<String>,
}

impl CoverageSurvey {
    /// Surveys an archive's folder, one of its checkpoints, or a downlink file.
    ///
    /// # Errors
    /// A folder without a usable checkpoint, a file that cannot be read or is neither.
    pub fn of(path: &Path) -> Result<Self, GroundError> {
        if path.is_dir() {
            return Self::of_folder(path);
        }
        if checkpoint::is_checkpoint(path)? {
            return Self::of_checkpoint(path);
        }
        let mut survey = Self { ephemeris: Ephemeris::new(SEGMENTS_MAX), ..Self::default() };
        let mut collector = Collector::new(WAIT_BYTES);
        collector.read_file(path, &mut |found| survey.see(found))?;
        let Self { received, ephemeris, .. } = &mut survey;
        for reading in &mut received.readings {
            reading.waits = !ephemeris.covers([reading.entry.start, reading.entry.end]);
        }
        survey.conclude(&collector);
        Ok(survey)
    }

    fn of_folder(path: &Path) -> Result<Self, GroundError> {
        let mut again = 0;
        loop {
            match Self::of_newest(path) {
                // A ground at work has written newer ones and removed it since the folder was read.
                Err(GroundError::Io { source, .. }) if source.kind() == ErrorKind::NotFound && again < 10 => {
                    again += 1;
                }
                found => return found,
            }
        }
    }

    /// The newest checkpoint of a folder that holds.
    fn of_newest(path: &Path) -> Result<Self, GroundError> {
        let files: Vec<PathBuf> = checkpoints(path)?;
        let mut bad = Vec::new();
        for file in files.iter().rev() {
            match Self::of_checkpoint(file) {
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
            Some(newest) => Err(GroundError::NoneHolds {
                path: path.to_owned(),
                checkpoints: files.len(),
                newest: Box::new(newest),
            }),
            None => Err(GroundError::without_checkpoint(path)),
        }
    }

    fn of_checkpoint(path: &Path) -> Result<Self, GroundError> {
        let head: ArchiveHead = checkpoint::read(path, |head, engines| {
            std::io::copy(engines, &mut std::io::sink()).map_err(GroundError::io(path, "read"))?;
            Ok(head)
        })?;
        Ok(Self::of_head(head))
    }

    /// Surveys a checkpoint in memory, and reads its engines too, as a session of `map` that resumes from it.
    ///
    /// # Errors
    /// A damaged checkpoint.
    pub fn of_bytes(bytes: &[u8], map: &MapConfig) -> Result<Self, GroundError> {
        let head: ArchiveHead =
            checkpoint::read_from(&mut Cursor::new(bytes), Path::new("memory"), |head, engines| {
                let accumulator = Accumulator::new(map.clone(), Ledger::default());
                accumulator.resume(head.accumulator.clone(), engines, None)?;
                Ok(head)
            })?;
        Ok(Self::of_head(head))
    }

    fn of_head(head: ArchiveHead) -> Self {
        let ArchiveHead { journal, ephemeris, collector, .. } = head;
        let mut survey = Self { ephemeris: Ephemeris::new(SEGMENTS_MAX), ..Self::default() };
        for segment in ephemeris {
            survey.ephemeris.insert(segment);
        }
        let readings =
            journal.strides().map(|(entry, share)| VisibilityPacket { entry: *entry, waits: false, share });
        survey.received.readings = readings.collect();
        for ((_, (made, count)), record) in &journal.others {
            let segment = record.segment.and_then(|start| survey.ephemeris.segment(start));
            let span = segment.map(|segment| [segment.start, segment.end()]);
            survey.received.positions.extend(span.map(|span| PositionsPacket {
                count: *count,
                made: *made,
                span,
            }));
        }
        // Held packets were received too, and are not in the journal.
        let counters = ReceptionCounters::default();
        let mut collector = Collector::resume(collector, journal.delivered(), counters);
        let read = survey.received.readings.len();
        while let Some(delivery) = collector.flush_next() {
            survey.see(delivery);
        }
        survey.received.readings[read..].iter_mut().for_each(|reading| reading.waits = true);
        survey.conclude(&collector);
        survey
    }

    fn see(&mut self, delivery: Delivery) {
        let Delivery { packets, frame } = delivery;
        match frame {
            Some(GroundFrame::Visibilities(block)) if !block.is_empty() => {
                let entry = packets
                    .first()
                    .map(|packet| JournalEntry::of(packet.header.time, packet.header.count, &block));
                let reading = entry.map(|entry| VisibilityPacket { entry, waits: false, share: None });
                self.received.readings.extend(reading);
            }
            Some(GroundFrame::Ephemeris(segment)) => {
                let span = [segment.start, segment.end()];
                let positions = |packet: &DeliveredPacket| PositionsPacket {
                    count: packet.header.count,
                    made: packet.header.time,
                    span,
                };
                self.received.positions.extend(packets.iter().map(positions));
                self.ephemeris.insert(segment);
            }
            _ => {}
        }
    }

    fn conclude(&mut self, collector: &Collector) {
        let channels = collector.instrument().into_iter().flat_map(|instrument| &instrument.channels);
        self.received.frequencies_hz = channels.map(|channel| channel.frequency_hz).collect();
        self.received.sets = collector.received().map(|(kind, set)| (kind, set.clone())).collect();
    }

    /// Checkpoints that could not be used, in words.
    #[doc(hidden)]
    pub fn notes(&self) -> impl Iterator<Item = &str> {
        self.notes.iter().map(String::as_str)
    }

    /// What has been received.
    #[must_use]
    pub fn received(&self) -> &ReceivedPackets {
        &self.received
    }

    /// What is missing.
    #[must_use]
    pub fn gaps(&self) -> Gaps {
        find_gaps(&self.received)
    }

    /// The parts of a span of time, s, in which the array observed: those covered by positions, without their edges. If
    /// there are none, all of it, at least a second.
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
        // Windows of 2400 s in every 9000 s; of the fourth no positions came.
        for window in [0, 1, 2, 4] {
            survey.ephemeris.insert(EphemerisSegment {
                start: MissionTime::from_seconds(9e3 * f64::from(window)),
                step_ticks: 300_000_000,
                satellites: 1,
                positions_m: vec![[0.0; 3]; 9],
            });
        }
        // The second window, of which the first and third came but for their edges; the third, by its last stream and its
        // own beginning; a part of one; and the fourth, whose time is unknown.
        assert_eq!(survey.observed_s([2399.0, 18_001.0]), [[9000.0, 11_400.0]]);
        assert_eq!(survey.observed_s([20_400.0, 18_000.0]), [[18_000.0, 20_400.0]]);
        assert_eq!(survey.observed_s([18_100.0, 18_900.0]), [[18_100.0, 18_900.0]]);
        assert_eq!(survey.observed_s([20_399.0, 36_001.0]), [[20_399.0, 36_001.0]]);
        assert_eq!(survey.observed_s([5000.0, 5000.0]), [[5000.0, 5001.0]]);
    }
}
