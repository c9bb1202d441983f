//! An open archive folder, and the ground stage that resumes from it.

use std::io::ErrorKind;
use std::path::Path;
use std::time::Duration;

use crate::calibration::AutoTable;
use crate::downlink::{DownlinkError, PacketKind};
use crate::frames::{EphemerisSegment, VisibilityReason};
use crate::ground::archive::calibration_state::CalibrationState;
use crate::ground::archive::checkpoint::{self, ArchiveHead};
use crate::ground::archive::folder::StateFolder;
use crate::ground::archive::journal::Journal;
use crate::ground::archive::names::parts_with;
use crate::ground::archive::settings::{require_equal, settings_of};
use crate::ground::archive::store::Archive;
use crate::ground::burst_watch::BurstWatch;
use crate::ground::live_view::LiveViewWriter;
use crate::ground::promises::SenderPromises;
use crate::ground::{Collector, CollectorState, Ground, GroundConfig, GroundError, GroundOutcome};
use crate::imaging::{AccumulationError, Accumulator};
use crate::ranks::{RankShare, Ranks};
use crate::runtime::{Cancel, Ledger};

const SEGMENT: &str = "the visibilities that the checkpoint beside it names";

/// The contents of a checkpoint: data and the journal.
pub(super) struct ArchiveContents {
    pub(super) collector: CollectorState,
    pub(super) ephemeris: Vec<EphemerisSegment>,
    pub(super) autos: AutoTable,
    pub(super) accumulator: Accumulator,
    pub(super) journal: Journal,
    pub(super) calibration: CalibrationState,
}

impl ArchiveContents {
    pub(super) fn empty(config: &GroundConfig, posts: &Ledger<VisibilityReason>) -> Self {
        Self {
            collector: CollectorState::new(config.wait_bytes),
            ephemeris: Vec::new(),
            autos: AutoTable::default(),
            accumulator: config.accumulator(posts),
            journal: Journal::default(),
            calibration: CalibrationState::default(),
        }
    }

    /// Adds the records, sums and other data of another archive.
    ///
    /// # Errors
    /// A different instrument; a packet of visibilities in both journals.
    pub(super) fn merge(&mut self, other: Self) -> Result<(), GroundError> {
        if self.calibration.is_solved() || other.calibration.is_solved() {
            return Err(GroundError::SeparateSolutions);
        }
        self.calibration.version = self.calibration.version.max(other.calibration.version);
        self.calibration.bursts.extend(other.calibration.bursts);
        self.calibration.searched.extend(other.calibration.searched);
        self.journal.merge(other.journal).map_err(|count| {
            let apid = PacketKind::Visibilities.apid();
            DownlinkError::DuplicatePacket { apid, count }
        })?;
        self.collector.merge(other.collector, |header| self.journal.contains(header))?;
        // If two segments start at the same time, the first is used.
        self.ephemeris.extend(other.ephemeris);
        self.autos.merge(other.autos);
        Ok(self.accumulator.merge(other.accumulator)?)
    }
}

/// Reads all parts of a checkpoint into a copy of the accumulator `empty`, after `check` has accepted its head.
fn read_parts(
    path: &Path,
    empty: &Accumulator,
    check: impl Fn(&ArchiveHead) -> Result<(), GroundError>,
) -> Result<(ArchiveHead, Accumulator), GroundError> {
    let read_part = |path: &Path, part: RankShare, empty: Accumulator| {
        checkpoint::read(path, |head, from| {
            check(&head)?;
            let sums = empty.resume_share(head.accumulator.clone(), from, path.parent(), part);
            Ok((head, sums.map_err(|error| unreadable(path, error))?))
        })
    };
    let mut whole: Option<(ArchiveHead, Accumulator)> = None;
    for (path, part) in parts_with(path) {
        let (head, sums) = read_part(&path, part, empty.without_data())?;
        match &mut whole {
            None => whole = Some((head, sums)),
            Some((first, _)) if first.checksum != head.checksum => {
                let found = "a different state from that of the first part".to_owned();
                return Err(GroundError::Damaged { path, found, expected: "parts of one checkpoint" });
            }
            Some((_, joined)) => joined.add_rank_share(sums)?,
        }
    }
    whole.ok_or_else(|| GroundError::without_checkpoint(path))
}

/// Converts an error of reading sums. Data that end too early are damaged; an error of the system does not mean damage.
fn unreadable(path: &Path, error: AccumulationError) -> GroundError {
    match error {
        AccumulationError::Io(source) if source.kind() != ErrorKind::UnexpectedEof => {
            GroundError::io(path, "read")(source)
        }
        AccumulationError::Segment { path, found } => GroundError::Damaged { path, found, expected: SEGMENT },
        other => other.into(),
    }
}

/// An open folder and the contents of its newest usable checkpoint.
pub(super) struct OpenArchive {
    pub(super) folder: StateFolder,
    contents: Option<ArchiveContents>,
    notes: Vec<String>,
    settings: Vec<(String, String)>,
    posts: Ledger<VisibilityReason>,
}

