//! Errors of solutions.

use thiserror::Error;

use crate::sky::harmonics::HarmonicsError;
use crate::units::ChannelId;

/// Why a solution failed.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum SolveError {
    /// The run was cancelled, and there is no time for the solution.
    #[error("the run was cancelled before the map was made")]
    Interrupted,
    /// Ranks that were to solve for different maps.
    #[error(
        "the ranks of the job hold sums of different data; expected each to take the same downlink with the same settings: is a file \
         growing, or was one of them interrupted?"
    )]
    Ranks,
    /// Sums on disk that could not be read.
    #[error("{0}")]
    Sums(String),
    /// Nothing to solve.
    #[error("there is no data for a map")]
    NoData,
    /// epsilon is missing for a channel.
    #[error("map.epsilon has no value for channel {0}; expected one value, or one for each channel")]
    NoEpsilon(ChannelId),
    /// epsilon is not positive.
    #[error("epsilon = {0}: expected a number above 0")]
    Epsilon(f64),
    /// A prior of another size.
    #[error("a prior of {found} pixels was given for a map of {expected}")]
    PriorLength {
        /// Pixels of the prior.
        found: usize,
        /// Pixels of the map.
        expected: usize,
    },
    /// A table of angular power that cannot be used.
    #[error("map.regulariser.file: {}: {found}; expected a table of l and C_l in K^2, from l = 0 on, all above 0", path.display())]
    Power {
        /// Its path.
        path: std::path::PathBuf,
        /// What was found.
        found: String,
    },
    /// A table of angular power that ends too early.
    #[error("map.regulariser.file: {found} degrees; expected {expected}, up to the greatest of the map")]
    PowerLength {
        /// Degrees in it.
        found: usize,
        /// Degrees of the map.
        expected: usize,
    },
    /// No power of the sky makes the matrix positive definite.
    #[error(
        "no angular power of the sky fits the data: the normal matrix has no Cholesky factor with any; expected finite numbers in it. \
         map.regulariser = \"identity\" takes R = epsilon W_max I instead"
    )]
    NoPower,
    /// Channels that cannot be solved for together.
    #[error(
        "a joint map of {channels} channels at {frequencies} frequencies; expected two or more, each at its own frequency"
    )]
    FewChannels {
        /// Channels given.
        channels: usize,
        /// Frequencies among them.
        frequencies: usize,
    },
    /// A frequency that channels do not enclose.
    #[error(
        "{:.3} MHz: expected a frequency between {:.3} and {:.3} MHz, those of the channels; beyond them the sky is not known",
        frequency_hz / 1e6, ends_hz[0] / 1e6, ends_hz[1] / 1e6
    )]
    BeyondChannels {
        /// Frequency asked for, Hz.
        frequency_hz: f64,
        /// Lowest and highest channel, Hz.
        ends_hz: [f64; 2],
    },
    /// Sums of which no joint map can be made.
    #[error(
        "{:.3} MHz: a state of {found}; expected sums over harmonics (map.engine = \"harmonic\", without refinement), of which joint maps \
         are made",
        frequency_hz / 1e6
    )]
    NotHarmonic {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// What it holds.
        found: &'static str,
    },
    /// A pixel that is not on the map.
    #[error("there is no pixel {pixel} on a map of {pixels}")]
    NoPixel {
        /// Pixel asked for.
        pixel: usize,
        /// Pixels of the map.
        pixels: usize,
    },
    /// The matrix has no Cholesky factor.
    #[error(
        "the regularised normal matrix is not positive definite at pixel {pixel}; expected it to be, with \
         epsilon = {epsilon:e}: raise map.epsilon; or lower map.weight_max, if the sky is so bright that all weights are far \
         below it"
    )]
    NotPositive {
        /// First pixel of the tile in which it failed.
        pixel: usize,
        /// Regularisation.
        epsilon: f64,
    },
    /// Visibilities that could not be summed for refinement.
    #[error("refinement: {0}")]
    Refinement(String),
    /// A transform between map and harmonics failed.
    #[error(transparent)]
    Harmonics(#[from] HarmonicsError),
    /// An eigenvalue decomposition that did not converge.
    #[error("the eigenvalues of the normal matrix did not converge; expected finite numbers in it")]
    Eigenvalues,
}
