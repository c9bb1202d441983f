//! Bessel functions of many orders, for several arguments at a time.
//!
//! `J_n(x)` and `j_n(x)` obey `f_{n+1} = (2 n + s) / x f_n - f_{n-1}` with s = 0 and 1. Forward recurrence from the first two orders is
//! stable while n <= x. Beyond, f_n falls and errors would grow, so the ratios `f_n / f_{n-1}` come from backward recurrence.

use std::f64::consts::PI;

use super::trigonometry::sin_cos;

/// Arguments that are computed together.
pub(crate) const LANES: usize = 8;

/// One number for each argument.
pub(crate) type Lanes = [f64; LANES];

/// Smallest argument for which Hankel's asymptotic series is exact to rounding.
const HANKEL_X_MIN: f64 = 30.0;

/// Intervals of the trapezoidal rule over a quarter of the circle, for smaller arguments: its error is `J_64(30)`, 1e-14.
const QUARTER_INTERVALS: usize = 16;

/// Orders above the last requested one, or above the turning point n = x, over which the error of the backward recurrence's start decays.
const START_MARGIN: usize = 40;

/// Evaluates orders 0, 1, .. for [`LANES`] arguments.
#[derive(Clone, Debug, Default)]
pub(crate) struct BesselOrders {
    values: Vec<Lanes>,
}

impl BesselOrders {
    /// `J_n(x)`, n = 0 ..= `order_max`, for x >= 0.
    pub(crate) fn cylindrical(&mut self, x: &Lanes, order_max: usize) -> &[Lanes] {
        let start = if x.iter().all(|x| *x >= HANKEL_X_MIN) {
            hankel(x)
        } else {
            let mut start = [[0.0; LANES]; 2];
            for k in 0..LANES {
                let [zero, one] = if x[k] >= HANKEL_X_MIN { hankel_one(x[k]) } else { by_quadrature(x[k]) };
                (start[0][k], start[1][k]) = (zero, one);
            }
            start
        };
        self.fill(x, 0.0, start, order_max)
    }

    /// `j_n(x)`, n = 0 ..= `order_max`, for x > 0.
    pub(crate) fn spherical(&mut self, x: &Lanes, order_max: usize) -> &[Lanes] {
        let mut start = [[0.0; LANES]; 2];
        for k in 0..LANES {
            let (sin, cos) = x[k].sin_cos();
            start[0][k] = sin / x[k];
            // The series where the two terms would cancel: its next term is below 1e-13 of the first.
            let square = x[k] * x[k];
            start[1][k] = if x[k] < 0.03 {
                x[k] / 3.0 * (1.0 - square / 10.0 * (1.0 - square / 28.0))
            } else {
                (sin / x[k] - cos) / x[k]
            };
        }
        self.fill(x, 1.0, start, order_max)
    }

    fn fill(&mut self, x: &Lanes, shift: f64, start: [Lanes; 2], order_max: usize) -> &[Lanes] {
        // Backward recurrence is needed only for arguments below the largest requested order.
        let small = x.iter().filter(|x| **x < (order_max + 1) as f64);
        let start_order = small.map(|x| order_max.max((x + 10.0 * x.cbrt()) as usize) + START_MARGIN).max();
        let start_order = start_order.unwrap_or(order_max).max(1);
        if self.values.len() <= start_order {
            self.values.resize(start_order + 1, [0.0; LANES]);
        }
        recurrence(x, shift, &start, &mut self.values[..=start_order], order_max);
        &self.values[..=order_max]
    }
}

/// `J_0` and `J_1` (DLMF 10.17.3): the terms of the series fall to 1e-17 of the first.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn hankel(x: &Lanes) -> [Lanes; 2] {
    let mut out = [[0.0; LANES]; 2];
    for k in 0..LANES {
        let [zero, one] = hankel_one(x[k]);
        (out[0][k], out[1][k]) = (zero, one);
    }
    out
}

#[inline(always)]
fn hankel_one(x: f64) -> [f64; 2] {
    let inverse = 1.0 / (8.0 * x);
    let scale = (2.0 / (PI * x)).sqrt();
    [0.0, 1.0].map(|order: f64| {
        let (mut p, mut q, mut term) = (0.0, 0.0, 1.0);
        for k in 0..16_u32 {
            // i^k: P takes the even terms, Q the odd ones, with alternating signs.
            let sign = if k % 4 < 2 { 1.0 } else { -1.0 };
            if k % 2 == 0 {
                p += sign * term;
            } else {
                q += sign * term;
            }
            let odd = f64::from(2 * k + 1);
            term *= (4.0 * order * order - odd * odd) / f64::from(k + 1) * inverse;
        }
        let (sin, cos) = sin_cos(x - (0.5 * order + 0.25) * PI);
        scale * (p * cos - q * sin)
    })
}

