//! What the Moon hides between the limb of a class and that of a pair.
//!
//! Seen from the mean nadir of a pair, its two satellites' limbs lie at angles `theta_b(psi)` that differ little from the
//! class's `theta_c`. In between, Legendre functions are series of Chebyshev polynomials of
//! `tau = (theta - theta_c) / width`, so that the coefficients
//!
//! ```text
//! c_{j m} = Int dpsi exp(-i m psi) Int_{theta_c}^{theta_b(psi)} dtheta sin(theta) A T_j(tau) exp(-2 pi i u n_y)
//! ```
//!
//! are all that a pair needs: the inner integral by Gauss-Legendre quadrature at points in psi, the outer as sums over these
//! (the integrand is even in psi and but for two slight kinks smooth).

use std::f64::consts::{PI, TAU};

use super::RowsSetup;
use super::lanes::Value;
use super::view::PairView;
use crate::frames::AntennaResponse;
use crate::numerics::quadrature::GaussLegendre;
use crate::numerics::trigonometry::sin_cos;

/// Relative error of Legendre functions as series.
const SERIES_ERROR: f64 = 1e-7;

/// Steps of Newton's iteration for the limb's angle, whose error is squared in each: the first is (half the separation)^2.
const NEWTON: usize = 4;

/// Points in psi beyond those that the fringe's and the harmonics' orders take.
const MARGIN: f64 = 24.0;

/// The zone around a class's limb.
#[derive(Clone, Debug)]
pub(super) struct Border {
    limb_rad: f64,
    width_rad: f64,
    /// Terms of the series.
    pub(super) terms: usize,
    /// `[term][point]`: from values at the series' points to its coefficients.
    to_series: Vec<f64>,
    /// Cosines and sines of the points psi, 0 ..= pi.
    cos_psi: Vec<f64>,
    sin_psi: Vec<f64>,
    rule: GaussLegendre,
    /// `[m][psi]`: `cos(m psi)` times the weight of the point, over the whole circle.
    pub(super) waves: Vec<Value>,
    response: AntennaResponse,
    wavelength_m: f64,
}

/// Room for one pair.
#[derive(Clone, Debug, Default)]
pub(super) struct BorderBuffers {
    /// `theta_b - theta_c` by psi.
    depth: Vec<f64>,
    /// `[part][term][psi]`.
    pub(super) sums: [Vec<f64>; 2],
}

impl Border {
    /// For pairs of up to `u_max` wavelengths whose limbs lie within `width_rad` of `limb_rad`.
    pub(super) fn new(setup: &RowsSetup, limb_rad: f64, width_rad: f64, u_max: f64) -> Self {
        let fringe = TAU * u_max;
        let orders = fringe * (limb_rad + width_rad).sin().min(1.0);
        let count = (0.5 * (orders + setup.l_max as f64) + 4.0 * orders.cbrt() + MARGIN).ceil() as usize;
        let psi: Vec<f64> = (0..=count).map(|k| PI * k as f64 / count as f64).collect();
        let weight = |k: usize| if k == 0 || k == count { PI / count as f64 } else { TAU / count as f64 };
        // Multiples of psi are points of the circle too.
        let circle: Vec<f64> = (0..2 * count).map(|k| (PI * k as f64 / count as f64).cos()).collect();
        let waves = (0..=setup.l_max)
            .flat_map(|m| (0..=count).map(move |k| (m * k, k)))
            .map(|(mk, k)| (weight(k) * circle[mk % (2 * count)]) as Value)
            .collect();
        let terms = terms(setup.l_max as f64 * width_rad);
        Self {
            limb_rad,
            width_rad,
            terms,
            to_series: (0..terms).flat_map(|j| (0..terms).map(move |k| to_series(terms, j, k))).collect(),
            cos_psi: psi.iter().map(|psi| psi.cos()).collect(),
            sin_psi: psi.iter().map(|psi| psi.sin()).collect(),
            rule: GaussLegendre::new(points(0.5 * width_rad * (setup.l_max as f64 + fringe))),
            waves,
            response: setup.response,
            wavelength_m: setup.wavelength_m,
        }
    }

    /// Points in psi.
    pub(super) fn points(&self) -> usize {
        self.cos_psi.len()
    }

    /// Angles from the nadir, rad, at which the series interpolates: Chebyshev's points.
    pub(super) fn angles_rad(&self) -> Vec<f64> {
        (0..self.terms).map(|k| self.limb_rad + self.width_rad * node(self.terms, k).cos()).collect()
    }

    /// The series' coefficients of a function from its values at [`Self::angles_rad`].
    pub(super) fn series(&self, values: &[f64], out: &mut [Value]) {
        for (out, strides) in out.iter_mut().zip(self.to_series.chunks_exact(self.terms)) {
            *out = strides.iter().zip(values).map(|(share, value)| share * value).sum::<f64>() as Value;
        }
    }

