//! Random streams keyed by their purpose, so that no result depends on scheduling.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Purpose of a random stream; streams of different kinds are independent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum StreamKind {
    /// Thermal noise of integrated visibilities.
    VisibilityNoise = 1,
    /// Noise of the noise-only companion map, generated on the ground.
    CompanionNoise = 2,
    /// Small-scale structure of a generated sky.
    SkyFluctuations = 3,
    /// Point sources of a generated sky.
    SkySources = 4,
    /// Starting vectors of eigenvalue iterations and probing vectors.
    Probe = 5,
    /// Samples of the daughters.
    Samples = 6,
    /// Phases of interference.
    Interference = 7,
    /// Noise of the ninth daughter's spectra.
    Spectrometer = 8,
    /// Errors of the simulated instrument.
    Instrument = 9,
    /// Errors of gains that calibration applied.
    GainErrors = 10,
    /// Faults of a simulated link.
    Link = 20,
}

/// The random stream of `seed`, `kind` and two words of identity (for a block of visibilities:
/// channel and pair, and start tick).
///
/// It is ChaCha8 with the arguments as key, so equal arguments give equal streams on any thread.
#[must_use]
pub fn random_stream(seed: u64, kind: StreamKind, identity: [u64; 2]) -> ChaCha8Rng {
    let words = [seed, kind as u64, identity[0], identity[1]];
    let mut key = [0_u8; 32];
    for (bytes, word) in key.chunks_exact_mut(8).zip(words) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    ChaCha8Rng::from_seed(key)
}
