//! Gridding kernels: windows of the non-uniform FFT (NUFFT) that interpolate between equally spaced nodes.
//!
//! There are two kinds:
//! - the *Kaiser-Bessel* window `phi(x) = I_0(beta sqrt(1 - (2x/w)^2)) / I_0(beta)`, |x| <= w/2 (Jackson et al. 1991;
//!   Fessler & Sutton 2003). Its transform is divided out of the data. With oversampling sigma its error is about
//!   `exp(-pi w sqrt(1 - 1/sigma))`. With five nodes that is half the error of the exponential of semicircle (Barnett, Magland &
//!   af Klinteberg 2019), and a fourth at the end of the band; evaluated as polynomials, both cost the same;
//! - the *windowed sinc* `sinc(x) K(2x/w)`, K the Kaiser window: it is longer, but its transform is 1 over the band, so that
//!   nothing has to be divided out. Interpolated weights need this kind: they multiply products of two patterns, out of which
//!   no transform can be divided.

use std::f64::consts::PI;

use crate::numerics::quadrature::GaussLegendre;
use crate::units::arithmetic::sinc;

/// Maximum width of a kernel, nodes.
pub(crate) const LANES: usize = 16;

/// Gridding kernel of compact support.
#[derive(Clone, Debug)]
pub(crate) struct Kernel {
    width: usize,
    shape: Shape,
    /// Coefficients of the polynomials in the distance from the centre, highest power first; one lane per node.
    polynomial: Vec<[f32; LANES]>,
}

/// Kind of a kernel, with its shape parameter beta and `I_0(beta)`.
#[derive(Clone, Copy, Debug)]
enum Shape {
    KaiserBessel { beta: f64, i0_beta: f64 },
    WindowedSinc { beta: f64, i0_beta: f64 },
}

impl Kernel {
    /// The narrowest Kaiser-Bessel window with an error below `tolerance` on a grid with `oversampling` > 1.
    pub(crate) fn new(tolerance: f64, oversampling: f64) -> Self {
        let rate = PI * (1.0 - 1.0 / oversampling).sqrt();
        let width = ((1.0 / tolerance).ln() / rate + 0.7).ceil().clamp(3.0, LANES as f64) as usize;
        Self::kaiser_bessel(width, oversampling)
    }

    /// The Kaiser-Bessel window of `width` <= 16 nodes for a grid with `oversampling` > 1.
    ///
    /// The error over the band is smallest for a `beta` slightly below the one that puts the transform's first zero at the first
    /// alias of the end of the band. The factors were found by trial.
    pub(crate) fn kaiser_bessel(width: usize, oversampling: f64) -> Self {
        let factor = if width <= 6 { 0.97 } else { 0.98 };
        let beta = factor * PI * width as f64 * (1.0 - 0.5 / oversampling);
        Self::with_shape(width, Shape::KaiserBessel { beta, i0_beta: bessel_i0(beta) })
    }

    /// A sinc of `width` <= 16 nodes under a Kaiser window of parameter `beta`; a larger `beta` gives a flatter band
    /// and a wider transition at half a cycle per node.
    pub(crate) fn windowed_sinc(width: usize, beta: f64) -> Self {
        Self::with_shape(width, Shape::WindowedSinc { beta, i0_beta: bessel_i0(beta) })
    }

    fn with_shape(width: usize, shape: Shape) -> Self {
        let mut kernel = Self { width, shape, polynomial: Vec::new() };
        kernel.polynomial = kernel.fit(width + 3);
        kernel
    }

    /// Width, nodes.
    pub(crate) fn width(&self) -> usize {
        self.width
    }

    /// The kernel at `x` grid steps from its centre.
    pub(crate) fn value(&self, x: f64) -> f64 {
        let t = 2.0 * x / self.width as f64;
        let inside = 1.0 - t * t;
        if inside < 0.0 {
            return 0.0;
        }
        match self.shape {
            Shape::KaiserBessel { beta, i0_beta } => bessel_i0(beta * inside.sqrt()) / i0_beta,
            Shape::WindowedSinc { beta, i0_beta } => sinc(PI * x) * bessel_i0(beta * inside.sqrt()) / i0_beta,
        }
    }

