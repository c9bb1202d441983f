//! The settings that an archive is bound to.

use std::path::Path;

use crate::ground::{GroundConfig, GroundError};

/// The settings that shape sums, the contents of the gains file among them.
pub(super) fn settings_of(config: &GroundConfig) -> Result<Vec<(String, String)>, GroundError> {
    let mut settings: Vec<(String, String)> =
        config.map.of_sums().into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
    settings.push(("calibration.hook".to_owned(), format!("{:?}", config.calibration.hook)));
    settings.push(("calibration.quantiser_bits".to_owned(), config.calibration.quantiser_bits.to_string()));
    settings.push(("calibration.sub_bands".to_owned(), config.calibration.sub_bands.to_string()));
    if let Some(path) = &config.calibration.gains_file {
        let bytes = std::fs::read(path).map_err(GroundError::io(path, "read"))?;
        let sum = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes);
        settings.push(("calibration.gains_file".to_owned(), format!("a file of checksum {sum:016x}")));
    }
    Ok(settings)
}

/// Refuses a checkpoint that was made with other settings.
pub(super) fn compare(
    path: &Path,
    found: &[(String, String)],
    expected: &[(String, String)],
) -> Result<(), GroundError> {
    let of = |settings: &[(String, String)], key: &str| {
        settings.iter().find(|(k, _)| k == key).map_or("(nothing)".to_owned(), |(_, value)| value.clone())
    };
    for (key, _) in expected.iter().chain(found) {
        let (found, expected) = (of(found, key), of(expected, key));
        if found != expected {
            return Err(GroundError::Settings { path: path.to_owned(), key: key.clone(), found, expected });
        }
    }
    Ok(())
}
