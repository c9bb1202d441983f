//! The stage that simulates the integrated visibilities of observing windows.

use std::f64::consts::TAU;
use std::sync::Arc;

use num_complex::{Complex32, Complex64};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Gamma, StandardNormal};
use rayon::prelude::*;

use super::powers::SkyPowers;
use super::schedule::{Integration, Schedule};
use super::troubles::PairTroubles;
use crate::array::{Array, EarthShadow, segments_for};
use crate::daughters::{InstrumentErrors, PassErrors};
use crate::frames::{
    AntennaResponse, EphemerisSegment, Flags, GroundFrame, Housekeeping, Instrument, ObservingWindow,
    VisibilityBlock,
};
use crate::response::model::{ModelError, PairPosition, VisibilityModel};
use crate::runtime::{Outlet, Stage, Units};
use crate::units::{ChannelId, MissionTime, Pair, StreamKind, TICKS_PER_SECOND, all_pairs, random_stream};

/// Largest spacing of tabulated positions, s; interpolation is then accurate to micrometres.
const EPHEMERIS_STEP_S: f64 = 60.0;

/// Queued visibilities of all channels at which they are predicted in any case; bounds memory to some 200 MB.
const QUEUED_VISIBILITIES_MAX: usize = 1_000_000;
/// Queued windows at which they are predicted in any case.
const QUEUED_WINDOWS_MAX: usize = 64;

/// Integrates all pairs and channels over each window.
///
/// Emits for each window: the instrument description, the ephemeris, the visibilities by channel and pair, the
/// auto-correlations if configured, and a housekeeping frame that closes the window. Windows are queued until the models
/// have enough visibilities for an efficient batch; this depends on the windows alone.
pub struct Integrator {
    array: Arc<Array>,
    models: Vec<ChannelModel>,
    instrument: Instrument,
    schedules: Vec<Schedule>,
    options: MeasurementOptions,
    queued: Vec<QueuedWindow>,
    sampled: u64,
    errors: Option<Arc<InstrumentErrors>>,
}

/// The model of a channel.
pub struct ChannelModel {
    /// Its preferred number of visibilities a call.
    pub batch: usize,
    /// The model; `None` for a channel that is simulated elsewhere. Batches are those of all channels, so that visibilities have
    /// the same bits whichever others are simulated with them.
    pub model: Option<Box<dyn VisibilityModel>>,
}

/// How a prediction becomes a measurement.
#[derive(Clone, Debug, PartialEq)]
pub struct MeasurementOptions {
    /// Thermal noise.
    pub noise: NoiseModel,
    /// Whether visibilities are averages over their integrations, or instantaneous values at their middle.
    pub smear_integrations: bool,
    /// Integration time of the auto-correlations, s; 0 for none.
    pub auto_integration_s: f64,
    /// Whether visibilities are flagged while the Earth is in sight of one of their daughters.
    pub flag_earth: bool,
}

/// A window whose visibilities have not been predicted yet.
struct QueuedWindow {
    window: ObservingWindow,
    channels: Vec<QueuedChannel>,
}

/// A channel of a queued window.
struct QueuedChannel {
    visibilities: usize,
    /// The pairs that have integrations; none of a channel that is simulated elsewhere.
    pairs: Vec<PairSchedule>,
}

/// The integrations of a pair in a window.
struct PairSchedule {
    pair: Pair,
    integrations: Vec<Integration>,
}

/// One channel of a window, with what all pairs share.
#[derive(Clone, Copy)]
struct WindowChannel<'a> {
    window: ObservingWindow,
    channel: ChannelId,
    powers: &'a SkyPowers,
    /// Present if the Earth in sight is flagged.
    shadow: Option<&'a EarthShadow>,
    /// Present if the instrument has errors.
    pass: Option<&'a PassErrors>,
}

impl WindowChannel<'_> {
    /// Flags of an integration.
    fn flags(&self, pair: Pair, from: MissionTime, duration_ticks: u32) -> Flags {
        let until = from.plus_ticks(duration_ticks.into());
        match self.shadow {
            Some(shadow) if !shadow.covers(pair, from, until) => Flags::EARTH,
            _ => Flags::GOOD,
        }
    }
}

/// Thermal noise of integrated visibilities.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseModel {
    /// Seed of the noise; `None` adds none (weights are those of the noise anyway).
    pub seed: Option<u64>,
    /// Receiver noise of each channel, T_rec / zeta with all that is added to it, K sr.
    pub receiver_noise_k_sr: Vec<f64>,
    /// The antennas, which may have several receivers.
    pub response: AntennaResponse,
}

