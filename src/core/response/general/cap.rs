//! Fringe patterns of satellite pairs in spherical harmonics: the whole-sky pattern minus that of the cap occulted by the Moon.
//!
//! With the pair's mean nadir as the pole, the occulted cap consists of complete rings, whose Fourier coefficients are Bessel
//! functions. Pairs with nearly the same limb form a class, which shares its rings and tables. The exception is the zone between the limb
//! of the class and that of the pair (see `limb_zone.rs`):
//!
//! ```text
//! q_{l m} = sum_rings v lambda_{l m}(theta) 2 pi (-1)^m J_m(2 pi u cos(p) sin theta) exp(2 pi i u sin(p) cos theta)
//!         + (-i)^m sum_j a_{j l m} c_{j m},
//! ```
//!
//! with u the baseline in wavelengths, p its pitch, l m about the nadir, v the quadrature weight of a ring, lambda the normalised Legendre functions, a their series in the
//! limb zone, and c the Fourier coefficients of the zone's moments. The pattern is mirror-symmetric in the plane of the pair, so that
//! `q_{l,-m} = q_{l m}`, and a quarter turn F takes the pole to the normal of the plane, l mu (see `turns.rs`):
//!
//! ```text
//! h_{l mu} = exp(-i mu p) sum_m F_{m mu} q_{l m},    (-1)^mu h_{l,-mu} = exp(i mu p) sum_m (-1)^m F_{m mu} q_{l m}.
//! ```
//!
//! Without the Moon the coefficients are `w_{l mu} = 4 pi (-1)^((l + mu) / 2) lambda_{l mu}(pi / 2) j_l(2 pi u)` (Rayleigh). The
//! pattern is `f = w - h`. A node is a pair at an instant whose row is computed, not interpolated; it takes a lane.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

use super::RowsSetup;
use super::classes::{NodeClass, rings_for};
use super::lanes::{LANES, VALUES, Value};
use super::limb_zone::{LimbZone, LimbZoneBuffers};
use super::plan::RowNode;
use super::turns::{QuarterTurns, strided_rows_mut};
use crate::frames::AntennaResponse;
use crate::numerics::bessel::BesselOrders;
use crate::numerics::legendre::Legendre;
use crate::numerics::quadrature::GaussLegendre;
use crate::numerics::trigonometry::sin_cos;
use crate::response::harmonic::degree_count;

/// Number of real and imaginary parts of [`LANES`] pairs.
const COMPLEX_LANES: usize = 2 * LANES;

#[derive(Clone, Copy, Debug)]
struct Ring {
    sin: f64,
    cos: f64,
    /// Maximum order m at which Legendre functions are not negligible on this ring.
    order_max: usize,
}

/// Tables shared by pairs whose limbs lie at about the same angle from the nadir.
#[derive(Clone, Debug)]
pub(super) struct CapClass {
    l_max: usize,
    limb_zone: LimbZone,
    /// Quadrature rings, ordered from the limb to the nadir.
    rings: Vec<Ring>,
    /// Number of leading rings on which Legendre functions are not negligible, by m.
    rings_by_order: Vec<usize>,
    /// For each m one row per l >= m: the series coefficients in the limb zone, then the weighted Legendre functions on the first
    /// `rings_by_order[m]` rings.
    legendre: Vec<Vec<Value>>,
    response: AntennaResponse,
}

/// Maximum order at which Legendre functions of degree `l_max` are not negligible at this sine: beyond m = l sin(theta) they decay
/// like an Airy function, with width (l sin(theta))^(1/3).
fn order_max(l_max: usize, sin: f64) -> usize {
    let turning = l_max as f64 * sin;
    l_max.min((turning + 8.0 * turning.cbrt()) as usize + 8)
}

/// The column of the real (0) or imaginary (1) part of a pair: groups of [`LANES`] real parts, then as many imaginary ones.
fn column_of(pair: usize, part: usize) -> usize {
    pair / LANES * COMPLEX_LANES + part * LANES + pair % LANES
}

