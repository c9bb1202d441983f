//! The mother's correlator: eight streams of samples to integrated visibilities.
//!
//! Blocks of the same number are brought together ([`Aligner`]), delayed and divided into sub-bands if that is asked for
//! ([`Division`]); all products of daughters are summed over
//! dumps of a few milliseconds ([`kernel`]); dumps are summed for as long as each baseline's motion allows
//! ([`GroupIntegrator`]). [`Correlator`] is the stage.

mod align;
mod autos;
mod integers;
mod integrate;
pub mod kernel;
mod spectra;
mod stage;

pub use align::{Aligner, AlignerCounts, BlockRow, StreamShape};
pub use integrate::{DumpRule, GroupIntegrator, Presence, dump_samples, shortest_integration_s};
pub use spectra::{Division, SUB_BANDS_MAX};
pub use stage::{Correlator, CorrelatorCounts, CorrelatorSetup};
