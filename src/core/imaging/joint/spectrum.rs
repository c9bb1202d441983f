//! Fits the spectrum of every pixel, `ln T = ln T_0 + beta ln(nu / nu_0) + 1/2 c ln(nu / nu_0)^2`, to the maps of all channels.

/// Spectral index and curvature of every pixel with their standard deviations; NaN where the map of a channel is not positive.
#[derive(Clone, Debug, PartialEq)]
pub struct SpectralMaps {
    /// Reference frequency nu_0, the geometric mean of the channels, Hz.
    pub reference_hz: f64,
    /// Spectral index beta = d ln T / d ln nu at nu_0.
    pub index: Vec<f64>,
    /// Standard deviation of the index.
    pub index_sigma: Vec<f64>,
    /// Curvature c, the change of beta per e-folding of frequency; empty with fewer than three channels.
    pub curvature: Vec<f64>,
    /// Standard deviation of the curvature.
    pub curvature_sigma: Vec<f64>,
}

/// Accumulates index and curvature of a map, and their scatter over samples.
pub(super) struct SpectrumFit {
    reference_hz: f64,
    /// Weights of ln T of each channel in beta and, with three channels or more, in c.
    weights: Vec<Vec<f64>>,
    /// Values `[beta, c][pixel]` of the map.
    fitted: Vec<Vec<f64>>,
    /// Sums over samples of squared deviations, `[beta, c][pixel]`.
    squares: Vec<Vec<f64>>,
    /// Number of valid samples of each pixel.
    counts: Vec<f64>,
}

impl SpectrumFit {
    pub(super) fn new(frequencies_hz: &[f64], maps_k: &[Vec<f64>]) -> Self {
        let logarithms: Vec<f64> = frequencies_hz.iter().map(|hz| hz.ln()).collect();
        let centre = logarithms.iter().sum::<f64>() / logarithms.len() as f64;
        let x: Vec<f64> = logarithms.iter().map(|ln| ln - centre).collect();
        let weights = fit_weights(&x);
        let fitted = fit_maps(&weights, maps_k);
        let pixels = maps_k.first().map_or(0, Vec::len);
        let squares = vec![vec![0.0; pixels]; fitted.len()];
        Self { reference_hz: centre.exp(), weights, fitted, squares, counts: vec![0.0; pixels] }
    }

    pub(super) fn add_sample(&mut self, maps_k: &[Vec<f64>]) {
        let sample = fit_maps(&self.weights, maps_k);
        for pixel in 0..self.counts.len() {
            let deviation: Vec<f64> =
                sample.iter().zip(&self.fitted).map(|(a, b)| a[pixel] - b[pixel]).collect();
            if deviation.iter().all(|x| x.is_finite()) {
                self.counts[pixel] += 1.0;
                self.squares.iter_mut().zip(deviation).for_each(|(sum, x)| sum[pixel] += x * x);
            }
        }
    }

    pub(super) fn finish(self) -> SpectralMaps {
        let Self { reference_hz, fitted, squares, counts, .. } = self;
        let sigma = |which: usize| {
            let of_pixel =
                |(sum, count): (&f64, &f64)| if *count > 0.0 { (sum / count).sqrt() } else { f64::NAN };
            squares
                .get(which)
                .map(|sums| sums.iter().zip(&counts).map(of_pixel).collect())
                .unwrap_or_default()
        };
        SpectralMaps {
            reference_hz,
            index: fitted.first().cloned().unwrap_or_default(),
            index_sigma: sigma(0),
            curvature: fitted.get(1).cloned().unwrap_or_default(),
            curvature_sigma: sigma(1),
        }
    }
}

/// The weights of a least-squares fit for beta and c, from orthogonal polynomials.
fn fit_weights(x: &[f64]) -> Vec<Vec<f64>> {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let square: Vec<f64> = x.iter().map(|x| x * x).collect();
    let mean = square.iter().sum::<f64>() / x.len() as f64;
    let slope = dot(&square, x) / dot(x, x);
    // x^2 minus its mean and its linear trend; the mean of x is 0.
    let residual: Vec<f64> = square.iter().zip(x).map(|(s, x)| s - mean - slope * x).collect();
    let norm = dot(&residual, &residual);
    if x.len() < 3 || norm <= 0.0 {
        return vec![x.iter().map(|value| value / dot(x, x)).collect()];
    }
    // For y = a + b x + q residual, c = 2 q, and the slope at x = 0 is b - q slope.
    let weight = |value: &f64, residual: &f64| value / dot(x, x) - slope * residual / norm;
    vec![
        x.iter().zip(&residual).map(|(value, residual)| weight(value, residual)).collect(),
        residual.iter().map(|residual| 2.0 * residual / norm).collect(),
    ]
}

fn fit_maps(weights: &[Vec<f64>], maps_k: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let pixels = maps_k.first().map_or(0, Vec::len);
    let of_pixel = |weights: &Vec<f64>, pixel: usize| {
        // The sum is not finite if a value is not positive.
        let term = |(weight, map): (&f64, &Vec<f64>)| weight * map[pixel].max(0.0).ln();
        let sum: f64 = weights.iter().zip(maps_k).map(term).sum();
        if sum.is_finite() { sum } else { f64::NAN }
    };
    weights.iter().map(|weights| (0..pixels).map(|pixel| of_pixel(weights, pixel)).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn index_and_curvature_of_a_curved_power_law_are_found() {
        let frequencies_hz = [1e6, 3e6, 10e6, 12e6];
        let reference_hz = f64::powf(1e6 * 3e6 * 10e6 * 12e6, 0.25);
        // Three pixels; the last is not positive at one frequency.
        let law = |hz: f64, index: f64, curvature: f64| {
            let x = (hz / reference_hz).ln();
            5e5 * (index * x + 0.5 * curvature * x * x).exp()
        };
        let maps: Vec<Vec<f64>> = frequencies_hz
            .iter()
            .map(|hz| vec![law(*hz, -2.5, 0.0), law(*hz, -2.1, -0.7), if *hz == 3e6 { -1.0 } else { 1.0 }])
            .collect();
        let mut spectra = SpectrumFit::new(&frequencies_hz, &maps);
        let shifted: Vec<Vec<f64>> =
            frequencies_hz.iter().map(|hz| vec![law(*hz, -2.4, 0.0), law(*hz, -2.1, -0.5), 1.0]).collect();
        spectra.add_sample(&shifted);
        let found = spectra.finish();
        assert!((found.reference_hz / reference_hz - 1.0).abs() < 1e-12);
        for (values, expected) in [
            (&found.index, [-2.5, -2.1]),
            (&found.curvature, [0.0, -0.7]),
            (&found.index_sigma, [0.1, 0.0]),
            (&found.curvature_sigma, [0.0, 0.2]),
        ] {
            assert!(
                (values[0] - expected[0]).abs() < 1e-9 && (values[1] - expected[1]).abs() < 1e-9,
                "{values:?}"
            );
            assert!(values[2].is_nan());
        }
        let two = SpectrumFit::new(&[1e6, 4e6], &[vec![16.0], vec![1.0]]).finish();
        assert!((two.index[0] + 2.0).abs() < 1e-12 && two.curvature.is_empty());
    }
}
