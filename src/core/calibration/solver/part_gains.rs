//! Changes of the gains of several daughters in a part of an interval, fitted together to the residuals of all pairs.
//!
//! What no change of any gain explains comes from the model. It shows how far gains only seem to change because the
//! model is wrong.

use num_complex::Complex64;

use crate::numerics::DenseFactor;

/// Number of Gauss-Newton steps: changes of half a turn settle within ten.
const STEPS: usize = 10;

/// Longest step of the logarithm of a gain.
const STEP_MAX: f64 = 0.7;

/// Inverse variance of what a change is expected to be (of its natural logarithm), so that common phases stay zero.
const PRIOR: f64 = 1.0;

/// Residuals of a pair in a part of an interval.
#[derive(Clone, Copy)]
pub(super) struct PairPart {
    pub(super) daughters: [usize; 2],
    /// Sum of weight, conjugate of the prediction, and residual.
    pub(super) score: Complex64,
    /// Sum of weight and squared prediction.
    pub(super) information: f64,
}

/// What a fit of gains leaves of a pair.
#[derive(Clone, Copy)]
pub(super) struct PairRemainder {
    /// Factor by which the product of both gains changes.
    pub(super) change: Complex64,
    /// Chi-square of the rest.
    pub(super) chi_square: f64,
    /// Its degrees of freedom: what is expected if only noise is left.
    pub(super) degrees_of_freedom: f64,
}

/// Signs with which changes of the first and second daughter act on a pair, of log amplitude and of phase.
const SIGNS: [[f64; 2]; 2] = [[1.0, 1.0], [1.0, -1.0]];

/// Fits changes of the gains of the `free` daughters; the others stay.
pub(super) fn fit_part(pairs: &[PairPart], satellites: usize, free: &[usize]) -> Vec<PairRemainder> {
    let order = free.len();
    let mut place = vec![None; satellites];
    free.iter().enumerate().for_each(|(at, daughter)| place[*daughter] = Some(at));
    let mut values = [vec![0.0; order], vec![0.0; order]];
    let factor_of = |values: &[Vec<f64>; 2], pair: &PairPart| {
        let sum = |axis: usize| -> f64 {
            let of = |k: usize| place[pair.daughters[k]].map_or(0.0, |at: usize| values[axis][at]);
            SIGNS[axis][0] * of(0) + SIGNS[axis][1] * of(1)
        };
        Complex64::from_polar(sum(0).exp(), sum(1))
    };
    let mut inverses = [Vec::new(), Vec::new()];
    for step in 0..=STEPS {
        let before = values.clone();
        for axis in [0, 1] {
            let (matrix, mut right) = normal_equations(axis, pairs, &before, (&place, &factor_of));
            let Some(factor) = DenseFactor::new(&matrix, order) else { continue };
            if step == STEPS {
                inverses[axis] = factor.inverse();
                continue;
            }
            factor.solve(&mut right);
            let longest = right.iter().fold(STEP_MAX, |most: f64, change| most.max(change.abs()));
            for (value, change) in values[axis].iter_mut().zip(right) {
                *value += change * STEP_MAX / longest;
            }
        }
    }
    let left = |pair: &PairPart| {
        let change = factor_of(&values, pair);
        let rest = pair.score - pair.information * (change - 1.0);
        let information = pair.information * change.norm_sqr();
        let leverage: f64 =
            (0..2).map(|axis| information * variance(axis, pair, &inverses[axis], &place)).sum();
        let chi_square = if pair.information > 0.0 { rest.norm_sqr() / pair.information } else { 0.0 };
        let degrees_of_freedom = if pair.information > 0.0 { (2.0 - leverage).max(0.0) } else { 0.0 };
        PairRemainder { change, chi_square, degrees_of_freedom }
    };
    pairs.iter().map(left).collect()
}

