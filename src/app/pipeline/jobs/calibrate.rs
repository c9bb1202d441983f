//! Calibration of a downlink: gains of each pass from a known signal, alternating with maps (self-calibration) if configured.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::array::Ephemeris;
use crate::calibration::solver::{
    CalibrationMode, GainState, PassBlocks, PassSolution, PassSolver, SolverConfig,
};
use crate::calibration::{CalibrationHook, VanVleck};
use crate::downlink::{DownlinkReader, FileSource};
use crate::frames::{GroundFrame, VisibilityBlock};
use crate::ground::{Ground, WAIT_BYTES};
use crate::pipeline::config::{Config, PipelineError};
use crate::pipeline::graph::calibrate_products::{write_json, write_products};
use crate::pipeline::graph::found_solutions::FoundSolutions;
use crate::pipeline::graph::run::lock_folder;
use crate::pipeline::graph::{CalibrateSummary, replay};
use crate::products::create_folder;
use crate::runtime::Cancel;
use crate::sky::SkyMap;
use crate::sky::fits::{ReadOptions, check_frequencies, read_whole_map};
use crate::sky::harmonics::AnalysisOptions;
use crate::sky::spectra::auto_cl;
use crate::units::{InvalidValue, frequency_folder};

/// Option that names the maps of the known sky, for error messages.
const MODEL: &str = "--model";

/// Inputs and output of the calibration of a downlink.
pub struct CalibrateJob<'a> {
    /// Settings of the ground segment.
    pub config: &'a Config,
    /// Downlink files; sorted by the times of their first visibilities if they can be read twice.
    pub files: &'a [PathBuf],
    /// Map of the sky for each channel, K; may be empty if an artificial signal is known.
    pub models: Vec<SkyMap>,
    /// Files of these maps, whose frequencies are checked against the channels; empty for maps that are not from files.
    pub model_files: &'a [PathBuf],
    /// Folder for the products.
    pub out: &'a Path,
    /// Called after each pass with the progress.
    pub watch: CalibrateWatcher<'a>,
}

/// Callback that receives the progress of a calibration.
pub type CalibrateWatcher<'a> = &'a mut dyn FnMut(CalibrateProgress);

/// Progress of a calibration.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CalibrateProgress {
    /// Number of the round; 0 uses the given model.
    pub round: u32,
    /// Number of the last round, unless the gains converge earlier.
    pub last_round: u32,
    /// Passes solved in the round; `None` while its maps are made.
    pub passes: Option<u64>,
    /// Fraction of the data that the round has read.
    pub read: f64,
}

/// Solves for the gains of every pass, and writes `gains.json` for a replay, `solutions.csv`, `solutions.json` and
/// `solutions.png`. They are written at the end only, so a repetition after an interruption gives the same result.
///
/// # Errors
/// Files that cannot be read; maps that do not fit the channels; a failed replay.
pub fn calibrate(job: CalibrateJob<'_>, cancel: &Cancel) -> Result<CalibrateSummary, PipelineError> {
    let CalibrateJob { config, files, models, model_files, out, watch } = job;
    let solver = &config.calibrate;
    check(config, &models)?;
    let files = &sorted_by_time(files)?[..];
    let _lock = lock_folder(out)?;
    let first = SolverConfig { mode: solver.known_signal(!models.is_empty()), ..solver.clone() };
    let van_vleck = config.calibration.van_vleck()?;
    let bytes = files.iter().map(|file| std::fs::metadata(file).map_or(0, |file| file.len())).sum::<u64>();
    let last_round = solver.map_rounds;
    let solve = |round: u32, solver: &SolverConfig, maps: &[SkyMap], watch: CalibrateWatcher<'_>| {
        // Maps of later rounds are made from the data, so their frequencies need no check.
        let model_files = if round == 0 { model_files } else { &[] };
        let van_vleck = van_vleck.as_ref();
        let pass_round = Round { solver, files, maps, model_files, model_key: MODEL, van_vleck, cancel };
        pass_round.solve(&mut |passes, read_bytes| {
            let read = read_bytes as f64 / bytes.max(1) as f64;
            watch(CalibrateProgress { round, last_round, passes: Some(passes), read });
        })
    };
    let mut rounds = Vec::new();
    let mut found = solve(0, &first, &models, watch)?;
    rounds.push(found.round(0, first.mode, None, Vec::new()));
    for round in 1..=solver.map_rounds {
        if cancel.is_cancelled() {
            break;
        }
        watch(CalibrateProgress { round, last_round, passes: None, read: 0.0 });
        let maps = make_maps(config, files, &found, &out.join(format!("round-{round}")), cancel)?;
        if cancel.is_cancelled() {
            break;
        }
        let map_cl_k2 = maps.iter().map(map_cl_k2).collect::<Result<_, PipelineError>>()?;
        let next = solve(round, solver, &maps, watch)?;
        let change = change_rms(&found.solutions, &next.solutions);
        rounds.push(next.round(round, solver.mode, Some(change), map_cl_k2));
        found = next;
        if change < solver.settled {
            break;
        }
    }
    let mut summary = found.summary(solver);
    summary.rounds = rounds;
    summary.cancelled = cancel.is_cancelled();
    if !summary.cancelled {
        write_products(out, &found, &summary, config.products.pictures)?;
    }
    Ok(summary)
}

