//! Solutions of passes: from visibilities as they were sent, with the positions of the packets.

use std::collections::BTreeMap;

use super::config::{CalibrationMode, SolverConfig};
use super::diagnosis::{Datum, diagnose};
use super::model::{KnownSignal, Offsets};
use super::positions::{Search, modelled};
use super::smooth::smooth;
use super::solution::{PassData, PassSolution, solve_from, solve_pass_in_parts};
use super::sums::ModelledBlock;
use super::verdict::ModelVerdict;
use crate::array::{Ephemeris, orbit_normal_hat};
use crate::calibration::{CalibrationError, VanVleck};
use crate::frames::{Flags, Instrument, PlacedVisibilities, VisibilityBlock};
use crate::sky::SkyMap;
use crate::units::vector::Vec3;
use crate::units::{InvalidValue, Pair};

/// Time between the two positions that determine an orbit's plane, s.
const NORMAL_S: f64 = 60.0;

/// Data of a pass as they were sent.
pub struct PassBlocks {
    /// Number of the pass.
    pub number: u64,
    /// Middle of the first and of the last integration, s since the epoch.
    pub span_s: [f64; 2],
    /// Visibilities of pairs of daughters, in the order of use.
    pub blocks: Vec<VisibilityBlock>,
}

/// Result of a pass.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SolvedPass {
    /// Solutions; empty without positions.
    pub solutions: Vec<PassSolution>,
    /// Number of visibilities left out because of a flag, or for lack of positions.
    pub unused: u64,
}

/// Solves pass after pass for one instrument.
pub struct PassSolver {
    config: SolverConfig,
    van_vleck: Option<VanVleck>,
    /// Maps of the sky, until the instrument is known.
    maps: Vec<SkyMap>,
    known: Option<(Instrument, KnownSignal)>,
}

impl PassSolver {
    /// Creates a solver with `maps` of the sky (K), one per channel; none for an artificial signal alone.
    #[must_use]
    pub fn new(config: &SolverConfig, van_vleck: Option<VanVleck>, maps: Vec<SkyMap>) -> Self {
        let mode = config.known_signal(!maps.is_empty());
        Self { config: SolverConfig { mode, ..config.clone() }, van_vleck, maps, known: None }
    }

    /// The settings in use; the mode is that of the known signal.
    #[must_use]
    pub fn config(&self) -> &SolverConfig {
        &self.config
    }

    /// Accepts the description of the instrument; only the first one counts.
    ///
    /// # Errors
    /// The number of maps is not that of the channels; the reference daughter does not exist; maps have pixels
    /// without value, or are finer than `sky_model` accepts.
    pub fn describe(&mut self, instrument: &Instrument, model_key: &str) -> Result<(), CalibrationError> {
        if self.known.is_some() {
            return Ok(());
        }
        self.config.check_instrument(instrument, self.maps.len(), model_key)?;
        self.config.can_model(&self.maps)?;
        let signal = KnownSignal::new(&self.config, instrument, &self.maps)?;
        self.maps = Vec::new();
        self.known = Some((instrument.clone(), signal));
        Ok(())
    }

    /// The instrument, once it has been described.
    #[must_use]
    pub fn instrument(&self) -> Option<&Instrument> {
        self.known.as_ref().map(|(instrument, _)| instrument)
    }

    /// Solves a pass with the positions in `ephemeris`.
    ///
    /// # Errors
    /// The model does not cover the positions.
    pub fn solve(&mut self, pass: PassBlocks, ephemeris: &Ephemeris) -> Result<SolvedPass, CalibrationError> {
        let Self { config, van_vleck, known, .. } = self;
        let Some((instrument, signal)) = known else { return Ok(SolvedPass::default()) };
        let PassBlocks { number, span_s, blocks } = pass;
        let all: usize = blocks.iter().map(VisibilityBlock::len).sum();
        let placed = place_blocks(config.mode, van_vleck.as_ref(), blocks, ephemeris, instrument);
        let used: usize = placed.iter().map(|(placed, _)| placed.len()).sum();
        let Some(normal_hat) = normals(instrument, ephemeris, 0.5 * (span_s[0] + span_s[1])) else {
            return Ok(SolvedPass { solutions: Vec::new(), unused: all as u64 });
        };
        let frequencies: Vec<f64> = instrument.channels.iter().map(|channel| channel.frequency_hz).collect();
        let task = PassTask { config, frequencies: &frequencies, number, span_s, normal_hat };
        let solutions = task.solve(&placed, signal)?;
        let period = u64::from(config.hold_out_every);
        let is_held_out = period > 0 && number % period == period - 1;
        let solutions = solutions.into_iter().map(|solution| PassSolution { is_held_out, ..solution });
        Ok(SolvedPass { solutions: solutions.collect(), unused: (all - used) as u64 })
    }
}

