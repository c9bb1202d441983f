//! The stage that turns observing windows into integrated visibilities.

use std::f64::consts::TAU;
use std::sync::Arc;

use num_complex::Complex32;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::model::{ModelError, PairPosition, Prediction, VisibilityModel};
use super::schedule::{Integration, Schedule};
use crate::array::{Array, segments_for};
use crate::frames::{Flags, GroundFrame, Housekeeping, Instrument, ObservingWindow, VisibilityBlock};
use crate::runtime::{Outlet, Stage, Units};
use crate::units::{ChannelId, Pair, StreamKind, TICKS_PER_SECOND, all_pairs, random_stream};

/// Greatest distance of tabulated positions, s; interpolation is then good to micrometres.
pub(super) const EPHEMERIS_STEP_S: f64 = 60.0;

/// Visibilities of all channels after which no model gets more at once; bounds memory to some 200 MB.
const WAITING_VISIBILITIES_MAX: usize = 1_000_000;
/// Windows after which no model gets more at once.
const WAITING_WINDOWS_MAX: usize = 64;

/// Integrates all pairs and channels over each window.
///
/// Emits, window by window: the instrument description, the ephemeris, the visibilities channel by
/// channel and pair by pair, and a housekeeping frame that closes the window. Windows wait until there are as
/// many visibilities as the channels' models like to predict at once, which depends on the windows alone.
pub struct Integrator {
    array: Arc<Array>,
    models: Vec<Box<dyn VisibilityModel>>,
    instrument: Instrument,
    schedules: Vec<Schedule>,
    options: MeasurementOptions,
    waiting: Vec<Waiting>,
    sampled: u64,
}

/// What is done to a prediction to make a measurement of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasurementOptions {
    /// Thermal noise.
    pub noise: NoiseModel,
    /// Whether visibilities are averages over their integrations, or of the instants in their middle.
    pub smear_integrations: bool,
}

/// A window whose visibilities are still to be predicted.
struct Waiting {
    window: ObservingWindow,
    /// By channel, the pairs that have integrations.
    channels: Vec<Vec<Scheduled>>,
}

/// The integrations of a pair in a window.
struct Scheduled {
    pair: Pair,
    integrations: Vec<Integration>,
}

/// Thermal noise of integrated visibilities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseModel {
    /// Seed of the noise; `None` adds none (weights stay those of the noise).
    pub seed: Option<u64>,
    /// Receiver noise T_rec / zeta, K sr.
    pub receiver_noise_k_sr: f64,
}

impl NoiseModel {
    /// Standard deviation of the real and of the imaginary part, K sr:
    /// `T_sys / sqrt(2 dnu dt)` with `T_sys = T_rec / zeta + Int T S A dn` (the paper, Eq. 12).
    #[must_use]
    pub fn sigma_k_sr(&self, zero_spacing_k_sr: f64, width_hz: f64, dt_s: f64) -> f64 {
        (self.receiver_noise_k_sr + zero_spacing_k_sr) / (2.0 * width_hz * dt_s).sqrt()
    }
}

impl Integrator {
    /// An integrator of `schedules` and `models`, one each for every channel of `instrument`.
    #[must_use]
    pub fn new(
        array: Arc<Array>,
        models: Vec<Box<dyn VisibilityModel>>,
        instrument: Instrument,
        schedules: Vec<Schedule>,
        options: MeasurementOptions,
    ) -> Self {
        Self { array, models, instrument, schedules, options, waiting: Vec::new(), sampled: 0 }
    }

    /// The integrations of every channel and pair in a window.
    fn schedule(&self, window: ObservingWindow) -> Waiting {
        let pairs = all_pairs(self.array.satellites());
        let channel = |schedule: &Schedule| {
            let scheduled = |&pair: &Pair| Scheduled {
                pair,
                integrations: schedule.integrations(&self.array, window, pair),
            };
            let all: Vec<Scheduled> = pairs.par_iter().map(scheduled).collect();
            all.into_iter().filter(|pair| !pair.integrations.is_empty()).collect()
        };
        Waiting { window, channels: self.schedules.iter().map(channel).collect() }
    }

    /// Whether what waits is enough to be predicted.
    fn enough_waits(&self) -> bool {
        let counts: Vec<usize> = (0..self.schedules.len())
            .map(|channel| self.waiting.iter().map(|waiting| waiting.visibilities(channel)).sum())
            .collect();
        self.waiting.len() >= WAITING_WINDOWS_MAX
            || counts.iter().sum::<usize>() >= WAITING_VISIBILITIES_MAX
            || counts.iter().zip(&self.models).all(|(&count, model)| count >= model.batch())
            // Nothing to predict: what waits is only told.
            || counts.iter().all(|&count| count == 0)
    }

    /// Predicts, measures and emits all windows that wait.
    fn measure_waiting(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        let waiting = std::mem::take(&mut self.waiting);
        // By channel, then by window.
        let mut blocks: Vec<std::vec::IntoIter<Vec<VisibilityBlock>>> = Vec::new();
        for channel in 0..self.schedules.len() {
            blocks.push(self.channel_blocks(&waiting, channel)?.into_iter());
            if out.is_closed() {
                return Ok(());
            }
        }
        for Waiting { window, .. } in waiting {
            out.push(GroundFrame::Instrument(self.instrument.clone()));
            for segment in segments_for(&self.array, window.start, window.end, EPHEMERIS_STEP_S) {
                out.push(GroundFrame::Ephemeris(segment));
            }
            for block in blocks.iter_mut().flat_map(|windows| windows.next().unwrap_or_default()) {
                self.sampled += block.len() as u64;
                out.push(GroundFrame::Visibilities(block));
            }
            let (time, sampled) = (window.end, self.sampled);
            out.push(GroundFrame::Housekeeping(Housekeeping { time, sampled, dropped: 0 }));
            if out.is_closed() {
                return Ok(());
            }
        }
        Ok(())
    }

