//! BtN^-1B as one matrix, for orbits whose node has not turned evenly.
//!
//! The blocks that are diagonal in m are the whole matrix once the node has turned evenly. Until then they are far from it: powers, errors and
//! samples that rest on them are wrong, and iterations that they precondition do not converge.
//!
//! Few visibilities at few nodes of the orbit also show what gridding does to the matrix. Its eigenvalues, none of which is negative in truth,
//! go down to some -1e-5 of the largest. Such errors E change the right-hand side by E x, which counts as noise of variance `eta^2` in each
//! unknown: with `A = U diag(a) U'` the equations become `U diag(a^2 / (a + eta^2)) U' x = U diag(a / (a + eta^2)) U' b`, whose right-hand side
//! has the matrix as its covariance, as that of exact equations has.

use std::borrow::Cow;

use faer::{Mat, Side};
use rayon::prelude::*;

use super::grid::ALPHAS;
use super::stored::TorusPart;
use super::{HarmonicSums, OrderBlocks, degrees};
use crate::imaging::exact::fixed_point::parts::sum_of_parts;
use crate::imaging::power::{Block, PowerProblem};
use crate::imaging::solver::{NamedWatch, dot};
use crate::imaging::{Accuracy, NormalSums, SumCounts};

/// Columns that are made at once: a thread has a workspace for each.
const COLUMNS: usize = 8;

/// Eigenvalues above this multiple of the most negative one are accurate enough for a first estimate of the sky's norm.
const ACCURATE: f64 = 30.0;

/// Unknowns up to which a matrix is made, some l_max = 49: it takes as many products as these.
pub const WHOLE_UNKNOWNS_MAX: usize = 2_500;

/// Covered share of the node's turn below which the blocks are not near the matrix. Mean squares of (map - sky) / sigma at nside 8 and 16, by the
/// blocks and by the matrix: 1.4 and 1.3 for shares of 0.8, 1.3 and 1.2 of 0.65, 1.1 and 1.0 of 0.5, 2.7 and 1.3 of 0.35, 270 and 1.9 of 0.02.
pub const EVEN_SHARE: f64 = 0.6;

/// The equations of a map with R from the data.
pub(super) enum PowerEquations<'a> {
    /// With blocks near their matrix.
    ByOrder { sums: &'a HarmonicSums, blocks: OrderBlocks, may_mislead: bool },
    /// With their whole matrix.
    Whole(WholeSums<'a>),
}

/// Equations whose matrix is stored, with what gridding did to it as noise.
pub(super) struct WholeSums<'a> {
    sums: &'a HarmonicSums,
    matrix: Mat<f64>,
    /// What right-hand sides go through; `None` if the matrix is as exact as it has to be.
    filter: Option<Filter>,
    right: Vec<f64>,
    noise: Vec<f64>,
    gain_errors: Vec<Vec<f64>>,
}

/// Multiplies each eigenvector of a matrix by its share.
struct Filter {
    vectors: Mat<f64>,
    shares: Vec<f64>,
}

impl Filter {
    fn apply(&self, right: &[f64]) -> Vec<f64> {
        let column = Mat::from_fn(right.len(), 1, |k, _| right[k]);
        let mut modes = self.vectors.transpose() * column;
        self.shares.iter().enumerate().for_each(|(k, share)| modes[(k, 0)] *= share);
        let sum = &self.vectors * modes;
        (0..right.len()).map(|k| sum[(k, 0)]).collect()
    }
}

impl<'a> PowerEquations<'a> {
    /// Equations for what the data say beside `prior`, with this right-hand side.
    pub(super) fn new(
        sums: &'a HarmonicSums,
        right: &[f64],
        prior: Option<&[f64]>,
        watch: NamedWatch<'_>,
    ) -> Self {
        // Intermediate maps have no errors.
        let may_mislead = watch.is_of_final_map() && sums.covered_share() < EVEN_SHARE;
        let is_whole = may_mislead && sums.unknowns() <= WHOLE_UNKNOWNS_MAX;
        let whole = is_whole.then(|| WholeSums::new(sums, right, prior, watch)).flatten();
        whole.map_or_else(|| Self::ByOrder { sums, blocks: sums.order_blocks(), may_mislead }, Self::Whole)
    }

