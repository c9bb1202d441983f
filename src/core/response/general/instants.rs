//! Averages over integrations as sums over instants.
//!
//! The error of n-point Gauss-Legendre quadrature in the mean of `exp(i h x)` over -1 <= x <= 1 is at most
//! `2^(2n) n!^4 / ((2n + 1) (2n)!^3) h^(2n)`. Within an integration h is half of the motion of a phase: of the fringe, and of the
//! limb's harmonics, which have little power.

use crate::numerics::quadrature::GaussLegendre;

/// Maximum error of the mean of the fastest fringe in the sky, which few directions have.
const FRINGE_ERROR: f64 = 1e-4;

/// Maximum error of the mean of the limb's highest degree: one degree has about 1e-3 of the power.
const LIMB_ERROR: f64 = 1e-2;

/// Maximum number of instants.
const INSTANTS_MAX: usize = 24;

/// Instant of an integration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Instant {
    /// Time after the middle, in units of half the integration.
    pub offset: f64,
    /// Weight in the mean.
    pub weight: f64,
}

/// Quadrature rules with 1, 2, .. instants.
#[derive(Clone, Debug)]
pub struct Instants {
    rules: Vec<Vec<Instant>>,
}

/// Number of points that the mean of `exp(i h x)` needs.
fn point_count(h: f64, error_max: f64) -> usize {
    let mut error = 1.0;
    for n in 1..INSTANTS_MAX {
        // The bound for n from the bound for n - 1.
        let k = n as f64;
        error *= (h * h * k) / (2.0 * (2.0 * k + 1.0) * (2.0 * k - 1.0).powi(2));
        if error <= error_max {
            return n;
        }
    }
    INSTANTS_MAX
}

impl Default for Instants {
    fn default() -> Self {
        Self::new()
    }
}

impl Instants {
    /// Computes all rules.
    #[must_use]
    pub fn new() -> Self {
        let rule = |n: usize| {
            let rule = GaussLegendre::new(n);
            let instants = rule.abscissae.iter().zip(&rule.weights);
            instants.map(|(t, w)| Instant { offset: 2.0 * t - 1.0, weight: *w }).collect()
        };
        Self { rules: (1..=INSTANTS_MAX).map(rule).collect() }
    }

    /// Returns the rule with the middle instant only.
    #[must_use]
    pub fn middle(&self) -> &[Instant] {
        &self.rules[0]
    }

    /// Returns the rule for an integration in half of which the phases of the fringe and of the limb's highest degree move by these
    /// angles, rad.
    #[must_use]
    pub fn for_phases(&self, [fringe_rad, limb_rad]: [f64; 2]) -> &[Instant] {
        &self.rules[point_count(fringe_rad, FRINGE_ERROR).max(point_count(limb_rad, LIMB_ERROR)) - 1]
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;

    #[test]
    fn means_err_by_what_is_allowed() {
        let all = Instants::new();
        assert_eq!(all.rules[0], [Instant { offset: 0.0, weight: 1.0 }]);
        for (h, error_max) in [(0.01, 1e-4), (0.4, 1e-4), (1.3, 1e-4), (4.2, 1e-2), (9.0, 1e-2)] {
            let count = point_count(h, error_max);
            let mean: Complex64 =
                all.rules[count - 1].iter().map(|at| at.weight * Complex64::cis(h * at.offset)).sum();
            let error = (mean - f64::sin(h) / h).norm();
            assert!(error <= error_max, "{h}: {error} with {count}");
            // At most one more than needed, as the formula is a bound.
            let fewer: Complex64 = match count {
                0..=2 => continue,
                _ => all.rules[count - 3].iter().map(|at| at.weight * Complex64::cis(h * at.offset)).sum(),
            };
            assert!((fewer - f64::sin(h) / h).norm() > error_max, "{h}: {count}");
        }
    }
}
