//! Rotation of coefficients to another frame.
//!
//! For a rotation `R = Rz(alpha) Ry(beta) Rz(gamma)`, the field whose value at `R n` is that of the old field at n has
//! the coefficients (Varshalovich et al. 1988, 4.1)
//!
//! ```text
//! a'_lm = exp(-i m alpha) sum_mu d^l_{m mu}(beta) b_mu,    b_mu = exp(-i mu gamma) a_{l mu}
//!       = exp(-i m alpha) sum_{mu >= 0} d^l_{m mu} b_mu + (-1)^m d^l_{-m,mu} conj(b_mu)
//! ```
//!
//! (the second term only for mu >= 1) for a real field. A band-limited field stays band-limited, so that the only error is
//! rounding.

use num_complex::Complex64;
use rayon::prelude::*;

use super::{Alm, WignerTable};
use crate::sky::frame::Rotation;

/// Number of parts of the sum over mu, which is fixed so that the result does not depend on the number of threads.
const PARTS: usize = 8;

impl Alm {
    /// Computes the coefficients of the field rotated by `rotation`, which maps old directions to new ones.
    #[must_use]
    #[doc(hidden)]
    pub fn rotated(&self, rotation: &Rotation) -> Self {
        let [alpha, beta, gamma] = euler_angles(rotation);
        let table = WignerTable::new(self.l_max(), beta);
        let parts: Vec<Self> = (0..PARTS)
            .into_par_iter()
            .map(|part| {
                let mut sum = Self::zeros(self.l_max());
                for mu in (part..=self.l_max()).step_by(PARTS) {
                    self.add_order(&mut sum, &table, mu, gamma);
                }
                sum
            })
            .collect();
        let mut rotated_alm = Self::zeros(self.l_max());
        for m in 0..=self.l_max() {
            let phase = Complex64::cis(-(m as f64) * alpha);
            for l in m..=self.l_max() {
                let total: Complex64 = parts.iter().map(|part| part.get(l, m)).sum();
                // Order 0 of a real field is real; the imaginary part is rounding error.
                *rotated_alm.get_mut(l, m) = if m == 0 { total.re.into() } else { total * phase };
            }
        }
        rotated_alm
    }

    /// Adds the contribution of orders mu and -mu to all orders m >= 0.
    fn add_order(&self, sum: &mut Self, table: &WignerTable, mu: usize, gamma: f64) {
        let phase = Complex64::cis(-(mu as f64) * gamma);
        let mut rows = table.rows(mu);
        while let Some((l, row)) = rows.next_row() {
            let b = self.get(l, mu) * phase;
            *sum.get_mut(l, 0) += row[l] * if mu == 0 { b } else { (2.0 * b.re).into() };
            for m in 1..=l {
                let mirrored = if m % 2 == 0 { row[l - m] } else { -row[l - m] };
                let negative = if mu == 0 { Complex64::ZERO } else { b.conj() * mirrored };
                *sum.get_mut(l, m) += b * row[l + m] + negative;
            }
        }
    }
}

/// Returns the angles alpha, beta, gamma with `rotation = Rz(alpha) Ry(beta) Rz(gamma)`, rad.
fn euler_angles(rotation: &Rotation) -> [f64; 3] {
    let [x, y, z] = rotation;
    let sin_beta = z[0].hypot(z[1]);
    if sin_beta < 1e-15 {
        // A rotation about z, or z reversed.
        let beta = if z[2] > 0.0 { 0.0 } else { std::f64::consts::PI };
        return [(-x[1]).atan2(y[1]), beta, 0.0];
    }
    [y[2].atan2(x[2]), sin_beta.atan2(z[2]), z[1].atan2(-z[0])]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sky::frame::{Frame, rotate, transpose};
    use crate::sky::harmonics::{AnalysisOptions, Method, analysis};
    use crate::sky::healpix::pixel_directions;
    use crate::units::vector::{Vec3, dot};

    /// A polynomial of degree 7 in the direction.
    fn field(n: Vec3) -> f64 {
        let [a, b, c] = [[0.3, -0.5, 0.8], [1.0, 0.2, -0.4], [-0.1, 0.9, 0.3]].map(|v| dot(v, n));
        1.0 + a.powi(7) + b.powi(3) * c.powi(2) - a * b * c + c
    }

    #[test]
    fn coefficients_are_those_of_the_turned_field() {
        let options =
            AnalysisOptions { method: Method::LeastSquares { tolerance: 1e-13, iterations_max: 50 } };
        let coefficients = |value: &dyn Fn(Vec3) -> f64| {
            let map: Vec<f64> = pixel_directions(16).into_iter().map(value).collect();
            analysis(&map, 8, &options).unwrap().alm
        };
        let upside_down = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]];
        let (sin, cos) = 0.7_f64.sin_cos();
        let about_z = [[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]];
        for rotation in [Frame::Galactic.to_ecliptic(), Frame::Equatorial.to_ecliptic(), upside_down, about_z]
        {
            let back = transpose(&rotation);
            let turned = coefficients(&field).rotated(&rotation);
            let expected = coefficients(&|n| field(rotate(&back, n)));
            for (found, expected) in turned.values().iter().zip(expected.values()) {
                // The analysis is accurate to 1e-13 for coefficients of order 1.
                assert!((found - expected).norm() < 1e-11, "{found} {expected}");
            }
        }
    }

    #[test]
    fn turning_back_and_forth_changes_nothing_at_high_degrees() {
        let mut alm = Alm::zeros(400);
        for (k, value) in alm.values_mut().iter_mut().enumerate() {
            let k = k as f64;
            *value = Complex64::new((1.3 * k * k).sin(), if k <= 400.0 { 0.0 } else { (0.7 * k * k).cos() });
        }
        let rotation = Frame::Galactic.to_ecliptic();
        let again = alm.rotated(&rotation).rotated(&transpose(&rotation));
        for (found, expected) in again.values().iter().zip(alm.values()) {
            // 800 terms with errors of d of 1e-13 each; the rotation matrix is accurate to 1e-15.
            assert!((found - expected).norm() < 1e-10, "{found} {expected}");
        }
    }
}
