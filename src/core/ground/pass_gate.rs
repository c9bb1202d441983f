//! Holds visibilities back until the gains of their pass are known.
//!
//! Visibilities wait in the hold buffer, as they do for their positions. A pass ends with the first visibilities that begin more
//! than `calibrate.pass_gap_s` after it. At most two passes are open: the newest, and one of late data, which ends with
//! late data of another pass. Late data of a closed pass, or within the gap of it, get the gains of that pass.

use crate::array::Ephemeris;
use crate::calibration::solver::{PassBlocks, PassSolver};
use crate::calibration::{CalibrationError, ClosedPass, SolvedGains};
use crate::downlink::wire::VisibilitiesOutline;
use crate::frames::{Instrument, VisibilityBlock};
use crate::sky::fits::check_frequencies;

pub(super) const MODEL_FILES_KEY: &str = "calibrate.model_files";

/// Index of the newest open pass.
const NEWEST: usize = 0;
/// Index of the open pass of late data.
const LATE: usize = 1;

/// Called after each pass is closed.
pub type PassObserver = Box<dyn FnMut(&SolvedGains) + Send>;

/// State of a `PassGate` in a checkpoint.
#[derive(Clone, Debug, Default, PartialEq, bincode::Encode, bincode::Decode)]
pub struct PassGateState {
    pub(super) passes: Vec<ClosedPass>,
    open: [Option<[f64; 2]>; 2],
    late: u64,
}

impl PassGateState {
    /// Whether the state fits the instrument. Checkpoints are untrusted.
    pub(super) fn is_sound(&self, instrument: Option<&Instrument>) -> bool {
        let is_span =
            |[from_s, until_s]: &[f64; 2]| from_s.is_finite() && until_s.is_finite() && from_s <= until_s;
        let fits = |pass: &ClosedPass| instrument.is_some_and(|instrument| pass.fits_instrument(instrument));
        self.passes.iter().all(fits) && self.open.iter().flatten().all(is_span)
    }
}

/// Decides which visibilities are due, and solves for the gains of passes that have ended.
pub(super) struct PassGate {
    solver: PassSolver,
    gains: SolvedGains,
    gap_s: f64,
    /// Midpoints of the first and the last integration, by [`NEWEST`] and [`LATE`].
    open: [Option<[f64; 2]>; 2],
    observer: Option<PassObserver>,
    /// Whether all held visibilities have to be passed to [`PassGate::register`] first.
    pub(super) must_register_held: bool,
}

impl PassGate {
    /// A gate with a solver, and draws of the errors of its gains.
    pub(super) fn new(solver: PassSolver, error_draws: usize) -> Self {
        let gap_s = solver.config().pass_gap_s;
        let gains = SolvedGains::new(gap_s, error_draws);
        Self { solver, gains, gap_s, open: [None; 2], observer: None, must_register_held: true }
    }

    /// The table of solved gains, which clones share.
    pub(super) fn gains(&self) -> &SolvedGains {
        &self.gains
    }

    pub(super) fn set_observer(&mut self, observer: PassObserver) {
        self.observer = Some(observer);
    }

    pub(super) fn describe(&mut self, instrument: &Instrument) -> Result<(), CalibrationError> {
        self.must_register_held = true;
        check_frequencies(&self.solver.config().model_files, &instrument.frequencies_hz())?;
        self.gains.describe(instrument);
        self.solver.describe(instrument, MODEL_FILES_KEY)
    }

    pub(super) fn state(&self) -> PassGateState {
        PassGateState { passes: self.gains.passes(), open: self.open, late: self.gains.late() }
    }

    /// Resumes from a state. The instrument must have been described.
    pub(super) fn resume(&mut self, state: PassGateState) {
        let PassGateState { mut passes, open, late } = state;
        // In the order in which they were closed: the validity of each depends on the gains before it.
        passes.sort_unstable_by_key(|pass| pass.number);
        passes.into_iter().for_each(|pass| self.gains.add_pass(pass));
        self.gains.count_late(late);
        self.gains.begin_session();
        self.open = open;
    }

