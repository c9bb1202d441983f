//! The settings that a ground segment uses for a downlink if the user gives none.

use std::path::PathBuf;

use super::source::{ConfigSource, QUICKLOOK};
use crate::frames::Instrument;
use crate::ground::Collector;

/// Name of the settings file among the products of `run`.
pub(in crate::pipeline) const SETTINGS: &str = "pipeline.toml";

/// Sections that decide the maps. `[runtime]` depends on the machine and changes no byte.
const SECTIONS: [&str; 3] = ["calibration", "map", "products"];

/// Where the settings of the maps are from, if the user gives no file.
#[derive(Clone, Debug, PartialEq, Eq)]
#[doc(hidden)]
pub enum SettingsOrigin {
    /// A file is given, or nothing is known of the downlink.
    Given,
    /// The pipeline that made the downlink.
    Run(String),
    /// The pipeline beside the downlink cannot be used; says which, why, and what to do.
    NotUsed(String),
}

impl ConfigSource {
    /// Adds the map settings of the pipeline that made a downlink, and returns where they are from; overrides of this source take
    /// precedence.
    ///
    /// The pipeline is `pipeline.toml` beside the first of `files`, or the quicklook, if its hash and seed of the space segment are
    /// those in the downlink. So `simulate` and `replay` make the same maps as `run`. A source with a file is returned unchanged, as is
    /// one for an unknown downlink or for a pipe, which can be read only once.
    #[must_use]
    #[doc(hidden)]
    pub fn with_downlink_settings(self, files: &[PathBuf]) -> (Self, SettingsOrigin) {
        let first = files.first().filter(|path| self.file.is_none() && path.is_file());
        // A file that cannot be read is reported when the ground segment opens it.
        let Some((path, instrument)) =
            first.and_then(|path| Some((path, Collector::instrument_of(path).ok()??)))
        else {
            return (self, SettingsOrigin::Given);
        };
        let beside = path.with_file_name(SETTINGS);
        let mut not_used = SettingsOrigin::Given;
        if beside.is_file() {
            let source = Self { file: Some(beside.clone()), ..Self::default() };
            match source.map_settings(&instrument) {
                Ok(settings) => return self.with_settings_of(&source, settings),
                Err(reason) => {
                    not_used = SettingsOrigin::NotUsed(format!(
                        "the settings in {} are not used, as {reason}. Expected a pipeline that made this downlink: \
                        choose the maps' settings with --map FILE or --set",
                        beside.display()
                    ));
                }
            }
        }
        let quicklook = Self::default();
        match quicklook.map_settings(&instrument) {
            Ok(settings) => self.with_settings_of(&quicklook, settings),
            Err(_) => (self, not_used),
        }
    }

    fn with_settings_of(mut self, source: &Self, settings: Vec<String>) -> (Self, SettingsOrigin) {
        self.overrides = settings.into_iter().chain(self.overrides).collect();
        (self, SettingsOrigin::Run(source.origin()))
    }

    /// The settings of the maps, as overrides; or why they are not those of the instrument's run.
    fn map_settings(&self, instrument: &Instrument) -> Result<Vec<String>, String> {
        let config = self.load().map_err(|error| format!("it cannot be loaded: {error}"))?;
        if (config.seed, config.space_hash()) != (instrument.seed, instrument.configuration_hash) {
            return Err("its seed or its mission is not the downlink's".to_owned());
        }
        let text = match &self.file {
            Some(path) => std::fs::read_to_string(path).map_err(|error| error.to_string())?,
            None => QUICKLOOK.to_owned(),
        };
        let table: toml::Table = toml::from_str(&text).map_err(|error| error.to_string())?;
        let keys = SECTIONS.iter().filter_map(|name| Some((name, table.get(*name)?.as_table()?)));
        let settings = keys.flat_map(|(name, section)| {
            section.iter().map(move |(key, value)| format!("{name}.{key}={value}"))
        });
        // What `auto` was for the run's orbits.
        let engine = if config.map.is_harmonic() { "harmonic" } else { "pixel" };
        Ok(settings.chain([format!("map.engine={engine}")]).collect())
    }
}
