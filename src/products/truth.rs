//! The true sky of a simulation, which the ground segment does not know.

use std::collections::BTreeMap;

use super::config::PostProcessing;
use crate::sky::{Frame, InputSky, MapError, SkyMap};
use crate::units::ChannelId;

/// The true sky of every channel, to compare maps with.
///
/// Spectra are of the sky at its own resolution, pictures and relative errors of the sky in pixels of the maps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Truth(BTreeMap<ChannelId, ChannelTruth>);

/// The true sky of a channel.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ChannelTruth {
    /// In the pixels of the maps.
    pub(super) plain: InputSky,
    /// In those of post-processed maps, and smoothed like them, if there are any.
    pub(super) processed: Option<InputSky>,
}

/// Maps with which a truth is compared.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapShape {
    /// nside.
    pub nside: usize,
    /// Greatest degree of maps of harmonics; `None` for maps of pixels.
    pub l_max: Option<usize>,
    /// What is done with them.
    pub processing: Option<PostProcessing>,
}

impl Truth {
    /// No truth, as with real data.
    #[must_use]
    pub fn unknown() -> Self {
        Self::default()
    }

    /// The truth for maps of this shape: `skies`, one per channel, turned to ecliptic axes. For maps of pixels they are
    /// averaged over them; for maps of harmonics they are limited to the same degrees.
    ///
    /// # Errors
    /// A sky that cannot be turned, resampled or smoothed.
    pub fn new(skies: &[SkyMap], shape: MapShape) -> Result<Self, MapError> {
        let channels = (0..).map(ChannelId).zip(skies);
        channels
            .map(|(channel, sky)| Ok((channel, ChannelTruth::new(sky, shape)?)))
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// With that of one more channel.
    ///
    /// # Errors
    /// As [`Truth::new`].
    pub fn with(mut self, channel: ChannelId, sky: &SkyMap, shape: MapShape) -> Result<Self, MapError> {
        self.0.insert(channel, ChannelTruth::new(sky, shape)?);
        Ok(self)
    }

    /// The true sky of one channel, if known.
    #[must_use]
    pub(super) fn channel(&self, channel: ChannelId) -> Option<&ChannelTruth> {
        self.0.get(&channel)
    }
}

impl ChannelTruth {
    fn new(sky: &SkyMap, shape: MapShape) -> Result<Self, MapError> {
        let MapShape { nside, l_max, processing } = shape;
        let mut plain = InputSky::new(sky, Frame::Ecliptic, nside, 3 * nside - 1)?;
        if let Some(l_max) = l_max {
            plain.map = sky.band_limited(nside, l_max)?;
        }
        let processed = processing.map(|processing| {
            let fine = processing.nside(nside);
            let map = match l_max {
                Some(l_max) => sky.band_limited(fine, l_max)?,
                None => sky.to_ecliptic().resized(fine)?,
            };
            let mut alm = plain.alm.clone();
            processing.smooth(&mut alm);
            Ok::<_, MapError>(InputSky { map: map.smoothed(processing.fwhm_rad())?, alm })
        });
        Ok(Self { plain, processed: processed.transpose()? })
    }
}
