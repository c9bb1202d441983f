//! Ninth daughter: a spectrometer for the whole sky from 30 to 120 MHz, which measures the monopole.

use std::sync::Arc;

use num_complex::Complex32;
use rand_distr::{Distribution, StandardNormal};

use super::sizes::VISIBILITY_BYTES;
use crate::array::Array;
use crate::frames::{Flags, GroundFrame, Housekeeping, ObservingWindow, Spectrometer, VisibilityBlock};
use crate::numerics::lagrange_weights;
use crate::response::model::{DaughterPosition, DirectSum, ModelError, VisibilityModel};
use crate::runtime::{Outlet, Stage, Units};
use crate::units::{
    ChannelId, Checks, InvalidValue, Pair, StreamKind, TICKS_PER_SECOND, keys, random_stream,
};

/// Lowest and highest frequency that a ninth daughter may observe, Hz.
pub const NINTH_BAND_HZ: [f64; 2] = [30e6, 120e6];

/// Minimum number of samples of an integration (width x time): the noise is modelled as Gaussian, and its true
/// skewness is then 2 %.
const SAMPLES_MIN: f64 = 1e4;

keys! {
    /// The `[spacecraft.ninth]` section.
    pub struct NinthConfig {
        /// Add a ninth daughter.
        everyday on: bool = false;
        /// Minimum and maximum frequency of the spectrum.
        #[only_with("spacecraft.ninth.on = true")]
        expert band_hz: [f64; 2] = NINTH_BAND_HZ;
        /// Number of channels in the band.
        #[only_with("spacecraft.ninth.on = true")]
        expert channels: usize = 90;
        /// Length of an integration.
        #[only_with("spacecraft.ninth.on = true")]
        expert integration_s: f64 = 10.0;
        /// Receiver noise over the antenna's transmission efficiency, T_rec / zeta.
        #[only_with("spacecraft.ninth.on = true")]
        expert receiver_noise_k_sr: f64 = 0.0;
        /// Arc by which it trails daughter 1 on the same circle.
        #[only_with("spacecraft.ninth.on = true")]
        expert arc_m: f64 = 110e3;
        /// Spectral index of temperature that extrapolates a sky from files above its highest channel.
        #[only_with("spacecraft.ninth.on = true")]
        expert file_index: f64 = -2.51;
    }
}

impl NinthConfig {
    /// The spectrometer in the instrument description; `None` without a ninth daughter.
    #[must_use]
    pub fn spectrometer(&self) -> Option<Spectrometer> {
        let [low_hz, high_hz] = self.band_hz;
        // At most 1024 in a valid configuration.
        let channels = self.channels as u16;
        let width_hz = (high_hz - low_hz) / f64::from(channels.max(1));
        self.on.then_some(Spectrometer { low_hz, width_hz, channels })
    }

    /// All problems of the section; empty if it is valid.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("spacecraft");
        let [low_hz, high_hz] = self.band_hz;
        let is_inside = NINTH_BAND_HZ[0] <= low_hz && low_hz < high_hz && high_hz <= NINTH_BAND_HZ[1];
        checks.number("ninth.band_hz", high_hz, is_inside, "two frequencies, rising, from 30e6 to 120e6 Hz");
        let channels = self.channels;
        checks.number("ninth.channels", channels as f64, (1..=1024).contains(&channels), "1 to 1024");
        let length_s = self.integration_s;
        checks.number(
            "ninth.integration_s",
            length_s,
            (1e-3..=1000.0).contains(&length_s),
            "0.001 s to 1000 s",
        );
        let samples = (high_hz - low_hz) / channels.max(1) as f64 * length_s;
        let is_sufficient = samples >= SAMPLES_MIN || !is_inside;
        checks.number(
            "ninth.integration_s",
            length_s,
            is_sufficient,
            "at least 1e4 samples: 1e4 / (width of a channel in Hz) seconds or more",
        );
        let noise = self.receiver_noise_k_sr;
        checks.number("ninth.receiver_noise_k_sr", noise, noise >= 0.0, "K sr, not negative");
        checks.number("ninth.arc_m", self.arc_m, (0.0..=1e6).contains(&self.arc_m), "0 m to 1e6 m");
        let index = self.file_index;
        checks.number("ninth.file_index", index, (-4.0..=0.0).contains(&index), "-4 to 0");
        checks.finish()
    }

    /// Data rate of the spectra while the array observes, bit/s, without packet headers.
    #[must_use]
    pub fn bits_per_s(&self) -> f64 {
        if !self.on {
            return 0.0;
        }
        8.0 * VISIBILITY_BYTES as f64 * self.channels as f64 / self.integration_s
    }
}

