//! The flux of a burst by time, fitted and subtracted.
//!
//! A visibility of the burst is the mean over its integration of the power by time, times the fringe of the direction at its middle, or 0 where
//! the Moon hides it from a daughter. The powers of cells of equal length are fitted to all pairs by weighted least squares; what the steady
//! sky adds is noise of the fit, as the pair has it in the pass. Long baselines see little of it and integrate for a short time, and so say
//! how bright the burst was when; short ones, which a map needs, are rid of it. The variance of the power is added to theirs: it bounds
//! that of one part. Errors of the parts of a pair, and of pairs, have signs in common, which is neglected. Projecting the column out of the sums
//! instead would mix pairs, so that they no longer were sums over visibilities.
//!
//! Where the residuals are above what noise and steady sky have, the source is not a point or is elsewhere: such cells are left out.
//! Residuals of visibilities from which the Moon hides the direction are judged by themselves. What the fit has not seen is left out too.

use std::cmp::Ordering;

use bincode::{Decode, Encode};
use num_complex::Complex64;

use crate::array::hidden_by_moon;
use crate::frames::PlacedVisibilities;
use crate::numerics::{DenseFactor, median};
use crate::response::beacon::plane_wave;
use crate::units::Pair;
use crate::units::vector::{Vec3, norm, sub};

/// Maximum number of cells of a burst, for the fit's time and memory.
const CELLS_MAX: usize = 256;

/// Shortest cell, s.
const CELL_S_MIN: f64 = 0.5;

/// Mean squared residual, in units of that of noise and steady sky, up to which a cell is explained. Its mean over three pairs, the least,
/// is above 3 with a probability of 6e-3, if all are exponential; over 28 of 4e-13. At the Moon's limb a mean is of less: of one pair, 0.05.
const RESIDUAL_MAX: f64 = 3.0;

/// Information of the prior in units of the largest cell's: the power of a cell that no pair sees is 0 with a variance 1e9 times the least.
const PRIOR: f64 = 1e-9;

/// Maximum number of spans of a fit: a pass of the default array has some hundreds of packets in a channel.
const SPANS_MAX: usize = 1 << 12;

/// The visibilities of a block in the fit: those of a pair from the first to the last.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub(super) struct FittedSpan {
    pair: Pair,
    band: u16,
    from_s: f64,
    until_s: f64,
}

/// The power of a burst by time, in cells of equal length.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct LightCurve {
    /// Direction, a unit vector on ecliptic axes.
    pub hat: Vec3,
    /// Radius of the Moon, which hides it, m.
    pub moon_radius_m: f64,
    /// Start of the first cell, s.
    pub from_s: f64,
    /// Length of a cell, s.
    pub cell_s: f64,
    /// Power, K sr.
    pub power_k_sr: Vec<f32>,
    /// Its variance, (K sr)^2; infinite where a point source does not explain the visibilities.
    pub variance_k2_sr2: Vec<f32>,
    /// What it was fitted to, by pair, band and start.
    pub(super) fitted: Vec<FittedSpan>,
}

/// A visibility of a burst, for the fit.
#[derive(Clone, Copy)]
pub(super) struct BurstRow<'a> {
    pub(super) block: &'a PlacedVisibilities,
    pub(super) k: usize,
    /// Mean squared modulus of what the steady sky adds, (K sr)^2.
    pub(super) steady_k2_sr2: f64,
}

impl BurstRow<'_> {
    pub(super) fn duration_s(&self) -> f64 {
        duration_s(self.block, self.k)
    }

    /// Variance, real and imaginary part together, with the steady sky counted a number of times.
    pub(super) fn variance_k2_sr2(&self, times: f64) -> f64 {
        times * self.steady_k2_sr2 + 2.0 / self.block.weight[self.k]
    }
}

fn duration_s(block: &PlacedVisibilities, k: usize) -> f64 {
    block.duration_s.get(k).copied().map_or(0.0, f64::from).max(1e-3)
}

