//! Instrument errors of one pair in one channel and pass.

use num_complex::Complex64;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::array::Array;
use crate::daughters::{InstrumentErrors, PassErrors};
use crate::frames::ObservingWindow;
use crate::response::beacon::plane_wave;
use crate::units::Pair;
use crate::units::vector::sub;

/// Instrument errors of a pair in a channel and pass.
pub(super) struct PairErrors<'a> {
    pub(super) errors: &'a InstrumentErrors,
    pub(super) pass: &'a PassErrors,
    pub(super) array: &'a Array,
    pub(super) window: ObservingWindow,
    pub(super) pair: Pair,
    /// Index of the channel.
    pub(super) channel: usize,
    pub(super) frequency_hz: f64,
    pub(super) outliers: Option<ChaCha8Rng>,
}

/// Artificial signals of a pair: beacon, and interference from the Earth.
#[derive(Clone, Copy)]
pub(super) struct ArtificialSignals {
    /// Power at each daughter.
    pub(super) powers_k_sr: [f64; 2],
    pub(super) visibility_k_sr: Complex64,
}

impl PairErrors<'_> {
    /// Beacon and interference at a time.
    pub(super) fn artificial_signals(&self, t_s: f64) -> ArtificialSignals {
        let Self { array, pair, frequency_hz, .. } = *self;
        let beacon =
            if self.beacon_is_on(t_s) { self.errors.config().beacon.signal() } else { Default::default() };
        let burst_k_sr = self.errors.burst_k_sr(t_s);
        let leaks_k_sr = [pair.i, pair.j].map(|n| self.errors.leak_k_sr(array, n.into(), t_s));
        if !beacon.is_on() && burst_k_sr == 0.0 && leaks_k_sr == [0.0; 2] {
            return ArtificialSignals { powers_k_sr: [0.0; 2], visibility_k_sr: Complex64::ZERO };
        }
        let [r_i_m, r_j_m] = [pair.i, pair.j].map(|n| array.position_m(n.into(), t_s));
        let earth_k_sr = burst_k_sr + (leaks_k_sr[0] * leaks_k_sr[1]).sqrt();
        let earth = plane_wave(earth_k_sr, array.earth_hat(t_s), sub(r_i_m, r_j_m), frequency_hz);
        let beacon_k_sr = beacon.visibility_k_sr(r_i_m, r_j_m, frequency_hz);
        let powers_k_sr = leaks_k_sr.map(|leak_k_sr| beacon.k_sr + burst_k_sr + leak_k_sr);
        ArtificialSignals { powers_k_sr, visibility_k_sr: beacon_k_sr + earth }
    }

    /// Product of the gains of the pair at a time.
    pub(super) fn gain(&self, t_s: f64) -> Complex64 {
        let [g_i, g_j] = [self.pair.i, self.pair.j].map(|n| self.pass.gain(n.into(), self.channel, t_s));
        g_i * g_j.conj()
    }

    /// Whether a receiver of the pair is dead.
    pub(super) fn is_dead(&self) -> bool {
        [self.pair.i, self.pair.j].into_iter().any(|n| self.pass.is_dead(n.into(), self.channel))
    }

    /// Whether the beacon is on at a time.
    pub(super) fn beacon_is_on(&self, t_s: f64) -> bool {
        self.errors.config().beacon.is_on(t_s - self.window.start.seconds())
    }

    /// Outlier to be added to the next visibility, in units of its noise; zero for most.
    pub(super) fn outlier(&mut self) -> Complex64 {
        let config = self.errors.config();
        let Some(stream) = &mut self.outliers else { return Complex64::ZERO };
        let chance = f64::from(stream.next_u32()) / 2.0_f64.powi(32);
        if chance >= config.outlier_probability {
            return Complex64::ZERO;
        }
        let [re, im]: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut *stream));
        config.outlier_sigma * Complex64::new(re, im)
    }
}
