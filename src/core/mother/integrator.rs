//! Stage that simulates the integrated visibilities of observing windows.

use std::f64::consts::TAU;
use std::sync::Arc;

use num_complex::{Complex32, Complex64};
use rand_distr::{Distribution, Gamma, StandardNormal};
use rayon::prelude::*;

use super::moving::MovingSky;
use super::noise::NoiseModel;
use super::pair_errors::PairErrors;
use super::powers::{NOISE_STEP_S, SENT_STEP_S, SkyPowers};
use super::schedule::{Integration, Schedule};
use crate::array::{Array, EarthOccultation, segments_for};
use crate::daughters::{InstrumentErrors, PassErrors};
use crate::frames::{
    EphemerisSegment, Flags, GroundFrame, Housekeeping, Instrument, ObservingWindow, VisibilityBlock,
};
use crate::response::model::{ModelError, PairPosition, VisibilityModel};
use crate::runtime::{Outlet, Stage, Units};
use crate::units::{ChannelId, MissionTime, Pair, TICKS_PER_SECOND, all_pairs};

/// Maximum spacing of tabulated positions, s: interpolation is then accurate to micrometres.
const EPHEMERIS_STEP_S: f64 = 60.0;

/// Number of queued visibilities of all channels at which they are predicted, even if batches are not full; bounds
/// memory to some 200 MB.
const QUEUED_VISIBILITIES_MAX: usize = 1_000_000;
/// Number of queued windows at which they are predicted, even if batches are not full.
const QUEUED_WINDOWS_MAX: usize = 64;

/// Simulates the integrated visibilities of all pairs and channels in each window.
///
/// Emits for each window: the instrument description, the ephemeris, the visibilities by channel and pair, the
/// auto-correlations if configured, and a housekeeping frame that closes the window. Windows are queued until the
/// models have enough visibilities for an efficient batch. Batches depend on the windows alone, so that results are
/// reproducible.
pub struct Integrator {
    array: Arc<Array>,
    models: Vec<ChannelModel>,
    instrument: Instrument,
    schedules: Vec<Schedule>,
    options: MeasurementOptions,
    queued: Vec<QueuedWindow>,
    sampled: u64,
    errors: Option<Arc<InstrumentErrors>>,
    moving: Option<Arc<MovingSky>>,
}

/// Model of a channel.
pub struct ChannelModel {
    /// Preferred number of visibilities per call.
    pub batch: usize,
    /// The model; `None` for a channel that another process or group simulates. Batches count all channels, so that the
    /// results of a channel are bit-identical whichever others are simulated with it.
    pub model: Option<Box<dyn VisibilityModel>>,
}

/// Options of the conversion from predictions to measurements.
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

/// A window whose visibilities are not predicted yet.
struct QueuedWindow {
    window: ObservingWindow,
    channels: Vec<QueuedChannel>,
}

/// A channel of a queued window.
struct QueuedChannel {
    visibilities: usize,
    /// Pairs with integrations; empty for a channel that is simulated elsewhere.
    pairs: Vec<PairSchedule>,
}

/// The integrations of a pair in a window.
struct PairSchedule {
    pair: Pair,
    integrations: Vec<Integration>,
}

/// One channel of a window, with data that all pairs share.
#[derive(Clone, Copy)]
struct WindowChannel<'a> {
    window: ObservingWindow,
    channel: ChannelId,
    powers: &'a SkyPowers,
    /// Occultation of the Earth, if visibilities with the Earth in sight are flagged.
    earth_occultation: Option<&'a EarthOccultation>,
    /// Instrument errors of the pass, if there are any.
    pass: Option<&'a PassErrors>,
}

impl WindowChannel<'_> {
    /// Flags of an integration.
    fn flags(&self, pair: Pair, from: MissionTime, duration_ticks: u32) -> Flags {
        let until = from.plus_ticks(duration_ticks.into());
        match self.earth_occultation {
            Some(earth_occultation) if !earth_occultation.covers(pair, from, until) => Flags::EARTH,
            _ => Flags::GOOD,
        }
    }
}

