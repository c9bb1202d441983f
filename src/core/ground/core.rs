//! The ground stage, which turns the bytes of a downlink into sums.

use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::archive::{Archive, RecordDraft};
use super::burst_watch::{BurstWatch, WatchedBlock};
use super::live_view::{Activity, LiveViewWriter};
use super::pass_gate::{PassGate, PassObserver};
use super::promises::SenderPromises;
use super::{Collector, CollectorStep, DeliveredPacket, Delivery, GroundConfig, GroundError, GroundOutcome};
use crate::calibration::{BurstChoice, BurstSearch, Calibrator, DividedBlock, MissingPackets};
use crate::downlink::transport::socket::HeldAnswers;
use crate::downlink::wire::VisibilitiesOutline;
use crate::downlink::{CucTime, PacketHeader, PacketKind};
use crate::frames::{AutoPower, GroundFrame, Instrument, PlacedFrame, VisibilityReason};
use crate::imaging::{Accumulator, Snapshot};
use crate::ranks::Ranks;
use crate::runtime::{Cancel, Outlet, Stage, Units};
use crate::units::vector::Vec3;

/// Pauses between attempts to write the last checkpoint of a session, as a shortage may pass.
const LAST_CHECKPOINT_PAUSES: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(1)];

/// Steps between updates of the shown counters while data arrive without pause, and at powers of two, so that a short run shows something.
/// Counting gaps takes a while.
const STEPS_PER_UPDATE: u64 = 32;

/// The ground stage: takes the bytes of a downlink and emits sums.
///
/// Collects each packet once, adds positions to its visibilities, calibrates them and adds them to the sums. With an
/// [archive](super::archive) it resumes from earlier sessions and writes checkpoints.
pub struct Ground {
    pub(super) collector: Collector,
    pub(super) calibrator: Calibrator,
    /// Holds visibilities back until the gains of their pass are solved; `None` if gains are not solved here.
    pub(super) gate: Option<PassGate>,
    pub(super) accumulator: Accumulator,
    pub(super) outcome: GroundOutcome,
    /// The state on disk: journal, checkpoints, raw archive.
    pub(super) archive: Option<Archive>,
    pub(super) cancel: Cancel,
    /// Time for which visibilities are still added after cancellation, without an archive.
    pub(super) cancel_grace: Duration,
    /// Whether the sums of earlier sessions are emitted as a snapshot at the start.
    pub(super) has_initial_snapshot: bool,
    pub(super) steps: u64,
    pub(super) promises: SenderPromises,
    pub(super) live_view_writer: LiveViewWriter,
    pub(super) burst_watch: BurstWatch,
}

impl Ground {
    /// A ground stage without an archive.
    ///
    /// # Errors
    /// A calibration that cannot be read.
    pub fn new(config: &GroundConfig) -> Result<Self, GroundError> {
        let gate = config.gate()?;
        let gains = gate.as_ref().map(|gate| gate.gains().clone());
        let calibrator = |outcome: &GroundOutcome| config.calibrator(gate.as_ref(), &outcome.ledger);
        let outcome = GroundOutcome { gains, ..GroundOutcome::default() };
        let calibrator = calibrator(&outcome)?;
        let outcome = GroundOutcome { bursts: calibrator.bursts().clone(), ..outcome };
        Ok(Self {
            collector: Collector::new(config.wait_bytes),
            calibrator,
            gate,
            accumulator: config.accumulator(&outcome.ledger),
            live_view_writer: LiveViewWriter::new(&outcome.live_view),
            outcome,
            archive: None,
            cancel: Cancel::new(),
            cancel_grace: Duration::ZERO,
            has_initial_snapshot: false,
            steps: 0,
            promises: SenderPromises::default(),
            burst_watch: BurstWatch::default(),
        })
    }

    /// Stops adding visibilities to the sums once `cancel` is triggered.
    ///
    /// With an archive, later visibilities are held for the next session, while the hold buffer has room. Without one
    /// they are still added for `grace`, and the rest counts as not received. The last checkpoint and the final sums follow.
    #[must_use]
    #[doc(hidden)]
    pub fn with_cancel(mut self, cancel: &Cancel, grace: Duration) -> Self {
        self.accumulator = self.accumulator.cancelled_by(cancel);
        Self { cancel: cancel.clone(), cancel_grace: grace, ..self }
    }

