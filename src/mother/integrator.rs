//! The stage that turns observing windows into integrated visibilities.

use std::convert::Infallible;
use std::sync::Arc;

use num_complex::Complex32;
use rand_distr::{Distribution, StandardNormal};

use super::model::{PairPosition, Prediction, VisibilityModel};
use super::schedule::{Integration, Schedule};
use crate::array::{Array, segments_for};
use crate::frames::{Flags, GroundFrame, Housekeeping, Instrument, ObservingWindow, VisibilityBlock};
use crate::runtime::{Outlet, Stage, Units};
use crate::units::{ChannelId, Pair, StreamKind, TICKS_PER_SECOND, all_pairs, random_stream};

/// Greatest distance of tabulated positions, s; interpolation is then good to micrometres.
pub(super) const EPHEMERIS_STEP_S: f64 = 60.0;

/// Integrates all pairs and channels over each window.
///
/// Emits, window by window: the instrument description, the ephemeris, the visibilities channel by
/// channel and pair by pair, and a housekeeping frame that closes the window.
pub struct Integrator {
    array: Arc<Array>,
    model: Arc<dyn VisibilityModel>,
    instrument: Instrument,
    schedules: Vec<Schedule>,
    noise: NoiseModel,
    sampled: u64,
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
    /// An integrator of `schedules`, one a channel of `instrument`.
    #[must_use]
    pub fn new(
        array: Arc<Array>,
        model: Arc<dyn VisibilityModel>,
        instrument: Instrument,
        schedules: Vec<Schedule>,
        noise: NoiseModel,
    ) -> Self {
        Self { array, model, instrument, schedules, noise, sampled: 0 }
    }

    fn block(&self, window: ObservingWindow, channel: ChannelId, pair: Pair) -> VisibilityBlock {
        let schedule = &self.schedules[usize::from(channel.0)];
        let integrations = schedule.integrations(&self.array, window, pair);
        let positions: Vec<PairPosition> =
            integrations.iter().map(|&integration| self.position(window, pair, integration)).collect();
        let mut predictions = vec![Prediction::default(); positions.len()];
        self.model.predict(channel, &positions, &mut predictions);
        self.measure(window, channel, pair, &integrations, &predictions)
    }

    fn position(&self, window: ObservingWindow, pair: Pair, integration: Integration) -> PairPosition {
        let half_s = 0.5 * f64::from(integration.duration_ticks) / TICKS_PER_SECOND as f64;
        let from = window.start.plus_ticks(i64::from(integration.offset_ticks));
        let time_s = from.seconds() + half_s;
        PairPosition {
            r_i_m: self.array.position_m(pair.i.into(), time_s),
            r_j_m: self.array.position_m(pair.j.into(), time_s),
        }
    }

    /// Adds noise, weights and time tags to what the model predicts.
    fn measure(
        &self,
        window: ObservingWindow,
        channel: ChannelId,
        pair: Pair,
        integrations: &[Integration],
        predictions: &[Prediction],
    ) -> VisibilityBlock {
        let width_hz = self.instrument.channels[usize::from(channel.0)].width_hz;
        let identity = u64::from(channel.0) << 32 | u64::from(pair.i) << 8 | u64::from(pair.j);
        let mut noise = self
            .noise
            .seed
            .map(|seed| random_stream(seed, StreamKind::VisibilityNoise, [identity, window.start.0 as u64]));
        let mut block = VisibilityBlock { channel, pair, start: window.start, ..VisibilityBlock::default() };
        for (integration, prediction) in integrations.iter().zip(predictions) {
            let dt_s = f64::from(integration.duration_ticks) / TICKS_PER_SECOND as f64;
            let sigma = self.noise.sigma_k_sr(prediction.zero_spacing_k_sr, width_hz, dt_s);
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

impl Stage for Integrator {
    type In = ObservingWindow;
    type Out = GroundFrame;
    type Error = Infallible;

    fn step(&mut self, window: ObservingWindow, out: &mut Outlet<GroundFrame>) -> Result<(), Infallible> {
        out.push(GroundFrame::Instrument(self.instrument.clone()));
        for segment in segments_for(&self.array, window.start, window.end, EPHEMERIS_STEP_S) {
            out.push(GroundFrame::Ephemeris(segment));
        }
        for channel in 0..self.schedules.len() {
            for pair in all_pairs(self.array.satellites()) {
                let block = self.block(window, ChannelId(channel as u16), pair);
                if !block.is_empty() {
                    self.sampled += block.len() as u64;
                    out.push(GroundFrame::Visibilities(block));
                }
                if out.is_closed() {
                    return Ok(());
                }
            }
        }
        let (time, sampled) = (window.end, self.sampled);
        out.push(GroundFrame::Housekeeping(Housekeeping { time, sampled, dropped: 0 }));
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.sampled, "visibilities")
    }
}
