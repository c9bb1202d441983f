//! Normal equations over spherical harmonics, for satellites on one circular orbit: gridded sums, with which BtN^-1B is
//! applied to harmonic coefficients by a non-uniform FFT.
//!
//! On a common circular orbit every row of B is a rotation of a pattern that depends only on the baseline's length
//! (see [`mod@crate::response::harmonic`]). A row at baseline u is interpolated from nodes u_k by a compact
//! kernel, `B = sum_k kappa(u_k - u) B_k`, so
//!
//! ```text
//! BtN^-1B = sum_{k k'} B_k^t [ sum_t w_t kappa_k kappa_k' at (alpha_t, gamma_t) ] B_k'
//! ```
//!
//! and only the bracket has to be summed: a weight for every pair of neighbouring nodes on a torus of two angles. Alpha is
//! the longitude of the ascending node minus pi/2, gamma the orbital phase plus pi/2. On the torus the bracket multiplies
//! pointwise. Its grid resolves the products of two functions of degree `l_max`; weights are gridded with kernels whose
//! spectra are flat over their band.
//!
//! Adding a visibility takes some thousand multiply-adds for any map size, and the size of the sums does not grow with
//! the data. With M the smallest power of four not below `weight_max`, weights are rounded to `2^-30 M` and data to
//! `2^-24 sqrt(M)`; terms above 2^21 of these quanta keep 21 bits (see the module `exact`). There is room for a total
//! weight of `2^32 M`.

mod beams;
mod blocks;
mod checkpoint;
mod cost;
mod coupling;
mod coverage;
mod exact;
mod gain_errors;
mod grid;
mod lines;
mod mover_columns;
mod mover_fluxes;
mod movers;
mod noise_maps;
mod noises;
mod operator;
mod parts;
mod posterior;
mod quanta;
mod setup;
mod sigma;
mod solve;
mod spread;
mod stored;
mod sums;
#[cfg(test)]
mod tests;
mod tori;
mod whole;
mod workspace;

use std::io::Read;
use std::sync::{Arc, OnceLock};

pub use super::unknowns::{coefficients, degrees, unknowns, unknowns_of_gradient};
pub(super) use beams::beams_with_power;
pub use beams::harmonic_beams;
pub use blocks::{OrderBlocks, OrderFactors};
pub(super) use cost::harmonic_cost;
pub use coverage::{GeometryCoverage, GeometrySurvey};
pub use grid::SPREAD_MULTIPLY_ADDS;
pub use mover_columns::{MONTH_S, MoverColumns};
pub use mover_fluxes::{MoverFlux, MoverFluxes};
pub use movers::{BODIES_MAX, MONTHS_MAX, MoverSums};
pub use noise_maps::solve_noises;
pub use noises::NoiseSums;
pub use parts::SumPart;
pub use posterior::NOISES_TOGETHER;
pub(super) use posterior::Posterior;
pub use setup::{
    ApplicationSize, HarmonicMemory, HarmonicSetup, SharedSize, application_size, memory, nominal_orbit,
    shared_size,
};
pub(super) use setup::{INCLINATION_STEP_DEG, RADIUS_STEP_M};
pub(super) use sigma::{moments, moments_k, resolution_deg, sample, view_sigma_k};
pub use solve::{HarmonicRequest, HarmonicSolution, solve_regularised};
pub(super) use solve::{largest_of_circle, prior_unknowns};
pub use sums::HarmonicSums;
pub use whole::{EVEN_SHARE, WHOLE_UNKNOWNS_MAX};

use self::checkpoint::HarmonicHead;
use self::exact::{ExactTori, SCALES_MAX};
use self::grid::Grids;
use self::operator::Operator;
use self::quanta::Quanta;
use self::spread::TorusPoint;
use self::tori::Tori;
use crate::imaging::exact::checkpoint::{BasisKind, FrameReader, FrameWriter};
use crate::imaging::exact::engine::{Accepted, CommonSetup, ExactEngine, SkyBasis};
use crate::imaging::exact::fixed_point::{Direction, WeightScale};
use crate::imaging::{AccumulationError, Refusal, SumCounts};
use crate::ranks::{RankShare, Ranks};
use crate::response::harmonic::PairOrientation;
use crate::units::vector::Vec3;

/// The engine whose unknowns are spherical harmonics. Its memory grows as baselines of more lengths arrive.
pub type HarmonicEngine = ExactEngine<HarmonicBasis>;

/// The basis of spherical harmonics, for satellites on one circular orbit.
pub struct HarmonicBasis {
    setup: HarmonicSetup,
    quanta: Quanta,
    grids: Arc<Grids>,
    tables: Arc<OnceLock<Operator>>,
    ranks: Ranks,
}

impl HarmonicEngine {
    /// Makes an empty engine that of one of several ranks: it receives all visibilities and holds its share of the sums. All ranks must have
    /// engines of the same setup, and use their sums in the same order.
    #[must_use]
    pub fn with_ranks(mut self, ranks: &Ranks) -> Self {
        let grids = Grids { share: ranks.share(), ..Grids::clone(&self.basis.grids) };
        let HarmonicBasis { setup, quanta, .. } = *self.basis;
        let (grids, tables, ranks) = (Arc::new(grids), Arc::default(), ranks.clone());
        self.basis = Arc::new(HarmonicBasis { setup, quanta, grids, tables, ranks });
        self
    }

