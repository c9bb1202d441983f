//! The ground as one stage: bytes of a downlink to sums.

use std::sync::atomic::Ordering;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use super::archive::{Archive, RecordDraft};
use super::live_view::{Activity, LiveViewWriter};
use super::pass_gate::{PassGate, PassObserver};
use super::promises::SenderPromises;
use super::{Collector, CollectorStep, DeliveredPacket, Delivery, GroundConfig, GroundError, GroundOutcome};
use crate::calibration::{Calibrator, MissingPackets};
use crate::downlink::transport::socket::HeldAnswers;
use crate::downlink::wire::VisibilitiesOutline;
use crate::downlink::{CucTime, PacketHeader, PacketKind};
use crate::frames::{GroundFrame, Instrument, PlacedFrame};
use crate::imaging::{Accumulator, Snapshot};
use crate::ranks::Ranks;
use crate::runtime::{Cancel, Outlet, Stage, Units};

/// Waits before the last checkpoint of a session is tried again: what lacks may be there a moment later.
const LAST_WAITS: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(1)];

/// Steps after which a ground that never rests shows the counters of the reception again; counting gaps takes a while.
const STEPS_SHOWN: u64 = 32;

/// Takes the bytes of a downlink and emits sums.
///
/// Collects packets, each once; places and calibrates their visibilities; adds them to the sums. With an [archive](super::archive) it
/// resumes from earlier sessions and writes checkpoints.
pub struct Ground {
    pub(super) collector: Collector,
    pub(super) calibrator: Calibrator,
    /// If gains are to be found.
    pub(super) gate: Option<PassGate>,
    pub(super) accumulator: Accumulator,
    pub(super) outcome: GroundOutcome,
    pub(super) archive: Option<Archive>,
    /// Ends the work early; see [`Ground::cancelled_by`].
    pub(super) cancel: Cancel,
    /// How long it goes on adding then, if there is no archive.
    pub(super) linger: Duration,
    /// Whether it begins with a snapshot of what earlier sessions have summed.
    pub(super) begins_with_maps: bool,
    /// Steps so far.
    pub(super) steps: u64,
    /// To senders that wait for a checkpoint.
    pub(super) promises: SenderPromises,
    /// For those who look on.
    pub(super) live_view_writer: LiveViewWriter,
}

impl Ground {
    /// A ground that keeps nothing for later sessions.
    ///
    /// # Errors
    /// Calibration that cannot be read.
    pub fn new(config: &GroundConfig) -> Result<Self, GroundError> {
        let gate = config.gate()?;
        let gains = gate.as_ref().map(|gate| gate.gains().clone());
        let outcome = GroundOutcome { gains, ..GroundOutcome::default() };
        Ok(Self {
            collector: Collector::new(config.wait_bytes),
            calibrator: config.calibrator(gate.as_ref(), &outcome.ledger)?,
            gate,
            accumulator: config.accumulator(&outcome.ledger),
            live_view_writer: LiveViewWriter::of(&outcome.live_view),
            outcome,
            archive: None,
            cancel: Cancel::new(),
            linger: Duration::ZERO,
            begins_with_maps: false,
            steps: 0,
            promises: SenderPromises::default(),
        })
    }

    /// Once `cancel` is triggered, visibilities that arrive are no longer added to the sums, which takes time. With an
    /// archive they are held for the next session, as far as the hold buffer has room. Without one they are added for
    /// `linger` yet, and the rest counts as not received. Checkpoint and final sums follow as ever.
    #[must_use]
    #[doc(hidden)]
    pub fn cancelled_by(mut self, cancel: &Cancel, linger: Duration) -> Self {
        self.accumulator = self.accumulator.cancelled_by(cancel);
        Self { cancel: cancel.clone(), linger, ..self }
    }

    /// As one rank's of several: it receives everything, and holds its part of the sums.
    #[must_use]
    #[doc(hidden)]
    pub fn with_ranks(self, ranks: &Ranks) -> Self {
        Self { accumulator: self.accumulator.with_ranks(ranks), ..self }
    }

    /// Sums noise of further realisations as well, one a seed: for final maps of the harmonic engine, without an archive.
    #[must_use]
    #[doc(hidden)]
    pub fn with_noises(self, seeds: &[u64]) -> Self {
        Self { accumulator: self.accumulator.with_noises(seeds), ..self }
    }

