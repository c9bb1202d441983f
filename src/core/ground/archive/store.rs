//! The archive of a running ground stage.

use std::time::Instant;

use super::calibration_state::CalibrationState;
use super::checkpoint::{self, ArchiveHeadView};
use super::draft::{RecordDraft, digest};
use super::folder::{StateFolder, checkpoints};
use super::journal::{Journal, OtherRecord, SendingKey, SumsSpan};
use crate::array::Ephemeris;
use crate::calibration::{AutoTable, Calibrator};
use crate::downlink::PacketKind;
use crate::downlink::transport::packet_archive::PacketArchive;
use crate::frames::{EphemerisSegment, PlacedVisibilities, VisibilityReason};
use crate::ground::pass_gate::PassGate;
use crate::ground::{Collector, DeliveredPacket, GroundError, SharedSaving};
use crate::imaging::anywhere::SegmentFolder;
use crate::imaging::{AccumulationError, Accumulator};
use crate::runtime::{Ledger, LedgerReport};

/// Divisor of the interval for the first retry after a failed checkpoint. The pause doubles with each failure.
const RETRY_DIVISOR: u64 = 8;

/// Keeps a journal of the packets applied by a ground stage, and writes its checkpoints into a folder.
pub(in crate::ground) struct Archive {
    pub(in crate::ground) folder: StateFolder,
    pub(in crate::ground) settings: Vec<(String, String)>,
    /// Number of the calibration that the sums were made with, from 1.
    pub(in crate::ground) version: u32,
    pub(in crate::ground) journal: Journal,
    /// Notes on checkpoints that could not be used.
    pub(in crate::ground) notes: Vec<String>,
    /// Ledger entries of the current packet.
    pub(in crate::ground) posts: Ledger<VisibilityReason>,
    pub(in crate::ground) interval: u64,
    /// Number of visibilities between the last attempt and the next. After a failure it is shorter than the interval, and grows.
    pub(in crate::ground) wait: u64,
    pub(in crate::ground) since_attempt: u64,
    pub(in crate::ground) saving: SharedSaving,
    /// The raw archive beside the checkpoints; `None` if the stage does not write to one.
    pub(in crate::ground) packets: Option<PacketArchive>,
}

impl Archive {
    /// Records an applied delivery, and returns its ledger entries.
    pub(in crate::ground) fn record(
        &mut self,
        packets: &[DeliveredPacket],
        draft: RecordDraft,
        ephemeris: &Ephemeris,
    ) -> LedgerReport<VisibilityReason> {
        let posts = self.take_posts();
        let (Some(first), Some(last)) = (packets.first(), packets.last()) else { return posts };
        if first.header.kind == PacketKind::Visibilities {
            self.since_attempt += u64::from(draft.entry.visibilities);
            self.journal.record_visibilities(first, draft, &posts);
            return posts;
        }
        let is_used = |segment: &EphemerisSegment| ephemeris.segment(segment.start) == Some(segment);
        let ephemeris_start = draft.segment.filter(is_used).map(|segment| segment.start);
        let payload = [first.header.count, last.header.count];
        for DeliveredPacket { header, checksum, counts } in packets {
            let (bytes, report) = (header.bytes as u32, draft.report);
            let (checksum, counts) = (*checksum, *counts);
            let record = OtherRecord { checksum, bytes, counts, payload, ephemeris_start, report };
            self.journal.others.insert((header.kind, (header.time, header.count)), record);
        }
        posts
    }

    /// Records that visibilities of an applied packet were taken out of the sums, as they lie in a burst; `outside` are the others of
    /// those offered to the sums.
    pub(in crate::ground) fn reflag(&mut self, sent: SendingKey, outside: &PlacedVisibilities, removed: u64) {
        let Some(record) = self.journal.visibilities.get_mut(&sent) else { return };
        (record.digest, record.offered) = (digest(outside), outside.len() as u32);
        record.accumulated = record.accumulated.saturating_sub(removed as u32);
        if removed > 0 {
            record.left_out.push((VisibilityReason::Burst, removed as u32));
        }
        let ends = outside.time_s.first().zip(outside.time_s.last()).filter(|_| record.accumulated > 0);
        record.used = record.used.zip(ends).map(|(used, (&first, &last))| {
            let [from_s, until_s] = used.span_s;
            SumsSpan { span_s: [from_s.max(first), until_s.min(last)], ..used }
        });
    }

    /// The ledger for the packet that is being applied.
    pub(in crate::ground) fn posts(&self) -> Ledger<VisibilityReason> {
        self.posts.clone()
    }

