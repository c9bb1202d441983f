//! What the sliders of the page set.

use lunarray_app::pipeline::{Config, ConfigError, ConfigSource};

/// The mission's parameters that a visitor chooses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sliders {
    /// Altitude of the orbit, km.
    pub altitude_km: f64,
    /// Inclination to the ecliptic, degrees.
    pub inclination_deg: f64,
    /// Number of daughters.
    pub daughters: u32,
    /// Centre frequency of the channel, MHz.
    pub frequency_mhz: f64,
}

/// nside of the maps.
const NSIDE: usize = 8;
/// nside of the sky that is observed.
const SKY_NSIDE: usize = 32;
/// Maps on the way to the last one.
const MAPS: f64 = 8.0;
/// Product of frequency, MHz, and kept integrations: low frequencies have more baselines within the limit.
const INTEGRATIONS_MHZ: f64 = 45.0;

impl Sliders {
    /// The keys that differ from those of the quickstart, as `--set` takes them.
    ///
    /// Period and precession of the node follow altitude and inclination from the paper's, by Kepler's third law and for a Moon
    /// that is oblate (J_2): a^(3/2), and a^(7/2) / cos i. One precession is observed.
    #[must_use]
    pub fn overrides(&self) -> Vec<String> {
        let Self { altitude_km, inclination_deg, daughters, frequency_mhz } = *self;
        let paper = Config::default().array;
        let wider = (paper.moon_radius_m + 1e3 * altitude_km) / (paper.moon_radius_m + paper.altitude_m);
        let slower = paper.inclination_deg.to_radians().cos() / inclination_deg.to_radians().cos();
        let period_s = paper.orbital_period_s * wider.powf(1.5);
        let precession_s = paper.precession_period_s * wider.powf(3.5) * slower;
        let every_nth = (INTEGRATIONS_MHZ / frequency_mhz).round().max(1.0);
        // The node moves three degrees from one observed window to the next.
        let every_nth_window = (precession_s / period_s / 120.0).floor().max(1.0);
        vec![
            format!("array.altitude_m={}", 1e3 * altitude_km),
            format!("array.inclination_deg={inclination_deg}"),
            format!("array.satellites={daughters}"),
            format!("array.orbital_period_s={period_s}"),
            format!("array.precession_period_s={precession_s}"),
            format!("spacecraft.duration_s={precession_s}"),
            format!("spacecraft.channels_hz=[{}]", 1e6 * frequency_mhz),
            format!("spacecraft.every_nth_window={every_nth_window}"),
            format!("spacecraft.every_nth_integration={every_nth}"),
            format!("spacecraft.baseline_wavelengths_max={}", 2 * NSIDE),
            format!("sky.nside={SKY_NSIDE}"),
            format!("map.nside={NSIDE}"),
            format!("map.snapshot_every_s={}", precession_s / MAPS),
        ]
    }

    /// The whole, checked configuration.
    ///
    /// # Errors
    /// Values that the pipeline refuses.
    pub fn config(&self) -> Result<Config, ConfigError> {
        ConfigSource { overrides: self.overrides(), ..ConfigSource::default() }.load()
    }
}