    /// The kernel's transform `Int phi(x) cos(2 pi f x) dx` at each of `frequencies`, cycles per step.
    pub(crate) fn transforms(&self, frequencies: &[f64]) -> Vec<f64> {
        let rule = GaussLegendre::new(64 + 8 * self.width);
        let half = 0.5 * self.width as f64;
        let values: Vec<f64> = rule.abscissae.iter().map(|t| self.value(half * t)).collect();
        let at = |f: f64| -> f64 {
            let terms = rule.abscissae.iter().zip(&rule.weights).zip(&values);
            2.0 * half * terms.map(|((t, w), v)| w * v * (2.0 * PI * f * half * t).cos()).sum::<f64>()
        };
        frequencies.iter().map(|&f| at(f)).collect()
    }

    /// The first node within the kernel's support about `x` (in grid steps), and the kernel at it and the following nodes.
    #[inline(always)]
    pub(crate) fn spread(&self, x: f64) -> (i64, [f32; LANES]) {
        let first = (x - 0.5 * self.width as f64).ceil();
        // t falls from 1 to -1 as x moves from one node to the next.
        let t = (2.0 * (first - (x - 0.5 * self.width as f64)) - 1.0) as f32;
        let mut lanes = [0.0; LANES];
        for row in &self.polynomial {
            for (lane, c) in lanes.iter_mut().zip(row) {
                *lane = *lane * t + c;
            }
        }
        (first as i64, lanes)
    }

    /// Fits polynomials of `degree` in t to the kernel at each node, through Chebyshev points.
    fn fit(&self, degree: usize) -> Vec<[f32; LANES]> {
        let n = degree + 1;
        let points: Vec<f64> = (0..n).map(|k| (PI * (k as f64 + 0.5) / n as f64).cos()).collect();
        let mut rows = vec![[0.0_f32; LANES]; n];
        for node in 0..self.width {
            let half = 0.5 * self.width as f64;
            // The node is (t + 1) / 2 + node - w / 2 steps from x.
            let values: Vec<f64> =
                points.iter().map(|t| self.value(0.5 * (t + 1.0) + node as f64 - half)).collect();
            for (row, c) in rows.iter_mut().zip(monomials(&points, &values).iter().rev()) {
                row[node] = *c as f32;
            }
        }
        rows
    }
}

/// The modified Bessel function I_0 by its power series, which has no cancellation.
fn bessel_i0(x: f64) -> f64 {
    let quarter = 0.25 * x * x;
    let (mut term, mut sum) = (1.0, 1.0);
    for k in 1..200 {
        term *= quarter / f64::from(k * k);
        sum += term;
        if term < 1e-17 * sum {
            break;
        }
    }
    sum
}

