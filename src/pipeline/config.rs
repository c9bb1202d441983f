//! Pipeline files: parsed, overridden from the command line, and checked all at once.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::accumulation::MapConfig;
use crate::array::{Array, ArrayConfig};
use crate::calibration::{CalibrationConfig, VanVleck};
use crate::daughters::DaughtersConfig;
use crate::downlink::DownlinkConfig;
use crate::mother::{Fidelity, SpacecraftConfig};
use crate::products::ProductsConfig;
use crate::runtime::RuntimeConfig;
use crate::sky::SkyConfig;

/// What messages call the pipeline that runs when no file is named.
const QUICKLOOK_NAME: &str = "embedded quicklook";
/// The pipeline that runs when no file is named.
pub const QUICKLOOK: &str = include_str!("../../pipelines/quicklook.toml");

/// A whole pipeline: what is in the sky, what flies, and what the ground makes of it.
///
/// Sections stand in the order in which data passes. A ground segment reads `calibration`, `map`,
/// `products` and `runtime` only, and `downlink.listen` where it listens.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Name; products go to `out/NAME` unless told otherwise.
    pub name: String,
    /// Seed of everything random in the space segment.
    pub seed: u64,
    /// The sky.
    pub sky: SkyConfig,
    /// The array.
    pub array: ArrayConfig,
    /// The daughters' samples.
    pub daughters: DaughtersConfig,
    /// The spacecraft.
    pub spacecraft: SpacecraftConfig,
    /// The downlink.
    pub downlink: DownlinkConfig,
    /// Calibration.
    pub calibration: CalibrationConfig,
    /// Map making.
    pub map: MapConfig,
    /// What is written.
    pub products: ProductsConfig,
    /// Queues and threads.
    pub runtime: RuntimeConfig,
}

/// Why there is no usable configuration.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the pipeline file {}: {source}", path.display())]
    Read {
        /// Path.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, or keys and types that a pipeline does not have.
    #[error("{origin}: {source}")]
    Parse {
        /// File, or the embedded default's name.
        origin: String,
        /// Line, column and what was expected.
        source: Box<toml::de::Error>,
    },
    /// A `--set` that is not `key=value`.
    #[error("--set {0}: expected key=value, for example --set map.nside=32")]
    Override(String),
    /// A `--set` through something that is not a section.
    #[error("--set {key}: `{part}` is not a section")]
    NotASection {
        /// Whole key.
        key: String,
        /// Part of the key.
        part: String,
    },
    /// A name that cannot be a folder's.
    #[error("name = {0:?}: expected at most 60 bytes, without slashes and control characters")]
    Name(String),
    /// A ground that takes sub-bands for something else than the spacecraft.
    #[error("calibration.sub_bands = {ground}: expected spacecraft.sub_bands, which is {space}")]
    SubBands {
        /// Of the spacecraft.
        space: usize,
        /// Of the ground.
        ground: usize,
    },
    /// A correction of another quantiser than the daughters'.
    #[error(
        "calibration.quantiser_bits = {ground}: expected {expected}, as daughters.bits is {bits} and spacecraft.fidelity \
         is \"{fidelity}\""
    )]
    QuantiserBits {
        /// Of the ground.
        ground: u32,
        /// What it may be.
        expected: String,
        /// Of the daughters.
        bits: u32,
        /// Whether there are samples.
        fidelity: &'static str,
    },
    /// A key that pipelines do not have.
    #[error("{0}: no such key; pipelines/reference.toml holds all of them")]
    Unknown(String),
    /// Values that cannot be; all of them.
    #[error("{origin}: {} problem(s)\n{}", problems.len(), bullets(problems))]
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

