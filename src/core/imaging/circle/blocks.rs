//! The blocks of BtN^-1B that are diagonal in the order m, for preconditioning.

use std::borrow::Cow;

use faer::linalg::solvers::{Llt, Solve};
use faer::{Accum, Mat, MatMut, MatRef, Par, Side};
use rayon::prelude::*;

use super::HarmonicSetup;
use super::grid::ALPHAS;
use super::grid::{Grids, NODES};
use super::stored::TorusPart;
use super::tori::Tori;
use crate::imaging::exact::fixed_point::parts::sum_of_parts;
use crate::imaging::power::Block;
use crate::ranks::Ranks;
use crate::response::harmonic::degree_count;
use crate::response::harmonic::filter::FilteredPatterns;
use crate::sky::harmonics::WignerTable;

/// For each m two matrices, over l = m, m + 2, .. and over l = m + 1, m + 3, ... Weights averaged over the phase do not couple even and odd
/// degrees, because patterns have only even l + mu.
///
/// `A_m(l, l') = sum_mu d^l_{m mu} d^l'_{m mu} sum_{kk'} W_kk' f_{l mu}^k f_{l' mu}^k'`, with W summed over the torus.
#[derive(Clone, Debug)]
pub struct OrderBlocks {
    l_max: usize,
    /// `[m][parity of l - m]`.
    blocks: Vec<[Mat<f64>; 2]>,
}

/// Cholesky factors of the blocks; `None` for a block that is not positive definite.
pub struct OrderFactors {
    l_max: usize,
    factors: Vec<[Option<Llt<f64>>; 2]>,
}

impl OrderBlocks {
    pub(super) fn new(
        patterns: &FilteredPatterns,
        grids: &Grids,
        tori: &Tori,
        setup: &HarmonicSetup,
        ranks: &Ranks,
    ) -> Self {
        let l_max = setup.l_max;
        let totals = totals(grids, tori, ranks);
        let wigner = WignerTable::new(l_max, setup.orbit.inclination_rad);
        let mut blocks: Vec<[Mat<f64>; 2]> = (0..=l_max)
            .map(|m| [0, 1].map(|parity| Mat::zeros(size(l_max, m, parity), size(l_max, m, parity))))
            .collect();
        // Only a few orders mu at a time, because of the memory of their matrices and rows of d.
        for first in (0..=l_max).step_by(MUS_AT_ONCE) {
            let last = (first + MUS_AT_ONCE - 1).min(l_max);
            let parts: Vec<MuPart> = (first..=last)
                .into_par_iter()
                .map(|mu| MuPart::new(mu, l_max, patterns, &totals, &wigner))
                .collect();
            blocks.par_iter_mut().enumerate().for_each(|(m, blocks)| {
                parts.iter().for_each(|part| part.add(m, blocks));
            });
        }
        Self { l_max, blocks }
    }

    /// The diagonal element of the zonal coefficient of degree `l`, (K sr^(1/2))^-2.
    #[must_use]
    pub fn diagonal(&self, l: usize) -> f64 {
        self.blocks[0][l % 2][(l / 2, l / 2)]
    }

    /// Multiplies a vector of unknowns by the blocks, in place.
    pub fn multiply(&self, unknowns: &mut [f64]) {
        let mut rest = unknowns;
        for (m, blocks) in self.blocks.iter().enumerate() {
            let parts = parts_of(m);
            let (of_m, others) = rest.split_at_mut(parts * (self.l_max + 1 - m));
            rest = others;
            for (parity, block) in blocks.iter().enumerate() {
                let product = block * gather(of_m, parity, parts, block.nrows());
                scatter(of_m, parity, parts, &product);
            }
        }
    }

