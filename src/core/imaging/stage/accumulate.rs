//! Accumulates the normal equations, with sums for each channel. The stage `ground` calls it by [`Accumulator::accept`].

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::Path;
use std::sync::Arc;

use super::snapshot::Snapshot;
use crate::frames::{Instrument, PlacedFrame, PlacedVisibilities, VisibilityReason};
use crate::imaging::SolveError;
use crate::imaging::anywhere::{ArchiveSegment, SegmentFolder};
use crate::imaging::beyond::{BeyondNoise, read_power};
use crate::imaging::circle::SumPart;
use crate::imaging::method::{MapSums, NewOrRefused, SumShare};
use crate::imaging::{AccumulationError, Added, ChannelGroup, MapConfig};
use crate::ranks::{RankShare, Ranks};
use crate::runtime::{Cancel, Ledger, Outlet, Stage, Units};
use crate::units::ChannelId;
use crate::units::vector::{norm, sub};

/// Checkpoint state of an accumulator, except its sums, time spans and ledger, which are saved separately.
///
/// Snapshot numbers are not saved: they start from 1 again, because snapshot times depend on how the data arrived.
#[derive(Clone, Debug, Default, PartialEq, bincode::Encode, bincode::Decode)]
pub struct AccumulatorState {
    instrument: Option<Instrument>,
    /// Whether each channel has sums.
    channels: Vec<bool>,
}

impl AccumulatorState {
    /// Whether each channel has sums.
    #[must_use]
    pub fn has_sums(&self) -> &[bool] {
        &self.channels
    }
}

/// The time span of a channel without data.
const NO_SPAN_S: [f64; 2] = [f64::INFINITY, f64::NEG_INFINITY];

/// The sums of one channel, and the time span of their data.
struct ChannelState {
    sums: Box<dyn MapSums>,
    span_s: [f64; 2],
    snapshots: u32,
}

impl ChannelState {
    fn new(sums: Box<dyn MapSums>) -> Self {
        Self { sums, span_s: NO_SPAN_S, snapshots: 0 }
    }

    fn has_data(&self) -> bool {
        self.sums.counts().visibilities > 0
    }
}

/// Accumulates calibrated visibilities, and emits snapshots at equal steps of mission time and a final one.
pub struct Accumulator {
    config: MapConfig,
    ledger: Ledger<VisibilityReason>,
    instrument: Option<Arc<Instrument>>,
    channels: Vec<Option<ChannelState>>,
    next_snapshot_s: Option<f64>,
    accumulated: u64,
    cancel: Cancel,
    memory_max_bytes: Option<u64>,
    /// The channels to accumulate; `None` for all.
    group: Option<ChannelGroup>,
    share: SumShare,
    /// The sky beyond the degrees of the maps, by channel, where it counts as noise.
    beyond: BTreeMap<ChannelId, BeyondNoise>,
}

impl Accumulator {
    /// Creates a stage that reports to `ledger`.
    #[must_use]
    pub fn new(config: MapConfig, ledger: Ledger<VisibilityReason>) -> Self {
        Self {
            config,
            ledger,
            instrument: None,
            channels: Vec::new(),
            next_snapshot_s: None,
            accumulated: 0,
            cancel: Cancel::new(),
            memory_max_bytes: None,
            group: None,
            share: SumShare { ranks: Ranks::single(), part: None, realisation_seeds: Vec::new() },
            beyond: BTreeMap::new(),
        }
    }

    /// Makes it one of several ranks: it receives all visibilities and holds its share of the harmonic sums.
    #[must_use]
    pub fn with_ranks(self, ranks: &Ranks) -> Self {
        Self { share: SumShare { ranks: ranks.clone(), ..self.share }, ..self }
    }

    /// Accumulates only this part of the harmonic sums; `None` for all of them. The data are read once for each part. The complete sums are
    /// emitted after the last part, and no snapshots before.
    #[must_use]
    pub fn with_part(self, part: Option<SumPart>) -> Self {
        Self { share: SumShare { part, ..self.share }, ..self }
    }

