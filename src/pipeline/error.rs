//! Why a pipeline did not run.

use thiserror::Error;

use super::config::ConfigError;
use crate::array::ArrayError;
use crate::runtime::{LedgerImbalance, RuntimeError};
use crate::sky::MapError;
use crate::sky::fits::FitsError;

/// Why a pipeline did not run.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// The configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The array.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// A map of the simulated sky or a prior map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The generated sky.
    #[error(transparent)]
    GeneratedSky(#[from] crate::sky::generated::GeneratedSkyError),
    /// The sky's coefficients cannot be found.
    #[error("the simulated sky's coefficients: {0}")]
    Coefficients(#[from] crate::sky::harmonics::HarmonicsError),
    /// A setting of the sky that does not fit its map.
    #[error(transparent)]
    SkyConfig(#[from] crate::sky::SkyConfigError),
    /// A model of visibilities cannot be.
    #[error(transparent)]
    Model(#[from] crate::mother::ModelError),
    /// A map file.
    #[error(transparent)]
    Fits(#[from] FitsError),
    /// A stage failed.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// Data unaccounted for: a bug of the program.
    #[error(transparent)]
    Ledger(#[from] LedgerImbalance),
    /// Calibration cannot be set up.
    #[error(transparent)]
    Calibration(#[from] crate::calibration::CalibrationError),
    /// The downlink.
    #[error(transparent)]
    Downlink(#[from] crate::downlink::DownlinkError),
    /// Products cannot be written.
    #[error(transparent)]
    Products(#[from] crate::products::ProductsError),
    /// No thread pool.
    #[error("cannot start {threads} worker threads: {reason}")]
    Threads {
        /// Threads asked for.
        threads: usize,
        /// What the system said.
        reason: String,
    },
}
