//! Applies BtN^-1B to harmonic coefficients, and projects data onto them.
//!
//! For each block of alphas (the longitude of the orbit's node less 90 degrees) the sky is rotated into the orbital plane by Wigner's d,
//! multiplied by the fringe patterns at all nodes (grid points of the baseline u), and transformed from order mu to gamma (the orbital phase plus
//! 90 degrees), where the weights multiply pointwise. Then the transposed steps follow in reverse order.

use std::ops::Range;

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::{Complex32, Complex64};
use rayon::prelude::*;

use super::grid::ALPHAS;
use super::grid::{Grids, NODE_GROUP, NODES};
use super::lines::multiply_line;
use super::stored::TorusPart;
use super::tori::{BlockRows, Tori};
use super::workspace::{NodeRange, Workspace};
use crate::imaging::exact::fixed_point::parts::sum_of_parts;
use crate::ranks::Ranks;
use crate::response::harmonic::filter::FilteredPatterns;
use crate::response::harmonic::rotation::{RotationTable, order_count};
use crate::response::harmonic::{PatternGeometry, PatternTable, degree_count};
use crate::sky::harmonics::Alm;

/// The operator BtN^-1B, with its tables.
#[derive(Debug)]
pub(super) struct Operator {
    l_max: usize,
    grids: Grids,
    rotation: RotationTable<f32>,
    pub(super) patterns: FilteredPatterns,
    /// Reciprocal of the transform of the data's spreading kernel, at the orders 0 ..= l_max.
    correction: Vec<f64>,
}

/// The sums of all ranks, as seen from one of them.
pub(super) struct SharedTori<'a> {
    pub(super) ranks: &'a Ranks,
    /// The share of this rank.
    pub(super) tori: &'a Tori,
    /// The range of nodes with data on any rank.
    pub(super) reached: Range<usize>,
    /// Whether each alpha has weights here.
    pub(super) used: &'a [bool],
}

/// The right-hand side of the data or of the noise-only map.
#[derive(Clone, Copy)]
pub(super) enum RightHandSide {
    Data,
    Noise,
}

/// The blocks of alphas over which a product is summed.
struct Blocks<'a> {
    ranks: &'a Ranks,
    /// Whether each alpha has data.
    used: &'a [bool],
    reach: NodeRange,
    /// Number of skies.
    skies: usize,
    /// Whether blocks are taken in reverse order.
    is_reversed: bool,
}

/// The points of a grid of an angle.
#[derive(Clone, Copy)]
struct AngleGrid {
    points: usize,
}

impl AngleGrid {
    /// Sine and cosine of the angle of a point.
    fn sin_cos(self, index: usize) -> (f64, f64) {
        (std::f64::consts::TAU * (index % self.points) as f64 / self.points as f64).sin_cos()
    }
}

impl Operator {
    pub(super) fn new(
        l_max: usize,
        grids: Grids,
        geometry: PatternGeometry,
        inclination_rad: f64,
        fractional_bandwidth: f64,
    ) -> Self {
        let table = PatternTable::new(geometry, l_max, grids.table_nodes());
        let step = grids.nodes.step;
        let patterns = FilteredPatterns::new(
            table,
            1.002 * step,
            |f| grids.u.transforms(f).iter().map(|t| 1.0 / t).collect(),
            |u| u * fractional_bandwidth / step,
        );
        let correction = grids.data_correction(l_max);
        let rotation = RotationTable::new(l_max, inclination_rad);
        Self { l_max, grids, rotation, patterns, correction }
    }

    /// Bytes of the tables.
    pub(super) fn table_bytes(l_max: usize, grids: &Grids) -> u64 {
        let patterns: usize =
            (0..=l_max).map(|mu| 2 * grids.table_nodes().count * degree_count(l_max, mu)).sum();
        let rotation: usize = (0..=l_max).map(|l| 2 * order_count(l) * (l + 1)).sum();
        // The patterns are filtered from a table of the same size.
        (4 * (2 * patterns + rotation)) as u64
    }

    /// Bytes of one thread's workspace for this many skies.
    pub(super) fn workspace_bytes(l_max: usize, grids: &Grids, skies: usize) -> u64 {
        (4 * (l_max + 1) * 2 * skies * ALPHAS * (2 * grids.nodes.count + l_max / 4)) as u64
    }

    /// Floating-point operations of the products with patterns and rotations in one application.
    pub(super) fn matrix_product_flops(&self, shared: &SharedTori<'_>) -> f64 {
        let reach = self.reach(shared.reached.clone());
        let blocks = shared.used.chunks(ALPHAS).filter(|block| block.contains(&true)).count();
        let patterns: usize = (0..=self.l_max).map(|mu| 2 * reach.count * degree_count(self.l_max, mu)).sum();
        let rotations: usize = (0..=self.l_max).map(|l| order_count(l) * (l + 1)).sum();
        // Forward and back, real and imaginary parts, multiplications and additions.
        (2 * 2 * 2 * ALPHAS * blocks * (patterns + rotations)) as f64
    }

