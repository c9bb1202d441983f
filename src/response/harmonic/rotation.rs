//! The sky in the frame of the orbit's plane.
//!
//! With `alpha = Omega - pi/2` the coefficients of the sky turned into the plane are
//!
//! ```text
//! t_{l mu}(alpha) = sum_m exp(-i m alpha) conj(T_lm) d^l_{m mu}(i)
//!                 = sum_{m>=0} d+_{m mu} Re z_m + i d-_{m mu} Im z_m,    z_m = conj(T_lm) exp(-i m alpha)
//! d+-_{m mu} = d^l_{m mu} +- (-1)^m d^l_{-m,mu}   (m > 0; at m = 0 both are d^l_{0 mu})
//! ```
//!
//! for a real sky, and `t_{l,-mu} = (-1)^mu conj(t_{l mu})`. Only even l + mu meet a pattern that is
//! mirror-symmetric in the plane. For each l this is two real matrix products over many alpha at once.

use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

use super::real::Real;
use crate::sky::harmonics::{Alm, WignerTable};

/// `d+` and `d-` for even l + mu, mu >= 0, by degree.
#[derive(Clone, Debug)]
pub struct RotationTable<T> {
    l_max: usize,
    /// By l: for mu = l mod 2, +2, .. l a row m = 0 ..= l of d+; then the same of d-.
    degrees: Vec<Vec<T>>,
}

/// Orders of one parity that are computed between two copies into place.
const ORDERS_AT_ONCE: usize = 64;

impl<T: Real> RotationTable<T> {
    /// For `l <= l_max` and an orbit of this inclination.
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

/// For l = mu, mu + 2, ..: d+ for m = 0 ..= l, then d-.
fn folded_rows<T: Real>(wigner: &WignerTable, mu: usize) -> Vec<T> {
    let mut folded = Vec::new();
    let mut rows = wigner.rows(mu);
    while let Some((l, row)) = rows.next_row() {
        if (l - mu) % 2 == 1 {
            continue;
        }
        for sign in [1.0, -1.0] {
            folded.push(T::entry(row[l]));
            for m in 1..=l {
                let parity = if m % 2 == 0 { sign } else { -sign };
                folded.push(T::entry(row[l + m] + parity * row[l - m]));
            }
        }
    }
    folded
}

/// Number of mu = l mod 2, + 2, .. l.
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

    /// Rows over m = 0 ..= l for mu = l mod 2, + 2, .. l: d+ and d-.
    #[must_use]
    pub fn degree(&self, l: usize) -> (&[T], &[T]) {
        self.degrees[l].split_at(orders(l) * (l + 1))
    }
}

/// `t_{l mu}(alpha)` at some alpha.
#[derive(Clone, Debug)]
pub(crate) struct RotatedSky<T> {
    /// By l: for each alpha the real parts of all mu = l mod 2, ..; then the imaginary parts alike.
    degrees: Vec<Vec<T>>,
}

impl<T: Real> RotatedSky<T> {
    /// The sky `alm` times `factor[m]`, seen at each of `alpha` (rad).
    pub(crate) fn new(table: &RotationTable<T>, alm: &Alm, factor: &[f64], alpha: &[f64]) -> Self {
        let turns: Vec<(f64, f64)> = (0..=table.l_max)
            .flat_map(|m| alpha.iter().map(move |alpha| (m as f64 * alpha).sin_cos()))
            .collect();
        let degrees = (0..=table.l_max)
            .into_par_iter()
            .map(|l| {
                let count = alpha.len();
                let mut z = [vec![T::default(); (l + 1) * count], vec![T::default(); (l + 1) * count]];
                for m in 0..=l {
                    let a = alm.get(l, m).conj() * factor[m];
                    for (k, (sin, cos)) in turns[m * count..(m + 1) * count].iter().enumerate() {
                        z[0][k * (l + 1) + m] = T::of(a.re * cos + a.im * sin);
                        z[1][k * (l + 1) + m] = T::of(a.im * cos - a.re * sin);
                    }
                }
                let (plus, minus) = table.degree(l);
                let mut degree = vec![T::default(); 2 * orders(l) * count];
                let (re, im) = degree.split_at_mut(orders(l) * count);
                for (out, d, z) in [(re, plus, &z[0]), (im, minus, &z[1])] {
                    faer::linalg::matmul::matmul(
                        MatMut::from_column_major_slice_mut(out, orders(l), count),
                        Accum::Replace,
                        MatRef::from_row_major_slice(d, orders(l), l + 1),
                        MatRef::from_column_major_slice(z, l + 1, count),
                        T::of(1.0),
                        Par::Seq,
                    );
                }
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
