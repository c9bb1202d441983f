//! Bit errors: a Gilbert-Elliott channel (Gilbert 1960, Elliott 1963).

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::config::LinkConfig;

/// Two states, each with a bit error rate and a geometrically distributed length; one state if there are no bursts.
#[derive(Debug)]
pub(super) struct Noise {
    random: ChaCha8Rng,
    /// Bit error rates between bursts and in them.
    rates: [f64; 2],
    /// Probability that a bit is the last of its state.
    ends: [f64; 2],
    in_burst: bool,
    /// Bits left in the current state.
    left: u64,
}

impl Noise {
    pub(super) fn new(config: &LinkConfig, mut random: ChaCha8Rng) -> Self {
        let bursts = config.burst_every_bits > 0.0;
        let ends = if bursts { [1.0 / config.burst_every_bits, 1.0 / config.burst_bits] } else { [0.0; 2] };
        let left = geometric(&mut random, ends[0]).saturating_add(1);
        let rates = [config.bit_error_rate, config.burst_bit_error_rate];
        Self { random, rates, ends, in_burst: false, left }
    }

    /// Flips bits, and reports their places.
    pub(super) fn apply(&mut self, bytes: &mut [u8], mut flipped: impl FnMut(usize)) {
        let (mut at, end) = (0, 8 * bytes.len() as u64);
        while at < end {
            let state = usize::from(self.in_burst);
            let until = end.min(at.saturating_add(self.left));
            self.left -= until - at;
            // The geometric distribution has no memory, so distances may be drawn afresh in each state.
            loop {
                at = at.saturating_add(geometric(&mut self.random, self.rates[state]));
                if at >= until {
                    break;
                }
                bytes[(at / 8) as usize] ^= 0x80 >> (at % 8);
                flipped(at as usize);
                at += 1;
            }
            at = until;
            if self.left == 0 {
                self.in_burst = !self.in_burst;
                let end = self.ends[usize::from(self.in_burst)];
                self.left = geometric(&mut self.random, end).saturating_add(1);
            }
        }
    }
}

/// Failures before the first success of independent trials.
fn geometric(random: &mut ChaCha8Rng, probability: f64) -> u64 {
    if probability <= 0.0 {
        return u64::MAX;
    }
    let open: f64 = 1.0 - random.random::<f64>();
    // A cast saturates at the largest integer, as for a tiny probability.
    (open.ln() / (-probability).ln_1p()) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::{StreamKind, random_stream};

    /// Places of the flipped bits in a number of bytes.
    fn flips(config: &LinkConfig, bytes: usize) -> Vec<usize> {
        let mut noise = Noise::new(config, random_stream(1, StreamKind::Link, [0, 0]));
        let mut found = Vec::new();
        for first in (0..bytes).step_by(1_000) {
            let mut part = [0; 1_000];
            noise.apply(&mut part, |bit| found.push(8 * first + bit));
            let wrong: u32 = part.iter().map(|octet| octet.count_ones()).sum();
            assert!(found.iter().filter(|bit| **bit >= 8 * first).count() == wrong as usize);
        }
        found
    }

    #[test]
    fn bits_are_wrong_at_the_rate_asked_for() {
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
    fn bursts_come_as_often_and_last_as_long_as_asked_for() {
        let config = LinkConfig {
            burst_every_bits: 20_000.0,
            burst_bits: 200.0,
            burst_bit_error_rate: 0.5,
            ..LinkConfig::default()
        };
        let found = flips(&config, 2_000_000);
        // Of 16e6 bits 200 in 20200 are in bursts, half of them wrong; about 800 bursts, each length spread as much
        // as it is long: 5 sqrt(2 / 800) = 0.25.
        let expected = 16e6 * 200.0 / 20_200.0 / 2.0;
        assert!((found.len() as f64 / expected - 1.0).abs() < 0.25, "{}", found.len());
        // Distances beyond 60 bits have a probability of 2^-60 in a burst and make bursts countable.
        let bursts = 1 + found.windows(2).filter(|pair| pair[1] - pair[0] > 60).count();
        assert!((bursts as f64 / (16e6 / 20_200.0) - 1.0).abs() < 5.0 / 792_f64.sqrt() + 0.02, "{bursts}");
    }
}
