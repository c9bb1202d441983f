//! The flux of a burst by time, fitted and subtracted.
//!
//! A visibility of the burst is the mean over its integration of the power by time, times the fringe of the direction, or 0 where the Moon hides
//! it from a daughter. The fringe turns by up to an eighth in an integration, which takes 2.6 % of a steady power; if the visibilities say that
//! theirs did, each cell has its mean over the part of the integration in it, or else (simulations that do not smear) that at the middle. The
//! powers of cells of equal length are fitted to all pairs by weighted least squares; what the steady sky adds is noise of the fit, as the pair
//! has it in the pass. Long baselines see little of it and integrate for a short time, and so say how bright the burst was when; short ones, which
//! a map needs, are rid of it. The variance of the power is added to theirs: it bounds that of one part. Errors of the parts of a pair, and of
//! pairs, have signs in common, which is neglected. Projecting the column out of the sums instead would mix pairs, so that they no longer were
//! sums over visibilities.
//!
//! Where the residuals are above what noise and steady sky have, the source is not a point or is elsewhere: such cells are left out.
//! Residuals of visibilities from which the Moon hides the direction are judged by themselves. What the fit has not seen is left out too.

use std::cmp::Ordering;

use bincode::{Decode, Encode};
use num_complex::Complex64;

use super::rows::{BurstRow, Place, Share, duration_s, motion, shares};
use crate::array::hidden_by_moon;
use crate::frames::PlacedVisibilities;
use crate::numerics::{DenseFactor, median};
use crate::response::beacon::plane_wave;
use crate::units::Pair;
use crate::units::vector::{Vec3, add, dot, norm, scale, sub};

/// Maximum number of cells of a burst, for the fit's time and memory.
const CELLS_MAX: usize = 256;

/// Shortest cell, s.
const CELL_S_MIN: f64 = 0.5;

/// Mean squared residual, in units of that of noise and steady sky, up to which a cell is explained. Its mean over three pairs, the least,
/// is above 3 with a probability of 6e-3, if all are exponential; over 28 of 4e-13. At the Moon's limb a mean is of less: of one pair, 0.05.
const RESIDUAL_MAX: f64 = 3.0;

/// Information of the prior in units of the largest cell's: the power of a cell that no pair sees is 0 with a variance 1e9 times the least.
const PRIOR: f64 = 1e-9;

/// Maximum number of products of two cells in a fit: those of 22,000 visibilities in cells of their lengths are 2e5. Lengths are untrusted.
const PRODUCTS_MAX: f64 = 1e8;

/// Maximum number of spans of a fit: a pass of the default array has some hundreds of packets in a channel.
const SPANS_MAX: usize = 1 << 12;

/// The visibilities of a block in the fit: those of a pair from the first to the last.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub(super) struct FittedSpan {
    pair: Pair,
    band: u16,
    from_s: f64,
    until_s: f64,
    /// Motion of the baseline at both ends, wavelengths per s. A visibility that arrives again may have lost its neighbours.
    motions: [Vec3; 2],
}

impl FittedSpan {
    fn motion(&self, time_s: f64) -> Vec3 {
        let length_s = self.until_s - self.from_s;
        let part = if length_s > 0.0 { (time_s - self.from_s) / length_s } else { 0.0 };
        add(self.motions[0], scale(part, sub(self.motions[1], self.motions[0])))
    }
}

/// The power of a burst by time, in cells of equal length.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct LightCurve {
    /// Direction, a unit vector on ecliptic axes.
    pub hat: Vec3,
    /// Radius of the Moon, which hides it, m.
    pub moon_radius_m: f64,
    /// Whether fringes turned during integrations.
    pub smears: bool,
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

/// The spans of rows, which follow each other by block.
fn spans_of(rows: &[BurstRow]) -> Vec<FittedSpan> {
    let of_block = rows.chunk_by(|a, b| std::ptr::eq(a.block, b.block));
    let span = |rows: &[BurstRow]| {
        let time_s = |row: &BurstRow| row.block.time_s[row.k];
        let (mut first, mut last) = (&rows[0], &rows[0]);
        for row in rows {
            first = if time_s(row) < time_s(first) { row } else { first };
            last = if time_s(row) > time_s(last) { row } else { last };
        }
        let [from_s, until_s] = [first, last].map(time_s);
        let motions = [first, last].map(|row| motion(row.block, row.k));
        FittedSpan { pair: first.block.pair, band: first.block.band, from_s, until_s, motions }
    };
    let mut spans: Vec<FittedSpan> = of_block.map(span).collect();
    spans.sort_by(|a, b| (a.pair, a.band).cmp(&(b.pair, b.band)).then(a.from_s.total_cmp(&b.from_s)));
    spans
}

