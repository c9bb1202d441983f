//! Design files: what is searched, within which limits, and how the result is checked.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::sensitivity::SENSITIVITY_L_MAX;
use super::study_file::{StudyError, case_plan, invalid, read_study};
use crate::pipeline::config::{Config, ConfigSource, Plan, is_folder_name, is_whole_at, number_at};

const VALUES_MAX: usize = 64;
const EVALUATIONS_MAX: usize = 10_000;
/// Longest name: the pipeline of the result appends `-design` to it.
const NAME_BYTES_MAX: usize = 60 - "-design".len();
/// The setting that is searched as a whole: a value for each arc, in ascending order.
const ARCS: &str = "array.arcs_m";

/// A setting that is searched.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DesignParameter {
    /// Key of the pipeline, such as `array.altitude_m` or `array.kepler[0].eccentricity`; `array.arcs_m` stands for all arcs.
    pub key: String,
    /// Lowest value, in the key's unit.
    pub from: f64,
    /// Highest value.
    pub to: f64,
}

/// What is lowered, at some degrees and in all channels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum DesignObjective {
    /// The geometric mean of 1 / SNR_l.
    #[default]
    Noise,
    /// The modes that are not measured, of the 2 l + 1 of each degree.
    Modes,
}

/// What a design has to keep.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DesignLimits {
    /// Least distance of any two satellites, m.
    #[serde(default)]
    pub closest_m_min: f64,
    /// Least and most that the greatest distance of two satellites may be, m: long baselines give resolution.
    #[serde(default)]
    pub span_m_min: f64,
    /// See `span_m_min`.
    pub span_m_max: Option<f64>,
    /// Most velocity change of a satellite for the breathing of the formation, m/s a year.
    pub keeping_m_s_per_year_max: Option<f64>,
}

/// Content of a design file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct DesignFile {
    name: Option<String>,
    /// Path of the pipeline to start from, relative to the design's folder; the embedded quicklook if absent.
    pipeline: Option<PathBuf>,
    #[serde(default)]
    set: Vec<String>,
    #[serde(default)]
    objective: DesignObjective,
    #[serde(default = "usual_degrees")]
    degrees: [usize; 2],
    #[serde(default = "usual_evaluations")]
    evaluations: usize,
    #[serde(default)]
    seed: u64,
    #[serde(default)]
    limits: DesignLimits,
    #[serde(default)]
    parameter: Vec<DesignParameter>,
    check: Option<Vec<String>>,
}

fn usual_degrees() -> [usize; 2] {
    [2, 17]
}

fn usual_evaluations() -> usize {
    150
}

/// A design to be searched.
#[derive(Clone, Debug)]
pub struct Design {
    /// Name; results go to `out/NAME` by default.
    pub name: String,
    /// The pipeline to start from.
    pub start: ConfigSource,
    /// Its plan.
    pub plan: Plan,
    /// Its values of the parameters.
    pub(super) start_values: Vec<f64>,
    /// What is lowered.
    pub objective: DesignObjective,
    /// First and last degree at which it is.
    pub degrees: [usize; 2],
    /// Most estimates.
    pub evaluations: usize,
    /// Seed of the search.
    pub seed: u64,
    /// What a design has to keep.
    pub limits: DesignLimits,
    /// The settings that are searched.
    pub parameters: Vec<DesignParameter>,
    /// Overrides of the runs that check the result.
    pub check: Vec<String>,
}

