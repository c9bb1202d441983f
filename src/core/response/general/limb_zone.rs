//! The part of the occulted sky between the limb of a class and the limb of a pair.
//!
//! Measured from the mean nadir of a pair, the limbs of its two satellites lie at angles `theta_b(psi)` that differ little from the
//! class's `theta_c`. In between, Legendre functions are expanded in Chebyshev polynomials of
//! `tau = (theta - theta_c) / width`, so that the coefficients
//!
//! ```text
//! c_{j m} = Int dpsi exp(-i m psi) Int_{theta_c}^{theta_b(psi)} dtheta sin(theta) A T_j(tau) exp(-2 pi i u n_y)
//! ```
//!
//! are all that a pair needs. The inner integral is a Gauss-Legendre quadrature at points in psi, the outer one a sum over these
//! points (the integrand is even in psi, and smooth except for two slight kinks).

use std::f64::consts::{PI, TAU};

use super::RowsSetup;
use super::lanes::Value;
use super::view::PairView;
use crate::frames::AntennaResponse;
use crate::numerics::quadrature::GaussLegendre;
use crate::numerics::trigonometry::sin_cos;

/// Maximum relative error of the series of Legendre functions.
const SERIES_ERROR: f64 = 1e-7;

/// Newton steps for the angle of the limb. Each squares the error, which begins as (half the separation)^2.
const NEWTON_STEPS: usize = 4;

/// Additional points in psi beyond the orders of the fringe and of the harmonics.
const POINTS_MARGIN: f64 = 24.0;

/// The zone around the limb of a class.
#[derive(Clone, Debug)]
pub(super) struct LimbZone {
    limb_rad: f64,
    half_width_rad: f64,
    /// Number of terms of the series.
    pub(super) terms: usize,
    /// Matrix `[term][point]` from values at the Chebyshev points to the series' coefficients.
    to_series: Vec<f64>,
    /// Cosines and sines of the points psi, 0 ..= pi.
    cos_psi: Vec<f64>,
    sin_psi: Vec<f64>,
    rule: GaussLegendre,
    /// `cos(m psi)` times the quadrature weight over the whole circle, `[m][psi]`.
    pub(super) cos_weights: Vec<Value>,
    response: AntennaResponse,
    wavelength_m: f64,
}

/// Work buffers for one pair.
#[derive(Clone, Debug, Default)]
pub(super) struct LimbZoneBuffers {
    /// `theta_b - theta_c` by psi.
    depth: Vec<f64>,
    /// Inner integrals, `[part][term][psi]`.
    pub(super) sums: [Vec<f64>; 2],
}

impl LimbZone {
    /// Prepares the zone for pairs of up to `u_max` wavelengths whose limbs lie within `half_width_rad` of `limb_rad`.
    pub(super) fn new(setup: &RowsSetup, limb_rad: f64, half_width_rad: f64, u_max: f64) -> Self {
        let fringe = TAU * u_max;
        let orders = fringe * (limb_rad + half_width_rad).sin().min(1.0);
        let count =
            (0.5 * (orders + setup.l_max as f64) + 4.0 * orders.cbrt() + POINTS_MARGIN).ceil() as usize;
        let psi: Vec<f64> = (0..=count).map(|k| PI * k as f64 / count as f64).collect();
        let weight = |k: usize| if k == 0 || k == count { PI / count as f64 } else { TAU / count as f64 };
        // Multiples of a point psi are points of the same circle.
        let circle: Vec<f64> = (0..2 * count).map(|k| (PI * k as f64 / count as f64).cos()).collect();
        let cos_weights = (0..=setup.l_max)
            .flat_map(|m| (0..=count).map(move |k| (m * k, k)))
            .map(|(mk, k)| (weight(k) * circle[mk % (2 * count)]) as Value)
            .collect();
        let terms = series_terms(setup.l_max as f64 * half_width_rad);
        Self {
            limb_rad,
            half_width_rad,
            terms,
            to_series: (0..terms).flat_map(|j| (0..terms).map(move |k| series_weight(terms, j, k))).collect(),
            cos_psi: psi.iter().map(|psi| psi.cos()).collect(),
            sin_psi: psi.iter().map(|psi| psi.sin()).collect(),
            rule: GaussLegendre::new(gauss_points(0.5 * half_width_rad * (setup.l_max as f64 + fringe))),
            cos_weights,
            response: setup.response,
            wavelength_m: setup.wavelength_m,
        }
    }

