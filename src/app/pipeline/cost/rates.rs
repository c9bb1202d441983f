//! Rates of the simulation per core, measured on the machine that `imaging/rates.rs` names.

/// Fringes of direct sums per second (bench `response`).
pub(in crate::pipeline) const FRINGES_PER_S: f64 = 7.2e8;

/// Samples drawn, quantised, sent and correlated per second, counted per daughter and channel, with eight daughters (`lunarray
/// bench`: 30 channels of 8 kHz at 23 times real time).
pub(in crate::pipeline) const SAMPLES_PER_S: f64 = 2.2e7;
