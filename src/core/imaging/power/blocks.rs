//! A block-diagonal normal matrix, or the block-diagonal approximation of one that it preconditions.

use std::borrow::Cow;
use std::collections::HashMap;

use faer::linalg::solvers::{DenseSolveCore, Llt, Solve};
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Mat, Par, Side};
use rayon::prelude::*;

use super::knots::Knots;

/// A block of the matrix: unknowns that are coupled only with one another.
#[derive(Clone, Debug)]
pub(in crate::imaging) struct Block<'a> {
    /// Elements of BtN^-1B.
    pub(in crate::imaging) matrix: Cow<'a, Mat<f64>>,
    /// The degree of each row.
    pub(in crate::imaging) degrees: Vec<usize>,
    /// Indices of the unknowns of the rows; one list for each set of unknowns with the same matrix.
    pub(in crate::imaging) places: Vec<Vec<usize>>,
}

/// The posterior of a block's unknowns.
pub(in crate::imaging) struct BlockPosterior {
    pub(in crate::imaging) mean: Mat<f64>,
    pub(in crate::imaging) covariance: Mat<f64>,
}

/// The log evidence of a power, and its derivatives.
pub(super) struct Evidence {
    /// `1/2 b.(A + R)^-1 b + 1/2 ln det R - 1/2 ln det(A + R)`.
    pub(super) value: f64,
    /// Gradient with respect to ln C_l, by degree.
    pub(super) gradient: Vec<f64>,
    /// Fisher information on the parameters.
    pub(super) fisher: Mat<f64>,
}

/// Elements of the matrix that couple unknowns of different blocks.
#[derive(Clone, Debug)]
pub(in crate::imaging) struct Coupling {
    /// Highest degree of the coupled unknowns.
    pub(in crate::imaging) degree_max: usize,
    /// Indices of the unknowns, with all parts of a row of a block or none.
    pub(in crate::imaging) places: Vec<usize>,
    /// What the blocks lack, in this order.
    pub(in crate::imaging) matrix: Mat<f64>,
}

/// Cholesky factors of the blocks plus R; `None` for a block that is not positive definite.
pub(in crate::imaging) struct Factors<'a> {
    blocks: &'a [Block<'a>],
    /// The order in which the rows of each block are eliminated.
    orders: Vec<Vec<usize>>,
    factors: Vec<Option<Llt<f64>>>,
    coupled: Option<Coupled>,
}

/// Least pivot of the coupling's factor, below which rounding may be all of it; of blocks it is 1.
const LEAST_PIVOT: f64 = 1e-4;

/// The factor of the coupling: with L of the blocks the whole is `L Q L'`, where Q is the identity but for the coupled unknowns.
struct Coupled {
    places: Vec<usize>,
    factor: Llt<f64>,
}

impl Coupling {
    /// The same with other unknowns first: in order of decreasing degree, so that samples of the lowest degrees resemble those of the blocks.
    fn by_degree(&self, blocks: &[Block<'_>]) -> Self {
        let of_block = |block: &Block<'_>| {
            let degrees = block.degrees.clone();
            let pairs = |places: &Vec<usize>| places.iter().copied().zip(degrees.clone()).collect::<Vec<_>>();
            block.places.iter().flat_map(pairs).collect::<Vec<_>>()
        };
        let degree_of: HashMap<usize, usize> = blocks.iter().flat_map(of_block).collect();
        let mut order: Vec<usize> = (0..self.places.len()).collect();
        order.sort_by_key(|k| std::cmp::Reverse(degree_of.get(&self.places[*k])));
        let matrix = Mat::from_fn(order.len(), order.len(), |i, j| self.matrix[(order[i], order[j])]);
        Self { degree_max: self.degree_max, places: order.iter().map(|k| self.places[*k]).collect(), matrix }
    }
}

