//! Settings by their path, such as `array.kepler[0].eccentricity`: replaced by overrides, and read.

use super::error::ConfigError;
use super::reader::SHOWN_MAX;
use super::sections::Config;
use crate::units::shortened;

/// Maximum number of sections in the key of an override; the deepest key has three.
const DEPTH_MAX: usize = 8;

/// Applies an override `key=value` to a table; a value that is not TOML is taken as a string. Returns the key.
pub(super) fn apply_override<'a>(table: &mut toml::Table, text: &'a str) -> Result<&'a str, ConfigError> {
    let invalid = || ConfigError::Override(shortened(text, SHOWN_MAX));
    let (key, value) = text.split_once('=').ok_or_else(invalid)?;
    let key = key.trim();
    let parsed = toml::from_str::<toml::Table>(&format!("value = {value}"));
    let value = parsed
        .ok()
        .and_then(|mut table| table.remove("value"))
        .unwrap_or_else(|| toml::Value::String(value.trim().to_owned()));
    let (sections, last) = key.rsplit_once('.').map_or(("", key), |(head, last)| (head, last));
    if last.is_empty() || sections.split('.').count() > DEPTH_MAX {
        return Err(invalid());
    }
    let no_list = || "is no element: the file has no such list; set the whole one first".to_owned();
    let mut section = table;
    for part in sections.split('.').filter(|part| !part.is_empty()) {
        let (name, element) = element_of(part);
        if element.is_some() && !section.contains_key(name) {
            return Err(not_there(key, part, no_list()));
        }
        let place = section.entry(name).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        let place = at(place, element).map_err(|found| not_there(key, part, found))?;
        let found = format!("is {}, not a section", kind_of(place));
        section = place.as_table_mut().ok_or_else(|| not_there(key, part, found))?;
    }
    let (name, element) = element_of(last);
    match section.get_mut(name) {
        Some(place) => *at(place, element).map_err(|found| not_there(key, last, found))? = value,
        None if element.is_some() => return Err(not_there(key, last, no_list())),
        None => drop(section.insert(name.to_owned(), value)),
    }
    Ok(key)
}

fn not_there(key: &str, part: &str, found: String) -> ConfigError {
    ConfigError::NotThere { key: shortened(key, SHOWN_MAX), part: shortened(part, SHOWN_MAX), found }
}

/// The name and the index of `name[index]`, an element of a list.
fn element_of(part: &str) -> (&str, Option<usize>) {
    let found = part.strip_suffix(']').and_then(|part| part.split_once('['));
    match found.map(|(name, index)| (name, index.parse())) {
        Some((name, Ok(index))) => (name, Some(index)),
        _ => (part, None),
    }
}

/// A value, or an element of it; what is there instead if it has no such element.
fn at(place: &mut toml::Value, element: Option<usize>) -> Result<&mut toml::Value, String> {
    let Some(element) = element else { return Ok(place) };
    let kind = kind_of(place);
    let toml::Value::Array(list) = place else {
        return Err(format!("is no element: this is {kind}, not a list"));
    };
    let count = list.len();
    list.get_mut(element).ok_or_else(|| match count {
        0 => "is no element: the list is empty".to_owned(),
        _ => format!("is no element: the list has [0] to [{}]", count - 1),
    })
}

fn kind_of(value: &toml::Value) -> &'static str {
    match value {
        toml::Value::String(_) => "a text",
        toml::Value::Integer(_) | toml::Value::Float(_) => "a number",
        toml::Value::Boolean(_) => "true or false",
        toml::Value::Datetime(_) => "a date",
        toml::Value::Array(_) => "a list",
        toml::Value::Table(_) => "a section",
    }
}

/// The number at a path of settings, such as `array.kepler[0].eccentricity`.
pub(in crate::pipeline) fn number_at(config: &Config, key: &str) -> Option<f64> {
    let value = value_at(config, key)?;
    value.as_float().or_else(|| Some(value.as_integer()? as f64))
}

/// Whether a setting is a whole number.
pub(in crate::pipeline) fn is_whole_at(config: &Config, key: &str) -> bool {
    value_at(config, key).is_some_and(|value| value.is_integer())
}

fn value_at(config: &Config, key: &str) -> Option<toml::Value> {
    let mut place = toml::Value::try_from(config).ok()?;
    for part in key.split('.') {
        let (name, element) = element_of(part);
        place = place.as_table_mut()?.remove(name)?;
        place = std::mem::replace(at(&mut place, element).ok()?, toml::Value::Boolean(false));
    }
    Some(place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::config::ConfigSource;

    #[test]
    fn overrides_reach_elements_of_lists() {
        let one = "{ semi_major_axis_m = 2e6, eccentricity = 0.01, inclination_deg = 30, node_longitude_deg = 0, periapsis_deg = 0, \
                   mean_anomaly_deg = 0 }";
        let text = format!("[array]\nsatellites = 3\nkepler = [{one}, {one}, {one}]");
        let overrides = [
            "array.kepler[1].eccentricity=0.05",
            "spacecraft.channels_hz=[1e6, 3e6]",
            "spacecraft.channels_hz[1]=5e6",
        ];
        let source =
            ConfigSource { overrides: overrides.map(str::to_owned).to_vec(), ..ConfigSource::default() };
        let found = source.parse_text(&text).unwrap();
        let eccentricities: Vec<f64> = found.array.kepler.iter().map(|one| one.eccentricity).collect();
        assert_eq!(eccentricities, [0.01, 0.05, 0.01]);
        assert_eq!(number_at(&found, "array.kepler[1].eccentricity"), Some(0.05));
        assert_eq!(number_at(&found, "array.satellites"), Some(3.0));
        assert!(is_whole_at(&found, "array.satellites") && !is_whole_at(&found, "array.altitude_m"));
        for key in ["array.kepler[3].eccentricity", "array.kepler", "array.nothing", "name"] {
            assert_eq!(number_at(&found, key), None, "{key}");
        }
        for (set, told) in [
            (
                "array.kepler[1].eccentricity=abc",
                "--set array.kepler[1].eccentricity=abc: array.kepler: invalid type: string \"abc\"",
            ),
            (
                "array.kepler[1].excentricity=0.1",
                "--set array.kepler[1].excentricity=0.1: array.kepler: unknown field `excentricity`",
            ),
            ("array.kepler[3].eccentricity=0.1", "`kepler[3]` is no element: the list has [0] to [2]"),
        ] {
            let source = ConfigSource { overrides: vec![set.to_owned()], ..ConfigSource::default() };
            let error = source.parse_text(&text).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
        assert_eq!(found.spacecraft.channels_hz, [1e6, 5e6]);
    }
}
