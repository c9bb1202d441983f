//! Calibration: from received visibilities to placed, corrected and weighted ones.
//!
//! The [`Calibrator`] gives visibilities their positions and applies corrections in order: [`VanVleck`] undoes the effect
//! of coarse quantisers on correlations; a [`Calibration`] turns them into what ideal antennas would have measured
//! ([`Identity`] changes nothing, [`AntennaGains`] divides by complex gains from a file, and corrects positions); [`SubBands`] combines sub-bands
//! of a channel. [`CalibrationConfig`] chooses. The [`solver`] finds the gains of such a file from the data;
//! [`SolvedGains`] are those that a ground finds while the data arrive.
//!
//! Uses [`crate::frames`] and [`crate::array`]. Every block is used once; every visibility that is left out is in the
//! ledger with its reason.

mod autos;
mod blocks;
mod config;
mod error;
mod gains;
mod gains_file;
mod solved;
pub mod solver;
mod stage;
mod sub_bands;
mod van_vleck;

pub use autos::{AUTOS_MAX, AutoTable};
pub use blocks::{BlockKey, Completeness, MissingPackets, ReceivedBlocks};
pub use config::{CalibrationConfig, CalibrationHook};
pub use error::CalibrationError;
pub use gains::AntennaGains;
pub use gains_file::{ChannelGains, GainSolution, GainsFile, Interpolation, PositionSolution};
pub use solved::{ClosedPass, SolvedGains};
pub use stage::Calibrator;
pub use sub_bands::SubBands;
pub use van_vleck::{QuantiserBitsError, VanVleck};

use crate::frames::{Instrument, PlacedVisibilities, VisibilityReason};

/// Corrects visibilities in place.
pub trait Calibration: Send {
    /// Name as in the configuration.
    fn name(&self) -> &'static str;

    /// Takes the description of the instrument; returns the description after calibration.
    ///
    /// # Errors
    /// [`CalibrationError`] if the calibration was not made for this instrument.
    fn describe(&mut self, instrument: &Instrument) -> Result<Instrument, CalibrationError> {
        Ok(instrument.clone())
    }

    /// Corrects values and weights of a block, and removes what cannot be corrected. Keeps the order and the equal
    /// lengths of the arrays.
    ///
    /// # Errors
    /// [`CalibrationError`] if the calibration was not made for this block. Bad data is not an error but counted in the
    /// report.
    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError>;

    /// Whether it leaves every block as it is.
    fn is_identity(&self) -> bool {
        false
    }
}

/// What became of the visibilities of a block.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct CalibrationReport {
    /// Corrected, or good as they were.
    pub kept: usize,
    /// Removed: a gain is zero, not finite, or so small or large that nothing is left.
    pub unusable_gain: usize,
}

impl CalibrationReport {
    /// Reason and number of those removed, for a ledger; zeros included.
    #[must_use]
    pub fn removed(&self) -> [(VisibilityReason, usize); 1] {
        [(VisibilityReason::UnusableGain, self.unusable_gain)]
    }
}

/// Changes nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Identity;

impl Calibration for Identity {
    fn name(&self) -> &'static str {
        "identity"
    }

    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError> {
        Ok(CalibrationReport { kept: block.len(), unusable_gain: 0 })
    }

    fn is_identity(&self) -> bool {
        true
    }
}
