//! Harmonic coefficients of a pair's fringe pattern at many baseline lengths.
//!
//! In the body frame (x to the zenith, y along the track, z the orbit normal) the pattern of a pair with
//! `u = b nu / c` is `f(n) = S_i S_j A exp(-2 pi i u n_y)`. A satellite at `psi = +-d/2` on the circle sees the
//! directions with `n_x cos(d/2) +- n_y sin(d/2) >= -cos a`, `cos a = sqrt(1 - (R_moon / r)^2)`. On the ring at
//! colatitude theta both therefore see `|psi| <= arccos(-cos a / sin theta) - d/2`, and the whole ring where
//! `sin theta < cos a`. With the rings' Fourier coefficients `I_mu` (see `ring.rs`)
//!
//! ```text
//! f_{l mu} = Int dtheta sin theta lambda_{l mu}(theta) I_mu(theta)
//! ```
//!
//! by Gauss-Legendre quadrature: in theta where rings are whole, and elsewhere in the angle chi along the Moon's limb,
//! `cos theta = (R_moon / r) sin chi`, in which the limb is analytic. f is real, and zero where l + mu is odd
//! (mirror symmetry in the orbital plane).
//!
//! Nodes may have negative u, and then negative d. This continues f analytically, as interpolation near u = 0
//! requires. (The sliver `|psi - pi| < d/2 - h` opposite the zenith, which the arc hidden from one satellite would leave, is
//! neglected: less than d^3 / 40 sr, 1e-10 sr at d = 1.8e-3.)

use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

use super::ring::RingSolver;
use crate::frames::AntennaResponse;
use crate::numerics::Real;
use crate::numerics::legendre::Legendre;
use crate::numerics::quadrature::GaussLegendre;

/// Parameters of a fringe pattern except the baseline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatternGeometry {
    /// Radius of the satellites' circle, m.
    pub orbit_radius_m: f64,
    /// Radius of the Moon, m; less than `orbit_radius_m`.
    pub moon_radius_m: f64,
    /// Wavelength, m.
    pub wavelength_m: f64,
    /// Response of the antennas.
    pub response: AntennaResponse,
}

/// Grid of equally spaced u.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NodeGrid {
    /// First value.
    pub first: f64,
    /// Spacing, positive.
    pub step: f64,
    /// Number of values.
    pub count: usize,
}

impl NodeGrid {
    /// Value of node `k`.
    #[must_use]
    pub fn u(&self, k: usize) -> f64 {
        self.first + self.step * k as f64
    }

    /// Maximum |u|.
    #[must_use]
    pub fn u_abs_max(&self) -> f64 {
        self.first.abs().max(self.u(self.count.saturating_sub(1)).abs())
    }
}

/// Coefficients `f_{l,mu}` and `(-1)^mu f_{l,-mu}` for mu >= 0 and l = mu, mu + 2, .. at every node.
#[derive(Clone, Debug)]
pub struct PatternTable<T> {
    l_max: usize,
    grid: NodeGrid,
    /// By mu, for each l a row of `2 count` values: `f_{l,mu}` at all nodes, then `(-1)^mu f_{l,-mu}`.
    blocks: Vec<Vec<T>>,
}

/// Maximum memory of the ring coefficients of one chunk of nodes, bytes.
const CHUNK_BYTES: usize = 400 << 20;

impl<T: Real> PatternTable<T> {
    /// Computes the coefficients for `l <= l_max` at the nodes of `grid`.
    #[must_use]
    pub fn new(geometry: PatternGeometry, l_max: usize, grid: NodeGrid) -> Self {
        let mut table = Self {
            l_max,
            grid,
            blocks: (0..=l_max)
                .map(|mu| vec![T::default(); 2 * grid.count * degree_count(l_max, mu)])
                .collect(),
        };
        let points = ring_points(geometry, l_max, grid.u_abs_max(), 1).0.len();
        let per_node = points * (2 * l_max + 1) * size_of::<T>();
        let chunk = (CHUNK_BYTES / per_node.max(1)).clamp(8, 128).min(grid.count.max(1));
        for first in (0..grid.count).step_by(chunk) {
            table.fill(geometry, first, chunk.min(grid.count - first));
        }
        table
    }

