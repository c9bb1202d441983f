//! The passes of a downlink: visibilities as they were sent, with the positions of the packets, to solutions.

use super::config::{CalibrationMode, SolverConfig};
use super::model::{KnownSignal, Offsets};
use super::positions::{Search, modelled};
use super::smooth::smooth;
use super::solution::{PassData, PassSolution, solve_from, solve_pass_in_parts};
use super::sums::ModelledBlock;
use crate::array::{Ephemeris, orbit_normal_hat};
use crate::calibration::{CalibrationError, VanVleck};
use crate::frames::{Flags, Instrument, PlacedVisibilities, VisibilityBlock};
use crate::sky::SkyMap;
use crate::units::InvalidValue;
use crate::units::vector::Vec3;

/// Time between the two positions that give an orbit's plane, s.
const NORMAL_S: f64 = 60.0;

/// Data of a pass, as they were sent.
pub struct PassBlocks {
    /// Number of the pass.
    pub number: u64,
    /// Middle of the first and of the last integration, s since the epoch.
    pub span_s: [f64; 2],
    /// Visibilities of two daughters, in the order in which they are to be used.
    pub blocks: Vec<VisibilityBlock>,
}

/// What became of a pass.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SolvedPass {
    /// Its solutions; none without positions.
    pub solutions: Vec<PassSolution>,
    /// Visibilities that were left out because of a flag, or without positions.
    pub unused: u64,
}

/// Solves pass after pass for one instrument.
pub struct PassSolver {
    config: SolverConfig,
    van_vleck: Option<VanVleck>,
    /// Until the instrument is known.
    maps: Vec<SkyMap>,
    known: Option<(Instrument, KnownSignal)>,
}

impl PassSolver {
    /// Solves with `maps` of the sky (K), one a channel; none for an artificial signal alone.
    #[must_use]
    pub fn new(config: &SolverConfig, van_vleck: Option<VanVleck>, maps: Vec<SkyMap>) -> Self {
        let mode = config.known_signal(!maps.is_empty());
        Self { config: SolverConfig { mode, ..config.clone() }, van_vleck, maps, known: None }
    }

    /// What it solves with; the mode is that of the signal that is known.
    #[must_use]
    pub fn config(&self) -> &SolverConfig {
        &self.config
    }

    /// Takes the description of the instrument; later ones change nothing.
    ///
    /// # Errors
    /// A number of maps that is not that of the channels; a reference daughter that it has not; maps with pixels without value, or
    /// finer than `sky_model` takes.
    pub fn describe(&mut self, instrument: &Instrument, model_key: &str) -> Result<(), CalibrationError> {
        if self.known.is_some() {
            return Ok(());
        }
        self.config.fits(instrument, self.maps.len(), model_key)?;
        self.config.can_model(&self.maps)?;
        let signal = KnownSignal::new(&self.config, instrument, &self.maps)?;
        self.maps = Vec::new();
        self.known = Some((instrument.clone(), signal));
        Ok(())
    }

    /// The instrument, once it is described.
    #[must_use]
    pub fn instrument(&self) -> Option<&Instrument> {
        self.known.as_ref().map(|(instrument, _)| instrument)
    }

    /// Solves a pass by the positions in `ephemeris`.
    ///
    /// # Errors
    /// Positions that the model does not cover.
    pub fn solve(&mut self, pass: PassBlocks, ephemeris: &Ephemeris) -> Result<SolvedPass, CalibrationError> {
        let Self { config, van_vleck, known, .. } = self;
        let Some((instrument, signal)) = known else { return Ok(SolvedPass::default()) };
        let PassBlocks { number, span_s, blocks } = pass;
        let all: usize = blocks.iter().map(VisibilityBlock::len).sum();
        let placed = placed(config.mode, van_vleck.as_ref(), blocks, ephemeris, instrument);
        let used: usize = placed.iter().map(|(placed, _)| placed.len()).sum();
        let Some(normal_hat) = normals(instrument, ephemeris, 0.5 * (span_s[0] + span_s[1])) else {
            return Ok(SolvedPass { solutions: Vec::new(), unused: all as u64 });
        };
        let frequencies: Vec<f64> = instrument.channels.iter().map(|channel| channel.frequency_hz).collect();
        let task = Task { config, frequencies: &frequencies, number, span_s, normal_hat };
        let solutions = task.solve(&placed, signal)?;
        let every = u64::from(config.hold_out_every);
        let is_held_out = every > 0 && number % every == every - 1;
        let solutions = solutions.into_iter().map(|solution| PassSolution { is_held_out, ..solution });
        Ok(SolvedPass { solutions: solutions.collect(), unused: (all - used) as u64 })
    }
}

