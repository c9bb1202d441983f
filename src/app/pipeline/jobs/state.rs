//! Use of a saved state without new data: its settings, and maps of its normal equations.

use std::path::Path;

use crate::ground::archive::REMEMBERED;
use crate::ground::{Ground, GroundError, WAIT_BYTES};
use crate::imaging::{REFINED, Regulariser, RegulariserChoice};
use crate::imaging::{Samples, Solution, SolveError, SolveWatch, Solver, SolverSetup};
use crate::pipeline::config::{Config, ConfigSource, PipelineError};
use crate::runtime::{Outlet, Stage};
use crate::units::PerChannel;

impl ConfigSource {
    /// Adds the settings of the state in `folder`, so that the user need not repeat them; overrides of this source take precedence.
    /// A source with a file is returned unchanged: its settings are compared with the state later.
    ///
    /// # Errors
    /// A folder without a usable state; [`GroundError::FilesOfState`] if the state was made with a gains file or maps of the known
    /// sky that no override names, as the state holds only their checksums.
    #[doc(hidden)]
    pub fn with_state_settings(self, folder: &Path) -> Result<Self, GroundError> {
        self.with_settings(folder, Ground::settings_in)
    }

    /// Adds the settings on which the sums of the state in `folder` depend, without those of how maps were made of them.
    ///
    /// # Errors
    /// As [`ConfigSource::with_state_settings`].
    #[doc(hidden)]
    pub fn with_sums_settings(self, folder: &Path) -> Result<Self, GroundError> {
        self.with_settings(folder, |folder| {
            let settings = Ground::settings_in(folder)?.into_iter();
            Ok(settings.filter(|(key, _)| !REMEMBERED.contains(&key.as_str())).collect())
        })
    }

    /// Adds the settings of the state in `folder` without locking it, for each of several ranks before they open it.
    ///
    /// # Errors
    /// As [`ConfigSource::with_state_settings`].
    #[doc(hidden)]
    pub fn with_state_settings_for_ranks(self, folder: &Path) -> Result<Self, GroundError> {
        self.with_settings(folder, Ground::settings_for_ranks)
    }

    fn with_settings(
        mut self,
        folder: &Path,
        settings_in: impl Fn(&Path) -> Result<Vec<(String, String)>, GroundError>,
    ) -> Result<Self, GroundError> {
        if self.file.is_none() {
            let mut settings = settings_in(folder)?;
            require_files(folder, &settings, &self.overrides)?;
            // They go together: a choice of one replaces both.
            if REMEMBERED.iter().any(|key| self.overrides.iter().any(|text| sets(text, key))) {
                settings.retain(|(key, _)| !REMEMBERED.contains(&key.as_str()));
            }
            let overrides =
                settings.iter().filter_map(|(key, value)| Some(format!("{key}={}", setting_toml(value)?)));
            self.overrides = overrides.chain(std::mem::take(&mut self.overrides)).collect();
        }
        Ok(self)
    }
}

/// Requires an override for each file of which the state holds only the checksum, as it cannot be opened without them.
fn require_files(
    folder: &Path,
    settings: &[(String, String)],
    overrides: &[String],
) -> Result<(), GroundError> {
    for (key, description, expected) in [
        (
            "calibration.gains_file",
            "gains of",
            "--old-calibration FILE (recalibrate), --calibration FILE (replay) or --set calibration.gains_file=FILE (other commands)",
        ),
        (
            "map.beyond_files",
            "the sky's power beyond the maps' degrees, of",
            "--set map.beyond_files=[FILE, ...]",
        ),
        (
            "calibrate.model_files",
            "gains that were found with maps of the known sky,",
            "--set calibrate.model_files=[FILE, ...]",
        ),
    ] {
        let is_file = |(name, value): &&(String, String)| {
            name.strip_prefix(key).is_some_and(|rest| rest.is_empty() || rest.starts_with('['))
                && value.starts_with(FILE_PREFIX)
        };
        let files: Vec<&str> = settings.iter().filter(is_file).map(|(_, value)| value.as_str()).collect();
        if !files.is_empty() && !overrides.iter().any(|text| sets(text, key)) {
            let (path, found) = (folder.to_owned(), format!("{description} {}", files.join(", ")));
            return Err(GroundError::FilesOfState { path, found, expected });
        }
    }
    Ok(())
}

/// Whether an override sets a key, or the whole section.
fn sets(text: &str, key: &str) -> bool {
    let name = text.split_once('=').map_or("", |(name, _)| name.trim());
    name == key || key.split_once('.').is_some_and(|(section, _)| name == section)
}

/// Beginning of the checksum text that stands for the path of a file in a state.
const FILE_PREFIX: &str = "a file of";

/// Default limit of refinement iterations for a state of stored visibilities; `map.refine.residual_max` ends them earlier.
const REFINE_ITERATIONS_MAX: usize = 10;