    /// Fills `buffers.sums` with the inner integrals of a pair.
    pub(super) fn integrate(&self, view: &PairView, buffers: &mut BorderBuffers) {
        let points = self.points();
        buffers.depth.clear();
        buffers.depth.resize(points, f64::NEG_INFINITY);
        let pitch = view.pitch_rad();
        for (angle, cos_limb) in view.angle_rad.into_iter().zip(view.cos_limb) {
            let (sin_away, cos_away) = (angle - pitch).sin_cos();
            limb(self.limb_rad, cos_limb.acos(), [cos_away, -sin_away], &self.cos_psi, &mut buffers.depth);
        }
        let wave = TAU * view.baseline_m / self.wavelength_m;
        let (sin_pitch, cos_pitch) = pitch.sin_cos();
        let dipole = match self.response {
            AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 0.0,
            AntennaResponse::DipoleNormal => 1.0,
        };
        for sums in &mut buffers.sums {
            sums.clear();
            sums.resize(self.terms * points, 0.0);
        }
        let [re, im] = &mut buffers.sums;
        for (t, weight) in self.rule.abscissae.iter().zip(&self.rule.weights) {
            let at = InnerPoint {
                limb_rad: self.limb_rad,
                inverse_width: 1.0 / self.width_rad,
                t: *t,
                weight: *weight,
                along: wave * cos_pitch,
                down: wave * sin_pitch,
                dipole,
            };
            add_point(&at, [&self.cos_psi, &self.sin_psi], &buffers.depth, re, im);
        }
    }
}

/// Chebyshev's points, as angles.
fn node(terms: usize, k: usize) -> f64 {
    PI * (k as f64 + 0.5) / terms as f64
}

/// The share of the value at point k in the coefficient of `T_j`.
fn to_series(terms: usize, j: usize, k: usize) -> f64 {
    (if j == 0 { 1.0 } else { 2.0 }) / terms as f64 * (j as f64 * node(terms, k)).cos()
}

/// Terms of a Chebyshev series of `exp(i h tau)`: its coefficients fall as `J_j(h)`.
fn terms(h: f64) -> usize {
    let mut term = 1.0;
    let mut j = 0;
    while term > SERIES_ERROR || (j as f64) < h {
        j += 1;
        term *= 0.5 * h / j as f64;
    }
    j.max(2)
}

/// Points of a Gauss-Legendre rule for `exp(i h t)`, |t| <= 1, to some 1e-9: the remainder falls as `(h / 2)^(2 n) / (2 n)!`.
fn points(h: f64) -> usize {
    let mut remainder = 1.0;
    let mut n = 0;
    while remainder > 1e-10 || (2 * n) as f64 <= h {
        n += 1;
        remainder *= (0.5 * h).powi(2) / (2 * n * (2 * n - 1)) as f64;
    }
    n.max(2)
}

/// Raises `depth` to where this satellite's limb lies beyond the class's, by psi: the limb obeys
/// `cos(theta) a + sin(theta) b cos(psi) = cos(limb)` where the satellite's nadir is at `(a, b)`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn limb(class_rad: f64, limb_rad: f64, nadir: [f64; 2], cos_psi: &[f64], depth: &mut [f64]) {
    let cos_limb = sin_cos(limb_rad).1;
    for (cos_psi, depth) in cos_psi.iter().zip(depth) {
        let across = nadir[1] * cos_psi;
        let mut theta = limb_rad;
        for _ in 0..NEWTON {
            let (sin, cos) = sin_cos(theta);
            let value = cos * nadir[0] + sin * across - cos_limb;
            let slope = cos * across - sin * nadir[0];
            theta -= value / slope;
        }
        *depth = depth.max(theta - class_rad);
    }
}

/// A point of the inner quadrature.
struct InnerPoint {
    limb_rad: f64,
    inverse_width: f64,
    t: f64,
    weight: f64,
    /// `2 pi u` times cosine and sine of the pitch.
    along: f64,
    down: f64,
    /// 1 for a dipole along the normal, 0 for isotropic antennas.
    dipole: f64,
}

/// Adds a point of the inner quadrature to all terms at all psi.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn add_point(
    at: &InnerPoint,
    [cos_psi, sin_psi]: [&[f64]; 2],
    depth: &[f64],
    re: &mut [f64],
    im: &mut [f64],
) {
    const BLOCK: usize = 16;
    let count = depth.len();
    let terms = re.len() / count.max(1);
    for first in (0..count).step_by(BLOCK) {
        let length = BLOCK.min(count - first);
        let mut tau = [0.0; BLOCK];
        let [mut before_re, mut before_im, mut now_re, mut now_im] = [[0.0; BLOCK]; 4];
        for k in 0..length {
            let depth = depth[first + k];
            let (sin, cos) = sin_cos(at.limb_rad + depth * at.t);
            let out_of_plane = sin * sin_psi[first + k];
            let size = at.weight * depth * sin * (1.0 - at.dipole * out_of_plane * out_of_plane);
            let (phase_sin, phase_cos) = sin_cos(at.along * sin * cos_psi[first + k] - at.down * cos);
            tau[k] = depth * at.t * at.inverse_width;
            (now_re[k], now_im[k]) = (size * phase_cos, -size * phase_sin);
            // T_{-1} = T_1.
            (before_re[k], before_im[k]) = (tau[k] * now_re[k], tau[k] * now_im[k]);
        }
        for term in 0..terms {
            let place = term * count + first;
            let (re, im) = (&mut re[place..place + length], &mut im[place..place + length]);
            for k in 0..length {
                re[k] += now_re[k];
                im[k] += now_im[k];
            }
            for k in 0..BLOCK {
                let next_re = 2.0 * tau[k] * now_re[k] - before_re[k];
                let next_im = 2.0 * tau[k] * now_im[k] - before_im[k];
                (before_re[k], now_re[k]) = (now_re[k], next_re);
                (before_im[k], now_im[k]) = (now_im[k], next_im);
            }
        }
    }
}
