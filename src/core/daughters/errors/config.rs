//! Configuration of the instrument's errors.

use crate::response::beacon::Beacon;
use crate::response::{AntennaFiles, PatternsByFrequency};
use crate::units::{Checks, InvalidValue, keys};

/// Minimum correlation time of a drift, s: some thousand nodes in a pass.
const DRIFT_TIME_S_MIN: f64 = 60.0;

/// Minimum time constant of clock steering, s.
const STEERING_S_MIN: f64 = 600.0;

keys! {
    /// The `[instrument]` section: what is wrong with the daughters, in either fidelity. Without any of it, data are as
    /// they are without the section. What is wrong with positions and times is in [`NavigationConfig`](super::NavigationConfig).
    pub struct InstrumentConfig {
        /// Number of the realisation of random errors, also of `[navigation]`; sky and thermal noise stay the same.
        everyday realisation: u32 = 0;
        /// Natural logarithm of the voltage gain's amplitude, by daughter and channel.
        section amplitude: ErrorTerms = ErrorTerms::default();
        /// Phase of the voltage gain, by daughter and channel.
        section phase_deg: ErrorTerms = ErrorTerms::default();
        /// Offset of the clock by daughter, for all channels; positive if samples are late.
        section clock_ns: ErrorTerms = ErrorTerms::default();
        /// Tilt of an antenna's axis from the orbit's normal towards the track; needs spacecraft.model = "direct" or "general",
        /// or samples.
        section tilt_along_deg: ErrorTerms = ErrorTerms::default();
        /// Tilt of an antenna's axis from the orbit's normal away from the Moon.
        section tilt_radial_deg: ErrorTerms = ErrorTerms::default();
        /// Distortion q of the voltage pattern: a factor 1 + q (3 cos^2 - 1) / 2 with the angle from the axis.
        section pattern: ErrorTerms = ErrorTerms::default();
        /// Distortion of the voltage pattern by frequency, added to instrument.pattern: rows `[frequency_hz, q]`, or
        /// `[frequency_hz, q_1, q_2, ...]` with one q a daughter; linear between rows, constant beyond.
        #[serde(skip_serializing_if = "PatternsByFrequency::is_ideal")]
        expert pattern_by_frequency: PatternsByFrequency = PatternsByFrequency::default();
        /// Attitudes and patterns of the antennas by files, to which tilts are added.
        #[serde(skip_serializing_if = "AntennaFiles::is_default")]
        section antenna_files: AntennaFiles = AntennaFiles::default();
        /// Allan deviation of every clock at 1 s, with white frequency noise.
        expert clock_allan_deviation: f64 = 0.0;
        /// Time within which steering brings clocks back: their noise is forgotten as exp(-|t| / this).
        #[only_with(".clock_allan_deviation")]
        expert clock_steering_s: f64 = 86_400.0;
        /// Daughters, from 1, that deliver noise and no signal.
        expert dead_daughters: Vec<u32> = Vec::new();
        /// Receivers that deliver noise and no signal: daughter, from 1, and channel, from 0.
        expert dead_channels: Vec<[u32; 2]> = Vec::new();
        /// Probability that a visibility is an outlier.
        #[only_with(".outlier_sigma")]
        expert outlier_probability: f64 = 0.0;
        /// Standard deviation of what is added to an outlier's real and imaginary part, over that of thermal noise.
        #[only_with(".outlier_probability")]
        expert outlier_sigma: f64 = 0.0;
        /// Mean time between bursts of interference from the Earth; 0 for none.
        #[only_with(".burst_k_sr")]
        expert burst_every_s: f64 = 0.0;
        /// Length of a burst.
        #[only_with(".burst_every_s")]
        expert burst_s: f64 = 0.0;
        /// Power of a burst at a daughter.
        #[only_with(".burst_s")]
        expert burst_k_sr: f64 = 0.0;
        /// Power at a daughter of interference from the Earth at the Moon's limb; 0 for none.
        expert leak_k_sr: f64 = 0.0;
        /// Angle below the limb over which the leakage falls by a factor e.
        #[only_with(".leak_k_sr")]
        expert leak_depth_deg: f64 = 1.0;
        /// Artificial signal for calibration: a plane wave, equal at all daughters. Its integrations are flagged and stay out of
        /// maps.
        section beacon: BeaconSchedule = BeaconSchedule::default();
    }
}

