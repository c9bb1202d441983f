//! BtN^-1B as an operator on harmonic coefficients, and the projection of data onto them.
//!
//! For a block of alphas: the sky turned into the orbit's plane (products with d), its products with the
//! patterns at all nodes, transforms from mu to gamma; there the weights multiply, pointwise; and back.

use std::sync::Arc;

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::{Complex32, Complex64};
use rayon::prelude::*;
use rustfft::{Fft, FftPlanner};

use super::grid::{Grids, NODE_GROUP, NODES};
use super::tori::{Node, Tori};
use crate::response::harmonic::filter::FilteredPatterns;
use crate::response::harmonic::rotation::{RotationTable, orders};
use crate::response::harmonic::{PatternGeometry, PatternTable, degrees};
use crate::sky::harmonics::Alm;

/// Alphas of a block: columns of its matrix products, halved.
const ALPHAS: usize = 16;

/// Tables, and what is worked on at once.
#[derive(Debug)]
pub(super) struct Operator {
    l_max: usize,
    grids: Grids,
    rotation: RotationTable<f32>,
    pub(super) patterns: FilteredPatterns,
    /// One over the transform of the data's kernel at the orders 0 ..= l_max.
    correction: Vec<f64>,
}

/// One direction of transforms and their scratch.
struct Transforms {
    forward: Arc<dyn Fft<f32>>,
    inverse: Arc<dyn Fft<f32>>,
    scratch: Vec<Complex32>,
}

/// What a thread works in.
struct Workspace {
    /// By mu: the turned sky, `[re of alphas, im of alphas][l]`.
    turned: Vec<f32>,
    /// By mu: `[re of alphas, im of alphas][node][mu, -mu]`.
    products: Vec<f32>,
    /// Two groups of nodes on the grid in gamma.
    ring: Vec<Vec<Complex32>>,
    /// A group of nodes on its way back.
    group: Vec<Vec<Complex32>>,
    transforms: Transforms,
}

/// Nodes in whole groups that hold all sums.
#[derive(Clone, Copy)]
struct Reach {
    first: usize,
    count: usize,
}

/// Which grid: of weights or of data.
#[derive(Clone, Copy)]
struct Circle {
    points: usize,
}

impl Circle {
    fn turn(self, index: usize) -> (f64, f64) {
        (std::f64::consts::TAU * (index % self.points) as f64 / self.points as f64).sin_cos()
    }
}

impl Operator {
    pub(super) fn new(
        l_max: usize,
        grids: Grids,
        (geometry, inclination_rad): (PatternGeometry, f64),
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
        let patterns: usize = (0..=l_max).map(|mu| 2 * grids.table_nodes().count * degrees(l_max, mu)).sum();
        let rotation: usize = (0..=l_max).map(|l| 2 * orders(l) * (l + 1)).sum();
        // The patterns are filtered from a table of the same size.
        (4 * (2 * patterns + rotation)) as u64
    }

    /// Bytes that one thread works in.
    pub(super) fn workspace_bytes(l_max: usize, grids: &Grids) -> u64 {
        (4 * (l_max + 1) * 2 * ALPHAS * (2 * grids.nodes.count + l_max / 4)) as u64
    }

    /// Operations of the products with patterns and rotations in one application.
    pub(super) fn matrix_product_flops(&self, tori: &Tori) -> f64 {
        let reach = self.reach(tori);
        let used = tori.alphas(self.grids.points, |node| &node.weights);
        let alphas = used.iter().filter(|used| **used).count().next_multiple_of(ALPHAS);
        let patterns: usize = (0..=self.l_max).map(|mu| 2 * reach.count * degrees(self.l_max, mu)).sum();
        let rotations: usize = (0..=self.l_max).map(|l| orders(l) * (l + 1)).sum();
        // Forth and back, real and imaginary parts, multiplications and additions.
        (2 * 2 * 2 * alphas * (patterns + rotations)) as f64
    }

    fn reach(&self, tori: &Tori) -> Reach {
        let reached = tori.reached();
        let first = reached.start / NODE_GROUP * NODE_GROUP;
        Reach { first, count: (reached.end - first).next_multiple_of(NODE_GROUP) }
    }

