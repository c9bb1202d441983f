//! Reports keys that are set but have no effect with the other settings, and the setting that they need.

use thiserror::Error;
use toml::{Table, Value};

use super::key_list::{FlatKey, flat_keys};
use super::problems::Problems;
use super::sections::Config;
use crate::units::{Level, shortened};

const SHOWN_MAX: usize = 60;

/// A key that is set and has no effect.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{key} = {value} has {}", told(only_with))]
pub struct NoEffect {
    /// Full key.
    pub key: String,
    /// Value of the key.
    pub value: String,
    /// Condition under which the key has an effect.
    pub only_with: String,
}

const ONLY_WITH: &str = "an effect only with ";

fn told(condition: &str) -> String {
    match condition.strip_prefix("no ").filter(|rest| !rest.contains(" or ") && !rest.contains(" and ")) {
        Some(other) => format!("no effect with {other}; leave one of them out"),
        None => format!("an effect only {}", condition_text(condition)),
    }
}

/// A condition in words, which begin with `with` or `without`.
#[must_use]
#[doc(hidden)]
pub fn condition_text(condition: &str) -> String {
    let without =
        |part: &str| part.strip_prefix("no ").filter(|rest| !rest.contains(" or ")).map(str::to_owned);
    let all: Option<Vec<String>> = condition.split(" and ").map(without).collect();
    match (all, condition.strip_prefix("no ")) {
        (Some(keys), _) => match keys.split_last() {
            Some((last, [])) => format!("without {last}"),
            Some((last, rest)) => format!("without {} or {last}", rest.join(", ")),
            None => String::new(),
        },
        (None, Some(rest)) => format!("without {}", rest.replace(" or ", " or with ")),
        (None, None) => format!("with {}", condition.replace(" and no ", " and without ")),
    }
}

/// Whether a problem is a key without effect because a strength is zero that is set to zero in `set`: a study steps through it.
pub(super) fn is_of_strength_zero(problem: &str, set: &Table) -> bool {
    let strength = problem.split_once(ONLY_WITH).and_then(|(_, key)| value_of(set, key));
    strength.is_some_and(|value| value.as_float() == Some(0.0) || value.as_integer() == Some(0))
}

impl Config {
    /// The value of a key as a file has it.
    pub(super) fn shown(&self, key: &str) -> String {
        let set = Table::try_from(self).unwrap_or_default();
        let default = || flat_keys().into_iter().find(|known| known.path == key)?.default;
        value_of(&set, key).cloned().or_else(default).map_or_else(String::new, |value| value.to_string())
    }

    /// Keys of `sections` (of all sections if the list is empty) that differ from their defaults and have no effect.
    pub(super) fn without_effect(&self, sections: &[&str]) -> Problems {
        let mut found = Problems::default();
        // A configuration always has a TOML form: the test of the reference relies on it too.
        let set = Table::try_from(self).unwrap_or_default();
        let keys = flat_keys();
        let is_in_sections = |key: &&FlatKey| {
            sections.is_empty() || sections.contains(&key.path.split('.').next().unwrap_or(""))
        };
        for key in keys.iter().filter(|key| key.key.level != Level::Section).filter(is_in_sections) {
            let Some(value) = value_of(&set, &key.path).filter(|value| Some(*value) != key.default.as_ref())
            else {
                continue;
            };
            if let Some(only_with) = key.only_with.iter().find(|only| !holds(only, &set, &keys)) {
                found.push(|| NoEffect {
                    key: key.path.clone(),
                    value: shortened(&value.to_string(), SHOWN_MAX),
                    only_with: only_with.clone(),
                });
            }
        }
        found
    }
}

/// The value at a dotted path.
fn value_of<'a>(table: &'a Table, path: &str) -> Option<&'a Value> {
    let (first, rest) = path.split_once('.').map_or((path, None), |(first, rest)| (first, Some(rest)));
    let value = table.get(first)?;
    match rest {
        Some(rest) => value_of(value.as_table()?, rest),
        None => Some(value),
    }
}

/// Whether a condition holds: of any part (joined by `or`) all comparisons (joined by `and`): `key = value`, `key > number`, a key alone,
/// which is true if the key differs from its default, or `no` and one of them, if it does not hold.
fn holds(condition: &str, set: &Table, keys: &[FlatKey]) -> bool {
    condition.split(" or ").any(|part| part.split(" and ").all(|comparison| is_true(comparison, set, keys)))
}

fn is_true(comparison: &str, set: &Table, keys: &[FlatKey]) -> bool {
    if let Some(key) = comparison.strip_prefix("no ") {
        return !is_true(key, set, keys);
    }
    let mut words = comparison.splitn(3, ' ');
    let (path, sign, wanted) = (words.next().unwrap_or(""), words.next(), words.next());
    let default = keys.iter().find(|key| key.path == path).and_then(|key| key.default.as_ref());
    let value = value_of(set, path).or(default);
    let wanted = wanted.and_then(|text| toml::from_str::<Table>(&format!("v = {text}")).ok()?.remove("v"));
    match (sign, value, wanted) {
        (None, value, _) => value != default,
        (Some("="), Some(value), Some(wanted)) => *value == wanted,
        (Some(">"), Some(value), Some(wanted)) => is_above(value, &wanted),
        _ => false,
    }
}

