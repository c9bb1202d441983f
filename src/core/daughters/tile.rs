//! Covariance matrices at many frequencies, and dispatch of SIMD code over them.

use pulp::{Arch, Simd, WithSimd};

use super::bins::HALF;

/// Number of frequencies processed together: `HALF` below the channel's centre, and their mirror images above it.
pub(super) const TILE: usize = 2 * HALF;

/// Smallest pivot of a covariance matrix, as a fraction of its diagonal: the rounding of `f32` lies below it.
pub(super) const PIVOT_MIN: f32 = 1e-6;

/// Hermitian or triangular matrices at `TILE` frequencies: lower triangles, row by row, `TILE` values per element.
#[derive(Clone, Debug)]
pub(super) struct Tile {
    pub re: Vec<[f32; TILE]>,
    pub im: Vec<[f32; TILE]>,
}

/// Index of element (i, j), i >= j, of a lower triangle.
pub(super) fn element(i: usize, j: usize) -> usize {
    i * (i + 1) / 2 + j
}

impl Tile {
    pub(super) fn new(order: usize) -> Self {
        let elements = element(order, 0);
        Self { re: vec![[0.0; TILE]; elements], im: vec![[0.0; TILE]; elements] }
    }
}

/// A computation on the frequencies of a tile.
pub(super) trait TileKernel {
    type Output;
    /// Runs the computation; `P` registers hold one side of the channel.
    fn run<S: Simd, const P: usize>(self, simd: S) -> Self::Output;
}

/// Runs `kernel` with the widest registers of the machine.
pub(super) fn on_tile<K: TileKernel>(arch: Arch, kernel: K) -> K::Output {
    arch.dispatch(WidestSimd(kernel))
}

struct WidestSimd<K>(K);

impl<K: TileKernel> WithSimd for WidestSimd<K> {
    type Output = K::Output;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> K::Output {
        match S::F32_LANES {
            16 => self.0.run::<S, 1>(simd),
            8 => self.0.run::<S, 2>(simd),
            4 => self.0.run::<S, 4>(simd),
            _ => self.0.run::<S, HALF>(simd),
        }
    }
}