/// Converts a setting of a checkpoint, in Rust's debug form (`16`, `AntennaGains`, `Limits { a: 1.0, b: 2.0 }`), to TOML; `None` for a
/// file, of which only the checksum is known.
fn setting_toml(value: &str) -> Option<String> {
    if value.starts_with(FILE_PREFIX) {
        return None;
    }
    if value == REFINED {
        return Some(REFINE_ITERATIONS_MAX.to_string());
    }
    if let Some((_, fields)) = value.split_once(" { ") {
        return Some(format!("{{ {}", fields.replace(": ", " = ")));
    }
    if !value.starts_with(|c: char| c.is_ascii_uppercase()) {
        return Some(value.to_owned());
    }
    // Enum variants are kebab case in TOML.
    let mut text = String::new();
    for (k, c) in value.char_indices() {
        if c.is_ascii_uppercase() && k > 0 {
            text.push('-');
        }
        text.push(c.to_ascii_lowercase());
    }
    Some(format!("{text:?}"))
}

/// Maps every channel of a state without new data, for each epsilon in `epsilons`, or for the configured epsilon if it is empty.
///
/// R is that of the configuration, or `epsilon W_max I` if that has no epsilon. The state is unchanged. `found` receives each map as
/// soon as it is made; `watch` reports progress and ends the solution early.
///
/// # Errors
/// A state that cannot be read or was made with other settings; a solution that fails.
pub fn solve_state(
    folder: &Path,
    config: &Config,
    epsilons: &[f64],
    watch: &SolveWatch,
    found: &mut dyn FnMut(Solution),
) -> Result<(), PipelineError> {
    let choices = match epsilons {
        [] => vec![config.map.epsilon()],
        epsilons => epsilons.iter().map(|&epsilon| PerChannel::All(epsilon)).collect(),
    };
    for epsilon in choices {
        let mut setup = SolverSetup { epsilon, ..config.solver(watch.clone())? };
        if !epsilons.is_empty() && config.map.regulariser() == RegulariserChoice::Data {
            // R from the data has no epsilon.
            setup.regularisers = vec![Regulariser::default()];
        }
        // Solving consumes the sums, so they are read again for each epsilon.
        solve_sums(folder, config, setup, found)?;
    }
    Ok(())
}

/// Maps every channel of a state, with `samples` from the posterior; R is estimated from the data. The state is unchanged.
///
/// # Errors
/// As [`solve_state`]; [`crate::imaging::SolveError::Interrupted`] after the channels that were finished when `watch` was cancelled.
pub fn sample_state(
    folder: &Path,
    config: &Config,
    samples: Samples,
    watch: &SolveWatch,
    found: &mut dyn FnMut(Solution),
) -> Result<(), PipelineError> {
    let setup = SolverSetup { samples, ..config.solver(watch.clone())? };
    solve_sums(folder, config, setup, found)
}

/// Reads the sums of a state, and solves for the map of every channel.
fn solve_sums(
    folder: &Path,
    config: &Config,
    setup: SolverSetup,
    found: &mut dyn FnMut(Solution),
) -> Result<(), PipelineError> {
    let sums = Ground::sums_in(folder, &config.ground(WAIT_BYTES))?;
    let watch = setup.watch.clone();
    let mut solver = Solver::new(setup);
    for snapshot in sums {
        let mut out = Outlet::collect();
        let solved = solver.step(snapshot, &mut out);
        // A solution that was cut short may also fail.
        if watch.is_cancelled() {
            return Err(SolveError::Interrupted.into());
        }
        solved?;
        out.into_vec().into_iter().for_each(&mut *found);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::{CalibrationConfig, CalibrationHook};
    use crate::imaging::{EngineKind, MapConfig, RefineConfig};
    use crate::response::harmonic::GeometryLimits;
    use crate::response::pixel::PixelMethod;

    #[test]
    fn settings_of_a_state_are_read_back() {
        let calibration =
            CalibrationConfig { quantiser_bits: 2, sub_bands: 1, ..CalibrationConfig::default() };
        let pixel = MapConfig {
            nside: 4,
            engine: EngineKind::Pixel,
            rows: PixelMethod::AverageExact,
            weight_max: 2e-9,
            ..MapConfig::default()
        };
        let limits = GeometryLimits { altitude_m_max: 1e-3, ..GeometryLimits::default() };
        let harmonic = MapConfig { engine: EngineKind::Harmonic, l_max: 7, limits, ..MapConfig::default() };
        let refine = RefineConfig { passes_max: REFINE_ITERATIONS_MAX, ..RefineConfig::default() };
        let refined = MapConfig { refine, ..harmonic.clone() };
        for map in [pixel, harmonic, refined] {
            let mut overrides: Vec<String> = map
                .sum_settings()
                .iter()
                .filter_map(|(key, value)| Some(format!("{key}={}", setting_toml(value)?)))
                .collect();
            overrides.push(format!("calibration.quantiser_bits={}", calibration.quantiser_bits));
            let config = ConfigSource { overrides, ..ConfigSource::default() }.load_ground().unwrap();
            assert_eq!((config.map, config.calibration), (map, calibration.clone()));
        }
        let hook = setting_toml(&format!("{:?}", CalibrationHook::AntennaGains));
        assert_eq!(hook.as_deref(), Some("\"antenna-gains\""));
        assert_eq!(setting_toml("a file of checksum 0123"), None);
    }
}
