//! Gains that are found while the data arrive, pass by pass.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bincode::{Decode, Encode};

use super::solver::{InstrumentEvent, PassSolution, gains_file, instrument_events};
use super::{AntennaGains, Calibration, CalibrationError, CalibrationReport};
use crate::frames::{Instrument, PlacedVisibilities};

/// Solutions before a pass that say what is usual, for its events.
const USUAL: usize = 64;

/// A pass that is closed.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct ClosedPass {
    /// Its number, in the order of closing.
    pub number: u64,
    /// Middle of its first and of its last integration, s since the epoch.
    pub span_s: [f64; 2],
    /// Visibilities that were left out of its solutions because of a flag, or without positions.
    pub unused: u64,
    /// Its solutions; none if nothing is known of its gains.
    pub solutions: Vec<PassSolution>,
}

impl ClosedPass {
    /// Whether it is one of an instrument; a forged state may hold anything.
    #[must_use]
    pub fn is_of(&self, instrument: &Instrument) -> bool {
        let (satellites, channels) = (usize::from(instrument.satellites), instrument.channels.len());
        let is_sound = |solution: &PassSolution| {
            solution.daughters.len() == satellites
                && solution.normal_hat.len() == satellites
                && solution.daughters.iter().all(|daughter| daughter.gains.len() == channels)
                && solution.outlier_parts.is_of(channels)
                && solution.model_error.len() == channels
                && (1..=satellites).contains(&(solution.reference as usize))
        };
        self.span_s.iter().all(|time_s| time_s.is_finite())
            && self.span_s[0] <= self.span_s[1]
            && self.solutions.iter().all(is_sound)
    }
}

/// What is known of passes; clones share it. As a calibration it applies the gains of the pass that a block belongs to.
#[derive(Clone, Debug, Default)]
pub struct SolvedGains(Arc<Mutex<SolvedTable>>);

#[derive(Debug, Default)]
struct SolvedTable {
    gap_s: f64,
    instrument: Option<Instrument>,
    /// In the order of time.
    passes: Vec<(ClosedPass, Option<AntennaGains>)>,
    /// As they were told.
    events: Vec<InstrumentEvent>,
    /// Of them, those of earlier sessions.
    told_before: usize,
    late: u64,
}

impl SolvedTable {
    /// The pass nearest to a time, and how far it is, s.
    fn nearest(&mut self, time_s: f64) -> Option<(&mut (ClosedPass, Option<AntennaGains>), f64)> {
        let next = self.passes.partition_point(|(pass, _)| pass.span_s[0] <= time_s);
        let away_s = |at: usize| {
            let (ClosedPass { span_s: [from_s, until_s], .. }, _) = self.passes.get(at)?;
            Some((at, (from_s - time_s).max(time_s - until_s).max(0.0)))
        };
        let before = next.checked_sub(1).and_then(away_s);
        let (at, away_s) = match (before, away_s(next)) {
            (Some(before), Some(after)) => Some(if before.1 <= after.1 { before } else { after }),
            (before, after) => before.or(after),
        }?;
        Some((&mut self.passes[at], away_s)).filter(|(_, away_s)| *away_s <= self.gap_s)
    }
}

impl SolvedGains {
    /// Of no pass; gains of one hold for data up to `gap_s` away from it.
    #[must_use]
    pub fn new(gap_s: f64) -> Self {
        Self(Arc::new(Mutex::new(SolvedTable { gap_s, ..SolvedTable::default() })))
    }

    fn table(&self) -> MutexGuard<'_, SolvedTable> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the description of the instrument.
    pub fn describe(&self, instrument: &Instrument) {
        self.table().instrument = Some(instrument.clone());
    }

    /// The instrument, once it is described.
    #[must_use]
    pub fn instrument(&self) -> Option<Instrument> {
        self.table().instrument.clone()
    }

    /// Time to the nearest pass that is closed, s; `None` if there is none near enough for its gains to hold.
    #[must_use]
    pub fn distance_to_pass_s(&self, time_s: f64) -> Option<f64> {
        self.table().nearest(time_s).map(|(_, away_s)| away_s)
    }

    /// Adds a pass. Where its solutions are no gains that can be applied, they are not known.
    pub fn close(&self, pass: ClosedPass) {
        let mut table = self.table();
        let known = table.instrument.as_ref().filter(|_| !pass.solutions.is_empty());
        let gains = known.map(|instrument| {
            AntennaGains::new(&gains_file(&pass.solutions, &instrument.channels, false)).ok()
        });
        let (number, from_s) = (pass.number, pass.span_s[0]);
        let at = table.passes.partition_point(|(other, _)| other.span_s[0] <= from_s);
        table.passes.insert(at, (pass, gains.flatten()));
        let known = &table.passes[at.saturating_sub(USUAL)..=at];
        let solutions: Vec<PassSolution> =
            known.iter().flat_map(|(pass, _)| pass.solutions.iter().cloned()).collect();
        let events = instrument_events(&solutions);
        table.events.extend(events.into_iter().filter(|event| event.pass() == number));
    }

    /// Counts visibilities of a pass that was closed before they arrived.
    pub fn count_late(&self, visibilities: u64) {
        self.table().late += visibilities;
    }

    /// Visibilities of passes that were closed before they arrived.
    #[must_use]
    pub fn late(&self) -> u64 {
        self.table().late
    }

    /// All passes that are closed, in the order of time.
    #[must_use]
    pub fn passes(&self) -> Vec<ClosedPass> {
        self.table().passes.iter().map(|(pass, _)| pass.clone()).collect()
    }

    /// Number of passes that are closed.
    #[must_use]
    pub fn len(&self) -> usize {
        self.table().passes.len()
    }

    /// Whether no pass is closed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Begins a new session of passes.
    pub fn begin_session(&self) {
        let mut table = self.table();
        table.told_before = table.events.len();
    }

    /// Events of this session after the first `told`, each as it was judged when its pass was closed.
    #[must_use]
    pub fn events_since(&self, told: usize) -> Vec<InstrumentEvent> {
        let table = self.table();
        table.events.get(table.told_before + told..).unwrap_or_default().to_vec()
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
