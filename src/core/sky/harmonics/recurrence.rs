//! The recurrence of normalised Legendre functions, in steps of two degrees.
//!
//! With eps_l = sqrt((l^2 - m^2) / (4 l^2 - 1)) the orthonormal functions p_l (Y_lm = p_l(theta) e^{i m phi})
//! obey x p_l = eps_{l+1} p_{l+1} + eps_l p_{l-1}, x = cos theta. Applied twice, this links degrees l - 2, l, l + 2
//! by x^2 only, so that only every other function has to be computed, and a ring and its mirror image have the
//! same functions. The functions in between follow from the same relation: a sum over them is x
//! times a sum over the computed functions with other coefficients. This halving, and the scaling that reduces a
//! step to two multiply-adds, follow Reinecke & Seljebotn 2013 (libsharp) and Ishioka 2018.

use num_complex::Complex64;
use std::f64::consts::PI;

/// Tables of one order m; computed function j has degree m + 2 j.
pub(super) struct Order {
    pub m: usize,
    /// Factor of the first function, p_m = `start` (sin theta)^m.
    pub start: f64,
    /// Coefficients `[A_j, B_j]` of the recurrence q_{j+1} = (A_j x^2 + B_j) q_j + q_{j-1}.
    pub steps: Vec<[f64; 2]>,
    /// Scale of each function, p_{m+2j} = `scale[j]` q_j.
    scale: Vec<f64>,
    /// Coefficients `[eps_{m+2j}, 1 / eps_{m+2j+1}]` for the functions in between.
    between: Vec<[f64; 2]>,
}

pub(super) fn all_orders(l_max: usize) -> Vec<Order> {
    use rayon::prelude::*;
    let mut start = (0.25 / PI).sqrt();
    let mut starts = vec![start];
    for m in 1..=l_max {
        let m = m as f64;
        start *= -((2.0 * m + 1.0) / (2.0 * m)).sqrt();
        starts.push(start);
    }
    starts.into_par_iter().enumerate().map(|(m, start)| Order::new(m, start, l_max)).collect()
}

impl Order {
    fn new(m: usize, start: f64, l_max: usize) -> Self {
        let count = (l_max - m) / 2 + 1;
        let order = (m * m) as f64;
        let eps: Vec<f64> = (m..m + 2 * count + 1)
            .map(|l| {
                let l2 = (l * l) as f64;
                ((l2 - order) / (4.0 * l2 - 1.0)).abs().sqrt()
            })
            .collect();
        let mut steps = Vec::with_capacity(count);
        let mut scale = Vec::with_capacity(count);
        let mut between = Vec::with_capacity(count);
        // Scales of this function and of the next. The second is free, and is chosen so that the scaled functions of
        // even and odd j are of similar size. The sign makes the recurrence a sum.
        let (mut this, mut next) =
            (1.0, (eps[1] * eps[2] / (eps[3.min(2 * count)] * eps[4.min(2 * count)])).sqrt());
        for j in 0..count {
            let (e0, e1, e2) = (eps[2 * j], eps[2 * j + 1], eps[2 * j + 2]);
            let link = e1 * e2;
            let a = this / (next * link);
            steps.push([a, -(e0 * e0 + e1 * e1) * a]);
            scale.push(this);
            between.push([e0, 1.0 / e1]);
            if let (Some(e3), Some(e4)) = (eps.get(2 * j + 3), eps.get(2 * j + 4)) {
                (this, next) = (next, -this * link / (e3 * e4));
            }
        }
        Self { m, start, steps, scale, between }
    }

    pub(super) fn len(&self) -> usize {
        self.steps.len()
    }

    /// Converts coefficients `alm` of l = m, m + 1, .. to coefficients of the scaled functions: real and imaginary part of
    /// the factor of q_j, then of the factor of x q_j.
    pub(super) fn mix(&self, alm: &[Complex64], out: &mut Vec<[f64; 4]>) {
        out.clear();
        out.resize(self.len(), [0.0; 4]);
        let mut above = Complex64::ZERO;
        let mut eps_above = 0.0;
        for j in (0..self.len()).rev() {
            let [eps, inverse] = self.between[j];
            let odd = alm.get(2 * j + 1).copied().unwrap_or_default();
            above = (odd - above * eps_above) * inverse;
            eps_above = eps;
            let (scale, even) = (self.scale[j], alm[2 * j]);
            out[j] = [even.re * scale, even.im * scale, above.re * scale, above.im * scale];
        }
    }

