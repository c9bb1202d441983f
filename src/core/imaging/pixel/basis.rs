//! The pixels of a map as the basis of an exact engine.
use rayon::prelude::*;

use super::checkpoint::PixelHead;
use super::exact::{BLOCK, Panels, SCALES_MAX, WEIGHT_QUANTA};
use super::{
    ColumnBlock, ExactPixels, FACTOR_SCALE, PADDING, PixelSetup, PixelSums, RIGHT_STEPS, SymmetricTiles,
    Whitened,
};
use crate::array::is_underground;
use crate::frames::AntennaResponse;
use crate::imaging::exact::checkpoint::{BasisKind, FrameReader, FrameWriter};
use crate::imaging::exact::engine::{Accepted, CommonSetup, ExactEngine, SkyBasis};
use crate::imaging::exact::fixed_point::rounding::round_factors;
use crate::imaging::exact::fixed_point::{Direction, WeightScale};
use crate::imaging::{AccumulationError, Refusal, SumCounts};
use crate::response::harmonic::GeometryRefusal;
use crate::response::pixel::{PairGeometry, RowMaker};
use crate::sky::healpix::{pixel_area_sr, pixel_count};
use crate::units::vector::{Vec3, norm};

/// The engine whose unknowns are the pixels of a HEALPix map.
pub type PixelEngine = ExactEngine<PixelBasis>;

/// The pixels of a HEALPix map as a basis.
pub struct PixelBasis {
    setup: PixelSetup,
    scale: WeightScale,
    rows: RowMaker,
}

/// Positions of the two satellites of a visibility.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairPositions {
    r_i_m: Vec3,
    r_j_m: Vec3,
}

impl PixelEngine {
    /// Memory of an engine, bytes: the matrix, a block of rows, and two copies of it in the order of the products.
    #[must_use]
    pub fn memory_bytes(nside: usize) -> u64 {
        let pixels = pixel_count(nside);
        SymmetricTiles::memory_bytes(pixels) + (3 * 2 * BLOCK * (pixels + PADDING) * 8) as u64
    }
}

impl PixelBasis {
    fn pair(&self, PairPositions { r_i_m, r_j_m }: PairPositions) -> PairGeometry {
        PairGeometry {
            r_i_m,
            r_j_m,
            frequency_hz: self.setup.frequency_hz,
            moon_radius_m: self.setup.moon_radius_m,
            response: self.setup.response,
        }
    }

    /// Quanta of the matrix and of the right-hand sides, K^-2 and K^-1.
    fn quanta(&self) -> (f64, f64) {
        let area_sr = pixel_area_sr(self.setup.nside);
        (
            area_sr * area_sr * self.scale.weight / WEIGHT_QUANTA,
            area_sr * self.scale.root / (FACTOR_SCALE * RIGHT_STEPS),
        )
    }

    /// Rows of B times the square roots of the weights, rounded: two rows per visibility.
    fn factors(&self, batch: &[Accepted<PairPositions>], stride: usize) -> Vec<f64> {
        let pixels = self.rows.pixels();
        let pairs: Vec<PairGeometry> = batch.iter().map(|visibility| self.pair(visibility.place)).collect();
        pairs.iter().for_each(|pair| self.rows.prepare(pair));
        let mut a = vec![0.0_f64; 2 * batch.len() * stride];
        a.par_chunks_exact_mut(2 * stride).zip(batch.par_iter().zip(&pairs)).for_each(
            |(rows, (visibility, pair))| {
                let (re, im) = rows.split_at_mut(stride);
                let factor = FACTOR_SCALE * visibility.weight.sqrt() / self.scale.root;
                self.rows.fill(pair, factor, &mut re[..pixels], &mut im[..pixels]);
                round_factors(rows);
            },
        );
        a
    }
}

impl SkyBasis for PixelBasis {
    type Setup = PixelSetup;
    type Place = PairPositions;
    type Exact = ExactPixels;
    type Equations = PixelSums;
    type Head = PixelHead;

    const KIND: BasisKind = BasisKind::Pixel;
    const BATCH: usize = BLOCK;
    const SCALES_MAX: f64 = SCALES_MAX;

    fn new(setup: &PixelSetup, scale: WeightScale) -> Result<Self, AccumulationError> {
        Ok(Self { setup: *setup, scale, rows: RowMaker::new(setup.nside, setup.method)? })
    }

    fn common(setup: &PixelSetup) -> CommonSetup {
        let &PixelSetup { frequency_hz, weight_max, companion_seed, .. } = setup;
        CommonSetup { frequency_hz, weight_max, companion_seed }
    }

    fn zeros(&self) -> ExactPixels {
        ExactPixels::zeros(self.setup.nside)
    }

    fn place(&self, r_i_m: Vec3, r_j_m: Vec3) -> Result<PairPositions, Refusal> {
        let positions = PairPositions { r_i_m, r_j_m };
        if [r_i_m, r_j_m].into_iter().any(|r_m| !norm(r_m).is_normal()) {
            return Err(Refusal::Geometry(GeometryRefusal::NotFinite));
        }
        if [r_i_m, r_j_m].into_iter().any(|r_m| is_underground(r_m, self.setup.moon_radius_m)) {
            return Err(Refusal::Geometry(GeometryRefusal::Altitude));
        }
        if r_i_m == r_j_m {
            return Err(Refusal::Geometry(GeometryRefusal::Degenerate));
        }
        let has_dipoles = self.setup.response == AntennaResponse::DipoleNormal;
        if has_dipoles && self.pair(positions).orbit_normal().is_none() {
            return Err(Refusal::Geometry(GeometryRefusal::Degenerate));
        }
        Ok(positions)
    }

    fn sum(&self, exact: &mut ExactPixels, batch: &[Accepted<PairPositions>], direction: Direction) {
        let (pixels, columns) = (self.rows.pixels(), 2 * batch.len());
        let stride = pixels + PADDING;
        let a = self.factors(batch, stride);
        let whitened: Vec<Whitened> =
            batch.iter().map(|v| Whitened { data: v.weight.sqrt() * v.value_k_sr, noise: v.noise }).collect();
        let sign = direction.sign();
        exact.add_right_hand_sides(&a, stride, &whitened, sign);
        let panels = Panels::new(ColumnBlock { values: &a, columns, stride }, pixels, sign);
        exact.normal.add_products(&panels);
    }

    fn combine(&self, exact: &mut ExactPixels, other: &ExactPixels, direction: Direction) {
        exact.combine(other, direction);
    }

    fn finish(&self, exact: ExactPixels, counts: SumCounts) -> PixelSums {
        let (unit, right_unit) = self.quanta();
        let values = |sums: Vec<i128>| sums.into_iter().map(|sum| sum as f64 * right_unit).collect();
        PixelSums {
            nside: self.setup.nside,
            normal: exact.normal.into_values(unit),
            right: values(exact.right),
            noise: values(exact.noise),
            counts,
        }
    }

    fn head(setup: &PixelSetup) -> PixelHead {
        PixelHead::new(setup)
    }

    fn setup_of(head: PixelHead) -> Result<PixelSetup, AccumulationError> {
        head.setup()
    }

    fn write(&self, exact: &ExactPixels, out: &mut FrameWriter<'_>) -> Result<(), AccumulationError> {
        exact.write(out)
    }

    fn read(&self, from: &mut FrameReader<'_>) -> Result<ExactPixels, AccumulationError> {
        ExactPixels::read(self.setup.nside, from)
    }
}
