//! Rotation of the sky into the frame of the orbital plane.
//!
//! With `alpha = Omega - pi/2` the coefficients of the sky rotated into the plane are
//!
//! ```text
//! t_{l mu}(alpha) = sum_m exp(-i m alpha) conj(T_lm) d^l_{m mu}(i)
//!                 = sum_{m>=0} d+_{m mu} Re z_m + i d-_{m mu} Im z_m,    z_m = conj(T_lm) exp(-i m alpha)
//! d+-_{m mu} = d^l_{m mu} +- (-1)^m d^l_{-m,mu}   (m > 0; at m = 0 both are d^l_{0 mu})
//! ```
//!
//! for a real sky, and `t_{l,-mu} = (-1)^mu conj(t_{l mu})`. Only even l + mu are needed, because patterns are
//! mirror-symmetric in the plane. For each l the rotation is two real matrix products over many alpha.

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;
use rayon::prelude::*;

use crate::numerics::Real;
use crate::sky::harmonics::{Alm, WignerTable};

/// Table of `d+` and `d-` for even l + mu and mu >= 0, by degree.
#[derive(Clone, Debug)]
pub struct RotationTable<T> {
    l_max: usize,
    /// By l: rows over m = 0 ..= l of d+ for mu = l mod 2, + 2, .. l, then the same rows of d-.
    degrees: Vec<Vec<T>>,
}

/// Orders that are computed before their values are copied into the table.
const ORDERS_AT_ONCE: usize = 64;

impl<T: Real> RotationTable<T> {
    /// Computes the table for `l <= l_max` and an orbit of this inclination.
    #[must_use]
    pub fn new(l_max: usize, inclination_rad: f64) -> Self {
        let wigner = WignerTable::new(l_max, inclination_rad);
        let mut degrees: Vec<Vec<T>> =
            (0..=l_max).map(|l| vec![T::default(); 2 * order_count(l) * (l + 1)]).collect();
        for first in (0..=l_max).step_by(ORDERS_AT_ONCE) {
            let last = (first + ORDERS_AT_ONCE - 1).min(l_max);
            let columns: Vec<Vec<T>> =
                (first..=last).into_par_iter().map(|mu| sum_and_difference_rows(&wigner, mu)).collect();
            degrees.par_iter_mut().enumerate().skip(first).for_each(|(l, degree)| {
                let half = order_count(l) * (l + 1);
                for (mu, column) in (first..=last.min(l)).zip(&columns).filter(|(mu, _)| (l - mu) % 2 == 0) {
                    // Rows of l = mu, mu + 2, ..: 2 (l + 1) values each.
                    let start = (mu..l).step_by(2).map(|l| 2 * (l + 1)).sum::<usize>();
                    let (plus, minus) = column[start..start + 2 * (l + 1)].split_at(l + 1);
                    let place = mu / 2 * (l + 1);
                    degree[place..place + l + 1].copy_from_slice(plus);
                    degree[half + place..half + place + l + 1].copy_from_slice(minus);
                }
            });
        }
        Self { l_max, degrees }
    }
}

impl<T: Real> RotationTable<T> {
    /// Rotates degree l into the orbital plane at several alphas: writes `Re t_{l mu}` as `[alpha][mu]` for
    /// mu = l mod 2, + 2, .., then `Im t_{l mu}` in the same order.
    ///
    /// `coefficient(m)` is `conj(T_lm)`; `sin_cos` holds sine and cosine of m alpha, `[m][alpha]`; both parts of `z` are work
    /// buffers of at least (l + 1) values per alpha; `out` has two values for each alpha and mu.
    pub(crate) fn rotate_degree(
        &self,
        l: usize,
        coefficient: impl Fn(usize) -> Complex64,
        sin_cos: &[(f64, f64)],
        z: [&mut [T]; 2],
        out: &mut [T],
    ) {
        let (rows, columns) = (order_count(l), l + 1);
        let count = out.len() / (2 * rows);
        for m in 0..=l {
            let a = coefficient(m);
            for (k, (sin, cos)) in sin_cos[m * count..(m + 1) * count].iter().enumerate() {
                z[0][k * columns + m] = T::nearest(a.re * cos + a.im * sin);
                z[1][k * columns + m] = T::nearest(a.im * cos - a.re * sin);
            }
        }
        let (plus, minus) = self.degree(l);
        let (re, im) = out.split_at_mut(rows * count);
        for (out, d, z) in [(re, plus, &*z[0]), (im, minus, &*z[1])] {
            faer::linalg::matmul::matmul(
                MatMut::from_column_major_slice_mut(out, rows, count),
                Accum::Replace,
                MatRef::from_row_major_slice(d, rows, columns),
                MatRef::from_column_major_slice(&z[..columns * count], columns, count),
                T::nearest(1.0),
                Par::Seq,
            );
        }
    }
}

