//! Configuration of the simulated sky.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::frame::Frame;
use super::generated::{AddedSky, GeneratedSky};
use super::healpix::is_valid_nside;
use super::moving::MovingSource;
use crate::units::{Checks, InvalidValue, PerChannel, keys};

/// Treatment of a map file whose frequency differs from the channel's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum MapFrequency {
    /// The file is refused.
    #[default]
    #[serde(rename = "must-match")]
    MustMatch,
    /// The map is scaled by a power of frequency: T(nu) = T(FREQ) (nu / FREQ)^index.
    #[serde(rename = "spectral_index")]
    SpectralIndex(f64),
}

keys! {
    /// The `[sky]` section.
    pub struct SkyConfig {
        /// Map of the sky: HEALPix FITS, such as "map.fits", for all channels, or a list, one per channel. Without it the sky
        /// is generated.
        everyday file: Option<PerChannel<PathBuf>> = None;
        /// Frame of map files without COORDSYS: "ecliptic", "galactic" or "equatorial". Without it they are refused.
        #[only_with("sky.file")]
        #[serde(skip_serializing_if = "Option::is_none")]
        everyday frame: Option<Frame> = None;
        /// Column of the map files, from 0 without a column of pixel numbers; by default that of the channel's frequency, or else the
        /// first that may be a temperature.
        #[only_with("sky.file")]
        #[serde(skip_serializing_if = "Option::is_none")]
        expert column: Option<usize> = None;
        /// What to do if the FREQ of a map file is not the channel's: "must-match" refuses it, `{ spectral_index = -2.5 }` scales
        /// it by (nu / FREQ)^index.
        #[only_with("sky.file")]
        expert frequency: MapFrequency = MapFrequency::default();
        /// HEALPix nside of the generated sky, or of map files with `added`: a power of two up to 1024.
        #[only_with("no sky.file or sky.added")]
        everyday nside: usize = 64;
        /// Maximum degree of the harmonic model; 0 for what the baselines need.
        expert l_max: usize = 0;
        /// The generated sky.
        #[only_with("no sky.file or sky.added")]
        section generated: GeneratedSky = GeneratedSky::default();
        /// What to add to map files: `{ small_scales = true, sources = true }` adds generated ones, `catalogue = "sources.csv"`
        /// those of a table, as `lunarray sky --sources` writes it.
        #[only_with("sky.file")]
        #[serde(skip_serializing_if = "Option::is_none")]
        expert added: Option<AddedSky> = None;
        /// Table (CSV) of steady point sources beside the map, at their exact directions for baselines of any length; as `lunarray sky
        /// --sources` writes it. Without an index of their own, sources have sky.generated.source_spectral_index.
        #[serde(skip_serializing_if = "Option::is_none")]
        expert points: Option<PathBuf> = None;
        /// Point sources that move or burst, such as `[{ direction = "sun", starts_s = [9e4], peak_jy = 1e8 }]`; direction = `"sun"`,
        /// `"jupiter"` or `[longitude, latitude]`; optional `steady_jy`, `reference_hz`, `spectral_index`, `rise_s`, `decay_s`,
        /// `duration_index`, `drift_s` (a type III burst's). The bursts are listed beside the downlink, in FILE.moving.csv.
        #[serde(skip_serializing_if = "Vec::is_empty")]
        expert moving: Vec<MovingSource> = Vec::new();
    }
}

/// Maximum nside of a generated sky.
pub const GENERATED_NSIDE_MAX: usize = 1024;

/// Maximum degree of the harmonic model.
const L_MAX: usize = 1536;

impl SkyConfig {
    /// Maximum degree that the configuration may set for a map of `nside`.
    #[must_use]
    pub fn l_max_limit(nside: usize) -> usize {
        L_MAX.min(5 * nside / 2)
    }

    /// Longest baseline to which a map of `nside` has anything to say, wavelengths, beside `points` at exact directions; `None` without
    /// such points, where maps are all there is.
    #[must_use]
    pub fn reach_wavelengths(&self, nside: usize) -> Option<f64> {
        let degree = if self.l_max > 0 { self.l_max } else { 2 * nside };
        self.points.as_ref().map(|_| degree as f64 / std::f64::consts::TAU)
    }

    fn l_max_expected(limit: usize) -> String {
        format!("0, or at most {limit}: 2.5 nside of the sky, and {L_MAX}")
    }

    /// Maximum degree that the analysis of a map of `nside` determines exactly: 9/4 nside.
    #[must_use]
    #[doc(hidden)]
    pub fn l_max_determined(nside: usize) -> usize {
        9 * nside / 4
    }

    /// Requires that a map of `nside` determines coefficients up to `l_max`.
    ///
    /// # Errors
    /// [`InvalidValue`] for `sky.l_max`.
    pub fn check_l_max(l_max: usize, nside: usize) -> Result<(), InvalidValue> {
        let limit = Self::l_max_limit(nside);
        let mut checks = Checks::new("sky");
        checks.require("l_max", l_max, l_max <= limit, Self::l_max_expected(limit));
        checks.finish().pop().map_or(Ok(()), Err)
    }

    /// Lists the problems of the configuration for `channels` channels; empty if it is valid.
    #[must_use]
    pub fn problems(&self, channels: usize) -> Vec<InvalidValue> {
        let mut checks = Checks::new("sky");
        let nside = self.nside;
        let good = is_valid_nside(nside) && nside <= GENERATED_NSIDE_MAX;
        checks.require("nside", nside, good, format!("a power of two from 1 to {GENERATED_NSIDE_MAX}"));
        let limit = Self::l_max_limit(nside);
        let good = self.file.is_some() || self.l_max <= limit;
        checks.require("l_max", self.l_max, good, Self::l_max_expected(limit));
        if let Some(files) = &self.file {
            let files = files.values().len();
            // Whether one file can serve all channels is decided later, by its frequency.
            let expected = format!("one, or one per channel, of which there are {channels}");
            checks.require("file", format!("({files} files)"), files == 1 || files == channels, expected);
        }
        if let MapFrequency::SpectralIndex(index) = self.frequency {
            let (key, good) = ("frequency.spectral_index", (-10.0..=10.0).contains(&index));
            checks.number(key, index, good, "-10 to 10");
        }
        let mut found = checks.finish();
        found.extend(self.generated.problems());
        found.extend(self.moving.iter().enumerate().flat_map(|(index, source)| source.problems(index)));
        found
    }
}
