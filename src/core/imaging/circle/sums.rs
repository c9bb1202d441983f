//! Normal equations over harmonic coefficients.

use std::ops::Range;
use std::sync::{Arc, OnceLock};

use super::HarmonicSetup;
use super::blocks::OrderBlocks;
use super::grid::Grids;
use super::mover_columns::MoverColumns;
use super::operator::{Operator, RightHandSide, SharedTori};
use super::stored::TorusPart;
use super::tori::Tori;
use crate::imaging::unknowns::{coefficients, unknowns_of_gradient};
use crate::imaging::{Accuracy, NormalSums, SumCounts};
use crate::ranks::Ranks;
use crate::sky::harmonics::Alm;

/// Interpolation between nodes and gridding of weights have errors of up to 4e-4 of an eigenvalue, and of some 1e-7 of W_max where large terms
/// cancel. Compared with rows in f64 from other code (`tests/maps/traces.rs`, l_max 20), the absolute part is 0 at 3 MHz up to 250 m, 2.1e-7 of
/// W_max at 10 MHz up to 234 m, and 3e-9 up to 470 m.
const ACCURACY: Accuracy = Accuracy { relative: 1e-3, absolute: 1e-6 };

/// Normal equations of one channel over the real orthonormal harmonics up to `l_max`.
///
/// A vector of unknowns has (l_max + 1)^2 elements in K sr^(1/2), by increasing m: `T_l0` for m = 0, `sqrt(2) Re T_lm` and
/// `sqrt(2) Im T_lm` for m > 0, each for l = m, m + 1, ..
#[derive(Clone, Debug)]
pub struct HarmonicSums {
    pub(super) setup: HarmonicSetup,
    pub(super) grids: Arc<Grids>,
    pub(super) tables: Arc<OnceLock<Operator>>,
    /// The share of the sums that this process holds.
    pub(super) tori: Tori,
    /// The ranks that share the sums. All of them must take part in whatever needs all sums.
    pub(super) ranks: Ranks,
    /// The range of nodes with data on any rank.
    pub(super) reached: OnceLock<Range<usize>>,
    /// Whether each alpha has weights here; cached, because it takes as long to compute as a product.
    pub(super) used: OnceLock<Vec<bool>>,
    pub(super) counts: SumCounts,
    pub(super) right: OnceLock<Vec<f64>>,
    pub(super) noise: OnceLock<Vec<f64>>,
    /// Right-hand sides of additional noise realisations.
    pub(super) noise_realisations: Vec<Vec<f64>>,
    /// Columns of bodies that move; `None` if none are solved for.
    pub(super) movers: Option<MoverColumns>,
    /// The share of pairs of right-hand sides of draws of the errors by gains.
    pub(super) gain_error_tori: Vec<Tori>,
    pub(super) gain_errors: OnceLock<Vec<Vec<f64>>>,
    /// The power of errors by gains, in units of the noise variance.
    pub(super) gain_error_power: f64,
}

impl HarmonicSums {
    /// The setup of the sums.
    #[must_use]
    pub fn setup(&self) -> &HarmonicSetup {
        &self.setup
    }

    pub(super) fn operator(&self) -> &Operator {
        self.tables.get_or_init(|| self.setup.operator(&self.grids))
    }

    /// Right-hand sides of the additional noise realisations.
    #[must_use]
    pub fn noise_realisations(&self) -> &[Vec<f64>] {
        &self.noise_realisations
    }

    pub(super) fn shared(&self) -> SharedTori<'_> {
        let reached = self.reached.get_or_init(|| self.tori.reached(&self.ranks)).clone();
        let used = self.used.get_or_init(|| self.tori.alphas(&self.grids, TorusPart::Weights));
        SharedTori { ranks: &self.ranks, tori: &self.tori, reached, used }
    }

    /// The two right-hand sides of a pair on the grid.
    pub(super) fn projected(&self, tori: &Tori) -> [Vec<f64>; 2] {
        projected(self.operator(), &SharedTori { tori, ..self.shared() })
    }

    /// Floating-point operations of this process's matrix products in one [`NormalSums::apply`].
    #[must_use]
    pub fn matrix_product_flops(&self) -> f64 {
        self.operator().matrix_product_flops(&self.shared())
    }

    /// Bytes of this process's weights, which each [`NormalSums::apply`] reads once.
    #[must_use]
    pub fn weight_bytes(&self) -> u64 {
        self.tori.weight_bytes(&self.grids)
    }

    /// The blocks of BtN^-1B that are diagonal in m, with weights averaged over the phase. They are the whole matrix once the orbit has covered
    /// all nodes and phases evenly.
    #[must_use]
    pub fn order_blocks(&self) -> OrderBlocks {
        OrderBlocks::new(&self.operator().patterns, &self.grids, &self.tori, &self.setup, &self.ranks)
    }
}

/// The two right-hand sides of sums.
pub(super) fn projected(operator: &Operator, shared: &SharedTori<'_>) -> [Vec<f64>; 2] {
    [RightHandSide::Data, RightHandSide::Noise]
        .map(|side| unknowns_of_gradient(&operator.project(shared, side)))
}

impl NormalSums for HarmonicSums {
    fn unknowns(&self) -> usize {
        (self.setup.l_max + 1) * (self.setup.l_max + 1)
    }

    fn apply(&self, x: &[f64], y: &mut [f64]) {
        for product in self.apply_all(&[x]) {
            y.copy_from_slice(&product);
        }
    }

    fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        let skies: Vec<Alm> = x.iter().map(|x| coefficients(x, self.setup.l_max)).collect();
        self.operator().apply(&self.shared(), &skies).iter().map(unknowns_of_gradient).collect()
    }

    fn right_hand_side(&self) -> &[f64] {
        self.right.get_or_init(|| {
            unknowns_of_gradient(&self.operator().project(&self.shared(), RightHandSide::Data))
        })
    }

    fn noise_right_hand_side(&self) -> &[f64] {
        self.noise.get_or_init(|| {
            unknowns_of_gradient(&self.operator().project(&self.shared(), RightHandSide::Noise))
        })
    }

    fn gain_error_right_hand_sides(&self) -> &[Vec<f64>] {
        self.gain_errors.get_or_init(|| {
            // Alphas of a rank may have no draws.
            let mut pairs = [self.gain_error_tori.len() as i64];
            self.ranks.max(&mut pairs);
            let none = Tori::in_memory(vec![None; self.grids.nodes.count]);
            let tori = |pair: usize| self.gain_error_tori.get(pair).unwrap_or(&none);
            (0..pairs[0] as usize).flat_map(|pair| self.projected(tori(pair))).collect()
        })
    }

    fn gain_error_power(&self) -> f64 {
        self.gain_error_power
    }

    fn counts(&self) -> SumCounts {
        self.counts
    }

    fn accuracy(&self) -> Accuracy {
        ACCURACY
    }

    fn failure(&self) -> Option<&str> {
        self.tori.stored.as_ref()?.failure()
    }
}
