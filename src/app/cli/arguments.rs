//! Arguments that several commands share.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::Args;
use clap::builder::{PathBufValueParser, TypedValueParser};

use super::output::print_notes;
use crate::files::ProtectedInputs;
use crate::ground::{Ground, GroundError};
use crate::pipeline::{Config, ConfigError, ConfigSource, GroupSize, MemoryLimit};
use crate::sky::Frame;
use crate::sky::fits::ReadOptions;
use crate::units::Dimension;
use crate::units::time_scales::{Tai, TimeScale};

/// A pipeline file, and settings that replace some in the file.
#[derive(Debug, Args)]
pub(super) struct PipelineArgs {
    /// Pipeline file (TOML); the embedded quicklook if none is given.
    #[arg(value_name = "PIPELINE.toml", value_parser = input_path())]
    pipeline: Option<PathBuf>,
    /// Seed of all random numbers of the space segment, in place of the file's.
    #[arg(long)]
    seed: Option<u64>,
    /// Replace one setting, for example --set map.nside=32; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Downlink format, in place of the file's: plain space packets, or coded transfer frames (CADUs).
    #[arg(long, value_name = "packets|cadu")]
    format: Option<String>,
    /// Channels to map, from 0, such as 0-4,7; by default all. The others are counted as left out.
    #[arg(long, value_name = "LIST", value_parser = channel_list)]
    channels: Option<ChannelList>,
    /// Maximum memory, by the estimate, with a unit, such as 8GB or 16GiB; by default what the machine has available.
    #[arg(long, value_name = "SIZE", value_parser = size_bytes)]
    memory_max: Option<u64>,
}

/// A pipeline file, for commands that use only its array.
#[derive(Debug, Args)]
pub(super) struct ArrayArgs {
    /// Pipeline file (TOML) that describes the array; the paper's fiducial array if none is given.
    #[arg(long, value_name = "PIPELINE.toml", value_parser = input_path())]
    pipeline: Option<PathBuf>,
    /// Replace one setting, for example --set array.inclination_deg=60; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

/// Properties of map files that lack the keyword for them.
#[derive(Clone, Copy, Debug, Args)]
pub(super) struct MapFileArgs {
    /// Frame of map files without COORDSYS: ecliptic, galactic or equatorial; without it they are refused.
    #[arg(long, value_name = "FRAME", value_parser = frame)]
    frame: Option<Frame>,
}

impl MapFileArgs {
    pub(super) fn options(self) -> ReadOptions {
        ReadOptions { frame_if_missing: self.frame, ..ReadOptions::default() }
    }
}

/// Name of standard input and output.
const STANDARD: &str = "-";

/// Parser of an input file; `-` is standard input.
pub(super) fn input_path() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().map(|path| if is_standard(&path) { PathBuf::from("/dev/stdin") } else { path })
}

/// Refuses pipes and standard input, which cannot be read twice. A missing file is reported when it is opened.
pub(super) fn require_repeatable(path: &Path, reason: &str) -> Result<(), String> {
    match std::fs::metadata(path) {
        Ok(found) if !found.is_file() => {
            Err(format!("{}: not a regular file; expected one, as {reason}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Parser of an output file or folder; `-` is refused, and what lies in the folder of a state.
pub(super) fn output_path() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| match is_standard(&path) {
        true => Err("expected a name, as this is not written to standard output; ./- is a file of that name"
            .to_owned()),
        false => outside_states(path),
    })
}

/// Parser of an output file; `-` is standard output.
pub(super) fn output_or_standard() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(outside_states)
}

/// Parser of the folder of a new state.
pub(super) fn new_state_path() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| match Ground::is_state(&path) {
        // The command says so.
        Ok(true) => Ok(path),
        _ => outside_states(path),
    })
}

/// Refuses a path in the folder of a state, where nothing but the state is written.
fn outside_states(path: PathBuf) -> Result<PathBuf, String> {
    let whole = std::path::absolute(&path).unwrap_or_else(|_| path.clone());
    let around = whole.ancestors().find(|folder| Ground::is_state(folder).unwrap_or(false));
    around.map_or(Ok(path), |state| {
        Err(format!("{} is the folder of a state; expected a name outside it", state.display()))
    })
}