    /// BtN^-1B of the coefficients `sky`, the gradient in terms of real and imaginary parts for m >= 0.
    pub(super) fn apply(&self, tori: &Tori, sky: &Alm) -> Alm {
        let reach = self.reach(tori);
        let circle = Circle { points: self.grids.points };
        let used = tori.alphas(circle.points, |node| &node.weights);
        self.over_blocks(&used, circle.points, reach, |work, alphas| {
            self.turn(sky, circle, alphas, &mut work.turned);
            self.multiply_patterns(work, reach);
            for (place, &alpha) in alphas.iter().enumerate() {
                self.multiply_weights(tori, (alpha, place), work, reach);
            }
            self.gradient(work, reach, circle, (alphas, None))
        })
    }

    /// BtN^-1 times the data (`side` 0) or the companion's noise (`side` 1).
    pub(super) fn project(&self, tori: &Tori, side: usize) -> Alm {
        let reach = self.reach(tori);
        let circle = Circle { points: self.grids.data_points() };
        let used = tori.alphas(circle.points, |node| &node.sides);
        self.over_blocks(&used, circle.points, reach, |work, alphas| {
            work.products.fill(0.0);
            for (place, &alpha) in alphas.iter().enumerate() {
                for group in (0..reach.count).step_by(NODE_GROUP) {
                    for (k, line) in work.group.iter_mut().enumerate() {
                        let node = tori.nodes.get(reach.first + group + k).and_then(Option::as_ref);
                        self.read_side(node, (alpha, side), line);
                        work.transforms.inverse(line);
                        for (mu, factor) in self.correction.iter().enumerate() {
                            line[mu] *= *factor as f32;
                            if mu > 0 {
                                line[circle.points - mu] *= *factor as f32;
                            }
                        }
                    }
                    self.scatter(&work.group, place, (group, reach), &mut work.products);
                }
            }
            self.gradient(work, reach, circle, (alphas, Some(&self.correction)))
        })
    }

    /// Sums `block` over blocks of the alphas in use; the order of the sum does not depend on threads.
    fn over_blocks(
        &self,
        used: &[bool],
        points: usize,
        reach: Reach,
        block: impl Fn(&mut Workspace, &[usize]) -> Vec<Complex64> + Sync,
    ) -> Alm {
        let alphas: Vec<usize> = (0..points).filter(|&alpha| used[alpha]).collect();
        let blocks: Vec<&[usize]> = alphas.chunks(ALPHAS).collect();
        let parts: Vec<Vec<Complex64>> = blocks
            .into_par_iter()
            .map_init(|| self.workspace(points, reach), |work, alphas| block(work, alphas))
            .collect();
        let mut sum = Alm::zeros(self.l_max);
        for part in parts {
            sum.values_mut().iter_mut().zip(part).for_each(|(sum, term)| *sum += term);
        }
        sum
    }

    fn workspace(&self, points: usize, reach: Reach) -> Workspace {
        let mut planner = FftPlanner::new();
        let (forward, inverse) = (planner.plan_fft_forward(points), planner.plan_fft_inverse(points));
        let scratch = forward.get_inplace_scratch_len().max(inverse.get_inplace_scratch_len());
        let line = || vec![Complex32::ZERO; points];
        let turned: usize = (0..=self.l_max).map(|mu| degrees(self.l_max, mu)).sum();
        Workspace {
            turned: vec![0.0; 2 * ALPHAS * turned],
            products: vec![0.0; (self.l_max + 1) * 2 * ALPHAS * 2 * reach.count],
            ring: (0..2 * NODE_GROUP).map(|_| line()).collect(),
            group: (0..NODE_GROUP).map(|_| line()).collect(),
            transforms: Transforms { forward, inverse, scratch: vec![Complex32::ZERO; scratch] },
        }
    }

    /// Where order mu of the turned sky starts.
    fn turned_start(&self, mu: usize) -> usize {
        (0..mu).map(|mu| 2 * ALPHAS * degrees(self.l_max, mu)).sum()
    }

