//! Fourier coefficients of a fringe on an arc of a ring.
//!
//! On the ring at colatitude theta the pattern is `exp(-i x sin psi)`, `x = 2 pi u sin theta`, where both satellites see
//! it, `low <= psi <= high`, and nothing beyond. As in the symmetric case (`response/harmonic/ring.rs`), its coefficients
//!
//! ```text
//! I_mu = Int_low^high exp(-i (x sin psi + mu psi)) dpsi,     E_mu(psi) = exp(-i (x sin psi + mu psi))
//! ```
//!
//! obey Bessel's recurrence with boundary terms on the right-hand side,
//!
//! ```text
//! x I_{mu+1} + 2 mu I_mu + x I_{mu-1} = 2 i (E_mu(high) - E_mu(low))
//! ```
//!
//! which is followed upwards from `I_0` and `I_1` for |mu| < x, and solved as a boundary-value problem beyond.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use num_complex::Complex64;

use crate::response::harmonic::quadrature::{GaussLegendre, Rules};
use crate::response::harmonic::trigonometry::sin_cos;

/// Quadrature rules for `I_0` and `I_1`, and buffers for one ring.
#[derive(Clone, Debug)]
pub(super) struct ArcSolver {
    rules: Arc<Rules>,
    ratio: Vec<f64>,
    values: Vec<Complex64>,
}

/// `I_0` and `I_1` by a rule whose number of points is a multiple of the lanes.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn integrate_start(x: f64, [low, high]: [f64; 2], abscissae: &[f64], weights: &[f64]) -> [Complex64; 2] {
    const LANES: usize = 8;
    let mut sums = [[0.0; LANES]; 4];
    let length = high - low;
    for (t, w) in abscissae.chunks_exact(LANES).zip(weights.chunks_exact(LANES)) {
        for k in 0..LANES {
            let (sin, cos) = sin_cos(low + length * t[k]);
            let (fringe_sin, fringe_cos) = sin_cos(x * sin);
            // exp(-i x sin psi), and that times exp(-i psi).
            sums[0][k] += w[k] * fringe_cos;
            sums[1][k] -= w[k] * fringe_sin;
            sums[2][k] += w[k] * (fringe_cos * cos - fringe_sin * sin);
            sums[3][k] -= w[k] * (fringe_sin * cos + fringe_cos * sin);
        }
    }
    let [a, b, c, d] = sums.map(|lanes| length * lanes.iter().sum::<f64>());
    [Complex64::new(a, b), Complex64::new(c, d)]
}

/// From here on Hankel's series gives Bessel functions to rounding.
const BESSEL_X_MIN: f64 = 30.0;

/// `J_0` and `J_1` for x of at least [`BESSEL_X_MIN`] (DLMF 10.17.3): the terms of the series fall to 1e-17 of the first.
fn bessel(x: f64) -> [f64; 2] {
    [0.0, 1.0].map(|order: f64| {
        let (mut p, mut q, mut term) = (0.0, 0.0, 1.0);
        for k in 0..16 {
            // i^k: P takes the even terms, Q the odd ones, with alternating signs.
            let sign = if k % 4 < 2 { 1.0 } else { -1.0 };
            if k % 2 == 0 {
                p += sign * term
            } else {
                q += sign * term
            }
            let odd = (2 * k + 1) as f64;
            term *= (4.0 * order * order - odd * odd) / (8.0 * (k + 1) as f64 * x);
        }
        let (sin, cos) = (x - (0.5 * order + 0.25) * PI).sin_cos();
        (2.0 / (PI * x)).sqrt() * (p * cos - q * sin)
    })
}

/// A phase `x sin(psi)` over much of a ring needs more points than a straight one of the same slope: without them `I_0` errs by
/// 3e-7 at x = 140.
const MORE_POINTS: f64 = 1.4;

/// Additional orders over which the error of the far end decays.
const FAR_MARGIN: usize = 40;

impl ArcSolver {
    /// A solver for 0 <= x <= `x_max`.
    pub(super) fn new(x_max: f64) -> Self {
        let points = GaussLegendre::points_for(MORE_POINTS * PI * x_max);
        Self { rules: Arc::new(Rules::up_to(points)), ratio: Vec::new(), values: Vec::new() }
    }

