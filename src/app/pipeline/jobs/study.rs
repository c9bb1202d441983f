//! Studies: parameter sweeps that share simulations and normal equations.
//!
//! A study runs a pipeline at every combination of some settings. Cases that differ only in the ground segment share one simulated
//! downlink. Cases that differ only in the solution (epsilon, prior) also share the normal equations of one state.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::calibrate::{CalibrateJob, calibrate, with_gains};
use super::case::{CaseSummary, step_of};
use super::event::{JobEvent, JobWatcher, MapStep};
use super::noise_maps::NoiseMaps;
use super::realisations::{RealisationSpread, SpreadProducts, spreads, spreads_csv};
use super::step::{Outcome, Step, key_of};
use super::study_file::{Study, StudyCase};
use crate::calibration::solver::SolverConfig;
use crate::downlink::{FileSource, Recorder};
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::config::{Config, PipelineError};
use crate::pipeline::graph::run::{
    DownlinkSinks, lock_folder, replay_with_truth, simulate_skies, write_settings,
};
use crate::pipeline::graph::{downlink_file, space_segment};
use crate::products::{
    Crossing, EpsilonChoices, MapShape, ProductsError, RunFigures, Truth, create_folder, crossings,
    draw_epsilons, draw_runs, epsilon_choices, epsilons_csv, runs_csv, spectra_csv, write_product,
};
use crate::runtime::Cancel;
use crate::sky::SkyMap;

/// Number of visibilities between checkpoints of a shared state: a minute's work or more.
const CHECKPOINT_EVERY: u64 = 20_000_000;

/// Results of a study.
#[derive(Clone, Debug, Serialize)]
pub struct StudySummary {
    /// Name of the study.
    pub name: String,
    /// Whether the study was interrupted: the same command resumes it.
    pub cancelled: bool,
    /// The finished cases.
    pub cases: Vec<CaseSummary>,
    /// The cases, by number, that differ only in `map.epsilon`.
    #[serde(skip)]
    pub epsilon_groups: Vec<Vec<usize>>,
    /// Values of `map.epsilon` where the two traces cross, for cases that differ only in `map.epsilon`.
    pub crossings: Vec<Crossing>,
    /// Choices of `map.epsilon` by several rules, for the same cases, if at least three have traces.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub epsilons: Vec<EpsilonChoices>,
    /// Scatter over realisations.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub spreads: Vec<RealisationSpread>,
}

/// Inputs for the maps of a case: data, gains, and a state that it shares with other cases.
struct CaseInputs<'a> {
    file: &'a Path,
    /// The file as a list; empty if the state already holds it.
    files: &'a [PathBuf],
    gains: Option<&'a Path>,
    state: Option<&'a PathBuf>,
}

struct StudyRun<'a> {
    study: &'a Study,
    out: &'a Path,
    cancel: &'a Cancel,
    watch: JobWatcher<'a>,
}

/// Runs the cases of a study that are not finished in `out`, and writes tables and curves of all cases.
///
/// Writes into `out` a folder of products for each case, `study.json`, `study.csv`, `spectra.csv` and `study.png`. Shared downlinks and
/// states are removed after their last use, unless `keep` is set.
///
/// # Errors
/// As [`crate::pipeline::run()`]; tables and pictures that cannot be written.
pub fn run_study(
    study: &Study,
    out: &Path,
    keep: bool,
    cancel: &Cancel,
    watch: JobWatcher<'_>,
) -> Result<StudySummary, PipelineError> {
    create_folder(out)?;
    let _lock = lock_folder(out)?;
    let mut run = StudyRun { study, out, cancel, watch };
    let pending = |k: &usize| !is_done(&study.cases[*k], out);
    let mut pending: Vec<usize> = (0..study.cases.len()).filter(pending).collect();
    let mut is_cancelled = false;
    while let (Some(&first), false) = (pending.first(), is_cancelled) {
        let config = &study.cases[first].plan.config;
        let key = downlink_key(config);
        let (group, rest): (Vec<usize>, Vec<usize>) =
            pending.iter().partition(|&&k| downlink_key(&study.cases[k].plan.config) == key);
        let file = out.join(format!("downlink-{key:016x}.{}", extension(config)));
        let marker = file.with_added_extension("simulated");
        let downlink = Step::Downlink(marker.clone(), config, &file);
        is_cancelled = run.make_group(&group, &downlink, &file, keep)?.is_cancelled();
        if !is_cancelled && !keep {
            for path in [&file, &marker] {
                fs::remove_file(path).map_err(ProductsError::write(path))?;
            }
        }
        pending = rest;
    }
    let summary = summarise(study, out, is_cancelled)?;
    write_results(&summary, out)?;
    Ok(summary)
}