keys! {
    /// Terms of one error, which add up. Random terms are Gaussian, zero on average, and independent from daughter to daughter
    /// (and from channel to channel, where the error is one of channels).
    pub struct ErrorTerms {
        /// Given values, one per daughter, or none; the unit of values and rms is that of the section's name.
        expert constant: Vec<f64> = Vec::new();
        /// Given rates since the epoch, one per daughter, or none.
        expert rate_per_day: Vec<f64> = Vec::new();
        /// Rms of a random constant, the same for the whole mission.
        expert constant_rms: f64 = 0.0;
        /// Rms of a random constant, new in each pass.
        expert pass_rms: f64 = 0.0;
        /// Rms of an oscillation with the orbital period.
        expert orbit_rms: f64 = 0.0;
        /// Rms of a Gauss-Markov process with correlation exp(-|t| / drift_time_s).
        expert drift_rms: f64 = 0.0;
        /// Correlation time of the Gauss-Markov process.
        #[only_with(".drift_rms")]
        expert drift_time_s: f64 = 3600.0;
        /// Rms of a level that jumps.
        expert step_rms: f64 = 0.0;
        /// Interval in which the level jumps once, at a random time.
        #[only_with(".step_rms")]
        expert step_every_s: f64 = 86_400.0;
    }
}

keys! {
    /// The artificial signal and its times.
    pub struct BeaconSchedule {
        /// Power at a daughter, in every channel; 0 for no signal.
        #[only_with(".on_s")]
        expert k_sr: f64 = 0.0;
        /// Ecliptic longitude and latitude that it comes from.
        #[only_with(".k_sr")]
        expert direction_deg: [f64; 2] = [0.0, 0.0];
        /// Time for which it is on, from the start of each pass.
        #[only_with(".k_sr")]
        expert on_s: f64 = 0.0;
        /// Time after which it is repeated in a pass; 0 for once.
        #[only_with(".k_sr")]
        expert every_s: f64 = 0.0;
    }
}

impl BeaconSchedule {
    /// The beacon signal.
    #[must_use]
    pub fn signal(&self) -> Beacon {
        Beacon { k_sr: self.k_sr, direction_deg: self.direction_deg }
    }

    /// Whether the beacon is on at a time after the start of a pass, s.
    #[must_use]
    pub fn is_on(&self, after_s: f64) -> bool {
        let since_s = if self.every_s > 0.0 { after_s.rem_euclid(self.every_s) } else { after_s };
        self.k_sr > 0.0 && since_s < self.on_s
    }
}

impl ErrorTerms {
    /// Whether there is no error.
    #[must_use]
    pub fn is_none(&self) -> bool {
        let given = self.constant.iter().chain(&self.rate_per_day).all(|value| *value == 0.0);
        let rms = [self.constant_rms, self.pass_rms, self.orbit_rms, self.drift_rms, self.step_rms];
        given && rms.iter().all(|value| *value == 0.0)
    }

    /// Whether the error may change within a pass.
    #[must_use]
    pub fn changes_in_a_pass(&self) -> bool {
        let rms = [self.orbit_rms, self.drift_rms, self.step_rms];
        rms.iter().chain(&self.rate_per_day).any(|value| *value != 0.0)
    }

