//! Interpolation of band-limited functions from equally spaced nodes.
//!
//! A function on -1 <= x <= 1 whose phase sweeps +-z is an average of `exp(i s x)` over `|s| <= z`. Its value at x is
//! estimated with the weights w that minimise the mean over s of `|exp(i s x) - sum_k w_k exp(i s x_k)|^2`:
//! `G w = g(x)` with `G_kl = sinc(z (x_k - x_l))` and `g_k = sinc(z (x - x_k))`. Adding 1e-9 to the
//! diagonal regularises G and keeps weights below 10. With `ceil(z) + 5` nodes the error is at most 1e-3 of the
//! function, at the ends of the interval and of the band, and 2e-4 rms; a constant is exact.

use super::bins::{BINS, HALF, bin_offset};

/// Regularisation added to the diagonal.
const RIDGE: f64 = 1e-9;

/// Groups of `HALF` bins on one side of the channel.
const GROUPS: usize = BINS / 2 / HALF;

/// Largest phase sweep +-z that `nodes` nodes interpolate.
fn sweep_max(nodes: usize) -> f64 {
    match nodes {
        0..=3 => 0.25,
        4 | 5 => 1.0,
        6 | 7 => 2.0,
        more => (more - 5) as f64,
    }
}

/// Number of nodes for a phase sweep of +-`z`.
pub(super) fn nodes_for(z: f64) -> usize {
    let is_sufficient = |&nodes: &usize| sweep_max(nodes) >= z;
    let nodes_max = z.ceil().max(0.0) as usize + 5;
    [3, 5, 6].into_iter().find(is_sufficient).unwrap_or(nodes_max)
}

/// Position of a node in -1..1.
pub(super) fn node(k: usize, nodes: usize) -> f64 {
    2.0 * k as f64 / (nodes - 1) as f64 - 1.0
}

/// Interpolation weights of equally spaced nodes.
pub(super) struct BandInterpolation {
    nodes: usize,
    /// Cholesky factor of G, rows of its lower triangle.
    factor: Vec<Vec<f64>>,
}

impl BandInterpolation {
    /// Interpolation from `nodes` nodes, at least two.
    pub(super) fn new(nodes: usize) -> Self {
        let mut factor: Vec<Vec<f64>> = Vec::with_capacity(nodes);
        for i in 0..nodes {
            let mut row = Vec::with_capacity(i + 1);
            for j in 0..=i {
                let other = factor.get(j).unwrap_or(&row);
                let sum_before: f64 = row.iter().zip(other).map(|(a, b)| a * b).sum();
                let remainder = kernel(nodes, node(i, nodes) - node(j, nodes)) - sum_before;
                // The ridge keeps pivots positive; rounding is 1e-16 of the diagonal.
                row.push(if i == j {
                    (remainder + RIDGE).max(RIDGE * RIDGE).sqrt()
                } else {
                    remainder / other[j]
                });
            }
            factor.push(row);
        }
        Self { nodes, factor }
    }

    /// Weights at `x`; they sum to one.
    pub(super) fn weights(&self, x: f64, weights: &mut [f64]) {
        for (k, weight) in weights.iter_mut().enumerate() {
            *weight = kernel(self.nodes, x - node(k, self.nodes));
        }
        for (i, row) in self.factor.iter().enumerate() {
            let sum_before: f64 = row[..i].iter().zip(&*weights).map(|(a, b)| a * b).sum();
            weights[i] = (weights[i] - sum_before) / row[i];
        }
        for i in (0..self.nodes).rev() {
            let sum_before: f64 = (i + 1..self.nodes).map(|k| self.factor[k][i] * weights[k]).sum();
            weights[i] = (weights[i] - sum_before) / self.factor[i][i];
        }
        let sum: f64 = weights.iter().sum();
        for weight in weights {
            *weight /= sum;
        }
    }
}

/// Mean of `exp(i s d)` over the band of `nodes` nodes.
fn kernel(nodes: usize, distance: f64) -> f64 {
    let x = sweep_max(nodes) * distance;
    if x.abs() < 1e-4 { 1.0 - x * x / 6.0 } else { x.sin() / x }
}

/// Basis functions of frequency over a channel: interpolation from nodes, split into even and odd functions, so that
/// the bins below the centre also give those above it.
#[derive(Debug)]
pub(super) struct Basis {
    nodes: usize,
    /// By group of bins: even functions, then odd ones.
    rows: Vec<[f32; HALF]>,
}

impl Basis {
    /// The basis of `nodes` nodes, at least two.
    pub(super) fn new(nodes: usize) -> Self {
        let interpolation = BandInterpolation::new(nodes);
        let mut rows = vec![[0.0; HALF]; GROUPS * nodes];
        let mut weights = vec![0.0; nodes];
        for bin in 0..BINS / 2 {
            interpolation.weights(2.0 * bin_offset(bin), &mut weights);
            for (row, value) in rows[bin / HALF * nodes..].iter_mut().zip(functions(&weights)) {
                row[bin % HALF] = value as f32;
            }
        }
        Self { nodes, rows }
    }

