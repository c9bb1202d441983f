//! The pixel engine: BtN^-1B itself, pixel by pixel.

use num_complex::Complex64;
use rayon::prelude::*;

use super::error::AccumulationError;
use super::exact::{BLOCK, ExactTiles, Panels, SCALES_MAX, WEIGHT_QUANTA, add_scaled, round_factors};
use super::noise::companion_noise;
use super::scale::{Scale, Totals};
use super::tiles::{Columns, SymmetricTiles};
use super::{Added, Direction, NormalEngine, NormalSums, Refusal, SumCounts, checkpoint};
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::response::harmonic::GeometryRefusal;
use crate::response::pixel::{PairGeometry, PixelMethod, RowMaker};
use crate::sky::healpix::{pixel_area_sr, pixel_count};
use crate::units::vector::{Vec3, norm};

/// Elements between the rows of B in a block, beyond their length; see [`crate::accumulation::tiles`] on strides.
const PADDING: usize = 16;

/// Factors of the greatest weight: a row of B times the root of its weight, in units of the scale's.
const FACTORS: f64 = 2_097_152.0; // 2^21, the root of WEIGHT_QUANTA
/// Steps of a whitened visibility or noise in one standard deviation.
const SIDE_STEPS: f64 = 1024.0;

/// What distinguishes one pixel engine from another.
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
    /// Greatest weight that is taken, (K sr)^-2; it sets the resolution of the sums.
    pub weight_max: f64,
}

/// A visibility that waits for its block to be full.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pending {
    r_i_m: Vec3,
    r_j_m: Vec3,
    /// Root of the weight, (K sr)^-1.
    root: f64,
    /// Value times that.
    whitened: Complex64,
    /// Noise of the noise-only companion, in units of the standard deviation.
    noise: Complex64,
}

/// Sums `BtN^-1B` and `BtN^-1V` over the pixels of a HEALPix map; real and imaginary parts of a
/// visibility are separate rows of B (the paper, Sect. 4).
///
/// Costs 2 N_pix^2 multiply-adds a visibility, of which symmetry saves half. With M the power of four not below
/// `weight_max`, terms of the matrix are rounded to `2^-42 M` times the square of a pixel's area, and those of the
/// right-hand sides to `2^-31 sqrt(M)` times the area; there is room for a weight of `2^21 M` in all.
pub struct PixelEngine {
    pub(super) setup: PixelSetup,
    scale: Scale,
    rows: RowMaker,
    pub(super) sums: ExactSums,
    /// All that were put in, also those that wait.
    pub(super) totals: Totals,
    pending: Vec<Pending>,
    /// What is to become of those that wait.
    direction: Direction,
}

/// The sums as integers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ExactSums {
    pub(super) normal: ExactTiles,
    pub(super) right: Vec<i128>,
    pub(super) noise: Vec<i128>,
}

/// Normal equations over pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelSums {
    /// HEALPix nside.
    pub nside: usize,
    /// BtN^-1B, K^-2.
    pub normal: SymmetricTiles,
    /// BtN^-1V, K^-1.
    pub right: Vec<f64>,
    /// BtN^-1n, K^-1.
    pub noise: Vec<f64>,
    /// What is in them.
    pub counts: SumCounts,
}

impl ExactSums {
    fn zeros(nside: usize) -> Self {
        let pixels = pixel_count(nside);
        Self { normal: ExactTiles::zeros(pixels), right: vec![0; pixels], noise: vec![0; pixels] }
    }

    /// Adds, or takes out, other sums.
    fn combine(&mut self, other: &Self, direction: Direction) {
        match direction {
            Direction::In => self.normal.add(&other.normal),
            Direction::Out => self.normal.subtract(&other.normal),
        }
        let sides = [(&mut self.right, &other.right), (&mut self.noise, &other.noise)];
        for (sums, others) in sides {
            for (sum, term) in sums.iter_mut().zip(others) {
                *sum = match direction {
                    Direction::In => sum.wrapping_add(*term),
                    Direction::Out => sum.wrapping_sub(*term),
                };
            }
        }
    }

