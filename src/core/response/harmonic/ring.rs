//! Fourier coefficients of the fringe pattern on one ring of the body frame, with an exact limb.
//!
//! On the ring at colatitude theta the pattern is `exp(-i x sin psi)`, `x = 2 pi u sin theta`, for
//! |psi| <= limb, and 0 beyond. Its coefficients
//!
//! ```text
//! I_mu = Int_{-limb}^{limb} cos(x sin psi + mu psi) dpsi
//! ```
//!
//! obey Bessel's recurrence with boundary terms on the right-hand side (from the integral of the derivative of
//! `sin(x sin psi + mu psi)`):
//!
//! ```text
//! x I_{mu+1} + 2 mu I_mu + x I_{mu-1} = 4 sin(x sin limb + mu limb)
//! ```
//!
//! For |mu| < x the solutions oscillate, and the recurrence runs upwards from `I_0` and `I_1`, which come from quadrature.
//! For |mu| > x it is solved as a boundary-value problem (Olver's method); the boundary value at high mu is the leading term of
//! the integral by parts. Each coefficient costs a few operations.

use std::f64::consts::PI;

use crate::numerics::quadrature::{GaussLegendre, QuadratureRules};
use crate::numerics::trigonometry::sin_cos;

/// Quadrature rules for `I_0` and `I_1`, and buffers for one ring.
#[derive(Clone, Debug)]
pub(crate) struct RingSolver {
    rules: std::sync::Arc<QuadratureRules>,
    order_max: usize,
    ratio: Vec<f64>,
    values: Vec<f64>,
}

impl RingSolver {
    /// Prepares quadrature rules for |x| <= `x_max`.
    pub(crate) fn new(x_max: f64) -> Self {
        let points = GaussLegendre::points_for(0.5 * PI * x_max.abs());
        let rules = std::sync::Arc::new(QuadratureRules::up_to(points));
        Self { rules, order_max: 0, ratio: Vec::new(), values: Vec::new() }
    }

    /// Writes `I_mu` for mu = -order_max ..= order_max and a ring visible at |psi| <= `limb` <= pi;
    /// `out` has `2 order_max + 1` elements.
    pub(crate) fn solve(&mut self, x: f64, limb: f64, out: &mut [f64]) {
        self.order_max = out.len() / 2;
        let centre = self.order_max;
        let limb = limb.clamp(0.0, PI);
        let start = self.start(x.abs(), limb);
        let boundary = x.abs() * limb.sin();
        let first_below = if x.abs() >= 1.0 { 4.0 / x.abs() * boundary.sin() - start[1] } else { 0.0 };
        self.solve_recurrence(x.abs(), start, [boundary, limb]);
        for n in 0..=self.order_max {
            // Changing the sign of x is the same as changing the sign of mu.
            out[if x < 0.0 { centre - n } else { centre + n }] = self.values[n];
        }
        // (-1)^n I_{-n} obeys the same recurrence with the right-hand side -4 (-1)^n sin(boundary - n limb).
        self.solve_recurrence(x.abs(), [start[0], -first_below], [boundary + PI, PI - limb]);
        for n in 0..=self.order_max {
            let sign = if n % 2 == 0 { 1.0 } else { -1.0 };
            out[if x < 0.0 { centre + n } else { centre - n }] = sign * self.values[n];
        }
    }

    fn start(&self, x: f64, limb: f64) -> [f64; 2] {
        let points = GaussLegendre::points_for(0.5 * limb * x);
        let rule = self.rules.at_least(points);
        integrate_start(x, limb, &rule.abscissae, &rule.weights)
    }

