//! Rotations of many skies by any Euler angles, as products with one constant table.
//!
//! As `R = Rz(alpha) Ry(beta) Rz(gamma) = Rz(alpha + pi/2) Ry(pi/2) Rz(beta + pi) Ry(pi/2) Rz(gamma + pi/2)`, two products with the
//! constant `d^l_{m k}(pi/2)` and phases between them rotate by any angles. For a real sky only orders >= 0 are
//! kept; with `d_{-m,k}(pi/2) = (-1)^(l+k) d_{m k}(pi/2)`,
//!
//! ```text
//! Re b_k = sum_{m = l+k mod 2} F_{m k} Re z_m,   Im b_k = sum_{m != l+k mod 2} F_{m k} Im z_m,   F = 2 d (d for m = 0)
//! ```
//!
//! Vectors of degree l have the even orders first, then the odd ones. Matrices of such vectors are row-major: orders by vectors.

use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

use super::lanes::Value;
use crate::sky::harmonics::WignerTable;

/// Table of `F^l_{m k}` for all l.
#[derive(Clone, Debug)]
pub(super) struct QuarterTurns {
    /// By l, for each parity of k and of m a block of rows k and columns m, column-major.
    degrees: Vec<[[Vec<Value>; 2]; 2]>,
}

/// Number of orders 0 ..= l of this parity.
pub(super) fn parity_count(l: usize, parity: usize) -> usize {
    (l + 2 - parity) / 2
}

/// Index of order m in a vector of degree l.
pub(super) fn order_index(l: usize, m: usize) -> usize {
    if m.is_multiple_of(2) { m / 2 } else { parity_count(l, 0) + m / 2 }
}

impl QuarterTurns {
    pub(super) fn new(l_max: usize) -> Self {
        let wigner = WignerTable::new(l_max, std::f64::consts::FRAC_PI_2);
        let block = |l: usize, k: usize, m: usize| vec![0.0; parity_count(l, k) * parity_count(l, m)];
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
                    let rows = parity_count(l, k % 2);
                    let factor = if m == 0 { 1.0 } else { 2.0 };
                    degrees[l][k % 2][m % 2][m / 2 * rows + k / 2] = (factor * d) as Value;
                }
            }
        }
        Self { degrees }
    }

    pub(super) fn l_max(&self) -> usize {
        self.degrees.len().saturating_sub(1)
    }

    /// Rotates vectors of degree l, given by real and imaginary parts, by a quarter turn. Only orders of the parities in `parities`
    /// are written.
    pub(super) fn rotate(&self, l: usize, parities: &[usize], from: [&[Value]; 2], to: [&mut [Value]; 2]) {
        self.for_each_table(l, parities, from, to, |table, from, mut to, [k, m]| {
            let (rows, inner) = (parity_count(l, k), parity_count(l, m));
            let from = from.subrows(first_of_parity(l, m), inner);
            multiply(to.as_mut().subrows_mut(first_of_parity(l, k), rows), table, from, Accum::Replace);
        });
    }

    /// Calls `apply` for real and imaginary parts with the table of orders of parity m to those of each parity k, and [k, m].
    fn for_each_table(
        &self,
        l: usize,
        parities: &[usize],
        from: [&[Value]; 2],
        to: [&mut [Value]; 2],
        apply: impl Fn(MatRef<'_, Value>, MatRef<'_, Value>, MatMut<'_, Value>, [usize; 2]),
    ) {
        let columns = from[0].len() / (l + 1);
        for (part, (from, to)) in from.into_iter().zip(to).enumerate() {
            let from = MatRef::from_row_major_slice(from, l + 1, columns);
            let mut to = MatMut::from_row_major_slice_mut(to, l + 1, columns);
            for &k in parities {
                let m = (l + k + part) % 2;
                let (rows, inner) = (parity_count(l, k), parity_count(l, m));
                if rows > 0 && inner > 0 {
                    let table = MatRef::from_column_major_slice(&self.degrees[l][k][m], rows, inner);
                    apply(table, from, to.as_mut(), [k, m]);
                }
            }
        }
    }

    /// Rotates functions that are mirror-symmetric in a plane through the pole by a quarter turn, to the plane's normal as the pole.
    ///
    /// They are given by real coefficients of degree l, `[m][column]`. The results are the contributions of even and of odd m to the
    /// orders k with even l + k, `[k][column]`: their sum is order k, their difference `(-1)^k` times order -k.
    pub(super) fn rotate_symmetric(
        &self,
        l: usize,
        from: &[Value],
        columns: usize,
        to: &mut [Vec<Value>; 2],
    ) {
        let rows = parity_count(l, l % 2);
        for (parity, to) in to.iter_mut().enumerate() {
            to.clear();
            to.resize(rows * columns, 0.0);
            let inner = parity_count(l, parity);
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

    /// Computes gradients with respect to the input of [`Self::rotate`] from gradients with respect to the orders of `parities` of its
    /// output.
    pub(super) fn rotate_transposed(
        &self,
        l: usize,
        parities: &[usize],
        from: [&[Value]; 2],
        to: [&mut [Value]; 2],
    ) {
        let [re, im] = to;
        re.fill(0.0);
        im.fill(0.0);
        self.for_each_table(l, parities, from, [re, im], |table, from, mut to, [k, m]| {
            let (rows, inner) = (parity_count(l, k), parity_count(l, m));
            let from = from.subrows(first_of_parity(l, k), rows);
            let to = to.as_mut().subrows_mut(first_of_parity(l, m), inner);
            multiply(to, table.transpose(), from, Accum::Add);
        });
    }
}

/// Returns a mutable matrix whose rows begin `stride` apart. (faer's own constructor confuses the strides, in 0.24.4.)
pub(super) fn strided_rows_mut(
    slice: &mut [Value],
    rows: usize,
    columns: usize,
    stride: usize,
) -> MatMut<'_, Value> {
    MatMut::from_column_major_slice_with_stride_mut(slice, columns, rows, stride).transpose_mut()
}

/// Index of the first order of this parity in a vector of degree l.
fn first_of_parity(l: usize, parity: usize) -> usize {
    if parity == 0 { 0 } else { parity_count(l, 0) }
}

fn multiply(to: MatMut<'_, Value>, a: MatRef<'_, Value>, b: MatRef<'_, Value>, accum: Accum) {
    faer::linalg::matmul::matmul(to, accum, a, b, 1.0, Par::Seq);
}