/// Memory of a task's work buffers for `batch` pairs, without patterns, bytes.
pub(super) fn batch_bytes(l_max: usize, u_max: f64, batch: usize) -> f64 {
    let orders = (l_max + 1) as f64;
    let rings = (rings_for(l_max, FRAC_PI_2, u_max) + 16) as f64;
    // Real and imaginary parts of four bytes.
    8.0 * batch as f64 * orders * (rings + orders)
}

impl CapClass {
    pub(super) fn new(setup: &RowsSetup, class: &NodeClass) -> Self {
        let l_max = setup.l_max;
        let limb_rad = class.limb_rad;
        let rule = GaussLegendre::new(rings_for(l_max, limb_rad, class.u_max));
        let (mut rings, mut weights) = (Vec::new(), Vec::new());
        for (t, w) in rule.abscissae.iter().zip(&rule.weights).rev() {
            let (sin, cos) = (limb_rad * t).sin_cos();
            rings.push(Ring { sin, cos, order_max: order_max(l_max, sin) });
            weights.push(TAU * limb_rad * w * sin);
        }
        let limb_zone = LimbZone::new(setup, limb_rad, class.half_width_rad, class.u_max);
        let functions = Legendre::new(l_max, rings.iter().map(|ring| (ring.cos, ring.sin)));
        let angles = limb_zone.angles_rad();
        let limb_zone_legendre = Legendre::new(l_max, angles.iter().map(|theta| (theta.cos(), theta.sin())));
        let ones = vec![1.0; angles.len()];
        let rings_by_order: Vec<usize> =
            (0..=l_max).map(|m| rings.partition_point(|ring| ring.order_max >= m)).collect();
        let legendre = (0..=l_max)
            .into_par_iter()
            .map(|m| {
                let (terms, count) = (limb_zone.terms, rings_by_order[m]);
                let inner = functions.rows::<Value>(m, &weights[..count]);
                let outer = limb_zone_legendre.rows::<f64>(m, &ones);
                let mut rows = vec![0.0; (l_max + 1 - m) * (terms + count)];
                for (k, row) in rows.chunks_exact_mut(terms + count).enumerate() {
                    limb_zone.series(&outer[k * terms..(k + 1) * terms], &mut row[..terms]);
                    row[terms..].copy_from_slice(&inner[k * count..(k + 1) * count]);
                }
                rows
            })
            .collect();
        Self { l_max, limb_zone, rings, rings_by_order, legendre, response: setup.response }
    }