    /// Also accumulates additional noise realisations, one per seed, for the final harmonic sums.
    #[must_use]
    pub fn with_noise_realisations(self, seeds: &[u64]) -> Self {
        Self { share: SumShare { realisation_seeds: seeds.to_vec(), ..self.share }, ..self }
    }

    /// A copy with the same settings and ledger but without data; additional noise realisations are not copied.
    #[must_use]
    pub fn without_data(&self) -> Self {
        let (config, ledger) = (self.config.clone(), self.ledger.clone());
        Self::new(config, ledger)
            .with_ranks(&self.share.ranks)
            .with_group(self.group.clone())
            .with_part(self.share.part.clone())
            .with_memory_limit(self.memory_max_bytes)
            .cancelled_by(&self.cancel)
    }

    /// The ranks that share the sums.
    #[must_use]
    pub fn ranks(&self) -> &Ranks {
        &self.share.ranks
    }

    /// Restricts it to the channels of a group; `None` for all channels.
    #[must_use]
    pub fn with_group(self, group: Option<ChannelGroup>) -> Self {
        Self { group, ..self }
    }

    /// Refuses instruments whose sums would take more than this many bytes.
    #[must_use]
    pub fn with_memory_limit(self, memory_max_bytes: Option<u64>) -> Self {
        Self { memory_max_bytes, ..self }
    }

    /// Emits only final data once `cancel` is triggered.
    #[must_use]
    pub fn cancelled_by(self, cancel: &Cancel) -> Self {
        Self { cancel: cancel.clone(), ..self }
    }

    /// The checkpoint state, except sums and spans.
    #[must_use]
    pub fn state(&self) -> AccumulatorState {
        AccumulatorState {
            instrument: self.instrument.as_deref().cloned(),
            channels: self.channels.iter().map(Option::is_some).collect(),
        }
    }

    /// Writes its sums one after another; stored visibilities go into files of their own in `segments`.
    ///
    /// # Errors
    /// The writer's.
    pub fn write_sums(
        &mut self,
        out: &mut dyn Write,
        segments: SegmentFolder<'_>,
    ) -> Result<(), AccumulationError> {
        for state in self.channels.iter_mut().flatten() {
            state.sums.save(out, segments)?;
        }
        Ok(())
    }

    /// The files of stored visibilities that belong to the checkpoint.
    pub fn segments(&self) -> impl Iterator<Item = &ArchiveSegment> {
        self.channels.iter().flatten().flat_map(|state| state.sums.segments())
    }

    /// Forgets the files of stored visibilities, so that the next checkpoint can go into another folder.
    pub fn forget_segments(&mut self) {
        for state in self.channels.iter_mut().flatten() {
            state.sums.forget_segments();
        }
    }

    /// Resumes from a state and the sums that [`Accumulator::write_sums`] wrote, with stored visibilities in `folder`. The channels' spans
    /// are restored by [`Accumulator::restore_spans`].
    ///
    /// # Errors
    /// The sums are damaged, or of another kind than configured.
    pub fn resume(
        self,
        state: AccumulatorState,
        from: &mut dyn Read,
        folder: Option<&Path>,
    ) -> Result<Self, AccumulationError> {
        self.resume_share(state, from, folder, RankShare::WHOLE)
    }

    /// Resumes from sums that the rank with share `written_by` wrote, as [`Accumulator::resume`]. Only the share of this rank is kept; call
    /// [`Accumulator::add_rank_share`] for what other ranks wrote.
    ///
    /// # Errors
    /// As [`Accumulator::resume`].
    pub fn resume_share(
        self,
        state: AccumulatorState,
        from: &mut dyn Read,
        folder: Option<&Path>,
        written_by: RankShare,
    ) -> Result<Self, AccumulationError> {
        let mut channels = Vec::new();
        for (channel, has_sums) in (0..).map(ChannelId).zip(state.channels) {
            let sums = has_sums
                .then(|| self.config.load_sums(from, folder, (written_by, &self.share)))
                .transpose()?;
            // Sums of other groups are read and dropped: without a length before them they cannot be skipped.
            let is_kept = self.group.as_ref().is_none_or(|group| group.contains(&channel));
            channels.push(sums.filter(|_| is_kept).map(ChannelState::new));
        }
        Ok(Self { instrument: state.instrument.map(Arc::new), channels, ..self })
    }

