//! The sky's power outside the Moon's disc, from harmonic coefficients, and its transpose.
//!
//! The disc, of angular radius a around n, hides a cap, so that
//!
//! ```text
//! Int T (1 - M) dn = sum_lm v_l(a) T_lm Y_lm(n),   v_l = 4 pi [l = 0] - K_l,
//! K_l = 2 pi Int_cos(a)^1 P_l(z) dz = 2 pi (P_{l-1}(cos a) - P_{l+1}(cos a)) / (2 l + 1).
//! ```
//!
//! The limb is exact, and every degree of the map is in it. For each of a few radii a this is a function of n of the map's degree. It is
//! evaluated on a grid with [`OVERSAMPLING`] times as many points as that needs, and interpolated by polynomials.

use std::f64::consts::{PI, SQRT_2};
use std::sync::Arc;

use num_complex::Complex64;
use rayon::prelude::*;
use rustfft::{Fft, FftPlanner};

use crate::imaging::unknowns::index_of;
use crate::numerics::lagrange_weights;
use crate::numerics::legendre::Legendre;
use crate::units::vector::Vec3;

/// Grid points per shortest half wavelength. With [`NODES`] the error is 1e-4 of the highest degree, which has some 1e-4 of a power, and falls
/// with the eighth power of the degree.
const OVERSAMPLING: usize = 4;
/// Nodes of an interpolation in each angle.
const NODES: usize = 8;
/// Maximum number of radii of the disc.
const RADII_MAX: usize = 24;

/// The direction of the Moon from a daughter, and the cosine of the angular radius of its disc.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Disc {
    pub(super) direction: Vec3,
    pub(super) cos_radius: f64,
}

/// The operator from a map's unknowns to the powers outside some discs.
pub(super) struct Discs {
    l_max: usize,
    /// Points of the grid from pole to pole; there are twice as many around.
    points: usize,
    /// v_l at each of the radii.
    visible: Vec<Vec<f64>>,
    /// The places over which each power is averaged.
    places: Vec<[Place; 2]>,
    /// Interpolation weights of the radii, for each disc.
    radius_weights: Vec<f64>,
    legendre: Legendre,
    inverse: Arc<dyn Fft<f64>>,
    forward: Arc<dyn Fft<f64>>,
}

/// Where a disc lies on the grid: the first node and the interpolation weights in colatitude and longitude.
struct Place {
    first: [i64; 2],
    weights: [[f64; NODES]; 2],
}

/// `v_l` of degrees up to l_max for a disc whose radius has this cosine, sr.
pub(super) fn visible_sr(l_max: usize, cos_radius: f64) -> Vec<f64> {
    // P_{l-1}, P_l, P_{l+1}, from P_{-1} = 1.
    let [mut below, mut at, mut above] = [1.0, 1.0, cos_radius];
    let of_degree = |l: usize| {
        let hidden = 2.0 * PI * (below - above) / (2 * l + 1) as f64;
        let l = (l + 1) as f64;
        [below, at, above] = [at, above, ((2.0 * l + 1.0) * cos_radius * above - l * at) / (l + 1.0)];
        -hidden
    };
    let mut visible: Vec<f64> = (0..=l_max).map(of_degree).collect();
    visible[0] += 4.0 * PI;
    visible
}

impl Discs {
    /// The operator for powers outside these discs, each averaged over two directions of its disc (those of an arc, in Gauss's quadrature).
    pub(super) fn new(l_max: usize, discs: &[(Disc, [Vec3; 2])]) -> Self {
        let points = OVERSAMPLING * (l_max + 1);
        let step = PI / points as f64;
        let radii: Vec<f64> = discs.iter().map(|(disc, _)| disc.cos_radius.acos()).collect();
        let ends = radii.iter().fold([PI, 0.0_f64], |[low, high], a| [low.min(*a), high.max(*a)]);
        let nodes = radius_nodes(ends, l_max);
        let place = |[x, y, z]: Vec3| {
            let colatitude = z.clamp(-1.0, 1.0).acos();
            // Colatitudes are in the middle of their steps, so that none is a pole.
            let angles = [colatitude / step - 0.5, y.atan2(x) / step];
            let first = angles.map(|angle| angle.floor() as i64 - (NODES / 2 - 1) as i64);
            let weights = [0, 1].map(|axis| {
                let nodes: [f64; NODES] = std::array::from_fn(|k| k as f64);
                let mut weights = [0.0; NODES];
                weights.copy_from_slice(&lagrange_weights(&nodes, angles[axis] - first[axis] as f64));
                weights
            });
            Place { first, weights }
        };
        let mut planner = FftPlanner::new();
        Self {
            l_max,
            points,
            visible: nodes.iter().map(|a| visible_sr(l_max, a.cos())).collect(),
            places: discs.par_iter().map(|(_, ends)| ends.map(place)).collect(),
            radius_weights: radii.iter().flat_map(|a| lagrange_weights(&nodes, *a)).collect(),
            legendre: Legendre::new(l_max, (0..points).map(|k| colatitude_cos_sin(k, step))),
            inverse: planner.plan_fft_inverse(2 * points),
            forward: planner.plan_fft_forward(2 * points),
        }
    }

