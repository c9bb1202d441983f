//! Maps of the sky at the frequency of a channel, and outlines of map files.

use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::error::{FitsError, FitsProblem};
use super::metadata::{StatedFrequency, check_quoted, is_other_quantity, is_same_hz};
use super::read::{MapFile, ReadOptions, read_frequency, read_notes, read_whole_map_file};
use crate::sky::{Frame, MapError, MapFrequency, SkyConfig, SkyMap};
use crate::units::{Dimension, echo};

/// Least mean of a sky of which something can be known, K.
const MEAN_K_MIN: f64 = 1e-16;

/// Channel for which a sky is read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SkyChannel {
    /// Centre frequency, Hz.
    pub frequency_hz: f64,
    /// Whether a sky without power is accepted, because the receivers have noise.
    pub is_dark_accepted: bool,
    /// Whether one file serves several channels, and so has to state its frequency.
    pub is_file_shared: bool,
}

/// Outline of a map file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MapOutline {
    /// Path of the file.
    pub file: PathBuf,
    /// Frame of the map.
    pub frame: Frame,
    /// Whether the frame is assumed, because the file does not state it.
    pub frame_assumed: bool,
    /// Frequency of the map, Hz; `None` if the file does not state it.
    pub frequency_hz: Option<f64>,
    /// Unit (TUNIT); empty if not stated, which means K.
    pub unit: String,
    /// Name of the column; may be empty.
    pub column: String,
    /// Number of map columns in the table.
    pub columns: usize,
    /// Order of the pixels in the file, and whether it is assumed.
    pub ordering: &'static str,
    /// HEALPix nside.
    pub nside: usize,
    /// Side of a pixel, degrees.
    pub pixel_deg: f64,
    /// Maximum degree that the pixels determine well.
    pub l_max: usize,
    /// Number of pixels without a value (NaN, infinite, UNSEEN or BAD_DATA); 0, as a map with any is refused.
    pub bad_pixels: usize,
    /// Mean, minimum and maximum value, K.
    pub mean_min_max_k: [f64; 3],
}

impl MapOutline {
    /// Reads the outline of a channel's map, or of the first map.
    ///
    /// # Errors
    /// As [`super::read_whole_map`].
    pub fn read(path: &Path, options: &ReadOptions) -> Result<Self, FitsError> {
        let file = read_whole_map_file(path, options)?;
        let (nside, values) = (file.map.nside(), file.map.values());
        let (min_k, max_k) =
            values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(min_k, max_k), &value| {
                (min_k.min(value), max_k.max(value))
            });
        Ok(Self {
            file: path.to_owned(),
            frame: file.map.frame(),
            frame_assumed: file.frame_assumed,
            frequency_hz: file.frequency_hz,
            unit: file.unit.clone(),
            column: file.name.clone(),
            columns: file.columns,
            ordering: file.ordering,
            nside,
            pixel_deg: (41_252.961_249_419_27 / values.len() as f64).sqrt(),
            l_max: SkyConfig::l_max_determined(nside),
            bad_pixels: 0,
            mean_min_max_k: [values.iter().sum::<f64>() / values.len() as f64, min_k, max_k],
        })
    }
}

impl fmt::Display for MapOutline {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let frequency = match self.frequency_hz {
            Some(hz) => Dimension::Frequency.show(hz),
            None => "no frequency (FREQ)".to_owned(),
        };
        let frame = if self.frame_assumed { " (as configured)" } else { "" };
        let unit = if self.unit.is_empty() { "no unit, taken as K" } else { &self.unit };
        let column = match self.columns {
            0 | 1 => String::new(),
            columns => format!(", column `{}` of {columns}", self.column),
        };
        let [mean, min_k, max_k] = self.mean_min_max_k;
        write!(
            f,
            "{}: {frequency}, {} frame{frame}, {unit}{column}, nside {} in {} (pixels of {:.2} deg, l up to {}), {} bad pixels, mean {mean:.4e} \
             K, {min_k:.3e} K to {max_k:.3e} K",
            self.file.display(),
            self.frame,
            self.nside,
            self.ordering,
            self.pixel_deg,
            self.l_max,
            self.bad_pixels
        )
    }
}