    /// Computes the coefficients `q_{l m}` of the occulted caps, `[l][m][group][real or imaginary part][lane]`.
    fn occulted<'a>(&self, nodes: &[RowNode], wavelength_m: f64, buffers: &'a mut CapBuffers) -> &'a [Value] {
        let groups = nodes.len().div_ceil(LANES);
        let columns = groups * COMPLEX_LANES;
        let (l_max, terms) = (self.l_max, self.limb_zone.terms);
        let height = terms + self.rings.len();
        // Only written elements are read: the orders up to each ring's maximum.
        buffers.coefficients.resize((l_max + 1) * height * columns, 0.0);
        for (group, nodes) in nodes.chunks(LANES).enumerate() {
            self.ring_coefficients(nodes, wavelength_m, group, columns, buffers);
        }
        self.limb_zone_coefficients(nodes, columns, buffers);
        buffers.occulted.resize((l_max + 1) * (l_max + 1) * columns, 0.0);
        for m in 0..=l_max {
            let inner = terms + self.rings_by_order[m];
            let rings = &buffers.coefficients[m * height * columns..][..inner * columns];
            let rows = l_max + 1 - m;
            let out = &mut buffers.occulted[(m * (l_max + 1) + m) * columns..];
            let out = &mut out[..(rows - 1) * (l_max + 1) * columns + columns];
            faer::linalg::matmul::matmul(
                strided_rows_mut(out, rows, columns, (l_max + 1) * columns),
                Accum::Replace,
                MatRef::from_row_major_slice(&self.legendre[m], rows, inner),
                MatRef::from_row_major_slice(rings, inner, columns),
                1.0,
                Par::Seq,
            );
        }
        &buffers.occulted
    }

    /// Computes the rings' coefficients of up to [`LANES`] pairs, `[m][row][column]`; the last pair is repeated to fill the remaining
    /// lanes.
    fn ring_coefficients(
        &self,
        nodes: &[RowNode],
        wavelength_m: f64,
        group: usize,
        columns: usize,
        buffers: &mut CapBuffers,
    ) {
        let (terms, height) = (self.limb_zone.terms, self.limb_zone.terms + self.rings.len());
        let Some(last) = nodes.last() else { return };
        let (mut horizontal, mut vertical) = ([0.0; LANES], [0.0; LANES]);
        let filled = nodes.iter().chain(std::iter::repeat(last)).take(LANES);
        for (k, node) in filled.enumerate() {
            let two_pi_u = TAU * node.view.baseline_m / wavelength_m;
            let (sin, cos) = node.view.pitch_rad().sin_cos();
            (horizontal[k], vertical[k]) = (two_pi_u * cos, two_pi_u * sin);
        }
        // The response of dipoles couples m to m - 2 and m + 2.
        let extra_orders = match self.response {
            AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 0,
            AntennaResponse::DipoleNormal => 2,
        };
        for (k, ring) in self.rings.iter().enumerate() {
            let x = horizontal.map(|wave| wave * ring.sin);
            let orders = buffers.bessel.cylindrical(&x, ring.order_max + extra_orders);
            let first = (terms + k) * columns + group * COMPLEX_LANES;
            let phases = phases(&vertical, ring.cos);
            let out = &mut buffers.coefficients[first..];
            write_ring(orders, &phases, ring, extra_orders > 0, out, height * columns);
        }
    }

    /// Computes the coefficients of the limb zones.
    fn limb_zone_coefficients(&self, nodes: &[RowNode], columns: usize, buffers: &mut CapBuffers) {
        let (terms, points) = (self.limb_zone.terms, self.limb_zone.points());
        let height = terms + self.rings.len();
        // `[term][column][psi]`, with a column for each part of each pair, as `column_of` says.
        let width = terms * columns;
        buffers.limb_zone.resize(points * width, 0.0);
        for pair in 0..columns / 2 {
            let Some(node) = nodes.get(pair).or(nodes.last()) else { return };
            if pair < nodes.len() {
                self.limb_zone.integrate(&node.view, &mut buffers.pair);
            }
            for (part, sums) in buffers.pair.sums.iter().enumerate() {
                for (term, sums) in sums.chunks_exact(points).enumerate() {
                    let place = (term * columns + column_of(pair, part)) * points;
                    let to = &mut buffers.limb_zone[place..place + points];
                    to.iter_mut().zip(sums).for_each(|(to, from)| *to = *from as Value);
                }
            }
        }
        let orders = self.l_max + 1;
        buffers.fourier.resize(orders * width, 0.0);
        faer::linalg::matmul::matmul(
            MatMut::from_row_major_slice_mut(&mut buffers.fourier, orders, width),
            Accum::Replace,
            MatRef::from_row_major_slice(&self.limb_zone.cos_weights, orders, points),
            MatRef::from_column_major_slice(&buffers.limb_zone, points, width),
            1.0,
            Par::Seq,
        );
        for (m, fourier) in buffers.fourier.chunks_exact(width).enumerate() {
            let out = &mut buffers.coefficients[m * height * columns..][..width];
            for (to, from) in out.chunks_exact_mut(COMPLEX_LANES).zip(fourier.chunks_exact(COMPLEX_LANES)) {
                let ((to_re, to_im), (re, im)) = (to.split_at_mut(LANES), from.split_at(LANES));
                // Times (-i)^m.
                for k in 0..LANES {
                    (to_re[k], to_im[k]) = match m % 4 {
                        0 => (re[k], im[k]),
                        1 => (im[k], -re[k]),
                        2 => (-re[k], -im[k]),
                        _ => (-im[k], re[k]),
                    };
                }
            }
        }
    }
}

/// Real and imaginary parts of `exp(i wave cos)`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn phases(waves: &[f64; LANES], cos: f64) -> [[f64; LANES]; 2] {
    let mut out = [[0.0; LANES]; 2];
    for k in 0..LANES {
        (out[1][k], out[0][k]) = sin_cos(waves[k] * cos);
    }
    out
}

