//! Exact sums of products: a symmetric matrix of integers in tiles.
//!
//! Fused multiply-adds round the products, see [`crate::imaging::exact::fixed_point::rounding`]. Library products cannot be used,
//! because they start their running sums at zero.

use multiversion::multiversion;
use rayon::prelude::*;

use super::tiles::{ColumnBlock, STRIDE, SymmetricTiles, TILE, extent, tile_at, tiles_along};
use crate::imaging::exact::fixed_point::Direction;
use crate::imaging::exact::fixed_point::rounding::{BIAS, above_bias};

/// Quanta of a term of the maximum weight, 2^42; its factors go up to 2^21.
pub(super) const WEIGHT_QUANTA: f64 = 4_398_046_511_104.0;
/// Maximum number of visibilities whose products are formed together: 2^7 terms of 2^42 are well within the 2^51 of a running sum.
pub(super) const BLOCK: usize = 128;
/// Maximum total weight of sums of 63 bits, in units of the scale.
pub(super) const SCALES_MAX: f64 = 2_097_152.0 - 1.0;

/// Numbers of rows in panels of left and right factors. Their products take twelve vector registers for sums; two for factors and one for a
/// broadcast factor fill the sixteen registers.
const LEFT: usize = 8;
const RIGHT: usize = 6;

/// Factors in the order of their multiplication: panels of rows, each stored column by column.
pub(super) struct Panels {
    columns: usize,
    /// Left factors by row of tiles.
    left: Vec<Vec<[f64; LEFT]>>,
    /// Right factors by row of tiles, times the sign.
    right: Vec<Vec<[f64; RIGHT]>>,
}

impl Panels {
    /// Arranges rounded factors; `sign` (1 or -1) multiplies their products.
    pub(super) fn new(a: ColumnBlock<'_, f64>, order: usize, sign: f64) -> Self {
        let by_tile = |i: usize| (a, i * TILE..i * TILE + extent(order, i));
        Self {
            columns: a.columns,
            left: (0..tiles_along(order)).into_par_iter().map(|i| panels(by_tile(i), 1.0)).collect(),
            right: (0..tiles_along(order)).into_par_iter().map(|i| panels(by_tile(i), sign)).collect(),
        }
    }
}

/// Arranges rows in panels of `N`, padded with zeros.
fn panels<const N: usize>(
    (a, rows): (ColumnBlock<'_, f64>, std::ops::Range<usize>),
    sign: f64,
) -> Vec<[f64; N]> {
    let mut out = Vec::with_capacity(rows.len().div_ceil(N) * a.columns);
    for first in rows.clone().step_by(N) {
        let count = N.min(rows.end - first);
        for column in 0..a.columns {
            let from = &a.values[column * a.stride + first..][..count];
            let mut panel = [0.0; N];
            for (to, from) in panel.iter_mut().zip(from) {
                *to = sign * from;
            }
            out.push(panel);
        }
    }
    out
}

/// The lower triangle of a symmetric matrix of integers, in the tiles of [`SymmetricTiles`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ExactTiles {
    order: usize,
    tiles: Vec<Vec<i64>>,
}

impl ExactTiles {
    pub(super) fn zeros(order: usize) -> Self {
        let count = tiles_along(order) * (tiles_along(order) + 1) / 2;
        Self { order, tiles: (0..count).map(|k| vec![0; STRIDE * extent(order, tile_at(k).1)]).collect() }
    }

    /// Adds the products of all pairs of rows, each product rounded to a whole number.
    pub(super) fn add_products(&mut self, panels: &Panels) {
        self.tiles.par_iter_mut().enumerate().for_each(|(index, tile)| {
            let (i, j) = tile_at(index);
            multiply_panels((&panels.left[i], &panels.right[j]), panels.columns, i == j, tile);
        });
    }

    /// Adds another matrix of the same order or removes it, depending on the direction.
    pub(super) fn combine(&mut self, other: &Self, direction: Direction) {
        let combine = match direction {
            Direction::In => i64::wrapping_add,
            Direction::Out => i64::wrapping_sub,
        };
        self.tiles.par_iter_mut().zip(&other.tiles).for_each(|(tile, other)| {
            tile.iter_mut().zip(other).for_each(|(sum, term)| *sum = combine(*sum, *term));
        });
    }

    /// Converts the matrix to floating point, times `unit`, in the memory of the integers.
    pub(super) fn into_values(self, unit: f64) -> SymmetricTiles {
        let tiles = self.tiles.into_par_iter().map(|tile| to_values(tile, unit)).collect();
        SymmetricTiles::from_tiles(self.order, tiles)
    }

    /// The used elements of columns, tile by tile, for a checkpoint.
    pub(super) fn columns(&self) -> impl Iterator<Item = &[i64]> {
        self.tiles.iter().enumerate().flat_map(move |(index, tile)| {
            let rows = extent(self.order, tile_at(index).0);
            tile.chunks_exact(STRIDE).map(move |column| &column[..rows])
        })
    }

    /// Creates a matrix whose columns `read` fills, in the order of [`Self::columns`]. Tiles of two megabytes are allocated one by one, as
    /// they are read.
    pub(super) fn read<E>(
        order: usize,
        mut read: impl FnMut(&mut [i64]) -> Result<(), E>,
    ) -> Result<Self, E> {
        let along = tiles_along(order);
        let mut tiles = Vec::new();
        for (i, j) in (0..along * (along + 1) / 2).map(tile_at) {
            let mut tile = vec![0; STRIDE * extent(order, j)];
            for column in tile.chunks_exact_mut(STRIDE) {
                read(&mut column[..extent(order, i)])?;
            }
            tiles.push(tile);
        }
        Ok(Self { order, tiles })
    }
}

