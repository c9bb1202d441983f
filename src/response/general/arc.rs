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
//! Pairs are the lanes of vectors: for all of them the rings, and so the orders, are the same.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use crate::response::harmonic::quadrature::{GaussLegendre, Rules};
use crate::response::harmonic::trigonometry::sin_cos;

/// Pairs that are computed together.
pub(super) const LANES: usize = 8;

/// One number for each pair.
pub(super) type Lanes = [f64; LANES];

/// Type of patterns. Sums over the rings keep 1e-6 of a row's rms, of the 1e-4 that interpolation may cost.
pub(super) type Value = f32;

/// Values of all pairs at one order.
pub(super) const VALUES: usize = 4 * LANES;

/// Real and imaginary part of `I_mu`, then of `I_{-mu}`, for each pair.
pub(super) type Coefficients = [[Value; LANES]; 4];

/// A ring as pairs see it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arcs {
    /// `2 pi u sin theta`.
    pub(super) x: Lanes,
    /// The arc that both satellites of a pair see, rad.
    pub(super) low: Lanes,
    pub(super) high: Lanes,
}

/// Quadrature rules for `I_0` and `I_1`, and buffers for one ring.
#[derive(Clone, Debug)]
pub(super) struct ArcSolver {
    rules: Arc<Rules>,
    steps: Vec<Step>,
}

/// What elimination leaves of one order: real and imaginary part of the right-hand side of `I_n`, then of `(-1)^n I_{-n}`, and
/// their ratio to the next order's.
#[derive(Clone, Copy, Debug)]
struct Step {
    values: [Lanes; 4],
    ratio: Lanes,
}

const NO_STEP: Step = Step { values: [[0.0; LANES]; 4], ratio: [0.0; LANES] };

/// `Int exp(-i x sin psi) dpsi` from `from` over `length`, and that with another factor `exp(-i psi)`: real and imaginary parts.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn integrate(x: &Lanes, from: &Lanes, length: &Lanes, abscissae: &[f64], weights: &[f64]) -> [Lanes; 4] {
    let mut sums = [[0.0; LANES]; 4];
    for (t, w) in abscissae.iter().zip(weights) {
        for k in 0..LANES {
            let (sin, cos) = sin_cos(from[k] + length[k] * t);
            let (fringe_sin, fringe_cos) = sin_cos(x[k] * sin);
            sums[0][k] += w * fringe_cos;
            sums[1][k] -= w * fringe_sin;
            sums[2][k] += w * (fringe_cos * cos - fringe_sin * sin);
            sums[3][k] -= w * (fringe_sin * cos + fringe_cos * sin);
        }
    }
    sums.map(|sum| std::array::from_fn(|k| length[k] * sum[k]))
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
        let (sin, cos) = sin_cos(x - (0.5 * order + 0.25) * PI);
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
        Self { rules: Arc::new(Rules::up_to(points)), steps: Vec::new() }
    }

    /// Writes the coefficients of mu = 0, 1, .. as far as `out` goes.
    pub(super) fn solve(&mut self, arcs: &Arcs, out: &mut [Coefficients]) {
        let start = self.start(arcs);
        let order_max = out.len().saturating_sub(1);
        // Where the orders that are asked for stay below x, what is beyond does not matter.
        let beyond = arcs.x.iter().filter(|x| **x < (order_max + 1) as f64);
        let far = beyond.map(|x| (x + 10.0 * x.cbrt()) as usize + FAR_MARGIN).max();
        let far = far.map_or(order_max, |far| far.max(order_max + FAR_MARGIN));
        if self.steps.len() <= far {
            self.steps.resize(far + 1, NO_STEP);
        }
        recurrences(arcs, &start, &mut self.steps[..=far], out);
    }

    /// `I_0` and `I_1` by quadrature over the shorter of the arcs.
    fn start(&self, arcs: &Arcs) -> [Lanes; 4] {
        let (mut from, mut length) = (arcs.low, [0.0; LANES]);
        let mut whole = [[0.0; LANES]; 4];
        let mut sign = [1.0; LANES];
        let mut points = 0;
        for k in 0..LANES {
            let (x, seen) = (arcs.x[k], arcs.high[k] - arcs.low[k]);
            length[k] = seen;
            if x >= BESSEL_X_MIN && TAU - seen < seen {
                // All of the ring, less what is hidden.
                let [zero, one] = bessel(x);
                // Int exp(-i (x sin psi + psi)) dpsi is 2 pi J_{-1}(x).
                (whole[0][k], whole[2][k]) = (TAU * zero, -TAU * one);
                (from[k], length[k], sign[k]) = (arcs.high[k], (TAU - seen).max(0.0), -1.0);
            }
            points = points.max(GaussLegendre::points_for(MORE_POINTS * 0.5 * length[k] * x));
        }
        let rule = self.rules.of(points);
        let part = integrate(&arcs.x, &from, &length, &rule.abscissae, &rule.weights);
        std::array::from_fn(|n| std::array::from_fn(|k| whole[n][k] + sign[k] * part[n][k]))
    }
}

