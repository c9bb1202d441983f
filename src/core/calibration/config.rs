//! Configuration of calibration.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{
    AntennaGains, BurstChoice, Calibration, CalibrationError, GainsFile, Identity, SolvedGains, SubBands,
    VanVleck,
};
use crate::frames::ERROR_DRAWS_MAX;
use crate::units::{Checks, InvalidValue, keys};

/// Maximum number of sub-bands of a channel.
const SUB_BANDS_MAX: usize = 64;

/// Accepted numbers of bits, for messages.
const QUANTISER_BITS: &str = "0 for none, 1, 2 or 4";

/// Choice of the calibration hook.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CalibrationHook {
    /// No correction.
    #[default]
    Identity,
    /// Complex gains of every antenna, from a file.
    AntennaGains,
    /// Gains found from the data, pass by pass, with the settings of `[calibrate]`.
    Solve,
}

keys! {
    /// The `[calibration]` section.
    #[derive(Eq)]
    pub struct CalibrationConfig {
        /// Correction of gains: "identity" for none, "antenna-gains" from a file, or "solve": solved for while the data
        /// arrive, with the settings of section `calibrate`.
        everyday hook: CalibrationHook = CalibrationHook::Identity;
        /// File of gains for "antenna-gains", such as "gains.json".
        #[only_with(r#"calibration.hook = "antenna-gains""#)]
        #[serde(skip_serializing_if = "Option::is_none")]
        everyday gains_file: Option<PathBuf> = None;
        /// Number of draws of the errors of the applied gains, if these are known, that the sums of harmonic maps carry: with them the errors of
        /// a map include those of its gains. Even, such as 8, which nearly doubles the memory of the sums; 0 for errors without them.
        #[only_with(r#"calibration.hook = "antenna-gains" or calibration.hook = "solve""#)]
        expert error_draws: usize = 0;
        /// Bits of the samples, for whose quantisation correlations are corrected: 1, 2 or 4; 0 for no correction.
        expert quantiser_bits: u32 = 0;
        /// Number of successive channels of the downlink that are sub-bands of one channel of the map.
        expert sub_bands: usize = 1;
        /// Bursts of point sources, such as the Sun's, that are found in a pass: "flag" leaves their visibilities out of the sums, "peel"
        /// subtracts their fitted flux and lowers weights by its error, "keep" only reports them, "off" does not look for any. A steady
        /// source that the Moon uncovers for less than a quarter of a pass, and that outshines the rest, is taken for a burst.
        #[serde(skip_serializing_if = "BurstChoice::is_off")]
        expert bursts: BurstChoice = BurstChoice::Off;
    }
}