    /// Writes `I_mu`, mu = -order_max ..= order_max, for `arc = [low, high]`; `out` has room for these `2 order_max + 1`.
    pub(super) fn solve(&mut self, x: f64, arc: [f64; 2], out: &mut [Complex64]) {
        let order_max = out.len() / 2;
        let start = self.start(x, arc);
        let edges = arc.map(|psi| Complex64::cis(-x * psi.sin()));
        let twice = Complex64::new(0.0, 2.0);
        let below = if x >= 1.0 { twice * (edges[1] - edges[0]) / x - start[1] } else { Complex64::ZERO };
        self.branch(x, start, edges.map(|e| twice * e), arc.map(|psi| Complex64::cis(-psi)), order_max);
        out[order_max..].copy_from_slice(&self.values[..=order_max]);
        // J_n = (-1)^n I_{-n} obeys the same recurrence with the right-hand side of -n times -(-1)^n.
        let steps = arc.map(|psi| -Complex64::cis(psi));
        self.branch(x, [start[0], -below], edges.map(|e| -twice * e), steps, order_max);
        for n in 1..=order_max {
            out[order_max - n] = if n % 2 == 0 { self.values[n] } else { -self.values[n] };
        }
    }

    /// `I_0` and `I_1` by quadrature.
    fn start(&self, x: f64, [low, high]: [f64; 2]) -> [Complex64; 2] {
        let integrate = |arc: [f64; 2]| {
            let points = GaussLegendre::points_for(MORE_POINTS * 0.5 * (arc[1] - arc[0]) * x);
            let rule = self.rules.of(points);
            integrate_start(x, arc, &rule.abscissae, &rule.weights)
        };
        let hidden = [high, low + TAU];
        if x < BESSEL_X_MIN || hidden[1] - hidden[0] > high - low {
            return integrate([low, high]);
        }
        // All of the ring, less what is hidden.
        let [zero, one] = bessel(x);
        let rest = if hidden[1] > hidden[0] { integrate(hidden) } else { [Complex64::ZERO; 2] };
        [TAU * zero - rest[0], -TAU * one - rest[1]]
    }

    /// Solves `x K_{n+1} + 2 n K_n + x K_{n-1} = b_high s_high^n - b_low s_low^n` for n = 0 ..= `order_max`, given `K_0` and
    /// `K_1` (the latter used only if x >= 1).
    fn branch(
        &mut self,
        x: f64,
        start: [Complex64; 2],
        [mut low, mut high]: [Complex64; 2],
        [low_step, high_step]: [Complex64; 2],
        order_max: usize,
    ) {
        let turning = x.floor() as usize;
        let known = turning.min(order_max);
        let far = order_max.max((x + 10.0 * x.cbrt()) as usize) + FAR_MARGIN;
        self.values.resize((far + 2).max(self.values.len()), Complex64::ZERO);
        self.ratio.resize((far + 2).max(self.ratio.len()), 0.0);
        let (values, ratio) = (&mut self.values, &mut self.ratio);
        let mut advance = || {
            (low, high) = (low * low_step, high * high_step);
            high - low
        };
        values[0] = start[0];
        values[1] = start[1];
        if known >= 1 {
            let inverse = 1.0 / x;
            for n in 1..known {
                values[n + 1] = (advance() - 2.0 * n as f64 * values[n]) * inverse - values[n - 1];
            }
            if turning >= order_max {
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
        // By parts: the boundary term over the slope of its phase; the error decays on the way down.
        let mut next = advance() / (2.0 * (far + 1) as f64);
        for n in (known + 1..=far).rev() {
            next = values[n] - ratio[n] * next;
            values[n] = next;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_are_the_integrals() {
        let rule = GaussLegendre::new(400);
        let order_max = 30;
        let mut solver = ArcSolver::new(150.0);
        let mut out = vec![Complex64::ZERO; 2 * order_max + 1];
        for x in [0.0, 1e-9, 0.3, 1.0, 2.5, 17.3, 30.0, 31.7, 140.0] {
            for arc in [[-PI, PI], [-2.1, 2.1], [-2.12, 2.07], [-0.4, 0.3], [1e-3, 2.0]] {
                solver.solve(x, arc, &mut out);
                for (place, found) in out.iter().enumerate() {
                    let mu = place as f64 - order_max as f64;
                    let value = |t: f64| {
                        let psi = arc[0] + (arc[1] - arc[0]) * t;
                        Complex64::cis(-x * psi.sin() - mu * psi)
                    };
                    let sum: Complex64 =
                        rule.abscissae.iter().zip(&rule.weights).map(|(t, w)| w * value(*t)).sum();
                    let expected = (arc[1] - arc[0]) * sum;
                    // Roundings of numbers of order one, which the recurrence multiplies by up to some thousand about |mu| = x.
                    assert!((found - expected).norm() < 1e-11, "{x} {arc:?} {mu}: {found} {expected}");
                }
            }
        }
    }
}