    /// Restores an engine from what the rank with share `part` wrote, as one of `ranks`. The number of ranks may have changed; only the new
    /// share is kept.
    ///
    /// # Errors
    /// As [`NormalEngine::restore`]; or there are sums that do not belong to `part`.
    ///
    /// [`NormalEngine::restore`]: crate::imaging::NormalEngine::restore
    pub fn restore_part(
        from: &mut dyn Read,
        part: RankShare,
        ranks: &Ranks,
    ) -> Result<Self, AccumulationError> {
        let (mut from, (head, totals)) = FrameReader::new(from, HarmonicBasis::KIND)?;
        let kept = ranks.share();
        let engine = Self::with_sums(HarmonicBasis::setup_of(head)?, totals, |basis| {
            ExactTori::read(&basis.grids, &mut from, part, kept)
        })?;
        from.finish()?;
        Ok(engine.with_ranks(ranks))
    }

    /// Adds another share of the same sums: the same visibilities at other alphas.
    ///
    /// # Errors
    /// The shares are of different sums, or overlap.
    pub fn join(&mut self, other: Self) -> Result<(), AccumulationError> {
        let basis = Arc::clone(&self.basis);
        let (ours, theirs) = self.matching_parts(other)?;
        ours.join(&basis.grids, &theirs)
    }
}

impl HarmonicBasis {
    /// The basis for a process that holds all sums.
    fn unshared(&self) -> Self {
        let grids = Arc::new(Grids { share: RankShare::WHOLE, ..Grids::clone(&self.grids) });
        Self { setup: self.setup, quanta: self.quanta, grids, tables: Arc::default(), ranks: Ranks::single() }
    }

    fn sums(&self, tori: Tori, gain_error_tori: Vec<Tori>, counts: SumCounts) -> HarmonicSums {
        HarmonicSums {
            setup: self.setup,
            grids: Arc::clone(&self.grids),
            tables: Arc::clone(&self.tables),
            tori,
            ranks: self.ranks.clone(),
            reached: OnceLock::new(),
            used: OnceLock::new(),
            counts,
            right: OnceLock::new(),
            noise: OnceLock::new(),
            noise_realisations: Vec::new(),
            movers: None,
            gain_error_tori,
            gain_errors: OnceLock::new(),
            gain_error_power: 0.0,
        }
    }
}

impl SkyBasis for HarmonicBasis {
    type Setup = HarmonicSetup;
    type Place = TorusPoint;
    type Exact = ExactTori;
    type Equations = HarmonicSums;
    type Head = HarmonicHead;

    const KIND: BasisKind = BasisKind::Harmonic;
    /// Large enough to keep all cores busy over the nodes, in little memory.
    const BATCH: usize = 16_384;
    const SCALES_MAX: f64 = SCALES_MAX;

    fn new(setup: &HarmonicSetup, scale: WeightScale) -> Result<Self, AccumulationError> {
        setup.check()?;
        Ok(Self {
            setup: *setup,
            quanta: Quanta::new(scale),
            grids: Arc::new(setup.grids()),
            tables: Arc::new(OnceLock::new()),
            ranks: Ranks::single(),
        })
    }

    fn common(setup: &HarmonicSetup) -> CommonSetup {
        let &HarmonicSetup { frequency_hz, weight_max, companion_seed, .. } = setup;
        CommonSetup { frequency_hz, weight_max, companion_seed }
    }

    fn zeros(&self) -> ExactTori {
        ExactTori::zeros(&self.grids)
    }

    fn place(&self, r_i_m: Vec3, r_j_m: Vec3) -> Result<TorusPoint, Refusal> {
        let orientation = PairOrientation::of_pair(r_i_m, r_j_m)?;
        let pair = self.setup.orbit.pair(&orientation, self.setup.wavelength_m())?;
        if orientation.baseline_m > self.setup.baseline_m_max {
            return Err(Refusal::TooLong);
        }
        Ok(TorusPoint {
            alpha_rad: pair.state.node_rad - std::f64::consts::FRAC_PI_2,
            gamma_rad: pair.state.phase_rad + std::f64::consts::FRAC_PI_2,
            u: pair.state.baseline_wavelengths,
            is_conjugated: pair.reversed,
        })
    }

    fn sum(&self, exact: &mut ExactTori, batch: &[Accepted<TorusPoint>], direction: Direction) {
        exact.add(&self.grids, self.quanta, batch, direction);
    }

    fn combine(&self, exact: &mut ExactTori, other: &ExactTori, direction: Direction) {
        exact.combine(&self.grids, other, direction);
    }

    fn equations(&self, exact: &ExactTori, counts: SumCounts) -> HarmonicSums {
        let (gain_errors, gain_error_power) =
            (exact.gain_errors(&self.grids, self.quanta), exact.error_power());
        let sums = self.sums(exact.values(&self.grids, self.quanta), gain_errors, counts);
        HarmonicSums { gain_error_power, ..sums }
    }

    fn finish(&self, exact: ExactTori, counts: SumCounts) -> HarmonicSums {
        let gain_error_power = exact.error_power();
        let (values, gain_errors) = exact.into_values(&self.grids, self.quanta);
        let sums = self.sums(values, gain_errors, counts);
        HarmonicSums { gain_error_power, ..sums }
    }

    fn head(setup: &HarmonicSetup) -> HarmonicHead {
        HarmonicHead::new(setup)
    }

    fn setup_of(head: HarmonicHead) -> Result<HarmonicSetup, AccumulationError> {
        head.setup()
    }

    fn write(&self, exact: &ExactTori, out: &mut FrameWriter<'_>) -> Result<(), AccumulationError> {
        exact.write(&self.grids, out)
    }

    fn read(&self, from: &mut FrameReader<'_>) -> Result<ExactTori, AccumulationError> {
        ExactTori::read(&self.grids, from, RankShare::WHOLE, RankShare::WHOLE)
    }
}
