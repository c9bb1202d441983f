//! Patterns of pairs: the view of both satellites without the Moon, less the cap that it hides.
//!
//! From the mean nadir of the pair as the pole the hidden cap is made of whole rings, whose Fourier coefficients are Bessel
//! functions, but for the zone between the class's limb and the pair's (see `border.rs`):
//!
//! ```text
//! q_{l m} = sum_rings w lambda_{l m}(theta) 2 pi (-1)^m J_m(2 pi u cos(p) sin theta) exp(2 pi i u sin(p) cos theta)
//!         + (-i)^m sum_j a_{j l m} c_{j m},
//! ```
//!
//! p being the pitch of the baseline. The pattern is mirror-symmetric in the plane of the pair, so that
//! `q_{l,-m} = q_{l m}`, and a quarter turn takes the pole to the normal of the plane (see `turns.rs`):
//!
//! ```text
//! h_{l mu} = exp(-i mu p) sum_m F_{m mu} q_{l m},    (-1)^mu h_{l,-mu} = exp(i mu p) sum_m (-1)^m F_{m mu} q_{l m}.
//! ```
//!
//! Without the Moon the coefficients are `4 pi (-1)^((l + mu) / 2) lambda_{l mu}(pi / 2) j_l(2 pi u)` (Rayleigh).

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

use super::RowsSetup;
use super::border::{Border, BorderBuffers};
use super::classes::{NodeClass, rings_for};
use super::lanes::{LANES, VALUES, Value};
use super::plan::RowNode;
use super::turns::{QuarterTurns, rows_apart_mut};
use crate::frames::AntennaResponse;
use crate::numerics::bessel::BesselOrders;
use crate::numerics::legendre::Legendre;
use crate::numerics::quadrature::GaussLegendre;
use crate::numerics::trigonometry::sin_cos;
use crate::response::harmonic::degrees;

/// Values of [`LANES`] pairs, complex.
const COMPLEX: usize = 2 * LANES;

/// A ring of the hidden cap.
#[derive(Clone, Copy, Debug)]
struct Ring {
    sin: f64,
    cos: f64,
    /// The greatest order with Legendre functions that are not negligible here.
    reach: usize,
}

/// Tables that pairs with about the same limb share.
#[derive(Clone, Debug)]
pub(super) struct CapClass {
    l_max: usize,
    border: Border,
    /// From the limb to the nadir.
    rings: Vec<Ring>,
    /// By m: on how many rings, from the first, Legendre functions are not negligible.
    reached: Vec<usize>,
    /// By m: for l = m, m + 1, .. a row of the border's series, then of the rings reached, with their weights.
    legendre: Vec<Vec<Value>>,
    response: AntennaResponse,
}

/// Orders of Legendre functions of degree `l_max` that are not negligible at this sine: beyond `l sin(theta)` they decay as
/// Airy functions, over a width of its cube root.
fn reach(l_max: usize, sin: f64) -> usize {
    let turning = l_max as f64 * sin;
    l_max.min((turning + 8.0 * turning.cbrt()) as usize + 8)
}

