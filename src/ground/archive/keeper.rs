//! The ground stage from bytes to sums that remembers what it has done.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::PoisonError;

use super::checkpoint;
use super::checkpoint::HeadView;
use super::error::StateError;
use super::folder::{StateFolder, checkpoints};
use super::journal::{Journal, OtherLine, digest};
use super::settings::{compare, settings_of};
use crate::accumulation::{Accumulator, Snapshot};
use crate::calibration::Calibrator;
use crate::downlink::{DownlinkError, Kind, PacketHeader};
use crate::frames::{
    GroundFrame, Instrument, PlacedFrame, PlacedVisibilities, VisibilityBlock, VisibilityReason,
};
use crate::ground::{Collector, Delivery};
use crate::pipeline::config::Config;
use crate::pipeline::ground_segment::{GroundOutcome, stages};
use crate::runtime::{Ledger, LedgerReport, Outlet, Stage, Units};

/// Takes the bytes of a downlink and emits sums; everything in between is in its checkpoints.
pub struct Keeper {
    folder: StateFolder,
    notes: Vec<String>,
    settings: Vec<(String, String)>,
    pub(super) collector: Collector,
    pub(super) calibrator: Calibrator,
    pub(super) accumulator: Accumulator,
    pub(super) journal: Journal,
    pub(super) outcome: GroundOutcome,
    /// What becomes of the packet that is being applied.
    tally: Ledger<VisibilityReason>,
    checkpoint_every: u64,
    since_checkpoint: u64,
}

impl Keeper {
    /// A keeper that goes on from the newest checkpoint in `folder`, or from nothing if there is none.
    ///
    /// A checkpoint is written whenever `checkpoint_every` visibilities have been taken, and at the end. A new state
    /// lets visibilities wait for their positions until `wait_bytes` of them do.
    ///
    /// # Errors
    /// A folder that cannot be used or is in use; a state that was summed with other settings, or of which no
    /// checkpoint holds; calibration that cannot be read.
    pub fn open(
        folder: &Path,
        config: &Config,
        wait_bytes: u64,
        checkpoint_every: u64,
    ) -> Result<Self, StateError> {
        Self::load(folder, config, (wait_bytes, checkpoint_every), true)
    }

    /// As [`Keeper::open`]; checkpoints that do not hold get another name if they are to be set aside.
    fn load(
        folder: &Path,
        config: &Config,
        (wait_bytes, checkpoint_every): (u64, u64),
        sets_aside: bool,
    ) -> Result<Self, StateError> {
        let mut folder = StateFolder::open(folder)?;
        let settings = settings_of(config)?;
        let outcome = GroundOutcome::default();
        let read = |path: &Path| {
            checkpoint::read(path, |head, engines| {
                compare(path, &head.settings, &settings)?;
                let tally = Ledger::new();
                let (calibrator, accumulator) = stages(config, &tally, &outcome)?;
                let accumulator = accumulator.resume(head.accumulator, engines)?;
                let mut calibrator = calibrator.resume(head.calibrator, head.powers);
                for entry in head.journal.entries() {
                    calibrator.has_used(entry.channel, entry.pair, entry.start);
                }
                let collector = Collector::resume(head.collector);
                Ok((collector, calibrator, accumulator, head.journal, head.ledger, tally))
            })
        };
        let (found, notes) = folder.load(sets_aside, read)?;
        let (collector, calibrator, accumulator, journal, ledger, tally) = match found {
            Some(found) => found,
            None => {
                let tally = Ledger::new();
                let (calibrator, accumulator) = stages(config, &tally, &outcome)?;
                let collector = Collector::new(wait_bytes);
                (collector, calibrator, accumulator, Journal::default(), LedgerReport::default(), tally)
            }
        };
        outcome.ledger.post_report(&ledger);
        Ok(Self {
            folder,
            notes,
            settings,
            collector,
            calibrator,
            accumulator,
            journal,
            outcome,
            tally,
            checkpoint_every: checkpoint_every.max(1),
            since_checkpoint: 0,
        })
    }

