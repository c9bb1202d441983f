//! Configuration of a generated sky.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::sky::harmonics::HarmonicsError;
use crate::sky::healpix::is_valid_nside;
use crate::units::{Checks, InvalidValue};

/// Frequencies for which there is a sky, Hz.
const FREQUENCY_HZ: std::ops::RangeInclusive<f64> = 0.1e6..=120e6;
/// Finest map.
const NSIDE_MAX: usize = 1024;

/// Switches and amplitudes of a generated sky.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GeneratedSky {
    /// Whether the diffuse emission fluctuates on small scales.
    pub small_scales: bool,
    /// Factor on the amplitude of the small scales of Remazeilles et al. (2015).
    pub small_scale_amplitude: f64,
    /// Resolution of the smooth model on which small scales are put, FWHM, degrees.
    pub small_scale_fwhm_deg: f64,
    /// Greatest degree l of the small scales; a map holds at most 3 nside - 1.
    pub small_scale_l_max: usize,
    /// Standard deviation of the logarithm of the gas's opacity over the sky.
    pub cloud_log_rms: f64,
    /// Standard deviation of the synchrotron index over the sky.
    pub index_rms: f64,
    /// Whether the radio loops, with the North Polar Spur, are there.
    pub loops: bool,
    /// Whether opaque nebulae are there.
    pub nebulae: bool,
    /// Whether point sources are there.
    pub point_sources: bool,
    /// Faintest source drawn, Jy at 154 MHz; fainter ones are part of the smooth background.
    pub source_flux_jy_min: f64,
    /// Brightest source drawn, Jy at 154 MHz.
    pub source_flux_jy_max: f64,
    /// Spectral index of the sources' fluxes.
    pub source_spectral_index: f64,
    /// Whether Galactic gas absorbs the sources.
    pub sources_absorbed: bool,
}

impl Default for GeneratedSky {
    fn default() -> Self {
        Self {
            small_scales: true,
            small_scale_amplitude: 1.0,
            small_scale_fwhm_deg: 5.0,
            small_scale_l_max: 3071,
            cloud_log_rms: 0.33,
            index_rms: 0.05,
            loops: true,
            nebulae: true,
            point_sources: true,
            source_flux_jy_min: 4.36,
            source_flux_jy_max: 75.0,
            source_spectral_index: -0.8,
            sources_absorbed: true,
        }
    }
}

/// Why there is no such sky.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum GeneratedSkyError {
    /// A value of the configuration that is not accepted.
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    /// A frequency for which there is no model.
    #[error("no generated sky at {frequency_hz} Hz; expected 1e5 to 1.2e8 Hz")]
    Frequency {
        /// Value found, Hz.
        frequency_hz: f64,
    },
    /// An nside for which there is no map.
    #[error("no generated sky of nside {nside}; expected a power of two from 1 to 1024")]
    Nside {
        /// Value found.
        nside: usize,
    },
    /// The fluctuations could not be synthesised.
    #[error("generated sky: fluctuations")]
    Fluctuations(#[from] HarmonicsError),
}

impl GeneratedSky {
    /// Everything that is wrong with the section; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::of("sky.generated");
        let rules = [
            ("small_scale_amplitude", self.small_scale_amplitude, 0.0..=10.0, "0 to 10"),
            ("small_scale_fwhm_deg", self.small_scale_fwhm_deg, 0.1..=30.0, "0.1 to 30 degrees"),
            ("small_scale_l_max", self.small_scale_l_max as f64, 1.0..=3071.0, "1 to 3071"),
            ("cloud_log_rms", self.cloud_log_rms, 0.0..=1.0, "0 to 1"),
            ("index_rms", self.index_rms, 0.0..=0.3, "0 to 0.3"),
            (
                "source_flux_jy_min",
                self.source_flux_jy_min,
                0.1..=75.0,
                "0.1 to 75 Jy, where the counts hold",
            ),
            (
                "source_flux_jy_max",
                self.source_flux_jy_max,
                0.1..=75.0,
                "0.1 to 75 Jy, where the counts hold",
            ),
            ("source_spectral_index", self.source_spectral_index, -3.0..=3.0, "-3 to 3"),
        ];
        for (key, value, range, expected) in rules {
            checks.number(key, value, range.contains(&value), expected);
        }
        let (least_jy, most_jy) = (self.source_flux_jy_min, self.source_flux_jy_max);
        checks.require("source_flux_jy_max", most_jy, most_jy > least_jy, "more than source_flux_jy_min");
        checks.finish()
    }
}

pub(super) fn check_request(frequency_hz: f64, nside: usize) -> Result<(), GeneratedSkyError> {
    if !FREQUENCY_HZ.contains(&frequency_hz) {
        return Err(GeneratedSkyError::Frequency { frequency_hz });
    }
    if !is_valid_nside(nside) || nside > NSIDE_MAX {
        return Err(GeneratedSkyError::Nside { nside });
    }
    Ok(())
}
