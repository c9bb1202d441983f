//! Responses of pairs whose antennas differ, as polynomials in the direction.
//!
//! Short dipoles along d and e correlate an unpolarised wave from n by `d . e - (n . d) (n . e)`; further factors are polynomials in
//! `(n . d)^2`. With `n . n = 1` all terms can have the same even degree D, so that
//!
//! ```text
//! A_ij(n, t) = sum_k a_k(t) P_k(n),   P_k = n_x^p n_y^q n_z^r,   p + q + r = D,
//! ```
//!
//! and a visibility is a sum of isotropic visibilities of the skies `P_k T`, which have D degrees more than T. These skies do not depend
//! on time, so that rows of B are interpolated for isotropic antennas only, and antennas may rotate freely between visibilities.

use crate::frames::AntennaResponse;
use crate::response::pixel::{DirectionForm, SatelliteAntenna};
use crate::sky::harmonics::{Alm, Component, times_direction, times_direction_transposed};
use crate::units::vector::{Vec3, dot};

/// Maximum degree of a response: two dipoles, each with an individual pattern.
pub const DEGREE_MAX: usize = 6;

type Exponents = [usize; 3];

fn monomials(degree: usize) -> Vec<Exponents> {
    (0..=degree).rev().flat_map(|p| (0..=degree - p).rev().map(move |q| [p, q, degree - p - q])).collect()
}

/// Index of a monomial among those of its degree.
fn monomial_index([p, q, r]: Exponents) -> usize {
    let rest = q + r;
    debug_assert!(p + rest <= DEGREE_MAX);
    rest * (rest + 1) / 2 + r
}

/// Response of a pair, a homogeneous polynomial of even degree in the direction (a unit vector).
#[derive(Clone, Debug, PartialEq)]
pub struct PairResponse {
    degree: usize,
    coefficients: Vec<f64>,
}

impl PairResponse {
    /// The response 1 in all directions.
    #[must_use]
    pub fn isotropic() -> Self {
        Self { degree: 0, coefficients: vec![1.0] }
    }

    /// The polynomial `constant - sum (n . a) (n . b)` over pairs of vectors, of degree 2.
    fn quadratic(constant: f64, vectors: &[[Vec3; 2]]) -> Self {
        let mut coefficients = vec![0.0; 6];
        for axis in 0..3 {
            let mut exponents = [0; 3];
            exponents[axis] = 2;
            coefficients[monomial_index(exponents)] = constant;
        }
        for [a, b] in vectors {
            for (p, a) in a.iter().enumerate() {
                for (q, b) in b.iter().enumerate() {
                    let mut exponents = [0; 3];
                    exponents[p] += 1;
                    exponents[q] += 1;
                    coefficients[monomial_index(exponents)] -= a * b;
                }
            }
        }
        Self { degree: 2, coefficients }
    }

    /// The response of two short dipoles along these unit vectors.
    #[must_use]
    pub fn of_dipoles(d: Vec3, e: Vec3) -> Self {
        Self::quadratic(dot(d, e), &[[d, e]])
    }

    /// The response of three crossed dipoles on each satellite, along the unit vectors d and e: 3/2 of the mean correlation of
    /// corresponding dipoles, which is 1 for equal attitudes.
    #[must_use]
    pub fn of_triads(d: [Vec3; 3], e: [Vec3; 3]) -> Self {
        let constant = 0.5 * (0..3).map(|k| dot(d[k], e[k])).sum::<f64>();
        let halves: [[Vec3; 2]; 3] = std::array::from_fn(|k| [d[k].map(|x| 0.5 * x), e[k]]);
        Self::quadratic(constant, &halves)
    }

    /// A form of degree 2.
    #[must_use]
    pub fn of_form(DirectionForm(coefficients): DirectionForm) -> Self {
        Self { degree: 2, coefficients: coefficients.to_vec() }
    }

