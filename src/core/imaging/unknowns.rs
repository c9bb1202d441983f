//! Unknowns of maps over spherical harmonics: real numbers, by order and then degree.

use crate::sky::harmonics::Alm;

/// The degree of each unknown, in order.
pub fn degrees(l_max: usize) -> impl Iterator<Item = usize> {
    degrees_orders_parts(l_max).map(|(l, ..)| l)
}

/// Degree, order and part of each unknown, in order.
pub(in crate::imaging) fn degrees_orders_parts(l_max: usize) -> impl Iterator<Item = (usize, usize, usize)> {
    let parts = |m: usize| 0..if m == 0 { 1 } else { 2 };
    let of_order = move |m: usize| (m..=l_max).flat_map(move |l| parts(m).map(move |part| (l, m, part)));
    (0..=l_max).flat_map(of_order)
}

/// The index of an unknown among those of a map.
pub(in crate::imaging) fn index_of(l_max: usize, l: usize, m: usize, part: usize) -> usize {
    // Before order m are l_max + 1 unknowns of order 0, and 2 (l_max + 1 - k) of each order k below m.
    if m == 0 { l } else { (l_max + 1) * (2 * m - 1) - m * (m - 1) + 2 * (l - m) + part }
}

/// Converts a vector of unknowns to coefficients; missing ones are zero.
#[must_use]
pub fn coefficients(unknowns: &[f64], l_max: usize) -> Alm {
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let mut alm = Alm::zeros(l_max);
    let (zonal, rest) = unknowns.split_at(unknowns.len().min(l_max + 1));
    let values = alm.values_mut();
    for (value, x) in values.iter_mut().zip(zonal) {
        value.re = *x;
    }
    for (value, x) in values[l_max + 1..].iter_mut().zip(rest.as_chunks::<2>().0) {
        value.re = half * x[0];
        value.im = half * x[1];
    }
    alm
}

/// Converts coefficients to a vector of unknowns.
#[must_use]
pub fn unknowns(alm: &Alm) -> Vec<f64> {
    scaled(alm, std::f64::consts::SQRT_2)
}

/// Converts a gradient with respect to `Re T_lm` and `Im T_lm` to one with respect to the unknowns.
#[must_use]
pub fn unknowns_of_gradient(gradient: &Alm) -> Vec<f64> {
    scaled(gradient, std::f64::consts::FRAC_1_SQRT_2)
}

fn scaled(alm: &Alm, factor: f64) -> Vec<f64> {
    let (zonal, rest) = alm.values().split_at(alm.l_max() + 1);
    let rest = rest.iter().flat_map(|value| [factor * value.re, factor * value.im]);
    zonal.iter().map(|value| value.re).chain(rest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn indices_follow_the_order_of_unknowns() {
        for l_max in [0, 1, 5] {
            let indices = degrees_orders_parts(l_max).map(|(l, m, part)| index_of(l_max, l, m, part));
            assert!(indices.eq(0..(l_max + 1).pow(2)));
        }
    }
}