impl NoiseModel {
    /// Standard deviation of the real and of the imaginary part, K sr, for sky powers `Int T S A dn` at the two daughters:
    /// `sqrt(P_i P_j / (2 dnu dt))` with `P = T_rec / zeta + Int T S A dn` (the paper, Eq. 12, with each daughter's own
    /// system temperature).
    ///
    /// Three dipoles have three receivers. Their mean times 3/2 is half of a sum: of the sky's powers P, and of 3/2 of a receiver's
    /// noise. Where each has a third of that, the variance is a third of that of one receiver with the same power; dipoles whose powers
    /// differ by 10 % add 1 % to it, which is left out.
    #[must_use]
    pub fn sigma_k_sr(&self, channel: ChannelId, powers_k_sr: [f64; 2], width_hz: f64, dt_s: f64) -> f64 {
        let receiver = self.receiver_k_sr(channel);
        let [p_i, p_j] = powers_k_sr.map(|power| receiver + power);
        (p_i * p_j / (2.0 * self.samples(width_hz, dt_s))).sqrt()
    }

    /// Independent samples of an integration in all receivers of a daughter.
    fn samples(&self, width_hz: f64, dt_s: f64) -> f64 {
        f64::from(self.response.receivers()) * width_hz * dt_s
    }

    fn receiver_k_sr(&self, channel: ChannelId) -> f64 {
        let one_k_sr = self.receiver_noise_k_sr.get(usize::from(channel.0)).copied().unwrap_or(0.0);
        match self.response.receivers() {
            1 => one_k_sr,
            receivers => 0.5 * f64::from(receivers) * one_k_sr,
        }
    }

    /// Random stream of the noise of a pair, or of an auto-correlation, in a channel and window.
    fn stream(&self, window: ObservingWindow, channel: ChannelId, pair: Pair) -> Option<ChaCha8Rng> {
        let identity = u64::from(channel.0) << 32 | u64::from(pair.i) << 8 | u64::from(pair.j);
        let stream =
            |seed| random_stream(seed, StreamKind::VisibilityNoise, [identity, window.start.0 as u64]);
        self.seed.map(stream)
    }
}

impl Integrator {
    /// An integrator with one schedule and one model per channel of `instrument`.
    #[must_use]
    pub fn new(
        array: Arc<Array>,
        models: Vec<ChannelModel>,
        instrument: Instrument,
        schedules: Vec<Schedule>,
        options: MeasurementOptions,
    ) -> Self {
        Self { array, models, instrument, schedules, options, queued: Vec::new(), sampled: 0, errors: None }
    }

    /// Adds errors of the instrument.
    #[must_use]
    pub fn with_errors(self, errors: Option<Arc<InstrumentErrors>>) -> Self {
        Self { errors, ..self }
    }

    /// The integrations of every channel and pair in a window.
    fn schedule(&self, window: ObservingWindow) -> QueuedWindow {
        let pairs = all_pairs(self.array.satellites());
        let channel = |(schedule, model): (&Schedule, &ChannelModel)| {
            let scheduled = |&pair: &Pair| PairSchedule {
                pair,
                integrations: schedule.integrations(&self.array, window, pair),
            };
            if model.model.is_none() {
                let count = |pair: &Pair| schedule.integrations(&self.array, window, *pair).len();
                return QueuedChannel { visibilities: pairs.par_iter().map(count).sum(), pairs: Vec::new() };
            }
            let all: Vec<PairSchedule> = pairs.par_iter().map(scheduled).collect();
            let pairs: Vec<PairSchedule> =
                all.into_iter().filter(|pair| !pair.integrations.is_empty()).collect();
            QueuedChannel { visibilities: pairs.iter().map(|pair| pair.integrations.len()).sum(), pairs }
        };
        QueuedWindow { window, channels: self.schedules.iter().zip(&self.models).map(channel).collect() }
    }

    /// Whether the queue is large enough to be predicted.
    fn batch_is_full(&self) -> bool {
        let counts: Vec<usize> = (0..self.schedules.len())
            .map(|channel| self.queued.iter().map(|queued| queued.channels[channel].visibilities).sum())
            .collect();
        self.queued.len() >= QUEUED_WINDOWS_MAX
            || counts.iter().sum::<usize>() >= QUEUED_VISIBILITIES_MAX
            || counts.iter().zip(&self.models).all(|(&count, model)| count >= model.batch)
            // Nothing to predict: the windows only need to be reported.
            || counts.iter().all(|&count| count == 0)
    }

