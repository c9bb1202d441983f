//! Maps of the sky at the frequency of a channel.

use std::path::Path;

use super::error::{FitsError, FitsProblem};
use super::header::Header;
use super::read::{MapFile, ReadOptions, read_header, read_whole_map, read_whole_map_file};
use crate::sky::{MapError, MapFrequency, SkyConfig, SkyMap};
use crate::units::Dimension;

/// Relative difference up to which two frequencies are the same: a digit lost in a header.
const SAME: f64 = 1e-6;

/// Reads the map of a sky, in K, for a channel at `frequency_hz`: temperatures in every pixel, of a mean above 0 unless
/// `may_be_dark`.
///
/// A map says by FREQ (Hz) for which frequency it holds. One of another frequency is refused, or scaled by a power law, as
/// `config` says. One without FREQ is taken as it is, but cannot be scaled.
///
/// # Errors
/// As [`super::read_whole_map`]; [`FitsProblem::Keyword`] or [`FitsProblem::Missing`] for FREQ;
/// [`MapError::NoTemperature`], [`MapError::Dark`].
pub fn read_sky(
    path: &Path,
    frequency_hz: f64,
    config: &SkyConfig,
    may_be_dark: bool,
) -> Result<SkyMap, FitsError> {
    let map = read_at(path, frequency_hz, config)?;
    match mean_k(path, &map)? {
        value if value <= 0.0 && !may_be_dark => Err(FitsError::new(path, MapError::Dark { value }.into())),
        _ => Ok(map),
    }
}

/// Reads the map of a known sky, in K, to calibrate with: temperatures in every pixel, of a mean above 0. Its frequency is
/// compared by [`check_frequency`] when the channel is known.
///
/// # Errors
/// As [`super::read_whole_map`]; [`MapError::NoTemperature`], [`MapError::NothingKnown`].
pub fn read_known_sky(path: &Path, options: &ReadOptions) -> Result<SkyMap, FitsError> {
    let map = read_whole_map(path, options)?;
    match mean_k(path, &map)? {
        value if value <= 0.0 => Err(FitsError::new(path, MapError::NothingKnown { value }.into())),
        _ => Ok(map),
    }
}

/// Requires that a map is of a channel at `frequency_hz`, if it says by FREQ (Hz) of which frequency it is. Reads only headers.
///
/// # Errors
/// A file that cannot be read; [`FitsProblem::Keyword`] for FREQ.
pub fn check_frequency(path: &Path, frequency_hz: f64) -> Result<(), FitsError> {
    let header = read_header(path)?;
    match map_hz(&header).map_err(|problem| FitsError::new(path, problem))? {
        Some(map_hz) if !is_same(map_hz, frequency_hz) => {
            Err(FitsError::new(path, other_frequency(map_hz, frequency_hz, "")))
        }
        _ => Ok(()),
    }
}

/// [`check_frequency`] of one map a channel; of another number of maps, which others refuse, of none.
///
/// # Errors
/// As [`check_frequency`].
pub fn check_frequencies<P: AsRef<Path>>(paths: &[P], channels_hz: &[f64]) -> Result<(), FitsError> {
    match paths.len() == channels_hz.len() {
        true => paths.iter().zip(channels_hz).try_for_each(|(path, &hz)| check_frequency(path.as_ref(), hz)),
        false => Ok(()),
    }
}

/// Mean of a map of temperatures, K.
fn mean_k(path: &Path, map: &SkyMap) -> Result<f64, FitsError> {
    map.check_temperatures().map_err(|problem| FitsError::new(path, problem.into()))?;
    Ok(map.values().iter().sum::<f64>() / map.values().len() as f64)
}

/// FREQ of a map, if it has one.
fn map_hz(header: &Header) -> Result<Option<f64>, FitsProblem> {
    let Some(found) = header.get("FREQ") else { return Ok(None) };
    let map_hz = header.real("FREQ").filter(|map_hz| map_hz.is_finite() && *map_hz > 0.0);
    map_hz.map(Some).ok_or_else(|| FitsProblem::keyword("FREQ", found, "a positive number, Hz"))
}

fn is_same(map_hz: f64, frequency_hz: f64) -> bool {
    (map_hz - frequency_hz).abs() <= SAME * frequency_hz
}

/// A map of another frequency than the channel's; `otherwise` is what can be done besides giving another map.
fn other_frequency(map_hz: f64, frequency_hz: f64, otherwise: &str) -> FitsProblem {
    let [found, expected] = [map_hz, frequency_hz].map(|hz| Dimension::Frequency.show(hz));
    let expected = format!("{expected}, the channel's: give a map of that frequency{otherwise}");
    FitsProblem::keyword("FREQ", found, expected)
}

/// The map at the channel's frequency.
fn read_at(path: &Path, frequency_hz: f64, config: &SkyConfig) -> Result<SkyMap, FitsError> {
    let rule = config.frequency;
    let options = ReadOptions { frame_if_missing: config.frame, ..ReadOptions::default() };
    let MapFile { mut map, header, .. } = read_whole_map_file(path, &options)?;
    let refuse = |problem| FitsError::new(path, problem);
    let scales = matches!(rule, MapFrequency::SpectralIndex(_));
    let Some(map_hz) = map_hz(&header).map_err(refuse)? else {
        let expected = "the map's frequency, Hz, for sky.frequency = { spectral_index = .. } to scale from";
        return if scales { Err(refuse(FitsProblem::missing("FREQ", expected))) } else { Ok(map) };
    };
    match rule {
        _ if is_same(map_hz, frequency_hz) => Ok(map),
        MapFrequency::MustMatch => {
            let otherwise = ", or have it scaled by sky.frequency = { spectral_index = -2.5 }";
            Err(refuse(other_frequency(map_hz, frequency_hz, otherwise)))
        }
        MapFrequency::SpectralIndex(index) => {
            let factor = (frequency_hz / map_hz).powf(index);
            map.values_mut().iter_mut().for_each(|value| *value *= factor);
            Ok(map)
        }
    }
}
