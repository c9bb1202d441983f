//! Compact kernels: how a value between nodes is made from the nodes around it.
//!
//! Two kinds:
//! - the *exponential of semicircle* `phi(x) = exp(beta (sqrt(1 - (2x/w)^2) - 1))`, |x| <= w/2 (Barnett,
//!   Magland & af Klinteberg 2019). Its transform is divided out of what is interpolated. With oversampling
//!   sigma its error is about `exp(-pi w sqrt(1 - 1/sigma))`;
//! - the *windowed sinc* `sinc(x) K(2x/w)`, K the Kaiser window: longer, but with a transform that is 1 over the
//!   band, so nothing has to be divided out. That is what the weights need: they multiply products of
//!   two patterns, whose transforms cannot be divided out of one.

use std::f64::consts::PI;

use super::quadrature::GaussLegendre;
use crate::units::arithmetic::sinc;

/// Most nodes that a kernel reaches.
pub(crate) const LANES: usize = 16;

/// A compact kernel on a grid.
#[derive(Clone, Debug)]
pub(crate) struct Kernel {
    width: usize,
    shape: Shape,
    /// Coefficients of the polynomials in the distance to the middle, highest power first, one lane a node.
    polynomial: Vec<[f32; LANES]>,
}

/// Which of the two kinds, and how fast it falls off.
#[derive(Clone, Copy, Debug)]
enum Shape {
    Semicircle { beta: f64 },
    WindowedSinc { beta: f64, middle: f64 },
}

impl Kernel {
    /// The narrowest exponential of semicircle that errs by less than `tolerance` on a grid with
    /// `oversampling` > 1.
    pub(crate) fn new(tolerance: f64, oversampling: f64) -> Self {
        let rate = PI * (1.0 - 1.0 / oversampling).sqrt();
        let width = ((1.0 / tolerance).ln() / rate + 0.7).ceil().clamp(3.0, LANES as f64) as usize;
        Self::semicircle(width, oversampling)
    }

    /// The exponential of semicircle of `width` <= 16 nodes for a grid with `oversampling` > 1.
    pub(crate) fn semicircle(width: usize, oversampling: f64) -> Self {
        let beta = 0.976 * PI * width as f64 * (1.0 - 0.5 / oversampling);
        Self::of(width, Shape::Semicircle { beta })
    }

    /// A sinc of `width` <= 16 nodes under a Kaiser window of parameter `beta`; the greater that is, the flatter the
    /// band and the wider its edge at half a cycle a node.
    pub(crate) fn windowed_sinc(width: usize, beta: f64) -> Self {
        Self::of(width, Shape::WindowedSinc { beta, middle: bessel_i0(beta) })
    }

    fn of(width: usize, shape: Shape) -> Self {
        let mut kernel = Self { width, shape, polynomial: Vec::new() };
        kernel.polynomial = kernel.fit(width + 3);
        kernel
    }

    /// Number of nodes it reaches.
    pub(crate) fn width(&self) -> usize {
        self.width
    }

    /// At `x` grid steps from the middle.
    pub(crate) fn value(&self, x: f64) -> f64 {
        let t = 2.0 * x / self.width as f64;
        let inside = 1.0 - t * t;
        if inside < 0.0 {
            return 0.0;
        }
        match self.shape {
            Shape::Semicircle { beta } => (beta * (inside.sqrt() - 1.0)).exp(),
            Shape::WindowedSinc { beta, middle } => sinc(PI * x) * bessel_i0(beta * inside.sqrt()) / middle,
        }
    }

    /// `Int phi(x) cos(2 pi f x) dx` at each of `frequencies`, cycles a step.
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

    /// The first node reached from `x` (in grid steps), and the kernel at the nodes from there on.
    #[inline(always)]
    pub(crate) fn spread(&self, x: f64) -> (i64, [f32; LANES]) {
        let first = (x - 0.5 * self.width as f64).ceil();
        // From -1 to 1 as x goes from one node to the next.
        let t = (2.0 * (first - (x - 0.5 * self.width as f64)) - 1.0) as f32;
        let mut lanes = [0.0; LANES];
        for row in &self.polynomial {
            for (lane, c) in lanes.iter_mut().zip(row) {
                *lane = *lane * t + c;
            }
        }
        (first as i64, lanes)
    }

    /// Polynomials of `degree` in t that reproduce the kernel at each node, through Chebyshev points.
    fn fit(&self, degree: usize) -> Vec<[f32; LANES]> {
        let n = degree + 1;
        let points: Vec<f64> = (0..n).map(|k| (PI * (k as f64 + 0.5) / n as f64).cos()).collect();
        let mut rows = vec![[0.0_f32; LANES]; n];
        for node in 0..self.width {
            let half = 0.5 * self.width as f64;
            // The node lies at (t + 1) / 2 + node - w / 2 steps from x.
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
                    // The design rule is asymptotic, and worst at the end of the band; f32 adds 1e-6.
                    assert!(
                        error < 5.0 * tolerance + 1e-6,
                        "{tolerance} {oversampling} {frequency}: {error:e}"
                    );
                }
            }
        }
    }
    /// In the middle of the band nothing has to be divided out, and the fall at its edge is where it should be.
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
                // Kaiser's rule for beta = 7: ripples of 72 dB up to 0.36 cycles a node; the last is on the edge, where
                // half of the fall, from 1 to 0 over 0.14 either side of 0.5, has not yet come.
                assert!(error < tolerance, "{frequency}: {error:e}");
            }
        }
    }
}