    /// The sky in the plane of the orbit at each alpha: `t_{l mu} = sum_m d+ Re z + i d- Im z`,
    /// `z = conj(T_lm) exp(-i m alpha)`.
    fn turn(&self, sky: &Alm, circle: Circle, alphas: &[usize], turned: &mut [f32]) {
        turned.fill(0.0);
        let starts: Vec<usize> = (0..=self.l_max).map(|mu| self.turned_start(mu)).collect();
        let count = alphas.len();
        let turns = self.turns(circle, alphas);
        let mut z = [vec![0.0_f32; (self.l_max + 1) * ALPHAS], vec![0.0_f32; (self.l_max + 1) * ALPHAS]];
        let mut out = vec![0.0_f32; 2 * orders(self.l_max) * ALPHAS];
        for l in 0..=self.l_max {
            let [re, im] = &mut z;
            let out = &mut out[..2 * orders(l) * count];
            self.rotation.rotate_degree(l, |m| sky.get(l, m).conj(), &turns, [re, im], out);
            for (part, out) in out.chunks_exact(orders(l) * count).enumerate() {
                for (k, column) in out.chunks_exact(orders(l)).enumerate() {
                    for (order, value) in column.iter().enumerate() {
                        let mu = l % 2 + 2 * order;
                        let rows = degrees(self.l_max, mu);
                        turned[starts[mu] + (part * ALPHAS + k) * rows + (l - mu) / 2] = *value;
                    }
                }
            }
        }
    }

    /// Sine and cosine of m alpha: `[m][alpha]`.
    fn turns(&self, circle: Circle, alphas: &[usize]) -> Vec<(f64, f64)> {
        (0..=self.l_max).flat_map(|m| alphas.iter().map(move |alpha| circle.turn(m * alpha))).collect()
    }