    /// Tells senders that wait for it, through `answers`, what its checkpoints hold. To be of use, it needs an archive, and has to take
    /// the stream of the source that shares `answers`, from its beginning.
    #[must_use]
    #[doc(hidden)]
    pub fn answering(self, answers: &HeldAnswers) -> Self {
        Self { promises: self.promises.answering(answers), ..self }
    }

    /// Begins with a snapshot of what earlier sessions have summed, if snapshots are wanted: a ground that was started again has maps at
    /// once, and not when the next one is due.
    #[must_use]
    #[doc(hidden)]
    pub fn beginning_with_maps(self) -> Self {
        Self { begins_with_maps: true, ..self }
    }

    /// Tells `observer` of each pass whose gains it has found, on its own thread.
    #[must_use]
    #[doc(hidden)]
    pub fn observed_by(mut self, observer: PassObserver) -> Self {
        if let Some(gate) = &mut self.gate {
            gate.observed_by(observer);
        }
        self
    }

    /// The ranks that hold parts of the sums.
    #[must_use]
    #[doc(hidden)]
    pub fn ranks(&self) -> &Ranks {
        self.accumulator.ranks()
    }

    /// The instrument, once it is known.
    #[must_use]
    #[doc(hidden)]
    pub fn instrument(&self) -> Option<&Instrument> {
        self.collector.instrument()
    }

    /// What it leaves behind besides its sums.
    #[must_use]
    pub fn outcome(&self) -> GroundOutcome {
        self.outcome.clone()
    }

    /// Applies deliveries until more bytes are needed; writes checkpoints that are due.
    pub(super) fn advance(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        loop {
            match self.archive {
                Some(_) if self.cancel.is_cancelled() => self.collector.set_aside(),
                None if self.cancel.elapsed().is_some_and(|elapsed| elapsed >= self.linger) => return Ok(()),
                _ => {}
            }
            self.catch_up();
            if self.collector.held().is_full() {
                self.close_passes();
            }
            let Self { collector, calibrator, gate, .. } = self;
            let delivery = match collector.next_step(&|outline| is_due(calibrator, gate.as_ref(), outline))? {
                CollectorStep::Waited(delivery) => delivery,
                CollectorStep::Delivery(delivery) => {
                    if let (Some(gate), Some(GroundFrame::Visibilities(block))) = (gate, &delivery.frame) {
                        gate.count_late(block);
                    }
                    delivery
                }
                CollectorStep::Held(header) => {
                    self.note(&header, true);
                    continue;
                }
                CollectorStep::Nothing => return Ok(()),
            };
            self.apply(delivery, out)?;
            if self.archive.as_ref().is_some_and(Archive::is_due) {
                let written = self.checkpoint();
                if self.ranks().are_many() {
                    // Without it the parts of the others are worth nothing.
                    written?;
                }
                // Nothing is lost yet if it fails: the outcome says so, and it is tried again.
            }
        }
    }

    /// Takes note of a packet that waits for its gains; closes the pass that it ends.
    fn note(&mut self, header: &PacketHeader, is_new: bool) {
        let Self { collector, gate: Some(gate), archive, cancel, .. } = self else { return };
        if archive.is_some() && cancel.is_cancelled() {
            // The next session does, in the order of sending.
            return;
        }
        let Some(block) = collector.held().get(header).and_then(|packet| collector.decoded(packet)) else {
            return;
        };
        let ended = gate.ended_by(&block);
        if let Some(which) = ended {
            self.close_pass(which);
        }
        if let Some(gate) = &mut self.gate
            && !gate.note(&block)
            && is_new
        {
            gate.count_late(&block);
        }
    }

    /// Takes note of what was held before the instrument was known, or in an earlier session.
    fn catch_up(&mut self) {
        let Self { collector, gate: Some(gate), .. } = self else { return };
        if !gate.is_behind || collector.instrument().is_none() {
            return;
        }
        gate.is_behind = false;
        let held: Vec<PacketHeader> = collector.held().packets().map(|packet| packet.header).collect();
        held.iter()
            .filter(|header| header.kind == PacketKind::Visibilities)
            .for_each(|header| self.note(header, false));
        self.collector.consider_held();
    }

    fn close_passes(&mut self) {
        let open = self.gate.as_ref().map(PassGate::open_passes).unwrap_or_default();
        open.into_iter().for_each(|which| self.close_pass(which));
    }