    /// Makes the stage one of several ranks: it receives all data and holds its part of the sums.
    #[must_use]
    #[doc(hidden)]
    pub fn with_ranks(self, ranks: &Ranks) -> Self {
        Self { accumulator: self.accumulator.with_ranks(ranks), ..self }
    }

    /// Also accumulates additional noise realisations, one per seed. Only for final maps of the harmonic engine, without an archive.
    #[must_use]
    #[doc(hidden)]
    pub fn with_noise_realisations(self, seeds: &[u64]) -> Self {
        Self { accumulator: self.accumulator.with_noise_realisations(seeds), ..self }
    }

    /// Reports through `answers` which data the checkpoints hold, for senders that wait for it. It needs an archive, and has to read the
    /// source that shares `answers` from its first byte.
    #[must_use]
    #[doc(hidden)]
    pub fn with_answers(self, answers: &HeldAnswers) -> Self {
        Self { promises: self.promises.with_answers(answers), ..self }
    }

    /// Emits the sums of earlier sessions as a snapshot at the start, if snapshots are enabled. After a restart, maps are then
    /// available at once.
    #[must_use]
    #[doc(hidden)]
    pub fn with_initial_snapshot(self) -> Self {
        Self { has_initial_snapshot: true, ..self }
    }

    /// Keeps the daughters' total powers with their positions in [`GroundOutcome::placed_autos`].
    #[must_use]
    #[doc(hidden)]
    pub fn with_placed_autos(mut self) -> Self {
        self.outcome.placed_autos = Some(Arc::default());
        self
    }

    /// The daughters' total powers with their positions, where the ephemeris has them.
    pub(super) fn placed_autos(&self) -> Vec<(AutoPower, Vec3)> {
        let ephemeris = self.calibrator.ephemeris();
        let place = |power: AutoPower| {
            Some((power, ephemeris.position_at(power.time_s, usize::from(power.daughter))?))
        };
        self.calibrator.auto_powers().into_iter().filter_map(place).collect()
    }

    /// Calls `observer` on the thread of the stage after the gains of each pass are solved.
    #[must_use]
    #[doc(hidden)]
    pub fn with_observer(mut self, observer: PassObserver) -> Self {
        if let Some(gate) = &mut self.gate {
            gate.set_observer(observer);
        }
        self
    }

    /// The ranks among which the sums are divided.
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

    /// The results other than the sums.
    #[must_use]
    pub fn outcome(&self) -> GroundOutcome {
        self.outcome.clone()
    }

    /// Applies deliveries until more bytes are needed; writes checkpoints that are due.
    pub(super) fn advance(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        loop {
            match self.archive {
                Some(_) if self.cancel.is_cancelled() => self.collector.hold_for_next_session(),
                None if self.cancel.elapsed().is_some_and(|elapsed| elapsed >= self.cancel_grace) => {
                    self.outcome.left_data.store(true, Ordering::Relaxed);
                    return Ok(());
                }
                _ => {}
            }
            self.register_all_held();
            if self.collector.held().is_full() {
                self.solve_open_passes();
            }
            let Self { collector, calibrator, gate, .. } = self;
            let delivery = match collector
                .next_step(&|outline| is_ready(calibrator, gate.as_ref(), outline))?
            {
                CollectorStep::Released(delivery) => delivery,
                CollectorStep::Direct(delivery) => {
                    // They need not wait: the gains of their pass were solved before they came.
                    if let (Some(gate), Some(GroundFrame::Visibilities(block))) = (gate, &delivery.frame) {
                        gate.count_late(block);
                    }
                    delivery
                }
                CollectorStep::Held(header) => {
                    self.register(&header, true);
                    continue;
                }
                CollectorStep::NeedsBytes => return Ok(()),
            };
            self.apply(delivery, out)?;
            if self.archive.as_ref().is_some_and(Archive::is_due) {
                // A failure loses no data: the outcome reports it, and the next attempt follows.
                let written = self.checkpoint();
                if self.ranks().is_distributed() {
                    // Without it the parts of the other ranks are useless.
                    written?;
                }
            }
        }
    }

