//! The true sky of a simulation, with which maps are compared. The ground segment does not use it.

use std::collections::BTreeMap;

use super::config::PostProcessing;
use crate::sky::{Frame, InputSky, MapError, SkyMap};
use crate::units::ChannelId;

/// The true sky of every channel, with which maps are compared.
///
/// Spectra use the sky at its own resolution; pictures and relative errors use the sky in pixels of the maps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Truth(BTreeMap<ChannelId, ChannelTruth>);

#[derive(Clone, Debug, PartialEq)]
pub(super) struct ChannelTruth {
    /// The sky in the pixels of the maps.
    pub(super) plain: InputSky,
    /// The sky in the pixels of post-processed maps, smoothed like them; `None` without post-processing.
    pub(super) processed: Option<InputSky>,
}

/// Shape of the maps that are compared with the true sky.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapShape {
    /// nside of the maps.
    pub nside: usize,
    /// Maximum degree of harmonic maps; `None` for pixel maps.
    pub l_max: Option<usize>,
    /// Post-processing of the maps.
    pub processing: Option<PostProcessing>,
}

impl Truth {
    /// An unknown truth, as with real data.
    #[must_use]
    pub fn unknown() -> Self {
        Self::default()
    }

    /// The truth for maps of this shape from `skies`, one per channel, rotated to ecliptic axes. For pixel maps they are averaged
    /// over pixels; for harmonic maps they are limited to the same degrees.
    ///
    /// # Errors
    /// A sky that cannot be rotated, resampled or smoothed.
    pub fn new(skies: &[SkyMap], shape: MapShape) -> Result<Self, MapError> {
        let channels = (0..).map(ChannelId).zip(skies);
        channels
            .map(|(channel, sky)| Ok((channel, ChannelTruth::new(sky, shape)?)))
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// Adds the true sky of a channel.
    ///
    /// # Errors
    /// Errors of [`Truth::new`].
    pub fn with(mut self, channel: ChannelId, sky: &SkyMap, shape: MapShape) -> Result<Self, MapError> {
        self.0.insert(channel, ChannelTruth::new(sky, shape)?);
        Ok(self)
    }

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
