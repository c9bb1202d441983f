//! The settings on which the sums of an archive depend.

use std::path::Path;

use crate::calibration::{BurstChoice, CalibrationHook};
use crate::ground::{GroundConfig, GroundError};
use crate::imaging::RegulariserChoice;

/// The settings on which the sums depend, including checksums of input files, and those that are [`REMEMBERED`].
pub(in crate::ground) fn settings_of(config: &GroundConfig) -> Result<Vec<(String, String)>, GroundError> {
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
        BurstChoice::Peel => settings.push(("calibration.bursts".to_owned(), "peel".to_owned())),
    }
    let draws = config.calibration.error_draws;
    if draws > 0 && config.calibration.hook != CalibrationHook::Identity {
        settings.push(("calibration.error_draws".to_owned(), draws.to_string()));
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
    settings.extend(remembered(config));
    Ok(settings)
}

/// Keys of how maps are made of sums. A state remembers them for sessions without a map file; sums do not depend on them.
pub const REMEMBERED: [&str; 2] = ["map.epsilon", "map.regulariser"];

/// Values of [`REMEMBERED`] as TOML. Tables of a regulariser are not remembered: their paths may lead elsewhere tomorrow.
fn remembered(config: &GroundConfig) -> impl Iterator<Item = (String, String)> {
    let epsilon = config.map.epsilon.as_ref().and_then(|epsilon| serde_json::to_string(epsilon).ok());
    let regulariser = config.map.regulariser.as_ref().and_then(|regulariser| match regulariser {
        RegulariserChoice::Data => Some("\"data\"".to_owned()),
        RegulariserChoice::Identity => Some("\"identity\"".to_owned()),
        RegulariserChoice::Degree(exponent) => Some(format!("{{ degree = {exponent:?} }}")),
        RegulariserChoice::File(_) => None,
    });
    let values = REMEMBERED.into_iter().zip([epsilon, regulariser]);
    values.filter_map(|(key, value)| Some((key.to_owned(), value?)))
}

fn checksum(path: &Path) -> Result<String, GroundError> {
    let bytes = std::fs::read(path).map_err(GroundError::io(path, "read"))?;
    let sum = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes);
    Ok(format!("a file of checksum {sum:016x}"))
}

/// Returns an error if a checkpoint was made with other settings.
pub(in crate::ground) fn require_equal(
    path: &Path,
    found: &[(String, String)],
    expected: &[(String, String)],
) -> Result<(), GroundError> {
    let value_of = |settings: &[(String, String)], key: &str| {
        settings.iter().find(|(k, _)| k == key).map_or("(nothing)".to_owned(), |(_, value)| value.clone())
    };
    let of_sums = |(key, _): &&(String, String)| !REMEMBERED.contains(&key.as_str());
    for (key, _) in expected.iter().chain(found).filter(of_sums) {
        let (found, expected) = (value_of(found, key), value_of(expected, key));
        if found != expected {
            return Err(GroundError::Settings { path: path.to_owned(), key: key.clone(), found, expected });
        }
    }
    Ok(())
}