    /// Adds rows times whitened data, and rows times whitened noise, to the two right-hand sides.
    fn add_sides(&mut self, a: &[f64], stride: usize, block: &[Pending], sign: f64) {
        const STRETCH: usize = 512;
        let sides = self.right.par_chunks_mut(STRETCH).zip(self.noise.par_chunks_mut(STRETCH));
        sides.enumerate().for_each(|(stretch, (right, noise))| {
            // 2^8 terms of less than 2^50 fit 64 bits.
            let mut sums = [[0_i64; STRETCH]; 2];
            let steps = sign * SIDE_STEPS;
            for (k, visibility) in block.iter().enumerate() {
                let (data, draw) = (visibility.whitened, visibility.noise);
                for (part, factors) in [[data.re, draw.re], [data.im, draw.im]].into_iter().enumerate() {
                    let row = &a[(2 * k + part) * stride + stretch * STRETCH..][..right.len()];
                    for (sums, factor) in sums.iter_mut().zip(factors) {
                        add_scaled(sums, row, steps * factor);
                    }
                }
            }
            for (sides, sums) in [right, noise].into_iter().zip(&sums) {
                sides.iter_mut().zip(sums).for_each(|(side, sum)| *side += i128::from(*sum));
            }
        });
    }
}

impl PixelEngine {
    /// An empty engine.
    ///
    /// # Errors
    /// An nside for which there are no rows, or a `weight_max` that is none.
    pub fn new(setup: PixelSetup) -> Result<Self, AccumulationError> {
        Self::of(setup, Totals::default(), || Ok(ExactSums::zeros(setup.nside)))
    }

    /// An engine of these sums, made when the setup is known to be sound.
    pub(super) fn of(
        setup: PixelSetup,
        totals: Totals,
        sums: impl FnOnce() -> Result<ExactSums, AccumulationError>,
    ) -> Result<Self, AccumulationError> {
        Ok(Self {
            scale: Scale::new(setup.weight_max)?,
            rows: RowMaker::new(setup.nside, setup.method)?,
            sums: sums()?,
            totals,
            pending: Vec::with_capacity(BLOCK),
            direction: Direction::In,
            setup,
        })
    }

    /// Memory of an engine, bytes: the matrix and a block of rows, twice more in the order of their products.
    #[must_use]
    pub fn memory_bytes(nside: usize) -> u64 {
        let pixels = pixel_count(nside);
        SymmetricTiles::memory_bytes(pixels) + (3 * 2 * BLOCK * (pixels + PADDING) * 8) as u64
    }

    /// Setup.
    #[must_use]
    pub fn setup(&self) -> &PixelSetup {
        &self.setup
    }

    fn pair(&self, r_i_m: Vec3, r_j_m: Vec3) -> PairGeometry {
        PairGeometry {
            r_i_m,
            r_j_m,
            frequency_hz: self.setup.frequency_hz,
            moon_radius_m: self.setup.moon_radius_m,
            response: self.setup.response,
        }
    }

    /// What is summed of a visibility, or why it is not.
    fn place(&self, placed: &PlacedVisibilities, k: usize) -> Result<(Pending, Totals), Refusal> {
        let (r_i_m, r_j_m, value, weight) =
            (placed.r_i_m[k], placed.r_j_m[k], placed.value_k_sr[k], placed.weight[k]);
        if [r_i_m, r_j_m].into_iter().any(|r_m| !norm(r_m).is_normal()) {
            return Err(Refusal::Geometry(GeometryRefusal::NotFinite));
        }
        let dipoles = self.setup.response == AntennaResponse::DipoleNormal;
        if dipoles && self.pair(r_i_m, r_j_m).orbit_normal().is_none() {
            return Err(Refusal::Geometry(GeometryRefusal::Degenerate));
        }
        self.scale.check(value, weight, self.setup.weight_max)?;
        let root = weight.sqrt();
        let noise = companion_noise(self.setup.companion_seed, placed, k);
        Ok((Pending { r_i_m, r_j_m, root, whitened: root * value, noise }, Totals::one(self.scale, weight)))
    }

    /// Puts visibilities in or takes them out.
    fn take(
        &mut self,
        placed: &PlacedVisibilities,
        direction: Direction,
    ) -> Result<Added, AccumulationError> {
        let (expected_hz, found_hz) = (self.setup.frequency_hz, placed.frequency_hz);
        if found_hz != expected_hz {
            return Err(AccumulationError::Frequency { expected_hz, found_hz });
        }
        let found: Vec<_> = (0..placed.len()).map(|k| self.place(placed, k)).collect();
        if direction == Direction::Out {
            let taken = found.iter().flatten().map(|(_, one)| *one);
            let left = taken.into_iter().try_fold(self.totals, |totals, one| totals.and(one, direction));
            left.ok_or(AccumulationError::NothingHeld(placed.channel))?;
        }
        if self.direction != direction {
            self.settle();
            self.direction = direction;
        }
        let mut added = Added::default();
        for found in found {
            match found.and_then(|(pending, one)| Ok((pending, self.with(one, direction)?))) {
                Ok((pending, totals)) => {
                    added.visibilities += 1;
                    self.totals = totals;
                    self.pending.push(pending);
                }
                Err(reason) => added.refuse(reason),
            }
            if self.pending.len() == BLOCK {
                self.settle();
            }
        }
        Ok(added)
    }

