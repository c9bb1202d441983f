//! The sky of a map by spherical harmonics, for pairs on one circle.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use num_complex::Complex64;

use crate::frames::AntennaResponse;
use crate::response::harmonic::{GeometryLimits, PairOrientation, RotationTable};
use crate::response::model::{
    DirectSum, HarmonicSum, HarmonicSumSetup, ModelError, PairPosition, VisibilityModel,
};
use crate::sky::harmonics::{Alm, AnalysisOptions, Method};
use crate::sky::{Frame, MapError, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Longest baseline of a map, wavelengths, in units of its nside: two and a half times that whose fringe is two pixels wide.
const WAVELENGTHS_OF_NSIDE: f64 = 2.5;

/// Most of them; bounds the tables.
const WAVELENGTHS_MAX: f64 = 320.0;

/// Greatest nside whose tables are made: 0.7 GB, and 0.4 GB a channel.
pub(super) const NSIDE_MAX: usize = 256;

/// Phase of the longest baseline's fringe by which a pair may be off its circle, rad: half a percent of a turn in a hundred.
const PHASE_RAD_MAX: f64 = 1e-3;

/// Circles are multiples of these, far less than what matters, so that a pass has the circle of the one before.
const INCLINATION_STEP_DEG: f64 = 1e-5;
const RADIUS_STEP_M: f64 = 1.0;

/// A circular orbit.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Circle {
    inclination_deg: f64,
    radius_m: f64,
}

impl Circle {
    /// The circle of a pair, taken as prograde.
    fn of(position: &PairPosition) -> Option<Self> {
        let found = PairOrientation::of(position.r_i_m, position.r_j_m).ok()?;
        let inclination_deg = found.inclination_rad.min(PI - found.inclination_rad).to_degrees();
        Some(Self {
            inclination_deg: (inclination_deg / INCLINATION_STEP_DEG).round() * INCLINATION_STEP_DEG,
            radius_m: (found.radius_m / RADIUS_STEP_M).round() * RADIUS_STEP_M,
        })
    }

    fn inclination_rad(&self) -> f64 {
        self.inclination_deg.to_radians()
    }
}

/// The rotations of a circle, which channels share.
#[derive(Default)]
pub(super) struct Rotations {
    kept: Option<(Circle, Arc<RotationTable<f32>>)>,
}

impl Rotations {
    fn of(&mut self, circle: Circle, l_max: usize) -> Arc<RotationTable<f32>> {
        match &self.kept {
            Some((kept, table)) if *kept == circle && table.l_max() == l_max => Arc::clone(table),
            _ => {
                let table = Arc::new(RotationTable::new(l_max, circle.inclination_rad()));
                self.kept = Some((circle, Arc::clone(&table)));
                table
            }
        }
    }
}

/// The sky of a channel: harmonics where they hold, sums over pixels elsewhere.
pub(super) struct CircleSky {
    alm: Alm,
    nside: usize,
    frequency_hz: f64,
    moon_radius_m: f64,
    response: AntennaResponse,
    /// Of the circle seen last.
    made: Option<(Circle, HarmonicSum)>,
    elsewhere: DirectSum,
}

impl CircleSky {
    /// The sky of `map` (K) to degree 5/2 nside.
    ///
    /// # Errors
    /// A map with pixels that have no value.
    pub(super) fn new(
        map: &SkyMap,
        frequency_hz: f64,
        moon_radius_m: f64,
        response: AntennaResponse,
    ) -> Result<Self, MapError> {
        let nside = map.nside();
        let alm = map.harmonics(5 * nside / 2, &AnalysisOptions { method: Method::ACCURATE })?;
        let alm = match map.frame() {
            Frame::Ecliptic => alm,
            frame => alm.rotated(&frame.to_ecliptic()),
        };
        let elsewhere = DirectSum::new(map, frequency_hz, moon_radius_m, response);
        Ok(Self { alm, nside, frequency_hz, moon_radius_m, response, made: None, elsewhere })
    }

