//! What can be chosen about the simulated sky.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::generated::GeneratedSky;
use super::healpix::is_valid_nside;
use crate::units::PerChannel;

/// Where the simulated sky comes from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SkyConfig {
    /// HEALPix FITS maps in K, one, or one a channel; the generated sky if none is named.
    pub file: Option<PerChannel<PathBuf>>,
    /// nside of the generated sky.
    pub nside: usize,
    /// Greatest band limit of skies that are simulated through harmonics, less for a map that holds less; 0 for
    /// what the baselines ask for.
    pub l_max: usize,
    /// The generated sky's parts.
    pub generated: GeneratedSky,
}

impl Default for SkyConfig {
    fn default() -> Self {
        Self { file: None, nside: 64, l_max: 0, generated: GeneratedSky::default() }
    }
}

/// Greatest nside of a generated sky.
pub const GENERATED_NSIDE_MAX: usize = 1024;

/// A setting of the sky that cannot be.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum SkyConfigError {
    /// Not a map size.
    #[error("sky.nside = {0}: expected a power of two from 1 to {GENERATED_NSIDE_MAX}")]
    Nside(usize),
    /// A band limit beyond what harmonics or the map hold.
    #[error("sky.l_max = {l_max}: expected 0, or at most {most}: 2.5 nside of the sky, and {L_MAX}")]
    BandLimit {
        /// Value found.
        l_max: usize,
        /// Greatest value for this nside.
        most: usize,
    },
    /// Not one file for each channel.
    #[error(
        "sky.file: {files} file(s) for {channels} channels; a map holds for one frequency, so expected one a channel"
    )]
    FileCount {
        /// Files named.
        files: usize,
        /// Channels of the spacecraft.
        channels: usize,
    },
    /// A part of the generated sky.
    #[error("sky.generated: {0}")]
    Generated(String),
}

/// Greatest band limit of harmonic simulation.
const L_MAX: usize = 1536;

impl SkyConfig {
    /// Greatest band limit that a map of `nside` determines.
    #[must_use]
    pub fn l_max_most(nside: usize) -> usize {
        L_MAX.min(5 * nside / 2)
    }

    /// Everything that is wrong with the configuration for `channels` channels; empty if it is good.
    #[must_use]
    pub fn problems(&self, channels: usize) -> Vec<SkyConfigError> {
        let mut found = Vec::new();
        if !is_valid_nside(self.nside) || self.nside > GENERATED_NSIDE_MAX {
            found.push(SkyConfigError::Nside(self.nside));
        }
        let most = Self::l_max_most(self.nside);
        if self.file.is_none() && self.l_max > most {
            found.push(SkyConfigError::BandLimit { l_max: self.l_max, most });
        }
        if let Some(files) = &self.file {
            let files = files.values().len();
            if files != channels {
                found.push(SkyConfigError::FileCount { files, channels });
            }
        }
        found.extend(self.generated.problems().iter().map(|e| SkyConfigError::Generated(e.to_string())));
        found
    }
}
