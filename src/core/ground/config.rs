//! Configuration of the ground segment.

use std::path::Path;

use super::GroundError;
use super::pass_gate::{MODEL_FILES_KEY, PassGate};
use crate::calibration::solver::{PassSolver, SolverConfig};
use crate::calibration::{CalibrationConfig, CalibrationError, CalibrationHook, Calibrator, FoundBursts};
use crate::frames::{Instrument, VisibilityReason};
use crate::imaging::circle::SumPart;
use crate::imaging::{AccumulationError, Accumulator, ChannelGroup, MapConfig};
use crate::runtime::Ledger;
use crate::sky::fits::check_frequencies;

/// Default capacity of the hold buffer, bytes. It holds a week of data of 30 channels.
#[doc(hidden)]
pub const WAIT_BYTES: u64 = 1 << 28;

/// Maximum number of ephemeris segments in memory, enough for two years of windows.
const SEGMENTS_MAX: usize = 8192;

/// Configuration of the ground segment.
#[derive(Clone, Debug)]
pub struct GroundConfig {
    /// Which calibration is applied.
    pub calibration: CalibrationConfig,
    /// How gains are solved for, if `calibration.hook = "solve"`.
    pub calibrate: SolverConfig,
    /// Which sums are accumulated.
    pub map: MapConfig,
    /// Capacity of the hold buffer for visibilities whose positions are unknown, bytes. An archive keeps its first value.
    pub wait_bytes: u64,
    /// Limit of the estimated memory for the sums, bytes; `None` for no limit.
    pub memory_max_bytes: Option<u64>,
    /// The channels to accumulate; `None` for all.
    pub group: Option<ChannelGroup>,
    /// The part of the sums to accumulate; `None` for the whole.
    pub part: Option<SumPart>,
}

impl GroundConfig {
    /// Checks that maps can be made with the data of an instrument, from its description.
    ///
    /// # Errors
    /// A calibration for another instrument; map settings that do not fit the instrument; files at other frequencies; too many channels for
    /// the memory.
    pub fn fits(&self, instrument: &Instrument) -> Result<(), GroundError> {
        if self.calibration.hook == CalibrationHook::Solve {
            let maps = self.calibrate.model_files.len();
            self.calibrate
                .check_instrument(instrument, maps, MODEL_FILES_KEY)
                .map_err(CalibrationError::from)?;
            check_frequencies(&self.calibrate.model_files, &instrument.frequencies_hz())
                .map_err(CalibrationError::from)?;
        }
        let described = self.described(instrument)?;
        self.map.check_priors(&described)?;
        let channels = described.channels.len();
        if let Some(misfit) = self.map.mismatches(channels).into_iter().next() {
            return Err(AccumulationError::from(misfit).into());
        }
        Ok(self.map.require_memory(channels, self.memory_max_bytes, self.group.as_ref())?)
    }

    /// The description of the instrument after calibration.
    ///
    /// # Errors
    /// A calibration for another instrument.
    pub fn described(&self, instrument: &Instrument) -> Result<Instrument, GroundError> {
        Ok(self.calibration.build(Path::new(""))?.describe(instrument)?)
    }

    /// The gate that holds visibilities until their gains are solved; `None` if gains are not solved for.
    pub(super) fn gate(&self) -> Result<Option<PassGate>, CalibrationError> {
        if self.calibration.hook != CalibrationHook::Solve {
            return Ok(None);
        }
        if let Some(problem) = self.calibrate.problems_of_hook().into_iter().next() {
            return Err(problem.into());
        }
        let (van_vleck, maps) = (self.calibration.van_vleck()?, self.calibrate.models()?);
        let solver = PassSolver::new(&self.calibrate, van_vleck, maps);
        Ok(Some(PassGate::new(solver, self.calibration.error_draws)))
    }

    /// A calibrator without data that posts to `ledger` and uses the gains of `gate`.
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
            .with_group(self.group.clone())
            .with_bursts(&FoundBursts::new(self.calibration.bursts)))
    }

    /// An accumulator without data that posts to `ledger`.
    pub(super) fn accumulator(&self, ledger: &Ledger<VisibilityReason>) -> Accumulator {
        Accumulator::new(self.map.clone(), ledger.clone())
            .with_memory_limit(self.memory_max_bytes)
            .with_group(self.group.clone())
            .with_part(self.part.clone())
    }
}
