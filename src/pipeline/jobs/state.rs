//! A state on its own: the settings that it was made with, and maps of its sums without new data.

use std::path::Path;

use crate::ground::{Ground, GroundError, WAIT_BYTES};
use crate::imaging::joint::{JointChannel, JointRequest, JointSolution, solve_jointly};
use crate::imaging::{REFINED, Regulariser, RegulariserChoice, SnapshotData, SolveError, StoppingRule};
use crate::imaging::{Solution, SolveWatch, Solver, SolverSetup};
use crate::pipeline::config::{Config, ConfigSource, PipelineError};
use crate::runtime::{Outlet, Stage};
use crate::units::PerChannel;

impl ConfigSource {
    /// This source with the settings of the state in `folder` before its own overrides, so that the state can be used without
    /// naming them again. Only without a file: what a file says stands, and is compared with the state.
    ///
    /// # Errors
    /// A folder without a usable state; [`GroundError::FilesOfState`] where the state was made with gains of a file, or maps of
    /// the known sky, that no override names: it holds only their checksums.
    #[doc(hidden)]
    pub fn of_state(self, folder: &Path) -> Result<Self, GroundError> {
        self.of_settings(folder, Ground::settings_in)
    }

    /// As [`ConfigSource::of_state`], for each of several ranks before they open the folder.
    ///
    /// # Errors
    /// Likewise.
    #[doc(hidden)]
    pub fn of_state_for_ranks(self, folder: &Path) -> Result<Self, GroundError> {
        self.of_settings(folder, Ground::settings_for_ranks)
    }

    fn of_settings(
        mut self,
        folder: &Path,
        settings_in: impl Fn(&Path) -> Result<Vec<(String, String)>, GroundError>,
    ) -> Result<Self, GroundError> {
        if self.file.is_none() {
            let settings = settings_in(folder)?;
            require_files(folder, &settings, &self.overrides)?;
            let overrides =
                settings.iter().filter_map(|(key, value)| Some(format!("{key}={}", toml_of(value)?)));
            self.overrides = overrides.chain(std::mem::take(&mut self.overrides)).collect();
        }
        Ok(self)
    }
}

/// Requires that files whose checksums a state holds are named: without them it cannot be opened.
fn require_files(
    folder: &Path,
    settings: &[(String, String)],
    overrides: &[String],
) -> Result<(), GroundError> {
    for (key, what, expected) in [
        (
            "calibration.gains_file",
            "gains of",
            "--old-calibration FILE (recalibrate), --calibration FILE (replay) or --set calibration.gains_file=FILE (other commands)",
        ),
        (
            "calibrate.model_files",
            "gains that were found with maps of the known sky,",
            "--set calibrate.model_files=[FILE, ...]",
        ),
    ] {
        let is_of = |(name, value): &&(String, String)| {
            name.strip_prefix(key).is_some_and(|rest| rest.is_empty() || rest.starts_with('['))
                && value.starts_with(A_FILE)
        };
        let files: Vec<&str> = settings.iter().filter(is_of).map(|(_, value)| value.as_str()).collect();
        // A section may be set as a whole.
        let names = |text: &String| {
            let set = text.split_once('=').map_or("", |(set, _)| set.trim());
            set == key || key.split_once('.').is_some_and(|(section, _)| set == section)
        };
        if !files.is_empty() && !overrides.iter().any(names) {
            let (path, found) = (folder.to_owned(), format!("{what} {}", files.join(", ")));
            return Err(GroundError::FilesOfState { path, found, expected });
        }
    }
    Ok(())
}

/// How the checksum of a file begins, which stands for its path in a state.
const A_FILE: &str = "a file of";

/// Passes of a map from a state that holds visibilities one by one, if nobody says how many: `map.refine.residual_max` ends them.
const PASSES_MAX: usize = 10;

/// A setting as a checkpoint has it (Rust's debug form: `16`, `AntennaGains`, `Limits { a: 1.0, b: 2.0 }`) as a value of TOML;
/// `None` for a file: only its checksum is known.
fn toml_of(value: &str) -> Option<String> {
    if value.starts_with(A_FILE) {
        return None;
    }
    if value == REFINED {
        return Some(PASSES_MAX.to_string());
    }
    if let Some((_, fields)) = value.split_once(" { ") {
        return Some(format!("{{ {}", fields.replace(": ", " = ")));
    }
    if !value.starts_with(|c: char| c.is_ascii_uppercase()) {
        return Some(value.to_owned());
    }
    // A variant, which files write in kebab case.
    let mut text = String::new();
    for (k, c) in value.char_indices() {
        if c.is_ascii_uppercase() && k > 0 {
            text.push('-');
        }
        text.push(c.to_ascii_lowercase());
    }
    Some(format!("{text:?}"))
}

