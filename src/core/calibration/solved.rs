//! Gains found while the data arrive, pass by pass.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bincode::{Decode, Encode};

use super::solver::{InstrumentEvent, PassSolution, gains_file, instrument_events};
use super::{AntennaGains, Calibration, CalibrationError, CalibrationReport};
use crate::frames::{Instrument, PlacedVisibilities};

/// Number of earlier passes from which the usual scatter of gains is estimated.
const USUAL_PASSES: usize = 64;

/// A pass whose data are complete, with its solutions.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct ClosedPass {
    /// Number of the pass, in the order of closing.
    pub number: u64,
    /// Middle of the first and of the last integration, s since the epoch.
    pub span_s: [f64; 2],
    /// Visibilities not used in the solutions, because of a flag or for lack of positions.
    pub unused: u64,
    /// Solutions; empty if the gains are unknown.
    pub solutions: Vec<PassSolution>,
}

impl ClosedPass {
    /// Whether the pass fits an instrument. Checkpoints are untrusted input.
    #[must_use]
    pub fn fits_instrument(&self, instrument: &Instrument) -> bool {
        let (satellites, channels) = (usize::from(instrument.satellites), instrument.channels.len());
        let solution_fits = |solution: &PassSolution| {
            solution.daughters.len() == satellites
                && solution.normal_hat.len() == satellites
                && solution.daughters.iter().all(|daughter| daughter.gains.len() == channels)
                && solution.outlier_fractions.has_channels(channels)
                && solution.model_error.len() == channels
                && solution.models.len() == channels
                && solution.correlations.len() == channels
                && (1..=satellites).contains(&(solution.reference as usize))
        };
        self.span_s.iter().all(|time_s| time_s.is_finite())
            && self.span_s[0] <= self.span_s[1]
            && self.solutions.iter().all(solution_fits)
    }
}

/// Solutions of all closed passes; clones share them. As a [`Calibration`] it applies the gains of the pass nearest
/// to a block.
#[derive(Clone, Debug, Default)]
pub struct SolvedGains(Arc<Mutex<SolvedTable>>);

#[derive(Debug, Default)]
struct SolvedTable {
    gap_s: f64,
    /// Number of draws of the errors of gains.
    error_draws: usize,
    instrument: Option<Instrument>,
    /// Passes in the order of time, with their gains if these are known.
    passes: Vec<(ClosedPass, Option<AntennaGains>)>,
    /// Events of all sessions, as each was judged when its pass was closed.
    events: Vec<InstrumentEvent>,
    /// Number of events of earlier sessions.
    earlier_events: usize,
    late: u64,
}

impl SolvedTable {
    /// The pass nearest to a time and its distance in time, s; `None` beyond `gap_s`.
    fn nearest(&mut self, time_s: f64) -> Option<(&mut (ClosedPass, Option<AntennaGains>), f64)> {
        let next = self.passes.partition_point(|(pass, _)| pass.span_s[0] <= time_s);
        let with_distance = |at: usize| {
            let (ClosedPass { span_s: [from_s, until_s], .. }, _) = self.passes.get(at)?;
            Some((at, (from_s - time_s).max(time_s - until_s).max(0.0)))
        };
        let before = next.checked_sub(1).and_then(with_distance);
        let (at, distance_s) = match (before, with_distance(next)) {
            (Some(before), Some(after)) => Some(if before.1 <= after.1 { before } else { after }),
            (before, after) => before.or(after),
        }?;
        Some((&mut self.passes[at], distance_s)).filter(|(_, distance_s)| *distance_s <= self.gap_s)
    }
}

impl SolvedGains {
    /// Creates a table without passes. Gains of a pass apply to data up to `gap_s` away from it, and visibilities get `error_draws` draws of
    /// the errors of their gains.
    #[must_use]
    pub fn new(gap_s: f64, error_draws: usize) -> Self {
        Self(Arc::new(Mutex::new(SolvedTable { gap_s, error_draws, ..SolvedTable::default() })))
    }

    fn table(&self) -> MutexGuard<'_, SolvedTable> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the instrument.
    pub fn describe(&self, instrument: &Instrument) {
        self.table().instrument = Some(instrument.clone());
    }

    /// The instrument, once it has been described.
    #[must_use]
    pub fn instrument(&self) -> Option<Instrument> {
        self.table().instrument.clone()
    }

    /// Time to the nearest closed pass, s; `None` if it is too far for its gains to apply.
    #[must_use]
    pub fn distance_to_pass_s(&self, time_s: f64) -> Option<f64> {
        self.table().nearest(time_s).map(|(_, distance_s)| distance_s)
    }

    /// Adds a closed pass. Its gains count as unknown if its solutions cannot be applied.
    pub fn add_pass(&self, pass: ClosedPass) {
        let mut table = self.table();
        let known = table.instrument.as_ref().filter(|_| !pass.solutions.is_empty());
        let gains = known.map(|instrument| {
            let file = gains_file(&pass.solutions, &instrument.channels, false);
            let gains = AntennaGains::new(&file).ok()?;
            Some(gains.with_error_draws(&file, table.error_draws, instrument.seed))
        });
        let (number, from_s) = (pass.number, pass.span_s[0]);
        let at = table.passes.partition_point(|(other, _)| other.span_s[0] <= from_s);
        table.passes.insert(at, (pass, gains.flatten()));
        let known = &table.passes[at.saturating_sub(USUAL_PASSES)..=at];
        let solutions: Vec<PassSolution> =
            known.iter().flat_map(|(pass, _)| pass.solutions.iter().cloned()).collect();
        let events = instrument_events(&solutions);
        table.events.extend(events.into_iter().filter(|event| event.pass() == number));
    }

    /// Counts visibilities that arrived after their pass had been closed.
    pub fn count_late(&self, visibilities: u64) {
        self.table().late += visibilities;
    }

    /// Number of visibilities that arrived after their pass had been closed.
    #[must_use]
    pub fn late(&self) -> u64 {
        self.table().late
    }

    /// All closed passes in the order of time.
    #[must_use]
    pub fn passes(&self) -> Vec<ClosedPass> {
        self.table().passes.iter().map(|(pass, _)| pass.clone()).collect()
    }

    /// Number of closed passes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.table().passes.len()
    }

    /// Whether no pass is closed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Begins a new session: [`Self::events_since`] counts from here.
    pub fn begin_session(&self) {
        let mut table = self.table();
        table.earlier_events = table.events.len();
    }

    /// Events of this session, except the first `seen`.
    #[must_use]
    pub fn events_since(&self, seen: usize) -> Vec<InstrumentEvent> {
        let table = self.table();
        table.events.get(table.earlier_events + seen..).unwrap_or_default().to_vec()
    }
}

impl Calibration for SolvedGains {
    fn name(&self) -> &'static str {
        "solve"
    }

    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError> {
        let Some(&first_s) = block.time_s.first() else { return Ok(CalibrationReport::default()) };
        let mut table = self.table();
        if let Some(((_, Some(gains)), _)) = table.nearest(first_s) {
            return gains.apply(block);
        }
        let unusable_gain = block.len();
        block.truncate(0);
        Ok(CalibrationReport { kept: 0, unusable_gain })
    }
}
