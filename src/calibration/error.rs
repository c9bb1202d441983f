//! Errors of calibration.

use std::path::PathBuf;

use thiserror::Error;

use crate::units::{Dimension, InvalidValue, Pair};

/// Errors of calibration.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CalibrationError {
    /// A value of the configuration that is not accepted.
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    /// A block whose arrays are not of one length, as it came or as a hook left it.
    #[error(transparent)]
    Lengths(#[from] crate::frames::UnequalLengths),
    /// The gains file cannot be read.
    #[error("gains file {}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The gains file is not TOML or JSON of the expected shape.
    #[error("gains file {}: {message}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Where and what, from the parser.
        message: String,
    },
    /// The gains file holds invalid values.
    #[error("gains file {}: {}", path.display(), list(problems))]
    Values {
        /// The file.
        path: PathBuf,
        /// Everything that is wrong with it.
        problems: Vec<InvalidValue>,
    },
    /// Invalid gains, not from a file.
    #[error("gains: {}", list(problems))]
    Gains {
        /// Everything that is wrong with them.
        problems: Vec<InvalidValue>,
    },
    /// A channel without gains.
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
    /// Channels that are not adjoining sub-bands.
    #[error(
        "calibration.sub_bands = {sub_bands}: expected the number of adjoining sub-bands of each channel in the \
         downlink, which has {channels} channels"
    )]
    SubBands {
        /// Number configured.
        sub_bands: usize,
        /// Channels of the downlink.
        channels: usize,
    },
    /// A map of the known sky that cannot be read.
    #[error(transparent)]
    ModelFile(#[from] crate::sky::fits::FitsError),
    /// A map of the known sky that cannot be used.
    #[error("map of calibrate.model_files or --model: {0}")]
    ModelMap(#[from] crate::sky::MapError),
    /// Positions that the model of the known sky does not cover.
    #[error(transparent)]
    Model(#[from] crate::response::model::ModelError),
    /// A satellite without gains.
    #[error("no gains for pair {pair}: the gains file has {satellites} satellites; is it for this array?")]
    Satellite {
        /// The pair.
        pair: Pair,
        /// Number of satellites that have gains.
        satellites: usize,
    },
}

/// Most problems of a file that are told one by one; a mistake in one gain is often made in all of them.
const TOLD_MAX: usize = 5;

fn list(problems: &[InvalidValue]) -> String {
    let lines: Vec<String> = problems.iter().take(TOLD_MAX).map(ToString::to_string).collect();
    let more = match problems.len().saturating_sub(TOLD_MAX) {
        0 => String::new(),
        more => format!("; and {more} more"),
    };
    format!("{}{more}", lines.join("; "))
}