impl Integrator {
    /// Creates an integrator with one schedule and one model per channel of `instrument`.
    #[must_use]
    pub fn new(
        array: Arc<Array>,
        models: Vec<ChannelModel>,
        instrument: Instrument,
        schedules: Vec<Schedule>,
        options: MeasurementOptions,
    ) -> Self {
        Self {
            array,
            models,
            instrument,
            schedules,
            options,
            queued: Vec::new(),
            sampled: 0,
            errors: None,
            moving: None,
        }
    }

    /// Adds errors of the instrument.
    #[must_use]
    pub fn with_errors(self, errors: Option<Arc<InstrumentErrors>>) -> Self {
        Self { errors, ..self }
    }

    /// Adds moving sources, to visibilities, auto-correlations and their noise.
    #[must_use]
    pub fn with_moving(self, moving: Option<Arc<MovingSky>>) -> Self {
        Self { moving, ..self }
    }

    /// Schedules the integrations of every channel and pair in a window.
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

    /// Whether the queue is large enough for a prediction.
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

    /// Simulates and emits all queued windows.
    fn simulate_queue(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        let queued = std::mem::take(&mut self.queued);
        let windows: Vec<ObservingWindow> = queued.iter().map(|queued| queued.window).collect();
        let earth_occultations = self.earth_occultations(&windows);
        let passes: Vec<PassErrors> = match &self.errors {
            Some(errors) => windows.par_iter().map(|window| errors.pass(*window)).collect(),
            None => Vec::new(),
        };
        // By channel, then by window.
        let mut blocks: Vec<std::vec::IntoIter<Vec<VisibilityBlock>>> = Vec::new();
        let mut powers: Vec<(ChannelId, Vec<SkyPowers>)> = Vec::new();
        for channel in 0..self.schedules.len() {
            let Some(model) = &mut self.models[channel].model else { continue };
            let step_s = if self.options.auto_integration_s > 0.0 { SENT_STEP_S } else { NOISE_STEP_S };
            let sky = SkyPowers::predict(model.as_mut(), &self.array, &windows, step_s)?;
            blocks.push(
                self.channel_blocks(&queued, channel, &sky, (&earth_occultations, &passes))?.into_iter(),
            );
            powers.push((ChannelId(channel as u16), sky));
            if out.is_closed() {
                return Ok(());
            }
        }
        for (k, window) in windows.into_iter().enumerate() {
            send_window_header(&self.array, &self.instrument, window, passes.get(k), out);
            let visibilities = blocks.iter_mut().flat_map(|windows| windows.next().unwrap_or_default());
            let autos = powers.iter().flat_map(|(channel, powers)| {
                let (earth_occultation, pass) = (earth_occultations.get(k), passes.get(k));
                self.autos(WindowChannel {
                    window,
                    channel: *channel,
                    powers: &powers[k],
                    earth_occultation,
                    pass,
                })
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

    /// Occultations of the Earth in each window; empty if they are not needed.
    fn earth_occultations(&self, windows: &[ObservingWindow]) -> Vec<EarthOccultation> {
        if !self.options.flag_earth {
            return Vec::new();
        }
        windows.iter().map(|window| EarthOccultation::new(&self.array, *window)).collect()
    }

    /// Simulates one channel, window by window and pair by pair.
    fn channel_blocks(
        &mut self,
        queued: &[QueuedWindow],
        channel: usize,
        powers: &[SkyPowers],
        (earth_occultations, passes): (&[EarthOccultation], &[PassErrors]),
    ) -> Result<Vec<Vec<VisibilityBlock>>, ModelError> {
        let scheduled: Vec<(WindowChannel, &PairSchedule)> = queued
            .iter()
            .zip(powers)
            .enumerate()
            .flat_map(|(k, (queued, powers))| {
                let (window, earth_occultation, pass) =
                    (queued.window, earth_occultations.get(k), passes.get(k));
                let channel_id = ChannelId(channel as u16);
                let context = WindowChannel { window, channel: channel_id, powers, earth_occultation, pass };
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
        let add_noise_and_errors =
            |((context, pair), part): (&(WindowChannel, &PairSchedule), &&[Complex64])| {
                self.add_noise_and_errors(*context, pair, part)
            };
        let blocks: Vec<VisibilityBlock> =
            scheduled.par_iter().zip(&parts).map(add_noise_and_errors).collect();
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

    /// Adds errors, noise and weights to the model's predictions for a pair.
    fn add_noise_and_errors(
        &self,
        context: WindowChannel,
        scheduled: &PairSchedule,
        predictions: &[Complex64],
    ) -> VisibilityBlock {
        let WindowChannel { window, channel, powers, .. } = context;
        let (pair, noise_model) = (scheduled.pair, &self.options.noise);
        let of_channel = &self.instrument.channels[usize::from(channel.0)];
        let width_hz = of_channel.width_hz;
        let mut noise = noise_model.stream(window, channel, pair);
        let mut pair_errors = self.pair_errors(context, pair);
        let mut block = VisibilityBlock { channel, pair, start: window.start, ..VisibilityBlock::default() };
        for (integration, prediction) in scheduled.integrations.iter().zip(predictions) {
            let dt_s = f64::from(integration.duration_ticks) / TICKS_PER_SECOND as f64;
            let from = window.start.plus_ticks(i64::from(integration.offset_ticks));
            let middle_s = from.seconds() + 0.5 * dt_s;
            let mut antenna_powers_k_sr =
                [pair.i, pair.j].map(|n| powers.at(&self.array, n.into(), middle_s));
            let mut value = *prediction;
            if let Some(moving) = &self.moving {
                let signal = moving.signal(pair, of_channel, middle_s, dt_s);
                value += signal.visibility_k_sr;
                antenna_powers_k_sr
                    .iter_mut()
                    .zip(signal.powers_k_sr)
                    .for_each(|(total, power)| *total += power);
            }
            let mut gain = Complex64::ONE;
            if let Some(pair_errors) = &pair_errors {
                let interference = pair_errors.artificial_signals(middle_s);
                value += interference.visibility_k_sr;
                antenna_powers_k_sr
                    .iter_mut()
                    .zip(interference.powers_k_sr)
                    .for_each(|(total, power)| *total += power);
                gain = pair_errors.gain(middle_s);
                // A dead receiver delivers noise of the same power.
                value = if pair_errors.is_dead() { Complex64::ZERO } else { value * gain };
            }
            let sigma = noise_model.sigma_k_sr(channel, antenna_powers_k_sr, width_hz, dt_s) * gain.norm();
            if let Some(stream) = &mut noise {
                let draw: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(stream));
                value.re += sigma * draw[0];
                value.im += sigma * draw[1];
            }
            let mut flags = context.flags(pair, from, integration.duration_ticks);
            if let Some(pair_errors) = &mut pair_errors {
                value += sigma * pair_errors.outlier();
                if pair_errors.beacon_is_on(middle_s) {
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

    /// Instrument errors of a pair in a window; `None` for an ideal instrument.
    fn pair_errors<'a>(&'a self, context: WindowChannel<'a>, pair: Pair) -> Option<PairErrors<'a>> {
        let (errors, pass) = (self.errors.as_deref()?, context.pass?);
        let channel = usize::from(context.channel.0);
        Some(PairErrors {
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
        let of_channel = &self.instrument.channels[usize::from(channel.0)];
        let width_hz = of_channel.width_hz;
        let length = (window.end.0 - window.start.0).clamp(0, i64::from(u32::MAX)) as u32;
        let block = |n: u8| {
            let pair = Pair { i: n, j: n };
            let mut noise = noise_model.stream(window, channel, pair);
            let pair_errors = self.pair_errors(context, pair);
            let mut block =
                VisibilityBlock { channel, pair, start: window.start, ..VisibilityBlock::default() };
            for offset in (0..length).step_by(step as usize) {
                let duration = step.min(length - offset);
                let dt_s = f64::from(duration) / TICKS_PER_SECOND as f64;
                let from = window.start.plus_ticks(offset.into());
                let middle_s = from.seconds() + 0.5 * dt_s;
                // The mean over the integration, in which the Moon's direction changes: Gauss's quadrature with two points.
                let offset_s = 0.5 * dt_s / 3.0_f64.sqrt();
                let sky_k_sr = |t_s: f64| 0.5 * powers.at(&self.array, n.into(), t_s);
                let mut expected_k_sr = noise_model.receiver_k_sr(channel)
                    + sky_k_sr(middle_s - offset_s)
                    + sky_k_sr(middle_s + offset_s);
                if let Some(moving) = &self.moving {
                    expected_k_sr += moving.signal(pair, of_channel, middle_s, dt_s).powers_k_sr[0];
                }
                let mut flags = context.flags(pair, from, duration);
                if let Some(pair_errors) = &pair_errors {
                    expected_k_sr += pair_errors.artificial_signals(middle_s).powers_k_sr[0];
                    expected_k_sr *= pair_errors.gain(middle_s).norm();
                    if pair_errors.beacon_is_on(middle_s) {
                        flags.0 |= Flags::BEACON.0;
                    }
                }
                let samples = noise_model.samples(width_hz, dt_s);
                // The last integration may be too short for an independent sample: no power is estimated for it.
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

/// Draws a mean of |x|^2 over `samples` samples of a complex Gaussian of unit power.
fn mean_square(samples: f64, stream: &mut impl rand::Rng) -> f64 {
    // The distribution exists for any positive shape and scale.
    Gamma::new(samples, samples.recip()).map_or(1.0, |gamma| gamma.sample(stream))
}

/// Sends the instrument description and the ephemeris of a window.
pub(super) fn send_window_header(
    array: &Array,
    instrument: &Instrument,
    window: ObservingWindow,
    pass: Option<&PassErrors>,
    out: &mut Outlet<GroundFrame>,
) {
    out.push(GroundFrame::Instrument(instrument.clone()));
    for segment in reported_ephemeris(array, window, pass) {
        out.push(GroundFrame::Ephemeris(segment));
    }
}

/// Ephemeris of a window as reported in packets, with navigation errors. It extends beyond the window if time tags
/// may lie outside.
pub(super) fn reported_ephemeris(
    array: &Array,
    window: ObservingWindow,
    pass: Option<&PassErrors>,
) -> Vec<EphemerisSegment> {
    let tag_error_max_s = pass.map_or(0.0, PassErrors::tag_error_max_s);
    let margin_ticks = MissionTime::from_seconds(tag_error_max_s).0;
    let (mut from, mut until) = (window.start.plus_ticks(-margin_ticks), window.end.plus_ticks(margin_ticks));
    if let Some([from_s, until_s]) = array.known_s().filter(|_| margin_ticks > 0) {
        from = from.max(MissionTime::from_seconds(from_s).plus_ticks(1)).min(window.start);
        until = until.min(MissionTime::from_seconds(until_s).plus_ticks(-1)).max(window.end);
    }
    let mut segments = segments_for(array, from, until, EPHEMERIS_STEP_S);
    if let Some(pass) = pass {
        segments.iter_mut().for_each(|segment| pass.add_errors(segment, array));
    }
    segments
}

/// Sends the visibilities of a window and closes it; returns their number. `sampled` is the total of all earlier
/// windows.
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
        let window = self.schedule(window);
        self.queued.push(window);
        if self.batch_is_full() { self.simulate_queue(out) } else { Ok(()) }
    }

    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        self.simulate_queue(out)
    }

    fn units(&self) -> Units {
        Units::of(self.sampled, "visibilities")
    }
}