    /// Whether the packet with this outline can be calibrated now.
    pub(super) fn is_due(&self, outline: &VisibilitiesOutline) -> bool {
        let middle_s = outline.middle_s;
        if self.solver.instrument().is_some_and(|instrument| instrument.is_spectrum(outline.pair)) {
            return true;
        }
        let is_in_open_pass = || (0..2).any(|index| self.is_in_open_pass(index, [middle_s; 2]));
        self.gains
            .distance_to_pass_s(middle_s)
            .is_some_and(|distance_s| distance_s == 0.0 || !is_in_open_pass())
    }

    /// Whether a block with this span belongs to an open pass, within the gap.
    fn is_in_open_pass(&self, index: usize, [first_s, last_s]: [f64; 2]) -> bool {
        self.open[index].is_some_and(|[from_s, until_s]| {
            !(first_s > until_s + self.gap_s || last_s < from_s - self.gap_s)
        })
    }

    /// Index of the open pass that ends because this block belongs to another pass.
    pub(super) fn ended_by(&self, block: &VisibilityBlock) -> Option<usize> {
        let block_span_s = span_s(block)?;
        let [_, until_s] = self.open[NEWEST]?;
        if self.gains.distance_to_pass_s(block_span_s[0]) == Some(0.0)
            || self.is_in_open_pass(NEWEST, block_span_s)
        {
            return None;
        }
        if block_span_s[0] > until_s + self.gap_s {
            return Some(NEWEST);
        }
        (self.open[LATE].is_some()
            && !self.is_in_open_pass(LATE, block_span_s)
            && self.gains.distance_to_pass_s(block_span_s[0]).is_none())
        .then_some(LATE)
    }

    /// Registers a held block, and returns whether it is in an open pass. The pass that it ends must have been closed before.
    pub(super) fn register(&mut self, block: &VisibilityBlock) -> bool {
        let Some(block_span_s) = span_s(block) else { return false };
        let distance_s = self.gains.distance_to_pass_s(block_span_s[0]);
        let index = if distance_s == Some(0.0) {
            return false;
        } else if self.is_in_open_pass(NEWEST, block_span_s) {
            NEWEST
        } else if self.is_in_open_pass(LATE, block_span_s) {
            LATE
        } else if distance_s.is_some() {
            return false;
        } else if self.open[NEWEST].is_none() {
            NEWEST
        } else {
            LATE
        };
        let [from_s, until_s] = self.open[index].unwrap_or(block_span_s);
        self.open[index] = Some([from_s.min(block_span_s[0]), until_s.max(block_span_s[1])]);
        true
    }

    /// Counts a block whose pass was closed before it arrived.
    pub(super) fn count_late(&self, block: &VisibilityBlock) {
        if block.pair.i != block.pair.j {
            self.gains.count_late(block.len() as u64);
        }
    }

    pub(super) fn open_passes(&self) -> Vec<usize> {
        [LATE, NEWEST].into_iter().filter(|index| self.open[*index].is_some()).collect()
    }

    /// Whether a block begins within the span of an open pass.
    pub(super) fn holds(&self, index: usize, block: &VisibilityBlock) -> bool {
        let (Some([from_s, until_s]), Some([first_s, _])) = (self.open[index], span_s(block)) else {
            return false;
        };
        (from_s..=until_s).contains(&first_s)
    }

    /// Solves an open pass and closes it. Data for which the model signal cannot be predicted get no gains.
    pub(super) fn close(&mut self, index: usize, blocks: Vec<VisibilityBlock>, ephemeris: &Ephemeris) {
        let Some(span_s) = self.open[index].take() else { return };
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

/// Midpoints of the first and the last integration of a cross-correlation block, s; `None` for auto-correlations and empty blocks.
fn span_s(block: &VisibilityBlock) -> Option<[f64; 2]> {
    let last = block.len().checked_sub(1).filter(|_| block.pair.i != block.pair.j)?;
    Some([block.middle_s(0), block.middle_s(last)])
}