    /// Predicts, measures and emits all queued windows.
    fn measure_queue(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        let queued = std::mem::take(&mut self.queued);
        let windows: Vec<ObservingWindow> = queued.iter().map(|queued| queued.window).collect();
        let shadows = self.shadows(&windows);
        let passes: Vec<PassErrors> = match &self.errors {
            Some(errors) => windows.par_iter().map(|window| errors.pass(*window)).collect(),
            None => Vec::new(),
        };
        // By channel, then by window.
        let mut blocks: Vec<std::vec::IntoIter<Vec<VisibilityBlock>>> = Vec::new();
        let mut powers: Vec<(ChannelId, Vec<SkyPowers>)> = Vec::new();
        for channel in 0..self.schedules.len() {
            let Some(model) = &mut self.models[channel].model else { continue };
            let sky = SkyPowers::predict(model.as_mut(), &self.array, &windows)?;
            blocks.push(self.channel_blocks(&queued, channel, &sky, (&shadows, &passes))?.into_iter());
            powers.push((ChannelId(channel as u16), sky));
            if out.is_closed() {
                return Ok(());
            }
        }
        for (k, window) in windows.into_iter().enumerate() {
            describe(&self.array, &self.instrument, window, passes.get(k), out);
            let visibilities = blocks.iter_mut().flat_map(|windows| windows.next().unwrap_or_default());
            let autos = powers.iter().flat_map(|(channel, powers)| {
                let (shadow, pass) = (shadows.get(k), passes.get(k));
                self.autos(WindowChannel { window, channel: *channel, powers: &powers[k], shadow, pass })
            });
            let blocks = visibilities.chain(autos).map(|mut block| {
                if let Some(pass) = passes.get(k) {
                    pass.tag(&mut block);
                }
                block
            });
            self.sampled += send_window(blocks, window, self.sampled, out);
            if out.is_closed() {
                return Ok(());
            }
        }
        Ok(())
    }

    /// The Earth's shadow in each window; none if it does not matter.
    fn shadows(&self, windows: &[ObservingWindow]) -> Vec<EarthShadow> {
        if !self.options.flag_earth {
            return Vec::new();
        }
        windows.iter().map(|window| EarthShadow::new(&self.array, *window)).collect()
    }

    /// The measurements of one channel, window by window and pair by pair.
    fn channel_blocks(
        &mut self,
        queued: &[QueuedWindow],
        channel: usize,
        powers: &[SkyPowers],
        (shadows, passes): (&[EarthShadow], &[PassErrors]),
    ) -> Result<Vec<Vec<VisibilityBlock>>, ModelError> {
        let scheduled: Vec<(WindowChannel, &PairSchedule)> = queued
            .iter()
            .zip(powers)
            .enumerate()
            .flat_map(|(k, (queued, powers))| {
                let (window, shadow, pass) = (queued.window, shadows.get(k), passes.get(k));
                let channel_id = ChannelId(channel as u16);
                let context = WindowChannel { window, channel: channel_id, powers, shadow, pass };
                queued.channels[channel].pairs.iter().map(move |pair| (context, pair))
            })
            .collect();
        let positions: Vec<Vec<PairPosition>> =
            scheduled.par_iter().map(|(context, pair)| self.positions(context.window, pair)).collect();
        let positions = positions.concat();
        let mut predictions = vec![Complex64::ZERO; positions.len()];
        if let Some(model) = &mut self.models[channel].model {
            model.predict(&positions, &mut predictions)?;
        }
        let mut rest = &predictions[..];
        let mut parts = Vec::with_capacity(scheduled.len());
        for (_, pair) in &scheduled {
            let (part, after) = rest.split_at(pair.integrations.len());
            parts.push(part);
            rest = after;
        }
        let measure = |((context, pair), part): (&(WindowChannel, &PairSchedule), &&[Complex64])| {
            self.measure(*context, pair, part)
        };
        let blocks: Vec<VisibilityBlock> = scheduled.par_iter().zip(&parts).map(measure).collect();
        let mut blocks = blocks.into_iter();
        let of_window =
            |queued: &QueuedWindow| blocks.by_ref().take(queued.channels[channel].pairs.len()).collect();
        Ok(queued.iter().map(of_window).collect())
    }

