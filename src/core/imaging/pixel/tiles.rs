//! A symmetric matrix, stored as square tiles of its lower triangle.
//!
//! It takes half the memory of the full matrix. Threads work on whole tiles, so that updates, products and factorisation have the same
//! bits for any number of threads.

use faer::linalg::matmul::{matmul, triangular};
use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

/// Number of rows and columns of a tile, so that the product of two strips fits the second-level cache.
pub const TILE: usize = 512;

/// Elements from column to column of a tile. It is no power of two, which would map all columns to few cache sets (measured: 155 instead of
/// 229 Gflop/s).
pub(super) const STRIDE: usize = TILE + 16;

/// The lower triangle of a symmetric matrix in f64, as tiles.
#[derive(Clone, Debug, PartialEq)]
pub struct SymmetricTiles {
    order: usize,
    /// Tile (i, j), i >= j, is at i (i + 1) / 2 + j, with columns of [`STRIDE`] elements. Only the lower triangle of a
    /// diagonal tile is used.
    tiles: Vec<Vec<f64>>,
}

/// A block of columns of a matrix A, for the product A A^T.
#[derive(Clone, Copy, Debug)]
pub struct ColumnBlock<'a, T> {
    /// Elements; column k starts at `k * stride`.
    pub values: &'a [T],
    /// Number of columns.
    pub columns: usize,
    /// Elements from column to column.
    pub stride: usize,
}

/// Number of tiles along the side of a matrix.
pub(super) fn tiles_along(order: usize) -> usize {
    order.div_ceil(TILE)
}

/// The tile (i, j) at an index; tiles are stored row by row.
pub(super) fn tile_at(index: usize) -> (usize, usize) {
    let mut i = ((((8 * index + 1) as f64).sqrt() - 1.0) / 2.0) as usize;
    // The square root may be rounded to either side.
    while i * (i + 1) / 2 > index {
        i -= 1;
    }
    while (i + 1) * (i + 2) / 2 <= index {
        i += 1;
    }
    (i, index - i * (i + 1) / 2)
}

impl SymmetricTiles {
    /// A matrix of zeros.
    #[must_use]
    pub fn zeros(order: usize) -> Self {
        let count = tiles_along(order) * (tiles_along(order) + 1) / 2;
        let tiles = (0..count)
            .map(|index| {
                let (_, j) = tile_at(index);
                vec![0.0; STRIDE * extent(order, j)]
            })
            .collect();
        Self { order, tiles }
    }

    /// Creates a matrix from its tiles.
    pub(super) fn from_tiles(order: usize, tiles: Vec<Vec<f64>>) -> Self {
        Self { order, tiles }
    }

    /// Number of rows of the matrix.
    #[must_use]
    pub fn order(&self) -> usize {
        self.order
    }

    /// Memory of a matrix of this order, bytes.
    #[must_use]
    pub fn memory_bytes(order: usize) -> u64 {
        let along = tiles_along(order);
        let columns: usize = (0..along).map(|j| extent(order, j) * (along - j)).sum();
        (columns * STRIDE * size_of::<f64>()) as u64
    }

    /// Number of tiles along the side.
    pub(crate) fn along(&self) -> usize {
        tiles_along(self.order)
    }

    /// The rows of tile row `i`.
    pub(crate) fn rows(&self, i: usize) -> std::ops::Range<usize> {
        i * TILE..i * TILE + extent(self.order, i)
    }

    /// The tile (i, j), i >= j.
    pub(crate) fn tile(&self, i: usize, j: usize) -> MatRef<'_, f64> {
        Self::view(&self.tiles[i * (i + 1) / 2 + j], extent(self.order, i), extent(self.order, j))
    }

    /// All tiles, for changes in parallel.
    pub(crate) fn tiles_mut(&mut self) -> &mut [Vec<f64>] {
        &mut self.tiles
    }

    /// The tile (i, j) at an index of [`Self::tiles_mut`].
    pub(crate) fn tile_at(index: usize) -> (usize, usize) {
        tile_at(index)
    }

    /// Views a tile's storage as a matrix.
    pub(crate) fn view(values: &[f64], rows: usize, columns: usize) -> MatRef<'_, f64> {
        MatRef::from_column_major_slice_with_stride(values, rows, columns, STRIDE)
    }

    /// Views a tile's storage as a mutable matrix.
    pub(crate) fn view_mut(values: &mut [f64], rows: usize, columns: usize) -> MatMut<'_, f64> {
        MatMut::from_column_major_slice_with_stride_mut(values, rows, columns, STRIDE)
    }

    /// Adds A A^T by library products, whose rounding depends on the library; for comparison with the engine's own products.
    pub fn add_products_f64(&mut self, a: ColumnBlock<'_, f64>) {
        let order = self.order;
        self.tiles.par_iter_mut().enumerate().for_each(|(index, tile)| {
            let (i, j) = tile_at(index);
            let (left, right) = (strip(a, order, i), strip(a, order, j));
            let tile = Self::view_mut(tile, left.nrows(), right.nrows());
            add_product(tile, 1.0, left, right, i == j);
        });
    }

    /// Adds `shift` to the diagonal.
    pub fn add_to_diagonal(&mut self, shift: f64) {
        for i in 0..self.along() {
            let rows = extent(self.order, i);
            let tile = &mut self.tiles[i * (i + 1) / 2 + i];
            for k in 0..rows {
                tile[k * STRIDE + k] += shift;
            }
        }
    }

    /// The elements of the diagonal.
    #[must_use]
    pub fn diagonal(&self) -> Vec<f64> {
        (0..self.order).map(|k| self.get(k, k)).collect()
    }

    /// The element (row, column).
    #[must_use]
    pub fn get(&self, row: usize, column: usize) -> f64 {
        let (row, column) = (row.max(column), row.min(column));
        let (i, j) = (row / TILE, column / TILE);
        self.tiles[i * (i + 1) / 2 + j][column % TILE * STRIDE + row % TILE]
    }

    /// Computes y = M x; both have length [`Self::order`].
    pub fn multiply(&self, x: &[f64], y: &mut [f64]) {
        let parts: Vec<[Vec<f64>; 2]> = self
            .tiles
            .par_iter()
            .enumerate()
            .map(|(index, tile)| {
                let (i, j) = tile_at(index);
                multiply_tile(tile, &x[self.rows(i)], &x[self.rows(j)], i == j)
            })
            .collect();
        y.fill(0.0);
        for (index, [below, mirrored]) in parts.iter().enumerate() {
            let (i, j) = tile_at(index);
            for (y, part) in y[self.rows(i)].iter_mut().zip(below) {
                *y += part;
            }
            for (y, part) in y[self.rows(j)].iter_mut().zip(mirrored) {
                *y += part;
            }
        }
    }
}