    /// Registers a packet that waits for its gains; if it ends a pass, solves for the gains of that.
    fn register(&mut self, header: &PacketHeader, is_new: bool) {
        let Self { collector, gate: Some(gate), archive, cancel, .. } = self else { return };
        if archive.is_some() && cancel.is_cancelled() {
            // The next session registers them, in the order of sending.
            return;
        }
        let Some(block) = collector.held().get(header).and_then(|packet| collector.decoded(packet)) else {
            return;
        };
        let ended = gate.ended_by(&block);
        if let Some(which) = ended {
            self.solve_gains_of_pass(which);
        }
        if let Some(gate) = &mut self.gate
            && !gate.register(&block)
            && is_new
        {
            gate.count_late(&block);
        }
    }

    /// Registers packets that were held before the instrument was known, or in an earlier session.
    fn register_all_held(&mut self) {
        let Self { collector, gate: Some(gate), .. } = self else { return };
        if !gate.must_register_held || collector.instrument().is_none() {
            return;
        }
        gate.must_register_held = false;
        let held: Vec<PacketHeader> = collector.held().packets().map(|packet| packet.header).collect();
        held.iter()
            .filter(|header| header.kind == PacketKind::Visibilities)
            .for_each(|header| self.register(header, false));
        self.collector.recheck_held();
    }

    fn solve_open_passes(&mut self) {
        let open = self.gate.as_ref().map(PassGate::open_passes).unwrap_or_default();
        open.into_iter().for_each(|which| self.solve_gains_of_pass(which));
    }

    /// Solves for the gains of a pass with the packets held, in the order of sending.
    fn solve_gains_of_pass(&mut self, which: usize) {
        let Self { collector, calibrator, gate: Some(gate), .. } = self else { return };
        let waiting =
            collector.held().packets().filter(|packet| packet.header.kind == PacketKind::Visibilities);
        let blocks = waiting.filter_map(|packet| collector.decoded(packet));
        let blocks = blocks.filter(|block| gate.holds(which, block)).collect();
        gate.close(which, blocks, calibrator.ephemeris());
        collector.recheck_held();
    }