/// Maps of the sums in a state, without new data: of every channel, with each of these epsilons (`R = epsilon W_max I`, unless the
/// configuration has another R with an epsilon), or those of the
/// configuration if there are none. The state stays as it is. `found` gets each map as soon as it is made, with its epsilon;
/// `watch` follows, and ends it early.
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
    let given = epsilons.iter().map(|&epsilon| PerChannel::All(epsilon));
    let each: Vec<_> = if epsilons.is_empty() { vec![config.map.epsilon()] } else { given.collect() };
    for epsilon in each {
        // Solving takes the sums: they are read again for the next.
        let mut setup = SolverSetup { epsilon, ..config.solver(watch.clone())? };
        if !epsilons.is_empty() && config.map.regulariser() == RegulariserChoice::Data {
            // Who names an epsilon asks for the R that has one.
            setup.regularisers = vec![Regulariser::default()];
        }
        solve_sums(folder, config, setup, found)?;
    }
    Ok(())
}

/// Maps of the sums in a state with `count` others that are as likely, draws from the posterior of R from the data. The state stays as
/// it is.
///
/// # Errors
/// As [`solve_state`].
pub fn sample_state(
    folder: &Path,
    config: &Config,
    count: usize,
    watch: &SolveWatch,
    found: &mut dyn FnMut(Solution),
) -> Result<(), PipelineError> {
    let setup = SolverSetup { samples: count, ..config.solver(watch.clone())? };
    solve_sums(folder, config, setup, found)
}

/// Maps of several channels together, of the sums in one state or several; `request` makes of the first state's stopping rule what is asked
/// for. The states stay as they are.
///
/// # Errors
/// As [`solve_state`]; sums that are not over harmonics; as [`solve_jointly`].
pub fn solve_states_jointly(
    states: &[(&Path, Config)],
    request: &dyn Fn(StoppingRule) -> JointRequest,
    watch: &SolveWatch,
) -> Result<JointSolution, PipelineError> {
    let (mut channels, mut rule) = (Vec::new(), None);
    for (folder, config) in states {
        rule.get_or_insert(config.solver(watch.clone())?.rule);
        for snapshot in Ground::sums_in(folder, &config.ground(WAIT_BYTES))? {
            let channel = snapshot.instrument.channels.get(usize::from(snapshot.channel.0));
            let frequency_hz = channel.map_or(0.0, |channel| channel.frequency_hz);
            let found = match snapshot.data {
                SnapshotData::Harmonic(sums) => {
                    channels.push(JointChannel { frequency_hz, nside: snapshot.nside, sums });
                    continue;
                }
                SnapshotData::Pixel(_) => "sums over pixels",
                _ => "visibilities one by one",
            };
            return Err(SolveError::NotHarmonic { frequency_hz, found }.into());
        }
    }
    let rule = rule.ok_or(SolveError::NoData)?;
    Ok(solve_jointly(channels, &request(rule), watch)?)
}

fn solve_sums(
    folder: &Path,
    config: &Config,
    setup: SolverSetup,
    found: &mut dyn FnMut(Solution),
) -> Result<(), PipelineError> {
    let sums = Ground::sums_in(folder, &config.ground(WAIT_BYTES))?;
    let mut solver = Solver::new(setup);
    for snapshot in sums {
        let mut out = Outlet::collect();
        solver.step(snapshot, &mut out)?;
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
        let pixel =
            MapConfig { nside: 4, rows: PixelMethod::AverageExact, weight_max: 2e-9, ..MapConfig::default() };
        let limits = GeometryLimits { altitude_m_max: 1e-3, ..GeometryLimits::default() };
        let harmonic = MapConfig { engine: EngineKind::Harmonic, l_max: 7, limits, ..MapConfig::default() };
        let refine = RefineConfig { passes_max: PASSES_MAX, ..RefineConfig::default() };
        let refined = MapConfig { refine, ..harmonic.clone() };
        for map in [pixel, harmonic, refined] {
            let mut overrides: Vec<String> = map
                .sum_settings()
                .iter()
                .filter_map(|(key, value)| Some(format!("{key}={}", toml_of(value)?)))
                .collect();
            overrides.push(format!("calibration.quantiser_bits={}", calibration.quantiser_bits));
            let config = ConfigSource { overrides, ..ConfigSource::default() }.load_ground().unwrap();
            assert_eq!((config.map, config.calibration), (map, calibration.clone()));
        }
        let hook = toml_of(&format!("{:?}", CalibrationHook::AntennaGains));
        assert_eq!(hook.as_deref(), Some("\"antenna-gains\""));
        assert_eq!(toml_of("a file of checksum 0123"), None);
    }
}
