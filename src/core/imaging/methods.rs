//! The map methods by their names: the one place that knows all of them.

use std::io::Read;
use std::path::Path;

use super::anywhere::RefinedMaps;
use super::circle::CircleMaps;
use super::config::Method;
use super::cost::{ChannelData, EngineCost};
use super::method::{MapMethod, MapSums, NewChannel, NewOrRefused, SumShare};
use super::pixel::{MatrixFreeMaps, PixelMaps};
use super::{AccumulationError, MapConfig, automatic_weight_max};
use crate::frames::{Channel, Instrument, PlacedVisibilities};
use crate::ranks::RankShare;

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
}
