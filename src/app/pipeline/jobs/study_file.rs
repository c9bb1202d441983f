//! Study files: reading, checks, and the cases that follow from the axes.

use std::collections::BTreeSet;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use thiserror::Error;

use crate::files::read_text;
use crate::pipeline::config::{ConfigSource, PipelineError, Plan, has_sections, is_folder_name, study_key};
use crate::sky::SkyMap;
use crate::sky::fits::{ReadOptions, check_frequencies, read_known_sky};

const CASES_MAX: usize = 1000;
/// Maximum number of directions in `covariance_at_deg`: each needs a map in memory.
const COVARIANCES_MAX: usize = 16;
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Maximum length of the name of a case's folder, without `case-`.
const FOLDER_CHARACTERS_MAX: usize = 100;

/// Errors in a study or design file, or its cases.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StudyError {
    /// The file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// Path.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The content is not valid.
    #[error("{}: {found}; expected {expected}", path.display())]
    File {
        /// Path.
        path: PathBuf,
        /// What was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
    /// A case whose settings are invalid.
    #[error("case {label}: {source}")]
    Case {
        /// Label of the case.
        label: String,
        /// What is wrong.
        source: Box<PipelineError>,
    },
}

/// Content of a study file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct StudyFile {
    name: Option<String>,
    /// Path of the pipeline, relative to the study's folder; the embedded quicklook if absent.
    pipeline: Option<PathBuf>,
    /// Overrides of all cases.
    #[serde(default)]
    set: Vec<String>,
    #[serde(default)]
    axis: Vec<AxisFile>,
    /// Number of realisations of each case: of the noise-only map, and of the instrument's random errors if it has any.
    realisations: Option<usize>,
    /// Directions whose noise covariance with all pixels is computed: ecliptic longitude and latitude, degrees.
    #[serde(default)]
    covariance_at_deg: Vec<[f64; 2]>,
    /// Whether each case is run twice: with the data as sent, and with the data calibrated.
    #[serde(default)]
    calibrated: bool,
    /// Paths of maps of the sky to calibrate with, one per channel, relative to the study's folder; `calibrate.model_files` if empty.
    #[serde(default)]
    model: Vec<PathBuf>,
}

/// An axis: a key and its values, or named cases of several settings each.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct AxisFile {
    key: Option<String>,
    values: Option<Vec<toml::Value>>,
    cases: Option<Vec<CaseFile>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CaseFile {
    label: String,
    set: Vec<String>,
}

/// Labels and overrides of a case.
#[derive(Clone, Default)]
struct Draft {
    labels: Vec<String>,
    sets: Vec<String>,
    /// Seeds of additional noise realisations that share the sums.
    noise_seeds: Vec<u64>,
}

impl Draft {
    fn with(&self, label: String, sets: &[String]) -> Self {
        let mut draft = self.clone();
        draft.labels.push(label);
        draft.sets.extend_from_slice(sets);
        draft
    }
}

pub(super) fn invalid(path: &Path, found: String, expected: &'static str) -> StudyError {
    StudyError::File { path: path.to_owned(), found, expected }
}

impl StudyFile {
    fn read(path: &Path) -> Result<Self, StudyError> {
        let text = read_study(path)?;
        toml::from_str(&text).map_err(|error| match is_pipeline(&text) {
            true => invalid(
                path,
                "a pipeline".to_owned(),
                "a study: pipeline = \"FILE\" and [[axis]] with key and values, or with cases; `lunarray run` runs a pipeline",
            ),
            false => invalid(
                path,
                error.to_string().trim_end().to_owned(),
                "name, pipeline, set and [[axis]] with key and values, or with cases",
            ),
        })
    }

    /// Checks everything except the cases.
    fn check(&self, path: &Path, extra_overrides: &[String]) -> Result<(), StudyError> {
        if self.axis.is_empty() && self.realisations.is_none() && !self.calibrated {
            let expected =
                "[[axis]] with key and values, or with cases; or realisations = N, or calibrated = true";
            return Err(invalid(path, "nothing that makes cases".to_owned(), expected));
        }
        if let Some(found) = self.duplicate_key(extra_overrides) {
            let expected = "each key on one axis alone: what is set last would hold under both labels";
            return Err(invalid(path, found, expected));
        }
        let directions = &self.covariance_at_deg;
        let is_direction =
            |[longitude, latitude]: &[f64; 2]| longitude.abs() <= 360.0 && latitude.abs() <= 90.0;
        let names: BTreeSet<String> = directions.iter().map(|at_deg| direction_name(*at_deg)).collect();
        let are_few = directions.len() <= COVARIANCES_MAX && names.len() == directions.len();
        if !are_few || !directions.iter().all(is_direction) {
            let expected = "at most 16 of [longitude, latitude], ecliptic, degrees, each once";
            return Err(invalid(path, format!("covariance_at_deg = {directions:?}"), expected));
        }
        if self.realisations.unwrap_or(1) == 1 && !directions.is_empty() {
            let found = "covariance_at_deg without realisations".to_owned();
            return Err(invalid(path, found, "realisations = 2 or more with it"));
        }
        Ok(())
    }