fn to_values(tile: Vec<i64>, unit: f64) -> Vec<f64> {
    tile.into_iter().map(|sum| sum as f64 * unit).collect()
}

/// Adds the products of two strips of panels to a tile; in a diagonal tile only those that reach its lower triangle.
///
/// Without fused multiply-add in hardware this is slow but gives the same result.
#[multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn multiply_panels(
    (left, right): (&[[f64; LEFT]], &[[f64; RIGHT]]),
    columns: usize,
    is_diagonal: bool,
    tile: &mut [i64],
) {
    for (right_panel, right) in right.chunks_exact(columns).enumerate() {
        for (left_panel, left) in left.chunks_exact(columns).enumerate() {
            let (row, column) = (left_panel * LEFT, right_panel * RIGHT);
            if is_diagonal && row + LEFT <= column {
                continue;
            }
            let mut sums = [[BIAS; LEFT]; RIGHT];
            for (left, right) in left.iter().zip(right) {
                for (sums, right) in sums.iter_mut().zip(right) {
                    for (sum, left) in sums.iter_mut().zip(left) {
                        *sum = left.mul_add(*right, *sum);
                    }
                }
            }
            // There are no columns beyond the last; rows beyond the last fall into the gap between columns.
            for (sums, column) in sums.iter().zip(column..) {
                let start = column * STRIDE + row;
                let Some(tile) = tile.get_mut(start..start + LEFT) else { break };
                for (to, sum) in tile.iter_mut().zip(sums) {
                    *to = to.wrapping_add(above_bias(*sum));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use rand::seq::SliceRandom;

    use super::*;
    use crate::imaging::exact::fixed_point::rounding::{STEPS, round_factors};
    use crate::units::{StreamKind, random_stream};

    /// Rounded rows of factors of all magnitudes.
    fn rows(order: usize, columns: usize, seed: u64) -> Vec<Vec<f64>> {
        let mut stream = random_stream(seed, StreamKind::Probe, [0, 0]);
        (0..columns)
            .map(|_| {
                let size = 2_f64.powf(stream.random_range(-10.0..21.0));
                let mut row: Vec<f64> = (0..order).map(|_| size * stream.random_range(-1.0..1.0)).collect();
                row[0] = 0.0;
                round_factors(&mut row);
                row
            })
            .collect()
    }

    fn sum(order: usize, batches: &[&[Vec<f64>]], sign: f64) -> ExactTiles {
        let mut tiles = ExactTiles::zeros(order);
        for batch in batches {
            let values: Vec<f64> = batch.concat();
            let a = ColumnBlock { values: &values, columns: batch.len(), stride: order };
            tiles.add_products(&Panels::new(a, order, sign));
        }
        tiles
    }

    #[test]
    fn factors_are_rounded_to_odd_steps() {
        for mut row in rows(301, 9, 1) {
            let before = row.clone();
            round_factors(&mut row);
            // Rounding is idempotent.
            assert_eq!(row, before);
            assert_eq!(row[0], 0.0);
            for factor in row.iter().skip(1) {
                let steps = factor * STEPS;
                assert!(steps == steps.round() && (steps as i64) % 2 != 0, "{factor}");
            }
        }
        let mut strange = [f64::NAN, f64::INFINITY, -1e300, 1e-300];
        round_factors(&mut strange);
        assert_eq!(strange[..3], [0.0; 3]);
        assert!(strange[3].abs() <= 1.0 / STEPS);
    }

    /// The sums have the same integers in any order and batches, and equal the sums of separately rounded products.
    #[test]
    fn sums_of_products_do_not_depend_on_order_or_batches() {
        let mut stream = random_stream(5, StreamKind::Probe, [1, 0]);
        for order in [5, 48, TILE - 1, TILE + 37] {
            let mut rows = rows(order, 40, order as u64);
            let whole = sum(order, &[&rows], 1.0);
            for (r, c) in [(0, 0), (order - 1, 0), (order / 2, order / 3), (order - 1, order - 1)] {
                let expected: i64 = rows.iter().map(|row| nearest(row[r], row[c])).sum();
                let found = whole.clone().into_values(1.0).get(r, c);
                assert_eq!(found, expected as f64, "({r}, {c}) of {order}");
            }
            for _ in 0..4 {
                rows.shuffle(&mut stream);
                let (first, second) = rows.split_at(stream.random_range(1..40));
                assert!(sum(order, &[first, second], 1.0) == whole);
                let mut merged = sum(order, &[second], 1.0);
                merged.combine(&sum(order, &[first], 1.0), Direction::In);
                assert!(merged == whole);
                merged.combine(&sum(order, &[second], 1.0), Direction::Out);
                merged.combine(&sum(order, &[first], -1.0), Direction::In);
                assert!(merged == ExactTiles::zeros(order));
            }
        }
    }

    /// The nearest whole number to a product of multiples of 2^-28, by integers.
    fn nearest(a: f64, b: f64) -> i64 {
        let product = (a * STEPS) as i128 * (b * STEPS) as i128;
        (product + (1 << 55)).div_euclid(1 << 56) as i64
    }

    /// The largest block of the maximum weight is within the range of the running sums.
    #[test]
    fn the_largest_block_does_not_overflow() {
        let mut row = vec![WEIGHT_QUANTA.sqrt(); 16];
        round_factors(&mut row);
        let rows = vec![row.clone(); BLOCK];
        let expected = BLOCK as i64 * nearest(row[0], row[0]);
        let found = sum(16, &[&rows], 1.0).columns().next().unwrap()[0];
        assert_eq!(found, expected);
        assert!(found < 1 << 50);
        // The maximum total is within the range of the integers.
        assert!(SCALES_MAX * WEIGHT_QUANTA < 2_f64.powi(63));
    }
}