    /// Adds the transpose of [`Self::mix`] to `alm`.
    pub(super) fn unmix(&self, sums: &[[f64; 4]], alm: &mut [Complex64]) {
        let mut below = Complex64::ZERO;
        for (j, (sum, (&scale, &[eps, inverse]))) in
            sums.iter().zip(self.scale.iter().zip(&self.between)).enumerate()
        {
            alm[2 * j] += Complex64::new(sum[0], sum[1]) * scale;
            if let Some(odd) = alm.get_mut(2 * j + 1) {
                below = (Complex64::new(sum[2], sum[3]) * scale - below * eps) * inverse;
                *odd += below;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computes p_l for l = m .. l_max by the three-term recurrence in l.
    fn three_term(m: usize, l_max: usize, start: f64, x: f64) -> Vec<f64> {
        let eps = |l: usize| {
            let (l2, m2) = ((l * l) as f64, (m * m) as f64);
            ((l2 - m2) / (4.0 * l2 - 1.0)).sqrt()
        };
        let mut p = vec![start * (1.0 - x * x).powf(m as f64 / 2.0)];
        for l in m..l_max {
            let below = if l > m { eps(l) * p[l - m - 1] } else { 0.0 };
            p.push((x * p[l - m] - below) / eps(l + 1));
        }
        p
    }

    #[test]
    fn steps_of_two_give_the_same_functions() {
        let l_max = 40;
        for order in all_orders(l_max) {
            for x in [-0.9, -0.3, 0.0, 0.1, 0.7, 0.99] {
                let expected = three_term(order.m, l_max, order.start, x);
                let (mut below, mut q) = (0.0, expected[0]);
                for j in 0..order.len() {
                    let found = order.scale[j] * q;
                    // Some tens of steps round numbers of at most a few.
                    assert!((found - expected[2 * j]).abs() < 1e-12, "m {} j {j} x {x}", order.m);
                    let [a, b] = order.steps[j];
                    (below, q) = (q, (a * x * x + b) * q + below);
                }
            }
        }
    }

    #[test]
    fn functions_in_between_follow() {
        let l_max = 23;
        let x = 0.37;
        for order in all_orders(l_max) {
            let p = three_term(order.m, l_max, order.start, x);
            let alm: Vec<Complex64> =
                (0..p.len()).map(|k| Complex64::new(1.0 + k as f64, (k * k) as f64 - 3.0)).collect();
            let mut mixed = Vec::new();
            order.mix(&alm, &mut mixed);
            let expected: Complex64 = alm.iter().zip(&p).map(|(a, p)| a * p).sum();
            let (mut re, mut im) = (0.0, 0.0);
            for (j, c) in mixed.iter().enumerate() {
                let q = p[2 * j] / order.scale[j];
                re += q * (c[0] + x * c[2]);
                im += q * (c[1] + x * c[3]);
            }
            // Tens of coefficients up to 500 are rounded by 1e-16 each.
            assert!((Complex64::new(re, im) - expected).norm() < 1e-11, "m {}", order.m);
            // <mix(a), s> = <a, unmix(s)>.
            let sums: Vec<[f64; 4]> = (0..order.len()).map(|j| [0.3, -0.1, 0.7 + j as f64, 0.2]).collect();
            let mut back = vec![Complex64::ZERO; alm.len()];
            order.unmix(&sums, &mut back);
            let left: f64 =
                mixed.iter().zip(&sums).map(|(a, b)| (0..4).map(|k| a[k] * b[k]).sum::<f64>()).sum();
            let right: f64 = alm.iter().zip(&back).map(|(a, b)| a.re * b.re + a.im * b.im).sum();
            assert!((left - right).abs() < 1e-12 * left.abs().max(1e3), "m {}: {left} {right}", order.m);
        }
    }
}