    /// All combinations of the values of the axes.
    fn combinations(&self, path: &Path) -> Result<Vec<Draft>, StudyError> {
        let mut combinations = vec![Draft::default()];
        for (number, axis) in self.axis.iter().enumerate() {
            let expected = "key with values, or cases with label and set; at least one";
            let steps = steps(axis).ok_or_else(|| invalid(path, format!("axis {}", number + 1), expected))?;
            if combinations.len().saturating_mul(steps.len()) > CASES_MAX {
                let found = format!("more than {CASES_MAX} combinations");
                return Err(invalid(path, found, "at most 1000 cases"));
            }
            let with_steps = |draft: &Draft| {
                steps.iter().map(|(label, sets)| draft.with(label.clone(), sets)).collect::<Vec<Draft>>()
            };
            combinations = combinations.iter().flat_map(with_steps).collect();
        }
        let realisations = self.realisations.unwrap_or(1);
        if realisations == 0 || combinations.len().saturating_mul(realisations) > CASES_MAX {
            let found = format!("realisations = {realisations} of {} cases", combinations.len());
            return Err(invalid(path, found, "1 or more, at most 1000 cases in all"));
        }
        Ok(combinations)
    }

    /// The realisations of a combination: one case if they can share its sums, otherwise one case per realisation.
    fn realisation_cases(&self, combination: &Draft, source: &ConfigSource) -> Vec<Draft> {
        let realisations = self.realisations.unwrap_or(1);
        // Errors of the configuration are reported with the case.
        let Some(base) = source.load().ok().filter(|_| realisations > 1) else {
            return vec![combination.clone(); realisations];
        };
        let seed = |number: usize| base.map.companion_seed.wrapping_add(number as u64);
        let seed_override = |number| format!("map.companion_seed={}", seed(number));
        if base.shares_realisations() && !self.calibrated {
            let shared = combination.with(format!("realisations 1 to {realisations}"), &[seed_override(1)]);
            return vec![Draft { noise_seeds: (2..=realisations).map(seed).collect(), ..shared }];
        }
        let errors_override = |number: usize| {
            let realisation = base.instrument.realisation.saturating_add(number as u32);
            base.has_errors().then(|| format!("instrument.realisation={realisation}"))
        };
        let case = |number| {
            let sets: Vec<String> =
                [seed_override(number)].into_iter().chain(errors_override(number)).collect();
            combination.with(format!("realisation {number}"), &sets)
        };
        (1..=realisations).map(case).collect()
    }

    fn model_files(&self, path: &Path, common: &ConfigSource) -> Result<Vec<PathBuf>, StudyError> {
        if self.model.is_empty() && self.calibrated {
            // Errors of the configuration are reported with the cases.
            return Ok(common.load().map_or_else(|_| Vec::new(), |common| common.calibrate.model_files));
        }
        if !self.model.is_empty() && !self.calibrated {
            let found = "model without calibration".to_owned();
            return Err(invalid(path, found, "calibrated = true with a model"));
        }
        Ok(self.model.iter().map(|model| resolve_path(path, model)).collect())
    }