/// Where a configuration comes from and what is laid over it.
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
    /// What messages call this source.
    #[must_use]
    pub fn origin(&self) -> String {
        self.file.as_deref().map_or_else(|| QUICKLOOK_NAME.into(), |path| path.display().to_string())
    }

    /// Reads, overrides and parses; values are not checked yet.
    ///
    /// # Errors
    /// An unreadable file, TOML errors with line and column, unknown keys, bad overrides.
    pub fn parse(&self) -> Result<Config, ConfigError> {
        match &self.file {
            Some(path) => self.parse_text(&read(path)?),
            None => self.parse_text(QUICKLOOK),
        }
    }

    /// [`Self::parse`] of a text that has been read.
    ///
    /// # Errors
    /// As [`Self::parse`].
    pub fn parse_text(&self, text: &str) -> Result<Config, ConfigError> {
        let origin = self.origin();
        let parse_error = |origin: String, table: Option<&toml::Table>, source: toml::de::Error| {
            let unknown = table.map(unknown_keys).unwrap_or_default();
            // One alone is told by the parser, which knows its line.
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
    /// As [`Self::parse`]; [`ConfigError::Values`] with everything that is wrong.
    pub fn load(&self) -> Result<Config, ConfigError> {
        let config = self.parse()?;
        refuse(self.origin(), config.problems()).map(|()| config)
    }

    /// [`Self::parse`], then the checks of the ground segment's sections. Without a file these have their defaults, which
    /// fit any downlink; the quicklook's are for its own three channels.
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

/// Things that are wrong, of any folder.
pub type Problems = Vec<Box<dyn std::error::Error + Send + Sync>>;

fn boxed<E: std::error::Error + Send + Sync + 'static>(found: Vec<E>) -> Problems {
    found.into_iter().map(|problem| Box::new(problem) as _).collect()
}

impl Config {
    /// Everything that is wrong with a whole pipeline; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Problems {
        let channels = self.spacecraft.channels_hz.len();
        let mut found = boxed(self.sky.problems(channels));
        let bad = |c: char| c.is_control() || c == '/' || c == '\\';
        if self.name.len() > 60 || self.name.contains(bad) || [".", ".."].contains(&self.name.as_str()) {
            found.push(Box::new(ConfigError::Name(self.name.clone())));
        }
        let array = self.array.problems();
        let spacecraft = self.spacecraft.problems();
        if array.is_empty() {
            match Array::new(&self.array) {
                Ok(array) if spacecraft.is_empty() => {
                    found.extend(boxed(self.spacecraft.dump_problem(&array).into_iter().collect()));
                }
                Ok(_) => {}
                Err(problem) => found.push(Box::new(problem)),
            }
        }
        found.extend(boxed(array));
        let width_hz = self.spacecraft.channel_width_hz;
        found.extend(boxed(self.daughters.problems(self.array.satellites, width_hz)));
        found.extend(boxed(spacecraft));
        found.extend(boxed(self.downlink.problems()));
        let (space, ground) = (self.spacecraft.sub_bands, self.calibration.sub_bands);
        if space != ground {
            found.push(Box::new(ConfigError::SubBands { space, ground }));
        }
        found.extend(self.quantiser_problem().map(|problem| Box::new(problem) as _));
        found.extend(boxed(self.map.misfits(channels)));
        found.extend(self.ground_problems());
        found
    }

    /// A van Vleck correction of a quantiser that the samples did not pass.
    fn quantiser_problem(&self) -> Option<ConfigError> {
        let (ground, bits) = (self.calibration.quantiser_bits, self.daughters.bits);
        let (fidelity, expected) = match self.spacecraft.fidelity {
            Fidelity::Visibilities => ("visibilities", "0".to_owned()),
            Fidelity::Samples if VanVleck::new(bits).is_ok() => {
                ("samples", format!("{bits}, or 0 for no correction"))
            }
            Fidelity::Samples => ("samples", "0".to_owned()),
        };
        let good = ground == 0 || (self.spacecraft.fidelity == Fidelity::Samples && ground == bits);
        (!good).then_some(ConfigError::QuantiserBits { ground, expected, bits, fidelity })
    }

    /// Everything that is wrong with the ground segment's sections; empty if they are good.
    #[must_use]
    pub fn ground_problems(&self) -> Problems {
        let mut found = boxed(self.downlink.listen.problems());
        found.extend(boxed(self.calibration.problems()));
        found.extend(boxed(self.map.problems()));
        found.extend(boxed(self.products.problems()));
        found.extend(boxed(self.runtime.problems()));
        found
    }

    /// A hash of what the spacecraft measures, for provenance: of the sections that shape it, and of the contents of the
    /// files that they name. What the link then does to it is not part of it: what comes through two stations, or in two
    /// formats, is the same data.
    #[must_use]
    pub fn space_hash(&self) -> u64 {
        let Self { name, seed, sky, array, daughters, spacecraft, .. } = self;
        let mut sky = sky.clone();
        sky.file = sky.file.map(|files| files.map(|path| contents(path)));
        hash(&(name, seed, sky, array, daughters, spacecraft))
    }

    /// A hash of the sections that shape maps from a downlink, and of the contents of the files that they name, for
    /// provenance.
    #[must_use]
    pub fn ground_hash(&self) -> u64 {
        let (mut calibration, mut map) = (self.calibration.clone(), self.map.clone());
        calibration.gains_file = calibration.gains_file.as_deref().map(contents);
        map.prior_files = map.prior_files.iter().map(|path| contents(path)).collect();
        hash(&(calibration, map))
    }
}

/// What stands for a file in a hash: a checksum of what is in it. A file that cannot be read stands for its name; it ends
/// the run when it is needed.
fn contents(path: &Path) -> PathBuf {
    let sum = crc_fast::checksum_file(crc_fast::CrcAlgorithm::Crc64Nvme, &path.to_string_lossy(), None);
    sum.map_or_else(|_| path.to_owned(), |sum| PathBuf::from(format!("{sum:016x}")))
}

