//! Gain solutions of the passes of a downlink, and their summary.

use std::fmt;

use serde::Serialize;

use crate::calibration::solver::{
    CalibrationMode, GainEstimate, GainState, InstrumentEvent, PassSolution, SolverConfig, gains_file,
    instrument_events,
};
use crate::calibration::{GainsFile, SolvedGains};
use crate::frames::Instrument;
use crate::numerics::median;

const EVENTS_SHOWN: usize = 20;

/// One round of calibration: all passes solved with one sky model.
#[derive(Clone, Debug, Serialize)]
pub struct CalibrateRound {
    /// Number of the round; 0 uses the given model.
    pub round: u32,
    /// The known signal: the sky, the artificial signal, or both.
    pub mode: CalibrationMode,
    /// Root mean square of the relative change of the gains since the previous round.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change_rms: Option<f64>,
    /// Mean reduced chi-square of the passes that are used for maps.
    pub chi_square: f64,
    /// Mean reduced chi-square of the held-out passes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chi_square_held_out: Option<f64>,
    /// Angular power spectrum of the maps that this round was solved with, by channel, K^2.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub map_cl_k2: Vec<Vec<f64>>,
}

/// Summary of `lunarray calibrate`.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CalibrateSummary {
    /// Number of passes.
    pub passes: u64,
    /// Number of solutions; a pass may have several.
    pub solutions: u64,
    /// Solutions that converged.
    pub converged: u64,
    /// Visibilities used.
    pub visibilities: u64,
    /// Visibilities left out as outliers.
    pub outliers: u64,
    /// Visibilities left out because they are flagged or have no positions.
    pub unused: u64,
    /// Visibilities that arrived after their pass was solved.
    pub late: u64,
    /// Number of gains that are not good, and of all gains.
    pub gains_not_good: [u64; 2],
    /// Median standard deviation of a daughter's good phases, deg, by channel and daughter; `None` without a good one.
    pub phase_sigma_deg: Vec<Vec<Option<f64>>>,
    /// The rounds, in order.
    pub rounds: Vec<CalibrateRound>,
    /// Events of the instrument: jumps of clocks, steps of gains, interference, bursts.
    pub events: Vec<InstrumentEvent>,
    /// Conventions for what the data do not determine.
    pub conventions: Vec<String>,
    /// Warnings, and how to mend what is wrong.
    pub warnings: Vec<String>,
    /// Whether the calibration was interrupted: then nothing is written.
    pub cancelled: bool,
}

impl fmt::Display for CalibrateSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [bad, all] = self.gains_not_good;
        write!(
            f,
            "{} passes: {} solutions, {} of them converged; {} visibilities, {} outliers, {} unused, {} late; {bad} of {all} gains \
             are not good",
            self.passes,
            self.solutions,
            self.converged,
            self.visibilities,
            self.outliers,
            self.unused,
            self.late,
        )?;
        for event in self.events.iter().take(EVENTS_SHOWN) {
            write!(f, "\nevent: {event}")?;
        }
        match self.events.len().saturating_sub(EVENTS_SHOWN) {
            0 => Ok(()),
            more => write!(f, "\nand {more} more events, in solutions.json"),
        }
    }
}

/// Solutions of all passes, with counts of the data outside of them.
#[derive(Default)]
pub(in crate::pipeline) struct FoundSolutions {
    pub(in crate::pipeline) instrument: Option<Instrument>,
    pub(in crate::pipeline) solutions: Vec<PassSolution>,
    pub(in crate::pipeline) passes: u64,
    pub(in crate::pipeline) unused: u64,
    pub(in crate::pipeline) late: u64,
}

impl FoundSolutions {
    /// Solutions that the ground segment has found so far.
    pub(in crate::pipeline) fn from_gains(gains: &SolvedGains) -> Self {
        let passes = gains.passes();
        Self {
            instrument: gains.instrument(),
            passes: passes.len() as u64,
            unused: passes.iter().map(|pass| pass.unused).sum(),
            late: gains.late(),
            solutions: passes.into_iter().flat_map(|pass| pass.solutions).collect(),
        }
    }

