//! What couples low degrees of different orders in BtN^-1B, for preconditioning.
//!
//! The blocks of [`super::OrderBlocks`] average the weights over the torus. What they leave out are the other harmonics of the weights,
//! `w_kk'(p, q) = sum W_kk'(alpha, gamma) exp(i p alpha + i q gamma)`, with which
//!
//! ```text
//! A(l m, l' m') = sum_{mu mu'} d^l_{m mu} d^l'_{m' mu'} sum_{kk'} f_{l mu}^k f_{l' mu'}^k' w_kk'(m - m', mu - mu').
//! ```
//!
//! Nodes far beyond those that see the degrees are left out: there all but the averages is small.

use std::ops::Range;

use faer::{Accum, Mat, MatMut, MatRef, Par};
use num_complex::{Complex32, Complex64};
use rayon::prelude::*;
use rustfft::FftPlanner;

use super::grid::{ALPHAS, Grids, NODES};
use super::stored::TorusPart;
use super::sums::HarmonicSums;
use super::tori::Tori;
use crate::imaging::power::Coupling;
use crate::imaging::unknowns::{degrees, degrees_orders_parts};
use crate::response::harmonic::degree_count;
use crate::response::harmonic::filter::FilteredPatterns;
use crate::sky::harmonics::WignerTable;

/// Degrees up to this multiple of `2 pi u` of the shortest baseline u are coupled: 25 for 100 m at 10 MHz.
const SEEN: f64 = 1.2;
/// Highest such degree; the time grows with its sixth power.
const COUPLED_DEGREES: usize = 48;
/// The same in units of l_max, so that it takes no longer than a few products.
const COUPLED_SHARE: f64 = 0.3;
/// Baselines that see a degree l have about l / (2 pi) wavelengths; those beyond this multiple are left out.
const REACH: f64 = 2.0;

/// Harmonics of the weights of some nodes.
struct WeightHarmonics {
    /// Highest p and q.
    highest: usize,
    nodes: usize,
    /// `[node][diagonal][cos, sin of p alpha][p][re, im][q]`, q from 0.
    sums: Vec<f32>,
}

/// The patterns and rows of d of one order mu, from `-l_max` to `l_max`.
struct OrderPattern {
    mu: i64,
    /// f_{l mu} at these nodes, for l = |mu|, |mu| + 2, ..
    pattern: Mat<f32>,
    /// d^l_{m mu}, m = -l ..= l.
    rows: Vec<Vec<f64>>,
}

impl HarmonicSums {
    /// What [`Self::order_blocks`] lack of BtN^-1B at the degrees that the shortest baselines see, where coverage is least even. `None` of a
    /// rank's share, if the sums could not be read, or if no baseline is short enough for these degrees.
    pub(in crate::imaging) fn coupling(&self) -> Option<Coupling> {
        // Of several ranks each has a part of the weights.
        if self.grids.share.count > 1 {
            return None;
        }
        let shortest = self.grids.nodes.u(self.shared().reached.start + NODES / 2).max(0.0);
        let seen = (SEEN * std::f64::consts::TAU * shortest) as usize;
        let l_max = self.setup.l_max;
        let degree_max = seen.clamp(2, COUPLED_DEGREES).min((COUPLED_SHARE * l_max as f64) as usize);
        let wavelengths = REACH * degree_max as f64 / std::f64::consts::TAU;
        let matrix = self.coupling_within(degree_max, wavelengths)?;
        let places = degrees(l_max).enumerate().filter(|(_, l)| *l <= degree_max);
        Some(Coupling { degree_max, places: places.map(|(place, _)| place).collect(), matrix })
    }

    /// The coupling of all unknowns up to a degree, from nodes up to a baseline, wavelengths.
    pub(super) fn coupling_within(&self, l_max: usize, wavelengths: f64) -> Option<Mat<f64>> {
        let reached = self.shared().reached;
        let nodes = reached.start..reached.end.min(self.grids.nodes_up_to(wavelengths));
        if nodes.is_empty() {
            return None;
        }
        let wigner = WignerTable::new(l_max, self.setup.orbit.inclination_rad);
        let orders = order_patterns(&self.operator().patterns, &wigner, l_max, &nodes);
        let harmonics = WeightHarmonics::new(&self.grids, &self.tori, nodes, 2 * l_max)?;
        let of_difference = |p: usize| (p, difference_matrices(&orders, &harmonics, l_max, p));
        let all: Vec<_> = (0..=2 * l_max).into_par_iter().map(of_difference).collect();
        Some(real_matrix(l_max, &all))
    }
}

