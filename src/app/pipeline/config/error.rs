//! Errors of a configuration and of a pipeline.

use std::path::PathBuf;

use thiserror::Error;

use super::memory::MemoryLimit;
use super::problems::Problems;
use crate::array::ArrayError;
use crate::frames::{SampleReason, VisibilityReason};
use crate::response::MeasuredAntennasError;
use crate::runtime::{LedgerImbalance, LedgerReport, RuntimeError};
use crate::sky::MapError;
use crate::sky::fits::FitsError;
use crate::units::bytes_text;

/// Share of the visibilities of a run, refused for their positions, from which on its map has the wrong engine.
const OFF_CIRCLE_SHARE: f64 = 0.01;

/// What to do where the harmonic engine refused many visibilities for their positions; a line, or nothing.
pub(in crate::pipeline) fn advice_off_circle(ledger: &LedgerReport<VisibilityReason>) -> &'static str {
    use VisibilityReason::{OffAltitude, OutOfPlane, UnequalAltitudes};
    let reasons = [OutOfPlane, OffAltitude, UnequalAltitudes];
    let refused: u64 = reasons.iter().filter_map(|reason| ledger.left_out.get(reason)).sum();
    match refused as f64 > OFF_CIRCLE_SHARE * ledger.sampled as f64 {
        true => {
            "\nmany visibilities were refused, as the satellites do not share a circle: map.engine = \"pixel\" takes them, or \
             map.refine.passes_max above 0"
        }
        false => "",
    }
}

/// Maximum length of a pipeline file, bytes; a hundred times that of a file with every key.
pub(super) const FILE_BYTES_MAX: u64 = 1 << 20;

/// Errors of reading and checking a configuration.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the pipeline file {}: {source}", path.display())]
    Read {
        /// Path.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not text.
    #[error(
        "{}, line {line}: not text in UTF-8; expected a pipeline file (TOML). `lunarray inspect` and `replay` read a downlink, and sky.file names a map",
        path.display()
    )]
    NotText {
        /// Path.
        path: PathBuf,
        /// Line of the first byte that is no text, counted from 1.
        line: usize,
    },
    /// The file is a study.
    #[error("{}: a study, with {key}; expected a pipeline file: run it by `lunarray study {}`", path.display(), path.display())]
    Study {
        /// Path.
        path: PathBuf,
        /// A key that only studies have.
        key: &'static str,
    },
    /// The file is too long for a pipeline file.
    #[error("{}: more than {FILE_BYTES_MAX} bytes; expected a pipeline file, which has some thousand", path.display())]
    TooLong {
        /// Path.
        path: PathBuf,
    },
    /// A `--set` that is not `key=value`.
    #[error("--set {0}: expected key=value, for example --set map.nside=32")]
    Override(String),
    /// A `--set` with a key below a value, or of an element that is not there.
    #[error("--set {key}: `{part}` {found}")]
    NotThere {
        /// Full key.
        key: String,
        /// The part of the key that is not there.
        part: String,
        /// What is there.
        found: String,
    },
    /// Syntax errors, unknown keys, wrong types and invalid values, all together.
    #[error("{origin}: {problems}")]
    Values {
        /// Path of the file, or name of the embedded default.
        origin: String,
        /// The problems.
        problems: Problems,
    },
}

