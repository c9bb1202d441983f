//! Where a configuration comes from: a file or the embedded default, and overrides from the command line.

use std::path::{Path, PathBuf};

use thiserror::Error;

use super::config::{Config, Problems};
use crate::units::{echo, echo_lines};

/// Name of the default pipeline in messages.
const QUICKLOOK_NAME: &str = "embedded quicklook";
/// The default pipeline, which runs when no file is named.
pub const QUICKLOOK: &str = include_str!("../../pipelines/quicklook.toml");

/// Why there is no usable configuration.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the pipeline file {}: {source}", path.display())]
    Read {
        /// Path.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Not TOML, or unknown keys or wrong types.
    #[error("{}: {}", echo(origin), echo_lines(source))]
    Parse {
        /// File, or the embedded default's name.
        origin: String,
        /// Line, column and what was expected.
        source: Box<toml::de::Error>,
    },
    /// A `--set` that is not `key=value`.
    #[error("--set {}: expected key=value, for example --set map.nside=32", echo(.0))]
    Override(String),
    /// A `--set` with a key below one that is not a section.
    #[error("--set {}: `{}` is not a section", echo(key), echo(part))]
    NotASection {
        /// Whole key.
        key: String,
        /// Part of the key.
        part: String,
    },
    /// An unknown key.
    #[error("{}: no such key; pipelines/reference.toml holds all of them", echo(.0))]
    Unknown(String),
    /// Invalid values; all of them.
    #[error("{}: {} problem(s)\n{}", echo(origin), problems.len(), bullets(problems))]
    Values {
        /// File, or the embedded default's name.
        origin: String,
        /// What is wrong.
        problems: Vec<Box<dyn std::error::Error + Send + Sync>>,
    },
}

fn bullets(problems: &[Box<dyn std::error::Error + Send + Sync>]) -> String {
    problems.iter().map(|problem| format!("  - {problem}")).collect::<Vec<_>>().join("\n")
}

/// Where a configuration comes from, and overrides of it.
#[derive(Clone, Debug, Default)]
pub struct ConfigSource {
    /// Pipeline file; `None` for the embedded quicklook.
    pub file: Option<PathBuf>,
    /// `key=value` overrides, in order.
    pub overrides: Vec<String>,
    /// Seed that replaces the file's.
    pub seed: Option<u64>,
}

impl ConfigSource {
    /// Name of this source in messages.
    #[must_use]
    pub fn origin(&self) -> String {
        self.file.as_deref().map_or_else(|| QUICKLOOK_NAME.into(), |path| path.display().to_string())
    }

    /// Reads the file, applies the overrides and parses; does not check values.
    ///
    /// # Errors
    /// An unreadable file, TOML errors with line and column, unknown keys, bad overrides.
    pub fn parse(&self) -> Result<Config, ConfigError> {
        match &self.file {
            Some(path) => self.parse_text(&read(path)?),
            None => self.parse_text(QUICKLOOK),
        }
    }

    /// As [`Self::parse`], with this text instead of the file.
    ///
    /// # Errors
    /// As [`Self::parse`].
    pub fn parse_text(&self, text: &str) -> Result<Config, ConfigError> {
        let origin = self.origin();
        let parse_error = |origin: String, table: Option<&toml::Table>, source: toml::de::Error| {
            let unknown = table.map(unknown_keys).unwrap_or_default();
            // A single one is reported by the parser, which knows its line.
            if unknown.len() > 1 {
                let problems = unknown.into_iter().map(|key| Box::new(ConfigError::Unknown(key)) as _);
                return ConfigError::Values { origin, problems: problems.collect() };
            }
            ConfigError::Parse { origin, source: Box::new(source) }
        };
        // Straight from the text first: these errors know their line.
        let mut config: Config = toml::from_str(text)
            .map_err(|source| parse_error(origin.clone(), toml::from_str(text).ok().as_ref(), source))?;
        if !self.overrides.is_empty() {
            let mut table: toml::Table =
                toml::from_str(text).map_err(|source| parse_error(origin, None, source))?;
            for text in &self.overrides {
                set(&mut table, text)?;
            }
            let origin = format!("--set {}", self.overrides.join(" --set "));
            config = table.clone().try_into().map_err(|source| parse_error(origin, Some(&table), source))?;
        }
        if let Some(seed) = self.seed {
            config.seed = seed;
        }
        if config.name.is_empty() {
            config.name = self.default_name();
        }
        Ok(config)
    }

    fn default_name(&self) -> String {
        let stem = self.file.as_deref().and_then(Path::file_stem);
        stem.map_or_else(|| "lunarray".into(), |stem| stem.to_string_lossy().into_owned())
    }

    /// [`Self::parse`], then every check of a whole pipeline.
    ///
    /// # Errors
    /// As [`Self::parse`]; [`ConfigError::Values`] with all invalid values.
    pub fn load(&self) -> Result<Config, ConfigError> {
        let config = self.parse()?;
        refuse(self.origin(), config.problems()).map(|()| config)
    }

    /// [`Self::parse`], then the checks of the sections of the ground segment. Without a file these have their defaults,
    /// which fit any downlink; those of the quicklook are for its own three channels.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_ground(&self) -> Result<Config, ConfigError> {
        let (config, origin) = match &self.file {
            Some(_) => (self.parse()?, self.origin()),
            None => (self.parse_text("")?, "default settings".to_owned()),
        };
        refuse(origin, config.ground_problems()).map(|()| config)
    }
}