/// Returns the options for reading the map files of a sky for a channel at `frequency_hz`.
#[must_use]
pub fn sky_options(config: &SkyConfig, frequency_hz: f64) -> ReadOptions {
    ReadOptions { frame_if_missing: config.frame, frequency_hz: Some(frequency_hz), column: config.column }
}

/// Reads the map of a sky, in K, for a channel. Every pixel must be a temperature, and the mean 1e-16 or more unless the sky may be dark.
///
/// FREQ, or the name of the column, states the frequency of a map. A map of another frequency is refused, or scaled by
/// a power law, as `config` says. A map that states no frequency is used unchanged if it serves only this channel, and cannot be scaled.
///
/// # Errors
/// As [`super::read_whole_map`]; [`FitsProblem::Keyword`] or [`FitsProblem::Missing`] for FREQ;
/// [`MapError::NoTemperature`], [`MapError::Dark`].
pub fn read_sky(path: &Path, channel: &SkyChannel, config: &SkyConfig) -> Result<SkyMap, FitsError> {
    let map = read_at(path, channel, config)?;
    match mean_k(path, &map)? {
        value if value < MEAN_K_MIN && !channel.is_dark_accepted => {
            Err(FitsError::new(path, MapError::Dark { value }.into()))
        }
        _ => Ok(map),
    }
}

/// Notes on the map of a sky for a channel: assumptions about its metadata ([`read_notes`]), and temperatures below 0 K.
///
/// # Errors
/// As [`read_sky`].
pub fn sky_notes(path: &Path, channel: &SkyChannel, config: &SkyConfig) -> Result<Vec<String>, FitsError> {
    let mut notes = read_notes(path, &sky_options(config, channel.frequency_hz))?;
    let map = read_at(path, channel, config)?;
    let below: Vec<f64> = map.values().iter().copied().filter(|value| *value < 0.0).collect();
    if let Some(least) = below.iter().copied().reduce(f64::min) {
        let (count, total) = (below.len(), map.values().len());
        notes.push(format!(
            "{count} of {total} pixels are below 0 K, down to {least:.4e} K, and count as temperatures: if that means bad pixels, \
             say so in the header (BAD_DATA), and fill them"
        ));
    }
    Ok(notes)
}

/// Reads the map of the sky model for calibration, in K. Every pixel must be a temperature, and the mean 1e-16 or more. When the channel
/// is known, [`check_frequency`] compares the frequency.
///
/// # Errors
/// As [`super::read_whole_map`]; [`MapError::NoTemperature`], [`MapError::NothingKnown`].
pub fn read_known_sky(path: &Path, options: &ReadOptions) -> Result<SkyMap, FitsError> {
    let map = read_temperatures(path, options)?.map;
    match mean_k(path, &map)? {
        value if value < MEAN_K_MIN => Err(FitsError::new(path, MapError::NothingKnown { value }.into())),
        _ => Ok(map),
    }
}

/// Reads a prior map, in K, with the metadata of its file. Every pixel must be a temperature.
///
/// # Errors
/// As [`super::read_whole_map`]; [`MapError::NoTemperature`].
pub fn read_prior(path: &Path, options: &ReadOptions) -> Result<MapFile, FitsError> {
    let file = read_temperatures(path, options)?;
    mean_k(path, &file.map).map(|_| file)
}

/// Reads a whole map of which the name of the column does not say that it is something else.
fn read_temperatures(path: &Path, options: &ReadOptions) -> Result<MapFile, FitsError> {
    let file = read_whole_map_file(path, options)?;
    if is_other_quantity(&file.name) {
        let expected = "the name of a map of the sky's temperature, such as TEMPERATURE or T_10MHz";
        return Err(FitsError::new(path, FitsProblem::keyword("TTYPEn", echo(&file.name), expected)));
    }
    Ok(file)
}

