//! Errors of calibration.

use std::path::PathBuf;

use thiserror::Error;

use crate::units::{Dimension, InvalidValue, Pair};

/// Errors of calibration.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CalibrationError {
    /// A value of the configuration is not accepted.
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    /// The arrays of a block have unequal lengths, as received or after a hook.
    #[error(transparent)]
    Lengths(#[from] crate::frames::UnequalLengths),
    /// The gains file cannot be read.
    #[error("gains file {}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The gains file is not TOML or JSON of the expected structure.
    #[error("gains file {}: {message}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Message of the parser, with the place.
        message: String,
    },
    /// The gains file holds invalid values.
    #[error("gains file {}: {}", path.display(), joined(problems))]
    Values {
        /// The file.
        path: PathBuf,
        /// All invalid values.
        problems: Vec<InvalidValue>,
    },
    /// Gains that do not come from a file are invalid.
    #[error("gains: {}", joined(problems))]
    Gains {
        /// All invalid values.
        problems: Vec<InvalidValue>,
    },
    /// A channel has no gains.
    #[error(
        "no gains within {} of the channel at {}, the nearest are for {}; add them to the gains file or leave the channel out",
        Dimension::Frequency.show(*tolerance_hz), Dimension::Frequency.show(*frequency_hz), Dimension::Frequency.show(*nearest_hz)
    )]
    Channel {
        /// Centre frequency of the channel, Hz.
        frequency_hz: f64,
        /// Nearest frequency that has gains, Hz.
        nearest_hz: f64,
        /// Largest distance that is accepted, Hz.
        tolerance_hz: f64,
    },
    /// The channels are not adjoining sub-bands.
    #[error(
        "calibration.sub_bands = {sub_bands}: expected the number of adjoining sub-bands of each channel in the \
         downlink, which has {channels} channels"
    )]
    SubBands {
        /// Configured number of sub-bands.
        sub_bands: usize,
        /// Number of channels of the downlink.
        channels: usize,
    },
    /// A map of the known sky cannot be read.
    #[error(transparent)]
    ModelFile(#[from] crate::sky::fits::FitsError),
    /// A map of the known sky cannot be used.
    #[error("map of calibrate.model_files or --model: {0}")]
    ModelMap(#[from] crate::sky::MapError),
    /// The model of the known sky does not cover the positions.
    #[error(transparent)]
    Model(#[from] crate::response::model::ModelError),
    /// A satellite has no gains.
    #[error("no gains for pair {pair}: the gains file has {satellites} satellites; is it for this array?")]
    Satellite {
        /// The pair.
        pair: Pair,
        /// Number of satellites that have gains.
        satellites: usize,
    },
}

/// Maximum number of listed problems: a mistake in one gain is often made in all.
const LISTED_MAX: usize = 5;

fn joined(problems: &[InvalidValue]) -> String {
    let lines: Vec<String> = problems.iter().take(LISTED_MAX).map(ToString::to_string).collect();
    let more = match problems.len().saturating_sub(LISTED_MAX) {
        0 => String::new(),
        more => format!("; and {more} more"),
    };
    format!("{}{more}", lines.join("; "))
}