    /// The response of the antennas of two satellites; elements count as isotropic unless both satellites have the same kind.
    #[must_use]
    pub fn of_antennas([a, b]: [&SatelliteAntenna; 2]) -> Self {
        let kind = match (a.elements, b.elements) {
            (AntennaResponse::DipoleNormal, AntennaResponse::DipoleNormal) => AntennaResponse::DipoleNormal,
            (AntennaResponse::ThreeDipoles, AntennaResponse::ThreeDipoles) => AntennaResponse::ThreeDipoles,
            _ => AntennaResponse::Isotropic,
        };
        let with = |of: Self, antenna: &SatelliteAntenna, k: usize| match antenna.forms {
            None => of,
            Some(forms) => of.times(&Self::of_form(forms[k])),
        };
        let all_alike =
            [a, b].iter().all(|antenna| antenna.forms.is_none_or(|forms| forms[1..] == [forms[0]; 2]));
        let ideal = match kind {
            AntennaResponse::DipoleNormal => Self::of_dipoles(a.axes[0], b.axes[0]),
            AntennaResponse::ThreeDipoles if all_alike => Self::of_triads(a.axes, b.axes),
            AntennaResponse::ThreeDipoles => {
                let halves = |k: usize| {
                    let half = a.axes[k].map(|x| 0.5 * x);
                    with(with(Self::of_dipoles(half, b.axes[k]), a, k), b, k)
                };
                return halves(0).plus(&halves(1)).plus(&halves(2));
            }
            AntennaResponse::Isotropic => Self::isotropic(),
        };
        with(with(ideal, a, 0), b, 0)
    }

    /// Their sum, of the higher degree.
    fn plus(&self, other: &Self) -> Self {
        let degree = self.degree.max(other.degree);
        let mut coefficients = self.coefficients_of_degree(degree);
        coefficients.iter_mut().zip(other.coefficients_of_degree(degree)).for_each(|(a, b)| *a += b);
        Self { degree, coefficients }
    }

    /// The product with another response.
    #[must_use]
    pub fn times(&self, other: &Self) -> Self {
        let degree = self.degree + other.degree;
        let mut coefficients = vec![0.0; monomials(degree).len()];
        for (a, x) in monomials(self.degree).into_iter().zip(&self.coefficients) {
            for (b, y) in monomials(other.degree).into_iter().zip(&other.coefficients) {
                coefficients[monomial_index(std::array::from_fn(|k| a[k] + b[k]))] += x * y;
            }
        }
        Self { degree, coefficients }
    }

    /// Degree of the polynomial.
    #[must_use]
    pub fn degree(&self) -> usize {
        self.degree
    }

    /// Value in a direction, a unit vector.
    #[must_use]
    pub fn value(&self, n_hat: Vec3) -> f64 {
        let power = |exponents: Exponents| -> f64 {
            n_hat.iter().zip(exponents).map(|(n, exponent)| n.powi(exponent as i32)).product()
        };
        monomials(self.degree).into_iter().map(power).zip(&self.coefficients).map(|(p, a)| a * p).sum()
    }

    /// Coefficients of the same response as a polynomial of this degree, which must not be lower.
    pub(super) fn coefficients_of_degree(&self, degree: usize) -> Vec<f64> {
        let mut raised = self.clone();
        // n . n = 1 raises the degree by 2.
        let one = Self::quadratic(1.0, &[]);
        while raised.degree < degree {
            raised = raised.times(&one);
        }
        raised.coefficients
    }
}

/// Products of skies with the monomials of one degree.
#[derive(Clone, Debug)]
pub(super) struct SkyProducts {
    degree: usize,
}

impl SkyProducts {
    pub(super) fn new(degree: usize) -> Self {
        Self { degree }
    }

    pub(super) fn degree(&self) -> usize {
        self.degree
    }

    pub(super) fn count(&self) -> usize {
        (self.degree + 1) * (self.degree + 2) / 2
    }

    fn factors([p, q, r]: Exponents) -> impl DoubleEndedIterator<Item = Component> {
        let [x, y, z] = Component::ALL.map(|component| move |count| std::iter::repeat_n(component, count));
        x(p).chain(y(q)).chain(z(r))
    }

    /// Computes all products of each sky, sky by sky.
    pub(super) fn multiply(&self, skies: &[Alm]) -> Vec<Alm> {
        let product = |sky: &Alm, exponents| {
            Self::factors(exponents).fold(sky.clone(), |sky, component| times_direction(&sky, component))
        };
        let all = |sky| monomials(self.degree).into_iter().map(move |exponents| product(sky, exponents));
        skies.iter().flat_map(all).collect()
    }

