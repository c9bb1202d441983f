//! The mother's correlator: sample streams of all daughters in, integrated visibilities out.
//!
//! [`Correlator`] is the stage. It aligns blocks of the same number (`align`), applies delays and divides channels into
//! sub-bands if configured ([`Division`], `spectra`), sums the products of all pairs over dumps of a few milliseconds
//! ([`kernel`], and `integers` for quantised samples), and sums dumps for as long as the motion of each baseline allows
//! (`integrate`; `autos` for auto-correlations).

mod align;
mod autos;
mod integers;
mod integrate;
pub mod kernel;
mod lanes;
mod spectra;
mod stage;

pub use align::AlignerCounts;
pub(super) use integrate::{dump_samples, shortest_integration_s};
pub use spectra::Division;
pub(super) use spectra::SUB_BANDS_MAX;
pub use stage::{Correlator, CorrelatorCounts, CorrelatorSetup};
