//! Configuration of joint maps.

use super::posterior::JointRequest;
use super::powers::PowerPriors;
use crate::imaging::StoppingRule;
use crate::units::{Checks, InvalidValue, PerChannel, keys};

/// Maximum number of posterior samples, which are in memory for every channel.
pub const SAMPLES_MAX: u64 = 1_000;

/// Maximum prior of gain, offset and slope, percent.
pub const PRIOR_PERCENT_MAX: f64 = 1_000.0;

keys! {
    /// The `[joint]` section: joint maps at the end of `lunarray run`.
    pub struct JointConfig {
        /// Make joint maps of the channels from the sums in memory, as `lunarray joint` does from states, in OUT/joint.
        expert on: bool = false;
        /// Frequencies between the channels at which maps are made, too.
        #[only_with(".on = true")]
        expert at_hz: Vec<f64> = Vec::new();
        /// Posterior samples, for the errors of means and spectra.
        #[only_with(".on = true")]
        expert count: u64 = 16;
        /// Fit the daughters' total powers, too.
        #[only_with(r#".on = true and spacecraft.auto_powers = true or .on = true and spacecraft.fidelity = "samples""#)]
        expert powers: bool = true;
        /// Standard deviations of gain, offset and slope of a power over a pass, percent of the power.
        #[only_with(
            ".on = true and .powers = true and spacecraft.auto_powers = true or \
             .on = true and .powers = true and spacecraft.fidelity = \"samples\""
        )]
        expert power_priors_percent: [f64; 3] = [10.0, 1.0, 1.0];
        /// Part of the powers that is not the sky, receiver noise and the Moon's emission: one value, or one for each channel.
        #[only_with(
            ".on = true and .powers = true and spacecraft.auto_powers = true or \
             .on = true and .powers = true and spacecraft.fidelity = \"samples\""
        )]
        expert power_constant_k_sr: PerChannel<f64> = PerChannel::All(0.0);
    }
}

impl JointConfig {
    /// All problems of the values; the pipeline has `channels` channels.
    #[must_use]
    pub fn problems(&self, channels: usize) -> Vec<InvalidValue> {
        let mut checks = Checks::new("joint");
        checks.numbers("at_hz", &self.at_hz, |hz| hz > 0.0 && hz.is_finite(), "frequencies above 0");
        let good = (2..=SAMPLES_MAX).contains(&self.count);
        checks.require("count", self.count, good, format!("2 to {SAMPLES_MAX}"));
        let good = |percent| (0.0..=PRIOR_PERCENT_MAX).contains(&percent);
        let expected = format!("gain, offset and slope, each 0 to {PRIOR_PERCENT_MAX} percent");
        checks.numbers("power_priors_percent", &self.power_priors_percent, good, expected);
        let constants = &self.power_constant_k_sr;
        checks.numbers("power_constant_k_sr", constants.values(), f64::is_finite, "finite numbers");
        let expected = format!("one value, or {channels}, one for each channel");
        let found = format!("({} values)", constants.values().len());
        checks.require("power_constant_k_sr", found, constants.fits(channels), expected);
        checks.finish()
    }

    /// The request for joint maps, with total powers if there are any; `constant_k_sr` in order of frequency.
    #[must_use]
    pub fn request(&self, rule: StoppingRule, has_powers: bool, constant_k_sr: Vec<f64>) -> JointRequest {
        let uses_powers = self.powers && has_powers;
        JointRequest {
            rule,
            samples: self.count as usize,
            at_hz: self.at_hz.clone(),
            powers: uses_powers.then(|| PowerPriors::of_percent(self.power_priors_percent, constant_k_sr)),
        }
    }
}