    /// Puts states together into a new one, in the folder `into`; those of `parts` stay as they are.
    ///
    /// # Errors
    /// A folder that holds a state already; a state that is named twice; states of different instruments or settings, or
    /// that hold the same visibilities.
    pub fn merge(into: &Path, parts: &[PathBuf], config: &Config) -> Result<Self, StateError> {
        let mut whole: Option<Self> = None;
        let mut seen = BTreeSet::new();
        for path in parts {
            let real = path.canonicalize().map_err(StateError::io(path, "find"))?;
            if !seen.insert(real) {
                return Err(StateError::NamedTwice { path: path.clone() });
            }
            if checkpoints(path)?.is_empty() {
                return Err(StateError::without_checkpoint(path));
            }
            let part = Self::load(path, config, (0, u64::MAX), false)?;
            match &mut whole {
                None => whole = Some(part),
                Some(whole) => whole.absorb(part)?,
            }
        }
        let mut whole = whole.ok_or_else(|| StateError::without_checkpoint(into))?;
        whole.folder = StateFolder::open(into)?;
        if !checkpoints(into)?.is_empty() {
            return Err(StateError::Occupied { path: into.to_owned() });
        }
        whole.advance(&mut Outlet::collect())?;
        whole.checkpoint()?;
        Ok(whole)
    }

    fn absorb(&mut self, part: Self) -> Result<(), StateError> {
        for entry in part.journal.entries() {
            self.calibrator.has_used(entry.channel, entry.pair, entry.start);
        }
        let both = self.journal.absorb(part.journal);
        let both =
            both.map_err(|count| DownlinkError::TakenTwice { apid: Kind::Visibilities.apid(), count })?;
        self.collector.absorb(part.collector.into_state())?;
        for (kind, line) in both {
            self.collector.uncount(kind, 1, u64::from(line.bytes));
        }
        self.calibrator.absorb(part.calibrator);
        self.accumulator.absorb(part.accumulator)?;
        self.outcome.ledger.post_report(&part.outcome.ledger.report());
        self.notes.extend(part.notes);
        Ok(())
    }

    /// The instrument that it knows.
    #[must_use]
    pub fn instrument(&self) -> Option<&Instrument> {
        self.collector.instrument()
    }

    /// Packets of visibilities in its sums.
    #[must_use]
    pub fn packets(&self) -> usize {
        self.journal.entries().count()
    }

    /// What is to be said of checkpoints that do not hold.
    pub fn notes(&self) -> impl Iterator<Item = &str> {
        self.notes.iter().map(String::as_str)
    }

    /// Where its accounts are kept.
    #[must_use]
    pub fn outcome(&self) -> GroundOutcome {
        self.outcome.clone()
    }

    /// Takes what has been read through calibration into the sums.
    fn apply(&mut self, found: Delivery, out: &mut Outlet<Snapshot>) -> Result<(), StateError> {
        let Delivery { packets, frame } = found;
        let visibilities = packets.first().filter(|(header, _)| header.kind == Kind::Visibilities).copied();
        let Some((header, check)) = visibilities else {
            return self.apply_other(&packets, frame);
        };
        let block: Option<VisibilityBlock> = match &frame {
            Some(GroundFrame::Visibilities(block)) => Some(block.clone()),
            _ => None,
        };
        let (mut summed, mut offered) = (digest(&PlacedVisibilities::default()), 0);
        let mut placed = Outlet::collect();
        if let Some(frame) = frame {
            self.since_checkpoint += block.as_ref().map_or(0, |block| block.len() as u64);
            self.calibrator.step(frame, &mut placed)?;
        }
        for frame in placed.into_vec() {
            if let PlacedFrame::Visibilities(placed) = &frame {
                (summed, offered) = (digest(placed), placed.len() as u32);
            }
            self.accumulator.step(frame, out)?;
        }
        let used_s = self.accumulator.take_latest_s();
        let account = self.tally.take();
        self.outcome.ledger.post_report(&account);
        self.journal.keep(header, check, block.as_ref(), (summed, offered, used_s), &account);
        Ok(())
    }

