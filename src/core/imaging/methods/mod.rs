//! The map methods by their names: the one place that knows all of them.

mod anywhere;
mod circle;
mod pixel;

use std::io::Read;
use std::path::Path;

use self::anywhere::RefinedMaps;
use self::circle::CircleMaps;
use self::pixel::{MatrixFreeMaps, PixelMaps};
use super::cost::{ChannelData, EngineCost};
use super::method::{MapMethod, MapSums, NewChannel, NewOrRefused, SumShare};
use super::{AccumulationError, ChannelGroup, MapConfig, Method, PixelEngine, automatic_weight_max};
use crate::frames::{Channel, Instrument, PlacedVisibilities};
use crate::ranks::RankShare;
use crate::units::ChannelId;

impl Method {
    fn implementation(self) -> &'static dyn MapMethod {
        match self {
            Self::Pixel => &PixelMaps,
            Self::MatrixFree => &MatrixFreeMaps,
            Self::Harmonic => &CircleMaps,
            Self::Refined => &RefinedMaps,
        }
    }
}

impl MapConfig {
    /// Creates the sums for the channel of `placed`, its first data.
    pub(super) fn new_sums(
        &self,
        instrument: &Instrument,
        placed: &PlacedVisibilities,
        share: &SumShare,
    ) -> Result<NewOrRefused<Box<dyn MapSums>>, AccumulationError> {
        let Some(&Channel { frequency_hz, width_hz }) =
            instrument.channels.get(usize::from(placed.channel.0))
        else {
            return Err(AccumulationError::UnknownChannel(placed.channel));
        };
        let weight_max = match self.weight_max {
            0.0 => automatic_weight_max(frequency_hz, width_hz),
            weight_max => weight_max,
        };
        let channel = NewChannel { config: self, instrument, placed, frequency_hz, weight_max, share };
        self.method().implementation().create(&channel)
    }

    /// Reads what [`MapSums::save`] wrote on the rank with share `part`, as [`MapMethod::load`].
    pub(super) fn load_sums(
        &self,
        from: &mut dyn Read,
        folder: Option<&Path>,
        (part, share): (RankShare, &SumShare),
    ) -> Result<Box<dyn MapSums>, AccumulationError> {
        self.method().implementation().load(self, from, folder, (part, &share.ranks))
    }

    /// Estimates what the map of a channel takes.
    #[doc(hidden)]
    #[must_use]
    pub fn cost(&self, data: ChannelData) -> EngineCost {
        self.method().implementation().cost(self, data)
    }

    /// Requires that the sums of the mapped channels of a group take at most `limit_bytes`; the instrument has `channels` channels. Harmonic sums
    /// grow with the data and are not counted.
    ///
    /// # Errors
    /// [`AccumulationError::Memory`].
    #[doc(hidden)]
    pub fn require_memory(
        &self,
        channels: usize,
        limit_bytes: Option<u64>,
        group: Option<&ChannelGroup>,
    ) -> Result<(), AccumulationError> {
        let each = match self.method() {
            Method::Pixel => PixelEngine::memory_bytes(self.nside),
            Method::MatrixFree | Method::Harmonic | Method::Refined => 0,
        };
        let is_summed = |channel: &ChannelId| {
            self.is_mapped(*channel) && group.is_none_or(|group| group.contains(channel))
        };
        let channels = (0..channels as u16).map(ChannelId).filter(is_summed).count();
        let needed_bytes = each.saturating_mul(channels as u64);
        match limit_bytes {
            Some(limit_bytes) if needed_bytes > limit_bytes => {
                Err(AccumulationError::Memory { channels, needed_bytes, limit_bytes })
            }
            _ => Ok(()),
        }
    }
}