/// The folder in `out` for a pipeline or study of this name. A link could lead anywhere, and is refused.
pub(super) fn default_out(name: &str) -> Result<PathBuf, String> {
    let folder = PathBuf::from("out").join(name);
    if folder.is_symlink() {
        let at = std::fs::read_link(&folder).unwrap_or_default();
        let (folder, at) = (folder.display(), at.display());
        return Err(format!(
            "{folder}: it is a link to {at}; expected a folder, or --out with the folder that is meant"
        ));
    }
    Ok(folder)
}

/// Parser of a picture to write, as PNG or SVG by its extension. Another extension is likely the name of another file.
pub(super) fn picture_path() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| {
        let is_picture = path.extension().is_some_and(|extension| {
            ["png", "svg"].iter().any(|known| extension.eq_ignore_ascii_case(known))
        });
        if is_picture {
            outside_states(path)
        } else {
            Err("expected a name that ends in .png or .svg".to_owned())
        }
    })
}

pub(super) fn is_standard(path: &Path) -> bool {
    path.as_os_str() == STANDARD
}

pub(super) fn frame(text: &str) -> Result<Frame, String> {
    Frame::from_coordsys(text).ok_or_else(|| "expected ecliptic, galactic or equatorial".to_owned())
}

/// Gains for the visibilities of downlink files.
#[derive(Debug, Args)]
pub(super) struct GainsArgs {
    /// Map file (TOML), of which only the section calibration is used; by default that of the run that made the downlink.
    #[arg(long, value_name = "MAP.toml", value_parser = input_path())]
    pub(super) map: Option<PathBuf>,
    /// Gains that `lunarray calibrate` found.
    #[arg(long, value_name = "GAINS.json")]
    calibration: Option<PathBuf>,
}

impl GainsArgs {
    /// The settings of downlink files, or of the map file if there is one.
    pub(super) fn source(&self, files: &[PathBuf]) -> ConfigSource {
        let gains = self.calibration.iter().map(|path| format!("{:?}", path.display().to_string()));
        let of_file = |file: String| {
            ["calibration.hook=antenna-gains".to_owned(), format!("calibration.gains_file={file}")]
        };
        let overrides = gains.flat_map(of_file).collect();
        ConfigSource { file: self.map.clone(), overrides, seed: None }.with_downlink_settings(files).0
    }
}

/// The map file of an existing state.
#[derive(Debug, Args)]
pub(super) struct StateMapArgs {
    /// Map file (TOML) with which the state was made; by default the settings that the state holds.
    #[arg(long, value_name = "MAP.toml", value_parser = input_path())]
    map: Option<PathBuf>,
    /// Replace one setting, for example --set map.nside=8; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

impl ArrayArgs {
    pub(super) fn inputs(&self) -> Vec<PathBuf> {
        self.pipeline.iter().cloned().collect()
    }

    pub(super) fn source(&self) -> ConfigSource {
        ConfigSource { file: self.pipeline.clone(), overrides: self.overrides.clone(), seed: None }
    }
}

impl StateMapArgs {
    /// Protects the input files from being overwritten, until the result is dropped.
    pub(super) fn protect(&self, config: &Config) -> ProtectedInputs {
        ProtectedInputs::of(self.map.iter().cloned().chain(config.input_files()))
    }

    /// The settings of the state in a folder, or of the map file if there is one.
    pub(super) fn source(&self, state: &Path) -> Result<ConfigSource, GroundError> {
        self.source_with(state, [])
    }

    /// The settings of the state's sums, or of the map file if there is one.
    pub(super) fn source_of_sums(&self, state: &Path) -> Result<ConfigSource, GroundError> {
        let overrides = self.overrides.clone();
        ConfigSource { file: self.map.clone(), overrides, seed: None }.with_sums_settings(state)
    }

    /// The settings of the state or the map file, with additional overrides.
    pub(super) fn source_with(
        &self,
        state: &Path,
        extra_overrides: impl IntoIterator<Item = String>,
    ) -> Result<ConfigSource, GroundError> {
        let overrides = self.overrides.iter().cloned().chain(extra_overrides).collect();
        ConfigSource { file: self.map.clone(), overrides, seed: None }.with_state_settings(state)
    }
}

impl PipelineArgs {
    pub(super) fn source(&self) -> ConfigSource {
        let Self { pipeline, seed, overrides, format, .. } = self;
        let format = format.iter().map(|format| format!("downlink.format={format:?}"));
        let channels = self.channels.iter().map(ChannelList::setting);
        let overrides = overrides.iter().cloned().chain(format).chain(channels).collect();
        ConfigSource { file: pipeline.clone(), overrides, seed: *seed }
    }