impl LightCurve {
    /// Fits the powers from `from_s` to `until_s`; `None` if the rows do not determine them.
    pub(super) fn fit(
        rows: &[BurstRow],
        Place { hat, moon_radius_m, smears }: Place,
        [from_s, until_s]: [f64; 2],
    ) -> Option<Self> {
        // Of each visibility, so that pairs count by how often they integrate: half of them resolve a cell.
        let usual_s = median(rows.iter().map(BurstRow::duration_s).collect())?;
        let cell_s = usual_s.max((until_s - from_s) / CELLS_MAX as f64).max(CELL_S_MIN);
        let cells = (((until_s - from_s) / cell_s).ceil() as usize).clamp(1, CELLS_MAX);
        let products = |row: &BurstRow| (row.duration_s() / cell_s + 2.0).min(cells as f64).powi(2);
        if rows.iter().map(products).sum::<f64>() > PRODUCTS_MAX {
            return None;
        }
        let blank = vec![0.0_f32; cells];
        let mut curve = Self {
            hat,
            moon_radius_m,
            smears,
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
            let value = fringe.conj() * row.block.value_k_sr[row.k];
            let parts: Vec<(usize, Complex64)> = curve.parts(row.block, row.k).collect();
            for (cell, part) in &parts {
                powers[*cell] += information * (part.conj() * value).re;
                for (other, of_other) in &parts {
                    matrix[cell * cells + other] += information * (part.conj() * of_other).re;
                }
            }
        }
        let largest = (0..cells).map(|cell| matrix[cell * (cells + 1)]).fold(0.0, f64::max);
        (0..cells).for_each(|cell| matrix[cell * (cells + 1)] += PRIOR * largest);
        let factor = DenseFactor::new(&matrix, cells)?;
        factor.solve(&mut powers);
        let inverse = factor.inverse();
        curve.power_k_sr = powers.iter().map(|power| *power as f32).collect();
        // The information is of both parts of a visibility, of which the power is in one: half the variance.
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
                    let (power_k_sr, variance) = self.mean(row.block, row.k);
                    let residual = value - fringe * power_k_sr;
                    (0, residual.norm_sqr() / (row.variance_k2_sr2(1.0) + variance))
                }
                None => (1, value.norm_sqr() / row.variance_k2_sr2(1.0)),
            };
            for Share { cell, share, .. } in self.shares(row.block, row.k) {
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

    fn shares(&self, block: &PlacedVisibilities, k: usize) -> impl Iterator<Item = Share> + use<> {
        shares([self.from_s, self.cell_s], self.cells(), [block.time_s[k], duration_s(block, k)])
    }

    /// Cells of an integration, and the powers of them in a visibility in units of the fringe at its middle.
    fn parts(
        &self,
        block: &PlacedVisibilities,
        k: usize,
    ) -> impl Iterator<Item = (usize, Complex64)> + use<> {
        let motion = self.span_of(block, k).filter(|_| self.smears).map(|span| span.motion(block.time_s[k]));
        let rate = motion.map_or(0.0, |motion| dot(motion, self.hat));
        let duration_s = duration_s(block, k);
        self.shares(block, k).map(move |share| (share.cell, share.turned(rate, duration_s)))
    }

    /// Visibility of a source of 1 K sr at the middle of an integration; `None` where the Moon hides it.
    fn fringe(&self, block: &PlacedVisibilities, k: usize) -> Option<Complex64> {
        let [r_i_m, r_j_m] = [block.r_i_m[k], block.r_j_m[k]];
        let is_hidden = [r_i_m, r_j_m].iter().any(|r_m| hidden_by_moon(*r_m, self.hat, self.moon_radius_m));
        (!is_hidden).then(|| plane_wave(1.0, self.hat, sub(r_i_m, r_j_m), block.frequency_hz))
    }

    /// Mean power in an integration, in units of the fringe at its middle, and its variance.
    fn mean(&self, block: &PlacedVisibilities, k: usize) -> (Complex64, f64) {
        let mut mean = (Complex64::ZERO, 0.0);
        for (cell, part) in self.parts(block, k) {
            mean.0 += part * f64::from(self.power_k_sr[cell]);
            mean.1 += part.norm_sqr() * f64::from(self.variance_k2_sr2[cell]);
        }
        mean
    }

    /// The span of the fit that visibility `k` of a block lies in, if it was in the fit.
    fn span_of(&self, block: &PlacedVisibilities, k: usize) -> Option<&FittedSpan> {
        let (key, time_s) = ((block.pair, block.band), block.time_s[k]);
        let is_before = |span: &FittedSpan| match (span.pair, span.band).cmp(&key) {
            Ordering::Less => true,
            Ordering::Equal => span.from_s <= time_s,
            Ordering::Greater => false,
        };
        let next = self.fitted.partition_point(is_before);
        let last = self.fitted[..next].last();
        last.filter(|span| (span.pair, span.band) == key && time_s <= span.until_s)
    }

    /// Visibility `k` of a block without the burst, and its weight; `None` if the burst is not known well enough to subtract it, or the
    /// visibility was not in the fit, which has not judged it.
    pub(super) fn without_burst(&self, block: &PlacedVisibilities, k: usize) -> Option<(Complex64, f64)> {
        let (power_k_sr, variance) = self.mean(block, k);
        if variance.is_infinite() || self.span_of(block, k).is_none() {
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
            && self.fitted.iter().flat_map(|span| span.motions).flatten().all(f64::is_finite)
            && self.variance_k2_sr2.len() == self.cells()
            && self.power_k_sr.iter().all(|power| power.is_finite())
            && self.variance_k2_sr2.iter().all(|variance| *variance >= 0.0)
    }
}