impl Block<'_> {
    fn order(&self) -> usize {
        self.degrees.len()
    }

    fn factor(&self, r: &[f64]) -> Option<Llt<f64>> {
        let mut matrix = Mat::clone(&self.matrix);
        for (k, l) in self.degrees.iter().enumerate() {
            matrix[(k, k)] += r[*l];
        }
        matrix.llt(Side::Lower).ok()
    }

    /// The block with its rows in another order, without its places.
    fn in_order(&self, order: &[usize]) -> Block<'static> {
        let matrix = Mat::from_fn(order.len(), order.len(), |i, j| self.matrix[(order[i], order[j])]);
        let degrees = order.iter().map(|k| self.degrees[*k]).collect();
        Block { matrix: Cow::Owned(matrix), degrees, places: Vec::new() }
    }

    /// Mean, by row and part, and covariance of the unknowns for a right-hand side; `None` if the block is not positive definite.
    pub(in crate::imaging) fn posterior(&self, r: &[f64], right: &[f64]) -> Option<BlockPosterior> {
        let factor = self.factor(r)?;
        Some(BlockPosterior { mean: factor.solve(&self.gather(right)), covariance: factor.inverse() })
    }

    fn gather(&self, unknowns: &[f64]) -> Mat<f64> {
        Mat::from_fn(self.order(), self.places.len(), |k, part| unknowns[self.places[part][k]])
    }

    /// The block's log evidence.
    fn value(&self, factor: &Llt<f64>, r: &[f64], right: &Mat<f64>, solved: &Mat<f64>) -> f64 {
        let half_logarithms: f64 =
            self.degrees.iter().enumerate().map(|(k, l)| 0.5 * r[*l].ln() - factor.L()[(k, k)].ln()).sum();
        let mut product = 0.0;
        for part in 0..right.ncols() {
            for k in 0..right.nrows() {
                product += right[(k, part)] * solved[(k, part)];
            }
        }
        0.5 * product + self.places.len() as f64 * half_logarithms
    }
}

fn regularisation(power: &[f64]) -> Vec<f64> {
    power.iter().map(|power| power.recip()).collect()
}

/// The log evidence; `None` if a block is not positive definite.
pub(in crate::imaging) fn log_evidence(blocks: &[Block<'_>], power: &[f64], right: &[f64]) -> Option<f64> {
    let r = regularisation(power);
    let block_value = |block: &Block<'_>| {
        let factor = block.factor(&r)?;
        let right = block.gather(right);
        let solved = factor.solve(&right);
        Some(block.value(&factor, &r, &right, &solved))
    };
    let values: Vec<Option<f64>> = blocks.par_iter().map(block_value).collect();
    values.into_iter().sum::<Option<f64>>().filter(|value| value.is_finite())
}

/// The log evidence, gradient and Fisher information of one block.
type BlockEvidence = (f64, Vec<f64>, Mat<f64>);