    /// Finds the gains of a pass from what has arrived of it, in the order of sending.
    fn close_pass(&mut self, which: usize) {
        let Self { collector, calibrator, gate: Some(gate), .. } = self else { return };
        let waiting =
            collector.held().packets().filter(|packet| packet.header.kind == PacketKind::Visibilities);
        let blocks = waiting.filter_map(|packet| collector.decoded(packet));
        let blocks = blocks.filter(|block| gate.holds(which, block)).collect();
        gate.close(which, blocks, calibrator.ephemeris());
        collector.consider_held();
    }

    /// Takes a delivery through calibration into the sums, and into the journal if there is an archive.
    fn apply(&mut self, delivery: Delivery, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        let Delivery { packets, frame } = delivery;
        if let (Some(GroundFrame::Instrument(instrument)), Some(gate)) = (&frame, &mut self.gate) {
            gate.describe(instrument)?;
        }
        if let Some(GroundFrame::Visibilities(block)) = &frame {
            let bad = packets.iter().map(|packet| u64::from(packet.reading.visibilities_bad_value)).sum();
            self.calibrator.count_bad(block.start, bad);
        }
        let autos = self.live_view_writer.expect_powers(frame.as_ref());
        let used = self.use_frame(&packets, frame, out);
        if let Some((span, autos)) = autos.zip(self.calibrator.autos()) {
            self.live_view_writer.add_powers(span, autos);
        }
        used
    }

    fn use_frame(
        &mut self,
        packets: &[DeliveredPacket],
        frame: Option<GroundFrame>,
        out: &mut Outlet<Snapshot>,
    ) -> Result<(), GroundError> {
        let Some(archive) = &mut self.archive else {
            if let Some(placed) = placed(&mut self.calibrator, frame)? {
                self.live_view_writer.add(&placed);
                self.accumulator.accept(placed, out)?;
            }
            return Ok(());
        };
        let mut draft = RecordDraft::of(frame.as_ref());
        if let Some(placed) = placed(&mut self.calibrator, frame)? {
            draft.offer(&placed);
            self.live_view_writer.add(&placed);
            draft.used_s = self.accumulator.accept(placed, out)?;
        }
        let posted = archive.record(packets, draft, self.calibrator.ephemeris());
        self.outcome.ledger.post_report(&posted);
        Ok(())
    }

    /// Closes open passes, and applies held packets without their positions.
    pub(super) fn flush(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        if !(self.archive.is_some() && self.cancel.is_cancelled()) {
            self.catch_up();
            self.close_passes();
            loop {
                let Self { collector, calibrator, gate, .. } = self;
                let waiting = collector.next_waiting(&|outline| is_due(calibrator, gate.as_ref(), outline));
                let Some(delivery) = waiting else { break };
                self.apply(delivery, out)?;
            }
        }
        while let Some(delivery) = self.collector.flush_next() {
            match &delivery.frame {
                Some(GroundFrame::Visibilities(block))
                    if self.archive.is_some() && self.cancel.is_cancelled() =>
                {
                    self.calibrator.leave_for_later(block);
                }
                _ => self.apply(delivery, out)?,
            }
        }
        Ok(())
    }

    /// Shows the counters of the reception, and what else visitors see.
    fn show(&self, activity: Activity) {
        // First, so that nobody sees counters that are newer.
        self.live_view_writer.show(activity, &self.collector, self.calibrator.ephemeris());
        fill(&self.outcome.reception, self.collector.counters());
        self.outcome.waiting_bytes.store(self.collector.held().waiting_bytes(), Ordering::Relaxed);
    }

    /// Shows what earlier sessions have received, before anything comes.
    pub(super) fn show_state(&mut self, latest_s: Option<f64>) {
        self.live_view_writer.resume(latest_s, &self.collector, self.calibrator.ephemeris());
        fill(&self.outcome.reception, self.collector.counters());
        self.outcome.waiting_bytes.store(self.collector.held().waiting_bytes(), Ordering::Relaxed);
    }

    /// Packets of visibilities that are known to be missing.
    fn missing_packets(&self) -> MissingPackets {
        let latest = self.calibrator.blocks().latest_report().0;
        let reported = self.instrument().zip(latest).map(|(instrument, latest)| {
            // Beyond the range of the time code nothing is made.
            CucTime::new(instrument.epoch_tai_s, latest.time).unwrap_or(CucTime(u64::MAX))
        });
        let mut missing = MissingPackets::default();
        for (_, received) in self.collector.received().filter(|(kind, _)| *kind == PacketKind::Visibilities) {
            let [all, since] = received.missing_since(reported.unwrap_or_default());
            missing = MissingPackets { all, unreported: if reported.is_some() { since } else { all } };
        }
        missing
    }

