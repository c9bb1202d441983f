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
    let mut turned = Vec::new();
    let count = 2 * patterns.grid.count;
    for group in groups {
        let width = 2 * group.alphas.len();
        let first_l = block.order(0);
        turn(block, l_max, skies, group, &mut turned);
        let rows = (l_max - first_l) / 2 + 1;
        for lane in 0..ORDER_LANES {
            let mu = block.order(lane);
            if mu > l_max {
                break;
            }
            let sky = &turned[(lane * rows + lane) * width..(lane + 1) * rows * width];
            let pattern = patterns.order(mu);
            for &run in &group.runs {
                let plan = &plans[run];
                let from = &pattern[2 * plan.first_node..];
                let products = match group.alphas.len() {
                    1 => products::<2>(sky, from, count),
                    2 => products::<4>(sky, from, count),
                    3 => products::<6>(sky, from, count),
                    4 => products::<8>(sky, from, count),
                    5 => products::<10>(sky, from, count),
                    _ => products::<12>(sky, from, count),
                };
                let place = 4 * (offsets[run] * ORDER_LANES + lane);
                reduce(&products, group.alphas.len(), plan, &mut out[place..]);
            }
        }
    }
    out
}

/// The rotated sky at a group's alphas, `[lane][l][alpha][re, im]`, l from the block's first order in steps of 2.
fn turn(block: OrderBlock, l_max: usize, skies: &[RotatedSky<f32>], group: &Group, out: &mut Vec<f32>) {
    let first_l = block.order(0);
    let rows = (l_max - first_l) / 2 + 1;
    let width = 2 * group.alphas.len();
    out.clear();
    out.resize(ORDER_LANES * rows * width, 0.0);
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

/// `sum_l sky[l][r] pattern[l][lane]`, unused r zero.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn products<const R: usize>(
    sky: &[f32],
    pattern: &[f32],
    stride: usize,
) -> [[f32; PATTERN_LANES]; 2 * ALPHAS_MAX] {
    let mut sums = [[0.0_f32; PATTERN_LANES]; R];
    for (row, sky) in sky.chunks_exact(R).enumerate() {
        let start = row * stride;
        let Ok(sky) = <&[f32; R]>::try_from(sky) else { continue };
        let Ok(values) = <&[f32; PATTERN_LANES]>::try_from(&pattern[start..start + PATTERN_LANES]) else {
            continue;
        };
        for r in 0..R {
            for lane in 0..PATTERN_LANES {
                sums[r][lane] = sky[r].mul_add(values[lane], sums[r][lane]);
            }
        }
    }
    let mut out = [[0.0; PATTERN_LANES]; 2 * ALPHAS_MAX];
    out[..R].copy_from_slice(&sums);
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
