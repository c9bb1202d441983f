//! Geometry of pairs and of single satellites: positions, baseline and antenna response.

use crate::array::hidden_by_moon;
use crate::frames::AntennaResponse;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, cross, dot, norm, scale, sub};

/// Positions of two satellites and the frequency of their visibility.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairGeometry {
    /// Position of satellite i, m, Moon-centred.
    pub r_i_m: Vec3,
    /// Position of satellite j, m, Moon-centred.
    pub r_j_m: Vec3,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Radius of the Moon, m; 0 if nothing hides the sky.
    pub moon_radius_m: f64,
    /// Antenna power response.
    pub response: AntennaResponse,
}

impl PairGeometry {
    /// Baseline r_i - r_j in wavelengths.
    #[must_use]
    pub fn baseline_wavelengths(&self) -> Vec3 {
        scale(self.frequency_hz / SPEED_OF_LIGHT_M_S, sub(self.r_i_m, self.r_j_m))
    }

    /// Normal of the plane through both satellites and the Moon's centre: the orbit normal, along which the dipoles of
    /// [`AntennaResponse::DipoleNormal`] point. `None` if both lie in the same or in opposite directions from the
    /// centre, which leaves the plane undefined. For one satellite use [`SingleGeometry`].
    #[must_use]
    #[doc(hidden)]
    pub fn orbit_normal(&self) -> Option<Vec3> {
        let normal = cross(self.r_i_m, self.r_j_m);
        let length = norm(normal);
        // For parallel positions the product is only rounding error.
        let rounding = 1e-12 * norm(self.r_i_m) * norm(self.r_j_m);
        (length > rounding).then(|| scale(1.0 / length, normal))
    }

    /// Power response A in direction `n_hat`; NaN for dipoles without an orbital plane.
    #[must_use]
    #[doc(hidden)]
    pub fn antenna(&self, n_hat: Vec3) -> f64 {
        match self.response {
            AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 1.0,
            AntennaResponse::DipoleNormal => {
                let along = self.orbit_normal().map_or(f64::NAN, |normal| dot(n_hat, normal));
                1.0 - along * along
            }
        }
    }
}

/// Antenna of one satellite with individual attitude and pattern.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SatelliteAntenna {
    /// What it consists of: one dipole along the first axis, or one along each.
    pub elements: AntennaResponse,
    /// Its axes: unit vectors across each other, or the effective axes of dipoles that were measured.
    pub axes: [Vec3; 3],
    /// Factors of the dipoles' voltages by direction; without dipoles the first holds. `None` for 1.
    pub forms: Option<[DirectionForm; 3]>,
}

impl SatelliteAntenna {
    /// The antenna with these axes, the third across both, and a factor `1 + q P_2(cos)` of its voltage with the angle from the first.
    #[must_use]
    pub fn new(elements: AntennaResponse, [a, b]: [Vec3; 2], q: f64) -> Self {
        let forms = (q != 0.0).then(|| [DirectionForm::of_distortion(a, q); 3]);
        Self { elements, axes: [a, b, cross(a, b)], forms }
    }
}

/// A symmetric form of degree 2 in a direction of length 1: its coefficients of x x, x y, x z, y y, y z, z z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DirectionForm(pub [f64; 6]);

impl DirectionForm {
    /// 1 in all directions.
    pub const ONE: Self = Self([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]);

    /// `n . F n` by a symmetric matrix on the axes of a body, which are given.
    #[must_use]
    pub fn of(matrix: [Vec3; 3], body: [Vec3; 3]) -> Self {
        let at = |p: usize, q: usize| -> f64 {
            let term = |(a, b): (usize, usize)| matrix[a][b] * body[a][p] * body[b][q];
            (0..9).map(|k| term((k / 3, k % 3))).sum()
        };
        Self([at(0, 0), 2.0 * at(0, 1), 2.0 * at(0, 2), at(1, 1), 2.0 * at(1, 2), at(2, 2)])
    }

    /// `1 + q P_2(n . axis)`.
    #[must_use]
    pub fn of_distortion(axis_hat: Vec3, q: f64) -> Self {
        let Self(one) = Self::ONE;
        let [x, y, z] = axis_hat;
        let squares = [x * x, 2.0 * x * y, 2.0 * x * z, y * y, 2.0 * y * z, z * z];
        Self(std::array::from_fn(|k| (1.0 - 0.5 * q) * one[k] + 1.5 * q * squares[k]))
    }

    /// Its value in a direction.
    #[inline(always)]
    #[must_use]
    pub fn value(&self, [x, y, z]: Vec3) -> f64 {
        let Self([xx, xy, xz, yy, yz, zz]) = self;
        x * (xx * x + xy * y + xz * z) + y * (yy * y + yz * z) + zz * z * z
    }
}

/// Position and antenna of one satellite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SingleGeometry {
    /// Position, m, Moon-centred.
    pub r_m: Vec3,
    /// Normal of the orbit, a unit vector along which dipoles point; the position alone does not determine it.
    pub normal_hat: Vec3,
    /// Radius of the Moon, m; 0 if nothing hides the sky.
    pub moon_radius_m: f64,
    /// Antenna power response.
    pub response: AntennaResponse,
}

impl SingleGeometry {
    /// Envelope A S in direction `n_hat`: 0 where the Moon hides it.
    #[must_use]
    pub fn envelope(&self, n_hat: Vec3) -> f64 {
        if hidden_by_moon(self.r_m, n_hat, self.moon_radius_m) {
            return 0.0;
        }
        match self.response {
            AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 1.0,
            AntennaResponse::DipoleNormal => 1.0 - dot(n_hat, self.normal_hat).powi(2),
        }
    }
}
