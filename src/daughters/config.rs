//! Configuration of sampling, of the daughters' faults and of their links to the mother.

use serde::{Deserialize, Serialize};

use crate::units::{Checks, InvalidValue};

/// Bits that stand for samples that are not quantised.
pub const FLOAT_BITS: u32 = 32;

/// The `[daughters]` section; used by sample fidelity alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DaughtersConfig {
    /// Bits of the real and of the imaginary part: 1, 2, 4, 8, or 32 for floats.
    pub bits: u32,
    /// Time constant of the automatic level control, s.
    pub level_time_constant_s: f64,
    /// Samples in a block.
    pub block_samples: usize,
    /// Greatest rate of the link from one daughter to the mother, bit/s; 0 for no limit.
    pub link_bits_per_s_max: f64,
    /// Buffer of one daughter before its link, bytes.
    pub link_buffer_bytes: u64,
    /// What is dropped when the buffer is full.
    pub link_drop: DropPolicy,
    /// Faults and artificial signals; none by default.
    pub disturbances: Disturbances,
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

/// Faults and artificial signals. Lists have one value a daughter, or are empty for no such fault.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Disturbances {
    /// Amplitude gain less one.
    pub gain_error: Vec<f64>,
    /// Its drift, 1/s since the epoch.
    pub gain_drift_per_s: Vec<f64>,
    /// Phase, rad.
    pub phase_rad: Vec<f64>,
    /// Its drift, rad/s since the epoch.
    pub phase_drift_rad_per_s: Vec<f64>,
    /// Clock offset, s; positive if samples are late.
    pub clock_offset_s: Vec<f64>,
    /// Its drift, s/s since the epoch.
    pub clock_drift: Vec<f64>,
    /// Power of narrow-band leakage from the Earth at the limb, K sr; 0 for none.
    pub interference_k_sr: f64,
    /// Its frequency, Hz from the channel's centre.
    pub interference_offset_hz: f64,
    /// Depth behind the limb over which its power falls by a factor e, m.
    pub interference_depth_m: f64,
    /// Power of the calibration tone, K sr, equal and in phase at all daughters; 0 for none.
    pub calibration_k_sr: f64,
    /// Its frequency, Hz from the channel's centre.
    pub calibration_offset_hz: f64,
    /// Its phase at the start of a window, rad.
    pub calibration_phase_rad: f64,
}

impl Default for DaughtersConfig {
    fn default() -> Self {
        Self {
            bits: 8,
            level_time_constant_s: 10.0,
            block_samples: 1024,
            link_bits_per_s_max: 0.0,
            link_buffer_bytes: 16 << 20,
            link_drop: DropPolicy::Newest,
            disturbances: Disturbances::default(),
        }
    }
}

impl DaughtersConfig {
    /// Everything that is wrong with the section for an array of `satellites` and channels of a width; empty if it is
    /// good.
    #[must_use]
    pub fn problems(&self, satellites: usize, channel_width_hz: f64) -> Vec<InvalidValue> {
        let mut checks = Checks::of("daughters");
        let bits = f64::from(self.bits);
        checks.number("bits", bits, [1, 2, 4, 8, FLOAT_BITS].contains(&self.bits), "1, 2, 4, 8 or 32");
        let level = self.level_time_constant_s;
        checks.number("level_time_constant_s", level, (1e-3..=1e6).contains(&level), "0.001 s to 1e6 s");
        let block = self.block_samples;
        let fits = block.is_power_of_two() && (256..=65_536).contains(&block);
        checks.number("block_samples", block as f64, fits, "a power of two from 256 to 65536");
        let rate = self.link_bits_per_s_max;
        checks.number("link_bits_per_s_max", rate, rate >= 0.0, "bit/s, or 0 for no limit");
        let buffer = self.link_buffer_bytes;
        let fits = (4096..=1 << 32).contains(&buffer);
        checks.number("link_buffer_bytes", buffer as f64, fits, "4096 bytes to 4 GiB");
        let d = &self.disturbances;
        for (key, list) in [
            ("disturbances.gain_error", &d.gain_error),
            ("disturbances.gain_drift_per_s", &d.gain_drift_per_s),
            ("disturbances.phase_rad", &d.phase_rad),
            ("disturbances.phase_drift_rad_per_s", &d.phase_drift_rad_per_s),
            ("disturbances.clock_offset_s", &d.clock_offset_s),
            ("disturbances.clock_drift", &d.clock_drift),
        ] {
            let count = list.len();
            checks.number(key, count as f64, count == 0 || count == satellites, "no value or one a daughter");
            checks.numbers(key, list, |_| true, "finite numbers");
        }
        for (key, power) in [
            ("disturbances.interference_k_sr", d.interference_k_sr),
            ("disturbances.calibration_k_sr", d.calibration_k_sr),
        ] {
            checks.number(key, power, power >= 0.0, "K sr, not negative");
        }
        let depth = d.interference_depth_m;
        let good = depth > 0.0 || d.interference_k_sr == 0.0;
        checks.number("disturbances.interference_depth_m", depth, good, "a positive length, m");
        for (key, offset_hz) in [
            ("disturbances.interference_offset_hz", d.interference_offset_hz),
            ("disturbances.calibration_offset_hz", d.calibration_offset_hz),
        ] {
            let inside = offset_hz.abs() <= 0.5 * channel_width_hz;
            checks.number(key, offset_hz, inside, "at most half of spacecraft.channel_width_hz either way");
        }
        let phase_rad = d.calibration_phase_rad;
        checks.number("disturbances.calibration_phase_rad", phase_rad, true, "a finite number");
        checks.finish()
    }

    /// Rate that the samples of all daughters need, bit/s: daughters x channels x width x 2 x bits.
    #[must_use]
    pub fn rate_bits_per_s(&self, satellites: usize, channels: usize, width_hz: f64) -> f64 {
        (satellites * channels) as f64 * width_hz * 2.0 * f64::from(self.bits)
    }
}
