//! Configuration of the daughters' antennas that a refined map assumes.

use crate::imaging::assumed_instrument::AssumedAntenna;
use crate::response::{AntennaFiles, PatternsByFrequency};
use crate::units::{Checks, keys};

keys! {
    /// Antennas by daughter; those beyond a list are ideal.
    pub struct AntennasConfig {
        /// Tilt of an antenna's axis from the orbit's normal towards the track.
        expert tilt_along_deg: Vec<f64> = Vec::new();
        /// Tilt of an antenna's axis away from the Moon.
        expert tilt_radial_deg: Vec<f64> = Vec::new();
        /// Distortion q of the voltage pattern, as instrument.pattern.
        expert pattern: Vec<f64> = Vec::new();
        /// Distortion by frequency, added to `pattern`, as instrument.pattern_by_frequency.
        #[serde(skip_serializing_if = "PatternsByFrequency::is_ideal")]
        expert pattern_by_frequency: PatternsByFrequency = PatternsByFrequency::default();
        /// Attitudes and patterns by files, to which tilts are added.
        #[serde(skip_serializing_if = "AntennaFiles::is_default")]
        section files: AntennaFiles = AntennaFiles::default();
    }
}

impl AntennasConfig {
    fn lists(&self) -> [(&'static str, &[f64]); 3] {
        let Self { tilt_along_deg, tilt_radial_deg, pattern, .. } = self;
        [("tilt_along_deg", tilt_along_deg), ("tilt_radial_deg", tilt_radial_deg), ("pattern", pattern)]
    }

    /// Whether nothing is set.
    #[must_use]
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Whether all antennas are ideal.
    #[must_use]
    pub fn is_ideal(&self) -> bool {
        self.keys_set().is_empty()
    }

    /// Names of the keys that make an antenna differ from an ideal one.
    #[must_use]
    pub fn keys_set(&self) -> Vec<&'static str> {
        let is_set = |values: &[f64]| values.iter().any(|value| *value != 0.0);
        let lists = self.lists().into_iter().filter(|(_, values)| is_set(values)).map(|(key, _)| key);
        let by_frequency = (!self.pattern_by_frequency.is_ideal()).then_some("pattern_by_frequency");
        lists.chain(by_frequency).chain(self.files.is_some().then_some("files")).collect()
    }

    /// Maximum degree of a pair's response as a polynomial in the direction, from two dipoles and two patterns.
    #[must_use]
    pub fn degree(&self) -> usize {
        let is_set = |values: &[f64]| values.iter().any(|value| *value != 0.0);
        let has_patterns = is_set(&self.pattern) || !self.pattern_by_frequency.is_ideal();
        2 * usize::from(!self.is_ideal()) + self.files.degree().max(4 * usize::from(has_patterns))
    }

    /// The assumed antennas, without patterns by frequency; empty if all are ideal.
    pub(super) fn assumed(&self) -> Vec<AssumedAntenna> {
        if self.is_ideal() {
            return Vec::new();
        }
        let count = self.lists().map(|(_, values)| values.len()).into_iter().max().unwrap_or(0);
        let value = |values: &[f64], k: usize| values.get(k).copied().unwrap_or(0.0);
        let antenna = |k: usize| AssumedAntenna {
            tilt_deg: [value(&self.tilt_along_deg, k), value(&self.tilt_radial_deg, k)],
            distortion: value(&self.pattern, k),
        };
        (0..count).map(antenna).collect()
    }

    pub(super) fn check(&self, checks: &mut Checks) {
        let has_patterns =
            !self.pattern_by_frequency.is_ideal() || self.pattern.iter().any(|value| *value != 0.0);
        self.files.check("antennas.files", has_patterns, checks);
        self.pattern_by_frequency.check("antennas.pattern_by_frequency", None, checks);
        for (key, values) in self.lists() {
            let expected = format!("at most {}, one per daughter", u8::MAX);
            checks.require(
                format!("antennas.{key}"),
                format!("({} values)", values.len()),
                values.len() <= usize::from(u8::MAX),
                expected,
            );
            let (limit, expected) = match key {
                "pattern" => (2.0, "-2 to 2"),
                _ => (80.0, "-80 to 80 degrees"),
            };
            checks.numbers(format!("antennas.{key}"), values, |value| value.abs() <= limit, expected);
        }
    }
}