impl CalibrationConfig {
    /// All invalid values; empty if there are none. Does not open the gains file.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("calibration");
        let bits = self.quantiser_bits;
        checks.require("quantiser_bits", bits, bits == 0 || VanVleck::new(bits).is_ok(), QUANTISER_BITS);
        checks.require(
            "quantiser_bits",
            bits,
            bits == 0 || self.sub_bands <= 1,
            "0 with sub_bands above 1: the correction is for whole channels, and a quantiser's effect spreads over all sub-bands",
        );
        let sub_bands = self.sub_bands;
        checks.require("sub_bands", sub_bands, (1..=SUB_BANDS_MAX).contains(&sub_bands), "1 to 64");
        let draws = self.error_draws;
        let is_good = draws <= ERROR_DRAWS_MAX && draws.is_multiple_of(2);
        checks.require("error_draws", draws, is_good, "an even number from 0 to 64");
        let single = self.hook != CalibrationHook::Solve || sub_bands == 1;
        let expected = "1 with hook = \"solve\", which finds gains for the channels as they are sent";
        checks.require("sub_bands", sub_bands, single, expected);
        let has_file = self.hook != CalibrationHook::AntennaGains || self.gains_file.is_some();
        let expected = "the path of a file, for hook = \"antenna-gains\"";
        checks.require("gains_file", "(missing)", has_file, expected);
        checks.finish()
    }

    /// Number of draws of the errors of the gains that are applied; 0 if no errors are known.
    #[must_use]
    #[doc(hidden)]
    pub fn known_error_draws(&self) -> usize {
        // Without draws the file need not be read.
        if self.error_draws == 0 {
            return 0;
        }
        let states_errors = |path: &PathBuf| GainsFile::read(path).is_ok_and(|file| file.states_errors());
        let is_known = match self.hook {
            CalibrationHook::Identity => false,
            CalibrationHook::AntennaGains => self.gains_file.as_ref().is_some_and(states_errors),
            CalibrationHook::Solve => true,
        };
        if is_known { self.error_draws } else { 0 }
    }

    /// The van Vleck correction, if any.
    ///
    /// # Errors
    /// The number of bits has no correction.
    pub fn van_vleck(&self) -> Result<Option<VanVleck>, CalibrationError> {
        if self.quantiser_bits == 0 {
            return Ok(None);
        }
        VanVleck::new(self.quantiser_bits).map(Some).map_err(|error| {
            InvalidValue {
                key: "calibration.quantiser_bits".to_owned(),
                value: error.0.to_string(),
                expected: QUANTISER_BITS.into(),
            }
            .into()
        })
    }

    /// Builds the calibration. `folder` is the folder of the configuration file. With hook `solve` the gains are
    /// still unknown: a ground station with [`SolvedGains`] finds and applies them.
    ///
    /// # Errors
    /// The first of [`CalibrationConfig::problems`], or an invalid gains file.
    pub fn build(&self, folder: &Path) -> Result<Box<dyn Calibration>, CalibrationError> {
        if let Some(problem) = self.problems().into_iter().next() {
            return Err(problem.into());
        }
        let calibration: Box<dyn Calibration> = match self.hook {
            CalibrationHook::Identity => Box::new(Identity),
            CalibrationHook::AntennaGains => {
                // `problems` has required the file.
                let file = self.gains_file.as_deref().unwrap_or(Path::new(""));
                Box::new(AntennaGains::read(&folder.join(file), self.error_draws)?)
            }
            CalibrationHook::Solve => Box::new(SolvedGains::default()),
        };
        Ok(match self.sub_bands {
            1 => calibration,
            count => Box::new(SubBands::new(calibration, count)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_the_identity() {
        let config: CalibrationConfig = toml::from_str("").unwrap();
        assert!(config.problems().is_empty());
        assert_eq!(config.build(Path::new("")).unwrap().name(), "identity");
        assert_eq!(toml::from_str::<CalibrationConfig>(&toml::to_string(&config).unwrap()), Ok(config));
    }

    #[test]
    fn hook_and_file_must_agree() {
        let config: CalibrationConfig = toml::from_str("hook = 'antenna-gains'").unwrap();
        let problems = config.problems();
        assert_eq!(problems.len(), 1);
        assert!(problems[0].to_string().starts_with("calibration.gains_file = "), "{}", problems[0]);
        assert!(config.build(Path::new("")).is_err());
        assert!(toml::from_str::<CalibrationConfig>("hook = 'magic'").is_err());
        assert!(toml::from_str::<CalibrationConfig>("gain_file = 'gains.toml'").is_err());
    }

    #[test]
    fn the_file_is_sought_beside_the_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let config: CalibrationConfig =
            toml::from_str("hook = 'antenna-gains'\ngains_file = 'gains.toml'").unwrap();
        assert!(config.problems().is_empty());
        let missing = config.build(folder.path()).err().unwrap();
        assert!(matches!(missing, CalibrationError::Read { .. }), "{missing}");
        let gains =
            "[[channels]]\nfrequency_hz = 1e7\nsolutions = [{ time_s = 0, gains = [[1, 0], [0, 1]] }]";
        std::fs::write(folder.path().join("gains.toml"), gains).unwrap();
        assert_eq!(config.build(folder.path()).unwrap().name(), "antenna-gains");
    }
}
