//! What the accumulation of a channel hands to its solution.

use std::sync::Arc;

use crate::frames::Instrument;
use crate::imaging::anywhere::VisibilityArchive;
use crate::imaging::circle::{HarmonicSums, NoiseSums};
use crate::imaging::{MatrixFreeVisibilities, NormalSums, PixelSums, SumCounts};
use crate::units::ChannelId;

/// A copy of the sums of one channel, to be solved while more data arrives.
pub struct Snapshot {
    /// Instrument.
    pub instrument: Arc<Instrument>,
    /// Channel.
    pub channel: ChannelId,
    /// Number of the snapshot in its channel, from 1.
    pub number: u32,
    /// Whether it holds all data.
    pub is_final: bool,
    /// Mission times of its first and last data, s.
    pub span_s: [f64; 2],
    /// nside of its map.
    pub nside: usize,
    /// Its data.
    pub data: SnapshotData,
}

/// The data of a snapshot: accumulated normal equations, or individual visibilities.
pub enum SnapshotData {
    /// Normal equations over pixels.
    Pixel(PixelSums),
    /// Normal equations over spherical harmonics.
    Harmonic(Box<HarmonicSums>),
    /// Individual visibilities, for iterative refinement.
    Refined(Box<VisibilityArchive>),
    /// Individual visibilities, for a pixel map solved without storing the matrix.
    MatrixFree(Box<MatrixFreeVisibilities>),
}

impl SnapshotData {
    pub(super) fn with_noise_realisations(self, realisations: Option<NoiseSums>) -> Self {
        match (self, realisations) {
            (Self::Harmonic(sums), Some(realisations)) => {
                Self::Harmonic(Box::new(sums.with_noise_realisations(realisations)))
            }
            (other, _) => other,
        }
    }

    /// Number and weight of its visibilities.
    #[must_use]
    pub fn counts(&self) -> SumCounts {
        match self {
            Self::Pixel(sums) => sums.counts(),
            Self::Harmonic(sums) => sums.counts(),
            Self::Refined(archive) => archive.counts(),
            Self::MatrixFree(visibilities) => visibilities.counts(),
        }
    }
}
