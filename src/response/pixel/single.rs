//! What one satellite hears by herself.

use super::kernel::Prepared;
use super::sums::sums_of;
use super::{Directions, ResponseError};
use crate::array::hidden_by_moon;
use crate::frames::AntennaResponse;
use crate::units::vector::{Vec3, dot};

/// Where one satellite stands, and how she hears.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SingleGeometry {
    /// Position, m, Moon-centred.
    pub r_m: Vec3,
    /// Normal of her orbit, a unit vector: one position does not tell it, and dipoles point along it.
    pub normal_hat: Vec3,
    /// Radius of the body that hides the sky, m.
    pub moon_radius_m: f64,
    /// Antenna power response.
    pub response: AntennaResponse,
}

impl SingleGeometry {
    /// A S in direction `n_hat`: 0 where the Moon hides it.
    #[must_use]
    pub fn envelope(&self, n_hat: Vec3) -> f64 {
        if hidden_by_moon(self.r_m, n_hat, self.moon_radius_m) {
            return 0.0;
        }
        match self.response {
            AntennaResponse::Isotropic => 1.0,
            AntennaResponse::DipoleNormal => 1.0 - dot(n_hat, self.normal_hat).powi(2),
        }
    }
}

/// `Int T A S dn` of each satellite, K sr, for a sky (K) at `directions`, `area_sr` each; as [`crate::response::pixel::sky_sums`] in
/// accuracy and threads.
///
/// # Errors
/// [`ResponseError::SkyLength`] unless there is one sky value for each direction.
pub fn sky_powers(
    singles: &[SingleGeometry],
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) -> Result<Vec<f64>, ResponseError> {
    let sums = sums_of(singles, Prepared::single, directions, sky_k, area_sr)?;
    Ok(sums.into_iter().map(|sum| sum.zero_spacing_k_sr).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::response::pixel::{PairGeometry, sky_sums};
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::units::vector::{cross, scale, unit};
    use std::f64::consts::PI;

    const MOON_M: f64 = 1.7371e6;

    /// On an orbit whose normal is nowhere near an axis.
    fn single(response: AntennaResponse) -> SingleGeometry {
        let normal_hat = unit([0.3, -0.6, 0.5]);
        let r_m = scale(2.0371e6, unit(cross(normal_hat, [0.2, 0.1, -0.7])));
        SingleGeometry { r_m, normal_hat, moon_radius_m: MOON_M, response }
    }

    #[test]
    fn powers_of_a_uniform_sky_are_the_solid_angles() {
        const NSIDE: usize = 128;
        let directions = pixel_directions(NSIDE);
        let sky_k = vec![3.0_f32; directions.len()];
        let cos = (1.0 - (MOON_M / 2.0371e6).powi(2)).sqrt();
        // All but the Moon's cap; of dipoles at right angles to the Moon the integral of 1 - sin^2 t cos^2 p over it.
        let whole = 2.0 * PI * (1.0 + cos);
        let dipole = PI * ((1.0 + cos) + (1.0 + cos.powi(3)) / 3.0);
        for (response, expected) in
            [(AntennaResponse::Isotropic, whole), (AntennaResponse::DipoleNormal, dipole)]
        {
            let one = single(response);
            let area_sr = pixel_area_sr(NSIDE);
            let found = sky_powers(&[one], &directions.as_slice().into(), &sky_k, area_sr).unwrap()[0];
            // Pixels count whole: some 4 x 128 of them lie on the limb, each half too much or too little at random.
            let limb = 0.5 * 512.0_f64.sqrt() * area_sr / expected;
            assert!((found / (3.0 * expected) - 1.0).abs() < 4.0 * limb, "{response:?}: {found}");
            let exact: f64 = directions.iter().map(|&n_hat| one.envelope(n_hat)).sum();
            // As documented for sums of f32.
            assert!((found / (3.0 * exact * area_sr) - 1.0).abs() < 1e-6, "{response:?}");
        }
    }

    #[test]
    fn a_pair_that_comes_together_hears_what_one_hears() {
        let one = single(AntennaResponse::DipoleNormal);
        let directions = pixel_directions(32);
        // Brighter to one side, so that a wrong axis shows.
        let sky_k: Vec<f32> =
            directions.iter().map(|n| 2.0 + (n[0] + n[2]) as f32 + (n[1] * n[2]) as f32).collect();
        let area_sr = pixel_area_sr(32);
        let directions = Directions::from(directions.as_slice());
        let expected = sky_powers(&[one], &directions, &sky_k, area_sr).unwrap()[0];
        let pair = |apart_m: f64| PairGeometry {
            r_i_m: one.r_m,
            r_j_m: crate::units::vector::add(one.r_m, scale(apart_m, unit(cross(one.normal_hat, one.r_m)))),
            frequency_hz: 1e6,
            moon_radius_m: MOON_M,
            response: AntennaResponse::DipoleNormal,
        };
        let near = sky_sums(&[pair(0.5)], &directions, &sky_k, area_sr).unwrap()[0].zero_spacing_k_sr;
        // Half a metre is 2.5e-7 rad; a plane through the two is known as well as their distance, to 1e-9 m.
        assert!((near / expected - 1.0).abs() < 3e-6, "{near} {expected}");
        // In one place they have no plane, and no answer instead of a wrong one.
        assert_eq!(pair(0.0).orbit_normal(), None);
        assert!(sky_sums(&[pair(0.0)], &directions, &sky_k, area_sr).unwrap()[0].zero_spacing_k_sr.is_nan());
    }
}
