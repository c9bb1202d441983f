//! Averages over integrations as sums over instants.
//!
//! Gauss-Legendre quadrature of n points errs in the mean of `exp(i h x)` over -1 <= x <= 1 by
//! `2^(2n) n!^4 / ((2n + 1) (2n)!^3) h^(2n)` at most. Within an integration h is half of what phases move by: those of the fringe, and
//! those of the limb's harmonics, in which there is little power.

use crate::numerics::quadrature::GaussLegendre;

/// Error of the mean of a fringe that moves as fast as any in the sky: few directions do.
const FRINGE_ERROR: f64 = 1e-4;

/// Error of the mean of the limb's highest degree: the power at one degree is about 1e-3 of the whole.
const LIMB_ERROR: f64 = 1e-2;

/// Most instants.
const INSTANTS_MAX: usize = 24;

/// An instant of an integration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Instant {
    /// After the middle, in units of half of the integration.
    pub offset: f64,
    /// Its weight in the mean.
    pub weight: f64,
}

/// The instants of a mean, by their number less 1.
#[derive(Clone, Debug)]
pub struct Instants {
    rules: Vec<Vec<Instant>>,
}

/// Points that the mean of `exp(i h x)` takes.
fn points(h: f64, error_max: f64) -> usize {
    let mut error = 1.0;
    for n in 1..INSTANTS_MAX {
        // From the formula for n - 1.
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
    /// All rules.
    #[must_use]
    pub fn new() -> Self {
        let rule = |n: usize| {
            let rule = GaussLegendre::new(n);
            let instants = rule.abscissae.iter().zip(&rule.weights);
            instants.map(|(t, w)| Instant { offset: 2.0 * t - 1.0, weight: *w }).collect()
        };
        Self { rules: (1..=INSTANTS_MAX).map(rule).collect() }
    }

    /// The instant in the middle alone.
    #[must_use]
    pub fn middle(&self) -> &[Instant] {
        &self.rules[0]
    }

    /// The instants of an integration, as many as the motion of phases in half of it needs, rad: of the fringe, and of the limb's highest
    /// degree.
    #[must_use]
    pub fn for_phases(&self, [fringe_rad, limb_rad]: [f64; 2]) -> &[Instant] {
        &self.rules[points(fringe_rad, FRINGE_ERROR).max(points(limb_rad, LIMB_ERROR)) - 1]
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
        for (h, most) in [(0.01, 1e-4), (0.4, 1e-4), (1.3, 1e-4), (4.2, 1e-2), (9.0, 1e-2)] {
            let count = points(h, most);
            let mean: Complex64 =
                all.rules[count - 1].iter().map(|at| at.weight * Complex64::cis(h * at.offset)).sum();
            let error = (mean - f64::sin(h) / h).norm();
            assert!(error <= most, "{h}: {error} with {count}");
            // No more than it takes, by one: the formula is a bound.
            let fewer: Complex64 = match count {
                0..=2 => continue,
                _ => all.rules[count - 3].iter().map(|at| at.weight * Complex64::cis(h * at.offset)).sum(),
            };
            assert!((fewer - f64::sin(h) / h).norm() > most, "{h}: {count}");
        }
    }
}