/// Sky over a band of frequencies, as one daughter receives it.
pub enum NinthSky {
    /// One map whose temperatures follow a power law in frequency.
    PowerLaw {
        /// Direct sums over the map.
        model: DirectSum,
        /// Frequency of the map, Hz.
        frequency_hz: f64,
        /// Spectral index.
        index: f64,
    },
    /// Maps at increasing frequencies, Hz, between which log power is a polynomial in log frequency.
    Maps(Vec<(f64, DirectSum)>),
}

impl NinthSky {
    /// Frequencies of maps that determine a smooth spectrum over a band: Chebyshev nodes in log frequency.
    #[must_use]
    pub fn nodes_hz([low_hz, high_hz]: [f64; 2]) -> Vec<f64> {
        const NODES: usize = 6;
        let (middle, half) = (0.5 * (low_hz * high_hz).ln(), 0.5 * (high_hz / low_hz).ln());
        let at = |k: usize| {
            let angle = std::f64::consts::PI * (k as f64 + 0.5) / NODES as f64;
            (middle - half * angle.cos()).exp()
        };
        (0..NODES).map(at).collect()
    }

    /// Powers (K sr) by position, then by frequency.
    ///
    /// # Errors
    /// A model does not cover the positions.
    pub fn powers(
        &mut self,
        positions: &[DaughterPosition],
        frequencies_hz: &[f64],
    ) -> Result<Vec<Vec<f64>>, ModelError> {
        match self {
            Self::PowerLaw { model, frequency_hz, index } => {
                let mut powers = vec![0.0; positions.len()];
                model.predict_powers(positions, &mut powers)?;
                let factors: Vec<f64> =
                    frequencies_hz.iter().map(|at_hz| (at_hz / *frequency_hz).powf(*index)).collect();
                let scaled = |power: f64| factors.iter().map(|factor| power * factor).collect();
                Ok(powers.into_iter().map(scaled).collect())
            }
            Self::Maps(maps) => {
                let mut map_powers = vec![vec![0.0; positions.len()]; maps.len()];
                for ((_, model), powers) in maps.iter_mut().zip(&mut map_powers) {
                    model.predict_powers(positions, powers)?;
                }
                let nodes: Vec<f64> = maps.iter().map(|(frequency_hz, _)| frequency_hz.ln()).collect();
                let weights: Vec<Vec<f64>> =
                    frequencies_hz.iter().map(|at_hz| lagrange_weights(&nodes, at_hz.ln())).collect();
                let at = |position: usize, weights: &Vec<f64>| {
                    weights
                        .iter()
                        .zip(&map_powers)
                        .map(|(w, powers)| w * powers[position].ln())
                        .sum::<f64>()
                        .exp()
                };
                Ok((0..positions.len())
                    .map(|position| weights.iter().map(|w| at(position, w)).collect())
                    .collect())
            }
        }
    }
}

/// Setup of [`Ninth`].
pub struct NinthSetup {
    /// The array, whose orbit the daughter shares.
    pub array: Arc<Array>,
    /// Settings of the daughter.
    pub config: NinthConfig,
    /// The sky that the daughter receives.
    pub sky: NinthSky,
    /// Windows of observation, in the order of time.
    pub windows: Vec<ObservingWindow>,
    /// Seed of the noise; `None` for no noise.
    pub seed: Option<u64>,
}

/// Forwards frames, and inserts the ninth daughter's spectra of each window before the frame that closes it.
///
/// Each power is that of sky plus receiver at the middle of an integration, with noise of P / sqrt(dnu dt) (the
/// radiometer equation of one receiver). Its weight is dnu dt / P^2 with the measured power. Integrations are
/// contiguous from the start of a window, the last one cut at its end. A remainder of fewer than 1e4 samples is added
/// to the preceding integration, or omitted if there is none.
pub struct Ninth {
    setup: NinthSetup,
    spectrometer: Spectrometer,
    windows: std::iter::Peekable<std::vec::IntoIter<ObservingWindow>>,
    /// Number of channels of the array: index of the first channel of the spectrum.
    first_channel: usize,
    /// Number of daughters of the array: index of the ninth daughter.
    satellite: u8,
    sampled: u64,
}