fn extension(config: &Config) -> &'static str {
    let name = downlink_file(config.downlink.format);
    name.rsplit('.').next().unwrap_or("ccsds")
}

fn is_done(case: &StudyCase, out: &Path) -> bool {
    matches!(step_of(case, out).is_done(), Ok(true))
}

/// Hash of the settings that decide the downlink.
fn downlink_key(config: &Config) -> u64 {
    key_of(serde_json::to_vec(&(config.space_hash(), &config.downlink)).unwrap_or_default())
}

/// Hash of the settings that decide the sums, so that each downlink has states of its own.
fn sums_key(case: &StudyCase) -> u64 {
    let config = &case.plan.config;
    let (map, solver) = (&config.map, case.calibrated.then_some(&config.calibrate));
    let sums = (
        downlink_key(config),
        map.sum_settings(),
        &map.beyond_files,
        map.snapshot_every_s,
        &map.refine,
        &config.calibration,
        solver,
    );
    // Self-calibration depends on the settings of the solution, too.
    let solution = solver.filter(|solver| solver.map_rounds > 0).map(|_| map);
    key_of(serde_json::to_vec(&(sums, solution)).unwrap_or_default())
}

/// Cache of the input sky for one shape of maps, as consecutive cases often share it.
struct LastTruth {
    shape: MapShape,
    truth: Truth,
}