/// Errors that prevent or end a run of a pipeline.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// An invalid configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// An invalid array or orbit.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// Files of antennas, which a section names.
    #[error("{0}: {1}")]
    Antennas(&'static str, MeasuredAntennasError),
    /// A map of the simulated sky or a prior map.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The generated sky cannot be computed.
    #[error(transparent)]
    GeneratedSky(#[from] crate::sky::generated::GeneratedSkyError),
    /// The sources or components added to a sky map are invalid.
    #[error(transparent)]
    AddedSky(#[from] crate::sky::generated::AddedSkyError),
    /// The harmonic coefficients of the simulated sky cannot be computed.
    #[error("the harmonic coefficients of the simulated sky: {0}")]
    Coefficients(#[from] crate::sky::harmonics::HarmonicsError),
    /// A value of the configuration that does not fit the named files.
    #[error(transparent)]
    Invalid(#[from] crate::units::InvalidValue),
    /// An invalid model of visibilities.
    #[error(transparent)]
    Model(#[from] crate::response::model::ModelError),
    /// A map file is unreadable or invalid.
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
    /// The downlink cannot be read, written, sent or received.
    #[error(transparent)]
    Downlink(#[from] crate::downlink::DownlinkError),
    /// Products cannot be written.
    #[error(transparent)]
    Products(#[from] crate::products::ProductsError),
    /// The solution for a map failed.
    #[error(transparent)]
    Solve(#[from] crate::imaging::SolveError),
    /// The ground segment failed.
    #[error(transparent)]
    Ground(#[from] crate::ground::GroundError),
    /// A patch cannot be imaged.
    #[error(transparent)]
    Zoom(#[from] crate::imaging::zoom::ZoomError),
    /// A search without an array within its limits.
    #[error(
        "none of {trials} arrays is possible: {reasons}. Expected wider [limits], other ranges, or more evaluations; all are in {}",
        table.display()
    )]
    NoDesign {
        /// Number of arrays that were tried.
        trials: usize,
        /// The commonest reasons, how many arrays have each, and an example.
        reasons: String,
        /// Path of the table of arrays.
        table: std::path::PathBuf,
    },
    /// No data for any map.
    #[error(
        "no visibility of a pair could be used, so there is no map; see {} and, for a downlink, `lunarray inspect`\n{ledger}{}",
        summary.display(),
        advice_off_circle(ledger)
    )]
    NoMap {
        /// Path of the summary.
        summary: std::path::PathBuf,
        /// The ledger of visibilities.
        ledger: Box<LedgerReport<VisibilityReason>>,
    },
    /// The last checkpoint of the ground segment could not be written.
    #[error(
        "the state was not saved: {reason}. Maps and {} hold all data; the state holds that of its newest checkpoint: {}",
        summary.display(),
        if *is_archived {
            "mend the cause; the next start adds what its raw archive has, so that nothing has to be sent again"
        } else {
            "mend the cause, and replay the same files again"
        }
    )]
    Unsaved {
        /// Path of the summary.
        summary: std::path::PathBuf,
        /// Why the checkpoint could not be written.
        reason: String,
        /// Whether a raw archive has the packets since that checkpoint.
        is_archived: bool,
    },
    /// One rank of several was interrupted, so the ranks hold different data and no map can be made.
    #[error(
        "interrupted: the ranks have not received the same data, so no map was made of them; earlier maps are kept"
    )]
    RankInterrupted,
    /// Settings with which ranks cannot share the normal equations.
    #[error("--mpi: found {found}, expected {expected}")]
    NotShareable {
        /// The setting.
        found: &'static str,
        /// The required setting.
        expected: &'static str,
    },
    /// The mission has no observing window.
    #[error(
        "spacecraft.duration_s = {duration_s}: there is no observing window in it. The first begins when the Earth sets for \
         daughter 1, within an orbit of {orbit_s:.0} s, and spacecraft.thin and every_nth_window leave out more"
    )]
    NoWindow {
        /// Length of the mission, s.
        duration_s: f64,
        /// Orbital period, s.
        orbit_s: f64,
    },
    /// The Earth never sets for the first station.
    #[error(
        "array.stations: the Earth is above the horizon of station 1 for all of spacecraft.duration_s = {duration_s}, so there is no \
         observing window; expected stations on the far side, or spacecraft.thin and every_nth_window that leave out less"
    )]
    EarthNeverSets {
        /// Length of the mission, s.
        duration_s: f64,
    },
    /// A downlink that cannot be read more than once.
    #[error("{}: not a regular file; expected one with --groups, which reads the downlink once per group", path.display())]
    NotRepeatable {
        /// Path of the downlink.
        path: std::path::PathBuf,
    },
    /// A downlink that describes no instrument.
    #[error(
        "{}: no description of the instrument; expected one near the beginning of the downlink: is an earlier file missing?",
        path.display()
    )]
    NoInstrument {
        /// The first file.
        path: std::path::PathBuf,
    },
    /// Files that changed between the readings for two groups.
    #[error(
        "the files hold {now} visibilities, but held {before} when the previous group of channels was mapped; expected \
         unchanged files: repeat the command once they are complete"
    )]
    FilesChanged {
        /// Visibilities in the earlier reading.
        before: u64,
        /// Visibilities now.
        now: u64,
    },
    /// Joint maps where sums are not in the memory of one process.
    #[error(
        "{with}: found joint.on = true, expected false; `lunarray joint` makes joint maps of a state, which `lunarray replay --state` leaves"
    )]
    NotJoint {
        /// What does not go with it.
        with: &'static str,
    },
    /// A setting of a map that joint maps do not have.
    #[error(
        "{}: found {key} in the settings of its maps, which joint maps do not have; expected none: override it, such as --set {key}={none}",
        state.display()
    )]
    JointWithout {
        /// Folder of the state.
        state: std::path::PathBuf,
        /// The key.
        key: &'static str,
        /// Its value for none.
        none: &'static str,
    },
    /// Two states of a joint map hold one frequency.
    #[error(
        "{:.3} MHz is in {} and in {}; expected each frequency in one state: `lunarray replay` of all downlinks into one state adds their data",
        frequency_hz / 1e6, states[0].display(), states[1].display()
    )]
    SameFrequency {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Folders of the states.
        states: [std::path::PathBuf; 2],
    },
    /// A run that cannot be done group by group.
    #[error("--groups: found {found}, expected {expected}")]
    NotInGroups {
        /// The setting.
        found: &'static str,
        /// The required setting.
        expected: &'static str,
    },
    /// A spool file was removed before it was merged.
    #[error("{}: removed while other groups were simulated; expected it to stay: repeat the command", path.display())]
    SpoolGone {
        /// Path of the spool file.
        path: std::path::PathBuf,
    },
    /// A spool file cannot be written or read back.
    #[error(transparent)]
    Spool(#[from] crate::mother::SpoolError),
    /// No baseline for any map.
    #[error("{0}")]
    NoBaseline(String),
    /// An estimate of the cost that is not finite.
    #[error(
        "the estimated {what} is {value}: nothing bounds this run; expected settings of which the work can be estimated: look for periods, \
         motions and times near 0, and for very large numbers"
    )]
    Unbounded {
        /// The estimated quantity.
        what: String,
        /// Value of the estimate.
        value: f64,
    },
    /// The run needs more memory than is available.
    #[error(
        "an estimated {} of memory are needed, but {} are available ({}): lower map.nside, \
         map.l_max or the number of channels, take some of them at a time (--groups auto), or state another limit, as in --memory-max {}GB",
        bytes_text(*needed_bytes), bytes_text(limit.bytes as f64), limit.source, (needed_bytes / 1e9).ceil()
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
        /// Requested number of threads.
        threads: usize,
        /// The system's error.
        reason: String,
    },
}