impl SolverConfig {
    /// Requires that an instrument can be solved with so many maps of the sky; `model_key` is what names them.
    ///
    /// # Errors
    /// Another number of channels; a reference daughter that is not there.
    pub fn fits(&self, instrument: &Instrument, maps: usize, model_key: &str) -> Result<(), InvalidValue> {
        let channels = instrument.channels.len();
        let invalid = |key: &str, value: String, expected: String| InvalidValue {
            key: key.to_owned(),
            value,
            expected: expected.into(),
        };
        if maps != 0 && maps != channels {
            let expected = format!("{channels}: one a channel of the downlink");
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
pub(super) struct Task<'a> {
    pub(super) config: &'a SolverConfig,
    pub(super) frequencies: &'a [f64],
    pub(super) number: u64,
    pub(super) span_s: [f64; 2],
    pub(super) normal_hat: Vec<Vec3>,
}

impl Task<'_> {
    /// Solutions of its parts; with positions, about those found before.
    pub(super) fn solve(
        &self,
        placed: &[(PlacedVisibilities, bool)],
        signal: &mut KnownSignal,
    ) -> Result<Vec<PassSolution>, CalibrationError> {
        let Self { config, normal_hat, .. } = self;
        let moves = config.position_sigma_m > 0.0;
        let sought = if moves { Some(self.search(placed).find(signal)?) } else { None };
        let offset_m = sought
            .as_ref()
            .map_or_else(|| vec![[0.0; 3]; normal_hat.len()], |sought| sought.position_m.clone());
        let mut offsets = Offsets { offset_m, normal_hat: normal_hat.clone() };
        let all: Vec<(&PlacedVisibilities, bool)> = placed.iter().map(|(placed, on)| (placed, *on)).collect();
        let mut solutions = Vec::new();
        for _ in 0..if moves { config.position_rounds } else { 1 } {
            let mut blocks = modelled(&all, signal, &offsets)?;
            solutions = match moves {
                true => self.parts().map(|span_s| self.part(span_s, &mut blocks, &offsets)).collect(),
                false => self.parts().flat_map(|span_s| self.steady_parts(span_s, &mut blocks)).collect(),
            };
            let ([solution], true) = (&solutions[..], moves) else { break };
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
        smooth(&mut solutions);
        if let Some(sought) = sought {
            solutions
                .iter_mut()
                .for_each(|solution| solution.mark_ambiguous(|n, hz| sought.is_ambiguous(n, hz)));
        }
        Ok(solutions)
    }

    /// Intervals of equal length; the end belongs to the last.
    fn parts(&self) -> impl Iterator<Item = [f64; 2]> {
        let [from_s, until_s] = self.span_s;
        let parts = self.config.solutions_per_pass;
        let step_s = (until_s - from_s) / f64::from(parts) * (1.0 + 1e-9) + 1e-6;
        (0..parts).map(move |k| {
            let start_s = from_s + f64::from(k) * step_s;
            [start_s, start_s + step_s]
        })
    }

    fn part(&self, span_s: [f64; 2], blocks: &mut [ModelledBlock], about: &Offsets) -> PassSolution {
        let normal_hat = self.normal_hat.clone();
        let data = PassData { pass: self.number, span_s, blocks, normal_hat };
        solve_from(self.config, self.frequencies, data, &about.offset_m)
    }

    fn steady_parts(&self, span_s: [f64; 2], blocks: &mut [ModelledBlock]) -> Vec<PassSolution> {
        let data = PassData { pass: self.number, span_s, blocks, normal_hat: self.normal_hat.clone() };
        solve_pass_in_parts(self.config, self.frequencies, data)
    }

    fn search<'a>(&'a self, placed: &'a [(PlacedVisibilities, bool)]) -> Search<'a> {
        let Self { config, frequencies, normal_hat, .. } = self;
        Search { config, frequencies_hz: frequencies, span_s: self.whole_s(), normal_hat, placed }
    }

    /// All of the pass; its end belongs to it.
    fn whole_s(&self) -> [f64; 2] {
        let [from_s, until_s] = self.span_s;
        [from_s, until_s + 1e-6 * (1.0 + until_s - from_s)]
    }
}

/// Normals of the orbits of all daughters; `None` if a position is not known.
fn normals(instrument: &Instrument, ephemeris: &Ephemeris, middle_s: f64) -> Option<Vec<Vec3>> {
    let normal = |n: usize| {
        let [before, after] = [-0.5, 0.5].map(|part| ephemeris.position_at(middle_s + part * NORMAL_S, n));
        orbit_normal_hat(before?, after?)
    };
    (0..usize::from(instrument.satellites)).map(normal).collect()
}

/// Visibilities with positions, and whether the artificial signal is on in them.
fn placed(
    mode: CalibrationMode,
    van_vleck: Option<&VanVleck>,
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
        if let Some(van_vleck) = van_vleck {
            van_vleck.apply(&mut block, channel.width_hz);
        }
        let (placed, _) = ephemeris.place(&block, channel.frequency_hz);
        (!placed.is_empty()).then_some((placed, is_on))
    };
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