/// Solves `x K_{n+1} + 2 n K_n + x K_{n-1} = b_n(high) - b_n(low)` for `K_n = I_n` and `K_n = (-1)^n I_{-n}`, which obeys the same
/// recurrence with another right-hand side: upwards while n < x, and beyond by elimination up to the last of the steps and
/// back.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn recurrences(arcs: &Arcs, start: &[Lanes; 4], steps: &mut [Step], out: &mut [Coefficients]) {
    const ZERO: Lanes = [0.0; LANES];
    let x = arcs.x;
    let (mut inverse, mut known) = (ZERO, ZERO);
    // The boundary terms at the ends and what multiplies them from order to order; values of this order and the one before.
    let [mut high, mut low] = [[ZERO; 4]; 2];
    let [mut high_step, mut low_step] = [[ZERO; 2]; 2];
    let mut now = [start[0], start[1], start[0], start[1]];
    let mut before = [ZERO; 4];
    let mut right = [ZERO; 4];
    for k in 0..LANES {
        known[k] = x[k].floor();
        inverse[k] = if x[k] >= 1.0 { 1.0 / x[k] } else { 0.0 };
        let (sin, cos) = sin_cos(arcs.high[k]);
        (high_step[0][k], high_step[1][k]) = (cos, -sin);
        let (fringe_sin, fringe_cos) = sin_cos(x[k] * sin);
        // 2 i exp(-i x sin psi), and minus that.
        (high[0][k], high[1][k]) = (2.0 * fringe_sin, 2.0 * fringe_cos);
        (high[2][k], high[3][k]) = (-2.0 * fringe_sin, -2.0 * fringe_cos);
        let (sin, cos) = sin_cos(arcs.low[k]);
        (low_step[0][k], low_step[1][k]) = (cos, -sin);
        let (fringe_sin, fringe_cos) = sin_cos(x[k] * sin);
        (low[0][k], low[1][k]) = (2.0 * fringe_sin, 2.0 * fringe_cos);
        (low[2][k], low[3][k]) = (-2.0 * fringe_sin, -2.0 * fringe_cos);
        for n in 0..4 {
            right[n][k] = high[n][k] - low[n][k];
        }
        // I_{-1} from the recurrence at 0, and (-1)^1 I_1.
        before[0][k] = right[0][k] * inverse[k] - start[2][k];
        before[1][k] = right[1][k] * inverse[k] - start[3][k];
        before[2][k] = -start[2][k];
        before[3][k] = -start[3][k];
    }
    let mut ratio = ZERO;
    steps[0] = Step { values: now, ratio };
    for (n, step) in steps.iter_mut().enumerate().skip(1) {
        let (order, below) = (n as f64, 2.0 * (n - 1) as f64);
        for k in 0..LANES {
            let pivot = 1.0 / (2.0 * order - x[k] * ratio[k]);
            let is_known = order <= known[k];
            ratio[k] = if is_known { 0.0 } else { x[k] * pivot };
            let (hc, hs) = (high_step[0][k], high_step[1][k]);
            let (lc, ls) = (low_step[0][k], low_step[1][k]);
            // exp(-i psi) for the first, -exp(i psi) for the second.
            let h = [
                high[0][k] * hc - high[1][k] * hs,
                high[0][k] * hs + high[1][k] * hc,
                -(high[2][k] * hc + high[3][k] * hs),
                high[2][k] * hs - high[3][k] * hc,
            ];
            let l = [
                low[0][k] * lc - low[1][k] * ls,
                low[0][k] * ls + low[1][k] * lc,
                -(low[2][k] * lc + low[3][k] * ls),
                low[2][k] * ls - low[3][k] * lc,
            ];
            for part in 0..4 {
                (high[part][k], low[part][k]) = (h[part], l[part]);
                let next_right = h[part] - l[part];
                let upwards = (right[part][k] - below * now[part][k]) * inverse[k] - before[part][k];
                let eliminated = (next_right - x[k] * now[part][k]) * pivot;
                before[part][k] = now[part][k];
                now[part][k] = if is_known { upwards } else { eliminated };
                right[part][k] = next_right;
            }
        }
        *step = Step { values: now, ratio };
    }
    // Beyond the last step, by parts: the boundary term over the slope of its phase. The error decays on the way down.
    let scale = 0.5 / steps.len() as f64;
    let mut next = [ZERO; 4];
    for k in 0..LANES {
        let (hc, hs) = (high_step[0][k], high_step[1][k]);
        let (lc, ls) = (low_step[0][k], low_step[1][k]);
        next[0][k] = scale * (high[0][k] * hc - high[1][k] * hs - low[0][k] * lc + low[1][k] * ls);
        next[1][k] = scale * (high[0][k] * hs + high[1][k] * hc - low[0][k] * ls - low[1][k] * lc);
        next[2][k] = scale * (-high[2][k] * hc - high[3][k] * hs + low[2][k] * lc + low[3][k] * ls);
        next[3][k] = scale * (high[2][k] * hs - high[3][k] * hc - low[2][k] * ls + low[3][k] * lc);
    }
    for (n, step) in steps.iter().enumerate().rev() {
        for (next, values) in next.iter_mut().zip(step.values) {
            for ((next, value), ratio) in next.iter_mut().zip(values).zip(step.ratio) {
                *next = value - ratio * *next;
            }
        }
        if let Some(out) = out.get_mut(n) {
            // (-1)^n I_{-n} is what was solved for.
            let sign = if n % 2 == 0 { 1.0 } else { -1.0 };
            for k in 0..LANES {
                out[0][k] = next[0][k] as Value;
                out[1][k] = next[1][k] as Value;
                out[2][k] = (sign * next[2][k]) as Value;
                out[3][k] = (sign * next[3][k]) as Value;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;

    #[test]
    fn coefficients_are_the_integrals() {
        let rule = GaussLegendre::new(400);
        let xs = [0.0, 1e-9, 0.3, 1.0, 2.5, 17.3, 30.0, 31.7, 140.0];
        let arcs = [[-PI, PI], [-2.1, 2.1], [-2.12, 2.07], [-0.4, 0.3], [1e-3, 2.0]];
        let cases: Vec<(f64, [f64; 2])> = xs.iter().flat_map(|x| arcs.map(|arc| (*x, arc))).collect();
        // Lanes are cases that lie far apart, so that they need different numbers of points and steps.
        for first in 0..cases.len() {
            let lanes: [_; LANES] = std::array::from_fn(|k| cases[(first + 7 * k) % cases.len()]);
            let arcs =
                Arcs { x: lanes.map(|c| c.0), low: lanes.map(|c| c.1[0]), high: lanes.map(|c| c.1[1]) };
            for orders in [1, 4, 31] {
                let mut out = vec![[[0.0; LANES]; 4]; orders];
                ArcSolver::new(150.0).solve(&arcs, &mut out);
                for (mu, found) in out.iter().enumerate() {
                    for (k, (x, [low, high])) in lanes.iter().enumerate() {
                        for (sign, parts) in
                            [(1.0, [found[0][k], found[1][k]]), (-1.0, [found[2][k], found[3][k]])]
                        {
                            let value = |t: f64| {
                                let psi = low + (high - low) * t;
                                Complex64::cis(-x * psi.sin() - sign * mu as f64 * psi)
                            };
                            let sum: Complex64 =
                                rule.abscissae.iter().zip(&rule.weights).map(|(t, w)| w * value(*t)).sum();
                            let expected = (high - low) * sum;
                            let found = Complex64::new(f64::from(parts[0]), f64::from(parts[1]));
                            // Rounded to the type of patterns in the end.
                            let error = (found - expected).norm();
                            assert!(
                                error < 1e-11 + f64::from(Value::EPSILON) * expected.norm(),
                                "{lanes:?} {mu}: {error:e}"
                            );
                        }
                    }
                }
            }
        }
    }
}
