//! Sources of a configuration: a file or the embedded default, and overrides from the command line.

use std::io::Read;
use std::path::{Path, PathBuf};

use super::channel_lists;
use super::effects::is_of_strength_zero;
use super::error::{ConfigError, FILE_BYTES_MAX};
use super::problems::Problems;
use super::quantities::read_units;
use super::reader::{KeyLocator, PartialConfig, parse_table};
use super::sections::Config;
use super::settings_path::apply_override;
use crate::runtime::RuntimeConfig;

const QUICKLOOK_NAME: &str = "embedded quicklook";
/// The default pipeline, which is used if no file is named.
pub const QUICKLOOK: &str = include_str!("quicklook.toml");

/// Source of a configuration: a pipeline file and overrides.
#[derive(Clone, Debug, Default)]
pub struct ConfigSource {
    /// Pipeline file; `None` for the embedded quicklook.
    pub file: Option<PathBuf>,
    /// `key=value` overrides, in order.
    pub overrides: Vec<String>,
    /// Seed that replaces the one in the file.
    pub seed: Option<u64>,
}

impl ConfigSource {
    /// Name of this source in messages.
    #[must_use]
    #[doc(hidden)]
    pub fn origin(&self) -> String {
        self.file.as_deref().map_or_else(|| QUICKLOOK_NAME.into(), |path| path.display().to_string())
    }

    /// Reads the file and applies the overrides, without checking values.
    ///
    /// # Errors
    /// An unreadable file; all syntax errors, unknown keys, wrong types and invalid overrides.
    #[doc(hidden)]
    pub fn parse(&self) -> Result<Config, ConfigError> {
        self.parse_text(&self.text()?)
    }

    /// Parses `text` in place of the file, and applies the overrides, without checking values.
    ///
    /// # Errors
    /// As [`Self::parse`].
    #[doc(hidden)]
    pub fn parse_text(&self, text: &str) -> Result<Config, ConfigError> {
        self.checked_noting(text, self.origin(), (true, &|_| Problems::default()), &mut Vec::new())
    }

    fn text(&self) -> Result<String, ConfigError> {
        match &self.file {
            Some(path) => read(path),
            None => Ok(QUICKLOOK.to_owned()),
        }
    }

    fn default_name(&self) -> String {
        let stem = self.file.as_deref().and_then(Path::file_stem);
        stem.map_or_else(|| "lunarray".into(), |stem| stem.to_string_lossy().into_owned())
    }

    /// Reads the file, applies the overrides and checks the values of a whole pipeline.
    ///
    /// # Errors
    /// As [`Self::parse`]; invalid values. All problems are reported together.
    pub fn load(&self) -> Result<Config, ConfigError> {
        self.load_noting(&mut Vec::new())
    }

    /// Loads the configuration as [`Self::load`] does, and adds a note for each list that was adapted because an override changes the
    /// channels.
    ///
    /// # Errors
    /// As [`Self::load`].
    #[doc(hidden)]
    pub fn load_noting(&self, notes: &mut Vec<String>) -> Result<Config, ConfigError> {
        self.checked_noting(&self.text()?, self.origin(), (true, &Config::problems), notes)
    }

