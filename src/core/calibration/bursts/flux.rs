//! The flux of a burst by time, finer than its integrations.
//!
//! The integrations of pairs are not in step, so that together they resolve what is shorter than one of them. The powers of short cells are fitted
//! with a random walk as prior, loose enough for the rise of a type III burst.
//!
//! A burst is short against an integration, in which the fringe turns by up to an eighth: what is measured has the phase of when the burst was.
//! Simulations that do not smear integrations have the phase of the middle.
//!
//! **Errors.** What the steady sky adds to a pair is alike in successive integrations, and a power changes within cells: the scatter of pairs, each of
//! which has its own integrations, has both.

use std::collections::BTreeMap;

use num_complex::Complex64;

use super::rows::{BurstRow, Place, Share, baseline, motion, phasor, shares};
use crate::array::hidden_by_moon;
use crate::numerics::DenseFactor;
use crate::units::Pair;
use crate::units::vector::{Vec3, add, dot, scale};

/// Cells of a burst.
const CELLS: usize = 128;

/// Shortest cell, s.
const CELL_S_MIN: f64 = 0.5;

/// Cells of a light curve, and fits of it with the prior of the one before.
const CELLS_OF_CURVE: usize = 384;
const ROUNDS: usize = 2;

/// Least power in units of the largest by which the prior of a light curve lets it change.
const CHANGE_MIN: f64 = 1e-3;

/// Time in which the prior lets the power change by its largest value, or by that about it, s.
const WALK_S: f64 = 5.0;

/// Largest share of a pair in a flux whose error is found by pairs.
const SHARE_MAX: f64 = 0.7;

/// Work of a visibility in units of that of a product of two cells.
const WORK_OF_ROW: f64 = 1e3;

/// The source in a visibility: `exp(2 pi i turns) V` is the sum of the powers of cells times their factors.
struct Term {
    turns: f64,
    cells: Vec<(usize, Complex64)>,
}

/// What a visibility has of the source.
pub(super) struct Seen {
    /// Power, K sr.
    pub(super) power_k_sr: f64,
    /// Baseline when the burst was, wavelengths.
    pub(super) u: Vec3,
    /// The visibility, K sr, as it were at that time, K sr.
    pub(super) value_k_sr: Complex64,
}

/// Powers by time, and how they follow from visibilities.
pub(super) struct Flux {
    place: Place,
    from_s: f64,
    cell_s: f64,
    power_k_sr: Vec<f64>,
    factor: DenseFactor,
}

/// Length of a cell, of at most some, s.
fn cell_s([from_s, until_s]: [f64; 2], cells_max: usize) -> f64 {
    ((until_s - from_s) / cells_max as f64).max(CELL_S_MIN)
}

/// All visibilities, or as many of them, evenly, as a fit may take: a thousand times more than those of short integrations need are refused. Lengths
/// of integrations are untrusted.
pub(super) fn affordable<'a>(rows: &[BurstRow<'a>], span_s: [f64; 2], work_max: f64) -> Vec<BurstRow<'a>> {
    let work = |row: &BurstRow| (row.duration_s() / cell_s(span_s, CELLS) + 2.0).min(CELLS as f64).powi(2);
    let work: f64 = rows.iter().map(|row| WORK_OF_ROW + work(row)).sum();
    rows.iter().step_by((work / work_max).ceil().max(1.0) as usize).copied().collect()
}

impl Flux {
    /// Fits the powers; `None` if the visibilities do not determine them.
    pub(super) fn fit(rows: &[BurstRow], place: Place, span_s: [f64; 2]) -> Option<Self> {
        let sums = Sums::new(rows, place, span_s, CELLS)?;
        let change = vec![sums.largest_k_sr; sums.powers.len() + 1];
        sums.solved(&change)
    }

    /// Fits them in shorter cells: a power changes by what it is then, so that where there is none it is known better.
    pub(super) fn fit_curve(rows: &[BurstRow], place: Place, span_s: [f64; 2]) -> Option<Self> {
        let sums = Sums::new(rows, place, span_s, CELLS_OF_CURVE)?;
        let cells = sums.powers.len();
        let mut flux = sums.solved(&vec![sums.largest_k_sr; cells + 1])?;
        for _ in 0..ROUNDS {
            let inverse = flux.factor.inverse();
            let sigma_k_sr = |cell: usize| (0.5 * inverse[cell * (cells + 1)]).max(0.0).sqrt();
            let least_k_sr = CHANGE_MIN * flux.largest_k_sr();
            let of_cell = |cell: usize| flux.power_k_sr[cell].abs().max(sigma_k_sr(cell)).max(least_k_sr);
            let of_cells: Vec<f64> = (0..cells).map(of_cell).collect();
            let reach = (WALK_S / flux.cell_s).ceil() as usize;
            let about = |edge: usize| {
                let near = edge.saturating_sub(reach + 1)..(edge + reach + 1).min(cells);
                of_cells[near].iter().copied().fold(0.0, f64::max)
            };
            flux = sums.solved(&(0..=cells).map(about).collect::<Vec<f64>>())?;
        }
        Some(flux)
    }

