//! The ground stage from bytes to sums that remembers what it has done.

use std::path::{Path, PathBuf};
use std::sync::PoisonError;

use super::error::StateError;
use super::file::{self, Head};
use super::folder::{StateFolder, checkpoints};
use super::journal::JournalEntry;
use crate::accumulation::{Accumulator, Snapshot};
use crate::calibration::Calibrator;
use crate::downlink::{Collector, PacketHeader};
use crate::frames::{GroundFrame, Instrument};
use crate::pipeline::config::Config;
use crate::pipeline::ground::GroundOutcome;
use crate::runtime::{Outlet, Stage, Units};

/// Takes the bytes of a downlink and emits sums; everything in between is in its checkpoints.
pub struct Keeper {
    folder: StateFolder,
    notes: Vec<String>,
    settings: Vec<(String, String)>,
    collector: Collector,
    calibrator: Calibrator,
    accumulator: Accumulator,
    journal: Vec<JournalEntry>,
    outcome: GroundOutcome,
    checkpoint_every: u64,
    since_checkpoint: u64,
}

impl Keeper {
    /// A keeper that goes on from the newest checkpoint in `folder`, or from nothing if there is none.
    ///
    /// A checkpoint is written whenever `checkpoint_every` visibilities have been taken, and at the end. A new state
    /// lets packets wait for those before them until others of `wait_bytes` have come.
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
        let mut folder = StateFolder::open(folder)?;
        let settings = settings_of(config)?;
        let read = |path: &Path| {
            file::read(path, |head, engines| {
                compare(path, &head.settings, &settings)?;
                let outcome = GroundOutcome::default();
                outcome.ledger.post_report(&head.ledger);
                let accumulator = Accumulator::new(config.map.clone(), outcome.ledger.clone());
                let calibration = config.calibration.build(Path::new(""))?;
                let calibrator = Calibrator::new(calibration, outcome.ledger.clone());
                let accumulator = accumulator.resume(head.accumulator, engines)?;
                let calibrator = calibrator.resume(head.calibrator);
                Ok((Collector::resume(head.collector), calibrator, accumulator, head.journal, outcome))
            })
        };
        let (found, notes) = folder.load(read)?;
        let (collector, calibrator, accumulator, journal, outcome) = match found {
            Some(found) => found,
            None => {
                let outcome = GroundOutcome::default();
                let calibration = config.calibration.build(Path::new(""))?;
                let calibrator = Calibrator::new(calibration, outcome.ledger.clone());
                let accumulator = Accumulator::new(config.map.clone(), outcome.ledger.clone());
                (Collector::new(wait_bytes), calibrator, accumulator, Vec::new(), outcome)
            }
        };
        Ok(Self {
            folder,
            notes,
            settings,
            collector,
            calibrator,
            accumulator,
            journal,
            outcome,
            checkpoint_every: checkpoint_every.max(1),
            since_checkpoint: 0,
        })
    }

    /// Puts states together into a new one, in the folder `into`; those of `parts` stay as they are.
    ///
    /// # Errors
    /// A folder that holds a state already; states of different instruments or settings, or that hold the same
    /// visibilities.
    pub fn merge(into: &Path, parts: &[PathBuf], config: &Config) -> Result<Self, StateError> {
        let mut whole: Option<Self> = None;
        for path in parts {
            if checkpoints(path)?.is_empty() {
                return Err(StateError::without_checkpoint(path));
            }
            let part = Self::open(path, config, 0, u64::MAX)?;
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
        self.collector.absorb(part.collector.state())?;
        self.calibrator.absorb(part.calibrator.state());
        self.accumulator.absorb(part.accumulator)?;
        self.outcome.ledger.post_report(&part.outcome.ledger.report());
        self.journal.extend(part.journal);
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
        self.journal.len()
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

    /// Takes a frame through calibration into the sums.
    fn apply(
        &mut self,
        (header, frame): (PacketHeader, GroundFrame),
        out: &mut Outlet<Snapshot>,
    ) -> Result<(), StateError> {
        if let GroundFrame::Visibilities(block) = &frame {
            self.journal.extend(JournalEntry::of(header, block));
            self.since_checkpoint += block.len() as u64;
        }
        let mut placed = Outlet::collect();
        self.calibrator.step(frame, &mut placed)?;
        for frame in placed.into_vec() {
            self.accumulator.step(frame, out)?;
        }
        Ok(())
    }

    /// Applies what has come and is in order.
    fn advance(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), StateError> {
        while let Some(found) = self.collector.next_frame()? {
            self.apply(found, out)?;
            if self.since_checkpoint >= self.checkpoint_every {
                self.checkpoint()?;
            }
        }
        Ok(())
    }

    fn checkpoint(&mut self) -> Result<(), StateError> {
        self.since_checkpoint = 0;
        let head = Head {
            settings: self.settings.clone(),
            collector: self.collector.state(),
            calibrator: self.calibrator.state(),
            accumulator: self.accumulator.state(),
            ledger: self.outcome.ledger.report(),
            journal: self.journal.clone(),
        };
        let accumulator = &self.accumulator;
        self.folder.save(|out, path| {
            file::write(out, path, &head, |out| accumulator.write_engines(out).map_err(StateError::from))
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
        *self.outcome.reception.lock().unwrap_or_else(PoisonError::into_inner) = self.collector.counters();
        Ok(self.accumulator.finish(out)?)
    }

    fn units(&self) -> Units {
        Units::of(self.collector.bytes(), "bytes")
    }
}

/// The settings that shape sums, the contents of the gains file among them.
fn settings_of(config: &Config) -> Result<Vec<(String, String)>, StateError> {
    let mut settings: Vec<(String, String)> =
        config.map.of_sums().into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    settings.push(("calibration.hook".to_owned(), format!("{:?}", config.calibration.hook)));
    if let Some(path) = &config.calibration.gains_file {
        let bytes = std::fs::read(path).map_err(StateError::io(path, "read"))?;
        let sum = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes);
        settings.push(("calibration.gains_file".to_owned(), format!("a file of checksum {sum:016x}")));
    }
    Ok(settings)
}

/// Refuses a state of other settings.
fn compare(path: &Path, found: &[(String, String)], expected: &[(String, String)]) -> Result<(), StateError> {
    let of = |settings: &[(String, String)], key: &str| {
        settings.iter().find(|(k, _)| k == key).map_or("(nothing)".to_owned(), |(_, value)| value.clone())
    };
    for (key, _) in expected.iter().chain(found) {
        let (found, expected) = (of(found, key), of(expected, key));
        if found != expected {
            return Err(StateError::Settings { path: path.to_owned(), key: key.clone(), found, expected });
        }
    }
    Ok(())
}
