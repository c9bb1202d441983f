//! A checked configuration, with the array, schedules and observing windows that follow from it.

use std::path::PathBuf;
use std::sync::Arc;

use super::error::PipelineError;
use super::sections::Config;
use crate::array::Array;
use crate::daughters::{AntennaErrors, InstrumentErrors, truth_csv};
use crate::frames::{Instrument, ObservingWindow};
use crate::mother::{Fidelity, MovingSky, Observer, Schedule, SteadyPoints};
use crate::response::{MeasuredAntennas, MeasuredAntennasError};
use crate::sky::fits::SkyChannel;
use crate::sky::generated::{AddedSkyError, CataloguePoint, read_catalogue};
use crate::sky::k_sr_per_jy;
use crate::units::{ChannelId, MissionTime, all_pairs};

/// A checked configuration, with the array, schedules and observing windows that follow from it.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The configuration.
    pub config: Config,
    /// The array.
    pub array: Arc<Array>,
    /// The instrument description in the downlink.
    pub instrument: Instrument,
    /// Integration schedule of each channel.
    pub schedules: Vec<Schedule>,
    /// Observing windows, after thinning.
    pub windows: Vec<ObservingWindow>,
}

impl Plan {
    /// Makes the plan of a configuration, which [`crate::pipeline::ConfigSource::load`] has to have checked.
    ///
    /// # Errors
    /// An invalid array, or one that never observes.
    pub fn new(mut config: Config) -> Result<Self, PipelineError> {
        config.choose_engine(true);
        let array = Arc::new(Array::new(&config.array)?);
        let spacecraft = &config.spacecraft;
        let instrument = Instrument {
            name: config.name.clone(),
            epoch_tai_s: config.epoch_tai_s(&array),
            moon_radius_m: array.moon_radius_m(),
            // At most MAX_SATELLITES, as the array has checked.
            satellites: array.satellites() as u8,
            channels: spacecraft.channels(),
            response: spacecraft.antenna.into(),
            seed: config.seed,
            configuration_hash: config.space_hash(),
            spectrometer: spacecraft.ninth.spectrometer(),
            noiseless: !spacecraft.thermal_noise,
        };
        let schedules = spacecraft.schedules();
        let mut windows = Observer::windows(&array, spacecraft.duration_s, spacecraft.window_thinning());
        if windows.is_empty() && array.is_on_surface() {
            return Err(PipelineError::EarthNeverSets { duration_s: spacecraft.duration_s });
        }
        if windows.is_empty() {
            return Err(PipelineError::NoWindow {
                duration_s: spacecraft.duration_s,
                orbit_s: config.array.orbital_period_s,
            });
        }
        if spacecraft.window_s_max > 0.0 {
            for window in &mut windows {
                let cut = MissionTime::from_seconds(window.start.seconds() + spacecraft.window_s_max);
                window.end = window.end.min(cut);
            }
        }
        Ok(Self { config, array, instrument, schedules, windows })
    }

    /// Properties of a channel that decide how its sky map is read.
    #[must_use]
    pub(in crate::pipeline) fn sky_channel(&self, channel: usize) -> SkyChannel {
        let Config { sky, spacecraft, .. } = &self.config;
        let channels = spacecraft.channels_hz.len();
        SkyChannel {
            frequency_hz: spacecraft.channels_hz[channel],
            is_dark_accepted: spacecraft.receiver_k_sr()[channel] > 0.0,
            is_file_shared: channels > 1 && sky.file.as_ref().is_some_and(|files| files.values().len() == 1),
        }
    }

    /// Data rate of the samples of all daughters on their links, bit/s; `None` if samples are not simulated.
    #[must_use]
    #[doc(hidden)]
    pub fn samples_bits_per_s(&self) -> Option<f64> {
        let Config { spacecraft, daughters, .. } = &self.config;
        let (count, channels) = (self.array.satellites(), spacecraft.channels_hz.len());
        (spacecraft.fidelity == Fidelity::Samples)
            .then(|| daughters.rate_bits_per_s(count, channels, spacecraft.channel_width_hz))
    }

    /// Data rate of one daughter's samples, and the limit of its link, bit/s; `None` without samples or without a limit.
    #[must_use]
    #[doc(hidden)]
    pub fn link_bits_per_s(&self) -> Option<[f64; 2]> {
        let needed = self.samples_bits_per_s()? / self.array.satellites() as f64;
        let limit = self.config.daughters.link_bits_per_s_max;
        (limit > 0.0).then_some([needed, limit])
    }

    /// Errors of the instrument and of the positions and times in packets; `None` if there are none.
    #[must_use]
    #[doc(hidden)]
    pub fn instrument_errors(&self) -> Option<Arc<InstrumentErrors>> {
        let Config { instrument, navigation, seed, spacecraft, .. } = &self.config;
        let channels = spacecraft.channels();
        InstrumentErrors::new(instrument, navigation, *seed, &self.array, &channels).map(Arc::new)
    }

