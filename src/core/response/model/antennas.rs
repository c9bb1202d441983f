//! Direct sums over the sky with a different antenna on each daughter.

use std::sync::Arc;

use num_complex::Complex64;

use super::direct::DirectSum;
use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::response::general::DEGREE_MAX;
use crate::response::pixel::{SatelliteAntenna, antenna_powers, antenna_sums};

/// The antenna of each daughter at any time.
pub trait AntennaPatterns: Send + Sync {
    /// Returns the antenna of a daughter (counted from 0) at a mission time, s.
    fn antenna(&self, daughter: u8, t_s: f64) -> SatelliteAntenna;

    /// Maximum degree of a pair's response as a polynomial in the direction.
    fn degree(&self) -> usize {
        DEGREE_MAX
    }
}

/// Direct sum in which every daughter has its own antenna: two dipoles along d and e correlate an unpolarised wave from n by
/// `d . e - (n . d) (n . e)`.
///
/// Unless all positions of a call carry their pair (or daughter) and time, the response of the sum itself is used.
pub struct AntennaSum {
    sum: DirectSum,
    patterns: Arc<dyn AntennaPatterns>,
}

impl AntennaSum {
    /// Replaces the antenna response of `sum` by `patterns`.
    #[must_use]
    pub fn new(sum: DirectSum, patterns: Arc<dyn AntennaPatterns>) -> Self {
        Self { sum, patterns }
    }
}

