//! Calibration of a downlink: solutions pass by pass from a known signal, in turn with the map if asked for.

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::calibrate_products::{create, write, write_json};
use super::config::Config;
use super::error::PipelineError;
use super::run::{lock_folder, replay};
use crate::array::{Ephemeris, orbit_normal_hat};
use crate::calibration::solver::{
    CalibrationMode, GainState, InstrumentEvent, KnownSignal, ModelledBlock, Offsets, PassData, PassSolution,
    SolverConfig, gains_file, instrument_events, solve_pass,
};
use crate::calibration::{CalibrationHook, GainsFile, VanVleck};
use crate::downlink::{DownlinkReader, FileSource};
use crate::frames::{Flags, GroundFrame, Instrument, PlacedVisibilities, VisibilityBlock};
use crate::ground::{Ground, WAIT_BYTES};
use crate::runtime::Cancel;
use crate::sky::SkyMap;
use crate::sky::fits::{ReadOptions, read_whole_map};
use crate::sky::harmonics::AnalysisOptions;
use crate::sky::spectra::auto_cl;
use crate::units::InvalidValue;

/// Time between the two positions that give an orbit's plane, s.
const NORMAL_S: f64 = 60.0;

/// A downlink to be calibrated.
pub struct CalibrateJob<'a> {
    /// Settings of the ground segment.
    pub config: &'a Config,
    /// Downlink files in the order of time.
    pub files: &'a [PathBuf],
    /// Map of the sky for each channel, K; may be empty if an artificial signal is known.
    pub models: Vec<SkyMap>,
    /// Folder for the products.
    pub out: &'a Path,
    /// Is told after each pass how far it is.
    pub watch: CalibrateWatcher<'a>,
}

/// Follows a calibration.
pub type CalibrateWatcher<'a> = &'a mut dyn FnMut(CalibrateProgress);

/// How far a calibration is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CalibrateProgress {
    /// Number of the round; 0 with the given model.
    pub round: u32,
    /// Number of the last one, unless gains settle before.
    pub last_round: u32,
    /// Passes solved in it; `None` while its map is made.
    pub passes: Option<u64>,
    /// Part of the data that it has read, 0 to 1.
    pub read: f64,
}

/// One solution of all passes, and the map that it was made with.
#[derive(Clone, Debug, Serialize)]
pub struct CalibrateRound {
    /// Number; 0 with the given model.
    pub round: u32,
    /// What was known: of the sky, of the artificial signal, or of both.
    pub mode: CalibrationMode,
    /// Root mean square change of the gains since the round before, relative to one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change_rms: Option<f64>,
    /// Mean of chi_square over the passes that make maps.
    pub chi_square: f64,
    /// The same of passes that are held out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chi_square_held_out: Option<f64>,
    /// Power by degree of the maps of this round, by channel, K^2; those that the round was made with.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub map_cl_k2: Vec<Vec<f64>>,
}

/// What `lunarray calibrate` found.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CalibrateSummary {
    /// Passes.
    pub passes: u64,
    /// Solutions.
    pub solutions: u64,
    /// Those that converged.
    pub converged: u64,
    /// Visibilities used.
    pub visibilities: u64,
    /// Left out as outliers.
    pub outliers: u64,
    /// Left out because of a flag, or without positions.
    pub unused: u64,
    /// Of passes that had been solved before they arrived.
    pub late: u64,
    /// Gains that are not good, of all.
    pub gains_not_good: [u64; 2],
    /// Median standard deviation of a daughter's phase, deg, by channel and daughter.
    pub phase_sigma_deg: Vec<Vec<f64>>,
    /// Rounds.
    pub rounds: Vec<CalibrateRound>,
    /// What happened to the instrument: jumps of clocks, steps of gains, interference, bursts.
    pub events: Vec<InstrumentEvent>,
    /// What the data do not determine, and what decides it.
    pub conventions: Vec<String>,
    /// Whether it was ended early; nothing is written then.
    pub cancelled: bool,
}

