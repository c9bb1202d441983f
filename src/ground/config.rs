//! Configuration of the ground.

use std::path::Path;

use super::GroundError;
use crate::accumulation::{AccumulationError, Accumulator, ChannelGroup, MapConfig};
use crate::calibration::{CalibrationConfig, CalibrationError, Calibrator};
use crate::frames::{Instrument, VisibilityReason};
use crate::runtime::Ledger;

/// Default capacity of the hold buffer, bytes: a week of thirty channels.
pub const WAIT_BYTES: u64 = 1 << 28;

/// Segments of positions that are kept: more than two years of windows.
const SEGMENTS_MAX: usize = 8192;

/// Configuration of the ground, from bytes to sums.
#[derive(Clone, Debug)]
pub struct GroundConfig {
    /// Calibration.
    pub calibration: CalibrationConfig,
    /// Sums.
    pub map: MapConfig,
    /// Bytes of visibilities that may wait for their positions. An archive keeps the value that it was made with.
    pub wait_bytes: u64,
    /// Most memory for the sums, bytes, as far as it is known beforehand; `None` for no limit.
    pub memory_max_bytes: Option<u64>,
    /// The channels that are summed; `None` for all.
    pub group: Option<ChannelGroup>,
}

impl GroundConfig {
    /// Whether maps can be made of an instrument, as far as its description says.
    ///
    /// # Errors
    /// Calibration that was not made for it; settings of the map that do not fit it; too many channels, or too
    /// little memory for them.
    pub fn fits(&self, instrument: &Instrument) -> Result<(), GroundError> {
        let channels = self.described(instrument)?.channels.len();
        if let Some(misfit) = self.map.misfits(channels).into_iter().next() {
            return Err(AccumulationError::from(misfit).into());
        }
        Ok(self.map.require_memory(channels, self.memory_max_bytes, self.group.as_ref())?)
    }

    /// The instrument as it is after calibration.
    ///
    /// # Errors
    /// Calibration that was not made for it.
    pub fn described(&self, instrument: &Instrument) -> Result<Instrument, GroundError> {
        Ok(self.calibration.build(Path::new(""))?.describe(instrument)?)
    }

    /// A calibrator without data, posting to `ledger`.
    pub(super) fn calibrator(
        &self,
        ledger: &Ledger<VisibilityReason>,
    ) -> Result<Calibrator, CalibrationError> {
        let calibration = self.calibration.build(Path::new(""))?;
        Ok(Calibrator::new(calibration, ledger.clone())
            .with_van_vleck(self.calibration.van_vleck()?)
            .with_autos()
            .with_segments(SEGMENTS_MAX)
            .of_group(self.group.clone()))
    }

    /// An accumulator without data, posting to `ledger`.
    pub(super) fn accumulator(&self, ledger: &Ledger<VisibilityReason>) -> Accumulator {
        Accumulator::new(self.map.clone(), ledger.clone())
            .within_memory(self.memory_max_bytes)
            .of_group(self.group.clone())
    }
}