    /// Describes a key that is set by two axes, or by an axis and by `--set`; `None` without one.
    fn duplicate_key(&self, extra_overrides: &[String]) -> Option<String> {
        let key = |set: &String| set.split_once('=').map_or(set.as_str(), |(key, _)| key).trim().to_owned();
        let keys = |axis: &AxisFile| -> BTreeSet<String> {
            let case_keys = axis.cases.iter().flatten().flat_map(|case| &case.set).map(key);
            axis.key.iter().map(|key| key.trim().to_owned()).chain(case_keys).collect()
        };
        let named = self.axis.iter().zip(1..).map(|(axis, number)| (format!("axis {number}"), keys(axis)));
        let mut named: Vec<(String, BTreeSet<String>)> = named.collect();
        named.push(("--set".to_owned(), extra_overrides.iter().map(key).collect()));
        // Setting a section sets all of its keys.
        let contains =
            |a: &str, b: &str| b.strip_prefix(a).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        named.iter().enumerate().find_map(|(k, (first, keys))| {
            named[k + 1..].iter().find_map(|(second, others)| {
                let overlaps =
                    |key: &&String| others.iter().any(|other| contains(key, other) || contains(other, key));
                keys.iter().find(overlaps).map(|key| format!("{key} is set by {first} and by {second}"))
            })
        })
    }
}

/// A study: cases with their configurations.
#[derive(Clone, Debug)]
pub struct Study {
    /// Name; results go to `out/NAME` by default.
    pub name: String,
    /// The cases, in order; cases that differ only in their realisation are consecutive.
    pub cases: Vec<StudyCase>,
    /// Number of realisations of each case.
    pub realisations: usize,
    /// Directions whose noise covariance with all pixels is computed: ecliptic longitude and latitude, degrees.
    pub covariance_at_deg: Vec<[f64; 2]>,
    /// Maps of the sky to calibrate with, K; empty if no case is calibrated, or if an artificial signal is used.
    pub models: Vec<SkyMap>,
    /// Files of the maps to calibrate with.
    pub model_files: Vec<PathBuf>,
}

/// A case of a study.
#[derive(Clone, Debug)]
pub struct StudyCase {
    /// Labels, one for each axis.
    pub labels: Vec<String>,
    /// Overrides of the pipeline.
    pub overrides: Vec<String>,
    /// The plan.
    pub plan: Plan,
    /// Whether the data are calibrated before they are mapped.
    pub calibrated: bool,
    /// Seeds of additional realisations of the noise-only map.
    pub noise_seeds: Vec<u64>,
    /// Number shared by the cases that differ only in their realisation.
    pub(in crate::pipeline) family: usize,
    pub(in crate::pipeline) models_hash: u64,
}

impl StudyCase {
    /// The labels of all axes, joined by commas.
    #[must_use]
    pub fn label(&self) -> String {
        self.labels.join(", ")
    }

    /// Name of the folder for products: the label without blanks and signs.
    #[must_use]
    pub fn folder(&self) -> String {
        let label = self.label();
        let parts = label.split(|c: char| !(c.is_ascii_alphanumeric() || ['.', '_'].contains(&c)));
        let name = parts.filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-");
        format!("case-{}", name.chars().take(FOLDER_CHARACTERS_MAX).collect::<String>())
    }
}

impl Study {
    /// Reads a study and checks the configuration of every case; `extra_overrides` apply to all cases.
    ///
    /// # Errors
    /// A file that cannot be read or is no study; a case whose settings are wrong.
    pub fn read(path: &Path, extra_overrides: &[String]) -> Result<Self, StudyError> {
        let file = StudyFile::read(path)?;
        file.check(path, extra_overrides)?;
        let pipeline = file.pipeline.as_ref().map(|pipeline| resolve_path(path, pipeline));
        let source = |sets: &[String]| {
            let overrides = [file.set.as_slice(), sets, extra_overrides].concat();
            ConfigSource { file: pipeline.clone(), overrides, seed: None }
        };
        let combinations = file.combinations(path)?;
        let families: Vec<Vec<Draft>> =
            combinations.iter().map(|draft| file.realisation_cases(draft, &source(&draft.sets))).collect();
        let model_files = file.model_files(path, &source(&[]))?;
        let (models, models_hash) = read_models(&model_files)?;
        let kinds: &[bool] = if file.calibrated { &[false, true] } else { &[false] };
        let mut cases = Vec::new();
        // Realisations of a case have to be consecutive.
        for (number, realisations) in families.iter().enumerate() {
            for (kind, &calibrated) in kinds.iter().enumerate() {
                let family = number * kinds.len() + kind;
                for draft in realisations {
                    let mut labels = draft.labels.clone();
                    if file.calibrated {
                        labels.insert(0, if calibrated { "calibrated" } else { "as sent" }.to_owned());
                    }
                    let source = source(&draft.sets);
                    let plan = case_plan(&source, calibrated.then_some(&model_files)).map_err(|source| {
                        StudyError::Case { label: labels.join(", "), source: Box::new(source) }
                    })?;
                    let (overrides, noise_seeds) = (source.overrides, draft.noise_seeds.clone());
                    cases.push(StudyCase {
                        labels,
                        overrides,
                        plan,
                        calibrated,
                        noise_seeds,
                        family,
                        models_hash,
                    });
                }
            }
        }
        let mut folders = BTreeSet::new();
        if let Some(duplicate) = cases.iter().find(|case| !folders.insert(case.folder())) {
            let found = format!("two cases with products in {}", duplicate.folder());
            return Err(invalid(path, found, "labels that differ in letters or digits"));
        }
        let stem =
            path.file_stem().map_or_else(|| "study".into(), |stem| stem.to_string_lossy().into_owned());
        let name = file.name.unwrap_or(stem);
        if name.is_empty() || !is_folder_name(&name) {
            let expected = "1 to 60 bytes, without slashes and control characters";
            return Err(invalid(path, format!("name = {name:?}"), expected));
        }
        let realisations = file.realisations.unwrap_or(1);
        let covariance_at_deg = file.covariance_at_deg;
        Ok(Self { name, cases, realisations, covariance_at_deg, models, model_files })
    }
}