    /// Adds the share of the sums that another rank wrote, channel by channel. Both must hold the same visibilities, in different blocks
    /// of the sums (see [`crate::imaging::circle`]).
    ///
    /// # Errors
    /// The shares are of different sums, or of a method that does not divide its sums.
    pub fn add_rank_share(&mut self, other: Self) -> Result<(), AccumulationError> {
        if self.channels.len() != other.channels.len() {
            return Err(AccumulationError::Mismatch { what: "numbers of channels" });
        }
        for (slot, theirs) in self.channels.iter_mut().zip(other.channels) {
            match (slot, theirs) {
                (None, None) => {}
                (Some(ours), Some(theirs)) => ours.sums.join(theirs.sums)?,
                _ => return Err(AccumulationError::Undivided),
            }
        }
        Ok(())
    }

    /// Adds the sums of another accumulator, channel by channel.
    ///
    /// # Errors
    /// The sums have different setups.
    pub fn merge(&mut self, other: Self) -> Result<(), AccumulationError> {
        if self.instrument.is_none() {
            self.instrument = other.instrument;
        }
        if self.channels.len() < other.channels.len() {
            self.channels.resize_with(other.channels.len(), || None);
        }
        for (slot, theirs) in self.channels.iter_mut().zip(other.channels) {
            match (slot.as_mut(), theirs) {
                (_, None) => {}
                (None, theirs) => *slot = theirs,
                (Some(ours), Some(theirs)) => {
                    ours.sums.merge(theirs.sums)?;
                    let ([first, last], [from, to]) = (ours.span_s, theirs.span_s);
                    ours.span_s = [first.min(from), last.max(to)];
                }
            }
        }
        Ok(())
    }

    /// Whether visibilities of a channel are accumulated.
    #[must_use]
    pub fn maps(&self, channel: ChannelId) -> bool {
        self.group.as_ref().is_none_or(|group| group.contains(&channel)) && self.config.is_mapped(channel)
    }

