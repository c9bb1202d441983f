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
    Model(#[from] crate::response::model::ModelError),
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
    /// The ground.
    #[error(transparent)]
    Ground(#[from] crate::ground::GroundError),
    /// Nothing to make a map of.
    #[error(
        "no pair's visibility could be used, so there is no map; see {} and, for a downlink, `lunarray inspect`\n{ledger}",
        summary.display()
    )]
    NoMap {
        /// Where the summary is.
        summary: std::path::PathBuf,
        /// What became of every visibility.
        ledger: Box<crate::runtime::LedgerReport>,
    },
    /// The array never observes.
    #[error(
        "spacecraft.duration_s = {duration_s}: there is no observing window in it; the first begins when the Earth sets \
         for daughter 1, at most an orbit of {orbit_s:.0} s later, and every_nth_window = {every_nth} are left out between two"
    )]
    NoWindow {
        /// Length of the mission, s.
        duration_s: f64,
        /// An orbit, s.
        orbit_s: f64,
        /// Windows from one to the next that is used.
        every_nth: u64,
    },
    /// No thread pool.
    #[error("cannot start {threads} worker threads: {reason}")]
    Threads {
        /// Threads asked for.
        threads: usize,
        /// What the system said.
        reason: String,
    },
}
