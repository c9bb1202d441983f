//! Gauss-Legendre rules.

use std::f64::consts::PI;

/// Abscissae and weights on [0, 1], abscissae rising.
#[derive(Clone, Debug)]
pub(crate) struct GaussLegendre {
    pub(crate) abscissae: Vec<f64>,
    pub(crate) weights: Vec<f64>,
}

impl GaussLegendre {
    /// The rule of `n` points, exact for polynomials of degree 2n - 1.
    ///
    /// Newton's iteration on P_n from the asymptotic zeros `cos(pi (k + 3/4) / (n + 1/2))`.
    pub(crate) fn new(n: usize) -> Self {
        let n = n.max(1);
        let mut rule = Self { abscissae: vec![0.5; n], weights: vec![1.0; n] };
        for k in 0..n.div_ceil(2) {
            let mut x = (PI * (k as f64 + 0.75) / (n as f64 + 0.5)).cos();
            let mut slope = 1.0;
            for _ in 0..8 {
                let (value, derivative) = legendre(n, x);
                slope = derivative;
                let change = value / derivative;
                x -= change;
                if change.abs() < 1e-16 {
                    break;
                }
            }
            let weight = 1.0 / ((1.0 - x * x) * slope * slope);
            rule.abscissae[k] = 0.5 * (1.0 - x);
            rule.abscissae[n - 1 - k] = 0.5 * (1.0 + x);
            rule.weights[k] = weight;
            rule.weights[n - 1 - k] = weight;
        }
        rule
    }

    /// Points needed for `exp(i omega t)` over t in [-1, 1] to about f64 precision: half a point a
    /// radian, and the width of the turning region.
    pub(crate) fn points_for(omega: f64) -> usize {
        (0.5 * omega + 4.0 * omega.cbrt() + 16.0).ceil() as usize
    }
}

/// P_n(x) and its derivative, |x| < 1.
fn legendre(n: usize, x: f64) -> (f64, f64) {
    let (mut before, mut value) = (1.0, x);
    for k in 2..=n {
        let k = k as f64;
        (before, value) = (value, ((2.0 * k - 1.0) * x * value - (k - 1.0) * before) / k);
    }
    (value, n as f64 * (before - x * value) / (1.0 - x * x))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oscillations_are_integrated_to_rounding() {
        for omega in [0.0, 1.0, 10.0, 300.0, 1000.0] {
            let rule = GaussLegendre::new(GaussLegendre::points_for(omega));
            let sum: f64 =
                rule.abscissae.iter().zip(&rule.weights).map(|(t, w)| w * (2.0 * omega * t).cos()).sum();
            let exact = if omega == 0.0 { 1.0 } else { (2.0 * omega).sin() / (2.0 * omega) };
            // Phases of up to 2000 rad carry 2e-13 of rounding.
            assert!((sum - exact).abs() < 5e-13, "{omega}: {sum} {exact}");
        }
    }
}
