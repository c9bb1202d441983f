//! Simulated noise of visibilities, for noise-only maps.

use num_complex::Complex64;
use rand_distr::{Distribution, StandardNormal};

use crate::frames::PlacedVisibilities;
use crate::units::{MissionTime, StreamKind, random_stream};

/// The identity that determines a visibility's noise: channel, sub-band, pair and time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::imaging) struct NoiseKey([u64; 2]);

impl NoiseKey {
    pub(in crate::imaging) fn new(placed: &PlacedVisibilities, k: usize) -> Self {
        let pair = u64::from(placed.pair.i) << 8 | u64::from(placed.pair.j);
        let source = u64::from(placed.channel.0) << 32 | u64::from(placed.band) << 16 | pair;
        Self([source, MissionTime::from_seconds(placed.time_s[k]).0 as u64])
    }
}

/// Standard normal noise of the real and imaginary part of a visibility.
pub(in crate::imaging) fn companion_noise(seed: u64, placed: &PlacedVisibilities, k: usize) -> Complex64 {
    unit_noise(seed, NoiseKey::new(placed, k))
}

/// Standard normal noise of the real and imaginary part of the visibility with this key.
pub(in crate::imaging) fn unit_noise(seed: u64, NoiseKey(identity): NoiseKey) -> Complex64 {
    let mut stream = random_stream(seed, StreamKind::CompanionNoise, identity);
    let mut normal = || -> f64 { StandardNormal.sample(&mut stream) };
    let re = normal();
    Complex64::new(re, normal())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::{ChannelId, Pair};

    #[test]
    fn sub_bands_of_a_channel_have_independent_noise() {
        const COUNT: usize = 4_000;
        let noise = |channel: u16, band: u16| {
            let placed = PlacedVisibilities {
                channel: ChannelId(channel),
                band,
                pair: Pair { i: 2, j: 5 },
                time_s: (0..COUNT).map(|k| k as f64).collect(),
                ..PlacedVisibilities::default()
            };
            (0..COUNT).map(|k| companion_noise(3, &placed, k)).collect::<Vec<_>>()
        };
        let noises: Vec<Vec<Complex64>> =
            [(0, 0), (0, 1), (0, 2), (0, 3), (1, 0)].map(|(c, b)| noise(c, b)).to_vec();
        for (first, one) in noises.iter().enumerate() {
            for (second, other) in noises.iter().enumerate().skip(first) {
                let product = one.iter().zip(other).map(|(a, b)| a * b.conj()).sum::<Complex64>();
                let mean = product / COUNT as f64;
                // <|z|^2> = 2 with variance 4; products of independent values have variance 2 in each part. Five standard errors.
                let expected = if first == second { 2.0 } else { 0.0 };
                assert!(
                    (mean - expected).norm() < 5.0 * (4.0 / COUNT as f64).sqrt(),
                    "{first} {second}: {mean}"
                );
            }
        }
    }
}