    /// Visibilities of positions, K sr. The circle is that of the first; what is not on it is summed over pixels.
    ///
    /// # Errors
    /// Positions that neither covers.
    pub(super) fn predict(
        &mut self,
        positions: &[PairPosition],
        rotations: &mut Rotations,
    ) -> Result<Vec<Complex64>, ModelError> {
        let covered = match positions.iter().find_map(Circle::of) {
            Some(circle) if circle.radius_m > self.moon_radius_m => {
                self.on(circle, rotations)?.predict_covered(positions)?
            }
            _ => vec![None; positions.len()],
        };
        let off =
            |(position, found): (&PairPosition, &Option<Complex64>)| found.is_none().then_some(*position);
        let rest: Vec<PairPosition> = positions.iter().zip(&covered).filter_map(off).collect();
        let mut summed = vec![Complex64::ZERO; rest.len()];
        self.elsewhere.predict(&rest, &mut summed)?;
        let mut summed = summed.into_iter();
        Ok(covered.into_iter().map(|found| found.or_else(|| summed.next()).unwrap_or_default()).collect())
    }

    /// The model on a circle.
    fn on(&mut self, circle: Circle, rotations: &mut Rotations) -> Result<&mut HarmonicSum, ModelError> {
        let made = match self.made.take() {
            Some((before, sum)) if before == circle => sum,
            _ => self.sum(circle, rotations)?,
        };
        Ok(&mut self.made.insert((circle, made)).1)
    }

