//! Holds visibilities back until the gains of their pass are known.
//!
//! Visibilities wait in the hold buffer, as they do for their positions. A pass ends with the first visibilities that begin more
//! than `calibrate.pass_gap_s` after it. Two passes are open at most: the newest, and one of data that come late, which ends with
//! late data of another pass. Data of a pass that is closed already, and those within that gap of one, get its gains; they count
//! as late.

use crate::array::Ephemeris;
use crate::calibration::solver::{PassBlocks, PassSolver};
use crate::calibration::{CalibrationError, ClosedPass, SolvedGains};
use crate::downlink::wire::VisibilitiesOutline;
use crate::frames::{Instrument, VisibilityBlock};
use crate::sky::fits::check_frequencies;

/// What names the maps of the known sky.
pub(super) const MODEL: &str = "calibrate.model_files";

/// The place of the newest pass.
const NEWEST: usize = 0;
/// The place of a pass of late data.
const LATE: usize = 1;

/// Hears of each pass that is closed.
pub type PassObserver = Box<dyn FnMut(&SolvedGains) + Send>;

/// What a checkpoint keeps of it.
#[derive(Clone, Debug, Default, PartialEq, bincode::Encode, bincode::Decode)]
pub struct PassGateState {
    pub(super) passes: Vec<ClosedPass>,
    open: [Option<[f64; 2]>; 2],
    late: u64,
}

impl PassGateState {
    /// Whether it is one of an instrument; a forged state may hold anything.
    pub(super) fn is_sound(&self, instrument: Option<&Instrument>) -> bool {
        let is_open =
            |[from_s, until_s]: &[f64; 2]| from_s.is_finite() && until_s.is_finite() && from_s <= until_s;
        let is_of = |pass: &ClosedPass| instrument.is_some_and(|instrument| pass.fits_instrument(instrument));
        self.passes.iter().all(is_of) && self.open.iter().flatten().all(is_open)
    }
}

/// Says which visibilities are due, and solves passes that have ended.
pub(super) struct PassGate {
    solver: PassSolver,
    gains: SolvedGains,
    gap_s: f64,
    /// Middle of the first and of the last integration, by [`NEWEST`] and [`LATE`].
    open: [Option<[f64; 2]>; 2],
    observer: Option<PassObserver>,
    /// Held visibilities may not have been noted.
    pub(super) is_behind: bool,
}

impl PassGate {
    pub(super) fn new(solver: PassSolver) -> Self {
        let gap_s = solver.config().pass_gap_s;
        let gains = SolvedGains::new(gap_s);
        Self { solver, gains, gap_s, open: [None; 2], observer: None, is_behind: true }
    }

    /// Where the gains are.
    pub(super) fn gains(&self) -> &SolvedGains {
        &self.gains
    }

    pub(super) fn observed_by(&mut self, observer: PassObserver) {
        self.observer = Some(observer);
    }

    pub(super) fn describe(&mut self, instrument: &Instrument) -> Result<(), CalibrationError> {
        self.is_behind = true;
        check_frequencies(&self.solver.config().model_files, &instrument.frequencies_hz())?;
        self.gains.describe(instrument);
        self.solver.describe(instrument, MODEL)
    }

    pub(super) fn state(&self) -> PassGateState {
        PassGateState { passes: self.gains.passes(), open: self.open, late: self.gains.late() }
    }

    /// Goes on from a state; the instrument is described.
    pub(super) fn resume(&mut self, state: PassGateState) {
        let PassGateState { mut passes, open, late } = state;
        // As they were closed, so that each is judged by what was known then.
        passes.sort_unstable_by_key(|pass| pass.number);
        passes.into_iter().for_each(|pass| self.gains.add_pass(pass));
        self.gains.count_late(late);
        self.gains.begin_session();
        self.open = open;
    }

    /// Whether what a packet claims to hold waits for no gains.
    pub(super) fn is_due(&self, outline: &VisibilitiesOutline) -> bool {
        let middle_s = outline.middle_s;
        if self.solver.instrument().is_some_and(|instrument| instrument.is_spectrum(outline.pair)) {
            return true;
        }
        let is_open = || self.open.iter().flatten().any(|span_s| self.is_near(*span_s, [middle_s; 2]));
        self.gains.distance_s(middle_s).is_some_and(|distance_s| distance_s == 0.0 || !is_open())
    }