    /// Loads the configuration, and prints notes about adapted settings.
    pub(super) fn load(&self) -> Result<Config, ConfigError> {
        self.load_noting(true)
    }

    /// Loads the configuration; prints notes about adapted settings if `prints_notes`.
    pub(super) fn load_noting(&self, prints_notes: bool) -> Result<Config, ConfigError> {
        let mut notes = Vec::new();
        let config = self.source().load_noting(&mut notes)?;
        if prints_notes {
            print_notes(notes);
        }
        Ok(config)
    }

    /// Protects the input files from being overwritten, until the result is dropped.
    pub(super) fn protect(&self, config: &Config) -> ProtectedInputs {
        ProtectedInputs::of(self.pipeline.iter().cloned().chain(config.input_files()))
    }

    /// The memory limit: the given one, or that of the machine.
    pub(super) fn memory_limit(&self) -> Option<MemoryLimit> {
        self.memory_max.map(MemoryLimit::of_user).or_else(MemoryLimit::of_machine)
    }
}

/// Numbers of the channels to map.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ChannelList(Vec<u16>);

impl ChannelList {
    /// The list as an override of `map.channels`.
    pub(super) fn setting(&self) -> String {
        format!("map.channels={:?}", self.0)
    }
}

/// Parses a number of channels per group, or `auto`.
pub(super) fn group_size(text: &str) -> Result<GroupSize, String> {
    match (text.trim(), text.trim().parse()) {
        ("auto", _) => Ok(GroupSize::Automatic),
        (_, Ok(channels)) if channels > 0 => Ok(GroupSize::Channels(channels)),
        _ => Err("expected auto, or a number of channels above 0".into()),
    }
}

/// Parses a list of channel numbers and ranges such as `0-4,7`.
pub(super) fn channel_list(text: &str) -> Result<ChannelList, String> {
    const NUMBERS: u16 = 4096;
    let number = |text: &str| text.trim().parse::<u16>().ok().filter(|&number| number < NUMBERS);
    let range = |part: &str| match part.split_once('-') {
        Some((first, last)) => Some(number(first)?..=number(last)?).filter(|range| !range.is_empty()),
        None => number(part).map(|number| number..=number),
    };
    let ranges: Option<Vec<_>> = text.split(',').map(range).collect();
    let ranges = ranges.ok_or("expected numbers from 0 and ranges of them, such as 0-4,7")?;
    let channels: BTreeSet<u16> = ranges.into_iter().flatten().collect();
    Ok(ChannelList(channels.into_iter().collect()))
}

/// Parses a size such as `8GB`, `16GiB` or `500 MB`, to bytes; a number without a unit is in bytes.
pub(super) fn size_bytes(text: &str) -> Result<u64, String> {
    const UNITS: [(&str, f64); 9] = [
        ("KIB", 1024.0),
        ("MIB", 1_048_576.0),
        ("GIB", 1_073_741_824.0),
        ("TIB", 1_099_511_627_776.0),
        ("KB", 1e3),
        ("MB", 1e6),
        ("GB", 1e9),
        ("TB", 1e12),
        ("B", 1.0),
    ];
    let upper = text.trim().to_ascii_uppercase();
    let found = UNITS.iter().find_map(|(unit, bytes)| Some((upper.strip_suffix(unit)?, *bytes)));
    let (number, unit_bytes) = found.unwrap_or((&upper, 1.0));
    match number.trim().parse::<f64>() {
        Ok(value) if (1.0..=1e18).contains(&(value * unit_bytes)) => Ok((value * unit_bytes) as u64),
        _ => Err("expected a size such as 8GB, 16GiB or 500MB".into()),
    }
}

/// Parses a time such as `7d`, `12h`, `90s` or `90`, to seconds; at most 1e9 s of either sign.
pub(super) fn time_s(text: &str) -> Result<f64, String> {
    match Dimension::Time.parse(text)? {
        value if value.abs() <= 1e9 => Ok(value),
        _ => Err("expected at most 1e9 s".to_owned()),
    }
}

/// A mission time, given relative to the epoch or as a date.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum TimeOfMission {
    /// Time since the epoch, s.
    Since(f64),
    /// TAI since 1958-01-01, s.
    Tai(f64),
}

impl TimeOfMission {
    /// The time since an epoch, s; the epoch is TAI since 1958-01-01, s.
    pub(super) fn since_s(self, epoch_tai_s: f64) -> f64 {
        match self {
            Self::Since(time_s) => time_s,
            Self::Tai(tai_s) => tai_s - epoch_tai_s,
        }
    }
}