impl WeightHarmonics {
    fn new(grids: &Grids, tori: &Tori, nodes: Range<usize>, highest: usize) -> Option<Self> {
        let (points, count) = (grids.points, highest + 1);
        let node_len = NODES * 4 * count * count;
        let mut sums = vec![0.0_f32; nodes.len() * node_len];
        let transform = FftPlanner::<f32>::new().plan_fft_inverse(points);
        for block in (0..points.div_ceil(ALPHAS)).filter(|block| grids.share.holds(*block)) {
            let rows = tori.block(grids, TorusPart::Weights, block)?;
            let alphas: Vec<usize> = (block * ALPHAS..points.min((block + 1) * ALPHAS)).collect();
            // `[cos, sin of p alpha][p]` by alpha.
            let phases = Mat::<f32>::from_fn(2 * count, alphas.len(), |row, k| {
                let angle =
                    std::f64::consts::TAU * ((row % count * alphas[k]) % points) as f64 / points as f64;
                if row < count { angle.cos() as f32 } else { angle.sin() as f32 }
            });
            sums.par_chunks_exact_mut(node_len).zip(nodes.clone()).for_each(|(sums, node)| {
                // `[diagonal][re, im][q]` by alpha.
                let mut spectra = Mat::<f32>::zeros(NODES * 2 * count, alphas.len());
                let mut line = vec![Complex32::ZERO; points];
                let mut has_data = false;
                for k in 0..alphas.len() {
                    let Some(row) = rows.row(node, k) else { continue };
                    has_data = true;
                    for (d, row) in row.chunks_exact(grids.weight_stride()).enumerate() {
                        line.iter_mut().zip(row).for_each(|(z, w)| *z = Complex32::new(*w, 0.0));
                        transform.process(&mut line);
                        for (q, z) in line[..count].iter().enumerate() {
                            spectra[((2 * d) * count + q, k)] = z.re;
                            spectra[((2 * d + 1) * count + q, k)] = z.im;
                        }
                    }
                }
                if has_data {
                    faer::linalg::matmul::matmul(
                        MatMut::from_row_major_slice_mut(sums, NODES * 2 * count, 2 * count),
                        Accum::Add,
                        &spectra,
                        phases.transpose(),
                        1.0,
                        Par::Seq,
                    );
                }
            });
        }
        Some(Self { highest, nodes: nodes.len(), sums })
    }

    /// w(p, q) of a node and a diagonal, for p >= 0; zero for p = q = 0, which the blocks have.
    fn at(&self, node: usize, diagonal: usize, p: usize, q: i64) -> Complex32 {
        if p == 0 && q == 0 {
            return Complex32::ZERO;
        }
        let count = self.highest + 1;
        let q_at = q.unsigned_abs() as usize;
        let part = |which: usize, trigonometric: usize| {
            self.sums[((node * NODES + diagonal) * 2 * count + which * count + q_at) * 2 * count
                + trigonometric * count
                + p]
        };
        // sum_alpha (cos p alpha + i sin p alpha) (re +- i im), as weights are real.
        let sign = if q < 0 { -1.0 } else { 1.0 };
        let (re, im) = ([part(0, 0), part(0, 1)], [sign * part(1, 0), sign * part(1, 1)]);
        Complex32::new(re[0] - im[1], re[1] + im[0])
    }
}

fn order_patterns(
    patterns: &FilteredPatterns,
    wigner: &WignerTable,
    l_max: usize,
    nodes: &Range<usize>,
) -> Vec<OrderPattern> {
    let stride = 2 * patterns.grid.count;
    let of_order = |mu: i64| {
        let order = mu.unsigned_abs() as usize;
        let all = patterns.order(order);
        let sign = usize::from(mu < 0);
        let pattern = Mat::from_fn(nodes.len(), degree_count(l_max, order), |k, i| {
            all[i * stride + 2 * (nodes.start + k) + sign]
        });
        let mut rows = Vec::new();
        let mut every = wigner.rows(order);
        while let Some((l, row)) = every.next_row() {
            if l <= l_max && (l - order).is_multiple_of(2) {
                // d^l_{m, -mu} = (-1)^(m + mu) d^l_{-m, mu}; patterns of -mu have a factor (-1)^mu.
                let of_m = |m: i64| match mu < 0 {
                    true if m % 2 != 0 => -row[(l as i64 - m) as usize],
                    true => row[(l as i64 - m) as usize],
                    false => row[(l as i64 + m) as usize],
                };
                rows.push((-(l as i64)..=l as i64).map(of_m).collect());
            }
        }
        OrderPattern { mu, pattern, rows }
    };
    (-(l_max as i64)..=l_max as i64).map(of_order).collect()
}