/// The spans of rows, which follow each other by block.
fn spans_of(rows: &[BurstRow]) -> Vec<FittedSpan> {
    let of_block = rows.chunk_by(|a, b| std::ptr::eq(a.block, b.block));
    let span = |rows: &[BurstRow]| {
        let times_s = rows.iter().map(|row| row.block.time_s[row.k]);
        let [from_s, until_s] =
            times_s.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], t_s| [a.min(t_s), b.max(t_s)]);
        FittedSpan { pair: rows[0].block.pair, band: rows[0].block.band, from_s, until_s }
    };
    let mut spans: Vec<FittedSpan> = of_block.map(span).collect();
    spans.sort_by(|a, b| (a.pair, a.band).cmp(&(b.pair, b.band)).then(a.from_s.total_cmp(&b.from_s)));
    spans
}

impl LightCurve {
    /// Fits the powers from `from_s` to `until_s`; `None` if the rows do not determine them.
    pub(super) fn fit(
        rows: &[BurstRow],
        hat: Vec3,
        [from_s, until_s]: [f64; 2],
        moon_radius_m: f64,
    ) -> Option<Self> {
        // Of each visibility, so that pairs count by how often they integrate: half of them resolve a cell.
        let usual_s = median(rows.iter().map(BurstRow::duration_s).collect())?;
        let cell_s = usual_s.max((until_s - from_s) / CELLS_MAX as f64).max(CELL_S_MIN);
        let cells = (((until_s - from_s) / cell_s).ceil() as usize).clamp(1, CELLS_MAX);
        let blank = vec![0.0_f32; cells];
        let mut curve = Self {
            hat,
            moon_radius_m,
            from_s,
            cell_s,
            power_k_sr: blank.clone(),
            variance_k2_sr2: blank,
            fitted: spans_of(rows),
        };
        let (mut matrix, mut powers) = (vec![0.0; cells * cells], vec![0.0; cells]);
        for row in rows {
            let Some(fringe) = curve.fringe(row.block, row.k) else { continue };
            // The steady sky hardly changes in a cell, and so counts once there.
            let information = row.variance_k2_sr2((cell_s / row.duration_s()).max(1.0)).recip();
            let real = (fringe.conj() * row.block.value_k_sr[row.k]).re;
            for (cell, share) in curve.shares(row.block, row.k) {
                powers[cell] += information * share * real;
                for (other, share_of_other) in curve.shares(row.block, row.k) {
                    matrix[cell * cells + other] += information * share * share_of_other;
                }
            }
        }
        let largest = (0..cells).map(|cell| matrix[cell * (cells + 1)]).fold(0.0, f64::max);
        (0..cells).for_each(|cell| matrix[cell * (cells + 1)] += PRIOR * largest);
        let factor = DenseFactor::new(&matrix, cells)?;
        factor.solve(&mut powers);
        let inverse = factor.inverse();
        curve.power_k_sr = powers.iter().map(|power| *power as f32).collect();
        // The information is of both parts of a visibility, of which the fringe's phase keeps one: half the variance.
        curve.variance_k2_sr2 = (0..cells)
            .map(|cell| 0.5 * inverse[cell * (cells + 1)])
            .map(|variance| variance as f32)
            .collect();
        curve.leave_out_unexplained(rows);
        curve.is_sound().then_some(curve)
    }

    /// Gives cells an infinite variance that no visibility is in, or whose residuals are too large: of the visibilities that see the source,
    /// or of those from which the Moon hides it.
    fn leave_out_unexplained(&mut self, rows: &[BurstRow]) {
        let mut sums = vec![[[0.0; 2]; 2]; self.power_k_sr.len()];
        for row in rows {
            let value = row.block.value_k_sr[row.k];
            let (kind, ratio) = match self.fringe(row.block, row.k) {
                Some(fringe) => {
                    let [power_k_sr, variance] = self.mean(row.block, row.k);
                    let residual = value - fringe * power_k_sr;
                    (0, residual.norm_sqr() / (row.variance_k2_sr2(1.0) + variance))
                }
                None => (1, value.norm_sqr() / row.variance_k2_sr2(1.0)),
            };
            for (cell, share) in self.shares(row.block, row.k) {
                let [sum, number] = &mut sums[cell][kind];
                (*sum, *number) = (*sum + share * ratio, *number + share);
            }
        }
        for (variance, [seen, hidden]) in self.variance_k2_sr2.iter_mut().zip(sums) {
            let has_rows = seen[1] + hidden[1] > 0.0;
            let is_explained = has_rows && [seen, hidden].iter().all(|[sum, n]| *sum <= RESIDUAL_MAX * n);
            if !is_explained {
                *variance = f32::INFINITY;
            }
        }
    }