    /// Extends the range of nodes with data to whole groups.
    fn reach(&self, reached: Range<usize>) -> NodeRange {
        let first = reached.start / NODE_GROUP * NODE_GROUP;
        NodeRange { first, count: (reached.end - first).next_multiple_of(NODE_GROUP) }
    }

    /// Multiplies the coefficients of each sky by BtN^-1B. The results are gradients of x'Ax / 2 with
    /// respect to real and imaginary parts for m >= 0.
    /// Weights and patterns are read once for all skies, but each product has the bits that it would have alone.
    pub(super) fn apply(&self, shared: &SharedTori<'_>, skies: &[Alm]) -> Vec<Alm> {
        if skies.is_empty() {
            return Vec::new();
        }
        let tori = shared.tori;
        let reach = self.reach(shared.reached.clone());
        let circle = AngleGrid { points: self.grids.points };
        let blocks = Blocks {
            ranks: shared.ranks,
            used: shared.used,
            reach,
            skies: skies.len(),
            is_reversed: tori.next_is_reversed(),
        };
        self.sum_over_blocks(blocks, |work, alphas| {
            let rows = tori.block(&self.grids, TorusPart::Weights, alphas[0] / ALPHAS)?;
            work.rotated.fill(0.0);
            for (first, sky) in (0..).step_by(ALPHAS).zip(skies) {
                self.rotate(sky, circle, alphas, first, work);
            }
            self.multiply_patterns(work, reach);
            for (place, &alpha) in alphas.iter().enumerate() {
                for first in (0..work.columns).step_by(ALPHAS) {
                    self.multiply_weights(&rows, alpha % ALPHAS, first + place, work, reach);
                }
            }
            Some(self.gradients(work, reach, circle, alphas, None))
        })
    }

    /// Computes BtN^-1 times the data or the noise.
    pub(super) fn project(&self, shared: &SharedTori<'_>, side: RightHandSide) -> Alm {
        let tori = shared.tori;
        let reach = self.reach(shared.reached.clone());
        let circle = AngleGrid { points: self.grids.data_points() };
        let used = tori.alphas(&self.grids, TorusPart::Right);
        let blocks = Blocks { ranks: shared.ranks, used: &used, reach, skies: 1, is_reversed: false };
        let mut projected = self.sum_over_blocks(blocks, |work, alphas| {
            let rows = tori.block(&self.grids, TorusPart::Right, alphas[0] / ALPHAS)?;
            work.products.fill(0.0);
            for (place, &alpha) in alphas.iter().enumerate() {
                for group in (0..reach.count).step_by(NODE_GROUP) {
                    for (k, line) in work.group.iter_mut().enumerate() {
                        let row = rows.row(reach.first + group + k, alpha % ALPHAS);
                        self.read_right_hand_side(row, side, line);
                        work.transforms.inverse(line);
                        for (mu, factor) in self.correction.iter().enumerate() {
                            line[mu] *= *factor as f32;
                            if mu > 0 {
                                line[circle.points - mu] *= *factor as f32;
                            }
                        }
                    }
                    work.scatter(place, 0, group);
                }
            }
            Some(self.gradients(work, reach, circle, alphas, Some(&self.correction)))
        });
        projected.swap_remove(0)
    }

    /// Sums the results of `block`, one vector per sky, over all blocks of alphas in use. The sums have the same bits for any order and any
    /// distribution of blocks among threads and ranks. They are NaN if `block` fails.
    fn sum_over_blocks(
        &self,
        over: Blocks<'_>,
        block: impl Fn(&mut Workspace, &[usize]) -> Option<Vec<Vec<f64>>> + Sync,
    ) -> Vec<Alm> {
        let Blocks { ranks, used, reach, skies, is_reversed } = over;
        let points = used.len();
        let of_range = |first: usize| -> Vec<usize> {
            (first..points.min(first + ALPHAS)).filter(|&alpha| used[alpha]).collect()
        };
        let mut blocks: Vec<Vec<usize>> =
            (0..points).step_by(ALPHAS).map(of_range).filter(|alphas| !alphas.is_empty()).collect();
        if is_reversed {
            blocks.reverse();
        }
        let parts: Vec<Vec<Vec<f64>>> = blocks
            .par_iter()
            .map_init(
                || Workspace::new(self.l_max, points, reach, skies),
                |work, alphas| block(work, alphas).unwrap_or_else(|| vec![vec![f64::NAN]; skies]),
            )
            .collect();
        let of_sky = |sky: usize| {
            let mut total = Alm::zeros(self.l_max);
            let parts: Vec<&[f64]> = parts.iter().map(|part| part[sky].as_slice()).collect();
            let sums = sum_of_parts(ranks, &parts, 2 * total.values().len(), points.div_ceil(ALPHAS));
            for (value, sums) in total.values_mut().iter_mut().zip(sums.as_chunks::<2>().0) {
                *value = Complex64::new(sums[0], sums[1]);
            }
            total
        };
        (0..skies).map(of_sky).collect()
    }