    /// Calibrates a delivery, adds it to the sums and, if there is an archive, to the journal.
    fn apply(&mut self, delivery: Delivery, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        let Delivery { packets, frame } = delivery;
        if let (Some(GroundFrame::Instrument(instrument)), Some(gate)) = (&frame, &mut self.gate) {
            gate.describe(instrument)?;
        }
        if let Some(GroundFrame::Visibilities(block)) = &frame {
            let bad = packets.iter().map(|packet| u64::from(packet.counts.visibilities_bad_value)).sum();
            self.calibrator.count_bad(block.start, bad);
        }
        let span = self.live_view_writer.auto_span(frame.as_ref());
        let used = self.use_frame(&packets, frame, out);
        if let Some((span, autos)) = span.zip(self.calibrator.autos()) {
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
        let mut draft = RecordDraft::new(frame.as_ref());
        let placed = calibrate(&mut self.calibrator, frame)?;
        if let Some(mut placed) = placed {
            if self.burst_watch.is_ended_by(&placed) {
                let known = self.outcome.bursts.len();
                self.take_out_bursts()?;
                // If the pass ended only because the watch was full, this block belongs to it, too.
                if let PlacedFrame::Visibilities(placed) = &mut placed {
                    self.calibrator.take_bursts_out(placed, known);
                }
            }
            draft.offer(&placed);
            self.live_view_writer.add(&placed);
            let watched = match &placed {
                PlacedFrame::Visibilities(placed)
                    if self.outcome.bursts.choice() != BurstChoice::Off
                        && self.accumulator.maps(placed.channel) =>
                {
                    Some(placed.clone())
                }
                _ => None,
            };
            draft.used_span_s = self.accumulator.accept(placed, out)?;
            if let Some(watched) = watched {
                self.burst_watch.keep(watched, packets, draft.used_span_s.is_some());
                self.burst_watch.alert(&self.outcome.bursts, false);
            }
        }
        if let Some(archive) = &mut self.archive {
            let posted = archive.record(packets, draft, self.calibrator.ephemeris());
            self.outcome.ledger.post_report(&posted);
        }
        Ok(())
    }

    /// Judges the visibilities of the open pass, and takes those in bursts out of the sums.
    fn take_out_bursts(&mut self) -> Result<(), GroundError> {
        let Some(instrument) = self.collector.instrument() else { return Ok(()) };
        let search = BurstSearch {
            moon_radius_m: instrument.moon_radius_m,
            epoch_tai_s: instrument.epoch_tai_s,
            choice: self.outcome.bursts.choice(),
        };
        let bursts = self.outcome.bursts.clone();
        // Those known before were applied when the visibilities arrived.
        let known = bursts.len();
        for WatchedBlock { placed, sent, is_used } in self.burst_watch.end(search, &bursts) {
            let divided = bursts.divided(&placed, known);
            let Some(DividedBlock { used, left_out, as_received, peeled }) = divided else { continue };
            // Those in a burst leave the sums; where its flux is known they come back without it.
            let mut removed = 0;
            if is_used {
                removed += self.accumulator.remove(&left_out)?.visibilities;
                removed += self.accumulator.remove(&as_received)?.visibilities;
                removed = removed.saturating_sub(self.accumulator.put_back(&peeled)?.visibilities);
            }
            self.outcome.ledger.move_to_left_out(VisibilityReason::Burst, removed);
            if let Some((archive, sent)) = self.archive.as_mut().zip(sent) {
                archive.reflag(sent, &used, removed);
            }
        }
        Ok(())
    }

    /// Closes open passes, and applies all held packets: visibilities without positions are counted as such.
    pub(super) fn flush(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        if !(self.archive.is_some() && self.cancel.is_cancelled()) {
            self.register_all_held();
            self.solve_open_passes();
            loop {
                let Self { collector, calibrator, gate, .. } = self;
                let released =
                    collector.next_released(&|outline| is_ready(calibrator, gate.as_ref(), outline));
                let Some(delivery) = released else { break };
                self.apply(delivery, out)?;
            }
        }
        while let Some(delivery) = self.collector.flush_next() {
            match &delivery.frame {
                Some(GroundFrame::Visibilities(block))
                    if self.archive.is_some() && self.cancel.is_cancelled() =>
                {
                    self.outcome.left_data.store(true, Ordering::Relaxed);
                    self.calibrator.count_for_next_session(block);
                }
                _ => self.apply(delivery, out)?,
            }
        }
        Ok(())
    }

    fn show(&self, activity: Activity) {
        // First, so that no visitor sees counters newer than the view.
        self.live_view_writer.show(activity, &self.collector, self.calibrator.ephemeris());
        store(&self.outcome.reception, self.collector.counters());
        self.outcome.waiting_bytes.store(self.collector.held().waiting_bytes(), Ordering::Relaxed);
    }

    /// Shows the state of earlier sessions before new data arrive.
    pub(super) fn show_state(&mut self, latest_s: Option<f64>) {
        self.live_view_writer.resume(latest_s, &self.collector, self.calibrator.ephemeris());
        store(&self.outcome.reception, self.collector.counters());
        self.outcome.waiting_bytes.store(self.collector.held().waiting_bytes(), Ordering::Relaxed);
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
        self.promises.note_checkpoint(self.collector.packets(), written.is_ok());
        self.note_unsaved();
        written
    }

    /// Updates the amount of data that no checkpoint holds.
    fn note_unsaved(&self) {
        if self.archive.is_some() {
            let has_new = self.promises.has_new(self.collector.packets());
            self.outcome.saving.note_received(self.collector.bytes(), has_new);
        }
    }

    /// Whether a checkpoint is due by the age of unsaved data. Ranks have to write at the same place of the stream, not by the clock.
    fn has_old_unsaved_data(&self) -> bool {
        let saves = self.archive.as_ref().is_some_and(Archive::saves_during_session);
        saves && !self.ranks().is_distributed() && self.outcome.saving.is_old()
    }

    /// Whether the only checkpoint in the folder is the one that would be written now.
    pub(super) fn is_written(&self) -> Result<bool, GroundError> {
        let Some(archive) = &self.archive else { return Ok(false) };
        archive.is_written(&self.collector, (&self.calibrator, self.gate.as_ref()), &self.accumulator)
    }

    /// Writes the last checkpoint of a session. If all attempts fail, the outcome reports it and maps are still made.
    ///
    /// With ranks, a failure is an error. A cancelled rank writes none, as it stopped at another place of the stream than the others.
    fn last_checkpoint(&mut self) -> Result<(), GroundError> {
        if self.ranks().is_distributed() {
            return if self.cancel.is_cancelled() { Ok(()) } else { self.checkpoint() };
        }
        for pause in LAST_CHECKPOINT_PAUSES {
            if self.checkpoint().is_ok() {
                return Ok(());
            }
            std::thread::sleep(pause);
        }
        let _ = self.checkpoint();
        Ok(())
    }
}

/// Counts the packets of visibilities that are known to be missing.
pub(super) fn missing_packets(collector: &Collector, calibrator: &Calibrator) -> MissingPackets {
    let latest = calibrator.blocks().latest_report().0;
    let reported = collector.instrument().zip(latest).map(|(instrument, latest)| {
        // No packet is made beyond the range of the time code.
        CucTime::new(instrument.epoch_tai_s, latest.time).unwrap_or(CucTime(u64::MAX))
    });
    let mut missing = MissingPackets::default();
    for (_, received) in collector.received().filter(|(kind, _)| *kind == PacketKind::Visibilities) {
        let [all, since] = received.missing_since(reported.unwrap_or_default());
        missing = MissingPackets { all, unreported: if reported.is_some() { since } else { all } };
    }
    missing
}

/// Whether visibilities can be applied: their positions and gains are known.
fn is_ready(calibrator: &Calibrator, gate: Option<&PassGate>, outline: &VisibilitiesOutline) -> bool {
    calibrator.ephemeris().covers(outline.span) && gate.is_none_or(|gate| gate.is_due(outline))
}

fn calibrate(
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
        if std::mem::take(&mut self.has_initial_snapshot) {
            self.accumulator.emit_resumed(out)?;
        }
        self.collector.push(&bytes);
        self.advance(out)?;
        self.promises.note_bytes(self.collector.bytes());
        self.note_unsaved();
        if self.promises.are_due(self.collector.packets()) || self.has_old_unsaved_data() {
            // After a failure the next attempt follows while a sender waits.
            let _ = self.checkpoint();
        }
        self.steps += 1;
        if self.steps.is_power_of_two() || self.steps.is_multiple_of(STEPS_PER_UPDATE) {
            self.show(Activity::Working);
        }
        Ok(())
    }

    fn idle(&mut self) {
        self.burst_watch.alert(&self.outcome.bursts, true);
        self.show(Activity::Idle);
    }

    fn finish(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), GroundError> {
        self.collector.finish();
        self.advance(out)?;
        self.take_out_bursts()?;
        // The checkpoint keeps held packets held. The final maps use those of their visibilities that have positions.
        self.last_checkpoint()?;
        self.flush(out)?;
        self.take_out_bursts()?;
        store(
            &self.outcome.completeness,
            self.calibrator.post_losses(missing_packets(&self.collector, &self.calibrator)),
        );
        if let Some(archive) = &self.archive {
            self.outcome.ledger.post_report(&archive.take_posts());
        }
        self.show(Activity::Idle);
        store(&self.outcome.autos, self.calibrator.auto_powers());
        if let Some(placed) = &self.outcome.placed_autos {
            store(placed, self.placed_autos());
        }
        Ok(self.accumulator.finish(out)?)
    }

    fn units(&self) -> Units {
        Units::of(self.collector.bytes(), "bytes")
    }
}

fn store<T>(shared: &Mutex<T>, value: T) {
    *shared.lock().unwrap_or_else(PoisonError::into_inner) = value;
}