    /// The measurements of one channel, window by window and pair by pair.
    fn channel_blocks(
        &mut self,
        waiting: &[Waiting],
        channel: usize,
    ) -> Result<Vec<Vec<VisibilityBlock>>, ModelError> {
        let scheduled: Vec<(ObservingWindow, &Scheduled)> = waiting
            .iter()
            .flat_map(|waiting| waiting.channels[channel].iter().map(|pair| (waiting.window, pair)))
            .collect();
        let positions: Vec<Vec<PairPosition>> =
            scheduled.par_iter().map(|(window, pair)| self.positions(*window, pair)).collect();
        let positions = positions.concat();
        let mut predictions = vec![Prediction::default(); positions.len()];
        self.models[channel].predict(&positions, &mut predictions)?;
        let mut rest = &predictions[..];
        let mut parts = Vec::with_capacity(scheduled.len());
        for (_, pair) in &scheduled {
            let (part, after) = rest.split_at(pair.integrations.len());
            parts.push(part);
            rest = after;
        }
        let measure = |((window, pair), part): (&(ObservingWindow, &Scheduled), &&[Prediction])| {
            self.measure(*window, ChannelId(channel as u16), pair, part)
        };
        let blocks: Vec<VisibilityBlock> = scheduled.par_iter().zip(&parts).map(measure).collect();
        let mut blocks = blocks.into_iter();
        let of_window = |waiting: &Waiting| blocks.by_ref().take(waiting.channels[channel].len()).collect();
        Ok(waiting.iter().map(of_window).collect())
    }

    /// Where a pair is in the middle of each of its integrations.
    fn positions(&self, window: ObservingWindow, scheduled: &Scheduled) -> Vec<PairPosition> {
        let Pair { i, j } = scheduled.pair;
        let position = |integration: &Integration| {
            let dt_s = f64::from(integration.duration_ticks) / TICKS_PER_SECOND as f64;
            let from = window.start.plus_ticks(i64::from(integration.offset_ticks));
            let time_s = from.seconds() + 0.5 * dt_s;
            let smeared = self.options.smear_integrations;
            PairPosition {
                r_i_m: self.array.position_m(i.into(), time_s),
                r_j_m: self.array.position_m(j.into(), time_s),
                span_rad: if smeared { TAU * dt_s / self.array.orbital_period_s() } else { 0.0 },
            }
        };
        scheduled.integrations.iter().map(position).collect()
    }

    /// Adds noise, weights and time tags to what the model predicts.
    fn measure(
        &self,
        window: ObservingWindow,
        channel: ChannelId,
        scheduled: &Scheduled,
        predictions: &[Prediction],
    ) -> VisibilityBlock {
        let (pair, noise_model) = (scheduled.pair, self.options.noise);
        let width_hz = self.instrument.channels[usize::from(channel.0)].width_hz;
        let identity = u64::from(channel.0) << 32 | u64::from(pair.i) << 8 | u64::from(pair.j);
        let mut noise = noise_model
            .seed
            .map(|seed| random_stream(seed, StreamKind::VisibilityNoise, [identity, window.start.0 as u64]));
        let mut block = VisibilityBlock { channel, pair, start: window.start, ..VisibilityBlock::default() };
        for (integration, prediction) in scheduled.integrations.iter().zip(predictions) {
            let dt_s = f64::from(integration.duration_ticks) / TICKS_PER_SECOND as f64;
            let sigma = noise_model.sigma_k_sr(prediction.zero_spacing_k_sr, width_hz, dt_s);
            let mut value = prediction.visibility_k_sr;
            if let Some(stream) = &mut noise {
                let draw: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(stream));
                value.re += sigma * draw[0];
                value.im += sigma * draw[1];
            }
            block.offset_ticks.push(integration.offset_ticks);
            block.duration_ticks.push(integration.duration_ticks);
            block.value_k_sr.push(Complex32::new(value.re as f32, value.im as f32));
            block.weight.push((sigma * sigma).recip() as f32);
            block.flags.push(Flags::GOOD);
        }
        block
    }
}

impl Waiting {
    /// Integrations of one channel.
    fn visibilities(&self, channel: usize) -> usize {
        self.channels[channel].iter().map(|pair| pair.integrations.len()).sum()
    }
}

impl Stage for Integrator {
    type In = ObservingWindow;
    type Out = GroundFrame;
    type Error = ModelError;

    fn step(&mut self, window: ObservingWindow, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        let scheduled = self.schedule(window);
        self.waiting.push(scheduled);
        if self.enough_waits() { self.measure_waiting(out) } else { Ok(()) }
    }

    fn finish(&mut self, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        self.measure_waiting(out)
    }

    fn units(&self) -> Units {
        Units::of(self.sampled, "visibilities")
    }
}
