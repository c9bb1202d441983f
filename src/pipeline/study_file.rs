//! A study's file, and the cases that it names.

use std::collections::BTreeSet;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use thiserror::Error;

use super::config::is_folder_name;
use super::config_source::{ConfigSource, has_sections, study_key};
use super::error::PipelineError;
use super::plan::Plan;
use crate::files::read_text;
use crate::sky::SkyMap;
use crate::sky::fits::{ReadOptions, check_frequencies, read_known_sky};

/// Most cases of a study.
const CASES_MAX: usize = 1000;
/// Most directions of `covariance_at_deg`: each takes a map of memory.
const COVARIANCES_MAX: usize = 16;
/// Longest study file, bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Most characters of the name of a case's folder, besides its beginning.
const FOLDER_CHARACTERS_MAX: usize = 100;

/// Why a study cannot be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StudyError {
    /// The file cannot be read.
    #[error("cannot read the study {}: {source}", path.display())]
    Read {
        /// Path.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file is no study.
    #[error("{}: {found}; expected {expected}", path.display())]
    File {
        /// Path.
        path: PathBuf,
        /// What was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
    /// A case whose settings are not a pipeline.
    #[error("case {label}: {source}")]
    Case {
        /// Its label.
        label: String,
        /// What is wrong.
        source: Box<PipelineError>,
    },
}

/// A study file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct StudyFile {
    name: Option<String>,
    /// Beside the study; the embedded quicklook if absent.
    pipeline: Option<PathBuf>,
    /// Overrides of all cases.
    #[serde(default)]
    set: Vec<String>,
    #[serde(default)]
    axis: Vec<AxisFile>,
    /// Realisations of each case: of the noise-only map's noise, and of the instrument's random errors if it has any.
    realisations: Option<usize>,
    /// Directions with which the noise of all pixels has a covariance that is wanted: ecliptic longitude and latitude, degrees.
    #[serde(default)]
    covariance_at_deg: Vec<[f64; 2]>,
    /// Whether each case is made twice: with the data as sent, and with gains that are found from them.
    #[serde(default)]
    calibrated: bool,
    /// Maps of the sky to calibrate with, one a channel; beside the study. Without, those of `calibrate.model_files`.
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

impl StudyFile {
    /// A key that two axes set, or an axis and the overrides `more` of all cases, in words.
    fn set_twice(&self, more: &[String]) -> Option<String> {
        let key = |set: &String| set.split_once('=').map_or(set.as_str(), |(key, _)| key).trim().to_owned();
        let keys = |axis: &AxisFile| -> BTreeSet<String> {
            let of_cases = axis.cases.iter().flatten().flat_map(|case| &case.set).map(key);
            axis.key.iter().map(|key| key.trim().to_owned()).chain(of_cases).collect()
        };
        let named = self.axis.iter().zip(1..).map(|(axis, number)| (format!("axis {number}"), keys(axis)));
        let mut named: Vec<(String, BTreeSet<String>)> = named.collect();
        named.push(("--set".to_owned(), more.iter().map(key).collect()));
        // A section holds all of its keys.
        let holds =
            |a: &str, b: &str| b.strip_prefix(a).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        named.iter().enumerate().find_map(|(k, (first, keys))| {
            named[k + 1..].iter().find_map(|(second, others)| {
                let both = |key: &&String| others.iter().any(|other| holds(key, other) || holds(other, key));
                keys.iter().find(both).map(|key| format!("{key} is set by {first} and by {second}"))
            })
        })
    }
}

/// A study: its cases, with their configurations.
#[derive(Clone, Debug)]
pub struct Study {
    /// Name; results go to `out/NAME` by default.
    pub name: String,
    /// Its cases, in order; those that differ in their realisation alone follow each other.
    pub cases: Vec<StudyCase>,
    /// Realisations of each case; 1 for none but its own.
    pub realisations: usize,
    /// Directions with which the noise of all pixels has a covariance that is wanted: ecliptic longitude and latitude, degrees.
    pub covariance_at_deg: Vec<[f64; 2]>,
    /// Maps of the sky to calibrate with, K; empty if none is calibrated, or if an artificial signal is enough.
    pub models: Vec<SkyMap>,
    /// Their files.
    pub model_files: Vec<PathBuf>,
}

/// A case of a study.
#[derive(Clone, Debug)]
pub struct StudyCase {
    /// What tells it from the others: a part for each axis.
    pub labels: Vec<String>,
    /// Its overrides of the pipeline.
    pub overrides: Vec<String>,
    /// Its plan.
    pub plan: Plan,
    /// Whether gains are found from its data and applied.
    pub calibrated: bool,
    /// Seeds of further realisations of its noise-only map, which share all the rest with it.
    pub noise_seeds: Vec<u64>,
    /// The number of what its realisations have in common, from 0.
    pub(super) family: usize,
    /// A number that changes with the maps to calibrate with.
    pub(super) models_hash: u64,
}

impl StudyCase {
    /// Its parts in one.
    #[must_use]
    pub fn label(&self) -> String {
        self.labels.join(", ")
    }

    /// Name of the folder of its products: its label without blanks and signs.
    #[must_use]
    pub fn folder(&self) -> String {
        let label = self.label();
        let parts = label.split(|c: char| !(c.is_ascii_alphanumeric() || ['.', '_'].contains(&c)));
        let name = parts.filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-");
        format!("case-{}", name.chars().take(FOLDER_CHARACTERS_MAX).collect::<String>())
    }
}

impl Study {
    /// Reads a study, with more overrides of all its cases, and checks the configuration of every case.
    ///
    /// # Errors
    /// A file that cannot be read or is no study; a case whose settings are wrong.
    pub fn read(path: &Path, more: &[String]) -> Result<Self, StudyError> {
        let text = read_study(path)?;
        let wrong = |found: String, expected| StudyError::File { path: path.to_owned(), found, expected };
        let file: StudyFile = toml::from_str(&text).map_err(|error| match is_pipeline(&text) {
            true => wrong(
                "a pipeline".to_owned(),
                "a study: pipeline = \"FILE\" and [[axis]] with key and values, or with cases; `lunarray run` runs a pipeline",
            ),
            false => wrong(
                error.to_string().trim_end().to_owned(),
                "name, pipeline, set and [[axis]] with key and values, or with cases",
            ),
        })?;
        if file.axis.is_empty() && file.realisations.is_none() && !file.calibrated {
            let expected =
                "[[axis]] with key and values, or with cases; or realisations = N, or calibrated = true";
            return Err(wrong("nothing that makes cases".to_owned(), expected));
        }
        if let Some(found) = file.set_twice(more) {
            return Err(wrong(
                found,
                "each key on one axis alone: what is set last would hold under both labels",
            ));
        }
        let mut combinations = vec![(Vec::new(), Vec::new())];
        for (number, axis) in file.axis.iter().enumerate() {
            let steps = steps(axis).ok_or_else(|| {
                wrong(
                    format!("axis {}", number + 1),
                    "key with values, or cases with label and set; at least one",
                )
            })?;
            if combinations.len().saturating_mul(steps.len()) > CASES_MAX {
                return Err(wrong(format!("more than {CASES_MAX} combinations"), "at most 1000 cases"));
            }
            combinations = combinations
                .iter()
                .flat_map(|(labels, sets)| {
                    steps.iter().map(move |(label, set)| {
                        let labels: Vec<String> = [labels.as_slice(), std::slice::from_ref(label)].concat();
                        let sets: Vec<String> = [sets.as_slice(), set.as_slice()].concat();
                        (labels, sets)
                    })
                })
                .collect();
        }
        let realisations = file.realisations.unwrap_or(1);
        if realisations == 0 || combinations.len().saturating_mul(realisations) > CASES_MAX {
            let found = format!("realisations = {realisations} of {} cases", combinations.len());
            return Err(wrong(found, "1 or more, at most 1000 cases in all"));
        }
        let directions = &file.covariance_at_deg;
        let is_direction =
            |[longitude, latitude]: &[f64; 2]| longitude.abs() <= 360.0 && latitude.abs() <= 90.0;
        let names: BTreeSet<String> = directions.iter().map(|at_deg| direction_name(*at_deg)).collect();
        let are_few = directions.len() <= COVARIANCES_MAX && names.len() == directions.len();
        if !are_few || !directions.iter().all(is_direction) {
            let expected = "at most 16 of [longitude, latitude], ecliptic, degrees, each once";
            return Err(wrong(format!("covariance_at_deg = {directions:?}"), expected));
        }
        if realisations == 1 && !directions.is_empty() {
            return Err(wrong(
                "covariance_at_deg without realisations".to_owned(),
                "realisations = 2 or more with it",
            ));
        }
        let stem =
            path.file_stem().map_or_else(|| "study".into(), |stem| stem.to_string_lossy().into_owned());
        let beside = |pipeline: &PathBuf| path.parent().unwrap_or(Path::new("")).join(pipeline);
        let pipeline = file.pipeline.as_ref().map(beside);
        let mut realised = Vec::new();
        for (labels, sets) in combinations {
            let overrides = [file.set.as_slice(), &sets, more].concat();
            let source = ConfigSource { file: pipeline.clone(), overrides, seed: None };
            // What is wrong is told with the case.
            let base = source.load().ok();
            let companion = base.as_ref().map_or(0, |base| base.map.companion_seed);
            let seed = |number: usize| companion.wrapping_add(number as u64);
            if base.as_ref().is_some_and(|base| realisations > 1 && base.shares_realisations())
                && !file.calibrated
            {
                let (mut labels, mut sets) = (labels, sets);
                labels.push(format!("realisations 1 to {realisations}"));
                sets.push(format!("map.companion_seed={}", seed(1)));
                realised.push(vec![(labels, sets, (2..=realisations).map(seed).collect())]);
                continue;
            }
            let mut of_case = Vec::new();
            for number in 1..=realisations {
                let (mut labels, mut sets) = (labels.clone(), sets.clone());
                if let Some(base) = base.as_ref().filter(|_| realisations > 1) {
                    labels.push(format!("realisation {number}"));
                    sets.push(format!("map.companion_seed={}", seed(number)));
                    if base.has_errors() {
                        let realisation = base.instrument.realisation.saturating_add(number as u32);
                        sets.push(format!("instrument.realisation={realisation}"));
                    }
                }
                of_case.push((labels, sets, Vec::new()));
            }
            realised.push(of_case);
        }
        let mut models: Vec<PathBuf> = file.model.iter().map(beside).collect();
        if models.is_empty() && file.calibrated {
            // As `lunarray calibrate`; what is wrong is told with the cases.
            let overrides = [file.set.as_slice(), more].concat();
            let common = ConfigSource { file: pipeline.clone(), overrides, seed: None }.load();
            models = common.map_or_else(|_| Vec::new(), |common| common.calibrate.model_files);
        }
        if !models.is_empty() && !file.calibrated {
            return Err(wrong("model without calibration".to_owned(), "calibrated = true with a model"));
        }
        let model_files = models;
        let (models, models_hash) = read_models(&model_files)?;
        let kinds: &[bool] = if file.calibrated { &[false, true] } else { &[false] };
        // Realisations of a case stay together.
        let realised = realised.iter().enumerate().flat_map(|(number, of_case)| {
            kinds.iter().enumerate().flat_map(move |(kind, &calibrated)| {
                let family = number * kinds.len() + kind;
                of_case.iter().map(move |(labels, sets, noise_seeds)| {
                    let mut labels = labels.clone();
                    if file.calibrated {
                        labels.insert(0, if calibrated { "calibrated" } else { "as sent" }.to_owned());
                    }
                    (labels, sets, noise_seeds, family, calibrated)
                })
            })
        });
        let cases = realised.map(|(labels, sets, noise_seeds, family, calibrated)| {
            let overrides = [file.set.as_slice(), sets, more].concat();
            let source = ConfigSource { file: pipeline.clone(), overrides: overrides.clone(), seed: None };
            let plan = source.load().map_err(PipelineError::from).and_then(Plan::new);
            let of_case = |source| StudyError::Case { label: labels.join(", "), source: Box::new(source) };
            let plan = plan.map_err(of_case)?;
            if calibrated {
                // Before anything is simulated.
                let checked = check_frequencies(&model_files, &plan.config.spacecraft.channels_hz);
                checked.map_err(|error| of_case(error.into()))?;
            }
            let noise_seeds: Vec<u64> = noise_seeds.clone();
            Ok(StudyCase { labels, overrides, plan, calibrated, noise_seeds, family, models_hash })
        });
        let cases = cases.collect::<Result<Vec<StudyCase>, StudyError>>()?;
        let mut folders = BTreeSet::new();
        if let Some(twice) = cases.iter().find(|case| !folders.insert(case.folder())) {
            let found = format!("two cases with products in {}", twice.folder());
            return Err(wrong(found, "labels that differ in letters or digits"));
        }
        let (name, covariance_at_deg) = (file.name.unwrap_or(stem), file.covariance_at_deg);
        if name.is_empty() || !is_folder_name(&name) {
            return Err(wrong(
                format!("name = {name:?}"),
                "1 to 60 bytes, without slashes and control characters",
            ));
        }
        Ok(Self { name, cases, realisations, covariance_at_deg, models, model_files })
    }
}

/// Whether a text has sections of a pipeline, and no axis.
fn is_pipeline(text: &str) -> bool {
    let table: toml::Table = toml::from_str(text).unwrap_or_default();
    study_key(&table).is_none() && has_sections(&table)
}

/// Maps to calibrate with, and a number that changes with their bytes.
fn read_models(paths: &[PathBuf]) -> Result<(Vec<SkyMap>, u64), StudyError> {
    let (mut maps, mut sums) = (Vec::new(), Vec::new());
    for path in paths {
        let failed = |reason: String| StudyError::File {
            path: path.clone(),
            found: reason,
            expected: "a map of the sky to calibrate with, HEALPix in K",
        };
        maps.push(read_known_sky(path, &ReadOptions::default()).map_err(|error| failed(error.to_string()))?);
        let bytes = fs::read(path).map_err(|error| failed(error.to_string()))?;
        sums.extend_from_slice(&crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes).to_le_bytes());
    }
    Ok((maps, crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &sums)))
}

fn read_study(path: &Path) -> Result<String, StudyError> {
    read_text(path, FILE_BYTES_MAX).map_err(|source| match source.kind() {
        ErrorKind::FileTooLarge => StudyError::File {
            path: path.to_owned(),
            found: source.to_string(),
            expected: "a study, at most a megabyte",
        },
        _ => StudyError::Read { path: path.to_owned(), source },
    })
}

/// Label and overrides of each step of an axis; `None` for one without steps.
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

/// A direction as a part of a file's name.
pub(super) fn direction_name([longitude_deg, latitude_deg]: [f64; 2]) -> String {
    // Zero has no sign.
    format!("{:.3}_{:.3}", longitude_deg + 0.0, latitude_deg + 0.0)
}