impl Ninth {
    /// Creates the ninth daughter of a setup; `None` if the configuration has none.
    #[must_use]
    pub fn new(mut setup: NinthSetup) -> Option<Self> {
        let windows = std::mem::take(&mut setup.windows).into_iter().peekable();
        let spectrometer = setup.config.spectrometer()?;
        Some(Self { setup, spectrometer, windows, first_channel: 0, satellite: 0, sampled: 0 })
    }

    /// Spectra of a window, by channel.
    fn spectra(&mut self, window: ObservingWindow) -> Result<Vec<VisibilityBlock>, ModelError> {
        let config = &self.setup.config;
        let length = (window.end.0 - window.start.0).clamp(0, i64::from(u32::MAX)) as u32;
        let step = ((config.integration_s * TICKS_PER_SECOND as f64) as u32).max(1);
        let mut offsets: Vec<u32> = (0..length).step_by(step as usize).collect();
        let mut durations: Vec<u32> = offsets.iter().map(|offset| step.min(length - offset)).collect();
        let samples = |duration: u32| self.spectrometer.width_hz * f64::from(duration) * 1e-6;
        if let Some(rest) = durations.pop_if(|duration| samples(*duration) < SAMPLES_MIN) {
            offsets.pop();
            if let Some(last) = durations.last_mut() {
                *last += rest;
            }
        }
        let position = |(offset, duration): (&u32, &u32)| {
            let middle = f64::from(*offset) + 0.5 * f64::from(*duration);
            let t_s = window.start.seconds() + middle / TICKS_PER_SECOND as f64;
            let r_m = self.setup.array.trailing_position_m(config.arc_m, t_s);
            DaughterPosition {
                r_m,
                normal_hat: self.setup.array.orbit_normal_hat(t_s),
                ..DaughterPosition::default()
            }
        };
        let positions: Vec<DaughterPosition> = offsets.iter().zip(&durations).map(position).collect();
        let channels: Vec<_> = self.spectrometer.channels().collect();
        let frequencies_hz: Vec<f64> = channels.iter().map(|channel| channel.frequency_hz).collect();
        let powers = self.setup.sky.powers(&positions, &frequencies_hz)?;
        let (first, satellite) = (self.first_channel, self.satellite);
        let blocks = channels.iter().enumerate().map(|(k, channel)| {
            let mut noise = self
                .setup
                .seed
                .map(|seed| random_stream(seed, StreamKind::Spectrometer, [k as u64, window.start.0 as u64]));
            let mut block = VisibilityBlock {
                channel: ChannelId((first + k) as u16),
                pair: Pair { i: satellite, j: satellite },
                start: window.start,
                offset_ticks: offsets.clone(),
                duration_ticks: durations.clone(),
                flags: vec![Flags::GOOD; offsets.len()],
                ..VisibilityBlock::default()
            };
            for (powers, duration) in powers.iter().zip(&durations) {
                let samples = channel.width_hz * f64::from(*duration) / TICKS_PER_SECOND as f64;
                let draw: f64 = noise.as_mut().map_or(0.0, |stream| StandardNormal.sample(stream));
                let power = (powers[k] + config.receiver_noise_k_sr) * (1.0 + draw / samples.sqrt());
                block.value_k_sr.push(Complex32::new(power as f32, 0.0));
                block.weight.push((samples / (power * power)) as f32);
            }
            block
        });
        Ok(blocks.collect())
    }
}

impl Stage for Ninth {
    type In = GroundFrame;
    type Out = GroundFrame;
    type Error = ModelError;

    fn step(&mut self, frame: GroundFrame, out: &mut Outlet<GroundFrame>) -> Result<(), ModelError> {
        match frame {
            GroundFrame::Instrument(instrument) => {
                (self.first_channel, self.satellite) = (instrument.channels.len(), instrument.satellites);
                out.push(GroundFrame::Instrument(instrument));
            }
            GroundFrame::Housekeeping(report) => {
                while let Some(window) = self.windows.next_if(|window| window.start < report.time) {
                    for block in self.spectra(window)? {
                        self.sampled += block.len() as u64;
                        out.push(GroundFrame::Visibilities(block));
                    }
                }
                let sampled = report.sampled + self.sampled;
                out.push(GroundFrame::Housekeeping(Housekeeping { sampled, ..report }));
            }
            other => out.push(other),
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.sampled, "powers")
    }
}
