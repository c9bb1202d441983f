//! Files of antenna gains.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::CalibrationError;
use crate::files::read_text;
use crate::units::{Checks, InvalidValue, MAX_SATELLITES, shortened};

/// Maximum size of a file, bytes: gains of all channels in a month of passes take some megabytes.
const BYTES_MAX: u64 = 1 << 30;

/// Maximum length of a line of a parser's message, characters.
const LINE_CHARS: usize = 300;

/// Text of a parser's error, with lines of bounded length: it may quote the file.
fn parser_message(error: impl std::fmt::Display) -> String {
    let text = error.to_string();
    text.lines().map(|line| shortened(line.trim_end(), LINE_CHARS)).collect::<Vec<_>>().join("\n")
}

/// Interpolation of gains between solutions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Interpolation {
    /// Linear in log amplitude and phase, the phase along the shorter arc.
    #[default]
    LogLinear,
    /// The solution nearer in time; the earlier one half-way.
    Nearest,
}

/// Gains of all satellites in some channels at some times, as TOML or JSON:
///
/// ```toml
#[doc = include_str!("gains_example.toml")]
/// ```
///
/// The first solution applies to all earlier times, the last to all later ones. A gain of zero or (in TOML) `nan`
/// marks a satellite as unusable at that time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GainsFile {
    /// Interpolation of gains between solutions.
    #[serde(default)]
    pub interpolation: Interpolation,
    /// Largest difference between the frequencies of a channel and of the gains that it uses, Hz.
    #[serde(default = "half_channel_hz")]
    pub frequency_tolerance_hz: f64,
    /// Gains by channel, in any order.
    pub channels: Vec<ChannelGains>,
    /// Errors of the positions in packets, by time; positions are not corrected where there is no entry.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub positions: Vec<PositionSolution>,
}

/// Position errors of all satellites over an interval: reported minus true.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PositionSolution {
    /// Start of the interval, s since the mission epoch; not before the end of the preceding interval.
    pub from_s: f64,
    /// End of the interval, s.
    pub until_s: f64,
    /// Normal of every satellite's orbit: unit vectors on ecliptic axes.
    pub normals_hat: Vec<[f64; 3]>,
    /// Position error of every satellite along its track, along the normal, and away from the Moon, m.
    pub offsets_m: Vec<[f64; 3]>,
}

/// Half the width of a channel of the DSL mission, Hz.
fn half_channel_hz() -> f64 {
    4e3
}

/// Gains in one channel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelGains {
    /// Centre frequency, Hz.
    pub frequency_hz: f64,
    /// Gains at increasing times.
    pub solutions: Vec<GainSolution>,
}

/// Gains at one time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GainSolution {
    /// Time since the mission epoch, s.
    pub time_s: f64,
    /// Real and imaginary part of every satellite's voltage gain.
    pub gains: Vec<[f64; 2]>,
    /// Errors of maps by these gains; absent if there are none, or not known, as with more than 16 daughters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub errors: Option<GainErrors>,
}

/// Errors that the gains of one solution make in a map, independent of those of other solutions and of the map's noise.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GainErrors {
    /// Names the solution, s since the mission epoch: entries of one solution, such as of the start and the end of a pass, have one error, and
    /// so have those of solutions that were smoothed together.
    pub solution_s: f64,
    /// Standard deviations of the natural logarithm of the amplitude and of the phase, rad, of every satellite.
    pub sigma: Vec<[f64; 2]>,
    /// Correlations of the errors of ln amplitude and of phase, of satellite 2 with 1, 3 with 1, 3 with 2, and so on; empty for none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub correlations: Vec<[f64; 2]>,
}

/// Largest standard deviation of a gain's logarithm. Errors are taken to first order, which fails well below it.
pub(super) const SIGMA_MAX: f64 = 1.0;

impl GainsFile {
    /// Whether errors of any gains are stated.
    pub(super) fn states_errors(&self) -> bool {
        self.channels.iter().flat_map(|channel| &channel.solutions).any(|solution| solution.errors.is_some())
    }