    /// Writes a checkpoint, if there is an archive.
    pub(super) fn checkpoint(&mut self) -> Result<(), GroundError> {
        let Some(archive) = &mut self.archive else { return Ok(()) };
        let written = archive.checkpoint(
            &self.collector,
            (&self.calibrator, self.gate.as_ref()),
            &mut self.accumulator,
        );
        if written.is_ok() {
            archive.mark_packets(self.promises.bytes);
        }
        self.promises.keep(self.collector.packets(), written.is_ok());
        self.note_unsaved();
        written
    }

    /// Tells how much no checkpoint holds.
    fn note_unsaved(&self) {
        if self.archive.is_some() {
            let has_new = self.promises.has_new(self.collector.packets());
            self.outcome.saving.note_received(self.collector.bytes(), has_new);
        }
    }

    /// Whether what no checkpoint holds has become old; not of a rank, which writes where the others do.
    fn is_old(&self) -> bool {
        let saves = self.archive.as_ref().is_some_and(Archive::saves_on_the_way);
        saves && !self.ranks().are_many() && self.outcome.saving.is_old()
    }

    /// Whether the only checkpoint in the folder is the one that would be written now.
    pub(super) fn is_written(&self) -> Result<bool, GroundError> {
        let Some(archive) = &self.archive else { return Ok(false) };
        archive.is_written(&self.collector, (&self.calibrator, self.gate.as_ref()), &self.accumulator)
    }

    /// Writes the last checkpoint of a session. Maps are made even if it fails for good; the outcome says so. Not so with ranks: see
    /// [`Ground::advance`]; one that was told to end is not where the others are.
    fn last_checkpoint(&mut self) -> Result<(), GroundError> {
        if self.ranks().are_many() {
            return if self.cancel.is_cancelled() { Ok(()) } else { self.checkpoint() };
        }
        for wait in LAST_WAITS {
            if self.checkpoint().is_ok() {
                return Ok(());
            }
            std::thread::sleep(wait);
        }
        let _ = self.checkpoint();
        Ok(())
    }
}

/// Whether visibilities wait for nothing.
fn is_due(calibrator: &Calibrator, gate: Option<&PassGate>, outline: &VisibilitiesOutline) -> bool {
    calibrator.ephemeris().covers(outline.span) && gate.is_none_or(|gate| gate.is_due(outline))
}

fn placed(
    calibrator: &mut Calibrator,
    frame: Option<GroundFrame>,
) -> Result<Option<PlacedFrame>, GroundError> {
    Ok(frame.map(|frame| calibrator.accept(frame)).transpose()?.flatten())
}

impl Stage for Ground {
    type In = Vec<u8>;
    type Out = Snapshot;
    type Error = GroundError;

    fn step(&mut self, bytes: Vec<u8>, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        if std::mem::take(&mut self.begins_with_maps) {
            self.accumulator.emit_resumed(out)?;
        }
        self.collector.push(&bytes);
        self.advance(out)?;
        self.promises.note_bytes(self.collector.bytes());
        self.note_unsaved();
        if self.promises.are_due(self.collector.packets()) || self.is_old() {
            // If it fails, it is tried again while anyone waits.
            let _ = self.checkpoint();
        }
        self.steps += 1;
        if self.steps.is_power_of_two() || self.steps.is_multiple_of(STEPS_SHOWN) {
            self.show(Activity::Working);
        }
        Ok(())
    }

    /// Updates the view when the link falls silent.
    fn rest(&mut self) {
        self.show(Activity::Idle);
    }

    fn finish(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        self.collector.finish();
        self.advance(out)?;
        // The checkpoint keeps held packets as they are; the final maps use them without their positions.
        self.last_checkpoint()?;
        self.flush(out)?;
        fill(&self.outcome.completeness, self.calibrator.close(self.missing_packets()));
        if let Some(archive) = &self.archive {
            self.outcome.ledger.post_report(&archive.take_posts());
        }
        self.show(Activity::Idle);
        fill(&self.outcome.autos, self.calibrator.auto_powers());
        Ok(self.accumulator.finish(out)?)
    }

    fn units(&self) -> Units {
        Units::of(self.collector.bytes(), "bytes")
    }
}

fn fill<T>(place: &Mutex<T>, value: T) {
    *place.lock().unwrap_or_else(PoisonError::into_inner) = value;
}