    /// Takes a payload other than visibilities, or a part of one that has been given up.
    fn apply_other(
        &mut self,
        packets: &[(PacketHeader, u32)],
        frame: Option<GroundFrame>,
    ) -> Result<(), StateError> {
        let positions = match &frame {
            Some(GroundFrame::Ephemeris(segment)) => Some(segment.clone()),
            _ => None,
        };
        let mut placed = Outlet::collect();
        if let Some(frame) = frame {
            self.calibrator.step(frame, &mut placed)?;
        }
        for frame in placed.into_vec() {
            self.accumulator.step(frame, &mut Outlet::collect())?;
        }
        let holds =
            positions.filter(|segment| self.calibrator.ephemeris().segment(segment.start) == Some(segment));
        let (Some((first, _)), Some((last, _))) = (packets.first(), packets.last()) else { return Ok(()) };
        let payload = [first.count, last.count];
        for (header, check) in packets {
            let segment = holds.as_ref().map(|segment| segment.start);
            let line = OtherLine { check: *check, bytes: header.bytes as u32, payload, segment };
            self.journal.others.insert((header.kind, (header.time, header.count)), line);
        }
        Ok(())
    }

    /// Applies what has come and need not wait.
    fn advance(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), StateError> {
        loop {
            let ephemeris = self.calibrator.ephemeris();
            let Some(found) = self.collector.next_delivery(&|stretch| ephemeris.covers(stretch))? else {
                return Ok(());
            };
            self.apply(found, out)?;
            if self.since_checkpoint >= self.checkpoint_every {
                self.checkpoint()?;
            }
        }
    }

    /// Forgets all that is not in packets.
    pub(super) fn begin_anew(&mut self, config: &Config) -> Result<(), StateError> {
        (self.calibrator, self.accumulator) = stages(config, &self.tally, &self.outcome)?;
        let _ = self.outcome.ledger.take();
        self.journal = Journal::default();
        Ok(())
    }

    pub(super) fn checkpoint(&mut self) -> Result<(), StateError> {
        self.since_checkpoint = 0;
        let head = HeadView {
            settings: &self.settings,
            collector: self.collector.view(),
            calibrator: self.calibrator.state(),
            accumulator: self.accumulator.state(),
            powers: self.calibrator.powers(),
            ledger: self.outcome.ledger.report(),
            journal: &self.journal,
        };
        let accumulator = &mut self.accumulator;
        self.folder.save(|out, path| {
            checkpoint::write(out, path, &head, |out| {
                accumulator.write_engines(out).map_err(StateError::from)
            })
        })
    }
}

impl Stage for Keeper {
    type In = Vec<u8>;
    type Out = Snapshot;
    type Error = StateError;

    fn step(&mut self, bytes: Vec<u8>, out: &mut Outlet<Snapshot>) -> Result<(), StateError> {
        self.collector.push(&bytes);
        self.advance(out)
    }

    fn finish(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), StateError> {
        self.collector.finish();
        self.advance(out)?;
        // Packets that wait do so in the checkpoint; for now the maps take them in as they are.
        self.checkpoint()?;
        while let Some(found) = self.collector.next_waiting() {
            self.apply(found, out)?;
        }
        self.calibrator.finish(&mut Outlet::collect())?;
        self.outcome.ledger.post_report(&self.tally.take());
        *self.outcome.reception.lock().unwrap_or_else(PoisonError::into_inner) = self.collector.counters();
        Ok(self.accumulator.finish(out)?)
    }

    fn units(&self) -> Units {
        Units::of(self.collector.bytes(), "bytes")
    }
}
