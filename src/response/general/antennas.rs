//! Responses of pairs whose antennas differ, as polynomials in the direction.
//!
//! Of short dipoles along d and e an unpolarised wave from n leaves `d . e - (n . d) (n . e)`; further factors are polynomials in
//! `(n . d)^2`. With `n . n = 1` all terms have one even degree D, so that
//!
//! ```text
//! A_ij(n, t) = sum_k a_k(t) P_k(n),   P_k = n_x^p n_y^q n_z^r,   p + q + r = D,
//! ```
//!
//! and a visibility is a sum of isotropic ones of the skies `P_k T`, which have D degrees more than T. These do not depend on time, so
//! that antennas may turn as they like between visibilities: rows of B are interpolated for the isotropic ones alone.

use crate::frames::AntennaResponse;
use crate::response::pixel::{DirectionForm, SatelliteAntenna};
use crate::sky::harmonics::{Alm, Component, times_direction, times_direction_transposed};
use crate::units::vector::{Vec3, dot};

/// Greatest degree of a response: two dipoles, each with a pattern of its own.
pub const DEGREE_MAX: usize = 6;

/// Exponents of n_x, n_y and n_z.
type Exponents = [usize; 3];

/// Exponents of the monomials of one degree.
fn monomials(degree: usize) -> Vec<Exponents> {
    (0..=degree).rev().flat_map(|p| (0..=degree - p).rev().map(move |q| [p, q, degree - p - q])).collect()
}

/// Place of a monomial among those of its degree.
fn place([p, q, r]: Exponents) -> usize {
    let rest = q + r;
    debug_assert!(p + rest <= DEGREE_MAX);
    rest * (rest + 1) / 2 + r
}

/// The response of a pair: a homogeneous polynomial of even degree in the direction, of length 1.
#[derive(Clone, Debug, PartialEq)]
pub struct PairResponse {
    degree: usize,
    coefficients: Vec<f64>,
}

impl PairResponse {
    /// 1 in all directions.
    #[must_use]
    pub fn isotropic() -> Self {
        Self { degree: 0, coefficients: vec![1.0] }
    }