fn is_above(value: &Value, limit: &Value) -> bool {
    let number = |value: &Value| value.as_float().or_else(|| value.as_integer().map(|whole| whole as f64));
    match value {
        Value::Array(list) => list.iter().any(|value| is_above(value, limit)),
        value => number(value).zip(number(limit)).is_some_and(|(value, limit)| value > limit),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::EngineKind;
    use crate::pipeline::ConfigSource;

    /// Three satellites on an ellipse.
    const ORBITS: &str = "satellites = 3, kepler = [\
        { semi_major_axis_m = 2e6, eccentricity = 0.01, inclination_deg = 30.0, node_longitude_deg = 0.0, periapsis_deg = 0.0, mean_anomaly_deg = 0.0 },\
        { semi_major_axis_m = 2e6, eccentricity = 0.01, inclination_deg = 30.0, node_longitude_deg = 0.0, periapsis_deg = 0.0, mean_anomaly_deg = 0.1 },\
        { semi_major_axis_m = 2e6, eccentricity = 0.01, inclination_deg = 30.0, node_longitude_deg = 0.0, periapsis_deg = 0.0, mean_anomaly_deg = 0.3 }]";

    fn messages(text: &str) -> Vec<String> {
        let mut config: Config = toml::from_str(text).unwrap();
        // An engine is chosen before; here of pixels where none is named.
        if config.map.engine == EngineKind::Auto {
            config.map.engine = EngineKind::Pixel;
        }
        config.problems().iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_key_without_effect_is_reported_with_its_value_and_condition() {
        for (text, expected) in [
            ("map.l_max = 10", "map.l_max = 10 has an effect only with map.engine = \"harmonic\""),
            (
                "map.refine.passes_max = 3",
                "map.refine.passes_max = 3 has an effect only with map.engine = \"harmonic\"",
            ),
            (
                "map.engine = \"harmonic\"\nmap.matrix = \"free\"",
                "map.matrix = \"free\" has an effect only with map.engine = \"pixel\"",
            ),
            (
                "map.iterations_max = 7",
                "map.iterations_max = 7 has an effect only with map.engine = \"harmonic\" or map.matrix = \"free\" or \
                 map.regulariser.degree or map.regulariser.file or map.nside > 32 and without map.epsilon and without \
                 map.regulariser = \"identity\"",
            ),
            (
                "daughters.bits = 2",
                "daughters.bits = 2 has an effect only with spacecraft.fidelity = \"samples\"",
            ),
            // The section's condition holds for the keys of a section in it.
            (
                "daughters.tones.calibration_k_sr = 2.0",
                "daughters.tones.calibration_k_sr = 2.0 has an effect only with spacecraft.fidelity = \"samples\"",
            ),
            ("sky.frequency = { spectral_index = -2.5 }", "has an effect only with sky.file"),
            // What would be left of a generated sky.
            (
                "sky = { file = \"a.fits\", nside = 8 }",
                "sky.nside = 8 has an effect only without sky.file or with sky.added",
            ),
            (
                "sky = { file = \"a.fits\", generated.loops = false }",
                "sky.generated.loops = false has an effect only without sky.file or with sky.added",
            ),
            (
                "map.epsilon = 0.5\nmap.regulariser = \"data\"",
                "map.epsilon = 0.5 has no effect with map.regulariser = \"data\"; leave one of them out",
            ),
            (
                "calibration.gains_file = \"g\"",
                "calibration.gains_file = \"g\" has an effect only with calibration.hook = \"antenna-gains\"",
            ),
            (
                "instrument.antenna_files.table_error_max = 0.1",
                "instrument.antenna_files.table_error_max = 0.1 has an effect only with instrument.antenna_files.tables",
            ),
            (
                "map.engine = \"harmonic\"\nmap.refine.passes_max = 3\nmap.antennas.files.table_error_max = 0.1",
                "map.antennas.files.table_error_max = 0.1 has an effect only with map.antennas.files.tables",
            ),
            // Keys of a term that is off.
            (
                "instrument.burst_s = 9.0",
                "instrument.burst_s = 9.0 has an effect only with instrument.burst_every_s",
            ),
            ("instrument.outlier_sigma = 9.0", "only with instrument.outlier_probability"),
            ("instrument.leak_depth_deg = 9.0", "only with instrument.leak_k_sr"),
            ("instrument.clock_steering_s = 9e5", "only with instrument.clock_allan_deviation"),
            ("instrument.beacon.on_s = 9.0", "only with instrument.beacon.k_sr"),
            ("instrument.amplitude.drift_time_s = 99.0", "only with instrument.amplitude.drift_rms"),
            ("navigation.along_m.step_every_s = 99.0", "only with navigation.along_m.step_rms"),
            ("downlink.idle_frames = 9", "only with downlink.format = \"cadu\""),
            ("downlink.link.burst_bits = 9.0", "only with downlink.link.burst_every_bits"),
            ("downlink.link.reorder_frames = 9", "only with downlink.link.reorder"),
            ("products = { frame = \"ecliptic\", pictures = false }", "only with products.pictures = true"),
            (
                "sky.generated = { source_flux_jy_min = 5.0, point_sources = false }",
                "only with sky.generated.point_sources = true or sky.added",
            ),
            // A formation's shape beside orbits of the satellites' own.
            (
                format!("array = {{ {ORBITS}, altitude_m = 1e6 }}").as_str(),
                "array.altitude_m = 1000000.0 has an effect only without array.kepler, array.oem or array.stations",
            ),
            (
                format!("array = {{ {ORBITS}, breathing.span_m_max = 5e4 }}").as_str(),
                "array.breathing.span_m_max = 50000.0 has an effect only without array.kepler, array.oem or array.stations",
            ),
        ] {
            let found = messages(text);
            assert_eq!(found.len(), 1, "{text}: {found:?}");
            assert!(found[0].ends_with(expected), "{text}: {found:?}");
        }
    }

    /// R from the data of few pixels, and the identity of any number of them.
    #[test]
    fn what_is_solved_directly_takes_no_rule_for_iterations() {
        for text in [
            "map = { residual_max = 1e-6, regulariser = \"data\", nside = 32 }",
            "map = { residual_max = 1e-6, regulariser = \"identity\" }",
            "map = { residual_max = 1e-6, regulariser = \"identity\", nside = 64 }",
            "map = { iterations_max = 7, epsilon = 1e-3, nside = 64 }",
        ] {
            let found = messages(text);
            assert_eq!(found.len(), 1, "{text}: {found:?}");
            let condition =
                "or map.nside > 32 and without map.epsilon and without map.regulariser = \"identity\"";
            assert!(found[0].ends_with(condition), "{text}: {found:?}");
        }
    }

    #[test]
    fn keys_with_an_effect_and_defaults_are_not_reported() {
        for text in [
            "",
            "map.l_max = 0",
            "map.matrix = \"free\"\nmap.iterations_max = 7",
            "map.engine = \"pixel\"\nmap.nside = 64\nmap.iterations_max = 7",
            "map = { nside = 64, residual_max = 1e-6, regulariser = \"data\" }",
            "map = { residual_max = 1e-6, regulariser = { degree = 2.0 }, epsilon = 1e-3 }",
            "map = { residual_max = 1e-6, regulariser = { file = [\"cl.csv\"] } }",
            "map = { residual_max = 1e-6, regulariser = \"identity\", matrix = \"free\" }",
            "map = { residual_max = 1e-6, epsilon = 1e-3, engine = \"harmonic\" }",
            "map.engine = \"harmonic\"\nmap.l_max = 10\nmap.refine = { passes_max = 3, residual_max = 0.1 }",
            format!("array = {{ {ORBITS}, altitude_m = 300e3, moon_radius_m = 1.7e6 }}").as_str(),
        ] {
            assert_eq!(messages(text), Vec::<String>::new(), "{text}");
        }
    }

    #[test]
    fn a_strength_that_is_set_to_zero_is_no_slip() {
        let load = |set: &[&str]| {
            let overrides = set.iter().map(|&text| text.to_owned()).collect();
            ConfigSource { overrides, ..ConfigSource::default() }.load().map(|_| ())
        };
        let time = "instrument.clock_ns.drift_time_s=60.0";
        load(&[time, "instrument.clock_ns.drift_rms=0.0"]).unwrap();
        load(&["downlink.link={reorder=0, reorder_frames=9}"]).unwrap();
        assert!(load(&[time]).unwrap_err().to_string().contains("only with instrument.clock_ns.drift_rms"));
        assert!(load(&["products={pictures=false, frame='ecliptic'}"]).is_err());
    }

    #[test]
    fn every_condition_names_existing_keys() {
        let keys = flat_keys();
        let conditions = keys.iter().flat_map(|key| &key.only_with);
        for comparison in conditions.flat_map(|only| only.split(" and ")).flat_map(|part| part.split(" or "))
        {
            let words: Vec<&str> = comparison.strip_prefix("no ").unwrap_or(comparison).split(' ').collect();
            // The choice of a regulariser is a value with a name of its own.
            let of_key = |key: &FlatKey| {
                words[0].strip_prefix(&key.path).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
            };
            assert!(keys.iter().any(of_key), "{comparison}");
            assert!(matches!(words[1..], [] | ["=" | ">", _]), "{comparison}");
        }
    }
}
