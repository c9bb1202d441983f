//! Gauss-Legendre quadrature.

use std::f64::consts::PI;

/// A Gauss-Legendre rule on [0, 1], with increasing abscissae.
#[derive(Clone, Debug)]
pub(crate) struct GaussLegendre {
    pub(crate) abscissae: Vec<f64>,
    pub(crate) weights: Vec<f64>,
}

/// Largest rule whose zeros are found by Newton's iteration on the recurrence of P_n, which takes n operations per step.
const NEWTON_MAX: usize = 96;

/// Terms of the Taylor series of P_n about a zero that give the next zero to rounding (Glaser, Liu and Rokhlin 2007).
const TAYLOR_TERMS: usize = 30;

impl GaussLegendre {
    /// The rule of `n` points, exact for polynomials of degree 2n - 1. Each point takes some 0.3 us for any `n`.
    pub(crate) fn new(n: usize) -> Self {
        let n = n.max(1);
        let mut rule = Self { abscissae: vec![0.5; n], weights: vec![1.0; n] };
        let mut set = |k: usize, [x, slope]: [f64; 2]| {
            let weight = 1.0 / ((1.0 - x * x) * slope * slope);
            (rule.abscissae[k], rule.weights[k]) = (0.5 * (1.0 - x), weight);
            (rule.abscissae[n - 1 - k], rule.weights[n - 1 - k]) = (0.5 * (1.0 + x), weight);
        };
        let half = n.div_ceil(2);
        if n <= NEWTON_MAX {
            (0..half).for_each(|k| set(k, zero_by_recurrence(n, k)));
            return rule;
        }
        // From the middle outwards, each zero from the one before.
        let (value, slope) = legendre(n, 0.0);
        let mut zero = LegendreExpansion { n: n as f64, x: 0.0, value, slope };
        for k in (0..half).rev() {
            let is_middle = 2 * k + 1 == n;
            if !is_middle {
                zero = zero.zero_near(asymptotic_zero(n, k));
            }
            set(k, [zero.x, zero.slope]);
        }
        rule
    }

    /// Points needed for `exp(i omega t)` over t in [-1, 1] to about f64 precision: half a point per
    /// radian, and the width of the turning region.
    pub(crate) fn points_for(omega: f64) -> usize {
        (0.5 * omega + 4.0 * omega.cbrt() + 16.0).ceil() as usize
    }
}

/// The `k`th largest zero of P_n, to some thousandths of the distance to its neighbour (Tricomi's formula).
fn asymptotic_zero(n: usize, k: usize) -> f64 {
    let cos = (PI * (k as f64 + 0.75) / (n as f64 + 0.5)).cos();
    let n = n as f64;
    (1.0 - (n - 1.0) / (8.0 * n * n * n)) * cos
}

/// The `k`th largest zero of P_n and the slope there, by Newton's iteration.
fn zero_by_recurrence(n: usize, k: usize) -> [f64; 2] {
    let (mut x, mut slope) = (asymptotic_zero(n, k), 1.0);
    for _ in 0..8 {
        let (value, derivative) = legendre(n, x);
        slope = derivative;
        let change = value / derivative;
        x -= change;
        if change.abs() < 1e-16 {
            break;
        }
    }
    [x, slope]
}

/// Value and slope of P_n at a point, from which its Taylor series follows.
struct LegendreExpansion {
    n: f64,
    x: f64,
    value: f64,
    slope: f64,
}

