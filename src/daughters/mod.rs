//! The daughters: sampling of 30 channels of 8 kHz, quantiser and clocks.
//!
//! Empty for now: the chain starts at integrated visibilities, in [`crate::mother`]. Sample streams will
//! come in here and be correlated there; everything downstream will not tell the difference.
