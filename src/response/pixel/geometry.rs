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
    /// Elements of the antenna: one dipole along the first axis, three dipoles along all axes, or isotropic.
    pub elements: AntennaResponse,
    /// First and second axis, orthogonal unit vectors; the third is their cross product.
    pub axes_hat: [Vec3; 2],
    /// q in the factor `1 + q P_2(cos)` of the voltage pattern, with the angle from the first axis.
    pub distortion: f64,
}

impl SatelliteAntenna {
    /// All three axes, along which three dipoles point.
    #[must_use]
    pub fn triad(&self) -> [Vec3; 3] {
        let [a, b] = self.axes_hat;
        [a, b, cross(a, b)]
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
