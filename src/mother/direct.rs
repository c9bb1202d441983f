//! Visibilities by direct sum over a sky's pixels.

use super::model::{PairPosition, Prediction, VisibilityModel};
use crate::array::response::{Directions, PairGeometry, sky_sums};
use crate::frames::AntennaResponse;
use crate::sky::SkyMap;
use crate::sky::healpix::pixel_area_sr;
use crate::units::ChannelId;

/// One sky a channel, each summed over its own pixels at their centres; nothing is resampled.
///
/// Costs one fringe a pixel and visibility.
#[derive(Clone, Debug)]
pub struct DirectSum {
    channels: Vec<ChannelSky>,
    moon_radius_m: f64,
    response: AntennaResponse,
}

#[derive(Clone, Debug)]
struct ChannelSky {
    frequency_hz: f64,
    directions: Directions,
    /// K.
    values: Vec<f32>,
    area_sr: f64,
}

impl DirectSum {
    /// The model of `skies` (K, any frame), one for each of `frequencies_hz`.
    #[must_use]
    pub fn new(
        skies: &[SkyMap],
        frequencies_hz: &[f64],
        moon_radius_m: f64,
        response: AntennaResponse,
    ) -> Self {
        let channel = |(sky, &frequency_hz): (&SkyMap, &f64)| ChannelSky {
            frequency_hz,
            directions: Directions::from(sky.directions_ecliptic().as_slice()),
            values: sky.values().iter().map(|&value| value as f32).collect(),
            area_sr: pixel_area_sr(sky.nside()),
        };
        let channels = skies.iter().zip(frequencies_hz).map(channel).collect();
        Self { channels, moon_radius_m, response }
    }
}

impl VisibilityModel for DirectSum {
    fn predict(&self, channel: ChannelId, positions: &[PairPosition], out: &mut [Prediction]) {
        let Some(sky) = self.channels.get(usize::from(channel.0)) else { return };
        let pair = |position: &PairPosition| PairGeometry {
            r_i_m: position.r_i_m,
            r_j_m: position.r_j_m,
            frequency_hz: sky.frequency_hz,
            moon_radius_m: self.moon_radius_m,
            response: self.response,
        };
        let pairs: Vec<PairGeometry> = positions.iter().map(pair).collect();
        // Lengths agree by construction, so there is always an answer.
        let sums = sky_sums(&pairs, &sky.directions, &sky.values, sky.area_sr).unwrap_or_default();
        for (out, sum) in out.iter_mut().zip(sums) {
            *out =
                Prediction { visibility_k_sr: sum.visibility_k_sr, zero_spacing_k_sr: sum.zero_spacing_k_sr };
        }
    }
}