/// The log evidence with its derivatives; `None` if a block is not positive definite.
pub(super) fn evidence(
    blocks: &[Block<'_>],
    knots: &Knots,
    power: &[f64],
    right: &[f64],
) -> Option<Evidence> {
    let r = regularisation(power);
    let parts: Vec<Option<BlockEvidence>> =
        blocks.par_iter().map(|block| block_evidence(block, knots, &r, right)).collect();
    let mut sum = Evidence {
        value: 0.0,
        gradient: vec![0.0; power.len()],
        fisher: Mat::zeros(knots.count(), knots.count()),
    };
    for (block, part) in blocks.iter().zip(parts) {
        let (value, gradient, fisher) = part?;
        sum.value += value;
        block.degrees.iter().zip(gradient).for_each(|(l, term)| sum.gradient[*l] += term);
        sum.fisher += fisher;
    }
    sum.value.is_finite().then_some(sum)
}

fn block_evidence(block: &Block<'_>, knots: &Knots, r: &[f64], right: &[f64]) -> Option<BlockEvidence> {
    let factor = block.factor(r)?;
    let right = block.gather(right);
    let solved = factor.solve(&right);
    let value = block.value(&factor, r, &right, &solved);
    let inverse = factor.inverse();
    let (order, copies) = (block.order(), block.places.len() as f64);
    let r_at: Vec<f64> = block.degrees.iter().map(|l| r[*l]).collect();
    let gradient: Vec<f64> = (0..order)
        .map(|k| {
            let square: f64 = (0..solved.ncols()).map(|part| solved[(k, part)].powi(2)).sum();
            0.5 * (r_at[k] * square - copies * (1.0 - r_at[k] * inverse[(k, k)]))
        })
        .collect();
    // With G = 1 - R^(1/2) (A + R)^-1 R^(1/2), the information on ln C_l and ln C_l' is half the sum of squares of G.
    let weights: Vec<[(usize, f64); 2]> = block.degrees.iter().map(|l| knots.weights(*l)).collect();
    let roots: Vec<f64> = r_at.iter().map(|r| r.sqrt()).collect();
    let mut half = Mat::<f64>::zeros(order, knots.count());
    for j in 0..order {
        for (knot, share) in weights[j].into_iter().filter(|(_, share)| *share != 0.0) {
            for i in 0..order {
                let g = f64::from(u8::from(i == j)) - roots[i] * inverse[(i, j)] * roots[j];
                half[(i, knot)] += 0.5 * copies * g * g * share;
            }
        }
    }
    let mut fisher = Mat::<f64>::zeros(knots.count(), knots.count());
    for (i, weights) in weights.iter().enumerate() {
        for (knot, share) in weights.iter().filter(|(_, share)| *share != 0.0) {
            for other in 0..knots.count() {
                fisher[(*knot, other)] += share * half[(i, other)];
            }
        }
    }
    Some((value, gradient, fisher))
}

impl<'a> Factors<'a> {
    /// Factorises the blocks plus R by degree. A block that is not positive definite leaves its unknowns unchanged in solutions.
    pub(in crate::imaging) fn new(blocks: &'a [Block<'a>], r: &[f64]) -> Self {
        let orders = blocks.iter().map(|block| (0..block.order()).collect()).collect();
        let factors = blocks.par_iter().map(|block| block.factor(r)).collect();
        Self { blocks, orders, factors, coupled: None }
    }

    /// Factorises the blocks, what couples them, and R. If both together are not positive definite, the coupling is left out.
    pub(in crate::imaging) fn coupled(blocks: &'a [Block<'a>], coupling: &Coupling, r: &[f64]) -> Self {
        // What is coupled comes last, so that it is coupled by its own part of the factors alone.
        let index_of = coupling_index(&coupling.places);
        let order = |block: &Block<'a>| {
            let mut order: Vec<usize> = (0..block.order()).collect();
            order.sort_by_key(|k| index_of.contains_key(&block.places[0][*k]));
            order
        };
        let orders: Vec<Vec<usize>> = blocks.iter().map(order).collect();
        let factor = |(block, order): (&Block<'a>, &Vec<usize>)| block.in_order(order).factor(r);
        let factors = blocks.par_iter().zip(&orders).map(factor).collect();
        let mut factors = Self { blocks, orders, factors, coupled: None };
        factors.coupled = factors.couple(coupling);
        factors
    }

    /// `Q = 1 + L^-1 E L^-t` of the coupled unknowns.
    fn couple(&self, coupling: &Coupling) -> Option<Coupled> {
        let Coupling { places, mut matrix, .. } = coupling.by_degree(self.blocks);
        let index_of = coupling_index(&places);
        for _ in 0..2 {
            for ((block, order), factor) in self.blocks.iter().zip(&self.orders).zip(&self.factors) {
                let first = order.iter().position(|k| index_of.contains_key(&block.places[0][*k]));
                let Some(first) = first else { continue };
                let lower = factor.as_ref()?.L();
                let corner = lower.submatrix(first, first, order.len() - first, order.len() - first);
                for places in &block.places {
                    let rows: Vec<usize> = order[first..].iter().map(|k| index_of[&places[*k]]).collect();
                    let mut values = Mat::from_fn(rows.len(), matrix.ncols(), |i, j| matrix[(rows[i], j)]);
                    solve_lower_triangular_in_place(corner, values.as_mut(), Par::Seq);
                    for j in 0..matrix.ncols() {
                        rows.iter().enumerate().for_each(|(i, row)| matrix[(*row, j)] = values[(i, j)]);
                    }
                }
            }
            matrix = matrix.transpose().to_owned();
        }
        for k in 0..matrix.nrows() {
            matrix[(k, k)] += 1.0;
        }
        let factor = matrix.llt(Side::Lower).ok()?;
        let least = (0..matrix.nrows()).map(|k| factor.L()[(k, k)].powi(2)).fold(f64::INFINITY, f64::min);
        (least > LEAST_PIVOT).then_some(Coupled { places, factor })
    }

    /// Applies `operation` to the unknowns of each block, in place.
    fn apply(&self, unknowns: &mut [f64], operation: &dyn Fn(&Llt<f64>, &mut Mat<f64>)) {
        for ((block, order), factor) in self.blocks.iter().zip(&self.orders).zip(&self.factors) {
            let Some(factor) = factor else { continue };
            let at = |k: usize, part: usize| block.places[part][order[k]];
            let mut values = Mat::from_fn(order.len(), block.places.len(), |k, part| unknowns[at(k, part)]);
            operation(factor, &mut values);
            for part in 0..block.places.len() {
                (0..order.len()).for_each(|k| unknowns[at(k, part)] = values[(k, part)]);
            }
        }
    }

    /// Applies `operation` to the coupled unknowns, in place.
    fn apply_coupled(&self, unknowns: &mut [f64], operation: &dyn Fn(&Llt<f64>, &mut Mat<f64>)) {
        let Some(Coupled { places, factor }) = &self.coupled else { return };
        let mut values = Mat::from_fn(places.len(), 1, |k, _| unknowns[places[k]]);
        operation(factor, &mut values);
        places.iter().enumerate().for_each(|(k, place)| unknowns[*place] = values[(k, 0)]);
    }

    /// Solves for a vector of unknowns, in place.
    pub(in crate::imaging) fn solve(&self, unknowns: &mut [f64]) {
        if self.coupled.is_none() {
            return self.apply(unknowns, &|factor, values| factor.solve_in_place(values));
        }
        self.solve_lower(unknowns);
        self.solve_upper(unknowns);
    }

    /// Solves with the lower factor of all.
    pub(in crate::imaging) fn solve_lower(&self, unknowns: &mut [f64]) {
        self.apply(unknowns, &solve_lower);
        self.apply_coupled(unknowns, &solve_lower);
    }

    /// Solves with its transpose. For standard normal x the result is a sample whose covariance is the inverse of what was factorised.
    pub(in crate::imaging) fn solve_upper(&self, unknowns: &mut [f64]) {
        self.apply_coupled(unknowns, &solve_upper);
        self.solve_upper_of_blocks(unknowns);
    }

    /// Solves with the upper factors of the blocks alone.
    pub(in crate::imaging) fn solve_upper_of_blocks(&self, unknowns: &mut [f64]) {
        self.apply(unknowns, &solve_upper);
    }

    /// The trace of the inverse of the blocks plus R, by degree, without what couples them.
    pub(in crate::imaging) fn traces(&self, l_max: usize) -> Vec<f64> {
        let diagonal = |factor: &Option<Llt<f64>>| {
            factor.as_ref().map(|factor| {
                let inverse = factor.inverse();
                (0..inverse.nrows()).map(|k| inverse[(k, k)]).collect::<Vec<f64>>()
            })
        };
        let diagonals: Vec<Option<Vec<f64>>> = self.factors.par_iter().map(diagonal).collect();
        let mut traces = vec![0.0; l_max + 1];
        for ((block, order), diagonal) in self.blocks.iter().zip(&self.orders).zip(diagonals) {
            for (k, term) in order.iter().zip(diagonal.unwrap_or_default()) {
                traces[block.degrees[*k]] += block.places.len() as f64 * term;
            }
        }
        traces
    }

    /// The values `v.(A + R)^-1 v` in one block, without what couples it, for each column of `v`; zeros if the block has no factor.
    pub(in crate::imaging) fn quadratic_forms(&self, block: usize, mut v: Mat<f64>) -> Vec<f64> {
        let Some(Some(factor)) = self.factors.get(block) else { return vec![0.0; v.ncols()] };
        let order = &self.orders[block];
        v = Mat::from_fn(v.nrows(), v.ncols(), |k, column| v[(order[k], column)]);
        solve_lower_triangular_in_place(factor.L(), v.as_mut(), Par::Seq);
        (0..v.ncols()).map(|column| (0..v.nrows()).map(|k| v[(k, column)].powi(2)).sum()).collect()
    }
}