/// Computes for l = mu, mu + 2, .. the values of d+ for m = 0 ..= l, then those of d-.
fn sum_and_difference_rows<T: Real>(wigner: &WignerTable, mu: usize) -> Vec<T> {
    let mut values = Vec::new();
    let mut rows = wigner.rows(mu);
    while let Some((l, row)) = rows.next_row() {
        if (l - mu) % 2 == 1 {
            continue;
        }
        for sign in [1.0, -1.0] {
            values.push(T::table_entry(row[l]));
            for m in 1..=l {
                let parity = if m % 2 == 0 { sign } else { -sign };
                values.push(T::table_entry(row[l + m] + parity * row[l - m]));
            }
        }
    }
    values
}

/// Number of orders mu = l mod 2, + 2, .. l at degree l.
#[must_use]
pub fn order_count(l: usize) -> usize {
    l / 2 + 1
}

impl<T> RotationTable<T> {
    /// Maximum degree.
    #[must_use]
    pub fn l_max(&self) -> usize {
        self.l_max
    }

    /// Returns d+ and d- of degree l: rows over m = 0 ..= l, one for each mu = l mod 2, + 2, .. l.
    #[must_use]
    pub fn degree(&self, l: usize) -> (&[T], &[T]) {
        self.degrees[l].split_at(order_count(l) * (l + 1))
    }
}

/// Coefficients `t_{l mu}(alpha)` of the rotated sky at several alpha.
#[derive(Clone, Debug)]
pub(crate) struct RotatedSky<T> {
    /// By l: real parts as `[alpha][mu]` for mu = l mod 2, .., then imaginary parts.
    degrees: Vec<Vec<T>>,
}

impl<T: Real> RotatedSky<T> {
    /// Rotates the sky `alm`, with its coefficients multiplied by `factor[m]`, to each of `alpha` (rad).
    pub(crate) fn new(table: &RotationTable<T>, alm: &Alm, factor: &[f64], alpha: &[f64]) -> Self {
        let sin_cos: Vec<(f64, f64)> = (0..=table.l_max)
            .flat_map(|m| alpha.iter().map(move |alpha| (m as f64 * alpha).sin_cos()))
            .collect();
        let degrees = (0..=table.l_max)
            .into_par_iter()
            .map(|l| {
                let count = alpha.len();
                let mut z = [vec![T::default(); (l + 1) * count], vec![T::default(); (l + 1) * count]];
                let mut degree = vec![T::default(); 2 * order_count(l) * count];
                let coefficient = |m: usize| alm.get(l, m).conj() * factor[m];
                table.rotate_degree(
                    l,
                    coefficient,
                    &sin_cos,
                    z.each_mut().map(Vec::as_mut_slice),
                    &mut degree,
                );
                degree
            })
            .collect();
        Self { degrees }
    }

    /// Returns the real and the imaginary parts of degree l, each as `[alpha][mu]` for mu = l mod 2, + 2, ..
    pub(crate) fn degree(&self, l: usize) -> (&[T], &[T]) {
        let degree = &self.degrees[l];
        degree.split_at(degree.len() / 2)
    }
}