    pub(in crate::ground) fn set_settings(&mut self, settings: Vec<(String, String)>) {
        self.settings = settings;
    }

    /// Notes on checkpoints that could not be used.
    pub(in crate::ground) fn notes(&self) -> impl Iterator<Item = &str> {
        self.notes.iter().map(String::as_str)
    }

    /// Whether checkpoints are written before the end of the session.
    pub(in crate::ground) fn saves_during_session(&self) -> bool {
        self.interval < u64::MAX
    }

    pub(in crate::ground) fn is_due(&self) -> bool {
        self.since_attempt >= self.wait
    }

    /// Takes the ledger entries since the last call.
    pub(in crate::ground) fn take_posts(&self) -> LedgerReport<VisibilityReason> {
        self.posts.take()
    }

    /// Marks in the raw archive how many bytes of this session the newest checkpoint holds. Without the mark they are read again
    /// after a restart.
    pub(in crate::ground) fn mark_packets(&self, bytes: u64) {
        if let (Some(packets), Some(newest)) = (&self.packets, self.folder.newest()) {
            let _ = packets.record_checkpoint(newest, bytes, &self.folder.numbers());
        }
    }

    /// Writes a checkpoint and counts the attempt. A failure loses no data.
    pub(in crate::ground) fn checkpoint(
        &mut self,
        collector: &Collector,
        (calibrator, gate): (&Calibrator, Option<&PassGate>),
        accumulator: &mut Accumulator,
    ) -> Result<(), GroundError> {
        let begun = Instant::now();
        let written = self.write(collector, (calibrator, gate), accumulator);
        let failed_before = self.saving.count_attempt(written.as_ref().err(), begun);
        self.since_attempt = 0;
        self.wait = match (&written, failed_before) {
            (Ok(()), _) => self.interval,
            (Err(_), false) => (self.interval / RETRY_DIVISOR).max(1),
            (Err(_), true) => self.wait.saturating_mul(2).min(self.interval),
        };
        written
    }

    /// Whether the only checkpoint of the folder has the head that would be written now. The sums follow from its journal.
    pub(in crate::ground) fn is_written(
        &self,
        collector: &Collector,
        (calibrator, gate): (&Calibrator, Option<&PassGate>),
        accumulator: &Accumulator,
    ) -> Result<bool, GroundError> {
        let found = checkpoints(self.folder.path())?;
        let [only] = &found[..] else { return Ok(false) };
        let no_autos = AutoTable::default();
        let parts =
            ArchiveHeadRef { settings: &self.settings, journal: &self.journal, version: self.version };
        let head = parts.view(collector, (calibrator, gate), accumulator, &no_autos);
        checkpoint::is_of_head(only, &head)
    }

    fn write(
        &mut self,
        collector: &Collector,
        (calibrator, gate): (&Calibrator, Option<&PassGate>),
        accumulator: &mut Accumulator,
    ) -> Result<(), GroundError> {
        let no_autos = AutoTable::default();
        let parts =
            ArchiveHeadRef { settings: &self.settings, journal: &self.journal, version: self.version };
        let head = parts.view(collector, (calibrator, gate), accumulator, &no_autos);
        let (folder, number) = self.folder.next();
        let place = SegmentFolder { folder: &folder, number };
        self.folder.save(|out, path| {
            let add_path = |error| match error {
                AccumulationError::Io(source) => GroundError::io(path, "write")(source),
                other => other.into(),
            };
            checkpoint::write(out, path, &head, |out| accumulator.write_sums(out, place).map_err(add_path))
        })?;
        self.folder.set_segments(accumulator.segments());
        self.folder.remove_unnamed();
        Ok(())
    }
}

/// The parts of a checkpoint's head that belong to the archive.
struct ArchiveHeadRef<'a> {
    settings: &'a Vec<(String, String)>,
    journal: &'a Journal,
    version: u32,
}

impl<'a> ArchiveHeadRef<'a> {
    fn view(
        &self,
        collector: &'a Collector,
        (calibrator, gate): (&'a Calibrator, Option<&PassGate>),
        accumulator: &Accumulator,
        no_autos: &'a AutoTable,
    ) -> ArchiveHeadView<'a> {
        ArchiveHeadView {
            settings: self.settings,
            collector: collector.view(),
            ephemeris: calibrator.ephemeris().segments().collect(),
            autos: calibrator.autos().unwrap_or(no_autos),
            accumulator: accumulator.state(),
            journal: self.journal,
            calibration: CalibrationState {
                version: self.version,
                passes: gate.map(PassGate::state).unwrap_or_default(),
                bursts: calibrator.bursts().list(),
                searched: calibrator.bursts().searched(),
            },
        }
    }
}
