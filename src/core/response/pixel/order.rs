//! Order of the pixels in a row.

use crate::sky::healpix;

/// Order in which a row lists the pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PixelOrder {
    /// RING order, as in maps.
    Ring,
    /// NESTED order, in which neighbours are adjacent, so that the Moon hides many of them at once.
    Nested,
}

impl PixelOrder {
    /// RING number of the pixel at an index of a row.
    pub(super) fn ring(self, nside: usize, index: usize) -> usize {
        match self {
            Self::Ring => index,
            Self::Nested => healpix::nested_to_ring(nside, index),
        }
    }
}