    /// Positions of a pair at the middle of each of its integrations.
    fn positions(&self, window: ObservingWindow, scheduled: &PairSchedule) -> Vec<PairPosition> {
        let Pair { i, j } = scheduled.pair;
        let position = |integration: &Integration| {
            let dt_s = f64::from(integration.duration_ticks) / TICKS_PER_SECOND as f64;
            let from = window.start.plus_ticks(i64::from(integration.offset_ticks));
            let time_s = from.seconds() + 0.5 * dt_s;
            let smeared = self.options.smear_integrations;
            PairPosition {
                pair_time: Some((scheduled.pair, time_s)),
                r_i_m: self.array.position_m(i.into(), time_s),
                r_j_m: self.array.position_m(j.into(), time_s),
                span_rad: if smeared { TAU * dt_s / self.array.orbital_period_s() } else { 0.0 },
            }
        };
        scheduled.integrations.iter().map(position).collect()
    }

    /// Adds noise, weights and time tags to the model's predictions.
    fn measure(
        &self,
        context: WindowChannel,
        scheduled: &PairSchedule,
        predictions: &[Complex64],
    ) -> VisibilityBlock {
        let WindowChannel { window, channel, powers, .. } = context;
        let (pair, noise_model) = (scheduled.pair, &self.options.noise);
        let width_hz = self.instrument.channels[usize::from(channel.0)].width_hz;
        let mut noise = noise_model.stream(window, channel, pair);
        let mut troubles = self.troubles(context, pair);
        let mut block = VisibilityBlock { channel, pair, start: window.start, ..VisibilityBlock::default() };
        for (integration, prediction) in scheduled.integrations.iter().zip(predictions) {
            let dt_s = f64::from(integration.duration_ticks) / TICKS_PER_SECOND as f64;
            let from = window.start.plus_ticks(i64::from(integration.offset_ticks));
            let middle_s = from.seconds() + 0.5 * dt_s;
            let mut own = [pair.i, pair.j].map(|n| powers.at(&self.array, n.into(), middle_s));
            let mut value = *prediction;
            let mut gain = Complex64::ONE;
            if let Some(troubles) = &troubles {
                let signals = troubles.signals(middle_s);
                value += signals.visibility_k_sr;
                own.iter_mut().zip(signals.powers_k_sr).for_each(|(own, power)| *own += power);
                gain = troubles.gain(middle_s);
                // A dead receiver delivers noise of the same power.
                value = if troubles.is_dead() { Complex64::ZERO } else { value * gain };
            }
            let sigma = noise_model.sigma_k_sr(channel, own, width_hz, dt_s) * gain.norm();
            if let Some(stream) = &mut noise {
                let draw: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(stream));
                value.re += sigma * draw[0];
                value.im += sigma * draw[1];
            }
            let mut flags = context.flags(pair, from, integration.duration_ticks);
            if let Some(troubles) = &mut troubles {
                value += sigma * troubles.outlier();
                if troubles.beacon_is_on(middle_s) {
                    flags.0 |= Flags::BEACON.0;
                }
            }
            block.offset_ticks.push(integration.offset_ticks);
            block.duration_ticks.push(integration.duration_ticks);
            block.value_k_sr.push(Complex32::new(value.re as f32, value.im as f32));
            block.weight.push((sigma * sigma).recip() as f32);
            block.flags.push(flags);
        }
        block
    }

    /// What is wrong with a pair, if anything is.
    fn troubles<'a>(&'a self, context: WindowChannel<'a>, pair: Pair) -> Option<PairTroubles<'a>> {
        let (errors, pass) = (self.errors.as_deref()?, context.pass?);
        let channel = usize::from(context.channel.0);
        Some(PairTroubles {
            errors,
            pass,
            array: &self.array,
            window: context.window,
            pair,
            channel,
            frequency_hz: self.instrument.channels[channel].frequency_hz,
            outliers: errors.outliers(context.window, channel, pair),
        })
    }

    /// Auto-correlations over a window, if configured: contiguous integrations, the last one cut at the window's end.
    fn autos(&self, context: WindowChannel) -> Vec<VisibilityBlock> {
        let WindowChannel { window, channel, powers, .. } = context;
        let step = (self.options.auto_integration_s * TICKS_PER_SECOND as f64) as u32;
        if step == 0 {
            return Vec::new();
        }
        let noise_model = &self.options.noise;
        let width_hz = self.instrument.channels[usize::from(channel.0)].width_hz;
        let length = (window.end.0 - window.start.0).clamp(0, i64::from(u32::MAX)) as u32;
        let block = |n: u8| {
            let pair = Pair { i: n, j: n };
            let mut noise = noise_model.stream(window, channel, pair);
            let troubles = self.troubles(context, pair);
            let mut block =
                VisibilityBlock { channel, pair, start: window.start, ..VisibilityBlock::default() };
            for offset in (0..length).step_by(step as usize) {
                let duration = step.min(length - offset);
                let dt_s = f64::from(duration) / TICKS_PER_SECOND as f64;
                let from = window.start.plus_ticks(offset.into());
                let middle_s = from.seconds() + 0.5 * dt_s;
                let mut expected_k_sr =
                    noise_model.receiver_k_sr(channel) + powers.at(&self.array, n.into(), middle_s);
                let mut flags = context.flags(pair, from, duration);
                if let Some(troubles) = &troubles {
                    expected_k_sr += troubles.signals(middle_s).powers_k_sr[0];
                    expected_k_sr *= troubles.gain(middle_s).norm();
                    if troubles.beacon_is_on(middle_s) {
                        flags.0 |= Flags::BEACON.0;
                    }
                }
                let samples = noise_model.samples(width_hz, dt_s);
                // The last integration may be shorter than one sample, which has no power.
                if samples < 1.0 {
                    continue;
                }
                let power = noise
                    .as_mut()
                    .map_or(expected_k_sr, |stream| expected_k_sr * mean_square(samples, stream));
                block.offset_ticks.push(offset);
                block.duration_ticks.push(duration);
                block.value_k_sr.push(Complex32::new(power as f32, 0.0));
                block.weight.push((samples / (power * power)) as f32);
                block.flags.push(flags);
            }
            block
        };
        (0..self.array.satellites() as u8).into_par_iter().map(block).collect()
    }
}

