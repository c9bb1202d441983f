//! Configuration of the ground.

use std::path::Path;

use super::GroundError;
use super::pass_gate::{MODEL, PassGate};
use crate::calibration::solver::{PassSolver, SolverConfig};
use crate::calibration::{CalibrationConfig, CalibrationError, CalibrationHook, Calibrator};
use crate::frames::{Instrument, VisibilityReason};
use crate::imaging::circle::SumPart;
use crate::imaging::{AccumulationError, Accumulator, ChannelGroup, MapConfig};
use crate::runtime::Ledger;
use crate::sky::fits::check_frequencies;

/// Default capacity of the hold buffer, bytes: a week of thirty channels.
#[doc(hidden)]
pub const WAIT_BYTES: u64 = 1 << 28;

/// Segments of positions that are kept: more than two years of windows.
const SEGMENTS_MAX: usize = 8192;

/// Configuration of the ground, from bytes to sums.
#[derive(Clone, Debug)]
pub struct GroundConfig {
    /// Calibration.
    pub calibration: CalibrationConfig,
    /// How gains are found, for `calibration.hook = "solve"`.
    pub calibrate: SolverConfig,
    /// Sums.
    pub map: MapConfig,
    /// Bytes of visibilities that may wait for their positions. An archive keeps the value that it was made with.
    pub wait_bytes: u64,
    /// Most memory for the sums, bytes, as far as it is known beforehand; `None` for no limit.
    pub memory_max_bytes: Option<u64>,
    /// The channels that are summed; `None` for all.
    pub group: Option<ChannelGroup>,
    /// The part of the sums that is made; `None` for all of them.
    pub part: Option<SumPart>,
}

impl GroundConfig {
    /// Whether maps can be made of an instrument, as far as its description says.
    ///
    /// # Errors
    /// Calibration that was not made for it; settings of the map that do not fit it, or files of other frequencies; too many channels, or too
    /// little memory for them.
    pub fn fits(&self, instrument: &Instrument) -> Result<(), GroundError> {
        if self.calibration.hook == CalibrationHook::Solve {
            let maps = self.calibrate.model_files.len();
            self.calibrate.check_instrument(instrument, maps, MODEL).map_err(CalibrationError::from)?;
            check_frequencies(&self.calibrate.model_files, &instrument.frequencies_hz())
                .map_err(CalibrationError::from)?;
        }
        let described = self.described(instrument)?;
        self.map.check_priors(&described)?;
        let channels = described.channels.len();
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

    /// The gate that holds visibilities until their gains are known, if gains are to be found.
    pub(super) fn gate(&self) -> Result<Option<PassGate>, CalibrationError> {
        if self.calibration.hook != CalibrationHook::Solve {
            return Ok(None);
        }
        if let Some(problem) = self.calibrate.problems_of_hook().into_iter().next() {
            return Err(problem.into());
        }
        let (van_vleck, maps) = (self.calibration.van_vleck()?, self.calibrate.models()?);
        Ok(Some(PassGate::new(PassSolver::new(&self.calibrate, van_vleck, maps))))
    }

    /// A calibrator without data, posting to `ledger`, with the gains that `gate` finds.
    pub(super) fn calibrator(
        &self,
        gate: Option<&PassGate>,
        ledger: &Ledger<VisibilityReason>,
    ) -> Result<Calibrator, CalibrationError> {
        let calibration = match gate {
            Some(gate) => Box::new(gate.gains().clone()),
            None => self.calibration.build(Path::new(""))?,
        };
        Ok(Calibrator::new(calibration, ledger.clone())
            .with_van_vleck(self.calibration.van_vleck()?)
            .with_autos()
            .with_segments(SEGMENTS_MAX)
            .with_group(self.group.clone()))
    }

    /// An accumulator without data, posting to `ledger`.
    pub(super) fn accumulator(&self, ledger: &Ledger<VisibilityReason>) -> Accumulator {
        Accumulator::new(self.map.clone(), ledger.clone())
            .within_memory(self.memory_max_bytes)
            .of_group(self.group.clone())
            .in_part(self.part.clone())
    }
}
