//! Normal equations over pixels: `BtN^-1B` itself, element by element.
//!
//! Real and imaginary parts of a visibility are separate rows of B (the paper, Sect. 4). Summing a visibility costs
//! 2 N_pix^2 multiply-adds, of which symmetry saves half. With M the power of four not below `weight_max`, terms of
//! the matrix are rounded to `2^-42 M` times the square of a pixel's area, and those of the right-hand sides to
//! `2^-31 sqrt(M)` times the area; there is room for a total weight of `2^21 M`.

mod checkpoint;
mod cholesky;
mod exact;
mod remade;
mod solve;
mod solve_remade;
mod solve_with_power;
mod sums;
mod tiles;

pub use cholesky::{Cholesky, NotPositive};
pub use remade::{RemadeSums, RemadeVisibilities};
pub use solve::{Diagnostics, PixelExtras, PixelSolution, PointBeam, solve_pixels, solve_pixels_with};
pub(super) use solve::{check_request, subtract_prediction};
pub use solve_remade::solve_remade;
pub use solve_with_power::{POWER_NSIDE_MAX, solve_pixels_with_power};
pub use sums::PixelSums;
pub use tiles::{ColumnBlock, SymmetricTiles, TILE};

use num_complex::Complex64;
use rayon::prelude::*;

use self::checkpoint::PixelHead;
use self::exact::{BLOCK, ExactTiles, Panels, SCALES_MAX, WEIGHT_QUANTA};
use crate::frames::AntennaResponse;
use crate::imaging::exact::checkpoint::{BasisKind, FrameReader, FrameWriter};
use crate::imaging::exact::engine::{Accepted, CommonSetup, ExactEngine, SkyBasis};
use crate::imaging::exact::fixed_point::rounding::{add_scaled, round_factors};
use crate::imaging::exact::fixed_point::{Direction, WeightScale};
use crate::imaging::{AccumulationError, Refusal, SumCounts};
use crate::response::harmonic::GeometryRefusal;
use crate::response::pixel::{PairGeometry, PixelMethod, RowMaker};
use crate::sky::healpix::{pixel_area_sr, pixel_count};
use crate::units::vector::{Vec3, norm};

/// Elements between the rows of B in a block, beyond their length: a stride of a power of two would map all rows to few
/// cache sets.
const PADDING: usize = 16;

/// Factors of the greatest weight: a row of B times the root of its weight, in units of the scale's.
const FACTORS: f64 = 2_097_152.0; // 2^21, the root of WEIGHT_QUANTA
/// Steps of a whitened visibility or noise in one standard deviation.
const RIGHT_STEPS: f64 = 1024.0;

/// The engine that sums over the pixels of a HEALPix map.
pub type PixelEngine = ExactEngine<PixelBasis>;

/// Setup of a pixel engine; only engines of equal setup can be merged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelSetup {
    /// HEALPix nside of the map.
    pub nside: usize,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// How rows of B are made.
    pub method: PixelMethod,
    /// Radius of the body that hides the sky, m.
    pub moon_radius_m: f64,
    /// Antenna response.
    pub response: AntennaResponse,
    /// Seed of the noise-only companion.
    pub companion_seed: u64,
    /// Greatest weight that is accepted, (K sr)^-2; it sets the resolution of the sums.
    pub weight_max: f64,
}

/// Pixels of a HEALPix map.
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

/// The sums as integers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExactPixels {
    normal: ExactTiles,
    right: Vec<i128>,
    noise: Vec<i128>,
}

/// A visibility and the noise of its companion, in standard deviations.
#[derive(Clone, Copy)]
struct Whitened {
    data: Complex64,
    noise: Complex64,
}

impl ExactPixels {
    fn zeros(nside: usize) -> Self {
        let pixels = pixel_count(nside);
        Self { normal: ExactTiles::zeros(pixels), right: vec![0; pixels], noise: vec![0; pixels] }
    }

    /// Adds other sums, or removes them.
    fn combine(&mut self, other: &Self, direction: Direction) {
        self.normal.combine(&other.normal, direction);
        for (sums, others) in [(&mut self.right, &other.right), (&mut self.noise, &other.noise)] {
            for (sum, term) in sums.iter_mut().zip(others) {
                *sum = match direction {
                    Direction::In => sum.wrapping_add(*term),
                    Direction::Out => sum.wrapping_sub(*term),
                };
            }
        }
    }

    /// Adds rows times whitened data, and rows times whitened noise, to the two right-hand sides.
    fn add_right_hand_sides(&mut self, a: &[f64], stride: usize, block: &[Whitened], sign: f64) {
        const PIXELS: usize = 512;
        let parts = self.right.par_chunks_mut(PIXELS).zip(self.noise.par_chunks_mut(PIXELS));
        parts.enumerate().for_each(|(part, (right, noise))| {
            // 2^8 terms of less than 2^50 fit 64 bits.
            let mut sums = [[0_i64; PIXELS]; 2];
            let steps = sign * RIGHT_STEPS;
            for (k, Whitened { data, noise }) in block.iter().enumerate() {
                for (row, factors) in [[data.re, noise.re], [data.im, noise.im]].into_iter().enumerate() {
                    let row = &a[(2 * k + row) * stride + part * PIXELS..][..right.len()];
                    for (sums, factor) in sums.iter_mut().zip(factors) {
                        add_scaled(sums, row, steps * factor);
                    }
                }
            }
            for (totals, sums) in [right, noise].into_iter().zip(&sums) {
                totals.iter_mut().zip(sums).for_each(|(total, sum)| *total += i128::from(*sum));
            }
        });
    }
}

impl PixelEngine {
    /// Memory of an engine, bytes: the matrix and a block of rows, twice more in the order of their products.
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

    /// Steps of the matrix and of the right-hand sides, K^-2 and K^-1.
    fn units(&self) -> (f64, f64) {
        let area_sr = pixel_area_sr(self.setup.nside);
        (
            area_sr * area_sr * self.scale.weight / WEIGHT_QUANTA,
            area_sr * self.scale.root / (FACTORS * RIGHT_STEPS),
        )
    }

    /// Rows of B times the roots of the weights, rounded to factors: two for each visibility.
    fn factors(&self, batch: &[Accepted<PairPositions>], stride: usize) -> Vec<f64> {
        let pixels = self.rows.pixels();
        let pairs: Vec<PairGeometry> = batch.iter().map(|visibility| self.pair(visibility.place)).collect();
        pairs.iter().for_each(|pair| self.rows.prepare(pair));
        let mut a = vec![0.0_f64; 2 * batch.len() * stride];
        a.par_chunks_exact_mut(2 * stride).zip(batch.par_iter().zip(&pairs)).for_each(
            |(rows, (visibility, pair))| {
                let (re, im) = rows.split_at_mut(stride);
                let factor = FACTORS * visibility.weight.sqrt() / self.scale.root;
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
        // Within the Moon nothing is seen, and satellites at one place are none.
        if [r_i_m, r_j_m].into_iter().any(|r_m| norm(r_m) <= self.setup.moon_radius_m) {
            return Err(Refusal::Geometry(GeometryRefusal::Altitude));
        }
        if r_i_m == r_j_m {
            return Err(Refusal::Geometry(GeometryRefusal::Degenerate));
        }
        let dipoles = self.setup.response == AntennaResponse::DipoleNormal;
        if dipoles && self.pair(positions).orbit_normal().is_none() {
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
        let (unit, right_unit) = self.units();
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