    /// Reads the file, applies the overrides and checks the values of the ground segment.
    ///
    /// Without a file the keys have their defaults, which fit any downlink; the quicklook's values fit only its three channels.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_ground(&self) -> Result<Config, ConfigError> {
        match &self.file {
            Some(_) => self.checked_ground(&self.text()?, self.origin()),
            None => self.checked_ground("", "default settings".to_owned()),
        }
    }

    fn checked_ground(&self, text: &str, origin: String) -> Result<Config, ConfigError> {
        self.checked_noting(text, origin, (false, &Config::ground_problems), &mut Vec::new())
    }

    /// Parses `text`, applies the overrides and requires that neither parsing nor the check of values finds a problem, of a whole pipeline or
    /// of a ground segment.
    fn checked_noting(
        &self,
        text: &str,
        origin: String,
        (is_whole, value_problems): (bool, &dyn Fn(&Config) -> Problems),
        notes: &mut Vec<String>,
    ) -> Result<Config, ConfigError> {
        let mut table = match parse_table(text) {
            Ok(table) => table,
            Err(problems) => return Err(ConfigError::Values { origin, problems }),
        };
        if let Some((path, key)) = self.file.as_ref().zip(study_key(&table)) {
            return Err(ConfigError::Study { path: path.clone(), key });
        }
        read_units(&mut table);
        let mut locator = KeyLocator::new(text);
        let mut override_problems = Vec::new();
        let channels_hz = channel_lists::channels_hz(&table);
        let mut keys = Vec::new();
        for text in &self.overrides {
            match apply_override(&mut table, text) {
                Ok(key) => {
                    locator.add_override(key, text);
                    keys.push(key);
                }
                Err(error) => override_problems.push(error),
            }
        }
        read_units(&mut table);
        notes.extend(drop_replaced(&mut table, &keys));
        channel_lists::wrap_single_channel(&mut table);
        if let Some(before) = channels_hz {
            notes.extend(channel_lists::adapt_lists(&mut table, &before, |key| keys.contains(&key)));
        }
        let mut partial = PartialConfig::new(table.clone(), &locator);
        if let Some(seed) = self.seed {
            partial.config.seed = seed;
        }
        if partial.config.name.is_empty() {
            partial.config.name = self.default_name();
        }
        start_threads(&partial.config.runtime);
        // A map file without a space segment, or no file, does not know the orbits.
        let knows_orbits =
            is_whole || ["array", "sky", "spacecraft"].iter().any(|name| table.contains_key(*name));
        partial.config.choose_engine(knows_orbits);
        let found = value_problems(&partial.config).without(|problem| is_of_strength_zero(problem, &table));
        let problems = partial.all_problems(found, override_problems);
        match problems.is_empty() {
            true => Ok(partial.config),
            false => Err(ConfigError::Values { origin, problems }),
        }
    }
}

/// Top-level keys that only studies have.
const STUDY_KEYS: [&str; 6] = ["realisations", "calibrated", "covariance_at_deg", "model", "pipeline", "set"];

pub(in crate::pipeline) fn has_sections(table: &toml::Table) -> bool {
    ["array", "map", "sky", "spacecraft"].iter().any(|section| table.contains_key(*section))
}

/// A key that shows that a table is a study; `None` for a pipeline.
pub(in crate::pipeline) fn study_key(table: &toml::Table) -> Option<&'static str> {
    if table.get("axis").is_some_and(toml::Value::is_array) {
        return Some("[[axis]]");
    }
    STUDY_KEYS.into_iter().find(|key| table.contains_key(*key)).filter(|_| !has_sections(table))
}

fn read(path: &Path) -> Result<String, ConfigError> {
    let failed = |source| ConfigError::Read { path: path.to_owned(), source };
    let file = std::fs::File::open(path).map_err(failed)?;
    let mut bytes = Vec::new();
    file.take(FILE_BYTES_MAX + 1).read_to_end(&mut bytes).map_err(failed)?;
    let is_long = bytes.len() as u64 > FILE_BYTES_MAX;
    // In a long file, the last character that was read may be incomplete.
    let is_truncated_text = |error: std::str::Utf8Error| is_long && error.error_len().is_none();
    match String::from_utf8(bytes) {
        Err(error) if !is_truncated_text(error.utf8_error()) => {
            let text = &error.as_bytes()[..error.utf8_error().valid_up_to()];
            let line = 1 + text.iter().filter(|byte| **byte == b'\n').count();
            Err(ConfigError::NotText { path: path.to_owned(), line })
        }
        Ok(text) if !is_long => Ok(text),
        _ => Err(ConfigError::TooLong { path: path.to_owned() }),
    }
}

/// Keys of which an override replaces others of the same section: those that the file sets are left out, as both together would be an
/// error.
const REPLACING: [(&str, &str, &[&str]); 4] = [
    ("spacecraft", "thin", &["every_nth_window", "every_nth_integration"]),
    ("spacecraft", "every_nth_window", &["thin"]),
    ("spacecraft", "every_nth_integration", &["thin"]),
    ("sky", "file", &["nside", "generated"]),
];