/// The first 64 bits of a CRC over the JSON form: stable over runs, machines and field order.
fn hash(value: &impl Serialize) -> u64 {
    // Maps with string keys and finite numbers always have a JSON form.
    let text = serde_json::to_vec(value).unwrap_or_default();
    crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &text)
}

fn read(path: &Path) -> Result<String, ConfigError> {
    std::fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })
}

/// Keys that have no default because they may be absent.
const OPTIONAL_KEYS: [&str; 2] = ["sky.file", "calibration.gains_file"];

/// All keys of a table that pipelines do not have, with their sections.
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

/// Lays `key=value` over a table; a value that is not TOML is taken as a string.
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

    const REFERENCE: &str = include_str!("../../pipelines/reference.toml");

    fn with(overrides: &[&str]) -> Result<Config, ConfigError> {
        let overrides = overrides.iter().map(|&text| text.to_owned()).collect();
        ConfigSource { overrides, ..ConfigSource::default() }.parse()
    }

    #[test]
    fn the_reference_file_holds_every_key_with_its_default() {
        let written: toml::Table = toml::from_str(REFERENCE).unwrap();
        let config: Config = toml::from_str(REFERENCE).unwrap();
        assert_eq!(config, Config::default());
        let all = toml::Table::try_from(Config::default()).unwrap();
        fn same_keys(path: &str, all: &toml::Table, written: &toml::Table) {
            for (key, value) in all {
                let path = format!("{path}.{key}");
                let found = written.get(key).unwrap_or_else(|| panic!("{path} is missing"));
                if let (Some(all), Some(written)) = (value.as_table(), found.as_table()) {
                    same_keys(&path, all, written);
                }
            }
        }
        same_keys("", &all, &written);
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
        assert!(told.iter().any(|text| text.contains("map.epsilon has 3 values")), "{told:?}");
    }

    #[test]
    fn corrections_are_of_the_quantiser_that_is_there() {
        let problems = |bits: u32, ground: u32, fidelity: &str| {
            let fidelity = format!("spacecraft.fidelity={fidelity}");
            let (bits, ground) =
                (format!("daughters.bits={bits}"), format!("calibration.quantiser_bits={ground}"));
            let config = with(&[&bits, &ground, &fidelity]).unwrap();
            config.quantiser_problem().map(|problem| problem.to_string())
        };
        for good in [(1, 1), (2, 2), (4, 4), (2, 0), (8, 0), (32, 0)] {
            assert_eq!(problems(good.0, good.1, "samples"), None);
        }
        for bad in [(1, 2), (2, 4), (8, 1), (32, 4)] {
            assert!(problems(bad.0, bad.1, "samples").is_some_and(|text| text.contains("daughters.bits is")));
        }
        assert!(problems(1, 1, "visibilities").is_some_and(|text| text.contains("expected 0")));
    }

    #[test]
    fn hashes_follow_the_contents_of_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        let hashes = |name: &str| {
            let sky = format!("sky.file={:?}", path(name));
            let (prior, gains) = (format!("map.prior_files=[{:?}]", path(name)), path("gains"));
            let sky = with(&[&sky]).unwrap();
            let prior = with(&[&prior]).unwrap();
            let gains = with(&[&format!("calibration.gains_file={gains:?}")]).unwrap();
            [sky.space_hash(), prior.ground_hash(), gains.ground_hash()]
        };
        for (name, text) in [("one", "a"), ("same", "a"), ("other", "b"), ("gains", "c")] {
            std::fs::write(path(name), text).unwrap();
        }
        let first = hashes("one");
        assert_eq!(first, hashes("same"));
        let other = hashes("other");
        assert!(first[0] != other[0] && first[1] != other[1] && first[2] == other[2]);
        std::fs::write(path("gains"), "d").unwrap();
        assert_ne!(first[2], hashes("one")[2]);
        // Nothing there: the name alone.
        assert_ne!(hashes("none"), hashes("neither"));
    }

    #[test]
    fn hashes_follow_what_they_stand_for() {
        let base = with(&[]).unwrap();
        let mapped = with(&["map.nside=8"]).unwrap();
        let flown = with(&["spacecraft.thermal_noise=false"]).unwrap();
        let queued = with(&["runtime.queue_capacity=3"]).unwrap();
        assert_eq!(base.space_hash(), mapped.space_hash());
        assert_ne!(base.ground_hash(), mapped.ground_hash());
        assert_ne!(base.space_hash(), flown.space_hash());
        assert_eq!(base.ground_hash(), flown.ground_hash());
        assert_eq!((base.space_hash(), base.ground_hash()), (queued.space_hash(), queued.ground_hash()));
    }
}
