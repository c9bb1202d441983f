//! Solutions of the passes of a downlink, and what is told of them.

use std::fmt;

use serde::Serialize;

use crate::calibration::solver::{
    CalibrationMode, GainState, InstrumentEvent, PassSolution, SolverConfig, gains_file, instrument_events,
};
use crate::calibration::{GainsFile, SolvedGains};
use crate::frames::Instrument;
use crate::numerics::median;

/// Most events that are printed.
const EVENTS_SHOWN: usize = 20;

/// One solution of all passes, and the map that it was made with.
#[derive(Clone, Debug, Serialize)]
pub struct CalibrateRound {
    /// Number; 0 with the given model.
    pub round: u32,
    /// The known signal: the sky, the artificial signal, or both.
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

/// Summary of `lunarray calibrate`.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CalibrateSummary {
    /// Passes.
    pub passes: u64,
    /// Solutions.
    pub solutions: u64,
    /// Solutions that converged.
    pub converged: u64,
    /// Visibilities used.
    pub visibilities: u64,
    /// Left out as outliers.
    pub outliers: u64,
    /// Left out because of a flag, or without positions.
    pub unused: u64,
    /// Visibilities that arrived after their pass was solved.
    pub late: u64,
    /// Gains that are not good, and all gains.
    pub gains_not_good: [u64; 2],
    /// Median standard deviation of a daughter's phase, deg, by channel and daughter.
    pub phase_sigma_deg: Vec<Vec<f64>>,
    /// Rounds.
    pub rounds: Vec<CalibrateRound>,
    /// Events of the instrument: jumps of clocks, steps of gains, interference, bursts.
    pub events: Vec<InstrumentEvent>,
    /// Conventions for what the data do not determine.
    pub conventions: Vec<String>,
    /// Warnings, and how to mend what is wrong.
    pub warnings: Vec<String>,
    /// Whether it was ended early: then nothing is written.
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

/// Solutions of all passes.
#[derive(Default)]
pub(in crate::pipeline) struct FoundSolutions {
    pub(in crate::pipeline) instrument: Option<Instrument>,
    pub(in crate::pipeline) solutions: Vec<PassSolution>,
    pub(in crate::pipeline) passes: u64,
    pub(in crate::pipeline) unused: u64,
    pub(in crate::pipeline) late: u64,
}

impl FoundSolutions {
    /// Solutions that a ground has found so far.
    pub(in crate::pipeline) fn of(gains: &SolvedGains) -> Self {
        let passes = gains.passes();
        Self {
            instrument: gains.instrument(),
            passes: passes.len() as u64,
            unused: passes.iter().map(|pass| pass.unused).sum(),
            late: gains.late(),
            solutions: passes.into_iter().flat_map(|pass| pass.solutions).collect(),
        }
    }

    /// The summary of solutions with the given maps, or without.
    pub(in crate::pipeline) fn of_one_round(
        &self,
        solver: &SolverConfig,
        has_maps: bool,
    ) -> CalibrateSummary {
        let mut summary = self.summary(solver);
        summary.rounds = vec![self.round(0, solver.known_signal(has_maps), None, Vec::new())];
        summary
    }

    /// The file of gains; `None` without solutions.
    pub(in crate::pipeline) fn gains(&self, without_held_out: bool) -> Option<GainsFile> {
        let instrument = self.instrument.as_ref()?;
        (!self.solutions.is_empty())
            .then(|| gains_file(&self.solutions, &instrument.channels, without_held_out))
    }

    /// A round of these solutions.
    pub(in crate::pipeline) fn round(
        &self,
        round: u32,
        mode: CalibrationMode,
        change_rms: Option<f64>,
        map_cl_k2: Vec<Vec<f64>>,
    ) -> CalibrateRound {
        let mean = |held_out: bool| {
            // A part of a pass may have no data.
            let of = self.solutions.iter().filter(|one| one.is_held_out == held_out && one.visibilities > 0);
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

    /// Warnings about data that are not in the solutions.
    fn warnings(&self, solver: &SolverConfig) -> Vec<String> {
        let mut warnings = Vec::new();
        if self.late > 0 {
            warnings.push(format!(
                "{} visibilities came after their passes had been solved and are in no solution: `lunarray calibrate` uses all of files whose times do not \
                 overlap",
                self.late
            ));
        }
        let gains = self.solutions.iter().flat_map(|one| &one.daughters).flat_map(|daughter| &daughter.gains);
        if !self.solutions.is_empty() && gains.clone().all(|gain| gain.state != GainState::Good) {
            warnings.push(format!(
                "no gain is good, so that a replay with them maps nothing: the reference (calibrate.reference_daughter = {}) has to have \
                 data, and the model has to be that of the data (chi-square)",
                solver.reference_daughter
            ));
        }
        warnings
    }

    /// Their summary.
    pub(in crate::pipeline) fn summary(&self, solver: &SolverConfig) -> CalibrateSummary {
        let satellites = self.instrument.as_ref().map_or(0, |instrument| usize::from(instrument.satellites));
        let hz = |instrument: &Instrument| instrument.channels.iter().map(|one| one.frequency_hz).collect();
        let frequencies_hz: Vec<f64> = self.instrument.as_ref().map_or_else(Vec::new, hz);
        let channels = frequencies_hz.len();
        let sigma_deg = |c: usize, n: usize| {
            let sigmas = self.solutions.iter().map(|one| one.daughters[n].gains[c].phase_sigma_deg);
            median(sigmas.collect()).unwrap_or(f64::NAN)
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