impl Design {
    /// Reads a design file. `extra` are further overrides of the pipeline to start from.
    ///
    /// # Errors
    /// A file that cannot be read or is no design; a pipeline that cannot be used, or has no such numbers.
    pub fn read(path: &Path, extra: &[String]) -> Result<Self, StudyError> {
        let text = read_study(path)?;
        let expected = "a design: pipeline, [[parameter]] with key, from and to, [limits] and check";
        let file: DesignFile = toml::from_str(&text)
            .map_err(|error| invalid(path, error.to_string().trim_end().to_owned(), expected))?;
        file.require_valid().map_err(|(found, expected)| invalid(path, found, expected))?;
        let stem = path.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
        let name = file.name.clone().unwrap_or(stem);
        if name.is_empty() || name.len() > NAME_BYTES_MAX || !is_folder_name(&name) {
            let expected = "1 to 53 bytes, without slashes and control characters";
            return Err(invalid(path, format!("name = {name:?}"), expected));
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        let start = ConfigSource {
            file: file.pipeline.as_ref().map(|pipeline| folder.join(pipeline)),
            overrides: [file.set.as_slice(), extra].concat(),
            seed: None,
        };
        let plan = case_plan(&start, None)
            .map_err(|error| StudyError::Case { label: "start".to_owned(), source: Box::new(error) })?;
        file.require_effect(&plan).map_err(|(found, expected)| invalid(path, found, expected))?;
        let mut start_values = Vec::new();
        for DesignParameter { key, .. } in &file.parameter {
            let found = values_at(&plan, key).ok_or_else(|| {
                let expected = "a number of the pipeline; `set` gives one to a setting that has none";
                invalid(path, format!("key = {key:?}"), expected)
            })?;
            start_values.extend(found);
        }
        if start_values.len() > VALUES_MAX {
            return Err(invalid(path, format!("{} values", start_values.len()), "at most 64 to be searched"));
        }
        let check = file.check.unwrap_or_else(|| other_realisation(&plan.config));
        Ok(Self {
            name,
            start,
            plan,
            start_values,
            objective: file.objective,
            degrees: file.degrees,
            evaluations: file.evaluations,
            seed: file.seed,
            limits: file.limits,
            parameters: file.parameter,
            check,
        })
    }

    /// The pipeline with other settings.
    pub(super) fn source(&self, settings: &[String]) -> ConfigSource {
        let overrides = [self.start.overrides.as_slice(), settings].concat();
        ConfigSource { overrides, ..self.start.clone() }
    }

    /// The parameter of each value.
    pub(super) fn parameter_of_each(&self) -> impl Iterator<Item = &DesignParameter> {
        let width = |one: &DesignParameter| values_at(&self.plan, &one.key).map_or(0, |found| found.len());
        self.parameters.iter().flat_map(move |one| std::iter::repeat_n(one, width(one)))
    }

    /// The settings that values stand for.
    pub(super) fn settings(&self, values: &[f64]) -> Vec<String> {
        let of_each: Vec<(&DesignParameter, f64)> =
            self.parameter_of_each().zip(values.iter().copied()).collect();
        let set = |group: &[(&DesignParameter, f64)]| {
            let (key, mut values) = (&group[0].0.key, group.iter().map(|one| one.1).collect::<Vec<f64>>());
            values.sort_by(f64::total_cmp);
            if key == ARCS { format!("{key}={values:?}") } else { format!("{key}={:?}", values[0]) }
        };
        of_each.chunk_by(|a, b| a.0.key == b.0.key).map(set).collect()
    }
}

/// The values of a key in a plan.
fn values_at(plan: &Plan, key: &str) -> Option<Vec<f64>> {
    if key != ARCS {
        return number_at(&plan.config, key).map(|value| vec![value]);
    }
    let formation = plan.array.formation()?;
    Some((1..formation.satellites()).map(|n| formation.arc_m(n, 0.0).0).collect())
}

impl DesignFile {
    /// What was found and expected instead, of the first value that cannot be used.
    fn require_valid(&self) -> Result<(), (String, &'static str)> {
        if self.parameter.is_empty() {
            return Err(("nothing to search".to_owned(), "[[parameter]] with key, from and to"));
        }
        let mut keys: Vec<&str> = self.parameter.iter().map(|one| one.key.as_str()).collect();
        keys.sort_unstable();
        if let Some(twice) = keys.windows(2).find(|two| two[0] == two[1]) {
            return Err((format!("two parameters {}", twice[0]), "each key once"));
        }
        let is_wide = |one: &&DesignParameter| one.from < one.to && (one.to - one.from).is_finite();
        if let Some(DesignParameter { key, from, to }) = self.parameter.iter().find(|one| !is_wide(one)) {
            return Err((format!("{key} from {from} to {to}"), "two numbers, from below to"));
        }
        let [first, last] = self.degrees;
        if first == 0 || first > last || last > SENSITIVITY_L_MAX {
            let found = format!("degrees = [{first}, {last}]");
            return Err((found, "the first and the last degree, from 1 to 18"));
        }
        if !(1..=EVALUATIONS_MAX).contains(&self.evaluations) {
            return Err((format!("evaluations = {}", self.evaluations), "1 to 10000"));
        }
        let DesignLimits { closest_m_min, span_m_min, span_m_max, keeping_m_s_per_year_max } = self.limits;
        let limits = [
            ("closest_m_min", Some(closest_m_min)),
            ("span_m_min", Some(span_m_min)),
            ("span_m_max", span_m_max),
            ("keeping_m_s_per_year_max", keeping_m_s_per_year_max),
        ];
        let set = limits.into_iter().filter_map(|(key, limit)| Some((key, limit?)));
        match set.into_iter().find(|(_, limit)| !(limit.is_finite() && *limit >= 0.0)) {
            Some((key, limit)) => Err((format!("limits.{key} = {limit}"), "limits that are not negative")),
            None => Ok(()),
        }
    }