    /// Whether C_l and errors may be far from true: the node has not turned evenly, and the matrix is too large to be stored.
    pub(super) fn may_mislead(&self) -> bool {
        matches!(self, Self::ByOrder { may_mislead: true, .. })
    }

    pub(super) fn sums(&self) -> &dyn NormalSums {
        match self {
            Self::ByOrder { sums, .. } => *sums,
            Self::Whole(whole) => whole,
        }
    }

    /// The right-hand side that belongs to one of the sums.
    pub(super) fn right(&self, of_sums: &[f64]) -> Vec<f64> {
        match self {
            Self::Whole(WholeSums { filter: Some(filter), .. }) => filter.apply(of_sums),
            _ => of_sums.to_vec(),
        }
    }

    /// The search for the power, with [`Self::blocks`] and [`Self::right`].
    pub(super) fn problem<'b>(
        &'b self,
        blocks: &'b [Block<'b>],
        degrees: &'b [usize],
        right: &'b [f64],
        data_chi2: f64,
    ) -> PowerProblem<'b> {
        let sums = self.sums();
        let data_count = 2.0 * sums.counts().visibilities as f64;
        PowerProblem { sums, blocks, coupling: None, degrees, right, data_chi2, data_count }
    }

    pub(super) fn blocks(&self) -> Vec<Block<'_>> {
        match self {
            Self::ByOrder { blocks, .. } => blocks.blocks(),
            Self::Whole(WholeSums { matrix, sums, .. }) => vec![Block {
                matrix: Cow::Borrowed(matrix),
                degrees: degrees(sums.setup.l_max).collect(),
                places: vec![(0..matrix.nrows()).collect()],
            }],
        }
    }
}

impl<'a> WholeSums<'a> {
    /// `None` if no time is left for the matrix.
    fn new(
        sums: &'a HarmonicSums,
        right: &[f64],
        prior: Option<&[f64]>,
        watch: NamedWatch<'_>,
    ) -> Option<Self> {
        Some(Self::with_matrix(sums, sums.whole_matrix(watch)?, right, prior))
    }

    pub(super) fn with_matrix(
        sums: &'a HarmonicSums,
        matrix: Mat<f64>,
        right: &[f64],
        prior: Option<&[f64]>,
    ) -> Self {
        let noise = sums.noise_right_hand_side().to_vec();
        let gain_errors = sums.gain_error_right_hand_sides().to_vec();
        let filter = None;
        let exact = Self { sums, matrix, filter, right: right.to_vec(), noise, gain_errors };
        exact.with_error_as_noise(prior)
    }

    #[cfg(test)]
    pub(super) fn matrix(&self) -> &Mat<f64> {
        &self.matrix
    }

    /// Counts errors of the matrix as noise.
    fn with_error_as_noise(self, prior: Option<&[f64]>) -> Self {
        if self.matrix.llt(Side::Lower).is_ok() {
            return self;
        }
        let Ok(decomposed) = self.matrix.self_adjoint_eigen(Side::Lower) else { return self };
        let values: Vec<f64> = decomposed.S().column_vector().iter().copied().collect();
        let [least, .., largest] = values[..] else { return self };
        let count = values.len();
        // At least rounding, if none is negative.
        let error = (-least).max(count as f64 * f64::EPSILON * largest);
        let inverse = |value: &f64| if *value > ACCURATE * error { value.recip() } else { 0.0 };
        let vectors = decomposed.U().to_owned();
        let mut filter = Filter { vectors, shares: values.iter().map(inverse).collect() };
        let mut sky = filter.apply(&self.right);
        if let Some(prior) = prior {
            sky.iter_mut().zip(prior).for_each(|(sky, prior)| *sky += prior);
        }
        let noise = error * error * dot(&sky, &sky) / count as f64;
        let share = |value: &f64| if *value > 0.0 { value / (value + noise) } else { 0.0 };
        filter.shares = values.iter().map(share).collect();
        let scaled = |i: usize, k: usize| filter.vectors[(i, k)] * filter.shares[k] * values[k];
        Self {
            sums: self.sums,
            matrix: Mat::from_fn(count, count, scaled) * filter.vectors.transpose(),
            right: filter.apply(&self.right),
            noise: filter.apply(&self.noise),
            gain_errors: self.gain_errors.iter().map(|v| filter.apply(v)).collect(),
            filter: Some(filter),
        }
    }
}