/// `J_0` and `J_1` as means of `cos(x sin psi)` and `sin(x sin psi) sin psi` over the circle.
fn by_quadrature(x: f64) -> [f64; 2] {
    let mut sums = [0.0; 2];
    for k in 0..=QUARTER_INTERVALS {
        let end = if k == 0 || k == QUARTER_INTERVALS { 0.5 } else { 1.0 };
        let (slope, _) = sin_cos(0.5 * PI * k as f64 / QUARTER_INTERVALS as f64);
        let (sin, cos) = sin_cos(x * slope);
        sums[0] += end * cos;
        sums[1] += end * sin * slope;
    }
    sums.map(|sum| sum / QUARTER_INTERVALS as f64)
}

/// Fills `values[n]`: first ratios by backward recurrence down to n <= x for all lanes, then values by forward recurrence.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn recurrence(x: &Lanes, shift: f64, start: &[Lanes; 2], values: &mut [Lanes], order_max: usize) {
    let x_min = x.iter().fold(f64::INFINITY, |x_min, x| x_min.min(*x)) as usize;
    let mut ratio = [0.0; LANES];
    for n in (x_min.max(1) + 1..values.len()).rev() {
        for k in 0..LANES {
            ratio[k] = x[k] / ((2 * n) as f64 + shift - x[k] * ratio[k]);
        }
        values[n] = ratio;
    }
    let mut inverse = [0.0; LANES];
    for k in 0..LANES {
        inverse[k] = if x[k] >= 1.0 { 1.0 / x[k] } else { 0.0 };
    }
    let [mut before, mut now] = *start;
    values[0] = before;
    values[1] = now;
    for (n, value) in values.iter_mut().enumerate().take(order_max + 1).skip(2) {
        let factor = (2 * (n - 1)) as f64 + shift;
        let order = n as f64;
        for k in 0..LANES {
            let forward = factor * inverse[k] * now[k] - before[k];
            let from_ratio = value[k] * now[k];
            before[k] = now[k];
            now[k] = if order <= x[k] { forward } else { from_ratio };
        }
        *value = now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numerics::quadrature::GaussLegendre;

    const XS: [f64; 16] = [
        1e-6,
        0.02,
        0.031,
        0.7,
        1.0,
        2.404_825_557_695_773,
        3.7,
        11.0,
        19.5,
        29.99,
        30.01,
        64.0,
        64.5,
        140.0,
        400.3,
        800.0,
    ];

    /// Bessel's integral over half a turn.
    #[test]
    fn cylindrical_functions_are_bessels_integrals() {
        let rule = GaussLegendre::new(900);
        for first in 0..XS.len() {
            let x: Lanes = std::array::from_fn(|k| XS[(first + 5 * k) % XS.len()]);
            for order_max in [0, 1, 5, 70, 200] {
                let mut orders = BesselOrders::default();
                let found = orders.cylindrical(&x, order_max).to_vec();
                assert_eq!(found.len(), order_max + 1);
                for (n, found) in found.iter().enumerate().step_by(7) {
                    for (x, found) in x.iter().zip(found) {
                        let value = |t: f64| (n as f64 * PI * t - x * (PI * t).sin()).cos();
                        let sum: f64 =
                            rule.abscissae.iter().zip(&rule.weights).map(|(t, w)| w * value(*t)).sum();
                        // Rounding of phases of up to 800 rad, in about 800 recurrence steps.
                        assert!((found - sum).abs() < 1e-12, "J_{n}({x}): {found} {sum}");
                    }
                }
            }
        }
    }

    /// Poisson's: `j_n(x) = (-i)^n / 2 Int_-1^1 exp(i x z) P_n(z) dz`.
    #[test]
    fn spherical_functions_are_poissons_integrals() {
        let rule = GaussLegendre::new(900);
        for first in 0..XS.len() {
            let x: Lanes = std::array::from_fn(|k| XS[(first + 5 * k) % XS.len()]);
            for order_max in [0, 1, 5, 70, 200] {
                let mut orders = BesselOrders::default();
                let found = orders.spherical(&x, order_max).to_vec();
                let mut sums = vec![[0.0; LANES]; order_max + 1];
                for (t, w) in rule.abscissae.iter().zip(&rule.weights) {
                    let z = 2.0 * t - 1.0;
                    let (mut before, mut now) = (0.0, 1.0);
                    for (n, sums) in sums.iter_mut().enumerate() {
                        for (sum, x) in sums.iter_mut().zip(&x) {
                            let phase = x * z - 0.5 * PI * n as f64;
                            *sum += w * now * phase.cos();
                        }
                        let n = n as f64;
                        (before, now) = (now, ((2.0 * n + 1.0) * z * now - n * before) / (n + 1.0));
                    }
                }
                for (n, (found, sums)) in found.iter().zip(&sums).enumerate() {
                    for ((x, found), sum) in x.iter().zip(found).zip(sums) {
                        assert!((found - sum).abs() < 1e-12, "j_{n}({x}): {found} {sum}");
                    }
                }
            }
        }
    }
}
