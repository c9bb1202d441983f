//! The ground stage that sums normal equations: an engine for each channel.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::Path;
use std::sync::Arc;

use crate::frames::{Channel, Instrument, PlacedFrame, PlacedVisibilities, VisibilityReason};
use crate::imaging::anywhere::{ArchiveSegment, RefinedSetup, SegmentPlace, VisibilityArchive};
use crate::imaging::circle::{HarmonicEngine, HarmonicSetup, HarmonicSums, NoiseSums, SumPart, orbit_of};
use crate::imaging::{
    AccumulationError, Added, ChannelGroup, EngineKind, MapConfig, MatrixFreeVisibilities, NormalEngine,
    NormalSums, PixelEngine, PixelSetup, PixelSums, SumCounts, automatic_weight_max,
};
use crate::ranks::{RankShare, Ranks};
use crate::runtime::{Cancel, Ledger, Outlet, Stage, Units};
use crate::units::ChannelId;
use crate::units::vector::{norm, sub};

/// A copy of the sums of one channel, to be solved while more data arrives.
pub struct Snapshot {
    /// Instrument.
    pub instrument: Arc<Instrument>,
    /// Channel.
    pub channel: ChannelId,
    /// Number of the snapshot in its channel, from 1.
    pub number: u32,
    /// Whether it holds all data.
    pub is_final: bool,
    /// First and last mission time of the data in it, s.
    pub span_s: [f64; 2],
    /// nside of the map to be made.
    pub nside: usize,
    /// The sums.
    pub sums: SnapshotSums,
}

/// Sums of either engine.
pub enum SnapshotSums {
    /// Over pixels.
    Pixel(PixelSums),
    /// Over harmonics.
    Harmonic(Box<HarmonicSums>),
    /// Visibilities one by one, for a refined map.
    Refined(Box<VisibilityArchive>),
    /// Visibilities one by one, for a map of pixels.
    MatrixFree(Box<MatrixFreeVisibilities>),
}

impl SnapshotSums {
    fn with_noises(self, noises: Option<NoiseSums>) -> Self {
        match (self, noises) {
            (Self::Harmonic(sums), Some(noises)) => Self::Harmonic(Box::new(sums.with_noises(noises))),
            (other, _) => other,
        }
    }

    /// Number and weight of the visibilities in the sums.
    #[must_use]
    pub fn counts(&self) -> SumCounts {
        match self {
            Self::Pixel(sums) => sums.counts(),
            Self::Harmonic(sums) => sums.counts(),
            Self::Refined(archive) => archive.counts(),
            Self::MatrixFree(visibilities) => visibilities.counts(),
        }
    }
}

/// Sums of either engine, or an archive of single visibilities.
enum Engine {
    Pixel(Box<PixelEngine>),
    Harmonic(Box<HarmonicEngine>),
    Archive(Box<VisibilityArchive>),
}

impl Engine {
    /// The part of one rank of several. Only the harmonic engine divides its sums; others hold all on every rank.
    fn with_ranks(self, ranks: &Ranks) -> Self {
        match self {
            Self::Harmonic(engine) => Self::Harmonic(Box::new(engine.with_ranks(ranks))),
            other => other,
        }
    }

    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        match self {
            Self::Pixel(engine) => engine.add(placed),
            Self::Harmonic(engine) => engine.add(placed),
            Self::Archive(archive) => archive.add(placed),
        }
    }

    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        match self {
            Self::Pixel(engine) => engine.remove(placed),
            Self::Harmonic(engine) => engine.remove(placed),
            Self::Archive(archive) => archive.remove(placed),
        }
    }

    /// Whether it is empty: then there is no map to make.
    fn is_empty(&self) -> bool {
        let counts = match self {
            Self::Pixel(engine) => engine.counts(),
            Self::Harmonic(engine) => engine.counts(),
            Self::Archive(archive) => archive.counts(),
        };
        counts.visibilities == 0
    }

    /// A copy of the sums; for an archive to be refined, its sums on the nearest circle.
    fn sums(&mut self, config: &MapConfig) -> Result<SnapshotSums, AccumulationError> {
        Ok(match self {
            Self::Archive(archive) if config.is_matrix_free() => matrix_free(config, archive.copy()),
            Self::Pixel(engine) => SnapshotSums::Pixel(engine.sums()),
            Self::Harmonic(engine) => SnapshotSums::Harmonic(Box::new(engine.sums())),
            Self::Archive(archive) => SnapshotSums::Harmonic(Box::new(archive.circle_sums()?)),
        })
    }

    fn into_sums(self, config: &MapConfig) -> SnapshotSums {
        match self {
            Self::Archive(archive) if config.is_matrix_free() => matrix_free(config, *archive),
            Self::Pixel(engine) => SnapshotSums::Pixel(engine.into_sums()),
            Self::Harmonic(engine) => SnapshotSums::Harmonic(Box::new(engine.into_sums())),
            Self::Archive(archive) => SnapshotSums::Refined(archive),
        }
    }
}