    /// The blocks with the indices of their unknowns, in order of m and parity.
    pub(in crate::imaging) fn blocks(&self) -> Vec<Block<'_>> {
        let mut first = 0;
        let mut all = Vec::new();
        for (m, blocks) in self.blocks.iter().enumerate() {
            let parts = parts_of(m);
            for (parity, block) in blocks.iter().enumerate().filter(|(_, block)| block.nrows() > 0) {
                let place = |part: usize| {
                    (0..block.nrows()).map(|k| first + (2 * k + parity) * parts + part).collect()
                };
                all.push(Block {
                    matrix: Cow::Borrowed(block),
                    degrees: (0..block.nrows()).map(|k| m + parity + 2 * k).collect(),
                    places: (0..parts).map(place).collect(),
                });
            }
            first += parts * (self.l_max + 1 - m);
        }
        all
    }

    /// Factorises the blocks plus `regularisation` I. A block that is not positive definite leaves its unknowns unchanged in solutions.
    #[must_use]
    pub fn factors(&self, regularisation: f64) -> OrderFactors {
        self.factors_with(&|_| regularisation)
    }

    /// Factorises the blocks plus an R that depends on the degree.
    #[must_use]
    pub fn factors_with(&self, of_degree: &(dyn Fn(usize) -> f64 + Sync)) -> OrderFactors {
        let factor = |m: usize, parity: usize, block: &Mat<f64>| {
            let mut block = block.clone();
            for k in 0..block.nrows() {
                block[(k, k)] += of_degree(m + parity + 2 * k);
            }
            block.llt(Side::Lower).ok()
        };
        let both =
            |(m, blocks): (usize, &[Mat<f64>; 2])| [0, 1].map(|parity| factor(m, parity, &blocks[parity]));
        let factors = self.blocks.par_iter().enumerate().map(both).collect();
        OrderFactors { l_max: self.l_max, factors }
    }
}

impl OrderFactors {
    /// Solves for a vector of unknowns, in place.
    pub fn solve(&self, unknowns: &mut [f64]) {
        let mut rest = unknowns;
        for (m, factors) in self.factors.iter().enumerate() {
            let parts = parts_of(m);
            let (of_m, others) = rest.split_at_mut(parts * (self.l_max + 1 - m));
            rest = others;
            for (parity, factor) in factors.iter().enumerate() {
                let Some(factor) = factor else { continue };
                let mut right = gather(of_m, parity, parts, size(self.l_max, m, parity));
                factor.solve_in_place(&mut right);
                scatter(of_m, parity, parts, &right);
            }
        }
    }
}

/// The order m of each of [`OrderBlocks::blocks`].
pub(super) fn orders_of(l_max: usize) -> Vec<usize> {
    let of_order = |m: usize| (0..2).filter(move |parity| size(l_max, m, *parity) > 0).map(move |_| m);
    (0..=l_max).flat_map(of_order).collect()
}

/// Number of real unknowns per coefficient of order m.
fn parts_of(m: usize) -> usize {
    if m == 0 { 1 } else { 2 }
}

/// The unknowns of one order and parity: one row for each of `count` degrees.
fn gather(of_m: &[f64], parity: usize, parts: usize, count: usize) -> Mat<f64> {
    Mat::from_fn(count, parts, |k, part| of_m[(2 * k + parity) * parts + part])
}

/// Writes back the unknowns of one order and parity.
fn scatter(of_m: &mut [f64], parity: usize, parts: usize, values: &Mat<f64>) {
    for k in 0..values.nrows() {
        for part in 0..parts {
            of_m[(2 * k + parity) * parts + part] = values[(k, part)];
        }
    }
}

/// Number of orders mu whose parts are in memory at once.
const MUS_AT_ONCE: usize = 16;

/// Number of degrees l = m + parity, m + parity + 2, .. <= l_max.
fn size(l_max: usize, m: usize, parity: usize) -> usize {
    (l_max + 2).saturating_sub(m + parity) / 2
}

/// Sums of the weights over alpha and gamma for each pair of neighbouring nodes: `[node][diagonal]`.
fn totals(grids: &Grids, tori: &Tori, ranks: &Ranks) -> Vec<[f64; NODES]> {
    let stride = grids.weight_stride();
    let len = NODES * grids.nodes.count;
    // By blocks of alphas, as in products.
    let part = |block: usize| {
        let mut totals = vec![0.0; len];
        let Some(rows) = tori.block(grids, TorusPart::Weights, block) else { return vec![f64::NAN] };
        for (node, totals) in totals.as_chunks_mut::<NODES>().0.iter_mut().enumerate() {
            for row in
                (0..ALPHAS.min(grids.points - block * ALPHAS)).filter_map(|alpha| rows.row(node, alpha))
            {
                for (total, row) in totals.iter_mut().zip(row.chunks_exact(stride)) {
                    *total += row.iter().map(|w| f64::from(*w)).sum::<f64>();
                }
            }
        }
        totals
    };
    let blocks: Vec<usize> =
        (0..grids.points.div_ceil(ALPHAS)).filter(|block| grids.share.holds(*block)).collect();
    let parts: Vec<Vec<f64>> = blocks.into_par_iter().map(part).collect();
    sum_of_parts(ranks, &parts, len, grids.points.div_ceil(ALPHAS)).as_chunks().0.to_vec()
}

