//! The sky in the frame of the orbital plane.
//!
//! With `alpha = Omega - pi/2` the coefficients of the sky rotated into the plane are
//!
//! ```text
//! t_{l mu}(alpha) = sum_m exp(-i m alpha) conj(T_lm) d^l_{m mu}(i)
//!                 = sum_{m>=0} d+_{m mu} Re z_m + i d-_{m mu} Im z_m,    z_m = conj(T_lm) exp(-i m alpha)
//! d+-_{m mu} = d^l_{m mu} +- (-1)^m d^l_{-m,mu}   (m > 0; at m = 0 both are d^l_{0 mu})
//! ```
//!
//! for a real sky, and `t_{l,-mu} = (-1)^mu conj(t_{l mu})`. Only even l + mu matter: patterns are
//! mirror-symmetric in the plane. For each l this is two real matrix products over many alpha.

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;
use rayon::prelude::*;

use crate::numerics::Real;
use crate::sky::harmonics::{Alm, WignerTable};

/// `d+` and `d-` for even l + mu, mu >= 0, by degree.
#[derive(Clone, Debug)]
pub struct RotationTable<T> {
    l_max: usize,
    /// By l: for each mu = l mod 2, +2, .. l a row m = 0 ..= l of d+; then likewise d-.
    degrees: Vec<Vec<T>>,
}

/// Orders computed before their values are copied into place.
const ORDERS_AT_ONCE: usize = 64;

impl<T: Real> RotationTable<T> {
    /// The table for `l <= l_max` and an orbit of this inclination.
    #[must_use]
    pub fn new(l_max: usize, inclination_rad: f64) -> Self {
        let wigner = WignerTable::new(l_max, inclination_rad);
        let mut degrees: Vec<Vec<T>> =
            (0..=l_max).map(|l| vec![T::default(); 2 * orders(l) * (l + 1)]).collect();
        for first in (0..=l_max).step_by(ORDERS_AT_ONCE) {
            let last = (first + ORDERS_AT_ONCE - 1).min(l_max);
            let columns: Vec<Vec<T>> =
                (first..=last).into_par_iter().map(|mu| folded_rows(&wigner, mu)).collect();
            degrees.par_iter_mut().enumerate().skip(first).for_each(|(l, degree)| {
                let half = orders(l) * (l + 1);
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
    /// Rotates degree l into the orbital plane at several alphas: writes `Re t_{l mu}` for all mu = l mod 2, + 2, .. of
    /// one alpha after another, then likewise `Im t_{l mu}`.
    ///
    /// `coefficient(m)` is `conj(T_lm)`; `turns` holds sine and cosine of m alpha, `[m][alpha]`; `z` is scratch, at
    /// least (l + 1) values an alpha each; `out` has two values for each alpha and mu.
    pub(crate) fn rotate_degree(
        &self,
        l: usize,
        coefficient: impl Fn(usize) -> Complex64,
        turns: &[(f64, f64)],
        z: [&mut [T]; 2],
        out: &mut [T],
    ) {
        let (rows, columns) = (orders(l), l + 1);
        let count = out.len() / (2 * rows);
        for m in 0..=l {
            let a = coefficient(m);
            for (k, (sin, cos)) in turns[m * count..(m + 1) * count].iter().enumerate() {
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

/// For l = mu, mu + 2, ..: d+ for m = 0 ..= l, then d-.
fn folded_rows<T: Real>(wigner: &WignerTable, mu: usize) -> Vec<T> {
    let mut folded = Vec::new();
    let mut rows = wigner.rows(mu);
    while let Some((l, row)) = rows.next_row() {
        if (l - mu) % 2 == 1 {
            continue;
        }
        for sign in [1.0, -1.0] {
            folded.push(T::table_entry(row[l]));
            for m in 1..=l {
                let parity = if m % 2 == 0 { sign } else { -sign };
                folded.push(T::table_entry(row[l + m] + parity * row[l - m]));
            }
        }
    }
    folded
}

/// Number of orders mu = l mod 2, + 2, .. l.
#[must_use]
pub fn orders(l: usize) -> usize {
    l / 2 + 1
}

impl<T> RotationTable<T> {
    /// Greatest degree.
    #[must_use]
    pub fn l_max(&self) -> usize {
        self.l_max
    }

    /// Rows over m = 0 ..= l, one for each mu = l mod 2, + 2, .. l: d+ and d-.
    #[must_use]
    pub fn degree(&self, l: usize) -> (&[T], &[T]) {
        self.degrees[l].split_at(orders(l) * (l + 1))
    }
}

/// `t_{l mu}(alpha)` at several alpha.
#[derive(Clone, Debug)]
pub(crate) struct RotatedSky<T> {
    /// By l: for each alpha the real parts at all mu = l mod 2, ..; then likewise the imaginary parts.
    degrees: Vec<Vec<T>>,
}

impl<T: Real> RotatedSky<T> {
    /// The sky `alm`, coefficients times `factor[m]`, at each of `alpha` (rad).
    pub(crate) fn new(table: &RotationTable<T>, alm: &Alm, factor: &[f64], alpha: &[f64]) -> Self {
        let turns: Vec<(f64, f64)> = (0..=table.l_max)
            .flat_map(|m| alpha.iter().map(move |alpha| (m as f64 * alpha).sin_cos()))
            .collect();
        let degrees = (0..=table.l_max)
            .into_par_iter()
            .map(|l| {
                let count = alpha.len();
                let mut z = [vec![T::default(); (l + 1) * count], vec![T::default(); (l + 1) * count]];
                let mut degree = vec![T::default(); 2 * orders(l) * count];
                let coefficient = |m: usize| alm.get(l, m).conj() * factor[m];
                table.rotate_degree(l, coefficient, &turns, z.each_mut().map(Vec::as_mut_slice), &mut degree);
                degree
            })
            .collect();
        Self { degrees }
    }

    /// Of degree l: alpha after alpha, the real (imaginary) parts at mu = l mod 2, + 2, ..
    pub(crate) fn degree(&self, l: usize) -> (&[T], &[T]) {
        let degree = &self.degrees[l];
        degree.split_at(degree.len() / 2)
    }
}
