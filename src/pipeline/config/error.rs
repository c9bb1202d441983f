//! Errors of a pipeline.

use thiserror::Error;

use super::memory::MemoryLimit;
use super::source::ConfigError;
use crate::array::ArrayError;
use crate::frames::{SampleReason, VisibilityReason};
use crate::response::MeasuredAntennasError;
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
    /// Files of antennas, which a section names.
    #[error("{0}: {1}")]
    Antennas(&'static str, MeasuredAntennasError),
    /// A map of the simulated sky or a prior map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The generated sky.
    #[error(transparent)]
    GeneratedSky(#[from] crate::sky::generated::GeneratedSkyError),
    /// What is added to a map of the sky.
    #[error(transparent)]
    AddedSky(#[from] crate::sky::generated::AddedSkyError),
    /// The harmonic coefficients of the simulated sky cannot be computed.
    #[error("the harmonic coefficients of the simulated sky: {0}")]
    Coefficients(#[from] crate::sky::harmonics::HarmonicsError),
    /// A value of the configuration that does not fit the files that it names.
    #[error(transparent)]
    Invalid(#[from] crate::units::InvalidValue),
    /// An invalid model of visibilities.
    #[error(transparent)]
    Model(#[from] crate::response::model::ModelError),
    /// A map file.
    #[error(transparent)]
    Fits(#[from] FitsError),
    /// A stage failed.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// Visibilities unaccounted for: a bug of the program.
    #[error(transparent)]
    Ledger(#[from] LedgerImbalance<VisibilityReason>),
    /// Samples unaccounted for: a bug of the program.
    #[error(transparent)]
    SampleLedger(#[from] LedgerImbalance<SampleReason>),
    /// Calibration cannot be set up.
    #[error(transparent)]
    Calibration(#[from] crate::calibration::CalibrationError),
    /// The downlink.
    #[error(transparent)]
    Downlink(#[from] crate::downlink::DownlinkError),
    /// Products cannot be written.
    #[error(transparent)]
    Products(#[from] crate::products::ProductsError),
    /// A map cannot be made of sums.
    #[error(transparent)]
    Solve(#[from] crate::imaging::SolveError),
    /// The ground failed.
    #[error(transparent)]
    Ground(#[from] crate::ground::GroundError),
    /// No data for any map.
    #[error(
        "no visibility of a pair could be used, so there is no map; see {} and, for a downlink, `lunarray inspect`\n{ledger}",
        summary.display()
    )]
    NoMap {
        /// Where the summary is.
        summary: std::path::PathBuf,
        /// The ledger of visibilities.
        ledger: Box<crate::runtime::LedgerReport<VisibilityReason>>,
    },
    /// The ground's last checkpoint could not be written.
    #[error(
        "the state was not saved: {reason}. Maps and {} hold all data; the state holds that of its newest checkpoint: \
         mend the cause, and replay the same files again",
        summary.display()
    )]
    Unsaved {
        /// Where the summary is.
        summary: std::path::PathBuf,
        /// Why it could not be written.
        reason: String,
    },
    /// One rank of several was interrupted, so that there is no common sum.
    #[error(
        "interrupted: ranks hold no common sums of the data so far, so there is no map of them; maps made before stay"
    )]
    RankInterrupted,
    /// Settings with which ranks cannot share the sums.
    #[error("--mpi: found {found}, expected {expected}")]
    NotShareable {
        /// What was set.
        found: &'static str,
        /// What can be shared.
        expected: &'static str,
    },
    /// No observing window.
    #[error(
        "spacecraft.duration_s = {duration_s}: there is no observing window in it. The first begins when the Earth sets for \
         daughter 1, within an orbit of {orbit_s:.0} s, and spacecraft.thin and every_nth_window leave out more"
    )]
    NoWindow {
        /// Length of the mission, s.
        duration_s: f64,
        /// An orbit, s.
        orbit_s: f64,
    },
    /// A downlink that cannot be read more than once.
    #[error("{}: not a regular file; expected one with --groups, which reads the downlink once a group", path.display())]
    NotRepeatable {
        /// What was named.
        path: std::path::PathBuf,
    },
    /// A downlink that describes no instrument.
    #[error(
        "{}: no description of the instrument; expected one, as every downlink of ours has near its beginning: is a file \
         before it missing?",
        path.display()
    )]
    NoInstrument {
        /// The first file.
        path: std::path::PathBuf,
    },
    /// Files that changed while they were read once a group.
    #[error(
        "the files hold {now} visibilities, and held {before} when the group of channels before was mapped; expected \
         files that stay: repeat the command once they are complete"
    )]
    FilesChanged {
        /// Visibilities at first.
        before: u64,
        /// Visibilities now.
        now: u64,
    },
    /// What cannot be done group by group.
    #[error("--groups: found {found}, expected {expected}")]
    NotInGroups {
        /// What was set.
        found: &'static str,
        /// What can be.
        expected: &'static str,
    },
    /// Visibilities that were put aside are gone.
    #[error("{}: gone while the others were simulated; expected it to stay: repeat the command", path.display())]
    SpoolGone {
        /// The file.
        path: std::path::PathBuf,
    },
    /// Visibilities cannot be put aside, or read back.
    #[error(transparent)]
    Spool(#[from] crate::mother::SpoolError),
    /// An estimate that is not a number.
    #[error(
        "the estimated {what} is {value}: nothing bounds this run; expected settings of which the work can be estimated: look for periods, \
         motions and times near 0, and for very large numbers"
    )]
    Unbounded {
        /// What was estimated.
        what: String,
        /// The estimate.
        value: f64,
    },
    /// More memory needed than there is.
    #[error(
        "an estimated {} of memory are needed, and {} are available ({}): expected at most that; lower map.nside, \
         map.l_max or the number of channels, take some of them at a time (--groups auto), or state another limit, as in --memory-max {}GB",
        gigabytes(*needed_bytes), gigabytes(limit.bytes as f64), limit.source, (needed_bytes / 1e9).ceil()
    )]
    Memory {
        /// Estimated need, bytes.
        needed_bytes: f64,
        /// The limit.
        limit: MemoryLimit,
    },
    /// The thread pool cannot be started.
    #[error("cannot start {threads} worker threads: {reason}")]
    Threads {
        /// Threads asked for.
        threads: usize,
        /// The system's error.
        reason: String,
    },
}

/// Bytes as gigabytes.
fn gigabytes(bytes: f64) -> String {
    match bytes {
        1e8.. => format!("{:.2} GB", bytes / 1e9),
        1e5.. => format!("{:.1} MB", bytes / 1e6),
        _ => format!("{bytes:.0} bytes"),
    }
}
