//! Normal equations over pixels: `BtN^-1B` itself, element by element.
//!
//! Real and imaginary parts of a visibility are separate rows of B (the paper, Sect. 3.2). Adding a visibility takes
//! 2 N_pix^2 multiply-adds, of which symmetry saves half. With M the smallest power of four not below `weight_max`, terms
//! of the matrix are rounded to `2^-42 M` times the square of a pixel's area, and those of the right-hand sides to
//! `2^-31 sqrt(M)` times the area; there is room for a total weight of `2^21 M`.

mod basis;
mod checkpoint;
mod cholesky;
mod cost;
mod exact;
mod matrix_free;
mod projected;
mod solve;
mod solve_by_degree;
mod solve_matrix_free;
mod solve_with_power;
mod sums;
mod tiles;

pub use basis::PixelEngine;
pub use cholesky::{Cholesky, NotPositive};
pub(super) use cost::{matrix_free_cost, pixel_cost};
pub use matrix_free::{MatrixFreeSums, MatrixFreeVisibilities};
pub(super) use projected::{averaged_blocks, degree_max};
pub use solve::{PixelExtras, PixelSolution, solve_pixels, solve_pixels_with};
pub(super) use solve_by_degree::{PixelEquations, SolvedByDegree};
pub use solve_matrix_free::solve_matrix_free;
pub(super) use solve_with_power::POWER_NSIDE_MAX;
pub use solve_with_power::solve_pixels_with_power;
pub use sums::PixelSums;
pub use tiles::{ColumnBlock, SymmetricTiles, TILE};

use num_complex::Complex64;
use rayon::prelude::*;

use self::exact::ExactTiles;
use crate::frames::AntennaResponse;
use crate::imaging::exact::fixed_point::Direction;
use crate::imaging::exact::fixed_point::rounding::add_scaled;
use crate::response::pixel::PixelMethod;
use crate::sky::healpix::pixel_count;

/// Unused elements between the rows of B in a block: with a power of two as stride, all rows would share few cache sets.
const PADDING: usize = 16;

/// Factors are rows of B times the square root of their weight; this is their size for the maximum weight.
const FACTOR_SCALE: f64 = 2_097_152.0; // 2^21, the root of WEIGHT_QUANTA
/// Steps per standard deviation of a whitened visibility or noise.
const RIGHT_STEPS: f64 = 1024.0;

/// Setup of a pixel engine; only engines of equal setup can be merged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelSetup {
    /// HEALPix nside of the map.
    pub nside: usize,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Method by which rows of B are computed.
    pub method: PixelMethod,
    /// Radius of the body that hides the sky, m.
    pub moon_radius_m: f64,
    /// Antenna response.
    pub response: AntennaResponse,
    /// Seed of the noise-only companion map.
    pub companion_seed: u64,
    /// Maximum weight that is accepted, (K sr)^-2; it sets the resolution of the sums.
    pub weight_max: f64,
}

/// The sums as integers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExactPixels {
    normal: ExactTiles,
    right: Vec<i128>,
    noise: Vec<i128>,
}

/// A visibility and its simulated noise, in units of the standard deviation.
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

    /// Adds other sums or removes them, depending on the direction.
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