/// Leaves out the keys of a file that the overrides `keys` replace; a note on each.
fn drop_replaced(table: &mut toml::Table, keys: &[&str]) -> Vec<String> {
    let mut notes = Vec::new();
    for (section, by, others) in
        REPLACING.iter().filter(|(section, by, _)| keys.contains(&&*format!("{section}.{by}")))
    {
        let Some(found) = table.get_mut(*section).and_then(toml::Value::as_table_mut) else { continue };
        // A stride of 1 leaves nothing out, and `sky.added` uses what generates a sky.
        if found.get(*by).and_then(toml::Value::as_integer) == Some(1) || found.contains_key("added") {
            continue;
        }
        for other in *others {
            let name = format!("{section}.{other}");
            let is_set = keys.iter().any(|key| {
                key.strip_prefix(&*name).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
            });
            if !is_set && found.remove(*other).is_some() {
                notes.push(format!("{name}: left out, as --set {section}.{by} replaces it"));
            }
        }
    }
    notes
}

/// Starts the worker threads that a configuration asks for, as its checks use them already. The first configuration of a process decides:
/// [`crate::pipeline::use_threads`] refuses another number, and numbers that cannot be.
fn start_threads(config: &RuntimeConfig) {
    if config.threads != 0 && config.problems().is_empty() {
        let _ = rayon::ThreadPoolBuilder::new().num_threads(config.threads).build_global();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::{EngineKind, MapConfig};

    fn with(overrides: &[&str]) -> Result<Config, ConfigError> {
        let overrides = overrides.iter().map(|&text| text.to_owned()).collect();
        ConfigSource { overrides, ..ConfigSource::default() }.parse()
    }

    #[test]
    fn the_embedded_pipeline_is_valid() {
        assert!(ConfigSource::default().load().is_ok());
    }

    #[test]
    fn an_override_replaces_the_other_way_of_the_file() {
        let strides = |set: &[&str]| {
            let found = with(set).unwrap().spacecraft;
            (found.thin, found.every_nth_window, found.every_nth_integration.values().to_vec())
        };
        assert_eq!(strides(&["spacecraft.thin=10"]), (10, 1, vec![1]));
        assert_eq!(strides(&["spacecraft.thin=1"]), (1, 41, vec![8, 4, 1]));
        let text = "[spacecraft]\nthin = 10\n[sky]\nnside = 8\ngenerated.loops = false\n";
        let of_text = |set: &str| {
            let source = ConfigSource { overrides: vec![set.to_owned()], ..ConfigSource::default() };
            source.parse_text(text).unwrap()
        };
        assert_eq!(of_text("spacecraft.every_nth_window=3").spacecraft.thin, 1);
        assert_eq!(of_text("spacecraft.every_nth_window=1").spacecraft.thin, 10);
        assert_eq!(of_text("sky.file='a.fits'").sky.nside, 64);
        assert!(of_text("sky.file='a.fits'").sky.generated.loops);
        // Of two that are given together none is taken for a slip.
        let both = ["spacecraft.thin=10", "spacecraft.every_nth_window=3"];
        let overrides = both.map(str::to_owned).to_vec();
        let said = ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap_err().to_string();
        assert!(said.contains("spacecraft.thin = 10: expected 1, or every_nth_window = 1"), "{said}");
        let mut notes = Vec::new();
        let overrides = vec!["spacecraft.thin=10".to_owned()];
        ConfigSource { overrides, ..ConfigSource::default() }.load_noting(&mut notes).unwrap();
        assert!(notes.iter().any(|note| note.contains("every_nth_window: left out")), "{notes:?}");
    }

    /// The default pipeline is for any orbits: its engine is one that they allow.
    #[test]
    fn the_embedded_pipeline_takes_any_orbits() {
        let cases: [(&[&str], EngineKind); 6] = [
            (&[], EngineKind::Harmonic),
            // Keys that only pixels have, and positions that calibration moves off the circle.
            (&["map.matrix='free'"], EngineKind::Pixel),
            (&["calibrate.position_sigma_m=10"], EngineKind::Pixel),
            (&["array.eccentricity=0.01"], EngineKind::Pixel),
            (&["array.cross_track_ratio=0.1"], EngineKind::Pixel),
            (&["array.eccentricity=0.01", "map.refine.passes_max=3"], EngineKind::Harmonic),
        ];
        for (overrides, engine) in cases {
            let overrides = overrides.iter().map(|&text| text.to_owned()).collect();
            let config = ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap();
            assert_eq!(config.map.engine, engine, "{config:?}");
        }
    }

    #[test]
    fn overrides_reach_every_depth() {
        let config = with(&["map.nside=8", "seed=5", "array.breathing.ratio=2.0", "sky.file=some/map.fits"]);
        let config = config.unwrap();
        assert_eq!((config.map.nside, config.seed, config.array.breathing.ratio), (8, 5, 2.0));
        assert_eq!(config.sky.file.unwrap().get(0), Some(PathBuf::from("some/map.fits")));
        for (bad, part) in [
            ("map.nside", "expected key=value"),
            ("=8", "expected key=value"),
            ("seed.more=1", "--set seed.more: `seed` is a number, not a section"),
            (
                "map.epsilon[0]=1",
                "--set map.epsilon[0]: `epsilon[0]` is no element: the file has no such list",
            ),
            ("array.kepler[0].eccentricity=0.1", "`kepler[0]` is no element: the file has no such list"),
            ("seed[0]=1", "--set seed[0]: `seed[0]` is no element: this is a number, not a list"),
            ("spacecraft.channels_hz[3]=1e6", "`channels_hz[3]` is no element: the list has [0] to [2]"),
            ("spacecraft.channels_hz[0].low=1e6", "`channels_hz[0]` is a number, not a section"),
            (
                "map.nsides=8",
                "--set map.nsides=8: map.nsides: no such key; did you mean nside? [map] has antennas, ",
            ),
            ("a.b.c.d.e.f.g.h.i.j=1", "expected key=value"),
        ] {
            let told = with(&["seed=5", bad]).unwrap_err().to_string();
            assert!(told.contains(part), "{bad}: {told}");
        }
    }

    /// The problems of a text with overrides, as lines.
    fn told(text: &str, overrides: &[&str]) -> Vec<String> {
        let overrides = overrides.iter().map(|&text| text.to_owned()).collect();
        let source = ConfigSource { overrides, ..ConfigSource::default() };
        let error = source
            .checked_noting(text, "here".to_owned(), (true, &Config::problems), &mut Vec::new())
            .unwrap_err()
            .to_string();
        error.lines().map(str::to_owned).collect()
    }

    #[test]
    fn an_old_value_is_refused_with_its_new_name() {
        for (before, now) in [("held", "stored"), ("remade", "free")] {
            let told = told("", &[&format!("map.matrix={before}")]);
            assert!(
                told[1].ends_with(&format!("map.matrix: \"{before}\" was renamed to \"{now}\"")),
                "{told:?}"
            );
            assert!(with(&[&format!("map.matrix={now}")]).is_ok());
        }
    }

    #[test]
    fn unknown_keys_wrong_types_and_invalid_values_are_reported_together() {
        let text = "sed = 1\n[map]\nnside = \"big\"\nepsilon = -1.0\nl_maxx = 3\n\n[sat]\na = 1\nb = 2\n[spacecraft]\n\
                    duration_s = -3\nninth = 9\n[sky]\nfile = 7\nnside = 7\n[products]\npictures = 1";
        let found = told(text, &["map.weight_max=lots", "runtime.threads", "spacecraft.antenna=\"dish\""]);
        let expected = [
            "here: 13 problem(s)",
            "--set runtime.threads: expected key=value",
            "line 5: map.l_maxx: no such key; did you mean l_max? [map] has",
            "line 3: map.nside: invalid type: string \"big\", expected a whole number, not negative",
            "--set map.weight_max=lots: map.weight_max: invalid type: string \"lots\", expected a number",
            "line 17: products.pictures: invalid type: integer `1`, expected a boolean",
            "line 7: sat: no such key; a pipeline has",
            "line 1: sed: no such key; did you mean seed? a pipeline has",
            "line 14: sky.file: expected one value, or a list with one for each channel",
            "--set spacecraft.antenna=\"dish\": spacecraft.antenna: unknown variant `dish`, expected one of `isotropic`",
            "line 12: spacecraft.ninth: found one value (integer), expected a section",
            "sky.nside = 7: expected a power of two",
            "spacecraft.duration_s = -3: expected seconds",
            "map.epsilon = -1: expected 1e-16 to 1",
        ];
        for expected in expected {
            assert!(found.iter().any(|line| line.contains(expected)), "{expected} is not in {found:#?}");
        }
        assert_eq!(found.len(), expected.len(), "{found:#?}");
    }

    #[test]
    fn consequences_of_an_unreadable_value_are_not_reported() {
        // Lists that fit the unreadable channels, and a correction that fits the unreadable quantiser.
        let text = "[spacecraft]\nchannels_hz = [1e6, \"two MHz\"]\nevery_nth_integration = [1, 1]\nfidelity = \"samples\"\n\
                    [daughters]\nbits = \"two\"\n[calibration]\nquantiser_bits = 2\n[map]\nepsilon = [1e-4, 1e-4]\n\
                    [array]\nsatellites = \"four\"\n[instrument.amplitude]\nconstant = [0.1, 0.1, 0.1, 0.1]\n";
        let found = told(text, &[]);
        assert_eq!(found.len(), 4, "{found:#?}");
        for key in ["array.satellites: ", "daughters.bits: ", "spacecraft.channels_hz: "] {
            assert!(found.iter().any(|line| line.contains(key)), "{key} is not in {found:#?}");
        }
    }

    #[test]
    fn values_may_have_units() {
        let text = "[spacecraft]\nchannels_hz = [\"1MHz\", 3e6]\nduration_s = \"30d\"\n[array]\naltitude_m = \"300km\"\n";
        let load = |text: &str, overrides: &[&str]| {
            let overrides = overrides.iter().map(|&text| text.to_owned()).collect();
            ConfigSource { overrides, ..ConfigSource::default() }.parse_text(text)
        };
        let config = load(text, &["map.snapshot_every_s=12h", "array.inclination_deg=90arcmin"]).unwrap();
        assert_eq!(config.spacecraft.channels_hz, [1e6, 3e6]);
        assert_eq!((config.spacecraft.duration_s, config.array.altitude_m), (2_592_000.0, 300e3));
        assert_eq!((config.map.snapshot_every_s, config.array.inclination_deg), (43_200.0, 1.5));
        let config =
            load("", &["spacecraft.channels_hz=[3MHz, 10 MHz]", "spacecraft.window_s_max=5min"]).unwrap();
        assert_eq!((config.spacecraft.channels_hz, config.spacecraft.window_s_max), (vec![3e6, 10e6], 300.0));
        let config = load("", &["calibrate.clock_sigma_ns=1us", "calibrate.position_sigma_m=1km"]).unwrap();
        assert_eq!((config.calibrate.clock_sigma_ns, config.calibrate.position_sigma_m), (1e3, 1e3));
        // Messages name the units that a key accepts, and what was found.
        for (bad, part) in [
            (
                "array.altitude_m=300MHz",
                "array.altitude_m: invalid type: string \"300MHz\", expected a number of metres, or one with m or km",
            ),
            (
                "spacecraft.channels_hz=[3MHz, 3m]",
                "channels_hz: invalid type: string \"3m\", expected a number of Hz, or one with Hz, kHz, MHz or GHz",
            ),
            (
                "spacecraft.channels_hz=3m",
                "string \"3m\", expected a list; a value is a number of Hz, or one with Hz",
            ),
            ("calibrate.clock_sigma_ns=1km", "expected a number of nanoseconds, or one with ns, us, ms or s"),
        ] {
            let told = load("", &[bad]).unwrap_err().to_string();
            assert!(told.contains(part), "{bad}: {told}");
        }
        // Texts with other units, or at keys without a unit, have the wrong type.
        for bad in ["spacecraft.duration_s=3MHz", "map.nside=16m", "spacecraft.channels_hz=[3MHz, 1d]"] {
            let told = load("", &[bad]).unwrap_err().to_string();
            assert!(told.contains("invalid type: string"), "{bad}: {told}");
        }
    }

    #[test]
    fn one_frequency_is_one_channel() {
        for text in ["3MHz", "3e6", "3_000_000", "[3MHz]"] {
            let config = with(&[&format!("spacecraft.channels_hz={text}")]).unwrap();
            assert_eq!(config.spacecraft.channels_hz, [3e6], "{text}");
        }
        let told = with(&["spacecraft.channels_hz=lots"]).unwrap_err().to_string();
        assert!(
            told.contains("spacecraft.channels_hz: invalid type: string \"lots\", expected a list"),
            "{told}"
        );
    }

    #[test]
    fn values_follow_the_nearest_channel() {
        let load = |overrides: &[&str]| {
            let overrides = overrides.iter().map(|&text| text.to_owned()).collect();
            let mut notes = Vec::new();
            let config = ConfigSource { overrides, ..ConfigSource::default() }.load_noting(&mut notes);
            config.map(|config| (config, notes))
        };
        // The quicklook has 1, 3 and 10 MHz with every 8th, 4th and single integration.
        let (config, notes) = load(&["spacecraft.channels_hz=[5e6, 29e6]"]).unwrap();
        assert_eq!(config.spacecraft.every_nth_integration.values(), [4, 1]);
        assert_eq!(notes.len(), 1, "{notes:?}");
        assert!(
            notes
                .iter()
                .any(|note| note
                    .starts_with("spacecraft.every_nth_integration = [4, 1]: values of the nearest")),
            "{notes:?}"
        );
        // Lists that are set by overrides are not adapted, even if their length is wrong.
        let (config, notes) = load(&["map.epsilon=0.1", "spacecraft.channels_hz=[5e6]"]).unwrap();
        assert_eq!((config.map.epsilon().get(0), notes.len()), (Some(0.1), 1));
        let (_, notes) = load(&["map.epsilon=0.1"]).unwrap();
        assert!(notes.is_empty());
        assert!(load(&["spacecraft.channels_hz=[5e6]", "map.epsilon=[0.1, 0.1]"]).is_err());
    }

    #[test]
    fn syntax_errors_are_reported_with_line_and_column() {
        let found = told("seed = 1\n[map\nnside = 3\n", &[]);
        assert!(found[1].contains("line 2, column 5: "), "{found:?}");
        let long = format!("seed = 1\nname = {}", "x".repeat(100_000));
        assert!(told(&long, &[]).iter().all(|line| line.len() < 300));
    }

    #[test]
    fn many_problems_are_counted_and_some_shown() {
        let keys: String = (0..50_000).map(|k| format!("k{k} = 1\n")).collect();
        let found = told(&keys, &[]);
        assert_eq!((found.len(), found[0].as_str()), (22, "here: 50000 problem(s)"));
        assert_eq!(found[21], "  and 49980 more");
        let list = |value: &str| format!("[{}]", vec![value; 100_000].join(", "));
        let text = format!(
            "[spacecraft]\nchannels_hz = {0}\nevery_nth_integration = {1}\nbaseline_wavelengths_max = {0}\ndelay_centre_deg = {0}\n\
             [map]\nepsilon = {0}\nprior_k = {0}\n[instrument.amplitude]\nconstant = {0}\n",
            list("-1.0"),
            list("0")
        );
        let found = told(&text, &[]);
        assert!(found.len() < 20 && found.iter().all(|line| line.len() < 300), "{found:#?}");
        assert!(found.iter().any(|line| line.contains("channels_hz = (100000 channels): expected 1 to 30")));
    }

    #[test]
    fn a_long_file_is_not_read_whole() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("long.toml");
        std::fs::write(&path, "# comment\n".repeat(200_000)).unwrap();
        let source = ConfigSource { file: Some(path), ..ConfigSource::default() };
        assert!(matches!(source.load(), Err(ConfigError::TooLong { .. })));
    }

    #[test]
    fn a_ground_without_a_file_takes_any_number_of_channels() {
        let config = ConfigSource::default().load_ground().unwrap();
        // Of any orbits.
        let map = MapConfig { engine: EngineKind::Pixel, ..MapConfig::default() };
        assert_eq!((config.map, config.name.as_str()), (map, "lunarray"));
        let told =
            with(&["spacecraft.channels_hz=[3e6]", "map.epsilon=[1e-4, 1e-6, 1e-4]"]).unwrap().problems();
        let told: Vec<String> = told.iter().map(ToString::to_string).collect();
        assert!(told.iter().any(|text| text.contains("map.epsilon = (3 values)")), "{told:?}");
    }
}