    /// The summary of a calibration of one round; `has_maps`: it was solved with maps of the sky.
    pub(in crate::pipeline) fn single_round_summary(
        &self,
        solver: &SolverConfig,
        has_maps: bool,
    ) -> CalibrateSummary {
        let mut summary = self.summary(solver);
        summary.rounds = vec![self.round(0, solver.known_signal(has_maps), None, Vec::new())];
        summary
    }

    /// The content of `gains.json`; `None` without solutions.
    pub(in crate::pipeline) fn gains(&self, without_held_out: bool) -> Option<GainsFile> {
        let instrument = self.instrument.as_ref()?;
        (!self.solutions.is_empty())
            .then(|| gains_file(&self.solutions, &instrument.channels, without_held_out))
    }

    /// The record of the round that found these solutions.
    pub(in crate::pipeline) fn round(
        &self,
        round: u32,
        mode: CalibrationMode,
        change_rms: Option<f64>,
        map_cl_k2: Vec<Vec<f64>>,
    ) -> CalibrateRound {
        let mean = |is_held_out: bool| {
            // A part of a pass may have no data.
            let solutions = self
                .solutions
                .iter()
                .filter(|solution| solution.is_held_out == is_held_out && solution.visibilities > 0);
            let (sum, count) =
                solutions.fold((0.0, 0.0), |(sum, count), found| (sum + found.chi_square, count + 1.0));
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

    fn all_gains(&self) -> impl Iterator<Item = &GainEstimate> + Clone {
        self.solutions.iter().flat_map(|solution| &solution.daughters).flat_map(|daughter| &daughter.gains)
    }

    /// Warnings about late data, and about solutions without a good gain.
    fn warnings(&self, solver: &SolverConfig) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.late > 0 {
            warnings.push(format!(
                "{} visibilities came after their passes had been solved and are in no solution: `lunarray calibrate` uses all, if times of \
                 files do not overlap",
                self.late
            ));
        }
        let mut gains = self.all_gains();
        if !self.solutions.is_empty() && gains.all(|gain| gain.state != GainState::Good) {
            warnings.push(format!(
                "no gain is good, so a replay with them makes no map: see whether the reference (calibrate.reference_daughter = {}) has \
                 data, and whether the model is the sky of these data (chi-square)",
                solver.reference_daughter
            ));
        }
        warnings
    }

    /// The summary of the solutions, without rounds.
    pub(in crate::pipeline) fn summary(&self, solver: &SolverConfig) -> CalibrateSummary {
        let satellites = self.instrument.as_ref().map_or(0, |instrument| usize::from(instrument.satellites));
        let frequencies_hz = self.instrument.as_ref().map_or_else(Vec::new, Instrument::frequencies_hz);
        let channels = frequencies_hz.len();
        let sigma_deg = |c: usize, n: usize| {
            let gains = self.solutions.iter().map(|solution| &solution.daughters[n].gains[c]);
            let good = gains.filter(|gain| gain.state == GainState::Good);
            median(good.map(|gain| gain.phase_sigma_deg).collect())
        };
        let (bad, all) = self
            .all_gains()
            .fold((0, 0), |(bad, all), gain| (bad + u64::from(gain.state != GainState::Good), all + 1));
        CalibrateSummary {
            passes: self.passes,
            solutions: self.solutions.len() as u64,
            converged: self.solutions.iter().filter(|solution| solution.converged).count() as u64,
            visibilities: self.solutions.iter().map(|solution| solution.visibilities).sum(),
            outliers: self.solutions.iter().map(|solution| solution.outliers).sum(),
            unused: self.unused,
            late: self.late,
            gains_not_good: [bad, all],
            phase_sigma_deg: (0..channels)
                .map(|c| (0..satellites).map(|n| sigma_deg(c, n)).collect())
                .collect(),
            events: instrument_events(&self.solutions),
            conventions: solver.conventions(&frequencies_hz),
            warnings: self.warnings(solver),
            ..CalibrateSummary::default()
        }
    }
}