    /// Errors of the daughters' antennas; `None` if all are ideal.
    ///
    /// # Errors
    /// Files of antennas that cannot be used, or that say nothing of a window or channel.
    #[doc(hidden)]
    pub fn antenna_errors(&self) -> Result<Option<Arc<AntennaErrors>>, PipelineError> {
        let Some(errors) = self.instrument_errors() else { return Ok(None) };
        let Instrument { response, epoch_tai_s, .. } = self.instrument;
        let measured = self.measured_antennas();
        let measured =
            measured.map_err(|error| PipelineError::Antennas("instrument.antenna_files", error))?;
        let (array, measured) = (Arc::clone(&self.array), (measured, epoch_tai_s));
        Ok(AntennaErrors::new(&errors, array, &self.windows, response, measured))
    }

    /// Antennas as the instrument's files say they are, in all channels and windows.
    fn measured_antennas(&self) -> Result<MeasuredAntennas, MeasuredAntennasError> {
        let Instrument { response, epoch_tai_s, .. } = self.instrument;
        let measured = MeasuredAntennas::read(&self.config.instrument.antenna_files)?;
        for channel in &self.instrument.channels {
            measured.require(self.array.satellites(), response, channel.frequency_hz)?;
        }
        for satellite in 0..self.array.satellites() {
            for window in &self.windows {
                let ends_s = [window.start, window.end].map(|end| epoch_tai_s + end.seconds());
                measured.require_attitude(satellite, ends_s)?;
            }
        }
        Ok(measured)
    }

    /// The true instrument errors of every pass as a table (CSV); `None` if there are none.
    #[must_use]
    #[doc(hidden)]
    pub fn instrument_truth(&self) -> Option<String> {
        self.instrument_errors().map(|errors| truth_csv(&errors, &self.windows))
    }

    /// The moving sources, and the steady ones of a table; `None` if there are none.
    ///
    /// # Errors
    /// A table that cannot be read.
    pub(in crate::pipeline) fn moving_sky(&self) -> Result<Option<Arc<MovingSky>>, PipelineError> {
        let Config { sky, spacecraft, .. } = &self.config;
        let index = sky.generated.source_spectral_index;
        let read = |path: &PathBuf| read_catalogue(path, index).map_err(AddedSkyError::from);
        let table = sky.points.as_ref().map(read).transpose()?;
        if sky.moving.is_empty() && table.is_none() {
            return Ok(None);
        }
        let at = |frequency_hz: f64| {
            let k_sr = |point: &CataloguePoint| point.flux_jy(frequency_hz) * k_sr_per_jy(frequency_hz);
            let sources = table.iter().flatten().map(|point| (point.direction, k_sr(point))).collect();
            SteadyPoints { frequency_hz, sources }
        };
        let points = self.instrument.channels.iter().map(|channel| at(channel.frequency_hz)).collect();
        Ok(Some(Arc::new(MovingSky {
            sources: sky.moving.clone(),
            points,
            array: Arc::clone(&self.array),
            epoch_tai_s: self.instrument.epoch_tai_s,
            response: self.instrument.response,
            smear_integrations: spacecraft.smear_integrations,
            smear_bandwidth: spacecraft.smear_bandwidth,
        })))
    }

    /// The true bursts of moving sources as a table (CSV); `None` if there are no such sources.
    #[must_use]
    #[doc(hidden)]
    pub fn moving_truth(&self) -> Option<String> {
        if self.config.sky.moving.is_empty() {
            return None;
        }
        let moving = self.moving_sky().ok().flatten()?;
        Some(moving.truth_csv(&self.instrument.channels, &self.windows))
    }

    /// Data rate of the ninth daughter's spectra while the array observes, bit/s; `None` without that daughter.
    #[must_use]
    #[doc(hidden)]
    pub fn ninth_bits_per_s(&self) -> Option<f64> {
        let ninth = &self.config.spacecraft.ninth;
        ninth.on.then(|| ninth.bits_per_s())
    }

    /// Number of windows for progress reports; 0 if samples are simulated, as their stages do not process whole windows.
    #[must_use]
    #[doc(hidden)]
    pub fn progress_windows(&self) -> u64 {
        match self.config.spacecraft.fidelity {
            Fidelity::Visibilities => self.windows.len() as u64,
            Fidelity::Samples => 0,
        }
    }

    /// Estimated numbers of visibilities of each channel, sent and mapped.
    #[must_use]
    pub fn visibilities(&self) -> Vec<Expected> {
        let map = &self.config.map;
        let bands = self.config.spacecraft.sub_bands as f64;
        let expected = |(channel, schedule): (usize, &Schedule)| {
            let is_mapped = map.is_mapped(ChannelId(channel as u16));
            let limit_m = map.baseline_m_max(schedule.frequency_hz);
            let mut expected = Expected::default();
            for &window in &self.windows {
                for pair in all_pairs(self.array.satellites()) {
                    let (count, length_m) = schedule.estimate(&self.array, window, pair);
                    let count = count * bands;
                    expected.sent += count;
                    if is_mapped && length_m < limit_m {
                        expected.mapped += count;
                    }
                }
            }
            expected
        };
        self.schedules.iter().enumerate().map(expected).collect()
    }
}

/// Estimated numbers of visibilities in one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Expected {
    /// Visibilities in the downlink.
    pub sent: f64,
    /// Visibilities within the map's longest baseline.
    pub mapped: f64,
}