    /// Checks the terms. `of` gives the number of items with values of their own, and their name; `[most,
    /// most_per_day]` bounds values and rates.
    pub(super) fn check(
        &self,
        name: &str,
        of: (usize, &str),
        [most, most_per_day]: [f64; 2],
        smooth: bool,
        checks: &mut Checks,
    ) {
        let (values, each) = of;
        for (key, list, most) in
            [("constant", &self.constant, most), ("rate_per_day", &self.rate_per_day, most_per_day)]
        {
            let (key, count) = (format!("{name}.{key}"), list.len());
            let fits = count == 0 || count == values;
            let expected = format!("none, or {values}: one {each}");
            checks.require(&key, format!("({count} values)"), fits, expected);
            checks.numbers(
                &key,
                list,
                |value| value.abs() <= most,
                format!("numbers from -{most} to {most}"),
            );
        }
        for (key, rms) in [
            ("constant_rms", self.constant_rms),
            ("pass_rms", self.pass_rms),
            ("orbit_rms", self.orbit_rms),
            ("drift_rms", self.drift_rms),
            ("step_rms", self.step_rms),
        ] {
            let expected = format!("a standard deviation, 0 to {most}");
            checks.number(format!("{name}.{key}"), rms, (0.0..=most).contains(&rms), expected);
        }
        if smooth {
            let expected = "0: positions in packets are interpolated, and antennas turn slowly, so that their errors have to be smooth";
            checks.number(format!("{name}.drift_rms"), self.drift_rms, self.drift_rms == 0.0, expected);
            checks.number(format!("{name}.step_rms"), self.step_rms, self.step_rms == 0.0, expected);
        }
        let time_s = self.drift_time_s;
        let expected = "60 s to 1e9 s";
        checks.number(
            format!("{name}.drift_time_s"),
            time_s,
            (DRIFT_TIME_S_MIN..=1e9).contains(&time_s),
            expected,
        );
        let every_s = self.step_every_s;
        checks.number(
            format!("{name}.step_every_s"),
            every_s,
            (1.0..=1e9).contains(&every_s),
            "1 s to 1e9 s",
        );
    }
}

/// Maximum values of an error, and maximum rates per day: those of receivers and clocks that would still be used,
/// over years.
fn maxima_of(name: &str) -> [f64; 2] {
    match name {
        "amplitude" => [5.0, 0.01],
        "pattern" => [10.0, 0.01],
        "phase_deg" => [1e6, 1e7],
        "clock_ns" => [1e9, 1e9],
        _ => [45.0, 45.0],
    }
}

impl InstrumentConfig {
    /// Whether anything differs from an ideal instrument.
    #[must_use]
    pub fn is_on(&self) -> bool {
        let has_outliers = self.outlier_probability > 0.0 && self.outlier_sigma > 0.0;
        self.terms().iter().any(|(_, terms)| !terms.is_none())
            || !(self.dead_daughters.is_empty() && self.dead_channels.is_empty())
            || has_outliers
            || self.has_bursts()
            || self.leak_k_sr > 0.0
            || self.clock_allan_deviation > 0.0
            || self.beacon.k_sr > 0.0
            || !self.pattern_by_frequency.is_ideal()
            || self.antenna_files.is_some()
    }

    /// Keeps the schedule of the beacon, without errors.
    #[must_use]
    pub fn without_errors(&self) -> Self {
        Self { beacon: self.beacon.clone(), ..Self::default() }
    }

    /// Whether there are bursts of interference.
    #[must_use]
    pub fn has_bursts(&self) -> bool {
        self.burst_every_s > 0.0 && self.burst_s > 0.0 && self.burst_k_sr > 0.0
    }

    /// Whether antennas differ from the ideal one.
    #[must_use]
    pub fn has_own_antennas(&self) -> bool {
        !self.pattern_by_frequency.is_ideal()
            || self.antenna_files.is_some()
            || [&self.tilt_along_deg, &self.tilt_radial_deg, &self.pattern]
                .iter()
                .any(|terms| !terms.is_none())
    }

    /// Whether anything changes within a pass.
    #[must_use]
    pub fn changes_in_a_pass(&self) -> bool {
        self.clock_allan_deviation > 0.0 || self.terms().iter().any(|(_, terms)| terms.changes_in_a_pass())
    }

