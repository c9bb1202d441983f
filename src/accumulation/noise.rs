//! Noise drawn on the ground, for a map of noise alone.

use num_complex::Complex64;
use rand_distr::{Distribution, StandardNormal};

use crate::frames::PlacedVisibilities;
use crate::units::{MissionTime, StreamKind, random_stream};

/// Unit normal noise of a visibility's real and imaginary part; it depends on channel, pair and time alone.
pub(super) fn companion_noise(seed: u64, placed: &PlacedVisibilities, k: usize) -> Complex64 {
    let pair = u64::from(placed.pair.i) << 8 | u64::from(placed.pair.j);
    let identity =
        [u64::from(placed.channel.0) << 32 | pair, MissionTime::from_seconds(placed.time_s[k]).0 as u64];
    let mut stream = random_stream(seed, StreamKind::CompanionNoise, identity);
    let mut draw = || -> f64 { StandardNormal.sample(&mut stream) };
    let re = draw();
    Complex64::new(re, draw())
}