/// The index of each coupled unknown.
fn coupling_index(places: &[usize]) -> HashMap<usize, usize> {
    places.iter().enumerate().map(|(index, place)| (*place, index)).collect()
}

fn solve_lower(factor: &Llt<f64>, values: &mut Mat<f64>) {
    solve_lower_triangular_in_place(factor.L(), values.as_mut(), Par::Seq);
}

fn solve_upper(factor: &Llt<f64>, values: &mut Mat<f64>) {
    solve_upper_triangular_in_place(factor.L().transpose(), values.as_mut(), Par::Seq);
}

/// Multiplies a vector of unknowns by the blocks.
pub(in crate::imaging) fn multiply(blocks: &[Block<'_>], unknowns: &[f64]) -> Vec<f64> {
    let mut products = vec![0.0; unknowns.len()];
    for block in blocks {
        let product = &*block.matrix * block.gather(unknowns);
        for (part, places) in block.places.iter().enumerate() {
            places.iter().enumerate().for_each(|(k, place)| products[*place] = product[(k, part)]);
        }
    }
    products
}

/// The largest diagonal element of the blocks.
pub(super) fn largest_diagonal(blocks: &[Block<'_>]) -> f64 {
    let block_max = |block: &Block<'_>| (0..block.order()).map(|k| block.matrix[(k, k)]).fold(0.0, f64::max);
    blocks.iter().map(block_max).fold(0.0, f64::max)
}