    pub(super) fn points(&self) -> usize {
        self.cos_psi.len()
    }

    /// Chebyshev points of the series, as angles from the nadir, rad.
    pub(super) fn angles_rad(&self) -> Vec<f64> {
        (0..self.terms)
            .map(|k| self.limb_rad + self.half_width_rad * chebyshev_angle(self.terms, k).cos())
            .collect()
    }

    /// Computes the series' coefficients of a function from its values at [`Self::angles_rad`].
    pub(super) fn series(&self, values: &[f64], out: &mut [Value]) {
        for (out, row) in out.iter_mut().zip(self.to_series.chunks_exact(self.terms)) {
            *out = row.iter().zip(values).map(|(element, value)| element * value).sum::<f64>() as Value;
        }
    }

    /// Computes the inner integrals of a pair into `buffers.sums`.
    pub(super) fn integrate(&self, view: &PairView, buffers: &mut LimbZoneBuffers) {
        let points = self.points();
        buffers.depth.clear();
        buffers.depth.resize(points, f64::NEG_INFINITY);
        let pitch = view.pitch_rad();
        for (angle, cos_limb) in view.angle_rad.into_iter().zip(view.cos_limb) {
            let (sin_away, cos_away) = (angle - pitch).sin_cos();
            raise_to_limb(
                self.limb_rad,
                cos_limb.acos(),
                [cos_away, -sin_away],
                &self.cos_psi,
                &mut buffers.depth,
            );
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
                inverse_width: 1.0 / self.half_width_rad,
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

/// Angle whose cosine is the k-th Chebyshev point.
fn chebyshev_angle(terms: usize, k: usize) -> f64 {
    PI * (k as f64 + 0.5) / terms as f64
}

/// Weight of the value at point k in the coefficient of `T_j`.
fn series_weight(terms: usize, j: usize, k: usize) -> f64 {
    (if j == 0 { 1.0 } else { 2.0 }) / terms as f64 * (j as f64 * chebyshev_angle(terms, k)).cos()
}

/// Number of terms of the Chebyshev series of `exp(i h tau)`, whose coefficients fall as `J_j(h)`.
fn series_terms(h: f64) -> usize {
    let mut term = 1.0;
    let mut j = 0;
    while term > SERIES_ERROR || (j as f64) < h {
        j += 1;
        term *= 0.5 * h / j as f64;
    }
    j.max(2)
}

/// Number of Gauss-Legendre points for `exp(i h t)`, |t| <= 1, to some 1e-9: the remainder falls as `(h / 2)^(2 n) / (2 n)!`.
fn gauss_points(h: f64) -> usize {
    let mut remainder = 1.0;
    let mut n = 0;
    while remainder > 1e-10 || (2 * n) as f64 <= h {
        n += 1;
        remainder *= (0.5 * h).powi(2) / (2 * n * (2 * n - 1)) as f64;
    }
    n.max(2)
}

/// Raises `depth` by psi to the distance of this satellite's limb beyond the class's: the limb obeys
/// `cos(theta) a + sin(theta) b cos(psi) = cos(limb)` for a satellite with its nadir at `(a, b)`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn raise_to_limb(class_rad: f64, limb_rad: f64, nadir: [f64; 2], cos_psi: &[f64], depth: &mut [f64]) {
    let cos_limb = sin_cos(limb_rad).1;
    for (cos_psi, depth) in cos_psi.iter().zip(depth) {
        let across = nadir[1] * cos_psi;
        let mut theta = limb_rad;
        for _ in 0..NEWTON_STEPS {
            let (sin, cos) = sin_cos(theta);
            let value = cos * nadir[0] + sin * across - cos_limb;
            let slope = cos * across - sin * nadir[0];
            theta -= value / slope;
        }
        *depth = depth.max(theta - class_rad);
    }
}

struct InnerPoint {
    limb_rad: f64,
    inverse_width: f64,
    t: f64,
    weight: f64,
    /// `2 pi u` times the cosine of the pitch.
    along: f64,
    /// `2 pi u` times the sine of the pitch.
    down: f64,
    /// 1 for a dipole along the normal, 0 for isotropic antennas.
    dipole: f64,
}

/// Adds a point of the inner quadrature to all terms and psi.
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