fn invalid(
    key: &str,
    value: impl ToString,
    expected: impl Into<std::borrow::Cow<'static, str>>,
) -> PipelineError {
    InvalidValue { key: key.to_owned(), value: value.to_string(), expected: expected.into() }.into()
}

/// Checks that the settings and the number of maps permit a calibration.
fn check(config: &Config, models: &[SkyMap]) -> Result<(), PipelineError> {
    let (solver, calibration) = (&config.calibrate, &config.calibration);
    if calibration.sub_bands != 1 {
        return Err(invalid(
            "calibration.sub_bands",
            calibration.sub_bands,
            "1: gains are of channels as they are sent",
        ));
    }
    if calibration.hook == CalibrationHook::AntennaGains {
        return Err(invalid(
            "calibration.hook",
            "\"antenna-gains\"",
            "\"identity\": gains are found from data as sent",
        ));
    }
    let needs_sky = solver.mode == CalibrationMode::Sky;
    if needs_sky && models.is_empty() {
        let expected = "maps of the sky, one per channel, or calibrate.mode = \"beacon\" or \"joint\"";
        return Err(invalid(MODEL, "(none)", expected));
    }
    if solver.mode == CalibrationMode::Beacon && solver.map_rounds > 0 {
        let expected = "0 with calibrate.mode = \"beacon\", which uses no map";
        return Err(invalid("calibrate.map_rounds", solver.map_rounds, expected));
    }
    Ok(())
}

/// One round: the passes of a downlink, and the model to solve them with.
struct Round<'a> {
    solver: &'a SolverConfig,
    files: &'a [PathBuf],
    maps: &'a [SkyMap],
    model_files: &'a [PathBuf],
    model_key: &'static str,
    van_vleck: Option<&'a VanVleck>,
    cancel: &'a Cancel,
}

/// Visibilities of the pass that is being read.
#[derive(Default)]
struct OpenPass {
    blocks: Vec<VisibilityBlock>,
    span_s: Option<[f64; 2]>,
}

impl OpenPass {
    /// Solves the pass, if it has data, and adds the solution to `found`.
    fn solve(
        self,
        found: &mut FoundSolutions,
        solver: &mut PassSolver,
        ephemeris: &Ephemeris,
    ) -> Result<(), PipelineError> {
        let Self { blocks, span_s: Some(span_s) } = self else { return Ok(()) };
        if found.instrument.is_none() {
            return Ok(());
        }
        let solved = solver.solve(PassBlocks { number: found.passes, span_s, blocks }, ephemeris)?;
        found.passes += 1;
        found.unused += solved.unused;
        found.solutions.extend(solved.solutions);
        Ok(())
    }
}

impl Round<'_> {
    /// Solves all passes; `watch` receives after each pass the number of solved passes and of bytes read.
    fn solve(&self, watch: &mut dyn FnMut(u64, u64)) -> Result<FoundSolutions, PipelineError> {
        let mut found = FoundSolutions::default();
        let mut ephemeris = Ephemeris::default();
        let mut solver = PassSolver::new(self.solver, self.van_vleck.cloned(), self.maps.to_vec());
        let mut open = OpenPass::default();
        let mut bytes_before = 0;
        for file in self.files {
            let mut reader = DownlinkReader::open(file)?;
            while let Some(frame) = reader.next_frame()? {
                if self.cancel.is_cancelled() {
                    return Ok(found);
                }
                match frame {
                    GroundFrame::Instrument(instrument) => match &found.instrument {
                        None => {
                            check_frequencies(self.model_files, &instrument.frequencies_hz())?;
                            solver.describe(&instrument, self.model_key)?;
                            found.instrument = Some(instrument);
                        }
                        Some(before) if *before == instrument => {}
                        Some(_) => return Err(self.other_instrument_error(file)),
                    },
                    GroundFrame::Ephemeris(segment) => {
                        ephemeris.insert(segment);
                    }
                    GroundFrame::Visibilities(block) if block.pair.i != block.pair.j && !block.is_empty() => {
                        let last = block.len() - 1;
                        let block_s = [block.middle_s(0), block.middle_s(last)];
                        let gap_s = self.solver.pass_gap_s;
                        match open.span_s {
                            Some([_, until_s]) if block_s[0] > until_s + gap_s => {
                                let pass = std::mem::take(&mut open);
                                pass.solve(&mut found, &mut solver, &ephemeris)?;
                                watch(found.passes, bytes_before + reader.bytes());
                            }
                            Some([from_s, _]) if block_s[1] < from_s - gap_s => {
                                found.late += block.len() as u64;
                                continue;
                            }
                            _ => {}
                        }
                        let [from_s, until_s] = open.span_s.unwrap_or(block_s);
                        open.span_s = Some([from_s.min(block_s[0]), until_s.max(block_s[1])]);
                        open.blocks.push(block);
                    }
                    _ => {}
                }
            }
            bytes_before += reader.bytes();
        }
        open.solve(&mut found, &mut solver, &ephemeris)?;
        if found.instrument.is_none() {
            return Err(invalid("downlink", self.names(), "files with a description of the instrument"));
        }
        if found.passes == 0 {
            return Err(invalid(
                "downlink",
                self.names(),
                "files with visibilities: there is nothing to solve",
            ));
        }
        Ok(found)
    }

    fn names(&self) -> String {
        self.files.iter().map(|file| file.display().to_string()).collect::<Vec<_>>().join(", ")
    }

    fn other_instrument_error(&self, file: &Path) -> PipelineError {
        let first = self.files.first().map_or_else(String::new, |first| first.display().to_string());
        let expected =
            format!("the instrument of {first}, its daughters and channels: one mission at a time");
        invalid("downlink", file.display(), expected)
    }
}