/// A random mean of |x|^2 over `samples` samples of a complex Gaussian of unit power.
fn mean_square(samples: f64, stream: &mut impl rand::Rng) -> f64 {
    // The distribution exists for any positive shape and scale.
    Gamma::new(samples, samples.recip()).map_or(1.0, |gamma| gamma.sample(stream))
}

/// Begins a window: what the spacecraft says of the instrument, and where its daughters are.
pub(super) fn describe(
    array: &Array,
    instrument: &Instrument,
    window: ObservingWindow,
    pass: Option<&PassErrors>,
    out: &mut Outlet<GroundFrame>,
) {
    out.push(GroundFrame::Instrument(instrument.clone()));
    for segment in positions_said(array, window, pass) {
        out.push(GroundFrame::Ephemeris(segment));
    }
}

/// The ephemeris of a window as packets say it; beyond the window where time tags may lie outside it.
pub(super) fn positions_said(
    array: &Array,
    window: ObservingWindow,
    pass: Option<&PassErrors>,
) -> Vec<EphemerisSegment> {
    let reach_s = pass.map_or(0.0, PassErrors::reach_s);
    let reach = MissionTime::from_seconds(reach_s).0;
    let (mut from, mut until) = (window.start.plus_ticks(-reach), window.end.plus_ticks(reach));
    if let Some([from_s, until_s]) = array.known_s().filter(|_| reach > 0) {
        from = from.max(MissionTime::from_seconds(from_s).plus_ticks(1)).min(window.start);
        until = until.min(MissionTime::from_seconds(until_s).plus_ticks(-1)).max(window.end);
    }
    let mut segments = segments_for(array, from, until, EPHEMERIS_STEP_S);
    if let Some(pass) = pass {
        segments.iter_mut().for_each(|segment| pass.add_errors(segment, array));
    }
    segments
}

/// Sends the visibilities of a window and closes it; returns their number. `sampled` is that of all windows before.
pub(super) fn send_window(
    blocks: impl Iterator<Item = VisibilityBlock>,
    window: ObservingWindow,
    sampled: u64,
    out: &mut Outlet<GroundFrame>,
) -> u64 {
    let mut count = 0;
    for block in blocks {
        count += block.len() as u64;
        out.push(GroundFrame::Visibilities(block));
    }
    let (time, sampled) = (window.end, sampled + count);
    out.push(GroundFrame::Housekeeping(Housekeeping { time, sampled, dropped: 0 }));
    count
}

impl Stage for Integrator {
    type In = ObservingWindow;
    type Out = GroundFrame;
    type Error = ModelError;

    fn step(&mut self, window: ObservingWindow, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        let scheduled = self.schedule(window);
        self.queued.push(scheduled);
        if self.batch_is_full() { self.measure_queue(out) } else { Ok(()) }
    }

    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        self.measure_queue(out)
    }

    fn units(&self) -> Units {
        Units::of(self.sampled, "visibilities")
    }
}
