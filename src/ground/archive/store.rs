//! The archive of a running ground, and what its checkpoints hold.

use std::time::Instant;

use super::calibration_state::CalibrationState;
use super::checkpoint::{self, ArchiveHeadView};
use super::draft::RecordDraft;
use super::folder::{StateFolder, checkpoints};
use super::journal::{Journal, OtherRecord};
use crate::array::Ephemeris;
use crate::calibration::{AutoTable, Calibrator};
use crate::downlink::PacketKind;
use crate::downlink::transport::packet_archive::PacketArchive;
use crate::frames::{EphemerisSegment, VisibilityReason};
use crate::ground::pass_gate::PassGate;
use crate::ground::{Collector, DeliveredPacket, GroundError, SharedSaving};
use crate::imaging::anywhere::SegmentPlace;
use crate::imaging::{AccumulationError, Accumulator};
use crate::runtime::{Ledger, LedgerReport};

/// After a failure a checkpoint is tried again after this part of the interval, then after twice that, and so on.
const RETRIES: u64 = 8;

/// Keeps a journal of what a ground applies, and writes checkpoints of the ground into a folder.
pub(in crate::ground) struct Archive {
    pub(super) folder: StateFolder,
    /// Settings that shape the sums.
    pub(super) settings: Vec<(String, String)>,
    /// Number of the calibration that the sums were made with, from 1.
    pub(super) version: u32,
    pub(super) journal: Journal,
    /// Checkpoints that could not be used, in words.
    pub(super) notes: Vec<String>,
    /// Ledger entries of the current packet.
    pub(super) posts: Ledger<VisibilityReason>,
    /// Visibilities from one checkpoint to the next.
    pub(super) interval: u64,
    /// Visibilities from the last attempt to the next: fewer than the interval after one that failed, and more each time.
    pub(super) wait: u64,
    pub(super) since_attempt: u64,
    pub(super) saving: SharedSaving,
    /// The raw archive beside the checkpoints, if there is one.
    pub(super) packets: Option<PacketArchive>,
}

impl Archive {
    /// Records a delivery that became `draft`; returns what it has posted to the ledger.
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
        let segment = draft.segment.filter(is_used).map(|segment| segment.start);
        let payload = [first.header.count, last.header.count];
        for DeliveredPacket { header, check, reading } in packets {
            let (bytes, report) = (header.bytes as u32, draft.report);
            let record = OtherRecord { check: *check, bytes, reading: *reading, payload, segment, report };
            self.journal.others.insert((header.kind, (header.time, header.count)), record);
        }
        posts
    }

    /// Where applying packets posts.
    pub(super) fn posts(&self) -> Ledger<VisibilityReason> {
        self.posts.clone()
    }

    /// Binds it to other settings.
    pub(super) fn set_settings(&mut self, settings: Vec<(String, String)>) {
        self.settings = settings;
    }

    /// Checkpoints that could not be used, in words.
    pub(super) fn notes(&self) -> impl Iterator<Item = &str> {
        self.notes.iter().map(String::as_str)
    }

    /// Whether checkpoints are written before the end of the session.
    pub(in crate::ground) fn saves_on_the_way(&self) -> bool {
        self.interval < u64::MAX
    }

    /// Whether a checkpoint is due.
    pub(in crate::ground) fn is_due(&self) -> bool {
        self.since_attempt >= self.wait
    }

    /// Ledger entries since the last call.
    pub(in crate::ground) fn take_posts(&self) -> LedgerReport<VisibilityReason> {
        self.posts.take()
    }

    /// Notes in the raw archive what the newest checkpoint holds: so many bytes of what came this session. Without that note they
    /// are read once more after a restart.
    pub(in crate::ground) fn mark_packets(&self, passed: u64) {
        if let (Some(packets), Some(newest)) = (&self.packets, self.folder.newest()) {
            let _ = packets.record_checkpoint(newest, passed, &self.folder.numbers());
        }
    }

    /// Writes a checkpoint, and keeps what became of it. After a failure everything is still there to be written again.
    pub(in crate::ground) fn checkpoint(
        &mut self,
        collector: &Collector,
        (calibrator, gate): (&Calibrator, Option<&PassGate>),
        accumulator: &mut Accumulator,
    ) -> Result<(), GroundError> {
        let begun = Instant::now();
        let written = self.write(collector, (calibrator, gate), accumulator);
        let failed_before = self.saving.update(written.as_ref().err(), begun);
        self.since_attempt = 0;
        self.wait = match (&written, failed_before) {
            (Ok(()), _) => self.interval,
            (Err(_), false) => (self.interval / RETRIES).max(1),
            (Err(_), true) => self.wait.saturating_mul(2).min(self.interval),
        };
        written
    }

    /// Whether the only checkpoint of the folder is the one that would be written now: the sums follow from its journal.
    pub(in crate::ground) fn is_written(
        &self,
        collector: &Collector,
        (calibrator, gate): (&Calibrator, Option<&PassGate>),
        accumulator: &Accumulator,
    ) -> Result<bool, GroundError> {
        let found = checkpoints(self.folder.path())?;
        let [only] = &found[..] else { return Ok(false) };
        let no_autos = AutoTable::default();
        let of = ArchiveHeadRef { settings: &self.settings, journal: &self.journal, version: self.version };
        let head = of.view(collector, (calibrator, gate), accumulator, &no_autos);
        checkpoint::is_of_head(only, &head)
    }

    fn write(
        &mut self,
        collector: &Collector,
        (calibrator, gate): (&Calibrator, Option<&PassGate>),
        accumulator: &mut Accumulator,
    ) -> Result<(), GroundError> {
        let no_autos = AutoTable::default();
        let of = ArchiveHeadRef { settings: &self.settings, journal: &self.journal, version: self.version };
        let head = of.view(collector, (calibrator, gate), accumulator, &no_autos);
        let (folder, number) = self.folder.next();
        let place = SegmentPlace { folder: &folder, number };
        self.folder.save(|out, path| {
            let of_file = |error| match error {
                AccumulationError::Io(source) => GroundError::io(path, "write")(source),
                other => other.into(),
            };
            checkpoint::write(out, path, &head, |out| accumulator.write_engines(out, place).map_err(of_file))
        })?;
        self.folder.names(accumulator.segments());
        self.folder.remove_unnamed();
        Ok(())
    }
}

/// The archive's part of a checkpoint's head.
struct ArchiveHeadRef<'a> {
    settings: &'a Vec<(String, String)>,
    journal: &'a Journal,
    version: u32,
}

impl<'a> ArchiveHeadRef<'a> {
    /// The head of a checkpoint.
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
            },
        }
    }
}
