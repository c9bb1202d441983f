//! The settings that a ground segment uses for a downlink if the user gives none.

use std::path::PathBuf;

use super::source::{ConfigSource, QUICKLOOK};
use crate::frames::Instrument;
use crate::ground::Collector;

/// Name of the settings file among the products of `run`.
pub(in crate::pipeline) const SETTINGS: &str = "pipeline.toml";

/// Sections that decide the maps. `[runtime]` depends on the machine and changes no byte.
const SECTIONS: [&str; 3] = ["calibration", "map", "products"];

impl ConfigSource {
    /// Adds the map settings of the pipeline that made a downlink, and returns where they are from; overrides of this source take
    /// precedence.
    ///
    /// The pipeline is `pipeline.toml` beside the first of `files`, or the quicklook, if its hash and seed of the space segment are
    /// those in the downlink. So `simulate` and `replay` make the same maps as `run`. A source with a file is returned unchanged, as is
    /// one for an unknown downlink or for a pipe, which can be read only once.
    #[must_use]
    #[doc(hidden)]
    pub fn with_downlink_settings(mut self, files: &[PathBuf]) -> (Self, Option<String>) {
        let first = files.first().filter(|path| self.file.is_none() && path.is_file());
        // A file that cannot be read is reported when the ground segment opens it.
        let Some((path, instrument)) =
            first.and_then(|path| Some((path, Collector::instrument_of(path).ok()??)))
        else {
            return (self, None);
        };
        let beside = path.with_file_name(SETTINGS);
        let candidates = [Self { file: Some(beside), ..Self::default() }, Self::default()];
        let Some((origin, settings)) =
            candidates.iter().find_map(|source| Some((source.origin(), source.map_settings(&instrument)?)))
        else {
            return (self, None);
        };
        self.overrides = settings.into_iter().chain(self.overrides).collect();
        (self, Some(origin))
    }

    /// The settings of the maps, as overrides; `None` if the instrument is of another space segment.
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
