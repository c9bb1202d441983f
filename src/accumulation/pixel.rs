//! The pixel engine: BtN^-1B itself, pixel by pixel.

use num_complex::Complex64;
use rayon::prelude::*;

use super::checkpoint;
use super::error::AccumulationError;
use super::noise::companion_noise;
use super::tiles::{Columns, SymmetricTiles};
use super::{Added, NormalEngine, NormalSums, SumCounts};
use crate::array::response::{PairGeometry, PixelMethod, RowMaker};
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::sky::healpix::{pixel_area_sr, pixel_count};
use crate::units::vector::Vec3;

/// Visibilities whose rows are made and multiplied together: 256 columns, so that a product reads and
/// writes the matrix rarely, and its rows stay in cache.
const BLOCK: usize = 128;

/// Greatest nside at which products are formed in f64; beyond, in f32 and added up in f64.
const NSIDE_MAX_F64: usize = 32;

/// Elements between the rows of B in a block, beyond their length; see [`super::tiles`] on strides.
const PADDING: usize = 16;

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
}

/// A visibility that waits for its block to be full.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pending {
    pub(super) r_i_m: Vec3,
    pub(super) r_j_m: Vec3,
    pub(super) value_k_sr: Complex64,
    pub(super) weight: f64,
    /// Noise of the noise-only companion, in units of the standard deviation.
    pub(super) noise: Complex64,
}

/// Sums `BtN^-1B` and `BtN^-1V` over the pixels of a HEALPix map; real and imaginary parts of a
/// visibility are separate rows of B (the paper, Sect. 4).
///
/// Costs 2 N_pix^2 multiply-adds a visibility, of which symmetry saves half.
pub struct PixelEngine {
    pub(super) setup: PixelSetup,
    rows: RowMaker,
    pub(super) sums: PixelSums,
    pub(super) pending: Vec<Pending>,
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

impl PixelSums {
    pub(super) fn zeros(nside: usize) -> Self {
        let pixels = pixel_count(nside);
        Self {
            nside,
            normal: SymmetricTiles::zeros(pixels),
            right: vec![0.0; pixels],
            noise: vec![0.0; pixels],
            counts: SumCounts::default(),
        }
    }

    /// Adds a block of visibilities `sign` times, their rows made by `rows`.
    fn add_block(&mut self, setup: &PixelSetup, rows: &RowMaker, block: &[Pending], sign: f64) {
        if block.is_empty() {
            return;
        }
        let pixels = rows.pixels();
        let stride = pixels + PADDING;
        let area_sr = pixel_area_sr(setup.nside);
        let pair = |visibility: &Pending| PairGeometry {
            r_i_m: visibility.r_i_m,
            r_j_m: visibility.r_j_m,
            frequency_hz: setup.frequency_hz,
            moon_radius_m: setup.moon_radius_m,
            response: setup.response,
        };
        block.iter().for_each(|visibility| rows.prepare(&pair(visibility)));
        let fill = |visibility: &Pending, re: &mut [f64], im: &mut [f64]| {
            rows.fill(&pair(visibility), area_sr * visibility.weight.sqrt(), re, im);
        };
        let mut a = vec![0.0_f64; 2 * block.len() * stride];
        a.par_chunks_exact_mut(2 * stride).zip(block).for_each(|(rows, visibility)| {
            let (re, im) = rows.split_at_mut(stride);
            fill(visibility, &mut re[..pixels], &mut im[..pixels]);
        });
        self.add_sides(&a, stride, block, sign);
        let columns = 2 * block.len();
        if setup.nside <= NSIDE_MAX_F64 || sign < 0.0 {
            self.normal.add_products_times(Columns { values: &a, columns, stride }, sign);
        } else {
            let single: Vec<f32> = a.par_iter().map(|&x| x as f32).collect();
            self.normal.add_products_f32(Columns { values: &single, columns, stride });
        }
        self.counts.visibilities = if sign < 0.0 {
            self.counts.visibilities.saturating_sub(block.len() as u64)
        } else {
            self.counts.visibilities + block.len() as u64
        };
        self.counts.weight += sign * block.iter().map(|visibility| visibility.weight).sum::<f64>();
    }