impl LegendreExpansion {
    /// The zero near `guess`, by Newton's iteration on the Taylor series, whose terms follow from Legendre's equation:
    /// `(1 - x^2) (k + 1) (k + 2) a_{k+2} = 2 x (k + 1)^2 a_{k+1} + (k (k + 1) - n (n + 1)) a_k`.
    fn zero_near(&self, guess: f64) -> Self {
        let Self { n, x, value, slope } = *self;
        let step = guess - x;
        let mut terms = [0.0; TAYLOR_TERMS];
        (terms[0], terms[1]) = (value, slope * step);
        for k in 0..TAYLOR_TERMS - 2 {
            let order = k as f64;
            let sum = 2.0 * x * step * (order + 1.0) * (order + 1.0) * terms[k + 1]
                + step * step * (order * (order + 1.0) - n * (n + 1.0)) * terms[k];
            terms[k + 2] = sum / ((1.0 - x * x) * (order + 1.0) * (order + 2.0));
        }
        // In units of the step.
        let (mut t, mut slope) = (1.0, 0.0);
        for _ in 0..6 {
            let mut value = 0.0;
            slope = 0.0;
            for &term in terms.iter().rev() {
                slope = slope * t + value;
                value = value * t + term;
            }
            let change = value / slope;
            t -= change;
            if change.abs() < 1e-15 {
                break;
            }
        }
        let slope = slope / step;
        let next = x + step * t;
        // The value at the rounded zero is kept, or rounding errors would add up from zero to zero.
        let missed = step * t - (next - x);
        Self { n, x: next, value: -missed * slope, slope }
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

/// Rules of increasing size, each at most a sixteenth or 16 points larger than the one before.
#[derive(Clone, Debug)]
pub(crate) struct QuadratureRules(Vec<GaussLegendre>);

impl QuadratureRules {
    /// All sizes are multiples of this.
    const SIZE_UNIT: usize = 16;

    /// QuadratureRules that cover all sizes up to `points` points.
    pub(crate) fn up_to(points: usize) -> Self {
        let mut sizes = vec![Self::SIZE_UNIT];
        while let Some(&last) = sizes.last().filter(|&&last| last < points) {
            sizes.push((last + (last / 16).max(1)).next_multiple_of(Self::SIZE_UNIT));
        }
        Self(sizes.into_iter().map(GaussLegendre::new).collect())
    }

    /// The smallest rule of at least `points` points, or the largest rule.
    pub(crate) fn at_least(&self, points: usize) -> &GaussLegendre {
        let index = self.0.partition_point(|rule| rule.weights.len() < points);
        &self.0[index.min(self.0.len() - 1)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oscillations_are_integrated_to_rounding() {
        for omega in [0.0, 1.0, 10.0, 100.0, 131.0, 300.0, 1000.0, 3e4, 1e5] {
            let rule = GaussLegendre::new(GaussLegendre::points_for(omega));
            let sum: f64 =
                rule.abscissae.iter().zip(&rule.weights).map(|(t, w)| w * (2.0 * omega * t).cos()).sum();
            let exact = if omega == 0.0 { 1.0 } else { (2.0 * omega).sin() / (2.0 * omega) };
            // Phases are rounded to 2e-16 per radian, with random signs.
            assert!((sum - exact).abs() < 1e-14 + 2e-16 * omega, "{omega}: {sum} {exact}");
        }
    }

    /// Sizes on both sides of the change of method, and far beyond.
    #[test]
    fn polynomials_are_integrated_whatever_the_number_of_points() {
        for n in (1..=4).chain(NEWTON_MAX - 2..NEWTON_MAX + 4).chain([1000, 1001, 30_000]) {
            let rule = GaussLegendre::new(n);
            assert!(rule.abscissae.windows(2).all(|pair| pair[0] < pair[1]), "{n}");
            for power in (0..2 * n.min(20)).map(|k| k as i32) {
                let sum: f64 = rule.abscissae.iter().zip(&rule.weights).map(|(t, w)| w * t.powi(power)).sum();
                let exact = 1.0 / f64::from(power + 1);
                // Each slope follows from its neighbour's by a sum of some thirty terms: rounding errors grow as the square
                // root of the number of points.
                let error = 30.0 * f64::EPSILON * (n as f64).sqrt();
                assert!((sum / exact - 1.0).abs() < 4e-15 + error, "{n} {power}: {sum} {exact}");
            }
        }
    }

    #[test]
    fn rules_reach_every_number_of_points() {
        for points_max in [1, 16, 17, 100, 5000] {
            let rules = QuadratureRules::up_to(points_max);
            for points in 1..=points_max {
                let found = rules.at_least(points).weights.len();
                assert!(found >= points && found.is_multiple_of(16), "{points_max} {points}");
                assert!(found < points + points / 16 + 32, "{points_max} {points}: {found}");
            }
            assert_eq!(
                rules.at_least(10 * points_max).weights.len(),
                rules.at_least(points_max).weights.len()
            );
        }
    }
}
