//! Inner loops of the forward operator.
//!
//! For each order mu they interpolate the rotated sky to the alphas of a group, multiply it by the patterns at the nodes of
//! a run, and reduce the products to the run's Chebyshev terms.

use super::blocked::{BlockedPatterns, PATTERN_LANES, PatternLanes};
use super::rotation::{RotatedSky, order_count};

/// Orders mu of one task, which fill a vector of the rotated sky.
pub(crate) const ORDER_LANES: usize = 16;
pub(crate) const ALPHAS_MAX: usize = 6;

/// Part of the interpolation to one alpha: the rotated sky, the index of its first alpha, and the kernel at the following ones.
#[derive(Clone, Debug)]
pub(crate) struct AlphaPart {
    pub(crate) block: usize,
    pub(crate) first: usize,
    pub(crate) weights: Vec<f32>,
}

/// Products at one block of nodes: real and imaginary part for each alpha.
type Products = [[f32; PATTERN_LANES]; 2 * ALPHAS_MAX];

/// Runs that share alphas.
#[derive(Clone, Debug)]
pub(crate) struct RunGroup {
    /// Interpolation to each alpha, in one or two parts.
    pub(crate) alphas: Vec<Vec<AlphaPart>>,
    pub(crate) runs: Vec<usize>,
    /// Blocks of nodes that the runs need, in order.
    pub(crate) blocks: Vec<usize>,
}

/// Weights that reduce products at alphas and nodes to the Chebyshev coefficients of a run.
#[derive(Clone, Debug)]
pub(crate) struct RunPlan {
    pub(crate) first_block: usize,
    pub(crate) blocks: usize,
    pub(crate) terms: usize,
    /// `[term][block][alpha]`: a weight for each lane of the pattern vector.
    pub(crate) weights: Vec<[f32; PATTERN_LANES]>,
}

/// Orders of a task: mu = parity + 2 (first + lane).
#[derive(Clone, Copy, Debug)]
pub(crate) struct OrderBlock {
    pub(crate) parity: usize,
    pub(crate) first: usize,
}

impl OrderBlock {
    /// The order of a lane.
    pub(crate) fn order(self, lane: usize) -> usize {
        self.parity + 2 * (self.first + lane)
    }
}

/// Inputs of [`project`], shared by all tasks.
pub(crate) struct Projection<'a> {
    pub(crate) l_max: usize,
    /// Rotated skies, indexed by [`AlphaPart::block`].
    pub(crate) skies: &'a [RotatedSky<f32>],
    pub(crate) patterns: &'a BlockedPatterns,
    pub(crate) groups: &'a [RunGroup],
    pub(crate) plans: &'a [RunPlan],
    /// Index of each run's first term in the output, and the total number of terms.
    pub(crate) offsets: &'a [usize],
}

/// Computes the Chebyshev coefficients of a block's orders: for each term of each run and each lane `A_mu` (re, im) and
/// `conj(A_{-mu})` (re, im).
pub(crate) fn project(block: OrderBlock, inputs: &Projection<'_>) -> Vec<f32> {
    let Projection { l_max, skies, patterns, groups, plans, offsets } = *inputs;
    let mut out = vec![0.0; 4 * ORDER_LANES * offsets[plans.len()]];
    let rows = (l_max - block.order(0)) / 2 + 1;
    let rotated: Vec<Vec<f32>> = groups.iter().map(|group| interpolate(block, l_max, skies, group)).collect();
    let mut products: Vec<Products> = Vec::new();
    // Order by order, so that the patterns of an order stay in the cache for all runs.
    for lane in 0..ORDER_LANES {
        let mu = block.order(lane);
        if mu > l_max {
            break;
        }
        for (group, rotated) in groups.iter().zip(&rotated) {
            let alphas = group.alphas.len();
            let sky = &rotated[(lane * rows + lane) * 2 * alphas..(lane + 1) * rows * 2 * alphas];
            products.clear();
            products.extend(group.blocks.iter().map(|&nodes| {
                let pattern = patterns.block(mu, nodes);
                match alphas {
                    1 => multiply::<2, 0>(sky, pattern),
                    2 => multiply::<4, 0>(sky, pattern),
                    3 => multiply::<4, 2>(sky, pattern),
                    4 => multiply::<4, 4>(sky, pattern),
                    5 => multiply::<6, 4>(sky, pattern),
                    _ => multiply::<6, 6>(sky, pattern),
                }
            }));
            for &run in &group.runs {
                let plan = &plans[run];
                let place = group.blocks.partition_point(|nodes| *nodes < plan.first_block);
                let products = &products[place..place + plan.blocks];
                reduce(products, alphas, plan, &mut out[4 * (offsets[run] * ORDER_LANES + lane)..]);
            }
        }
    }
    out
}