/// Visibilities for a map of pixels without its matrix.
fn matrix_free(config: &MapConfig, archive: VisibilityArchive) -> SnapshotSums {
    SnapshotSums::MatrixFree(Box::new(MatrixFreeVisibilities {
        nside: config.nside,
        method: config.rows,
        archive,
    }))
}

/// State of an accumulator besides its engines, spans and ledger, from which another can resume. Snapshots are numbered
/// from 1 again: their times depend on how the data arrived.
#[derive(Clone, Debug, Default, PartialEq, bincode::Encode, bincode::Decode)]
pub struct AccumulatorState {
    instrument: Option<Instrument>,
    /// Whether each channel has an engine.
    channels: Vec<bool>,
}

/// The span of no data.
const NO_SPAN_S: [f64; 2] = [f64::INFINITY, f64::NEG_INFINITY];

/// The engine of one channel, and the span of its data.
struct ChannelSums {
    engine: Engine,
    /// Noises of further realisations, of the harmonic engine.
    noises: Option<NoiseSums>,
    span_s: [f64; 2],
    snapshots: u32,
}

/// Sums calibrated visibilities; emits snapshots at equal steps of mission time, and a final one.
pub struct Accumulator {
    config: MapConfig,
    ledger: Ledger<VisibilityReason>,
    instrument: Option<Arc<Instrument>>,
    channels: Vec<Option<ChannelSums>>,
    next_snapshot_s: Option<f64>,
    accumulated: u64,
    cancel: Cancel,
    memory_max_bytes: Option<u64>,
    /// The channels of a group; `None` for all.
    group: Option<ChannelGroup>,
    /// The ranks that hold the other parts of the sums.
    ranks: Ranks,
    /// The part of the sums that is made now, where they are made one after the other.
    part: Option<SumPart>,
    /// Seeds of further realisations of noise.
    noise_seeds: Vec<u64>,
}