    fn terms(&self) -> [(&'static str, &ErrorTerms); 6] {
        [
            ("amplitude", &self.amplitude),
            ("phase_deg", &self.phase_deg),
            ("clock_ns", &self.clock_ns),
            ("tilt_along_deg", &self.tilt_along_deg),
            ("tilt_radial_deg", &self.tilt_radial_deg),
            ("pattern", &self.pattern),
        ]
    }

    /// Checks tilts, clocks and leaks.
    fn check_rest(&self, checks: &mut Checks) {
        for (name, terms) in
            [("tilt_along_deg", &self.tilt_along_deg), ("tilt_radial_deg", &self.tilt_radial_deg)]
        {
            let given = terms.constant.iter().chain([&terms.constant_rms, &terms.pass_rms, &terms.orbit_rms]);
            let most = given.fold(0.0, |most: f64, deg| most.max(deg.abs()));
            checks.number(name, most, most <= 45.0, "tilts of at most 45 deg");
        }
        let deviation = self.clock_allan_deviation;
        let expected = "0 (none) to 1e-6, at 1 s";
        checks.number("clock_allan_deviation", deviation, (0.0..=1e-6).contains(&deviation), expected);
        let steering_s = self.clock_steering_s;
        let good = (STEERING_S_MIN..=1e7).contains(&steering_s);
        checks.number("clock_steering_s", steering_s, good, "600 s to 1e7 s");
        let depth_deg = self.leak_depth_deg;
        checks.number("leak_depth_deg", depth_deg, (1e-3..=180.0).contains(&depth_deg), "0.001 to 180 deg");
    }

    /// All invalid values for an array of `satellites` and a number of channels; `samples` is true with sample
    /// fidelity. Empty if there are none.
    #[must_use]
    pub fn problems(&self, satellites: usize, channels: usize, samples: bool) -> Vec<InvalidValue> {
        let mut checks = Checks::new("instrument");
        for (name, terms) in self.terms() {
            let smooth = !["amplitude", "phase_deg", "clock_ns"].contains(&name);
            terms.check(name, (satellites, "a daughter"), maxima_of(name), smooth, &mut checks);
        }
        self.pattern_by_frequency.check("pattern_by_frequency", Some(satellites), &mut checks);
        let has_patterns = !(self.pattern.is_none() && self.pattern_by_frequency.is_ideal());
        self.antenna_files.check("antenna_files", has_patterns, &mut checks);
        self.check_rest(&mut checks);
        let exists = |number: u32, count: usize| (1..=count).contains(&(number as usize));
        for (index, &daughter) in self.dead_daughters.iter().enumerate() {
            let expected = format!("a daughter, 1 to {satellites}");
            checks.require(
                format!("dead_daughters[{index}]"),
                daughter,
                exists(daughter, satellites),
                expected,
            );
            let is_new = !self.dead_daughters[..index].contains(&daughter);
            checks.require(format!("dead_daughters[{index}]"), daughter, is_new, "every daughter once");
        }
        for (index, &[daughter, channel]) in self.dead_channels.iter().enumerate() {
            let good = exists(daughter, satellites) && (channel as usize) < channels;
            let expected = format!(
                "a daughter, 1 to {satellites}, and a channel, 0 to {}, every pair once",
                channels.saturating_sub(1)
            );
            checks.require(
                format!("dead_channels[{index}]"),
                format!("[{daughter}, {channel}]"),
                good && !self.dead_channels[..index].contains(&[daughter, channel]),
                expected,
            );
        }
        let probability = self.outlier_probability;
        checks.number("outlier_probability", probability, (0.0..=1.0).contains(&probability), "0 to 1");
        for (key, value) in [
            ("outlier_sigma", self.outlier_sigma),
            ("burst_every_s", self.burst_every_s),
            ("burst_s", self.burst_s),
            ("burst_k_sr", self.burst_k_sr),
            ("leak_k_sr", self.leak_k_sr),
            ("beacon.on_s", self.beacon.on_s),
            ("beacon.every_s", self.beacon.every_s),
        ] {
            checks.number(key, value, (0.0..=1e12).contains(&value), "0 or more, at most 1e12");
        }
        let (burst_s, every_s) = (self.burst_s, self.burst_every_s);
        checks.number("burst_s", burst_s, every_s == 0.0 || burst_s <= every_s, "at most burst_every_s");
        self.beacon.signal().check("beacon", &mut checks);
        // Samples have their own tones and interference.
        let expected = "none with spacecraft.fidelity = \"samples\", which have daughters.tones";
        for (key, on) in [
            ("dead_daughters", !self.dead_daughters.is_empty()),
            ("dead_channels", !self.dead_channels.is_empty()),
            ("outlier_probability", probability > 0.0),
            ("burst_k_sr", self.has_bursts()),
            ("leak_k_sr", self.leak_k_sr > 0.0),
            ("beacon.k_sr", self.beacon.k_sr > 0.0),
        ] {
            checks.require(key, "(on)", !(samples && on), expected);
        }
        checks.finish()
    }
}
