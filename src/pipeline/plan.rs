//! A checked pipeline, and what it will cost.

use std::sync::Arc;

use super::config::{Config, Problems};
use super::error::PipelineError;
use crate::array::Array;
use crate::frames::{Instrument, ObservingWindow};
use crate::mother::{Observer, Schedule};
use crate::units::all_pairs;

/// A configuration that has been checked, with what follows from it.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The configuration.
    pub config: Config,
    /// The array.
    pub array: Arc<Array>,
    /// What the spacecraft says of itself.
    pub instrument: Instrument,
    /// One schedule a channel.
    pub schedules: Vec<Schedule>,
    /// The windows in which it observes.
    pub windows: Vec<ObservingWindow>,
}

impl Plan {
    /// The plan of a configuration that [`super::ConfigSource::load`] has checked.
    ///
    /// # Errors
    /// An array that cannot be.
    pub fn new(config: Config) -> Result<Self, PipelineError> {
        let array = Arc::new(Array::new(&config.array)?);
        let spacecraft = &config.spacecraft;
        let instrument = Instrument {
            name: config.name.clone(),
            epoch_tai_s: spacecraft.epoch_tai_s,
            moon_radius_m: array.moon_radius_m(),
            // At most MAX_SATELLITES, as the array has checked.
            satellites: array.satellites() as u8,
            channels: spacecraft.channels(),
            response: spacecraft.antenna.into(),
            seed: config.seed,
            configuration_hash: config.space_hash(),
        };
        let schedule = |(channel, &frequency_hz): (usize, &f64)| Schedule {
            rule: spacecraft.rule(),
            frequency_hz,
            baseline_wavelengths_max: spacecraft.baseline_wavelengths_max.get(channel).unwrap_or(0.0),
            every_nth: spacecraft.every_nth_integration.get(channel).unwrap_or(1),
            every_nth_window: spacecraft.every_nth_window,
        };
        let schedules = spacecraft.channels_hz.iter().enumerate().map(schedule).collect();
        let windows = Observer::windows(&array, spacecraft.duration_s, spacecraft.every_nth_window);
        Ok(Self { config, array, instrument, schedules, windows })
    }

    /// What is wrong with the files that the configuration names; reads them.
    #[must_use]
    pub fn file_problems(&self) -> Problems {
        super::space::file_problems(self)
    }

    /// About how many visibilities each channel will have, sent down and within the map's limit.
    #[must_use]
    pub fn visibilities(&self) -> Vec<Expected> {
        let map = &self.config.map;
        let expected = |schedule: &Schedule| {
            let limit_m = map.baseline_m_max(schedule.frequency_hz);
            let mut expected = Expected::default();
            for &window in &self.windows {
                for pair in all_pairs(self.array.satellites()) {
                    let (count, length_m) = schedule.estimate(&self.array, window, pair);
                    expected.sent += count;
                    if length_m < limit_m {
                        expected.mapped += count;
                    }
                }
            }
            expected
        };
        self.schedules.iter().map(expected).collect()
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