impl NormalSums for WholeSums<'_> {
    fn unknowns(&self) -> usize {
        self.matrix.nrows()
    }

    fn apply(&self, x: &[f64], y: &mut [f64]) {
        for product in self.apply_all(&[x]) {
            y.copy_from_slice(&product);
        }
    }

    fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        let columns = Mat::from_fn(self.unknowns(), x.len(), |k, column| x[column][k]);
        let products = &self.matrix * columns;
        (0..x.len()).map(|column| (0..self.unknowns()).map(|k| products[(k, column)]).collect()).collect()
    }

    fn right_hand_side(&self) -> &[f64] {
        &self.right
    }

    fn noise_right_hand_side(&self) -> &[f64] {
        &self.noise
    }

    fn gain_error_right_hand_sides(&self) -> &[Vec<f64>] {
        &self.gain_errors
    }

    fn gain_error_power(&self) -> f64 {
        self.sums.gain_error_power()
    }

    fn counts(&self) -> SumCounts {
        self.sums.counts()
    }

    fn accuracy(&self) -> Accuracy {
        self.sums.accuracy()
    }

    fn failure(&self) -> Option<&str> {
        self.sums.failure()
    }
}

impl HarmonicSums {
    /// The share of the turn of the node that the weights w cover: `(sum w)^2 / (n sum w^2)` over n values of alpha. NaN if the sums could not be
    /// read. All ranks must ask for it.
    pub(super) fn covered_share(&self) -> f64 {
        let (grids, stride) = (&self.grids, self.grids.weight_stride());
        let blocks = grids.points.div_ceil(ALPHAS);
        let part = |block: usize| {
            let mut weights = vec![0.0; grids.points];
            let Some(rows) = self.tori.block(grids, TorusPart::Weights, block) else {
                return vec![f64::NAN];
            };
            for (k, weight) in weights[block * ALPHAS..].iter_mut().take(ALPHAS).enumerate() {
                let rows = (0..grids.nodes.count).filter_map(|node| rows.row(node, k));
                *weight = rows.flat_map(|row| &row[..stride]).map(|w| f64::from(*w)).sum();
            }
            weights
        };
        let held: Vec<usize> = (0..blocks).filter(|block| grids.share.holds(*block)).collect();
        let parts: Vec<Vec<f64>> = held.into_par_iter().map(part).collect();
        let weights = sum_of_parts(&self.ranks, &parts, grids.points, blocks);
        let sum: f64 = weights.iter().sum();
        let squares: f64 = weights.iter().map(|w| w * w).sum();
        sum * sum / (weights.len() as f64 * squares)
    }

    /// BtN^-1B over all unknowns; `None` if no time is left for it.
    fn whole_matrix(&self, watch: NamedWatch<'_>) -> Option<Mat<f64>> {
        let count = self.unknowns();
        let task = watch.start("matrix, by columns", 0.0);
        let mut matrix = Mat::zeros(count, count);
        for first in (0..count).step_by(COLUMNS) {
            if !task.report_step(true, first, (count - first) as f64 / count as f64) {
                return None;
            }
            let unit = |column: usize| {
                let mut unit = vec![0.0; count];
                unit[column] = 1.0;
                unit
            };
            let units: Vec<Vec<f64>> = (first..count.min(first + COLUMNS)).map(unit).collect();
            let units: Vec<&[f64]> = units.iter().map(Vec::as_slice).collect();
            for (column, product) in (first..).zip(self.apply_all(&units)) {
                // Half to each side, as products are not symmetric to the last bit.
                for (row, value) in product.iter().enumerate() {
                    matrix[(row, column)] += 0.5 * value;
                    matrix[(column, row)] += 0.5 * value;
                }
            }
        }
        Some(matrix)
    }
}
