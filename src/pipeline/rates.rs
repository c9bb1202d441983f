//! Rates of one core of the simulation, measured once, from which times are estimated: of the machine that `imaging/rates.rs` names.

/// Fringes of direct sums in a second (bench `response`).
pub(super) const FRINGES_PER_S: f64 = 7.2e8;

/// Samples of one daughter and channel that are drawn, quantised, sent and correlated in a second, with eight daughters
/// (`lunarray bench`: 30 channels of 8 kHz at 23 times real time).
pub(super) const SAMPLES_PER_S: f64 = 2.2e7;