    /// Sum over visibilities of their squared residuals in units of their variances.
    pub(super) fn squares(&self, rows: &[BurstRow]) -> f64 {
        let square = |row: &BurstRow| {
            let term = self.term(row)?;
            Some(self.information(row) * (term.value(row) - self.sum(&term)).norm_sqr())
        };
        rows.iter().filter_map(square).sum()
    }

    /// Length of a cell, s.
    pub(super) fn cell_s(&self) -> f64 {
        self.cell_s
    }

    /// Power of the brightest cell, K sr.
    pub(super) fn largest_k_sr(&self) -> f64 {
        self.power_k_sr.iter().copied().fold(0.0, f64::max)
    }

    fn shares(&self, row: &BurstRow) -> impl Iterator<Item = Share> + use<> {
        shares([self.from_s, self.cell_s], self.power_k_sr.len(), [row.block.time_s[row.k], row.duration_s()])
    }

    /// The source in a visibility; `None` where the Moon hides it.
    fn term(&self, row: &BurstRow) -> Option<Term> {
        let (block, k, Place { hat, moon_radius_m, smears }) = (row.block, row.k, self.place);
        let is_hidden = |r_m: Vec3| hidden_by_moon(r_m, hat, moon_radius_m);
        if is_hidden(block.r_i_m[k]) || is_hidden(block.r_j_m[k]) {
            return None;
        }
        let rate = if smears { dot(motion(block, k), hat) } else { 0.0 };
        let duration_s = row.duration_s();
        let cells = self.shares(row).map(|share| (share.cell, share.turned(rate, duration_s))).collect();
        Some(Term { turns: dot(baseline(block, k), hat), cells })
    }

    /// What a visibility has of the source; `None` where the Moon hides it.
    pub(super) fn seen(&self, row: &BurstRow) -> Option<Seen> {
        let term = self.term(row)?;
        let sum = self.sum(&term);
        let mut weighted = [0.0; 2];
        for Share { cell, share, after_s } in self.shares(row) {
            let power = share * self.power_k_sr[cell].max(0.0);
            weighted = [weighted[0] + power, weighted[1] + power * after_s];
        }
        let after_s = if weighted[0] > 0.0 && self.place.smears { weighted[1] / weighted[0] } else { 0.0 };
        let moved = scale(after_s, motion(row.block, row.k));
        let turn = if sum.re > 0.0 {
            sum.conj() / sum.norm() * phasor(-dot(moved, self.place.hat))
        } else {
            1.0.into()
        };
        Some(Seen {
            power_k_sr: if sum.re > 0.0 { sum.norm() } else { 0.0 },
            u: add(baseline(row.block, row.k), moved),
            value_k_sr: row.block.value_k_sr[row.k] * turn,
        })
    }

    /// Mean power in an integration, K sr, also where the Moon hides the source.
    pub(super) fn power_k_sr_in(&self, row: &BurstRow) -> f64 {
        self.shares(row).map(|Share { cell, share, .. }| share * self.power_k_sr[cell]).sum()
    }

    fn sum(&self, term: &Term) -> Complex64 {
        term.cells.iter().map(|(cell, factor)| factor * self.power_k_sr[*cell]).sum()
    }

    /// Inverse variance of a visibility. The steady sky hardly changes in a cell, and so counts once there.
    fn information(&self, row: &BurstRow) -> f64 {
        row.variance_k2_sr2((self.cell_s / row.duration_s()).max(1.0)).recip()
    }

    /// Mean power in a span, and its standard deviation, K sr: by what pairs, each by itself, say of it, and by the model, whose prior is not the
    /// burst.
    pub(super) fn mean_k_sr(&self, rows: &[BurstRow], span_s: [f64; 2]) -> [f64; 2] {
        let Mean { power_k_sr, by_pairs, by_model, .. } = self.mean(&self.residuals(rows), span_s);
        [power_k_sr, (by_pairs + by_model).sqrt()]
    }

    /// What the fit leaves of visibilities that see the source, in the order of rows.
    pub(super) fn residuals(&self, rows: &[BurstRow]) -> Vec<Residual> {
        let residual = |row: &BurstRow| {
            let term = self.term(row)?;
            let value_k_sr = (term.value(row) - self.sum(&term)).re;
            let cells = term.cells.iter().map(|(cell, factor)| (*cell, factor.re)).collect();
            Some(Residual { pair: row.block.pair, information: self.information(row), value_k_sr, cells })
        };
        rows.iter().filter_map(residual).collect()
    }