impl Accumulator {
    /// A stage that reports to `ledger`.
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
            ranks: Ranks::one(),
            part: None,
            noise_seeds: Vec::new(),
        }
    }

    /// Makes it one rank of several: it takes all visibilities and holds its part of the harmonic engine's sums.
    #[must_use]
    pub fn with_ranks(self, ranks: &Ranks) -> Self {
        Self { ranks: ranks.clone(), ..self }
    }

    /// Makes a part of the sums of the harmonic engine, and emits them with the last part; there are no snapshots on the way. `None` makes all of
    /// them at once.
    #[must_use]
    pub fn in_part(self, part: Option<SumPart>) -> Self {
        Self { part, ..self }
    }

    /// Sums noise of further realisations as well, one a seed, for the final sums of the harmonic engine.
    #[must_use]
    pub fn with_noises(self, seeds: &[u64]) -> Self {
        Self { noise_seeds: seeds.to_vec(), ..self }
    }

    /// A copy with the same settings and ledger, without data.
    #[must_use]
    pub fn without_sums(&self) -> Self {
        let (config, ledger) = (self.config.clone(), self.ledger.clone());
        Self::new(config, ledger)
            .with_ranks(&self.ranks)
            .of_group(self.group.clone())
            .in_part(self.part.clone())
            .within_memory(self.memory_max_bytes)
            .cancelled_by(&self.cancel)
    }

    /// The ranks that hold parts of the sums.
    #[must_use]
    pub fn ranks(&self) -> &Ranks {
        &self.ranks
    }

    /// Restricts it to the channels of a group; `None` for all.
    #[must_use]
    pub fn of_group(self, group: Option<ChannelGroup>) -> Self {
        Self { group, ..self }
    }

    /// Refuses instruments whose sums would take more memory, bytes.
    #[must_use]
    pub fn within_memory(self, memory_max_bytes: Option<u64>) -> Self {
        Self { memory_max_bytes, ..self }
    }

    /// Once `cancel` is triggered, only final sums are emitted.
    #[must_use]
    pub fn cancelled_by(self, cancel: &Cancel) -> Self {
        Self { cancel: cancel.clone(), ..self }
    }

    /// Its state besides the engines and spans.
    #[must_use]
    pub fn state(&self) -> AccumulatorState {
        AccumulatorState {
            instrument: self.instrument.as_deref().cloned(),
            channels: self.channels.iter().map(Option::is_some).collect(),
        }
    }

    /// Writes its engines one after another; archives of visibilities go into files of their own at `place`.
    ///
    /// # Errors
    /// The writer's.
    pub fn write_engines(
        &mut self,
        out: &mut dyn Write,
        place: SegmentPlace<'_>,
    ) -> Result<(), AccumulationError> {
        for sums in self.channels.iter_mut().flatten() {
            match &mut sums.engine {
                Engine::Pixel(engine) => engine.checkpoint(out)?,
                Engine::Harmonic(engine) => engine.checkpoint(out)?,
                Engine::Archive(archive) => archive.checkpoint(out, place)?,
            }
        }
        Ok(())
    }

    /// The archive files beside the checkpoint.
    pub fn segments(&self) -> impl Iterator<Item = &ArchiveSegment> {
        self.channels.iter().flatten().flat_map(|sums| match &sums.engine {
            Engine::Archive(archive) => archive.segments(),
            Engine::Pixel(_) | Engine::Harmonic(_) => &[],
        })
    }

    /// Forgets the archive files: the next checkpoint goes into another folder.
    pub fn leave_segments(&mut self) {
        for sums in self.channels.iter_mut().flatten() {
            if let Engine::Archive(archive) = &mut sums.engine {
                archive.leave_segments();
            }
        }
    }

    /// Resumes from a state and its engines, as [`Accumulator::write_engines`] wrote them, with files in `folder`. The channels' spans
    /// are not part of it: see [`Accumulator::set_spans`].
    ///
    /// # Errors
    /// Engines that are damaged, or of another kind than configured.
    pub fn resume(
        self,
        state: AccumulatorState,
        from: &mut dyn Read,
        folder: Option<&Path>,
    ) -> Result<Self, AccumulationError> {
        self.resume_part(state, from, folder, RankShare::WHOLE)
    }

    /// As [`Accumulator::resume`], from engines that were written by the rank of `part`. Only what this rank holds is kept; join the
    /// other parts.
    ///
    /// # Errors
    /// Likewise.
    pub fn resume_part(
        self,
        state: AccumulatorState,
        from: &mut dyn Read,
        folder: Option<&Path>,
        part: RankShare,
    ) -> Result<Self, AccumulationError> {
        let refine = self.config.refine;
        let mut channels = Vec::new();
        for has_engine in state.channels {
            if !has_engine {
                channels.push(None);
                continue;
            }
            let engine = match self.config.engine {
                _ if self.config.holds_visibilities() => {
                    let most = refine.visibilities_max;
                    Engine::Archive(Box::new(VisibilityArchive::restore(from, folder, most)?))
                }
                EngineKind::Pixel | EngineKind::Auto => Engine::Pixel(Box::new(PixelEngine::restore(from)?)),
                EngineKind::Harmonic => {
                    Engine::Harmonic(Box::new(HarmonicEngine::restore_part(from, part, &self.ranks)?))
                }
            };
            channels.push(Some(ChannelSums { engine, noises: None, span_s: NO_SPAN_S, snapshots: 0 }));
        }
        Ok(Self { instrument: state.instrument.map(Arc::new), channels, ..self })
    }

    /// Joins another part of the same sums, channel by channel: the same visibilities at other alphas.
    ///
    /// # Errors
    /// Parts of different sums.
    pub fn join(&mut self, other: Self) -> Result<(), AccumulationError> {
        let apart = AccumulationError::Mismatch { what: "channels, or sums that have no parts," };
        if self.channels.len() != other.channels.len() {
            return Err(apart);
        }
        for (slot, theirs) in self.channels.iter_mut().zip(other.channels) {
            match (slot, theirs) {
                (None, None) => {}
                (
                    Some(ChannelSums { engine: Engine::Harmonic(ours), .. }),
                    Some(ChannelSums { engine: Engine::Harmonic(theirs), .. }),
                ) => ours.join(*theirs)?,
                _ => return Err(apart),
            }
        }
        Ok(())
    }

    /// Adds the sums of another accumulator, channel by channel.
    ///
    /// # Errors
    /// Engines of different setups.
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
                    match (&mut ours.engine, theirs.engine) {
                        (Engine::Pixel(ours), Engine::Pixel(theirs)) => ours.merge(*theirs)?,
                        (Engine::Harmonic(ours), Engine::Harmonic(theirs)) => ours.merge(*theirs)?,
                        (Engine::Archive(ours), Engine::Archive(theirs)) => ours.merge(*theirs)?,
                        _ => return Err(AccumulationError::Mismatch { what: "kinds" }),
                    }
                    let ([first, last], [from, to]) = (ours.span_s, theirs.span_s);
                    ours.span_s = [first.min(from), last.max(to)];
                }
            }
        }
        Ok(())
    }

    /// Subtracts visibilities from the sums of their channel; posts nothing to the ledger.
    ///
    /// Visibilities beyond the map's longest baseline never were in the sums: they are neither subtracted nor refused.
    ///
    /// # Errors
    /// A channel that holds nothing, or as [`NormalEngine::remove`].
    pub fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        let near = within(placed, self.config.baseline_m_max(placed.frequency_hz));
        if near.is_empty() {
            return Ok(Added::default());
        }
        let slot = self.channels.get_mut(usize::from(placed.channel.0)).and_then(Option::as_mut);
        let sums = slot.ok_or(AccumulationError::NothingHeld(placed.channel))?;
        sums.engine.remove(&near)
    }

    /// Sets the first and last mission time, s, of the data in each channel; drops the sums of all others.
    pub fn set_spans(&mut self, spans_s: &BTreeMap<ChannelId, [f64; 2]>) {
        for (slot, channel) in self.channels.iter_mut().zip(0..) {
            match (slot.as_mut(), spans_s.get(&ChannelId(channel))) {
                (Some(sums), Some(&span_s)) => sums.span_s = span_s,
                _ => *slot = None,
            }
        }
    }

    /// Takes the next frame, and emits snapshots that are due; returns the first and last mission time, s, of the
    /// visibilities that were offered to an engine.
    ///
    /// # Errors
    /// As [`NormalEngine::add`]; an instrument that the map's settings do not fit.
    pub fn accept(
        &mut self,
        frame: PlacedFrame,
        out: &mut Outlet<Snapshot>,
    ) -> Result<Option<[f64; 2]>, AccumulationError> {
        match frame {
            PlacedFrame::Instrument(instrument) => self.open(instrument)?,
            PlacedFrame::Visibilities(placed) => {
                if let Some(&time_s) = placed.time_s.first() {
                    self.emit_if_due(time_s, out)?;
                }
                return self.add(&placed);
            }
            PlacedFrame::Elsewhere(counted) => {
                self.emit_if_due(counted.first_s, out)?;
                self.ledger.left_out(VisibilityReason::ChannelNotMapped, counted.visibilities);
            }
            PlacedFrame::Housekeeping(_) => {}
        }
        Ok(None)
    }

    fn open(&mut self, instrument: Instrument) -> Result<(), AccumulationError> {
        let channels = instrument.channels.len();
        if let Some(misfit) = self.config.misfits(channels).into_iter().next() {
            return Err(misfit.into());
        }
        self.config.check_priors(&instrument)?;
        self.config.require_memory(channels, self.memory_max_bytes, self.group.as_ref())?;
        self.channels = (0..channels).map(|_| None).collect();
        self.instrument = Some(Arc::new(instrument));
        Ok(())
    }

    /// The sums that `placed` belongs to, created with the first data; or why its positions determine no orbit.
    fn sums(
        &mut self,
        placed: &PlacedVisibilities,
    ) -> Result<Result<&mut ChannelSums, VisibilityReason>, AccumulationError> {
        let channel = placed.channel;
        let index = usize::from(channel.0);
        let unknown = || AccumulationError::UnknownChannel(channel);
        let instrument = self.instrument.as_ref().ok_or_else(unknown)?;
        let slot = self.channels.get_mut(index).ok_or_else(unknown)?;
        let sums = match slot {
            Some(sums) => sums,
            empty => match engine(&self.config, instrument, placed)? {
                Ok(engine) => {
                    let engine = match &self.part {
                        Some(part) => engine.with_ranks(&part.ranks()),
                        None => engine.with_ranks(&self.ranks),
                    };
                    let noises = match &engine {
                        Engine::Harmonic(engine) if !self.noise_seeds.is_empty() => {
                            Some(NoiseSums::new(engine, &self.noise_seeds))
                        }
                        _ => None,
                    };
                    empty.insert(ChannelSums { engine, noises, span_s: NO_SPAN_S, snapshots: 0 })
                }
                Err(reason) => return Ok(Err(reason)),
            },
        };
        Ok(Ok(sums))
    }

    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Option<[f64; 2]>, AccumulationError> {
        let is_other = self.group.as_ref().is_some_and(|group| !group.contains(&placed.channel));
        if is_other || !self.config.maps(placed.channel) {
            self.ledger.left_out(VisibilityReason::ChannelNotMapped, placed.len() as u64);
            return Ok(None);
        }
        let near = within(placed, self.config.baseline_m_max(placed.frequency_hz));
        self.ledger.left_out(VisibilityReason::BaselineBeyondMap, (placed.len() - near.len()) as u64);
        if near.is_empty() {
            // A channel without usable data has no sums, and no map.
            return Ok(None);
        }
        let sums = match self.sums(&near)? {
            Ok(sums) => sums,
            Err(reason) => {
                self.ledger.left_out(reason, near.len() as u64);
                return Ok(None);
            }
        };
        let Added { visibilities, refused } = sums.engine.add(&near)?;
        if let (Engine::Harmonic(engine), Some(noises)) = (&sums.engine, &mut sums.noises) {
            noises.add(engine, &near);
        }
        let offered_s = near.time_s.first().zip(near.time_s.last()).map(|(&first, &last)| [first, last]);
        if let Some([first, last]) = offered_s {
            sums.span_s = [sums.span_s[0].min(first), sums.span_s[1].max(last)];
        }
        self.accumulated += visibilities;
        self.ledger.accumulated(visibilities);
        for (reason, count) in refused {
            self.ledger.left_out(reason.into(), count);
        }
        Ok(offered_s)
    }

    /// Emits a snapshot of what earlier sessions have summed, if snapshots are wanted.
    ///
    /// # Errors
    /// Sums that cannot be written down.
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
            let Some(channel) = slot.as_mut().filter(|channel| !channel.engine.is_empty()) else { continue };
            channel.snapshots += 1;
            let snapshot = Snapshot {
                instrument: Arc::clone(instrument),
                channel: ChannelId(index as u16),
                number: channel.snapshots,
                is_final: false,
                span_s: channel.span_s,
                nside: self.config.nside,
                sums: channel.engine.sums(&self.config)?,
            };
            out.push_unless(snapshot, &self.cancel);
        }
        Ok(())
    }

    /// Emits snapshots when data of a later step of mission time arrives.
    fn emit_if_due(&mut self, time_s: f64, out: &mut Outlet<Snapshot>) -> Result<(), AccumulationError> {
        let every_s = self.config.snapshot_every_s;
        if every_s <= 0.0 || self.part.is_some() {
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

/// An engine for the channel of `placed`, which is its first data; or why its positions determine no orbit.
fn engine(
    config: &MapConfig,
    instrument: &Instrument,
    placed: &PlacedVisibilities,
) -> Result<Result<Engine, VisibilityReason>, AccumulationError> {
    let Some(&Channel { frequency_hz, width_hz }) = instrument.channels.get(usize::from(placed.channel.0))
    else {
        return Err(AccumulationError::UnknownChannel(placed.channel));
    };
    let (moon_radius_m, response) = (instrument.moon_radius_m, instrument.response);
    let weight_max = match config.weight_max {
        0.0 => automatic_weight_max(frequency_hz, width_hz),
        weight_max => weight_max,
    };
    Ok(match config.engine {
        _ if config.holds_visibilities() => {
            Ok(Engine::Archive(Box::new(VisibilityArchive::new(RefinedSetup {
                channel: placed.channel,
                // Pixels have no degrees.
                l_max: if config.is_matrix_free() { 0 } else { config.degree() },
                frequency_hz,
                baseline_m_max: config.baseline_m_max(frequency_hz),
                moon_radius_m,
                response,
                companion_seed: config.companion_seed,
                weight_max,
                limits: config.limits,
                visibilities_max: config.refine.visibilities_max,
            })?)))
        }
        EngineKind::Pixel | EngineKind::Auto => Ok(Engine::Pixel(Box::new(PixelEngine::new(PixelSetup {
            nside: config.nside,
            frequency_hz,
            method: config.rows,
            moon_radius_m,
            response,
            companion_seed: config.companion_seed,
            weight_max,
        })?))),
        EngineKind::Harmonic => match orbit_of(placed, config.limits) {
            // Positions come from outside: what no satellite can have is refused, and later data may have others.
            Some(orbit) if orbit.radius_m <= moon_radius_m.max(config.baseline_m_max(frequency_hz)) => {
                Err(VisibilityReason::OffAltitude)
            }
            Some(orbit) => Ok(Engine::Harmonic(Box::new(HarmonicEngine::new(HarmonicSetup {
                l_max: config.degree(),
                frequency_hz,
                baseline_m_max: config.baseline_m_max(frequency_hz),
                moon_radius_m,
                response,
                orbit,
                companion_seed: config.companion_seed,
                weight_max,
            })?))),
            None => Err(VisibilityReason::NoDirection),
        },
    })
}

/// The visibilities whose baseline is shorter than `baseline_m_max`.
fn within(placed: &PlacedVisibilities, baseline_m_max: f64) -> PlacedVisibilities {
    let is_near = |k: &usize| norm(sub(placed.r_i_m[*k], placed.r_j_m[*k])) < baseline_m_max;
    let kept: Vec<usize> = (0..placed.len()).filter(is_near).collect();
    fn pick<T: Copy>(from: &[T], kept: &[usize]) -> Vec<T> {
        kept.iter().map(|&k| from[k]).collect()
    }
    PlacedVisibilities {
        channel: placed.channel,
        band: placed.band,
        frequency_hz: placed.frequency_hz,
        pair: placed.pair,
        time_s: pick(&placed.time_s, &kept),
        r_i_m: pick(&placed.r_i_m, &kept),
        r_j_m: pick(&placed.r_j_m, &kept),
        value_k_sr: pick(&placed.value_k_sr, &kept),
        weight: pick(&placed.weight, &kept),
        duration_s: if placed.duration_s.is_empty() { Vec::new() } else { pick(&placed.duration_s, &kept) },
    }
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
            let Some(ChannelSums { engine, noises, span_s, snapshots }) =
                slot.filter(|sums| !sums.engine.is_empty())
            else {
                continue;
            };
            let sums = match (&self.part, engine) {
                // Later parts would be of other data.
                (Some(_), _) if self.cancel.is_cancelled() => continue,
                (Some(part), Engine::Harmonic(engine)) => match engine.finish_part(part)? {
                    Some(sums) => SnapshotSums::Harmonic(Box::new(sums)),
                    None => continue,
                },
                (_, engine) => engine.into_sums(&self.config).with_noises(noises),
            };
            out.push(Snapshot {
                instrument: Arc::clone(&instrument),
                channel: ChannelId(index as u16),
                number: snapshots + 1,
                is_final: true,
                span_s,
                nside: self.config.nside,
                sums,
            });
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.accumulated, "visibilities")
    }
}
