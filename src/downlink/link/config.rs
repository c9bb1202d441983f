//! Configuration of a simulated link: what it does to a downlink.

use serde::{Deserialize, Serialize};

use crate::downlink::wire::Format;
use crate::units::{Checks, InvalidValue};

/// Maximum delay of a reordered frame, and maximum number of frames that a second station repeats.
const FRAMES_MAX: u64 = 1 << 20;

/// The `[downlink.link]` section: all faults are off by default.
///
/// "Frame" means a coded frame (CADU), or a packet if packets are sent plain.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LinkConfig {
    /// Probability that a bit is wrong.
    pub bit_error_rate: f64,
    /// Mean distance between bursts, bits; 0 for none. Bursts and the gaps between them are the states of a
    /// Gilbert-Elliott channel.
    pub burst_every_bits: f64,
    /// Mean length of bursts, bits.
    pub burst_bits: f64,
    /// Probability that a bit of a burst is wrong.
    pub burst_bit_error_rate: f64,
    /// Probability that a frame does not arrive.
    pub frame_loss: f64,
    /// Probability that a pass does not arrive.
    pub pass_loss: f64,
    /// Probability that a pass is truncated.
    pub pass_cut: f64,
    /// Probability that a frame arrives twice.
    pub duplicate: f64,
    /// Probability that a frame arrives late.
    pub reorder: f64,
    /// Maximum delay of a late frame, frames.
    pub reorder_frames: u64,
    /// Probability that a pass arrives after the one that follows it.
    pub pass_swap: f64,
    /// Probability that a bit is lost or added within a coded frame.
    pub bit_slip: f64,
    /// Frames at the end of each pass that a second station receives too, with faults of its own.
    pub second_station_frames: u64,
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            bit_error_rate: 0.0,
            burst_every_bits: 0.0,
            burst_bits: 0.0,
            burst_bit_error_rate: 0.5,
            frame_loss: 0.0,
            pass_loss: 0.0,
            pass_cut: 0.0,
            duplicate: 0.0,
            reorder: 0.0,
            reorder_frames: 16,
            pass_swap: 0.0,
            bit_slip: 0.0,
            second_station_frames: 0,
        }
    }
}

impl LinkConfig {
    /// Whether the link has any faults.
    #[must_use]
    #[doc(hidden)]
    pub fn is_on(&self) -> bool {
        let rates = [
            self.bit_error_rate,
            self.burst_every_bits,
            self.frame_loss,
            self.pass_loss,
            self.pass_cut,
            self.duplicate,
            self.reorder,
            self.pass_swap,
            self.bit_slip,
        ];
        self.second_station_frames > 0 || rates.iter().any(|rate| *rate != 0.0)
    }

    /// All values that are invalid for a format; empty for a valid configuration.
    #[must_use]
    #[doc(hidden)]
    pub fn problems(&self, format: Format) -> Vec<InvalidValue> {
        let mut checks = Checks::of("downlink.link");
        for (key, value) in [
            ("bit_error_rate", self.bit_error_rate),
            ("burst_bit_error_rate", self.burst_bit_error_rate),
            ("frame_loss", self.frame_loss),
            ("pass_loss", self.pass_loss),
            ("pass_cut", self.pass_cut),
            ("duplicate", self.duplicate),
            ("reorder", self.reorder),
            ("pass_swap", self.pass_swap),
            ("bit_slip", self.bit_slip),
        ] {
            checks.require(key, value, (0.0..=1.0).contains(&value), "a probability, 0 to 1");
        }
        let bursts = self.burst_every_bits;
        let good = bursts == 0.0 || (1.0..=1e15).contains(&bursts);
        checks.require("burst_every_bits", bursts, good, "0, or 1 to 1e15");
        let good = bursts == 0.0 || (1.0..=1e15).contains(&self.burst_bits);
        checks.require("burst_bits", self.burst_bits, good, "1 to 1e15 where there are bursts");
        let slips_are_possible = self.bit_slip == 0.0 || format == Format::Cadu;
        checks.require("bit_slip", self.bit_slip, slips_are_possible, "0 unless format is \"cadu\"");
        for (key, value) in
            [("reorder_frames", self.reorder_frames), ("second_station_frames", self.second_station_frames)]
        {
            checks.require(key, value, value <= FRAMES_MAX, "at most 1048576");
        }
        checks.finish()
    }
}
