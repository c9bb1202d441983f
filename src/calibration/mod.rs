//! The place of calibration: between decoding and accumulation.
//!
//! A [`Calibration`] turns measured visibilities into what ideal antennas would have measured, and
//! gives each the weight that is left to it. [`Identity`] does nothing; [`AntennaGains`] divides by
//! complex gains from a file. [`CalibrationConfig`] chooses. Before either, [`VanVleck`] takes out what
//! quantisers of few bits do to correlations; after it, [`SubBands`] brings sub-bands of a channel together.

mod autos;
mod blocks;
mod config;
mod error;
mod gains;
mod gains_file;
mod stage;
mod sub_bands;
mod van_vleck;

pub use autos::{AUTOS_MAX, AutoTable};
pub use blocks::{BlockKey, ReceivedBlocks};
pub use config::{CalibrationConfig, CalibrationHook};
pub use error::CalibrationError;
pub use gains::AntennaGains;
pub use gains_file::{ChannelGains, GainSolution, GainsFile, Interpolation};
pub use stage::{Calibrator, DUPLICATE};
pub use sub_bands::SubBands;
pub use van_vleck::{QuantiserBitsError, VanVleck};

use crate::frames::{Instrument, PlacedVisibilities};

/// Corrects visibilities in place.
pub trait Calibration: Send {
    /// Name as in the configuration.
    fn name(&self) -> &'static str;

    /// Hears of the instrument that measured what will come, and says what it looks like afterwards.
    ///
    /// # Errors
    /// [`CalibrationError`] if it is none that this calibration was made for.
    fn describe(&mut self, instrument: &Instrument) -> Result<Instrument, CalibrationError> {
        Ok(instrument.clone())
    }

    /// Corrects values and weights of a block, and takes out what cannot be corrected; order and
    /// equal lengths of the arrays are kept.
    ///
    /// # Errors
    /// [`CalibrationError`] if the block is none that this calibration was made for. Bad data is not
    /// an error but counted in the report.
    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError>;
}

/// What became of the visibilities of a block.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct CalibrationReport {
    /// Corrected, or good as they were.
    pub kept: usize,
    /// Taken out: a gain is zero, not finite, or so small or large that nothing is left.
    pub unusable_gain: usize,
}

impl CalibrationReport {
    /// Reason and number of those taken out, for a ledger; zeros included.
    #[must_use]
    pub fn removed(&self) -> [(&'static str, usize); 1] {
        [("unusable gain", self.unusable_gain)]
    }
}

/// Leaves everything as it is.
#[derive(Clone, Copy, Debug, Default)]
pub struct Identity;

impl Calibration for Identity {
    fn name(&self) -> &'static str {
        "identity"
    }

    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError> {
        Ok(CalibrationReport { kept: block.len(), unusable_gain: 0 })
    }
}
