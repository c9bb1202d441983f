//! Bit errors of a Gilbert-Elliott channel (Gilbert 1960, Elliott 1963).

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::downlink::config::LinkConfig;

/// Gilbert-Elliott channel: two states, each with a bit error rate and a geometrically distributed length. Without bursts,
/// there is one state.
#[derive(Debug)]
pub(super) struct BitErrors {
    random: ChaCha8Rng,
    /// Bit error rates between bursts and within them.
    error_rates: [f64; 2],
    /// Probabilities that a bit is the last of its state.
    end_probabilities: [f64; 2],
    in_burst: bool,
    /// Number of bits until the state changes.
    bits_left: u64,
}

impl BitErrors {
    pub(super) fn new(config: &LinkConfig, mut random: ChaCha8Rng) -> Self {
        let has_bursts = config.burst_every_bits > 0.0;
        let end_probabilities =
            if has_bursts { [1.0 / config.burst_every_bits, 1.0 / config.burst_bits] } else { [0.0; 2] };
        let bits_left = geometric(&mut random, end_probabilities[0]).saturating_add(1);
        let error_rates = [config.bit_error_rate, config.burst_bit_error_rate];
        Self { random, error_rates, end_probabilities, in_burst: false, bits_left }
    }

    /// Flips bits, and calls `report` with their indices.
    pub(super) fn apply(&mut self, bytes: &mut [u8], mut report: impl FnMut(usize)) {
        let (mut at, end) = (0, 8 * bytes.len() as u64);
        while at < end {
            let state = usize::from(self.in_burst);
            let until = end.min(at.saturating_add(self.bits_left));
            self.bits_left -= until - at;
            // The geometric distribution is memoryless, so each state may begin with a new distance.
            loop {
                at = at.saturating_add(geometric(&mut self.random, self.error_rates[state]));
                if at >= until {
                    break;
                }
                bytes[(at / 8) as usize] ^= 0x80 >> (at % 8);
                report(at as usize);
                at += 1;
            }
            at = until;
            if self.bits_left == 0 {
                self.in_burst = !self.in_burst;
                let end = self.end_probabilities[usize::from(self.in_burst)];
                self.bits_left = geometric(&mut self.random, end).saturating_add(1);
            }
        }
    }
}

/// Draws the number of failures before the first success of independent trials.
fn geometric(random: &mut ChaCha8Rng, probability: f64) -> u64 {
    if probability <= 0.0 {
        return u64::MAX;
    }
    // In (0, 1], so that the logarithm is finite.
    let uniform: f64 = 1.0 - random.random::<f64>();
    // The cast saturates for a tiny probability.
    (uniform.ln() / (-probability).ln_1p()) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::{StreamKind, random_stream};

    /// Indices of the flipped bits in a number of bytes.
    fn flips(config: &LinkConfig, bytes: usize) -> Vec<usize> {
        let mut bit_errors = BitErrors::new(config, random_stream(1, StreamKind::Link, [0, 0]));
        let mut found = Vec::new();
        for first in (0..bytes).step_by(1_000) {
            let mut part = [0; 1_000];
            bit_errors.apply(&mut part, |bit| found.push(8 * first + bit));
            let wrong: u32 = part.iter().map(|octet| octet.count_ones()).sum();
            assert!(found.iter().filter(|bit| **bit >= 8 * first).count() == wrong as usize);
        }
        found
    }

    #[test]
    fn bits_are_wrong_at_the_configured_rate() {
        for rate in [1e-4, 3e-3, 0.2] {
            let config = LinkConfig { bit_error_rate: rate, ..LinkConfig::default() };
            let (found, bits) = (flips(&config, 1_000_000).len() as f64, 8e6);
            // Five standard deviations of a binomial distribution.
            assert!((found - rate * bits).abs() < 5.0 * (rate * bits).sqrt(), "{rate}: {found}");
        }
        assert!(flips(&LinkConfig::default(), 1_000_000).is_empty());
        let all = LinkConfig { bit_error_rate: 1.0, ..LinkConfig::default() };
        assert_eq!(flips(&all, 1_000).len(), 8_000);
    }

    #[test]
    fn bursts_have_the_configured_distance_and_length() {
        let config = LinkConfig {
            burst_every_bits: 20_000.0,
            burst_bits: 200.0,
            burst_bit_error_rate: 0.5,
            ..LinkConfig::default()
        };
        let found = flips(&config, 2_000_000);
        // Of 16e6 bits, 200 in 20200 are in bursts and half of those are wrong. There are about 800 bursts; the standard
        // deviation of their lengths equals the mean: 5 sqrt(2 / 800) = 0.25.
        let expected = 16e6 * 200.0 / 20_200.0 / 2.0;
        assert!((found.len() as f64 / expected - 1.0).abs() < 0.25, "{}", found.len());
        // Within a burst a distance above 60 bits has a probability of 2^-60, so it separates bursts.
        let bursts = 1 + found.windows(2).filter(|pair| pair[1] - pair[0] > 60).count();
        assert!((bursts as f64 / (16e6 / 20_200.0) - 1.0).abs() < 5.0 / 792_f64.sqrt() + 0.02, "{bursts}");
    }
}