    /// The offset of each order mu in `columns` columns of rotated skies.
    fn rotated_starts(&self, columns: usize) -> Vec<usize> {
        let lengths = (0..=self.l_max).map(|mu| 2 * columns * degree_count(self.l_max, mu));
        lengths.scan(0, |end, length| Some(std::mem::replace(end, *end + length))).collect()
    }

    /// Rotates a sky into the orbital plane at each alpha, in the columns from `first` on: `t_{l mu} = sum_m d+ Re z + i d- Im z` with
    /// `z = conj(T_lm) exp(-i m alpha)`.
    fn rotate(&self, sky: &Alm, circle: AngleGrid, alphas: &[usize], first: usize, work: &mut Workspace) {
        let Workspace { columns, rotated, .. } = work;
        let starts = self.rotated_starts(*columns);
        let count = alphas.len();
        let phases = self.phases(circle, alphas);
        let mut z = [vec![0.0_f32; (self.l_max + 1) * ALPHAS], vec![0.0_f32; (self.l_max + 1) * ALPHAS]];
        let mut out = vec![0.0_f32; 2 * order_count(self.l_max) * ALPHAS];
        for l in 0..=self.l_max {
            let [re, im] = &mut z;
            let out = &mut out[..2 * order_count(l) * count];
            self.rotation.rotate_degree(l, |m| sky.get(l, m).conj(), &phases, [re, im], out);
            for (part, out) in out.chunks_exact(order_count(l) * count).enumerate() {
                for (k, column) in out.chunks_exact(order_count(l)).enumerate() {
                    for (index, value) in column.iter().enumerate() {
                        let mu = l % 2 + 2 * index;
                        let rows = degree_count(self.l_max, mu);
                        rotated[starts[mu] + (part * *columns + first + k) * rows + (l - mu) / 2] = *value;
                    }
                }
            }
        }
    }

    /// The sines and cosines of m alpha: `[m][alpha]`.
    fn phases(&self, circle: AngleGrid, alphas: &[usize]) -> Vec<(f64, f64)> {
        (0..=self.l_max).flat_map(|m| alphas.iter().map(move |alpha| circle.sin_cos(m * alpha))).collect()
    }

