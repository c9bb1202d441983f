//! Conversion of TOML to a configuration. It reads as much as possible and reports all keys and values that it cannot read.

use std::collections::HashMap;

use thiserror::Error;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use super::key_list::known_keys;
use super::problems::{Problem, Problems};
use super::sections::Config;
use crate::units::{Dimension, shortened};

/// Old and new names of keys. The new name includes the unit if it changed.
const RENAMED_KEYS: [(&str, &str); 18] = [
    ("map.regularisation_exponent", "map.regulariser, as { degree = 2.0 }"),
    ("map.regularisation_files", "map.regulariser, as { file = [\"cl.csv\"] }"),
    ("instrument.along_m", "navigation.along_m"),
    ("instrument.across_m", "navigation.across_m"),
    ("instrument.radial_m", "navigation.radial_m"),
    ("daughters.disturbances.gain_error", "instrument.amplitude.constant (the logarithm of the amplitude)"),
    (
        "daughters.disturbances.gain_drift_per_s",
        "instrument.amplitude.rate_per_day (of the logarithm, a day)",
    ),
    ("daughters.disturbances.phase_rad", "instrument.phase_deg.constant (degrees)"),
    ("daughters.disturbances.phase_drift_rad_per_s", "instrument.phase_deg.rate_per_day (degrees a day)"),
    ("daughters.disturbances.clock_offset_s", "instrument.clock_ns.constant (ns)"),
    ("daughters.disturbances.clock_drift", "instrument.clock_ns.rate_per_day (ns a day)"),
    ("daughters.disturbances.interference_k_sr", "daughters.tones.interference_k_sr"),
    ("daughters.disturbances.interference_offset_hz", "daughters.tones.interference_offset_hz"),
    ("daughters.disturbances.interference_depth_m", "daughters.tones.interference_depth_m"),
    ("daughters.disturbances.calibration_k_sr", "daughters.tones.calibration_k_sr"),
    ("daughters.disturbances.calibration_offset_hz", "daughters.tones.calibration_offset_hz"),
    ("daughters.disturbances.calibration_phase_rad", "daughters.tones.calibration_phase_rad"),
    ("daughters.disturbances", "daughters.tones, and [instrument] for gains, phases and clocks"),
];

/// Keys with old and new names of their values.
const RENAMED_VALUES: [(&str, &str, &str); 2] =
    [("map.matrix", "held", "stored"), ("map.matrix", "remade", "free")];

/// Maximum number of characters of a key, an override or the parser's message that are shown.
pub(in crate::pipeline) const SHOWN_MAX: usize = 160;

/// A key or value that the configuration cannot hold.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum ReadProblem {
    /// Text that is not TOML.
    #[error("line {line}, column {column}: {message}")]
    Syntax {
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// The parser's message.
        message: String,
    },
    /// A key or section that does not exist.
    #[error("{place}{key}: no such key; {known}")]
    Unknown {
        /// Line or override in which the key is set.
        place: String,
        /// Full key.
        key: String,
        /// Similar and existing keys.
        known: String,
    },
    /// A value of the wrong type.
    #[error("{place}{key}: {message}")]
    Type {
        /// Line or override in which the key is set.
        place: String,
        /// Full key.
        key: String,
        /// What was found and expected.
        message: String,
    },
}

/// A configuration in which unreadable values are replaced by defaults.
pub(in crate::pipeline) struct PartialConfig {
    /// The values that could be read; defaults for the others.
    pub(in crate::pipeline) config: Config,
    pub(in crate::pipeline) problems: Problems,
    unread: Vec<String>,
}

impl PartialConfig {
    /// Reads `table`; `locator` locates its keys for messages.
    pub(in crate::pipeline) fn new(table: Table, locator: &KeyLocator<'_>) -> Self {
        if let Ok(config) = table.clone().try_into() {
            return Self { config, problems: Problems::default(), unread: Vec::new() };
        }
        let mut reader = SectionReader { locator, problems: Problems::default(), unread: Vec::new() };
        let valid = reader.section(&[], table, &known_keys(Config::KEYS));
        let SectionReader { mut problems, unread, .. } = reader;
        let config = valid.try_into().unwrap_or_else(|error: toml::de::Error| {
            // Keys that are valid one by one but not together; there are none today.
            problems.push(|| error);
            Config::default()
        });
        Self { config, problems, unread }
    }

    /// Collects all problems: `override_problems`, problems of reading, and those of `value_problems` that are not due to a value
    /// that could not be read.
    pub(in crate::pipeline) fn all_problems<E: Into<Problem>>(
        &mut self,
        value_problems: Problems,
        override_problems: Vec<E>,
    ) -> Problems {
        let mut found = Problems::default();
        override_problems.into_iter().for_each(|problem| found.push(|| problem));
        found.append(std::mem::take(&mut self.problems));
        found.append(value_problems.without(|problem| self.may_be_secondary(problem)));
        found
    }