    fn sum(&self, circle: Circle, rotations: &mut Rotations) -> Result<HarmonicSum, ModelError> {
        let wavelength_m = SPEED_OF_LIGHT_M_S / self.frequency_hz;
        let u_max = (WAVELENGTHS_OF_NSIDE * self.nside as f64)
            .min(WAVELENGTHS_MAX)
            .min(1.99 * circle.radius_m / wavelength_m);
        let off_deg = (PHASE_RAD_MAX / (TAU * u_max)).to_degrees();
        let setup = HarmonicSumSetup {
            frequency_hz: self.frequency_hz,
            orbit_radius_m: circle.radius_m,
            inclination_rad: circle.inclination_rad(),
            moon_radius_m: self.moon_radius_m,
            baseline_wavelengths_max: u_max,
            response: self.response,
            limits: GeometryLimits {
                out_of_track_deg_max: off_deg,
                inclination_deg_max: 0.0,
                altitude_m_max: RADIUS_STEP_M,
                radial_deg_max: off_deg,
            },
        };
        HarmonicSum::new(self.alm.clone(), setup, rotations.of(circle, self.alm.l_max()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::sky::harmonics::Transform;
    use crate::sky::healpix::pixel_area_sr;
    use crate::units::vector::{add, norm, scale, sub, unit};
    use crate::units::{StreamKind, random_stream};
    use rand::RngExt;

    const FREQUENCY_HZ: f64 = 10e6;
    const ISOTROPIC: AntennaResponse = AntennaResponse::Isotropic;

    fn array() -> Array {
        Array::new(&ArrayConfig::default()).unwrap()
    }

    /// A sky of degrees up to 24 above a level of 10 K.
    fn sky(nside: usize) -> SkyMap {
        let mut stream = random_stream(3, StreamKind::Probe, [0, 0]);
        let mut alm = Alm::zeros(24);
        for m in 0..=24 {
            for l in m..=24 {
                let im = if m == 0 { 0.0 } else { stream.random::<f64>() - 0.5 };
                *alm.get_mut(l, m) = Complex64::new(stream.random::<f64>() - 0.5, im);
            }
        }
        *alm.get_mut(0, 0) = (10.0 * (4.0 * PI).sqrt()).into();
        let values = Transform::new(nside, 24).unwrap().synthesis(&alm).unwrap();
        SkyMap::new(Frame::Ecliptic, values).unwrap()
    }

    /// Two daughters of an array over part of an orbit.
    fn pass(array: &Array, [i, j]: [usize; 2]) -> Vec<PairPosition> {
        let at = |t_s: f64| PairPosition {
            r_i_m: array.position_m(i, t_s),
            r_j_m: array.position_m(j, t_s),
            span_rad: 0.0,
            at: None,
        };
        (0..60).map(|k| at(1000.0 + 20.0 * f64::from(k))).collect()
    }

    fn circle_sky(array: &Array) -> CircleSky {
        CircleSky::new(&sky(64), FREQUENCY_HZ, array.moon_radius_m(), ISOTROPIC).unwrap()
    }

    fn bits(values: &[Complex64]) -> Vec<[u64; 2]> {
        values.iter().map(|value| [value.re.to_bits(), value.im.to_bits()]).collect()
    }

    #[test]
    fn pairs_on_a_circle_have_the_visibilities_of_sums_over_fine_pixels() {
        const FINE: usize = 256;
        let array = array();
        let positions = pass(&array, [0, 1]);
        let mut sky_of_circle = circle_sky(&array);
        let found = sky_of_circle.predict(&positions, &mut Rotations::default()).unwrap();
        let mut direct = DirectSum::new(&sky(FINE), FREQUENCY_HZ, array.moon_radius_m(), ISOTROPIC);
        let mut expected = vec![Complex64::ZERO; positions.len()];
        direct.predict(&positions, &mut expected).unwrap();
        // Direct sums count the 4 nside pixels on the limb whole: half a pixel each, at random, of some 12 K.
        let limb = 0.5 * (4.0 * FINE as f64).sqrt() * pixel_area_sr(FINE) * 12.0;
        for (found, expected) in found.iter().zip(&expected) {
            assert!((found - expected).norm() < 4.0 * limb, "{found} {expected} {limb}");
        }
        // It is not all limb.
        let power = expected.iter().map(Complex64::norm_sqr).sum::<f64>() / expected.len() as f64;
        assert!(power.sqrt() > 20.0 * limb, "{power}");
        assert!(sky_of_circle.made.is_some());
    }

    #[test]
    fn what_is_off_the_circle_or_too_long_is_summed_over_pixels() {
        let array = array();
        let mut positions = pass(&array, [0, 1]);
        let wavelength_m = SPEED_OF_LIGHT_M_S / FREQUENCY_HZ;
        let longest = pass(&array, [0, 7]);
        assert!(norm(sub(longest[0].r_i_m, longest[0].r_j_m)) > 2.5 * 64.0 * wavelength_m);
        positions.extend(longest);
        // A metre away from the Moon, of one.
        let moved = positions.len();
        positions.extend(pass(&array, [0, 1]).into_iter().map(|position| {
            let r_i_m = add(position.r_i_m, scale(1.0, unit(position.r_i_m)));
            PairPosition { r_i_m, ..position }
        }));
        let mut sky_of_circle = circle_sky(&array);
        let found = sky_of_circle.predict(&positions, &mut Rotations::default()).unwrap();
        let mut direct = DirectSum::new(&sky(64), FREQUENCY_HZ, array.moon_radius_m(), ISOTROPIC);
        let mut expected = vec![Complex64::ZERO; positions.len()];
        direct.predict(&positions, &mut expected).unwrap();
        assert_eq!(bits(&found[60..]), bits(&expected[60..]));
        assert!(found[..60].iter().zip(&expected[..60]).all(|(found, expected)| found != expected));
        // The last sixty by themselves: no circle fits them, not even their own.
        let alone = sky_of_circle.predict(&positions[moved..], &mut Rotations::default()).unwrap();
        assert_eq!(bits(&alone), bits(&expected[moved..]));
    }

    #[test]
    fn maps_that_are_too_fine_for_tables_are_refused_by_name() {
        use crate::calibration::solver::{SkyModel, SolverConfig};
        let fine = SkyMap::new(Frame::Ecliptic, vec![1.0; 12 * 512 * 512]).unwrap();
        let of = |sky_model: SkyModel| SolverConfig { sky_model, ..SolverConfig::default() };
        let refused = of(SkyModel::Harmonic).can_model(std::slice::from_ref(&fine)).unwrap_err();
        assert_eq!(refused.key, "calibrate.sky_model");
        assert!(refused.to_string().contains("nside 512"), "{refused}");
        for sky_model in [SkyModel::Auto, SkyModel::Direct] {
            of(sky_model).can_model(std::slice::from_ref(&fine)).unwrap();
            assert!(!of(sky_model).is_harmonic(512));
        }
        of(SkyModel::Harmonic).can_model(&[sky(64)]).unwrap();
    }

    #[test]
    fn another_circle_before_changes_no_bit() {
        let array = array();
        let positions = pass(&array, [1, 2]);
        let higher = Array::new(&ArrayConfig { altitude_m: 350e3, ..ArrayConfig::default() }).unwrap();
        let mut rotations = Rotations::default();
        let mut sky_of_circle = circle_sky(&array);
        let first = sky_of_circle.predict(&positions, &mut rotations).unwrap();
        let elsewhere = sky_of_circle.predict(&pass(&higher, [1, 2]), &mut rotations).unwrap();
        assert_ne!(bits(&elsewhere), bits(&first));
        assert_eq!(bits(&sky_of_circle.predict(&positions, &mut rotations).unwrap()), bits(&first));
        let mut other = circle_sky(&array);
        assert_eq!(bits(&other.predict(&positions, &mut Rotations::default()).unwrap()), bits(&first));
    }
}
