//! The true sky of a simulation, which the ground segment does not know.

use crate::sky::{MapError, SkyMap};
use crate::units::ChannelId;

/// The true sky of every channel at the resolution of the maps; used only for comparison.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Truth(Vec<SkyMap>);

impl Truth {
    /// No truth, as with real data.
    #[must_use]
    pub fn unknown() -> Self {
        Self::default()
    }

    /// The truth for pixel maps: `skies`, one per channel, rotated to ecliptic axes and resampled to `nside`.
    ///
    /// # Errors
    /// A sky that cannot be rotated or resampled.
    pub fn new(skies: &[SkyMap], nside: usize) -> Result<Self, MapError> {
        let at_map_size = |sky: &SkyMap| sky.to_ecliptic().resized(nside);
        skies.iter().map(at_map_size).collect::<Result<_, _>>().map(Self)
    }

    /// The truth for harmonic maps: `skies`, one per channel, rotated to ecliptic axes and limited to degrees up to `l_max`.
    ///
    /// # Errors
    /// A sky without a harmonic transform.
    pub fn band_limited(skies: &[SkyMap], nside: usize, l_max: usize) -> Result<Self, MapError> {
        skies.iter().map(|sky| sky.band_limited(nside, l_max)).collect::<Result<_, _>>().map(Self)
    }

    /// The true sky of one channel, if known.
    #[must_use]
    pub fn channel(&self, channel: ChannelId) -> Option<&SkyMap> {
        self.0.get(usize::from(channel.0))
    }
}
