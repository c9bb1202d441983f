//! The settings of the maps that belong to a downlink, for a ground that is told none.

use std::path::PathBuf;

use super::config_source::{ConfigSource, QUICKLOOK};
use super::run::SETTINGS;
use crate::frames::Instrument;
use crate::ground::Collector;

/// Sections that decide what maps are made. Those of the runtime change no byte, and are the machine's.
const SECTIONS: [&str; 3] = ["calibration", "map", "products"];

impl ConfigSource {
    /// This source with the settings of the maps that `run` makes of the same data, before its own overrides, and where they are
    /// from: `pipeline.toml` beside the first of `files`, or the quicklook, if the downlink carries the hash and the seed of its
    /// space segment. Only without a file; otherwise, and of a downlink that nobody knows, this source as it is.
    ///
    /// So `simulate` and `replay` give the maps of `run` when none of them is told anything. Only ordinary files are looked at: what
    /// is read from a pipe is gone.
    #[must_use]
    #[doc(hidden)]
    pub fn of_downlink(mut self, files: &[PathBuf]) -> (Self, Option<String>) {
        let first = files.first().filter(|path| self.file.is_none() && path.is_file());
        // A file that cannot be read is told when the ground reads it.
        let Some((path, instrument)) =
            first.and_then(|path| Some((path, Collector::instrument_of(path).ok()??)))
        else {
            return (self, None);
        };
        let beside = path.with_file_name(SETTINGS);
        let known = [Self { file: Some(beside), ..Self::default() }, Self::default()];
        let Some((from, settings)) =
            known.iter().find_map(|source| Some((source.origin(), source.map_settings(&instrument)?)))
        else {
            return (self, None);
        };
        self.overrides = settings.into_iter().chain(self.overrides).collect();
        (self, Some(from))
    }

    /// The settings of the maps, as overrides, if the spacecraft is that of the instrument.
    fn map_settings(&self, instrument: &Instrument) -> Option<Vec<String>> {
        let config = self.load().ok()?;
        if (config.seed, config.space_hash()) != (instrument.seed, instrument.configuration_hash) {
            return None;
        }
        let text = match &self.file {
            Some(path) => std::fs::read_to_string(path).ok()?,
            None => QUICKLOOK.to_owned(),
        };
        let table: toml::Table = toml::from_str(&text).ok()?;
        let keys = SECTIONS.iter().filter_map(|name| Some((name, table.get(*name)?.as_table()?)));
        let settings = keys.flat_map(|(name, section)| {
            section.iter().map(move |(key, value)| format!("{name}.{key}={value}"))
        });
        Some(settings.collect())
    }
}
