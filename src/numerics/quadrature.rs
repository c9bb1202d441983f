//! Gauss-Legendre rules.

use std::f64::consts::PI;

/// Abscissae and weights on [0, 1], abscissae rising.
#[derive(Clone, Debug)]
pub(crate) struct GaussLegendre {
    pub(crate) abscissae: Vec<f64>,
    pub(crate) weights: Vec<f64>,
}

/// Most points of a rule found by Newton's iteration on the recurrence of P_n, n operations a step.
const NEWTON_MAX: usize = 96;

/// Terms of P_n around a zero: the next zero lies within them to rounding (Glaser, Liu and Rokhlin 2007).
const TERMS: usize = 30;

impl GaussLegendre {
    /// The rule of `n` points, exact for polynomials of degree 2n - 1. A point takes some 0.3 us, whatever `n`.
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
        let mut at = LegendreExpansion { n: n as f64, x: 0.0, value, slope };
        for k in (0..half).rev() {
            let is_middle = 2 * k + 1 == n;
            if !is_middle {
                at = at.zero_near(asymptotic_zero(n, k));
            }
            set(k, [at.x, at.slope]);
        }
        rule
    }

    /// Points needed for `exp(i omega t)` over t in [-1, 1] to about f64 precision: half a point a
    /// radian, and the width of the turning region.
    pub(crate) fn points_for(omega: f64) -> usize {
        (0.5 * omega + 4.0 * omega.cbrt() + 16.0).ceil() as usize
    }
}

/// The `k`th zero of P_n, from above, to some thousandths of the distance to its neighbour (Tricomi).
fn asymptotic_zero(n: usize, k: usize) -> f64 {
    let cos = (PI * (k as f64 + 0.75) / (n as f64 + 0.5)).cos();
    let n = n as f64;
    (1.0 - (n - 1.0) / (8.0 * n * n * n)) * cos
}

/// The `k`th zero of P_n and the slope there, by Newton's iteration.
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

/// P_n around a point.
struct LegendreExpansion {
    n: f64,
    x: f64,
    value: f64,
    slope: f64,
}

impl LegendreExpansion {
    /// A neighbouring zero, by Newton's iteration on the Taylor series, whose terms follow from Legendre's equation:
    /// `(1 - x^2) (k + 1) (k + 2) a_{k+2} = 2 x (k + 1)^2 a_{k+1} + (k (k + 1) - n (n + 1)) a_k`.
    fn zero_near(&self, guess: f64) -> Self {
        let Self { n, x, value, slope } = *self;
        let step = guess - x;
        let mut terms = [0.0; TERMS];
        (terms[0], terms[1]) = (value, slope * step);
        for k in 0..TERMS - 2 {
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
        // What rounding takes from a zero is put back by the value there, or such errors would add up.
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

/// Rules of rising size, each at most a sixteenth or 16 points larger than the one before; sizes are multiples of 16.
#[derive(Clone, Debug)]
pub(crate) struct Rules(Vec<GaussLegendre>);

impl Rules {
    /// Sizes are multiples of this.
    const STEP: usize = 16;

    /// Rules of up to `points` points.
    pub(crate) fn up_to(points: usize) -> Self {
        let mut sizes = vec![Self::STEP];
        while let Some(&last) = sizes.last().filter(|&&last| last < points) {
            sizes.push((last + (last / 16).max(1)).next_multiple_of(Self::STEP));
        }
        Self(sizes.into_iter().map(GaussLegendre::new).collect())
    }

    /// The smallest rule of at least so many points, or the greatest.
    pub(crate) fn of(&self, points: usize) -> &GaussLegendre {
        let place = self.0.partition_point(|rule| rule.weights.len() < points);
        &self.0[place.min(self.0.len() - 1)]
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
            // Phases carry a rounding of 2e-16 each radian, by chance to either side.
            assert!((sum - exact).abs() < 1e-14 + 2e-16 * omega, "{omega}: {sum} {exact}");
        }
    }

    /// On both sides of the change from one way of finding zeros to the other, and far beyond.
    #[test]
    fn polynomials_are_integrated_whatever_the_number_of_points() {
        for n in (1..=4).chain(NEWTON_MAX - 2..NEWTON_MAX + 4).chain([1000, 1001, 30_000]) {
            let rule = GaussLegendre::new(n);
            assert!(rule.abscissae.windows(2).all(|pair| pair[0] < pair[1]), "{n}");
            for power in (0..2 * n.min(20)).map(|k| k as i32) {
                let sum: f64 = rule.abscissae.iter().zip(&rule.weights).map(|(t, w)| w * t.powi(power)).sum();
                let exact = 1.0 / f64::from(power + 1);
                // Slopes of neighbours follow from each other by sums of some thirty terms: roundings add up as the root of
                // the number of points.
                let error = 30.0 * f64::EPSILON * (n as f64).sqrt();
                assert!((sum / exact - 1.0).abs() < 4e-15 + error, "{n} {power}: {sum} {exact}");
            }
        }
    }

    #[test]
    fn rules_reach_every_number_of_points() {
        for most in [1, 16, 17, 100, 5000] {
            let rules = Rules::up_to(most);
            for points in 1..=most {
                let found = rules.of(points).weights.len();
                assert!(found >= points && found.is_multiple_of(16), "{most} {points}");
                assert!(found < points + points / 16 + 32, "{most} {points}: {found}");
            }
            assert_eq!(rules.of(10 * most).weights.len(), rules.of(most).weights.len());
        }
    }
}