    /// The powers outside the discs for a map's unknowns, K sr.
    pub(super) fn powers(&self, x: &[f64]) -> Vec<f64> {
        let (radii, around) = (self.visible.len(), 2 * self.points);
        let of_order = |m: usize| -> Vec<Complex64> {
            let rows = self.legendre.rows::<f64>(m, &vec![1.0; self.points]);
            let mut sums = vec![Complex64::default(); radii * self.points];
            for (l, row) in (m..).zip(rows.chunks_exact(self.points)) {
                let value = self.unknown(x, l, m);
                for (visible, sums) in self.visible.iter().zip(sums.chunks_exact_mut(self.points)) {
                    let value = value * visible[l];
                    sums.iter_mut().zip(row).for_each(|(sum, y)| *sum += value * y);
                }
            }
            sums
        };
        let orders: Vec<Vec<Complex64>> = (0..=self.l_max).into_par_iter().map(of_order).collect();
        let circle = |index: usize| -> Vec<f64> {
            let mut circle = vec![Complex64::default(); around];
            circle.iter_mut().zip(&orders).for_each(|(value, order)| *value = order[index]);
            self.inverse.process(&mut circle);
            circle.iter().map(|value| value.re).collect()
        };
        let circles: Vec<Vec<f64>> = (0..radii * self.points).into_par_iter().map(circle).collect();
        let of_disc = |(places, radius_weights): (&[Place; 2], &[f64])| {
            let mut power = 0.0;
            for place in places {
                self.for_each_node(place, &mut |circle, k, weight| {
                    for (radius, share) in radius_weights.iter().enumerate() {
                        power += 0.5 * share * weight * circles[radius * self.points + circle][k];
                    }
                });
            }
            power
        };
        self.places.par_iter().zip(self.radius_weights.par_chunks_exact(radii)).map(of_disc).collect()
    }

    /// The transpose of [`Self::powers`].
    pub(super) fn transposed(&self, rows: &[f64]) -> Vec<f64> {
        let (radii, around) = (self.visible.len(), 2 * self.points);
        let mut circles = vec![Complex64::default(); radii * self.points * around];
        for ((places, radius_weights), row) in
            self.places.iter().zip(self.radius_weights.chunks_exact(radii)).zip(rows)
        {
            for place in places {
                self.for_each_node(place, &mut |circle, k, weight| {
                    for (radius, share) in radius_weights.iter().enumerate() {
                        circles[(radius * self.points + circle) * around + k].re +=
                            0.5 * share * weight * row;
                    }
                });
            }
        }
        circles.par_chunks_exact_mut(around).for_each(|circle| self.forward.process(circle));
        let of_order = |m: usize| -> Vec<Complex64> {
            let rows = self.legendre.rows::<f64>(m, &vec![1.0; self.points]);
            let of_degree = |(l, row): (usize, &[f64])| {
                let of_radius = |(radius, visible): (usize, &Vec<f64>)| {
                    let circles = circles[radius * self.points * around..].chunks_exact(around);
                    let sum: Complex64 = circles.zip(row).map(|(circle, y)| circle[m] * y).sum();
                    sum * visible[l]
                };
                self.visible.iter().enumerate().map(of_radius).sum()
            };
            (m..).zip(rows.chunks_exact(self.points)).map(of_degree).collect()
        };
        let orders: Vec<Vec<Complex64>> = (0..=self.l_max).into_par_iter().map(of_order).collect();
        let mut x = vec![0.0; (self.l_max + 1).pow(2)];
        for (m, order) in orders.iter().enumerate() {
            for (l, value) in (m..).zip(order) {
                x[index_of(self.l_max, l, m, 0)] = if m == 0 { value.re } else { SQRT_2 * value.re };
                if m > 0 {
                    x[index_of(self.l_max, l, m, 1)] = SQRT_2 * value.im;
                }
            }
        }
        x
    }

    /// The coefficient whose real part times exp(i m longitude) an unknown adds.
    fn unknown(&self, x: &[f64], l: usize, m: usize) -> Complex64 {
        let at = |part| x[index_of(self.l_max, l, m, part)];
        if m == 0 { at(0).into() } else { SQRT_2 * Complex64::new(at(0), at(1)) }
    }

    /// Calls `take` with colatitude, longitude and weight of the nodes of a disc. Beyond a pole the grid goes on at the opposite longitude.
    fn for_each_node(&self, place: &Place, take: &mut dyn FnMut(usize, usize, f64)) {
        let points = self.points as i64;
        for (i, weight) in (place.first[0]..).zip(place.weights[0]) {
            let (circle, turn) = match i {
                i if i < 0 => (-1 - i, points),
                i if i >= points => (2 * points - 1 - i, points),
                i => (i, 0),
            };
            for (k, other) in (place.first[1] + turn..).zip(place.weights[1]) {
                take(circle as usize, k.rem_euclid(2 * points) as usize, weight * other);
            }
        }
    }
}