/// Resolves a path in a study file, which is relative to the study's folder.
fn resolve_path(study: &Path, named: &Path) -> PathBuf {
    study.parent().unwrap_or(Path::new("")).join(named)
}

/// The plan of a case. The frequencies of `model_files`, the maps to calibrate with, are checked before anything is simulated.
pub(super) fn case_plan(
    source: &ConfigSource,
    model_files: Option<&Vec<PathBuf>>,
) -> Result<Plan, PipelineError> {
    let plan = source.load().map_err(PipelineError::from).and_then(Plan::new)?;
    if plan.config.joint.on {
        return Err(PipelineError::NotJoint { with: "a study" });
    }
    if let Some(files) = model_files {
        check_frequencies(files, &plan.config.spacecraft.channels_hz)?;
    }
    Ok(plan)
}

/// Whether a text has sections of a pipeline, and no key of a study.
fn is_pipeline(text: &str) -> bool {
    let table: toml::Table = toml::from_str(text).unwrap_or_default();
    study_key(&table).is_none() && has_sections(&table)
}

/// Reads the maps to calibrate with; returns them and a hash of the files.
fn read_models(paths: &[PathBuf]) -> Result<(Vec<SkyMap>, u64), StudyError> {
    let (mut maps, mut checksums) = (Vec::new(), Vec::new());
    for path in paths {
        let failed = |reason: String| StudyError::File {
            path: path.clone(),
            found: reason,
            expected: "a map of the sky to calibrate with, HEALPix in K",
        };
        maps.push(read_known_sky(path, &ReadOptions::default()).map_err(|error| failed(error.to_string()))?);
        let bytes = fs::read(path).map_err(|error| failed(error.to_string()))?;
        checksums
            .extend_from_slice(&crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes).to_le_bytes());
    }
    Ok((maps, crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &checksums)))
}

pub(super) fn read_study(path: &Path) -> Result<String, StudyError> {
    read_text(path, FILE_BYTES_MAX).map_err(|source| match source.kind() {
        ErrorKind::FileTooLarge => StudyError::File {
            path: path.to_owned(),
            found: source.to_string(),
            expected: "at most a megabyte",
        },
        _ => StudyError::Read { path: path.to_owned(), source },
    })
}

/// Label and overrides of each value of an axis; `None` if it has no values.
fn steps(axis: &AxisFile) -> Option<Vec<(String, Vec<String>)>> {
    let steps: Vec<_> = match (&axis.key, &axis.values, &axis.cases) {
        (Some(key), Some(values), None) => {
            let name = key.rsplit('.').next().unwrap_or(key);
            let step = |value: &toml::Value| (format!("{name} = {value}"), vec![format!("{key}={value}")]);
            values.iter().map(step).collect()
        }
        (None, None, Some(cases)) => {
            cases.iter().map(|case| (case.label.clone(), case.set.clone())).collect()
        }
        _ => return None,
    };
    (!steps.is_empty()).then_some(steps)
}

pub(in crate::pipeline) fn direction_name([longitude_deg, latitude_deg]: [f64; 2]) -> String {
    // Adding 0.0 turns -0.0 into 0.0.
    format!("{:.3}_{:.3}", longitude_deg + 0.0, latitude_deg + 0.0)
}