    /// Mean power in a span.
    pub(super) fn mean(&self, residuals: &[Residual], [from_s, until_s]: [f64; 2]) -> Mean {
        let start = |cell: usize| self.from_s + self.cell_s * cell as f64;
        let share = |cell: usize| {
            (start(cell + 1).min(until_s) - start(cell).max(from_s)).max(0.0) / (until_s - from_s)
        };
        let shares: Vec<f64> = (0..self.power_k_sr.len()).map(share).collect();
        let power_k_sr = shares.iter().zip(&self.power_k_sr).map(|(share, power)| share * power).sum();
        let mut response = shares.clone();
        self.factor.solve(&mut response);
        // Of each pair: what its residuals add, and how much of the mean it determines.
        let mut pairs: BTreeMap<Pair, [f64; 2]> = BTreeMap::new();
        let mut is_seen = false;
        for Residual { pair, information, value_k_sr, cells } in residuals {
            let factor: f64 = cells.iter().map(|(cell, factor)| factor * response[*cell]).sum();
            let inside = cells.iter().filter(|(cell, _)| shares[*cell] > 0.0);
            let inside: f64 = inside.map(|(_, factor)| factor).sum();
            is_seen |= inside != 0.0;
            let [sum, determined] = pairs.entry(*pair).or_default();
            *sum += information * factor * value_k_sr;
            *determined += information * factor * inside;
        }
        let square = |[sum, determined]: &[f64; 2]| (sum / (1.0 - determined.clamp(0.0, SHARE_MAX))).powi(2);
        let by_pairs: f64 = pairs.values().map(square).sum();
        let by_model: f64 =
            0.5 * shares.iter().zip(&response).map(|(share, response)| share * response).sum::<f64>();
        Mean { power_k_sr, by_pairs, by_model, is_seen }
    }
}

/// What a fit leaves of a visibility.
pub(super) struct Residual {
    pair: Pair,
    information: f64,
    value_k_sr: f64,
    /// The cells in it, with their factors.
    cells: Vec<(usize, f64)>,
}

/// A mean power, K sr, and its variance, (K sr)^2: by the scatter of pairs, and by the model.
pub(super) struct Mean {
    pub(super) power_k_sr: f64,
    pub(super) by_pairs: f64,
    pub(super) by_model: f64,
    /// Whether a visibility saw the source then.
    pub(super) is_seen: bool,
}

/// The normal equations of powers.
struct Sums {
    flux: Flux,
    matrix: Vec<f64>,
    powers: Vec<f64>,
    /// Largest power that a visibility has.
    largest_k_sr: f64,
}

impl Sums {
    fn new(rows: &[BurstRow], place: Place, [from_s, until_s]: [f64; 2], cells_max: usize) -> Option<Self> {
        let cell_s = cell_s([from_s, until_s], cells_max);
        let cells = (((until_s - from_s) / cell_s).ceil() as usize).clamp(1, cells_max);
        let power_k_sr = vec![0.0; cells];
        let flux = Flux { place, from_s, cell_s, power_k_sr, factor: DenseFactor::new(&[1.0], 1)? };
        let (mut matrix, mut powers, mut largest_k_sr) = (vec![0.0; cells * cells], vec![0.0; cells], 0.0);
        for row in rows {
            let Some(term) = flux.term(row) else { continue };
            // The part across the fringe says where the source is.
            let (information, value) = (flux.information(row), term.value(row).re);
            largest_k_sr = f64::max(largest_k_sr, value);
            for (cell, factor) in &term.cells {
                powers[*cell] += information * factor.re * value;
                for (other, of_other) in &term.cells {
                    matrix[cell * cells + other] += information * factor.re * of_other.re;
                }
            }
        }
        (largest_k_sr > 0.0).then_some(Self { flux, matrix, powers, largest_k_sr })
    }

    /// The powers, with the change in [`WALK_S`] that the prior lets each have over the one before, K sr. Before and after, there is no power.
    fn solved(&self, change_k_sr: &[f64]) -> Option<Flux> {
        let Self { flux: Flux { place, from_s, cell_s, .. }, .. } = *self;
        let (mut matrix, mut power_k_sr, cells) =
            (self.matrix.clone(), self.powers.clone(), self.powers.len());
        for (edge, change_k_sr) in change_k_sr.iter().enumerate() {
            // Information counts both parts of a visibility: half the inverse variance.
            let tie = 0.5 * WALK_S / (cell_s * change_k_sr * change_k_sr);
            let sides = [edge.checked_sub(1), Some(edge).filter(|cell| *cell < cells)];
            sides.into_iter().flatten().for_each(|cell| matrix[cell * (cells + 1)] += tie);
            if let [Some(before), Some(after)] = sides {
                matrix[after * cells + before] -= tie;
                matrix[before * cells + after] -= tie;
            }
        }
        let factor = DenseFactor::new(&matrix, cells)?;
        factor.solve(&mut power_k_sr);
        Some(Flux { place, from_s, cell_s, power_k_sr, factor })
    }
}

impl Term {
    /// A visibility with the fringe's phase at its middle taken out.
    fn value(&self, row: &BurstRow) -> Complex64 {
        row.block.value_k_sr[row.k] * phasor(self.turns)
    }
}
