//! From TOML to a configuration: whatever can be read is, and everything that cannot is told.

use std::collections::HashMap;

use thiserror::Error;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use super::key_list::known_keys;
use super::problems::{Problem, Problems};
use super::sections::Config;
use crate::units::{Dimension, shortened};

/// Old names of keys, and the new ones; those of values that change their unit say so.
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

/// Old names of values of keys, and the new ones.
const RENAMED_VALUES: [(&str, &str, &str); 2] =
    [("map.matrix", "held", "stored"), ("map.matrix", "remade", "free")];

/// Most characters of a key, an override or the parser's message that are shown.
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
        /// What was expected.
        message: String,
    },
    /// A key or section that does not exist.
    #[error("{place}{key}: no such key; {known}")]
    Unknown {
        /// Where it stands.
        place: String,
        /// Full key.
        key: String,
        /// The keys that there are.
        known: String,
    },
    /// A value of the wrong type.
    #[error("{place}{key}: {message}")]
    Type {
        /// Where it stands.
        place: String,
        /// Full key.
        key: String,
        /// What was found and expected.
        message: String,
    },
}

/// A configuration as far as it could be read.
pub(in crate::pipeline) struct Reading {
    /// The values that could be read; defaults for the others.
    pub(in crate::pipeline) config: Config,
    /// The keys and values that could not.
    pub(in crate::pipeline) problems: Problems,
    /// Keys whose values could not be read.
    unread: Vec<String>,
}

impl Reading {
    /// Reads `table`; `lines` are those of its keys, where they are known.
    pub(in crate::pipeline) fn new(table: Table, lines: &Lines<'_>) -> Self {
        if let Ok(config) = table.clone().try_into() {
            return Self { config, problems: Problems::default(), unread: Vec::new() };
        }
        let mut walk = SectionReader { lines, problems: Problems::default(), unread: Vec::new() };
        let good = walk.section(&[], table, &known_keys(Config::KEYS));
        let SectionReader { mut problems, unread, .. } = walk;
        let config = good.try_into().unwrap_or_else(|error: toml::de::Error| {
            // Good keys that are bad together: there are none today.
            problems.push(|| error);
            Config::default()
        });
        Self { config, problems, unread }
    }

    /// All problems: `others` first, then those of reading, then those `of_values` that do not follow from them.
    pub(in crate::pipeline) fn tell<E: Into<Problem>>(
        &mut self,
        of_values: Problems,
        others: Vec<E>,
    ) -> Problems {
        let mut told = Problems::default();
        others.into_iter().for_each(|other| told.push(|| other));
        told.append(std::mem::take(&mut self.problems));
        told.append(of_values.without(|problem| self.may_follow(problem)));
        told
    }

    /// Whether a problem of the values that were read may be only that another value could not be read: a default was
    /// taken in its place.
    fn may_follow(&self, problem: &str) -> bool {
        let counts = |key: &str| match key {
            "spacecraft.channels_hz" => problem.contains("channels"),
            "array.satellites" => problem.contains("a daughter"),
            _ => false,
        };
        self.unread.iter().any(|key| problem.contains(key.as_str()) || counts(key))
    }
}

struct SectionReader<'a> {
    lines: &'a Lines<'a>,
    problems: Problems,
    unread: Vec<String>,
}

impl SectionReader<'_> {
    /// The part of a section at `path` that can be read.
    fn section(&mut self, path: &[&str], table: Table, known: &Table) -> Table {
        let mut good = Table::new();
        for (key, value) in table {
            let path = [path, &[key.as_str()]].concat();
            let value = match (known.get(&key), value) {
                (Some(Value::Table(known)), Value::Table(table)) => {
                    Some(Value::Table(self.section(&path, table, known)))
                }
                (Some(Value::Table(_)), value) => {
                    let found = value.type_str();
                    self.refuse(&path, || format!("found one value ({found}), expected a section"));
                    None
                }
                (None, Value::Table(table)) if is_renamed_below(&path) => {
                    self.section(&path, table, &Table::new());
                    None
                }
                (None, _) => {
                    let lines = self.lines;
                    self.problems.push(|| ReadProblem::Unknown {
                        place: lines.place(&path),
                        key: shortened(&path.join("."), SHOWN_MAX),
                        known: keys_of(&path, known),
                    });
                    None
                }
                (_, value) => match alone(&path, value.clone()).try_into::<Config>() {
                    Ok(_) => Some(value),
                    Err(error) => {
                        let units = units_of(&key, &value);
                        let renamed = renamed_value(&path, &value);
                        self.refuse(&path, || {
                            renamed.unwrap_or_else(|| with_units(&plain(error.message()), units))
                        });
                        None
                    }
                },
            };
            if let Some(value) = value {
                good.insert(key, value);
            }
        }
        good
    }

    fn refuse(&mut self, path: &[&str], message: impl FnOnce() -> String) {
        let (lines, key) = (self.lines, path.join("."));
        self.unread.push(key.clone());
        self.problems.push(|| ReadProblem::Type { place: lines.place(path), key, message: message() });
    }
}

/// A table with one value.
fn alone(path: &[&str], value: Value) -> Table {
    let mut path = path.iter().rev();
    let last = path.next().map(|key| (*key).to_owned());
    let innermost: Table = last.map(|key| (key, value)).into_iter().collect();
    path.fold(innermost, |table, key| Table::from_iter([((*key).to_owned(), Value::Table(table))]))
}