    /// Reads a file: JSON if its name ends in `.json`, TOML otherwise. Does not check the values.
    ///
    /// # Errors
    /// [`CalibrationError::Read`] and [`CalibrationError::Syntax`].
    pub fn read(path: &Path) -> Result<Self, CalibrationError> {
        let text = read_text(path, BYTES_MAX)
            .map_err(|source| CalibrationError::Read { path: path.to_owned(), source })?;
        let parsed = if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("json")) {
            serde_json::from_str(&text).map_err(parser_message)
        } else {
            toml::from_str(&text).map_err(parser_message)
        };
        parsed.map_err(|message| CalibrationError::Syntax { path: path.to_owned(), message })
    }

    /// All invalid values; empty if there are none.
    #[must_use]
    #[doc(hidden)]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("");
        let tolerance_hz = self.frequency_tolerance_hz;
        let expected = "a finite number of at least 0";
        checks.number("frequency_tolerance_hz", tolerance_hz, tolerance_hz >= 0.0, expected);
        checks.require("channels", "[]", !self.channels.is_empty(), "at least one channel");
        let satellites = self.satellites();
        for (index, channel) in self.channels.iter().enumerate() {
            let key = format!("channels[{index}]");
            let frequency_hz = channel.frequency_hz;
            let frequency_key = format!("{key}.frequency_hz");
            checks.number(&frequency_key, frequency_hz, frequency_hz > 0.0, "a positive number");
            let is_new = self.channels[..index].iter().all(|earlier| earlier.frequency_hz != frequency_hz);
            checks.require(&frequency_key, frequency_hz, is_new, "every frequency once");
            channel.check(&key, satellites, &mut checks);
        }
        let mut previous_s = f64::NEG_INFINITY;
        for (index, position) in self.positions.iter().enumerate() {
            let key = format!("positions[{index}]");
            let [from_s, until_s] = [position.from_s, position.until_s];
            let expected = "a finite time, not before until_s of the preceding entry";
            checks.number(format!("{key}.from_s"), from_s, from_s >= previous_s, expected);
            checks.number(format!("{key}.until_s"), until_s, until_s > from_s, "a finite time after from_s");
            previous_s = previous_s.max(until_s);
            for (name, list) in [("normals_hat", &position.normals_hat), ("offsets_m", &position.offsets_m)] {
                let key = format!("{key}.{name}");
                let found = format!("({} satellites)", list.len());
                checks.require(
                    &key,
                    found,
                    list.len() == satellites,
                    "as many satellites as in the first solution",
                );
                checks.numbers(&key, list.as_flattened(), |_| true, "finite numbers");
            }
        }
        checks.finish()
    }

    /// Number of satellites in the first solution; 0 if there is none.
    #[must_use]
    #[doc(hidden)]
    pub fn satellites(&self) -> usize {
        let first = self.channels.iter().find_map(|channel| channel.solutions.first());
        first.map_or(0, |solution| solution.gains.len())
    }
}