/// Coefficients, lowest power first, of the polynomial through the points (Newton's form, expanded).
fn monomials(points: &[f64], values: &[f64]) -> Vec<f64> {
    let n = points.len();
    let mut divided = values.to_vec();
    for order in 1..n {
        for k in (order..n).rev() {
            divided[k] = (divided[k] - divided[k - 1]) / (points[k] - points[k - order]);
        }
    }
    let mut coefficients = vec![0.0; n];
    for k in (0..n).rev() {
        for power in (1..n).rev() {
            coefficients[power] = coefficients[power - 1] - points[k] * coefficients[power];
        }
        coefficients[0] = divided[k] - points[k] * coefficients[0];
    }
    coefficients
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreading_with_the_transform_divided_out_interpolates() {
        for (tolerance, oversampling) in [(1e-4, 2.0), (1e-5, 1.5), (1e-6, 1.25), (1e-6, 2.0)] {
            let kernel = Kernel::new(tolerance, oversampling);
            for frequency in [0.0, 0.11, -0.3 / oversampling, 0.5 / oversampling] {
                let transform = kernel.transforms(&[frequency])[0];
                for k in 0..50 {
                    let x = 0.137 * f64::from(k) - 3.0;
                    let (first, lanes) = kernel.spread(x);
                    let phase = |x: f64| 2.0 * PI * frequency * x;
                    let (mut re, mut im) = (0.0, 0.0);
                    for (j, lane) in lanes.iter().enumerate().take(kernel.width()) {
                        let node = (first + j as i64) as f64;
                        let error = (f64::from(*lane) - kernel.value(node - x)).abs();
                        assert!(error < 0.1 * tolerance + 2e-7);
                        re += f64::from(*lane) / transform * phase(node).cos();
                        im += f64::from(*lane) / transform * phase(node).sin();
                    }
                    let error = (re - phase(x).cos()).hypot(im - phase(x).sin());
                    // The design rule is asymptotic, and least accurate at the end of the band; f32 adds 1e-6.
                    assert!(
                        error < 5.0 * tolerance + 1e-6,
                        "{tolerance} {oversampling} {frequency}: {error:e}"
                    );
                }
            }
        }
    }

    /// Mean and maximum error of the kernel in u, over all frequencies of the band and positions between nodes.
    #[test]
    fn five_nodes_at_three_and_a_half_a_wavelength_follow_a_fringe() {
        let kernel = Kernel::kaiser_bessel(5, 1.75);
        let (mut sum, mut error_max, mut count) = (0.0, 0.0_f64, 0.0);
        for frequency in (0..=100).map(|k| f64::from(k) / 350.0) {
            let transform = kernel.transforms(&[frequency])[0];
            for k in 0..64 {
                let (first, lanes) = kernel.spread((f64::from(k) + 0.5) / 64.0);
                let x = (f64::from(k) + 0.5) / 64.0;
                let (mut re, mut im) = (0.0, 0.0);
                for (j, lane) in lanes.iter().enumerate().take(5) {
                    let phase = 2.0 * PI * frequency * ((first + j as i64) as f64 - x);
                    re += f64::from(*lane) / transform * phase.cos();
                    im += f64::from(*lane) / transform * phase.sin();
                }
                let square: f64 = (re - 1.0).powi(2) + im * im;
                (sum, error_max, count) = (sum + square, error_max.max(square.sqrt()), count + 1.0);
            }
        }
        let mean = f64::sqrt(sum / count);
        // The kernel's formula evaluated with numpy in f64 gives 8.32e-5 and 3.177e-4; polynomials in f32 add some 1e-6.
        assert!(
            (mean - 8.32e-5).abs() < 2e-6 && (error_max - 3.177e-4).abs() < 5e-6,
            "{mean:e} {error_max:e}"
        );
    }

    /// The transform is 1 in the middle of the band, and falls where it should at the end.
    #[test]
    fn a_windowed_sinc_interpolates_as_it_is() {
        let kernel = Kernel::windowed_sinc(16, 7.0);
        for (frequency, tolerance) in [(0.0, 4e-4), (0.2, 4e-4), (0.35, 1e-3), (0.444, 0.32)] {
            for k in 0..50 {
                let x = 0.137 * f64::from(k) - 3.0;
                let (first, lanes) = kernel.spread(x);
                let phase = |x: f64| 2.0 * PI * frequency * x;
                let (mut re, mut im) = (0.0, 0.0);
                for (j, lane) in lanes.iter().enumerate() {
                    let node = (first + j as i64) as f64;
                    re += f64::from(*lane) * phase(node).cos();
                    im += f64::from(*lane) * phase(node).sin();
                }
                let error = (re - phase(x).cos()).hypot(im - phase(x).sin());
                // Kaiser's rule for beta = 7: ripples of -72 dB up to 0.36 cycles per node. The last frequency is in the transition,
                // which falls from 1 to 0 within 0.14 of 0.5.
                assert!(error < tolerance, "{frequency}: {error:e}");
            }
        }
    }
}
