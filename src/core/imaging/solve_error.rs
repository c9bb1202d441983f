//! Errors of solutions.

use thiserror::Error;

use crate::sky::harmonics::HarmonicsError;
use crate::units::ChannelId;

/// Why a solution failed.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum SolveError {
    /// The run was cancelled before the solution was ready.
    #[error("the run was cancelled before the map was made")]
    Interrupted,
    /// The ranks of a job hold different data.
    #[error(
        "the ranks of the job hold sums of different data; expected each to take the same downlink with the same settings: is a file \
         growing, or was one of them interrupted?"
    )]
    Ranks,
    /// Sums on disk could not be read.
    #[error("{0}")]
    Sums(String),
    /// There is no data.
    #[error("there is no data for a map")]
    NoData,
    /// There is no epsilon for a channel.
    #[error("map.epsilon has no value for channel {0}; expected one value, or one for each channel")]
    NoEpsilon(ChannelId),
    /// epsilon is not positive.
    #[error("epsilon = {0}: expected a number above 0")]
    Epsilon(f64),
    /// The prior has another size than the map.
    #[error("a prior of {found} pixels was given for a map of {expected}")]
    PriorLength {
        /// Pixels of the prior.
        found: usize,
        /// Pixels of the map.
        expected: usize,
    },
    /// A prior map is of another frequency than the data.
    #[error(
        "map.prior_files: the prior of channel {channel} is at {} MHz, the data at {} MHz; expected one frequency: set \
         spacecraft.channels_hz to that of the data",
        prior_hz / 1e6, data_hz / 1e6
    )]
    PriorFrequency {
        /// The channel.
        channel: ChannelId,
        /// Frequency of the prior, Hz.
        prior_hz: f64,
        /// Frequency of the data, Hz.
        data_hz: f64,
    },
    /// A table of angular power is invalid.
    #[error("map.regulariser.file: {}: {found}; expected a table of l and C_l in K^2, from l = 0 on, all above 0", path.display())]
    Power {
        /// Its path.
        path: std::path::PathBuf,
        /// What was found.
        found: String,
    },
    /// A table of the power beyond the degrees of a map is invalid.
    #[error(
        "map.beyond_files: {}: {found}; expected a table of l and C_l in K^2 of two or more degrees without gaps, all above 0",
        path.display()
    )]
    BeyondPower {
        /// Its path.
        path: std::path::PathBuf,
        /// What was found.
        found: String,
    },
    /// A table of angular power ends before the map's maximum degree.
    #[error("map.regulariser.file: {found} degrees; expected {expected}, up to the greatest of the map")]
    PowerLength {
        /// Degrees in it.
        found: usize,
        /// Degrees of the map.
        expected: usize,
    },
    /// No power of the sky makes the normal matrix positive definite.
    #[error(
        "no angular power of the sky fits the data: the normal matrix has no Cholesky factor with any; expected finite numbers in it. \
         map.regulariser = \"identity\" takes R = epsilon W_max I instead"
    )]
    NoPower,
    /// There are too few channels for a joint map, or two of one frequency.
    #[error(
        "a joint map of {channels} channels at {frequencies} frequencies; expected two or more, each at its own frequency, or one with total \
         powers (spacecraft.auto_powers = true)"
    )]
    FewChannels {
        /// Number of channels.
        channels: usize,
        /// Number of different frequencies.
        frequencies: usize,
    },
    /// Two joint maps are at nearly one frequency.
    #[error(
        "joint maps at {} and {} Hz would have one folder; expected the same frequency, or 1 kHz or more between them", pair_hz[0], pair_hz[1]
    )]
    NearFrequencies {
        /// The frequencies, Hz.
        pair_hz: [f64; 2],
    },
    /// A frequency lies outside the range of the channels.
    #[error(
        "{:.3} MHz: expected a frequency between {:.3} and {:.3} MHz, those of the channels; beyond them the sky is not known",
        frequency_hz / 1e6, ends_hz[0] / 1e6, ends_hz[1] / 1e6
    )]
    BeyondChannels {
        /// Requested frequency, Hz.
        frequency_hz: f64,
        /// Lowest and highest frequency of the channels, Hz.
        ends_hz: [f64; 2],
    },
    /// There are constants of total powers for another number of channels.
    #[error(
        "{found} constants of the total powers for {channels} channels; expected one, or one for each channel in order of frequency"
    )]
    PowerConstants {
        /// Number of constants.
        found: usize,
        /// Number of channels.
        channels: usize,
    },
    /// Total powers of antennas with a pattern.
    #[error(
        "{:.3} MHz: total powers of dipoles; expected isotropic antennas or three dipoles, as a pattern is not in the powers' rows: \
         --no-powers (joint.powers = false) leaves them out", frequency_hz / 1e6
    )]
    PowersOfDipoles {
        /// Frequency, Hz.
        frequency_hz: f64,
    },
    /// A state does not hold harmonic sums, which joint maps need.
    #[error(
        "{:.3} MHz: a state of {found}; expected sums over harmonics (map.engine = \"harmonic\", without refinement), of which joint maps \
         are made",
        frequency_hz / 1e6
    )]
    NotHarmonic {
        /// Frequency, Hz.
        frequency_hz: f64,
        /// What the state holds.
        found: &'static str,
    },
    /// A pixel that is not on the map.
    #[error("there is no pixel {pixel} on a map of {pixels}")]
    NoPixel {
        /// Requested pixel.
        pixel: usize,
        /// Number of pixels of the map.
        pixels: usize,
    },
    /// The matrix has no Cholesky factor.
    #[error(
        "the regularised normal matrix is not positive definite at pixel {pixel}; expected it to be, with \
         epsilon = {epsilon:e}: raise map.epsilon; or lower map.weight_max, if the sky is so bright that all weights are far \
         below it"
    )]
    NotPositive {
        /// First pixel of the tile in which factorisation failed.
        pixel: usize,
        /// Value of epsilon.
        epsilon: f64,
    },
    /// Refinement failed.
    #[error("refinement: {0}")]
    Refinement(String),
    /// A transform between map and harmonics failed.
    #[error(transparent)]
    Harmonics(#[from] HarmonicsError),
}