    /// Whether a problem may be due to the default that replaces a value that could not be read.
    fn may_be_secondary(&self, problem: &str) -> bool {
        let decides_a_count = |key: &str| match key {
            "spacecraft.channels_hz" => problem.contains("channels"),
            "array.satellites" => problem.contains("a daughter"),
            _ => false,
        };
        self.unread.iter().any(|key| problem.contains(key.as_str()) || decides_a_count(key))
    }
}

/// Reads sections key by key, and collects the problems.
struct SectionReader<'a> {
    locator: &'a KeyLocator<'a>,
    problems: Problems,
    unread: Vec<String>,
}

impl SectionReader<'_> {
    /// The keys of the section at `path` whose values can be read; `known` holds the keys that exist.
    fn section(&mut self, path: &[&str], table: Table, known: &Table) -> Table {
        let mut valid = Table::new();
        for (key, value) in table {
            let path = [path, &[key.as_str()]].concat();
            let value = match (known.get(&key), value) {
                (Some(Value::Table(known)), Value::Table(table)) => {
                    Some(Value::Table(self.section(&path, table, known)))
                }
                (Some(Value::Table(_)), value) => {
                    let found = value.type_str();
                    self.report_type(&path, || format!("found one value ({found}), expected a section"));
                    None
                }
                (None, Value::Table(table)) if is_renamed_below(&path) => {
                    self.section(&path, table, &Table::new());
                    None
                }
                (None, _) => {
                    let locator = self.locator;
                    self.problems.push(|| ReadProblem::Unknown {
                        place: locator.place(&path),
                        key: shortened(&path.join("."), SHOWN_MAX),
                        known: known_keys_message(&path, known),
                    });
                    None
                }
                (_, value) => match nested_table(&path, value.clone()).try_into::<Config>() {
                    Ok(_) => Some(value),
                    Err(error) => {
                        let units = expected_units(&key, &value);
                        let renamed = renamed_value(&path, &value);
                        self.report_type(&path, || {
                            renamed.unwrap_or_else(|| with_units(&plain_type_names(error.message()), units))
                        });
                        None
                    }
                },
            };
            if let Some(value) = value {
                valid.insert(key, value);
            }
        }
        valid
    }

    fn report_type(&mut self, path: &[&str], message: impl FnOnce() -> String) {
        let (locator, key) = (self.locator, path.join("."));
        self.unread.push(key.clone());
        self.problems.push(|| ReadProblem::Type { place: locator.place(path), key, message: message() });
    }
}

/// Nested tables that contain only `value`, at `path`.
fn nested_table(path: &[&str], value: Value) -> Table {
    let mut path = path.iter().rev();
    let last = path.next().map(|key| (*key).to_owned());
    let innermost: Table = last.map(|key| (key, value)).into_iter().collect();
    path.fold(innermost, |table, key| Table::from_iter([((*key).to_owned(), Value::Table(table))]))
}

fn is_renamed_below(path: &[&str]) -> bool {
    let prefix = format!("{}.", path.join("."));
    RENAMED_KEYS.iter().any(|(before, _)| before.starts_with(&prefix))
}

/// Message for an old name of a value; `None` if it is not one.
fn renamed_value(path: &[&str], value: &Value) -> Option<String> {
    let (path, value) = (path.join("."), value.as_str()?);
    let (_, before, now) = RENAMED_VALUES.iter().find(|(key, before, _)| *key == path && *before == value)?;
    Some(format!("\"{before}\" was renamed to \"{now}\""))
}

/// Message for the unknown key at `path`: its new name, or the similar and the existing keys of its section.
fn known_keys_message(path: &[&str], known: &Table) -> String {
    let full_key = path.join(".");
    let Some((wrong, path)) = path.split_last() else { return String::new() };
    if let Some((_, now)) = RENAMED_KEYS.iter().find(|(before, _)| *before == full_key) {
        return format!("it was renamed to {now}");
    }
    let section = path.join(".");
    let keys: Vec<&str> = known.keys().map(String::as_str).collect();
    let section = if path.is_empty() { "a pipeline".to_owned() } else { format!("[{section}]") };
    let has = format!("{section} has {}", keys.join(", "));
    // At most one wrong letter in three.
    let nearest = keys.iter().map(|key| (edit_distance(wrong, key), key)).min();
    match nearest.filter(|(distance, key)| 3 * distance <= key.len()) {
        Some((_, key)) => format!("did you mean {key}? {has}"),
        None => has,
    }
}

