//! A checked pipeline and what follows from its configuration.

use std::sync::Arc;

use super::error::PipelineError;
use super::sections::Config;
use crate::array::Array;
use crate::daughters::{AntennaErrors, InstrumentErrors, truth_csv};
use crate::frames::{Instrument, ObservingWindow};
use crate::mother::{Fidelity, Observer, Schedule};
use crate::sky::fits::SkyChannel;
use crate::units::{ChannelId, MissionTime, all_pairs};

/// A configuration that has been checked, with what follows from it.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The configuration.
    pub config: Config,
    /// The array.
    pub array: Arc<Array>,
    /// The description that the spacecraft sends.
    pub instrument: Instrument,
    /// One schedule a channel.
    pub schedules: Vec<Schedule>,
    /// The windows in which it observes.
    pub windows: Vec<ObservingWindow>,
}

impl Plan {
    /// The plan of a configuration that [`crate::pipeline::ConfigSource::load`] has checked.
    ///
    /// # Errors
    /// An invalid array, or one that never observes.
    pub fn new(config: Config) -> Result<Self, PipelineError> {
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

    /// The channel for which a sky is read.
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

    /// Rate that the daughters' samples need on their links, bit/s; `None` without samples.
    #[must_use]
    #[doc(hidden)]
    pub fn samples_bits_per_s(&self) -> Option<f64> {
        let Config { spacecraft, daughters, .. } = &self.config;
        let (count, channels) = (self.array.satellites(), spacecraft.channels_hz.len());
        (spacecraft.fidelity == Fidelity::Samples)
            .then(|| daughters.rate_bits_per_s(count, channels, spacecraft.channel_width_hz))
    }

    /// Rate that one daughter's samples need on its link, and the greatest that the link has, bit/s; `None` without
    /// samples or limit.
    #[must_use]
    #[doc(hidden)]
    pub fn link_bits_per_s(&self) -> Option<[f64; 2]> {
        let needed = self.samples_bits_per_s()? / self.array.satellites() as f64;
        let limit = self.config.daughters.link_bits_per_s_max;
        (limit > 0.0).then_some([needed, limit])
    }

    /// Errors of the instrument and of what packets say of positions and times; `None` if there are none.
    #[must_use]
    #[doc(hidden)]
    pub fn instrument_errors(&self) -> Option<Arc<InstrumentErrors>> {
        let Config { instrument, navigation, seed, spacecraft, .. } = &self.config;
        let channels = spacecraft.channels();
        InstrumentErrors::new(instrument, navigation, *seed, &self.array, &channels).map(Arc::new)
    }

    /// Antennas of the daughters that are not ideal; `None` if all are.
    #[must_use]
    #[doc(hidden)]
    pub fn antenna_errors(&self) -> Option<Arc<AntennaErrors>> {
        let (errors, elements) = (self.instrument_errors()?, self.instrument.response);
        AntennaErrors::new(&errors, Arc::clone(&self.array), &self.windows, elements)
    }

    /// The true errors in every pass as a table (CSV); `None` if there are none.
    #[must_use]
    #[doc(hidden)]
    pub fn instrument_truth(&self) -> Option<String> {
        self.instrument_errors().map(|errors| truth_csv(&errors, &self.windows))
    }

    /// Rate of the ninth daughter's spectra while the array observes, bit/s; `None` without it.
    #[must_use]
    #[doc(hidden)]
    pub fn ninth_bits_per_s(&self) -> Option<f64> {
        let ninth = &self.config.spacecraft.ninth;
        ninth.on.then(|| ninth.bits_per_s())
    }

    /// Windows by which progress is measured; 0 for samples, whose stages do not take whole windows.
    #[must_use]
    #[doc(hidden)]
    pub fn windows_watched(&self) -> u64 {
        match self.config.spacecraft.fidelity {
            Fidelity::Visibilities => self.windows.len() as u64,
            Fidelity::Samples => 0,
        }
    }

    /// Estimated visibilities of each channel, sent down and within the map's limit.
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

/// Visibilities expected in one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Expected {
    /// Sent down.
    pub sent: f64,
    /// Of these, within the map's longest baseline.
    pub mapped: f64,
}
