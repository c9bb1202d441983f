//! Interpolation through Chebyshev points on [-1, 1].

use std::f64::consts::PI;

/// Maximum number of terms.
pub(crate) const TERMS_MAX: usize = 16;

/// Terms needed for `exp(i h tau)`, |tau| <= 1, to `tolerance`: the error is about `2 (h/2)^K / K!`.
pub(crate) fn terms_for(h: f64, tolerance: f64) -> Option<usize> {
    let mut error = 2.0;
    for terms in 1..=TERMS_MAX {
        error *= 0.5 * h / terms as f64;
        if error <= tolerance {
            return Some(terms);
        }
    }
    None
}

/// The largest h for which [`terms_for`] needs at most `terms` terms.
pub(crate) fn h_max(terms: usize, tolerance: f64) -> f64 {
    let factorial: f64 = (1..=terms).map(|k| k as f64).product();
    2.0 * (0.5 * tolerance * factorial).powf(1.0 / terms as f64)
}

/// Chebyshev points of the first kind.
pub(crate) fn points(terms: usize) -> Vec<f64> {
    (0..terms).map(|k| (PI * (k as f64 + 0.5) / terms as f64).cos()).collect()
}

/// The matrix `[n][k]` that turns the values at the points k into the coefficients of T_n.
pub(crate) fn analysis(terms: usize) -> Vec<Vec<f64>> {
    (0..terms)
        .map(|n| {
            let scale = if n == 0 { 1.0 } else { 2.0 } / terms as f64;
            (0..terms).map(|k| scale * (PI * n as f64 * (k as f64 + 0.5) / terms as f64).cos()).collect()
        })
        .collect()
}

/// Weights of the values at the Chebyshev points for interpolation at `tau`.
pub(crate) fn weights_at(terms: usize, tau: f64) -> Vec<f64> {
    let polynomials = polynomials(terms, tau);
    let analysis = analysis(terms);
    (0..terms).map(|k| (0..terms).map(|n| analysis[n][k] * polynomials[n]).sum()).collect()
}

/// The Chebyshev polynomials `T_0(tau) .. T_{terms-1}(tau)`.
pub(crate) fn polynomials(terms: usize, tau: f64) -> [f64; TERMS_MAX] {
    let mut values = [0.0; TERMS_MAX];
    values[0] = 1.0;
    if terms > 1 {
        values[1] = tau;
    }
    for n in 2..terms {
        values[n] = 2.0 * tau * values[n - 1] - values[n - 2];
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn oscillations_are_interpolated_to_the_tolerance() {
        for h in [0.05, 0.5, 1.5, 3.0] {
            for tolerance in [1e-3, 1e-5, 1e-7] {
                let terms = terms_for(h, tolerance).expect("few terms");
                assert!(h_max(terms, tolerance) >= h);
                let nodes = points(terms);
                for k in 0..=20 {
                    let tau = 0.1 * f64::from(k) - 1.0;
                    let weights = weights_at(terms, tau);
                    let sum = |f: fn(f64) -> f64| -> f64 {
                        weights.iter().zip(&nodes).map(|(w, t)| w * f(h * t)).sum()
                    };
                    let error = (sum(f64::cos) - (h * tau).cos()).hypot(sum(f64::sin) - (h * tau).sin());
                    // The estimate is the leading term.
                    assert!(error < 2.0 * tolerance, "{h} {tolerance} {tau}: {error}");
                }
            }
        }
    }
}