    fn fill(&mut self, geometry: PatternGeometry, first: usize, count: usize) {
        let (grid, l_max) = (self.grid, self.l_max);
        let u: Vec<f64> = (first..first + count).map(|k| grid.u(k)).collect();
        let u_max = u.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        let (rings, weights) = ring_points(geometry, l_max, u_max, 1);
        let orders = 2 * l_max + 1;
        let solver = RingSolver::new(std::f64::consts::TAU * u_max);
        let mut coefficients = vec![T::default(); rings.len() * orders * count];
        coefficients.par_chunks_mut(orders * count).zip(&rings).for_each_init(
            || (solver.clone(), vec![0.0; orders]),
            |(solver, orders_of_ring), (chunk, ring)| {
                let order_max = ring.order_max(l_max);
                let orders_of_ring = &mut orders_of_ring[..2 * order_max + 1];
                let chunk = &mut chunk[(l_max - order_max) * count..];
                for (k, &u) in u.iter().enumerate() {
                    let half = half_separation(geometry, u);
                    let limb = if ring.is_whole { ring.limb } else { ring.limb - half };
                    solver.solve(std::f64::consts::TAU * u * ring.sin_theta, limb, orders_of_ring);
                    for (place, value) in chunk[k..].iter_mut().step_by(count).zip(orders_of_ring.iter()) {
                        *place = T::table_entry(*value);
                    }
                }
            },
        );
        let legendre = Legendre::new(l_max, rings.iter().map(|ring| (ring.z, ring.sin_theta)));
        self.blocks.par_iter_mut().enumerate().for_each(|(mu, block)| {
            let rings_used = rings.partition_point(|ring| ring.order_max(l_max) >= mu);
            let rows = legendre.even_rows::<T>(mu, &weights[..rings_used]);
            let lambda = MatRef::from_column_major_slice(&rows, rings_used, degree_count(l_max, mu));
            let mut out = MatMut::from_column_major_slice_mut(block, 2 * grid.count, degree_count(l_max, mu));
            for (sign, order) in [(0, l_max + mu), (1, l_max - mu)] {
                let ring = MatRef::from_column_major_slice_with_stride(
                    &coefficients[order * count..],
                    count,
                    rings_used,
                    orders * count,
                );
                let out = out.as_mut().subrows_mut(sign * grid.count + first, count);
                // lambda_{l,-mu} = (-1)^mu lambda_{l,mu} gives the sign in the table.
                faer::linalg::matmul::matmul(out, Accum::Replace, ring, lambda, T::nearest(1.0), Par::Seq);
            }
        });
    }
}

impl<T> PatternTable<T> {
    /// Maximum degree.
    #[must_use]
    pub fn l_max(&self) -> usize {
        self.l_max
    }

    /// The nodes.
    #[must_use]
    pub fn grid(&self) -> NodeGrid {
        self.grid
    }

    /// Rows of order `mu >= 0` for l = mu, mu + 2, ..: `f_{l,mu}` at all nodes, then `(-1)^mu f_{l,-mu}` at all nodes.
    #[must_use]
    pub fn order(&self, mu: usize) -> &[T] {
        &self.blocks[mu]
    }

    pub(crate) fn orders_mut(&mut self) -> &mut [Vec<T>] {
        &mut self.blocks
    }
}

/// Number of degrees l = mu, mu + 2, .. <= l_max.
#[must_use]
pub fn degree_count(l_max: usize, mu: usize) -> usize {
    (l_max - mu) / 2 + 1
}

/// Half the angle between the satellites of a pair, seen from the Moon's centre, rad, with the sign of u.
fn half_separation(geometry: PatternGeometry, u: f64) -> f64 {
    (0.5 * u * geometry.wavelength_m / geometry.orbit_radius_m).clamp(-1.0, 1.0).asin()
}

/// Ring of the body frame at one colatitude.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RingPoint {
    pub(crate) z: f64,
    pub(crate) sin_theta: f64,
    /// The |psi| up to which a satellite at psi = 0 sees the ring, rad.
    limb: f64,
    /// Whether any satellite sees all of the ring.
    is_whole: bool,
}

impl RingPoint {
    /// Maximum order at which Legendre functions of degree `l_max` are not negligible on this ring: beyond
    /// m = l sin(theta) they decay like an Airy function, with width (l sin(theta))^(1/3).
    pub(crate) fn order_max(&self, l_max: usize) -> usize {
        let turning = l_max as f64 * self.sin_theta;
        l_max.min((turning + 8.0 * turning.cbrt()) as usize + 8)
    }
}

