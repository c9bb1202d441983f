//! Calibration: from received visibilities to placed, corrected and weighted ones.
//!
//! The [`Calibrator`] gives visibilities their positions and applies corrections in order: [`VanVleck`] undoes the
//! effect of coarse quantisers on correlations; a [`Calibration`] turns them into what ideal antennas would have
//! measured ([`Identity`] changes nothing, [`AntennaGains`] divides by complex gains from a file and corrects
//! positions); [`SubBands`] combines sub-bands of a channel. [`CalibrationConfig`] selects the corrections. The
//! [`solver`] finds gains from the data; [`SolvedGains`] holds those that a ground station finds while data arrive.
//!
//! Each block is used once. Each visibility left out is in the ledger with its reason.

mod autos;
mod blocks;
mod bursts;
mod config;
mod error;
mod gain_errors;
mod gains;
mod gains_file;
mod solved;
#[doc(hidden)]
pub mod solver;
mod stage;
mod sub_bands;
mod van_vleck;

#[doc(hidden)]
pub use autos::{AUTOS_MAX, AutoTable};
#[doc(hidden)]
pub use blocks::{BlockKey, Completeness, MissingPackets, ReceivedBlocks};
#[doc(hidden)]
pub use bursts::{
    BurstAlert, BurstChoice, BurstEvent, BurstSearch, BurstSummary, ChannelCurve, DividedBlock, FluxPoint,
    FoundBurst, FoundBursts, LightCurve, PassAlerts, PassCounts, SearchedChannel, SearchedPasses,
    find_alerts, find_bursts, find_events,
};
#[doc(hidden)]
pub use config::{CalibrationConfig, CalibrationHook};
pub use error::CalibrationError;
#[doc(hidden)]
pub use gains::AntennaGains;
#[doc(hidden)]
pub use gains_file::{ChannelGains, GainErrors, GainSolution, GainsFile, Interpolation, PositionSolution};
#[doc(hidden)]
pub use solved::{ClosedPass, SolvedGains};
#[doc(hidden)]
pub use solver::CORRELATED_MAX;
pub use stage::Calibrator;
#[doc(hidden)]
pub use sub_bands::SubBands;
#[doc(hidden)]
pub use van_vleck::{QuantiserBitsError, VanVleck};

use crate::frames::{Instrument, PlacedVisibilities, VisibilityReason};

/// Corrects visibilities in place.
///
/// ```
/// use lunarray::prelude::*;
///
/// /// Divides by a gain that all satellites share.
/// struct CommonGain(f64);
///
/// impl Calibration for CommonGain {
///     fn name(&self) -> &'static str {
///         "common gain"
///     }
///
///     fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError> {
///         for (value, weight) in block.value_k_sr.iter_mut().zip(&mut block.weight) {
///             *value /= self.0;
///             *weight *= self.0 * self.0;
///         }
///         Ok(CalibrationReport { kept: block.len(), unusable_gain: 0 })
///     }
/// }
///
/// let mut block = PlacedVisibilities {
///     time_s: vec![0.0],
///     r_i_m: vec![[2e6, 0.0, 0.0]],
///     r_j_m: vec![[2e6, 100.0, 0.0]],
///     value_k_sr: vec![8.0.into()],
///     weight: vec![1.0],
///     ..PlacedVisibilities::default()
/// };
/// CommonGain(4.0).apply(&mut block)?;
/// assert_eq!((block.value_k_sr[0].re, block.weight[0]), (2.0, 16.0));
/// # Ok::<(), CalibrationError>(())
/// ```
///
/// A [`Calibrator`] passes every block of a downlink through it, once positions are known.
pub trait Calibration: Send {
    /// Name as in the configuration.
    fn name(&self) -> &'static str;

    /// Accepts the description of the instrument, and returns the description after calibration.
    ///
    /// # Errors
    /// [`CalibrationError`] if the calibration was not made for this instrument.
    fn describe(&mut self, instrument: &Instrument) -> Result<Instrument, CalibrationError> {
        Ok(instrument.clone())
    }

    /// Corrects values and weights of a block, and removes visibilities that cannot be corrected. Keeps the order and
    /// the equal lengths of the arrays.
    ///
    /// # Errors
    /// [`CalibrationError`] if the calibration was not made for this block. Bad data are no error: the report counts
    /// them.
    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError>;

    /// Whether the calibration changes no block.
    fn is_identity(&self) -> bool {
        false
    }
}

/// Number of visibilities of a block that were kept and removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[must_use]
pub struct CalibrationReport {
    /// Visibilities kept, corrected or unchanged.
    pub kept: usize,
    /// Visibilities removed, because a gain is zero, not finite, or so small or large that no digits are left.
    pub unusable_gain: usize,
}

impl CalibrationReport {
    /// Reason and number of removed visibilities, zeros included, for a ledger.
    #[must_use]
    #[doc(hidden)]
    pub fn removed(&self) -> [(VisibilityReason, usize); 1] {
        [(VisibilityReason::UnusableGain, self.unusable_gain)]
    }
}

/// Calibration that changes nothing.
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