    /// The patterns of order mu at the nodes in reach, as a matrix.
    fn pattern(&self, mu: usize, reach: NodeRange) -> MatRef<'_, f32> {
        let stride = 2 * self.patterns.grid.count;
        let rows = &self.patterns.order(mu)[2 * reach.first..];
        MatRef::from_column_major_slice_with_stride(
            rows,
            2 * reach.count,
            degree_count(self.l_max, mu),
            stride,
        )
    }

    /// Multiplies the rotated skies by the patterns of all nodes.
    fn multiply_patterns(&self, work: &mut Workspace, reach: NodeRange) {
        let (starts, columns) = (self.rotated_starts(work.columns), 2 * work.columns);
        for (mu, products) in work.products.chunks_exact_mut(columns * 2 * reach.count).enumerate() {
            let rows = degree_count(self.l_max, mu);
            let rotated = &work.rotated[starts[mu]..starts[mu] + columns * rows];
            faer::linalg::matmul::matmul(
                MatMut::from_column_major_slice_mut(products, 2 * reach.count, columns),
                Accum::Replace,
                self.pattern(mu, reach),
                MatRef::from_column_major_slice(rotated, rows, columns),
                1.0,
                Par::Seq,
            );
        }
    }

    /// Multiplies one column by the weights of neighbouring nodes, between the transforms from mu to gamma (in `gather`) and back. `place` is its
    /// alpha's number in the block.
    fn multiply_weights(
        &self,
        block: &BlockRows<'_>,
        place: usize,
        column: usize,
        work: &mut Workspace,
        reach: NodeRange,
    ) {
        const BEHIND: usize = NODES - 1;
        let rows = |node: usize| block.row(node, place);
        work.ring.iter_mut().for_each(|line| line.fill(Complex32::ZERO));
        // Results lag behind the input by the number of nodes that weights couple.
        for group in (0..reach.count + NODE_GROUP).step_by(NODE_GROUP) {
            work.gather(column, group);
            for (k, line) in work.group.iter_mut().enumerate() {
                let node = (group + k).checked_sub(BEHIND).filter(|node| *node < reach.count);
                let Some(node) = node else {
                    line.fill(Complex32::ZERO);
                    continue;
                };
                let weights: [Option<&[f32]>; NODES] =
                    std::array::from_fn(|d| (reach.first + node).checked_sub(d).and_then(rows));
                let z = |offset: isize| {
                    let index = (node + 2 * NODE_GROUP).wrapping_add_signed(offset) % (2 * NODE_GROUP);
                    work.ring[index].as_slice()
                };
                multiply_line(line, &weights, self.grids.weight_stride(), z);
                work.transforms.inverse(line);
            }
            let skipped = BEHIND.saturating_sub(group);
            work.scatter(column, skipped, group + skipped - BEHIND);
        }
    }

    /// Copies a node's right-hand side at one alpha to a line.
    fn read_right_hand_side(&self, row: Option<&[f32]>, side: RightHandSide, line: &mut [Complex32]) {
        let stride = self.grids.data_stride();
        let Some(row) = row else {
            line.fill(Complex32::ZERO);
            return;
        };
        let (re, im) = row[2 * side as usize * stride..][..2 * stride].split_at(stride);
        for ((out, re), im) in line.iter_mut().zip(re).zip(im) {
            *out = Complex32::new(*re, *im);
        }
    }

    /// Multiplies by the transposed patterns, rotates back from the orbital plane, and sums over alpha, for each sky.
    fn gradients(
        &self,
        work: &mut Workspace,
        reach: NodeRange,
        circle: AngleGrid,
        alphas: &[usize],
        factor: Option<&[f64]>,
    ) -> Vec<Vec<f64>> {
        let (starts, columns) = (self.rotated_starts(work.columns), 2 * work.columns);
        for (mu, products) in work.products.chunks_exact(columns * 2 * reach.count).enumerate() {
            let rows = degree_count(self.l_max, mu);
            let rotated = &mut work.rotated[starts[mu]..starts[mu] + columns * rows];
            faer::linalg::matmul::matmul(
                MatMut::from_column_major_slice_mut(rotated, rows, columns),
                Accum::Replace,
                self.pattern(mu, reach).transpose(),
                MatRef::from_column_major_slice(products, 2 * reach.count, columns),
                1.0,
                Par::Seq,
            );
        }
        let firsts = (0..work.columns).step_by(ALPHAS);
        firsts.map(|first| self.rotate_back(work, circle, alphas, first, factor)).collect()
    }

    /// Applies the transpose of [`Operator::rotate`], and multiplies each order m by its factor.
    fn rotate_back(
        &self,
        work: &Workspace,
        circle: AngleGrid,
        alphas: &[usize],
        first: usize,
        factor: Option<&[f64]>,
    ) -> Vec<f64> {
        let starts = self.rotated_starts(work.columns);
        let count = alphas.len();
        let phases = self.phases(circle, alphas);
        let mut sum = Alm::zeros(self.l_max);
        let mut column = vec![0.0_f32; order_count(self.l_max) * ALPHAS];
        let mut z = [vec![0.0_f32; (self.l_max + 1) * ALPHAS], vec![0.0_f32; (self.l_max + 1) * ALPHAS]];
        for l in 0..=self.l_max {
            let (plus, minus) = self.rotation.degree(l);
            for (part, d) in [plus, minus].into_iter().enumerate() {
                let column = &mut column[..order_count(l) * count];
                for (k, column) in column.chunks_exact_mut(order_count(l)).enumerate() {
                    for (index, value) in column.iter_mut().enumerate() {
                        let mu = l % 2 + 2 * index;
                        let rows = degree_count(self.l_max, mu);
                        *value = work.rotated
                            [starts[mu] + (part * work.columns + first + k) * rows + (l - mu) / 2];
                    }
                }
                faer::linalg::matmul::matmul(
                    MatMut::from_column_major_slice_mut(&mut z[part][..(l + 1) * count], l + 1, count),
                    Accum::Replace,
                    MatRef::from_row_major_slice(d, order_count(l), l + 1).transpose(),
                    MatRef::from_column_major_slice(column, order_count(l), count),
                    1.0,
                    Par::Seq,
                );
            }
            for m in 0..=l {
                let mut total = Complex64::ZERO;
                for (k, (sin, cos)) in phases[m * count..(m + 1) * count].iter().enumerate() {
                    let z = [&z[0], &z[1]].map(|z| f64::from(z[k * (l + 1) + m]));
                    // conj(z exp(i m alpha))
                    total += Complex64::new(z[0] * cos - z[1] * sin, -(z[0] * sin + z[1] * cos));
                }
                *sum.get_mut(l, m) = total * factor.map_or(1.0, |factor| factor[m]);
            }
        }
        sum.values().iter().flat_map(|value| [value.re, value.im]).collect()
    }
}