impl VisibilityModel for AntennaSum {
    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        let pair_times: Option<Vec<_>> = positions.iter().map(|position| position.pair_time).collect();
        let Some(pair_times) = pair_times else { return self.sum.predict(positions, out) };
        let pairs = self.sum.pairs(positions)?.into_iter().zip(pair_times).map(|(geometry, (pair, t_s))| {
            (geometry, [pair.i, pair.j].map(|daughter| self.patterns.antenna(daughter, t_s)))
        });
        let pairs: Vec<_> = pairs.collect();
        let (directions, values, area_sr) = self.sum.sky();
        // Lengths agree by construction, so the sums cannot fail.
        let sums = antenna_sums(&pairs, directions, values, area_sr).unwrap_or_default();
        out.iter_mut().zip(sums).for_each(|(out, sum)| *out = sum.visibility_k_sr);
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        let daughter_times: Option<Vec<_>> =
            daughters.iter().map(|daughter| daughter.daughter_time).collect();
        let Some(daughter_times) = daughter_times else { return self.sum.predict_powers(daughters, out) };
        let singles = daughters
            .iter()
            .zip(daughter_times)
            .map(|(daughter, (number, t_s))| (self.sum.single(daughter), self.patterns.antenna(number, t_s)));
        let singles: Vec<_> = singles.collect();
        let (directions, values, area_sr) = self.sum.sky();
        // Lengths agree by construction, so the sums cannot fail.
        let powers = antenna_powers(&singles, directions, values, area_sr).unwrap_or_default();
        out.iter_mut().zip(powers).for_each(|(out, power)| *out = power);
        Ok(())
    }

    fn has_individual_antennas(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::frames::AntennaResponse;
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::sky::{Frame, SkyMap};
    use crate::units::Pair;
    use crate::units::vector::{Vec3, cross, dot, scale, sub, unit};

    const NSIDE: usize = 8;

    /// Antennas whose attitude depends on the daughter's number.
    struct Tilted {
        elements: AntennaResponse,
    }

    impl AntennaPatterns for Tilted {
        fn antenna(&self, daughter: u8, t_s: f64) -> SatelliteAntenna {
            let k = f64::from(daughter) + t_s * 1e-6;
            let axis_hat = unit([0.3 * k, -0.5 + 0.1 * k, 0.9]);
            let across = unit(cross(axis_hat, [0.7, 0.2 * k, 0.1]));
            SatelliteAntenna::new(self.elements, [axis_hat, across], 0.1 * k)
        }
    }

    /// A source in one pixel, and its direction.
    fn source() -> (SkyMap, Vec3) {
        let mut values = vec![0.0; 12 * NSIDE * NSIDE];
        // Near the zenith of all daughters, which are on the x axis at the epoch.
        let directions = pixel_directions(NSIDE);
        let above = (0..values.len()).max_by(|a, b| directions[*a][0].total_cmp(&directions[*b][0])).unwrap();
        values[above] = 1e4;
        (SkyMap::new(Frame::Ecliptic, values).unwrap(), directions[above])
    }

    #[test]
    fn one_source_is_seen_through_the_projections_of_both_dipoles() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let (sky, n_hat) = source();
        for elements in
            [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal, AntennaResponse::ThreeDipoles]
        {
            let sum = DirectSum::new(&sky, 3e6, array.moon_radius_m(), AntennaResponse::Isotropic);
            let mut plain = sum.clone();
            let mut model = AntennaSum::new(sum, Arc::new(Tilted { elements }));
            for (i, j) in [(0_u8, 1_u8), (2, 5), (1, 7)] {
                let t_s = 4e5 + f64::from(j);
                let [r_i_m, r_j_m] = [i, j].map(|n| array.position_m(n.into(), 0.0));
                let position =
                    PairPosition { r_i_m, r_j_m, span_rad: 0.0, pair_time: Some((Pair { i, j }, t_s)) };
                let (mut found, mut ideal) = ([Complex64::ZERO], [Complex64::ZERO]);
                model.predict(&[position], &mut found).unwrap();
                plain.predict(&[position], &mut ideal).unwrap();
                // The voltage of a polarisation is the component of the dipole across the wave's direction.
                let [a, b] = [i, j].map(|n| Tilted { elements }.antenna(n, t_s));
                let across = |axis: Vec3| sub(axis, scale(dot(axis, n_hat), n_hat));
                let dipoles = |a: &SatelliteAntenna, b: &SatelliteAntenna| match elements {
                    AntennaResponse::Isotropic => 1.0,
                    AntennaResponse::DipoleNormal => dot(across(a.axes[0]), across(b.axes[0])),
                    // Sum over corresponding dipoles, whose mean is 2/3 for equal attitudes.
                    AntennaResponse::ThreeDipoles => {
                        a.axes.iter().zip(b.axes).map(|(d, e)| dot(across(*d), across(e))).sum::<f64>() / 2.0
                    }
                };
                let legendre = |axis: Vec3| (3.0 * dot(axis, n_hat).powi(2) - 1.0) / 2.0;
                let q = |daughter: u8| 0.1 * (f64::from(daughter) + t_s * 1e-6);
                let factor =
                    dipoles(&a, &b) * (1.0 + q(i) * legendre(a.axes[0])) * (1.0 + q(j) * legendre(b.axes[0]));
                // Single precision of the fringe.
                assert!((found[0] - factor * ideal[0]).norm() < 2e-6 * ideal[0].norm(), "{i} {j}: {found:?}");
                let mut power = [0.0];
                let daughter = DaughterPosition {
                    r_m: r_i_m,
                    normal_hat: [0.0, 0.0, 1.0],
                    daughter_time: Some((i, t_s)),
                };
                model.predict_powers(&[daughter], &mut power).unwrap();
                let own = dipoles(&a, &a);
                let expected = 1e4 * pixel_area_sr(NSIDE) * own * (1.0 + q(i) * legendre(a.axes[0])).powi(2);
                assert!((power[0] / expected - 1.0).abs() < 1e-6, "{} {expected}", power[0]);
            }
        }
    }

    #[test]
    fn straight_antennas_are_those_of_the_response() {
        struct Straight(Array);
        impl AntennaPatterns for Straight {
            fn antenna(&self, daughter: u8, t_s: f64) -> SatelliteAntenna {
                let axis_hat = self.0.normal_hat(daughter.into(), t_s);
                let axes_hat = [axis_hat, unit(cross(axis_hat, [0.3, 0.5, 0.1]))];
                SatelliteAntenna::new(AntennaResponse::DipoleNormal, axes_hat, 0.0)
            }
        }
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let values = pixel_directions(NSIDE).iter().map(|n| 3.0 + n[0] + n[1] * n[2]).collect();
        let sky = SkyMap::new(Frame::Ecliptic, values).unwrap();
        let mut plain = DirectSum::new(&sky, 3e6, array.moon_radius_m(), AntennaResponse::DipoleNormal);
        let mut model = AntennaSum::new(plain.clone(), Arc::new(Straight(array.clone())));
        let t_s = 3e6;
        let [r_i_m, r_j_m] = [1, 5].map(|n| array.position_m(n, t_s));
        let position =
            PairPosition { r_i_m, r_j_m, span_rad: 0.0, pair_time: Some((Pair { i: 1, j: 5 }, t_s)) };
        let (mut found, mut expected) = ([Complex64::ZERO], [Complex64::ZERO]);
        model.predict(&[position], &mut found).unwrap();
        plain.predict(&[position], &mut expected).unwrap();
        // Single precision for a sky of 40 K sr.
        assert!((found[0] - expected[0]).norm() < 4e-5, "{found:?} {expected:?}");
    }
}
