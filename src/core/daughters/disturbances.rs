//! Tones in the samples, and the response of a daughter with the errors of the instrument.

use std::f64::consts::TAU;

use num_complex::{Complex32, Complex64};
use rand::Rng;

use super::config::Tones;
use super::errors::PassErrors;
use super::synthesis::Response;
use crate::array::Array;
use crate::frames::Channel;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::dot;
use crate::units::{StreamKind, random_stream};

impl Tones {
    /// Whether any tone is added.
    #[must_use]
    #[doc(hidden)]
    pub fn are_on(&self) -> bool {
        self.interference_k_sr > 0.0 || self.calibration_k_sr > 0.0
    }

    /// Whether the section has its defaults, which are left out of a configuration's hash.
    pub(super) fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

impl Response {
    /// Response of a daughter in a channel (numbers from 0) at a time, with the errors of the instrument.
    pub(super) fn with_errors(
        pass: &PassErrors,
        (daughter, number): (usize, usize),
        channel: Channel,
        t_s: f64,
    ) -> Self {
        let turns = -channel.width_hz * pass.clock_s(daughter, t_s);
        Self { gain: pass.gain(daughter, number, t_s), turns }
    }
}

/// The tones in one block of samples of a daughter.
#[derive(Clone, Copy, Debug)]
pub(super) struct BlockTones<'a> {
    pub tones: &'a Tones,
    pub array: &'a Array,
    pub daughter: usize,
    pub channel: Channel,
    /// Time of the window's first sample, s.
    pub window_s: f64,
    /// Index of the block's first sample in the window.
    pub first: u64,
    /// Seed of the interference's phase.
    pub seed: u64,
    /// Errors of the instrument.
    pub pass: Option<&'a PassErrors>,
    /// Index of the channel.
    pub number: usize,
}

impl BlockTones<'_> {
    /// Adds the calibration tone and the Earth's interference. The daughter's gain and clock affect both.
    pub(super) fn add_to(&self, re: &mut [f32], im: &mut [f32]) {
        let d = self.tones;
        let t_s = self.window_s + self.first as f64 / self.channel.width_hz;
        let response = self.pass.map_or(Response::IDEAL, |pass| {
            Response::with_errors(pass, (self.daughter, self.number), self.channel, t_s)
        });
        let gain_at = |offset_hz: f64| {
            response.gain * Complex64::cis(TAU * response.turns * offset_hz / self.channel.width_hz)
        };
        if d.calibration_k_sr > 0.0 {
            let start = Complex64::from_polar(d.calibration_k_sr.sqrt(), d.calibration_phase_rad);
            let offset_hz = d.calibration_offset_hz;
            self.add(gain_at(offset_hz) * start, [offset_hz, 0.0], re, im);
        }
        if d.interference_k_sr > 0.0 {
            let depth_m = self.array.earth_depth_for_m(self.daughter, t_s).max(0.0);
            let power = d.interference_k_sr * (-depth_m / d.interference_depth_m).exp();
            // One phase per window, common to all daughters.
            let identity = [self.channel.frequency_hz.to_bits(), self.window_s.to_bits()];
            let mut rng = random_stream(self.seed, StreamKind::Interference, identity);
            let turns = f64::from(rng.next_u32()) / 2.0_f64.powi(32);
            let offset_hz = d.interference_offset_hz;
            let per_m = (self.channel.frequency_hz + offset_hz) / SPEED_OF_LIGHT_M_S;
            let along_m = |t_s| dot(self.array.earth_hat(t_s), self.array.position_m(self.daughter, t_s));
            // Motion advances the phase over the block, so that it is continuous with the next block.
            let length_s = re.len() as f64 / self.channel.width_hz;
            let moved_m = along_m(t_s + length_s) - along_m(t_s);
            let start = Complex64::from_polar(power.sqrt(), TAU * (turns - per_m * along_m(t_s)).fract());
            self.add(gain_at(offset_hz) * start, [offset_hz, per_m * moved_m / length_s], re, im);
        }
    }

    /// Adds a tone with phase `start` at the window's first sample. It has frequency `offset_hz` since then, and
    /// `shift_hz` more since the block's first sample.
    fn add(&self, start: Complex64, [offset_hz, shift_hz]: [f64; 2], re: &mut [f32], im: &mut [f32]) {
        let turns = offset_hz / self.channel.width_hz;
        let from = Complex64::cis(-TAU * (turns * self.first as f64).fract());
        let step = Complex64::cis(-TAU * (turns + shift_hz / self.channel.width_hz));
        let mut value = start * from;
        for (re, im) in re.iter_mut().zip(im) {
            let tone = Complex32::new(value.re as f32, value.im as f32);
            *re += tone.re;
            *im += tone.im;
            value *= step;
        }
    }
}