fn colatitude_cos_sin(k: usize, step: f64) -> (f64, f64) {
    let (sin, cos) = ((k as f64 + 0.5) * step).sin_cos();
    (cos, sin)
}

/// Chebyshev nodes between the smallest and the largest radius, as many as the functions of the highest degree need; one on a circular orbit.
fn radius_nodes([low, high]: [f64; 2], l_max: usize) -> Vec<f64> {
    let reach = (0.5 * (high - low)).max(0.0);
    let turns = reach * l_max as f64;
    let count = if turns < 1e-6 { 1 } else { (3 + (2.0 * turns) as usize).min(RADII_MAX) };
    let node = |k: usize| 0.5 * (low + high) + reach * (PI * (k as f64 + 0.5) / count as f64).cos();
    (0..count).map(node).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::circle::coefficients;
    use crate::sky::harmonics::synthesis;
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::units::vector::{dot, unit};

    fn discs() -> Vec<Disc> {
        let direction = |k: usize| {
            let k = k as f64;
            unit([(1.3 * k).sin(), (2.1 * k + 0.4).cos(), (0.7 * k).sin() - 0.2])
        };
        // Radii of 55 to 61 degrees, and discs at and near the poles.
        let mut discs: Vec<Disc> = (0..40)
            .map(|k| Disc {
                direction: direction(k),
                cos_radius: (55.0 + 0.15 * k as f64).to_radians().cos(),
            })
            .collect();
        discs[0].direction = [0.0, 0.0, 1.0];
        discs[1].direction = unit([-1e-3, 2e-3, -1.0]);
        discs
    }

    fn at_rest(discs: &[Disc]) -> Vec<(Disc, [Vec3; 2])> {
        discs.iter().map(|disc| (*disc, [disc.direction; 2])).collect()
    }

    fn wave(count: usize, f: f64) -> Vec<f64> {
        (0..count).map(|k| (f * k as f64 + 0.1).sin()).collect()
    }

    /// Compares K_l with `2 pi Int P_l dz` of written-out polynomials.
    #[test]
    fn caps_are_those_of_the_polynomials() {
        let z: f64 = 0.52;
        let expected = [
            2.0 * PI * (1.0 + z),
            -PI * (1.0 - z * z),
            // P_2 = (3 z^2 - 1) / 2, P_3 = (5 z^3 - 3 z) / 2, P_4 = (35 z^4 - 30 z^2 + 3) / 8.
            -PI * (z - z.powi(3)),
            -PI * (1.25 * (1.0 - z.powi(4)) - 1.5 * (1.0 - z * z)),
            -PI / 4.0 * (7.0 * (1.0 - z.powi(5)) - 10.0 * (1.0 - z.powi(3)) + 3.0 * (1.0 - z)),
        ];
        for (found, expected) in visible_sr(4, z).iter().zip(expected) {
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
    }

    /// Compares powers with sums over the pixels of a fine map outside the disc.
    #[test]
    fn powers_are_those_of_sums_over_pixels() {
        const NSIDE: usize = 256;
        let l_max = 8;
        let x = wave(81, 0.7);
        let sky = synthesis(&coefficients(&x, l_max), NSIDE).unwrap();
        let directions = pixel_directions(NSIDE);
        let discs = discs();
        let found = Discs::new(l_max, &at_rest(&discs)).powers(&x);
        for (disc, found) in discs.iter().zip(found) {
            let seen =
                directions.iter().zip(&sky).filter(|(n, _)| dot(**n, disc.direction) < disc.cos_radius);
            let expected = seen.map(|(_, value)| value).sum::<f64>() * pixel_area_sr(NSIDE);
            // Some 1600 pixels of 1.6e-5 sr on the limb count in full or not at all, an error of 0.29 each, of a sky of about 2.5 K rms.
            assert!((found - expected).abs() < 4.0 * 0.29 * 40.0 * 1.6e-5 * 2.5, "{found} {expected}");
        }
    }

    #[test]
    fn transposed_is_the_transpose() {
        let discs = discs();
        for l_max in [1, 13] {
            // Averages of each disc's direction and the next one's.
            let ends = (0..discs.len()).map(|k| [discs[k].direction, discs[(k + 1) % discs.len()].direction]);
            let operator = Discs::new(l_max, &discs.iter().copied().zip(ends).collect::<Vec<_>>());
            let (x, y) = (wave((l_max + 1).pow(2), 0.9), wave(discs.len(), 0.31));
            let left: f64 = operator.powers(&x).iter().zip(&y).map(|(a, b)| a * b).sum();
            let right: f64 = operator.transposed(&y).iter().zip(&x).map(|(a, b)| a * b).sum();
            // Sums of some hundred terms in another order.
            assert!((left - right).abs() < 1e-11 * (1.0 + left.abs()), "{left} {right}");
        }
    }
}