/// Interpolates the rotated sky to a group's alphas: `[lane][l][alpha][re, im]`, l from the block's first order in steps of 2.
fn interpolate(block: OrderBlock, l_max: usize, skies: &[RotatedSky<f32>], group: &RunGroup) -> Vec<f32> {
    let first_l = block.order(0);
    let rows = (l_max - first_l) / 2 + 1;
    let width = 2 * group.alphas.len();
    let mut out = vec![0.0; ORDER_LANES * rows * width];
    for row in 0..rows {
        let l = first_l + 2 * row;
        let stride = order_count(l);
        let lanes = (stride - block.first).min(ORDER_LANES);
        let parts = group.alphas.iter().enumerate().flat_map(|(a, parts)| parts.iter().map(move |p| (a, p)));
        for (a, alpha) in parts {
            let (re, im) = skies[alpha.block].degree(l);
            for (part, values) in [re, im].into_iter().enumerate() {
                let start = alpha.first * stride + block.first;
                let sums = combine(&values[start..], stride, lanes, &alpha.weights);
                for (lane, sum) in sums.iter().enumerate().take(lanes) {
                    out[(lane * rows + row) * width + 2 * a + part] += *sum;
                }
            }
        }
    }
    out
}

/// Returns `sum_k weights[k] values[k stride + lane]` by lane.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn combine(values: &[f32], stride: usize, lanes: usize, weights: &[f32]) -> [f32; ORDER_LANES] {
    let mut sums = [0.0_f32; ORDER_LANES];
    for (k, w) in weights.iter().enumerate() {
        let row = &values[k * stride..k * stride + lanes];
        if let Ok(row) = <&[f32; ORDER_LANES]>::try_from(row) {
            for (sum, v) in sums.iter_mut().zip(row) {
                *sum = w.mul_add(*v, *sum);
            }
        } else {
            for (sum, v) in sums.iter_mut().zip(row) {
                *sum = w.mul_add(*v, *sum);
            }
        }
    }
    sums
}

/// Returns `sums + factor values`, lane by lane. Sums are passed by value so that they stay in a register.
#[inline(always)]
fn add_scaled(
    sums: [f32; PATTERN_LANES],
    factor: f32,
    values: &[f32; PATTERN_LANES],
) -> [f32; PATTERN_LANES] {
    let mut out = sums;
    for (out, value) in out.iter_mut().zip(values) {
        *out = factor.mul_add(*value, *out);
    }
    out
}

/// Returns `sum_l sky[l][r] pattern[l][lane]` for r < A + B, and 0 for the other r.
///
/// The sums are in two short arrays, because the compiler turns loops over eight sums into gathers and scatters instead
/// of unrolling them.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn multiply<const A: usize, const B: usize>(sky: &[f32], pattern: &[PatternLanes]) -> Products {
    let mut first = [[0.0_f32; PATTERN_LANES]; A];
    let mut second = [[0.0_f32; PATTERN_LANES]; B];
    for (sky, values) in sky.chunks_exact(A + B).zip(pattern) {
        for (sums, factor) in first.iter_mut().zip(sky) {
            *sums = add_scaled(*sums, *factor, &values.0);
        }
        for (sums, factor) in second.iter_mut().zip(&sky[A..]) {
            *sums = add_scaled(*sums, *factor, &values.0);
        }
    }
    let mut out = [[0.0; PATTERN_LANES]; 2 * ALPHAS_MAX];
    out[..A].copy_from_slice(&first);
    out[A..A + B].copy_from_slice(&second);
    out
}

/// Reduces the products to the terms of the run; even lanes hold +mu, odd lanes -mu.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn reduce(products: &[Products], alphas: usize, plan: &RunPlan, out: &mut [f32]) {
    for (term, weights) in plan.weights.chunks_exact(alphas * products.len()).enumerate() {
        let mut sums = [[0.0_f32; PATTERN_LANES]; 2];
        for (products, weights) in products.iter().zip(weights.chunks_exact(alphas)) {
            for (pair, weights) in products.chunks_exact(2).zip(weights) {
                for part in 0..2 {
                    for lane in 0..PATTERN_LANES {
                        sums[part][lane] = weights[lane].mul_add(pair[part][lane], sums[part][lane]);
                    }
                }
            }
        }
        let place = 4 * ORDER_LANES * term;
        for part in 0..2 {
            let mut both = [0.0_f32; 2];
            for pair in sums[part].chunks_exact(2) {
                both[0] += pair[0];
                both[1] += pair[1];
            }
            out[place + part] = both[0];
            out[place + 2 + part] = both[1];
        }
    }
}
