//! Configuration of a generated sky.

use thiserror::Error;

use crate::sky::harmonics::HarmonicsError;
use crate::sky::healpix::is_valid_nside;
use crate::units::{Checks, InvalidValue, keys};

const FREQUENCY_HZ: std::ops::RangeInclusive<f64> = 0.1e6..=120e6;
const NSIDE_MAX: usize = 1024;

keys! {
    /// The `[sky.generated]` section: components of a generated sky and their amplitudes.
    pub struct GeneratedSky {
        /// Small-scale fluctuations of the diffuse emission.
        expert small_scales: bool = true;
        /// Factor on the amplitude of the small scales of Remazeilles et al. (2015).
        #[only_with(".small_scales = true or sky.added")]
        expert small_scale_amplitude: f64 = 1.0;
        /// FWHM of the smooth model, below which the small scales are added.
        #[only_with(".small_scales = true or sky.added")]
        expert small_scale_fwhm_deg: f64 = 5.0;
        /// Maximum degree of the small scales; a map holds at most 3 nside - 1.
        #[only_with(".small_scales = true or sky.added")]
        expert small_scale_l_max: usize = 3071;
        /// Rms of the logarithm of the gas's opacity over the sky.
        expert cloud_log_rms: f64 = 0.33;
        /// Rms of the synchrotron index over the sky.
        expert index_rms: f64 = 0.05;
        /// Radio loops, with the North Polar Spur.
        expert loops: bool = true;
        /// Opaque nebulae.
        expert nebulae: bool = true;
        /// Point sources.
        expert point_sources: bool = true;
        /// Minimum flux density of a source, at 154 MHz; fainter ones are part of the smooth background.
        #[only_with(".point_sources = true or sky.added")]
        expert source_flux_jy_min: f64 = 4.36;
        /// Maximum flux density of a source, at 154 MHz.
        #[only_with(".point_sources = true or sky.added")]
        expert source_flux_jy_max: f64 = 75.0;
        /// Spectral index of the sources' flux densities.
        #[only_with(".point_sources = true or sky.added")]
        expert source_spectral_index: f64 = -0.8;
        /// Absorption of the sources by Galactic gas.
        #[only_with(".point_sources = true or sky.added")]
        expert sources_absorbed: bool = true;
    }
}

/// Why a sky cannot be generated.
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
    /// Lists the problems of the section; empty if it is valid.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("sky.generated");
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
        let (min_jy, max_jy) = (self.source_flux_jy_min, self.source_flux_jy_max);
        checks.require("source_flux_jy_max", max_jy, max_jy > min_jy, "more than source_flux_jy_min");
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
