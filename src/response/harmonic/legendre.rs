//! Associated Legendre functions at many colatitudes at once.

use crate::sky::harmonics::scaled::{RESCALE_ABOVE, RESCALE_DOWN};

use super::real::Real;

/// Orthonormal `lambda_{l mu}(theta) = Y_{l mu}(theta, 0)`, Condon-Shortley phase.
#[derive(Clone, Debug)]
pub(crate) struct Legendre {
    z: Vec<f64>,
    ln_sin: Vec<f64>,
    /// `ln |lambda_{mu mu}|` at the equator.
    ln_first: Vec<f64>,
    l_max: usize,
}

impl Legendre {
    /// For `l <= l_max` at the colatitudes with these cosines and sines.
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

    /// `weight(theta) lambda_{l mu}(theta)` for l = mu, mu + 2, .. <= l_max: a row of the first colatitudes
    /// each, as many as there are weights.
    pub(crate) fn even_rows<T: Real>(&self, mu: usize, weights: &[f64]) -> Vec<T> {
        let points = weights.len().min(self.z.len());
        let mut rows = Vec::with_capacity(points * ((self.l_max - mu) / 2 + 1));
        let sign = if mu.is_multiple_of(2) { 1.0 } else { -1.0 };
        let mut lanes = Lanes {
            current: vec![0.0; points],
            previous: vec![0.0; points],
            power: vec![0.0; points],
            value: vec![0.0; points],
        };
        let ln_512 = 512.0 * std::f64::consts::LN_2;
        for k in 0..points {
            let ln = self.ln_first[mu] + if mu > 0 { mu as f64 * self.ln_sin[k] } else { 0.0 };
            let power = (ln / ln_512).round().min(0.0);
            lanes.power[k] = power;
            lanes.current[k] = sign * (ln - power * ln_512).exp();
            lanes.value[k] = if power == 0.0 { lanes.current[k] } else { 0.0 };
        }
        for l in mu..=self.l_max {
            if l > mu {
                let square = |l: usize| (l * l) as f64 - (mu * mu) as f64;
                let (twice, above) = (2.0 * l as f64, 1.0 / square(l));
                let forward = ((twice * twice - 1.0) * above).sqrt();
                let behind = if l == mu + 1 {
                    0.0
                } else {
                    ((twice + 1.0) / (twice - 3.0) * square(l - 1) * above).sqrt()
                };
                step(forward, behind, &self.z[..points], &mut lanes);
            }
            if (l - mu).is_multiple_of(2) {
                rows.extend(lanes.value.iter().zip(weights).map(|(v, w)| T::entry(v * w)));
            }
        }
        rows
    }
}

struct Lanes {
    current: Vec<f64>,
    previous: Vec<f64>,
    power: Vec<f64>,
    value: Vec<f64>,
}

#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn step(forward: f64, behind: f64, z: &[f64], lanes: &mut Lanes) {
    let n = z.len();
    let current = &mut lanes.current[..n];
    let previous = &mut lanes.previous[..n];
    let power = &mut lanes.power[..n];
    let value = &mut lanes.value[..n];
    for k in 0..n {
        let next = forward * z[k] * current[k] - behind * previous[k];
        let grown = next.abs() > RESCALE_ABOVE;
        let scale = if grown { RESCALE_DOWN } else { 1.0 };
        let now = power[k] + if grown { 1.0 } else { 0.0 };
        previous[k] = current[k] * scale;
        current[k] = next * scale;
        power[k] = now;
        value[k] = if now == 0.0 { next * scale } else { 0.0 };
    }
}