impl SolverConfig {
    /// Checks that the settings fit an instrument and the number of maps of the sky; `model_key` is the configuration
    /// key of the maps.
    ///
    /// # Errors
    /// The number of channels differs, or the reference daughter does not exist.
    pub fn check_instrument(
        &self,
        instrument: &Instrument,
        maps: usize,
        model_key: &str,
    ) -> Result<(), InvalidValue> {
        let channels = instrument.channels.len();
        let invalid = |key: &str, value: String, expected: String| InvalidValue {
            key: key.to_owned(),
            value,
            expected: expected.into(),
        };
        if maps != 0 && maps != channels {
            let expected = format!("{channels}: one for each channel of the downlink");
            return Err(invalid(model_key, format!("({maps} maps)"), expected));
        }
        let reference = self.reference_daughter;
        if reference > u32::from(instrument.satellites) {
            let expected = format!("1 to {}, the daughters of the downlink", instrument.satellites);
            return Err(invalid("calibrate.reference_daughter", reference.to_string(), expected));
        }
        Ok(())
    }
}

/// One pass and the solver's inputs.
pub(super) struct PassTask<'a> {
    pub(super) config: &'a SolverConfig,
    pub(super) frequencies: &'a [f64],
    pub(super) number: u64,
    pub(super) span_s: [f64; 2],
    pub(super) normal_hat: Vec<Vec3>,
}

impl PassTask<'_> {
    /// Solutions of its parts; with positions, about those found before.
    pub(super) fn solve(
        &self,
        placed: &[(PlacedVisibilities, bool)],
        signal: &mut KnownSignal,
    ) -> Result<Vec<PassSolution>, CalibrationError> {
        let Self { config, normal_hat, .. } = self;
        let solves_positions = config.position_sigma_m > 0.0;
        let search_result = if solves_positions { Some(self.search(placed).find(signal)?) } else { None };
        let offset_m = search_result.as_ref().map_or_else(
            || vec![[0.0; 3]; normal_hat.len()],
            |search_result| search_result.position_m.clone(),
        );
        let mut offsets = Offsets { offset_m, normal_hat: normal_hat.clone() };
        let all: Vec<(&PlacedVisibilities, bool)> = placed.iter().map(|(placed, on)| (placed, *on)).collect();
        let mut solutions = Vec::new();
        for _ in 0..if solves_positions { config.position_rounds } else { 1 } {
            let mut blocks = modelled(&all, signal, &offsets)?;
            solutions = match solves_positions {
                true => self
                    .intervals()
                    .map(|span_s| self.solve_interval(span_s, &mut blocks, &offsets))
                    .collect(),
                false => {
                    self.intervals().flat_map(|span_s| self.solve_in_parts(span_s, &mut blocks)).collect()
                }
            };
            if !solves_positions {
                solutions.iter_mut().for_each(|solution| name_faults(solution, placed, &blocks, signal));
            }
            let ([solution], true) = (&solutions[..], solves_positions) else { break };
            let now: Vec<[f64; 3]> = solution.daughters.iter().map(|daughter| daughter.position_m).collect();
            let sigma = |n: usize, axis: usize| solution.daughters[n].position_sigma_m[axis];
            let has_moved = |(n, (now, before)): (usize, (&[f64; 3], &[f64; 3]))| {
                (0..3).any(|axis| (now[axis] - before[axis]).abs() > 0.1 * sigma(n, axis))
            };
            let moved = now.iter().zip(&offsets.offset_m).enumerate().any(has_moved);
            offsets.offset_m = now;
            if !moved {
                break;
            }
        }
        smooth(&mut solutions, config);
        if let Some(search_result) = search_result {
            solutions
                .iter_mut()
                .for_each(|solution| solution.mark_ambiguous(|n, hz| search_result.is_ambiguous(n, hz)));
        }
        Ok(solutions)
    }

    /// Intervals of equal length. The last includes the end.
    fn intervals(&self) -> impl Iterator<Item = [f64; 2]> {
        let [from_s, until_s] = self.span_s;
        let parts = self.config.solutions_per_pass;
        let step_s = (until_s - from_s) / f64::from(parts) * (1.0 + 1e-9) + 1e-6;
        (0..parts).map(move |k| {
            let start_s = from_s + f64::from(k) * step_s;
            [start_s, start_s + step_s]
        })
    }

    fn solve_interval(
        &self,
        span_s: [f64; 2],
        blocks: &mut [ModelledBlock],
        offsets: &Offsets,
    ) -> PassSolution {
        let normal_hat = self.normal_hat.clone();
        let data = PassData { pass: self.number, span_s, blocks, normal_hat };
        solve_from(self.config, self.frequencies, data, &offsets.offset_m)
    }

    fn solve_in_parts(&self, span_s: [f64; 2], blocks: &mut [ModelledBlock]) -> Vec<PassSolution> {
        let data = PassData { pass: self.number, span_s, blocks, normal_hat: self.normal_hat.clone() };
        solve_pass_in_parts(self.config, self.frequencies, data)
    }

    fn search<'a>(&'a self, placed: &'a [(PlacedVisibilities, bool)]) -> Search<'a> {
        let Self { config, frequencies, normal_hat, .. } = self;
        Search { config, frequencies_hz: frequencies, span_s: self.full_span_s(), normal_hat, placed }
    }

    /// Interval of the whole pass, its end included.
    fn full_span_s(&self) -> [f64; 2] {
        let [from_s, until_s] = self.span_s;
        [from_s, until_s + 1e-6 * (1.0 + until_s - from_s)]
    }
}