/// Writes `(-1)^m J_m` times the phase for each m, with a stride of `stride`; with `dipole` for a ring weighted by the dipole response.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn write_ring(
    orders: &[[f64; LANES]],
    phases: &[[f64; LANES]; 2],
    ring: &Ring,
    dipole: bool,
    out: &mut [Value],
    stride: usize,
) {
    let quarter_sin2 = 0.25 * ring.sin * ring.sin;
    for m in 0..=ring.order_max {
        let sign = if m.is_multiple_of(2) { 1.0 } else { -1.0 };
        let out = &mut out[m * stride..m * stride + COMPLEX_LANES];
        let (re, im) = out.split_at_mut(LANES);
        for k in 0..LANES {
            let mut value = orders[m][k];
            if dipole {
                // 1 - sin^2(theta) sin^2(psi); J_{-m} = (-1)^m J_m.
                let j_minus_2 = if m == 1 { -orders[1][k] } else { orders[m.abs_diff(2)][k] };
                value = (1.0 - 2.0 * quarter_sin2) * value - quarter_sin2 * (orders[m + 2][k] + j_minus_2);
            }
            re[k] = (sign * value * phases[0][k]) as Value;
            im[k] = (sign * value * phases[1][k]) as Value;
        }
    }
}

/// Work buffers for the patterns of a batch.
#[derive(Clone, Debug, Default)]
pub(super) struct CapBuffers {
    bessel: BesselOrders,
    pair: LimbZoneBuffers,
    /// `[m][limb-zone term, then ring][column]`.
    coefficients: Vec<Value>,
    limb_zone: Vec<Value>,
    fourier: Vec<Value>,
    occulted: Vec<Value>,
    /// Contributions of even and of odd m after the quarter turn.
    rotated: [Vec<Value>; 2],
}

/// Tables of patterns shared by all classes.
#[derive(Clone, Debug)]
pub(super) struct Patterns {
    setup: RowsSetup,
    /// Factors of `j_l`, `j_{l+2}` and `j_{l-2}` in the whole-sky pattern, by mu and for l = mu, mu + 2, ..
    whole_sky: Vec<Vec<[f64; 3]>>,
}

impl Patterns {
    pub(super) fn new(setup: RowsSetup) -> Self {
        Self { whole_sky: whole_sky_factors(&setup), setup }
    }

    /// Computes the patterns of pairs of one class, by mu: rows of l = mu, mu + 2, .. for [`LANES`] pairs at a time.
    pub(super) fn write_patterns(
        &self,
        turns: &QuarterTurns,
        class: &CapClass,
        nodes: &[RowNode],
        buffers: &mut CapBuffers,
        out: &mut Vec<NodePatterns>,
    ) {
        let l_max = self.setup.l_max;
        let groups = nodes.len().div_ceil(LANES);
        let columns = groups * COMPLEX_LANES;
        class.occulted(nodes, self.setup.wavelength_m, buffers);
        out.resize_with(l_max + 1, NodePatterns::default);
        // All elements are overwritten.
        out.iter_mut().enumerate().for_each(|(mu, out)| out.resize(degree_count(l_max, mu), groups));
        let spherical_bessel = self.spherical_bessel(nodes, buffers);
        let pitches = pitch_phases(nodes, l_max);
        for l in 0..=l_max {
            let hidden = &buffers.occulted[l * (l_max + 1) * columns..][..(l + 1) * columns];
            turns.rotate_symmetric(l, hidden, columns, &mut buffers.rotated);
            let rotated = buffers.rotated.each_ref().map(Vec::as_slice);
            assemble(rotated, &pitches, &spherical_bessel, &self.whole_sky, [l, l_max, groups], out);
        }
    }