/// The product of the banded matrix of weights and the patterns of order mu, for both signs of mu.
fn weighted(patterns: &FilteredPatterns, totals: &[[f64; NODES]], mu: usize, l_max: usize) -> Vec<f32> {
    let count = degree_count(l_max, mu);
    let stride = 2 * patterns.grid.count;
    let pattern = &patterns.order(mu)[..count * stride];
    let mut weighted = vec![0.0_f32; count * stride];
    for (out, row) in weighted.chunks_exact_mut(stride).zip(pattern.chunks_exact(stride)) {
        for (k, totals) in totals.iter().enumerate() {
            for (d, total) in totals.iter().enumerate().take_while(|(d, _)| k + d < patterns.grid.count) {
                for sign in 0..2 {
                    let (low, high) = (2 * k + sign, 2 * (k + d) + sign);
                    out[low] += *total as f32 * row[high];
                    if d > 0 {
                        out[high] += *total as f32 * row[low];
                    }
                }
            }
        }
    }
    weighted
}

/// The contribution of one order mu: products of weights and patterns, and rows of d.
struct MuPart {
    mu: usize,
    l_max: usize,
    /// Matrix over l, l' = mu, mu + 2, .., averaged over mu and -mu.
    powers: Mat<f64>,
    /// Rows d^l_{m mu}, m = -l ..= l, for l = mu, mu + 2, ..
    rows: Vec<Vec<f64>>,
}

impl MuPart {
    fn new(
        mu: usize,
        l_max: usize,
        patterns: &FilteredPatterns,
        totals: &[[f64; NODES]],
        wigner: &WignerTable,
    ) -> Self {
        let count = degree_count(l_max, mu);
        let stride = 2 * patterns.grid.count;
        let pattern = &patterns.order(mu)[..count * stride];
        let weighted = weighted(patterns, totals, mu, l_max);
        let mut powers = vec![0.0_f32; count * count];
        faer::linalg::matmul::matmul(
            MatMut::from_column_major_slice_mut(&mut powers, count, count),
            Accum::Replace,
            MatRef::from_column_major_slice(pattern, stride, count).transpose(),
            MatRef::from_column_major_slice(&weighted, stride, count),
            0.5,
            Par::Seq,
        );
        let mut rows = Vec::with_capacity(count);
        let mut all = wigner.rows(mu);
        while let Some((l, row)) = all.next_row() {
            if (l - mu).is_multiple_of(2) {
                rows.push(row.to_vec());
            }
        }
        let powers =
            Mat::from_fn(count, count, |i, j| 0.5 * f64::from(powers[i + count * j] + powers[j + count * i]));
        Self { mu, l_max, powers, rows }
    }

    fn add(&self, m: usize, blocks: &mut [Mat<f64>; 2]) {
        // Patterns have only l of the parity of mu.
        let parity = (self.mu + m) % 2;
        let block = &mut blocks[parity];
        let lowest = m.max(self.mu) + (m.max(self.mu) + self.mu) % 2;
        let signs: &[bool] = if self.mu == 0 { &[true] } else { &[true, false] };
        for &positive in signs {
            let d = |l: usize| {
                let row = &self.rows[(l - self.mu) / 2];
                if positive { row[l + m] } else { row[l - m] }
            };
            let values: Vec<f64> = (lowest..=self.l_max).step_by(2).map(d).collect();
            let (in_block, in_powers) = ((lowest - m - parity) / 2, (lowest - self.mu) / 2);
            for (j, right) in values.iter().enumerate() {
                for (i, left) in values.iter().enumerate() {
                    block[(in_block + i, in_block + j)] +=
                        left * right * self.powers[(in_powers + i, in_powers + j)];
                }
            }
        }
    }
}