/// Normal matrix and right-hand side of the next step of an axis.
fn normal_equations(
    axis: usize,
    pairs: &[PairPart],
    values: &[Vec<f64>; 2],
    (place, factor_of): (&[Option<usize>], &impl Fn(&[Vec<f64>; 2], &PairPart) -> Complex64),
) -> (Vec<f64>, Vec<f64>) {
    let order = values[axis].len();
    let mut matrix = vec![0.0; order * order];
    let mut right: Vec<f64> = values[axis].iter().map(|value| -PRIOR * value).collect();
    (0..order).for_each(|at| matrix[at * order + at] = PRIOR);
    for pair in pairs {
        let factor = factor_of(values, pair);
        let rest = factor.conj() * (pair.score - pair.information * (factor - 1.0));
        let (rest, information) =
            (if axis == 0 { rest.re } else { rest.im }, pair.information * factor.norm_sqr());
        let ends = [0, 1].map(|k| (place[pair.daughters[k]], SIGNS[axis][k]));
        for (at, sign) in ends {
            let Some(at) = at else { continue };
            right[at] += sign * rest;
            for (other, other_sign) in ends {
                if let Some(other) = other {
                    matrix[at * order + other] += sign * other_sign * information;
                }
            }
        }
    }
    (matrix, right)
}

/// Variance of the change of a pair that is due to noise.
fn variance(axis: usize, pair: &PairPart, inverse: &[f64], place: &[Option<usize>]) -> f64 {
    let order = (inverse.len() as f64).sqrt().round() as usize;
    let ends = [0, 1].map(|k| (place[pair.daughters[k]], SIGNS[axis][k]));
    let mut sum = 0.0;
    for (at, sign) in ends {
        for (other, other_sign) in ends {
            if let (Some(at), Some(other)) = (at, other) {
                sum += sign * other_sign * inverse.get(at * order + other).copied().unwrap_or(0.0);
            }
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pairs of six daughters with these changes of gains (natural logarithms), and an error of the model by pair.
    fn pairs(changes: &[Complex64; 6], error: impl Fn(usize, usize) -> Complex64) -> Vec<PairPart> {
        let pair = |(i, j): (usize, usize)| {
            let information = 1e4 * (1.0 + i as f64);
            let ratio = (changes[i] + changes[j].conj()).exp() * (1.0 + error(i, j));
            PairPart { daughters: [i, j], score: information * (ratio - 1.0), information }
        };
        (0..6).flat_map(|i| (i + 1..6).map(move |j| (i, j))).map(pair).collect()
    }

    #[test]
    fn changes_of_all_gains_leave_nothing_and_errors_of_the_model_remain() {
        let changes = [(0.1, 0.8), (-0.2, -1.5), (0.0, 0.3), (0.3, 0.0), (-0.1, 2.0), (0.0, -0.7)]
            .map(|(re, im)| Complex64::new(re, im));
        let all: Vec<usize> = (0..6).collect();
        let left = fit_part(&pairs(&changes, |_, _| Complex64::ZERO), 6, &all);
        // The prior pulls a change by its size over an information of 1e5: chi-square is a few times 1e-4.
        assert!(left.iter().all(|pair| pair.chi_square < 1e-2));
        // 30 real data, six amplitudes and five phases.
        let degrees: f64 = left.iter().map(|pair| pair.degrees_of_freedom).sum();
        assert!((degrees - 19.0).abs() < 0.01, "{degrees}");
        // Errors of 5 % that alternate from pair to pair stay: at least half of their chi-square, as 19 of 30 degrees do.
        let error = |i: usize, j: usize| {
            Complex64::new(if (i + 2 * j).is_multiple_of(3) { 0.05 } else { -0.025 }, 0.0)
        };
        let with_error = pairs(&[Complex64::ZERO; 6], error);
        let before: f64 = with_error.iter().map(|pair| pair.score.norm_sqr() / pair.information).sum();
        let after: f64 = fit_part(&with_error, 6, &all).iter().map(|pair| pair.chi_square).sum();
        assert!(after > 0.3 * before && before > 100.0, "{before} {after}");
        // One daughter alone explains its own change.
        let mut one = [Complex64::ZERO; 6];
        one[4] = Complex64::new(0.2, 1.9);
        assert!(
            fit_part(&pairs(&one, |_, _| Complex64::ZERO), 6, &[4]).iter().all(|pair| pair.chi_square < 1e-2)
        );
    }
}