    /// Removes visibilities from their channel without posting to the ledger.
    ///
    /// Visibilities beyond the map's longest baseline were never added: they are neither removed nor refused.
    ///
    /// # Errors
    /// The channel holds nothing, or as [`MapSums::remove`].
    pub fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        let usable = self.usable(placed)?;
        if usable.is_empty() {
            return Ok(Added::default());
        }
        let slot = self.channels.get_mut(usize::from(placed.channel.0)).and_then(Option::as_mut);
        let state = slot.ok_or(AccumulationError::NothingHeld(placed.channel))?;
        let removed = state.sums.remove(&usable)?;
        self.accumulated = self.accumulated.saturating_sub(removed.visibilities);
        Ok(removed)
    }

    /// Adds visibilities in place of removed ones, without posting to the ledger.
    ///
    /// # Errors
    /// As [`Self::remove`].
    pub fn put_back(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        let usable = self.usable(placed)?;
        if usable.is_empty() {
            return Ok(Added::default());
        }
        let slot = self.channels.get_mut(usize::from(placed.channel.0)).and_then(Option::as_mut);
        let state = slot.ok_or(AccumulationError::NothingHeld(placed.channel))?;
        let added = state.sums.add(&usable)?;
        self.accumulated += added.visibilities;
        Ok(added)
    }

    /// Sets the first and last mission time, s, of the data in each channel, and drops channels without a span.
    pub fn restore_spans(&mut self, spans_s: &BTreeMap<ChannelId, [f64; 2]>) {
        for (slot, channel) in self.channels.iter_mut().zip(0..) {
            match (slot.as_mut(), spans_s.get(&ChannelId(channel))) {
                (Some(state), Some(&span_s)) => state.span_s = span_s,
                _ => *slot = None,
            }
        }
    }

    /// Accepts the next frame and emits the snapshots that are due. Returns the first and last mission time, s, of the visibilities that
    /// were passed to the sums.
    ///
    /// # Errors
    /// As [`MapSums::add`]; or the map's settings do not fit the instrument.
    pub fn accept(
        &mut self,
        frame: PlacedFrame,
        out: &mut Outlet<Snapshot>,
    ) -> Result<Option<[f64; 2]>, AccumulationError> {
        match frame {
            PlacedFrame::Instrument(instrument) => self.set_instrument(instrument)?,
            PlacedFrame::Visibilities(placed) => {
                if let Some(&time_s) = placed.time_s.first() {
                    self.emit_if_due(time_s, out)?;
                }
                return self.add(&placed);
            }
            PlacedFrame::NotMapped(counted) => {
                self.emit_if_due(counted.first_s, out)?;
                self.ledger.add_left_out(VisibilityReason::ChannelNotMapped, counted.visibilities);
            }
            PlacedFrame::Housekeeping(_) => {}
        }
        Ok(None)
    }

    /// Checks an instrument against the map's settings, and starts anew with it.
    fn set_instrument(&mut self, instrument: Instrument) -> Result<(), AccumulationError> {
        let channels = instrument.channels.len();
        if let Some(mismatch) = self.config.mismatches(channels).into_iter().next() {
            return Err(mismatch.into());
        }
        self.config.check_priors(&instrument)?;
        self.config.require_memory(channels, self.memory_max_bytes, self.group.as_ref())?;
        self.channels = (0..channels).map(|_| None).collect();
        self.beyond.clear();
        self.instrument = Some(Arc::new(instrument));
        Ok(())
    }

    /// The channel of `placed`, created by its first data.
    fn channel_or_new(
        &mut self,
        placed: &PlacedVisibilities,
    ) -> Result<NewOrRefused<&mut ChannelState>, AccumulationError> {
        let channel = placed.channel;
        let index = usize::from(channel.0);
        let unknown = || AccumulationError::UnknownChannel(channel);
        let instrument = self.instrument.as_ref().ok_or_else(unknown)?;
        let slot = self.channels.get_mut(index).ok_or_else(unknown)?;
        let state = match slot {
            Some(state) => state,
            empty => match self.config.new_sums(instrument, placed, &self.share)? {
                Ok(sums) => empty.insert(ChannelState::new(sums)),
                Err(reason) => return Ok(Err(reason)),
            },
        };
        Ok(Ok(state))
    }

    /// The visibilities that a map uses, with the weights that it gives them.
    fn usable(&mut self, placed: &PlacedVisibilities) -> Result<PlacedVisibilities, AccumulationError> {
        let (config, channel) = (&self.config, placed.channel);
        let baseline_m_max = config.baseline_m_max(placed.frequency_hz);
        let mut usable = within_baseline(placed, baseline_m_max);
        let Some(path) = config.beyond_files.get(usize::from(channel.0)).filter(|_| !usable.is_empty())
        else {
            return Ok(usable);
        };
        if !self.beyond.contains_key(&channel) {
            let instrument = self.instrument.as_ref().ok_or(AccumulationError::UnknownChannel(channel))?;
            let failed = |error: SolveError| AccumulationError::Beyond(error.to_string());
            let (first, power_k2) = read_power(path).map_err(failed)?;
            let (hz, moon_m) = (placed.frequency_hz, instrument.moon_radius_m);
            let beyond = BeyondNoise::new((first, &power_k2), config.degree(), hz, baseline_m_max, moon_m);
            self.beyond.insert(channel, beyond);
        }
        if let Some(beyond) = self.beyond.get_mut(&channel) {
            beyond.lower_weights(&mut usable);
        }
        Ok(usable)
    }

    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Option<[f64; 2]>, AccumulationError> {
        if !self.maps(placed.channel) {
            self.ledger.add_left_out(VisibilityReason::ChannelNotMapped, placed.len() as u64);
            return Ok(None);
        }
        let usable = self.usable(placed)?;
        self.ledger.add_left_out(VisibilityReason::BaselineBeyondMap, (placed.len() - usable.len()) as u64);
        if usable.is_empty() {
            // A channel without usable data gets no sums and no map.
            return Ok(None);
        }
        let state = match self.channel_or_new(&usable)? {
            Ok(state) => state,
            Err(reason) => {
                self.ledger.add_left_out(reason, usable.len() as u64);
                return Ok(None);
            }
        };
        let Added { visibilities, refused } = state.sums.add(&usable)?;
        let offered_s = usable.time_s.first().zip(usable.time_s.last()).map(|(&first, &last)| [first, last]);
        if let Some([first, last]) = offered_s {
            state.span_s = [state.span_s[0].min(first), state.span_s[1].max(last)];
        }
        self.accumulated += visibilities;
        self.ledger.add_accumulated(visibilities);
        for (reason, count) in refused {
            self.ledger.add_left_out(reason.into(), count);
        }
        Ok(offered_s)
    }

    /// Emits snapshots of the data of earlier sessions, if snapshots are wanted.
    ///
    /// # Errors
    /// As [`MapSums::add`], for the harmonic sums of stored visibilities.
    pub fn emit_resumed(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), AccumulationError> {
        if self.config.snapshot_every_s > 0.0 { self.emit(out) } else { Ok(()) }
    }

    /// Emits a snapshot of each channel.
    fn emit(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), AccumulationError> {
        let Some(instrument) = &self.instrument else { return Ok(()) };
        for (index, slot) in self.channels.iter_mut().enumerate() {
            if self.cancel.is_cancelled() {
                return Ok(());
            }
            let Some(state) = slot.as_mut().filter(|state| state.has_data()) else { continue };
            state.snapshots += 1;
            let snapshot = Snapshot {
                instrument: Arc::clone(instrument),
                channel: ChannelId(index as u16),
                number: state.snapshots,
                is_final: false,
                span_s: state.span_s,
                nside: self.config.nside,
                data: state.sums.snapshot()?,
            };
            out.push_unless(snapshot, &self.cancel);
        }
        Ok(())
    }

    /// Emits snapshots when the first data of the next step of mission time arrive.
    fn emit_if_due(&mut self, time_s: f64, out: &mut Outlet<Snapshot>) -> Result<(), AccumulationError> {
        let every_s = self.config.snapshot_every_s;
        if every_s <= 0.0 || self.share.part.is_some() {
            return Ok(());
        }
        let next_s = ((time_s / every_s).floor() + 1.0) * every_s;
        match self.next_snapshot_s {
            Some(due_s) if time_s >= due_s => {
                self.emit(out)?;
                self.next_snapshot_s = Some(next_s);
            }
            Some(_) => {}
            None => self.next_snapshot_s = Some(next_s),
        }
        Ok(())
    }
}

