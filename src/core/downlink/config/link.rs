//! Configuration of a simulated link.

use super::Format;
use crate::units::{Checks, InvalidValue, keys};

/// Maximum delay of a reordered frame, and maximum number of frames that a second station repeats.
const FRAMES_MAX: u64 = 1 << 20;

keys! {
    /// The `[downlink.link]` section: all faults are off by default.
    ///
    /// "Frame" means a coded frame (CADU), or a packet if packets are sent plain.
    pub struct LinkConfig {
        /// Probability that a bit is wrong.
        everyday bit_error_rate: f64 = 0.0;
        /// Mean distance between bursts; 0 for none. Bursts and gaps are the states of a Gilbert-Elliott channel.
        expert burst_every_bits: f64 = 0.0;
        /// Mean length of bursts.
        #[only_with(".burst_every_bits")]
        expert burst_bits: f64 = 0.0;
        /// Probability that a bit of a burst is wrong.
        #[only_with(".burst_every_bits")]
        expert burst_bit_error_rate: f64 = 0.5;
        /// Probability that a frame does not arrive.
        everyday frame_loss: f64 = 0.0;
        /// Probability that a pass does not arrive.
        everyday pass_loss: f64 = 0.0;
        /// Probability that a pass is truncated.
        expert pass_cut: f64 = 0.0;
        /// Probability that a frame arrives twice.
        expert duplicate: f64 = 0.0;
        /// Probability that a frame arrives late.
        expert reorder: f64 = 0.0;
        /// Maximum delay of a late frame.
        #[only_with(".reorder")]
        expert reorder_frames: u64 = 16;
        /// Probability that a pass arrives after the next one.
        expert pass_swap: f64 = 0.0;
        /// Probability that a bit is lost or added within a coded frame.
        expert bit_slip: f64 = 0.0;
        /// Frames at the end of each pass that a second station receives, too, with its own faults.
        expert second_station_frames: u64 = 0;
    }
}

impl LinkConfig {
    /// Whether any fault is configured.
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

    /// The values that are invalid for a format; empty for a valid configuration.
    #[must_use]
    #[doc(hidden)]
    pub fn problems(&self, format: Format) -> Vec<InvalidValue> {
        let mut checks = Checks::new("downlink.link");
        // Beyond, nothing arrives: a frame has thousands of bits.
        let rate = self.bit_error_rate;
        checks.require("bit_error_rate", rate, (0.0..=0.1).contains(&rate), "a probability, 0 to 0.1");
        for (key, value) in [("frame_loss", self.frame_loss), ("pass_loss", self.pass_loss)] {
            checks.require(key, value, (0.0..1.0).contains(&value), "a probability, 0 to less than 1");
        }
        for (key, value) in [
            ("burst_bit_error_rate", self.burst_bit_error_rate),
            ("pass_cut", self.pass_cut),
            ("duplicate", self.duplicate),
            ("reorder", self.reorder),
            ("pass_swap", self.pass_swap),
            ("bit_slip", self.bit_slip),
        ] {
            checks.require(key, value, (0.0..=1.0).contains(&value), "a probability, 0 to 1");
        }
        let bursts = self.burst_every_bits;
        let is_valid = bursts == 0.0 || (1.0..=1e15).contains(&bursts);
        checks.require("burst_every_bits", bursts, is_valid, "0, or 1 to 1e15");
        let is_valid = bursts == 0.0 || (1.0..=1e15).contains(&self.burst_bits);
        checks.require("burst_bits", self.burst_bits, is_valid, "1 to 1e15 where there are bursts");
        let is_valid = self.bit_slip == 0.0 || format == Format::Cadu;
        checks.require("bit_slip", self.bit_slip, is_valid, "0 unless format is \"cadu\"");
        for (key, value) in
            [("reorder_frames", self.reorder_frames), ("second_station_frames", self.second_station_frames)]
        {
            checks.require(key, value, value <= FRAMES_MAX, "at most 1048576");
        }
        checks.finish()
    }
}
