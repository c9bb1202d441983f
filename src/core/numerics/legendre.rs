//! Normalised associated Legendre functions at many colatitudes at once.

use super::Real;
use super::scaled::{LaneSlices, ScaledLanes, advance};

/// Computes `lambda_{l mu}(theta) = Y_{l mu}(theta, 0)`, orthonormal, with the Condon-Shortley phase.
#[derive(Clone, Debug)]
pub(crate) struct Legendre {
    z: Vec<f64>,
    ln_sin: Vec<f64>,
    /// `ln |lambda_{mu mu}|` at the equator.
    ln_first: Vec<f64>,
    l_max: usize,
}

impl Legendre {
    /// Prepares `l <= l_max` at colatitudes given by (cosine, sine).
    pub(crate) fn new(l_max: usize, points: impl Iterator<Item = (f64, f64)>) -> Self {
        let (z, ln_sin) = points.map(|(z, sin_theta)| (z, sin_theta.ln())).unzip();
        let mut ln_product = 0.0;
        let ln_first = (0..=l_max)
            .map(|mu| {
                if mu > 0 {
                    ln_product += ((2 * mu - 1) as f64 / (2 * mu) as f64).ln();
                }
                0.5 * (((2 * mu + 1) as f64 / (4.0 * std::f64::consts::PI)).ln() + ln_product)
            })
            .collect();
        Self { z, ln_sin, ln_first, l_max }
    }

    /// Rows `weight(theta) lambda_{l mu}(theta)`, one for each degree l = mu, mu + 2, .. <= l_max, at the first `weights.len()` colatitudes.
    pub(crate) fn even_rows<T: Real>(&self, mu: usize, weights: &[f64]) -> Vec<T> {
        self.rows_of_every(2, mu, weights)
    }

    /// The rows of [`Self::even_rows`] for all degrees l = mu, mu + 1, ..
    pub(crate) fn rows<T: Real>(&self, mu: usize, weights: &[f64]) -> Vec<T> {
        self.rows_of_every(1, mu, weights)
    }

    /// The rows for l = mu, mu + `step`, ..
    fn rows_of_every<T: Real>(&self, step: usize, mu: usize, weights: &[f64]) -> Vec<T> {
        let points = weights.len().min(self.z.len());
        let mut rows = Vec::with_capacity(points * ((self.l_max - mu) / step + 1));
        let sign = if mu.is_multiple_of(2) { 1.0 } else { -1.0 };
        let mut lanes = ScaledLanes::zeros(points);
        let ln_512 = 512.0 * std::f64::consts::LN_2;
        for k in 0..points {
            // The first degree lies below the range of f64 near the poles.
            let ln = self.ln_first[mu] + if mu > 0 { mu as f64 * self.ln_sin[k] } else { 0.0 };
            let power = (ln / ln_512).round().min(0.0);
            lanes.power[k] = power;
            lanes.current[k] = sign * (ln - power * ln_512).exp();
            lanes.value[k] = if power == 0.0 { lanes.current[k] } else { 0.0 };
        }
        for l in mu..=self.l_max {
            if l > mu {
                let square = |l: usize| (l * l) as f64 - (mu * mu) as f64;
                let (twice, inverse) = (2.0 * l as f64, 1.0 / square(l));
                let forward = ((twice * twice - 1.0) * inverse).sqrt();
                let behind = if l == mu + 1 {
                    0.0
                } else {
                    ((twice + 1.0) / (twice - 3.0) * square(l - 1) * inverse).sqrt()
                };
                advance_all(forward, behind, &self.z[..points], &mut lanes);
            }
            if (l - mu).is_multiple_of(step) {
                rows.extend(lanes.value.iter().zip(weights).map(|(v, w)| T::table_entry(v * w)));
            }
        }
        rows
    }
}

#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn advance_all(forward: f64, behind: f64, z: &[f64], lanes: &mut ScaledLanes) {
    let n = z.len();
    let LaneSlices { current, previous, power, value } = lanes.slices(0..n);
    let (current, previous) = (&mut current[..n], &mut previous[..n]);
    let (power, value) = (&mut power[..n], &mut value[..n]);
    for k in 0..n {
        let next = forward * z[k] * current[k] - behind * previous[k];
        advance(next, [&mut current[k], &mut previous[k], &mut power[k], &mut value[k]]);
    }
}