/// Names what is wrong with the models of channels whose residuals say that they are.
fn name_faults(
    solution: &mut PassSolution,
    placed: &[(PlacedVisibilities, bool)],
    blocks: &[ModelledBlock],
    signal: &KnownSignal,
) {
    let span_s = solution.from_s..solution.until_s;
    for (channel, verdict) in solution.models.iter_mut().enumerate() {
        let ModelVerdict::Wrong { fault, .. } = verdict else { continue };
        let mut pairs: BTreeMap<Pair, Vec<Datum>> = BTreeMap::new();
        for ((placed, beacon_is_on), block) in placed.iter().zip(blocks) {
            if block.channel != channel || *beacon_is_on {
                continue;
            }
            let used =
                (0..block.time_s.len()).filter(|k| !block.is_out[*k] && span_s.contains(&block.time_s[*k]));
            pairs.entry(block.pair).or_default().extend(used.map(|k| Datum {
                geometry: signal.geometry(placed, k),
                value_k_sr: block.value_k_sr[k],
                weight: block.weight[k],
                model: block.model[k][0],
            }));
        }
        let pairs: Vec<Vec<Datum>> = pairs.into_values().filter(|pair| !pair.is_empty()).collect();
        *fault = diagnose(&pairs, &|ratio, positions| signal.at_ratio(channel, ratio, positions));
    }
}

/// Normals of the orbits of all daughters; `None` if a position is unknown.
fn normals(instrument: &Instrument, ephemeris: &Ephemeris, middle_s: f64) -> Option<Vec<Vec3>> {
    let normal = |n: usize| {
        let [before, after] = [-0.5, 0.5].map(|part| ephemeris.position_at(middle_s + part * NORMAL_S, n));
        orbit_normal_hat(before?, after?)
    };
    (0..usize::from(instrument.satellites)).map(normal).collect()
}

/// Visibilities with positions, and whether the artificial signal is on.
fn place_blocks(
    mode: CalibrationMode,
    van_vleck: Option<&VanVleck>,
    blocks: Vec<VisibilityBlock>,
    ephemeris: &Ephemeris,
    instrument: &Instrument,
) -> Vec<(PlacedVisibilities, bool)> {
    let place_block = |mut block: VisibilityBlock, beacon_is_on: bool| {
        let channel = instrument.channel_of(block.channel, block.pair)?;
        for flags in &mut block.flags {
            let fits = *flags == if beacon_is_on { Flags::BEACON } else { Flags::GOOD };
            *flags = if fits { Flags::GOOD } else { Flags::UNCALIBRATED };
        }
        if let Some(van_vleck) = van_vleck {
            van_vleck.apply(&mut block, channel.width_hz);
        }
        let (placed, _) = ephemeris.place(&block, channel.frequency_hz);
        (!placed.is_empty()).then_some((placed, beacon_is_on))
    };
    blocks
        .into_iter()
        .flat_map(|block| {
            let on = (mode != CalibrationMode::Sky).then(|| place_block(block.clone(), true)).flatten();
            let off = (mode != CalibrationMode::Beacon).then(|| place_block(block, false)).flatten();
            [on, off]
        })
        .flatten()
        .collect()
}