/// Returns the rings of the northern hemisphere, equator first, and their quadrature weights (for both hemispheres, with the
/// antennas' response), for degrees up to `l_max` and |u| up to `u_max`; `refine` multiplies the number of rings.
pub(crate) fn ring_points(
    geometry: PatternGeometry,
    l_max: usize,
    u_max: f64,
    refine: usize,
) -> (Vec<RingPoint>, Vec<f64>) {
    let sin_limb = (geometry.moon_radius_m / geometry.orbit_radius_m).clamp(0.0, 1.0);
    let cos_limb = (1.0 - sin_limb * sin_limb).sqrt();
    let wave_number = l_max as f64 + std::f64::consts::TAU * u_max;
    let response = |z: f64| match geometry.response {
        AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 1.0,
        AntennaResponse::DipoleNormal => 1.0 - z * z,
    };
    let (mut rings, mut weights) = (Vec::new(), Vec::new());
    let quarter = std::f64::consts::FRAC_PI_2;
    let omega = 0.5 * quarter * sin_limb * wave_number;
    let rule = GaussLegendre::new(refine * GaussLegendre::points_for(omega));
    for (t, w) in rule.abscissae.iter().zip(&rule.weights) {
        let (sin_chi, cos_chi) = (quarter * t).sin_cos();
        let z = sin_limb * sin_chi;
        let sin_theta = (1.0 - z * z).sqrt();
        rings.push(RingPoint { z, sin_theta, limb: (sin_limb * cos_chi).atan2(-cos_limb), is_whole: false });
        weights.push(2.0 * w * quarter * sin_limb * cos_chi * response(z));
    }
    let theta_max = cos_limb.asin();
    let rule = GaussLegendre::new(refine * GaussLegendre::points_for(0.5 * theta_max * wave_number));
    for (t, w) in rule.abscissae.iter().zip(&rule.weights).rev() {
        let (sin_theta, z) = (theta_max * t).sin_cos();
        rings.push(RingPoint { z, sin_theta, limb: std::f64::consts::PI, is_whole: true });
        weights.push(2.0 * w * theta_max * sin_theta * response(z));
    }
    (rings, weights)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn geometry() -> PatternGeometry {
        PatternGeometry {
            orbit_radius_m: 2_037_100.0,
            moon_radius_m: 1_737_100.0,
            wavelength_m: 30.0,
            response: AntennaResponse::Isotropic,
        }
    }

    /// More points do not change the result.
    #[test]
    fn quadrature_has_converged() {
        for (l_max, u) in [(8, 3.0), (60, 0.0), (12, 60.0), (50, 20.0)] {
            let (rings, weights) = ring_points(geometry(), l_max, u, 1);
            let (finer, finer_weights) = ring_points(geometry(), l_max, u, 2);
            let project = |rings: &[RingPoint], weights: &[f64], mu: usize| {
                let mut solver = RingSolver::new(400.0);
                let legendre = Legendre::new(l_max, rings.iter().map(|ring| (ring.z, ring.sin_theta)));
                let rows = legendre.even_rows::<f64>(mu, weights);
                let mut orders = vec![0.0; 2 * l_max + 1];
                let mut sums = vec![0.0; rows.len() / rings.len()];
                for (k, ring) in rings.iter().enumerate() {
                    solver.solve(std::f64::consts::TAU * u * ring.sin_theta, ring.limb, &mut orders);
                    for (sum, row) in sums.iter_mut().zip(rows.chunks_exact(rings.len())) {
                        *sum += row[k] * orders[l_max + mu];
                    }
                }
                sums
            };
            for mu in 0..=l_max {
                let few = project(&rings, &weights, mu);
                let many = project(&finer, &finer_weights, mu);
                for (a, b) in few.iter().zip(&many) {
                    // Phases of some hundred radians are rounded.
                    assert!((a - b).abs() < 2e-12, "{l_max} {u} {mu}: {a} {b}");
                }
            }
        }
    }

    /// By Parseval's theorem the power of the coefficients is the visible solid angle, except for the tail beyond `l_max` (about
    /// the length of the limb over 2 pi^2 l_max).
    #[test]
    fn power_is_the_visible_solid_angle() {
        let grid = NodeGrid { first: 0.0, step: 7.0, count: 2 };
        let table = PatternTable::<f64>::new(geometry(), 150, grid);
        let cos_limb = (1.0 - (1_737_100.0_f64 / 2_037_100.0).powi(2)).sqrt();
        let visible = std::f64::consts::TAU * (1.0 + cos_limb);
        for k in 0..2 {
            let power: f64 = (0..=150)
                .flat_map(|mu| table.order(mu).chunks_exact(4).map(move |row| (mu, row)))
                .map(|(mu, row)| row[k].powi(2) + if mu > 0 { row[2 + k].powi(2) } else { 0.0 })
                .sum();
            assert!(power < visible && power > 0.995 * visible, "{power} {visible}");
        }
    }
}
