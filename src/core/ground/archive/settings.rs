//! The settings on which the sums of an archive depend.

use std::path::Path;

use crate::calibration::{BurstChoice, CalibrationHook};
use crate::ground::{GroundConfig, GroundError};

/// The settings on which the sums depend, including checksums of input files.
pub(super) fn settings_of(config: &GroundConfig) -> Result<Vec<(String, String)>, GroundError> {
    let mut settings: Vec<(String, String)> =
        config.map.sum_settings().into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    settings.push(("calibration.hook".to_owned(), format!("{:?}", config.calibration.hook)));
    settings.push(("calibration.quantiser_bits".to_owned(), config.calibration.quantiser_bits.to_string()));
    settings.push(("calibration.sub_bands".to_owned(), config.calibration.sub_bands.to_string()));
    // Nothing for "off": states from before there was a choice go on.
    match config.calibration.bursts {
        BurstChoice::Off => {}
        BurstChoice::Flag => settings.push(("calibration.bursts".to_owned(), "flag".to_owned())),
        BurstChoice::Keep => settings.push(("calibration.bursts".to_owned(), "keep".to_owned())),
    }
    if let Some(path) = &config.calibration.gains_file {
        settings.push(("calibration.gains_file".to_owned(), checksum(path)?));
    }
    for (number, path) in config.map.beyond_files.iter().enumerate() {
        settings.push((format!("map.beyond_files[{number}]"), checksum(path)?));
    }
    if config.calibration.hook == CalibrationHook::Solve {
        // The JSON form of these values equals their TOML form.
        let keys = serde_json::to_value(&config.calibrate).unwrap_or_default();
        let keys = keys.as_object().into_iter().flatten().filter(|(key, _)| *key != "model_files");
        settings.extend(keys.map(|(key, value)| (format!("calibrate.{key}"), value.to_string())));
        for (number, path) in config.calibrate.model_files.iter().enumerate() {
            settings.push((format!("calibrate.model_files[{number}]"), checksum(path)?));
        }
    }
    Ok(settings)
}

fn checksum(path: &Path) -> Result<String, GroundError> {
    let bytes = std::fs::read(path).map_err(GroundError::io(path, "read"))?;
    let sum = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes);
    Ok(format!("a file of checksum {sum:016x}"))
}

/// Returns an error if a checkpoint was made with other settings.
pub(super) fn require_equal(
    path: &Path,
    found: &[(String, String)],
    expected: &[(String, String)],
) -> Result<(), GroundError> {
    let value_of = |settings: &[(String, String)], key: &str| {
        settings.iter().find(|(k, _)| k == key).map_or("(nothing)".to_owned(), |(_, value)| value.clone())
    };
    for (key, _) in expected.iter().chain(found) {
        let (found, expected) = (value_of(found, key), value_of(expected, key));
        if found != expected {
            return Err(GroundError::Settings { path: path.to_owned(), key: key.clone(), found, expected });
        }
    }
    Ok(())
}
