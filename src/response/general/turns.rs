//! Rotations of many skies by any Euler angles, as products with one table.
//!
//! `R = Rz(alpha) Ry(beta) Rz(gamma) = Rz(alpha + pi/2) Ry(pi/2) Rz(beta + pi) Ry(pi/2) Rz(gamma + pi/2)`: with the phases
//! between them, two products with the constant `d^l_{m k}(pi/2)` rotate to any angle. For a real sky only orders >= 0 are
//! kept; with `d_{-m,k}(pi/2) = (-1)^(l+k) d_{m k}(pi/2)`,
//!
//! ```text
//! Re b_k = sum_{m = l+k mod 2} F_{m k} Re z_m,   Im b_k = sum_{m != l+k mod 2} F_{m k} Im z_m,   F = 2 d (d for m = 0)
//! ```
//!
//! Vectors of degree l hold the even orders first, then the odd ones. Matrices of them are row-major: orders by vectors.

use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

use super::lanes::Value;
use crate::sky::harmonics::WignerTable;

/// `F^l_{m k}` for all l.
#[derive(Clone, Debug)]
pub(super) struct QuarterTurns {
    /// By l: for parities of k and of m a block of rows k and columns m, column-major.
    degrees: Vec<[[Vec<Value>; 2]; 2]>,
}

/// Orders 0 ..= l of this parity.
pub(super) fn count(l: usize, parity: usize) -> usize {
    (l + 2 - parity) / 2
}

/// Place of order m in a vector of degree l.
pub(super) fn place(l: usize, m: usize) -> usize {
    if m.is_multiple_of(2) { m / 2 } else { count(l, 0) + m / 2 }
}

impl QuarterTurns {
    pub(super) fn new(l_max: usize) -> Self {
        let wigner = WignerTable::new(l_max, std::f64::consts::FRAC_PI_2);
        let block = |l: usize, k: usize, m: usize| vec![0.0; count(l, k) * count(l, m)];
        let mut degrees: Vec<[[Vec<Value>; 2]; 2]> =
            (0..=l_max).map(|l| [0, 1].map(|k| [0, 1].map(|m| block(l, k, m)))).collect();
        let columns: Vec<Vec<Vec<f64>>> = (0..=l_max)
            .into_par_iter()
            .map(|k| {
                let mut rows = wigner.rows(k);
                let mut column = Vec::new();
                while let Some((l, row)) = rows.next_row() {
                    column.push(row[l..].to_vec());
                }
                column
            })
            .collect();
        for (k, column) in columns.iter().enumerate() {
            for (l, row) in (k..=l_max).zip(column) {
                for (m, d) in row.iter().enumerate() {
                    let rows = count(l, k % 2);
                    let factor = if m == 0 { 1.0 } else { 2.0 };
                    degrees[l][k % 2][m % 2][m / 2 * rows + k / 2] = (factor * d) as Value;
                }
            }
        }
        Self { degrees }
    }

    /// Greatest degree.
    pub(super) fn l_max(&self) -> usize {
        self.degrees.len().saturating_sub(1)
    }

    /// Turns vectors of degree l by a quarter, given by real and imaginary parts. Writes orders of the parities in `parities` and
    /// leaves others as they are.
    pub(super) fn turn(&self, l: usize, parities: &[usize], from: [&[Value]; 2], to: [&mut [Value]; 2]) {
        let columns = from[0].len() / (l + 1);
        for (part, (from, to)) in from.into_iter().zip(to).enumerate() {
            let from = MatRef::from_row_major_slice(from, l + 1, columns);
            let mut to = MatMut::from_row_major_slice_mut(to, l + 1, columns);
            for &k in parities {
                let m = (l + k + part) % 2;
                let (rows, inner) = (count(l, k), count(l, m));
                if rows == 0 || inner == 0 {
                    continue;
                }
                let table = MatRef::from_column_major_slice(&self.degrees[l][k][m], rows, inner);
                multiply(
                    to.as_mut().subrows_mut(first(l, k), rows),
                    table,
                    from.subrows(first(l, m), inner),
                    Accum::Replace,
                );
            }
        }
    }

    /// Turns functions that are mirror-symmetric in a plane through the pole, given by real coefficients of degree l, `[m][column]`, to the
    /// orders k of even l + k about that plane's normal, `[k][column]`: from even m, and from odd m. Their sum is order k, their
    /// difference `(-1)^k` times order -k.
    pub(super) fn fold(&self, l: usize, from: &[Value], columns: usize, to: &mut [Vec<Value>; 2]) {
        let rows = count(l, l % 2);
        for (parity, to) in to.iter_mut().enumerate() {
            to.clear();
            to.resize(rows * columns, 0.0);
            let inner = count(l, parity);
            if inner == 0 {
                continue;
            }
            let from = &from[parity * columns..][..(inner - 1) * 2 * columns + columns];
            multiply(
                MatMut::from_row_major_slice_mut(to, rows, columns),
                MatRef::from_column_major_slice(&self.degrees[l][l % 2][parity], rows, inner),
                MatRef::from_row_major_slice_with_stride(from, inner, columns, 2 * columns),
                Accum::Replace,
            );
        }
    }

    /// The transpose of [`Self::turn`]: from gradients of its output, of which those of `parities` count, to gradients of
    /// its input.
    pub(super) fn turn_back(&self, l: usize, parities: &[usize], from: [&[Value]; 2], to: [&mut [Value]; 2]) {
        let columns = from[0].len() / (l + 1);
        for (part, (from, to)) in from.into_iter().zip(to).enumerate() {
            to.fill(0.0);
            let from = MatRef::from_row_major_slice(from, l + 1, columns);
            let mut to = MatMut::from_row_major_slice_mut(to, l + 1, columns);
            for &k in parities {
                let m = (l + k + part) % 2;
                let (rows, inner) = (count(l, k), count(l, m));
                if rows == 0 || inner == 0 {
                    continue;
                }
                let table = MatRef::from_column_major_slice(&self.degrees[l][k][m], rows, inner);
                multiply(
                    to.as_mut().subrows_mut(first(l, m), inner),
                    table.transpose(),
                    from.subrows(first(l, k), rows),
                    Accum::Add,
                );
            }
        }
    }
}

/// A matrix to be written whose rows begin `stride` apart. (faer's own constructor of this kind confuses the strides, in 0.24.4.)
pub(super) fn rows_apart_mut(
    slice: &mut [Value],
    rows: usize,
    columns: usize,
    stride: usize,
) -> MatMut<'_, Value> {
    MatMut::from_column_major_slice_with_stride_mut(slice, columns, rows, stride).transpose_mut()
}

/// Place of the first order of this parity.
fn first(l: usize, parity: usize) -> usize {
    if parity == 0 { 0 } else { count(l, 0) }
}

fn multiply(to: MatMut<'_, Value>, a: MatRef<'_, Value>, b: MatRef<'_, Value>, accum: Accum) {
    faer::linalg::matmul::matmul(to, accum, a, b, 1.0, Par::Seq);
}
