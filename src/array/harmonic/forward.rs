//! The inner loops of the forward operator.
//!
//! For each order mu: the sky turned to a group's alphas, its products with the patterns at a run's nodes,
//! and their reduction to the run's Chebyshev terms.

use super::filter::FilteredPatterns;
use super::rotation::{RotatedSky, orders};

/// Orders mu that one task takes: a vector of the rotated sky.
pub(crate) const ORDER_LANES: usize = 16;
/// A vector of patterns: eight nodes, both signs of mu.
pub(crate) const PATTERN_LANES: usize = 16;
/// Most alphas of a group.
pub(crate) const ALPHAS_MAX: usize = 6;

/// One alpha of a group: which rotated sky, from which of its alphas on, and the kernel there.
#[derive(Clone, Debug)]
pub(crate) struct AlphaNode {
    pub(crate) block: usize,
    pub(crate) first: usize,
    pub(crate) weights: Vec<f32>,
}

/// Runs that share their alphas.
#[derive(Clone, Debug)]
pub(crate) struct Group {
    pub(crate) alphas: Vec<AlphaNode>,
    /// Places of its runs among those of the batch.
    pub(crate) runs: Vec<usize>,
}

/// How a run's Chebyshev coefficients come from products at alphas and nodes.
#[derive(Clone, Debug)]
pub(crate) struct RunPlan {
    pub(crate) first_node: usize,
    pub(crate) terms: usize,
    /// `[term][alpha]`: a weight for each lane of the pattern vector.
    pub(crate) weights: Vec<[f32; PATTERN_LANES]>,
}

/// A task's slice of orders: mu = parity + 2 (first + lane).
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

/// Chebyshev coefficients of a block's orders: for each run, term and lane `A_mu` (re, im) and
/// `conj(A_{-mu})` (re, im); runs start at `offsets`.
pub(crate) fn project(
    block: OrderBlock,
    l_max: usize,
    (skies, patterns): (&[RotatedSky<f32>], &FilteredPatterns),
    (groups, plans): (&[Group], &[RunPlan]),
    offsets: &[usize],
) -> Vec<f32> {
    let mut out = vec![0.0; 4 * ORDER_LANES * offsets[plans.len()]];
    let count = 2 * patterns.grid.count;
    let rows = (l_max - block.order(0)) / 2 + 1;
    let turned: Vec<Vec<f32>> = groups.iter().map(|group| turn(block, l_max, skies, group)).collect();
    // Order by order: the patterns of one stay in the cache while all runs pass.
    for lane in 0..ORDER_LANES {
        let mu = block.order(lane);
        if mu > l_max {
            break;
        }
        let pattern = patterns.order(mu);
        for (group, turned) in groups.iter().zip(&turned) {
            let alphas = group.alphas.len();
            let sky = &turned[(lane * rows + lane) * 2 * alphas..(lane + 1) * rows * 2 * alphas];
            for &run in &group.runs {
                let plan = &plans[run];
                let from = &pattern[2 * plan.first_node..];
                let products = match alphas {
                    1 => products::<2, 0>(sky, from, count),
                    2 => products::<4, 0>(sky, from, count),
                    3 => products::<4, 2>(sky, from, count),
                    4 => products::<4, 4>(sky, from, count),
                    5 => products::<6, 4>(sky, from, count),
                    _ => products::<6, 6>(sky, from, count),
                };
                let place = 4 * (offsets[run] * ORDER_LANES + lane);
                reduce(&products, alphas, plan, &mut out[place..]);
            }
        }
    }
    out
}

/// The rotated sky at a group's alphas, `[lane][l][alpha][re, im]`, l from the block's first order in steps of 2.
fn turn(block: OrderBlock, l_max: usize, skies: &[RotatedSky<f32>], group: &Group) -> Vec<f32> {
    let first_l = block.order(0);
    let rows = (l_max - first_l) / 2 + 1;
    let width = 2 * group.alphas.len();
    let mut out = vec![0.0; ORDER_LANES * rows * width];
    for row in 0..rows {
        let l = first_l + 2 * row;
        let stride = orders(l);
        let lanes = (stride - block.first).min(ORDER_LANES);
        for (a, alpha) in group.alphas.iter().enumerate() {
            let (re, im) = skies[alpha.block].degree(l);
            for (part, values) in [re, im].into_iter().enumerate() {
                let start = alpha.first * stride + block.first;
                let sums = combine(&values[start..], stride, lanes, &alpha.weights);
                for (lane, sum) in sums.iter().enumerate().take(lanes) {
                    out[(lane * rows + row) * width + 2 * a + part] = *sum;
                }
            }
        }
    }
    out
}

/// `sum_k weights[k] values[k stride + lane]`.
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

/// `sums + factor values`, lane by lane; by value, so that the sums stay in a register.
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

/// `sum_l sky[l][r] pattern[l][lane]` for r < A + B, the rest zero.
///
/// Two short arrays instead of a long one: loops over eight sums are turned into gathers and scatters
/// instead of being unrolled.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn products<const A: usize, const B: usize>(
    sky: &[f32],
    pattern: &[f32],
    stride: usize,
) -> [[f32; PATTERN_LANES]; 2 * ALPHAS_MAX] {
    let mut first = [[0.0_f32; PATTERN_LANES]; A];
    let mut second = [[0.0_f32; PATTERN_LANES]; B];
    for (row, sky) in sky.chunks_exact(A + B).enumerate() {
        let start = row * stride;
        let Ok(values) = <&[f32; PATTERN_LANES]>::try_from(&pattern[start..start + PATTERN_LANES]) else {
            continue;
        };
        for (sums, factor) in first.iter_mut().zip(sky) {
            *sums = add_scaled(*sums, *factor, values);
        }
        for (sums, factor) in second.iter_mut().zip(&sky[A..]) {
            *sums = add_scaled(*sums, *factor, values);
        }
    }
    let mut out = [[0.0; PATTERN_LANES]; 2 * ALPHAS_MAX];
    out[..A].copy_from_slice(&first);
    out[A..A + B].copy_from_slice(&second);
    out
}

/// Sums the products into the run's terms; even lanes are +mu, odd ones -mu.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn reduce(products: &[[f32; PATTERN_LANES]; 2 * ALPHAS_MAX], alphas: usize, plan: &RunPlan, out: &mut [f32]) {
    for (term, weights) in plan.weights.chunks_exact(alphas).enumerate() {
        let mut sums = [[0.0_f32; PATTERN_LANES]; 2];
        for (pair, weights) in products.chunks_exact(2).zip(weights) {
            for part in 0..2 {
                for lane in 0..PATTERN_LANES {
                    sums[part][lane] = weights[lane].mul_add(pair[part][lane], sums[part][lane]);
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