fn edit_distance(from: &str, to: &str) -> usize {
    // No key is hundreds of letters long.
    let from = from.bytes().take(2 * SHOWN_MAX);
    let mut row: Vec<usize> = (0..=to.len()).collect();
    for (k, a) in from.enumerate() {
        let mut diagonal = std::mem::replace(&mut row[0], k + 1);
        for (j, b) in to.bytes().enumerate() {
            let changed = diagonal + usize::from(a != b);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[to.len()]
}

/// Replaces Rust's type names in a message of the parser.
fn plain_type_names(message: &str) -> String {
    ["usize", "u64", "u32", "u16", "u8"]
        .map(|name| (name, "a whole number, not negative"))
        .into_iter()
        .chain([("f64", "a number"), ("a sequence", "a list")])
        .fold(message.to_owned(), |text, (name, plain)| {
            text.replace(&format!("expected {name}"), &format!("expected {plain}"))
        })
}

/// The units that a key accepts, if its value is a text or a list with texts.
fn expected_units(key: &str, value: &Value) -> Option<&'static str> {
    let is_text = value.is_str() || value.as_array().is_some_and(|list| list.iter().any(Value::is_str));
    Dimension::from_key(key).filter(|_| is_text).map(Dimension::expected)
}

/// Adds the units that the key accepts to a message of the parser.
fn with_units(message: &str, units: Option<&str>) -> String {
    let Some(units) = units else { return shortened(message, SHOWN_MAX) };
    match message.strip_suffix("a number") {
        Some(message) => format!("{}{units}", shortened(message, SHOWN_MAX)),
        None => format!("{}; a value is {units}", shortened(message, SHOWN_MAX)),
    }
}

/// Locates keys for messages: by line of the file or by override.
#[derive(Default)]
pub(in crate::pipeline) struct KeyLocator<'a> {
    text: &'a str,
    table: Option<Spanned<DeTable<'a>>>,
    overrides: HashMap<String, String>,
}

impl<'a> KeyLocator<'a> {
    pub(in crate::pipeline) fn new(text: &'a str) -> Self {
        Self { text, table: DeTable::parse(text).ok(), overrides: HashMap::new() }
    }

    pub(in crate::pipeline) fn add_override(&mut self, key: &str, text: &str) {
        let text = shortened(text, SHOWN_MAX);
        // Problems of an element are told of its list.
        let Some((list, _)) = key.split_once('[') else {
            self.overrides.insert(key.to_owned(), text);
            return;
        };
        let of_list = self.overrides.entry(list.to_owned()).or_default();
        *of_list = if of_list.is_empty() { text } else { format!("{of_list}, --set {text}") };
    }

    /// Prefix of a message: the override or the line that sets the key.
    fn place(&self, path: &[&str]) -> String {
        // An override also creates the sections of its key.
        let key = path.join(".");
        let is_below =
            |set: &str| set.strip_prefix(&key).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        let line = self.line(path);
        let override_below =
            self.overrides.iter().filter(|(set, _)| is_below(set)).map(|(_, text)| text).min();
        match (self.overrides.get(&key).or(override_below.filter(|_| line.is_none())), line) {
            (Some(text), _) => format!("--set {text}: "),
            (None, Some(line)) => format!("line {line}: "),
            (None, None) => String::new(),
        }
    }

    fn line(&self, path: &[&str]) -> Option<usize> {
        let mut table = self.table.as_ref()?.get_ref();
        let (last, sections) = path.split_last()?;
        for section in sections {
            let (_, value) = table.iter().find(|(found, _)| found.get_ref() == section)?;
            let DeValue::Table(inner) = value.get_ref() else { return None };
            table = inner;
        }
        let key = table.keys().find(|found| found.get_ref() == last)?;
        Some(position(self.text, key.span().start).0)
    }
}

/// Line and column of a byte, counted from 1.
fn position(text: &str, byte: usize) -> (usize, usize) {
    let before = text.get(..byte).unwrap_or(text);
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    (before.matches('\n').count() + 1, before[line_start..].chars().count() + 1)
}

/// Parses a TOML text; the error lists all syntax errors.
pub(in crate::pipeline) fn parse_table(text: &str) -> Result<Table, Problems> {
    toml::from_str(text).map_err(|error| {
        let mut problems = Problems::default();
        let (_, mut errors) = DeTable::parse_recoverable(text);
        if errors.is_empty() {
            errors.push(error);
        }
        for error in errors {
            problems.push(|| {
                let (line, column) = position(text, error.span().map_or(0, |span| span.start));
                ReadProblem::Syntax { line, column, message: shortened(error.message(), SHOWN_MAX) }
            });
        }
        problems
    })
}