    /// Computes the spherical Bessel functions `j_l(2 pi u)`, l = 0 ..= l_max + 2, by group.
    fn spherical_bessel(&self, nodes: &[RowNode], buffers: &mut CapBuffers) -> Vec<[f64; LANES]> {
        let order_max = self.setup.l_max + 2;
        let mut out = Vec::with_capacity(nodes.len().div_ceil(LANES) * (order_max + 1));
        for nodes in nodes.chunks(LANES) {
            let last = nodes.last().map_or(1.0, |node| node.view.baseline_m);
            let x = std::array::from_fn(|k| {
                TAU * nodes.get(k).map_or(last, |node| node.view.baseline_m) / self.setup.wavelength_m
            });
            out.extend_from_slice(buffers.bessel.spherical(&x, order_max));
        }
        out
    }
}

/// Real and imaginary parts of `exp(-i mu p)` by group, mu and lane.
fn pitch_phases(nodes: &[RowNode], l_max: usize) -> [Vec<Value>; 2] {
    let mut out = [0, 1].map(|_| Vec::with_capacity(nodes.len().next_multiple_of(LANES) * (l_max + 1)));
    for nodes in nodes.chunks(LANES) {
        for mu in 0..=l_max {
            for k in 0..LANES {
                let pitch = nodes.get(k).or(nodes.last()).map_or(0.0, |node| node.view.pitch_rad());
                let (sin, cos) = sin_cos(-(mu as f64) * pitch);
                out[0].push(cos as Value);
                out[1].push(sin as Value);
            }
        }
    }
    out
}

/// Computes `f_{l mu}` and `(-1)^mu f_{l,-mu}` of all pairs at one degree: whole-sky minus occulted coefficients.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn assemble(
    [even, odd]: [&[Value]; 2],
    [cos, sin]: &[Vec<Value>; 2],
    spherical_bessel: &[[f64; LANES]],
    whole_sky: &[Vec<[f64; 3]>],
    [l, l_max, groups]: [usize; 3],
    out: &mut [NodePatterns],
) {
    let rows = even.chunks_exact(groups * COMPLEX_LANES).zip(odd.chunks_exact(groups * COMPLEX_LANES));
    for (mu, (even, odd)) in (l % 2..=l).step_by(2).zip(rows) {
        let (row, out) = ((l - mu) / 2, &mut out[mu]);
        let [factor, factor_plus_2, factor_minus_2] = whole_sky[mu][row];
        let sign: Value = if mu.is_multiple_of(2) { 1.0 } else { -1.0 };
        let parts = even.chunks_exact(COMPLEX_LANES).zip(odd.chunks_exact(COMPLEX_LANES));
        for (group, (even, odd)) in parts.enumerate() {
            let place = (group * (l_max + 1) + mu) * LANES;
            let (cos, sin) = (&cos[place..place + LANES], &sin[place..place + LANES]);
            let spherical = &spherical_bessel[group * (l_max + 3)..];
            let (j_minus_2, j, j_plus_2) =
                (&spherical[l.saturating_sub(2)], &spherical[l], &spherical[l + 2]);
            let ((even_re, even_im), (odd_re, odd_im)) = (even.split_at(LANES), odd.split_at(LANES));
            let out = &mut out.rows_mut(group)[row * VALUES..(row + 1) * VALUES];
            for k in 0..LANES {
                let whole =
                    (factor * j[k] + factor_plus_2 * j_plus_2[k] + factor_minus_2 * j_minus_2[k]) as Value;
                let (re, im) = (even_re[k] + odd_re[k], even_im[k] + odd_im[k]);
                out[k] = whole - (re * cos[k] - im * sin[k]);
                out[LANES + k] = -(re * sin[k] + im * cos[k]);
                let (re, im) = (even_re[k] - odd_re[k], even_im[k] - odd_im[k]);
                out[2 * LANES + k] = sign * whole - (re * cos[k] + im * sin[k]);
                out[3 * LANES + k] = -(im * cos[k] - re * sin[k]);
            }
        }
    }
}