    /// `constant - (n . a) (n . b)` summed over pairs of vectors, as a polynomial of degree 2.
    fn quadratic(constant: f64, vectors: &[[Vec3; 2]]) -> Self {
        let mut coefficients = vec![0.0; 6];
        for axis in 0..3 {
            let mut exponents = [0; 3];
            exponents[axis] = 2;
            coefficients[place(exponents)] = constant;
        }
        for [a, b] in vectors {
            for (p, a) in a.iter().enumerate() {
                for (q, b) in b.iter().enumerate() {
                    let mut exponents = [0; 3];
                    exponents[p] += 1;
                    exponents[q] += 1;
                    coefficients[place(exponents)] -= a * b;
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

    /// The response of three crossed dipoles on each satellite, d and e being their unit vectors: the mean of the correlations of like
    /// dipoles, times 3/2, so that satellites of one attitude have the response 1.
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

    /// The response of the antennas of two satellites: dipoles if both are.
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
        let mut coefficients = self.coefficients_of(degree);
        coefficients.iter_mut().zip(other.coefficients_of(degree)).for_each(|(a, b)| *a += b);
        Self { degree, coefficients }
    }

    /// Their product.
    #[must_use]
    pub fn times(&self, other: &Self) -> Self {
        let degree = self.degree + other.degree;
        let mut coefficients = vec![0.0; monomials(degree).len()];
        for (a, x) in monomials(self.degree).into_iter().zip(&self.coefficients) {
            for (b, y) in monomials(other.degree).into_iter().zip(&other.coefficients) {
                coefficients[place(std::array::from_fn(|k| a[k] + b[k]))] += x * y;
            }
        }
        Self { degree, coefficients }
    }

    /// Its degree.
    #[must_use]
    pub fn degree(&self) -> usize {
        self.degree
    }

    /// Its value in a direction of length 1.
    #[must_use]
    pub fn at(&self, n_hat: Vec3) -> f64 {
        let power = |exponents: Exponents| -> f64 {
            n_hat.iter().zip(exponents).map(|(n, exponent)| n.powi(exponent as i32)).product()
        };
        monomials(self.degree).into_iter().map(power).zip(&self.coefficients).map(|(p, a)| a * p).sum()
    }

    /// The coefficients of the same response as a polynomial of a degree that is not less.
    pub(super) fn coefficients_of(&self, degree: usize) -> Vec<f64> {
        let mut same = self.clone();
        // Times n . n.
        let one = Self::quadratic(1.0, &[]);
        while same.degree < degree {
            same = same.times(&one);
        }
        same.coefficients
    }
}

/// Skies times the monomials of one degree.
#[derive(Clone, Debug)]
pub(super) struct Products {
    degree: usize,
}

impl Products {
    pub(super) fn new(degree: usize) -> Self {
        Self { degree }
    }

    pub(super) fn degree(&self) -> usize {
        self.degree
    }

    /// Products of each sky.
    pub(super) fn count(&self) -> usize {
        (self.degree + 1) * (self.degree + 2) / 2
    }

    fn factors([p, q, r]: Exponents) -> impl DoubleEndedIterator<Item = Component> {
        let [x, y, z] = Component::ALL.map(|component| move |count| std::iter::repeat_n(component, count));
        x(p).chain(y(q)).chain(z(r))
    }

    /// All products of each sky, one sky after the other.
    pub(super) fn of(&self, skies: &[Alm]) -> Vec<Alm> {
        let product = |sky: &Alm, exponents| {
            Self::factors(exponents).fold(sky.clone(), |sky, component| times_direction(&sky, component))
        };
        let all = |sky| monomials(self.degree).into_iter().map(move |exponents| product(sky, exponents));
        skies.iter().flat_map(all).collect()
    }

    /// Gradients with respect to skies from those with respect to their products.
    pub(super) fn back(&self, gradients: Vec<Alm>) -> Vec<Alm> {
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
            assert_eq!(all.len(), Products::new(degree).count());
            for (k, exponents) in all.into_iter().enumerate() {
                assert_eq!((exponents.iter().sum::<usize>(), place(exponents)), (degree, k));
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
            assert!((PairResponse::of_dipoles(d, e).at(n) - dipoles).abs() < 1e-15);
            let [a, b] = [(d, 0.2), (e, -0.1)].map(|(axis_hat, q)| {
                SatelliteAntenna::new(AntennaResponse::DipoleNormal, [axis_hat, unit(cross(axis_hat, n))], q)
            });
            let expected = dipoles * (1.0 + 0.2 * p_2(dot(d, n))) * (1.0 - 0.1 * p_2(dot(e, n)));
            let found = PairResponse::of_antennas([&a, &b]);
            assert_eq!(found.degree(), 6);
            assert!((found.at(n) - expected).abs() < 1e-14, "{} {expected}", found.at(n));
            let higher =
                PairResponse { degree: 6, coefficients: PairResponse::of_dipoles(d, e).coefficients_of(6) };
            assert!((higher.at(n) - dipoles).abs() < 1e-14);
        }
    }

    #[test]
    fn three_dipoles_of_one_attitude_see_all_directions_alike() {
        let axes = [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.8, 0.6]];
        // Turned by 10 degrees about x.
        let (sin, cos) = 10.0_f64.to_radians().sin_cos();
        let turned = axes.map(|[x, y, z]| [x, cos * y - sin * z, sin * y + cos * z]);
        for n in [[0.2, 0.3, -0.7], [1.0, 0.0, 0.0], [-0.4, 0.9, 0.1]].map(unit) {
            assert!((PairResponse::of_triads(axes, axes).at(n) - 1.0).abs() < 1e-15);
            // sum_k d_k . e_k = 1 + 2 cos; sum_k (n . d_k) (n . e_k) = n . R n = nx^2 + cos (ny^2 + nz^2).
            let expected = 0.5 * (1.0 + 2.0 * cos - n[0] * n[0] - cos * (1.0 - n[0] * n[0]));
            let found = PairResponse::of_triads(axes, turned).at(n);
            assert!((found - expected).abs() < 1e-15, "{found} {expected}");
        }
    }
}
