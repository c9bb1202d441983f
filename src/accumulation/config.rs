//! What can be chosen about the map.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::array::response::PixelMethod;
use crate::sky::healpix::{is_valid_nside, pixel_area_sr};
use crate::units::PerChannel;
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Greatest nside of the pixel engine: 49152 pixels, 9.7 GB of sums a channel (half of a symmetric matrix, f64).
pub const PIXEL_ENGINE_NSIDE_MAX: usize = 64;

/// The ground's map making.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapConfig {
    /// HEALPix nside of the maps.
    pub nside: usize,
    /// How rows of B are made.
    pub rows: PixelMethod,
    /// Longest baseline used, in units of b_p = wavelength / sqrt(4 pi / N_pix).
    pub baseline_bp_max: f64,
    /// Regularisation epsilon: R = epsilon W_max I.
    pub epsilon: PerChannel<f64>,
    /// Prior map: one temperature everywhere, K; 0 for none.
    pub prior_k: PerChannel<f64>,
    /// Prior maps: HEALPix FITS files, one a channel, in K; empty for none.
    pub prior_files: Vec<PathBuf>,
    /// FWHM to which prior maps are smoothed, degrees.
    pub prior_fwhm_deg: f64,
    /// Mission time between snapshot maps, s; 0 for a final map alone.
    pub snapshot_every_s: f64,
    /// Seed of the noise-only companion map.
    pub companion_seed: u64,
}

impl Default for MapConfig {
    fn default() -> Self {
        Self {
            nside: 16,
            rows: PixelMethod::Average,
            baseline_bp_max: 2.0,
            epsilon: PerChannel::All(1e-4),
            prior_k: PerChannel::All(0.0),
            prior_files: Vec::new(),
            prior_fwhm_deg: 5.0,
            snapshot_every_s: 0.0,
            companion_seed: 1,
        }
    }
}

/// A setting of the map that cannot be.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum MapConfigError {
    /// Not a map size.
    #[error("map.nside = {0}: expected a power of two from 1 to {PIXEL_ENGINE_NSIDE_MAX}")]
    Nside(usize),
    /// A number outside its range.
    #[error("map.{key} = {value}: expected {expected}")]
    Parameter {
        /// Key.
        key: &'static str,
        /// Value found.
        value: f64,
        /// Range that is accepted.
        expected: &'static str,
    },
    /// A list by channel of the wrong length.
    #[error("map.{key}: expected one value, or one for each of the {channels} channels")]
    Misfit {
        /// Key.
        key: &'static str,
        /// Number of channels.
        channels: usize,
    },
    /// Two priors at once.
    #[error("map.prior_k and map.prior_files are both given: expected one of them")]
    TwoPriors,
}

impl MapConfig {
    /// Everything that is wrong with the configuration; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Vec<MapConfigError> {
        let mut found = Vec::new();
        if !is_valid_nside(self.nside) || self.nside > PIXEL_ENGINE_NSIDE_MAX {
            found.push(MapConfigError::Nside(self.nside));
        }
        let mut require = |key, value: f64, good: bool, expected| {
            if !(good && value.is_finite()) {
                found.push(MapConfigError::Parameter { key, value, expected });
            }
        };
        let longest = self.baseline_bp_max;
        require("baseline_bp_max", longest, longest > 0.0, "a positive number, in units of b_p");
        for &epsilon in self.epsilon.values() {
            require("epsilon", epsilon, epsilon > 0.0 && epsilon <= 1.0, "above 0 and at most 1");
        }
        for &prior in self.prior_k.values() {
            require("prior_k", prior, prior >= 0.0, "K, not negative");
        }
        let fwhm = self.prior_fwhm_deg;
        require("prior_fwhm_deg", fwhm, (0.0..=180.0).contains(&fwhm), "0 to 180");
        let every = self.snapshot_every_s;
        require("snapshot_every_s", every, every >= 0.0, "seconds, or 0 for a final map alone");
        if !self.prior_files.is_empty() && self.prior_k.values().iter().any(|&k| k != 0.0) {
            found.push(MapConfigError::TwoPriors);
        }
        found
    }

    /// Longest baseline used at a frequency, m.
    ///
    /// b_p = wavelength / sqrt(4 pi / N_pix) is the baseline that a pixel just resolves (the paper, Sect. 4).
    #[must_use]
    pub fn baseline_m_max(&self, frequency_hz: f64) -> f64 {
        let pixel_rad = pixel_area_sr(self.nside).sqrt();
        self.baseline_bp_max * SPEED_OF_LIGHT_M_S / frequency_hz / pixel_rad
    }

    /// Settings by channel that do not fit an instrument of `channels` channels, by key.
    #[must_use]
    pub fn misfits(&self, channels: usize) -> Vec<&'static str> {
        let files = self.prior_files.len();
        [
            ("epsilon", self.epsilon.fits(channels)),
            ("prior_k", self.prior_k.fits(channels)),
            ("prior_files", files == 0 || files == channels),
        ]
        .into_iter()
        .filter_map(|(key, fits)| (!fits).then_some(key))
        .collect()
    }
}