/// The visibilities whose baselines are shorter than `baseline_m_max`.
fn within_baseline(placed: &PlacedVisibilities, baseline_m_max: f64) -> PlacedVisibilities {
    let mut short = placed.without_visibilities();
    let is_short = |k: &usize| norm(sub(placed.r_i_m[*k], placed.r_j_m[*k])) < baseline_m_max;
    (0..placed.len()).filter(is_short).for_each(|k| short.push_from(placed, k));
    short
}

impl Stage for Accumulator {
    type In = PlacedFrame;
    type Out = Snapshot;
    type Error = AccumulationError;

    fn step(&mut self, frame: PlacedFrame, out: &mut Outlet<Snapshot>) -> Result<(), AccumulationError> {
        self.accept(frame, out).map(drop)
    }

    fn finish(&mut self, out: &mut Outlet<Snapshot>) -> Result<(), AccumulationError> {
        let Some(instrument) = self.instrument.take() else { return Ok(()) };
        for (index, slot) in self.channels.drain(..).enumerate() {
            if out.is_closed() {
                return Ok(());
            }
            // After cancellation the remaining parts would not see the same visibilities, so nothing is emitted.
            let is_cut = self.share.part.is_some() && self.cancel.is_cancelled();
            let Some(ChannelState { sums, span_s, snapshots }) =
                slot.filter(|state| state.has_data() && !is_cut)
            else {
                continue;
            };
            let Some(data) = sums.finish()? else { continue };
            out.push(Snapshot {
                instrument: Arc::clone(&instrument),
                channel: ChannelId(index as u16),
                number: snapshots + 1,
                is_final: true,
                span_s,
                nside: self.config.nside,
                data,
            });
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.accumulated, "visibilities")
    }
}