    /// Solves `x K_{n+1} + 2 n K_n + x K_{n-1} = 4 sin(phase + n step)` for n = 0 ..= order_max, from
    /// `K_0`, `K_1` (which is used only if x >= 1) and `[phase, step]`.
    fn solve_recurrence(&mut self, x: f64, start: [f64; 2], [phase, step]: [f64; 2]) {
        let turning_point = x.floor() as usize;
        let known = turning_point.min(self.order_max);
        let far = self.order_max.max((x + 10.0 * x.cbrt()) as usize) + FAR_MARGIN;
        self.values.resize(far + 2, 0.0);
        self.ratio.resize(far + 2, 0.0);
        let (values, ratio) = (&mut self.values, &mut self.ratio);
        let (turn_sin, turn_cos) = step.sin_cos();
        let (mut sin, mut cos) = (phase + step).sin_cos();
        let mut advance = || {
            let now = sin;
            (sin, cos) = (sin * turn_cos + cos * turn_sin, cos * turn_cos - sin * turn_sin);
            4.0 * now
        };
        values[0] = start[0];
        values[1] = start[1];
        if known >= 1 {
            let inverse = 1.0 / x;
            for n in 1..known {
                values[n + 1] = (advance() - 2.0 * n as f64 * values[n]) * inverse - values[n - 1];
            }
            if turning_point >= self.order_max {
                return;
            }
            // The right-hand side at n = `known` belongs to the row that the boundary value replaces.
            advance();
        }
        let mut above = 0.0;
        let mut carried = values[known];
        for n in known + 1..=far {
            let pivot = 1.0 / (2.0 * n as f64 - x * above);
            carried = (advance() - x * carried) * pivot;
            above = x * pivot;
            ratio[n] = above;
            values[n] = carried;
        }
        // The leading term of the integral by parts; its error decays towards lower orders.
        let mut next = advance() / (2.0 * (far + 1) as f64);
        for n in (known + 1..=far).rev() {
            next = values[n] - ratio[n] * next;
            values[n] = next;
        }
    }
}

/// Additional orders over which the error of the boundary value decays.
const FAR_MARGIN: usize = 40;

#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn integrate_start(x: f64, limb: f64, abscissae: &[f64], weights: &[f64]) -> [f64; 2] {
    const LANES: usize = 8;
    let (mut zero, mut one) = ([0.0; LANES], [0.0; LANES]);
    for (t, w) in abscissae.chunks_exact(LANES).zip(weights.chunks_exact(LANES)) {
        for k in 0..LANES {
            let (sin, cos) = sin_cos(limb * t[k]);
            let (fringe_sin, fringe_cos) = sin_cos(x * sin);
            zero[k] += w[k] * fringe_cos;
            one[k] += w[k] * (fringe_cos * cos - fringe_sin * sin);
        }
    }
    let twice = 2.0 * limb;
    [twice * zero.iter().sum::<f64>(), twice * one.iter().sum::<f64>()]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn integral(x: f64, limb: f64, mu: i64) -> f64 {
        let rule = GaussLegendre::new(240);
        let sum: f64 = rule
            .abscissae
            .iter()
            .zip(&rule.weights)
            .map(|(t, w)| w * (x * (limb * t).sin() + mu as f64 * limb * t).cos())
            .sum();
        2.0 * limb * sum
    }

    #[test]
    fn coefficients_are_the_integrals() {
        let order_max = 40;
        let mut solver = RingSolver::new(210.0);
        let mut out = vec![0.0; 2 * order_max + 1];
        for x in [0.0, 1e-9, 0.3, 1.0, 2.5, 17.3, 37.0, 40.0, 41.2, 75.0, 200.0, -13.0, -80.0] {
            for limb in [1e-4, 0.7, 1.9, 2.1, 3.0, PI] {
                solver.solve(x, limb, &mut out);
                for mu in -(order_max as i64)..=order_max as i64 {
                    let found = out[(mu + order_max as i64) as usize];
                    let expected = integral(x, limb, mu);
                    // Both have errors of some hundred roundings of numbers of order one.
                    assert!((found - expected).abs() < 1e-12, "{x} {limb} {mu}: {found} {expected}");
                }
            }
        }
    }
}