/// Factors of `j_l`, `j_{l+2}` and `j_{l-2}` in the coefficients of a fringe over the whole sky, by mu and l. The response of dipoles is
/// `1 - z^2`, and multiplication by z couples degree l to l - 1 and l + 1.
fn whole_sky_factors(setup: &RowsSetup) -> Vec<Vec<[f64; 3]>> {
    let l_max = setup.l_max;
    let functions = Legendre::new(l_max + 2, std::iter::once((0.0, 1.0)));
    (0..=l_max)
        .map(|mu| {
            let values = functions.even_rows::<f64>(mu, &[4.0 * PI]);
            // The factor (-1)^((l + mu) / 2) alternates with l.
            let first = if mu.is_multiple_of(2) { 1.0 } else { -1.0 };
            let value = |row: usize| {
                values
                    .get(row)
                    .map_or(0.0, |value| if row.is_multiple_of(2) { first * value } else { -first * value })
            };
            // z lambda_l = coupling(l + 1) lambda_{l+1} + coupling(l) lambda_{l-1}.
            let coupling = |l: usize| {
                if l <= mu { 0.0 } else { (((l * l - mu * mu) as f64) / ((4 * l * l - 1) as f64)).sqrt() }
            };
            (0..degree_count(l_max, mu))
                .map(|row| {
                    let l = mu + 2 * row;
                    match setup.response {
                        AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => [value(row), 0.0, 0.0],
                        AntennaResponse::DipoleNormal => {
                            let from_l = (1.0 - coupling(l + 1).powi(2) - coupling(l).powi(2)) * value(row);
                            let from_l_plus_2 = -coupling(l + 1) * coupling(l + 2) * value(row + 1);
                            let from_l_minus_2 = match row {
                                0 => 0.0,
                                _ => -coupling(l) * coupling(l - 1) * value(row - 1),
                            };
                            [from_l, from_l_plus_2, from_l_minus_2]
                        }
                    }
                })
                .collect()
        })
        .collect()
}

/// Coefficients of the patterns of a batch at one mu: rows of l = mu, mu + 2, .. for [`LANES`] nodes at a time. A row has the real and
/// imaginary parts of `f_{l mu}`, then of `(-1)^mu f_{l,-mu}`, each by lane.
#[derive(Default)]
pub(super) struct NodePatterns {
    count: usize,
    coefficients: Vec<Value>,
}

impl NodePatterns {
    fn resize(&mut self, count: usize, groups: usize) {
        self.count = count;
        self.coefficients.resize(groups * count * VALUES, 0.0);
    }

    pub(super) fn rows(&self, group: usize) -> &[Value] {
        &self.coefficients[group * self.count * VALUES..][..self.count * VALUES]
    }