    fn is_near(&self, [from_s, until_s]: [f64; 2], of_s: [f64; 2]) -> bool {
        !(of_s[0] > until_s + self.gap_s || of_s[1] < from_s - self.gap_s)
    }

    fn is_of(&self, which: usize, of_s: [f64; 2]) -> bool {
        self.open[which].is_some_and(|span_s| self.is_near(span_s, of_s))
    }

    /// The open pass that has ended, as this block is of another.
    pub(super) fn ended_by(&self, block: &VisibilityBlock) -> Option<usize> {
        let of_s = span_s(block)?;
        let [_, until_s] = self.open[NEWEST]?;
        if self.gains.distance_s(of_s[0]) == Some(0.0) || self.is_of(NEWEST, of_s) {
            return None;
        }
        if of_s[0] > until_s + self.gap_s {
            return Some(NEWEST);
        }
        (self.open[LATE].is_some() && !self.is_of(LATE, of_s) && self.gains.distance_s(of_s[0]).is_none())
            .then_some(LATE)
    }

    /// Takes note of a block that is held; what it ends is closed. Returns whether it is of an open pass.
    pub(super) fn note(&mut self, block: &VisibilityBlock) -> bool {
        let Some(of_s) = span_s(block) else { return false };
        let distance_s = self.gains.distance_s(of_s[0]);
        let which = match () {
            () if distance_s == Some(0.0) => None,
            () if self.is_of(NEWEST, of_s) => Some(NEWEST),
            () if self.is_of(LATE, of_s) => Some(LATE),
            () if distance_s.is_some() => None,
            () if self.open[NEWEST].is_none() => Some(NEWEST),
            () => Some(LATE),
        };
        let Some(which) = which else { return false };
        let [from_s, until_s] = self.open[which].unwrap_or(of_s);
        self.open[which] = Some([from_s.min(of_s[0]), until_s.max(of_s[1])]);
        true
    }

    /// Counts a block whose pass was closed before it arrived.
    pub(super) fn count_late(&self, block: &VisibilityBlock) {
        if block.pair.i != block.pair.j {
            self.gains.count_late(block.len() as u64);
        }
    }

    /// Passes that are open, the late one first.
    pub(super) fn open_passes(&self) -> Vec<usize> {
        [LATE, NEWEST].into_iter().filter(|which| self.open[*which].is_some()).collect()
    }

    /// Whether a block is of an open pass.
    pub(super) fn holds(&self, which: usize, block: &VisibilityBlock) -> bool {
        let within =
            |([from_s, until_s], [first_s, _]): ([f64; 2], [f64; 2])| (from_s..=until_s).contains(&first_s);
        self.open[which].zip(span_s(block)).is_some_and(within)
    }

    /// Solves an open pass and closes it. Data for which the known signal cannot be predicted have no gains.
    pub(super) fn close(&mut self, which: usize, blocks: Vec<VisibilityBlock>, ephemeris: &Ephemeris) {
        let Some(span_s) = self.open[which].take() else { return };
        let number = self.gains.len() as u64;
        let all = blocks.iter().map(|block| block.len() as u64).sum();
        let solved = self.solver.solve(PassBlocks { number, span_s, blocks }, ephemeris);
        let (solutions, unused) =
            solved.map_or((Vec::new(), all), |solved| (solved.solutions, solved.unused));
        self.gains.add_pass(ClosedPass { number, span_s, unused, solutions });
        if let Some(observer) = &mut self.observer {
            observer(&self.gains);
        }
    }
}

/// Middle of the first and of the last integration of two daughters, s; `None` of other blocks.
fn span_s(block: &VisibilityBlock) -> Option<[f64; 2]> {
    let last = block.len().checked_sub(1).filter(|_| block.pair.i != block.pair.j)?;
    Some([block.middle_s(0), block.middle_s(last)])
}