/// Elements `H(l m, l' m')` with m - m' = p: for each m' from `-l_max` a matrix over l, l' from 0.
fn difference_matrices(
    orders: &[OrderPattern],
    harmonics: &WeightHarmonics,
    l_max: usize,
    p: usize,
) -> Vec<Mat<Complex64>> {
    let last = l_max as i64;
    let mut matrices: Vec<Mat<Complex64>> =
        (-last..=last - p as i64).map(|_| Mat::zeros(l_max + 1, l_max + 1)).collect();
    for right in orders {
        for left in orders {
            let product = weighted_product(left, right, harmonics, p);
            for (m_right, matrix) in (-last..).zip(&mut matrices) {
                let m_left = m_right + p as i64;
                left.for_each_degree(m_left, &mut |i, l, d| {
                    right.for_each_degree(m_right, &mut |j, other, d_other| {
                        let re = f64::from(product[(i, 2 * j)]);
                        let im = f64::from(product[(i, 2 * j + 1)]);
                        matrix[(l, other)] += d * d_other * Complex64::new(re, im);
                    });
                });
            }
        }
    }
    matrices
}

impl OrderPattern {
    /// Calls `take` with the index, degree and d of each degree that has an order m.
    fn for_each_degree(&self, m: i64, take: &mut dyn FnMut(usize, usize, f64)) {
        let order = self.mu.unsigned_abs() as usize;
        for (i, row) in self.rows.iter().enumerate() {
            let l = order + 2 * i;
            if m.unsigned_abs() as usize <= l {
                take(i, l, row[(l as i64 + m) as usize]);
            }
        }
    }
}

/// `sum_kk' f_{l mu}^k w_kk' f_{l' mu'}^k'`: columns are real and imaginary parts for each l'.
fn weighted_product(
    left: &OrderPattern,
    right: &OrderPattern,
    harmonics: &WeightHarmonics,
    p: usize,
) -> Mat<f32> {
    let nodes = harmonics.nodes;
    let mut weighted = Mat::<f32>::zeros(nodes, 2 * right.pattern.ncols());
    for node in 0..nodes {
        for d in 0..NODES.min(nodes - node) {
            let w = harmonics.at(node, d, p, left.mu - right.mu);
            for j in 0..right.pattern.ncols() {
                let high = right.pattern[(node + d, j)];
                weighted[(node, 2 * j)] += w.re * high;
                weighted[(node, 2 * j + 1)] += w.im * high;
                if d > 0 {
                    let low = right.pattern[(node, j)];
                    weighted[(node + d, 2 * j)] += w.re * low;
                    weighted[(node + d, 2 * j + 1)] += w.im * low;
                }
            }
        }
    }
    let mut product = Mat::<f32>::zeros(left.pattern.ncols(), weighted.ncols());
    faer::linalg::matmul::matmul(
        &mut product,
        Accum::Replace,
        left.pattern.transpose(),
        MatRef::from(weighted.as_ref()),
        1.0,
        Par::Seq,
    );
    product
}

/// The matrix over real unknowns: `Re U^t H conj(U)`, with `T = U x`.
fn real_matrix(l_max: usize, differences: &[(usize, Vec<Mat<Complex64>>)]) -> Mat<f64> {
    let last = l_max as i64;
    let element = |l: usize, m: i64, other: usize, m_other: i64| {
        let (p, first) = (m - m_other, m_other.min(m) + last);
        let matrix = &differences[p.unsigned_abs() as usize].1[first as usize];
        if p >= 0 { matrix[(l, other)] } else { matrix[(other, l)].conj() }
    };
    let unknowns: Vec<(usize, usize, usize)> = degrees_orders_parts(l_max).collect();
    // Coefficients of T_lm and T_l-m = (-1)^m conj(T_lm).
    let terms = |(_, m, part): (usize, usize, usize)| -> Vec<(i64, Complex64)> {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let unit = if part == 0 { Complex64::new(half, 0.0) } else { Complex64::new(0.0, half) };
        match m {
            0 => vec![(0, Complex64::ONE)],
            m if m % 2 == 0 => vec![(m as i64, unit), (-(m as i64), unit.conj())],
            m => vec![(m as i64, unit), (-(m as i64), -unit.conj())],
        }
    };
    let terms: Vec<Vec<(i64, Complex64)>> = unknowns.iter().map(|unknown| terms(*unknown)).collect();
    Mat::from_fn(unknowns.len(), unknowns.len(), |i, j| {
        let mut sum = 0.0;
        for (m, u) in &terms[i] {
            for (m_other, v) in &terms[j] {
                sum += (u * v.conj() * element(unknowns[i].0, *m, unknowns[j].0, *m_other)).re;
            }
        }
        sum
    })
}
