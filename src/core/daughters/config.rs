//! Configuration of sampling, of the daughters' faults and of their links to the mother.

use serde::{Deserialize, Serialize};

use crate::units::{Checks, InvalidValue, keys};

/// Number of bits that denotes samples without quantisation.
pub const FLOAT_BITS: u32 = 32;

keys! {
    /// The `[daughters]` section; used by sample fidelity alone.
    pub struct DaughtersConfig {
        /// Bits of the real and of the imaginary part: 1, 2, 4, 8, or 32 for floats.
        everyday bits: u32 = 8;
        /// Time constant of the automatic level control.
        expert level_time_constant_s: f64 = 10.0;
        /// Samples in a block: a power of two from 256 to 65536.
        expert block_samples: usize = 1024;
        /// Maximum rate of a daughter's link to the mother; 0 for no limit.
        expert link_bits_per_s_max: f64 = 0.0;
        /// Buffer before a daughter's link.
        expert link_buffer_bytes: u64 = 16 << 20;
        /// What a full buffer drops: the "newest" or the "oldest" block.
        expert link_drop: DropPolicy = DropPolicy::Newest;
        /// Tones added to the samples: interference from the Earth, and a calibration signal.
        #[serde(skip_serializing_if = "Tones::is_none")]
        section tones: Tones = Tones::default();
    }
}

/// What a full buffer drops.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DropPolicy {
    /// The newest block.
    #[default]
    Newest,
    /// The oldest blocks.
    Oldest,
}

keys! {
    /// Tones that are added to samples. Errors of gains, phases and clocks are in `[instrument]`.
    pub struct Tones {
        /// Power of narrow-band leakage from the Earth at the limb.
        expert interference_k_sr: f64 = 0.0;
        /// Frequency of the leakage, from the channel's centre.
        expert interference_offset_hz: f64 = 0.0;
        /// Depth behind the limb over which the leakage falls by a factor e.
        expert interference_depth_m: f64 = 0.0;
        /// Power of the calibration tone, equal and in phase at all daughters.
        expert calibration_k_sr: f64 = 0.0;
        /// Frequency of the calibration tone, from the channel's centre.
        expert calibration_offset_hz: f64 = 0.0;
        /// Phase of the calibration tone at the start of a window.
        expert calibration_phase_rad: f64 = 0.0;
    }
}

impl DaughtersConfig {
    /// All invalid values for channels of a width; empty if there are none.
    #[must_use]
    pub fn problems(&self, channel_width_hz: f64) -> Vec<InvalidValue> {
        let mut checks = Checks::new("daughters");
        let bits = f64::from(self.bits);
        checks.number("bits", bits, [1, 2, 4, 8, FLOAT_BITS].contains(&self.bits), "1, 2, 4, 8 or 32");
        let level = self.level_time_constant_s;
        checks.number("level_time_constant_s", level, (1e-3..=1e6).contains(&level), "0.001 s to 1e6 s");
        let block = self.block_samples;
        let is_accepted = block.is_power_of_two() && (256..=65_536).contains(&block);
        checks.number("block_samples", block as f64, is_accepted, "a power of two from 256 to 65536");
        let rate = self.link_bits_per_s_max;
        checks.number("link_bits_per_s_max", rate, rate >= 0.0, "bit/s, or 0 for no limit");
        let buffer = self.link_buffer_bytes;
        let is_accepted = (4096..=1 << 32).contains(&buffer);
        checks.number("link_buffer_bytes", buffer as f64, is_accepted, "4096 bytes to 4 GiB");
        let d = &self.tones;
        for (key, power) in
            [("tones.interference_k_sr", d.interference_k_sr), ("tones.calibration_k_sr", d.calibration_k_sr)]
        {
            checks.number(key, power, power >= 0.0, "K sr, not negative");
        }
        let depth = d.interference_depth_m;
        let good = depth > 0.0 || d.interference_k_sr == 0.0;
        checks.number("tones.interference_depth_m", depth, good, "a positive length, m");
        for (key, offset_hz) in [
            ("tones.interference_offset_hz", d.interference_offset_hz),
            ("tones.calibration_offset_hz", d.calibration_offset_hz),
        ] {
            let is_in_channel = offset_hz.abs() <= 0.5 * channel_width_hz;
            checks.number(
                key,
                offset_hz,
                is_in_channel,
                "at most half of spacecraft.channel_width_hz either way",
            );
        }
        let phase_rad = d.calibration_phase_rad;
        checks.number("tones.calibration_phase_rad", phase_rad, true, "a finite number");
        checks.finish()
    }

    /// Data rate of the samples of all daughters, bit/s: daughters x channels x width x 2 x bits.
    #[must_use]
    pub fn rate_bits_per_s(&self, satellites: usize, channels: usize, width_hz: f64) -> f64 {
        (satellites * channels) as f64 * width_hz * 2.0 * f64::from(self.bits)
    }
}