/// Finds the gains of every pass, and writes them: `gains.json` for a replay, `solutions.csv`, `solutions.json` and
/// `solutions.png`. Nothing of it is there before all of it is known, so a repetition after an interruption gives the same.
///
/// # Errors
/// Files that cannot be read; maps that do not fit the channels; a failed replay.
pub fn calibrate(job: CalibrateJob<'_>, cancel: &Cancel) -> Result<CalibrateSummary, PipelineError> {
    let CalibrateJob { config, files, models, out, watch } = job;
    let solver = &config.calibrate;
    check(config, &models)?;
    let _lock = lock_folder(out)?;
    let first = match (solver.mode, models.is_empty()) {
        (CalibrationMode::Joint, true) => SolverConfig { mode: CalibrationMode::Beacon, ..solver.clone() },
        _ => solver.clone(),
    };
    let van_vleck = config.calibration.van_vleck()?;
    let bytes = files.iter().map(|file| std::fs::metadata(file).map_or(0, |file| file.len())).sum::<u64>();
    let last_round = solver.map_rounds;
    let solve = |round: u32, solver: &SolverConfig, maps: &[SkyMap], watch: CalibrateWatcher<'_>| {
        let passes = Passes { solver, files, maps, van_vleck: van_vleck.as_ref(), cancel };
        passes.solve(&mut |passes, read_bytes| {
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
        let powers = maps.iter().map(power).collect::<Result<_, PipelineError>>()?;
        let next = solve(round, solver, &maps, watch)?;
        let change = change_rms(&found.solutions, &next.solutions);
        rounds.push(next.round(round, solver.mode, Some(change), powers));
        found = next;
        if change < solver.settled {
            break;
        }
    }
    let mut summary = found.summary(solver);
    summary.rounds = rounds;
    summary.cancelled = cancel.is_cancelled();
    if !summary.cancelled {
        write(out, &found, &summary, config.products.pictures)?;
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

fn check(config: &Config, models: &[SkyMap]) -> Result<(), PipelineError> {
    let (solver, calibration) = (&config.calibrate, &config.calibration);
    if calibration.sub_bands != 1 {
        return Err(invalid(
            "calibration.sub_bands",
            calibration.sub_bands,
            "1: gains are of channels as they are sent",
        ));
    }
    if calibration.hook != CalibrationHook::Identity {
        return Err(invalid(
            "calibration.hook",
            "\"antenna-gains\"",
            "\"identity\": gains are found from data as sent",
        ));
    }
    let needs_sky = solver.mode == CalibrationMode::Sky;
    if needs_sky && models.is_empty() {
        let expected = "maps of the sky, one a channel, or calibrate.mode = \"beacon\" or \"joint\"";
        return Err(invalid("--model", "(none)", expected));
    }
    if solver.mode == CalibrationMode::Beacon && solver.map_rounds > 0 {
        let expected = "0 with calibrate.mode = \"beacon\", which uses no map";
        return Err(invalid("calibrate.map_rounds", solver.map_rounds, expected));
    }
    Ok(())
}

/// The passes of a downlink.
struct Passes<'a> {
    solver: &'a SolverConfig,
    files: &'a [PathBuf],
    maps: &'a [SkyMap],
    van_vleck: Option<&'a VanVleck>,
    cancel: &'a Cancel,
}

/// Solutions of all passes.
#[derive(Default)]
pub(super) struct FoundSolutions {
    pub(super) instrument: Option<Instrument>,
    pub(super) solutions: Vec<PassSolution>,
    passes: u64,
    unused: u64,
    late: u64,
}

/// What is being read.
#[derive(Default)]
struct OpenPass {
    blocks: Vec<VisibilityBlock>,
    span_s: Option<[f64; 2]>,
}

impl Passes<'_> {
    /// Solves all passes; `watch` hears after each their number and the bytes that are read.
    fn solve(&self, watch: &mut dyn FnMut(u64, u64)) -> Result<FoundSolutions, PipelineError> {
        let mut found = FoundSolutions::default();
        let mut ephemeris = Ephemeris::default();
        let mut signal: Option<KnownSignal> = None;
        let mut open = OpenPass::default();
        let mut bytes_before = 0;
        for file in self.files {
            let mut reader = DownlinkReader::open(file)?;
            while let Some(frame) = reader.next_frame()? {
                if self.cancel.is_cancelled() {
                    return Ok(found);
                }
                match frame {
                    GroundFrame::Instrument(instrument) if found.instrument.is_none() => {
                        signal = Some(self.signal(&instrument)?);
                        found.instrument = Some(instrument);
                    }
                    GroundFrame::Ephemeris(segment) => {
                        ephemeris.insert(segment);
                    }
                    GroundFrame::Visibilities(block) if block.pair.i != block.pair.j && !block.is_empty() => {
                        let last = block.len() - 1;
                        let of = [block.middle_s(0), block.middle_s(last)];
                        let gap_s = self.solver.pass_gap_s;
                        match open.span_s {
                            Some([_, until_s]) if of[0] > until_s + gap_s => {
                                let pass = std::mem::take(&mut open);
                                self.close(pass, &ephemeris, &mut signal, &mut found)?;
                                watch(found.passes, bytes_before + reader.bytes());
                            }
                            Some([from_s, _]) if of[1] < from_s - gap_s => {
                                found.late += block.len() as u64;
                                continue;
                            }
                            _ => {}
                        }
                        let [from_s, until_s] = open.span_s.unwrap_or(of);
                        open.span_s = Some([from_s.min(of[0]), until_s.max(of[1])]);
                        open.blocks.push(block);
                    }
                    _ => {}
                }
            }
            bytes_before += reader.bytes();
        }
        self.close(open, &ephemeris, &mut signal, &mut found)?;
        if found.instrument.is_none() {
            let names: Vec<String> = self.files.iter().map(|file| file.display().to_string()).collect();
            return Err(invalid("downlink", names.join(", "), "files with a description of the instrument"));
        }
        Ok(found)
    }

    fn signal(&self, instrument: &Instrument) -> Result<KnownSignal, PipelineError> {
        let (maps, channels) = (self.maps.len(), instrument.channels.len());
        if maps != 0 && maps != channels {
            return Err(invalid(
                "--model",
                format!("({maps} maps)"),
                format!("{channels}: one a channel of the downlink"),
            ));
        }
        let reference = self.solver.reference_daughter;
        if reference > u32::from(instrument.satellites) {
            let expected = format!("1 to {}, the daughters of the downlink", instrument.satellites);
            return Err(invalid("calibrate.reference_daughter", reference, expected));
        }
        Ok(KnownSignal::new(self.solver, instrument, self.maps)?)
    }

    /// Solves a pass.
    fn close(
        &self,
        pass: OpenPass,
        ephemeris: &Ephemeris,
        signal: &mut Option<KnownSignal>,
        found: &mut FoundSolutions,
    ) -> Result<(), PipelineError> {
        let (Some([from_s, until_s]), Some(signal)) = (pass.span_s, signal.as_mut()) else { return Ok(()) };
        let Some(instrument) = &found.instrument else { return Ok(()) };
        let all: usize = pass.blocks.iter().map(VisibilityBlock::len).sum();
        let placed = self.placed(pass.blocks, ephemeris, instrument);
        let used: usize = placed.iter().map(|(placed, _)| placed.len()).sum();
        found.unused += (all - used) as u64;
        let number = found.passes;
        found.passes += 1;
        let middle_s = 0.5 * (from_s + until_s);
        let normal = |n: usize| {
            let [before, after] =
                [-0.5, 0.5].map(|part| ephemeris.position_at(middle_s + part * NORMAL_S, n));
            orbit_normal_hat(before?, after?)
        };
        let normals: Option<Vec<_>> = (0..usize::from(instrument.satellites)).map(normal).collect();
        let Some(normal_hat) = normals else {
            found.unused += used as u64;
            return Ok(());
        };
        let frequencies: Vec<f64> = instrument.channels.iter().map(|channel| channel.frequency_hz).collect();
        let parts = self.solver.solutions_per_pass;
        // The end belongs to the last part.
        let step_s = (until_s - from_s) / f64::from(parts) * (1.0 + 1e-9) + 1e-6;
        let spans = (0..parts).map(|k| {
            let start_s = from_s + f64::from(k) * step_s;
            [start_s, start_s + step_s]
        });
        let mut offsets =
            Offsets { offset_m: vec![[0.0; 3]; normal_hat.len()], normal_hat: normal_hat.clone() };
        let moves = self.solver.position_sigma_m > 0.0;
        let mut solutions = Vec::new();
        for _ in 0..if moves { self.solver.position_rounds } else { 1 } {
            let mut blocks = modelled(&placed, signal, &offsets)?;
            let solve = |span_s: [f64; 2]| {
                let normal_hat = normal_hat.clone();
                solve_pass(
                    self.solver,
                    &frequencies,
                    PassData { pass: number, span_s, blocks: &mut blocks, normal_hat },
                )
            };
            solutions = spans.clone().map(solve).collect();
            let [solution] = &solutions[..] else { break };
            let now: Vec<[f64; 3]> = solution.daughters.iter().map(|daughter| daughter.position_m).collect();
            let sigma = |n: usize, axis: usize| solution.daughters[n].position_sigma_m[axis];
            let apart = |(n, (now, before)): (usize, (&[f64; 3], &[f64; 3]))| {
                (0..3).any(|axis| (now[axis] - before[axis]).abs() > 0.1 * sigma(n, axis))
            };
            let moved = now.iter().zip(&offsets.offset_m).enumerate().any(apart);
            offsets.offset_m = now;
            if !moved {
                break;
            }
        }
        let every = u64::from(self.solver.hold_out_every);
        let is_held_out = every > 0 && number % every == every - 1;
        found
            .solutions
            .extend(solutions.into_iter().map(|solution| PassSolution { is_held_out, ..solution }));
        Ok(())
    }

    /// Visibilities with positions, and whether the artificial signal is on in them.
    fn placed(
        &self,
        blocks: Vec<VisibilityBlock>,
        ephemeris: &Ephemeris,
        instrument: &Instrument,
    ) -> Vec<(PlacedVisibilities, bool)> {
        let with = |mut block: VisibilityBlock, is_on: bool| {
            let channel = instrument.channel_of(block.channel, block.pair)?;
            for flags in &mut block.flags {
                let fits = *flags == if is_on { Flags::BEACON } else { Flags::GOOD };
                *flags = if fits { Flags::GOOD } else { Flags::UNCALIBRATED };
            }
            if let Some(van_vleck) = self.van_vleck {
                van_vleck.apply(&mut block, channel.width_hz);
            }
            let (placed, _) = ephemeris.place(&block, channel.frequency_hz);
            (!placed.is_empty()).then_some((placed, is_on))
        };
        let mode = self.solver.mode;
        blocks
            .into_iter()
            .flat_map(|block| {
                let on = (mode != CalibrationMode::Sky).then(|| with(block.clone(), true)).flatten();
                let off = (mode != CalibrationMode::Beacon).then(|| with(block, false)).flatten();
                [on, off]
            })
            .flatten()
            .collect()
    }
}

fn modelled(
    placed: &[(PlacedVisibilities, bool)],
    signal: &mut KnownSignal,
    offsets: &Offsets,
) -> Result<Vec<ModelledBlock>, PipelineError> {
    let block = |(placed, is_on): &(PlacedVisibilities, bool)| {
        Ok(ModelledBlock {
            channel: placed.channel.0.into(),
            pair: placed.pair,
            time_s: placed.time_s.clone(),
            value_k_sr: placed.value_k_sr.clone(),
            weight: placed.weight.clone(),
            model: signal.model(placed, offsets, *is_on)?,
            is_out: vec![false; placed.len()],
        })
    };
    placed.iter().map(block).collect()
}

impl FoundSolutions {
    /// The file of gains; `None` without solutions.
    pub(super) fn gains(&self, without_held_out: bool) -> Option<GainsFile> {
        let instrument = self.instrument.as_ref()?;
        (!self.solutions.is_empty())
            .then(|| gains_file(&self.solutions, &instrument.channels, without_held_out))
    }

    fn round(
        &self,
        round: u32,
        mode: CalibrationMode,
        change_rms: Option<f64>,
        map_cl_k2: Vec<Vec<f64>>,
    ) -> CalibrateRound {
        let mean = |held_out: bool| {
            let of = self.solutions.iter().filter(|solution| solution.is_held_out == held_out);
            let (sum, count) = of.fold((0.0, 0.0), |(sum, count), one| (sum + one.chi_square, count + 1.0));
            (count > 0.0).then(|| sum / count)
        };
        CalibrateRound {
            round,
            mode,
            change_rms,
            chi_square: mean(false).unwrap_or(f64::NAN),
            chi_square_held_out: mean(true),
            map_cl_k2,
        }
    }

    fn summary(&self, solver: &SolverConfig) -> CalibrateSummary {
        let satellites = self.instrument.as_ref().map_or(0, |instrument| usize::from(instrument.satellites));
        let channels = self.instrument.as_ref().map_or(0, |instrument| instrument.channels.len());
        let median = |c: usize, n: usize| {
            let mut sigmas: Vec<f64> =
                self.solutions.iter().map(|one| one.daughters[n].gains[c].phase_sigma_deg).collect();
            sigmas.sort_unstable_by(f64::total_cmp);
            sigmas.get(sigmas.len() / 2).copied().unwrap_or(f64::NAN)
        };
        let gains = self.solutions.iter().flat_map(|one| &one.daughters).flat_map(|daughter| &daughter.gains);
        let (bad, all) =
            gains.fold((0, 0), |(bad, all), gain| (bad + u64::from(gain.state != GainState::Good), all + 1));
        CalibrateSummary {
            passes: self.passes,
            solutions: self.solutions.len() as u64,
            converged: self.solutions.iter().filter(|one| one.converged).count() as u64,
            visibilities: self.solutions.iter().map(|one| one.visibilities).sum(),
            outliers: self.solutions.iter().map(|one| one.outliers).sum(),
            unused: self.unused,
            late: self.late,
            gains_not_good: [bad, all],
            phase_sigma_deg: (0..channels).map(|c| (0..satellites).map(|n| median(c, n)).collect()).collect(),
            events: instrument_events(&self.solutions),
            conventions: solver.conventions(),
            ..CalibrateSummary::default()
        }
    }
}

/// Root mean square of the relative change of gains that are good in both.
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

/// `config` with the gains of a file.
pub(super) fn with_gains(config: &Config, gains: PathBuf) -> Config {
    let mut config = config.clone();
    config.calibration.hook = CalibrationHook::AntennaGains;
    config.calibration.gains_file = Some(gains);
    config
}

/// Maps of the data with solutions, one a channel.
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
    create(folder)?;
    let path = folder.join("gains.json");
    write_json(&path, &gains)?;
    let mut config = with_gains(config, path);
    config.products.pictures = false;
    config.map.snapshot_every_s = 0.0;
    let ground = Ground::new(&config.ground(WAIT_BYTES))?;
    replay(FileSource::open(files)?, &config, ground, folder, cancel, &mut |_watched| {})?;
    if cancel.is_cancelled() {
        return Ok(Vec::new());
    }
    let read = |channel: &crate::frames::Channel| {
        let path = folder.join(format!("{:.3}MHz", channel.frequency_hz / 1e6)).join("map.fits");
        Ok(read_whole_map(&path, &ReadOptions::default())?)
    };
    instrument.channels.iter().map(read).collect()
}

/// Power of a map by degree, K^2.
fn power(map: &SkyMap) -> Result<Vec<f64>, PipelineError> {
    Ok(auto_cl(&map.harmonics(2 * map.nside(), &AnalysisOptions::default())?))
}