    fn pattern(&self, mu: usize, reach: Reach) -> MatRef<'_, f32> {
        let stride = 2 * self.patterns.grid.count;
        let rows = &self.patterns.order(mu)[2 * reach.first..];
        MatRef::from_column_major_slice_with_stride(rows, 2 * reach.count, degrees(self.l_max, mu), stride)
    }

    /// The turned sky times the patterns of every node.
    fn multiply_patterns(&self, work: &mut Workspace, reach: Reach) {
        let len = 2 * ALPHAS * 2 * reach.count;
        for (mu, products) in work.products.chunks_exact_mut(len).enumerate() {
            let (start, rows) = (self.turned_start(mu), degrees(self.l_max, mu));
            let turned = &work.turned[start..start + 2 * ALPHAS * rows];
            faer::linalg::matmul::matmul(
                MatMut::from_column_major_slice_mut(products, 2 * reach.count, 2 * ALPHAS),
                Accum::Replace,
                self.pattern(mu, reach),
                MatRef::from_column_major_slice(turned, rows, 2 * ALPHAS),
                1.0,
                Par::Seq,
            );
        }
    }

    /// For one alpha: from orders mu to gamma, times the weights of neighbouring nodes, and back.
    fn multiply_weights(
        &self,
        tori: &Tori,
        (alpha, place): (usize, usize),
        work: &mut Workspace,
        reach: Reach,
    ) {
        const BEHIND: usize = NODES - 1;
        let row = NODES * self.grids.weight_stride();
        let rows = |node: usize| {
            let weights = &tori.nodes.get(node)?.as_ref()?.weights;
            Some(&weights[alpha * row..(alpha + 1) * row])
        };
        work.ring.iter_mut().for_each(|line| line.fill(Complex32::ZERO));
        // Nodes come in groups, and leave in groups that lag behind by as many as weights reach.
        for group in (0..reach.count + NODE_GROUP).step_by(NODE_GROUP) {
            let half = group % (2 * NODE_GROUP);
            let lines = &mut work.ring[half..half + NODE_GROUP];
            if group < reach.count {
                self.gather(&work.products, place, (group, reach), lines);
                lines.iter_mut().for_each(|line| work.transforms.forward(line));
            } else {
                lines.iter_mut().for_each(|line| line.fill(Complex32::ZERO));
            }
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
            self.scatter_behind(work, place, (group, reach));
        }
    }

    /// A group of nodes from the products, onto the circle of orders.
    fn gather(
        &self,
        products: &[f32],
        place: usize,
        (group, reach): (usize, Reach),
        lines: &mut [Vec<Complex32>],
    ) {
        let points = lines[0].len();
        let column = 2 * reach.count;
        for line in lines.iter_mut() {
            line[self.l_max + 1..points - self.l_max].fill(Complex32::ZERO);
        }
        for (mu, products) in products.chunks_exact(2 * ALPHAS * column).enumerate() {
            let re = &products[place * column + 2 * group..][..2 * NODE_GROUP];
            let im = &products[(ALPHAS + place) * column + 2 * group..][..2 * NODE_GROUP];
            for (k, line) in lines.iter_mut().enumerate() {
                line[mu] = Complex32::new(re[2 * k], im[2 * k]);
                if mu > 0 {
                    line[points - mu] = Complex32::new(re[2 * k + 1], -im[2 * k + 1]);
                }
            }
        }
    }

    /// The group that lags behind `group`, back into the products.
    fn scatter_behind(&self, work: &mut Workspace, place: usize, (group, reach): (usize, Reach)) {
        const BEHIND: usize = NODES - 1;
        let column = 2 * reach.count;
        let points = work.group[0].len();
        let skipped = BEHIND.saturating_sub(group);
        let first = (group + skipped) - BEHIND;
        let lines = &work.group[skipped..];
        let count = lines.len().min(reach.count.saturating_sub(first));
        for (mu, products) in work.products.chunks_exact_mut(2 * ALPHAS * column).enumerate() {
            for (k, line) in lines[..count].iter().enumerate() {
                put(products, (place, column), first + k, (line, mu, points));
            }
        }
    }

    /// A group of nodes back into the products.
    fn scatter(
        &self,
        lines: &[Vec<Complex32>],
        place: usize,
        (group, reach): (usize, Reach),
        products: &mut [f32],
    ) {
        let column = 2 * reach.count;
        let points = lines[0].len();
        for (mu, products) in products.chunks_exact_mut(2 * ALPHAS * column).enumerate() {
            for (k, line) in lines.iter().enumerate() {
                put(products, (place, column), group + k, (line, mu, points));
            }
        }
    }

    /// A node's data at one alpha.
    fn read_side(&self, node: Option<&Node>, (alpha, side): (usize, usize), line: &mut [Complex32]) {
        let stride = self.grids.data_stride();
        let Some(node) = node else {
            line.fill(Complex32::ZERO);
            return;
        };
        let rows = &node.sides[(alpha * 4 + 2 * side) * stride..];
        let (re, im) = rows[..2 * stride].split_at(stride);
        for ((out, re), im) in line.iter_mut().zip(re).zip(im) {
            *out = Complex32::new(*re, *im);
        }
    }

    /// Products with the patterns, transposed, turned back from the orbit's plane and summed over alpha.
    fn gradient(
        &self,
        work: &mut Workspace,
        reach: Reach,
        circle: Circle,
        (alphas, factor): (&[usize], Option<&[f64]>),
    ) -> Vec<Complex64> {
        let len = 2 * ALPHAS * 2 * reach.count;
        for (mu, products) in work.products.chunks_exact(len).enumerate() {
            let (start, rows) = (self.turned_start(mu), degrees(self.l_max, mu));
            let turned = &mut work.turned[start..start + 2 * ALPHAS * rows];
            faer::linalg::matmul::matmul(
                MatMut::from_column_major_slice_mut(turned, rows, 2 * ALPHAS),
                Accum::Replace,
                self.pattern(mu, reach).transpose(),
                MatRef::from_column_major_slice(products, 2 * reach.count, 2 * ALPHAS),
                1.0,
                Par::Seq,
            );
        }
        self.turn_back(&work.turned, circle, alphas, factor)
    }

    /// The transpose of [`Operator::turn`], each order m times its factor.
    fn turn_back(
        &self,
        turned: &[f32],
        circle: Circle,
        alphas: &[usize],
        factor: Option<&[f64]>,
    ) -> Vec<Complex64> {
        let starts: Vec<usize> = (0..=self.l_max).map(|mu| self.turned_start(mu)).collect();
        let count = alphas.len();
        let turns = self.turns(circle, alphas);
        let mut sum = Alm::zeros(self.l_max);
        let mut column = vec![0.0_f32; orders(self.l_max) * ALPHAS];
        let mut z = [vec![0.0_f32; (self.l_max + 1) * ALPHAS], vec![0.0_f32; (self.l_max + 1) * ALPHAS]];
        for l in 0..=self.l_max {
            let (plus, minus) = self.rotation.degree(l);
            for (part, d) in [plus, minus].into_iter().enumerate() {
                let column = &mut column[..orders(l) * count];
                for (k, column) in column.chunks_exact_mut(orders(l)).enumerate() {
                    for (order, value) in column.iter_mut().enumerate() {
                        let mu = l % 2 + 2 * order;
                        let rows = degrees(self.l_max, mu);
                        *value = turned[starts[mu] + (part * ALPHAS + k) * rows + (l - mu) / 2];
                    }
                }
                faer::linalg::matmul::matmul(
                    MatMut::from_column_major_slice_mut(&mut z[part][..(l + 1) * count], l + 1, count),
                    Accum::Replace,
                    MatRef::from_row_major_slice(d, orders(l), l + 1).transpose(),
                    MatRef::from_column_major_slice(column, orders(l), count),
                    1.0,
                    Par::Seq,
                );
            }
            for m in 0..=l {
                let mut total = Complex64::ZERO;
                for (k, (sin, cos)) in turns[m * count..(m + 1) * count].iter().enumerate() {
                    let z = [&z[0], &z[1]].map(|z| f64::from(z[k * (l + 1) + m]));
                    // conj(z exp(i m alpha))
                    total += Complex64::new(z[0] * cos - z[1] * sin, -(z[0] * sin + z[1] * cos));
                }
                *sum.get_mut(l, m) = total * factor.map_or(1.0, |factor| factor[m]);
            }
        }
        sum.values().to_vec()
    }
}

