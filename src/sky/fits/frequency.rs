//! Maps of the sky at the frequency of a channel.

use std::path::Path;

use super::error::{FitsError, FitsProblem};
use super::read::{MapFile, ReadOptions, read_whole_map_file};
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
    let refuse = |problem: MapError| FitsError::new(path, problem.into());
    map.check_temperatures().map_err(refuse)?;
    let mean_k = map.values().iter().sum::<f64>() / map.values().len() as f64;
    if mean_k <= 0.0 && !may_be_dark {
        return Err(refuse(MapError::Dark { value: mean_k }));
    }
    Ok(map)
}

/// The map at the channel's frequency.
fn read_at(path: &Path, frequency_hz: f64, config: &SkyConfig) -> Result<SkyMap, FitsError> {
    let rule = config.frequency;
    let options = ReadOptions { frame_if_missing: config.frame, ..ReadOptions::default() };
    let MapFile { mut map, header, .. } = read_whole_map_file(path, &options)?;
    let refuse = |problem| FitsError::new(path, problem);
    let scales = matches!(rule, MapFrequency::SpectralIndex(_));
    let Some(found) = header.get("FREQ") else {
        let expected = "the map's frequency, Hz, for sky.frequency = { spectral_index = .. } to scale from";
        return if scales { Err(refuse(FitsProblem::missing("FREQ", expected))) } else { Ok(map) };
    };
    let map_hz = header.real("FREQ").filter(|map_hz| map_hz.is_finite() && *map_hz > 0.0);
    let Some(map_hz) = map_hz else {
        return Err(refuse(FitsProblem::keyword("FREQ", found, "a positive number, Hz")));
    };
    match rule {
        _ if (map_hz - frequency_hz).abs() <= SAME * frequency_hz => Ok(map),
        MapFrequency::MustMatch => {
            let expected = format!(
                "{}, the channel's: give a map of that frequency, or have it scaled by \
                 sky.frequency = {{ spectral_index = -2.5 }}",
                Dimension::Frequency.show(frequency_hz)
            );
            Err(refuse(FitsProblem::keyword("FREQ", Dimension::Frequency.show(map_hz), expected)))
        }
        MapFrequency::SpectralIndex(index) => {
            let factor = (frequency_hz / map_hz).powf(index);
            map.values_mut().iter_mut().for_each(|value| *value *= factor);
            Ok(map)
        }
    }
}