/// Number of rows of tile row `i`.
pub(super) fn extent(order: usize, i: usize) -> usize {
    (order - i * TILE).min(TILE)
}

/// The rows of A that belong to tile row `i`.
fn strip<T>(a: ColumnBlock<'_, T>, order: usize, i: usize) -> MatRef<'_, T> {
    MatRef::from_column_major_slice_with_stride(a.values, order, a.columns, a.stride)
        .subrows(i * TILE, extent(order, i))
}

/// Computes `to += factor left right^T`; only the lower triangle of a diagonal tile.
pub(crate) fn add_product(
    to: MatMut<'_, f64>,
    factor: f64,
    left: MatRef<'_, f64>,
    right: MatRef<'_, f64>,
    is_diagonal: bool,
) {
    let (accum, right) = (Accum::Add, right.transpose());
    if is_diagonal {
        use triangular::BlockStructure::{Rectangular, TriangularLower};
        triangular::matmul(
            to,
            TriangularLower,
            accum,
            left,
            Rectangular,
            right,
            Rectangular,
            factor,
            Par::Seq,
        );
    } else {
        matmul(to, accum, left, right, factor, Par::Seq);
    }
}

/// The contribution of a tile to M x: to its rows, and by symmetry to its columns.
fn multiply_tile(tile: &[f64], x_rows: &[f64], x_columns: &[f64], is_diagonal: bool) -> [Vec<f64>; 2] {
    let mut below = vec![0.0; x_rows.len()];
    let mut mirrored = vec![0.0; x_columns.len()];
    for (k, column) in tile.chunks_exact(STRIDE).enumerate() {
        // In a diagonal tile the elements below the diagonal contribute twice, the diagonal once.
        let first = if is_diagonal { k + 1 } else { 0 };
        let column_below = &column[first..x_rows.len()];
        let x = x_columns[k];
        if is_diagonal {
            below[k] += column[k] * x;
        }
        for (y, &element) in below[first..].iter_mut().zip(column_below) {
            *y += element * x;
        }
        mirrored[k] += dot(column_below, &x_rows[first..]);
    }
    [below, mirrored]
}

/// The scalar product in eight running sums, which the compiler can vectorise.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let (a_chunks, b_chunks) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f64 = a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(x, y)| x * y).sum();
    for (a, b) in a_chunks.zip(b_chunks) {
        for k in 0..8 {
            sums[k] += a[k] * b[k];
        }
    }
    sums.iter().sum::<f64>() + rest
}

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::*;
    use crate::units::{StreamKind, random_stream};

    fn random(count: usize, seed: u64) -> Vec<f64> {
        let mut stream = random_stream(seed, StreamKind::Probe, [0, 0]);
        (0..count).map(|_| stream.random_range(-1.0..1.0)).collect()
    }

    #[test]
    fn indices_run_through_the_lower_triangle() {
        let mut index = 0;
        for i in 0..200 {
            for j in 0..=i {
                assert_eq!(tile_at(index), (i, j));
                index += 1;
            }
        }
    }

    #[test]
    fn products_and_multiplication_agree_with_plain_sums() {
        for order in [5, TILE - 1, TILE, 2 * TILE + 37] {
            let columns = 6;
            let stride = order + 3;
            let a = random(stride * columns, 1);
            let mut exact = SymmetricTiles::zeros(order);
            exact.add_products_f64(ColumnBlock { values: &a, columns, stride });
            let plain = |r: usize, c: usize| -> f64 {
                (0..columns).map(|k| a[k * stride + r] * a[k * stride + c]).sum()
            };
            for (r, c) in [(0, 0), (order - 1, 0), (order / 2, order - 1), (order - 1, order - 1)] {
                // Six terms below one, with rounding errors of 1e-16.
                assert!((exact.get(r, c) - plain(r, c)).abs() < 1e-14);
            }
            let x = random(order, 2);
            let mut y = vec![0.0; order];
            exact.multiply(&x, &mut y);
            for r in [0, order / 3, order - 1] {
                let sum: f64 = (0..order).map(|c| plain(r, c) * x[c]).sum();
                assert!((y[r] - sum).abs() < 1e-11 * order as f64);
            }
        }
    }
}