impl Transforms {
    fn forward(&mut self, line: &mut [Complex32]) {
        self.forward.process_with_scratch(line, &mut self.scratch);
    }

    fn inverse(&mut self, line: &mut [Complex32]) {
        self.inverse.process_with_scratch(line, &mut self.scratch);
    }
}

/// Orders mu and -mu of a node, the second conjugated, into their place among the products.
#[inline(always)]
fn put(
    products: &mut [f32],
    (place, column): (usize, usize),
    node: usize,
    (line, mu, points): (&[Complex32], usize, usize),
) {
    let minus = if mu > 0 { line[points - mu] } else { Complex32::ZERO };
    let re = place * column + 2 * node;
    let im = (ALPHAS + place) * column + 2 * node;
    products[re] = line[mu].re;
    products[re + 1] = minus.re;
    products[im] = line[mu].im;
    products[im + 1] = -minus.im;
}

/// Terms of one node's product: its own weights with itself and those above, theirs with those below.
const TERMS: usize = 2 * NODES - 1;

/// `line = sum_d W_d z_{+d} + sum_{d > 0} W'_d z_{-d}`, where `rows[d]` are the weights of the node d below: its
/// diagonal d couples it to this one, and `rows[0]` couples this one to those above.
fn multiply_line<'a>(
    line: &mut [Complex32],
    rows: &[Option<&'a [f32]>; NODES],
    stride: usize,
    z: impl Fn(isize) -> &'a [Complex32],
) {
    let mut terms: [(&[f32], &[Complex32]); TERMS] = [(&[], &[]); TERMS];
    let mut count = 0;
    let points = line.len();
    for d in 0..NODES {
        if let Some(own) = rows[0] {
            terms[count] = (&own[d * stride..d * stride + points], z(d as isize));
            count += 1;
        }
        if d > 0
            && let Some(below) = rows[d]
        {
            terms[count] = (&below[d * stride..d * stride + points], z(-(d as isize)));
            count += 1;
        }
    }
    sum_products(line, &terms[..count]);
}

/// Points that are summed over all terms in registers.
const CHUNK: usize = 16;

#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn sum_products(line: &mut [Complex32], terms: &[(&[f32], &[Complex32])]) {
    let (chunks, rest) = line.as_chunks_mut::<CHUNK>();
    let tail = chunks.len() * CHUNK;
    for (k, out) in chunks.iter_mut().enumerate() {
        let mut sums = [Complex32::ZERO; CHUNK];
        for (weights, z) in terms {
            let (Some(weights), Some(z)) =
                (weights.as_chunks::<CHUNK>().0.get(k), z.as_chunks::<CHUNK>().0.get(k))
            else {
                continue;
            };
            for ((sum, w), z) in sums.iter_mut().zip(weights).zip(z) {
                sum.re += w * z.re;
                sum.im += w * z.im;
            }
        }
        *out = sums;
    }
    for (k, out) in rest.iter_mut().enumerate() {
        *out = terms.iter().map(|(weights, z)| z[tail + k] * weights[tail + k]).sum();
    }
}
