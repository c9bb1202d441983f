//! Spectra of pixels: `ln T = ln T_0 + beta ln(nu / nu_0) + 1/2 c ln(nu / nu_0)^2` fitted to the maps of all channels.

/// Spectral index and curvature of every pixel, with their standard deviations; NaN where a channel's map is not positive.
#[derive(Clone, Debug, PartialEq)]
pub struct SpectralMaps {
    /// nu_0, Hz: the geometric mean of the channels.
    pub reference_hz: f64,
    /// beta: d ln T / d ln nu at nu_0.
    pub index: Vec<f64>,
    /// Its standard deviation.
    pub index_sigma: Vec<f64>,
    /// c: the change of beta an e-folding of frequency; empty with fewer than three channels.
    pub curvature: Vec<f64>,
    /// Its standard deviation.
    pub curvature_sigma: Vec<f64>,
}

/// Index and curvature as sums over ln T of channels, and what samples scatter.
pub(super) struct Spectra {
    reference_hz: f64,
    /// Weights of ln T of each channel in ln T_0, beta and, with three channels or more, c.
    weights: Vec<Vec<f64>>,
    /// [beta, c][pixel].
    fitted: Vec<Vec<f64>>,
    squares: Vec<Vec<f64>>,
    /// Samples that counted in each pixel.
    counts: Vec<f64>,
}

impl Spectra {
    pub(super) fn new(frequencies_hz: &[f64], maps_k: &[Vec<f64>]) -> Self {
        let logarithms: Vec<f64> = frequencies_hz.iter().map(|hz| hz.ln()).collect();
        let centre = logarithms.iter().sum::<f64>() / logarithms.len() as f64;
        let x: Vec<f64> = logarithms.iter().map(|ln| ln - centre).collect();
        let weights = fit_weights(&x);
        let fitted = fits(&weights, maps_k);
        let pixels = maps_k.first().map_or(0, Vec::len);
        let squares = vec![vec![0.0; pixels]; fitted.len()];
        Self { reference_hz: centre.exp(), weights, fitted, squares, counts: vec![0.0; pixels] }
    }

    pub(super) fn add_sample(&mut self, maps_k: &[Vec<f64>]) {
        let sample = fits(&self.weights, maps_k);
        for pixel in 0..self.counts.len() {
            let off: Vec<f64> = sample.iter().zip(&self.fitted).map(|(a, b)| a[pixel] - b[pixel]).collect();
            if off.iter().all(|off| off.is_finite()) {
                self.counts[pixel] += 1.0;
                self.squares.iter_mut().zip(off).for_each(|(sum, off)| sum[pixel] += off * off);
            }
        }
    }

    pub(super) fn end(self) -> SpectralMaps {
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

/// The rows of the least-squares inverse for beta and c: of orthogonal polynomials, so that no matrix is inverted.
fn fit_weights(x: &[f64]) -> Vec<Vec<f64>> {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let square: Vec<f64> = x.iter().map(|x| x * x).collect();
    let mean = square.iter().sum::<f64>() / x.len() as f64;
    let slope = dot(&square, x) / dot(x, x);
    // x^2 less its mean and its slope: x has no mean.
    let bent: Vec<f64> = square.iter().zip(x).map(|(s, x)| s - mean - slope * x).collect();
    let norm = dot(&bent, &bent);
    if x.len() < 3 || norm <= 0.0 {
        return vec![x.iter().map(|value| value / dot(x, x)).collect()];
    }
    // y = a + b x + q bent: c = 2 q, and the slope at x = 0 is b - q slope.
    let of = |value: &f64, bent: &f64| value / dot(x, x) - slope * bent / norm;
    vec![
        x.iter().zip(&bent).map(|(value, bent)| of(value, bent)).collect(),
        bent.iter().map(|bent| 2.0 * bent / norm).collect(),
    ]
}

fn fits(weights: &[Vec<f64>], maps_k: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let pixels = maps_k.first().map_or(0, Vec::len);
    let of_pixel = |weights: &Vec<f64>, pixel: usize| {
        // The logarithm of what is not positive is no number, and so is the sum.
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
    fn index_and_curvature_of_a_bent_power_law_come_back() {
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
        let mut spectra = Spectra::new(&frequencies_hz, &maps);
        let shifted: Vec<Vec<f64>> =
            frequencies_hz.iter().map(|hz| vec![law(*hz, -2.4, 0.0), law(*hz, -2.1, -0.5), 1.0]).collect();
        spectra.add_sample(&shifted);
        let found = spectra.end();
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
        let two = Spectra::new(&[1e6, 4e6], &[vec![16.0], vec![1.0]]).end();
        assert!((two.index[0] + 2.0).abs() < 1e-12 && two.curvature.is_empty());
    }
}