impl StudyRun<'_> {
    /// Runs the cases of one downlink.
    fn make_group(
        &mut self,
        group: &[usize],
        downlink: &Step<'_>,
        file: &Path,
        keep: bool,
    ) -> Result<Outcome, PipelineError> {
        let cases = &self.study.cases;
        let plan = &cases[group[0]].plan;
        let skies = space_segment::skies(plan)?;
        let outcome = downlink.run(|| {
            let recorder = Some(Recorder::create(file)?);
            let sinks = DownlinkSinks { file: Some(file.to_owned()), recorder, socket: None };
            let watch = &mut self.watch;
            let report = simulate_skies(plan, &skies, sinks, self.cancel, &mut |view| {
                watch(JobEvent::Simulate(group[0]), Some(view));
            })?;
            if report.cancelled {
                // The downlink is incomplete.
                let _ = fs::remove_file(file);
            }
            Ok(Outcome::of(report.cancelled))
        })?;
        if outcome.is_cancelled() {
            return Ok(outcome);
        }
        let mut left = group.to_vec();
        let mut last = None;
        while let Some(&first) = left.first() {
            let key = sums_key(&cases[first]);
            let (same, rest): (Vec<usize>, Vec<usize>) =
                left.iter().partition(|&&k| sums_key(&cases[k]) == key);
            let state = self.out.join(format!("state-{key:016x}"));
            // Snapshots are made while data arrive, so a state cannot be shared.
            let map = &cases[first].plan.config.map;
            let is_shared = same.len() > 1 && map.snapshot_every_s == 0.0;
            let gains = if cases[first].calibrated {
                let Some(gains) = self.calibrate(first, file)? else { return Ok(Outcome::Cancelled) };
                Some(gains)
            } else {
                None
            };
            for (number, &k) in same.iter().enumerate() {
                // After the first case, the shared state holds the data.
                let files = if number == 0 || !is_shared { &[file.to_owned()][..] } else { &[] };
                let inputs =
                    CaseInputs { file, files, gains: gains.as_deref(), state: is_shared.then_some(&state) };
                let outcome = step_of(&cases[k], self.out).run(|| self.map(k, inputs, &skies, &mut last))?;
                if outcome.is_cancelled() {
                    return Ok(outcome);
                }
            }
            if !keep && state.exists() {
                fs::remove_dir_all(&state).map_err(ProductsError::write(&state))?;
            }
            left = rest;
        }
        Ok(Outcome::Done)
    }

    /// Calibrates a downlink with the settings of a case, in a subfolder of its products. Returns the path of the gains; `None` if it
    /// was cancelled.
    fn calibrate(&mut self, number: usize, file: &Path) -> Result<Option<PathBuf>, PipelineError> {
        let case = &self.study.cases[number];
        let folder = self.out.join(case.folder());
        create_folder(&folder)?;
        let out = folder.join("calibration");
        let watch = &mut self.watch;
        let job = CalibrateJob {
            config: &case.plan.config,
            files: &[file.to_owned()],
            models: self.study.models.clone(),
            model_files: &self.study.model_files,
            out: &out,
            watch: &mut |progress| watch(JobEvent::Calibrate(number, progress), None),
        };
        let summary = calibrate(job, self.cancel)?;
        Ok((!summary.cancelled).then(|| out.join("gains.json")))
    }

    /// Maps a case.
    fn map(
        &mut self,
        number: usize,
        inputs: CaseInputs<'_>,
        skies: &[SkyMap],
        last: &mut Option<LastTruth>,
    ) -> Result<Outcome, PipelineError> {
        let CaseInputs { file, files, gains, state } = inputs;
        let case = &self.study.cases[number];
        let with_gains = gains.map(|gains| with_gains(&case.plan.config, gains.to_owned()));
        let config = with_gains.as_ref().unwrap_or(&case.plan.config);
        let folder = self.out.join(case.folder());
        let shape = config.map_shape();
        let truth = match last.take() {
            Some(known) if known.shape == shape => known.truth,
            _ => Truth::new(skies, shape)?,
        };
        *last = Some(LastTruth { shape, truth: truth.clone() });
        create_folder(&folder)?;
        write_settings(config, &folder)?;
        let settings = config.ground(WAIT_BYTES);
        let ground = match state {
            Some(state) => Ground::open(state, &settings, CHECKPOINT_EVERY)?,
            None => Ground::new(&settings)?,
        };
        let source = FileSource::open(files)?;
        let watch = &mut self.watch;
        let summary = replay_with_truth(truth, source, config, ground, &folder, self.cancel, &mut |view| {
            watch(JobEvent::Map(MapStep::whole(number)), Some(view));
        })?;
        if summary.cancelled {
            return Ok(Outcome::Cancelled);
        }
        let maps = NoiseMaps { config, file, out: &folder, seeds: &case.noise_seeds };
        maps.make(self.cancel, &mut |view| watch(JobEvent::Realise(number), Some(view)))
    }
}

/// Collects the figures of the finished cases, and what their comparison shows.
fn summarise(study: &Study, out: &Path, cancelled: bool) -> Result<StudySummary, PipelineError> {
    let mut cases = Vec::new();
    let mut groups: Vec<(Vec<u8>, Vec<usize>)> = Vec::new();
    let done: Vec<&StudyCase> = study.cases.iter().filter(|case| is_done(case, out)).collect();
    for case in &done {
        let mut figures = RunFigures::read(&out.join(case.folder()))?;
        figures.label = case.label();
        let engine = if case.plan.config.map.is_harmonic() { "harmonic" } else { "pixel" };
        figures.engine = Some(engine.to_owned());
        let mut config = case.plan.config.clone();
        config.map.epsilon = None;
        let key = serde_json::to_vec(&(config, case.calibrated)).unwrap_or_default();
        match groups.iter_mut().find(|(found, _)| *found == key) {
            Some((_, members)) => members.push(cases.len()),
            None => groups.push((key, vec![cases.len()])),
        }
        let (folder, realisations) = (case.folder(), 1 + case.noise_seeds.len());
        cases.push(CaseSummary { folder, overrides: case.overrides.clone(), realisations, figures });
    }
    let epsilon_groups: Vec<Vec<usize>> = groups.into_iter().map(|(_, members)| members).collect();
    let groups = figures_of_groups(&cases, &epsilon_groups);
    let (crossings, epsilons) = (crossings(&groups), epsilon_choices(&groups));
    compare_with_ideal(&done, &mut cases);
    let products = SpreadProducts { covariance_at_deg: &study.covariance_at_deg, folder: out };
    let spreads =
        if study.realisations > 1 { spreads(&families(study, &cases), products)? } else { Vec::new() };
    Ok(StudySummary {
        name: study.name.clone(),
        cancelled,
        cases,
        epsilon_groups,
        crossings,
        epsilons,
        spreads,
    })
}