/// Sorts files by the times of their first visibilities, as passes are solved in order of time. Files without visibilities come last.
/// If any file cannot be read twice, the order is unchanged.
fn sorted_by_time(files: &[PathBuf]) -> Result<Vec<PathBuf>, PipelineError> {
    let is_repeatable = |file: &PathBuf| std::fs::metadata(file).is_ok_and(|found| found.is_file());
    if files.len() < 2 || !files.iter().all(is_repeatable) {
        return Ok(files.to_vec());
    }
    let mut timed = files
        .iter()
        .map(|file| Ok((first_time_s(file)?, file.clone())))
        .collect::<Result<Vec<(f64, PathBuf)>, PipelineError>>()?;
    timed.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    Ok(timed.into_iter().map(|(_, file)| file).collect())
}

/// Time of the first visibility of a file, s; infinity without any.
fn first_time_s(file: &Path) -> Result<f64, PipelineError> {
    let mut reader = DownlinkReader::open(file)?;
    while let Some(frame) = reader.next_frame()? {
        match frame {
            GroundFrame::Visibilities(block) if !block.is_empty() => return Ok(block.middle_s(0)),
            _ => {}
        }
    }
    Ok(f64::INFINITY)
}

/// Root mean square of the relative change of the gains that are good in both rounds.
fn change_rms(before: &[PassSolution], after: &[PassSolution]) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for (before, after) in before.iter().zip(after) {
        for (before, after) in before.daughters.iter().zip(&after.daughters) {
            for (a, b) in before.gains.iter().zip(&after.gains) {
                if a.state == GainState::Good && b.state == GainState::Good {
                    let turn = (b.phase_deg - a.phase_deg).to_radians();
                    sum += (num_complex::Complex64::from_polar(b.amplitude / a.amplitude, turn) - 1.0)
                        .norm_sqr();
                    count += 1.0;
                }
            }
        }
    }
    if count > 0.0 { (sum / count).sqrt() } else { f64::INFINITY }
}

/// Returns `config` with the gains of a file applied.
#[must_use]
pub fn with_gains(config: &Config, gains: PathBuf) -> Config {
    let mut config = config.clone();
    config.calibration.hook = CalibrationHook::AntennaGains;
    config.calibration.gains_file = Some(gains);
    config
}

/// Maps the calibrated data without the held-out passes, one map per channel; empty without solutions.
fn make_maps(
    config: &Config,
    files: &[PathBuf],
    found: &FoundSolutions,
    folder: &Path,
    cancel: &Cancel,
) -> Result<Vec<SkyMap>, PipelineError> {
    let Some((gains, instrument)) = found.gains(true).zip(found.instrument.as_ref()) else {
        return Ok(Vec::new());
    };
    create_folder(folder)?;
    let path = folder.join("gains.json");
    write_json(&path, &gains)?;
    let mut config = with_gains(config, path);
    config.products.pictures = false;
    config.map.snapshot_every_s = 0.0;
    let ground = Ground::new(&config.ground(WAIT_BYTES))?;
    replay(FileSource::open(files)?, &config, ground, folder, cancel, &mut |_| {})?;
    if cancel.is_cancelled() {
        return Ok(Vec::new());
    }
    let read = |channel: &crate::frames::Channel| {
        let path = folder.join(frequency_folder(channel.frequency_hz)).join("map.fits");
        Ok(read_whole_map(&path, &ReadOptions::default())?)
    };
    instrument.channels.iter().map(read).collect()
}

fn map_cl_k2(map: &SkyMap) -> Result<Vec<f64>, PipelineError> {
    Ok(auto_cl(&map.harmonics(2 * map.nside(), &AnalysisOptions::default())?))
}
