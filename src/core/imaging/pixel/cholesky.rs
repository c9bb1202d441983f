//! In-place Cholesky factorisation of a tiled matrix.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{
    LltParams, LltRegularization, cholesky_in_place, cholesky_in_place_scratch,
};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Par, Spec};
use rayon::prelude::*;

use super::tiles::{SymmetricTiles, TILE, add_product};

/// The factor L of `M = L Lt`, in the tiles that held M.
///
/// The factorisation is right-looking: a column of tiles is finished, then its products are subtracted from the rest.
/// The operations on each tile, and so the bits, do not depend on the number of threads.
#[derive(Clone, Debug)]
pub struct Cholesky(SymmetricTiles);

/// The first row of the tile whose factorisation failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotPositive(pub usize);

impl Cholesky {
    /// Factorises a symmetric positive definite matrix in its own memory.
    ///
    /// # Errors
    /// [`NotPositive`] with the first row of the tile that has no factor.
    pub fn new(mut matrix: SymmetricTiles) -> Result<Self, NotPositive> {
        for step in 0..matrix.along() {
            Self::advance(&mut matrix, step)?;
        }
        Ok(Self::from_factor(matrix))
    }

    /// Performs one of the `matrix.along()` steps of the factorisation, in order.
    pub(in crate::imaging) fn advance(matrix: &mut SymmetricTiles, step: usize) -> Result<(), NotPositive> {
        factor_column(matrix, step)?;
        subtract_column(matrix, step);
        Ok(())
    }

    /// Wraps the factor after all steps.
    pub(in crate::imaging) fn from_factor(matrix: SymmetricTiles) -> Self {
        Self(matrix)
    }

    /// Order of the matrix.
    #[must_use]
    pub fn order(&self) -> usize {
        self.0.order()
    }

    /// Solves `L Lt x = b`; `x` holds b before and x after.
    pub fn solve(&self, x: &mut [f64]) {
        let tiles = &self.0;
        for i in 0..tiles.along() {
            for j in 0..i {
                let (before, here) = x.split_at_mut(tiles.rows(i).start);
                subtract(tiles, i, j, &before[tiles.rows(j)], here);
            }
            let range = tiles.rows(i);
            forward(tiles, i, &mut x[range]);
        }
        for i in (0..tiles.along()).rev() {
            for k in i + 1..tiles.along() {
                let (here, after) = x.split_at_mut(tiles.rows(i).end);
                let start = tiles.rows(k).start - here.len();
                let rows = tiles.rows(k).len();
                subtract_mirrored(tiles, k, i, &after[start..start + rows], &mut here[tiles.rows(i)]);
            }
            let range = tiles.rows(i);
            backward(tiles, i, &mut x[range]);
        }
    }
}

/// Factorises the diagonal tile `step`, and solves for the tiles below it.
fn factor_column(matrix: &mut SymmetricTiles, step: usize) -> Result<(), NotPositive> {
    let size = matrix.rows(step).len();
    let first = matrix.rows(step).start;
    let order = matrix.order();
    let diagonal = step * (step + 1) / 2 + step;
    let (before, after) = matrix.tiles_mut().split_at_mut(diagonal + 1);
    let Some(pivot) = before.last_mut() else { return Ok(()) };
    let mut pivot = SymmetricTiles::view_mut(pivot, size, size);
    let params: Spec<LltParams, f64> = Spec::default();
    let mut memory = MemBuffer::new(cholesky_in_place_scratch::<f64>(size, Par::Seq, params));
    let stack = MemStack::new(&mut memory);
    cholesky_in_place(pivot.as_mut(), LltRegularization::default(), Par::Seq, stack, params)
        .map_err(|_| NotPositive(first))?;
    let pivot = pivot.as_ref();
    after.par_iter_mut().enumerate().for_each(|(index, tile)| {
        let (i, j) = SymmetricTiles::tile_at(index + diagonal + 1);
        if j == step {
            let rows = (order - i * TILE).min(TILE);
            // X L^T = B is equivalent to L X^T = B^T.
            let tile = SymmetricTiles::view_mut(tile, rows, size);
            solve_lower_triangular_in_place(pivot, tile.transpose_mut(), Par::Seq);
        }
    });
    Ok(())
}

/// Subtracts the products of the tiles of column `step` from the tiles to their lower right.
fn subtract_column(matrix: &mut SymmetricTiles, step: usize) {
    let order = matrix.order();
    let along = matrix.along();
    // The column is moved out, because it is read while other tiles are written.
    let column: Vec<Vec<f64>> =
        (step + 1..along).map(|i| std::mem::take(&mut matrix.tiles_mut()[i * (i + 1) / 2 + step])).collect();
    let size = matrix.rows(step).len();
    let rows_of = |i: usize| (order - i * TILE).min(TILE);
    matrix.tiles_mut().par_iter_mut().enumerate().for_each(|(index, tile)| {
        let (i, j) = SymmetricTiles::tile_at(index);
        if j <= step || i <= step {
            return;
        }
        let left = SymmetricTiles::view(&column[i - step - 1], rows_of(i), size);
        let right = SymmetricTiles::view(&column[j - step - 1], rows_of(j), size);
        let tile = SymmetricTiles::view_mut(tile, rows_of(i), rows_of(j));
        add_product(tile, -1.0, left, right, i == j);
    });
    for (k, tile) in column.into_iter().enumerate() {
        let i = step + 1 + k;
        matrix.tiles_mut()[i * (i + 1) / 2 + step] = tile;
    }
}

/// Computes `y -= L_ij x`.
fn subtract(tiles: &SymmetricTiles, i: usize, j: usize, x: &[f64], y: &mut [f64]) {
    let tile = tiles.tile(i, j);
    for (k, &x) in x.iter().enumerate() {
        for (y, &element) in y.iter_mut().zip(tile.col(k).iter()) {
            *y -= element * x;
        }
    }
}

/// Computes `y -= L_ij^T x`.
fn subtract_mirrored(tiles: &SymmetricTiles, i: usize, j: usize, x: &[f64], y: &mut [f64]) {
    let tile = tiles.tile(i, j);
    for (k, y) in y.iter_mut().enumerate() {
        *y -= x.iter().zip(tile.col(k).iter()).map(|(x, element)| x * element).sum::<f64>();
    }
}

/// Solves `L_ii y = x` in place.
fn forward(tiles: &SymmetricTiles, i: usize, x: &mut [f64]) {
    let tile = tiles.tile(i, i);
    for k in 0..x.len() {
        x[k] /= tile[(k, k)];
        let solved = x[k];
        for r in k + 1..x.len() {
            x[r] -= tile[(r, k)] * solved;
        }
    }
}

/// Solves `L_ii^T y = x` in place.
fn backward(tiles: &SymmetricTiles, i: usize, x: &mut [f64]) {
    let tile = tiles.tile(i, i);
    for k in (0..x.len()).rev() {
        let sum: f64 = (k + 1..x.len()).map(|r| tile[(r, k)] * x[r]).sum();
        x[k] = (x[k] - sum) / tile[(k, k)];
    }
}
