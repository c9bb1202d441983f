//! Order of the pixels in a row.

use crate::sky::healpix;

/// Order of the pixels in a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PixelOrder {
    /// As maps have them.
    Ring,
    /// Neighbours together, so that the Moon hides many of them at once.
    Nested,
}

impl PixelOrder {
    /// RING number of the pixel at a place of a row.
    pub(super) fn ring(self, nside: usize, place: usize) -> usize {
        match self {
            Self::Ring => place,
            Self::Nested => healpix::nested_to_ring(nside, place),
        }
    }
}