    /// The totals with others, if sums of 63 bits hold them: no element is greater than what the weights allow.
    fn with(&self, others: Totals, direction: Direction) -> Result<Totals, Refusal> {
        let totals = self.totals.and(others, direction).ok_or(Refusal::Full)?;
        if totals.scales() > SCALES_MAX { Err(Refusal::Full) } else { Ok(totals) }
    }

    fn combine(&mut self, mut other: Self, direction: Direction) -> Result<(), AccumulationError> {
        if self.setup != other.setup {
            return Err(AccumulationError::Mismatch {
                what: "pixels, frequency, response, seed or greatest weight",
            });
        }
        let totals = self.with(other.totals, direction).map_err(|_| AccumulationError::Range)?;
        self.settle();
        other.settle();
        self.sums.combine(&other.sums, direction);
        self.totals = totals;
        Ok(())
    }

    /// Steps of the matrix and of the sides, K^-2 and K^-1.
    fn units(&self) -> (f64, f64) {
        let area_sr = pixel_area_sr(self.setup.nside);
        (
            area_sr * area_sr * self.scale.weight / WEIGHT_QUANTA,
            area_sr * self.scale.root / (FACTORS * SIDE_STEPS),
        )
    }

    fn values(&self, exact: ExactSums) -> PixelSums {
        let (unit, side_unit) = self.units();
        let side = |sums: Vec<i128>| sums.into_iter().map(|sum| sum as f64 * side_unit).collect();
        PixelSums {
            nside: self.setup.nside,
            normal: exact.normal.into_values(unit),
            right: side(exact.right),
            noise: side(exact.noise),
            counts: self.totals.counts(self.scale),
        }
    }
}

impl NormalEngine for PixelEngine {
    type Sums = PixelSums;

    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.take(placed, Direction::In)
    }

    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.take(placed, Direction::Out)
    }

    fn settle(&mut self) {
        let block = std::mem::take(&mut self.pending);
        if block.is_empty() {
            return;
        }
        let (pixels, columns) = (self.rows.pixels(), 2 * block.len());
        let stride = pixels + PADDING;
        let pairs: Vec<PairGeometry> =
            block.iter().map(|visibility| self.pair(visibility.r_i_m, visibility.r_j_m)).collect();
        pairs.iter().for_each(|pair| self.rows.prepare(pair));
        let mut a = vec![0.0_f64; columns * stride];
        a.par_chunks_exact_mut(2 * stride).zip(block.par_iter().zip(&pairs)).for_each(
            |(rows, (visibility, pair))| {
                let (re, im) = rows.split_at_mut(stride);
                let factor = FACTORS * visibility.root / self.scale.root;
                self.rows.fill(pair, factor, &mut re[..pixels], &mut im[..pixels]);
                round_factors(rows);
            },
        );
        let sign = self.direction.sign();
        self.sums.add_sides(&a, stride, &block, sign);
        let panels = Panels::new(Columns { values: &a, columns, stride }, pixels, sign);
        self.sums.normal.add_products(&panels);
        // The room is used again.
        self.pending = block;
        self.pending.clear();
    }

    fn merge(&mut self, other: Self) -> Result<(), AccumulationError> {
        self.combine(other, Direction::In)
    }

    fn subtract(&mut self, other: Self) -> Result<(), AccumulationError> {
        self.combine(other, Direction::Out)
    }

    fn counts(&self) -> SumCounts {
        self.totals.counts(self.scale)
    }

    fn sums(&mut self) -> PixelSums {
        self.settle();
        self.values(self.sums.clone())
    }

    fn into_sums(mut self) -> PixelSums {
        self.settle();
        let exact = std::mem::replace(&mut self.sums, ExactSums::zeros(1));
        self.values(exact)
    }

    fn checkpoint(&mut self, out: &mut dyn std::io::Write) -> Result<(), AccumulationError> {
        self.settle();
        checkpoint::write(self, out)
    }

    fn restore(from: &mut dyn std::io::Read) -> Result<Self, AccumulationError> {
        checkpoint::read(from)
    }
}

impl NormalSums for PixelSums {
    fn unknowns(&self) -> usize {
        self.right.len()
    }

    fn apply(&self, x: &[f64], y: &mut [f64]) {
        self.normal.multiply(x, y);
    }

    fn right_hand_side(&self) -> &[f64] {
        &self.right
    }

    fn noise_side(&self) -> &[f64] {
        &self.noise
    }

    fn counts(&self) -> SumCounts {
        self.counts
    }
}