impl OpenArchive {
    /// Opens a folder. Damaged checkpoints are renamed if `renames_damaged`.
    pub(super) fn new(
        folder: &Path,
        config: &GroundConfig,
        renames_damaged: bool,
    ) -> Result<Self, GroundError> {
        Self::with_ranks(folder, config, renames_damaged, &Ranks::single())
    }

    /// Like [`OpenArchive::new`], as one of several ranks.
    pub(super) fn with_ranks(
        folder: &Path,
        config: &GroundConfig,
        renames_damaged: bool,
        ranks: &Ranks,
    ) -> Result<Self, GroundError> {
        if config.map.holds_visibilities() && ranks.is_distributed() {
            return Err(AccumulationError::HeldByRank.into());
        }
        if !config.map.movers.is_empty() {
            return Err(AccumulationError::Movers { what: "a saved state" }.into());
        }
        let mut folder = match renames_damaged || ranks.is_distributed() {
            true => StateFolder::open_with_ranks(folder, ranks)?,
            false => StateFolder::open_to_read(folder)?,
        };
        let settings = settings_of(config)?;
        let posts = Ledger::new();
        let (contents, notes) = folder.load(renames_damaged, |path| {
            let empty = config.accumulator(&posts).with_ranks(ranks);
            let (head, accumulator) =
                read_parts(path, &empty, |head| require_equal(path, &head.settings, &settings))?;
            let ArchiveHead { collector, ephemeris, autos, journal, calibration, .. } = head;
            Ok(ArchiveContents { collector, ephemeris, autos, accumulator, journal, calibration })
        })?;
        if let Some(contents) = &contents {
            folder.set_segments(contents.accumulator.segments());
        }
        Ok(Self { folder, contents, notes, settings, posts })
    }

    /// Moves the contents to another folder, which is new.
    pub(super) fn move_to(&mut self, folder: StateFolder) {
        self.folder = folder;
        if let Some(contents) = &mut self.contents {
            contents.accumulator.forget_segments();
        }
    }

    pub(super) fn merge(&mut self, other: Self) -> Result<(), GroundError> {
        self.notes.extend(other.notes);
        match (&mut self.contents, other.contents) {
            (Some(ours), Some(theirs)) => return ours.merge(theirs),
            (None, theirs) => self.contents = theirs,
            _ => {}
        }
        Ok(())
    }

    pub(super) fn resume(self, config: &GroundConfig, interval: u64) -> Result<Ground, GroundError> {
        let Self { folder, contents, notes, settings, posts } = self;
        let contents = contents.unwrap_or_else(|| ArchiveContents::empty(config, &posts));
        let ArchiveContents { collector, ephemeris, autos, accumulator, journal, calibration } = contents;
        // Needed for a new archive.
        let mut accumulator = accumulator.with_ranks(folder.ranks());
        let mut outcome = GroundOutcome::default();
        outcome.saving.begin();
        outcome.ledger.post_report(&journal.ledger());
        accumulator.restore_spans(&journal.spans_s());
        let instrument = collector.instrument().cloned();
        let mut gate = config.gate()?;
        if let Some(instrument) = instrument.as_ref().filter(|_| !config.map.prior_files.is_empty()) {
            config.map.check_priors(&config.described(instrument)?)?;
        }
        if let (Some(gate), Some(instrument)) = (&mut gate, &instrument) {
            gate.describe(instrument)?;
            gate.resume(calibration.passes);
        }
        outcome.gains = gate.as_ref().map(|gate| gate.gains().clone());
        let calibrator = config.calibrator(gate.as_ref(), &posts)?;
        calibrator.bursts().resume(calibration.bursts, calibration.searched);
        outcome.bursts = calibrator.bursts().clone();
        let calibrator = calibrator.resume(instrument, ephemeris, autos, journal.blocks());
        let collector = Collector::resume(collector, journal.delivered(), journal.reception());
        let (interval, saving, version) = (interval.max(1), outcome.saving.clone(), calibration.version);
        let (wait, since_attempt) = (interval, 0);
        let archive = Archive {
            folder,
            settings,
            version,
            journal,
            notes,
            posts,
            interval,
            wait,
            since_attempt,
            saving,
            packets: None,
        };
        let (cancel, cancel_grace, steps) = (Cancel::new(), Duration::ZERO, 0);
        let promises = SenderPromises::since(collector.packets());
        let live_view_writer = LiveViewWriter::new(&outcome.live_view);
        Ok(Ground {
            collector,
            calibrator,
            gate,
            accumulator,
            outcome,
            archive: Some(archive),
            cancel,
            cancel_grace,
            has_initial_snapshot: false,
            steps,
            promises,
            live_view_writer,
            burst_watch: BurstWatch::default(),
        })
    }
}
