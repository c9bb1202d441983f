//! What a simulation knows and the ground does not: the sky that was observed.

use crate::sky::{MapError, SkyMap};
use crate::units::ChannelId;

/// The observed sky of every channel, at the maps' size; only to compare maps with.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Truth(Vec<SkyMap>);

impl Truth {
    /// Nothing is known, as with real data.
    #[must_use]
    pub fn unknown() -> Self {
        Self::default()
    }

    /// Of `skies`, one a channel, turned to ecliptic axes and averaged or split to `nside`: what a map of pixels is
    /// to be compared with.
    ///
    /// # Errors
    /// A sky that cannot be turned or resized.
    pub fn new(skies: &[SkyMap], nside: usize) -> Result<Self, MapError> {
        let at_map_size = |sky: &SkyMap| sky.to_ecliptic().resized(nside);
        skies.iter().map(at_map_size).collect::<Result<_, _>>().map(Self)
    }

    /// Of `skies`, one a channel, turned to ecliptic axes, without the degrees beyond `l_max`: what a map of
    /// harmonics is to be compared with.
    ///
    /// # Errors
    /// A sky that has no harmonics.
    pub fn band_limited(skies: &[SkyMap], nside: usize, l_max: usize) -> Result<Self, MapError> {
        skies.iter().map(|sky| sky.band_limited(nside, l_max)).collect::<Result<_, _>>().map(Self)
    }

    /// The sky of one channel, if it is known.
    #[must_use]
    pub fn channel(&self, channel: ChannelId) -> Option<&SkyMap> {
        self.0.get(usize::from(channel.0))
    }
}