/// Requires that the frequency of a map is `frequency_hz`, if the map states one, or if its header names only one. Reads only headers.
///
/// # Errors
/// [`FitsError`] for a file that cannot be read; [`FitsProblem::Keyword`] for the frequency.
pub fn check_frequency(path: &Path, frequency_hz: f64, options: &ReadOptions) -> Result<(), FitsError> {
    let checked = match read_frequency(path, options)? {
        (Some(found), _) if is_same_hz(found.hz, frequency_hz) => Ok(()),
        (Some(found), _) => Err(other_frequency(&found, frequency_hz, "")),
        (None, quoted) => check_quoted(&quoted, frequency_hz),
    };
    checked.map_err(|problem| FitsError::new(path, problem))
}

/// Checks the frequencies of maps ([`check_frequency`]) if there is one per channel; other numbers of maps are refused elsewhere.
///
/// # Errors
/// As [`check_frequency`].
pub fn check_frequencies<P: AsRef<Path>>(paths: &[P], channels_hz: &[f64]) -> Result<(), FitsError> {
    let options = ReadOptions::default();
    match paths.len() == channels_hz.len() {
        true => {
            let mut pairs = paths.iter().zip(channels_hz);
            pairs.try_for_each(|(path, &hz)| check_frequency(path.as_ref(), hz, &options))
        }
        false => Ok(()),
    }
}

/// Checks that a map has temperatures, and returns their mean, K.
fn mean_k(path: &Path, map: &SkyMap) -> Result<f64, FitsError> {
    map.check_temperatures().map_err(|problem| FitsError::new(path, problem.into()))?;
    Ok(map.values().iter().sum::<f64>() / map.values().len() as f64)
}

/// Problem of a map whose frequency differs from the channel's; `otherwise` is what the user can do instead of giving another map.
fn other_frequency(of_map: &StatedFrequency, frequency_hz: f64, otherwise: &str) -> FitsProblem {
    let [found, expected] = [of_map.hz, frequency_hz].map(|hz| Dimension::Frequency.show(hz));
    let expected = format!("{expected}, the channel's: give a map of that frequency{otherwise}");
    FitsProblem::keyword(&of_map.keyword, found, expected)
}

/// Reads a map and converts it to the channel's frequency.
fn read_at(path: &Path, channel: &SkyChannel, config: &SkyConfig) -> Result<SkyMap, FitsError> {
    let (rule, wanted_hz) = (config.frequency, channel.frequency_hz);
    let options = sky_options(config, wanted_hz);
    let MapFile { mut map, frequency_hz, frequency_keyword, quoted, .. } = read_temperatures(path, &options)?;
    let refuse = |problem| FitsError::new(path, problem);
    let Some(map_hz) = frequency_hz else {
        let expected = match rule {
            MapFrequency::SpectralIndex(_) => {
                "the map's frequency, Hz, for sky.frequency = { spectral_index = .. } to scale from"
            }
            MapFrequency::MustMatch if channel.is_file_shared => {
                "the map's frequency, Hz, as sky.file is one map for several channels: add the keyword, or give one map per channel"
            }
            MapFrequency::MustMatch => return check_quoted(&quoted, wanted_hz).map(|()| map).map_err(refuse),
        };
        return Err(refuse(FitsProblem::missing("FREQ", expected)));
    };
    match rule {
        _ if is_same_hz(map_hz, wanted_hz) => Ok(map),
        MapFrequency::MustMatch => {
            let otherwise = ", or have it scaled by sky.frequency = { spectral_index = -2.5 }";
            let of_map = StatedFrequency { hz: map_hz, keyword: frequency_keyword };
            Err(refuse(other_frequency(&of_map, wanted_hz, otherwise)))
        }
        MapFrequency::SpectralIndex(index) => {
            let factor = (wanted_hz / map_hz).powf(index);
            map.values_mut().iter_mut().for_each(|value| *value *= factor);
            Ok(map)
        }
    }
}