/// Figures of groups of cases.
fn figures_of_groups<'a>(cases: &'a [CaseSummary], groups: &[Vec<usize>]) -> Vec<Vec<&'a RunFigures>> {
    groups.iter().map(|members| members.iter().map(|&k| &cases[k].figures).collect()).collect()
}

/// Compares each case of a study of instrument errors with the case that has no errors and is not calibrated.
fn compare_with_ideal(done: &[&StudyCase], cases: &mut [CaseSummary]) {
    let ideal_key = |case: &StudyCase| {
        let mut config = case.plan.config.without_errors();
        config.calibrate = SolverConfig::default();
        serde_json::to_value(&config).unwrap_or_default()
    };
    let has_errors = |case: &StudyCase| {
        let config = &case.plan.config;
        let ideal = config.without_errors();
        case.calibrated || (&config.instrument, &config.navigation) != (&ideal.instrument, &ideal.navigation)
    };
    if !done.iter().any(|case| has_errors(case)) {
        return;
    }
    let ideals: Vec<(serde_json::Value, RunFigures)> = done
        .iter()
        .zip(cases.iter())
        .filter(|(case, _)| !has_errors(case))
        .map(|(case, summary)| (ideal_key(case), summary.figures.clone()))
        .collect();
    for (case, summary) in done.iter().zip(cases) {
        let key = ideal_key(case);
        if let Some((_, ideal)) = ideals.iter().find(|(found, _)| *found == key) {
            summary.figures.set_power_kept(ideal);
        }
    }
}

/// Groups the cases that differ only in their realisation, with their common label.
fn families<'a>(study: &Study, cases: &'a [CaseSummary]) -> Vec<(String, Vec<&'a CaseSummary>)> {
    study
        .cases
        .chunk_by(|a, b| a.family == b.family)
        .map(|members| {
            let folders: BTreeSet<String> = members.iter().map(StudyCase::folder).collect();
            let label = members[0].labels.split_last().map(|(_, common)| common.join(", "));
            let done = cases.iter().filter(|case| folders.contains(&case.folder));
            (label.unwrap_or_default(), done.collect())
        })
        .collect()
}

fn write_results(summary: &StudySummary, out: &Path) -> Result<(), PipelineError> {
    let runs: Vec<&RunFigures> = summary.cases.iter().map(|case| &case.figures).collect();
    let json = serde_json::to_vec_pretty(summary)
        .map_err(|error| ProductsError::Encode { path: out.join("study.json"), reason: error.to_string() })?;
    for (name, bytes) in [
        ("study.json", json),
        ("study.csv", runs_csv(&runs).into_bytes()),
        ("spectra.csv", spectra_csv(&runs).into_bytes()),
        ("realisations.csv", table_if_any(&summary.spreads, spreads_csv)),
        ("epsilons.csv", table_if_any(&summary.epsilons, epsilons_csv)),
    ] {
        if !bytes.is_empty() {
            write_product(&out.join(name), &bytes)?;
        }
    }
    let groups = figures_of_groups(&summary.cases, &summary.epsilon_groups);
    let picture = draw_runs(&summary.name, &runs, &groups).map_err(ProductsError::from)?;
    for name in ["study.png", "study.svg"] {
        picture.write(&out.join(name)).map_err(ProductsError::from)?;
    }
    if !summary.epsilons.is_empty() {
        let picture = draw_epsilons(&summary.name, &summary.epsilons).map_err(ProductsError::from)?;
        for name in ["epsilons.png", "epsilons.svg"] {
            picture.write(&out.join(name)).map_err(ProductsError::from)?;
        }
    }
    Ok(())
}

/// The bytes of a table; empty if it has no rows.
fn table_if_any<T>(rows: &[T], table: impl Fn(&[T]) -> String) -> Vec<u8> {
    if rows.is_empty() { Vec::new() } else { table(rows).into_bytes() }
}