/// Parses a time such as `7d`, or a date such as `2027-01-08T12:00:00` (TAI) or `2027-01-08T12:00:00Z` (UTC).
pub(super) fn time_of_mission(text: &str) -> Result<TimeOfMission, String> {
    let scale = if text.ends_with('Z') { TimeScale::Utc } else { TimeScale::Tai };
    match Tai::parse(text, scale) {
        Some(time) => Ok(TimeOfMission::Tai(time.seconds_since_1958())),
        None => time_s(text).map(TimeOfMission::Since).map_err(|expected| {
            format!(
                "{expected}; or a date, TAI such as 2027-01-08T12:00:37, or UTC such as 2027-01-08T12:00:00Z"
            )
        }),
    }
}

pub(super) fn band_text([low_hz, high_hz]: [f64; 2]) -> String {
    format!("{} to {}", Dimension::Frequency.show(low_hz), Dimension::Frequency.show(high_hz))
}

/// Parses a frequency such as `3MHz` or `3e6`, to Hz.
pub(super) fn frequency_hz(text: &str) -> Result<f64, String> {
    Dimension::Frequency.parse(text)
}

/// Parses a time that is not negative, to seconds; see [`time_s`].
pub(super) fn not_negative_s(text: &str) -> Result<f64, String> {
    match time_s(text)? {
        value if value >= 0.0 => Ok(value),
        _ => Err("expected a time that is not negative".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_numbers_or_dates() {
        // 2027-01-01T00:00:00 is 69 years and 17 leap days after 1958-01-01.
        let epoch_tai_s = (69.0 * 365.0 + 17.0) * 86_400.0;
        let since = |text| time_of_mission(text).map(|time| time.since_s(epoch_tai_s));
        assert_eq!(since("1.5h"), Ok(5400.0));
        assert_eq!(since("2027-01-08T12:00:00"), Ok(7.5 * 86_400.0));
        assert_eq!(since("2026-12-31T23:59:59.5"), Ok(-0.5));
        // UTC is 37 s behind (IERS Bulletin C 52 and later).
        assert_eq!(since("2027-01-08T12:00:00Z"), Ok(7.5 * 86_400.0 + 37.0));
        for text in ["2027-02-30T00:00:00Z", "2027-02-30T00:00:00", "2027-01-08", "soon"] {
            assert!(since(text).unwrap_err().contains("or a date, TAI"), "{text}");
        }
    }

    #[test]
    fn channels_are_numbers_and_ranges() {
        let list = |text| channel_list(text).map(|list| list.setting());
        assert_eq!(list("7, 0-2").unwrap(), "map.channels=[0, 1, 2, 7]");
        assert_eq!(list("3-3,3").unwrap(), "map.channels=[3]");
        for text in ["", "a", "2-1", "1-", "-1", "1,,2", "5000", "0-70000", "1..2"] {
            assert!(list(text).is_err(), "{text}");
        }
    }

    #[test]
    fn sizes_have_units() {
        for (text, expected) in [
            ("8GB", 8_000_000_000),
            ("16GiB", 17_179_869_184),
            ("1.5 gb", 1_500_000_000),
            ("500MB", 500_000_000),
            ("2TiB", 2_199_023_255_552),
            ("4096", 4096),
            ("12B", 12),
            ("3kB", 3000),
        ] {
            assert_eq!(size_bytes(text), Ok(expected), "{text}");
        }
        for text in ["", "GB", "-1GB", "0", "NaNGB", "infB", "8 parsecs", "1e30TB", "8GBit"] {
            assert!(size_bytes(text).is_err(), "{text}");
        }
    }

    #[test]
    fn times_have_units() {
        for (text, expected_s) in
            [("7d", 604_800.0), ("1.5 h", 5400.0), ("90s", 90.0), ("90", 90.0), ("0", 0.0)]
        {
            assert_eq!((time_s(text), not_negative_s(text)), (Ok(expected_s), Ok(expected_s)));
        }
        assert_eq!(time_s("-1d"), Ok(-86_400.0));
        assert!(not_negative_s("-1d").is_err());
        for text in ["", "d", "infd", "7w", "NaN", "1e9d"] {
            assert!(time_s(text).is_err() && not_negative_s(text).is_err(), "{text}");
        }
    }
}