fn refuse(origin: String, problems: Problems) -> Result<(), ConfigError> {
    if problems.is_empty() { Ok(()) } else { Err(ConfigError::Values { origin, problems }) }
}

fn read(path: &Path) -> Result<String, ConfigError> {
    std::fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })
}

/// Keys that have no default because they may be absent.
const OPTIONAL_KEYS: [&str; 2] = ["sky.file", "calibration.gains_file"];

/// All unknown keys of a table, with their sections.
fn unknown_keys(table: &toml::Table) -> Vec<String> {
    fn walk(prefix: &str, table: &toml::Table, known: &toml::Table, found: &mut Vec<String>) {
        for (key, value) in table {
            let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
            match (known.get(key), value) {
                (Some(toml::Value::Table(known)), toml::Value::Table(table)) => {
                    walk(&path, table, known, found);
                }
                (Some(_), _) => {}
                (None, _) if OPTIONAL_KEYS.contains(&path.as_str()) => {}
                (None, _) => found.push(path),
            }
        }
    }
    let mut found = Vec::new();
    // The default configuration always has a TOML form: the reference file's test relies on it too.
    let known = toml::Table::try_from(Config::default()).unwrap_or_default();
    walk("", table, &known, &mut found);
    found
}

/// Sets `key=value` in a table; a value that is not TOML is a string.
fn set(table: &mut toml::Table, text: &str) -> Result<(), ConfigError> {
    let (key, value) = text.split_once('=').ok_or_else(|| ConfigError::Override(text.to_owned()))?;
    let key = key.trim();
    let parsed = toml::from_str::<toml::Table>(&format!("value = {value}"));
    let value = parsed
        .ok()
        .and_then(|mut table| table.remove("value"))
        .unwrap_or_else(|| toml::Value::String(value.trim().to_owned()));
    let (sections, last) = key.rsplit_once('.').map_or(("", key), |(head, last)| (head, last));
    if last.is_empty() {
        return Err(ConfigError::Override(text.to_owned()));
    }
    let mut here = table;
    for part in sections.split('.').filter(|part| !part.is_empty()) {
        let next = here.entry(part).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        here = next
            .as_table_mut()
            .ok_or_else(|| ConfigError::NotASection { key: key.to_owned(), part: part.to_owned() })?;
    }
    here.insert(last.to_owned(), value);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::accumulation::MapConfig;

    fn with(overrides: &[&str]) -> Result<Config, ConfigError> {
        let overrides = overrides.iter().map(|&text| text.to_owned()).collect();
        ConfigSource { overrides, ..ConfigSource::default() }.parse()
    }

    #[test]
    fn the_embedded_pipeline_is_good() {
        assert!(ConfigSource::default().load().is_ok());
    }

    #[test]
    fn overrides_reach_every_depth() {
        let config = with(&["map.nside=8", "seed=5", "array.breathing.ratio=2.0", "sky.file=some/map.fits"]);
        let config = config.unwrap();
        assert_eq!((config.map.nside, config.seed, config.array.breathing.ratio), (8, 5, 2.0));
        assert_eq!(config.sky.file.unwrap().get(0), Some(PathBuf::from("some/map.fits")));
        assert!(matches!(with(&["map.nside"]), Err(ConfigError::Override(_))));
        assert!(matches!(with(&["seed.more=1"]), Err(ConfigError::NotASection { .. })));
        let unknown = with(&["map.nsides=8"]).unwrap_err().to_string();
        assert!(unknown.contains("nsides"), "{unknown}");
    }

    #[test]
    fn messages_stay_short_whatever_the_file_holds() {
        let long = "7".repeat(10_000_000);
        let texts = [
            format!("[map]\nepsilon = \"{long}\""),
            format!("[map]\nepsilon = {long}"),
            format!("[map]\nnside = [{long}"),
            format!("k{long} = 1\nm{long} = 2"),
            format!("[map]\nepsilon = 1{}", "0".repeat(300)),
        ];
        for text in texts {
            let source = ConfigSource::default();
            let told =
                source.parse_text(&text).map(|config| config.problems()).map_err(|error| error.to_string());
            let told = told.unwrap_or_else(|error| vec![error.into()]);
            let told: Vec<String> = told.iter().map(ToString::to_string).collect();
            // Room for the keys of a section.
            assert!(!told.is_empty() && told.iter().all(|text| text.len() < 4000), "{}", told.concat().len());
        }
        let told = with(&["map.epsilon=text"]).unwrap_err().to_string();
        assert!(told.contains("\"text\"") && !told.contains("untagged"), "{told}");
        assert!(with(&[&long]).unwrap_err().to_string().len() < 300);
    }

    #[test]
    fn unknown_keys_are_told_all_at_once() {
        let told = with(&["map.nsides=8", "sky.fil=x", "map.nside=8", "seeds=1"]).unwrap_err().to_string();
        for key in ["map.nsides", "sky.fil:", "seeds"] {
            assert!(told.contains(key), "{key} is not in {told}");
        }
        assert!(!told.contains("map.nside:"), "{told}");
    }

    #[test]
    fn a_ground_without_a_file_takes_any_number_of_channels() {
        let config = ConfigSource::default().load_ground().unwrap();
        assert_eq!((config.map, config.name.as_str()), (MapConfig::default(), "lunarray"));
        let told = with(&["spacecraft.channels_hz=[3e6]"]).unwrap().problems();
        let told: Vec<String> = told.iter().map(ToString::to_string).collect();
        assert!(told.iter().any(|text| text.contains("map.epsilon = (3 values)")), "{told:?}");
    }
}