/// Memory of a task's buffers besides patterns, bytes.
pub(super) fn batch_bytes(l_max: usize, u_max: f64, batch: usize) -> f64 {
    let orders = (l_max + 1) as f64;
    let rings = (rings_for(l_max, FRAC_PI_2, u_max) + 16) as f64;
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
            rings.push(Ring { sin, cos, reach: reach(l_max, sin) });
            weights.push(TAU * limb_rad * w * sin);
        }
        let border = Border::new(setup, limb_rad, class.width_rad, class.u_max);
        let functions = Legendre::new(l_max, rings.iter().map(|ring| (ring.cos, ring.sin)));
        let angles = border.angles_rad();
        let near = Legendre::new(l_max, angles.iter().map(|theta| (theta.cos(), theta.sin())));
        let ones = vec![1.0; angles.len()];
        let reached: Vec<usize> =
            (0..=l_max).map(|m| rings.partition_point(|ring| ring.reach >= m)).collect();
        let legendre = (0..=l_max)
            .into_par_iter()
            .map(|m| {
                let (terms, reached) = (border.terms, reached[m]);
                let inner = functions.rows::<Value>(m, &weights[..reached]);
                let outer = near.rows::<f64>(m, &ones);
                let mut rows = vec![0.0; (l_max + 1 - m) * (terms + reached)];
                for (k, row) in rows.chunks_exact_mut(terms + reached).enumerate() {
                    border.series(&outer[k * terms..(k + 1) * terms], &mut row[..terms]);
                    row[terms..].copy_from_slice(&inner[k * reached..(k + 1) * reached]);
                }
                rows
            })
            .collect();
        Self { l_max, border, rings, reached, legendre, response: setup.response }
    }

    /// Coefficients of the hidden parts of pairs, `q_{l m}` at `[l][m][group][real or imaginary part][lane]`.
    fn hidden<'a>(&self, nodes: &[RowNode], wavelength_m: f64, buffers: &'a mut CapBuffers) -> &'a [Value] {
        let groups = nodes.len().div_ceil(LANES);
        let columns = groups * COMPLEX;
        let (l_max, terms) = (self.l_max, self.border.terms);
        let height = terms + self.rings.len();
        // Only written elements are read: the orders that reach a ring.
        buffers.rings.resize((l_max + 1) * height * columns, 0.0);
        for (group, nodes) in nodes.chunks(LANES).enumerate() {
            self.ring_coefficients(nodes, wavelength_m, group, columns, buffers);
        }
        self.border_coefficients(nodes, columns, buffers);
        buffers.hidden.resize((l_max + 1) * (l_max + 1) * columns, 0.0);
        for m in 0..=l_max {
            let inner = terms + self.reached[m];
            let rings = &buffers.rings[m * height * columns..][..inner * columns];
            let rows = l_max + 1 - m;
            let out = &mut buffers.hidden[(m * (l_max + 1) + m) * columns..];
            let out = &mut out[..(rows - 1) * (l_max + 1) * columns + columns];
            faer::linalg::matmul::matmul(
                rows_apart_mut(out, rows, columns, (l_max + 1) * columns),
                Accum::Replace,
                MatRef::from_row_major_slice(&self.legendre[m], rows, inner),
                MatRef::from_row_major_slice(rings, inner, columns),
                1.0,
                Par::Seq,
            );
        }
        &buffers.hidden
    }

    /// Writes the rings' coefficients of up to [`LANES`] pairs, of which the last fills what is left, to
    /// `[m][row][column]`.
    fn ring_coefficients(
        &self,
        nodes: &[RowNode],
        wavelength_m: f64,
        group: usize,
        columns: usize,
        buffers: &mut CapBuffers,
    ) {
        let (terms, height) = (self.border.terms, self.border.terms + self.rings.len());
        let Some(last) = nodes.last() else { return };
        let mut waves = [[0.0; LANES]; 2];
        let filled = nodes.iter().chain(std::iter::repeat(last)).take(LANES);
        for (k, node) in filled.enumerate() {
            let wave = TAU * node.view.baseline_m / wavelength_m;
            let (sin, cos) = node.view.pitch_rad().sin_cos();
            (waves[0][k], waves[1][k]) = (wave * cos, wave * sin);
        }
        let more = match self.response {
            AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 0,
            AntennaResponse::DipoleNormal => 2,
        };
        for (k, ring) in self.rings.iter().enumerate() {
            let x = waves[0].map(|wave| wave * ring.sin);
            let orders = buffers.bessel.cylindrical(&x, ring.reach + more);
            let first = (terms + k) * columns + group * COMPLEX;
            let phases = phases(&waves[1], ring.cos);
            let out = &mut buffers.rings[first..];
            write_ring(orders, &phases, ring, more > 0, out, height * columns);
        }
    }

    /// Writes the coefficients of the borders.
    fn border_coefficients(&self, nodes: &[RowNode], columns: usize, buffers: &mut CapBuffers) {
        let (terms, points) = (self.border.terms, self.border.points());
        let height = terms + self.rings.len();
        // `[term][column][psi]`.
        let width = terms * columns;
        buffers.border.resize(points * width, 0.0);
        for lane in 0..columns / 2 {
            let Some(node) = nodes.get(lane).or(nodes.last()) else { return };
            if lane < nodes.len() {
                self.border.integrate(&node.view, &mut buffers.pair);
            }
            let column = lane / LANES * COMPLEX + lane % LANES;
            for (part, sums) in buffers.pair.sums.iter().enumerate() {
                for (term, sums) in sums.chunks_exact(points).enumerate() {
                    let place = (term * columns + column + part * LANES) * points;
                    let to = &mut buffers.border[place..place + points];
                    to.iter_mut().zip(sums).for_each(|(to, from)| *to = *from as Value);
                }
            }
        }
        let orders = self.l_max + 1;
        buffers.waves.resize(orders * width, 0.0);
        faer::linalg::matmul::matmul(
            MatMut::from_row_major_slice_mut(&mut buffers.waves, orders, width),
            Accum::Replace,
            MatRef::from_row_major_slice(&self.border.waves, orders, points),
            MatRef::from_column_major_slice(&buffers.border, points, width),
            1.0,
            Par::Seq,
        );
        for (m, waves) in buffers.waves.chunks_exact(width).enumerate() {
            let out = &mut buffers.rings[m * height * columns..][..width];
            for (to, from) in out.chunks_exact_mut(COMPLEX).zip(waves.chunks_exact(COMPLEX)) {
                let ((to_re, to_im), (re, im)) = (to.split_at_mut(LANES), from.split_at(LANES));
                // (-i)^m.
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

/// `exp(i wave cos)`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn phases(waves: &[f64; LANES], cos: f64) -> [[f64; LANES]; 2] {
    let mut out = [[0.0; LANES]; 2];
    for k in 0..LANES {
        (out[1][k], out[0][k]) = sin_cos(waves[k] * cos);
    }
    out
}

/// Writes `(-1)^m J_m` times phases, or that of a ring with the response of dipoles, at steps of `stride`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn write_ring(
    orders: &[[f64; LANES]],
    phases: &[[f64; LANES]; 2],
    ring: &Ring,
    dipole: bool,
    out: &mut [Value],
    stride: usize,
) {
    let quarter = 0.25 * ring.sin * ring.sin;
    for m in 0..=ring.reach {
        let sign = if m.is_multiple_of(2) { 1.0 } else { -1.0 };
        let out = &mut out[m * stride..m * stride + COMPLEX];
        let (re, im) = out.split_at_mut(LANES);
        for k in 0..LANES {
            let mut value = orders[m][k];
            if dipole {
                // 1 - sin^2(theta) sin^2(psi); J_{-m} = (-1)^m J_m.
                let below = if m == 1 { -orders[1][k] } else { orders[m.abs_diff(2)][k] };
                value = (1.0 - 2.0 * quarter) * value - quarter * (orders[m + 2][k] + below);
            }
            re[k] = (sign * value * phases[0][k]) as Value;
            im[k] = (sign * value * phases[1][k]) as Value;
        }
    }
}

/// Room for the patterns of a batch.
#[derive(Clone, Debug, Default)]
pub(super) struct CapBuffers {
    bessel: BesselOrders,
    pair: BorderBuffers,
    rings: Vec<Value>,
    border: Vec<Value>,
    waves: Vec<Value>,
    hidden: Vec<Value>,
    /// Sums over even and over odd m.
    turned: [Vec<Value>; 2],
}

/// Tables of patterns that all classes share.
#[derive(Clone, Debug)]
pub(super) struct Patterns {
    setup: RowsSetup,
    /// By mu, for l = mu, mu + 2, ..: factors of `j_l`, `j_{l+2}` and `j_{l-2}`.
    whole: Vec<Vec<[f64; 3]>>,
}

impl Patterns {
    pub(super) fn new(setup: RowsSetup) -> Self {
        Self { whole: whole_sky(&setup), setup }
    }

    /// Writes patterns of pairs of one class, by mu: for [`LANES`] of them at a time rows of l = mu, mu + 2, ..
    pub(super) fn of(
        &self,
        turns: &QuarterTurns,
        class: &CapClass,
        nodes: &[RowNode],
        buffers: &mut CapBuffers,
        out: &mut Vec<NodePatterns>,
    ) {
        let l_max = self.setup.l_max;
        let groups = nodes.len().div_ceil(LANES);
        let columns = groups * COMPLEX;
        class.hidden(nodes, self.setup.wavelength_m, buffers);
        out.resize_with(l_max + 1, NodePatterns::default);
        // All of it will be written.
        out.iter_mut().enumerate().for_each(|(mu, out)| out.make_room(degrees(l_max, mu), groups));
        let unhidden = self.unhidden(nodes, buffers);
        let pitches = pitch_phases(nodes, l_max);
        for l in 0..=l_max {
            let hidden = &buffers.hidden[l * (l_max + 1) * columns..][..(l + 1) * columns];
            turns.fold(l, hidden, columns, &mut buffers.turned);
            let turned = buffers.turned.each_ref().map(Vec::as_slice);
            assemble(turned, &pitches, &unhidden, &self.whole, [l, l_max, groups], out);
        }
    }

    /// `j_l(2 pi u)`, l = 0 ..= l_max + 2, by group.
    fn unhidden(&self, nodes: &[RowNode], buffers: &mut CapBuffers) -> Vec<[f64; LANES]> {
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

/// `exp(-i mu p)` by group, mu and lane: real and imaginary parts.
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

/// The visible part of all pairs at one degree: writes `f_{l mu}` and `(-1)^mu f_{l,-mu}`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn assemble(
    [even, odd]: [&[Value]; 2],
    [cos, sin]: &[Vec<Value>; 2],
    unhidden: &[[f64; LANES]],
    whole: &[Vec<[f64; 3]>],
    [l, l_max, groups]: [usize; 3],
    out: &mut [NodePatterns],
) {
    let rows = even.chunks_exact(groups * COMPLEX).zip(odd.chunks_exact(groups * COMPLEX));
    for (mu, (even, odd)) in (l % 2..=l).step_by(2).zip(rows) {
        let (degree, out) = ((l - mu) / 2, &mut out[mu]);
        let [of_here, of_above, of_below] = whole[mu][degree];
        let sign: Value = if mu.is_multiple_of(2) { 1.0 } else { -1.0 };
        let parts = even.chunks_exact(COMPLEX).zip(odd.chunks_exact(COMPLEX));
        for (group, (even, odd)) in parts.enumerate() {
            let place = (group * (l_max + 1) + mu) * LANES;
            let (cos, sin) = (&cos[place..place + LANES], &sin[place..place + LANES]);
            let spherical = &unhidden[group * (l_max + 3)..];
            let (below, here, above) = (&spherical[l.saturating_sub(2)], &spherical[l], &spherical[l + 2]);
            let ((even_re, even_im), (odd_re, odd_im)) = (even.split_at(LANES), odd.split_at(LANES));
            let out = &mut out.of_mut(group)[degree * VALUES..(degree + 1) * VALUES];
            for k in 0..LANES {
                let whole = (of_here * here[k] + of_above * above[k] + of_below * below[k]) as Value;
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

/// Coefficients of a fringe over the whole sky, by mu and l: factors of `j_l`, `j_{l+2}` and `j_{l-2}`. A dipole's response
/// is `1 - z^2`, and z takes degree l to its neighbours.
fn whole_sky(setup: &RowsSetup) -> Vec<Vec<[f64; 3]>> {
    let l_max = setup.l_max;
    let functions = Legendre::new(l_max + 2, std::iter::once((0.0, 1.0)));
    (0..=l_max)
        .map(|mu| {
            let values = functions.even_rows::<f64>(mu, &[4.0 * PI]);
            // With (-1)^((l + mu) / 2), which alternates with l.
            let first = if mu.is_multiple_of(2) { 1.0 } else { -1.0 };
            let value = |degree: usize| {
                values.get(degree).map_or(0.0, |value| {
                    if degree.is_multiple_of(2) { first * value } else { -first * value }
                })
            };
            let step = |l: usize| {
                if l <= mu { 0.0 } else { (((l * l - mu * mu) as f64) / ((4 * l * l - 1) as f64)).sqrt() }
            };
            (0..degrees(l_max, mu))
                .map(|degree| {
                    let l = mu + 2 * degree;
                    match setup.response {
                        AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => {
                            [value(degree), 0.0, 0.0]
                        }
                        AntennaResponse::DipoleNormal => {
                            let same = 1.0 - step(l + 1).powi(2) - step(l).powi(2);
                            let above = -step(l + 1) * step(l + 2) * value(degree + 1);
                            let below =
                                if degree == 0 { 0.0 } else { -step(l) * step(l - 1) * value(degree - 1) };
                            [same * value(degree), above, below]
                        }
                    }
                })
                .collect()
        })
        .collect()
}

/// Coefficients of the patterns of a batch at one mu: for [`LANES`] nodes at a time rows of l = mu, mu + 2, ..; in a row real and
/// imaginary parts of `f_{l mu}`, then of `(-1)^mu f_{l,-mu}`, each by lane.
#[derive(Default)]
pub(super) struct NodePatterns {
    count: usize,
    coefficients: Vec<Value>,
}

impl NodePatterns {
    fn make_room(&mut self, count: usize, groups: usize) {
        self.count = count;
        self.coefficients.resize(groups * count * VALUES, 0.0);
    }

    /// Rows of a group of nodes.
    pub(super) fn of(&self, group: usize) -> &[Value] {
        &self.coefficients[group * self.count * VALUES..][..self.count * VALUES]
    }

    fn of_mut(&mut self, group: usize) -> &mut [Value] {
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
        PairView::of(at(0), at(1), MOON_M).unwrap()
    }

    /// Coefficients by quadrature in the pair's own axes: whole circles about the mean zenith, on each of which what both satellites
    /// see is found by bisection, and Gauss-Legendre quadrature from there to the zenith.
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
                            // lambda_{l,-mu} = (-1)^mu lambda_{l mu}, twice.
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
            let farthest = |view: &PairView| (view.cap_rad() - middle_rad).abs() + view.limbs_apart_rad();
            let class = NodeClass {
                limb_rad: middle_rad,
                width_rad: views.iter().map(farthest).fold(0.0, f64::max),
                u_max: 40.0,
            };
            let class = CapClass::new(&setup, &class);
            let (mut buffers, mut found) = (CapBuffers::default(), Vec::new());
            patterns.of(&QuarterTurns::new(L_MAX), &class, &nodes, &mut buffers, &mut found);
            for (lane, view) in views.iter().enumerate() {
                for (mu, expected) in expected(view, response).iter().enumerate() {
                    for (k, expected) in expected.iter().enumerate() {
                        let part = |part: usize| f64::from(found[mu].of(0)[k * VALUES + part * LANES + lane]);
                        let found = [Complex64::new(part(0), part(1)), Complex64::new(part(2), part(3))];
                        for (found, expected) in found.iter().zip(expected) {
                            // Sums of some 100 terms of f32 of up to 4; the circle of the expected ones has a kink.
                            let error = (found - expected).norm();
                            assert!(error < 4e-6, "{lane} {mu} {k}: {found} {expected} {error:e}");
                        }
                    }
                }
            }
        }
    }
}