    /// What was found and expected instead, of the first parameter or limit that tells nothing of the estimates of a plan.
    fn require_effect(&self, plan: &Plan) -> Result<(), (String, &'static str)> {
        let keys: Vec<&str> = self.parameter.iter().map(|one| one.key.as_str()).collect();
        for key in &keys {
            let found = || format!("key = {key:?}");
            let section = key.split('.').next().unwrap_or_default();
            if !["array", "spacecraft"].contains(&section) || key.starts_with("spacecraft.channels_hz") {
                let expected = "a number of [array] or [spacecraft] other than a channel: all estimates are of one sky, its channels and \
                                the map's own settings";
                return Err((found(), expected));
            }
            if is_whole_at(&plan.config, key) {
                let expected = "a number that is not whole: a search takes steps between; vary whole ones by `lunarray study`";
                return Err((found(), expected));
            }
            if let Some(expected) = replacement(key, &keys, &plan.config) {
                return Err((format!("{key} has no effect here"), expected));
            }
        }
        if self.limits.keeping_m_s_per_year_max.is_some() && plan.array.formation().is_none() {
            let expected = "that limit only of satellites on one circle, whose breathing is known";
            return Err(("keeping_m_s_per_year_max without a formation".to_owned(), expected));
        }
        Ok(())
    }
}

/// Keys that others replace, and those others.
fn replacement(key: &str, keys: &[&str], config: &Config) -> Option<&'static str> {
    let has_arcs = keys.contains(&ARCS) || !config.array.arcs_m.is_empty();
    let has_orbit = ["array.altitude_m", "array.inclination_deg"].iter().any(|key| keys.contains(key));
    match key {
        "array.orbital_period_s" | "array.precession_period_s" if has_orbit => Some(
            "array.altitude_m and array.inclination_deg, from which the periods follow, or the periods alone",
        ),
        "array.breathing.first_spacing_m_min"
        | "array.breathing.second_spacing_m_min"
        | "array.breathing.span_m_max"
            if has_arcs =>
        {
            Some("array.arcs_m, which replaces the spacings, or the spacings alone")
        }
        key if key.starts_with("array.arcs_m[") && keys.contains(&ARCS) => {
            Some("array.arcs_m for all arcs, or some of its elements")
        }
        _ => None,
    }
}

/// Another seed and epoch: sky and noise differ, and node and satellites are elsewhere when the mission begins.
fn other_realisation(config: &Config) -> Vec<String> {
    let next = |seed: u64| seed.wrapping_add(1) % (1 << 62);
    // The noise-only map has a seed of its own.
    let mut sets = vec![
        format!("seed={}", next(config.seed)),
        format!("map.companion_seed={}", next(config.map.companion_seed)),
    ];
    if !config.array.has_own_orbits() {
        let [node_deg, phase_deg] = [
            (config.array.node_longitude_deg + 97.0) % 360.0,
            (config.array.orbital_phase_deg + 211.0) % 360.0,
        ];
        sets.push(format!("array.node_longitude_deg={node_deg}"));
        sets.push(format!("array.orbital_phase_deg={phase_deg}"));
    }
    sets
}