    /// Computes gradients with respect to skies from gradients with respect to their products.
    pub(super) fn gradients_of_skies(&self, gradients: Vec<Alm>) -> Vec<Alm> {
        if self.degree == 0 {
            return gradients;
        }
        let of_sky = |gradients: &[Alm]| {
            let mut sum: Option<Alm> = None;
            for (exponents, gradient) in monomials(self.degree).into_iter().zip(gradients) {
                let part = Self::factors(exponents).rev().fold(gradient.clone(), |gradient, component| {
                    times_direction_transposed(&gradient, component)
                });
                match &mut sum {
                    None => sum = Some(part),
                    Some(sum) => sum.values_mut().iter_mut().zip(part.values()).for_each(|(a, b)| *a += b),
                }
            }
            sum.unwrap_or_else(|| Alm::zeros(0))
        };
        gradients.chunks(self.count()).map(of_sky).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::vector::{cross, unit};

    #[test]
    fn monomials_have_their_places() {
        for degree in 0..=DEGREE_MAX {
            let all = monomials(degree);
            assert_eq!(all.len(), SkyProducts::new(degree).count());
            for (k, exponents) in all.into_iter().enumerate() {
                assert_eq!((exponents.iter().sum::<usize>(), monomial_index(exponents)), (degree, k));
            }
        }
    }

    #[test]
    fn responses_are_those_of_projections() {
        let [d, e] = [[0.3, -0.5, 0.9], [0.1, 0.8, 0.4]].map(unit);
        let across = |axis: Vec3, n: Vec3| {
            let along = dot(axis, n);
            [0, 1, 2].map(|k| axis[k] - along * n[k])
        };
        let p_2 = |x: f64| 1.5 * x * x - 0.5;
        for n in [[0.2, 0.3, -0.7], [1.0, 0.0, 0.0], [-0.4, 0.9, 0.1]].map(unit) {
            let dipoles = dot(across(d, n), across(e, n));
            assert!((PairResponse::of_dipoles(d, e).value(n) - dipoles).abs() < 1e-15);
            let [a, b] = [(d, 0.2), (e, -0.1)].map(|(axis_hat, q)| {
                SatelliteAntenna::new(AntennaResponse::DipoleNormal, [axis_hat, unit(cross(axis_hat, n))], q)
            });
            let expected = dipoles * (1.0 + 0.2 * p_2(dot(d, n))) * (1.0 - 0.1 * p_2(dot(e, n)));
            let found = PairResponse::of_antennas([&a, &b]);
            assert_eq!(found.degree(), 6);
            assert!((found.value(n) - expected).abs() < 1e-14, "{} {expected}", found.value(n));
            let higher = PairResponse {
                degree: 6,
                coefficients: PairResponse::of_dipoles(d, e).coefficients_of_degree(6),
            };
            assert!((higher.value(n) - dipoles).abs() < 1e-14);
        }
    }

    #[test]
    fn three_dipoles_of_one_attitude_see_all_directions_alike() {
        let axes = [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.8, 0.6]];
        // Rotated by 10 degrees about x.
        let (sin, cos) = 10.0_f64.to_radians().sin_cos();
        let turned = axes.map(|[x, y, z]| [x, cos * y - sin * z, sin * y + cos * z]);
        for n in [[0.2, 0.3, -0.7], [1.0, 0.0, 0.0], [-0.4, 0.9, 0.1]].map(unit) {
            assert!((PairResponse::of_triads(axes, axes).value(n) - 1.0).abs() < 1e-15);
            // sum_k d_k . e_k = 1 + 2 cos; sum_k (n . d_k) (n . e_k) = n . R n = nx^2 + cos (ny^2 + nz^2).
            let expected = 0.5 * (1.0 + 2.0 * cos - n[0] * n[0] - cos * (1.0 - n[0] * n[0]));
            let found = PairResponse::of_triads(axes, turned).value(n);
            assert!((found - expected).abs() < 1e-15, "{found} {expected}");
        }
    }
}