/// Whether keys of the section at `path` have other names now.
fn is_renamed_below(path: &[&str]) -> bool {
    let inside = format!("{}.", path.join("."));
    RENAMED_KEYS.iter().any(|(before, _)| before.starts_with(&inside))
}

/// What to write in place of an old name of a value.
fn renamed_value(path: &[&str], value: &Value) -> Option<String> {
    let (path, value) = (path.join("."), value.as_str()?);
    let (_, before, now) = RENAMED_VALUES.iter().find(|(key, before, _)| *key == path && *before == value)?;
    Some(format!("\"{before}\" was renamed to \"{now}\""))
}

/// The keys of the section that lacks `path`, for a message; first the one that is spelled most like it.
fn keys_of(path: &[&str], known: &Table) -> String {
    let Some((wrong, path)) = path.split_last() else { return String::new() };
    let whole = [path, &[*wrong]].concat().join(".");
    if let Some((_, now)) = RENAMED_KEYS.iter().find(|(before, _)| *before == whole) {
        return format!("it was renamed to {now}");
    }
    let section = path.join(".");
    let keys: Vec<&str> = known.keys().map(String::as_str).collect();
    let section = if path.is_empty() { "a pipeline".to_owned() } else { format!("[{section}]") };
    let has = format!("{section} has {}", keys.join(", "));
    // One slip in three letters.
    let nearest = keys.iter().map(|key| (slips(wrong, key), key)).min();
    match nearest.filter(|(slips, key)| 3 * slips <= key.len()) {
        Some((_, key)) => format!("did you mean {key}? {has}"),
        None => has,
    }
}

/// Letters to be changed, added or left out to make one word of another (Levenshtein's distance).
fn slips(from: &str, to: &str) -> usize {
    // Nobody means a key by a word of hundreds of letters.
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

/// A message of the parser without the language's names of types.
fn plain(message: &str) -> String {
    ["usize", "u64", "u32", "u16", "u8"]
        .map(|name| (name, "a whole number, not negative"))
        .into_iter()
        .chain([("f64", "a number"), ("a sequence", "a list")])
        .fold(message.to_owned(), |text, (name, plain)| {
            text.replace(&format!("expected {name}"), &format!("expected {plain}"))
        })
}

/// The units that the key of a text, or of a list with texts, takes, by its name.
fn units_of(key: &str, value: &Value) -> Option<&'static str> {
    let is_text = value.is_str() || value.as_array().is_some_and(|list| list.iter().any(Value::is_str));
    Dimension::from_key(key).filter(|_| is_text).map(Dimension::expected)
}

/// A message of the parser, with the units that the key takes.
fn with_units(message: &str, units: Option<&str>) -> String {
    let Some(units) = units else { return shortened(message, SHOWN_MAX) };
    match message.strip_suffix("a number") {
        Some(message) => format!("{}{units}", shortened(message, SHOWN_MAX)),
        None => format!("{}; a value is {units}", shortened(message, SHOWN_MAX)),
    }
}

/// Where keys stand.
#[derive(Default)]
pub(in crate::pipeline) struct Lines<'a> {
    text: &'a str,
    table: Option<Spanned<DeTable<'a>>>,
    /// By key of an override, its text.
    overrides: HashMap<String, String>,
}

impl<'a> Lines<'a> {
    /// The lines of a text that has been parsed.
    pub(in crate::pipeline) fn of(text: &'a str) -> Self {
        Self { text, table: DeTable::parse(text).ok(), overrides: HashMap::new() }
    }

    /// Notes that a key was set by an override.
    pub(in crate::pipeline) fn set(&mut self, key: &str, text: &str) {
        self.overrides.insert(key.to_owned(), shortened(text, SHOWN_MAX));
    }

    fn place(&self, path: &[&str]) -> String {
        // An override stands for the sections that it makes, too.
        let key = path.join(".");
        let below =
            |set: &str| set.strip_prefix(&key).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        let line = self.line(path);
        let of_override = self.overrides.iter().filter(|(set, _)| below(set)).map(|(_, text)| text).min();
        match (self.overrides.get(&key).or(of_override.filter(|_| line.is_none())), line) {
            (Some(text), _) => format!("--set {text}: "),
            (None, Some(line)) => format!("line {line}: "),
            (None, None) => String::new(),
        }
    }

    fn line(&self, path: &[&str]) -> Option<usize> {
        let mut table = self.table.as_ref()?.get_ref();
        let (last, sections) = path.split_last()?;
        let find = |table: &'_ DeTable<'a>, key: &str| {
            table.keys().find(|found| found.get_ref() == key).map(Spanned::span)
        };
        for section in sections {
            let (_, value) = table.iter().find(|(found, _)| found.get_ref() == section)?;
            let DeValue::Table(inner) = value.get_ref() else { return None };
            table = inner;
        }
        Some(position(self.text, find(table, last)?.start).0)
    }
}

/// Line and column of a byte, from 1.
fn position(text: &str, byte: usize) -> (usize, usize) {
    let before = text.get(..byte).unwrap_or(text);
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    (before.matches('\n').count() + 1, before[line_start..].chars().count() + 1)
}

/// The TOML of a text, or every place where it is not TOML.
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