    /// Adds rows times whitened data, and rows times whitened noise, to the two right-hand sides.
    fn add_sides(&mut self, a: &[f64], stride: usize, block: &[Pending], sign: f64) {
        const STRETCH: usize = 512;
        let sides = self.right.par_chunks_mut(STRETCH).zip(self.noise.par_chunks_mut(STRETCH));
        sides.enumerate().for_each(|(stretch, (right, noise))| {
            for (k, visibility) in block.iter().enumerate() {
                let whitened = sign * visibility.value_k_sr * visibility.weight.sqrt();
                let noise_of = sign * visibility.noise;
                let parts = [(whitened.re, noise_of.re), (whitened.im, noise_of.im)];
                for (part, (data, draw)) in parts.into_iter().enumerate() {
                    let row = &a[(2 * k + part) * stride + stretch * STRETCH..];
                    for ((right, noise), &row) in right.iter_mut().zip(noise.iter_mut()).zip(row) {
                        *right += row * data;
                        *noise += row * draw;
                    }
                }
            }
        });
    }
}

impl PixelEngine {
    /// An empty engine.
    ///
    /// # Errors
    /// An nside for which there are no rows.
    pub fn new(setup: PixelSetup) -> Result<Self, AccumulationError> {
        let rows = RowMaker::new(setup.nside, setup.method)?;
        Ok(Self { setup, rows, sums: PixelSums::zeros(setup.nside), pending: Vec::with_capacity(BLOCK) })
    }

    /// Memory of an engine, bytes: the matrix and a block of rows.
    #[must_use]
    pub fn memory_bytes(nside: usize) -> u64 {
        let pixels = pixel_count(nside);
        SymmetricTiles::memory_bytes(pixels) + (2 * BLOCK * (pixels + PADDING) * 8) as u64
    }

    /// Setup.
    #[must_use]
    pub fn setup(&self) -> &PixelSetup {
        &self.setup
    }

    fn check(&self, placed: &PlacedVisibilities) -> Result<(), AccumulationError> {
        let (expected_hz, found_hz) = (self.setup.frequency_hz, placed.frequency_hz);
        if found_hz == expected_hz {
            Ok(())
        } else {
            Err(AccumulationError::Frequency { expected_hz, found_hz })
        }
    }

    fn pending(&self, placed: &PlacedVisibilities, k: usize) -> Pending {
        Pending {
            r_i_m: placed.r_i_m[k],
            r_j_m: placed.r_j_m[k],
            value_k_sr: placed.value_k_sr[k],
            weight: placed.weight[k],
            noise: companion_noise(self.setup.companion_seed, placed, k),
        }
    }

    /// Adds what waits, full block or not.
    fn settle(&mut self) {
        let pending = std::mem::take(&mut self.pending);
        self.sums.add_block(&self.setup, &self.rows, &pending, 1.0);
    }
}

impl NormalEngine for PixelEngine {
    type Sums = PixelSums;

    fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.check(placed)?;
        for k in 0..placed.len() {
            self.pending.push(self.pending(placed, k));
            if self.pending.len() == BLOCK {
                self.settle();
            }
        }
        Ok(Added { visibilities: placed.len() as u64, ..Added::default() })
    }

    fn remove(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        self.check(placed)?;
        self.settle();
        let taken: Vec<Pending> = (0..placed.len()).map(|k| self.pending(placed, k)).collect();
        for block in taken.chunks(BLOCK) {
            self.sums.add_block(&self.setup, &self.rows, block, -1.0);
        }
        Ok(Added { visibilities: placed.len() as u64, ..Added::default() })
    }

    fn merge(&mut self, mut other: Self) -> Result<(), AccumulationError> {
        if self.setup != other.setup {
            return Err(AccumulationError::Mismatch { what: "pixels, frequency, response or seed" });
        }
        self.settle();
        other.settle();
        self.sums.normal.add(&other.sums.normal);
        let sides = [(&mut self.sums.right, &other.sums.right), (&mut self.sums.noise, &other.sums.noise)];
        for (sums, others) in sides {
            for (sum, term) in sums.iter_mut().zip(others) {
                *sum += term;
            }
        }
        self.sums.counts.visibilities += other.sums.counts.visibilities;
        self.sums.counts.weight += other.sums.counts.weight;
        Ok(())
    }

    fn counts(&self) -> SumCounts {
        SumCounts {
            visibilities: self.sums.counts.visibilities + self.pending.len() as u64,
            weight: self.sums.counts.weight + self.pending.iter().map(|p| p.weight).sum::<f64>(),
        }
    }

    fn sums(&self) -> PixelSums {
        let mut sums = self.sums.clone();
        sums.add_block(&self.setup, &self.rows, &self.pending, 1.0);
        sums
    }

    fn into_sums(mut self) -> PixelSums {
        self.settle();
        self.sums
    }

    fn checkpoint(&self, out: &mut dyn std::io::Write) -> Result<(), AccumulationError> {
        checkpoint::write(self, out)
    }

    fn restore(from: &mut dyn std::io::Read) -> Result<Self, AccumulationError> {
        let checkpoint::Restored { setup, sums, pending } = checkpoint::read(from)?;
        let mut engine = Self { setup, rows: RowMaker::new(setup.nside, setup.method)?, sums, pending };
        engine.pending.reserve(BLOCK);
        Ok(engine)
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