    /// Number of nodes, functions and coefficients.
    pub(super) fn nodes(&self) -> usize {
        self.nodes
    }

    /// Values at the bins of a group: even functions, odd functions.
    pub(super) fn group(&self, group: usize) -> (&[[f32; HALF]], &[[f32; HALF]]) {
        self.rows[group * self.nodes..][..self.nodes].split_at(self.nodes.div_ceil(2))
    }

    /// Computes the coefficients from the values at the nodes.
    pub(super) fn coefficients(&self, value: impl Fn(usize) -> f64, out: &mut [f32]) {
        let (even, odd) = out.split_at_mut(self.nodes.div_ceil(2));
        for (k, even) in even.iter_mut().enumerate() {
            let mirrored = self.nodes - 1 - k;
            *even = (value(k) + if k == mirrored { 0.0 } else { value(mirrored) }) as f32;
        }
        for (k, odd) in odd.iter_mut().enumerate() {
            *odd = (value(k) - value(self.nodes - 1 - k)) as f32;
        }
    }

    /// The expansion at any position.
    #[cfg(test)]
    pub(super) fn value(&self, coefficients: &[f32], x: f64) -> f64 {
        let mut weights = vec![0.0; self.nodes];
        BandInterpolation::new(self.nodes).weights(x, &mut weights);
        functions(&weights).zip(coefficients).map(|(value, c)| value * f64::from(*c)).sum()
    }
}

/// Values of the even and of the odd functions, from interpolation weights.
fn functions(weights: &[f64]) -> impl Iterator<Item = f64> {
    let last = weights.len() - 1;
    let half = weights.len() / 2;
    let even = (0..weights.len() - half).map(move |k| 0.5 * (weights[k] + weights[last - k]));
    even.chain((0..half).map(move |k| 0.5 * (weights[k] - weights[last - k])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_phase_is_interpolated_as_documented() {
        for z in [0.05, 0.3, 1.0, 1.7, 3.2, 8.4, 14.9, 29.0, 57.3] {
            let nodes = nodes_for(z);
            let interpolation = BandInterpolation::new(nodes);
            let mut weights = vec![0.0; nodes];
            let (mut worst, mut squares, mut count) = (0.0_f64, 0.0, 0.0);
            for x in (0..=40).map(|k| f64::from(k) / 20.0 - 1.0) {
                interpolation.weights(x, &mut weights);
                assert!(weights.iter().map(|w| w.abs()).sum::<f64>() < 30.0, "{z}");
                for s in (0..=50).map(|k| z * f64::from(k) / 50.0) {
                    let part = |f: fn(f64) -> f64| {
                        let sum = weights.iter().enumerate().map(|(k, w)| w * f(s * node(k, nodes)));
                        sum.sum::<f64>() - f(s * x)
                    };
                    let error = part(f64::cos).hypot(part(f64::sin));
                    worst = worst.max(error);
                    squares += error * error;
                    count += 1.0;
                }
            }
            let rms = (squares / count).sqrt();
            // As documented.
            assert!(worst < 1e-3 && rms < 2e-4, "{z}: {nodes} nodes, {worst:.1e}, rms {rms:.1e}");
        }
    }

    #[test]
    fn even_and_odd_functions_give_both_sides() {
        for nodes in [3, 6, 9] {
            let basis = Basis::new(nodes);
            let value = |k: usize| (k * k) as f64 - 2.0;
            let mut coefficients = vec![0.0; nodes];
            basis.coefficients(value, &mut coefficients);
            for bin in 0..BINS / 2 {
                let (even, odd) = basis.group(bin / HALF);
                let (c_even, c_odd) = coefficients.split_at(even.len());
                let sum = |rows: &[[f32; HALF]], c: &[f32]| -> f64 {
                    rows.iter().zip(c).map(|(row, c)| f64::from(row[bin % HALF] * c)).sum()
                };
                let (even, odd) = (sum(even, c_even), sum(odd, c_odd));
                for (found, bin) in [(even + odd, bin), (even - odd, BINS - 1 - bin)] {
                    let mut weights = vec![0.0; nodes];
                    BandInterpolation::new(nodes).weights(2.0 * bin_offset(bin), &mut weights);
                    let expected: f64 = weights.iter().enumerate().map(|(k, w)| w * value(k)).sum();
                    // f32 sums of up to 60.
                    assert!((found - expected).abs() < 2e-4, "{nodes} {bin}: {found} {expected}");
                }
            }
        }
    }
}
