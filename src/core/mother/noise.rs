//! Thermal noise of integrated visibilities.

use rand_chacha::ChaCha8Rng;

use crate::frames::{AntennaResponse, ObservingWindow};
use crate::units::{ChannelId, Pair, StreamKind, random_stream};

/// Model of the thermal noise of integrated visibilities.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseModel {
    /// Seed of the noise; `None` for no noise. Weights are the same in both cases.
    pub seed: Option<u64>,
    /// Receiver noise of each channel, K sr: T_rec / zeta plus 1/f noise and the interference floor.
    pub receiver_noise_k_sr: Vec<f64>,
    /// Antenna response, which determines the number of receivers.
    pub response: AntennaResponse,
}

impl NoiseModel {
    /// Standard deviation of the real and of the imaginary part, K sr, for sky powers `Int T S A dn` at the two daughters:
    /// `sqrt(P_i P_j / (2 dnu dt))` with `P = T_rec / zeta + Int T S A dn` (the paper, Sect. 3.2, with each daughter's own
    /// system temperature).
    ///
    /// With three dipoles the visibility is half the sum over the dipoles. The sky's power in it is P, the receivers'
    /// 3/2 of one receiver's noise. If the three contribute equally, the variance is a third of that of one receiver
    /// with the same total power. Dipoles whose powers differ by 10 % would add 1 %, which is neglected.
    #[must_use]
    pub fn sigma_k_sr(&self, channel: ChannelId, powers_k_sr: [f64; 2], width_hz: f64, dt_s: f64) -> f64 {
        let receiver = self.receiver_k_sr(channel);
        let [p_i, p_j] = powers_k_sr.map(|power| receiver + power);
        (p_i * p_j / (2.0 * self.samples(width_hz, dt_s))).sqrt()
    }

    /// Number of independent samples of an integration in all receivers of a daughter.
    pub(super) fn samples(&self, width_hz: f64, dt_s: f64) -> f64 {
        f64::from(self.response.receivers()) * width_hz * dt_s
    }

    pub(super) fn receiver_k_sr(&self, channel: ChannelId) -> f64 {
        let per_receiver_k_sr = self.receiver_noise_k_sr.get(usize::from(channel.0)).copied().unwrap_or(0.0);
        match self.response.receivers() {
            1 => per_receiver_k_sr,
            receivers => 0.5 * f64::from(receivers) * per_receiver_k_sr,
        }
    }

    /// Random stream of the noise of a pair, or of an auto-correlation, in a channel and window.
    pub(super) fn stream(
        &self,
        window: ObservingWindow,
        channel: ChannelId,
        pair: Pair,
    ) -> Option<ChaCha8Rng> {
        let identity = u64::from(channel.0) << 32 | u64::from(pair.i) << 8 | u64::from(pair.j);
        let stream =
            |seed| random_stream(seed, StreamKind::VisibilityNoise, [identity, window.start.0 as u64]);
        self.seed.map(stream)
    }
}