    /// Cells of an integration, and the parts of it that lie in them.
    fn shares(&self, block: &PlacedVisibilities, k: usize) -> impl Iterator<Item = (usize, f64)> + use<> {
        let duration = duration_s(block, k) / self.cell_s;
        let from = (block.time_s[k] - self.from_s) / self.cell_s - 0.5 * duration;
        let until = from + duration;
        let cells = from.max(0.0) as usize..(until.max(0.0).ceil() as usize).min(self.power_k_sr.len());
        let share = move |cell: usize| ((cell + 1) as f64).min(until) - (cell as f64).max(from);
        cells.map(move |cell| (cell, share(cell) / duration)).filter(|(_, share)| *share > 0.0)
    }

    /// Visibility of a source of 1 K sr; `None` where the Moon hides it.
    fn fringe(&self, block: &PlacedVisibilities, k: usize) -> Option<Complex64> {
        let [r_i_m, r_j_m] = [block.r_i_m[k], block.r_j_m[k]];
        let is_hidden = [r_i_m, r_j_m].iter().any(|r_m| hidden_by_moon(*r_m, self.hat, self.moon_radius_m));
        (!is_hidden).then(|| plane_wave(1.0, self.hat, sub(r_i_m, r_j_m), block.frequency_hz))
    }

    /// Mean power in an integration, and its variance.
    fn mean(&self, block: &PlacedVisibilities, k: usize) -> [f64; 2] {
        let mut mean = [0.0; 2];
        for (cell, share) in self.shares(block, k) {
            mean[0] += share * f64::from(self.power_k_sr[cell]);
            mean[1] += share * share * f64::from(self.variance_k2_sr2[cell]);
        }
        mean
    }

    /// Whether visibility `k` of a block was in the fit.
    fn is_fitted_to(&self, block: &PlacedVisibilities, k: usize) -> bool {
        let (key, time_s) = ((block.pair, block.band), block.time_s[k]);
        let is_before = |span: &FittedSpan| match (span.pair, span.band).cmp(&key) {
            Ordering::Less => true,
            Ordering::Equal => span.from_s <= time_s,
            Ordering::Greater => false,
        };
        let next = self.fitted.partition_point(is_before);
        let last = self.fitted[..next].last();
        last.is_some_and(|span| (span.pair, span.band) == key && time_s <= span.until_s)
    }

    /// Visibility `k` of a block without the burst, and its weight; `None` if the burst is not known well enough to subtract it, or the
    /// visibility was not in the fit, which has not judged it.
    pub(super) fn without_burst(&self, block: &PlacedVisibilities, k: usize) -> Option<(Complex64, f64)> {
        let [power_k_sr, variance] = self.mean(block, k);
        if variance.is_infinite() || !self.is_fitted_to(block, k) {
            return None;
        }
        let Some(fringe) = self.fringe(block, k) else { return Some((block.value_k_sr[k], block.weight[k])) };
        let weight = (block.weight[k].recip() + variance).recip();
        (weight > 0.0).then(|| (block.value_k_sr[k] - fringe * power_k_sr, weight))
    }

    /// Time that is left out, s.
    pub(super) fn unexplained_s(&self) -> f64 {
        self.cell_s * self.variance_k2_sr2.iter().filter(|variance| variance.is_infinite()).count() as f64
    }

    /// Number of cells.
    pub(super) fn cells(&self) -> usize {
        self.power_k_sr.len()
    }

    /// Memory of the cells and spans.
    pub(super) fn bytes(&self) -> usize {
        self.cells() * 2 * size_of::<f32>() + self.fitted.len() * size_of::<FittedSpan>()
    }

    /// Whether the values are those of a light curve. Checkpoints are untrusted.
    pub(super) fn is_sound(&self) -> bool {
        let is_time = |s: f64| s.is_finite();
        (norm(self.hat) - 1.0).abs() < 1e-6
            && is_time(self.moon_radius_m)
            && is_time(self.from_s)
            && is_time(self.cell_s)
            && self.cell_s >= CELL_S_MIN
            && (1..=CELLS_MAX).contains(&self.cells())
            && self.fitted.len() <= SPANS_MAX
            && self.variance_k2_sr2.len() == self.cells()
            && self.power_k_sr.iter().all(|power| power.is_finite())
            && self.variance_k2_sr2.iter().all(|variance| *variance >= 0.0)
    }
}