impl ChannelGains {
    fn check(&self, key: &str, satellites: usize, checks: &mut Checks) {
        let is_nonempty = !self.solutions.is_empty();
        checks.require(format!("{key}.solutions"), "[]", is_nonempty, "at least one solution");
        let mut previous_s = f64::NEG_INFINITY;
        for (index, solution) in self.solutions.iter().enumerate() {
            let key = format!("{key}.solutions[{index}]");
            let time_s = solution.time_s;
            let expected = "a finite time after that of the preceding solution";
            checks.number(format!("{key}.time_s"), time_s, time_s > previous_s, expected);
            previous_s = previous_s.max(time_s);
            let count = solution.gains.len();
            let (gains_key, found) = (format!("{key}.gains"), format!("({count} satellites)"));
            let is_accepted = (2..=MAX_SATELLITES).contains(&count);
            checks.require(&gains_key, &found, is_accepted, "2 to 64 satellites");
            let is_equal = !is_accepted || count == satellites;
            checks.require(&gains_key, &found, is_equal, "as many satellites as in the first solution");
            let Some(errors) = &solution.errors else { continue };
            let solution_s = errors.solution_s;
            checks.number(format!("{key}.errors.solution_s"), solution_s, true, "a finite time");
            let (sigma_key, found) =
                (format!("{key}.errors.sigma"), format!("({} satellites)", errors.sigma.len()));
            checks.require(&sigma_key, found, errors.sigma.len() == count, "as many satellites as gains");
            let (correlations, key) = (&errors.correlations, format!("{key}.errors.correlations"));
            let is_triangle =
                correlations.is_empty() || correlations.len() == count * count.saturating_sub(1) / 2;
            checks.require(
                &key,
                format!("({})", correlations.len()),
                is_triangle,
                "none, or one for every pair",
            );
            let is_correlation = |value: f64| (-1.0..=1.0).contains(&value);
            checks.numbers(&key, correlations.as_flattened(), is_correlation, "numbers of -1 to 1");
            let is_sigma = |sigma: f64| (0.0..=SIGMA_MAX).contains(&sigma);
            checks.numbers(&sigma_key, errors.sigma.as_flattened(), is_sigma, "numbers of 0 to 1");
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn read(name: &str, text: &str) -> Result<GainsFile, CalibrationError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        GainsFile::read(&path)
    }

    const TOML: &str =
        "[[channels]]\nfrequency_hz = 1e7\nsolutions = [{ time_s = 5, gains = [[1, 0], [0.5, -2]] }]";

    #[test]
    fn toml_and_json_are_equivalent() {
        let json = r#"{"channels": [{"frequency_hz": 1e7,
                       "solutions": [{"time_s": 5, "gains": [[1, 0], [0.5, -2]]}]}]}"#;
        let (from_toml, from_json) = (read("a.toml", TOML).unwrap(), read("a.JSON", json).unwrap());
        assert_eq!(from_toml, from_json);
        assert!(from_toml.problems().is_empty());
        assert_eq!(from_toml.channels[0].solutions[0].gains, [[1.0, 0.0], [0.5, -2.0]]);
    }

    #[test]
    fn the_example_in_the_documentation_is_good() {
        let file: GainsFile = toml::from_str(include_str!("gains_example.toml")).unwrap();
        assert!(file.problems().is_empty());
        assert_eq!(file.channels[0].solutions.len(), 2);
    }

    #[test]
    fn unknown_keys_and_other_files_are_refused() {
        for text in [&format!("gain = 1\n{TOML}"), "", "SIMPLE  =  T", "channels = 3"] {
            let error = read("a.toml", text).unwrap_err();
            assert!(matches!(error, CalibrationError::Syntax { .. }), "{error}");
            assert!(error.to_string().contains("a.toml"), "{error}");
        }
    }

    #[test]
    fn all_invalid_values_are_reported_at_once() {
        let text = "frequency_tolerance_hz = -1\n\
            [[channels]]\nfrequency_hz = 1e7\n\
            solutions = [{ time_s = 5, gains = [[1, 0], [1, 0]] }, { time_s = 5, gains = [[1, 0]] }]\n\
            [[channels]]\nfrequency_hz = 1e7\nsolutions = []\n\
            [[channels]]\nfrequency_hz = nan\n\
            solutions = [{ time_s = inf, gains = [[1, 0], [1, 0], [1, 0]] }]";
        let keys: Vec<String> =
            read("a.toml", text).unwrap().problems().into_iter().map(|problem| problem.key).collect();
        let expected = [
            "frequency_tolerance_hz",
            "channels[0].solutions[1].time_s",
            "channels[0].solutions[1].gains",
            "channels[1].frequency_hz",
            "channels[1].solutions",
            "channels[2].frequency_hz",
            "channels[2].solutions[0].time_s",
            "channels[2].solutions[0].gains",
        ];
        assert_eq!(keys, expected);
    }

    #[test]
    fn only_the_first_of_many_mistakes_are_listed() {
        let solutions: Vec<String> =
            (0..30).map(|k| format!("{{ time_s = {k}, gains = [[1, 0]] }}")).collect();
        let text = format!("[[channels]]\nfrequency_hz = 1e7\nsolutions = [{}]", solutions.join(", "));
        let problems = read("a.toml", &text).unwrap().problems();
        assert_eq!(problems.len(), 30);
        let told = CalibrationError::Values { path: "a.toml".into(), problems }.to_string();
        assert_eq!(told.matches("expected 2 to 64 satellites").count(), 5, "{told}");
        assert!(told.ends_with("; and 25 more"), "{told}");
    }

    proptest! {
        #[test]
        fn any_text_is_read_or_refused(text in any::<String>(), cut in 0..TOML.len()) {
            let _ = toml::from_str::<GainsFile>(&text).map(|file| file.problems());
            let _ = toml::from_str::<GainsFile>(&TOML[..cut]).map(|file| file.problems());
            let _ = serde_json::from_str::<GainsFile>(&text).map(|file| file.problems());
        }
    }
}
