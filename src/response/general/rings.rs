//! Sums over rings: from the Fourier coefficients of arcs to those of patterns over degrees.

use std::ops::Range;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::RowsSetup;
use super::arc::{Coefficients, VALUES, Value};
use super::plan::NodeClass;
use crate::response::harmonic::legendre::Legendre;
use crate::response::harmonic::pattern::{PatternGeometry, RingPoint, ring_points};

/// Degrees that are summed together, in registers.
const PANEL: usize = 8;

/// So many degrees, and what fills the last panel.
pub(super) fn padded(degrees: usize) -> usize {
    degrees.next_multiple_of(PANEL)
}

/// Quadrature points of one class of nodes, and the Legendre functions there.
pub(super) struct RingClass {
    pub(super) rings: Vec<RingPoint>,
    /// By ring: the greatest order that is not negligible there.
    pub(super) reach: Vec<usize>,
    /// By mu: on how many rings, from the first, it is not negligible.
    reached: Vec<usize>,
    /// By mu: Legendre functions times the rings' weights, in panels of l = mu, mu + 2, ..; in a panel ring by ring.
    legendre: Vec<Vec<Value>>,
}

impl RingClass {
    pub(super) fn new(setup: &RowsSetup, class: &NodeClass) -> Self {
        let geometry = PatternGeometry {
            orbit_radius_m: class.radius_m,
            moon_radius_m: setup.moon_radius_m,
            wavelength_m: setup.wavelength_m,
            response: setup.response,
        };
        let l_max = setup.l_max;
        let (rings, weights) = ring_points(geometry, l_max, class.u_max, 1);
        let functions = Legendre::new(l_max, rings.iter().map(|ring| (ring.z, ring.sin_theta)));
        let reach: Vec<usize> = rings.iter().map(|ring| ring.orders(l_max)).collect();
        let reached: Vec<usize> =
            (0..=l_max).map(|mu| reach.partition_point(|orders| *orders >= mu)).collect();
        let legendre = (0..=l_max)
            .into_par_iter()
            .map(|mu| panels(&functions.even_rows::<Value>(mu, &weights[..reached[mu]]), reached[mu]))
            .collect();
        Self { rings, reach, reached, legendre }
    }

    /// Adds to `out`, `[degree][value]`, the sum over some rings of Legendre functions and the arcs' coefficients of one mu,
    /// which are `stride` apart.
    pub(super) fn sum_up(
        &self,
        mu: usize,
        rings: Range<usize>,
        arcs: &[Coefficients],
        stride: usize,
        out: &mut [Value],
    ) {
        let rings = rings.start..rings.end.min(self.reached[mu]);
        let (panels, reached) = (&self.legendre[mu], self.reached[mu]);
        Arch::new().dispatch(Sum { panels, reached, rings, arcs, stride, out });
    }
}

/// Rows of equal length, in panels; zeros fill the last.
fn panels(rows: &[Value], length: usize) -> Vec<Value> {
    let count = rows.len().checked_div(length).unwrap_or(0);
    let mut out = vec![0.0; padded(count) * length];
    for (k, row) in rows.chunks_exact(length.max(1)).enumerate() {
        let panel = &mut out[k / PANEL * PANEL * length..];
        panel.iter_mut().skip(k % PANEL).step_by(PANEL).zip(row).for_each(|(to, from)| *to = *from);
    }
    out
}

struct Sum<'a> {
    panels: &'a [Value],
    reached: usize,
    rings: Range<usize>,
    arcs: &'a [Coefficients],
    stride: usize,
    out: &'a mut [Value],
}

impl WithSimd for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match S::F32_LANES {
            16 => self.run::<S, { VALUES / 16 }>(simd),
            8 => self.run::<S, { VALUES / 8 }>(simd),
            4 => self.run::<S, { VALUES / 4 }>(simd),
            _ => self.run::<S, VALUES>(simd),
        }
    }
}

impl Sum<'_> {
    /// `P` registers hold the values of one degree.
    #[inline(always)]
    fn run<S: Simd, const P: usize>(self, simd: S) {
        let Self { panels, reached, rings, arcs, stride, out } = self;
        let panels = panels.chunks_exact((PANEL * reached).max(1));
        for (panel, out) in panels.zip(out.chunks_exact_mut(PANEL * VALUES)) {
            let mut sums = [[simd.splat_f32s(0.0); P]; PANEL];
            let panel = &panel[PANEL * rings.start..PANEL * rings.end];
            for (legendre, arc) in panel.chunks_exact(PANEL).zip(arcs.iter().step_by(stride)) {
                let arc = S::as_simd_f32s(arc.as_flattened()).0;
                let arc: [S::f32s; P] = std::array::from_fn(|p| arc[p]);
                for (sums, legendre) in sums.iter_mut().zip(legendre) {
                    let legendre = simd.splat_f32s(*legendre);
                    for (sum, arc) in sums.iter_mut().zip(arc) {
                        *sum = simd.mul_add_f32s(legendre, arc, *sum);
                    }
                }
            }
            for (out, sum) in S::as_mut_simd_f32s(out).0.iter_mut().zip(sums.as_flattened()) {
                *out = simd.add_f32s(*out, *sum);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::AntennaResponse;

    #[test]
    fn sums_are_those_of_rows() {
        let setup = RowsSetup {
            l_max: 40,
            wavelength_m: 30.0,
            moon_radius_m: 1737.1e3,
            response: AntennaResponse::Isotropic,
        };
        let class = RingClass::new(&setup, &NodeClass { radius_m: 2037.1e3, u_max: 12.0 });
        let stride = 5;
        let first = 3;
        let last = class.rings.len();
        // Numbers without a pattern.
        let number = |k: usize| ((k * 7919) % 1009) as Value / 1009.0 - 0.5;
        let arcs: Vec<Coefficients> = (0..stride * (last - first))
            .map(|k| std::array::from_fn(|part| std::array::from_fn(|lane| number(97 * k + 8 * part + lane))))
            .collect();
        let points = class.rings.iter().map(|ring| (ring.z, ring.sin_theta));
        let functions = Legendre::new(setup.l_max, points);
        let geometry = PatternGeometry {
            orbit_radius_m: 2037.1e3,
            moon_radius_m: setup.moon_radius_m,
            wavelength_m: setup.wavelength_m,
            response: setup.response,
        };
        let (_, weights) = ring_points(geometry, setup.l_max, 12.0, 1);
        for mu in [0, 1, 17, 39, 40] {
            let reached = class.reached[mu];
            let rows = functions.even_rows::<f64>(mu, &weights[..reached]);
            let count = rows.len() / reached;
            let mut out = vec![1.0; padded(count) * VALUES];
            class.sum_up(mu, first..last, &arcs, stride, &mut out);
            for (k, (row, out)) in rows.chunks(reached).zip(out.chunks(VALUES)).enumerate() {
                for (value, found) in out.iter().enumerate() {
                    let terms = (first..reached).map(|ring| {
                        row[ring] * f64::from(arcs[(ring - first) * stride].as_flattened()[value])
                    });
                    let (sum, size) =
                        terms.fold((1.0, 1.0), |(sum, size), term| (sum + term, size + term.abs()));
                    // A rounding of each term and each partial sum, by chance to either side.
                    let allowed = 16.0 * f64::from(Value::EPSILON) * size;
                    assert!((f64::from(*found) - sum).abs() < allowed, "{mu} {k} {value}: {found} {sum}");
                }
            }
        }
    }
}