    fn rows_mut(&mut self, group: usize) -> &mut [Value] {
        &mut self.coefficients[group * self.count * VALUES..][..self.count * VALUES]
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use num_complex::Complex64;

    use super::super::view::PairView;
    use super::*;
    use crate::units::vector::{Vec3, add, dot, scale};

    const MOON_M: f64 = 1737.1e3;
    const L_MAX: usize = 14;
    const WAVELENGTH_M: f64 = 100.0;

    /// Two satellites in the plane of x and y.
    fn view(radii_m: [f64; 2], angles_rad: [f64; 2]) -> PairView {
        let at = |k: usize| [radii_m[k] * angles_rad[k].cos(), radii_m[k] * angles_rad[k].sin(), 0.0];
        PairView::new(at(0), at(1), MOON_M).unwrap()
    }

    /// Coefficients by quadrature on the pair's own axes. On each half circle from the mean zenith the limb is found by bisection, and
    /// Gauss-Legendre quadrature runs from there to the zenith.
    fn expected(view: &PairView, response: AntennaResponse) -> Vec<Vec<[Complex64; 2]>> {
        const CIRCLE: usize = 500;
        let rule = GaussLegendre::new(240);
        let (sin, cos) = view.pitch_rad().sin_cos();
        let (zenith, along): (Vec3, Vec3) = ([cos, sin, 0.0], [-sin, cos, 0.0]);
        let satellites = view.angle_rad.map(|angle| [angle.cos(), angle.sin(), 0.0]);
        let sees = |n: Vec3| satellites.iter().zip(view.cos_limb).all(|(at, limb)| dot(n, *at) >= -limb);
        let (mut points, mut values) = (Vec::new(), Vec::new());
        for k in 0..CIRCLE {
            let (sin_psi, cos_psi) = (TAU * (k as f64 + 0.5) / CIRCLE as f64).sin_cos();
            let away = add(scale(cos_psi, along), [0.0, 0.0, sin_psi]);
            let direction = |theta: f64| add(scale(theta.cos(), zenith), scale(theta.sin(), away));
            let (mut seen, mut hidden) = (FRAC_PI_2, PI);
            for _ in 0..60 {
                let middle = 0.5 * (seen + hidden);
                if sees(direction(middle)) { seen = middle } else { hidden = middle }
            }
            for (t, w) in rule.abscissae.iter().zip(&rule.weights) {
                let n = direction(seen * t);
                let gain = match response {
                    AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 1.0,
                    AntennaResponse::DipoleNormal => 1.0 - n[2] * n[2],
                };
                let size = TAU / CIRCLE as f64 * seen * w * (seen * t).sin() * gain;
                points.push(n);
                values.push(size * Complex64::cis(-TAU * view.baseline_m / WAVELENGTH_M * n[1]));
            }
        }
        let functions = Legendre::new(L_MAX, points.iter().map(|n| (n[2], n[0].hypot(n[1]))));
        let ones = vec![1.0; points.len()];
        (0..=L_MAX)
            .map(|mu| {
                let rows = functions.even_rows::<f64>(mu, &ones);
                rows.chunks_exact(points.len())
                    .map(|row| {
                        let mut sums = [Complex64::new(0.0, 0.0); 2];
                        for ((n, value), lambda) in points.iter().zip(&values).zip(row) {
                            let turn = Complex64::cis(-(mu as f64) * n[1].atan2(n[0]));
                            sums[0] += lambda * value * turn;
                            // The sign (-1)^mu of lambda_{l,-mu} cancels that of the expected (-1)^mu f_{l,-mu}.
                            sums[1] += lambda * value * turn.conj();
                        }
                        sums
                    })
                    .collect()
            })
            .collect()
    }

    #[test]
    fn patterns_are_integrals_over_what_both_see() {
        let views = [
            view([2037.1e3, 2037.1e3], [1e-4, -1e-4]),
            view([2037.1e3, 2037.1e3], [1.8e-5, -1.8e-5]),
            view([2036.6e3, 2037.7e3], [4e-4, -5e-4]),
            view([2051e3, 2050.2e3], [-9e-4, 9e-4]),
            view([2020e3, 2020.9e3], [6e-4, -1.1e-3]),
        ];
        for response in [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal] {
            let setup = RowsSetup {
                l_max: L_MAX,
                wavelength_m: WAVELENGTH_M,
                moon_radius_m: MOON_M,
                response,
                polynomial_degree: 0,
            };
            let nodes = views.map(|view| RowNode { turns_rad: [0.0; 3], view, class: 0 });
            let patterns = Patterns::new(setup);
            let middle_rad = views[0].cap_rad();
            let half_width_rad =
                |view: &PairView| (view.cap_rad() - middle_rad).abs() + view.limb_spread_rad();
            let class = NodeClass {
                limb_rad: middle_rad,
                half_width_rad: views.iter().map(half_width_rad).fold(0.0, f64::max),
                u_max: 40.0,
            };
            let class = CapClass::new(&setup, &class);
            let (mut buffers, mut found) = (CapBuffers::default(), Vec::new());
            patterns.write_patterns(&QuarterTurns::new(L_MAX), &class, &nodes, &mut buffers, &mut found);
            for (lane, view) in views.iter().enumerate() {
                for (mu, expected) in expected(view, response).iter().enumerate() {
                    for (k, expected) in expected.iter().enumerate() {
                        let part =
                            |part: usize| f64::from(found[mu].rows(0)[k * VALUES + part * LANES + lane]);
                        let found = [Complex64::new(part(0), part(1)), Complex64::new(part(2), part(3))];
                        for (found, expected) in found.iter().zip(expected) {
                            // f32 sums of about 100 terms of up to 4; the integrand of the reference quadrature has a kink in psi.
                            let error = (found - expected).norm();
                            assert!(error < 4e-6, "{lane} {mu} {k}: {found} {expected} {error:e}");
                        }
                    }
                }
            }
        }
    }
}
